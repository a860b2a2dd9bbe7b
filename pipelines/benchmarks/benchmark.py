"""Times of sasmap over those of plain reading and writing, appended to a history file.

    python pipelines/benchmarks/benchmark.py [--repeats 3] [--history FILE]

Seconds differ from machine to machine; a ratio to work of the same kind on the same machine does
so less. Each ratio is the least of some repeats of the one over the least of the other:

- first look: opening and checking the sample survey over reading its tiles once;
- run: `sasmap run` of the sample, one thread, over reading its tiles and writing them again;
- simulate: the sample's scene over writing as many random pixels.

A line of CSV is added for each ratio, with date, version and revision. The last column compares
with the median of the lines before (ratio now over ratio then): above 1.3 is a slow-down that the
scatter between repeats does not make.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio

import sasmap
from sasmap.cli import main as command
from sasmap.simulate import load_scene, simulate
from sasmap.survey.opening import open_survey
from sasmap.version import VERSION

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_data"
COLUMNS = ("date", "version", "revision", "what", "seconds", "reference", "ratio", "over_before")


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


BENCHMARKS = {"first look": (look, read), "run": (run, rewrite), "simulate": (make, write_noise)}


def before(history: Path, what: str) -> float | None:
    """Return the median ratio of earlier lines, if there are any."""
    if not history.exists():
        return None
    with open(history, newline="") as stream:
        found = [float(row["ratio"]) for row in csv.DictReader(stream) if row["what"] == what]
    return statistics.median(found) if found else None


def revision() -> str:
    """Return the checkout's revision, where there is one."""
    asked = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    told = subprocess.run(asked, capture_output=True, text=True, check=False)
    return told.stdout.strip() if told.returncode == 0 else ""


def main() -> None:
    """Run the benchmarks that are asked for and append their ratios."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", choices=BENCHMARKS, action="append", help="default: all")
    parser.add_argument(
        "--history", type=Path, default=Path(__file__).with_name("history.csv"),
        help="CSV file that is appended to",
    )  # fmt: skip
    args = parser.parse_args()
    look(Path())  # compilation and imports are no part of a ratio
    for what in args.only or BENCHMARKS:
        work, reference = BENCHMARKS[what]
        if what != "first look":
            least(work, 1)
        seconds, plain = least(work, args.repeats), least(reference, args.repeats)
        ratio, earlier = seconds / plain, before(args.history, what)
        row = (
            datetime.date.today().isoformat(), VERSION, revision(), what, f"{seconds:.3f}",
            f"{plain:.4f}", f"{ratio:.1f}", "" if earlier is None else f"{ratio / earlier:.2f}",
        )  # fmt: skip
        new = not args.history.exists()
        with open(args.history, "a", newline="") as stream:
            lines = csv.writer(stream, lineterminator="\n")
            if new:
                lines.writerow(COLUMNS)
            lines.writerow(row)
        print(*(f"{name} {value}" for name, value in zip(COLUMNS[3:], row[3:], strict=True)))


if __name__ == "__main__":
    main()
