"""The cell grid, common to all passes of a survey."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pyproj
from affine import Affine

from sasmap.arrays import BoolArray, FloatArray
from sasmap.errors import InputError
from sasmap.survey.tiles import Tile

# Scale error of a map projection, which is also that of heights and wavelengths: from which it is
# worth a warning (a UTM zone stays below 0.1 %, as do errors of f), and the largest. A UTM zone and
# its neighbours stay below 1.3 %, Web Mercator exceeds 2 % beyond 12 degrees of latitude.
STRETCHED, MAX_STRETCH = 0.001, 0.02
# Number of cells beyond which the plan alone takes minutes: 4 million of 12.5 m cover 25 km x 25
# km.
MAX_CELLS = 4_000_000
# Distance from the nearest other tile at which a tile is misplaced where cells are too many, m.
APART = 20_000.0


class Cell(NamedTuple):
    """A square of the grid by its row (from the top) and column (from the left)."""

    row: int
    column: int


@dataclass(frozen=True)
class CellGrid:
    """Square cells from the upper-left corner of the union of all tiles.

    Attributes
    ----------
    crs : str
        Projected CRS in metres, as WKT.
    left, top : float
        Upper-left corner, m.
    size : float
        Side of a cell, m.
    rows, columns : int
    spacing : float
        Distance from cell to cell, m; cells overlap where it is smaller than their size.
    """

    crs: str
    left: float
    top: float
    size: float
    rows: int
    columns: int
    spacing: float

    @property
    def transform(self) -> Affine:
        """Affine of rasters with one pixel per cell, centred on it and as large as the spacing."""
        margin = 0.5 * (self.size - self.spacing)
        place = self.left + margin, self.top - margin
        return Affine(self.spacing, 0.0, place[0], 0.0, -self.spacing, place[1])

    def pixels(self, window: int) -> Affine:
        """Affine of rasters with `window` by `window` pixels per cell, for adjacent cells."""
        step = self.size / window
        return Affine(step, 0.0, self.left, 0.0, -step, self.top)

    def __iter__(self) -> Iterator[Cell]:
        """Cells row by row."""
        return (Cell(r, c) for r in range(self.rows) for c in range(self.columns))

    def bounds(self, cell: Cell) -> tuple[float, float, float, float]:
        """Return left, bottom, right, top of a cell, m."""
        left, top = self.left + cell.column * self.spacing, self.top - cell.row * self.spacing
        return left, top - self.size, left + self.size, top

    def met_by(self, tile: Tile, reach: float) -> Iterator[Cell]:
        """Cells that a tile's bounding box, widened by `reach` (m), overlaps."""
        x, y = tile.outline_in(self.crs)
        slack = 1e-6 * self.size
        shared = self.size - self.spacing
        first = np.floor((x.min() - reach - self.left + slack - shared) / self.spacing)
        last = np.floor((x.max() + reach - self.left - slack) / self.spacing)
        upper = np.floor((self.top - y.max() - reach + slack - shared) / self.spacing)
        lower = np.floor((self.top - y.min() + reach - slack) / self.spacing)
        for row in range(max(int(upper), 0), min(int(lower), self.rows - 1) + 1):
            for column in range(max(int(first), 0), min(int(last), self.columns - 1) + 1):
                yield Cell(row, column)

    def holds(self, cell: Cell, x: FloatArray, y: FloatArray) -> BoolArray:
        """Whether map points lie in a cell; with adjacent cells, each lies in exactly one."""
        right, down = (x - self.left) / self.spacing + 1e-9, (self.top - y) / self.spacing + 1e-9
        reach = self.size / self.spacing
        across = (right >= cell.column) & (right < cell.column + reach)
        inside: BoolArray = across & (down >= cell.row) & (down < cell.row + reach)
        return inside

    def overlapping(self, spacing: float) -> CellGrid:
        """Lay out cells of the same size over the same area at another spacing, m.

        The last cells reach its end; further ones would add nothing.
        """
        rows, columns = (
            1 + max(int(np.ceil((n - 1) * self.size / spacing - 1e-6)), 0)
            for n in (self.rows, self.columns)
        )
        return replace(self, rows=rows, columns=columns, spacing=spacing)


