import numpy as np
import pytest
import rasterio
import tifffile
from affine import Affine

from sasmap.errors import InputError
from sasmap.survey.lattice import Lattice, Window
from sasmap.survey.tiles import find_tiles, inspect_tile, read_mosaic, read_tile
from tests.helpers import write_tile

NORTH_UP = Affine(0.5, 0, 500000.0, 0, -0.5, 3300000.0)
RAMP = np.arange(12 * 20, dtype="float32").reshape(12, 20)


def test_pixel_is_point_is_shifted_to_area(tmp_path):
    # GDAL writes the tie point half a pixel off for pixel-is-point and shifts it back on reading
    path = write_tile(tmp_path / "p.tif", RAMP, NORTH_UP, tags={"AREA_OR_POINT": "Point"})
    tile = inspect_tile(path)
    x, y = tile.lattice.centres(Window(0, 0, 1, 1))
    assert abs(x[0, 0] - 500000.25) < 1e-6 * 0.5
    assert abs(y[0, 0] - 3299999.75) < 1e-6 * 0.5


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32", "float64"])
def test_nodata_negative_and_infinite_are_missing(tmp_path, dtype):
    values = RAMP.astype(dtype)
    values[0, 0] = 7
    if values.dtype.kind != "u":
        values[3, 3] = -1
    if values.dtype.kind == "f":
        values[4, 4] = np.inf
        values[5, 5] = np.nan
    tile = inspect_tile(write_tile(tmp_path / "a.tif", values, NORTH_UP, nodata=7))
    got = read_tile(tile, tile.window)
    assert got.dtype == (np.float64 if dtype == "float64" else np.float32)
    missing = (values == 7) | ~np.isfinite(values.astype(float)) | (values.astype(float) < 0)
    np.testing.assert_array_equal(np.isnan(got), missing)
    np.testing.assert_array_equal(got[~missing], values[~missing])


def test_window_of_a_tile(tmp_path):
    tile = inspect_tile(write_tile(tmp_path / "a.tif", RAMP, NORTH_UP))
    np.testing.assert_array_equal(read_tile(tile, Window(2, 3, 4, 5)), RAMP[2:6, 3:8])


def faulty(path):
    with pytest.raises(InputError) as caught:
        inspect_tile(path)
    (fault,) = caught.value.faults
    assert str(path) in fault
    return fault


def test_missing_text_and_folder(tmp_path):
    assert "no such file" in faulty(tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("not a tiff\n")
    assert "not a GeoTIFF" in faulty(tmp_path / "text.tif")
    assert "a folder: expected files" in faulty(tmp_path)
    (tmp_path / "vrt.tif").write_text("<VRTDataset rasterXSize='1' rasterYSize='1'/>")
    assert "not a GeoTIFF" in faulty(tmp_path / "vrt.tif")


def test_georeference_is_needed_and_projected(tmp_path):
    assert "no CRS" in faulty(write_tile(tmp_path / "a.tif", RAMP, NORTH_UP, crs=None))
    degrees = Affine(1e-6, 0, -81.0, 0, -1e-6, 29.8)
    fault = faulty(write_tile(tmp_path / "b.tif", RAMP, degrees, crs="EPSG:4326"))
    assert "geographic CRS" in fault
    assert "EPSG:32617" in fault


def test_bands_and_kind_of_pixels(tmp_path):
    assert "complex64" in faulty(write_tile(tmp_path / "c.tif", RAMP.astype("complex64"), NORTH_UP))
    with rasterio.open(
        tmp_path / "two.tif", "w", driver="GTiff", count=2, height=2, width=2, dtype="uint8",
        crs="EPSG:32617", transform=NORTH_UP,
    ) as target:  # fmt: skip
        target.write(np.zeros((2, 2, 2), "uint8"))
    assert "2 bands" in faulty(tmp_path / "two.tif")


@pytest.mark.parametrize("layout", [{"tiled": True, "blockxsize": 64, "blockysize": 64}, {}])
@pytest.mark.parametrize("keep", [0.5, 0.9])
def test_truncated(tmp_path, layout, keep):
    noise = np.random.default_rng(1).integers(0, 255, (300, 300), dtype="uint8")
    path = write_tile(tmp_path / "t.tif", noise, NORTH_UP, compress="deflate", **layout)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    assert "truncated" in faulty(path) or "not a GeoTIFF" in faulty(path)


def test_broken_block_is_an_error_that_names_file_and_block(tmp_path):
    noise = np.random.default_rng(1).integers(0, 255, (256, 256), dtype="uint8")
    path = write_tile(tmp_path / "t.tif", noise, NORTH_UP, compress="deflate", tiled=True,
                      blockxsize=64, blockysize=64)  # fmt: skip
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 200] = b"\x00" * 200
    path.write_bytes(bytes(content))
    tile = inspect_tile(path)
    with pytest.raises(OSError, match=r"t\.tif: rows 64 to 127, columns 192 to 255"):
        read_tile(tile, tile.window)
    np.testing.assert_array_equal(read_tile(tile, Window(0, 0, 32, 256)), noise[:32])


