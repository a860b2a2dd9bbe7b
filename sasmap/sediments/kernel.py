"""The generalised-K density, in logs, for any arguments: the compiled inner loop.

Texture z ~ Gamma(nu, mean 1); given z the amplitude is Rice with drift z kappa and mean square
scatter z (SCIENCE 4; G 5), so with scale a = 1

    p(x) = 2 x i0e(2 kappa x) C(nu) J,      C(nu) = nu^nu exp(-nu) / Gamma(nu),
    J = integral over z of exp(-(x - kappa z)^2 / z - nu (z - 1 - log z)) dz / z^2

No term of the exponent is large where the density is not small, so nothing cancels, whatever nu,
kappa and x are. With z = z0 exp(t) about its saddle z0 the integral is that of

    exp(-alpha (exp(-t) - 1 + t) - beta (exp(t) - 1 - t)),     alpha = x^2 / z0, beta = (nu + kappa^2) z0

over the line (a modified Bessel function), which the trapezoidal rule gives to the last digits: its
error falls exponentially with the number of points (Trefethen and Weideman 2014, SIAM Review 56).
"""

from __future__ import annotations

import math

import numba
import numpy as np

# Step of the trapezoidal rule: in widths of the peak, and at most.
STEP_WIDTHS, LONGEST = 0.55, 0.22
# Exponents below this count for nothing.
DEEP = 40.0
LARGE_NU = 30.0


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
    """exp(t) - 1 - t without cancellation."""
    if abs(t) < 0.03:
        return t * t * (0.5 + t * (1 / 6 + t * (1 / 24 + t * (1 / 120 + t * (1 / 720 + t / 5040)))))
    return math.expm1(t) - t


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
def _log_integral(alpha, beta):  # type: ignore[no-untyped-def]
    """Log of the integral over t."""
    width = 1.0 / math.sqrt(alpha + beta)
    step = min(STEP_WIDTHS * width, LONGEST)
    total = 1.0 + _side(alpha, beta, step) + _side(beta, alpha, step)
    return math.log(total * step)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_density(x, log_i0e, nu, kappa, normaliser):  # type: ignore[no-untyped-def]
    """Log density at x > 0 with scale 1.

    `log_i0e` is that of 2 kappa x, `normaliser` :func:`log_normaliser` of nu.
    """
    total = nu + kappa * kappa
    root = math.hypot(nu - 1.0, 2.0 * math.sqrt(total) * x)
    # the positive root of total z^2 - (nu - 1) z = x^2, by the sum that does not cancel
    z = 0.5 * (nu - 1.0 + root) / total if nu > 1.0 else 2.0 * x * (x / (root + 1.0 - nu))
    alpha, beta = 0.5 * (root - (nu - 1.0)), 0.5 * (root + (nu - 1.0))
    if nu > 1.0:
        alpha = x * (x / z)
    else:
        beta = total * z
    if z < 1e-280:
        return -np.inf
    log_z = math.log(z) if abs(z - 1.0) > 0.1 else math.log1p(z - 1.0)
    gamma = nu * _past(log_z) if abs(log_z) < 1.0 else nu * (z - 1.0 - log_z)
    drift = (x - kappa * z) * ((x - kappa * z) / z)
    value = math.log(2.0 * x) + log_i0e + normaliser - drift - gamma - log_z
    return value + _log_integral(alpha, beta)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_densities(x, log_i0e, nu, kappa):  # type: ignore[no-untyped-def]
    """Log densities at points (n,), all > 0, of one law of scale 1."""
    normaliser = log_normaliser(nu)
    result = np.empty(x.size)
    for i in range(x.size):
        result[i] = log_density(x[i], log_i0e[i], nu, kappa, normaliser)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_densities_each(x, log_i0e, nu, kappa):  # type: ignore[no-untyped-def]
    """Log densities at points (n,), each of its own law."""
    result = np.empty(x.size)
    for i in range(x.size):
        result[i] = log_density(x[i], log_i0e[i], nu[i], kappa[i], log_normaliser(nu[i]))
    return result
