"""Polygons of a GeoJSON or GeoPackage file in any CRS, transformed to the survey's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyproj
import shapely
from shapely.geometry.base import BaseGeometry

from sasmap.errors import InputError, check_file
from sasmap.survey.cells import CellGrid

# Largest polygon file that is read, bytes: GDAL holds all of it in memory.
MAX_BYTES = 2**27
GEOPACKAGE = b"SQLite format 3\0"
WGS84 = "OGC:CRS84"
POLYGONS = ("Polygon", "MultiPolygon")
EXPECTED = "expected a GeoJSON or GeoPackage of polygons"


def read_polygons(path: Path, grid: CellGrid, expected: str) -> BaseGeometry:
    """Read the polygons of a file as one geometry in the survey's CRS.

    Parameters
    ----------
    path : Path
    grid : CellGrid
        Has the survey's CRS.
    expected : str
        Expected file, for the message where it is missing.

    Raises
    ------
    InputError
        Where the file is missing, or holds no polygons.
    """
    check_file(path, expected, MAX_BYTES)
    with open(path, "rb") as stream:
        start = stream.read(len(GEOPACKAGE))
    shapes, crs = _geopackage(path) if start == GEOPACKAGE else _geojson(path)
    shapes = [shape for shape in shapes if shape.geom_type in POLYGONS and not shape.is_empty]
    if not shapes:
        raise InputError(f"{path}: holds no polygons; {EXPECTED}")
    return shapely.union_all([shapely.make_valid(_moved(s, crs, grid.crs, path)) for s in shapes])


def on_tiles(area: BaseGeometry, grid: CellGrid) -> bool:
    """Test whether an area meets the rectangle of all tiles.

    Parameters
    ----------
    area : shapely geometry
        In the survey's CRS.
    grid : CellGrid

    Returns
    -------
    bool
    """
    width, height = grid.columns * grid.size, grid.rows * grid.size
    whole = shapely.box(grid.left, grid.top - height, grid.left + width, grid.top)
    return bool(area.intersects(whole))


def _moved(shape: BaseGeometry, crs: pyproj.CRS, wanted: str, path: Path) -> BaseGeometry:
    move = pyproj.Transformer.from_crs(crs, wanted, always_xy=True)
    moved = shapely.transform(shape, move.transform, interleaved=False)
    if not np.isfinite(shapely.get_coordinates(moved)).all():
        raise InputError(f"{path}: coordinates lie outside the domain of the survey's CRS")
    return moved


def _geojson(path: Path) -> tuple[list[BaseGeometry], pyproj.CRS]:
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        shapes = [shapely.geometry.shape(g) for g in _geometries(content)]
        crs = pyproj.CRS.from_user_input(_crs_name(content))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: {EXPECTED}: {' '.join(str(error).split())}") from None
    except (shapely.errors.ShapelyError, pyproj.exceptions.ProjError) as error:
        raise InputError(f"{path}: {EXPECTED}: {' '.join(str(error).split())}") from None
    return shapes, crs


def _geometries(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Geometries of any kind of GeoJSON object."""
    kind = content["type"]
    if kind == "FeatureCollection":
        return [g for feature in content["features"] for g in _geometries(feature)]
    if kind == "Feature":
        return [] if content["geometry"] is None else _geometries(content["geometry"])
    if kind == "GeometryCollection":
        return [g for part in content["geometries"] for g in _geometries(part)]
    return [content]


def _crs_name(content: dict[str, Any]) -> str:
    """Name of the CRS: WGS 84 (RFC 7946) unless there is the older ``crs`` member."""
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
