"""Outlines of rippled sea floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from affine import Affine
from scipy.ndimage import gaussian_filter, label
from skimage.measure import find_contours

from sasmap.arrays import BoolArray, FloatArray
from sasmap.io.geopackage import write_layer

LAYER = "extent"
# Smoothed weight of the observed places above which an unobserved place takes the value of its
# surroundings: a hole (1 in its middle when small), not the edge of the coverage (0.5).
SEEN = 0.6


class Outline(NamedTuple):
    """A rippled area on the map.

    Attributes
    ----------
    polygon : shapely.Polygon
    wavelength : float
        Wavelength of its ripples, m.
    """

    polygon: shapely.Polygon
    wavelength: float


def outlines(
    probability: FloatArray, own: BoolArray, wavelength: float, transform: Affine
) -> list[Outline]:
    """Trace rippled areas on a mosaic of cells.

    Parameters
    ----------
    probability : ndarray (rows, columns)
        Probability that a place is rippled; NaN where it was not observed.
    own : ndarray of bool (rows, columns)
        Places of cells in which ripples were found: an area must reach one of them.
    wavelength : float
        m; outlines are smooth over a quarter of it, and no area is smaller than its square.
    transform : Affine
        Of the mosaic.

    Returns
    -------
    list of Outline
    """
    step = float(np.sqrt(abs(transform.determinant)))
    smooth = _smoothed(np.pad(probability, 1, constant_values=np.nan), 0.25 * wavelength / step)
    smooth[[0, -1]] = smooth[:, [0, -1]] = 0.0
    areas, count = label(smooth > 0.5)
    reached = np.zeros(count + 1, bool)
    reached[np.unique(areas[np.pad(own, 1)])] = True
    reached[0] = False
    smooth = np.where((areas > 0) & ~reached[areas], 0.0, smooth)
    shells: list[shapely.Polygon] = []
    holes: list[shapely.Polygon] = []
    for ring in find_contours(smooth, 0.5):
        if len(ring) < 4:
            continue
        row, column = ring[:, 0] - 0.5, ring[:, 1] - 0.5  # from the mosaic's corner, less the pad
        x = transform.c + transform.a * column + transform.b * row
        y = transform.f + transform.d * column + transform.e * row
        polygon = shapely.Polygon(np.column_stack([x, y]))
        if polygon.area >= wavelength**2:
            (holes if _around_low(ring, smooth) else shells).append(polygon)
    return [Outline(_without(shell, holes), wavelength) for shell in shells]


def _smoothed(values: FloatArray, sd: float) -> FloatArray:
    """Gaussian mean over observed places; 0 where there is none."""
    seen = np.isfinite(values)
    weight = gaussian_filter(seen.astype(float), sd, mode="constant")
    total = gaussian_filter(np.where(seen, values, 0.0), sd, mode="constant")
    mean = total / np.maximum(weight, 1e-9)
    return np.where(seen | (weight > SEEN), mean, 0.0)


def _around_low(ring: FloatArray, field: FloatArray) -> bool:
    """Whether a closed contour encloses lower values: scikit-image keeps those on its left."""
    row, column = ring[:, 0], ring[:, 1]
    return bool((row[:-1] * column[1:] - row[1:] * column[:-1]).sum() > 0)


def _without(shell: shapely.Polygon, holes: Sequence[shapely.Polygon]) -> shapely.Polygon:
    """Cut the holes that lie in a shell out of it."""
    within = [h.exterior.coords for h in holes if shell.contains(h)]
    return shapely.Polygon(shell.exterior.coords, within)


def write_extent(path: Path, found: Sequence[Outline], crs: str, scratch: Path) -> None:
    """Write layer ``extent`` of a GeoPackage: polygons with their area and wavelength.

    Parameters
    ----------
    path : Path
    found : sequence of Outline
    crs : str
        WKT.
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    shapes = [shapely.normalize(o.polygon) for o in found]
    fields = {
        "area": np.array([s.area for s in shapes], np.float64),
        "wavelength": np.array([o.wavelength for o in found], np.float64),
    }
    write_layer(path, LAYER, "Polygon", shapes, fields, crs, scratch)
