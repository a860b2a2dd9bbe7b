"""Map of sediment classes: likelihoods, a Potts field that does not smear edges, a sieve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from sasmap.arrays import BoolArray
from sasmap.sediments.classes import Classes
from sasmap.sediments.field import (
    likeliest,
    mean_field,
    softmax,
    table_sums,
    window_means,
    window_sums,
)
from sasmap.sediments.patches import patches, rims
from sasmap.sediments.texture import Texture, channels, evidence
from sasmap.sediments.trends import AmplitudeGrid

GRID = 1024
# Potts field: side of its window in pixels, its strength in nats where all neighbours agree, and
# mean-field iterations.
FIELD, STRENGTH, ROUNDS = 9, 9.0, 12
FIRST_WINDOW = 13
# Side in pixels of the window whose darkness decides what is not sediment in a textured bed.
DARK_WINDOW = 17
# Smallest patch that the map shows, in pixels.
SMALLEST = 300


def log_likelihoods(looks: Sequence[AmplitudeGrid], classes: Classes) -> NDArray[np.float32]:
    """Compute the log likelihood of each class at each pixel, over all looks.

    Where the survey has a law for areas that are not sediment, its log likelihood comes last.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
    classes : Classes

    Returns
    -------
    ndarray (classes, rows, columns)
        Divided by the noise factor, as for independent samples; NaN where no look shows a pixel.
    """
    if classes.texture is not None:
        return _with_texture(looks, classes, classes.texture)
    return _of_pixels(looks, classes)


def _of_pixels(looks: Sequence[AmplitudeGrid], classes: Classes) -> NDArray[np.float32]:
    """Log likelihoods under amplitude laws."""
    shape = looks[0].amplitude.shape
    result = np.zeros((len(classes.every), *shape), np.float32)
    seen = np.zeros(shape, bool)
    laws = classes.every
    top = max(law.mean_square for law in laws) ** 0.5
    grid, step = np.linspace(np.log(1e-5 * top), np.log(50 * top), GRID, retstep=True)
    table = np.stack([law.log_density(np.exp(grid)) for law in laws])
    for i, look in enumerate(looks):
        logs = _logs(look)
        if logs is not None:
            logs -= classes.log_trend(i, look.cotangent, look.altitude)  # NaN in the water column
            table_sums(logs, table, grid[0], float(step), 1 / classes.noise_factor, result, seen)
    if not seen.all():
        result[:, ~seen] = np.nan
    return result


def _logs(look: AmplitudeGrid) -> NDArray[np.float32] | None:
    """Log amplitude, NaN where there is none; None if there is none anywhere."""
    known = look.amplitude > 0
    if not known.any():
        return None
    logs = np.full(known.shape, np.nan, np.float32)
    np.log(look.amplitude, out=logs, where=known)
    return logs


def _with_texture(
    looks: Sequence[AmplitudeGrid], classes: Classes, texture: Texture
) -> NDArray[np.float32]:
    """Log odds by laws at several scales; looks see the same texture, so they are averaged."""
    shape = looks[0].amplitude.shape
    result = np.zeros((len(classes.every), *shape), np.float32)
    seen = np.zeros(shape, np.float32)
    for i, look in enumerate(looks):
        logs = _logs(look)
        if logs is None:
            continue
        logs -= classes.log_trend(i, np.nan_to_num(look.cotangent, nan=1.0), look.altitude)
        known = np.isfinite(logs)
        odds = evidence(texture, channels(logs))
        result[: len(classes.laws)] += np.nan_to_num(odds)
        seen += known
    result /= np.maximum(seen, 1)
    if classes.dark is not None:
        # by amplitude: log likelihood ratio to the likeliest class, summed over a window
        level = np.nan_to_num(_of_pixels(looks, classes))
        darker = level[-1] - level[:-1].max(axis=0)
        around = uniform_filter(darker, DARK_WINDOW, mode="reflect") * DARK_WINDOW**2
        result[-1] = result[:-1].max(axis=0) + around
    result[:, seen == 0] = np.nan
    return result


def averaged(likelihood: NDArray[np.float32], mask: BoolArray, side: int) -> NDArray[np.float32]:
    """Average log likelihoods over squares, within the marked pixels only.

    Parameters
    ----------
    likelihood : ndarray (classes, rows, columns)
        NaN where no look shows a pixel.
    mask : ndarray of bool (rows, columns)
    side : int
        Pixels.

    Returns
    -------
    ndarray (classes, rows, columns)
    """
    there = mask & np.isfinite(likelihood[0])
    if not there.any():
        return likelihood
    result = likelihood.copy()
    window_means(likelihood, there, side, result)
    return result


def below_best(likelihood: NDArray[np.float32]) -> NDArray[np.float32]:
    """Subtract the best class from log likelihoods (classes, rows, columns); 0 where unknown."""
    level: NDArray[np.float32] = likelihood - likelihood.max(axis=0)
    unknown = np.isnan(level[0])
    if unknown.any():
        level[:, unknown] = 0.0
    return level


class ClassMap(NamedTuple):
    """A sediment map.

    Attributes
    ----------
    label : ndarray of uint8 (rows, columns)
        1 for the first class; 0 where no look shows the floor.
    probability : ndarray (rows, columns)
        Posterior probability of that class; NaN where there is none.
    """

    label: NDArray[np.uint8]
    probability: NDArray[np.float32]


def class_map(
    likelihood: NDArray[np.float32], count: int | None = None, whole: bool = True
) -> ClassMap:
    """Classify pixels.

    Parameters
    ----------
    likelihood : ndarray (classes, rows, columns)
        Of :func:`log_likelihoods`.
    count : int, optional
        Number of sediments; later classes are not sediment. Default all.
    whole : bool
        Whether the map ends at the edges; if not, small patches there may continue beyond.

    Returns
    -------
    ClassMap
    """
    seen = np.isfinite(likelihood[0])
    level = below_best(likelihood)
    if len(level) == 1:
        one = np.where(seen, 1.0, np.nan).astype(np.float32)
        return ClassMap(seen.astype(np.uint8), one)
    share = np.empty_like(level)
    window_sums(level, FIRST_WINDOW, share)
    softmax(share, seen)
    mean_field(level, seen, share, FIELD, STRENGTH, ROUNDS)
    label, highest = likeliest(share, seen)
    label = sieved(label, whole=whole)
    sediment = seen & (label <= (count or len(level)))
    chosen = np.where(sediment, highest, np.float32(np.nan))
    return ClassMap(np.where(sediment, label, 0).astype(np.uint8), chosen)


def sieved(
    label: NDArray[np.uint8],
    smallest: float = SMALLEST,
    whole: bool = True,
    among: BoolArray | None = None,
) -> NDArray[np.uint8]:
    """Assign patches of too few pixels to the nearest other class.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)
        0 for none.
    smallest : float
        Size in pixels of the smallest patch that stays.
    whole : bool
        Whether patches end at the edges; if not, those that touch them stay.
    among : ndarray of bool (rows, columns), optional
        Only patches with at least half their pixels here are reassigned. Default all.

    Returns
    -------
    ndarray of uint8 (rows, columns)
    """
    parts, size = patches(label)
    few = size < smallest
    if among is not None:
        few &= np.bincount(parts[among], minlength=size.size) >= 0.5 * size
    if not whole:
        for edge in (parts[0], parts[-1], parts[:, 0], parts[:, -1]):
            few[edge] = False
    few[0] = False
    if not few.any():
        return label
    lost = few[parts]
    # the nearest pixel lies on a rim
    rim = rims((label > 0) & ~lost)
    if not len(rim):
        return label
    nearest = rim[cKDTree(rim).query(np.argwhere(lost))[1]]
    result = label.copy()
    result[lost] = label[tuple(nearest.T)]
    return result
