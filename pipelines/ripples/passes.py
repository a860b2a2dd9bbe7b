"""Several passes over a cell: table 4 of Zare and Cobb, four headings, contradictions, rescue.

    python pipelines/ripples/passes.py [--runs 50] [--cells 400] [--published]

Table 4: a near pass (12.2 to 24.4 m), then a far one (24.4 to 36.6 m), over f = 0.6, A_H = 0.07 m.
Headings: each cell has ripples of its own, seen by four passes at four headings and ranges;
contradictions give one pass another sea floor, whose f is 20 % off. Rescue: a near pass that casts
no shadow and tells A_H badly beside a far one that casts some, in both orders.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import permutations
from typing import NamedTuple

import numpy as np
from zare_cobb_tables import simulate_clip as table_clip

from sasmap.ripples import Clip, Quality, RippleSettings, estimate
from sasmap.ripples.fusion import FusedCell, fuse, next_prior
from sasmap.ripples.summary import Summary, summarise
from sasmap.simulate import Scene, simulate_clip

TRUTH = (0.6, 0.07)
RANGES = ((12.2, 24.4), (24.4, 36.6))
PRINTED = ((7.8e-5, 0.68), (3.4e-5, 0.024))  # means of five runs
ORIGIN = (500000.0, 3300000.0)
HEADINGS = (0.0, 60.0, 115.0, 300.0)


def table_run(seed: int, method: str) -> np.ndarray:
    """Errors of f and A_H and widths of their 90 % intervals, after each pass (2, 4)."""
    bounds = {"frequency": (0, 1), "height": (0, 1)} if method == "zare-cobb" else {}
    settings = RippleSettings(method=method, shadow="crest", **bounds)
    summaries: list[Summary | None] = []
    for k, (near, far) in enumerate(RANGES):
        clip = table_clip(near, far, *TRUTH, "crest", 2 * seed + k)
        prior = next_prior(summaries, settings)
        summaries.append(summarise(estimate(clip, settings, rng=2 * seed + k, prior=prior)))
    known = fuse(summaries, settings).posteriors
    return np.array(
        [[*np.subtract(k.mean, TRUTH), *np.subtract(k.q95, k.q05)] for k in known], float
    )


def table_four(runs: int, pool: ProcessPoolExecutor, methods: list[str]) -> None:
    """Print table 4."""
    print("table 4: mean squared errors (printed), share of runs whose 90 % interval narrowed")
    for method in methods:
        found = np.array(list(pool.map(partial(table_run, method=method), range(runs))))
        for k in range(2):
            f, height = (found[:, k, :2] ** 2).mean(axis=0)
            narrower = (found[:, k, 2:] < found[:, 0, 2:]).mean(axis=0)
            share = "" if k == 0 else f"   narrower {narrower[0]:.2f} {narrower[1]:.2f}"
            print(
                f"  {method:9s} after pass {k + 1}: f {f:.1e} ({PRINTED[k][0]:.0e})  "
                f"A_H {height:.1e} ({PRINTED[k][1]:.0e}){share}",
                flush=True,
            )


class Cell(NamedTuple):
    """What four passes came to: true values, each pass's summary, and one of another sea floor."""

    truth: tuple[float, float, float]
    summaries: list[Summary]
    other: Summary


def scene_of(seed: int, factor: float = 1.0) -> Scene:
    """Draw a sea floor and four passes."""
    rng = np.random.default_rng([seed, 4])
    pixel, side = 0.06, 180
    frequency = rng.uniform(0.6, 1.4)
    patch = {
        "frequency": factor * frequency,
        "height": rng.uniform(0.12, 0.35) / (2 * np.pi * frequency),
        "azimuth": rng.uniform(0, 180),
        "phase": rng.uniform(0, 6.28),
    }
    passes = [
        {
            "name": f"p{i}",
            "heading": heading,
            "distance": rng.uniform(18, 60),
            "altitude": rng.uniform(4, 10),
            "dtype": "float32",
        }
        for i, heading in enumerate(HEADINGS)
    ]
    return Scene(
        name="headings",
        seed=seed,
        origin=ORIGIN,
        size=(side * pixel, side * pixel),
        pixel_size=pixel,
        sediments=[{"name": "sand"}],
        ripples=[patch],
        passes=passes,
    )


def cell(seed: int) -> Cell:
    """Simulate and estimate a cell's passes."""
    settings, scene = RippleSettings(), scene_of(seed)
    summaries = []
    for i in range(len(HEADINGS)):
        made = simulate_clip(scene, np.random.default_rng([seed, i]), i)
        summaries.append(summarise(estimate(made.clip, settings, rng=[seed, i])))
    off = simulate_clip(scene_of(seed, 1.2), np.random.default_rng([seed, 9]), 1)
    other = summarise(estimate(off.clip, settings, rng=[seed, 9]))
    return Cell((made.frequency, made.height, made.azimuth), summaries, other)


