"""Looks at a survey's floor, read in tiles because they may be larger than memory.

Only statistics of blocks are held in memory, one block for 256 pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.threads import Workers, mapped
from sasmap.sediments.bands import Bands
from sasmap.sediments.trends import (
    BLOCK,
    AmplitudeGrid,
    Blocks,
    block_statistics,
    log_cotangent,
    trend_of,
)

Part = tuple[slice, slice]

# Side in pixels of the tiles that are read at once: whole blocks.
TILE = 64 * BLOCK
# Pixels from which a class's law is fitted (evenly thinned), and the maximum number of blocks that
# they come from.
SAMPLES, SAMPLED_BLOCKS = 60_000, 512
# Blocks of a look whose pixels are cached for the next fit: 25 MB.
KEPT = 8192


@dataclass(frozen=True)
class Flat:
    """A look's amplitude with gain and trend removed; read in slices.

    Attributes
    ----------
    look : AmplitudeGrid
    trend : ndarray (3,)
        Log gain, slope and bend.
    centre : float
        Log cotangent about which slope and bend are taken.
    bands : Bands or None
        Gain by range, beyond the trend.
    number : int
        Index of the look in `bands`.
    kept : dict
        Cache of single blocks that have been read; shared among several gains of one look.
    """

    look: AmplitudeGrid
    trend: FloatArray
    centre: float
    bands: Bands | None = None
    number: int = 0
    kept: dict[tuple[int, int], NDArray[np.float32]] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.look.amplitude.shape
        return rows, columns

    def __getitem__(self, part: Any) -> NDArray[np.floating]:
        """Return amplitudes of a part; NaN where there is none."""
        altitude = None
        if self.bands is not None and self.look.altitude is not None:
            altitude = np.asarray(self.look.altitude[part], np.float32)
        cotangent = np.asarray(self.look.cotangent[part], np.float32)
        return self._leveled(self.look.amplitude[part], cotangent, altitude)

    def blocks(self, rows: IntArray, columns: IntArray) -> NDArray[np.floating]:
        """Return amplitudes of the pixels of some blocks (blocks, pixels)."""
        if not rows.size:
            return np.empty((0, BLOCK**2), np.float32)
        layers = np.stack([self._raw(int(r), int(c)) for r, c in zip(rows, columns, strict=True)])
        altitude = None if self.look.altitude is None else layers[:, 2]
        return self._leveled(layers[:, 0], layers[:, 1], altitude)

    def _raw(self, row: int, column: int) -> NDArray[np.float32]:
        """Amplitude, cotangent and altitude, if there is any, of a block (2 or 3, pixels)."""
        found = self.kept.get((row, column))
        if found is None:
            part = _pixels(row, column)
            found = np.array([np.ravel(v[part]) for v in self.look if v is not None], np.float32)
            if len(self.kept) < KEPT:
                self.kept[row, column] = found
        return found

    def _leveled(
        self,
        amplitude: NDArray[np.floating],
        cotangent: NDArray[np.float32],
        altitude: NDArray[np.float32] | None,
    ) -> NDArray[np.floating]:
        gain = trend_of(self.trend, log_cotangent(cotangent) - self.centre)
        if self.bands is not None:
            gain = gain + self.bands.of(self.number, cotangent, altitude)
        return np.asarray(amplitude * np.exp(-gain))

    def logs(self, part: Any) -> NDArray[np.floating]:
        """Return log amplitudes of a part; NaN where there is none."""
        values = self[part]
        return np.log(np.where(values > 0, values, np.nan))


def flat_looks(
    looks: Sequence[AmplitudeGrid], trends: FloatArray, centre: float, bands: Bands | None
) -> list[Flat]:
    """Remove gain, trend and bands, if there are any, from looks."""
    pairs = enumerate(zip(looks, trends, strict=True))
    return [Flat(look, trend, centre, bands, k) for k, (look, trend) in pairs]


def tiles(shape: tuple[int, ...], side: int = TILE) -> list[Part]:
    """List the tiles of a raster, row by row."""
    rows, columns = shape[:2]
    return [
        (slice(r, min(r + side, rows)), slice(c, min(c + side, columns)))
        for r, c in product(range(0, rows, side), range(0, columns, side))
    ]


def blocks_in(part: Part) -> Part:
    """Whole blocks of a tile that starts at a block's edge."""
    return (
        slice(part[0].start // BLOCK, part[0].stop // BLOCK),
        slice(part[1].start // BLOCK, part[1].stop // BLOCK),
    )


def on_pixels(blocks: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Expand blocks to their pixels; pixels beyond the last whole block take its value."""
    if not blocks.size:
        return np.zeros(shape, blocks.dtype)
    index = [
        np.minimum(np.arange(n) // BLOCK, m - 1) for n, m in zip(shape, blocks.shape, strict=True)
    ]
    return np.asarray(blocks[np.ix_(*index)])


def blocks_shown(mask: Any, workers: Workers = 1) -> BoolArray:
    """Find blocks that are mostly marked (above 0) in a raster that is read in slices."""
    result = np.zeros([n // BLOCK for n in mask.shape], bool)
    every = tiles(mask.shape)

    def share(part: Part) -> FloatArray:
        values = np.asarray(mask[part]) > 0
        rows, columns = (n // BLOCK for n in values.shape)
        values = values[: rows * BLOCK, : columns * BLOCK]
        return np.asarray(values.reshape(rows, BLOCK, columns, BLOCK).mean(axis=(1, 3)))

    for part, found in zip(every, mapped(share, every, workers), strict=True):
        result[blocks_in(part)] = found > 0.5
    return result


def gather(
    looks: Sequence[AmplitudeGrid], centre: float | None, workers: Workers = 1
) -> tuple[list[Blocks], float]:
    """Gather statistics of the blocks of all looks.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; read in slices.
    centre : float or None
        Log cotangent subtracted from the blocks' places; their mean where None.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.

    Returns
    -------
    list of Blocks
    float
        The centre.

    Raises
    ------
    ValueError
        Where no block of any look is known.
    """
    shape = looks[0].amplitude.shape
    lattice = shape[0] // BLOCK, shape[1] // BLOCK
    found = [Blocks(*(np.zeros(lattice) for _ in Blocks._fields)) for _ in looks]
    every = list(product(range(len(looks)), tiles(shape)))

    def read(at: tuple[int, Part]) -> Blocks:
        k, part = at
        rasters = (None if v is None else np.asarray(v[part], np.float32) for v in looks[k])
        return block_statistics(AmplitudeGrid(*rasters), 0.0)

    for (k, part), told in zip(every, mapped(read, every, workers), strict=True):
        for target, values in zip(found[k], told, strict=True):
            target[blocks_in(part)] = values
    if not any((b.known > 0).any() for b in found):
        raise ValueError("expected a block of known amplitudes")
    if centre is None:
        means = [float(b.place[b.known > 0].mean()) for b in found if (b.known > 0).any()]
        centre = float(np.mean(means))
    return [b._replace(place=b.place - centre) for b in found], centre


def pixels_of(flat: Sequence[Flat], blocks: BoolArray) -> FloatArray:
    """Read the amplitudes of pixels in some blocks of all looks; thinned where there are many.

    Parameters
    ----------
    flat : sequence of Flat
    blocks : ndarray of bool (block rows, block columns)

    Returns
    -------
    ndarray (n,)
    """
    where = np.flatnonzero(blocks)
    if where.size > SAMPLED_BLOCKS:
        # at random, since an even step may hit the same columns repeatedly; in the same order in
        # every draw, so that most blocks are in the cache
        order = _order(blocks.size)[where]
        where = np.sort(where[np.argpartition(order, SAMPLED_BLOCKS)[:SAMPLED_BLOCKS]])
    place = np.unravel_index(where, blocks.shape)
    return thinned(np.concatenate([one.blocks(*place) for one in flat], axis=1).ravel())


@lru_cache(maxsize=4)
def _order(blocks: int) -> IntArray:
    """Random order of the blocks of a lattice."""
    return np.random.default_rng(0).permutation(blocks)


def thinned(values: FloatArray) -> FloatArray:
    """Thin the known amplitudes evenly."""
    values = values[np.isfinite(values) & (values > 0)]
    return values[:: max(values.size // SAMPLES, 1)]


def _pixels(row: int, column: int) -> Part:
    """Pixels of a block."""
    return (
        slice(row * BLOCK, (row + 1) * BLOCK),
        slice(column * BLOCK, (column + 1) * BLOCK),
    )


def chosen_tiles(shape: tuple[int, ...], side: int, most: int, labels: IntArray) -> list[Part]:
    """Choose tiles that represent a raster: all, or some at random, with some of each class.

    Parameters
    ----------
    shape : tuple of int
        Pixels.
    side : int
        Side of a tile in pixels; whole blocks.
    most : int
        Maximum number of tiles.
    labels : ndarray of int (block rows, block columns)
        Classes, -1 for none.

    Returns
    -------
    list of tuple of slice
        In the order of the raster.
    """
    every = tiles(shape, side)
    if len(every) <= most:
        return every
    counts = int(labels.max()) + 1
    held = np.array(
        [np.bincount(labels[blocks_in(p)].ravel() + 1, minlength=counts + 1) for p in every]
    )
    order = np.random.default_rng(0).permutation(len(every))
    share = max(most // (2 * max(counts, 1)), 1)
    kept: dict[int, None] = {}
    for k in range(counts):  # tiles that hold most of a class first, but not all from one place
        many = held[order, k + 1] >= 0.5 * held[:, k + 1].max()
        kept |= dict.fromkeys(int(i) for i in order[many][:share])
    kept |= dict.fromkeys(int(i) for i in order)
    return [every[i] for i in sorted(list(kept)[: max(most, counts)])]


def around(part: Part, margin: int, shape: tuple[int, ...]) -> tuple[Part, Part]:
    """Widen a part by a margin, within the raster; also return the part's place in the result."""
    wide = [
        slice(max(s.start - margin, 0), min(s.stop + margin, n))
        for s, n in zip(part, shape, strict=False)
    ]
    inner = [slice(s.start - w.start, s.stop - w.start) for s, w in zip(part, wide, strict=True)]
    return (wide[0], wide[1]), (inner[0], inner[1])


def marked_values(flat: Sequence[Flat], marks: Any, count: int) -> Iterator[tuple[FloatArray, int]]:
    """Yield the amplitudes of each class's marked pixels, thinned, and the number known."""
    values: list[list[FloatArray]] = [[] for _ in range(count)]
    for part in tiles(flat[0].shape):
        here = np.asarray(marks[part])
        for k in np.unique(here[(here > 0) & (here <= count)]):
            for one in flat:
                shown = one[part][here == k]
                values[int(k) - 1].append(shown[np.isfinite(shown) & (shown > 0)])
    for every in values:
        joined = np.concatenate(every) if every else np.empty(0)
        yield thinned(joined), int(joined.size)
