"""Heights of cells in which a patch is dark, bright or has no ripples.

    python pipelines/studies/patches.py [--seeds 1 2]

Coherent cells in deep shadow, in some and in none, with straight and with wandering crests; a
square patch of 40 or 90 of 260 pixels is set to a hundredth of the mean intensity (shadow of an
object), made eight times as bright, replaced by flat floor, or has its shadows lit.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import product

import numpy as np
from judged import estimated, print_table

from sasmap.simulate import coherent_cell

SIDE = 260
KINDS = ("dark", "bright", "flat", "lit")
SCENES = {
    "deep shadow": dict(
        law="gaussian", height=0.042, frequency=1.17, near=39.7, altitude=3.35, noise=-19.0,
        range_flattened=True,
    ),
    "some shadow": dict(
        law="lambert", height=0.06, frequency=0.8, near=20.0, altitude=4.0, noise=-22.0
    ),
    "no shadow": dict(
        law="rough", height=0.05, frequency=0.8, near=10.0, altitude=6.0, noise=-25.0
    ),
}  # fmt: skip


def patched(power: np.ndarray, kind: str, size: int, rng: np.random.Generator) -> np.ndarray:
    """Intensity with a patch at a random place."""
    row, column = rng.integers(0, SIDE - size, 2)
    there = np.s_[row : row + size, column : column + size]
    speckle = power.mean() * rng.exponential(size=(size, size))
    changed = power.copy()
    changed[there] = {
        "dark": 0.01 * speckle,
        "bright": 8 * power[there],
        "flat": speckle,
        "lit": np.maximum(0.4 * speckle, power[there]),
    }[kind]
    return changed


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    rows = []
    for (name, scene), wander, seed in product(SCENES.items(), (0.0, 0.5), options.seeds):
        rng = np.random.default_rng([seed, 88])
        made = coherent_cell(
            rng, pixel_size=0.05, shape=(SIDE, SIDE), wander=wander, wander_length=5.0, **scene
        )
        for kind, size in product(KINDS, (40, 90)):
            power = patched(made.clip.amplitude**2, kind, size, rng)
            clip = replace(made.clip, amplitude=np.sqrt(power))
            row = estimated(clip, made.frequency, made.height, seed)
            rows.append({"scene": name, "patch": f"{kind}, {size} pixels", **row})
    print_table(rows, ("scene", "patch"))


if __name__ == "__main__":
    main()
