"""A survey from plan to products: cells and passes as dask work, finished cells kept."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from dask.callbacks import Callback

from sasmap.config import Survey
from sasmap.errors import InputError
from sasmap.manifest import Clock, Outcome, write_manifest
from sasmap.plan import Look, Plan, make_plan, tags_of
from sasmap.productnames import RIPPLE_PRODUCTS
from sasmap.products.model import Mosaic
from sasmap.products.rasters import float_layer, write_large_cog
from sasmap.products.ripples import write_ripple_rasters, write_ripples_netcdf
from sasmap.ripples.chain import chained
from sasmap.ripples.passes import Summary
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.sedimentstage import try_sediments
from sasmap.store import Store
from sasmap.survey.cells import Cell
from sasmap.work import Context, LookResult, run_look

log = logging.getLogger("sasmap")

CLUSTER_TIMEOUT = "10s"


def run_survey(
    survey: Survey,
    *,
    output: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    restart: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Outcome:
    """Run a survey: estimate every cell, write every product.

    Parameters
    ----------
    survey : Survey
    output : Path, optional
        Folder of the products; default the survey file's.
    workers : int, optional
        Threads; default one a core.
    scheduler : str, optional
        Address of a dask.distributed scheduler to use instead of threads.
    restart : bool
        Forget finished work first.
    progress : callable, optional
        Called with the number of finished looks at cells and of all.

    Returns
    -------
    Outcome

    Raises
    ------
    InputError
        Before anything is written or changed.
    """
    if output is not None:
        survey = survey.model_copy(update={"output": str(Path(output).absolute())})
    clock = Clock()
    with clock.stage("check"):
        plan = make_plan(survey)
    with _cluster(scheduler) as client:
        store = Store(_made(survey.output_folder))
        for warning in plan.opened.warnings:
            log.warning(warning)
        store.remove_leftovers()
        if restart:
            store.clear()
        outcome = Outcome(store.output, seconds=clock.seconds)
        if survey.ripples is not None:
            with clock.stage("ripples"):
                _estimate_cells(plan, store, outcome, workers, client, progress)
    if survey.ripples is not None:
        with clock.stage("products"):
            _write_ripples(plan, store, outcome)
    else:
        left = [name for name in RIPPLE_PRODUCTS if (store.output / name).exists()]
        if left:
            log.warning("of an earlier run, not of this one: %s", ", ".join(left))
    if survey.sediments is not None:
        with clock.stage("sediments"):
            try_sediments(plan, store, outcome, workers)
    write_manifest(plan, store, outcome)
    return outcome


@contextmanager
def _cluster(address: str | None) -> Iterator[Any]:
    """Connect to a dask scheduler; None without an address."""
    if address is None:
        yield None
        return
    from distributed import Client  # heavy, and only clusters need it

    try:
        client = Client(address, timeout=CLUSTER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no dask scheduler answers: {error}") from None
    with client:
        yield client


def _made(folder: Path) -> Path:
    try:
        (folder / ".sasmap").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: output folder cannot be made: {error.strerror or error}"
        ) from None
    if not os.access(folder / ".sasmap", os.W_OK):
        raise InputError(f"{folder}: output folder cannot be written to")
    return folder


def _estimate_cells(
    plan: Plan,
    store: Store,
    outcome: Outcome,
    workers: int | None,
    client: Any,
    progress: Callable[[int, int], None] | None,
) -> None:
    settings = plan.settings.ripples
    assert settings is not None
    tasks: dict[tuple[Cell, int], Any] = {}
    context = dask.delayed(Context(plan, store), pure=False, traverse=False)
    for cell, looks in plan.cells.items():
        earlier: list[Any] = []
        for k in looks:
            tasks[cell, k] = dask.delayed(run_look, pure=False)(context, cell, k, list(earlier))
            if settings.method == "zare-cobb":  # the default method chains what looks know
                earlier.append(tasks[cell, k])
    total = len(tasks)
    log.info("%d cells, %d looks at them", len(plan.cells), total)
    done = dict(zip(tasks, _compute(list(tasks.values()), workers, client, progress), strict=True))
    for cell, looks in plan.cells.items():
        summaries: list[Summary | None] = [None] * len(plan.looks)
        keys: list[str | None] = [None] * len(plan.looks)
        for k in looks:
            result = done[cell, k]
            summaries[k] = result.summary
            keys[k] = result.key
            outcome.computed += result.computed
            outcome.kept += not result.computed
            if result.fault is not None:
                summaries[k] = Summary(Quality.FAILED, LeftOut(0))
                outcome.failures.append(_failure(cell, plan.looks[k], result.fault))
        outcome.cells[cell.row, cell.column] = summaries
        outcome.keys[cell.row, cell.column] = keys
        outcome.chains[cell.row, cell.column] = chained(summaries, settings)


def _failure(cell: Cell, look: Look, fault: str) -> dict[str, Any]:
    log.warning("cell row %d, column %d, pass %s: %s", *cell, look.label, fault)
    return {"row": cell.row, "column": cell.column, "pass": look.label, "fault": fault}


def _compute(
    tasks: list[Any],
    workers: int | None,
    client: Any,
    progress: Callable[[int, int], None] | None,
) -> Sequence[LookResult]:
    tick = _Ticker(len(tasks), progress)
    results: Sequence[LookResult]
    if client is not None:
        futures = client.compute(tasks)
        for future in futures:
            future.add_done_callback(lambda _: tick())
        results = client.gather(futures)
        return results
    with Callback(posttask=lambda key, *_: tick() if str(key).startswith("run_look") else None):
        results = dask.compute(
            *tasks, scheduler="threads", num_workers=workers or os.cpu_count() or 1
        )
    return results


@dataclass
class _Ticker:
    total: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def __call__(self) -> None:
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.total)


def _write_ripples(plan: Plan, store: Store, outcome: Outcome) -> None:
    grid, settings = plan.opened.grid, plan.settings.ripples
    assert settings is not None
    shape, tags = (grid.rows, grid.columns), tags_of(plan)
    outcome.written += write_ripple_rasters(
        store.output,
        outcome.cells,
        outcome.chains,
        [look.sonar_pass.name for look in plan.looks],
        shape,
        grid.transform,
        grid.crs,
        tags,
        store.scratch,
    )
    path = store.output / "ripples.nc"
    labels = [look.label for look in plan.looks]
    write_ripples_netcdf(
        path,
        outcome.cells,
        outcome.chains,
        labels,
        shape,
        grid.transform,
        grid.crs,
        tags,
        store.scratch,
    )
    outcome.written.append(path)
    if settings.keep_model:
        path = store.output / "modelled_amplitude.tif"
        window = plan.settings.window
        mosaic = Mosaic(outcome.keys, store, shape, window)
        layer = float_layer(["modelled amplitude"], [""], tags)
        write_large_cog(path, mosaic, layer, grid.pixels(window), grid.crs, store.scratch)
        outcome.written.append(path)
