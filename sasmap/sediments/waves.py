"""Amplitude of the floor with its ripples averaged out.

Ripples are removed without a model of them: where the local spectrum has a peak, the image of log
intensity is demodulated at its wave number, pixels are folded by the resulting phase, and the mean
profile, a few harmonics of the wave, is subtracted. Shadow of the ripples is part of the profile
and so of the bed; a profile has zero mean, so sediments keep their level. Where crests turn, fork
or cross, no single profile holds: its residual at the scale of the ripples is subtracted as well,
down to the speckle level. The cells in which ripples are estimated are not used.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from math import ceil, hypot
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, irfft, next_fast_len, rfft, rfft2
from scipy.ndimage import gaussian_filter

from sasmap.arrays import BoolArray, FloatArray, IntArray

Single = NDArray[np.float32]
Part = tuple[slice, slice]

# Side in pixels of the squares that are averaged first; side in averaged pixels of windows, which
# overlap by half: small ones find short ripples in small patches, large ones long and weak ripples.
COARSE, WINDOWS = 4, (128, 64)
LATTICE, MARGIN = COARSE * WINDOWS[0] // 2, COARSE * WINDOWS[0]
# Difference, in modes of a small window, within which its wave is that of a large window, which
# then suffices if it finds ripples all over the small one: equal waves are up to one mode apart.
SAME = 1.5
# Shortest wavelength searched, in averaged pixels (shorter ones average out in the blocks of 16
# pixels by which sediments are found), and minimum number of waves in a window.
SHORTEST, FEWEST = 5.0, 4
# Minimum power of a wave relative to the median of its ring. Speckle power is exponential: the
# highest of 4000 is 12 medians, and one window in a million reaches 30; recorded and simulated
# ripples have 200 or more. Ratio of the power at a wave number to that at half of it, in the same
# direction, from which it may be and surely is a wave: an edge has a quarter, a soft one up to 2.
# Forked crests in a window of eight had only 1.4: they need a neighbouring window that is surely
# not an edge, with nearly the same wave (within this share of its wave number).
STANDS_OUT, RISES, BESIDE = 40.0, (1.0, 2.0), 0.4
# A peak may be an overtone of the wave at these shares of its wave number.
WITHIN = (1.0, 1 / 2, 1 / 3)
# Minimum known share of a window; number of windows whose spectra are computed at once.
KNOWN, AT_ONCE = 0.25, 64
# Widths (standard deviation, in wavelengths across and along the crests) over which the phase, the
# profile and its explained variance are averaged.
PHASE, PROFILE, NEAR = (0.6, 0.6), (0.5, 1.5), (0.15, 1.0)
# The widest of all; padding of an image in standard deviations, at most half of the largest window;
# and standard deviations beyond which a Gaussian's spectrum (1e-5) is negligible.
WIDEST, PADDED, REACHES = (1.0, 1.5), 4.0, 4.8
HARMONICS = 6
# Maximum share of the variance of log intensity that a profile leaves, minimum amplitude of its
# fundamental, and maximum local strength relative to the mean profile.
EXPLAINED, LEAST, STRONGEST = 0.7, 0.15, 2.0
# Minimum intensity relative to the local mean (20 dB below it there is only noise).
FLOOR = 0.01
# Averaged pixels (standard deviation) over which the residual of a profile is smoothed, and widths,
# in wavelengths, over which its power is compared with that of speckle.
REST, JUDGED = 1.0, (0.5, 0.5)
# Radius, in wavelengths, of holes closed in the rippled area, and of the smallest patches kept.
CLOSED, OPENED = 1.0, 0.5


class Waves(NamedTuple):
    """Ripples as seen in an image.

    Attributes
    ----------
    profile : ndarray of float32 (rows, columns)
        Log of the rippled floor's amplitude relative to the same floor flat; 0 without ripples.
    rippled : ndarray of bool (rows, columns)
    """

    profile: Single
    rippled: BoolArray


def find_waves(amplitude: NDArray[np.floating], inner: Part | None = None) -> Waves:
    """Find ripples in an image and their effect on its amplitude.

    Parameters
    ----------
    amplitude : ndarray (rows, columns)
        NaN where there is none. Pieces of a survey agree where they begin at multiples of
        ``LATTICE`` pixels and reach ``MARGIN`` pixels beyond `inner`.
    inner : tuple of slice, optional
        Part of the image to return; default all.

    Returns
    -------
    Waves
        Within `inner`.
    """
    inner = inner or (slice(0, amplitude.shape[0]), slice(0, amplitude.shape[1]))
    rows, columns = (slice(s.start // COARSE, -(-s.stop // COARSE)) for s in inner)
    level, known = coarse(amplitude)
    profile, weight, rippled = (np.zeros(level.shape, np.float32) for _ in range(3))
    told: list[tuple[Part, _Wave, BoolArray]] = []
    for size in WINDOWS:
        larger = tuple(told)
        for part, wave in _waves_about(level, known, (rows, columns), size):
            if any(wave.near(w, SAME / size) and _all(there, p, part) for p, w, there in larger):
                continue
            taper = np.hanning(size + 2)[1:-1].astype(np.float32)
            height, width = (s.stop - s.start for s in part)
            hat = np.outer(taper[:height], taper[:width])
            weight[part] += hat
            there, found = _profile(level[part], known[part], wave.number)
            profile[part] += hat * found
            rippled[part] += hat * there
            told.append((part, wave, there))
    if not rippled.any():
        asked = [s.stop - s.start for s in inner]
        return Waves(np.zeros(asked, np.float32), np.zeros(asked, bool))
    mask = (rippled > 0.5 * np.maximum(weight, 1e-9)) & (known > 0)
    # average over the windows that find ripples there
    fine = _fine(np.where(mask, profile / np.maximum(rippled, 1e-9), 0), inner)
    whole = np.repeat(np.repeat(mask, COARSE, axis=0), COARSE, axis=1)
    padded = np.zeros(amplitude.shape, bool)
    padded[: whole.shape[0], : whole.shape[1]] = whole
    return Waves((0.5 * fine).astype(np.float32), padded[inner])


def coarse(amplitude: NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
    """Log of the mean intensity of small squares, and whether any of it is known (1, else 0)."""
    mean = _intensities(amplitude, COARSE)
    known = mean > 0
    return np.log(np.where(known, mean, 1.0)), known.astype(float)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _intensities(amplitude, side):  # type: ignore[no-untyped-def]
    """Mean square of the known pixels of squares; 0 where there are none."""
    rows, columns = amplitude.shape[0] // side, amplitude.shape[1] // side
    result = np.zeros((rows, columns))
    for r in range(rows):
        for c in range(columns):
            total, count = 0.0, 0
            for i in range(r * side, (r + 1) * side):
                for j in range(c * side, (c + 1) * side):
                    value = float(amplitude[i, j])
                    if np.isfinite(value):
                        total += value * value
                        count += 1
            result[r, c] = total / count if count else 0.0
    return result


def _windows(shape: tuple[int, ...], size: int) -> list[tuple[slice, slice]]:
    """Windows on the lattice; the whole image where it is smaller than one."""
    firsts = [sorted({*range(0, max(n - size, 0) + 1, size // 2), max(n - size, 0)}) for n in shape]
    return [
        (slice(r, min(r + size, shape[0])), slice(c, min(c + size, shape[1])))
        for r in firsts[0]
        for c in firsts[1]
    ]


class _Wave(NamedTuple):
    """Wave number (cycles per averaged pixel, down and across); power relative to half of it."""

    down: float
    across: float
    rise: float

    @property
    def number(self) -> tuple[float, float]:
        return self.down, self.across

    def like(self, other: _Wave) -> bool:
        """Whether another wave is nearly the same."""
        return self.near(other, BESIDE * hypot(*other.number))

    def near(self, other: _Wave, most: float) -> bool:
        """Whether wave numbers differ by at most `most`; opposite ones are the same wave."""
        apart = hypot(self.down - other.down, self.across - other.across)
        mirrored = hypot(self.down + other.down, self.across + other.across)
        return min(apart, mirrored) <= most


def _waves_about(
    level: FloatArray, known: FloatArray, asked: Part, size: int
) -> Iterator[tuple[Part, _Wave]]:
    """Yield the windows that overlap the requested part and have a wave, with that wave.

    Windows with few ripples do not count against those that other windows find there.
    """
    every = _windows(level.shape, size)
    mine = [part for part in every if _overlap(part, asked)]
    found = [(p, w) for p, w in zip(mine, _waves(level, known, mine, size), strict=True) if w]
    doubtful = [p for p, wave in found if wave.rise < RISES[1]]
    beside = [p for p in every if not _overlap(p, asked) and any(_overlap(p, d) for d in doubtful)]
    others = [(p, w) for p, w in zip(beside, _waves(level, known, beside, size), strict=True) if w]
    sure = [(p, wave) for p, wave in found + others if wave.rise >= RISES[1]]
    for part, wave in found:
        if wave.rise >= RISES[1] or any(_overlap(part, p) and wave.like(w) for p, w in sure):
            yield part, wave


def _all(mask: BoolArray, whole: Part, part: Part) -> bool:
    """Whether a part lies in a window whose mask covers all of it."""
    inside = all(a.start <= b.start and b.stop <= a.stop for a, b in zip(whole, part, strict=True))
    place = (slice(b.start - a.start, b.stop - a.start) for a, b in zip(whole, part, strict=True))
    return inside and bool(mask[tuple(place)].all())


def _overlap(first: Part, second: Part) -> bool:
    return all(a.start < b.stop and a.stop > b.start for a, b in zip(first, second, strict=True))


def _waves(
    level: FloatArray, known: FloatArray, parts: Sequence[Part], size: int
) -> list[_Wave | None]:
    """Find the wave of the ripples in each window."""
    found: list[_Wave | None] = [None] * len(parts)
    enough = [
        i
        for i, part in enumerate(parts)
        if known[part].mean() >= KNOWN and min(known[part].shape) >= 3 * SHORTEST
    ]
    for first in range(0, len(enough), AT_ONCE):
        some = enough[first : first + AT_ONCE]
        flat = np.zeros((len(some), size, size), np.float32)
        for target, i in zip(flat, some, strict=True):
            here, there = level[parts[i]], known[parts[i]]
            hat = np.outer(*(np.hanning(n + 2)[1:-1] for n in here.shape)) * there
            height, width = here.shape
            target[:height, :width] = (here - (here * hat).sum() / hat.sum()) * hat
        power = _power(flat)
        over = np.zeros((len(some), power[0].size))
        for ring in _rings(size):
            values = power.reshape(len(some), -1)[:, ring]
            over[:, ring] = values / np.maximum(np.median(values, axis=1, keepdims=True), 1e-300)
        for i, one, ratio in zip(some, power, over, strict=True):
            found[i] = _peak(one, ratio, size)
    return found


def _power(flat: Single) -> FloatArray:
    """Power spectra of images, each mode the mean of the nine around it; across from 0 on."""
    half = np.square(np.abs(rfft2(flat)).astype(float))
    # beyond both ends are the modes of the mirrored wave number
    rows = -np.arange(flat.shape[1]) % flat.shape[1]
    wide = np.concatenate([half[:, rows, 1:2], half, half[:, rows, -2:-1]], axis=2)
    across = wide[:, :, :-2] + wide[:, :, 1:-1] + wide[:, :, 2:]
    return np.asarray((np.roll(across, 1, axis=1) + across + np.roll(across, -1, axis=1)) / 9)


def _peak(power: FloatArray, over: FloatArray, size: int) -> _Wave | None:
    """Find the wave number that stands out of its ring, if there is one and it is not an edge."""
    place = int(np.argmax(over))
    if over[place] < STANDS_OUT:
        return None
    k = _mode(np.unravel_index(place, power.shape), size)
    # a sharp crest's overtone may stand out more than the wave itself, but has less power
    k = max((_summit(power, k * share, over, size) for share in WITHIN), key=lambda v: v[0])[1]
    rise = float(_about(power, k, size).max() / max(_about(power, k / 2, size).max(), 1e-300))
    return _Wave(float(k[0]) / size, float(k[1]) / size, rise) if rise >= RISES[0] else None


def _mode(place: tuple[Any, ...], size: int) -> IntArray:
    """Cycles per window, down and across, at an index of half a spectrum."""
    row, column = (int(v) for v in place)
    return np.array([row - size * (row > size // 2), column])


def _near(k: NDArray[Any], size: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the nine modes about a wave number (cycles per window)."""
    down, across = (np.arange(h - 1, h + 2) for h in np.rint(k).astype(int))
    # a real image has the same power at the opposite wave number
    down = np.where(across[None] < 0, -down[:, None], down[:, None]) % size
    return down, np.broadcast_to(np.abs(across)[None], down.shape)


