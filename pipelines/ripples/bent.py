"""Bent and forked crests: errors of f and A_H, coverage of their intervals, time.

    python pipelines/ripples/bent.py [--clips 40]

The truth of f is the wave number of the plane fitted to the clip's own simulated phase by least
squares. Kinds: crests that wander by 2 rad (rms; more than pi across the clip), and crests with
three forks that wander a little.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from sasmap.ripples import Quality, RippleSettings, estimate
from sasmap.simulate import Scene, simulate_clip

ORIGIN = (500000.0, 3300000.0)
KINDS = ("straight", "wander", "forks")


class Case(NamedTuple):
    """One clip: relative errors, whether 90 % intervals cover, time."""

    found: bool
    quality: int
    frequency: float
    height: float
    covers: tuple[bool, bool]
    seconds: float


def scene_of(kind: str, seed: int, size: int) -> Scene:
    """Draw a scene: 8 to 20 wavelengths of ripples of moderate steepness."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    pixel = 0.05
    length = size * pixel
    frequency = rng.uniform(8, 20) / length
    steepness = rng.uniform(0.1, 0.35)
    patch = {
        "frequency": frequency,
        "height": steepness / (2 * np.pi * frequency),
        "azimuth": 90 + rng.uniform(-50, 50),
        "phase": rng.uniform(0, 2 * np.pi),
    }
    if kind == "wander":
        patch |= {"wander": 2.0, "wander_length": length / rng.uniform(3, 5)}
    if kind == "forks":
        forks = rng.uniform(0.15 * length, 0.85 * length, (3, 2))
        patch |= {"wander": 0.5, "wander_length": length / 3}
        patch["forks"] = [tuple(float(v) for v in fork) for fork in forks]
    one = {
        "name": "one",
        "heading": 0,
        "distance": rng.uniform(20, 50) + length / 2,
        "altitude": rng.uniform(4, 10),
        "dtype": "float32",
    }
    return Scene(
        name=kind,
        seed=seed,
        origin=ORIGIN,
        size=(length, length),
        pixel_size=pixel,
        sediments=[{"name": "sand"}],
        ripples=[patch],
        passes=[one],
    )


def one(seed: int, kind: str, size: int) -> Case:
    """Simulate and estimate one clip."""
    made = simulate_clip(scene_of(kind, seed, size), np.random.default_rng([seed, 7]))
    start = time.perf_counter()
    posterior = estimate(made.clip, RippleSettings(), rng=seed)
    seconds = time.perf_counter() - start
    if not posterior.sampled:
        nothing = float("nan")
        return Case(False, int(posterior.quality), nothing, nothing, (False, False), seconds)
    mean, quantiles = posterior.mean, posterior.quantiles
    truth = {"frequency": made.frequency, "height": made.height}
    covers = [bool(quantiles[n].values[0] <= t <= quantiles[n].values[2]) for n, t in truth.items()]
    errors = [float(mean[n]) / t - 1 for n, t in truth.items()]
    return Case(True, int(posterior.quality), *errors, (covers[0], covers[1]), seconds)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=40)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--size", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print("          clips found good |  |error| of f (%): median, 90 % | of A_H | in 2 %, 15 % |"
          " 90 % intervals cover f, A_H | s/clip")  # fmt: skip
    with ProcessPoolExecutor(options.workers) as pool:
        for kind in options.kinds.split(","):
            run = partial(one, kind=kind, size=options.size)
            cases = list(pool.map(run, range(options.clips)))
            found = [c for c in cases if c.found]
            f, h = (100 * np.abs([getattr(c, n) for c in found]) for n in ("frequency", "height"))
            cover = 100 * np.mean([c.covers for c in found], axis=0)
            good = sum(c.quality == Quality.GOOD for c in found)
            within = 100 * np.mean(f < 2), 100 * np.mean(h < 15)
            print(
                f"{kind:9s} {len(cases):5d} {len(found):5d} {good:4d} | "
                f"{np.median(f):10.2f} {np.quantile(f, 0.9):10.2f} | {np.median(h):6.1f} "
                f"{np.quantile(h, 0.9):6.1f} | {within[0]:4.0f} % {within[1]:4.0f} % | "
                f"{cover[0]:5.0f} {cover[1]:5.0f} | {np.median([c.seconds for c in cases]):.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
