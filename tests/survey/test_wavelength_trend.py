"""Ripples whose length changes over range tell which range the tiles have."""

import numpy as np
import pytest
from affine import Affine
from scipy.ndimage import gaussian_filter

from tests.survey.test_kinds import Folder, track

SIDE, PIXEL, ALTITUDE, NEAR = 500, 0.025, 5.0, 7.0
NORTH = np.arange(3299985.0, 3300022.0, 0.5)


def opened(path, shown, told, bent=0.0, seed=0):
    """Warnings of a tile of ripples in one range, told to be in another."""
    rng = np.random.default_rng(seed)
    distance = NEAR + PIXEL * (np.arange(SIDE) + 0.5)
    ground = distance if shown == "ground" else np.sqrt(distance**2 - ALTITUDE**2)
    wander = gaussian_filter(rng.normal(size=(SIDE, SIDE)), 120, mode="wrap")
    phase = 2 * np.pi * 0.8 * ground + bent * wander / wander.std()
    values = 40 * (1 + 0.5 * np.sin(phase)) * rng.rayleigh(1.0, (SIDE, SIDE))
    folder = Folder(path)
    place = Affine(PIXEL, 0, 500000.0 + NEAR, 0, -PIXEL, 3300012.5)
    folder.tile(values.astype("float32"), transform=place)
    folder.pings(track(north=NORTH, altitude=ALTITUDE))
    folder.keys["range"] = told
    return " ".join(folder.open().warnings)


@pytest.mark.parametrize(("shown", "told"), [("ground", "slant"), ("slant", "ground")])
def test_straight_ripples_tell_a_range_that_is_told_wrongly(tmp_path, shown, told):
    assert f"expected range: {shown}" in opened(tmp_path, shown, told)


@pytest.mark.parametrize("shown", ["ground", "slant"])
@pytest.mark.parametrize("bent", [0.0, 0.5, 1.0])
def test_ripples_that_are_told_rightly_are_not_doubted(tmp_path, shown, bent):
    assert opened(tmp_path, shown, shown, bent, seed=int(10 * bent)) == ""
