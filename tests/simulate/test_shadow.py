import numpy as np
import pytest

from sasmap.simulate.profiles import crest
from sasmap.simulate.scattering import (
    shadow_crest_rule,
    shadow_line_of_sight,
)
from sasmap.simulate.shadow import shadow_mask, shadow_table

FREQUENCY = 0.6


@pytest.mark.parametrize("profile", ["sine", "stokes", "peaked"])
@pytest.mark.parametrize(("near", "height"), [(12.0, 0.07), (25.0, 0.07), (60.0, 0.03)])
def test_table_hides_what_a_scan_along_the_ray_hides(profile, near, height):
    reach = near - 4 / FREQUENCY + np.arange(40_000) * 5e-4
    phase = 2 * np.pi * FREQUENCY * reach
    full = 2 * np.pi * FREQUENCY * height
    floor = height * crest(phase, full, profile)
    seen = reach > near
    scanned = shadow_line_of_sight(floor, reach, 4.83)[seen]
    told = shadow_mask(
        phase[seen], reach[seen], 4.83, FREQUENCY, FREQUENCY, height, profile, "line-of-sight"
    )
    assert abs(scanned.mean() - told.mean()) < 1e-3
    # they differ by no more than a few steps at each edge
    edges = np.count_nonzero(np.diff(scanned.astype(int)))
    assert (scanned != told).sum() <= 8 * max(edges, 1)


def test_crest_rule_is_the_published_one():
    reach = 24.4 + np.arange(20_000) * 6e-4
    phase = 2 * np.pi * FREQUENCY * reach
    published = shadow_crest_rule(phase, reach, 4.83, FREQUENCY, 0.07)
    told = shadow_mask(phase, reach, 4.83, FREQUENCY, FREQUENCY, 0.07, "sine", "crest")
    assert (published != told).mean() < 2e-3
    # from 0.72 of the ripples' slope on the rays are too low to reach every trough
    begin = 4.83 / (0.7246 * 2 * np.pi * FREQUENCY * 0.07)
    assert not told[reach < 0.99 * begin].any()
    assert 0.05 < told[reach > begin + 4 / FREQUENCY].mean() < 0.5


@pytest.mark.parametrize("rule", ["line-of-sight", "crest"])
def test_shadow_closes_at_the_limit_and_fills_the_wave_at_grazing_zero(rule):
    begin, end, limit = shadow_table(rule, "sine")[0]
    width = end - begin
    assert width[0] == pytest.approx(2 * np.pi)
    assert width[-1] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(width) < 1e-6).all()
    # shadow sets in where the steepest slope, or the chord from the crest, reaches the ray's
    assert limit[0] == pytest.approx(1.0 if rule == "line-of-sight" else 0.7246, abs=2e-4)
