"""The fit of one wave in a clip, and the images that its parameters render."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import BoolArray, FloatArray
from sasmap.ripples.image import Image
from sasmap.ripples.optimise import Peak
from sasmap.ripples.phase import PhaseField
from sasmap.ripples.pixels import paint_pixels, spread_boxes
from sasmap.ripples.rendering import (
    Geometry,
    Histogram,
    fill_expected,
    parameters_at,
    pulses_of,
)


class Fit(NamedTuple):
    """A clip binned by phase and range, and the likeliest parameters.

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
        Log likelihood ratio of the likeliest ripple to a flat sea floor, for independent speckle.
    unlike : float
        Standard deviation of log A_H from place to place
        (:func:`sasmap.ripples.residuals.spread_of_heights`).
    tilt : float
        Standard deviation of the slope of the phase over range, cycles/m
        (:func:`sasmap.ripples.errors.slope_error`).
    across : tuple of float
        Wave number across the look and its standard deviation, cycles/m.
    """

    phase: PhaseField
    trend: FloatArray
    data: Histogram
    geometry: Geometry
    peaks: list[Peak]
    noise_factor: float = 1.0
    explained: float = 0.0
    unlike: float = 0.0
    tilt: float = 0.0
    across: tuple[float, float] = (0.0, 0.0)

    @property
    def z(self) -> FloatArray:
        """Sampling coordinates of the likeliest peak."""
        return self.peaks[0].z


def pulses_at(fit: Fit, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Render pulses (blocks, bins) over ripple phase, and their lags (blocks,), at coordinates."""
    return pulses_of(parameters_at(z, fit.geometry), fit.data, fit.geometry)


def lag_over_range(fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Return ground ranges (m) and the phase lag of the image's fundamental there, rad."""
    return fit.data.ground_range, np.unwrap(pulses_at(fit, fit.z)[1])


def expected_at(fit: Fit, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return expected intensity over the local mean (blocks, bins) and gains (blocks,)."""
    means, gains = np.empty(fit.data.pixel_count.shape), np.empty(len(fit.data.place))
    fill_expected(parameters_at(z, fit.geometry), fit.data, fit.geometry, means, gains)
    return means, gains


def log_slope(fit: Fit, coordinate: int, step: float) -> FloatArray:
    """Return the derivative of the log expected intensity (blocks, bins) by a coordinate."""
    lower, higher = fit.z.copy(), fit.z.copy()
    lower[coordinate] -= step
    higher[coordinate] += step
    logs = [np.log(expected_at(fit, z)[0]) for z in (lower, higher)]
    return np.asarray((logs[1] - logs[0]) / (2 * step))


def painted(image: Image, fit: Fit, used: BoolArray, means: FloatArray) -> FloatArray:
    """Spread means of bins (blocks, bins) over the used pixels, times the trend; 0 elsewhere."""
    model = spread_bins(image, fit, used, means)
    return np.asarray(model * spread_boxes(fit.trend, fit.phase.box, image.shape))


def spread_bins(image: Image, fit: Fit, used: BoolArray, values: FloatArray) -> FloatArray:
    """Spread values of bins (blocks, bins) over the used pixels; 0 elsewhere."""
    phase, reach = fit.phase, fit.data.ground_range
    return np.asarray(
        paint_pixels(used, image.ground_range, phase.cycles, phase.per_pixel(image), reach, values)
    )
