"""Reading a scene file; apart from the scene's model, which knows nothing of surveys."""

from __future__ import annotations

from pathlib import Path

from sasmap.config import parse_model
from sasmap.simulate.scene import Scene
from sasmap.yamlfile import load_yaml


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
        With one line for every fault found.
    """
    path = Path(path)
    return parse_model(Scene, load_yaml(path), path)
