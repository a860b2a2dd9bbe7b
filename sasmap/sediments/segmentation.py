"""Number of sediment classes, and their amplitude laws.

Blocks of pixels are described by mean and variance of their log amplitude, with the gain of the
pass and its trend over grazing angle removed, and grouped by a Gaussian mixture; groups whose laws
differ too little per pixel are one sediment. Each class then has its own amplitude law
(:func:`sasmap.sediments.fitting.choose`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.threads import Workers
from sasmap.sediments.bands import SLIGHT, Bands, find_bands, leveled, steep
from sasmap.sediments.classes import Classes, dark_blocks, dark_law, levels, noise_factor
from sasmap.sediments.description import BlockTexture, gain_of
from sasmap.sediments.fitting import Law
from sasmap.sediments.floor import Flat, Part, around, blocks_shown, chosen_tiles, gather, tiles
from sasmap.sediments.grouping import WAVES, grouped, pruned, textured_groups
from sasmap.sediments.separation import (
    TOLD,
    TOLD_TEXTURED,
    laws_of,
    merged,
    too_alike,
    united,
    within,
)
from sasmap.sediments.texture import DECIDING, REACH, Texture, channels, learn
from sasmap.sediments.trends import BLOCK, AmplitudeGrid, Blocks, first_trends, refit

# Scatter of mean and log variance within one sediment's blocks, beyond sampling noise.
FLOOR = (0.02, 0.06)
# Standard deviations from the neighbours' mean within which a block holds one sediment.
EVEN = 3.0
# Minimum mean log likelihood ratio per pixel (nats) between the laws of two sediments.
APART = 0.02
# Pixels, over all looks, whose texture is described (at most about 250 MB, by blocks) and from
# which textures are learned; side in pixels of the sampled tiles where a survey has more pixels.
DESCRIBED, SAMPLE, SAMPLED_SIDE = 100_000_000, 3_000_000, 256
# Span of gain by range, in log amplitude, above which it certainly shifts classes (1.7 dB).
PLAIN = 0.2
# Maximum ratio of the blocks' deviation from their class levels with gain by range to that without
# it, and minimum number of blocks to judge by: false gain, found on grainy sediments with rough
# boundaries, blurs levels (1.5 to 2 on three such scenes; 0.4 to 1.1 on six with real gain, 1.2
# over a wreck).
WORSE, TELLING = 1.3, 2000
# Minimum share of each look's blocks that are free of ripples for the gain to be found from these
# alone.
LEVEL = 0.2


Dark = BoolArray


@dataclass
class _Survey:
    """Data of a survey that are gathered once, however many ways of grouping are tried."""

    looks: Sequence[AmplitudeGrid]
    blocks: list[Blocks]
    centre: float
    bands: Bands | None
    factor: float
    workers: Workers
    first: FloatArray
    rippled: Dark | None = None
    texture: BlockTexture | None = None

    def __post_init__(self) -> None:
        self.kept: list[dict[tuple[int, int], NDArray[np.float32]]] = [{} for _ in self.looks]

    def leveled(self, bands: Bands | None) -> list[Blocks]:
        """Remove bands, if there are any, from the blocks of all looks."""
        return self.blocks if bands is None else leveled(self.blocks, bands)

    def flat(self, trends: FloatArray, bands: Bands | None) -> list[Flat]:
        """Remove gain, trend and bands, if there are any, from the looks."""
        each = enumerate(zip(self.looks, trends, self.kept, strict=True))
        return [Flat(v, trend, self.centre, bands, k, kept) for k, (v, trend, kept) in each]

    def described(
        self, labels: IntArray, trends: FloatArray, bands: Bands | None, dark: Dark
    ) -> tuple[FloatArray, BoolArray]:
        """Return the texture of blocks under a gain, and which blocks are described."""
        if self.texture is None:
            # bands are removed pixel by pixel: within a block they would appear as texture
            flat = self.flat(trends, self.bands)
            chosen = _sampled(flat, labels, DESCRIBED)
            gains = gain_of(self.blocks, trends, self.bands)
            self.texture = BlockTexture.of(
                flat, gains, labels.shape, chosen, self.workers, self.rippled
            )
        described = self.texture.under(self.blocks, trends, bands, dark)
        return described, self.texture.shown


class _Found(NamedTuple):
    """One way of grouping a survey's blocks."""

    labels: IntArray
    laws: list[Law]
    textured: bool
    trends: FloatArray
    bands: Bands | None
    dark: Law | None


