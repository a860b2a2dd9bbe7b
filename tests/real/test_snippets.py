"""Recorded synthetic aperture images: ripples where a person sees them (skipped without them)."""

import numpy as np
import pytest
import rasterio

from sasmap.ripples.detection import find_waves
from sasmap.ripples.image import as_image
from tests.helpers import SHARED, clip_of

WINDOW = 128
RIPPLED = [
    ("31", 3, 3), ("31", 2, 3), ("17", 1, 1), ("17", 2, 2), ("17", 3, 3),
    ("20", 0, 3), ("20", 1, 3), ("20", 3, 2),
]  # fmt: skip
FLAT = [("17", 0, c) for c in range(4)] + [("17", 1, c) for c in (0, 2, 3)]
FLAT += [("20", r, 0) for r in range(4)]
FLAT += [("02", r, c) for r in range(3) for c in range(4)] + [("02", 3, c) for c in (1, 2, 3)]


def probability(snippet, row, column):
    path = SHARED / "sassed" / f"snippet_{snippet}.tif"
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    with rasterio.open(path) as tile:
        values = tile.read(1).astype(float)
    part = values[WINDOW * row : WINDOW * (row + 1), WINDOW * column : WINDOW * (column + 1)]
    reach = 20 + 0.05 * (WINDOW * column + np.arange(part.shape[1]))
    return find_waves(as_image(clip_of(part, reach, 5.0, 0.05)), (0.05, 5.0)).probability


@pytest.mark.parametrize(("snippet", "row", "column"), RIPPLED)
def test_forked_and_short_crested_ripples_are_found(snippet, row, column):
    assert probability(snippet, row, column) > 0.5


@pytest.mark.parametrize(("snippet", "row", "column"), FLAT)
def test_flat_floors_stay_without_ripples(snippet, row, column):
    assert not probability(snippet, row, column) > 0.5
