"""Finished work in the output folder: kept under a key of everything it depends on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sasmap.products.files import write_text, written_whole
from sasmap.ripples.passes import Summary
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.version import VERSION

FOLDER = ".sasmap"


@dataclass(frozen=True)
class Store:
    """Finished looks at cells, a small JSON file each, written whole or not at all.

    Attributes
    ----------
    output : Path
        The survey's output folder.
    """

    output: Path

    @property
    def folder(self) -> Path:
        """Folder of what is kept between runs."""
        return self.output / FOLDER

    @property
    def scratch(self) -> Path:
        """Folder of unfinished files; never read, emptied by the next run."""
        return self.output / FOLDER / "unfinished"

    def path(self, key: str) -> Path:
        """Where the result under a key is kept."""
        return self.output / FOLDER / "cells" / key[:2] / f"{key}.json"

    def load(self, key: str) -> Summary | None:
        """Return the finished result under a key, or None."""
        try:
            content = json.loads(self.path(key).read_text(encoding="utf-8"))
            return _summary(content)
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def save(self, key: str, summary: Summary) -> None:
        """Keep a finished result."""
        write_text(self.path(key), json.dumps(asdict(summary)), self.scratch)

    def model_path(self, key: str) -> Path:
        """Where the modelled amplitude of a cell is kept."""
        return self.path(key).with_suffix(".npz")

    def save_model(
        self, key: str, model: NDArray[np.float32] | None, relief: NDArray[np.float32]
    ) -> None:
        """Keep a cell's modelled amplitude over that of flat sea floor, and itself where wanted.

        Before the result, which completes it.
        """
        layers: dict[str, NDArray[Any]] = {"relief": relief.astype(np.float16)}
        if model is not None:
            layers["model"] = model
        with written_whole(self.model_path(key), self.scratch) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **layers)

    def load_model(self, key: str) -> NDArray[np.float32]:
        """Return a cell's modelled amplitude."""
        return self._layer(key, "model")

    def load_relief(self, key: str) -> NDArray[np.float32]:
        """Return a cell's modelled amplitude over that of flat sea floor."""
        return self._layer(key, "relief")

    def _layer(self, key: str, name: str) -> NDArray[np.float32]:
        with np.load(self.model_path(key), allow_pickle=False) as layers:
            return np.asarray(layers[name], np.float32)

    def clear(self) -> None:
        """Forget all finished work."""
        for path in self.folder.glob("*.json"):
            path.unlink(missing_ok=True)
        for path in (self.output / FOLDER / "cells").glob("*/*.*"):
            path.unlink(missing_ok=True)

    def remove_leftovers(self) -> None:
        """Remove what an interrupted run left unfinished."""
        for path in self.scratch.glob("*"):
            path.unlink(missing_ok=True)


def _summary(content: dict[str, Any]) -> Summary:
    if set(content) != {f.name for f in fields(Summary)}:
        raise ValueError("not a summary of this version")
    pairs = {k: _frozen(v) for k, v in content.items()}
    pairs["quality"] = Quality(content["quality"])
    pairs["left_out"] = LeftOut(content["left_out"])
    return Summary(**pairs)


def _frozen(value: Any) -> Any:
    """Turn lists, however deep, into the tuples they were."""
    return tuple(_frozen(v) for v in value) if isinstance(value, list) else value


def digest(content: Any) -> str:
    """Return the SHA-256 of a JSON value, in hexadecimal."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def code_version() -> str:
    """Version of sasmap and a hash of its source: other code may give other results."""
    state = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        state.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{VERSION}+{state.hexdigest()[:12]}"
