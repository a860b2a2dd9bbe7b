"""One clip to its posterior: is it needed at all, start, sample, judge."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sasmap.ripples.clip import BinnedClip, Clip, bin_clip, mean_look
from sasmap.ripples.likelihood import Prior, speckle_data
from sasmap.ripples.posterior import LeftOut, Posterior, Quality, converged, dataset
from sasmap.ripples.presence import ripple_peaks, spectrum, too_long
from sasmap.ripples.published import sample_published
from sasmap.ripples.sampler import learn_proposal, metropolis
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.starts import cooled_population

MIN_PIXELS = 400
ROUND = 250


def estimate(
    clip: Clip | xr.DataArray,
    settings: RippleSettings | None = None,
    *,
    rng: np.random.Generator | int | None = None,
    prior: Prior | None = None,
) -> Posterior:
    """Estimate ripple frequency f and height A_H from one clip.

    Parameters
    ----------
    clip : Clip or DataArray (y, x)
        Linear amplitudes with ``x``, ``y``, ``ground_range``, ``altitude`` (m) and
        ``look_azimuth`` (degrees) coordinates, as :func:`sasmap.open_pass` gives them.
    settings : RippleSettings, optional
        The survey's ``ripples`` block.
    rng : Generator or int, optional
        Source of randomness or its seed; the same seed gives the same posterior to the bit.
    prior : Prior, optional
        Of (f, A_H); flat within the settings' bounds if not given.

    Returns
    -------
    Posterior
        Its quality says whether there are draws, and whether they converged.

    Raises
    ------
    ValueError
        Where a coordinate is missing.

    Notes
    -----
    Crests are taken as straight and looked at square-on. The default method samples the speckle
    likelihood of :mod:`sasmap.ripples.kernel`; "zare-cobb" is the published sampler (Zare and Cobb
    2013).
    """
    settings = settings or RippleSettings()
    rng = np.random.default_rng(rng)
    if isinstance(clip, xr.DataArray):
        clip = Clip.from_array(clip)
    prior = prior or Prior.flat(settings.frequency, settings.height)
    valid = clip.valid
    if valid.sum() < MIN_PIXELS:
        return Posterior(Quality.TOO_FEW_PIXELS, prior)
    if np.ptp(clip.amplitude[valid]) == 0:
        return Posterior(Quality.NO_RIPPLES, prior, left_out=LeftOut.SAMPLING)
    if settings.method == "zare-cobb":
        return _published(clip, prior, rng)
    return _default(clip, settings, prior, rng)


def _default(
    clip: Clip, settings: RippleSettings, prior: Prior, rng: np.random.Generator
) -> Posterior:
    binned = bin_clip(clip)
    found = spectrum(binned, settings.frequency)
    if found is None:
        return Posterior(Quality.NOT_IDENTIFIABLE, prior, left_out=LeftOut.SAMPLING)
    peaks = ripple_peaks(found)
    if not peaks.size:
        unclear = too_long(found, settings.frequency)
        quality = Quality.NOT_IDENTIFIABLE if unclear else Quality.NO_RIPPLES
        return Posterior(quality, prior, left_out=LeftOut.SAMPLING)
    shadow = settings.shadow if _can_cast_shadow(binned, prior) else "none"
    pooled = binned.pooled(1 / float(found.frequency[peaks[0]]))
    data = speckle_data(pooled, shadow, binned.altitude_variation)
    compiled = prior.compiled()
    population = cooled_population(found, peaks, data, prior, rng)
    proposal = learn_proposal(population)
    states = population[rng.permutation(len(population))[: settings.chains]]
    rounds: list[np.ndarray] = []
    accepted, kept, done = 0, 0, False
    while kept < settings.draws and not done:
        steps = min(ROUND, settings.draws - kept)
        chains = [metropolis(state, steps, proposal, data, compiled, rng) for state in states]
        states = np.array([chain.draws[-1] for chain in chains])
        accepted += sum(chain.accepted for chain in chains)
        kept += steps
        rounds.append(np.stack([chain.draws for chain in chains]))
        draws = np.concatenate(rounds, axis=1)
        done = converged(draws[..., 0]) and converged(draws[..., 1])
    draws[..., 2] %= 2 * np.pi
    draws[..., 3] = np.exp(draws[..., 3])
    left_out = LeftOut.ORIENTATION | LeftOut.PHASE_FIELD | LeftOut.TREND
    if shadow == "none":
        left_out |= LeftOut.SHADOW
    return Posterior(
        Quality.GOOD if done else Quality.NOT_CONVERGED,
        prior,
        dataset(draws, ("frequency", "height", "phase", "noise")),
        binned.azimuth % 180.0,
        accepted / (kept * len(states)),
        left_out,
    )


def _can_cast_shadow(binned: BinnedClip, prior: Prior) -> bool:
    """Whether a slope within the bounds is steeper than the lowest grazing angle."""
    ends = np.array([binned.start, -binned.start])
    ground_range = binned.range0[:, None] + binned.range_slope[:, None] * ends
    altitude = binned.altitude0[:, None] + binned.altitude_slope[:, None] * ends
    steepest = 2 * np.pi * prior.bounds[0][1] * prior.bounds[1][1]
    return bool(steepest >= (altitude / np.maximum(ground_range, 1e-9)).min())


def _published(clip: Clip, prior: Prior, rng: np.random.Generator) -> Posterior:
    draws, acceptance = sample_published(clip, prior, rng)
    return Posterior(
        Quality.NOT_CONVERGED,  # one chain cannot show that it converged
        prior,
        dataset(draws, ("frequency", "height")),
        mean_look(clip) % 180.0,
        acceptance,
        LeftOut.PRESENCE_TEST | LeftOut.ORIENTATION | LeftOut.PHASE_FIELD | LeftOut.TREND,
    )
