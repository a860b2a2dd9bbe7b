"""Text tables of many styles, read into columns of numbers.

pandas reads the cells; faults that it would silently repair (surplus cells, duplicate column names)
are refused here, with the row number in the file: the first line is row 1.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sasmap.arrays import FloatArray
from sasmap.errors import InputError, check_file

# Largest table that is read, bytes: about ten million pings.
MAX_BYTES = 2**29
# Separators; a header without any of them is separated by spaces.
MARKS = ",;\t|"
COMMENTS = ("#", "%", "//", "!")
# Maximum number of lines before the header, such as titles.
MOST_HEAD = 40
# Text that stands for a missing number.
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--", "*", "?"})
# Units that need no conversion; others in a header are refused.
UNITS = frozenset(
    ("m", "metre", "metres", "meter", "meters", "deg", "degree", "degrees", "degt", "°", "wgs84")
)
# Metres with a remark on the reference surface.
_METRES_ABOVE = re.compile(r"^(m|met(er|re)s?) (above|over|from) ")
# Thousands separators between digits: spaces of several widths and apostrophes.
_THOUSANDS = re.compile(r"(?<=\d)[ \u00a0\u2009\u202f'\u2019](?=\d{3}(\D|$))")
_UNIT = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
# A unit to be refused at the end of a name without brackets: altitude_ft.
_UNIT_TO_REFUSE = re.compile(
    r"^(.+?)[_\s.-]+(ft|foot|feet|yds?|yards?|fm|fathoms?|mm|cm|dm|km|nm|rad|radians?)$", re.I
)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a table as text.

    Attributes
    ----------
    path : Path
    header : list of str
        Names, lower case, without units.
    full : list of str
        Names, lower case, with units.
    units : list of str
        Text in brackets after each name.
    head_row : int
        Row of the header in the file.
    rows : list of int
        Row in the file of each row of `cells`.
    cells : DataFrame of str
    mark : str
    """

    path: Path
    header: list[str]
    full: list[str]
    units: list[str]
    head_row: int
    rows: list[int]
    cells: pd.DataFrame
    mark: str

    def numbers(self, name: str, gaps: bool = False) -> FloatArray:
        """Return a column as numbers.

        Parameters
        ----------
        name : str
            Lower case, with or without its unit.
        gaps : bool
            Whether cells may be empty; these become NaN.

        Raises
        ------
        InputError
            Where two columns have that name, the unit is unexpected, or a cell is not a number.
        """
        column = self._place(name)
        text = self.cells[column]
        values = np.array(pd.to_numeric(text, errors="coerce"), float)
        odd = ~np.isfinite(values)
        if not odd.any():
            return values
        for i in np.flatnonzero(odd):
            given = str(text.iloc[i]).strip()
            if given.lower() in MISSING and gaps:
                values[i] = np.nan
                continue
            values[i] = self._number(int(i), name, given)
        return values

    def _place(self, name: str) -> int:
        places = [k for k, known in enumerate(self.full) if known == name]
        places = places or [k for k, known in enumerate(self.header) if known == name]
        if len(places) > 1:
            raise InputError(
                f"{self.path}: row {self.head_row}: {len(places)} columns named {name!r}: "
                "expected one; delete or rename the others, or choose one with columns:"
            )
        unit = self.units[places[0]].lower()
        if unit and unit not in UNITS and not _METRES_ABOVE.match(unit):
            raise InputError(
                f"{self.path}: row {self.head_row}: {name} in {unit!r}: expected metres (degrees "
                "for longitude, latitude); convert it"
            )
        return places[0]

    def _number(self, i: int, name: str, given: str) -> float:
        where = f"{self.path}: row {self.rows[i]}: {name}"
        try:
            value = float(_point(given).replace("_", "?"))  # only Python accepts 1_000 as a number
        except ValueError:
            raise InputError(f"{where}: expected a number, got {given[:40]!r}") from None
        if not np.isfinite(value):
            raise InputError(f"{where}: expected a finite number, got {given[:40]!r}")
        return value


def _point(given: str) -> str:
    """Write a number with a decimal point: of commas and points, the last kind is decimal."""
    given = _THOUSANDS.sub("", given)
    comma, point = given.rfind(","), given.rfind(".")
    if comma < 0:
        return given.replace("\u2212", "-")
    if point > comma or given.count(",") > 1:
        return given.replace(",", "")
    return given.replace(".", "").replace(",", ".")


