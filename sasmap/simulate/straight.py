"""Clips of straight ripples, exact at each pixel and fast: for studies and tests."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from sasmap.ripples.clip import Clip
from sasmap.simulate.scattering import ProfileName, lit_amplitude, profile_slope, steepest
from sasmap.simulate.shadow import ShadowRule, shadow_mask


def straight_clip(
    rng: np.random.Generator,
    *,
    frequency: float,
    height: float,
    azimuth: float = 90.0,
    phase: float = 0.0,
    near: float = 20.0,
    altitude: float = 5.0,
    pixel_size: float = 0.05,
    shape: tuple[int, int] = (200, 200),
    profile: ProfileName = "sine",
    shadow: ShadowRule = "line-of-sight",
    noise: float = 0.003,
    nu: float = float("inf"),
    correlation: float = 0.0,
    lambert: bool = False,
) -> Clip:
    """Simulate a clip; the sonar looks east from a straight track (docs/science.md).

    Parameters
    ----------
    rng : Generator
    frequency, height : float
        f (cycles/m) and A_H (m).
    azimuth : float
        Azimuth of the crest normal, degrees clockwise from north; that of the look is 90.
    phase : float
        Ripple phase at the clip's centre along the look direction, rad.
    near : float
        Ground range of the first column, m.
    altitude, pixel_size : float
        m.
    shape : tuple of int
    profile : {"sine", "stokes", "peaked"}
    shadow : {"line-of-sight", "crest"}
    noise : float
        Intensity of the receiver noise relative to that of flat sea floor.
    nu : float
        Shape of the speckle's texture; infinite for none.
    correlation : float
        Correlation of the speckle, pixels (standard deviation of the Gaussian filter of the complex
        field).
    lambert : bool
        Scatter by Lambert's law, squared sine of the local grazing angle, instead of sigma_s.

    Returns
    -------
    Clip
    """
    x = pixel_size * np.arange(shape[1]) + np.zeros((shape[0], 1))
    y = pixel_size * np.arange(shape[0])[::-1, None] + np.zeros((1, shape[1]))
    ground_range = near + x
    turn = np.radians(azimuth - 90.0)
    if np.cos(turn) < 0:
        turn += np.pi
    along, across = frequency * np.cos(turn), frequency * np.sin(turn)
    # to the right of the look is south
    place = along * (x - x.mean()) - across * (y - y.mean())
    angle = 2 * np.pi * place + phase
    steepness = 2 * np.pi * frequency * height
    grazing = np.arctan2(altitude, ground_range)
    slope = profile_slope(angle, steepness, profile)
    if lambert:
        tilt = np.arctan(steepness * np.cos(turn) * slope)
        amplitude = np.maximum(np.sin(grazing + tilt), 0) / np.sin(grazing).mean()
    else:
        extreme = steepest(steepness, profile)
        amplitude = lit_amplitude(grazing, slope, extreme, steepness * np.cos(turn))
        amplitude = np.maximum(amplitude, 0) / lit_amplitude(grazing, 0.0, 1.0, 0.0).mean()
    hidden = shadow_mask(angle, ground_range, altitude, along, frequency, height, profile, shadow)
    mean = np.where(hidden, 0.0, amplitude**2) + noise
    field = rng.normal(size=(2, *shape))
    if correlation > 0:
        field = gaussian_filter(field, (0, correlation, correlation), mode="wrap")
        field /= field.std()
    power = 0.5 * (field**2).sum(axis=0)
    if np.isfinite(nu):
        power = power * rng.gamma(nu, 1 / nu, shape)
    result = np.sqrt(mean * power)
    wide = np.full(shape, altitude)
    return Clip(result, x, y, ground_range, wide, np.full(shape, 90.0), pixel_size)
