"""What a worker does: one look at one cell, from pixels to a finished result in the store."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import shapely
import xarray as xr
from numpy.typing import NDArray

from sasmap.errors import fault_of
from sasmap.ripples.clip import Clip
from sasmap.ripples.estimation import estimate
from sasmap.ripples.fusion import next_prior
from sasmap.ripples.posterior import LeftOut, Posterior, Quality
from sasmap.ripples.priors import Prior
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.summary import Summary, summarise
from sasmap.run.plan import Plan, Swath
from sasmap.run.store import Store, code_version, digest
from sasmap.survey.cells import Cell
from sasmap.survey.navigation import Track
from sasmap.survey.passes import Side, read_clip
from sasmap.survey.placement import on_cell

MIN_VALID = 0.25


class LookResult(NamedTuple):
    """What became of one look at one cell: a summary, or why there is none."""

    summary: Summary | None
    fault: str | None
    computed: bool
    key: str | None = None  # of the result in the store


class Context(NamedTuple):
    """What all tasks of a run share."""

    plan: Plan
    store: Store


def run_cell(context: Context, cell: Cell) -> list[LookResult]:
    """Estimate all looks at a cell, or take their finished results. Never raises.

    Parameters
    ----------
    context : Context
    cell : Cell

    Returns
    -------
    list of LookResult
        Of each look that shows the cell, in their order.
    """
    settings = context.plan.settings.ripples
    assert settings is not None
    results: list[LookResult] = []
    for k in context.plan.cells[cell]:
        earlier = _earlier([r.summary for r in results], settings)
        try:
            results.append(_look(context, cell, k, earlier))
        except Exception as error:  # one cell's fault must not end the survey
            results.append(LookResult(None, fault_of(error), True))
    return results


def _earlier(summaries: Sequence[Summary | None], settings: RippleSettings) -> list[Summary]:
    """Return the looks that the next starts from: none by default."""
    return [s for s in summaries if s is not None] if settings.method == "zare-cobb" else []


def _look(context: Context, cell: Cell, k: int, earlier: list[Summary]) -> LookResult:
    plan, store = context
    look = plan.swaths[k]
    settings = ripple_settings(plan)
    prior = next_prior(earlier, settings)
    key = _key(plan, cell, look, [prior.mean, prior.sd])
    kept = store.load(key)
    if kept is not None:
        return LookResult(kept, None, False, key)
    clip = clip_of(plan, cell, look, look.side)
    pixels = None if clip is None else Clip.from_array(clip)
    arrays: dict[str, NDArray[Any]] = {}
    if clip is None or pixels is None:
        summary = Summary(Quality.NO_DATA, LeftOut.SAMPLING)
    elif _shown(plan, cell, look, clip) < MIN_VALID:
        summary = Summary(Quality.TOO_FEW_PIXELS, LeftOut.SAMPLING)
    else:
        posterior = _estimated(plan, cell, look, pixels, settings, prior)
        summary = summarise(posterior)
        arrays = _modelled(plan, cell, pixels, posterior)
    if plan.settings.sediments is not None and pixels is not None:
        amplitude, cotangent = _floor(plan, cell, pixels)
        arrays |= {"amplitude": amplitude, "cotangent": cotangent}
    if arrays:
        store.save_arrays(key, arrays)
    store.save(key, summary)
    return LookResult(summary, None, True, key)


def _estimated(
    plan: Plan, cell: Cell, look: Swath, pixels: Clip, settings: RippleSettings, prior: Prior
) -> Posterior:
    rng = np.random.default_rng(_seed(plan.settings.seed, look, cell))
    return estimate(pixels, settings, rng=rng, prior=prior)


def estimate_again(
    context: Context, cell: Cell, k: int, summaries: Sequence[Summary | None]
) -> tuple[xr.DataArray | None, Posterior | None]:
    """Estimate a look once more, with its model: the same to the bit, for the report.

    Parameters
    ----------
    context : Context
    cell : Cell
    k : int
        Swath.
    summaries : sequence of Summary or None
        What the run found of each look at the cell.

    Returns
    -------
    clip : DataArray or None
    posterior : Posterior or None
        None where the look was not estimated.
    """
    plan = context.plan
    look = plan.swaths[k]
    clip = clip_of(plan, cell, look, look.side)
    summary = summaries[k]
    if clip is None or summary is None or summary.quality is Quality.TOO_FEW_PIXELS:
        return clip, None
    settings = ripple_settings(plan).model_copy(update={"keep_model": True})
    prior = next_prior(_earlier(summaries[:k], settings), settings)
    return clip, _estimated(plan, cell, look, Clip.from_array(clip), settings, prior)


def finished_looks(plan: Plan, store: Store) -> int:
    """Count the looks at cells that an earlier run has finished.

    With the published method only each cell's first: what the later ones depend on is not known.
    """
    settings = ripple_settings(plan)
    prior = next_prior([], settings)
    known = [prior.mean, prior.sd]
    first = settings.method == "zare-cobb"
    pairs = ((c, k) for c, looks in plan.cells.items() for k in (looks[:1] if first else looks))
    keys = (_key(plan, cell, plan.swaths[k], known) for cell, k in pairs)
    return sum(store.path(key).exists() for key in keys)


def _modelled(
    plan: Plan, cell: Cell, clip: Clip, posterior: Posterior
) -> dict[str, NDArray[np.float32]]:
    """Modelled amplitude on a cell's own pixels, if it is kept."""
    settings = plan.settings.ripples
    assert settings is not None
    place = plan.opened.grid, cell, plan.settings.window
    found = {}
    if settings.keep_model and posterior.model is not None:
        found["model"] = on_cell(clip, posterior.model, *place)
    return found


