"""The simulated sea floor: sediment class, ripple phase and height at any map point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.simulate.profiles import crest
from sasmap.simulate.scene import RipplePatch, Scene

# Number of random waves summed to a Gaussian field: its excess kurtosis is -1.5 / WAVES = -0.006.
WAVES = 256
# Grid points per correlation length of the wander: the error of cubic interpolation is then 1e-5
# of its rms.
WANDER_SAMPLES = 8
# Width of the edge over which bends begin, in correlation lengths of the wander (a choice).
BENDS = 0.5


class Waves(NamedTuple):
    """Local plane wave of the ripples at map points; arrays of the points' shape.

    Attributes
    ----------
    phase : ndarray
        rad, the crest at pi/2.
    east, north : ndarray
        Wave vector, cycles/m.
    height : ndarray
        A_H, m; 0 where there are no ripples.
    patch : ndarray of int
        Index of the ripple patch, -1 for none.
    """

    def where(self, other: Waves, better: BoolArray) -> Waves:
        """Take the other's waves where a condition holds."""
        return Waves(*(np.where(better, b, a) for a, b in zip(self, other, strict=True)))

    phase: FloatArray
    east: FloatArray
    north: FloatArray
    height: FloatArray
    patch: IntArray


def in_polygon(x: FloatArray, y: FloatArray, polygon: FloatArray) -> BoolArray:
    """Find which points lie in a polygon, by the even-odd rule.

    Parameters
    ----------
    x, y : ndarray
        Points, m, of the same shape.
    polygon : ndarray (n, 2)
        Vertices, m.

    Returns
    -------
    ndarray of bool
        Of the points' shape.
    """
    inside = np.zeros(np.shape(x), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def edge_distance(x: FloatArray, y: FloatArray, polygon: FloatArray) -> FloatArray:
    """Compute the distance of points from a polygon's outline.

    Parameters
    ----------
    x, y : ndarray
        Points, m, of the same shape.
    polygon : ndarray (n, 2)
        Vertices, m.

    Returns
    -------
    ndarray
        m, of the points' shape.
    """
    nearest = np.full(np.shape(x), np.inf)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        dx, dy = x1 - x0, y1 - y0
        square = dx * dx + dy * dy
        along = ((x - x0) * dx + (y - y0) * dy) / square if square > 0 else np.zeros_like(x)
        along = np.clip(along, 0, 1)
        np.minimum(nearest, np.hypot(x - x0 - along * dx, y - y0 - along * dy), out=nearest)
    return nearest


@dataclass(frozen=True)
class _Wander:
    """A smooth Gaussian random phase and its gradient on a grid, for interpolation."""

    left: float
    bottom: float
    step: float
    values: FloatArray  # (3, rows, columns): phase, d/d east, d/d north

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        where = [(y - self.bottom) / self.step, (x - self.left) / self.step]
        return np.stack([map_coordinates(v, where, order=3, mode="nearest") for v in self.values])


class SeaFloor:
    """A scene's sea floor.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        origin = np.array(scene.origin)
        self._sediments = [
            None if s.polygon is None else np.array(s.polygon) + origin for s in scene.sediments
        ]
        self._patches = [
            None if p.polygon is None else np.array(p.polygon) + origin for p in scene.ripples
        ]
        self._wander = [_wander(scene, k, patch) for k, patch in enumerate(scene.ripples)]

    @property
    def outlines(self) -> list[FloatArray]:
        """Polygons of the sediments that have one, (n, 2) map coordinates."""
        return [polygon for polygon in self._sediments if polygon is not None]

    def sediment(self, x: FloatArray, y: FloatArray) -> IntArray:
        """Index of the sediment at map points."""
        index = np.zeros(np.shape(x), np.int64)
        for k, polygon in enumerate(self._sediments):
            if polygon is not None:
                index[in_polygon(x, y, polygon)] = k
        return index

    def waves(self, x: FloatArray, y: FloatArray) -> Waves:
        """Ripple phase, wave vector and height of the highest system at map points."""
        first, *added = self.systems(x, y)
        for one in added:
            first = first.where(one, one.height > first.height)
        return first

    def second(self, x: FloatArray, y: FloatArray) -> Waves:
        """Like :meth:`waves`, for the second highest system."""
        first, *added = self.systems(x, y)
        second = _no_waves(np.shape(x))
        for one in added:
            higher = one.height > first.height
            lower = one.where(first, higher)
            first = first.where(one, higher)
            second = second.where(lower, lower.height > second.height)
        return second

    def systems(self, x: FloatArray, y: FloatArray) -> list[Waves]:
        """Systems of ripples whose heights add up to the sea floor's.

        Parameters
        ----------
        x, y : ndarray
            Map points, m, of the same shape.

        Returns
        -------
        list of Waves
            One for the patches that cover each other, then one for each added patch.
        """
        shape = np.shape(x)
        found = [_no_waves(shape)]
        for k, patch in enumerate(self._scene.ripples):
            if patch.added:
                found.append(_no_waves(shape))
            self._lay(found[-1 if patch.added else 0], k, x, y)
        return found

    def _lay(self, waves: Waves, k: int, x: FloatArray, y: FloatArray) -> None:
        """Replace the waves of other patches by those of a patch, within its polygon."""
        patch, polygon = self._scene.ripples[k], self._patches[k]
        inside = np.ones(np.shape(x), bool) if polygon is None else in_polygon(x, y, polygon)
        if not inside.any():
            return
        px, py = x[inside], y[inside]
        phase, east, north, height = self._patch(k, patch, px, py)
        if polygon is not None:  # ripples fade out over half a wavelength, without a step
            fade = np.clip(2 * patch.frequency * edge_distance(px, py, polygon), 0, 1)
            height = height * fade**2 * (3 - 2 * fade)
        waves.phase[inside], waves.height[inside], waves.patch[inside] = phase, height, k
        waves.east[inside], waves.north[inside] = east, north

    def _patch(
        self, k: int, patch: RipplePatch, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        azimuth = np.radians(patch.azimuth)
        kx, ky = patch.frequency * np.sin(azimuth), patch.frequency * np.cos(azimuth)
        cx, cy = self._scene.centre
        phase = 2 * np.pi * (kx * (x - cx) + ky * (y - cy)) + patch.phase
        east, north = np.full_like(x, kx), np.full_like(x, ky)
        height = np.full_like(x, patch.height)
        wander = self._wander[k]
        if wander is None and not patch.forks:
            return phase, east, north, height
        extra, dx, dy = np.zeros((3, *x.shape)) if wander is None else wander.at(x, y)
        turn, turn_x, turn_y, calm = self._forked(patch, x, y)
        extra, dx, dy = extra + turn, dx + turn_x, dy + turn_y
        share, share_x, share_y = self._bent(patch, x, y)
        phase = phase + share * extra
        east = east + (share * dx + share_x * extra) / (2 * np.pi)
        north = north + (share * dy + share_y * extra) / (2 * np.pi)
        return phase, east, north, height * (1 - share * (1 - calm))

    def _forked(self, patch: RipplePatch, x: FloatArray, y: FloatArray) -> FloatArray:
        """Phase added by forks, its gradient, rad/m, and the remaining fraction of the height."""
        result = np.stack([np.zeros_like(x), np.zeros_like(x), np.zeros_like(x), np.ones_like(x)])
        before = np.zeros_like(x)
        for j, (fx, fy) in enumerate(patch.forks):
            sign = 1 - 2 * (j % 2)
            dx, dy = x - self._scene.origin[0] - fx, y - self._scene.origin[1] - fy
            square = dx**2 + dy**2
            soft = square + (0.25 / patch.frequency) ** 2
            angle = np.arctan2(dy, dx)
            if sign < 0:  # the branch cut of a pair lies between its forks, so that it can fade out
                angle -= 2 * np.pi * np.rint((angle - before) / (2 * np.pi))
            before = angle
            result[:3] += sign * np.stack([angle, -dy / soft, dx / soft])
            result[3] *= square / soft
        return result

    def _bent(self, patch: RipplePatch, x: FloatArray, y: FloatArray) -> FloatArray:
        """Fraction of wander and forks in a patch's phase, and the fraction's gradient, 1/m."""
        if patch.bends is None:
            return np.stack([np.ones_like(x), np.zeros_like(x), np.zeros_like(x)])
        polygon = np.array(patch.bends) + np.array(self._scene.origin)

        def share(x: FloatArray, y: FloatArray) -> FloatArray:
            inside = in_polygon(x, y, polygon)
            depth = edge_distance(x, y, polygon) / (BENDS * patch.wander_length)
            part = np.clip(np.where(inside, depth, 0.0), 0, 1)
            return np.asarray(part**2 * (3 - 2 * part))

        step = 1e-3 * patch.wander_length
        east, west = share(x + step, y), share(x - step, y)
        north, south = share(x, y + step), share(x, y - step)
        return np.stack([share(x, y), (east - west) / (2 * step), (north - south) / (2 * step)])

    @property
    def relief(self) -> float:
        """Upper bound of the height above or below the mean sea floor, m."""
        highest, added = 0.0, 0.0
        for patch in self._scene.ripples:
            # the Stokes term, with a margin for crests that wander to twice the wave number
            extra = 2 * np.pi * patch.frequency * patch.height if patch.profile == "stokes" else 0.0
            most = patch.height * (1 + extra)
            if patch.added:
                added += most
            else:
                highest = max(highest, most)
        return highest + added

    def elevation(self, waves: Waves) -> FloatArray:
        """Height of one system of ripples at the points of `waves`, m."""
        result = np.zeros_like(waves.height)
        steepness = 2 * np.pi * np.hypot(waves.east, waves.north) * waves.height
        for k, patch in enumerate(self._scene.ripples):
            on = waves.patch == k
            if on.any():
                shape = crest(waves.phase[on], steepness[on], patch.profile, patch.asymmetry)
                result[on] = waves.height[on] * shape
        return result

    def surface(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the sea floor above its mean at map points, all systems of ripples, m."""
        first, *added = self.systems(x, y)
        height = self.elevation(first)
        for one in added:
            height += self.elevation(one)
        return height


def _no_waves(shape: tuple[int, ...]) -> Waves:
    phase, east, north, height = np.zeros((4, *shape))
    return Waves(phase, east, north, height, np.full(shape, -1, np.int64))


def _wander(scene: Scene, k: int, patch: RipplePatch) -> _Wander | None:
    """Sum random plane waves with Gaussian wave numbers, for a Gaussian correlation."""
    if patch.wander == 0:
        return None
    rng = np.random.default_rng(np.random.SeedSequence([scene.seed, 101, k]))
    numbers = rng.normal(0, 1 / patch.wander_length, (WAVES, 2))
    offsets = rng.uniform(0, 2 * np.pi, WAVES)
    step = patch.wander_length / WANDER_SAMPLES
    margin = 4 * step + 60.0  # lines of sight start outside the scene
    x = np.arange(-margin, scene.size[0] + margin + step, step)
    y = np.arange(-margin, scene.size[1] + margin + step, step)
    values = np.zeros((3, y.size, x.size))
    for (kx, ky), offset in zip(numbers, offsets, strict=True):
        angle = kx * x + ky * y[:, None] + offset
        sine = np.sin(angle)
        values += np.stack([np.cos(angle), -kx * sine, -ky * sine])
    values *= patch.wander * np.sqrt(2 / WAVES)
    return _Wander(scene.origin[0] - margin, scene.origin[1] - margin, step, values)
