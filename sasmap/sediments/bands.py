"""What of the level follows range over a whole line, and so may be gain or beam pattern.

A gain of grazing angle (a beam pattern) or of slant range (time-varied gain) alone, whichever
explains more where the altitude changes, is fitted to what it can be told by. Where looks from two
sides or ranges see
one block, the floor is the same in both and the difference is gain. Where one look alone does, all
that follows range over its line is taken for gain: neighbouring blocks across range differ by it,
but for those few between which a boundary runs. Those count for next to nothing (Geman-McClure
weights): with Cauchy's, a slightly oblique boundary of 1.8 dB went into the gain.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.numerics.order import median
from sasmap.sediments.trends import Blocks, Real, log_angle, log_reach, trend_of

FloatArray = NDArray[np.float64]
Index = NDArray[np.int64]

# Log cotangents of a bin: 1 % of range, about a block at the far end of a swath of 100 blocks; and
# blocks that a bin holds on average, at least; bins, at most.
WIDTH, HELD, MOST = 0.01, 12, 200
# Blocks apart, at most, of pairs that tell the gain; and pairs, about, at most.
LAGS, PAIRS = 3, 300_000
# The same where blocks of steep gain are left out in between: as wide as two steps of it are.
FAR = 8
# Mean difference in log cotangent from which two looks see a block differently: 10 % of range.
DIFFERENT = 0.1
# Share of a look's blocks that another look must see as well to be told by.
SHARED = 0.3
# Change of log gain from bin to bin (0.9 dB) from which its middle says little of a pixel's.
STEEP = 0.1
# Share of what gain by angle leaves unexplained that gain by range must not exceed to be preferred.
BETTER = 0.97
# Gain by range that makes no classes: log amplitude from the least to the greatest (0.4 dB).
SLIGHT = 0.05
# Log gain under its median (14 dB, as of blocks that are no sediment) that a bin has at least.
LOWEST = 1.6
# Weight that holds gains at 0 where nothing tells them, of that of one pair; rounds of reweighting,
# at most, and change of any gain that ends them.
RIDGE, ROUNDS, SETTLED = 1e-3, 30, 1e-5


class Bands(NamedTuple):
    """Log gain by grazing angle or range, of each look.

    Attributes
    ----------
    places : tuple of ndarray
        Rising log cotangents of the grazing angle, or logs of the slant range.
    gains : tuple of ndarray
        Log gain at each; linear between. NaN where there is no floor: in the water column.
    ranged : bool
        Whether it goes by slant range.
    """

    places: tuple[FloatArray, ...]
    gains: tuple[FloatArray, ...]
    ranged: bool = False

    @property
    def span(self) -> float:
        """Log gain from the least to the greatest of a look."""
        return max(float(np.nanmax(g) - np.nanmin(g)) for g in self.gains)

    def of(
        self, look: int, cotangent: NDArray[Real], altitude: NDArray[Real] | None = None
    ) -> NDArray[Real]:
        """Log gain of a look at grazing angles, and altitudes where it goes by range.

        Parameters
        ----------
        look : int
        cotangent : ndarray
        altitude : ndarray, optional
            m.

        Returns
        -------
        ndarray

        Raises
        ------
        ValueError
            Where gain goes by range and no altitude is given.
        """
        if not self.ranged:
            return self._at(look, log_angle(cotangent))
        if altitude is None:
            raise ValueError("gain by range: expected altitudes")
        return self._at(look, log_reach(cotangent, np.asarray(altitude, cotangent.dtype)))

    def of_block(self, look: int, blocks: Blocks) -> FloatArray:
        """Log gain of a look at its blocks."""
        return self._at(look, self.place(blocks))

    def place(self, blocks: Blocks) -> FloatArray:
        """Where blocks are."""
        return blocks.reach if self.ranged else blocks.angle

    def _at(self, look: int, place: NDArray[Real]) -> NDArray[Real]:
        gain = np.interp(place, self.places[look], self.gains[look])
        return np.asarray(gain, place.dtype)


def steep(bands: Bands, blocks: Sequence[Blocks]) -> NDArray[np.bool_]:
    """Find blocks of any look within which the gain changes too much to be taken off pixels.

    Parameters
    ----------
    bands : Bands
    blocks : sequence of Blocks

    Returns
    -------
    ndarray of bool (block rows, block columns)
    """
    result = np.zeros(blocks[0].mean.shape, bool)
    for block, place, gain in zip(blocks, bands.places, bands.gains, strict=True):
        jump = np.abs(np.diff(gain))
        most = np.maximum(np.append(jump, 0.0), np.append(0.0, jump))
        result |= (block.known > 0) & (np.interp(bands.place(block), place, most) > STEEP)
    return result


def evened(
    values: Iterable[FloatArray], known: NDArray[np.bool_], block: Blocks, bands: Bands
) -> list[FloatArray]:
    """Take what follows angle, or range, off other statistics of a look's blocks.

    Noise lies under the floor by range, and resolution goes with it: where gain does, so may they.

    Parameters
    ----------
    values : iterable of ndarray (block rows, block columns)
    known : ndarray of bool (block rows, block columns)
    block : Blocks
        Of the look.
    bands : Bands
        Whether by angle or range.

    Returns
    -------
    list of ndarray (block rows, block columns)
    """
    if not known.any():
        return list(values)
    place = bands.place(block)
    at, (bins,) = _binned([block._replace(place=place, known=known.astype(float))])
    one, other = _pairs(bins, known, FAR)
    first, second = bins.ravel()[one], bins.ravel()[other]
    found = []
    for each in values:
        flat = each.ravel()
        gain = np.nan_to_num(_solved(first, second, flat[one] - flat[other], at.size))
        found.append(each - np.interp(place, at, gain))
    return found


def leveled(blocks: Sequence[Blocks], bands: Bands) -> list[Blocks]:
    """Take bands off the blocks of all looks, off their level and off how it scatters.

    Parameters
    ----------
    blocks : sequence of Blocks
        Of each look.
    bands : Bands

    Returns
    -------
    list of Blocks
        In the water column nothing is known.
    """
    return [_leveled(block, bands, look) for look, block in enumerate(blocks)]


def _leveled(block: Blocks, bands: Bands, look: int) -> Blocks:
    """Take bands off a look's blocks."""
    spread = np.log(np.maximum(block.variance, 1e-6))
    (spread,) = evened([spread], block.known > 0, block, bands)
    gain = bands.of_block(look, block)
    there = np.isfinite(gain)
    mean = np.where(there, block.mean - gain, 0.0)
    return block._replace(mean=mean, variance=np.exp(spread), known=block.known * there)


