"""Kinds of pixel values (amplitude, intensity, decibels), and a check of the stated kind.

The check uses speckle. Where many scatterers share a pixel, amplitude follows a Rayleigh
distribution: its standard deviation is 0.52 of its mean and its skewness 0.63 whatever the gain
(Goodman, Speckle Phenomena in Optics, 2007, section 3.2). Texture (K distribution) and structure of
the sea floor only raise both. Intensity has 1.0 and 2.0; decibels are skewed to the left;
averaging, interpolation and display scaling lower the contrast. Statistics are computed over many
small blocks, so that structure wider than a block does not matter, and from the blocks with the
lowest contrast.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sasmap.arrays import BoolArray, FloatArray
from sasmap.survey.display import found_gamma

Kind = Literal["linear", "intensity", "db"]
KINDS: tuple[Kind, ...] = ("linear", "intensity", "db")

# Side of a block in pixels: large enough for a standard error of 0.03 of its contrast, and smaller
# than a quarter of most wavelengths.
BLOCK = 16
# Minimum number of blocks for a judgement: with fewer, the scatter of the quartile exceeds the
# tolerance of the limits (measured on Rayleigh speckle).
FEWEST_BLOCKS = 6
# Contrast (standard deviation over mean, lower quartile of the blocks) that amplitude can have.
# Measured: Rayleigh speckle 0.51, K-distributed with shape 1 0.75, with shape 0.5 (which is the
# same as intensity) 0.95; two looks averaged 0.35, gamma 0.7 0.38, 0.85 0.45 (which lowers A_H by a
# seventh), bilinear resampling 0.33, intensity 0.95.
CONTRAST = (0.465, 0.85)
# Where short ripples cast shadow in every block, contrast reaches 2.1, with a skewness of at most
# 1.1 times that (1.2 with few shadows); for intensity it is 1.7 times (measured on simulated
# tiles).
SHADOWED, MOST_SHADOWED = 1.4, 2.5
# Number of blocks for which the limits hold, and allowance for the scatter of the quartile with
# fewer.
SURE_BLOCKS, STRAY = 60, 0.035
# Within a block, correlated speckle varies less than its true variance. Maximum lag in pixels of
# the correlation area that corrects for it, and maximum number of blocks it is computed from.
LAGS, CORRELATED_BLOCKS = 5, 400
# Minimum skewness of the blocks with lowest contrast. Rayleigh 0.55, correlated over four pixels
# 0.25, uniform (an equalised histogram) 0, compressed highlights 0.2 and less.
SKEWNESS = 0.22
# Skewness that separates averaged intensity of amplitude's contrast: four looks 0.85, Rayleigh
# 0.55.
AVERAGED_SKEWNESS, AVERAGED_CONTRAST = 0.78, 0.53
# Decibels, whatever their offset and scale, have a skewness of -1; gamma 0.45 has -0.1.
LOGARITHMIC = -0.6
# Share of pixels under a tenth of their block's median: Rayleigh 0.007, K with shape 1 0.02 at a
# skewness above 1.2; more at less skewness means a subtracted black level, unless dark pixels are
# clustered: in shadow most neighbours of a dark pixel are dark, in speckle few.
DARK_SHARE, DARK_SKEWNESS, TOGETHER = 0.05, 1.2, 0.5
# Share of pixels at the lowest value where a black level was clipped; noise in shadow has few.
CLIPPED = 0.02
# Skewness of the blocks with lowest contrast below which values may be decibels of the usual scale:
# those have -0.95, equalised images -0.35, saturated or compressed ones more.
DECIBELS = -0.45
# Minimum mean of a block in grey levels: below, rounding determines the contrast.
FEWEST_STEPS = 4.0
# Number of distinct values of a tile, and grey levels of its median block, below which rounding
# loses contrast.
FEW_LEVELS, FEW_STEPS = 17, 2.0
# Share of pixels at the largest value that means saturation: speckle reaches five times its mean in
# under 1e-8 of pixels.
SATURATED = 0.005
# Share of negative pixels that noise about a black level can explain.
NEGATIVE = 0.002
# Largest level in dB that is plausible for any sonar; larger values are not decibels.
LARGEST_DB = 400.0

Sample = list[FloatArray]


class Verdict(NamedTuple):
    """A fault of a tile's pixel values.

    Attributes
    ----------
    text : str
        The finding, what was expected and what to do.
    refused : bool
        Whether values of that kind cannot be used at all.
    """

    text: str
    refused: bool = False


@dataclass(frozen=True)
class Speckle:
    """Statistics of small blocks.

    Attributes
    ----------
    blocks : int
    contrast : float
        Standard deviation over mean, lower quartile, corrected to uncorrelated speckle.
    skewness, least_skewness : float
        Median over all blocks, and over the half with lowest contrast.
    dark, together : float
        Share of pixels under a tenth of their block's median, and share of such pixels among their
        neighbours along rows or columns.
    floor : float
        Share of pixels at the lowest value.
    mean : float
        Median of the blocks' means.
    """

    blocks: int
    contrast: float
    skewness: float
    least_skewness: float
    dark: float
    together: float
    floor: float
    mean: float

    @property
    def enough(self) -> bool:
        """Whether there are enough blocks for a judgement."""
        return self.blocks >= FEWEST_BLOCKS

    @property
    def fits(self) -> bool:
        """Whether the statistics are possible for linear amplitude."""
        return (
            self.least_contrast <= self.contrast
            and not self.too_much
            and self.least_skewness >= SKEWNESS
            and not self.averaged_intensity
        )

    @property
    def too_much(self) -> bool:
        """Whether contrast exceeds what texture and shadow can cause."""
        shadowed = self.least_skewness < SHADOWED * self.contrast
        return self.contrast > (MOST_SHADOWED if shadowed else CONTRAST[1])

    @property
    def least_contrast(self) -> float:
        """Minimum contrast possible for amplitude, with an allowance for few blocks."""
        return CONTRAST[0] - (STRAY if self.blocks < SURE_BLOCKS else 0.0)

    @property
    def averaged_intensity(self) -> bool:
        """Whether contrast is that of amplitude, but skewness that of averaged intensity."""
        return self.contrast < AVERAGED_CONTRAST and self.least_skewness > AVERAGED_SKEWNESS


def to_linear(values: NDArray[np.floating], kind: Kind) -> NDArray[np.floating]:
    """Convert a tile's pixel values to linear amplitude.

    Parameters
    ----------
    values : ndarray
        As stored, scale and offset applied.
    kind : {"linear", "intensity", "db"}

    Returns
    -------
    ndarray
        NaN where a value is not an amplitude: negative, unless in decibels.
    """
    if kind == "db":
        bounded = np.where(np.abs(values) <= LARGEST_DB, values, np.nan)
        return np.asarray(10.0 ** (bounded / 20.0), values.dtype)
    known = np.where(values >= 0, values, np.nan)
    return np.asarray(np.sqrt(known) if kind == "intensity" else known, values.dtype)


def speckle_of(sample: Sample, least: float = 0.0) -> Speckle:
    """Compute statistics over the blocks of a sample.

    Parameters
    ----------
    sample : list of ndarray
        Pieces of a tile, NaN where there is nothing.
    least : float
        Blocks with a smaller mean are skipped.
    """
    parts = [_blocks(piece) for piece in sample]
    blocks = np.concatenate(parts) if parts else np.empty((0, BLOCK**2))
    mean, spread = blocks.mean(axis=1), blocks.std(axis=1)
    # a block of one value is not speckle; the rounding error of a large mean is not spread
    kept = (spread > 1e-6 * np.abs(mean)) & (mean >= least) & (mean != 0)
    blocks, mean, spread = blocks[kept], mean[kept], spread[kept]
    if not blocks.size:
        return Speckle(0, *[np.nan] * 7)
    contrast = spread / np.abs(mean)
    skewness = (((blocks - mean[:, None]) / spread[:, None]) ** 3).mean(axis=1)
    plain = contrast <= np.median(contrast)
    dark = blocks < 0.1 * np.median(blocks, axis=1, keepdims=True)
    return Speckle(
        blocks.shape[0],
        float(np.quantile(contrast, 0.25) / _within(blocks[plain], mean[plain])),
        float(np.median(skewness)),
        float(np.median(skewness[plain])),
        float(dark.mean()),
        _together(dark.reshape(-1, BLOCK, BLOCK)),
        float((blocks == blocks.min()).mean()),
        float(np.median(mean)),
    )


def _together(dark: BoolArray) -> float:
    """Share of the neighbours of dark pixels that are dark, along rows or columns."""
    count = max(int(dark[:, 1:, 1:].sum()), 1)
    down = int((dark[:, 1:, 1:] & dark[:, :-1, 1:]).sum())
    across = int((dark[:, 1:, 1:] & dark[:, 1:, :-1]).sum())
    return max(down, across) / count


def _within(blocks: FloatArray, mean: FloatArray) -> float:
    """Return the standard deviation of correlated speckle within a block over the true one."""
    some = slice(None, None, blocks.shape[0] // CORRELATED_BLOCKS + 1)
    part = (blocks[some] - mean[some, None]).reshape(-1, BLOCK, BLOCK)
    variance = float(np.mean(part**2))
    area = 0.0
    for i in range(-LAGS, LAGS + 1):
        for j in range(-LAGS, LAGS + 1):
            one = part[:, max(i, 0) : BLOCK + min(i, 0), max(j, 0) : BLOCK + min(j, 0)]
            other = part[:, max(-i, 0) : BLOCK - max(i, 0), max(-j, 0) : BLOCK - max(j, 0)]
            area += max(float(np.mean(one * other)) / variance, 0.0)
    return float(np.sqrt(max(1.0 - area / BLOCK**2, 0.5)))


def _blocks(piece: FloatArray) -> FloatArray:
    """Cut a piece into blocks without gaps, one row each."""
    rows, columns = (n // BLOCK for n in piece.shape)
    cut = piece[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    blocks = cut.transpose(0, 2, 1, 3).reshape(-1, BLOCK**2)
    return np.asarray(blocks[np.isfinite(blocks).all(axis=1)], float)


def judge(sample: Sample, kind: Kind) -> Iterator[Verdict]:
    """Check a tile's pixel values against the kind stated in the survey file.

    Parameters
    ----------
    sample : list of ndarray
        Pieces of a tile as stored, scale and offset applied, NaN where nodata or fill.
    kind : {"linear", "intensity", "db"}
        The kind stated in the survey file.

    Yields
    ------
    Verdict
    """
    values = np.concatenate([piece[np.isfinite(piece)] for piece in sample]) if sample else None
    if values is None or not values.size:
        return
    levels = np.unique(values)
    if levels.size == 1:
        yield Verdict(f"has a single value ({levels[0]:g}): expected amplitudes")
        return
    yield from _spoiled(sample, values, levels)
    step = float(np.diff(levels).min())
    contradiction = _negative(sample, values, kind) or _contradiction(sample, kind, step)
    if contradiction is not None:
        yield contradiction


def _spoiled(sample: Sample, values: FloatArray, levels: FloatArray) -> Iterator[Verdict]:
    """Find saturation, few grey levels and lossy compression, for any kind of values."""
    top = float(levels[-1])
    share = float((values == top).mean())
    if share > SATURATED and levels.size > 2:
        yield Verdict(
            f"{share:.1%} of its pixels have the largest value, {top:g}: saturated, which lowers "
            "contrast; export it with less gain"
        )
    middle = speckle_of(sample).mean / float(np.diff(levels).min())
    # for values about zero the mean is meaningless
    if levels.size < FEW_LEVELS or (levels[0] >= 0 and middle < FEW_STEPS):
        yield Verdict(
            f"has few grey levels ({levels.size} different values): contrast of dark floor is lost "
            "to rounding; export it with more gain, or in 16 bits"
        )
    if any(_jpeg_blocks(piece) for piece in sample[:: len(sample) // JPEG_PIECES + 1]):
        yield Verdict(
            "has the 8 x 8 blocks of JPEG compression, which changes speckle; export it lossless"
        )


def _negative(sample: Sample, values: FloatArray, kind: Kind) -> Verdict | None:
    """Find negative values, which neither amplitude nor intensity has."""
    share = float((values < 0).mean())
    if kind == "db" or share <= NEGATIVE:
        return None
    told = f"{share:.1%} of its pixels are negative, which {_name(kind)} cannot be"
    if _fitting(sample, "db"):
        return Verdict(f"{told}: they look like decibels; try amplitude: db", refused=True)
    return Verdict(
        f"{told}: expected decibels (amplitude: db) or values from 0 up; declare the value for "
        "no data as nodata, and undo any subtraction",
        refused=True,
    )


def _contradiction(sample: Sample, kind: Kind, step: float) -> Verdict | None:
    """Find contrast and skewness that are impossible for speckle of the stated kind."""
    raw = speckle_of(sample, 0.0 if kind == "db" else FEWEST_STEPS * step)
    told = speckle_of([np.asarray(to_linear(p, kind)) for p in sample]) if kind != "linear" else raw
    if not told.enough:
        return _unlike_decibels(raw) if kind == "db" else None
    if told.fits:
        return _black_level(raw) or _display(sample, step) if kind == "linear" else None
    found = f"contrast {told.contrast:.2f} and skewness {told.least_skewness:.2f}"
    start = f"does not look like {_name(kind)} ({found}; speckle has 0.52 and 0.6)"
    others = [other for other in KINDS if other != kind and _fitting(sample, other)]
    if raw.least_skewness > DECIBELS and "db" in others:
        others.remove("db")
    if others:
        sure = "db" in (others[0], kind)
        return Verdict(f"{start}: try amplitude: {others[0]}", refused=sure)
    return Verdict(f"{start}: {_cause(raw, told, kind)}")


def _unlike_decibels(raw: Speckle) -> Verdict | None:
    """Refuse values that cannot be decibels."""
    if not raw.enough:
        return None
    return Verdict(
        f"does not look like decibels (about {raw.mean:.3g}): try amplitude: linear", refused=True
    )


def _black_level(raw: Speckle) -> Verdict | None:
    if raw.dark <= DARK_SHARE or raw.least_skewness >= DARK_SKEWNESS or raw.together > TOGETHER:
        return None
    if raw.floor < CLIPPED:
        return None
    return Verdict(
        f"{raw.dark:.0%} of its pixels are nearly black, where speckle has 1 %: deep shadow, too "
        "few levels, or a black level was subtracted; if one was, export it without"
    )


def _display(sample: Sample, step: float) -> Verdict | None:
    gamma = found_gamma(sample, step)
    if gamma is None:
        return None
    if gamma < 1:
        return Verdict(
            f"its speckle is compressed, as by a display gamma of about {gamma:.2f} or by "
            "averaging: A_H will be too small; export linear amplitude at full resolution"
        )
    return Verdict(
        f"its speckle is stretched, as by a display gamma of about {gamma:.1f}: A_H will be too "
        "large; export linear amplitude"
    )


def _fitting(sample: Sample, kind: Kind) -> bool:
    """Whether the values can be speckle of a kind."""
    told = speckle_of([np.asarray(to_linear(piece, kind)) for piece in sample])
    return told.enough and told.fits


def _cause(raw: Speckle, told: Speckle, kind: Kind) -> str:
    """Name the likely processing of the values, and what to do."""
    if raw.skewness < LOGARITHMIC:
        return (
            "they look like decibels rescaled for display; export linear amplitude, or "
            "dB for amplitude: db"
        )
    if told.averaged_intensity and kind == "linear":
        return "they look like averaged intensity; try amplitude: intensity"
    if told.too_much:
        return (
            "its contrast is too high, as for intensity (amplitude: intensity) or after "
            "stretching for display; export linear amplitude"
        )
    return (
        "its contrast is too low, as after averaging, interpolation or scaling for display "
        "(gamma, log, equalised): A_H will be too small; export linear amplitude at full resolution"
    )


def _name(kind: Kind) -> str:
    return {"linear": "linear amplitude", "intensity": "intensity", "db": "decibels"}[kind]


# JPEG: coefficients of 8 x 8 blocks are multiples of a step, most of them zero. Ratio of the count
# of zeros at the blocks' own offset to that at others (speckle at most 2, quality 95 at least 6),
# and its significance in standard deviations (speckle at most 10, JPEG at least 46).
JPEG_SIDE, JPEG_RATIO, JPEG_SIGMAS = 8, 3.5, 20.0
# Magnitude below which coefficients count as zero (rounding to whole grey levels has sd 0.29), and
# minimum spread of a block, well above that.
JPEG_ZERO, JPEG_SPREAD = 0.5, 4.0
# Maximum side in pixels of an examined piece, minimum side for a judgement, and maximum number of
# pieces: these bound the time.
JPEG_MOST, JPEG_LEAST, JPEG_PIECES = 136, 40, 6


def _jpeg_blocks(piece: FloatArray) -> bool:
    """Whether a piece has JPEG's quantised cosine coefficients, at any offset."""
    part = np.nan_to_num(piece[:JPEG_MOST, :JPEG_MOST], nan=0.0)
    whole = (part == np.rint(part)).all()
    if min(part.shape) < JPEG_LEAST or part.std() < JPEG_SPREAD or not whole:
        return False
    scores = [_zeros(part[i:, j:]) for i in range(JPEG_SIDE) for j in range(JPEG_SIDE)]
    # only one offset fits the blocks; few grey levels raise the count at all offsets
    best, usual = max(scores), float(np.median(scores))
    return best > JPEG_RATIO * usual and best - usual > JPEG_SIGMAS * np.sqrt(usual + 1.0)


def _zeros(part: FloatArray) -> int:
    """Count the high-frequency cosine coefficients near zero."""
    rows, columns = (n // JPEG_SIDE for n in part.shape)
    cut = part[: rows * JPEG_SIDE, : columns * JPEG_SIDE]
    blocks = cut.reshape(rows, JPEG_SIDE, columns, JPEG_SIDE).transpose(0, 2, 1, 3)
    blocks = blocks[blocks.std(axis=(2, 3)) > JPEG_SPREAD]  # saturated blocks have no waves
    wave = scipy.fft.dctn(blocks, axes=(1, 2), norm="ortho")
    return int((np.abs(wave[:, 3:, 3:]) < JPEG_ZERO).sum())
