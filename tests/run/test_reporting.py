import json
import re
import shutil
from datetime import UTC, datetime
from html.parser import HTMLParser
from types import SimpleNamespace

import pyproj
import pytest

import sasmap
from sasmap.ripples.posterior import Quality
from sasmap.run.answers import ripple_words, summary_lines
from sasmap.run.pipeline import run_survey
from tests.conftest import SAMPLE
from tests.helpers import small_survey, with_pass


class Parts(HTMLParser):
    """Headings, sources, links and what is open."""

    def __init__(self):
        super().__init__()
        self.ids, self.links, self.sources, self.scripts = [], [], [], 0

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.scripts += tag == "script"
        if "id" in found:
            self.ids.append(found["id"])
        if tag == "a":
            self.links.append(found["href"].removeprefix("#"))
        if tag == "img":
            self.sources.append(found["src"])


def parts_of(path):
    parser = Parts()
    parser.feed(path.read_text(encoding="utf-8"))
    return parser


def test_the_report_is_whole_and_stands_alone(sample):
    output, _ = sample
    text = (output / "report.html").read_text(encoding="utf-8")
    parts = parts_of(output / "report.html")
    assert parts.links == [
        "answer", "survey", "ripples", "cells", "convergence", "sediments", "run",
    ]  # fmt: skip
    assert set(parts.links) == set(parts.ids)
    assert parts.scripts == 0
    # overview, ripple maps, law and growth, cells, sediments
    assert len(parts.sources) == 1 + 5 + 2 + 3 + 3
    assert all(source.startswith("data:image/png;base64,") for source in parts.sources)
    assert not re.search(r"""(src|href)=["'](http|/)""", text)
    for expected in (
        "Best of the good cells", "Worst", "near", "far", "4 cells", "Nothing failed",
        "Rippled cells", "Wavelength", "crest to trough", "Crest direction", "Sediment classes",
        "use the values with their intervals", "the crests are straight",
    ):  # fmt: skip
        assert expected in text
    assert "nan" not in re.sub(r"base64,[^\"]*", "", text)


def test_names_are_escaped(tmp_path):
    path = small_survey(tmp_path, name="<script>alert(1)</script> & co")
    run_survey(sasmap.load_survey(path))
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<script>" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; co" in text


def test_a_survey_without_ripples_or_sediments_shows_what_there_is(tmp_path):
    path = small_survey(tmp_path)
    outcome = run_survey(sasmap.load_survey(path))
    parts = parts_of(tmp_path / "out" / "report.html")
    assert parts.links == ["answer", "survey", "ripples", "run"]
    assert any("6 no ripples" in line for line in summary_lines(outcome))


def test_words_say_that_passes_contradict_each_other():
    found = (Quality.CONTRADICTION, Quality.NO_RIPPLES, Quality.CONTRADICTION)
    outcome = SimpleNamespace(fused={i: SimpleNamespace(quality=q) for i, q in enumerate(found)})
    assert "in 2 cells the passes contradict each other" in ripple_words(outcome)
    del outcome.fused[0], outcome.fused[2]
    assert ripple_words(outcome) == "No cell has ripples with a converged estimate."


def test_stac_item_finds_the_survey(sample):
    output, outcome = sample
    item = json.loads((output / "stac.json").read_text())
    west, south, east, north = item["bbox"]
    assert west == pytest.approx(-81, abs=1e-6)
    assert south == pytest.approx(29.83, abs=0.01)
    assert east > west
    assert north > south
    for asset in item["assets"].values():
        assert (output / asset["href"]).is_file()
    assert item["id"] == json.loads((output / "run.json").read_text())["run_id"]
    assert len(item["assets"]) >= 15
    assert item["assets"]["ripple_cells.gpkg"]["title"] == "Ripples"
    assert item["properties"]["proj:code"] == "EPSG:32617"
    assert outcome.failures == []


def test_stac_item_is_valid_and_bears_the_passes_dates(sample, tmp_path):
    pystac = pytest.importorskip("pystac")
    from sasmap.products.stac import write_stac

    output, _ = sample
    content = json.loads((output / "stac.json").read_text())
    first = datetime(2024, 5, 1, tzinfo=UTC)
    last = datetime(2024, 5, 3, 14, 30, tzinfo=UTC)
    box, crs = (500000.0, 3300000.0, 500037.5, 3300025.0), pyproj.CRS.from_epsg(32617).to_wkt()
    for span in (None, (first, first), (first, last)):
        path = tmp_path / "stac.json"
        write_stac(path, content["id"], "a", box, crs, ["mosaic.tif"], span, tmp_path)
        item = pystac.Item.from_file(path)
        pystac.validation.validate_dict(
            item.to_dict() | {"stac_extensions": []}  # whose schemas lie on the network
        )
        properties = json.loads(path.read_text())["properties"]
        if span is None:
            assert item.datetime.year >= 2025
        elif span == (first, first):
            assert properties["datetime"] == "2024-05-01T00:00:00Z"
        else:
            assert properties["datetime"] is None
            assert properties["start_datetime"] == "2024-05-01T00:00:00Z"
            assert properties["end_datetime"] == "2024-05-03T14:30:00Z"


