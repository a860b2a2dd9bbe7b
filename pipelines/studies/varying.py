"""Beds whose waves are not alike within a cell: heights that vary, and an edge of the field.

    python pipelines/studies/varying.py [--cells 20] [--first 0] [--workers 2]

Cells of 500 x 500 pixels of 2.5 cm by the coherent simulator: f 0.6 to 1.4 cycles/m, steepness 0.05
to 0.15, looks up to 45 degrees off the crest normal, 5 to 32 m of range, five scattering laws. The
log of the height of single waves has a standard deviation of 0, 0.1 or 0.2; or waves come in groups
of 4 to 7, down to 0.3 of the highest; or heights double across the look over the cell; or all are
alike and the ripples end within the cell, over a tenth of a metre. The truth is the mean height
over the rippled floor, and f of the wave.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np
from heightfields import grid_around, image
from numpy.typing import NDArray

from sasmap.ripples import Clip, Quality, RippleSettings, estimate

SIZE, PIXEL = 500, 0.025
LAWS = (
    "lambert", "gaussian", "rough", {"exponent": 1.0}, {"exponent": 1.5, "concentration": 0.4},
)  # fmt: skip
# Spread of the log of heights of single waves, and what else varies.
KINDS = {
    "all alike": (0.0, ""),
    "heights vary by 10 %": (0.1, ""),
    "heights vary by 20 %": (0.2, ""),
    "waves in groups": (0.0, "groups"),
    "heights double across the look": (0.0, "ramp"),
    "field ends in the cell": (0.0, "end"),
}


class Row(NamedTuple):
    """Result of a cell: whether it is good; of f and A_H rank of the truth, error and width."""

    kind: str
    good: bool
    rank: tuple[float, float]
    error: tuple[float, float]
    width: tuple[float, float]


def draw(seed: int, kind: str) -> tuple[Clip, float, float]:
    """Draw a cell: its clip, f and mean A_H."""
    spread, also = KINDS[kind]
    rng = np.random.default_rng([seed, 77])
    grid = grid_around(SIZE, PIXEL)
    frequency, turn = rng.uniform(0.6, 1.4), np.radians(90 + rng.uniform(-45, 45))
    height = rng.uniform(0.05, 0.15) / frequency / 2
    peaked = rng.uniform(0, 0.15)
    x, y = np.meshgrid(grid.x, grid.y)
    cycles = frequency * (x * np.sin(turn) + y * np.cos(turn)) + 100
    own = height * np.exp(spread * rng.normal(0, 1, 400))
    number = np.floor(cycles).astype(int)
    part = cycles - number
    smooth = part * part * (3 - 2 * part)
    heights = own[number] * (1 - smooth) + own[number + 1] * smooth
    if also == "groups":
        turn_of_group = np.pi * cycles / rng.uniform(4, 7) + rng.uniform(0, 6)
        heights = heights * (0.3 + 0.7 * np.cos(turn_of_group) ** 2)
    elif also == "ramp":
        heights = heights * 2 ** (rng.choice([-1, 1]) * (y / (SIZE * PIXEL) - 0.5))
    sonar = {"near": rng.uniform(5, 32), "altitude": rng.uniform(3, 8), "law": LAWS[seed % 5]}
    rippled = np.ones(x.shape)
    if also == "end":
        share, across = rng.uniform(0.35, 0.75), seed % 2
        rippled = 1 / (1 + np.exp(((y if across else x) - share * SIZE * PIXEL) / 0.1))
    bed = rippled * heights * (np.sin(2 * np.pi * cycles) - peaked * np.cos(4 * np.pi * cycles))
    side = SIZE * PIXEL
    inside = (x >= 0) & (x < side) & (y >= 0) & (y < side) & (rippled > 0.5)
    sonar |= {"noise": -25.0, "range_flattened": False, "blur": 0.5}
    return image(rng, grid, bed - bed.mean(), SIZE, **sonar), frequency, heights[inside].mean()


def one(job: tuple[int, str]) -> Row | None:
    """Estimate a cell; None where no ripples are found."""
    seed, kind = job
    clip, *truth = draw(seed, kind)
    posterior = estimate(clip, RippleSettings(), rng=seed)
    if not posterior.sampled:
        return None
    draws = [posterior.draws[name].values.ravel() for name in ("frequency", "height")]
    rank = tuple(float((d < t).mean()) for d, t in zip(draws, truth, strict=True))
    error = tuple(float(d.mean() / t - 1) for d, t in zip(draws, truth, strict=True))
    ends = (np.quantile(d, (0.05, 0.95)) for d in draws)
    width = tuple(float(np.ptp(e) / t) for e, t in zip(ends, truth, strict=True))
    return Row(kind, posterior.quality is Quality.GOOD, rank, error, width)


def column(rows: list[Row], name: str, i: int) -> NDArray[np.float64]:
    """Of f (0) or A_H (1)."""
    return np.array([getattr(row, name)[i] for row in rows])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=20, help="of each kind")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    print(
        "| bed | cells | good | f in its 90 % interval | error | A_H in its 90 % interval |", end=""
    )
    print(" error | mean error | width |\n|---|---|---|---|---|---|---|---|---|")
    for kind in KINDS:
        jobs = [(seed, kind) for seed in range(options.first, options.first + options.cells)]
        with ProcessPoolExecutor(options.workers) as pool:
            found = [row for row in pool.map(one, jobs) if row is not None]
        good = [row for row in found if row.good]
        inside = [np.mean(np.abs(column(good, "rank", i) - 0.5) < 0.45) for i in range(2)]
        error = [np.median(np.abs(column(good, "error", i))) for i in range(2)]
        height = column(good, "error", 1).mean(), np.median(column(good, "width", 1))
        print(
            f"| {kind} | {options.cells} | {len(good)} | {inside[0]:.0%} | {error[0]:.2%} | "
            f"{inside[1]:.0%} | {error[1]:.1%} | {height[0]:+.0%} | {height[1]:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
