"""Errors of the model of a clip: those that enter the likelihood, and those added to f."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.optimise import BLUR, COORDINATES, NOISE_SLOPE, line_of_lags
from sasmap.ripples.rendered import Fit, expected_at, expected_of, pulses_at, pulses_of
from sasmap.ripples.rendering import Geometry, Histogram, Parameters, fill_residuals, parameters_at

FloatArray = NDArray[np.float64]

# Errors of the model: least relative error of the expected intensity that is shared by the pixels
# of a cell (a group of range and one of ERROR_CELLS parts of phase), with straight crests and where
# a phase field is followed; displacement of the pulse that all groups share, in pixels, and in
# cycles where a field is followed (pipelines/ripples/coherent.py).
MODEL_ERROR, FIELD_ERROR, MODEL_SHIFT, FIELD_SHIFT, ERROR_CELLS = 0.02, 0.04, 0.15, 0.02, 16
# Error of the expected intensity over the clip's mean, with straight crests and where a field is
# followed: side lobes, and lit sea floor at forks and defects where the model has shadow.
DARK_ERROR = (0.002, 0.01)
# Floor of the intensity over the clip's mean that this error is divided by.
LEAST_LIGHT = 1e-4
# Standard deviations: departure of the log of a scattering law from its family at each knot (rough
# floors have a peak near normal incidence), and third harmonic of the profile over A_H.
LAW_ERROR, THIRD_HARMONIC = (0.15, 0.2, 0.3, 0.35, 0.35, 0.8), 0.03
# Change of log A_H over the range of a clip: standard deviations of its first cosines, and step of
# the finite difference. Of 53 cells of an independent simulator, whose heights change by factors of
# 1.3 to 10 or come in groups, 8 were off by 4 standard deviations and 20 % without it, 1 with 0.07
# and 1 with 0.1, where calibration is worse (pipelines/ripples/calibration.py).
HEIGHT_TREND, HEIGHT_STEP = (0.07, 0.07, 0.07), 0.05
# Step of the finite difference for parameters that are not sampled, in their sampling coordinates.
PARAMETER_STEP = 0.1
# Standard deviation of the pulse's second harmonic, over its mean, where crests bend.
FIELD_HARMONIC = 0.03


def with_errors(fit: Fit) -> Histogram:
    """Return the histogram with the model errors that all bins share.

    The errors are the scattering law's departure from its family, the crest profile's third
    harmonic, and heights that change over range; where a phase field is followed, also that the
    pulse of crests of many wavelengths and directions differs from that of their mean. They are
    integrated out to second order.
    """
    data = fit.data
    logs = np.log(expected_at(fit, fit.z)[0])
    wrong = [fit._replace(geometry=g) for g in _geometries(fit.geometry)]
    errors = [np.log(expected_at(other, other.z)[0]) - logs for other in wrong]
    if not fit.geometry.published:
        errors += _height_trends(fit)
    if not fit.phase.rigid:
        bins = logs.shape[1]
        angle = 2 * np.pi * ((np.arange(bins) + 0.5) / bins + data.phase_offset)
        errors += [FIELD_HARMONIC * np.cos(2 * angle), FIELD_HARMONIC * np.sin(2 * angle)]
    return _sharing(data, np.array(errors)) if errors else data


def _sharing(data: Histogram, errors: FloatArray) -> Histogram:
    """Return a histogram with these errors (errors, blocks, bins), one standard deviation each."""
    flat = errors.reshape(len(errors), -1)
    information = (flat * data.pixel_count.ravel()) @ flat.T
    gain = np.asarray(np.linalg.inv(information + np.eye(len(errors))), np.float64)
    return data._replace(errors=errors, error_gain=gain)


def with_fixed_parameters(fit: Fit) -> Histogram:
    """Return the histogram with, further, the errors of parameters that are fitted but not sampled.

    Blur and noise slope are integrated out about their fitted values, to second order.
    """
    shapes = []
    for i in (NOISE_SLOPE, BLUR):
        step = PARAMETER_STEP * np.eye(COORDINATES)[i]
        lower, higher = (np.log(expected_at(fit, z)[0]) for z in (fit.z - step, fit.z + step))
        shapes.append((higher - lower) / (2 * PARAMETER_STEP))
    return _sharing(fit.data, np.concatenate([fit.data.errors, shapes]))


def _geometries(geometry: Geometry) -> list[Geometry]:
    """Geometries whose crest profile or scattering law is off by one standard deviation."""
    others = []
    if not geometry.published:
        others = [geometry._replace(third_harmonic=v) for v in THIRD_HARMONIC * np.eye(2)]
    if np.isnan(geometry.fixed[0]):
        others += [geometry._replace(law_error=v) for v in np.diag(LAW_ERROR)]
    return others


def _height_trends(fit: Fit) -> list[FloatArray]:
    """Errors of the log expected intensity from changes of A_H over range, (blocks, bins) each."""
    lower, higher = (np.log(expected_of(fit, ripple)[0]) for ripple in _lower_and_higher(fit))
    slope = (higher - lower) / (2 * HEIGHT_STEP)
    return [change[:, None] * slope for change in _changes(fit.data)]


def _lower_and_higher(fit: Fit) -> list[Parameters]:
    """Parameters at a fit's peak with A_H a step lower and higher."""
    ripple = parameters_at(fit.z, fit.geometry)
    steps = np.exp([-HEIGHT_STEP, HEIGHT_STEP])
    return [ripple._replace(height=float(ripple.height * step)) for step in steps]


