"""Sediment map of the sample survey at several windows, against its truth.

    python pipelines/sediments/windows.py --output DIR [--windows 500 333 250 200 125] [--ripples]

The map should not depend on the cells. Runs the sample's sediments at each window, on request with
ripples, and prints classes, adjusted Rand index and the mapped share of the floor.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import rasterio
import yaml
from numpy.typing import NDArray

from sasmap.cli import main as sasmap

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"


def survey_of(window: int, ripples: bool, output: Path) -> Path:
    """Write the sample's survey file with another window; returns its path."""
    content = yaml.safe_load((SAMPLE / "survey.yaml").read_text(encoding="utf-8"))
    content |= {"window": window, "output": str(output / f"{window}")}
    if not ripples:
        del content["ripples"]
    for look in content["passes"]:
        look["tiles"] = [str(SAMPLE / tile) for tile in look["tiles"]]
        look["navigation"] = str(SAMPLE / look["navigation"])
    path = output / f"sample_{window}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def rand_index(first: NDArray[np.int64], second: NDArray[np.int64]) -> float:
    """Compute the adjusted Rand index."""
    table = np.zeros((first.max() + 1, second.max() + 1))
    np.add.at(table, (first.ravel(), second.ravel()), 1)
    both, rows, columns = (
        float((v * (v - 1) / 2).sum()) for v in (table, table.sum(axis=1), table.sum(axis=0))
    )
    chance = rows * columns / (table.sum() * (table.sum() - 1) / 2)
    most = 0.5 * (rows + columns)
    return 1.0 if most == chance else (both - chance) / (most - chance)


def judged(folder: Path) -> tuple[int, float, float]:
    """Classes of a map, its adjusted Rand index to the truth and the share that is mapped."""
    with rasterio.open(SAMPLE / "truth/sediment_class.tif") as source:
        truth, coarse, box = source.read(1).astype(int), source.transform, source.bounds
    with rasterio.open(folder / "sediment_class.tif") as source:
        place = source.window(*box).round_offsets().round_lengths()
        label = source.read(1, window=place, boundless=True, fill_value=0).astype(int)
        fine = source.transform
    step = round(coarse.a / fine.a)
    truth = np.repeat(np.repeat(truth, step, axis=0), step, axis=1)
    rows, columns = (min(a, b) for a, b in zip(truth.shape, label.shape, strict=True))
    truth, label = truth[:rows, :columns], label[:rows, :columns]
    known = label > 0
    return int(label.max()), rand_index(truth[known], label[known]), float(known.mean())


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--windows", type=int, nargs="*", default=[500, 333, 250, 200, 125])
    parser.add_argument("--ripples", action="store_true")
    options = parser.parse_args()
    output = options.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    for window in options.windows:
        status = sasmap(["run", str(survey_of(window, options.ripples, output)), "--quiet"])
        classes, index, share = judged(output / f"{window}")
        print(
            f"window {window}: exit status {status}, {classes} classes, adjusted Rand index "
            f"{index:.4f}, {share:.1%} mapped",
            flush=True,
        )


if __name__ == "__main__":
    main()
