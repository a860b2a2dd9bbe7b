"""Tiles of coherent scenes: scattering facets of the sea floor, placed by their slant range.

The sea floor is divided into facets. Each scatters according to its normal, area and law if a ray
from the array reaches it; its complex echo of random phase is placed where its slant range lies on
a flat floor; echoes add coherently under a point spread function. Speckle, shadow, layover, the
lean of crests towards the sonar and the brightening of facing slopes all follow from this. This
module and its imports share no code with :mod:`sasmap.ripples`, which is tested against it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.simulate.facets import (
    HALO,
    REACH,
    patch_texture,
    see_facets,
    sum_rows,
    take_pixels,
)
from sasmap.simulate.geometry import StraightTrack, track_line
from sasmap.simulate.laws import backscatter
from sasmap.simulate.scene import Scene, ScenePass
from sasmap.simulate.seafloor import SeaFloor

# Approximate largest number of facets in a strip; bounds memory (a choice).
STRIP = 400_000
# Grazing angle, rad, at which the levels of sediments of different laws are defined (a choice: the
# middle of the usual 10 to 60 degrees).
LEVEL_GRAZING = float(np.radians(30.0))
FACETS, TEXTURE, NOISE = 1, 2, 3


class _Grid(NamedTuple):
    """Grid of a pass: facets over ground range, and the image over the displayed range.

    Attributes
    ----------
    along, across : float
        Position of row 0 and column 0, the centre of a pixel, m.
    row_step, column_step : float
        m.
    fine : int
        Rows per pixel; there are twice as many columns.
    sigma : float
        Standard deviation of the point spread function, m.
    """

    along: float
    across: float
    row_step: float
    column_step: float
    fine: int
    sigma: float

    def rows(self, along: FloatArray) -> IntArray:
        """Nearest rows."""
        # ties always go the same way, whatever the rounding of the tile's coordinates
        return np.rint((along - self.along) / self.row_step + 1e-4).astype(np.int64)

    def columns(self, across: FloatArray) -> IntArray:
        """Nearest columns."""
        return np.rint((across - self.across) / self.column_step + 1e-4).astype(np.int64)


class _Pass(NamedTuple):
    """Inputs common to all strips of a tile."""

    scene: Scene
    floor: SeaFloor
    line: StraightTrack
    grid: _Grid
    slant: bool
    noise: float
    keys: tuple[np.uint64, ...]


def coherent_amplitude(
    scene: Scene,
    floor: SeaFloor,
    scene_pass: ScenePass,
    along: FloatArray,
    shown: FloatArray,
    key: int,
) -> FloatArray:
    """Render pixels of a coherent scene.

    Parameters
    ----------
    scene : Scene
    floor : SeaFloor
    scene_pass : ScenePass
    along : ndarray (pixels,)
        Along-track distance of the pixels' centres, m.
    shown : ndarray (pixels,)
        Their distance from the track in the image: ground range, or slant range, m.
    key : int
        Key of the speckle; pixels rendered separately with the same key belong to the same image.

    Returns
    -------
    ndarray (pixels,)
        Amplitude; its mean square is 1 on flat floor of level 1 at the scene's centre (before
        receiver noise, and before it is flattened over range).
    """
    result = np.empty(along.size)
    if along.size == 0:
        return result
    line = track_line(scene, scene_pass)
    grid = _grid(scene, scene_pass, line)
    noise = 0.0 if scene_pass.noise is None else 10 ** (scene_pass.noise / 10)
    keys = tuple(np.uint64(v) for v in np.random.SeedSequence(key).generate_state(4, np.uint64))
    what = _Pass(scene, floor, line, grid, scene_pass.range == "slant", noise, keys)
    rows, columns = grid.rows(along), grid.columns(shown)
    order = np.argsort(rows, kind="stable")
    width = int(columns.max() - columns.min()) + 8 * grid.fine
    height = max(4 * grid.fine, STRIP // width)
    cuts = np.arange(rows.min(), rows.max() + height, height)
    starts = np.searchsorted(rows[order], cuts)
    for low, high in zip(starts, [*starts[1:], order.size], strict=True):
        part = order[low:high]
        if part.size:
            result[part] = _strip(what, rows[part], columns[part])
    if scene_pass.range_flattened:
        level = flat_intensity(scene, scene_pass, along, shown) + noise
        result /= np.sqrt(level)
    return result


def flat_intensity(
    scene: Scene, scene_pass: ScenePass, along: FloatArray, shown: FloatArray
) -> FloatArray:
    """Mean intensity of a flat floor of the first sediment, without receiver noise.

    Parameters
    ----------
    scene : Scene
    scene_pass : ScenePass
    along, shown : ndarray
        As for :func:`coherent_amplitude`, m.

    Returns
    -------
    ndarray
        Level times S(grazing), in slant range divided by the cosine of the grazing angle because a
        pixel covers more floor; relative to the same at the scene's centre without the level.
    """
    line = track_line(scene, scene_pass)
    altitude = line.altitude_at(along)
    slant = scene_pass.range == "slant"
    ground = np.sqrt(np.maximum(shown**2 - altitude**2, 1e-12)) if slant else shown
    grazing = np.arctan2(altitude, ground)
    first = scene.sediments[0]
    intensity = first.level * _scattered(scene, 0, grazing) / _reference(scene, line, slant)
    return np.asarray(intensity / np.cos(grazing) if slant else intensity)


def _grid(scene: Scene, scene_pass: ScenePass, line: StraightTrack) -> _Grid:
    pixel = scene_pass.pixel_size or scene.pixel_size
    corner = scene.origin[0] + 0.5 * pixel, scene.origin[1] + scene.size[1] - 0.5 * pixel
    view = line.see(*(np.array([v]) for v in corner))
    # at least two rows and four columns per standard deviation of half a pixel
    fine = max(2, int(np.ceil(1 / scene_pass.blur)))
    along, across = float(view.along[0]), float(view.ground_range[0])
    sigma = scene_pass.blur * pixel
    return _Grid(along, across, pixel / fine, 0.5 * pixel / fine, fine, sigma)


def _scattered(scene: Scene, sediment: int, grazing: FloatArray) -> FloatArray:
    """S(grazing) of a sediment relative to its value at LEVEL_GRAZING."""
    law = scene.sediments[sediment].law or scene.law
    return np.asarray(backscatter(law, grazing) / backscatter(law, LEVEL_GRAZING))


def _reference(scene: Scene, line: StraightTrack, slant: bool) -> float:
    """Intensity of flat floor of the first sediment, with level 1, at the scene's centre."""
    centre = line.see(*(np.array([v]) for v in scene.centre))
    grazing = np.arctan2(centre.altitude, centre.ground_range)
    level = float(_scattered(scene, 0, grazing)[0])
    return level / float(np.cos(grazing[0])) if slant else level


