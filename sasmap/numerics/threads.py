"""Work in threads that an interrupt or a fault ends at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def mapped(function: Callable[[T], R], items: Iterable[T], workers: int | None) -> Iterator[R]:
    """Yield what a function gives for each item, in order; little more than `workers` wait.

    Parameters
    ----------
    function : callable
    items : iterable
    workers : int or None
        Threads; None for one a core.

    Yields
    ------
    object
    """
    pool = ThreadPoolExecutor(workers)
    rest = iter(items)
    try:
        waiting = [pool.submit(function, item) for item in islice(rest, 4 * (workers or 8))]
        while waiting:
            yield waiting.pop(0).result()
            waiting += [pool.submit(function, item) for item in islice(rest, 1)]
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
