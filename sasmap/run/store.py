"""Finished results in the output folder, stored under a hash of everything they depend on."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sasmap.io.files import write_text, written_whole
from sasmap.passes.derived import Derived
from sasmap.passes.summary import Summary
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.version import VERSION

FOLDER = ".sasmap"
# Text for numbers that JSON lacks.
NO_NUMBERS = ("nan", "inf", "-inf")


@dataclass(frozen=True)
class Store:
    """Finished looks at cells, a small JSON file each, written atomically.

    Attributes
    ----------
    output : Path
        The survey's output folder.
    """

    output: Path

    @property
    def folder(self) -> Path:
        """Folder of results that are kept between runs."""
        return self.output / FOLDER

    @property
    def scratch(self) -> Path:
        """Folder of unfinished files; never read, emptied by the next run."""
        return self.output / FOLDER / "unfinished"

    def path(self, key: str) -> Path:
        """File of the result under a key."""
        return self.output / FOLDER / "cells" / key[:2] / f"{key}.json"

    def load(self, key: str) -> Summary | None:
        """Return the finished result under a key, or None."""
        try:
            content = json.loads(self.path(key).read_text(encoding="utf-8"))
            return _summary(content)
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def save(self, key: str, summary: Summary) -> None:
        """Store a finished result."""
        write_text(
            self.path(key), json.dumps(_plain(asdict(summary)), allow_nan=False), self.scratch
        )

    def arrays_path(self, key: str) -> Path:
        """File of a result's arrays."""
        return self.path(key).with_suffix(".npz")

    def save_arrays(self, key: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Store a result's arrays; call it before `save`, which marks the result as complete."""
        with written_whole(self.arrays_path(key), self.scratch) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    def load_arrays(self, key: str, names: Sequence[str]) -> list[NDArray[Any]] | None:
        """Return some of a result's arrays, or None where it lacks any."""
        try:
            with np.load(self.arrays_path(key), allow_pickle=False) as arrays:
                return [arrays[name] for name in names]
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            return None

    def clear(self) -> None:
        """Delete all finished results."""
        for path in self.folder.glob("*.json"):
            path.unlink(missing_ok=True)
        for path in (self.output / FOLDER / "cells").glob("*/*.*"):
            path.unlink(missing_ok=True)

    def remove_leftovers(self) -> None:
        """Remove unfinished files of an interrupted run."""
        for path in self.scratch.glob("*"):
            path.unlink(missing_ok=True)


def _summary(content: dict[str, Any]) -> Summary:
    if set(content) != {f.name for f in fields(Summary)}:
        raise ValueError("not a summary of this version")
    reason = str(content.pop("reason"))  # the only text; other strings stand for numbers
    pairs = {"reason": reason} | {k: _frozen(v) for k, v in content.items()}
    pairs["quality"] = Quality(content["quality"])
    pairs["left_out"] = LeftOut(content["left_out"])
    pairs["derived"] = Derived(*pairs["derived"])
    return Summary(**pairs)


def _plain(value: Any) -> Any:
    """Replace NaN and the infinities, which JSON lacks, by text."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value


def _frozen(value: Any) -> Any:
    """Turn lists, at any depth, back into tuples, and such text into numbers."""
    if isinstance(value, list):
        return tuple(_frozen(v) for v in value)
    return float(value) if value in NO_NUMBERS else value


def digest(content: Any) -> str:
    """Return the SHA-256 of a JSON value, in hexadecimal."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def code_version() -> str:
    """Version of sasmap and a hash of its source: changed code may change results."""
    state = hashlib.sha256()
    root = Path(__file__).parent.parent
    for path in sorted(root.rglob("*.py")):
        state.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{VERSION}+{state.hexdigest()[:12]}"
