import json

import pytest

from sasmap.cli import main
from tests.helpers import small_survey


def test_run_tells_where_the_products_are(tmp_path, capsys):
    path = small_survey(tmp_path)
    assert main(["run", str(path), "--output", str(tmp_path / "maps")]) == 0
    said = capsys.readouterr()
    assert "6 no ripples" in said.out
    assert str(tmp_path / "maps") in said.out
    assert "6 of 6" in said.err


def test_quiet_says_nothing(tmp_path, capsys):
    assert main(["run", str(small_survey(tmp_path)), "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""


def test_plan_and_schema(tmp_path, capsys):
    assert main(["plan", str(small_survey(tmp_path, sediments={}))]) == 0
    said = capsys.readouterr().out
    assert "2 rows x 3 columns of 10 m" in said
    assert "left out" not in said
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "Survey"


def test_bad_input_is_one_line_status_2_and_touches_nothing(tmp_path, capsys):
    path = small_survey(tmp_path)
    assert main(["run", str(path), "--quiet"]) == 0
    before = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    path.write_text(path.read_text().replace("window", "windw"))
    assert main(["run", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "windw: unknown key; did you mean 'window'?" in line
    after = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert after == before


@pytest.mark.parametrize("taken", ["file", "below-a-file"])
def test_an_output_folder_that_cannot_be_made(tmp_path, capsys, taken):
    path = small_survey(tmp_path)
    (tmp_path / "file").write_text("mine")
    target = tmp_path / "file" if taken == "file" else tmp_path / "file" / "deeper"
    assert main(["run", str(path), "--output", str(target)]) == 2
    assert "output folder cannot be made" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


def test_nobody_answers_as_scheduler(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sasmap.run.scheduling.CLUSTER_TIMEOUT", "1s")
    path = small_survey(tmp_path)
    assert main(["run", str(path), "--quiet", "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "no dask scheduler answers" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments", [[], ["run"], ["fly"], ["run", "x", "--workers", "0"]])
def test_bad_usage_is_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "usage" in capsys.readouterr().err


def test_help_of_each_verb_has_an_example(capsys):
    for verb in ("run", "plan", "simulate"):
        with pytest.raises(SystemExit):
            main([verb, "--help"])
        assert "Example: sasmap" in " ".join(capsys.readouterr().out.split())
