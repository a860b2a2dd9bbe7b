"""Sidecar files that other programs read with a tile, and that are not read here.

GDAL would follow them, and a hostile one can make it access the network. They are reported instead,
with the command that copies their contents into the tile.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from affine import Affine

WORLD_FILES = (".tfw", ".tifw", ".tiffw", ".wld")
# Contents of an auxiliary file that change values or position; statistics and histograms, which
# QGIS writes everywhere, do not.
TELLING = (b"<NoDataValue", b"<SRS", b"<GeoTransform", b"<GCP", b"<Scale", b"<Offset", b"<Color",
           b"<MaskBand", b"<UnitType")  # fmt: skip
# Bytes of an auxiliary file that are searched: bounds memory.
MOST_BYTES = 2**20


def beside(path: Path, endings: tuple[str, ...]) -> list[Path]:
    """Find the files beside a tile that have its name and another extension.

    Parameters
    ----------
    path : Path
        Of the tile.
    endings : tuple of str
        In lower case; upper case is found too.

    Returns
    -------
    list of Path
    """
    found = []
    for ending in endings:
        for name in (f"{path.stem}{ending}", f"{path.name}{ending}"):
            for spelled in (path.with_name(name), path.with_name(name).with_suffix(ending.upper())):
                if spelled.is_file() and spelled not in found:
                    found.append(spelled)
    return found


def unread(path: Path, transform: Affine) -> Iterator[str]:
    """Yield a message for each sidecar file that is not read.

    Parameters
    ----------
    path : Path
    transform : Affine
        Of the tile; a world file that agrees with it is not reported.
    """
    name = path.name
    for mask in beside(path, (".msk",)):
        yield (
            f"{path}: {mask.name} beside it is not read: copy the mask in: gdal_translate -b 1 "
            f"-mask mask --config GDAL_TIFF_INTERNAL_MASK YES {name} masked.tif"
        )
    for auxiliary in beside(path, (".aux.xml", ".aux")):
        if auxiliary.suffix == ".aux" or _tells(auxiliary):
            yield (
                f"{path}: {auxiliary.name} beside it is not read: copy in its contents, such as "
                f"nodata: gdal_translate {name} complete.tif"
            )
    for world in beside(path, WORLD_FILES):
        if _agrees(world, transform):
            continue
        yield (
            f"{path}: {world.name} beside it is not read, only the tile's own georeference: if the "
            f"world file is right: gdal_translate --config GDAL_GEOREF_SOURCES WORLDFILE {name} "
            "placed.tif"
        )
    for overview in beside(path, (".ovr",)):
        yield (
            f"{path}: {overview.name} beside it is not read, only the tile's pixels: if overviews "
            f"are wanted in the tile: gdaladdo {name}"
        )


def _tells(auxiliary: Path) -> bool:
    try:
        with open(auxiliary, "rb") as stream:
            content = stream.read(MOST_BYTES)
    except OSError:
        return True
    return any(word in content for word in TELLING)


def _agrees(world: Path, transform: Affine) -> bool:
    """Whether a world file agrees with the tile's georeference to a hundredth of a pixel."""
    try:
        a, d, b, e, x, y = (float(v) for v in world.read_text(encoding="ascii")[:1000].split())
    except (OSError, ValueError):
        return False
    told = Affine(a, b, x, d, e, y) @ Affine.translation(-0.5, -0.5)  # from pixel centres
    step = abs(transform.determinant) ** 0.5
    near: bool = max(abs(p - q) for p, q in zip(told[:6], transform[:6], strict=True)) < 0.01 * step
    return near
