import subprocess
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import sasmap
from sasmap.catalogue import CATALOGUE
from sasmap.io.geopackage import Feature, write_boundaries
from sasmap.products.colours import (
    CLASS_COLOURS,
    QUALITY_COLOURS,
    class_colour,
    hexadecimal,
    stops,
)
from sasmap.products.qgis.styles import categories, style_of
from sasmap.run.pipeline import run_survey
from tests.helpers import small_survey

SYSTEM = Path("/usr/bin/python3")  # QGIS comes with the system's Python
RENDER = """
import sys
from qgis.core import (
    QgsApplication, QgsLayoutExporter, QgsMapRendererParallelJob, QgsMapSettings, QgsProject
)
from qgis.PyQt.QtCore import QSize
app = QgsApplication([], False)
app.initQgis()
project = QgsProject.instance()
assert project.read(sys.argv[1])
print(project.crs().authid())
print(project.title())
for node in project.layerTreeRoot().findLayers():
    layer = node.layer()
    assert layer.isValid(), layer.source()
    settings = QgsMapSettings()
    settings.setOutputSize(QSize(120, 80))
    settings.setDestinationCrs(project.crs())
    extent = layer.extent()
    extent.scale(1.1)
    settings.setExtent(extent)
    settings.setLayers([layer])
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    image = job.renderedImage()
    seen = {image.pixel(x, y) for x in range(0, 120) for y in range(0, 80)}
    print(layer.source().rsplit("/", 1)[-1], layer.renderer().type(), len(seen))
layout = project.layoutManager().layoutByName("Map")
settings = QgsLayoutExporter.PdfExportSettings()
assert QgsLayoutExporter(layout).exportToPdf(sys.argv[2], settings) == QgsLayoutExporter.Success
app.exitQgis()
"""


def luminance(colour):
    r, g, b = (v / 255 for v in colour)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def test_ramps_rise_in_lightness_and_the_azimuths_is_cyclic():
    ramps = {p.ramp for p in CATALOGUE if p.ramp is not None}
    assert len(ramps) > 4
    for ramp in ramps:
        colours = [c for _, c in stops(ramp, 0.0, 1.0, 33)]
        if ramp.name == "twilight":
            assert np.abs(np.subtract(colours[0], colours[-1])).max() < 12
        else:
            assert (np.diff([luminance(c) for c in colours]) > -1e-3).all()


def test_class_colours_are_all_different():
    colours = [class_colour(k) for k in range(3 * len(CLASS_COLOURS))]
    assert len(set(colours)) == len(colours)


def test_every_layer_has_a_style_and_stands_in_the_project(sample):
    output, outcome = sample
    drawn = [p for p in outcome.written if p.suffix in (".tif", ".gpkg")]
    for path in drawn:
        root = ET.parse(path.with_suffix(".qml")).getroot()
        assert root.tag == "qgis"
    quality = ET.parse(output / "ripple_quality.qml").getroot()
    entries = {e.get("label"): e.get("color") for e in quality.iter("paletteEntry")}
    assert entries["good"] == hexadecimal(next(iter(QUALITY_COLOURS.values())))
    assert set(entries) == {"good", "no ripples"}  # no entry without a cell
    frequency = ET.parse(output / "ripple_frequency.qml").getroot()
    labels = [e.get("label") for e in frequency.iter("item")]
    assert all(label.endswith(" cycles/m") for label in labels)
    root = ET.parse(output / "survey.qgs").getroot()
    assert root.find("title").text == "two passes off the bar"
    sources = [e.text for e in root.iter("datasource")]
    assert len(sources) == len(drawn)
    assert all(s.startswith("./") for s in sources)
    tree = root.find("layer-tree-group")
    names = [node.get("id") for node in tree]
    assert names[-1] == "sasmap_mosaic_tif"  # below all others
    shown = [n.get("id") for n in tree if n.get("checked") == "Qt::Checked"]
    assert len(shown) == 5
    sediments = ET.parse(output / "sediment_class.qml").getroot()
    assert next(sediments.iter("rasterrenderer")).get("opacity") == "0.5"


