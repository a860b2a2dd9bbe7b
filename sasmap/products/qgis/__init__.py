"""QGIS styles and a project, so that QGIS opens products coloured, labelled and ready to print."""
