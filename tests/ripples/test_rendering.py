"""The rendered wavelength against rays, exact places and a simulator that knows nothing of it."""

import numba
import numpy as np
import pytest

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.errors import MODEL_SHIFT
from sasmap.ripples.optimise import COORDINATES
from sasmap.ripples.rendering import (
    BOUND,
    CREST,
    FACETS,
    LINE_OF_SIGHT,
    _gain,
    contrast_per_slope,
    deposit,
    fill_echoes,
    fill_expected,
    fill_facets,
    fill_lags,
    fill_law,
    fill_lit,
    fill_profile,
    fill_published,
    fill_residuals,
    line_of_lags,
    log_posterior,
    pulse_at,
    pulses_of,
)
from sasmap.ripples.rendering import NODES as LAW_NODES
from sasmap.ripples.settings import Exponent, RippleSettings
from sasmap.simulate.laws import PowerLaw
from sasmap.simulate.scattering import lit_amplitude, shadow_crest_rule, shadow_line_of_sight
from tests.ripples.engine import (
    GAUSSIAN,
    LAMBERT,
    as_imaged,
    coherent,
    empty,
    geometry,
    harmonic,
    noiseless,
    ripple,
    summed,
)

LAWS = [LAMBERT, GAUSSIAN, (1.0, 0.5), (3.0, 1.5)]
SHAPES = {"sine": (0.0, 0.0), "peaked": (0.25, 0.0), "asymmetric": (0.05, 0.25)}


def profile(n, peakedness=0.0, asymmetry=0.0, third=(0.0, 0.0)):
    heights, slopes = np.empty(n), np.empty(n)
    fill_profile(peakedness, asymmetry, np.array(third, float), heights, slopes)
    return heights, slopes


def crest_height(place, peakedness, asymmetry, n=20000):
    """Profile over A_H at places (cycles), from its Fourier series alone."""

    def series(x):
        second = peakedness * np.cos(2 * x) + asymmetry * np.sin(2 * x)
        return np.sin(x) - second + BOUND * asymmetry**2 * np.sin(3 * x)

    whole = series(2 * np.pi * (np.arange(n) + 0.5) / n)
    return 2 * series(2 * np.pi * np.asarray(place)) / np.ptp(whole)


def law_intensity(sine, exponent, concentration):
    """Scattered intensity by the sine of the local grazing angle, 0 where turned away."""
    sine = np.asarray(sine)
    lit = np.clip(sine, 1e-9, 1.0)
    value = lit**exponent * np.exp(-concentration * (np.arcsin(lit) - 0.5 * np.pi) ** 2)
    return np.where(sine > 0, value, 0.0)


def ray_traced(truth, along, ground_range, altitude, n=6000, before=3):
    """Place in the image (cycles) and power of a wavelength's facets, facet by facet."""
    u = (np.arange(-before * n, n) + 0.5) / n
    height = truth.height * crest_height(u, truth.peakedness, truth.asymmetry)
    slope = np.gradient(height, u / along)
    # of each point, seen from the ground range, whether one up to a wavelength nearer hides it
    depth, apart = height - altitude, np.arange(n, 0, -1) / n / along
    seen = np.ones(u.size, bool)
    for i in range(u.size - n, u.size):
        seen[i] = not (depth[i - n : i] > depth[i] * (1 - apart / ground_range)).any()
    theta = np.arctan2(altitude - height, ground_range)
    area = np.sqrt(1 + slope**2)
    sine = (np.sin(theta) + slope * np.cos(theta)) / area
    power = law_intensity(sine[-n:], truth.exponent, truth.concentration)
    moved = np.sqrt(ground_range**2 + (altitude - height) ** 2 - altitude**2) - ground_range
    return (u + moved * along)[-n:], (power * area[-n:] * seen[-n:]), seen[-n:].mean()


