"""A wave found in a clip to the fold that its posterior is sampled from.

Straight crests or a phase field, which profile, whether there is a trend, and how much less the
clip's speckle says than independent speckle: each is settled here, by what the clip shows, before
any sampling.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft2

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.fold import PROFILES, fold, fold_plan, turn_across
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
    straight,
)
from sasmap.ripples.pixels import unfold_pixels
from sasmap.ripples.presence import EULER
from sasmap.ripples.scattering import ProfileName
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.shadow import ShadowRule, shadow_table
from sasmap.ripples.starts import polished, scan

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
REFOLD = 0.002  # cycles over a block
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
    table : ndarray (n, SIZE + 1)
        The scan.
    profile : str
    trended : bool
        Whether the clip has a trend that the scattering of its sea floor does not explain.
    noise_factor : float
        How many times the variance of independent speckle the clip's has.
    """

    phase: PhaseField
    trend: FloatArray
    data: FoldData
    theta: FloatArray
    level: float
    table: FloatArray
    profile: ProfileName
    trended: bool
    noise_factor: float


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
    boxes = demodulate(task.image, wave)
    boxes = demodulate(task.image, refined_wave(task.image, boxes, boxes.count > 0))
    best = _best_phase(task, boxes)
    best = _with_profile(task, best)
    return _with_residuals(task, best)


def _folded(task: Task, phase: PhaseField, trend: FloatArray, profile: ProfileName) -> Fit:
    data = fold(task.image, phase, trend, task.shadow, profile, 1.0)
    return _climbed(task, phase, trend, data, profile)


def _climbed(
    task: Task, phase: PhaseField, trend: FloatArray, data: FoldData, profile: ProfileName
) -> Fit:
    table = scan(data, task.prior)
    start = table[np.argmax(table[:, SIZE]), :SIZE]
    theta, level = polished(start, data, task.compiled)
    return Fit(phase, trend, data, theta, level, table, profile, False, 1.0)


def _with_other_profile(task: Task, fit: Fit, profile: ProfileName) -> Fit:
    rule = task.shadow or "line-of-sight"
    data = fit.data._replace(profile=PROFILES[profile], table=shadow_table(rule, profile))
    theta, level = polished(fit.theta, data, task.compiled)
    return fit._replace(data=data, theta=theta, level=level, profile=profile)


def _best_phase(task: Task, boxes: Boxes) -> Fit:
    flat = np.ones_like(boxes.trend)
    phase = straight(task.image, boxes.wave, boxes)
    rigid = _refolded(task, _folded(task, phase, flat, "sine"))
    found = bend(boxes)
    if found.scores.max() * STRAIGHT < 1:
        return rigid
    field = bent(task.image, boxes, found)
    free = _folded(task, field, flat, "sine")
    explained = _explained(rigid)
    gain = _explained(free) - explained
    return free if gain > FIELD_MARGIN + FIELD_GAIN * explained else rigid


def _explained(fit: Fit) -> float:
    """Log posterior of a fit over the log likelihood of a flat image in the same fold."""
    data = fit.data
    filled = data.total > 0
    pixels = np.bincount(data.group, data.pixels.sum(axis=1))
    total = np.bincount(data.group, data.total.sum(axis=1))
    level = np.log(total / np.maximum(pixels, 1) + 1e-300)[data.group, None]
    loss = float((data.pixels * (level - data.log_mean))[filled].sum())
    return max(fit.level + loss - 0.5 * float(filled.sum()), 0.0)


def _refolded(task: Task, fit: Fit) -> Fit:
    """Fold straight crests again at the wave that the fold itself tells."""
    image, phase = task.image, fit.phase
    look = image.look
    right = np.array([look[1], -look[0]])
    along = fit.theta[0] * np.cos(fit.theta[2] - fit.data.look)
    wave = along * look + (phase.wave @ right) * right
    turn, sd = turn_across(image, phase, wave, fit.trend)
    wave = wave + turn * right
    phase = replace(
        phase,
        wave=wave,
        mean_wave=np.array([wave @ look, wave @ right]),
        wave_sd=np.array([np.inf, sd]),
    )
    return _folded(task, phase, fit.trend, fit.profile)


