import json

import numpy as np
import pytest

from sasmap.passes.derived import Derived
from sasmap.passes.summary import Summary
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.run.store import Store, code_version, digest

DONE = Summary(
    Quality.GOOD,
    LeftOut.SHADOW | LeftOut.PHASE_FIELD,
    mean=(0.1 + 0.2, 1 / 3),
    azimuth=90.0,
    coherence_length=float("inf"),
    derived=Derived((1.5, 0.1), (0.1, 0.2, 0.3, 0.4)),
    reason="too few waves in the window",
)


def test_results_come_back_to_the_bit(tmp_path):
    store = Store(tmp_path)
    assert store.load("ab12") is None
    store.save("ab12", DONE)
    again = store.load("ab12")
    assert repr(again) == repr(DONE)
    assert isinstance(again.quality, Quality)
    assert LeftOut.PHASE_FIELD in again.left_out
    assert isinstance(again.derived, Derived)
    assert again.reason == DONE.reason
    assert np.isinf(again.coherence_length)
    json.loads(store.path("ab12").read_text(), parse_constant=pytest.fail)  # no NaN


def test_broken_results_count_as_unfinished(tmp_path):
    store = Store(tmp_path)
    store.save("ab12", DONE)
    path = store.path("ab12")
    whole = path.read_text()
    for text in ("", whole[: len(whole) // 2], "{}", "[1]", whole.replace("azimuth", "azimut")):
        path.write_text(text)
        assert store.load("ab12") is None


def test_clear_and_leftovers(tmp_path):
    store = Store(tmp_path)
    store.save("ab12", DONE)
    (store.scratch / "x.part").write_text("half")
    store.remove_leftovers()
    assert not list(store.scratch.iterdir())
    store.clear()
    assert store.load("ab12") is None


def test_digest_sees_every_change_and_no_order_of_keys():
    assert digest({"a": 1, "b": [2.5]}) == digest({"b": [2.5], "a": 1})
    assert digest({"a": 1}) != digest({"a": 2})
    assert code_version().startswith("0.")
