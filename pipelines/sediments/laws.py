"""Amplitude laws: accuracy and speed of the density, efficiency of fits, G's table 1.

    python pipelines/sediments/laws.py [--points 20000] [--fits 200] [--snippets FOLDER]

Density: absolute error of log p over max(1, |log p|) against 40 digits (the texture integral about
its saddle), by regions of the arguments, beside the formula with scipy's kve, evaluated naively.
Fits: loss of log likelihood, coverage of 95 % intervals and variance over the Cramer-Rao bound
(observed scores of a large sample at the truth). Table 1 of G: mean square difference of densities
after his least squares, for simulated textures and windows of recorded clips.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import mpmath as mp
import numpy as np
from scipy.special import gammaln, i0e, kve

from sasmap.sediments import fit, generalized_k
from sasmap.sediments.fitting import FAMILIES
from sasmap.sediments.moments import fit_histogram

mp.mp.dps = 40
DECADES_NU = ((-3, -1), (-1, 1), (1, 3), (3, 5), (5, 8))
KAPPAS = (0.0, 1e-2, 1.0, 1e2, 1e4)
CASES = ((0.3, 0.0), (0.3, 1.0), (1.0, 0.0), (1.0, 3.0), (3.0, 1.0), (10.0, 1.0), (30.0, 3.0))


def reference(x: float, nu: float, kappa: float) -> float:
    """Log density with 40 digits."""
    x, nu, kappa = mp.mpf(x), mp.mpf(nu), mp.mpf(kappa)
    total = nu + kappa**2
    root = mp.sqrt((nu - 1) ** 2 + 4 * total * x * x)
    z = (nu - 1 + root) / (2 * total) if nu > 1 else 2 * x * x / (root - (nu - 1))
    alpha, beta = x * x / z, total * z
    step = min(mp.mpf("0.35") / mp.sqrt(alpha + beta), mp.mpf("0.12"))
    integral = mp.mpf(1)
    for sign in (1, -1):
        k = 1
        while True:
            t = sign * k * step
            term = mp.exp(-alpha * (mp.expm1(-t) + t) - beta * (mp.expm1(t) - t))
            if term < mp.mpf(10) ** -32:
                break
            integral, k = integral + term, k + 1
    y = 2 * kappa * x
    if y > 1e4:
        terms = [mp.rf(mp.mpf(1) / 2, m) ** 2 / (mp.factorial(m) * (2 * y) ** m) for m in range(12)]
        bessel = mp.log(sum(terms)) - mp.log(2 * mp.pi * y) / 2
    else:
        bessel = mp.log(mp.besseli(0, y)) - y
    drift = (x - kappa * z) ** 2 / z + nu * (z - 1 - mp.log(z)) + mp.log(z)
    head = mp.log(2 * x) + bessel + nu * mp.log(nu) - nu - mp.loggamma(nu)
    return float(head - drift + mp.log(integral * step))


def naive(x: np.ndarray, nu: float, kappa: float) -> np.ndarray:
    """Log density by scipy's scaled Bessel functions (G 5, corrected)."""
    b = 2 * np.sqrt(nu + kappa**2)
    with np.errstate(all="ignore"):
        bessels = np.log(i0e(2 * kappa * x)) + 2 * kappa * x + np.log(kve(nu - 1, b * x)) - b * x
        return np.log(2 * b) - gammaln(nu) + nu * np.log(2 * nu * x / b) + bessels


