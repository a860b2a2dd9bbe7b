"""Passes of a survey: tiles and track together, as lazy arrays or as the clip of a cell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import dask.array as da
import numpy as np
import pyproj
import xarray as xr

from sasmap.config import PassSettings, Survey
from sasmap.errors import InputError
from sasmap.productnames import PRODUCTS
from sasmap.survey.cells import Cell, CellGrid, check_grid_crs, lay_grid
from sasmap.survey.lattice import (
    FloatArray,
    Lattice,
    Window,
    bounding_window,
    outline,
    transform_points,
)
from sasmap.survey.navigation import MIN_GRAZING, Track, read_navigation
from sasmap.survey.tiles import Amplitude, Tile, find_tiles, gather, inspect_tile, read_tile

Side = Literal["port", "starboard"]
CHUNK = 1024
CHECKED_PIXELS = 100_000

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
    """A pass ready to be read.

    Attributes
    ----------
    name : str
    tiles : tuple of Tile
        In order of precedence where they overlap.
    track : Track
        In the survey's CRS.
    sides : tuple of str
        Sides of the track that the pass shows.
    slant : bool
        Whether the tiles' across-track axis is slant range.
    navigation : Path
    """

    name: str
    tiles: tuple[Tile, ...]
    track: Track
    sides: tuple[Side, ...]
    slant: bool
    navigation: Path

    @property
    def files(self) -> list[Path]:
        """Every file the pass is read from."""
        return [*(tile.path for tile in self.tiles), self.navigation]

    @property
    def reach(self) -> float:
        """How far a tile pixel can lie from the sea floor it shows, m."""
        return float(self.track.altitude.max()) if self.slant else 0.0


@dataclass(frozen=True)
class OpenSurvey:
    """A survey whose files were found and checked.

    Attributes
    ----------
    settings : Survey
    grid : CellGrid
    passes : tuple of SonarPass
    warnings : tuple of str
        What is odd but no fault, a line each.
    """

    settings: Survey
    grid: CellGrid
    passes: tuple[SonarPass, ...]
    warnings: tuple[str, ...]


def open_survey(survey: Survey) -> OpenSurvey:
    """Find and check every file of a survey before any work starts.

    Parameters
    ----------
    survey : Survey

    Returns
    -------
    OpenSurvey

    Raises
    ------
    InputError
        With a line for every fault found in tiles and navigation.
    """
    faults: list[str] = []
    tiles: dict[str, tuple[Tile, ...]] = {}
    for settings in survey.passes:
        try:
            tiles[settings.name] = _inspect_tiles(survey, settings)
        except InputError as error:
            faults.extend(error.faults)
    if faults:
        raise InputError(dict.fromkeys(faults))
    every = [tile for settings in survey.passes for tile in tiles[settings.name]]
    crs = _product_crs(survey, every)
    grid = lay_grid(every, crs, survey.window)
    passes, warnings = [], []
    for settings in survey.passes:
        try:
            passes.append(_open(survey, settings, tiles[settings.name], crs))
            warnings += _check_pixels(passes[-1], crs)
        except InputError as error:
            faults.extend(error.faults)
    if faults:
        raise InputError(dict.fromkeys(faults))
    check_kept(survey, (f for p in passes for f in p.files))
    return OpenSurvey(survey, grid, tuple(passes), tuple(warnings))


def _inspect_tiles(survey: Survey, settings: PassSettings) -> tuple[Tile, ...]:
    faults, tiles = [], []
    paths: list[Path] = []
    for pattern in settings.tiles:
        literal = survey.path.parent / pattern
        found = [
            path
            for path in find_tiles(survey.path.parent, pattern)
            if path == literal or not _is_product(survey, path)
        ]
        if not found:
            faults.append(
                f"{survey.path}: passes.{settings.name}.tiles: no file matches {pattern!r}"
            )
        paths.extend(found)
    for path in dict.fromkeys(paths):
        try:
            tiles.append(inspect_tile(path))
        except InputError as error:
            faults.extend(error.faults)
    if faults:
        raise InputError(faults)
    return tuple(tiles)


def _is_product(survey: Survey, path: Path) -> bool:
    """Whether a path is where a run writes a product."""
    inside = path.resolve().parent == survey.output_folder.resolve()
    return inside and path.name in PRODUCTS


def check_kept(survey: Survey, inputs: Iterable[Path]) -> None:
    """Refuse an output folder in which a product would replace an input."""
    for path in sorted({*inputs, survey.path}):
        if _is_product(survey, path):
            raise InputError(f"{path}: a product of that name would replace this input; move one")


def _product_crs(survey: Survey, tiles: list[Tile]) -> str:
    if survey.crs is not None:
        where, crs = f"{survey.path}: crs", pyproj.CRS.from_user_input(survey.crs)
    else:
        where, crs = str(tiles[0].path), pyproj.CRS.from_wkt(tiles[0].lattice.crs)
    wkt = crs.to_wkt()
    # two spellings of one CRS must not count as two
    for tile in tiles:
        if tile.lattice.crs != wkt and pyproj.CRS.from_wkt(tile.lattice.crs).equals(
            crs, ignore_axis_order=True
        ):
            wkt = tile.lattice.crs
            break
    x, y = tiles[0].outline_in(wkt)
    check_grid_crs(crs, where, float(np.mean(x)), float(np.mean(y)))
    return wkt


def _open(survey: Survey, settings: PassSettings, tiles: tuple[Tile, ...], crs: str) -> SonarPass:
    path = survey.resolve(settings.navigation)
    track = read_navigation(path, crs, tiles[0].lattice.crs, settings.navigation_crs)
    sides: tuple[Side, ...] = ("port", "starboard") if settings.side == "both" else (settings.side,)
    found = SonarPass(settings.name, tiles, track, sides, settings.range == "slant", path)
    faults = [fault for tile in tiles for fault in _check_seen(found, tile, crs)]
    if faults:
        raise InputError(faults)
    return found


def _check_seen(sonar_pass: SonarPass, tile: Tile, crs: str) -> list[str]:
    """Check on a coarse raster of the tile's pixels that the track can have seen it."""
    window = tile.window
    step = max(window.height, window.width) / 64
    row, column = np.meshgrid(
        np.arange(0, window.height + step / 2, step).clip(0.5, window.height - 0.5),
        np.arange(0, window.width + step / 2, step).clip(0.5, window.width - 0.5),
        indexing="ij",
    )
    t = tile.lattice.transform
    x, y = t.c + t.a * column + t.b * row, t.f + t.d * column + t.e * row
    seen = sonar_pass.track.locate(*transform_points(tile.lattice.crs, crs, x, y))
    with np.errstate(invalid="ignore"):
        near = np.arctan2(seen.altitude, seen.distance) >= MIN_GRAZING
    if not near.any():
        return [
            f"{tile.path}: lies outside the navigation: no ping of {sonar_pass.navigation} "
            "passes abeam of it within the range a sonar at that altitude can see"
        ]
    wanted = np.zeros_like(near)
    for side in sonar_pass.sides:
        wanted |= near & (seen.starboard == (side == "starboard"))
    if not wanted.any():
        other = "port" if sonar_pass.sides == ("starboard",) else "starboard"
        return [
            f"{tile.path}: lies on the {other} side of the track; expected {sonar_pass.sides[0]}"
        ]
    return []


