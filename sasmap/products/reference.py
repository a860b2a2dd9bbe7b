"""The page of all products, generated from the catalogue so that it stays correct."""

from __future__ import annotations

from sasmap.catalogue import CATALOGUE

_HEAD = """# Products

Generated from the program's catalogue by
`python -m sasmap.products.reference > docs/products.md`. Rasters are Cloud-Optimized GeoTIFFs whose
bands carry these descriptions and units.
"""
_KINDS = {
    "cells": "raster, one pixel per cell",
    "cell codes": "raster of codes, one pixel per cell",
    "pixels": "raster, full resolution",
    "pixel codes": "raster of codes, full resolution",
    "polygons": "GeoPackage of polygons",
    "lines": "GeoPackage of lines",
    "file": "",
}


def catalogue_reference() -> str:
    """Return the page of all products, in Markdown."""
    lines = [_HEAD, "| file | kind | contents | bands (unit) |", "|---|---|---|---|"]
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
