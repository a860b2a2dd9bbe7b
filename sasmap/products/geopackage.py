"""GeoPackage of lines, written byte for byte the same for the same lines (OGC 12-128r18)."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyproj
from numpy.typing import NDArray

from sasmap.products.files import written_whole

FloatArray = NDArray[np.float64]

# "GPKG" and version 1.3; the date is fixed, so that bytes are a function of the lines alone.
APPLICATION, VERSION = 0x47504B47, 10300
DATE = "2000-01-01T00:00:00.000Z"
OWN_CRS = 100_000
TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL,
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE boundaries (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom LINESTRING,
  left TEXT, right TEXT, position_sd DOUBLE);
"""


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
    known = pyproj.CRS.from_wkt(crs)
    authority = known.to_authority()
    code = int(authority[1]) if authority and authority[0] == "EPSG" else OWN_CRS
    organisation = "EPSG" if code != OWN_CRS else "NONE"
    places = [f.points for f in features]
    box = [None] * 4
    if places:
        every = np.vstack(places)
        box = [*every.min(axis=0).tolist(), *every.max(axis=0).tolist()]
    with written_whole(path, scratch) as part:
        part.unlink()
        base = sqlite3.connect(part)
        try:
            base.execute(f"PRAGMA application_id = {APPLICATION}")
            base.execute(f"PRAGMA user_version = {VERSION}")
            base.executescript(TABLES)
            base.executemany(
                "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)",
                [
                    ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
                    ("Undefined geographic", 0, "NONE", 0, "undefined", None),
                    _wgs84(),
                    (known.name, code, organisation, code, known.to_wkt("WKT1_GDAL"), None),
                ],
            )
            contents = ("boundaries", "features", "boundaries", "", DATE, *box, code)
            base.execute(f"INSERT INTO gpkg_contents VALUES ({', '.join('?' * 10)})", contents)
            columns = ("boundaries", "geom", "LINESTRING", code, 0, 0)
            base.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", columns)
            base.executemany(
                "INSERT INTO boundaries (geom, left, right, position_sd) VALUES (?, ?, ?, ?)",
                [(_geometry(f.points, code), f.left, f.right, f.position_sd) for f in features],
            )
            base.commit()
        except sqlite3.Error as error:
            raise OSError(f"{path}: cannot be written: {error}") from None
        finally:
            base.close()


def _wgs84() -> tuple[str, int, str, int, str, None]:
    wkt = pyproj.CRS.from_epsg(4326).to_wkt("WKT1_GDAL")
    return "WGS 84", 4326, "EPSG", 4326, wkt, None


def _geometry(points: FloatArray, code: int) -> bytes:
    """GeoPackage header without envelope, then a line as well-known binary, little-endian."""
    header = b"GP" + struct.pack("<BBi", 0, 1, code)
    line = struct.pack("<BII", 1, 2, len(points))
    return header + line + np.ascontiguousarray(points, "<f8").tobytes()
