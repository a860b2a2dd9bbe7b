"""Ripple products of a survey with one pixel, polygon or table row per cell."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from affine import Affine

from sasmap.catalogue import CATALOGUE, Product
from sasmap.io.files import written_whole
from sasmap.io.geopackage import write_layer
from sasmap.io.rasters import Category, Layer, float_layer, write_cog
from sasmap.products.cell_values import CellResult, attributes, raster
from sasmap.products.colours import QUALITY_COLOURS
from sasmap.ripples.posterior import Quality

Results = Mapping[tuple[int, int], CellResult]


def write_ripple_rasters(
    folder: Path,
    results: Results,
    shape: tuple[int, int],
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    scratch: Path,
) -> list[Path]:
    """Write every raster of the catalogue that has one pixel per cell.

    Parameters
    ----------
    folder : Path
    results : mapping of (row, column) to CellResult
    shape : tuple of int
        Rows and columns of the grid.
    transform : Affine
    crs : str
        WKT.
    tags : mapping of str to str
    scratch : Path

    Returns
    -------
    list of Path
    """
    written = []
    for product in CATALOGUE:
        if product.kind not in ("cells", "cell codes"):
            continue
        values = raster(product.file, results, len(product.bands), shape)
        written.append(folder / product.file)
        layer = _layer(product, tags)
        if product.kind == "cell codes":
            values = np.nan_to_num(values)
        write_cog(written[-1], values, layer, transform, crs, scratch)
    return written


def _layer(product: Product, tags: Mapping[str, str]) -> Layer:
    texts, units = [b.text for b in product.bands], [b.unit for b in product.bands]
    if product.kind == "cells":
        return float_layer(texts, units, tags)
    if product.file != "ripple_quality.tif":
        return Layer(texts, units, 255, "uint8", {}, tags)
    categories = {int(q): Category(q.label, (*c, 255)) for q, c in QUALITY_COLOURS.items()}
    categories[int(Quality.NO_DATA)] = Category(Quality.NO_DATA.label, (0, 0, 0, 0))
    return Layer(texts, units, 0, "uint8", categories, tags)


def write_cells(
    folder: Path, results: Results, transform: Affine, crs: str, size: float, scratch: Path
) -> list[Path]:
    """Write ripple_cells.gpkg, one polygon per cell, and ripple_cells.csv, one line per cell.

    Parameters
    ----------
    folder : Path
    results : mapping of (row, column) to CellResult
    transform : Affine
        Affine of rasters with one pixel per cell.
    crs : str
        WKT.
    size : float
        Side of a cell, m; larger than that pixel where cells overlap.
    scratch : Path

    Returns
    -------
    list of Path
    """
    columns: dict[str, list[Any]] = {
        "row": [row for row, _ in results],
        "column": [column for _, column in results],
        **attributes(list(results.values())),
    }
    squares = [_square(transform, row, column, size) for row, column in results]
    path = folder / "ripple_cells.gpkg"
    arrays = {name: _array(values) for name, values in columns.items()}
    write_layer(path, "cells", "Polygon", squares, arrays, crs, scratch)
    centres = [square.centroid for square in squares]
    places = {"x": [c.x for c in centres], "y": [c.y for c in centres]}
    del columns["label"]
    table = folder / "ripple_cells.csv"
    _write_table(
        table, {"row": columns["row"], "column": columns["column"], **places, **columns}, scratch
    )
    return [path, table]


def _square(transform: Affine, row: int, column: int, size: float) -> Any:
    margin = 0.5 * (size / transform.a - 1)  # pixels
    left, top = transform @ (column - margin, row - margin)
    right, bottom = transform @ (column + 1 + margin, row + 1 + margin)
    return shapely.box(left, bottom, right, top)


def _array(values: list[Any]) -> Any:
    if values and isinstance(values[0], str):
        return np.array(values, object)
    return np.array(values, np.int32 if values and isinstance(values[0], int) else np.float64)


def _write_table(path: Path, columns: Mapping[str, list[Any]], scratch: Path) -> None:
    """Write columns as CSV; unknown numbers are left empty."""
    with (
        written_whole(path, scratch) as part,
        part.open("w", encoding="utf-8", newline="") as file,
    ):
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        for line in zip(*columns.values(), strict=True):
            table.writerow(_cell(value) for value in line)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.10g}" if np.isfinite(value) else ""
    return str(value)
