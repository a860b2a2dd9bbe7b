"""A recording's track: fixes that repeat or jump from ping to ping made a smooth line."""

from __future__ import annotations

import numpy as np
import scipy.interpolate
import scipy.ndimage

from sasmap.survey.lattice import FloatArray
from sasmap.survey.pings import Pings, checked_pings

# Metres along the track to a knot of the cubic spline: vehicles turn more slowly, fixes scatter by
# decimetres within (0.2 m on an Iver2).
KNOT = 30.0
# Pings over which altitude is averaged.
ALTITUDE_PINGS = 9


def smooth_track(pings: Pings) -> tuple[Pings, list[str]]:
    """Smooth positions and altitude of a recorded line.

    Parameters
    ----------
    pings : Pings
        As recorded; altitude zero where there is none.

    Returns
    -------
    pings : Pings
    warnings : list of str
        What was mended.
    """
    pings, warnings = checked_pings(pings)
    index = np.arange(pings.x.size, dtype=float)
    fresh = np.concatenate(
        [[True], (np.diff(pings.x) != 0) | (np.diff(pings.y) != 0)]
    )  # a fix is held until the next: only its first ping has it in time
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
