"""Ordered parallel map over threads, or over whatever else spreads the work."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")
# Threads (None for one per core), or a function that spreads work elsewhere and yields in order.
Workers = int | None | Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]


def mapped(function: Callable[[T], R], items: Iterable[T], workers: Workers) -> Iterator[R]:
    """Yield a function's result for each item, in order; an interrupt or a fault ends all threads.

    Parameters
    ----------
    function : callable
    items : iterable
    workers : int, None or callable
        Threads; None for one per core. A callable is called with the function and the items.

    Yields
    ------
    object
    """
    if callable(workers):
        yield from workers(function, items)
        return
    pool = ThreadPoolExecutor(workers)
    rest = iter(items)
    try:
        waiting = [pool.submit(function, item) for item in islice(rest, 4 * (workers or 8))]
        while waiting:
            yield waiting.pop(0).result()
            waiting += [pool.submit(function, item) for item in islice(rest, 1)]
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
