import numpy as np
import pyproj
import pytest

from sasmap.errors import InputError
from sasmap.survey.cells import Cell, CellGrid, check_count, check_grid_crs, lay_grid
from sasmap.survey.tiles import inspect_tile
from tests.helpers import UTM, write_tile
from tests.survey.test_tiles import NORTH_UP, RAMP, shift

WKT = pyproj.CRS.from_user_input(UTM).to_wkt()


def test_grid_starts_at_the_upper_left_of_all_tiles(tmp_path):
    a = inspect_tile(write_tile(tmp_path / "a.tif", RAMP, NORTH_UP))
    b = inspect_tile(write_tile(tmp_path / "b.tif", RAMP, NORTH_UP @ shift(-6, 7)))
    grid = lay_grid([a, b], a.lattice.crs, 10)
    assert (grid.left, grid.top, grid.size) == (499997.0, 3300000.0, 5.0)
    assert (grid.rows, grid.columns) == (2, 3)  # 19 rows and 26 columns of pixels
    assert grid.bounds(Cell(1, 2)) == (500007.0, 3299990.0, 500012.0, 3299995.0)
    assert [tuple(c) for c in grid] == [(r, c) for r in range(2) for c in range(3)]


def test_every_point_lies_in_one_cell():
    grid = CellGrid(WKT, 500000.0, 3300000.0, 12.5, 4, 5, 12.5)
    rng = np.random.default_rng(1)
    x = 500000 + np.concatenate([rng.uniform(0, 62.5, 500), 12.5 * np.arange(5)])
    y = 3300000 - np.concatenate([rng.uniform(0, 50, 500), 12.5 * np.arange(4), [3.0]])
    held = sum(grid.holds(cell, x, y).astype(int) for cell in grid)
    np.testing.assert_array_equal(held, 1)


def test_whole_pixels_do_not_make_a_sliver_of_a_cell(tmp_path):
    tenth = NORTH_UP @ NORTH_UP.scale(0.2)  # 0.1 m pixels: sizes that binary cannot hold
    tile = inspect_tile(write_tile(tmp_path / "a.tif", np.zeros((90, 210), "uint8"), tenth))
    grid = lay_grid([tile], tile.lattice.crs, 30)
    assert (grid.rows, grid.columns) == (3, 7)


@pytest.mark.parametrize(
    ("crs", "x", "y", "says"),
    [
        ("EPSG:4326", -81.0, 29.8, "geographic CRS"),
        ("EPSG:3857", -9016879.0, 3472000.0, "stretches distances"),
        ("EPSG:2236", 600000.0, 600000.0, "US survey foot"),
        ("EPSG:32617+5714", 500000.0, 3300000.0, "has heights"),
        ("EPSG:5714", 500000.0, 3300000.0, "vertical CRS"),
    ],
)
def test_crs_whose_numbers_are_not_metres_on_the_ground(crs, x, y, says):
    with pytest.raises(InputError, match=says):
        check_grid_crs(pyproj.CRS.from_user_input(crs), "survey.yaml: crs", x, y)


def test_utm_is_accepted():
    utm = pyproj.CRS.from_user_input(UTM)
    assert check_grid_crs(utm, "survey.yaml: crs", 500000.0, 3300000.0) == ""


def test_another_utm_zone_is_worth_a_warning():
    utm = pyproj.CRS.from_user_input(UTM)
    said = check_grid_crs(utm, "survey.yaml: crs", 1200000.0, 3300000.0)
    assert "survey.yaml: crs" in said
    assert "0.5" in said
    assert "wavelengths and heights are off by as much" in said


def test_tiles_meet_the_cells_they_overlap(tmp_path):
    tile = inspect_tile(write_tile(tmp_path / "b.tif", RAMP, NORTH_UP))
    grid = CellGrid(tile.lattice.crs, 499997.0, 3300003.0, 5.0, 4, 6, 5.0)
    # the tile is 10 m x 6 m from (500000, 3300000) down
    assert {tuple(c) for c in grid.met_by(tile, 0.0)} == {(r, c) for r in (0, 1) for c in (0, 1, 2)}
    assert len(set(grid.met_by(tile, 2.5))) > 6


def test_a_grid_too_large_to_hold_is_refused(tmp_path):
    far = NORTH_UP @ shift(80_000_000, 80_000_000)
    tiles = [
        inspect_tile(write_tile(tmp_path / f"{k}.tif", RAMP, t))
        for k, t in enumerate((NORTH_UP, far))
    ]
    with pytest.raises(InputError, match=r"1\.tif: lies .* km from the nearest other tile"):
        lay_grid(tiles, tiles[0].lattice.crs, 4)


def test_too_many_cells_of_tiles_that_lie_together_are_refused():
    check_count(CellGrid(WKT, 0.0, 0.0, 1.0, 2000, 2000, 1.0), "a.tif")
    with pytest.raises(InputError, match=r"a\.tif: .*choose a larger window"):
        check_count(CellGrid(WKT, 0.0, 0.0, 1.0, 2001, 2000, 1.0), "a.tif")


@pytest.mark.parametrize("count", [2, 4])
def test_the_tile_in_another_zone_is_named(tmp_path, count):
    """Once the first tile was named, and a larger window advised."""
    tiles = [
        inspect_tile(
            write_tile(tmp_path / f"{k}.tif", RAMP, NORTH_UP, crs=zone),
        )
        for k, zone in enumerate([UTM] * (count - 1) + ["EPSG:32618"])
    ]
    with pytest.raises(InputError, match=rf"{count - 1}.tif: lies .* km .*zone 18N"):
        lay_grid(tiles, tiles[0].lattice.crs, 4)


def test_overlapping_cells_share_pixels_and_reach_the_end():
    plain = CellGrid(WKT, 500000.0, 3300000.0, 12.5, 2, 3, 12.5)
    grid = plain.overlapping(6.25)
    assert (grid.rows, grid.columns) == (3, 5)
    assert grid.bounds(Cell(2, 4)) == plain.bounds(Cell(1, 2))
    assert grid.bounds(Cell(0, 1)) == (500006.25, 3299987.5, 500018.75, 3300000.0)
    # a raster's pixel is about its cell's centre
    left, _, right, top = grid.bounds(Cell(1, 3))
    x, y = grid.transform @ (3.5, 1.5)
    assert (x, y) == ((left + right) / 2, top - 6.25)
    assert grid.transform.a == 6.25
    rng = np.random.default_rng(1)
    x, y = 500006.25 + rng.uniform(0, 25, 500), 3299993.75 - rng.uniform(0, 12.5, 500)
    held = sum(grid.holds(cell, x, y).astype(int) for cell in grid)
    np.testing.assert_array_equal(held, 4)


def test_tiles_meet_the_overlapping_cells_that_hold_a_point_of_them(tmp_path):
    tile = inspect_tile(write_tile(tmp_path / "c.tif", RAMP, NORTH_UP))
    grid = CellGrid(tile.lattice.crs, 499991.0, 3300007.0, 5.0, 6, 9, 5.0).overlapping(1.7)
    x, y = np.meshgrid(500000 + np.arange(0.05, 10, 0.1), 3300000 - np.arange(0.05, 6, 0.1))
    shown = {cell for cell in grid if grid.holds(cell, x, y).any()}
    assert set(grid.met_by(tile, 0.0)) == shown
