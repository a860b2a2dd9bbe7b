"""Reading of scene files, separate from the scene's model, which does not depend on surveys."""

from __future__ import annotations

from pathlib import Path

from sasmap.errors import InputError
from sasmap.settings.survey import parse_model
from sasmap.settings.yamlfile import load_yaml
from sasmap.simulate.scene import Scene


def load_scene(path: str | Path) -> Scene:
    """Read and check a scene file.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        With one line per fault.
    """
    path = Path(path)
    keys = load_yaml(path)
    if "output" in keys:
        raise InputError(
            f"{path}: expected a scene to simulate, got a survey: 'sasmap run {path}' runs it"
        )
    return parse_model(Scene, keys, path)
