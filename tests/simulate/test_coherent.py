import ast
import itertools
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from affine import Affine
from scipy import stats

import sasmap
from sasmap.errors import InputError
from sasmap.simulate import Scene, coherent_cell, load_scene, simulate
from sasmap.simulate.facets import HALO, _gamma, see_facets
from sasmap.simulate.image import record
from sasmap.simulate.laws import PowerLaw, backscatter
from sasmap.simulate.profiles import CrestProfile, crest
from sasmap.simulate.seafloor import SeaFloor
from sasmap.simulate.write import pass_raster

PACKAGE = Path(sasmap.__file__).parent
PIXEL = 0.05
PASS = {"name": "one", "heading": 0, "distance": 20, "dtype": "float32", "noise": None}
RIPPLES = {"frequency": 0.8, "height": 0.06, "azimuth": 90}
PLAIN = {
    "name": "test",
    "origin": (500000.0, 3300000.0),
    "size": (10.0, 8.0),
    "pixel_size": PIXEL,
    "physics": "coherent",
    "sediments": [{"name": "sand"}],
    "passes": [PASS],
}
LAWS = {  # written out once more
    "lambert": lambda t: np.sin(t) ** 2,
    "gaussian": lambda t: np.exp(-(3 / np.pi) * (t - np.pi / 2) ** 2),
    "uniform": lambda t: np.ones_like(t),
    "power": lambda t: np.sin(t) ** 1.2 * np.exp(-0.4 * (t - np.pi / 2) ** 2),
}
GIVEN = {
    "lambert": "lambert",
    "gaussian": "gaussian",
    "uniform": PowerLaw(exponent=0),
    "power": PowerLaw(exponent=1.2, concentration=0.4),
}


def scene_of(**changes):
    return Scene.model_validate({**PLAIN, **changes})


def tile_of(scene, which=None, seed=1, floor=None):
    raster = pass_raster(scene, scene.passes[0])
    top, left, rows, columns = which or (0, 0, raster.rows, raster.columns)
    transform = raster.transform @ Affine.translation(left, top)
    rng = np.random.default_rng(seed)
    return record(scene, floor or SeaFloor(scene), scene.passes[0], transform, (rows, columns), rng)


def cell(seed=1, **changes):
    given = {"frequency": 0.8, "height": 0.06, "noise": None, "pixel_size": PIXEL, **changes}
    return coherent_cell(np.random.default_rng(seed), **given).clip


