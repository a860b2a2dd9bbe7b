"""Amplitude of the floor as it is when averaged over its ripples.

Ripples are taken off without a model of them: where the local spectrum holds a wave, the image of
log intensity is demodulated by it, pixels are folded by the phase so found, and the mean profile,
a few harmonics of it, is subtracted. Shadow of the ripples is a part of the profile and so of the
bed; a profile has no level, so sediments keep theirs. Nothing is asked of the cells that ripples
are estimated in.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, ifft2, next_fast_len
from scipy.ndimage import map_coordinates, uniform_filter

FloatArray = NDArray[np.float64]
Single = NDArray[np.float32]

# Pixels a side that are averaged first; averaged pixels a side of windows, which overlap by half:
# small ones find short ripples in small patches, large ones long and weak ones.
COARSE, WINDOWS = 4, (64, 128)
LATTICE, MARGIN = COARSE * WINDOWS[-1] // 2, COARSE * WINDOWS[-1]
# Waves that are looked for, averaged pixels: shorter ones are averaged over by the blocks of
# pixels that sediments are found by (16 pixels); and how many a window must hold.
SHORTEST, FEWEST = 5.0, 4
# Power of a wave over the median of its ring. Speckle's powers are exponential: its highest of 4000
# is 12 medians, and one window in a million reaches 30; recorded and simulated ripples have 200 up.
# An edge has no more at a wave number than at half of it, in the same direction.
STANDS_OUT, RISES = 40.0, 2.0
# Share of a window that must be known.
KNOWN = 0.25
# Widths (standard deviation, in wavelengths across and along the crests) over which the phase, the
# profile and what it explains are averaged.
PHASE, PROFILE, NEAR = (0.6, 0.6), (0.5, 1.5), (0.15, 1.0)
HARMONICS = 6
# Share of the scatter of log intensity that a profile leaves, at most, the least amplitude of its
# fundamental, and by how much it may be stronger than its mean.
EXPLAINED, LEAST, STRONGEST = 0.7, 0.15, 2.0
# Of intensity over the local mean: the least that is kept (20 dB down there is noise alone).
FLOOR = 0.01


class Waves(NamedTuple):
    """Ripples as an image shows them.

    Attributes
    ----------
    profile : ndarray of float32 (rows, columns)
        Log of the amplitude that ripples make over that of the same floor flat; 0 where none are.
    rippled : ndarray of bool (rows, columns)
    """

    profile: Single
    rippled: NDArray[np.bool_]


def find_waves(amplitude: NDArray[np.floating]) -> Waves:
    """Find ripples in an image and what they do to its amplitude.

    Parameters
    ----------
    amplitude : ndarray (rows, columns)
        NaN where there is none. Pieces of a survey agree where they begin at multiples of
        ``LATTICE`` pixels and reach ``MARGIN`` pixels beyond what is asked.

    Returns
    -------
    Waves
    """
    level, known = _coarse(amplitude)
    profile = np.zeros(level.shape)
    weight = np.zeros(level.shape)
    rippled = np.zeros(level.shape)
    for size, part in ((n, p) for n in WINDOWS for p in _windows(level.shape, n)):
        wave = _wave(level[part], known[part], size)
        if wave is None:
            continue  # what holds few ripples tells nothing of those that others find in it
        taper = np.hanning(size + 2)[1:-1]
        height, width = (s.stop - s.start for s in part)
        hat = np.outer(taper[:height], taper[:width])
        weight[part] += hat
        there, found = _profile(level[part], known[part], wave)
        profile[part] += hat * found
        rippled[part] += hat * there
    weight = np.maximum(weight, 1e-9)
    mask = (rippled / weight > 0.5) & (known > 0)
    fine = _fine(profile / weight, amplitude.shape)
    whole = np.repeat(np.repeat(mask, COARSE, axis=0), COARSE, axis=1)
    padded = np.zeros(amplitude.shape, bool)
    padded[: whole.shape[0], : whole.shape[1]] = whole
    return Waves((0.5 * fine).astype(np.float32), padded)


def _coarse(amplitude: NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
    """Log of the mean intensity of small squares, and the share of them that is known."""
    rows, columns = (n // COARSE * COARSE for n in amplitude.shape)
    shape = rows // COARSE, COARSE, columns // COARSE, COARSE
    parts = amplitude[:rows, :columns].astype(float).reshape(shape)
    there = np.isfinite(parts)
    count = there.sum(axis=(1, 3))
    power = np.where(there, parts, 0.0) ** 2
    mean = power.sum(axis=(1, 3)) / np.maximum(count, 1)
    known = (count > 0) & (mean > 0)
    return np.log(np.where(known, mean, 1.0)), known.astype(float)


def _windows(shape: tuple[int, ...], size: int) -> list[tuple[slice, slice]]:
    """Windows on the lattice; where an image is smaller than one, the image."""
    firsts = [sorted({*range(0, max(n - size, 0) + 1, size // 2), max(n - size, 0)}) for n in shape]
    return [
        (slice(r, min(r + size, shape[0])), slice(c, min(c + size, shape[1])))
        for r in firsts[0]
        for c in firsts[1]
    ]


def _wave(level: FloatArray, known: FloatArray, size: int) -> tuple[float, float] | None:
    """Wave number (cycles per averaged pixel, down and across) of the ripples in a window."""
    if known.mean() < KNOWN or min(level.shape) < 3 * SHORTEST:
        return None
    hat = np.outer(*(np.hanning(n + 2)[1:-1] for n in level.shape)) * known
    flat = (level - (level * hat).sum() / hat.sum()) * hat
    power = uniform_filter(np.abs(fft2(flat, (size, size))) ** 2, 3, mode="wrap")
    over = np.zeros(power.size)
    for ring in _rings(size):
        values = power.ravel()[ring]
        over[ring] = values / max(float(np.median(values)), 1e-300)
    row, column = np.unravel_index(int(np.argmax(over)), power.shape)
    k = np.fft.fftfreq(size)[[row, column]]
    half = [np.arange(h - 1, h + 2) % size for h in np.rint(k * size / 2).astype(int)]
    if over.max() < STANDS_OUT or power[row, column] < RISES * power[np.ix_(*half)].max():
        return None
    return float(k[0]), float(k[1])


@cache
def _rings(window: int) -> list[NDArray[np.int64]]:
    """Places in the spectrum of the wave numbers that are looked at, by their size."""
    k = np.fft.fftfreq(window)
    size = np.hypot(k[:, None], k).ravel()
    used = (size >= FEWEST / window) & (size <= 1 / SHORTEST)
    ring = np.where(used, np.rint(size * window), -1).astype(int)
    return [np.flatnonzero(ring == radius) for radius in np.unique(ring[used])]


class _Along:
    """Averages that reach farther along crests than across them, of what is known.

    Parameters
    ----------
    known : ndarray (rows, columns)
    wave : (float, float)
        Cycles a pixel, down and across.
    """

    def __init__(self, known: FloatArray, wave: tuple[float, float]) -> None:
        self._known, self._shape = (
            known,
            tuple(next_fast_len(n + WINDOWS[-1] // 2) for n in known.shape),
        )
        r, c = (np.fft.fftfreq(n) for n in self._shape)
        self._length = 1 / np.hypot(*wave)
        self._ahead = (r[:, None] * wave[0] + c * wave[1]) * self._length
        self._beside = (r[:, None] * wave[1] - c * wave[0]) * self._length

    def __call__(self, values: NDArray[Any], across: float, along: float) -> NDArray[np.complex128]:
        """Average over Gaussians of so many wavelengths (standard deviation)."""
        size = (2 * np.pi * self._length) ** 2
        kernel = np.exp(-0.5 * size * ((across * self._ahead) ** 2 + (along * self._beside) ** 2))
        rows, columns = self._known.shape

        def smooth(v: NDArray[Any]) -> NDArray[np.complex128]:
            return np.asarray(ifft2(fft2(v, self._shape) * kernel)[:rows, :columns])

        share = np.maximum(smooth(self._known).real, 1e-3)
        return np.asarray(smooth(values * self._known) / share)


def _profile(
    level: FloatArray, known: FloatArray, wave: tuple[float, float]
) -> tuple[NDArray[np.bool_], FloatArray]:
    """Where ripples are, and their log intensity over that of flat floor."""
    length = 1 / np.hypot(*wave)
    average = _Along(known, wave)
    flat = (level - average(level, 1.0, 1.0).real) * known
    r, c = np.indices(level.shape)
    carrier = 2 * np.pi * (wave[0] * r + wave[1] * c)
    first = average(flat * np.exp(-1j * carrier), *PHASE)
    phase = carrier + np.angle(first)
    total = np.zeros(level.shape)
    for k in range(1, min(HARMONICS, max(int(length / 2.5), 1)) + 1):
        turn = np.exp(1j * k * phase)
        total += 2 * (average(flat * np.conj(turn), *PROFILE) * turn).real
    total = np.maximum(total, np.log(FLOOR))
    # ripples begin and end within a wavelength: how strong the profile is around each place
    power = np.maximum(average(total**2, *NEAR).real, 1e-9)
    total *= np.clip(average(flat * total, *NEAR).real / power, 0.0, STRONGEST)
    before, after = (average(v**2, *NEAR).real for v in (flat, flat - total))
    there = (after < EXPLAINED * before) & (2 * np.abs(first) > LEAST) & (known > 0)
    # amplitude is linear in slope to first order, and slope has no mean: the mean amplitude over a
    # wavelength is that of flat floor (the mean intensity is up to 4 dB more)
    mean = average(np.exp(0.5 * total), 1.0, 1.0).real
    total -= 2 * np.log(np.maximum(mean, FLOOR))
    return there, total * there


def _fine(coarse: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Lay averaged pixels on the pixels that they are of, linear between."""
    if not coarse.any():
        return np.zeros(shape)
    r, c = ((np.arange(n) + 0.5) / COARSE - 0.5 for n in shape)
    places = np.meshgrid(r, c, indexing="ij")
    return np.asarray(map_coordinates(coarse, places, order=1, mode="nearest"))
