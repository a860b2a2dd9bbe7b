"""The sediment map of a survey: looks read cell by cell, classes from a sample of them.

Amplitudes are laid on the survey's own pixels. Where a cell is rippled its amplitude is taken over
the ripples' modelled relief, so that troughs are no sediment of their own and shadow is none.
Everything of the map's size lies on disk; memory does not grow with the survey.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.io.canvas import Canvas
from sasmap.numerics.threads import mapped
from sasmap.run.class_models import ClassModel
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.mapping import Line, paint, refined, traced
from sasmap.sediments.segmentation import Classes, carry_over, find_classes, train_classes
from sasmap.sediments.trends import BLOCK, AmplitudeGrid

FloatArray = NDArray[np.float64]
Read = Callable[[int, int, int], tuple[FloatArray, FloatArray] | None]

# Pixels, of all looks, from which classes are found, and cells they come from at most.
SAMPLE, SAMPLED_CELLS = 6_000_000, 100
# Pixels a side, about, of the blocks that are classified at once, and around them that decide too.
SIDE, HALO = 1024, 32
# Steps of a quantised log likelihood, nats, and the most below the best class.
STEP, DEEPEST = 0.1, 12.7
# Steps of the probability that is kept.
PROBABILITY = 0.002
# Bins of a class's amplitudes in the report, and cells that they are of, at most.
BINS, DRAWN = 40, 24


class Ground(NamedTuple):
    """How a survey is read.

    Attributes
    ----------
    rows, columns : int
        Cells.
    window : int
        Pixels a side of a cell.
    looks : int
    read : callable
        ``read(row, column, look)`` gives amplitude and cotangent of the grazing angle (window,
        window), or None.
    """

    rows: int
    columns: int
    window: int
    looks: int
    read: Read

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels of the map."""
        return self.rows * self.window, self.columns * self.window

    def cell(self, row: int, column: int) -> list[AmplitudeGrid]:
        """All looks at a cell; NaN where there is none."""
        none = np.full((self.window, self.window), np.nan)
        parts = (self.read(row, column, k) for k in range(self.looks))
        return [
            AmplitudeGrid(none, none) if part is None else AmplitudeGrid(*part) for part in parts
        ]


class Quantised:
    """Log likelihoods of one class, kept in a byte each; slices are nats."""

    def __init__(self, values: Any) -> None:
        self.values = values

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.values.shape
        return rows, columns

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        """Return nats of a part of the map."""
        return np.asarray(self.values[part] * np.float32(STEP), np.float32)


@dataclass(frozen=True)
class SedimentMap:
    """A survey's sediments; the rasters last until the canvases are closed.

    Attributes
    ----------
    label : Canvas of uint8 (rows, columns)
    confidence : Canvas of float32 (rows, columns)
    lines : tuple of Line
    classes : Classes
    names : tuple of str
    """

    label: Canvas
    confidence: Canvas
    lines: tuple[Line, ...]
    classes: Classes
    names: tuple[str, ...]

    def histograms(self, ground: Ground) -> list[dict[str, list[float]]]:
        """Amplitudes of each class on the map, less gain and trend, of some cells.

        Parameters
        ----------
        ground : Ground

        Returns
        -------
        list of dict
            ``edges`` and ``counts`` of each class.
        """
        top = [4 * np.sqrt(law.mean_square) for law in self.classes.laws]
        edges = [np.linspace(0, v, BINS + 1) for v in top]
        counts = [np.zeros(BINS) for _ in top]
        every = [(r, c) for r in range(ground.rows) for c in range(ground.columns)]
        for place in _thinned(every, DRAWN):
            label = self.label[_pixels_of(place, ground.window)]
            for k, look in enumerate(ground.cell(*place)):
                trend = self.classes.log_trend(k, np.nan_to_num(look.cotangent, nan=1.0))
                flat = look.amplitude * np.exp(-trend)
                for i, count in enumerate(counts):
                    count += np.histogram(flat[label == i + 1], edges[i])[0]
        return [
            {"edges": e.tolist(), "counts": c.tolist()} for e, c in zip(edges, counts, strict=True)
        ]

    def pixels(self) -> NDArray[np.int64]:
        """Count pixels by number of the class (256,)."""
        total = np.zeros(256, np.int64)
        for top in range(0, self.label.shape[0], SIDE):
            total += np.bincount(self.label[slice(top, top + SIDE)].ravel(), minlength=256)
        return total

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
        pixels = self.pixels()
        if not self.classes.laws:
            return []
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


