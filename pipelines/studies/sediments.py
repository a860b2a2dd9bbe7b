"""Error against run time: fits of amplitude laws, choice of family, and boundaries.

    python pipelines/studies/sediments.py [--quick] [--repeats 100] [--output docs/studies]

Fits: generalised K samples (nu 2, kappa 1; and K, nu 4) of 256 to 65 536, by maximum likelihood,
even moments, log-moments and least squares on a histogram (G 3.4). Choice: sasmap's (the simplest
law the data do not reject) beside always the generalised K and always Rayleigh. Loss is the mean
log likelihood a sample, times their number, that a fitted law lacks of the true one on fresh data
(half the number of parameters is ideal). Boundaries: wavy ones at 0.15 nat a pixel by windows of
several sizes and by linked nodes of several spacings. Writes sediments.csv and sediments.md.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from sasmap.sediments import choose, fit, generalized_k
from sasmap.sediments.moments import fit_histogram, fit_log_moments, fit_moments
from sasmap.sediments.nodes import refine_boundary

LAWS = {"generalised K (2, 1)": (2.0, 1.0), "K (4)": (4.0, 0.0), "Rayleigh": (1e6, 0.0)}
SIZES = (256, 1024, 4096, 16384, 65536)
FRESH = 50_000
Row = dict[str, float | str]


Density = Callable[[np.ndarray], np.ndarray]


def by_histogram(sample: np.ndarray) -> Density:
    """Least squares on a histogram of 80 bins (G 3.4)."""
    top = 4 * np.sqrt(np.mean(sample**2))
    density, edges = np.histogram(sample, np.linspace(0, top, 81), density=True)
    *shapes, scale = fit_histogram(edges, density, "generalized_k").parameters
    return lambda x: generalized_k.logpdf(x, *shapes, scale=scale)


METHODS: dict[str, Callable[[np.ndarray], Density]] = {
    "maximum likelihood": lambda sample: fit(sample).log_density,
    "even moments": lambda sample: fit_moments(sample).log_density,
    "log-moments": lambda sample: fit_log_moments(sample).log_density,
    "histogram, least squares": by_histogram,
    "chosen family": lambda sample: choose(sample).law.log_density,
    "always Rayleigh": lambda sample: fit(sample, "rayleigh").log_density,
}


def fitted(name: str, law: str, n: int, repeats: int) -> Row:
    """Loss and time of a way to fit."""
    nu, kappa = LAWS[law]
    losses, seconds, failed = [], [], 0
    for seed in range(repeats):
        sample = generalized_k.rvs(nu, kappa, size=n, random_state=seed)
        fresh = generalized_k.rvs(nu, kappa, size=FRESH, random_state=seed + 10**6)
        start = time.perf_counter()
        try:
            found = METHODS[name](sample)
        except ValueError:
            failed += 1
            continue
        seconds.append(time.perf_counter() - start)
        gain = generalized_k.logpdf(fresh, nu, kappa) - found(fresh)
        losses.append(n * float(gain.mean()))
    error = float(np.std(losses) / np.sqrt(max(len(losses), 1)))
    return {
        "study": "fit", "case": law, "method": name, "n": n, "seconds": float(np.median(seconds)),
        "error": float(np.mean(losses)), "standard_error": error, "failed": failed,
    }  # fmt: skip


def wavy(seed: int, size: int = 400) -> tuple[np.ndarray, cKDTree]:
    """Log likelihood ratio over a wavy boundary, and points of the truth."""
    rng = np.random.default_rng([seed, 9])
    y, x = np.indices((size, size))
    phase = rng.uniform(0, 6)
    edge = size / 2 + 15 * np.sin(y / 30 + phase)
    level = np.where(x > edge, 1.75, 1.0)
    intensity = level * rng.exponential(size=level.shape)
    ratio = (intensity / 1.75 + np.log(1.75)) - intensity  # log p_L - log p_R
    rows = np.linspace(0, size - 1, 4 * size)
    truth = np.column_stack([rows, size / 2 + 15 * np.sin(rows / 30 + phase) - 0.5])
    return ratio, cKDTree(truth)


def windows(width: int, ratio: np.ndarray) -> np.ndarray:
    """Boundary of a classification by windows."""
    lines = find_contours(uniform_filter(ratio, width), 0.0)
    return np.vstack(lines)


def nodes(spacing: float, ratio: np.ndarray) -> np.ndarray:
    """Boundary by linked nodes, from the longest line of windows of 33."""
    first = max(find_contours(uniform_filter(ratio, 33), 0.0), key=len)
    # the left sediment to the left of the way
    middle = first[len(first) // 2]
    way = first[min(len(first) // 2 + 8, len(first) - 1)] - middle
    left = middle - 10 * np.array([way[1], -way[0]]) / np.hypot(*way)
    row, column = np.clip(left.astype(int), 8, np.array(ratio.shape) - 9)
    if ratio[row - 8 : row + 9, column - 8 : column + 9].mean() < 0:
        first = first[::-1]
    return refine_boundary(first, ratio, spacing=spacing).points


BOUNDARIES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    **{f"windows of {w}": partial(windows, w) for w in (9, 17, 33, 65)},
    **{f"nodes every {s:g} px": partial(nodes, s) for s in (2.0, 4.0, 8.0, 16.0)},
}


def bounded(name: str, repeats: int) -> Row:
    """Mean distance to the truth, and time."""
    errors, seconds = [], []
    for seed in range(repeats):
        ratio, tree = wavy(seed)
        start = time.perf_counter()
        points = BOUNDARIES[name](ratio)
        seconds.append(time.perf_counter() - start)
        errors.append(float(tree.query(points)[0].mean()))
    return {
        "study": "boundary", "case": "wavy", "method": name, "n": 160_000,
        "seconds": float(np.median(seconds)), "error": float(np.mean(errors)),
        "standard_error": float(np.std(errors) / np.sqrt(repeats)), "failed": 0,
    }  # fmt: skip


def table(rows: list[Row]) -> str:
    """Write the rows as Markdown."""
    lines = ["Loss of fits, nats (over all samples; fresh data):\n"]
    lines.append("| law | method | " + " | ".join(str(n) for n in SIZES) + " | ms at 4096 |")
    lines.append("|---|---|" + "---|" * (len(SIZES) + 1))
    for law in LAWS:
        for name in METHODS:
            mine = {r["n"]: r for r in rows if r["case"] == law and r["method"] == name}
            if not mine:
                continue
            cells = [
                f"{mine[n]['error']:.2f} ± {mine[n]['standard_error']:.2f}" if n in mine else ""
                for n in SIZES
            ]
            ms = f"{1e3 * mine[4096]['seconds']:.1f}" if 4096 in mine else ""
            lines.append(f"| {law} | {name} | " + " | ".join(cells) + f" | {ms} |")
    lines.append("\nWavy boundaries of 400 x 400 pixels at 0.15 nat a pixel:\n")
    lines.append("| method | mean distance to the truth (px) | s |\n|---|---|---|")
    for r in rows:
        if r["study"] == "boundary":
            lines.append(
                f"| {r['method']} | {r['error']:.2f} ± {r['standard_error']:.2f} | "
                f"{r['seconds']:.2g} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run all and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few repeats, few sizes")
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    repeats = 3 if options.quick else options.repeats
    sizes = SIZES[:3] if options.quick else SIZES
    rows = [fitted(m, law, n, repeats) for law in LAWS for m in METHODS for n in sizes]
    rows += [bounded(name, min(repeats, 40)) for name in BOUNDARIES]
    options.output.mkdir(parents=True, exist_ok=True)
    with open(options.output / "sediments.csv", "w", newline="", encoding="utf-8") as stream:
        written = csv.DictWriter(stream, list(rows[0]))
        written.writeheader()
        written.writerows(rows)
    text = table(rows)
    (options.output / "sediments.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
