"""Texture of blocks: variation of amplitude at several scales, summed once for all trial gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, uniform_filter

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.threads import Workers, mapped
from sasmap.sediments.bands import Bands, evened
from sasmap.sediments.floor import Flat, Part, around, blocks_in, tiles
from sasmap.sediments.texture import LAGS, SCALES
from sasmap.sediments.trends import BLOCK, MIN_KNOWN, Blocks, trend_of

Labels = IntArray

# Side in blocks of the window over which texture is described: 48 pixels.
AROUND = 3
# Side in blocks of the window that must be free of other groups for a block's texture to be its
# own: texture is described from 24 pixels to each side, of averages over 16.
CLEAR = 5
# Pixels over which intensity is averaged: at the coarsest scale a block holds too few averages.
LEVELS = SCALES[:-1]


def gain_of(blocks: Sequence[Blocks], trends: FloatArray, bands: Bands | None) -> list[FloatArray]:
    """Log gain of each look at each of its blocks.

    Parameters
    ----------
    blocks : sequence of Blocks
    trends : ndarray (looks, 3)
    bands : Bands or None

    Returns
    -------
    list of ndarray (block rows, block columns)
    """
    gains = [trend_of(t, b.place) for t, b in zip(trends, blocks, strict=True)]
    if bands is None:
        return gains
    return [
        gain + np.nan_to_num(bands.of_block(k, b))
        for k, (gain, b) in enumerate(zip(gains, blocks, strict=True))
    ]


@dataclass(frozen=True)
class BlockTexture:
    """Sums of log amplitudes at several scales over blocks.

    Attributes
    ----------
    sums : list of ndarray of float32 (block rows, block columns, 13)
        For each look: number of known pixels; sums of their log amplitude at each scale except the
        coarsest, and of its squares; sums of squared differences. 0 outside the described tiles.
    gains : list of ndarray (block rows, block columns)
        Log gain that was subtracted.
    shown : ndarray of bool (block rows, block columns)
        Blocks whose neighbours are all described.
    """

    sums: list[NDArray[np.float32]]
    gains: list[FloatArray]
    shown: BoolArray

    @classmethod
    def of(
        cls,
        flat: Sequence[Flat],
        gains: list[FloatArray],
        shape: tuple[int, ...],
        chosen: Sequence[Part],
        workers: Workers,
        rippled: BoolArray | None = None,
    ) -> BlockTexture:
        """Describe tiles.

        Parameters
        ----------
        flat : sequence of Flat
        gains : list of ndarray (block rows, block columns)
            Log gain subtracted from these.
        shape : tuple of int
            Block rows and columns.
        chosen : sequence of tuple of slice
        workers : int, None or callable
            Number of threads, or a callable that distributes work.
        rippled : ndarray of bool (block rows, block columns), optional
            Blocks that will be left out under every gain.

        Returns
        -------
        BlockTexture
        """
        clear = np.ones(shape, bool) if rippled is None else ~rippled
        parts = [part for one in chosen if (part := _bounds(one, clear)) is not None]
        sums = [_texture_sums(look, shape, parts, workers) for look in flat]
        return cls(sums, gains, _shown(chosen, shape))

    def under(
        self,
        blocks: Sequence[Blocks],
        trends: FloatArray,
        bands: Bands | None,
        dark: BoolArray,
    ) -> FloatArray:
        """Compute the texture of blocks with their neighbours under a gain.

        Parameters
        ----------
        blocks : sequence of Blocks
        trends : ndarray (looks, 3)
        bands : Bands or None
            Variances and differences are corrected for variation with range as well.
        dark : ndarray of bool (block rows, block columns)
            Blocks that are left out, together with those around them.

        Returns
        -------
        ndarray (block rows, block columns, 9)
            Mean log amplitude, its log variances at each scale except the coarsest, and log mean
            squares of differences, averaged over all looks. NaN where unknown.
        """
        split = len(LEVELS)
        total = np.zeros((*dark.shape, 1 + split + len(LAGS)))
        looks = np.zeros(dark.shape)
        near = binary_dilation(dark, np.ones((CLEAR, CLEAR)))
        gains = gain_of(blocks, trends, bands)
        for taken, before, after, block in zip(self.sums, self.gains, gains, blocks, strict=True):
            sums = np.moveaxis(taken.astype(float), -1, 0) * ~dark
            count, levels, squares = sums[0], sums[1 : 1 + split], sums[1 + split : 1 + 2 * split]
            # gain is constant within a block
            off = before - after
            squares += off * (2 * levels + off * count)
            levels += off * count
            sums = np.stack([uniform_filter(v, AROUND, mode="constant") for v in sums])
            enough = (sums[0] >= MIN_KNOWN * BLOCK**2) & ~near
            values = _values(sums)
            if bands is not None:
                values[1:] = evened(values[1:], enough, block, bands)
            total += np.where(enough[..., None], np.moveaxis(values, 0, -1), 0.0)
            looks += enough
        known = self.shown & (looks > 0)
        return np.where(known[..., None], total / np.maximum(looks, 1)[..., None], np.nan)


def _values(sums: FloatArray) -> FloatArray:
    """Mean log amplitude, log variances and log mean squared differences from sums (13, ...)."""
    means = sums[1:] / np.maximum(sums[0], 1e-9)
    levels, squares, apart = np.split(means, [len(LEVELS), 2 * len(LEVELS)])
    scatter = np.log(np.maximum(squares - levels**2, 1e-6))
    return np.concatenate([levels[:1], scatter, np.log(np.maximum(apart, 0) + 1e-6)])


def described(look: Flat, chosen: BoolArray, workers: Workers = 1) -> FloatArray:
    """Compute the texture of a look's blocks, each without its neighbours.

    Parameters
    ----------
    look : Flat
    chosen : ndarray of bool (block rows, block columns)
    workers : int, None or callable
        Number of threads, or a callable that distributes work.

    Returns
    -------
    ndarray (block rows, block columns, 9)
        As :meth:`BlockTexture.under` returns it; NaN elsewhere and where too few pixels are known.
    """
    parts = [part for one in tiles(look.shape) if (part := _bounds(one, chosen)) is not None]
    sums = np.moveaxis(_texture_sums(look, chosen.shape, parts, workers).astype(float), -1, 0)
    there = chosen & (sums[0] >= MIN_KNOWN * BLOCK**2)
    return np.where(there[..., None], np.moveaxis(_values(sums), 0, -1), np.nan)


def _texture_sums(
    look: Flat, shape: tuple[int, ...], chosen: Sequence[Part], workers: Workers
) -> NDArray[np.float32]:
    """Sum over blocks (block rows, block columns, 13), tile by tile; 0 outside tiles.

    The sums are those of :attr:`BlockTexture.sums`.
    """
    result = np.zeros((*shape, 1 + 2 * len(LEVELS) + len(LAGS)), np.float32)

    def add(part: Part) -> NDArray[np.float32]:
        wide, inner = around(part, BLOCK, look.shape)
        return block_texture(look[wide])[blocks_in(inner)]

    for part, sums in zip(chosen, mapped(add, chosen, workers), strict=True):
        result[blocks_in(part)] = sums
    return result


def _bounds(tile: Part, blocks: BoolArray) -> Part | None:
    """Bounding box of marked blocks within a tile; None where it holds none."""
    held = blocks[blocks_in(tile)]
    if not held.any():
        return None
    ends = [np.flatnonzero(held.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    first, last = zip(*ends, strict=True)
    (top, left), (bottom, right) = first, last
    row, column = tile[0].start, tile[1].start
    return (
        slice(row + int(top) * BLOCK, row + (int(bottom) + 1) * BLOCK),
        slice(column + int(left) * BLOCK, column + (int(right) + 1) * BLOCK),
    )


def block_texture(amplitude: NDArray[np.floating]) -> NDArray[np.float32]:
    """Describe the whole blocks of an image.

    Averages are sampled twice per their length, which gives as much information as every pixel.

    Parameters
    ----------
    amplitude : ndarray (rows, columns)
        NaN where there is none.

    Returns
    -------
    ndarray of float32 (block rows, block columns, 13)
        See :class:`BlockTexture`.
    """
    rows, columns = (n // BLOCK * BLOCK for n in amplitude.shape)
    amplitude = amplitude[:rows, :columns]
    known = amplitude > 0
    share = known.astype(np.float32)
    count = _block_sums(share, BLOCK)
    # in units of the mean amplitude, squares stay in the range of single precision
    unit = float(np.mean(amplitude, where=known)) if known.any() else 1.0
    power = np.square(np.where(known, amplitude, 0).astype(np.float32) / np.float32(unit))
    levels, squares, apart = [], [], []
    for scale in LEVELS:
        if scale > 2:
            power, share = _quartered(power), _quartered(share)
        side = BLOCK // max(scale // 2, 1)
        mean, many = (power, share) if scale == 1 else (_pooled(power), _pooled(share))
        there = many > 0.5 * scale**2
        mean = np.where(there, mean, 1) / np.where(there, many, 1)
        level = np.log(np.maximum(mean, np.float32(1e-37))) * np.float32(0.5)
        level += np.float32(np.log(unit))
        levels.append(_known_mean(level, there, side))
        squares.append(_known_mean(level * level, there, side))
        apart.append(_known_mean(*_differences(level, there, int(scale > 1)), side))
    return np.stack([count, *(count * v for v in (*levels, *squares, *apart))], axis=-1)


def _quartered(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over disjoint squares of 2 by 2."""
    down = values[::2] + values[1::2]
    return np.asarray(down[:, ::2] + down[:, 1::2])


