"""What a survey's looks show of the floor, laid on its own pixels on disk, its ripples taken off.

The map is made from this surface in blocks of its own: it does not know the cells that ripples are
estimated in.
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

FloatArray = NDArray[np.float64]
Read = Callable[[int, int, int], tuple[FloatArray, FloatArray, FloatArray] | None]
Part = tuple[slice, slice]

# Pixels a side of the pieces in which ripples and objects are looked for.
PIECE = 8 * LATTICE
# Pixels a side of the blocks that rasters are stored in, and the least where these fit cells: rows
# of a part of a block are written one by one, which took a twentieth of the stage.
WHOLE, FEWEST = 256, 128
# Share of a class's training that may lie on objects, if these are to be no sediment.
TAUGHT = 0.05


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
        ``read(row, column, look)`` gives amplitude, cotangent of the grazing angle and altitude
        (window, window each), or None. A fault is that of the cell alone.
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
    """What could not be read, and why."""

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
        Of the grazing angle; m.
    profile : Canvas
        Log of what ripples do to the amplitude.
    hidden : Canvas
        1 for objects, 2 for their shadow.
    """

    amplitude: Any
    cotangent: Any
    altitude: Any
    profile: Any
    hidden: Any


class Slices:
    """A look's amplitude, ripples taken off: slices are read."""

    def __init__(self, look: Look) -> None:
        self._look = look
        self.shape: tuple[int, int] = look.amplitude.shape

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        """Read a slice; NaN where there is no amplitude."""
        amplitude = _known(self._look.amplitude[part])
        profile = self._look.profile[part]
        if profile.view(np.uint16).any():  # as whole numbers, which are looked at much faster
            amplitude *= np.exp(-profile.astype(np.float32))
        return amplitude


class Surface(NamedTuple):
    """All looks at a survey; slices are read.

    Attributes
    ----------
    shape : tuple of int
    looks : tuple of Look
    rippled : Canvas of uint8
        1 where a look shows ripples.
    objects : Canvas of uint8
        1 where a look shows an object that is no sediment.
    marks : Canvas of uint8 or None
        Classes that training shows.
    faults : list of Fault
        What could not be read.
    apart : bool
        Whether objects were taken out.
    """

    shape: tuple[int, int]
    looks: tuple[Look, ...]
    rippled: Any
    objects: Any
    marks: Any
    faults: list[Fault]
    apart: bool = False

    def part(self, part: Part, ranged: bool) -> list[AmplitudeGrid]:
        """Amplitudes of all looks, ripples taken off; NaN where there is none.

        Altitudes are read where gain goes by range.
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
        """All looks, to be read by slices."""
        return [AmplitudeGrid(Slices(k), k.cotangent, k.altitude) for k in self.looks]

    def shown(self, workers: Workers) -> bool:
        """Whether a look shows a pixel of the floor."""

        def one(part: Part) -> bool:
            return any(bool((look.amplitude[part] > 0).any()) for look in self.looks)

        return any(mapped(one, self.blocks(2 * PIECE), workers))

    @property
    def whole(self) -> Part:
        """All of the map."""
        return slice(0, self.shape[0]), slice(0, self.shape[1])

    def blocks(self, side: int) -> list[Part]:
        """Blocks of so many pixels a side, row by row."""
        rows, columns = self.shape
        return [
            (slice(r, min(r + side, rows)), slice(c, min(c + side, columns)))
            for r, c in product(range(0, rows, side), range(0, columns, side))
        ]

    def around(self, part: Part, margin: int) -> tuple[Part, Part]:
        """Widen a part by a margin, as far as the map goes; and the part's place in that."""
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
    """Lay a survey's looks on disk and take their ripples, and objects, off.

    Parameters
    ----------
    ground : Ground
    known : ClassModel or None
        Whose marks are laid as well.
    workers : int, None or callable
        Threads, or what spreads work.
    scratch : Path
        Folder of the rasters.
    stack : ExitStack
        Closes them.
    progress : callable, optional
        Called with the number of cells that have been read and of all.
    objects : bool
        Whether objects are looked for.

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
    """Find objects and take them and their shadow out of the looks; say whether that was done."""
    pieces = surface.blocks(PIECE)
    shown = list(mapped(lambda p: _find_objects(surface, p), pieces, workers))
    total = np.sum([marked for _, marked in shown], axis=0)
    taught = total[0, 1:] > 0
    if (total[1, 1:][taught] > TAUGHT * total[0, 1:][taught]).any():
        return False  # a class that is made of such things was shown: they are sediment here
    # only now: pieces look at what lies around them
    there = [piece for piece, (found, _) in zip(pieces, shown, strict=True) if found]
    deque(mapped(lambda p: _hide(surface, p), there, workers), 0)
    return True


def _find_objects(surface: Surface, part: Part) -> tuple[bool, NDArray[np.int64]]:
    """Mark objects and shadow of each look in a piece.

    Returns whether there are any, and how many pixels of each class that training shows lie in the
    piece and on objects (2, 256).
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
    """Take what is no floor out of a piece of the looks; mark things on the map."""
    things = np.zeros([s.stop - s.start for s in part], bool)
    for look in surface.looks:
        hidden = look.hidden[part]
        things |= hidden == 1
        if hidden.any():
            look.amplitude[part] = np.where(hidden > 0, np.float32(0), look.amplitude[part])
    for look in surface.looks:  # what stands on the floor hides it from all sides
        if things.any():
            look.amplitude[part] = np.where(things, np.float32(0), look.amplitude[part])
    surface.objects[part] = things


def _take_off(surface: Surface, part: Part) -> bool:
    """Find ripples in a piece of each look; say whether there are any."""
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
    """Give rippled floor in some pieces the level that it has flat, by the law that suits all."""

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
    """Blocks of a raster that is written cell by cell: whole ones in a cell, if that can be."""
    parts = (window // k for k in range(1, window // FEWEST + 1) if window % k == 0)
    return next((side for side in parts if side <= 2 * WHOLE), WHOLE)


def _known(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(amplitude > 0, amplitude, np.float32(np.nan))


def _pixels_of(place: tuple[int, int], window: int) -> Part:
    row, column = (v * window for v in place)
    return slice(row, row + window), slice(column, column + window)
