"""Check of a GeoTIFF's georeference: its CRS, or a message with a remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import rasterio
from affine import Affine

from sasmap.errors import InputError
from sasmap.survey.sidecars import WORLD_FILES, beside

PROJECTED = "expected a projected CRS in metres, such as the UTM zone of the survey"


def checked_crs(path: Path, source: rasterio.DatasetReader, geographic: bool) -> str:
    """Return a tile's CRS as WKT.

    Parameters
    ----------
    path : Path
    source : DatasetReader
    geographic : bool
        Whether geographic tiles are accepted because the survey file sets the products' CRS.

    Raises
    ------
    InputError
        Where the tile's georeference cannot be used; says why and what to do.
    """
    if source.gcps[0]:
        raise InputError(_control_points(path, source))
    if source.crs is None:
        raise InputError(_no_crs(path))
    crs = _parsed(path, source)
    _check_kind(path, crs)
    _check_transform(path, source)
    if crs.is_geographic and not geographic:
        raise InputError(
            f"{path}: geographic CRS {crs.name!r}: set the products' CRS in the survey file, for "
            f"example crs: {_utm_of(source)}; its pixels are then moved to their nearest place"
        )
    return str(crs.to_wkt())


def _no_crs(path: Path) -> str:
    start = f"{path}: no CRS: expected a tile georeferenced in a projected CRS"
    files = [file.name for file in beside(path, (*WORLD_FILES, ".aux.xml", ".prj"))]
    if files:
        return (
            f"{start}; {' and '.join(files)} beside it is not read: copy it in: gdal_translate "
            f"-a_srs EPSG:32617 {path.name} placed.tif (with its own CRS)"
        )
    return f"{start}; set the right one, for example gdal_edit.py -a_srs EPSG:32617 {path.name}"


def _parsed(path: Path, source: rasterio.DatasetReader) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_wkt(source.crs.to_wkt())
    except (pyproj.exceptions.ProjError, rasterio.errors.CRSError) as error:
        told = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: CRS that cannot be read ({told}): {PROJECTED}") from None


def _check_kind(path: Path, crs: pyproj.CRS) -> None:
    """Refuse a CRS that does not place pixels on the ellipsoid, or that has heights."""
    edit = f"gdal_edit.py -a_srs EPSG:32617 {path.name}"
    if crs.is_geocentric:
        raise InputError(
            f"{path}: 3-D geocentric CRS {crs.name!r}, whose axes are not on the map: {PROJECTED}; "
            f"warp it, for example gdalwarp -r near -t_srs EPSG:32617 {path.name} utm.tif"
        )
    if crs.is_compound or len(crs.axis_info) > 2:
        flat = crs.to_2d()
        flat = flat.sub_crs_list[0] if flat.is_compound else flat
        code = flat.to_authority()
        name = ":".join(code) if code else "EPSG:32617"
        raise InputError(
            f"{path}: 3-D CRS {crs.name!r}: expected a horizontal CRS without vertical axis; name "
            f"it alone, for example gdal_edit.py -a_srs {name} {path.name}"
        )
    if crs.is_engineering or not (crs.is_projected or crs.is_geographic):
        raise InputError(
            f"{path}: local CRS {crs.name!r} without a known place on the Earth: {PROJECTED}; "
            f"if it is one, set it, for example {edit}; otherwise use control points: "
            f"gdal_translate -gcp ... and gdalwarp -r near -t_srs EPSG:32617"
        )


def _check_transform(path: Path, source: rasterio.DatasetReader) -> None:
    determinant = source.transform.determinant
    if source.transform != Affine.identity() and np.isfinite(determinant) and determinant != 0:
        return
    world = beside(path, WORLD_FILES)
    if world:
        raise InputError(
            f"{path}: no georeference of its own, and {world[0].name} beside it is not read: write "
            f"it into the tile: gdal_translate {path.name} placed.tif"
        )
    raise InputError(f"{path}: no georeference: expected a GeoTIFF with a pixel size and origin")


def _control_points(path: Path, source: rasterio.DatasetReader) -> str:
    points, crs = source.gcps
    target = "EPSG:32617"
    if crs is not None and crs.is_projected and crs.to_epsg():
        target = f"EPSG:{crs.to_epsg()}"
    elif crs is not None and crs.is_geographic:
        target = _zone(points[0].x, points[0].y)
    return (
        f"{path}: has {len(points)} ground control points only: expected a pixel size and "
        f"origin; warp it: gdalwarp -r near -t_srs {target} {path.name} placed.tif"
    )


def _utm_of(source: rasterio.DatasetReader) -> str:
    return _zone(*(source.transform @ (source.width / 2, source.height / 2)))


def _zone(longitude: float, latitude: float) -> str:
    """UTM zone of a point, or an example."""
    if not (-180 <= longitude <= 180 and -90 <= latitude <= 90):
        return "EPSG:32617"
    zone = min(int((longitude + 180) // 6) + 1, 60)
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
