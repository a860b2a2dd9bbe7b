"""Checks of a tile's bands: one of amplitudes, optionally with alpha, or three of the same grey."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
import rasterio.windows
from rasterio.enums import ColorInterp

from sasmap.errors import InputError

# Side in pixels, and number, of the windows along the tile's diagonal in which colours are compared
# (a choice: a sample is enough, as a colour image has colours nearly everywhere).
SIDE, WINDOWS = 64, 9


def check_bands(path: Path, source: rasterio.DatasetReader) -> None:
    """Check that a tile's first band holds amplitudes, and that other bands add nothing.

    Parameters
    ----------
    path : Path
        Of the tile, for messages.
    source : DatasetReader

    Raises
    ------
    InputError
        For complex pixels, palettes, colours, and bands other than amplitude, alpha or grey.
    """
    kind = source.dtypes[0]
    if np.dtype(kind).kind not in "uif":
        raise InputError(
            f"{path}: expected real amplitudes, got {kind} pixels; write their magnitude"
        )
    colours = list(source.colorinterp)
    if colours[0] == ColorInterp.palette and not _grey_palette(source):
        raise InputError(
            f"{path}: its values are indices into a colour palette: expected amplitudes; export "
            "the data, not the picture"
        )
    bands = [c for c in colours if c != ColorInterp.alpha]
    if len(bands) == 1 and colours[0] != ColorInterp.alpha:
        return
    rgb = bands == [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    if not rgb:
        raise InputError(
            f"{path}: expected a single amplitude band, got {source.count} bands; extract the "
            "right "
            f"one, for example gdal_translate -b 1 {path.name} amplitude.tif"
        )
    if not _grey(path, source):
        raise InputError(
            f"{path}: a colour image: expected a single band of amplitudes, or the same grey "
            "in red, green and blue; export the data, not the picture"
        )


def _grey_palette(source: rasterio.DatasetReader) -> bool:
    """Whether a palette shows each value as the grey of that value."""
    try:
        palette = source.colormap(1)
    except ValueError:
        return True
    return all(red == green == blue == value for value, (red, green, blue, _) in palette.items())


def _grey(path: Path, source: rasterio.DatasetReader) -> bool:
    """Whether red, green and blue are equal, along the tile's diagonal."""
    for k in range(WINDOWS):
        row = k * max(source.height - SIDE, 0) // (WINDOWS - 1)
        column = k * max(source.width - SIDE, 0) // (WINDOWS - 1)
        window = rasterio.windows.Window(
            column, row, min(SIDE, source.width), min(SIDE, source.height)
        )
        try:
            red, green, blue = source.read((1, 2, 3), window=window)
        except rasterio.errors.RasterioError:
            continue  # an undecodable block fails its cells, not the survey
        if not (np.array_equal(red, green) and np.array_equal(red, blue)):
            return False
    return True
