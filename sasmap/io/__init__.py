"""Safe files: written whole or not at all, rasters in the making, the formats of the products."""
