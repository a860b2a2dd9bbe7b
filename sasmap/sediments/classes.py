"""Sediment classes of a survey, and areas too dark to be sediment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from sasmap.arrays import BoolArray, FloatArray
from sasmap.numerics.looks import effective_samples
from sasmap.sediments.bands import Bands
from sasmap.sediments.fitting import Law, choose
from sasmap.sediments.floor import Flat, pixels_of
from sasmap.sediments.texture import Texture
from sasmap.sediments.trends import BLOCK, AmplitudeGrid, Blocks, Real, log_cotangent, trend_of

# Log amplitude below the survey's median (14 dB) and, where sediments are known, below the darkest
# one (5 dB) at which a block is not sediment; minimum number of such blocks to fit their law.
DARK, DARKER, LEAST_DARK = 1.6, 0.58, 4


@dataclass(frozen=True)
class Classes:
    """Sediment classes of a survey.

    Attributes
    ----------
    laws : tuple of Law
        In order of rising mean intensity where found by clustering, so that numbers are stable.
    trends : ndarray (looks, 3)
        Log gain of each look, and its slope and bend with the log cotangent of the
        grazing angle about `centre`.
    centre : float
        Log of a cotangent.
    noise_factor : float
        Pixels per independent sample.
    dark : Law or None
        Law of areas too dark to be sediment: shadow, water column.
    texture : Texture or None
        Laws at several scales, where amplitude alone does not separate the classes.
    bands : Bands or None
        Gain by range that would otherwise appear as sediments that no two looks confirm.
    """

    laws: tuple[Law, ...]
    trends: FloatArray
    centre: float
    noise_factor: float
    dark: Law | None = None
    texture: Texture | None = None
    bands: Bands | None = None

    @property
    def every(self) -> tuple[Law, ...]:
        """Laws of the classes, followed by that of areas that are not sediment."""
        return self.laws if self.dark is None else (*self.laws, self.dark)

    @property
    def ranged(self) -> bool:
        """Whether gain depends on slant range, so that altitudes are required."""
        return self.bands is not None and self.bands.ranged

    def log_trend(
        self, look: int, cotangent: NDArray[Real], altitude: NDArray[Real] | None = None
    ) -> NDArray[Real]:
        """Log amplitude contributed by a look's gain, trend and bands.

        Parameters
        ----------
        look : int
        cotangent : ndarray
            Of the grazing angle.
        altitude : ndarray, optional
            m.

        Returns
        -------
        ndarray
        """
        place: NDArray[Real] = np.asarray(log_cotangent(cotangent) - self.centre, cotangent.dtype)
        gain = trend_of(self.trends[look], place)
        if self.bands is not None:
            gain += self.bands.of(look, cotangent, altitude)
        return gain


def log_moments(law: Law) -> tuple[float, float]:
    """Return the mean and the log variance of a law's log amplitude."""
    t = np.log(law.mean_square) / 2 + np.linspace(-14, 5, 2000)
    weight = np.exp(law.log_density(np.exp(t)) + t)
    weight /= weight.sum()
    mean = float(weight @ t)
    return mean, float(np.log(weight @ (t - mean) ** 2))


def dark_blocks(blocks: list[Blocks], trends: FloatArray, laws: Sequence[Law] = ()) -> BoolArray:
    """Find blocks too dark to be sediment, by the survey's median and by the sediments' laws."""
    level, weight = levels(blocks, trends)
    seen = weight > 0
    limit = float(np.median(level[seen])) - DARK
    if laws:
        limit = min(limit, min(log_moments(law)[0] for law in laws) - DARKER)
    return seen & (level < limit)


def dark_law(flat: Sequence[Flat], dark: BoolArray, factor: float) -> Law | None:
    """Fit the law of blocks too dark to be sediment, if there are enough of them."""
    if dark.sum() < LEAST_DARK:
        return None
    values = pixels_of(flat, dark)
    return choose(values, samples=values.size / factor).law


def levels(blocks: list[Blocks], trends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average the log amplitude of blocks over all looks; also return the number of pixels."""
    weight = np.sum([b.known for b in blocks], axis=0)
    level = np.sum(
        [b.known * (b.mean - trend_of(t, b.place)) for b, t in zip(blocks, trends, strict=True)],
        axis=0,
    )
    return level / np.maximum(weight, 1), weight


def noise_factor(looks: Sequence[AmplitudeGrid], blocks: Sequence[Blocks] | None = None) -> float:
    """Estimate the number of pixels per independent sample from the middle of each look.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
    blocks : sequence of Blocks, optional
        Of the looks, if they are to be read in slices.

    Returns
    -------
    float
    """
    factors = []
    for k, look in enumerate(looks):
        known = np.isfinite(look.amplitude) if blocks is None else blocks[k].known > 0
        rows, columns = np.nonzero(known)
        if rows.size == 0:
            continue
        row, column = int(rows[rows.size // 2]), int(columns[rows.size // 2])
        if blocks is not None:
            row, column = row * BLOCK + BLOCK // 2, column * BLOCK + BLOCK // 2
        box = slice(max(row - 64, 0), row + 64), slice(max(column - 64, 0), column + 64)
        part = np.asarray(look.amplitude[box], float)
        # texture and edges correlate over longer distances than speckle: remove the local level
        factors.append(np.isfinite(part).sum() / max(effective_samples(_whitened(part)), 1.0))
    return float(max(np.median(factors), 1.0))


def _whitened(part: FloatArray) -> FloatArray:
    known = np.isfinite(part)
    filled = np.where(known, part, 0.0)
    share = np.maximum(uniform_filter(known.astype(float), 11), 1e-9)
    local = uniform_filter(filled**2, 11) / share
    return np.where(known, filled / np.sqrt(np.maximum(local, 1e-30)), np.nan)
