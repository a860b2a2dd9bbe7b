"""The catalogue of products: every file that a run writes, described once.

File names, band descriptions, styles, the QGIS project, the report, the STAC item and
docs/products.md are made from it. A new product with numbers of each cell takes an entry here and a
line in ``sasmap/products/cell_values.py``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

Kind = Literal["cells", "cell codes", "pixels", "pixel codes", "polygons", "lines", "file"]
Stage = Literal["ripples", "sediments", "run"]


class Ramp(NamedTuple):
    """How values are mapped to colours.

    Attributes
    ----------
    name : str
        Name of the matplotlib colour map.
    limits : tuple of float or None
        Values at the first and last colour; None for the range of the data, widened to at least
        the measured uncertainty.
    """

    name: str
    limits: tuple[float, float] | None = None


class Band(NamedTuple):
    """A band of a raster: its description and unit (empty for none)."""

    text: str
    unit: str


class Product(NamedTuple):
    """A file of the output folder.

    Attributes
    ----------
    file : str
        Its name.
    stage : str
        The stage that writes it: ripples, sediments, or run.
    kind : str
        Raster of numbers or codes with one pixel per cell (``cells``, ``cell codes``) or at full
        resolution (``pixels``, ``pixel codes``), ``polygons``, ``lines``, or another ``file``.
    title : str
        Name of its map layer.
    sentence : str
        What it holds.
    bands : tuple of Band
    ramp : Ramp or None
        Of the first band of rasters of numbers.
    symbol : str
        Symbol of the quantity, as the report writes it.
    shown : bool
        Whether its layer is switched on in the QGIS project.
    opacity : float
        Of its layer in the QGIS project.
    """

    file: str
    stage: Stage
    kind: Kind
    title: str
    sentence: str
    bands: tuple[Band, ...] = ()
    ramp: Ramp | None = None
    symbol: str = ""
    shown: bool = False
    opacity: float = 1.0

    @property
    def unit(self) -> str:
        """Unit of the first band; empty for none."""
        unit = self.bands[0].unit if self.bands else ""
        return "" if unit == "1" else unit

    @property
    def layer(self) -> bool:
        """Whether it is a map layer."""
        return self.kind != "file"

    @property
    def vector(self) -> bool:
        """Whether it is a GeoPackage."""
        return self.kind in ("polygons", "lines")

    @property
    def style(self) -> str:
        """File name of its QGIS style."""
        return self.file.rpartition(".")[0] + ".qml"

    @property
    def table(self) -> str:
        """Layer name in the GeoPackage."""
        return self.file.rpartition(".")[0].removeprefix("sediment_").removeprefix("ripple_")


def _statistics(quantity: str, unit: str) -> tuple[Band, ...]:
    """Mean, standard deviation and 5 and 95 % quantiles of a quantity."""
    return tuple(
        Band(f"{quantity}, {statistic}", unit)
        for statistic in ("mean", "standard deviation", "5 % quantile", "95 % quantile")
    )


LOG, MANIFEST, PROJECT, REPORT, ITEM = (
    "sasmap.log",
    "run.json",
    "survey.qgs",
    "report.html",
    "stac.json",
)
PROBABILITY = Ramp("cividis", (0.0, 1.0))

# In the order of the map's layers, topmost first.
CATALOGUE = (
    Product(
        "sediment_boundaries.gpkg",
        "sediments",
        "lines",
        "Sediment boundaries",
        "Class boundaries, refined by maximum likelihood: classes on the left and right, "
        "and standard deviation of the position (`position_sd`, m).",
        shown=True,
    ),
    Product(
        "ripple_cells.gpkg",
        "ripples",
        "polygons",
        "Ripples",
        "One polygon per cell: every ripple quantity with standard deviation and quantiles, the "
        "azimuth, the quality code and its reason in words, and the passes used.",
        ramp=Ramp("plasma"),
        shown=True,
    ),
    Product(
        "ripple_extent.gpkg",
        "ripples",
        "polygons",
        "Rippled sea floor",
        "Outlines of the rippled sea floor, traced pixel by pixel across cells: `area` (m²) and "
        "`wavelength` (m).",
        shown=True,
    ),
    Product(
        "ripple_wavelength.tif",
        "ripples",
        "cells",
        "Ripple wavelength",
        "Wavelength 1/f of the ripples, m.",
        _statistics("ripple wavelength 1/f", "m"),
        Ramp("viridis"),
        "λ",
    ),
    Product(
        "ripple_crest_to_trough.tif",
        "ripples",
        "cells",
        "Ripple height, crest to trough",
        "Height of the ripples from trough to crest, 2 A_H, m.",
        _statistics("ripple height from trough to crest, 2 A_H", "m"),
        Ramp("plasma"),
        "H",
    ),
    Product(
        "ripple_steepness.tif",
        "ripples",
        "cells",
        "Ripple steepness",
        "Steepness of the ripples: height from trough to crest over wavelength, 2 A_H f.",
        _statistics("ripple steepness, height from trough to crest over wavelength", "1"),
        Ramp("cividis"),
        "H/λ",
    ),
    Product(
        "ripple_frequency.tif",
        "ripples",
        "cells",
        "Ripple frequency f",
        "Spatial frequency f of the ripples, cycles/m.",
        _statistics("ripple frequency f", "cycles/m"),
        Ramp("viridis"),
        "f",
    ),
    Product(
        "ripple_height.tif",
        "ripples",
        "cells",
        "Ripple amplitude A_H",
        "Amplitude A_H of the ripples, m: half the height from trough to crest.",
        _statistics("ripple amplitude A_H, half the height from trough to crest", "m"),
        Ramp("magma"),
        "A_H",
    ),
    Product(
        "ripple_azimuth.tif",
        "ripples",
        "cells",
        "Azimuth of the crest normal",
        "Direction across the crests, degrees clockwise from grid north (0 to 180): axial mean and "
        "standard deviation.",
        (
            Band("azimuth of the crest normal clockwise from grid north, axial mean", "degrees"),
            Band("azimuth of the crest normal, standard deviation", "degrees"),
        ),
        Ramp("twilight", (0.0, 180.0)),
        "azimuth",
    ),
    Product(
        "ripple_probability.tif",
        "ripples",
        "cells",
        "Probability of ripples",
        "Probability that the cell is rippled.",
        (Band("probability that the cell is rippled", "1"),),
        PROBABILITY,
    ),
    Product(
        "ripple_quality.tif",
        "ripples",
        "cell codes",
        "Quality of cells",
        "Quality code: 1 good, 2 no ripples, 3 not converged, 4 passes contradict each other, "
        "5 not identifiable, 6 too few valid pixels, 7 failed; 0 no data.",
        (Band("quality code of the cell", ""),),
    ),
    Product(
        "ripple_passes.tif",
        "ripples",
        "cell codes",
        "Passes used",
        "Number of passes that the cell's values are estimated from.",
        (Band("number of passes used", "1"),),
        Ramp("viridis"),
    ),
    Product(
        "sediment_areas.gpkg",
        "sediments",
        "polygons",
        "Sediment areas",
        "Polygons of the sediments, without gaps or overlaps: `class`, `name`, `code`, `area_m2`, "
        "mean `confidence`, and whether most of it is `rippled`.",
    ),
    Product(
        "sediment_class.tif",
        "sediments",
        "pixel codes",
        "Sediments",
        "Class of each pixel, numbered by rising intensity or as in the survey file, with colours "
        "and names. Objects (wrecks, boulders) have the last number; shadow and water column "
        "belong to no class.",
        (Band("sediment class", ""),),
        shown=True,
        opacity=0.5,
    ),
    Product(
        "sediment_confidence.tif",
        "sediments",
        "pixels",
        "Probability of the class",
        "Probability of the mapped class at each pixel.",
        (Band("probability of the class", "1"),),
        PROBABILITY,
    ),
    Product(
        "modelled_amplitude.tif",
        "ripples",
        "pixels",
        "Modelled amplitude",
        "With `keep_model: true`: the image predicted by the estimate, to compare with the tile.",
        (Band("modelled amplitude, posterior mean", ""),),
        Ramp("gray"),
    ),
    Product(
        "mosaic.tif",
        "run",
        "pixels",
        "Sonar mosaic",
        "The amplitude of all passes on one grid, with gains matched where they overlap; the "
        "first pass of the survey file lies on top.",
        (Band("amplitude, linear, in units of the first pass", ""),),
        Ramp("gray"),
        shown=True,
    ),
    Product(
        "ripple_cells.csv",
        "ripples",
        "file",
        "Table of cells",
        "The attributes of `ripple_cells.gpkg` as a table, with the cells' centres.",
    ),
    Product(
        "ripples.nc",
        "ripples",
        "file",
        "Ripples by pass and cell",
        "Everything per pass and cell (NetCDF, CF-1.11): estimates before the pass, from the pass "
        "alone and after it, convergence, scattering law, crest profile, skipped steps; and "
        "the combined value of each quantity.",
    ),
    Product(
        "sediment_classes.json",
        "sediments",
        "file",
        "Fitted classes",
        "The fitted classes, for use in another survey (`model`).",
    ),
    Product(
        PROJECT,
        "run",
        "file",
        "QGIS project",
        "QGIS project of all layers, coloured and labelled, with a page to print; each layer has "
        "its `.qml` style as well.",
    ),
    Product(
        REPORT,
        "run",
        "file",
        "Report",
        "One page to read and print: the map, the numbers, some cells in detail, what was left out "
        "and why.",
    ),
    Product(ITEM, "run", "file", "STAC item", "Entry for a STAC catalogue."),
    Product(
        MANIFEST,
        "run",
        "file",
        "Record of the run",
        "Versions, settings, input hashes, counts, classes, failures, what was left out, seconds "
        "by stage.",
    ),
    Product(LOG, "run", "file", "Log", "Log of the run with times."),
)
BY_FILE = {product.file: product for product in CATALOGUE}


def files_of(stage: Stage) -> tuple[str, ...]:
    """Return the names of a stage's products, category names of code rasters included."""
    return tuple(_names_of(stage))


def _names_of(stage: Stage) -> Iterator[str]:
    for product in CATALOGUE:
        if product.stage == stage:
            yield product.file
            if product.kind.endswith("codes"):
                yield product.file + ".aux.xml"


RIPPLE_PRODUCTS, SEDIMENT_PRODUCTS = files_of("ripples"), files_of("sediments")
STYLES = tuple(product.style for product in CATALOGUE if product.layer)
# All files that a run may write.
PRODUCTS = frozenset({*RIPPLE_PRODUCTS, *SEDIMENT_PRODUCTS, *files_of("run"), *STYLES})
