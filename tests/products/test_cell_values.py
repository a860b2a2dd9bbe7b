import csv
import json
from dataclasses import replace

import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
import shapely
import xarray as xr
from affine import Affine

import sasmap
from sasmap.catalogue import BY_FILE, CATALOGUE, Band, Product, Ramp
from sasmap.errors import InputError
from sasmap.passes.cell_estimate import CellEstimate
from sasmap.passes.derived import Derived
from sasmap.products.cell_values import (
    VALUES,
    attributes,
    cell_results,
    label,
    measured,
    statistics,
)
from sasmap.products.netcdf import _combined
from sasmap.products.ranges import padded_range, range_of
from sasmap.products.ripples import write_ripple_rasters


def read(folder, name):
    with rasterio.open(folder / name) as source:
        return source.read()


def test_lengths_and_heights_follow_from_f_and_a_h(sample):
    output, _ = sample
    f, height = read(output, "ripple_frequency.tif"), read(output, "ripple_height.tif")
    length, crest = (read(output, f"ripple_{n}.tif") for n in ("wavelength", "crest_to_trough"))
    steep = read(output, "ripple_steepness.tif")
    np.testing.assert_allclose(crest, 2 * height, rtol=1e-6)
    np.testing.assert_allclose(length[2], 1 / f[3], rtol=1e-6)  # quantiles change places
    np.testing.assert_allclose(length[3], 1 / f[2], rtol=1e-6)
    np.testing.assert_allclose(length[0], (1 + (f[1] / f[0]) ** 2) / f[0], rtol=1e-4)
    np.testing.assert_allclose(length[1], f[1] / f[0] ** 2, rtol=0.02)
    np.testing.assert_allclose(steep[0], 2 * height[0] * f[0], rtol=1e-3)
    known = np.isfinite(steep[0])
    assert known.sum() == 4
    assert (steep[2] < steep[0])[known].all()
    assert (steep[0] < steep[3])[known].all()


def test_bands_say_what_they_hold(sample):
    output, _ = sample
    with rasterio.open(output / "ripple_height.tif") as source:
        assert all("half the height from trough to crest" in d for d in source.descriptions)
    for product in CATALOGUE:
        path = output / product.file
        if product.bands and path.exists():
            with rasterio.open(path) as source:
                assert source.descriptions == tuple(b.text for b in product.bands)
                assert [u or "" for u in source.units] == [b.unit for b in product.bands]


def test_cells_are_polygons_with_all_that_is_known(sample):
    output, _ = sample
    meta, _, shapes, arrays = pyogrio.raw.read(output / "ripple_cells.gpkg")
    cells = dict(zip(meta["fields"], arrays, strict=True))
    squares = shapely.from_wkb(shapes)
    assert meta["crs"] == "EPSG:32617"
    np.testing.assert_allclose(shapely.area(squares), 12.5**2)
    for name, file in (("wavelength", "ripple_wavelength.tif"), ("height", "ripple_height.tif")):
        bands = read(output, file)
        for i, statistic in enumerate(("mean", "sd", "q05", "q95")):
            raster = bands[i][cells["row"], cells["column"]]
            np.testing.assert_allclose(cells[f"{name}_{statistic}"], raster, rtol=1e-6)
    rippled = cells["column"] < 2
    assert (cells["quality"][rippled] == 1).all()
    assert set(cells["reason"][~rippled]) == {"examined, and no ripples found"}
    assert all("near" in p or "far" in p for p in cells["passes"][rippled])
    for row, text in zip(cells["row"][rippled], cells["label"][rippled], strict=True):
        assert text.startswith("λ 1.6" if row == 0 else "λ 1.5")
    with rasterio.open(output / "ripple_quality.tif") as source:
        for square, code in zip(squares, cells["quality"], strict=True):
            x, y = square.centroid.x, square.centroid.y
            assert next(source.sample([(x, y)]))[0] == code


