"""What `plan` says of a run's memory."""

import sasmap
from sasmap.run import cost
from sasmap.run.plan import make_plan
from tests.helpers import small_survey


def test_memory_is_a_constant_and_an_amount_per_worker(tmp_path, monkeypatch):
    monkeypatch.setattr(cost, "seconds_of", lambda plan, workers: (1.0, 1.0))
    small, large = (
        make_plan(sasmap.load_survey(small_survey(tmp_path / str(window), window=window)))
        for window in (10, 20)
    )
    one, three = cost.cost_of(small, 1), cost.cost_of(small, 3)
    assert three.memory - one.memory == 2 * one.per_worker
    assert cost.cost_of(large, 1).per_worker == 4 * one.per_worker  # proportional to the pixels
    (line,) = (v for v in cost.describe_cost(small, 3) if v.startswith("memory"))
    assert "for each of 3 threads" in line
