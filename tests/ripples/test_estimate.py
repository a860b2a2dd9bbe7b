import warnings

import numpy as np
import pytest
import xarray as xr

from sasmap.ripples import Clip, Prior, RippleSettings, estimate
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.simulate import Scene, simulate_clip
from tests.helpers import clip_of, zare_cobb_clip
from tests.ripples.test_clip import turned

CREST = RippleSettings(shadow="crest")
# (near, far, f, A_H): ZC tables 1 to 3 and their printed mean squared errors of f and A_H
TABLES = [
    (1.2, 13.4, 0.6, 0.07, 0.34, 0.24),
    (12.2, 24.4, 0.6, 0.07, 8e-5, 0.62),
    (24.4, 36.6, 0.6, 0.07, 1e-6, 0.001),
    (36.6, 48.2, 0.6, 0.07, 6e-6, 0.002),
    (24.4, 36.6, 0.4, 0.07, 3e-5, 0.806),
    (24.4, 36.6, 0.5, 0.07, 3e-5, 0.303),
    (24.4, 36.6, 0.7, 0.07, 1e-6, 0.002),
    (24.4, 36.6, 0.6, 0.06, 1e-5, 0.13),
    (24.4, 36.6, 0.6, 0.08, 1e-5, 0.002),
    (24.4, 36.6, 0.6, 0.09, 1e-5, 0.004),
]


@pytest.mark.parametrize("rule", ["crest", "line-of-sight"])
@pytest.mark.parametrize("entry", TABLES, ids=lambda e: f"{e[0]}-{e[1]}-f{e[2]}-A{e[3]}")
def test_beats_every_printed_entry(entry, rule):
    near, far, frequency, height, error_f, error_height = entry
    errors = []
    for seed in range(2):
        clip = zare_cobb_clip(near, far, frequency, height, rule, seed)
        mean = estimate(clip, RippleSettings(shadow=rule), rng=seed).mean
        errors.append([float(mean.frequency) - frequency, float(mean.height) - height])
    f, h = (np.array(errors) ** 2).mean(axis=0)
    assert f < min(error_f, 2e-6)
    assert h < min(error_height, 2e-5)


def test_same_seed_same_draws_other_seed_same_answer():
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07)
    one, two, other = (estimate(clip, CREST, rng=seed) for seed in (1, 1, 2))
    xr.testing.assert_identical(one.draws, two.draws)
    assert not one.draws.equals(other.draws)
    assert abs(float(one.mean.height - other.mean.height)) < 1e-3
    assert one.quality is Quality.GOOD
    assert max(one.rhat.values()) <= 1.01
    assert min(*one.ess_bulk.values(), *one.ess_tail.values()) >= 400


def test_takes_arrays_as_well_as_clips():
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07)
    wide = {
        k: (("y", "x"), getattr(clip, k))
        for k in ("x", "y", "ground_range", "altitude", "look_azimuth")
    }
    array = xr.DataArray(clip.amplitude, dims=("y", "x"), coords=wide)
    posterior = estimate(array, CREST, rng=1)
    assert posterior.draws.frequency.dims == ("chain", "draw")
    other = estimate(clip, CREST, rng=1)
    for name in ("frequency", "height"):
        assert abs(float(posterior.mean[name] - other.mean[name])) < float(other.sd[name])
    quantiles = posterior.quantiles.height.values
    assert quantiles[0] < quantiles[1] < quantiles[2]


@pytest.mark.parametrize("degrees", [0, 90, 215])
def test_answer_does_not_turn_with_the_map(degrees):
    clip = turned(zare_cobb_clip(24.4, 36.6, 0.6, 0.07), degrees)
    posterior = estimate(clip, CREST, rng=1)
    assert abs(float(posterior.mean.frequency) - 0.6) < 1e-3
    assert abs(float(posterior.mean.height) - 0.07) < 1e-3
    off = (posterior.azimuth[0] - 90 - degrees + 90) % 180 - 90
    assert abs(off) < 0.1


@pytest.mark.parametrize("seed", range(10))
def test_flat_sea_floor_has_no_ripples(seed):
    rng = np.random.default_rng(seed)
    r = 20 + 0.05 * np.arange(200)
    trend = np.exp(-(((r - 25) / 8) ** 2))
    posterior = estimate(clip_of(trend * rng.rayleigh(1.0, (200, 200)), r, 5.0, 0.05), rng=seed)
    assert posterior.quality is Quality.NO_RIPPLES
    assert not posterior.sampled
    assert LeftOut.SAMPLING in posterior.left_out


