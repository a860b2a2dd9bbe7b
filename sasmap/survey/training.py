"""Training polygons of sediment classes: read, checked, rasterised."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize
from shapely.geometry.base import BaseGeometry

from sasmap.errors import InputError
from sasmap.sediments.classes import noise_factor
from sasmap.sediments.training import LEAST_SAMPLES
from sasmap.sediments.trends import AmplitudeGrid
from sasmap.settings.survey import ClassSettings, Survey
from sasmap.survey.cells import Cell, CellGrid
from sasmap.survey.lattice import Window, bounding_window, transform_points
from sasmap.survey.passes import SonarPass, view
from sasmap.survey.polygons import EXPECTED, on_tiles, read_polygons
from sasmap.survey.tiles import Tile, read_tile

# Side in pixels of the pieces in which training pixels are counted: bounds memory.
CHUNK = 512
# Half the side, pixels, of the piece in which the correlation of speckle is estimated.
MIDDLE = 64


class Training(NamedTuple):
    """Training area of a class.

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
    """Read the training polygons that a survey names, if any.

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


def check_shown(
    training: tuple[Training, ...], passes: tuple[SonarPass, ...], grid: CellGrid
) -> None:
    """Check that the tiles show enough of each class, before the run spends hours.

    Parameters
    ----------
    training : tuple of Training
    passes : tuple of SonarPass
    grid : CellGrid

    Raises
    ------
    InputError
        With one line per class that has too few valid pixels.
    """
    faults: list[str] = []
    if not training:
        return
    needed = int(np.ceil(LEAST_SAMPLES * _pixels_a_sample(passes)))
    for one in training:
        shown = 0
        for sonar_pass in passes:
            for tile in sonar_pass.tiles:
                if shown < needed:
                    shown += _shown(one.area, sonar_pass, tile, grid.crs, needed)
        if shown < needed:
            faults.append(
                f"{one.path}: class {one.name!r}: the tiles show {shown} pixels of its polygons: "
                f"expected at least {needed}; draw larger ones, on valid pixels"
            )
    if faults:
        raise InputError(faults)


def _pixels_a_sample(passes: tuple[SonarPass, ...]) -> float:
    """Pixels per independent sample, from the middle of each pass's first tile."""
    looks = []
    for sonar_pass in passes:
        tile = sonar_pass.tiles[0]
        row, column = tile.window.height // 2, tile.window.width // 2
        middle = Window(row - MIDDLE, column - MIDDLE, 2 * MIDDLE, 2 * MIDDLE)
        try:
            part = np.asarray(read_tile(tile, middle.intersect(tile.window)), float)
        except OSError:
            continue
        if np.isfinite(part).any():
            looks.append(AmplitudeGrid(part, np.full_like(part, np.nan)))
    return noise_factor(looks) if looks else 1.0


def _shown(area: BaseGeometry, sonar_pass: SonarPass, tile: Tile, crs: str, needed: int) -> int:
    """Count a tile's valid pixels in an area, up to the needed number."""
    x, y = shapely.get_coordinates(area.envelope).T
    box = bounding_window(*tile.lattice.pixel_of(*transform_points(crs, tile.lattice.crs, x, y)))
    box = box.intersect(tile.window)
    shapely.prepare(area)
    count = 0
    for row in range(box.row, box.row + box.height, CHUNK):
        for column in range(box.column, box.column + box.width, CHUNK):
            part = Window(row, column, CHUNK, CHUNK).intersect(box)
            try:
                valid = np.isfinite(read_tile(tile, part))
            except OSError:
                continue  # an undecodable block fails its cells, not the survey
            if valid.any():
                seen = view(sonar_pass, crs, tile.lattice, part)
                floor = seen.get("ground_x", seen["x"]), seen.get("ground_y", seen["y"])
                valid &= np.isfinite(seen["ground_range"]) & shapely.contains_xy(area, *floor)
                count += int(valid.sum())
            if count >= needed:
                return count
    return count


def cells_shown(training: tuple[Training, ...], grid: CellGrid) -> list[Cell]:
    """Find the cells that training polygons meet, row by row."""
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
    """Rasterise training polygons on a cell's pixels.

    Parameters
    ----------
    training : tuple of Training
    grid : CellGrid
    cell : Cell
    window : int
        Side of the cell in pixels.

    Returns
    -------
    ndarray of uint8 (window, window)
        1 for the first class, 0 outside training polygons.
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
