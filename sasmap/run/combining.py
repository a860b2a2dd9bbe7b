"""Second stage of the ripple estimate: the survey's shared parameters, and each cell given them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import from_bounds

from sasmap.passes.fusion import fuse_cells, learn_survey
from sasmap.ripples.posterior import Quality
from sasmap.run.manifest import Outcome
from sasmap.run.overlaps import Place, apart
from sasmap.run.plan import Plan
from sasmap.survey.cells import Cell, CellGrid

# Pixels across a cell at which the map is read, and the minimum share of them in one class for the
# cell to count as that class (choices: overviews suffice, and a boundary may cross a corner).
ACROSS, MOSTLY = 32, 0.8
# Minimum number of cells in which a pass misses ripples that others show, for a warning (a choice).
FLAT = 4


def combine_cells(plan: Plan, outcome: Outcome) -> None:
    """Estimate the parameters that a survey's looks share, and combine the looks at each cell.

    Parameters
    ----------
    plan : Plan
    outcome : Outcome
        With the looks at each cell, and the mapped sediments where there are any; results are
        added to it.
    """
    settings = plan.settings.ripples
    assert settings is not None
    plan = plan.ripples
    classes = dict.fromkeys(outcome.cells, 0)
    mapped = [path for path in outcome.written if path.name == "sediment_class.tif"]
    if mapped:
        names = [one["number"] for one in outcome.sediments if one["law"] is not None]
        classes = classes_of_cells(mapped[0], plan.opened.grid, outcome.cells, len(names))
    some = apart(plan, outcome.cells)
    outcome.survey = learn_survey(
        [outcome.cells[cell] for cell in some],
        settings,
        plan.settings.seed,
        [classes[cell] for cell in some],
    )
    fused = fuse_cells(
        list(outcome.cells.values()), settings, outcome.survey, list(classes.values())
    )
    outcome.fused = dict(zip(outcome.cells, fused, strict=True))
    for text in _unseen(plan, outcome):
        outcome.warn(text)


def _unseen(plan: Plan, outcome: Outcome) -> list[str]:
    """Warn of looks that show no ripples in most cells where others show some."""
    qualities = [
        [None if s is None else s.quality for s in summaries]
        for summaries in outcome.cells.values()
    ]
    found = []
    for k, swath in enumerate(plan.swaths):
        where = [row[k] for row in qualities if row[k] and Quality.GOOD in row[:k] + row[k + 1 :]]
        flat = where.count(Quality.NO_RIPPLES)
        if flat >= FLAT and flat > 0.5 * len(where):
            found.append(
                f"pass {swath.label}: no ripples in {flat} of the {len(where)} cells where another "
                "pass shows some: washed out in between, or too poor an image; results there are "
                "the other's alone"
            )
    return found


def classes_of_cells(
    path: Path, grid: CellGrid, cells: Iterable[Place], sediments: int
) -> dict[Place, int]:
    """Read the sediment class of each cell.

    Parameters
    ----------
    path : Path
        The map: classes numbered from 1.
    grid : CellGrid
    cells : iterable of (row, column)
    sediments : int
        Number of classes that are sediments; objects have a larger number.

    Returns
    -------
    dict of (row, column) to int
        0 where no sediment covers most of the cell.
    """
    found = {}
    with rasterio.open(path) as source:
        for cell in cells:
            window = from_bounds(*grid.bounds(Cell(*cell)), source.transform)
            codes = source.read(1, window=window, out_shape=(ACROSS, ACROSS))
            count = np.bincount(codes.ravel(), minlength=sediments + 1)[1 : sediments + 1]
            most = int(np.argmax(count)) if sediments else 0
            pure = count.any() and count[most] >= MOSTLY * codes.size
            found[cell] = most + 1 if pure else 0
    return found
