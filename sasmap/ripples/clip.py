"""Pixels of a clip and their geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from sasmap.arrays import BoolArray, FloatArray

# Intensity added to every pixel, over the clip's mean: no sonar image extends to more than 25 dB
# below its sea floor, and exact zeros (quantised or simulated shadow) would otherwise count as
# proof of a noise floor of zero.
DYNAMIC_RANGE = 3e-3
# Largest intensity over the mean above which amplitudes are capped, and the cap over the median of
# amplitudes above zero.
GLARING, OUTLIER = 300.0, 30.0


# Accuracy of the altitude from an altimeter or a bottom track (standard deviation), m.
ALTITUDE_SD = 0.02


@dataclass(frozen=True)
class Clip:
    """Image of a patch of sea floor from one look; all arrays (rows, columns).

    Attributes
    ----------
    amplitude : ndarray
        Linear amplitude, NaN where there is none.
    x, y : ndarray
        Map position of the sea floor in the pixel, m.
    ground_range, altitude : ndarray
        m.
    look_azimuth : ndarray
        Degrees clockwise from grid north.
    pixel_size : float
        m.
    altitude_sd : float
        Accuracy of the altitude, m.
    """

    amplitude: FloatArray
    x: FloatArray
    y: FloatArray
    ground_range: FloatArray
    altitude: FloatArray
    look_azimuth: FloatArray
    pixel_size: float
    altitude_sd: float = ALTITUDE_SD

    @property
    def valid(self) -> BoolArray:
        """Pixels with an amplitude and a known geometry."""
        known = np.isfinite(self.amplitude) & np.isfinite(self.look_azimuth)
        return known & (self.ground_range > 0) & (self.altitude > 0)

    @classmethod
    def from_array(cls, array: xr.DataArray) -> Clip:
        """Make a clip from an array as :func:`sasmap.open_pass` returns it.

        Parameters
        ----------
        array : DataArray (y, x)
            Amplitude with coordinates ``x``, ``y``, ``ground_range``, ``altitude`` (m) and
            ``look_azimuth`` (degrees), each of one or two dimensions or a scalar; computed here if
            lazy.

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
        known = float(array.attrs.get("altitude_sd", ALTITUDE_SD))
        return cls(amplitude, **wide, pixel_size=float(size), altitude_sd=known)


def _filled(coordinate: xr.DataArray, array: xr.DataArray) -> FloatArray:
    if coordinate.dims == array.dims:
        return np.asarray(coordinate.values, float)
    wide = coordinate.broadcast_like(array).transpose(*array.dims)
    return np.asarray(wide.values, float)


def _pixel_size(x: FloatArray, y: FloatArray) -> float:
    steps = [np.hypot(np.diff(x, axis=i), np.diff(y, axis=i)).ravel() for i in (0, 1)]
    steps = [s[np.isfinite(s) & (s > 0)] for s in steps]
    known = [float(np.median(s)) for s in steps if s.size]
    return float(np.sqrt(np.prod(known))) if len(known) == 2 else float((known or [1.0])[0])


def mean_look(clip: Clip) -> float:
    """Return the mean look azimuth of the clip's valid pixels, degrees."""
    azimuth = np.radians(clip.look_azimuth[clip.valid])
    return float(np.degrees(np.arctan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())) % 360)


def normalised(clip: Clip, valid: BoolArray) -> tuple[FloatArray, float]:
    """Intensity of the valid pixels over its mean, and the root of that mean.

    Amplitudes are first divided by the largest one, whose square may overflow. Pixels brighter than
    speckle can be (defects) are capped, as they would dominate the mean.
    """
    amplitude = clip.amplitude[valid]
    largest = float(amplitude.max())
    if largest == 0:
        return np.zeros_like(amplitude), 0.0
    power = (amplitude / largest) ** 2
    mean = float(power.mean())
    if mean * GLARING < 1:
        largest = min(largest, OUTLIER * float(np.median(amplitude[amplitude > 0])))
        power = np.minimum(amplitude / largest, 1.0) ** 2
        mean = float(power.mean())
    return np.asarray(power / mean), largest * float(np.sqrt(mean))
