"""Parts common to all figures of the report: encoding, map frames, scale bars."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rasterio.enums import Resampling

# Maximum side in pixels of the rasters in a figure, and its resolution: these bound the report's
# size (a choice).
MOST = 1000
DPI = 130
INK = "#333333"
Box = tuple[float, float, float, float]


class Picture(NamedTuple):
    """A figure with its caption; `source` is a data URL."""

    source: str
    caption: str


def encoded(figure: Figure) -> str:
    """Encode a figure as a data URL."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def read_thinned(path: Path, averaged: bool = False) -> tuple[NDArray[Any], Box]:
    """Band 1 of a raster, thinned and masked, and its edges (left, right, bottom, top), m."""
    with rasterio.open(path) as source:
        factor = max(1, -(-max(source.shape) // MOST))
        shape = (max(source.height // factor, 1), max(source.width // factor, 1))
        how = Resampling.average if averaged else Resampling.nearest
        values = source.read(1, out_shape=shape, masked=True, resampling=how)
        box = source.bounds
    return values, (box.left, box.right, box.bottom, box.top)


def map_frame(box: Box, width: float = 7.0) -> tuple[Figure, Axes]:
    """Return a figure with axes that show a box of the map, to scale.

    Parameters
    ----------
    box : tuple of float
        Left, right, bottom, top, m.
    width : float
        Of the figure, inches.

    Returns
    -------
    Figure, Axes
    """
    across, down = box[1] - box[0], box[3] - box[2]
    tall = float(np.clip(0.8 * width * down / across, 0.3 * width, 1.05 * width))
    figure = Figure(figsize=(width, tall + 0.7), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=box[:2], ylim=box[2:], aspect="equal")
    axes.set_xlabel("easting (m)", fontsize=8)
    axes.set_ylabel("northing (m)", fontsize=8)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    scale_bar(axes, box)
    return figure, axes


def scale_bar(axes: Axes, box: Box) -> None:
    """Draw a bar of a round length in the lower left corner."""
    width, height = box[1] - box[0], box[3] - box[2]
    length = round_length(0.3 * width)
    x, y = box[0] + 0.04 * width, box[2] + 0.05 * height
    axes.plot([x, x + length], [y, y], color="white", lw=5, solid_capstyle="butt", zorder=8)
    axes.plot([x, x + length], [y, y], color="black", lw=2.5, solid_capstyle="butt", zorder=9)
    label = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
    axes.text(x, y + 0.025 * height, f"{length:g} m", fontsize=7, va="bottom", bbox=label, zorder=9)


def round_length(most: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that does not exceed a length."""
    step = 10.0 ** np.floor(np.log10(most))
    return float(step * max(v for v in (1, 2, 5) if v * step <= most * (1 + 1e-9)))


def plain(axes: Axes, x: str, y: str, title: str) -> None:
    """Label small axes."""
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    axes.ticklabel_format(useOffset=False)
