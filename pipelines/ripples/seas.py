"""Detection and wavelength on random seas: short crests, defects and several directions.

    python pipelines/ripples/seas.py [--cells 40] [--size 300] [--first 0]

Heights are Gaussian random seas with the spectra of surveyed dunes (a band of wavelengths
about a peak, directions spread about one or two), not sums of a phase: crests are short, fork and
end everywhere. They are rendered by the coherent simulator. For each kind of bed the share of cells
where ripples are found, and the wavelength over that of the spectrum's peak.
"""

from __future__ import annotations

import argparse

import numpy as np

from sasmap.ripples import Clip
from sasmap.ripples.detection import find_waves
from sasmap.ripples.image import as_image
from sasmap.simulate.coherent import coherent_amplitude
from sasmap.simulate.scene import Scene
from sasmap.simulate.seafloor import SeaFloor, Waves

PIXEL, ALTITUDE, WAVES = 0.025, 5.0, 160
# Relative spread of wave numbers, spread of directions (degrees), and weight of a second system
# across the first.
KINDS = {
    "long crests": (0.08, 6.0, 0.0),
    "usual crests": (0.12, 12.0, 0.0),
    "short crests": (0.18, 20.0, 0.0),
    "very short crests": (0.25, 30.0, 0.0),
    "two directions": (0.12, 10.0, 0.6),
}


class Bed(SeaFloor):
    """A sea floor whose height is a sum of random waves."""

    def __init__(self, scene: Scene, numbers: np.ndarray, sizes: np.ndarray, phases: np.ndarray):
        super().__init__(scene)
        self._parts = numbers, sizes, phases

    def systems(self, x: np.ndarray, y: np.ndarray) -> list[Waves]:
        """Heights in place of one system of waves."""
        shape = np.broadcast_shapes(np.shape(x), np.shape(y))
        height = np.zeros(shape)
        for (east, north), size, phase in zip(*self._parts, strict=True):
            height += size * np.sin(2 * np.pi * (east * x + north * y) + phase)
        none = np.zeros(shape)
        return [Waves(none, none, none, height, np.zeros(shape, np.int64))]

    def elevation(self, waves: Waves) -> np.ndarray:
        """Heights, m."""
        return waves.height

    @property
    def relief(self) -> float:
        """Upper bound of the height over or under the mean, m."""
        return float(np.abs(self._parts[1]).sum())


def bed(rng: np.random.Generator, scene: Scene, frequency: float, kind: str) -> Bed:
    """Draw a bed: root mean square height of an amplitude of a twentieth of a wavelength."""
    spread, turn, second = KINDS[kind]
    length = frequency * np.exp(rng.normal(0, spread, WAVES))
    first = rng.uniform(45, 135)
    direction = np.where(
        rng.random(WAVES) < second / (1 + second), first + rng.uniform(50, 80), first
    )
    angle = np.radians(direction + rng.normal(0, turn, WAVES))
    numbers = length[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    sizes = np.full(WAVES, 0.04 / frequency / np.sqrt(WAVES))
    return Bed(scene, numbers, sizes, rng.uniform(0, 2 * np.pi, WAVES))


def rendered(seed: int, size: int, kind: str) -> tuple[Clip, float]:
    """Clip of a bed, and the frequency of its spectrum's peak, cycles/m."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    side, near = size * PIXEL, float(rng.uniform(10, 30))
    scene = Scene.model_validate(
        {
            "name": "bed", "seed": seed, "origin": (0.0, 0.0), "size": (side, side),
            "pixel_size": PIXEL, "physics": "coherent", "law": "lambert",
            "sediments": [{"name": "sand"}],
            "passes": [
                {"name": "east", "heading": 0.0, "distance": near + 0.5 * side,
                 "altitude": ALTITUDE, "noise": -25.0, "dtype": "float32"}
            ],
        }
    )  # fmt: skip
    frequency = float(rng.uniform(6, 10)) / side
    floor = bed(rng, scene, frequency, kind)
    down, right = np.indices((size, size))
    x, y = PIXEL * (right + 0.5), side - PIXEL * (down + 0.5)
    reach = near + x
    along = y - 0.5 * side
    pixels = coherent_amplitude(scene, floor, scene.passes[0], along.ravel(), reach.ravel(), seed)
    shape = (size, size)
    amplitude = pixels.reshape(shape)
    clip = Clip(amplitude, x, y, reach, np.full(shape, ALTITUDE), np.full(shape, 90.0), PIXEL)
    return clip, frequency


def main() -> None:
    """Print a line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=40)
    parser.add_argument("--size", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    options = parser.parse_args()
    for kind in options.kinds.split(","):
        ratios = []
        for seed in range(options.first, options.first + options.cells):
            clip, frequency = rendered(seed, options.size, kind)
            waves = [w for w in find_waves(as_image(clip), (0.05, 10.0)).waves if w.evidence > 0]
            if waves:
                strongest = max(waves, key=lambda w: w.energy)
                ratios.append(frequency / float(np.hypot(*strongest.vector)))
        words = f"{kind:18s} found {len(ratios)} of {options.cells}"
        if ratios:
            low, middle, high = np.quantile(ratios, (0.1, 0.5, 0.9))
            words += f"; wavelength over the spectrum's {middle:.2f} ({low:.2f} to {high:.2f})"
        print(words, flush=True)


if __name__ == "__main__":
    main()
