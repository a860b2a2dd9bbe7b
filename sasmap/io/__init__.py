"""Files: atomic writes, rasters built piece by piece, the formats of the products."""
