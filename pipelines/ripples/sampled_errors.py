"""What it costs that errors of law and profile are integrated out, not sampled.

    python pipelines/ripples/sampled_errors.py [--draws 110] [--workers 2]

The likelihood integrates the law's departure from its family, the profile's third harmonic and what
sasmap.ripples.nuisance names out to second order about the fit. Here the same posterior is sampled
with eight amplitudes and those as coordinates, rendered anew at every point: 120 chains of 3000
steps by differential evolution (ter Braak and Vrugt 2008), about thirty times the densities of an
estimate. Clips are those of calibration.py; the fit starts at the true wave.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numba
import numpy as np
from calibration import LEVELS, coverage, draw

from sasmap.ripples import Prior, RippleSettings
from sasmap.ripples.errors import LAW_ERROR, THIRD_HARMONIC
from sasmap.ripples.estimation import draw_points
from sasmap.ripples.fit import NoPlaceError, Task, fit_wave
from sasmap.ripples.image import as_image
from sasmap.ripples.optimise import COORDINATES
from sasmap.ripples.rendered import Fit
from sasmap.ripples.rendering import log_posterior, named_parameters

# Standard deviation of log A_H below which it counts as well known (as in coherent.py).
KNOWN = 0.1
LAW = len(THIRD_HARMONIC)
SD = np.concatenate([THIRD_HARMONIC, LAW_ERROR])
CHAINS, STEPS, BURN_IN, KEPT = 120, 3000, 1000, 10
# Shares of the coordinates that a step moves, share of steps between modes, points of the archive.
MOVED, JUMP, ARCHIVE = (0.15, 0.4, 1.0), 0.1, 20_000


class Result(NamedTuple):
    """Of a clip: rank of the true A_H, and standard deviation of its log, both ways."""

    rank: tuple[float, float]
    sd: tuple[float, float]


@numba.njit
def log_densities(points, sd, data, geometry):  # type: ignore[no-untyped-def]
    """Log posterior density of coordinates and amplitudes (n, COORDINATES + amplitudes)."""
    values = np.empty(len(points))
    for i in range(len(points)):
        amplitude = points[i, COORDINATES:]
        geometry.third_harmonic[:] = sd[:LAW] * amplitude[:LAW]
        geometry.law_error[:] = sd[LAW:] * amplitude[LAW:]
        values[i] = log_posterior(points[i, :COORDINATES].copy(), data, geometry)
        values[i] -= 0.5 * np.sum(amplitude**2)
    return values


def sampled_with_errors(fit: Fit, draws: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw coordinates (n, COORDINATES), from draws of the integrated posterior as a start."""
    data = fit.data._replace(errors=fit.data.errors[:0])
    copied = ("law_error", "third_harmonic")
    geometry = fit.geometry._replace(**{k: getattr(fit.geometry, k).copy() for k in copied})
    start = rng.choice(draws.reshape(-1, COORDINATES), CHAINS)
    state = np.hstack([start, 0.5 * rng.standard_normal((CHAINS, SD.size))])
    level = log_densities(state, SD, data, geometry)
    archive, kept = state.copy(), []
    size = state.shape[1]
    for step in range(STEPS):
        pairs = archive[rng.integers(len(archive), size=(2, CHAINS))]
        moved = rng.random((CHAINS, size)) < MOVED[rng.integers(len(MOVED))]
        moved[np.arange(CHAINS), rng.integers(size, size=CHAINS)] = True
        scale = 2.38 / np.sqrt(2 * moved.sum(axis=1, keepdims=True)) * rng.choice([0.5, 1.0])
        if rng.random() < JUMP:
            moved, scale = np.ones_like(moved), np.ones((CHAINS, 1))
        noise = 1e-5 * rng.standard_normal((CHAINS, size))
        proposed = state + moved * (scale * (pairs[0] - pairs[1]) + noise)
        reached = log_densities(proposed, SD, data, geometry)
        better = np.log(rng.random(CHAINS)) < reached - level
        state = np.where(better[:, None], proposed, state)
        level = np.where(better, reached, level)
        if step % KEPT == 0:
            archive = np.concatenate([archive[CHAINS if len(archive) > ARCHIVE else 0 :], state])
            kept += [state[:, :COORDINATES]] if step > BURN_IN else []
    return np.concatenate(kept)


def one(seed: int) -> Result | None:
    """Draw a clip and rank its true A_H among draws of both posteriors; None if none fits."""
    scene, ripple, clip = draw(seed)
    settings = RippleSettings()
    prior = Prior.natural(settings.frequency, settings.height)
    wave = scene.frequency * np.array([np.cos(scene.turn), -np.sin(scene.turn)])
    try:
        fit = fit_wave(Task(as_image(clip), settings, prior, clip.altitude_sd), wave)
    except NoPlaceError:
        return None
    integrated = draw_points(fit, settings, np.random.default_rng(seed))[0]
    exact = sampled_with_errors(fit, integrated, np.random.default_rng(seed))
    height = [named_parameters(p, fit.geometry)["height"] for p in (integrated, exact)]
    ranks = [float(np.mean(h < ripple.height)) for h in height]
    spreads = [float(np.log(h).std()) for h in height]
    return Result((ranks[0], ranks[1]), (spreads[0], spreads[1]))


def main() -> None:
    """Print the coverage of both posteriors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=110)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        found = [r for r in pool.map(one, range(options.draws)) if r]
    rank, sd = (np.array([getattr(r, name) for r in found]) for name in ("rank", "sd"))
    print(f"A_H in intervals of {', '.join(f'{x:.0%}' for x in LEVELS)}; ratio of sd, 10, 50, 90 %")
    known = sd[:, 0] < KNOWN
    for title, chosen in (("all", known | True), (f"sd < {KNOWN}", known), ("others", ~known)):
        if not chosen.any():  # few clips may hold none of a kind
            continue
        ratio = np.quantile(sd[chosen, 1] / sd[chosen, 0], [0.1, 0.5, 0.9])
        print(f"{title}, {chosen.sum()} clips; ratio", *(f"{r:.2f}" for r in ratio))
        for k, name in enumerate(("errors integrated out", "errors sampled")):
            print(f"  {name:22s}", *(f"{c:5.1f}" for c in coverage(rank[chosen, k])))


if __name__ == "__main__":
    main()