def _changes(data: Histogram) -> list[FloatArray]:
    """Return changes of log A_H over range, one standard deviation each, (blocks,)."""
    across = (data.place - data.place.min()) / max(float(np.ptp(data.place)), 1e-9)
    return [sd * np.cos(np.pi * k * across) for k, sd in enumerate(HEIGHT_TREND, 1)]


def turned_by_errors(fit: Fit) -> float:
    """Compute the standard deviation of the slope of lags over range due to the model's errors.

    Errors of law and profile, and heights that change over range, also turn the image's phase. With
    straight crests their posterior given the image is used, with a phase field their prior.

    Parameters
    ----------
    fit : Fit
        Its histogram as :func:`with_errors` returns it.

    Returns
    -------
    float
        Cycles/m.
    """
    data = fit.data
    if not len(data.errors):
        return 0.0
    others = (pulses_at(fit._replace(geometry=g), fit.z)[1] for g in _geometries(fit.geometry))
    lags = pulses_at(fit, fit.z)[1]
    turned = [_turn(lags, other) for other in others]
    if not fit.geometry.published:
        slope = lag_per_height(fit)
        turned += [change * slope for change in _changes(data)]
    slopes = np.array([line_of_lags(turn, data)[0] for turn in turned])
    left = data.error_gain[: slopes.size, : slopes.size] if fit.phase.rigid else np.eye(slopes.size)
    return float(np.sqrt(slopes @ left @ slopes)) / (2 * np.pi)


def lag_per_height(fit: Fit) -> FloatArray:
    """Compute the derivative of lags with respect to log A_H at a fit's peak, rad, (blocks,)."""
    lower, higher = (pulses_of(fit, ripple)[1] for ripple in _lower_and_higher(fit))
    return _turn(lower, higher) / (2 * HEIGHT_STEP)


