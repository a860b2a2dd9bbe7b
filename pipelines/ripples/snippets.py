"""Ripples of recorded snippets in a folder: wavelengths, windows, modelled images.

    python pipelines/ripples/snippets.py FOLDER [--window 160] [--picture FILE.png]

FOLDER holds snippet_02.tif, _17, _20 and _31. Pixel size, range and altitude are assumptions, so
wavelengths are in pixels. Snippet 31 is compared with its modelled image strip by strip: 16-row
means of both, each over its smooth mean, and the same on every second 8-row strip when those were
kept from the estimate. With --picture (needs matplotlib) the clips beside their models.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter1d

from sasmap.ripples import Clip, Posterior, RippleSettings, estimate

PIXEL, NEAR, ALTITUDE = 0.05, 20.0, 5.0
SETTINGS = RippleSettings(keep_model=True)


def read(path: Path) -> np.ndarray:
    """Amplitude of a tile, NaN where there is none."""
    with rasterio.open(path) as tile:
        values = tile.read(1).astype(float)
        missing = tile.nodata
    return values if missing is None else np.where(values == missing, np.nan, values)


def clip_of(amplitude: np.ndarray, row: int = 0, column: int = 0) -> Clip:
    """Lay amplitudes on the assumed geometry; row and column of their first pixel in the tile."""
    rows, columns = np.indices(amplitude.shape)
    x, y = PIXEL * (column + columns + 0.5), -PIXEL * (row + rows + 0.5)
    altitude, look = np.full(x.shape, ALTITUDE), np.full(x.shape, 90.0)
    return Clip(amplitude, x, y, NEAR + x, altitude, look, PIXEL)


def line(posterior: Posterior) -> str:
    """Say what an estimate found, in pixels."""
    text = f"{posterior.quality.label:16s} P {posterior.probability:5.3f}"
    if not posterior.sampled:
        return text
    wavelength = 1 / float(posterior.mean.frequency) / PIXEL
    return (
        f"{text}  {wavelength:6.2f} px  normal {posterior.azimuth[0]:5.1f} deg  "
        f"rippled {posterior.shape.rippled_fraction:.2f}"
    )


def strips(image: np.ndarray, size: int) -> np.ndarray:
    """Means of strips of rows, each over its mean smoothed along the strip."""
    count = image.shape[0] // size
    means = np.nanmean(image[: count * size].reshape(count, size, -1), axis=1)
    known = np.isfinite(means)
    filled = np.where(known, means, 0)
    smooth = gaussian_filter1d(filled, 40, axis=1) / gaussian_filter1d(known * 1.0, 40, axis=1)
    return np.where(known, means / smooth, np.nan)


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Of what both know."""
    known = np.isfinite(one) & np.isfinite(other)
    return float(np.corrcoef(one[known], other[known])[0, 1])


def strip_figures(amplitude: np.ndarray) -> tuple[Posterior, float, float]:
    """Estimate of a tile, and correlations of its strip means with the model's, seen and not."""
    posterior = estimate(clip_of(amplitude), SETTINGS, rng=1)
    seen = correlation(strips(amplitude, 16), strips(posterior.model, 16))
    withheld = np.arange(amplitude.shape[0]) // 8 % 2 == 1
    part = estimate(clip_of(np.where(withheld[:, None], np.nan, amplitude)), SETTINGS, rng=1)
    if part.model is None:
        return posterior, seen, float("nan")
    unseen = correlation(strips(amplitude, 8)[1::2], strips(part.model, 8)[1::2])
    return posterior, seen, unseen


def windows(amplitude: np.ndarray, size: int) -> None:
    """Print what each window of a tile comes to."""
    for row in range(0, amplitude.shape[0] - size // 2, size):
        for column in range(0, amplitude.shape[1] - size // 2, size):
            part = amplitude[row : row + size, column : column + size]
            posterior = estimate(clip_of(part, row, column), SETTINGS, rng=1)
            print(f"  rows {row:3d}+ columns {column:3d}+  {line(posterior)}", flush=True)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--window", type=int, default=160)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    tiles = {n: read(options.folder / f"snippet_{n}.tif") for n in ("31", "20", "17", "02")}
    whole = {n: estimate(clip_of(a), SETTINGS, rng=1) for n, a in tiles.items()}
    for number, amplitude in tiles.items():
        print(f"snippet {number}, {amplitude.shape}: {line(whole[number])}", flush=True)
        if number == "31":
            _, seen, unseen = strip_figures(amplitude)
            print(f"  strip means: {seen:.2f} seen (16 rows), {unseen:.2f} withheld (8 rows)")
        else:
            windows(amplitude, options.window)
    if options.picture:
        draw(tiles, whole, options.picture)


def draw(tiles: dict[str, np.ndarray], whole: dict[str, Posterior], path: Path) -> None:
    """Draw the clips above their modelled images."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(tiles), figsize=(5 * len(tiles), 9))
    for (top, bottom), (number, amplitude) in zip(axes.T, tiles.items(), strict=True):
        top.imshow(amplitude, cmap="gray", vmax=np.nanquantile(amplitude, 0.99))
        top.set_title(f"snippet {number}")
        model = whole[number].model
        bottom.axis("off")
        if model is not None:
            bottom.imshow(model, cmap="gray")
    figure.tight_layout()
    figure.savefig(path, dpi=60)


if __name__ == "__main__":
    main()