def test_a_step_and_an_object_with_its_shadow_are_no_ripples():
    rng = np.random.default_rng(3)
    r = 20 + 0.05 * np.arange(200)
    step = np.where(r < 24, 1.0, 3.0) * np.ones((200, 1))
    thing = np.ones((200, 200))
    thing[80:110, 90:96] = 8.0
    thing[80:110, 96:130] = 0.05
    for floor in (step, thing):
        clip = clip_of(floor * rng.rayleigh(1.0, (200, 200)), r, 5.0, 0.05)
        assert estimate(clip, rng=1).quality is Quality.NO_RIPPLES


def test_a_prior_far_narrower_than_the_data_decides():
    clip = zare_cobb_clip(1.2, 13.4, 0.6, 0.07)
    prior = Prior((0.6, 0.08), (1e-6, 1e-6), ((0.05, 5), (0, 0.5)))
    posterior = estimate(clip, rng=1, prior=prior)
    assert abs(float(posterior.mean.height) - 0.08) < 5e-6
    assert abs(float(posterior.sd.height) / 1e-6 - 1) < 0.2


def test_shadow_is_left_out_where_none_can_fall():
    clip = zare_cobb_clip(1.2, 13.4, 0.6, 0.07)
    steep = RippleSettings(frequency=(0.3, 1.0), height=(0, 0.03))
    wide = estimate(clip, RippleSettings(), rng=1)
    assert LeftOut.SHADOW not in wide.left_out
    assert LeftOut.SHADOW in estimate(clip, steep, rng=1).left_out


ODD = {
    "zeros": (np.zeros((60, 60)), Quality.NO_RIPPLES),
    "one value": (np.full((60, 60), 3.0), Quality.NO_RIPPLES),
    "tiny": (np.ones((3, 3)), Quality.TOO_FEW_PIXELS),
    "all missing": (np.full((60, 60), np.nan), Quality.TOO_FEW_PIXELS),
    "one pixel lit": (np.eye(60) * (np.arange(60) == 7), Quality.NO_RIPPLES),
}


@pytest.mark.parametrize("method", ["default", "zare-cobb"])
@pytest.mark.parametrize("name", ODD)
def test_odd_clips_get_their_code_without_a_warning(name, method):
    amplitude, quality = ODD[name]
    clip = clip_of(amplitude, 20 + 0.05 * np.arange(amplitude.shape[1]), 5.0, 0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posterior = estimate(clip, RippleSettings(method=method), rng=1)
    if method == "default" or name != "one pixel lit":
        assert posterior.quality is quality


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_scale_of_amplitudes_does_not_matter(scale):
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07)
    scaled = Clip(**{**vars(clip), "amplitude": clip.amplitude * scale})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posterior = estimate(scaled, CREST, rng=1)
    assert abs(float(posterior.mean.height) - 0.07) < 1e-3


def test_ripples_survive_holes():
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07)
    rng = np.random.default_rng(1)
    amplitude = np.where(rng.random(clip.amplitude.shape) < 0.6, np.nan, clip.amplitude)
    amplitude[:, 200:230] = np.nan
    posterior = estimate(Clip(**{**vars(clip), "amplitude": amplitude}), CREST, rng=1)
    assert abs(float(posterior.mean.frequency) - 0.6) < 2e-3
    assert abs(float(posterior.mean.height) - 0.07) < 2e-3


def test_a_wave_too_long_for_the_clip_is_not_identifiable():
    clip = zare_cobb_clip(24.4, 28.4, 0.6, 0.07)  # 2.4 wavelengths
    assert estimate(clip, CREST, rng=1).quality is Quality.NOT_IDENTIFIABLE


@pytest.mark.parametrize("heading", [20, 75, 130, 200, 250, 340])
def test_ripples_are_found_from_any_direction_on_a_lattice_that_keeps_north_up(heading):
    scene = Scene(
        name="one",
        origin=(500000, 3300000),
        size=(12, 12),
        pixel_size=0.06,
        sediments=[{"name": "sand"}],
        ripples=[{"frequency": 0.9, "height": 0.04, "azimuth": 50 + heading}],
        passes=[
            {"name": "a", "heading": heading, "distance": 30, "altitude": 6, "dtype": "float32"}
        ],
    )
    made = simulate_clip(scene, np.random.default_rng(heading))
    posterior = estimate(made.clip, rng=1)
    assert posterior.quality is Quality.GOOD
    for name, truth in (("frequency", 0.9), ("height", 0.04)):
        assert abs(float(posterior.mean[name]) - truth) < 4 * float(posterior.sd[name])
    off = (posterior.azimuth[0] - 50 - heading + 90) % 180 - 90
    assert abs(off) < 4 * posterior.azimuth[1]
