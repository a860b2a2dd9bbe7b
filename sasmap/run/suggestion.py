"""Suggestion of a window from the wavelengths in some cells."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sasmap.ripples.clip import Clip
from sasmap.ripples.detection import find_waves
from sasmap.ripples.image import as_image
from sasmap.run.plan import Plan
from sasmap.run.task import WIDER, clip_of

# Looks that are examined (a choice: seconds of work), and minimum valid share of a window's pixels.
LOOKS, SHOWN = 12, 0.25
# Minimum and ideal number of wavelengths in a window (docs/guide.md); step of suggestions, pixels.
ENOUGH, WANTED, STEP = 5.0, 8.0, 10
# Window sides in cells that are tried in turn until one shows ripples: the last holds 3.5
# wavelengths where a cell holds half of one. Maximum side in pixels of those wider than a cell (a
# choice: seconds).
WINDOWS, LARGEST = (WIDER, 2 * WIDER, 4 * WIDER), 1200


def describe_window(plan: Plan) -> Iterator[str]:
    """Describe the wavelengths in some looks, and the window that holds eight of them.

    Parameters
    ----------
    plan : Plan

    Yields
    ------
    str
        A line; none where the survey estimates no ripples.

    Raises
    ------
    OSError
        Where a block of a tile cannot be decoded.
    """
    if plan.settings.ripples is None:
        return
    first = WIDER if WIDER * plan.settings.window <= LARGEST else 1.0
    lengths, seen = _wavelengths(plan, first)
    for cells in WINDOWS[1:]:
        if not lengths and cells * plan.settings.window <= LARGEST:
            lengths, _ = _wavelengths(plan, cells)
    if not lengths:
        yield f"window: no ripples in {seen} looks across the survey"
        return
    wavelength = float(np.median(lengths))
    pixel = plan.opened.grid.size / plan.settings.window
    wanted = int(np.ceil(WANTED * wavelength / pixel / STEP)) * STEP
    held = plan.opened.grid.size / wavelength
    about = f"window: wavelengths of about {wavelength:.2g} m in {len(lengths)} of {seen} looks"
    if held < ENOUGH:
        yield f"{about}: {plan.settings.window} px hold {held:.1f}; {wanted} px hold eight"
    else:
        yield f"{about}: {wanted} px hold eight, {plan.settings.window} px hold {held:.0f}"


def _wavelengths(plan: Plan, cells: float) -> tuple[list[float], int]:
    """Wavelengths (m) in looks with ripples, in windows `cells` cells wide; looks examined."""
    settings = plan.settings.ripples
    assert settings is not None
    pairs = [(cell, k) for cell, looks in plan.cells.items() for k in looks]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(LOOKS, len(pairs))).astype(int))
    lengths, seen = [], 0
    for cell, k in (pairs[i] for i in chosen):
        look = plan.swaths[k]
        array = clip_of(plan, cell, look, look.side, cells)
        clip = None if array is None else Clip.from_array(array)
        if clip is None or clip.valid.mean() < SHOWN or np.ptp(clip.amplitude[clip.valid]) == 0:
            continue
        seen += 1
        found = find_waves(as_image(clip), settings.frequency)
        if found.probability > 0.5:
            lengths.append(1 / float(np.hypot(*found.waves[0].vector)))
    return lengths, seen
