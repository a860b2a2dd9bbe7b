"""Posterior of the ripples in a clip: draws, their summary, and their quality."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Any

import numpy as np
import xarray as xr

from sasmap.arrays import FloatArray
from sasmap.ripples import diagnostics
from sasmap.ripples.priors import Prior

MAX_RHAT = 1.01
MIN_ESS = 400.0
QUANTILES = (0.05, 0.5, 0.95)
JUDGED = ("frequency", "height", "azimuth")


class Quality(IntEnum):
    """Quality of a cell (README, products)."""

    NO_DATA = 0
    GOOD = 1
    NO_RIPPLES = 2
    NOT_CONVERGED = 3
    CONTRADICTION = 4
    NOT_IDENTIFIABLE = 5
    TOO_FEW_PIXELS = 6
    FAILED = 7

    @property
    def label(self) -> str:
        """Human-readable name."""
        return _LABELS.get(self, self.name.lower().replace("_", " "))


_LABELS = {
    Quality.CONTRADICTION: "passes contradict each other",
    Quality.TOO_FEW_PIXELS: "too few valid pixels",
}


class LeftOut(IntFlag):
    """Steps that were left out, as the clip did not need them or the method lacks them."""

    SAMPLING = 1
    PRESENCE_TEST = 2
    SHADOW = 4
    ORIENTATION = 8
    PHASE_FIELD = 16


NOTHING = LeftOut(0)


@dataclass(frozen=True)
class Shape:
    """Shape of the crests of a clip, and its geometry.

    Attributes
    ----------
    coherence_length : float
        Distance over which the phase, without its mean slope, stays correlated (1/e), m; at least
        the clip's diagonal where crests are straight.
    rippled_fraction : float
        Rippled fraction of the valid area.
    stiffness : float
        Smoothing of the phase field, m; infinite where crests are straight.
    noise_factor : float
        Variance of the speckle over that of independent pixels.
    defect_density : float
        Number of places per square metre where crests split or end.
    tangent, altitude, altitude_sd : float
        Tangent of the grazing angle; the sonar's altitude and its accuracy, m; at the clip's
        middle.
    centre : tuple of float
        Map position (east, north) of the clip's centre, m, to which the draws of `phase` refer.
    """

    coherence_length: float
    rippled_fraction: float
    stiffness: float
    noise_factor: float
    defect_density: float
    tangent: float = 1.0
    altitude: float = 1.0
    altitude_sd: float = 0.0
    centre: tuple[float, float] = (float("nan"), float("nan"))


def axial(degrees: FloatArray) -> tuple[float, float]:
    """Mean (0 to 180) and standard deviation of axial angles, degrees.

    Parameters
    ----------
    degrees : ndarray

    Returns
    -------
    mean, sd : float
        The standard deviation of the angles turned to within 90 degrees of the mean.
    """
    twice = np.radians(2 * degrees)
    mean = float(np.degrees(np.arctan2(np.sin(twice).mean(), np.cos(twice).mean())) / 2)
    offset = (degrees - mean + 90) % 180 - 90
    return (mean + float(offset.mean())) % 180, float(offset.std())


@dataclass(frozen=True)
class Posterior:
    """Posterior of one clip.

    Attributes
    ----------
    quality : Quality
        GOOD, NO_RIPPLES, NOT_CONVERGED, NOT_IDENTIFIABLE or TOO_FEW_PIXELS.
    prior : Prior
        Prior of (f, A_H) that was used.
    draws : Dataset (chain, draw)
        ``frequency`` (cycles/m), ``height`` (A_H, m), ``azimuth`` (crest normal, degrees clockwise
        from grid north, unwrapped about its mean), and the other parameters of
        :class:`sasmap.ripples.rendering.Parameters` but for the wave offset; empty where no ripple
        was sampled.
    acceptance : float
        Accepted fraction of the independence proposals of the kept draws.
    left_out : LeftOut
        Steps that were left out.
    probability : float
        Probability that the clip is rippled.
    shape : Shape or None
        Shape of the crests; None without draws.
    model : ndarray (rows, columns) or None
        Posterior mean of the amplitude, in the clip's units, if requested; NaN where the geometry
        is unknown or there are no ripples.
    reason : str
        Why the clip is inconclusive, in words; empty where it is not.
    rippled : ndarray (rows, columns) or None
        Probability that a pixel lies on rippled floor, NaN at invalid pixels; None without draws.
    second : Dataset (chain, draw)
        As `draws`, for a second system of ripples; empty where there is no evidence of one.
    reference : tuple of float
        Quantities from which `rippled` was computed: wave vector (east, north), cycles/m, and
        :attr:`sasmap.ripples.extent.Extent.own`. Empty without draws.
    """

    quality: Quality
    prior: Prior
    draws: xr.Dataset = field(default_factory=xr.Dataset)
    acceptance: float = float("nan")
    left_out: LeftOut = NOTHING
    probability: float = float("nan")
    shape: Shape | None = None
    model: FloatArray | None = None
    reason: str = ""
    rippled: FloatArray | None = None
    reference: tuple[float, ...] = ()
    second: xr.Dataset = field(default_factory=xr.Dataset)

    @property
    def sampled(self) -> bool:
        """Whether there are draws."""
        return bool(self.draws.sizes)

    @property
    def mean(self) -> xr.Dataset:
        """Posterior means (of f, cycles/m, A_H, m, and the rest)."""
        return self.draws.mean()

    @property
    def sd(self) -> xr.Dataset:
        """Posterior standard deviations."""
        return self.draws.std(ddof=1)

    @property
    def quantiles(self) -> xr.Dataset:
        """Posterior quantiles 0.05, 0.5 and 0.95 along ``quantile``."""
        return self.draws.quantile(QUANTILES)

    @property
    def azimuth(self) -> tuple[float, float]:
        """Axial mean (0 to 180) and standard deviation of the crest normal's azimuth, degrees."""
        if "azimuth" not in self.draws:
            return float("nan"), float("nan")
        return axial(self.draws["azimuth"].values)

    def to_arviz(self) -> Any:
        """Convert the Markov chains for ArviZ, where it is installed.

        Returns
        -------
        InferenceData or DataTree
            With a group ``posterior`` of f (cycles/m), A_H (m) and the rest, by chain and draw.

        Raises
        ------
        ImportError
            Where ArviZ is not installed.
        ValueError
            Where nothing was sampled.
        """
        if not self.sampled:
            raise ValueError("nothing was sampled")
        values = {str(name): self.draws[name].values for name in self.draws}
        try:
            from arviz_base import from_dict  # part of ArviZ since 1.0

            return from_dict({"posterior": values})
        except ImportError:
            pass
        try:
            import arviz
        except ImportError:
            raise ImportError(
                "ArviZ is not installed: pip install arviz (or pip install 'sasmap[studies]')"
            ) from None
        return arviz.from_dict(posterior=values)

    @property
    def _judged(self) -> dict[str, FloatArray]:
        return {name: self.draws[name].values for name in JUDGED if name in self.draws}

    @property
    def rhat(self) -> dict[str, float]:
        """Rank-normalised split R-hat of f, A_H and the azimuth."""
        return {name: diagnostics.rhat(v) for name, v in self._judged.items()}

    @property
    def ess_bulk(self) -> dict[str, float]:
        """Bulk effective sample size of f, A_H and the azimuth."""
        return {name: diagnostics.ess_bulk(v) for name, v in self._judged.items()}

    @property
    def ess_tail(self) -> dict[str, float]:
        """Tail effective sample size of f, A_H and the azimuth."""
        return {name: diagnostics.ess_tail(v) for name, v in self._judged.items()}


def converged(draws: FloatArray) -> bool:
    """Whether draws (chain, draw) reach R-hat <= 1.01 and bulk and tail ESS >= 400."""
    return (
        diagnostics.rhat(draws) <= MAX_RHAT
        and diagnostics.ess_bulk(draws) >= MIN_ESS
        and diagnostics.ess_tail(draws) >= MIN_ESS
    )


UNITS = {
    "frequency": "cycles/m",
    "height": "m",
    "azimuth": "degrees",
    "phase": "rad",
    "blur": "cycles",
}


def dataset(draws: Mapping[str, FloatArray]) -> xr.Dataset:
    """Label draws (chain, draw) of named parameters with their units, 1 where they have none."""
    shape = next(iter(draws.values())).shape
    return xr.Dataset(
        {
            name: (("chain", "draw"), values, {"units": UNITS.get(name, "1")})
            for name, values in draws.items()
        },
        coords={"chain": np.arange(shape[0]), "draw": np.arange(shape[1])},
    )
