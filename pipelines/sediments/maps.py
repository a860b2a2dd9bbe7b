"""Sediment maps: number of classes, agreement, boundary errors, other methods, G's experiment.

    python pipelines/sediments/maps.py [--scenes 20] [--images 100]

Classes: scenes of one to five sediments seen by two looks with a gain step and range trends.
Boundaries: wavy, closed and three-class scenes of 0.12 to 0.17 nats a pixel; mean distance to the
true boundary of the class map's lines, of the refined ones, and of other methods on the same log
likelihood ratios (two classes); share of nodes within their stated 95 % interval. G's experiment: a
boundary between K textures, row by row (mean error in pixels along the row) and by nodes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import ruptures
from scipy import stats
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from skimage.segmentation import felzenszwalb, morphological_chan_vese, random_walker, watershed

from sasmap.sediments import k_distribution
from sasmap.sediments.boundaries import (
    best_positions,
    filtered_joint,
    row_maxima,
    window_likelihoods,
    window_ratios,
)
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.mapping import refine_map, traced
from sasmap.sediments.nodes import refine_boundary
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.trends import AmplitudeGrid

LEVELS, NUS = (1.0, 2.2, 0.4, 4.5, 1.1), (50.0, 4.0, 20.0, 1.0, 1.0)
WEAK = (1.0, 1.75, 3.1)


def rand_index(first: np.ndarray, second: np.ndarray) -> float:
    """Compute the adjusted Rand index."""
    table = np.zeros((first.max() + 1, second.max() + 1))
    np.add.at(table, (first.ravel(), second.ravel()), 1)

    def pairs(v: np.ndarray) -> float:
        return float((v * (v - 1) / 2).sum())

    both, rows, columns = pairs(table), pairs(table.sum(axis=1)), pairs(table.sum(axis=0))
    chance = rows * columns / (table.sum() * (table.sum() - 1) / 2)
    most = 0.5 * (rows + columns)
    return 1.0 if most == chance else (both - chance) / (most - chance)


def patches(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Wavy patches of some sediments."""
    if count == 1:
        return np.zeros((size, size), int)
    y, x = np.indices((size, size))
    x = x + 12 * np.sin(y / 37 + rng.uniform(0, 6))
    y = y + 12 * np.sin(x / 41 + rng.uniform(0, 6))
    seeds = rng.uniform(0, size, (2 * count, 2))
    away = [(x - a) ** 2 + (y - b) ** 2 for a, b in seeds]
    return np.asarray(np.argmin(away, axis=0) % count)


def classes_of(seed: int, count: int, size: int = 384) -> tuple[int, float, float]:
    """Classes found in a scene, agreement with the truth, seconds."""
    rng = np.random.default_rng([seed, count])
    truth = patches(rng, count, size)
    x = np.broadcast_to(np.arange(size), truth.shape)
    looks = []
    for k in range(2):
        amplitude = textured(truth, LEVELS, NUS, rng)
        reach = 20 + 0.05 * x if k == 0 else 45 - 0.05 * x
        looks.append(AmplitudeGrid((1.0, 1.7)[k] * amplitude * (reach / 30) ** -0.4, reach))
    start = time.perf_counter()
    found = find_classes(looks)
    label = class_map(log_likelihoods(looks, found)).label
    seconds = time.perf_counter() - start
    return len(found.laws), rand_index(truth, label.astype(int)), seconds


def textured(
    truth: np.ndarray, levels: tuple[float, ...], nus: tuple[float, ...], rng: np.random.Generator
) -> np.ndarray:
    """K speckle of each class's level and texture."""
    amplitude = np.empty(truth.shape)
    for k in np.unique(truth):
        here = truth == k
        sample = k_distribution.rvs(nus[k], size=here.sum(), random_state=rng)
        amplitude[here] = np.sqrt(levels[k]) * sample
    return amplitude


