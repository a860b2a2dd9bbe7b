"""Registration of passes from the positions of crests.

Where the phases of all cells agree on one shift of a pass relative to the map, the pass is
misregistered; migration differs from cell to cell. Crests determine a shift along their normal,
modulo a wavelength; cells of several directions and wavelengths together determine it completely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray, IntArray

# Prior standard deviation of registration, m (differential GPS); range of the search, in units of
# it; step of the search over the shortest wavelength.
USUAL, REACH, STEP = 0.5, 3.0, 0.1
# Additional error of a phase, cycles, and prior share of cells with migrated crests (choices).
PHASE_ERROR, MIGRATED = 0.02, 0.3
# Least gain in log likelihood over no shift, least number and share of agreeing cells, and standard
# deviations within which a cell agrees (docs/science.md, Registration and migration).
GAIN, LEAST_CELLS, LEAST_SHARE, AGREE = 8.0, 5, 0.5, 3.0
# Most cells from which a shift is estimated; sweeps over the passes; grid points evaluated at once.
MOST_CELLS, SWEEPS, CHUNK = 400, 3, 256


class Moves(NamedTuple):
    """Displacements of crests from those of the first look at their cell; arrays (M,).

    Attributes
    ----------
    first, swath : ndarray of int
        Passes of the two looks.
    distance, sd : ndarray
        m along the normal, modulo a wavelength.
    wavelength : ndarray
        m.
    normal : ndarray (M, 2)
        East and north.
    """

    first: IntArray
    swath: IntArray
    distance: FloatArray
    sd: FloatArray
    wavelength: FloatArray
    normal: FloatArray


def left_over(moves: Moves, shifts: FloatArray) -> FloatArray:
    """Distances minus the shifts of the passes, from minus half to half a wavelength.

    Parameters
    ----------
    moves : Moves
    shifts : ndarray (passes, 2)
        East and north, m.

    Returns
    -------
    ndarray (M,)
    """
    shift = ((shifts[moves.swath] - shifts[moves.first]) * moves.normal).sum(axis=1)
    rest = moves.distance - shift
    return np.asarray(rest - moves.wavelength * np.rint(rest / moves.wavelength))


def registration(moves: Moves, passes: int) -> FloatArray:
    """Estimate the shifts of passes relative to the map from crests that have not migrated.

    Parameters
    ----------
    moves : Moves
    passes : int

    Returns
    -------
    ndarray (passes, 2)
        East and north, m, relative to the first pass. 0 for passes whose cells do not agree on a
        shift.
    """
    shifts = np.zeros((passes, 2))
    for _ in range(SWEEPS if passes > 2 else 1):
        before = shifts.copy()
        for k in range(1, passes):
            shifts[k] = _shift_of(k, moves, shifts)
        if np.allclose(before, shifts, atol=1e-4):
            break
    return shifts


def _shift_of(k: int, moves: Moves, shifts: FloatArray) -> FloatArray:
    """Estimate the shift of a pass, given those of the others."""
    seen = np.flatnonzero((moves.swath == k) != (moves.first == k))
    if len(seen) < LEAST_CELLS:
        return np.zeros(2)
    seen = seen[np.unique(np.linspace(0, len(seen) - 1, MOST_CELLS).astype(int))]
    mine = Moves(*(values[seen] for values in moves))
    others = shifts.copy()
    others[k] = 0.0
    sign = np.where(mine.swath == k, 1.0, -1.0)
    rest, normal = left_over(mine, others) * sign, mine.normal
    sd = np.hypot(mine.sd, PHASE_ERROR * mine.wavelength)
    step = STEP * mine.wavelength.min()
    side = np.arange(-np.ceil(REACH * USUAL / step), np.ceil(REACH * USUAL / step) + 1) * step
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    parts = np.split(grid, np.arange(CHUNK, len(grid), CHUNK))
    # widened by a step, so that no peak falls between the points of the grid
    wide = np.hypot(sd, 0.5 * step)
    levels = np.concatenate([_level(p, rest, normal, mine.wavelength, wide) for p in parts])
    best = grid[int(np.argmax(levels))]
    for _ in range(5):
        best = _refined(best, rest, normal, mine.wavelength, sd)
    apart = _wrapped(rest - normal @ best, mine.wavelength)
    agree = int((np.abs(apart) < AGREE * sd).sum())
    points = np.stack([best, np.zeros(2)])
    there, here = _level(points, rest, normal, mine.wavelength, sd)
    if there - here < GAIN or agree < max(LEAST_CELLS, LEAST_SHARE * len(rest)):
        return np.zeros(2)
    return np.asarray(best)


def _wrapped(distance: FloatArray, wavelength: FloatArray) -> FloatArray:
    return np.asarray(distance - wavelength * np.rint(distance / wavelength))


def _level(
    points: FloatArray,
    rest: FloatArray,
    normal: FloatArray,
    wavelength: FloatArray,
    sd: FloatArray,
) -> FloatArray:
    """Log posterior of shifts (n, 2); a cell with migrated crests may have any phase."""
    apart = _wrapped(rest - points @ normal.T, wavelength)
    peak = wavelength / (np.sqrt(2 * np.pi) * sd) * np.exp(-0.5 * (apart / sd) ** 2)
    likelihood = np.log(MIGRATED + (1 - MIGRATED) * peak).sum(axis=1)
    return np.asarray(likelihood - 0.5 * (points**2).sum(axis=1) / USUAL**2)


def _refined(
    point: FloatArray,
    rest: FloatArray,
    normal: FloatArray,
    wavelength: FloatArray,
    sd: FloatArray,
) -> FloatArray:
    """Refine a shift by least squares over the cells that agree with it."""
    apart = _wrapped(rest - normal @ point, wavelength)
    peak = wavelength / (np.sqrt(2 * np.pi) * sd) * np.exp(-0.5 * (apart / sd) ** 2)
    weight = (1 - MIGRATED) * peak / (MIGRATED + (1 - MIGRATED) * peak) / sd**2
    precision = (normal * weight[:, None]).T @ normal + np.eye(2) / USUAL**2
    push = (weight * (apart + normal @ point)) @ normal
    return np.asarray(np.linalg.solve(precision, push))
