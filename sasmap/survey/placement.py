"""Resampling of a clip's values to the pixels of its cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.ripples.clip import Clip
from sasmap.ripples.image import lattice
from sasmap.survey.cells import Cell, CellGrid

# Deviation, pixels, up to which a clip's lattice counts as parallel to the cell's.
STRAIGHT = 0.05


def on_cell(
    clip: Clip, model: FloatArray, grid: CellGrid, cell: Cell, window: int
) -> NDArray[np.float32]:
    """Resample values on a clip's lattice to the pixels of its cell by nearest neighbour.

    Parameters
    ----------
    clip : Clip
    model : ndarray (..., rows, columns)
        Modelled amplitude, or other values, on the clip's lattice.
    grid : CellGrid
    cell : Cell
    window : int
        Side of the cell in pixels.

    Returns
    -------
    ndarray (..., window, window)
        NaN where the clip has no model.
    """
    step = grid.size / window
    left, _, _, top = grid.bounds(cell)
    x = left + step * (np.arange(window) + 0.5)
    y = top - step * (np.arange(window) + 0.5)
    steps, first = lattice(clip)
    result = np.full((*model.shape[:-2], window, window), np.nan, np.float32)
    height, width = model.shape[-2:]
    north_up = np.diag([step, -step])
    if np.abs(steps - north_up).max() * max(height, width) < STRAIGHT * step:  # the usual case
        column, row = (
            np.rint(v).astype(int) for v in ((x - first[0]) / step, (first[1] - y) / step)
        )
        across = (column >= 0) & (column < width)
        down = (row >= 0) & (row < height)
        part = [slice(int(v.argmax()), int(v.argmax() + v.sum())) for v in (down, across)]
        result[..., part[0], part[1]] = model[..., row[down][:, None], column[across]]
        return result
    offset = np.stack(np.broadcast_arrays(x[None, :] - first[0], y[:, None] - first[1]))
    column, row = np.rint(np.einsum("ij,jkl->ikl", np.linalg.inv(steps), offset)).astype(int)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    result[..., inside] = model[..., row[inside], column[inside]]
    return result
