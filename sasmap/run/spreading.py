"""Work on the parts of a map, spread over a cluster whose workers may die."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import dask

log = logging.getLogger("sasmap")


class Spread:
    """Does what :func:`sasmap.numerics.threads.mapped` does, on the workers of a cluster.

    Parts are written to rasters in the output folder, which all workers share; what comes back is
    no more than statistics of blocks of pixels, and lines. Doing a part twice writes the same.

    Parameters
    ----------
    client : distributed.Client
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield what a function gives for each item, in order.

        Parameters
        ----------
        function : callable
        items : iterable

        Yields
        ------
        object

        Raises
        ------
        RuntimeError
            Where no worker survives an item.
        """
        from distributed import KilledWorker  # heavy, and only clusters need it

        every = list(items)
        futures = self._client.compute([_task(function, item) for item in every])
        try:
            for k, item in enumerate(every):
                try:
                    result = futures[k].result()
                except KilledWorker:
                    result = self._alone(function, item)
                futures[k] = None  # forget what has been told
                yield result
        finally:
            self._client.cancel([f for f in futures if f is not None])

    def _alone(self, function: Callable[[Any], Any], item: Any) -> Any:
        """Do an item again: another may have killed the workers that it was on."""
        from distributed import KilledWorker

        log.info("sediments: %s again, alone", item)
        try:
            return self._client.compute(_task(function, item), retries=0).result()
        except KilledWorker:
            raise RuntimeError(f"{item}: no worker survives it: out of memory, or killed") from None


def _task(function: Callable[[Any], Any], item: Any) -> Any:
    return dask.delayed(function, pure=False, traverse=False)(item)
