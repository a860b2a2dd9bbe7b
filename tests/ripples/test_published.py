import numpy as np
import pytest

from sasmap.ripples import Prior, RippleSettings, estimate
from sasmap.ripples.posterior import Quality
from sasmap.ripples.published import (
    initial,
    normalise,
    prior_data,
    published_amplitude,
    published_log_posterior,
    reduce,
)
from tests.helpers import zare_cobb_amplitude, zare_cobb_clip

SETTINGS = RippleSettings(method="zare-cobb", frequency=(0, 1), height=(0, 1))
PRIOR = prior_data(Prior.flat((0, 1), (0, 1)))


def test_amplitude_is_the_crest_rule_model():
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07)
    data = reduce(clip, normalise(clip))
    expected = zare_cobb_amplitude(data.ground_range, 0.6, 0.07, 4.83, "crest")
    np.testing.assert_allclose(published_amplitude(0.6, 0.07, data), expected, atol=1e-12)


def test_row_means_hold_all_that_the_gaussian_likelihood_uses():
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07, size=60)
    image = normalise(clip)
    data = reduce(clip, image)

    def pixel_by_pixel(frequency, height):
        model = zare_cobb_amplitude(clip.ground_range[0], frequency, height, 4.83, "crest")
        return -0.5 * ((image - model) ** 2).sum()

    points = [(0.6, 0.07), (0.5, 0.2), (0.9, 0.01)]
    short = [published_log_posterior(np.array(p), data, PRIOR) for p in points]
    np.testing.assert_allclose(
        np.diff(short), np.diff([pixel_by_pixel(*p) for p in points]), atol=1e-8
    )


def test_normalisation_and_start_are_the_published_ones():
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07)
    image = normalise(clip)
    assert abs(image.mean()) < 1e-12
    assert image.max() < 1  # the maximum is taken before the mean is taken off
    start = initial(reduce(clip, image), image, PRIOR)
    assert abs(start[0] - 0.6) < 1 / 12.2  # an FFT bin
    assert start[1] == pytest.approx(np.sqrt((image**2).mean()))


@pytest.mark.parametrize(
    ("near", "far", "frequency", "error_f", "error_height"),
    [
        (12.2, 24.4, 0.6, 9.0e-5, 0.82),
        (24.4, 36.6, 0.6, 5e-6, 0.001),
        (36.6, 48.2, 0.6, 2e-6, 0.001),
        (24.4, 36.6, 0.4, 3.6e-5, 0.85),
    ],
)
def test_published_errors_failures_included(near, far, frequency, error_f, error_height):
    # mean squared errors of this reading of the paper, within a factor of five
    errors = []
    for seed in range(8):
        clip = zare_cobb_clip(near, far, frequency, 0.07, seed=seed)
        posterior = estimate(clip, SETTINGS, rng=seed)
        assert posterior.quality is Quality.NOT_CONVERGED
        mean = posterior.mean
        errors.append([float(mean.frequency) - frequency, float(mean.height) - 0.07])
    f, height = (np.array(errors) ** 2).mean(axis=0)
    assert error_f / 5 < f < 5 * error_f
    assert error_height / 5 < height < 5 * error_height