def find_bands(blocks: Sequence[Blocks], trends: FloatArray) -> Bands:
    """Find what of each look's level follows range, beyond its trend.

    Parameters
    ----------
    blocks : sequence of Blocks
    trends : ndarray (looks, 3)

    Returns
    -------
    Bands
    """
    levels = [b.mean - trend_of(t, b.place) for b, t in zip(blocks, trends, strict=True)]
    found = _fitted(blocks, levels, False)
    if all((b.reach[b.known > 0] != 0).all() for b in blocks):
        ranged = _fitted(blocks, levels, True)
        rest = [_left(blocks, levels, bands) for bands in (found, ranged)]
        scale = 1.5 * np.median(np.abs(rest[0])) + 1e-9 if rest[0].size else 1.0
        cost = [float(np.mean(v**2 / (v**2 + scale**2))) if v.size else 0.0 for v in rest]
        if cost[1] < BETTER * cost[0]:
            return ranged
    return found


def _left(blocks: Sequence[Blocks], levels: Sequence[FloatArray], bands: Bands) -> FloatArray:
    """Differences of near blocks that gain does not explain."""
    found = []
    for k, (block, level) in enumerate(zip(blocks, levels, strict=True)):
        number = np.arange(level.size).reshape(level.shape)
        flat = level - bands.of_block(k, block)
        found.append(_across(number, flat, (block.known > 0) & np.isfinite(flat))[2])
    return np.concatenate(found)


def _fitted(blocks: Sequence[Blocks], levels: Sequence[FloatArray], ranged: bool) -> Bands:
    """Fit gain by angle, or by range."""
    blocks = [b._replace(place=b.reach if ranged else b.angle) for b in blocks]
    partners = _partners(blocks)
    alone = [k for k in range(len(blocks)) if not partners[k]]
    places, gains = [np.zeros(1)] * len(blocks), [np.zeros(1)] * len(blocks)
    for k in alone:
        at, bins = _binned([blocks[k]])
        pairs = _across(bins[0], levels[k], blocks[k].known > 0)
        places[k], gains[k] = at, _solved(*pairs, at.size)
    rest = [k for k in range(len(blocks)) if partners[k]]
    if rest:
        # one sonar, one gain of range: what two looks have in common at one place is the floor
        at, bins = _binned([blocks[k] for k in rest])
        first: list[Index] = []
        second: list[Index] = []
        change: list[FloatArray] = []
        for i, k in enumerate(rest):
            for j in (rest.index(p) for p in partners[k] if p < k):
                both = (blocks[k].known > 0) & (blocks[rest[j]].known > 0)
                away = (levels[k] - levels[rest[j]])[both]
                first.append(bins[i][both])
                second.append(bins[j][both])
                change.append(away - np.median(away))
        found = _solved(
            np.concatenate(first), np.concatenate(second), np.concatenate(change), at.size
        )
        for k in rest:
            places[k], gains[k] = at, found
    return Bands(tuple(places), tuple(gains), ranged)


