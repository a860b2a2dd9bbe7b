"""A wave found in a clip to the fold that its posterior is sampled from.

Straight crests or a phase field, which profile, whether there is a trend, and how much less the
clip's speckle says than independent speckle: each is settled here, by what the clip shows, before
any sampling.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft2

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.fold import PROFILES, Reference, detrended, fold, fold_plan
from sasmap.ripples.folded import FoldData, PriorData
from sasmap.ripples.image import Image
from sasmap.ripples.kernel import SIZE, log_likelihood, pulses
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.phase import (
    STRAIGHT,
    Boxes,
    PhaseField,
    bend,
    bent,
    demodulate,
    local_mean,
    refined_wave,
    rewaved,
    straight,
)
from sasmap.ripples.pixels import unfold_pixels
from sasmap.ripples.presence import EULER
from sasmap.ripples.scattering import ProfileName
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.shadow import ShadowRule, shadow_table
from sasmap.ripples.starts import polished, rivals, scan

FloatArray = NDArray[np.float64]

# What a field must explain beyond straight crests, of what these explain and in log likelihood.
FIELD_GAIN, FIELD_MARGIN = 0.004, 10.0
# What another profile must explain beyond a sine: in the same terms, and of what a sine leaves
# unexplained.
PROFILE_GAIN, PROFILE_MARGIN, PROFILE_SHARE = 0.002, 10.0, 0.3
# A sine that leaves no more than this unexplained, in standard deviations of its deviance, will do.
EXPLAINED = 1.0
# Variation of the ratio of image and model, over several wavelengths, that makes a trend (rms).
TREND_RMS = 0.05
# Share of a clip's pixels, in light and clear of shadow's edges, from which they tell its trend and
# its speckle.
MIN_LIT = 0.05
# Pixels of a bin from which its mean says something about the model.
FEW = 8.0
NOISE_BOUNDS = (0.5, 50.0)
# Model intensity over its mean below which speckle is not judged.
DARK = 0.1


class Fit(NamedTuple):
    """A fold and the point of its posterior to start from.

    Attributes
    ----------
    phase : PhaseField
    trend : ndarray (box rows, box columns)
    data : FoldData
    theta : ndarray (SIZE,)
        Near the peak.
    level : float
        Its log posterior.
    profile : str
    trended : bool
        Whether the clip has a trend that the scattering of its sea floor does not explain.
    noise_factor : float
        How many times the variance of independent speckle the clip's has.
    reference : Reference or None
        What straight crests were folded at.
    """

    phase: PhaseField
    trend: FloatArray
    data: FoldData
    theta: FloatArray
    level: float
    profile: ProfileName
    trended: bool
    noise_factor: float
    reference: Reference | None = None


class Task(NamedTuple):
    """What does not change while a clip is fitted."""

    image: Image
    shadow: ShadowRule | None
    settings: RippleSettings
    prior: Prior
    compiled: PriorData


def fit_wave(task: Task, wave: FloatArray) -> Fit:
    """Fit a wave: phase, profile, trend and noise.

    Parameters
    ----------
    task : Task
    wave : ndarray (2,)
        Where the spectrum has its peak, (east, north), cycles/m.

    Returns
    -------
    Fit
    """
    # of the two vectors of a wave, the one that the sonar looks along
    boxes = demodulate(task.image, wave if wave @ task.image.look >= 0 else -wave)
    boxes = rewaved(task.image, boxes, refined_wave(task.image, boxes, boxes.count > 0))
    return _with_residuals(task, *_with_profile(task, _best_phase(task, boxes)))


def _searched(task: Task, phase: PhaseField, trend: FloatArray, profile: ProfileName) -> Fit:
    """Fold on an even grid of phase, search all of A_H, phase and noise, and climb."""
    data = fold(task.image, phase, trend, task.shadow, profile)
    table = scan(data, task.prior)
    start = table[np.argmax(table[:, SIZE]), :SIZE]
    peaks = [polished(start, data, task.compiled)]
    if task.shadow is not None:
        peaks += [polished(row, data, task.compiled) for row in rivals(table, peaks[0][0])]
    theta, level = max(peaks, key=lambda peak: peak[1])
    return Fit(phase, trend, data, theta, level, profile, False, 1.0)


def refolded(task: Task, fit: Fit) -> Fit:
    """Fold straight crests where the fit is, following their shadow, and climb on; bent ones stay.

    Parameters
    ----------
    task : Task
    fit : Fit
        Its level says nothing beside the result's: other pixels count.

    Returns
    -------
    Fit
    """
    if not fit.phase.rigid:
        return fit
    for near in (False, True) if task.shadow is None else (False, True, True):
        reference = Reference(fit.theta, fit.data)
        data = fold(task.image, fit.phase, fit.trend, task.shadow, fit.profile, reference)
        theta = fit.theta.copy()
        if not fit.data.fine:
            theta[5] = 0.0
        theta, level = polished(theta, data, task.compiled, near=near)
        fit = fit._replace(data=data, theta=theta, level=level, reference=reference)
    return fit


def _with_other_profile(task: Task, fit: Fit, profile: ProfileName) -> Fit:
    rule = task.shadow or "line-of-sight"
    data = fit.data._replace(profile=PROFILES[profile], table=shadow_table(rule, profile))
    theta, level = polished(fit.theta, data, task.compiled)
    return fit._replace(data=data, theta=theta, level=level, profile=profile)


def _best_phase(task: Task, boxes: Boxes) -> Fit:
    flat = np.ones_like(boxes.trend)
    rigid = _searched(task, straight(task.image, boxes.wave, boxes), flat, "sine")
    found = bend(boxes)
    if (found.scores < STRAIGHT).all():
        return rigid
    free = _searched(task, bent(task.image, boxes, found), flat, "sine")
    known = explained(rigid)
    gain = explained(free) - known
    return free if gain > FIELD_MARGIN + FIELD_GAIN * known else rigid


def explained(fit: Fit) -> float:
    """Log likelihood of a fit over that of a flat sea floor.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    float
        At least 0.
    """
    flat = fit.theta.copy()
    flat[1] = 0.0
    aside = fit.data._replace(wave_precision=np.zeros(2))
    return float(max(log_likelihood(fit.theta, aside) - log_likelihood(flat, aside), 0.0))


def _with_profile(task: Task, fit: Fit) -> tuple[Fit, Fit]:
    """Return the fit with the profile that the survey fixes, or else the data choose.

    And the same fit refolded, where crests are straight.
    """
    wanted = task.settings.profile
    close = refolded(task, fit)
    misfit, freedom = dispersion(close)
    if wanted == fit.profile or (wanted == "auto" and (misfit - 1) * np.sqrt(freedom) < EXPLAINED):
        return fit, close
    misfit, freedom = dispersion(fit)
    names: tuple[ProfileName, ...] = ("stokes", "peaked") if wanted == "auto" else (wanted,)
    fits = [_with_other_profile(task, fit, name) for name in names]
    best = max(fits, key=lambda f: f.level)
    missed = PROFILE_SHARE * 0.5 * max(misfit - 1, 0) * freedom
    least = PROFILE_MARGIN + PROFILE_GAIN * explained(fit) + missed
    if wanted == "auto" and best.level < fit.level + least:
        return fit, close
    return best, refolded(task, best)


def _with_residuals(task: Task, search: Fit, fit: Fit) -> Fit:
    """Take a trend off the clip where one shows, and measure its noise factor.

    Parameters
    ----------
    task : Task
    search, fit : Fit
        On an even grid of phase, and the same refolded where crests are straight.

    Returns
    -------
    Fit
    """
    trended = False
    for last in (False, False, True):
        ratio = residual(task.image, fit)
        if np.count_nonzero(ratio) < MIN_LIT * task.image.valid.sum():
            return fit
        trend, rms, noise = local_mean(task.image, fit.phase, ratio)
        if last or rms < TREND_RMS + 2 * noise:
            break
        trended = True
        search = _searched(task, fit.phase, fit.trend * trend, fit.profile)
        fit = refolded(task, search)
    factor = 1.0
    if task.settings.speckle == "measured":
        factor = max(noise_factor(task.image, fit.phase.wave, ratio), dispersion(fit)[0], 1.0)
    data, theta, level = fit.data._replace(power=1 / factor), fit.theta, fit.level
    if factor > 1:  # what a field's phases say counts for more now
        theta, level = polished(theta, data, task.compiled, near=True)
    return Fit(
        fit.phase, fit.trend, data, theta, level, fit.profile, trended, factor, fit.reference
    )


def dispersion(fit: Fit) -> tuple[float, float]:
    """Chi-square of a fit over its degrees of freedom: what no ripple of the model explains.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    ratio : float
        Near 1 where the model is true and speckle independent.
    freedom : float
    """
    data = fit.data
    model, clear, _ = pulses(fit.theta, data)
    enough = clear & (data.known > FEW)
    mean = data.total[enough] / data.known[enough]
    square = data.known[enough] * np.log(model[enough] / mean) + data.known[enough] * (
        mean / model[enough] - 1
    )
    freedom = max(float(enough.sum() - data.group.max() - 1 - SIZE), 1.0)
    return float(2 * square.sum() / freedom), freedom


def residual(image: Image, fit: Fit) -> FloatArray:
    """Intensity over the model's (rows, columns); 0 where not valid, not rippled or in shadow."""
    used = image.valid & fit.phase.pixels(fit.phase.covered, image.shape)
    plan, _, _ = fold_plan(image, fit.phase, fit.reference)
    pulse, clear, _ = pulses(fit.theta, fit.data)
    model = unfold_pixels(used, fit.phase.cycles(image.shape), plan, np.where(clear, pulse, 0.0))
    lit = model > DARK * max(float(model[used].mean()), 1e-300)
    power = detrended(image, fit.phase, fit.trend) + DYNAMIC_RANGE
    ratio = power / np.where(lit, model, 1.0)
    return np.asarray(np.where(lit, ratio, 0.0))