def find_classes(
    looks: Sequence[AmplitudeGrid],
    count: int | None = None,
    workers: Workers = 1,
    rippled: Any = None,
) -> Classes:
    """Find the classes of a survey.

    Amplitude is gathered from all of it, by blocks; texture and laws from a part if it is large.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; read in slices.
    count : int, optional
        Number of classes; found from the data where not given.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.
    rippled : array (rows, columns), optional
        Above 0 where ripples were removed. Texture there is ignored, so that residuals of ripples
        do not become sediments. Read in slices.

    Returns
    -------
    Classes

    Raises
    ------
    ValueError
        Where no block of any look is known.
    """
    blocks, centre = gather(looks, None, workers)
    factor = noise_factor(looks, blocks)
    beds = None if rippled is None else blocks_shown(rippled, workers)
    if beds is not None and beds.any():
        blocks = [_over_waves(b, beds) for b in blocks]
    first = first_trends(blocks)
    bands = find_bands(_level_ones(blocks, beds), first) if count != 1 else None
    bands = None if bands is None or bands.span < SLIGHT else bands
    survey = _Survey(looks, blocks, centre, bands, factor, workers, first, beds)
    found = _found(survey, None if bands is not None else count, None)
    if bands is not None:
        if len(found.laws) > 1:
            fewer = _found(survey, None, bands)
            # variation with range alone is not a sediment; otherwise the trend suffices
            most = len(found.laws) - (bands.span < PLAIN)
            if len(fewer.laws) <= most and not _blurred(survey, fewer, found):
                found = fewer
        if count is not None and len(found.laws) != count:
            found = _found(survey, count, found.bands)
    return _finished(survey, found if count is not None else _without_drift(survey, found))


def _blurred(survey: _Survey, fewer: _Found, found: _Found) -> bool:
    """Whether gain by range blurs the levels of classes, instead of explaining them.

    Where it does not reduce the number of classes, it must reduce the spread.
    """
    simpler = len(fewer.laws) < len(found.laws)
    if simpler and (found.labels >= 0).sum() < TELLING:
        return False
    limit = WORSE if simpler else 1.0
    return _spread(survey, fewer) > limit * _spread(survey, found)


def _spread(survey: _Survey, found: _Found) -> float:
    """Root mean square deviation of blocks' levels from those of their classes."""
    level, weight = levels(survey.leveled(found.bands), found.trends)
    away = [
        level[one] - np.median(level[one])
        for k in range(len(found.laws))
        if (one := (found.labels == k) & (weight > 0)).any()
    ]
    return float(np.sqrt(np.mean(np.concatenate(away) ** 2))) if away else np.inf