def read_table(path: Path, wanted: frozenset[str]) -> Table:
    """Read a text table whose columns are named by a header.

    Parameters
    ----------
    path : Path
    wanted : frozenset of str
        Names that identify the header below titles.

    Raises
    ------
    InputError
        Where the file is not a text table, or a row has more cells than the header.
    """
    lines = _lines(path)
    if not lines:
        raise InputError(f"{path}: empty: expected a header and one row per ping")
    head, mark = _find_header(lines, wanted)
    head_row, names = lines[head][0], _split(lines[head][1], mark)
    body = lines[head + 1 :]
    below = _units_below(body, mark, len(names))
    if below:
        body = body[1:]
    if len(body) < 2:
        raise InputError(f"{path}: expected at least two pings, got {len(body)}")
    cells = _cells(path, body, mark, len(names))
    header, units = zip(*(_name_and_unit(name) for name in names), strict=True)
    if below:
        units = tuple(given or more for given, more in zip(units, below, strict=True))
    full = [" ".join(name.lower().split()) for name in names]
    rows = [row for row, _ in body]
    return Table(path, list(header), full, list(units), head_row, rows, cells, mark)


def _units_below(body: list[tuple[int, str]], mark: str, width: int) -> list[str]:
    """Units in a separate row below the header; empty without such a row."""
    cells = [c.strip().strip("[]()").lower() for c in _split(body[0][1], mark)] if body else []
    if len(cells) != width or not any(cells) or any(re.search(r"\d", cell) for cell in cells):
        return []
    return cells if set(cells) & UNITS else []


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines that are neither blank nor comments, with their row numbers."""
    check_file(path, "expected a CSV file, one row per ping", MAX_BYTES)
    try:
        text = _decoded(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeError:
        text = None
    if text is None or "\0" in text:
        raise InputError(f"{path}: expected a CSV text file in UTF-8")
    found = []
    for row, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        bare = line.strip().strip(MARKS).strip()
        comment = bare.startswith(COMMENTS) or (row == 1 and bare.lower().startswith("sep="))
        if bare and not comment:
            found.append((row, line))
    return found


def _decoded(raw: bytes) -> str:
    """Decode UTF-8, UTF-16 with a byte-order mark, or else Windows-1252."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252")


def _find_header(lines: list[tuple[int, str]], wanted: frozenset[str]) -> tuple[int, str]:
    """Find the header, the first line that names altitude, and the separator."""
    for k, (_, line) in enumerate(lines[:MOST_HEAD]):
        mark = _mark_of(line)
        names = {_name_and_unit(name)[0] for name in _split(line, mark)}
        if names & wanted:
            return k, mark
    return 0, _mark_of(lines[0][1])


def _mark_of(line: str) -> str:
    mark = max(MARKS, key=line.count)
    return mark if mark in line else " "


def _split(line: str, mark: str) -> list[str]:
    if mark == " ":
        return re.sub(r"\s+(?=[\[(])", "", line).split()  # a unit belongs to the name before it
    try:
        return next(csv.reader([line], delimiter=mark, skipinitialspace=True), [])
    except csv.Error:  # a cell longer than csv's limit
        return line.split(mark)


def _cells(path: Path, body: list[tuple[int, str]], mark: str, width: int) -> pd.DataFrame:
    """Cells of all rows as text; an extra column catches surplus cells."""
    for row, line in body:
        # quoted separators do not count; lines with many are split completely
        if line.count(mark) > width and (found := len(_split(line, mark))) > width + 1:
            raise InputError(_surplus(path, row, found, width))
    text = "\n".join(line for _, line in body)
    try:
        cells = pd.read_csv(
            io.StringIO(text),
            sep=r"\s+" if mark == " " else mark,
            header=None,
            names=list(range(width + 1)),
            index_col=False,
            dtype=str,
            keep_default_na=False,
            skipinitialspace=True,
            skip_blank_lines=False,
            on_bad_lines="error",
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError, ValueError) as error:
        raise InputError(f"{path}: expected a CSV text file: {_short(error)}") from None
    if len(cells) != len(body):
        raise InputError(f"{path}: expected one line per row: a quoted cell spans lines")
    cells = cells.fillna("")
    surplus = np.flatnonzero(cells[width].str.strip() != "")
    if surplus.size:
        raise InputError(_surplus(path, body[int(surplus[0])][0], width + 1, width))
    return cells


def _surplus(path: Path, row: int, found: int, width: int) -> str:
    return (
        f"{path}: row {row}: {found} cells under {width} column names: name every "
        "column in the header, or quote decimal commas"
    )


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def _name_and_unit(name: str) -> tuple[str, str]:
    """Split a header cell: "Altitude (m)" is altitude in m."""
    bare = name.strip().strip("\"'").strip()
    found = _UNIT.match(bare) or _UNIT_TO_REFUSE.match(bare)
    return (found[1].lower(), found[2]) if found and found[1] else (bare.lower(), "")
