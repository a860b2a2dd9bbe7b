"""Convergence of Markov chains: rank-normalised split R-hat and effective sample sizes.

Vehtari, Gelman, Simpson, Carpenter, Buerkner 2021, Bayesian Analysis 16, arXiv 1903.08008.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri
from scipy.stats import rankdata

from sasmap.arrays import FloatArray


def rhat(draws: FloatArray) -> float:
    """Rank-normalised split R-hat: the larger of the bulk and the folded (tail) value.

    Parameters
    ----------
    draws : ndarray (chain, draw)
        At least two chains of four draws.

    Returns
    -------
    float
        1 where all draws are equal; NaN where a draw is not finite or there are too few.
    """
    if not _usable(draws) or draws.shape[0] < 2:
        return float("nan")
    if np.ptp(draws) == 0:
        return 1.0
    split = _split(draws)
    folded = np.abs(split - np.median(split))
    return max(_rhat(_rank_normalised(split)), _rhat(_rank_normalised(folded)))


def ess_bulk(draws: FloatArray) -> float:
    """Effective sample size of the centre of the distribution.

    Parameters
    ----------
    draws : ndarray (chain, draw)
    """
    return _ess(_rank_normalised(_split(draws))) if _usable(draws) else float("nan")


def ess_tail(draws: FloatArray) -> float:
    """Effective sample size of the tails: the smaller one of the 5 % and 95 % quantiles.

    Parameters
    ----------
    draws : ndarray (chain, draw)
    """
    if not _usable(draws):
        return float("nan")
    sizes = []
    for probability in (0.05, 0.95):
        below = (draws <= np.quantile(draws, probability)).astype(float)
        sizes.append(_ess(_split(below)))
    return min(sizes)


def _usable(draws: FloatArray) -> bool:
    return bool(draws.ndim == 2 and draws.shape[1] >= 4 and np.isfinite(draws).all())


def _split(draws: FloatArray) -> FloatArray:
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]])


def _rank_normalised(draws: FloatArray) -> FloatArray:
    ranks = rankdata(draws, method="average").reshape(draws.shape)
    return np.asarray(ndtri((ranks - 0.375) / (draws.size + 0.25)))


def _rhat(draws: FloatArray) -> float:
    n = draws.shape[1]
    between = n * np.var(draws.mean(axis=1), ddof=1)
    within = np.var(draws, axis=1, ddof=1).mean()
    if within == 0:
        return 1.0 if between == 0 else float("inf")
    return float(np.sqrt((between / within + n - 1) / n))


def _autocovariance(draws: FloatArray) -> FloatArray:
    n = draws.shape[1]
    centred = draws - draws.mean(axis=1, keepdims=True)
    size = next_fast_len(2 * n)
    spectrum = rfft(centred, size, axis=1)
    return np.asarray(irfft(spectrum * np.conj(spectrum), size, axis=1)[:, :n] / n)


def _ess(draws: FloatArray) -> float:
    """Geyer's initial monotone sequence over chains (Vehtari et al., section 3.2)."""
    chains, n = draws.shape
    if np.ptp(draws) < np.finfo(float).resolution:
        return float(draws.size)
    covariance = _autocovariance(draws)
    mean_variance = covariance[:, 0].mean() * n / (n - 1)
    variance = mean_variance * (n - 1) / n
    if chains > 1:
        variance += np.var(draws.mean(axis=1), ddof=1)
    rho = 1 - (mean_variance - covariance.mean(axis=0)) / variance
    rho[0] = 1.0
    return _geyer(rho, draws.size)


def _geyer(rho: FloatArray, size: int) -> float:
    pairs = rho[: 2 * max((rho.size - 1) // 2, 1)].reshape(-1, 2)
    sums = pairs.sum(axis=1)
    last = int(np.argmax(np.append(sums[:-1] <= 0, True)))
    tail = pairs[last, 0] if sums[last] >= 0 else max(pairs[last, 0], 0.0)
    time = 2 * np.minimum.accumulate(sums[:last]).sum() + tail - 1
    return float(size / max(time, 1 / np.log10(size)))
