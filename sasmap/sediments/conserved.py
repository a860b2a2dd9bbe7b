"""Mean of a rippled bed's amplitude that its relief does not change, by the scattering law.

Under Lambert's law amplitude is proportional to the sine of the local grazing angle, and so to the
projected area of a facet: the mean over a wavelength equals that of flat floor, with or without
shadow. Where amplitude goes as a power m of the sine, the mean of amplitude to the power 1/m is
conserved: for m below 1 bright facets have more weight, in the limit the brightest alone (floor
equally bright at any angle except in shadow), for m above 1 less. With the wrong m a bed's level
changes with the amount of shadow: from near to far range, and at its edge. With the right one,
blocks of a bed agree with each other and with the same floor without ripples beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sasmap.arrays import BoolArray, FloatArray
from sasmap.sediments.trends import BLOCK, log_cotangent

# Powers of the sine that are tried. Amplitude of sand goes with powers of 0.5 to 2 over most angles
# (APL-UW TR 9407); a power near 0 is floor of the same amplitude at all angles.
POWERS = (0.1, 0.25, 0.35, 0.5, 0.7, 1.0, 1.35, 1.8, 2.5)
LAMBERT = POWERS.index(1.0)
# Sampling step in pixels; pixels over which powers are averaged (standard deviation: half of the
# longest wave that is removed); margin in pixels that influences a place.
STEP, AVERAGED, MARGIN = 4, 64, 256
# Distances in blocks between the pairs that determine the power (nearer blocks differ by their
# place on a ripple); maximum number of pairs for one direction and distance; minimum range over the
# powers of a useful pair's correction (log amplitude), and minimum number of useful pairs.
LAGS, PAIRS, DIFFER, FEWEST = (4, 8, 16), 20_000, 0.03, 200
# Minimum share of blocks that are free of ripples. Within one bed that fills a survey, power and
# gain by range cannot be separated, and that gain is removed anyway.
LEVEL = 0.1
# Another power is preferred where its cost is below this share of that under Lambert's law. On
# simulated beds beside flat floor, the best power has 0.92 to 0.99 of it under a Gaussian law, and
# 0.9999 under Lambert's.
BETTER = 0.998
ROUNDS = 10


class Bed(NamedTuple):
    """Blocks of a look.

    Attributes
    ----------
    level : ndarray (block rows, block columns)
        Mean log amplitude with ripples removed; NaN where there is none.
    place : ndarray (block rows, block columns)
        Log cotangent of the grazing angle.
    change : ndarray (powers, block rows, block columns)
        Change of the level of rippled floor under each power, relative to Lambert's.
    share : ndarray (block rows, block columns)
        Rippled share of each block.
    """

    level: FloatArray
    place: FloatArray
    change: FloatArray
    share: FloatArray

    @classmethod
    def nowhere(cls, rows: int, columns: int) -> Bed:
        """Return blocks without data."""
        nothing, change = (
            np.zeros((rows, columns)),
            np.zeros((len(POWERS), rows, columns)),
        )
        return cls(np.full((rows, columns), np.nan), nothing, change, nothing.copy())

    def at(self, rows: slice, columns: slice) -> Bed:
        """Return some of the blocks."""
        return Bed(*(v[..., rows, columns] for v in self))

    def put(self, rows: slice, columns: slice, part: Bed) -> None:
        """Fill in some of the blocks."""
        pairs: Iterable[tuple[FloatArray, FloatArray]] = zip(self, part, strict=True)
        for target, values in pairs:
            target[..., rows, columns] = values


def bed_of(
    amplitude: NDArray[np.floating],
    cotangent: NDArray[np.floating],
    profile: NDArray[np.floating],
    rippled: BoolArray,
) -> Bed:
    """Describe the whole blocks of an image.

    Parameters
    ----------
    amplitude : ndarray (rows, columns)
        As recorded; not above 0, or NaN, where there is none.
    cotangent : ndarray (rows, columns)
        Of the grazing angle.
    profile : ndarray (rows, columns)
        Log of the amplitude profile of ripples, whose mean is 1; 0 where there are none.
    rippled : ndarray of bool (rows, columns)

    Returns
    -------
    Bed
    """
    rows, columns = (n // BLOCK * BLOCK for n in amplitude.shape)
    some = slice(STEP // 2, rows, STEP), slice(STEP // 2, columns, STEP)
    values, logs = np.asarray(amplitude[some], float), np.asarray(profile[some], np.float32)
    known = values > 0
    level = np.log(np.where(known, values, 1.0)) - logs.astype(float)
    total = _blocks(known)
    mean = _blocks(np.where(known, level, 0.0)) / np.maximum(total, 1)
    place = log_cotangent(np.nan_to_num(np.asarray(cotangent[some], float), nan=1.0))
    change = np.zeros((len(POWERS), *total.shape))
    there = np.asarray(rippled[some], bool)
    if there.any():
        change = _changes(logs, there)
    side = (BLOCK // STEP) ** 2
    level = np.asarray(np.where(total >= 0.5 * side, mean, np.nan), np.float64)
    return Bed(level, _blocks(place) / side, change, _blocks(there) / side)


def _changes(logs: NDArray[np.float32], there: BoolArray) -> FloatArray:
    """Compute log power means relative to the plain mean, by blocks.

    A block's mean stands for its pixels, since the averages are four blocks wide.
    """
    width = AVERAGED / BLOCK
    many = _blocks(there)
    share = np.maximum(gaussian_filter(many, width, mode="nearest"), 1e-3)
    found = []
    for power in POWERS:
        raised = _blocks(np.where(there, np.exp(logs / np.float32(power)), np.float32(0)))
        mean = gaussian_filter(raised, width, mode="nearest") / share
        found.append(power * np.log(np.maximum(mean, 1e-20)))
    return np.where(many > 0, np.stack(found) - found[LAMBERT], 0.0)


def _blocks(values: NDArray[Any]) -> FloatArray:
    side = BLOCK // STEP
    rows, columns = (n // side for n in values.shape)
    parts = values.reshape(rows, side, columns, side)
    return np.asarray(parts.sum(axis=(1, 3), dtype=float))


def power_of(beds: Sequence[Bed]) -> int:
    """Find the power under which near blocks of all looks agree best.

    Parameters
    ----------
    beds : sequence of Bed
        Of each look.

    Returns
    -------
    int
        Index in ``POWERS``: Lambert's where no other is clearly better.
    """
    known = np.concatenate([np.isfinite(bed.level).ravel() for bed in beds])
    flat = np.concatenate([bed.share.ravel() == 0 for bed in beds])
    if flat[known].sum() < LEVEL * known.sum():
        return LAMBERT
    pairs = [_pairs(bed) for bed in beds]
    apart = sum(int((np.ptp(p[1], axis=0) > DIFFER).sum()) for p in pairs)
    if apart < FEWEST:
        return LAMBERT
    cost = np.array([sum(_cost(p, k) for p in pairs) for k in range(len(POWERS))])
    best = int(np.argmin(cost))
    return best if cost[best] < BETTER * cost[LAMBERT] else LAMBERT


def _pairs(bed: Bed) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences of near blocks: level (n,), change (powers, n), place and its square (n, 2)."""
    level, change, step = [], [], []
    for axis in (0, 1):
        v, p = np.moveaxis(bed.level, axis, 0), np.moveaxis(bed.place, axis, 0)
        c = np.moveaxis(bed.change * bed.share, axis + 1, 1)
        for lag in LAGS:
            both = np.flatnonzero(np.isfinite(v[lag:]) & np.isfinite(v[:-lag]))
            both = both[:: max(both.size // PAIRS, 1) | 1]
            level.append((v[lag:] - v[:-lag]).ravel()[both])
            away = (c[:, lag:] - c[:, :-lag]).reshape(len(c), -1)
            change.append(away[:, both])
            linear, square = (p[lag:] - p[:-lag]), (p[lag:] ** 2 - p[:-lag] ** 2)
            step.append(np.column_stack([linear.ravel()[both], square.ravel()[both]]))
    return np.concatenate(level), np.concatenate(change, axis=1), np.concatenate(step)


def _cost(pairs: tuple[FloatArray, FloatArray, FloatArray], power: int) -> float:
    """Robust misfit (Geman-McClure) of a power, with the best-fitting trend over range."""
    level, change, step = pairs
    if not level.size:
        return 0.0
    # one scale for all powers
    scale = 1.5 * float(np.median(np.abs(level))) + 1e-9
    wanted = level + change[power]
    trend: FloatArray = np.zeros(2)
    for _ in range(ROUNDS):
        weight = 1 / (1 + ((wanted - step @ trend) / scale) ** 2) ** 2
        heavy = step * weight[:, None]
        matrix = heavy.T @ step + np.diag([1e-4, 1e-3])
        trend = np.asarray(np.linalg.solve(matrix, heavy.T @ wanted), np.float64)
    square = ((wanted - step @ trend) / scale) ** 2
    return float((square / (1 + square)).sum())
