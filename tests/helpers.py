"""Clips and small surveys that tests build by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
import yaml
from affine import Affine

from sasmap.ripples import Clip
from sasmap.simulate.scattering import (
    lit_amplitude,
    shadow_crest_rule,
    shadow_line_of_sight,
)

UTM = "EPSG:32617"
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def zare_cobb_amplitude(ground_range, frequency, height, altitude, rule):
    """A* along ranges as ZC 4.1 simulates it: sine, phase zero at the track."""
    phase = 2 * np.pi * frequency * ground_range
    grazing = np.arctan2(altitude, ground_range)
    amplitude = lit_amplitude(grazing, np.cos(phase), 1.0, 2 * np.pi * frequency * height)
    if rule == "crest":
        shadow = shadow_crest_rule(phase, ground_range, altitude, frequency, height)
    else:
        # forty sights a pixel: coarser ones miss part of what lies just behind a crest
        step = (ground_range[1] - ground_range[0]) / 40
        before = int(1 / (frequency * step)) // 40 * 40 + 40
        fine = ground_range[0] + step * np.arange(-before, 40 * ground_range.size)
        first = int(np.searchsorted(fine, 1e-3))
        floor = height * np.sin(2 * np.pi * frequency * fine[first:])
        shadow = np.zeros(fine.size, bool)
        shadow[first:] = shadow_line_of_sight(floor, fine[first:], altitude)
        shadow = shadow[before::40]
    return np.where(shadow, 0.0, amplitude)


def zare_cobb_clip(near, far, frequency, height, rule="crest", seed=0, altitude=4.83, size=500):
    """A clip of Rayleigh speckle over straight sine ripples, looked at square-on."""
    step = (far - near) / size
    ground_range = near + step * (np.arange(size) + 0.5)
    amplitude = zare_cobb_amplitude(ground_range, frequency, height, altitude, rule)
    rng = np.random.default_rng(seed)
    return clip_of(amplitude * rng.rayleigh(100.0, (size, size)), ground_range, altitude, step)


def clip_of(amplitude, ground_range, altitude, step):
    """Put amplitudes (rows, ranges) on a north-up lattice looked at eastwards."""
    shape = amplitude.shape
    x = np.broadcast_to(ground_range, shape).copy()
    y = np.broadcast_to(step * np.arange(shape[0])[::-1, None], shape).copy()
    return Clip(amplitude, x, y, x, np.full(shape, altitude), np.full(shape, 90.0), step)


def write_tile(path, values, transform, crs=UTM, nodata=None, **options):
    """Write a GeoTIFF; `tags` go into it."""
    tags = options.pop("tags", {})
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {
        "driver": "GTiff",
        "count": 1,
        "height": values.shape[0],
        "width": values.shape[1],
        "dtype": values.dtype.name,
        "crs": crs,
        "transform": transform,
        "nodata": nodata,
        **options,
    }
    with rasterio.open(path, "w", **profile) as target:
        target.update_tags(**tags)
        target.write(values, 1)
    return path


def write_track(path, x, y, altitude, header=("x", "y", "altitude")):
    """Write a navigation CSV."""
    rows = [",".join(header)]
    altitude = np.broadcast_to(altitude, np.shape(x))
    rows += [f"{a!r},{b!r},{c!r}" for a, b, c in zip(x, y, altitude, strict=True)]
    path.write_text("\n".join(rows).replace("np.float64(", "").replace(")", "") + "\n")
    return path


def small_survey(folder: Path, **changes):
    """A 40 x 60 pixel pass of 0.5 m pixels east of a northward track, window 20; returns its path.

    Keyword arguments replace keys of the survey file; a value of None removes the key.
    """
    rng = np.random.default_rng(5)
    values = rng.rayleigh(80.0, (40, 60)).astype("float32")
    corner = Affine(0.5, 0, 500010.0, 0, -0.5, 3300020.0)
    write_tile(
        folder / "tiles" / "a.tif",
        values,
        corner,
        nodata=float("nan"),
        tiled=True,
        blockxsize=16,
        blockysize=16,
    )
    north = np.arange(3299995.0, 3300026.0)
    write_track(folder / "nav.csv", np.full(north.size, 500000.0), north, 5.0)
    content = {
        "name": "small",
        "window": 20,
        "passes": [
            {
                "name": "one",
                "tiles": ["tiles/*.tif"],
                "navigation": "nav.csv",
                "side": "starboard",
            }
        ],
        "ripples": {},
    }
    content.update(changes)
    content = {key: value for key, value in content.items() if value is not None}
    path = folder / "survey.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def with_pass(**changes):
    """The `passes` key of :func:`small_survey` with some of its pass's keys changed."""
    one = {"name": "one", "tiles": ["tiles/*.tif"], "navigation": "nav.csv", "side": "starboard"}
    one.update(changes)
    return {"passes": [one]}
