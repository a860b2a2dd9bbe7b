"""Kill a run at random instants, resume it, and compare every byte of its products.

    python pipelines/scale/killed.py [--times 100] [--workers 2]

A small survey (ripples, sediments, modelled amplitude) is run once. Then, so many times, a run in
an empty folder is killed (SIGKILL) after a random time, every product under its final name is
compared with the finished one, and the run is resumed to its end and compared again.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import yaml

from sasmap.cli import main as sasmap

SCENE = {
    "name": "killed",
    "seed": 5,
    "origin": [500000, 3300000],
    "size": [30, 20],
    "pixel_size": 0.05,
    "window": 200,
    "sediments": [
        {"name": "sand"},
        {"name": "mud", "level": 0.4, "polygon": [[20, -1], [19, 9], [21, 21], [31, 21], [31, -1]]},
    ],
    "ripples": [
        {"frequency": 0.7, "height": 0.06, "azimuth": 80,
         "polygon": [[-1, -1], [19, -1], [19, 21], [-1, 21]]},
    ],
    "passes": [
        {"name": "near", "heading": 0, "distance": 27, "altitude": 5},
        {"name": "far", "heading": 0, "distance": 40, "altitude": 6},
    ],
}  # fmt: skip
# Differ from run to run by the times in them.
TIMED = ("run.json", "report.html", "sasmap.log")


def contents(folder: Path) -> dict[str, bytes]:
    """Products under their final names, but those that hold times."""
    files = (p for p in folder.iterdir() if p.is_file() and p.name not in TIMED)
    return {p.name: p.read_bytes() for p in files}


def command(survey: Path, output: Path) -> list[str]:
    """Return the command of a quiet run."""
    run = [sys.executable, "-m", "sasmap.cli", "run", str(survey)]
    return [*run, "--output", str(output), "--quiet", "--workers", "1"]


def killed_once(survey: Path, wanted: dict[str, bytes], longest: float, seed: int) -> str:
    """Kill and resume a run; return a fault, or nothing."""
    delay = random.Random(seed).uniform(0.0, longest)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        process = subprocess.Popen(command(survey, output))
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
        left = contents(output) if output.is_dir() else {}
        for name, raw in left.items():
            if wanted.get(name) != raw:
                return f"{delay:.2f} s: {name} was left half-written"
        status = subprocess.run(command(survey, output), check=False).returncode
        found = contents(output)
        differ = sorted(n for n in {*found, *wanted} if found.get(n) != wanted.get(n))
        if status or differ or list(output.rglob("*.part")):
            return f"{delay:.2f} s: exit status {status}; differ: {', '.join(differ)}"
    return ""


def main() -> int:
    """Kill, resume, compare, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        (root / "scene.yaml").write_text(yaml.safe_dump(SCENE), encoding="utf-8")
        sasmap(["simulate", str(root / "scene.yaml"), "--output", str(root)])
        survey = root / "survey.yaml"
        settings = yaml.safe_load(survey.read_text(encoding="utf-8"))
        settings["ripples"]["keep_model"] = True
        survey.write_text(yaml.safe_dump(settings), encoding="utf-8")
        subprocess.run(command(survey, root / "first"), check=True)  # compiles
        start = time.perf_counter()
        subprocess.run(command(survey, root / "whole"), check=True)
        longest = (time.perf_counter() - start) * 1.3  # as many run at once
        wanted = contents(root / "whole")
        print(f"{len(wanted)} products, {longest / 1.3:.1f} s a run", flush=True)
        with ThreadPoolExecutor(options.workers) as pool:
            seeds = range(options.times)
            said = pool.map(lambda k: killed_once(survey, wanted, longest, k), seeds)
            faults = [line for line in said if line]
        print("\n".join(faults))
        print(f"{options.times - len(faults)} of {options.times} complete and the same to the byte")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
