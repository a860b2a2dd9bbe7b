"""What a run writes: rasters, vectors, tables, QGIS project, report."""
