"""Passes combined: what one look learned, the next one starts from (ZC 4.2; docs/science.md).

Each look's posterior of (f, A_H, azimuth) under the survey's own flat prior is a Gaussian mixture.
What a cell knows after several looks is the product of theirs, each widened by a scatter for change
and misregistration, truncated to the survey's bounds: the posterior after one look is the prior of
the next. A product knows no order. Looks that no common value explains are kept apart: the largest
group that agrees stands for the cell.

The published method hands a Gaussian of hand-set width from look to look instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sasmap.numerics.gaussians import Mixture
from sasmap.ripples.derived import UNKNOWN as UNDERIVED
from sasmap.ripples.derived import Derived, derived_of_mixture
from sasmap.ripples.mixture import disagreement, marginal, product, widened
from sasmap.ripples.posterior import Quality
from sasmap.ripples.priors import Prior
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.summary import NAN, Summary

# What Zare and Cobb set by hand: cycles/m and m.
PUBLISHED_SD = (0.003, 0.17)
# Squared Mahalanobis distance (chi-squared with 3 degrees of freedom) beyond which two looks
# contradict each other: one in a million by chance, were their posteriors Gaussian.
LIMIT = 30.0
# Looks of which every group is tried; of more, one at a time is dropped.
MOST_TRIED = 10


@dataclass(frozen=True)
class CellEstimate:
    """What is known of a cell.

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
# The prior of a first look: flat.
FLAT = CellEstimate(sd=(float("inf"),) * 2, azimuth=(NAN, float("inf")))


@dataclass(frozen=True)
class FusedCell:
    """A cell's looks, combined.

    Attributes
    ----------
    priors, posteriors : tuple of CellEstimate
        Before and after each look, in their order; unknown where no look has told anything yet.
    disagreements : tuple of float
        Squared Mahalanobis distance of each look from all others that agree with each other
        (chi-squared with 3 degrees of freedom by chance); NaN without others.
    group : tuple of int
        Looks that stand for the cell.
    final : CellEstimate
    quality : Quality
    qualities : tuple of Quality
        Of each look; one that disagrees with the cell's group, and all where no majority agrees,
        contradict each other.
    """

    priors: tuple[CellEstimate, ...]
    posteriors: tuple[CellEstimate, ...]
    disagreements: tuple[float, ...]
    group: tuple[int, ...]
    final: CellEstimate
    quality: Quality
    qualities: tuple[Quality, ...]


def fuse(summaries: Sequence[Summary | None], settings: RippleSettings) -> FusedCell:
    """FusedCell the looks at a cell.

    Parameters
    ----------
    summaries : sequence of Summary or None
        One a look, None where it does not show the cell.
    settings : RippleSettings

    Returns
    -------
    FusedCell
    """
    quality = cell_quality([s.quality for s in summaries if s is not None])
    if settings.method == "zare-cobb":
        return _published(summaries, settings, quality)
    looks = {k: m for k, s in enumerate(summaries) if (m := _trusted(s)) is not None}
    turned = _about_one_axis(looks)
    wide = {k: widened(m, _scatter(m, settings)) for k, m in turned.items()}
    group = _agreeing(wide)
    qualities = _qualities(summaries)
    if len(group) < len(looks):
        quality = Quality.CONTRADICTION if quality is Quality.GOOD else quality
        lost = looks if 2 * len(group) <= len(looks) else looks.keys() - set(group)
        qualities = tuple(
            Quality.CONTRADICTION if k in lost else q for k, q in enumerate(qualities)
        )
    known: list[CellEstimate] = []
    together: Mixture | None = None
    # the only look is known by its own draws, better than by their mixture
    only = summaries[group[0]] if len(group) == 1 else None
    for k in range(len(summaries)):
        if k in group:
            together = wide[k] if together is None else product(together, wide[k])
        known.append(_known(together, only, settings))
    final = known[-1] if known else UNKNOWN
    if not group:
        group, final = _doubtful(summaries)
    if quality is Quality.FAILED:
        group, final = (), UNKNOWN
    return FusedCell(
        tuple(FLAT if k is UNKNOWN else k for k in (UNKNOWN, *known))[: len(known)],
        tuple(known),
        tuple(_apart(wide, group, k) for k in range(len(summaries))),
        group,
        final,
        quality,
        qualities,
    )


def _qualities(summaries: Sequence[Summary | None]) -> tuple[Quality, ...]:
    return tuple(Quality.NO_DATA if s is None else s.quality for s in summaries)


def _trusted(summary: Summary | None) -> Mixture | None:
    if summary is None or summary.quality is not Quality.GOOD:
        return None
    return summary.density


def _about_one_axis(looks: dict[int, Mixture]) -> dict[int, Mixture]:
    """Turn azimuths, which are axial, to within 90 degrees of their common mean."""
    if not looks:
        return {}
    twice = [np.radians(2 * m.weight @ m.mean[:, 2]) for m in looks.values()]
    centre = np.degrees(np.arctan2(np.sin(twice).mean(), np.cos(twice).mean())) / 2
    result = {}
    for k, m in looks.items():
        turn = 180 * np.rint((m.weight @ m.mean[:, 2] - centre) / 180)
        result[k] = m._replace(mean=m.mean - np.array([0, 0, turn]))
    return result


