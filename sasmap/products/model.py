"""The modelled amplitude of a survey as one raster at tile resolution."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.clip import Clip
from sasmap.ripples.image import lattice
from sasmap.survey.cells import Cell, CellGrid

# Pixels by which a clip's lattice may stray from the cell's.
STRAIGHT = 0.05


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
    result = np.full((window, window), np.nan, np.float32)
    north_up = np.diag([step, -step])
    if np.abs(steps - north_up).max() * max(model.shape) < STRAIGHT * step:  # the usual case
        column, row = (
            np.rint(v).astype(int) for v in ((x - first[0]) / step, (first[1] - y) / step)
        )
        across = (column >= 0) & (column < model.shape[1])
        down = (row >= 0) & (row < model.shape[0])
        result[np.ix_(down, across)] = model[np.ix_(row[down], column[across])]
        return result
    offset = np.stack(np.broadcast_arrays(x[None, :] - first[0], y[:, None] - first[1]))
    column, row = np.rint(np.einsum("ij,jkl->ikl", np.linalg.inv(steps), offset)).astype(int)
    inside = (row >= 0) & (row < model.shape[0]) & (column >= 0) & (column < model.shape[1])
    result[inside] = model[row[inside], column[inside]]
    return result


class Mosaic:
    """Modelled amplitudes of all cells as one array; rows are read cell by cell.

    Parameters
    ----------
    models : mapping of (row, column) to str
        Key of each cell's model.
    load : callable
        Returns the model (window, window) under a key.
    shape : tuple of int
        Rows and columns of cells.
    window : int
        Pixels a side of a cell.
    """

    def __init__(
        self,
        models: Mapping[tuple[int, int], str],
        load: Callable[[str], NDArray[np.float32]],
        shape: tuple[int, int],
        window: int,
    ) -> None:
        self._models, self._load, self._window = models, load, window
        self.shape = shape[0] * window, shape[1] * window

    def __getitem__(self, rows: slice) -> NDArray[np.float32]:
        """Read whole rows of pixels."""
        top, bottom, _ = rows.indices(self.shape[0])
        window = self._window
        result = np.full((bottom - top, self.shape[1]), np.nan, np.float32)
        for row in range(top // window, (bottom - 1) // window + 1):
            first = max(row * window, top)
            last = min((row + 1) * window, bottom)
            for column in range(self.shape[1] // window):
                if (row, column) in self._models:
                    model = self._load(self._models[row, column])
                    part = model[first - row * window : last - row * window]
                    where = slice(column * window, (column + 1) * window)
                    result[first - top : last - top, where] = part
        return result
