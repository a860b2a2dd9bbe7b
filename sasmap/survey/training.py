"""Polygons that show what sediments look like: read, checked, laid on the map's pixels."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize
from shapely.geometry.base import BaseGeometry

from sasmap.config import ClassSettings, Survey
from sasmap.errors import InputError
from sasmap.survey.cells import Cell, CellGrid
from sasmap.survey.polygons import EXPECTED, on_tiles, read_polygons


class Training(NamedTuple):
    """Where a class is known to lie.

    Attributes
    ----------
    name : str
    path : Path
    area : shapely geometry
        Polygons, in the survey's CRS.
    """

    name: str
    path: Path
    area: BaseGeometry


def read_training(survey: Survey, grid: CellGrid) -> tuple[Training, ...]:
    """Read the training polygons that a survey names; none where it names none.

    Parameters
    ----------
    survey : Survey
    grid : CellGrid

    Returns
    -------
    tuple of Training

    Raises
    ------
    InputError
        Where a file is missing, holds no polygons or none on the grid, or where polygons of two
        classes overlap.
    """
    classes = survey.sediments.classes if survey.sediments is not None else ()
    if not isinstance(classes, tuple):
        return ()
    found: list[Training] = []
    faults: list[str] = []
    for settings in classes:
        try:
            found.append(_read(survey.resolve(settings.training), settings, grid))
        except InputError as error:
            faults.extend(error.faults)
    for i, one in enumerate(found):
        for other in found[:i]:
            if one.area.intersection(other.area).area > 0:
                faults.append(
                    f"{one.path}: polygons of {one.name!r} overlap those of "
                    f"{other.name!r} in {other.path}"
                )
    if faults:
        raise InputError(faults)
    return tuple(found)


def _read(path: Path, settings: ClassSettings, grid: CellGrid) -> Training:
    area = read_polygons(path, grid, f"{EXPECTED} for class {settings.name!r}")
    if not on_tiles(area, grid):
        raise InputError(f"{path}: no polygon of it lies on the survey's tiles")
    return Training(settings.name, path, area)


def cells_shown(training: tuple[Training, ...], grid: CellGrid) -> list[Cell]:
    """Cells that training polygons meet, row by row."""
    found = set()
    for one in training:
        left, bottom, right, top = one.area.bounds
        first = max(int((left - grid.left) // grid.size), 0)
        upper = max(int((grid.top - top) // grid.size), 0)
        last = min(int((right - grid.left) // grid.size), grid.columns - 1)
        lower = min(int((grid.top - bottom) // grid.size), grid.rows - 1)
        prepared = one.area
        shapely.prepare(prepared)
        for row in range(upper, lower + 1):
            for column in range(first, last + 1):
                if prepared.intersects(shapely.box(*grid.bounds(Cell(row, column)))):
                    found.add(Cell(row, column))
    return sorted(found)


def marked(
    training: tuple[Training, ...], grid: CellGrid, cell: Cell, window: int
) -> NDArray[np.uint8]:
    """Classes that training polygons show on a cell's pixels.

    Parameters
    ----------
    training : tuple of Training
    grid : CellGrid
    cell : Cell
    window : int
        Pixels a side of the cell.

    Returns
    -------
    ndarray of uint8 (window, window)
        1 for the first class, 0 where none is shown.
    """
    place: Affine = grid.pixels(window) @ Affine.translation(
        cell.column * window, cell.row * window
    )
    square = shapely.box(*grid.bounds(cell))
    shapes = [(one.area, k) for k, one in enumerate(training, 1) if one.area.intersects(square)]
    if not shapes:
        return np.zeros((window, window), np.uint8)
    laid = rasterize(shapes, (window, window), fill=0, transform=place, dtype="uint8")
    return np.asarray(laid, np.uint8)
