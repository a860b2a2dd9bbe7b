import sqlite3

import numpy as np
import pyproj
import shapely
from affine import Affine

from sasmap.products.extent import outlines, write_extent

CRS = pyproj.CRS.from_epsg(32617).to_wkt()
MAP = Affine(0.5, 0, 500000, 0, -0.5, 3300000)


def ring():
    """A rippled ring: 60 places outside, 20 inside, around place (100, 100)."""
    row, column = np.indices((200, 200))
    distance = np.hypot(row - 99.5, column - 99.5)
    return ((distance < 60) & (distance > 20)).astype(float)


def test_outlines_lie_where_the_ripples_end():
    (found,) = outlines(ring(), np.ones((200, 200), bool), 4.0, MAP)
    shape = found.polygon
    assert abs(shape.area / (np.pi * (60**2 - 20**2) * 0.25) - 1) < 0.02
    assert len(shape.interiors) == 1
    np.testing.assert_allclose(shape.centroid.coords[0], (500050, 3299950), atol=0.1)
    edge = shapely.get_coordinates(shape.exterior) - (500050, 3299950)
    assert np.abs(np.hypot(*edge.T) - 30).max() < 1.0  # a quarter of a wavelength


def test_a_survey_that_is_rippled_throughout_has_its_own_edge_as_outline():
    whole = np.ones((80, 60))
    (found,) = outlines(whole, np.ones(whole.shape, bool), 3.0, MAP)
    assert abs(found.polygon.area / (80 * 60 * 0.25) - 1) < 0.02


def test_an_area_that_reaches_no_cell_with_ripples_and_a_small_one_are_left_out():
    there = np.zeros((100, 100))
    there[10:40, 10:40] = there[60:90, 60:90] = 1.0
    there[70:73, 10:13] = 1.0
    own = np.zeros(there.shape, bool)
    own[:50] = own[60:, :50] = True
    (found,) = outlines(there, own, 4.0, MAP)
    assert found.polygon.bounds[2] < 500000 + 50 * 0.5


def test_a_hole_in_the_data_is_no_hole_in_the_ripples():
    there = np.ones((100, 100))
    there[50:52] = np.nan
    (found,) = outlines(there, np.ones(there.shape, bool), 8.0, MAP)
    assert len(found.polygon.interiors) == 0


def test_the_same_outlines_give_the_same_bytes(tmp_path):
    found = outlines(ring(), np.ones((200, 200), bool), 4.0, MAP)
    paths = [tmp_path / "a.gpkg", tmp_path / "b.gpkg"]
    for path in paths:
        write_extent(path, found, CRS, tmp_path / "scratch")
    assert paths[0].read_bytes() == paths[1].read_bytes()
    base = sqlite3.connect(paths[0])
    area, wavelength = base.execute("SELECT area, wavelength FROM extent").fetchone()
    base.close()
    assert wavelength == 4.0
    assert abs(area - found[0].polygon.area) < 1e-6
