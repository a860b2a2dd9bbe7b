"""What a run leaves behind: rasters, tables, the run's own record."""
