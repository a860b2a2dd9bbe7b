"""Amplitude GeoTIFFs: checked before use, opened safely, read by windows."""

from __future__ import annotations

import fnmatch
import glob
import hashlib
import logging
import os
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyproj
import rasterio
import rasterio.windows
import tifffile
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError  # GDAL's errors, which rasterio lets through in places

from sasmap.arrays import FloatArray
from sasmap.errors import InputError
from sasmap.settings.survey import expanded
from sasmap.survey.amplitude import Kind, to_linear
from sasmap.survey.bands import check_bands
from sasmap.survey.fill import Fill
from sasmap.survey.georeference import checked_crs
from sasmap.survey.lattice import Lattice, Window, bounding_window, outline, transform_points

# Exceptions of tifffile where a file's structure is broken.
TIFF_FAULTS = (tifffile.TiffFileError, struct.error, ValueError, IndexError, KeyError, TypeError,
               ZeroDivisionError, AttributeError)  # fmt: skip
TIFF_ENDINGS = (".tif", ".tiff")
# TIFF's PlanarConfiguration for separate bands.
SEPARATE = 2

Amplitude = NDArray[np.float32] | FloatArray

# Sidecar files (overviews, auxiliary XML) are never read: a hostile one can make GDAL access the
# network.
GDAL_OPTIONS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_HTTP_TIMEOUT": "1",
    "GDAL_PAM_ENABLED": "NO",
}
# A tile without georeference is refused with a message of our own.
warnings.filterwarnings("ignore", category=rasterio.errors.NotGeoreferencedWarning)
# Largest block that is decoded, bytes: each worker holds one, so this bounds memory.
MAX_BLOCK_BYTES = 2**29
# Largest plausible ratio of the pixels' bytes to the file size: deflate compresses at most 1032:1.
MAX_EXPANSION = 2000.0


@dataclass(frozen=True)
class Tile:
    """A checked amplitude GeoTIFF.

    Attributes
    ----------
    path : Path
    lattice : Lattice
        CRS and affine; pixel-is-point files are already shifted to pixel-is-area.
    window : Window
        All of the tile's pixels.
    dtype : str
        Type of the stored pixels.
    kind : {"linear", "intensity", "db"}
        Kind of the pixel values.
    fill : tuple of Fill
        Undeclared fill.
    """

    path: Path
    lattice: Lattice
    window: Window
    dtype: str
    kind: Kind = "linear"
    fill: tuple[Fill, ...] = ()

    @property
    def geographic(self) -> bool:
        """Whether the lattice is in degrees: its pixels are not square on the ground."""
        return _metres(self.lattice.crs) is None

    @property
    def pixel_size(self) -> float:
        """Side in metres of the square with a pixel's area; in degrees, of the pixel's longer side.

        With the longer side no pixel appears twice after nearest-neighbour resampling.
        """
        unit = _metres(self.lattice.crs)
        if unit is None:
            return _longer_side(self)
        return float(abs(self.lattice.transform.determinant) ** 0.5 * unit)

    def outline_in(self, crs: str) -> tuple[FloatArray, FloatArray]:
        """Return points of the tile's edge in another CRS."""
        return _outline_in(self, crs)


@lru_cache(maxsize=1000)
def _metres(crs: str) -> float | None:
    """Length of a CRS's unit in metres; None where it is geographic."""
    parsed = pyproj.CRS.from_wkt(crs)
    return None if parsed.is_geographic else float(parsed.axis_info[0].unit_conversion_factor)


def _longer_side(tile: Tile) -> float:
    """Longer side of a geographic tile's middle pixel, m."""
    t, crs = tile.lattice.transform, pyproj.CRS.from_wkt(tile.lattice.crs)
    row, column = tile.window.height / 2, tile.window.width / 2
    corners = [t @ (column + i, row + j) for i, j in ((0, 0), (1, 0), (0, 1))]
    (x0, y0), (x1, y1), (x2, y2) = corners
    geod = crs.get_geod() or pyproj.Geod(ellps="WGS84")
    _, _, sides = geod.inv([x0, x0], [y0, y0], [x1, x2], [y1, y2])
    return float(max(sides))


