"""Polygons that show what sediments look like: read, checked, laid on the map's pixels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyogrio
import pyproj
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize
from shapely.geometry.base import BaseGeometry

from sasmap.config import ClassSettings, Survey
from sasmap.errors import InputError, check_file
from sasmap.survey.cells import Cell, CellGrid

MAX_BYTES = 2**27
GEOPACKAGE = b"SQLite format 3\0"
WGS84 = "OGC:CRS84"
POLYGONS = ("Polygon", "MultiPolygon")
EXPECTED = "expected a GeoJSON or GeoPackage of polygons"


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
    check_file(path, f"{EXPECTED} for class {settings.name!r}", MAX_BYTES)
    with open(path, "rb") as stream:
        start = stream.read(len(GEOPACKAGE))
    shapes, crs = _geopackage(path) if start == GEOPACKAGE else _geojson(path)
    shapes = [shape for shape in shapes if shape.geom_type in POLYGONS and not shape.is_empty]
    if not shapes:
        raise InputError(f"{path}: holds no polygons; {EXPECTED}")
    area = shapely.union_all([shapely.make_valid(_moved(s, crs, grid.crs, path)) for s in shapes])
    width, height = grid.columns * grid.size, grid.rows * grid.size
    whole = shapely.box(grid.left, grid.top - height, grid.left + width, grid.top)
    if not area.intersects(whole):
        raise InputError(f"{path}: no polygon of it lies on the survey's tiles")
    return Training(settings.name, path, area)


def _moved(shape: BaseGeometry, crs: pyproj.CRS, wanted: str, path: Path) -> BaseGeometry:
    move = pyproj.Transformer.from_crs(crs, wanted, always_xy=True)
    moved = shapely.transform(shape, move.transform, interleaved=False)
    if not np.isfinite(shapely.get_coordinates(moved)).all():
        raise InputError(f"{path}: coordinates lie outside what the survey's CRS can hold")
    return moved


def _geojson(path: Path) -> tuple[list[BaseGeometry], pyproj.CRS]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        shapes = [shapely.geometry.shape(g) for g in _geometries(content)]
        crs = pyproj.CRS.from_user_input(_crs_name(content))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: {EXPECTED}: {' '.join(str(error).split())}") from None
    except (shapely.errors.ShapelyError, pyproj.exceptions.ProjError) as error:
        raise InputError(f"{path}: {EXPECTED}: {' '.join(str(error).split())}") from None
    return shapes, crs


def _geometries(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Geometries of a GeoJSON object, whatever it is."""
    kind = content["type"]
    if kind == "FeatureCollection":
        return [g for feature in content["features"] for g in _geometries(feature)]
    if kind == "Feature":
        return [] if content["geometry"] is None else _geometries(content["geometry"])
    if kind == "GeometryCollection":
        return [g for part in content["geometries"] for g in _geometries(part)]
    return [content]


def _crs_name(content: dict[str, Any]) -> str:
    """Name the CRS: by default WGS 84 (RFC 7946), else what the older ``crs`` member says."""
    return str(content["crs"]["properties"]["name"]) if content.get("crs") else WGS84


def _geopackage(path: Path) -> tuple[list[BaseGeometry], pyproj.CRS]:
    shapes: list[BaseGeometry] = []
    crs = None
    try:
        for layer, kind in pyogrio.list_layers(path):
            if kind is None:
                continue
            about, _, geometries, _ = pyogrio.raw.read(path, layer=layer, columns=[])
            if about["crs"] is None or (crs is not None and about["crs"] != crs):
                raise InputError(f"{path}: layer {layer!r}: expected polygons of one known CRS")
            crs = about["crs"]
            shapes += [g for g in shapely.from_wkb(geometries) if g is not None]
        if crs is None:
            raise InputError(f"{path}: holds no layer of polygons; {EXPECTED}")
        return shapes, pyproj.CRS.from_user_input(crs)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise InputError(f"{path}: {EXPECTED}: {' '.join(str(error).split())}") from None
    except (shapely.errors.ShapelyError, pyproj.exceptions.ProjError) as error:
        raise InputError(f"{path}: {EXPECTED}: {' '.join(str(error).split())}") from None


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
