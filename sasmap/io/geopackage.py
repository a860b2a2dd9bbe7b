"""GeoPackages of lines and areas, written byte for byte the same for the same shapes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray

from sasmap.io.files import written_whole

FloatArray = NDArray[np.float64]

# The date that GDAL would write is fixed, so that bytes are a function of the shapes alone.
DATE = "2000-01-01T00:00:00.000Z"


class Feature(NamedTuple):
    """A boundary on the map.

    Attributes
    ----------
    points : ndarray (n, 2)
        Map coordinates, m.
    left, right : str
        Names of the classes left and right of the way.
    position_sd : float
        m.
    """

    points: FloatArray
    left: str
    right: str
    position_sd: float


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
    fields: dict[str, NDArray[Any]] = {
        k: np.array([getattr(f, k) for f in features], object) for k in ("left", "right")
    }
    fields["position_sd"] = np.array([f.position_sd for f in features], np.float64)
    write_layer(path, "boundaries", "LineString", lines, fields, crs, scratch)


def write_layer(
    path: Path,
    layer: str,
    kind: str,
    shapes: Sequence[Any],
    fields: Mapping[str, NDArray[Any]],
    crs: str,
    scratch: Path,
) -> None:
    """Write a GeoPackage of one layer, whole or not at all.

    Parameters
    ----------
    path : Path
    layer : str
    kind : str
        "LineString" or "Polygon".
    shapes : sequence of shapely geometry
    fields : mapping of str to ndarray
        A value a shape.
    crs : str
        WKT.
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    with written_whole(path, scratch) as part:
        draft = part.with_suffix(".gpkg")  # GDAL warns of other names
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": DATE})
        try:
            pyogrio.raw.write(
                draft,
                np.asarray(shapely.to_wkb(list(shapes)), object),
                list(fields.values()),
                list(fields),
                driver="GPKG",
                layer=layer,
                geometry_type=kind,
                crs=crs,
                dataset_options={"VERSION": "1.2"},  # which all readers know
            )
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            draft.unlink(missing_ok=True)
            raise OSError(f"{path}: cannot be written: {error}") from None
        finally:
            pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
        os.replace(draft, part)
