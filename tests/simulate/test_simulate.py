import json

import numpy as np
import pytest
import rasterio
from scipy import stats

import sasmap
from sasmap.errors import InputError
from sasmap.simulate import Scene, load_scene, simulate
from sasmap.simulate.image import record, scattering, track_line
from sasmap.simulate.seafloor import SeaFloor, edge_distance, in_polygon
from sasmap.simulate.write import pass_raster

PLAIN = {
    "name": "test",
    "origin": (500000.0, 3300000.0),
    "size": (10.0, 8.0),
    "pixel_size": 0.05,
    "physics": "published",
    "sediments": [{"name": "sand"}],
    "passes": [{"name": "one", "heading": 0, "distance": 20, "dtype": "float32", "noise": None}],
}
RIPPLES = {"frequency": 0.8, "height": 0.06, "azimuth": 90}


def scene_of(**changes):
    return Scene.model_validate({**PLAIN, **changes})


def one_pass(**changes):
    return [{**PLAIN["passes"][0], **changes}]


def tile_of(scene, seed=1):
    whole = pass_raster(scene, scene.passes[0])
    floor = SeaFloor(scene)
    rng = np.random.default_rng(seed)
    return record(scene, floor, scene.passes[0], whole.transform, (whole.rows, whole.columns), rng)


def noiseless(scene, transform=None):
    """A* of the first pass over its whole raster."""
    whole = pass_raster(scene, scene.passes[0])
    t = transform or whole.transform
    column, row = np.meshgrid(np.arange(whole.columns) + 0.5, np.arange(whole.rows) + 0.5)
    x, y = t.c + t.a * column + t.b * row, t.f + t.d * column + t.e * row
    line = track_line(scene, scene.passes[0])
    return scattering(scene, SeaFloor(scene), line, x, y, line.see(x, y), scene.pixel_size)


def test_rayleigh_speckle_of_a_flat_floor():
    values = tile_of(scene_of()).astype(float)
    power = (values / noiseless(scene_of())) ** 2
    assert stats.kstest(power.ravel()[::7], stats.expon.cdf).pvalue > 1e-3


@pytest.mark.parametrize(("nu", "kappa"), [(2.0, 0.0), (float("inf"), 1.5), (4.0, 1.0)])
def test_texture_and_steady_part_keep_the_mean_square(nu, kappa):
    scene = scene_of(sediments=[{"name": "s", "nu": nu, "kappa": kappa}])
    power = (tile_of(scene).astype(float) / noiseless(scene)) ** 2
    assert abs(power.mean() - 1) < 0.03
    # E[y^2] of docs/science.md: gamma texture z, x | z Rice of drift z kappa and scatter z
    a2 = 1 / (1 + kappa**2 * (1 + 1 / nu))
    z2, z3, z4 = (
        (1 + 1 / nu),
        (1 + 1 / nu) * (1 + 2 / nu),
        (1 + 1 / nu) * (1 + 2 / nu) * (1 + 3 / nu),
    )
    expected = a2**2 * (2 * z2 + 4 * kappa**2 * z3 + kappa**4 * z4)
    assert abs((power**2).mean() / expected - 1) < 0.12


def test_correlated_speckle_keeps_its_law_and_gains_a_correlation():
    scene = scene_of(passes=one_pass(correlation=1.5))
    power = (tile_of(scene).astype(float) / noiseless(scene)) ** 2
    assert abs(power.mean() - 1) < 0.05
    assert abs(power.var() - 1) < 0.15
    shifted = np.corrcoef(power[:, :-1].ravel(), power[:, 1:].ravel())[0, 1]
    # Gaussian field: squared correlation of the field, exp(-1 / (4 l^2)) at one pixel
    assert abs(shifted - np.exp(-1 / (4 * 1.5**2)) ** 2) < 0.05


def test_receiver_noise_fills_the_shadow():
    scene = scene_of(ripples=[{**RIPPLES, "height": 0.12}], passes=one_pass(noise=-20, distance=60))
    shadow = noiseless(scene) == 0
    assert 0.3 < shadow.mean() < 0.9
    power = tile_of(scene).astype(float)[shadow] ** 2
    assert abs(power.mean() - 0.01) < 0.001