def test_profile_has_mean_zero_half_range_one_and_its_derivative():
    for shape in [*SHAPES.values(), (-0.1, 0.1), (0.06, -0.3)]:
        heights, slopes = profile(4000, *shape, third=(0.03, -0.02))
        assert abs(heights.mean()) < 1e-12
        assert np.ptp(heights) == pytest.approx(2.0, abs=1e-5)
        step = 2 * np.pi / 4000
        by_difference = (np.roll(heights, -1) - np.roll(heights, 1)) / (2 * step)
        np.testing.assert_allclose(slopes, by_difference, atol=2e-5)


def test_peaked_and_asymmetric_profiles_are_what_they_say():
    x = 2 * np.pi * (np.arange(4000) + 0.5) / 4000
    peaked = 2 * ((1 + np.sin(x)) / 2) ** 2 - 1
    np.testing.assert_allclose(profile(4000, 0.25)[0], peaked - peaked.mean(), atol=1e-5)
    _, slopes = profile(4000, 0.0, 0.25)
    assert slopes.min() < -1.3 * slopes.max() or slopes.max() > -1.3 * slopes.min()
    # a wave whose phase is modulated, to second order in the modulation
    modulated = np.sin(x + 0.3 * np.sin(x))
    np.testing.assert_allclose(profile(4000, 0.0, -0.151)[0], modulated, atol=0.02)
    assert np.abs(profile(4000, 0.0, 0.151)[0] - modulated).max() > 0.2
    x3 = np.exp(-3j * x)
    third = 2 * np.mean(profile(4000, third=(0.0, 0.1))[0] * x3)
    first = 2 * np.mean(profile(4000, third=(0.0, 0.1))[0] * np.exp(-1j * x))
    assert (third / abs(first)).real == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("degrees", [8, 20, 45, 65])
def test_contrast_to_first_order_in_slope(law, degrees):
    tangent, along, far = np.tan(np.radians(degrees)), 0.6, 2000.0
    where = geometry(along, far, far * tangent)
    data = empty(far, far * tangent)
    steepness = 0.002
    (pulse,), (lag,) = pulses_of(ripple(steepness / (2 * np.pi * along), law), data, where)
    theta = np.radians(degrees)
    per_slope = law[0] / np.tan(theta) - 2 * law[1] * (theta - np.pi / 2) + np.tan(theta)
    assert contrast_per_slope(*law, tangent) == pytest.approx(per_slope)
    assert abs(harmonic(pulse, 1)) == pytest.approx(steepness * per_slope, rel=0.01)
    assert abs(lag) < 0.02  # brightest where the floor faces the sonar most
    (flat,), _ = pulses_of(ripple(1e-9, law), data, where)
    np.testing.assert_allclose(flat, 1.0, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("height", "distance", "law"),
    [(0.05, 6.0, LAMBERT), (0.08, 12.0, LAMBERT), (0.08, 12.0, GAUSSIAN), (0.06, 30.0, (1.0, 0.5))],
)
def test_pulse_is_that_of_many_facets_traced_one_by_one(shape, height, distance, law):
    along, altitude, blur = 0.6, 5.0, 0.02
    peakedness, asymmetry = SHAPES[shape]
    truth = ripple(height, law, peakedness=peakedness, asymmetry=asymmetry, blur=blur)
    (pulse,), _ = pulses_of(truth, empty(distance, altitude), geometry(along, distance, altitude))
    place, power, _ = ray_traced(truth, along, distance, altitude)
    for k in (1, 2, 3):
        expected = 2 * (power * np.exp(2j * np.pi * k * place)).sum() / power.sum()
        expected *= np.exp(-2 * (np.pi * k * blur) ** 2)
        seen = harmonic(pulse, k) * np.sinc(k / pulse.size) ** 2  # as bins are interpolated
        assert abs(seen - expected) < 0.008


@pytest.mark.parametrize("place", [-1e-18, -0.25, 3.5, 7.0, 7.75, 16.0, 23.999, 1e6 + 0.5, -900.1])
def test_pulse_repeats_at_any_place(place):
    pulse = np.array([3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0])
    closed = np.append(pulse, pulse[:2])
    expected = np.interp(place, np.arange(8), pulse, period=8)
    assert pulse_at(closed, place / 8) == pytest.approx(expected, rel=1e-9)


