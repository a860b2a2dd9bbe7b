"""mosaic.tif: the amplitude of all passes on the survey's pixel grid.

The first pass of the survey file lies on top. Gains are matched in cells that two passes show; the
first pass of each group connected in this way keeps its units.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.catalogue import BY_FILE
from sasmap.io.canvas import Canvas
from sasmap.io.files import write_text
from sasmap.io.rasters import float_layer, write_large_cog
from sasmap.numerics.threads import mapped
from sasmap.ripples.clip import Clip
from sasmap.run.plan import Plan, tags_of
from sasmap.run.store import Store, code_version, digest
from sasmap.run.task import clip_of, excluded_hash, track_hash
from sasmap.survey.cells import Cell
from sasmap.survey.placement import on_cell
from sasmap.survey.tiles import hash_file

Read = Callable[[Cell, int], NDArray[np.float32] | None]

FILE = "mosaic.tif"
RECORD = "mosaic.json"
# Maximum number of cells in which gains of passes are compared, and minimum number of pixels that
# both must show. 400 independent pixels of speckle give a gain to 0.3 dB; the median over cells is
# better.
COMPARED, LEAST = 48, 400


class GainRatio(NamedTuple):
    """Ratio of the gains of two swaths.

    Attributes
    ----------
    first, second : int
        Swaths.
    log_gain : float
        Log of the ratio of the second swath's amplitude to the first's.
    weight : float
        Number of cells.
    """

    first: int
    second: int
    log_gain: float
    weight: float


def write_mosaic(plan: Plan, store: Store, workers: int | None) -> list[Path]:
    """Write mosaic.tif, or keep that of an earlier run with the same pixels.

    Parameters
    ----------
    plan : Plan
    store : Store
    workers : int or None
        Threads; None for one per core.

    Returns
    -------
    list of Path
    """
    path, record = store.output / FILE, store.folder / RECORD
    key = _key(plan)
    if _kept(path, record, key):
        return [path]
    grid, window = plan.opened.grid, plan.settings.window
    shape = grid.rows * window, grid.columns * window
    read = _reader(plan)
    gains = swath_gains(plan.cells, len(plan.swaths), read, workers)
    scale = np.exp(-gains)
    with Canvas(store.scratch / "mosaic.part", shape, "float32", window) as canvas:

        def lay(cell: Cell) -> None:
            rows = slice(cell.row * window, (cell.row + 1) * window)
            columns = slice(cell.column * window, (cell.column + 1) * window)
            canvas[rows, columns] = _laid(plan, cell, read, scale)

        deque(mapped(lay, grid, workers), 0)
        product = BY_FILE[FILE]
        texts, units = [b.text for b in product.bands], [b.unit for b in product.bands]
        layer = float_layer(texts, units, tags_of(plan))
        write_large_cog(path, canvas, layer, grid.pixels(window), grid.crs, store.scratch)
    content = {"key": key, "hash": hash_file(path)}
    write_text(record, json.dumps(content), store.scratch)
    return [path]


def _reader(plan: Plan) -> Read:
    place = plan.opened.grid, plan.settings.window

    def read(cell: Cell, k: int) -> NDArray[np.float32] | None:
        """Amplitude of a swath on a cell's own pixels; None where there is none."""
        swath = plan.swaths[k]
        try:
            array = clip_of(plan, cell, swath, swath.side)
        except OSError:
            return None  # a block that cannot be decoded: the stages report it
        if array is None:
            return None
        clip = Clip.from_array(array)
        known = np.where(clip.valid, clip.amplitude, np.nan)
        return on_cell(clip, known, place[0], cell, place[1])

    return read


def _laid(plan: Plan, cell: Cell, read: Read, scale: FloatArray) -> NDArray[np.float32]:
    window = plan.settings.window
    result = np.full((window, window), np.nan, np.float32)
    for k in plan.cells.get(cell, ()):
        missing = np.isnan(result)
        if not missing.any():
            break
        shown = read(cell, k)
        if shown is not None:
            result[missing] = shown[missing] * np.float32(scale[k])
    return result


