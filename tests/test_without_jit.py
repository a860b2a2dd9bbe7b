"""The kernels' tests with compilation off: what the compiled code does is what the source says.

Compiled code reads past an array's end without a word; the source raises. The simulator's random
numbers are left out: they rest on integers that wrap round, which only compiled code has.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = (
    "tests/survey/test_navigation.py::test_equals_brute_force_over_all_segments",
    "tests/numerics",
    "tests/ripples/test_rendering.py",
    "tests/simulate/test_scattering.py",
)
# Minutes long without compilation, or simulated by facets.
TOO_LONG = ("recovered", "pulse", "maps_origin")


def test_kernels_do_the_same_uncompiled():
    chosen = " and ".join(f"not {name}" for name in TOO_LONG)
    command = [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *TESTS]
    ran = subprocess.run(
        [*command, "-k", chosen], cwd=ROOT, env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout[-3000:]
    assert int(re.search(r"(\d+) passed", ran.stdout)[1]) > 50
