"""Checks of pings: outliers of position and altitude, gaps, steps, rows out of order.

A few bad pings are interpolated from their neighbours, with a warning; more are refused. Rows are
numbered as in the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.spatial
from numpy.typing import NDArray

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.errors import InputError

# Half-width of the running median, pings: runs of up to five bad pings are outliers of it.
HALF = 5
# Deviations that are not noise: in standard deviations (from the median absolute deviation), in
# ping spacings for positions, and as a fraction of altitude. The sea floor's relief within eleven
# pings is smaller: a wreck of a quarter of the altitude enters the median once it spans six pings.
SIGMAS, SPACINGS, FRACTION = 8.0, 4.0, 0.25
# Ratio of standard deviation to median absolute deviation of a normal distribution.
TO_SD = 1.4826
# Bad pings that are interpolated: maximum share of all, and maximum number of successive missing
# altitudes (choices: what interpolation can bridge).
MOST_BAD, LONGEST_GAP = 0.1, 10
# Minimum number of pings for the running median: one more than its width of eleven.
FEWEST = 12
# Step of altitude between two pings that is not relief: as a fraction of the median altitude (the
# error that heights would have), steeper than 45 degrees, and lasting.
CLIFF = 0.2
# Step of rounded altitudes, as a share of altitude, whose half is a significant error of A_H
# (2.5 %).
COARSE = 0.05
# Lasting step across the track: in metres (a twentieth of a range of ten metres), ping spacings,
# and standard deviations of the scatter across the track.
ASIDE, ASIDE_SPACINGS, ASIDE_SIGMAS = 0.5, 2.0, 8.0
# Ping spacings beyond which a step leads to another line (the jump of survey/lines.py).
FARTHEST_ASIDE = 20.0
# Rounded positions: the step, m, that matters for ranges of ten metres, and the share of pings that
# then deviate from a straight line by half of it.
ROUNDED, BENT = 0.25, 0.1
# Rows out of order: ratio of the median step to the distance to the nearest ping, and to the extent
# of the track. In order these are about 1 (jitter of three spacings: 5) and small; shuffled, the
# step is a third of the extent.
DISORDER, WIDE = 10.0, 0.05
# Maximum number of rows that a message lists.
NAMED = 5


class Pings(NamedTuple):
    """Rows of a navigation file: their numbers in the file, position (m) and altitude (m)."""

    path: Path
    rows: IntArray
    x: FloatArray
    y: FloatArray
    altitude: FloatArray

    def at(self, pick: slice | BoolArray) -> Pings:
        """Select pings."""
        return Pings(self.path, self.rows[pick], self.x[pick], self.y[pick], self.altitude[pick])


def checked_pings(pings: Pings) -> tuple[Pings, list[str]]:
    """Interpolate outliers and gaps of a few pings; refuse files with more.

    Parameters
    ----------
    pings : Pings
        Altitude NaN where the file has none.

    Returns
    -------
    pings : Pings
    warnings : list of str

    Raises
    ------
    InputError
        Names the row.
    """
    warnings: list[str] = []
    pings = _once(pings, warnings)
    _check_order(pings)
    pings = _filled(pings, warnings)
    pings = _without_spikes(pings, warnings)
    _check_rounding(pings, warnings)
    _check_cliffs(pings, warnings)
    _check_jumps(pings, warnings)
    return pings, warnings


def _once(pings: Pings, warnings: list[str]) -> Pings:
    """Drop rows that repeat an earlier one other than the row before."""
    values = np.column_stack([pings.x, pings.y, np.nan_to_num(pings.altitude, nan=-1.0)])
    _, first, inverse = np.unique(values, axis=0, return_index=True, return_inverse=True)
    origin = first[inverse.ravel()]
    index = np.arange(values.shape[0])
    standing = np.zeros(index.size, bool)  # a sonar that stands still repeats rows: harmless
    standing[1:] = (values[1:] == values[:-1]).all(axis=1)
    repeated = (origin < index) & ~standing
    if not repeated.any():
        return pings
    at = np.flatnonzero(repeated)
    warnings.append(
        f"{pings.path}: {_named(pings, at)} repeats row {pings.rows[origin[at[0]]]}"
        f"{' and so on' if at.size > 1 else ''}: left out"
    )
    return pings.at(~repeated)


def _check_order(pings: Pings) -> None:
    """Refuse rows that are not in track order."""
    points = np.column_stack([pings.x, pings.y])
    step = np.hypot(*np.diff(points, axis=0).T)
    if points.shape[0] < FEWEST or not (step > 0).any():
        return
    unique = np.unique(points, axis=0)
    if unique.shape[0] < FEWEST:
        return
    nearest = scipy.spatial.cKDTree(unique).query(unique, k=2)[0][:, 1]
    usual, extent = float(np.median(nearest)), float(np.hypot(*np.ptp(points, axis=0)))
    if np.median(step) <= DISORDER * usual or np.median(step) <= WIDE * extent:
        return
    at = int(np.flatnonzero(step > DISORDER * usual)[0]) + 1
    raise InputError(
        f"{pings.path}: row {pings.rows[at]}: rows are not in track order: it lies "
        f"{step[at - 1]:.1f} m from the row before, while pings are {usual:.2g} m apart: "
        "sort the file by time"
    )


def _filled(pings: Pings, warnings: list[str]) -> Pings:
    """Interpolate altitude where a few pings have none: empty, zero or negative."""
    altitude = pings.altitude.copy()
    missing = ~(altitude > 0)
    if not missing.any():
        return pings
    at = np.flatnonzero(missing)
    longest = max(len(run) for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1))
    # an altimeter slower than the sonar leaves short gaps between its readings
    slow = (
        longest <= LONGEST_GAP and (~missing).sum() >= FEWEST / 2 and np.isnan(altitude[at]).all()
    )
    if longest > LONGEST_GAP or (at.size > MOST_BAD * missing.size and not slow):
        given = altitude[at[0]]
        what = "a number, got nothing" if np.isnan(given) else f"more than 0 m, got {given:g}"
        more = f" ({at.size} of {missing.size} pings have none)" if at.size > 1 else ""
        raise InputError(f"{pings.path}: row {pings.rows[at[0]]}: altitude: expected {what}{more}")
    altitude[missing] = np.interp(at, np.flatnonzero(~missing), altitude[~missing])
    warnings.append(
        f"{pings.path}: {_named(pings, at)}: no altitude: interpolated from the pings around"
    )
    return pings._replace(altitude=altitude)


def _without_spikes(pings: Pings, warnings: list[str]) -> Pings:
    """Interpolate positions and altitudes that are outliers of the running median."""
    if pings.x.size < FEWEST:
        return pings
    x, y, altitude = pings.x.copy(), pings.y.copy(), pings.altitude.copy()
    away = np.hypot(x - _median(x), y - _median(y))
    step = np.hypot(np.diff(x), np.diff(y))
    spacing = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    limit = max(SPACINGS * spacing, SIGMAS * TO_SD * float(np.median(away)))
    # the last ping of a line is far from the median around it, but not from the line before it
    bad = (away > limit) & (np.minimum(*_from_either_side(x, y)) > limit)
    if bad.any():
        at = np.flatnonzero(bad)
        told = (
            f"{pings.path}: {_named(pings, at)}: position {away[at[0]]:.1f} m away from its "
            f"neighbours' median, while pings are {spacing:.2g} m apart"
        )
        _mend((x, y), bad, told, warnings)
    local = _median(altitude)
    away = np.abs(altitude - local)
    bad = away > np.maximum(FRACTION * local, SIGMAS * TO_SD * float(np.median(away)))
    if bad.any():
        at = np.flatnonzero(bad)
        told = (
            f"{pings.path}: {_named(pings, at)}: altitude {altitude[at[0]]:g} m, its neighbours' "
            f"median {local[at[0]]:.3g} m"
        )
        _mend((altitude,), bad, told, warnings)
    return pings._replace(x=x, y=y, altitude=altitude)


def _mend(values: Sequence[FloatArray], bad: BoolArray, told: str, warnings: list[str]) -> None:
    """Interpolate bad numbers in place, or refuse them where there are too many."""
    if bad.sum() > MOST_BAD * bad.size:
        raise InputError(f"{told}: {bad.sum()} of {bad.size} pings are like that: correct the file")
    for one in values:
        one[bad] = np.interp(np.flatnonzero(bad), np.flatnonzero(~bad), one[~bad])
    warnings.append(f"{told}: interpolated from the pings around; correct or remove it")


def _median(values: FloatArray) -> FloatArray:
    """Take a running median over a ping and its neighbours, with the trend beyond the ends."""
    width = 2 * HALF + 1

    def beyond(end: FloatArray) -> FloatArray:
        """Values before the first of `end`, along a robust line."""
        place = np.arange(end.size)
        slope = float(np.median(np.diff(end)))
        level = float(np.median(end - slope * place))
        return np.asarray(level + slope * np.arange(-HALF, 0), float)

    before, after = beyond(values[:width]), beyond(values[: -width - 1 : -1])[::-1]
    padded = np.concatenate([before, values, after])
    return np.asarray(
        np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1), float
    )


def _from_either_side(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance of each ping from extrapolations of those before and after it; inf at the ends."""
    width = 2 * HALF + 1
    place = np.arange(width)
    ahead, behind = [], []
    for values in (x, y):
        windows = np.lib.stride_tricks.sliding_window_view(values, width)
        slope = np.median(np.diff(windows, axis=1), axis=1)
        level = np.median(windows - slope[:, None] * place, axis=1)
        ahead.append((level + slope * width)[:-1])
        behind.append((level - slope)[1:])
    before, after = np.full(x.size, np.inf), np.full(x.size, np.inf)
    before[width:] = np.hypot(x[width:] - ahead[0], y[width:] - ahead[1])
    after[:-width] = np.hypot(x[:-width] - behind[0], y[:-width] - behind[1])
    return before, after


