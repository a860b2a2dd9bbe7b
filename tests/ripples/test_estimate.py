import warnings
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from sasmap.ripples import Clip, Prior, RippleSettings, estimate, estimation
from sasmap.ripples.errors import LAW_ERROR, THIRD_HARMONIC, slope_error, weighed, with_errors
from sasmap.ripples.optimise import OFFSET, PHASE, fisher_scoring
from sasmap.ripples.posterior import LeftOut, Quality, dataset
from sasmap.ripples.rendering import Parameters, line_of_lags, parameters_at, pulses_of
from tests.helpers import clip_of, zare_cobb_clip
from tests.ripples.engine import BINS, coherent, fit_of, noiseless
from tests.ripples.test_clip import turned

# fewer draws than by default: what is slow to converge is told well enough
DEFAULT = RippleSettings(draws=1500)
LAMBERT = RippleSettings(draws=1500, scattering="lambert")
BLURRED = {"frequency": 2.0, "blur": 1.6}
# (near, far, f, A_H) of Zare and Cobb's tables and their printed mean squared errors of f and A_H
TABLES = [
    (36.6, 48.2, 0.6, 0.07, 6e-6, 0.002),
    (24.4, 36.6, 0.5, 0.07, 3e-5, 0.303),
    (24.4, 36.6, 0.6, 0.09, 1e-5, 0.004),
]


@cache
def cell(seed, law="lambert", height=0.08, near=14.0, **changes):
    """A coherent clip; shared by the tests, which leave it as it is."""
    return coherent(seed, law, height, near=near, **changes)


@cache
def told(seed, law="lambert", height=0.08, near=14.0, settings=DEFAULT, rng=1, **changes):
    """Its posterior."""
    return estimate(cell(seed, law, height, near, **changes).clip, settings, rng=rng)


def altered(clip, **changes):
    return Clip(**{**vars(clip), **changes})


def mean_and_sd(posterior, name="height"):
    return float(posterior.mean[name]), float(posterior.sd[name])


def same(one, other, times=1.0, names=("frequency", "height")):
    """Whether two posteriors agree within so many of their standard deviations."""
    pairs = [(mean_and_sd(one, n), mean_and_sd(other, n)) for n in names]
    return all(abs(a[0] - b[0]) < times * max(a[1], b[1]) for a, b in pairs)


@pytest.mark.parametrize("near", [6.0, 14.0, 26.0])
@pytest.mark.parametrize("law", ["lambert", "rough", "gaussian"])
def test_truth_is_recovered_under_laws_that_are_not_told(law, near):
    made, posterior = cell(int(near), law, near=near), told(int(near), law, near=near)
    assert posterior.sampled
    assert posterior.probability > 0.99
    height, sd = mean_and_sd(posterior)
    assert abs(height - 0.08) < 4 * sd
    assert abs(height / 0.08 - 1) < 0.15
    frequency, sd = mean_and_sd(posterior, "frequency")
    assert abs(frequency - made.frequency) < 4 * sd
    assert sd < 2e-3
    off = (posterior.azimuth[0] - made.azimuth + 90) % 180 - 90
    assert abs(off) < 4 * posterior.azimuth[1]
    assert LeftOut.PHASE_FIELD in posterior.left_out


def test_law_is_learned_where_shadow_and_lean_break_the_tie():
    lambert, gaussian = told(6, "lambert", near=6.0), told(6, "gaussian", near=6.0)
    assert abs(float(lambert.mean.exponent) - 2.0) < 4 * float(lambert.sd.exponent)
    assert float(lambert.mean.exponent) > 1.2
    assert float(gaussian.mean.exponent) < 0.6
    assert float(gaussian.mean.concentration) > 0.4


