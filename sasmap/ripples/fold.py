"""Fold a clip by phase: a few hundred bins through which its pixels enter the likelihood."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.folded import FoldData
from sasmap.ripples.image import Image
from sasmap.ripples.kernel import BINS, PEAKED, SINE, STOKES
from sasmap.ripples.phase import PhaseField
from sasmap.ripples.pixels import (
    ALONG,
    COUNT,
    DITHER,
    FLAT,
    KNOWN,
    LOG_SLOPE,
    LOG_SLOPE2,
    PHASE,
    PHASE2,
    TILT,
    TOTAL,
    FoldPlan,
    fold_pixels,
)
from sasmap.ripples.scattering import ProfileName
from sasmap.ripples.shadow import MAX_STEEPNESS, ShadowRule, shadow_table

FloatArray = NDArray[np.float64]

# Blocks of one gain hold at least a wavelength; those of one geometry, no more than this change of
# the log of the ray's slope, where crests are straight.
MAX_GAINS = 8
MAX_CHANGE = 0.04
MAX_BLOCKS = 32
# Where whole columns of pixels share a phase, each tells a shadow's edge to about a third of a
# pixel, as this many pixels of its own would; together they would claim to know it to a hundredth,
# which no sonar's image and no navigation can bear.
EDGE_PIXELS = 1.5
# Strips across the look, and harmonics of the pulse, that tell how crests are turned.
STRIPS = 8
HARMONICS = 3
PROFILES: dict[ProfileName, int] = {"sine": SINE, "stokes": STOKES, "peaked": PEAKED}
# Blurs, rad: of straight crests at most a thirtieth of a wave; of a field, whose model would turn
# from all lit to dark at a point without some, no more than leaves a pulse.
STRAIGHT_BLURS, FIELD_BLURS = (1e-3, 0.2), (0.07, 1.5)
# Half-widths of bins and blocks never vanish: a point would make the likelihood a step.
MIN_HALF = 1e-3


def fold_plan(image: Image, phase: PhaseField, trend: FloatArray) -> FoldPlan:
    """Lay out the bins: blocks of like geometry along the look."""
    look = image.look
    right = np.array([look[1], -look[0]])
    place = image.project(look)[image.valid]
    start, length = float(place.min()), float(np.ptp(place)) + 1e-9
    gains = gain_blocks(phase, look, length)
    each = 1
    if phase.rigid:
        reach = image.ground_range[image.valid]
        change = float(np.log(reach.max() / max(reach.min(), 1e-3)))
        each = int(np.ceil(min(change / MAX_CHANGE, MAX_BLOCKS) / gains))
    blocks = gains * each
    return FoldPlan(
        image.per_pixel(phase.wave),
        look @ image.steps,
        right @ image.steps,
        start,
        length / blocks * (1 + 1e-9),
        blocks,
        BINS,
        phase.box,
        trend,
        phase.even,
        phase.odd,
        phase.tiles,
        not phase.rigid,
    )


def gain_blocks(phase: PhaseField, look: FloatArray, length: float) -> int:
    """Return how many blocks of their own gain a clip of a length along the look has."""
    return int(np.clip(length * float(np.abs(phase.wave @ look)), 1, MAX_GAINS))


def fold(
    image: Image,
    phase: PhaseField,
    trend: FloatArray,
    shadow: ShadowRule | None,
    profile: ProfileName,
    noise_factor: float,
) -> FoldData:
    """Fold a clip's pixels by their phase and make them ready for the compiled likelihood.

    Parameters
    ----------
    image : Image
    phase : PhaseField
        Whose `covered` boxes are folded.
    trend : ndarray
        Of the intensity, on the phase field's boxes.
    shadow : {"line-of-sight", "crest"} or None
        None where none can fall.
    profile : {"sine", "stokes", "peaked"}
    noise_factor : float
        How many times the variance of independent speckle the clip's speckle has.

    Returns
    -------
    FoldData
    """
    plan = fold_plan(image, phase, trend)
    used = image.valid & phase.pixels(phase.covered, image.shape)
    sums, places, met = fold_pixels(
        image.power, used, image.saturated, image.ground_range, image.altitude, plan
    )
    parts = np.asarray(sum((met >> k) & 1 for k in range(DITHER)), float)
    footprint = image.pixel_size * float(np.hypot(*phase.wave))  # in cycles
    columns = phase.rigid and float(np.median(parts[parts > 0])) < DITHER / 4
    # the variance of a footprint, on three bins
    leak = min((footprint * BINS) ** 2 / 16, 0.25) if columns else 0.0
    if columns:
        sums = _footprints(sums, leak)
    count, filled = np.maximum(sums[COUNT], 1), sums[COUNT] > 0
    blocks = _blocks(sums, places)
    gains = gain_blocks(phase, image.look, plan.width * plan.blocks)
    group = np.arange(plan.blocks) // (plan.blocks // gains)
    bins = _bins(sums, blocks, group) if phase.rigid else _even_bins(sums, blocks)
    dither = np.minimum(EDGE_PIXELS * np.maximum(parts, 1) / count + (parts / DITHER) ** 4, 1.0)
    known, total = sums[KNOWN], sums[TOTAL] + DYNAMIC_RANGE * sums[COUNT]
    ratio = np.where(filled, total / np.maximum(known, 1), 1.0)
    look = image.look
    right = np.array([look[1], -look[0]])
    return FoldData(
        pixels=known,
        total=total,
        log_mean=np.log(ratio),
        phase=bins.angle,
        half=2 * np.pi * np.maximum(bins.half, MIN_HALF),
        cosine=np.cos(bins.angle),
        sine=np.sin(bins.angle),
        ahead=bins.ahead,
        farther=bins.farther,
        steeper=bins.steeper,
        flat=bins.flat,
        dither=dither,
        leak=leak,
        guard=2 * np.pi * (2.5 if columns else 0.5) * footprint,
        reach=blocks.reach,
        altitude=blocks.altitude,
        tilt=blocks.tilt,
        spread=np.sqrt(3) * bins.spread,
        along=blocks.along,
        across=blocks.across,
        group=group,
        lagging=_line_weights(blocks.along, blocks.weight),
        base=np.array([phase.wave @ look, phase.wave @ right]),
        wave=phase.mean_wave,
        wave_precision=1 / phase.wave_sd**2,
        look=float(np.radians(image.azimuth)),
        table=shadow_table(shadow or "line-of-sight", profile),
        table_steepness=MAX_STEEPNESS,
        blur=np.array([np.log(phase.blur), 1 / phase.blur_sd**2]),
        blur_bounds=np.log(STRAIGHT_BLURS if phase.rigid else FIELD_BLURS),
        power=1 / noise_factor,
        profile=PROFILES[profile],
        shadow=0 if shadow is None else 2 if shadow == "crest" else 1,
        field=int(not phase.rigid),
    )


class _Blocks(NamedTuple):
    """Number of pixels of blocks and means over them (blocks,)."""

    weight: FloatArray
    along: FloatArray
    across: FloatArray
    reach: FloatArray
    altitude: FloatArray
    slope: FloatArray
    slope2: FloatArray
    tilt: FloatArray


class _Bins(NamedTuple):
    """Means over the pixels of bins (blocks, bins); spread of log slope in a block (blocks,)."""

    angle: FloatArray
    half: FloatArray
    ahead: FloatArray
    farther: FloatArray
    steeper: FloatArray
    flat: FloatArray
    spread: FloatArray


def _blocks(sums: FloatArray, places: FloatArray) -> _Blocks:
    """Means over blocks; over the clip for those without a pixel."""
    weight = places[0]

    def mean(total: FloatArray) -> FloatArray:
        return np.asarray(
            np.where(weight > 0, total / np.maximum(weight, 1), total.sum() / weight.sum())
        )

    along, across, reach, altitude = (mean(total) for total in places[1:])
    slope, slope2, tilt = (mean(sums[k].sum(axis=1)) for k in (LOG_SLOPE, LOG_SLOPE2, TILT))
    return _Blocks(weight, along, across, reach, altitude, slope, slope2, tilt)


def _bins(sums: FloatArray, blocks: _Blocks, group: NDArray[np.int64]) -> _Bins:
    """Bins of straight crests: each has its own phase, place and ray."""
    filled, count = sums[COUNT] > 0, np.maximum(sums[COUNT], 1)
    offset = sums[PHASE] / count
    flat = np.bincount(group, sums[FLAT].sum(axis=1)) / np.bincount(group, blocks.weight + 1e-9)
    flat = flat[group][:, None]
    variance = np.maximum(sums[LOG_SLOPE2] / count - (sums[LOG_SLOPE] / count) ** 2, 0)
    within = (variance * sums[COUNT]).sum(axis=1) / np.maximum(blocks.weight, 1)

    def beyond(k: int, place: FloatArray) -> FloatArray:
        return np.where(filled, sums[k] / count - place[:, None], 0)

    return _Bins(
        2 * np.pi * ((np.arange(BINS) + 0.5) / BINS + offset),
        np.sqrt(3 * np.maximum(sums[PHASE2] / count - offset**2, 0)),
        beyond(ALONG, blocks.along),
        beyond(LOG_SLOPE, blocks.slope),
        beyond(TILT, blocks.tilt),
        np.where(filled, sums[FLAT] / count / np.maximum(flat, 1e-9), 1.0),
        np.sqrt(within),
    )


def _even_bins(sums: FloatArray, blocks: _Blocks) -> _Bins:
    """Bins of bent crests: an even grid of phase, each with its whole block's rays."""
    shape = sums[COUNT].shape
    angle = np.broadcast_to(2 * np.pi * (np.arange(BINS) + 0.5) / BINS, shape).copy()
    spread = np.sqrt(np.maximum(blocks.slope2 - blocks.slope**2, 0))
    none = np.zeros(shape)
    return _Bins(angle, np.full(shape, 0.5 / BINS), none, none, none, np.ones(shape), spread)


