"""The survey's looks at the floor on the map's pixels on disk, with ripples removed.

The map is made from this surface in its own blocks, independent of the cells in which ripples are
estimated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import FloatArray, IntArray
from sasmap.errors import fault_of
from sasmap.io.canvas import Canvas
from sasmap.numerics.threads import Workers, mapped
from sasmap.run.class_models import ClassModel
from sasmap.sediments.conserved import LAMBERT, Bed, bed_of, power_of
from sasmap.sediments.conserved import MARGIN as REACH
from sasmap.sediments.floor import blocks_in, on_pixels
from sasmap.sediments.objects import find_objects
from sasmap.sediments.trends import BLOCK, AmplitudeGrid
from sasmap.sediments.waves import LATTICE, MARGIN, find_waves

Read = Callable[[int, int, int], tuple[FloatArray, FloatArray, FloatArray] | None]
Part = tuple[slice, slice]

# Side in pixels of the pieces in which ripples and objects are searched.
PIECE = 8 * LATTICE
# Side in pixels of the blocks in which rasters are stored, and its minimum where blocks are fitted
# to cells: parts of a block are written row by row, which took a twentieth of the stage.
WHOLE, FEWEST = 256, 128
# Maximum share of a class's training on objects; above it objects count as sediment.
TAUGHT = 0.05


class Ground(NamedTuple):
    """Layout of a survey, and the function that reads it.

    Attributes
    ----------
    rows, columns : int
        Number of cells.
    window : int
        Side of a cell in pixels.
    looks : int
    read : callable
        ``read(row, column, look)`` gives amplitude, cotangent of the grazing angle and altitude
        (window, window each), or None. An exception concerns that cell alone.
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


class Fault(NamedTuple):
    """A look at a cell that could not be read, and why."""

    row: int
    column: int
    look: int
    text: str


class Look(NamedTuple):
    """One look's rasters.

    Attributes
    ----------
    amplitude : Canvas
        0 for none.
    cotangent, altitude : Canvas
        Cotangent of the grazing angle; altitude, m.
    profile : Canvas
        Log of the amplitude profile of ripples.
    hidden : Canvas
        1 for objects, 2 for their shadow.
    """

    amplitude: Any
    cotangent: Any
    altitude: Any
    profile: Any
    hidden: Any


class Slices:
    """A look's amplitude with ripples removed, read in slices."""

    def __init__(self, look: Look) -> None:
        self._look = look
        self.shape: tuple[int, int] = look.amplitude.shape

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        """Read a slice; NaN where there is no amplitude."""
        amplitude = _known(self._look.amplitude[part])
        profile = self._look.profile[part]
        if profile.view(np.uint16).any():  # as integers, which are tested much faster
            amplitude *= np.exp(-profile.astype(np.float32))
        return amplitude


class Surface(NamedTuple):
    """All looks at a survey, read in slices.

    Attributes
    ----------
    shape : tuple of int
    looks : tuple of Look
    rippled : Canvas of uint8
        1 where a look shows ripples.
    objects : Canvas of uint8
        1 where a look shows an object that is not sediment.
    marks : Canvas of uint8 or None
        Training classes.
    faults : list of Fault
        Looks that could not be read.
    apart : bool
        Whether objects were removed.
    """

    shape: tuple[int, int]
    looks: tuple[Look, ...]
    rippled: Any
    objects: Any
    marks: Any
    faults: list[Fault]
    apart: bool = False

    def part(self, part: Part, ranged: bool) -> list[AmplitudeGrid]:
        """Amplitudes of all looks with ripples removed; NaN where there is none.

        Altitudes are read if gain depends on range.
        """
        return [
            AmplitudeGrid(
                one.amplitude[part],
                one.cotangent[part].astype(np.float32),
                one.altitude[part].astype(np.float32) if ranged else None,
            )
            for one in self.slices()
        ]

    def slices(self) -> list[AmplitudeGrid]:
        """All looks, to be read in slices."""
        return [AmplitudeGrid(Slices(k), k.cotangent, k.altitude) for k in self.looks]

    def shown(self, workers: Workers) -> bool:
        """Whether a look shows a pixel of the floor."""

        def one(part: Part) -> bool:
            return any(bool((look.amplitude[part] > 0).any()) for look in self.looks)

        return any(mapped(one, self.blocks(2 * PIECE), workers))

    @property
    def whole(self) -> Part:
        """The whole map."""
        return slice(0, self.shape[0]), slice(0, self.shape[1])

    def blocks(self, side: int) -> list[Part]:
        """Blocks of `side` by `side` pixels, row by row."""
        rows, columns = self.shape
        return [
            (slice(r, min(r + side, rows)), slice(c, min(c + side, columns)))
            for r, c in product(range(0, rows, side), range(0, columns, side))
        ]

    def around(self, part: Part, margin: int) -> tuple[Part, Part]:
        """Widen a part by a margin, within the map; also return the part's place in the result."""
        wide = tuple(
            slice(max(s.start - margin, 0), min(s.stop + margin, n))
            for s, n in zip(part, self.shape, strict=True)
        )
        inner = tuple(
            slice(s.start - w.start, s.stop - w.start) for s, w in zip(part, wide, strict=True)
        )
        return (wide[0], wide[1]), (inner[0], inner[1])


