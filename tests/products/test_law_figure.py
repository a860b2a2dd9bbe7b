import numpy as np
import pytest

from sasmap.passes.looks import Shared
from sasmap.passes.shared import Population, SurveyModel, merged
from sasmap.products.law_figure import law_caption, law_figure, level


def model(sd, learned=True):
    rng = np.random.default_rng(1)
    laws = np.array([2.0, 0.1]) + sd * rng.standard_normal((24, 2))
    values = [
        Shared(law, np.full(2, 0.1), np.zeros(2), np.zeros(1), np.full(3, 0.01), 0.2, 0.03)
        for law in laws
    ]
    return SurveyModel(tuple(values), learned)


def test_lambert_is_twenty_times_the_log_of_the_sine():
    degrees = np.array([5.0, 10.0, 40.0])
    found = level(2.0, 0.0, degrees, 10.0)
    sines = np.sin(np.radians(degrees))
    np.testing.assert_allclose(found, 20 * np.log10(sines / sines[1]), atol=1e-9)


def test_the_caption_says_whether_anything_fixed_the_law():
    picture = law_figure(model(0.05), (6.0, 25.0))
    assert picture.source.startswith("data:image/png;base64,")
    assert "n 2.0" in picture.caption
    assert "No shadow" not in picture.caption
    assert "Neither shadow" in law_caption(model(1.0))


def test_the_caption_says_that_shape_misleads():
    plain = model(0.05)
    bent = [v._replace(shift=np.array([-1.0, 0.0])) for v in plain.values]
    assert "another form" not in law_caption(plain)
    assert "biases n by -1.0" in law_caption(SurveyModel(tuple(bent), True))


def test_two_laws_that_are_told_apart_are_both_drawn():
    one, other = model(0.05).values, model(0.08).values
    pairs = tuple(
        (Population(0.3, a), Population(0.7, b._replace(law=b.law + 1.0)))
        for a, b in zip(one, other, strict=True)
    )
    survey = SurveyModel(tuple(merged(p) for p in pairs), True, pairs, True)
    caption = law_caption(survey)
    assert "law 1, 30 % of the cells: n 2.0" in caption
    assert "law 2, 70 % of the cells: n 3.0" in caption
    mapped = law_caption(survey._replace(sediments=(1, 3)), ["mud", "sand", "gravel"])
    assert "mud: n 2.0" in mapped
    assert "gravel: n 3.0" in mapped
    alone = survey._replace(apart=False)
    assert "law 2" not in law_caption(alone)
    ranges = (6.0, 25.0)
    assert law_figure(survey, ranges).source != law_figure(alone, ranges).source


@pytest.mark.parametrize("survey", [None, model(0.1, learned=False)])
def test_a_law_that_was_not_learned_is_not_drawn(survey):
    assert law_figure(survey, (6.0, 25.0)) is None
