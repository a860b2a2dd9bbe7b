"""Detection of display scaling (gamma near 1) whose contrast is still possible for speckle.

A power of the amplitude stretches its logarithm and keeps the shape of the logarithm's
distribution. Texture (K distribution) widens the logarithm as well, but makes it less skewed, and
structure within a block widens large blocks more than small ones. Quantiles are used instead of
cumulants (Nicolas, Traitement du Signal 19:139, 2002), because rounding to whole grey levels
distorts the low tail.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray

# Side in pixels of large and small blocks, and the share of the blocks that are used: the narrowest
# ones, which have the least structure of the sea floor.
LARGE, SMALL, SHARE = 16, 8, 0.25
# Quantiles of log amplitude that define its width and skewness (a choice: robust to rounding).
QUANTILES = (0.1, 0.5, 0.9)
# Width in large blocks of Rayleigh speckle, from a simulation of 961 blocks.
RAYLEIGH_WIDTH = 1.419
# Minimum mean of a block in grey levels: below, rounding determines the tenth percentile.
FEWEST_STEPS = 8.0
# Minimum number of large blocks: with fewer, the scatter of the skewness exceeds the margin of the
# limits (0.01 at 200).
FEWEST_BLOCKS = 200
# Limits from 60 simulated ripple fields (wavelengths of 12 to 140 pixels, slopes of 0.02 to 0.35,
# K shapes of 1.5 and more, three noise levels), each unchanged and with gamma 1.2. Unchanged, the
# width is under 1.62 or the skewness above -0.16, or shadows give a skewness under -0.23 or a ratio
# of widths under 0.86. With gamma 1.2 on speckle without texture: 1.75, -0.19 and 0.91.
WIDTH, SKEWNESS, RATIO = 1.63, (-0.225, -0.165), 0.88
# Below this width and above this skewness, amplitude was compressed or averaged. Speckle correlated
# over two or three pixels is as narrow (1.35 to 1.32), at a skewness of -0.19 to -0.23; gamma 0.85
# on two rippled scenes gives 1.30 and 1.32 at -0.17.
NARROW, NARROW_SKEWNESS = 1.335, -0.185


class LogShape(NamedTuple):
    """Shape of log amplitude in the narrowest blocks.

    Attributes
    ----------
    blocks : int
        Number of blocks, before the narrowest were chosen.
    width : float
        Distance from the first to the last quantile.
    skewness : float
        Bowley's skewness, from the quantiles, -1 to 1.
    """

    blocks: int
    width: float
    skewness: float


def found_gamma(sample: list[FloatArray], step: float) -> float | None:
    """Estimate the gamma of display scaling from speckle.

    Parameters
    ----------
    sample : list of ndarray (rows, columns)
        Pieces of a tile, NaN where there is nothing.
    step : float
        Smallest difference between two values.

    Returns
    -------
    float or None
        Approximate gamma; None where the values can be amplitude, or are too few or too coarse.
        Between about 0.9 and 1.13 it cannot be separated from correlation or texture.
    """
    large = log_shape(sample, LARGE, step)
    if large.blocks < FEWEST_BLOCKS:
        return None
    if large.width < NARROW and large.skewness > NARROW_SKEWNESS:
        return large.width / RAYLEIGH_WIDTH
    if large.width < WIDTH or not SKEWNESS[0] < large.skewness < SKEWNESS[1]:
        return None
    if log_shape(sample, SMALL, step).width < RATIO * large.width:
        return None
    return large.width / RAYLEIGH_WIDTH


def log_shape(sample: list[FloatArray], side: int, step: float) -> LogShape:
    """Compute the shape of log amplitude from the blocks of a sample.

    Parameters
    ----------
    sample : list of ndarray (rows, columns)
    side : int
        Side of a block in pixels.
    step : float
        Smallest difference between two values; rounding to it is dithered.
    """
    parts = [_blocks(piece, side, step) for piece in sample]
    blocks = np.concatenate(parts) if parts else np.empty((0, side**2))
    if not blocks.size:
        return LogShape(0, np.nan, np.nan)
    # rounded values have ties, which move quantiles: a dither within the step, the same for every
    # block, separates them
    spread = (np.arange(side**2) * 0.6180339887498949) % 1.0 - 0.5  # golden ratio: evenly spread
    blocks = np.log(np.maximum(blocks + step * spread, 0.25 * step))
    blocks -= np.median(blocks, axis=1, keepdims=True)
    low, _, high = np.quantile(blocks, QUANTILES, axis=1)
    narrow = np.argsort(high - low, kind="stable")[: max(int(SHARE * blocks.shape[0]), 1)]
    low, middle, high = np.quantile(blocks[narrow], QUANTILES)
    return LogShape(
        blocks.shape[0], float(high - low), float((high + low - 2.0 * middle) / (high - low))
    )


def _blocks(piece: FloatArray, side: int, step: float) -> FloatArray:
    """Cut a piece into blocks, one row each; dark blocks and those with gaps are left out."""
    rows, columns = (n // side for n in piece.shape)
    cut = piece[: rows * side, : columns * side].reshape(rows, side, columns, side)
    blocks = cut.transpose(0, 2, 1, 3).reshape(-1, side**2)
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    bright = (blocks.mean(axis=1) > FEWEST_STEPS * step) & (blocks.min(axis=1) >= 0)
    return np.asarray(blocks[bright & (blocks.std(axis=1) > 0)], float)
