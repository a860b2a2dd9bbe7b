"""The generalised-K density, in logs, for any arguments: the compiled inner loop.

Texture z ~ Gamma(nu, mean 1); given z, the amplitude is Rician with drift z kappa and mean square
scatter z (G 5), so with scale a = 1

    p(x) = 2 x i0e(2 kappa x) C(nu) J,      C(nu) = nu^nu exp(-nu) / Gamma(nu),
    J = integral over z of exp(-(x - kappa z)^2 / z - nu (z - 1 - log z)) dz / z^2

No term of the exponent is large where the density is not small, so nothing cancels, whatever nu,
kappa and x are. With z = z0 exp(t) about its saddle z0 the integral is that of

    exp(-alpha (exp(-t) - 1 + t) - beta (exp(t) - 1 - t)),

alpha = x^2 / z0, beta = (nu + kappa^2) z0, over the line (a modified Bessel function), which the
trapezoidal rule gives to machine precision: its error falls exponentially with the number of points
(Trefethen and Weideman 2014, SIAM Review 56).
"""

from __future__ import annotations

import math

import numba
import numpy as np

# Step of the trapezoidal rule in widths of the peak, and its maximum.
STEP_WIDTHS, LONGEST = 0.6, 0.25
# Terms exp(-x) with x above this are neglected.
DEEP = 35.0
# Curvature below which the peak is wide.
WIDE = 300.0
LARGE_NU, LARGE_Y = 30.0, 30.0
# Log density below which it is taken as 0, and smallest lower limit of integrals in units of the
# root mean square.
NOTHING, LEAST = -740.0, 1e-20


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_normaliser(nu):  # type: ignore[no-untyped-def]
    """Log of nu^nu exp(-nu) / Gamma(nu); by Stirling's series for large nu (DLMF 5.11.1)."""
    if nu < LARGE_NU:
        return nu * math.log(nu) - nu - math.lgamma(nu)
    y = 1.0 / (nu * nu)
    series = (1.0 / 12.0 - y * (1.0 / 360.0 - y * (1.0 / 1260.0 - y / 1680.0))) / nu
    return 0.5 * math.log(nu / (2.0 * math.pi)) - series


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _past(t):  # type: ignore[no-untyped-def]
    """exp(t) - 1 - t without cancellation, by its series for |t| < 0.3."""
    if abs(t) > 0.3:
        return math.expm1(t) - t
    tail = 1.0 + t / 9.0 * (1.0 + t / 10.0 * (1.0 + t / 11.0 * (1.0 + t / 12.0)))
    tail = 1.0 + t / 6.0 * (1.0 + t / 7.0 * (1.0 + t / 8.0 * tail))
    return 0.5 * t * t * (1.0 + t / 3.0 * (1.0 + t / 4.0 * (1.0 + t / 5.0 * tail)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _side(alpha, beta, step):  # type: ignore[no-untyped-def]
    """Sum the trapezoidal rule over t > 0."""
    total, k = 0.0, 1
    while True:
        t = k * step
        fall = alpha * _past(-t) + beta * _past(t)
        if fall > DEEP:
            return total
        total += math.exp(-fall)
        k += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _wide_side(alpha, beta, step):  # type: ignore[no-untyped-def]
    """Compute the same sum where the peak is wide: there powers of exp(step) do not cancel."""
    total, t = 0.0, 0.0
    up, down = math.exp(step), math.exp(-step)
    rise, decline = 1.0, 1.0
    while True:
        t += step
        rise *= up
        decline *= down
        fall = alpha * (decline - 1.0 + t) + beta * (rise - 1.0 - t)
        if fall > DEEP:
            return total
        total += math.exp(-fall)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_integral(alpha, beta):  # type: ignore[no-untyped-def]
    """Log of the integral over t."""
    both = alpha + beta
    step = min(STEP_WIDTHS / math.sqrt(both), LONGEST)
    if both < WIDE:
        total = 1.0 + _wide_side(alpha, beta, step) + _wide_side(beta, alpha, step)
    else:
        total = 1.0 + _side(alpha, beta, step) + _side(beta, alpha, step)
    return math.log(total * step)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_i0e(y):  # type: ignore[no-untyped-def]
    """Log of exp(-y) I0(y), y >= 0: the power series, then the asymptotic one (DLMF 10.40.1)."""
    total, term, k = 1.0, 1.0, 1
    if y < LARGE_Y:
        square = 0.25 * y * y
        while term > 1e-18 * total:
            term *= square / (k * k)
            total += term
            k += 1
        return math.log(total) - y
    while term > 1e-18 and k < 40:
        term *= (2 * k - 1) ** 2 / (8.0 * y * k)
        total += term
        k += 1
    return math.log(total) - 0.5 * math.log(2.0 * math.pi * y)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_density(x, nu, kappa, normaliser):  # type: ignore[no-untyped-def]
    """Log density at x > 0 with scale 1; `normaliser` is :func:`log_normaliser` of nu."""
    total = nu + kappa * kappa
    root = math.hypot(nu - 1.0, 2.0 * math.sqrt(total) * x)
    # the positive root of total z^2 - (nu - 1) z = x^2, in the form without cancellation
    if nu > 1.0:
        z = 0.5 * (nu - 1.0 + root) / total
        alpha, beta = x * (x / z), 0.5 * (root + (nu - 1.0))
    else:
        z = 2.0 * x * (x / (root + (1.0 - nu)))
        alpha, beta = 0.5 * (root + (1.0 - nu)), total * z
    if z < 1e-290:
        return _log_origin(x, nu, kappa, normaliser)
    log_z = math.log(z) if abs(z - 1.0) > 0.1 else math.log1p(z - 1.0)
    gamma = nu * _past(log_z) if abs(log_z) < 1.0 else nu * (z - 1.0 - log_z)
    drift = (x - kappa * z) * ((x - kappa * z) / z)
    value = math.log(2.0 * x) + log_i0e(2.0 * kappa * x) + normaliser - drift - gamma - log_z
    return value + _log_integral(alpha, beta)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_origin(x, nu, kappa, normaliser):  # type: ignore[no-untyped-def]
    """Log density where x^2 underflows, nu < 1: 2 x^(2 nu - 1) Gamma(1 - nu) C(nu) exp(nu)."""
    return math.log(2.0) + (2.0 * nu - 1.0) * math.log(x) + math.lgamma(1.0 - nu) + normaliser + nu


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_densities(x, nu, kappa):  # type: ignore[no-untyped-def]
    """Log densities at points (n,), all > 0, of one law of scale 1."""
    normaliser = log_normaliser(nu)
    result = np.empty(x.size)
    for i in range(x.size):
        result[i] = log_density(x[i], nu, kappa, normaliser)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_densities_each(x, nu, kappa):  # type: ignore[no-untyped-def]
    """Log densities at points (n,), each of its own law."""
    result = np.empty(x.size)
    for i in range(x.size):
        result[i] = log_density(x[i], nu[i], kappa[i], log_normaliser(nu[i]))
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _edge(inner, outer, nu, kappa, normaliser):  # type: ignore[no-untyped-def]
    """Find where the density becomes negligible, between a point inside and one outside."""
    for _ in range(200):
        middle = math.sqrt(inner * outer)
        if log_density(middle, nu, kappa, normaliser) > NOTHING:
            inner = middle
        else:
            outer = middle
        if abs(math.log(outer / inner)) < 1e-3:
            break
    return outer


@numba.njit(cache=True, nogil=True, error_model="numpy")
def reach(nu, kappa):  # type: ignore[no-untyped-def]
    """Lower and upper limit between which the density of scale 1 is not negligible."""
    normaliser = log_normaliser(nu)
    rms = math.sqrt(1.0 + kappa * kappa * (1.0 + 1.0 / nu))
    best, middle = -np.inf, rms
    for share in (1e-3, 0.03, 0.1, 0.3, 0.6, 0.8, 0.9, 0.97, 1.0, 1.1):
        for centre in (rms, kappa):
            if centre > 0.0:
                level = log_density(share * centre, nu, kappa, normaliser)
                if level > best:
                    best, middle = level, share * centre
    low, high = LEAST * rms, 1e6 * rms
    if log_density(low, nu, kappa, normaliser) < NOTHING:
        low = _edge(middle, low, nu, kappa, normaliser)
    return low, _edge(middle, high, nu, kappa, normaliser)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def next_place(u, nu, kappa, normaliser):  # type: ignore[no-untyped-def]
    """Farthest point beyond u up to which one Gauss-Legendre rule integrates the density."""
    step = 1e-6 * u
    level = log_density(u, nu, kappa, normaliser)
    slope = abs(log_density(u + step, nu, kappa, normaliser) - level) / step
    feature = math.sqrt(u * u / max(nu, 1.0) + max(u, 1.0) / max(kappa, 1.0))
    return u + min(0.5 * u, feature, 5.0 / max(slope, 1e-300))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mass(low, high, nu, kappa, normaliser, nodes, weights):  # type: ignore[no-untyped-def]
    """Integrate the density between two near points by a Gauss-Legendre rule."""
    total, half = 0.0, 0.5 * (high - low)
    for k in range(nodes.size):
        total += weights[k] * math.exp(
            log_density(low + half * (1.0 + nodes[k]), nu, kappa, normaliser)
        )
    return total * half


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cumulate(nu, kappa, nodes, weights):  # type: ignore[no-untyped-def]
    """Points of a law of scale 1, and the mass below and above each: three arrays (n,)."""
    normaliser = log_normaliser(nu)
    low, high = reach(nu, kappa)
    places = [low]
    while places[-1] < high:
        places.append(next_place(places[-1], nu, kappa, normaliser))
    n = len(places)
    place, below, above = np.empty(n), np.empty(n), np.empty(n)
    part = np.empty(n)
    for i in range(n):
        place[i] = places[i]
    # below the first point the density is a power law
    head = log_density(low, nu, kappa, normaliser)
    below[0] = math.exp(head) * low / min(2.0 * nu, 2.0) if head > NOTHING + 40.0 else 0.0
    for i in range(n - 1):
        part[i] = mass(place[i], place[i + 1], nu, kappa, normaliser, nodes, weights)
        below[i + 1] = below[i] + part[i]
    above[n - 1] = 0.0
    for i in range(n - 2, -1, -1):
        above[i] = above[i + 1] + part[i]
    return place, below, above
