"""The products of a run: rasters, vectors, tables, QGIS project, report."""
