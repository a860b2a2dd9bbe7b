"""The modelled amplitude of a survey as one raster at tile resolution."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.shutil import copy
from rasterio.windows import Window

from sasmap.products.files import written_whole
from sasmap.ripples.clip import Clip
from sasmap.ripples.image import lattice
from sasmap.survey.cells import Cell, CellGrid


def on_cell(
    clip: Clip, model: NDArray[np.float64], grid: CellGrid, cell: Cell, window: int
) -> NDArray[np.float32]:
    """Take a clip's modelled amplitude to the pixels of its cell, each from its nearest.

    Parameters
    ----------
    clip : Clip
    model : ndarray (rows, columns)
        On the clip's lattice.
    grid : CellGrid
    cell : Cell
    window : int
        Pixels a side of the cell.

    Returns
    -------
    ndarray (window, window)
        NaN where the clip has no model.
    """
    step = grid.size / window
    x = grid.left + cell.column * grid.size + step * (np.arange(window) + 0.5)
    y = grid.top - cell.row * grid.size - step * (np.arange(window) + 0.5)
    steps, first = lattice(clip)
    offset = np.stack(np.broadcast_arrays(x[None, :] - first[0], y[:, None] - first[1]))
    column, row = np.rint(np.einsum("ij,jkl->ikl", np.linalg.inv(steps), offset)).astype(int)
    inside = (row >= 0) & (row < model.shape[0]) & (column >= 0) & (column < model.shape[1])
    result = np.full((window, window), np.nan, np.float32)
    result[inside] = model[row[inside], column[inside]]
    return result


def write_mosaic(
    path: Path,
    models: Mapping[tuple[int, int], str],
    load: Callable[[str], NDArray[np.float32]],
    shape: tuple[int, int],
    window: int,
    grid: CellGrid,
    tags: Mapping[str, str],
    scratch: Path,
) -> None:
    """Write the modelled amplitude of all cells, block by block, as a Cloud-Optimized GeoTIFF.

    Parameters
    ----------
    path : Path
    models : mapping of (row, column) to str
        Key of each cell's model.
    load : callable
        Returns the model (window, window) under a key.
    shape : tuple of int
        Rows and columns of the grid.
    window : int
        Pixels a side of a cell.
    grid : CellGrid
    tags : mapping of str to str
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "height": shape[0] * window,
        "width": shape[1] * window,
        "crs": rasterio.crs.CRS.from_wkt(grid.crs),
        "transform": grid.pixels(window),
        "nodata": float("nan"),
        "tiled": True,
        "compress": "deflate",
        "bigtiff": "if_safer",
    }
    try:
        with (
            rasterio.Env(GDAL_PAM_ENABLED="NO"),
            written_whole(path, scratch) as part,
            written_whole(scratch / "mosaic.gtiff", scratch) as plain,
        ):
            with rasterio.open(plain, "w", **profile) as target:
                target.set_band_description(1, "modelled amplitude")
                target.update_tags(**tags)
                for row in range(shape[0]):
                    for column in range(shape[1]):
                        block = np.full((window, window), np.nan, np.float32)
                        if (row, column) in models:
                            block = load(models[row, column])
                        place = Window(column * window, row * window, window, window)
                        target.write(block, 1, window=place)
            copy(plain, part, driver="COG", compress="deflate", blocksize=512, num_threads=1)
    except rasterio.errors.RasterioError as error:
        raise OSError(f"{path}: cannot be written: {error}") from None
    (scratch / "mosaic.gtiff").unlink(missing_ok=True)