def _floor(plan: Plan, cell: Cell, pixels: Clip) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
    """Amplitude and cotangent of grazing on a cell's own pixels."""
    place = plan.opened.grid, cell, plan.settings.window
    known = np.where(pixels.valid, pixels.amplitude, np.nan)
    amplitude = on_cell(pixels, known, *place)
    cotangent = on_cell(pixels, pixels.ground_range / pixels.altitude, *place)
    return amplitude.astype(np.float32), np.minimum(cotangent, 6e4).astype(np.float16)


def ripple_settings(plan: Plan) -> RippleSettings:
    """Return settings of the estimates."""
    settings = plan.settings.ripples
    assert settings is not None
    return settings


def clip_of(plan: Plan, cell: Cell, look: Swath, side: Side) -> xr.DataArray | None:
    """Read what one side of a look's pass shows of a cell."""
    tiles = plan.tiles[look.sonar_pass.name].get(cell, ())
    return read_clip(look.sonar_pass, plan.opened.grid, cell, side, tiles)


def _shown(plan: Plan, cell: Cell, look: Swath, clip: xr.DataArray) -> float:
    """Fraction of a cell that a look's pass shows, its other side included if that matters."""

    def fraction(part: xr.DataArray | None) -> float:
        if part is None:
            return 0.0
        area = int(np.isfinite(part.values).sum()) * part.attrs["pixel_size"] ** 2
        return float(area / plan.opened.grid.size**2)

    shown = fraction(clip)
    for side in look.sonar_pass.sides:
        if side != look.side and shown < MIN_VALID:
            shown += fraction(clip_of(plan, cell, look, side))
    return shown


def _seed(seed: int, look: Swath, cell: Cell) -> np.random.SeedSequence:
    # the pass by its name, so that a pass added or moved in the list changes no other
    name = int(digest(look.label)[:16], 16)
    return np.random.SeedSequence([seed, name, cell.row, cell.column])


def _key(plan: Plan, cell: Cell, look: Swath, prior: list[Any]) -> str:
    grid, sonar_pass = plan.opened.grid, look.sonar_pass
    tiles = plan.tiles[sonar_pass.name].get(cell, ())
    return digest(
        {
            "code": code_version(),
            "seed": plan.settings.seed,
            "settings": _dumped(plan),
            "grid": [grid.crs, repr(grid.left), repr(grid.top), repr(grid.size)],
            "cell": list(cell),
            "pass": [look.label, look.side, sonar_pass.slant, repr(sonar_pass.altitude_sd)],
            "numbers": [tile.kind for tile in tiles],
            "excluded": excluded_hash(plan, cell),
            "tiles": [plan.hashes[tile.path] for tile in tiles],
            "track": track_hash(sonar_pass.track),
            "prior": repr(prior),
        }
    )


def excluded_hash(plan: Plan, cell: Cell | None) -> str | None:
    """Hash what is left out of a cell, or of the survey; None where nothing is."""
    excluded = plan.opened.excluded
    if excluded is None:
        return None
    if cell is None:
        return digest(excluded.wkb_hex)
    # what lies within a pixel of the cell
    grid = plan.opened.grid
    square = shapely.box(*grid.bounds(cell)).buffer(grid.size / plan.settings.window)
    return digest(excluded.wkb_hex) if excluded.intersects(square) else None


def _dumped(plan: Plan) -> list[Any]:
    settings = plan.settings.ripples
    assert settings is not None
    return [settings.model_dump(mode="json"), plan.settings.sediments is not None]


@lru_cache(maxsize=1024)
def track_hash(track: Track) -> str:
    """Hash a track's positions and altitudes."""
    state = hashlib.sha256()
    for values in (track.x, track.y, track.altitude):
        state.update(values.tobytes())
    return state.hexdigest()


def read_floor(
    context: Context, cell: Cell, k: int, key: str | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Read amplitude and cotangent of grazing on a cell's own pixels.

    Parameters
    ----------
    context : Context
    cell : Cell
    k : int
        Swath.
    key : str or None
        Under which the ripple stage kept them, if it did.

    Returns
    -------
    tuple of ndarray (window, window) or None
        None where the look does not show the cell.

    Raises
    ------
    OSError
        Where a block of a tile cannot be decoded.
    """
    plan, store = context
    look = plan.swaths[k]
    if k not in plan.cells.get(cell, ()):
        return None
    kept = store.load_arrays(key, ("amplitude", "cotangent")) if key is not None else None
    if kept is not None:
        return kept[0].astype(float), kept[1].astype(float)
    clip = clip_of(plan, cell, look, look.side)
    if clip is None:
        return None
    amplitude, cotangent = _floor(plan, cell, Clip.from_array(clip))
    return amplitude.astype(float), cotangent.astype(float)