def lay_grid(tiles: list[Tile], crs: str, window: int) -> CellGrid:
    """Lay out the cell grid over all tiles of a survey.

    Parameters
    ----------
    tiles : list of Tile
        Tiles of all passes; the first one's pixel size defines the cells.
    crs : str
        CRS of the grid, WKT.
    window : int
        Side of a cell in pixels of the first tile.

    Returns
    -------
    CellGrid

    Raises
    ------
    InputError
        Where a tile cannot be transformed to the CRS.
    """
    edges = []
    for tile in tiles:
        x, y = tile.outline_in(crs)
        if not np.all(np.isfinite(x) & np.isfinite(y)):
            raise InputError(f"{tile.path}: lies outside the domain of the survey's CRS")
        edges.append((x.min(), x.max(), y.min(), y.max()))
    west, east, south, north = np.array(edges).T
    left, right, bottom, top = west.min(), east.max(), south.min(), north.max()
    size = window * tiles[0].pixel_size
    # less than a thousandth of a pixel is rounding, not a cell
    slack = 1e-3 / window
    columns = max(1, int(np.ceil((right - left) / size - slack)))
    rows = max(1, int(np.ceil((top - bottom) / size - slack)))
    if rows * columns > MAX_CELLS:
        _check_together(tiles, 0.5 * (west + east), 0.5 * (south + north))
    grid = CellGrid(crs, float(left), float(top), size, rows, columns, size)
    check_count(grid, str(tiles[0].path))
    return grid


def _check_together(tiles: list[Tile], x: FloatArray, y: FloatArray) -> None:
    """Refuse a tile whose centre (x, y) lies far from all others, which have theirs together."""
    middle = (np.median(x), np.median(y)) if len(tiles) > 2 else (x[0], y[0])
    away = np.hypot(x - middle[0], y - middle[1])
    worst = int(np.argmax(away))
    others = np.delete(np.hypot(x - x[worst], y - y[worst]), worst)
    if others.size and others.min() > APART:
        tile = tiles[worst]
        raise InputError(
            f"{tile.path}: lies {others.min() / 1000:,.0f} km from the nearest other tile: check "
            f"its CRS ({pyproj.CRS.from_wkt(tile.lattice.crs).name}) and its origin"
        )


def check_count(grid: CellGrid, where: str) -> None:
    """Refuse a grid of too many cells.

    Parameters
    ----------
    grid : CellGrid
    where : str
        File, for the message.

    Raises
    ------
    InputError
    """
    if grid.rows * grid.columns > MAX_CELLS:
        overlap = ", or less overlap" if grid.spacing < grid.size else ""
        raise InputError(
            f"{where}: the tiles span {grid.rows} x {grid.columns} cells of {grid.size:g} m: "
            f"expected at most {MAX_CELLS}; split the survey or choose a larger window{overlap}"
        )


def check_grid_crs(crs: pyproj.CRS, where: str, x: float, y: float) -> str:
    """Refuse a product CRS whose map distances are not metres on the ground.

    Parameters
    ----------
    crs : pyproj.CRS
    where : str
        File and key that set it, for the message.
    x, y : float
        A point of the survey in that CRS.

    Returns
    -------
    str
        Warning where map distances are off by more than 0.1 % there, else empty.

    Raises
    ------
    InputError
        For a geographic CRS, one in units other than metres, or one that stretches distances here
        by more than 2 % (as Web Mercator may).
    """
    advice = "choose a projected CRS in metres, such as the UTM zone of the survey"
    if crs.is_compound or len(crs.axis_info) > 2:
        raise InputError(f"{where}: CRS {crs.name!r} has heights: {advice}, without them")
    if not crs.is_projected:
        kind = "geographic" if crs.is_geographic else crs.type_name.removesuffix(" CRS").lower()
        raise InputError(f"{where}: {kind} CRS {crs.name!r}: {advice}")
    if any(abs(axis.unit_conversion_factor - 1.0) > 1e-9 for axis in crs.axis_info[:2]):
        raise InputError(f"{where}: CRS {crs.name!r} is in {crs.axis_info[0].unit_name}: {advice}")
    longitude, latitude = pyproj.Proj(crs)(x, y, inverse=True)
    if not (np.isfinite(longitude) and np.isfinite(latitude)):
        raise InputError(f"{where}: the tiles lie outside the domain of CRS {crs.name!r}: {advice}")
    factors = pyproj.Proj(crs).get_factors(longitude, latitude)
    stretch = max(abs(factors.meridional_scale - 1), abs(factors.parallel_scale - 1))
    if not stretch < MAX_STRETCH:
        raise InputError(
            f"{where}: CRS {crs.name!r} stretches distances by {stretch:.0%} here: {advice}"
        )
    if stretch < STRETCHED:
        return ""
    return (
        f"{where}: CRS {crs.name!r} stretches distances by {stretch:.2%} here, which no interval "
        f"includes: wavelengths and heights are off by as much; {advice}"
    )
