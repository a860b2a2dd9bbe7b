"""Simulation-based calibration of the intervals of f, A_H and azimuth.

    python pipelines/ripples/calibration.py [--draws 400] [--workers 2]

Every clip is drawn from the default model itself (Talts et al. 2018): height, scattering law, crest
profile, noise, blur and altitude from their priors, and the errors that the model allows for
(the law's departure from its family, the profile's third harmonic, heights that change over range,
errors that pixels of a wavelength share, a little light in shadow). A clip holds 6 to 12 straight
wavelengths of 16 to 60 pixels, seen at 5 to 50 m.
Ranks are of the truth among the draws; the band is that of the ECDF of as many uniform ranks.
Clips whose ripple is not detected are left out: the selection depends on the image alone, so that
intervals must be calibrated on the others.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy import stats

from sasmap.ripples import Clip, Prior, Quality, RippleSettings, estimate
from sasmap.ripples.errors import (
    DARK_ERROR,
    ERROR_CELLS,
    LAW_ERROR,
    MODEL_ERROR,
    MODEL_SHIFT,
    THIRD_HARMONIC,
)
from sasmap.ripples.fit import ANY_PHASE, FOUND_TO, OWN_WIDTH
from sasmap.ripples.optimise import COORDINATES, HEIGHT, TREND
from sasmap.ripples.rendering import (
    LAW_BOUNDS,
    LAW_KNOTS,
    LINE_OF_SIGHT,
    Geometry,
    Histogram,
    Parameters,
    fill_pulses,
    parameters_at,
)

LEVELS = (0.5, 0.9, 0.95)
NAMES = ("frequency", "height", "azimuth")
BINS = 128
ALTITUDE_SD = 0.02


class Case(NamedTuple):
    """Result of a clip: ranks (0 to 1) of the truth, standardised errors, and quality."""

    ranks: np.ndarray
    errors: np.ndarray
    quality: int


class Scene(NamedTuple):
    """Where a clip lies, and its wave."""

    frequency: float
    turn: float
    pixel: float
    side: int
    near: float
    altitude: float


def draw_scene(rng: np.random.Generator) -> Scene:
    """Draw what is not estimated, and f."""
    frequency = float(np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
    pixel = 1 / frequency / rng.uniform(16, 60)
    side = round(rng.uniform(6, 12) / frequency / pixel)
    near = float(np.exp(rng.uniform(np.log(5), np.log(50))))
    return Scene(frequency, rng.uniform(-1.0, 1.0), pixel, side, near, rng.uniform(3, 10))


def geometry_of(scene: Scene, rng: np.random.Generator) -> Geometry:
    """Return the model's geometry with an error of its law and profile drawn."""
    along = scene.frequency * np.cos(scene.turn)
    prior = Prior.natural((0.05, 5.0), (0.0, 0.5))
    return Geometry(
        along=along,
        across=scene.frequency * np.sin(scene.turn),
        range_middle=scene.near + 0.5 * scene.side * scene.pixel,
        altitude_middle=scene.altitude,
        altitude_sd=ALTITUDE_SD,
        expected_blur=OWN_WIDTH**0.5 * scene.pixel * scene.frequency,
        wave_sd=FOUND_TO / (scene.side * scene.pixel),
        phase_sd=ANY_PHASE,
        bent=False,
        published=False,
        shadow=LINE_OF_SIGHT,
        law_error=np.array(LAW_ERROR) * rng.standard_normal(LAW_KNOTS.size),
        third_harmonic=np.array(THIRD_HARMONIC) * rng.standard_normal(2),
        fixed=np.full(4, np.nan),
        height_mean=0.0,
        height_sd=np.inf,
        height_least=0.0,
        height_most=0.5,
        steepness_middle=prior.steepness[0],
        steepness_sd=prior.steepness[1],
    )


def draw_parameters(geometry: Geometry, frequency: float, rng: np.random.Generator) -> Parameters:
    """Draw from the prior of sampling coordinates, phase flat."""
    trend = rng.standard_normal(len(TREND))
    while True:
        z = np.append(rng.standard_normal(COORDINATES - trend.size), trend)
        z[:2] = 0.0, rng.uniform(-np.pi, np.pi)
        steepness = geometry.steepness_middle * np.exp(geometry.steepness_sd * rng.normal())
        height = 0.5 * steepness / frequency
        z[HEIGHT] = 0.0
        for _ in range(30):  # the coordinate at which A_H is this
            z[HEIGHT] += np.log(height / min(parameters_at(z, geometry).height, 1e9))
        ripple = parameters_at(z, geometry)
        possible = abs(ripple.peakedness) < 0.4 and abs(ripple.asymmetry) < 0.4
        least, most = LAW_BOUNDS
        possible &= least < ripple.exponent < most and least < ripple.concentration < most
        # of a law that darkens with slope no height has this contrast
        possible &= bool(np.isclose(ripple.height, height))
        if possible and 2 * np.pi * frequency * height < 1:
            return ripple


