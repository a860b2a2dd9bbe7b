"""The README's picture: the print layout of the sample survey's QGIS project.

    python3 pipelines/picture.py [--project sample_data/out/survey.qgs] [--picture docs/sample.png]

Needs a Python that has QGIS (on Debian and Ubuntu the system's, with python3-qgis).
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from qgis.core import QgsApplication, QgsLayoutExporter, QgsProject

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Print layout "Map" of a project to an image."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--project", type=Path, default=ROOT / "sample_data/out/survey.qgs")
    parser.add_argument("--picture", type=Path, default=ROOT / "docs/sample.png")
    options = parser.parse_args()
    application = QgsApplication([], False)
    application.initQgis()
    project = QgsProject.instance()
    if not project.read(str(options.project)):
        raise SystemExit(f"{options.project}: cannot be read")
    layout = project.layoutManager().layoutByName("Map")
    settings = QgsLayoutExporter.ImageExportSettings()
    settings.dpi = 100
    options.picture.unlink(missing_ok=True)
    status = QgsLayoutExporter(layout).exportToImage(str(options.picture), settings)
    if status != QgsLayoutExporter.Success:
        raise SystemExit(f"{options.picture}: cannot be written")


if __name__ == "__main__":
    main()