def test_law_is_part_of_the_posterior_unless_it_is_fixed():
    free, fixed = told(14), told(14, settings=LAMBERT)
    for name in ("exponent", "concentration"):
        assert free.draws[name].dims == ("chain", "draw")
        assert float(free.sd[name]) > 0.02
        assert float(fixed.sd[name]) == 0
    assert float(fixed.mean.exponent) == 2
    assert float(fixed.mean.concentration) == 0
    other = told(14, settings=RippleSettings(draws=1500, scattering={"exponent": 1.5}))
    assert float(other.mean.exponent) == 1.5


def test_contrast_alone_leaves_height_open_until_the_law_is_known():
    free, fixed = (told(2, height=0.03, near=15.0, settings=s) for s in (DEFAULT, LAMBERT))
    mean, sd = mean_and_sd(free)
    assert sd / mean > 0.1
    assert abs(mean - 0.03) < 2 * sd
    mean, narrow = mean_and_sd(fixed)
    assert narrow < 0.25 * sd
    assert abs(mean - 0.03) < 4 * narrow
    # what is open is which law: the two go together
    tied = np.corrcoef(free.draws.exponent.values.ravel(), np.log(free.draws.height.values.ravel()))
    assert tied[0, 1] < -0.5


def test_a_law_taken_for_another_gives_another_height():
    wrong = told(
        2, height=0.03, near=15.0, settings=RippleSettings(draws=1500, scattering={"exponent": 1})
    )
    assert float(wrong.mean.height) > 1.5 * 0.03


def test_what_the_altitude_may_be_is_what_height_by_shadow_may_be():
    made = cell(26, near=26.0)
    sure, unsure = (
        estimate(altered(made.clip, altitude_sd=sd), LAMBERT, rng=1) for sd in (0.02, 0.8)
    )
    added = np.sqrt(float(unsure.sd.height) ** 2 - float(sure.sd.height) ** 2)
    relative = added / float(unsure.mean.height)
    assert relative == pytest.approx(float(unsure.sd.altitude_scale), rel=0.35)
    assert float(unsure.sd.altitude_scale) > 3 * float(sure.sd.altitude_scale)


def test_same_seed_same_draws_other_seed_same_answer():
    clip = cell(14).clip
    one, two, other = told(14), estimate(clip, DEFAULT, rng=1), estimate(clip, DEFAULT, rng=2)
    xr.testing.assert_identical(one.draws, two.draws)
    assert not one.draws.equals(other.draws)
    assert same(one, other, 0.3)
    assert one.quality is Quality.GOOD
    judged = ("frequency", "height")
    assert max(one.rhat[n] for n in judged) <= 1.01
    assert min(v[n] for v in (one.ess_bulk, one.ess_tail) for n in judged) >= 400


def test_every_parameter_has_a_name_and_a_unit():
    draws = told(14).draws
    names = {*Parameters._fields, "frequency", "azimuth"} - {"wave_offset"}
    assert set(draws.data_vars) == names
    assert draws.frequency.attrs["units"] == "cycles/m"
    assert draws.height.attrs["units"] == "m"
    assert float(draws.phase.min()) >= 0
    assert float(draws.phase.max()) < 2 * np.pi


def test_takes_arrays_as_well_as_clips():
    clip = cell(14).clip
    wide = {
        k: (("y", "x"), getattr(clip, k))
        for k in ("x", "y", "ground_range", "altitude", "look_azimuth")
    }
    array = xr.DataArray(clip.amplitude, dims=("y", "x"), coords=wide)
    posterior = estimate(array, DEFAULT, rng=1)
    assert posterior.draws.frequency.dims == ("chain", "draw")
    assert same(posterior, told(14), 0.5)
    quantiles = posterior.quantiles.height.values
    assert quantiles[0] < quantiles[1] < quantiles[2]


@pytest.mark.parametrize("degrees", [90, 215])
def test_answer_does_not_turn_with_the_map(degrees):
    posterior = estimate(turned(cell(14).clip, degrees), DEFAULT, rng=1)
    assert same(posterior, told(14), 0.5)
    off = (posterior.azimuth[0] - told(14).azimuth[0] - degrees + 90) % 180 - 90
    assert abs(off) < 0.5 * posterior.azimuth[1]


