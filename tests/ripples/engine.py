"""Engine parts that tests build by hand: geometries, histograms without noise, coherent clips."""

from functools import cache
from types import SimpleNamespace

import numpy as np

from sasmap.ripples.demodulation import demodulate
from sasmap.ripples.fit import ANY_PHASE, Task, clip_geometry, fit_wave
from sasmap.ripples.histogram import histogram
from sasmap.ripples.image import as_image
from sasmap.ripples.optimise import fisher_scoring, search
from sasmap.ripples.phase import straight
from sasmap.ripples.priors import Prior
from sasmap.ripples.rendered import Fit
from sasmap.ripples.rendering import (
    LAW_KNOTS,
    LINE_OF_SIGHT,
    Geometry,
    Histogram,
    Parameters,
    fill_expected,
    line_of_lags,
    pulses_of,
)
from sasmap.ripples.settings import RippleSettings
from sasmap.simulate import coherent_cell

SHAPE, BINS = (200, 200), 48
LAMBERT, GAUSSIAN = (2.0, 0.0), (0.0, 3 / np.pi)


def ripple(height, law=LAMBERT, **changes):
    """Parameters of a sine without noise or blur."""
    plain = Parameters(0.0, 0.0, height, *law, 0.0, 0.0, 1e-9, 1.0, 1e-6, 1.0)
    return plain._replace(**changes)


def geometry(along, ground_range, altitude, **changes):
    """A geometry with everything estimated and natural priors."""
    prior = Prior.natural((0.05, 5.0), (0.0, 0.5))
    made = Geometry(
        along=along,
        across=0.0,
        range_middle=ground_range,
        altitude_middle=altitude,
        altitude_sd=0.02,
        expected_blur=0.02,
        wave_sd=0.05,
        phase_sd=ANY_PHASE,
        bent=False,
        published=False,
        shadow=LINE_OF_SIGHT,
        law_error=np.zeros(LAW_KNOTS.size),
        third_harmonic=np.zeros(2),
        fixed=np.full(4, np.nan),
        height_mean=0.25,
        height_sd=np.inf,
        height_least=0.0,
        height_most=0.5,
        steepness_middle=prior.steepness[0],
        steepness_sd=prior.steepness[1],
    )
    return made._replace(**changes)


def empty(ground_range, altitude, bins=64, count=400.0, group=None, offset=0.0):
    """A histogram of bins that are all as full, at ranges, without intensity yet."""
    ground_range = np.atleast_1d(np.asarray(ground_range, float))
    shape = (ground_range.size, bins)
    return Histogram(
        np.full(shape, count),
        np.zeros(shape),
        np.full(shape, offset),
        np.zeros(shape),
        ground_range - ground_range.mean(),
        ground_range,
        np.full(shape[0], altitude),
        np.ones(shape[0]),
        np.zeros(shape[0], np.int64) if group is None else np.asarray(group, np.int64),
        np.zeros((0, *shape)),
        np.zeros((0, 0)),
        np.zeros(0),
        1.0,
        np.zeros(0),
        np.ones(shape),
    )


def noiseless(truth, data, where):
    """The histogram that a ripple is expected to make, gain 1."""
    pulses, _ = pulses_of(truth, data, where)
    sums = np.ones_like(data.pixel_count)
    means, gains = np.empty(sums.shape), np.empty(len(sums))
    full = data._replace(intensity_sum=sums * data.pixel_count * pulses)
    fill_expected(truth, full, where, means, gains)
    # the gain is that of these sums; what is expected at it reproduces itself
    full = data._replace(intensity_sum=data.pixel_count * means / gains[:, None])
    fill_expected(truth, full, where, means, gains)
    return data._replace(intensity_sum=data.pixel_count * means)


def as_imaged(truth, data, where):
    """Parameters that show the pulses of a ripple at its own phase, not at its image's."""
    slope, centre = line_of_lags(pulses_of(truth, data, where)[1], data)
    offset = -slope / (2 * np.pi)
    height = truth.height * where.along / (where.along + offset)
    return truth._replace(wave_offset=offset, phase=-centre, height=height)


def harmonic(pulse, k):
    """Complex amplitude of a pulse's k-th harmonic over its mean: of cos(2 pi k place - angle)."""
    place = (np.arange(pulse.size) + 0.5) / pulse.size
    return 2 * np.mean(pulse * np.exp(2j * np.pi * k * place)) / pulse.mean()


def coherent(seed, law="lambert", height=0.08, frequency=0.62, near=12.0, **changes):
    """A coherent cell of straight crests looked at square-on, and what is true of it."""
    given = {"altitude": 5.0, "pixel_size": 0.05, "shape": (260, 260)} | changes
    rng = np.random.default_rng(seed)
    return coherent_cell(rng, frequency=frequency, height=height, near=near, law=law, **given)


def summed(clip, wave, settings=None, origin=None, trend=None):
    """An image, its task, straight phase, histogram at a wave and geometry."""
    image = as_image(clip)
    settings = settings or RippleSettings()
    task = Task(image, settings, Prior.natural(settings.frequency, settings.height), 0.02)
    boxes = demodulate(image, wave)
    phase = straight(image, boxes)
    if origin is not None:
        phase = type(phase)(**{**vars(phase), "origin": origin})
    level = boxes.trend if trend is None else np.full(boxes.trend.shape, trend)
    data = histogram(image, level, phase)
    return image, task, phase, data, clip_geometry(task, phase, data)


@cache
def fitted_cell(seed, turn, **changes):
    """A cell whose crest normals are turned from the look, its image and a fit to it."""
    changes = {"near": 14.0, "frequency": 0.9, "height": 0.06, "shape": SHAPE} | changes
    made = coherent(seed, azimuth_off_look=turn, **changes)
    _, task, *_ = summed(made.clip, made.wave)
    return made, task.image, fit_wave(task, made.wave)


def fit_of(groups, misfit, rigid=True, height=0.02, noise=0.01, **changes):
    """A fit to ripples, shallow ones if not said, whose intensity is off by (groups, bins)."""
    reach = 12.0 + 0.5 * np.arange(4 * groups)
    where = geometry(0.6, float(reach.mean()), 6.0, expected_blur=0.03, **changes)
    group = np.repeat(np.arange(groups), 4).astype(np.int64)
    truth = ripple(height, LAMBERT, blur=0.03, noise=noise, noise_slope=1.0)
    data = noiseless(truth, empty(reach, 6.0, bins=BINS, count=500.0, group=group), where)
    peak = fisher_scoring(search(data, where)[0].z, data, where)
    data = data._replace(intensity_sum=data.intensity_sum * misfit[group])
    phase = SimpleNamespace(rigid=rigid, wave_sd=np.zeros(2), shape=(400, 400))
    return Fit(phase, None, data, where, [peak])
