"""Which room of the package may import which: one way, downwards."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sasmap

PACKAGE = Path(sasmap.__file__).parent
BASE = {"arrays", "errors", "version", "catalogue"}
# A room may import the rooms below it that are listed, itself and the base.
MAY = {
    "numerics": set(),
    "io": set(),
    "ripples": {"numerics"},
    "passes": {"numerics", "ripples"},
    "sediments": {"numerics"},
    "settings": {"ripples", "io"},
    "survey": {"settings", "io", "numerics", "ripples", "sediments"},
    "products": {"io", "ripples", "passes", "sediments", "survey"},
    "simulate": {"settings", "io", "products", "ripples"},
    "run": {"settings", "io", "numerics", "ripples", "passes", "sediments", "survey", "products"},
}
NUMBERS_ONLY = ("numerics", "ripples", "passes", "sediments")
OUTSIDE = {"dask", "distributed", "rasterio", "pyogrio", "pyproj", "shapely", "matplotlib"}


def imports(path):
    """Full names of what a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            yield node.module


def breaches(files, room):
    """Imports of files of a room that its rule forbids."""
    for path in files:
        for name in imports(path):
            parts = name.split(".")
            if parts[0] == "sasmap" and len(parts) > 1:
                if parts[1] not in MAY[room] | BASE | {room}:
                    yield f"{path.name}: {name}"
            elif room in NUMBERS_ONLY and parts[0] in OUTSIDE:
                yield f"{path.name}: {name}"


@pytest.mark.parametrize("room", sorted(MAY))
def test_a_room_imports_only_what_lies_below_it(room):
    assert list(breaches(sorted((PACKAGE / room).rglob("*.py")), room)) == []


def test_every_package_is_a_room_of_the_rule():
    rooms = {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert rooms == set(MAY)


def test_a_breach_is_found(tmp_path):
    (tmp_path / "bad.py").write_text("import rasterio\nfrom sasmap.run.store import Store\n")
    assert len(list(breaches([tmp_path / "bad.py"], "ripples"))) == 2


def test_the_rule_itself_has_no_circle():
    order, rest = [], dict(MAY)
    while rest:
        free = [room for room, below in rest.items() if below <= set(order)]
        assert free, f"a circle among {sorted(rest)}"
        order += free
        rest = {room: below for room, below in rest.items() if room not in free}


def test_modules_of_a_room_import_each_other_without_a_circle():
    for room in MAY:
        below = {
            ".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): {
                n for n in imports(p) if n.startswith(f"sasmap.{room}.")
            }
            for p in (PACKAGE / room).rglob("*.py")
            if p.name != "__init__.py"
        }
        done = set()
        while below:
            free = [name for name, needs in below.items() if not (needs & set(below)) - {name}]
            assert free, f"a circle among {sorted(below)}"
            done |= set(free)
            below = {name: needs for name, needs in below.items() if name not in done}


def test_a_worker_loads_no_products():
    code = (
        "import sys, sasmap.run.task, sasmap.run.scheduling;"
        "print([m for m in sys.modules if m.startswith('sasmap.products')])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    assert found.stdout.strip() == "[]"
