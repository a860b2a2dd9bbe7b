"""A pixel lattice (CRS and affine) and rectangular windows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pyproj
from affine import Affine

from sasmap.arrays import FloatArray
from sasmap.errors import InputError

# Two lattices are the same where their pixels coincide to this fraction of a pixel (far below any
# error of georeferencing, far above rounding).
COINCIDENT = 1e-4


class Window(NamedTuple):
    """Rows and columns [row, row + height) x [column, column + width) of a lattice."""

    row: int
    column: int
    height: int
    width: int

    def intersect(self, other: Window) -> Window:
        """Return the common part, of zero height or width where there is none."""
        row, column = max(self.row, other.row), max(self.column, other.column)
        bottom = min(self.row + self.height, other.row + other.height)
        right = min(self.column + self.width, other.column + other.width)
        return Window(row, column, max(bottom - row, 0), max(right - column, 0))

    @property
    def empty(self) -> bool:
        """Whether no pixel is inside."""
        return self.height <= 0 or self.width <= 0


@dataclass(frozen=True)
class Lattice:
    """A pixel lattice; the upper-left corner of a pixel is ``transform * (column, row)``.

    Parameters
    ----------
    crs : str
        CRS as WKT.
    transform : Affine
        Pixel coordinates (column, row) to map coordinates (x, y); any rotation or shear.
    """

    crs: str
    transform: Affine

    def centres(self, window: Window) -> tuple[FloatArray, FloatArray]:
        """Return map x and y of the pixel centres, each (height, width)."""
        column = window.column + 0.5 + np.arange(window.width, dtype=float)
        row = window.row + 0.5 + np.arange(window.height, dtype=float)[:, None]
        t = self.transform
        return t.c + t.a * column + t.b * row, t.f + t.d * column + t.e * row

    def pixel_of(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return fractional (row, column) of map points in this lattice's CRS."""
        t = ~self.transform
        return t.f + t.d * x + t.e * y, t.c + t.a * x + t.b * y

    def offset_to(self, other: Lattice) -> tuple[int, int] | None:
        """Return (rows, columns) from this lattice's origin to the other's, in whole pixels.

        None where the pixels of the two do not coincide.
        """
        if self.crs != other.crs:
            return None
        a, b = self.transform, other.transform
        size = abs(a.determinant) ** 0.5
        # over a tile of 1e4 pixels a relative difference of 1e-8 stays within COINCIDENT
        steps = ((a.a, b.a), (a.b, b.b), (a.d, b.d), (a.e, b.e))
        if any(abs(p - q) > 1e-8 * size for p, q in steps):
            return None
        row, column = self.pixel_of(np.array(b.c), np.array(b.f))
        whole = round(float(row)), round(float(column))
        if abs(row - whole[0]) > COINCIDENT or abs(column - whole[1]) > COINCIDENT:
            return None
        return whole


def transform_points(
    source: str, target: str, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Transform map points from one CRS to another.

    Parameters
    ----------
    source, target : str
        CRS as WKT.
    x, y : ndarray
        Easting or longitude, and northing or latitude, whatever the order of the CRS's axes.

    Returns
    -------
    x, y : ndarray
        Infinity for points outside the domain of the target CRS.

    Raises
    ------
    InputError
        Where there is no transformation between the two.
    """
    if source == target:
        return x, y
    try:
        transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
        moved_x, moved_y = transformer.transform(x, y)
    except pyproj.exceptions.ProjError:
        names = [pyproj.CRS.from_user_input(crs).name for crs in (source, target)]
        fault = f"no transformation is known from CRS {names[0]!r} to {names[1]!r}"
        raise InputError(fault) from None
    return np.asarray(moved_x, float), np.asarray(moved_y, float)


def outline(window: Window, lattice: Lattice, points: int = 5) -> tuple[FloatArray, FloatArray]:
    """Return map points around a window's edge.

    Parameters
    ----------
    window : Window
    lattice : Lattice
    points : int
        Points per side, corners included.

    Returns
    -------
    x, y : ndarray (4 * points,)
        In the lattice's CRS.
    """
    s = np.linspace(0.0, 1.0, points)
    columns = window.column + window.width * np.concatenate(
        [s, np.ones(points), s, np.zeros(points)]
    )
    rows = window.row + window.height * np.concatenate([np.zeros(points), s, np.ones(points), s])
    t = lattice.transform
    return t.c + t.a * columns + t.b * rows, t.f + t.d * columns + t.e * rows


def bounding_window(row: FloatArray, column: FloatArray) -> Window:
    """Return the smallest window that holds some points.

    Parameters
    ----------
    row, column : ndarray
        Fractional pixels, counted from the pixels' edges.

    Returns
    -------
    Window
        Points within 1e-6 pixel of a pixel's edge do not reach into the next pixel.
    """
    top, left = int(np.floor(row.min() + 1e-6)), int(np.floor(column.min() + 1e-6))
    bottom, right = int(np.ceil(row.max() - 1e-6)), int(np.ceil(column.max() - 1e-6))
    return Window(top, left, max(bottom - top, 0), max(right - left, 0))
