"""Estimate of a run's time, memory and disk space, and whether it fits this machine."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sasmap.errors import InputError
from sasmap.ripples import rendering
from sasmap.run.plan import Plan
from sasmap.run.store import Store
from sasmap.run.task import finished_looks, try_look
from sasmap.run.wording import duration, size
from sasmap.sediments.segmentation import DESCRIBED, SAMPLE

# Seconds for a look at a cell on one core where none can be timed: per pixel of flat sea floor, and
# per look with ripples, which hardly depends on the window (measured on the sample survey, 2.5 GHz
# core).
FLAT, RIPPLED = 1e-6, 4.0
# Seconds per pixel on one core: for the sample in which sediment classes are found, for the
# sediment map, and for the mosaic (each look); seconds for start, products and report (measured in
# the same way).
FOUND, MAPPED, LAID, FIXED = 8e-7, 5e-7, 5e-7, 8.0
# Maximum number of looks that `plan` times, one in how many is timed, and seconds after which it
# stops: a plan should take less than half a minute (a choice).
TIMED, SHARE, ENOUGH = 8, 3, 15.0
# Bytes of the process with its libraries, per pixel of a cell being processed, and per pixel of the
# sediment sample: resident memory, measured on 25 Mpx of one pass (998 MB with one thread); and per
# look with its task, both held until the second stage (docs/scale.md).
BASE, WORKING, SAMPLED, HELD = 400e6, 300.0, 200.0, 22e3
# Bytes on disk: per look at a cell with its figure; per pixel for the sediment map, the modelled
# image and the ripples' extent; per pixel for temporary maps and for products; per pixel for the
# mosaic with its temporary files (from the formats' sizes, uncompressed).
RECORD, KEPT, MODELLED, EXTENT = 80_000, 8, 4, 1
MAKING, PRODUCTS, MOSAIC = 24, 6, 12


class Cost(NamedTuple):
    """Estimated cost of a run.

    Attributes
    ----------
    memory, disk : float
        Bytes, upper estimates.
    per_worker : float
        Bytes of memory per worker; the rest does not depend on their number.
    finished, looks : int
        Number of looks finished by an earlier run, and of all looks.
    """

    memory: float
    per_worker: float
    disk: float
    finished: int
    looks: int


def cost_of(plan: Plan, workers: int | None) -> Cost:
    """Estimate a run's memory and disk space.

    Parameters
    ----------
    plan : Plan
    workers : int or None
        Threads; default one per core.

    Returns
    -------
    Cost
    """
    survey = plan.settings
    threads = workers or os.cpu_count() or 1
    looks = sum(len(k) for k in plan.ripples.cells.values())
    cell = survey.window**2
    finished = finished_looks(plan.ripples, Store(survey.output_folder)) if survey.ripples else 0
    memory = BASE + WORKING * cell * threads + HELD * looks
    grid = plan.opened.grid.rows * plan.opened.grid.columns * cell
    disk = float(MOSAIC * grid)
    if survey.ripples is not None:
        kept = EXTENT + MODELLED * survey.ripples.keep_model
        disk += (looks - finished) * (RECORD + kept * cell)
    if survey.sediments is not None:
        memory += SAMPLED * min(SAMPLE, looks * cell)
        kept = survey.ripples is not None and plan.overlapping is None
        disk += KEPT * (looks - finished) * cell * kept
        disk += (MAKING + PRODUCTS) * grid
    return Cost(memory, WORKING * cell, disk, finished, looks)


def seconds_of(plan: Plan, workers: int | None) -> tuple[float, float]:
    """Estimate how long a run will take by timing a few looks.

    Parameters
    ----------
    plan : Plan
    workers : int or None

    Returns
    -------
    low, high : float
        Equal where looks could be timed; otherwise without any ripples and with ripples everywhere.
    """
    survey = plan.settings
    threads = workers or os.cpu_count() or 1
    cost, cell = cost_of(plan, workers), survey.window**2
    shown = sum(len(k) for k in plan.cells.values()) * cell
    low = high = LAID * shown
    if survey.ripples is not None:
        left = cost.looks - cost.finished
        timed = _timed(plan.ripples, left) if left and compiled() else []
        ends = (FLAT * cell, RIPPLED) if not timed else (float(np.mean(timed)),) * 2
        low, high = low + left * ends[0], high + left * ends[1]
    if survey.sediments is not None:
        pixels = len(plan.cells) * cell + 0.2 * shown
        mapped = MAPPED * pixels + FOUND * min(DESCRIBED, shown)
        low, high = low + mapped, high + mapped
    return FIXED + low / threads, FIXED + high / threads


def _timed(plan: Plan, left: int) -> list[float]:
    """Time looks spread over the survey, s."""
    looks = [(cell, k) for cell, swaths in plan.cells.items() for k in swaths]
    count = min(max(left // SHARE, 2), left, TIMED)
    seconds: list[float] = []
    for i in range(count):
        cell, k = looks[(2 * i + 1) * len(looks) // (2 * count)]
        start = time.perf_counter()
        try:
            try_look(plan, cell, k)
        except Exception:
            continue  # the run will report the fault
        seconds.append(time.perf_counter() - start)
        if sum(seconds) > ENOUGH:
            break
    return seconds[1:] if len(seconds) > 2 else seconds  # the first loads code and tables


def compiled() -> bool:
    """Whether the code of this version is compiled, judged by the cache of the rendering module."""
    source = Path(rendering.__file__)
    cached = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(cached) if cached else source.parent / "__pycache__"
    made = (path.stat().st_mtime for path in folder.rglob(f"{source.stem}.*.nbi"))
    return max(made, default=0.0) > source.stat().st_mtime


def check_fits(plan: Plan, workers: int | None) -> None:
    """Refuse a run whose output cannot be written, or that needs more than this machine has.

    Raises
    ------
    InputError
    """
    cost = cost_of(plan, workers)
    folder = plan.settings.output_folder
    faults = []
    above = _existing(folder)
    if not above.is_dir():
        faults.append(f"{folder}: output folder cannot be made: {above} is a file")
    elif not os.access(above, os.W_OK | os.X_OK):
        faults.append(f"{folder}: output folder cannot be written to")
    free = shutil.disk_usage(above).free
    if cost.disk > free:
        faults.append(
            f"{folder}: the run needs about {size(cost.disk)} of disk, {size(free)} are free"
        )
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if cost.memory > there:
        faults.append(
            f"{plan.settings.path}: window: cells of {plan.settings.window} pixels need about "
            f"{size(cost.memory)} of memory, this machine has {size(there)}"
        )
    if faults:
        raise InputError(faults)


def _existing(folder: Path) -> Path:
    """Folder itself, or the nearest of its parents that exists."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder


def describe_cost(plan: Plan, workers: int | None) -> Iterator[str]:
    """Describe the estimated cost of a run, a line each."""
    cost = cost_of(plan, workers)
    threads = workers or os.cpu_count() or 1
    if cost.finished:
        yield f"finished by an earlier run: {cost.finished} of {cost.looks} looks at cells"
    low, high = (duration(v) for v in seconds_of(plan, workers))
    span = low if low == high else f"{low} without ripples to {high} with ripples everywhere"
    first = "" if compiled() else ", and a minute to compile, once"
    yield f"time: about {span}, on {threads} threads{first}"
    fixed = size(cost.memory - threads * cost.per_worker)
    each = f"{fixed} and {size(cost.per_worker)} for each of {threads} threads"
    yield f"memory: about {size(cost.memory)} ({each}); disk: at most {size(cost.disk)}"
