"""Straight crests as the limit of bent ones, and what a field of phases follows."""

from functools import cache

import numpy as np
import pytest

from sasmap.ripples import RippleSettings, estimate
from sasmap.ripples.demodulation import demodulate, refined_wave, rewaved, turned_back
from sasmap.ripples.fit import fitted, refined
from sasmap.ripples.optimise import search
from sasmap.ripples.phase import FORK_TURN, STIFFNESS, STRAIGHT, best_field, trial_fields
from sasmap.ripples.pixels import spread_boxes
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.ripples.rendered import lag_over_range
from sasmap.ripples.rendering import parameters_at
from sasmap.simulate import Scene
from sasmap.simulate.seafloor import SeaFloor
from tests.ripples.engine import coherent, summed

KEEP = RippleSettings(keep_model=True)
WANDER = {"wander": 1.0, "wander_length": 5.0, "near": 10.0, "frequency": 0.9, "height": 0.05}


@cache
def straight_cell(seed=4):
    return coherent(seed, near=12.0, frequency=0.8, height=0.05)


@cache
def wandering_cell(seed, **changes):
    return coherent(seed, **{**WANDER, "shape": (280, 280), **changes})


@cache
def wandering_estimate(seed):
    return estimate(wandering_cell(seed).clip, KEEP, rng=1)


@cache
def both_fits():
    """Straight crests, fitted as such and as a field."""
    made = straight_cell()
    image, task, field, _, _ = summed(made.clip, made.wave)
    boxes = demodulate(image, made.wave)
    boxes = rewaved(image, boxes, refined_wave(image, boxes, boxes.count > 0))
    rigid = refined(task, fitted(task, field, boxes.trend, search))
    curved = refined(
        task, fitted(task, best_field(image, boxes, trial_fields(boxes)), boxes.trend, search)
    )
    return rigid, curved


def scores(made):
    """How much better than a plane wave fields predict what they did not see."""
    image, task, field, _, _ = summed(made.clip, made.wave)
    boxes = demodulate(image, made.wave)
    boxes = rewaved(image, boxes, refined_wave(image, boxes, boxes.count > 0))
    upright = turned_back(image, boxes, lag_over_range(fitted(task, field, boxes.trend, search)))
    upright = rewaved(image, upright, refined_wave(image, upright, upright.count > 0))
    return trial_fields(upright).scores


def test_a_fork_that_the_best_field_passes_over_is_an_error_of_the_mean_wave():
    errors = []
    for forks in (0, 1):
        made = wandering_cell(11, forks=forks, wander=0.4)
        image, *_ = summed(made.clip, made.wave)
        boxes = demodulate(image, made.wave)
        boxes = rewaved(image, boxes, refined_wave(image, boxes, boxes.count > 0))
        trials = trial_fields(boxes)
        stiffest = trials._replace(scores=np.arange(len(STIFFNESS)) * 10.0)
        errors.append(best_field(image, boxes, stiffest).wave_sd[0])
    clip = max(made.clip.amplitude.shape) * made.clip.pixel_size
    assert errors[0] < 0.5 * FORK_TURN / clip
    assert errors[1] > 0.9 * FORK_TURN / clip


def test_straight_is_the_limit_of_bent():
    rigid, curved = both_fits()
    assert rigid.phase.rigid
    assert not curved.phase.rigid
    one, other = (parameters_at(f.z, f.geometry) for f in (rigid, curved))
    sd = [np.sqrt(f.peaks[0].covariance[2, 2]) for f in (rigid, curved)]
    assert abs(np.log(other.height / one.height)) < 2 * np.hypot(*sd)  # of log A_H
    assert abs(np.log(one.height / 0.05)) < 4 * sd[0]


def test_straight_and_bent_tell_the_same_frequency():
    rigid, curved = both_fits()
    truth = straight_cell().frequency
    lag = np.unwrap(lag_over_range(curved)[1])
    pixels = curved.data.pixel_count.sum(axis=1)
    slope = np.polyfit(curved.data.place, lag, 1, w=np.sqrt(pixels))[0] / (2 * np.pi)
    along = curved.geometry.along + slope
    sd = np.hypot(curved.phase.wave_sd[0], 1e-3)
    assert abs(along - truth) < 3 * sd
    ripple = parameters_at(rigid.z, rigid.geometry)
    assert abs(rigid.geometry.along + ripple.wave_offset - truth) < 2e-3


def test_fields_predict_straight_crests_no_better_than_a_plane_wave():
    assert (scores(straight_cell()) < STRAIGHT).all()
    assert scores(straight_cell()).max() > 0.9
    assert scores(straight_cell(5)).max() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("seed", [1, 2])
def test_fields_predict_crests_that_wander_better(seed):
    found = scores(wandering_cell(seed))
    assert (found >= STRAIGHT).any()
    assert found.max() > 1.05


