"""Gain and trend over grazing angle of each look, by blocks of pixels.

A single look cannot separate such a trend from a boundary that runs along the track; looks from two
sides, or ranges, can.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.order import median

Real = TypeVar("Real", bound=np.floating[Any])

BLOCK = 16
# Minimum cotangent of a grazing angle that is resolved: 3 degrees off the vertical.
STEEPEST = 0.05
# Step in pixels, each way, of those from which a block's position is averaged.
THINNED = 4
# Minimum share of a block's pixels that are known.
MIN_KNOWN = 0.6
# Maximum distance in blocks of the pairs that determine the trend.
LAGS = 4
# Maximum number of such pairs in one direction and distance (evenly thinned).
PAIRS = 100_000
# Maximum rounds of reweighting, and change of slope and bend at which they stop.
ROUNDS, SETTLED = 30, 1e-5
# Standard deviations of slope and bend within classes about those first estimates.
SLOPE_SD = (0.12, 0.3)


class AmplitudeGrid(NamedTuple):
    """Amplitude and geometry of one look, on the map's lattice.

    Attributes
    ----------
    amplitude : array (rows, columns)
        NaN where there is none, or no sediment (shadow, water column). Read in slices where stated.
    cotangent : array (rows, columns)
        Of the grazing angle: ground range over altitude.
    altitude : array (rows, columns) or None
        Altitude of the sonar above the floor, m, where it is known.
    """

    amplitude: Any
    cotangent: Any
    altitude: Any = None


class Blocks(NamedTuple):
    """Statistics of blocks of one look (block rows, block columns).

    Attributes
    ----------
    mean, variance : ndarray
        Of the log amplitude.
    known : ndarray
        Number of known pixels.
    place : ndarray
        Log cotangent of the grazing angle about a centre, constant where there is no trend.
    angle, reach : ndarray
        Log cotangent, also of steep angles, and log slant range (0 where it is not known).
    """

    mean: FloatArray
    variance: FloatArray
    known: FloatArray
    place: FloatArray
    angle: FloatArray
    reach: FloatArray


def log_cotangent(cotangent: NDArray[Real]) -> NDArray[Real]:
    """Log of a grazing angle's cotangent, 0 for angles steeper than 45 degrees (no trend)."""
    return np.asarray(np.log(np.maximum(cotangent, 1.0)))


def log_angle(cotangent: NDArray[Real]) -> NDArray[Real]:
    """Log of a grazing angle's cotangent, also beneath the sonar."""
    return np.asarray(np.log(np.maximum(cotangent, STEEPEST)))


def log_reach(cotangent: NDArray[Real], altitude: NDArray[Real]) -> NDArray[Real]:
    """Log of the slant range, m."""
    return np.asarray(np.log(np.maximum(altitude, 1e-3)) + 0.5 * np.log1p(np.square(cotangent)))


