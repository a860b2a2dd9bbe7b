"""A survey from plan to products: cells and passes as dask work, finished cells kept."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr
from dask.callbacks import Callback

from sasmap.config import Survey
from sasmap.errors import InputError
from sasmap.productnames import MANIFEST, RIPPLE_PRODUCTS
from sasmap.products.files import write_text
from sasmap.products.model import on_cell, write_mosaic
from sasmap.products.ripples import write_ripple_rasters, write_ripples_netcdf
from sasmap.products.sediments import write_sediments
from sasmap.ripples.chain import Chain, chained, next_prior
from sasmap.ripples.clip import Clip
from sasmap.ripples.estimate import estimate
from sasmap.ripples.passes import Summary, summarise
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.ripples.settings import RippleSettings
from sasmap.sedimentmap import Bands, levelled, map_sediments
from sasmap.store import Store, code_version, digest
from sasmap.survey.cells import Cell
from sasmap.survey.navigation import Track
from sasmap.survey.passes import OpenSurvey, Side, SonarPass, open_survey, read_clip, tiles_of_cells
from sasmap.survey.tiles import Tile, hash_file

log = logging.getLogger("sasmap")

MIN_VALID = 0.25
CLUSTER_TIMEOUT = "10s"
TRAINING_NOTE = "sediments: classes with training polygons are not yet run by this version"


class Look(NamedTuple):
    """One side of one pass."""

    sonar_pass: SonarPass
    side: Side

    @property
    def label(self) -> str:
        """The pass's name, with the side where the pass shows both."""
        both = len(self.sonar_pass.sides) == 2
        return f"{self.sonar_pass.name}:{self.side}" if both else self.sonar_pass.name


@dataclass(frozen=True)
class Plan:
    """What a run will do.

    Attributes
    ----------
    opened : OpenSurvey
    looks : tuple of Look
    cells : dict of Cell to tuple of int
        The looks (indices) whose tiles meet each cell that any meet.
    tiles : dict of str to dict of Cell to tuple of Tile
        By pass, the tiles that may show each cell.
    hashes : dict of Path to str
        SHA-256 of every input file.
    left_out : tuple of str
        What the survey does not call for, and why.
    """

    opened: OpenSurvey
    looks: tuple[Look, ...]
    cells: dict[Cell, tuple[int, ...]]
    tiles: dict[str, dict[Cell, tuple[Tile, ...]]]
    hashes: dict[Path, str]
    left_out: tuple[str, ...]

    @property
    def settings(self) -> Survey:
        """The survey's settings."""
        return self.opened.settings

    @property
    def run_id(self) -> str:
        """Hash of inputs, settings, code version and seed."""
        # inputs count by what they hold, not by where they lie
        places: Any = {"passes": {"__all__": {"tiles", "navigation"}}, "output": True}
        settings = self.settings.model_dump(mode="json", exclude=places)
        return digest([self._inputs(), settings, code_version()])[:16]

    def _inputs(self) -> list[list[str]]:
        return [
            [look.label, *(self.hashes[f] for f in look.sonar_pass.files)] for look in self.looks
        ]


class LookResult(NamedTuple):
    """What became of one look at one cell: a summary, or why there is none."""

    summary: Summary | None
    fault: str | None
    computed: bool
    model: str | None = None  # key of the modelled amplitude in the store


@dataclass
class Outcome:
    """What became of a run."""

    output: Path
    cells: dict[tuple[int, int], list[Summary | None]] = field(default_factory=dict)
    chains: dict[tuple[int, int], Chain] = field(default_factory=dict)
    models: dict[tuple[int, int], list[str | None]] = field(default_factory=dict)
    sediments: list[dict[str, Any]] = field(default_factory=list)
    failures: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    computed: int = 0
    kept: int = 0
    written: list[Path] = field(default_factory=list)

    def counts(self) -> dict[str, int]:
        """Cells by quality."""
        labels = [chain.quality.label for chain in self.chains.values()]
        return {q.label: labels.count(q.label) for q in Quality if q.label in labels}


