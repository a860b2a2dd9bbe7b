"""A YAML reader without surprises: YAML 1.2 scalars, no duplicate keys, no aliases."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from sasmap.errors import InputError, check_file

# Largest settings file that is read, bytes (a choice: a thousand passes fill a tenth of it).
MAX_BYTES = 1_000_000


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader with the YAML 1.2 core schema that refuses aliases and duplicate keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.constructor.ConstructorError(
                None, None, "aliases are not accepted: write the value out", event.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"expected a text key, got {key!r}", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key '{key}' is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep=deep)

    def construct_core_int(self, node: yaml.ScalarNode) -> int:
        return int(str(self.construct_scalar(node)))

    def construct_core_float(self, node: yaml.ScalarNode) -> float:
        text = str(self.construct_scalar(node)).lower().replace(".inf", "inf")
        return float(text.replace(".nan", "nan"))


_SCALARS = (
    ("null", r"^(~|null|Null|NULL|)$", "~nN\0"),
    ("bool", r"^(true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("int", r"^[-+]?[0-9]{1,18}$", "-+0123456789"),
    (
        "float",
        r"^([-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$",
        "-+0123456789.",
    ),
)
for _tag, _pattern, _first in _SCALARS:
    _StrictLoader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}",
        re.compile(_pattern),
        [c if c != "\0" else "" for c in _first],
    )
# Without base-8, base-60 or underscore notations: 010 is ten and 12:30 is text.
_StrictLoader.add_constructor("tag:yaml.org,2002:int", _StrictLoader.construct_core_int)
_StrictLoader.add_constructor("tag:yaml.org,2002:float", _StrictLoader.construct_core_float)


def load_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Parameters
    ----------
    path : Path
        A local text file in UTF-8.

    Returns
    -------
    dict
        The mapping, of plain Python values.

    Raises
    ------
    InputError
        Where the file cannot be read or is not YAML, holds an alias, a tag, a duplicate key,
        or is not a mapping.
    """
    try:
        check_file(path, "expected a YAML text file", MAX_BYTES)
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected a UTF-8 text file") from None
    try:
        content = yaml.load(text, Loader=_StrictLoader)  # a SafeLoader, made stricter
    except yaml.YAMLError as error:
        raise InputError(f"{path}: {_one_line(error)}") from None
    except RecursionError:
        raise InputError(f"{path}: nested too deeply") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: a value does not fit its tag: {_short(error)}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected 'key: value' lines at the top level")
    return content


class _CoreDumper(yaml.SafeDumper):
    """SafeDumper that quotes whatever `load_yaml` would not read back as text."""


for _tag, _pattern, _first in _SCALARS:
    _CoreDumper.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), [c if c != "\0" else "" for c in _first]
    )


def dump_yaml(content: dict[str, Any]) -> str:
    """Write a mapping as YAML that :func:`load_yaml` reads back to the same values.

    Parameters
    ----------
    content : dict
        Of numbers, strings, lists and dicts.

    Returns
    -------
    str
    """
    return yaml.dump(content, Dumper=_CoreDumper, sort_keys=False, allow_unicode=True)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:100]


def _one_line(error: yaml.YAMLError) -> str:
    if isinstance(error, yaml.MarkedYAMLError):
        problem = " ".join((error.problem or "not valid YAML").split())
        mark = error.problem_mark
        return f"line {mark.line + 1}: {problem}" if mark is not None else problem
    return " ".join(str(error).split())
