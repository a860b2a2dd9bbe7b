"""A simulated survey on disk: tiles, navigation, truth and a survey file ready to run."""

from __future__ import annotations

import csv
import io
import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj
import rasterio
from affine import Affine
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.errors import InputError
from sasmap.io.files import write_text, written_whole
from sasmap.io.rasters import Category, Layer, as_bands, float_layer, write_cog
from sasmap.products.colours import class_colour
from sasmap.settings.yamlfile import dump_yaml
from sasmap.simulate.geometry import track_line
from sasmap.simulate.image import NODATA, record
from sasmap.simulate.scene import Scene, ScenePass
from sasmap.simulate.seafloor import SeaFloor, Waves

# Distance between the pings of simulated navigation, m (a choice; usual for SAS).
PING_SPACING = 0.5
# Side of a truth pixel in pixels of the scene (a choice: a tenth of the tiles' size on disk).
TRUTH_PIXELS = 10


class Raster(NamedTuple):
    """Position and size of a raster."""

    transform: Affine
    rows: int
    columns: int


def simulate(scene: Scene, output: str | Path) -> list[Path]:
    """Simulate a scene and write it as a survey.

    Parameters
    ----------
    scene : Scene
        From :func:`sasmap.simulate.load_scene`.
    output : str or Path
        Folder; made if missing. The same scene gives the same bytes.

    Returns
    -------
    list of Path
        Written files: tiles in one folder per pass, navigation CSVs, ``truth/`` (GeoTIFFs of
        ripple frequency, height, azimuth and sediment class; GeoJSON of class boundaries) and
        ``survey.yaml``.

    Raises
    ------
    InputError
        Where the folder cannot be made.
    """
    folder = Path(output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
    scratch = folder / ".sasmap-simulate"
    shutil.rmtree(scratch, ignore_errors=True)
    floor = SeaFloor(scene)
    written = []
    for k, scene_pass in enumerate(scene.passes):
        tiles = _write_tiles(scene, floor, scene_pass, k, folder, scratch)
        if not tiles:
            raise InputError(f"passes.{scene_pass.name}: does not see the scene")
        written += tiles
        written.append(folder / f"{scene_pass.name}.csv")
        write_text(written[-1], _navigation(scene, scene_pass), scratch)
    written += _write_truth(scene, floor, folder / "truth", scratch)
    written.append(folder / "survey.yaml")
    write_text(written[-1], _survey(scene), scratch)
    scratch.rmdir()
    return written


def pass_raster(scene: Scene, scene_pass: ScenePass) -> Raster:
    """Lay out a pass's pixels over the scene, with the pass's rotation.

    Parameters
    ----------
    scene : Scene
    scene_pass : ScenePass

    Returns
    -------
    Raster
        Its pixels cover the whole scene.
    """
    pixel = scene_pass.pixel_size or scene.pixel_size
    angle = np.radians(scene_pass.rotation)
    c, s = np.cos(angle), np.sin(angle)
    altitude = scene_pass.altitude
    reach = 0.0
    if scene_pass.range == "slant":  # in slant range the sea floor lies farther from the track
        reach = max(altitude) if isinstance(altitude, tuple) else altitude
    east, north = scene.size[0] + 2 * reach, scene.size[1] + 2 * reach
    width = abs(c) * east + abs(s) * north
    height = abs(s) * east + abs(c) * north
    columns, rows = (int(np.ceil(v / pixel - 1e-6)) for v in (width, height))
    if scene_pass.rotation == 0:
        corner_x, corner_y = scene.origin[0] - reach, scene.origin[1] + scene.size[1] + reach
    else:
        half_x, half_y = columns * pixel / 2, rows * pixel / 2
        corner_x = scene.centre[0] - half_x * c + half_y * s
        corner_y = scene.centre[1] + half_x * s + half_y * c
    transform = Affine(pixel * c, -pixel * s, corner_x, -pixel * s, -pixel * c, corner_y)
    return Raster(transform, rows, columns)


def _write_tiles(
    scene: Scene, floor: SeaFloor, scene_pass: ScenePass, k: int, folder: Path, scratch: Path
) -> list[Path]:
    whole = pass_raster(scene, scene_pass)
    for old in (folder / scene_pass.name).glob(f"{scene_pass.name}_r*_c*.tif"):
        old.unlink()  # a smaller or coarser scene has fewer tiles
    side = scene_pass.tile
    written = []
    for i, top in enumerate(range(0, whole.rows, side)):
        for j, left in enumerate(range(0, whole.columns, side)):
            transform = whole.transform @ Affine.translation(left, top)
            shape = min(side, whole.rows - top), min(side, whole.columns - left)
            # coherent tiles of a pass share their speckle, so that they meet without a seam
            which = [scene.seed, k] if scene.physics == "coherent" else [scene.seed, k, i, j]
            rng = np.random.default_rng(np.random.SeedSequence(which))
            pixels = record(scene, floor, scene_pass, transform, shape, rng)
            nodata = NODATA[scene_pass.dtype]
            valid = ~np.isnan(pixels) if np.isnan(nodata) else pixels != nodata
            if valid.any():
                path = folder / scene_pass.name / f"{scene_pass.name}_r{i}_c{j}.tif"
                _write_tile(path, pixels, transform, scene, nodata, scratch)
                written.append(path)
    return written


def _write_tile(
    path: Path,
    pixels: NDArray[np.generic],
    transform: Affine,
    scene: Scene,
    nodata: float,
    scratch: Path,
) -> None:
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": pixels.dtype.name,
        "count": 1,
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "crs": scene.crs,
        "transform": transform,
        "nodata": nodata,
        "compress": "deflate",
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
    }
    with written_whole(path, scratch) as part, rasterio.open(part, "w", **profile) as target:
        target.write(pixels, 1)
        target.set_band_description(1, "amplitude")


