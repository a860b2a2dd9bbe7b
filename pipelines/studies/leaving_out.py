"""Time saved by skipped steps: scenes that need none, one or all of them.

    python pipelines/studies/leaving_out.py [--quick] [--clips 20] [--output docs/studies]

sasmap skips steps that a scene does not need and records them (``left_out``). Cells of 500 x 500
pixels by the coherent simulator, Lambert's law: flat; straight ripples that cannot cast shadow;
with shadow; with shadow and bent crests. Each is estimated by default, then with the law fixed, and
with the modelled image kept as well: seconds, skipped steps, error and width of the 90 % interval
of A_H. Then the cost of the second stage with one pass and with four, and of the sediment map for
one sediment, for four, and for two that differ by texture alone. Writes leaving_out.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import gammaincinv, ndtr

from sasmap.passes.fusion import fuse_cells, learn_survey
from sasmap.passes.summary import Summary, summarise
from sasmap.ripples import Clip, Posterior, Quality, RippleSettings, estimate
from sasmap.ripples.posterior import LeftOut
from sasmap.sediments import k_distribution
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.mapping import refine_map
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.trends import AmplitudeGrid
from sasmap.simulate import coherent_cell

SETTINGS = {
    "as it is": RippleSettings(),
    "law told": RippleSettings(scattering="lambert"),
    "with its image": RippleSettings(keep_model=True),
}
BENT = {"wander": 0.8, "wander_length": 5.0}
SCENES: dict[str, dict[str, float]] = {
    "flat": {"height": 0.0},
    "straight, no shadow": {"height": 0.03, "near": 8.0},
    "straight, shadow": {"height": 0.06, "near": 28.0},
    "bent, shadow": {"height": 0.06, "near": 28.0, **BENT},
}


class Timed(NamedTuple):
    """An estimate, its seconds, and the true A_H, m."""

    posterior: Posterior
    seconds: float
    height: float


def clip_of(name: str, seed: int, size: int) -> Clip:
    """Simulate a cell of a scene."""
    return coherent_cell(
        np.random.default_rng([seed, 12]), frequency=0.8, azimuth_off_look=10.0, pixel_size=0.025,
        shape=(size, size), **SCENES[name],
    ).clip  # fmt: skip


def timed(name: str, clip: Clip, settings: RippleSettings, seed: int) -> Timed:
    """Estimate a cell."""
    start = time.perf_counter()
    posterior = estimate(clip, settings, rng=seed)
    return Timed(posterior, time.perf_counter() - start, SCENES[name]["height"])


def left_out(posterior: Posterior) -> str:
    """Names of what was left out."""
    names = [str(f.name).lower().replace("_", " ") for f in LeftOut if f in posterior.left_out]
    return ", ".join(names) or "nothing"


def ripples(clips: int, size: int) -> list[str]:
    """Lines of the table of ripples."""
    lines = []
    for name in SCENES:
        cells = [clip_of(name, seed, size) for seed in range(clips)]
        for told, settings in SETTINGS.items():
            runs = [timed(name, clip, settings, seed) for seed, clip in enumerate(cells)]
            left = [left_out(run.posterior) for run in runs]
            good = [run for run in runs if run.posterior.quality is Quality.GOOD]
            draws = [run.posterior.draws["height"].values.ravel() for run in good]
            error = [abs(d.mean() / r.height - 1) for d, r in zip(draws, good, strict=True)]
            width = [
                np.ptp(np.quantile(d, (0.05, 0.95))) / r.height
                for d, r in zip(draws, good, strict=True)
            ]
            known = f"{100 * np.median(error):.1f} %, {np.median(width):.2f}" if good else ""
            seconds = np.median([run.seconds for run in runs])
            usual = max(set(left), key=left.count)
            lines.append(f"| {name} | {told} | {usual} | {seconds:.2f} | {len(good)} | {known} |")
    return lines


def second_stage(cells: int, kinds: int, size: int) -> list[str]:
    """Lines of the table of passes: cells that repeat a few estimates, one a pass."""
    found: list[Summary] = [
        summarise(estimate(clip_of("straight, shadow", seed, size), RippleSettings(), rng=seed))
        for seed in range(kinds)
    ]
    few = [[one] for one in found[:2]]
    fuse_cells(few, RippleSettings(), learn_survey(few, RippleSettings()))  # compiled before timing
    lines = []
    for passes in (1, 4):
        survey = [[found[(i + k) % len(found)] for k in range(passes)] for i in range(cells)]
        start = time.perf_counter()
        model = learn_survey(survey, RippleSettings())
        middle = time.perf_counter()
        fuse_cells(survey, RippleSettings(), model)
        ended = time.perf_counter()
        lines.append(f"| {cells} | {passes} | {middle - start:.2f} | {ended - middle:.2f} |")
    return lines


def floor_of(name: str, seed: int, size: int) -> np.ndarray:
    """Amplitude of a floor of one sediment, of four, or of two of one histogram."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size))
    if name == "two, by texture":
        # K of nu 2, its texture white on the left and 5 pixels long on the right
        white = ndtr(rng.normal(size=x.shape))
        smooth = gaussian_filter(rng.normal(size=x.shape), 5)
        uniform = np.where(x > size / 2, ndtr(smooth / smooth.std()), white)
        return np.sqrt(gammaincinv(2.0, uniform) / 2.0) * rng.rayleigh(1, x.shape)
    truth = (x > size / 2).astype(int) + 2 * (y > size / 2 + 20 * np.sin(x / 40))
    levels = np.array((1.0, 2.2, 0.4, 4.5))[truth] if name == "four" else 1.0
    return np.sqrt(levels) * k_distribution.rvs(20.0, size=truth.shape, random_state=rng)


def sediments(scenes: int, size: int) -> list[str]:
    """Lines of the table of sediments."""
    lines = []
    for name in ("one", "four", "two, by texture"):
        parts, counts, textured = [], [], 0
        for seed in range(scenes):
            reach = 4 + 0.005 * np.indices((size, size))[0]
            looks = [AmplitudeGrid(floor_of(name, seed, size), reach)]
            moments = [time.perf_counter()]
            classes = find_classes(looks)
            moments.append(time.perf_counter())
            likelihood = log_likelihoods(looks, classes)
            label = class_map(likelihood).label
            moments.append(time.perf_counter())
            refine_map(label, likelihood)
            moments.append(time.perf_counter())
            parts.append(np.diff(moments))
            counts.append(len(classes.laws))
            textured += classes.texture is not None
        seconds = " | ".join(f"{v:.2f}" for v in np.median(parts, axis=0))
        usual = max(set(counts), key=counts.count)
        lines.append(f"| {name} | {usual} | {textured} of {scenes} | {seconds} |")
    return lines


def main() -> None:
    """Print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one small clip of each kind")
    parser.add_argument("--clips", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    clips, size, cells = (1, 300, 20) if options.quick else (options.clips, 500, 2000)
    for settings in SETTINGS.values():  # compiles
        timed("bent, shadow", clip_of("bent, shadow", 99, size), settings, 0)
    tables = (
        ("cell | | left out | s | good | error, width of A_H", ripples(clips, size)),
        (
            "cells | passes | second stage learns, s | combines, s",
            second_stage(cells, min(clips + 1, 8), size),
        ),
        (
            "sediments | classes found | texture used | classes, s | map, s | refinement, s",
            sediments(max(clips // 2, 1), 512),
        ),
    )
    text = ""
    for head, lines in tables:
        rule = "|---" * (head.count("|") + 1) + "|"
        text += "\n".join([f"| {head} |", rule, *lines]) + "\n\n"
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "leaving_out.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