def correlated_of(seed: int, size: int = 512) -> tuple[int, float, int]:
    """Sediments of one histogram and different correlation: agreement, classes found, and there.

    K speckle of one law; the texture is white, or correlated over 3 or 8 pixels (a Gaussian field
    that is turned into a gamma one, value by value).
    """
    rng = np.random.default_rng([seed, 9])
    count = 2 + seed % 2
    truth = patches(rng, count, size)
    nu = rng.uniform(1.0, 3.0)
    widths = rng.permutation([0.0, 3.0, 8.0])[:count]
    texture = np.empty(truth.shape)
    for k, width in enumerate(widths):
        field = rng.normal(size=truth.shape)
        field = gaussian_filter(field, width, mode="wrap") if width else field
        gamma = stats.gamma.ppf(stats.norm.cdf(field / field.std()), nu) / nu
        texture[truth == k] = gamma[truth == k]
    speckle = rng.normal(size=(2, *truth.shape))
    amplitude = np.sqrt(np.maximum(texture, 1e-9) / 2) * np.hypot(*speckle)
    looks = [AmplitudeGrid(amplitude, np.full(truth.shape, 5.0))]
    found = find_classes(looks)
    label = class_map(log_likelihoods(looks, found)).label
    return count, rand_index(truth, label.astype(int)), len(found.laws)


def edges_of(truth: np.ndarray) -> cKDTree:
    """Points where pixels of two classes meet."""
    across = np.argwhere(truth[:, 1:] != truth[:, :-1]) + np.array([0, 0.5])
    down = np.argwhere(truth[1:] != truth[:-1]) + np.array([0.5, 0])
    return cKDTree(np.vstack([across, down]))


def boundary_scene(kind: str, rng: np.random.Generator, size: int = 400) -> np.ndarray:
    """Classes of a wavy, closed or three-class scene."""
    y, x = np.indices((size, size))
    edge = size / 2 + 15 * np.sin(y / 30 + rng.uniform(0, 6))
    if kind == "wavy":
        return np.asarray((x > edge).astype(int))
    if kind == "closed":
        turn = np.arctan2(y - 200, x - 200)
        return np.asarray((np.hypot(x - 200, y - 200) < 110 + 12 * np.sin(4 * turn)).astype(int))
    return np.asarray(np.where(x < edge - 40, 0, np.where(y > 190 + 10 * np.sin(x / 25), 1, 2)))


def peers() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Segmentations into two of the same log likelihood ratio."""

    def seeds(ratio: np.ndarray) -> np.ndarray:
        smooth = uniform_filter(ratio, 33)
        low, high = np.quantile(smooth, [0.2, 0.8])
        return np.where(smooth < low, 1, np.where(smooth > high, 2, 0))

    def walked(ratio: np.ndarray) -> np.ndarray:
        return np.asarray(random_walker(ratio, seeds(ratio), beta=20, mode="cg_j", tol=1e-2) == 2)

    def flooded(ratio: np.ndarray) -> np.ndarray:
        smooth = uniform_filter(ratio, 9)
        slope = np.hypot(*np.gradient(smooth))
        return np.asarray(watershed(slope, seeds(ratio)) == 2)

    def contoured(ratio: np.ndarray) -> np.ndarray:
        first = uniform_filter(ratio, 33) > 0
        return np.asarray(morphological_chan_vese(ratio, 60, init_level_set=first, smoothing=3) > 0)

    def joined(scale: float, ratio: np.ndarray) -> np.ndarray:
        smooth = uniform_filter(ratio, 9)
        parts = felzenszwalb(smooth, scale=scale, sigma=2, min_size=400, channel_axis=None)
        total = np.bincount(parts.ravel(), ratio.ravel())
        return np.asarray(total[parts] > 0)

    return {
        "windows of 17": lambda ratio: uniform_filter(ratio, 17) > 0,
        "windows of 33": lambda ratio: uniform_filter(ratio, 33) > 0,
        "Chan-Vese": contoured,
        "random walker": walked,
        "watershed": flooded,
        **{f"felzenszwalb {scale}": partial(joined, scale) for scale in (30, 100, 300)},
    }


def boundaries_of(seed: int, kind: str) -> dict[str, tuple[float, float]]:
    """Mean distance to the true boundary, or share, and seconds, by method."""
    rng = np.random.default_rng([seed, 3])
    truth = boundary_scene(kind, rng)
    tree = edges_of(truth)
    amplitude = textured(truth, WEAK, (50.0,) * 3, rng)
    # range runs across the first boundary: one that follows range would be taken for gain
    reach = 20 + 0.05 * np.broadcast_to(np.arange(len(truth))[:, None], truth.shape)
    looks = [AmplitudeGrid(amplitude, reach)]
    start = time.perf_counter()
    likelihood = log_likelihoods(looks, find_classes(looks))
    found = class_map(likelihood)
    middle = time.perf_counter()
    refined = refine_map(found.label, likelihood)
    end = time.perf_counter()
    if not refined.lines:
        return {}
    points = np.vstack([line.boundary.points for line in refined.lines])
    sd = np.concatenate([line.boundary.sd for line in refined.lines])
    away = tree.query(points)[0]
    before = np.vstack([p for _, _, p, _ in traced(found.label)])
    result = {
        "class map": (float(tree.query(before)[0].mean()), middle - start),
        "refined": (float(away.mean()), end - middle),
        "within 95 %": (float(np.mean(away < 1.96 * sd + 0.25)), 0.0),
    }
    if kind != "three" and len(likelihood) == 2:
        ratio = (likelihood[1] - likelihood[0]).astype(float)
        for name, method in peers().items():
            start = time.perf_counter()
            mask = method(ratio)
            seconds = time.perf_counter() - start
            lines = find_contours(np.asarray(mask, float), 0.5)
            if lines:
                result[name] = (float(tree.query(np.vstack(lines))[0].mean()), seconds)
    return result


def rows_of(seed: int, rows: int = 200, columns: int = 300) -> list[float]:
    """Mean errors of G's ways and of nodes on one image."""
    rng = np.random.default_rng([seed, 4])
    edge = columns / 2 + 12 * np.sin(np.arange(rows) / 40 + rng.uniform(0, 6))
    truth = (np.arange(columns) + 0.5 > edge[:, None]).astype(int)
    amplitude = textured(truth, (1.0, 1.56), (1.0, 5.0), rng)
    left = k_distribution.logpdf(amplitude, 1.0)
    right = k_distribution.logpdf(amplitude, 5.0, scale=1.25)
    ratio = window_ratios(left, right)
    ways = [
        row_maxima(window_likelihoods(left, right).joint),
        row_maxima(ratio.joint),
        row_maxima(filtered_joint(ratio)),
        best_positions(left, right),
    ]
    guess = np.column_stack([np.arange(rows)[::-1], np.full(rows, columns / 2)])
    changes = [breakpoint_of(row) for row in left - right]
    nodes = refine_boundary(guess, left - right, reach=25).points[::-1]
    followed = np.interp(np.arange(rows), nodes[:, 0], nodes[:, 1]) + 0.5
    return [float(np.abs(way - edge).mean()) for way in [*ways, changes, followed]]


