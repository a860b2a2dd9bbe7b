"""The wave number across the look, and heights that vary."""

import numpy as np
import pytest

from sasmap.ripples.clip import Clip
from sasmap.ripples.estimation import ONE_HEIGHT
from sasmap.ripples.fit import fit_wave
from sasmap.ripples.optimise import COORDINATES, HEIGHT, PHASE
from sasmap.ripples.rendered import expected_at, painted, pulses_at
from sasmap.ripples.rendering import line_of_lags
from tests.ripples.engine import SHAPE, fitted_cell, summed


def errors_across(turn):
    """Errors of the wave number across the look over their standard deviations."""
    made = [fitted_cell(seed, turn) for seed in range(60, 70)]
    assert all(fit.phase.rigid for *_, fit in made)
    told = [(fit.across, cell.wave @ image.beside) for cell, image, fit in made]
    return np.array([(found - truth) / sd for (found, sd), truth in told])


@pytest.mark.parametrize("turn", [3.0, 25.0])
def test_the_wave_number_across_the_look_scatters_by_its_error(turn):
    # crests that lie nearly along the columns leak between the spectrum's bins
    errors = errors_across(turn)
    assert abs(errors.mean()) < 3 / np.sqrt(errors.size)
    assert 0.4 < np.sqrt(np.mean(errors**2)) < 1.7


def lag(fit, z):
    """Lag of the image's phase at the clip's centre, rad."""
    return line_of_lags(pulses_at(fit, z)[1], fit.data)[1]


def uneven(seed, spread, turn=10.0, **changes):
    """Spread of heights fitted to a cell whose single waves are made higher or lower."""
    made, image, fit = fitted_cell(seed, turn, **changes)
    if spread == 0.0:
        return fit.unlike
    rng = np.random.default_rng(seed)
    per_column, per_row, origin = fit.phase.per_pixel(image)
    row, column = np.indices(SHAPE)
    cycles = origin + per_column * (column - 0.5 * SHAPE[1]) + per_row * (row - 0.5 * SHAPE[0])
    number = np.floor(cycles).astype(int) - int(np.floor(cycles.min()))
    every = np.ones(SHAPE, bool)
    equal = painted(image, fit, every, expected_at(fit, fit.z)[0])
    seen = np.empty(SHAPE)
    for k, change in enumerate(spread * rng.standard_normal(number.max() + 1)):
        z = fit.z + change * np.eye(COORDINATES)[HEIGHT]
        z[PHASE] -= lag(fit, z) - lag(fit, fit.z)  # the crests stay where they are
        here = number == k
        seen[here] = (painted(image, fit, every, expected_at(fit, z)[0]) / equal)[here]
    clip = Clip(**{**vars(made.clip), "amplitude": made.clip.amplitude * np.sqrt(seen)})
    _, task, *_ = summed(clip, made.wave)
    return fit_wave(task, made.wave).unlike


@pytest.mark.parametrize("law", ["lambert", "rough", "gaussian"])
def test_equal_waves_have_no_spread_of_heights_under_any_law(law):
    spreads = [uneven(seed, 0.0, law=law) for seed in range(4)]
    assert np.median(spreads) < ONE_HEIGHT
    assert max(spreads) < 3 * ONE_HEIGHT


def test_forks_are_no_spread_of_heights():
    forked = {"wander": 0.5, "wander_length": 5.0, "forks": 2, "near": 20.0}
    assert np.median([uneven(seed, 0.0, **forked) for seed in range(5)]) < 0.06


@pytest.mark.parametrize("turn", [0.0, 30.0])
def test_the_spread_of_heights_grows_with_that_of_single_waves(turn):
    # what is estimated is a variance
    few, many = (
        np.sqrt(np.mean([uneven(seed, sd, turn) ** 2 for seed in range(5)])) for sd in (0.1, 0.3)
    )
    # a square holds parts of two waves, and of more where crests are oblique
    assert 0.03 < few < 0.1
    assert 2 * few < many < 0.3
