"""The sediment stage on a cluster: the same bytes, whoever dies."""

import os
import pickle
import threading
import time

import pytest
import rasterio
import yaml
from distributed import Client, LocalCluster

import sasmap
from sasmap.cli import main
from sasmap.run import spreading
from sasmap.run.pipeline import run_survey
from sasmap.run.spreading import Spread
from tests.run.test_sediment_map import SCENE, survey_of

PRODUCTS = (
    "sediment_class.tif",
    "sediment_confidence.tif",
    "sediment_boundaries.gpkg",
    "sediment_areas.gpkg",
    "sediment_classes.json",
)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A survey of two sediments and a boulder, and its map made by threads."""
    folder = tmp_path_factory.mktemp("scene")
    scene = {**SCENE, "size": [60, 30]}
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    assert main(["simulate", str(folder / "scene.yaml"), "--output", str(folder)]) == 0
    (tile,) = (folder / "one").glob("*.tif")
    with rasterio.open(tile, "r+") as source:
        values = source.read(1)
        # the track runs east in the north: range goes with rows
        values[400:420, 900:920] = 170 + values[400:420, 900:920] // 8
        values[420:460, 900:920] = 1 + values[420:460, 900:920] // 32
        source.write(values, 1)
    survey = sasmap.load_survey(survey_of(folder))
    outcome = run_survey(survey, output=folder / "out")
    return survey, folder / "out", outcome


def test_a_boulder_makes_no_sediment(reference):
    _, folder, outcome = reference
    assert [one["name"] for one in outcome.sediments][-1] == "object"
    assert len(outcome.sediments) == 3
    with rasterio.open(folder / "sediment_class.tif") as source:
        label = source.read(1)
    number = outcome.sediments[-1]["number"]
    assert label[410, 910] == number
    assert label[440, 910] == 0  # its shadow
    assert (label == number).sum() < 1500


def test_dying_workers_change_no_byte(reference, tmp_path, monkeypatch):
    survey, expected, _ = reference
    told = []
    plain = Spread.__call__

    def weighed(self, function, items):
        for result in plain(self, function, items):
            told.append(len(pickle.dumps(result)))
            yield result

    monkeypatch.setattr(spreading.Spread, "__call__", weighed)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:

        def kill():
            time.sleep(1.5)
            process = next(iter(cluster.workers.values())).process.process
            os.kill(process.pid, 9)

        thread = threading.Thread(target=kill)
        thread.start()
        outcome = run_survey(survey, output=tmp_path, scheduler=cluster.scheduler_address)
        thread.join()
    assert outcome.failures == []
    for name in PRODUCTS:
        assert (tmp_path / name).read_bytes() == (expected / name).read_bytes(), name
    # of blocks of 1024 pixels a side: statistics of 64 by 64 blocks, and no pixels
    assert len(told) > 20
    assert max(told) < 64 * 64 * 13 * 8 + 10_000


def _deadly(item):
    if item == 2:
        os.kill(os.getpid(), 9)
    return 10 * item


def test_what_no_worker_survives_is_told():
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        spread = Spread(client)
        assert list(spread(_deadly, [3, 1, 4])) == [30, 10, 40]
        with pytest.raises(RuntimeError, match="kills every worker"):
            list(spread(_deadly, [1, 2, 3]))
