"""Passes of a survey: tiles and track together, as lazy arrays or as the clip of a cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import dask.array as da
import numpy as np
import pyproj
import shapely
import xarray as xr
from shapely.geometry.base import BaseGeometry

from sasmap.arrays import BoolArray, FloatArray
from sasmap.survey.cells import Cell, CellGrid
from sasmap.survey.lattice import (
    Lattice,
    Window,
    bounding_window,
    outline,
    transform_points,
)
from sasmap.survey.navigation import Geometry, Track
from sasmap.survey.tiles import Amplitude, Tile, read_mosaic

Side = Literal["port", "starboard"]
# Side in pixels of the dask chunks of a lazy array: 8 MB of double precision.
CHUNK = 1024

ATTRIBUTES = {
    "ground_range": {"units": "m", "long_name": "horizontal distance from the track"},
    "altitude": {"units": "m", "long_name": "height of the sonar above the mean sea floor"},
    "look_azimuth": {
        "units": "degrees",
        "long_name": "direction from the track to the pixel, clockwise from grid north",
    },
    "ground_x": {"units": "m", "long_name": "easting of the sea floor a slant-range pixel shows"},
    "ground_y": {"units": "m", "long_name": "northing of the sea floor a slant-range pixel shows"},
    "x": {"units": "m", "standard_name": "projection_x_coordinate"},
    "y": {"units": "m", "standard_name": "projection_y_coordinate"},
}


@dataclass(frozen=True)
class SonarPass:
    """A pass that is ready to be read.

    Attributes
    ----------
    name : str
        Name in the survey file, with the number of the line where several lines saw the pass.
    settings_name : str
        Name in the survey file.
    tiles : tuple of Tile
        In order of precedence where they overlap.
    track : Track
        In the survey's CRS.
    sides : tuple of str
        Sides of the track that the pass shows.
    slant : bool
        Whether the tiles' across-track axis is slant range.
    navigation : Path
    altitude_sd : float
        Standard deviation of the altitude, m.
    excluded : shapely geometry or None
        Where pixels are left out, in the survey's CRS.
    """

    name: str
    settings_name: str
    tiles: tuple[Tile, ...]
    track: Track
    sides: tuple[Side, ...]
    slant: bool
    navigation: Path
    altitude_sd: float = 0.0
    excluded: BaseGeometry | None = None

    @property
    def files(self) -> list[Path]:
        """All files of the pass."""
        return [*(tile.path for tile in self.tiles), self.navigation]

    @property
    def reach(self) -> float:
        """Largest distance between a tile pixel and the sea floor that it shows, m."""
        return float(self.track.altitude.max()) if self.slant else 0.0

    def locate(self, x: FloatArray, y: FloatArray, step: int = 1) -> Geometry:
        """Find the track's nearest point for map points, on the sides that the pass shows.

        Parameters
        ----------
        x, y : ndarray
            Map coordinates, m, of the same shape.
        step : int
            See :meth:`Track.locate`.

        Returns
        -------
        Geometry
            As from :meth:`Track.locate`; the distance is NaN on the other side as well.
        """
        seen = self.track.locate(x, y, step=step)
        if len(self.sides) == 1:
            seen.distance[seen.starboard != (self.sides[0] == "starboard")] = np.nan
        return seen


def view(
    sonar_pass: SonarPass, crs: str, lattice: Lattice, window: Window, step: int = 1
) -> dict[str, Any]:
    """Compute positions and viewing geometry of a window's pixels.

    Parameters
    ----------
    sonar_pass : SonarPass
    crs : str
        CRS of the result, WKT.
    lattice : Lattice
    window : Window
    step : int
        For ground-range tiles, step in pixels between points that are located exactly, see
        :meth:`Track.locate`.

    Returns
    -------
    dict
        ``x, y`` (m), ``starboard`` (bool), ``ground_range, altitude`` (m), ``look_azimuth``
        (degrees) and, for slant range, ``ground_x, ground_y`` (m), each (height, width); NaN where
        the pass did not see the pixel: beyond the track's ends, on the other side, in the water
        column, or in an excluded area.
    """
    x, y = transform_points(lattice.crs, crs, *lattice.centres(window))
    x, y = np.broadcast_arrays(x, y)
    seen = sonar_pass.locate(x, y, 1 if sonar_pass.slant else step)
    ground_range = seen.distance
    result = {"x": x, "y": y, "starboard": seen.starboard}
    if sonar_pass.slant:
        squared = seen.distance**2 - seen.altitude**2
        ground_range = np.sqrt(np.where(squared > 0, squared, np.nan))
        shift = ground_range - seen.distance
        azimuth = np.radians(seen.look_azimuth)
        result["ground_x"] = x + shift * np.sin(azimuth)
        result["ground_y"] = y + shift * np.cos(azimuth)
    if sonar_pass.excluded is not None:
        floor = result.get("ground_x", x), result.get("ground_y", y)
        ground_range[shapely.contains_xy(sonar_pass.excluded, *floor)] = np.nan
    missing = np.isnan(ground_range)
    seen.altitude[missing] = np.nan
    seen.look_azimuth[missing] = np.nan
    return result | {
        "ground_range": ground_range,
        "altitude": seen.altitude,
        "look_azimuth": seen.look_azimuth,
    }


def open_lazily(sonar_pass: SonarPass, grid: CellGrid) -> xr.DataArray:
    """Open a pass as a lazy array on its first tile's lattice, see :func:`clip_lattice`.

    Parameters
    ----------
    sonar_pass : SonarPass
    grid : CellGrid
        Its CRS is that of the coordinates.

    Returns
    -------
    DataArray (y, x)
        As described for :func:`sasmap.open_pass`.
    """
    lattice = clip_lattice(sonar_pass.tiles[0], grid)
    return _lazy(sonar_pass, grid.crs, lattice, _extent(sonar_pass, lattice))


def clip_lattice(tile: Tile, grid: CellGrid) -> Lattice:
    """Return the lattice on which a tile's pixels are represented.

    This is its own lattice, unless that is in degrees: then a lattice in the survey's CRS whose
    square pixels have the longer side of the tile's pixels, so that none of these appears twice.
    """
    if not tile.geographic:
        return tile.lattice
    count = max(round(grid.size / tile.pixel_size), 1)
    return Lattice(grid.crs, grid.pixels(count))


def _extent(sonar_pass: SonarPass, lattice: Lattice) -> Window:
    rows, columns = [], []
    for tile in sonar_pass.tiles:
        row, column = lattice.pixel_of(*tile.outline_in(lattice.crs))
        rows.append(row)
        columns.append(column)
    return bounding_window(np.concatenate(rows), np.concatenate(columns))


def _lazy(sonar_pass: SonarPass, crs: str, lattice: Lattice, window: Window) -> xr.DataArray:
    chunks = da.core.normalize_chunks(CHUNK, (window.height, window.width), dtype=np.float64)
    dtype = read_mosaic(sonar_pass.tiles, lattice, Window(0, 0, 0, 0)).dtype
    names = ["ground_range", "altitude", "look_azimuth"]
    names += ["ground_x", "ground_y"] if sonar_pass.slant else []
    aligned = lattice.crs == crs and lattice.transform.b == lattice.transform.d == 0
    names += [] if aligned else ["x", "y"]

    def part_of(info: Any) -> Window:
        (top, bottom), (left, right) = info[None]["array-location"][-2:]
        return Window(window.row + top, window.column + left, bottom - top, right - left)

    def pixels(block_info: Any = None) -> Amplitude:
        part = part_of(block_info)
        seen = view(sonar_pass, crs, lattice, part)
        amplitude = read_mosaic(sonar_pass.tiles, lattice, part)
        amplitude[np.isnan(seen["ground_range"])] = np.nan
        return amplitude

    def coordinates(block_info: Any = None) -> FloatArray:
        seen = view(sonar_pass, crs, lattice, part_of(block_info))
        return np.stack([seen[name] for name in names])

    values = da.map_blocks(pixels, chunks=chunks, dtype=dtype, meta=np.empty((0, 0), dtype))
    stack = da.map_blocks(
        coordinates, chunks=((len(names),), *chunks), dtype=float, meta=np.empty((0, 0, 0))
    )
    lazy: dict[str, Any] = {name: (("y", "x"), stack[i]) for i, name in enumerate(names)}
    if aligned:
        x, _ = lattice.centres(window._replace(height=1))
        _, y = lattice.centres(window._replace(width=1))
        lazy |= {"x": x[0], "y": y[:, 0]}
    return _array(values, lazy, crs, sonar_pass)


def _array(
    values: Any, coordinates: dict[str, Any], crs: str, sonar_pass: SonarPass
) -> xr.DataArray:
    spatial_ref = xr.Variable((), 0, pyproj.CRS.from_wkt(crs).to_cf())
    array = xr.DataArray(
        values,
        dims=("y", "x"),
        coords=coordinates | {"spatial_ref": spatial_ref},
        name="amplitude",
        attrs={
            "long_name": "linear amplitude",
            "grid_mapping": "spatial_ref",
            "pass": sonar_pass.name,
            "altitude_sd": sonar_pass.altitude_sd,
        },
    )
    for key, attributes in ATTRIBUTES.items():
        if key in array.coords:
            array.coords[key].attrs.update(attributes)
    return array


def tiles_of_cells(sonar_pass: SonarPass, grid: CellGrid) -> dict[Cell, tuple[Tile, ...]]:
    """Find the tiles of a pass that may show each cell.

    Parameters
    ----------
    sonar_pass : SonarPass
    grid : CellGrid

    Returns
    -------
    dict of Cell to tuple of Tile
        In order of precedence; cells without a tile are absent.
    """
    met: dict[Cell, tuple[Tile, ...]] = {}
    for tile in sonar_pass.tiles:
        for cell in grid.met_by(tile, sonar_pass.reach):
            met[cell] = (*met.get(cell, ()), tile)
    return met


def read_clip(
    sonar_pass: SonarPass,
    grid: CellGrid,
    cell: Cell,
    side: Side,
    tiles: tuple[Tile, ...] | None = None,
    step: int = 1,
) -> xr.DataArray | None:
    """Read a cell's clip from one side of a pass.

    The clip is on the lattice of the tile that covers most of the cell, see
    :func:`clip_lattice`.

    Parameters
    ----------
    sonar_pass : SonarPass
    grid : CellGrid
    cell : Cell
    side : {"port", "starboard"}
    tiles : tuple of Tile, optional
        Result of :func:`tiles_of_cells` for the cell; found here if not given.
    step : int
        Of :func:`view`.

    Returns
    -------
    DataArray (y, x) or None
        As from :func:`open_pass`, but in memory, cut to the cell's own pixels (others NaN),
        with the pixel size (m) as attribute ``pixel_size``; None where there is no pixel.

    Raises
    ------
    OSError
        Where a block of a tile cannot be decoded.
    """
    if tiles is None:
        tiles = tiles_of_cells(sonar_pass, grid).get(cell, ())
    if not tiles:
        return None
    around = _around(cell, grid, sonar_pass.reach)

    def window_on(lattice: Lattice) -> Window:
        edge = transform_points(grid.crs, lattice.crs, *around)
        return bounding_window(*lattice.pixel_of(*edge))

    def area_of(tile: Tile) -> float:
        common = window_on(tile.lattice).intersect(tile.window)
        return common.height * common.width * tile.pixel_size**2

    main = max(tiles, key=area_of)
    lattice = clip_lattice(main, grid)
    window = window_on(lattice)
    amplitude = read_mosaic(tiles, lattice, window)
    if np.isnan(amplitude).all():
        return None
    seen = view(sonar_pass, grid.crs, lattice, window, step)
    inside = grid.holds(cell, seen.get("ground_x", seen["x"]), seen.get("ground_y", seen["y"]))
    valid = inside & ~np.isnan(seen["ground_range"]) & ~np.isnan(amplitude)
    valid &= seen.pop("starboard") == (side == "starboard")
    if not valid.any():
        return None
    return _cut(amplitude, seen, valid, grid.crs, sonar_pass, _pixel_size(main, lattice))


def _around(cell: Cell, grid: CellGrid, reach: float) -> tuple[FloatArray, FloatArray]:
    """Points around a cell's edge, widened by `reach` (m)."""
    left, bottom, right, top = grid.bounds(cell)
    x, y = outline(Window(cell.row, cell.column, 1, 1), Lattice(grid.crs, grid.transform))
    centre_x, centre_y = (left + right) / 2, (bottom + top) / 2
    wider = grid.size / grid.spacing + 2 * reach / grid.spacing
    return centre_x + (x - centre_x) * wider, centre_y + (y - centre_y) * wider


def _pixel_size(tile: Tile, lattice: Lattice) -> float:
    """Side of a clip's pixels, m."""
    return float(abs(lattice.transform.a)) if tile.geographic else tile.pixel_size


def _span(valid: BoolArray) -> slice:
    """Slice from the first to the last valid row or column; at least two, to define the lattice."""
    at = np.flatnonzero(valid)
    first, last = int(at[0]), int(at[-1])
    if first == last and valid.size > 1:
        first, last = (first, last + 1) if last + 1 < valid.size else (first - 1, last)
    return slice(first, last + 1)


def _cut(
    amplitude: Amplitude,
    seen: dict[str, Any],
    valid: Any,
    crs: str,
    sonar_pass: SonarPass,
    pixel_size: float,
) -> xr.DataArray:
    box = _span(valid.any(axis=1)), _span(valid.any(axis=0))
    amplitude[~valid] = np.nan
    coordinates = {key: (("y", "x"), value[box]) for key, value in seen.items()}
    clip = _array(amplitude[box], coordinates, crs, sonar_pass)
    clip.attrs["pixel_size"] = pixel_size
    return clip
