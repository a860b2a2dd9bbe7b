"""A cell's posterior over all its passes, under one survey's law and altitudes: numbers only."""
