"""Error against run time: sasmap's ripple estimate beside other methods.

    python pipelines/studies/ripples.py [--quick] [--clips 20] [--output docs/studies]

Clips of Zare and Cobb's kind (Rayleigh speckle over sine ripples, 500 x 500 pixels, shadow by the
crest rule in simulation and in every estimate, phase zero at the track as the published sampler
needs), f from 0.4 to 0.8 cycles/m and A_H from 0.05 to 0.09 m, at near, middle and far range:
straight crests, and crests that wander by 0.8 rad (rms) from row to row. Every method starts from
the pixels; seconds are wall clock on one core. Writes ripples.csv, ripples.md and ripples.png.

Methods: the FFT start alone; the published sampler, on row means and (same numbers, timed on few
clips) as published on all pixels; a brute-force grid posterior; emcee; differential evolution with
restarts; sasmap's default method at budgets of 100 to 4000 draws per chain, told the scattering law
and (as by default) not told it. Grid, emcee and differential evolution use the speckle likelihood
of row means, exact for straight crests, and are told the law.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from scipy.optimize import differential_evolution

from sasmap.ripples import Clip, RippleSettings, estimate
from sasmap.simulate.scattering import lit_amplitude, shadow_crest_rule

mpl.use("Agg")
import matplotlib.pyplot as plt

SIZE, ALTITUDE, PIXEL = 500, 4.83, 0.0244
RANGES = {"near": 5.0, "middle": 18.0, "far": 31.0}
BOUNDS = ((0.2, 1.2), (0.01, 0.15))
# Goals for the RMSE over the truth.
GOALS = (("f 1 %", 0, 0.01), ("f 0.1 %", 0, 0.001), ("A_H 10 %", 1, 0.1), ("A_H 1 %", 1, 0.01))


class Case(NamedTuple):
    """A clip with its truth."""

    clip: Clip
    frequency: float
    height: float


class Found(NamedTuple):
    """Result of a method: means, 90 % intervals (or None), seconds, ESS of f."""

    mean: tuple[float, float]
    interval: tuple[tuple[float, float], tuple[float, float]] | None
    seconds: float
    ess: float = float("nan")


def amplitude_of(
    phase: np.ndarray, reach: np.ndarray, frequency: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """Amplitude over straight sine ripples, 0 in shadow by the crest rule."""
    grazing = np.arctan2(ALTITUDE, reach)
    lit = lit_amplitude(grazing, np.cos(phase), 1.0, 2 * np.pi * frequency * height)
    return np.where(shadow_crest_rule(phase, reach, ALTITUDE, frequency, height), 0.0, lit)


def case_of(where: str, bent: bool, seed: int) -> Case:
    """Simulate a clip."""
    rng = np.random.default_rng([seed, list(RANGES).index(where), bent])
    frequency, height = rng.uniform(0.4, 0.8), rng.uniform(0.05, 0.09)
    reach = RANGES[where] + PIXEL * (np.arange(SIZE) + 0.5)
    wander = np.zeros(SIZE)
    if bent:
        turns = rng.normal(0, 1, 6) / np.arange(1, 7)
        rows = np.arange(SIZE) / SIZE
        wander = sum(t * np.sin(2 * np.pi * (k + 1) * rows) for k, t in enumerate(turns))
        wander *= 0.8 / max(wander.std(), 1e-9)
    phase = 2 * np.pi * frequency * reach + wander[:, None]
    clean = amplitude_of(phase, reach, np.float64(frequency), np.float64(height))
    amplitude = clean * rng.rayleigh(100.0, (SIZE, SIZE)) + 1e-6
    x = np.broadcast_to(reach, amplitude.shape).copy()
    y = np.broadcast_to(PIXEL * np.arange(SIZE)[::-1, None], amplitude.shape).copy()
    same = np.full(amplitude.shape, ALTITUDE), np.full(amplitude.shape, 90.0)
    return Case(Clip(amplitude, x, y, x, *same, PIXEL), frequency, height)


class Rows:
    """Speckle likelihood of row means: intensities are exponential, their means gamma."""

    def __init__(self, clip: Clip) -> None:
        self.reach = clip.ground_range[0]
        self.mean = (clip.amplitude**2).mean(axis=0)
        self.mean /= self.mean.mean()
        self.looks = clip.amplitude.shape[0]

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        """Of (f, A_H, phase, log noise) in rows (n, 4); the scale is that of the best fit."""
        f, height, phase, noise = (v[:, None] for v in np.atleast_2d(theta).T)
        model = amplitude_of(2 * np.pi * f * self.reach + phase, self.reach, f, height) ** 2
        model = model + np.exp(noise) * 0.01
        scale = (self.mean / model).mean(axis=1, keepdims=True)
        return -self.looks * (np.log(scale * model) + self.mean / (scale * model)).sum(axis=1)

    def log_posterior(self, theta: np.ndarray) -> np.ndarray:
        """Return the same within flat bounds."""
        theta = np.atleast_2d(theta)
        inside = (np.abs(theta[:, 2]) < np.pi) & (theta[:, 3] > -12) & (theta[:, 3] < 3)
        for i, (low, high) in enumerate(BOUNDS):
            inside &= (theta[:, i] > low) & (theta[:, i] < high)
        result = np.full(len(theta), -np.inf)
        if inside.any():
            result[inside] = self.log_likelihood(theta[inside])
        return result


def fourier_start(clip: Clip) -> tuple[float, float]:
    """FFT peak of the cross-range mean, and A_H from its rms (ZC 3.2.2)."""
    mean = clip.amplitude.mean(axis=0)
    centred = (mean - mean.mean()) / mean.max()
    power = np.abs(np.fft.rfft(centred * np.hanning(SIZE), 8 * SIZE)) ** 2
    peak = int(np.argmax(power[16:])) + 16
    return peak / (8 * SIZE * PIXEL), float(np.sqrt(2) * np.std(centred) * 0.15)


def fft(case: Case, seed: int) -> Found:
    """FFT start alone."""
    start = time.perf_counter()
    found = fourier_start(case.clip)
    return Found(found, None, time.perf_counter() - start)


def published(case: Case, seed: int) -> Found:
    """Run the published sampler, on row means."""
    settings = RippleSettings(method="zare-cobb", frequency=(0, 5), height=(0, 1), shadow="crest")
    return _estimated(case, settings, seed)


def published_on_pixels(case: Case, seed: int) -> Found:
    """As published: the Gaussian likelihood of every pixel at every iteration; seconds alone."""
    rng = np.random.default_rng(seed)
    values = case.clip.amplitude / case.clip.amplitude.max()
    reach = case.clip.ground_range
    steps, done = 200, 0
    start = time.perf_counter()
    theta, level = np.array([0.6, 0.07]), -np.inf
    while done < steps:
        done += 1
        trial = np.abs(theta + rng.normal(0, 0.1, 2))
        model = amplitude_of(2 * np.pi * trial[0] * reach, reach, trial[0], trial[1])
        found = -0.5 * float(((values - model) ** 2).sum())
        if np.log(rng.uniform()) < found - level:
            theta, level = trial, found
    seconds = (time.perf_counter() - start) * 5000 / steps
    return Found(published(case, seed).mean, None, seconds)


def grid(case: Case, seed: int) -> Found:
    """Brute force: a grid of 17^4 points about the best, drawn in four times."""
    start = time.perf_counter()
    rows = Rows(case.clip)
    f, _ = fourier_start(case.clip)
    centre, half = np.array([f, 0.07, 0.0, -3.0]), np.array([0.06, 0.055, np.pi, 5.0])
    for _ in range(5):
        axes = [np.linspace(c - h, c + h, 17) for c, h in zip(centre, half, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 4)
        points[:, 1] = np.clip(points[:, 1], 0.005, None)
        level = np.concatenate([rows.log_likelihood(p) for p in np.array_split(points, 60)])
        weight = np.exp(level - level.max())
        weight /= weight.sum()
        mean = weight @ points
        sd = np.sqrt(weight @ (points - mean) ** 2)
        centre, half = mean, np.maximum(4 * sd, 0.3 * half)
    order = [np.argsort(points[:, i]) for i in range(2)]
    interval = tuple(
        tuple(np.interp([0.05, 0.95], np.cumsum(weight[o]), points[o, i]))
        for i, o in enumerate(order)
    )
    return Found((mean[0], mean[1]), interval, time.perf_counter() - start)


def evolution(case: Case, seed: int) -> Found:
    """Differential evolution, three restarts."""
    start = time.perf_counter()
    rows = Rows(case.clip)
    bounds = [*BOUNDS, (-np.pi, np.pi), (-12, 3)]
    best = min(
        (
            differential_evolution(
                lambda v: -rows.log_likelihood(v.T), bounds, rng=seed + 17 * k, vectorized=True,
                updating="deferred", maxiter=300, popsize=15, tol=1e-8,
            )
            for k in range(3)
        ),
        key=lambda r: r.fun,
    )  # fmt: skip
    return Found((best.x[0], best.x[1]), None, time.perf_counter() - start)


def hammer(case: Case, seed: int, steps: int = 3000) -> Found:
    """emcee: 24 walkers from about the FFT's f and the best of a coarse scan."""
    import arviz_stats
    import emcee

    rng = np.random.default_rng(seed)
    start = time.perf_counter()
    rows = Rows(case.clip)
    f, _ = fourier_start(case.clip)
    tries = np.column_stack(
        [
            f + rng.uniform(-0.02, 0.02, 20000),
            rng.uniform(*BOUNDS[1], 20000),
            rng.uniform(-np.pi, np.pi, 20000),
            rng.uniform(-8, 1, 20000),
        ]
    )
    level = np.concatenate([rows.log_posterior(t) for t in np.array_split(tries, 20)])
    first = tries[np.argsort(-level)[:24]]
    np.random.seed(seed)  # noqa: NPY002 (where emcee takes its randomness from)
    sampler = emcee.EnsembleSampler(24, 4, rows.log_posterior, vectorize=True)
    sampler.run_mcmc(first, steps)
    chain = sampler.get_chain(discard=steps // 3)
    seconds = time.perf_counter() - start
    flat = chain.reshape(-1, 4)
    interval = tuple(tuple(np.quantile(flat[:, i], [0.05, 0.95])) for i in range(2))
    ess = float(arviz_stats.base.array_stats.ess(chain[..., 0].T, method="bulk"))
    return Found((flat[:, 0].mean(), flat[:, 1].mean()), interval, seconds, ess)


def default(draws: int, scattering: str) -> Callable[[Case, int], Found]:
    """Return the default method with so many draws per chain at most."""
    settings = RippleSettings(
        shadow="crest", draws=draws, frequency=(0.05, 5), scattering=scattering
    )

    def method(case: Case, seed: int) -> Found:
        return _estimated(case, settings, seed)

    return method


def _estimated(case: Case, settings: RippleSettings, seed: int) -> Found:
    start = time.perf_counter()
    posterior = estimate(case.clip, settings, rng=seed)
    seconds = time.perf_counter() - start
    if not posterior.sampled:
        return Found((float("nan"),) * 2, None, seconds)
    mean = tuple(float(posterior.mean[name]) for name in ("frequency", "height"))
    q = posterior.draws[["frequency", "height"]].quantile([0.05, 0.95])
    interval = tuple((float(q[n][0]), float(q[n][1])) for n in ("frequency", "height"))
    return Found(mean, interval, seconds, posterior.ess_bulk["frequency"])


METHODS: dict[str, Callable[[Case, int], Found]] = {
    "FFT start alone": fft,
    "published, row means": published,
    "published, all pixels": published_on_pixels,
    "grid posterior": grid,
    "differential evolution": evolution,
    "emcee": hammer,
    **{f"sasmap, law known, {n} draws": default(n, "zare-cobb") for n in (100, 400, 4000)},
    **{f"sasmap, {n} draws": default(n, "estimated") for n in (100, 400, 4000)},
}
SLOW = ("published, all pixels", "grid posterior", "differential evolution", "emcee")


def measure(where: str, bent: bool, name: str, clips: int) -> dict[str, float | str]:
    """Run a method over clips: relative errors, coverage, seconds."""
    few = min(clips, 6) if name in SLOW else clips
    cases = [case_of(where, bent, seed) for seed in range(few)]
    found = [METHODS[name](case, seed) for seed, case in enumerate(cases)]
    truth = np.array([(c.frequency, c.height) for c in cases])
    error = np.array([f.mean for f in found]) / truth - 1
    covers = [
        [low <= t <= high for t, (low, high) in zip(true, f.interval, strict=True)]
        for f, true in zip(found, truth, strict=True)
        if f.interval is not None
    ]
    missed = float(np.isnan(error[:, 0]).mean())
    rms = np.sqrt(np.nanmean(error**2, axis=0))
    middle = np.nanmedian(np.abs(error), axis=0)
    share = np.mean(covers, axis=0) if covers else (np.nan, np.nan)
    seconds = float(np.median([f.seconds for f in found]))
    return {
        "range": where,
        "crests": "bent" if bent else "straight",
        "method": name,
        "clips": few,
        "seconds": seconds,
        "rmse_f": rms[0],
        "rmse_A_H": rms[1],
        "median_error_f": middle[0],
        "median_error_A_H": middle[1],
        "coverage_f": share[0],
        "coverage_A_H": share[1],
        "ess_per_second": float(np.median([f.ess / f.seconds for f in found])),
        "not_found": missed,
    }


def table(rows: list[dict[str, float | str]]) -> str:
    """Write the rows as Markdown, and the goals that each method reaches."""
    head = (
        "| range | crests | method | clips | s a clip | RMSE f | RMSE A_H | 90 % covers f, A_H | "
        "ESS of f a second |\n|---|---|---|---|---|---|---|---|---|"
    )
    lines = [head]
    for r in rows:
        covers = (
            ""
            if np.isnan(r["coverage_f"])
            else f"{100 * r['coverage_f']:.0f}, {100 * r['coverage_A_H']:.0f} %"
        )
        ess = "" if np.isnan(r["ess_per_second"]) else f"{r['ess_per_second']:.0f}"
        lines.append(
            f"| {r['range']} | {r['crests']} | {r['method']} | {r['clips']} | {r['seconds']:.3g} | "
            f"{100 * r['rmse_f']:.2g} % | {100 * r['rmse_A_H']:.2g} % | {covers} | {ess} |"
        )
    lines.append("\nSeconds at which a method first has an RMSE below (all ranges):\n")
    lines.append("| crests | method | " + " | ".join(g for g, _, _ in GOALS) + " |")
    lines.append("|---|---|" + "---|" * len(GOALS))
    for crests in ("straight", "bent"):
        for name in dict.fromkeys(r["method"] for r in rows):
            mine = [r for r in rows if r["method"] == name and r["crests"] == crests]
            if not mine:
                continue
            cells = []
            for _, i, goal in GOALS:
                key = ("rmse_f", "rmse_A_H")[i]
                reached = max(r[key] for r in mine) < goal
                cells.append(f"{max(r['seconds'] for r in mine):.2g}" if reached else "never")
            lines.append(f"| {crests} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def plot(rows: list[dict[str, float | str]], path: Path) -> None:
    """Draw RMSE over seconds."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), sharex=True, layout="constrained")
    marks = dict(zip(RANGES, "osD", strict=True))
    names = list(dict.fromkeys(r["method"] for r in rows))
    colours = plt.get_cmap("tab10")
    for j, crests in enumerate(("straight", "bent")):
        for i, (key, label) in enumerate((("rmse_f", "RMSE of f"), ("rmse_A_H", "RMSE of A_H"))):
            for r in rows:
                if r["crests"] == crests:
                    k = names.index(r["method"])
                    axes[i, j].loglog(
                        r["seconds"], r[key], marks[r["range"]], color=colours(k), ms=6
                    )
            axes[i, j].set(ylabel=f"{label} (relative)", title=f"{crests} crests")
            axes[i, j].grid(alpha=0.3)
    for ax in axes[1]:
        ax.set_xlabel("seconds a clip, one core")
    handles = [plt.Line2D([], [], marker="o", ls="", color=colours(k)) for k in range(len(names))]
    handles += [plt.Line2D([], [], marker=m, ls="", color="k") for m in marks.values()]
    figure.legend(handles, [*names, *RANGES], loc="outside lower center", ncols=5, fontsize=8)
    figure.savefig(path, dpi=90)


def main() -> None:
    """Run all and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="a clip of each kind at far range, the fast methods"
    )
    parser.add_argument("--clips", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    clips = 1 if options.quick else options.clips
    estimate(case_of("middle", False, 0).clip, rng=0)  # compiles
    estimate(case_of("middle", True, 0).clip, rng=0)
    rows = []
    for bent in (False, True):
        for where in ("middle",) if options.quick else RANGES:
            for name in METHODS:
                if (options.quick and name in SLOW) or (bent and name in SLOW[1:]):
                    continue
                rows.append(measure(where, bent, name, clips))
                print({k: v if isinstance(v, str) else f"{v:.3g}" for k, v in rows[-1].items()})
    options.output.mkdir(parents=True, exist_ok=True)
    with open(options.output / "ripples.csv", "w", newline="", encoding="utf-8") as stream:
        written = csv.DictWriter(stream, list(rows[0]))
        written.writeheader()
        written.writerows(rows)
    (options.output / "ripples.md").write_text(table(rows), encoding="utf-8")
    plot(rows, options.output / "ripples.png")


if __name__ == "__main__":
    main()