@lru_cache(maxsize=100_000)
def _outline_in(tile: Tile, crs: str) -> tuple[FloatArray, FloatArray]:
    x, y = outline(tile.window, tile.lattice)
    return transform_points(tile.lattice.crs, crs, x, y)


@contextmanager
def open_geotiff(path: Path, **options: str) -> Iterator[rasterio.DatasetReader]:
    """Open a GeoTIFF without its sidecar files.

    Parameters
    ----------
    path : Path
    **options : str
        Further options of GDAL.

    Raises
    ------
    rasterio.errors.RasterioIOError
        Where it cannot be opened.
    """
    with rasterio.Env(**GDAL_OPTIONS, **options), rasterio.open(path, driver="GTiff") as source:
        yield source


def inspect_tile(path: Path, kind: Kind = "linear", geographic: bool = False) -> Tile:
    """Open a tile's header and check that the tile can be used.

    Parameters
    ----------
    path : Path
        A regular local file.
    kind : {"linear", "intensity", "db"}
        Kind of its pixel values.
    geographic : bool
        Whether a geographic CRS is accepted.

    Returns
    -------
    Tile

    Raises
    ------
    InputError
        Where the file is missing, not a GeoTIFF, truncated, not a single real-valued band, or
        has no usable georeference.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"{path}: expected a file name in UTF-8") from None
    if not path.is_file():
        raise InputError(_no_file(path))
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: no permission to read it")
    try:
        with open_geotiff(path) as source:
            check_bands(path, source)
            crs = checked_crs(path, source, geographic)
            _check_blocks(path, source)
            return Tile(
                path=path,
                lattice=Lattice(crs, source.transform),
                window=Window(0, 0, source.height, source.width),
                dtype=source.dtypes[0],
                kind=kind,
            )
    except (rasterio.errors.RasterioIOError, CPLE_BaseError):
        raise InputError(f"{path}: not a GeoTIFF that can be opened{_made_of(path)}") from None


def _no_file(path: Path) -> str:
    if path.is_dir():
        inside = sorted({f.suffix for f in path.iterdir() if f.suffix.lower() in TIFF_ENDINGS})
        return f"{path}: a folder: expected files, such as {path.name}/*{(inside or ['.tif'])[0]}"
    return f"{path}: no such file" if not path.exists() else f"{path}: not a file"


def _made_of(path: Path) -> str:
    """Describe how to convert a file of another format to GeoTIFF."""
    if path.suffix.lower() == ".xtf":
        return f": a raw recording: sasmap tiles {path.name} --output DIR"
    if path.suffix.lower() not in TIFF_ENDINGS:
        return f": convert it: gdal_translate {path.name} {path.stem}.tif"
    return ""


def _check_blocks(path: Path, source: rasterio.DatasetReader) -> None:
    """Compare block offsets with the file's size: a truncated TIFF opens without complaint."""
    size = path.stat().st_size
    height, width = source.block_shapes[0]
    item = np.dtype(source.dtypes[0]).itemsize
    if height * width * item > MAX_BLOCK_BYTES:
        raise InputError(
            f"{path}: blocks of {height} x {width} pixels are too large to read; write it in tiles"
        )
    total = source.height * source.width * item
    if total > 2**32 and total > MAX_EXPANSION * size:
        raise InputError(f"{path}: {size} bytes claim to hold {total}: refused as implausible")
    _check_directories(path, size, source.count)


