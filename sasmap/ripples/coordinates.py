"""Coordinates in which a clip's posterior is sampled: contrast or height, with the law.

An image constrains contrast unless shadow constrains height. Where it does, contrast depends on
height and law along a curve, which a mixture of Gaussians approximates poorly. The logs of contrast
and height differ, to first order, by a function of the law alone, so that densities are the same in
both.
"""

from __future__ import annotations

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.ripples.optimise import HEIGHT, LAW, Peak
from sasmap.ripples.rendering import CONCENTRATION, EXPONENT, Geometry, contrast_per_slope

# Least contrast per slope.
LEAST = 1e-9


class Coordinates:
    """Sampling coordinates for a set of peaks: log contrast or log A_H, whichever varies less.

    Parameters
    ----------
    peaks : list of Peak
        Their `level` is the log of their mass, their covariance that of `free`.
    geometry : Geometry
    free : ndarray of int
        Indices of the coordinates that are sampled.
    """

    def __init__(self, peaks: list[Peak], geometry: Geometry, free: IntArray) -> None:
        self._tangent = geometry.altitude_middle / geometry.range_middle
        self.by_height = False
        self.peaks = peaks
        if not np.isnan(geometry.fixed[0]):
            return
        at = int(np.flatnonzero(free == HEIGHT)[0])
        turned = [self._turned(p, free) for p in peaks]
        self.by_height = _variance(turned, at) < _variance(peaks, at)
        self.peaks = turned if self.by_height else peaks

    def to_sampling(self, z: FloatArray) -> FloatArray:
        """Return points (..., COORDINATES), their third coordinate log A_H if `by_height`."""
        points = z.copy()
        if self.by_height:
            points[..., HEIGHT] -= self._per_slope(z)
        return points

    def from_sampling(self, points: FloatArray) -> FloatArray:
        """Return the model's coordinates (..., COORDINATES), of which the third is log contrast."""
        z = points.copy()
        if self.by_height:
            z[..., HEIGHT] += self._per_slope(points)
        return z

    def _per_slope(self, z: FloatArray) -> FloatArray:
        """Log of the contrast per slope, to first order."""
        exponent = EXPONENT[0] + EXPONENT[1] * z[..., LAW]
        concentration = CONCENTRATION[0] + CONCENTRATION[1] * z[..., LAW + 1]
        each = contrast_per_slope(exponent, concentration, self._tangent)
        return np.asarray(np.log(np.maximum(each, LEAST)))

    def _turned(self, peak: Peak, free: IntArray) -> Peak:
        """Transform a peak from log contrast to log A_H."""
        turn = np.eye(free.size)
        at = int(np.flatnonzero(free == HEIGHT)[0])
        here = self._per_slope(peak.z)
        rises = EXPONENT[1], CONCENTRATION[1]
        for i, law in enumerate(((rises[0], 0.0), (0.0, rises[1]))):
            rise = contrast_per_slope(*law, self._tangent) - self._tangent
            turn[at, np.flatnonzero(free == LAW + i)] = -rise / np.exp(here)
        z = peak.z.copy()
        z[HEIGHT] -= here
        return Peak(z, peak.level, turn @ peak.covariance @ turn.T)


def _variance(peaks: list[Peak], at: int) -> float:
    """Variance of a mixture's third coordinate."""
    weight = np.exp([p.level - max(q.level for q in peaks) for p in peaks])
    weight /= weight.sum()
    mean = np.array([p.z[HEIGHT] for p in peaks])
    within = np.array([p.covariance[at, at] for p in peaks])
    return float(weight @ (within + (mean - weight @ mean) ** 2))
