"""Values of a cell as the products show them: one function per quantity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.catalogue import CATALOGUE, Product
from sasmap.passes.cell_estimate import CellEstimate
from sasmap.passes.fusion import FusedCell
from sasmap.passes.summary import Summary
from sasmap.ripples.posterior import Quality

STATISTICS = ("mean", "sd", "q05", "q95")
# Finest step of a label on a map, m.
MILLIMETRE = 1e-3

Cells = Mapping[tuple[int, int], Sequence[Summary | None]]
FusedCells = Mapping[tuple[int, int], FusedCell]


class CellResult(NamedTuple):
    """A cell with its looks and their combination.

    Attributes
    ----------
    summaries : sequence of Summary or None
        One per swath, None where it does not show the cell.
    fused : FusedCell
    passes : sequence of str
        Name of the pass of each swath.
    """

    summaries: Sequence[Summary | None]
    fused: FusedCell
    passes: Sequence[str]

    @property
    def used(self) -> list[str]:
        """Passes from which the cell's values are estimated, in order."""
        return list(dict.fromkeys(self.passes[k] for k in self.fused.group))


def _wavelength(estimate: CellEstimate) -> tuple[float, ...]:
    # the wavelength decreases with f, so the quantiles swap
    ends = (1 / f if f > 0 else float("nan") for f in (estimate.q95[0], estimate.q05[0]))
    return (*estimate.derived.wavelength, *ends)


def _sampled(estimate: CellEstimate, i: int, factor: float = 1.0) -> tuple[float, ...]:
    return tuple(factor * getattr(estimate, name)[i] for name in STATISTICS)


# Mean, standard deviation, 5 and 95 % quantiles of the quantities that describe ripples.
QUANTITIES: dict[str, Callable[[CellEstimate], tuple[float, ...]]] = {
    "wavelength": _wavelength,
    "crest_to_trough": lambda estimate: _sampled(estimate, 1, 2.0),
    "steepness": lambda estimate: tuple(estimate.derived.steepness),
    "frequency": lambda estimate: _sampled(estimate, 0),
    "height": lambda estimate: _sampled(estimate, 1),
}


def statistics(estimate: CellEstimate, quantity: str) -> tuple[float, ...]:
    """Mean, standard deviation, 5 and 95 % quantiles of a quantity.

    Parameters
    ----------
    estimate : CellEstimate
    quantity : str
        ``frequency`` (cycles/m), ``height`` (A_H, m), ``wavelength`` (m), ``crest_to_trough`` (m)
        or ``steepness``.

    Returns
    -------
    tuple of float

    Raises
    ------
    KeyError
        If there is no such quantity.
    """
    return QUANTITIES[quantity](estimate)


def cell_probability(summaries: Sequence[Summary | None], fused: FusedCell) -> float:
    """Probability that a cell is rippled: the largest of the looks used for it, or of all."""
    group = [summaries[k] for k in fused.group] or summaries
    known = [s.probability for s in group if s is not None and np.isfinite(s.probability)]
    return max(known, default=float("nan"))


# The bands of each raster with one pixel per cell, by file: a new product of the catalogue needs a
# line here (or in QUANTITIES); the cells' vectors and table and ripples.nc use it from there.
VALUES: dict[str, Callable[[CellResult], Sequence[float]]] = {
    **{
        f"ripple_{name}.tif": lambda cell, tell=tell: tell(cell.fused.final)  # type: ignore[misc]
        for name, tell in QUANTITIES.items()
    },
    "ripple_azimuth.tif": lambda cell: cell.fused.final.azimuth,
    "ripple_probability.tif": lambda cell: [cell_probability(cell.summaries, cell.fused)],
    "ripple_quality.tif": lambda cell: [cell.fused.quality],
    "ripple_passes.tif": lambda cell: [len(cell.used)],
}


def cell_results(
    cells: Cells, fused: FusedCells, passes: Sequence[str]
) -> dict[tuple[int, int], CellResult]:
    """Collect looks and their combination for each cell.

    Parameters
    ----------
    cells : mapping of (row, column) to sequence of Summary or None
    fused : mapping of (row, column) to FusedCell
    passes : sequence of str
        Name of the pass of each swath.

    Returns
    -------
    dict of (row, column) to CellResult
    """
    return {cell: CellResult(s, fused[cell], passes) for cell, s in sorted(cells.items())}