def test_the_same_floor_seen_from_both_ends():
    # facets that face one sonar turn from the other: bright and dark change places
    near = scene_of(ripples=[RIPPLES], size=(10.0, 2.0), passes=one_pass(altitude=20))
    back = scene_of(ripples=[RIPPLES], size=(10.0, 2.0), passes=one_pass(altitude=20, heading=180))
    one, other = noiseless(near)[20], noiseless(back)[20]
    middle = slice(60, 140)
    assert np.corrcoef(one[middle], other[middle])[0, 1] < -0.9


def test_along_the_crests_there_is_no_contrast():
    scene = scene_of(ripples=[{**RIPPLES, "azimuth": 0}], passes=one_pass(altitude=15))
    flat = noiseless(scene_of(passes=one_pass(altitude=15)))
    np.testing.assert_allclose(noiseless(scene), flat, rtol=1e-6)


def test_truth_follows_the_wander_and_forks():
    patch = {**RIPPLES, "wander": 1.0, "wander_length": 4.0, "forks": [[5, 4]]}
    floor = SeaFloor(scene_of(ripples=[patch]))
    x, y = np.meshgrid(500000 + np.linspace(0.5, 9.5, 181), 3300000 + np.linspace(0.5, 7.5, 141))
    waves = floor.waves(x, y)
    away = np.hypot(x - 500005, y - 3300004) > 1.5
    turn = np.angle(np.exp(1j * np.diff(waves.phase, axis=1)))[1:-1, 1:] / (2 * np.pi * 0.05)
    inside = away[1:-1, 1:-1]
    middle = 0.5 * (turn[:, 1:] + turn[:, :-1]) if turn.shape[1] > 179 else turn
    np.testing.assert_allclose(
        middle[:, : inside.shape[1]][inside], waves.east[1:-1, 1:-1][inside], atol=0.05
    )
    ring = np.linspace(0, 2 * np.pi, 400)
    phase = floor.waves(500005 + 2 * np.cos(ring), 3300004 + 2 * np.sin(ring)).phase
    winding = np.angle(np.exp(1j * np.diff(phase))).sum()
    assert abs(winding - 2 * np.pi) < 1e-6  # one crest more on one side than on the other


def test_bends_leave_the_crests_around_them_as_they_are():
    bends = [[4, 2], [9, 2], [9, 7], [4, 7]]
    bent = {"wander": 0.9, "wander_length": 2.0, "forks": [[6, 4], [7, 5]], "bends": bends}
    plain = SeaFloor(scene_of(ripples=[RIPPLES]))
    floor = SeaFloor(scene_of(ripples=[{**RIPPLES, **bent}]))
    x, y = np.meshgrid(500000 + np.linspace(0.5, 9.5, 181), 3300000 + np.linspace(0.5, 7.5, 141))
    outline = np.add(bends, (500000.0, 3300000.0))
    inside = in_polygon(x, y, outline) | (edge_distance(x, y, outline) < 0.01)
    was, now = plain.waves(x, y), floor.waves(x, y)
    for a, b in zip(was, now, strict=True):
        np.testing.assert_array_equal(a[~inside], b[~inside])
    # crests go on across the edge: the sea floor has no step there
    assert np.abs(np.diff(floor.surface(x, y), axis=0)).max() < 0.02
    turn = np.angle(np.exp(1j * (now.phase - was.phase)))
    assert np.abs(turn[inside]).max() > 1.0
    # the wave vector is the phase's gradient, but at forks and where two edges are as near
    step = 1e-4
    east = np.angle(np.exp(1j * (floor.waves(x + step, y).phase - now.phase))) / (2 * np.pi * step)
    away = np.min([np.hypot(x - 500000 - a, y - 3300000 - b) for a, b in bent["forks"]], 0) > 1.5
    assert np.mean(np.abs(east - now.east)[away] < 0.05) > 0.99


def test_bends_with_an_end_need_pairs_of_forks():
    with pytest.raises(ValueError, match="pairs"):
        scene_of(ripples=[{**RIPPLES, "forks": [[5, 4]], "bends": [[4, 2], [9, 2], [9, 7]]}])