def _about(power: FloatArray, k: NDArray[Any], size: int) -> FloatArray:
    """Power of the nine modes about a wave number."""
    return np.asarray(power[_near(k, size)])


def _summit(
    power: FloatArray, k: NDArray[Any], over: FloatArray, size: int
) -> tuple[float, IntArray]:
    """Climb to the strongest mode that stands out near a wave number; return its power and it."""
    ratio = over.reshape(power.shape)
    best = 0.0, np.rint(k).astype(int)
    while True:
        down, across = _near(best[1], size)
        values = np.where(ratio[down, across] >= STANDS_OUT, power[down, across], 0.0)
        i = np.unravel_index(int(np.argmax(values)), values.shape)
        if values[i] <= best[0]:
            return best
        best = float(values[i]), _mode((down[i], across[i]), size)


@cache
def _rings(window: int) -> list[IntArray]:
    """Return indices in half a spectrum of the searched wave numbers, grouped by magnitude."""
    down, across = np.fft.fftfreq(window)[:, None], np.fft.rfftfreq(window)
    size = np.hypot(down, across).ravel()
    # one of each two opposite wave numbers
    used = ((across > 0) | (down >= 0)).ravel() & (size >= FEWEST / window) & (size <= 1 / SHORTEST)
    ring = np.where(used, np.rint(size * window), -1).astype(int)
    return [np.flatnonzero(ring == radius) for radius in np.unique(ring[used])]


