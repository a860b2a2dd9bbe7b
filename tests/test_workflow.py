"""Running where others run too: clusters, locks, folders of earlier runs, areas."""

import html
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

import sasmap
from sasmap.cli import main
from sasmap.errors import InputError
from sasmap.run.lock import locked
from sasmap.run.pipeline import run_survey
from sasmap.run.plan import make_plan
from sasmap.run.scheduling import check_workers
from sasmap.survey.cells import Cell
from sasmap.survey.opening import open_survey
from sasmap.survey.passes import read_clip
from tests.helpers import UTM, small_survey, with_pass, write_tile, write_track

PRODUCTS = ("ripple_frequency.tif", "ripple_height.tif", "ripple_quality.tif", "ripples.nc")


def polygon(path, left, bottom, right, top, mark=""):
    ring = [[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]]
    shape = {"type": "Polygon", "coordinates": [ring]}
    shape["crs"] = {"type": "name", "properties": {"name": UTM}}
    path.write_text(mark + json.dumps(shape), encoding="utf-8")


@pytest.fixture
def elsewhere(tmp_path):
    """A dask scheduler and two workers, as processes started in another folder."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0"]
    quiet = {"cwd": folder, "stdout": subprocess.DEVNULL}
    scheduler = subprocess.Popen(
        [*command, "--no-dashboard"], stderr=subprocess.PIPE, text=True, **quiet
    )
    workers = []
    try:
        found = None
        while found is None:
            line = scheduler.stderr.readline()
            assert line, "the scheduler ended"
            found = re.search(r"Scheduler at:\s+(tcp://\S+)", line)
        address = found[1]
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
        workers = [
            subprocess.Popen([*worker, "--no-dashboard"], stderr=subprocess.DEVNULL, **quiet)
            for _ in range(2)
        ]
        from distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield address
    finally:
        for process in (*workers, scheduler):
            process.send_signal(signal.SIGTERM)
        for process in (*workers, scheduler):
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()


def test_workers_elsewhere_give_the_same_bytes(tmp_path, elsewhere, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "site").mkdir()
    small_survey(tmp_path / "site")
    assert main(["run", "site/survey.yaml", "--output", "here", "--quiet"]) == 0
    command = ["run", "site/survey.yaml", "--output", "there", "--quiet", "--scheduler", elsewhere]
    assert main(command) == 0, capsys.readouterr().err
    for name in PRODUCTS:
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_workers_that_do_not_see_the_tiles_are_named(tmp_path):
    path = tmp_path / "a.tif"
    path.write_bytes(b"12")

    class Client:
        """A cluster of two workers, one of which has another file there."""

        def run(self, look, sizes, on_error):
            return {"tcp://one": look(sizes), "tcp://two": look({k: 3 for k in sizes})}

    with pytest.raises(InputError, match=r"a\.tif: worker tcp://two does not see this file"):
        check_workers(Client(), [path])


def test_an_address_without_a_port_is_one_line(tmp_path, capsys):
    path = small_survey(tmp_path)
    for address in ("127.0.0.1", "tcp://node1", "tcp://node1:", "node1:dask"):
        assert main(["run", str(path), "--scheduler", address, "--quiet"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "with its port" in line
    assert not (tmp_path / "out").exists()


def test_one_run_at_a_time(tmp_path, capsys):
    path = small_survey(tmp_path)
    lock = tmp_path / "out" / ".sasmap" / "lock"
    lock.parent.mkdir(parents=True)
    with locked(lock):
        assert main(["run", str(path), "--quiet"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert str(os.getpid()) in line
        assert "delete this file" in line
    assert not lock.exists()
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    host = json.loads(_content_of(lock))["host"]
    lock.write_text(json.dumps({"process": ended.pid, "host": host}))
    assert main(["run", str(path), "--quiet"]) == 0  # of a process that is no more
    lock.write_text(json.dumps({"process": ended.pid, "host": "another"}))
    assert main(["run", str(path), "--quiet"]) == 2
    assert "another" in capsys.readouterr().err


def _content_of(lock):
    with locked(lock):
        return lock.read_text()


def test_products_of_an_earlier_run_are_named(tmp_path, capsys):
    path = small_survey(tmp_path, sediments={})
    assert main(["run", str(path), "--quiet"]) == 0
    capsys.readouterr()
    small_survey(tmp_path)
    assert main(["run", str(path), "--quiet"]) == 0
    assert "sediment_class.tif" in capsys.readouterr().err
    content = json.loads((tmp_path / "out" / "run.json").read_text())
    assert any("sediment_class.tif" in line for line in content["warnings"])


def test_home_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    path = small_survey(tmp_path, **with_pass(tiles=["~/tiles/*.tif"], navigation="~/nav.csv"))
    opened = open_survey(sasmap.load_survey("~/survey.yaml"))
    assert opened.passes[0].tiles[0].path == path.parent / "tiles" / "a.tif"


def test_warnings_stand_on_the_terminal_in_the_record_and_on_top(tmp_path, capsys):
    path = small_survey(tmp_path)
    values = np.random.default_rng(5).gamma(9, 9.0, (40, 60)).astype("float32")
    corner = Affine(0.5, 0, 500010.0, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "tiles" / "a.tif", values, corner)
    assert main(["run", str(path)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert "WARNING" in said[-1]
    assert "a.tif" in said[-1]
    (warning,) = json.loads((tmp_path / "out" / "run.json").read_text())["warnings"]
    assert "a.tif" in warning
    report = (tmp_path / "out" / "report.html").read_text()
    assert warning[-60:] in html.unescape(report)
    assert report.index('class="warnings"') < report.index('id="survey"')


def test_area_and_exclude(tmp_path):
    polygon(tmp_path / "area.geojson", 500011, 3300011, 500019, 3300019)
    polygon(tmp_path / "wreck.geojson", 500015, 3300015, 500017, 3300017, mark="\ufeff")
    path = small_survey(tmp_path, area="area.geojson", exclude="wreck.geojson")
    plan = make_plan(sasmap.load_survey(path))
    assert list(plan.cells) == [Cell(0, 0)]
    sonar_pass = plan.opened.passes[0]
    clip = read_clip(sonar_pass, plan.opened.grid, Cell(0, 0), "starboard")
    x, y = np.meshgrid(clip.x[0], clip.y[:, 0])
    inside = (x > 500015) & (x < 500017) & (y > 3300015) & (y < 3300017)
    np.testing.assert_array_equal(np.isnan(clip.values), inside)
    array = sasmap.open_pass(plan.settings, "one")
    assert int(np.isnan(array.values).sum()) == 16
    outcome = run_survey(plan.settings, output=tmp_path / "maps")
    assert outcome.failures == []
    assert outcome.computed == 1
    small_survey(tmp_path, area="area.geojson")
    again = run_survey(sasmap.load_survey(path), output=tmp_path / "maps")
    assert again.computed == 1  # another exclude, other pixels


def test_areas_off_the_tiles(tmp_path):
    polygon(tmp_path / "off.geojson", 400000, 3300000, 400010, 3300010)
    path = small_survey(tmp_path, area="off.geojson")
    with pytest.raises(InputError, match=r"off\.geojson: no polygon of it lies on"):
        make_plan(sasmap.load_survey(path))
    path = small_survey(tmp_path, exclude="off.geojson")
    assert "nothing is left out" in make_plan(sasmap.load_survey(path)).opened.warnings[0]
    polygon(tmp_path / "all.geojson", 499000, 3299000, 501000, 3301000)
    path = small_survey(tmp_path, exclude="all.geojson")
    with pytest.raises(InputError, match=r"no valid pixel|leave no cell"):
        make_plan(sasmap.load_survey(path))


def test_a_geographic_tile_is_laid_on_square_pixels(tmp_path):
    """Every value that is shown is that of the tile's pixel at the place."""
    path = small_survey(tmp_path, crs=UTM)
    values = np.random.default_rng(2).rayleigh(60.0, (90, 110))
    place = Affine(2e-6, 0, -80.9999, 0, -1.6e-6, 29.8303)
    write_tile(tmp_path / "tiles" / "a.tif", values, place, crs="EPSG:4326")
    north = np.linspace(29.8300, 29.8305, 80)
    write_track(
        tmp_path / "nav.csv", np.full(80, -81.0), north, 5.0, ("longitude", "latitude", "altitude")
    )
    array = sasmap.open_pass(sasmap.load_survey(path), "one").compute()
    assert np.allclose(np.diff(array.x), -np.diff(array.y).mean(), atol=1e-6)
    shown = array.values[np.isfinite(array.values)]
    assert shown.size > 0.8 * values.size * 1.6 / 2 * 0.86
    assert np.unique(shown).size == shown.size  # no pixel twice
    assert set(shown) <= set(values.ravel())


