"""The modelled amplitude of a survey as one raster at tile resolution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


class ModelledAmplitude:
    """Modelled amplitudes of all cells as one array, read by rows of cells.

    Parameters
    ----------
    load : callable
        ``load(row, column)`` gives a cell's modelled amplitude (window, window), or None.
    shape : tuple of int
        Rows and columns of cells.
    window : int
        Side of a cell in pixels.
    """

    def __init__(
        self,
        load: Callable[[int, int], NDArray[np.float32] | None],
        shape: tuple[int, int],
        window: int,
    ) -> None:
        self._load, self._window = load, window
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
                model = self._load(row, column)
                if model is not None:
                    part = model[first - row * window : last - row * window]
                    where = slice(column * window, (column + 1) * window)
                    result[first - top : last - top, where] = part
        return result
