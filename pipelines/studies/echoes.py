"""Independent echoes: heights on images from the raw data of another simulator.

    python pipelines/studies/echoes.py [--quick] [--scenes 18] [--first 0] [--images DIR]

Needs openstb-simulator (``pip install -e '.[studies]'``). Rippled floors of 5 random point
scatterers a pixel, 250 x 250 pixels of 5 cm, at least 8 wavelengths; three scattering laws
(Lambert's; the sine of the grazing angle; sin^1.5 with a specular peak, which is outside of the
estimator's family), two headings of the track over the bed, three ranges, sine, pointed and
asymmetric crests, straight or wandering; shadow by line of sight. openstb-simulator gives the
receiver's raw data, ``rawdata.py`` compresses and backprojects them, and sasmap estimates each
image alone with default settings, from pixels and geometry only. Noise is 25 dB below the image's
mean intensity. A scene takes one to two minutes of one core. Kept are the seeds and the estimates
(echoes.csv), not the raw data.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rawdata
from judged import estimated, print_table, write_rows
from numpy.typing import NDArray

from sasmap.ripples import Clip

FloatArray = NDArray[np.float64]

LAWS = {
    "lambert": lambda sine: sine**2,
    "sine": lambda sine: sine,
    # geometric optics with 15 degrees of rms slope, as strong as the rest at normal incidence
    "peaked": lambda sine: (
        sine**1.5 + np.exp(-(1 / sine**2 - 1) / (2 * np.tan(np.radians(15)) ** 2)) / sine**4
    ),
}
HEADINGS = (0.0, 35.0)
NEAR = (10.0, 24.0, 16.0)
ALTITUDE, NOISE, DENSITY = 5.0, -25.0, 5.0
PROFILES = ("sine", "pointed", "asymmetric")


class Bed(NamedTuple):
    """A rippled floor in map coordinates: h = A_H times a profile of the phase.

    Attributes
    ----------
    frequency, height : float
        Of the mean wave vector (cycles/m), and A_H, m.
    azimuth : float
        Of the crest normal, degrees clockwise from north.
    profile : str
    wander : ndarray (waves, 4)
        Plane waves that the phase wanders by: wave vector (rad/m), offset (rad), size (rad).
    offset : float
        rad.
    """

    frequency: float
    height: float
    azimuth: float
    profile: str
    wander: FloatArray
    offset: float

    def elevation(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height over the mean at map points, m."""
        p = self.phase(x, y)
        if self.profile == "pointed":
            return self.height * (np.sin(p) - 0.15 * np.cos(2 * p))
        if self.profile == "asymmetric":
            return self.height * np.sin(p + 0.35 * np.sin(p))
        return self.height * np.sin(p)

    def phase(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Phase at map points, rad."""
        turn = np.radians(self.azimuth)
        along = x * np.sin(turn) + y * np.cos(turn)
        phase = 2 * np.pi * self.frequency * along + self.offset
        for kx, ky, offset, size in self.wander:
            phase = phase + size * np.sin(kx * x + ky * y + offset)
        return np.asarray(phase)


class Scene(NamedTuple):
    """Parameters of a scene."""

    bed: Bed
    law: str
    heading: float
    swath: rawdata.Swath


def scene_of(seed: int, size: int) -> Scene:
    """Draw a scene: laws, headings and ranges in turn, the bed at random."""
    rng = np.random.default_rng([seed, 2511])
    extent = 0.05 * size
    off_look = rng.uniform(-35, 35)
    heading = HEADINGS[seed // 3 % 2]
    # at least eight wavelengths; crest to trough at most 0.16 wavelengths
    frequency = rng.uniform(8.2, 12) / extent / np.cos(np.radians(off_look))
    height = rng.uniform(0.02, 0.08 / frequency)
    turns = rng.uniform(0, 2 * np.pi, 4), rng.uniform(5, 10, 4), rng.uniform(0, 2 * np.pi, 4)
    size_of = 0.0 if seed % 2 else rng.uniform(0.3, 0.8)
    wander = np.column_stack(
        [
            2 * np.pi / turns[1] * np.cos(turns[0]),
            2 * np.pi / turns[1] * np.sin(turns[0]),
            turns[2],
            np.full(4, size_of / np.sqrt(2)),
        ]
    )
    azimuth = heading + 90 + off_look
    profile = PROFILES[rng.integers(3)]
    bed = Bed(frequency, height, azimuth, profile, wander, rng.uniform(0, 2 * np.pi))
    swath = rawdata.Swath(size, size, NEAR[seed // 6 % 3], ALTITUDE)
    return Scene(bed, tuple(LAWS)[seed % 3], heading, swath)


def to_map(heading: float, along: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Map position (east, north, m) of points along and to starboard of the track."""
    sine, cosine = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    return along * sine + across * cosine, along * cosine - across * sine


def record(
    scene: Scene, recorder: rawdata.Recorder, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Record and focus a scene: the image's amplitude, rows along the track."""
    sonar, swath = recorder.sonar, scene.swath

    def floor(along: FloatArray, across: FloatArray) -> FloatArray:
        return scene.bed.elevation(*to_map(scene.heading, along, across))

    points = rawdata.scatterers(floor, LAWS[scene.law], sonar, swath, DENSITY, rng)
    pressure, places, gate = recorder.record(*points, swath)
    hiss = rng.normal(size=pressure.shape) + 1j * rng.normal(size=pressure.shape)
    echo, noise = (
        rawdata.backproject(rawdata.compress(raw, sonar), places, gate, sonar, swath)
        for raw in (pressure, hiss)
    )
    level = 10 ** (NOISE / 10) * np.mean(np.abs(echo) ** 2) / np.mean(np.abs(noise) ** 2)
    return np.abs(echo + np.sqrt(level) * noise).astype(np.float32)


def clip_of(scene: Scene, amplitude: NDArray[np.float32], pixel: float) -> tuple[Clip, float]:
    """Give an image its geometry; the clip, and the true f of the mean wave in it."""
    swath = scene.swath
    along, across = np.meshgrid(*swath.lattice(pixel), indexing="ij")
    x, y = to_map(scene.heading, along, across)
    same = np.full(x.shape, swath.altitude), np.full(x.shape, (scene.heading + 90) % 360)
    design = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    wave = np.linalg.lstsq(design, scene.bed.phase(x, y).ravel(), rcond=None)[0][:2]
    # rows run against the track, as in a map that has north on top
    flipped = (v[::-1] for v in (amplitude.astype(float), x, y, across, *same))
    return Clip(*flipped, pixel), float(np.hypot(*wave) / (2 * np.pi))


def one(seed: int, size: int, recorder: rawdata.Recorder, kept: Path | None) -> dict[str, Any]:
    """Simulate and estimate a scene; a row of the table."""
    scene = scene_of(seed, size)
    image = None if kept is None else kept / f"echo_{seed}_{size}.npy"
    start = time.perf_counter()
    if image is not None and image.exists():
        amplitude = np.load(image)
    else:
        amplitude = record(scene, recorder, np.random.default_rng([seed, 1900]))
        if image is not None:
            np.save(image, amplitude)
    seconds = time.perf_counter() - start
    clip, truth = clip_of(scene, amplitude, recorder.sonar.pixel)
    bed = scene.bed
    about = {
        "seed": seed,
        "law": scene.law,
        "heading": scene.heading,
        "near": scene.swath.near,
        "profile": bed.profile,
        "crests": "wander" if bed.wander[0, 3] else "straight",
        "seconds_to_simulate": round(seconds, 1),
    }
    return about | estimated(clip, truth, bed.height, seed)


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one scene of 120 x 120 pixels")
    parser.add_argument("--scenes", type=int, default=18)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument(
        "--images", type=Path, help="keep images here, and use those that are here already"
    )
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    size, scenes = (120, 1) if options.quick else (250, options.scenes)
    if options.images:
        options.images.mkdir(parents=True, exist_ok=True)
    recorder = rawdata.Recorder(rawdata.Sonar())
    rows = []
    for seed in range(options.first, options.first + scenes):
        rows.append(one(seed, size, recorder, options.images))
        print({k: v if isinstance(v, str) else f"{v:.4g}" for k, v in rows[-1].items()}, flush=True)
        write_rows(options.output / "echoes.csv", rows)
    recorder.close()
    print_table(rows, ("law", "heading", "near", "profile", "crests"))


if __name__ == "__main__":
    main()
