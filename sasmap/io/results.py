"""An output folder read back: cells as a dataset, areas and classes as tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyogrio
import shapely
import xarray as xr

from sasmap.catalogue import MANIFEST
from sasmap.errors import InputError


class Run(NamedTuple):
    """Results of a run.

    Attributes
    ----------
    cells : Dataset
        Of ``ripples.nc``: for each quantity its combined value (statistic, y, x), and everything
        per pass (pass, y, x); empty where the survey has no ripples block.
    areas : DataFrame
        Sediment areas, one row per polygon with its ``geometry`` (shapely); otherwise one row
        per class.
    record : dict
        ``run.json``.
    """

    cells: xr.Dataset
    areas: pd.DataFrame
    record: dict[str, Any]


def open_run(folder: str | Path) -> Run:
    """Read the results of a run.

    Parameters
    ----------
    folder : str or Path
        Its output folder.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        Where the folder holds no run, or one of its products cannot be read.

    Examples
    --------
    >>> run = sasmap.open_run("out")  # doctest: +SKIP
    >>> run.cells.wavelength.sel(statistic="mean")  # doctest: +SKIP
    """
    folder = Path(folder)
    path = folder / MANIFEST
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        written = set(record["products"])
        cells = xr.Dataset()
        if "ripples.nc" in written:
            path = folder / "ripples.nc"
            with xr.open_dataset(path, engine="scipy") as found:
                cells = found.load()
        path = folder / "sediment_areas.gpkg"
        areas = pd.DataFrame(record["sediment_classes"])
        if path.name in written:
            areas = _table(path)
    except FileNotFoundError:
        raise InputError(f"{path}: expected the output folder of a run") from None
    except (OSError, ValueError, KeyError, TypeError, pyogrio.errors.DataSourceError) as error:
        told = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read: {told}") from None
    return Run(cells, areas, record)


def _table(path: Path) -> pd.DataFrame:
    meta, _, shapes, columns = pyogrio.raw.read(path)
    table = dict(zip(meta["fields"], columns, strict=True))
    return pd.DataFrame({**table, "geometry": shapely.from_wkb(shapes)})