def test_pulses_have_a_mean_of_one_and_blur_takes_harmonics():
    where, data = geometry(0.6, 20.0, 5.0), empty([18.0, 20.0, 22.0], 5.0)
    narrow, wide = 0.03, 0.06
    before, _ = pulses_of(ripple(0.07, blur=narrow), data, where)
    after, _ = pulses_of(ripple(0.07, blur=wide), data, where)
    for pulses in (before, after):
        np.testing.assert_allclose(pulses.mean(axis=1), 1.0, rtol=1e-9)
    for k in (1, 2, 3, 4):
        ratio = harmonic(after[1], k) / harmonic(before[1], k)
        expected = np.exp(-2 * (np.pi * k) ** 2 * (wide**2 - narrow**2))
        assert abs(ratio) == pytest.approx(expected, rel=0.01)
        assert abs(np.angle(ratio)) < 1e-9


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("degrees", [3, 6, 10, 14])
def test_shadow_is_that_of_a_ray_scan(shape, degrees):
    along, distance, height, n = 0.6, 30.0, 0.07, 192
    altitude = distance * np.tan(np.radians(degrees))
    peakedness, asymmetry = SHAPES[shape]
    heights, _ = profile(n, peakedness, asymmetry)
    lit = np.empty(n)
    fill_lit(height * heights - altitude, 1 / (along * n * distance), np.argmax(heights), lit)
    truth = ripple(height, peakedness=peakedness, asymmetry=asymmetry)
    _, _, fraction = ray_traced(truth, along, distance, altitude, n=192 * 50)
    assert abs(lit.mean() - fraction) < 0.5 / n
    assert ((lit >= 0) & (lit <= 1 + 1e-12)).all()
    # and by the sea floor's own ranges, several wavelengths
    step = 1 / (along * 2000)
    reach = distance + step * np.arange(-8000, 8000)
    floor = height * crest_height(along * reach, peakedness, asymmetry)
    middle = np.abs(reach - distance) < 0.5 / along
    hidden = shadow_line_of_sight(floor, reach, altitude)[middle].mean()
    assert abs((1 - lit.mean()) - hidden) < 0.02


@pytest.mark.parametrize("shape", SHAPES)
def test_pulse_is_continuous_in_height(shape):
    """Where shadow begins, and where its edges pass from facet to facet."""
    peakedness, asymmetry = SHAPES[shape]
    where, data = geometry(0.6, 20.0, 5.0), empty(20.0, 5.0)

    truth = ripple(0.05, peakedness=peakedness, asymmetry=asymmetry, blur=0.02)
    heights = np.linspace(0.045, 0.075, 4001)
    pulses = [pulses_of(truth._replace(height=h), data, where)[0] for h in heights]
    # which facet is the horizon is told by its neighbour: from farther it may differ by this much
    assert np.abs(np.diff(pulses, axis=0)).max() < 3e-3


@pytest.mark.parametrize(("altitude", "distance"), [(5.0, 6.0), (5.0, 20.0), (8.0, 10.0)])
@pytest.mark.parametrize("height", [-0.08, 0.03, 0.1])
def test_echoes_are_placed_by_slant_range(altitude, distance, height):
    along, bins = 0.6, 64
    n = FACETS * bins
    facets, pulse, law = np.zeros((5, n)), np.zeros(bins), np.ones((2, LAW_NODES))
    law[1] = 0.0
    facets[0], facets[2] = height, 1e-12
    facets[2, 100] = 1.0  # all power in one facet
    power, at = np.empty((2, n))
    fill_echoes(along, altitude / distance, distance, 0, 0, facets, law, power, at)
    deposit(pulse, at, power, np.empty(n))
    place = np.angle(harmonic(pulse, 1)) / (2 * np.pi)
    # what is shown at a range lies at r with r'^2 = r^2 + (A - h)^2 - A^2
    lies = np.sqrt(distance**2 - (altitude - height) ** 2 + altitude**2)
    expected = 100.5 / n - (lies - distance) * along
    assert abs((place - expected + 0.5) % 1 - 0.5) < 2e-4
    assert (lies > distance) == (height > 0)  # crests lean towards the sonar
    # and nearly so for the facet's own range
    shown = np.sqrt(distance**2 + (altitude - height) ** 2 - altitude**2)
    expected = 100.5 / n + (shown - distance) * along
    assert abs((place - expected + 0.5) % 1 - 0.5) < 1e-3


