"""Colours of class rasters, styles and the report.

All are distinct for colour-blind readers: categories after Okabe and Ito, ramps perceptually
uniform, the azimuth's ramp cyclic.
"""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np

from sasmap.catalogue import Ramp
from sasmap.ripples.posterior import Quality

Colour = tuple[int, int, int]

CLASS_COLOURS: tuple[Colour, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
    (140, 140, 140),
)
QUALITY_COLOURS: dict[Quality, Colour] = {
    Quality.GOOD: (0, 158, 115),
    Quality.NO_RIPPLES: (200, 200, 200),
    Quality.NOT_CONVERGED: (230, 159, 0),
    Quality.CONTRADICTION: (204, 121, 167),
    Quality.NOT_IDENTIFIABLE: (86, 180, 233),
    Quality.TOO_FEW_PIXELS: (240, 228, 66),
    Quality.FAILED: (213, 94, 0),
}
# Factor by which the colours are darkened when they repeat; number of colours along a ramp (a
# choice).
SHADE = 0.7
STOPS = 9


def class_colour(k: int) -> Colour:
    """Colour of the k-th class, from 0."""
    shade = SHADE ** (k // len(CLASS_COLOURS))
    red, green, blue = CLASS_COLOURS[k % len(CLASS_COLOURS)]
    return int(shade * red), int(shade * green), int(shade * blue)


def stops(ramp: Ramp, low: float, high: float, count: int = STOPS) -> list[tuple[float, Colour]]:
    """Values and colours along a ramp.

    Parameters
    ----------
    ramp : Ramp
    low, high : float
    count : int

    Returns
    -------
    list of (float, colour)
    """
    colours = mpl.colormaps[ramp.name](np.linspace(0, 1, count))[:, :3]
    values = np.linspace(low, high, count)
    return [(float(v), _whole(c)) for v, c in zip(values, colours, strict=True)]


def _whole(colour: Sequence[float]) -> Colour:
    red, green, blue = (round(255 * float(v)) for v in colour)
    return red, green, blue


def hexadecimal(colour: Colour) -> str:
    """Write a colour as #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def colour_at(ramp: Ramp, low: float, high: float, value: float) -> Colour:
    """Colour of a value along a ramp from low to high; values beyond are clipped."""
    place = (value - low) / (high - low) if high > low else 0.5
    return _whole(mpl.colormaps[ramp.name](float(np.clip(place, 0, 1)))[:3])
