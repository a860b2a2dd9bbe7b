"""Cells as dask tasks: on threads of this machine, or on cluster workers, which may die."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import dask
from dask.callbacks import Callback

from sasmap.errors import InputError
from sasmap.run.task import Context, LookResult, run_cell
from sasmap.survey.cells import Cell

log = logging.getLogger("sasmap")

CLUSTER_TIMEOUT = "10s"
DIED = "its worker died, also when run alone: out of memory, or killed"
Progress = Callable[[int, int], None]


@contextmanager
def cluster(address: str | None) -> Iterator[Any]:
    """Connect to a dask scheduler.

    Parameters
    ----------
    address : str or None
        Address of the scheduler, with its port.

    Yields
    ------
    distributed.Client or None
        None without an address.

    Raises
    ------
    InputError
        Where no scheduler answers.
    """
    if address is None:
        yield None
        return
    _check_address(address)
    from distributed import Client  # heavy, and only clusters need it

    try:
        client = Client(address, timeout=CLUSTER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, ImportError, RuntimeError) as error:
        told = " ".join(str(error).split())
        raise InputError(f"--scheduler {address}: no dask scheduler answers: {told}") from None
    with client:
        yield client


def _check_address(address: str) -> None:
    """Refuse an address without a port: dask would raise a traceback, or wait."""
    host, mark, port = address.rpartition("://")[2].rpartition(":")
    if not mark or not port.isdigit() or not host:
        raise InputError(
            f"--scheduler {address}: expected an address with its port, such as tcp://node1:8786 "
            "(dask scheduler prints it when it starts)"
        )


def check_workers(client: Any, inputs: Sequence[Path]) -> None:
    """Check that the workers of a cluster see the same survey files as this process.

    Parameters
    ----------
    client : distributed.Client or None
    inputs : sequence of Path
        Absolute.

    Raises
    ------
    InputError
        Names a worker and a file that it does not see.
    """
    if client is None:
        return
    sizes = {str(path): path.stat().st_size for path in inputs}
    answers = client.run(_not_seen, sizes, on_error="return")
    for worker, answer in sorted(answers.items()):
        if isinstance(answer, OSError):
            continue  # it has died: others take over its work
        if isinstance(answer, Exception):
            told = " ".join(f"{type(answer).__name__}: {answer}".split())
            raise InputError(f"--scheduler: worker {worker} cannot check the tiles: {told}")
        if answer is not None:
            raise InputError(
                f"{answer}: worker {worker} does not see this file, or sees another one: expected "
                "a file system that all workers share, mounted at the same path"
            )


def _not_seen(sizes: dict[str, int]) -> str | None:
    """Return the first file that is missing or has another size; runs on a worker."""
    for name, size in sizes.items():
        try:
            if os.stat(name).st_size != size:
                return name
        except OSError:
            return name
    return None


def compute(
    context: Context,
    cells: Sequence[Cell],
    workers: int | None,
    client: Any,
    progress: Progress | None,
) -> list[list[LookResult]]:
    """Run cells in any order on the available threads or workers.

    Parameters
    ----------
    context : Context
    cells : sequence of Cell
    workers : int or None
        Threads, without a cluster; default one per core.
    client : distributed.Client or None
    progress : callable or None
        Called with the number of finished cells and of all cells.

    Returns
    -------
    list of list of LookResult
        Looks of each cell, in the order of `cells`. Where a worker dies its cells run again
        elsewhere; a cell that kills every worker is recorded as failed.
    """
    shared = dask.delayed(context, pure=False, traverse=False)
    tasks = [dask.delayed(run_cell, pure=False)(shared, cell) for cell in cells]
    tick = _Ticker(len(tasks), progress)
    if client is not None:
        return _on_cluster(client, context, list(zip(cells, tasks, strict=True)), tick)
    results: list[list[LookResult]]
    with Callback(posttask=lambda key, *_: tick() if str(key).startswith("run_cell") else None):
        results = list(
            dask.compute(*tasks, scheduler="threads", num_workers=workers or os.cpu_count() or 1)
        )
    return results


def _on_cluster(
    client: Any, context: Context, tasks: list[tuple[Cell, Any]], tick: _Ticker
) -> list[list[LookResult]]:
    from distributed import as_completed

    futures = client.compute([task for _, task in tasks])
    place = {future.key: i for i, future in enumerate(futures)}
    done: dict[int, list[LookResult]] = {}
    suspects = []
    with client.as_current():
        for future in as_completed(futures):
            if future.status == "finished":
                done[place[future.key]] = future.result()
                tick()
            else:
                suspects.append(place[future.key])
    # a cell that kills its worker takes others with it: run alone, only that cell fails
    for i in sorted(suspects):
        cell, _ = tasks[i]
        log.info("cell row %d, column %d: again, alone", *cell)
        # a new task: under its old key the scheduler would return the old failure
        shared = dask.delayed(context, pure=False, traverse=False)
        future = client.compute(dask.delayed(run_cell, pure=False)(shared, cell), retries=0)
        found = future.exception()
        looks = context.plan.cells[cell]
        done[i] = [LookResult(None, DIED, True) for _ in looks] if found else future.result()
        tick()
    return [done[i] for i in range(len(tasks))]


class _Ticker:
    def __init__(self, total: int, progress: Progress | None) -> None:
        self._total, self._progress, self._done = total, progress, 0

    def __call__(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)
