"""The wave number across the look, and what slight bends of the crests leave unknown."""

from functools import cache

import numpy as np
import pytest

from sasmap.ripples.fit import fit_wave
from tests.ripples.engine import coherent, summed

SHAPE = (200, 200)


@cache
def fitted_cell(seed, turn, **changes):
    """A fit to a cell whose crest normals are turned from the look; true wave number across it."""
    changes = {"near": 14.0, "frequency": 0.9, "height": 0.06, "shape": SHAPE} | changes
    made = coherent(seed, azimuth_off_look=turn, **changes)
    _, task, *_ = summed(made.clip, made.wave)
    look = task.image.look
    return fit_wave(task, made.wave), made.wave @ np.array([look[1], -look[0]])


def errors_across(turn):
    """Errors of the wave number across the look over their standard deviations."""
    made = [fitted_cell(seed, turn) for seed in range(60, 70)]
    assert all(fit.phase.rigid for fit, _ in made)
    return np.array([(fit.across[0] - truth) / fit.across[1] for fit, truth in made])


@pytest.mark.parametrize("turn", [3.0, 25.0])
def test_the_wave_number_across_the_look_scatters_by_its_error(turn):
    # crests that lie nearly along the columns leak between the spectrum's bins
    errors = errors_across(turn)
    assert abs(errors.mean()) < 3 / np.sqrt(errors.size)
    assert 0.4 < np.sqrt(np.mean(errors**2)) < 1.7


def test_slight_bends_widen_the_error_of_the_wave_number():
    bends = {"wander": 0.5, "wander_length": 6.0}
    seeds = (0, 1, 3)  # a phase field follows cell 2
    slight = [fitted_cell(seed, 0.0, **bends)[0] for seed in seeds]
    straight = [fitted_cell(seed, 0.0)[0] for seed in seeds]
    assert all(fit.phase.rigid for fit in straight + slight)
    for one, other in zip(straight, slight, strict=True):
        assert other.tilt > 1.5 * one.tilt
        assert other.across[1] > 1.5 * one.across[1]
