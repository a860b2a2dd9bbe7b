"""Errors of the model of a clip: those that enter the likelihood, and those added to f."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.ripples.optimise import PHASE
from sasmap.ripples.rendered import Fit, expected_at, log_slope, pulses_at
from sasmap.ripples.rendering import (
    Geometry,
    Histogram,
    error_gain,
    fill_residuals,
    line_of_lags,
    parameters_at,
    pulses_of,
)

# Errors of the model: least relative error of the expected intensity that is shared by the pixels
# of a cell (a group of range and one of ERROR_CELLS parts of phase), with straight crests and where
# a phase field is followed; displacement of the pulse that all groups share, in pixels, and in
# cycles where a field is followed (pipelines/ripples/coherent.py).
MODEL_ERROR, FIELD_ERROR, MODEL_SHIFT, FIELD_SHIFT, ERROR_CELLS = 0.025, 0.04, 0.15, 0.02, 16
# Error of the expected intensity over the clip's mean, with straight crests and where a field is
# followed: side lobes, and lit sea floor at forks and defects where the model has shadow.
DARK_ERROR = (0.002, 0.01)
# Expected intensity over the clip's mean below which a cell or pixel is dark, and the floor of the
# intensity that errors of dark cells are divided by.
DARK, LEAST_LIGHT = 0.1, 1e-4
# Quantile over ranges of the light in shadow beyond which it is local: where a patch lights the
# shadows of more than half of the ranges, the median took it for lower ripples in 2 of 10 clips
# (pipelines/studies/patches.py).
LOCAL_LIGHT = 0.25
# Standard deviations: departure of the log of a scattering law from its family at each knot (rough
# floors have a peak near normal incidence), and third harmonic of the profile over A_H.
LAW_ERROR = (0.15, 0.2, 0.3, 0.35, 0.35, 0.8)
THIRD_HARMONIC = (0.03, 0.03)
# Steps of finite differences: of log A_H, and of the errors above, standard deviations.
HEIGHT_STEP, ERROR_STEP = 0.05, 0.7
# Least share of the mean intensity that is not noise floor, by which errors are scaled.
LEAST_SIGNAL = 0.01
# Standard deviation of the pulse's second harmonic, over its mean, where crests bend.
FIELD_HARMONIC = 0.03


def with_errors(fit: Fit) -> Fit:
    """Give a fit's histogram the model errors that all bins share.

    The errors are the crest profile's third harmonic and the scattering law's departure from its
    family; where a phase field is followed, also that the pulse of crests of many wavelengths and
    directions differs from that of their mean. They are integrated out to second order.
    """
    data, geometry = fit.data, fit.geometry
    errors = [_slope_of(fit, lower, higher) for lower, higher in _beside(geometry)]
    if not fit.phase.rigid:
        bins = data.pixel_count.shape[1]
        angle = 2 * np.pi * ((np.arange(bins) + 0.5) / bins + data.phase_offset)
        errors += [FIELD_HARMONIC * np.cos(2 * angle), FIELD_HARMONIC * np.sin(2 * angle)]
    if not errors:
        return fit
    signal = max(1.0 - parameters_at(fit.z, geometry).noise, LEAST_SIGNAL)
    return fit._replace(data=sharing(data, np.array(errors), np.zeros(len(errors)), signal))


def sharing(data: Histogram, errors: FloatArray, fitted: FloatArray, signal: float) -> Histogram:
    """Return a histogram with these errors (errors, blocks, bins), one standard deviation each.

    `signal` is the share of the mean intensity that was not noise floor where they were computed.
    """
    flat = errors.reshape(len(errors), -1)
    information = (flat * data.pixel_count.ravel()) @ flat.T
    size, axes = np.linalg.eigh(information)
    return data._replace(
        errors=errors,
        error_axes=np.ascontiguousarray(axes),
        error_information=np.maximum(size, 0.0),
        error_signal=signal,
        error_fitted=fitted,
    )


def _beside(geometry: Geometry) -> list[tuple[Geometry, Geometry]]:
    """Geometries with each error ERROR_STEP standard deviations lower and higher."""
    kinds: dict[str, tuple[float, ...]] = {}
    if not geometry.published:
        kinds["third_harmonic"] = THIRD_HARMONIC
    if np.isnan(geometry.fixed[0]):
        kinds["law_error"] = LAW_ERROR
    pairs = []
    for name, sd in kinds.items():
        for step in ERROR_STEP * np.diag(sd):
            changed: list[dict[str, Any]] = [
                {name: getattr(geometry, name) + sign * step} for sign in (-1, 1)
            ]
            pairs.append((geometry._replace(**changed[0]), geometry._replace(**changed[1])))
    return pairs


def _slope_of(fit: Fit, lower: Geometry, higher: Geometry) -> FloatArray:
    """Change of the log expected intensity (blocks, bins) by one standard deviation of an error."""
    logs = [np.log(expected_at(fit._replace(geometry=g), fit.z)[0]) for g in (lower, higher)]
    return np.asarray((logs[1] - logs[0]) / (2 * ERROR_STEP))


def fitted_amplitudes(fit: Fit, means: FloatArray) -> FloatArray:
    """Amplitudes of the errors in the image beyond those that the fit contains, (errors,)."""
    residuals = np.empty(means.shape)
    fill_residuals(means, fit.data, residuals, np.empty(means.shape))
    errors = fit.data.errors.reshape(len(fit.data.errors), -1)
    return np.asarray(error_gain(fit.data) @ (errors @ residuals.ravel() - fit.data.error_fitted))


def turned_by_errors(fit: Fit) -> FloatArray:
    """Compute by how much a standard deviation of each error changes the slope of lags over range.

    Errors of law and profile also turn the image's phase.

    Parameters
    ----------
    fit : Fit
        Its histogram as :func:`with_errors` returns it.

    Returns
    -------
    ndarray (errors,)
        Cycles/m.
    """
    turned = np.zeros(len(fit.data.errors))
    if not turned.size:
        return turned
    for k, pair in enumerate(_beside(fit.geometry)):
        lags = [pulses_at(fit._replace(geometry=g), fit.z)[1] for g in pair]
        turned[k] = line_of_lags(_turn(*lags), fit.data)[0] / (4 * np.pi * ERROR_STEP)
    return turned


def lag_per_height(fit: Fit) -> FloatArray:
    """Compute the derivative of lags with respect to log A_H at a fit's peak, rad, (blocks,)."""
    ripple = parameters_at(fit.z, fit.geometry)
    lags = []
    for step in (-HEIGHT_STEP, HEIGHT_STEP):
        moved = ripple._replace(height=float(ripple.height * np.exp(step)))
        lags.append(pulses_of(moved, fit.data, fit.geometry)[1])
    return _turn(*lags) / (2 * HEIGHT_STEP)


