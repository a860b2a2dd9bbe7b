"""Atomic writes: files appear under their final name only when they are complete."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_whole(path: Path, scratch: Path) -> Iterator[Path]:
    """Give a path to write to; on success the file replaces `path` in one step.

    Parameters
    ----------
    path : Path
        Final name.
    scratch : Path
        Folder on the same file system for the unfinished file; made if missing.

    Yields
    ------
    Path
        To write to. Removed if the block raises.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f"{path.name}.", suffix=".part", dir=scratch)
    os.close(handle)
    part = Path(name)
    try:
        yield part
        with open(part, "rb+") as stream:
            os.fsync(stream.fileno())
        part.chmod(0o644)
        path.parent.mkdir(parents=True, exist_ok=True)
        os.replace(part, path)
        _sync_folder(path.parent)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str, scratch: Path) -> None:
    """Write a UTF-8 text file whole."""
    with written_whole(path, scratch) as part:
        part.write_text(text, encoding="utf-8")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
