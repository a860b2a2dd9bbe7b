"""What is wrong with an input, told in one line a fault."""

from __future__ import annotations

from collections.abc import Iterable


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
