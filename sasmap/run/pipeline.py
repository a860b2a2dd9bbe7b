"""A survey from plan to products: cells as dask tasks, results stored as they finish."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from sasmap.catalogue import BY_FILE, LOG, MANIFEST, RIPPLE_PRODUCTS, SEDIMENT_PRODUCTS
from sasmap.errors import InputError, fault_of
from sasmap.io.rasters import float_layer, write_large_cog
from sasmap.passes.summary import Summary
from sasmap.products.cell_values import cell_results
from sasmap.products.colours import QUALITY_COLOURS
from sasmap.products.model import ModelledAmplitude
from sasmap.products.netcdf import write_ripples_netcdf
from sasmap.products.qgis.project import Titles, write_styles
from sasmap.products.qgis.styles import categories
from sasmap.products.ripples import write_cells, write_ripple_rasters
from sasmap.products.stac import write_stac
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.run.answers import summary_lines
from sasmap.run.bands import bands_or_ripples
from sasmap.run.combining import combine_cells
from sasmap.run.cost import check_fits, compiled
from sasmap.run.extent_stage import write_ripple_extent
from sasmap.run.lock import LOCK, locked
from sasmap.run.manifest import Clock, Outcome, write_manifest
from sasmap.run.mosaic import write_mosaic
from sasmap.run.overlaps import blended, sharing
from sasmap.run.plan import Plan, Swath, dates_of, make_plan, recorded, tags_of
from sasmap.run.reporting import make_report
from sasmap.run.scheduling import check_workers, cluster, compute
from sasmap.run.sediment_stage import sediment_stage
from sasmap.run.store import Store, code_version
from sasmap.run.task import Context
from sasmap.settings.survey import Survey
from sasmap.survey.cells import Cell
from sasmap.version import VERSION

log = logging.getLogger("sasmap")


def run_survey(
    survey: Survey,
    *,
    output: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    restart: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Outcome:
    """Run a survey: estimate every cell, write every product.

    Parameters
    ----------
    survey : Survey
    output : Path, optional
        Folder of the products; default the survey file's.
    workers : int, optional
        Threads; default one per core.
    scheduler : str, optional
        Address of a dask.distributed scheduler to use instead of threads.
    restart : bool
        Discard finished work first.
    progress : callable, optional
        Called with the stage (ripples or sediments), the number of finished cells and of all cells.

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
        check_fits(plan, workers)
    # linear-algebra threads compete with the threads of cells: on a busy machine a run took twice
    # as long, and sums may depend on the number of threads
    with threadpool_limits(1, user_api="blas"), cluster(scheduler) as client:
        check_workers(client, sorted(plan.hashes))
        store = Store(_made(survey.output_folder))
        with locked(store.folder / LOCK), _logged(store.output / LOG) as note:
            log.info("sasmap %s, run %s of %s", code_version(), plan.run_id, survey.path)
            for warning in plan.opened.warnings:
                log.warning("warning: %s", warning)
            store.remove_leftovers()
            if restart:
                store.clear()
            outcome = Outcome(
                store.output, seconds=clock.seconds, warnings=list(plan.opened.warnings)
            )
            if survey.ripples is not None:
                with clock.stage("ripples"):
                    _estimate_cells(plan, store, outcome, workers, client, progress)
            _make_products(plan, store, outcome, clock, workers, client, progress)
            for line in summary_lines(outcome):
                note(line)
            note("ended: " + ("complete" if not outcome.failures else "with failures"))
    return outcome


def _make_products(
    plan: Plan,
    store: Store,
    outcome: Outcome,
    clock: Clock,
    workers: int | None,
    client: Any,
    progress: Callable[[str, int, int], None] | None,
) -> None:
    survey = plan.settings
    if survey.sediments is not None:
        log.info("sediments")
        with clock.stage("sediments"):
            told = None if progress is None else partial(progress, "sediments")
            _attempt(
                outcome,
                "sediments",
                lambda: sediment_stage(plan, store, outcome, workers, told, client),
            )
    if survey.ripples is not None:  # after the sediments, which show the cells that share a law
        with clock.stage("products"):
            combine_cells(plan, outcome)
            _write_ripples(plan, store, outcome)
    log.info("mosaic")
    with clock.stage("mosaic"):
        _attempt(outcome, "mosaic.tif", lambda: write_mosaic(plan, store, workers))
    _name_stale(store, outcome)
    log.info("report")
    with clock.stage("report"):
        _present(plan, store, outcome)
    _attempt(outcome, MANIFEST, lambda: [write_manifest(plan.ripples, store, outcome)])


def _name_stale(store: Store, outcome: Outcome) -> None:
    """Warn about products of an earlier run that this run does not write."""
    written = {path.name for path in outcome.written}
    names = [n for n in (*RIPPLE_PRODUCTS, *SEDIMENT_PRODUCTS) if not n.endswith(".aux.xml")]
    stale = [n for n in names if n not in written and (store.output / n).exists()]
    if stale:
        outcome.warn(
            f"{store.output}: {', '.join(stale)}: left by an earlier run, not made now: remove, "
            "or choose another output folder"
        )


class _LogFile(logging.FileHandler):
    """A log file that does not complain: a full disk ends the run in one line of its own."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Drop a line that cannot be written."""


