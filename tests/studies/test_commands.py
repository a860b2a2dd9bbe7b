"""The studies' commands run, and leave their tables."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# What a command writes, and the package from outside that it needs.
COMMANDS = {
    "beds.py": ("beds.csv", "pybedforms"),
    "echoes.py": ("echoes.csv", "openstb.simulator"),
    "leaving_out.py": ("leaving_out.md", None),
    "ripples.py": ("ripples.md", None),
    "shadow_method.py": ("shadow_method.csv", None),
    "stability.py": ("stability.md", None),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_quick_run_leaves_its_table(name, tmp_path):
    written, package = COMMANDS[name]
    if package:
        pytest.importorskip(package, reason="pip install -e '.[studies]'")
    script = ROOT / "pipelines" / "studies" / name
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(
        [sys.executable, script, "--quick", "--output", tmp_path],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    table = (tmp_path / written).read_text(encoding="utf-8")
    assert len(table.splitlines()) > 1