def _over_waves(block: Blocks, beds: Dark) -> Blocks:
    """Give rippled blocks the level and scatter of their surroundings: crests and troughs differ.

    Uses medians, so that an edge between sediments stays in place.
    """
    known = block.known > 0
    mine = beds & known
    if not mine.any():
        return block

    def smooth(values: FloatArray) -> FloatArray:
        filled = np.where(known, values, np.median(values[mine]))
        wide = np.pad(filled, WAVES // 2, "edge")
        around = sliding_window_view(wide, (WAVES, WAVES))[mine].reshape(-1, WAVES**2)
        result = values.copy()
        result[mine] = np.median(around, axis=1, overwrite_input=True)
        return result

    return block._replace(mean=smooth(block.mean), variance=smooth(block.variance))


def _level_ones(blocks: list[Blocks], beds: Dark | None) -> list[Blocks]:
    """Keep blocks without ripples, if there are enough to determine the gain.

    Shadow and slopes of ripples give a bed's mean amplitude its own dependence on range.
    """
    if beds is None:
        return blocks
    level = [b._replace(known=np.where(beds, 0.0, b.known)) for b in blocks]
    left = [
        (a.known > 0).sum() >= LEVEL * (b.known > 0).sum()
        for a, b in zip(level, blocks, strict=True)
    ]
    return level if all(left) else blocks


def _without_drift(survey: _Survey, found: _Found) -> _Found:
    """Merge classes that differ only by drift."""
    level, weight = levels(survey.leveled(found.bands), found.trends)
    seen = np.where(weight > 0, found.labels, -1)
    flat = survey.flat(found.trends, found.bands)
    told = TOLD_TEXTURED if found.textured else TOLD
    labels, laws = united(flat, seen, found.laws, level, survey.factor, told, survey.rippled)
    return found._replace(labels=labels, laws=laws, textured=found.textured and len(laws) > 1)


def _found(survey: _Survey, count: int | None, bands: Bands | None) -> _Found:
    """Group blocks, with bands of gain removed if there are any."""
    blocks = survey.leveled(bands)
    first = trends = survey.first if bands is None else first_trends(blocks)
    dark = dark_blocks(blocks, trends)
    fewest, most = count or 1, None
    for _ in range(3):
        features, index = _features(blocks, trends, dark)
        groups = grouped(features, FLOOR, fewest, most)
        trends = refit(blocks, groups, index, first)
        # better trends change the group of few blocks
        there = int(groups.max()) + 1
        fewest, most = max(there - 1, count or 1), max(there + 1, count or 1)
    factor = survey.factor
    labels = np.full(blocks[0].mean.shape, -1)
    labels[index] = groups
    flat = survey.flat(trends, bands)
    none = dark_law(flat, dark, factor)
    # merge groups that are one sediment first: else each lies beside the other everywhere
    labels, _ = merged(flat, labels, count or 1, factor, APART)
    labels = pruned(labels, count or 1, rippled=survey.rippled)
    unclear = dark if bands is None else dark | steep(bands, blocks)
    unclear = unclear if survey.rippled is None else unclear | survey.rippled
    described, shown = survey.described(labels, trends, bands, unclear)
    textured, mixed = textured_groups(described, shown, labels, unclear, count)
    labels, laws = merged(flat, labels, count or 1, factor, APART if count is None else np.inf)
    others = laws_of(flat, textured, factor)
    # where amplitude suffices, it gives sharper boundaries
    nested = within(textured, labels)
    alike = len(others) > 1 and too_alike(others) and nested
    same = len(others) == len(laws) and nested and within(labels, textured)
    needed = alike or (mixed and not same and len(others) >= max(len(laws), 2))
    if needed:
        labels, laws = textured, others
    return _Found(labels, laws, needed, trends, bands, none)


def _finished(survey: _Survey, found: _Found) -> Classes:
    """Return classes by rising intensity, with textures where classes differ by these."""
    order = np.argsort([law.mean_square for law in found.laws], kind="stable")
    laws = tuple(found.laws[i] for i in order)
    texture = None
    if found.textured:
        flat = survey.flat(found.trends, found.bands)
        number = np.append(np.argsort(order), -1) + 1  # the last is for blocks of no class
        chosen = _sampled(flat, found.labels, SAMPLE)
        texture = _learned(flat, number[found.labels], len(laws), chosen)
    return Classes(
        laws, found.trends, survey.centre, survey.factor, found.dark, texture, found.bands
    )


def _sampled(flat: Sequence[Flat], labels: IntArray, pixels: int) -> list[Part]:
    """Choose tiles with at most about `pixels` pixels over all looks."""
    shape = flat[0].shape
    if shape[0] * shape[1] * len(flat) <= pixels:
        return tiles(shape)
    most = max(pixels // (SAMPLED_SIDE**2 * len(flat)), 4)
    return chosen_tiles(shape, SAMPLED_SIDE, most, labels)


def _learned(flat: Sequence[Flat], labels: IntArray, count: int, chosen: Sequence[Part]) -> Texture:
    """Learn textures of the blocks' classes (from 1, 0 for none) from some tiles."""
    parts = []
    for part in chosen:
        wide, inner = around(part, REACH, flat[0].shape)
        rows, columns = (slice(s.start // BLOCK, -(-s.stop // BLOCK)) for s in part)
        marks = _marks_of(labels[rows, columns], [s.stop - s.start for s in part])
        if marks.any():
            parts += [(channels(one.logs(wide))[:, *inner], marks) for one in flat]
    return learn(parts, count, -(-DECIDING * len(flat) // len(parts)), cores=True)


def _marks_of(blocks: IntArray, shape: Sequence[int]) -> IntArray:
    """Expand classes of blocks to their pixels; 0 beyond the last whole block."""
    whole = np.repeat(np.repeat(blocks, BLOCK, axis=0), BLOCK, axis=1)
    whole = whole[: shape[0], : shape[1]]
    return np.pad(whole, [(0, n - m) for n, m in zip(shape, whole.shape, strict=True)])


def _features(
    blocks: list[Blocks], trends: FloatArray, dark: BoolArray
) -> tuple[FloatArray, tuple[IntArray, ...]]:
    """Mean and log variance of log amplitude of even blocks (n, 2), and their indices."""
    level, weight = levels(blocks, trends)
    weight = np.where(dark, 0.0, weight)
    spread = np.sum([b.known * b.variance for b in blocks], axis=0)
    many = np.maximum(weight, 1)
    spread = np.log(np.maximum(spread / many, 1e-6))
    seen = (weight > 0).astype(float)
    around = uniform_filter(level * seen, 3, mode="nearest") / np.maximum(
        uniform_filter(seen, 3, mode="nearest"), 1e-9
    )
    error = np.sqrt(np.exp(spread) / many)
    known = (weight > 0) & (np.abs(level - around) < EVEN * np.sqrt(8 / 9) * 2 * error)
    if known.sum() < 0.3 * (weight > 0).sum():
        known = weight > 0
    index = np.nonzero(known)
    return np.column_stack([level[index], spread[index]]), index
