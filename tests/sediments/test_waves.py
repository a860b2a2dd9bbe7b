import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, gaussian_filter

from sasmap.sediments import waves as module
from sasmap.sediments.waves import LATTICE, MARGIN, find_waves

SIZE = 640


def speckle(seed, shape=(SIZE, SIZE), width=0.0):
    z = np.random.default_rng(seed).normal(size=(2, *shape))
    if width:
        z = np.stack([gaussian_filter(v, width) for v in z])
    return np.hypot(*z)


def rippled(seed, length, turn, contrast=0.8, shape=(SIZE, SIZE)):
    """Speckle over wandering crests, and how many times brighter these make it."""
    y, x = np.indices(shape)
    phase = 2 * np.pi * (x * np.cos(turn) + y * np.sin(turn)) / length + np.sin(y / 90)
    pulse = np.maximum(1 + contrast * np.sin(phase), 0.15)
    return speckle(seed, shape) * pulse, pulse


@pytest.mark.parametrize(("length", "turn"), [(30, 0.4), (66, 0.0), (48, 1.9)])
def test_ripples_are_taken_off_and_leave_the_level_of_flat_floor(length, turn):
    image, pulse = rippled(1, length, turn)
    waves = find_waves(image)
    assert waves.rippled.mean() > 0.95
    flat = image * np.exp(-waves.profile)
    ripples = np.log(pulse)
    before = np.std(gaussian_filter(np.log(image), 2))
    after = np.std(gaussian_filter(np.log(flat), 2))
    assert after < 0.35 * before
    middle = slice(100, -100), slice(100, -100)
    assert np.corrcoef(ripples[middle].ravel(), waves.profile[middle].ravel())[0, 1] > 0.97
    # amplitude is linear in slope: the mean amplitude is that of flat floor, 0.3 dB or so
    assert np.mean(flat) / np.mean(speckle(1)) == pytest.approx(1, abs=0.05)


def uneven(kind):
    """Phase and second phase of crests that turn, end or are crossed by others."""
    y, x = np.indices((SIZE, SIZE))
    phase, second = 2 * np.pi * x / 60, np.zeros((SIZE, SIZE))
    if kind == "kink":
        phase += np.where(y > 320, 2 * np.pi * (y - 320) * 0.4 / 60, 0)
    elif kind == "forks":
        phase += np.arctan2(y - 300, x - 250) - np.arctan2(y - 420, x - 400)
    else:
        second = 2 * np.pi * (0.5 * x + 0.8 * y) / 42
    return phase, second


@pytest.mark.parametrize(("kind", "most"), [("kink", 1.3), ("forks", 1.3), ("crossing", 3.0)])
def test_crests_that_turn_fork_or_cross_leave_one_bed(kind, most):
    phase, second = uneven(kind)
    pulse = np.maximum(1 + 0.8 * np.sin(phase) + 0.5 * np.sin(second), 0.15)
    waves = find_waves(speckle(5) * pulse)
    assert waves.rippled.mean() > 0.98
    flat = speckle(5) * pulse * np.exp(-waves.profile)
    rest, alone = (np.std(gaussian_filter(np.log(v), 3)) for v in (flat, speckle(5)))
    assert alone < rest < most * alone  # ripples have eleven times as much
    assert np.mean(flat) / np.mean(speckle(5)) == pytest.approx(1, abs=0.03)


def test_a_doubtful_wave_needs_a_sure_one_beside_it(monkeypatch):
    image, _ = rippled(10, 66, 0.0)
    monkeypatch.setattr(module, "RISES", (1.0, 1e12))
    assert not find_waves(image).rippled.any()
    sure, doubtful = module._Wave(0.1, 0.02, 5.0), module._Wave(-0.09, -0.03, 1.4)
    assert doubtful.like(sure)
    assert not module._Wave(0.1, -0.08, 1.4).like(sure)


@pytest.mark.parametrize("radius", [0.7, 3.0, 11.4])
def test_a_mask_grows_by_discs(radius):
    mask = np.random.default_rng(2).random((60, 83)) < 0.004
    found = module._discs(mask, radius)
    np.testing.assert_array_equal(found, distance_transform_edt(~mask) <= radius)


def test_ripples_end_where_they_end():
    image, _ = rippled(2, 50, 0.3)
    y, x = np.indices(image.shape)
    there = np.hypot(x - 320, y - 320) < 200
    waves = find_waves(np.where(there, image, speckle(3)))
    near = np.abs(np.hypot(x - 320, y - 320) - 200) < 45
    assert waves.rippled[there & ~near].mean() > 0.95
    assert waves.rippled[~there & ~near].mean() < 0.02
    assert np.abs(waves.profile[~there & ~near]).mean() < 0.02


@pytest.mark.parametrize("kind", ["speckle", "correlated", "boulders", "edges", "objects", "holes"])
def test_what_is_no_ripple_is_left_alone(kind):
    image = speckle(4, width=1.5 if kind == "correlated" else 0.0)
    y, x = np.indices(image.shape)
    if kind == "boulders":
        texture = gaussian_filter(np.random.default_rng(5).normal(size=image.shape), 8)
        image *= np.exp(0.7 * texture / texture.std())
    elif kind == "edges":
        image[x + 15 * np.sin(y / 40) > 300] *= 3
        image[y + x / 2 > 500] *= 0.4
    elif kind == "objects":
        image[200:240, 150:260] *= 8
        image[200:240, 260:360] *= 0.05
    elif kind == "holes":
        image[:, 250:400] = np.nan
    waves = find_waves(image)
    assert not waves.rippled.any()
    assert not waves.profile.any()


def test_sediments_under_ripples_keep_their_levels():
    image, _ = rippled(6, 40, 0.2)
    x = np.indices(image.shape)[1]
    image = np.where(x > 320, 2.0, 1.0) * image
    waves = find_waves(image)
    flat = np.log(image * np.exp(-waves.profile))
    assert flat[:, 400:].mean() - flat[:, :240].mean() == pytest.approx(np.log(2), abs=0.05)


def test_pieces_of_a_survey_agree_with_the_whole():
    shape = (5 * LATTICE + 70, 4 * LATTICE)
    image, _ = rippled(7, 45, 0.9, shape=shape)
    image[:, 900:] = speckle(8, shape)[:, 900:]
    whole = find_waves(image)
    first, last = 2 * LATTICE, 4 * LATTICE
    piece = find_waves(image[first - MARGIN : last + MARGIN])
    part = slice(MARGIN, MARGIN + last - first)
    np.testing.assert_allclose(piece.profile[part], whole.profile[first:last], atol=1e-5)
    np.testing.assert_array_equal(piece.rippled[part], whole.rippled[first:last])


def test_what_is_unknown_changes_nothing_around_it():
    image, _ = rippled(9, 44, 0.1)
    alone = find_waves(image)
    padded = np.full((SIZE + 300, SIZE + 300), np.nan)
    padded[:SIZE, :SIZE] = image
    found = find_waves(padded)
    assert np.abs(found.profile[:SIZE, :SIZE] - alone.profile).mean() < 0.02
    assert not found.rippled[SIZE:].any()
