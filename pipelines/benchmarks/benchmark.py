"""Ratios of sasmap's run times to those of other work on the same machine, with a history.

    python pipelines/benchmarks/benchmark.py [--quick] [--repeats 3] [--history FILE]

Seconds differ from machine to machine; ratios to work of the same kind in the same run differ less.
Each is the least of some repeats over the least of the other's:

- first look: opening and checking the sample survey over GDAL reading its tiles;
- run: `sasmap run` of the sample with one thread over GDAL reading and rewriting its tiles;
- simulate: simulating the sample's scene over GDAL writing as many random pixels;
- sampler: seconds per effective sample of sasmap's sampler over those of emcee, both on the log
  posterior of one clip; emcee starts from sasmap's draws (needs the extra `studies`);
- estimate: the default estimate of a clip over the published sampler on its row means;
- cell: the estimate of coherent cells over that of version 0.1, from its last commit (not with
  --quick: the other version compiles anew).

A row with date, version, commit, cores and ratios is appended to the history, a CSV file. What is
more than 1.3 times the median of earlier rows of machines with as many cores is marked as slower:
the scatter between repeats is smaller.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import importlib.util
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio

import sasmap
from sasmap.cli import main as command
from sasmap.ripples import Clip, RippleSettings, diagnostics, estimate, estimation
from sasmap.simulate import coherent_cell, load_scene, simulate
from sasmap.survey.opening import open_survey
from sasmap.version import VERSION

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_data"
# Ratio to earlier rows from which a benchmark is called slower: above the scatter of repeats.
SLOWER = 1.3
# Walkers and steps of emcee per sampled coordinate and in all.
WALKERS, STEPS = 4, 1500


class Times(NamedTuple):
    """Seconds of the work and of its reference."""

    seconds: float
    reference: float


def least(call: Callable[[Path], object], repeats: int) -> float:
    """Return the least time of some repeats, s, each with a new folder to write into."""
    times = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            call(Path(folder))
            times.append(time.perf_counter() - start)
    return min(times)


def tiles() -> list[Path]:
    """Return the sample's tiles."""
    survey = sasmap.load_survey(SAMPLE / "survey.yaml")
    patterns = [pattern for one in survey.passes for pattern in one.tiles]
    return [path for pattern in patterns for path in sorted(SAMPLE.glob(pattern))]


def read(_: Path) -> None:
    """Read the sample's tiles."""
    for path in tiles():
        with rasterio.open(path) as source:
            source.read(1)


def rewrite(folder: Path) -> None:
    """Read the sample's tiles and write them again."""
    for k, path in enumerate(tiles()):
        with rasterio.open(path) as source:
            values, profile = source.read(), source.profile
        with rasterio.open(folder / f"{k}.tif", "w", **profile) as target:
            target.write(values)


def write_noise(folder: Path) -> None:
    """Write random pixels, as many as the sample's tiles have."""
    rng = np.random.default_rng(1)
    for k, path in enumerate(tiles()):
        with rasterio.open(path) as source:
            profile = source.profile
        values = rng.rayleigh(40.0, (1, profile["height"], profile["width"]))
        with rasterio.open(folder / f"{k}.tif", "w", **profile) as target:
            target.write(np.minimum(values, 255).astype(profile["dtype"]))


def look(_: Path) -> None:
    """Open and check the sample."""
    open_survey(sasmap.load_survey(SAMPLE / "survey.yaml"))


def run(folder: Path) -> None:
    """Run the sample with one thread."""
    names = [str(SAMPLE / "survey.yaml"), "--output", str(folder), "--workers", "1", "--quiet"]
    if command(["run", *names]) != 0:
        raise SystemExit("the sample did not run")


def make(folder: Path) -> None:
    """Simulate the sample's scene."""
    simulate(load_scene(SAMPLE / "scene.yaml"), folder)


def clip() -> Clip:
    """Simulate a cell of straight crests with shadow: 500 x 500 pixels, seed 1."""
    rng = np.random.default_rng(1)
    return coherent_cell(
        rng, frequency=0.6, height=0.07, near=20.0, altitude=5.0, pixel_size=0.025, shape=(500, 500)
    ).clip


def against(work: Callable[[Path], object], reference: Callable[[Path], object]) -> Any:
    """Return a benchmark of one call over another."""

    def measure(repeats: int) -> Times:
        least(work, 1)  # imports and compilation do not count
        return Times(least(work, repeats), least(reference, repeats))

    return measure


