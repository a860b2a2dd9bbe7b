import sqlite3

import numpy as np
import pyogrio
import pyproj
import shapely

from sasmap.io.geopackage import Feature, write_boundaries, write_layer

CRS = pyproj.CRS.from_epsg(32617).to_wkt()
LINE = Feature(np.array([[500000.0, 3300000.0], [500010.0, 3300005.0]]), "sand", "mud", 0.25)


def test_layer_holds_lines_with_their_classes(tmp_path):
    path = tmp_path / "b.gpkg"
    write_boundaries(path, [LINE], CRS, tmp_path / "scratch")
    base = sqlite3.connect(path)
    assert base.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
    row = base.execute("SELECT geom, left, right, position_sd FROM boundaries").fetchone()
    assert row[1:] == ("sand", "mud", 0.25)
    assert row[0][:2] == b"GP"
    about, _, shapes, _ = pyogrio.raw.read(path, layer="boundaries")
    np.testing.assert_array_equal(shapely.get_coordinates(shapely.from_wkb(shapes)), LINE.points)
    assert about["crs"] == "EPSG:32617"
    contents = base.execute("SELECT table_name, min_x, max_y, srs_id FROM gpkg_contents").fetchone()
    assert contents == ("boundaries", 500000.0, 3300005.0, 32617)
    assert base.execute("PRAGMA foreign_key_check").fetchall() == []
    assert base.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    base.close()


def test_the_same_lines_give_the_same_bytes(tmp_path):
    paths = [tmp_path / "a.gpkg", tmp_path / "b.gpkg"]
    for path in paths:
        write_boundaries(path, [LINE, LINE], CRS, tmp_path / "scratch")
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_no_lines_are_a_layer_all_the_same(tmp_path):
    write_boundaries(tmp_path / "b.gpkg", [], CRS, tmp_path / "scratch")
    base = sqlite3.connect(tmp_path / "b.gpkg")
    assert base.execute("SELECT count(*) FROM boundaries").fetchone()[0] == 0
    base.close()


def test_a_layer_holds_any_columns_and_leaves_unknown_numbers_empty(tmp_path):
    columns = {
        "code": np.array([1, 2], np.int32),
        "value": np.array([0.5, np.nan]),
        "name": np.array(["sand", "mud ä"], object),
    }
    squares = [shapely.box(0, 0, 1, 1), shapely.box(1, 0, 2, 1)]
    paths = [tmp_path / "a.gpkg", tmp_path / "b.gpkg"]
    for path in paths:
        write_layer(path, "cells", "Polygon", squares, columns, CRS, tmp_path / "scratch")
    assert paths[0].read_bytes() == paths[1].read_bytes()
    base = sqlite3.connect(paths[0])
    rows = base.execute("SELECT code, value, name FROM cells").fetchall()
    assert rows == [(1, 0.5, "sand"), (2, None, "mud ä")]
    base.close()
