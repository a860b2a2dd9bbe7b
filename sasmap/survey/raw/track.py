"""Smoothing of a recording's track, whose fixes repeat or jump from ping to ping."""

from __future__ import annotations

import numpy as np
import scipy.interpolate
import scipy.ndimage

from sasmap.arrays import FloatArray
from sasmap.survey.pings import Pings, checked_pings

# Spacing of the knots of the cubic spline, m: vehicles turn more slowly, and fixes scatter by
# decimetres within it (0.2 m on an Iver2).
KNOT = 30.0
# Pings over which altitude is averaged (a choice: reduces the altimeter's noise by 3).
ALTITUDE_PINGS = 9


def smooth_track(pings: Pings) -> tuple[Pings, list[str]]:
    """Smooth positions and altitude of a recorded line.

    Parameters
    ----------
    pings : Pings
        As recorded; altitude zero where missing.

    Returns
    -------
    pings : Pings
    warnings : list of str
        Corrections that were made.
    """
    pings, warnings = checked_pings(pings)
    index = np.arange(pings.x.size, dtype=float)
    fresh = np.concatenate(
        [[True], (np.diff(pings.x) != 0) | (np.diff(pings.y) != 0)]
    )  # a fix is repeated until the next: only its first ping is in time
    at = np.flatnonzero(fresh)
    rough = float(np.hypot(np.ptp(pings.x), np.ptp(pings.y)))
    knots = max(int(rough // KNOT), 1)
    x, y = (_spline(at.astype(float), v[at], index, knots) for v in (pings.x, pings.y))
    altitude = scipy.ndimage.uniform_filter1d(pings.altitude, ALTITUDE_PINGS, mode="nearest")
    return pings._replace(x=x, y=y, altitude=altitude), warnings


def _spline(at: FloatArray, values: FloatArray, wanted: FloatArray, pieces: int) -> FloatArray:
    """Fit a least-squares cubic spline of so many pieces."""
    pieces = min(pieces, max(at.size // 8, 1))
    order = min(3, at.size - 1)
    inner = np.quantile(at, np.linspace(0, 1, pieces + 1)[1:-1])
    fit = scipy.interpolate.LSQUnivariateSpline(at, values, inner, k=order)
    return np.asarray(fit(wanted), float)
