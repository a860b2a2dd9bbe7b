"""Rasters in the making: on disk, read and written by slices, so that memory does not grow."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

# Bytes read or written at once, about.
CHUNK = 2**24


class Canvas:
    """A raster of zeros on disk whose slices are arrays; threads may share it.

    Parameters
    ----------
    path : Path
        Of the file, which lasts until the canvas is closed.
    shape : tuple of int
        Rows and columns.
    dtype : str
    """

    def __init__(self, path: Path, shape: tuple[int, int], dtype: str) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
        os.ftruncate(self._file, shape[0] * shape[1] * self.dtype.itemsize)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Forget the raster."""
        if self._file >= 0:
            os.close(self._file)
            self._path.unlink(missing_ok=True)
            self._file = -1

    def _box(self, part: Any) -> tuple[int, int, int, int]:
        rows, columns = part if isinstance(part, tuple) else (part, slice(None))
        top, bottom, _ = rows.indices(self.shape[0])
        left, right, _ = columns.indices(self.shape[1])
        return top, max(bottom, top), left, max(right, left)

    def _offset(self, row: int, column: int) -> int:
        return (row * self.shape[1] + column) * self.dtype.itemsize

    def __getitem__(self, part: Any) -> NDArray[Any]:
        """Read a slice of rows, or of rows and columns."""
        top, bottom, left, right = self._box(part)
        result = np.empty((bottom - top, right - left), self.dtype)
        if result.size == 0:
            return result
        if result.shape[1] == self.shape[1]:
            self._fill(result, self._offset(top, 0))
        else:
            for row in range(top, bottom):
                self._fill(result[row - top], self._offset(row, left))
        return result

    def __setitem__(self, part: Any, values: NDArray[Any]) -> None:
        """Write a slice of rows, or of rows and columns."""
        top, bottom, left, right = self._box(part)
        block = np.empty((bottom - top, right - left), self.dtype)
        block[:] = values
        for row in range(top, bottom):
            self._write(block[row - top], self._offset(row, left))

    def _fill(self, result: NDArray[Any], offset: int) -> None:
        buffer = memoryview(result.data).cast("B")
        done = 0
        while done < len(buffer):
            got = os.preadv(self._file, [buffer[done : done + CHUNK]], offset + done)
            if got == 0:
                raise OSError(f"{self._path}: ends too early")
            done += got

    def _write(self, row: NDArray[Any], offset: int) -> None:
        buffer = memoryview(row.data).cast("B")
        done = 0
        while done < len(buffer):
            done += os.pwrite(self._file, buffer[done:], offset + done)