def _partners(blocks: Sequence[Blocks]) -> list[list[int]]:
    """Find for each look those that see much of the same from elsewhere."""
    result: list[list[int]] = [[] for _ in blocks]
    for k, one in enumerate(blocks):
        for j in range(k):
            other = blocks[j]
            both = (one.known > 0) & (other.known > 0)
            least = SHARED * min((one.known > 0).sum(), (other.known > 0).sum())
            if both.sum() <= max(least, 1):
                continue
            if np.abs(one.place - other.place)[both].mean() > DIFFERENT:
                result[k].append(j)
                result[j].append(k)
    return result


def _binned(blocks: Sequence[Blocks]) -> tuple[FloatArray, list[Index]]:
    """Mean place of bins of range, and the bin of each block."""
    seen = np.concatenate([b.place[b.known > 0] for b in blocks])
    if not seen.size:
        return np.zeros(1), [np.zeros(b.place.shape, np.int64) for b in blocks]
    count = int(np.clip(min(np.ptp(seen) / WIDTH, seen.size / HELD), 1, MOST))
    edges = np.unique(np.quantile(seen, np.arange(1, count) / count))
    bins = [np.searchsorted(edges, b.place, side="right") for b in blocks]
    every = np.searchsorted(edges, seen, side="right")
    held = np.bincount(every, minlength=edges.size + 1)
    kept = np.flatnonzero(held)
    number = np.searchsorted(kept, np.arange(edges.size + 1)).clip(max=kept.size - 1)
    place = np.bincount(every, seen, minlength=edges.size + 1)[kept] / held[kept]
    return place, [number[b] for b in bins]


def _across(
    bins: Index, level: FloatArray, known: NDArray[np.bool_]
) -> tuple[Index, Index, FloatArray]:
    """Bins of near blocks of unlike range, and by how much their levels differ."""
    one, other = _pairs(bins, known, LAGS)
    bins, level = bins.ravel(), level.ravel()
    return bins[one], bins[other], level[one] - level[other]


def _pairs(bins: Index, known: NDArray[np.bool_], lags: int) -> tuple[Index, Index]:
    """Places of near blocks of unlike range, and of their neighbours before them."""
    number = np.arange(bins.size).reshape(bins.shape)
    one, other = [], []
    for axis in (0, 1):
        b, n, k = (np.moveaxis(v, axis, 0) for v in (bins, number, known))
        for lag in range(1, lags + 1):
            both = np.flatnonzero(k[lag:] & k[:-lag] & (b[lag:] != b[:-lag]))
            # an odd step meets all columns
            both = both[:: max(both.size * 2 * lags // PAIRS, 1) | 1]
            one.append(n[lag:].ravel()[both])
            other.append(n[:-lag].ravel()[both])
    return np.concatenate(one), np.concatenate(other)


def _solved(first: Index, second: Index, change: FloatArray, count: int) -> FloatArray:
    """Gains of bins that explain differences (first less second), robustly; about 0."""
    gain = np.zeros(count)
    if change.size < 2 * count:
        return gain
    for _ in range(ROUNDS):
        before = gain
        scale = 1.5 * median(np.abs(_rest(first, second, change, gain))) + 1e-9
        joined, right = _weighed(first, second, change, gain, scale)
        joined += joined.T
        matrix = np.diag(joined.sum(axis=1) + RIDGE) - joined
        gain = np.linalg.solve(matrix, right)
        if np.abs(gain - before).max() < SETTLED:
            break
    gain -= gain.mean()
    # so far below it is the water column, not a beam pattern
    return np.where(gain < np.median(gain) - LOWEST, np.nan, gain)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rest(first, second, change, gain):  # type: ignore[no-untyped-def]
    """Take gains off differences."""
    rest = np.empty(change.size)
    for i in range(change.size):
        rest[i] = change[i] - gain[first[i]] + gain[second[i]]
    return rest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weighed(first, second, change, gain, scale):  # type: ignore[no-untyped-def]
    """Weights of pairs of bins, and what their differences add up to in each bin."""
    joined, right = np.zeros((gain.size, gain.size)), np.zeros(gain.size)
    for i in range(change.size):
        a, b = first[i], second[i]
        rest = (change[i] - gain[a] + gain[b]) / scale
        weight = 1 / (1 + rest * rest) ** 2
        joined[a, b] += weight
        right[a] += weight * change[i]
        right[b] -= weight * change[i]
    return joined, right
