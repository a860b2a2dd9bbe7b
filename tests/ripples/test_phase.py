import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sasmap.ripples import RippleSettings, estimate
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.ripples.scattering import lit_amplitude
from sasmap.simulate import straight_clip

KEEP = RippleSettings(keep_model=True)


def wandering(seed, wander=2.0, part=1.0, size=320, scale=70.0):
    """A clip whose phase wanders smoothly by `wander` rad (rms), rippled in the first part of it.

    Return it with its mean frequency, by least squares over the simulated phase, and what it would
    be without speckle.
    """
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.normal(size=(2 * size, 2 * size)), scale)[:size, :size]
    field = wander * (field - field.mean()) / max(field.std(), 1e-12)
    pixel, frequency, height = 0.05, 0.8, 0.05
    flat = straight_clip(
        rng,
        frequency=frequency,
        height=0.0,
        pixel_size=pixel,
        shape=(size, size),
        near=8.0,
        altitude=8.0,
    )
    phase = 2 * np.pi * frequency * flat.x + field
    steep = 2 * np.pi * frequency * height
    grazing = np.arctan2(flat.altitude, flat.ground_range)
    steep = 2 * np.pi * frequency * height
    level = lit_amplitude(grazing, np.zeros(phase.shape), 1.0, steep)
    lit = lit_amplitude(grazing, np.cos(phase), 1.0, steep) / level
    rows = np.arange(size)[:, None] < part * size
    a = np.where(rows, lit, 1.0)
    y, x = np.indices((size, size)) * pixel
    design = np.stack([x.ravel(), -y.ravel(), np.ones(x.size)], axis=1)
    plane = np.linalg.lstsq(design, phase.ravel(), rcond=None)[0] / (2 * np.pi)
    clip = type(flat)(**{**vars(flat), "amplitude": flat.amplitude * a})
    return clip, float(np.hypot(*plane[:2])), level * a


@pytest.mark.parametrize("seed", range(4))
def test_bent_crests_keep_their_mean_frequency(seed):
    clip, frequency, truth = wandering(seed)
    posterior = estimate(clip, KEEP, rng=1)
    assert posterior.sampled
    assert LeftOut.PHASE_FIELD not in posterior.left_out
    assert abs(float(posterior.mean.frequency) / frequency - 1) < 0.02
    assert posterior.shape.coherence_length < 16.0
    model = posterior.model
    seen = np.isfinite(model)
    assert seen.mean() > 0.6
    assert np.corrcoef(model[seen], truth[seen])[0, 1] > 0.85


def test_straight_crests_need_no_field():
    clip, _, _ = wandering(1, wander=0.0)
    posterior = estimate(clip, rng=1)
    assert LeftOut.PHASE_FIELD in posterior.left_out
    assert abs(float(posterior.mean.frequency) - 0.8) < 2e-3
    assert posterior.shape.rippled_fraction > 0.95
    assert posterior.quality is Quality.GOOD


def test_ripples_in_half_a_cell_are_found_and_only_there():
    clip, _, _ = wandering(2, wander=0.0, part=0.5)
    posterior = estimate(clip, KEEP, rng=1)
    assert abs(float(posterior.mean.frequency) - 0.8) < 5e-3
    assert 0.3 < posterior.shape.rippled_fraction < 0.75
    rows = np.isfinite(posterior.model).mean(axis=1)
    assert rows[:120].mean() > 0.9
    assert rows[220:].mean() < 0.2


def test_holes_are_modelled_too():
    clip, _, _ = wandering(3)
    clip.amplitude[100:130, 80:200] = np.nan
    model = estimate(clip, KEEP, rng=1).model
    hole = (slice(105, 125), slice(90, 190))
    assert np.isfinite(model[hole]).mean() > 0.8
