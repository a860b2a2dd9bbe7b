"""The sediment map of a survey: classes of its surface, mapped block by block.

Pixels are on disk; only statistics of blocks of 16 by 16 pixels grow with the survey in memory.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import FloatArray, IntArray
from sasmap.io.canvas import Canvas
from sasmap.numerics.threads import Workers, mapped
from sasmap.run.class_models import ClassModel
from sasmap.run.sediment_surface import Ground, Part, Surface, lay
from sasmap.sediments.carrying import carry_over
from sasmap.sediments.classes import Classes
from sasmap.sediments.classmap import averaged, below_best, class_map, log_likelihoods, sieved
from sasmap.sediments.fitting import Law, shares
from sasmap.sediments.mapping import Line, paint, refined, sides, traced
from sasmap.sediments.patches import counted
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.texture import MARGIN, SHARED
from sasmap.sediments.training import train_classes

# Side in pixels of the blocks that are classified at once, and of the margin that affects them.
SIDE, HALO = 1024, 32
# Step of a quantised log likelihood, nats, and its largest depth below the best class.
STEP, DEEPEST = 0.1, 12.7
# Name of objects, and the confidence shown for them: a guess, not calibrated.
OBJECT, CERTAIN = "object", 0.9
# Step of the stored probability.
PROBABILITY = 0.002
# Size in pixels of the smallest patch that is rippled, or flat among ripples: a few wavelengths.
FEWEST_RIPPLED = 4096
# Side in pixels of the window over which rippled floor is averaged and classified: one to three
# wavelengths, half of the longest. Troughs in shadow show noise, whose law is not a sediment's.
WAVES = 2 * HALO + 1
# Bins of a class's amplitudes in the report; maximum number of blocks that are read for them, and
# side of these in pixels.
BINS, DRAWN, DRAWN_SIDE = 40, 24, 256


class Quantised:
    """Log likelihoods of one class, stored in one byte each; slices return nats."""

    def __init__(self, values: Any, step: float = STEP) -> None:
        self.values, self.step = values, step

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.values.shape
        return rows, columns

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        """Return nats of a part of the map."""
        return np.asarray(self.values[part] * np.float32(self.step), np.float32)


class Drawn(NamedTuple):
    """Amplitudes of a class on some blocks of the map.

    Attributes
    ----------
    edges : ndarray (n,)
        Edges of bins, from 0.
    counts : ndarray (n,)
        Number of pixels in each bin, and of those above the last edge.
    mean_square : float
    """

    edges: FloatArray
    counts: FloatArray
    mean_square: float

    def histogram(self) -> dict[str, list[float]]:
        """Return ``edges`` and the ``counts`` between them."""
        return {"edges": self.edges.tolist(), "counts": self.counts[:-1].tolist()}

    def beyond(self, law: Law) -> float | None:
        """Share of pixels in excess of a law, summed over bins; None where there are none."""
        total = self.counts.sum()
        if not total:
            return None
        over = self.counts / total - shares(law, self.edges)
        return round(float(np.maximum(over, 0).sum()), 4)

    def level(self, first: float) -> float | None:
        """Mean intensity of the pixels relative to `first`, dB; None where there are none."""
        return _decibels(self.mean_square / first) if self.mean_square > 0 else None


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
    surface : Surface
    rippled : Canvas of uint8 (rows, columns)
        1 where the floor is rippled.
    objects : bool
        Whether the map shows objects, whose number follows those of the classes.
    unmerged : (tuple of str, Classes) or None
        Names and classes before classes of the same name were merged: with these the map can be
        reproduced.
    """

    label: Canvas
    confidence: Canvas
    lines: tuple[Line, ...]
    classes: Classes
    names: tuple[str, ...]
    surface: Surface
    rippled: Canvas
    objects: bool = False
    unmerged: tuple[tuple[str, ...], Classes] | None = None

    @property
    def every_name(self) -> tuple[str, ...]:
        """Names of all numbers of the map, from 1."""
        return (*self.names, OBJECT) if self.objects else self.names

    def drawn(self) -> list[Drawn]:
        """Gather amplitudes of each class in some blocks of the map, gain and trend removed."""
        top = [4 * np.sqrt(law.mean_square) for law in self.classes.laws]
        edges = [np.append(np.linspace(0, v, BINS + 1), np.inf) for v in top]
        counts = [np.zeros(BINS + 1) for _ in top]
        power = np.zeros(len(top))
        for part in _thinned(self.surface.blocks(DRAWN_SIDE), DRAWN):
            label = self.label[part]
            for k, look in enumerate(self.surface.part(part, self.classes.ranged)):
                cotangent = np.nan_to_num(look.cotangent, nan=1.0)
                trend = self.classes.log_trend(k, cotangent, look.altitude)
                flat = look.amplitude * np.exp(-trend)
                for i, count in enumerate(counts):
                    values = flat[(label == i + 1) & np.isfinite(flat)]
                    count += np.histogram(values, edges[i])[0]
                    power[i] += (values**2).sum()
        return [
            Drawn(e[:-1], c, float(p / max(c.sum(), 1)))
            for e, c, p in zip(edges, counts, power, strict=True)
        ]

    def renumbered(self, number: NDArray[np.uint8]) -> tuple[Line, ...]:
        """Give classes new numbers on the map (256,); return lines that still separate classes."""
        if (number[1 : len(self.classes.laws) + 1] != np.arange(len(self.classes.laws)) + 1).any():
            for top in range(0, self.label.shape[0], SIDE):
                part = slice(top, top + SIDE)
                self.label[part] = number[self.label[part]]
        return tuple(
            line._replace(left=int(number[line.left]), right=int(number[line.right]))
            for line in self.lines
            if number[line.left] and number[line.right] and number[line.left] != number[line.right]
        )

    def merged(self) -> SedimentMap:
        """Merge classes of the same name into one class with the first one's law."""
        names = tuple(dict.fromkeys(self.names))
        number = np.zeros(256, np.uint8)
        number[1 : len(self.names) + 1] = [names.index(name) + 1 for name in self.names]
        lines = self.renumbered(number)
        first = tuple(self.classes.laws[self.names.index(name)] for name in names)
        return replace(
            self,
            lines=lines,
            names=names,
            classes=replace(self.classes, laws=first),
            unmerged=(self.names, self.classes),
        )

    def with_objects(self) -> SedimentMap:
        """Mark objects on the map."""
        there = False
        for part in self.surface.blocks(SIDE):
            things = self.surface.objects[part] > 0
            if things.any():
                self.label[part] = np.where(things, len(self.names) + 1, self.label[part])
                self.confidence[part] = np.where(things, CERTAIN, self.confidence[part])
                there = True
        return replace(self, objects=there)

    def pixels(self) -> IntArray:
        """Count pixels by number of the class (256,)."""
        total = np.zeros(256, np.int64)
        for top in range(0, self.label.shape[0], SIDE):
            total += counted(self.label[slice(top, top + SIDE)])
        return total

    def table(self, pixel_area: float, drawn: Sequence[Drawn]) -> list[dict[str, Any]]:
        """List the entries of ``run.json``, class by class.

        Parameters
        ----------
        pixel_area : float
            m^2.
        drawn : sequence of Drawn
            Of :meth:`drawn`.

        Returns
        -------
        list of dict
        """
        pixels = self.pixels()
        if not self.classes.laws:
            return []
        first = self.classes.laws[0].mean_square
        bands = self.classes.bands
        # a span of log amplitude
        gain = None if bands is None else _decibels(float(np.exp(2 * bands.span)))
        rows: list[dict[str, Any]] = [
            {
                "number": i + 1,
                "name": name,
                "law": law.family,
                "nu": None if not np.isfinite(law.nu) else round(law.nu, 4),
                "kappa": round(law.kappa, 4),
                "intensity_dB_over_first": _decibels(law.mean_square / first),
                "intensity_of_pixels_dB_over_first": one.level(first),
                "divergence_of_fit": _rounded(law.divergence),
                "share_beyond_law": one.beyond(law),
                "taken_for_gain_by_range_dB": gain,
                "area_m2": round(float(pixels[i + 1]) * pixel_area, 3),
            }
            for i, (name, law, one) in enumerate(
                zip(self.names, self.classes.laws, drawn, strict=True)
            )
        ]
        if self.objects:
            nothing: dict[str, Any] = dict.fromkeys(rows[0])
            area = round(float(pixels[len(rows) + 1]) * pixel_area, 3)
            told = {"number": len(rows) + 1, "name": OBJECT, "area_m2": area}
            rows.append({**nothing, **told, "taken_for_gain_by_range_dB": gain})
        return rows


