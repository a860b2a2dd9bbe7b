import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray as xr
from affine import Affine
from rio_cogeo import cog_validate
from threadpoolctl import threadpool_info, threadpool_limits

import sasmap
from sasmap.cli import main
from sasmap.run.pipeline import run_survey
from sasmap.run.plan import make_plan
from tests.helpers import small_survey, with_pass, write_tile

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
PRODUCTS = (
    "ripple_frequency.tif",
    "ripple_height.tif",
    "ripple_quality.tif",
    "ripple_passes.tif",
    "ripples.nc",
    "sediment_class.tif",
    "sediment_confidence.tif",
    "sediment_boundaries.gpkg",
    "ripple_steepness.tif",
    "ripple_cells.gpkg",
    "ripple_cells.csv",
    "mosaic.tif",
)


def products(folder):
    mapped = (folder / "sediment_class.tif").exists()  # the small surveys have no sediments block
    names = PRODUCTS if mapped else [name for name in PRODUCTS if "sediment" not in name]
    return {name: (folder / name).read_bytes() for name in names}


def read(folder, name):
    with rasterio.open(folder / name) as source:
        return source.read()


def cells_of(name):
    """Means of a raster of the truth over the sample's six cells."""
    truth = read(SAMPLE / "truth", f"{name}.tif")[0]
    return truth.reshape(2, 50, 3, 50).mean(axis=(1, 3))


def test_sample_products_hold_the_truth_with_honest_intervals(sample):
    output, outcome = sample
    frequency, height = read(output, "ripple_frequency.tif"), read(output, "ripple_height.tif")
    rippled = np.array([[True, True, False]] * 2)
    np.testing.assert_array_equal(np.isfinite(frequency[0]), rippled)
    # where crests bend and fork, a cell's one number is known to half a per cent, and A_H badly
    truths = (cells_of("ripple_frequency"), cells_of("ripple_height"))
    even = np.array([[True, False, False], [False, False, False]])
    for bands, truth, most in zip((frequency, height), truths, (0.01, 0.35), strict=True):
        np.testing.assert_allclose(bands[0][rippled], truth[rippled], rtol=most)
        np.testing.assert_allclose(bands[0][even], truth[even], rtol=0.05)
        known = np.hypot(5 * bands[1], np.where(even, 0.0, 0.005 * truth))
        assert (np.abs(bands[0] - truth)[rippled] < known[rippled]).all()
        assert (bands[2][rippled] < bands[3][rippled]).all()
    quality, passes = read(output, "ripple_quality.tif")[0], read(output, "ripple_passes.tif")[0]
    np.testing.assert_array_equal(quality, np.where(rippled, 1, 2))
    assert (passes[rippled] >= 1).all()
    assert (passes[~rippled] == 0).all()
    assert outcome.failures == []


def test_rasters_are_where_the_cells_are_and_valid_cogs(sample):
    output, _ = sample
    for name in PRODUCTS[:4]:
        assert cog_validate(output / name, strict=True)[0]
        with rasterio.open(output / name) as source:
            assert source.crs.to_epsg() == 32617
            assert tuple(source.transform)[:6] == (12.5, 0, 500000, 0, -12.5, 3300025)
            assert all(source.descriptions)
            assert source.tags()["SURVEY"] == "two passes off the bar"
            assert len(source.tags()["RUN_ID"]) == 16
    with rasterio.open(output / "ripple_height.tif") as source:
        assert source.units == ("m",) * 4
        assert np.isnan(source.nodata)
    with rasterio.open(output / "ripple_quality.tif") as source:
        assert source.nodata == 0
        assert source.colormap(1)[1] == (0, 158, 115, 255)


def test_netcdf_holds_every_look(sample):
    output, _ = sample
    with xr.open_dataset(output / "ripples.nc") as found:
        assert found["frequency_mean"].dims == ("pass", "y", "x")
        assert found["pass"].values.tolist() == ["near", "far"]
        near, far = found["frequency_prior_sd"].isel(x=0, y=0).values
        assert np.isinf(near)
        assert np.isfinite(far)
        assert found["left_out"].attrs["flag_meanings"].startswith("sampling")
        np.testing.assert_allclose(found.x, 500006.25 + 12.5 * np.arange(3))
        last = found["height_mean"].isel({"pass": 1})
        good = found["quality"].isel({"pass": 1}) == 1
        raster = read(output, "ripple_height.tif")[0]
        np.testing.assert_allclose(raster[good.values], last.values[good.values], rtol=1e-6)


