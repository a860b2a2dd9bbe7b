"""The sums through which a clip's pixels enter the likelihood."""

import numpy as np
import pytest

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.demodulation import demodulate
from sasmap.ripples.histogram import BLOCK_SHARE, LEAST_BLOCK, MOST_GROUPS, histogram, range_edges
from sasmap.ripples.image import as_image
from sasmap.ripples.phase import straight
from tests.helpers import clip_of
from tests.ripples.engine import coherent, summed


def flat_clip(rows=60, columns=220, near=10.0, step=0.05, seed=0):
    rng = np.random.default_rng(seed)
    return clip_of(rng.rayleigh(1.0, (rows, columns)), near + step * np.arange(columns), 5.0, step)


def test_pixels_and_intensity_are_conserved():
    clip = flat_clip()
    clip.amplitude[5:9, 40:60] = np.nan
    image, _, _, data, _ = summed(clip, np.array([0.62, 0.0]), trend=1.0)
    assert data.pixel_count.sum() == image.valid.sum()
    expected = (image.power + DYNAMIC_RANGE)[image.valid].sum()
    assert data.intensity_sum.sum() == pytest.approx(expected, rel=1e-12)
    weight = data.pixel_count.sum(axis=1)
    for name, known in (("ground_range", image.ground_range), ("altitude", image.altitude)):
        mean = np.average(getattr(data, name), weights=weight)
        assert mean == pytest.approx(known[image.valid].mean(), rel=1e-12)
    halved = summed(clip, np.array([0.62, 0.0]), trend=2.0)[3]
    np.testing.assert_allclose(halved.intensity_sum, data.intensity_sum / 2, rtol=1e-12)
    np.testing.assert_allclose(halved.trend, 2.0)


def test_each_bin_holds_the_pixels_of_its_phase_and_range():
    clip = flat_clip(rows=7)
    wave = np.array([0.62, 0.0])
    image, _, _, data, _ = summed(clip, wave, origin=0.3, trend=1.0)
    bins = data.pixel_count.shape[1]
    cycles = (0.3 + 0.62 * 0.05 * (np.arange(220) - 109.5)) % 1
    place = np.minimum((cycles * bins).astype(int), bins - 1)
    expected = np.bincount(place, (image.power + DYNAMIC_RANGE).sum(axis=0), bins)
    np.testing.assert_allclose(data.intensity_sum.sum(axis=0), expected, rtol=1e-12)
    total = data.pixel_count.sum(axis=0)
    offset = (data.phase_offset * data.pixel_count).sum(axis=0) / np.maximum(total, 1)
    known = np.bincount(place, cycles - (place + 0.5) / bins, bins) / np.maximum(
        np.bincount(place, minlength=bins), 1
    )
    np.testing.assert_allclose(offset, known, atol=1e-9)
    assert np.abs(data.phase_offset).max() <= 0.5 / bins + 1e-12
    assert np.abs(data.phase_offset).max() > 0.2 / bins


@pytest.mark.parametrize(("near", "far"), [(3.0, 9.0), (8.0, 20.0), (40.0, 55.0)])
def test_range_edges(near, far):
    edges = range_edges(near, far)
    width = np.diff(edges)
    assert edges[0] == near
    assert edges[-1] == pytest.approx(far)
    assert (width > 0.5 * LEAST_BLOCK).all()
    assert (width <= np.maximum(LEAST_BLOCK, BLOCK_SHARE * edges[:-1]) * 1.001).all()


def test_blocks_lie_between_their_edges():
    data = summed(flat_clip(near=4.0), np.array([0.62, 0.0]))[3]
    edges = range_edges(4.0, 4.0 + 0.05 * 219)
    assert len(data.ground_range) == edges.size - 1
    slack = 1.01 * (edges[-1] - edges[0]) / (8 * (edges.size - 1))  # steps of the block table
    assert (data.ground_range > edges[:-1] - slack).all()
    assert (data.ground_range < edges[1:] + slack).all()
    assert (np.diff(data.ground_range) > 0).all()


@pytest.mark.parametrize(("near", "frequency"), [(5.0, 0.4), (5.0, 2.0), (30.0, 0.7), (30.0, 3.0)])
def test_groups_are_a_wavelength_at_least_and_few(near, frequency):
    data = summed(flat_clip(columns=260, near=near), np.array([frequency, 0.0]))[3]
    extent = 0.05 * 259
    least = max(1 / frequency, extent / MOST_GROUPS)
    assert data.group[0] == 0
    assert set(np.diff(data.group)) <= {0, 1}
    groups = data.group.max() + 1
    assert 1 <= groups <= MOST_GROUPS
    assert groups >= extent / least / 2.5  # and no longer than they need be
    starts = [data.ground_range[data.group == g][0] for g in range(groups)]
    assert (np.diff(starts) >= least - 1e-9).all()
    assert data.ground_range[-1] - starts[-1] >= 0.85 * least


def test_saturated_pixels_are_counted_apart():
    clip = flat_clip()
    top = 1.8
    clip.amplitude[:] = np.minimum(clip.amplitude, top)
    image, _, _, data, _ = summed(clip, np.array([0.62, 0.0]), trend=1.0)
    saturated = int((clip.amplitude == top).sum())
    assert saturated > 100
    assert image.saturated.sum() == saturated
    assert data.pixel_count.sum() == image.valid.sum() - saturated
    expected = (image.power + DYNAMIC_RANGE).sum()
    assert data.intensity_sum.sum() == pytest.approx(expected, rel=1e-12)


def test_a_wavelength_of_whole_pixels_does_not_bias():
    """Each bin then holds few columns or one: its pixels' own phase counts, not its middle."""
    worst = {}
    for pixels in (32, 32.7):
        wave = np.array([1 / (pixels * 0.05), 0.0])
        column = np.arange(256)
        reach = 20 + 0.05 * column
        cycles = wave[0] * 0.05 * (column - 127.5) + 0.37
        pulse = np.exp(np.cos(2 * np.pi * cycles))  # what a column shows
        clip = clip_of(np.sqrt(pulse) * np.ones((40, 1)), reach, 5.0, 0.05)
        image = as_image(clip)
        field = straight(image, demodulate(image, wave))
        field = type(field)(**{**vars(field), "origin": 0.37})
        data = histogram(image, np.ones(field.both.shape), field)
        bins = data.pixel_count.shape[1]
        full = data.pixel_count > 0
        seen = data.intensity_sum[full] / data.pixel_count[full] - DYNAMIC_RANGE
        where = ((np.arange(bins) + 0.5) / bins + data.phase_offset)[full]
        fine = np.exp(np.cos(2 * np.pi * (np.arange(bins) + 0.5) / bins))
        told = np.interp(where * bins - 0.5, np.arange(bins), fine, period=bins)
        blind = np.broadcast_to(fine, full.shape)[full]
        told *= seen.mean() / told.mean()
        blind = blind * seen.mean() / blind.mean()
        worst[pixels] = [np.abs(v / seen - 1).max() for v in (told, blind)]
    assert max(w[0] for w in worst.values()) < 0.02
    assert worst[32][1] > 5 * worst[32][0]


def test_fields_of_a_coherent_clip_are_finite_and_empty_blocks_go():
    made = coherent(1, shape=(80, 200))
    made.clip.amplitude[:, 90:120] = np.nan
    data = summed(made.clip, made.wave)[3]
    assert (data.pixel_count.sum(axis=1) > 0).all()
    assert all(np.isfinite(v).all() for v in data)
    assert data.errors.shape[0] == 0
