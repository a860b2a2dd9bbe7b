"""Combination of the looks at a cell, given the survey's shared parameters.

The likelihood of (f, A_H, azimuth) from a look, under the survey's law, is a Gaussian mixture. The
posterior after several looks is the product of their likelihoods, each widened by a scatter for
change and misregistration, and of the prior (Zare and Cobb 2013, 4.2: the posterior after one look
is the prior of the next). It does not depend on the order of looks. It is averaged over the
posterior of the shared parameters. Looks that contradict each other are not combined: the largest
group that agrees is used for the cell.

The published method passes a Gaussian of fixed width from look to look instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sasmap.arrays import IntArray
from sasmap.passes.agreement import agreeing, distances_of, together
from sasmap.passes.cell_estimate import FLAT, UNKNOWN, CellEstimate, estimates, of_summary
from sasmap.passes.combination import after_each, reach_after_each
from sasmap.passes.looks import Looks, collect
from sasmap.passes.registration import Moves, left_over, registration
from sasmap.passes.shared import LEAST_LOOKS, MOST_SEDIMENTS, SurveyModel, learn, numbered
from sasmap.passes.summary import NAN, Summary
from sasmap.ripples.posterior import Quality
from sasmap.ripples.priors import Prior
from sasmap.ripples.settings import RippleSettings

# Standard deviations of f and A_H that Zare and Cobb (2013) set by hand: cycles/m and m.
PUBLISHED_SD = (0.003, 0.17)
# Number of cells that are combined at once, to bound memory.
CHUNK = 200


@dataclass(frozen=True)
class FusedCell:
    """The combined looks of a cell.

    Attributes
    ----------
    priors, posteriors : tuple of CellEstimate
        Before and after each look, in order; flat before the first informative look.
    disagreements : tuple of float
        Squared Mahalanobis distance of each look from the nearest other look of the agreeing group
        (chi-squared with 3 degrees of freedom by chance); NaN without others.
    group : tuple of int
        Looks that the estimate is based on.
    final : CellEstimate
    migration : tuple of (float, float)
        Displacement of the crests of each look from those of the first of the group, m along the
        azimuth from 0 to 180 degrees, and its standard deviation; modulo a wavelength, with the
        passes' registration removed. NaN for looks outside the group.
    quality : Quality
    qualities : tuple of Quality
        Quality of each look; a look that disagrees with the cell's group has CONTRADICTION, and all
        looks have it where no majority agrees.
    registration : tuple of (float, float)
        Shift of each pass relative to the map, east and north, m, from the crests of all cells;
        empty where they do not agree on one.
    """

    priors: tuple[CellEstimate, ...]
    posteriors: tuple[CellEstimate, ...]
    disagreements: tuple[float, ...]
    group: tuple[int, ...]
    final: CellEstimate
    migration: tuple[tuple[float, float], ...]
    quality: Quality
    qualities: tuple[Quality, ...]
    registration: tuple[tuple[float, float], ...] = ()


def learn_survey(
    cells: Sequence[Sequence[Summary | None]],
    settings: RippleSettings,
    seed: int = 0,
    classes: Sequence[int] | None = None,
) -> SurveyModel:
    """Estimate the shared parameters of a survey; see :func:`sasmap.passes.shared.learn`.

    Parameters
    ----------
    cells : sequence of sequence of Summary or None
        For each cell one per swath, None where the swath does not show the cell.
    settings : RippleSettings
    seed : int
    classes : sequence of int, optional
        Mapped sediment of each cell, from 1; 0 where it has several or none.

    Returns
    -------
    SurveyModel
    """
    swaths = max((len(c) for c in cells), default=0)
    scatter = None if settings.scatter is None else np.array(settings.scatter, float)
    if settings.method == "zare-cobb":
        return learn(None, swaths, scatter, seed)
    sediments = _with_laws(cells, classes)
    looks = collect(cells, numbered(classes, sediments))
    return learn(looks, swaths, scatter, seed, sediments)


def _with_laws(
    cells: Sequence[Sequence[Summary | None]], classes: Sequence[int] | None
) -> tuple[int, ...]:
    """Choose the mapped classes with enough good looks for their own law; none if only one has."""
    if classes is None:
        return ()
    count: Counter[int] = Counter()
    for one, summaries in zip(classes, cells, strict=True):
        count[one] += sum(s is not None and s.quality is Quality.GOOD for s in summaries)
    enough = [one for one in sorted(count) if one and count[one] >= LEAST_LOOKS]
    most = sorted(enough, key=lambda one: -count[one])[:MOST_SEDIMENTS]
    return tuple(sorted(most)) if len(most) > 1 else ()


def fuse(
    summaries: Sequence[Summary | None],
    settings: RippleSettings,
    survey: SurveyModel | None = None,
) -> FusedCell:
    """Combine the looks at one cell, as :func:`fuse_cells` does for several."""
    return fuse_cells([summaries], settings, survey)[0]


def fuse_cells(
    cells: Sequence[Sequence[Summary | None]],
    settings: RippleSettings,
    survey: SurveyModel | None = None,
    classes: Sequence[int] | None = None,
) -> list[FusedCell]:
    """Combine the looks at each cell.

    Parameters
    ----------
    cells : sequence of sequence of Summary or None
        For each cell one per swath, None where the swath does not show the cell.
    settings : RippleSettings
    survey : SurveyModel, optional
        Shared parameters; estimated from these cells by default.
    classes : sequence of int, optional
        Mapped sediment of each cell, as in :func:`learn_survey`.

    Returns
    -------
    list of FusedCell
    """
    if settings.method == "zare-cobb":
        return [_published(summaries, settings) for summaries in cells]
    survey = survey or learn_survey(cells, settings, classes=classes)
    sediment = numbered(classes, survey.sediments)
    # process cells together whose looks have equally many components, so that padding is small
    size = [max((len(s.mixture) for s in c if s is not None), default=0) for c in cells]
    order = np.argsort(size, kind="stable")
    found: dict[int, FusedCell] = {}
    for first in range(0, len(cells), CHUNK):
        part = [int(i) for i in order[first : first + CHUNK]]
        of_part = None if sediment is None else sediment[part]
        fused = _fused([cells[i] for i in part], settings, survey, of_part)
        found.update(zip(part, fused, strict=True))
    return _registered([found[i] for i in range(len(cells))])


def _registered(fused: list[FusedCell]) -> list[FusedCell]:
    """Separate shifts of passes, which all cells share, from the migration of crests."""
    places = [
        (i, k)
        for i, c in enumerate(fused)
        for k in c.group[1:]
        if np.isfinite(c.migration[k][0]) and np.isfinite(c.final.azimuth[0])
    ]
    if not places:
        return fused
    turn = np.radians([fused[i].final.azimuth[0] for i, _ in places])
    moved = np.array([fused[i].migration[k] for i, k in places])
    moves = Moves(
        np.array([fused[i].group[0] for i, _ in places]),
        np.array([k for _, k in places]),
        moved[:, 0],
        moved[:, 1],
        1 / np.array([fused[i].final.mean[0] for i, _ in places]),
        np.column_stack([np.sin(turn), np.cos(turn)]),
    )
    shifts = registration(moves, max(len(c.migration) for c in fused))
    if not shifts.any():
        return fused
    left = [list(c.migration) for c in fused]
    for (i, k), rest, sd in zip(places, left_over(moves, shifts), moves.sd, strict=True):
        left[i][k] = float(rest), float(sd)
    told = tuple((float(east), float(north)) for east, north in shifts)
    return [
        replace(c, migration=tuple(own), registration=told)
        for c, own in zip(fused, left, strict=True)
    ]


def _fused(
    cells: Sequence[Sequence[Summary | None]],
    settings: RippleSettings,
    survey: SurveyModel,
    sediment: IntArray | None,
) -> list[FusedCell]:
    looks = collect(cells, sediment)
    if looks is None:
        return [_assembled(s, (), {}, {}) for s in cells]
    distances, volumes = distances_of(looks, survey, len(cells))
    groups = [agreeing(d, s) for d, s in zip(distances, volumes, strict=True)]
    groups = together(looks, survey, groups)
    if survey.learned and survey.looks == 1:  # it shares its law with no other
        known = _only(cells)
    else:
        known = _products(looks, survey, groups, settings)
    return [
        _assembled(summaries, groups[i], distances[i], known.get(i, {}))
        for i, summaries in enumerate(cells)
    ]


def _assembled(
    summaries: Sequence[Summary | None],
    group: tuple[int, ...],
    distances: dict[tuple[int, int], float],
    known: dict[int, CellEstimate],
) -> FusedCell:
    """Assemble the result of a cell; `known` has the estimates after each look of the group."""
    qualities = tuple(Quality.NO_DATA if s is None else s.quality for s in summaries)
    quality = cell_quality([s.quality for s in summaries if s is not None])
    looks = {k for k, q in enumerate(qualities) if q is Quality.GOOD}
    if len(group) < len(looks):
        quality = Quality.CONTRADICTION if quality is Quality.GOOD else quality
        lost = looks if 2 * len(group) <= len(looks) else looks - set(group)
        qualities = tuple(
            Quality.CONTRADICTION if k in lost else q for k, q in enumerate(qualities)
        )
    after: list[CellEstimate] = []
    for k in range(len(summaries)):
        after.append(known.get(k, after[-1] if after else UNKNOWN))
    final = after[-1] if after else UNKNOWN
    if not group:
        group, final = _doubtful(summaries)
    if quality is Quality.FAILED:
        group, final = (), UNKNOWN
    before = [UNKNOWN, *after][: len(after)]
    apart = [
        min((distances[min(j, k), max(j, k)] for j in group if j != k and j in looks), default=NAN)
        if k in looks
        else NAN
        for k in range(len(summaries))
    ]
    return FusedCell(
        tuple(FLAT if k is UNKNOWN else k for k in before),
        tuple(after),
        tuple(apart),
        group,
        final,
        migrations(summaries, group, final),
        quality,
        qualities,
    )


def migrations(
    summaries: Sequence[Summary | None], group: tuple[int, ...], final: CellEstimate
) -> tuple[tuple[float, float], ...]:
    """Displacement of the crests of looks from those of the first look of their group.

    Parameters
    ----------
    summaries : sequence of Summary or None
    group : tuple of int
        Looks that agree in f, A_H and azimuth.
    final : CellEstimate
        Their combined estimate.

    Returns
    -------
    tuple of (float, float)
        For each look, displacement in m along the azimuth from 0 to 180 degrees, from minus half to
        half a wavelength, and its standard deviation.
    """
    nothing = (NAN, NAN)
    if not group or not np.isfinite(final.mean[0]):
        return (nothing,) * len(summaries)
    turn = np.radians(final.azimuth[0])
    normal = np.array([np.sin(turn), np.cos(turn)])
    frequency = final.mean[0]
    first = summaries[group[0]]
    found = [nothing] * len(summaries)
    for k in group:
        summary = summaries[k]
        assert summary is not None
        assert first is not None
        apart = np.subtract(first.centre, summary.centre)
        (before, before_sd), (now, now_sd) = first.crest_phase, summary.crest_phase
        moved = before - now - frequency * float(normal @ apart)
        across = np.array([normal[1], -normal[0]])
        carried = np.hypot(
            final.sd[0] * (normal @ apart),
            frequency * np.radians(final.azimuth[1]) * (across @ apart),
        )
        if np.isfinite(moved):
            sd = 0.0 if k == group[0] else float(np.sqrt(before_sd**2 + now_sd**2 + carried**2))
            found[k] = (moved - round(moved)) / frequency, sd / frequency
    return tuple(found)


def _only(cells: Sequence[Sequence[Summary | None]]) -> dict[int, dict[int, CellEstimate]]:
    """Estimate of the cell of a survey's only good look: that of the look."""
    return {
        i: {k: of_summary(s)}
        for i, summaries in enumerate(cells)
        for k, s in enumerate(summaries)
        if s is not None and s.quality is Quality.GOOD
    }


