"""The default method on stiff and extreme clips and priors.

    python pipelines/ripples/extremes.py

Every case must end in a finite estimate or the right quality code: no nan, no exception, no warning
from numpy.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sasmap.ripples import Clip, Posterior, Prior, RippleSettings, estimate
from sasmap.ripples.posterior import Quality
from sasmap.simulate import straight_clip

WIDE = RippleSettings()
BOUNDS = (WIDE.frequency, WIDE.height)
Case = tuple[Clip, Prior | None, set[Quality]]
GOOD = {Quality.GOOD}
TOLD = {Quality.GOOD, Quality.NOT_CONVERGED}
NONE = {Quality.NO_RIPPLES}
HIDDEN = {Quality.NOT_IDENTIFIABLE}
FEW = {Quality.TOO_FEW_PIXELS}


def ripples(frequency: float = 0.6, height: float = 0.07, **changes: float) -> Clip:
    """Straight ripples of 300 x 300 pixels of 4 cm."""
    options = {"pixel_size": 0.04, "shape": (300, 300), "near": 20.0, **changes}
    return straight_clip(np.random.default_rng(1), frequency=frequency, height=height, **options)


def holding(clip: Clip, change: Callable[[np.ndarray], np.ndarray]) -> Clip:
    """Return a clip with other amplitudes."""
    return replace(clip, amplitude=change(clip.amplitude))


def thinned(amplitude: np.ndarray) -> np.ndarray:
    """One pixel of a hundred."""
    return np.where(np.random.default_rng(2).random(amplitude.shape) < 0.99, np.nan, amplitude)


def cases() -> dict[str, Case]:
    """Clip, prior and the qualities that are right."""
    clip = ripples()
    far = {"pixel_size": 0.4, "near": 60.0, "altitude": 40.0}
    return {
        "A_H zero": (ripples(height=0.0), None, NONE),
        "A_H 1e-6 m": (ripples(height=1e-6), None, NONE),
        "A_H 1 mm": (ripples(height=1e-3), None, NONE | HIDDEN | TOLD),
        "f at its lower bound": (ripples(0.05, 0.3, **far), None, TOLD),
        "f at its upper bound": (ripples(5.0, 0.005, pixel_size=0.02), None, TOLD),
        "f at Nyquist": (ripples(12.5, 0.002), None, NONE | HIDDEN),
        "f beyond Nyquist (seen as 5)": (ripples(20.0, 0.002), None, TOLD | NONE | HIDDEN),
        "shadow from far before the clip": (ripples(near=120.0, altitude=5.0), None, TOLD),
        "shadow only far beyond the clip": (ripples(near=3.0, altitude=20.0), None, TOLD),
        "grazing 80 degrees": (ripples(near=0.9, altitude=20.0), None, TOLD | NONE | HIDDEN),
        "grazing 1 degree": (ripples(height=0.03, near=280.0), None, TOLD | NONE | HIDDEN),
        "look along the crests": (ripples(azimuth=0.0), None, NONE | HIDDEN),
        "look 1 degree off the crests": (ripples(azimuth=1.0), None, NONE | HIDDEN),
        "prior of width 1e-6": (clip, Prior((0.6, 0.07), (1e-6, 1e-6), BOUNDS), TOLD),
        "prior 100 sd above its bounds": (
            clip,
            Prior((0.6, 1.5), (0.2, 0.01), BOUNDS),
            TOLD,
        ),
        "prior of f 100 sd below its bounds": (
            clip,
            Prior((-1.0, 0.07), (0.0105, 0.1), BOUNDS),
            TOLD | NONE | HIDDEN,
        ),
        "clip of zeros": (holding(clip, lambda a: 0 * a), None, NONE),
        "clip of one value": (holding(clip, lambda a: 0 * a + 3), None, NONE),
        "3 x 3 pixels": (ripples(shape=(3, 3)), None, FEW),
        "1 x 500 pixels": (ripples(shape=(1, 500)), None, TOLD | NONE | HIDDEN),
        "500 x 1 pixels": (ripples(shape=(500, 1)), None, NONE | HIDDEN),
        "99 % nodata": (holding(clip, thinned), None, TOLD | NONE | HIDDEN),
        "all nodata": (holding(clip, lambda a: a * np.nan), None, FEW),
        "amplitudes of 1e-30": (holding(clip, lambda a: 1e-30 * a), None, TOLD),
        "amplitudes of 1e30": (holding(clip, lambda a: 1e30 * a), None, TOLD),
        "one pixel of 1e6 times the rest": (
            holding(clip, lambda a: np.where(np.arange(a.size).reshape(a.shape) == 777, 1e6, a)),
            None,
            TOLD | NONE | HIDDEN,
        ),
    }


def outcome(case: Case) -> Posterior:
    """Estimate a case; any warning is an error."""
    clip, prior, _ = case
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return estimate(clip, WIDE, rng=1, prior=prior)


def finite(posterior: Posterior) -> bool:
    """Whether all that a posterior holds is finite."""
    return not posterior.sampled or all(
        bool(np.isfinite(values).all())
        for values in (*posterior.draws.values(), *posterior.mean.values(), posterior.azimuth)
    )


def main() -> None:
    """Print the table."""
    print(f"{'case':36s} quality            f (cycles/m)        A_H (m)             right")
    for name, case in cases().items():
        posterior = outcome(case)
        right = posterior.quality in case[2] and finite(posterior)
        numbers = ""
        if posterior.sampled:
            mean, sd = posterior.mean, posterior.sd
            numbers = (
                f"{float(mean.frequency):.5f} ± {float(sd.frequency):.1e}  "
                f"{float(mean.height):.5f} ± {float(sd.height):.1e}"
            )
        print(f"{name:36s} {posterior.quality.name.lower():18s} {numbers:40s} {right}", flush=True)


if __name__ == "__main__":
    main()
