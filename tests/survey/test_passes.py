import numpy as np
import pyproj
import pytest
from affine import Affine

import sasmap
from sasmap.errors import InputError
from sasmap.survey.cells import Cell
from sasmap.survey.opening import open_survey
from sasmap.survey.passes import read_clip
from tests.helpers import UTM, small_survey, with_pass, write_tile, write_track


def opened(path):
    return open_survey(sasmap.load_survey(path))


def faults(path):
    with pytest.raises(InputError) as caught:
        opened(path)
    return caught.value.faults


def test_open_pass_is_lazy_and_carries_its_geometry(tmp_path):
    array = sasmap.open_pass(sasmap.load_survey(small_survey(tmp_path)), "one")
    assert array.dims == ("y", "x")
    assert array.shape == (40, 60)
    assert array.chunks is not None
    assert array.coords["ground_range"].chunks is not None
    np.testing.assert_allclose(array.x, 500010.25 + 0.5 * np.arange(60))
    np.testing.assert_allclose(array.y, 3300019.75 - 0.5 * np.arange(40))
    np.testing.assert_allclose(array.ground_range[3], 10.25 + 0.5 * np.arange(60), atol=1e-6)
    np.testing.assert_allclose(array.altitude, 5.0)
    np.testing.assert_allclose(array.look_azimuth, 90.0)
    assert pyproj.CRS.from_cf(array.spatial_ref.attrs) == pyproj.CRS.from_user_input(UTM)
    assert array.ground_range.attrs["units"] == "m"


def test_unknown_pass(tmp_path):
    with pytest.raises(InputError, match="no pass named 'two'; there are: one"):
        sasmap.open_pass(sasmap.load_survey(small_survey(tmp_path)), "two")


def test_rotated_tiles_have_positions_of_two_dimensions(tmp_path):
    path = small_survey(tmp_path)
    turned = Affine(0.5, 0, 500020.0, 0, -0.5, 3300015.0) @ Affine.rotation(25)
    values = np.random.default_rng(0).rayleigh(1, (16, 24)).astype("float32")
    write_tile(tmp_path / "tiles" / "a.tif", values, turned)
    array = sasmap.open_pass(sasmap.load_survey(path), "one")
    x, y = turned @ (7.5, 3.5)
    assert abs(float(array.x[3, 7]) - x) < 5e-7
    assert abs(float(array.y[3, 7]) - y) < 5e-7
    assert abs(float(array.ground_range[3, 7]) - (x - 500000)) < 1e-6
    assert float(array[3, 7]) == values[3, 7]


def test_clips_hold_every_pixel_once_and_unchanged(tmp_path):
    survey = opened(small_survey(tmp_path))
    array = sasmap.open_pass(survey.settings, "one").compute()
    assert (survey.grid.rows, survey.grid.columns) == (2, 3)
    total = 0
    for cell in survey.grid:
        clip = read_clip(survey.passes[0], survey.grid, cell, "starboard")
        rows = slice(20 * cell.row, 20 * cell.row + 20)
        columns = slice(20 * cell.column, 20 * cell.column + 20)
        np.testing.assert_array_equal(clip.values, array.values[rows, columns])
        np.testing.assert_allclose(clip.ground_range, array.ground_range[rows, columns])
        total += int(np.isfinite(clip.values).sum())
    assert total == array.size


def test_rotated_and_reprojected_tiles_give_each_cell_its_own_pixels(tmp_path):
    path = small_survey(tmp_path, crs="EPSG:32616")
    turned = Affine(0.25, 0, 500020.0, 0, -0.25, 3300015.0) @ Affine.rotation(25)
    values = np.random.default_rng(0).rayleigh(1, (48, 56)).astype("float32")
    write_tile(tmp_path / "tiles" / "a.tif", values, turned)
    survey = opened(path)
    found = []
    for cell in survey.grid:
        clip = read_clip(survey.passes[0], survey.grid, cell, "starboard")
        if clip is not None:
            valid = np.isfinite(clip.values)
            left, bottom, right, top = survey.grid.bounds(cell)
            x, y = clip.x.values[valid], clip.y.values[valid]
            assert ((x > left - 1e-6) & (x < right + 1e-6)).all()
            assert ((y > bottom - 1e-6) & (y < top + 1e-6)).all()
            found.append(clip.values[valid])
    np.testing.assert_array_equal(np.sort(np.concatenate(found)), np.sort(values.ravel()))


