from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from sasmap.ripples import Prior, RippleSettings, estimate
from sasmap.ripples.fit import Task
from sasmap.ripples.image import as_image
from sasmap.ripples.weak import box_response, contrast, log_gain, sums_at, wave_grid, weak_clip
from sasmap.simulate import straight_clip

F, A = 1.2, 0.006
PRIOR = Prior((F, A), (0.12, 0.003), ((0.3, 5.0), (0.0005, 0.1)))
SETTINGS = RippleSettings(
    frequency=(0.3, 5.0), height=(0.0005, 0.1), presence="assumed", speckle="independent"
)


def weak_ripples(rng, frequency, height):
    """Ripples of a few percent of contrast in 100 x 100 pixels."""
    return straight_clip(
        rng,
        frequency=frequency,
        height=height,
        azimuth=70.0,
        pixel_size=0.06,
        shape=(100, 100),
        near=20.0,
        altitude=8.0,
        noise=0.0,
    )


@pytest.fixture(scope="module")
def task():
    image = as_image(weak_ripples(np.random.default_rng(3), F, A))
    return Task(image, None, SETTINGS, PRIOR, PRIOR.compiled(image.azimuth))


def test_boxes_leave_of_a_wave_what_they_say(task):
    image = task.image
    row, column = image.rows_and_columns
    wave = np.array([[0.07, -0.02]])
    smooth = 1 + 0.1 * np.cos(2 * np.pi * (wave[0, 0] * column + wave[0, 1] * row) - 0.7)
    still = replace(image, power=smooth)
    sums = []
    for high in (50.0, 1.0):  # cycles/m: boxes of a pixel and of two
        other = task._replace(image=still, prior=Prior.flat((0.3, high), (0.0, 0.1)))
        clip = weak_clip(other, F * image.look)
        sums.append(sums_at(wave, clip, image.shape)[0] / box_response(wave, clip.size)[0])
    assert clip.size == 2
    assert abs(sums[1] / sums[0] - 1) < 0.01
    assert abs(np.angle(sums[0]) + 0.7) < 0.02


def test_likelihood_is_that_of_exponential_intensity(task):
    image = task.image
    clip = weak_clip(task._replace(prior=Prior.flat((0.3, 50.0), (0.0, 0.1))), F * image.look)
    wave = image.per_pixel(F * np.array([np.sin(1.2), np.cos(1.2)]))
    total = abs(sums_at(wave[None], clip, image.shape)[0])
    # the intensity that weak_clip divides by its trend, and how contrast grows, from their product
    grows = np.arctan2(image.ground_range, image.altitude) / clip.tilt
    ratio = 1 + clip.boxes / grows
    row, column = image.rows_and_columns
    phase = 2 * np.pi * (wave[0] * column + wave[1] * row)
    for a in (0.02, 0.05):
        values = []
        for turn in 2 * np.pi * np.arange(48) / 48:
            level = 1 + a * grows * np.cos(phase + turn)
            values.append((ratio - ratio / level - np.log(level)).sum())
        exact = logsumexp(values) - np.log(48)
        assert abs(log_gain(np.array(a), np.array(total), clip) - exact) < 0.25


def test_contrast_is_that_of_the_scattering_law():
    for steep, tilt in ((0.02, 1.2), (0.3, 1.4)):
        slope = np.arctan(steep)
        # N(grazing - slope) over N(grazing), its swing about the mean of both extremes
        up, down = (np.exp(-((tilt - s * slope) ** 2 - tilt**2) / (2 * np.pi / 3)) for s in (1, -1))
        np.testing.assert_allclose(contrast(np.array(steep), tilt), up - down, rtol=1e-12)


def test_grid_holds_the_truth(task):
    grid = wave_grid(weak_clip(task, F * task.image.look), task)
    assert abs(grid.weight.sum() - 1) < 1e-9
    f = np.hypot(*task.image.per_metre(grid.waves.T))
    share = grid.weight.sum(axis=1)
    mean = (share * f).sum()
    assert abs(mean - F) < 4 * np.sqrt((share * (f - mean) ** 2).sum() + 1e-4)


def test_intervals_of_clips_without_a_clear_wave_cover():
    inside, wide = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        truth = rng.normal(F, 0.12)
        clip = weak_ripples(rng, truth, 0.003)
        posterior = estimate(clip, SETTINGS, rng=seed, prior=PRIOR)
        low, _, high = posterior.quantiles["frequency"].values
        inside.append(low <= truth <= high)
        wide.append(high - low)
    assert np.mean(inside) > 0.75
    assert np.median(wide) > 0.05  # many waves are possible