def _navigation(scene: Scene, scene_pass: ScenePass) -> str:
    line = track_line(scene, scene_pass)
    pings = int(np.ceil(line.length / PING_SPACING)) + 1
    along = np.linspace(0, line.length, pings)
    x, y = line.point(along, np.zeros(pings))
    names, digits = ("x", "y"), 4
    if scene_pass.positions == "geographic":
        geographic = pyproj.Transformer.from_crs(scene.crs, "EPSG:4326", always_xy=True)
        x, y = geographic.transform(x, y)
        names, digits = ("longitude", "latitude"), 9
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("ping", *names, "heading", "altitude"))
    for ping, values in enumerate(zip(x, y, line.altitude_at(along), strict=True)):
        px, py, altitude = values
        heading = f"{scene_pass.heading % 360:.2f}"
        rows.writerow((ping, f"{px:.{digits}f}", f"{py:.{digits}f}", heading, f"{altitude:.4f}"))
    return text.getvalue()


def _write_truth(scene: Scene, floor: SeaFloor, folder: Path, scratch: Path) -> list[Path]:
    pixel = TRUTH_PIXELS * scene.pixel_size
    columns, rows = (max(1, int(np.ceil(v / pixel - 1e-6))) for v in scene.size)
    top = scene.origin[1] + scene.size[1]
    transform = Affine(pixel, 0, scene.origin[0], 0, -pixel, top)
    x, y = np.meshgrid(
        scene.origin[0] + pixel * (np.arange(columns) + 0.5), top - pixel * (np.arange(rows) + 0.5)
    )
    layers = _ripple_layers(floor.waves(x, y))
    if any(patch.added for patch in scene.ripples):
        layers |= _ripple_layers(floor.second(x, y), "_second")
    crs = pyproj.CRS.from_user_input(scene.crs).to_wkt()
    written = []
    for name, (values, layer) in layers.items():
        written.append(folder / f"{name}.tif")
        write_cog(written[-1], as_bands(values), layer, transform, crs, scratch)
    written.append(folder / "sediment_class.tif")
    classes = as_bands(floor.sediment(x, y) + 1)
    write_cog(written[-1], classes, _class_layer(scene), transform, crs, scratch)
    written.append(folder / "boundaries.geojson")
    write_text(written[-1], json.dumps(_boundaries(scene, floor), indent=1) + "\n", scratch)
    return written