def breakpoint_of(row: np.ndarray) -> int:
    """Position at which ruptures splits a row of log likelihood ratios."""
    return int(ruptures.Binseg(model="l2", min_size=5, jump=1).fit(row).predict(n_bkps=1)[0])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        print("sediments | right number | adjusted Rand index: mean, least | s a scene")
        for count in range(1, 6):
            run = partial(classes_of, count=count)
            found = list(pool.map(run, range(options.scenes)))
            right = 100 * np.mean([n == count for n, _, _ in found])
            index = [i for _, i, _ in found]
            seconds = np.median([s for _, _, s in found])
            head = f"{count:9d} | {right:10.0f} % | {np.mean(index):.3f} {min(index):.3f}"
            print(f"{head} | {seconds:.2f}", flush=True)
        found = list(pool.map(correlated_of, range(options.scenes)))
        right = 100 * np.mean([count == n for count, _, n in found])
        index = [i for _, i, _ in found]
        print(f"one histogram, different correlation: {right:.0f} % right, ", end="")
        print(f"adjusted Rand index {np.mean(index):.3f}, least {min(index):.3f}", flush=True)
        print("\nmean distance to the true boundary, pixels (s)")
        for kind in ("wavy", "closed", "three"):
            found = list(pool.map(partial(boundaries_of, kind=kind), range(options.scenes)))
            names = list(dict.fromkeys(name for f in found for name in f))
            parts = [
                f"{name} {np.mean([f[name][0] for f in found if name in f]):.2f}"
                f" ({np.median([f[name][1] for f in found if name in f]):.2f})"
                for name in names
            ]
            print(f"  {kind}: " + ", ".join(parts), flush=True)
        errors = np.array(list(pool.map(rows_of, range(options.images))))
        names = ("Z", "Z'", "filtered Z'", "whole rows", "ruptures", "nodes")
        print("\nG's experiment, mean error along rows, pixels: ", end="")
        print(", ".join(f"{n} {e:.2f}" for n, e in zip(names, errors.mean(axis=0), strict=True)))


if __name__ == "__main__":
    main()
