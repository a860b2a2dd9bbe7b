"""The main results of a run, for the report's first page and the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.catalogue import PROJECT, REPORT
from sasmap.passes.cell_estimate import CellEstimate
from sasmap.products.cell_values import measured, statistics
from sasmap.ripples.posterior import Quality, axial
from sasmap.run.manifest import Outcome
from sasmap.run.plan import Plan
from sasmap.run.wording import duration

# Range of the cells' values (5 to 95 %), in standard deviations of one cell, above which they
# differ: twice that of equal cells.
APART = 6.6


class Answer(NamedTuple):
    """A number of the first page: its name, its value and a remark."""

    what: str
    value: str
    beside: str


def _good(outcome: Outcome) -> list[CellEstimate]:
    return [c.final for c in outcome.fused.values() if c.quality is Quality.GOOD]


def _table(cells: list[CellEstimate], quantity: str) -> FloatArray:
    return np.array([statistics(c, quantity) for c in cells])


def answers(plan: Plan, outcome: Outcome) -> Iterator[Answer]:
    """Yield the available numbers of the first page.

    Parameters
    ----------
    plan : Plan
    outcome : Outcome

    Yields
    ------
    Answer
    """
    good = _good(outcome)
    if outcome.fused:
        area = len(good) * plan.opened.grid.spacing**2
        beside = f"of {len(outcome.fused)}; {area:,.0f} m² with a converged estimate"
        yield Answer("Rippled cells", str(len(good)), beside)
    if good:  # by the default method, which estimates their azimuth
        yield _typical("Wavelength", _table(good, "wavelength"))
        yield _typical("Height, crest to trough", _table(good, "crest_to_trough"))
        known = np.array([c.azimuth[0] for c in good])
        mean, spread = axial(known[np.isfinite(known)])
        beside = "clockwise from grid north, where crests run"
        beside += f"; spread over the cells {spread:.0f}°" if spread >= 1 else ""
        yield Answer("Crest direction", f"{(mean + 90) % 180:.0f}°", beside)
    if outcome.sediments:
        areas = ", ".join(f"{c['name']} {c['area_m2']:,.0f} m²" for c in outcome.sediments)
        yield Answer("Sediment classes", str(len(outcome.sediments)), areas)


def _typical(what: str, table: FloatArray) -> Answer:
    """Range over cells where they differ by more than their errors, otherwise the median."""
    value, sd = np.median(table[:, 0]), np.median(table[:, 1])
    low, high = np.quantile(table[:, 0], (0.05, 0.95))
    if high - low > APART * sd:
        beside = f"90 % of the cells; median {value:.3g} m, standard deviation of a cell {sd:.2g} m"
        return Answer(what, f"{low:.3g} to {high:.3g} m", beside)
    return Answer(what, f"{measured(float(value), float(sd))} m", "median ± sd of one cell")


def ripple_words(outcome: Outcome) -> str:
    """Summarise the ripples in a sentence."""
    good = _good(outcome)
    if not good:
        apart = sum(c.quality is Quality.CONTRADICTION for c in outcome.fused.values())
        why = f": in {apart} cells the passes contradict each other" if apart else ""
        return f"No cell has ripples with a converged estimate{why}."
    names = (("wavelength", "wavelength"), ("height (crest to trough)", "crest_to_trough"))
    parts = [f"{text} {_typical(text, _table(good, name)).value}" for text, name in names]
    steepness = np.median(_table(good, "steepness")[:, 0])
    count = f"{len(good)} cells have" if len(good) > 1 else "1 cell has"
    return f"{count} ripples: {', '.join(parts)}, median steepness {steepness:.3f}."


def summary_lines(outcome: Outcome) -> Iterator[str]:
    """Summarise a run in about a dozen lines.

    Parameters
    ----------
    outcome : Outcome

    Yields
    ------
    str
    """
    counts = ", ".join(f"{count} {label}" for label, count in outcome.counts().items())
    if outcome.fused:
        yield f"cells: {counts}"
        yield f"ripples: {ripple_words(outcome)}"
        yield f"looks: {outcome.computed} computed, {outcome.kept} kept from earlier runs"
    if outcome.sediments:
        areas = (f"{c['name']} {c['area_m2']:.0f} m²" for c in outcome.sediments)
        yield f"sediments: {', '.join(areas)}"
    if outcome.failures:
        yield f"failed: {len(outcome.failures)}, listed in run.json"
    stages: dict[str, Any] = outcome.seconds
    spent = ", ".join(f"{k} {v:.1f}" for k, v in stages.items())
    yield f"time: {duration(sum(stages.values()))} (seconds: {spent})"
    yield f"products: {len(outcome.written)} files in {outcome.output}"
    last = {p.name for p in outcome.written}
    if PROJECT in last:
        yield f"look at: {outcome.output / PROJECT} (QGIS)"
    if REPORT in last:
        yield f"look at: {outcome.output / REPORT}"
