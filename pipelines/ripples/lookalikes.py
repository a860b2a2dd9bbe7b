"""Ripples that resemble marks, objects or bands of gain, and bands of gain: what each comes to.

    python pipelines/ripples/lookalikes.py [--clips 200] [--first 0] [--kinds forked,patch,...]

Clips of 128 to 400 pixels, as received, display-scaled and as JPEG in turn: ripples of four to
eight waves with few or many forks, with unevenly spaced crests, in patches, and two systems in one
direction; straight ripples with crests along the track, and such whose wavelength drifts over
range; bands of gain evenly spaced in grazing angle, or in one over the slant range (Lloyd's
mirror); and rough relief of no direction. For each kind the share that is found, not identifiable,
and taken for bands; the same without the step of crests, narrow hulls and grain (`--without`) shows
what these cost.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import floors
import numpy as np
from scipy.ndimage import gaussian_filter1d

from sasmap.ripples import Clip, detection, places
from sasmap.ripples.detection import Unclear, find_waves
from sasmap.ripples.image import as_image

PIXEL = 0.05
Rng = np.random.Generator


def clip_of(rng: Rng, seed: int, intensity: np.ndarray, near: float, altitude: float) -> Clip:
    """Lay speckle over an intensity (rows, columns), range along the columns from `near`, m."""
    size = len(intensity)
    amplitude = np.sqrt(intensity) * floors.speckle(rng, size, correlation=rng.uniform(0, 1))
    amplitude = floors.VERSIONS[seed % 3](rng, amplitude)
    x = near + PIXEL * (np.arange(size) + 0.5) + np.zeros((size, 1))
    y = PIXEL * np.arange(size)[::-1, None] + np.zeros((1, size))
    shape = x.shape
    return Clip(amplitude, x, y, x, np.full(shape, altitude), np.full(shape, 90.0), PIXEL)


def forked(rng: Rng, size: int) -> np.ndarray:
    """Four to eight waves with up to a fork in every third square of a wavelength."""
    wave = floors._wave(
        rng, size, rng.uniform(4, 8), rng.uniform(-1.2, 1.2), rng.choice([0, 0.1, 0.33])
    )
    return 1 + rng.uniform(0.3, 0.9) * wave


def uneven(rng: Rng, size: int) -> np.ndarray:
    """Four to ten waves of which the spacing varies by a fifth (standard deviation)."""
    turn, (row, column) = rng.uniform(-1.2, 1.2), np.indices((size, size)) - size / 2
    place = (column * np.cos(turn) + row * np.sin(turn)) * rng.uniform(4, 10) / size
    crests = np.cumsum(1 + 0.2 * rng.normal(size=41))
    phase = np.interp(place, crests - crests[20], np.arange(-20, 21))
    return 1 + rng.uniform(0.4, 0.9) * np.sin(2 * np.pi * phase)


def patch(rng: Rng, size: int) -> np.ndarray:
    """Ripples in an ellipse, up to three times as long as wide, of another brightness."""
    turn = rng.uniform(-1.2, 1.2)
    wave = floors._wave(rng, size, rng.uniform(6, 20) * size / 200, turn, rng.choice([0, 0.1, 0.3]))
    row, column = np.indices((size, size)) - size * rng.uniform(0.25, 0.75, 2)[:, None, None]
    turn += rng.normal(0, 0.8)
    long, wide = rng.uniform(0.25, 0.45) * size * np.array([1.0, rng.uniform(0.35, 1)])
    square = ((row * np.sin(turn) + column * np.cos(turn)) / long) ** 2
    square += ((row * np.cos(turn) - column * np.sin(turn)) / wide) ** 2
    inside = np.clip(3 - 3 * square, 0, 1)
    return np.exp(rng.normal(0, 0.1) * inside) * (1 + rng.uniform(0.4, 0.9) * inside * wave)


def parallel(rng: Rng, size: int) -> np.ndarray:
    """Two systems of nearly one direction, the shorter 1.4 to 3 times as short."""
    waves, turn = rng.uniform(3.8, 8), rng.uniform(-1.1, 1.1)
    first = floors._wave(rng, size, waves, turn)
    second = floors._wave(rng, size, waves * rng.uniform(1.4, 3), turn + rng.normal(0, 0.1))
    return 1 + rng.uniform(0.25, 0.5) * first + rng.uniform(0.25, 0.5) * second


def over_range(rng: Rng, size: int, place: np.ndarray, bend: float = 0.0) -> np.ndarray:
    """Four to ten waves in a function of range (size,), swaying by up to `bend` cycles or not."""
    sway = gaussian_filter1d(rng.normal(size=size), size / 8)
    sway *= bend * rng.choice([0, rng.random()]) / sway.std()
    share = (place - place.min()) / np.ptp(place)
    phase = rng.uniform(4, 10) * share + sway[:, None] + rng.random()
    return 1 + rng.uniform(0.1, 0.5) * np.sin(2 * np.pi * phase)


def drifting(reach: np.ndarray, rng: Rng) -> np.ndarray:
    """Places of waves whose wave number drifts by up to 15 % from the middle to either side."""
    share = (reach - reach[0]) / np.ptp(reach)
    return share + rng.uniform(-0.15, 0.15) * (share - 0.5) ** 2


FLOORS: dict[str, Callable[[Rng, int], np.ndarray]] = {
    kind.__name__: kind for kind in (forked, uneven, patch, parallel)
}
RANGES: dict[str, Callable[[np.ndarray, float, Rng], np.ndarray]] = {
    "straight": lambda reach, altitude, rng: reach,
    "drifting": lambda reach, altitude, rng: drifting(reach, rng),
    "bands (angle)": lambda reach, altitude, rng: np.arctan2(reach, altitude),
    "bands (Lloyd)": lambda reach, altitude, rng: -1 / np.hypot(reach, altitude),
}


def relief(reach: np.ndarray, altitude: float, rng: Rng) -> np.ndarray:
    """Intensity of rough floor of no direction, with shadow: ground ranges (columns,), m."""
    size = reach.size
    height = floors.smooth_noise(rng, size, rng.uniform(1.5, 6.0))
    height *= PIXEL * rng.uniform(0.05, 0.4) / np.gradient(height, axis=1).std()
    slope = np.arctan(np.gradient(height, PIXEL, axis=1))
    ray = (height - altitude) / reach
    lit = ray >= np.maximum.accumulate(ray, axis=1)
    power = np.maximum(np.sin(np.arctan2(altitude, reach) + slope), 0.0) ** rng.uniform(1, 3)
    return np.where(lit, power / power.mean(), 0.0) + 0.01


def simulated(seed: int, kind: str) -> Clip:
    """Make a clip of a kind."""
    rng = np.random.default_rng([seed, sum(kind.encode())])
    size = int(rng.choice([128, 160, 200, 300] if kind in FLOORS else [160, 200, 300, 400]))
    near, altitude = rng.uniform(12, 35), rng.uniform(3, 8)
    if kind in FLOORS:
        return clip_of(rng, seed, FLOORS[kind](rng, size), near, altitude)
    reach = near + PIXEL * (np.arange(size) + 0.5)
    if kind == "relief":
        return clip_of(rng, seed, relief(reach, altitude, rng), near, altitude)
    intensity = over_range(rng, size, RANGES[kind](reach, altitude, rng), 0.02)
    return clip_of(rng, seed, intensity, near, altitude)


def main() -> None:
    """Print a line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", default=",".join([*FLOORS, *RANGES, "relief"]))
    parser.add_argument("--without", action="store_true")
    options = parser.parse_args()
    if options.without:
        detection.PER_STEP, detection.GRAINS = 0.0, (-2.0, -1.0)
        places.RIBBED, places.TAKEN_OFF = 0.0, 1.0
    for kind in options.kinds.split(","):
        seeds = range(options.first, options.first + options.clips)
        results = [find_waves(as_image(simulated(s, kind)), (0.05, 10.0)) for s in seeds]
        found = sum(r.unclear is None and r.probability > 0.5 for r in results)
        bands = sum(r.unclear is Unclear.BANDS for r in results)
        other = sum(r.unclear is not None for r in results) - bands
        print(
            f"{kind:14s} found {found}, bands {bands}, otherwise not identifiable {other}", end=""
        )
        print(f", of {options.clips}", flush=True)


if __name__ == "__main__":
    main()
