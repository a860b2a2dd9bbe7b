"""From a wave that was found in a clip to its histogram and the peak that sampling starts from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.numerics.looks import noise_factor
from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.demodulation import (
    along_range,
    demodulate,
    local_ratio,
    refined_wave,
    rewaved,
    turned_back,
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
from sasmap.ripples.phase import STRAIGHT, PhaseField, best_field, straight, trial_fields
from sasmap.ripples.pixels import paint_pixels, spread_boxes
from sasmap.ripples.priors import Prior
from sasmap.ripples.rendering import (
    CREST,
    LAW_KNOTS,
    LINE_OF_SIGHT,
    Geometry,
    Histogram,
    Parameters,
    fill_expected,
    fill_lags,
    fill_pulses,
    fill_residuals,
    parameters_at,
)
from sasmap.ripples.settings import RippleSettings, scattering_law

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Expected standard deviation of a sonar's point spread, pixels.
POINT_SPREAD = 0.5
# Cycles over the clip to which detection tells a wave number, and by which shadow and lean may turn
# the image's wave from the ripple's (half a radian at either end, docs/science.md).
FOUND_TO = 0.5
# Rounds in which the trend is told anew, knowing the pulse, and of Fisher scoring in each.
TREND_ROUNDS, TREND_CLIMB = 2, 6
# Errors of the model: least relative error of the expected intensity that the pixels of a group of
# range and one of so many parts of phase share, with straight crests and where a field is followed;
# displacement of the pulse that all groups share, in pixels, and in cycles where a field is
# followed (pipelines/ripples/coherent.py).
MODEL_ERROR, FIELD_ERROR, MODEL_SHIFT, FIELD_SHIFT, ERROR_CELLS = 0.02, 0.04, 0.15, 0.02, 16
# Error of the expected intensity over the clip's mean, with straight crests and where a field is
# followed: side lobes, and light that forks and defects leave in shadow.
DARK_ERROR = (0.002, 0.01)
# Least intensity over the clip's mean of which that error is told.
LEAST_LIGHT = 1e-4
# Departure of the log of a scattering law from its family at each knot (rough floors have a peak
# near normal incidence); third harmonic of the profile over A_H; rounds in which errors are told.
LAW_ERROR, THIRD_HARMONIC, ERROR_ROUNDS = (0.15, 0.2, 0.3, 0.35, 0.35, 0.8), 0.03, 2
# Change of log A_H over the range of a clip: standard deviations of its first cosines, and step by
# which it is told. Of 53 cells of a simulator of others, whose heights change by 1.3 to 10 times or
# come in groups, 8 were 4 standard deviations and 20 % off without, 1 with 0.07 and with 0.1, where
# calibration is worse (pipelines/ripples/calibration.py).
HEIGHT_TREND, HEIGHT_STEP = (0.07, 0.07, 0.07), 0.05
# Error of the pulse's second harmonic where crests bend.
FIELD_HARMONIC = 0.03
# Least wave number along the look over that across: height is not identifiable below seven times it
# (detection.MIN_ALONG), so that a choice.
LEAST_ALONG = 0.01
# Steepest slope of a peaked profile over a sine's of the same height.
PEAKED_SLOPE = 1.5
# Expected intensity over the mean below which speckle is not judged.
DARK = 0.1


class Fit(NamedTuple):
    """A clip by phase and range, and the likeliest parameters.

    Attributes
    ----------
    phase : PhaseField
    trend : ndarray (box rows, box columns)
    data : Histogram
    geometry : Geometry
    peaks : list of Peak
        The likeliest first.
    noise_factor : float
        Variance of the speckle over that of independent pixels.
    explained : float
        Log likelihood of the likeliest ripple over that of a flat sea floor, speckle independent.
    misfit : float
        Relative error of the expected intensity that the image shows (:func:`misfit_of`).
    """

    phase: PhaseField
    trend: FloatArray
    data: Histogram
    geometry: Geometry
    peaks: list[Peak]
    noise_factor: float = 1.0
    explained: float = 0.0
    misfit: float = 0.0

    @property
    def z(self) -> FloatArray:
        """Sampling coordinates of the likeliest peak."""
        return self.peaks[0].z


class NoPlaceError(ValueError):
    """No height within the settings' bounds makes ripples of a wave."""


class Task(NamedTuple):
    """What does not change while a clip is fitted."""

    image: Image
    settings: RippleSettings
    prior: Prior
    altitude_sd: float