def block_statistics(look: AmplitudeGrid, centre: float) -> Blocks:
    """Gather log amplitudes by blocks, and log cotangents about a centre."""
    amplitude = look.amplitude
    rows, columns = (n // BLOCK * BLOCK for n in amplitude.shape)
    shape = (rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    known = np.isfinite(amplitude) & (amplitude > 0)
    logs = np.log(np.where(known, amplitude, 1.0))[:rows, :columns].reshape(shape)
    there = known[:rows, :columns].reshape(shape)
    count = _summed(there)
    total = np.maximum(count, 1)
    mean = _summed(logs * there) / total
    rest = logs - mean[:, None, :, None].astype(logs.dtype)
    variance = _summed(rest * rest * there) / total
    enough = count >= MIN_KNOWN * BLOCK**2
    return Blocks(mean, variance, np.where(enough, count, 0.0), *_places(look, known, centre))


def _places(look: AmplitudeGrid, known: BoolArray, centre: float) -> list[FloatArray]:
    """Place, angle and reach of blocks; they vary so slowly that few pixels suffice."""
    rows, columns = (n // BLOCK * BLOCK for n in known.shape)
    some = slice(THINNED // 2, rows, THINNED), slice(THINNED // 2, columns, THINNED)
    side = BLOCK // THINNED
    shape = rows // BLOCK, side, columns // BLOCK, side
    there = known[some].reshape(shape)
    there = there | ~there.any(axis=(1, 3), keepdims=True)
    cotangent = np.nan_to_num(np.asarray(look.cotangent[some], float), nan=1.0)
    places = [log_cotangent(cotangent) - centre, log_angle(cotangent)]
    if look.altitude is not None:
        altitude = np.nan_to_num(np.asarray(look.altitude[some], float), nan=1.0)
        places.append(log_reach(cotangent, altitude))
    means = [_summed(v.reshape(shape) * there) / _summed(there) for v in places]
    return means if look.altitude is not None else [*means, np.zeros(means[0].shape)]


def _summed(values: NDArray[Any]) -> FloatArray:
    """Sum over the pixels of blocks (block rows, their rows, block columns, their columns)."""
    down = values.sum(axis=1, dtype=None if values.dtype != bool else np.float64)
    return np.asarray(down.sum(axis=2, dtype=float))


def first_trends(blocks: list[Blocks]) -> FloatArray:
    """Fit slope and bend of each look from its neighbouring blocks, gain from overlapping looks."""
    trends = np.zeros((len(blocks), 3))
    for k, block in enumerate(blocks):
        trends[k, 1:] = _slope(block)
        for j in range(k):
            gain = gain_over(block, trends[k], blocks[j], trends[j])
            if gain is not None:
                trends[k, 0] = gain
                break
    return trends


def gain_over(block: Blocks, trend: FloatArray, other: Blocks, known: FloatArray) -> float | None:
    """Find a look's gain from the floor that another look shows as well.

    Parameters
    ----------
    block : Blocks
    trend : ndarray (3,)
        Gain (any), slope and bend.
    other : Blocks
        Of the other look.
    known : ndarray (3,)
        Gain, slope and bend of that one.

    Returns
    -------
    float or None
        None where they show no block in common.
    """
    both = (block.known > 0) & (other.known > 0)
    if not both.any():
        return None
    level = block.mean - trend_of(trend * (0.0, 1.0, 1.0), block.place)
    return float(np.median(level[both] - (other.mean - trend_of(known, other.place))[both]))


def _slope(block: Blocks) -> FloatArray:
    """Fit slope and bend of log amplitude over log cotangent to differences of near blocks.

    In most such pairs both blocks hold the same sediment; the others have large residuals and
    little weight (Cauchy weights).
    """
    change, step, bend = [], [], []
    for axis in (0, 1):
        for lag in range(1, LAGS + 1):
            first = [np.moveaxis(v, axis, 0)[lag:] for v in block]
            second = [np.moveaxis(v, axis, 0)[:-lag] for v in block]
            both = (first[2] > 0) & (second[2] > 0)
            every = slice(None, None, max(int(both.sum()) // PAIRS, 1) | 1)
            change.append((first[0] - second[0])[both][every])
            step.append((first[3] - second[3])[both][every])
            bend.append((first[3] ** 2 - second[3] ** 2)[both][every])
    y, ahead, bent = (np.concatenate(v) for v in (change, step, bend))
    if y.size < 20:
        return np.zeros(2)
    # start from no trend: the least-squares fit is affected by edges and objects
    found: FloatArray = np.zeros(2)
    for _ in range(ROUNDS):
        before = found
        scale = 1.5 * median(np.abs(y - found[0] * ahead - found[1] * bent)) + 1e-9
        matrix, right = _weighed(y, ahead, bent, found, scale)
        # unconstrained parameters stay at 0
        matrix += np.diag([1e-4, 1e-3])
        found = np.asarray(np.linalg.solve(matrix, right), np.float64)
        if np.abs(found - before).max() < SETTLED:
            break
    return np.asarray(found)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weighed(y, step, bend, trend, scale):  # type: ignore[no-untyped-def]
    """Sum the normal equations of slope and bend, each difference with its Cauchy weight."""
    matrix, right = np.zeros((2, 2)), np.zeros(2)
    for i in range(y.size):
        rest = (y[i] - trend[0] * step[i] - trend[1] * bend[i]) / scale
        weight = 1 / (1 + rest * rest)
        matrix[0, 0] += weight * step[i] * step[i]
        matrix[0, 1] += weight * step[i] * bend[i]
        matrix[1, 1] += weight * bend[i] * bend[i]
        right[0] += weight * step[i] * y[i]
        right[1] += weight * bend[i] * y[i]
    matrix[1, 0] = matrix[0, 1]
    return matrix, right


def trend_of(trend: FloatArray, place: NDArray[Real]) -> NDArray[Real]:
    """Log amplitude for a gain, slope and bend at log cotangents about the centre."""
    gain, slope, bend = (float(v) for v in trend)  # the result keeps the precision of `place`
    return np.asarray(gain + slope * place + bend * place * place)


def refit(
    blocks: list[Blocks],
    groups: IntArray,
    index: tuple[IntArray, ...],
    first: FloatArray,
    means: FloatArray | None = None,
    gain_sd: float = 1e-6,
) -> FloatArray:
    """Fit gain, slope and bend of each look to its blocks' deviations from their classes.

    A prior keeps slopes near the first ones, which do not depend on classes.

    Parameters
    ----------
    blocks : list of Blocks
    groups : ndarray of int
        Class of each block of `index`, or of each block of the lattice.
    index : tuple of ndarray
        Rows and columns of the blocks that are used.
    first : ndarray (looks, 3)
    means : ndarray (classes,), optional
        Mean log amplitude of each class; fitted as well where not given.
    gain_sd : float
        Standard deviation of the first look's gain, which is otherwise fixed as the survey's.

    Returns
    -------
    ndarray (looks, 3)
    """
    groups = groups[index] if groups.ndim == 2 else groups
    count, size = int(groups.max()) + 1, 3 * len(blocks)
    design, wanted, weight = [], [], []
    for k, block in enumerate(blocks):
        there = block.known[index] > 0
        place = block.place[index][there]
        columns = np.zeros((place.size, size + count))
        columns[:, 3 * k : 3 * k + 3] = np.column_stack([np.ones(place.size), place, place**2])
        columns[np.arange(place.size), size + groups[there]] = 1
        design.append(columns)
        wanted.append(block.mean[index][there])
        error = np.sqrt(block.variance[index][there] / block.known[index][there])
        weight.append(1 / np.hypot(error, 0.03))
    stiff = np.zeros((size, size + count))
    sd = np.tile([10.0, *SLOPE_SD], len(blocks))
    sd[0] = gain_sd
    stiff[:, :size] = np.diag(1 / sd)
    w = np.concatenate(weight)
    matrix = np.vstack([np.vstack(design) * w[:, None], stiff])
    right = np.concatenate([np.concatenate(wanted) * w, first.ravel() / sd])
    if means is not None:
        right -= matrix[:, size:] @ means[:count]
        matrix = matrix[:, :size]
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return np.asarray(found[:size].reshape(-1, 3))
