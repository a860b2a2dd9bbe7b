"""Cells that the report shows in detail, drawn from their stored results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sasmap.errors import fault_of
from sasmap.passes.cell_estimate import CellEstimate
from sasmap.products.cell_figures import CellPicture, cell_figure
from sasmap.products.cell_values import ADVICE, MEANINGS, measured, statistics
from sasmap.ripples.clip import Clip, mean_look
from sasmap.ripples.posterior import Quality
from sasmap.run.manifest import Outcome
from sasmap.run.plan import Plan
from sasmap.run.store import Store
from sasmap.run.task import clip_of
from sasmap.survey.cells import Cell
from sasmap.survey.placement import on_cell

FLAGGED = (
    Quality.CONTRADICTION,
    Quality.NOT_CONVERGED,
    Quality.NOT_IDENTIFIABLE,
)
# Maximum number of flagged cells that are shown (a choice: the report stays short).
MOST_FLAGGED = 2


def cell_details(plan: Plan, store: Store, outcome: Outcome) -> Iterator[dict[str, Any]]:
    """Yield text and figure of some cells.

    Parameters
    ----------
    plan : Plan
    store : Store
    outcome : Outcome

    Yields
    ------
    dict
        ``title``, ``words``, ``source`` (data URL, or None) and ``caption``.
    """
    labels = [swath.label for swath in plan.swaths]
    for titles, cell in _chosen(outcome):
        fused = outcome.fused[cell]
        k = _best_swath(outcome, cell)
        told = {
            "title": f"{titles}: row {cell.row}, column {cell.column}",
            "words": _words(fused.final, fused.quality),
            "source": None,
            "caption": "",
        }
        try:
            picture = None if k is None else _picture(plan, store, outcome, cell, k)
        except Exception as error:  # one cell's figure must not fail the report
            yield told | {"caption": f"No figure: {fault_of(error)}"}
            continue
        if picture is not None and k is not None:
            yield told | {
                "source": cell_figure(picture, fused, labels),
                "caption": _caption(picture, labels[k]),
            }


def _caption(picture: CellPicture, label: str) -> str:
    shown = f"Pass {label}, north up, {picture.size:g} m a side"
    if picture.model is None:
        return f"{shown}; the arrow is the look direction. No model: nothing was sampled."
    return (
        f"{shown}; the arrow is the look direction. Clip and posterior-mean model on one grey "
        "scale; traces and posterior of this pass alone; 90 % intervals after each pass."
    )


def _chosen(outcome: Outcome) -> Iterator[tuple[str, Cell]]:
    """Choose the best, median and worst good cell by the relative sd of A_H, and flagged ones."""
    good = [k for k, c in outcome.fused.items() if c.quality is Quality.GOOD]
    good.sort(key=lambda k: outcome.fused[k].final.sd[1] / outcome.fused[k].final.mean[1])
    if good:
        places = {0: "Best", len(good) // 2: "Median", len(good) - 1: "Worst"}
        if len(good) == 1:
            yield "The only good cell", Cell(*good[0])
            places = {}
        for place in sorted(places):
            yield f"{places[place]} of the good cells, by the sd of A_H", Cell(*good[place])
    flagged = [
        (q.label.capitalize(), Cell(*k))
        for q in FLAGGED
        for k, c in sorted(outcome.fused.items())
        if c.quality is q
    ]
    first = {label: cell for label, cell in reversed(flagged)}
    yield from list(first.items())[:MOST_FLAGGED]


def _best_swath(outcome: Outcome, cell: Cell) -> int | None:
    """Return the look with the smallest sd of f, of those used for a cell or else of all."""
    summaries = outcome.cells[cell]
    every = [k for k, s in enumerate(summaries) if s is not None]
    shown = outcome.fused[cell].group or every
    known = [s.sd[0] if s is not None and s.sd[0] > 0 else np.inf for s in summaries]
    return min(shown, key=lambda k: known[k], default=None)


def _picture(plan: Plan, store: Store, outcome: Outcome, cell: Cell, k: int) -> CellPicture | None:
    """Read a clip and its stored estimate."""
    swath, grid = plan.swaths[k], plan.opened.grid
    array = clip_of(plan, cell, swath, swath.side)
    if array is None:
        return None
    clip = Clip.from_array(array)
    known = np.where(clip.valid, clip.amplitude, np.nan)
    key = outcome.keys[cell][k]
    kept = None if key is None else store.load_arrays(key, ("picture", "picture_step"))
    draws = None if key is None else store.load_arrays(key, ("frequency", "height"))
    none = np.zeros((0, 0))
    model = None
    if kept is not None:
        model = np.where(kept[0] > 0, (kept[0].astype(float) - 1) * float(kept[1]), np.nan)
    frequency, height = (none, none) if draws is None else draws
    return CellPicture(
        on_cell(clip, known, grid, cell, plan.settings.window),
        model,
        frequency,
        height,
        grid.size,
        mean_look(clip),
    )


def _words(final: CellEstimate, quality: Quality) -> str:
    if not np.isfinite(final.mean[0]):
        advice = f" What to do: {ADVICE[quality]}." if ADVICE[quality] else ""
        return f"Quality: {quality.label}; {MEANINGS[quality]}.{advice}"
    length, height = (statistics(final, k) for k in ("wavelength", "crest_to_trough"))
    return (
        f"Wavelength {measured(length[0], length[1])} m, height "
        f"{measured(height[0], height[1])} m (f {measured(final.mean[0], final.sd[0])} cycles/m, "
        f"A_H {measured(final.mean[1], final.sd[1])} m), azimuth of the crest normal "
        f"{measured(*final.azimuth)}°; quality: {quality.label}."
    )