def lay(
    ground: Ground,
    known: ClassModel | None,
    workers: Workers,
    scratch: Path,
    stack: ExitStack,
    progress: Callable[[int, int], None] | None = None,
    objects: bool = True,
) -> Surface:
    """Write a survey's looks to disk, and remove ripples and objects from them.

    Parameters
    ----------
    ground : Ground
    known : ClassModel or None
        Its training marks are written as well.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.
    scratch : Path
        Folder of the rasters.
    stack : ExitStack
        Closes them.
    progress : callable, optional
        Called with the number of cells that have been read and of all cells.
    objects : bool
        Whether objects are searched for.

    Returns
    -------
    Surface
    """

    def canvas(name: str, dtype: str, block: int = WHOLE) -> Canvas:
        path = scratch / f"{name}.part"
        return stack.enter_context(Canvas(path, ground.shape, dtype, block))

    cells = _block_of(ground.window)
    looks = tuple(
        Look(
            canvas(f"amplitude{k}", "float32", cells),
            canvas(f"cotangent{k}", "float16", cells),
            canvas(f"altitude{k}", "float16", cells),
            canvas(f"profile{k}", "float16"),
            canvas(f"hidden{k}", "uint8"),
        )
        for k in range(ground.looks)
    )
    shown = known is not None and known.marks is not None
    marks = canvas("marks", "uint8", cells) if shown else None
    surface = Surface(
        ground.shape, looks, canvas("rippled", "uint8"), canvas("objects", "uint8"), marks, []
    )
    marked = set(known.cells) if known is not None else set()

    def read(place: tuple[int, int]) -> list[Fault]:
        part = _pixels_of(place, ground.window)
        faults = []
        for k, look in enumerate(looks):
            try:
                found = ground.read(*place, k)
            except Exception as error:  # one cell's fault must not end the survey
                faults.append(Fault(*place, k, fault_of(error)))
                continue
            if found is not None:
                look.amplitude[part] = np.nan_to_num(found[0])
                look.cotangent[part] = np.clip(found[1], None, 6e4)
                look.altitude[part] = np.clip(found[2], None, 6e4)
        if marks is not None and known is not None and known.marks is not None and place in marked:
            marks[part] = known.marks(*place)
        return faults

    every = product(range(ground.rows), range(ground.columns))
    for done, faults in enumerate(mapped(read, every, workers), 1):
        surface.faults.extend(faults)
        if progress is not None:
            progress(done, ground.rows * ground.columns)
    found = mapped(lambda p: _take_off(surface, p), surface.blocks(PIECE), workers)
    beds = [p for p, there in zip(surface.blocks(PIECE), found, strict=True) if there]
    if beds:
        _conserve(surface, beds, workers)
    return surface._replace(apart=objects and _set_apart(surface, workers))


def _set_apart(surface: Surface, workers: Workers) -> bool:
    """Find objects and remove them and their shadow from the looks; return whether it was done."""
    pieces = surface.blocks(PIECE)
    shown = list(mapped(lambda p: _find_objects(surface, p), pieces, workers))
    total = np.sum([marked for _, marked in shown], axis=0)
    taught = total[0, 1:] > 0
    if (total[1, 1:][taught] > TAUGHT * total[0, 1:][taught]).any():
        return False  # training shows a class made of such objects: they are sediment here
    # only now, since pieces read a margin around them
    there = [piece for piece, (found, _) in zip(pieces, shown, strict=True) if found]
    deque(mapped(lambda p: _hide(surface, p), there, workers), 0)
    return True


