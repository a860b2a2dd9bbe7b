"""Summary of the posterior of a look at a cell, in numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.numerics.gaussians import Mixture
from sasmap.passes.derived import UNKNOWN, Derived, derived_of_draws
from sasmap.passes.mixture import fit_mixture
from sasmap.ripples.diagnostics import ess_bulk
from sasmap.ripples.posterior import JUDGED, LeftOut, Posterior, Quality, axial

NAN = float("nan")
LAW = ("exponent", "concentration", "peakedness", "asymmetry")
Numbers = tuple[float, ...]
# Floor of the contrast per slope: any law that grows with grazing angle has more.
LEAST_CONTRAST = 0.05
# Prior of the change of log A_H with log altitude, mean and standard deviation: 0.5 to 0.92 in
# eight coherent cells (5 to 35 m, A_H 0.04 to 0.09 m), estimated from draws with an altitude error
# of 0.4 m.
ALTITUDE_GAIN = (0.75, 0.15)


@dataclass(frozen=True)
class Summary:
    """Summary of the posterior of one look: numbers only; NaN where there are no ripples.

    Attributes
    ----------
    mean, sd, q05, q95 : tuple of float
        Of f (cycles/m) and A_H (m), from this look alone (with the published method: combined).
    derived : Derived
        Wavelength and steepness.
    rhat, ess_bulk, ess_tail : tuple of float
        Of f, A_H and the azimuth.
    correlation : float
        Between f and A_H.
    azimuth : tuple of float
        Axial mean and standard deviation of the crest normal's azimuth, degrees clockwise from grid
        north.
    mixture : tuple of tuple of float
        Gaussian mixture over log f, log contrast, azimuth in degrees, and exponent and
        concentration of the law; over log f, log A_H and azimuth where the law is fixed. For each
        component its weight, mean, and covariance by rows. Empty without ripples.
    reach : tuple of float
        Least and largest A_H (m) of the draws, where the mixture ends: the absence of shadow bounds
        A_H sharply, which Gaussians do not.
    probability : float
        Probability that the cell is rippled.
    coherence_length : float
        m.
    rippled_fraction, noise_factor : float
    exponent, exponent_sd, concentration, concentration_sd : float
        Of the scattering law sin^n(theta) exp(-c (theta - pi/2)^2), from this look alone.
    peakedness, asymmetry : float
        Second harmonics of the crest profile over A_H.
    defect_density : float
        Number of places per square metre of rippled floor where crests split or end.
    reason : str
        Why the look cannot show whether there are ripples, in words; empty where it can.
    second_mean, second_sd : tuple of float
        Of f (cycles/m), A_H (m) and the azimuth (degrees) of a second system of ripples.
    window : float
        Side length of the estimated area in cells; above 1 where a wave is too long for one cell.
    tangent, altitude : float
        Tangent of the grazing angle, and altitude of the sonar, m, at the clip's middle.
    altitude_gain, altitude_sd : float
        Change of log A_H with log altitude; accuracy of the altitude, m.
    crest_phase : tuple of float
        Phase of the ripple at `centre`, cycles along the crest normal's azimuth from 0 to 180
        degrees (h is A_H sin of 2 pi times it), and its circular standard deviation.
    centre : tuple of float
        Map position (east, north) of the clip's centre, m.
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
    reach: tuple[float, float] = (0.0, float("inf"))
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
    defect_density: float = NAN
    reason: str = ""
    second_mean: tuple[float, float, float] = (NAN, NAN, NAN)
    second_sd: tuple[float, float, float] = (NAN, NAN, NAN)
    window: float = 1.0
    tangent: float = 1.0
    altitude: float = 1.0
    altitude_gain: float = 0.0
    altitude_sd: float = 0.0
    crest_phase: tuple[float, float] = (NAN, NAN)
    centre: tuple[float, float] = (NAN, NAN)

    @property
    def density(self) -> Mixture | None:
        """The mixture, or None without one."""
        if not self.mixture:
            return None
        rows = np.array(self.mixture)
        size = 5 if rows.shape[1] == 31 else 3
        square = rows[:, size + 1 :].reshape(-1, size, size)
        return Mixture(rows[:, 0], rows[:, 1 : size + 1], square)


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
        return Summary(
            posterior.quality,
            posterior.left_out,
            probability=posterior.probability,
            reason=posterior.reason,
        )
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
        reach=_pair((draws[1].min(), draws[1].max())),
        derived=derived_of_draws(*draws),
        probability=posterior.probability,
        **_second(posterior),
        **_shape(posterior),
        **_law(posterior),
    )


