"""A wave too long for a cell is estimated in what lies around it."""

import numpy as np
import pytest
import xarray as xr
from affine import Affine

import sasmap
from sasmap.run.pipeline import run_survey
from sasmap.run.plan import make_plan
from sasmap.run.suggestion import describe_window
from tests.helpers import small_survey, write_tile

WINDOW, PIXEL, WAVELENGTH = 120, 0.05, 50  # pixels: 2.4 waves a cell


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("long")
    path = small_survey(folder, window=WINDOW, ripples={"draws": 300})
    rng = np.random.default_rng(3)
    row, column = np.indices((2 * WINDOW, 3 * WINDOW))
    phase = 2 * np.pi / WAVELENGTH * (column + 0.2 * row)
    values = 80 * np.sqrt((1 + 0.8 * np.sin(phase)) * rng.exponential(1.0, row.shape))
    corner = Affine(PIXEL, 0, 500020.0, 0, -PIXEL, 3300020.0)
    write_tile(folder / "tiles" / "a.tif", values.astype("float32"), corner, nodata=float("nan"))
    output = folder / "out"
    first = run_survey(sasmap.load_survey(path), output=output, workers=1)
    again = run_survey(sasmap.load_survey(path), output=output, workers=1)
    return output, first, again


def test_long_waves_are_estimated_in_a_wider_window(found):
    output, first, _ = found
    assert first.failures == []
    with xr.open_dataset(output / "ripples.nc") as looks:
        window = looks["window"].values
        frequency = looks["frequency_alone_mean"].values
    wide = window == 2
    assert wide.sum() >= 2
    known = np.hypot(1, 0.2) / (WAVELENGTH * PIXEL)
    np.testing.assert_allclose(frequency[wide], known, rtol=0.02)


def test_the_plan_suggests_a_window_that_holds_eight_waves(found):
    plan = make_plan(sasmap.load_survey(found[0].parent / "survey.yaml"))
    (line,) = describe_window(plan)
    eight = 8 * WAVELENGTH / np.hypot(1, 0.2)
    wanted = int(line.split(" px hold eight")[0].split()[-1])
    assert abs(wanted / eight - 1) < 0.1
    assert f"{WINDOW} px hold 2.4" in line


def test_the_plan_names_the_window_where_a_cell_holds_hardly_one_wave(found):
    plan = make_plan(
        sasmap.load_survey(found[0].parent / "survey.yaml").model_copy(update={"window": 40})
    )
    (line,) = describe_window(plan)
    assert "wavelengths of about 2.5 m" in line
    assert "40 px hold 0.8; 400 px hold eight" in line


def test_wider_estimates_are_kept(found):
    _, first, again = found
    assert (again.computed, again.kept) == (0, first.computed + first.kept)
