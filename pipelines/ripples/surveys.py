"""Heights of whole surveys: one scattering law, a few cells with shadow, the rest by contrast.

    python pipelines/ripples/surveys.py [--surveys 6] [--cells 60] [--shadowed 15] [--mixed]
        [--mapped] [--csv FILE] [--cache FOLDER]

Each survey has one scattering law, of the fitted family or outside it, rendered by the coherent
simulator. Ripples cast shadow in its far cells, and not in the others. Every cell is estimated
alone; then the law is estimated from all of them. Prints coverage and error of A_H before and
after, for cells with shadow and without. `--mixed` makes surveys of two sediments: every second
cell of one survey and the others of another, for each pair of surveys; with `--mapped` the second
stage knows which of the two sediments each cell is of, but for one in twenty. With a cache the
looks are estimated once and stored there, so that the second stage can be studied again in seconds.
"""

from __future__ import annotations

import argparse
import csv
import pickle
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from sasmap.passes.fusion import fuse_cells, learn_survey
from sasmap.passes.shared import quantiles_of
from sasmap.passes.summary import Summary, summarise
from sasmap.ripples import Quality, RippleSettings, estimate
from sasmap.simulate import coherent_cell
from sasmap.simulate.laws import PowerLaw

PIXEL = 0.025


def law_of(seed: int) -> Any:
    """Return a survey's law: four by turns and one of the fitted family."""
    rng = np.random.default_rng([seed, 3])
    family = PowerLaw(exponent=rng.uniform(0.5, 3), concentration=rng.uniform(0, 1))
    return ["lambert", "gaussian", "rough", "volume", family][seed % 5]


def draw_cell(rng: np.random.Generator, size: int, shadowed: bool) -> dict[str, Any]:
    """Draw a cell: steeper than the lowest ray, or clearly less steep."""
    while True:
        frequency, height = rng.uniform(4 / (PIXEL * size), 1.2), rng.uniform(0.02, 0.1)
        near, altitude = rng.uniform(6, 40), rng.uniform(3, 9)
        steep = 2 * np.pi * frequency * height / (altitude / (near + 0.5 * PIXEL * size))
        fits = 2 * frequency * height < 0.17
        if fits and (steep > 1.3 if shadowed else 0.15 < steep < 0.6):
            break
    return {
        "frequency": frequency,
        "height": height,
        "azimuth_off_look": rng.uniform(-50, 50),
        "near": near,
        "altitude": altitude,
        "pixel_size": PIXEL,
        "shape": (size, size),
        "profile": rng.choice(["sine", "stokes"]),
        "wander": float(rng.choice([0.0, rng.uniform(0.3, 0.8)])),
        "wander_length": rng.uniform(3, 8),
        "noise": rng.uniform(-30, -20),
        "blur": rng.uniform(0.4, 0.8),
    }


Look = tuple[Summary, dict[str, Any]]


def one(job: tuple[int, int, bool], law: Any, size: int, cache: Path | None) -> Look:
    """Estimate one cell of a survey, or read its estimate from the cache."""
    seed, number, shadowed = job
    kept = cache / f"{seed}-{size}-{number}{'s' * shadowed}.pkl" if cache else None
    if kept is not None and kept.exists():
        look: Look = pickle.loads(kept.read_bytes())
        return look
    rng = np.random.default_rng([seed, number, 4])
    drawn = draw_cell(rng, size, shadowed)
    made = coherent_cell(rng, law=law, **drawn)
    summary = summarise(estimate(made.clip, RippleSettings(), rng=number))
    look = summary, {"height": made.height, "frequency": made.frequency, "shadowed": shadowed}
    if kept is not None:
        kept.write_bytes(pickle.dumps(look))
    return look


def covers(low: float, high: float, truth: float) -> bool:
    """Whether an interval contains the truth."""
    return low <= truth <= high


