"""The page of all products, made from the catalogue so that it cannot drift."""

from __future__ import annotations

from sasmap.catalogue import CATALOGUE

_HEAD = """# Products

Made from the program's own catalogue by
`python -m sasmap.products.reference > docs/products.md`. Rasters are Cloud-Optimized GeoTIFF; their
bands bear these descriptions and units.
"""
_KINDS = {
    "cells": "raster, a pixel a cell",
    "cell codes": "raster of codes, a pixel a cell",
    "pixels": "raster, full resolution",
    "pixel codes": "raster of codes, full resolution",
    "polygons": "GeoPackage of polygons",
    "lines": "GeoPackage of lines",
    "file": "",
}


def catalogue_reference() -> str:
    """Return the page of all products, in Markdown."""
    lines = [_HEAD, "| file | kind | what it holds | bands (unit) |", "|---|---|---|---|"]
    for p in CATALOGUE:
        bands = "; ".join(b.text for b in p.bands)
        if len(p.bands) == 4:  # a quantity and its statistics
            quantity = p.bands[0].text.removesuffix(", mean")
            bands = f"{quantity}: mean, standard deviation, 5 % and 95 % quantile"
        bands += f" ({p.bands[0].unit})" if p.bands and p.bands[0].unit else ""
        lines.append(f"| `{p.file}` | {_KINDS[p.kind]} | {p.sentence} | {bands} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(catalogue_reference(), end="")