def _ripple_layers(waves: Waves, ending: str = "") -> dict[str, tuple[FloatArray, Layer]]:
    """Rasters of a system of ripples, by name; NaN where there are no ripples."""
    values = {
        "frequency": np.hypot(waves.east, waves.north),
        "height": waves.height,
        "azimuth": np.degrees(np.arctan2(waves.east, waves.north)) % 180.0,
    }
    told = {
        "frequency": float_layer(["ripple frequency"], ["cycles/m"]),
        "height": float_layer(["ripple height A_H"], ["m"]),
        "azimuth": float_layer(["azimuth of the crest normal"], ["degrees"]),
    }
    none = waves.height == 0
    return {
        f"ripple_{name}{ending}": (np.where(none, np.nan, value), told[name])
        for name, value in values.items()
    }


def _class_layer(scene: Scene) -> Layer:
    categories = {0: Category("no data", (0, 0, 0, 0))}
    for k, sediment in enumerate(scene.sediments):
        categories[k + 1] = Category(sediment.name, (*class_colour(k), 255))
    return Layer(["sediment class"], [""], 0, "uint8", categories)


def _boundaries(scene: Scene, floor: SeaFloor) -> dict[str, Any]:
    """Visible parts of the sediments' outlines, with the classes on both sides."""
    features = []
    for polygon in floor.outlines:
        for line, left, right in _visible(scene, floor, polygon):
            features.append(
                {
                    "type": "Feature",
                    "properties": {
                        "left": scene.sediments[left].name,
                        "right": scene.sediments[right].name,
                    },
                    "geometry": {"type": "LineString", "coordinates": np.round(line, 4).tolist()},
                }
            )
    crs = pyproj.CRS.from_user_input(scene.crs)
    name = "::".join(crs.to_authority() or ("OGC", "CRS84"))
    return {
        "type": "FeatureCollection",
        "name": "boundaries",
        "crs": {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{name}"}},
        "features": features,
    }


def _visible(
    scene: Scene, floor: SeaFloor, polygon: FloatArray
) -> list[tuple[FloatArray, int, int]]:
    """Cut an outline into pieces within the scene between the same two classes."""
    step = scene.pixel_size
    runs: list[tuple[FloatArray, int, int]] = []
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        if length == 0:
            continue
        pieces = max(1, int(np.ceil(length / step)))
        cuts = start + (end - start) * np.linspace(0, 1, pieces + 1)[:, None]
        middle = (cuts[:-1] + cuts[1:]) / 2
        normal = np.array([-(end - start)[1], (end - start)[0]]) / length * 1e-3 * step
        left = floor.sediment(*(middle + normal).T)
        right = floor.sediment(*(middle - normal).T)
        inside = np.all((middle >= scene.origin) & (middle <= np.add(scene.origin, scene.size)), 1)
        key = np.where(inside & (left != right), left * 1000 + right, -1)
        for run in np.split(np.arange(pieces), np.flatnonzero(np.diff(key)) + 1):
            if key[run[0]] >= 0:
                line = cuts[[run[0], run[-1] + 1]]
                runs.append((line, int(left[run[0]]), int(right[run[0]])))
    return _joined(runs)


def _joined(runs: list[tuple[FloatArray, int, int]]) -> list[tuple[FloatArray, int, int]]:
    joined: list[tuple[FloatArray, int, int]] = []
    for line, left, right in runs:
        if (
            joined
            and joined[-1][1:] == (left, right)
            and np.array_equal(joined[-1][0][-1], line[0])
        ):
            joined[-1] = (np.vstack([joined[-1][0], line[1:]]), left, right)
        else:
            joined.append((line, left, right))
    return joined


def _survey(scene: Scene) -> str:
    ripples = {}
    if scene.physics == "published":  # the law that renders its images
        ripples = {"scattering": "zare-cobb", "shadow": scene.shadow}
    content = {
        "name": scene.name,
        "output": "out",
        "crs": scene.crs,
        "window": scene.window,
        "seed": scene.seed,
        "passes": [
            {
                "name": p.name,
                "tiles": [f"{p.name}/*.tif"],
                "navigation": f"{p.name}.csv",
                "side": p.side,
                "range": p.range,
            }
            for p in scene.passes
        ],
        "ripples": ripples,
        "sediments": {"classes": "auto"},
    }
    return dump_yaml(content)
