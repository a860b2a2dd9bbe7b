"""From a wave found in a clip to its histogram and the peaks that sampling starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sasmap.arrays import BoolArray, FloatArray
from sasmap.numerics.looks import noise_factor, point_spread
from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.demodulation import (
    along_range,
    demodulate,
    local_ratio,
    refined_wave,
    rewaved,
    turned_back,
)
from sasmap.ripples.errors import (
    DARK,
    bin_weights,
    slope_error,
    weighed,
    with_errors,
    without_local_light,
)
from sasmap.ripples.histogram import histogram
from sasmap.ripples.image import Image
from sasmap.ripples.optimise import (
    CLIMB,
    PEAKS,
    Peak,
    distinct,
    fisher_scoring,
    glance,
    rivals,
    search,
)
from sasmap.ripples.phase import (
    STRAIGHT,
    PhaseField,
    best_field,
    straight,
    trial_fields,
    with_slight_bends,
)
from sasmap.ripples.priors import Prior
from sasmap.ripples.rendered import Fit, expected_at, lag_over_range, painted
from sasmap.ripples.rendering import (
    CREST,
    LAW_KNOTS,
    LINE_OF_SIGHT,
    Geometry,
    Histogram,
)
from sasmap.ripples.residuals import across_look, spread_of_heights
from sasmap.ripples.settings import RippleSettings, scattering_law

# Variance of the blur by a sonar's point spread function before it is measured, squared pixels, and
# its least: that of a pixel's own width.
POINT_SPREAD, OWN_WIDTH = 0.25, 1 / 12
# Prior standard deviations of the image's wave number, cycles over the clip (the accuracy of
# detection), and of its phase, rad (that of any phase); of the phase where a field has followed it.
FOUND_TO, ANY_PHASE, FIELD_PHASE = 0.5, np.pi / np.sqrt(3), 0.1
# Rounds in which the trend is estimated again with the pulse known, and of Fisher scoring in each;
# rounds in which the model's errors are estimated.
TREND_ROUNDS, TREND_CLIMB, ERROR_ROUNDS = 2, 6, 2
# Least wave number along the look over that across (a choice: height is not identifiable below
# seven times it, detection.MIN_ALONG).
LEAST_ALONG = 0.01
# Steepest slope of a profile within the prior over that of a sine of the same height (1.76).
PEAKED_SLOPE = 1.8


class NoPlaceError(ValueError):
    """No height within the settings' bounds fits ripples of this wave."""


class Task(NamedTuple):
    """Inputs that stay the same while a clip is fitted."""

    image: Image
    settings: RippleSettings
    prior: Prior
    altitude_sd: float

    @property
    def published(self) -> bool:
        """Whether Zare and Cobb's model is fitted."""
        return self.settings.scattering == "zare-cobb"


def fit_wave(task: Task, wave: FloatArray) -> Fit:
    """Fit a wave: straight crests first, a phase field where they do not suffice.

    Parameters
    ----------
    task : Task
    wave : ndarray (2,)
        Wave vector of the spectrum's peak, (east, north), cycles/m.

    Raises
    ------
    NoPlaceError
        If no height within the prior's bounds fits it.
    """
    image = task.image
    # a wave has two vectors of opposite sign: take the one that points along the look
    boxes = demodulate(image, wave if wave @ image.look >= 0 else -wave)
    boxes = rewaved(image, boxes, refined_wave(image, boxes, boxes.count > 0))
    phase = straight(image, boxes)
    seen = fitted(task, phase, boxes.trend, glance)
    # shadow and lean turn the fundamental's phase with range, which is not a bend of the crests
    upright = turned_back(image, boxes, lag_over_range(seen))
    upright = rewaved(image, upright, refined_wave(image, upright, upright.count > 0))
    trials = trial_fields(upright)
    if (trials.scores >= STRAIGHT).any():
        phase = best_field(image, boxes, trial_fields(boxes))
    else:
        phase = with_slight_bends(image, phase, trials)
    return refined(task, fitted(task, phase, boxes.trend, search))


