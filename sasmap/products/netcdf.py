"""ripples.nc: all results per pass and cell, and the combined value of each quantity (CF-1.11)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from affine import Affine

from sasmap.arrays import FloatArray
from sasmap.catalogue import Band
from sasmap.io.files import written_whole
from sasmap.passes.shared import SurveyModel
from sasmap.products.cell_values import (
    STATISTICS,
    VALUES,
    CellResult,
    Cells,
    FusedCells,
    cell_products,
    cell_results,
)
from sasmap.ripples.detection import Unclear
from sasmap.ripples.posterior import JUDGED, LeftOut, Quality

# Convergence diagnostics of f, A_H and the azimuth.
CONVERGENCE = {
    "rhat": "rank-normalised split R-hat",
    "ess_bulk": "bulk effective sample size",
    "ess_tail": "tail effective sample size",
}
# Name, unit and meaning of the other quantities of a look.
SINGLE = {
    "correlation": ("1", "posterior correlation of f and A_H"),
    "acceptance": ("1", "accepted fraction of the proposals"),
    "probability": ("1", "probability that the cell is rippled"),
    "coherence_length": ("m", "distance over which the phase of the crests stays correlated"),
    "rippled_fraction": ("1", "rippled fraction of the valid area"),
    "defect_density": ("m-2", "crest terminations per square metre of rippled sea floor"),
    "window": ("1", "side of the window in which the look was estimated, in cells"),
    "noise_factor": ("1", "variance of the speckle over that of independent pixels"),
    "exponent": ("1", "exponent n of the scattering law sin(theta)^n exp(-c (theta - pi/2)^2)"),
    "exponent_sd": ("1", "standard deviation of the exponent of the scattering law"),
    "concentration": ("1", "concentration c of the scattering law"),
    "concentration_sd": ("1", "standard deviation of the concentration of the scattering law"),
    "peakedness": ("1", "in-phase second harmonic of the crest profile over A_H"),
    "asymmetry": ("1", "quadrature second harmonic of the crest profile over A_H"),
}
# Units of the catalogue in UDUNITS notation.
UNITS = {"cycles/m": "m-1", "degrees": "degree"}
# Suffix of the first of several bands after the name of the quantity.
STATISTIC = re.compile(r", (axial )?mean$")


def write_ripples_netcdf(
    path: Path,
    cells: Cells,
    chains: FusedCells,
    looks: Sequence[str],
    passes: Sequence[str],
    shape: tuple[int, int],
    transform: Affine,
    crs: str,
    size: float,
    tags: Mapping[str, str],
    scratch: Path,
    survey: SurveyModel | None = None,
) -> list[Path]:
    """Write prior, posterior, convergence and quality per look and cell, and combined values.

    Parameters
    ----------
    path : Path
    cells : mapping of (row, column) to sequence of Summary or None
    chains : mapping of (row, column) to FusedCell
    looks : sequence of str
        Labels, one per look.
    passes : sequence of str
        Name of the pass of each look.
    shape : tuple of int
        Rows and columns of the grid.
    transform : Affine
    crs : str
        WKT.
    size : float
        Side of a cell, m: where cells overlap their bounds are written.
    tags : mapping of str to str
        Global attributes.
    scratch : Path
    survey : SurveyModel, optional
        Shared parameters of the survey.

    Returns
    -------
    list of Path
    """
    full = (len(looks), *shape)
    results = cell_results(cells, chains, passes)
    variables = {
        **_combined(results, shape),
        **_known_fields(cells, chains, full),
        **_look_fields(cells, full),
    }
    for name in variables:
        variables[name][2]["grid_mapping"] = "spatial_ref"
    variables |= _shared(survey)
    spatial = pyproj.CRS.from_wkt(crs).to_cf()
    spatial["GeoTransform"] = " ".join(repr(v) for v in transform.to_gdal())
    variables["spatial_ref"] = ((), np.int32(0), spatial)
    labels = {"long_name": "pass, with the side where it shows both"}
    coordinates = {
        "pass": ("pass", np.array(looks, dtype=str), labels),
        "statistic": ("statistic", np.array(STATISTICS), {"long_name": "posterior statistic"}),
        "y": ("y", _centres(transform.f, transform.e, shape[0]), _axis("y")),
        "x": ("x", _centres(transform.c, transform.a, shape[1]), _axis("x")),
    }
    if size > transform.a:
        for name, (_, centres, about) in list(coordinates.items())[2:]:
            about["bounds"] = f"{name}_bounds"
            ends = centres[:, None] + 0.5 * size * np.array([-1, 1])
            variables[f"{name}_bounds"] = ((name, "bounds"), ends)
    result = xr.Dataset(variables, coordinates, _global(tags))
    # coordinates and fields without gaps have no fill value
    encoding = {
        name: {"_FillValue": np.nan if name in variables and v.dtype.kind == "f" else None}
        for name, v in result.variables.items()
        if v.dtype.kind in "fiu"
    }
    with written_whole(path, scratch) as part:
        result.to_netcdf(part, engine="scipy", format="NETCDF3_64BIT", encoding=encoding)
    return [path]


def _global(tags: Mapping[str, str]) -> dict[str, str]:
    return {
        "Conventions": "CF-1.11",
        "title": f"Ripples of the survey {tags['SURVEY']}",
        "institution": "not stated in the survey file",
        "source": f"{tags['SOFTWARE']}, from synthetic aperture sonar amplitude",
        "history": f"run {tags['RUN_ID']} of {tags['SOFTWARE']}",
        "references": "Zare and Cobb (2013); docs/science.md of sasmap",
        "comment": "Variables without the dimension pass are of all passes combined.",
        **tags,
    }


def _shared(survey: SurveyModel | None) -> dict[str, Any]:
    """Collect the shared parameters: law (statistic), altitude offsets (statistic, pass)."""
    if survey is None or not survey.values:
        return {}

    def summed(values: Any) -> FloatArray:
        drawn = np.array(values, float)
        ends = np.quantile(drawn, (0.05, 0.95), axis=0)
        return np.stack([drawn.mean(axis=0), drawn.std(axis=0), *ends])

    offset = summed([v.offset for v in survey.values])
    about = "true altitude minus that of the navigation, by swath"
    variables: dict[str, Any] = {
        "altitude_offset": (("statistic", "pass"), offset, {"units": "m", "long_name": about})
    }
    if survey.learned:
        names = ("exponent n", "concentration c")
        for field, what in (("law", "mean over the survey"), ("spread", "sd from look to look")):
            values = summed([getattr(v, field) for v in survey.values])
            for i, name in enumerate(names):
                about = (
                    f"{name} of the scattering law sin(theta)^n exp(-c (theta - pi/2)^2), {what}"
                )
                key = f"{field}_{name.split()[0]}"
                variables[key] = ("statistic", values[:, i], {"units": "1", "long_name": about})
    if survey.apart:
        variables |= _sediments(survey, summed)
    return variables


def _sediments(survey: SurveyModel, summed: Callable[[Any], FloatArray]) -> dict[str, Any]:
    """Collect the laws (statistic, sediment) that the survey separates."""
    mapped = "laws of mapped classes" if survey.sediments else "laws told apart, not mapped classes"
    described = {
        "share": "share of the cells",
        "exponent": "exponent n of the scattering law, mean over the sediment",
        "concentration": "concentration c of the scattering law, mean over the sediment",
    }
    columns = [summed([(p.weight, *p.shared.law) for p in draws]) for draws in survey.found]
    values = np.stack(columns, axis=1)
    laws: dict[str, Any] = {
        f"sediment_{name}": (
            ("statistic", "sediment"),
            values[..., i],
            {"units": "1", "long_name": f"{about}; {mapped}"},
        )
        for i, (name, about) in enumerate(described.items())
    }
    if survey.sediments:
        about = {"long_name": "number of the mapped class, as in sediment_class.tif"}
        numbers = np.array(survey.sediments, np.int8)
        laws["sediment_class"] = ("sediment", numbers, about)
    return laws


def _meaning(band: Band) -> str:
    """Name the quantity in a product's first band, without the statistic."""
    return STATISTIC.sub("", band.text)


