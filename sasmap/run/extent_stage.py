"""Outlines of a survey's rippled sea floor: neighbouring cells are traced together."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from scipy.ndimage import label

from sasmap.arrays import BoolArray, FloatArray
from sasmap.products.extent import Outline, outlines, write_extent
from sasmap.run.manifest import Outcome
from sasmap.run.overlaps import covered, met, sharing
from sasmap.run.plan import Plan
from sasmap.run.store import Store
from sasmap.run.task import CERTAIN, UNSEEN, Context, extent_beside
from sasmap.survey.cells import Cell

# Maximum side of a mosaic node in pixels (smaller where wavelengths are short), and maximum number
# of nodes in one group, which bounds memory (a choice).
COARSE, LARGEST = 5, 40_000_000
# Minimum number of nodes per wavelength: outlines are smoothed over a quarter of it.
FINE = 6.0
BESIDE = ((0, 1), (1, 0), (0, -1), (-1, 0))

Found = dict[tuple[int, int], dict[int, tuple[NDArray[Any], FloatArray]]]


def write_ripple_extent(plan: Plan, store: Store, outcome: Outcome) -> Path:
    """Write ripple_extent.gpkg.

    Parameters
    ----------
    plan : Plan
    store : Store
    outcome : Outcome
        With the finished cells.

    Returns
    -------
    Path
    """
    found = _found(store, outcome)
    context = Context(plan, store)
    areas: list[Outline] = []
    for cells in _groups(found, plan):
        areas += _traced(context, found, cells)
    path = store.output / "ripple_extent.gpkg"
    write_extent(path, areas, plan.opened.grid.crs, store.scratch)
    return path


def _found(store: Store, outcome: Outcome) -> Found:
    """Cells with ripples and their references, by look."""
    found: Found = {}
    for cell, keys in outcome.keys.items():
        for k, key in enumerate(keys):
            kept = None if key is None else store.load_arrays(key, ("rippled", "reference"))
            if kept is not None:
                found.setdefault(cell, {})[k] = (kept[0], kept[1])
    return found


def _groups(found: Found, plan: Plan) -> Iterator[list[tuple[int, int]]]:
    """Group rippled cells of the map that touch, with those between and beside them."""
    grid = plan.opened.grid
    there = np.zeros((grid.rows + 2, grid.columns + 2), bool)
    for row, column in met(plan, list(found)):
        there[row : row + 3, column + 1] = True
        there[row + 1, column : column + 3] = True
    groups, count = label(there, np.ones((3, 3)))
    for i in range(1, count + 1):
        rows, columns = np.nonzero(groups == i)
        cells = zip((rows - 1).tolist(), (columns - 1).tolist(), strict=True)
        yield [c for c in cells if 0 <= c[0] < grid.rows and 0 <= c[1] < grid.columns]


def _traced(context: Context, found: Found, cells: list[tuple[int, int]]) -> list[Outline]:
    """Trace the outlines of a group of cells."""
    plan = context.plan
    grid, window = plan.opened.grid, plan.settings.window
    rippled = sorted({s.cell for c in cells for s in sharing(plan, c) if s.cell in found})
    lengths = [1 / np.hypot(*r[:2]) for c in rippled for _, r in found[c].values()]
    wavelength = float(np.median(lengths))
    size = int(np.clip(wavelength / (grid.size / window) / FINE, 1, COARSE))
    first = np.min(cells, axis=0)
    shape = np.max(cells, axis=0) - first + 1
    size = max(size, int(np.ceil(window * np.sqrt(shape.prod() / LARGEST))))
    side = -(-window // size)
    mosaic = np.full(tuple(shape * side), np.nan)
    own = np.zeros(mosaic.shape, bool)
    for cell in cells:
        row, column = (np.array(cell) - first) * side
        part = np.s_[row : row + side, column : column + side]
        inside = covered(plan, cell, found)
        mosaic[part] = _places(context, found, cell, inside, side)
        own[part] = _summed(inside.astype(float), side) > 0
    left = grid.left + first[1] * grid.size
    top = grid.top - first[0] * grid.size
    step = grid.size / side
    return outlines(mosaic, own, wavelength, Affine(step, 0.0, left, 0.0, -step, top))


def _places(
    context: Context,
    found: Found,
    cell: tuple[int, int],
    inside: BoolArray,
    side: int,
) -> FloatArray:
    """Probability of rippled sea floor at a cell's nodes (side, side): the mean over its looks.

    `inside` are the pixels of cells in which ripples were found; ripples may continue from there
    into the others.
    """
    plan = context.plan
    looks = []
    for shared in sharing(plan, cell):
        for rippled, _ in found.get(shared.cell, {}).values():
            looks.append(np.full(inside.shape, UNSEEN, np.uint8))
            looks[-1][shared.here] = rippled[shared.there]
    if not inside.all():
        near = [(cell[0] + r, cell[1] + c) for r, c in ((0, 0), *BESIDE)]
        every = sorted({s.cell for c in near for s in sharing(plan, c) if s.cell in found})
        around = [found[c] for c in every]
        for k in sorted({k for a in around for k in a}):
            references = [a[k][1] for a in around if k in a]
            beside = extent_beside(context, Cell(*cell), k, references)
            if beside is not None:
                looks.append(np.where(inside, UNSEEN, beside).astype(np.uint8))
    total, seen = np.zeros((side, side)), np.zeros((side, side))
    for look in looks:
        known = look != UNSEEN
        total += _summed(np.where(known, look / CERTAIN, 0.0), side)
        seen += _summed(1.0 * known, side)
    return np.where(seen > 0, total / np.maximum(seen, 1), np.nan)


def _summed(values: FloatArray, side: int) -> FloatArray:
    """Sum pixels over nodes (side, side)."""
    edges = np.linspace(0, len(values), side + 1).astype(int)[:-1]
    return np.asarray(np.add.reduceat(np.add.reduceat(values, edges, axis=0), edges, axis=1))
