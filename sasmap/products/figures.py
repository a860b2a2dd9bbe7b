"""Pictures of the report, as data addresses."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyogrio
import rasterio
import shapely
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sasmap.products.colours import RAMPS, Colour
from sasmap.ripples.fusion import FusedCell
from sasmap.sediments.fitting import Law

# Pixels a side, at most, of the rasters in a picture.
MOST = 900
DPI = 100
INK = "#333333"


class Picture(NamedTuple):
    """A picture with its caption; `source` is a data address."""

    source: str
    caption: str


def encoded(figure: Figure) -> str:
    """Return a figure as a data address."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _read(path: Path) -> tuple[NDArray[Any], tuple[float, float, float, float], Any]:
    """Band 1, thinned and masked, the edges (left, right, bottom, top), and the colour table."""
    with rasterio.open(path) as source:
        factor = max(1, -(-max(source.shape) // MOST))
        shape = (max(source.height // factor, 1), max(source.width // factor, 1))
        values = source.read(1, out_shape=shape, masked=True)
        box = source.bounds
        table = source.colormap(1) if source.dtypes[0] == "uint8" else None
    return values, (box.left, box.right, box.bottom, box.top), table


def _frame(box: tuple[float, float, float, float]) -> tuple[Figure, Axes]:
    width, height = box[1] - box[0], box[3] - box[2]
    tall = float(np.clip(6.0 * height / width, 2.2, 8.0))
    figure = Figure(figsize=(7.0, tall + 0.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set(
        xlim=box[:2], ylim=box[2:], aspect="equal", xlabel="easting (m)", ylabel="northing (m)"
    )
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    _scale_bar(axes, box)
    return figure, axes


def _scale_bar(axes: Axes, box: tuple[float, float, float, float]) -> None:
    """Draw a bar of a round length in the lower left corner."""
    width, height = box[1] - box[0], box[3] - box[2]
    rough = 0.25 * width
    step = 10 ** np.floor(np.log10(rough))
    length = float(step * max(v for v in (1, 2, 5) if v * step <= rough))
    x, y = box[0] + 0.04 * width, box[2] + 0.05 * height
    axes.plot([x, x + length], [y, y], color="white", lw=5, solid_capstyle="butt", zorder=5)
    axes.plot([x, x + length], [y, y], color="black", lw=2.5, solid_capstyle="butt", zorder=6)
    text = f"{length:g} m"
    label = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
    axes.text(x, y + 0.02 * height, text, fontsize=7, va="bottom", bbox=label, zorder=6)


def map_of(path: Path) -> Picture:
    """Draw a continuous raster.

    Parameters
    ----------
    path : Path
        A product of :data:`sasmap.products.colours.RAMPS`.

    Returns
    -------
    Picture
    """
    ramp = RAMPS[path.name]
    values, box, _ = _read(path)
    figure, axes = _frame(box)
    low, high = ramp.limits or (None, None)
    image = axes.imshow(
        values, extent=box, cmap=ramp.name, vmin=low, vmax=high, interpolation="nearest"
    )
    bar = figure.colorbar(image, ax=axes, shrink=0.85)
    bar.set_label(f"{ramp.title} ({ramp.unit})" if ramp.unit else ramp.title, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return Picture(encoded(figure), f"{ramp.title}. White: none ({path.name}).")


def classes_of(path: Path, names: Mapping[int, tuple[str, Colour]], caption: str) -> Picture:
    """Draw a class raster with its legend; over sediments their boundaries.

    Parameters
    ----------
    path : Path
    names : mapping of int to (str, colour)
    caption : str

    Returns
    -------
    Picture
    """
    values, box, _ = _read(path)
    figure, axes = _frame(box)
    palette = np.ones((256, 3))
    for value, (_, colour) in names.items():
        palette[value] = np.array(colour) / 255
    axes.imshow(
        np.ma.filled(values, 0), extent=box, cmap=ListedColormap(palette), vmin=0, vmax=255,
        interpolation="nearest",
    )  # fmt: skip
    lines = path.with_name("sediment_boundaries.gpkg")
    if path.name.startswith("sediment") and lines.exists():
        _, _, shapes, _ = pyogrio.raw.read(lines)
        for shape in shapely.from_wkb(shapes):
            axes.plot(*shape.xy, color="black", lw=0.8)
    shown = [v for v in names if (values == v).any()]
    handles = [Patch(color=palette[v], label=names[v][0]) for v in shown]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=7)
    return Picture(encoded(figure), caption)


def cell_figure(
    clip: xr.DataArray,
    model: NDArray[Any] | None,
    draws: xr.Dataset,
    chain: FusedCell,
    looks: Sequence[str],
) -> str:
    """Draw a cell: clip beside model, traces, posterior, growth over passes.

    Parameters
    ----------
    clip : DataArray (y, x)
    model : ndarray (rows, columns) or None
    draws : Dataset (chain, draw)
        With ``frequency`` and ``height``; empty where nothing was sampled.
    chain : FusedCell
    looks : sequence of str

    Returns
    -------
    str
        Data address.
    """
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 4)
    values = clip.values
    top = float(np.nanquantile(values, 0.99))
    pictures = [("clip", values), ("model", model)]
    for k, (title, image) in enumerate(pictures):
        axes = figure.add_subplot(grid[0, 2 * k : 2 * k + 2])
        axes.set_title(title, fontsize=9)
        axes.set(xticks=[], yticks=[])
        if image is None or not np.isfinite(image).any():
            axes.text(
                0.5, 0.5, "no model: nothing was sampled", ha="center", va="center", fontsize=8
            )
            continue
        axes.imshow(image, cmap="gray", vmin=0, vmax=top, interpolation="nearest", aspect="auto")
    if draws.sizes:
        for k, (name, label) in enumerate((("frequency", "f (cycles/m)"), ("height", "A_H (m)"))):
            axes = figure.add_subplot(grid[1, k])
            axes.plot(draws[name].values.T, lw=0.4)
            _plain(axes, "draw", label, f"trace of {label.split()[0]}")
        axes = figure.add_subplot(grid[1, 2])
        axes.plot(draws.frequency.values.ravel(), draws.height.values.ravel(), ".", ms=1, color=INK)
        _plain(axes, "f (cycles/m)", "A_H (m)", "posterior of this look")
    _growth(figure.add_subplot(grid[1, 3]), chain, looks)
    return encoded(figure)


def _plain(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=6)
    axes.locator_params(nbins=4)
    axes.ticklabel_format(useOffset=False)


def _growth(axes: Axes, chain: FusedCell, looks: Sequence[str]) -> None:
    """Intervals of f and A_H after each pass, over the last mean."""
    final = chain.final.mean
    for i, (name, colour) in enumerate((("f", "#0072b2"), ("A_H", "#d55e00"))):
        known = [k for k, p in enumerate(chain.posteriors) if np.isfinite(p.mean[i])]
        middle = [chain.posteriors[k].mean[i] / final[i] for k in known]
        low = [(chain.posteriors[k].mean[i] - chain.posteriors[k].q05[i]) / final[i] for k in known]
        high = [
            (chain.posteriors[k].q95[i] - chain.posteriors[k].mean[i]) / final[i] for k in known
        ]
        error = np.maximum([low, high], 0.0) if known else None
        place = np.array(known, float) + 0.12 * (2 * i - 1)
        axes.errorbar(place, middle, error, fmt="o", ms=3, color=colour, label=name, capsize=2)
    axes.set_xticks(range(len(looks)), looks, rotation=30, ha="right", fontsize=6)
    axes.set_ylabel("over the final mean", fontsize=8)
    axes.set_title("90 % interval after each pass", fontsize=9)
    axes.tick_params(labelsize=6)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(fontsize=7)


def class_figure(
    histograms: Sequence[Mapping[str, Any]],
    laws: Sequence[Law],
    names: Mapping[int, tuple[str, Colour]],
) -> Picture:
    """Draw the amplitudes of each class with the density fitted to them.

    Parameters
    ----------
    histograms : sequence of mapping
        Of each class: ``edges`` and ``counts``.
    laws : sequence of Law
    names : mapping of int to (str, colour)
        From number 1.

    Returns
    -------
    Picture
    """
    across = min(len(laws), 3)
    down = -(-len(laws) // across)
    figure = Figure(figsize=(3.3 * across, 2.4 * down), layout="constrained")
    for k, (histogram, law) in enumerate(zip(histograms, laws, strict=True)):
        axes = figure.add_subplot(down, across, k + 1)
        edges, counts = np.array(histogram["edges"]), np.array(histogram["counts"], float)
        density = counts / max(counts.sum(), 1) / np.diff(edges)
        name, colour = names[k + 1]
        axes.stairs(density, edges, fill=True, color=np.array(colour) / 255, alpha=0.7)
        x = np.linspace(edges[0], edges[-1], 300)[1:]
        axes.plot(x, np.exp(law.log_density(x)), color="black", lw=1)
        _plain(axes, "amplitude, flattened", "density", f"{name}: {law.family.replace('_', ' ')}")
    caption = (
        "Amplitudes of each class on the map, less gain and trend, and the law fitted to them."
    )
    return Picture(encoded(figure), caption)
