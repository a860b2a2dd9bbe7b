"""Files beside a tile that other programs read along with it, and that are not read here.

GDAL would follow them, and a hostile one can lead it to the network; they are named instead, with
the command that writes what they say into the tile.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from affine import Affine

WORLD_FILES = (".tfw", ".tifw", ".tiffw", ".wld")
# What an auxiliary file can hold that changes numbers or place; statistics and histograms, which
# QGIS leaves everywhere, do not.
TELLING = (b"<NoDataValue", b"<SRS", b"<GeoTransform", b"<GCP", b"<Scale", b"<Offset", b"<Color",
           b"<MaskBand", b"<UnitType")  # fmt: skip
# Bytes of an auxiliary file that are looked at.
MOST_BYTES = 2**20


def beside(path: Path, endings: tuple[str, ...]) -> list[Path]:
    """Find the files beside a tile that have its name and another ending.

    Parameters
    ----------
    path : Path
        Of the tile.
    endings : tuple of str
        In lower case; files with the same ending in upper case are found too.

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
    """Name the files beside a tile that are not read, a line each.

    Parameters
    ----------
    path : Path
    transform : Affine
        The tile's own; a world file that says the same is not named.
    """
    name = path.name
    for mask in beside(path, (".msk",)):
        yield (
            f"{path}: {mask.name} beside it is not read: bake the mask in: gdal_translate -b 1 "
            f"-mask mask --config GDAL_TIFF_INTERNAL_MASK YES {name} masked.tif"
        )
    for auxiliary in beside(path, (".aux.xml", ".aux")):
        if auxiliary.suffix == ".aux" or _tells(auxiliary):
            yield (
                f"{path}: {auxiliary.name} beside it is not read: bake in what it says, such as "
                f"nodata: gdal_translate {name} baked.tif"
            )
    for world in beside(path, WORLD_FILES):
        if _agrees(world, transform):
            continue
        yield (
            f"{path}: {world.name} beside it is not read, the tile's own georeference is: if the "
            f"world file is right: gdal_translate --config GDAL_GEOREF_SOURCES WORLDFILE {name} "
            "placed.tif"
        )
    for overview in beside(path, (".ovr",)):
        yield (
            f"{path}: {overview.name} beside it is not read; the tile's pixels are: if overviews "
            f"are wanted within: gdaladdo {name}"
        )


def _tells(auxiliary: Path) -> bool:
    try:
        with open(auxiliary, "rb") as stream:
            content = stream.read(MOST_BYTES)
    except OSError:
        return True
    return any(word in content for word in TELLING)


def _agrees(world: Path, transform: Affine) -> bool:
    """Whether a world file places pixels within a hundredth of where the tile itself does."""
    try:
        a, d, b, e, x, y = (float(v) for v in world.read_text(encoding="ascii")[:1000].split())
    except (OSError, ValueError):
        return False
    told = Affine(a, b, x, d, e, y) @ Affine.translation(-0.5, -0.5)  # it gives pixel centres
    step = abs(transform.determinant) ** 0.5
    near: bool = max(abs(p - q) for p, q in zip(told[:6], transform[:6], strict=True)) < 0.01 * step
    return near
