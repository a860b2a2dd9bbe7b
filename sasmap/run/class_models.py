"""Sediment classes known in advance: from training polygons, or from another survey's file."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.errors import InputError, check_file
from sasmap.io.jsonfile import finite
from sasmap.sediments.classes import Classes
from sasmap.sediments.fitting import FAMILIES, Law
from sasmap.sediments.texture import BINS, CHANNELS, WINDOWS, Texture

FORMAT = "sasmap sediment classes 1"
MAX_BYTES = 2**24


class ClassModel(NamedTuple):
    """Classes known in advance.

    Attributes
    ----------
    names : tuple of str
        Classes of the same name are one class of the map.
    marks : callable or None
        ``marks(row, column)`` gives the training class at each pixel of a cell, 0 for none.
    cells : tuple of (row, column)
        Cells that have training pixels.
    laws : tuple of Law
        Laws of another survey; empty where they are estimated from training pixels.
    centre : float
        Log of the cotangent of the grazing angle at which the laws hold.
    texture : Texture or None
        Laws at several scales, where the survey used them.
    codes : tuple of str
        Codes in the user's scheme (Folk, EUNIS, CMECS), if any.
    objects : bool
        Whether objects were a class of their own where the classes were found.
    """

    names: tuple[str, ...]
    marks: Callable[[int, int], NDArray[np.uint8]] | None = None
    cells: tuple[tuple[int, int], ...] = ()
    laws: tuple[Law, ...] = ()
    centre: float = 0.0
    texture: Texture | None = None
    codes: tuple[str, ...] = ()
    objects: bool = True

    def codes_of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the code of each name; empty where none is given."""
        known = dict(zip(reversed(self.names), reversed(self.codes), strict=False))
        return tuple(known.get(name, "") for name in names)


def model_text(
    names: Sequence[str], codes: Sequence[str], classes: Classes, objects: bool = True
) -> str:
    """Write a survey's classes as JSON, for use in other surveys.

    Parameters
    ----------
    names, codes : sequence of str
    classes : Classes
    objects : bool
        Whether objects were a class of their own.

    Returns
    -------
    str
    """
    content = {
        "format": FORMAT,
        "reference_cotangent": float(np.exp(classes.centre)),
        "objects_apart": objects,
        "classes": [
            {"name": name, "code": code, **asdict(law)}
            for name, code, law in zip(names, codes, classes.laws, strict=True)
        ],
    }
    if classes.texture is not None:
        content["texture"] = {
            f.name: np.round(getattr(classes.texture, f.name), 6).tolist()
            for f in fields(classes.texture)
        }
    indent = None if "texture" in content else 2
    return json.dumps(finite(content), indent=indent, allow_nan=False) + "\n"


def read_model(path: Path) -> ClassModel:
    """Read the classes of another survey.

    Parameters
    ----------
    path : Path
        ``sediment_classes.json`` of its output folder.

    Returns
    -------
    ClassModel

    Raises
    ------
    InputError
        Where the file is missing or is not such a file.
    """
    expected = "expected sediment_classes.json of another run"
    check_file(path, expected, MAX_BYTES)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        laws = tuple(law_of(one) for one in content["classes"])
        names = tuple(str(one["name"]) for one in content["classes"])
        reach = float(content["reference_cotangent"])
        if not laws or not 0 < reach < np.inf or len(laws) > 250:
            raise ValueError("no classes, or no angle")
        texture = _texture_of(content["texture"], len(laws)) if "texture" in content else None
        codes = tuple(str(one.get("code", "")) for one in content["classes"])
        return ClassModel(
            names,
            laws=laws,
            centre=float(np.log(reach)),
            texture=texture,
            codes=codes,
            objects=bool(content.get("objects_apart", True)),
        )
    except OSError as error:
        raise InputError(f"{path}: {expected}: {error.strerror or error}") from None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: {expected}: {' '.join(str(error).split())}") from None


def _texture_of(content: dict[str, Any], count: int) -> Texture:
    """Read laws at several scales; ValueError, KeyError or TypeError where they are invalid."""
    found = Texture(**{f.name: np.array(content[f.name], float) for f in fields(Texture)})
    shapes = found.low.shape, found.high.shape, found.table.shape, found.offset.shape
    wanted = (CHANNELS,), (CHANNELS,), (len(WINDOWS), count, CHANNELS, BINS), (count,)
    values = (found.low, found.high, found.table, found.offset)
    if shapes != wanted or not all(np.isfinite(v).all() for v in values):
        raise ValueError("texture: not of this version")
    if not (found.high > found.low).all():
        raise ValueError("texture: invalid bins")
    return found


def law_of(content: dict[str, Any]) -> Law:
    """Read a law as written by :func:`model_text`.

    Raises
    ------
    ValueError, KeyError, TypeError
        Where it is invalid.
    """
    values = {f.name: _number(content[f.name]) for f in fields(Law)}
    law = Law(**{**values, "errors": tuple(_number(v) for v in values["errors"])})
    numbers = (law.scale, law.mean_square)
    shaped = law.family in ("rayleigh", "rice") or law.shape > 0
    if law.family not in FAMILIES or not shaped or not all(0 < v < np.inf for v in numbers):
        raise ValueError("invalid parameters of a law")
    if not 0 <= law.kappa < np.inf:
        raise ValueError("kappa: expected at least 0")
    return law


def _number(value: Any) -> Any:
    """Read a number; null stands for NaN, which JSON lacks."""
    return float("nan") if value is None else value