def _check_rounding(pings: Pings, warnings: list[str]) -> None:
    """Warn about altitudes that are rounded so coarsely that heights are wrong."""
    levels = np.unique(pings.altitude)
    if levels.size < 2 or pings.altitude.size < FEWEST:
        return
    step, middle = float(np.diff(levels).min()), float(np.median(levels))
    whole = np.abs(levels / step - np.rint(levels / step)).max() < 1e-3
    if whole and step > COARSE * middle:
        warnings.append(
            f"{pings.path}: altitude is rounded to steps of {step:.2g} m: A_H is wrong by up to "
            f"{step / 2 / middle:.0%}; export more digits"
        )


def _check_cliffs(pings: Pings, warnings: list[str]) -> None:
    """Warn about lasting steps of altitude that cannot be relief."""
    limit = CLIFF * float(np.median(pings.altitude))
    along = np.hypot(np.diff(pings.x), np.diff(pings.y))
    step = np.abs(np.diff(pings.altitude))
    at = np.flatnonzero((step > limit) & (step > along))
    at = at[[abs(_lasting(pings.altitude, int(k))) > limit for k in at]] if at.size else at
    if not at.size:
        return
    before, after = pings.altitude[at[0]], pings.altitude[at[0] + 1]
    warnings.append(
        f"{pings.path}: {_named(pings, at + 1)}: altitude jumps from {before:.3g} m to {after:.3g} "
        "m from one ping to the next: A_H has the same relative error there; correct the file"
    )


