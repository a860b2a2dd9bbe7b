"""Finding and checking a survey's files before any work starts."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyproj
import shapely
import xarray as xr
from shapely.geometry.base import BaseGeometry

from sasmap.catalogue import PRODUCTS
from sasmap.errors import InputError
from sasmap.numerics.threads import mapped
from sasmap.settings.survey import PassSettings, Survey
from sasmap.survey.cells import CellGrid, check_grid_crs, lay_grid
from sasmap.survey.contents import look_into
from sasmap.survey.gains import compare_tiles
from sasmap.survey.navigation import read_navigation
from sasmap.survey.passes import Side, SonarPass, open_lazily
from sasmap.survey.polygons import EXPECTED, on_tiles, read_polygons
from sasmap.survey.tiles import Tile, find_tiles, inspect_tile, near_miss
from sasmap.survey.visibility import assign_tiles, check_altitude, left_out, shows_floor
from sasmap.survey.water_column import check_column
from sasmap.survey.wavelength_trend import check_ripples

T = TypeVar("T")

log = logging.getLogger("sasmap")


@dataclass(frozen=True)
class OpenSurvey:
    """A survey whose files were found and checked.

    Attributes
    ----------
    settings : Survey
    grid : CellGrid
    passes : tuple of SonarPass
    warnings : tuple of str
        Peculiarities that are not faults, a line each.
    area : shapely geometry or None
        In the survey's CRS; cells that it does not touch are left out.
    """

    settings: Survey
    grid: CellGrid
    passes: tuple[SonarPass, ...]
    warnings: tuple[str, ...]
    area: BaseGeometry | None = None

    @property
    def excluded(self) -> BaseGeometry | None:
        """Area whose pixels are left out."""
        return self.passes[0].excluded

    @property
    def polygon_files(self) -> list[Path]:
        """Files of the area and of the excluded area."""
        named = (self.settings.area, self.settings.exclude)
        return [self.settings.resolve(name) for name in named if name is not None]


class _Faults:
    """Faults of several files, collected to be reported together."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def gather(self, call: Callable[[], T]) -> T | None:
        try:
            return call()
        except InputError as error:
            self.lines.extend(error.faults)
            return None

    def raise_any(self) -> None:
        if self.lines:
            raise InputError(dict.fromkeys(self.lines))


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
        With one line per fault in tiles, navigation and polygons.
    """
    faults = _Faults()
    found = [faults.gather(lambda s=s: _inspect_tiles(survey, s)) for s in survey.passes]  # type: ignore[misc]
    faults.raise_any()
    tiles = [part or () for part in found]
    warnings: list[str] = []
    crs = _product_crs(survey, [tile for part in tiles for tile in part], warnings)
    grid = lay_grid([tile for part in tiles for tile in part], crs, survey.window)
    _tell(tiles)
    tiles = [_look_into(part, warnings, faults) for part in tiles]
    area = faults.gather(lambda: _polygons(survey, "area", grid, warnings))
    excluded = faults.gather(lambda: _polygons(survey, "exclude", grid, warnings))
    passes: list[SonarPass] = []
    for settings, part in zip(survey.passes, tiles, strict=True):
        lines = faults.gather(
            lambda s=settings, p=part: _open(survey, s, p, crs, excluded, warnings)  # type: ignore[misc]
        )
        passes += lines or []
    faults.raise_any()
    check_kept(survey, (f for p in passes for f in p.files))
    return OpenSurvey(survey, grid, tuple(passes), tuple(dict.fromkeys(warnings)), area)


def _tell(tiles: list[tuple[Tile, ...]]) -> None:
    """Log the extent of the first check, which takes seconds on large mosaics."""
    every = [tile for part in tiles for tile in part]
    megapixels = sum(tile.window.height * tile.window.width for tile in every) / 1e6
    log.info(
        "checking %s (%.3g megapixels) and %s: fill, pixel values, gains, geometry",
        _counted(len(every), "tile"), megapixels, _counted(len(tiles), "navigation file"),
    )  # fmt: skip


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _look_into(tiles: tuple[Tile, ...], warnings: list[str], faults: _Faults) -> tuple[Tile, ...]:
    """Find fill in tiles and check their pixel values."""
    looked = []
    for tile, odd, wrong in mapped(look_into, tiles, os.cpu_count()):
        looked.append(tile)
        warnings += odd
        faults.lines += wrong
    return tuple(looked)


def _polygons(survey: Survey, key: str, grid: CellGrid, warnings: list[str]) -> BaseGeometry | None:
    """Read the polygons named by a key of the survey file."""
    name = getattr(survey, key)
    if name is None:
        return None
    path = survey.resolve(name)
    found = read_polygons(path, grid, f"{EXPECTED} for {key}")
    if not on_tiles(found, grid):
        told = f"{path}: no polygon of it lies on the survey's tiles"
        if key == "area":
            raise InputError(told)
        warnings.append(f"{told}: nothing is left out")
        return None
    shapely.prepare(found)
    return found


def _inspect_tiles(survey: Survey, settings: PassSettings) -> tuple[Tile, ...]:
    faults = _Faults()
    paths: list[Path] = []
    for pattern in settings.tiles:
        literal = survey.resolve(pattern)
        found = [
            path
            for path in find_tiles(survey.path.parent, pattern)
            if path == literal or not (_is_product(survey, path) or _was_product(path))
        ]
        if not found:
            faults.lines.append(
                f"{survey.path}: passes.{settings.name}.tiles: no file matches {pattern!r}"
                f"{near_miss(survey.path.parent, pattern)}"
            )
        paths.extend(found)
    geographic = survey.crs is not None
    tiles = [
        faults.gather(lambda p=path: inspect_tile(p, settings.amplitude, geographic))  # type: ignore[misc]
        for path in dict.fromkeys(paths)
    ]
    faults.raise_any()
    return tuple(tile for tile in tiles if tile is not None)


def _is_product(survey: Survey, path: Path) -> bool:
    """Whether a run writes a product to this path."""
    inside = path.resolve().parent == survey.output_folder.resolve()
    return inside and path.name in PRODUCTS


def _was_product(path: Path) -> bool:
    """Whether a run with another output folder has written this product."""
    return path.name in PRODUCTS and (path.parent / ".sasmap").is_dir()


def check_kept(survey: Survey, inputs: Iterable[Path]) -> None:
    """Refuse an output folder in which a product would replace an input.

    Parameters
    ----------
    survey : Survey
    inputs : iterable of Path

    Raises
    ------
    InputError
        Names the input.
    """
    for path in sorted({*inputs, survey.path}):
        if _is_product(survey, path):
            raise InputError(f"{path}: a product of this name would overwrite this input; move one")


def _product_crs(survey: Survey, tiles: list[Tile], warnings: list[str]) -> str:
    if survey.crs is not None:
        where, crs = f"{survey.path}: crs", pyproj.CRS.from_user_input(survey.crs)
    else:
        where, crs = str(tiles[0].path), pyproj.CRS.from_wkt(tiles[0].lattice.crs)
    wkt = crs.to_wkt()
    # two spellings of one CRS must not count as two CRSs
    for tile in tiles:
        if tile.lattice.crs != wkt and pyproj.CRS.from_wkt(tile.lattice.crs).equals(
            crs, ignore_axis_order=True
        ):
            wkt = tile.lattice.crs
            break
    x, y = tiles[0].outline_in(wkt)
    stretched = check_grid_crs(crs, where, float(np.mean(x)), float(np.mean(y)))
    warnings += [stretched] if stretched else []
    return wkt


def _open(
    survey: Survey,
    settings: PassSettings,
    tiles: tuple[Tile, ...],
    crs: str,
    excluded: BaseGeometry | None,
    warnings: list[str],
) -> list[SonarPass]:
    """Open a pass: one per line of its navigation, if several saw its tiles."""
    path = survey.resolve(settings.navigation)
    navigation = read_navigation(
        path, crs, tiles[0].lattice.crs, settings.navigation_crs, settings.columns
    )
    warnings += navigation.warnings
    sides: tuple[Side, ...] = ("port", "starboard") if settings.side == "both" else (settings.side,)
    name = settings.name
    wanted = [
        SonarPass(name, name, tiles, stretch.track, sides, settings.range == "slant", path,
                  settings.altitude_sd, excluded)
        for stretch in navigation.stretches
    ]  # fmt: skip
    labels = [stretch.label for stretch in navigation.stretches]
    found = assign_tiles(wanted, labels, crs, warnings)
    for one in found:
        check_altitude(one, crs, warnings)
        warnings += check_column(one, crs) or check_ripples(one, crs)
        warnings += compare_tiles(one.tiles, crs)
    warnings += _check_pixels(found, crs)
    return found


def _check_pixels(lines: list[SonarPass], crs: str) -> list[str]:
    """Check that the pass shows sea floor; return a warning for each tile without any."""
    empty, told, count = [], [], 0
    for sonar_pass in lines:
        for tile in sonar_pass.tiles:
            count += 1
            try:
                if not shows_floor(sonar_pass, tile, crs):
                    empty.append(tile)
                else:
                    told.append(left_out(sonar_pass, tile, crs))
            except OSError:
                continue  # an undecodable block fails its cells, not the survey
    if len(empty) == count:
        raise InputError(
            f"{empty[0].path}: pass {lines[0].settings_name!r} has no valid pixel: expected "
            "amplitudes of zero or more, not nodata, on a side it shows, outside the water column"
        )
    return [*(f"{tile.path}: holds no valid pixel" for tile in empty), *filter(None, told)]


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
        CRS in CF form. On the first tile's lattice; tiles on other lattices are resampled by
        nearest neighbour.

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
    opened = open_survey(survey)
    return open_lazily(_chosen(opened, name), opened.grid)


def _chosen(opened: OpenSurvey, name: str) -> SonarPass:
    """Return the pass with a name; if several lines saw it, that of the named line."""
    found = [p for p in opened.passes if name in (p.name, p.settings_name)]
    if not found:
        opened.settings.find_pass(name)  # its message lists the passes
    if len(found) > 1:
        known = ", ".join(repr(p.name) for p in found)
        raise InputError(f"{opened.settings.path}: pass {name!r} has several lines: open {known}")
    return found[0]
