"""Gain and trend over grazing angle of each look, by blocks of pixels.

Such a trend and a boundary that runs along the track look alike to a single look; looks from
two sides, or ranges, tell them apart.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.numerics.order import median

FloatArray = NDArray[np.float64]
Real = TypeVar("Real", bound=np.floating[Any])

BLOCK = 16
# Least cotangent of a grazing angle that is told apart: 3 degrees off the vertical.
STEEPEST = 0.05
# Pixels apart, each way, of those that tell where a block is.
THINNED = 4
# Of a block's pixels, how many must be known.
MIN_KNOWN = 0.6
# Blocks apart, at most, of pairs that tell the trend.
LAGS = 4
# Such pairs of one direction, at most: evenly thinned.
PAIRS = 100_000
# Rounds of reweighting, at most, and change of slope and bend that ends them.
ROUNDS, SETTLED = 30, 1e-5
# How far slope and bend within classes may be from what those say (standard deviation).
SLOPE_SD = (0.12, 0.3)


class AmplitudeGrid(NamedTuple):
    """What one look shows, on the map's lattice.

    Attributes
    ----------
    amplitude : array (rows, columns)
        NaN where there is none, or no sediment (shadow, water column). Where said, slices are read.
    cotangent : array (rows, columns)
        Of the grazing angle: ground range over altitude.
    altitude : array (rows, columns) or None
        Of the sonar over the floor, m, where it is known.
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
        Pixels.
    place : ndarray
        Log cotangent of the grazing angle about a centre, where a trend is told.
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
    """Log of a grazing angle's cotangent; steeper than 45 degrees there is no trend."""
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


def _places(look: AmplitudeGrid, known: NDArray[np.bool_], centre: float) -> list[FloatArray]:
    """Place, angle and reach of blocks: they change so slowly that few pixels tell."""
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
    """Add up the pixels of blocks (block rows, their rows, block columns, their columns)."""
    down = values.sum(axis=1, dtype=None if values.dtype != bool else np.float64)
    return np.asarray(down.sum(axis=2, dtype=float))


def first_trends(blocks: list[Blocks]) -> FloatArray:
    """Slope and bend of each look by its neighbouring blocks, gain by the blocks that two show."""
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
    """Tell a look's gain by the floor that another look shows as well.

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
    """Slope and bend of log amplitude with log cotangent, by differences of near blocks.

    Of most such pairs both blocks hold the same sediment; those that do not are told by their
    residuals and count for little (Cauchy weights).
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
    # from no trend at all: least squares would begin at what edges and objects make
    found: FloatArray = np.zeros(2)
    for _ in range(ROUNDS):
        before = found
        scale = 1.5 * median(np.abs(y - found[0] * ahead - found[1] * bent)) + 1e-9
        matrix, right = _weighed(y, ahead, bent, found, scale)
        # what nothing tells stays at 0
        matrix += np.diag([1e-4, 1e-3])
        found = np.asarray(np.linalg.solve(matrix, right), np.float64)
        if np.abs(found - before).max() < SETTLED:
            break
    return np.asarray(found)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weighed(y, step, bend, trend, scale):  # type: ignore[no-untyped-def]
    """Add up the normal equations of slope and bend, each difference with its Cauchy weight."""
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
    """Log of the amplitude that a gain, slope and bend make at log cotangents about the centre."""
    gain, slope, bend = (float(v) for v in trend)  # of the precision that places have
    return np.asarray(gain + slope * place + bend * place * place)


def refit(
    blocks: list[Blocks],
    groups: NDArray[np.int64],
    index: tuple[NDArray[np.int64], ...],
    first: FloatArray,
    means: FloatArray | None = None,
    gain_sd: float = 1e-6,
) -> FloatArray:
    """Fit gain, slope and bend of each look to what its blocks have beyond their classes.

    Not far from the first slopes, which no class can have bent.

    Parameters
    ----------
    blocks : list of Blocks
    groups : ndarray of int
        Class of each block of `index`; or of each block of the lattice.
    index : tuple of ndarray
        Rows and columns of the blocks that count.
    first : ndarray (looks, 3)
    means : ndarray (classes,), optional
        Mean log amplitude of each class; fitted as well where not given.
    gain_sd : float
        Of the first look's gain, which is otherwise the survey's.

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
