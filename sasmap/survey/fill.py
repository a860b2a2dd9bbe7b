"""Undeclared fill: large areas at a tile's edge, of one value or nearly black.

Areas of exactly one value are fill. Nearly black ones, which JPEG or resampling make of fill, can
also be shadow or water, whose noise has the skewness of speckle (0.63): they are reported only
where their values are distributed differently.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import rasterio
import rasterio.windows
import scipy.ndimage
from numpy.typing import NDArray

from sasmap.arrays import BoolArray, FloatArray
from sasmap.survey.lattice import Window

# Side in pixels of the blocks that are tested for one value: small enough for a thin frame.
BLOCK = 4
# Pixels of each block that are compared: corners and two inside. In speckle all of them are equal
# in one block of a million, and such blocks are not adjacent.
PROBES = ((0, 0), (0, 3), (3, 0), (3, 3), (1, 2), (2, 1))
# Minimum area, pixels, and minimum contact with the tile's edge, pixels or a fraction of the edge.
# A shadow of exactly zero that meets the edge is smaller: ripples of which three and a half
# wavelengths fit into a cell of 500 pixels have shadows of under 70 pixels.
LEAST_AREA, LEAST_CONTACT, LEAST_FRACTION = 1024, 96, 0.125
# Maximum number of values tried, those most frequent along the edge first: tiles have one or two
# fill values.
MOST_VALUES = 4
# Nearly black: all probes of a block are below this share of the usual largest one. In speckle this
# happens in one block of ten million.
BLACK = 0.2
# Windows along each side of the tile, and their side in pixels, from which the usual largest probe
# is estimated.
WINDOWS, SIDE = 3, 64
# Skewness of the noise in shadow and water: Rayleigh's 0.63, rounded to whole grey levels.
NOISE_SKEWNESS = (0.3, 0.9)
# Minimum ratio of the depth of fill at the edge to the width of shadows within the tile, and the
# quantile of that width over blocks.
DEEPER, WIDEST = 1.5, 0.9
# Depth, in blocks from the edge, over which the distribution of values is computed.
RIM = 8
# Bytes read at once: bounds memory.
READ_BYTES = 2**26


@dataclass(frozen=True)
class Fill:
    """Fill of one value in a tile.

    Attributes
    ----------
    value : float
        As stored.
    rows, columns : int
        Number of blocks.
    packed : bytes
        One bit per block: fill, or adjacent to fill.
    area : int
        Approximate number of pixels.
    """

    value: float
    rows: int
    columns: int
    packed: bytes
    area: int

    def near(self, window: Window) -> BoolArray:
        """Pixels of a window that lie in blocks of fill or beside them."""
        bits = np.unpackbits(np.frombuffer(self.packed, np.uint8), count=self.rows * self.columns)
        blocks = bits.reshape(self.rows, self.columns).astype(bool)
        row = (window.row + np.arange(window.height)) // BLOCK
        column = (window.column + np.arange(window.width)) // BLOCK
        return np.asarray(blocks[np.ix_(row, column)])


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Probes of a tile's blocks; each (rows, columns)."""

    value: FloatArray  # the first probe's
    alike: BoolArray  # whether all are equal to it
    top: NDArray[np.float32]  # the largest valid one; NaN where none is valid


def find_fill(
    source: rasterio.DatasetReader, kind: Literal["linear", "intensity", "db"]
) -> tuple[tuple[Fill, ...], str]:
    """Find a tile's fill; undecodable blocks do not count.

    Parameters
    ----------
    source : DatasetReader
        Its nodata value and masks are not fill: they are declared.
    kind : {"linear", "intensity", "db"}
        Kind of its values; the level of black is unknown for decibels.

    Returns
    -------
    fill : tuple of Fill
        One for each value.
    border : str
        Description of a nearly black edge that looks like fill; empty without one.
    """
    limit = _black(source, kind)
    if not _edge_odd(source, limit):
        return (), ""
    blocks = _block_map(source)
    found, known = [], np.zeros(blocks.alike.shape, bool)
    shape = source.height, source.width
    for candidate in _edge_values(blocks.value, blocks.alike):
        if candidate == source.nodata:
            continue
        area = _at_edge(blocks.alike & (blocks.value == candidate), shape)
        if area is not None and _rim(area, blocks.alike & (blocks.value == candidate), shape).any():
            known |= area
            wide = scipy.ndimage.binary_dilation(area, np.ones((3, 3), bool))
            size = int(area.sum()) * BLOCK**2
            packed = np.packbits(wide).tobytes()
            found.append(Fill(candidate, area.shape[0], area.shape[1], packed, size))
    return tuple(found), _black_border(blocks, known, limit, shape)


