"""Numerical tools shared by ripples and sediments: arrays only, no files and no maps."""