class _Along:
    """Averages of known pixels with different widths along and across crests.

    Spectra are truncated where a kernel is negligible, in whole columns.

    Parameters
    ----------
    known : ndarray (rows, columns)
    wave : (float, float)
        Cycles per pixel, down and across.
    """

    def __init__(self, known: Single, wave: tuple[float, float]) -> None:
        self._known = known
        self._whole = bool(known.all())
        self._length = 1 / hypot(*wave)
        self._way = (wave[0] * self._length, wave[1] * self._length)
        self._shape = tuple(
            next_fast_len(n + min(ceil(PADDED * self._spread(*WIDEST, k)), WINDOWS[0] // 2))
            for k, n in enumerate(known.shape)
        )
        self._spectrum: NDArray[np.complexfloating] = rfft(known, self._shape[1])
        self._kernels: dict[tuple[float, float], tuple[Single, Single]] = {}

    def _spread(self, across: float, along: float, axis: int) -> float:
        """Return the standard deviation (pixels) along an axis of a Gaussian in wavelengths."""
        way = self._way[axis], self._way[1 - axis]
        return self._length * hypot(across * way[0], along * way[1])

    def __call__(self, values: NDArray[Any], across: float, along: float) -> NDArray[Any]:
        """Average images (..., rows, columns) over Gaussians with widths in wavelengths (sd)."""
        if (across, along) not in self._kernels:
            kernel = self._kernel(across, along)
            count = kernel.shape[1] // 2 + 1
            share = self._convolved(self._spectrum[:, :count], kernel[:, :count])
            share = irfft(share, self._shape[1])[:, : self._known.shape[1]]
            self._kernels[across, along] = kernel, 1 / np.maximum(share, np.float32(1e-3))
        kernel, over = self._kernels[across, along]
        smooth = self._smooth(values if self._whole else values * self._known, kernel)
        smooth *= over
        return smooth

    def _kernel(self, across: float, along: float) -> Single:
        """Spectrum of a Gaussian: columns from 0 on, then the negative ones, up to its cut-off."""
        rows, columns = self._shape
        # the spectrum is widest where the Gaussian is narrowest
        widest = hypot(self._way[1] / across, self._way[0] / along) / (2 * np.pi * self._length)
        most = min(int(REACHES * widest * columns) + 1, (columns - 1) // 2)
        r = np.fft.fftfreq(rows).astype(np.float32)[:, None]
        cycles = np.concatenate([np.arange(most + 1), np.arange(-most, 0)])
        c = (cycles / columns).astype(np.float32)
        ahead = np.square(r * np.float32(self._way[0]) + c * np.float32(self._way[1]))
        beside = np.square(r * np.float32(self._way[1]) - c * np.float32(self._way[0]))
        size = 0.5 * (2 * np.pi * self._length) ** 2
        ahead *= np.float32(-size * across**2)
        beside *= np.float32(-size * along**2)
        return np.asarray(np.exp(ahead + beside))

    def _convolved(self, half: NDArray[Any], kernel: Single) -> NDArray[Any]:
        """Convolve columns of a spectrum along the other axis."""
        wide = fft(half, self._shape[0], axis=-2)
        wide *= kernel
        return np.asarray(ifft(wide, axis=-2, overwrite_x=True)[..., : self._known.shape[0], :])

    def _smooth(self, values: NDArray[Any], kernel: Single) -> NDArray[Any]:
        """Convolve; for a real image half of its spectrum suffices."""
        columns, width = values.shape[-1], self._shape[1]
        count = kernel.shape[1] // 2 + 1
        if not np.iscomplexobj(values):
            half = rfft(values, width)[..., :count]
            return np.asarray(irfft(self._convolved(half, kernel[:, :count]), width)[..., :columns])
        every = fft(values, width)
        kept = np.concatenate([every[..., :count], every[..., width - count + 1 :]], axis=-1)
        every = np.zeros((*values.shape[:-1], width), values.dtype)
        kept = self._convolved(kept, kernel)
        every[..., :count], every[..., width - count + 1 :] = kept[..., :count], kept[..., count:]
        return np.asarray(ifft(every, overwrite_x=True)[..., :columns])


def _profile(
    level: NDArray[np.floating],
    known: NDArray[np.floating],
    wave: tuple[float, float],
    columns: int = 1,
) -> tuple[BoolArray, NDArray[np.floating]]:
    """Mask of ripples, and their log intensity relative to that of flat floor.

    `columns` is the axis of the map's columns, as the image may be transposed.
    """
    if abs(wave[1]) > abs(wave[0]):  # averages are cheaper where crests run along the rows
        there, total = _profile(level.T, known.T, (wave[1], wave[0]), 1 - columns)
        return there.T, total.T
    length = 1 / hypot(*wave)
    level, known = np.ascontiguousarray(level, np.float32), np.ascontiguousarray(known, np.float32)
    average = _Along(known, wave)
    flat = (level - average(level, 1.0, 1.0)) * known
    down, across = (
        np.exp(2j * np.pi * k * np.arange(n)) for k, n in zip(wave, level.shape, strict=True)
    )
    carrier = np.outer(down, across).astype(np.complex64)
    first = average(flat * np.conj(carrier), *PHASE)
    strength = np.abs(first)
    wave_once = carrier * first / np.maximum(strength, np.float32(1e-30))
    total = _folded(flat, wave_once, min(HARMONICS, max(int(length / 2.5), 1)), average)
    total = np.maximum(total, np.float32(np.log(FLOOR)))
    # ripples begin and end within a wavelength: scale the profile by its local strength
    power, both, before = average(np.stack([total**2, flat * total, flat**2]), *NEAR)
    total *= np.clip(both / np.maximum(power, 1e-9), 0.0, STRONGEST)
    after = average((flat - total) ** 2, *NEAR)
    there = (after < EXPLAINED * before) & (2 * strength > LEAST)
    there = _rounded(there, OPENED * length, CLOSED * length) & (known > 0)
    total += _left_over(flat - total, known, average, columns)
    # amplitude is linear in slope to first order, and slope has zero mean: the mean amplitude over
    # a wavelength is that of flat floor (the mean intensity is up to 4 dB more)
    mean = average(np.exp(0.5 * total), 1.0, 1.0)
    total -= 2 * np.log(np.maximum(mean, FLOOR))
    return there, total * there


def _folded(
    flat: Single, wave: NDArray[np.complexfloating], count: int, average: _Along
) -> NDArray[np.floating]:
    """Mean profile from `count` harmonics of a wave given as complex phase factors."""
    total = np.zeros(flat.shape, np.float32)
    turn = np.ones_like(wave)
    for _ in range(count):
        turn *= wave
        mean = average(flat * np.conj(turn), *PROFILE)
        total += 2 * (mean.real * turn.real - mean.imag * turn.imag)
    return total


def _rounded(mask: BoolArray, opened: float, closed: float) -> BoolArray:
    """Open a mask by a disc, then close it by another, as if it continued beyond its edges."""
    kept = _grown(~_grown(~mask, opened), opened)
    pad = int(np.ceil(closed)) + 1
    wide = ~_grown(~_grown(np.pad(kept, pad, "edge"), closed), closed)
    return np.asarray(wide[pad:-pad, pad:-pad])


def _grown(mask: BoolArray, radius: float) -> BoolArray:
    return np.asarray(_discs(mask, radius)) if mask.any() else mask


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _discs(mask, radius):  # type: ignore[no-untyped-def]
    """Mark pixels within a radius of a mask."""
    rows, columns = mask.shape
    reach = int(radius)
    half = np.array([int(np.sqrt(radius * radius - d * d)) for d in range(reach + 1)])
    beside = np.empty((rows, columns), np.int64)
    for r in range(rows):
        last = -columns - reach - 1
        for c in range(columns):
            if mask[r, c]:
                last = c
            beside[r, c] = c - last
        last = 2 * columns + reach + 1
        for c in range(columns - 1, -1, -1):
            if mask[r, c]:
                last = c
            beside[r, c] = min(beside[r, c], last - c)
    grown = np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        for s in range(max(r - reach, 0), min(r + reach + 1, rows)):
            most = half[abs(r - s)]
            for c in range(columns):
                grown[r, c] |= beside[s, c] <= most
    return grown


def _left_over(
    rest: NDArray[np.floating], known: NDArray[np.floating], average: _Along, columns: int
) -> Single:
    """Find the part of a profile's residual that exceeds speckle.

    Where crests cross, fork or turn sharply, no single profile holds, and the residual at the scale
    of the ripples belongs to the bed as well. The speckle's share of it is left in the image.
    """
    smooth = gaussian_filter(rest, REST, mode="nearest")
    # speckle is estimated from differences of neighbours
    there = np.moveaxis(known, columns, 1) > 0
    steps = np.diff(np.moveaxis(rest, columns, 1), axis=1)[there[:, 1:] & there[:, :-1]]
    noise = 0.5 * np.square(np.median(np.abs(steps)) / 0.6745) if steps.size else 0.0
    noise = noise / (4 * np.pi * REST**2)
    power = np.maximum(average(smooth**2, *JUDGED), 1e-9)
    return np.asarray(smooth * (1 - np.sqrt(np.minimum(noise / power, 1))), np.float32)


def _fine(coarse: Single, inner: Part) -> Single:
    """Interpolate averaged pixels linearly to the pixels of a part of an image."""
    rows, columns = (_between(n, s) for n, s in zip(coarse.shape, inner, strict=True))
    return np.asarray(_bilinear(coarse, rows, columns))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bilinear(values, rows, columns):  # type: ignore[no-untyped-def]
    """Interpolate at rows and columns given as (before, after, weight of the latter)."""
    result = np.empty((rows[0].size, columns[0].size), values.dtype)
    for i in range(rows[0].size):
        first, second, share = values[rows[0][i]], values[rows[1][i]], rows[2][i]
        near = first + share * (second - first)
        for j in range(columns[0].size):
            left, right = near[columns[0][j]], near[columns[1][j]]
            result[i, j] = left + columns[2][j] * (right - left)
    return result


def _between(n: int, part: slice) -> tuple[IntArray, IntArray, Single]:
    """Averaged pixels before and after each pixel, and the weight of the latter."""
    place = np.clip((np.arange(part.start, part.stop) + 0.5) / COARSE - 0.5, 0, n - 1)
    before = place.astype(int)
    share = (place - before).astype(np.float32)
    return before, np.minimum(before + 1, n - 1), share
