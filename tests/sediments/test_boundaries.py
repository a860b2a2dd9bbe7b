import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from sasmap.sediments import k_distribution
from sasmap.sediments.boundaries import (
    best_positions,
    filtered_joint,
    fit_profiles,
    row_maxima,
    window_likelihoods,
    window_ratios,
)
from sasmap.sediments.nodes import normals, refine_boundary, resampled

ROWS, COLUMNS = 120, 240


def densities(left, seed):
    """Log densities of K speckle under both laws, where `left` says which is true."""
    rng = np.random.default_rng(seed)
    one = k_distribution.rvs(1.0, size=left.shape, random_state=rng)
    other = 1.25 * k_distribution.rvs(5.0, size=left.shape, random_state=rng)
    amplitude = np.where(left, one, other)
    return (
        k_distribution.logpdf(amplitude, 1.0),
        k_distribution.logpdf(amplitude, 5.0, scale=1.25),
    )


def straight_edge(seed, at=100):
    return densities(np.broadcast_to(np.arange(COLUMNS) < at, (ROWS, COLUMNS)), seed)


def test_windows_sum_what_lies_beside_a_position():
    rng = np.random.default_rng(1)
    left, right = rng.normal(size=(2, 3, 50))
    found = window_likelihoods(left, right, 10)
    ratios = window_ratios(left, right, 10)
    for c in (10, 27, 40):
        np.testing.assert_allclose(found.left[:, c], left[:, c - 10 : c].sum(axis=1))
        np.testing.assert_allclose(found.right[:, c], right[:, c : c + 10].sum(axis=1))
        np.testing.assert_allclose(ratios.left[:, c], (left - right)[:, c - 10 : c].sum(axis=1))
        np.testing.assert_allclose(ratios.right[:, c], (right - left)[:, c : c + 10].sum(axis=1))
    np.testing.assert_allclose(found.joint, found.left + found.right)
    assert np.isnan(found.joint[:, [0, 9, 41, 50]]).all()
    with pytest.raises(ValueError, match="two windows"):
        window_ratios(left, right, 26)


def test_profiles_are_found_exactly_where_there_is_no_noise():
    level = np.where(np.arange(COLUMNS) < 90, 0.3, -0.2)[None]
    windows = window_ratios(level, np.zeros_like(level), 40)
    for side, values in (("left", windows.left), ("right", windows.right)):
        fitted = fit_profiles(values, side, 40)
        assert fitted.position.tolist() == [90]
        known = np.isfinite(values)
        np.testing.assert_allclose(fitted.filtered[known], values[known], atol=1e-9)
    assert row_maxima(filtered_joint(windows, 40)).tolist() == [90]


def test_each_step_of_the_published_way_is_an_improvement():
    errors = []
    for seed in range(6):
        log_left, log_right = straight_edge(seed)
        plain, ratio = window_likelihoods(log_left, log_right), window_ratios(log_left, log_right)
        ways = (
            row_maxima(plain.joint),
            row_maxima(ratio.joint),
            row_maxima(filtered_joint(ratio)),
            best_positions(log_left, log_right),
        )
        errors.append([np.abs(way - 100).mean() for way in ways])
    plain, ratio, filtered, whole = np.mean(errors, axis=0)
    assert plain > ratio > filtered > whole


def distance(points, row, column):
    return cKDTree(np.column_stack([row, column])).query(points)[0]


def test_nodes_follow_a_wavy_boundary_with_honest_intervals():
    errors, inside = [], []
    rows = np.arange(ROWS)
    edge = 120 + 10 * np.sin(rows / 15)
    for seed in range(5):
        log_left, log_right = densities(np.arange(COLUMNS) + 0.5 < edge[:, None], seed)
        guess = np.column_stack([rows[::-1], np.full(ROWS, 120.0)])  # upwards: left is left
        found = refine_boundary(guess, log_left - log_right, reach=20)
        fine = np.linspace(0, ROWS - 1, 4000)
        within = (found.points[:, 0] > 2) & (found.points[:, 0] < ROWS - 3)
        off = distance(found.points, fine, np.interp(fine, rows, edge) - 0.5)[within]
        errors.append(off.mean())
        inside.append(np.mean(off < 1.96 * found.sd[within]))
    assert np.mean(errors) < 1.5
    assert np.mean(inside) > 0.88