def _pooled(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over the square of 2 by 2 that begins at each place; the last row and column repeat."""
    wide = np.pad(values, ((0, 1), (0, 1)), "edge")
    down = wide[:-1] + wide[1:]
    return np.asarray(down[:, :-1] + down[:, 1:])


def _differences(
    level: NDArray[np.float32], there: BoolArray, behind: int
) -> tuple[NDArray[np.float32], BoolArray]:
    """Squared differences, down plus across, from `behind` places back to one ahead; and where."""
    pad = ((behind, 1), (behind, 1))
    wide, known = np.pad(level, pad, "edge"), np.pad(there, pad, "edge")
    (rows, columns), step = level.shape, behind + 1
    middle = slice(behind, behind + rows), slice(behind, behind + columns)
    down = wide[step : step + rows, middle[1]] - wide[:rows, middle[1]]
    across = wide[middle[0], step : step + columns] - wide[middle[0], :columns]
    both = known[step : step + rows, middle[1]] & known[:rows, middle[1]]
    both &= known[middle[0], step : step + columns] & known[middle[0], :columns]
    return down * down + across * across, both


def _known_mean(values: NDArray[np.float32], there: BoolArray, side: int) -> NDArray[np.float32]:
    """Mean of known values over squares; 0 where there are none."""
    if there.all():
        return np.asarray(_block_sums(values, side) / np.float32(side * side), np.float32)
    many = _block_sums(there.astype(np.float32), side)
    total = _block_sums(np.where(there, values, np.float32(0)), side)
    return np.asarray(total / np.maximum(many, 1), np.float32)


def _block_sums(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    rows, columns = (n // side for n in values.shape)
    down = values.reshape(rows, side, -1).sum(axis=1)
    return np.asarray(down.reshape(rows, columns, side).sum(axis=2))


def _shown(chosen: Sequence[Part], shape: tuple[int, ...]) -> BoolArray:
    """Mark blocks in tiles whose neighbours are all in tiles."""
    mask = np.zeros(shape, bool)
    for part in chosen:
        mask[blocks_in(part)] = True
    return np.asarray(binary_erosion(mask, np.ones((AROUND, AROUND)), border_value=1))