def _combined(results: Mapping[tuple[int, int], CellResult], shape: tuple[int, int]) -> Any:
    """Collect the combined value of each quantity (statistic, y, x) and quality codes (y, x)."""
    variables: dict[str, Any] = {}
    flat = ("y", "x")
    for name, product in cell_products().items():
        values = np.full((len(STATISTICS), *shape), np.nan)
        for cell, result in results.items():
            known = VALUES[product.file](result)
            values[: len(known), *cell] = known
        band = product.bands[0]
        about = {
            "units": UNITS.get(band.unit, band.unit),
            "long_name": f"{_meaning(band)}, all passes combined",
        }
        if len(product.bands) == 1:  # the value per pass has the plain name
            variables[f"cell_{name}"] = (flat, values[0], about)
        else:
            variables[name] = (("statistic", *flat), values, about)
    quality, passes = np.zeros(shape, np.int8), np.zeros(shape, np.int8)
    for cell, result in results.items():
        quality[cell], passes[cell] = result.fused.quality, min(len(result.used), 127)
    variables["cell_quality"] = (flat, quality, _flags("quality of the cell"))
    about = {"units": "1", "long_name": "number of passes used for the cell's values"}
    variables["cell_passes"] = (flat, passes, about)
    return variables


_DIMS = ("pass", "y", "x")
_PARAMETERS = (("frequency", "m-1"), ("height", "m"))


