"""The print layout: map, legend, scale bar, north arrow, CRS and date."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pyproj

from sasmap.products.qgis.xml import child, line_settings, symbol, symbol_layer

# QGIS's type numbers of layout items.
PAGE, MAP, LEGEND, PICTURE, LABEL, SCALE_BAR = 65638, 65639, 65642, 65640, 65641, 65646
# A4 landscape and the boxes of its items: left, top, width, height, mm.
PAPER = (0.0, 0.0, 297.0, 210.0)
MAP_PLACE = (10.0, 22.0, 205.0, 178.0)
TITLE_PLACE = (10.0, 8.0, 205.0, 11.0)
LEGEND_PLACE = (220.0, 30.0, 67.0, 110.0)
ARROW_PLACE = (272.0, 8.0, 12.0, 18.0)
BAR_PLACE = (220.0, 150.0, 67.0, 14.0)
NOTES_PLACE = (220.0, 168.0, 67.0, 32.0)
# Margin around the survey on the map, over its size (a choice).
MARGIN = 0.04
ARROW = ":/images/north_arrows/layout_default_north_arrow.svg"


class Sheet(NamedTuple):
    """Text of the page.

    Attributes
    ----------
    name, dates, software : str
    crs : str
        WKT.
    box : tuple of float
        Left, bottom, right, top of the survey, m.
    ripples : bool
        Whether ripples are drawn.
    """

    name: str
    dates: str
    software: str
    crs: str
    box: tuple[float, float, float, float]
    ripples: bool


def add_layouts(root: ET.Element, sheet: Sheet, legend: ET.Element) -> None:
    """Append a print layout named "Map" to a project.

    Parameters
    ----------
    root : Element
    sheet : Sheet
    legend : Element
        Layer tree of what the legend lists.
    """
    layouts = child(root, "Layouts")
    layout = child(layouts, "Layout", name="Map", units="mm", printResolution="300")
    pages = child(layout, "PageCollection")
    _white(pages)
    _white(_item(pages, PAGE, "page", PAPER))
    extent = _extent(sheet.box)
    chart = _item(layout, MAP, "map", MAP_PLACE, frame="true", drawCanvasItems="true")
    names = ("xmin", "ymin", "xmax", "ymax")
    child(chart, "Extent", **{k: repr(v) for k, v in zip(names, extent, strict=True)})
    child(chart, "LayerSet")
    _legend(layout, legend)
    _scale_bar(layout, extent)
    _item(
        layout, PICTURE, "north", ARROW_PLACE, file=ARROW, mapUuid=_id("map"), mode="2",
        northMode="0", northOffset="0", resizeMode="0", anchorPoint="4",
    )  # fmt: skip
    _label(layout, "title", TITLE_PLACE, sheet.name, 16)
    _label(layout, "notes", NOTES_PLACE, _notes(sheet), 7)


def _notes(sheet: Sheet) -> str:
    crs = pyproj.CRS.from_wkt(sheet.crs)
    authority = crs.to_authority()
    code = f" ({':'.join(authority)})" if authority else ""
    surveyed = f"surveyed {sheet.dates}\n" if sheet.dates else ""
    ripples = (
        "Ripples: lines along the crests, longer for longer wavelengths; dotted where flagged. "
        "λ wavelength, H height from trough to crest, ± one standard deviation.\n"
    )
    return (
        f"{ripples if sheet.ripples else ''}CRS {crs.name}{code}\n"
        f"scale 1 : [% round(item_variables('map')['map_scale']) %]\n{surveyed}"
        f"printed [% format_date(now(), 'yyyy-MM-dd') %]\n{sheet.software}"
    )


def _extent(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Widen a box (m) to the aspect ratio of the map on the page."""
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    across, down = ((1 + 2 * MARGIN) * (b - a) for a, b in ((box[0], box[2]), (box[1], box[3])))
    scale = max(across / MAP_PLACE[2], down / MAP_PLACE[3])  # m per mm
    half = scale * MAP_PLACE[2] / 2, scale * MAP_PLACE[3] / 2
    return x - half[0], y - half[1], x + half[0], y + half[1]


def _id(name: str) -> str:
    return f"{{{uuid.uuid5(uuid.NAMESPACE_URL, f'sasmap/layout/{name}')}}}"


