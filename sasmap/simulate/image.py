"""Tiles of a simulated pass: scattering, shadow, speckle, noise, quantisation."""

from __future__ import annotations

from typing import cast

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sasmap.arrays import BoolArray, ComplexArray, FloatArray
from sasmap.simulate.coherent import coherent_amplitude
from sasmap.simulate.geometry import StraightTrack, View, track_line
from sasmap.simulate.scattering import (
    ProfileName,
    cross_section,
    lit_amplitude,
    profile_slope,
    shadow_crest_rule,
    steepest,
)
from sasmap.simulate.scene import Scene, ScenePass
from sasmap.simulate.seafloor import SeaFloor, Waves, in_polygon

# Step of the lines of sight over range, pixels (a choice: finer than a pixel resolves).
SIGHT_STEP = 0.5
# Lines of sight start this far before the nearest pixel, m: no ripple's shadow is longer.
SIGHT_REACH = 40.0
NODATA = {"uint8": 0, "uint16": 0, "float32": np.nan}
# Pixel value of the rms amplitude of flat floor: speckle of a facet four times as bright saturates
# 8-bit pixels with probability exp(-9) = 1e-4.
FILL = {"uint8": 255 / 6, "uint16": 65535 / 12, "float32": 1.0}


def record(
    scene: Scene,
    floor: SeaFloor,
    scene_pass: ScenePass,
    transform: Affine,
    shape: tuple[int, int],
    rng: np.random.Generator,
) -> NDArray[np.generic]:
    """Simulate a tile.

    Parameters
    ----------
    scene : Scene
    floor : SeaFloor
    scene_pass : ScenePass
    transform : Affine
        Of the tile.
    shape : tuple of int
        Rows and columns.
    rng : Generator
        With coherent physics, tiles of a pass with equal generators meet without a seam.

    Returns
    -------
    ndarray (rows, columns)
        Of the pass's dtype, with NODATA where the pass does not see the scene.
    """
    line = track_line(scene, scene_pass)
    column, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x = transform.c + transform.a * column + transform.b * row
    y = transform.f + transform.d * column + transform.e * row
    view = line.see(x, y)
    shown = view.ground_range
    if scene_pass.range == "slant":
        squared = view.ground_range**2 - view.altitude**2
        wet = (squared > 0) & (view.ground_range > 0)
        view = view._replace(ground_range=np.where(wet, np.sqrt(np.maximum(squared, 0)), -1.0))
        x, y = line.point(view.along, view.ground_range)
    seen = _covered(scene, scene_pass, x, y) & (view.ground_range > 0)
    amplitude = np.full(shape, np.nan)
    if scene.physics == "coherent":
        key = int(rng.integers(2**63))
        amplitude[seen] = coherent_amplitude(
            scene, floor, scene_pass, view.along[seen], shown[seen], key
        )
        return _quantised(amplitude, scene_pass)
    if seen.any():
        points = x[seen], y[seen], View(*(v[seen] for v in view))
        amplitude[seen] = scattering(
            scene, floor, line, *points, scene_pass.pixel_size or scene.pixel_size
        )
    field = _speckle(scene, floor, scene_pass, x, y, amplitude, rng)
    return _quantised(field, scene_pass)


def _covered(scene: Scene, scene_pass: ScenePass, x: FloatArray, y: FloatArray) -> BoolArray:
    east, north = x - scene.origin[0], y - scene.origin[1]
    inside = (east >= 0) & (east < scene.size[0]) & (north >= 0) & (north < scene.size[1])
    if scene_pass.area is not None:
        inside &= in_polygon(east, north, np.array(scene_pass.area))
    return np.asarray(inside)


def scattering(
    scene: Scene,
    floor: SeaFloor,
    line: StraightTrack,
    x: FloatArray,
    y: FloatArray,
    view: View,
    pixel: float,
) -> FloatArray:
    """Amplitude a* at map points (ZC 3), relative to flat sea floor at the scene's centre.

    Parameters
    ----------
    scene : Scene
    floor : SeaFloor
    line : StraightTrack
    x, y : ndarray
        Map coordinates, m.
    view : View
        Of the same points.
    pixel : float
        Pixel size, m.

    Returns
    -------
    ndarray
        0 in shadow.
    """
    waves = floor.waves(x, y)
    grazing = np.arctan2(view.altitude, view.ground_range)
    along_look = waves.east * line.look[0] + waves.north * line.look[1]
    # seen from behind, the same ripples have a reversed phase (docs/science.md, Orientation)
    phase = np.where(along_look < 0, np.pi - waves.phase, waves.phase)
    along_look = np.abs(along_look)
    steepness = 2 * np.pi * along_look * waves.height
    result = cross_section(grazing)
    for k, patch in enumerate(scene.ripples):
        on = (waves.patch == k) & (waves.height > 0)
        if on.any():
            profile = cast(ProfileName, patch.profile)  # a scene with another one is refused
            full = 2 * np.pi * np.hypot(waves.east[on], waves.north[on]) * waves.height[on]
            slope = profile_slope(phase[on], full, profile)
            extreme = steepest(full, profile)
            result[on] = lit_amplitude(grazing[on], slope, extreme, steepness[on])
    shadow = _shadow(scene, floor, line, view, waves, phase, along_look, pixel)
    centre = line.see(*(np.array([v]) for v in scene.centre))
    reference = cross_section(np.arctan2(centre.altitude, centre.ground_range))
    return np.asarray(np.where(shadow, 0.0, np.maximum(result, 0.0)) / reference)


