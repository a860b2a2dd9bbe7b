"""QGIS XML elements shared by styles, project and print layout (format of QGIS 3.22)."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

import pyproj

from sasmap.products.colours import Colour

VERSION = "3.22"


def text_of(root: ET.Element) -> str:
    """Write a document as QGIS does."""
    ET.indent(root)
    head = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
    return head + ET.tostring(root, encoding="unicode") + "\n"


def child(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    """Append an element; an attribute named ``class_`` becomes ``class``."""
    return ET.SubElement(parent, tag, {k.rstrip("_"): v for k, v in attributes.items()})


def options(parent: ET.Element, values: Mapping[str, str]) -> None:
    """Append an option map of texts."""
    holder = child(parent, "Option", type="Map")
    for name, value in values.items():
        child(holder, "Option", name=name, value=value, type="QString")


def symbol(parent: ET.Element, kind: str, name: str) -> ET.Element:
    """Append an empty symbol: line, fill or marker."""
    return child(parent, "symbol", type=kind, name=name, alpha="1", clip_to_extent="1")


def symbol_layer(
    parent: ET.Element,
    kind: str,
    settings: Mapping[str, str],
    expressions: Mapping[str, str] | None = None,
) -> ET.Element:
    """Append a layer to a symbol.

    Parameters
    ----------
    parent : Element
    kind : str
        Class of the layer, as ``SimpleLine``.
    settings : mapping of str to str
    expressions : mapping of str to str, optional
        Data-defined properties.

    Returns
    -------
    Element
    """
    layer = child(parent, "layer", class_=kind, enabled="1", locked="0", pass_="0")
    options(layer, settings)
    if expressions:
        holder = child(child(layer, "data_defined_properties"), "Option", type="Map")
        child(holder, "Option", name="name", value="", type="QString")
        properties = child(holder, "Option", name="properties", type="Map")
        for name, expression in expressions.items():
            one = child(properties, "Option", name=name, type="Map")
            child(one, "Option", name="active", value="true", type="bool")
            child(one, "Option", name="expression", value=expression, type="QString")
            child(one, "Option", name="type", value="3", type="int")
        child(holder, "Option", name="type", value="collection", type="QString")
    return layer


def line_settings(
    colour: Colour, width: float, unit: str = "MM", alpha: int = 255
) -> dict[str, str]:
    """Return settings of a solid simple line."""
    return {
        "line_color": ",".join(map(str, (*colour, alpha))),
        "line_width": f"{width:g}",
        "line_width_unit": unit,
        "capstyle": "round",
        "joinstyle": "round",
        "line_style": "solid",
    }


def spatial_reference(wkt: str) -> ET.Element:
    """Return a CRS as QGIS writes it."""
    crs = pyproj.CRS.from_wkt(wkt)
    element = ET.Element("spatialrefsys")
    ET.SubElement(element, "wkt").text = crs.to_wkt()
    authority = crs.to_authority()
    if authority is not None:
        ET.SubElement(element, "authid").text = ":".join(authority)
    ET.SubElement(element, "description").text = crs.name
    return element
