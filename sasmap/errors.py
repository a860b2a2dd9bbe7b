"""Errors in the input, one line per fault."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


class InputError(ValueError):
    """Bad usage or bad input: the command line exits with status 2.

    Parameters
    ----------
    faults : str or iterable of str
        One line each, naming the file and the key, row or pixel window, and what was expected.
    """

    def __init__(self, faults: str | Iterable[str]) -> None:
        self.faults = (faults,) if isinstance(faults, str) else tuple(faults)
        super().__init__("\n".join(self.faults))


def fault_of(error: BaseException) -> str:
    """Describe an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def check_file(path: Path, expected: str, most: int) -> None:
    """Check that an input is a regular file of at most some number of bytes.

    Parameters
    ----------
    path : Path
    expected : str
        What kind of file is expected, for the message.
    most : int
        Bytes.

    Raises
    ------
    InputError
    """
    try:
        if not path.exists():
            raise InputError(f"{path}: cannot be read: no such file; {expected}")
        if not path.is_file():
            raise InputError(f"{path}: cannot be read: not a regular file; {expected}")
        if path.stat().st_size > most:
            raise InputError(f"{path}: larger than {most} bytes; {expected}")
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read: {error}") from None
