"""Limits of shadow along a ripple, for any ripple and geometry, in a single table.

A point is hidden where the floor before it rises above the straight ray to the sonar, a line of
slope s = (altitude - h) / range. In units of phase and A_H its slope is s / (2 pi f A_H cos alpha).
For any range, altitude and look, the phases past the crest where shadow begins and ends depend only
on this ratio (and on the steepness, for a Stokes profile).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from sasmap.arrays import BoolArray, FloatArray
from sasmap.simulate.profiles import crest
from sasmap.simulate.scattering import ProfileName

ShadowRule = Literal["line-of-sight", "crest"]

# Largest tabulated steepness 2 pi f A_H (slopes up to 45 degrees).
MAX_STEEPNESS = 1.0
# Size of the table, and points along a wavelength at which floor and ray are compared: the error of
# shadow is then under 0.1 % of a wavelength (tests/simulate/test_shadow.py).
STEEPNESSES, RATIOS, FINE = 33, 257, 4096


@lru_cache(maxsize=8)
def shadow_table(rule: ShadowRule, profile: ProfileName) -> FloatArray:
    """Tabulate where shadow begins and ends.

    Parameters
    ----------
    rule : {"line-of-sight", "crest"}
    profile : {"sine", "stokes", "peaked"}

    Returns
    -------
    ndarray (STEEPNESSES or 1, 3, RATIOS)
        For steepnesses at even steps up to MAX_STEEPNESS: the phase past the crest where shadow
        begins, the phase where it ends, rad, and (third row) the limiting ratio above which there
        is no shadow. Along the last axis the ratio relative to that limit is sin(pi x / 2)^2 with x
        evenly from 0 to 1, which makes both phases nearly linear.
    """
    steepness = np.linspace(0, MAX_STEEPNESS, STEEPNESSES) if profile == "stokes" else np.zeros(1)
    return np.stack([_for_steepness(rule, profile, float(e)) for e in steepness])


def _for_steepness(rule: ShadowRule, profile: ProfileName, steepness: float) -> FloatArray:
    past = np.linspace(0, 2 * np.pi, FINE + 1)
    height = crest(past + np.pi / 2, steepness, profile)
    height = height - height[0]
    if rule == "crest":  # the ray over the crest itself
        limit = float((-height[1:] / past[1:]).max())
    else:
        limit = float((-np.diff(height) / np.diff(past)).max())
    ratio = limit * np.sin(0.5 * np.pi * np.linspace(0, 1, RATIOS)) ** 2
    if rule == "crest":
        margin = -ratio[:, None] * past - height
        edges = np.array([_edges(past, m) for m in margin])
    else:
        edges = np.array([_sight_edges(past, height + r * past) for r in ratio])
    # exact at both ends: shadow from crest to crest, and none
    edges[0] = (0.0, 2 * np.pi)
    edges[-1] = edges[-2].mean()
    return np.stack([edges[:, 0], edges[:, 1], np.full(RATIOS, limit)])


def _edges(past: FloatArray, margin: FloatArray) -> tuple[float, float]:
    """First and last zero of a margin that is positive in shadow."""
    hidden = np.flatnonzero(margin[1:-1] > 0) + 1
    if not hidden.size:
        middle = float(past[np.argmax(margin[1:]) + 1])
        return middle, middle
    first, last = int(hidden[0]), int(hidden[-1])
    return (
        _zero(past, margin, first - 1) if first > 1 else 0.0,
        _zero(past, margin, last),
    )


def _sight_edges(past: FloatArray, line: FloatArray) -> tuple[float, float]:
    """Edges of shadow: the floor, tilted by the ray's slope, is below its running maximum."""
    highest = np.maximum.accumulate(line)
    hidden = np.flatnonzero(line < highest)
    if not hidden.size:
        middle = float(past[np.argmin(np.diff(line))])
        return middle, middle
    first = int(hidden[0]) - 1
    bend = line[max(first - 1, 0)] - 2 * line[first] + line[first + 1]
    offset = 0.0
    if first > 0 and bend < 0:
        offset = 0.5 * float(line[first - 1] - line[first + 1]) / float(bend)
    margin = highest - line
    begin = float(past[first]) + offset * float(past[1])
    # the last interval of shadow within a wavelength
    last = int(hidden[-1])
    end = _zero(past, np.where(margin > 0, margin, highest[last] - line), last)
    return begin, end


def _zero(past: FloatArray, margin: FloatArray, i: int) -> float:
    """Zero of the straight line between points i and i + 1."""
    if i + 1 >= past.size:
        return float(past[-1])
    change = float(margin[i] - margin[i + 1])
    share = float(margin[i]) / change if change != 0 else 0.0
    return float(past[i] + np.clip(share, 0, 1) * (past[i + 1] - past[i]))


def shadow_mask(
    phase: FloatArray,
    ground_range: FloatArray,
    altitude: float,
    along: float,
    frequency: float,
    height: float,
    profile: ProfileName,
    rule: ShadowRule,
) -> BoolArray:
    """Find which points of straight ripples are in shadow, from the table.

    Parameters
    ----------
    phase : ndarray
        Ripple phase at the points, rad, along the look.
    ground_range : ndarray
        m.
    altitude : float
        m.
    along : float
        Frequency along the look, f cos(alpha), cycles/m, above 0.
    frequency, height : float
        f (cycles/m) and A_H (m).
    profile : {"sine", "stokes", "peaked"}
    rule : {"line-of-sight", "crest"}

    Returns
    -------
    ndarray of bool
    """
    full, steepness = 2 * np.pi * frequency * height, 2 * np.pi * along * height
    if not steepness > 0:
        return np.zeros(np.shape(phase), bool)
    past = np.mod(phase - np.pi / 2, 2 * np.pi)
    if rule == "crest":
        reach = ground_range - past / (2 * np.pi * along)
        slope = altitude / np.where(reach > 0, reach, np.inf)
    else:
        slope = (altitude - height * crest(phase, full, profile)) / ground_range
    ratio = slope / steepness
    table = shadow_table(rule, profile)
    place = min(full / MAX_STEEPNESS, 1.0) * (len(table) - 1)
    low = min(int(place), max(len(table) - 2, 0))
    share = place - low
    rows = (1 - share) * table[low] + share * table[min(low + 1, len(table) - 1)]
    begin, end, limit = rows[0], rows[1], rows[2, 0]
    x = 2 / np.pi * np.arcsin(np.sqrt(np.clip(ratio / limit, 0, 1))) * (RATIOS - 1)
    inside = (past > np.interp(x, np.arange(RATIOS), begin)) & (
        past < np.interp(x, np.arange(RATIOS), end)
    )
    return np.asarray(inside & (ratio < limit) & (ratio > 0))