def _with_profile(task: Task, fit: Fit) -> Fit:
    """Return the fit with the profile that the survey fixes, or else the data choose."""
    wanted = task.settings.profile
    if wanted == fit.profile:
        return fit
    misfit = dispersion(fit) - 1
    filled = float((fit.data.total > 0).sum())
    if wanted == "auto" and misfit * np.sqrt(filled) < EXPLAINED:
        return fit
    names: tuple[ProfileName, ...] = ("stokes", "peaked") if wanted == "auto" else (wanted,)
    fits = [_with_other_profile(task, fit, name) for name in names]
    best = max(fits, key=lambda f: f.level)
    missed = PROFILE_SHARE * 0.5 * max(misfit, 0) * filled
    least = PROFILE_MARGIN + PROFILE_GAIN * _explained(fit) + missed
    enough = best.level > fit.level + least
    return best if wanted != "auto" or enough else fit


def _with_residuals(task: Task, fit: Fit) -> Fit:
    """Take a trend off the clip where one shows, and measure its noise factor."""
    trended = False
    for _ in range(2):
        ratio = residual(task.image, fit)
        trend, rms, noise = local_mean(task.image, fit.phase, ratio)
        if rms < TREND_RMS + 2 * noise:
            break
        trended = True
        fit = _folded(task, fit.phase, fit.trend * trend, fit.profile)
        ratio = residual(task.image, fit)
    factor = 1.0
    if task.settings.speckle == "measured":
        factor = max(noise_factor(task.image, fit.phase, ratio), dispersion(fit))
    data = fit.data._replace(power=1 / factor)
    if fit.phase.rigid:  # a field's wave is as uncertain as its wander makes it
        data = data._replace(wave_precision=data.wave_precision / factor)
    return fit._replace(data=data, trended=trended, noise_factor=factor)


def dispersion(fit: Fit) -> float:
    """Deviance of a fit over its degrees of freedom: what no ripple of the model's kind explains.

    Parameters
    ----------
    fit : Fit
        With a likelihood of independent speckle.

    Returns
    -------
    float
        Near 1 where the model is true.
    """
    phases_aside = fit.data._replace(wave_precision=np.zeros(2))
    filled = float((fit.data.total > 0).sum())
    return float(1 - 2 * log_likelihood(fit.theta, phases_aside) / filled)


def residual(image: Image, fit: Fit) -> FloatArray:
    """Intensity over the model's (rows, columns); 0 where not valid, not rippled or in shadow."""
    plan = fold_plan(image, fit.phase, fit.trend)
    used = image.valid & fit.phase.pixels(fit.phase.covered, image.shape)
    model = unfold_pixels(used, plan, pulses(fit.theta, fit.data))
    lit = model > DARK * model[used].mean()
    ratio = (image.power + DYNAMIC_RANGE) / np.where(lit, model, 1.0)
    return np.asarray(np.where(lit, ratio, 0.0))


def noise_factor(image: Image, phase: PhaseField, ratio: FloatArray) -> float:
    """Variance of the speckle around the ripple's wave number over that of independent speckle.

    Correlated pixels and texture raise the spectrum of the residual there; averaging of looks
    lowers it. A geometric mean over the ring about the wave number, other lines left out by it.

    Parameters
    ----------
    image : Image
    phase : PhaseField
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
    per_column, per_row = image.per_pixel(phase.wave)
    radius = np.hypot(np.fft.rfftfreq(image.shape[1]), np.fft.fftfreq(image.shape[0])[:, None])
    number = np.hypot(per_column, per_row)
    ring = (radius > 0.6 * number) & (radius < 1.6 * number)
    if ring.sum() < 20:
        return 1.0
    value = float(np.exp(np.log(power[ring] + 1e-12).mean() + EULER))
    return float(np.clip(value, *NOISE_BOUNDS))
