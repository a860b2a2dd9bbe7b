"""Seconds and memory of the sediment stage on recorded texture, which has many small outlines.

    python pipelines/scale/recorded.py --data FOLDER --folder DIR [--megapixels 25]

Recordings are small: the scotsman line, turned upright, and the four snippets, each turned or
mirrored at random, are laid side by side to so many pixels, a survey of sediments alone with an
assumed straight track. Each is run in a process of its own.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import rasterio
import yaml
from affine import Affine
from numpy.typing import NDArray
from rasterio.warp import Resampling, reproject
from scale import run  # type: ignore[import-not-found]

PIXEL, SEED = 0.05, 11
LEFT, TOP, NEAREST, ALTITUDE = 600_000.0, 3_340_000.0, 20.0, 15.0
CRS = "EPSG:32616"
# Mean heading of the scotsman line, degrees, and its last part, which turns: metres left out.
HEADING, LEFT_OUT = 343.0, 6.0


def upright(data: Path) -> NDArray[np.uint16]:
    """Scotsman line with the track up, both sides; 0 where there is no data."""
    sides = []
    for name in ("port", "starboard"):
        with rasterio.open(data / f"scotsman/{name}.tif") as source:
            sides.append((source.read(1), source.transform, source.bounds))
    box = np.array([bounds for _, _, bounds in sides])
    centre = (box[:, 0].min() + box[:, 2].max()) / 2, (box[:, 1].min() + box[:, 3].max()) / 2
    size = 1400
    place = Affine.translation(*centre) @ Affine.rotation(-HEADING) @ Affine.scale(PIXEL, -PIXEL)
    place = place @ Affine.translation(-size / 2, -size / 2)
    both = np.zeros((size, size), np.uint16)
    for values, transform, _ in sides:
        turned = np.zeros_like(both)
        reproject(
            values, turned, src_transform=transform, src_crs="EPSG:32619", dst_transform=place,
            dst_crs="EPSG:32619", resampling=Resampling.nearest,
        )  # fmt: skip
        both = np.maximum(both, turned)
    # the largest part whose rows and columns are mostly known
    rows, columns = ((both > 0).mean(axis=axis) for axis in (1, 0))
    there = both[rows > 0.4 * rows.max()][:, columns > 0.5 * columns.max()]
    return np.ascontiguousarray(there)


def line(data: Path, side: int) -> NDArray[np.uint16]:
    """Scotsman line, mirrored to and fro."""
    whole = upright(data)
    return np.pad(whole, [(0, max(side - n, 0)) for n in whole.shape], "symmetric")[:side, :side]


def quilt(data: Path, side: int) -> NDArray[np.uint16]:
    """Snippets at random, each mirrored at random."""
    random = np.random.default_rng(SEED)
    pieces = []
    for name in ("02", "17", "20", "31"):
        with rasterio.open(data / f"sassed/snippet_{name}.tif") as source:
            pieces.append(source.read(1).astype(np.uint16))
    height, width = pieces[0].shape
    rows = []
    for _ in range(-(-side // height)):
        # larger patches than one snippet: real beds are larger
        chosen = [pieces[random.integers(4)] for _ in range(-(-side // (2 * width)))]
        flips = [p[:: random.choice((1, -1)), :: random.choice((1, -1))] for p in chosen]
        rows.append(np.hstack([np.hstack([p, p[:, ::-1]]) for p in flips])[:, :side])
    return np.vstack(rows)[:side]


def survey_of(name: str, values: NDArray[np.uint16], folder: Path) -> Path:
    """Write a tile, its navigation and a survey of its sediments; returns the survey file."""
    folder = folder / name
    folder.mkdir(parents=True, exist_ok=True)
    rows, columns = values.shape
    place = Affine(PIXEL, 0, LEFT + NEAREST, 0, -PIXEL, TOP)
    profile = {"driver": "GTiff", "height": rows, "width": columns, "count": 1, "nodata": 0}
    with rasterio.open(
        folder / "tile.tif", "w", **profile, dtype="uint16", crs=CRS, transform=place, tiled=True
    ) as target:
        target.write(values, 1)
    steps = np.arange(TOP - rows * PIXEL - 5, TOP + 5, 0.5)
    told = [f"{i},{LEFT},{y},0.0,{ALTITUDE}" for i, y in enumerate(steps)]
    path = folder / "navigation.csv"
    path.write_text("\n".join(["ping,x,y,heading,altitude", *told]), encoding="utf-8")
    look = {
        "name": "line",
        "tiles": ["tile.tif"],
        "navigation": "navigation.csv",
        "side": "starboard",
    }
    content = {"name": name, "window": 500, "passes": [look], "sediments": {}}
    path = folder / "survey.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def main() -> None:
    """Lay, run and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--megapixels", type=float, default=25.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--lay-only", action="store_true")
    options = parser.parse_args()
    side = round(np.sqrt(options.megapixels * 1e6))
    for name, lay in (("line", line), ("quilt", quilt)):
        survey = survey_of(name, lay(options.data.resolve(), side), options.folder.resolve())
        if options.lay_only:
            continue
        found = run(survey, options.folder / "out", options.workers)
        taken = found["stages"]["sediments"]
        print(
            f"{name:8s} {side**2 / 1e6:5.1f} Mpx: sediments {taken:.1f} s, "
            f"{1e6 * taken / side**2:.2f} s a Mpx; {found['classes']} classes; "
            f"whole run {found['cpu']:.0f} s of CPU, {found['memory_MB']:.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    sys.exit(main())
