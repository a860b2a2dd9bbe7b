"""Sea floors with and without ripples for the study of their detection (presence.py).

Each function makes the amplitude (size, size) of one kind of floor, range along the columns.
"""

from __future__ import annotations

import io

import numpy as np
from PIL import Image as Picture
from scipy.ndimage import gaussian_filter, gaussian_filter1d


def speckle(
    rng: np.random.Generator, size: int, nu: float = np.inf, correlation: float = 0.0
) -> np.ndarray:
    """Amplitude of speckle of mean intensity 1: Rayleigh or K, of correlated pixels or not."""
    field = rng.normal(size=(2, size, size))
    if correlation > 0:
        field = gaussian_filter(field, (0, correlation, correlation), mode="wrap")
        field /= field.std()
    power = 0.5 * (field**2).sum(axis=0)
    if np.isfinite(nu):
        power *= rng.gamma(nu, 1 / nu, (size, size))
    return np.sqrt(power)


def smooth_noise(rng: np.random.Generator, size: int, length: float) -> np.ndarray:
    """Gaussian random field of standard deviation 1 and a correlation length in pixels."""
    field = gaussian_filter(rng.normal(size=(size, size)), length, mode="wrap")
    return field / field.std()


def rayleigh(rng: np.random.Generator, size: int) -> np.ndarray:
    """Independent Rayleigh speckle."""
    return speckle(rng, size)


def k_law(rng: np.random.Generator, size: int) -> np.ndarray:
    """Spiky K speckle (nu 1)."""
    return speckle(rng, size, 1.0)


def correlated(rng: np.random.Generator, size: int) -> np.ndarray:
    """Speckle correlated over up to 2 pixels."""
    return speckle(rng, size, correlation=rng.uniform(0.5, 2))


def correlated_k(rng: np.random.Generator, size: int) -> np.ndarray:
    """Correlated K speckle."""
    return speckle(rng, size, rng.uniform(1, 5), rng.uniform(0.5, 1.5))


def texture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Sea floor whose level varies by a smooth random field."""
    level = np.exp(0.3 * smooth_noise(rng, size, rng.uniform(2, 30)))
    return level * speckle(rng, size)


def quantised(rng: np.random.Generator, size: int) -> np.ndarray:
    """Few grey values, the brightest saturated."""
    return np.clip(np.floor(speckle(rng, size) * 6), 0, 12)


def trend(rng: np.random.Generator, size: int) -> np.ndarray:
    """Beam pattern along range, steep at one side."""
    x = np.linspace(0, 1, size)
    shape = np.exp(rng.uniform(-3, 3) * x) + 3 * np.exp(-0.5 * ((x - rng.random()) / 0.15) ** 2)
    return shape * speckle(rng, size)


def edge(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a straight boundary of two sediments."""
    turn, row, column = rng.uniform(0, np.pi), *np.indices((size, size)) - size / 2
    side = row * np.sin(turn) + column * np.cos(turn) > rng.uniform(-0.3, 0.3) * size
    return np.where(side, rng.uniform(1.5, 4), 1.0) * speckle(rng, size)


