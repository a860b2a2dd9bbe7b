"""Numerical tools that ripples and sediments share: numbers only, no files and no maps."""