def region(task: tuple[tuple[int, int], float, int]) -> str:
    """One line of the table of accuracy."""
    (low, high), kappa, points = task
    rng = np.random.default_rng([low + 9, int(kappa * 100)])
    generalized_k.logpdf(1.0, 1.0, 1.0)  # compiled, or loaded
    worst = worst_naive = 0.0
    lost, seconds, seconds_naive = 0, 0.0, 0.0
    laws = max(points // 40, 1)
    for _ in range(laws):
        nu = 10 ** rng.uniform(low, high)
        rms = np.sqrt(1 + kappa**2 * (1 + 1 / nu))
        near = np.abs(1 + 0.5 * rng.normal(size=20))
        x = rms * np.concatenate([near, 10 ** rng.uniform(-12, 4, 20)])
        start = time.perf_counter()
        got = generalized_k.logpdf(x, nu, kappa)
        middle = time.perf_counter()
        other = naive(x, nu, kappa)
        seconds += middle - start
        seconds_naive += time.perf_counter() - middle
        exact = np.array([reference(v, nu, kappa) for v in x])
        size = np.maximum(np.abs(exact), 1)
        worst = max(worst, float((np.abs(got - exact) / size).max()))
        error = np.abs(other - exact) / size
        good = np.isfinite(error) & (error < 1e-6)
        lost += int((~good).sum())
        worst_naive = max(worst_naive, float(error[good].max(initial=0)))
    share = 100 * lost / (40 * laws)
    return (
        f"1e{low:+d} - 1e{high:+d}  {kappa:8g} | {worst:.1e}  | {worst_naive:.1e}, "
        f"{share:5.1f} % lost | {seconds / seconds_naive:5.1f}"
    )


def one_fit(seed: int, nu: float, kappa: float, n: int) -> list[float]:
    """Loss at the truth, errors of the coordinates, whether intervals hold it, seconds."""
    sample = generalized_k.rvs(nu, kappa, size=n, random_state=seed)
    start = time.perf_counter()
    law = fit(sample)
    seconds = time.perf_counter() - start
    truth = np.array([np.log(nu), np.log1p(kappa**2), np.log(1 + kappa**2 * (1 + 1 / nu))])
    found = np.array([np.log(law.nu), np.log1p(law.kappa**2), np.log(law.mean_square)])
    inside = np.abs(found - truth) < 1.96 * np.array(law.errors)
    fresh = generalized_k.rvs(nu, kappa, size=20_000, random_state=seed + 10**6)
    loss = generalized_k.logpdf(fresh, nu, kappa).mean() - law.log_density(fresh).mean()
    return [loss * n, *(found - truth), *inside.astype(float), seconds]


def bound(nu: float, kappa: float) -> np.ndarray:
    """Cramer-Rao variances of log nu, log(1 + kappa^2), log mean square, times the samples."""
    sample = generalized_k.rvs(nu, kappa, size=200_000, random_state=1)
    point = np.array([np.log(nu), np.log1p(kappa**2), np.log(1 + kappa**2 * (1 + 1 / nu))])

    def level(u: np.ndarray) -> np.ndarray:
        n, k = np.exp(u[0]), np.sqrt(max(np.expm1(u[1]), 0))
        scale = np.exp(0.5 * u[2]) / np.sqrt(1 + k**2 * (1 + 1 / n))
        return np.asarray(generalized_k.logpdf(sample, n, k, scale=scale))

    free = [0, 2] if kappa == 0 else [0, 1, 2]
    step = 1e-4 * np.eye(3)
    scores = np.array([(level(point + step[i]) - level(point - step[i])) / 2e-4 for i in free])
    variance = np.full(3, np.nan)
    variance[free] = np.diag(np.linalg.inv(scores @ scores.T / sample.size))
    return variance


def efficiency(pool: ProcessPoolExecutor, fits: int) -> None:
    """Print the table of fits."""
    print(
        "\n  nu  kappa      n | loss, nats (3/2 ideal) | efficiency log nu, log(1+k^2), log E[x^2]"
        " | 95 % cover | ms"
    )
    for nu, kappa in CASES:
        limit = bound(nu, kappa)
        for n in (4096, 65536):
            found = np.array(list(pool.map(partial(one_fit, nu=nu, kappa=kappa, n=n), range(fits))))
            ratio = limit / n / np.mean((found[:, 1:4] - 0) ** 2, axis=0)
            cover = 100 * found[:, 4:7].mean(axis=0)
            print(
                f"{nu:5g} {kappa:5g} {n:7d} | {found[:, 0].mean():5.2f}                  | "
                f"{ratio[0]:.2f} {ratio[1]:.2f} {ratio[2]:.2f}"
                f"                             | {cover[0]:3.0f} {cover[1]:3.0f} {cover[2]:3.0f} | "
                f"{1e3 * np.median(found[:, 7]):.1f}",
                flush=True,
            )


def against_scipy() -> None:
    """Print how much faster fits are than scipy's generic one, and how likely both are."""
    sample = generalized_k.rvs(2.0, 1.0, scale=3.0, size=4096, random_state=1)
    fit(sample)
    start = time.perf_counter()
    law = fit(sample)
    middle = time.perf_counter()
    generic = super(type(generalized_k), generalized_k).fit(sample, 1.0, 0.5, floc=0, scale=2.0)
    end = time.perf_counter()
    ours = law.log_density(sample).sum()
    theirs = generalized_k.logpdf(sample, *generic).sum()
    times = (end - middle) / (middle - start)
    print(f"\nscipy's generic fit of 4096 samples takes {times:.0f} times as long; ", end="")
    print(f"log likelihood beyond its: {ours - theirs:+.3f} nats")


def textures(size: int = 200) -> dict[str, np.ndarray]:
    """Eight simulated textures with the shapes that G describes, from mud to ripples."""
    n = size * size
    made = {
        "mud": generalized_k.rvs(50.0, 0.0, size=n, random_state=1),
        "sand": generalized_k.rvs(8.0, 0.5, size=n, random_state=2),
        "gravel": generalized_k.rvs(2.0, 1.0, size=n, random_state=3),
        "rock": generalized_k.rvs(0.6, 0.5, size=n, random_state=4),
        "posidonia": generalized_k.rvs(1.2, 2.0, size=n, random_state=5),
        "ripples": generalized_k.rvs(0.9, 3.0, size=n, random_state=6),
        "shells": generalized_k.rvs(0.3, 0.5, size=n, random_state=7),
    }
    made["48 kHz, offset"] = 0.25 + generalized_k.rvs(3.0, 0.5, size=n, random_state=8)
    return made


def recorded(folder: Path) -> dict[str, np.ndarray]:
    """Windows of recorded clips."""
    import rasterio

    windows = {}
    for name, row, column in (("02", 150, 150), ("17", 40, 300), ("17", 40, 20), ("31", 200, 200)):
        with rasterio.open(folder / f"snippet_{name}.tif") as source:
            part = source.read(1)[row : row + 128, column : column + 128].astype(float)
        windows[f"snippet {name}, {row}, {column}"] = part[part > 0]
    return windows


def table_one(samples: dict[str, np.ndarray]) -> None:
    """Print mean square differences of densities, over that of the best law."""
    head = "mean square difference of densities (x rms^2)"
    print(f"\n{head:46s}" + "".join(f"{f:>15s}" for f in FAMILIES))
    for name, sample in samples.items():
        rms = np.sqrt(np.mean(sample**2))
        density, edges = np.histogram(sample / rms, np.linspace(0, 4, 81), density=True)
        offset = "offset" in name
        misfits = [fit_histogram(edges, density, f, offset=offset).misfit for f in FAMILIES]
        print(f"{name:46s}" + "".join(f"{m:15.2e}" for m in misfits), flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--fits", type=int, default=200)
    parser.add_argument("--snippets", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    tasks = [(d, k, options.points // 25) for d in DECADES_NU for k in KAPPAS]
    print("      nu          kappa | error    | naive kve: error      | time over naive")
    with ProcessPoolExecutor(options.workers) as pool:
        for line in pool.map(region, tasks):
            print(line, flush=True)
        efficiency(pool, options.fits)
    against_scipy()
    table_one(textures())
    if options.snippets:
        table_one(recorded(options.snippets))


if __name__ == "__main__":
    main()
