"""Contents of the report, collected here and drawn in products."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sasmap.catalogue import CATALOGUE, MANIFEST, REPORT
from sasmap.products.cell_figures import class_figure, growth_figure
from sasmap.products.cell_values import ADVICE, MEANINGS
from sasmap.products.colours import QUALITY_COLOURS, hexadecimal
from sasmap.products.law_figure import law_figure
from sasmap.products.maps import codes_of, map_of, overview
from sasmap.products.qgis.styles import Categories
from sasmap.products.ranges import has_content
from sasmap.products.report import write_report
from sasmap.ripples.posterior import Quality
from sasmap.run.answers import answers, ripple_words
from sasmap.run.cell_details import cell_details
from sasmap.run.class_models import law_of
from sasmap.run.manifest import Outcome, left_out_counts, versions
from sasmap.run.plan import Plan, dates_of
from sasmap.run.store import Store, code_version
from sasmap.run.wording import duration
from sasmap.settings.yamlfile import dump_yaml

# Standard deviations above which a migration is significant; assumed registration error of passes,
# m (differential GPS).
SURE, REGISTERED = 3.0, 0.1
# Maps of the report's section on ripples.
RIPPLE_MAPS = (
    "ripple_wavelength.tif",
    "ripple_crest_to_trough.tif",
    "ripple_azimuth.tif",
    "ripple_probability.tif",
)


def make_report(plan: Plan, store: Store, outcome: Outcome, names: Categories) -> Path:
    """Write report.html.

    Parameters
    ----------
    plan : Plan
    store : Store
    outcome : Outcome
    names : Categories

    Returns
    -------
    Path
    """
    written = {p.name for p in outcome.written} | {MANIFEST}
    content: dict[str, Any] = {
        "title": plan.settings.name,
        "version": code_version(),
        "run_id": plan.run_id,
        "dates": dates_of(plan),
        "overview": overview(store.output, names.sediments) if "mosaic.tif" in written else None,
        "answers": list(answers(plan, outcome)),
        "passes": list(_passes(plan)),
        "grid": _grid(plan),
        "warnings": outcome.warnings,
        "quality": _quality(outcome),
        "ripple_words": ripple_words(outcome),
        "ripple_maps": list(_ripple_maps(store, written, names)),
        "law": law_figure(
            outcome.survey, grazing_of(outcome), [one["name"] for one in outcome.sediments]
        ),
        "migration": list(_migration(plan, outcome)),
        "growth": growth_figure(list(outcome.fused.values()), [s.label for s in plan.swaths]),
        "cells": list(cell_details(plan, store, outcome)),
        "convergence": _convergence(outcome),
        "sediment_map": None,
        "classes": list(_classes(outcome, names)),
        "class_figure": None,
        "left_out": [*plan.left_out, *left_out_counts(outcome)],
        "failures": [_told(f) for f in outcome.failures],
        "seconds": [(k, duration(v)) for k, v in outcome.seconds.items()],
        "computed": outcome.computed,
        "kept": outcome.kept,
        "products": [(p.file, p.sentence.replace("`", "")) for p in CATALOGUE if p.file in written],
        "settings": dump_yaml(plan.settings.model_dump(mode="json", exclude_none=True)),
        "versions": ", ".join(f"{k} {v}" for k, v in versions().items()),
    }
    if "sediment_class.tif" in written:
        content |= _sediments(store, outcome, names)
    content["sections"] = _sections(content)
    return write_report(store.output / REPORT, content, store.scratch)


def grazing_of(outcome: Outcome) -> tuple[float, float]:
    """Smallest and largest grazing angle of the looks with ripples, degrees."""
    looks = [s for every in outcome.cells.values() for s in every if s is not None and s.mixture]
    angles = [float(np.degrees(np.arctan(s.tangent))) for s in looks]
    return (min(angles), max(angles)) if angles else (5.0, 60.0)


def _migration(plan: Plan, outcome: Outcome) -> Iterator[str]:
    """Describe how far crests moved between the first pass of a cell and each later one."""
    for k, swath in enumerate(plan.swaths):
        found = [
            c.migration[k]
            for c in outcome.fused.values()
            if len(c.group) > 1 and k in c.group[1:] and np.isfinite(c.migration[k][0])
        ]
        if not found:
            continue
        shift = next((c.registration[k] for c in outcome.fused.values() if c.registration), (0, 0))
        if any(shift):
            yield (
                f"{swath.label}: the crests of all cells place the pass {shift[0]:+.3f} m east "
                f"and {shift[1]:+.3f} m north of the first; this is attributed to registration, "
                "not migration."
            )
        moved, sd = np.array(found).T
        clear = int((np.abs(moved) > SURE * np.hypot(sd, REGISTERED)).sum())
        yield (
            f"{swath.label}: crests lie {np.median(moved):+.3f} m from those of the first pass "
            f"(median of {len(found)} cells; modulo a wavelength"
            f"{', registration removed' if any(shift) else ''}); in {clear} of them significantly, "
            f"if the passes are registered to {REGISTERED:g} m."
        )


def _sections(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    every = (
        ("answer", "Summary", True),
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
        centres = np.array([plan.opened.grid.bounds(c) for c in met]).reshape(-1, 4)
        x, y = centres[:, [0, 2]].mean(axis=1), centres[:, [1, 3]].mean(axis=1)
        reach = p.track.locate(x, y).distance
        seen = reach[np.isfinite(reach)]
        yield {
            "name": p.name,
            "date": plan.settings.find_pass(p.name).date or "",
            "tiles": len(p.tiles),
            "sides": " and ".join(p.sides),
            "pings": p.track.x.size,
            "cells": len(met),
            "range": f"{seen.min():.0f} to {seen.max():.0f}" if seen.size else "unknown",
            "altitude": f"{low:.1f} to {high:.1f}",
        }


def _grid(plan: Plan) -> str:
    grid = plan.opened.grid
    rows, columns = _count(grid.rows, "row"), _count(grid.columns, "column")
    apart = f", every {grid.spacing:g} m" if plan.overlaps else ""
    return (
        f"{rows} and {columns} of cells of {grid.size:g} m{apart}, {plan.settings.window} pixels a "
        "side; "
        f"{len(plan.cells)} of them meet a tile."
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _quality(outcome: Outcome) -> list[dict[str, Any]]:
    counts = outcome.counts()
    return [
        {
            "code": int(q),
            "label": q.label,
            "count": counts[q.label],
            "meaning": _meaning(outcome, q),
            "advice": ADVICE[q],
            "colour": hexadecimal(QUALITY_COLOURS.get(q, (255, 255, 255))),
        }
        for q in Quality
        if q.label in counts
    ]


def _meaning(outcome: Outcome, quality: Quality) -> str:
    """Describe a quality; where ripples cannot be identified, say why and what to change."""
    if quality is not Quality.NOT_IDENTIFIABLE:
        return MEANINGS[quality]
    looks = [s for cell in outcome.cells.values() for s in cell if s is not None]
    counts = Counter(s.reason for s in looks if s.reason)
    told = "; ".join(
        f"{reason} ({count} look{'s' * (count > 1)})" for reason, count in counts.most_common()
    )
    return told or MEANINGS[quality]


def _ripple_maps(store: Store, written: set[str], names: Categories) -> Iterator[Any]:
    for name in RIPPLE_MAPS:
        path = store.output / name
        if name in written and has_content(path):
            yield map_of(path)
    path = store.output / "ripple_quality.tif"
    if path.name in written and has_content(path):
        yield codes_of(path, names.quality, "Quality of each cell. White: no data.")


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


def _classes(outcome: Outcome, names: Categories) -> Iterator[dict[str, Any]]:
    for c in outcome.sediments:
        law = c["law"] is not None  # objects have none
        yield {
            "number": c["number"],
            "name": c["name"],
            "colour": hexadecimal(names.sediments[c["number"]][1]),
            "law": c["law"].replace("_", " ") if law else "",
            "nu": ("∞" if c["nu"] is None else f"{c['nu']:.3g}") if law else "",
            "kappa": f"{c['kappa']:.3g}" if law else "",
            "intensity": f"{c['intensity_dB_over_first']:.1f}" if law else "",
            "area": f"{c['area_m2']:,.0f}",
        }


def _sediments(store: Store, outcome: Outcome, names: Categories) -> dict[str, Any]:
    path = store.output / "sediment_class.tif"
    if not has_content(path):
        return {}
    caption = "Sediment classes and refined boundaries. White: no class (shadow, no data)."
    content = json.loads((store.output / "sediment_classes.json").read_text(encoding="utf-8"))
    laws = [law_of(one) for one in content["classes"]]
    figure = class_figure(outcome.histograms, laws, names.sediments) if laws else None
    maps = [codes_of(path, names.sediments, caption)]
    confidence = store.output / "sediment_confidence.tif"
    if confidence.exists():
        maps.append(map_of(confidence))
    return {"sediment_map": maps, "class_figure": figure}


def _told(failure: Mapping[str, Any]) -> str:
    if "row" in failure:
        return (
            f"row {failure['row']}, column {failure['column']}, pass {failure['pass']}: "
            f"{failure['fault']}"
        )
    return f"{failure['stage']}: {failure['fault']}"
