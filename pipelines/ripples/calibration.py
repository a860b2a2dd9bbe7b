"""Simulation-based calibration: whether intervals of f, A_H and azimuth mean what they say.

    python pipelines/ripples/calibration.py [--draws 2000] [--rows exact,k,stokes,lambert,wavy]

Every clip has its own survey prior: a wavelength of 0.2 to 5 m, A_H of 0.005 to 0.3 m, a crest
normal in any direction, ranges of 5 to 150 m, altitudes of 3 to 20 m. Its truth is drawn from that
prior, and the estimate is given the same prior; receiver noise is drawn from the estimator's own.
A clip holds 6 to 16 wavelengths of 12 to 30 pixels. Ranks are of the truth among the draws; the
band is that of the ECDF of as many uniform ranks. Rows on scenes that are not as the model says are
there to show what happens.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats

from sasmap.ripples import Clip, Prior, RippleSettings, estimate
from sasmap.ripples.posterior import Quality
from sasmap.simulate import Scene, simulate_clip, straight_clip

ARRAYS = ("amplitude", "x", "y", "ground_range", "altitude", "look_azimuth")
LEVELS = (0.5, 0.9, 0.95)
NAMES = ("f", "A_H", "azimuth")
ROWS = {
    "exact": "as the model says, Rayleigh speckle",
    "k": "correlated K speckle (nu 4, 0.7 pixels)",
    "stokes": "Stokes crests seen as sine",
    "lambert": "Lambert's law instead of sigma_s",
    "wavy": "crests that wander by 1.5 rad (rms)",
}


class Case(NamedTuple):
    """What one clip came to: ranks (0 to 1) of the truth, absolute z, and quality."""

    ranks: np.ndarray
    errors: np.ndarray
    detected: bool
    quality: int


def draw_prior(rng: np.random.Generator) -> Prior:
    """Draw a survey's prior: f to a tenth, A_H to two fifths, of a ripple that can exist."""
    while True:
        frequency = 1 / np.exp(rng.uniform(np.log(0.2), np.log(5.0)))
        height = np.exp(rng.uniform(np.log(0.005), np.log(0.3)))
        if 0.03 < 2 * np.pi * frequency * height < 0.6:
            break
    return Prior((frequency, height), (0.1 * frequency, 0.4 * height), ((0.15, 6.0), (0.002, 0.6)))


def draw_truth(prior: Prior, rng: np.random.Generator) -> tuple[float, float]:
    """Draw f and A_H from a prior."""
    truth = []
    for mean, sd, bounds in zip(prior.mean, prior.sd, prior.bounds, strict=True):
        low, high = ((b - mean) / sd for b in bounds)
        truth.append(float(stats.truncnorm(low, high, mean, sd).rvs(random_state=rng)))
    return truth[0], truth[1]


def simulated(row: str, prior: Prior, azimuth: float, rng: np.random.Generator):
    """Simulate a clip; return it with the f and A_H that are true of it."""
    frequency, height = draw_truth(prior, rng)
    pixel = 1 / frequency / rng.uniform(12, 30)
    side = round(rng.uniform(6, 16) / frequency / pixel)
    near = np.exp(rng.uniform(np.log(5), np.log(150)))
    altitude = rng.uniform(3, 20)
    noise = float(np.exp(min(rng.normal(np.log(0.01), 2.0), 2.0)))  # the estimator's own prior
    if row == "wavy":
        length = side * pixel
        origin = (500000.0, 3300000.0)
        patch = {
            "frequency": frequency,
            "height": height,
            "azimuth": azimuth,
            "phase": rng.uniform(0, 2 * np.pi),
            "wander": 1.5,
            "wander_length": length / 3,
        }
        scene = Scene(
            name="wavy",
            seed=int(rng.integers(2**31)),
            origin=origin,
            size=(length, length),
            pixel_size=pixel,
            sediments=[{"name": "sand"}],
            ripples=[patch],
            passes=[
                {
                    "name": "one",
                    "heading": 0,
                    "distance": near + length / 2,
                    "altitude": altitude,
                    "dtype": "float32",
                }
            ],
        )
        made = simulate_clip(scene, rng)
        return made.clip, (made.frequency, made.height, made.azimuth)
    clip = straight_clip(
        rng,
        frequency=frequency,
        height=height,
        azimuth=azimuth,
        phase=rng.uniform(0, 2 * np.pi),
        near=near,
        altitude=altitude,
        pixel_size=pixel,
        shape=(side, side),
        profile="stokes" if row == "stokes" else "sine",
        nu=4.0 if row == "k" else float("inf"),
        correlation=0.7 if row == "k" else 0.0,
        lambert=row == "lambert",
        noise=noise,
    )
    return mirrored(clip, rng), (frequency, height, azimuth)