def headings(cells: list[Cell]) -> None:
    """Print how knowledge grows over four passes, coverage and the effect of order."""
    settings = RippleSettings()
    chains = [fuse(c.summaries, settings) for c in cells]
    honest = [c.quality == Quality.CONTRADICTION for c in chains]
    print(f"four headings, {len(cells)} cells: rms error of f (%), A_H (%), azimuth (degrees)")
    for k in range(len(HEADINGS)):
        pairs = [
            (c.truth, chain.posteriors[k])
            for c, chain in zip(cells, chains, strict=True)
            if np.isfinite(chain.posteriors[k].mean[0])
        ]
        errors = np.array([_errors(truth, known) for truth, known in pairs])
        inside = np.array(
            [[known.q05[i] <= truth[i] <= known.q95[i] for i in range(2)] for truth, known in pairs]
        )
        rms = np.sqrt(np.mean(errors**2, axis=0))
        middle = np.median(np.abs(errors), axis=0)
        cover = 100 * inside.mean(axis=0)
        print(
            f"  after {k + 1}: rms {rms[0]:.3f} {rms[1]:.2f} {rms[2]:.3f}   "
            f"median {middle[0]:.3f} {middle[1]:.2f} {middle[2]:.3f}   "
            f"90 % intervals cover {cover[0]:.0f} {cover[1]:.0f}   ({len(pairs)} cells)"
        )
    shifts = [_shift(c, settings) for c in cells]
    print(f"  order: means move by {max(shifts):.1e} posterior sd at most")
    print(f"  honest cells flagged as contradiction: {100 * np.mean(honest):.1f} %")
    flagged = []
    for c in cells:
        if c.other.quality is Quality.GOOD:
            mixed: list[Summary | None] = [c.summaries[0], c.other, *c.summaries[2:]]
            flagged.append(fuse(mixed, settings).qualities[1] is Quality.CONTRADICTION)
    print(f"  passes of another sea floor (f 20 % off) flagged: {100 * np.mean(flagged):.1f} %")


def _errors(truth: tuple[float, float, float], known: object) -> tuple[float, float, float]:
    turn = (known.azimuth[0] - truth[2] + 90) % 180 - 90
    return 100 * (known.mean[0] / truth[0] - 1), 100 * (known.mean[1] / truth[1] - 1), turn


def _shift(c: Cell, settings: RippleSettings) -> float:
    """Largest move of a mean, in posterior sd, over all orders."""
    finals = [fuse(list(order), settings).final for order in permutations(c.summaries)]
    means = np.array([f.mean for f in finals])
    return float(np.nan_to_num(np.ptp(means, axis=0) / np.array(finals[0].sd)).max())


def rescue_run(seed: int) -> list[FusedCell]:
    """FusedCell a near pass without shadow and a far one with some, in both orders."""
    settings = RippleSettings(shadow="crest")
    clips: list[Clip] = [
        table_clip(near, far, *TRUTH, "crest", 1000 + 2 * seed + i)
        for i, (near, far) in enumerate(((1.2, 13.4), (24.4, 36.6)))
    ]
    near, far = (summarise(estimate(c, settings, rng=seed)) for c in clips)
    return [fuse(looks, settings) for looks in ([near, far], [far, near])]


def rescue(runs: int, pool: ProcessPoolExecutor) -> None:
    """Print what the second pass makes of A_H."""
    found = list(pool.map(rescue_run, range(runs)))
    print("rescue: A_H, rms error and sd (m) after each pass")
    for i, name in enumerate(("near, then far", "far, then near")):
        for k in range(2):
            error = np.array([c[i].posteriors[k].mean[1] - TRUTH[1] for c in found])
            sd = np.median([c[i].posteriors[k].sd[1] for c in found])
            print(f"  {name:15s} after {k + 1}: {np.sqrt((error**2).mean()):.1e}  {sd:.1e}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--cells", type=int, default=400)
    parser.add_argument("--published", action="store_true", help="the published sampler as well")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    methods = ["default", "zare-cobb"] if options.published else ["default"]
    with ProcessPoolExecutor(options.workers) as pool:
        table_four(options.runs, pool, methods)
        rescue(max(options.runs // 5, 2), pool)
        headings(list(pool.map(cell, range(options.cells), chunksize=4)))


if __name__ == "__main__":
    main()