def test_the_page_to_print_has_what_a_map_needs(sample):
    output, _ = sample
    (layout,) = ET.parse(output / "survey.qgs").getroot().find("Layouts")
    items = {e.get("id"): e for e in layout.iter("LayoutItem")}
    assert set(items) == {"page", "map", "legend", "scale", "north", "title", "notes"}
    assert items["title"].get("labelText") == "two passes off the bar"
    assert "EPSG:32617" in items["notes"].get("labelText")
    assert "format_date" in items["notes"].get("labelText")
    listed = [e.get("id") for e in items["legend"].iter("layer-tree-layer")]
    assert "sasmap_ripple_cells_gpkg" in listed
    assert "sasmap_ripple_quality_tif" not in listed
    left, width, height = 10, 205, 178
    for name in ("legend", "scale", "north", "notes"):  # beside the map, on the page
        x, y, _ = items[name].get("position").split(",")
        across, down, _ = items[name].get("size").split(",")
        assert float(x) >= left + width
        assert float(x) + float(across) <= 297
        assert float(y) + float(down) <= 210
    assert items["map"].get("size") == f"{width},{height},mm"


def test_each_pair_of_classes_stands_once_in_the_legend(tmp_path):
    ends = np.array([[500000.0, 3300000.0], [500010.0, 3300005.0]])
    pairs = (("sand", "mud"), ("mud", "sand"), ("mud", "gravel"))
    features = [Feature(ends + k, *pair, 0.2) for k, pair in enumerate(pairs)]
    path = tmp_path / "sediment_boundaries.gpkg"
    write_boundaries(path, features, "EPSG:32617", tmp_path / "scratch")
    style = style_of(path, categories(["sand", "mud", "gravel", "rock"], QUALITY_COLOURS))
    labels = [e.get("label") for e in style[0].iter("category")]
    assert labels == ["gravel | mud", "mud | sand"]
    widths = [
        e.find("Option[@name='expression']").get("value")
        for e in style[0].iter("Option")
        if e.get("name") == "outlineWidth"
    ]
    assert len(widths) == 2
    assert all("position_sd" in w for w in widths)


def test_nothing_is_drawn_that_has_no_content(tmp_path):
    path = small_survey(tmp_path)
    outcome = run_survey(sasmap.load_survey(path))
    folder = tmp_path / "out"
    assert (folder / "ripple_height.tif").exists()
    assert not (folder / "ripple_height.qml").exists()
    sources = [e.text for e in ET.parse(folder / "survey.qgs").getroot().iter("datasource")]
    assert sorted(sources) == [
        "./mosaic.tif", "./ripple_probability.tif", "./ripple_quality.tif",
    ]  # fmt: skip
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "Ripple wavelength. White" not in text
    assert outcome.failures == []


def test_qgis_draws_every_layer_and_prints_the_page(sample, tmp_path):
    has = SYSTEM.exists() and subprocess.run(
        [SYSTEM, "-c", "import qgis.core"], capture_output=True, check=False
    )
    if not has or has.returncode:
        pytest.skip("QGIS is not installed")
    output, outcome = sample
    script = tmp_path / "render.py"
    script.write_text(RENDER)
    environment = {"QT_QPA_PLATFORM": "offscreen", "HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    found = subprocess.run(
        [SYSTEM, str(script), str(output / "survey.qgs"), str(tmp_path / "map.pdf")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
    )
    crs, title, *layers = found.stdout.split("\n")
    assert crs == "EPSG:32617"
    assert title == "two passes off the bar"
    kinds = dict(line.rsplit(" ", 1)[0].split() for line in layers if line)
    assert kinds["ripple_height.tif"] == "singlebandpseudocolor"
    assert kinds["sediment_class.tif"] == "paletted"
    assert kinds["mosaic.tif"] == "singlebandgray"
    assert kinds["sediment_boundaries.gpkg|layername=boundaries"] == "categorizedSymbol"
    assert kinds["ripple_cells.gpkg|layername=cells"] == "graduatedSymbol"
    assert len(kinds) == len([p for p in outcome.written if p.suffix in (".tif", ".gpkg")])
    colours = [int(line.rsplit(" ", 1)[1]) for line in layers if line]
    assert min(colours) > 1  # something is drawn of each
    assert (tmp_path / "map.pdf").stat().st_size > 20_000
