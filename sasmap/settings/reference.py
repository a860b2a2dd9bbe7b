"""The reference page of survey.yaml, generated from the model so that it stays correct."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sasmap.settings.survey import Survey

HEAD = """# Keys of survey.yaml

Generated from the program's model by `python -m sasmap.settings.reference > docs/keys.md`. Any
other key, and a value of the wrong type or out of range, is refused with a line that says what was
expected. Relative paths start at the survey file's folder. `sasmap schema` prints the same as
JSON Schema, for editors.
"""


def survey_reference() -> str:
    """Return the reference page, in Markdown."""
    schema = Survey.model_json_schema()
    blocks = schema["$defs"]
    parts = (
        ("The survey", schema),
        ("An entry of `passes`", blocks["PassSettings"]),
        ("`ripples`", blocks["RippleSettings"]),
        ("`sediments`", blocks["SedimentSettings"]),
        ("An entry of `sediments.classes`", blocks["ClassSettings"]),
    )
    return page_of_keys(HEAD, parts)


def page_of_keys(head: str, parts: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """Return a page of tables of keys, in Markdown.

    Parameters
    ----------
    head : str
        What stands above the tables.
    parts : sequence of (str, dict)
        Title and JSON Schema of each block.

    Returns
    -------
    str
    """
    lines = [head]
    for title, block in parts:
        lines.append(f"## {title}\n")
        lines.append("| key | value | default | meaning |")
        lines.append("|---|---|---|---|")
        lines.extend(_rows(block))
        lines.append("")
    return "\n".join(lines)


def _rows(block: dict[str, Any]) -> Iterator[str]:
    required = block.get("required", ())
    for key, about in block["properties"].items():
        default = "required" if key in required else _default(about)
        text = about.get("description", "")
        yield f"| `{key}` | {_kind(about)} | {default} | {text} |"


def _default(about: dict[str, Any]) -> str:
    value = about.get("default")
    if value is None:
        return "none"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _kind(about: dict[str, Any]) -> str:
    """Describe the values that a key takes."""
    if "anyOf" in about:
        kinds = [_kind(one) for one in about["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    if "$ref" in about or about.get("type") == "object":
        return "a block"
    if "enum" in about:
        return ", ".join(f"`{value}`" for value in about["enum"])
    if "const" in about:
        return f"`{about['const']}`"
    if about.get("type") == "array":
        if "prefixItems" in about:
            return f"a list of {len(about['prefixItems'])} numbers"
        if "prefixItems" in about["items"]:
            return "a list of pairs of numbers"
        inner = _kind(about["items"])
        return f"a list of {'blocks' if inner == 'a block' else 'texts'}"
    names = {
        "integer": "whole number",
        "number": "number",
        "string": "text",
        "boolean": "true, false",
    }
    return names[about["type"]] + _range(about)


def _range(about: dict[str, Any]) -> str:
    if about["type"] not in ("integer", "number"):
        return ""
    low, high = about.get("minimum"), about.get("maximum", about.get("exclusiveMaximum"))
    if low is None:
        return ""
    return f" from {low:,}" if high is None or high > 1e12 else f" from {low:,} to {high:,}"


if __name__ == "__main__":
    print(survey_reference(), end="")
