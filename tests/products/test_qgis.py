import subprocess
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from sasmap.products.colours import (
    CLASS_COLOURS,
    QUALITY_COLOURS,
    RAMPS,
    class_colour,
    hexadecimal,
    stops,
)

SYSTEM = Path("/usr/bin/python3")  # QGIS comes with the system's Python
RENDER = """
import sys
from qgis.core import QgsApplication, QgsProject
app = QgsApplication([], False)
app.initQgis()
project = QgsProject.instance()
assert project.read(sys.argv[1])
print(project.crs().authid())
for node in project.layerTreeRoot().findLayers():
    layer = node.layer()
    assert layer.isValid(), layer.source()
    print(layer.source().rsplit("/", 1)[-1], layer.renderer().type())
app.exitQgis()
"""


def luminance(colour):
    r, g, b = (v / 255 for v in colour)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def test_ramps_rise_in_lightness_and_the_azimuths_is_cyclic():
    for ramp in RAMPS.values():
        colours = [c for _, c in stops(ramp, 0.0, 1.0, 33)]
        if ramp.name == "twilight":
            assert np.abs(np.subtract(colours[0], colours[-1])).max() < 12
        else:
            assert (np.diff([luminance(c) for c in colours]) > -1e-3).all()


def test_class_colours_are_all_different():
    colours = [class_colour(k) for k in range(3 * len(CLASS_COLOURS))]
    assert len(set(colours)) == len(colours)


def test_every_raster_and_the_boundaries_have_a_style(sample):
    output, outcome = sample
    drawn = [p for p in outcome.written if p.suffix in (".tif", ".gpkg") and "areas" not in p.name]
    for path in drawn:
        root = ET.parse(path.with_suffix(".qml")).getroot()
        assert root.tag == "qgis"
    quality = ET.parse(output / "ripple_quality.qml").getroot()
    entries = {e.get("label"): e.get("color") for e in quality.iter("paletteEntry")}
    assert entries["good"] == hexadecimal(next(iter(QUALITY_COLOURS.values())))
    frequency = ET.parse(output / "ripple_frequency.qml").getroot()
    labels = [e.get("label") for e in frequency.iter("item")]
    assert all(label.endswith(" cycles/m") for label in labels)
    sources = [e.text for e in ET.parse(output / "survey.qgs").getroot().iter("datasource")]
    assert len(sources) == len(drawn)
    assert all(s.startswith("./") for s in sources)


def test_qgis_opens_the_project(sample, tmp_path):
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
        [SYSTEM, str(script), str(output / "survey.qgs")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    first, *layers = found.stdout.split("\n")
    assert first == "EPSG:32617"
    kinds = dict(line.split() for line in layers if line)
    assert kinds["ripple_height.tif"] == "singlebandpseudocolor"
    assert kinds["sediment_class.tif"] == "paletted"
    assert kinds["sediment_boundaries.gpkg|layername=boundaries"] == "categorizedSymbol"
    drawn = [p for p in outcome.written if p.suffix in (".tif", ".gpkg") and "areas" not in p.name]
    assert len(kinds) == len(drawn)
