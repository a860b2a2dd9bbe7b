"""The names of what a run writes into its output folder (README, products)."""

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
    "ripple_extent.gpkg",
)
SEDIMENT_PRODUCTS = (
    "sediment_class.tif",
    "sediment_class.tif.aux.xml",
    "sediment_confidence.tif",
    "sediment_boundaries.gpkg",
    "sediment_areas.gpkg",
    "sediment_classes.json",
)
MANIFEST = "run.json"
LOG = "sasmap.log"
STYLES = tuple(
    f"{name.rpartition('.')[0]}.qml"
    for name in (*RIPPLE_PRODUCTS, *SEDIMENT_PRODUCTS)
    if name.endswith((".tif", ".gpkg")) and name != "sediment_areas.gpkg"
)
PRODUCTS = frozenset(
    {
        *RIPPLE_PRODUCTS,
        *SEDIMENT_PRODUCTS,
        *STYLES,
        "survey.qgs",
        "report.html",
        "stac.json",
        LOG,
        MANIFEST,
    }
)
