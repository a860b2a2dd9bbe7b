"""Pixels of a clip, and the sums over bins through which they enter the likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

STRIPS = 16
# Intensity added to every pixel, over the clip's mean: no sonar's image spans more than 30 dB below
# its sea floor, and exact zeros (quantised or simulated shadow) would otherwise count as proof of
# a noise floor of nothing.
DYNAMIC_RANGE = 3e-3
# Bins that altitude may move a shadow's edge by within a strip.
EDGE_SHIFT = 0.5
# Bins by which range at the same u may vary within a strip.
RANGE_VARIATION = 2.0


@dataclass(frozen=True)
class Clip:
    """What one look shows of a patch of sea floor; all arrays (rows, columns).

    Attributes
    ----------
    amplitude : ndarray
        Linear amplitude, NaN where there is none.
    x, y : ndarray
        Map position of the sea floor that the pixel shows, m.
    ground_range, altitude : ndarray
        m.
    look_azimuth : ndarray
        Degrees clockwise from grid north.
    pixel_size : float
        m.
    """

    amplitude: FloatArray
    x: FloatArray
    y: FloatArray
    ground_range: FloatArray
    altitude: FloatArray
    look_azimuth: FloatArray
    pixel_size: float

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels with an amplitude and a known geometry."""
        known = np.isfinite(self.amplitude) & np.isfinite(self.look_azimuth)
        return known & (self.ground_range > 0) & (self.altitude > 0)

    @classmethod
    def from_array(cls, array: xr.DataArray) -> Clip:
        """Take a clip out of an array as :func:`sasmap.open_pass` gives it.

        Parameters
        ----------
        array : DataArray (y, x)
            Amplitude with coordinates ``x``, ``y``, ``ground_range``, ``altitude`` (m) and
            ``look_azimuth`` (degrees), each of one or two dimensions or a scalar; computed here if
            lazy.

        Returns
        -------
        Clip

        Raises
        ------
        ValueError
            Where a coordinate is missing or the array is not two-dimensional.
        """
        if array.ndim != 2:
            raise ValueError(f"expected an array (y, x), got dimensions {array.dims}")
        needed = ("x", "y", "ground_range", "altitude", "look_azimuth")
        missing = [name for name in needed if name not in array.coords]
        if missing:
            raise ValueError(f"expected coordinates {', '.join(missing)}")
        array = array.compute()
        names = {name: name for name in needed}
        if "ground_x" in array.coords:  # slant range: the tile's map position is not the floor's
            names |= {"x": "ground_x", "y": "ground_y"}
        wide = {key: _filled(array.coords[name], array) for key, name in names.items()}
        size = array.attrs.get("pixel_size") or _pixel_size(
            _filled(array.coords["x"], array), _filled(array.coords["y"], array)
        )
        amplitude = np.asarray(array.values, float)
        return cls(amplitude, **wide, pixel_size=float(size))


def _filled(coordinate: xr.DataArray, array: xr.DataArray) -> FloatArray:
    wide = coordinate.broadcast_like(array).transpose(*array.dims)
    return np.asarray(wide.values, float)


def _pixel_size(x: FloatArray, y: FloatArray) -> float:
    steps = [np.hypot(np.diff(x, axis=i), np.diff(y, axis=i)).ravel() for i in (0, 1)]
    steps = [s[np.isfinite(s) & (s > 0)] for s in steps]
    known = [float(np.median(s)) for s in steps if s.size]
    return float(np.sqrt(np.prod(known))) if len(known) == 2 else float((known or [1.0])[0])


@dataclass(frozen=True)
class BinnedClip:
    """Sums over bins: fine along the look (u), strips across it.

    With one model value a bin, Gaussian and exponential likelihoods depend on the pixels only
    through these sums (SCIENCE 3 "An exact shortcut").

    Attributes
    ----------
    pixels : ndarray (strips, bins)
        Pixels.
    total : ndarray (strips, bins)
        Sum of intensity over the clip's mean intensity.
    start, step : float
        u of the first bin's lower edge and bin width, m; u = 0 at the clip's centre.
    range0, range_slope, altitude0, altitude_slope : ndarray (strips,)
        Ground range and altitude, m, linear in u.
    shift : ndarray (bins,)
        Mean place of a bin's pixels, in bins from its centre.
    spread : float
        Width over which a bin's pixels lie, in bins: 0 where each column of pixels is a bin, 1
        where they fill it.
    azimuth : float
        Direction of u, the mean look, degrees clockwise from grid north.
    """

    pixels: FloatArray
    total: FloatArray
    start: float
    step: float
    range0: FloatArray
    range_slope: FloatArray
    altitude0: FloatArray
    altitude_slope: FloatArray
    shift: FloatArray
    spread: float
    azimuth: float

    @property
    def centres(self) -> FloatArray:
        """U of the bin centres, m."""
        return np.asarray(self.start + self.step * (np.arange(self.pixels.shape[1]) + 0.5))

    @property
    def length(self) -> float:
        """Extent along the look, m."""
        return float(self.step * self.pixels.shape[1])

    @property
    def altitude_variation(self) -> float:
        """Altitude's variation across the look over its mean."""
        return float(np.ptp(self.altitude0) / np.mean(self.altitude0))

    def pooled(self, wavelength: float) -> BinnedClip:
        """Merge neighbouring strips where the merged ones see alike.

        Parameters
        ----------
        wavelength : float
            m. Altitude stretches a shadow, which is no longer than this, in proportion.

        Returns
        -------
        BinnedClip
            With strips within which no shadow edge moves by more than about half a bin.
        """
        spread = self.altitude_variation * wavelength / (EDGE_SHIFT * self.step)
        bend = np.ptp(self.range0) / (RANGE_VARIATION * self.step)
        strips = int(np.clip(np.ceil(max(spread, bend)), 1, len(self.pixels)))
        group = np.arange(len(self.pixels)) * strips // len(self.pixels)
        weight = self.pixels.sum(axis=1)

        def summed(values: FloatArray) -> FloatArray:
            return np.add.reduceat(values, np.flatnonzero(np.diff(group, prepend=-1)), axis=0)

        def mean(values: FloatArray) -> FloatArray:
            return np.asarray(summed(weight * values) / summed(weight))

        return replace(
            self,
            pixels=summed(self.pixels),
            total=summed(self.total),
            range0=mean(self.range0),
            range_slope=mean(self.range_slope),
            altitude0=mean(self.altitude0),
            altitude_slope=mean(self.altitude_slope),
        )