def _lasting(values: FloatArray, k: int) -> float:
    """Difference of the medians of the pings after ping k and of those up to it."""
    after, before = values[k + 1 : k + 2 + HALF], values[max(k - HALF, 0) : k + 1]
    return float(np.median(after) - np.median(before))


def _check_jumps(pings: Pings, warnings: list[str]) -> None:
    """Warn about lasting steps across the track, as where navigation was corrected to a fix."""
    width = 2 * HALF + 2
    if pings.x.size < max(FEWEST, width):
        return
    x, y = (np.lib.stride_tricks.sliding_window_view(v, width) for v in (pings.x, pings.y))
    # course of the pings before and after the step, without the step itself
    dx, dy = (v[:, HALF] - v[:, 0] + v[:, -1] - v[:, HALF + 1] for v in (x, y))
    length = np.hypot(dx, dy)
    step = x[:, HALF + 1] - x[:, HALF], y[:, HALF + 1] - y[:, HALF]
    with np.errstate(invalid="ignore", divide="ignore"):
        aside = np.abs(step[0] * dy - step[1] * dx) / length
    every = np.hypot(np.diff(pings.x), np.diff(pings.y))
    spacing = float(np.median(every[every > 0])) if (every > 0).any() else 0.0
    scatter = TO_SD * float(np.nanmedian(aside)) if np.isfinite(aside).any() else 0.0
    limit = max(ASIDE, ASIDE_SPACINGS * spacing, ASIDE_SIGMAS * scatter)
    # a turn has no step longer than its neighbours; new lines are split off elsewhere
    found = (aside > limit) & (length > spacing * HALF) & (aside < FARTHEST_ASIDE * spacing)
    at = np.flatnonzero(found) + HALF
    if not at.size:
        return
    warnings.append(
        f"{pings.path}: {_named(pings, at + 1)}: position steps {aside[at[0] - HALF]:.1f} m across "
        "the track and stays there: ranges before or after it are wrong by as much; smooth the "
        "track"
    )


def rounding_of(values: FloatArray) -> float:
    """Find the step to which one coordinate of positions was rounded, in its unit.

    Parameters
    ----------
    values : ndarray (n,)
        Values as in the file, in track order.

    Returns
    -------
    float
        A power of ten or, for single-precision numbers, their resolution; 0 where the track is
        smoother than such a step, or the numbers are finer.
    """
    gaps = np.diff(np.unique(values))
    # sums of decimals differ in the last bits of double precision, which is not a step
    gaps = gaps[gaps > 1e-12 * np.abs(values).max()]
    if values.size < FEWEST or not gaps.size:
        return 0.0
    step = float(gaps.min())
    decimal = abs(np.log10(step) - np.rint(np.log10(step))) < 1e-3
    with np.errstate(over="ignore"):  # values that overflow are not in single precision
        single = values.astype(np.float32)
    coarse = bool((single == values).all()) and step >= 0.99 * np.spacing(np.abs(single).max())
    if not (decimal or coarse):
        return 0.0
    if not decimal:  # repeated fixes a whole step apart are not rounding
        values = values[np.concatenate([[True], np.diff(values) != 0])]
    bent = np.abs(np.diff(values, n=2)) > 0.5 * step
    return step if bent.sum() > BENT * values.size else 0.0


def _named(pings: Pings, at: NDArray[np.intp]) -> str:
    """List rows of the file."""
    rows = [str(row) for row in pings.rows[at[:NAMED]]]
    more = f" and {at.size - NAMED} more" if at.size > NAMED else ""
    return f"row{'s' if at.size > 1 else ''} {', '.join(rows)}{more}"