def test_the_field_follows_the_true_phase():
    made = wandering_cell(1, noise=None)
    image, _, _, _, _ = summed(made.clip, made.wave)
    boxes = demodulate(image, made.wave)
    field = best_field(image, boxes, trial_fields(boxes))
    cycles = field.cycles
    row, column = (np.arange(n) - (n - 1) / 2 for n in image.shape)
    per_column, per_row, _ = field.per_pixel(image)
    seen = 2 * np.pi * (cycles + per_column * column + per_row * row[:, None])
    # the true phase shows as crests: intensity is highest a quarter before them
    power = image.power / spread_boxes(boxes.trend, boxes.size, image.shape)
    folded = np.abs((power * np.exp(-1j * seen)).mean())
    plane = 2 * np.pi * (per_column * column + per_row * row[:, None])
    flat = np.abs((power * np.exp(-1j * plane)).mean())
    assert folded > 1.1 * flat
    truth = true_phase(1)
    difference = np.exp(1j * (seen - truth))
    mean = difference.mean()
    assert np.abs(mean) > 0.93
    assert np.abs((np.exp(1j * (plane - truth))).mean()) < 0.9
    error = np.angle(difference * np.conj(mean))
    assert np.sqrt((error**2).mean()) < 0.35


def true_phase(seed):
    """Of the sea floor of :func:`wandering_cell`, rad: the scene that its random numbers make."""
    rng = np.random.default_rng(seed)
    first = float(rng.uniform(0, 2 * np.pi))
    size = 280 * 0.05
    scene = Scene.model_validate(
        {
            "name": "cell",
            "seed": int(rng.integers(2**62)),
            "origin": (0.0, 0.0),
            "size": (size, size),
            "pixel_size": 0.05,
            "physics": "coherent",
            "sediments": [{"name": "sand"}],
            "ripples": [
                {
                    "frequency": 0.9,
                    "height": 0.05,
                    "azimuth": 90.0,
                    "phase": first,
                    "profile": "sine",
                    "wander": 1.0,
                    "wander_length": 5.0,
                }
            ],
            "passes": [{"name": "east", "heading": 0.0, "distance": 17.0, "altitude": 5.0}],
        }
    )
    clip = wandering_cell(seed, noise=None).clip
    return SeaFloor(scene).waves(clip.x, clip.y).phase


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_crests_that_wander_keep_their_mean_frequency_and_height(seed):
    made, posterior = wandering_cell(seed), wandering_estimate(seed)
    assert posterior.sampled
    assert LeftOut.PHASE_FIELD not in posterior.left_out
    for name, truth in (("frequency", made.frequency), ("height", 0.05)):
        assert abs(float(posterior.mean[name]) - truth) < 4 * float(posterior.sd[name])
    assert abs(float(posterior.mean.frequency) / made.frequency - 1) < 0.02
    assert np.isfinite(posterior.shape.stiffness)
    off = (posterior.azimuth[0] - made.azimuth + 90) % 180 - 90
    assert abs(off) < 4 * posterior.azimuth[1]


def test_the_modelled_image_follows_crests_that_wander():
    clip, posterior = wandering_cell(1).clip, wandering_estimate(1)
    model = posterior.model
    seen = np.isfinite(model)
    assert seen.mean() > 0.6
    # speckle has a mean amplitude of 0.886 of the root of its intensity, and varies by 0.52 of it
    assert np.corrcoef(model[seen], clip.amplitude[seen])[0, 1] > 0.4
    # a bin's pixels differ, where crests wander: the mean amplitude is less for it
    ratio = clip.amplitude[seen].mean() / model[seen].mean()
    assert 0.94 < ratio < 1.01


def test_straight_crests_need_no_field():
    posterior = estimate(straight_cell().clip, rng=1)
    assert LeftOut.PHASE_FIELD in posterior.left_out
    assert posterior.shape.rippled_fraction > 0.95
    assert posterior.shape.stiffness == np.inf
    assert posterior.quality is Quality.GOOD


def half_rippled():
    """Ripples in the upper half of a clip: the lower is a flat floor seen the same way."""
    made, flat = straight_cell(), coherent(8, near=12.0, height=0.0)
    amplitude = made.clip.amplitude.copy()
    amplitude[130:] = flat.clip.amplitude[130:]
    return type(made.clip)(**{**vars(made.clip), "amplitude": amplitude})


def test_ripples_in_half_a_cell_are_found_and_only_there():
    posterior = estimate(half_rippled(), RippleSettings(keep_model=True, draws=500), rng=1)
    assert abs(float(posterior.mean.frequency) - 0.8) < 5e-3
    assert 0.3 < posterior.shape.rippled_fraction < 0.75
    rows = np.isfinite(posterior.model).mean(axis=1)
    assert rows[:100].mean() > 0.9
    assert rows[170:].mean() < 0.2


def test_holes_are_modelled_too():
    clip = wandering_cell(3).clip
    amplitude = clip.amplitude.copy()
    amplitude[100:130, 80:200] = np.nan
    model = estimate(type(clip)(**{**vars(clip), "amplitude": amplitude}), KEEP, rng=1).model
    hole = (slice(105, 125), slice(90, 190))
    assert np.isfinite(model[hole]).mean() > 0.8
