"""Stability: every special function, likelihood, sampler and fit over its extreme arguments.

    python pipelines/studies/stability.py [--quick] [--output docs/studies]

One line each: what was asked of it, over what, the worst error found and where. Writes
stability.md.
`pipelines/ripples/extremes.py` and `pipelines/sediments/laws.py` hold the longer lists.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import mpmath
import numpy as np

from sasmap.numerics.gaussians import Mixture, log_densities
from sasmap.ripples import Prior, RippleSettings, estimate
from sasmap.ripples.diagnostics import ess_bulk, rhat
from sasmap.ripples.mixture import product
from sasmap.ripples.scattering import lit_amplitude, shadow_crest_rule, shadow_line_of_sight
from sasmap.sediments import fit, generalized_k, k_distribution
from sasmap.sediments.nodes import refine_boundary
from sasmap.simulate import straight_clip
from sasmap.survey.navigation import Track


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
    """Errors of the mean of a product of Gaussians of very different widths."""
    for power in range(7):
        wide = Mixture(np.ones(1), np.zeros((1, 3)), np.eye(3)[None])
        small = 10.0**-power
        narrow = Mixture(np.ones(1), np.full((1, 3), 0.3), small**2 * np.eye(3)[None])
        for first, second in ((wide, narrow), (narrow, wide)):
            found = product(first, second)
            exact = 0.3 / (1 + small**2)
            error = abs(found.mean[0, 0] - exact) / small
            yield f"widths apart 1e{power}", float(error)


def separations(count: int) -> Iterator[tuple[str, float]]:
    """How far a posterior lies from its prior, prior sds, where the prior is so much sharper."""
    clip = straight_clip(
        np.random.default_rng(1), frequency=0.6, height=0.07, pixel_size=0.04, shape=(300, 300),
        near=20.0,
    )  # fmt: skip
    settings = RippleSettings()
    bounds = settings.frequency, settings.height
    free = estimate(clip, settings, rng=1)
    sd = float(free.sd.frequency)
    for power in (0, 2, 4, 6):
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
    "product of Gaussians (mean, in narrower sds)": (products, "widths 1 to 1e6 apart", 1e-9),
    "posterior sd under sharp and wide priors (relative)": (
        separations, "scales 1 to 1e6 apart, either way", 0.2),
    "R-hat and ESS under shifts": (convergence, "1 to 1e10 sds", 1e-3),
    "crest rule within line of sight (share)": (shadows, "grazing 0.01 to 80 degrees", 1e-3),
    "scattering amplitude (share not finite)": (amplitudes, "grazing 0 to 90 degrees", 0.0),
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
