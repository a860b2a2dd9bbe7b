"""The sediment stage of a run: map, products, and reuse of an unchanged map."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sasmap.catalogue import SEDIMENT_PRODUCTS
from sasmap.io.files import write_text
from sasmap.products.sediments import write_sediments
from sasmap.run.class_models import ClassModel, model_text
from sasmap.run.manifest import Outcome
from sasmap.run.plan import Plan, tags_of
from sasmap.run.scheduling import Progress
from sasmap.run.sediment_map import map_sediments
from sasmap.run.sediment_surface import Fault, Ground
from sasmap.run.spreading import Spread
from sasmap.run.store import Store, code_version, digest
from sasmap.run.task import Context, Floor, excluded_hash, read_floor, track_hash
from sasmap.survey.cells import Cell
from sasmap.survey.tiles import hash_file
from sasmap.survey.training import cells_shown, marked

log = logging.getLogger("sasmap")

RECORD = "sediments.json"


def sediment_stage(
    plan: Plan,
    store: Store,
    outcome: Outcome,
    workers: int | None,
    progress: Progress | None = None,
    client: Any = None,
) -> list[Path]:
    """Map sediments, or keep an earlier run's map with the same key; returns the products."""
    key = _key(plan, outcome)
    kept = _kept(store, key)
    if kept is None:
        return _map(plan, store, outcome, workers, key, progress, client)
    outcome.sediments, outcome.histograms = kept["table"], kept["histograms"]
    _warn(plan, outcome)
    return [store.output / name for name in kept["files"]]


def _key(plan: Plan, outcome: Outcome) -> str:
    """Hash of everything the map depends on, including the results of the ripple stage."""
    grid = plan.opened.grid
    looks = [
        [
            look.label,
            look.side,
            look.sonar_pass.slant,
            [[plan.hashes[tile.path], tile.kind] for tile in look.sonar_pass.tiles],
            track_hash(look.sonar_pass.track),
        ]
        for look in plan.swaths
    ]
    place = [grid.crs, repr(grid.left), repr(grid.top), repr(grid.size), plan.settings.window]
    found = sorted((list(cell), keys) for cell, keys in outcome.keys.items())
    shown = [sorted(list(cell) for cell in plan.cells), excluded_hash(plan, None)]
    known = [code_version(), plan.sediment_settings, place, looks, found, shown, tags_of(plan)]
    return digest(known)


def _kept(store: Store, key: str) -> dict[str, Any] | None:
    """Return an earlier run's record of the same map, if its files are unchanged."""
    try:
        record = json.loads((store.folder / RECORD).read_text(encoding="utf-8"))
        if (
            record["key"] != key
            or "histograms" not in record
            or any("taken_for_gain_by_range_dB" not in one for one in record["table"])
            or set(record["files"]) - set(SEDIMENT_PRODUCTS)
        ):
            return None
        for name, value in record["files"].items():
            if hash_file(store.output / name) != value:
                return None
        return dict(record)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _map(
    plan: Plan,
    store: Store,
    outcome: Outcome,
    workers: int | None,
    key: str,
    progress: Progress | None,
    client: Any,
) -> list[Path]:
    settings = plan.settings.sediments
    assert settings is not None
    grid, window = plan.opened.grid, plan.settings.window
    context = Context(plan, store)
    keys = {} if plan.overlapping else outcome.keys  # overlapping cells have other pixels

    def read(row: int, column: int, k: int) -> Floor | None:
        found = keys.get((row, column))
        return read_floor(context, Cell(row, column), k, found[k] if found else None)

    ground = Ground(grid.rows, grid.columns, window, len(plan.swaths), read)
    count = settings.classes if isinstance(settings.classes, int) else None
    transform = grid.pixels(window)
    with ExitStack() as stack:
        spread = workers or os.cpu_count() or 1 if client is None else Spread(client)
        known = _known(plan)
        least = settings.least_area / abs(transform.determinant)
        found = map_sediments(ground, count, known, spread, store.scratch, stack, least, progress)
        if found is None:
            return []
        _record(plan, outcome, found.surface.faults)
        written = write_sediments(
            store.output,
            found.label,
            found.confidence,
            found.rippled,
            found.lines,
            found.every_name,
            (*_codes(known, found.names), *[""] * found.objects),
            transform,
            grid.crs,
            tags_of(plan),
            store.scratch,
        )
        drawn = found.drawn()
        outcome.sediments = found.table(abs(transform.determinant), drawn)
        outcome.histograms = [one.histogram() for one in drawn]
        names, classes = found.unmerged or (found.names, found.classes)
    _warn(plan, outcome)
    written.append(store.output / "sediment_classes.json")
    write_text(
        written[-1],
        model_text(names, _codes(known, names), classes, found.surface.apart),
        store.scratch,
    )
    if not found.surface.faults:
        _keep(store, key, outcome, written)
    return written


def _codes(known: ClassModel | None, names: Sequence[str]) -> tuple[str, ...]:
    return ("",) * len(names) if known is None else known.codes_of(names)


def _warn(plan: Plan, outcome: Outcome) -> None:
    """Warn where possible sediments were taken for gain."""
    gain = outcome.sediments[0]["taken_for_gain_by_range_dB"] if outcome.sediments else None
    if gain is not None:
        advice = (
            "look at mosaic.tif; where passes overlap they share one gain"
            if len({swath.sonar_pass.name for swath in plan.swaths}) > 1
            else "a pass from another side or range would tell whether they are sediments"
        )
        outcome.warn(
            f"sediments: levels that follow range over a whole line, by up to {gain:.1f} dB, are "
            f"taken for gain or beam pattern; {advice}"
        )


def _keep(store: Store, key: str, outcome: Outcome, written: list[Path]) -> None:
    files = {path.name: hash_file(path) for path in written}
    record = {
        "key": key,
        "table": outcome.sediments,
        "histograms": outcome.histograms,
        "files": files,
    }
    write_text(store.folder / RECORD, json.dumps(record), store.scratch)


def _known(plan: Plan) -> ClassModel | None:
    """Return the classes of training polygons, or of another survey."""
    if not plan.training:
        return plan.model
    grid, window = plan.opened.grid, plan.settings.window

    def marks(row: int, column: int) -> NDArray[np.uint8]:
        return marked(plan.training, grid, Cell(row, column), window)

    names = tuple(one.name for one in plan.training)
    return ClassModel(names, marks, tuple(cells_shown(plan.training, grid)))


def _record(plan: Plan, outcome: Outcome, faults: Sequence[Fault]) -> None:
    """Add unreadable looks to a run's failures, unless the ripple stage has done so."""
    known = {(f.get("row"), f.get("column"), f.get("pass")) for f in outcome.failures}
    for row, column, k, fault in sorted(faults):
        label = plan.swaths[k].label
        if (row, column, label) not in known:
            log.warning("cell row %d, column %d, pass %s: %s", row, column, label, fault)
            outcome.failures.append({"row": row, "column": column, "pass": label, "fault": fault})
