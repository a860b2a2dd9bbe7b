"""Figures of cells, of the gain from each pass, and of the sediments' amplitude laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from sasmap.passes.fusion import FusedCell
from sasmap.products.colours import Colour
from sasmap.products.figures import INK, Picture, encoded, plain, scale_bar
from sasmap.sediments.fitting import Law

# Maximum number of pass names that fit side by side under a figure.
FEW = 3
# Quantile of the clip's amplitudes that is drawn white (speckle has a long tail), and colour of the
# arrow along the look.
BRIGHT, LOOK = 0.97, "#ffd166"


class CellPicture(NamedTuple):
    """Images and draws of one look at a cell, north up.

    Attributes
    ----------
    clip : ndarray (rows, columns)
        Amplitude on the cell's own pixels, NaN where there is none.
    model : ndarray (rows, columns) or None
        Posterior-mean amplitude, possibly on fewer pixels.
    frequency, height : ndarray (chain, draw)
        Draws, thinned; empty where nothing was sampled.
    size : float
        Side of the cell, m.
    look : float
        Direction in which the sonar looked, degrees clockwise from grid north; NaN where unknown.
    """

    clip: NDArray[Any]
    model: NDArray[Any] | None
    frequency: NDArray[Any]
    height: NDArray[Any]
    size: float
    look: float


def cell_figure(cell: CellPicture, fused: FusedCell, swaths: Sequence[str]) -> str:
    """Draw a cell: clip beside model, traces, posterior, growth over passes.

    Parameters
    ----------
    cell : CellPicture
    fused : FusedCell
    swaths : sequence of str
        Labels.

    Returns
    -------
    str
        Data URL.
    """
    drawn = cell.frequency.size > 0
    figure = Figure(figsize=(7.4, 6.2 if drawn else 3.6), layout="constrained")
    grid = figure.add_gridspec(2 if drawn else 1, 6, height_ratios=[1.7, 1] if drawn else [1])
    top = float(np.nanquantile(cell.clip, BRIGHT)) if np.isfinite(cell.clip).any() else 1.0
    _image(figure.add_subplot(grid[0, :3]), cell, cell.clip, top, "clip")
    if cell.model is not None and np.isfinite(cell.model).any():
        _image(figure.add_subplot(grid[0, 3:]), cell, cell.model, top, "model")
    if not drawn:
        return encoded(figure)
    axes = figure.add_subplot(grid[1, :2])
    axes.plot(cell.height.T, lw=0.5)
    plain(axes, "draw (thinned)", "A_H (m)", "trace of each chain")
    axes = figure.add_subplot(grid[1, 2:4])
    axes.plot(cell.frequency.ravel(), cell.height.ravel(), ".", ms=1.5, color=INK)
    plain(axes, "f (cycles/m)", "A_H (m)", "posterior of this look")
    _growth(figure.add_subplot(grid[1, 4:]), fused, swaths)
    return encoded(figure)


def _image(axes: Axes, cell: CellPicture, image: NDArray[Any], top: float, title: str) -> None:
    box = (0.0, cell.size, 0.0, cell.size)
    axes.imshow(
        image, cmap="gray", vmin=0, vmax=top, interpolation="nearest", extent=box, aspect="equal"
    )
    axes.set_title(title, fontsize=9)
    axes.set(xticks=[], yticks=[], facecolor="#dde6ee")
    scale_bar(axes, box)
    if title == "clip" and np.isfinite(cell.look):
        turn = np.radians(cell.look)
        x, y, step = 0.87 * cell.size, 0.87 * cell.size, 0.09 * cell.size
        east, north = step * float(np.sin(turn)), step * float(np.cos(turn))
        axes.annotate(
            "",
            (x + east, y + north),
            (x - east, y - north),
            arrowprops={"arrowstyle": "-|>", "color": LOOK, "lw": 2, "mutation_scale": 14},
        )
        place = x, y - 0.12 * cell.size
        axes.text(*place, "look", ha="center", va="top", fontsize=7, color=LOOK)


def _growth(axes: Axes, fused: FusedCell, swaths: Sequence[str]) -> None:
    """Intervals of f and A_H after each pass, relative to the final mean."""
    final = fused.final.mean
    for i, (name, colour) in enumerate((("f", "#0072b2"), ("A_H", "#d55e00"))):
        known = [k for k, p in enumerate(fused.posteriors) if np.isfinite(p.mean[i])]
        after = [fused.posteriors[k] for k in known]
        middle = [p.mean[i] / final[i] for p in after]
        low = [(p.mean[i] - p.q05[i]) / final[i] for p in after]
        high = [(p.q95[i] - p.mean[i]) / final[i] for p in after]
        error = np.maximum([low, high], 0.0) if known else None
        place = np.array(known, float) + 0.12 * (2 * i - 1)
        axes.errorbar(place, middle, error, fmt="o", ms=3, color=colour, label=name, capsize=2)
    axes.set_xticks(range(len(swaths)), swaths, rotation=30, ha="right", fontsize=7)
    axes.set_ylabel("over the final mean", fontsize=8)
    axes.set_title("90 % after each pass", fontsize=9)
    axes.tick_params(labelsize=7)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(fontsize=7)


def growth_figure(cells: Sequence[FusedCell], swaths: Sequence[str]) -> Picture | None:
    """Draw how the standard deviations of f and A_H shrink as passes are added.

    Parameters
    ----------
    cells : sequence of FusedCell
    swaths : sequence of str
        Labels, in order.

    Returns
    -------
    Picture or None
        None where no cell was estimated from two passes.
    """
    several = [c for c in cells if len(c.group) > 1]
    if not several:
        return None
    figure = Figure(figsize=(5.2, 2.8), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, colour) in enumerate((("f", "#0072b2"), ("A_H", "#d55e00"))):
        sd = np.array([[p.sd[i] / c.final.mean[i] for p in c.posteriors] for c in several])
        known = np.isfinite(sd)
        steps = [k for k in range(len(swaths)) if known[:, k].any()]
        middle = [100 * float(np.median(sd[known[:, k], k])) for k in steps]
        axes.semilogy(steps, middle, "o-", color=colour, label=name)
    labels = [f"+ {s}" if k else s for k, s in enumerate(swaths)]
    turn = 30 if len(swaths) > FEW else 0
    axes.set_xticks(range(len(swaths)), labels, rotation=turn, ha="right" if turn else "center")
    axes.set_ylabel("median sd (% of the value)", fontsize=8)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    count = len(several)
    caption = (
        f"What each pass adds: median standard deviation over the {count} cells that several "
        "passes show, after each pass in the survey file's order."
    )
    return Picture(encoded(figure), caption)


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
        By class number, from 1.

    Returns
    -------
    Picture
    """
    across = min(len(laws), 3)
    down = -(-len(laws) // across)
    figure = Figure(figsize=(2.5 * across, 2.1 * down), layout="constrained")
    for k, (histogram, law) in enumerate(zip(histograms, laws, strict=True)):
        axes = figure.add_subplot(down, across, k + 1)
        edges, counts = np.array(histogram["edges"]), np.array(histogram["counts"], float)
        density = counts / max(counts.sum(), 1) / np.diff(edges)
        name, colour = names[k + 1]
        axes.stairs(density, edges, fill=True, color=np.array(colour) / 255, alpha=0.7)
        x = np.linspace(edges[0], edges[-1], 300)[1:]
        axes.plot(x, np.exp(law.log_density(x)), color="black", lw=1)
        plain(axes, "amplitude, gain removed", "density", f"{name}: {law.family.replace('_', ' ')}")
    caption = (
        "Amplitudes of each class on the map, with gain and range trend removed, and the "
        "law fitted to them."
    )
    return Picture(encoded(figure), caption)
