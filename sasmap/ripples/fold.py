"""Fold a clip by phase: a few thousand bins through which its pixels enter the likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.folded import FoldData
from sasmap.ripples.image import Image
from sasmap.ripples.kernel import PEAKED, SINE, SLIP_SD, STOKES, shadow_places
from sasmap.ripples.phase import PhaseField
from sasmap.ripples.pixels import (
    ALONG,
    COUNT,
    EDGE_BLOCK,
    EDGE_POWER,
    KNOWN,
    PHASE,
    TOTAL,
    FoldPlan,
    fold_pixels,
    spread_boxes,
)
from sasmap.ripples.scattering import SIGMA_VARIANCE, ProfileName
from sasmap.ripples.shadow import MAX_STEEPNESS, ShadowRule, shadow_table

FloatArray = NDArray[np.float64]

PROFILES: dict[ProfileName, int] = {"sine": SINE, "stokes": STOKES, "peaked": PEAKED}
# Bins of phase.
BINS = 48
# Strips of one gain hold at least a wavelength; one of straight crests spans no more than this
# change of the log of the range.
MAX_GAINS = 8
MAX_CHANGE = 0.15
# Cells to which the ends of strips are rounded, and blocks of a strip.
CELLS = 256
SIDES = 3
# Log of the range over that where shadow sets in at which strips end: there its edges part fast.
ONSET = (-0.03, -0.01, 0.0, 0.002, 0.006, 0.012, 0.03, 0.06, 0.12)
ONSET_SEARCH = 400
# Factors of the range between which a strip's shadow must not set in to be told for sure, at first
# and again and again; and those that tell how its edges move.
NEARER, FARTHER, NEXT = (0.92, 0.97, 0.994), (1.08, 1.03, 1.012), (0.995, 1.005)
# Pixels near the edges of straight crests' shadow are looked at one by one: these many. How near,
# and how far from its place an edge may be seen at a pixel (standard deviation), in pixels, at
# first and when a fold is made again and again. Floors are not quite even, and images know them by
# their pixels.
EDGE_PIXELS = 450
ZONES, EDGE_SDS = (5.0, 2.0, 1.0), (1.0, 0.4, 0.12)
# But no more of a wave than this, cycles.
MAX_ZONES = (0.07, 0.05, 0.05)
# Largest and smallest error of a field, rad: with less the model would turn from all lit to dark at
# a point, with more no pulse is left.
FIELD_BLURS = (0.07, 1.5)
# The same where a grid of phase is but a first search for straight crests.
COARSE_BLURS = (0.03, 0.5)
# Altitudes across a strip that differ by no more than this are the same.
SAME_ALTITUDE = 1e-3


class Reference(NamedTuple):
    """A point of the posterior that a fold is made for.

    Attributes
    ----------
    theta : ndarray (SIZE,)
    data : FoldData
        An earlier fold of the same clip, for its rule, profile and look.
    """

    theta: FloatArray
    data: FoldData


class _Bend(NamedTuple):
    """Where shadow's edges lie in a fold: ripple phase at its beginning, and FoldPlan.bend."""

    zero: float
    bend: FloatArray


def gain_groups(phase: PhaseField, look: FloatArray, length: float) -> int:
    """Return how many groups of their own gain a clip of a length along the look has."""
    return int(np.clip(length * float(np.abs(phase.wave @ look)), 1, MAX_GAINS))