@pytest.mark.parametrize("distance", [8.0, 20.0, 35.0])
@pytest.mark.parametrize("rule", [CREST, LINE_OF_SIGHT, 0])
def test_published_model_is_the_literal_one(rule, distance):
    n, wave, height, altitude = 384, 0.6, 0.07, 4.83
    facets, pulse = np.zeros((5, n)), np.zeros(n)
    truth = ripple(height, GAUSSIAN)
    power, at = np.empty((2, n))
    fill_published(truth, wave, altitude / distance, distance, rule, facets, power, at)
    deposit(pulse, at, power, np.empty(n))
    phase = 2 * np.pi * (np.arange(n) + 0.5) / n
    grazing, steepness = np.arctan2(altitude, distance), 2 * np.pi * wave * height
    literal = lit_amplitude(grazing, np.cos(phase), 1.0, steepness) ** 2
    hidden = np.zeros(n, bool)
    if rule == CREST:
        hidden = shadow_crest_rule(phase, distance, altitude, wave, height)
    elif rule == LINE_OF_SIGHT:
        u = (np.arange(-n, 1) + 0.5) / (n * wave)
        for i in range(n):  # each point seen from the same range
            turn = (i - n) / (n * wave)
            floor = height * np.sin(2 * np.pi * wave * (u + turn))
            reach = distance + u - u[-1]
            hidden[i] = shadow_line_of_sight(floor, reach, altitude)[-1]
    expected = np.where(hidden, 0.0, literal) * 2 * np.pi * (np.pi / 3)  # the Gaussian's factor
    edge = hidden != np.roll(hidden, 1)
    beside = edge | np.roll(edge, 1) | np.roll(edge, -1)
    beside[n // 4] |= rule == CREST  # the crest itself begins the rule's rays
    np.testing.assert_allclose(pulse[~beside], expected[~beside], rtol=2e-3, atol=1e-9)
    assert beside.mean() < 0.05
    # the crest rule starts shadow 1.38 times farther out
    assert hidden.any() == (rule != 0 and distance > (12 if rule == LINE_OF_SIGHT else 21))


@pytest.mark.parametrize("peakedness", [0.0, 0.1])
@pytest.mark.parametrize("distance", [15.0, 17.0, 30.0])
def test_crest_rule_holds_under_any_law(peakedness, distance):
    where, data = geometry(0.6, distance, 5.0), empty(distance, 5.0)
    truth = ripple(0.07, GAUSSIAN, peakedness=peakedness)
    lit, by_sight, by_rule = (
        pulses_of(truth, data, where._replace(shadow=rule))[0][0]
        for rule in (0, LINE_OF_SIGHT, CREST)
    )
    # of a sine, the rule's shadow begins where the trough is hidden, the other's 1.38 times nearer
    hidden = shadow_crest_rule(2 * np.pi * (np.arange(64) + 0.5) / 64, distance, 5.0, 0.6, 0.07)
    if not peakedness:
        assert hidden.any() == (distance == 30.0)
        assert np.allclose(by_rule, lit) == (not hidden.any())
    if distance == 30.0:
        dark = (by_rule < 1e-6).mean()
        assert dark == pytest.approx(hidden.mean(), abs=0.1)
        assert dark > 0.2
        assert (by_sight < 1e-6).mean() > dark


def test_a_bin_too_bright_costs_as_much_as_one_too_dark_where_the_model_errs():
    data = empty(20.0, 5.0, bins=4, count=50.0)
    means = np.ones(data.pixel_count.shape)
    for share, even in ((1.0, False), (0.0, True), (0.1, True)):
        costs = []
        for factor in (10.0, 0.1):
            other = data._replace(
                intensity_sum=factor * data.pixel_count,
                speckle_share=np.full(means.shape, share),
            )
            residuals, pulls = np.empty(means.shape), np.empty(means.shape)
            level = fill_residuals(means, other, residuals, pulls)
            costs.append(-level)
            moved = [np.exp(step) * means for step in (1e-5, -1e-5)]
            up, down = (fill_residuals(m, other, residuals, pulls) for m in moved)
            assert pulls.sum() == pytest.approx((up - down) / 2e-5, rel=1e-3)
            if share == 1.0:  # that of exponential intensity, relative to the best mean
                expected = 200.0 * (factor - 1 - np.log(factor))
                assert -level == pytest.approx(expected)
        assert (costs[0] / costs[1] < 1.3) == even


def test_waves_of_two_heights_have_their_mean_height():
    """Where shadow of one wave lies on lit floor of another, the fit must not favour the lower."""
    where, data = geometry(0.6, 20.0, 4.0), empty(np.linspace(19.0, 21.0, 8), 4.0)
    truth = ripple(0.07, blur=0.02, noise=0.05)
    unlike = (truth._replace(height=0.07 * np.exp(d)) for d in (-0.2, 0.2))
    waves = [pulses_of(wave, data, where)[0] for wave in unlike]
    pulses = np.where((np.arange(8) % 2 == 0)[:, None], *waves) + truth.noise
    data = data._replace(intensity_sum=pulses * data.pixel_count, group=np.arange(8))
    best = []
    for share in (0.03, 1.0):
        shared = data._replace(speckle_share=np.full(pulses.shape, share))
        levels = []
        for change in np.linspace(-0.25, 0.25, 101):
            means, gains = np.empty(pulses.shape), np.empty(8)
            changed = truth._replace(height=0.07 * np.exp(change))
            fill_expected(changed, shared, where, means, gains)
            levels.append(fill_residuals(means, shared, means.copy(), means.copy()))
        best.append(np.linspace(-0.25, 0.25, 101)[np.argmax(levels)])
    assert abs(best[0]) < 0.03
    assert best[1] < -0.1


def test_law_departs_from_its_family_by_its_error_alone():
    error = np.array([0.0, 0.0, 0.2, 0.2, 0.0, 0.0])
    tables = np.empty((2, 2, LAW_NODES))
    fill_law(1.0, 0.3, np.zeros(6), tables[0])
    fill_law(1.0, 0.3, error, tables[1])
    plain, off = tables[:, 0]
    np.testing.assert_array_equal(tables[:, 1, :-1], np.diff(tables[:, 0]))
    sine = np.arange(LAW_NODES) / (LAW_NODES - 1)
    between = (sine > np.sin(np.radians(19))) & (sine < np.sin(np.radians(32)))
    np.testing.assert_allclose(off[between] / plain[between], np.exp(0.2))
    outside = sine > np.sin(np.radians(51))
    np.testing.assert_allclose(off[outside], plain[outside])
    np.testing.assert_allclose(plain[100], law_intensity(sine[100], 1.0, 0.3))


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="the source raises for such numbers")
@pytest.mark.parametrize("height", [np.inf, np.nan])
def test_a_height_that_is_none_reads_nothing_beyond_an_array(height):
    where, data = geometry(0.6, 20.0, 5.0), empty([18.0, 20.0, 22.0], 5.0)
    means, gains = np.empty(data.pixel_count.shape), np.empty(3)
    fill_expected(ripple(height), data, where, means, gains)
    fill_expected(ripple(0.05)._replace(phase=height), data, where, means, gains)


