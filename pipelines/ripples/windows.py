"""One bed cut into cells of several sizes: f and A_H should not depend on the size.

    python pipelines/ripples/windows.py [--size 1000] [--windows 500,333,250,160] [--seed 1]

A bed with wandering crests is rendered by the coherent simulator, cut into cells of each window and
estimated as a survey of one pass: each cell by itself, then all of a window's cells together. For
every window the number of good cells, the medians of f and A_H over the bed's, and how often its
A_H lies in the 90 % interval.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace

import numpy as np

from sasmap.passes.fusion import FusedCell, fuse_cells, learn_survey
from sasmap.passes.summary import summarise
from sasmap.ripples import Clip, Quality, RippleSettings, estimate
from sasmap.simulate import coherent_cell

PIXEL = 0.025
NAMES = ("mean", "q05", "q95")
ARRAYS = [f.name for f in fields(Clip) if f.name not in ("pixel_size", "altitude_sd")]


def cells_of(clip: Clip, window: int) -> list[Clip]:
    """Whole cells of a clip, row by row."""
    rows, columns = (n // window for n in clip.amplitude.shape)
    squares = [
        np.s_[r * window : (r + 1) * window, c * window : (c + 1) * window]
        for r in range(rows)
        for c in range(columns)
    ]
    return [replace(clip, **{n: getattr(clip, n)[s] for n in ARRAYS}) for s in squares]


def estimated(clip: Clip, window: int, seed: int) -> list[FusedCell]:
    """Cells of a window, estimated as those of a survey."""
    settings = RippleSettings()
    looks = [[summarise(estimate(c, settings, rng=seed))] for c in cells_of(clip, window)]
    return fuse_cells(looks, settings, learn_survey(looks, settings, seed))


def main() -> None:
    """Print one line per window."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=1000, help="pixels a side of the bed")
    parser.add_argument("--windows", default="500,333,250,160")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--near", type=float, default=12.0)
    parser.add_argument("--frequency", type=float, default=1.2)
    parser.add_argument("--height", type=float, default=0.03)
    options = parser.parse_args()
    made = coherent_cell(
        np.random.default_rng(options.seed), frequency=options.frequency, height=options.height,
        azimuth_off_look=20.0, near=options.near, pixel_size=PIXEL,
        shape=(options.size, options.size), wander=0.6, wander_length=6.0, profile="stokes",
    )  # fmt: skip
    truth = made.frequency, made.height
    print(f"bed: f {truth[0]:.4f} cycles/m, A_H {truth[1]:.4f} m")
    for window in (int(w) for w in options.windows.split(",")):
        cells = estimated(made.clip, window, options.seed)
        good = [c.final for c in cells if c.quality is Quality.GOOD]
        found = sum(c.quality in (Quality.GOOD, Quality.NOT_CONVERGED) for c in cells)
        parts = [f"window {window}: {len(cells)} cells, {found} rippled, {len(good)} good"]
        for i, name in enumerate(("f", "A_H")):
            if not good:
                break
            mean, low, high = (np.array([getattr(c, s)[i] for c in good]) for s in NAMES)
            parts.append(f"{name}: median {np.median(mean) / truth[i]:.4f} of the bed's")
            if name == "A_H":  # f differs from place to place where crests wander
                inside = float(np.mean((low < truth[i]) & (truth[i] < high)))
                width = np.median((high - low) / mean)
                parts.append(f"90 % interval {width:.3f} wide, holds it in {inside:.0%}")
        print("; ".join(parts), flush=True)


if __name__ == "__main__":
    main()