def _item(
    parent: ET.Element,
    kind: int,
    name: str,
    place: tuple[float, float, float, float],
    **settings: str,
) -> ET.Element:
    left, top, width, height = place
    common: Mapping[str, str] = {
        "type": str(kind),
        "id": name,
        "uuid": _id(name),
        "templateUuid": _id(name),
        "position": f"{left:g},{top:g},mm",
        "positionOnPage": f"{left:g},{top:g},mm",
        "size": f"{width:g},{height:g},mm",
        "referencePoint": "0",
        "visibility": "1",
        "opacity": "1",
        "background": "false",
        "frame": "false",
        "outlineWidthM": "0.2,mm",
    }
    item = ET.SubElement(parent, "LayoutItem", {**common, **settings})
    child(item, "FrameColor", red="0", green="0", blue="0", alpha="255")
    child(item, "BackgroundColor", red="255", green="255", blue="255", alpha="255")
    return item


def _white(parent: ET.Element) -> None:
    fill = symbol(parent, "fill", "")
    settings = {"color": "255,255,255,255", "style": "solid", "outline_style": "no"}
    symbol_layer(fill, "SimpleFill", settings)


def _label(
    layout: ET.Element, name: str, place: tuple[float, float, float, float], text: str, size: int
) -> None:
    item = _item(
        layout, LABEL, name, place, labelText=text, htmlState="0", valign="32", halign="1",
        marginX="0", marginY="0",
    )  # fmt: skip
    child(item, "LabelFont", description=f"Sans Serif,{size},-1,5,50,0,0,0,0,0", style="")
    child(item, "FontColor", red="0", green="0", blue="0", alpha="255")


def _legend(layout: ET.Element, tree: ET.Element) -> None:
    item = _item(
        layout, LEGEND, "legend", LEGEND_PLACE, map_uuid=_id("map"), title="", columnCount="1",
        resizeToContents="1", symbolWidth="7", symbolHeight="4", boxSpace="0", wrapChar="",
        rasterBorder="0",
    )  # fmt: skip
    styles = child(item, "styles")
    for name, size in (("title", 10), ("group", 9), ("subgroup", 9), ("symbolLabel", 8)):
        style = child(styles, "style", name=name, marginTop="2", marginLeft="2", alignment="1")
        child(style, "styleFont", description=f"Sans Serif,{size},-1,5,50,0,0,0,0,0", style="")
    item.append(tree)


def _scale_bar(layout: ET.Element, extent: tuple[float, float, float, float]) -> None:
    a_mm = (extent[2] - extent[0]) / MAP_PLACE[2]
    rough = 25 * a_mm  # m of a segment of 25 mm
    step = 10.0 ** np.floor(np.log10(rough))
    length = float(max(v * step for v in (1, 2, 5) if v * step <= rough))
    item = _item(
        layout, SCALE_BAR, "scale", BAR_PLACE, mapUuid=_id("map"), style="Single Box",
        numSegments="2", numSegmentsLeft="0", numUnitsPerSegment=f"{length:g}",
        numMapUnitsPerScaleBarUnit="1", unitType="meters", unitLabel="m", segmentSizeMode="0",
        segmentMillimeters=f"{length / a_mm:g}", height="3", labelBarSpace="2",
        boxContentSpace="1", subdivisionsHeight="1.5", numSubdivisions="1",
        minBarWidth="20", maxBarWidth="60", outlineWidth="0.2", alignment="0",
    )  # fmt: skip
    child(
        item, "text-style", fontFamily="Sans Serif", fontSize="8", fontSizeUnit="Point",
        textColor="0,0,0,255",
    )  # fmt: skip
    child(item, "fillColor", red="0", green="0", blue="0", alpha="255")
    child(item, "fillColor2", red="255", green="255", blue="255", alpha="255")
    child(item, "strokeColor", red="0", green="0", blue="0", alpha="255")
    for name in ("lineSymbol", "divisionLineSymbol", "subdivisionLineSymbol"):
        one = symbol(child(item, name), "line", "")
        symbol_layer(one, "SimpleLine", line_settings((0, 0, 0), 0.2))
    for name in ("fillSymbol1", "fillSymbol2"):
        one = symbol(child(item, name), "fill", "")
        colour = "0,0,0,255" if name.endswith("1") else "255,255,255,255"
        symbol_layer(one, "SimpleFill", {"color": colour, "style": "solid"})
