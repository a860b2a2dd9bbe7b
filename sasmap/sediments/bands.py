"""Level that depends on range alone over a whole line, and so may be gain or beam pattern.

The gain is a function of grazing angle (a beam pattern) or of slant range (time-varied gain),
whichever explains more where the altitude changes. Where looks from two sides or ranges see the
same block, its floor is the same in both and the difference is gain. Where only one look sees it,
all variation with range over its line is taken for gain: neighbouring blocks across range differ
by it, except for the few pairs with a boundary between them. Those have negligible weight
(Geman-McClure); with Cauchy weights, a slightly oblique boundary of 1.8 dB went into the gain.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.order import median
from sasmap.sediments.trends import Blocks, Real, log_angle, log_reach, trend_of

Index = IntArray

# Width of a bin in log cotangent (1 % of range, about one block at the far end of a swath of 100
# blocks); minimum mean number of blocks in a bin; maximum number of bins.
WIDTH, HELD, MOST = 0.01, 12, 200
# Maximum distance in blocks between the pairs that determine the gain; approximate maximum number
# of pairs.
LAGS, PAIRS = 3, 300_000
# The same distance where blocks of steep gain in between are left out: the width of two steps.
FAR = 8
# Mean difference in log cotangent above which two looks see blocks differently: 10 % of range.
DIFFERENT = 0.1
# Share of a look's blocks that another look must also see for the two to be compared.
SHARED = 0.3
# Change of log gain from bin to bin (0.9 dB) above which a bin's value says little about a pixel's.
STEEP = 0.1
# Gain by range is preferred where its residual cost is below this share of that of gain by angle.
BETTER = 0.97
# Span of gain by range, in log amplitude, below which it cannot be mistaken for classes (0.4 dB).
SLIGHT = 0.05
# Log gain below the median (14 dB, as for blocks that are not sediment) at which a bin is dropped.
LOWEST = 1.6
# Ridge weight, relative to one pair, that holds gains at 0 where no data constrain them; maximum
# number of reweighting rounds; largest change of a gain at which they stop.
RIDGE, ROUNDS, SETTLED = 1e-3, 30, 1e-5


class Bands(NamedTuple):
    """Log gain by grazing angle or range, of each look.

    Attributes
    ----------
    places : tuple of ndarray
        Log cotangents of the grazing angle, or logs of the slant range, in ascending order.
    gains : tuple of ndarray
        Log gain at each; linear between. NaN where there is no floor: in the water column.
    ranged : bool
        Whether gain depends on slant range rather than on grazing angle.
    """

    places: tuple[FloatArray, ...]
    gains: tuple[FloatArray, ...]
    ranged: bool = False

    @property
    def span(self) -> float:
        """Largest span (maximum less minimum) of a look's log gain."""
        return max(float(np.nanmax(g) - np.nanmin(g)) for g in self.gains)

    def of(
        self, look: int, cotangent: NDArray[Real], altitude: NDArray[Real] | None = None
    ) -> NDArray[Real]:
        """Log gain of a look at grazing angles, and at altitudes where gain depends on range.

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
            Where gain depends on range and no altitude is given.
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
        """Position of blocks in log range or log cotangent."""
        return blocks.reach if self.ranged else blocks.angle

    def _at(self, look: int, place: NDArray[Real]) -> NDArray[Real]:
        gain = np.interp(place, self.places[look], self.gains[look])
        return np.asarray(gain, place.dtype)


def steep(bands: Bands, blocks: Sequence[Blocks]) -> BoolArray:
    """Find blocks of any look within which gain changes too much to be subtracted from pixels.

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
    values: Iterable[FloatArray], known: BoolArray, block: Blocks, bands: Bands
) -> list[FloatArray]:
    """Remove the dependence on angle or range from other statistics of a look's blocks.

    Signal-to-noise ratio and resolution vary with range: where gain does, they may as well.

    Parameters
    ----------
    values : iterable of ndarray (block rows, block columns)
    known : ndarray of bool (block rows, block columns)
    block : Blocks
        Of the look.
    bands : Bands
        Decides between angle and range.

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
    """Remove bands from the blocks of all looks: from their level and from its variance.

    Parameters
    ----------
    blocks : sequence of Blocks
        Of each look.
    bands : Bands

    Returns
    -------
    list of Blocks
        Blocks in the water column are unknown.
    """
    return [_leveled(block, bands, look) for look, block in enumerate(blocks)]


def _leveled(block: Blocks, bands: Bands, look: int) -> Blocks:
    """Remove bands from a look's blocks."""
    spread = np.log(np.maximum(block.variance, 1e-6))
    (spread,) = evened([spread], block.known > 0, block, bands)
    gain = bands.of_block(look, block)
    there = np.isfinite(gain)
    mean = np.where(there, block.mean - gain, 0.0)
    return block._replace(mean=mean, variance=np.exp(spread), known=block.known * there)


def find_bands(blocks: Sequence[Blocks], trends: FloatArray) -> Bands:
    """Find the part of each look's level that depends on range, beyond its trend.

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
        # one sonar has one gain by range: the floor is common to two looks of a block
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
    """Find for each look those that see much of the same floor from another side or range."""
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
    """Return the mean position of range bins, and the bin of each block."""
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


def _across(bins: Index, level: FloatArray, known: BoolArray) -> tuple[Index, Index, FloatArray]:
    """Return the bins of pairs of near blocks in different bins, and their level differences."""
    one, other = _pairs(bins, known, LAGS)
    bins, level = bins.ravel(), level.ravel()
    return bins[one], bins[other], level[one] - level[other]


def _pairs(bins: Index, known: BoolArray, lags: int) -> tuple[Index, Index]:
    """Return flat indices of blocks, and of near blocks before them that lie in other bins."""
    number = np.arange(bins.size).reshape(bins.shape)
    one, other = [], []
    for axis in (0, 1):
        b, n, k = (np.moveaxis(v, axis, 0) for v in (bins, number, known))
        for lag in range(1, lags + 1):
            both = np.flatnonzero(k[lag:] & k[:-lag] & (b[lag:] != b[:-lag]))
            # an odd step reaches all columns
            both = both[:: max(both.size * 2 * lags // PAIRS, 1) | 1]
            one.append(n[lag:].ravel()[both])
            other.append(n[:-lag].ravel()[both])
    return np.concatenate(one), np.concatenate(other)


def _solved(first: Index, second: Index, change: FloatArray, count: int) -> FloatArray:
    """Solve robustly for the zero-mean gains of bins that explain differences (first - second)."""
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
    # a gain this low is the water column, not a beam pattern
    return np.where(gain < np.median(gain) - LOWEST, np.nan, gain)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rest(first, second, change, gain):  # type: ignore[no-untyped-def]
    """Subtract gains from differences."""
    rest = np.empty(change.size)
    for i in range(change.size):
        rest[i] = change[i] - gain[first[i]] + gain[second[i]]
    return rest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weighed(first, second, change, gain, scale):  # type: ignore[no-untyped-def]
    """Sum the weights of each pair of bins, and the weighted differences in each bin."""
    joined, right = np.zeros((gain.size, gain.size)), np.zeros(gain.size)
    for i in range(change.size):
        a, b = first[i], second[i]
        rest = (change[i] - gain[a] + gain[b]) / scale
        weight = 1 / (1 + rest * rest) ** 2
        joined[a, b] += weight
        right[a] += weight * change[i]
        right[b] -= weight * change[i]
    return joined, right