def test_added_ripples_cross_those_beneath(tmp_path):
    crossing = {"frequency": 1.1, "height": 0.02, "azimuth": 30, "added": True}
    one, other = (
        scene_of(ripples=[RIPPLES]),
        scene_of(physics="coherent", ripples=[{**crossing, "added": False}]),
    )
    scene = scene_of(physics="coherent", ripples=[RIPPLES, crossing])
    x, y = 500000 + np.linspace(1, 9, 50), 3300000 + np.linspace(1, 7, 50)
    floor = SeaFloor(scene)
    parts = SeaFloor(one).surface(x, y) + SeaFloor(other).surface(x, y)
    np.testing.assert_allclose(floor.surface(x, y), parts, atol=1e-12)
    assert np.abs(parts).max() <= floor.relief
    np.testing.assert_allclose(floor.waves(x, y).height, RIPPLES["height"])
    np.testing.assert_allclose(floor.second(x, y).height, 0.02)
    simulate(scene, tmp_path)
    with rasterio.open(tmp_path / "truth" / "ripple_frequency_second.tif") as truth:
        np.testing.assert_allclose(truth.read(1), 1.1, rtol=1e-6)
    with pytest.raises(ValueError, match=r"ripples.added: this value needs physics: coherent"):
        scene_of(ripples=[RIPPLES, crossing])


def test_patches_fade_at_their_edge():
    square = [[2, 2], [8, 2], [8, 6], [2, 6]]
    floor = SeaFloor(scene_of(ripples=[{**RIPPLES, "polygon": square}]))
    x = 500000 + np.linspace(0, 10, 1001)
    height = floor.waves(x, np.full(1001, 3300004.0)).height
    assert height[0] == 0
    assert abs(height[500] - 0.06) < 1e-12
    assert np.abs(np.diff(height)).max() < 0.002


def test_polygons():
    square = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
    x, y = np.array([1.0, 5.0, 2.0]), np.array([1.0, 1.0, 6.0])
    assert in_polygon(x, y, square).tolist() == [True, False, False]
    np.testing.assert_allclose(edge_distance(x, y, square), [1, 1, 2])


@pytest.mark.parametrize(
    "change",
    [
        {"rotation": 30},
        {"pixel_size": 0.1},
        {"side": "port", "heading": 180},
        {"range": "slant"},
        {"positions": "geographic"},
        {"altitude": [7, 3]},
        {"tile": 64},
        {"dtype": "uint16", "noise": -30},
    ],
)
def test_the_written_survey_puts_every_pixel_where_it_was_seen(tmp_path, change):
    scene = scene_of(
        ripples=[{**RIPPLES, "height": 0.03}], passes=one_pass(**change), size=(6.0, 5.0)
    )
    simulate(scene, tmp_path)
    array = sasmap.open_pass(sasmap.load_survey(tmp_path / "survey.yaml"), "one").compute()
    line = track_line(scene, scene.passes[0])
    x = array.coords.get("ground_x", array.x).broadcast_like(array).values
    y = array.coords.get("ground_y", array.y).broadcast_like(array).values
    seen = np.isfinite(array.values)
    assert seen.sum() > 0.9 * 6.0 * 5.0 / (scene.passes[0].pixel_size or 0.05) ** 2 * (
        0.8 if scene.passes[0].range == "slant" else 1.0
    )
    view = line.see(x[seen], y[seen])
    np.testing.assert_allclose(array.ground_range.values[seen], view.ground_range, atol=2e-3)
    np.testing.assert_allclose(array.altitude.values[seen], view.altitude, atol=2e-3)
    look = np.degrees(np.arctan2(*line.look)) % 360
    np.testing.assert_allclose(array.look_azimuth.values[seen], look, atol=0.02)
    model = scattering(scene, SeaFloor(scene), line, x[seen], y[seen], view, scene.pixel_size)
    # pixel by pixel the amplitudes are the model's times speckle
    ratio = array.values[seen].astype(float) ** 2 / np.maximum(model, 1e-9) ** 2
    lit = model > 0.3
    whole = np.average(ratio[lit])
    bright = lit & (model > np.median(model[lit]))
    assert abs(ratio[bright].mean() / whole - 1) < 0.1