@pytest.mark.parametrize("off_look", [-50.0, 35.0])
def test_ripples_that_the_look_crosses_aslant(off_look):
    made = cell(7, near=12.0, azimuth_off_look=off_look)
    posterior = told(7, near=12.0, azimuth_off_look=off_look)
    for name, truth in (("frequency", made.frequency), ("height", 0.08)):
        mean, sd = mean_and_sd(posterior, name)
        assert abs(mean - truth) < 4 * sd
    assert abs(float(posterior.mean.height) / 0.08 - 1) < 0.25
    off = (posterior.azimuth[0] - made.azimuth + 90) % 180 - 90
    assert abs(off) < 4 * posterior.azimuth[1]


def test_an_image_whose_range_trend_was_taken_out_says_the_same():
    plain, flattened = (told(9, near=10.0, range_flattened=f) for f in (False, True))
    for name in ("frequency", "height"):
        (a, sd_a), (b, sd_b) = (mean_and_sd(p, name) for p in (plain, flattened))
        assert abs(a - b) < 2 * np.hypot(sd_a, sd_b)
    mean, sd = mean_and_sd(flattened)
    assert abs(mean - 0.08) < 4 * sd


@pytest.mark.parametrize("rule", ["crest", "line-of-sight"])
@pytest.mark.parametrize("entry", TABLES, ids=lambda e: f"{e[0]}-{e[1]}-f{e[2]}-A{e[3]}")
def test_beats_the_printed_errors(entry, rule):
    near, far, frequency, height, error_f, error_height = entry
    settings = RippleSettings(shadow=rule, scattering="zare-cobb")
    errors = []
    for seed in range(2):
        clip = zare_cobb_clip(near, far, frequency, height, rule, seed)
        mean = estimate(clip, settings, rng=seed).mean
        errors.append([float(mean.frequency) - frequency, float(mean.height) - height])
    f, h = (np.array(errors) ** 2).mean(axis=0)
    assert f < min(error_f, 1e-6)
    assert h < min(error_height, 5e-6)


@pytest.mark.parametrize("seed", [8, 10, 12])
def test_edges_of_long_shadows_lead_no_fit_astray(seed):
    # pixels of one phase fall on one column of the image, light or dark as a whole
    settings = RippleSettings(scattering="zare-cobb")
    clip = zare_cobb_clip(36.6, 48.2, 0.6, 0.07, "line-of-sight", seed)
    posterior = estimate(clip, settings, rng=seed)
    assert posterior.quality is Quality.GOOD
    assert float(posterior.mean.height) == pytest.approx(0.07, abs=1.5e-3)
    assert float(posterior.mean.frequency) == pytest.approx(0.6, abs=1.5e-3)
    assert float(posterior.sd.frequency) < 1e-3


@pytest.mark.parametrize("seed", range(6))
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
    clip = cell(14).clip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posterior = estimate(altered(clip, amplitude=clip.amplitude * scale), DEFAULT, rng=1)
    assert same(posterior, told(14), 0.5)


def test_ripples_survive_holes():
    clip = cell(14).clip
    rng = np.random.default_rng(1)
    amplitude = np.where(rng.random(clip.amplitude.shape) < 0.6, np.nan, clip.amplitude)
    amplitude[:, 100:125] = np.nan
    posterior = estimate(altered(clip, amplitude=amplitude), DEFAULT, rng=1)
    for name, truth in (("frequency", cell(14).frequency), ("height", 0.08)):
        mean, sd = mean_and_sd(posterior, name)
        assert abs(mean - truth) < 4 * sd
    assert abs(float(posterior.mean.height) / 0.08 - 1) < 0.15


