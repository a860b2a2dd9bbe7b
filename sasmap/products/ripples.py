"""Ripple products of a survey: rasters with a pixel a cell, and ripples.nc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from affine import Affine
from numpy.typing import NDArray

from sasmap.products.files import written_whole
from sasmap.products.rasters import Category, Layer, as_bands, float_layer, write_cog
from sasmap.ripples.passes import Summary, cell_quality, used
from sasmap.ripples.posterior import JUDGED, LeftOut, Quality
from sasmap.ripples.settings import RippleSettings

# Colours after Okabe and Ito, told apart by colour-blind readers.
QUALITY_COLOURS = {
    Quality.NO_DATA: (0, 0, 0, 0),
    Quality.GOOD: (0, 158, 115, 255),
    Quality.NO_RIPPLES: (200, 200, 200, 255),
    Quality.NOT_CONVERGED: (230, 159, 0, 255),
    Quality.CONTRADICTION: (204, 121, 167, 255),
    Quality.NOT_IDENTIFIABLE: (86, 180, 233, 255),
    Quality.TOO_FEW_PIXELS: (240, 228, 66, 255),
    Quality.FAILED: (213, 94, 0, 255),
}
STATISTICS = ("mean", "sd", "q05", "q95")
SUMMARY_UNITS = {
    "mean": ("cycles/m", "m"),
    "sd": ("cycles/m", "m"),
    "q05": ("cycles/m", "m"),
    "q95": ("cycles/m", "m"),
    "prior_mean": ("cycles/m", "m"),
    "prior_sd": ("cycles/m", "m"),
}
# Of f, A_H and the azimuth.
CONVERGENCE = ("rhat", "ess_bulk", "ess_tail")
SINGLE_UNITS = {
    "correlation": "1",
    "acceptance": "1",
    "probability": "1",
    "coherence_length": "m",
    "rippled_fraction": "1",
    "noise_factor": "1",
}
PROFILES = ("", "sine", "stokes", "peaked")

Cells = Mapping[tuple[int, int], Sequence[Summary | None]]


def write_ripple_rasters(
    folder: Path,
    cells: Cells,
    looks: Sequence[str],
    settings: RippleSettings,
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
    looks : sequence of str
        Name of the pass that each look belongs to.
    settings : RippleSettings
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
        present = [(k, s) for k, s in enumerate(summaries) if s is not None]
        quality[cell] = cell_quality([s.quality for _, s in present])
        chosen = chosen_look(summaries, settings)
        probability[cell] = cell_probability(summaries, chosen)
        if chosen is None:
            continue
        summary = summaries[chosen]
        assert summary is not None
        for i, name in enumerate(STATISTICS):
            values[:, i, *cell] = getattr(summary, name)
        azimuth[:, *cell] = summary.azimuth
        passes[cell] = len({looks[k] for k, s in present if s.quality is summary.quality})
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
    categories = {int(q): Category(q.label, QUALITY_COLOURS[q]) for q in Quality}
    layer = Layer(["quality"], [""], 0, "uint8", categories, tags)
    written.append(folder / "ripple_quality.tif")
    write_cog(written[-1], as_bands(quality), layer, transform, crs, scratch)
    layer = Layer(["passes used"], ["1"], 255, "uint8", {}, tags)
    written.append(folder / "ripple_passes.tif")
    write_cog(written[-1], as_bands(passes), layer, transform, crs, scratch)
    return written


def cell_probability(summaries: Sequence[Summary | None], chosen: int | None) -> float:
    """Probability that a cell is rippled: of the look that stands for it, else the largest."""
    picked = summaries[chosen] if chosen is not None else None
    if picked is not None and np.isfinite(picked.probability):
        return picked.probability
    known = [s.probability for s in summaries if s is not None and np.isfinite(s.probability)]
    return max(known, default=float("nan"))


def chosen_look(summaries: Sequence[Summary | None], settings: RippleSettings) -> int | None:
    """Index of the look whose chained posterior is the cell's product, or None."""
    if any(s is not None and s.quality is Quality.FAILED for s in summaries):
        return None
    present = [k for k, s in enumerate(summaries) if s is not None]
    found = [s for s in summaries if s is not None]
    index = used(found, settings)
    if index is None:  # better a flagged value than none
        doubtful = [i for i, s in enumerate(found) if s.quality is Quality.NOT_CONVERGED]
        index = doubtful[-1] if doubtful else None
    return None if index is None else present[index]


