"""From a raw line to tiles: a worked example of preparing sasmap's input.

    python pipelines/raw_line.py --output DIR && sasmap run DIR/survey.yaml

A raw line is pings by samples of amplitude over slant range, with each ping's position, heading and
altitude, as sonar libraries read them from XTF or JSF. Here one is made from the sample survey;
what follows is what you would do with your own:

1. bring the samples from slant to ground range: ground = sqrt(slant^2 - altitude^2);
2. place them on the map: position of the ping + ground range along its beam;
3. give each pixel of a grid the sample that is nearest (do not average: speckle must keep its
   statistics), none where the nearest is farther than a pixel's diagonal;
4. write amplitude (linear, not dB) as a GeoTIFF with nodata, and the pings as CSV.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio
import yaml
from affine import Affine
from scipy.spatial import cKDTree

ROOT = Path(__file__).resolve().parents[1]
CRS, PIXEL = "EPSG:32617", 0.025


class RawLine(NamedTuple):
    """Pings of one side: amplitude (pings, samples), slant range (samples,), and the track."""

    amplitude: np.ndarray
    slant_range: np.ndarray
    x: np.ndarray
    y: np.ndarray
    heading: np.ndarray
    altitude: np.ndarray


def raw_line() -> RawLine:
    """Return a raw line; yours comes from a file. This one looks at the sample's near tile."""
    with rasterio.open(ROOT / "sample_data" / "near" / "near_r0_c0.tif") as source:
        values, transform = source.read(1).astype(float), source.transform
    with open(ROOT / "sample_data" / "near.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    track = {k: np.array([float(r[k]) for r in rows]) for k in ("x", "y", "heading", "altitude")}
    at = np.arange(0, len(rows) - 1, PIXEL / 0.5)  # a ping every pixel along the track
    x, y, altitude = (np.interp(at, range(len(rows)), track[k]) for k in ("x", "y", "altitude"))
    heading = np.full(x.size, track["heading"][0])
    slant = np.sqrt((8.0 + PIXEL * np.arange(1500)) ** 2 + 5.0**2)
    ground = np.sqrt(slant**2 - altitude[:, None] ** 2)
    beam = np.radians(heading + 90)[:, None]  # starboard
    column, row = ~transform @ (
        x[:, None] + ground * np.sin(beam),
        y[:, None] + ground * np.cos(beam),
    )
    row, column = np.floor(row).astype(int), np.floor(column).astype(int)
    inside = (row >= 0) & (row < values.shape[0]) & (column >= 0) & (column < values.shape[1])
    amplitude = np.zeros(ground.shape)
    amplitude[inside] = values[row[inside], column[inside]]
    return RawLine(amplitude, slant, x, y, heading, altitude)


def gridded(line: RawLine, side: int = 90) -> tuple[np.ndarray, Affine]:
    """Lay a raw line on a north-up grid; `side` is 90 for starboard and -90 for port."""
    square = line.slant_range**2 - line.altitude[:, None] ** 2
    ground = np.sqrt(np.where(square > 0, square, np.nan))  # NaN: water column
    beam = np.radians(line.heading + side)[:, None]
    x, y = line.x[:, None] + ground * np.sin(beam), line.y[:, None] + ground * np.cos(beam)
    seen = np.isfinite(ground) & (line.amplitude > 0)
    places = np.column_stack([x[seen], y[seen]])
    left, top = places[:, 0].min(), places[:, 1].max()
    columns, rows = (int(np.ceil(v / PIXEL)) for v in np.ptp(places, axis=0))
    transform = Affine(PIXEL, 0, left, 0, -PIXEL, top)
    centres = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), -1)
    wanted = np.array([left, top]) + centres.reshape(-1, 2) * [PIXEL, -PIXEL]
    away, nearest = cKDTree(places).query(wanted, distance_upper_bound=1.5 * PIXEL)
    found = np.append(line.amplitude[seen], 0.0)[nearest]
    return np.where(np.isfinite(away), found, 0.0).reshape(rows, columns), transform


def main() -> None:
    """Write tile, navigation and survey file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    folder = parser.parse_args().output
    folder.mkdir(parents=True, exist_ok=True)
    line = raw_line()
    values, transform = gridded(line)
    with rasterio.open(
        folder / "line.tif", "w", driver="GTiff", dtype="uint8", count=1, nodata=0, crs=CRS,
        height=values.shape[0], width=values.shape[1], transform=transform, tiled=True,
        compress="deflate",
    ) as target:  # fmt: skip
        target.write(values.clip(0, 255).astype("uint8"), 1)
    with open(folder / "line.csv", "w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(("ping", "x", "y", "heading", "altitude"))
        rows.writerows(zip(range(line.x.size), *line[2:], strict=True))
    survey = {
        "name": "a raw line",
        "passes": [
            {"name": "line", "tiles": ["line.tif"], "navigation": "line.csv", "side": "starboard"}
        ],
        "ripples": {},
        "sediments": {},
    }
    (folder / "survey.yaml").write_text(yaml.safe_dump(survey, sort_keys=False), encoding="utf-8")
    print(f"wrote {folder / 'survey.yaml'}: {values.shape[0]} x {values.shape[1]} pixels")


if __name__ == "__main__":
    main()