@pytest.mark.parametrize("wander", [0.0, 0.6])
@pytest.mark.parametrize("patch", [np.s_[:110, :35], np.s_[150:240, 60:150]])
@pytest.mark.parametrize("seed", [1, 4])
def test_a_patch_without_ripples_leaves_height_by_shadow(seed, wander, patch):
    """Light in deep shadow at one place was taken for lower ripples of another profile."""
    height = 0.042
    deep = {"frequency": 1.17, "near": 39.7, "altitude": 3.35, "noise": -19.0}
    crests = {"wander": wander, "wander_length": 6.0, "range_flattened": True}
    clip = cell(seed, "gaussian", height, **deep, **crests).clip
    power = clip.amplitude**2
    bare = np.random.default_rng(1).exponential(0.4 * power.mean(), power.shape)
    power[patch] = np.maximum(bare, power)[patch]
    posterior = estimate(altered(clip, amplitude=np.sqrt(power)), DEFAULT, rng=1)
    mean, sd = mean_and_sd(posterior)
    assert abs(mean - height) < 2 * sd
    assert sd < 0.4 * height


def test_a_wave_too_long_for_the_clip_is_not_identifiable():
    clip = zare_cobb_clip(24.4, 28.4, 0.6, 0.07)  # 2.4 wavelengths
    assert estimate(clip, rng=1).quality is Quality.NOT_IDENTIFIABLE


def test_a_prior_far_narrower_than_the_data_decides():
    made = cell(6, near=6.0)
    free = told(6, near=6.0)
    sd = 0.1 * float(free.sd.height)
    prior = Prior((0.62, 0.084), (np.inf, sd), ((0.05, 5), (0, 0.5)))
    posterior = estimate(made.clip, DEFAULT, rng=1, prior=prior)
    assert abs(float(posterior.mean.height) - 0.084) < sd
    assert abs(float(posterior.sd.height) / sd - 1) < 0.2
    narrow = 0.1 * float(free.sd.frequency)
    prior = Prior((0.622, 0.08), (narrow, np.inf), ((0.05, 5), (0, 0.5)))
    posterior = estimate(made.clip, DEFAULT, rng=1, prior=prior)
    assert abs(float(posterior.mean.frequency) - 0.622) < 3 * narrow
    assert abs(float(posterior.sd.frequency) / narrow - 1) < 0.05


def test_bounds_of_height_hold():
    bounded = told(
        2, height=0.03, near=15.0, settings=RippleSettings(draws=1500, height=(0.0, 0.03))
    )
    assert float(bounded.draws.height.max()) <= 0.03
    assert float(bounded.mean.exponent) > float(told(2, height=0.03, near=15.0).mean.exponent)


def test_crests_that_cross_are_an_error_of_each_other():
    first = SimpleNamespace(energy=1.0)
    faint, strong = (SimpleNamespace(energy=e) for e in (0.01, 4.0))
    assert estimation._crossing(first, None) == 0.0
    assert 0 < estimation._crossing(first, faint) < estimation._crossing(first, strong)


def test_an_error_of_the_model_leaves_no_less_known_than_the_prior(monkeypatch):
    monkeypatch.setattr(estimation, "_height_error", lambda fit: 5.0)
    posterior = estimate(cell(6, near=6.0).clip, DEFAULT, rng=1)
    spread = float(np.log(posterior.draws.height).std())
    prior = posterior.prior.steepness[1]
    assert 0.6 * prior < spread < 0.9 * prior


def test_waves_of_unlike_heights_raise_and_widen_height(monkeypatch):
    # a model of one height is dark where a lower wave is lit, which a lower height makes up for
    made = cell(6)
    monkeypatch.setattr(estimation, "OF_WAVES", 0.0)  # acts on f by itself
    alike = estimate(made.clip, DEFAULT, rng=1)
    monkeypatch.setattr(estimation, "_unlike", lambda fit: 0.1)
    unlike = estimate(made.clip, DEFAULT, rng=1)
    ratio = np.log(unlike.draws.height).mean() - np.log(alike.draws.height).mean()
    assert 0.15 < float(ratio) < 0.25
    sd, known = (float(np.log(p.draws.height).std()) for p in (unlike, alike))
    assert sd == pytest.approx(np.hypot(0.2, known), rel=0.04)
    # shadow of higher crests turns the image's phase, so that f is another one
    moved, before = (p.draws.frequency for p in (unlike, alike))
    assert abs(float(moved.mean() - before.mean())) > float(before.std())
    assert float(moved.std()) > 1.5 * float(before.std())