def _footprints(sums: FloatArray, side: float) -> FloatArray:
    """Spread sums (SUMS, blocks, bins) by a pixel's footprint: this share to each neighbour."""
    result = (1 - 2 * side) * sums
    for shift in (1, -1):
        moved = np.roll(sums, shift, axis=-1)
        # a pixel keeps its phase, told from the centre of the bin that it comes to
        offset = -shift / BINS
        moved[PHASE2] += 2 * offset * moved[PHASE] + offset**2 * moved[COUNT]
        moved[PHASE] += offset * moved[COUNT]
        result += side * moved
    return np.asarray(result)


def _line_weights(place: FloatArray, weight: FloatArray) -> FloatArray:
    """Weights whose sum with values at places is the slope of the line fitted to them, 1/m."""
    offset = place - np.average(place, weights=weight)
    square = float((weight * offset**2).sum())
    return np.asarray(weight * offset / square if square > 0 else np.zeros_like(place))


def turn_across(
    image: Image, phase: PhaseField, wave: FloatArray, trend: FloatArray
) -> tuple[float, float]:
    """How far straight crests are turned from a wave, by the pulse's phase in strips.

    Strips across the look are folded at the wave and their phase is told by the pulse that all
    share: the score of the speckle likelihood over its information.

    Parameters
    ----------
    image : Image
    phase : PhaseField
        Of straight crests.
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.
    trend : ndarray
        Of the intensity, on the phase field's boxes.

    Returns
    -------
    turn : float
        What is missing of the wave vector's component across the look (to the right of it),
        cycles/m.
    sd : float
        Its standard deviation, cycles/m, with independent speckle.
    """
    plan = fold_plan(image, replace(phase, wave=wave), trend)
    used = image.valid & phase.pixels(phase.covered, image.shape)
    look = image.look
    place = image.project(np.array([look[1], -look[0]]))[used]
    start, length = float(place.min()), float(np.ptp(place)) + 1e-9
    plan = plan._replace(
        along=plan.across, start=start, width=length / STRIPS * (1 + 1e-9), blocks=STRIPS
    )
    sums, places, _ = fold_pixels(
        image.power, used, image.saturated, image.ground_range, image.altitude, plan
    )
    pixels, total = sums[KNOWN], sums[TOTAL] + DYNAMIC_RANGE * sums[COUNT]
    pulse = total.sum(axis=0) / np.maximum(pixels.sum(axis=0), 1)
    lines = np.fft.rfft(pulse)
    lines[HARMONICS + 1 :] = 0
    smooth = np.maximum(np.fft.irfft(lines, BINS), 0.25 * pulse.mean())
    slope = np.fft.irfft(1j * np.arange(lines.size) * lines, BINS) / smooth
    score = ((total / smooth - pixels) * slope).sum(axis=1)
    information = (pixels * slope**2).sum(axis=1)
    centre = places[1] / np.maximum(places[0], 1)
    weight = information / max(information.sum(), 1e-300)
    offset = centre - (weight * centre).sum()
    square = max(float((information * offset**2).sum()), 1e-12)
    turn = float((offset * score).sum()) / square / (2 * np.pi)
    sd = 1 / (2 * np.pi * np.sqrt(square))
    return float(np.clip(turn, -0.25 / length, 0.25 / length)), float(sd)