def test_the_table_of_cells_is_that_of_the_polygons(sample):
    output, _ = sample
    with (output / "ripple_cells.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert float(rows[0]["x"]) == 500006.25
    assert float(rows[0]["y"]) == 3300018.75
    heights = read(output, "ripple_crest_to_trough.tif")[0]
    for row in rows:
        value = heights[int(row["row"]), int(row["column"])]
        told = row["crest_to_trough_mean"]
        assert told == "" if np.isnan(value) else float(told) == pytest.approx(value, rel=1e-6)


def test_netcdf_has_one_combined_variable_a_quantity(sample):
    output, _ = sample
    with xr.open_dataset(output / "ripples.nc") as found:
        assert found.attrs["Conventions"] == "CF-1.11"
        for name in ("frequency", "height", "wavelength", "crest_to_trough", "steepness"):
            raster = read(output, f"ripple_{name}.tif")
            np.testing.assert_allclose(found[name].values, raster, rtol=1e-6)
            assert found[name].dims == ("statistic", "y", "x")
        assert found.statistic.values.tolist() == ["mean", "sd", "q05", "q95"]
        assert all("long_name" in found[v].attrs for v in found.data_vars if v != "spatial_ref")


def test_netcdf_keeps_to_the_conventions(sample):
    checker = pytest.importorskip("compliance_checker.runner")
    output, _ = sample
    checker.CheckSuite.load_all_available_checkers()
    passed, errors = checker.ComplianceChecker.run_checker(
        str(output / "ripples.nc"), ["cf:1.11"], 0, "strict", output_filename="-"
    )
    assert passed
    assert not errors


def test_a_run_is_read_back(sample, tmp_path):
    output, _ = sample
    found = sasmap.open_run(output)
    mean = found.cells.wavelength.sel(statistic="mean").values
    np.testing.assert_allclose(mean, read(output, "ripple_wavelength.tif")[0], rtol=1e-6)
    assert found.cells["pass"].values.tolist() == ["near", "far"]
    assert found.areas["class"].nunique() == 3
    assert found.areas["area_m2"].sum() > 500
    assert found.record["cells_by_quality"]["good"] == 4
    with pytest.raises(InputError, match="expected the output folder of a run"):
        sasmap.open_run(tmp_path)


def test_json_has_no_nan(sample):
    output, _ = sample

    def refuse(text):
        raise AssertionError(text)

    paths = list(output.rglob("*.json"))
    assert len(paths) > 12
    for path in paths:
        json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_values_are_told_with_the_digits_that_are_known():
    assert measured(0.14073, 0.00137) == "0.1407 ± 0.0014"
    assert measured(12.3456, 1.2) == "12.3 ± 1.2"
    assert measured(1234.5, 250.0) == "1234 ± 250"
    assert measured(0.5, float("nan")) == "0.5"


def test_labels_tell_millimetres_at_most():
    derived = Derived((1.66618, 0.00031), (0.08, 0.01, 0.07, 0.09))
    estimate = CellEstimate((0.6, 0.07037), (1e-4, 7e-4), (0.59, 0.06), (0.61, 0.08), (90.0, 1.0))
    assert label(replace(estimate, derived=derived)) == "λ 1.666 m\nH 0.141 ± 0.001 m"
    derived = Derived((12.3456, 0.8), (0.08, 0.01, 0.07, 0.09))
    assert label(replace(estimate, derived=derived)).startswith("λ 12.35 ± 0.80 m")
    assert label(CellEstimate()) == ""


def test_a_wide_posterior_of_f_gives_a_skewed_wavelength():
    estimate = CellEstimate((0.5, 0.1), (0.1, 0.02), (0.34, 0.07), (0.66, 0.13))
    _, _, low, high = statistics(estimate, "wavelength")
    assert low == pytest.approx(1 / 0.66)
    assert high == pytest.approx(1 / 0.34)


def test_colours_span_at_least_what_is_uncertain(sample):
    output, _ = sample
    for file in ("ripple_frequency.tif", "ripple_wavelength.tif", "ripple_steepness.tif"):
        bands = read(output, file)
        low, high = range_of(output / file)
        assert high - low >= 3.9 * np.nanmedian(bands[1])
        assert low <= np.nanmin(bands[0])
        assert np.nanmax(bands[0]) <= high
    assert padded_range(np.array([2.0, 5.0]), np.array([0.1])) == pytest.approx((2.0, 5.0))
    low, high = padded_range(np.array([1e-3]), np.array([0.01]))
    assert low == 0.0  # a height is not negative
    assert high == pytest.approx(0.021)


def test_a_new_product_takes_one_entry_and_one_writer(sample, tmp_path, monkeypatch):
    _, outcome = sample
    entry = Product(
        "ripple_age.tif",
        "ripples",
        "cells",
        "Age",
        "How old.",
        (Band("age", "d"),),
        Ramp("viridis"),
    )
    monkeypatch.setattr("sasmap.products.ripples.CATALOGUE", (entry,))
    monkeypatch.setattr("sasmap.products.cell_values.CATALOGUE", (*CATALOGUE, entry))
    monkeypatch.setitem(VALUES, "ripple_age.tif", lambda cell: [float(len(cell.used))])
    results = cell_results(outcome.cells, outcome.fused, ["near", "far"])
    place = Affine(12.5, 0, 500000, 0, -12.5, 3300025), pyproj.CRS.from_epsg(32617).to_wkt()
    (path,) = write_ripple_rasters(tmp_path, results, (2, 3), *place, {}, tmp_path)
    with rasterio.open(path) as source:
        assert source.descriptions == ("age",)
        assert source.units == ("d",)
        assert set(source.read(1).ravel()) <= {0.0, 1.0, 2.0}
    used = [len(result.used) for result in results.values()]
    assert attributes(list(results.values()))["age"] == used
    dims, values, about = _combined(results, (2, 3))["cell_age"]
    assert dims == ("y", "x")
    assert values.ravel().tolist() == used
    assert about["units"] == "d"


def test_titles_of_the_catalogue_are_all_different():
    assert len({p.title for p in CATALOGUE}) == len(CATALOGUE) == len(BY_FILE)