def mirrored(clip: Clip, rng: np.random.Generator) -> Clip:
    """Store rows and columns the other way round, or not: the same sea floor and look."""
    steps = tuple(slice(None, None, int(s)) for s in rng.choice([-1, 1], 2))
    fields = {name: np.asarray(getattr(clip, name))[steps].copy() for name in ARRAYS}
    return replace(clip, **fields)


def one(seed: int, row: str) -> Case:
    """Simulate and estimate one clip."""
    rng = np.random.default_rng([seed, list(ROWS).index(row)])
    prior = draw_prior(rng)
    clip, truth = simulated(row, prior, rng.uniform(0, 180), rng)
    rigid = {"profile": "sine", "speckle": "measured" if row == "k" else "independent"}
    settings = RippleSettings(
        frequency=prior.bounds[0], height=prior.bounds[1], presence="assumed", **rigid
    )
    posterior = estimate(clip, settings, rng=seed, prior=prior)
    if not posterior.sampled:
        nothing = np.full(3, np.nan)
        return Case(nothing, nothing, False, int(posterior.quality))
    draws = [posterior.draws[n].values.ravel() for n in ("frequency", "height", "azimuth")]
    turn = (truth[2] - posterior.azimuth[0] + 90) % 180 - 90
    draws[2] = (draws[2] - posterior.azimuth[0] + 90) % 180 - 90
    known = (truth[0], truth[1], turn)
    ranks = np.array([(d < t).mean() for d, t in zip(draws, known, strict=True)])
    errors = np.array([(d.mean() - t) / d.std() for d, t in zip(draws, known, strict=True)])
    return Case(ranks, errors, posterior.probability > 0.5, int(posterior.quality))


def band(n: int, level: float = 0.99, trials: int = 2000) -> float:
    """Largest distance of the ECDF of n uniform ranks from the diagonal, at a level."""
    rng = np.random.default_rng(1)
    return float(np.quantile([distance(rng.random(n)) for _ in range(trials)], level))


def distance(ranks: np.ndarray) -> float:
    """Kolmogorov's distance of ranks from uniform."""
    return float(stats.kstest(ranks, "uniform").statistic)


def report(title: str, cases: list[Case]) -> None:
    """Print one row of the table for each parameter."""
    if not cases:
        return
    ranks = np.array([c.ranks for c in cases])
    errors = np.array([c.errors for c in cases])
    limit = band(len(ranks))
    for i, name in enumerate(NAMES):
        cover = [100 * np.mean(np.abs(ranks[:, i] - 0.5) <= level / 2) for level in LEVELS]
        rms = np.sqrt(np.median(errors[:, i] ** 2)) / 0.6745
        print(
            f"{title:34s} {name:8s} {len(ranks):5d}  {cover[0]:5.1f} {cover[1]:5.1f} "
            f"{cover[2]:5.1f}   {distance(ranks[:, i]):.3f} ({limit:.3f})   {rms:5.2f}",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--rows", default="exact,k,stokes,lambert,wavy")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print(f"{'':34s} {'':8s} clips   50 %  90 %  95 %   ECDF (99 % band)   robust sd of z")
    with ProcessPoolExecutor(options.workers) as pool:
        for row in options.rows.split(","):
            run = partial(one, row=row)
            cases = list(pool.map(run, range(options.draws), chunksize=5))
            sampled = [c for c in cases if np.isfinite(c.ranks).all()]
            report(ROWS[row], sampled)
            report("  detected", [c for c in sampled if c.detected])
            good = [c for c in sampled if c.detected and c.quality == Quality.GOOD]
            report("  detected, good", good)
            counts = np.bincount([c.quality for c in cases], minlength=8)
            named = [f"{Quality(i).label} {n}" for i, n in enumerate(counts) if n]
            print(f"  {', '.join(named)}", flush=True)


if __name__ == "__main__":
    main()