def test_an_edge_of_the_ripples_widens_frequency():
    image = SimpleNamespace(pixel_size=0.025, valid=np.ones((500, 500), bool))
    geometry = SimpleNamespace(along=1.0, across=0.0)
    phase = SimpleNamespace(rigid=True)
    fit = SimpleNamespace(geometry=geometry, unlike=0.0, phase=phase)
    filled, half, third = (estimation._stretch(fit, image, f) for f in (0.98, 0.5, 0.3))
    assert filled == 0.0
    assert half == pytest.approx(estimation.EDGE_TURN / 6.25)
    assert third > half


@pytest.mark.parametrize("height", [0.08, 0.12])
def test_wave_number_errs_with_law_and_profile_by_as_much_as_it_states(height):
    """The image tells errors of law and profile together with its wave number."""
    rng = np.random.default_rng(3)
    plain = fit_of(8, np.ones((8, BINS)), height=height, noise=1e-3)
    plain = plain._replace(data=weighed(plain.data, np.full(plain.data.pixel_count.shape, 0.02)))
    tilt = slope_error(with_errors(plain), plain.data, 1e-6)
    truth, free = parameters_at(plain.z, plain.geometry), np.array([OFFSET, PHASE])
    off, stated = [], 0.0
    for _ in range(60):
        law, harmonic = (0.3 * np.array(sd) for sd in (LAW_ERROR, THIRD_HARMONIC))
        where = plain.geometry._replace(
            law_error=law * rng.standard_normal(law.size),
            third_harmonic=harmonic * rng.standard_normal(harmonic.size),
        )
        data = noiseless(truth, plain.data, where)
        pixels = data.pixel_count
        data = data._replace(intensity_sum=data.intensity_sum * rng.gamma(pixels, 1 / pixels))
        seen = with_errors(plain._replace(data=data, tilt=tilt))
        peak = fisher_scoring(plain.z, seen.data, seen.geometry, free=free)
        seen = with_errors(seen._replace(peaks=[peak]))
        slope, _, stated = estimation._slopes(np.tile(peak.z, (1, 5, 1)), seen)
        lags = pulses_of(truth, data, where)[1]
        off.append(float(slope.mean()) - line_of_lags(lags, data)[0] / (2 * np.pi))
    assert 0.8 < np.std(off) / stated < 1.25
    assert stated > 1.1 * tilt


@pytest.mark.parametrize("turn", [0.0, 50.0])
def test_a_point_spread_of_several_pixels_does_not_lower_height(turn):
    """It takes two thirds of the contrast of ripples ten pixels long; speckle tells its size."""
    posterior = told(2, height=0.02, settings=LAMBERT, **BLURRED, azimuth_off_look=turn)
    low, _, high = posterior.quantiles.height.values
    assert low < 0.02 < high
    assert abs(float(posterior.mean.height) / 0.02 - 1) < 0.25
    assert float(posterior.sd.height) < 0.3 * 0.02


def test_errors_added_to_draws_may_outweigh_what_chains_leave_open():
    rng = np.random.default_rng(1)
    image, azimuth = SimpleNamespace(azimuth=90.0), np.full((4, 1000), 95.0)
    open_ = rng.normal(size=(4, 1000)) + 0.5 * np.arange(4)[:, None]
    for height, quality in (
        (open_, Quality.NOT_CONVERGED),
        (open_ + 20 * rng.normal(size=open_.shape), Quality.GOOD),
    ):
        draws = dataset({"height": height, "azimuth": azimuth})
        assert estimation._judged(draws, False, image) is quality
        assert estimation._judged(draws, True, image) is Quality.GOOD
