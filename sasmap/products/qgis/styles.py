"""How QGIS draws each product."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pyogrio

from sasmap.catalogue import BY_FILE, Product, Ramp
from sasmap.products.colours import Colour, class_colour, colour_at, hexadecimal, stops
from sasmap.products.qgis.xml import child, line_settings, symbol, symbol_layer
from sasmap.products.ranges import GAMMA, digits_for, has_content, padded_range, range_of, sampled
from sasmap.ripples.posterior import Quality

BLACK, WHITE = (0, 0, 0), (255, 255, 255)
# Colour classes of the ripple symbols, and length of the longest symbol over a cell's side.
RANGES, LONGEST = 5, 0.8
# Half-width of the band along a boundary, in standard deviations: 95 % of a Gaussian.
BAND = 1.96
# Name of a boundary's pair of classes, the same whichever is left.
PAIR = 'if("left" < "right", "left" || \' | \' || "right", "right" || \' | \' || "left")'


class Categories(NamedTuple):
    """Categories of the class rasters: value to name and colour.

    Attributes
    ----------
    quality, sediments : mapping of int to (str, colour)
    """

    quality: Mapping[int, tuple[str, Colour]]
    sediments: Mapping[int, tuple[str, Colour]]


def categories(classes: Sequence[str], quality: Mapping[Quality, Colour]) -> Categories:
    """Names and colours of the class rasters' values.

    Parameters
    ----------
    classes : sequence of str
        Sediments, from number 1.
    quality : mapping of Quality to colour

    Returns
    -------
    Categories
    """
    return Categories(
        {int(q): (q.label, colour) for q, colour in quality.items()},
        {k + 1: (name, class_colour(k)) for k, name in enumerate(classes)},
    )


def style_of(path: Path, names: Categories) -> list[ET.Element] | None:
    """Return the elements that draw a product, or None where it has no content.

    Parameters
    ----------
    path : Path
        A layer of the catalogue.
    names : Categories

    Returns
    -------
    list of Element or None
    """
    product = BY_FILE[path.name]
    if product.vector:
        return _vector(path, names)
    if not has_content(path):
        return None
    pipe = ET.Element("pipe")
    if product.kind in ("cell codes", "pixel codes"):
        shown = _codes(path, product, names)
        if not shown:
            return None
        pipe.append(_paletted(shown, product.opacity))
    elif product.ramp is not None and product.ramp.name == "gray":
        pipe.append(_grey(*(float(f"{v:.3g}") for v in range_of(path))))
        # darker floor keeps the hue of the sediments laid over it
        ET.SubElement(pipe, "brightnesscontrast", brightness="0", contrast="0", gamma=f"{GAMMA:g}")
    else:
        pipe.append(_pseudocolour(product, *range_of(path)))
    ET.SubElement(pipe, "rasterresampler", maxOversampling="2")
    return [pipe]


def _codes(path: Path, product: Product, names: Categories) -> dict[int, tuple[str, Colour]]:
    """Codes that occur in a raster, with names and colours."""
    there = {int(v) for v in np.unique(sampled(path, 1))}
    if product.file == "ripple_passes.tif":
        assert product.ramp is not None
        most = max(there, default=0)
        if most == 0:
            return {}
        return {v: (str(v), colour_at(product.ramp, 0, most, v)) for v in sorted(there)}
    every = names.sediments if product.stage == "sediments" else names.quality
    return {value: every[value] for value in every if value in there}


def _pseudocolour(product: Product, low: float, high: float) -> ET.Element:
    assert product.ramp is not None
    renderer = ET.Element(
        "rasterrenderer",
        type="singlebandpseudocolor",
        band="1",
        opacity=f"{product.opacity:g}",
        alphaBand="-1",
        classificationMin=repr(low),
        classificationMax=repr(high),
    )
    shader = child(
        child(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode="2",
        clip="0",
        minimumValue=repr(low),
        maximumValue=repr(high),
    )
    digits = digits_for(low, high)
    for value, colour in stops(product.ramp, low, high):
        label = f"{value:.{digits}f} {product.unit}".strip()
        child(
            shader, "item", value=repr(value), color=hexadecimal(colour), label=label, alpha="255"
        )
    return renderer


def _grey(low: float, high: float) -> ET.Element:
    renderer = ET.Element(
        "rasterrenderer",
        type="singlebandgray",
        grayBand="1",
        gradient="BlackToWhite",
        opacity="1",
        alphaBand="-1",
    )
    stretch = child(renderer, "contrastEnhancement")
    child(stretch, "minValue").text = repr(low)
    child(stretch, "maxValue").text = repr(high)
    child(stretch, "algorithm").text = "StretchToMinimumMaximum"
    return renderer


def _paletted(values: Mapping[int, tuple[str, Colour]], opacity: float) -> ET.Element:
    renderer = ET.Element(
        "rasterrenderer", type="paletted", band="1", opacity=f"{opacity:g}", alphaBand="-1"
    )
    palette = child(renderer, "colorPalette")
    for value, (name, colour) in values.items():
        child(
            palette,
            "paletteEntry",
            value=str(value),
            color=hexadecimal(colour),
            label=name,
            alpha="255",
        )
    return renderer


def _vector(path: Path, names: Categories) -> list[ET.Element] | None:
    meta, _, _, arrays = pyogrio.raw.read(path)
    columns = dict(zip(meta["fields"], arrays, strict=True))
    if not arrays or len(arrays[0]) == 0:
        return None
    if path.name == "sediment_boundaries.gpkg":
        return _boundaries(columns, names.sediments)
    if path.name == "ripple_cells.gpkg":
        return _ripples(path, columns)
    return [_outlines((0, 90, 181) if path.name == "ripple_extent.gpkg" else (60, 60, 60))]


def _outlines(colour: Colour) -> ET.Element:
    renderer = ET.Element("renderer-v2", type="singleSymbol", symbollevels="0")
    outline = symbol(child(renderer, "symbols"), "fill", "0")
    symbol_layer(outline, "SimpleLine", line_settings(WHITE, 0.8))
    symbol_layer(outline, "SimpleLine", line_settings(colour, 0.4))
    return renderer


def _boundaries(
    columns: Mapping[str, Any], sediments: Mapping[int, tuple[str, Colour]]
) -> list[ET.Element]:
    """Draw each pair of classes: the 95 % interval of the position, each side in its colour."""
    renderer = ET.Element(
        "renderer-v2", type="categorizedSymbol", attr=PAIR, symbollevels="0", forceraster="0"
    )
    listed, symbols = child(renderer, "categories"), child(renderer, "symbols")
    colours = dict(sediments.values())
    met = {tuple(sorted(pair)) for pair in zip(columns["left"], columns["right"], strict=True)}
    for k, (first, second) in enumerate(sorted(met)):
        name = f"{first} | {second}"
        child(listed, "category", symbol=str(k), value=name, label=name, render="true")
        one = symbol(symbols, "line", str(k))
        band = {"outlineWidth": f'{2 * BAND:g} * "position_sd"'}
        settings = line_settings(BLACK, 0.1, "MapUnit", alpha=90)
        symbol_layer(one, "SimpleLine", settings | {"capstyle": "flat"}, band)
        # left is negative; the first name may lie on either side of the line
        side = 'if("left" < "right", 1, -1)'
        for named, offset in ((first, -0.3), (second, 0.3)):
            settings = line_settings(colours.get(named, BLACK), 0.6)
            settings |= {"offset": f"{offset:g}", "offset_unit": "MM"}
            symbol_layer(one, "SimpleLine", settings, {"offset": f"{offset:g} * {side}"})
        symbol_layer(one, "SimpleLine", line_settings(BLACK, 0.2))
    told = (
        "'± ' || round(\"position_sd\", "
        "to_int(max(0, 1 - floor(log10(max(\"position_sd\", 0.000001)))))) || ' m'"
    )
    return [renderer, _labels(told, placement="2", flags="10", size=7)]


def _ripples(path: Path, columns: Mapping[str, Any]) -> list[ET.Element] | None:
    """Draw a line along the crests of each cell: length by wavelength, colour by height."""
    height, sd = columns["crest_to_trough_mean"], columns["crest_to_trough_sd"]
    known = np.isfinite(height)
    if not known.any():
        return None
    ramp = BY_FILE[path.name].ramp
    assert ramp is not None
    low, high = padded_range(height[known], sd[known])
    edges = np.linspace(low, high, RANGES + 1)
    box = pyogrio.read_info(path)["total_bounds"]
    size = (box[2] - box[0]) / (1 + np.ptp(columns["column"]))
    half = 0.5 * LONGEST * size / float(np.nanmax(columns["wavelength_mean"]))
    return [_crests(ramp, edges, height[known], half), _ripple_labels()]


def _crests(ramp: Ramp, edges: Any, heights: Any, half: float) -> ET.Element:
    renderer = ET.Element(
        "renderer-v2",
        type="graduatedSymbol",
        attr="crest_to_trough_mean",
        graduatedMethod="GraduatedColor",
        symbollevels="0",
    )
    ranges, symbols = child(renderer, "ranges"), child(renderer, "symbols")
    digits = digits_for(edges[0], edges[-1])
    line = (
        f"with_variable('half', {half:.6g} * \"wavelength_mean\", with_variable('centre', "
        'centroid($geometry), make_line(project(@centre, @half, radians("azimuth_mean" - 90)), '
        'project(@centre, @half, radians("azimuth_mean" + 90)))))'
    )
    dashed = {"lineStyle": "if(\"quality\" = 1, 'solid', 'dot')"}
    for k, (low, high) in enumerate(pairwise(edges)):
        last = k == len(edges) - 2
        if not ((heights >= low) & ((heights < high) | last)).any():
            continue
        label = f"H {low:.{digits}f} to {high:.{digits}f} m"
        child(
            ranges, "range", lower=repr(float(low)), upper=repr(float(high)), label=label,
            symbol=str(k), render="true",
        )  # fmt: skip
        one = symbol(symbols, "fill", str(k))
        symbol_layer(one, "SimpleLine", line_settings(WHITE, 0.1, alpha=110))
        generator = symbol_layer(
            one,
            "GeometryGenerator",
            {"SymbolType": "Line", "geometryModifier": line, "units": "MapUnit"},
        )
        crest = symbol(generator, "line", f"@{k}@1")
        symbol_layer(crest, "SimpleLine", line_settings(WHITE, 1.8))
        middle = (low + high) / 2
        colour = colour_at(ramp, edges[0], edges[-1], middle)
        symbol_layer(crest, "SimpleLine", line_settings(colour, 1.2), dashed)
    return renderer


def _ripple_labels() -> ET.Element:
    return _labels("label", placement="1", flags="0", size=7, beside=True)


def _labels(told: str, placement: str, flags: str, size: int, beside: bool = False) -> ET.Element:
    labeling = ET.Element("labeling", type="simple")
    settings = child(labeling, "settings", calloutType="simple")
    style = child(
        settings,
        "text-style",
        fieldName=told,
        isExpression="0" if told.isidentifier() else "1",
        fontFamily="Sans Serif",
        namedStyle="Bold",
        fontWeight="75",
        fontSize=str(size),
        fontSizeUnit="Point",
        textColor="0,0,0,255",
    )
    child(
        style,
        "text-buffer",
        bufferDraw="1",
        bufferSize="0.6",
        bufferSizeUnits="MM",
        bufferColor="255,255,255,200",
        bufferOpacity="1",
    )
    offset = {"quadOffset": "5", "xOffset": "2", "offsetUnits": "MM"} if beside else {}
    child(settings, "placement", placement=placement, placementFlags=flags, **offset)
    child(settings, "rendering", drawLabels="1", obstacle="0")
    return labeling