def _known_fields(cells: Cells, chains: FusedCells, shape: tuple[int, ...]) -> dict[str, Any]:
    """Collect the estimates of each cell before and after each look, and from it alone."""
    variables: dict[str, Any] = {}
    sources: tuple[tuple[str, str, Any], ...] = (
        ("", "after this pass, all so far combined", lambda c, k: chains[c].posteriors[k]),
        ("prior_", "before this pass", lambda c, k: chains[c].priors[k]),
        ("alone_", "from this pass alone", lambda c, k: cells[c][k]),
    )
    for prefix, about, source in sources:
        for name in ("mean", "sd") if prefix == "prior_" else STATISTICS:
            for i, (parameter, unit) in enumerate(_PARAMETERS):
                values = _values(cells, shape, partial(_statistic, source, name, i))
                meant = _meaning(cell_products()[parameter].bands[0])
                attributes = {"units": unit, "long_name": f"{name} of {meant}, {about}"}
                variables[f"{parameter}_{prefix}{name}"] = (_DIMS, values, attributes)
        for i, name in enumerate(("mean", "sd")):
            values = _values(cells, shape, partial(_statistic, source, "azimuth", i))
            attributes = {"units": "degree", "long_name": f"axial {name} of the azimuth {about}"}
            variables[f"azimuth_{prefix}{name}"] = (_DIMS, values, attributes)
    apart = _values(cells, shape, lambda c, k: chains[c].disagreements[k])
    about = "squared distance from the other passes; chi-squared, 3 degrees of freedom by chance"
    variables["disagreement"] = (_DIMS, apart, {"units": "1", "long_name": about})
    moves = ("migration", "distance"), ("migration_sd", "standard deviation of the distance")
    for i, (name, what) in enumerate(moves):
        moved = _values(cells, shape, lambda c, k, i=i: chains[c].migration[k][i])
        about = f"{what} of the crests from those of the first pass used, along the azimuth, "
        about += "up to whole wavelengths"
        variables[name] = (_DIMS, moved, {"units": "m", "long_name": about})
    return {**variables, **_verdicts(chains, shape)}


def _verdicts(chains: FusedCells, shape: tuple[int, ...]) -> dict[str, Any]:
    """Collect the quality of each look and whether it is used for its cell."""
    quality, used = np.zeros(shape, np.int8), np.zeros(shape, np.int8)
    for cell, chain in chains.items():
        quality[:, *cell] = chain.qualities
        used[list(chain.group), *cell] = 1
    about = {"units": "1", "long_name": "used for the cell's values"}
    return {
        "quality": (_DIMS, quality, _flags("quality of the look")),
        "used": (_DIMS, used, about),
    }


