"""Check whether ripples are regular in the stated kind of range of the tiles, or in the other.

In ground range, straight ripples have the same wavelength near the track and far from it; in slant
range they are shorter near the track, by the cosine of the grazing angle. Where the phase of the
ripples on the tiles bends over range by just that much, the stated kind of range is wrong.

In 150 simulated windows (12.5 m, starting at 5 to 12 m, altitude 5 m) no correct range was doubted;
of wrong ones 7 of 10 were found with straight crests, 2 of 10 with bent ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.ndimage

from sasmap.arrays import ComplexArray, FloatArray
from sasmap.survey.lattice import Window, transform_points
from sasmap.survey.passes import SonarPass
from sasmap.survey.tiles import Tile, read_tile
from sasmap.survey.water_column import LARGEST

# Side in pixels of the examined windows (a usual cell), maximum number of windows, pixels that are
# averaged first, and minimum valid share of a window.
SIDE, MOST_WINDOWS, MEAN, VALID = 500, 12, 2, 0.8
# Shortest wavelength in averaged pixels, longest as a share of a window, and minimum ratio of the
# spectrum's peak to its median.
SHORTEST, LONGEST, PEAK = 4.0, 0.25, 40.0
# Width of the smoothing of the phase, wavelengths, and points per side at which it is sampled.
SMOOTHING, PLACES = 0.7, 48
# Distance in altitudes within which slant and ground range differ enough; minimum bend of the phase
# between them, rad rms, and minimum component of the wave vector along the look.
NEAR, LEAST_BEND, ALONG = 6.0, 0.08, 0.7
# Bounds of the ratio of the bend found to that expected for the other range (1: other range, 0:
# stated range). The lead of brightness over the crests decreases with range, which on the simulated
# sample gives -0.5 and 1.5 instead of 0 and 1.
FOUND = (0.7, 2.0)
# Largest standard error of that ratio, and windows needed to estimate one; with fewer, the other
# range must leave at most this share of the phase's variance in each.
ERROR, ENOUGH, STRAIGHT = 0.15, 5, 0.35


class RangeBend(NamedTuple):
    """Bend of the phase of the ripples in a window.

    Attributes
    ----------
    found : float
        Bend relative to that expected for the other range.
    expected : float
        Variance of the expected bend, rad^2.
    straighter : float
        Ratio of the phase's variance along the other range to that along the stated one.
    """

    found: float
    expected: float
    straighter: float


def check_ripples(sonar_pass: SonarPass, crs: str) -> list[str]:
    """Compare ripples with the wavelength trend that each kind of range implies.

    Parameters
    ----------
    sonar_pass : SonarPass
    crs : str
        The survey's.

    Returns
    -------
    list of str
        A warning, or none: without ripples near the track nothing is known.
    """
    bends = [b for b in (_bend(sonar_pass, *w, crs) for w in _windows(sonar_pass, crs)) if b]
    if not bends:
        return []
    found, weight, straighter = np.array(bends).T
    mean = float(np.average(found, weights=weight))
    if len(bends) >= ENOUGH:
        error = float(np.sqrt((weight**2 * (found - mean) ** 2).sum()) / weight.sum())
        sure = error < ERROR
    else:
        sure = bool((straighter < STRAIGHT).all())
    if not sure or not FOUND[0] < mean < FOUND[1]:
        return []
    told, other = ("slant", "ground") if sonar_pass.slant else ("ground", "slant")
    return [
        f"{sonar_pass.tiles[0].path}: range: {told} is stated, but ripples change wavelength over "
        f"range just as in {other} range: expected range: {other}, or a correct altitude: "
        "frequency and A_H are wrong"
    ]


def _windows(sonar_pass: SonarPass, crs: str) -> list[tuple[Tile, Window]]:
    """Windows of the tiles near the track, spread evenly."""
    found = []
    for tile in sonar_pass.tiles:
        for row in range(0, max(tile.window.height - SIDE // 2, 1), SIDE):
            for column in range(0, max(tile.window.width - SIDE // 2, 1), SIDE):
                window = Window(row, column, SIDE, SIDE).intersect(tile.window)
                middle = Window(row + window.height // 2, column + window.width // 2, 1, 1)
                ratio = _ratio(sonar_pass, tile, crs, middle)
                if 1 < ratio[0, 0] < NEAR:
                    found.append((tile, window))
    return found[:: len(found) // MOST_WINDOWS + 1]


def _ratio(sonar_pass: SonarPass, tile: Tile, crs: str, window: Window) -> FloatArray:
    """Ratio of distance from the track to altitude, at a window's pixels; NaN where not seen."""
    distance, altitude = _geometry(sonar_pass, tile, crs, *tile.lattice.centres(window))
    return np.asarray(distance / altitude)