def test_manifest_says_what_ran_and_what_was_left_out(sample):
    output, _ = sample
    manifest = json.loads((output / "run.json").read_text())
    assert manifest["cells_by_quality"] == {"good": 4, "no ripples": 2}
    assert set(manifest["inputs"]) == {
        "near/near_r0_c0.tif", "near.csv", "far/far_r0_c0.tif", "far.csv",
    }  # fmt: skip
    assert manifest["looks_computed"] == 12
    assert set(manifest["seconds"]) == {
        "check", "ripples", "products", "sediments", "mosaic", "report",
    }  # fmt: skip
    levels = [c["intensity_dB_over_first"] for c in manifest["sediment_classes"]]
    np.testing.assert_allclose(levels, [0.0, 4.56, 7.98], atol=0.3)  # mud, sand, gravel
    assert manifest["settings"]["ripples"]["chains"] == 4
    assert not [p for p in output.rglob("*.part")]


def test_sample_regenerates_to_the_same_bytes(tmp_path):
    assert main(["simulate", str(SAMPLE / "scene.yaml"), "--output", str(tmp_path)]) == 0
    made = {p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file()}
    for name in made:
        assert (tmp_path / name).read_bytes() == (SAMPLE / name).read_bytes(), name
    kept = {
        p.relative_to(SAMPLE)
        for p in SAMPLE.rglob("*")
        if p.is_file() and "out" not in p.relative_to(SAMPLE).parts
    }
    assert kept - made == {Path("scene.yaml")}
    assert sum((SAMPLE / p).stat().st_size for p in kept) < 8_000_000


def test_finished_cells_are_kept_and_give_the_same_bytes(sample, tmp_path):
    output, _ = sample
    shutil.copytree(output, tmp_path / "out")
    survey = sasmap.load_survey(SAMPLE / "survey.yaml")
    before = products(output)
    again = run_survey(survey, output=tmp_path / "out", workers=1)
    assert (again.computed, again.kept) == (0, 12)
    assert products(tmp_path / "out") == before