def _black(source: rasterio.DatasetReader, kind: str) -> float:
    """Largest value that is nearly black; below all values where that is unknown."""
    if kind == "db":
        return -np.inf
    tops = []
    for k in range(WINDOWS**2):
        row, column = (
            (2 * i + 1) * max(n - SIDE, 0) // (2 * WINDOWS)
            for i, n in zip(divmod(k, WINDOWS), (source.height, source.width), strict=True)
        )
        window = rasterio.windows.Window(
            column, row, min(SIDE, source.width), min(SIDE, source.height)
        )
        try:
            tops.append(_read_blocks(source, window).top.ravel())
        except rasterio.errors.RasterioError:
            continue
    known = np.concatenate(tops) if tops else np.empty(0)
    known = known[np.isfinite(known)]
    share = BLACK if kind == "linear" else BLACK**2
    return share * float(np.quantile(known, 0.75)) if known.size else -np.inf


def _black_border(blocks: _Blocks, known: BoolArray, limit: float, shape: tuple[int, int]) -> str:
    """Describe the share of a tile that is nearly black at its edge, not shadow or water."""
    dark = (blocks.top >= 0) & (blocks.top <= limit) & ~known
    area = _at_edge(dark, shape)
    if area is None or not (rim := _rim(area, dark, shape)).any():
        return ""
    values = blocks.value[rim]
    values = values[(values >= 0) & (values <= limit)]  # a block's first probe may be nodata
    if values.size < RIM:
        return ""
    mean, spread = float(values.mean()), float(values.std())
    skewness = float((((values - mean) / spread) ** 3).mean()) if spread > 0 else 0.0
    if NOISE_SKEWNESS[0] < skewness < NOISE_SKEWNESS[1]:
        return ""
    share = float(area.mean())
    return f"{share:.0%} of it, at its edge, is nearly black, {values.min():g} to {values.max():g}"


def _rim(area: BoolArray, dark: BoolArray, shape: tuple[int, int]) -> BoolArray:
    """Blocks of an area along the tile's edge, where it is deeper than shadows.

    Shadows that cross the edge meet it over a short length each; a shadow along the edge is no
    deeper than those within the tile are wide.
    """
    rim = np.zeros_like(area)
    for turn, length in ((0, shape[1]), (1, shape[0]), (2, shape[1]), (3, shape[0])):
        turned, target = np.rot90(area, turn), np.rot90(rim, turn)  # views: the top row is an edge
        depth = np.where(turned.all(axis=0), turned.shape[0], turned.argmin(axis=0))
        least = DEEPER * _usual_width(np.rot90(dark, turn))
        ends = np.flatnonzero(np.diff(turned[0].astype(int), prepend=0, append=0))
        for first, last in ends.reshape(-1, 2):
            far = (last - first) * BLOCK >= min(LEAST_CONTACT, LEAST_FRACTION * length)
            if far and np.median(depth[first:last]) > least:
                target[:RIM, first:last] |= turned[:RIM, first:last]
    return rim


def _usual_width(dark: BoolArray) -> float:
    """Usual length of runs of dark blocks down the columns, among runs inside the tile."""
    # a bright row between columns separates their runs
    column = np.zeros((dark.shape[1], dark.shape[0] + 1), np.int8)
    column[:, :-1] = dark.T
    first, last = np.flatnonzero(np.diff(column.ravel(), prepend=0, append=0)).reshape(-1, 2).T
    inside = (first % (dark.shape[0] + 1) > 0) & (last % (dark.shape[0] + 1) < dark.shape[0])
    runs = np.sort((last - first)[inside])
    if not runs.size:
        return 0.0
    # weighted by blocks: single dark blocks are frequent, but not shadow
    return float(runs[np.searchsorted(np.cumsum(runs), WIDEST * runs.sum())])


