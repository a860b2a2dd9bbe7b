"""Estimate of a cell: statistics of a mixture over log f, log A_H and azimuth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sasmap.arrays import FloatArray
from sasmap.passes.derived import UNKNOWN as UNDERIVED
from sasmap.passes.derived import Derived
from sasmap.passes.mixture import Marginal, marginals, weighted
from sasmap.passes.summary import NAN, Summary
from sasmap.ripples.settings import RippleSettings

# Least probability of the heights that a cell's looks allow (a choice: looks that agree leave more
# than half).
LEAST_MASS = 0.1


@dataclass(frozen=True)
class CellEstimate:
    """Estimate of a cell.

    Attributes
    ----------
    mean, sd, q05, q95 : tuple of float
        Of f (cycles/m) and A_H (m).
    azimuth : tuple of float
        Axial mean (0 to 180) and standard deviation, degrees.
    derived : Derived
        Wavelength and steepness.
    """

    mean: tuple[float, float] = (NAN, NAN)
    sd: tuple[float, float] = (NAN, NAN)
    q05: tuple[float, float] = (NAN, NAN)
    q95: tuple[float, float] = (NAN, NAN)
    azimuth: tuple[float, float] = (NAN, NAN)
    derived: Derived = UNDERIVED


UNKNOWN = CellEstimate()
# Flat prior of a cell's first look.
FLAT = CellEstimate(sd=(float("inf"),) * 2, azimuth=(NAN, float("inf")))


def estimates(
    weight: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    settings: RippleSettings,
    reach: FloatArray,
) -> list[CellEstimate]:
    """Summarise mixtures over log f, log A_H and azimuth.

    Parameters
    ----------
    weight : ndarray (cells, K)
    mean : ndarray (cells, K, 3)
    covariance : ndarray (cells, K, 3, 3)
    settings : RippleSettings
    reach : ndarray (cells, 2)
        Least and largest A_H (m) of each cell, within the bounds of the settings. Ignored where
        little of the estimate lies between them: then the looks' likelihoods decide.

    Returns
    -------
    list of CellEstimate
    """
    variance = np.diagonal(covariance, axis1=2, axis2=3)
    with np.errstate(divide="ignore"):
        f_bounds, bounds = np.log(settings.frequency), np.log(settings.height)[:, None]
        closer = np.clip(np.log(reach).T, *bounds)
    sd = np.sqrt(variance[..., 1])
    low, high = (ndtr((b[:, None] - mean[..., 1]) / sd) for b in closer)
    bounds = np.where(weighted(weight, high - low) > LEAST_MASS, closer, bounds)
    # f is far better known than A_H, so the bounds of A_H at the cell's f bound the steepness
    steep = np.log(2) + weighted(weight, mean[..., 0]) + bounds
    ratio = variance[..., 0] + variance[..., 1] + 2 * covariance[..., 0, 1]
    logs = [
        (mean[..., 0], variance[..., 0], f_bounds),
        (mean[..., 1], variance[..., 1], bounds),
        (np.log(2) + mean[..., 0] + mean[..., 1], ratio, steep),
        (-mean[..., 0], variance[..., 0], -f_bounds[::-1]),
    ]
    found = [marginals(weight, m, np.sqrt(np.maximum(v, 1e-20)), b) for m, v, b in logs]
    turn = weighted(weight, mean[..., 2])
    spread = weighted(weight, variance[..., 2] + (mean[..., 2] - turn[:, None]) ** 2)
    return [
        CellEstimate(
            mean=_pair(found, "mean", i),
            sd=_pair(found, "sd", i),
            q05=_pair(found, "q05", i),
            q95=_pair(found, "q95", i),
            azimuth=(float(turn[i] % 180), float(np.sqrt(spread[i]))),
            derived=_derived(found, i),
        )
        for i in range(len(weight))
    ]


def _pair(found: list[Marginal], name: str, i: int) -> tuple[float, float]:
    """Return a statistic of f and of A_H."""
    return float(getattr(found[0], name)[i]), float(getattr(found[1], name)[i])


def _derived(found: list[Marginal], i: int) -> Derived:
    mean, sd, q05, q95 = (float(values[i]) for values in found[2])
    length = found[3]
    return Derived((float(length.mean[i]), float(length.sd[i])), (mean, sd, q05, q95))


def of_summary(summary: Summary) -> CellEstimate:
    """Return the estimate from a single look."""
    s = summary
    return CellEstimate(s.mean, s.sd, s.q05, s.q95, s.azimuth, s.derived)
