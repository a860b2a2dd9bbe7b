"""Styles and a project file, so that QGIS opens products coloured and labelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pyproj
import rasterio

from sasmap.io.files import write_text
from sasmap.products.colours import PASSES, RAMPS, Colour, Ramp, class_colour, hexadecimal, stops
from sasmap.ripples.posterior import Quality

VERSION = "3.22"
PROJECT = "survey.qgs"
EXTENT = "ripple_extent.gpkg"
# Of layers, from the topmost; those shown at first.
ORDER = (
    "sediment_boundaries.gpkg",
    EXTENT,
    "ripple_frequency.tif",
    "ripple_height.tif",
    "ripple_azimuth.tif",
    "ripple_probability.tif",
    "ripple_quality.tif",
    "ripple_passes.tif",
    "sediment_class.tif",
    "sediment_confidence.tif",
    "modelled_amplitude.tif",
)
SHOWN = ("sediment_boundaries.gpkg", "ripple_frequency.tif", "sediment_class.tif")
TITLES = {
    "sediment_boundaries.gpkg": "Sediment boundaries",
    EXTENT: "Rippled sea floor",
    "ripple_quality.tif": "Quality of cells",
    "ripple_passes.tif": "Passes used",
    "sediment_class.tif": "Sediments",
    **{name: f"{r.title}, {r.unit}" if r.unit else r.title for name, r in RAMPS.items()},
}


class Names(NamedTuple):
    """Categories of the class rasters: value to name and colour.

    Attributes
    ----------
    quality, sediments : mapping of int to (str, colour)
    """

    quality: Mapping[int, tuple[str, Colour]]
    sediments: Mapping[int, tuple[str, Colour]]


def categories(classes: Sequence[str], quality: Mapping[Quality, Colour]) -> Names:
    """Names and colours of the class rasters' values.

    Parameters
    ----------
    classes : sequence of str
        Sediments, from number 1.
    quality : mapping of Quality to colour

    Returns
    -------
    Names
    """
    return Names(
        {int(q): (q.label, colour) for q, colour in quality.items()},
        {k + 1: (name, class_colour(k)) for k, name in enumerate(classes)},
    )


def write_styles(folder: Path, products: Sequence[str], names: Names, scratch: Path) -> list[Path]:
    """Write a .qml beside each raster and the boundary layer, and the project that loads them.

    Parameters
    ----------
    folder : Path
        Of the products.
    products : sequence of str
        File names of those that the run wrote.
    names : Names
    scratch : Path

    Returns
    -------
    list of Path
    """
    written = []
    layers = [name for name in ORDER if name in products]
    styles = {name: _style(folder / name, names) for name in layers}
    for name in layers:
        path = (folder / name).with_suffix(".qml")
        root = ET.Element("qgis", version=VERSION, styleCategories="Symbology|Labeling|Rendering")
        root.extend(styles[name])
        write_text(path, _text(root), scratch)
        written.append(path)
    if layers:
        written.append(folder / PROJECT)
        write_text(written[-1], _project(folder, styles), scratch)
    return written


def _text(root: ET.Element) -> str:
    ET.indent(root)
    head = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
    return head + ET.tostring(root, encoding="unicode") + "\n"


def _style(path: Path, names: Names) -> list[ET.Element]:
    """Elements that draw a product."""
    if path.name == EXTENT:
        return [_outline()]
    if path.suffix == ".gpkg":
        return _boundaries(names.sediments)
    pipe = ET.Element("pipe")
    if path.name in RAMPS:
        pipe.append(_pseudocolour(RAMPS[path.name], *_limits(path, RAMPS[path.name])))
    elif path.name == "ripple_passes.tif":
        most = max(round(_limits(path, PASSES)[1]), 1)
        values = {int(v): (f"{v:.0f}", c) for v, c in stops(PASSES, 0, most, most + 1)}
        pipe.append(_paletted(values))
    else:
        sediments = path.name == "sediment_class.tif"
        pipe.append(_paletted(names.sediments if sediments else names.quality))
    ET.SubElement(pipe, "rasterresampler", maxOversampling="2")
    return [pipe]


def _limits(path: Path, ramp: Ramp) -> tuple[float, float]:
    if ramp.limits is not None:
        return ramp.limits
    with rasterio.open(path) as source:
        factor = max(1, max(source.shape) // 1000)
        shape = (max(source.height // factor, 1), max(source.width // factor, 1))
        values = source.read(1, out_shape=shape, masked=True).compressed()
    if values.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.quantile(values, [0.0, 1.0]))
    return (low, high) if high > low else (low - 0.05 * abs(low), high + 0.05 * abs(high) + 1e-9)


def _pseudocolour(ramp: Ramp, low: float, high: float) -> ET.Element:
    renderer = ET.Element(
        "rasterrenderer",
        type="singlebandpseudocolor",
        band="1",
        opacity="1",
        alphaBand="-1",
        classificationMin=repr(low),
        classificationMax=repr(high),
    )
    shader = ET.SubElement(
        ET.SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode="2",
        clip="0",
        minimumValue=repr(low),
        maximumValue=repr(high),
    )
    for value, colour in stops(ramp, low, high):
        label = f"{value:.4g} {ramp.unit}".strip()
        ET.SubElement(
            shader, "item", value=repr(value), color=hexadecimal(colour), label=label, alpha="255"
        )
    return renderer


def _paletted(values: Mapping[int, tuple[str, Colour]]) -> ET.Element:
    renderer = ET.Element("rasterrenderer", type="paletted", band="1", opacity="1", alphaBand="-1")
    palette = ET.SubElement(renderer, "colorPalette")
    for value, (name, colour) in values.items():
        ET.SubElement(
            palette,
            "paletteEntry",
            value=str(value),
            color=hexadecimal(colour),
            label=name,
            alpha="255",
        )
    return renderer


def _boundaries(sediments: Mapping[int, tuple[str, Colour]]) -> list[ET.Element]:
    """Draw a line for each pair of classes, its two sides in their colours; labelled."""
    renderer = ET.Element(
        "renderer-v2",
        type="categorizedSymbol",
        attr='"left" || \' | \' || "right"',
        symbollevels="0",
        enableorderby="0",
        forceraster="0",
    )
    listed, symbols = ET.SubElement(renderer, "categories"), ET.SubElement(renderer, "symbols")
    pairs = [(a, b) for a in sediments.values() for b in sediments.values() if a != b]
    for k, (left, right) in enumerate(pairs):
        name = f"{left[0]} | {right[0]}"
        ET.SubElement(listed, "category", symbol=str(k), value=name, label=name, render="true")
        symbol = ET.SubElement(
            symbols, "symbol", type="line", name=str(k), alpha="1", clip_to_extent="1"
        )
        for colour, offset in ((left[1], -0.3), (right[1], 0.3)):
            _simple_line(symbol, colour, 0.6, offset)
        _simple_line(symbol, (0, 0, 0), 0.2, 0.0)
    return [renderer, _labels()]


def _outline() -> ET.Element:
    """Draw areas by their outline alone."""
    renderer = ET.Element("renderer-v2", type="singleSymbol", symbollevels="0", forceraster="0")
    symbols = ET.SubElement(renderer, "symbols")
    symbol = ET.SubElement(symbols, "symbol", type="fill", name="0", alpha="1", clip_to_extent="1")
    _simple_line(symbol, (213, 94, 0), 0.5, 0.0)
    return renderer


def _simple_line(symbol: ET.Element, colour: Colour, width: float, offset: float) -> None:
    layer = ET.SubElement(
        symbol, "layer", {"class": "SimpleLine", "enabled": "1", "locked": "0", "pass": "0"}
    )
    options = ET.SubElement(layer, "Option", type="Map")
    settings = {
        "line_color": ",".join(map(str, (*colour, 255))),
        "line_width": str(width),
        "line_width_unit": "MM",
        "offset": str(offset),
        "offset_unit": "MM",
        "capstyle": "round",
        "joinstyle": "round",
        "line_style": "solid",
    }
    for name, value in settings.items():
        ET.SubElement(options, "Option", name=name, value=value, type="QString")


def _labels() -> ET.Element:
    labeling = ET.Element("labeling", type="simple")
    settings = ET.SubElement(labeling, "settings", calloutType="simple")
    told = "\"left\" || ' | ' || \"right\" || ', ±' || round(\"position_sd\", 2) || ' m'"
    style = ET.SubElement(
        settings,
        "text-style",
        fieldName=told,
        isExpression="1",
        fontSize="8",
        textColor="0,0,0,255",
    )
    ET.SubElement(
        style, "text-buffer", bufferDraw="1", bufferSize="1", bufferColor="255,255,255,255"
    )
    ET.SubElement(settings, "placement", placement="2", placementFlags="10")
    ET.SubElement(settings, "rendering", drawLabels="1")
    return labeling


def _project(folder: Path, styles: Mapping[str, list[ET.Element]]) -> str:
    """Write a project with the layers in order, by paths relative to it."""
    with rasterio.open(folder / next(n for n in styles if n.endswith(".tif"))) as source:
        crs, box = source.crs.to_wkt(), source.bounds
    root = ET.Element("qgis", version=VERSION, projectname="sasmap")
    ET.SubElement(root, "title").text = "sasmap"
    ET.SubElement(root, "projectCrs").append(_srs(crs))
    tree = ET.SubElement(root, "layer-tree-group")
    canvas = ET.SubElement(root, "mapcanvas", name="theMapCanvas", annotationsVisible="1")
    ET.SubElement(canvas, "units").text = "meters"
    extent = ET.SubElement(canvas, "extent")
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), box, strict=True):
        ET.SubElement(extent, name).text = repr(value)
    ET.SubElement(canvas, "destinationsrs").append(_srs(crs))
    layers = ET.SubElement(root, "projectlayers")
    for name, style in styles.items():
        ET.SubElement(
            tree,
            "layer-tree-layer",
            id=_identity(name),
            name=TITLES[name],
            source=_source(name),
            providerKey="ogr" if name.endswith(".gpkg") else "gdal",
            checked="Qt::Checked" if name in SHOWN else "Qt::Unchecked",
            expanded="1" if name in SHOWN else "0",
        )
        layers.append(_layer(name, crs, style))
    properties = ET.SubElement(root, "properties")
    paths = ET.SubElement(properties, "Paths")
    ET.SubElement(paths, "Absolute", type="bool").text = "false"
    reference = ET.SubElement(properties, "SpatialRefSys")
    ET.SubElement(reference, "ProjectionsEnabled", type="int").text = "1"
    return _text(root)


def _identity(name: str) -> str:
    return name.replace(".", "_")


def _source(name: str) -> str:
    layer = "extent" if name == EXTENT else "boundaries"
    return f"./{name}|layername={layer}" if name.endswith(".gpkg") else f"./{name}"


def _layer(name: str, crs: str, style: list[ET.Element]) -> ET.Element:
    vector = name.endswith(".gpkg")
    shape = "Polygon" if name == EXTENT else "Line"
    kind = {"type": "vector", "geometry": shape} if vector else {"type": "raster"}
    layer = ET.Element("maplayer", kind)
    ET.SubElement(layer, "id").text = _identity(name)
    ET.SubElement(layer, "datasource").text = _source(name)
    ET.SubElement(layer, "layername").text = TITLES[name]
    ET.SubElement(layer, "srs").append(_srs(crs))
    ET.SubElement(layer, "provider").text = "ogr" if vector else "gdal"
    layer.extend(style)
    return layer


def _srs(wkt: str) -> ET.Element:
    crs = pyproj.CRS.from_wkt(wkt)
    srs = ET.Element("spatialrefsys")
    ET.SubElement(srs, "wkt").text = crs.to_wkt()
    authority = crs.to_authority()
    if authority is not None:
        ET.SubElement(srs, "authid").text = ":".join(authority)
    ET.SubElement(srs, "description").text = crs.name
    return srs
