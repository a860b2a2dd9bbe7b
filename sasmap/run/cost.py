"""What a run will cost in time, memory and disk, and whether that fits this machine."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sasmap.errors import InputError
from sasmap.run.plan import Plan
from sasmap.run.sediment_map import SAMPLE
from sasmap.run.store import Store
from sasmap.run.task import finished_looks
from sasmap.run.wording import duration, size

# Seconds a pixel on one core, measured by pipelines/scale/scale.py: looks without ripples and with
# bent ones; the sediment map.
FLAT, RIPPLED, MAPPED = 4e-7, 2.4e-6, 5e-7
# Bytes of the process and its libraries; a pixel of a cell in work; a pixel of the sample.
BASE, WORKING, SAMPLED = 400e6, 300.0, 130.0
# Bytes on disk: of a look at a cell; of its pixels for the sediment map, modelled, and of the
# ripples' extent; of the map in the making, and of products.
RECORD, KEPT, MODELLED, EXTENT, MAKING, PRODUCTS = 4096, 6, 4, 1, 22, 6


class Cost(NamedTuple):
    """What a run will cost.

    Attributes
    ----------
    seconds : tuple of float
        Where no cell is rippled, and where all are.
    memory, disk : float
        Bytes, at most.
    finished, looks : int
        Looks at cells that an earlier run has finished, and all.
    """

    seconds: tuple[float, float]
    memory: float
    disk: float
    finished: int
    looks: int


def cost_of(plan: Plan, workers: int | None) -> Cost:
    """Estimate what a run will cost.

    Parameters
    ----------
    plan : Plan
    workers : int or None
        Threads; default one a core.

    Returns
    -------
    Cost
    """
    survey = plan.settings
    threads = workers or os.cpu_count() or 1
    looks = sum(len(k) for k in plan.cells.values())
    cell = survey.window**2
    pixels = len(plan.cells) * cell
    finished = finished_looks(plan, Store(survey.output_folder)) if survey.ripples else 0
    low = high = 0.0
    memory = BASE + WORKING * cell * threads
    disk = 0.0
    if survey.ripples is not None:
        left = (looks - finished) * cell
        low, high = FLAT * left, RIPPLED * left
        kept = EXTENT + MODELLED * survey.ripples.keep_model
        disk += (looks - finished) * (RECORD + kept * cell)
    if survey.sediments is not None:
        low, high = (v + MAPPED * (pixels + 0.2 * looks * cell) for v in (low, high))
        memory += SAMPLED * min(SAMPLE, looks * cell)
        disk += KEPT * (looks - finished) * cell * (survey.ripples is not None)
        disk += (MAKING + PRODUCTS) * plan.opened.grid.rows * plan.opened.grid.columns * cell
    return Cost((low / threads, high / threads), memory, disk, finished, looks)


def check_fits(plan: Plan, workers: int | None) -> None:
    """Refuse a run that needs more memory or disk than this machine has.

    Raises
    ------
    InputError
    """
    cost = cost_of(plan, workers)
    folder = plan.settings.output_folder
    faults = []
    free = shutil.disk_usage(_existing(folder)).free
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
    """Nearest folder above that exists."""
    folder = folder.absolute()
    while not folder.is_dir():
        folder = folder.parent
    return folder


def describe_cost(plan: Plan, workers: int | None) -> Iterator[str]:
    """Tell what a run will cost, a line each."""
    cost = cost_of(plan, workers)
    threads = workers or os.cpu_count() or 1
    if cost.finished:
        yield f"finished by an earlier run: {cost.finished} of {cost.looks} looks at cells"
    low, high = (duration(v) for v in cost.seconds)
    span = low if low == high else f"{low} without ripples to {high} with ripples everywhere"
    yield f"time: about {span}, on {threads} threads (and a minute to compile, once)"
    yield f"memory: about {size(cost.memory)}; disk: at most {size(cost.disk)}"
