"""JSON that every language's parser reads: no NaN, no infinity."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from sasmap.io.files import write_text


def write_json(path: Path, content: Any, scratch: Path) -> None:
    """Write a JSON file atomically; NaN and infinities become null.

    Parameters
    ----------
    path : Path
    content : object
        Nested dicts with text keys, lists, tuples, text, numbers and None.
    scratch : Path
        Folder for the unfinished file.
    """
    text = json.dumps(finite(content), indent=2, allow_nan=False)
    write_text(path, text + "\n", scratch)


def finite(content: Any) -> Any:
    """Return a JSON value with None in place of NaN and infinities."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
