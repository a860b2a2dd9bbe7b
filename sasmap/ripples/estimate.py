"""One clip to its posterior: is it needed at all, start, sample, judge."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sasmap.ripples.alignment import edge_errors
from sasmap.ripples.clip import Clip
from sasmap.ripples.fit import Fit, Task, fit_wave
from sasmap.ripples.folded import Proposal
from sasmap.ripples.image import Image, as_image
from sasmap.ripples.kernel import SIZE
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.model import modelled
from sasmap.ripples.posterior import (
    NOTHING,
    LeftOut,
    Posterior,
    Quality,
    Shape,
    converged,
    dataset,
)
from sasmap.ripples.presence import Spectrum, Wave, find_waves, spectrum, too_long
from sasmap.ripples.published import sample_published
from sasmap.ripples.sampler import learn_proposal, metropolis
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.starts import parameters, population
from sasmap.ripples.weak import sample_weak

MIN_PIXELS = 400
ROUND = 400
# Draws a chain after which its proposal is learned again, and from how many draws.
BURN_IN, RELEARNED = (1500, 1500), 240
# Share of the local frequency's variation by which a bent clip's A_H is uncertain.
BENT_SHARE = 0.7
# By how much the burn-in population is widened: one too narrow would not find out.
WIDENED = 1.2
# Probability from which a clip counts as rippled.
PRESENT = 0.5
# Standard deviations of the prior within which a wave is searched where it is assumed.
SEARCHED_SD = 4.0
# Cosine of the angle between crest normal and look below which a ripple's height cannot be told.
MIN_ALONG = 0.07
# Share of the strongest wave's energy from which its half or double is tried as well.
RIVAL = 0.25
# Power over the spectrum around it that a wave seen along its crests must have to be remarked.
STRIKING = 200.0


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
    The default method finds the ripple's wave in the clip's spectrum, follows its phase where
    crests bend, folds the pixels by that phase and samples the speckle likelihood of
    :mod:`sasmap.ripples.kernel`; "zare-cobb" is the published sampler (Zare and Cobb 2013), which
    takes crests as straight and looked at square-on.

    Examples
    --------
    >>> import sasmap
    >>> survey = sasmap.load_survey("sample_data/survey.yaml")
    >>> clip = sasmap.open_pass(survey, "near")[:500, :500]  # f is 0.6 cycles/m, A_H 0.07 m
    >>> posterior = estimate(clip, survey.ripples, rng=1)
    >>> posterior.quality.label, posterior.draws["frequency"].dims
    ('good', ('chain', 'draw'))
    >>> abs(float(posterior.mean.frequency) - 0.6) < 0.003
    True
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
        return Posterior(Quality.NO_RIPPLES, prior, left_out=LeftOut.SAMPLING, probability=0.0)
    if settings.method == "zare-cobb":
        return _published(clip, prior, rng)
    return _default(clip, settings, prior, rng)


def _default(
    clip: Clip, settings: RippleSettings, prior: Prior, rng: np.random.Generator
) -> Posterior:
    image = as_image(clip)
    found = spectrum(image)
    if found is None:
        return Posterior(Quality.NO_RIPPLES, prior, left_out=LeftOut.SAMPLING, probability=0.0)
    waves = find_waves(image, found, _searched(settings, prior))
    if waves is None:
        return Posterior(Quality.NOT_IDENTIFIABLE, prior, left_out=LeftOut.SAMPLING)
    chosen, probability = _candidates(image, waves, settings)
    shadow = settings.shadow if _can_cast_shadow(image, prior) else None
    task = Task(image, shadow, settings, prior, prior.compiled(image.azimuth))
    if settings.presence == "assumed" and probability <= PRESENT:
        weak = _weak(task, [*chosen, *waves][0], probability, rng)
        if weak is not None:
            return weak
    if not chosen:
        quality = _why_not(image, found, waves, settings)
        return Posterior(quality, prior, left_out=LeftOut.SAMPLING, probability=probability)
    fit = max((fit_wave(task, wave.vector) for wave in chosen), key=lambda f: f.level)
    draws, acceptance, done = _sampled(fit, task, rng)
    image_of = modelled(clip, image, fit, draws) if settings.keep_model else None
    return Posterior(
        _judged(draws, done, image, probability),
        prior,
        labelled(vouched(draws, fit, task, rng)),
        acceptance,
        _left_out(fit, shadow, settings),
        probability,
        Shape(
            fit.profile,
            fit.phase.coherence_length,
            fit.phase.rippled_fraction,
            fit.phase.stiffness,
            fit.noise_factor,
        ),
        None if image_of is None else image_of.amplitude,
        labelled(draws),
        None if image_of is None else image_of.relief,
    )


def _weak(task: Task, wave: Wave, probability: float, rng: np.random.Generator) -> Posterior | None:
    """Posterior of a clip that is assumed to be rippled and shows no clear wave."""
    sampled = sample_weak(task, wave.vector, rng)
    if sampled is None:
        return None
    draws, acceptance, done = sampled
    extent = float(np.hypot(*(np.array(task.image.shape) * task.image.pixel_size)))
    left_out = LeftOut.PRESENCE_TEST | LeftOut.SHADOW | LeftOut.PHASE_FIELD
    return Posterior(
        _judged(draws, done, task.image, probability),
        task.prior,
        labelled(draws),
        acceptance,
        left_out,
        probability,
        Shape("sine", extent, 1.0, float("inf"), 1.0),
    )


def _searched(settings: RippleSettings, prior: Prior) -> tuple[float, float]:
    """Frequencies to search: where presence is assumed, those that the prior holds possible."""
    low, high = settings.frequency
    reach = SEARCHED_SD * prior.sd[0]
    place = float(np.clip(prior.mean[0], low, high))
    if settings.presence == "tested" or not np.isfinite(reach):
        return low, high
    return max(low, place - reach), min(high, place + reach)


def _candidates(
    image: Image, waves: list[Wave], settings: RippleSettings
) -> tuple[list[Wave], float]:
    """Waves to fit, and the probability that there is a ripple.

    The strongest of those that pass, and those half or twice as long that come near it.
    """
    visible = [w for w in waves if _along_look(image, w) > MIN_ALONG]
    probability = max((w.probability for w in visible), default=0.0)
    passed = [w for w in visible if w.probability > PRESENT]
    if settings.presence == "assumed" and not passed:
        passed = sorted(visible, key=lambda w: -w.power)[:1]
    if not passed:
        return [], probability
    first = max(passed, key=lambda w: w.energy)
    others = [w for w in passed if w.energy > RIVAL * first.energy and _harmonic(w, first)]
    return [first, *others[:1]], probability


def _along_look(image: Image, wave: Wave) -> float:
    return float(abs(wave.vector @ image.look) / np.hypot(*wave.vector))


def _harmonic(wave: Wave, first: Wave) -> bool:
    """Whether a wave is nearly half or twice another."""
    ratio = np.hypot(*wave.vector) / np.hypot(*first.vector)
    cosine = abs(wave.vector @ first.vector) / (np.hypot(*wave.vector) * np.hypot(*first.vector))
    return bool(cosine > 0.97 and (abs(ratio - 0.5) < 0.06 or abs(ratio - 2) < 0.2))


def _why_not(image: Image, found: Spectrum, waves: list[Wave], settings: RippleSettings) -> Quality:
    """Quality of a clip without a wave that could be estimated."""
    hidden = [w for w in waves if w.probability > 0.99 and w.power > STRIKING]
    if hidden or too_long(image, found, settings.frequency):
        return Quality.NOT_IDENTIFIABLE
    return Quality.NO_RIPPLES


def _sampled(fit: Fit, task: Task, rng: np.random.Generator) -> tuple[np.ndarray, float, bool]:
    """Draws (chain, draw, parameter), accepted fraction, and whether they converged.

    Where chains do not converge soon, what they saw was burn-in: the proposal is learned anew from
    it and frozen again.
    """
    chains = task.settings.chains
    members, width = population(fit.theta, fit.data, task.prior, task.compiled, rng)
    states = members[rng.permutation(len(members))[:chains]]
    for most in (*BURN_IN, task.settings.draws):
        proposal = learn_proposal(members, WIDENED, width)
        most = min(most, task.settings.draws)
        draws, accepted, done = _rounds(states, proposal, most, fit, task, rng)
        if done:
            break
        seen = draws[:, draws.shape[1] // 3 :].reshape(-1, SIZE)
        members, width = seen[rng.permutation(len(seen))[:RELEARNED]], None
        states = draws[:, -1]
    return parameters(draws), accepted, done


def _rounds(
    states: np.ndarray,
    proposal: Proposal,
    most: int,
    fit: Fit,
    task: Task,
    rng: np.random.Generator,
) -> tuple[np.ndarray, float, bool]:
    """Run chains until they converge, or for this many draws each.

    Returns what :func:`_sampled` does, in the coordinates that are sampled.
    """
    rounds: list[np.ndarray] = []
    accepted, kept, done = 0, 0, False
    while kept < most and not done:
        steps = min(max(ROUND, kept // 2), most - kept)
        chains = [metropolis(s, steps, proposal, fit.data, task.compiled, rng) for s in states]
        states = np.array([chain.draws[-1] for chain in chains])
        accepted += sum(chain.accepted for chain in chains)
        kept += steps
        rounds.append(np.stack([chain.draws for chain in chains]))
        draws = np.concatenate(rounds, axis=1)
        theta = parameters(draws)
        done = all(converged(theta[..., i]) for i in range(3))
    return draws, accepted / (kept * len(states)), done


def vouched(draws: np.ndarray, fit: Fit, task: Task, rng: np.random.Generator) -> np.ndarray:
    """Widen draws by what the sampled likelihood does not know.

    A bent clip's pulse is one that places of different local frequency share; of straight crests
    along the lattice all rows sample shadow's edges alike.

    Parameters
    ----------
    draws : ndarray (chain, draw, SIZE)
    fit : Fit
    task : Task
    rng : Generator

    Returns
    -------
    ndarray (chain, draw, SIZE)
    """
    if fit.phase.rigid:
        errors = edge_errors(fit, task.image, draws.reshape(-1, draws.shape[-1]).mean(axis=0))
    else:
        errors = (0.0, BENT_SHARE * fit.phase.variation)
    if max(errors) == 0:
        return draws
    result = draws.copy()
    for i, error in enumerate(errors):
        middle = max(float(draws[..., i].mean()), 1e-12)
        spread = _added(float(draws[..., i].var()), task.prior.sd[i], error * middle) / middle
        result[..., i] *= np.exp(spread * rng.normal(size=draws.shape[:2]))
        result[..., i] = np.clip(result[..., i], *task.prior.bounds[i])
    return result


def _added(variance: float, prior_sd: float, error: float) -> float:
    """Spread to add to a posterior whose image is doubted by an error; its prior is not."""
    known = 1 / prior_sd**2
    seen = max(1 / max(variance, 1e-300) - known, 1e-300)
    wider = 1 / (known + 1 / (1 / seen + error**2))
    return float(np.sqrt(max(wider - variance, 0.0)))


def _judged(draws: np.ndarray, done: bool, image: Image, probability: float) -> Quality:
    """Quality of a sampled clip: not identifiable where only the survey says that it is rippled."""
    along = np.abs(np.cos(draws[..., 2] - np.radians(image.azimuth)))
    if np.quantile(along, 0.05) < MIN_ALONG or probability < PRESENT:
        return Quality.NOT_IDENTIFIABLE
    return Quality.GOOD if done else Quality.NOT_CONVERGED


def labelled(draws: np.ndarray) -> xr.Dataset:
    """Name draws and give them the units that people read."""
    draws = draws.copy()
    draws[..., 2] = np.degrees(draws[..., 2])
    draws[..., 2] -= 180.0 * np.floor(draws[..., 2].mean() / 180.0)
    draws[..., 3] %= 2 * np.pi
    draws[..., 4] = np.exp(draws[..., 4])
    return dataset(draws, ("frequency", "height", "azimuth", "phase", "noise", "blur"))


def _left_out(fit: Fit, shadow: str | None, settings: RippleSettings) -> LeftOut:
    left_out = LeftOut.PRESENCE_TEST if settings.presence == "assumed" else NOTHING
    if shadow is None:
        left_out |= LeftOut.SHADOW
    if fit.phase.rigid:
        left_out |= LeftOut.PHASE_FIELD
    if not fit.trended:
        left_out |= LeftOut.TREND
    return left_out


def _can_cast_shadow(image: Image, prior: Prior) -> bool:
    """Whether a slope within the bounds is steeper than the lowest grazing angle."""
    valid = image.valid
    lowest = float((image.altitude[valid] / image.ground_range[valid]).min())
    # of the three profiles the peaked one is the steepest
    steepest = min(2 * np.pi * prior.bounds[0][1] * prior.bounds[1][1], prior.steepest)
    return bool(1.3 * steepest >= lowest)


def _published(clip: Clip, prior: Prior, rng: np.random.Generator) -> Posterior:
    draws, acceptance = sample_published(clip, prior, rng)
    return Posterior(
        Quality.NOT_CONVERGED,  # one chain cannot show that it converged
        prior,
        dataset(draws, ("frequency", "height")),
        acceptance,
        LeftOut.PRESENCE_TEST | LeftOut.ORIENTATION | LeftOut.PHASE_FIELD | LeftOut.TREND,
    )