def _check_pixels(sonar_pass: SonarPass, crs: str) -> list[str]:
    """Check that the pass shows a pixel of sea floor; return a line for each tile that does not."""
    empty = []
    for tile in sonar_pass.tiles:
        try:
            if not _shows_floor(sonar_pass, tile, crs):
                empty.append(tile)
        except OSError:
            continue  # an undecodable block fails its cells, not the survey
    if len(empty) == len(sonar_pass.tiles):
        raise InputError(
            f"{empty[0].path}: pass {sonar_pass.name!r} has no valid pixel: expected amplitudes of "
            "zero or more, not nodata, on a side it shows, outside the water column"
        )
    return [f"{tile.path}: holds no valid pixel" for tile in empty]


def _shows_floor(sonar_pass: SonarPass, tile: Tile, crs: str) -> bool:
    rows = max(1, CHECKED_PIXELS // max(tile.window.width, 1))
    for row in range(0, tile.window.height, rows):
        part = Window(row, 0, min(rows, tile.window.height - row), tile.window.width)
        valid = ~np.isnan(read_tile(tile, part))
        if valid.any():
            seen = view(sonar_pass, crs, tile.lattice, part)["ground_range"]
            if (valid & ~np.isnan(seen)).any():
                return True
    return False


def view(sonar_pass: SonarPass, crs: str, lattice: Lattice, window: Window) -> dict[str, Any]:
    """Compute where a window's pixels are and how the sonar saw them.

    Parameters
    ----------
    sonar_pass : SonarPass
    crs : str
        CRS of the result, WKT.
    lattice : Lattice
    window : Window

    Returns
    -------
    dict
        ``x, y`` (m), ``starboard`` (bool), ``ground_range, altitude`` (m), ``look_azimuth``
        (degrees) and, for slant range, ``ground_x, ground_y`` (m), each (height, width); NaN where
        the pass did not see the pixel: beyond the track's ends, on a side it does not show, or in
        the water column.
    """
    x, y = transform_points(lattice.crs, crs, *lattice.centres(window))
    x, y = np.broadcast_arrays(x, y)
    seen = sonar_pass.track.locate(x, y)
    ground_range = seen.distance
    if len(sonar_pass.sides) == 1:
        ground_range[seen.starboard != (sonar_pass.sides[0] == "starboard")] = np.nan
    result = {"x": x, "y": y, "starboard": seen.starboard}
    if sonar_pass.slant:
        squared = seen.distance**2 - seen.altitude**2
        ground_range = np.sqrt(np.where(squared > 0, squared, np.nan))
        shift = ground_range - seen.distance
        azimuth = np.radians(seen.look_azimuth)
        result["ground_x"] = x + shift * np.sin(azimuth)
        result["ground_y"] = y + shift * np.cos(azimuth)
    missing = np.isnan(ground_range)
    seen.altitude[missing] = np.nan
    seen.look_azimuth[missing] = np.nan
    return result | {
        "ground_range": ground_range,
        "altitude": seen.altitude,
        "look_azimuth": seen.look_azimuth,
    }


def open_pass(survey: Survey, name: str) -> xr.DataArray:
    """Open a pass as a lazy array.

    Parameters
    ----------
    survey : Survey
        From :func:`sasmap.load_survey`.
    name : str
        Name of the pass.

    Returns
    -------
    DataArray (y, x)
        Linear amplitude, NaN where there is none, backed by dask. Coordinates: ``x``, ``y`` of
        the pixel centres (m, in the survey's CRS; two-dimensional where the tiles are rotated
        against it), ``ground_range``, ``altitude`` (m), ``look_azimuth`` (degrees clockwise from
        grid north), for slant-range tiles ``ground_x``, ``ground_y``, and ``spatial_ref``, the
        CRS in CF form. Pixels of the first tile's lattice; tiles on other lattices are laid into
        it by nearest pixel.

    Raises
    ------
    InputError
        Where the survey has no such pass, or a file of the survey is faulty.

    Examples
    --------
    >>> import sasmap
    >>> amplitude = open_pass(sasmap.load_survey("sample_data/survey.yaml"), "near")
    >>> amplitude.dims, amplitude.shape
    (('y', 'x'), (1000, 1500))
    >>> float(amplitude.ground_range[0, 0].round(2)), amplitude.ground_range.units
    (8.26, 'm')
    """
    survey.find_pass(name)
    opened = open_survey(survey)
    sonar_pass = next(p for p in opened.passes if p.name == name)
    crs = opened.grid.crs
    lattice = sonar_pass.tiles[0].lattice
    window = _extent(sonar_pass, lattice)
    return _lazy(sonar_pass, crs, lattice, window)


def _extent(sonar_pass: SonarPass, lattice: Lattice) -> Window:
    rows, columns = [], []
    for tile in sonar_pass.tiles:
        row, column = lattice.pixel_of(*tile.outline_in(lattice.crs))
        rows.append(row)
        columns.append(column)
    return bounding_window(np.concatenate(rows), np.concatenate(columns))


def _lazy(sonar_pass: SonarPass, crs: str, lattice: Lattice, window: Window) -> xr.DataArray:
    chunks = da.core.normalize_chunks(CHUNK, (window.height, window.width), dtype=np.float64)
    dtype = gather(sonar_pass.tiles, lattice, Window(0, 0, 0, 0)).dtype
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
        amplitude = gather(sonar_pass.tiles, lattice, part)
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
    return _array(values, lazy, crs, sonar_pass.name)


def _array(values: Any, coordinates: dict[str, Any], crs: str, name: str) -> xr.DataArray:
    spatial_ref = xr.Variable((), 0, pyproj.CRS.from_wkt(crs).to_cf())
    array = xr.DataArray(
        values,
        dims=("y", "x"),
        coords=coordinates | {"spatial_ref": spatial_ref},
        name="amplitude",
        attrs={"long_name": "linear amplitude", "grid_mapping": "spatial_ref", "pass": name},
    )
    for key, attributes in ATTRIBUTES.items():
        if key in array.coords:
            array.coords[key].attrs.update(attributes)
    return array


def tiles_of_cells(sonar_pass: SonarPass, grid: CellGrid) -> dict[Cell, tuple[Tile, ...]]:
    """Return the tiles of a pass that may show each cell, in order of precedence."""
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
) -> xr.DataArray | None:
    """Read what one side of a pass shows of a cell.

    The clip is on the lattice of the tile that covers most of the cell.

    Parameters
    ----------
    sonar_pass : SonarPass
    grid : CellGrid
    cell : Cell
    side : {"port", "starboard"}
    tiles : tuple of Tile, optional
        What :func:`tiles_of_cells` gives for the cell; found here if not given.

    Returns
    -------
    DataArray (y, x) or None
        As :func:`open_pass` gives it, but in memory, cut to the cell's own pixels (others NaN),
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
    left, bottom, right, top = grid.bounds(cell)
    reach = sonar_pass.reach
    corner = Lattice(grid.crs, grid.transform)
    margin = reach / grid.size
    square = Window(cell.row, cell.column, 1, 1)
    edge_x, edge_y = outline(square, corner)
    centre_x, centre_y = (left + right) / 2, (bottom + top) / 2
    edge_x = centre_x + (edge_x - centre_x) * (1 + 2 * margin)
    edge_y = centre_y + (edge_y - centre_y) * (1 + 2 * margin)

    def window_on(tile: Tile) -> Window:
        edge = transform_points(grid.crs, tile.lattice.crs, edge_x, edge_y)
        return bounding_window(*tile.lattice.pixel_of(*edge))

    def area_of(tile: Tile) -> float:
        common = window_on(tile).intersect(tile.window)
        return common.height * common.width * tile.pixel_size**2

    main = max(tiles, key=area_of)
    window = window_on(main)
    amplitude = gather(tiles, main.lattice, window)
    if np.isnan(amplitude).all():
        return None
    seen = view(sonar_pass, grid.crs, main.lattice, window)
    inside = grid.holds(cell, seen.get("ground_x", seen["x"]), seen.get("ground_y", seen["y"]))
    valid = inside & ~np.isnan(seen["ground_range"]) & ~np.isnan(amplitude)
    valid &= seen.pop("starboard") == (side == "starboard")
    if not valid.any():
        return None
    return _cut(amplitude, seen, valid, grid.crs, sonar_pass.name, main.pixel_size)


def _cut(
    amplitude: Amplitude,
    seen: dict[str, Any],
    valid: Any,
    crs: str,
    name: str,
    pixel_size: float,
) -> xr.DataArray:
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    amplitude[~valid] = np.nan
    coordinates = {key: (("y", "x"), value[box]) for key, value in seen.items()}
    clip = _array(amplitude[box], coordinates, crs, name)
    clip.attrs["pixel_size"] = pixel_size
    return clip
