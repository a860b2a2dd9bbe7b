"""The names of what a run writes into its output folder (INTERFACE "Products")."""

RIPPLE_PRODUCTS = (
    "ripple_frequency.tif",
    "ripple_height.tif",
    "ripple_azimuth.tif",
    "ripple_probability.tif",
    "ripple_quality.tif",
    "ripple_quality.tif.aux.xml",
    "ripple_passes.tif",
    "ripples.nc",
    "modelled_amplitude.tif",
)
SEDIMENT_PRODUCTS = (
    "sediment_class.tif",
    "sediment_class.tif.aux.xml",
    "sediment_confidence.tif",
    "sediment_boundaries.gpkg",
    "sediment_classes.json",
)
MANIFEST = "run.json"
PRODUCTS = frozenset({*RIPPLE_PRODUCTS, *SEDIMENT_PRODUCTS, MANIFEST})
