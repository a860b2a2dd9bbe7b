"""Run the scotsman line, from any data folder: python pipelines/scotsman/run.py --data DIR."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import yaml

from sasmap.cli import main as sasmap

HERE = Path(__file__).resolve().parent


def main() -> int:
    """Write the survey file for the folders given, and run it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=HERE / "../out/scotsman")
    options = parser.parse_args()
    survey = yaml.safe_load((HERE / "survey.yaml").read_text(encoding="utf-8"))
    data = options.data.resolve()
    line = survey["passes"][0]
    line["tiles"] = [str(data / Path(name).name) for name in line["tiles"]]
    line["navigation"] = str(data / Path(line["navigation"]).name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "survey.yaml"
        path.write_text(yaml.safe_dump(survey, sort_keys=False), encoding="utf-8")
        return sasmap(["run", str(path), "--output", str(options.output.resolve())])


if __name__ == "__main__":
    sys.exit(main())