def _shadow(
    scene: Scene,
    floor: SeaFloor,
    line: StraightTrack,
    view: View,
    waves: Waves,
    phase: FloatArray,
    along_look: FloatArray,
    pixel: float,
) -> BoolArray:
    if not (waves.patch >= 0).any():
        return np.zeros(view.along.shape, bool)
    if scene.shadow == "crest":
        ahead = np.maximum(along_look, 1e-9)
        ruled = shadow_crest_rule(phase, view.ground_range, view.altitude, ahead, waves.height)
        return np.asarray(ruled & (waves.height > 0))
    start = max(0.5 * pixel, float(view.ground_range.min()) - SIGHT_REACH)
    ranges = np.arange(start, float(view.ground_range.max()) + pixel, SIGHT_STEP * pixel)
    first = float(view.along.min())
    place = (view.along - first) / pixel
    # at oblique looks pixels lie between lines of sight, so these are closer together
    apart = pixel if np.abs(place - np.rint(place)).max() < 1e-3 else 0.5 * pixel
    rows = np.arange(first, float(view.along.max()) + pixel, apart)
    highest = np.empty((rows.size, ranges.size))
    for low in range(0, rows.size, 256):  # in stripes, to bound memory
        part = rows[low : low + 256]
        x, y = line.point(part[:, None], ranges)
        rise = (floor.elevation(floor.waves(x, y)) - line.altitude_at(part)[:, None]) / ranges
        highest[low : low + 256] = np.maximum.accumulate(rise, axis=1)
    place = np.clip((view.along - first) / apart, 0, rows.size - 1)
    row = np.minimum(np.floor(place + 1e-3).astype(np.int64), max(rows.size - 2, 0))
    share = np.maximum(place - row, 0)
    # at least half a step before the pixel: the second test covers nearer points
    before = np.floor((view.ground_range - start) / (SIGHT_STEP * pixel) - 0.5 + 1e-6).astype(int)
    rise = (floor.elevation(waves) - view.altitude) / view.ground_range
    column = np.clip(before, 0, ranges.size - 1)
    beside = highest[np.minimum(row + 1, rows.size - 1), column]
    above = highest[row, column] + share * (beside - highest[row, column])
    hidden = (rise < above) & (before >= 0)
    # between two lines: where the rise decreases, a point just before hides this one
    nearer = np.maximum(view.ground_range - 0.02 * pixel, 1e-3 * pixel)
    x, y = line.point(view.along, nearer)
    hidden |= rise < (floor.elevation(floor.waves(x, y)) - view.altitude) / nearer
    return np.asarray(hidden)


def _speckle(
    scene: Scene,
    floor: SeaFloor,
    scene_pass: ScenePass,
    x: FloatArray,
    y: FloatArray,
    amplitude: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Multiply by the sediment's generalised-K speckle and add receiver noise (docs/science.md)."""
    shape = amplitude.shape
    index = floor.sediment(x, y)
    level, nu, kappa = (
        np.array([getattr(s, name) for s in scene.sediments])[index]
        for name in ("level", "nu", "kappa")
    )
    random = _complex_noise(shape, scene_pass.correlation, rng)
    texture = np.ones(shape)
    finite = np.isfinite(nu)
    if finite.any():
        draws = rng.gamma(np.where(finite, nu, 1.0)) / np.where(finite, nu, 1.0)
        texture = np.where(finite, draws, 1.0)
    # unit mean square: E[x^2] = a^2 (1 + kappa^2 (1 + 1 / nu))
    scale = 1 / np.sqrt(1 + kappa**2 * (1 + 1 / nu))
    field = scale * (np.sqrt(texture) * random + texture * kappa)
    signal = np.sqrt(level) * amplitude * field
    if scene_pass.noise is not None:
        power = 10 ** (scene_pass.noise / 10)
        signal = signal + np.sqrt(power) * _complex_noise(shape, 0.0, rng)
    return np.asarray(np.abs(signal))


def _complex_noise(
    shape: tuple[int, ...], correlation: float, rng: np.random.Generator
) -> ComplexArray:
    """Circular Gaussian noise of unit mean square, correlated over `correlation` pixels."""
    parts = rng.normal(size=(2, *shape))
    if correlation > 0:
        impulse = np.zeros(64 * int(np.ceil(correlation)) + 1)
        impulse[impulse.size // 2] = 1
        kernel = gaussian_filter(impulse, correlation)
        parts = gaussian_filter(parts, (0, correlation, correlation), mode="wrap")
        parts /= (kernel**2).sum()
    return np.asarray((parts[0] + 1j * parts[1]) / np.sqrt(2))


def _quantised(field: FloatArray, scene_pass: ScenePass) -> NDArray[np.generic]:
    dtype = scene_pass.dtype
    value = field * (scene_pass.gain or FILL[dtype])
    missing = np.isnan(value)
    if dtype != "float32":  # 0 is nodata, so valid pixels start at 1
        value = np.clip(np.rint(np.nan_to_num(value)), 1, np.iinfo(dtype).max)
    return np.where(missing, NODATA[dtype], value).astype(dtype)
