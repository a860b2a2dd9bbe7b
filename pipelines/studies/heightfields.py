"""Images and truth of any sea floor that is given as heights on a grid: coherent facets, rulers."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sasmap.ripples import Clip
from sasmap.simulate import Scene
from sasmap.simulate.image import record
from sasmap.simulate.seafloor import SeaFloor, Waves

FloatArray = NDArray[np.float64]

# Sea floor around the clip, m over its side: sight lines start there, crests go on.
MARGIN = 0.4
# Lines across the crests on which waves are measured, and points a wavelength along them.
LINES, POINTS = 80, 60


class Grid(NamedTuple):
    """Where a floor is known: square cells around a clip whose lower left corner is (0, 0).

    Attributes
    ----------
    x, y : ndarray (n,)
        Increasing, m.
    step : float
        m.
    """

    x: FloatArray
    y: FloatArray
    step: float


def grid_around(size: int, pixel: float) -> Grid:
    """Lay a grid of one point a pixel over a clip of size x size pixels and its margin."""
    extra = int(MARGIN * size)
    axis = pixel * np.arange(-extra, size + extra + 1)
    return Grid(axis, axis, pixel)


class _Given(SeaFloor):
    """A sea floor of given heights; ``waves`` carries the places to ``elevation``."""

    def __init__(self, scene: Scene, grid: Grid, height: FloatArray) -> None:
        super().__init__(scene)
        self._grid, self._height = grid, height

    def systems(self, x: FloatArray, y: FloatArray) -> list[Waves]:
        x, y = np.broadcast_arrays(x, y)
        return [Waves(x, x, y, np.ones(x.shape), np.zeros(x.shape, np.int64))]

    def elevation(self, waves: Waves) -> FloatArray:
        grid = self._grid
        where = [(waves.north - grid.y[0]) / grid.step, (waves.east - grid.x[0]) / grid.step]
        return np.asarray(map_coordinates(self._height, where, order=3, mode="nearest"))

    @property
    def relief(self) -> float:
        return float(np.abs(self._height).max())


def image(
    rng: np.random.Generator, grid: Grid, height: FloatArray, size: int, **sonar: object
) -> Clip:
    """Record a floor with the coherent simulator, from a track to the west that runs north.

    Parameters
    ----------
    rng : Generator
    grid : Grid
        From :func:`grid_around`.
    height : ndarray (n, n)
        Over its mean, m, at (y, x).
    size : int
        Of the clip, pixels.
    **sonar
        ``near`` (ground range of the first column, m), ``altitude`` (m), ``law``, ``noise`` (dB),
        ``blur`` (pixels), ``range_flattened``.

    Returns
    -------
    Clip
    """
    pixel = grid.step
    side = size * pixel
    near, altitude = float(sonar["near"]), float(sonar["altitude"])
    east = {
        "name": "east", "heading": 0.0, "distance": near + 0.5 * side - 0.5 * pixel,
        "altitude": altitude, "noise": sonar["noise"], "dtype": "float32",
        "range_flattened": sonar["range_flattened"], "blur": sonar["blur"],
    }  # fmt: skip
    scene = Scene.model_validate(
        {
            "name": "bed", "origin": (0.0, 0.0), "size": (side, side), "pixel_size": pixel,
            "physics": "coherent", "law": sonar["law"], "sediments": [{"name": "sand"}],
            "passes": [east],
        }
    )  # fmt: skip
    floor = _Given(scene, grid, height)
    transform = Affine(pixel, 0, 0, 0, -pixel, side)
    amplitude = record(scene, floor, scene.passes[0], transform, (size, size), rng).astype(float)
    centre = pixel * (np.arange(size) + 0.5)
    x, y = np.meshgrid(centre, centre[::-1])
    same = np.full(x.shape, altitude), np.full(x.shape, 90.0)
    return Clip(amplitude, x, y, near + x - 0.5 * pixel, *same, pixel)


class Bed(NamedTuple):
    """What a floor's own heights say of its ripples within a clip.

    Attributes
    ----------
    wave : ndarray (2,)
        Peak of the spectrum, cycles/m east and north, eastwards.
    heights : ndarray (waves,)
        From trough to crest of single waves, between zero crossings along the peak's wave vector,
        m.
    rises : ndarray (waves,)
        Share of a wave, along the peak's wave vector, from its trough to its crest.
    """

    wave: FloatArray
    heights: FloatArray
    rises: FloatArray

    @property
    def frequency(self) -> float:
        """Of the peak, cycles/m."""
        return float(np.hypot(*self.wave))

    @property
    def median(self) -> float:
        """Median height from trough to crest, m."""
        return float(np.median(self.heights))

    @property
    def significant(self) -> float:
        """Mean of the highest third, m."""
        return float(np.sort(self.heights)[-max(len(self.heights) // 3, 1) :].mean())


def measure(grid: Grid, height: FloatArray, size: int) -> Bed:
    """Measure the ripples of a floor within a clip.

    Parameters
    ----------
    grid : Grid
    height : ndarray (n, n)
    size : int
        Of the clip, pixels.

    Returns
    -------
    Bed
    """
    first = int(np.searchsorted(grid.x, 0.0))
    inner = height[first : first + size, first : first + size]
    wave = _peak(inner - inner.mean(), grid.step)
    length = 1 / np.hypot(*wave)
    normal = wave * length
    side = size * grid.step
    # lines through the clip along the normal, with room for their ends
    along = np.arange(-0.5 * side, 0.5 * side, length / POINTS)
    offsets = np.linspace(-0.45 * side, 0.45 * side, LINES)[:, None]
    x = 0.5 * side + along * normal[0] - offsets * normal[1]
    y = 0.5 * side + along * normal[1] + offsets * normal[0]
    where = [(y - grid.y[0]) / grid.step, (x - grid.x[0]) / grid.step]
    lines = map_coordinates(height, where, order=3, mode="nearest")
    waves = [w for line in lines for w in _waves(line - line.mean())]
    return Bed(wave, *np.array(waves).T)


def _waves(line: FloatArray) -> list[tuple[float, float]]:
    """Height of each wave between upward zero crossings, and its share from trough to crest."""
    starts = np.flatnonzero((line[:-1] < 0) & (line[1:] >= 0)) + 1
    found = []
    for low, high in pairwise(starts):
        part = line[low:high]
        # noise about zero is no wave
        if len(part) < POINTS // 4:
            continue
        crest, trough = int(part.argmax()), int(part.argmin())
        rise = ((crest - trough) % len(part)) / len(part)
        found.append((float(np.ptp(part)), rise))
    return found


def _peak(height: FloatArray, step: float) -> FloatArray:
    """Wave vector of the largest Fourier component, to a fraction of a bin, eastwards."""
    size = len(height)
    window = np.hanning(size)
    padded = 4 * size
    power = np.abs(np.fft.fft2(height * window * window[:, None], (padded, padded))) ** 2
    i, j = np.unravel_index(int(power.argmax()), power.shape)

    def offset(low: float, middle: float, high: float) -> float:
        return 0.5 * (low - high) / (low - 2 * middle + high)

    around = np.log(power[np.ix_((i + np.arange(-1, 2)) % padded, (j + np.arange(-1, 2)) % padded)])
    place = np.array([j + offset(*around[1]), i + offset(*around[:, 1])])
    wave = ((place + padded / 2) % padded - padded / 2) / (padded * step)
    return np.asarray(wave if wave[0] >= 0 else -wave)
