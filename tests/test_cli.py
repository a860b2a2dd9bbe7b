import json
import platform
import subprocess
import sys

import pytest

import sasmap
from sasmap.cli import _Progress, _share_heaps, main
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


def test_a_reader_that_has_seen_enough_is_no_error():
    command = [sys.executable, "-m", "sasmap", "schema"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        run.stdout.close()
        assert run.stderr.read() == b""
    assert run.returncode == 0


def test_plan_of_another_output_counts_what_is_finished_there(tmp_path, capsys):
    path = small_survey(tmp_path)
    assert main(["run", str(path), "--quiet", "--output", str(tmp_path / "maps")]) == 0
    assert main(["plan", str(path), "--output", str(tmp_path / "maps")]) == 0
    assert "finished by an earlier run: 6 of 6" in capsys.readouterr().out
    assert main(["plan", str(path)]) == 0
    assert "finished" not in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_plan_tells_the_time_of_looks_that_it_tried(tmp_path, monkeypatch):
    from sasmap.run import cost
    from sasmap.run.plan import make_plan

    plan = make_plan(sasmap.load_survey(small_survey(tmp_path, sediments=None)))
    clock = iter(range(0, 1000, 7))
    tried = []
    monkeypatch.setattr(cost, "compiled", lambda: True)
    monkeypatch.setattr(cost.time, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(cost, "try_look", lambda plan, cell, k: tried.append((cell, k)))
    low, high = cost.seconds_of(plan, workers=2)
    assert tried
    assert low == high == pytest.approx(cost.FIXED + 6 * 7.0 / 2, abs=0.1)  # looks x seconds
    monkeypatch.setattr(cost, "compiled", lambda: False)
    low, high = cost.seconds_of(plan, workers=1)
    assert low < high


def test_progress_of_both_stages_tells_the_pace_of_the_last_cells(tmp_path, capsys, monkeypatch):
    path = small_survey(tmp_path, sediments={})
    assert main(["run", str(path), "--workers", "1"]) == 0
    said = capsys.readouterr().err
    assert "ripples: 6 of 6 cells done" in said
    assert "sediments: 6 of 6 cells done" in said
    progress = _Progress()
    # two minutes of compilation, then a cell each two seconds
    for done, now in ((1, 120.0), (2, 122.0), (3, 124.0), (4, 126.0)):
        monkeypatch.setattr("sasmap.cli.time.monotonic", lambda now=now: now)
        progress("ripples", done, 10)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "ripples: 4 of 10 cells done, 0.5 a second, 12 s left"
    for done, now in ((1, 200.0), (2, 200.0001)):  # kept from an earlier run
        monkeypatch.setattr("sasmap.cli.time.monotonic", lambda now=now: now)
        progress("sediments", done, 6)
    assert capsys.readouterr().err.splitlines()[-1] == "sediments: 2 of 6 cells done"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_every_verb_and_option(shell, capsys, tmp_path):
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    for word in ("run", "plan", "simulate", "tiles", "schema", "completion"):
        assert word in text
    assert "scheduler" in text
    if shell == "bash":
        script = tmp_path / "complete.sh"
        script.write_text(
            text + "COMP_WORDS=(sasmap run --res); COMP_CWORD=2; _sasmap\necho ${COMPREPLY[@]}\n"
        )
        found = subprocess.run(["bash", script], capture_output=True, text=True, check=True)
        assert found.stdout.strip() == "--restart"


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
    for verb in ("run", "plan", "simulate", "tiles", "schema", "completion"):
        with pytest.raises(SystemExit):
            main([verb, "--help"])
        assert "Example: sasmap" in " ".join(capsys.readouterr().out.split())


def test_a_termination_that_python_drops_is_raised_again():
    program = """
import os, signal, sys, time, weakref
import sasmap.cli

class Thing: pass

def ended(_):  # Python drops what is raised here
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.2)

def work():
    thing = Thing()
    watch = weakref.ref(thing, ended)
    del thing
    print("goes on", flush=True)
    time.sleep(20)
    return 0

sasmap.cli.survey_schema = work
sys.argv = ["sasmap", "schema"]
sasmap.cli.console()
"""
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert ended.stdout == "goes on\n"
    assert ended.returncode == 130
    assert ended.stderr.splitlines()[-1] == "sasmap: terminated; run again to go on from here"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_threads_share_heaps():
    assert _share_heaps()


def test_plan_refuses_what_run_would_before_it_reads_wide_windows(tmp_path, capsys, monkeypatch):
    path = small_survey(tmp_path, output="nav.csv")
    assert main(["plan", str(path)]) == 2
    assert "nav.csv: output folder cannot be made" in capsys.readouterr().err
    path = small_survey(tmp_path)
    monkeypatch.setattr("sasmap.run.suggestion.describe_window", lambda plan: 1 / 0)
    monkeypatch.setattr("sasmap.run.cost.WORKING", 1e12)
    assert main(["plan", str(path)]) == 2
    assert "memory" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["run", "plan"])
def test_an_empty_output_is_not_the_current_folder(verb, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([verb, str(small_survey(tmp_path)), "--output", ""])
    assert stop.value.code == 2
    assert "expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"ripples": {"height": [0, 7]}}, "ripples.height: expected bounds of A_H in metres"),
        ({"ripples": True}, "ripples: expected keys and values below it"),
        ({"area": None, "passes": [{"name": "a", "tiles": "*.tif"}]}, "expected a list, such as"),
    ],
)
def test_values_of_another_kind_are_told_in_plain_words(changes, says, tmp_path, capsys):
    assert main(["plan", str(small_survey(tmp_path, **changes))]) == 2
    assert says in capsys.readouterr().err
