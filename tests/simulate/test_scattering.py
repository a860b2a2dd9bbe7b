import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from sasmap.simulate.profiles import crest
from sasmap.simulate.scattering import (
    cross_section,
    lit_amplitude,
    profile_slope,
    shadow_crest_rule,
    shadow_line_of_sight,
    steepest,
)

PROFILES = ("sine", "stokes", "peaked")
PHASE = np.linspace(0, 2 * np.pi, 20001)


def test_cross_section_is_a_density_about_normal_incidence():
    assert abs(quad(cross_section, -20, 20)[0] - 1) < 1e-12
    angles = np.linspace(0, np.pi, 9)
    np.testing.assert_allclose(cross_section(angles), cross_section(np.pi - angles))
    assert cross_section(np.pi / 2) == cross_section(angles).max()


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("steepness", [0.0, 0.05, 0.3, 0.6])
def test_slope_is_the_derivative_and_steepest_its_maximum(profile, steepness):
    height = crest(PHASE, steepness, profile)
    slope = profile_slope(PHASE, steepness, profile)
    np.testing.assert_allclose(np.gradient(height, PHASE)[1:-1], slope[1:-1], atol=1e-6)
    assert abs(slope.max() - steepest(steepness, profile)) < 1e-6
    assert abs(slope.min() + steepest(steepness, profile)) < 1e-6
    assert abs(PHASE[height.argmax()] - np.pi / 2) < 1e-3
    assert abs(slope.mean()) < 1e-4


def test_stokes_becomes_a_sine_as_it_flattens():
    for function in (crest, profile_slope):
        np.testing.assert_allclose(
            function(PHASE, 1e-9, "stokes"), function(PHASE, 0, "sine"), atol=1e-8
        )


def test_flat_sea_floor_scatters_its_cross_section():
    grazing = np.linspace(0.05, 1.5, 7)
    np.testing.assert_allclose(lit_amplitude(grazing, 0.7, 1.0, 0.0), cross_section(grazing))


def test_amplitude_spans_the_extreme_slopes():
    grazing, steepness = 0.3, 0.25
    slope_angle = np.arctan(steepness)
    bright, dark = lit_amplitude(grazing, np.array([1.0, -1.0]), 1.0, steepness)
    assert (
        abs(
            bright
            - dark
            - cross_section(grazing + slope_angle)
            + cross_section(grazing - slope_angle)
        )
        < 1e-15
    )
    assert bright > dark  # the facet that faces the sonar


@given(
    height=st.floats(0.01, 0.2),
    wavelength=st.floats(0.5, 4),
    altitude=st.floats(3, 15),
    near=st.floats(5, 40),
)
def test_shadow_scan_equals_every_ray_tried(height, wavelength, altitude, near):
    ground_range = near + np.linspace(0, 3 * wavelength, 120)
    floor = height * np.sin(2 * np.pi * ground_range / wavelength)
    hidden = shadow_line_of_sight(floor, ground_range, altitude)
    rise = (floor - altitude) / ground_range
    expected = [any(rise[:i] > rise[i]) for i in range(rise.size)]
    np.testing.assert_array_equal(hidden, expected)


def test_published_fractions_of_shadow():
    # crest rule / line of sight, A_H = 0.07 m, f = 0.6, A_S = 4.83 m
    for near, by_crest, sight in ((12.2, 0.0, 0.125), (24.4, 0.26, 0.45)):
        r = near - 2 + np.linspace(0, 14.2, 28401)
        phase = 2 * np.pi * 0.6 * r
        seen = r >= near
        hidden = shadow_line_of_sight(0.07 * np.sin(phase), r, 4.83)[seen]
        ruled = shadow_crest_rule(phase, r, 4.83, 0.6, 0.07)[seen]
        assert abs(hidden.mean() - sight) < 0.01
        assert abs(ruled.mean() - by_crest) < 0.01


def test_shadow_starts_where_the_slope_reaches_the_grazing_angle():
    frequency, height, altitude = 0.6, 0.07, 4.83
    start = altitude / (2 * np.pi * frequency * height)
    r = np.linspace(start - 8, start + 8, 200_001)
    phase = 2 * np.pi * frequency * r
    hidden = shadow_line_of_sight(height * np.sin(phase), r, altitude)
    ruled = shadow_crest_rule(phase, r, altitude, frequency, height)
    assert abs(r[hidden][0] - start) < 1 / frequency
    assert not ruled.any() or r[ruled][0] > 1.2 * start


def test_crest_rule_hides_nothing_on_the_crest_or_without_height():
    r = np.full(100, 30.0)
    phase = np.linspace(0, 2 * np.pi, 100)
    assert not shadow_crest_rule(phase, r, 5.0, 0.6, 0.0).any()
    assert not shadow_crest_rule(np.pi / 2, 30.0, 5.0, 0.6, 0.3)
