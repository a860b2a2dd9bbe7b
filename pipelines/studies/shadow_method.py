"""The quantities of Jones and Traykovski (2018), on simulated floors like theirs.

    python pipelines/studies/shadow_method.py [--quick] [--cells 12] [--output docs/studies]

They measure height and asymmetry of bedforms by the shadows in a rotary sidescan sonar's image, and
compare with sonars that measure bathymetry beside it: heights agree by 34.0 +- 27.2 % for
wave-orbital ripples (wavelengths 0.3 to 0.8 m) and 16.6 +- 14.7 % for megaripples (5 to 8 m),
asymmetry by 1.9 +- 2.1 % and 11.2 +- 9.6 %. Here the same two kinds of bedforms are rendered by
the coherent simulator under five laws: flanks of half a cosine each, ripples of 0.11 of their
wavelength seen from 1.15 m above (their sensitivity study's numbers), megaripples of 0.05 to 0.1,
both even and with bedforms that each have a wavelength of their own (standard deviation 15 %).
Asymmetry is the share of a wavelength from trough to crest, 0.5 where symmetric, so errors are told
in percent of the wavelength, as theirs are. Not comparable: their truth is itself measured,
elsewhere on the bed; here it is known, and the image is georeferenced without error. Writes
shadow_method.csv.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from heightfields import grid_around, image, measure
from judged import is_good, values, write_rows
from numpy.typing import NDArray

from sasmap.ripples import Posterior, RippleSettings, estimate
from sasmap.simulate.laws import Law, PowerLaw

FloatArray = NDArray[np.float64]

LAWS: tuple[Law | PowerLaw, ...] = (
    "lambert", "gaussian", PowerLaw(exponent=1.0), "rough", "volume",
)  # fmt: skip
NAN = float("nan")
# Draws of which the profile is traced.
DRAWS = 200


class Kind(NamedTuple):
    """Bedforms of a kind and how they are seen.

    Attributes
    ----------
    wavelength, steepness, asymmetry, near : tuple of float
        Bounds: m, height over wavelength, share from trough to crest, m.
    altitude, pixel : float
        m.
    uneven : float
        Standard deviation of single wavelengths over their mean.
    """

    wavelength: tuple[float, float]
    steepness: tuple[float, float]
    asymmetry: tuple[float, float]
    near: tuple[float, float]
    altitude: float
    pixel: float
    uneven: float


RIPPLES = Kind((0.3, 0.8), (0.11, 0.11), (0.45, 0.55), (2.0, 12.0), 1.15, 0.0125, 0.0)
MEGARIPPLES = Kind((5.0, 8.0), (0.05, 0.1), (0.35, 0.65), (8.0, 30.0), 4.0, 0.12, 0.0)
KINDS = {
    "ripples, even": RIPPLES,
    "ripples, uneven": RIPPLES._replace(uneven=0.15),
    "megaripples, even": MEGARIPPLES,
    "megaripples, uneven": MEGARIPPLES._replace(uneven=0.15),
}
PUBLISHED = {"ripples": ("34.0 ± 27.2", "1.9 ± 2.1"), "megaripples": ("16.6 ± 14.7", "11.2 ± 9.6")}


def bedforms(
    rng: np.random.Generator, kind: Kind, length: float, distance: FloatArray, across: FloatArray
) -> FloatArray:
    """Lay bedforms along a distance, m: each has its wavelength, all one steepness and asymmetry.

    Parameters
    ----------
    rng : Generator
    kind : Kind
    length : float
        Mean wavelength, m.
    distance, across : ndarray
        Along and across the mean crest normal, m. Crests wander by a tenth of a wavelength.

    Returns
    -------
    ndarray
        Height, m.
    """
    count = int(np.ptp(distance) / length * 1.5) + 10
    lengths = length * np.clip(1 + kind.uneven * rng.normal(size=count), 0.5, 1.5)
    starts = distance.min() - 4 * length + np.concatenate([[0.0], np.cumsum(lengths)])
    place = distance + 0.1 * length * np.sin(across / length + rng.uniform(0, 2 * np.pi))
    which = np.clip(np.searchsorted(starts, place, side="right") - 1, 0, count - 1)
    share = (place - starts[which]) / lengths[which]
    rise = rng.uniform(*kind.asymmetry)
    rising = share < rise
    turn = np.where(rising, share / rise, 1 + (share - rise) / (1 - rise))
    height = rng.uniform(*kind.steepness) * lengths[which]
    # every trough lies at the same level
    return np.asarray(0.5 * height * (1 - np.cos(np.pi * turn)))


def rises_of(posterior: Posterior) -> FloatArray:
    """Share of a wavelength from trough to crest, in the direction of the look, of some draws.

    Parameters
    ----------
    posterior : Posterior
        With ``peakedness`` p and ``asymmetry`` q of the profile sin(x) - p cos(2x) - q sin(2x).

    Returns
    -------
    ndarray (draws,)
    """
    flat = [posterior.draws[n].values.ravel() for n in ("peakedness", "asymmetry")]
    p, q = (v[:: max(len(v) // DRAWS, 1), None] for v in flat)
    x = np.linspace(0, 2 * np.pi, 721)[:-1]
    profile = np.sin(x) - p * np.cos(2 * x) - q * np.sin(2 * x)
    crest, trough = x[profile.argmax(axis=1)], x[profile.argmin(axis=1)]
    return np.asarray(((crest - trough) % (2 * np.pi)) / (2 * np.pi))


def one(name: str, seed: int, size: int) -> dict[str, Any]:
    """Render and estimate a floor; a row of the table."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, list(KINDS).index(name), 2018])
    grid = grid_around(size, kind.pixel)
    length = rng.uniform(*kind.wavelength)
    turn = np.radians(rng.uniform(-30, 30))
    y = grid.y[:, None]
    along = grid.x * np.cos(turn) + y * np.sin(turn)
    across = -grid.x * np.sin(turn) + y * np.cos(turn)
    height = bedforms(rng, kind, length, along, across)
    height -= height.mean()
    truth = measure(grid, height, size)
    clip = image(
        rng, grid, height, size, near=rng.uniform(*kind.near), altitude=kind.altitude,
        law=LAWS[seed % len(LAWS)], noise=-25.0, blur=0.5, range_flattened=False,
    )  # fmt: skip
    posterior = estimate(clip, RippleSettings(), rng=seed)
    row = {
        "kind": name,
        "seed": seed,
        "quality": posterior.quality.label,
        "true_frequency": truth.frequency,
        "true_height": 0.5 * truth.median,
        "true_rise": float(np.median(truth.rises)),
    }
    if not posterior.sampled:
        return row | dict.fromkeys(("frequency", "height", "height_rank", "rise", "rise_rank"), NAN)
    height_draws, rises = posterior.draws["height"].values.ravel(), rises_of(posterior)
    return row | {
        "frequency": float(posterior.mean.frequency),
        "height": height_draws.mean(),
        "height_rank": np.mean(height_draws < row["true_height"]),
        "rise": rises.mean(),
        "rise_rank": np.mean(rises < row["true_rise"]),
    }