def _find_objects(surface: Surface, part: Part) -> tuple[bool, IntArray]:
    """Mark objects and shadow of each look in a piece.

    Returns whether there are any, and the number of training pixels of each class in the piece and
    on objects (2, 256).
    """
    wide, inner = surface.around(part, MARGIN)
    rippled = surface.rippled[wide] > 0
    things = np.zeros([s.stop - s.start for s in part], bool)
    any_shadow = False
    for look, one in zip(surface.looks, surface.slices(), strict=True):
        amplitude = one.amplitude[wide]
        if np.isnan(amplitude).all():
            continue
        found = find_objects(amplitude, look.cotangent[wide], rippled, inner)
        if found.object.any():
            look.hidden[part] = found.object + np.uint8(2) * found.shadow
            things |= found.object
            any_shadow |= bool(found.shadow.any())
        elif found.shadow.any():
            look.hidden[part] = np.uint8(2) * found.shadow
            any_shadow = True
    marked = np.zeros((2, 256), np.int64)
    if surface.marks is not None:
        marks = surface.marks[part]
        marked[:] = [np.bincount(v.ravel(), minlength=256) for v in (marks, marks * things)]
    return bool(things.any() or any_shadow), marked


def _hide(surface: Surface, part: Part) -> None:
    """Remove objects and shadow from a piece of the looks; mark objects on the map."""
    things = np.zeros([s.stop - s.start for s in part], bool)
    for look in surface.looks:
        hidden = look.hidden[part]
        things |= hidden == 1
        if hidden.any():
            look.amplitude[part] = np.where(hidden > 0, np.float32(0), look.amplitude[part])
    for look in surface.looks:  # an object hides the floor from all sides
        if things.any():
            look.amplitude[part] = np.where(things, np.float32(0), look.amplitude[part])
    surface.objects[part] = things


def _take_off(surface: Surface, part: Part) -> bool:
    """Find ripples in a piece of each look; return whether there are any."""
    wide, inner = surface.around(part, MARGIN)
    rippled = np.zeros([s.stop - s.start for s in part], bool)
    for look in surface.looks:
        amplitude = _known(look.amplitude[wide])
        if np.isnan(amplitude).all():
            continue
        waves = find_waves(amplitude, inner)
        if waves.rippled.any():
            look.profile[part] = waves.profile
            rippled |= waves.rippled
    if rippled.any():
        surface.rippled[part] = rippled
    return bool(rippled.any())


def _conserve(surface: Surface, pieces: list[Part], workers: Workers) -> None:
    """Give rippled floor in some pieces the level of flat floor, by the best-fitting power law."""

    def describe(part: Part) -> list[Bed]:
        wide, inner = surface.around(part, REACH)
        rippled = surface.rippled[wide] > 0
        return [
            bed_of(one.amplitude[wide], one.cotangent[wide], one.profile[wide], rippled).at(
                *blocks_in(inner)
            )
            for one in surface.looks
        ]

    lattice = [n // BLOCK for n in surface.shape]
    beds = [Bed.nowhere(*lattice) for _ in surface.looks]
    for part, found in zip(pieces, mapped(describe, pieces, workers), strict=True):
        for bed, values in zip(beds, found, strict=True):
            bed.put(*blocks_in(part), values)
    power = power_of(beds)
    if power == LAMBERT:
        return

    def change(part: Part) -> None:
        rippled = surface.rippled[part] > 0
        for look, bed in zip(surface.looks, beds, strict=True):
            values = on_pixels(bed.change[power][blocks_in(part)], rippled.shape)
            look.profile[part] = look.profile[part] - np.where(rippled, values, np.float32(0))

    deque(mapped(change, pieces, workers), 0)


def _block_of(window: int) -> int:
    """Block side of a raster that is written cell by cell: a divisor of the cell, if possible."""
    parts = (window // k for k in range(1, window // FEWEST + 1) if window % k == 0)
    return next((side for side in parts if side <= 2 * WHOLE), WHOLE)


def _known(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(amplitude > 0, amplitude, np.float32(np.nan))


def _pixels_of(place: tuple[int, int], window: int) -> Part:
    row, column = (v * window for v in place)
    return slice(row, row + window), slice(column, column + window)
