"""What a fit's residuals at the pixels tell that its histogram does not."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from sasmap.arrays import BoolArray, FloatArray
from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.errors import HEIGHT_STEP, per_cycle, with_fitted_errors
from sasmap.ripples.image import Image
from sasmap.ripples.optimise import HEIGHT
from sasmap.ripples.rendered import Fit, expected_at, log_slope, painted, spread_bins
from sasmap.ripples.rendering import HEIGHT_TREND, Histogram

# Least pixels of a square of one wavelength over those of a full one, for it to be used (a choice).
COVERED = 0.3


def across_look(image: Image, fit: Fit, whole: Histogram, used: BoolArray) -> tuple[float, float]:
    """Estimate the wave number across the look, and its standard deviation, cycles/m.

    One step of Fisher scoring over the pixels: the histogram's sums do not show how far crests
    turn. A phase field states its own.
    """
    across = fit.geometry.across
    if not fit.phase.rigid:
        return across, float(fit.phase.wave_sd[1])
    means, pixels = expected_at(fit, fit.z)[0], whole.pixel_count
    slope, weight = per_cycle(fit), _weight(fit, whole)
    residual = _relative(image, fit, means, used)
    pull = residual * spread_bins(image, fit, used, weight * slope)[used]
    x, y = (place[used] for place in image.places())
    x, y = x - x.mean(), y - y.mean()
    y = y - (x @ y) / max(x @ x, 1e-12) * x
    told, square = (pixels * weight * slope**2).sum(), float(np.mean(y**2))
    noise = fit.noise_factor * (pixels * (weight * slope) ** 2).sum()
    error = np.sqrt(noise * square) / max(told * square, 1e-12)
    error = np.hypot(error, fit.phase.wave_sd[1])
    return across + float(pull @ y / max(told * square, 1e-12)), float(error)


def spread_of_heights(image: Image, fit: Fit, whole: Histogram, used: BoolArray) -> float:
    """Estimate the standard deviation of log A_H between squares of one wavelength.

    In each square the log of A_H departs from the fit's by one step of Fisher scoring over its
    pixels. What speckle adds to the variance of these steps is subtracted, and so is the change
    over range that the likelihood allows for. Where single waves differ, squares hold parts of two
    of them and crests are oblique, so that heights differ by 2 to 3 times as much.
    """
    slope = log_slope(fit, HEIGHT, HEIGHT_STEP)
    weight = _weight(fit, whole)
    size = 1 / float(np.hypot(*image.per_pixel(fit.phase.wave)))
    row, column = ((place[used] / size).astype(int) for place in np.indices(image.shape))
    square = row * (int(image.shape[1] / size) + 1) + column

    def summed(values: FloatArray, times: FloatArray | float = 1.0) -> FloatArray:
        """Sum values of bins over the pixels of each square, each times a value of the pixel."""
        painted_values = spread_bins(image, fit, used, values)[used]
        return np.asarray(np.bincount(square, times * painted_values))

    pull = summed(weight * slope, _relative(image, fit, with_fitted_errors(fit), used))
    told, noise = summed(weight * slope**2), fit.noise_factor * summed((weight * slope) ** 2)
    pixels = np.bincount(square)
    filled = (pixels > COVERED * size**2) & (told > 0)
    left = int(filled.sum()) - len(HEIGHT_TREND) - 1
    if left <= 0:
        return 0.0
    place = np.bincount(square, image.project(image.look)[used])[filled] / pixels[filled]
    place = (place - place.min()) / max(float(np.ptp(place)), 1e-9)
    trend = np.cos(np.pi * place[:, None] * np.arange(len(HEIGHT_TREND) + 1))
    pull, told, root = pull[filled], told[filled], np.sqrt(told[filled])
    known = np.linalg.lstsq(trend * root[:, None], pull / root)[0]
    rest = np.abs(pull / told - trend @ known)
    speckle = np.median(noise[filled] / told**2)
    # squares that hold a fork differ in phase, not in height: a median passes over them
    variance = (np.median(rest) / norm.ppf(0.75)) ** 2 * place.size / left - speckle
    return float(np.sqrt(max(variance, 0.0)))


def _relative(image: Image, fit: Fit, means: FloatArray, used: BoolArray) -> FloatArray:
    """Intensity of the used pixels over that expected from means of bins, minus 1."""
    model = painted(image, fit, used, means)[used]
    return np.asarray((image.power[used] + DYNAMIC_RANGE) / np.maximum(model, 1e-300) - 1)


def _weight(fit: Fit, whole: Histogram) -> FloatArray:
    """Weight of a pixel in each bin, (blocks, bins)."""
    return np.asarray(fit.data.pixel_count / np.maximum(whole.pixel_count, 1.0))
