"""The modelled amplitude of a survey as one raster at tile resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.clip import Clip
from sasmap.ripples.image import lattice
from sasmap.store import Store
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
    keys : mapping of (row, column) to sequence of str or None
        Of each cell's looks; the last one with a model is shown.
    store : Store
    shape : tuple of int
        Rows and columns of cells.
    window : int
        Pixels a side of a cell.
    """

    def __init__(
        self,
        keys: Mapping[tuple[int, int], Sequence[str | None]],
        store: Store,
        shape: tuple[int, int],
        window: int,
    ) -> None:
        self._keys, self._store, self._window = keys, store, window
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
                model = self._model(row, column)
                if model is not None:
                    part = model[first - row * window : last - row * window]
                    where = slice(column * window, (column + 1) * window)
                    result[first - top : last - top, where] = part
        return result

    def _model(self, row: int, column: int) -> NDArray[np.float32] | None:
        for key in reversed(self._keys.get((row, column), ())):
            found = None if key is None else self._store.load_arrays(key, ("model",))
            if found is not None:
                return np.asarray(found[0], np.float32)
        return None
