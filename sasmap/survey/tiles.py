"""Amplitude GeoTIFFs: checked before use, opened safely, read by windows."""

from __future__ import annotations

import glob
import hashlib
import logging
import os
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyproj
import rasterio
import rasterio.windows
import tifffile
from affine import Affine
from numpy.typing import NDArray

from sasmap.errors import InputError
from sasmap.survey.lattice import Lattice, Window, bounding_window, outline, transform_points

Amplitude = NDArray[np.float32] | NDArray[np.float64]

# Sidecar files (overviews, auxiliary XML) are never looked at: a hostile one can point GDAL
# at the network.
GDAL_OPTIONS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_HTTP_TIMEOUT": "1",
    "GDAL_PAM_ENABLED": "NO",
}
MAX_BLOCK_BYTES = 2**29
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
    """

    path: Path
    lattice: Lattice
    window: Window
    dtype: str

    @property
    def pixel_size(self) -> float:
        """Side in metres of the square with a pixel's area."""
        unit = pyproj.CRS.from_wkt(self.lattice.crs).axis_info[0].unit_conversion_factor
        return float(abs(self.lattice.transform.determinant) ** 0.5 * unit)

    def outline_in(self, crs: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points of the tile's edge in another CRS."""
        return _outline_in(self, crs)


@lru_cache(maxsize=100_000)
def _outline_in(tile: Tile, crs: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = outline(tile.window, tile.lattice)
    return transform_points(tile.lattice.crs, crs, x, y)


def inspect_tile(path: Path) -> Tile:
    """Open a tile's header and check that the tile can be used.

    Parameters
    ----------
    path : Path
        A regular local file.

    Returns
    -------
    Tile

    Raises
    ------
    InputError
        Where the file is missing, not a GeoTIFF, truncated, not a single real-valued band, or
        has no usable georeference in a projected CRS.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"{path}: expected a file name in UTF-8") from None
    if not path.is_file():
        raise InputError(f"{path}: no such file" if not path.exists() else f"{path}: not a file")
    try:
        with rasterio.Env(**GDAL_OPTIONS), rasterio.open(path, driver="GTiff") as source:
            _check_band(path, source)
            crs = _checked_crs(path, source)
            _check_blocks(path, source)
            return Tile(
                path=path,
                lattice=Lattice(crs, source.transform),
                window=Window(0, 0, source.height, source.width),
                dtype=source.dtypes[0],
            )
    except rasterio.errors.RasterioIOError:
        raise InputError(f"{path}: not a GeoTIFF that can be opened") from None


def _check_band(path: Path, source: rasterio.DatasetReader) -> None:
    if source.count != 1:
        raise InputError(f"{path}: expected a single amplitude band, got {source.count} bands")
    if np.dtype(source.dtypes[0]).kind not in "uif":
        raise InputError(f"{path}: expected real amplitudes, got {source.dtypes[0]} pixels")


def _checked_crs(path: Path, source: rasterio.DatasetReader) -> str:
    if source.crs is None:
        raise InputError(f"{path}: no CRS: expected a tile georeferenced in a projected CRS")
    crs = pyproj.CRS.from_wkt(source.crs.to_wkt())
    if not crs.is_projected:
        advice = "expected a projected CRS; warp it first, for example gdalwarp -r near -t_srs"
        raise InputError(f"{path}: geographic CRS {crs.name!r}: {advice} {_utm_of(source, crs)}")
    determinant = source.transform.determinant
    if source.transform == Affine.identity() or not np.isfinite(determinant) or determinant == 0:
        raise InputError(
            f"{path}: no georeference: expected a GeoTIFF with a pixel size and origin"
        )
    return str(crs.to_wkt())


def _utm_of(source: rasterio.DatasetReader, crs: pyproj.CRS) -> str:
    if not crs.is_geographic:
        return "EPSG:32617"
    longitude, latitude = source.transform @ (source.width / 2, source.height / 2)
    if not (-180 <= longitude <= 180 and -90 <= latitude <= 90):
        return "EPSG:32617"
    zone = min(int((longitude + 180) // 6) + 1, 60)
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def _check_blocks(path: Path, source: rasterio.DatasetReader) -> None:
    """Compare block offsets with the file's size: a truncated TIFF opens without complaint."""
    size = path.stat().st_size
    height, width = source.block_shapes[0]
    item = np.dtype(source.dtypes[0]).itemsize
    if height * width * item > MAX_BLOCK_BYTES:
        raise InputError(
            f"{path}: blocks of {height} x {width} pixels are too large to read; tile it"
        )
    total = source.height * source.width * item
    if total > 2**32 and total > MAX_EXPANSION * size:
        raise InputError(f"{path}: {size} bytes claim to hold {total}: refused as implausible")
    blocks = -(-source.height // height) * -(-source.width // width)
    _check_directories(path, size, blocks)


def _check_directories(path: Path, size: int, blocks: int) -> None:
    """Check the blocks of every image in the file: pixels (so many), overviews, masks."""
    doubts = _Doubts()
    logger = logging.getLogger("tifffile")
    handlers, propagate = logger.handlers, logger.propagate
    logger.handlers, logger.propagate = [doubts], False  # it tells of a broken chain by a log line
    try:
        with tifffile.TiffFile(path) as file:
            pages = list(file.pages)
    except (tifffile.TiffFileError, struct.error, ValueError, IndexError, KeyError) as error:
        raise InputError(f"{path}: truncated or corrupt: {' '.join(str(error).split())}") from None
    finally:
        logger.handlers, logger.propagate = handlers, propagate
    if doubts.lines:
        raise InputError(f"{path}: truncated: its list of images leads past the end of the file")
    for k, page in enumerate(pages):
        offsets, lengths = np.array(page.dataoffsets), np.array(page.databytecounts)
        if offsets.size != lengths.size:
            raise InputError(f"{path}: corrupt: {offsets.size} blocks of {lengths.size} lengths")
        if k == 0 and offsets.size < blocks:
            raise InputError(
                f"{path}: truncated: {offsets.size} of the {blocks} blocks that its size asks for"
            )
        if k == 0 and not (offsets * lengths).any():
            raise InputError(f"{path}: no block of it was ever written")
        if (offsets + lengths > size).any():
            block = int((offsets + lengths > size).argmax())
            raise InputError(f"{path}: truncated: block {block} lies past the end of the file")


class _Doubts(logging.Handler):
    """Keeps what tifffile says of a file's structure."""

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
        there is none: nodata, masked, infinite or negative.

    Raises
    ------
    OSError
        Where a block cannot be decoded; the message names file and pixel window.
    """
    area = rasterio.windows.Window(window.column, window.row, window.width, window.height)
    kind = np.dtype(tile.dtype)
    target = np.float64 if kind.itemsize > 4 or kind in (np.int32, np.uint32) else np.float32
    try:
        with rasterio.Env(**GDAL_OPTIONS), rasterio.open(tile.path, driver="GTiff") as source:
            raw = source.read(1, window=area)
            missing = source.read_masks(1, window=area) == 0
            if source.nodata is not None:  # a mask of the file's own hides its nodata value
                missing |= raw == source.nodata
            scale, offset = source.scales[0], source.offsets[0]
    except rasterio.errors.RasterioError as error:
        raise OSError(f"{tile.path}: {_where(window)} cannot be read: {error}") from None
    amplitude = raw.astype(target)
    if (scale, offset) != (1.0, 0.0):
        amplitude = (amplitude * scale + offset).astype(target)
    missing |= ~np.isfinite(amplitude)
    missing |= np.less(amplitude, 0, where=~missing, out=np.zeros_like(missing))
    amplitude[missing] = np.nan
    return np.asarray(amplitude)


def _where(window: Window) -> str:
    rows = f"rows {window.row} to {window.row + window.height - 1}"
    return f"{rows}, columns {window.column} to {window.column + window.width - 1}"


def gather(tiles: tuple[Tile, ...], lattice: Lattice, window: Window) -> Amplitude:
    """Lay tiles into a window of a lattice, the first valid pixel winning where they overlap.

    Pixels are never interpolated, so that speckle keeps its statistics: a tile on the same lattice
    is copied, one on another lattice gives each pixel the value of its own nearest pixel.

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
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def find_tiles(folder: Path, pattern: str) -> list[Path]:
    """Return the files that a glob names, sorted; a relative one starts from the folder.

    A name without wildcards is returned as it is, so that its absence can be told.
    """
    if not glob.has_magic(pattern) or (folder / pattern).is_file():
        return [folder / pattern]
    full = os.path.join(glob.escape(str(folder)), pattern)
    return [Path(name) for name in sorted(glob.glob(full, recursive=True))]