def _blocks_of(page: tifffile.TiffPage, bands: int) -> int:
    """Count the blocks that an image's size requires, in the file's own strips or tiles.

    GDAL itself splits a single large strip into virtual ones.
    """
    if page.is_tiled:
        blocks = -(-page.imagelength // page.tilelength) * -(-page.imagewidth // page.tilewidth)
    else:
        blocks = -(-page.imagelength // min(max(page.rowsperstrip, 1), page.imagelength))
    return int(blocks * (bands if page.planarconfig == SEPARATE else 1))


def _check_directories(path: Path, size: int, bands: int) -> None:
    """Check the blocks of every image in the file: pixels, overviews, masks."""
    doubts = _Doubts()
    logger = logging.getLogger("tifffile")
    handlers, propagate = logger.handlers, logger.propagate
    logger.handlers, logger.propagate = [doubts], False  # a broken chain is only logged
    try:
        with tifffile.TiffFile(path) as file:
            pages = list(file.pages)
            blocks = _blocks_of(pages[0], bands)
    except TIFF_FAULTS as error:
        raise InputError(f"{path}: truncated or corrupt: {' '.join(str(error).split())}") from None
    finally:
        logger.handlers, logger.propagate = handlers, propagate
    if doubts.lines:
        raise InputError(f"{path}: truncated: its list of images points past the end of the file")
    for k, page in enumerate(pages):
        offsets, lengths = np.array(page.dataoffsets), np.array(page.databytecounts)
        if offsets.size != lengths.size:
            raise InputError(f"{path}: corrupt: {offsets.size} blocks of {lengths.size} lengths")
        if k == 0 and offsets.size < blocks:
            raise InputError(
                f"{path}: truncated: {offsets.size} of the {blocks} blocks that its size requires"
            )
        if k == 0 and not (offsets * lengths).any():
            raise InputError(f"{path}: none of its blocks was ever written")
        if (offsets + lengths > size).any():
            block = int((offsets + lengths > size).argmax())
            raise InputError(f"{path}: truncated: block {block} lies past the end of the file")


class _Doubts(logging.Handler):
    """Collects tifffile's log messages about a file's structure."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if "invalid page offset" in record.getMessage() or "corrupted" in record.getMessage():
            self.lines.append(record.getMessage())


def read_tile(tile: Tile, window: Window) -> Amplitude:
    """Read amplitudes of a window inside the tile.

    Parameters
    ----------
    tile : Tile
    window : Window
        Pixels of the tile; must lie inside it.

    Returns
    -------
    ndarray (height, width)
        Linear amplitude, float32 (float64 where the file holds it or 32-bit integers); NaN where
        there is no amplitude: nodata, masked, infinite or negative.

    Raises
    ------
    OSError
        Where a block cannot be decoded; the message names file and pixel window.
    """
    return np.asarray(to_linear(read_numbers(tile, window), tile.kind))


def read_numbers(tile: Tile, window: Window) -> Amplitude:
    """Read a window's values before they are converted to amplitude.

    Parameters
    ----------
    tile : Tile
    window : Window
        Pixels of the tile; must lie inside it.

    Returns
    -------
    ndarray (height, width)
        As stored, scale and offset applied; NaN for nodata, masked, fill and infinite values.

    Raises
    ------
    OSError
        Where a block cannot be decoded.
    """
    area = rasterio.windows.Window(window.column, window.row, window.width, window.height)
    kind = np.dtype(tile.dtype)
    target = np.float64 if kind.itemsize > 4 or kind in (np.int32, np.uint32) else np.float32
    try:
        with open_geotiff(tile.path) as source:
            raw = source.read(1, window=area)
            missing = source.read_masks(1, window=area) == 0
            if source.nodata is not None:  # a mask in the file hides its nodata value
                missing |= raw == source.nodata
            scale, offset = source.scales[0], source.offsets[0]
    except rasterio.errors.RasterioError as error:
        where = _where(_damaged(tile.path, window))
        raise OSError(f"{tile.path}: {where} cannot be read: {error}") from None
    for fill in tile.fill:
        missing |= (raw == fill.value) & fill.near(window)
    # a broken file can hold signalling NaN, and numbers beyond float32
    with np.errstate(invalid="ignore", over="ignore"):
        numbers = raw.astype(target)
        if (scale, offset) != (1.0, 0.0):
            numbers = (numbers * scale + offset).astype(target)
    missing |= ~np.isfinite(numbers)
    numbers[missing] = np.nan
    return np.asarray(numbers)


def _damaged(path: Path, window: Window) -> Window:
    """First block of a window that cannot be read; the window itself where each can be."""
    with suppress(rasterio.errors.RasterioError), open_geotiff(path) as source:
        for _, block in source.block_windows(1):
            here = Window(block.row_off, block.col_off, block.height, block.width)
            if min(here.intersect(window)[2:]) > 0 and not _decodes(source, block):
                return here
    return window


def _decodes(source: rasterio.DatasetReader, block: rasterio.windows.Window) -> bool:
    try:
        source.read(1, window=block)
    except rasterio.errors.RasterioError:
        return False
    return True


def _where(window: Window) -> str:
    rows = f"rows {window.row} to {window.row + window.height - 1}"
    return f"{rows}, columns {window.column} to {window.column + window.width - 1}"


def read_mosaic(tiles: tuple[Tile, ...], lattice: Lattice, window: Window) -> Amplitude:
    """Copy tiles into a window of a lattice; where they overlap, the first valid pixel wins.

    Pixels are never interpolated, so that speckle keeps its statistics: a tile on the same lattice
    is copied, a tile on another lattice is resampled by nearest neighbour.

    Parameters
    ----------
    tiles : tuple of Tile
        In order of precedence.
    lattice : Lattice
    window : Window
        Pixels of `lattice`; may reach beyond all tiles.

    Returns
    -------
    ndarray (height, width)
        Amplitude, NaN where no tile has any.
    """
    double = any(np.dtype(t.dtype).itemsize > 4 for t in tiles)
    mosaic = np.full((window.height, window.width), np.nan, np.float64 if double else np.float32)
    for tile in tiles:
        offset = lattice.offset_to(tile.lattice)
        if offset is not None:
            _copy(tile, offset, window, mosaic)
        else:
            _copy_nearest(tile, lattice, window, mosaic)
    return mosaic


def _copy(tile: Tile, offset: tuple[int, int], window: Window, mosaic: Amplitude) -> None:
    wanted = Window(window.row - offset[0], window.column - offset[1], window.height, window.width)
    part = wanted.intersect(tile.window)
    if part.empty:
        return
    row, column = part.row - wanted.row, part.column - wanted.column
    target = mosaic[row : row + part.height, column : column + part.width]
    np.copyto(target, read_tile(tile, part), where=np.isnan(target))


def _copy_nearest(tile: Tile, lattice: Lattice, window: Window, mosaic: Amplitude) -> None:
    edge = transform_points(lattice.crs, tile.lattice.crs, *outline(window, lattice))
    if not np.all(np.isfinite(edge)):
        return
    if bounding_window(*tile.lattice.pixel_of(*edge)).intersect(tile.window).empty:
        return
    centres = transform_points(lattice.crs, tile.lattice.crs, *lattice.centres(window))
    row, column = (np.floor(v).astype(np.int64) for v in tile.lattice.pixel_of(*centres))
    inside = (row >= 0) & (row < tile.window.height) & (column >= 0) & (column < tile.window.width)
    if not inside.any():
        return
    top, left = int(row[inside].min()), int(column[inside].min())
    part = Window(top, left, int(row[inside].max()) - top + 1, int(column[inside].max()) - left + 1)
    values = read_tile(tile, part)
    target = np.where(inside, np.nan, 0.0)
    target[inside] = values[row[inside] - top, column[inside] - left]
    np.copyto(mosaic, target.astype(mosaic.dtype), where=np.isnan(mosaic) & inside)


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str
        Hexadecimal.
    """
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def find_tiles(folder: Path, pattern: str) -> list[Path]:
    """Find the files that a glob pattern names.

    Parameters
    ----------
    folder : Path
        Start of relative patterns.
    pattern : str

    Returns
    -------
    list of Path
        Sorted. A name without wildcards is returned as it is, so that a missing file is reported.
    """
    pattern = str(expanded(pattern))
    if not glob.has_magic(pattern) or (folder / pattern).is_file():
        return [folder / pattern]
    full = os.path.join(glob.escape(str(folder)), pattern)
    return [Path(name) for name in sorted(glob.glob(full, recursive=True))]


def near_miss(folder: Path, pattern: str) -> str:
    """Suggest why a pattern matches no file.

    Parameters
    ----------
    folder : Path
        Start of relative patterns.
    pattern : str

    Returns
    -------
    str
        To be appended to a message; empty where nothing is known.
    """
    if "\\" in pattern:
        return f": folders are parted by /: {pattern.replace(chr(92), '/')!r}"
    wanted = folder / expanded(pattern)
    if not glob.has_magic(str(wanted.parent)):
        if not wanted.parent.is_dir():
            return f": there is no folder {wanted.parent}"
        for name in sorted(os.listdir(wanted.parent)):
            if fnmatch.fnmatchcase(name.lower(), wanted.name.lower()):
                return f": upper and lower case differ: there is {name}"
    return ""