def swath_gains(
    cells: dict[Cell, tuple[int, ...]], count: int, read: Read, workers: int | None
) -> FloatArray:
    """Log gain of each swath, relative to the first swath of its connected group.

    Parameters
    ----------
    cells : dict of Cell to tuple of int
        The swaths that may show each cell.
    count : int
        Number of swaths.
    read : callable
        ``read(cell, swath)`` gives amplitudes (window, window), NaN where there is none, or None.
    workers : int or None

    Returns
    -------
    ndarray (count,)
        Log of linear amplitude.
    """
    shared = [cell for cell, swaths in cells.items() if len(swaths) > 1]
    step = max(1, -(-len(shared) // COMPARED))
    some = shared[::step]

    def compare(cell: Cell) -> list[tuple[int, int, float]]:
        shown = {k: v for k in cells[cell] if (v := read(cell, k)) is not None}
        pairs = combinations(shown, 2)
        ratios = ((a, b, _log_ratio(shown[a], shown[b])) for a, b in pairs)
        return [(a, b, ratio) for a, b, ratio in ratios if np.isfinite(ratio)]

    found: dict[tuple[int, int], list[float]] = {}
    for one in mapped(compare, some, workers):
        for a, b, ratio in one:
            found.setdefault((a, b), []).append(ratio)
    ratios = [GainRatio(a, b, float(np.median(v)), float(len(v))) for (a, b), v in found.items()]
    return solve_gains(ratios, count)


def _log_ratio(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Log ratio of the second's root mean square amplitude to the first's, where both show floor.

    NaN where they do not overlap: the two sides of a line show different floor.
    """
    common = np.isfinite(first) & np.isfinite(second)
    if common.sum() < LEAST:
        return float("nan")
    power = [float(np.mean(v[common].astype(float) ** 2)) for v in (first, second)]
    return 0.5 * float(np.log(power[1] / power[0])) if min(power) > 0 else float("nan")


def solve_gains(ratios: Sequence[GainRatio], count: int) -> FloatArray:
    """Estimate gains from the ratios of pairs by weighted least squares.

    Parameters
    ----------
    ratios : sequence of GainRatio
    count : int
        Number of swaths.

    Returns
    -------
    ndarray (count,)
        Log gains; 0 for the first swath of each connected group.
    """
    root = list(range(count))
    for r in ratios:  # connected groups, by their first member
        a, b = root[r.first], root[r.second]
        root = [min(a, b) if k in (a, b) else k for k in root]
    rows = [np.zeros(count) for _ in ratios]
    for row, r in zip(rows, ratios, strict=True):
        row[r.second], row[r.first] = 1.0, -1.0
    weight = np.sqrt([r.weight for r in ratios])
    anchors = [np.eye(count)[k] for k in sorted(set(root))]
    values = np.array([r.log_gain for r in ratios])
    design = np.array([*(w * row for w, row in zip(weight, rows, strict=True)), *anchors])
    right = np.concatenate([weight * values, np.zeros(len(anchors))])
    return np.asarray(np.linalg.lstsq(design, right, rcond=None)[0])


def _key(plan: Plan) -> str:
    grid = plan.opened.grid
    swaths: list[Any] = [
        [
            s.label,
            s.side,
            s.sonar_pass.slant,
            track_hash(s.sonar_pass.track),
            [[plan.hashes[tile.path], tile.kind] for tile in s.sonar_pass.tiles],
        ]
        for s in plan.swaths
    ]
    place = [grid.crs, repr(grid.left), repr(grid.top), repr(grid.size), plan.settings.window]
    shown = [sorted(list(cell) for cell in plan.cells), excluded_hash(plan, None)]
    return digest([code_version(), swaths, place, shown, tags_of(plan)])


def _kept(path: Path, record: Path, key: str) -> bool:
    try:
        content = json.loads(record.read_text(encoding="utf-8"))
        return bool(content["key"] == key and content["hash"] == hash_file(path))
    except (OSError, ValueError, KeyError, TypeError):
        return False