def fold_plan(
    image: Image, phase: PhaseField, reference: Reference | None
) -> tuple[FoldPlan, NDArray[np.int64], float]:
    """Lay out strips, blocks and bins.

    Parameters
    ----------
    image : Image
    phase : PhaseField
    reference : Reference or None
        For straight crests: where to follow the edges of shadow; none for an even grid of phase.

    Returns
    -------
    plan : FoldPlan
    group : ndarray of int (strips,)
        Strips that share a gain.
    zero : float
        Ripple phase at the first bin's beginning, rad.
    """
    look = image.look
    right = np.array([look[1], -look[0]])
    (start, length), (side, width) = image.extent(look), image.extent(right)
    groups = gain_groups(phase, look, length)
    cells = np.arange(CELLS) * groups // CELLS
    wave, shift, sides, strip = phase.wave, 0.0, 1, cells
    if reference is not None:
        theta, sides = reference.theta, SIDES
        turn = theta[2] - reference.data.look
        wave = theta[0] * (np.cos(turn) * look + np.sin(turn) * right)
        strip = _strips(image, reference, groups, start, length)
        shift = float(theta[3])
    strips = int(strip[-1]) + 1
    step = length / CELLS
    place = start + step * (np.arange(CELLS) + 0.5)
    centre = np.bincount(strip, place) / np.bincount(strip)
    zero, bend = _bend(image, reference, centre)
    zone, _ = _nearness(image, reference, wave)
    near = 4 * zone * np.mean(bend[strip, 1] > 0) * image.valid.sum()
    return (
        FoldPlan(
            image.per_pixel(wave),
            (shift - zero) / (2 * np.pi),
            look @ image.steps,
            right @ image.steps,
            start,
            1 / step,
            strip,
            centre,
            side,
            sides / width,
            sides,
            BINS,
            bend,
            zone,
            min(EDGE_PIXELS / max(near, 1.0), 1.0),
            2 * EDGE_PIXELS,
        ),
        cells[np.searchsorted(strip, np.arange(strips))],
        zero,
    )


def _nearness(image: Image, reference: Reference | None, wave: FloatArray) -> tuple[float, float]:
    """Return what is near an edge of shadow, and how far from its place it may be seen, cycles."""
    stage = 0 if reference is None else reference.data.fine
    pixel = image.pixel_size * float(np.hypot(*wave))
    zone = min((ZONES[stage] + 2 * image.jitter) * pixel, MAX_ZONES[stage])
    return zone, min(float(np.hypot(EDGE_SDS[stage], image.jitter)) * pixel, 0.4 * zone)


