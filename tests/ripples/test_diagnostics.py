import numpy as np
import pytest
from arviz_stats.base import array_stats

from sasmap.ripples.diagnostics import ess_bulk, ess_tail, rhat

AXES = {"chain_axis": 0, "draw_axis": 1}


@pytest.mark.parametrize("correlation", [-0.5, 0.0, 0.5, 0.95, 0.999])
@pytest.mark.parametrize("shape", [(2, 4), (2, 21), (4, 50), (4, 101), (4, 1000), (7, 333)])
def test_equal_to_arviz(correlation, shape):
    rng = np.random.default_rng(2)
    noise = rng.standard_t(3, size=shape)
    draws = np.zeros(shape)
    for t in range(1, shape[1]):
        draws[:, t] = correlation * draws[:, t - 1] + noise[:, t]
    tail = {"method": "tail", "prob": (0.05, 0.95)}
    assert rhat(draws) == pytest.approx(float(array_stats.rhat(draws, **AXES)), abs=1e-8)
    bulk = float(array_stats.ess(draws, method="bulk", **AXES))
    assert ess_bulk(draws) == pytest.approx(bulk, abs=1e-8)
    assert ess_tail(draws) == pytest.approx(float(array_stats.ess(draws, **tail, **AXES)), abs=1e-8)


def test_chains_apart_do_not_pass():
    draws = np.random.default_rng(1).normal(size=(4, 500)) + np.array([[0], [0], [0], [3]])
    assert rhat(draws) > 1.3
    assert ess_bulk(draws) < 20


def test_a_chain_that_wanders_wider_does_not_pass():
    draws = np.random.default_rng(1).normal(size=(4, 500)) * np.array([[1], [1], [1], [5]])
    assert rhat(draws) > 1.1


def test_constant_short_and_broken_draws():
    assert rhat(np.ones((4, 100))) == 1.0
    for bad in (np.ones((4, 3)), np.full((4, 100), np.nan), np.ones(100)):
        assert np.isnan(rhat(bad))
        assert np.isnan(ess_bulk(bad))
        assert np.isnan(ess_tail(bad))