def _edge_odd(source: rasterio.DatasetReader, limit: float) -> bool:
    """Whether there can be fill: a quick check of the edge of a tiled file.

    A file in strips would have to be read completely for its sides.
    """
    if source.block_shapes[0][1] >= source.width:
        return True
    height, width = source.height, source.width
    bottom, right = ((n - 1) // BLOCK * BLOCK for n in (height, width))
    edges = ((0, 0, BLOCK, width), (bottom, 0, height - bottom, width),
             (0, 0, height, BLOCK), (0, right, height, width - right))  # fmt: skip
    count, least = 0, min(LEAST_CONTACT, LEAST_FRACTION * min(height, width)) / BLOCK
    for row, column, rows, columns in edges:
        try:
            blocks = _read_blocks(source, rasterio.windows.Window(column, row, columns, rows))
        except rasterio.errors.RasterioError:
            continue
        count += int(blocks.alike.sum())
        dark = np.flatnonzero(
            np.diff((blocks.top.ravel() <= limit).astype(int), prepend=0, append=0)
        )
        if dark.size and np.diff(dark)[::2].max() >= least:
            return True
    return bool(count >= least)


def _block_map(source: rasterio.DatasetReader) -> _Blocks:
    """Probe every block of a tile."""
    shape = -(-source.height // BLOCK), -(-source.width // BLOCK)
    whole = _Blocks(np.full(shape, np.nan), np.zeros(shape, bool), np.full(shape, np.nan, "f4"))
    for top, height in _bands(source):
        window = rasterio.windows.Window(0, top, source.width, height)
        rows = slice(top // BLOCK, top // BLOCK + -(-height // BLOCK))
        try:
            part = _read_blocks(source, window)
        except rasterio.errors.RasterioError:
            continue  # an undecodable block fails its cells, not the survey
        whole.value[rows], whole.alike[rows], whole.top[rows] = part.value, part.alike, part.top
    return whole


def _read_blocks(source: rasterio.DatasetReader, window: rasterio.windows.Window) -> _Blocks:
    """Read a window and probe its blocks."""
    # every file without a mask has all_valid, and nodata is compared by value
    flags = source.mask_flag_enums[0]
    masked = not {rasterio.enums.MaskFlags.all_valid, rasterio.enums.MaskFlags.nodata} & set(flags)
    raw = source.read(1, window=window)
    mask = source.read_masks(1, window=window) if masked else None
    return _probed(raw, mask, source.nodata)


def _bands(source: rasterio.DatasetReader) -> Iterator[tuple[int, int]]:
    item = np.dtype(source.dtypes[0]).itemsize
    block = source.block_shapes[0][0]
    step = max(READ_BYTES // (source.width * item), 1)
    step = max(step // block, 1) * block  # whole blocks: none is decoded twice
    step = -(-step // BLOCK) * BLOCK
    for top in range(0, source.height, step):
        yield top, min(step, source.height - top)


def _probed(
    raw: NDArray[np.generic], mask: NDArray[np.uint8] | None, nodata: float | None
) -> _Blocks:
    rows, columns = (np.arange(0, n, BLOCK) for n in raw.shape)

    def probe(values: NDArray[np.generic], i: int, j: int) -> NDArray[np.generic]:
        at = np.minimum(rows + i, raw.shape[0] - 1), np.minimum(columns + j, raw.shape[1] - 1)
        return np.asarray(values[np.ix_(*at)])

    first = probe(raw, 0, 0)
    alike = np.ones(first.shape, bool)
    top = np.full(first.shape, np.nan, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # a broken file's NaN can signal
        for i, j in PROBES:
            value = probe(raw, i, j)
            alike &= value == first
            there = value != nodata if nodata is not None else np.ones(first.shape, bool)
            if mask is not None:
                valid = probe(mask, i, j) != 0
                alike &= valid
                there &= valid
            np.fmax(top, value.astype(np.float32), out=top, where=there)
        return _Blocks(first.astype(float), alike, top)


def _edge_values(value: FloatArray, alike: BoolArray) -> list[float]:
    """Values of the uniform blocks along the edge, the most frequent first."""
    edges = ((value[0], alike[0]), (value[-1], alike[-1]), (value[:, 0], alike[:, 0]),
             (value[:, -1], alike[:, -1]))  # fmt: skip
    along = np.concatenate([values[same] for values, same in edges])
    values, counts = np.unique(along, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:MOST_VALUES]
    return [float(values[k]) for k in order if counts[k] > 1]


def _at_edge(blocks: BoolArray, shape: tuple[int, int]) -> BoolArray | None:
    """Blocks of areas that are large and extend far along the edge; None without one."""
    label, count = scipy.ndimage.label(blocks)
    if not count:
        return None
    size = np.bincount(label.ravel(), minlength=count + 1)
    contact = np.zeros(count + 1)
    for edge, length in (
        (label[0], shape[1]), (label[-1], shape[1]), (label[:, 0], shape[0]),
        (label[:, -1], shape[0]),
    ):  # fmt: skip
        needed = min(LEAST_CONTACT, LEAST_FRACTION * length) / BLOCK
        reach = np.bincount(edge, minlength=count + 1) / max(needed, 1.0)
        contact = np.maximum(contact, reach)
    large = (size * BLOCK**2 >= LEAST_AREA) & (contact >= 1)
    large[0] = False
    return np.asarray(large[label]) if large.any() else None