def noise_factor(image: Image, wave: FloatArray, ratio: FloatArray) -> float:
    """Variance of the speckle around the ripple's wave number over that of independent speckle.

    Correlated pixels and texture raise the spectrum of the residual there; averaging of looks
    lowers it. A geometric mean over the ring about the wave number, other lines left out by it.

    Parameters
    ----------
    image : Image
    wave : ndarray (2,)
        (east, north), cycles/m.
    ratio : ndarray (rows, columns)
        Of :func:`residual`.

    Returns
    -------
    float
    """
    used = ratio > 0
    count = int(used.sum())
    mean = ratio[used].mean()
    flat = np.where(used, np.minimum(ratio / mean, 12.0) - 1.0, 0.0)
    power = np.abs(rfft2(flat)) ** 2 / count
    per_column, per_row = image.per_pixel(wave)
    radius = np.hypot(np.fft.rfftfreq(image.shape[1]), np.fft.fftfreq(image.shape[0])[:, None])
    number = np.hypot(per_column, per_row)
    ring = (radius > 0.6 * number) & (radius < 1.6 * number)
    if ring.sum() < 20:
        return 1.0
    level = float(np.log(power[ring] + 1e-12).mean() + EULER)
    if abs(level) < 2 * np.pi / np.sqrt(6 * ring.sum()):  # two standard deviations
        return 1.0
    return float(np.clip(np.exp(level), *NOISE_BOUNDS))