def map_sediments(
    ground: Ground,
    count: int | None,
    known: ClassModel | None,
    workers: int | None,
    scratch: Path,
    stack: ExitStack,
    progress: Callable[[int, int], None] | None = None,
) -> SedimentMap | None:
    """Find or learn classes, map them and refine their boundaries.

    Parameters
    ----------
    ground : Ground
    count : int or None
        Classes; found where None.
    known : ClassModel or None
        Classes with training, or of another survey.
    workers : int or None
        Threads.
    scratch : Path
        Folder of the rasters in the making.
    stack : ExitStack
        Closes them.
    progress : callable, optional
        Called with the number of cells that have been read and of all.

    Returns
    -------
    SedimentMap or None
        None where no look shows the floor.

    Raises
    ------
    ValueError
        Where training shows too few pixels.
    """

    def canvas(name: str, dtype: str) -> Canvas:
        path = scratch / f"{name}.part"
        return stack.enter_context(Canvas(path, ground.shape, dtype, ground.window))

    classes = _classes(ground, count, known, workers)
    if classes is None:
        return None
    number = len(classes.laws)
    kept = [canvas(f"likelihood{k}", "int8") for k in range(len(classes.every))]
    seen, label = canvas("seen", "uint8"), canvas("label", "uint8")
    confidence = canvas("confidence", "float32")

    def weigh(place: tuple[int, int]) -> None:
        part = _pixels_of(place, ground.window)
        found = log_likelihoods(ground.cell(*place), classes)
        seen[part] = np.isfinite(found[0])
        for layer, values in zip(kept, _quantised(found), strict=True):
            layer[part] = values

    def classify(place: tuple[int, int]) -> None:
        _classify(place, side, seen, kept, number, label, confidence)

    every = product(range(ground.rows), range(ground.columns))
    for done, _ in enumerate(mapped(weigh, every, workers), 1):
        if progress is not None:
            progress(done, ground.rows * ground.columns)
    rows, columns = ground.shape
    side = max(SIDE // ground.window, 1) * ground.window
    deque(mapped(classify, product(range(0, rows, side), range(0, columns, side)), workers), 0)
    layers = [Quantised(layer) for layer in kept]
    lines = refined(traced(label), layers, workers)
    final = canvas("final", "uint8")
    for top in range(0, rows, SIDE):
        final[slice(top, top + SIDE)] = label[slice(top, top + SIDE)]
    paint(label, lines, final)
    if known is not None:
        return SedimentMap(final, confidence, tuple(lines), classes, known.names)
    return _without_empty(SedimentMap(final, confidence, tuple(lines), classes, ()))


def _without_empty(found: SedimentMap) -> SedimentMap:
    """Name classes, and number them without those that the sample held but the map does not."""
    pixels = found.pixels()
    there = [k for k in range(len(found.classes.laws)) if pixels[k + 1] > 0]
    number = np.zeros(256, np.uint8)
    number[[k + 1 for k in there]] = np.arange(1, len(there) + 1)
    if len(there) < len(found.classes.laws):
        for top in range(0, found.label.shape[0], SIDE):
            part = slice(top, top + SIDE)
            found.label[part] = number[found.label[part]]
    # a line can only part classes that are on the map
    lines = tuple(
        line._replace(left=int(number[line.left]), right=int(number[line.right]))
        for line in found.lines
        if number[line.left] and number[line.right]
    )
    classes = replace(found.classes, laws=tuple(found.classes.laws[k] for k in there))
    names = tuple(f"class {k + 1}" for k in range(len(there)))
    return replace(found, lines=lines, classes=classes, names=names)


def _pixels_of(place: tuple[int, int], window: int) -> tuple[slice, slice]:
    row, column = (v * window for v in place)
    return slice(row, row + window), slice(column, column + window)


def _classify(
    place: tuple[int, int],
    side: int,
    seen: Any,
    kept: Sequence[Any],
    count: int,
    label: Any,
    confidence: Any,
) -> None:
    """Classify one block of pixels, with those around it in view."""
    top, left = place
    bottom, right = min(top + side, seen.shape[0]), min(left + side, seen.shape[1])
    part = (
        slice(max(top - HALO, 0), min(bottom + HALO, seen.shape[0])),
        slice(max(left - HALO, 0), min(right + HALO, seen.shape[1])),
    )
    there = seen[part] > 0
    likelihood = np.stack([Quantised(layer)[part] for layer in kept])
    likelihood[:, ~there] = np.nan
    found = class_map(likelihood, count)
    inner = (
        slice(top - part[0].start, bottom - part[0].start),
        slice(left - part[1].start, right - part[1].start),
    )
    where = slice(top, bottom), slice(left, right)
    label[where] = found.label[inner]
    confidence[where] = np.rint(found.probability[inner] / PROBABILITY) * PROBABILITY


def _classes(
    ground: Ground, count: int | None, known: ClassModel | None, workers: int | None
) -> Classes | None:
    """Classes from a sample of the survey; None where that shows nothing."""
    cells, side = _sampled(ground, known)

    def middles(place: tuple[int, int]) -> list[AmplitudeGrid]:
        # all of a cell is read, and no more than its middle kept
        return [
            AmplitudeGrid(*(_middle(v, side).copy() for v in look)) for look in ground.cell(*place)
        ]

    read = list(mapped(middles, cells, workers))
    whole = side == ground.window and len(cells) == ground.rows * ground.columns
    width = ground.columns if whole else int(np.ceil(np.sqrt(len(cells))))
    looks = [
        AmplitudeGrid(*(_laid([cell[k][i] for cell in read], side, width, whole) for i in range(2)))
        for k in range(ground.looks)
    ]
    if not any(np.isfinite(look.amplitude).any() for look in looks):
        return None
    if known is None:
        return find_classes(looks, count)
    if known.laws:
        return carry_over(looks, known.laws, known.centre)
    assert known.marks is not None
    marks = _laid([known.marks(*place) for place in cells], side, width, whole)
    return train_classes(looks, np.nan_to_num(marks).astype(np.uint8), len(known.names))


def _sampled(ground: Ground, known: ClassModel | None) -> tuple[list[tuple[int, int]], int]:
    """Choose cells that speak for the survey, and pixels a side of what is taken of each."""
    every = [(r, c) for r in range(ground.rows) for c in range(ground.columns)]
    first = _thinned(list(known.cells), SAMPLED_CELLS) if known else []
    rest = _thinned([c for c in every if c not in set(first)], SAMPLED_CELLS)
    cells = sorted({*first, *rest}) if len(every) > SAMPLED_CELLS else every
    most = int(np.sqrt(SAMPLE / (len(cells) * ground.looks)))
    if ground.window <= most:
        return cells, ground.window
    if known and known.marks is not None:  # marks may lie anywhere in a cell
        many = max(int(SAMPLE // (ground.window**2 * ground.looks)), 4)
        return sorted({*_thinned(first, many), *_thinned(rest, many // 2)}), ground.window
    return cells, min(max(most // BLOCK, 4) * BLOCK, ground.window)


def _thinned(cells: list[tuple[int, int]], most: int) -> list[tuple[int, int]]:
    """Evenly thin a list."""
    if len(cells) <= most:
        return cells
    return [cells[int(k)] for k in np.unique(np.linspace(0, len(cells) - 1, most).round())]


def _laid(parts: Sequence[NDArray[Any]], side: int, width: int, whole: bool) -> FloatArray:
    """Lay the middles of cells side by side; apart, unless they are the whole survey."""
    seam = 0 if whole else BLOCK
    step = side + seam
    height = -(-len(parts) // width)
    result = np.full((height * step, width * step), np.nan)
    for i, part in enumerate(parts):
        row, column = (v * step for v in divmod(i, width))
        result[row : row + side, column : column + side] = _middle(part, side)
    return result


def _middle(part: NDArray[Any], side: int) -> NDArray[Any]:
    first = (part.shape[0] - side) // 2
    return part[first : first + side, first : first + side]


def _quantised(likelihood: NDArray[np.float32]) -> NDArray[np.int8]:
    level = np.nan_to_num(likelihood)
    below = np.maximum(level - level.max(axis=0), -DEEPEST)
    return np.asarray(np.rint(below / STEP), np.int8)
