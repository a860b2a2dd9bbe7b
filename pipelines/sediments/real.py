"""Sediment boundaries of real recordings, drawn over them.

    python pipelines/sediments/real.py --data FOLDER --output DIR

Runs the four SASSED snippets (assumed geometry) and the scotsman line through `sasmap run`,
and draws boundaries (with their 95 % interval as a band) over the amplitude, and classes beside it.
Needs matplotlib.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pyogrio
import rasterio
import shapely
import yaml

from sasmap.cli import main as sasmap

SURVEYS = {
    **{
        f"snippet_{k}": ([f"sassed/snippet_{k}.tif"], "sassed/navigation.csv", "starboard", 160)
        for k in ("02", "17", "20", "31")
    },
    "scotsman": (
        ["scotsman/port.tif", "scotsman/starboard.tif"], "scotsman/navigation.csv", "both", 200,
    ),
}  # fmt: skip


def survey_of(name: str, data: Path, output: Path) -> Path:
    """Write a survey file; returns its path."""
    tiles, navigation, side, window = SURVEYS[name]
    content = {
        "name": name,
        "output": str(output / name),
        "window": window,
        "passes": [
            {
                "name": "line",
                "tiles": [str(data / tile) for tile in tiles],
                "navigation": str(data / navigation),
                "side": side,
            }
        ],
        "ripples": {"frequency": [0.2, 4], "height": [0, 0.3]},
        "sediments": {},
    }
    path = output / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def draw(name: str, data: Path, output: Path) -> None:
    """Draw amplitude, boundaries over it, and classes."""
    folder = output / name
    with rasterio.open(folder / "sediment_class.tif") as source:
        label, bounds, colours = source.read(1), source.bounds, source.colormap(1)
    extent = (bounds.left, bounds.right, bounds.bottom, bounds.top)
    _, (left, right) = plt.subplots(1, 2, figsize=(18, 9))
    for tile in SURVEYS[name][0]:
        with rasterio.open(data / tile) as source:
            values = source.read(1, masked=True).astype(float).filled(np.nan)
            box = source.bounds
        top = np.nanquantile(values, 0.99)
        place = (box.left, box.right, box.bottom, box.top)
        left.imshow(values, cmap="gray", vmax=top, extent=place)
    _, _, shapes, fields = pyogrio.raw.read(folder / "sediment_boundaries.gpkg")
    for shape, sd in zip(shapely.from_wkb(shapes), fields[2], strict=True):
        left.plot(*shape.xy, color="tab:orange", lw=1.2)
        for part in getattr(shape.buffer(1.96 * sd), "geoms", [shape.buffer(1.96 * sd)]):
            left.fill(*part.exterior.xy, color="tab:orange", alpha=0.25, lw=0)
    picture = np.array([colours[k] for k in range(256)], float)[label] / 255
    right.imshow(picture, extent=extent)
    left.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
    plt.tight_layout()
    plt.savefig(output / f"{name}.png", dpi=70)


def main() -> None:
    """Run and draw each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--only", choices=SURVEYS, nargs="*", default=list(SURVEYS))
    options = parser.parse_args()
    data, output = options.data.resolve(), options.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        status = sasmap(["run", str(survey_of(name, data, output)), "--quiet"])
        print(f"{name}: exit status {status}, {output / name}.png")
        draw(name, data, output)


if __name__ == "__main__":
    main()