def _turn(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles from the first to the second, rad, within half a turn."""
    return np.asarray(np.angle(np.exp(1j * (second - first))))


def in_cells(data: Histogram, values: FloatArray) -> FloatArray:
    """Sum values (blocks, bins) over groups of range and parts of phase, (groups, parts)."""
    groups, bins = int(data.group.max()) + 1, values.shape[1]
    cell = data.group[:, None] * ERROR_CELLS + np.arange(bins) * ERROR_CELLS // bins
    summed = np.bincount(cell.ravel(), values.ravel(), groups * ERROR_CELLS)
    return np.asarray(summed.reshape(groups, ERROR_CELLS), float)


def with_fitted_errors(fit: Fit) -> FloatArray:
    """Return expected intensity (blocks, bins) with the model errors fitted to the image."""
    means = expected_at(fit, fit.z)[0]
    errors = fit.data.errors.reshape(-1, means.size)
    if not len(errors):
        return means
    residuals = np.empty(means.shape)
    fill_residuals(means, fit.data, residuals)
    told = fit.data.error_gain @ (errors @ residuals.ravel())
    return np.asarray(means * np.exp((told @ errors).reshape(means.shape)))


def misfit_of(fit: Fit, whole: Histogram, pixel_size: float) -> float:
    """Root mean square relative error of the expected intensity, beyond speckle.

    Computed over cells (groups of range and parts of phase), after the model errors that the
    likelihood allows for are fitted, and beyond the displacement that it allows for. Dark cells
    weigh less, by the square of their intensity, because side lobes brighten them.

    Parameters
    ----------
    fit : Fit
    whole : Histogram
        With all pixels of weight 1.
    pixel_size : float
        m.

    Returns
    -------
    float
    """
    means = with_fitted_errors(fit)
    moved = whole.pixel_count * _displacement(fit, means, pixel_size)
    sums = whole.pixel_count, whole.intensity_sum, whole.pixel_count * means, moved
    pixels, seen, expected, displaced = (in_cells(whole, v) for v in sums)
    count = np.maximum(pixels, 1.0)
    bright = np.minimum(np.maximum(seen, expected) / count, 1.0)
    beyond = (seen / np.maximum(expected, 1e-300) - 1) ** 2
    beyond -= (fit.noise_factor + displaced) / count
    return float(np.sqrt(max(np.average(beyond, weights=pixels * bright**2), 0.0)))


def bin_weights(fit: Fit, whole: Histogram, pixel_size: float) -> FloatArray:
    """Compute the weight of a pixel in each bin (blocks, bins), less where the model may be wrong.

    Integrating out an error of standard deviation s that n pixels share leaves them the weight
    1 / (F + n s^2), with F the fit's noise factor.

    Parameters
    ----------
    fit : Fit
    whole : Histogram
        With all pixels of weight 1.
    pixel_size : float
        m.

    Returns
    -------
    ndarray (blocks, bins)
    """
    means = expected_at(fit, fit.z)[0]
    own, common = _shared(fit, whole, means, pixel_size)
    return np.asarray(1 / (fit.noise_factor + own + common))


def slope_error(fit: Fit, whole: Histogram, pixel_size: float) -> float:
    """Compute the standard deviation of the slope of the phase over range.

    With straight crests it comes from speckle and from errors specific to each range; errors that
    all ranges share shift all phases equally. A phase field states its own.

    Parameters
    ----------
    fit : Fit
    whole : Histogram
        With all pixels of weight 1.
    pixel_size : float
        m.

    Returns
    -------
    float
        Cycles/m.
    """
    if not fit.phase.rigid:
        return float(fit.phase.wave_sd[0])
    means = with_fitted_errors(fit)
    own, _ = _shared(fit, whole, means, pixel_size)
    told = (whole.pixel_count / (fit.noise_factor + own) * per_cycle(np.log(means)) ** 2).sum(1)
    apart = whole.place - np.average(whole.place, weights=told)
    return float(np.hypot(1 / np.sqrt(max(told @ apart**2, 1e-12)), fit.phase.wave_sd[0]))


def per_cycle(logs: FloatArray) -> FloatArray:
    """Return the derivative of values (blocks, bins) with respect to phase, per cycle."""
    return np.asarray(0.5 * logs.shape[1] * (np.roll(logs, -1, axis=1) - np.roll(logs, 1, axis=1)))


def _displacement(fit: Fit, means: FloatArray, pixel_size: float) -> FloatArray:
    """Variance of the log expected intensity due to a displacement of the pulse, (blocks, bins)."""
    shift = np.hypot(
        MODEL_SHIFT * pixel_size * fit.geometry.along, 0 if fit.phase.rigid else FIELD_SHIFT
    )
    return np.asarray((shift * per_cycle(np.log(means))) ** 2)


def _shared(
    fit: Fit, whole: Histogram, means: FloatArray, pixel_size: float
) -> tuple[FloatArray, FloatArray]:
    """Return pixel counts times the variance of the errors that they share, (blocks, bins) each.

    The first is for a relative error of the expected intensity shared within a cell (a group of
    range and a part of phase). The second is for a relative error and a displacement of the pulse
    shared by all pixels of a part of phase. The relative errors are estimated from the clip's own
    misfit, the first at least MODEL_ERROR (FIELD_ERROR where a phase field is followed).
    """
    bins, noise_factor = means.shape[1], fit.noise_factor
    which = 0 if fit.phase.rigid else 1
    least = (MODEL_ERROR, FIELD_ERROR)[which] ** 2
    groups = int(whole.group.max()) + 1
    part = np.arange(bins) * ERROR_CELLS // bins
    total = partial(in_cells, whole)
    pixels = total(whole.pixel_count)
    count = np.maximum(pixels, 1.0)
    displacement = _displacement(fit, means, pixel_size)
    displaced = total(whole.pixel_count * displacement) / count
    brighter = np.maximum(total(whole.intensity_sum), total(whole.pixel_count * means)) / count
    dark = (DARK_ERROR[which] / np.maximum(brighter, LEAST_LIGHT)) ** 2
    misfit = total(whole.intensity_sum / means) / count - 1
    # misfit of the bright cells
    weight = pixels * least / (least + dark)
    both = np.average(misfit**2 - noise_factor / count - displaced, weights=weight)
    light = np.maximum(weight.sum(axis=0), 1e-9)
    shared = (weight * misfit).sum(axis=0) / light
    speckle = noise_factor * (weight**2 / count).sum(axis=0) / light**2
    displaced = (weight * displaced).sum(axis=0) / light
    common = np.average(shared**2 - speckle - displaced, weights=light)
    common = max((common - both / groups) / (1 - 1 / groups), 0.0) if groups > 1 else 0.0
    error = max(both - common, least)
    own = (count * (error + dark))[whole.group][:, part]
    return own, pixels.sum(axis=0)[part] * (common + displacement)