def test_dates_of_passes_go_into_report_page_and_item(tmp_path):
    path = small_survey(tmp_path, **with_pass(date="2024-05-01"))
    run_survey(sasmap.load_survey(path))
    item = json.loads((tmp_path / "out" / "stac.json").read_text())
    assert item["properties"]["datetime"] == "2024-05-01T00:00:00Z"
    assert "Surveyed 2024-05-01" in (tmp_path / "out" / "report.html").read_text()
    assert "surveyed 2024-05-01" in (tmp_path / "out" / "survey.qgs").read_text()


def test_the_report_estimates_nothing_again(sample, tmp_path, monkeypatch):
    output, _ = sample
    shutil.copytree(output, tmp_path / "out")

    def never(*_, **__):
        raise AssertionError("estimated again")

    monkeypatch.setattr("sasmap.run.task.estimate", never)
    survey = sasmap.load_survey(SAMPLE / "survey.yaml")
    again = run_survey(survey, output=tmp_path / "out", workers=1)
    assert again.failures == []
    parts = parts_of(tmp_path / "out" / "report.html")
    before = parts_of(output / "report.html")
    assert parts.sources == before.sources  # the same pictures
    assert "nothing was sampled" not in (tmp_path / "out" / "report.html").read_text()


def test_the_log_has_the_summary_and_how_the_run_ended(tmp_path, monkeypatch):
    path = small_survey(tmp_path)
    outcome = run_survey(sasmap.load_survey(path))
    lines = (tmp_path / "out" / "sasmap.log").read_text(encoding="utf-8").splitlines()
    for line in summary_lines(outcome):
        assert any(told.endswith(line) for told in lines)
    assert lines[-1].endswith("ended: complete")

    def stop(*_, **__):
        raise KeyboardInterrupt("terminated")

    monkeypatch.setattr("sasmap.run.pipeline.compute", stop)
    with pytest.raises(KeyboardInterrupt):
        run_survey(sasmap.load_survey(path))
    lines = (tmp_path / "out" / "sasmap.log").read_text(encoding="utf-8").splitlines()
    assert lines[-1].endswith("ended: terminated; run again to go on from here")


def test_the_summary_is_short_and_says_where_to_look(sample):
    _, outcome = sample
    lines = list(summary_lines(outcome))
    assert 6 <= len(lines) <= 12
    assert "wavelength 1.5" in lines[1]  # half of the cells 1.67 m, half 1.51 m
    assert lines[0] == "cells: 4 good, 2 no ripples"
    assert lines[-1].endswith("report.html")


def test_a_product_that_cannot_be_written_is_named_and_the_rest_is_there(tmp_path, monkeypatch):
    path = small_survey(tmp_path)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sasmap.run.pipeline.write_ripples_netcdf", full)
    outcome = run_survey(sasmap.load_survey(path))
    (failure,) = outcome.failures
    assert failure["stage"] == "ripples.nc"
    assert "No space left" in failure["fault"]
    assert (tmp_path / "out" / "ripple_quality.tif").exists()
    assert json.loads((tmp_path / "out" / "run.json").read_text())["failures"] == [failure]


def test_a_full_disk_fails_its_cells_by_name_and_ends_with_the_rest(tmp_path, monkeypatch, capsys):
    from sasmap.cli import main
    from sasmap.run.store import Store

    path = small_survey(tmp_path)
    save, saved = Store.save, []

    def full(self, key, summary):
        saved.append(key)
        if len(saved) == 2:
            raise OSError(28, "No space left on device")
        save(self, key, summary)

    monkeypatch.setattr(Store, "save", full)
    assert main(["run", str(path), "--quiet", "--workers", "1"]) == 1
    assert "No space left on device" in capsys.readouterr().err
    failures = json.loads((tmp_path / "out" / "run.json").read_text())["failures"]
    assert len(failures) == 1
    monkeypatch.setattr(Store, "save", save)
    again = run_survey(sasmap.load_survey(path))
    assert (again.kept, again.computed, again.failures) == (5, 1, [])