def test_gather_same_lattice_first_wins(tmp_path):
    first = RAMP.copy()
    first[:, 10:] = -1  # invalid: the second tile shows through
    a = inspect_tile(write_tile(tmp_path / "a.tif", first, NORTH_UP))
    b = inspect_tile(write_tile(tmp_path / "b.tif", RAMP + 1000, NORTH_UP @ shift(4, 2)))
    got = read_mosaic((a, b), a.lattice, Window(-1, 0, 16, 26))
    assert np.isnan(got[0]).all()
    np.testing.assert_array_equal(got[1:13, :10], RAMP[:, :10])
    np.testing.assert_array_equal(got[3:15, 10:24], 1000 + RAMP[:, 6:])
    assert np.isnan(got[1:3, 10:]).all()


def shift(columns, rows):
    return Affine.translation(columns, rows)


def test_gather_from_another_lattice_keeps_pixel_values(tmp_path):
    noise = np.random.default_rng(3).rayleigh(1.0, (40, 40)).astype("float32")
    turned = NORTH_UP @ Affine.rotation(30)
    tile = inspect_tile(write_tile(tmp_path / "a.tif", noise, turned))
    target = Lattice(tile.lattice.crs, NORTH_UP)
    window = Window(0, -30, 60, 70)
    got = read_mosaic((tile,), target, window)
    x, y = target.centres(window)
    row, column = tile.lattice.pixel_of(x, y)
    inside = (row >= 0) & (row < 40) & (column >= 0) & (column < 40)
    np.testing.assert_array_equal(~np.isnan(got), inside)
    picked = noise[row[inside].astype(int), column[inside].astype(int)]
    np.testing.assert_array_equal(got[inside], picked)


def test_globs_start_from_the_folder_even_with_odd_names(tmp_path):
    folder = tmp_path / "a[1]"
    (folder / "x").mkdir(parents=True)
    for name in ("b.tif", "a.tif"):
        (folder / "x" / name).touch()
    assert find_tiles(folder, "x/*.tif") == [folder / "x" / "a.tif", folder / "x" / "b.tif"]
    assert find_tiles(folder / "x", "../x/a*") == [folder / "x" / ".." / "x" / "a.tif"]
    assert find_tiles(folder, "none.tif") == [folder / "none.tif"]
    assert find_tiles(folder, "none*.tif") == []


def test_a_file_whose_writer_was_killed_is_refused(tmp_path):
    path = tmp_path / "s.tif"
    profile = {"driver": "GTiff", "count": 1, "height": 64, "width": 64, "dtype": "uint8"}
    with rasterio.open(
        path, "w", crs="EPSG:32617", transform=NORTH_UP, SPARSE_OK=True, tiled=True,
        blockxsize=32, blockysize=32, **profile,
    ):  # fmt: skip
        pass
    assert "none of its blocks was ever written" in faulty(path)


def with_mask(path, nodata=None):
    noise = np.random.default_rng(1).integers(1, 255, (128, 128), dtype="uint8")
    profile = {"driver": "GTiff", "count": 1, "height": 128, "width": 128, "dtype": "uint8"}
    mask = np.full((128, 128), 255, "uint8")
    mask[:20] = 0
    noise[30] = 7
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(
            path, "w", crs="EPSG:32617", transform=NORTH_UP, nodata=nodata, **profile
        ) as t,
    ):
        t.write(noise, 1)
        t.write_mask(mask)
    return path


def test_masks_and_nodata_both_hide(tmp_path):
    tile = inspect_tile(with_mask(tmp_path / "m.tif", nodata=7))
    missing = np.isnan(read_tile(tile, tile.window))
    assert missing[:20].all()
    assert missing[30].all()
    assert not missing[21:30].all()


@pytest.mark.parametrize("cut", [1, 60, 150, 220, 300, 400])
def test_a_truncated_mask_is_refused(tmp_path, cut):
    path = with_mask(tmp_path / "m.tif")
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    assert "truncated" in faulty(path)


def test_a_name_with_wildcards_that_exists_is_itself(tmp_path):
    (tmp_path / "a[1].tif").touch()
    assert find_tiles(tmp_path, "a[1].tif") == [tmp_path / "a[1].tif"]


def test_damaged_geokeys_are_one_line(tmp_path):
    """GDAL opens such a file and raises only when it is asked for its colours."""
    path = write_tile(tmp_path / "a.tif", np.ones((40, 60), "uint8"), NORTH_UP)
    with tifffile.TiffFile(path) as file:
        tags = {tag.name: tag.offset for tag in file.pages[0].tags}
    raw = bytearray(path.read_bytes())
    raw[tags["PhotometricInterpretation"]] = 225  # a tag that nothing knows
    raw[tags["ModelPixelScaleTag"] + 3] = 79  # no type of TIFF has that number
    raw[tags["GeoAsciiParamsTag"] + 3] = 1
    path.write_bytes(raw)
    with pytest.raises(InputError, match=r"a\.tif: not a GeoTIFF that can be opened"):
        inspect_tile(path)


def test_a_tile_without_permission_is_not_called_a_wrong_format(tmp_path, monkeypatch):
    path = write_tile(tmp_path / "a.tif", RAMP, NORTH_UP)
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "no permission" in faulty(path)