def simulate(
    scene: Scene, geometry: Geometry, ripple: Parameters, rng: np.random.Generator
) -> Clip:
    """Draw a clip's pixels from the model."""
    n = scene.side
    x = scene.pixel * (np.arange(n) - 0.5 * (n - 1)) + np.zeros((n, 1))
    y = scene.pixel * (np.arange(n)[::-1, None] - 0.5 * (n - 1)) + np.zeros((1, n))
    reach = geometry.range_middle + x[0]
    altitude = np.full(n, scene.altitude)
    one = np.ones((n, BINS))
    every = Histogram(
        one,
        one,
        0 * one,
        0 * one,
        x[0],
        reach,
        altitude,
        np.ones(n),
        np.zeros(n, int),
        one[None],
        one,
        one[0],
        1.0,
        one[0],
        one,
    )
    pulses = np.empty((n, BINS))
    fill_pulses(ripple, every, geometry, pulses)
    place = geometry.along * x - geometry.across * y + ripple.phase / (2 * np.pi)
    # errors of intensity in a wavelength of range and a part of phase, of place in all ranges
    group = ((reach - reach[0]) * geometry.along).astype(int)
    cell = (place % 1 * ERROR_CELLS).astype(int)
    shape = group.max() + 1, ERROR_CELLS
    level = np.exp(MODEL_ERROR * rng.standard_normal(shape))[group[None, :], cell]
    shift = MODEL_SHIFT * scene.pixel * geometry.along * rng.standard_normal(ERROR_CELLS)
    bins = (place + shift[cell]) * BINS - 0.5
    low = np.floor(bins).astype(int)
    column = np.broadcast_to(np.arange(n), low.shape)
    before, after = pulses[column, low % BINS], pulses[column, (low + 1) % BINS]
    mean = (before + (bins - low) * (after - before)) * level
    mean += DARK_ERROR[0] * np.abs(rng.standard_normal(shape))[group[None, :], cell]
    mean += ripple.noise * (reach / geometry.range_middle) ** ripple.noise_slope
    wide = np.broadcast_to(reach, mean.shape)
    look = np.full(mean.shape, 90.0)
    amplitude = np.sqrt(mean * rng.exponential(size=mean.shape))
    told = np.full(mean.shape, scene.altitude)
    return Clip(amplitude, x, y, wide, told, look, scene.pixel, ALTITUDE_SD)


def draw(seed: int) -> tuple[Scene, Parameters, Clip]:
    """Draw a scene, its ripples and the clip."""
    rng = np.random.default_rng([seed, 58])
    scene = draw_scene(rng)
    geometry = geometry_of(scene, rng)
    ripple = draw_parameters(geometry, scene.frequency, rng)
    return scene, ripple, simulate(scene, geometry, ripple, rng)


def one(seed: int) -> Case:
    """Draw a clip, estimate it and rank its truth."""
    scene, ripple, clip = draw(seed)
    posterior = estimate(clip, RippleSettings(), rng=seed)
    if not posterior.sampled:
        return Case(np.full(3, np.nan), np.full(3, np.nan), int(posterior.quality))
    azimuth = 90 + np.degrees(scene.turn)
    truth = scene.frequency, ripple.height, azimuth
    draws = [posterior.draws[name].values.ravel() for name in NAMES]
    draws[2] = azimuth + (draws[2] - azimuth + 90) % 180 - 90
    ranks = [np.mean(d < t) for d, t in zip(draws, truth, strict=True)]
    errors = [(d.mean() - t) / d.std() for d, t in zip(draws, truth, strict=True)]
    return Case(np.array(ranks), np.array(errors), int(posterior.quality))


def distance(ranks: np.ndarray) -> float:
    """Kolmogorov's distance of ranks from uniform."""
    return float(stats.kstest(ranks, "uniform").statistic)


def coverage(ranks: np.ndarray) -> list[float]:
    """Share of ranks in the intervals of LEVELS, %."""
    return [100 * float(np.mean(np.abs(ranks - 0.5) <= level / 2)) for level in LEVELS]


def report(title: str, cases: list[Case]) -> None:
    """Print one row of the table for each parameter."""
    ranks, errors = np.array([c.ranks for c in cases]), np.array([c.errors for c in cases])
    limit = 1.63 / np.sqrt(len(ranks))  # the 99 % point of Kolmogorov's law
    for i, name in enumerate(NAMES):
        cover = coverage(ranks[:, i])
        spread = np.sqrt(np.median(errors[:, i] ** 2)) / 0.6745
        print(
            f"{title:14s} {name:10s} {len(ranks):5d}  {cover[0]:5.1f} {cover[1]:5.1f} "
            f"{cover[2]:5.1f}   {distance(ranks[:, i]):.3f} ({limit:.3f})   {spread:5.2f}",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print(f"{'':25s} clips   50 %  90 %  95 %   ECDF (99 % band)   robust sd of z")
    with ProcessPoolExecutor(options.workers) as pool:
        cases = list(pool.map(one, range(options.draws), chunksize=5))
    sampled = [c for c in cases if np.isfinite(c.ranks).all()]
    report("found", sampled)
    report("good", [c for c in sampled if c.quality == Quality.GOOD])
    counts = np.bincount([c.quality for c in cases], minlength=8)
    print(", ".join(f"{Quality(i).label} {n}" for i, n in enumerate(counts) if n))


if __name__ == "__main__":
    main()