def test_slope_across_the_look_widens_facets():
    facets = np.empty((5, 96))
    profile = np.empty((2, 96))
    fill_profile(0.0, 0.0, np.zeros(2), *profile)
    fill_facets(0.08, 0.5, 0.4, profile, facets)
    x = 2 * np.pi * (np.arange(96) + 0.5) / 96
    along, beside = (2 * np.pi * 0.08 * w * np.cos(x) for w in (0.5, 0.4))
    np.testing.assert_allclose(facets[1], along, atol=1e-3)
    np.testing.assert_allclose(facets[2], np.sqrt(1 + along**2 + beside**2), rtol=1e-3)


@pytest.mark.parametrize("near", [6.0, 24.0])
@pytest.mark.parametrize("law", ["lambert", PowerLaw(exponent=1.0)])
def test_coherent_facets_show_this_pulse(law, near):
    """Mean intensity by phase and range of an image that other code made of complex echoes."""
    phase = 1.1
    made = coherent(3, law, near=near, shape=(150, 200), phase=phase, noise=None)
    fixed = "lambert" if law == "lambert" else Exponent(exponent=law.exponent)
    _, _, field, data, where = summed(
        made.clip, made.wave, RippleSettings(scattering=fixed), phase / (2 * np.pi), trend=1.0
    )
    assert field.rigid
    exponent = 2.0 if law == "lambert" else law.exponent
    truth = ripple(
        0.08, (exponent, 0.0), noise_slope=0.0, blur=0.5 * 0.05 * 0.62, noise=DYNAMIC_RANGE
    )
    # flat floor's own trend, and one gain
    level = np.sin(np.arctan2(data.altitude, data.ground_range)) ** exponent
    level /= level.mean()
    data = data._replace(
        group=0 * data.group, trend=level, intensity_sum=data.intensity_sum / level[:, None]
    )
    means, gains = np.empty(data.pixel_count.shape), np.empty(len(data.place))
    parts = means.shape[1] // 16 * np.arange(16)

    def misfits(height):
        imaged = as_imaged(truth._replace(height=height), data, where)
        fill_expected(imaged, data, where, means, gains)
        off, square = data.intensity_sum - means * data.pixel_count, means**2 * data.pixel_count
        slope = 0.5 * (np.roll(means, -1, axis=1) - np.roll(means, 1, axis=1)) * means.shape[1]
        moved = MODEL_SHIFT * 0.05 * 0.62 * np.abs(slope) * data.pixel_count
        off, square, moved = (np.add.reduceat(v.sum(axis=0), parts) for v in (off, square, moved))
        # neighbours share echoes: 1.6 times the variance of independent pixels; and the model's own
        # error, a displacement by a part of a pixel
        return off / np.sqrt(1.6 * square + moved**2)

    z = misfits(0.08)
    assert np.abs(z).max() < 4.5
    assert (z**2).mean() < 5.0
    for wrong in (0.07, 0.092):
        assert (misfits(wrong) ** 2).sum() > 3 * (z**2).sum() + 40