def mean_look(clip: Clip) -> float:
    """Return the mean look azimuth of the clip's valid pixels, degrees."""
    azimuth = np.radians(clip.look_azimuth[clip.valid])
    return float(np.degrees(np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())) % 360)


def bin_clip(clip: Clip, values: FloatArray | None = None) -> BinnedClip:
    """Sum a clip's intensity over bins of a pixel along the mean look, in strips across it.

    Parameters
    ----------
    clip : Clip
        With at least one valid pixel.
    values : ndarray (rows, columns), optional
        What to sum instead of the normalised intensity, for example a filtered image.

    Returns
    -------
    BinnedClip
    """
    valid = clip.valid
    azimuth = mean_look(clip)
    u, v = _along_and_across(clip, valid, azimuth)
    step = clip.pixel_size
    start = float(u.min()) - step / 2
    bins = int(np.floor((u.max() - start) / step + 1e-6)) + 1
    column = np.minimum(((u - start) / step + 1e-6).astype(np.int64), bins - 1)
    place = (u - start) / step - column - 0.5
    shift = np.bincount(column, place, bins) / np.maximum(np.bincount(column, minlength=bins), 1)
    around = float(np.sqrt(np.mean((place - shift[column]) ** 2)))
    width = max(np.ptp(v) + step, step)
    strip = np.minimum(((v - v.min()) / width * STRIPS).astype(np.int64), STRIPS - 1)
    index = strip * bins + column

    def summed(weights: Any = None) -> Any:
        flat = np.bincount(index, weights, STRIPS * bins)
        return flat.reshape(STRIPS, bins).astype(float)

    power = normalised(clip, valid)[0] if values is None else values[valid]
    floor = DYNAMIC_RANGE if values is None else 0.0
    count = summed()
    total = summed(power) + floor * count
    centres = np.asarray(start + step * (np.arange(bins) + 0.5), float)
    fits = [
        _linear(centres, count, summed(field[valid]), slope)
        for field, slope in ((clip.ground_range, 1.0), (clip.altitude, 0.0))
    ]
    filled = count.sum(axis=1) > 0
    count, total = count[filled], total[filled]
    (range0, range_slope), (altitude0, altitude_slope) = (
        (level[filled], slope[filled]) for level, slope in fits
    )
    return BinnedClip(
        count,
        total,
        start,
        step,
        range0,
        range_slope,
        altitude0,
        altitude_slope,
        shift,
        min(around * np.sqrt(12.0), 1.0),
        azimuth,
    )


def _along_and_across(
    clip: Clip, valid: NDArray[np.bool_], azimuth: float
) -> tuple[FloatArray, FloatArray]:
    x, y = clip.x[valid], clip.y[valid]
    x, y = x - (x.min() + x.max()) / 2, y - (y.min() + y.max()) / 2
    sine, cosine = np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))
    return x * sine + y * cosine, x * cosine - y * sine


def normalised(clip: Clip, valid: NDArray[np.bool_]) -> tuple[FloatArray, float]:
    """Intensity of the valid pixels over its mean, and the root of that mean.

    By way of the largest amplitude, whose square may not exist.
    """
    amplitude = clip.amplitude[valid]
    largest = float(amplitude.max())
    if largest == 0:
        return np.zeros_like(amplitude), 0.0
    power = (amplitude / largest) ** 2
    mean = float(power.mean())
    return np.asarray(power / mean), largest * float(np.sqrt(mean))


def _linear(
    u: FloatArray, count: FloatArray, summed: FloatArray, default_slope: float
) -> tuple[FloatArray, FloatArray]:
    """Weighted straight line through bin means, strip by strip."""
    weight = np.maximum(count.sum(axis=1), 1)
    mean_u = (count * u).sum(axis=1) / weight
    level = summed.sum(axis=1) / weight
    offset = u - mean_u[:, None]
    spread = (count * offset**2).sum(axis=1)
    covariance = ((summed - count * level[:, None]) * offset).sum(axis=1)
    enough = spread > 0
    slope = np.where(enough, covariance / np.where(enough, spread, 1), default_slope)
    return level - slope * mean_u, slope