def _turn(first: FloatArray, second: FloatArray) -> FloatArray:
    """Angles from the first to the second, rad, within half a turn."""
    return np.asarray(np.angle(np.exp(1j * (second - first))))


def in_cells(data: Histogram, values: FloatArray) -> FloatArray:
    """Sum values (blocks, bins) over groups of range and parts of phase, (groups, parts)."""
    groups, bins = int(data.group.max()) + 1, values.shape[1]
    cell = data.group[:, None] * ERROR_CELLS + np.arange(bins) * ERROR_CELLS // bins
    summed = np.bincount(cell.ravel(), values.ravel(), groups * ERROR_CELLS)
    return np.asarray(summed.reshape(groups, ERROR_CELLS), float)


def _to_bins(data: Histogram, cells: FloatArray) -> FloatArray:
    """Give each bin (blocks, bins) the value of its cell (groups, parts)."""
    bins = data.pixel_count.shape[1]
    return np.asarray(cells[data.group][:, np.arange(bins) * ERROR_CELLS // bins])


def weighed(data: Histogram, weight: FloatArray) -> Histogram:
    """Return a histogram whose pixels have these weights (blocks, bins)."""
    return data._replace(
        pixel_count=weight * data.pixel_count, intensity_sum=weight * data.intensity_sum
    )


def with_fitted_errors(fit: Fit) -> FloatArray:
    """Return expected intensity (blocks, bins) with the model errors fitted to the image."""
    means = expected_at(fit, fit.z)[0]
    if not len(fit.data.errors):
        return means
    errors = fit.data.errors.reshape(-1, means.size)
    return np.asarray(means * np.exp((fitted_amplitudes(fit, means) @ errors).reshape(means.shape)))


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
    own, common = _shared(fit, whole, means, _displacement(fit, per_cycle(fit), pixel_size))
    return np.asarray(1 / (fit.noise_factor + own + common))


def slope_error(fit: Fit, whole: Histogram, pixel_size: float) -> float:
    """Compute the standard deviation of the slope of the phase over range.

    With straight crests it comes from speckle and from errors specific to each range; errors that
    all ranges share shift all phases equally. Crests seen square-on fall on the same places of the
    pixels in every row, so that the displacement of a pulse is one of each range. A phase field
    states its own.

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
    means, slope = with_fitted_errors(fit), per_cycle(fit)
    displacement = _displacement(fit, slope, pixel_size)
    own, _ = _shared(fit, whole, means, displacement)
    rows = 1 + abs(fit.geometry.across) / fit.geometry.along * max(fit.phase.shape)
    own = own + _to_bins(whole, in_cells(whole, whole.pixel_count)) * displacement / rows
    told = (whole.pixel_count / (fit.noise_factor + own) * slope**2).sum(1)
    apart = whole.place - np.average(whole.place, weights=told)
    return float(np.hypot(1 / np.sqrt(max(told @ apart**2, 1e-12)), fit.phase.wave_sd[0]))


def per_cycle(fit: Fit) -> FloatArray:
    """Return the derivative of the log expected intensity (blocks, bins) by phase, per cycle.

    The phase of all crests is changed, as neighbouring bins may lie at different ranges.
    """
    step = 2 * np.pi / fit.data.pixel_count.shape[1]
    return 2 * np.pi * log_slope(fit, PHASE, step)


def _displacement(fit: Fit, slope: FloatArray, pixel_size: float) -> FloatArray:
    """Variance of the log expected intensity due to a displacement of the pulse, (blocks, bins).

    `slope` is that of :func:`per_cycle`.
    """
    shift = np.hypot(
        MODEL_SHIFT * pixel_size * fit.geometry.along, 0 if fit.phase.rigid else FIELD_SHIFT
    )
    return np.asarray((shift * slope) ** 2)


def local_light(pixels: FloatArray, seen: FloatArray, expected: FloatArray) -> FloatArray:
    """Compute the error of shadows that are lit at some ranges: pixels times its relative variance.

    A fork, an object or an edge of the ripples lights the shadows of some ranges; a height that is
    wrong leaves light in those of nearly all. It is one error for all dark cells of that range.

    Parameters
    ----------
    pixels, seen : ndarray (groups, parts)
        Pixels and intensities of cells.
    expected : ndarray (groups, parts) or (parts,)
    """
    beyond = seen - expected
    light = np.maximum(beyond - np.quantile(beyond, LOCAL_LIGHT, axis=0), 0.0)
    light = light / np.maximum(seen, LEAST_LIGHT)
    dark = expected < DARK
    shadow = np.where(dark, pixels, 0.0).sum(axis=1, keepdims=True)
    return np.asarray(np.where(dark, shadow * light**2, 0.0))


def without_local_light(data: Histogram) -> Histogram:
    """Weigh the pixels of a histogram by the error of shadows that are lit at some ranges."""
    pixels, seen = in_cells(data, data.pixel_count), in_cells(data, data.intensity_sum)
    seen = seen / np.maximum(pixels, 1.0)
    error = local_light(pixels, seen, np.quantile(seen, LOCAL_LIGHT, axis=0))
    return weighed(data, 1 / (1 + _to_bins(data, error)))


def _shared(
    fit: Fit, whole: Histogram, means: FloatArray, displacement: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return pixel counts times the variance of the errors that they share, (blocks, bins) each.

    The first is for a relative error of the expected intensity shared within a cell (a group of
    range and a part of phase). The second is for a relative error and a displacement of the pulse
    shared by all pixels of a part of phase. The relative errors are estimated from the clip's own
    misfit, the first at least MODEL_ERROR (FIELD_ERROR where a phase field is followed);
    `displacement` is that of :func:`_displacement`.
    """
    bins, noise_factor = means.shape[1], fit.noise_factor
    which = 0 if fit.phase.rigid else 1
    least = (MODEL_ERROR, FIELD_ERROR)[which] ** 2
    groups = int(whole.group.max()) + 1
    part = np.arange(bins) * ERROR_CELLS // bins
    total = partial(in_cells, whole)
    pixels = total(whole.pixel_count)
    count = np.maximum(pixels, 1.0)
    displaced = total(whole.pixel_count * displacement) / count
    seen, expected = total(whole.intensity_sum) / count, total(whole.pixel_count * means) / count
    brighter = np.maximum(np.maximum(seen, expected), LEAST_LIGHT)
    dark = (DARK_ERROR[which] / brighter) ** 2 + local_light(pixels, seen, expected) / count
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
    own = _to_bins(whole, count * (error + dark))
    return own, pixels.sum(axis=0)[part] * (common + displacement)
