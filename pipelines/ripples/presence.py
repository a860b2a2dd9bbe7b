"""False alarms on sea floors without ripples, and detection of weak ripples.

    python pipelines/ripples/presence.py [--clips 1000] [--kinds rayleigh,k,...] [--size 300]

Each kind of flat sea floor is simulated that many times and must be told from ripples in 99 % of
them. Weak ripples have a contrast (peak to mean of the noiseless intensity) of 0.1 over 8
wavelengths and must be found in 99 %.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from sasmap.ripples import Clip, Quality, RippleSettings, estimate

PIXEL = 0.05


def speckle(
    rng: np.random.Generator, size: int, nu: float = np.inf, correlation: float = 0.0
) -> np.ndarray:
    """Amplitude of speckle of mean intensity 1: Rayleigh or K, of correlated pixels or not."""
    field = rng.normal(size=(2, size, size))
    if correlation > 0:
        field = gaussian_filter(field, (0, correlation, correlation), mode="wrap")
        field /= field.std()
    power = 0.5 * (field**2).sum(axis=0)
    if np.isfinite(nu):
        power *= rng.gamma(nu, 1 / nu, (size, size))
    return np.sqrt(power)


def smooth_noise(rng: np.random.Generator, size: int, length: float) -> np.ndarray:
    """Gaussian random field of standard deviation 1 and a correlation length in pixels."""
    field = gaussian_filter(rng.normal(size=(size, size)), length, mode="wrap")
    return field / field.std()


def rayleigh(rng: np.random.Generator, size: int) -> np.ndarray:
    """Independent Rayleigh speckle."""
    return speckle(rng, size)


def k_law(rng: np.random.Generator, size: int) -> np.ndarray:
    """Spiky K speckle (nu 1)."""
    return speckle(rng, size, 1.0)


def correlated(rng: np.random.Generator, size: int) -> np.ndarray:
    """Speckle correlated over up to 2 pixels."""
    return speckle(rng, size, correlation=rng.uniform(0.5, 2))


def correlated_k(rng: np.random.Generator, size: int) -> np.ndarray:
    """Correlated K speckle."""
    return speckle(rng, size, rng.uniform(1, 5), rng.uniform(0.5, 1.5))


def texture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Sea floor whose level varies by a smooth random field."""
    level = np.exp(0.3 * smooth_noise(rng, size, rng.uniform(2, 30)))
    return level * speckle(rng, size)


def quantised(rng: np.random.Generator, size: int) -> np.ndarray:
    """Few grey values, the brightest saturated."""
    return np.clip(np.floor(speckle(rng, size) * 6), 0, 12)


def trend(rng: np.random.Generator, size: int) -> np.ndarray:
    """Beam pattern along range, steep at one side."""
    x = np.linspace(0, 1, size)
    shape = np.exp(rng.uniform(-3, 3) * x) + 3 * np.exp(-0.5 * ((x - rng.random()) / 0.15) ** 2)
    return shape * speckle(rng, size)


def edge(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a straight boundary of two sediments."""
    turn, row, column = rng.uniform(0, np.pi), *np.indices((size, size)) - size / 2
    side = row * np.sin(turn) + column * np.cos(turn) > rng.uniform(-0.3, 0.3) * size
    return np.where(side, rng.uniform(1.5, 4), 1.0) * speckle(rng, size)


def wavy_edge(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a boundary that wanders."""
    line = gaussian_filter1d(rng.normal(size=size), rng.uniform(8, 40), mode="wrap")
    line = size / 2 + rng.uniform(0.02, 0.1) * size * line / line.std()
    side = np.arange(size) > line[:, None]
    return np.where(side, rng.uniform(1.5, 4), 1.0) * speckle(rng, size)


def wedge(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a band of another sediment."""
    turn, row, column = rng.uniform(0, np.pi), *np.indices((size, size)) - size / 2
    place = row * np.sin(turn) + column * np.cos(turn) - rng.uniform(-0.3, 0.3) * size
    inside = np.abs(place) < rng.uniform(0.03, 0.2) * size
    return np.where(inside, rng.uniform(1.5, 4), 1.0) * speckle(rng, size)


def objects(rng: np.random.Generator, size: int) -> np.ndarray:
    """One to four bright objects with a shadow behind each."""
    floor = np.ones((size, size))
    for _ in range(rng.integers(1, 5)):
        row, column = rng.integers(0, size - 60, 2)
        tall, wide, far = rng.integers(4, 30), rng.integers(2, 8), rng.integers(5, 50)
        floor[row : row + tall, column : column + wide] = rng.uniform(3, 10)
        floor[row : row + tall, column + wide : column + wide + far] = 0.05
    return floor * speckle(rng, size)


def holes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Missing lines and a missing corner."""
    result = speckle(rng, size)
    result[rng.random(size) < 0.1] = np.nan
    result[: size // 3, : size // 4] = np.nan
    return result


def weak_ripples(rng: np.random.Generator, size: int) -> np.ndarray:
    """Straight ripples of contrast 0.1, 8 wavelengths along a side, not looked at along crests."""
    turn = rng.uniform(-1.4, 1.4)
    row, column = np.indices((size, size))
    angle = 2 * np.pi * 8 / size * (column * np.cos(turn) + row * np.sin(turn))
    return np.sqrt(1 + 0.1 * np.sin(angle + rng.uniform(0, 6.3))) * speckle(rng, size)


FLAT = {
    f.__name__: f
    for f in (
        rayleigh,
        k_law,
        correlated,
        correlated_k,
        texture,
        quantised,
        trend,
        edge,
        wavy_edge,
        wedge,
        objects,
        holes,
    )
}
KINDS = {**FLAT, "weak_ripples": weak_ripples}


def one(seed: int, kind: str, size: int) -> tuple[bool, float]:
    """Whether a clip of a kind is taken for rippled, and seconds."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    amplitude = KINDS[kind](rng, size)
    x = 30 + PIXEL * np.arange(size) + np.zeros((size, 1))
    y = PIXEL * np.arange(size)[::-1, None] + np.zeros((1, size))
    altitude, look = np.full(x.shape, 6.0), np.full(x.shape, 90.0)
    clip = Clip(amplitude, x, y, x, altitude, look, PIXEL)
    settings = RippleSettings(draws=100)
    start = time.perf_counter()
    posterior = estimate(clip, settings, rng=seed)
    rippled = posterior.probability > 0.5 and posterior.quality != Quality.NO_RIPPLES
    return bool(rippled), time.perf_counter() - start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=1000)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--size", type=int, default=300)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print(f"{options.clips} clips a kind of {options.size} x {options.size} pixels")
    with ProcessPoolExecutor(options.workers) as pool:
        for kind in options.kinds.split(","):
            run = partial(one, kind=kind, size=options.size)
            results = list(pool.map(run, range(options.clips), chunksize=10))
            rippled = [r for r, _ in results]
            seconds = np.median([s for _, s in results])
            wanted = "found" if kind == "weak_ripples" else "false alarms"
            which = [i for i, r in enumerate(rippled) if r == (kind != "weak_ripples")][:8]
            note = f"   not so: seeds {which}" if which else ""
            share = f"{100 * np.mean(rippled):6.2f} % {wanted:12s}"
            print(f"{kind:14s} {share} {seconds:.3f} s/clip{note}", flush=True)


if __name__ == "__main__":
    main()
