"""survey.yaml as a frozen model, and every message about it."""

from __future__ import annotations

import difflib
import json
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import pyproj
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    StringConstraints,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails

from sasmap.errors import InputError
from sasmap.ripples.settings import RippleSettings
from sasmap.settings.yamlfile import load_yaml

Name = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]+$")]


# Columns that are read from a navigation file.
NavigationColumn = Literal["x", "y", "longitude", "latitude", "altitude"]

_CLASSES = "expected auto, a number of at least 1, or a list of classes with training polygons"

Model = TypeVar("Model", bound=BaseModel)


class _Block(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PassSettings(_Block):
    """One pass of the sonar: its tiles, navigation and viewing side."""

    name: Name = Field(description="unique name of the pass")
    tiles: Annotated[tuple[Name, ...], Field(min_length=1)] = Field(
        description="globs relative to the survey file; single-band amplitude GeoTIFFs"
    )
    navigation: Name = Field(
        description="CSV: altitude and either longitude, latitude or x, y; one row per ping"
    )
    navigation_crs: str | None = Field(
        None,
        description="CRS of the navigation; default WGS 84 for longitude, latitude, "
        "the first tile's for x, y",
    )
    side: Literal["port", "starboard", "both"] = Field(
        description="side of the track that the tiles show; with both, each may show one only"
    )
    range: Literal["ground", "slant"] = Field(
        "ground", description="kind of range along the tiles' across-track axis"
    )
    amplitude: Literal["linear", "intensity", "db"] = Field(
        "linear",
        description="what the pixel values are: amplitude, its square, or 20 log10 of it (dB)",
    )
    columns: dict[NavigationColumn, Name] | None = Field(
        None,
        description="the CSV's names for `x`, `y`, `longitude`, `latitude`, `altitude`",
    )
    altitude_sd: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = Field(
        0.02, description="standard deviation of the altitude, m"
    )
    date: str | None = Field(
        None,
        description="when it was recorded: a date, or date and time, such as 2024-05-01 or "
        "2024-05-01T14:30:00Z",
    )

    @field_validator("columns")
    @classmethod
    def _own_columns(cls, value: dict[str, str] | None) -> dict[str, str] | None:
        given = [] if value is None else [name.strip().lower() for name in value.values()]
        twice = sorted({name for name in given if given.count(name) > 1})
        if twice:
            raise ValueError(f"expected a different column for each, got {twice[0]!r} twice")
        return value

    @field_validator("navigation_crs")
    @classmethod
    def _known_crs(cls, value: str | None) -> str | None:
        return _check_crs(value)

    @field_validator("date")
    @classmethod
    def _iso_date(cls, value: str | None) -> str | None:
        if value is not None:
            try:
                datetime.fromisoformat(value)
            except ValueError:
                raise ValueError(
                    f"expected a date such as 2024-05-01 or 2024-05-01T14:30:00Z, got {value!r}"
                ) from None
        return value


class ClassSettings(_Block):
    """A sediment class with its training polygons."""

    name: Name = Field(description="unique name of the class")
    training: Name = Field(description="GeoJSON or GeoPackage of polygons, in any CRS")


class SedimentSettings(_Block):
    """Settings of the sediment map."""

    classes: (
        Literal["auto"]
        | Annotated[int, Field(ge=1, le=250)]
        | Annotated[tuple[ClassSettings, ...], Field(min_length=1)]
    ) = Field("auto", description="auto, a number, or a list of named classes with training")
    model: Name | None = Field(
        None, description="sediment_classes.json of another run, whose classes are used instead"
    )
    least_area: Annotated[float, Field(ge=0, le=1e6)] = Field(
        0.5, description="smallest area on the map, m^2; smaller patches join a neighbouring class"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.model is not None and "classes" in self.model_fields_set:
            raise ValueError("expected classes or model, not both")
        if isinstance(self.classes, tuple):
            names = [c.name for c in self.classes]
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(
                    f"classes: expected a different name for each, got {twice[0]!r} twice"
                )
            if len(names) > 250:
                raise ValueError("classes: expected at most 250")
        return self


class Survey(_Block):
    """A survey: what to map, from which passes, into which folder."""

    name: Name = Field(description="shown in products and the report")
    output: Name = Field("out", description="folder of the products, relative to the survey file")
    crs: str | None = Field(None, description="CRS of the products; default the first tile's")
    window: Annotated[int, Field(ge=3, le=10_000)] = Field(
        500, description="pixels; a cell is window times the first tile's pixel size"
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(
        1, description="seed of all random numbers: the same seed gives the same bytes"
    )
    passes: Annotated[tuple[PassSettings, ...], Field(min_length=1)] = Field(
        description="one entry per pass"
    )
    area: Name | None = Field(
        None, description="GeoJSON or GeoPackage of polygons: only cells that touch them are mapped"
    )
    exclude: Name | None = Field(
        None, description="GeoJSON or GeoPackage of polygons whose pixels are left out"
    )
    ripples: RippleSettings | None = Field(None, description="no block: no ripple products")
    sediments: SedimentSettings | None = Field(None, description="no block: no sediment products")

    _path: Path = PrivateAttr(default_factory=lambda: Path("survey.yaml"))

    @field_validator("crs")
    @classmethod
    def _known_crs(cls, value: str | None) -> str | None:
        return _check_crs(value)

    @model_validator(mode="before")
    @classmethod
    def _empty_blocks(cls, content: Any) -> Any:
        """Fill a block that is named but left empty with its defaults."""
        if not isinstance(content, dict):
            return content
        empty: dict[str, Any] = {
            k: {} for k in ("ripples", "sediments") if k in content and content[k] is None
        }
        return content | empty

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [p.name for p in self.passes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"passes: expected a different name for each, got {twice[0]!r} twice")
        if self.ripples is None and self.sediments is None:
            raise ValueError("nothing to compute: expected a ripples or a sediments block")
        return self

    @property
    def path(self) -> Path:
        """The survey file; relative paths in it start from its folder."""
        return self._path

    @property
    def output_folder(self) -> Path:
        """Folder of the products."""
        return self.resolve(self.output)

    def resolve(self, path: str) -> Path:
        """Return a path of the survey file, relative ones from the file's own folder."""
        return self._path.parent / expanded(path)

    def find_pass(self, name: str) -> PassSettings:
        """Return the settings of a pass by its name.

        Raises
        ------
        InputError
            Where the survey has no pass of that name.
        """
        for settings in self.passes:
            if settings.name == name:
                return settings
        known = ", ".join(p.name for p in self.passes)
        raise InputError(f"{self._path}: passes: no pass named {name!r}; there are: {known}")


def load_survey(path: str | Path) -> Survey:
    """Read and check a survey file.

    Parameters
    ----------
    path : str or Path
        The survey file (docs/keys.md).

    Returns
    -------
    Survey
        Frozen settings; the files that it names are not opened yet.

    Raises
    ------
    InputError
        With one line per fault, each naming file and key.

    Examples
    --------
    >>> survey = load_survey("sample_data/survey.yaml")
    >>> [p.name for p in survey.passes], survey.window
    (['near', 'far'], 500)
    """
    # absolute: workers of a cluster run in other folders
    path = expanded(str(path)).absolute()
    survey = parse_model(Survey, load_yaml(path), path)
    survey._path = path
    return survey


def expanded(path: str) -> Path:
    """Replace a leading ``~`` of a path by the user's home folder.

    Parameters
    ----------
    path : str

    Returns
    -------
    Path
        Unchanged where there is no such user, so that the missing file is reported.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:  # no such user: keep the path, so that the missing file is reported
        return Path(path)


def parse_model(model: type[Model], content: dict[str, Any], path: Path) -> Model:
    """Validate a file's content against a model.

    Parameters
    ----------
    model : type of pydantic model
    content : dict
        As parsed from YAML.
    path : Path
        Of the file, for messages.

    Returns
    -------
    model

    Raises
    ------
    InputError
        With one line for each fault.
    """
    try:
        return model.model_validate(content, strict=False)
    except ValidationError as error:
        raise InputError(fault_lines(model, error, path)) from None


def fault_lines(model: type[BaseModel], error: ValidationError, path: Path) -> list[str]:
    """Turn pydantic's errors into lines ``file: key: what was expected``.

    Parameters
    ----------
    model : type of pydantic model
    error : ValidationError
    path : Path
        Of the file that was validated.

    Returns
    -------
    list of str
        Without repeats.
    """
    lines = []
    details = error.errors(include_url=False)
    for detail in details:
        key = _key(detail["loc"])
        if detail["type"] == "too_short" and any(_inside(d, detail) for d in details):
            continue  # the faults of its entries are reported
        if key.endswith("sediments.classes"):  # a fault for each kind of value it could have been
            detail["type"], detail["msg"] = "value_error", _CLASSES
        lines.append(
            " ".join(f"{path}: {f'{key}: ' if key else ''}{_message(model, detail)}".split())
        )
    return list(dict.fromkeys(lines))


def _inside(one: ErrorDetails, other: ErrorDetails) -> bool:
    depth = len(other["loc"])
    return len(one["loc"]) > depth and one["loc"][:depth] == other["loc"]


def survey_schema() -> str:
    """Return the JSON Schema of survey.yaml."""
    return json.dumps(Survey.model_json_schema(), indent=2)


def _check_crs(value: str | None) -> str | None:
    if value is not None:
        try:
            pyproj.CRS.from_user_input(value)
        except pyproj.exceptions.ProjError:
            raise ValueError(f"expected a CRS such as EPSG:32617, got {value!r}") from None
    return value


def _key(location: tuple[int | str, ...]) -> str:
    key = ""
    for part in location:
        if isinstance(part, int):
            key += f"[{part}]"
        elif "[" not in part and "-" not in part and part not in ("int", "str"):
            key += f".{part}" if key else part
    return key


def _message(model: type[BaseModel], detail: ErrorDetails) -> str:
    kind, given = detail["type"], detail.get("input")
    if kind == "extra_forbidden":
        name = str(detail["loc"][-1])
        close = difflib.get_close_matches(name, _known_keys(model), n=1)
        return "unknown key" + (f"; did you mean '{close[0]}'?" if close else "")
    if kind == "missing":
        return "missing; this key is required"
    message = detail["msg"].removeprefix("Value error, ")
    if kind == "value_error":
        return message
    if kind in ("too_short", "too_long"):
        length = detail["ctx"].get("min_length", detail["ctx"].get("max_length"))
        return f"expected {'at least' if kind == 'too_short' else 'at most'} {length} entries"
    plain = {"tuple_type": "a list, such as [a, b]", "model_type": "keys and values below it"}
    if kind in plain:
        message = f"expected {plain[kind]}"
    message = message.replace("Input should be", "expected")
    return f"{message[0].lower()}{message[1:]}, got {_short(given)}"


def _known_keys(model: type[BaseModel]) -> list[str]:
    schema = model.model_json_schema()
    blocks = [schema, *schema.get("$defs", {}).values()]
    return sorted({key for block in blocks for key in block.get("properties", {})})


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
