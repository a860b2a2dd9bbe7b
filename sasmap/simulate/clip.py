"""A single clip of a simulated scene with its truth, without files: for studies and tests."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from affine import Affine

from sasmap.arrays import FloatArray
from sasmap.ripples.clip import Clip
from sasmap.simulate.geometry import track_line
from sasmap.simulate.image import record
from sasmap.simulate.laws import Law, PowerLaw
from sasmap.simulate.profiles import CrestProfile
from sasmap.simulate.scene import Scene
from sasmap.simulate.seafloor import SeaFloor


class SimulatedClip(NamedTuple):
    """A clip and its true parameters.

    Attributes
    ----------
    clip : Clip
    wave : ndarray (2,)
        Mean wave vector (east, north), cycles/m: that of the plane fitted to the clip's phase by
        least squares (with forks, to its local slopes); NaN without ripples.
    height : float
        Median A_H where there are ripples, m.
    rippled_fraction : float
    """

    clip: Clip
    wave: FloatArray
    height: float
    rippled_fraction: float

    @property
    def frequency(self) -> float:
        """Frequency of the mean wave vector, cycles/m."""
        return float(np.hypot(*self.wave))

    @property
    def azimuth(self) -> float:
        """Azimuth of the mean wave vector, degrees clockwise from grid north, 0 to 180."""
        return float(np.degrees(np.arctan2(*self.wave)) % 180)


def simulate_clip(scene: Scene, rng: np.random.Generator, which: int = 0) -> SimulatedClip:
    """Simulate a whole scene as one clip.

    Parameters
    ----------
    scene : Scene
        Of the size of a clip.
    rng : Generator
        For speckle and noise; the sea floor depends on the scene's own seed.
    which : int
        Index of the pass.

    Returns
    -------
    SimulatedClip
    """
    scene_pass = scene.passes[which]
    size = scene_pass.pixel_size or scene.pixel_size
    shape = (round(scene.size[1] / size), round(scene.size[0] / size))
    left, top = scene.origin[0], scene.origin[1] + scene.size[1]
    transform = Affine(size, 0, left, 0, -size, top)
    floor = SeaFloor(scene)
    plain = scene_pass.model_copy(update={"range": "ground"})
    pixels = record(scene, floor, plain, transform, shape, rng).astype(float)
    if plain.dtype != "float32":
        pixels[pixels == 0] = np.nan
    x, y = np.meshgrid(
        left + size * (np.arange(shape[1]) + 0.5), top - size * (np.arange(shape[0]) + 0.5)
    )
    line = track_line(scene, plain)
    view = line.see(x, y)
    look = np.degrees(np.arctan2(line.look[0], line.look[1])) % 360
    ground_range = np.where(view.ground_range > 0, view.ground_range, np.nan)
    clip = Clip(pixels, x, y, ground_range, view.altitude, np.full(shape, look), size)
    return SimulatedClip(clip, *_truth(scene, floor, x, y))


def coherent_cell(
    rng: np.random.Generator,
    *,
    frequency: float,
    height: float,
    azimuth_off_look: float = 0.0,
    phase: float | None = None,
    near: float = 20.0,
    altitude: float = 5.0,
    pixel_size: float = 0.05,
    shape: tuple[int, int] = (200, 200),
    law: Law | PowerLaw = "lambert",
    profile: CrestProfile = "sine",
    asymmetry: float = 0.35,
    wander: float = 0.0,
    wander_length: float = 10.0,
    forks: int = 0,
    noise: float | None = -25.0,
    nu: float = float("inf"),
    range_flattened: bool = False,
    blur: float = 0.5,
) -> SimulatedClip:
    """Simulate one cell with coherent facets; the sonar looks east from a straight track.

    Parameters
    ----------
    rng : Generator
        For the wander, phase and forks of the ripples, speckle and noise.
    frequency, height : float
        f (cycles/m) and A_H (m); A_H of 0 for a flat floor.
    azimuth_off_look : float
        Angle of the crest normal from the look direction, degrees clockwise.
    phase : float, optional
        Phase at the cell's centre, rad; default random.
    near : float
        Ground range of the first column, m.
    altitude, pixel_size : float
        m.
    shape : tuple of int
        Rows and columns.
    law : str or PowerLaw
        As for :func:`sasmap.simulate.laws.backscatter`.
    profile : {"sine", "stokes", "peaked", "asymmetric"}
    asymmetry : float
    wander, wander_length : float
        Rms of the phase's wander, rad, and its correlation length, m.
    forks : int
        Number of forks, at random places.
    noise : float or None
        Receiver noise, dB relative to the mean intensity of flat floor at the cell's centre.
    nu : float
        Shape of the sediment's texture; infinite for none.
    range_flattened : bool
    blur : float
        Standard deviation of the point spread function, pixels.

    Returns
    -------
    SimulatedClip
    """
    size = (shape[1] * pixel_size, shape[0] * pixel_size)
    patch = {
        "frequency": frequency,
        "height": height,
        "azimuth": 90.0 + azimuth_off_look,
        "phase": float(rng.uniform(0, 2 * np.pi)) if phase is None else phase,
        "profile": profile,
        "asymmetry": asymmetry,
        "wander": wander,
        "wander_length": wander_length,
        "forks": [tuple(rng.uniform(0, 1, 2) * size) for _ in range(forks)],
    }
    east = {
        "name": "east",
        "heading": 0.0,
        "distance": near + 0.5 * size[0] - 0.5 * pixel_size,
        "altitude": altitude,
        "noise": noise,
        "dtype": "float32",
        "range_flattened": range_flattened,
        "blur": blur,
    }
    scene = Scene.model_validate(
        {
            "name": "cell",
            "seed": int(rng.integers(2**62)),
            "origin": (0.0, 0.0),
            "size": size,
            "pixel_size": pixel_size,
            "physics": "coherent",
            "law": law,
            "sediments": [{"name": "sand", "nu": nu}],
            "ripples": [patch] if height > 0 else [],
            "passes": [east],
        }
    )
    return simulate_clip(scene, rng)


def _truth(
    scene: Scene, floor: SeaFloor, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, float, float]:
    waves = floor.waves(x, y)
    rippled = waves.height > 0
    if not rippled.any():
        return np.full(2, np.nan), float("nan"), 0.0
    patch = scene.ripples[int(np.bincount(waves.patch[rippled]).argmax())]
    turn = np.radians(patch.azimuth)
    base = patch.frequency * np.array([np.sin(turn), np.cos(turn)])
    centre = scene.centre
    plain = 2 * np.pi * (base[0] * (x - centre[0]) + base[1] * (y - centre[1]))
    rest = waves.phase - plain - patch.phase
    if patch.forks and rippled.all():
        turn = _mean_slope(rest) / np.array([x[0, 1] - x[0, 0], y[1, 0] - y[0, 0]])
    else:
        design = np.column_stack([x[rippled] - centre[0], y[rippled] - centre[1]])
        design = np.column_stack([design, np.ones(len(design))])
        turn = np.linalg.lstsq(design, rest[rippled], rcond=None)[0][:2]
    wave = base + turn / (2 * np.pi)
    return wave, float(np.median(waves.height[rippled])), float(rippled.mean())


def _mean_slope(phase: FloatArray) -> FloatArray:
    """Slope of the plane fitted to a phase by least squares, rad per column and row.

    Fitted to the local slopes, weighted by a parabola: around a fork the phase itself has a branch
    cut that the sea floor does not.
    """
    slopes = []
    for axis in (1, 0):
        step = np.diff(np.moveaxis(phase, axis, 0), axis=0)
        turn = np.angle(np.exp(1j * step))
        k = np.arange(1, len(turn) + 1)
        weight = k * (len(turn) + 1 - k)
        slopes.append(float(np.average(turn.mean(axis=1), weights=weight)))
    return np.array(slopes)