def write_ripples_netcdf(
    path: Path,
    cells: Cells,
    looks: Sequence[str],
    shape: tuple[int, int],
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    scratch: Path,
) -> None:
    """Write everything per look and cell: prior, posterior, convergence, quality.

    Parameters
    ----------
    path : Path
    cells : mapping of (row, column) to sequence of Summary or None
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
    """
    full = (len(looks), *shape)
    variables: dict[str, Any] = {}
    for name, units in SUMMARY_UNITS.items():
        for k, parameter in enumerate(("frequency", "height")):
            field = _field(cells, full, lambda s, n=name, i=k: getattr(s, n)[i])
            variables[f"{parameter}_{name}"] = (_DIMS, field, {"units": units[k]})
    for name in CONVERGENCE:
        for k, parameter in enumerate(JUDGED):
            field = _field(cells, full, lambda s, n=name, i=k: getattr(s, n)[i])
            variables[f"{parameter}_{name}"] = (_DIMS, field, {"units": "1"})
    for k, statistic in enumerate(("mean", "sd")):
        for source, target in (("azimuth", statistic), ("prior_azimuth", f"prior_{statistic}")):
            field = _field(cells, full, lambda s, n=source, i=k: getattr(s, n)[i])
            variables[f"azimuth_{target}"] = (_DIMS, field, {"units": "degrees"})
    for name, unit in SINGLE_UNITS.items():
        field = _field(cells, full, lambda s, n=name: getattr(s, n))
        variables[name] = (_DIMS, field, {"units": unit})
    profile = _field(cells, full, lambda s: float(PROFILES.index(s.profile)))
    variables["profile"] = (_DIMS, np.nan_to_num(profile).astype(np.int8), _profiles())
    quality = _field(cells, full, lambda s: float(s.quality))
    left_out = _field(cells, full, lambda s: float(s.left_out))
    variables["quality"] = (_DIMS, np.nan_to_num(quality).astype(np.int8), _flags())
    variables["left_out"] = (_DIMS, np.nan_to_num(left_out).astype(np.int16), _masks())
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


_DIMS = ("pass", "y", "x")


def _field(cells: Cells, shape: tuple[int, ...], value: Any) -> NDArray[np.float64]:
    field = np.full(shape, np.nan)
    for cell, summaries in cells.items():
        for k, summary in enumerate(summaries):
            if summary is not None:
                field[k, *cell] = value(summary)
    return field


def _centres(origin: float, step: float, n: int) -> NDArray[np.float64]:
    return np.asarray(origin + step * (np.arange(n) + 0.5), np.float64)


def _axis(name: str) -> dict[str, str]:
    return {"units": "m", "standard_name": f"projection_{name}_coordinate"}


def _flags() -> dict[str, Any]:
    return {
        "flag_values": np.array([int(q) for q in Quality], np.int8),
        "flag_meanings": " ".join(q.label.replace(" ", "_") for q in Quality),
    }


def _profiles() -> dict[str, Any]:
    return {
        "flag_values": np.arange(len(PROFILES), dtype=np.int8),
        "flag_meanings": " ".join(name or "none" for name in PROFILES),
    }


def _masks() -> dict[str, Any]:
    return {
        "flag_masks": np.array([int(f) for f in LeftOut], np.int16),
        "flag_meanings": " ".join(str(f.name).lower() for f in LeftOut),
        "long_name": "what was left out",
    }
