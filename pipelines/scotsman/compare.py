"""Compare the sediment map of tiles made from the raw line with that of the tiles beside it.

    python pipelines/scotsman/compare.py [--data DIR] [--output DIR]

Prints how far the pixels of either set lie apart, and which share of the sea floor that both show
gets the same sediment. Classes are paired one to one so that the share is largest; the second share
lets several classes of one map be one of the other's.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import rasterio
import yaml
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from scipy.optimize import linear_sum_assignment
from skimage.registration import phase_cross_correlation

from sasmap.cli import main as sasmap

HERE = Path(__file__).resolve().parent


def laid_over(first: Path, second: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Read two rasters on the first one's pixels; the side of a pixel, m."""
    with rasterio.open(first) as one, rasterio.open(second) as other:
        place = {"crs": one.crs, "transform": one.transform}
        with WarpedVRT(
            other, width=one.width, height=one.height, resampling=Resampling.nearest, **place
        ) as laid:
            return one.read(1), laid.read(1), float(abs(one.transform.a))


def shift(first: Path, second: Path) -> tuple[float, float]:
    """How far north and east the second mosaic lies of the first, m."""
    one, other, step = laid_over(first, second)
    valid = np.isfinite(one) & np.isfinite(other) & (one > 0) & (other > 0)
    one, other = (np.log(np.where(valid, v, 1.0)) for v in (one, other))
    moved, _, _ = phase_cross_correlation(
        one, other, reference_mask=valid, moving_mask=valid, upsample_factor=1
    )
    return step * float(moved[0]), -step * float(moved[1])


def agreement(first: Path, second: Path) -> tuple[np.ndarray, float, float]:
    """Table of classes by classes; shares of pixels that agree one to one, and many to one."""
    one, other, _ = laid_over(first, second)
    both = (one > 0) & (other > 0)
    table = np.zeros((int(one.max()), int(other.max())), int)
    np.add.at(table, (one[both] - 1, other[both] - 1), 1)
    alike = linear_sum_assignment(-table)
    merged = table.max(axis=0 if table.shape[1] > table.shape[0] else 1)
    return table, float(table[alike].sum() / table.sum()), float(merged.sum() / table.sum())


def main() -> int:
    """Run both surveys, sediments alone, and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=HERE / "../out/scotsman-compare")
    options = parser.parse_args()
    data, output = options.data.resolve(), options.output.resolve()
    made = output / "made"
    status = sasmap(["tiles", str(data / "scotsman-iver2.xtf"), "--output", str(made)])
    beside = yaml.safe_load((HERE / "survey.yaml").read_text(encoding="utf-8"))
    line = beside["passes"][0]
    line["tiles"] = [str(data / Path(name).name) for name in line["tiles"]]
    line["navigation"] = str(data / Path(line["navigation"]).name)
    raw = yaml.safe_load((made / "survey.yaml").read_text(encoding="utf-8"))
    for content, folder in ((beside, output / "beside"), (raw, made)):
        folder.mkdir(parents=True, exist_ok=True)
        content.pop("ripples")
        content |= {"output": "out", "sediments": {}}
        (folder / "survey.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        status = status or sasmap(["run", str(folder / "survey.yaml"), "--quiet"])
    if status:
        return status
    maps = [output / name / "out" for name in ("beside", "made")]
    north, east = shift(*(m / "mosaic.tif" for m in maps))
    table, share, merged = agreement(*(m / "sediment_class.tif" for m in maps))
    print(f"mosaic made from the recording: {north:+.2f} m north, {east:+.2f} m east")
    print(f"classes of the tiles beside (rows), of those made (columns), pixels:\n{table}")
    print(f"sea floor with the same sediment: {share:.1%}; with classes merged: {merged:.1%}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
