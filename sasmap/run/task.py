"""The task of a worker: one look at one cell, from pixels to a stored result."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import shapely
import xarray as xr
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.errors import fault_of
from sasmap.passes.fusion import next_prior
from sasmap.passes.summary import Summary, summarise
from sasmap.ripples.clip import Clip
from sasmap.ripples.detection import Unclear
from sasmap.ripples.estimation import MIN_PIXELS, estimate
from sasmap.ripples.extent import ripple_extent
from sasmap.ripples.image import as_image, on_clip
from sasmap.ripples.posterior import LeftOut, Posterior, Quality
from sasmap.ripples.priors import Prior
from sasmap.ripples.settings import RippleSettings
from sasmap.run.plan import Plan, Swath
from sasmap.run.store import Store, code_version, digest
from sasmap.survey.cells import Cell, CellGrid
from sasmap.survey.navigation import Track
from sasmap.survey.passes import Side, read_clip
from sasmap.survey.placement import on_cell
from sasmap.survey.tiles import Tile

MIN_VALID = 0.25
# Steps of the stored probability that a pixel is rippled, and the code of unobserved pixels: both
# fit into a byte.
CERTAIN, UNSEEN = 200, 255
# Side, in cells, of the window in which a wavelength too long for a cell is estimated.
WIDER = 2.0
# Step in pixels at which the position along the track is computed, for the floor alone: between
# them it is linear to 0.1 % of the distance or better, the resolution of the stored cotangents.
LOCATED = 8
# Maximum side in pixels of a modelled image, and draws per chain, stored for the report: as much as
# a figure can show.
PICTURE, DRAWS = 250, 100


class LookResult(NamedTuple):
    """Result of one look at one cell: a summary, or why there is none."""

    summary: Summary | None
    fault: str | None
    computed: bool
    key: str | None = None  # of the result in the store


class Context(NamedTuple):
    """Inputs common to all tasks of a run."""

    plan: Plan
    store: Store


def run_cell(context: Context, cell: Cell) -> list[LookResult]:
    """Estimate all looks at a cell, or load their stored results. Never raises.

    Parameters
    ----------
    context : Context
    cell : Cell

    Returns
    -------
    list of LookResult
        One per look that shows the cell, in order.
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
    """Return the looks that the next one is conditioned on: none by default."""
    return [s for s in summaries if s is not None] if settings.method == "zare-cobb" else []


def _look(context: Context, cell: Cell, k: int, earlier: list[Summary]) -> LookResult:
    plan = context.plan
    look = plan.swaths[k]
    prior = next_prior(earlier, ripple_settings(plan))
    key = _key(plan, cell, look, [prior.mean, prior.sd])
    result = _finished(context, cell, look, prior, key)
    if result.summary is None or result.summary.reason != Unclear.WAVES:
        return result
    # a wavelength too long for the cell: a larger window may show it
    around = sorted({t.path for t in tiles_around(plan, cell, look)})
    wide = _finished(
        context, cell, look, prior, digest([key, [plan.hashes[p] for p in around]]), WIDER
    )
    found = wide.summary is not None and np.isfinite(wide.summary.mean[0])
    return wide._replace(computed=wide.computed or result.computed) if found else result


def _finished(
    context: Context, cell: Cell, look: Swath, prior: Prior, key: str, window: float = 1.0
) -> LookResult:
    """Load a look's result from the store, or compute it, for a window `window` cells wide."""
    plan, store = context
    kept = store.load(key)
    if kept is not None:
        return LookResult(kept, None, False, key)
    clip = clip_of(plan, cell, look, look.side, window)
    pixels = None if clip is None else Clip.from_array(clip)
    arrays: dict[str, Any] = {}
    if clip is None or pixels is None:
        summary = Summary(Quality.NO_DATA, LeftOut.SAMPLING)
    elif window == 1 and _shown(plan, cell, look, clip) < MIN_VALID:
        summary = Summary(Quality.TOO_FEW_PIXELS, LeftOut.SAMPLING)
    else:
        posterior = _estimated(plan, cell, look, pixels, ripple_settings(plan), prior)
        summary = replace(summarise(posterior), window=window)
        arrays |= _modelled(plan, cell, pixels, posterior) | _pictured(posterior)
        if posterior.rippled is not None:
            arrays["rippled"] = _packed(plan, cell, pixels, posterior.rippled)
            arrays["reference"] = np.array(posterior.reference)
    if plan.settings.sediments is not None and pixels is not None and not plan.overlaps:
        arrays |= _floor(plan, cell, pixels)
    if arrays:
        store.save_arrays(key, arrays)
    store.save(key, summary)
    return LookResult(summary, None, True, key)


