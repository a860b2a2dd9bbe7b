"""Clusters whose workers die."""

import json
import os
import threading
import time

import numpy as np
import pytest
import rasterio
from distributed import LocalCluster

import sasmap
from sasmap.run import task
from sasmap.run.pipeline import run_survey
from tests.helpers import small_survey

PRODUCTS = ("ripple_frequency.tif", "ripple_height.tif", "ripple_quality.tif", "ripples.nc")


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A survey of 24 cells, run in threads."""
    folder = tmp_path_factory.mktemp("reference")
    survey = sasmap.load_survey(small_survey(folder, window=10))
    run_survey(survey)
    return survey, folder / "out"


def test_killed_workers_change_nothing(reference, tmp_path):
    survey, expected = reference
    with LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None) as cluster:
        killed = []

        def kill():
            for _ in range(4):
                time.sleep(1.0)
                alive = [w.process for w in cluster.workers.values() if w.process is not None]
                process = alive[len(killed) % len(alive)].process
                if process is not None and process.pid is not None:
                    killed.append(process.pid)
                    os.kill(process.pid, 9)

        thread = threading.Thread(target=kill)
        thread.start()
        outcome = run_survey(survey, output=tmp_path, scheduler=cluster.scheduler_address)
        thread.join()
    assert killed
    assert outcome.failures == []
    for name in PRODUCTS:
        assert (tmp_path / name).read_bytes() == (expected / name).read_bytes(), name


def _poisoned(context, cell):
    """Kill the process that is given one cell."""
    if cell == (1, 2):
        os.kill(os.getpid(), 9)
    return task.run_cell(context, cell)


def test_a_poison_cell_is_flagged_and_nothing_else_is_lost(reference, tmp_path, monkeypatch):
    survey, expected = reference
    monkeypatch.setattr("sasmap.run.scheduling.run_cell", _poisoned)
    with LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None) as cluster:
        outcome = run_survey(survey, output=tmp_path, scheduler=cluster.scheduler_address)
    (failure,) = outcome.failures
    assert (failure["row"], failure["column"]) == (1, 2)
    assert "worker died" in failure["fault"]
    assert json.loads((tmp_path / "run.json").read_text())["failures"] == [failure]
    with (
        rasterio.open(tmp_path / "ripple_quality.tif") as found,
        rasterio.open(expected / "ripple_quality.tif") as wanted,
    ):
        quality = wanted.read(1)
        quality[1, 2] = 7
        np.testing.assert_array_equal(found.read(1), quality)
