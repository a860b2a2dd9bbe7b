"""Sediment products of a survey: classes, confidence and boundaries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine

from sasmap.io.geopackage import Feature, write_boundaries
from sasmap.io.rasters import Category, Layer, float_layer, write_large_cog
from sasmap.products.colours import class_colour
from sasmap.sediments.mapping import Line


def write_sediments(
    folder: Path,
    label: Any,
    confidence: Any,
    lines: Sequence[Line],
    names: Sequence[str],
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    scratch: Path,
) -> list[Path]:
    """Write sediment_class.tif, sediment_confidence.tif and sediment_boundaries.gpkg.

    Parameters
    ----------
    folder : Path
    label : array of uint8 (rows, columns)
        1 for the first class, 0 for nodata; read in stripes, as is `confidence`.
    confidence : array (rows, columns)
    lines : sequence of Line
    names : sequence of str
        Of the classes.
    transform : Affine
        Of the label's pixels.
    crs : str
        WKT.
    tags : mapping of str to str
    scratch : Path

    Returns
    -------
    list of Path
    """
    categories = {0: Category("no data", (0, 0, 0, 0))}
    for i, name in enumerate(names):
        categories[i + 1] = Category(name, (*class_colour(i), 255))
    written = [folder / "sediment_class.tif"]
    layer = Layer(["sediment class"], [""], 0, "uint8", categories, tags)
    write_large_cog(written[0], label, layer, transform, crs, scratch)
    written.append(folder / "sediment_confidence.tif")
    layer = float_layer(["probability of the class"], ["1"], tags)
    write_large_cog(written[1], confidence, layer, transform, crs, scratch)
    written.append(folder / "sediment_boundaries.gpkg")
    step = float(np.sqrt(abs(transform.determinant)))
    features = [_feature(line, names, transform, step) for line in lines]
    write_boundaries(written[2], features, crs, scratch)
    return written


def _feature(line: Line, names: Sequence[str], transform: Affine, step: float) -> Feature:
    points = line.boundary.points
    if line.boundary.closed:
        points = np.vstack([points, points[:1]])
    column, row = points[:, 1] + 0.5, points[:, 0] + 0.5
    x = transform.c + transform.a * column + transform.b * row
    y = transform.f + transform.d * column + transform.e * row
    sd = step * float(np.sqrt(np.mean(line.boundary.sd**2)))
    return Feature(np.column_stack([x, y]), names[line.left - 1], names[line.right - 1], sd)
