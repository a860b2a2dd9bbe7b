import json
import re
from html.parser import HTMLParser

import pytest

import sasmap
from sasmap.run.pipeline import run_survey
from sasmap.run.reporting import summary_lines
from tests.helpers import small_survey


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
    assert parts.links == ["survey", "ripples", "cells", "convergence", "sediments", "run"]
    assert set(parts.links) == set(parts.ids)
    assert parts.scripts == 0
    assert len(parts.sources) == 4 + 3 + 2  # maps, cells, sediments
    assert all(source.startswith("data:image/png;base64,") for source in parts.sources)
    assert not re.search(r"""(src|href)=["'](http|/)""", text)
    for expected in ("Best of the good cells", "Worst", "near", "far", "4 cells", "Nothing failed"):
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
    assert parts.links == ["survey", "ripples", "run"]
    assert any("6 no ripples" in line for line in summary_lines(outcome))


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
    assert len(item["assets"]) >= 10
    assert outcome.failures == []


def test_the_summary_is_short_and_says_where_to_look(sample):
    _, outcome = sample
    lines = list(summary_lines(outcome))
    assert 6 <= len(lines) <= 12
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