def fit_wave(task: Task, wave: FloatArray) -> Fit:
    """Fit a wave: straight crests first, a phase field where they do not suffice.

    Parameters
    ----------
    task : Task
    wave : ndarray (2,)
        Where the spectrum has its peak, (east, north), cycles/m.

    Returns
    -------
    Fit

    Raises
    ------
    NoPlaceError
        Where the prior has no place for it.
    """
    image = task.image
    # of the two vectors of a wave, the one that the sonar looks along
    boxes = demodulate(image, wave if wave @ image.look >= 0 else -wave)
    boxes = rewaved(image, boxes, refined_wave(image, boxes, boxes.count > 0))
    phase = straight(image, boxes)
    seen = fitted(task, phase, boxes.trend, glance)
    # shadow and lean turn the fundamental with range; that is no bend of the crests
    upright = turned_back(image, boxes, lag_over_range(seen))
    upright = rewaved(image, upright, refined_wave(image, upright, upright.count > 0))
    trials = trial_fields(upright)
    if (trials.scores >= STRAIGHT).any():
        phase = best_field(image, boxes, trial_fields(boxes))
    return refined(task, fitted(task, phase, boxes.trend, search))


def fitted(
    task: Task,
    phase: PhaseField,
    trend: FloatArray,
    climb: Callable[[Histogram, Geometry], list[Peak]],
) -> Fit:
    """Sum a clip over phase and range and climb to peaks of its posterior."""
    data = histogram(task.image, trend, phase)
    geometry = clip_geometry(task, phase, data)
    peaks = climb(data, geometry)
    if not peaks:
        raise NoPlaceError(f"no height within the bounds at {phase.mean_wave} cycles/m")
    return Fit(phase, trend, data, geometry, peaks)


