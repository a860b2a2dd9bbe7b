"""Surveys whose sediments are known: named classes, and another survey's."""

import json

import numpy as np
import pyogrio
import pytest
import rasterio
import yaml

import sasmap
from sasmap.cli import main
from sasmap.errors import InputError
from sasmap.run.pipeline import run_survey
from sasmap.run.plan import make_plan

SCENE = {
    "name": "two floors",
    "seed": 3,
    "origin": [500000, 3300000],
    "size": [16, 12],
    "pixel_size": 0.05,
    "window": 80,
    "sediments": [
        {"name": "mud", "level": 0.4},
        {"name": "sand", "level": 1.0, "polygon": [[8, -1], [7, 5], [9, 13], [17, 13], [17, -1]]},
    ],
    "passes": [{"name": "one", "heading": 90, "distance": 30, "altitude": 6, "gain": 60}],
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A survey of mud in the west and sand in the east, without ripples."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.yaml").write_text(yaml.safe_dump(SCENE))
    assert main(["simulate", str(folder / "scene.yaml"), "--output", str(folder)]) == 0
    for name, x in (("mud", 500002), ("sand", 500012)):
        ring = [[x, 3300002], [x + 3, 3300002], [x + 3, 3300009], [x, 3300009], [x, 3300002]]
        shape = {"type": "Polygon", "coordinates": [ring]}
        shape["crs"] = {"type": "name", "properties": {"name": "EPSG:32617"}}
        (folder / f"{name}.geojson").write_text(json.dumps(shape))
    return folder


def survey_of(scene, **sediments):
    content = yaml.safe_load((scene / "survey.yaml").read_text())
    del content["ripples"]
    content["sediments"] = sediments
    path = scene / f"{'_'.join(sediments) or 'plain'}.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def run(path, output):
    outcome = run_survey(sasmap.load_survey(path), output=output, workers=2)
    with rasterio.open(output / "sediment_class.tif") as source:
        return outcome, source.read(1)


def test_named_classes_are_mapped_and_reused(scene, tmp_path):
    # the brighter one first: numbers follow the list, not the intensity
    named = [{"name": n, "training": f"{n}.geojson"} for n in ("sand", "mud")]
    outcome, label = run(survey_of(scene, classes=named), tmp_path / "a")
    assert [c["name"] for c in outcome.sediments] == ["sand", "mud"]
    x = np.arange(label.shape[1]) * 0.05
    assert (label[:, x < 6.5] == 2).mean() > 0.99
    assert (label[:, x > 9.5] == 1).mean() > 0.99
    text = (tmp_path / "a" / "sediment_class.tif.aux.xml").read_text()
    assert "<Category>sand</Category>" in text
    model = tmp_path / "a" / "sediment_classes.json"
    again, reused = run(survey_of(scene, model=str(model)), tmp_path / "b")
    assert [c["name"] for c in again.sediments] == ["sand", "mud"]
    assert (reused == label).mean() > 0.995


def test_classes_are_named_merged_and_coded_by_an_edited_model(scene, tmp_path):
    _, before = run(survey_of(scene, classes=2), tmp_path / "a")
    model = json.loads((tmp_path / "a" / "sediment_classes.json").read_text())
    model["classes"][0] |= {"name": "silt", "code": "A5.3"}
    model["classes"][1] |= {"name": "fine sand", "code": "A5.2"}
    path = tmp_path / "edited.json"
    path.write_text(json.dumps(model))
    outcome, after = run(survey_of(scene, model=str(path)), tmp_path / "b")
    assert [c["name"] for c in outcome.sediments] == ["silt", "fine sand"]
    assert (after == before).mean() > 0.995
    meta, _, _, fields = pyogrio.raw.read(tmp_path / "b" / "sediment_areas.gpkg")
    columns = dict(zip(meta["fields"], fields, strict=True))
    assert dict(zip(columns["name"], columns["code"], strict=True)) == {
        "silt": "A5.3",
        "fine sand": "A5.2",
    }
    kept = json.loads((tmp_path / "b" / "sediment_classes.json").read_text())
    assert [c["code"] for c in kept["classes"]] == ["A5.3", "A5.2"]
    model["classes"][1]["name"] = "silt"
    path.write_text(json.dumps(model))
    outcome, after = run(survey_of(scene, model=str(path)), tmp_path / "c")
    assert [c["name"] for c in outcome.sediments] == ["silt"]
    assert (after == 1).all()
    assert pyogrio.raw.read(tmp_path / "c" / "sediment_boundaries.gpkg")[2].size == 0
    # its own model makes the same map of the same tiles: no law is lost
    written = tmp_path / "c" / "sediment_classes.json"
    assert len(json.loads(written.read_text())["classes"]) == 2
    _, again = run(survey_of(scene, model=str(written)), tmp_path / "d")
    np.testing.assert_array_equal(again, after)


