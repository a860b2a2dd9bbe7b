"""Seconds and memory of whole runs, by pixels, workers, passes and kind of crests.

    python pipelines/scale/scale.py --folder DIR [--megapixels 25 100] [--rows ...]

Simulates `scene.yaml` (whole: 100 Mpx, 400 cells) or its lower left part, once or as four passes,
with straight or bent crests; runs each in a process of its own and prints wall-clock seconds by
stage, CPU seconds, pixels per second and core, and peak memory. `control` runs two processes of one
worker side by side: the largest gain from two on this machine. `gdal` reads and rewrites the same
tiles.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import yaml

from sasmap.cli import main as sasmap

HERE = Path(__file__).resolve().parent
ROWS = ("straight", "bent", "passes", "one worker", "control", "gdal")
# Runs a command and prints its peak memory (kB) and CPU seconds. From a small process: Linux counts
# the memory of the process that starts another one as that one's peak.
LAUNCHER = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:]).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_maxrss, used.ru_utime + used.ru_stime)
sys.exit(status)
"""


def scene_of(megapixels: float, bent: bool, passes: int) -> dict[str, Any]:
    """Scene of so many pixels: whole cells of the lower left part."""
    scene = yaml.safe_load((HERE / "scene.yaml").read_text(encoding="utf-8"))
    cell = scene["window"] * scene["pixel_size"]
    side = round(np.sqrt(megapixels * 1e6) * scene["pixel_size"] / cell) * cell
    scene["size"] = [side, side]
    if bent:
        for patch in scene["ripples"]:
            patch.update(wander=1.2, wander_length=6.0)
    first = scene["passes"][0]
    ways = ((0, "starboard"), (180, "port"), (0, "port"), (180, "starboard"))
    scene["passes"] = [
        {**first, "name": f"pass{k}", "heading": heading, "side": side_, "distance": side / 2 + 20}
        for k, (heading, side_) in enumerate(ways[:passes])
    ]
    return scene


def survey_in(folder: Path, scene: dict[str, Any]) -> Path:
    """Simulate a scene unless that has been done; returns the survey file."""
    path = folder / "scene.yaml"
    text = yaml.safe_dump(scene)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        path.write_text(text, encoding="utf-8")
        if sasmap(["simulate", str(path), "--output", str(folder)]):
            sys.exit(1)
    return folder / "survey.yaml"


def run(survey: Path, output: Path, workers: int) -> dict[str, Any]:
    """Run a survey in a process of its own; return times, memory and cells."""
    shutil.rmtree(output, ignore_errors=True)
    command = [sys.executable, "-m", "sasmap.cli", "run", str(survey), "--output", str(output)]
    command = [sys.executable, "-c", LAUNCHER, *command, "--quiet", "--workers", str(workers)]
    start = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    seconds = time.perf_counter() - start
    memory, cpu = (float(v) for v in done.stdout.splitlines()[-1].split())
    manifest = json.loads((output / "run.json").read_text(encoding="utf-8"))
    shutil.rmtree(output)
    return {
        "status": done.returncode,
        "seconds": seconds,
        "cpu": cpu,
        "memory_MB": memory / 1000,
        "stages": manifest["seconds"],
        "cells": manifest["cells_by_quality"],
        "classes": len(manifest["sediment_classes"]),
    }


def rewritten(survey: Path) -> dict[str, Any]:
    """Read and rewrite a survey's tiles with GDAL."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
    for tile in sorted(survey.parent.glob("pass*/*.tif")):
        with rasterio.open(tile) as source:
            profile, values = source.profile, source.read(1)
        target = survey.parent / "rewritten.tif"
        with rasterio.open(target, "w", **profile) as written:
            written.write(values, 1)
        target.unlink()
    after = resource.getrusage(resource.RUSAGE_SELF)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": time.perf_counter() - start, "cpu": cpu, "memory_MB": 0.0}


def measure(name: str, folder: Path, megapixels: float) -> dict[str, Any]:
    """One row of the table."""
    passes = 4 if name == "passes" else 1
    scene = scene_of(megapixels, name == "bent", passes)
    kind = "bent" if name == "bent" else f"straight{passes}"
    survey = survey_in(folder / f"{kind}_{megapixels:g}", scene)
    output = folder / "out"
    pixels = (scene["size"][0] / scene["pixel_size"]) ** 2 * passes
    plain: dict[str, Callable[[], dict[str, Any]]] = {
        "one worker": lambda: run(survey, output, 1),
        "gdal": lambda: rewritten(survey),
        "control": lambda: _control(survey, folder),
    }
    found = plain.get(name, lambda: run(survey, output, 2))()
    cores = 1 if name in ("one worker", "gdal") else 2
    found["pixels_per_second_and_core"] = pixels * found.pop("runs", 1) / found["seconds"] / cores
    return {"row": name, "Mpx": pixels / 1e6, **found}


def _control(survey: Path, folder: Path) -> dict[str, Any]:
    """Two runs of one worker at once."""
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda k: run(survey, folder / f"out{k}", 1), range(2)))
    return {**both[0], "seconds": max(b["seconds"] for b in both), "runs": 2}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--megapixels", type=float, nargs="*", default=[25.0])
    parser.add_argument("--rows", choices=ROWS, nargs="*", default=ROWS)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    rows = []
    for megapixels in options.megapixels:
        for name in options.rows:
            row = measure(name, options.folder, megapixels)
            rows.append(row)
            stages = ", ".join(f"{k} {v:.1f}" for k, v in row.get("stages", {}).items())
            print(
                f"{row['row']:10s} {row['Mpx']:6.0f} Mpx {row['seconds']:7.1f} s "
                f"(CPU {row['cpu']:.0f}) {row['memory_MB']:6.0f} MB "
                f"{row['pixels_per_second_and_core'] / 1e6:.2f} Mpx/s/core  {stages} "
                f"{row.get('cells', '')} {row.get('classes', '')}",
                flush=True,
            )
    if options.csv:
        names = ("row", "Mpx", "seconds", "cpu", "memory_MB", "pixels_per_second_and_core")
        with open(options.csv, "w", newline="", encoding="utf-8") as stream:
            table = csv.DictWriter(stream, names, extrasaction="ignore")
            table.writeheader()
            table.writerows(rows)


if __name__ == "__main__":
    main()
