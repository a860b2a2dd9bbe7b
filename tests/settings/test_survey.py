import json

import pytest
from pydantic import ValidationError

from sasmap.errors import InputError
from sasmap.settings.survey import load_survey, survey_schema
from tests.helpers import small_survey, with_pass


def faults(path):
    with pytest.raises(InputError) as caught:
        load_survey(path)
    return caught.value.faults


def test_defaults_and_paths(tmp_path):
    survey = load_survey(small_survey(tmp_path))
    assert survey.window == 20
    assert survey.seed == 1
    assert survey.output_folder == tmp_path / "out"
    assert survey.ripples.frequency == (0.05, 5.0)
    assert survey.ripples.height == (0.0, 0.5)
    assert survey.ripples.shadow == "line-of-sight"
    with pytest.raises(ValidationError):
        survey.window = 3


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"windw": 3}, "windw: unknown key; did you mean 'window'?"),
        ({"window": "wide"}, "window: expected a valid integer"),
        ({"crs": "EPSG:1"}, "crs: expected a CRS"),
        ({"name": None}, "name: missing"),
        ({"passes": []}, "passes: expected at least 1 entries"),
        (with_pass(side="left"), "passes[0].side: expected 'port', 'starboard' or 'both'"),
        (with_pass(date="May 2024"), "passes[0].date: expected a date such as 2024-05-01"),
        (with_pass(tiles=[]), "passes[0].tiles: expected at least 1"),
        (with_pass(range="diagonal"), "passes[0].range"),
        ({"ripples": {"frequency": [3, 1]}}, "ripples.frequency: expected 0 <= lower < upper"),
        ({"ripples": {"height": [0, "inf"]}}, "ripples.height[1]"),
        ({"ripples": {"frequency": [0, 1]}}, "above 0 cycles/m"),
        ({"ripples": None}, "nothing to compute"),
        ({"sediments": {"classes": 0}}, "sediments.classes: expected auto, a number"),
        ({"seed": -1}, "seed"),
    ],
)
def test_each_fault_is_one_line_with_file_and_key(tmp_path, changes, says):
    (fault,) = faults(small_survey(tmp_path, **changes))
    assert fault.startswith(str(tmp_path / "survey.yaml"))
    assert says in fault
    assert "\n" not in fault


def test_all_faults_at_once(tmp_path):
    found = faults(small_survey(tmp_path, window=1, seed="x", colour="blue"))
    assert {f.split(": ")[1] for f in found} == {"window", "seed", "colour"}


def test_same_pass_name_twice(tmp_path):
    one = with_pass()["passes"][0]
    other = {**one, "tiles": ["tiles/*.tif"]}
    (fault,) = faults(small_survey(tmp_path, passes=[one, other]))
    assert "'one' twice" in fault


def test_published_method_takes_bounds_from_zero(tmp_path):
    block = {"method": "zare-cobb", "frequency": [0, 1], "height": [0, 1]}
    assert load_survey(small_survey(tmp_path, ripples=block)).ripples.frequency == (0, 1)


def test_schema_describes_every_key():
    schema = json.loads(survey_schema())
    assert set(schema["properties"]) == {
        "name", "output", "crs", "window", "seed", "passes", "area", "exclude",
        "ripples", "sediments",
    }  # fmt: skip
    assert schema["additionalProperties"] is False


def test_an_empty_block_takes_its_defaults(tmp_path):
    path = small_survey(tmp_path)
    path.write_text(path.read_text().replace("ripples: {}", "ripples:\nsediments:"))
    survey = load_survey(path)
    assert survey.ripples.frequency == (0.05, 5.0)
    assert survey.sediments.classes == "auto"
