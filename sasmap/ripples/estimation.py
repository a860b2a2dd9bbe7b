"""From one clip to its posterior: detect a ripple, fit it, sample, judge the quality."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from sasmap.arrays import FloatArray
from sasmap.ripples.clip import Clip
from sasmap.ripples.coordinates import Coordinates
from sasmap.ripples.detection import MIN_ALONG, Unclear, Wave, find_waves
from sasmap.ripples.errors import fitted_amplitudes, lag_per_height, turned_by_errors
from sasmap.ripples.extent import ripple_extent
from sasmap.ripples.fit import NoPlaceError, Task, fit_wave
from sasmap.ripples.image import Image, as_image, on_clip
from sasmap.ripples.model import modelled
from sasmap.ripples.nuisance import (
    integrated_coordinates,
    learned,
    with_drawn,
    with_integrated,
)
from sasmap.ripples.optimise import (
    COORDINATES,
    OFFSET,
    PHASE,
    Peak,
    free_coordinates,
)
from sasmap.ripples.posterior import (
    NOTHING,
    LeftOut,
    Posterior,
    Quality,
    Shape,
    converged,
    dataset,
)
from sasmap.ripples.priors import Prior
from sasmap.ripples.published import sample_published
from sasmap.ripples.rendered import Fit, expected_at, pulses_at
from sasmap.ripples.rendering import (
    error_gain,
    line_of_lags,
    log_posteriors,
    named_parameters,
)
from sasmap.ripples.ridge import along_ridges
from sasmap.ripples.sampler import mixture_of_peaks, sample
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.spectra import compared

MIN_PIXELS = 400
# Largest noise factor that correlated speckle explains, and error of log A_H for each factor of e
# beyond it: small ripples on large ones (pipelines/studies/beds.py).
MISFIT = (4.0, 0.2)
# Spread of log A_H from place to place that remains where all waves have one height. Beyond it, for
# each unit, how much too low log A_H is on average, its error, and how much single waves differ;
# the most by which it is raised, as taller groups weigh more (pipelines/studies/varying.py).
ONE_HEIGHT, TOO_LOW, VARYING, OF_WAVES, MOST_LOW = 0.01, 2.2, 2.0, 3.0, 0.4
# Rippled share of a clip above which it counts as filled, and below which an edge of the ripples
# certainly lies in it; cycles by which that edge turns the phase (pipelines/studies/varying.py).
FILLED, EDGE_TURN = (0.95, 0.85), 0.06
# Largest error of log A_H in total, as a share of its prior standard deviation.
UNKNOWN = 0.8
# Error of log A_H over the amplitude ratio of two sets of crests that cross.
CROSSING = 2.0
# Probability above which a wave counts as a ripple.
PRESENT = 0.5
# Cosine of the angle between crests below which they belong to another system; log of the ratio of
# wavelengths above which waves of one direction are two systems; cosine above which a wave of
# integer frequency ratio is an overtone.
ANOTHER, LONGER, OVERTONE = 0.87, 0.4, 0.95
# Ratio of frequencies above which, and energy over the strongest wave's below which, a wave of the
# same direction is an overtone even if the ratio is not an integer: shadow made one of 2.6 and 2.7
# with a tenth of the energy.
SHORTER, FAINT = 1.7, 0.25
# Energy of a second system over that of the strongest wave below which it is none: the window and
# the removal of the trend leave up to 0.001 of a wave in another direction
# (pipelines/ripples/calibration.py).
LEAST_SECOND = 0.002
# Share of the strongest wave's energy above which a wave of half or double its frequency is tried
# as well.
RIVAL = 0.25


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
        ``look_azimuth`` (degrees) coordinates, as :func:`sasmap.open_pass` returns them.
    settings : RippleSettings, optional
        The survey's ``ripples`` block.
    rng : Generator or int, optional
        Source of randomness or its seed; the same seed gives the same posterior to the bit.
    prior : Prior, optional
        Prior of (f, A_H); by default that of natural ripples within the settings' bounds.

    Returns
    -------
    Posterior
        Its quality says whether there are draws, and whether they converged.

    Raises
    ------
    TypeError
        Where the clip has no coordinates at all.
    ValueError
        Where a coordinate is missing.

    Notes
    -----
    The default method finds the ripple's wave in the clip's spectrum, follows its phase where
    crests bend, sums the pixels by phase and range and samples the speckle likelihood of a rendered
    wavelength (:mod:`sasmap.ripples.rendering`), its scattering law included; "zare-cobb" is the
    published sampler (Zare and Cobb 2013), which assumes straight crests seen square-on.

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
    if not isinstance(clip, Clip):
        raise TypeError(
            f"expected a Clip, or a DataArray as open_pass gives it, got {type(clip).__name__}"
        )
    prior = prior or Prior.natural(settings.frequency, settings.height)
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
    found = find_waves(image, settings.frequency)
    chosen = _candidates(found.waves)
    task = Task(image, settings, prior, clip.altitude_sd)
    fits = list(_fits(task, chosen))
    if not fits:
        reason = Unclear.HEIGHT if chosen else found.reason
        return Posterior(
            Quality.NOT_IDENTIFIABLE if reason else Quality.NO_RIPPLES,
            prior,
            left_out=LeftOut.SAMPLING,
            probability=found.probability,
            reason=reason,
        )
    wave, fit = max(fits, key=lambda f: f[1].explained)
    other = second_system(found.waves, fit.phase.wave)
    points, acceptance, done = draw_points(fit, settings, rng)
    extent = ripple_extent(image, fit.phase.wave)
    draws = _labelled(points, fit, image, (_crossing(wave, other), extent.fraction), rng)
    draws["frequency"].values = prior.weigh_frequency(draws["frequency"].values)
    image_of = modelled(clip, image, fit, points) if settings.keep_model else None
    return Posterior(
        _judged(draws, done, image),
        prior,
        draws,
        acceptance,
        _left_out(fit),
        found.probability,
        Shape(
            fit.phase.coherence_length,
            extent.fraction,
            fit.phase.stiffness,
            fit.noise_factor,
            extent.defect_density,
            fit.geometry.altitude_middle / fit.geometry.range_middle,
            fit.geometry.altitude_middle,
            fit.geometry.altitude_sd,
            (float(image.centre[0]), float(image.centre[1])),
        ),
        image_of,
        rippled=on_clip(clip, image, extent.probability),
        reference=(*(float(v) for v in fit.phase.wave), extent.own),
        second=xr.Dataset() if other is None else _draws_of(task, other, wave, rng),
    )


def _fits(task: Task, waves: list[Wave]) -> Iterator[tuple[Wave, Fit]]:
    """Yield the waves that the prior allows, and their fits."""
    for wave in waves:
        try:
            yield wave, fit_wave(task, wave.vector)
        except NoPlaceError:
            continue


def _draws_of(task: Task, wave: Wave, first: Wave, rng: np.random.Generator) -> xr.Dataset:
    """Estimate a second wave of a clip whose first system is already estimated."""
    fits = list(_fits(task, [wave]))
    if not fits:
        return xr.Dataset()
    fit = fits[0][1]
    if fit.geometry.along < MIN_ALONG * np.hypot(fit.geometry.along, fit.geometry.across):
        return xr.Dataset()
    points, _, done = draw_points(fit, task.settings, rng)
    if not done:  # too weak to be estimated from the clip
        return xr.Dataset()
    fraction = ripple_extent(task.image, fit.phase.wave).fraction
    return _labelled(points, fit, task.image, (_crossing(wave, first), fraction), rng)


def _crossing(wave: Wave, other: Wave | None) -> float:
    """Error of log A_H due to crossing crests, from their contrast energy over the wave's own.

    Each system is estimated as if alone, with a pulse that the other one blurs, which lowers A_H by
    about as much (a wave of 0.6 cycles/m and 0.07 m under one of 1.0 and 0.025: 0.034 and 0.039 m
    at energies of 0.10 and 0.03).
    """
    return 0.0 if other is None else CROSSING * float(np.sqrt(min(other.energy / wave.energy, 1.0)))


def _candidates(waves: list[Wave]) -> list[Wave]:
    """Waves to fit: the strongest that passes, and one of about half or double its frequency."""
    passed = [w for w in waves if w.probability > PRESENT]
    if not passed:
        return []
    first = max(passed, key=lambda w: w.energy)
    others = [w for w in passed if w.energy > RIVAL * first.energy and _harmonic(w, first)]
    return [first, *others[:1]]


def second_system(waves: list[Wave], first: FloatArray) -> Wave | None:
    """Return the likeliest wave of a second system, if there is one.

    Parameters
    ----------
    waves : list of Wave
        The likeliest first.
    first : ndarray (2,)
        Wave vector (east, north) of the first system, cycles/m.

    Returns
    -------
    Wave or None
        A wave of the whole clip (those of its parts belong to a first system that bends), either in
        another direction or in the same one at another wavelength that is not a harmonic.
    """
    most = max((wave.energy for wave in waves), default=0.0)
    for wave in waves:
        ratio, cosine = compared(wave.vector, first)
        # shadow broadens and shifts overtones
        faint = ratio > SHORTER and wave.energy < FAINT * most
        overtone = cosine > OVERTONE and (faint or abs(ratio - round(ratio)) < 0.1 * ratio)
        other = cosine < ANOTHER or (abs(np.log(ratio)) > LONGER and not overtone)
        likely = wave.whole and wave.probability > PRESENT and wave.energy > LEAST_SECOND * most
        if likely and other:
            return wave
    return None


def _harmonic(wave: Wave, first: Wave) -> bool:
    """Whether a wave has about half or twice the frequency of another in the same direction."""
    ratio, cosine = compared(wave.vector, first.vector)
    return bool(cosine > 0.97 and (abs(ratio - 0.5) < 0.06 or abs(ratio - 2) < 0.2))


def draw_points(
    fit: Fit, settings: RippleSettings, rng: np.random.Generator
) -> tuple[FloatArray, float, bool]:
    """Draw sampling coordinates (chain, draw, COORDINATES) from the posterior about a fit.

    Returns the accepted fraction and whether the chains converged as well.
    """
    free, integrated = free_coordinates(fit.geometry), integrated_coordinates(fit)
    sampled = np.setdiff1d(free, integrated)
    keep = np.ix_(*[np.isin(free, sampled)] * 2)
    peaks = []
    for peak in fit.peaks:
        z = fit.z.copy()
        z[sampled] = peak.z[sampled]
        peaks.append(Peak(z, peak.level, peak.covariance[keep]))
    fit = with_integrated(fit, integrated)
    ridge = along_ridges(peaks, fit.data, fit.geometry, sampled)
    coordinates = Coordinates(ridge, fit.geometry, sampled)
    rest = coordinates.to_sampling(fit.z)

    def whole(points: FloatArray) -> FloatArray:
        every = np.broadcast_to(rest, (*points.shape[:-1], COORDINATES)).copy()
        every[..., sampled] = points
        return coordinates.from_sampling(every)

    def log_density(points: FloatArray) -> FloatArray:
        return np.asarray(log_posteriors(whole(points), fit.data, fit.geometry))

    proposal = mixture_of_peaks([(p.z[sampled], p.covariance, p.level) for p in coordinates.peaks])

    def suffice(draws: FloatArray) -> bool:
        return converged(named_parameters(whole(draws), fit.geometry)["height"])

    chains, done = sample(log_density, proposal, suffice, settings.chains, settings.draws, rng)
    return with_drawn(whole(chains.draws), fit, integrated, rng), chains.accepted, done


def _labelled(
    points: FloatArray,
    fit: Fit,
    image: Image,
    beside: tuple[float, float],
    rng: np.random.Generator,
) -> xr.Dataset:
    """Convert draws of the coordinates to named quantities, with the errors added after sampling.

    `beside` is the error of log A_H due to crossing crests, and the rippled share of the clip.
    """
    crossing, fraction = beside
    shape = points.shape[:2]
    named = named_parameters(points, fit.geometry)
    across = fit.across[0] + fit.across[1] * rng.standard_normal(shape)
    named.pop("wave_offset")
    slope, lag, tilt = _slopes(points, fit)
    # what A_H differs by from the draws turns the phase as well
    error = _added_error(fit, named["height"], crossing)
    low = min(TOO_LOW * _unlike(fit), MOST_LOW)
    change = low + error * rng.standard_normal(shape) - 0.5 * error**2
    slope = slope + line_of_lags(lag_per_height(fit), fit.data)[0] / (2 * np.pi) * change
    along = fit.geometry.along + slope + tilt * rng.standard_normal(shape)
    stretch = 1 + _stretch(fit, image, fraction) * rng.standard_normal(shape)
    along, across = along * stretch, across * stretch
    cycles = fit.phase.middle + named["phase"] / (2 * np.pi) + lag
    # a pulse depends on A_H times the wave number; it was rendered with that of the fit
    height = named["height"] * np.exp(change) * (fit.geometry.along + fit.z[OFFSET]) / along
    named["height"] = np.clip(height, fit.geometry.height_least, fit.geometry.height_most)
    azimuth = image.azimuth + np.degrees(np.arctan2(across, along))
    turns = np.floor(azimuth.mean() / 180.0)
    # the same crests, with the phase counted in the opposite direction
    named["phase"] = 2 * np.pi * ((0.5 - cycles if turns % 2 else cycles) % 1.0)
    frequency = np.hypot(along, across)
    return dataset({"frequency": frequency, "azimuth": azimuth - 180.0 * turns, **named})


def _added_error(fit: Fit, height: FloatArray, crossing: float) -> float:
    """Error of log A_H to add to draws, which leaves no less known than a part of the prior."""
    known = min(fit.geometry.steepness_sd, fit.geometry.height_sd / float(height.mean()))
    most = (UNKNOWN * known) ** 2 - float(np.log(height).var())
    return float(min(np.hypot(_height_error(fit), crossing), np.sqrt(max(most, 0.0))))


def _height_error(fit: Fit) -> float:
    """Error of log A_H where the image contains something that the model lacks."""
    largest, per_log = MISFIT
    other = per_log * max(np.log(fit.noise_factor / largest), 0.0)
    return float(np.hypot(VARYING * _unlike(fit), other))


def _unlike(fit: Fit) -> float:
    """Spread of log A_H from place to place beyond that of equal waves."""
    return max(fit.unlike - ONE_HEIGHT, 0.0)


def _stretch(fit: Fit, image: Image, fraction: float) -> float:
    """Relative error of f due to heights that vary from wave to wave and to an edge of the ripples.

    A higher wave casts a longer shadow and leans farther, which turns the image's phase there; at
    an edge of the ripples the mean intensity has a step, which turns the phase of the last wave.
    """
    side = image.pixel_size * np.sqrt(np.count_nonzero(image.valid))
    waves = max(side * (abs(fit.geometry.along) + abs(fit.geometry.across)), 1.0)
    whole, cut = FILLED
    turn = EDGE_TURN * np.clip((whole - fraction) / (whole - cut), 0.0, 1.0)
    edge = turn / max(waves * fraction, 1.0)
    # error of the slope of a line fitted to the phases of so many waves
    return float(np.hypot(edge, _turn_of_heights(fit) * np.sqrt(12 / waves) / waves))


def _turn_of_heights(fit: Fit) -> float:
    """Spread of the image's phase from wave to wave due to their heights, cycles."""
    spread = OF_WAVES * _unlike(fit) if fit.phase.rigid else 0.0
    if spread == 0.0:
        return 0.0
    return float(spread * np.sqrt(np.mean(lag_per_height(fit) ** 2)) / (2 * np.pi))


