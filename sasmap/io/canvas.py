"""Temporary rasters on disk, read and written by slices, so that memory stays bounded."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class Canvas:
    """A raster of zeros on disk whose slices are arrays; threads and processes may share it.

    It is stored in square blocks, so that a slice takes a few reads, not one per row. Its file is
    opened for each slice, because a network file system shows the writes of others only on opening.
    A pickled canvas is the same raster wherever the same folder is visible.

    Parameters
    ----------
    path : Path
        The file, which is removed when the canvas is closed.
    shape : tuple of int
        Rows and columns.
    dtype : str
    block : int
        Side of the blocks in pixels; slices along their edges are fastest.
    """

    def __init__(self, path: Path, shape: tuple[int, int], dtype: str, block: int = 256) -> None:
        self.shape, self.dtype, self._block = shape, np.dtype(dtype), block
        self._across = -(-shape[1] // block)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path.absolute()
        blocks = self._across * -(-shape[0] // block)
        with self._opened(os.O_CREAT | os.O_TRUNC) as file:
            os.ftruncate(file, blocks * block * block * self.dtype.itemsize)

    @contextmanager
    def _opened(self, flags: int = 0) -> Iterator[int]:
        file = os.open(self._path, os.O_RDWR | flags, 0o644)
        try:
            yield file
        finally:
            os.close(file)

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
        """Remove the raster."""
        self._path.unlink(missing_ok=True)

    def _box(self, part: Any) -> tuple[int, int, int, int]:
        rows, columns = part if isinstance(part, tuple) else (part, slice(None))
        top, bottom, _ = rows.indices(self.shape[0])
        left, right, _ = columns.indices(self.shape[1])
        return top, max(bottom, top), left, max(right, left)

    def _parts(self, box: tuple[int, int, int, int]) -> Iterator[tuple[int, slice, slice]]:
        """Blocks that a box meets: number, and rows and columns of the raster in each."""
        top, bottom, left, right = box
        size = self._block
        for i in range(top // size, -(-bottom // size)):
            for j in range(left // size, -(-right // size)):
                rows = slice(max(i * size, top), min((i + 1) * size, bottom))
                columns = slice(max(j * size, left), min((j + 1) * size, right))
                yield i * self._across + j, rows, columns

    def _offset(self, number: int, row: int, column: int) -> int:
        size = self._block
        place = number * size * size + row % size * size + column % size
        return place * self.dtype.itemsize

    def __getitem__(self, part: Any) -> NDArray[Any]:
        """Read a slice of rows, or of rows and columns."""
        box = self._box(part)
        result = np.empty((box[1] - box[0], box[3] - box[2]), self.dtype)
        if result.size == 0:
            return result
        with self._opened() as file:
            for number, rows, columns in self._parts(box):
                height = rows.stop - rows.start
                wanted = height * self._block * self.dtype.itemsize
                raw = os.pread(file, wanted, self._offset(number, rows.start, 0))
                if len(raw) < wanted:
                    raise OSError(f"{self._path}: ends too early")
                values = np.frombuffer(raw, self.dtype).reshape(height, self._block)
                first = columns.start % self._block
                where = slice(rows.start - box[0], rows.stop - box[0])
                across = slice(columns.start - box[2], columns.stop - box[2])
                result[where, across] = values[:, first : first + columns.stop - columns.start]
        return result

    def __setitem__(self, part: Any, values: NDArray[Any]) -> None:
        """Write a slice of rows, or of rows and columns."""
        box = self._box(part)
        every = np.empty((box[1] - box[0], box[3] - box[2]), self.dtype)
        every[:] = values
        with self._opened() as file:
            for number, rows, columns in self._parts(box):
                part = every[
                    rows.start - box[0] : rows.stop - box[0],
                    columns.start - box[2] : columns.stop - box[2],
                ]
                if part.shape[1] == self._block:  # whole rows of the block are contiguous
                    _write(file, part.tobytes(), self._offset(number, rows.start, 0))
                else:
                    for k, row in enumerate(part, rows.start):
                        _write(file, row.tobytes(), self._offset(number, k, columns.start))


def _write(file: int, raw: bytes, offset: int) -> None:
    done = 0
    while done < len(raw):
        done += os.pwrite(file, raw[done:], offset + done)