def fitted(
    task: Task,
    phase: PhaseField,
    trend: FloatArray,
    climb: Callable[[Histogram, Geometry], list[Peak]],
) -> Fit:
    """Bin a clip by phase and range and climb to peaks of its posterior."""
    data = without_local_light(histogram(task.image, trend, phase, task.published))
    geometry = clip_geometry(task, phase, data)
    peaks = climb(data, geometry)
    if not peaks:
        raise NoPlaceError(f"no height within the bounds at {phase.mean_wave} cycles/m")
    return Fit(phase, trend, data, geometry, peaks)


def clip_geometry(task: Task, phase: PhaseField, data: Histogram) -> Geometry:
    """Collect the likelihood's inputs other than the histogram."""
    image, settings, prior = task.image, task.settings, task.prior
    along, across = (float(v) for v in phase.mean_wave)
    # refinement may turn a wave seen along its crests past the perpendicular to the look
    along = max(along, LEAST_ALONG * abs(across))
    extent = max(float(np.ptp(data.place)), image.pixel_size)
    pixels = data.pixel_count.sum(axis=1)
    middle = [float(np.average(v, weights=pixels)) for v in (data.ground_range, data.altitude)]
    law = scattering_law(settings.scattering)
    fixed = np.array([np.nan, np.nan, 0.0, 0.0] if task.published else [np.nan] * 4)
    if law is not None:
        fixed[:2] = law
    rule = CREST if settings.shadow == "crest" else LINE_OF_SIGHT
    # no shadow if no slope within the prior is as steep as the lowest ray
    slope = min(2 * np.pi * float(np.hypot(along, across)) * prior.bounds[1][1], 1.0)
    if PEAKED_SLOPE * slope < float((data.altitude / data.ground_range).min()):
        rule = 0
    return Geometry(
        along=along,
        across=across,
        range_middle=middle[0],
        altitude_middle=middle[1],
        altitude_sd=task.altitude_sd,
        wave_sd=FOUND_TO / extent if phase.rigid else FIELD_PHASE / middle[0],
        phase_sd=ANY_PHASE if phase.rigid else FIELD_PHASE,
        expected_blur=_expected_blur(image, phase, POINT_SPREAD * np.eye(2)),
        bent=not phase.rigid,
        published=task.published,
        shadow=rule,
        law_error=np.zeros(LAW_KNOTS.size),
        third_harmonic=np.zeros(2),
        fixed=fixed,
        height_mean=prior.mean[1],
        height_sd=prior.sd[1],
        height_least=prior.bounds[1][0],
        height_most=prior.bounds[1][1],
        steepness_middle=prior.steepness[0],
        steepness_sd=prior.steepness[1],
    )


def _expected_blur(image: Image, phase: PhaseField, spread: FloatArray) -> float:
    """Blur along the crest normal by a point spread of covariance `spread`, pixels, in cycles."""
    wave = image.per_pixel(phase.wave)
    variance = max(float(wave @ spread @ wave), OWN_WIDTH * float(wave @ wave))
    return float(np.hypot(np.sqrt(variance), phase.error / (2 * np.pi)))


def _speckle(image: Image, used: BoolArray, model: FloatArray) -> FloatArray:
    """Return the intensity over a modelled one where that is no shadow, 0 elsewhere."""
    lit = used & (model > DARK)
    return np.where(lit, (image.power + DYNAMIC_RANGE) / np.where(lit, model, 1.0), 0.0)


