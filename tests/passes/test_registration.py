"""Shifts of passes told from crests that migrate."""

import numpy as np

from sasmap.passes.registration import Moves, left_over, registration


def crests(rng, shifts, cells, migrated=(), azimuth=None):
    """What cells of random wavelength and direction show of passes that are shifted."""
    rows = []
    for _ in range(cells):
        turn = rng.uniform(0, np.pi) if azimuth is None else azimuth
        normal, wavelength = np.array([np.sin(turn), np.cos(turn)]), rng.uniform(0.5, 1.5)
        for k in range(1, len(shifts)):
            moved = normal @ shifts[k] + rng.normal(0, 0.005)
            rows.append((0, k, moved, 0.005, wavelength, normal))
    first, swath, distance, sd, wavelength, normal = zip(*rows, strict=True)
    distance, wavelength = np.array(distance), np.array(wavelength)
    for i in migrated:
        distance[i] += 0.3 * wavelength[i]
    distance -= wavelength * np.rint(distance / wavelength)
    ints = (np.array(first), np.array(swath))
    return Moves(*ints, distance, np.array(sd), wavelength, np.array(normal))


def test_a_shift_that_all_cells_show_is_registration():
    rng = np.random.default_rng(1)
    shifts = np.array([[0.0, 0.0], [0.45, -0.8], [0.0, 0.0]])
    migrated = range(0, 24, 4)  # some cells, of the first pass
    moves = crests(rng, shifts, 30, migrated)
    found = registration(moves, 3)
    np.testing.assert_allclose(found, shifts, atol=0.02)
    rest = left_over(moves, found)
    other = np.setdiff1d(np.arange(len(rest)), list(migrated))
    assert np.abs(rest[other]).max() < 0.05
    expected = 0.3 * moves.wavelength[list(migrated)]
    np.testing.assert_allclose(rest[list(migrated)], expected, atol=0.05)


def test_crests_that_migrate_each_by_its_own_distance_are_no_registration():
    rng = np.random.default_rng(2)
    moves = crests(rng, np.zeros((2, 2)), 40)
    wild = moves._replace(distance=rng.uniform(-0.5, 0.5, 40) * moves.wavelength)
    assert not registration(wild, 2).any()


def test_few_cells_tell_no_registration():
    rng = np.random.default_rng(3)
    moves = crests(rng, np.array([[0.0, 0.0], [0.2, 0.1]]), 4)
    assert not registration(moves, 2).any()


def test_parallel_crests_tell_a_shift_along_their_normal_only():
    rng = np.random.default_rng(4)
    found = registration(crests(rng, np.array([[0, 0], [0.2, 0.6]]), 20, azimuth=np.pi / 2), 2)
    np.testing.assert_allclose(found[1], [0.2, 0.0], atol=0.02)