def _decibels(ratio: float) -> float:
    return round(10 * float(np.log10(ratio)), 3)


def _rounded(value: float) -> float | None:
    return round(float(value), 5) if np.isfinite(value) else None


def map_sediments(
    ground: Ground,
    count: int | None,
    known: ClassModel | None,
    workers: Workers,
    scratch: Path,
    stack: ExitStack,
    least: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> SedimentMap | None:
    """Find or learn classes, map them and refine their boundaries.

    Parameters
    ----------
    ground : Ground
    count : int or None
        Number of classes; found from the data where None.
    known : ClassModel or None
        Classes with training, or of another survey.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.
    scratch : Path
        Folder of the unfinished rasters.
    stack : ExitStack
        Closes them.
    least : float
        Size in pixels of the smallest patch that the map shows.
    progress : callable, optional
        Called with the number of cells that have been read and of all cells.

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
        return stack.enter_context(Canvas(scratch / f"{name}.part", ground.shape, dtype))

    objects = known is None or known.objects
    surface = lay(ground, known, workers, scratch, stack, progress, objects)
    classes = _classes(surface, count, known, workers)
    if classes is None:
        return None
    kept = [canvas(f"likelihood{k}", "int8") for k in range(len(classes.every))]
    label, confidence = canvas("label", "uint8"), canvas("confidence", "float32")

    def classify(part: Part) -> None:
        _classify(surface, classes, part, kept, label, confidence)

    deque(mapped(classify, surface.blocks(SIDE), workers), 0)
    label = _without_crests(surface, label, canvas("beds", "uint8"), workers)
    # a pixel's log odds by texture are those of its window: a boundary may count them only once
    step = STEP if classes.texture is None else STEP / SHARED
    layers = [Quantised(layer, step) for layer in kept]
    lines = refined(traced(label), layers, workers)
    final = canvas("final", "uint8")
    for top in range(0, surface.shape[0], SIDE):
        final[slice(top, top + SIDE)] = label[slice(top, top + SIDE)]
    paint(label, lines, final, workers)
    if least > 1:
        final = _without_small(surface, final, least, canvas("sieved", "uint8"), workers)
        lines = [line for line in lines if _parts(final, line)]
    rippled = canvas("ripples", "uint8")
    _mark_rippled(surface, final, max(least, FEWEST_RIPPLED), rippled, workers)
    names = known.names if known is not None else ()
    found = SedimentMap(final, confidence, tuple(lines), classes, names, surface, rippled)
    found = found.merged() if known is not None else _without_empty(found)
    return found.with_objects()


def _parts(label: Canvas, line: Line) -> bool:
    """Whether a line still separates two classes after small patches were reassigned."""
    left, right = sides(label, line.boundary.points, line.boundary.closed)
    return bool(2 * (left != right).sum() >= left.size)


def _without_small(
    surface: Surface,
    label: Canvas,
    least: float,
    result: Canvas,
    workers: Workers,
) -> Canvas:
    """Reassign patches of too few pixels to the nearest class, block by block."""
    margin = int(np.ceil(2 * np.sqrt(least)))  # most patches are no longer than twice their root

    def one(part: Part) -> None:
        wide, inner = surface.around(part, margin)
        result[part] = sieved(label[wide], least, wide == surface.whole)[inner]

    deque(mapped(one, surface.blocks(2 * SIDE), workers), 0)
    return result


def _without_crests(surface: Surface, label: Canvas, result: Canvas, workers: Workers) -> Canvas:
    """Reassign single crests and troughs that differ from their bed to it, block by block."""
    margin = int(2 * np.sqrt(FEWEST_RIPPLED))

    def one(part: Part) -> None:
        wide, inner = surface.around(part, margin)
        rippled = surface.rippled[wide] > 0
        if rippled.any():
            beds = sieved(label[wide], FEWEST_RIPPLED, wide == surface.whole, rippled)
            result[part] = beds[inner]
        else:
            result[part] = label[part]

    deque(mapped(one, surface.blocks(2 * SIDE), workers), 0)
    return result


def _mark_rippled(
    surface: Surface, label: Canvas, least: float, result: Canvas, workers: Workers
) -> None:
    """Mark the rippled part of each class, without patches of too few pixels, block by block."""
    margin = int(np.ceil(2 * np.sqrt(least)))

    def one(part: Part) -> None:
        wide, inner = surface.around(part, margin)
        classes, rippled = label[wide], surface.rippled[wide]
        if not rippled.any():
            return
        # a patch is of one class; one that is too small becomes like its surroundings
        both = np.where(classes > 0, 2 * classes + rippled, 0).astype(np.uint8)
        both = sieved(both, least, wide == surface.whole)
        result[part] = np.where(classes > 0, both & 1, rippled)[inner]

    deque(mapped(one, surface.blocks(2 * SIDE), workers), 0)


def _without_empty(found: SedimentMap) -> SedimentMap:
    """Name and number the classes, dropping those that are not on the map."""
    pixels = found.pixels()
    there = [k for k in range(len(found.classes.laws)) if pixels[k + 1] > 0]
    number = np.zeros(256, np.uint8)
    number[[k + 1 for k in there]] = np.arange(1, len(there) + 1)
    lines = found.renumbered(number)
    texture = found.classes.texture
    classes = replace(
        found.classes,
        laws=tuple(found.classes.laws[k] for k in there),
        texture=texture if texture is None else texture.of(there),
    )
    names = tuple(f"class {k + 1}" for k in range(len(there)))
    return replace(found, lines=lines, classes=classes, names=names)


def _classify(
    surface: Surface,
    classes: Classes,
    part: Part,
    kept: Sequence[Any],
    label: Any,
    confidence: Any,
) -> None:
    """Classify one block of pixels, using a margin around it."""
    wide, inner = surface.around(part, HALO if classes.texture is None else HALO + MARGIN)
    likelihood = log_likelihoods(surface.part(wide, classes.ranged), classes)
    bed = averaged(likelihood, surface.rippled[wide] > 0, WAVES)
    found = class_map(bed, len(classes.laws), whole=wide == surface.whole)
    for layer, values in zip(kept, _quantised(likelihood[:, *inner]), strict=True):
        layer[part] = values
    label[part] = found.label[inner]
    confidence[part] = np.rint(found.probability[inner] / PROBABILITY) * PROBABILITY


def _classes(
    surface: Surface, count: int | None, known: ClassModel | None, workers: Workers
) -> Classes | None:
    """Find, take over or learn classes; None where no look shows the floor."""
    looks = surface.slices()
    if not surface.shown(workers):
        return None
    if known is None:
        return find_classes(looks, count, workers, surface.rippled)
    if known.laws:
        found = carry_over(looks, known.laws, known.centre, workers)
        return replace(found, texture=known.texture)
    return train_classes(looks, surface.marks, len(known.names), workers)


def _thinned(parts: list[Part], most: int) -> list[Part]:
    """Evenly thin a list."""
    if len(parts) <= most:
        return parts
    return [parts[int(k)] for k in np.unique(np.linspace(0, len(parts) - 1, most).round())]


def _quantised(likelihood: NDArray[np.float32]) -> NDArray[np.int8]:
    below = below_best(likelihood)
    np.maximum(below, np.float32(-DEEPEST), out=below)
    below *= np.float32(1 / STEP)
    return np.rint(below, out=below).astype(np.int8)
