"""The sediment of each cell, read from the map; what the second stage makes of it."""

from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from sasmap.ripples.posterior import Quality
from sasmap.run import combining
from sasmap.run.combining import _unseen, classes_of_cells, combine_cells
from sasmap.run.manifest import Outcome
from sasmap.survey.cells import CellGrid

WINDOW, SIZE = 100, 5.0


def grid(spacing=SIZE):
    count = int((2 * SIZE - SIZE) / spacing) + 1
    return CellGrid("EPSG:32632", 300.0, 900.0, SIZE, count, count, spacing)


def mapped(path, codes):
    place = grid().pixels(WINDOW)
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 1, "nodata": 0, "transform": place}
    rows, columns = codes.shape
    with rasterio.open(path, "w", height=rows, width=columns, crs="EPSG:32632", **profile) as to:
        to.write(codes, 1)
    return path


@pytest.fixture
def codes():
    """Class 1 in the west; in the east class 2, with half of the south-eastern cell unmapped."""
    found = np.ones((2 * WINDOW, 2 * WINDOW), np.uint8)
    found[:, WINDOW + 5 :] = 2
    found[150:, 150:] = 0
    return found


def test_a_cell_is_of_the_class_that_has_nearly_all_of_it(tmp_path, codes):
    cells = [(0, 0), (0, 1), (1, 0), (1, 1)]
    found = classes_of_cells(mapped(tmp_path / "map.tif", codes), grid(), cells, 2)
    assert found == {(0, 0): 1, (0, 1): 2, (1, 0): 1, (1, 1): 0}


def test_objects_are_no_sediment_and_overlapping_cells_have_their_own_pixels(tmp_path, codes):
    path = mapped(tmp_path / "map.tif", codes)
    assert classes_of_cells(path, grid(), [(0, 1)], 1) == {(0, 1): 0}
    assert classes_of_cells(path, grid(), [(0, 1)], 0) == {(0, 1): 0}
    overlapping = classes_of_cells(path, grid(SIZE / 2), [(0, 0), (0, 1), (0, 2)], 2)
    assert overlapping == {(0, 0): 1, (0, 1): 0, (0, 2): 2}


def test_the_second_stage_is_told_the_sediments_of_the_map(tmp_path, codes, monkeypatch):
    told = {}

    def learn(cells, settings, seed, classes):
        told["learned"] = list(classes)

    def fuse(cells, settings, survey, classes):
        told["combined"] = list(classes)
        return [None] * len(cells)

    monkeypatch.setattr(combining, "learn_survey", learn)
    monkeypatch.setattr(combining, "fuse_cells", fuse)
    plan = SimpleNamespace(
        settings=SimpleNamespace(ripples=object(), seed=1),
        opened=SimpleNamespace(grid=grid()),
        swaths=(),
    )
    plan.ripples = plan
    outcome = Outcome(tmp_path, cells={(0, 0): [None], (0, 1): [None]})
    combine_cells(plan, outcome)
    assert told == {"learned": [0, 0], "combined": [0, 0]}
    outcome.written = [mapped(tmp_path / "sediment_class.tif", codes)]
    outcome.sediments = [{"number": 1, "law": "k"}, {"number": 2, "law": "k"}]
    combine_cells(plan, outcome)
    assert told == {"learned": [1, 2], "combined": [1, 2]}


def test_a_pass_that_misses_the_ripples_of_another_is_told():
    def seen(*qualities):
        return [None if q is None else SimpleNamespace(quality=q) for q in qualities]

    good, none, odd = Quality.GOOD, Quality.NO_RIPPLES, Quality.NOT_IDENTIFIABLE
    plan = SimpleNamespace(swaths=[SimpleNamespace(label="one"), SimpleNamespace(label="two")])
    rows = [seen(good, none)] * 4 + [seen(good, odd)] * 3 + [seen(good, None), seen(none, none)]
    cells = {(0, k): row for k, row in enumerate(rows)}
    (text,) = _unseen(plan, SimpleNamespace(cells=cells))
    assert text.startswith("pass two: no ripples in 4 of the 7 cells where another pass shows some")
    cells = {(0, k): row for k, row in enumerate(rows[1:])}
    assert _unseen(plan, SimpleNamespace(cells=cells)) == []
