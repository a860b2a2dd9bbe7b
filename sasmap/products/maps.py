"""Maps of the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import shapely
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.catalogue import BY_FILE
from sasmap.products.colours import Colour
from sasmap.products.figures import Picture, encoded, map_frame, read_thinned
from sasmap.products.ranges import GAMMA, digits_for, has_content, padded_range, range_of

Codes = Mapping[int, tuple[str, Colour]]

# Opacity of sediments over the mosaic, and longest ripple symbol relative to a cell's side (a
# choice).
VEIL, LONGEST = 0.45, 0.8


def overview(folder: Path, sediments: Codes) -> Picture | None:
    """Draw the overview map: mosaic, sediments, boundaries and ripples.

    Parameters
    ----------
    folder : Path
        Of the products; those that exist are drawn.
    sediments : mapping of int to (str, colour)

    Returns
    -------
    Picture or None
        None without a mosaic.
    """
    path = folder / "mosaic.tif"
    if not path.exists() or not has_content(path):
        return None
    values, box = read_thinned(path, averaged=True)
    figure, axes = map_frame(box, width=7.4)
    low, high = range_of(path)
    grey = PowerNorm(1 / GAMMA, low, high)
    axes.imshow(values, extent=box, cmap="gray", norm=grey, interpolation="nearest")
    told = ["Sonar mosaic"]
    if _draw_sediments(folder, axes, figure, sediments, VEIL):
        told.append("sediments and their boundaries")
    if _draw_ripples(folder / "ripple_cells.gpkg", axes, figure):
        told.append(
            "ripples as lines along the crests, longer for longer wavelengths, dotted where flagged"
        )
    return Picture(encoded(figure), "; ".join(told) + ".")


def map_of(path: Path) -> Picture:
    """Draw a raster of numbers.

    Parameters
    ----------
    path : Path
        A product of the catalogue with a ramp, and with content.

    Returns
    -------
    Picture
    """
    product = BY_FILE[path.name]
    assert product.ramp is not None
    values, box = read_thinned(path)
    figure, axes = map_frame(box, width=5.2)
    low, high = range_of(path)
    image = axes.imshow(
        values, extent=box, cmap=product.ramp.name, vmin=low, vmax=high, interpolation="nearest"
    )
    bar = figure.colorbar(image, ax=axes, shrink=0.85)
    title = f"{product.title} ({product.unit})" if product.unit else product.title
    bar.set_label(title, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.ax.ticklabel_format(useOffset=False)
    return Picture(encoded(figure), f"{product.title}. White: none.")


def codes_of(path: Path, names: Codes, caption: str) -> Picture:
    """Draw a raster of codes with its legend; for sediments also their boundaries.

    Parameters
    ----------
    path : Path
    names : mapping of int to (str, colour)
    caption : str

    Returns
    -------
    Picture
    """
    values, box = read_thinned(path)
    figure, axes = map_frame(box, width=5.2)
    axes.imshow(_painted(values, names, 1.0), extent=box, interpolation="nearest")
    if path.name == "sediment_class.tif":
        _draw_boundaries(path.with_name("sediment_boundaries.gpkg"), axes)
    _legend(figure, values, names)
    return Picture(encoded(figure), caption)


def _painted(values: NDArray[Any], names: Codes, opacity: float) -> FloatArray:
    palette = np.zeros((256, 4))
    for value, (_, colour) in names.items():
        palette[value] = (*(np.array(colour) / 255), opacity)
    return np.asarray(palette[np.ma.filled(values, 0)])


def _legend(figure: Figure, values: NDArray[Any], names: Codes) -> None:
    shown = [v for v in names if (values == v).any()]
    handles = [Patch(color=np.array(names[v][1]) / 255, label=names[v][0]) for v in shown]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=7)


def _draw_sediments(folder: Path, axes: Axes, figure: Figure, names: Codes, opacity: float) -> bool:
    path = folder / "sediment_class.tif"
    if not path.exists() or not names or not has_content(path):
        return False
    values, box = read_thinned(path)
    axes.imshow(_painted(values, names, opacity), extent=box, interpolation="nearest")
    _draw_boundaries(folder / "sediment_boundaries.gpkg", axes)
    _legend(figure, values, names)
    return True


def _draw_boundaries(path: Path, axes: Axes) -> None:
    if path.exists():
        _, _, shapes, _ = pyogrio.raw.read(path)
        for shape in shapely.from_wkb(shapes):
            axes.plot(*shape.xy, color="black", lw=0.8)


def _draw_ripples(path: Path, axes: Axes, figure: Figure) -> bool:
    """Draw a line along the crests of each rippled cell; return whether there is any."""
    if not path.exists():
        return False
    meta, _, shapes, arrays = pyogrio.raw.read(path)
    columns = dict(zip(meta["fields"], arrays, strict=True))
    known = np.isfinite(columns["crest_to_trough_mean"]) & np.isfinite(columns["azimuth_mean"])
    if not known.any():
        return False
    squares = shapely.from_wkb(shapes[known])
    box = shapely.bounds(squares)
    centres = np.stack([box[:, [0, 2]].mean(axis=1), box[:, [1, 3]].mean(axis=1)], axis=1)
    height = columns["crest_to_trough_mean"][known]
    length = columns["wavelength_mean"][known]
    half = 0.5 * LONGEST * float(np.ptp(box[0, [0, 2]])) * length / length.max()
    along = np.radians(columns["azimuth_mean"][known] + 90)
    step = half[:, None] * np.stack([np.sin(along), np.cos(along)], axis=1)
    ends = np.stack([centres - step, centres + step], axis=1)
    low, high = padded_range(height, columns["crest_to_trough_sd"][known])
    ramp = BY_FILE[path.name].ramp
    assert ramp is not None
    norm, colours = Normalize(low, high), colormaps[ramp.name]
    style = ["solid" if q == 1 else "dotted" for q in columns["quality"][known]]
    axes.add_collection(LineCollection(list(ends), colors="white", linewidths=3.4, zorder=5))
    axes.add_collection(
        LineCollection(
            list(ends), colors=colours(norm(height)), linewidths=2.2, linestyles=style, zorder=6
        )
    )
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, shrink=0.7)
    bar.set_label("ripple height, crest to trough (m)", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.ax.yaxis.set_major_formatter(f"{{x:.{digits_for(low, high)}f}}")
    return True