@contextmanager
def _logged(path: Path) -> Iterator[Callable[[str], None]]:
    """Copy log messages to a file, with times; record there how the run ended.

    Yields a function that writes a line to the file alone.
    """
    try:
        handler = _LogFile(path, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    before = log.level
    log.setLevel(logging.INFO)
    log.addHandler(handler)

    def note(line: str) -> None:
        handler.handle(log.makeRecord(log.name, logging.INFO, "", 0, line, (), None))

    try:
        yield note
    except KeyboardInterrupt as stop:
        note(f"ended: {str(stop) or 'interrupted'}; run again to go on from here")
        raise
    except BaseException as error:
        note(f"ended: {fault_of(error) if isinstance(error, Exception) else error!r}")
        raise
    finally:
        log.removeHandler(handler)
        log.setLevel(before)
        handler.close()


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
    progress: Callable[[str, int, int], None] | None,
) -> None:
    plan = plan.ripples
    cells = list(plan.cells)
    log.info("%d cells, %d looks at them", len(cells), sum(map(len, plan.cells.values())))
    if not compiled():
        log.info("compiling first, once after an installation or update: about a minute")
    told = None if progress is None else partial(progress, "ripples")
    found = compute(Context(plan, store), cells, workers, client, told)
    done = dict(zip(cells, found, strict=True))
    for cell, looks in plan.cells.items():
        summaries: list[Summary | None] = [None] * len(plan.swaths)
        keys: list[str | None] = [None] * len(plan.swaths)
        for k, result in zip(looks, done[cell], strict=True):
            summaries[k] = result.summary
            keys[k] = result.key
            outcome.computed += result.computed
            outcome.kept += not result.computed
            if result.fault is not None:
                summaries[k] = Summary(Quality.FAILED, LeftOut(0))
                outcome.failures.append(_failure(cell, plan.swaths[k], result.fault))
        outcome.cells[cell.row, cell.column] = summaries
        outcome.keys[cell.row, cell.column] = keys


def _failure(cell: Cell, look: Swath, fault: str) -> dict[str, Any]:
    log.warning("cell row %d, column %d, pass %s: %s", *cell, look.label, fault)
    return {"row": cell.row, "column": cell.column, "pass": look.label, "fault": fault}


def _present(plan: Plan, store: Store, outcome: Outcome) -> None:
    """Styles, project, STAC item and report."""
    written = [p.name for p in outcome.written]
    names = categories([c["name"] for c in outcome.sediments], QUALITY_COLOURS)
    titles = Titles(plan.settings.name, dates_of(plan), plan.run_id, f"sasmap {VERSION}")
    _attempt(
        outcome,
        "styles",
        lambda: write_styles(store.output, written, names, titles, store.scratch),
    )
    grid = plan.opened.grid
    left, top = grid.left, grid.top
    box = left, top - grid.rows * grid.size, left + grid.columns * grid.size, top
    path = store.output / "stac.json"
    known = plan.run_id, plan.settings.name, box, grid.crs, written, recorded(plan)
    _attempt(outcome, path.name, lambda: [write_stac(path, *known, store.scratch)])
    _attempt(outcome, "report.html", lambda: [make_report(plan.ripples, store, outcome, names)])


def _attempt(outcome: Outcome, stage: str, work: Callable[[], Iterable[Path]]) -> None:
    """Run a step; where it fails, other products are kept and the failure is recorded."""
    try:
        outcome.written += work()
    except Exception as error:
        fault = fault_of(error)
        log.warning("%s: %s", stage, fault)
        outcome.failures.append({"stage": stage, "fault": fault})


def _write_ripples(plan: Plan, store: Store, outcome: Outcome) -> None:
    grid, settings = plan.ripples.opened.grid, plan.settings.ripples
    assert settings is not None
    shape = grid.rows, grid.columns
    scratch, tags = store.scratch, tags_of(plan)
    names = [swath.sonar_pass.name for swath in plan.swaths]
    labels = [swath.label for swath in plan.swaths]
    results = cell_results(outcome.cells, outcome.fused, names)
    place = grid.transform, grid.crs
    _attempt(
        outcome,
        "ripple rasters",
        lambda: write_ripple_rasters(store.output, results, shape, *place, tags, scratch),
    )
    _attempt(
        outcome,
        "ripple cells",
        lambda: write_cells(store.output, results, *place, grid.size, scratch),
    )
    doubt = bands_or_ripples(outcome.cells, outcome.fused, plan.swaths)
    if doubt:
        outcome.warn(doubt)
    path = store.output / "ripples.nc"
    found = outcome.cells, outcome.fused, labels, names
    _attempt(
        outcome,
        path.name,
        lambda: write_ripples_netcdf(
            path, *found, shape, *place, grid.size, tags, scratch, outcome.survey
        ),
    )
    _attempt(outcome, "ripple_extent.gpkg", lambda: [write_ripple_extent(plan, store, outcome)])
    if settings.keep_model:
        _attempt(outcome, "modelled amplitude", lambda: [_write_model(plan, store, outcome)])


def _write_model(plan: Plan, store: Store, outcome: Outcome) -> Path:
    grid, window = plan.opened.grid, plan.settings.window
    path = store.output / "modelled_amplitude.tif"

    def last(cell: tuple[int, int]) -> Any:
        """Modelled amplitude of the last pass that has one."""
        for key in reversed(outcome.keys.get(cell, [])):
            found = None if key is None else store.load_arrays(key, ("model",))
            if found is not None:
                return found[0]
        return None

    def model(row: int, column: int) -> Any:
        if plan.overlapping is None:
            return last((row, column))
        every = {s.cell: last(s.cell) for s in sharing(plan, (row, column))}
        return blended(plan, (row, column), {k: v for k, v in every.items() if v is not None})

    amplitude = ModelledAmplitude(model, (grid.rows, grid.columns), window)
    bands = BY_FILE[path.name].bands
    layer = float_layer([b.text for b in bands], [b.unit for b in bands], tags_of(plan))
    write_large_cog(path, amplitude, layer, grid.pixels(window), grid.crs, store.scratch)
    return path
