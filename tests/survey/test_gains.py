"""Gains of tiles that meet: steps are told, ripples along the seam are none."""

import numpy as np
import pytest
from affine import Affine

from sasmap.survey.gains import compare_tiles
from sasmap.survey.tiles import inspect_tile
from tests.helpers import write_tile

CRS = "EPSG:32617"


def tiles(folder, amplitude, cut):
    """Two tiles side by side, cut at a column."""
    parts = ((0, amplitude[:, :cut]), (cut, amplitude[:, cut:]))
    found = []
    for k, (column, values) in enumerate(parts):
        path = folder / f"{k}.tif"
        write_tile(
            path,
            values.astype("float32"),
            Affine(0.05, 0, 500000 + 0.05 * column, 0, -0.05, 3300000),
        )
        found.append(inspect_tile(path, "linear", False))
    return tuple(found)


@pytest.mark.parametrize("gain", [0.0, 5.0])
@pytest.mark.parametrize("rippled", [False, True])
def test_a_step_is_told_whether_or_not_crests_run_along_the_seam(tmp_path, gain, rippled):
    rng = np.random.default_rng(3)
    column = np.arange(800)
    # the cut lies between a trough and a crest of 66 pixels
    wave = np.where(np.sin(2 * np.pi * (column - 400) / 66) > 0, 1.6, 0.5) if rippled else 1.0
    amplitude = (
        rng.rayleigh(size=(400, 800)) * wave * np.where(column < 400, 1.0, 10 ** (gain / 20))
    )
    told = compare_tiles(tiles(tmp_path, amplitude, 400), CRS)
    assert len(told) == (1 if gain else 0)