def _slopes(points: FloatArray, fit: Fit) -> tuple[FloatArray, FloatArray, float]:
    """Compute the wave number and phase that each draw's shadow, lean and errors make of the fit's.

    Returns
    -------
    slope, centre : ndarray (chains, draws)
        What is added to the fit's wave number along the look, cycles/m, and to the phase at the
        clip's centre, cycles.
    sd : float
        Standard deviation of the first given a draw, cycles/m.

    Notes
    -----
    Errors of law and profile turn the image's phase as well; with straight crests the image tells
    them together with its wave number. `added` is the variance of their sum without that of the
    wave number given the errors, for which the fit's tilt is taken: errors that all ranges share
    would widen it, though they do not tilt the phase.
    """
    turned, joint = turned_by_errors(fit), fit
    added = float(turned @ turned)
    if fit.phase.rigid:
        joint = with_integrated(fit, np.array([OFFSET, PHASE]))
        turned = np.append(turned, [fit.geometry.wave_sd, 0.0])
        gain = error_gain(joint.data)
        alone = np.linalg.inv(np.linalg.inv(gain)[-2:, -2:])[0, 0] * fit.geometry.wave_sd**2
        added = float(turned @ gain @ turned - alone)

    def line(z: FloatArray) -> FloatArray:
        z = z.copy()
        z[[OFFSET, PHASE]] = fit.z[[OFFSET, PHASE]]
        slope, centre = line_of_lags(pulses_at(fit, z)[1], fit.data)
        told = 0.0
        if fit.phase.rigid:
            told = fit.z[OFFSET] + float(turned @ fitted_amplitudes(joint, expected_at(fit, z)[0]))
        return np.array([slope / (2 * np.pi) + told, centre / (2 * np.pi)])

    lags = learned(points, line, np.arange(COORDINATES))
    return lags[..., 0], lags[..., 1], float(np.sqrt(max(fit.tilt**2 + added, 0.0)))