def _statistic(source: Any, name: str, i: int, cell: tuple[int, int], k: int) -> float:
    return float(getattr(source(cell, k), name)[i])


def _values(cells: Cells, shape: tuple[int, ...], value: Any) -> FloatArray:
    """Fill a field with a value of each cell and look that shows it."""
    field = np.full(shape, np.nan)
    for cell, summaries in cells.items():
        for k, summary in enumerate(summaries):
            if summary is not None:
                field[k, *cell] = value(cell, k)
    return field


def _look_fields(cells: Cells, shape: tuple[int, ...]) -> dict[str, Any]:
    """Diagnostics of each look: convergence, crests, quality, skipped steps."""
    variables: dict[str, Any] = {}
    for name, meaning in CONVERGENCE.items():
        for k, parameter in enumerate(JUDGED):
            field = _field(cells, shape, lambda s, n=name, i=k: getattr(s, n)[i])
            about = {"units": "1", "long_name": f"{meaning} of the {parameter}"}
            variables[f"{parameter}_{name}"] = (_DIMS, field, about)
    for name, (unit, meaning) in SINGLE.items():
        field = _field(cells, shape, lambda s, n=name: getattr(s, n))
        variables[name] = (_DIMS, field, {"units": unit, "long_name": meaning})
    for k, parameter in enumerate(JUDGED):
        for name in ("mean", "sd"):
            field = _field(cells, shape, lambda s, n=f"second_{name}", i=k: getattr(s, n)[i])
            unit = {"frequency": "m-1", "height": "m", "azimuth": "degree"}[parameter]
            about = {"units": unit, "long_name": f"{name} of the {parameter} of a second system"}
            variables[f"{parameter}_second_{name}"] = (_DIMS, field, about)
    reasons = {reason.value: float(k + 1) for k, reason in enumerate(Unclear)}
    unclear = _field(cells, shape, lambda s: reasons.get(s.reason, 0.0))
    variables["unclear"] = (_DIMS, np.nan_to_num(unclear).astype(np.int8), _reasons())
    left_out = _field(cells, shape, lambda s: float(s.left_out))
    variables["left_out"] = (_DIMS, np.nan_to_num(left_out).astype(np.int16), _masks())
    return variables


def _field(cells: Cells, shape: tuple[int, ...], value: Any) -> FloatArray:
    return _values(cells, shape, lambda cell, k: value(cells[cell][k]))


def _centres(origin: float, step: float, n: int) -> FloatArray:
    return np.asarray(origin + step * (np.arange(n) + 0.5), np.float64)


def _axis(name: str) -> dict[str, str]:
    return {
        "units": "m",
        "standard_name": f"projection_{name}_coordinate",
        "long_name": f"{name} of the cells' centres",
        "axis": name.upper(),
    }


def _flags(about: str) -> dict[str, Any]:
    return {
        "long_name": about,
        "flag_values": np.array([int(q) for q in Quality], np.int8),
        "flag_meanings": " ".join(q.label.replace(" ", "_") for q in Quality),
    }


def _reasons() -> dict[str, Any]:
    names = ["clear", *(reason.name.lower() for reason in Unclear)]
    return {
        "flag_values": np.arange(len(names), dtype=np.int8),
        "flag_meanings": " ".join(names),
        "long_name": "why ripples cannot be identified: too few waves per window, too few pixels "
        "per wavelength, sonar looks along the crests, bands evenly spaced in grazing angle, no "
        "height within the settings' bounds",
    }


def _masks() -> dict[str, Any]:
    return {
        "flag_masks": np.array([int(f) for f in LeftOut], np.int16),
        "flag_meanings": " ".join(str(f.name).lower() for f in LeftOut),
        "long_name": "steps that were skipped",
    }
