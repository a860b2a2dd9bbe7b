"""Stability: every special function, likelihood, sampler and fit over its extreme arguments.

    python pipelines/studies/stability.py [--quick] [--output docs/studies]

One line each: function, range of arguments, worst error and where. Writes
stability.md. Parts of the engine are called as its tests call them (tests/ripples/engine.py).
`pipelines/ripples/extremes.py` and `pipelines/sediments/laws.py` hold the longer lists.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mpmath
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import gammaincinv, ndtr

from sasmap.numerics.gaussians import Mixture, log_densities
from sasmap.passes.fusion import fuse, fuse_cells, learn_survey
from sasmap.passes.summary import summarise
from sasmap.ripples import Clip, Prior, RippleSettings, estimate
from sasmap.ripples.diagnostics import ess_bulk, rhat
from sasmap.ripples.rendering import pulses_of
from sasmap.sediments import fit, generalized_k, k_distribution
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.nodes import refine_boundary
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.trends import AmplitudeGrid
from sasmap.simulate import coherent_cell
from sasmap.simulate.scattering import lit_amplitude, shadow_crest_rule, shadow_line_of_sight
from sasmap.survey.navigation import Track

sys.path.append(str(Path(__file__).resolve().parents[2]))
from tests.ripples.engine import empty, geometry, ripple

# Altitude (m) and frequency (cycles/m) of rendered wavelengths, and bins a wavelength.
ALTITUDE, WAVE, BINS = 50.0, 1.0, 64
# Exponent and concentration within the bounds of the law's prior.
CORNERS = ((4.9, -0.9), (4.9, 4.9), (2.0, 0.0), (0.0, 0.95))
# Those that brighten without end towards grazing.
ENDLESS = ((-0.9, -0.9), (-0.9, 4.9))
GRAZING = (1.0, 3.0, 10.0, 30.0, 60.0)  # degrees


class Line(NamedTuple):
    """One line of the table."""

    what: str
    over: str
    worst: float
    where: str
    limit: float


def worst_of(what: str, over: str, limit: float, cases: Iterator[tuple[str, float]]) -> Line:
    """Keep the worst case."""
    where, worst = max(cases, key=lambda c: np.inf if np.isnan(c[1]) else c[1])
    return Line(what, over, float(worst), where, limit)


def exact_density(x: float, nu: float, kappa: float) -> float:
    """Log density of the generalised K law at 40 digits (G 5, corrected).

    The Bessel function K by quadrature: mpmath's own is wrong at large orders.
    """
    mpmath.mp.dps = 40
    x, nu, kappa = mpmath.mpf(x), mpmath.mpf(nu), mpmath.mpf(kappa)
    b = 2 * mpmath.sqrt(nu + kappa**2)
    order, y = abs(nu - 1), b * x
    top = mpmath.asinh(order / y)
    height = order * top - y * mpmath.cosh(top)

    def integrand(t: mpmath.mpf) -> mpmath.mpf:
        level = mpmath.exp(order * t - y * mpmath.cosh(t) - height)
        return level * (1 + mpmath.exp(-2 * order * t)) / 2

    wide = 1 / mpmath.sqrt(y * mpmath.cosh(top))
    ends = sorted({0, *(max(top + k * wide, 0) for k in (-40, -12, -3, 0, 3, 12, 40))})
    bessel = height + mpmath.log(mpmath.quad(integrand, ends))
    value = mpmath.log(2 * b) - mpmath.loggamma(nu) + nu * mpmath.log(2 * nu * x / b)
    return float(value + mpmath.log(mpmath.besseli(0, 2 * kappa * x)) + bessel)


def densities(count: int) -> Iterator[tuple[str, float]]:
    """Relative errors (of at least 1) of log densities."""
    rng = np.random.default_rng(1)
    for _ in range(count):
        nu, kappa = 10 ** rng.uniform(-3, 4), 10 ** rng.uniform(-3, 1.5)
        x = float(np.sqrt(1 + kappa**2) * 10 ** rng.uniform(-9, 0.5))
        exact = exact_density(x, nu, kappa)
        got = float(generalized_k.logpdf(x, nu, kappa))
        yield f"nu {nu:.3g}, kappa {kappa:.3g}, x {x:.3g}", abs(got - exact) / max(abs(exact), 1)


def round_trips(count: int) -> Iterator[tuple[str, float]]:
    """Relative errors of probabilities after ppf and cdf, in the smaller tail."""
    rng = np.random.default_rng(2)
    for _ in range(count):
        nu, kappa, p = (
            10 ** rng.uniform(-1, 4),
            10 ** rng.uniform(-2, 1),
            10 ** rng.uniform(-12, -0.4),
        )
        back = float(generalized_k.cdf(generalized_k.ppf(p, nu, kappa), nu, kappa))
        yield f"nu {nu:.3g}, kappa {kappa:.3g}, p {p:.3g}", abs(back / p - 1)
        back = float(generalized_k.sf(generalized_k.isf(p, nu, kappa), nu, kappa))
        yield f"nu {nu:.3g}, kappa {kappa:.3g}, upper p {p:.3g}", abs(back / p - 1)


def limits(count: int) -> Iterator[tuple[str, float]]:
    """Differences from the laws that K becomes."""
    x = np.geomspace(1e-6, 6, 200)
    rayleigh = np.log(2 * x) - x**2
    yield "nu 1e10", float(np.abs(k_distribution.logpdf(x, 1e10) - rayleigh).max())
    for kappa in (1e-8, 1e-5):
        apart = generalized_k.logpdf(x, 2.0, kappa) - k_distribution.logpdf(x, 2.0)
        yield f"kappa {kappa:g}", float(np.abs(apart).max())


def scaled_fits(count: int) -> Iterator[tuple[str, float]]:
    """Change of nu when samples are scaled."""
    sample = generalized_k.rvs(2.0, 1.0, size=4096, random_state=1)
    nu = fit(sample).nu
    for power in (-140, -30, -5, 5, 30, 140):
        yield f"scale 1e{power}", abs(fit(sample * 10.0**power).nu / nu - 1)


def conditions(count: int) -> Iterator[tuple[str, float]]:
    """Errors of a density whose covariance is badly conditioned, by eigenvectors in mpmath."""
    rng = np.random.default_rng(3)
    for power in (2, 4, 6, 8, 10, 12):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        spread = np.array([1.0, 10 ** (-power / 4), 10 ** (-power / 2)])
        covariance = (turn * spread**2) @ turn.T
        covariance = 0.5 * (covariance + covariance.T)
        offset = turn @ (spread * rng.normal(size=3))
        mixture = Mixture(np.ones(1), np.zeros((1, 3)), covariance[None])
        got = float(log_densities(offset[None], mixture)[0, 0])
        mpmath.mp.dps = 40
        exact = mpmath.matrix(covariance.tolist())
        z = mpmath.matrix(offset.tolist())
        value = -(z.T * exact**-1 * z)[0] / 2 - mpmath.log(mpmath.det(exact)) / 2
        value -= mpmath.mpf(3) / 2 * mpmath.log(2 * mpmath.pi)
        yield f"condition 1e{power}", abs(got - float(value)) / max(abs(float(value)), 1)


def products(count: int) -> Iterator[tuple[str, float]]:
    """How far two looks of very different widths, combined, lie from the narrow one, in its sds."""
    summary = summarise(estimate(_clip(), RippleSettings(), rng=1))
    alone = RippleSettings(scatter=(0.0, 0.0, 0.0))
    rows = np.array(summary.mixture)
    for power in (0, 2, 4, 6) if count > 100 else (0, 2):
        # the same mean, covariances of log f, log contrast and azimuth drawn together
        scale = np.ones((5, 5))
        scale[:3, :3] = 10.0 ** (-2 * power)
        scale[:3, 3:] = scale[3:, :3] = 10.0**-power
        sharp = rows.copy()
        mean = np.average(rows[:, 1:4], axis=0, weights=rows[:, 0])
        sharp[:, 1:4] = mean + 10.0**-power * (rows[:, 1:4] - mean)
        sharp[:, 6:] *= scale.ravel()
        narrow = replace(summary, mixture=tuple(tuple(row) for row in sharp))
        try:
            final = fuse((summary, narrow), alone).final.mean[0]
        except np.linalg.LinAlgError:
            final = np.inf
        sd = summary.sd[0] * 10.0**-power
        yield f"widths apart 1e{power}", abs(final - np.exp(mean[0])) / sd


def _clip() -> Clip:
    """Straight ripples with some shadow: an estimate that converges at once."""
    return coherent_cell(
        np.random.default_rng(1), frequency=0.62, height=0.08, near=12.0, shape=(260, 260)
    ).clip


def separations(count: int) -> Iterator[tuple[str, float]]:
    """How far a posterior lies from its prior, prior sds, where the prior is so much sharper."""
    clip = _clip()
    settings = RippleSettings()
    bounds = settings.frequency, settings.height
    free = estimate(clip, settings, rng=1)
    sd = float(free.sd.frequency)
    for power in (0, 2, 4, 6) if count > 100 else (0, 6):
        mean = (float(free.mean.frequency), float(free.mean.height))
        prior = Prior(mean, (sd * 10.0**-power, 1.0), bounds)
        got = estimate(clip, settings, rng=1, prior=prior)
        expected = 1 / np.sqrt(1 + 10.0 ** (-2 * power))
        ratio = float(got.sd.frequency) / (sd * 10.0**-power) / expected
        yield f"prior sharper by 1e{power}", abs(ratio - 1)
        prior = Prior(mean, (sd * 10.0**power, 1.0), bounds)
        got = estimate(clip, settings, rng=1, prior=prior)
        expected = sd / np.sqrt(1 + 10.0 ** (-2 * power))
        yield f"prior wider by 1e{power}", abs(float(got.sd.frequency) / expected - 1)


def convergence(count: int) -> Iterator[tuple[str, float]]:
    """Change of R-hat and ESS when draws are shifted by up to 1e10 standard deviations."""
    draws = np.random.default_rng(4).normal(size=(4, 1000))
    for power in (0, 3, 6, 10):
        moved = draws + 10.0**power
        yield f"R-hat, shift 1e{power}", abs(rhat(moved) - rhat(draws))
        yield f"ESS, shift 1e{power}", abs(ess_bulk(moved) / ess_bulk(draws) - 1)


def shadows(count: int) -> Iterator[tuple[str, float]]:
    """Fraction of pixels in which steep floors' shadow is not inside the crest rule's reach."""
    for grazing in (0.01, 0.1, 1.0, 10.0, 80.0):
        reach = 100 / np.tan(np.radians(grazing)) + np.linspace(0, 20, 20001)
        phase = 2 * np.pi * 0.6 * reach
        floor = 0.07 * np.sin(phase)
        sight = shadow_line_of_sight(floor, reach, 100.0)
        crest = shadow_crest_rule(phase, reach, 100.0, 0.6, 0.07)
        # the crest rule's shadow is part of the true one, but for the first wavelength
        first = reach > reach[0] + 2 / 0.6
        yield f"grazing {grazing:g} degrees", float((crest & ~sight)[first].mean())


def amplitudes(count: int) -> Iterator[tuple[str, float]]:
    """Share of amplitudes that are not finite, over grazing and steepness."""
    for grazing in (1e-9, 1e-3, 0.5, np.pi / 2):
        for steepness in (0.0, 1e-12, 1.0, 1e6):
            got = lit_amplitude(grazing, np.linspace(-1, 1, 101), 1.0, steepness)
            bad = ~np.isfinite(got)
            yield f"grazing {grazing:g}, steepness {steepness:g}", float(bad.mean())


def ray_traced(height: float, law: tuple[float, float], reach: float, n: int) -> np.ndarray:
    """Power of one wavelength of a sine by bins of image phase: facet by facet, by rays."""
    before = 2
    u = (np.arange(-before * n, n) + 0.5) / n
    floor = height * np.sin(2 * np.pi * u)
    slope = 2 * np.pi * WAVE * height * np.cos(2 * np.pi * u)
    # the ray to a point of this wavelength is higher over a nearer point by what it rises
    seen = np.empty(n, bool)
    apart = np.arange(n, 0, -1) / n / WAVE
    for i in range(n):
        j = before * n + i
        ray = ALTITUDE - (ALTITUDE - floor[j]) * (1 - apart / reach)
        seen[i] = not (floor[j - n : j] > ray).any()
    u, floor, slope = u[-n:], floor[-n:], slope[-n:]
    theta = np.arctan2(ALTITUDE - floor, reach)
    area = np.sqrt(1 + slope**2)
    sine = np.clip((np.sin(theta) + slope * np.cos(theta)) / area, 1e-12, 1)
    power = sine ** law[0] * np.exp(-law[1] * (np.arcsin(sine) - np.pi / 2) ** 2) * area
    power *= seen & (np.sin(theta) + slope * np.cos(theta) > 0)
    place = u + WAVE * (np.sqrt(reach**2 + (ALTITUDE - floor) ** 2 - ALTITUDE**2) - reach)
    return np.bincount((place % 1 * BINS).astype(int), power, BINS)


def rendered(count: int) -> Iterator[tuple[str, float]]:
    """Compare rendered wavelengths with rays, from the lowest grazing to beyond layover."""
    return _rendered(count, GRAZING, CORNERS)


def rendered_endless(count: int) -> Iterator[tuple[str, float]]:
    """Compare them where a few facets at the edge of shadow hold most of the power."""
    return _rendered(count, GRAZING, ENDLESS)


def rendered_near(count: int) -> Iterator[tuple[str, float]]:
    """Compare them nearly below the sonar, where a wavelength is no small part of the range."""
    return _rendered(count, (80.0,), CORNERS + ENDLESS)


def _rendered(
    count: int, grazing: tuple[float, ...], laws: tuple[tuple[float, float], ...]
) -> Iterator[tuple[str, float]]:
    """Difference of a rendered wavelength's first harmonic, over its mean, from ray tracing's."""
    turn = np.exp(2j * np.pi * (np.arange(BINS) + 0.5) / BINS)
    for degrees in grazing:
        reach = ALTITUDE / np.tan(np.radians(degrees))
        for steepness in (1e-4, 1e-2, 0.1, 0.3, 1.0):
            height = steepness / (2 * np.pi * WAVE)
            for law in laws if count > 100 else laws[-2:]:
                where = geometry(WAVE, reach, ALTITUDE)
                (pulse,), _ = pulses_of(ripple(height, law), empty(reach, ALTITUDE, BINS), where)
                exact = ray_traced(height, law, reach, 8 * count)
                first, second = (2 * np.mean(v * turn) / v.mean() for v in (pulse, exact))
                name = f"grazing {degrees:g} degrees, steepness {steepness:g}, law {law}"
                yield name, float(abs(first - second))


def stage_two(cells: int) -> Iterator[tuple[str, float]]:
    """How far cells, combined under what their survey tells, lie from the truth, their own sds."""
    summaries, truths = [], []
    for seed in range(6):
        made = coherent_cell(
            np.random.default_rng([seed, 77]),
            frequency=0.8 + 0.05 * seed,
            height=0.03 + 0.008 * seed,
            near=12.0 + 2 * seed,
        )
        summaries.append(summarise(estimate(made.clip, RippleSettings(), rng=seed)))
        truths.append((made.frequency, made.height))
    survey = [[summaries[i % len(summaries)]] for i in range(cells)]
    settings = RippleSettings()
    for i, fused in enumerate(fuse_cells(survey, settings, learn_survey(survey, settings))):
        final, truth = fused.final, truths[i % len(truths)]
        off = np.abs(np.array(final.mean) - truth) / np.array(final.sd)
        yield f"{cells} cells, number {i}", float(off.max())


def surveys(count: int) -> Iterator[tuple[str, float]]:
    """Stage 2 with one cell and with many."""
    yield from stage_two(1)
    yield from stage_two(10_000 if count > 100 else 40)


def textures(count: int) -> Iterator[tuple[str, float]]:
    """Share of pixels in a wrong class: one sediment, two, and textures of any length."""
    size = 512 if count > 100 else 256
    for length in (1, 1000):
        for sediments in (1, 2):
            rng = np.random.default_rng(length + sediments)
            field = rng.normal(size=(size, size))
            if length > 1:
                field = gaussian_filter(field, length, mode="wrap", truncate=2)
            gamma = gammaincinv(4.0, ndtr((field - field.mean()) / field.std())) / 4.0
            if length > 1:  # what one scene shows of so long a texture: a slope
                gamma = 1 + 0.05 * (gamma - 1)
            truth = (np.indices(field.shape)[1] > size / 2).astype(int) * (sediments - 1)
            amplitude = np.sqrt(gamma * np.where(truth, 4.0, 1.0)) * rng.rayleigh(1, field.shape)
            looks = [AmplitudeGrid(amplitude, np.full(field.shape, 10.0))]
            classes = find_classes(looks)
            label = class_map(log_likelihoods(looks, classes)).label
            share = np.zeros((label.max() + 1, 2))
            np.add.at(share, (label.ravel(), truth.ravel()), 1 / label.size)
            yield f"{length} pixels, {sediments} sediments", float(1 - share.max(axis=0).sum())


def boundaries(count: int) -> Iterator[tuple[str, float]]:
    """Distance of a straight boundary from the truth, pixels, over contrasts."""
    for power in (-2, 0, 3, 6, 9):
        ratio = np.where(np.arange(200) < 100, 1.0, -1.0) * 10.0**power * np.ones((200, 1))
        guess = np.column_stack([np.arange(200)[::-1], np.full(200, 103.0)])
        points = refine_boundary(guess, ratio).points
        yield f"contrast 1e{power} nats a pixel", float(np.abs(points[:, 1] - 99.5).max())


def tracks(count: int) -> Iterator[tuple[str, float]]:
    """Errors of distances from tracks, m, far from the origin and over many pings."""
    for pings, offset in ((2, 0.0), (1000, 5e5), (100_000, 9e6)):
        y = offset + np.linspace(0, 0.5 * pings, pings)
        track = Track(np.full(pings, offset), y, np.full(pings, 5.0))
        reach = np.geomspace(1e-3, 500, 200)
        found = track.locate(offset + reach, np.full(200, y.mean()))
        yield f"{pings} pings at {offset:g} m", float(np.abs(found.distance - reach).max())


STUDIES: dict[str, tuple[Callable[[int], Iterator[tuple[str, float]]], str, float]] = {
    "log density, generalised K (of max(1, |log p|))": (
        densities, "nu 1e-3 to 1e4, kappa 1e-3 to 30, x 1e-9 to 3 rms, against 40 digits", 1e-10),
    "ppf and cdf, isf and sf (relative, in p)": (
        round_trips, "nu 0.1 to 1e4, kappa 0.01 to 10, p 1e-12 to 0.4", 1e-6),
    "limits of K and generalised K (nats)": (limits, "nu to 1e10, kappa to 0", 1e-6),
    "maximum likelihood under scaling (relative, in nu)": (scaled_fits, "1e-140 to 1e140", 1e-3),
    "density of a Gaussian (of max(1, |log p|))": (conditions, "condition 1e2 to 1e12", 1e-3),
    "two looks combined (mean of f, in narrower sds)": (products, "widths 1 to 1e6 apart", 1.0),
    "posterior sd under sharp and wide priors (relative)": (
        separations, "scales 1 to 1e6 apart, either way", 0.2),
    "R-hat and ESS under shifts": (convergence, "1 to 1e10 sds", 1e-3),
    "crest rule within line of sight (share)": (shadows, "grazing 0.01 to 80 degrees", 1e-3),
    "scattering amplitude (share not finite)": (amplitudes, "grazing 0 to 90 degrees", 0.0),
    "rendered wavelength (first harmonic over mean)": (
        rendered, "grazing 1 to 60 degrees, layover, steepness 1e-4 to 1, law at its bounds", 0.05),
    "the same by laws of exponent -0.9": (
        rendered_endless, "the same; they brighten without end towards grazing", 0.05),
    "the same nearly below the sonar": (
        rendered_near, "grazing 80 degrees, steepness 1e-4 to 1, any law", 0.05),
    "stage 2 (f and A_H from the truth, sds)": (surveys, "1 cell and 10 000", 4.0),
    "texture (share of pixels in a wrong class)": (
        textures, "1 and 1000 pixels long, one sediment and two", 0.02),
    "boundary by nodes (px)": (boundaries, "contrast 0.01 to 1e9 nats a pixel", 0.6),
    "distance from the track (m)": (tracks, "2 to 100 000 pings, to 9e6 m from the origin", 1e-6),
}  # fmt: skip


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--output", type=Path, default=Path("docs/studies"))
    options = parser.parse_args()
    count = 60 if options.quick else 600
    lines = [
        worst_of(what, over, limit, study(count)) for what, (study, over, limit) in STUDIES.items()
    ]
    text = "| what | over | worst | where | limit | |\n|---|---|---|---|---|---|\n"
    for line in lines:
        met = "met" if line.worst <= line.limit else "**missed**"
        cells = (line.what, line.over, f"{line.worst:.1e}", line.where, f"{line.limit:g}", met)
        text += f"| {' | '.join(cells)} |\n"
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "stability.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
