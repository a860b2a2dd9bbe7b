"""The README's picture: the sample survey and what sasmap makes of it.

python pipelines/picture.py --products sample_data/out [--picture docs/sample.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pyogrio
import rasterio
import shapely

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Draw a pass, ripples and sediments side by side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--products", type=Path, default=ROOT / "sample_data" / "out")
    parser.add_argument("--picture", type=Path, default=ROOT / "docs" / "sample.png")
    options = parser.parse_args()
    figure, axes = plt.subplots(1, 3, figsize=(15, 3.9), layout="constrained")
    with rasterio.open(ROOT / "sample_data" / "far" / "far_r0_c0.tif") as source:
        amplitude, box = source.read(1), source.bounds
    extent = (0, box.right - box.left, 0, box.top - box.bottom)
    axes[0].imshow(amplitude, cmap="gray", vmax=np.quantile(amplitude, 0.99), extent=extent)
    axes[0].set_title("one of two passes: amplitude")
    with rasterio.open(options.products / "ripple_height.tif") as source:
        height = source.read()
    with rasterio.open(options.products / "ripple_frequency.tif") as source:
        frequency = source.read()
    axes[1].imshow(frequency[0], cmap="viridis", extent=extent)
    rows, columns = frequency.shape[1:]
    for (row, column), f in np.ndenumerate(frequency[0]):
        x, y = (column + 0.5) * extent[1] / columns, (rows - row - 0.5) * extent[3] / rows
        text = "no ripples"
        if np.isfinite(f):
            text = f"f {f:.4f} ± {frequency[1, row, column]:.4f}\nA_H {height[0, row, column]:.4f} "
            text += f"± {height[1, row, column]:.4f} m"
        label = {"fc": "white", "ec": "none", "alpha": 0.85}
        axes[1].text(x, y, text, ha="center", va="center", fontsize=7, bbox=label)
    axes[1].set_title("ripples: f (cycles/m) and height, cell by cell")
    with rasterio.open(options.products / "sediment_class.tif") as source:
        label_map, colours = source.read(1), source.colormap(1)
    palette = np.array([colours[k] for k in range(256)], float) / 255
    axes[2].imshow(palette[label_map], extent=extent)
    _, _, shapes, _ = pyogrio.raw.read(options.products / "sediment_boundaries.gpkg")
    for shape in shapely.from_wkb(shapes):
        x, y = shape.xy
        axes[2].plot(np.array(x) - box.left, np.array(y) - box.bottom, color="k", lw=1.2)
    axes[2].set_title("sediments and refined boundaries (white: shadow)")
    for ax in axes:
        ax.set(xlim=extent[:2], ylim=extent[2:], xlabel="m", aspect="equal")
    figure.savefig(options.picture, dpi=80)


if __name__ == "__main__":
    main()
