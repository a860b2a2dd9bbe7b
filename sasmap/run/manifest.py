"""The outcome of a run and its record, run.json."""

from __future__ import annotations

import logging
import math
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.catalogue import MANIFEST
from sasmap.io.jsonfile import write_json
from sasmap.passes.fusion import FusedCell
from sasmap.passes.shared import SurveyModel, quantiles_of
from sasmap.passes.summary import Summary
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.ripples.settings import RippleSettings, scattering_law
from sasmap.run.plan import Plan, crs_name
from sasmap.run.store import Store, code_version

log = logging.getLogger("sasmap")


@dataclass
class Outcome:
    """The outcome of a run."""

    output: Path
    cells: dict[tuple[int, int], list[Summary | None]] = field(default_factory=dict)
    fused: dict[tuple[int, int], FusedCell] = field(default_factory=dict)
    survey: SurveyModel | None = None
    keys: dict[tuple[int, int], list[str | None]] = field(default_factory=dict)
    sediments: list[dict[str, Any]] = field(default_factory=list)
    histograms: list[dict[str, list[float]]] = field(default_factory=list)
    failures: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    computed: int = 0
    kept: int = 0
    written: list[Path] = field(default_factory=list)

    def warn(self, text: str) -> None:
        """Record a warning and log it."""
        self.warnings.append(text)
        log.warning("warning: %s", text)

    def counts(self) -> dict[str, int]:
        """Cells by quality."""
        labels = [chain.quality.label for chain in self.fused.values()]
        return {q.label: labels.count(q.label) for q in Quality if q.label in labels}


def write_manifest(plan: Plan, store: Store, outcome: Outcome) -> Path:
    """Write run.json; returns its path."""
    path = store.output / MANIFEST
    base = plan.settings.path.parent
    content = {
        "run_id": plan.run_id,
        "survey": plan.settings.name,
        "versions": versions(),
        "settings": plan.settings.model_dump(mode="json"),
        "seed": plan.settings.seed,
        "inputs": {_relative(f, base): value for f, value in plan.hashes.items()},
        "grid": {
            "rows": plan.opened.grid.rows,
            "columns": plan.opened.grid.columns,
            "cell_size_m": plan.opened.grid.size,
            **({"cell_spacing_m": plan.opened.grid.spacing} if plan.overlaps else {}),
            "crs": crs_name(plan.opened.grid.crs),
        },
        "cells_by_quality": outcome.counts(),
        "scattering_law": law_record(outcome.survey, plan.settings.ripples),
        "looks_computed": outcome.computed,
        "looks_kept_from_earlier_runs": outcome.kept,
        "sediment_classes": outcome.sediments,
        "failures": outcome.failures,
        "warnings": outcome.warnings,
        "left_out": [*plan.left_out, *left_out_counts(outcome)],
        "products": [*(p.name for p in outcome.written), MANIFEST],
        "seconds": {name: round(value, 3) for name, value in outcome.seconds.items()},
    }
    write_json(path, content, store.scratch)
    return path


def law_record(
    survey: SurveyModel | None, settings: RippleSettings | None
) -> dict[str, Any] | None:
    """Record the survey's scattering law and other shared parameters, with 5 and 95 % quantiles."""
    if survey is None or not survey.values:
        return None
    quantiles = survey.quantiles()
    found = survey.found if survey.learned else ()
    laws = [
        {
            **({"sediment": number} if number else {}),
            "share_of_cells": float(np.mean([p.weight for p in draws])),
            **_law(quantiles_of([p.shared for p in draws])),
        }
        for number, draws in zip_longest(survey.sediments, found)
    ]
    return {
        "form": "intensity = sin(grazing)^exponent exp(-concentration (grazing - pi/2)^2)",
        "learned": survey.learned,
        **_told(settings),
        **(_law(quantiles) if survey.learned else {}),
        "laws_told_apart": laws if survey.apart else [],
        "lambert": {"exponent": 2.0, "concentration": 0.0},
        "zare_cobb": {"exponent": 0.0, "concentration": 3 / math.pi},
        "shift_by_shape": list(quantiles["shift"][1]),
        "altitude_offset_m": [list(q) for q in quantiles["offset"].T],
        "scatter_between_passes": list(quantiles["scatter"][1]),
    }


def _told(settings: RippleSettings | None) -> dict[str, Any]:
    """Record the law that the survey file fixes, if it does."""
    law = None if settings is None else scattering_law(settings.scattering)
    return (
        {} if law is None else {"told": dict(zip(("exponent", "concentration"), law, strict=True))}
    )


def _law(quantiles: dict[str, FloatArray]) -> dict[str, Any]:
    """Record exponent and concentration: median, 5 and 95 % quantiles, and spread."""
    low, middle, high = (quantiles["law"][i] for i in range(3))
    spread = quantiles["spread"][1]
    return {
        name: {"median": middle[i], "q05": low[i], "q95": high[i], "spread": spread[i]}
        for i, name in enumerate(("exponent", "concentration"))
    }


# Steps of the estimate that looks skip, and why.
REASONS = {
    LeftOut.SAMPLING: "sampling: no ripples were found, or there were too few pixels",
    LeftOut.PRESENCE_TEST: "detection: the published method has none",
    LeftOut.SHADOW: "shadow: no slope is steep enough to cast one at its range",
    LeftOut.ORIENTATION: "orientation: the published method assumes a look along the crest normal",
    LeftOut.PHASE_FIELD: "phase field: the crests are straight",
}


def left_out_counts(outcome: Outcome) -> Iterator[str]:
    """Describe the steps that looks skipped, why, and in how many looks."""
    every = [s for summaries in outcome.cells.values() for s in summaries if s is not None]
    for flag in LeftOut:
        count = sum(1 for s in every if flag in s.left_out)
        if count:
            yield f"{REASONS[flag]} ({count} of {len(every)} looks at cells)"


def _relative(path: Path, base: Path) -> str:
    try:
        return str(path.relative_to(base))
    except ValueError:
        return os.path.relpath(path, base)


def versions() -> dict[str, str]:
    """Versions of sasmap and of its main dependencies."""
    names = ("numpy", "scipy", "numba", "rasterio", "xarray", "dask", "pyproj")
    return {
        "sasmap": code_version(),
        "python": platform.python_version(),
        **{name: version(name) for name in names},
    }


class Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the enclosed block."""
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start