def test_a_pulse_depends_on_height_times_wave_number():
    reach = [9.0, 14.0, 22.0]
    data = empty(reach, 4.0)
    first, _ = pulses_of(ripple(0.12, blur=0.02), data, geometry(0.6, 15.0, 4.0))
    second, _ = pulses_of(ripple(0.12 / 1.03, blur=0.02), data, geometry(0.6 * 1.03, 15.0, 4.0))
    lower, _ = pulses_of(ripple(0.12 / 1.03, blur=0.02), data, geometry(0.6, 15.0, 4.0))
    assert np.abs(second - first).mean() < 0.1 * np.abs(lower - first).mean()


def test_phase_and_wave_number_are_those_of_the_image():
    reach = np.linspace(4.0, 16.0, 25)
    data, where = empty(reach, 4.0), geometry(0.6, 12.0, 4.0)
    truth = ripple(0.15, blur=0.02)
    own = pulses_of(truth, data, where)[1]
    assert abs(line_of_lags(own, data)[0]) * np.ptp(reach) > 0.1
    left = []
    for bent in (False, True):
        means, lags = np.empty(data.pixel_count.shape), np.empty(reach.size)
        fill_expected(truth, data, where._replace(bent=bent), means, np.empty(reach.size))
        fill_lags(means, lags)
        left.append(np.abs(lags).max())
        assert np.abs(line_of_lags(lags, data)).max() < 0.02
    # a phase field follows every range, straight crests leave what is not on the line
    assert left[1] < 0.02 < left[0]


