"""What is kept of a look at a cell: its posterior in numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sasmap.numerics.gaussians import Mixture
from sasmap.ripples.derived import UNKNOWN, Derived, derived_of_draws
from sasmap.ripples.mixture import fit_mixture
from sasmap.ripples.posterior import JUDGED, LeftOut, Posterior, Quality

NAN = float("nan")
LAW = ("exponent", "concentration", "peakedness", "asymmetry")
Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Summary:
    """What is kept of the posterior of one look: numbers only; NaN where there are no ripples.

    Attributes
    ----------
    mean, sd, q05, q95 : tuple of float
        Of f (cycles/m) and A_H (m), by this look alone (with the published method: combined).
    derived : Derived
        Wavelength and steepness.
    rhat, ess_bulk, ess_tail : tuple of float
        Of f, A_H and the azimuth.
    correlation : float
        Between f and A_H.
    azimuth : tuple of float
        Axial mean and standard deviation of the crest normal's, degrees clockwise from grid north.
    mixture : tuple of tuple of float
        Gaussian mixture of (f, A_H, azimuth in degrees): of each component its weight, mean and
        covariance by rows. Empty without ripples.
    probability : float
        That the cell is rippled.
    coherence_length : float
        m.
    rippled_fraction, noise_factor : float
    exponent, exponent_sd, concentration, concentration_sd : float
        Of the scattering law sin^n(theta) exp(-c (theta - pi/2)^2), by this look alone.
    peakedness, asymmetry : float
        Second harmonics of the crest profile over A_H.
    """

    quality: Quality
    left_out: LeftOut
    mean: tuple[float, float] = (NAN, NAN)
    sd: tuple[float, float] = (NAN, NAN)
    q05: tuple[float, float] = (NAN, NAN)
    q95: tuple[float, float] = (NAN, NAN)
    correlation: float = NAN
    rhat: tuple[float, float, float] = (NAN, NAN, NAN)
    ess_bulk: tuple[float, float, float] = (NAN, NAN, NAN)
    ess_tail: tuple[float, float, float] = (NAN, NAN, NAN)
    acceptance: float = NAN
    azimuth: tuple[float, float] = (NAN, NAN)
    derived: Derived = UNKNOWN
    mixture: tuple[Numbers, ...] = ()
    probability: float = NAN
    coherence_length: float = NAN
    rippled_fraction: float = NAN
    noise_factor: float = NAN
    exponent: float = NAN
    exponent_sd: float = NAN
    concentration: float = NAN
    concentration_sd: float = NAN
    peakedness: float = NAN
    asymmetry: float = NAN

    @property
    def density(self) -> Mixture | None:
        """The mixture, or None without one."""
        if not self.mixture:
            return None
        rows = np.array(self.mixture)
        return Mixture(rows[:, 0], rows[:, 1:4], rows[:, 4:].reshape(-1, 3, 3))


def summarise(posterior: Posterior) -> Summary:
    """Reduce a posterior to the numbers that products and later passes need.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    Summary
    """
    if not posterior.sampled:
        return Summary(posterior.quality, posterior.left_out, probability=posterior.probability)
    draws = [posterior.draws[name].values for name in ("frequency", "height")]
    q05, q95 = (tuple(float(np.quantile(d, p)) for d in draws) for p in (0.05, 0.95))
    spread = [float(d.std(ddof=1)) for d in draws]
    both = all(s > 0 for s in spread)
    correlation = float(np.corrcoef(draws[0].ravel(), draws[1].ravel())[0, 1]) if both else 0.0
    return Summary(
        posterior.quality,
        posterior.left_out,
        mean=_pair(float(d.mean()) for d in draws),
        sd=_pair(spread),
        q05=_pair(q05),
        q95=_pair(q95),
        correlation=correlation,
        rhat=_triple(posterior.rhat),
        ess_bulk=_triple(posterior.ess_bulk),
        ess_tail=_triple(posterior.ess_tail),
        acceptance=posterior.acceptance,
        azimuth=posterior.azimuth,
        mixture=_mixture(posterior),
        derived=derived_of_draws(*draws),
        probability=posterior.probability,
        **_shape(posterior),
        **_law(posterior),
    )


def _mixture(posterior: Posterior) -> tuple[Numbers, ...]:
    if "azimuth" not in posterior.draws:
        return ()
    draws = [posterior.draws[name].values.ravel() for name in JUDGED]
    turn = posterior.azimuth[0] - draws[2]  # about the axial mean, which is from 0 to 180
    draws[2] = posterior.azimuth[0] - (turn - 180 * np.rint(turn / 180))
    fitted = fit_mixture(np.stack(draws, axis=1))
    return tuple(
        (float(w), *(float(v) for v in m), *(float(v) for v in c.ravel()))
        for w, m, c in zip(*fitted, strict=True)
    )


def _law(posterior: Posterior) -> dict[str, float]:
    """Scattering law and crest profile, where they are part of the posterior."""
    if "exponent" not in posterior.draws:
        return {}
    mean, sd = posterior.mean, posterior.sd
    found = {name: float(mean[name]) for name in LAW}
    return found | {f"{name}_sd": float(sd[name]) for name in LAW[:2]}


def _shape(posterior: Posterior) -> dict[str, Any]:
    shape = posterior.shape
    if shape is None:
        return {}
    return {
        "coherence_length": shape.coherence_length,
        "rippled_fraction": shape.rippled_fraction,
        "noise_factor": shape.noise_factor,
    }


def _triple(values: Mapping[str, float]) -> tuple[float, float, float]:
    first, second, third = (values.get(name, NAN) for name in JUDGED)
    return first, second, third


def _pair(values: Iterable[float]) -> tuple[float, float]:
    first, second = (float(v) for v in values)
    return first, second
