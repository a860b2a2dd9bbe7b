import numpy as np
import pytest

from sasmap.ripples import estimate
from sasmap.simulate import straight_clip
from tests.helpers import zare_cobb_clip


def test_intervals_hold_where_all_rows_sample_the_same_edges():
    # point-sampled shadow along the columns: f and A_H are off by more than speckle puts them
    rng = np.random.default_rng(5)
    scores = []
    for seed in range(12):
        f, height = rng.uniform(0.45, 0.75), rng.uniform(0.055, 0.085)
        posterior = estimate(zare_cobb_clip(30.0, 42.2, f, height, "line", seed), rng=seed)
        error = float(posterior.mean.frequency) - f, float(posterior.mean.height) - height
        sd = float(posterior.sd.frequency), float(posterior.sd.height)
        scores.append(np.abs(np.divide(error, sd)))
    assert np.sqrt(np.mean(np.square(scores), axis=0)) == pytest.approx([1.0, 1.0], abs=0.75)


def test_crests_across_the_lattice_are_known_better():
    def sd(azimuth):
        clip = straight_clip(
            np.random.default_rng(1), frequency=0.6, height=0.07, pixel_size=0.04,
            shape=(300, 300), near=30.0, azimuth=azimuth,
        )  # fmt: skip
        return float(estimate(clip, rng=1).sd.frequency)

    assert sd(90.0) > 1.5 * sd(80.0)


def test_without_shadow_nothing_is_widened():
    clip = zare_cobb_clip(2.0, 14.2, 0.6, 0.05, "line", 1)
    posterior = estimate(clip, rng=1)
    np.testing.assert_allclose(posterior.sd.frequency, posterior.chains.frequency.std(ddof=1))
