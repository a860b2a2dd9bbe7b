"""A STAC item of a run, so that catalogues find it (STAC 1.0.0)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyproj

from sasmap.io.files import write_text

MEDIA = {
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized",
    ".gpkg": "application/geopackage+sqlite3",
    ".nc": "application/netcdf",
    ".json": "application/json",
    ".html": "text/html",
}


def write_stac(
    path: Path,
    identity: str,
    title: str,
    box: tuple[float, float, float, float],
    crs: str,
    products: Sequence[str],
    scratch: Path,
) -> Path:
    """Write a STAC item.

    Parameters
    ----------
    path : Path
    identity : str
        The run's.
    title : str
    box : tuple of float
        Left, bottom, right, top, m.
    crs : str
        WKT.
    products : sequence of str
        File names beside it.
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
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"],
        "id": identity,
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "bbox": [west, south, east, north],
        "properties": {
            # a survey file knows no date: this is when the run was made
            "datetime": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
            "title": title,
            "proj:epsg": int(authority[1]) if authority and authority[0] == "EPSG" else None,
            "proj:wkt2": known.to_wkt(),
            "proj:bbox": list(box),
        },
        "links": [],
        "assets": {
            Path(name).stem: {
                "href": f"./{name}",
                "type": MEDIA[Path(name).suffix],
                "roles": ["data"],
            }
            for name in products
            if Path(name).suffix in MEDIA and name != path.name
        },
    }
    write_text(path, json.dumps(item, indent=2) + "\n", scratch)
    return path
