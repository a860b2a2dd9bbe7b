"""Independent beds: floors that are not sines, rendered by the coherent simulator.

    python pipelines/studies/beds.py [--quick] [--each 6] [--workers 1] [--output docs/studies]

Needs pybedforms (``pip install -e '.[studies]'``). Five of Rubin's bedforms by pybedforms (USGS
Bedforms 4.0 in Python, written by others), random seas by spectrum, ripple fields with defects (a
Gaussian field's phase, after Tang et al. 2009), triangular profiles and large ripples with small
ones on them; nowhere steeper than the angle of repose. The truth is measured from the heights: f
at the peak of the bed's spectrum, A_H as half of the median height from trough to crest of its
waves; the significant height (mean of the highest third) is kept beside it. Five scattering laws in
turn, 4 to 35 m of range, looks up to 40 degrees off the crest normal, 500 x 500 pixels of 2.5 cm.
Writes beds.csv.
"""

from __future__ import annotations

import argparse
import sys
import types
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from heightfields import Grid, grid_around, image, measure
from judged import estimated, print_table, write_rows
from numpy.typing import NDArray

from sasmap.simulate.laws import Law, PowerLaw

# pybedforms draws with Mayavi and imports it with everything else; nothing is drawn here
sys.modules.setdefault("mayavi", types.ModuleType("mayavi")).__dict__.setdefault("mlab", None)
from pybedforms.dune_topo import DuneTopo  # noqa: E402

FloatArray = NDArray[np.float64]
Maker = Callable[[np.random.Generator, FloatArray, FloatArray], FloatArray]

PIXEL = 0.025
LAWS: tuple[Law | PowerLaw, ...] = (
    "lambert", "gaussian", PowerLaw(exponent=1.0), "rough", "volume",
)  # fmt: skip
# Tangent of the angle of repose of wet sand, and the share of a floor that may be steeper.
REPOSE, STEEPER = float(np.tan(np.radians(34.0))), 1e-3
# Plane waves in a random sea.
WAVES = 200


def rubin(rng: np.random.Generator, u: FloatArray, v: FloatArray, **changed: float) -> FloatArray:
    """Bedforms of pybedforms at points along and across the mean normal, in wavelengths."""
    # a wavelength of 10 of its units; sets to be seen in plan, so nothing is deposited
    bed = DuneTopo(SPCNGF=10.0, TRENDF=0.0, DEPRAT=0.0, ELVMIN=changed.pop("ELVMIN", -9.0))
    for name, value in changed.items():
        setattr(bed, name, value)
    if bed.SPCNGS:
        bed.SD = 100 / bed.SPCNGS
    bed.PHASEF = rng.uniform(0, 360)
    bed.x, bed.y = 10 * u, 10 * v
    bed.run(0)
    return np.asarray(bed.TOPO) / 10


