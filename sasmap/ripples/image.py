"""A clip on a regular lattice: intensity, and positions of pixels from the clip's centre."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.ripples.clip import Clip, mean_look, normalised

# Largest deviation of pixels from a straight lattice, in pixels, above which they are averaged onto
# a regular one.
MAX_BEND = 0.3
# Share of pixels at the largest value above which the receiver or the file counts as saturated.
MIN_SATURATED = 1e-4
# Most pixels to which a lattice is fitted.
LATTICE_SAMPLES = 4000


@dataclass(frozen=True)
class Image:
    """A clip's intensity on a regular lattice.

    Attributes
    ----------
    power : ndarray (rows, columns)
        Intensity over the clip's mean; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    saturated : ndarray of bool (rows, columns)
        Pixels at the largest value the file can hold: their intensity is at least `power`.
    ground_range, altitude : ndarray (rows, columns)
        m; NaN where unknown.
    steps : ndarray (2, 2)
        Map displacement (east, north), m, of one column (first column of the matrix) and of one
        row (second).
    azimuth : float
        Mean look, degrees clockwise from grid north.
    rms : float
        Root of the mean intensity that `power` was divided by, in units of the amplitude.
    centre : ndarray (2,)
        Map position (east, north) of the lattice's centre, m.
    """

    power: FloatArray
    valid: BoolArray
    saturated: BoolArray
    ground_range: FloatArray
    altitude: FloatArray
    steps: FloatArray
    azimuth: float
    rms: float
    centre: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.power.shape[0], self.power.shape[1]

    @property
    def look(self) -> FloatArray:
        """Unit vector (east, north) of the mean look."""
        turn = np.radians(self.azimuth)
        return np.array([np.sin(turn), np.cos(turn)])

    @property
    def beside(self) -> FloatArray:
        """Unit vector (east, north) across the mean look, to its right."""
        east, north = self.look
        return np.array([north, -east])

    @property
    def pixel_size(self) -> float:
        """Square root of a pixel's area, m."""
        return float(np.sqrt(abs(np.linalg.det(self.steps))))

    def project(self, direction: FloatArray, size: int = 1) -> FloatArray:
        """Distance along a unit vector (east, north) from the clip's centre, m.

        That of pixels, or of the centres of boxes of `size` by `size` pixels.
        """
        row, column = (
            (np.arange(-(-n // size)) + 0.5) * size - 0.5 - (n - 1) / 2 for n in self.shape
        )
        per_column, per_row = self.per_pixel(direction)
        return np.asarray(per_column * column + per_row * row[:, None])

    def places(self, size: int = 1) -> tuple[FloatArray, FloatArray]:
        """Distances along and across the look, as :meth:`project` gives them, m."""
        return self.project(self.look, size), self.project(self.beside, size)

    @cached_property
    def mean_range(self) -> float:
        """Ground range at the clip's centre, from that of the valid pixels, m."""
        offset = self.project(self.look)[self.valid].mean()
        return float(self.ground_range[self.valid].mean() - offset)

    def per_pixel(self, wave: FloatArray) -> FloatArray:
        """Convert a wave vector (east, north) in cycles/m to cycles per column and row."""
        return np.asarray(wave @ self.steps)

    def per_metre(self, wave: FloatArray) -> FloatArray:
        """Convert cycles per column and row to a wave vector (east, north) in cycles/m."""
        return np.asarray(np.linalg.solve(self.steps.T, wave))


def as_image(clip: Clip) -> Image:
    """Put a clip on a regular lattice: its own if that is straight, else a north-up one.

    Parameters
    ----------
    clip : Clip
        With at least one valid pixel.

    Returns
    -------
    Image
        Slant-range tiles have uneven steps on the sea floor: their pixels are averaged onto a
        lattice of the clip's pixel size.
    """
    valid = clip.valid
    power, mean = normalised(clip, valid)
    wide = np.zeros(valid.shape)
    wide[valid] = power
    saturated = _saturated(clip.amplitude, valid)
    azimuth = mean_look(clip)
    steps, first = lattice(clip)
    bend = _bend(clip, valid, steps, first) / clip.pixel_size
    if bend <= MAX_BEND and abs(np.linalg.det(steps)) > 0:
        places = clip.ground_range, clip.altitude, steps
        centre = first + steps @ (np.array(wide.shape[::-1]) - 1) / 2
        return Image(wide, valid, saturated, *places, azimuth, mean, centre)
    return _summed(clip, wide, valid, saturated, azimuth, mean)


def _saturated(amplitude: FloatArray, valid: BoolArray) -> BoolArray:
    top = valid & (amplitude >= amplitude[valid].max())
    many = top.sum() > max(MIN_SATURATED * valid.sum(), 3)
    return top if many else np.zeros_like(valid)


def lattice(clip: Clip) -> tuple[FloatArray, FloatArray]:
    """Fit a straight lattice to the positions of a clip's pixels.

    Returns
    -------
    steps : ndarray (2, 2)
        Map displacement (east, north), m, of a column (first column) and of a row (second).
    first : ndarray (2,)
        Map position of row 0, column 0.
    """
    known = np.isfinite(clip.x) & np.isfinite(clip.y)
    row, column = np.nonzero(known)
    some = slice(None, None, max(row.size // LATTICE_SAMPLES, 1))
    row, column = row[some], column[some]
    places = np.column_stack([clip.x[row, column], clip.y[row, column]])
    origin = places.mean(axis=0)
    design = np.column_stack([column, row, np.ones(row.size)]).astype(float)
    fit = np.linalg.lstsq(design, places - origin, rcond=None)[0]
    return np.asarray(fit[:2].T), np.asarray(fit[2] + origin)


def _bend(clip: Clip, valid: BoolArray, steps: FloatArray, first: FloatArray) -> float:
    """Largest distance (east or north) of valid pixels from a straight lattice, m."""
    row, column = np.arange(valid.shape[0])[:, None], np.arange(valid.shape[1])
    worst = 0.0
    for i, places in enumerate((clip.x, clip.y)):
        offset = np.abs(places - (first[i] + steps[i, 0] * column + steps[i, 1] * row))
        worst = max(worst, float(offset[valid].max()))
    return worst


def _summed(
    clip: Clip,
    power: FloatArray,
    valid: BoolArray,
    saturated: BoolArray,
    azimuth: float,
    mean: float,
) -> Image:
    """Average pixels onto a north-up lattice."""
    size = clip.pixel_size
    x, y = clip.x[valid], clip.y[valid]
    row, column = _places(x, y, size)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    index = row * shape[1] + column
    count = np.bincount(index, minlength=shape[0] * shape[1])

    def average(values: FloatArray) -> FloatArray:
        total = np.bincount(index, values[valid], shape[0] * shape[1])
        return (total / np.maximum(count, 1)).reshape(shape)

    filled = (count > 0).reshape(shape)
    return Image(
        average(power),
        filled,
        average(saturated.astype(float)) > 0,
        np.where(filled, average(clip.ground_range), np.nan),
        np.where(filled, average(clip.altitude), np.nan),
        np.array([[size, 0.0], [0.0, -size]]),
        azimuth,
        mean,
        np.array([x.min() + 0.5 * size * (shape[1] - 1), y.max() - 0.5 * size * (shape[0] - 1)]),
    )


def on_clip(clip: Clip, image: Image, values: FloatArray) -> FloatArray:
    """Transfer values from an image's lattice back to the pixels of its clip.

    Parameters
    ----------
    clip : Clip
    image : Image
        Image of the clip.
    values : ndarray (rows, columns)
        On the image's lattice.

    Returns
    -------
    ndarray (rows, columns)
        On the clip's; NaN where the clip is not valid.
    """
    valid = clip.valid
    if image.shape == clip.amplitude.shape:
        return np.where(valid, values, np.nan)
    result = np.full(valid.shape, np.nan)
    x, y = clip.x[valid], clip.y[valid]
    row, column = _places(x, y, clip.pixel_size)
    result[valid] = values[row, column]
    return result


def _places(x: FloatArray, y: FloatArray, size: float) -> tuple[IntArray, IntArray]:
    """Rows and columns of a north-up lattice around map positions."""
    column = np.rint((x - x.min()) / size).astype(np.int64)
    row = np.rint((y.max() - y) / size).astype(np.int64)
    return row, column
