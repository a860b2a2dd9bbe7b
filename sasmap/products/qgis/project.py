"""survey.qgs: the project of all layers, and a style beside each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import pyogrio
import rasterio

from sasmap.catalogue import BY_FILE, CATALOGUE, PROJECT, STYLES
from sasmap.io.files import write_text
from sasmap.products.qgis.layout import Sheet, add_layouts
from sasmap.products.qgis.styles import Categories, style_of
from sasmap.products.qgis.xml import VERSION, child, options, spatial_reference, text_of


class Titles(NamedTuple):
    """Texts of the project.

    Attributes
    ----------
    name : str
    dates : str
        Dates of the survey; empty where the survey file gives none.
    run_id, software : str
    """

    name: str
    dates: str
    run_id: str
    software: str


def write_styles(
    folder: Path, products: Sequence[str], names: Categories, titles: Titles, scratch: Path
) -> list[Path]:
    """Write a .qml beside each layer that has content, and the project that loads them.

    Parameters
    ----------
    folder : Path
        Of the products.
    products : sequence of str
        File names of those that the run wrote.
    names : Categories
    titles : Titles
    scratch : Path

    Returns
    -------
    list of Path
    """
    written = []
    layers = [p.file for p in CATALOGUE if p.layer and p.file in products]
    drawn = ((name, style_of(folder / name, names)) for name in layers)
    styles = {name: style for name, style in drawn if style is not None}
    for name, style in styles.items():
        path = folder / BY_FILE[name].style
        root = ET.Element("qgis", version=VERSION, styleCategories="Symbology|Labeling|Rendering")
        root.extend(style)
        write_text(path, text_of(root), scratch)
        written.append(path)
    for name in set(STYLES) - {path.name for path in written}:
        (folder / name).unlink(missing_ok=True)  # of a product of an earlier run
    if any(name.endswith(".tif") for name in styles):
        written.append(folder / PROJECT)
        write_text(written[-1], _project(folder, styles, titles), scratch)
    return written


def _project(folder: Path, styles: Mapping[str, list[ET.Element]], titles: Titles) -> str:
    """Write a project with the layers in order, by paths relative to it."""
    with rasterio.open(folder / next(n for n in styles if n.endswith(".tif"))) as source:
        crs, box = source.crs.to_wkt(), source.bounds
    root = ET.Element("qgis", version=VERSION, projectname=titles.name)
    child(root, "title").text = titles.name
    child(root, "projectCrs").append(spatial_reference(crs))
    sources = {name: _source(folder / name) for name in styles}
    tree = child(root, "layer-tree-group")
    _list_layers(tree, sources, styles, list(styles))
    canvas = child(root, "mapcanvas", name="theMapCanvas", annotationsVisible="1")
    child(canvas, "units").text = "meters"
    extent = child(canvas, "extent")
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), box, strict=True):
        child(extent, name).text = repr(value)
    child(canvas, "destinationsrs").append(spatial_reference(crs))
    layers = child(root, "projectlayers")
    for name, style in styles.items():
        layers.append(_layer(folder / name, sources[name], crs, style))
    properties = child(root, "properties")
    child(child(properties, "Paths"), "Absolute", type="bool").text = "false"
    child(child(properties, "SpatialRefSys"), "ProjectionsEnabled", type="int").text = "1"
    legend = ET.Element("layer-tree-group")
    _list_layers(legend, sources, styles, [n for n in styles if BY_FILE[n].shown])
    software = f"{titles.software}, run {titles.run_id}"
    ripples = "ripple_cells.gpkg" in styles
    sheet = Sheet(titles.name, titles.dates, software, crs, box, ripples)
    add_layouts(root, sheet, legend)
    return text_of(root)


def _list_layers(
    tree: ET.Element,
    sources: Mapping[str, str],
    styles: Mapping[str, list[ET.Element]],
    names: Sequence[str],
) -> None:
    for name in names:
        product = BY_FILE[name]
        node = child(
            tree,
            "layer-tree-layer",
            id=_identity(name),
            name=_title(name),
            source=sources[name],
            providerKey="ogr" if product.vector else "gdal",
            checked="Qt::Checked" if product.shown else "Qt::Unchecked",
            expanded="1" if product.shown and name != "mosaic.tif" else "0",
        )
        if not product.vector:
            # without the legend's first line, which repeats the band's description
            order = ",".join(str(k) for k in range(1, _legend_lines(styles[name])))
            options(child(node, "customproperties"), {"legend/node-order": order})


def _legend_lines(style: Sequence[ET.Element]) -> int:
    """Count the lines of a raster's legend: the band's name and its colours."""
    entries = sum(1 for element in style for _ in element.iter("paletteEntry"))
    return 1 + max(entries, 1)


def _title(name: str) -> str:
    product = BY_FILE[name]
    return f"{product.title}, {product.unit}" if product.unit else product.title


def _identity(name: str) -> str:
    return "sasmap_" + name.replace(".", "_")  # QGIS gives ids of ten letters or fewer a new one


def _source(path: Path) -> str:
    if path.suffix != ".gpkg":
        return f"./{path.name}"
    return f"./{path.name}|layername={pyogrio.list_layers(path)[0][0]}"


def _layer(path: Path, source: str, crs: str, style: list[ET.Element]) -> ET.Element:
    vector = BY_FILE[path.name].vector
    geometry = "Line" if BY_FILE[path.name].kind == "lines" else "Polygon"
    kind = {"type": "vector", "geometry": geometry} if vector else {"type": "raster"}
    layer = ET.Element("maplayer", kind)
    child(layer, "id").text = _identity(path.name)
    child(layer, "datasource").text = source
    child(layer, "layername").text = _title(path.name)
    child(layer, "srs").append(spatial_reference(crs))
    child(layer, "provider").text = "ogr" if vector else "gdal"
    child(layer, "abstract").text = BY_FILE[path.name].sentence.replace("`", "")
    layer.extend(style)
    return layer
