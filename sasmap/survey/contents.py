"""Checks of a tile's contents: undeclared fill, and values that cannot be amplitude.

The whole tile is read once for its fill, and a sample of windows for its values.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import rasterio

from sasmap.arrays import FloatArray
from sasmap.survey.amplitude import judge
from sasmap.survey.fill import find_fill
from sasmap.survey.lattice import Window
from sasmap.survey.sidecars import unread
from sasmap.survey.tiles import Tile, open_geotiff, read_numbers

# Side in pixels of the windows whose values are checked, and windows along each side of the tile:
# 36 windows give over 2000 blocks.
SIDE, WINDOWS = 128, 6
# Largest harmless error of a compression, relative to the median: uniform over twice its size, it
# adds under 1 % to the variance of speckle.
LARGEST_LOSS = 0.05


def look_into(tile: Tile) -> tuple[Tile, list[str], list[str]]:
    """Find a tile's fill and check its values.

    Parameters
    ----------
    tile : Tile

    Returns
    -------
    tile : Tile
        With its fill.
    warnings, faults : list of str
        A line each.
    """
    warnings = list(unread(tile.path, tile.lattice.transform))
    faults: list[str] = []
    try:
        # the whole tile is read: its blocks are decoded on all cores
        with open_geotiff(tile.path, GDAL_NUM_THREADS="ALL_CPUS") as source:
            fill, border = find_fill(source, tile.kind)
            tile = replace(tile, fill=fill)
            lossy, largest = _loss(source)
    except rasterio.errors.RasterioError:
        return tile, warnings, faults  # undecodable blocks fail their cells, and are reported there
    for area in tile.fill:
        share = area.area / (tile.window.height * tile.window.width)
        warnings.append(
            f"{tile.path}: {share:.0%} of it, at its edge, is exactly {area.value:g}: no nodata "
            f"value or mask covers it: treated as no data; declare it, for example "
            f"gdal_edit.py -a_nodata {area.value:g} {tile.path.name}"
        )
    if border:
        warnings.append(
            f"{tile.path}: {border}, unlike shadow or water: compressed or resampled fill "
            f"counts as sea floor; set it to nodata, for example nearblack -nb 0 "
            f"-near 10 -o clean.tif {tile.path.name} and gdal_edit.py -a_nodata 0 clean.tif"
        )
    sample = list(_sample(tile))
    if lossy and (largest is None or largest > LARGEST_LOSS * _typical(sample)):
        warnings.append(f"{tile.path}: {lossy} compression changes speckle; export it lossless")
    for verdict in judge(sample, tile.kind):
        text = f"{tile.path}: {verdict.text}"
        (faults if verdict.refused else warnings).append(text)
    return tile, warnings, faults


def _loss(source: rasterio.DatasetReader) -> tuple[str, float | None]:
    """Name a lossy compression, and its maximum error where known; empty if it is lossless."""
    told = source.tags(ns="IMAGE_STRUCTURE")
    name = told.get("COMPRESSION", "")
    if "LERC" in name:
        error = float(told.get("MAX_Z_ERROR", 0.0))
        return ("LERC" if error > 0 else "", error)
    lossy = "JPEG" in name or told.get("COMPRESSION_REVERSIBILITY", "").startswith("LOSSY")
    return (name.removeprefix("YCbCr ") if lossy else "", None)


def _typical(sample: list[FloatArray]) -> float:
    """Median magnitude of a sample."""
    values = np.concatenate([piece[np.isfinite(piece)] for piece in sample] or [np.empty(0)])
    return float(np.median(np.abs(values))) if values.size else 0.0


def _sample(tile: Tile) -> Iterator[FloatArray]:
    """Read windows spread over a tile, row by row so that strips are decoded once."""
    for window in sample_windows(tile.window):
        try:
            yield np.asarray(read_numbers(tile, window), float)
        except OSError:
            continue  # an undecodable block fails its cells, not the survey


def sample_windows(whole: Window) -> Iterator[Window]:
    """Spread windows over a tile; they cover a small tile completely.

    Parameters
    ----------
    whole : Window
        All of the tile's pixels.

    Yields
    ------
    Window
        Of at most SIDE by SIDE pixels.
    """
    for row in _starts(whole.height):
        for column in _starts(whole.width):
            height, width = min(SIDE, whole.height - row), min(SIDE, whole.width - column)
            yield Window(row, column, height, width)


def _starts(length: int) -> list[int]:
    if length <= SIDE * WINDOWS:
        return list(range(0, length, SIDE))
    return [k * (length - SIDE) // (WINDOWS - 1) for k in range(WINDOWS)]
