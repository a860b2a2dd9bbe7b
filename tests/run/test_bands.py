"""Bands of gain over range look like ripples along the track: that is said."""

from types import SimpleNamespace

import numpy as np
import pytest

from sasmap.run.bands import bands_or_ripples
from sasmap.survey.navigation import Track

NORTH = np.arange(0.0, 101.0)
SWATH = SimpleNamespace(
    sonar_pass=SimpleNamespace(track=Track(np.zeros(101), NORTH, np.full(101, 5.0)))
)


def survey(*looks):
    """Cells by one swath east of a northward track: (range, azimuth, f) of each."""
    cells = {
        (0, i): [SimpleNamespace(centre=(reach, 50.0), azimuth=(turn, 0.1), mean=(f, 0.05))]
        for i, (reach, turn, f) in enumerate(looks)
    }
    return cells, {cell: SimpleNamespace(group=(0,)) for cell in cells}, [SWATH]


@pytest.mark.parametrize(
    "looks",
    [
        [(15, 90.3, 0.7)],
        [(15, 89.5, 0.74), (15, 90.2, 0.76)],
        [(15, 89.5, 3.0), (22, 91.0, 1.7)],
    ],
)
def test_crests_along_the_track_may_be_bands(looks):
    assert f"all {len(looks)} rippled cells" in bands_or_ripples(*survey(*looks))


@pytest.mark.parametrize(
    "looks",
    [
        [],
        [(15, 80.0, 0.7)],
        [(15, 90.0, 0.7), (15, 60.0, 0.7)],
        [(15, 90.0, 0.70), (22, 90.0, 0.71)],  # bands have another wavelength there
    ],
)
def test_ripples_that_bands_do_not_make(looks):
    assert bands_or_ripples(*survey(*looks)) == ""


def test_cells_without_an_estimate_say_nothing():
    cells, fused, swaths = survey((15, 90.0, 0.7))
    fused[0, 0] = SimpleNamespace(group=())
    assert bands_or_ripples(cells, fused, swaths) == ""
