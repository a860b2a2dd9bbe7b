"""Overlapping cells: which of them are disjoint, and the pixels that each has on the map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import BoolArray
from sasmap.passes.summary import Summary
from sasmap.run.plan import Plan
from sasmap.survey.cells import CellGrid

Place = tuple[int, int]
Part = tuple[slice, slice]
T = TypeVar("T")


class CommonPixels(NamedTuple):
    """Common pixels of a cell of the map and a cell of the ripple estimates.

    Attributes
    ----------
    cell : tuple of int
        Row and column of the latter.
    here, there : tuple of slice
        The pixels, rows and columns, in the former and in the latter.
    """

    cell: Place
    here: Part
    there: Part


def sharing(plan: Plan, cell: Place) -> Iterator[CommonPixels]:
    """Find the cells of the ripple estimates that share pixels with a cell of the map.

    Parameters
    ----------
    plan : Plan
        The plan of the map, in adjacent cells.
    cell : tuple of int
        Row and column.

    Yields
    ------
    CommonPixels
        The cell itself where cells do not overlap.
    """
    grid, window = plan.ripples.opened.grid, plan.settings.window
    step = _spacing(grid, window)
    along = [_common(place, window, step, n) for place, n in zip(cell, _shape(grid), strict=True)]
    for row, here_rows, there_rows in along[0]:
        for column, here_columns, there_columns in along[1]:
            yield CommonPixels(
                (row, column), (here_rows, here_columns), (there_rows, there_columns)
            )


def _shape(grid: CellGrid) -> Place:
    return grid.rows, grid.columns


def _spacing(grid: CellGrid, window: int) -> int:
    """Pixels from cell to cell."""
    return round(window * grid.spacing / grid.size)


def _common(place: int, window: int, step: int, count: int) -> list[tuple[int, slice, slice]]:
    """Rows (or columns) of cells that meet a window, and their common pixels."""
    start = place * window
    found = []
    for k in range(max((start - window) // step + 1, 0), min(-(-(start + window) // step), count)):
        offset = k * step - start
        low, high = max(offset, 0), min(offset + window, window)
        found.append((k, slice(low, high), slice(low - offset, high - offset)))
    return found


def covered(plan: Plan, cell: Place, found: Mapping[Place, T]) -> BoolArray:
    """Pixels (window, window) of a cell of the map that lie in cells of a mapping."""
    result = np.zeros((plan.settings.window,) * 2, bool)
    for shared in sharing(plan, cell):
        if shared.cell in found:
            result[shared.here] = True
    return result


def met(plan: Plan, cells: Sequence[Place]) -> set[Place]:
    """Find the cells of the map that share pixels with cells of the ripple estimates."""
    grid, window = plan.opened.grid, plan.settings.window
    step = _spacing(plan.ripples.opened.grid, window)
    result = set()
    for cell in cells:
        (top, left), (bottom, right) = (
            [(k * step + edge) // window for k in cell] for edge in (0, window - 1)
        )
        rows, columns = range(top, min(bottom + 1, grid.rows)), range(left, right + 1)
        result |= {(r, c) for r in rows for c in columns if c < grid.columns}
    return result


def apart(plan: Plan, cells: Mapping[Place, Sequence[Summary | None]]) -> list[Place]:
    """Choose disjoint cells, with as many rippled looks as possible.

    The survey's shared parameters are estimated from these, so that no pixel counts twice.

    Parameters
    ----------
    plan : Plan
    cells : mapping of (row, column) to sequence of Summary or None
        Looks at the cells of the ripple estimates.

    Returns
    -------
    list of tuple of int
    """
    grid = plan.ripples.opened.grid
    stride = int(np.ceil(grid.size / grid.spacing - 1e-9))
    drawn = {cell: sum(s is not None and bool(s.mixture) for s in v) for cell, v in cells.items()}
    starts = [(row, column) for row in range(stride) for column in range(stride)]

    def told(start: Place) -> int:
        return sum(n for cell, n in drawn.items() if _from(cell, start, stride))

    best = max(starts, key=told)  # the first of equals
    return [cell for cell in cells if _from(cell, best, stride)]


def _from(cell: Place, start: Place, stride: int) -> bool:
    return (cell[0] - start[0]) % stride == 0 and (cell[1] - start[1]) % stride == 0


def blended(
    plan: Plan, cell: Place, found: Mapping[Place, NDArray[np.float32]]
) -> NDArray[np.float32] | None:
    """Weighted mean of the images of overlapping cells, on the pixels of a cell of the map.

    The weight of an image falls from its centre to zero at its edge, so that there are no seams.

    Parameters
    ----------
    plan : Plan
    cell : tuple of int
    found : mapping of (row, column) to ndarray (window, window)
        NaN where an image has none.

    Returns
    -------
    ndarray (window, window) or None
        NaN where no image has any; None where no cell has one.
    """
    window = plan.settings.window
    some = [shared for shared in sharing(plan, cell) if shared.cell in found]
    if not some:
        return None
    tent = 1 - np.abs(2 * np.arange(window) + 1 - window) / (window + 1)
    total, weight = np.zeros((2, window, window))
    for shared in some:
        image = found[shared.cell][shared.there]
        share = np.where(np.isfinite(image), np.multiply.outer(tent, tent)[shared.there], 0.0)
        total[shared.here] += np.nan_to_num(image) * share
        weight[shared.here] += share
    mean = total / np.where(weight > 0, weight, 1.0)
    return np.where(weight > 0, mean, np.nan).astype(np.float32)
