import math

import pytest
from pydantic import ValidationError

from sasmap.ripples import RippleSettings
from sasmap.ripples.settings import Exponent, scattering_law


@pytest.mark.parametrize(
    ("setting", "law"),
    [
        ("estimated", None),
        ("lambert", (2.0, 0.0)),
        ("zare-cobb", (0.0, 3 / math.pi)),
        ({"exponent": 1.3}, (1.3, 0.0)),
        ({"exponent": 0}, (0.0, 0.0)),
        ({"exponent": 4}, (4.0, 0.0)),
    ],
)
def test_scattering_laws(setting, law):
    settings = RippleSettings(scattering=setting)
    assert scattering_law(settings.scattering) == (law if law is None else pytest.approx(law))
    assert isinstance(settings.scattering, Exponent) == isinstance(setting, dict)
    assert RippleSettings(**settings.model_dump()) == settings


@pytest.mark.parametrize(
    "setting",
    [
        "gaussian",
        "Lambert",
        "",
        None,
        2,
        {},
        {"exponent": -0.1},
        {"exponent": 4.1},
        {"exponent": math.nan},
        {"exponent": math.inf},
        {"exponent": "steep"},
        {"exponent": 2, "concentration": 1},
        {"power": 2},
        ["lambert"],
    ],
)
def test_what_is_no_scattering_law_is_refused(setting):
    with pytest.raises(ValidationError, match="scattering"):
        RippleSettings(scattering=setting)


def test_law_is_estimated_unless_told():
    assert RippleSettings().scattering == "estimated"
    assert RippleSettings().shadow == "line-of-sight"


@pytest.mark.parametrize("gone", ["profile", "presence", "speckle"])
def test_settings_that_went_are_refused(gone):
    with pytest.raises(ValidationError, match=gone):
        RippleSettings(**{gone: "sine"})


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"frequency": (0, 1)}, "above 0"),
        ({"frequency": (2, 1)}, "lower < upper"),
        ({"height": (-0.1, 1)}, "lower < upper"),
        ({"height": (0.1, 0.1)}, "lower < upper"),
        ({"height": (0, math.inf)}, "height"),
        ({"scatter": (0, -1, 0)}, "scatter"),
        ({"chains": 1}, "chains"),
        ({"draws": 99}, "draws"),
        ({"shadow": "none"}, "shadow"),
        ({"method": "other"}, "method"),
    ],
)
def test_what_is_refused(change, word):
    with pytest.raises(ValidationError, match=word):
        RippleSettings(**change)
    if change == {"frequency": (0, 1)}:
        assert RippleSettings(method="zare-cobb", **change).frequency == (0, 1)
