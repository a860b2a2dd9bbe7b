"""Ordered parallel map over threads or another executor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")
# Number of threads (None for one per core), or a function that runs the work elsewhere and yields
# results in order.
Workers = int | None | Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]


def mapped(function: Callable[[T], R], items: Iterable[T], workers: Workers) -> Iterator[R]:
    """Yield a function's result for each item, in order; an interrupt or error ends all threads.

    Parameters
    ----------
    function : callable
    items : iterable
    workers : int, None or callable
        Number of threads; None for one per core. A callable gets the function and the items.

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
