"""Viewing geometry of a simulated pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.simulate.scene import Scene, ScenePass


class View(NamedTuple):
    """Viewing geometry of map points; arrays of the points' shape, m."""

    along: FloatArray
    ground_range: FloatArray
    altitude: FloatArray


class StraightTrack(NamedTuple):
    """A pass's straight track, in map coordinates.

    Attributes
    ----------
    start : ndarray (2,)
        Map position of its first ping.
    direction, look : ndarray (2,)
        Unit vectors (east, north) along the track and across it, towards the imaged sea floor.
    length : float
        m.
    altitude : tuple of float
        At start and end, m.
    """

    start: FloatArray
    direction: FloatArray
    look: FloatArray
    length: float
    altitude: tuple[float, float]

    def see(self, x: FloatArray, y: FloatArray) -> View:
        """Return along-track distance, ground range and altitude for map points."""
        dx, dy = x - self.start[0], y - self.start[1]
        along = dx * self.direction[0] + dy * self.direction[1]
        return View(along, dx * self.look[0] + dy * self.look[1], self.altitude_at(along))

    def altitude_at(self, along: FloatArray) -> FloatArray:
        """Altitude at along-track distances, m."""
        first, last = self.altitude
        return first + (last - first) * np.clip(along / self.length, 0, 1)

    def point(self, along: FloatArray, ground_range: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return map points from along-track distance and ground range."""
        return (
            self.start[0] + along * self.direction[0] + ground_range * self.look[0],
            self.start[1] + along * self.direction[1] + ground_range * self.look[1],
        )


def track_line(scene: Scene, scene_pass: ScenePass) -> StraightTrack:
    """Place a pass's track so that the scene lies abeam of it.

    Parameters
    ----------
    scene : Scene
    scene_pass : ScenePass

    Returns
    -------
    StraightTrack
    """
    heading = np.radians(scene_pass.heading)
    direction = np.array([np.sin(heading), np.cos(heading)])
    starboard = np.array([direction[1], -direction[0]])
    look = starboard if scene_pass.side == "starboard" else -starboard
    half = 0.5 * (abs(direction[0]) * scene.size[0] + abs(direction[1]) * scene.size[1]) + 5.0
    abeam = np.array(scene.centre) - scene_pass.distance * look
    altitude = scene_pass.altitude
    both = altitude if isinstance(altitude, tuple) else (altitude, altitude)
    return StraightTrack(abeam - half * direction, direction, look, 2 * half, both)
