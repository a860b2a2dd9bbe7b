"""Ripple products of a survey: rasters with a pixel a cell, and ripples.nc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from affine import Affine
from numpy.typing import NDArray

from sasmap.io.files import written_whole
from sasmap.io.rasters import Category, Layer, as_bands, float_layer, write_cog
from sasmap.products.colours import QUALITY_COLOURS
from sasmap.ripples.detection import Unclear
from sasmap.ripples.fusion import FusedCell
from sasmap.ripples.posterior import JUDGED, LeftOut, Quality
from sasmap.ripples.summary import Summary

STATISTICS = ("mean", "sd", "q05", "q95")
# Of f, A_H and the azimuth.
CONVERGENCE = ("rhat", "ess_bulk", "ess_tail")
SINGLE_UNITS = {
    "correlation": "1",
    "acceptance": "1",
    "probability": "1",
    "coherence_length": "m",
    "rippled_fraction": "1",
    "noise_factor": "1",
    "defect_density": "m-2",
    "window": "1",
    "exponent": "1",
    "exponent_sd": "1",
    "concentration": "1",
    "concentration_sd": "1",
    "peakedness": "1",
    "asymmetry": "1",
}

Cells = Mapping[tuple[int, int], Sequence[Summary | None]]
FusedCells = Mapping[tuple[int, int], FusedCell]


def write_ripple_rasters(
    folder: Path,
    cells: Cells,
    chains: FusedCells,
    looks: Sequence[str],
    shape: tuple[int, int],
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    scratch: Path,
) -> list[Path]:
    """Write frequency, height, azimuth, probability, quality and passes, a pixel a cell.

    Parameters
    ----------
    folder : Path
    cells : mapping of (row, column) to sequence of Summary or None
        A summary for each look, None where the look does not show the cell.
    chains : mapping of (row, column) to FusedCell
    looks : sequence of str
        Name of the pass that each look belongs to.
    shape : tuple of int
        Rows and columns of the grid.
    transform : Affine
    crs : str
        WKT.
    tags : mapping of str to str
    scratch : Path

    Returns
    -------
    list of Path
    """
    values = np.full((2, len(STATISTICS), *shape), np.nan)
    azimuth = np.full((2, *shape), np.nan)
    probability = np.full(shape, np.nan)
    quality = np.zeros(shape, np.uint8)
    passes = np.zeros(shape, np.uint8)
    for cell, summaries in cells.items():
        chain = chains[cell]
        quality[cell] = chain.quality
        probability[cell] = cell_probability(summaries, chain)
        for i, name in enumerate(STATISTICS):
            values[:, i, *cell] = getattr(chain.final, name)
        azimuth[:, *cell] = chain.final.azimuth
        passes[cell] = len({looks[k] for k in chain.group})
    spots = (("frequency", "cycles/m"), ("height", "m"))
    written = []
    for k, (name, unit) in enumerate(spots):
        bands = [f"{name} {statistic}" for statistic in STATISTICS]
        layer = float_layer(bands, [unit] * len(bands), tags)
        written.append(folder / f"ripple_{name}.tif")
        write_cog(written[-1], values[k], layer, transform, crs, scratch)
    layer = float_layer(["azimuth axial mean", "azimuth sd"], ["degrees"] * 2, tags)
    written.append(folder / "ripple_azimuth.tif")
    write_cog(written[-1], azimuth, layer, transform, crs, scratch)
    layer = float_layer(["probability of ripples"], ["1"], tags)
    written.append(folder / "ripple_probability.tif")
    write_cog(written[-1], as_bands(probability), layer, transform, crs, scratch)
    categories = {int(q): Category(q.label, (*c, 255)) for q, c in QUALITY_COLOURS.items()}
    categories[int(Quality.NO_DATA)] = Category(Quality.NO_DATA.label, (0, 0, 0, 0))
    layer = Layer(["quality"], [""], 0, "uint8", categories, tags)
    written.append(folder / "ripple_quality.tif")
    write_cog(written[-1], as_bands(quality), layer, transform, crs, scratch)
    layer = Layer(["passes used"], ["1"], 255, "uint8", {}, tags)
    written.append(folder / "ripple_passes.tif")
    write_cog(written[-1], as_bands(passes), layer, transform, crs, scratch)
    return written


def cell_probability(summaries: Sequence[Summary | None], chain: FusedCell) -> float:
    """Probability that a cell is rippled: the largest of the looks that stand for it, or of all."""
    group = [summaries[k] for k in chain.group] or summaries
    known = [s.probability for s in group if s is not None and np.isfinite(s.probability)]
    return max(known, default=float("nan"))


def write_ripples_netcdf(
    path: Path,
    cells: Cells,
    chains: FusedCells,
    looks: Sequence[str],
    shape: tuple[int, int],
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    scratch: Path,
) -> list[Path]:
    """Write everything per look and cell: prior, posterior, convergence, quality.

    Parameters
    ----------
    path : Path
    cells : mapping of (row, column) to sequence of Summary or None
    chains : mapping of (row, column) to FusedCell
    looks : sequence of str
        Labels, one a look.
    shape : tuple of int
        Rows and columns of the grid.
    transform : Affine
    crs : str
        WKT.
    tags : mapping of str to str
        Global attributes.
    scratch : Path

    Returns
    -------
    list of Path
    """
    full = (len(looks), *shape)
    variables = {**_known_fields(cells, chains, full), **_look_fields(cells, full)}
    for name in variables:
        variables[name][2]["grid_mapping"] = "spatial_ref"
    spatial = pyproj.CRS.from_wkt(crs).to_cf()
    spatial["GeoTransform"] = " ".join(repr(v) for v in transform.to_gdal())
    variables["spatial_ref"] = ((), np.int32(0), spatial)
    result = xr.Dataset(
        variables,
        coords={
            "pass": ("pass", np.array(looks, dtype=str)),
            "y": ("y", _centres(transform.f, transform.e, shape[0]), _axis("y")),
            "x": ("x", _centres(transform.c, transform.a, shape[1]), _axis("x")),
        },
        attrs={"Conventions": "CF-1.8", **tags},
    )
    with written_whole(path, scratch) as part:
        result.to_netcdf(part, engine="scipy", format="NETCDF3_64BIT")
    return [path]


_DIMS = ("pass", "y", "x")
_PARAMETERS = (("frequency", "cycles/m"), ("height", "m"))


def _known_fields(cells: Cells, chains: FusedCells, shape: tuple[int, ...]) -> dict[str, Any]:
    """Collect what is known of each cell before and after each look, and by it alone."""
    variables: dict[str, Any] = {}
    sources: tuple[tuple[str, str, Any], ...] = (
        ("", "after this pass, all so far combined", lambda c, k: chains[c].posteriors[k]),
        ("prior_", "before this pass", lambda c, k: chains[c].priors[k]),
        ("alone_", "by this pass alone", lambda c, k: cells[c][k]),
    )
    for prefix, about, source in sources:
        for name in ("mean", "sd") if prefix == "prior_" else STATISTICS:
            for i, (parameter, unit) in enumerate(_PARAMETERS):
                values = _values(cells, shape, partial(_statistic, source, name, i))
                attributes = {"units": unit, "long_name": f"{name} of {parameter} {about}"}
                variables[f"{parameter}_{prefix}{name}"] = (_DIMS, values, attributes)
        for i, name in enumerate(("mean", "sd")):
            values = _values(cells, shape, partial(_statistic, source, "azimuth", i))
            attributes = {"units": "degrees", "long_name": f"axial {name} of the azimuth {about}"}
            variables[f"azimuth_{prefix}{name}"] = (_DIMS, values, attributes)
    apart = _values(cells, shape, lambda c, k: chains[c].disagreements[k])
    about = "squared distance from the other passes; chi-squared, 3 degrees of freedom, by chance"
    variables["disagreement"] = (_DIMS, apart, {"units": "1", "long_name": about})
    return {**variables, **_verdicts(chains, shape)}


def _verdicts(chains: FusedCells, shape: tuple[int, ...]) -> dict[str, Any]:
    """Collect the quality of each look and whether it stands for its cell."""
    quality, used = np.zeros(shape, np.int8), np.zeros(shape, np.int8)
    for cell, chain in chains.items():
        quality[:, *cell] = chain.qualities
        used[list(chain.group), *cell] = 1
    about = {"units": "1", "long_name": "stands for the cell"}
    return {"quality": (_DIMS, quality, _flags()), "used": (_DIMS, used, about)}


def _statistic(source: Any, name: str, i: int, cell: tuple[int, int], k: int) -> float:
    return float(getattr(source(cell, k), name)[i])


def _values(cells: Cells, shape: tuple[int, ...], value: Any) -> NDArray[np.float64]:
    """Fill a field with a value of each cell and look that shows it."""
    field = np.full(shape, np.nan)
    for cell, summaries in cells.items():
        for k, summary in enumerate(summaries):
            if summary is not None:
                field[k, *cell] = value(cell, k)
    return field


def _look_fields(cells: Cells, shape: tuple[int, ...]) -> dict[str, Any]:
    """How each look went: convergence, crests, quality, what was left out."""
    variables: dict[str, Any] = {}
    for name in CONVERGENCE:
        for k, parameter in enumerate(JUDGED):
            field = _field(cells, shape, lambda s, n=name, i=k: getattr(s, n)[i])
            variables[f"{parameter}_{name}"] = (_DIMS, field, {"units": "1"})
    units = {"frequency": "cycles/m", "height": "m", "azimuth": "degrees"}
    for k, parameter in enumerate(JUDGED):
        for name in ("mean", "sd"):
            field = _field(cells, shape, lambda s, n=f"second_{name}", i=k: getattr(s, n)[i])
            about = {"units": units[parameter], "long_name": "of a second system of ripples"}
            variables[f"{parameter}_second_{name}"] = (_DIMS, field, about)
    for name, unit in SINGLE_UNITS.items():
        field = _field(cells, shape, lambda s, n=name: getattr(s, n))
        variables[name] = (_DIMS, field, {"units": unit})
    reasons = {reason.value: float(k + 1) for k, reason in enumerate(Unclear)}
    unclear = _field(cells, shape, lambda s: reasons.get(s.reason, 0.0))
    variables["unclear"] = (_DIMS, np.nan_to_num(unclear).astype(np.int8), _reasons())
    left_out = _field(cells, shape, lambda s: float(s.left_out))
    variables["left_out"] = (_DIMS, np.nan_to_num(left_out).astype(np.int16), _masks())
    return variables


def _field(cells: Cells, shape: tuple[int, ...], value: Any) -> NDArray[np.float64]:
    return _values(cells, shape, lambda cell, k: value(cells[cell][k]))


def _centres(origin: float, step: float, n: int) -> NDArray[np.float64]:
    return np.asarray(origin + step * (np.arange(n) + 0.5), np.float64)


def _axis(name: str) -> dict[str, str]:
    return {"units": "m", "standard_name": f"projection_{name}_coordinate"}


def _flags() -> dict[str, Any]:
    return {
        "flag_values": np.array([int(q) for q in Quality], np.int8),
        "flag_meanings": " ".join(q.label.replace(" ", "_") for q in Quality),
    }


def _reasons() -> dict[str, Any]:
    names = ["clear", *(reason.name.lower() for reason in Unclear)]
    return {
        "flag_values": np.arange(len(names), dtype=np.int8),
        "flag_meanings": " ".join(names),
        "long_name": "why ripples cannot be told: too few waves a window, too few pixels a wave, "
        "looked at along the crests",
    }


def _masks() -> dict[str, Any]:
    return {
        "flag_masks": np.array([int(f) for f in LeftOut], np.int16),
        "flag_meanings": " ".join(str(f.name).lower() for f in LeftOut),
        "long_name": "what was left out",
    }