def sampler(repeats: int) -> Times | None:
    """Seconds per effective sample of the worst coordinate, of sasmap's sampler and of emcee."""
    if importlib.util.find_spec("emcee") is None:
        return None
    import emcee

    cell, calls = clip(), []
    original = estimation.sample

    def recorded(log_density: Any, *rest: Any) -> Any:
        start = time.perf_counter()
        found = original(log_density, *rest)
        calls.append((log_density, found[0].draws, time.perf_counter() - start))
        return found

    estimation.sample = recorded
    try:
        for _ in range(repeats + 1):  # the first compiles
            estimate(cell, rng=1)
    finally:
        estimation.sample = original
    log_density, draws, _ = calls[0]
    seconds = min(each[2] for each in calls[1:])
    size = draws.shape[-1]
    start = draws.reshape(-1, size)[:: max(draws[..., 0].size // (WALKERS * size), 1)]
    ensemble = emcee.EnsembleSampler(WALKERS * size, size, log_density, vectorize=True)
    ensemble.random_state = np.random.RandomState(1).get_state()
    state = ensemble.run_mcmc(start[: WALKERS * size], 2)  # compiles
    ensemble.reset()
    before = time.perf_counter()
    ensemble.run_mcmc(state, STEPS)
    spent = time.perf_counter() - before
    chains = np.swapaxes(ensemble.get_chain(), 0, 1)
    return Times(seconds / effective(draws), spent / effective(chains))


def effective(draws: np.ndarray) -> float:
    """Bulk effective sample size of the worst coordinate of draws (chain, draw, size)."""
    return min(diagnostics.ess_bulk(draws[..., k]) for k in range(draws.shape[-1]))


def published(repeats: int) -> Times:
    """Estimate a clip by default and by the published method."""
    cell, old = clip(), RippleSettings(method="zare-cobb")
    return against(lambda _: estimate(cell, rng=1), lambda _: estimate(cell, old, rng=1))(repeats)


def first_version(repeats: int) -> Times | None:
    """Median seconds of a few coherent cells, by today's code and by version 0.1."""
    sys.path += [str(ROOT / "pipelines" / "studies")]
    import versions

    commit = versions.FIRST_VERSION
    git = ["git", "-C", str(ROOT)]
    if subprocess.run([*git, "cat-file", "-e", commit], check=False).returncode != 0:
        return None
    with tempfile.TemporaryDirectory() as name:
        cells, other = Path(name) / "cells", Path(name) / "other"
        cells.mkdir()
        versions.write_cells(cells, range(7000, 7000 + 2 * repeats), 500)
        subprocess.run([*git, "worktree", "add", "-q", "--detach", other, commit], check=True)
        try:
            times = [
                statistics.median(
                    float(row["seconds"])
                    for row in versions.estimated_by(tree, cells, Path(name) / "rows.csv")
                )
                for tree in (ROOT, other)
            ]
        finally:
            subprocess.run([*git, "worktree", "remove", "--force", other], check=True)
    return Times(*times)


BENCHMARKS: dict[str, Callable[[int], Times | None]] = {
    "first look": against(look, read),
    "run": against(run, rewrite),
    "simulate": against(make, write_noise),
    "sampler": sampler,
    "estimate": published,
    "cell": first_version,
}
COLUMNS = ("date", "version", "commit", "cores", *BENCHMARKS)


def earlier(history: Path, what: str, cores: int) -> float | None:
    """Return the median ratio of earlier rows of machines with as many cores, if any."""
    if not history.exists():
        return None
    with open(history, newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["cores"] == str(cores)]
    found = [float(row[what]) for row in rows if row[what]]
    return statistics.median(found) if found else None


def commit() -> str:
    """Return the checkout's commit, where there is one."""
    asked = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    answer = subprocess.run(asked, capture_output=True, text=True, check=False)
    return answer.stdout.strip() if answer.returncode == 0 else ""


def append(history: Path, row: dict[str, str]) -> None:
    """Append a row to the history."""
    new = not history.exists()
    with open(history, "a", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        if new:
            table.writeheader()
        table.writerow(row)


def main() -> None:
    """Run the benchmarks that are asked for, print their ratios and append them to the history."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one repeat, without version 0.1")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", choices=BENCHMARKS, action="append", help="default: all")
    parser.add_argument("--history", type=Path, default=Path(__file__).with_name("history.csv"))
    args = parser.parse_args()
    cores = os.cpu_count() or 1
    chosen = args.only or [name for name in BENCHMARKS if name != "cell" or not args.quick]
    row = {
        "date": datetime.date.today().isoformat(),
        "version": VERSION,
        "commit": commit(),
        "cores": str(cores),
    }
    for what in chosen:
        times = BENCHMARKS[what](1 if args.quick else args.repeats)
        if times is None:
            print(f"{what}: left out, its reference is not installed or not in the repository")
            continue
        ratio, before = times.seconds / times.reference, earlier(args.history, what, cores)
        row[what] = f"{ratio:.4g}"
        change = "" if before is None else f", {ratio / before:.2f} times the earlier median"
        slower = " SLOWER" if before is not None and ratio > SLOWER * before else ""
        print(
            f"{what}: {times.seconds:.4g} s over {times.reference:.4g} s: {ratio:.4g}{change}"
            f"{slower}",
            flush=True,
        )
    append(args.history, row)


if __name__ == "__main__":
    main()
