"""Versions compared: sasmap 0.1 and the present one on the same coherent cells.

    python pipelines/studies/versions.py [--quick] [--cells 100] [--against COMMIT]

Draws cells as ``pipelines/ripples/coherent.py`` does, renders them with today's coherent simulator,
and has each version estimate them with its default settings: version 0.1 from its last commit, in a
worktree of its own in a temporary folder. Seconds are wall clock, one cell after another, without
compilation. Writes versions.csv.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from judged import Row, print_table, values, write_rows

from sasmap.simulate import coherent_cell

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "pipelines" / "ripples"))
from coherent import draw_scene  # noqa: E402

# The last commit of version 0.1: the next one begins the new ripple engine. It has no tag.
FIRST_VERSION = "5881555b752684af4a8dd8602dc730dc8c022369"


def write_cells(folder: Path, seeds: range, size: int) -> None:
    """Render cells into a folder, each with its truth."""
    for seed in seeds:
        rng = np.random.default_rng([seed, 1701])
        made = coherent_cell(rng, **draw_scene(rng, size))
        clip = made.clip
        np.savez(
            folder / f"{seed:06d}.npz",
            amplitude=clip.amplitude.astype(np.float32),
            x=clip.x,
            y=clip.y,
            ground_range=clip.ground_range,
            altitude=clip.altitude[0, 0],
            look_azimuth=clip.look_azimuth[0, 0],
            pixel_size=clip.pixel_size,
            seed=seed,
            true_frequency=made.frequency,
            true_height=made.height,
        )


def estimated_by(tree: Path, cells: Path, rows: Path) -> list[Row]:
    """Estimate the cells with the code in a tree."""
    worker = ROOT / "pipelines" / "studies" / "estimate_folder.py"
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    subprocess.run([sys.executable, worker, cells, rows], env=environment, check=True)
    with open(rows, newline="", encoding="utf-8") as stream:
        return [
            {k: v if k == "quality" else float(v) for k, v in row.items()}
            for row in csv.DictReader(stream)
        ]


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three small cells")
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--first", type=int, default=7000, help="seed of the first cell")
    parser.add_argument("--against", default=FIRST_VERSION, help="commit of the other version")
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    size, count = (200, 3) if options.quick else (500, options.cells)
    git = ["git", "-C", str(ROOT), "worktree"]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder, other = Path(name), Path(name) / "other"
        cells = folder / "cells"
        cells.mkdir()
        write_cells(cells, range(options.first, options.first + count), size)
        subprocess.run([*git, "add", "--quiet", "--detach", other, options.against], check=True)
        try:
            for version, tree in ((options.against[:7], other), ("today", ROOT)):
                found = estimated_by(tree, cells, folder / "rows.csv")
                rows += [{"version": version, **row} for row in found]
        finally:
            subprocess.run([*git, "remove", "--force", other], check=True)
    write_rows(options.output / "versions.csv", rows)
    print_table(rows, ("version",))
    for version in dict.fromkeys(row["version"] for row in rows):
        seconds = values([row for row in rows if row["version"] == version], "seconds")
        print(f"seconds per cell, {version}: median {np.median(seconds):.2f}")


if __name__ == "__main__":
    main()
