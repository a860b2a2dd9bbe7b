import numpy as np
import pyproj
import pytest
import rasterio
from affine import Affine
from rio_cogeo import cog_validate

from sasmap.io.files import write_text, written_whole
from sasmap.io.rasters import Category, Layer, float_layer, write_cog
from tests.helpers import UTM

WKT = pyproj.CRS.from_user_input(UTM).to_wkt()
GRID = Affine(12.5, 0, 500000.0, 0, -12.5, 3300025.0)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (700, 900)])
def test_float_rasters_are_valid_cogs_with_units_and_nodata(tmp_path, shape):
    values = np.random.default_rng(1).random((2, *shape))
    values[0, 0, 0] = np.nan
    layer = float_layer(["f mean", "f sd"], ["cycles/m", "cycles/m"], {"RUN_ID": "x"})
    path = tmp_path / "a.tif"
    write_cog(path, values, layer, GRID, WKT, tmp_path / "scratch")
    valid, errors, warnings = cog_validate(path, strict=True)
    assert valid, (errors, warnings)
    with rasterio.open(path) as source:
        np.testing.assert_array_equal(source.read(), values.astype("float32"))
        assert np.isnan(source.nodata)
        assert source.descriptions == ("f mean", "f sd")
        assert source.units == ("cycles/m", "cycles/m")
        assert source.transform == GRID
        assert source.crs.to_epsg() == 32617
        assert source.tags()["RUN_ID"] == "x"
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["a.tif"]


def test_class_rasters_have_colours_and_names(tmp_path):
    categories = {0: Category("no data", (0, 0, 0, 0)), 2: Category("a & b", (1, 2, 3, 255))}
    layer = Layer(["class"], [""], 0, "uint8", categories)
    path = tmp_path / "c.tif"
    write_cog(path, np.array([[[0, 2]]]), layer, GRID, WKT, tmp_path / "scratch")
    assert cog_validate(path, strict=True)[0]
    with rasterio.open(path) as source:
        assert source.nodata == 0
        assert source.colormap(1)[2] == (1, 2, 3, 255)
    assert "a &amp; b" in (tmp_path / "c.tif.aux.xml").read_text()


def test_same_values_same_bytes(tmp_path):
    layer = float_layer(["a"], ["m"])
    for name in ("a.tif", "b.tif"):
        write_cog(tmp_path / name, np.ones((1, 5, 5)), layer, GRID, WKT, tmp_path / name[0])
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def write_half(path, scratch):
    with written_whole(path, scratch) as part:
        part.write_text("half")
        assert part.suffix != ".txt"
        raise RuntimeError("stop")


def test_a_failed_write_leaves_the_old_file_and_no_scrap(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old", tmp_path / "scratch")
    with pytest.raises(RuntimeError, match="stop"):
        write_half(path, tmp_path / "scratch")
    assert path.read_text() == "old"
    assert list((tmp_path / "scratch").iterdir()) == []