def make_plan(survey: Survey) -> Plan:
    """Open and check a survey, and list what would run.

    Parameters
    ----------
    survey : Survey

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        With a line for every fault of the survey's files.
    """
    opened = open_survey(survey)
    looks = tuple(Look(p, side) for p in opened.passes for side in p.sides)
    tiles = {p.name: tiles_of_cells(p, opened.grid) for p in opened.passes}
    cells = {
        cell: tuple(k for k, look in enumerate(looks) if cell in tiles[look.sonar_pass.name])
        for cell in sorted({cell for met in tiles.values() for cell in met})
    }
    files = {f for p in opened.passes for f in p.files}
    left_out = [] if survey.ripples else ["ripples: the survey file has no ripples block"]
    if survey.sediments is None:
        left_out.append("sediments: the survey file has no sediments block")
    elif isinstance(survey.sediments.classes, tuple):
        left_out.append(TRAINING_NOTE)
    hashes = {f: hash_file(f) for f in sorted(files)}
    return Plan(opened, looks, cells, tiles, hashes, tuple(left_out))


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
    clock = _Clock()
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
    if _mapped(plan):
        with clock.stage("sediments"):
            _try_sediments(plan, store, outcome, workers)
    _write_manifest(plan, store, outcome)
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
    context = dask.delayed(_Context(plan, store), pure=False, traverse=False)
    for cell, looks in plan.cells.items():
        earlier: list[Any] = []
        for k in looks:
            tasks[cell, k] = dask.delayed(_run_look, pure=False)(context, cell, k, list(earlier))
            if settings.method == "zare-cobb":  # the default method chains what looks know
                earlier.append(tasks[cell, k])
    total = len(tasks)
    log.info("%d cells, %d looks at them", len(plan.cells), total)
    done = dict(zip(tasks, _compute(list(tasks.values()), workers, client, progress), strict=True))
    for cell, looks in plan.cells.items():
        summaries: list[Summary | None] = [None] * len(plan.looks)
        models: list[str | None] = [None] * len(plan.looks)
        for k in looks:
            result = done[cell, k]
            summaries[k] = result.summary
            models[k] = result.model
            outcome.computed += result.computed
            outcome.kept += not result.computed
            if result.fault is not None:
                summaries[k] = Summary(Quality.FAILED, LeftOut(0))
                outcome.failures.append(_failure(cell, plan.looks[k], result.fault))
        outcome.cells[cell.row, cell.column] = summaries
        outcome.models[cell.row, cell.column] = models
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
    with Callback(posttask=lambda key, *_: tick() if str(key).startswith("_run_look") else None):
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


class _Context(NamedTuple):
    plan: Plan
    store: Store


def _run_look(context: _Context, cell: Cell, k: int, earlier: list[LookResult]) -> LookResult:
    """Estimate one look at one cell, or take its finished result. Never raises."""
    try:
        return _look(context, cell, k, [r.summary for r in earlier if r.summary is not None])
    except Exception as error:  # one cell's fault must not end the survey
        return LookResult(None, f"{type(error).__name__}: {error}", True)


def _look(context: _Context, cell: Cell, k: int, earlier: list[Summary]) -> LookResult:
    plan, store = context
    look = plan.looks[k]
    settings = _ripple_settings(plan)
    prior = next_prior(earlier, settings)
    key = _key(plan, cell, look, [prior.mean, prior.sd])
    kept = store.load(key)
    if kept is not None:
        return LookResult(kept, None, False, _model_key(store, key))
    clip = _clip(plan, cell, look, look.side)
    if clip is None:
        summary = Summary(Quality.NO_DATA, LeftOut.SAMPLING)
    elif _shown(plan, cell, look, clip) < MIN_VALID:
        summary = Summary(Quality.TOO_FEW_PIXELS, LeftOut.SAMPLING)
    else:
        rng = np.random.default_rng(_seed(plan.settings.seed, look, cell))
        pixels = Clip.from_array(clip)
        posterior = estimate(pixels, settings, rng=rng, prior=prior)
        summary = summarise(posterior)
        if posterior.model is not None and posterior.relief is not None:
            place = plan.opened.grid, cell, plan.settings.window
            both = (on_cell(pixels, v, *place) for v in (posterior.model, posterior.relief))
            store.save_model(key, *both)
    store.save(key, summary)
    return LookResult(summary, None, True, _model_key(store, key))


