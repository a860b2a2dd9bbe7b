"""The range of values that a colour ramp covers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio

from sasmap.arrays import FloatArray
from sasmap.catalogue import BY_FILE

# Minimum half-width of the range in standard deviations of the values, so that noise is not
# stretched over the whole ramp: 95 % of a Gaussian.
COVERED = 2.0
# Quantiles between which an amplitude image is stretched: speckle has a long tail.
DARK, BRIGHT = 0.01, 0.99
# Approximate side in pixels of the decimated raster from which the range is computed (bounds time
# and memory).
SIDE = 1000


def has_content(path: Path) -> bool:
    """Whether a raster has any pixel with a value."""
    return sampled(path, 1).size > 0


def sampled(path: Path, band: int) -> FloatArray:
    """Read the valid values (n,) of a raster's band, decimated to about 1000 pixels per side."""
    with rasterio.open(path) as source:
        factor = max(1, max(source.shape) // SIDE)
        shape = (max(source.height // factor, 1), max(source.width // factor, 1))
        values = source.read(band, out_shape=shape, masked=True).compressed()
    return np.asarray(values[np.isfinite(values)], np.float64)


# Gamma of the mosaic's greys in figures and QGIS (a choice: between amplitude and decibels).
GAMMA = 2.0


def range_of(path: Path) -> tuple[float, float]:
    """Return the values of a raster's first and last colour.

    Parameters
    ----------
    path : Path
        A product of the catalogue, with content.

    Returns
    -------
    low, high : float
        The ramp's own limits where it has any; quantiles for amplitudes; otherwise the range of all
        values, and at least the measured uncertainty around their middle.
    """
    product = BY_FILE[path.name]
    assert product.ramp is not None
    if product.ramp.limits is not None:
        return product.ramp.limits
    values = sampled(path, 1)
    if product.kind == "pixels":
        low, high = np.quantile(values, (DARK, BRIGHT))
        return 0.0 if low < 0.5 * high else float(low), float(high)
    sd = sampled(path, 2) if len(product.bands) > 1 else np.zeros(0)
    return padded_range(values, sd)


def padded_range(values: FloatArray, sd: FloatArray) -> tuple[float, float]:
    """Range of values that covers at least their uncertainty.

    Parameters
    ----------
    values : ndarray (n,)
    sd : ndarray (n,)
        Standard deviations; may be empty.

    Returns
    -------
    low, high : float
        high > low.
    """
    low, high = float(values.min()), float(values.max())
    middle = (low + high) / 2
    reach = COVERED * float(np.median(sd)) if sd.size else 0.0
    reach = max(reach, (high - low) / 2, 1e-6 * abs(middle), 1e-9)
    bottom = max(middle - reach, 0.0) if low >= 0 else middle - reach
    return bottom, middle + reach


def digits_for(low: float, high: float) -> int:
    """Decimals that distinguish values within a range."""
    return int(np.clip(1 - np.floor(np.log10(high - low)), 0, 6))
