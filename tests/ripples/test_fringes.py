"""Bands of gain are evenly spaced in grazing angle, ripples in range."""

import numpy as np
import pytest

from sasmap.ripples import estimate
from sasmap.ripples.detection import Unclear, find_waves
from sasmap.ripples.image import as_image
from sasmap.ripples.posterior import Quality
from tests.helpers import clip_of

SIZE, PIXEL, ALTITUDE = 300, 0.05, 5.0


def seen(coordinate, near, contrast=0.4, waves=6, turn=0.0):
    """A clip whose intensity is a wave in a function of the ground range."""
    reach = near + PIXEL * (np.arange(SIZE) + 0.5)
    place = coordinate(reach)
    place = (place - place.min()) / np.ptp(place)
    row = np.arange(SIZE)[:, None] / SIZE
    level = 1 + contrast * np.sin(2 * np.pi * (waves * place + turn * row))
    speckle = np.random.default_rng(1).exponential(1.0, (SIZE, SIZE))
    return clip_of(np.sqrt(level * speckle), reach, ALTITUDE, PIXEL)


def angle(reach):
    return np.arctan2(reach, ALTITUDE)


def lloyd(reach):
    """Difference of two paths, of which one is reflected."""
    return -1 / np.hypot(reach, ALTITUDE)


@pytest.mark.parametrize("coordinate", [angle, lloyd])
@pytest.mark.parametrize("near", [20.0, 35.0])
def test_bands_that_follow_the_grazing_angle_are_not_identifiable(coordinate, near):
    posterior = estimate(seen(coordinate, near), rng=1)
    assert posterior.quality is Quality.NOT_IDENTIFIABLE
    assert posterior.reason == Unclear.BANDS


@pytest.mark.parametrize("near", [15.0, 35.0, 100.0])
@pytest.mark.parametrize("contrast", [0.1, 0.8])
def test_straight_ripples_along_the_track_are_found_at_every_range(near, contrast):
    found = find_waves(as_image(seen(lambda reach: reach, near, contrast)), (0.05, 5.0))
    assert found.unclear is None
    assert found.probability > 0.9


@pytest.mark.parametrize("near", [20.0, 35.0])
def test_ripples_across_which_the_wavelength_drifts_are_found(near):
    found = find_waves(
        as_image(seen(lambda reach: reach + 0.005 * (reach - near) ** 2, near)), (0.05, 5.0)
    )
    assert found.unclear is None
    assert found.probability > 0.9


def test_crests_that_are_not_along_the_track_are_no_bands():
    found = find_waves(as_image(seen(angle, 35.0, turn=0.8)), (0.05, 5.0))
    assert found.unclear is not Unclear.BANDS