def test_another_least_area_is_another_map_and_leaves_no_line_where_nothing_is_parted(tmp_path):
    spotted = {
        **SCENE,
        "sediments": [
            *SCENE["sediments"],
            {"name": "spot", "level": 0.4, "polygon": [[12, 5], [14, 5], [14, 7], [12, 7]]},
        ],
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(spotted))
    assert main(["simulate", str(tmp_path / "scene.yaml"), "--output", str(tmp_path)]) == 0
    found = []
    for least in (0.5, 12.0):
        _, label = run(survey_of(tmp_path, classes=2, least_area=least), tmp_path / "out")
        lines = pyogrio.raw.read(tmp_path / "out" / "sediment_boundaries.gpkg")[2].size
        found.append((float((label[100:140, 240:280] == 1).mean()), lines))
    assert found[0] == (pytest.approx(1.0, abs=0.1), 2)
    assert found[1] == (0.0, 1)


def test_the_map_does_not_know_the_window_and_ripples_are_no_sediment(tmp_path):
    rippled = {
        **SCENE,
        "size": [40, 25],
        "ripples": [{"frequency": 0.7, "height": 0.05, "azimuth": 70}],
        "sediments": [
            {"name": "sand", "level": 1.0},
            {
                "name": "mud",
                "level": 0.3,
                "polygon": [[24, -1], [28, 12], [25, 26], [41, 26], [41, -1]],
            },
        ],
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(rippled))
    assert main(["simulate", str(tmp_path / "scene.yaml"), "--output", str(tmp_path)]) == 0
    labels = []
    for window in (80, 133):
        content = yaml.safe_load((tmp_path / "survey.yaml").read_text())
        del content["ripples"]
        content |= {"sediments": {}, "window": window}
        path = tmp_path / f"survey_{window}.yaml"
        path.write_text(yaml.safe_dump(content))
        outcome, label = run(path, tmp_path / str(window))
        assert len(outcome.sediments) == 2
        labels.append(label[:500, :800])
    assert (labels[0] > 0).all()
    assert (labels[0] == labels[1]).mean() > 0.99
    x = np.arange(800) * 0.05
    assert (labels[0][:, x < 22] == 2).mean() > 0.98
    assert (labels[0][:, x > 30] == 1).mean() > 0.98


def test_an_unchanged_map_is_kept_and_a_changed_one_made_anew(scene, tmp_path):
    path = survey_of(scene, classes=2)
    run(path, tmp_path)
    products = {p.name: p.stat().st_mtime_ns for p in tmp_path.glob("sediment*.[tg]*")}
    outcome, _ = run(path, tmp_path)
    assert len(outcome.sediments) == 2
    assert {p.name: p.stat().st_mtime_ns for p in tmp_path.glob("sediment*.[tg]*")} == products
    (tmp_path / "sediment_class.tif").write_bytes(b"touched")
    _, label = run(path, tmp_path)
    assert label.max() == 2
    _, label = run(survey_of(scene, classes=1), tmp_path)
    assert label.max() == 1


