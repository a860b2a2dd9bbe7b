"""Passes: the posterior of one look is the prior of the next (ZC 4.2)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sasmap.ripples.likelihood import STEEPEST, Prior
from sasmap.ripples.posterior import JUDGED, LeftOut, Posterior, Quality
from sasmap.ripples.settings import RippleSettings

# Change and misregistration between two passes, as a fraction of f and A_H (standard deviation).
SCATTER = (0.002, 0.02)
# The same of the azimuth, degrees.
AZIMUTH_SCATTER = 0.5
# What Zare and Cobb set by hand: cycles/m and m.
PUBLISHED_SD = (0.003, 0.17)

NAN = float("nan")


@dataclass(frozen=True)
class Summary:
    """What is kept of a posterior: numbers only; NaN where there are no ripples.

    Attributes
    ----------
    mean, sd, q05, q95, prior_mean, prior_sd : tuple of float
        Of f (cycles/m) and A_H (m).
    rhat, ess_bulk, ess_tail : tuple of float
        Of f, A_H and the azimuth.
    correlation : float
        Between f and A_H.
    azimuth : tuple of float
        Axial mean and standard deviation of the crest normal's, degrees clockwise from grid north.
    probability : float
        That the cell is rippled.
    coherence_length : float
        m.
    rippled_fraction, noise_factor : float
    profile : str
        Empty without ripples.
    """

    quality: Quality
    left_out: LeftOut
    mean: tuple[float, float] = (NAN, NAN)
    sd: tuple[float, float] = (NAN, NAN)
    q05: tuple[float, float] = (NAN, NAN)
    q95: tuple[float, float] = (NAN, NAN)
    correlation: float = NAN
    prior_mean: tuple[float, float] = (NAN, NAN)
    prior_sd: tuple[float, float] = (NAN, NAN)
    rhat: tuple[float, float, float] = (NAN, NAN, NAN)
    ess_bulk: tuple[float, float, float] = (NAN, NAN, NAN)
    ess_tail: tuple[float, float, float] = (NAN, NAN, NAN)
    acceptance: float = NAN
    azimuth: tuple[float, float] = (NAN, NAN)
    prior_azimuth: tuple[float, float] = (NAN, NAN)
    probability: float = NAN
    coherence_length: float = NAN
    rippled_fraction: float = NAN
    noise_factor: float = NAN
    profile: str = ""


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
        prior_mean=posterior.prior.mean,
        prior_sd=posterior.prior.sd,
        rhat=_triple(posterior.rhat),
        ess_bulk=_triple(posterior.ess_bulk),
        ess_tail=_triple(posterior.ess_tail),
        acceptance=posterior.acceptance,
        azimuth=posterior.azimuth,
        prior_azimuth=posterior.prior.azimuth,
        probability=posterior.probability,
        **_shape(posterior),
    )


def _shape(posterior: Posterior) -> dict[str, Any]:
    shape = posterior.shape
    if shape is None:
        return {}
    return {
        "coherence_length": shape.coherence_length,
        "rippled_fraction": shape.rippled_fraction,
        "noise_factor": shape.noise_factor,
        "profile": shape.profile,
    }


def _triple(values: Mapping[str, float]) -> tuple[float, float, float]:
    first, second, third = (values.get(name, NAN) for name in JUDGED)
    return first, second, third


def _pair(values: Iterable[float]) -> tuple[float, float]:
    first, second = (float(v) for v in values)
    return first, second


def next_prior(earlier: Sequence[Summary], settings: RippleSettings) -> Prior:
    """Return the prior of a look, given what earlier looks at the same cell said.

    Parameters
    ----------
    earlier : sequence of Summary
        In order.
    settings : RippleSettings

    Returns
    -------
    Prior
        The last trusted posterior as a truncated Gaussian, widened by the scatter between passes
        (the published method takes its hand-set standard deviations instead); flat where there is
        none.
    """
    trusted = used(earlier, settings)
    if trusted is None:
        return Prior.flat(settings.frequency, settings.height)
    last = earlier[trusted]
    if settings.method == "zare-cobb":
        return Prior(last.mean, PUBLISHED_SD, (settings.frequency, settings.height))
    scatter = np.array(SCATTER) * np.array(last.mean)
    wide = np.hypot(last.sd, scatter)
    shrink = float(np.prod(np.array(last.sd) / wide)) if (wide > 0).all() else 0.0
    return Prior(
        last.mean,
        _pair(np.maximum(wide, 1e-12)),
        (settings.frequency, settings.height),
        float(np.clip(last.correlation * shrink, -0.999, 0.999)),
        (last.azimuth[0], float(np.hypot(last.azimuth[1], AZIMUTH_SCATTER))),
        STEEPEST,
    )


def used(summaries: Sequence[Summary], settings: RippleSettings) -> int | None:
    """Index of the look whose posterior stands for the cell so far, or None.

    The last one that converged; without any, the published method passes its last one on all the
    same.
    """
    good = [i for i, s in enumerate(summaries) if s.quality is Quality.GOOD]
    if not good and settings.method == "zare-cobb":
        good = [i for i, s in enumerate(summaries) if s.quality is Quality.NOT_CONVERGED]
    return good[-1] if good else None


def cell_quality(qualities: Sequence[Quality]) -> Quality:
    """Quality of a cell from those of its looks: the most telling one."""
    order = (
        Quality.FAILED,
        Quality.GOOD,
        Quality.NOT_CONVERGED,
        Quality.NO_RIPPLES,
        Quality.NOT_IDENTIFIABLE,
        Quality.TOO_FEW_PIXELS,
    )
    return next((q for q in order if q in qualities), Quality.NO_DATA)