def clip_geometry(task: Task, phase: PhaseField, data: Histogram) -> Geometry:
    """Gather what the likelihood needs besides the histogram."""
    image, settings, prior = task.image, task.settings, task.prior
    along, across = (float(v) for v in phase.mean_wave)
    # refined, crests that the sonar looks along may turn past the look
    along = max(along, LEAST_ALONG * abs(across))
    lattice = POINT_SPREAD * image.pixel_size * along
    pixels = data.pixel_count.sum(axis=1)
    middle = [float(np.average(v, weights=pixels)) for v in (data.ground_range, data.altitude)]
    law = scattering_law(settings.scattering)
    published = settings.scattering == "zare-cobb"
    fixed = np.array([np.nan, np.nan, 0.0, 0.0] if published else [np.nan] * 4)
    if law is not None:
        fixed[:2] = law
    rule = CREST if settings.shadow == "crest" else LINE_OF_SIGHT
    # no slope within the prior, of a peaked profile too, is as steep as the lowest ray
    slope = min(2 * np.pi * float(np.hypot(along, across)) * prior.bounds[1][1], 1.0)
    if PEAKED_SLOPE * slope < float((data.altitude / data.ground_range).min()):
        rule = 0
    return Geometry(
        along=along,
        across=across,
        range_middle=middle[0],
        altitude_middle=middle[1],
        altitude_sd=task.altitude_sd,
        wave_sd=FOUND_TO / max(float(np.ptp(data.place)), image.pixel_size),
        expected_blur=float(np.hypot(lattice, phase.error / (2 * np.pi))),
        follows_image=not phase.rigid,
        published=published,
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


def pulses_at(fit: Fit, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pulses (blocks, bins) over ripple phase, lags and levels (blocks,) at coordinates."""
    pulses = np.empty(fit.data.pixel_count.shape)
    lags, levels = np.empty((2, len(pulses)))
    fill_pulses(parameters_at(z, fit.geometry), fit.data, fit.geometry, pulses, levels)
    fill_lags(pulses, lags)
    return pulses, lags, levels


def lag_over_range(fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Ground ranges (m) and how far the image's fundamental is turned there, rad."""
    return fit.data.ground_range, np.unwrap(pulses_at(fit, fit.z)[1])


def expected_at(fit: Fit, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return expected intensity over the local mean (blocks, bins) and gains (blocks,)."""
    return _expected(fit, parameters_at(z, fit.geometry))


def _expected(fit: Fit, ripple: Parameters) -> tuple[FloatArray, FloatArray]:
    means, gains = np.empty(fit.data.pixel_count.shape), np.empty(len(fit.data.place))
    fill_expected(ripple, fit.data, fit.geometry, means, gains)
    return means, gains


def refined(task: Task, fit: Fit) -> Fit:
    """Take off the trend that the fit leaves, temper it by the speckle, and go on.

    The first trend is told without knowing the pulse and takes up a part of it at a clip's edges.
    """
    image, phase = task.image, fit.phase
    used = image.valid & phase.pixels(phase.covered, image.shape)
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
        data = histogram(image, trend, phase)
        fit = reoptimised(fit._replace(trend=trend), data, fit.geometry, TREND_CLIMB)
    model = painted(image, fit, used, expected_at(fit, fit.z)[0])
    lit = used & (model > DARK)
    ratio = np.where(lit, (image.power + DYNAMIC_RANGE) / np.where(lit, model, 1.0), 0.0)
    factor = noise_factor(ratio, image.per_pixel(phase.wave))
    fit = fit._replace(noise_factor=factor, explained=explained(fit))
    whole = fit.data
    for _ in range(ERROR_ROUNDS):
        fit = reweighted(fit, whole, image.pixel_size)
    found = rivals(fit.peaks, fit.data, fit.geometry)
    another = found[0] is not fit.peaks[0]
    fit = fit._replace(peaks=found)
    fit = reweighted(fit, whole, image.pixel_size) if another else fit
    return fit._replace(misfit=misfit_of(fit, whole))


def reweighted(fit: Fit, whole: Histogram, pixel_size: float) -> Fit:
    """Tell anew what the model may be wrong by at a fit's likeliest peak, and climb on.

    Parameters
    ----------
    fit : Fit
    whole : Histogram
        Of whole pixels.
    pixel_size : float
        m.

    Returns
    -------
    Fit
    """
    weight = bin_weights(fit._replace(data=whole), fit.noise_factor, pixel_size)
    data = whole._replace(
        pixel_count=weight * whole.pixel_count, intensity_sum=weight * whole.intensity_sum
    )
    fit = fit._replace(data=data)
    return reoptimised(fit, with_errors(fit), fit.geometry, CLIMB)


def explained(fit: Fit) -> float:
    """Log likelihood of a fit over that of a flat sea floor of the same gains."""
    data = fit.data
    means = expected_at(fit, fit.z)[0]
    count, total = (
        np.bincount(data.group, v.sum(axis=1))[data.group][:, None]
        for v in (data.pixel_count, data.intensity_sum)
    )
    flat = total / count
    gain = data.pixel_count * np.log(flat / means)
    return float((gain + data.intensity_sum * (1 / flat - 1 / means)).sum())


def with_errors(fit: Fit) -> Histogram:
    """Add what the model may be wrong by in all bins together to a histogram.

    The scattering law's departure from its family, the crest profile's third harmonic, and heights
    that change over range; where a field is followed, that a pulse of crests of many wavelengths
    and directions is not that of their mean. They are integrated out to second order.
    """
    data, geometry = fit.data, fit.geometry
    others = []
    if not geometry.published:
        others = [geometry._replace(third_harmonic=v) for v in THIRD_HARMONIC * np.eye(2)]
    if np.isnan(geometry.fixed[0]):
        others += [geometry._replace(law_error=v) for v in np.diag(LAW_ERROR)]
    logs = np.log(expected_at(fit, fit.z)[0])
    errors = [np.log(expected_at(fit._replace(geometry=g), fit.z)[0]) - logs for g in others]
    if not geometry.published:
        errors += _height_trends(fit)
    if not fit.phase.rigid:
        bins = logs.shape[1]
        angle = 2 * np.pi * ((np.arange(bins) + 0.5) / bins + data.phase_offset)
        errors += [FIELD_HARMONIC * np.cos(2 * angle), FIELD_HARMONIC * np.sin(2 * angle)]
    if not errors:
        return data
    stack = np.array(errors)
    flat = stack.reshape(len(stack), -1)
    information = (flat * data.pixel_count.ravel()) @ flat.T
    return data._replace(errors=stack, error_gain=np.linalg.inv(information + np.eye(len(stack))))


def _height_trends(fit: Fit) -> list[FloatArray]:
    """Errors of the log expected intensity where A_H changes over range, (blocks, bins) each."""
    parameters = parameters_at(fit.z, fit.geometry)
    logs = []
    for step in (-HEIGHT_STEP, HEIGHT_STEP):
        taller = parameters._replace(height=parameters.height * np.exp(step))
        logs.append(np.log(_expected(fit, taller)[0]))
    slope = (logs[1] - logs[0]) / (2 * HEIGHT_STEP)
    place = fit.data.place
    across = (place - place.min()) / max(float(np.ptp(place)), 1e-9)
    return [
        sd * np.cos(np.pi * k * across)[:, None] * slope for k, sd in enumerate(HEIGHT_TREND, 1)
    ]


def in_cells(data: Histogram, values: FloatArray) -> FloatArray:
    """Sum values (blocks, bins) over groups of range and parts of phase, (groups, parts)."""
    groups, bins = int(data.group.max()) + 1, values.shape[1]
    cell = data.group[:, None] * ERROR_CELLS + np.arange(bins) * ERROR_CELLS // bins
    summed = np.bincount(cell.ravel(), values.ravel(), groups * ERROR_CELLS)
    return np.asarray(summed.reshape(groups, ERROR_CELLS), float)


def with_fitted_errors(fit: Fit) -> FloatArray:
    """Return expected intensity (blocks, bins) with the errors that the image tells."""
    means = expected_at(fit, fit.z)[0]
    errors = fit.data.errors.reshape(-1, means.size)
    if not len(errors):
        return means
    residuals = np.empty(means.shape)
    fill_residuals(means, fit.data, residuals)
    told = fit.data.error_gain @ (errors @ residuals.ravel())
    return np.asarray(means * np.exp((told @ errors).reshape(means.shape)))


def misfit_of(fit: Fit, whole: Histogram) -> float:
    """Relative error of the expected intensity beyond speckle, root mean square over what is lit.

    Of groups of range and parts of phase, and beyond the errors of law and profile that the
    likelihood allows for. What is dark weighs less, by the square of its intensity: side lobes are
    light there.

    Parameters
    ----------
    fit : Fit
    whole : Histogram
        Of whole pixels.

    Returns
    -------
    float
    """
    means = with_fitted_errors(fit)
    sums = whole.pixel_count, whole.intensity_sum, whole.pixel_count * means
    pixels, seen, expected = (in_cells(whole, v) for v in sums)
    count = np.maximum(pixels, 1.0)
    bright = np.minimum(np.maximum(seen, expected) / count, 1.0)
    beyond = (seen / np.maximum(expected, 1e-300) - 1) ** 2 - fit.noise_factor / count
    return float(np.sqrt(max(np.average(beyond, weights=pixels * bright**2), 0.0)))


def bin_weights(fit: Fit, noise_factor: float, pixel_size: float) -> FloatArray:
    """Tell what a pixel of each bin is worth (blocks, bins): less where the model may err.

    A relative error of the expected intensity is shared by the pixels of a cell, a group of range
    and a part of phase. Another, and a displacement of the pulse, are shared by all that show a
    part of phase. Integrated out, an error of standard deviation s that n pixels share leaves them
    the weight 1 / (F + n s^2). The relative errors are what the clip's own misfit shows, the first
    no less than MODEL_ERROR.

    Parameters
    ----------
    fit : Fit
        With a histogram of whole pixels.
    noise_factor : float
        F, variance of the speckle over that of independent pixels.
    pixel_size : float
        m.

    Returns
    -------
    ndarray (blocks, bins)
    """
    data = fit.data
    means = expected_at(fit, fit.z)[0]
    bins = means.shape[1]
    logs = np.log(means)
    slope = 0.5 * bins * (np.roll(logs, -1, axis=1) - np.roll(logs, 1, axis=1))
    which = 0 if fit.phase.rigid else 1
    least = (MODEL_ERROR, FIELD_ERROR)[which] ** 2
    turn = (0.0, FIELD_SHIFT)[which]
    shift = np.hypot(MODEL_SHIFT * pixel_size * fit.geometry.along, turn)
    groups = int(data.group.max()) + 1
    part = np.arange(bins) * ERROR_CELLS // bins
    total = partial(in_cells, data)
    pixels = total(data.pixel_count)
    count = np.maximum(pixels, 1.0)
    displacement = (shift * slope) ** 2
    displaced = total(data.pixel_count * displacement) / count
    brighter = np.maximum(total(data.intensity_sum), total(data.pixel_count * means)) / count
    dark = (DARK_ERROR[which] / np.maximum(brighter, LEAST_LIGHT)) ** 2
    misfit = total(data.intensity_sum / means) / count - 1
    # what misfit the bright cells show
    weight = pixels * least / (least + dark)
    both = np.average(misfit**2 - noise_factor / count - displaced, weights=weight)
    whole = np.maximum(weight.sum(axis=0), 1e-9)
    shared = (weight * misfit).sum(axis=0) / whole
    speckle = noise_factor * (weight**2 / count).sum(axis=0) / whole**2
    displaced = (weight * displaced).sum(axis=0) / whole
    common = np.average(shared**2 - speckle - displaced, weights=whole)
    common = max((common - both / groups) / (1 - 1 / groups), 0.0) if groups > 1 else 0.0
    error = max(both - common, least)
    known = (count * (error + dark))[data.group][:, part]
    known = known + pixels.sum(axis=0)[part] * (common + displacement)
    return np.asarray(1 / (noise_factor + known))


def painted(image: Image, fit: Fit, used: BoolArray, means: FloatArray) -> FloatArray:
    """Spread bins (blocks, bins) over the pixels that are used, times the trend; 0 elsewhere."""
    model = paint_pixels(
        used,
        image.ground_range,
        fit.phase.cycles,
        fit.phase.per_pixel(image),
        fit.data.ground_range,
        means,
    )
    return np.asarray(model * spread_boxes(fit.trend, fit.phase.box, image.shape))


def reoptimised(fit: Fit, data: Histogram, geometry: Geometry, rounds: int) -> Fit:
    """Climb on from a fit's peaks on another histogram or geometry."""
    peaks = distinct([fisher_scoring(p.z, data, geometry, rounds) for p in fit.peaks], PEAKS)
    return fit._replace(data=data, geometry=geometry, peaks=peaks)