def asymmetric(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Straight and asymmetric."""
    return rubin(rng, u, v, SMTRYF=float(rng.uniform(0, 0.6)))


def sinuous(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Crests that wind by a quarter of a wavelength."""
    return rubin(rng, u, v, SNSPF1=float(rng.uniform(30, 60)), SNMGF1=float(rng.uniform(1, 2.5)))


def flat_troughs(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Bedforms with flats between them."""
    return rubin(rng, u, v, ELVMIN=float(rng.uniform(-0.3, 0.0)))


def two_sets(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Cross the first set with a lower one."""
    turn = float(rng.uniform(40, 80))
    return rubin(rng, u, v, SPCNGS=7.0, HTRTOS=0.4, TRENDS=turn, SMTRYS=1.0)


def superposed(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Small bedforms that are highest in the troughs of the large ones (Rubin's type 2)."""
    return rubin(rng, u, v, SPCNGS=4.0, HTRTOS=0.5, TRENDS=60.0, SMTRYS=1.0, TYPE=2)


def sea(
    rng: np.random.Generator, u: FloatArray, v: FloatArray, width: float, spread: float
) -> FloatArray:
    """Real part of :func:`complex_sea`."""
    return np.asarray(complex_sea(rng, u, v, width, spread).real)


def complex_sea(
    rng: np.random.Generator, u: FloatArray, v: FloatArray, width: float, spread: float
) -> NDArray[np.complex128]:
    """Sum plane waves of random phase about the mean one.

    Parameters
    ----------
    rng : Generator
    u, v : ndarray
        Along and across the mean normal, wavelengths.
    width : float
        Standard deviation of the wave number over its mean.
    spread : float
        Standard deviation of the direction, degrees.

    Returns
    -------
    ndarray of complex
    """
    number = 2 * np.pi * np.maximum(1 + width * rng.normal(size=WAVES), 0.2)
    turn = np.radians(spread) * rng.normal(size=WAVES)
    offset = rng.uniform(0, 2 * np.pi, WAVES)
    total = np.zeros(np.broadcast(u, v).shape, complex)
    for k, t, o in zip(number, turn, offset, strict=True):
        total += np.exp(1j * (k * (np.cos(t) * u + np.sin(t) * v) + o))
    return total / np.sqrt(WAVES)


def defects(
    rng: np.random.Generator, u: FloatArray, v: FloatArray, width: float, spread: float
) -> FloatArray:
    """Crests of even height that fork and end where a Gaussian field has no phase."""
    field = complex_sea(rng, u, v, width, spread)
    return np.asarray(field.real / np.sqrt(np.abs(field) ** 2 + 0.05))


def triangular(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Straight flanks, 30 to 50 % of the wave from trough to crest, edges slightly rounded."""
    share = rng.uniform(0.3, 0.5)
    share = share if rng.random() < 0.5 else 1 - share
    k = np.arange(1, 9)
    # Fourier series of a triangle, damped
    size = np.sin(np.pi * k * share) / (k**2 * share * (1 - share)) * np.exp(-((k / 6) ** 2))
    phase = 2 * np.pi * (u + rng.random())
    return np.asarray(sum(s * np.sin(n * phase) for n, s in zip(k, size, strict=True)))


def large_and_small(rng: np.random.Generator, u: FloatArray, v: FloatArray) -> FloatArray:
    """Ripples of a sixth of the wavelength and the height on large ones."""
    large = np.sin(2 * np.pi * u + rng.uniform(0, 2 * np.pi))
    return large + sea(rng, 6 * u, 6 * v, 0.05, 10.0) / 6


KINDS: dict[str, Maker] = {
    "Rubin, asymmetric": asymmetric,
    "Rubin, sinuous": sinuous,
    "Rubin, flat troughs": flat_troughs,
    "Rubin, two sets": two_sets,
    "Rubin, superposed": superposed,
    "narrow sea": partial(sea, width=0.04, spread=3.0),
    "wide sea": partial(sea, width=0.12, spread=8.0),
    "short-crested sea": partial(sea, width=0.08, spread=20.0),
    "few defects": partial(defects, width=0.04, spread=4.0),
    "many defects": partial(defects, width=0.08, spread=8.0),
    "triangular": triangular,
    "large and small": large_and_small,
}


def height_of(
    kind: str, rng: np.random.Generator, grid: Grid, size: int
) -> tuple[FloatArray, dict[str, float]]:
    """Draw a floor of a kind and measure it.

    Parameters
    ----------
    kind : str
        Of KINDS.
    rng : Generator
    grid : Grid
    size : int
        Of the clip, pixels.

    Returns
    -------
    height : ndarray (n, n)
        m.
    truth : dict
        ``frequency`` (cycles/m), ``height`` and ``significant`` (half from trough to crest, m).
    """
    extent = size * grid.step
    off_look = np.radians(rng.uniform(-40, 40))
    frequency = rng.uniform(8.5, 13) / extent / np.cos(off_look)
    # median steepness from trough to crest 0.05 to 0.14: wave ripples have 0.1 to 0.2
    wanted = rng.uniform(0.05, 0.14) / frequency
    kx, ky = frequency * np.cos(off_look), frequency * np.sin(off_look)
    u = kx * grid.x + ky * grid.y[:, None]
    v = -ky * grid.x + kx * grid.y[:, None]
    height = KINDS[kind](rng, u, v)
    height = height - height.mean()
    slope = np.hypot(*np.gradient(height, grid.step))
    steepest = REPOSE / float(np.quantile(slope, 1 - STEEPER))
    scale = min(wanted / measure(grid, height, size).median, steepest)
    bed = measure(grid, scale * height, size)
    truth = {
        "frequency": bed.frequency,
        "height": 0.5 * bed.median,
        "significant": 0.5 * bed.significant,
    }
    return scale * height, truth


def one(place: tuple[str, int], size: int) -> dict[str, Any]:
    """Render and estimate one floor; a row of the table."""
    kind, seed = place
    rng = np.random.default_rng([seed, list(KINDS).index(kind), 2512])
    grid = grid_around(size, PIXEL)
    height, truth = height_of(kind, rng, grid, size)
    law = LAWS[(seed + list(KINDS).index(kind)) % len(LAWS)]
    near, altitude = rng.uniform(4, 35), rng.uniform(3, 8)
    clip = image(
        rng, grid, height, size, near=near, altitude=altitude, law=law,
        noise=rng.uniform(-30, -18), blur=rng.uniform(0.4, 0.8),
        range_flattened=bool(rng.random() < 0.5),
    )  # fmt: skip
    name = law if isinstance(law, str) else f"sine^{law.exponent:g}"
    about = {"kind": kind, "seed": seed, "law": name, "near": near, "altitude": altitude}
    row = about | estimated(clip, truth["frequency"], truth["height"], seed)
    return row | {"true_significant": truth["significant"]}


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one small floor of each kind")
    parser.add_argument("--each", type=int, default=6, help="floors of each kind")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    size, each = (200, 1) if options.quick else (500, options.each)
    places = [(kind, seed) for kind in KINDS for seed in range(each)]
    if options.workers > 1:
        with ProcessPoolExecutor(options.workers) as pool:
            rows = list(pool.map(partial(one, size=size), places))
    else:
        rows = [one(place, size) for place in places]
    write_rows(options.output / "beds.csv", rows)
    print_table(rows, ("kind", "law"))


if __name__ == "__main__":
    main()
