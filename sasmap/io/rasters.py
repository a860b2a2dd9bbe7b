"""GeoTIFF products: Cloud-Optimized, described, with units, nodata and colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.shutil import copy
from rasterio.windows import Window

from sasmap.io.files import write_text, written_whole

# Rows of pixels written at once, and GDAL's cache, MB: these bound memory (a choice).
STRIPE, CACHE = 512, 64


@dataclass(frozen=True)
class Category:
    """A value of a class raster: its name and colour."""

    name: str
    colour: tuple[int, int, int, int]


@dataclass(frozen=True)
class Layer:
    """Contents of a raster, without its georeference.

    Attributes
    ----------
    bands : sequence of str
        Description of each band.
    units : sequence of str
        Unit of each band; empty for none.
    nodata : float
    dtype : str
    categories : mapping of int to Category
        Names and colours of a class raster; empty for a continuous one.
    tags : mapping of str to str
        Tags of the file.
    """

    bands: Sequence[str]
    units: Sequence[str]
    nodata: float
    dtype: str
    categories: Mapping[int, Category] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)


def write_cog(
    path: Path,
    values: NDArray[Any],
    layer: Layer,
    transform: Affine,
    crs: str,
    scratch: Path,
) -> None:
    """Write a Cloud-Optimized GeoTIFF, whole or not at all.

    Parameters
    ----------
    path : Path
    values : ndarray (bands, rows, columns)
    layer : Layer
    transform : Affine
    crs : str
        WKT.
    scratch : Path
        Folder for the unfinished file.

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    bands, rows, columns = values.shape
    profile = {
        **_profile(layer, (bands, rows, columns), transform, crs),
        "driver": "COG",
        "blocksize": 512,
        **_overviews(layer),
    }
    with written_whole(path, scratch) as part:
        try:
            # GDAL's auxiliary XML would have the unfinished file's name
            with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(part, "w", **profile) as target:
                target.write(values.astype(layer.dtype))
                _describe(target, layer)
        except rasterio.errors.RasterioError as error:
            raise OSError(f"{path}: cannot be written: {error}") from None
    if layer.categories:
        write_text(path.with_name(path.name + ".aux.xml"), _category_names(layer), scratch)


def write_large_cog(
    path: Path, values: Any, layer: Layer, transform: Affine, crs: str, scratch: Path
) -> None:
    """Write a Cloud-Optimized GeoTIFF of one band that need not fit into memory.

    Parameters
    ----------
    path : Path
    values : array (rows, columns)
        Of the layer's type; read in stripes of rows.
    layer : Layer
    transform : Affine
    crs : str
        WKT.
    scratch : Path

    Raises
    ------
    OSError
        Where the file cannot be written.
    """
    rows, columns = values.shape
    plain = scratch / f"{path.stem}.plain.part"
    profile = {**_profile(layer, (1, rows, columns), transform, crs), "driver": "GTiff"}
    if rows > STRIPE and columns > STRIPE:
        profile |= {"tiled": True, "blockxsize": STRIPE, "blockysize": STRIPE}
    settings = {"GDAL_PAM_ENABLED": "NO", "GDAL_CACHEMAX": CACHE}
    try:
        with rasterio.Env(**settings), written_whole(path, scratch) as part:
            with rasterio.open(plain, "w", **profile | {"compress": "none"}) as target:
                for top in range(0, rows, STRIPE):
                    stripe = np.asarray(values[slice(top, min(top + STRIPE, rows))])
                    window = Window(0, top, columns, stripe.shape[0])
                    target.write(stripe.astype(layer.dtype), 1, window=window)
                _describe(target, layer)
            options = {"compress": "deflate", "blocksize": 512, **_overviews(layer)}
            copy(plain, part, driver="COG", **options)
    except rasterio.errors.RasterioError as error:
        raise OSError(f"{path}: cannot be written: {error}") from None
    finally:
        plain.unlink(missing_ok=True)
    if layer.categories:
        write_text(path.with_name(path.name + ".aux.xml"), _category_names(layer), scratch)


def _profile(
    layer: Layer, shape: tuple[int, int, int], transform: Affine, crs: str
) -> dict[str, Any]:
    return {
        "dtype": layer.dtype,
        "count": shape[0],
        "height": shape[1],
        "width": shape[2],
        "crs": rasterio.crs.CRS.from_wkt(crs),
        "transform": transform,
        "nodata": layer.nodata,
        "compress": "deflate",
        "bigtiff": "if_safer",
    }


def _overviews(layer: Layer) -> dict[str, Any]:
    # threads do not change the bytes: blocks are compressed one by one
    return {
        "overview_resampling": "nearest" if layer.categories else "average",
        "num_threads": "all_cpus",
    }


def _describe(target: Any, layer: Layer) -> None:
    for band, (text, unit) in enumerate(zip(layer.bands, layer.units, strict=True), 1):
        target.set_band_description(band, text)
        if unit:
            target.set_band_unit(band, unit)
    target.update_tags(**layer.tags)
    if layer.categories:
        table = {value: c.colour for value, c in layer.categories.items()}
        target.write_colormap(1, table)


def _category_names(layer: Layer) -> str:
    """Category names as GDAL reads them; a GeoTIFF itself cannot hold them."""
    names = [
        layer.categories[value].name if value in layer.categories else ""
        for value in range(max(layer.categories) + 1)
    ]
    lines = "\n".join(f"      <Category>{escape(name)}</Category>" for name in names)
    return (
        '<PAMDataset>\n  <PAMRasterBand band="1">\n    <CategoryNames>\n'
        f"{lines}\n    </CategoryNames>\n  </PAMRasterBand>\n</PAMDataset>\n"
    )


NAN = float("nan")


def float_layer(
    bands: Sequence[str], units: Sequence[str], tags: Mapping[str, str] | None = None
) -> Layer:
    """Return a float32 layer with nodata NaN."""
    return Layer(bands, units, NAN, "float32", tags=tags or {})


def as_bands(*bands: NDArray[Any]) -> NDArray[Any]:
    """Stack (rows, columns) arrays into (bands, rows, columns)."""
    return np.stack(bands)