def _judged(draws: xr.Dataset, done: bool, image: Image) -> Quality:
    """Quality of a sampled clip.

    `done` says that the chains converged; beside errors added to their draws it may suffice that
    these have.
    """
    along = np.abs(np.cos(np.radians(draws["azimuth"].values - image.azimuth)))
    if np.quantile(along, 0.05) < MIN_ALONG:
        return Quality.NOT_IDENTIFIABLE
    height = draws["height"].values
    sure = done or (np.ptp(height) > 0 and converged(height))  # all may lie at a bound
    return Quality.GOOD if sure else Quality.NOT_CONVERGED


def _left_out(fit: Fit) -> LeftOut:
    left_out = NOTHING
    if fit.phase.rigid:
        left_out |= LeftOut.PHASE_FIELD
    if fit.geometry.shadow == 0:
        left_out |= LeftOut.SHADOW
    return left_out


def _published(clip: Clip, prior: Prior, rng: np.random.Generator) -> Posterior:
    draws, acceptance = sample_published(clip, prior, rng)
    return Posterior(
        Quality.NOT_CONVERGED,  # one chain cannot show that it converged
        prior,
        dataset({"frequency": draws[..., 0], "height": draws[..., 1]}),
        acceptance,
        LeftOut.PRESENCE_TEST | LeftOut.ORIENTATION | LeftOut.PHASE_FIELD,
    )