def _ripple_settings(plan: Plan) -> RippleSettings:
    """Return settings of the estimates: the sediment map needs the ripples' modelled amplitude."""
    settings = plan.settings.ripples
    assert settings is not None
    return settings.model_copy(update={"keep_model": settings.keep_model or _mapped(plan)})


def _mapped(plan: Plan) -> bool:
    """Whether the survey calls for a sediment map that this version makes."""
    sediments = plan.settings.sediments
    return sediments is not None and not isinstance(sediments.classes, tuple)


def _model_key(store: Store, key: str) -> str | None:
    return key if store.model_path(key).exists() else None


def _clip(plan: Plan, cell: Cell, look: Look, side: Side) -> xr.DataArray | None:
    tiles = plan.tiles[look.sonar_pass.name].get(cell, ())
    return read_clip(look.sonar_pass, plan.opened.grid, cell, side, tiles)


def _shown(plan: Plan, cell: Cell, look: Look, clip: xr.DataArray) -> float:
    """Fraction of a cell that a look's pass shows, its other side included if that matters."""

    def fraction(part: xr.DataArray | None) -> float:
        if part is None:
            return 0.0
        area = int(np.isfinite(part.values).sum()) * part.attrs["pixel_size"] ** 2
        return float(area / plan.opened.grid.size**2)

    shown = fraction(clip)
    for side in look.sonar_pass.sides:
        if side != look.side and shown < MIN_VALID:
            shown += fraction(_clip(plan, cell, look, side))
    return shown


def _seed(seed: int, look: Look, cell: Cell) -> np.random.SeedSequence:
    # the pass by its name, so that a pass added or moved in the list changes no other
    name = int(digest(look.label)[:16], 16)
    return np.random.SeedSequence([seed, name, cell.row, cell.column])


def _key(plan: Plan, cell: Cell, look: Look, prior: list[Any]) -> str:
    grid, sonar_pass = plan.opened.grid, look.sonar_pass
    tiles = plan.tiles[sonar_pass.name].get(cell, ())
    return digest(
        {
            "code": code_version(),
            "seed": plan.settings.seed,
            "settings": _ripple_settings(plan).model_dump(mode="json"),
            "grid": [grid.crs, repr(grid.left), repr(grid.top), repr(grid.size)],
            "cell": list(cell),
            "pass": [look.label, look.side, sonar_pass.slant],
            "tiles": [plan.hashes[tile.path] for tile in tiles],
            "track": _track_hash(sonar_pass.track),
            "prior": repr(prior),
        }
    )


@lru_cache(maxsize=1024)
def _track_hash(track: Track) -> str:
    state = hashlib.sha256()
    for values in (track.x, track.y, track.altitude):
        state.update(values.tobytes())
    return state.hexdigest()


def _tags(plan: Plan) -> dict[str, str]:
    return {
        "SOFTWARE": f"sasmap {code_version()}",
        "SURVEY": plan.settings.name,
        "RUN_ID": plan.run_id,
    }


def _write_ripples(plan: Plan, store: Store, outcome: Outcome) -> None:
    grid, settings = plan.opened.grid, plan.settings.ripples
    assert settings is not None
    shape, tags = (grid.rows, grid.columns), _tags(plan)
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
        last = {c: [m for m in keys if m is not None] for c, keys in outcome.models.items()}
        models = {c: keys[-1] for c, keys in last.items() if keys}
        write_mosaic(path, models, store.load_model, shape, window, grid, tags, store.scratch)
        outcome.written.append(path)


def _try_sediments(plan: Plan, store: Store, outcome: Outcome, workers: int | None) -> None:
    """Map sediments; where that fails, what is done stays and the run says what is missing."""
    try:
        _map_sediments(plan, store, outcome, workers)
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
        log.warning("sediments: %s", fault)
        outcome.failures.append({"stage": "sediments", "fault": fault})


def _map_sediments(plan: Plan, store: Store, outcome: Outcome, workers: int | None) -> None:
    assert plan.settings.sediments is not None
    grid, window = plan.opened.grid, plan.settings.window
    count = plan.settings.sediments.classes
    bands = Bands(
        grid.rows, grid.columns, window, len(plan.looks), partial(_read_look, plan, store, outcome)
    )
    found = map_sediments(
        bands, count if isinstance(count, int) else None, workers or os.cpu_count() or 1
    )
    if found is None:
        return
    transform = grid.pixels(window)
    outcome.sediments = found.table(abs(transform.determinant))
    outcome.written += write_sediments(
        store.output,
        found.label,
        found.confidence,
        found.lines,
        found.names,
        transform,
        grid.crs,
        _tags(plan),
        store.scratch,
    )