def wavy_edge(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a boundary that wanders."""
    line = gaussian_filter1d(rng.normal(size=size), rng.uniform(8, 40), mode="wrap")
    line = size / 2 + rng.uniform(0.02, 0.1) * size * line / line.std()
    side = np.arange(size) > line[:, None]
    return np.where(side, rng.uniform(1.5, 4), 1.0) * speckle(rng, size)


def wedge(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a band of another sediment."""
    turn, row, column = rng.uniform(0, np.pi), *np.indices((size, size)) - size / 2
    place = row * np.sin(turn) + column * np.cos(turn) - rng.uniform(-0.3, 0.3) * size
    inside = np.abs(place) < rng.uniform(0.03, 0.2) * size
    return np.where(inside, rng.uniform(1.5, 4), 1.0) * speckle(rng, size)


def objects(rng: np.random.Generator, size: int) -> np.ndarray:
    """One to four bright objects with a shadow behind each."""
    floor = np.ones((size, size))
    for _ in range(rng.integers(1, 5)):
        row, column = rng.integers(0, max(size - 60, 1), 2)
        tall, wide, far = rng.integers(4, 30), rng.integers(2, 8), rng.integers(5, 50)
        floor[row : row + tall, column : column + wide] = rng.uniform(3, 10)
        floor[row : row + tall, column + wide : column + wide + far] = 0.05
    return floor * speckle(rng, size)


def holes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Missing lines and a missing corner."""
    result = speckle(rng, size)
    result[rng.random(size) < 0.1] = np.nan
    result[: size // 3, : size // 4] = np.nan
    return result


def textures(rng: np.random.Generator, size: int) -> np.ndarray:
    """K-like textures that are correlated at three scales at once."""
    log = np.zeros((size, size))
    for length in (1.5, 5.0, 15.0):
        field = smooth_noise(rng, size, length * rng.uniform(0.7, 1.5))
        log += field / np.sqrt(rng.uniform(2, 12))
    return np.exp(0.5 * log) * speckle(rng, size, correlation=rng.uniform(0, 1.2))


def gain_steps(rng: np.random.Generator, size: int) -> np.ndarray:
    """Gain that steps between pings, and line noise that is correlated over a few of them."""
    steps = np.cumsum((rng.random(size) < 0.03) * rng.normal(0, 0.15, size))
    lines = gaussian_filter1d(rng.normal(size=size), rng.uniform(0.3, 4), mode="wrap")
    lines *= rng.uniform(0.02, 0.1) / lines.std()
    trend = np.exp(rng.uniform(-1, 1) * np.linspace(0, 1, size))
    law = rng.choice([np.inf, 5.0])
    gain = np.exp(steps - steps.mean() + lines)[:, None]
    return gain * trend * speckle(rng, size, law, rng.uniform(0, 1))


def slow_bands(rng: np.random.Generator, size: int) -> np.ndarray:
    """Slow bands over range, and faint line noise between pings."""
    bands = gaussian_filter1d(rng.normal(size=2 * size), rng.uniform(size / 12, size / 5))
    bands = bands[size // 2 : size // 2 + size]
    bands = (bands - bands.mean()) / bands.std() * rng.uniform(0.05, 0.25)
    lines = gaussian_filter1d(rng.normal(size=size), rng.uniform(0.3, 3), mode="wrap")
    lines *= rng.uniform(0.02, 0.08) / lines.std()
    return np.exp(bands + lines[:, None]) * speckle(rng, size, correlation=rng.uniform(0, 1.2))


def boulders(rng: np.random.Generator, size: int) -> np.ndarray:
    """Boulders of similar size, each with a shadow behind it."""
    floor = np.ones((size, size))
    usual = rng.uniform(3, 9)
    down, right = np.ogrid[:size, :size]
    for _ in range(int(rng.uniform(5, 60) * (size / 300) ** 2)):
        row, column = rng.integers(0, size, 2)
        tall = usual * rng.uniform(0.5, 1.6)
        shadow = tall * rng.uniform(1, 5)
        stone = ((down - row) / tall) ** 2 + ((right - column) / (0.6 * tall)) ** 2 < 1
        floor[stone] *= rng.uniform(2, 6)
        behind = right - column
        narrow = np.abs(down - row) < tall * (1 - 0.5 * behind / (shadow + tall))
        floor[narrow & (behind > 0.5 * tall) & (behind < shadow + 0.5 * tall)] = 0.08
    return floor * speckle(rng, size, correlation=rng.uniform(0, 1))


def trawl_marks(rng: np.random.Generator, size: int) -> np.ndarray:
    """One or two trawls, each of two furrows with a bright and a dark side."""
    floor = np.ones((size, size))
    turn = rng.uniform(0, np.pi)
    down, right = np.indices((size, size)) - size / 2
    for _ in range(rng.integers(1, 3)):
        way = turn + rng.normal(0, 0.15)
        bend = rng.uniform(0, 0.1) * size * np.sin(down / size * rng.uniform(0, 3))
        place = down * np.sin(way) + right * np.cos(way) + bend
        first, apart = rng.uniform(-0.4, 0.4) * size, rng.uniform(0.1, 0.4) * size
        for middle in (first, first + apart):
            wide = rng.uniform(1.5, 6)
            bright = rng.uniform(0.5, 3)
            floor *= 1 + bright * np.exp(-0.5 * ((place - middle) / wide) ** 2)
            floor *= 1 - 0.7 * np.exp(-0.5 * ((place - middle) / wide - 2.2) ** 2)
    return np.sqrt(floor) * speckle(rng, size, correlation=rng.uniform(0, 1))


def wreck(rng: np.random.Generator, size: int) -> np.ndarray:
    """Simulate a hull with ribs, planking and a bright edge, and its shadow."""
    floor = np.ones((size, size))
    turn = rng.uniform(0, np.pi)
    down, right = np.indices((size, size)).astype(float)
    row, column = rng.uniform(0.25, 0.75, 2) * size
    along = (down - row) * np.sin(turn) + (right - column) * np.cos(turn)
    across = (down - row) * np.cos(turn) - (right - column) * np.sin(turn)
    length = rng.uniform(0.2, 0.45) * size
    side = length * rng.uniform(0.18, 0.35) * (1 - (along / length) ** 2)
    hull = (np.abs(across) < side) & (np.abs(along) < length)
    rib = np.cos(2 * np.pi * along / rng.uniform(6, 22) + rng.uniform(0, 6)) > rng.uniform(0.2, 0.7)
    plank = 1 + rng.uniform(0, 0.4) * np.cos(2 * np.pi * across / rng.uniform(4, 10))
    inside = np.where(rib, rng.uniform(2, 6), rng.uniform(0.3, 1)) * plank
    floor[np.roll(hull, int(rng.uniform(0.05, 0.3) * size), axis=1) & ~hull] = 0.1
    floor[hull] = inside[hull]
    floor[hull & (side - np.abs(across) < 3)] = rng.uniform(3, 8)
    return floor * speckle(rng, size, correlation=rng.uniform(0, 1))


def _wave(
    rng: np.random.Generator, size: int, waves: float, turn: float, forks: float = 0.0
) -> np.ndarray:
    """Sine of a wave of so many lengths a side, with so many forks a square wavelength."""
    down, right = np.indices((size, size)) - size / 2
    phase = 2 * np.pi * waves / size * (right * np.cos(turn) + down * np.sin(turn))
    for _ in range(rng.poisson(forks * (1.2 * waves) ** 2)):
        row, column = rng.uniform(-0.6, 0.6, 2) * size
        phase = phase + rng.choice([-1, 1]) * np.arctan2(down - row, right - column)
    return np.sin(phase + rng.uniform(0, 2 * np.pi))


def weak(rng: np.random.Generator, size: int) -> np.ndarray:
    """Straight ripples of contrast 0.1, 8 wavelengths along a side, not looked at along crests."""
    return np.sqrt(1 + 0.1 * _wave(rng, size, 8, rng.uniform(-1.4, 1.4))) * speckle(rng, size)


def four(rng: np.random.Generator, size: int) -> np.ndarray:
    """Straight ripples of contrast 0.2, 4 wavelengths along a side."""
    return np.sqrt(1 + 0.2 * _wave(rng, size, 4, rng.uniform(-1.3, 1.3))) * speckle(rng, size)


def forked(rng: np.random.Generator, size: int) -> np.ndarray:
    """Ripples of contrast 0.7, 10 wavelengths, a crest that forks in every third square of one."""
    wave = _wave(rng, size, 10, rng.uniform(-1.2, 1.2), 1 / 3)
    return np.sqrt(1 + 0.7 * wave) * speckle(rng, size)


def crowded(rng: np.random.Generator, size: int) -> np.ndarray:
    """Ripples of contrast 0.7, 10 wavelengths, a fork in every square of one."""
    wave = _wave(rng, size, 10, rng.uniform(-1.2, 1.2), 1)
    return np.sqrt(1 + 0.7 * wave) * speckle(rng, size)


def four_forked(rng: np.random.Generator, size: int) -> np.ndarray:
    """Ripples of contrast 0.7, 4.5 wavelengths, a fork in every seventh square of one."""
    wave = _wave(rng, size, 4.5, rng.uniform(-0.8, 0.8), 0.15)
    return np.sqrt(1 + 0.7 * wave) * speckle(rng, size)


def crossing(rng: np.random.Generator, size: int) -> np.ndarray:
    """Two sets of ripples that cross, of contrast 0.3 each."""
    turn = rng.uniform(-0.6, 0.6)
    first = _wave(rng, size, rng.uniform(6, 10), turn)
    second = _wave(rng, size, rng.uniform(6, 14), turn + rng.uniform(0.7, 1.2))
    return np.sqrt(1 + 0.3 * first + 0.3 * second) * speckle(rng, size)


def display(rng: np.random.Generator, amplitude: np.ndarray) -> np.ndarray:
    """Scale to 8 bits as a viewer does: the brightest cut off, dark tones raised."""
    values = np.nan_to_num(amplitude)
    top = np.quantile(values[values > 0], rng.uniform(0.97, 0.999))
    scaled = np.rint(1 + 254 * np.clip(values / top, 0, 1) ** rng.uniform(0.4, 1))
    return np.where(np.isfinite(amplitude), scaled, np.nan)


def jpeg(rng: np.random.Generator, amplitude: np.ndarray) -> np.ndarray:
    """Compress a display-scaled image as JPEG does."""
    scaled = np.nan_to_num(display(rng, amplitude)).astype(np.uint8)
    packed = io.BytesIO()
    Picture.fromarray(scaled).save(packed, "JPEG", quality=int(rng.integers(40, 90)))
    values = np.array(Picture.open(packed)).astype(float)
    return np.where(np.isfinite(amplitude), np.maximum(values, 1), np.nan)


def as_is(rng: np.random.Generator, amplitude: np.ndarray) -> np.ndarray:
    """Leave an image as it was received."""
    return amplitude


FLAT = (
    rayleigh,
    k_law,
    correlated,
    correlated_k,
    texture,
    textures,
    quantised,
    trend,
    edge,
    wavy_edge,
    wedge,
    objects,
    holes,
    gain_steps,
    slow_bands,
    boulders,
    trawl_marks,
    wreck,
)
# And the share of clips that must be found.
RIPPLED = {weak: 0.99, four: 0.95, forked: 0.9, crowded: 0.9, four_forked: 0.9, crossing: 0.9}
VERSIONS = (as_is, display, jpeg)
