"""A STAC item of a run, so that catalogues find it (STAC 1.0.0)."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyproj

from sasmap.catalogue import BY_FILE, Product
from sasmap.io.jsonfile import write_json

MEDIA = {
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized",
    ".gpkg": "application/geopackage+sqlite3",
    ".nc": "application/netcdf",
    ".json": "application/json",
    ".html": "text/html",
    ".csv": "text/csv",
    ".qgs": "application/x-qgis-project",
}


def write_stac(
    path: Path,
    identity: str,
    title: str,
    box: tuple[float, float, float, float],
    crs: str,
    products: Sequence[str],
    recorded: tuple[datetime, datetime] | None,
    scratch: Path,
) -> Path:
    """Write a STAC item.

    Parameters
    ----------
    path : Path
    identity : str
        Identifier of the run.
    title : str
    box : tuple of float
        Left, bottom, right, top, m.
    crs : str
        WKT.
    products : sequence of str
        File names beside it.
    recorded : tuple of datetime or None
        First and last date of the passes.
    scratch : Path

    Returns
    -------
    Path
    """
    known = pyproj.CRS.from_wkt(crs)
    to_wgs = pyproj.Transformer.from_crs(known, "OGC:CRS84", always_xy=True)
    west, south, east, north = to_wgs.transform_bounds(*box)
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    authority = known.to_authority()
    item: dict[str, Any] = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v2.0.0/schema.json"],
        "id": identity,
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "bbox": [west, south, east, north],
        "properties": {
            **_times(recorded),
            "title": title,
            "proj:code": ":".join(authority) if authority else None,
            "proj:wkt2": known.to_wkt(),
            "proj:bbox": list(box),
        },
        "links": [],
        "assets": {
            name: _asset(BY_FILE[name])
            for name in products
            if name in BY_FILE and Path(name).suffix in MEDIA and name != path.name
        },
    }
    write_json(path, item, scratch)
    return path


def _times(recorded: tuple[datetime, datetime] | None) -> dict[str, Any]:
    """Date of the passes, or the first and last one; without dates the time of the run."""
    if recorded is None:
        return {"datetime": _time(datetime.now(UTC))}
    first, last = (_time(d) for d in recorded)
    if first == last:
        return {"datetime": first}
    return {"datetime": None, "start_datetime": first, "end_datetime": last}


def _time(value: datetime) -> str:
    return value.isoformat(timespec="seconds").replace("+00:00", "Z")


def _asset(product: Product) -> dict[str, Any]:
    return {
        "href": f"./{product.file}",
        "type": MEDIA[Path(product.file).suffix],
        "title": product.title,
        "description": product.sentence,
        "roles": ["metadata" if product.stage == "run" and not product.layer else "data"],
    }
