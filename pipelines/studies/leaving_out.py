"""What leaving out saves, and that it changes nothing: scenes that need nothing, one thing, all.

    python pipelines/studies/leaving_out.py [--quick] [--clips 20] [--output docs/studies]

Clips of 500 x 500 pixels: flat; straight ripples without shadow; with shadow; with shadow and bent
crests. Each is estimated as it is (the method leaves out what the clip does not need and says so)
and with the modelled image as well. Told are
seconds, what was left out, and by how many standard deviations f and A_H differ. For sediments: one
floor and four; where there is one, nothing is refined. Writes leaving_out.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from sasmap.ripples import Posterior, RippleSettings, estimate
from sasmap.ripples.posterior import LeftOut
from sasmap.sediments import k_distribution
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.mapping import refine_map
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.trends import Look
from sasmap.simulate import Scene, simulate_clip

AS_IT_IS = RippleSettings()
EVERYTHING = RippleSettings(keep_model=True)
SCENES = {
    "flat": None,
    "straight, no shadow": {"height": 0.03, "distance": 16},
    "straight, shadow": {"height": 0.07, "distance": 35},
    "bent, shadow": {"height": 0.07, "distance": 35, "wander": 1.5, "wander_length": 4.0},
}


def clip_of(name: str, seed: int) -> object:
    """Simulate a clip of a scene."""
    about = dict(SCENES[name] or {"height": 1e-6, "distance": 25})
    distance = about.pop("distance")
    patch = {"frequency": 0.7, "azimuth": 85, "phase": float(seed), **about}
    scene = Scene.model_validate(
        {
            "name": name, "seed": seed, "origin": (500000, 3300000), "size": (12.5, 12.5),
            "pixel_size": 0.025, "sediments": [{"name": "sand"}],
            "ripples": [patch] if SCENES[name] else [],
            "passes": [{"name": "one", "heading": 0, "distance": distance, "altitude": 5}],
        }
    )  # fmt: skip
    return simulate_clip(scene, np.random.default_rng(seed)).clip


def timed(clip: object, settings: RippleSettings, seed: int) -> tuple[Posterior, float]:
    """Estimate a clip; seconds as well."""
    start = time.perf_counter()
    posterior = estimate(clip, settings, rng=seed)  # type: ignore[arg-type]
    return posterior, time.perf_counter() - start


def ripples(clips: int) -> list[str]:
    """Lines of the table of ripples."""
    lines = []
    for name in SCENES:
        every, all_of_it, apart, left = [], [], [], []
        for seed in range(clips):
            clip = clip_of(name, seed)
            one, seconds = timed(clip, AS_IT_IS, seed)
            other, more = timed(clip, EVERYTHING, seed)
            every.append(seconds)
            all_of_it.append(more)
            names = (str(f.name).lower().replace("_", " ") for f in LeftOut if f in one.left_out)
            left.append(", ".join(names) or "nothing")
            if one.sampled and other.sampled:
                both = [
                    abs(float(one.mean[k] - other.mean[k])) / float(one.sd[k])
                    for k in ("frequency", "height")
                ]
                apart.append(max(both))
        usual = max(set(left), key=left.count)
        change = f"{np.median(apart):.2f}, at most {max(apart):.2f} sd" if apart else "no ripples"
        lines.append(
            f"| {name} | {usual} | {np.median(every):.2f} | {np.median(all_of_it):.2f} | {change} |"
        )
    return lines


def sediments(scenes: int) -> list[str]:
    """Lines of the table of sediments."""
    lines = []
    for name, levels in (("one sediment", (1.0,)), ("four", (1.0, 2.2, 0.4, 4.5))):
        seconds, lines_found, refined = [], [], []
        for seed in range(scenes):
            rng = np.random.default_rng(seed)
            y, x = np.indices((512, 512))
            truth = (x > 256).astype(int) + 2 * (y > 256 + 20 * np.sin(x / 40))
            truth = truth if len(levels) > 1 else np.zeros_like(truth)
            speckle = k_distribution.rvs(20.0, size=truth.shape, random_state=rng)
            looks = [Look(np.sqrt(np.array(levels)[truth]) * speckle, 4 + 0.005 * y)]
            start = time.perf_counter()
            classes = find_classes(looks)
            likelihood = log_likelihoods(looks, classes)
            found = class_map(likelihood)
            middle = time.perf_counter()
            result = refine_map(found.label, likelihood)
            refined.append(time.perf_counter() - middle)
            seconds.append(middle - start)
            lines_found.append(len(result.lines))
        lines.append(
            f"| {name} | {np.median(seconds):.2f} | {np.median(refined):.3f} | "
            f"{np.median(lines_found):.0f} |"
        )
    return lines


def main() -> None:
    """Print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--clips", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    clips = 2 if options.quick else options.clips
    timed(clip_of("bent, shadow", 99), EVERYTHING, 0)  # compiles
    text = "| clip | left out | s | s with everything | change of f, A_H |\n|---|---|---|---|---|\n"
    text += "\n".join(ripples(clips)) + "\n\n"
    text += "| map of 512 x 512 pixels | classes and map, s | refinement, s | lines |\n"
    text += "|---|---|---|---|\n" + "\n".join(sediments(clips)) + "\n"
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "leaving_out.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