def test_altitude_sd_goes_along(tmp_path):
    path = small_survey(tmp_path, **with_pass(altitude_sd=0.3))
    opened = open_survey(sasmap.load_survey(path))
    assert opened.passes[0].altitude_sd == 0.3
    assert sasmap.open_pass(opened.settings, "one").attrs["altitude_sd"] == 0.3
    clip = read_clip(opened.passes[0], opened.grid, Cell(0, 0), "starboard")
    assert clip.attrs["altitude_sd"] == 0.3


@pytest.mark.parametrize("kind", ["intensity", "db"])
def test_amplitude_is_converted_on_reading(tmp_path, kind):
    path = small_survey(tmp_path)
    clean = sasmap.open_pass(sasmap.load_survey(path), "one").values
    convert = {"intensity": np.square, "db": lambda v: 20 * np.log10(v)}[kind]
    corner = Affine(0.5, 0, 500010.0, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "tiles" / "a.tif", convert(clean).astype("float32"), corner)
    path = small_survey_again(tmp_path, kind)
    got = sasmap.open_pass(sasmap.load_survey(path), "one").values
    np.testing.assert_allclose(got, clean, rtol=1e-5)


def small_survey_again(folder, kind):
    """The survey file anew, the tile as it is."""
    tile = folder / "tiles" / "a.tif"
    kept = tile.read_bytes()
    path = small_survey(folder, **with_pass(amplitude=kind))
    tile.write_bytes(kept)
    return path


def test_a_cell_of_one_row_has_a_lattice(tmp_path):
    path = small_survey(tmp_path, window=39, sediments={})
    outcome = run_survey(sasmap.load_survey(path))
    assert outcome.failures == []
    assert Path(outcome.output / "sediment_class.tif").exists() or outcome.sediments == []


def test_a_tile_of_one_strip_is_whole_and_a_cut_one_is_not(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    path = small_survey(tmp_path)
    tile = tmp_path / "tiles" / "a.tif"
    with rasterio.open(tile) as source:
        values = source.read(1)
    geo = [
        (33550, "d", 3, (0.5, 0.5, 0.0), False),
        (33922, "d", 6, (0.0, 0.0, 0.0, 500010.0, 3300020.0, 0.0), False),
        (34735, "H", 16, (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32617), False),
    ]
    tifffile.imwrite(tile, values, extratags=geo, metadata=None, photometric="minisblack")
    np.testing.assert_array_equal(sasmap.open_pass(sasmap.load_survey(path), "one"), values)
    whole = tile.read_bytes()
    tile.write_bytes(whole[: len(whole) - 4000])
    with pytest.raises(InputError, match="truncated"):
        open_survey(sasmap.load_survey(path))