def describe(title: str, rows: list[dict[str, Any]]) -> None:
    """Print coverage and error before and after the second stage."""
    if not rows:
        return
    parts = [f"{title:34s} {len(rows):4d}"]
    for when in ("alone", "survey"):
        cover = 100 * np.mean([r[f"{when}_covers"] for r in rows])
        error = 100 * np.median([abs(r[f"{when}_mean"] / r["height"] - 1) for r in rows])
        width = np.median([r[f"{when}_width"] / r["height"] for r in rows])
        parts.append(f"{when}: cover {cover:3.0f} %, error {error:5.1f} %, width {width:5.2f}")
    print("   ".join(parts), flush=True)


def looks_of(
    seed: int, cells: int, shadowed: int, size: int, pool: Any, cache: Path | None
) -> list[Look]:
    """Simulate and estimate the cells of one survey."""
    jobs = [(seed, i, i < shadowed) for i in range(cells)]
    return list(pool.map(partial(one, law=law_of(seed), size=size, cache=cache), jobs))


def judge(
    title: str, found: list[Look], seed: int, classes: list[int] | None = None
) -> list[dict[str, Any]]:
    """Estimate the law of a survey from its looks; a row for each good cell."""
    summaries = [[summary] for summary, _ in found]
    survey = learn_survey(summaries, RippleSettings(), seed, classes)
    rows = []
    for (summary, truth), fused in zip(
        found, fuse_cells(summaries, RippleSettings(), survey, classes), strict=True
    ):
        if summary.quality is not Quality.GOOD:
            continue
        row = {"survey": title, **truth}
        for when, known in (("alone", summary), ("survey", fused.final)):
            low, high = known.q05[1], known.q95[1]
            row |= {
                f"{when}_mean": known.mean[1],
                f"{when}_width": high - low,
                f"{when}_covers": covers(low, high, truth["height"]),
            }
        rows.append(row)
    for draws in survey.found:
        quantiles = quantiles_of([p.shared for p in draws])
        share = 100 * np.mean([p.weight for p in draws])
        print(
            f"survey {title}; estimated of {share:.0f} % of the cells n, c:",
            np.round(quantiles["law"], 2).tolist(),
            "spread",
            np.round(quantiles["spread"][1], 2).tolist(),
        )
    describe("  with shadow", [r for r in rows if r["shadowed"]])
    describe("  by contrast", [r for r in rows if not r["shadowed"]])
    return rows


def main() -> None:
    """Print the tables, and write the cells where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--surveys", type=int, default=6)
    parser.add_argument("--first", type=int, default=0, help="seed of the first survey")
    parser.add_argument("--cells", type=int, default=60)
    parser.add_argument("--shadowed", type=int, default=15)
    parser.add_argument("--size", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--mixed", action="store_true", help="two laws in each survey")
    parser.add_argument("--mapped", action="store_true", help="with --mixed: the map tells them")
    parser.add_argument("--csv")
    parser.add_argument("--cache", type=Path)
    options = parser.parse_args()
    if options.cache:
        options.cache.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first, options.first + options.surveys)
    drawn = options.cells, options.shadowed, options.size
    with ProcessPoolExecutor(options.workers) as pool:
        found = {seed: looks_of(seed, *drawn, pool, options.cache) for seed in seeds}
    rows = []
    if options.mixed:
        for first, other in combinations(seeds, 2):
            title = f"{first} with {other}: laws {law_of(first)} and {law_of(other)}"
            both = found[first][::2], found[other][1::2]
            classes = [
                1 + k if i % 20 else 2 - k for k, one in enumerate(both) for i in range(len(one))
            ]
            rows += judge(title, both[0] + both[1], first, classes if options.mapped else None)
    else:
        for seed in seeds:
            rows += judge(f"{seed}: law {law_of(seed)}", found[seed], seed)
    describe("all with shadow", [r for r in rows if r["shadowed"]])
    describe("all by contrast", [r for r in rows if not r["shadowed"]])
    if options.csv:
        with open(options.csv, "w", newline="") as stream:
            writer = csv.DictWriter(stream, sorted({name for row in rows for name in row}))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
