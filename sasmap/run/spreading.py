"""Parts of a map computed on a cluster whose workers may die."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import dask

log = logging.getLogger("sasmap")


class Spread:
    """The equivalent of :func:`sasmap.numerics.threads.mapped` on the workers of a cluster.

    Parts are written to rasters in the output folder, which all workers share; only statistics of
    blocks of pixels, and lines, are returned. A part that runs twice writes the same values.

    Parameters
    ----------
    client : distributed.Client
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield a function's result for each item, in order.

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
            Where an item kills every worker.
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
                futures[k] = None  # free results that were yielded
                yield result
        finally:
            self._client.cancel([f for f in futures if f is not None])

    def _alone(self, function: Callable[[Any], Any], item: Any) -> Any:
        """Run an item again: another one may have killed its workers."""
        from distributed import KilledWorker

        log.info("sediments: %s again, alone", item)
        try:
            return self._client.compute(_task(function, item), retries=0).result()
        except KilledWorker:
            raise RuntimeError(f"{item}: kills every worker: out of memory, or killed") from None


def _task(function: Callable[[Any], Any], item: Any) -> Any:
    return dask.delayed(function, pure=False, traverse=False)(item)