def test_gain_is_the_most_likely_one_and_scale_tells_nothing():
    truth, where = ripple(0.06, noise=0.01), geometry(0.6, 15.0, 5.0)
    rng = np.random.default_rng(1)
    data = noiseless(truth, empty([14.0, 15.0, 16.0, 17.0], 5.0, group=[0, 0, 1, 1]), where)
    data = data._replace(intensity_sum=data.intensity_sum * rng.gamma(400, 1 / 400, (4, 64)))
    pulses, _ = pulses_of(truth, data, where)
    floors = np.full(4, 0.02)
    log_gain, information = _gain(0, 2, data, pulses, floors)

    def level(log_g):
        means = np.exp(log_g) * pulses[:2] + floors[:2, None]
        sums, counts = data.intensity_sum[:2], data.pixel_count[:2]
        return -(counts * np.log(means) + sums / means).sum()

    near = 1e-3
    assert level(log_gain) > max(level(log_gain - near), level(log_gain + near))
    slope = level(log_gain + near) - level(log_gain - near)
    assert abs(slope / (2 * near)) < 0.01 * information * near
    bend = (2 * level(log_gain) - level(log_gain + near) - level(log_gain - near)) / near**2
    assert bend == pytest.approx(information, rel=0.05)
    # whatever the units: noise is told against the image
    z = np.zeros(COORDINATES)
    z[2] = -1.3
    other = z + 0.1
    quiet = [z.copy(), other.copy()]
    for point in quiet:
        point[7] = -12.0
    levels = {
        scale: [
            log_posterior(p, data._replace(intensity_sum=scale * data.intensity_sum), where)
            for p in quiet
        ]
        for scale in (1.0, 3.0, 0.4)
    }
    for scale in (3.0, 0.4):
        assert np.diff(levels[scale]) == pytest.approx(np.diff(levels[1.0]), abs=1e-3)


def test_likelihood_is_of_the_pixels_not_of_their_order_or_the_maps_origin():
    made = coherent(5, near=15.0, shape=(120, 200))
    clip = made.clip
    z = np.zeros(COORDINATES)
    z[2] = -0.5
    rows = np.random.default_rng(2).permutation(len(clip.amplitude))
    shuffled = type(clip)(**{**vars(clip), "amplitude": clip.amplitude[rows]})
    moved = type(clip)(**{**vars(clip), "x": clip.x + 5e5, "y": clip.y + 3.3e6})
    levels = []
    for each in (clip, shuffled, moved):
        _, _, _, data, where = summed(each, made.wave, origin=0.2, trend=1.0)
        levels.append(log_posterior(z, data, where))
    assert levels[1] == pytest.approx(levels[0], rel=1e-10)
    assert levels[2] == pytest.approx(levels[0], rel=1e-7)


def test_heights_that_change_over_range_are_rendered_at_each_block():
    reach = np.linspace(14.0, 22.0, 9)
    data, where = empty(reach, 3.0), geometry(0.5, 18.0, 3.0)
    trend = np.array([0.1, -0.05, 0.02])
    names = ("trend_1", "trend_2", "trend_3")
    pulses, lags = pulses_of(ripple(0.2, **dict(zip(names, trend, strict=True))), data, where)
    across = (reach - reach[0]) / np.ptp(reach)
    change = sum(a * np.cos(np.pi * k * across) for k, a in enumerate(trend, 1))
    for k, scale in enumerate(np.exp(change)):
        alone, lag = pulses_of(ripple(0.2 * scale), data, where)
        np.testing.assert_allclose(pulses[k], alone[k], atol=1e-12)
        assert lags[k] == pytest.approx(lag[k])