def test_one_worker_restarted_gives_the_same_bytes_as_two(sample, tmp_path):
    output, _ = sample
    shutil.copytree(output, tmp_path / "out")
    survey = sasmap.load_survey(SAMPLE / "survey.yaml")
    again = run_survey(survey, output=tmp_path / "out", workers=1, restart=True)
    assert (again.computed, again.kept) == (12, 0)
    assert products(tmp_path / "out") == products(output)


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_and_resumed_gives_the_same_bytes(sample, tmp_path, kind):
    output, _ = sample
    command = [
        sys.executable, "-m", "sasmap.cli", "run", str(SAMPLE / "survey.yaml"),
        "--output", str(tmp_path), "--workers", "1",
    ]  # fmt: skip
    process = subprocess.Popen(
        command,
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        # a suite that was started in the background ignores interrupts, and so would its children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    finished = tmp_path / ".sasmap" / "cells"
    deadline = time.monotonic() + 400
    while len(list(finished.glob("*/*.json"))) < 3 and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(kind)
    status = process.wait(timeout=200)
    assert status == (-signal.SIGKILL if kind == signal.SIGKILL else 130)
    ended = "ended: interrupted" in (tmp_path / "sasmap.log").read_text(encoding="utf-8")
    assert ended == (kind == signal.SIGINT)
    assert not list(tmp_path.glob("*.tif"))
    survey = sasmap.load_survey(SAMPLE / "survey.yaml")
    resumed = run_survey(survey, output=tmp_path, workers=2)
    assert resumed.kept >= 3
    assert resumed.kept + resumed.computed == 12
    assert products(tmp_path) == products(output)


def test_killed_in_the_second_stage_and_resumed_gives_the_same_bytes(sample, tmp_path):
    output, _ = sample
    script = (
        "import os, signal, sasmap\n"
        "from sasmap.run import combining, pipeline\n"
        "combining.fuse_cells = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"survey = sasmap.load_survey({str(SAMPLE / 'survey.yaml')!r})\n"
        f"pipeline.run_survey(survey, output={str(tmp_path)!r}, workers=1)\n"
    )
    killed = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not list(tmp_path.glob("ripple_*.tif"))
    resumed = run_survey(sasmap.load_survey(SAMPLE / "survey.yaml"), output=tmp_path, workers=2)
    assert (resumed.computed, resumed.kept) == (0, 12)
    assert products(tmp_path) == products(output)


def test_a_batch_system_that_ends_a_run_leaves_it_resumable_and_says_so(tmp_path):
    command = [
        sys.executable, "-m", "sasmap", "run", str(SAMPLE / "survey.yaml"),
        "--output", str(tmp_path), "--workers", "1",
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    path = tmp_path / "sasmap.log"
    deadline = time.monotonic() + 200
    while not (path.exists() and "looks at them" in path.read_text(encoding="utf-8")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.terminate()
    _, said = process.communicate(timeout=200)
    assert process.returncode == 130, said
    assert said.splitlines()[-1] == "sasmap: terminated; run again to go on from here"
    last = path.read_text(encoding="utf-8").splitlines()[-1]
    assert last.endswith("ended: terminated; run again to go on from here")
    assert not (tmp_path / ".sasmap" / "lock").exists()


def test_linear_algebra_runs_on_one_thread(tmp_path):
    def threads():
        return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    during = set()
    survey = sasmap.load_survey(small_survey(tmp_path))
    with threadpool_limits(2, user_api="blas"):
        run_survey(survey, progress=lambda *_: during.update(threads()))
        assert during == {1}
        assert threads() == {2}


def run(path, *options):
    return run_survey(sasmap.load_survey(path), **dict(options))


def test_only_what_a_change_touches_is_computed_again(tmp_path):
    path = small_survey(tmp_path)
    assert run(path).computed == 6
    assert run(path).kept == 6
    text = path.read_text()
    path.write_text(text.replace("name: small", "name: other"))
    assert run(path).kept == 6  # a name changes no cell
    path.write_text(text + "seed: 2\n")
    assert run(path).computed == 6
    path.write_text(text.replace("ripples: {}", "ripples: {height: [0, 0.4]}"))
    assert run(path).computed == 6
    path.write_text(text)
    assert run(path).kept == 6
    nav = tmp_path / "nav.csv"
    nav.write_text(nav.read_text().replace(",5.0", ",5.1"))
    assert run(path).computed == 6


def test_a_tile_that_two_passes_list_is_told(tmp_path):
    path = small_survey(tmp_path)
    assert not make_plan(sasmap.load_survey(path)).opened.warnings
    (again,) = with_pass(name="two", tiles=["again.tif"])["passes"]
    shutil.copy(tmp_path / "tiles" / "a.tif", tmp_path / "again.tif")
    path = small_survey(tmp_path, passes=[*with_pass()["passes"], again])
    (text,) = make_plan(sasmap.load_survey(path)).opened.warnings
    assert "again.tif: pass two: the same data as" in text
    assert text.endswith("list it once")


def test_a_pass_added_later_leaves_the_first_one_alone(tmp_path):
    path = small_survey(tmp_path)
    run(path)
    text = path.read_text()
    start = text.index("passes:")
    block = text[start : text.index("ripples:")].removeprefix("passes:\n")
    path.write_text(text.replace(block, block + block.replace("name: one", "name: two")))
    later = run(path)
    assert (later.kept, later.computed) == (6, 6)


def test_a_block_that_cannot_be_decoded_fails_its_cells_alone(tmp_path):
    path = small_survey(tmp_path)
    tile = tmp_path / "tiles" / "a.tif"
    with rasterio.open(tile) as source:
        values, profile = source.read(1), source.profile
    with rasterio.open(tile, "w", **(profile | {"compress": "deflate"})) as target:
        target.write(values, 1)
    with rasterio.open(tile) as source:
        offset = int(source.get_tag_item("BLOCK_OFFSET_0_0", "TIFF", bidx=1))
    content = bytearray(tile.read_bytes())
    content[offset : offset + 60] = b"\xff" * 60
    tile.write_bytes(bytes(content))
    assert main(["run", str(path), "--quiet"]) == 1
    quality = read(tmp_path / "out", "ripple_quality.tif")[0]
    assert quality[0, 0] == 7
    assert (quality.ravel()[1:] != 7).all()
    (failure,) = json.loads((tmp_path / "out" / "run.json").read_text())["failures"]
    assert (failure["row"], failure["column"], failure["pass"]) == (0, 0, "one")
    assert "a.tif" in failure["fault"]


def test_cells_with_few_valid_pixels_say_so(tmp_path):
    path = small_survey(tmp_path, window=35)
    run(path)
    quality = read(tmp_path / "out", "ripple_quality.tif")[0]
    assert quality.shape == (2, 2)
    assert quality[1].tolist() == [6, 6]  # five rows of thirty-five


def test_plan_counts_and_writes_nothing(tmp_path):
    plan = make_plan(sasmap.load_survey(small_survey(tmp_path)))
    assert len(plan.cells) == 6
    assert all(looks == (0,) for looks in plan.cells.values())
    assert not (tmp_path / "out").exists()


def test_both_sides_are_two_looks_of_one_pass(tmp_path):
    path = small_survey(tmp_path)
    path.write_text(path.read_text().replace("starboard", "both"))
    run(path)
    with xr.open_dataset(tmp_path / "out" / "ripples.nc") as found:
        assert found["pass"].values.tolist() == ["one:port", "one:starboard"]


def test_cluster_gives_the_same_bytes(tmp_path):
    from distributed import LocalCluster

    (tmp_path / "a").mkdir()
    one = small_survey(tmp_path / "a")
    run(one)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        survey = sasmap.load_survey(one)
        outcome = run_survey(survey, output=tmp_path / "b", scheduler=cluster.scheduler_address)
    assert outcome.computed == 6
    assert products(tmp_path / "a" / "out") == products(tmp_path / "b")


def test_a_cell_seen_from_both_sides_counts_both(tmp_path):
    # the track runs through the cell; each side shows a fifth of it, both together more
    path = small_survey(tmp_path, window=60)
    values = np.full((60, 60), np.nan, "float32")
    values[:, 18:42] = np.random.default_rng(1).rayleigh(1, (60, 24))
    corner = Affine(0.5, 0, 499985.0, 0, -0.5, 3300024.0)
    write_tile(tmp_path / "tiles" / "a.tif", values, corner, nodata=float("nan"))
    path.write_text(path.read_text().replace("starboard", "both"))
    run(path)
    assert read(tmp_path / "out", "ripple_quality.tif")[0].tolist() != [[6]]


def test_where_inputs_lie_does_not_change_the_products(tmp_path):
    (tmp_path / "a").mkdir()
    path = small_survey(tmp_path / "a")
    run(path)
    before = products(tmp_path / "a" / "out")
    path.write_text(
        path.read_text().replace("tiles/*.tif", str(tmp_path / "a" / "tiles" / "a.tif"))
    )
    assert run(path).kept == 6
    assert products(tmp_path / "a" / "out") == before


def test_a_shifted_track_is_not_mistaken_for_the_old_one(tmp_path):
    path = small_survey(tmp_path)
    run(path)
    shifted = "+proj=tmerc +lon_0=-81 +k=0.9996 +x_0=499998 +datum=WGS84"
    text = path.read_text().replace(
        "side: starboard", f"side: starboard\n  navigation_crs: {shifted}"
    )
    path.write_text(text)
    assert run(path).computed == 6


def test_products_of_an_earlier_run_are_named(tmp_path, caplog):
    path = small_survey(tmp_path)
    run(path)
    path.write_text(path.read_text().replace("ripples: {}", "sediments: {}"))
    run(path)
    assert "ripple_height.tif" in caplog.text