def test_training_without_pixels_is_refused_before_anything_starts(scene, tmp_path):
    ring = [[500002, 3300002], [500002.1, 3300002], [500002.1, 3300002.1], [500002, 3300002]]
    shape = {"type": "Polygon", "coordinates": [ring]}
    shape["crs"] = {"type": "name", "properties": {"name": "EPSG:32617"}}
    (scene / "tiny.geojson").write_text(json.dumps(shape))
    named = [{"name": n, "training": f"{n}.geojson"} for n in ("sand", "tiny")]
    with pytest.raises(InputError, match=r"tiny\.geojson: class 'tiny': the tiles show \d+ pixels"):
        run_survey(sasmap.load_survey(survey_of(scene, classes=named)), output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unreadable_block_is_named_and_the_rest_is_mapped(scene, tmp_path):
    path = survey_of(scene, classes=2)
    tile = next((scene / "one").glob("*.tif"))
    content = tile.read_bytes()
    with rasterio.open(tile) as source:
        offset = int(source.get_tag_item("BLOCK_OFFSET_1_0", "TIFF", bidx=1))
    broken = bytearray(content)
    broken[offset : offset + 60] = b"\xff" * 60
    try:
        tile.write_bytes(bytes(broken))
        outcome, label = run(path, tmp_path)
    finally:
        tile.write_bytes(content)
    # the second column of blocks begins at pixel 256, within the last column of cells
    assert {(f["row"], f["column"]) for f in outcome.failures} == {(0, 3), (1, 3), (2, 3)}
    assert all("one_r0_c0.tif" in f["fault"] for f in outcome.failures)
    assert (label[:, :240] > 0).all()
    assert not label[:, 240:].any()


@pytest.mark.parametrize("content", ["{", "[]", '{"format": "other"}', "null"])
def test_a_model_that_is_none_is_refused(scene, content):
    (scene / "bad.json").write_text(content)
    with pytest.raises(sasmap.errors.InputError, match=r"bad\.json: expected sediment_classes"):
        make_plan(sasmap.load_survey(survey_of(scene, model="bad.json")))


def test_classes_and_model_exclude_each_other(scene):
    path = survey_of(scene, classes=2, model="x.json")
    with pytest.raises(sasmap.errors.InputError, match="expected classes or model, not both"):
        sasmap.load_survey(path)


def test_the_table_tells_how_classes_fit(scene, tmp_path):
    outcome, _ = run(survey_of(scene, classes=2), tmp_path / "two")
    beyond = max(row["share_beyond_law"] for row in outcome.sediments)
    for row in outcome.sediments:
        assert row["share_beyond_law"] < 0.03
        assert row["taken_for_gain_by_range_dB"] is None
        level = row["intensity_of_pixels_dB_over_first"]
        assert level == pytest.approx(row["intensity_dB_over_first"], abs=0.5)
    assert outcome.warnings == []
    # no law of one sediment fits a mixture of two
    model = json.loads((tmp_path / "two" / "sediment_classes.json").read_text())
    del model["classes"][1]
    path = tmp_path / "mud.json"
    path.write_text(json.dumps(model))
    outcome, _ = run(survey_of(scene, model=str(path)), tmp_path / "one")
    assert outcome.sediments[0]["share_beyond_law"] > 1.5 * beyond


def test_a_band_along_the_track_is_told_as_gain(tmp_path):
    floor = {
        **SCENE,
        "size": [24, 24],
        "sediments": [
            {"name": "mud", "level": 0.4},
            # the track runs east, so ranges are of the same y
            {"name": "sand", "level": 1.0, "polygon": [[-1, 10], [25, 10], [25, 18], [-1, 18]]},
        ],
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(floor))
    assert main(["simulate", str(tmp_path / "scene.yaml"), "--output", str(tmp_path)]) == 0
    outcome, label = run(survey_of(tmp_path), tmp_path / "out")
    assert len(outcome.sediments) == 1
    assert (label[label > 0] == 1).all()
    assert outcome.sediments[0]["taken_for_gain_by_range_dB"] > 2
    (warning,) = outcome.warnings
    assert "taken for gain" in warning
    again, _ = run(survey_of(tmp_path), tmp_path / "out")
    assert again.warnings == [warning]
