"""report.html: one self-contained file. All text from outside is escaped."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from sasmap.io.files import write_text


def write_report(path: Path, content: Mapping[str, Any], scratch: Path) -> Path:
    """Write the report.

    Parameters
    ----------
    path : Path
    content : mapping
        Values for the template ``report.html.j2``.
    scratch : Path

    Returns
    -------
    Path
    """
    environment = Environment(
        loader=PackageLoader("sasmap.products"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    text = environment.get_template("report.html.j2").render(**content)
    write_text(path, text, scratch)
    return path
