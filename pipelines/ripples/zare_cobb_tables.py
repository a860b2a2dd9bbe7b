"""Mean squared errors of f and A_H on the clips of Zare and Cobb's tables 1 to 3.

    python pipelines/ripples/zare_cobb_tables.py [--clips 50] [--shadow RULE]
                                                 [--method default|zare-cobb]

Each entry simulates that many clips of Rayleigh speckle over straight sine ripples (ZC 4.1) and
estimates them with everything unknown. The shadow rule is the same in simulation and estimate.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from sasmap.ripples import Clip, RippleSettings, estimate
from sasmap.simulate.scattering import lit_amplitude, shadow_crest_rule, shadow_line_of_sight

ALTITUDE = 4.83
# near and far range (m), f (cycles/m), A_H (m), and the printed squared errors of f and A_H
ENTRIES = (
    (24.4, 36.6, 0.4, 0.07, 3e-5, 0.806),
    (24.4, 36.6, 0.5, 0.07, 3e-5, 0.303),
    (24.4, 36.6, 0.6, 0.07, 1e-6, 0.002),
    (24.4, 36.6, 0.7, 0.07, 1e-6, 0.002),
    (24.4, 36.6, 0.6, 0.06, 1e-5, 0.13),
    (24.4, 36.6, 0.6, 0.07, 1e-5, 0.002),
    (24.4, 36.6, 0.6, 0.08, 1e-5, 0.002),
    (24.4, 36.6, 0.6, 0.09, 1e-5, 0.004),
    (1.2, 13.4, 0.6, 0.07, 0.34, 0.24),
    (12.2, 24.4, 0.6, 0.07, 8e-5, 0.62),
    (24.4, 36.6, 0.6, 0.07, 1e-5, 0.001),
    (36.6, 48.2, 0.6, 0.07, 6e-6, 0.002),
)
FINE = 40
SIZE = 500


def simulate_clip(
    near: float, far: float, frequency: float, height: float, shadow: str, seed: int
) -> Clip:
    """One clip of ZC 4.1: phase zero at the track, Rayleigh speckle of parameter 100."""
    step = (far - near) / SIZE
    r = near + step * (np.arange(SIZE) + 0.5)
    phase = 2 * np.pi * frequency * r
    lit = lit_amplitude(np.arctan2(ALTITUDE, r), np.cos(phase), 1.0, 2 * np.pi * frequency * height)
    if shadow == "crest":
        hidden = shadow_crest_rule(phase, r, ALTITUDE, frequency, height)
    else:
        before = (int(SIZE / (frequency * (far - near))) + 1) * FINE
        fine = r[0] + step / FINE * np.arange(-before, FINE * SIZE)
        ahead = fine > 1e-3
        floor = height * np.sin(2 * np.pi * frequency * fine[ahead])
        every = np.zeros(fine.size, bool)
        every[ahead] = shadow_line_of_sight(floor, fine[ahead], ALTITUDE)
        hidden = every[before::FINE]
    rng = np.random.default_rng(seed)
    amplitude = np.where(hidden, 0.0, lit) * rng.rayleigh(100.0, (SIZE, SIZE))
    x = np.broadcast_to(r, amplitude.shape)
    y = np.broadcast_to(step * np.arange(SIZE)[::-1, None], amplitude.shape)
    altitude = np.full(amplitude.shape, ALTITUDE)
    return Clip(amplitude, x, y, x, altitude, np.full(amplitude.shape, 90.0), step)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=50)
    parser.add_argument("--method", choices=("default", "zare-cobb"), default="default")
    parser.add_argument("--shadow", choices=("crest", "line-of-sight"), default="crest")
    options = parser.parse_args()
    bounds = {"frequency": (0, 1), "height": (0, 1)} if options.method == "zare-cobb" else {}
    settings = RippleSettings(
        method=options.method, shadow=options.shadow, scattering="zare-cobb", **bounds
    )
    print(f"method {options.method}, shadow {options.shadow}, {options.clips} clips an entry")
    print("   range (m)    f   A_H |  MSE f  (printed) | MSE A_H (printed) | good  s/clip")
    for near, far, frequency, height, printed_f, printed_height in ENTRIES:
        errors, seconds, good = [], [], 0
        for seed in range(options.clips):
            clip = simulate_clip(near, far, frequency, height, options.shadow, seed)
            start = time.perf_counter()
            posterior = estimate(clip, settings, rng=seed)
            seconds.append(time.perf_counter() - start)
            good += posterior.quality == 1
            if posterior.sampled:
                mean = posterior.mean
                errors.append([float(mean.frequency) - frequency, float(mean.height) - height])
        f, h = (np.array(errors) ** 2).mean(axis=0)
        missing = options.clips - len(errors)
        lost = f"  {missing} not found" if missing else ""
        print(
            f"{near:5.1f} - {far:4.1f}  {frequency:.1f}  {height:.2f} | {f:.1e} ({printed_f:.0e}) "
            f"| {h:.1e} ({printed_height:.0e}) | {good:3d}   {np.median(seconds):.2f}{lost}",
            flush=True,
        )


if __name__ == "__main__":
    main()
