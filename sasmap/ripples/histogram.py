"""The phase-range histogram of a clip: the sums through which its pixels enter the likelihood."""

from __future__ import annotations

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.image import Image
from sasmap.ripples.phase import PhaseField
from sasmap.ripples.pixels import spread_boxes, sum_pixels
from sasmap.ripples.rendering import Histogram

# Length of the blocks of range: least, m, and over range. At 4 m the slope of the ray changes by a
# quarter over a metre, and rendering a pulse every quarter of a metre changed A_H by 2 %.
LEAST_BLOCK, BLOCK_SHARE = 0.25, 0.05
# Most groups of range with a gain of their own, each at least a wavelength long.
MOST_GROUPS = 8
# Bins of phase per pixel along the look, and their largest number; where the published model is
# taken at its word, whose shadows have no blur, more: with the first, A_H of ripples far steeper
# than the lowest ray is 5 % too high (pipelines/ripples/zare_cobb_tables.py). Their least number.
BINS, SHARP_BINS, LEAST_BINS = (1.25, 64), (1.5, 96), 16


def range_edges(nearest: float, farthest: float) -> FloatArray:
    """Edges of the blocks of ground range, m.

    Parameters
    ----------
    nearest, farthest : float
        Ground ranges of the nearest and farthest pixel, m.

    Returns
    -------
    ndarray (blocks + 1,)
    """
    edges = [nearest]
    while edges[-1] < farthest:
        edges.append(edges[-1] + max(LEAST_BLOCK, BLOCK_SHARE * edges[-1]))
    stretch = (farthest - nearest) / max(edges[-1] - nearest, 1e-9)
    return (
        nearest + stretch * (np.array(edges) - nearest)
        if len(edges) > 1
        else np.array([nearest, nearest + LEAST_BLOCK])
    )


def histogram(
    image: Image, trend: FloatArray, phase: PhaseField, published: bool = False
) -> Histogram:
    """Sum a clip's rippled pixels over bins of phase and range.

    Parameters
    ----------
    image : Image
    trend : ndarray (box rows, box columns)
        Local mean intensity in the phase field's boxes.
    phase : PhaseField
    published : bool
        Whether Zare and Cobb's model is fitted.
    """
    used = image.valid & phase.pixels(phase.covered)
    along = float(phase.wave @ image.look)
    a_pixel, most = SHARP_BINS if published else BINS
    bins = int(np.clip(round(a_pixel / (along * image.pixel_size)), LEAST_BINS, most))
    reach = image.ground_range[used]
    edges = range_edges(float(reach.min()), float(reach.max()))
    level = spread_boxes(trend, phase.box, image.shape)
    power, field = (image.power + DYNAMIC_RANGE) / level, phase.cycles
    block, *sums = sum_pixels(
        power, used, image.saturated, image.ground_range, field, phase.per_pixel(image), edges, bins
    )
    filled = sums[0].any(axis=1)
    count, clear, total, offset, reaches = (v[filled] for v in sums)
    held = count.sum(axis=1)
    place, altitude, local = (
        np.bincount(block[used], v[used], filled.size)[filled] / held
        for v in (image.project(image.look), image.altitude, level)
    )
    middle, many = reaches.sum(axis=1) / held, np.maximum(count, 1)
    return Histogram(
        pixel_count=clear,
        intensity_sum=total,
        phase_offset=offset / many,
        range_offset=np.where(count > 0, reaches / many - middle[:, None], 0.0),
        place=place,
        ground_range=middle,
        altitude=altitude,
        trend=local,
        group=_groups(middle, max(1 / along, float(np.ptp(edges)) / MOST_GROUPS)),
        errors=np.zeros((0, *count.shape)),
        error_axes=np.zeros((0, 0)),
        error_information=np.zeros(0),
        error_signal=1.0,
        error_fitted=np.zeros(0),
        speckle_share=np.ones(count.shape),
    )


def _groups(reach: FloatArray, length: float) -> IntArray:
    """Return the groups of blocks that share a gain, each at least `length` long, m."""
    group, begin = np.zeros(len(reach), np.int64), reach[0]
    for b in range(1, len(reach)):
        enough = reach[b] - begin >= length and reach[-1] - reach[b] >= 0.9 * length
        group[b] = group[b - 1] + enough
        begin = reach[b] if enough else begin
    return group
