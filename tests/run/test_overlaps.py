"""Cells that overlap: their geometry in every product, and no pixel that counts twice."""

import shutil

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
import xarray as xr
from affine import Affine

import sasmap
from sasmap.passes.summary import Summary
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.run import combining
from sasmap.run.cost import cost_of
from sasmap.run.overlaps import apart, blended, covered, met, sharing
from sasmap.run.pipeline import run_survey
from sasmap.run.plan import describe, make_plan
from tests.helpers import small_survey, write_tile

WINDOW, PIXEL, WAVELENGTH, SIDE = 120, 0.05, 14, 240
LEFT, TOP = 500020.0, 3300020.0


def survey(folder, overlap):
    """Ripples everywhere but in the lower left corner; returns the survey's file."""
    ripples = {"draws": 100, "overlap": overlap, "keep_model": True}
    path = small_survey(folder, window=WINDOW, ripples=ripples, sediments={"classes": 1})
    row, column = np.indices((SIDE, SIDE))
    inside = (row < 110) | (column > 130)
    level = 1 + 0.7 * inside * np.sin(2 * np.pi / WAVELENGTH * (column + 0.3 * row))
    values = 80 * np.sqrt(level * np.random.default_rng(3).exponential(1.0, inside.shape))
    corner = Affine(PIXEL, 0, LEFT, 0, -PIXEL, TOP)
    write_tile(folder / "tiles" / "a.tif", values.astype("float32"), corner, nodata=float("nan"))
    return path


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("overlap")
    path = survey(folder, 0.5)
    learned = []

    def learn(cells, *rest):
        learned.append(len(cells))
        return original(cells, *rest)

    original, combining.learn_survey = combining.learn_survey, learn
    try:
        outcome = run_survey(sasmap.load_survey(path), workers=1)
    finally:
        combining.learn_survey = original
    assert outcome.failures == []
    return path.parent / "out", outcome, learned


def test_a_raster_has_a_pixel_for_each_cell_about_its_centre(found):
    with rasterio.open(found[0] / "ripple_frequency.tif") as source:
        assert source.shape == (3, 3)
        assert tuple(source.transform)[:6] == (3, 0, LEFT + 1.5, 0, -3, TOP - 1.5)
        frequency = source.read(1)
    known = np.isfinite(frequency)
    assert known.sum() >= 6
    assert not known[2, 0]
    np.testing.assert_allclose(frequency[known], np.hypot(1, 0.3) / (WAVELENGTH * PIXEL), rtol=0.05)


def test_cells_have_their_real_extents(found):
    output, _, _ = found
    _, _, shapes, _ = pyogrio.raw.read(output / "ripple_cells.gpkg")
    squares = shapely.from_wkb(shapes)
    np.testing.assert_allclose(shapely.area(squares), (WINDOW * PIXEL) ** 2)
    np.testing.assert_allclose(squares[1].bounds, (LEFT + 3, TOP - 6, LEFT + 9, TOP))
    with xr.open_dataset(output / "ripples.nc") as cells:
        assert cells.x.attrs["bounds"] == "x_bounds"
        np.testing.assert_allclose(cells.x_bounds[1], [LEFT + 3, LEFT + 9])
        np.testing.assert_allclose(cells.y_bounds[0], [TOP - 6, TOP])
        np.testing.assert_allclose(cells.x, LEFT + 3 + 3 * np.arange(3))


def test_what_the_survey_shares_is_learned_from_cells_that_share_no_pixel(found):
    assert found[2] == [4]
    assert len(found[1].fused) == 9


def test_the_extent_and_the_model_cover_the_map_without_a_seam(found):
    output, _, _ = found
    _, _, shapes, _ = pyogrio.raw.read(output / "ripple_extent.gpkg")
    truth = (SIDE**2 - 130 * 130) * PIXEL**2
    assert abs(sum(shapely.area(shapely.from_wkb(shapes))) / truth - 1) < 0.08
    with rasterio.open(output / "modelled_amplitude.tif") as source:
        model = source.read(1)
    assert model.shape == (SIDE, SIDE)
    across = np.abs(np.diff(model[:100], axis=0))
    # along the border between cells of the map as anywhere else
    assert np.nanmean(across[:, WINDOW - 3 : WINDOW + 3]) < 1.5 * np.nanmean(across)
    with rasterio.open(output / "sediment_class.tif") as source:
        assert (source.read(1) > 0).mean() > 0.9


def test_the_plan_counts_them(found, tmp_path):
    path = found[0].parent / "survey.yaml"
    plan = make_plan(sasmap.load_survey(path))
    text = "\n".join(describe(plan))
    assert "3 rows x 3 columns of 6 m, every 3 m" in text
    assert "9 looks, at most 1 per cell" in text
    cost = cost_of(plan, 1)
    assert (cost.looks, cost.finished) == (9, 9)


def test_without_overlap_a_cell_shares_pixels_with_itself_alone(tmp_path):
    plan = make_plan(sasmap.load_survey(survey(tmp_path, 0.0)))
    assert plan.ripples is plan
    for cell in plan.cells:
        (alone,) = sharing(plan, cell)
        assert alone.cell == cell
        assert covered(plan, cell, {cell: 1}).all()
    assert met(plan, [(1, 0)]) == {(1, 0)}
    assert apart(plan, {cell: [] for cell in plan.cells}) == list(plan.cells)


@pytest.mark.parametrize("overlap", [0.5, 0.3, 0.75])
def test_cells_apart_share_no_pixel_and_blends_keep_what_all_say(tmp_path, overlap):
    plan = make_plan(sasmap.load_survey(survey(tmp_path, overlap)))
    cells = list(plan.ripples.cells)
    none = Summary(Quality.NO_RIPPLES, LeftOut.SAMPLING)
    chosen = apart(plan, {cell: [none] for cell in cells})
    assert chosen
    images = {cell: np.full((WINDOW, WINDOW), 2.5, np.float32) for cell in cells}
    for cell in plan.cells:
        seen = sum(covered(plan, cell, {one: 1}).astype(int) for one in chosen)
        assert np.max(seen) <= 1
        np.testing.assert_allclose(blended(plan, cell, images), 2.5)
    shutil.rmtree(tmp_path)