def line(name: str, rows: list[dict[str, Any]]) -> str:
    """One line of the table, as Markdown."""
    good = [row for row in rows if is_good(row)]
    cells = [name, str(len(rows)), str(len(good))]
    if good:
        truth = values(good, "true_height")
        height = 100 * np.abs(values(good, "height") / truth - 1)
        rise = 100 * np.abs(values(good, "rise") - values(good, "true_rise"))
        for error, rank in ((height, "height_rank"), (rise, "rise_rank")):
            within = np.abs(values(good, rank) - 0.5) < 0.45
            cells += [
                f"{error.mean():.1f} ± {error.std():.1f}",
                f"{np.median(error):.1f}",
                f"{100 * within.mean():.0f}",
            ]
    else:
        cells += [""] * 6
    cells += PUBLISHED[name.split(",")[0]]
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| bedforms | floors | good | height: error, % | median | in its 90 % interval, % | asymmetry: "
    "error, % | median | in its 90 % interval, % | published: height, % | asymmetry, % |\n"
    + "|---" * 11
    + "|"
)


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one small floor of each kind")
    parser.add_argument("--cells", type=int, default=12, help="floors of each kind")
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    size, cells = (200, 1) if options.quick else (500, options.cells)
    rows = [one(name, seed, size) for name in KINDS for seed in range(cells)]
    write_rows(options.output / "shadow_method.csv", rows)
    print(HEAD)
    for name in KINDS:
        print(line(name, [row for row in rows if row["kind"] == name]))


if __name__ == "__main__":
    main()
