"""Sediment products of a survey: classes, confidence, boundaries and areas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize, shapes
from shapely.geometry import shape

from sasmap.io.geopackage import Area, Feature, write_areas, write_boundaries
from sasmap.io.rasters import Category, Layer, float_layer, write_large_cog
from sasmap.products.colours import class_colour
from sasmap.sediments.mapping import Line

# Rows that are read at once, and pixels of a corner that an outline cuts off.
STRIPE, SMOOTHED = 1024, 2.0


def write_sediments(
    folder: Path,
    label: Any,
    confidence: Any,
    rippled: Any,
    lines: Sequence[Line],
    names: Sequence[str],
    codes: Sequence[str],
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    scratch: Path,
) -> list[Path]:
    """Write sediment_class.tif, _confidence.tif, _boundaries.gpkg and _areas.gpkg.

    Parameters
    ----------
    folder : Path
    label : array of uint8 (rows, columns)
        1 for the first class, 0 for nodata; read in stripes, as is `confidence`.
    confidence : array (rows, columns)
    rippled : array of uint8 (rows, columns)
        1 where the floor is rippled; read in stripes.
    lines : sequence of Line
    names, codes : sequence of str
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
    written.append(folder / "sediment_areas.gpkg")
    found = areas_of(written[0], confidence, rippled, names, codes)
    write_areas(written[3], found, crs, scratch)
    return written


def areas_of(
    classes: Path, confidence: Any, rippled: Any, names: Sequence[str], codes: Sequence[str]
) -> list[Area]:
    """Outline the areas of a map so that neighbours share their outlines point by point.

    Parameters
    ----------
    classes : Path
        Raster of classes, on the map's lattice.
    confidence, rippled : array (rows, columns)
        Read in stripes.
    names, codes : sequence of str

    Returns
    -------
    list of Area
        Row by row of their first pixel.
    """
    with rasterio.open(classes) as source:
        transform, width, height = source.transform, source.width, source.height
        found = [
            (shape(g), int(v))
            for g, v in shapes(rasterio.band(source, 1), connectivity=4, transform=transform)
            if v > 0
        ]
    if not found:
        return []

    def pixels(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.rint(np.column_stack(~transform @ (points[:, 0], points[:, 1]))))

    # in pixels: whole numbers, which meet exactly
    outlines = list(shapely.transform([g for g, _ in found], pixels))
    total = np.zeros((3, len(found)))
    tree = shapely.STRtree(outlines)
    for top in range(0, height, STRIPE):
        rows = slice(top, min(top + STRIPE, height))
        here = tree.query(shapely.box(0, top, width, rows.stop))
        total += _sums(outlines, here, top, confidence[rows], rippled[rows])
    pixel = abs(transform.determinant)
    # where three areas meet, each has to have the point; then a staircase of pixels is no outline:
    # corners of less than two pixels go, on both sides alike
    smooth = shapely.coverage_simplify(shapely.segmentize(outlines, 1.0), SMOOTHED**0.5)
    smooth = shapely.transform(smooth, lambda p: np.column_stack(transform @ (p[:, 0], p[:, 1])))
    return [
        Area(
            outline,
            k,
            names[k - 1],
            codes[k - 1],
            float(count * pixel),
            float(np.clip(sure / max(count, 1), 0, 1)),
            bool(wavy > 0.5 * count),
        )
        for outline, (_, k), count, sure, wavy in zip(smooth, found, *total, strict=True)
    ]


def _sums(
    outlines: Sequence[Any],
    here: NDArray[np.int64],
    top: int,
    confidence: NDArray[np.floating],
    rippled: NDArray[np.uint8],
) -> NDArray[np.float64]:
    """Pixels, confidence and rippled pixels of each area (3, areas) in a stripe."""
    total = np.zeros((3, len(outlines)))
    if here.size:
        marked = [(outlines[i], int(i) + 1) for i in np.sort(here)]
        place = Affine.translation(0, top)
        number = rasterize(marked, confidence.shape, transform=place, dtype="int32").ravel()
        for row, weight in zip(total, (None, np.nan_to_num(confidence), rippled), strict=True):
            w = None if weight is None else weight.ravel()
            row += np.bincount(number, w, minlength=len(outlines) + 1)[1:]
    return total


def _feature(line: Line, names: Sequence[str], transform: Affine, step: float) -> Feature:
    points = line.boundary.points
    if line.boundary.closed:
        points = np.vstack([points, points[:1]])
    column, row = points[:, 1] + 0.5, points[:, 0] + 0.5
    x = transform.c + transform.a * column + transform.b * row
    y = transform.f + transform.d * column + transform.e * row
    sd = step * float(np.sqrt(np.mean(line.boundary.sd**2)))
    return Feature(np.column_stack([x, y]), names[line.left - 1], names[line.right - 1], sd)
