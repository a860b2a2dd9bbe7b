"""Fill that is not declared as nodata: large areas of exactly one value at a tile's edge."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import rasterio
import rasterio.windows
import scipy.ndimage
from numpy.typing import NDArray

from sasmap.survey.lattice import Window

# Pixels a side of the blocks that are of one value or not: narrow enough for a thin frame.
BLOCK = 4
# Pixels of each block that are compared: corners and two inside. Speckle makes all of them alike in
# one block of a million, and such blocks do not join.
PROBES = ((0, 0), (0, 3), (3, 0), (3, 3), (1, 2), (2, 1))
# Least area, pixels, and how far along the tile's edge it must reach, pixels or a fraction of the
# edge. A shadow of exactly zero that meets the edge reaches less: ripples that fit into a cell
# three and a half times have shadows of under 70 pixels in a cell of 500.
LEAST_AREA, LEAST_CONTACT, LEAST_FRACTION = 1024, 96, 0.125
# Values that are tried, those with most edge first.
MOST_VALUES = 4
# Bytes that are read at once.
READ_BYTES = 2**26


@dataclass(frozen=True)
class Fill:
    """Where a tile holds fill.

    Attributes
    ----------
    value : float
        As stored.
    rows, columns : int
        Blocks.
    packed : bytes
        A bit a block: fill, or beside fill.
    area : int
        Pixels, about.
    """

    value: float
    rows: int
    columns: int
    packed: bytes
    area: int

    def near(self, window: Window) -> NDArray[np.bool_]:
        """Pixels of a window that lie in blocks of fill or beside them."""
        bits = np.unpackbits(np.frombuffer(self.packed, np.uint8), count=self.rows * self.columns)
        blocks = bits.reshape(self.rows, self.columns).astype(bool)
        row = (window.row + np.arange(window.height)) // BLOCK
        column = (window.column + np.arange(window.width)) // BLOCK
        return np.asarray(blocks[np.ix_(row, column)])


def find_fill(source: rasterio.DatasetReader) -> tuple[Fill, ...]:
    """Find a tile's fill; blocks that cannot be decoded are none.

    Parameters
    ----------
    source : DatasetReader
        Its nodata value and masks are not fill: they are told already.

    Returns
    -------
    tuple of Fill
        One for each value.
    """
    if not _edge_alike(source):
        return ()
    value, alike = _block_map(source)
    found = []
    for candidate in _edge_values(value, alike):
        if candidate == source.nodata:
            continue
        area = _at_edge(alike & (value == candidate), (source.height, source.width))
        if area is not None:
            wide = scipy.ndimage.binary_dilation(area, np.ones((3, 3), bool))
            size = int(area.sum()) * BLOCK**2
            packed = np.packbits(wide).tobytes()
            found.append(Fill(candidate, area.shape[0], area.shape[1], packed, size))
    return tuple(found)


def _edge_alike(source: rasterio.DatasetReader) -> bool:
    """Whether there can be fill: a quick look at the edge of a file that lies in tiles.

    One that lies in strips has to be read whole for its sides.
    """
    if source.block_shapes[0][1] >= source.width:
        return True
    height, width = source.height, source.width
    bottom, right = ((n - 1) // BLOCK * BLOCK for n in (height, width))
    edges = ((0, 0, BLOCK, width), (bottom, 0, height - bottom, width),
             (0, 0, height, BLOCK), (0, right, height, width - right))  # fmt: skip
    count = 0
    for row, column, rows, columns in edges:
        try:
            _, alike = _read_alike(source, rasterio.windows.Window(column, row, columns, rows))
        except rasterio.errors.RasterioError:
            continue
        count += int(alike.sum())
    return bool(count * BLOCK >= min(LEAST_CONTACT, LEAST_FRACTION * min(height, width)))


def _block_map(source: rasterio.DatasetReader) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """First value of each block, and whether the block holds no other."""
    shape = -(-source.height // BLOCK), -(-source.width // BLOCK)
    value, alike = np.full(shape, np.nan), np.zeros(shape, bool)
    for top, height in _bands(source):
        window = rasterio.windows.Window(0, top, source.width, height)
        rows = slice(top // BLOCK, top // BLOCK + -(-height // BLOCK))
        try:
            value[rows], alike[rows] = _read_alike(source, window)
        except rasterio.errors.RasterioError:
            continue  # an undecodable block fails its cells, not the survey
    return value, alike


def _read_alike(
    source: rasterio.DatasetReader, window: rasterio.windows.Window
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Read a window; its blocks' first values, and whether they hold no other."""
    # all_valid is told by every file without a mask, and nodata is compared by value
    flags = source.mask_flag_enums[0]
    masked = not {rasterio.enums.MaskFlags.all_valid, rasterio.enums.MaskFlags.nodata} & set(flags)
    raw = source.read(1, window=window)
    return _alike(raw, source.read_masks(1, window=window) if masked else None)


def _bands(source: rasterio.DatasetReader) -> Iterator[tuple[int, int]]:
    item = np.dtype(source.dtypes[0]).itemsize
    block = source.block_shapes[0][0]
    step = max(READ_BYTES // (source.width * item), 1)
    step = max(step // block, 1) * block  # whole blocks: none is decoded twice
    step = -(-step // BLOCK) * BLOCK
    for top in range(0, source.height, step):
        yield top, min(step, source.height - top)


def _alike(
    raw: NDArray[np.generic], mask: NDArray[np.uint8] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    rows, columns = (np.arange(0, n, BLOCK) for n in raw.shape)

    def probe(values: NDArray[np.generic], i: int, j: int) -> NDArray[np.generic]:
        at = np.minimum(rows + i, raw.shape[0] - 1), np.minimum(columns + j, raw.shape[1] - 1)
        return np.asarray(values[np.ix_(*at)])

    first = probe(raw, 0, 0)
    alike = np.ones(first.shape, bool)
    for i, j in PROBES:
        alike &= probe(raw, i, j) == first
        if mask is not None:
            alike &= probe(mask, i, j) != 0
    with np.errstate(invalid="ignore"):  # a broken file's NaN can be one that signals
        return first.astype(float), alike


def _edge_values(value: NDArray[np.float64], alike: NDArray[np.bool_]) -> list[float]:
    """Values of the alike blocks along the edge, the most frequent first."""
    edges = ((value[0], alike[0]), (value[-1], alike[-1]), (value[:, 0], alike[:, 0]),
             (value[:, -1], alike[:, -1]))  # fmt: skip
    along = np.concatenate([values[same] for values, same in edges])
    values, counts = np.unique(along, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:MOST_VALUES]
    return [float(values[k]) for k in order if counts[k] > 1]


def _at_edge(blocks: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Blocks of the areas that are large and reach far along the edge; None without one."""
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