def refined(task: Task, fit: Fit) -> Fit:
    """Remove the trend that the fit leaves, weigh the pixels by speckle and errors, and fit again.

    The first trend is estimated without the pulse and absorbs part of it at the clip's edges.
    """
    image, phase = task.image, fit.phase
    used = image.valid & phase.pixels(phase.covered)
    for _ in range(TREND_ROUNDS):
        means, gains = expected_at(fit, fit.z)
        means = means / gains[:, None]
        seen, pixels = fit.data.intensity_sum.sum(axis=1), fit.data.pixel_count
        ratio = np.maximum(seen, 1e-9) / (means * pixels).sum(axis=1)
        reach = fit.data.ground_range
        overall = along_range(image, phase.box, reach, ratio, pixels.sum(axis=1))
        fit = fit._replace(trend=fit.trend * overall)
        model = painted(image, fit, used, means)
        trend = fit.trend * local_ratio(image, phase.wave, phase.box, used, model)
        blur = _expected_blur(image, phase, point_spread(_speckle(image, used, model)))
        fit = fit._replace(geometry=fit.geometry._replace(expected_blur=blur))
        fit = turned(image, fit._replace(trend=trend), across_look(image, fit, fit.data, used)[0])
        whole = histogram(image, trend, fit.phase, fit.geometry.published)
        fit = reoptimised(fit, without_local_light(whole), fit.geometry, TREND_CLIMB)
    model = painted(image, fit, used, expected_at(fit, fit.z)[0])
    factor = noise_factor(_speckle(image, used, model), image.per_pixel(phase.wave))
    fit = fit._replace(noise_factor=factor, explained=explained(fit))
    for _ in range(ERROR_ROUNDS):
        fit = reweighted(fit, whole, image.pixel_size)
    found = rivals(fit.peaks, fit.data, fit.geometry)
    another = found[0] is not fit.peaks[0]
    fit = fit._replace(peaks=found)
    fit = reweighted(fit, whole, image.pixel_size) if another else fit
    tilt = slope_error(fit, whole, image.pixel_size)
    # where the published model is asked for, it is taken at its word
    unlike = 0.0 if task.published else spread_of_heights(image, fit, whole, used)
    across = across_look(image, fit, whole, used)
    return fit._replace(unlike=unlike, tilt=tilt, across=across)


def turned(image: Image, fit: Fit, across: float) -> Fit:
    """Turn the crests of a fit to another wave number across the look, cycles/m."""
    phase, offset = fit.phase, across - fit.geometry.across
    phase = replace(
        phase,
        wave=phase.wave + offset * image.beside,
        mean_wave=phase.mean_wave + np.array([0.0, offset]),
    )
    return fit._replace(phase=phase, geometry=fit.geometry._replace(across=across))


def reweighted(fit: Fit, whole: Histogram, pixel_size: float) -> Fit:
    """Estimate the model's errors again at a fit's likeliest peak, and climb on.

    Parameters
    ----------
    fit : Fit
    whole : Histogram
        With all pixels of weight 1.
    pixel_size : float
        m.
    """
    weight = bin_weights(fit, whole, pixel_size)
    # where the published model is asked for, it is taken at its word
    share = np.ones_like(weight) if fit.geometry.published else fit.noise_factor * weight
    fit = fit._replace(data=weighed(whole, weight)._replace(speckle_share=share))
    fit = with_errors(fit)
    return with_errors(reoptimised(fit, fit.data, fit.geometry, CLIMB))


def explained(fit: Fit) -> float:
    """Log likelihood ratio of a fit to a flat sea floor with gains for the same groups."""
    data = fit.data
    means = expected_at(fit, fit.z)[0]
    count, total = (
        np.bincount(data.group, v.sum(axis=1))[data.group][:, None]
        for v in (data.pixel_count, data.intensity_sum)
    )
    flat = total / count
    gain = data.pixel_count * np.log(flat / means)
    return float((gain + data.intensity_sum * (1 / flat - 1 / means)).sum())


def reoptimised(fit: Fit, data: Histogram, geometry: Geometry, rounds: int) -> Fit:
    """Climb on from a fit's peaks with another histogram or geometry."""
    peaks = distinct([fisher_scoring(p.z, data, geometry, rounds) for p in fit.peaks], PEAKS)
    return fit._replace(data=data, geometry=geometry, peaks=peaks)
