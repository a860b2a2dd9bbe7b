"""Tiles that show the same floor at two places are told; others are not."""

import numpy as np
import pytest
from affine import Affine
from scipy.ndimage import gaussian_filter

from sasmap.survey.gains import compare_tiles
from sasmap.survey.offsets import offset_between
from sasmap.survey.tiles import inspect_tile
from tests.helpers import write_tile

CRS = "EPSG:32617"


def floor(rng, shape, rippled):
    level = np.exp(0.2 * gaussian_filter(rng.standard_normal(shape), 8) * 8)
    column = np.arange(shape[1])
    return level * (1 + 0.5 * np.sin(2 * np.pi * column / 33)) if rippled else level


@pytest.mark.parametrize("rippled", [False, True])
@pytest.mark.parametrize("moved", [(0, 8), (-5, 0), (12, -30), (0, 40)])
def test_the_offset_is_found_in_rows_and_columns(moved, rippled):
    rng = np.random.default_rng(3)
    shown = floor(rng, (400, 400), rippled) * rng.rayleigh(size=(400, 400))
    row, column = 100 - moved[0], 100 - moved[1]
    first, second = shown[100:292, 100:180].copy(), shown[row : row + 192, column : column + 80]
    first[:30, :20] = np.nan
    np.testing.assert_allclose(offset_between(first, second), moved, atol=1e-9)


@pytest.mark.parametrize("rippled", [False, True])
def test_images_in_place_or_of_other_floor_have_no_offset(rippled):
    rng = np.random.default_rng(4)
    level = floor(rng, (192, 192), rippled)
    one, other = (level * rng.rayleigh(size=level.shape) for _ in range(2))  # two sets of pings
    assert offset_between(one, one) is None
    assert offset_between(one, other) is None
    assert offset_between(one, np.roll(one, 1, axis=1)) is None  # as resampling may do
    assert offset_between(one, rng.rayleigh(size=level.shape)) is None
    assert offset_between(one, np.full(level.shape, np.nan)) is None


@pytest.mark.parametrize("shift", [0, 8, 40])
def test_a_tile_that_is_placed_wrongly_is_named_with_the_distance(tmp_path, shift):
    rng = np.random.default_rng(5)
    shown = floor(rng, (300, 600), rippled=True) * rng.rayleigh(size=(300, 600))
    found = []
    for k, (start, place) in enumerate(((0, 0), (250, 250 + shift))):
        path = tmp_path / f"{k}.tif"
        corner = Affine(0.05, 0, 500000 + 0.05 * place, 0, -0.05, 3300000)
        write_tile(path, shown[:, start : start + 350].astype("float32"), corner)
        found.append(inspect_tile(path, "linear", False))
    told = compare_tiles(tuple(found), CRS)
    if not shift:
        assert told == []
        return
    (line,) = told
    assert f"1.tif: shows the same sea floor {0.05 * shift:.2g} m from where 0.tif" in line