def _read_look(
    plan: Plan, store: Store, outcome: Outcome, row: int, column: int, k: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Amplitude, over that of ripples, and ground range of a look on a cell's own pixels."""
    cell, look = Cell(row, column), plan.looks[k]
    if k not in plan.cells.get(cell, ()):
        return None
    try:
        clip = _clip(plan, cell, look, look.side)
    except (OSError, ValueError):  # a block that does not decode: the ripple stage names it
        return None
    if clip is None:
        return None
    pixels = Clip.from_array(clip)
    place = plan.opened.grid, cell, plan.settings.window
    known = np.where(pixels.valid, pixels.amplitude, np.nan)
    amplitude, reach = (on_cell(pixels, v, *place) for v in (known, pixels.ground_range))
    keys = outcome.models.get((row, column))
    key = keys[k] if keys else None
    relief = store.load_relief(key).astype(float) if key is not None else None
    return levelled(amplitude.astype(float), relief), reach.astype(float)


def _write_manifest(plan: Plan, store: Store, outcome: Outcome) -> None:
    path = store.output / MANIFEST
    outcome.written.append(path)
    base = plan.settings.path.parent
    content = {
        "run_id": plan.run_id,
        "survey": plan.settings.name,
        "versions": _versions(),
        "settings": plan.settings.model_dump(mode="json"),
        "seed": plan.settings.seed,
        "inputs": {_relative(f, base): value for f, value in plan.hashes.items()},
        "grid": {
            "rows": plan.opened.grid.rows,
            "columns": plan.opened.grid.columns,
            "cell_size_m": plan.opened.grid.size,
        },
        "cells_by_quality": outcome.counts(),
        "looks_computed": outcome.computed,
        "looks_kept_from_earlier_runs": outcome.kept,
        "sediment_classes": outcome.sediments,
        "failures": outcome.failures,
        "warnings": list(plan.opened.warnings),
        "left_out": [*plan.left_out, *_left_out_counts(outcome)],
        "products": [p.name for p in outcome.written],
        "seconds": {name: round(value, 3) for name, value in outcome.seconds.items()},
    }
    write_text(path, json.dumps(content, indent=2) + "\n", store.scratch)


def _left_out_counts(outcome: Outcome) -> Iterator[str]:
    every = [s for summaries in outcome.cells.values() for s in summaries if s is not None]
    for flag in LeftOut:
        count = sum(1 for s in every if flag in s.left_out)
        if count:
            name = str(flag.name).lower().replace("_", " ")
            yield f"{name}: at {count} of {len(every)} looks at cells"


def _relative(path: Path, base: Path) -> str:
    try:
        return str(path.relative_to(base))
    except ValueError:
        return os.path.relpath(path, base)


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    names = ("numpy", "scipy", "numba", "rasterio", "xarray", "dask", "pyproj")
    return {
        "sasmap": code_version(),
        "python": platform.python_version(),
        **{name: version(name) for name in names},
    }


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


def describe(plan: Plan) -> Iterable[str]:
    """Tell what a plan would run, a line each."""
    grid = plan.opened.grid
    looks = [len(k) for k in plan.cells.values()]
    yield f"survey: {plan.settings.name}"
    yield f"cells: {grid.rows} rows x {grid.columns} columns of {grid.size:g} m"
    for p in plan.opened.passes:
        met = sum(any(plan.looks[k].sonar_pass is p for k in ks) for ks in plan.cells.values())
        sides = " and ".join(p.sides)
        yield f"pass {p.name}: {len(p.tiles)} tiles, {sides}, {p.track.x.size} pings, {met} cells"
    if plan.settings.ripples is not None:
        method = plan.settings.ripples.method
        yield f"ripples: method {method}, {sum(looks)} looks at cells, at most {max(looks)} a cell"
    for line in plan.left_out:
        yield f"left out: {line}"
    for line in plan.opened.warnings:
        yield f"warning: {line}"