def _mixture(posterior: Posterior) -> tuple[Numbers, ...]:
    if "azimuth" not in posterior.draws:
        return ()
    draws = posterior.draws
    azimuth = draws["azimuth"].values.ravel()
    turn = posterior.azimuth[0] - azimuth  # about the axial mean, which is from 0 to 180
    columns = [
        np.log(draws["frequency"].values.ravel()),
        np.log(draws["height"].values.ravel()),
        posterior.azimuth[0] - (turn - 180 * np.rint(turn / 180)),
    ]
    law = [draws[name].values.ravel() for name in LAW[:2]]
    if min(np.ptp(v) for v in law) > 0:
        assert posterior.shape is not None
        columns[1] = columns[1] + log_contrast(np.stack(law, axis=-1), posterior.shape.tangent)
        columns += law
    fitted = fit_mixture(np.stack(columns, axis=1))
    return tuple(
        (float(w), *(float(v) for v in m), *(float(v) for v in c.ravel()))
        for w, m, c in zip(*fitted, strict=True)
    )


def log_contrast(law: FloatArray, tangent: FloatArray | float) -> FloatArray:
    """Log of the relative change of intensity with slope, to first order.

    Parameters
    ----------
    law : ndarray (..., 2)
        n and c.
    tangent : ndarray or float
        Tangent of the grazing angle; broadcasts against the law's leading axes.

    Returns
    -------
    ndarray (...)
        As :func:`sasmap.ripples.rendering.contrast_per_slope`.
    """
    n, c = law[..., 0], law[..., 1]
    per_slope = n / tangent + 2 * c * (0.5 * np.pi - np.arctan(tangent)) + tangent
    return np.asarray(np.log(np.maximum(per_slope, LEAST_CONTRAST)))


def contrast_slopes(law: FloatArray, tangent: FloatArray | float) -> FloatArray:
    """Return the derivatives of :func:`log_contrast` with respect to n and c (..., 2)."""
    per_slope = np.exp(log_contrast(law, tangent))
    each = np.broadcast_arrays(1 / tangent, 2 * (0.5 * np.pi - np.arctan(tangent)))
    return np.asarray(np.stack(each, axis=-1) / per_slope[..., None])


def _law(posterior: Posterior) -> dict[str, Any]:
    """Scattering law and crest profile, where they are part of the posterior."""
    if "exponent" not in posterior.draws:
        return {}
    mean, sd = posterior.mean, posterior.sd
    found = {name: float(mean[name]) for name in LAW}
    return found | {f"{name}_sd": float(sd[name]) for name in LAW[:2]}


def _second(posterior: Posterior) -> dict[str, Any]:
    """Means and standard deviations of a second system of ripples, where there is one."""
    draws = posterior.second
    if not draws.sizes:
        return {}
    (f, f_sd), (height, height_sd) = (
        (float(draws[name].mean()), float(draws[name].std(ddof=1))) for name in JUDGED[:2]
    )
    azimuth, azimuth_sd = axial(draws["azimuth"].values)
    return {"second_mean": (f, height, azimuth), "second_sd": (f_sd, height_sd, azimuth_sd)}


def _shape(posterior: Posterior) -> dict[str, Any]:
    shape = posterior.shape
    if shape is None:
        return {}
    return {
        "coherence_length": shape.coherence_length,
        "rippled_fraction": shape.rippled_fraction,
        "noise_factor": shape.noise_factor,
        "defect_density": shape.defect_density,
        "tangent": shape.tangent,
        "altitude": shape.altitude,
        "altitude_sd": shape.altitude_sd,
        "altitude_gain": _altitude_gain(posterior),
        "crest_phase": _crest_phase(posterior),
        "centre": shape.centre,
    }


def _crest_phase(posterior: Posterior) -> tuple[float, float]:
    """Circular mean and standard deviation of the phase, cycles."""
    mean = np.exp(1j * posterior.draws["phase"].values).mean()
    sd = np.sqrt(-2 * np.log(min(abs(mean), 1.0)))
    return float(np.angle(mean) / (2 * np.pi) % 1.0), float(sd / (2 * np.pi))


def _altitude_gain(posterior: Posterior) -> float:
    """Change of log A_H with log altitude: the slope over the draws, shrunk to its prior mean.

    Where the altitude is known well, the draws alone determine it to ± 1 or worse.
    """
    scale, height = (np.log(posterior.draws[name].values) for name in ("altitude_scale", "height"))
    variance = float(scale.var())
    if variance < 1e-16:
        return 0.0
    slope = float(((scale - scale.mean()) * (height - height.mean())).mean() / variance)
    usual, sd = ALTITUDE_GAIN
    told = ess_bulk(height) * variance / max(float((height - slope * scale).var()), 1e-16)
    return (slope * told + usual / sd**2) / (told + 1 / sd**2)


def _triple(values: Mapping[str, float]) -> tuple[float, float, float]:
    first, second, third = (values.get(name, NAN) for name in JUDGED)
    return first, second, third


def _pair(values: Iterable[float]) -> tuple[float, float]:
    first, second = (float(v) for v in values)
    return first, second