def _estimated(
    plan: Plan, cell: Cell, look: Swath, pixels: Clip, settings: RippleSettings, prior: Prior
) -> Posterior:
    rng = np.random.default_rng(_seed(plan.settings.seed, look, cell))
    return estimate(pixels, settings, rng=rng, prior=prior)


def try_look(plan: Plan, cell: Cell, k: int) -> None:
    """Estimate a look at a cell without storing it, for `plan` to time."""
    swath, settings = plan.swaths[k], ripple_settings(plan)
    clip = clip_of(plan, cell, swath, swath.side)
    if clip is None or _shown(plan, cell, swath, clip) < MIN_VALID:
        return
    pixels = Clip.from_array(clip)
    posterior = _estimated(plan, cell, swath, pixels, settings, next_prior([], settings))
    summarise(posterior)
    _modelled(plan, cell, pixels, posterior)


def finished_looks(plan: Plan, store: Store) -> int:
    """Count the looks that an earlier run has finished.

    With the published method only the first look of each cell: the later ones depend on results.
    """
    settings = ripple_settings(plan)
    prior = next_prior([], settings)
    known = [prior.mean, prior.sd]
    first = settings.method == "zare-cobb"
    pairs = ((c, k) for c, looks in plan.cells.items() for k in (looks[:1] if first else looks))
    keys = (_key(plan, cell, plan.swaths[k], known) for cell, k in pairs)
    return sum(store.path(key).exists() for key in keys)


def _modelled(plan: Plan, cell: Cell, clip: Clip, posterior: Posterior) -> dict[str, NDArray[Any]]:
    """Modelled amplitude on a cell's own pixels: reduced for the report, in full if it is kept."""
    settings = plan.settings.ripples
    assert settings is not None
    place = plan.opened.grid, cell, plan.settings.window
    found: dict[str, NDArray[Any]] = {}
    if posterior.model is not None:
        model = on_cell(clip, posterior.model, *place)
        found["picture"], found["picture_step"] = in_bytes(block_means(model, PICTURE))
        if settings.keep_model:
            found["model"] = model
    return found


