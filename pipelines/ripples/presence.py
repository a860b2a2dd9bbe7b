"""Detection of ripples: false alarms on many kinds of flat floor, weak and forked ripples.

    python pipelines/ripples/presence.py [--clips 600] [--first 0] [--kinds rayleigh,k_law,...]

Each kind of flat floor (floors.py) is simulated that many times, in turn as received, display-
scaled to 8 bits and JPEG-compressed, at windows from 128 to 500 pixels; at most one in 10 000 may
be a false alarm. Ripples must be found in 99 % (contrast 0.1 over 8 wavelengths), 95 % (0.2
over 4) and 90 % (forks, crossing sets). Contrast is peak to mean of the noiseless intensity.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import floors
import numpy as np

from sasmap.ripples import Clip
from sasmap.ripples.detection import find_waves
from sasmap.ripples.image import as_image

PIXEL = 0.05
WINDOWS = (128, 160, 200, 250, 300, 333, 500)
RIPPLED_WINDOW = 300
KINDS = {kind.__name__: kind for kind in (*floors.FLAT, *floors.RIPPLED)}
LEAST = {kind.__name__: share for kind, share in floors.RIPPLED.items()}


def simulated(seed: int, kind: str) -> Clip:
    """Make a clip of a kind."""
    rng = np.random.default_rng([seed, sum(kind.encode())])
    flat = kind not in LEAST
    size = WINDOWS[seed // 3 % len(WINDOWS)] if flat else RIPPLED_WINDOW
    amplitude = KINDS[kind](rng, size)
    if flat:
        amplitude = floors.VERSIONS[seed % 3](rng, amplitude)
    x = 30 + PIXEL * np.arange(size) + np.zeros((size, 1))
    y = PIXEL * np.arange(size)[::-1, None] + np.zeros((1, size))
    return Clip(amplitude, x, y, x, np.full(x.shape, 6.0), np.full(x.shape, 90.0), PIXEL)


def one(seed: int, kind: str) -> tuple[float, float]:
    """Probability that a clip of a kind is rippled (0 where inconclusive), and seconds."""
    clip = simulated(seed, kind)
    start = time.perf_counter()
    found = find_waves(as_image(clip), (0.05, 5.0))
    return float(np.nan_to_num(found.probability)), time.perf_counter() - start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=600)
    parser.add_argument("--first", type=int, default=0, help="seed of the first clip")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    alarms = clips = 0
    with ProcessPoolExecutor(options.workers) as pool:
        for kind in options.kinds.split(","):
            seeds = range(options.first, options.first + options.clips)
            results = list(pool.map(partial(one, kind=kind), seeds, chunksize=10))
            rippled = np.array([p for p, _ in results]) > 0.5
            seconds = np.median([s for _, s in results])
            wrong = np.flatnonzero(rippled == (kind not in LEAST))[:8] + options.first
            note = f"   not so: seeds {wrong.tolist()}" if wrong.size else ""
            wanted = f"found, of {LEAST[kind]:.0%}" if kind in LEAST else "false alarms"
            share = f"{100 * rippled.mean():6.2f} % {wanted:15s}"
            print(f"{kind:14s} {share} {seconds:.3f} s/clip{note}", flush=True)
            if kind not in LEAST:
                alarms, clips = alarms + int(rippled.sum()), clips + rippled.size
    print(f"{alarms} false alarms in {clips} flat clips")


if __name__ == "__main__":
    main()
