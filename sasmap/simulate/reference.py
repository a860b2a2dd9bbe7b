"""The reference page of scene.yaml, generated from the model so that it stays correct."""

from __future__ import annotations

from sasmap.settings.reference import page_of_keys
from sasmap.simulate.scene import Scene

HEAD = """# Keys of scene.yaml

Generated from the program's model by `python -m sasmap.simulate.reference > docs/scene.md`. A scene
is a sea floor with known truth and the passes by it; `sasmap simulate scene.yaml --output DIR`
renders its tiles and writes navigation, truth and a `survey.yaml` that runs.
`sample_data/scene.yaml` is one.
"""


def scene_reference() -> str:
    """Return the reference page, in Markdown."""
    schema = Scene.model_json_schema()
    blocks = schema["$defs"]
    parts = (
        ("The scene", schema),
        ("An entry of `sediments`", blocks["Sediment"]),
        ("An entry of `ripples`", blocks["RipplePatch"]),
        ("An entry of `passes`", blocks["ScenePass"]),
        ("A `law` of your own: sin^n(theta) exp(-c (theta - pi/2)^2)", blocks["PowerLaw"]),
    )
    return page_of_keys(HEAD, parts)


if __name__ == "__main__":
    print(scene_reference(), end="")