def _strips(
    image: Image,
    reference: Reference,
    groups: int,
    start: float,
    length: float,
) -> NDArray[np.int64]:
    """Strip of each cell: of one gain, little change of range, and short where shadow sets in."""
    near, far = image.range_limits
    each = int(np.clip(np.ceil(np.log(far / max(near, 1e-3)) / MAX_CHANGE / groups), 1, 4))
    cut = np.zeros(CELLS, bool)
    cut[1:] = np.diff(np.arange(CELLS) * groups * each // CELLS) != 0
    onset = _onset(reference, near, far, image.mean_altitude)
    if onset is not None:
        places = onset * np.exp(ONSET) - image.mean_range  # from the clip's centre
        rows = ((places - start) / length * CELLS).astype(int)
        cut[rows[(rows > 0) & (rows < CELLS)]] = True
    return np.cumsum(cut)


def _onset(reference: Reference, near: float, far: float, altitude: float) -> float | None:
    """Ground range, m, near those of a clip, at which shadow sets in at the reference."""
    if reference.data.shadow == 0:
        return None
    reach = np.geomspace(0.85 * near, 1.1 * far, ONSET_SEARCH)
    edges = _edges(reference, reach, np.full(ONSET_SEARCH, altitude))
    flips = np.flatnonzero(np.diff(edges[:, 1] > edges[:, 0]))
    return float(np.sqrt(reach[flips[0]] * reach[flips[0] + 1])) if flips.size else None


def _edges(reference: Reference, reach: FloatArray, altitude: FloatArray) -> FloatArray:
    """Begin and end of shadow at ranges and altitudes, cycles past the crest (n, 2)."""
    theta = reference.theta.copy()
    theta[5] = 0.0
    data = reference.data._replace(reach=np.maximum(reach, 1e-3), altitude=altitude)
    return np.asarray(shadow_places(theta, data))


def _bend(image: Image, reference: Reference | None, centre: FloatArray) -> _Bend:
    """Follow the edges of shadow at the reference."""
    bend = np.zeros((centre.size, 5))
    if reference is None:
        return _Bend(0.0, bend)
    lit = _Bend(0.5 * np.pi, bend)
    if reference.data.shadow == 0:
        return lit
    reach = image.mean_range + centre
    altitude = np.full(centre.size, image.mean_altitude)
    stage = reference.data.fine
    near, here, far, before, behind = (
        _edges(reference, reach * k, altitude) for k in (NEARER[stage], 1.0, FARTHER[stage], *NEXT)
    )
    falls = np.array([edges[:, 1] > edges[:, 0] for edges in (near, here, far)])
    some = np.asarray(falls.any(axis=0))
    unsure = np.asarray(some & ~falls.all(axis=0))
    place = np.where(unsure[:, None], far, here)
    width = np.where(some, place[:, 1] - place[:, 0], 0.0)
    if not width.max() > 0:
        return lit
    most = int(np.argmax(width))
    turn = 0.5 * (place[most].sum() + 1) % 1  # in the middle of what the darkest strip shows
    moved = (place - turn) % 1
    shadowed = (width > 0) & (moved[:, 1] > moved[:, 0]) & (moved[:, 0] > 0)
    slope = (behind - before) / ((NEXT[1] - NEXT[0]) * reach[:, None])
    slope[unsure] = 0.0
    bend[shadowed] = np.column_stack([moved, slope, unsure])[shadowed]
    return _Bend(2 * np.pi * (0.25 + turn), bend)


def fold(
    image: Image,
    phase: PhaseField,
    trend: FloatArray,
    shadow: ShadowRule | None,
    profile: ProfileName,
    reference: Reference | None = None,
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
    reference : Reference, optional
        For straight crests: fold at this point of the posterior, and follow the edges of shadow.

    Returns
    -------
    FoldData
        With the likelihood of independent speckle.
    """
    plan, group, zero = fold_plan(image, phase, reference)
    used = image.valid & phase.pixels(phase.covered, image.shape)
    sums, dark, places, edges = fold_pixels(
        detrended(image, phase, trend),
        used,
        image.saturated,
        image.ground_range,
        image.altitude,
        phase.cycles(image.shape),
        plan,
        zero,
    )
    count = sums[..., COUNT]
    dark[:, 1] += DYNAMIC_RANGE * dark[:, 0]
    edges = edges[np.argsort(edges[:, EDGE_BLOCK], kind="stable")]
    edges[:, EDGE_POWER] += DYNAMIC_RANGE
    blocks = _blocks(plan, places)
    bins = _bins(sums, blocks)
    if reference is None:
        bins = _even_bins(bins)
    blur, blur_bounds = _blur(image, phase, reference)
    return FoldData(
        known=np.ascontiguousarray(sums[..., KNOWN]),
        total=sums[..., TOTAL] + DYNAMIC_RANGE * count,
        cosine=np.cos(bins.angle + zero),
        sine=np.sin(bins.angle + zero),
        ahead=bins.ahead,
        steeper=bins.steeper,
        flat=bins.flat,
        dark=dark,
        edges=edges,
        edge_start=np.searchsorted(edges[:, EDGE_BLOCK], np.arange(len(dark) + 1)),
        edge_sd=_nearness(image, reference, phase.wave)[1],
        along=blocks.along,
        across=blocks.across,
        reach=blocks.reach,
        altitude=blocks.altitude,
        tilt=blocks.tilt,
        spread=blocks.spread,
        group=group,
        lagging=_line_weights(blocks.along, blocks.weight),
        zero=zero,
        reference=_folded_by(image, phase, reference),
        wave=phase.mean_wave,
        wave_precision=1 / phase.wave_sd**2,
        look=float(np.radians(image.azimuth)),
        table=shadow_table(shadow or "line-of-sight", profile),
        table_steepness=MAX_STEEPNESS,
        blur=blur,
        blur_bounds=blur_bounds,
        pixel=image.pixel_size * float(np.hypot(*phase.wave)),
        power=1.0,
        profile=PROFILES[profile],
        shadow=0 if shadow is None else 2 if shadow == "crest" else 1,
        field=int(not phase.rigid),
        fine=0 if reference is None else min(reference.data.fine + 1, len(ZONES) - 1),
    )


def _folded_by(image: Image, phase: PhaseField, reference: Reference | None) -> FloatArray:
    """Phase, rad, and wave vector along and across the look, cycles/m, of a fold."""
    if reference is None:
        look, wave = image.look, phase.wave
        return np.array([0.0, wave @ look, wave[0] * look[1] - wave[1] * look[0]])
    f, _, azimuth, shift = reference.theta[:4]
    turn = azimuth - reference.data.look
    return np.array([shift, f * np.cos(turn), f * np.sin(turn)])


def _blur(
    image: Image, phase: PhaseField, reference: Reference | None
) -> tuple[FloatArray, FloatArray]:
    """Mean and precision of the last parameter, and its bounds."""
    if reference is None:
        bounds = np.log(COARSE_BLURS if phase.rigid else FIELD_BLURS)
        return np.array([np.log(phase.blur), 1 / phase.blur_sd**2]), bounds
    known = float(np.hypot(SLIP_SD, image.jitter))
    return np.array([0.0, 1 / known**2]), np.array([-3.0, 3.0]) * known


def detrended(image: Image, phase: PhaseField, trend: FloatArray) -> FloatArray:
    """Intensity of a clip over a trend on the phase field's boxes (rows, columns)."""
    if not np.ptp(trend) > 0:
        return image.power
    return np.asarray(image.power / spread_boxes(trend, phase.box, image.shape))


class _Blocks(NamedTuple):
    """Means over blocks (blocks,); geometry at the middle of their strip."""

    weight: FloatArray
    along: FloatArray
    across: FloatArray
    reach: FloatArray
    own_reach: FloatArray
    altitude: FloatArray
    tilt: FloatArray
    spread: FloatArray
    flat: float


class _Bins(NamedTuple):
    """Means over the pixels of bins (blocks, bins)."""

    angle: FloatArray
    ahead: FloatArray
    steeper: FloatArray
    flat: FloatArray


def _blocks(plan: FoldPlan, places: FloatArray) -> _Blocks:
    """Means over blocks; over the clip for those without a pixel."""
    weight = places[:, 0]
    whole = places.sum(axis=0) / weight.sum()
    mean = np.where(weight[:, None] > 0, places / np.maximum(weight, 1)[:, None], whole)
    _, along, across, own, altitude = mean.T
    strip = np.repeat(np.arange(plan.centre.size), plan.blocks)
    total = np.bincount(strip, weight)
    level = np.bincount(strip, altitude * weight) / np.maximum(total, 1)
    level = np.where(total > 0, level, whole[4])[strip]
    if np.ptp(altitude / level) < SAME_ALTITUDE:
        altitude = level
    reach = np.maximum(own + plan.centre[strip] - along, 0.1 * own)
    tilt = np.arctan2(reach, altitude)
    flat = np.exp(-(np.arctan2(own, altitude) ** 2) / SIGMA_VARIANCE)
    # strips are even along the look: half the width of log range, shortened by what they lack
    half = 0.5 * np.bincount(plan.strip) / plan.cells
    return _Blocks(
        weight,
        along,
        across,
        reach,
        own,
        altitude,
        tilt,
        np.arctanh(np.minimum(half[strip] / reach, 0.95)),
        float((flat * weight).sum() / weight.sum()),
    )


def _bins(sums: FloatArray, blocks: _Blocks) -> _Bins:
    """Bins of straight crests: each has its own phase, place and ray."""
    count = sums[..., COUNT]
    filled, many = count > 0, np.maximum(count, 1)
    bins = count.shape[1]
    offset = sums[..., PHASE] / many
    ahead = np.where(filled, sums[..., ALONG] / many - blocks.along[:, None], 0.0)
    reach = np.maximum(blocks.own_reach[:, None] + ahead, 1e-3)
    tilt = np.arctan2(reach, blocks.altitude[:, None])
    return _Bins(
        2 * np.pi * ((np.arange(bins) + 0.5) / bins + offset),
        ahead,
        tilt - blocks.tilt[:, None],
        np.exp(-(tilt**2) / SIGMA_VARIANCE) / blocks.flat,
    )


def _even_bins(bins: _Bins) -> _Bins:
    """Bins of an even grid of phase, each with its whole block's rays but its own floor."""
    shape = bins.angle.shape
    angle = np.broadcast_to(2 * np.pi * (np.arange(shape[1]) + 0.5) / shape[1], shape).copy()
    none = np.zeros(shape)
    return _Bins(angle, none, none, bins.flat)


def _line_weights(place: FloatArray, weight: FloatArray) -> FloatArray:
    """Weights whose sum with values at places is the slope of the line fitted to them, 1/m."""
    offset = place - np.average(place, weights=weight)
    square = float((weight * offset**2).sum())
    return np.asarray(weight * offset / square if square > 0 else np.zeros_like(place))