def test_sides_of_the_track(tmp_path):
    path = small_survey(tmp_path, **with_pass(side="both"))
    values = np.ones((20, 40), "float32")
    corner = Affine(0.5, 0, 499990.0, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "tiles" / "a.tif", values, corner)
    survey = opened(path)
    cell = Cell(0, 1)
    assert survey.passes[0].sides == ("port", "starboard")
    clip = read_clip(survey.passes[0], survey.grid, cell, "starboard")
    assert (clip.look_azimuth == 90).all()
    assert read_clip(survey.passes[0], survey.grid, cell, "port") is None
    port = read_clip(survey.passes[0], survey.grid, Cell(0, 0), "port")
    assert (port.look_azimuth == 270).all()
    (tmp_path / "one-side").mkdir()
    path = small_survey(tmp_path / "one-side")
    write_tile(tmp_path / "one-side" / "tiles" / "a.tif", values, corner)
    array = sasmap.open_pass(sasmap.load_survey(path), "one")
    assert np.isnan(array.values[:, :20]).all()
    assert not np.isnan(array.values[:, 20:]).any()


def test_slant_range_moves_pixels_to_the_sea_floor(tmp_path):
    path = small_survey(tmp_path, **with_pass(range="slant"))
    array = sasmap.open_pass(sasmap.load_survey(path), "one").compute()
    slant = array.x.values - 500000.0
    expected = np.sqrt(slant**2 - 25.0)
    np.testing.assert_allclose(array.ground_range[0], expected, atol=1e-6)
    np.testing.assert_allclose(array.ground_x[0], 500000 + expected, atol=1e-6)
    survey = opened(path)
    held = 0
    for cell in survey.grid:
        clip = read_clip(survey.passes[0], survey.grid, cell, "starboard")
        valid = np.isfinite(clip.values)
        left, _, right, _ = survey.grid.bounds(cell)
        x = clip.ground_x.values[valid]
        assert ((x >= left - 1e-6) & (x <= right + 1e-6)).all()
        held += valid.sum()
    # sea floor nearer than the first tile pixel lies outside the grid
    assert held == 40 * (500000 + expected >= survey.grid.left).sum()


def test_water_column_of_slant_tiles_is_no_sea_floor(tmp_path):
    path = small_survey(tmp_path, **with_pass(range="slant"))
    corner = Affine(0.5, 0, 500000.0, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "tiles" / "a.tif", np.ones((20, 40), "float32"), corner)
    array = sasmap.open_pass(sasmap.load_survey(path), "one")
    np.testing.assert_array_equal(np.isnan(array.values[0]), np.arange(40) < 10)


def test_overlapping_tiles_of_two_pixel_sizes(tmp_path):
    path = small_survey(tmp_path)
    corner = Affine(0.25, 0, 500015.0, 0, -0.25, 3300020.0)
    write_tile(
        tmp_path / "tiles" / "b.tif",
        7.0 + (np.arange(6400) % 2).reshape(40, 160).astype("float32"),
        corner,
    )
    survey = opened(path)
    assert survey.grid.size == 10.0  # of the first tile's pixels
    wide = [read_clip(survey.passes[0], survey.grid, Cell(0, c), "starboard") for c in range(4)]
    assert wide[0].shape == (20, 20)
    assert (wide[3].values >= 7.0).all()  # beyond the first tile
    assert wide[3].attrs["pixel_size"] == 0.25