def _pictured(posterior: Posterior) -> dict[str, NDArray[Any]]:
    """Draws for the report, thinned."""
    if not posterior.sampled:
        return {}
    step = max(1, -(-posterior.draws.sizes["draw"] // DRAWS))
    names = ("frequency", "height")
    return {name: posterior.draws[name].values[:, ::step].astype(np.float32) for name in names}


def block_means(image: NDArray[Any], most: int) -> NDArray[Any]:
    """Average an image (rows, columns) over squares, so that no side exceeds `most` pixels."""
    factor = max(1, -(-max(image.shape) // most))
    rows, columns = (-(-n // factor) for n in image.shape)
    padded = np.full((rows * factor, columns * factor), np.nan)
    padded[: image.shape[0], : image.shape[1]] = image
    squares = padded.reshape(rows, factor, columns, factor)
    known = np.isfinite(squares)
    count = known.sum(axis=(1, 3))
    total = np.where(known, squares, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def in_bytes(image: NDArray[Any]) -> tuple[NDArray[np.uint8], NDArray[Any]]:
    """Quantise an image of values of at least 0 to one byte per pixel; 0 stands for NaN.

    Returns the bytes and the step, so that the image is ``(bytes - 1) * step``.
    """
    known = np.isfinite(image)
    top = float(np.max(image, where=known, initial=0.0))
    step = top / 254 if top > 0 else 1.0
    values = np.where(known, 1 + np.rint(np.nan_to_num(image) / step), 0)
    return values.astype(np.uint8), np.array(step)


def _packed(plan: Plan, cell: Cell, clip: Clip, rippled: FloatArray) -> NDArray[np.uint8]:
    """Probability of rippled floor on a cell's own pixels, in steps of 1 / CERTAIN."""
    there = on_cell(clip, rippled, plan.opened.grid, cell, plan.settings.window)
    known = np.isfinite(there)
    steps = np.rint(CERTAIN * np.where(known, there, 0.0))
    return np.where(known, steps, UNSEEN).astype(np.uint8)


def extent_beside(
    context: Context, cell: Cell, k: int, references: Sequence[FloatArray]
) -> NDArray[np.uint8] | None:
    """Find how far ripples of neighbouring cells continue into one where none were found.

    Parameters
    ----------
    context : Context
    cell : Cell
    k : int
        Swath.
    references : sequence of ndarray (3,)
        `Posterior.reference` of the neighbouring cells.

    Returns
    -------
    ndarray of uint8 (window, window) or None
        As stored; None where the look does not show the cell.
    """
    plan = context.plan
    look = plan.swaths[k]
    array = clip_of(plan, cell, look, look.side) if k in plan.cells.get(cell, ()) else None
    if array is None:
        return None
    clip = Clip.from_array(array)
    if clip.valid.sum() < MIN_PIXELS or np.ptp(clip.amplitude[clip.valid]) == 0:
        return None
    image = as_image(clip)
    found = [ripple_extent(image, r[:2], float(r[2])).probability for r in references]
    return _packed(plan, cell, clip, on_clip(clip, image, np.max(found, axis=0)))


def _floor(plan: Plan, cell: Cell, pixels: Clip) -> dict[str, NDArray[Any]]:
    """Amplitude, cotangent of grazing and altitude on a cell's own pixels."""
    known = np.where(pixels.valid, pixels.amplitude, np.nan)
    layers = np.stack([known, pixels.ground_range / pixels.altitude, pixels.altitude])
    amplitude, cotangent, altitude = on_cell(
        pixels, layers, plan.opened.grid, cell, plan.settings.window
    )
    return {
        "amplitude": amplitude,
        "cotangent": np.minimum(cotangent, 6e4).astype(np.float16),
        "altitude": np.minimum(altitude, 6e4).astype(np.float16),
    }


def ripple_settings(plan: Plan) -> RippleSettings:
    """Return settings of the estimates; the report needs the modelled amplitude."""
    settings = plan.settings.ripples
    assert settings is not None
    return settings.model_copy(update={"keep_model": True})


def clip_of(
    plan: Plan, cell: Cell, look: Swath, side: Side, window: float = 1.0
) -> xr.DataArray | None:
    """Read a look's clip of a cell, or of a window around it that is `window` cells wide."""
    grid = plan.opened.grid
    if window == 1:
        tiles = plan.tiles[look.sonar_pass.name].get(cell, ())
        return read_clip(look.sonar_pass, grid, cell, side, tiles)
    left, _, _, top = grid.bounds(cell)
    before, size = 0.5 * (window - 1) * grid.size, window * grid.size
    square = CellGrid(grid.crs, left - before, top + before, size, 1, 1, size)
    return read_clip(
        look.sonar_pass, square, Cell(0, 0), side, tiles_around(plan, cell, look, window)
    )


def tiles_around(plan: Plan, cell: Cell, look: Swath, window: float = WIDER) -> tuple[Tile, ...]:
    """Tiles of a look's pass that show a window `window` cells wide around a cell, each once."""
    met, grid = plan.tiles[look.sonar_pass.name], plan.opened.grid
    reach = int(np.ceil(0.5 * (window - 1) * grid.size / grid.spacing - 1e-9))
    steps = range(-reach, reach + 1)
    cells = [Cell(cell.row + r, cell.column + c) for r in steps for c in steps]
    found = {tile.path: tile for one in cells for tile in met.get(one, ())}
    return tuple(found[path] for path in sorted(found))


def _shown(plan: Plan, cell: Cell, look: Swath, clip: xr.DataArray) -> float:
    """Fraction of a cell that a look's pass shows, including its other side where needed."""

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
    # by the pass's name, so that adding or moving a pass does not change the others
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
            "grid": [grid.crs, *(repr(v) for v in (grid.left, grid.top, grid.size, grid.spacing))],
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
    """Hash the excluded area of a cell, or of the survey; None where there is none."""
    excluded = plan.opened.excluded
    if excluded is None:
        return None
    if cell is None:
        return digest(excluded.wkb_hex)
    # the excluded area within a pixel of the cell
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


Floor = tuple[FloatArray, FloatArray, FloatArray]


def read_floor(context: Context, cell: Cell, k: int, key: str | None) -> Floor | None:
    """Read amplitude, cotangent of grazing and altitude on a cell's own pixels.

    Parameters
    ----------
    context : Context
    cell : Cell
    k : int
        Swath.
    key : str or None
        Key under which the ripple stage stored them, if it did.

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
    names = ("amplitude", "cotangent", "altitude")
    kept = store.load_arrays(key, names) if key is not None else None
    if kept is None:
        tiles = plan.tiles[look.sonar_pass.name].get(cell, ())
        clip = read_clip(look.sonar_pass, plan.opened.grid, cell, look.side, tiles, LOCATED)
        if clip is None:
            return None
        floor = _floor(plan, cell, Clip.from_array(clip))
        kept = [floor[name] for name in names]
    first, second, third = (v.astype(float) for v in kept)
    return first, second, third