def imported(path):
    """Modules of this package that a file imports anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] == "sasmap"}


def file_of(module):
    path = PACKAGE.joinpath(*module.split(".")[1:])
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


def test_simulator_and_estimator_share_nothing():
    waiting, seen = ["sasmap.simulate.coherent"], set()
    while waiting:
        module = waiting.pop()
        path = file_of(module)
        if module in seen or path is None or module == "sasmap":
            continue
        seen.add(module)
        waiting += imported(path)
    assert {"sasmap.simulate.facets", "sasmap.simulate.seafloor", "sasmap.simulate.scene"} <= seen
    assert not [module for module in seen if module.startswith("sasmap.ripples")]
    for path in (PACKAGE / "ripples").glob("*.py"):
        assert not [name for name in imported(path) if name.startswith("sasmap.simulate")], path


@pytest.mark.parametrize("law", LAWS)
def test_flat_floor_follows_the_law_over_range(law):
    clip = cell(height=0, law=GIVEN[law], near=6.0, shape=(800, 240))
    theta = np.arctan2(5.0, clip.ground_range[0])
    centre = np.arctan2(5.0, 6.0 + 119.5 * PIXEL)
    expected = LAWS[law](theta) / LAWS[law](centre)
    ratio = ((clip.amplitude**2).mean(axis=0) / expected).reshape(-1, 24).mean(axis=1)
    assert np.abs(ratio - 1).max() < 0.04
    assert abs(ratio.mean() - 1) < 0.01


@pytest.mark.parametrize("law", ["rough", "volume"])
def test_laws_outside_the_family(law):
    theta = np.linspace(0.01, np.pi / 2, 500)
    level = np.log(backscatter(law, theta))
    assert np.isfinite(level).all()
    # no sin^n exp(-c (theta - pi/2)^2) comes near
    design = np.column_stack([np.ones_like(theta), np.log(np.sin(theta)), (theta - np.pi / 2) ** 2])
    rest = level - design @ np.linalg.lstsq(design, level, rcond=None)[0]
    assert rest.std() > 0.1
    assert level[-1] > level[250] > level[50] or law == "volume"


def test_volume_scattering_falls_below_the_critical_angle():
    above, below = backscatter("volume", np.radians([35.0, 20.0]))
    assert above > 5 * below  # Lambert's law: 2.8


@pytest.mark.parametrize("blur", [0.4, 0.5, 1.0])
def test_speckle_is_developed_and_as_wide_as_the_point_spread(blur):
    clip = cell(height=0, law=PowerLaw(exponent=0), shape=(500, 500), blur=blur)
    power = clip.amplitude**2
    assert abs(power.mean() - 1) < 0.015
    assert abs(power.var() / power.mean() ** 2 - 1) < 0.03
    apart = int(np.ceil(6 * blur))
    assert stats.kstest(power[::apart, ::apart].ravel(), stats.expon.cdf).pvalue > 1e-3
    for step in (1, 2):
        expected = np.exp(-(step**2) / (4 * blur**2)) ** 2
        for one, other in ((power[step:], power[:-step]), (power[:, step:], power[:, :-step])):
            assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1] - expected) < 0.02


def test_texture_of_the_sediment():
    scene = scene_of(sediments=[{"name": "s", "nu": 1.5}], passes=[{**PASS, "distance": 200}])
    power = tile_of(scene).astype(float) ** 2
    assert abs(power.mean() - 1) < 0.05
    # the point spread function averages over neighbouring patches
    assert 1.2 < power.var() / power.mean() ** 2 < 1 + 2 / 1.5
    for nu in (0.4, 2.0):
        draws = [_gamma(np.uint64(k), nu) for k in range(4000)]
        assert stats.kstest(draws, stats.gamma(nu, scale=1 / nu).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"rotation": 30},
        {"heading": 200, "side": "port", "altitude": [6, 4]},
        {"range": "slant"},
    ],
)
def test_tiles_meet_without_a_seam(change):
    patch = {**RIPPLES, "wander": 1.0, "wander_length": 9.0, "forks": [[5, 4]], "azimuth": 70}
    mud = {"name": "mud", "nu": 2, "law": "volume", "polygon": [[3, 2], [8, 3], [5, 7]]}
    scene = scene_of(
        ripples=[{**patch, "profile": "stokes"}],
        sediments=[{"name": "sand"}, mud],
        passes=[{**PASS, "noise": -20, "distance": 12, **change}],
    )
    floor = SeaFloor(scene)
    whole = tile_of(scene, floor=floor)
    rows, columns = whole.shape
    parts = [
        tile_of(scene, (top, left, height, width), floor=floor)
        for top, height in ((0, 37), (37, rows - 37))
        for left, width in ((0, 91), (91, columns - 91))
    ]
    assert np.isfinite(whole).mean() > 0.15
    np.testing.assert_array_equal(np.block([parts[:2], parts[2:]]), whole)


def test_same_seed_same_bytes_and_a_survey_that_opens(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        scene = scene_of(
            seed=seed, size=(4.0, 3.0), ripples=[RIPPLES], passes=[{**PASS, "tile": 50}]
        )
        simulate(scene, tmp_path / name)
    tiles = [(tmp_path / n / "one" / "one_r0_c1.tif").read_bytes() for n in "abc"]
    assert tiles[0] == tiles[1] != tiles[2]
    assert "ripples: {}" in (tmp_path / "a" / "survey.yaml").read_text()
    array = sasmap.open_pass(sasmap.load_survey(tmp_path / "a" / "survey.yaml"), "one")
    assert np.isfinite(array.values).all()


@pytest.mark.parametrize("kind", ["ground", "slant"])
@pytest.mark.parametrize("sign", [1, -1])
def test_crests_lean_towards_the_sonar(kind, sign):
    # a bright stripe of floor, 5 cm wide, on a crest or in a trough
    altitude, height, place = 6.0, 0.25, 5.0
    stripe = [[place - 0.025, -1], [place + 0.025, -1], [place + 0.025, 9], [place - 0.025, 9]]
    ripple = {"frequency": 0.1, "height": height, "azimuth": 90, "phase": sign * np.pi / 2}
    scene = scene_of(
        size=(10.0, 8.0),
        sediments=[{"name": "sand"}, {"name": "wire", "level": 1e4, "polygon": stripe}],
        ripples=[ripple],
        passes=[{**PASS, "distance": 9.0, "altitude": altitude, "range": kind}],
    )
    power = np.nan_to_num(tile_of(scene).astype(float)) ** 2
    column = np.arange(power.shape[1]) + 0.5
    profile = power.mean(axis=0)
    near = np.abs(column - profile.argmax() - 0.5) < 6
    left = pass_raster(scene, scene.passes[0]).transform.c - scene.origin[0]
    seen = left + PIXEL * np.average(column[near], weights=profile[near])
    ground, slant = 9.0, np.hypot(9.0, altitude - sign * height)
    if kind == "slant":
        assert abs(seen + 4.0 - slant) < 0.25 * PIXEL
        return
    lean = seen + 4.0 - ground
    assert abs(lean - (np.sqrt(slant**2 - altitude**2) - ground)) < 0.25 * PIXEL
    assert abs(lean / (-sign * height * altitude / ground) - 1) < 0.1


def hidden_by_rays(profile, place, altitude):
    """Points of h(r) that a straight ray from the array does not reach, by looking along each."""
    result = np.zeros(place.size, bool)
    for k, r in enumerate(place):
        before = np.linspace(0.05 * r, r - 1e-6, 4000)
        ray = altitude + (profile(r) - altitude) * before / r
        result[k] = (profile(before) > ray + 1e-9).any()
    return result


def test_shadow_against_a_ray_tracer():
    altitude, step = 3.0, 0.02

    def floor(r):
        return 0.12 * np.sin(2 * np.pi * 0.7 * r) + 0.03 * np.sin(2 * np.pi * 1.9 * r)

    place = 15.0 + step * np.arange(400)
    hidden = hidden_by_rays(floor, place, altitude)
    wide = 11.0 + step * np.arange(-HALO, 600 + HALO)
    elevation = np.tile(floor(wide), (1 + 2 * HALO, 1))
    sine = see_facets(elevation, wide[HALO:-HALO], np.array([altitude]), (step, step), False)[0][0]
    assert 0.3 < hidden.mean() < 0.8
    assert ((sine[200:600] == 0) != hidden).mean() < 0.02  # one facet an edge
    # and in the image: dark where no lit floor is shown
    clip = cell(
        height=0.12, frequency=0.7, near=15, altitude=3.0, shape=(60, 200), phase=0, blur=0.3
    )
    fine = np.arange(14.0, 27.0, 0.01)
    middle = 15.0 + 99.5 * PIXEL

    def sine_floor(r):
        return 0.12 * np.sin(2 * np.pi * 0.7 * (r - middle))

    lit = fine[~hidden_by_rays(sine_floor, fine, altitude)]
    shown = np.sqrt(lit**2 + (altitude - sine_floor(lit)) ** 2 - altitude**2)
    count = np.histogram(shown, 15 - PIXEL / 2 + PIXEL * np.arange(201))[0]
    mean = (clip.amplitude**2).mean(axis=0)
    assert abs((mean < 0.02 * mean.max()).mean() - (count == 0).mean()) < 0.06


def expected_power(law, wave, height, phase, clip, blur, altitude):
    """Mean intensity by rays and histograms, for a sine: another way round than the renderer."""
    step = PIXEL / 40
    u = np.arange(clip.ground_range.min() - 3, clip.ground_range.max() + 3, step)
    x0, y0 = clip.x.mean(), clip.y.mean()
    shift = clip.x[0, 0] - clip.ground_range[0, 0]
    edges = np.append(clip.ground_range[0] - PIXEL / 2, clip.ground_range[0, -1] + PIXEL / 2)
    bins = np.concatenate([np.linspace(a, b, 9)[:-1] for a, b in itertools.pairwise(edges)])
    bins = np.append(bins, edges[-1])
    # intensity is spread by the squared point spread function
    reach = np.arange(-40, 41) * PIXEL / 8
    spread = np.exp(-(reach**2) / (blur * PIXEL) ** 2)
    spread /= spread.sum()
    result = np.empty(clip.amplitude.shape)
    for i, y in enumerate(clip.y[:, 0]):
        angle = 2 * np.pi * (wave[0] * (u + shift - x0) + wave[1] * (y - y0)) + phase
        h = height * np.sin(angle)
        slope = 2 * np.pi * height * np.cos(angle)[:, None] * wave
        normal = np.column_stack([-slope, np.ones(u.size)])
        area = np.linalg.norm(normal, axis=1)
        ray = np.column_stack([u, np.zeros(u.size), h - altitude])
        sine = -(ray * normal).sum(axis=1) / (np.linalg.norm(ray, axis=1) * area)
        elevation = np.arctan2(h - altitude, u)
        lit = (elevation >= np.maximum.accumulate(elevation)) & (sine > 0)
        power = np.where(lit, law(np.arcsin(np.clip(sine, 1e-9, 1))) * area, 0) * step
        shown = np.sqrt(np.maximum(u**2 + (altitude - h) ** 2 - altitude**2, 0))
        density = np.histogram(shown, bins, weights=power)[0] / (PIXEL / 8)
        density = np.convolve(density, spread, mode="same")
        result[i] = 0.5 * (density[3::8] + density[4::8])
    return result


@pytest.mark.parametrize(
    ("law", "height", "near", "off"),
    [
        ("lambert", 0.06, 10.0, 0.0),
        ("lambert", 0.06, 6.0, 40.0),
        ("gaussian", 0.1, 20.0, 25.0),
        ("uniform", 0.1, 5.0, 0.0),
        ("power", 0.12, 12.0, -60.0),
    ],
)
def test_slopes_brighten_by_law_area_and_foreshortening(law, height, near, off):
    clip = cell(height=height, near=near, azimuth_off_look=off, law=GIVEN[law], phase=0.7,
                shape=(360, 200))  # fmt: skip
    turn = np.radians(90 + off)
    wave = 0.8 * np.array([np.sin(turn), np.cos(turn)])
    rows = slice(None) if off else slice(0, 1)
    one = type(clip)(*(getattr(clip, n)[rows] for n in ("amplitude", "x", "y", "ground_range",
                     "altitude", "look_azimuth")), PIXEL)  # fmt: skip
    one.y[...] += 0 if off else clip.y.mean() - one.y.mean()
    expected = expected_power(LAWS[law], wave, height, 0.7, one, 0.5, 5.0)
    expected = expected + np.zeros(clip.amplitude.shape)
    expected /= LAWS[law](np.arctan2(5.0, near + 99.5 * PIXEL))
    power = clip.amplitude**2
    angle = 2 * np.pi * (wave[0] * (clip.x - clip.x.mean()) + wave[1] * (clip.y - clip.y.mean()))
    inner = (np.abs(np.arange(200) - 99.5) < 90)[None, :] & np.ones((360, 1), bool)
    which = np.floor((angle + 0.7) / (2 * np.pi) * 24).astype(int) % 24
    seen, should = (np.bincount(which[inner], v[inner], 24) for v in (power, expected))
    pixels = np.bincount(which[inner], minlength=24)
    noise = 1.3 * should / np.sqrt(pixels / 1.7) + 0.004 * should.max()
    assert should.max() > 1.5 * should.min()
    assert np.abs((seen - should) / noise).max() < 4.5
    assert abs(seen.sum() / should.sum() - 1) < 0.015


def test_range_flattened_removes_the_mean_trend():
    for noise in (None, -10.0):
        clip = cell(height=0, near=8.0, shape=(500, 300), noise=noise, range_flattened=True)
        mean = (clip.amplitude**2).mean(axis=0).reshape(-1, 30).mean(axis=1)
        assert np.abs(mean - 1).max() < 0.05


def test_receiver_noise_stays_in_the_shadow():
    clip = cell(height=0.12, near=45, noise=-20.0)
    dark = cell(height=0.12, near=45).amplitude ** 2 < 1e-8
    assert dark.mean() > 0.2
    assert abs((clip.amplitude[dark] ** 2).mean() / 0.01 - 1) < 0.05


def test_profiles_are_two_heights_tall():
    phase = np.linspace(0, 2 * np.pi, 20001)
    for name in set(get_args(CrestProfile)) - {"stokes"}:
        assert abs(np.ptp(crest(phase, 0.5, name, 0.35)) - 2) < 1e-6
    assert abs(crest(np.pi / 2, 0.5, "stokes") - crest(-np.pi / 2, 0.5, "stokes") - 2) < 1e-12
    slope = np.gradient(crest(phase, 0.5, "asymmetric", 0.35), phase)
    assert abs(slope.max() / -slope.min() - 1) > 0.2
    # steep towards the sonar or away from it: not the same image
    one, other = (
        (cell(profile="asymmetric", azimuth_off_look=off, near=10).amplitude ** 2).var()
        for off in (0, 180)
    )
    assert one > 1.2 * other


def test_truth_of_a_cell():
    told = coherent_cell(
        np.random.default_rng(2),
        frequency=0.7,
        height=0.05,
        azimuth_off_look=20,
        wander=0.5,
        forks=1,
    )
    assert abs(told.frequency - 0.7) < 0.1
    assert abs((told.azimuth - 110 + 90) % 180 - 90) < 10
    assert told.clip.amplitude.shape == (200, 200)
    assert abs(told.clip.ground_range[0, 0] - 20) < 1e-9


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"law": "lambert"}, "law"),
        ({"ripples": [{**RIPPLES, "profile": "asymmetric"}]}, "ripples.profile"),
        ({"passes": [{**PASS, "range_flattened": True}]}, "passes.range_flattened"),
        ({"physics": "coherent", "shadow": "crest"}, "shadow"),
        ({"physics": "coherent", "passes": [{**PASS, "correlation": 1}]}, "passes.correlation"),
        ({"physics": "coherent", "sediments": [{"name": "s", "kappa": 1}]}, "sediments.kappa"),
    ],
)
def test_keys_of_the_other_physics_are_refused(change, key):
    with pytest.raises(ValueError, match=f"{key}: this value needs physics"):
        scene_of(**{"physics": "published", **change})


def test_an_unknown_law_is_refused_in_words(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(
        "name: x\norigin: [0, 0]\nsize: [5, 5]\npixel_size: 0.05\n"
        "physics: coherent\nlaw: lambertian\n"
        "sediments: [{name: s}]\npasses: [{name: p, heading: 0, distance: 20}]\n"
    )
    with pytest.raises(InputError, match="law: expected"):
        load_scene(path)
