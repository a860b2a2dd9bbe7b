"""Estimate the clips in a folder with whichever sasmap is on the path: a worker of versions.py.

    python pipelines/studies/estimate_folder.py FOLDER ROWS.csv

Uses only what every version's public interface has.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import numpy as np

from sasmap.ripples import Clip, Quality, RippleSettings, estimate

NAN = float("nan")


def estimate_clip(path: Path) -> dict[str, object]:
    """Estimate a clip that versions.py wrote, with default settings."""
    stored = np.load(path)
    arrays = (stored["amplitude"].astype(float), *(stored[n] for n in ("x", "y", "ground_range")))
    same = (np.full(arrays[0].shape, float(stored[n])) for n in ("altitude", "look_azimuth"))
    clip = Clip(*arrays, *same, float(stored["pixel_size"]))
    seed = int(stored["seed"])
    start = time.perf_counter()
    posterior = estimate(clip, RippleSettings(), rng=seed)
    row: dict[str, object] = {
        "seed": seed,
        "quality": Quality(posterior.quality).label,
        "seconds": time.perf_counter() - start,
    }
    for name in ("frequency", "height"):
        truth = float(stored[f"true_{name}"])
        sampled = posterior.draws is not None and name in posterior.draws
        draws = np.asarray(posterior.draws[name]).ravel() if sampled else np.full(2, NAN)
        low, high = np.quantile(draws, (0.05, 0.95))
        row |= {
            f"true_{name}": truth,
            f"{name}_mean": draws.mean(),
            f"{name}_sd": draws.std(),
            f"{name}_low": low,
            f"{name}_high": high,
            f"{name}_rank": np.mean(draws < truth) if sampled else NAN,
        }
    return row


def main() -> None:
    """Write a row a clip."""
    folder, output = Path(sys.argv[1]), Path(sys.argv[2])
    paths = sorted(folder.glob("*.npz"))
    estimate_clip(paths[0])  # compiles
    rows = [estimate_clip(path) for path in paths]
    with open(output, "w", newline="", encoding="utf-8") as stream:
        written = csv.DictWriter(stream, list(rows[0]))
        written.writeheader()
        written.writerows(rows)


if __name__ == "__main__":
    main()
