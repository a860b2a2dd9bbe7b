"""The sediment map of a survey: looks read in bands of cells, classes from a sample of them.

Amplitudes are laid on the survey's own pixels. Where a cell is rippled its amplitude is taken over
the ripples' modelled relief, so that troughs are no sediment of their own and shadow is none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import dask
import numpy as np
from numpy.typing import NDArray

from sasmap.sediments.mapping import Line, refine_map
from sasmap.sediments.segmentation import Classes, Look, class_map, find_classes, log_likelihoods

FloatArray = NDArray[np.float64]

# Pixels, of all looks, from which classes are found; and rows of a neighbouring band that decide
# with a band's own.
SAMPLE = 6_000_000
HALO = 32
# Steps of a quantised log likelihood, nats, and the most below the best class.
STEP, DEEPEST = 0.1, 12.7
# Modelled amplitude, over that of flat sea floor, below which there is shadow.
SHADOW = 0.25


class Bands(NamedTuple):
    """How a survey is read.

    Attributes
    ----------
    rows, columns : int
        Cells.
    window : int
        Pixels a side of a cell.
    looks : int
    read : callable
        ``read(row, column, look)`` gives amplitude and ground range (window, window), or None.
    """

    rows: int
    columns: int
    window: int
    looks: int
    read: Callable[[int, int, int], tuple[FloatArray, FloatArray] | None]

    def band(self, row: int, workers: int | None) -> list[Look]:
        """One row of cells, all looks (window, columns * window)."""
        shape = (self.window, self.columns * self.window)
        found = [Look(np.full(shape, np.nan), np.full(shape, np.nan)) for _ in range(self.looks)]
        places = [(c, k) for c in range(self.columns) for k in range(self.looks)]
        tasks = [dask.delayed(self.read, pure=False)(row, c, k) for c, k in places]
        parts = dask.compute(*tasks, scheduler="threads", num_workers=workers)
        for (column, k), part in zip(places, parts, strict=True):
            if part is not None:
                where = slice(column * self.window, (column + 1) * self.window)
                found[k].amplitude[:, where], found[k].ground_range[:, where] = part
        return found


class Quantised:
    """Log likelihoods of one class, kept in a byte each; slices are nats."""

    def __init__(self, values: NDArray[np.int8]) -> None:
        self.values = values

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        """Return nats of a part of the map."""
        return np.asarray(self.values[part] * np.float32(STEP), np.float32)


@dataclass(frozen=True)
class SedimentMap:
    """A survey's sediments.

    Attributes
    ----------
    label : ndarray of uint8 (rows, columns)
    confidence : ndarray of float32 (rows, columns)
    lines : tuple of Line
    classes : Classes
    """

    label: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    lines: tuple[Line, ...]
    classes: Classes

    @property
    def names(self) -> list[str]:
        """Of the classes, by rising intensity."""
        return [f"class {i + 1}" for i in range(len(self.classes.laws))]

    def table(self, pixel_area: float) -> list[dict[str, Any]]:
        """Class by class what ``run.json`` says.

        Parameters
        ----------
        pixel_area : float
            m^2.

        Returns
        -------
        list of dict
        """
        pixels = np.bincount(self.label.ravel(), minlength=len(self.names) + 1)
        first = self.classes.laws[0].mean_square
        return [
            {
                "number": i + 1,
                "name": name,
                "law": law.family,
                "nu": None if not np.isfinite(law.nu) else round(law.nu, 4),
                "kappa": round(law.kappa, 4),
                "intensity_dB_over_first": round(10 * float(np.log10(law.mean_square / first)), 3),
                "area_m2": round(float(pixels[i + 1]) * pixel_area, 3),
            }
            for i, (name, law) in enumerate(zip(self.names, self.classes.laws, strict=True))
        ]


def map_sediments(bands: Bands, count: int | None, workers: int | None) -> SedimentMap | None:
    """Find classes, map them and refine their boundaries.

    Parameters
    ----------
    bands : Bands
    count : int or None
        Classes; found where None.
    workers : int or None
        Threads that read.

    Returns
    -------
    SedimentMap or None
        None where no look shows the floor.
    """
    sample = {row: bands.band(row, workers) for row in _sampled_rows(bands)}
    looks = _stacked(list(sample.values()))
    if not any(np.isfinite(look.amplitude).any() for look in looks):
        return None
    classes = find_classes(looks, count)
    del looks

    def likelihoods(row: int) -> NDArray[np.float32]:
        read = sample.pop(row, None)
        return log_likelihoods(read or bands.band(row, workers), classes)

    shape = (bands.rows * bands.window, bands.columns * bands.window)
    label = np.zeros(shape, np.uint8)
    confidence = np.full(shape, np.nan, np.float32)
    kept = np.zeros((len(classes.laws), *shape), np.int8)
    ahead = likelihoods(0)
    behind = ahead[:, :0]
    for row in range(bands.rows):
        here = ahead
        last = row + 1 == bands.rows
        ahead = here[:, :0] if last else likelihoods(row + 1)
        around = np.concatenate([behind[:, -HALO:], here, ahead[:, :HALO]], axis=1)
        found = class_map(around)
        above = behind[:, -HALO:].shape[1]
        inside = slice(above, above + bands.window)
        where = slice(row * bands.window, (row + 1) * bands.window)
        label[where], confidence[where] = found.label[inside], found.probability[inside]
        kept[:, where] = _quantised(here)
        behind = here
    refined = refine_map(label, [Quantised(layer) for layer in kept])
    return SedimentMap(refined.label, confidence, refined.lines, classes)


def _quantised(likelihood: NDArray[np.float32]) -> NDArray[np.int8]:
    level = np.nan_to_num(likelihood)
    below = np.maximum(level - level.max(axis=0), -DEEPEST)
    return np.asarray(np.rint(below / STEP), np.int8)


def _sampled_rows(bands: Bands) -> list[int]:
    """Evenly spread rows of cells: all, where they are few."""
    each = bands.window**2 * bands.columns * bands.looks
    many = int(np.clip(SAMPLE // each, 1, bands.rows))
    if many == bands.rows:
        return list(range(bands.rows))
    spread = np.linspace(0, bands.rows - 1, many + 2)[1:-1]
    return [int(row) for row in np.unique(spread.round())]


def _stacked(read: list[list[Look]]) -> list[Look]:
    """Lay bands of cells one below the other, look by look."""
    return [Look(*map(np.vstack, zip(*parts, strict=True))) for parts in zip(*read, strict=True)]


def levelled(amplitude: FloatArray, relief: FloatArray | None) -> FloatArray:
    """Take ripples off an amplitude; NaN in their shadow.

    Parameters
    ----------
    amplitude : ndarray (window, window)
    relief : ndarray (window, window) or None
        Modelled amplitude over that of flat sea floor; NaN where there are no ripples.

    Returns
    -------
    ndarray (window, window)
    """
    if relief is None:
        return amplitude
    known = np.where(np.isfinite(relief), relief, 1.0)
    return np.asarray(np.where(known < SHADOW, np.nan, amplitude / np.maximum(known, SHADOW)))