def test_nodes_close_around_an_island():
    row, column = np.indices((150, 150))
    left = np.hypot(row - 75, column - 75) > 40
    log_left, log_right = densities(left, 3)
    turn = np.linspace(0, 2 * np.pi, 60)[:-1]
    # clockwise on the map: the inside lies to the right
    guess = np.column_stack([75 - 34 * np.cos(turn), 75 + 34 * np.sin(turn)])
    found = refine_boundary(guess, log_left - log_right, closed=True, reach=16)
    radius = np.hypot(*(found.points - 75).T)
    assert np.abs(radius - 40).mean() < 1.2
    assert found.closed


def test_normals_point_right_of_the_way():
    up = np.column_stack([np.arange(10.0)[::-1], np.zeros(10)])
    np.testing.assert_allclose(normals(up, False), np.tile([0.0, 1.0], (10, 1)), atol=1e-12)


def test_points_are_laid_evenly():
    line = resampled(np.array([[0.0, 0.0], [0.0, 3.0], [0.0, 3.0], [4.0, 3.0]]), 1.0, False)
    np.testing.assert_allclose(np.hypot(*np.diff(line, axis=0).T), 1.0)
    with pytest.raises(ValueError, match="two different points"):
        resampled(np.zeros((3, 2)), 1.0, False)


def test_nothing_to_tell_leaves_a_line_where_it_is_and_unsure():
    guess = np.column_stack([np.arange(60.0), np.full(60, 30.0)])
    found = refine_boundary(guess, np.zeros((60, 60)), reach=10)
    assert np.abs(found.points[:, 1] - 30).max() < 1
    assert found.sd.min() > 3


def test_a_line_that_nothing_holds_does_not_run_away():
    # all of the image says that it is left of any line
    guess = np.column_stack([np.arange(80.0)[::-1], np.full(80, 40.0)])
    found = refine_boundary(guess, np.full((80, 200), 0.3), reach=10)
    assert np.abs(found.points[:, 1] - 40).max() < 16
    assert found.sd.min() > 3


@pytest.mark.parametrize("contrast", [3.0, 10.0])
@pytest.mark.parametrize("bright_left", [False, True])
def test_a_blurred_boundary_is_not_drawn_to_its_darker_side(contrast, bright_left):
    rng = np.random.default_rng(5)
    rows, columns, edge, fine = 240, 80, 40.3, 4
    place = np.arange(fine * columns) / fine - 0.5
    level = np.where((place < edge) == bright_left, contrast, 1.0)
    field = np.sqrt(level) * rng.standard_normal((2, fine * rows, fine * columns))
    blurred = gaussian_filter(field, (0, 0.5 * fine, 0.5 * fine))
    power = (blurred[:, fine // 2 :: fine, fine // 2 :: fine] ** 2).sum(axis=0)
    power /= power[:, 60:].mean() if bright_left else power[:, :20].mean()
    dark_over_bright = np.log(contrast) - power * (1 - 1 / contrast)
    # of the way up the rows, the left side has the smaller columns; 2.3 pixels to a sample
    ratio = (-dark_over_bright if bright_left else dark_over_bright) / 2.3
    guess = np.column_stack([np.arange(rows - 1.0, 0, -4), np.full(60, edge + 1)])
    found = refine_boundary(guess, ratio)
    off = (found.points[5:-5, 1] - edge).mean()
    assert abs(off) < 0.3  # without the offset of a sharp boundary 0.6 at a contrast of 10
    assert abs(off) < 2 * found.sd.mean()