def change_tile(folder, **profile):
    values = np.ones((20, 40), "float32")
    corner = Affine(0.5, 0, 500010.0, 0, -0.5, 3300020.0)
    return write_tile(folder / "tiles" / "a.tif", profile.pop("values", values),
                      profile.pop("transform", corner), **profile)  # fmt: skip


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda f: (f / "tiles" / "a.tif").unlink(), "no file matches 'tiles/*.tif'"),
        (lambda f: change_tile(f, crs=None), "a.tif: no CRS"),
        (lambda f: change_tile(f, crs="EPSG:4326"), "a.tif: geographic CRS"),
        (lambda f: (f / "tiles" / "a.tif").write_text("hello"), "a.tif: not a GeoTIFF"),
        (lambda f: (f / "nav.csv").unlink(), "nav.csv: cannot be read"),
        (
            lambda f: write_track(
                f / "nav.csv", [500000.0] * 2, [3299990.0, 3300030.0], [5.0, 0.0]
            ),
            "nav.csv: row 3: altitude: expected more than 0 m",
        ),
        (
            lambda f: change_tile(f, transform=Affine(0.5, 0, 500010.0, 0, -0.5, 3310000.0)),
            "a.tif: lies outside the navigation",
        ),
        (
            lambda f: change_tile(f, transform=Affine(0.5, 0, 540000.0, 0, -0.5, 3300020.0)),
            "a.tif: lies outside the navigation",
        ),
        (
            lambda f: change_tile(f, transform=Affine(0.5, 0, 499950.0, 0, -0.5, 3300020.0)),
            "a.tif: lies on the port side",
        ),
        (
            lambda f: change_tile(f, values=np.full((4, 4), np.nan, "float32")),
            "pass 'one' has no valid pixel",
        ),
    ],
)
def test_each_fault_is_one_line_that_names_its_cause(tmp_path, spoil, says):
    path = small_survey(tmp_path)
    spoil(tmp_path)
    (fault,) = faults(path)
    assert says in fault
    assert "\n" not in fault


def test_an_empty_tile_among_others_is_a_warning(tmp_path):
    path = small_survey(tmp_path)
    corner = Affine(0.5, 0, 500010.0, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "tiles" / "b.tif", np.full((4, 4), np.nan, "float32"), corner)
    (warning,) = opened(path).warnings
    assert "b.tif: holds no valid pixel" in warning


def test_faults_of_all_tiles_come_together(tmp_path):
    path = small_survey(tmp_path)
    (tmp_path / "tiles" / "b.tif").write_text("x")
    (tmp_path / "tiles" / "c.tif").write_text("x")
    assert len(faults(path)) == 2


@pytest.mark.parametrize(
    ("changes", "corner"),
    [
        ({"range": "slant"}, 500001.0),  # nearer than the altitude: water column only
        ({"side": "starboard"}, 499990.5),  # pixels to starboard are nodata, those to port are not
    ],
)
def test_a_pass_that_shows_no_floor_is_refused(tmp_path, changes, corner):
    path = small_survey(tmp_path, **with_pass(**changes))
    values = np.ones((20, 8 if "range" in changes else 40), "float32")
    if "range" not in changes:
        values[:, 15:] = np.nan
    transform = Affine(0.5, 0, corner, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "tiles" / "a.tif", values, transform, nodata=float("nan"))
    (fault,) = faults(path)
    assert "has no valid pixel" in fault


def test_products_are_no_tiles_and_replace_no_input(tmp_path):
    path = small_survey(tmp_path, output="tiles")
    (tmp_path / "tiles" / "ripple_height.tif").write_text("of an earlier run")
    assert len(opened(path).passes[0].tiles) == 1
    path = small_survey(tmp_path)
    (tmp_path / "tiles" / ".sasmap").mkdir()  # that run was given this folder by --output
    assert len(opened(path).passes[0].tiles) == 1
    path = small_survey(tmp_path, **with_pass(tiles=["tiles/ripple_height.tif"]), output="tiles")
    tile = tmp_path / "tiles" / "ripple_height.tif"
    tile.write_bytes((tmp_path / "tiles" / "a.tif").read_bytes())
    (fault,) = faults(path)
    assert "would overwrite this input" in fault
