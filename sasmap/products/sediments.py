"""Sediment products of a survey: classes, confidence, boundaries and areas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import rasterio
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize, shapes
from rasterio.windows import Window
from shapely.affinity import translate
from shapely.geometry import shape

from sasmap.arrays import FloatArray, IntArray
from sasmap.io.geopackage import Area, Feature, write_areas, write_boundaries
from sasmap.io.rasters import Category, Layer, float_layer, write_large_cog
from sasmap.products.colours import class_colour
from sasmap.sediments.mapping import Line

# Rows read at once (bounds memory), and area in pixels of a corner that an outline may cut off:
# less than a step of the pixel staircase.
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
        1 for the first class, 0 for nodata; read in stripes, like `confidence`.
    confidence : array (rows, columns)
    rippled : array of uint8 (rows, columns)
        1 where the floor is rippled; read in stripes.
    lines : sequence of Line
    names, codes : sequence of str
        Names and codes of the classes.
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
    found = areas_of(label, confidence, rippled, names, codes, transform, scratch)
    write_areas(written[3], found, crs, scratch)
    return written


def areas_of(
    label: Any,
    confidence: Any,
    rippled: Any,
    names: Sequence[str],
    codes: Sequence[str],
    transform: Affine,
    scratch: Path,
) -> list[Area]:
    """Trace the areas of a map so that neighbours share their outlines point by point.

    The rippled parts of a class are separate areas.

    Parameters
    ----------
    label, confidence, rippled : array (rows, columns)
        Read in stripes.
    names, codes : sequence of str
    transform : Affine
    scratch : Path

    Returns
    -------
    list of Area
        In the order in which they end, from the top.
    """
    height, width = label.shape
    found = _outlined(label, rippled, len(names), scratch)
    if not found:
        return []

    outlines = [outline for outline, _ in found]
    total = np.zeros((2, len(found)))
    tree = shapely.STRtree(outlines)
    for top in range(0, height, STRIPE):
        rows = slice(top, min(top + STRIPE, height))
        here = tree.query(shapely.box(0, top, width, rows.stop))
        total += _sums(outlines, here, top, confidence[rows])
    pixel = abs(transform.determinant)
    # where three areas meet, each must contain the point; then the staircase of pixels is smoothed:
    # corners of less than two pixels are cut, equally on both sides
    smooth = shapely.coverage_simplify(shapely.segmentize(outlines, 1.0), SMOOTHED**0.5)
    smooth = shapely.transform(smooth, lambda p: np.column_stack(transform @ (p[:, 0], p[:, 1])))
    return [
        Area(
            outline,
            k // 2,
            names[k // 2 - 1],
            codes[k // 2 - 1],
            float(count * pixel),
            float(np.clip(sure / max(count, 1), 0, 1)),
            bool(k % 2),
        )
        for outline, (_, k), count, sure in zip(smooth, found, *total, strict=True)
    ]


def _outlined(label: Any, rippled: Any, count: int, scratch: Path) -> list[tuple[Any, int]]:
    """Outlines in whole pixels, which meet exactly, and codes: twice the class (+ 1 if rippled)."""
    height, width = label.shape
    dtype = "uint8" if count < 128 else "uint16"
    profile = {"driver": "GTiff", "dtype": dtype, "count": 1}
    scratch.mkdir(parents=True, exist_ok=True)
    draft = scratch / "areas.tif"
    try:
        # a dummy georeference, since GDAL warns about a raster without one
        place = Affine.translation(0.0, 1.0)
        with rasterio.open(
            draft, "w", height=height, width=width, transform=place, **profile
        ) as target:
            for top in range(0, height, STRIPE):
                rows = slice(top, min(top + STRIPE, height))
                both = label[rows].astype(dtype) * 2 + (rippled[rows] > 0)
                both[label[rows] == 0] = 0
                target.write(both, 1, window=Window(0, top, width, len(both)))
        with rasterio.open(draft) as source:
            band = rasterio.band(source, 1)
            found = [
                (translate(shape(g), 0.0, -1.0), int(v))
                for g, v in shapes(band, connectivity=4, transform=place)
                if v > 1
            ]
    finally:
        draft.unlink(missing_ok=True)
    return found


def _sums(
    outlines: Sequence[Any],
    here: IntArray,
    top: int,
    confidence: NDArray[np.floating],
) -> FloatArray:
    """Sum pixels and their confidence over each area (2, areas) in a stripe."""
    total = np.zeros((2, len(outlines)))
    if here.size:
        marked = [(outlines[i], int(i) + 1) for i in np.sort(here)]
        place = Affine.translation(0, top)
        number = rasterize(marked, confidence.shape, transform=place, dtype="int32")
        _add_up(number, confidence, total)
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_up(number, confidence, total):  # type: ignore[no-untyped-def]
    """Add pixels and their confidence, where known, to the totals of their numbers (from 1)."""
    for r in range(number.shape[0]):
        for c in range(number.shape[1]):
            k = number[r, c] - 1
            if k >= 0:
                total[0, k] += 1
                if np.isfinite(confidence[r, c]):
                    total[1, k] += confidence[r, c]


def _feature(line: Line, names: Sequence[str], transform: Affine, step: float) -> Feature:
    points = line.boundary.points
    if line.boundary.closed:
        points = np.vstack([points, points[:1]])
    column, row = points[:, 1] + 0.5, points[:, 0] + 0.5
    x = transform.c + transform.a * column + transform.b * row
    y = transform.f + transform.d * column + transform.e * row
    sd = step * float(np.sqrt(np.mean(line.boundary.sd**2)))
    return Feature(np.column_stack([x, y]), names[line.left - 1], names[line.right - 1], sd)