def cell_products() -> dict[str, Product]:
    """Products with numbers of each cell, codes aside, by the name of the quantity."""
    return {
        product.file.removeprefix("ripple_").rpartition(".")[0]: product
        for product in CATALOGUE
        if product.kind == "cells"
    }


def raster(
    file: str, results: Mapping[tuple[int, int], CellResult], bands: int, shape: tuple[int, int]
) -> FloatArray:
    """Arrange a product's values on the grid.

    Parameters
    ----------
    file : str
        Name of the product.
    results : mapping of (row, column) to CellResult
    bands : int
    shape : tuple of int
        Rows and columns.

    Returns
    -------
    ndarray (bands, rows, columns)
        NaN outside the cells.
    """
    values = np.full((bands, *shape), np.nan)
    for cell, result in results.items():
        values[:, *cell] = VALUES[file](result)
    return values


# Meaning of each quality code, and what to do about it.
MEANINGS = {
    Quality.NO_DATA: "no pass shows the cell",
    Quality.GOOD: "ripples, with a converged estimate",
    Quality.NO_RIPPLES: "examined, and no ripples found",
    Quality.NOT_CONVERGED: "ripples, but the Markov chains did not agree",
    Quality.CONTRADICTION: "the passes give values that cannot belong to the same ripples",
    Quality.NOT_IDENTIFIABLE: "the sonar looks along the crests, or a wavelength has too few "
    "pixels or does not fit into the cell",
    Quality.TOO_FEW_PIXELS: "under a quarter of the cell's pixels are valid",
    Quality.FAILED: "could not be computed",
}
ADVICE = {
    Quality.NO_DATA: "",
    Quality.GOOD: "use the values with their intervals",
    Quality.NO_RIPPLES: "nothing",
    Quality.NOT_CONVERGED: "do not quote the values; try a smaller window where crests bend, a "
    "larger one where few wavelengths fit, or more ripples.draws",
    Quality.CONTRADICTION: "compare the passes in ripples.nc, their navigation and dates: "
    "ripples may have changed between them",
    Quality.NOT_IDENTIFIABLE: "add a pass of another heading, or choose a larger window for long "
    "waves and smaller pixels for short ones",
    Quality.TOO_FEW_PIXELS: "nothing, at the edges; elsewhere check the tiles for holes",
    Quality.FAILED: "see the failures at the end of the report; repair the input and run again",
}


def attributes(results: Sequence[CellResult]) -> dict[str, list[Any]]:
    """Attributes of cells as columns, for vectors and tables.

    Parameters
    ----------
    results : sequence of CellResult

    Returns
    -------
    dict of str to list
        Numbers, NaN where unknown, and text.
    """
    columns: dict[str, list[Any]] = {
        "quality": [int(r.fused.quality) for r in results],
        "quality_text": [r.fused.quality.label for r in results],
        "reason": [MEANINGS[r.fused.quality] for r in results],
    }
    for name, product in cell_products().items():
        bands = len(product.bands)
        keys = [f"{name}_{s}" for s in STATISTICS[:bands]] if bands > 1 else [name]
        every = np.array([VALUES[product.file](r) for r in results]).reshape(-1, bands)
        columns |= {key: every[:, i].tolist() for i, key in enumerate(keys)}
    columns["passes_used"] = [len(r.used) for r in results]
    columns["passes"] = [", ".join(r.used) for r in results]
    columns["label"] = [label(r.fused.final) for r in results]
    return columns


def label(estimate: CellEstimate) -> str:
    """Label of a cell on a map: wavelength and height, to a millimetre at best."""
    length, height = (statistics(estimate, k) for k in ("wavelength", "crest_to_trough"))
    if not np.isfinite(length[0]):
        return ""
    return f"λ {_on_a_map(*length[:2])} m\nH {_on_a_map(*height[:2])} m"


def _on_a_map(value: float, sd: float) -> str:
    if np.isfinite(sd) and sd < MILLIMETRE / 2:  # it would be rounded to 0.000
        return f"{value:.3f}"
    return f"{value:.3f} ± {sd:.3f}" if sd < 10 * MILLIMETRE else measured(value, sd)


def measured(value: float, sd: float) -> str:
    """Write a value with its standard deviation to two digits: 0.140 ± 0.012.

    Parameters
    ----------
    value, sd : float

    Returns
    -------
    str
    """
    if not (np.isfinite(value) and np.isfinite(sd) and sd > 0):
        return f"{value:.4g}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))
    return f"{value:.{digits}f} ± {sd:.{digits}f}"
