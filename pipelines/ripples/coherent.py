"""Heights on sea floors of the coherent simulator, with laws outside the estimator's family.

    python pipelines/ripples/coherent.py [--cells 300] [--workers 2] [--csv FILE]

Draws cells of every kind (five scattering laws, three profiles, straight, wandering and forked
crests, ranges 4 to 45 m, altitudes 3 to 10 m, A_H 0.02 to 0.1 m, looks up to 60 degrees off the
crest normal, images as received and with the range trend removed), renders each with the coherent
simulator, estimates it with default settings and prints coverage and errors of f and A_H.
"""

from __future__ import annotations

import argparse
import csv
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from sasmap.ripples import Quality, RippleSettings, estimate
from sasmap.simulate import coherent_cell
from sasmap.simulate.laws import PowerLaw

STEEPEST = 0.17  # crest to trough over wavelength of the steepest ripples that are drawn


def draw_scene(rng: np.random.Generator, size: int) -> dict[str, Any]:
    """Draw a cell: arguments of :func:`sasmap.simulate.coherent_cell`."""
    height = rng.uniform(0.02, 0.1)
    extent = 0.025 * size
    frequency = rng.uniform(4.0 / extent, min(2.0, 0.5 * STEEPEST / height))
    laws = [
        "lambert",
        "gaussian",
        PowerLaw(exponent=rng.uniform(0.5, 3), concentration=rng.uniform(0, 1)),
        "rough",
        "volume",
    ]
    crests = rng.choice(["straight", "wander", "forks"])
    return {
        "frequency": frequency,
        "height": height,
        "azimuth_off_look": rng.uniform(-60, 60),
        "near": rng.uniform(4, 45),
        "altitude": rng.uniform(3, 10),
        "pixel_size": 0.025,
        "shape": (size, size),
        "law": laws[rng.integers(len(laws))],
        "profile": rng.choice(["sine", "stokes", "asymmetric"]),
        "wander": 0.0 if crests == "straight" else rng.uniform(0.3, 1.0),
        "wander_length": rng.uniform(3, 8),
        "forks": int(rng.integers(1, 3)) if crests == "forks" else 0,
        "noise": rng.uniform(-30, -18),
        "range_flattened": bool(rng.random() < 0.5),
        "blur": rng.uniform(0.4, 0.8),
    }


def one(seed: int, size: int, settings: RippleSettings) -> dict[str, Any]:
    """Estimate one cell; a row of the table."""
    rng = np.random.default_rng([seed, 1701])
    scene = draw_scene(rng, size)
    made = coherent_cell(rng, **scene)
    start = time.perf_counter()
    posterior = estimate(made.clip, settings, rng=seed)
    seconds = time.perf_counter() - start
    length = 0.025 * size
    row = {
        "seed": seed,
        **{k: v for k, v in scene.items() if k not in ("shape", "pixel_size", "law")},
        "law": scene["law"] if isinstance(scene["law"], str) else "family",
        "waves": made.frequency * length,
        "quality": int(posterior.quality),
        "probability": posterior.probability,
        "seconds": seconds,
        "true_f": made.frequency,
        "true_height": made.height,
    }
    if posterior.sampled:
        for name, truth in (("frequency", made.frequency), ("height", made.height)):
            draws = posterior.draws[name].values.ravel()
            row |= {
                f"{name}_mean": draws.mean(),
                f"{name}_sd": draws.std(),
                f"{name}_rank": float(np.mean(draws < truth)),
            }
        row |= {
            "straight": posterior.shape.stiffness == np.inf,
            "noise_factor": posterior.shape.noise_factor,
            "exponent": float(posterior.mean.exponent),
        }
    return row


def column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """Values of a column."""
    return np.array([row[name] for row in rows], float)


def describe(title: str, rows: list[dict[str, Any]]) -> None:
    """Print coverage and errors of some good cells."""
    if not rows:
        return
    parts = [f"{title:28s} {len(rows):4d}"]
    for name, truth in (("frequency", "true_f"), ("height", "true_height")):
        rank = column(rows, f"{name}_rank")
        mean, sd, true = (
            column(rows, f"{name}_mean"),
            column(rows, f"{name}_sd"),
            column(rows, truth),
        )
        cover = [100 * np.mean(np.abs(rank - 0.5) < p / 2) for p in (0.5, 0.9)]
        error = np.abs(mean / true - 1)
        sure = sd / mean < 0.1
        far = np.sum(np.abs(mean - true) > 4 * sd + 0.2 * true)
        known = 100 * np.median(error[sure]) if sure.any() else np.nan
        parts.append(
            f"{cover[0]:5.0f} {cover[1]:5.0f} {100 * np.median(error):6.2f} {known:6.2f} "
            f"{sure.sum():4d} {far:3d}"
        )
    print("   ".join(parts), flush=True)


def report(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    good = [r for r in rows if r["quality"] == Quality.GOOD]
    enough = [r for r in rows if r["waves"] >= 4]
    found = [r for r in enough if r["quality"] in (Quality.GOOD, Quality.NOT_CONVERGED)]
    counts = np.bincount([r["quality"] for r in rows], minlength=8)
    print(", ".join(f"{Quality(i).label} {n}" for i, n in enumerate(counts) if n))
    print(f"found {len(found)} of {len(enough)} with four wavelengths or more")
    seconds = column(rows, "seconds")
    late = np.quantile(seconds, 0.9)
    print(f"seconds per cell: median {np.median(seconds):.2f}, 90 % below {late:.2f}")
    names = "50 %  90 %  error  sure    n far"
    print(f"{'':28s}            f: {names}   A_H: {names}")
    describe("all good cells", good)
    middle = float(np.median(column(rows, "near")))
    describe(f"nearer than {middle:.0f} m", [r for r in good if r["near"] < middle])
    describe("farther", [r for r in good if r["near"] >= middle])
    for law in ("lambert", "gaussian", "family", "rough", "volume"):
        describe(law, [r for r in good if r["law"] == law])
    for profile in ("sine", "stokes", "asymmetric"):
        describe(profile, [r for r in good if r["profile"] == profile])
    describe("straight", [r for r in good if r["wander"] == 0])
    describe("wander", [r for r in good if r["wander"] > 0 and r["forks"] == 0])
    describe("forks", [r for r in good if r["forks"] > 0])
    describe("as received", [r for r in good if not r["range_flattened"]])
    describe("range flattened", [r for r in good if r["range_flattened"]])


def main() -> None:
    """Print the table, and write the cells where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first cell")
    parser.add_argument("--size", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--csv")
    options = parser.parse_args()
    run = partial(one, size=options.size, settings=RippleSettings())
    seeds = range(options.first, options.first + options.cells)
    with ProcessPoolExecutor(options.workers) as pool:
        rows = list(pool.map(run, seeds))
    report(rows)
    if options.csv:
        names = sorted({name for row in rows for name in row})
        with open(options.csv, "w", newline="") as stream:
            writer = csv.DictWriter(stream, names)
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