def _strip(what: _Pass, rows: IntArray, columns: IntArray) -> FloatArray:
    """Amplitude of the pixels nearest to rows and columns of the grid."""
    grid = what.grid
    half = int(np.ceil(REACH * grid.sigma / grid.row_step))
    top, left = int(rows.min()) - half, int(columns.min())
    across = np.arange(top, int(rows.max()) + half + 1)
    along = grid.along + grid.row_step * across
    altitude = what.line.altitude_at(np.asarray(along))
    near = grid.across + grid.column_step * left
    far = grid.across + grid.column_step * int(columns.max())
    facets = _facet_columns(what, near, far, altitude)
    reach = np.arange(facets[0] - HALO, facets[-1] + HALO + 1)
    extra = np.arange(top - HALO, across[-1] + HALO + 1)
    x, y = what.line.point(
        (grid.along + grid.row_step * extra)[:, None], grid.across + grid.column_step * reach
    )
    elevation = what.floor.surface(x, y)
    ground_range = np.asarray(grid.across + grid.column_step * facets)
    steps = (grid.row_step, grid.column_step)
    sine, area, shown = see_facets(elevation, ground_range, altitude, steps, what.slant)
    sine[np.isnan(shown)] = 0.0
    inner = slice(HALO, -HALO)
    power = _power(what, sine, (x[inner, inner], y[inner, inner]), across, facets)
    # each facet adds its power times that of the point spread function, whose sum is one
    sigma = grid.sigma / grid.column_step
    amplitude = np.sqrt(power * area / (sigma * np.sqrt(np.pi)))
    place = (shown - grid.across) / grid.column_step - left
    wide = int(columns.max()) - left + 1
    first = (top, int(facets[0]))
    field = sum_rows(amplitude, place, what.keys[FACETS], first, sigma, wide)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * grid.row_step / grid.sigma) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    key = what.keys[NOISE]
    return np.asarray(
        take_pixels(field, kernel, rows - top, columns - left, key, (top, left), what.noise)
    )


def _facet_columns(what: _Pass, near: float, far: float, altitude: FloatArray) -> IntArray:
    """Columns of facets that appear between two ranges of the image, or may shadow these."""
    relief, margin = what.floor.relief, (REACH + 1) * what.grid.sigma + what.grid.column_step
    low, high = float(altitude.min()), float(altitude.max())
    near, far = max(near - margin, 0.0), far + margin
    if what.slant:
        first = near**2 - (high + relief) ** 2
        last = far**2 - max(low - relief, 0.0) ** 2
    else:
        first = near**2 - 2 * high * relief - relief**2
        last = far**2 + 2 * high * relief
    # nearest range of a crest that can shadow the first facet (rays over both extremes)
    sight = np.sqrt(max(first, 0.0)) * max(low - relief, 0.0) / (low + relief)
    step, offset = what.grid.column_step, what.grid.across
    start = int(np.ceil((max(sight, 0.5 * step) - offset) / step))
    stop = int(np.ceil((np.sqrt(max(last, 0.0)) - offset) / step))
    return np.arange(start, max(stop, start) + 1)


def _power(
    what: _Pass,
    sine: FloatArray,
    points: tuple[FloatArray, FloatArray],
    rows: IntArray,
    columns: IntArray,
) -> FloatArray:
    """Backscattered intensity per area of floor relative to the reference, texture included."""
    scene = what.scene
    index = what.floor.sediment(*points)
    power = np.zeros_like(sine)
    fine = what.grid.fine
    for k, sediment in enumerate(scene.sediments):
        on = (index == k) & (sine > 0)
        if on.any():
            power[on] = sediment.level * _scattered(scene, k, np.arcsin(sine[on]))
            if np.isfinite(sediment.nu):
                patch_rows, patch_columns = rows // fine, columns // (2 * fine)
                key = what.keys[TEXTURE]
                texture = patch_texture(
                    key, np.unique(patch_rows), np.unique(patch_columns), sediment.nu
                )
                wide = texture[np.ix_(patch_rows - patch_rows[0], patch_columns - patch_columns[0])]
                power[on] *= wide[on]
    return power / _reference(scene, what.line, what.slant)