def _scatter(mixture: Mixture, settings: RippleSettings) -> NDArray[np.float64]:
    mean = mixture.weight @ mixture.mean
    of_f, of_height, degrees = settings.scatter
    return np.array([of_f * mean[0], of_height * mean[1], degrees])


def _agreeing(looks: dict[int, Mixture]) -> tuple[int, ...]:
    """Return the largest group of looks that all agree with each other; the surest of equals."""
    every = tuple(sorted(looks))
    agree = {p: disagreement(looks[p[0]], looks[p[1]]) <= LIMIT for p in combinations(every, 2)}

    def good(group: tuple[int, ...]) -> bool:
        return all(agree[pair] for pair in combinations(group, 2))

    while len(every) > MOST_TRIED and not good(every):
        friends = {k: sum(agree[p] for p in combinations(every, 2) if k in p) for k in every}
        lonely = min(every, key=lambda k: (friends[k], k))
        every = tuple(k for k in every if k != lonely)
    if good(every):
        return every
    for size in range(len(every) - 1, 0, -1):
        groups = [g for g in combinations(every, size) if good(g)]
        if groups:
            return min(groups, key=lambda g: sum(_spread(looks[k]) for k in g))
    return ()


def _spread(mixture: Mixture) -> float:
    """Log volume of a density."""
    mean = mixture.weight @ mixture.mean
    offset = mixture.mean - mean
    covariance = np.einsum("k,kij->ij", mixture.weight, mixture.covariance)
    covariance += (mixture.weight[:, None] * offset).T @ offset
    return float(np.linalg.slogdet(covariance)[1])


def _apart(looks: dict[int, Mixture], group: tuple[int, ...], k: int) -> float:
    others = [looks[j] for j in group if j != k and j in looks]
    if k not in looks or not others:
        return NAN
    together = others[0]
    for other in others[1:]:
        together = product(together, other)
    return disagreement(looks[k], together)


def _known(
    together: Mixture | None, only: Summary | None, settings: RippleSettings
) -> CellEstimate:
    if together is None:
        return UNKNOWN
    if only is not None:
        return of_summary(only)
    bounds = (settings.frequency, settings.height)
    f, height = (marginal(together, i, bounds[i]) for i in range(2))
    turn = marginal(together, 2, (-np.inf, np.inf))
    return CellEstimate(
        (f.mean, height.mean),
        (f.sd, height.sd),
        (f.q05, height.q05),
        (f.q95, height.q95),
        (turn.mean % 180, turn.sd),
        derived_of_mixture(together, *bounds),
    )


def of_summary(summary: Summary) -> CellEstimate:
    """Return what a look alone knows."""
    s = summary
    return CellEstimate(s.mean, s.sd, s.q05, s.q95, s.azimuth, s.derived)


def _doubtful(summaries: Sequence[Summary | None]) -> tuple[tuple[int, ...], CellEstimate]:
    """Better a flagged value than none: of looks not converged, the one that came nearest."""
    found = {
        k: float(np.nan_to_num(min(s.ess_bulk)))
        for k, s in enumerate(summaries)
        if s is not None and s.quality is Quality.NOT_CONVERGED
    }
    if not found:
        return (), UNKNOWN
    best = max(found, key=lambda k: found[k])
    summary = summaries[best]
    assert summary is not None
    return (best,), of_summary(summary)


def next_prior(earlier: Sequence[Summary | None], settings: RippleSettings) -> Prior:
    """Return the prior that a look is sampled under, given what earlier looks said.

    Parameters
    ----------
    earlier : sequence of Summary or None
        In order.
    settings : RippleSettings

    Returns
    -------
    Prior
        The survey's flat prior: what looks know is multiplied afterwards. With the published
        method the last posterior, as a Gaussian of hand-set width.
    """
    index = _last_published(earlier) if settings.method == "zare-cobb" else None
    last = None if index is None else earlier[index]
    if last is None:
        flat = settings.method == "zare-cobb"
        return (Prior.flat if flat else Prior.natural)(settings.frequency, settings.height)
    return Prior(last.mean, PUBLISHED_SD, (settings.frequency, settings.height))


def _last_published(summaries: Sequence[Summary | None]) -> int | None:
    found = [
        k
        for k, s in enumerate(summaries)
        if s is not None and s.quality in (Quality.GOOD, Quality.NOT_CONVERGED)
    ]
    return found[-1] if found else None


def _published(
    summaries: Sequence[Summary | None], settings: RippleSettings, quality: Quality
) -> FusedCell:
    priors: list[CellEstimate] = []
    posteriors: list[CellEstimate] = []
    for k, summary in enumerate(summaries):
        index = _last_published(summaries[:k])
        prior = next_prior(summaries[:k], settings)
        priors.append(FLAT if index is None else CellEstimate(prior.mean, PUBLISHED_SD))
        known = summary is not None and summary.quality in (Quality.GOOD, Quality.NOT_CONVERGED)
        posteriors.append(of_summary(summary) if known and summary else (*posteriors, UNKNOWN)[-1])
    last = _last_published(summaries)
    nothing = (NAN,) * len(summaries)
    failed = quality is Quality.FAILED or last is None
    group = () if failed or last is None else (last,)
    final = UNKNOWN if failed else posteriors[-1]
    qualities = _qualities(summaries)
    return FusedCell(tuple(priors), tuple(posteriors), nothing, group, final, quality, qualities)


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
