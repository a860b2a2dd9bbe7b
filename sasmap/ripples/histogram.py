"""The phase-range histogram of a clip: the sums through which its pixels enter the likelihood."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.image import Image
from sasmap.ripples.phase import PhaseField
from sasmap.ripples.pixels import (
    ALTITUDE,
    COUNT,
    INTENSITY,
    OFFSET,
    PIXELS,
    PLACE,
    RANGE,
    REACH,
    TREND,
    UNSATURATED,
    sum_pixels,
)
from sasmap.ripples.rendering import Histogram

FloatArray = NDArray[np.float64]

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
    used = image.valid & phase.pixels(phase.covered, image.shape)
    along = float(phase.wave @ image.look)
    pixels = 1 / (along * image.pixel_size)
    a_pixel, most = SHARP_BINS if published else BINS
    bins = int(np.clip(round(a_pixel * pixels), LEAST_BINS, most))
    reach = image.ground_range[used]
    edges = range_edges(float(reach.min()), float(reach.max()))
    sums, blocks = sum_pixels(
        image.power + DYNAMIC_RANGE,
        used,
        image.saturated,
        image.ground_range,
        image.altitude,
        trend,
        phase.cycles,
        phase.per_pixel(image),
        image.look @ image.steps,
        edges,
        bins,
        phase.box,
    )
    return _as_histogram(sums, blocks, max(1 / along, float(np.ptp(edges)) / MOST_GROUPS))


def _as_histogram(sums: FloatArray, blocks: FloatArray, length: float) -> Histogram:
    """Drop empty blocks, turn sums into means and number the groups that share a gain."""
    filled = blocks[:, PIXELS] > 0
    sums, blocks = sums[filled], blocks[filled]
    mean = blocks / blocks[:, [PIXELS]]
    pixels = np.maximum(sums[..., COUNT], 1)
    group = np.zeros(len(mean), np.int64)
    begin = mean[0, RANGE]
    for b in range(1, len(mean)):
        whole = mean[b, RANGE] - begin >= length
        enough = mean[-1, RANGE] - mean[b, RANGE] >= 0.9 * length
        group[b] = group[b - 1] + (whole and enough)
        if group[b] > group[b - 1]:
            begin = mean[b, RANGE]
    return Histogram(
        sums[..., UNSATURATED].copy(),
        sums[..., INTENSITY].copy(),
        sums[..., OFFSET] / pixels,
        np.where(sums[..., COUNT] > 0, sums[..., REACH] / pixels - mean[:, [RANGE]], 0.0),
        mean[:, PLACE].copy(),
        mean[:, RANGE].copy(),
        mean[:, ALTITUDE].copy(),
        mean[:, TREND].copy(),
        group,
        np.zeros((0, *sums.shape[:2])),
        np.zeros((0, 0)),
        np.zeros(0),
        1.0,
        np.zeros(0),
        np.ones(sums.shape[:2]),
    )
