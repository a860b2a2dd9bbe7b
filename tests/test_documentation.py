"""What the documentation says is so."""

import doctest
import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sasmap.products.reference import catalogue_reference
from sasmap.settings.reference import survey_reference
from sasmap.simulate.reference import scene_reference

ROOT = Path(__file__).resolve().parents[1]
MODULES = (
    "sasmap.settings.survey",
    "sasmap.survey.opening",
    "sasmap.ripples.estimation",
    "sasmap.sediments.distributions",
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_docstrings(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0
    assert found.failed == 0


def test_reference_of_keys_is_that_of_the_model():
    assert (ROOT / "docs" / "keys.md").read_text(encoding="utf-8") == survey_reference()


def test_reference_of_a_scene_is_that_of_the_model():
    assert (ROOT / "docs" / "scene.md").read_text(encoding="utf-8") == scene_reference()


def test_page_of_products_is_that_of_the_catalogue():
    assert (ROOT / "docs" / "products.md").read_text(encoding="utf-8") == catalogue_reference()


def test_to_arviz_tells_what_to_install(monkeypatch):
    from sasmap.ripples.posterior import Posterior, Quality, dataset
    from sasmap.ripples.priors import Prior

    for name in ("arviz", "arviz_base"):
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    draws = dataset({"frequency": np.full((2, 5), 0.6)})
    posterior = Posterior(Quality.GOOD, Prior.natural((0.05, 5.0), (0.0, 0.5)), draws)
    with pytest.raises(ImportError, match="pip install arviz"):
        posterior.to_arviz()


def test_files_that_the_readme_names_are_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in re.findall(r"\]\((?!http)([^)#]+)\)", text):
        assert (ROOT / name).exists(), name
    for name in re.findall(r"python (pipelines/[\w/]+\.py)", text):
        assert (ROOT / name).exists(), name


def test_the_tutorial_runs(tmp_path):
    pytest.importorskip("matplotlib")
    script = ROOT / "pipelines" / "tutorial.py"
    command = [sys.executable, str(script), "--picture", str(tmp_path / "posterior.png")]
    subprocess.run(command, cwd=ROOT, check=True, timeout=400)
    assert (tmp_path / "posterior.png").stat().st_size > 10_000


def test_posteriors_go_to_arviz():
    """ArviZ reads what its own summary needs: every chain and draw of every number."""
    from arviz_stats import summary

    from sasmap.ripples import estimate
    from tests.helpers import zare_cobb_clip

    posterior = estimate(zare_cobb_clip(24.4, 36.6, 0.6, 0.07, size=300), rng=1)
    converted = posterior.to_arviz()
    assert converted.posterior["frequency"].dims == ("chain", "draw")
    table = summary(converted, round_to="none")
    mean = float(posterior.draws["height"].mean())
    assert float(table.loc["height", "mean"]) == pytest.approx(mean, rel=1e-6)
