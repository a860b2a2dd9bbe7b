"""Ripples that may be bands of gain: crests along the track, wavelength varying with range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sasmap.passes.fusion import FusedCell
from sasmap.passes.summary import Summary
from sasmap.run.plan import Swath

# Degrees between crest normal and look below which crests run along the track; relative difference
# of f below which two cells have the same f, and of range above which they are apart (choices:
# bands of a beam pattern follow the grazing angle, so that f varies with the square of the range).
ALONG, SAME, APART = 1.5, 0.03, 0.25


class _Seen(NamedTuple):
    """A rippled look: crest normal off the look (degrees), range (m) and f (cycles/m)."""

    off: float
    distance: float
    frequency: float


def bands_or_ripples(
    cells: Mapping[tuple[int, int], Sequence[Summary | None]],
    fused: Mapping[tuple[int, int], FusedCell],
    swaths: Sequence[Swath],
) -> str:
    """Warn that all ripples of a survey may be bands of gain over range; empty where not.

    Parameters
    ----------
    cells : mapping of (row, column) to sequence of Summary or None
        One per swath.
    fused : mapping of (row, column) to FusedCell
    swaths : sequence of Swath

    Returns
    -------
    str
    """
    looks = [
        _seen(summary, swaths[k])
        for cell, chain in fused.items()
        for k in chain.group
        if (summary := cells[cell][k]) is not None
    ]
    if not looks or any(abs(look.off) > ALONG for look in looks):
        return ""
    if any(_alike(a, b) for a in looks for b in looks):
        return ""
    cells_with = sum(bool(chain.group) for chain in fused.values())
    return (
        f"ripples: in all {cells_with} rippled cells the crests run along the track to "
        f"within {ALONG:g} degrees: bands of gain, beam pattern or multipath over range look the "
        "same; a pass of another heading would tell"
    )


def _seen(summary: Summary, swath: Swath) -> _Seen:
    place = swath.sonar_pass.track.locate(*(np.array([v]) for v in summary.centre))
    off = (summary.azimuth[0] - float(place.look_azimuth[0]) + 90) % 180 - 90
    return _Seen(off, float(place.distance[0]), summary.mean[0])


def _alike(one: _Seen, other: _Seen) -> bool:
    """Whether two looks at different ranges have the same f, as for ripples but not for bands."""
    apart = abs(one.distance / other.distance - 1) > APART
    return apart and abs(one.frequency / other.frequency - 1) < SAME