def _products(
    looks: Looks,
    survey: SurveyModel,
    groups: list[tuple[int, ...]],
    settings: RippleSettings,
) -> dict[int, dict[int, CellEstimate]]:
    """Estimates of each cell after each look of its group, averaged over the shared parameters."""
    used = np.array([k in groups[i] for i, k in zip(looks.cell, looks.swath, strict=True)])
    order = np.lexsort([looks.swath, looks.cell])
    some = looks.some(order[used[order]])
    result: dict[int, dict[int, CellEstimate]] = {}
    if some.cell.size:
        found = estimates(*after_each(some, survey), settings, reach_after_each(some, survey))
        for i, k, estimate in zip(some.cell, some.swath, found, strict=True):
            result.setdefault(int(i), {})[int(k)] = estimate
    return result


def _doubtful(summaries: Sequence[Summary | None]) -> tuple[tuple[int, ...], CellEstimate]:
    """Choose the look nearest to convergence: a flagged value is better than none."""
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
    """Return the prior of a look, given the earlier looks.

    Parameters
    ----------
    earlier : sequence of Summary or None
        In order.
    settings : RippleSettings

    Returns
    -------
    Prior
        The survey's own prior, as likelihoods are multiplied afterwards. With the published method,
        the last posterior as a Gaussian of fixed width; a flat prior before the first.
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


def _published(summaries: Sequence[Summary | None], settings: RippleSettings) -> FusedCell:
    quality = cell_quality([s.quality for s in summaries if s is not None])
    priors: list[CellEstimate] = []
    posteriors: list[CellEstimate] = []
    for k, summary in enumerate(summaries):
        index = _last_published(summaries[:k])
        prior = next_prior(summaries[:k], settings)
        known_before = CellEstimate(prior.mean, PUBLISHED_SD)
        priors.append(FLAT if index is None else known_before)
        known = summary is not None and summary.quality in (Quality.GOOD, Quality.NOT_CONVERGED)
        posteriors.append(of_summary(summary) if known and summary else (*posteriors, UNKNOWN)[-1])
    last = _last_published(summaries)
    nothing = (NAN,) * len(summaries)
    failed = quality is Quality.FAILED or last is None
    group = () if failed or last is None else (last,)
    final = UNKNOWN if failed else posteriors[-1]
    qualities = tuple(Quality.NO_DATA if s is None else s.quality for s in summaries)
    still = ((NAN, NAN),) * len(summaries)
    return FusedCell(
        tuple(priors), tuple(posteriors), nothing, group, final, still, quality, qualities
    )


def cell_quality(qualities: Sequence[Quality]) -> Quality:
    """Quality of a cell: the most informative of the qualities of its looks."""
    order = (
        Quality.FAILED,
        Quality.GOOD,
        Quality.NOT_CONVERGED,
        Quality.NO_RIPPLES,
        Quality.NOT_IDENTIFIABLE,
        Quality.TOO_FEW_PIXELS,
    )
    return next((q for q in order if q in qualities), Quality.NO_DATA)
