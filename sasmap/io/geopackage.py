"""GeoPackages: the same features give the same bytes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.io.files import written_whole

# The date that GDAL would write is fixed, so that the bytes depend on the features alone.
DATE = "2000-01-01T00:00:00.000Z"
# Characters of a fault that are passed on: SQLite repeats the whole statement.
MOST_TOLD = 200


class Feature(NamedTuple):
    """A boundary on the map.

    Attributes
    ----------
    points : ndarray (n, 2)
        Map coordinates, m.
    left, right : str
        Names of the classes to the left and right along the line.
    position_sd : float
        m.
    """

    points: FloatArray
    left: str
    right: str
    position_sd: float


class Area(NamedTuple):
    """An area of one sediment on the map.

    Attributes
    ----------
    shape : shapely geometry
        Polygon or multipolygon, map coordinates.
    number : int
        Number of its class.
    name, code : str
    area : float
        m^2.
    confidence : float
        Mean probability of the class.
    rippled : bool
    """

    shape: Any
    number: int
    name: str
    code: str
    area: float
    confidence: float
    rippled: bool


def write_boundaries(path: Path, features: Sequence[Feature], crs: str, scratch: Path) -> None:
    """Write layer ``boundaries`` of a GeoPackage, whole or not at all.

    Parameters
    ----------
    path : Path
    features : sequence of Feature
    crs : str
        WKT.
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    lines = [shapely.LineString(f.points) for f in features]
    columns = {
        "left": np.array([f.left for f in features], object),
        "right": np.array([f.right for f in features], object),
        "position_sd": np.array([f.position_sd for f in features], np.float64),
    }
    write_layer(path, "boundaries", "LineString", lines, columns, crs, scratch)


def write_areas(path: Path, areas: Sequence[Area], crs: str, scratch: Path) -> None:
    """Write layer ``areas`` of a GeoPackage, whole or not at all.

    Parameters
    ----------
    path : Path
    areas : sequence of Area
    crs : str
        WKT.
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    columns = {
        "class": np.array([a.number for a in areas], np.int32),
        "name": np.array([a.name for a in areas], object),
        "code": np.array([a.code for a in areas], object),
        "area_m2": np.array([a.area for a in areas], np.float64),
        "confidence": np.array([a.confidence for a in areas], np.float64),
        "rippled": np.array([a.rippled for a in areas], bool),
    }
    shapes = [
        a.shape if a.shape.geom_type == "MultiPolygon" else shapely.MultiPolygon([a.shape])
        for a in areas
    ]
    write_layer(path, "areas", "MultiPolygon", shapes, columns, crs, scratch)


def write_layer(
    path: Path,
    layer: str,
    kind: Literal["LineString", "Polygon", "MultiPolygon"],
    shapes: Sequence[Any],
    columns: Mapping[str, NDArray[Any]],
    crs: str,
    scratch: Path,
) -> None:
    """Write a GeoPackage of one layer, whole or not at all.

    Parameters
    ----------
    path : Path
    layer : str
        Its name.
    kind : str
        Type of all its geometries.
    shapes : sequence of shapely geometry
    columns : mapping of str to ndarray (n,)
        Attributes: integers, floats (NaN becomes null), or objects of text.
    crs : str
        WKT.
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    with written_whole(path, scratch) as part:
        draft = part.with_suffix(".gpkg")  # GDAL warns about other names
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": DATE})
        try:
            pyogrio.raw.write(
                draft,
                np.asarray(shapely.to_wkb(np.asarray(shapes, object)), object),
                list(columns.values()),
                list(columns),
                driver="GPKG",
                layer=layer,
                geometry_type=kind,
                crs=crs,
                dataset_options={"VERSION": "1.2"},  # which all readers support
            )
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            draft.unlink(missing_ok=True)
            told = " ".join(str(error).split())[-MOST_TOLD:]  # the cause follows the statement
            raise OSError(f"{path}: cannot be written: {told}") from None
        finally:
            pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
        os.replace(draft, part)