def _geometry(
    sonar_pass: SonarPass, tile: Tile, crs: str, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    seen = sonar_pass.locate(*transform_points(tile.lattice.crs, crs, x, y))
    return seen.distance, seen.altitude


def _bend(sonar_pass: SonarPass, tile: Tile, window: Window, crs: str) -> RangeBend | None:
    """Bend of the phase of a window's ripples over range; None without ripples along the look."""
    waves = _waves(tile, window)
    if waves is None:
        return None
    field, rows, columns, vector = waves
    t = tile.lattice.transform
    row, column = window.row + rows[:, None], window.column + columns
    x, y = t.c + t.a * column + t.b * row, t.f + t.d * column + t.e * row
    distance, altitude = _geometry(sonar_pass, tile, crs, x, y)
    slant = np.sqrt(np.where(distance > altitude, distance**2 - altitude**2, np.nan))
    if not np.isfinite(slant).all():
        return None
    ranges = (slant, distance) if sonar_pass.slant else (distance, slant)
    steps = rows[1] - rows[0], columns[1] - columns[0]
    slope = np.array([np.gradient(distance, s, axis=k).mean() for k, s in enumerate(steps)])
    if not slope.any():
        return None
    along = float(vector @ slope / (slope @ slope))  # cycles per metre of distance
    if abs(along) < ALONG * np.hypot(*vector) / np.hypot(*slope):
        return None
    phases = [2 * np.pi * along * _bent(one, distance, (rows, columns)) for one in ranges]
    expected = float(np.var(phases[1] - phases[0]))
    if expected < LEAST_BEND**2:
        return None
    left = [-2 * np.log(_coherence(field * np.exp(-1j * phase))) for phase in phases]
    return RangeBend(
        0.5 + (left[0] - left[1]) / (2 * expected), expected, left[1] / max(left[0], 1e-9)
    )


def _bent(
    ranges: FloatArray, distance: FloatArray, places: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Range scaled to the mean rate of the distance, its plane over rows and columns removed, m."""
    rate = np.polyfit(distance.ravel(), ranges.ravel(), 1)[0]
    row, column = np.meshgrid(*places, indexing="ij")
    plane = np.column_stack([row.ravel(), column.ravel(), np.ones(row.size)])
    scaled = (ranges / rate).ravel()
    return np.asarray(scaled - plane @ np.linalg.lstsq(plane, scaled, rcond=None)[0]).reshape(
        ranges.shape
    )


def _coherence(field: ComplexArray) -> float:
    """Share of a field that the best plane wave explains."""
    shape = tuple(4 * n for n in field.shape)
    return float(np.abs(scipy.fft.fft2(field, shape)).max() / np.abs(field).sum())


def _waves(
    tile: Tile, window: Window
) -> tuple[ComplexArray, FloatArray, FloatArray, FloatArray] | None:
    """Demodulate the ripples of a window; None without any.

    Returns
    -------
    field : ndarray of complex (rows, columns)
        Amplitude and phase at sample points, relative to a plane wave.
    rows, columns : ndarray
        Positions of the points, pixels from the window's corner.
    vector : ndarray (2,)
        Wave vector of the plane wave, cycles per row and column.
    """
    try:
        values = np.minimum(np.asarray(read_tile(tile, window), float), LARGEST)
    except OSError:
        return None
    height, width = (n // MEAN for n in values.shape)
    cut = values[: height * MEAN, : width * MEAN].reshape(height, MEAN, width, MEAN)
    valid = np.isfinite(cut)
    if valid.mean() < VALID or min(height, width) < 2 * PLACES:
        return None
    image = np.where(valid, cut, 0.0).sum(axis=(1, 3)) / np.maximum(valid.sum(axis=(1, 3)), 1)
    smooth = scipy.ndimage.gaussian_filter(image, LONGEST * min(height, width))
    image = np.where(valid.any(axis=(1, 3)), image / np.maximum(smooth, 1e-12) - 1.0, 0.0)
    taper = np.hanning(height)[:, None] * np.hanning(width)
    power = np.abs(scipy.fft.fft2(image * taper)) ** 2
    power = scipy.ndimage.uniform_filter(power, 3, mode="wrap")
    down, right = np.meshgrid(scipy.fft.fftfreq(height), scipy.fft.fftfreq(width), indexing="ij")
    number = np.hypot(down, right)
    inside = (number < 1 / SHORTEST) & (number > 1 / (LONGEST * min(height, width)))
    power = np.where(inside, power, 0.0)
    at = np.unravel_index(int(power.argmax()), power.shape)
    if power[at] < PEAK * np.median(power[inside]):
        return None
    vector = np.array([down[at], right[at]])
    turn = np.exp(
        -2j * np.pi * (vector[0] * np.arange(height)[:, None] + vector[1] * np.arange(width))
    )
    field = scipy.ndimage.gaussian_filter(
        image * turn, SMOOTHING / np.hypot(*vector), mode="nearest"
    )
    rows, columns = (np.linspace(0, n - 1, PLACES).astype(int) for n in (height, width))
    places = [MEAN * (v + 0.5) for v in (rows, columns)]
    return field[np.ix_(rows, columns)], places[0], places[1], vector / MEAN
