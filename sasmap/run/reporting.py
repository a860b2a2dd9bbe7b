"""What the report shows of a run: gathered here, drawn and written in products."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sasmap.errors import fault_of
from sasmap.products.colours import QUALITY_COLOURS, RAMPS, hexadecimal
from sasmap.products.figures import cell_figure, class_figure, classes_of, map_of
from sasmap.products.qgis import Names
from sasmap.products.report import write_report
from sasmap.ripples.posterior import Quality
from sasmap.run.class_models import law_of
from sasmap.run.manifest import Outcome, left_out_counts, versions
from sasmap.run.plan import Plan
from sasmap.run.store import Store, code_version
from sasmap.run.task import Context, estimate_again
from sasmap.survey.cells import Cell

MEANINGS = {
    Quality.NO_DATA: "no pass shows the cell",
    Quality.GOOD: "ripples, with a converged estimate",
    Quality.NO_RIPPLES: "looked at, and none found",
    Quality.NOT_CONVERGED: "chains did not agree; do not use the numbers",
    Quality.CONTRADICTION: "passes tell different values; ripples may have changed between them",
    Quality.NOT_IDENTIFIABLE: "too few waves or pixels a wave, or a look along the crests",
    Quality.TOO_FEW_PIXELS: "under a quarter of the cell's pixels are valid",
    Quality.FAILED: "could not be computed; see below",
}
FLAGGED = (
    Quality.CONTRADICTION,
    Quality.NOT_CONVERGED,
    Quality.NOT_IDENTIFIABLE,
    Quality.FAILED,
)
# Cells with a flag that are shown, at most.
MOST_FLAGGED = 2
PRODUCT_TEXTS = {
    "ripple_frequency.tif": "mean, sd, 5 % and 95 % quantiles of f (cycles/m), a pixel a cell",
    "ripple_height.tif": "the same of A_H (m)",
    "ripple_azimuth.tif": "axial mean and sd of the crest normal's azimuth (degrees)",
    "ripple_probability.tif": "probability that the cell is rippled",
    "ripple_quality.tif": "quality code of each cell",
    "ripple_passes.tif": "passes that stand for each cell",
    "ripple_extent.gpkg": "outlines of rippled sea floor",
    "ripples.nc": "everything per pass and cell (NetCDF)",
    "modelled_amplitude.tif": "posterior-mean image, beside which the tiles can be laid",
    "sediment_class.tif": "sediment class at full resolution",
    "sediment_confidence.tif": "probability of the class",
    "sediment_boundaries.gpkg": "boundaries with classes on either side and position_sd (m)",
    "sediment_classes.json": "fitted classes, to be taken over by another survey",
    "survey.qgs": "QGIS project with all layers",
    "stac.json": "STAC item of the run",
    "run.json": "settings, versions, inputs, failures, times",
}


def make_report(plan: Plan, store: Store, outcome: Outcome, names: Names) -> Path:
    """Write report.html.

    Parameters
    ----------
    plan : Plan
    store : Store
    outcome : Outcome
    names : Names

    Returns
    -------
    Path
    """
    written = {p.name for p in outcome.written}
    cells = list(_cells(plan, store, outcome))
    content: dict[str, Any] = {
        "title": plan.settings.name,
        "version": code_version(),
        "run_id": plan.run_id,
        "passes": list(_passes(plan)),
        "grid": _grid(plan),
        "warnings": outcome.warnings,
        "quality": _quality(outcome),
        "ripple_words": _ripple_words(outcome),
        "ripple_maps": [map_of(store.output / n) for n in list(RAMPS)[:3] if n in written],
        "cells": cells,
        "convergence": _convergence(outcome),
        "sediment_map": None,
        "classes": list(_classes(outcome, names)),
        "class_figure": None,
        "left_out": [*plan.left_out, *left_out_counts(outcome)],
        "failures": [_told(f) for f in outcome.failures],
        "seconds": [(k, f"{v:.1f}") for k, v in outcome.seconds.items()],
        "computed": outcome.computed,
        "kept": outcome.kept,
        "products": [(n, PRODUCT_TEXTS[n]) for n in PRODUCT_TEXTS if n in {*written, "run.json"}],
        "settings": json.dumps(plan.settings.model_dump(mode="json"), indent=2),
        "versions": json.dumps(versions(), indent=2),
    }
    if "ripple_quality.tif" in written:
        path = store.output / "ripple_quality.tif"
        content["ripple_maps"].append(classes_of(path, names.quality, "Quality of each cell."))
    if "sediment_class.tif" in written:
        content |= _sediments(store, outcome, names)
    content["sections"] = _sections(content)
    return write_report(store.output / "report.html", content, store.scratch)


def _sections(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    every = (
        ("survey", "Survey", True),
        ("ripples", "Ripples", content["quality"]),
        ("cells", "Cells", content["cells"]),
        ("convergence", "Convergence", content["convergence"]),
        ("sediments", "Sediments", content["sediment_map"]),
        ("run", "The run", True),
    )
    return [(key, text) for key, text, shown in every if shown]


def _passes(plan: Plan) -> Iterator[dict[str, Any]]:
    for p in plan.opened.passes:
        met = [c for c, ks in plan.cells.items() if any(plan.swaths[k].sonar_pass is p for k in ks)]
        low, high = p.track.altitude.min(), p.track.altitude.max()
        centres = np.array([plan.opened.grid.bounds(c) for c in met])
        x, y = centres[:, [0, 2]].mean(axis=1), centres[:, [1, 3]].mean(axis=1)
        reach = p.track.locate(x, y).distance
        seen = reach[np.isfinite(reach)]
        yield {
            "name": p.name,
            "tiles": len(p.tiles),
            "sides": " and ".join(p.sides),
            "pings": p.track.x.size,
            "cells": len(met),
            "range": f"{seen.min():.0f} to {seen.max():.0f}" if seen.size else "unknown",
            "altitude": f"{low:.1f} to {high:.1f}",
        }


def _grid(plan: Plan) -> str:
    grid = plan.opened.grid
    return (
        f"{grid.rows} rows and {grid.columns} columns of cells of {grid.size:g} m, "
        f"{plan.settings.window} pixels a side; {len(plan.cells)} of them meet a tile."
    )


def _quality(outcome: Outcome) -> list[dict[str, Any]]:
    counts = outcome.counts()
    return [
        {
            "label": q.label,
            "count": counts[q.label],
            "meaning": _meaning(outcome, q),
            "colour": hexadecimal(QUALITY_COLOURS.get(q, (255, 255, 255))),
        }
        for q in Quality
        if q.label in counts
    ]


def _meaning(outcome: Outcome, quality: Quality) -> str:
    """Say what a quality means; where ripples cannot be told, why not and what to change."""
    if quality is not Quality.NOT_IDENTIFIABLE:
        return MEANINGS[quality]
    looks = [s for cell in outcome.cells.values() for s in cell if s is not None]
    counts = Counter(s.reason for s in looks if s.reason)
    told = "; ".join(f"{reason} ({count} looks)" for reason, count in counts.most_common())
    return told or MEANINGS[quality]


def _ripple_words(outcome: Outcome) -> str:
    good = [c.final for c in outcome.fused.values() if c.quality is Quality.GOOD]
    if not good:
        return "No cell has ripples with a converged estimate."
    f, height = np.median([g.mean for g in good], axis=0)
    f_sd, height_sd = np.median([g.sd for g in good], axis=0)
    return (
        f"{len(good)} cells have ripples; medians: f {f:.4g} cycles/m (sd {f_sd:.2g}), "
        f"A_H {height:.3g} m (sd {height_sd:.2g})."
    )


def _convergence(outcome: Outcome) -> dict[str, Any] | None:
    looks = [s for every in outcome.cells.values() for s in every if s is not None]
    drawn = [s for s in looks if np.isfinite(s.rhat[0])]
    if not drawn:
        return None
    rows = []
    for i, name in enumerate(("f", "A_H", "azimuth")):
        for what, best in (("rhat", False), ("ess_bulk", True), ("ess_tail", True)):
            values = np.array([getattr(s, what)[i] for s in drawn], float)
            values = values[np.isfinite(values)]
            if values.size:
                worst = values.min() if best else values.max()
                title = {"rhat": "R̂", "ess_bulk": "bulk ESS", "ess_tail": "tail ESS"}[what]
                digits = ".0f" if best else ".4f"
                rows.append(
                    {
                        "name": f"{title} of {name}",
                        "median": f"{np.median(values):{digits}}",
                        "worst": f"{worst:{digits}}",
                    }
                )
    return {"count": len(drawn), "rows": rows}


def _chosen(outcome: Outcome) -> Iterator[tuple[str, Cell]]:
    """Best, median and worst of the good cells by the sd of f, and some with a flag."""
    good = [k for k, c in outcome.fused.items() if c.quality is Quality.GOOD]
    good.sort(key=lambda k: outcome.fused[k].final.sd[0] / outcome.fused[k].final.mean[0])
    if good:
        places = {0: "Best", len(good) // 2: "Median", len(good) - 1: "Worst"}
        for place in sorted(places):
            yield f"{places[place]} of the good cells, by the sd of f", Cell(*good[place])
    flagged = [
        (q.label.capitalize(), Cell(*k))
        for q in FLAGGED
        for k, c in sorted(outcome.fused.items())
        if c.quality is q
    ]
    first = {label: cell for label, cell in reversed(flagged)}
    yield from list(first.items())[:MOST_FLAGGED]


def _cells(plan: Plan, store: Store, outcome: Outcome) -> Iterator[dict[str, str]]:
    context = Context(plan, store)
    labels = [look.label for look in plan.swaths]
    for title, cell in _chosen(outcome):
        chain = outcome.fused[cell]
        summaries = outcome.cells[cell]
        shown = chain.group or [k for k, s in enumerate(summaries) if s is not None]
        known = [s.sd[0] if s is not None and s.sd[0] > 0 else np.inf for s in summaries]
        k = min(shown, key=lambda k: known[k])
        try:
            clip, posterior = estimate_again(context, cell, k, summaries)
        except Exception as error:
            yield _untold(f"{title}: row {cell.row}, column {cell.column}", error)
            continue
        if clip is None:
            continue
        draws = posterior.draws if posterior is not None else xr.Dataset()
        model = posterior.model if posterior is not None else None
        yield {
            "title": f"{title}: row {cell.row}, column {cell.column}",
            "words": _cell_words(chain.final, chain.quality),
            "source": cell_figure(clip, model, draws, chain, labels),
            "caption": f"Clip and posterior-mean model of pass {labels[k]}, on one grey scale; "
            "traces and posterior by that pass alone; intervals after each pass.",
        }


def _untold(title: str, error: Exception) -> dict[str, str]:
    empty = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="
    told = fault_of(error)
    return {"title": title, "words": told, "source": empty, "caption": "No picture."}


def _cell_words(final: Any, quality: Quality) -> str:
    if not np.isfinite(final.mean[0]):
        return f"Quality: {quality.label}; {MEANINGS[quality]}."
    return (
        f"f {final.mean[0]:.5g} ± {final.sd[0]:.2g} cycles/m, A_H {final.mean[1]:.4g} ± "
        f"{final.sd[1]:.2g} m, azimuth {final.azimuth[0]:.2f} ± {final.azimuth[1]:.2g} degrees; "
        f"quality: {quality.label}."
    )


def _classes(outcome: Outcome, names: Names) -> Iterator[dict[str, Any]]:
    for c in outcome.sediments:
        yield {
            "number": c["number"],
            "name": c["name"],
            "colour": hexadecimal(names.sediments[c["number"]][1]),
            "law": c["law"].replace("_", " "),
            "nu": "∞" if c["nu"] is None else f"{c['nu']:.3g}",
            "kappa": f"{c['kappa']:.3g}",
            "intensity": f"{c['intensity_dB_over_first']:.2f}",
            "area": f"{c['area_m2']:.1f}",
        }


def _sediments(store: Store, outcome: Outcome, names: Names) -> dict[str, Any]:
    caption = "Sediment classes and refined boundaries. White: none known (shadow, no data)."
    picture = classes_of(store.output / "sediment_class.tif", names.sediments, caption)
    content = json.loads((store.output / "sediment_classes.json").read_text(encoding="utf-8"))
    laws = [law_of(one) for one in content["classes"]]
    figure = class_figure(outcome.histograms, laws, names.sediments) if laws else None
    return {"sediment_map": picture, "class_figure": figure}


def _told(failure: Mapping[str, Any]) -> str:
    if "row" in failure:
        return (
            f"row {failure['row']}, column {failure['column']}, pass {failure['pass']}: "
            f"{failure['fault']}"
        )
    return f"{failure['stage']}: {failure['fault']}"


def summary_lines(outcome: Outcome) -> Iterator[str]:
    """Say how a run went, in about a dozen lines.

    Parameters
    ----------
    outcome : Outcome
    """
    counts = ", ".join(f"{count} {label}" for label, count in outcome.counts().items())
    if outcome.fused:
        yield f"cells: {counts}"
        yield f"ripples: {_ripple_words(outcome)}"
        yield f"looks: {outcome.computed} computed, {outcome.kept} kept from earlier runs"
    if outcome.sediments:
        areas = (f"{c['name']} {c['area_m2']:.0f} m²" for c in outcome.sediments)
        yield f"sediments: {', '.join(areas)}"
    if outcome.failures:
        yield f"failed: {len(outcome.failures)}, listed in run.json"
    yield "seconds: " + ", ".join(f"{k} {v:.1f}" for k, v in outcome.seconds.items())
    yield f"products: {len(outcome.written)} files in {outcome.output}"
    last = {p.name for p in outcome.written}
    if "survey.qgs" in last:
        yield f"look at: {outcome.output / 'survey.qgs'} (QGIS)"
    if "report.html" in last:
        yield f"look at: {outcome.output / 'report.html'}"