def test_truth_files_and_boundaries(tmp_path):
    scene = scene_of(
        ripples=[RIPPLES],
        sediments=[
            {"name": "sand"},
            {"name": "mud", "polygon": [[5, -1], [11, -1], [11, 9], [5, 9]]},
            {"name": "rock", "polygon": [[6, 3], [8, 3], [8, 5], [6, 5]]},
        ],
    )
    simulate(scene, tmp_path)
    with rasterio.open(tmp_path / "truth" / "sediment_class.tif") as source:
        assert set(np.unique(source.read(1))) == {1, 2, 3}
        assert source.colormap(1)[1] != source.colormap(1)[2]
    with rasterio.open(tmp_path / "truth" / "ripple_height.tif") as source:
        np.testing.assert_allclose(source.read(1), 0.06)
        assert source.units == ("m",)
    lines = json.loads((tmp_path / "truth" / "boundaries.geojson").read_text())["features"]
    found = {
        (f["properties"]["left"], f["properties"]["right"]): np.subtract(
            f["geometry"]["coordinates"], (500000, 3300000)
        )
        for f in lines
    }
    # of the mud only its western edge lies in the scene; the rock lies in the mud
    assert len(lines) == 2
    assert set(found) == {("mud", "sand"), ("rock", "mud")}
    edge, outline = found["mud", "sand"], found["rock", "mud"]
    np.testing.assert_allclose(edge[:, 0], 5, atol=1e-3)
    np.testing.assert_allclose(np.sort(edge[[0, -1], 1]), (0, 8), atol=0.06)
    np.testing.assert_allclose(outline[0], outline[-1], atol=1e-3)
    length = np.hypot(*np.diff(outline, axis=0).T).sum()
    assert length == pytest.approx(8, abs=0.01)
    assert ((outline >= (6 - 1e-3, 3 - 1e-3)) & (outline <= (8 + 1e-3, 5 + 1e-3))).all()


def test_same_scene_same_bytes_other_seed_other_speckle(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulate(scene_of(seed=seed), tmp_path / name)
    tiles = [(tmp_path / n / "one" / "one_r0_c0.tif").read_bytes() for n in "abc"]
    assert tiles[0] == tiles[1] != tiles[2]
    assert not (tmp_path / "a" / ".sasmap-simulate").exists()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("crs: EPSG:4326\n", "expected a projected CRS"),
        ("pixel_size: -1\n", "pixel_size"),
        ("ripple: []\n", "unknown key; did you mean 'ripples'?"),
    ],
)
def test_scene_faults_name_file_and_key(tmp_path, text, says):
    base = {k: v for k, v in PLAIN.items() if k not in text}
    path = tmp_path / "scene.yaml"
    path.write_text(text + "\n".join(f"{k}: {json.dumps(v)}" for k, v in base.items()))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert any(says in fault and str(path) in fault for fault in caught.value.faults)


def test_a_survey_is_no_scene(tmp_path):
    path = tmp_path / "survey.yaml"
    path.write_text("output: out\npasses: []\n")
    with pytest.raises(InputError, match="expected a scene to simulate, got a survey") as caught:
        load_scene(path)
    assert len(caught.value.faults) == 1


def test_a_smaller_scene_leaves_no_tiles_of_the_larger_one(tmp_path):
    simulate(scene_of(passes=one_pass(tile=64)), tmp_path)
    (tmp_path / ".sasmap-simulate").mkdir()
    (tmp_path / ".sasmap-simulate" / "x.part").touch()  # of a run that was killed
    simulate(scene_of(passes=one_pass(tile=2000)), tmp_path)
    assert [p.name for p in (tmp_path / "one").iterdir()] == ["one_r0_c0.tif"]


def test_a_pass_that_sees_nothing_is_refused(tmp_path):
    scene = scene_of(passes=one_pass(area=[[50, 50], [60, 50], [60, 60]]))
    with pytest.raises(InputError, match="does not see"):
        simulate(scene, tmp_path)


@pytest.mark.parametrize("name", ["a[1]", "out", "truth", "a/b", ".x"])
def test_names_that_could_not_be_run_are_refused(name):
    with pytest.raises(ValueError, match="passes"):
        scene_of(passes=one_pass(name=name))


def test_slant_range_is_as_good_as_ground_range(tmp_path):
    for kind in ("ground", "slant"):
        scene = scene_of(ripples=[RIPPLES], size=(10.0, 8.0), passes=one_pass(range=kind))
        simulate(scene, tmp_path / kind)
        survey = sasmap.load_survey(tmp_path / kind / "survey.yaml")
        settings = sasmap.ripples.RippleSettings(scattering="zare-cobb")  # what simulated it
        posterior = sasmap.ripples.estimate(sasmap.open_pass(survey, "one"), settings, rng=1)
        # 13 pixels per wavelength: A_H by line of sight is 4 % high, of either kind of tile
        assert float(posterior.mean.frequency) == pytest.approx(0.8, rel=0.005)
        assert float(posterior.mean.height) == pytest.approx(0.06, rel=0.06)
