"""One run at a time in an output folder."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sasmap.errors import InputError

LOCK = "lock"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock while the block runs.

    Parameters
    ----------
    path : Path
        Lock file, which names the process and host that hold it. A lock left by a dead process of
        this host is taken over.

    Raises
    ------
    InputError
        Where another run holds it; names the run, and says what to do if it no longer exists.
    """
    mine = json.dumps({"process": os.getpid(), "host": socket.gethostname()})
    try:
        _take(path, mine)
    except FileExistsError:
        holder = _holder(path)
        if not _gone(holder):
            process, host = holder
            raise InputError(
                f"{path}: process {process} on {host} writes into this folder: wait for it, or "
                "choose another --output; if no such run is left, delete this file"
            ) from None
        path.unlink(missing_ok=True)
        _retake(path, mine)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _take(path: Path, content: str) -> None:
    with open(path, "x", encoding="utf-8") as stream:
        stream.write(content)


def _retake(path: Path, content: str) -> None:
    try:
        _take(path, content)
    except FileExistsError:
        raise InputError(f"{path}: another run has just started in this folder") from None


def _holder(path: Path) -> tuple[int | None, str]:
    """Process and host that hold a lock; no process where the file names none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return int(content["process"]), str(content["host"])
    except (OSError, ValueError, KeyError, TypeError):
        return None, "an unknown host"


def _gone(holder: tuple[int | None, str]) -> bool:
    """Whether a process of this host has ended."""
    process, host = holder
    if process is None or host != socket.gethostname():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OverflowError:
        return True
    except PermissionError:
        return False  # another user's process lives
    return False
