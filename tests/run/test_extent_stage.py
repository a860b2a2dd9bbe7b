"""Outlines across cells: a rippled disc on four cells, most of it in one."""

import sqlite3

import numpy as np
import pytest
import shapely
from affine import Affine

import sasmap
from sasmap.run.pipeline import run_survey
from tests.helpers import small_survey, write_tile

WINDOW, PIXEL, WAVELENGTH = 200, 0.05, 20
CENTRE, RADIUS = (175, 185), 110  # row, column; pixels


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("disc")
    path = small_survey(folder, window=WINDOW, ripples={"draws": 100})
    rng = np.random.default_rng(3)
    row, column = np.indices((2 * WINDOW, 2 * WINDOW))
    inside = (row - CENTRE[0]) ** 2 + (column - CENTRE[1]) ** 2 < RADIUS**2
    phase = 2 * np.pi / WAVELENGTH * (column + 0.3 * row)
    level = 1 + 0.6 * inside * np.sin(phase)
    values = 80 * np.sqrt(level * rng.exponential(1.0, inside.shape))
    corner = Affine(PIXEL, 0, 500020.0, 0, -PIXEL, 3300020.0)
    write_tile(folder / "tiles" / "a.tif", values.astype("float32"), corner, nodata=float("nan"))
    outputs = [folder / name for name in ("first", "second")]
    for output, workers in zip(outputs, (1, 2), strict=True):
        outcome = run_survey(sasmap.load_survey(path), output=output, workers=workers)
        assert outcome.failures == []
    return outputs


def test_the_outline_goes_on_across_cells_also_where_too_few_waves_are_left_to_find(found):
    base = sqlite3.connect(found[0] / "ripple_extent.gpkg")
    rows = base.execute("SELECT area, wavelength FROM extent").fetchall()
    base.close()
    assert len(rows) == 1
    area, wavelength = rows[0]
    assert abs(area / (np.pi * (RADIUS * PIXEL) ** 2) - 1) < 0.05
    assert abs(wavelength / (WAVELENGTH * PIXEL / np.hypot(1, 0.3)) - 1) < 0.05


def test_the_outline_lies_within_half_a_wavelength_of_the_truth(found):
    import pyogrio

    _, _, shapes, _ = pyogrio.raw.read(found[0] / "ripple_extent.gpkg")
    edge = shapely.segmentize(shapely.from_wkb(shapes[0]).exterior, 0.1)
    x, y = shapely.get_coordinates(edge).T
    away = np.hypot(x - 500020 - PIXEL * (CENTRE[1] + 0.5), 3300020 - y - PIXEL * (CENTRE[0] + 0.5))
    distance = np.abs(away - RADIUS * PIXEL)
    assert distance.mean() < 0.5 * WAVELENGTH * PIXEL
    assert distance.max() < 1.5 * WAVELENGTH * PIXEL


def test_bytes_do_not_depend_on_the_number_of_workers(found):
    first, second = ((f / "ripple_extent.gpkg").read_bytes() for f in found)
    assert first == second
