"""The plan of a run: looks, cells, files, and steps that the survey does not need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj
import shapely

from sasmap.errors import InputError
from sasmap.run.class_models import ClassModel, read_model
from sasmap.run.store import code_version, digest
from sasmap.settings.survey import Survey
from sasmap.survey.cells import Cell, check_count
from sasmap.survey.opening import OpenSurvey, check_kept, open_survey
from sasmap.survey.passes import Side, SonarPass, tiles_of_cells
from sasmap.survey.tiles import Tile, hash_file
from sasmap.survey.training import Training, check_shown, read_training

# Grazing angle, degrees, below which ripples of steepness 0.11 (slope 0.35 = tan 19 degrees) cast
# shadow; difference of grazing angles above which contrast alone constrains the law (a choice).
SHADOW_GRAZING, APART = 19.0, 10.0


class Swath(NamedTuple):
    """One side of one pass."""

    sonar_pass: SonarPass
    side: Side

    @property
    def label(self) -> str:
        """The pass's name, with the side where the pass shows both."""
        both = len(self.sonar_pass.sides) == 2
        return f"{self.sonar_pass.name}:{self.side}" if both else self.sonar_pass.name


@dataclass(frozen=True)
class Plan:
    """The plan of a run.

    Attributes
    ----------
    opened : OpenSurvey
    swaths : tuple of Swath
    cells : dict of Cell to tuple of int
        For each cell that any tiles meet, the swaths (indices) whose tiles meet it.
    tiles : dict of str to dict of Cell to tuple of Tile
        By pass, the tiles that may show each cell.
    hashes : dict of Path to str
        SHA-256 of every input file.
    left_out : tuple of str
        Steps that are left out, and why.
    training : tuple of Training
        Training polygons; empty unless the survey names some.
    model : ClassModel or None
        Sediment classes of another survey.
    overlapping : Plan or None
        The same survey in overlapping cells, if ripples are estimated in such cells.
    """

    opened: OpenSurvey
    swaths: tuple[Swath, ...]
    cells: dict[Cell, tuple[int, ...]]
    tiles: dict[str, dict[Cell, tuple[Tile, ...]]]
    hashes: dict[Path, str]
    left_out: tuple[str, ...]
    training: tuple[Training, ...] = ()
    model: ClassModel | None = None
    overlapping: Plan | None = None

    @property
    def ripples(self) -> Plan:
        """The plan in the cells of the ripple estimates."""
        return self.overlapping or self

    @property
    def overlaps(self) -> bool:
        """Whether neighbouring cells share pixels."""
        return self.opened.grid.spacing < self.opened.grid.size

    @property
    def settings(self) -> Survey:
        """The survey's settings."""
        return self.opened.settings

    @property
    def run_id(self) -> str:
        """Hash of inputs, settings, code version and seed."""
        # inputs are identified by content, not by path
        places: Any = {"passes": {"__all__": {"tiles", "navigation"}}}
        places |= dict.fromkeys(("output", "area", "exclude"), True)
        settings = self.settings.model_dump(mode="json", exclude=places)
        settings["sediments"] = self.sediment_settings
        return digest([self._inputs(), settings, code_version()])[:16]

    @property
    def sediment_settings(self) -> list[Any] | None:
        """Settings of the sediment map, with the hashes of their files."""
        sediments = self.settings.sediments
        if sediments is None:
            return None
        known = [[t.name, self.hashes[t.path]] for t in self.training]
        model = None if sediments.model is None else self.hashes[self.model_path]
        classes = None if self.training else sediments.classes
        return [classes, sediments.least_area, known, model]

    @property
    def model_path(self) -> Path:
        """File of another survey's sediment classes."""
        sediments = self.settings.sediments
        assert sediments is not None
        assert sediments.model is not None
        return self.settings.resolve(sediments.model)

    def _inputs(self) -> list[list[str]]:
        swaths = [
            [swath.label, *(self.hashes[f] for f in swath.sonar_pass.files)]
            for swath in self.swaths
        ]
        polygons = (self.settings.area, self.settings.exclude)
        named = ["" if p is None else self.hashes[self.settings.resolve(p)] for p in polygons]
        return [*swaths, named]


def make_plan(survey: Survey) -> Plan:
    """Open and check a survey, and list what would run.

    Parameters
    ----------
    survey : Survey

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        With one line per fault of the survey's files.
    """
    opened = open_survey(survey)
    swaths = tuple(Swath(p, side) for p in opened.passes for side in p.sides)
    tiles, cells = _met(opened, swaths)
    if not cells:
        raise InputError(f"{survey.path}: area, exclude: no cell of the survey is left")
    training = read_training(survey, opened.grid)
    check_shown(training, opened.passes, opened.grid)
    files = {f for p in opened.passes for f in p.files} | {t.path for t in training}
    files |= set(opened.polygon_files)
    model = None
    if survey.sediments is not None and survey.sediments.model is not None:
        path = survey.resolve(survey.sediments.model)
        model = read_model(path)
        files.add(path)
    check_kept(survey, files)
    hashes = {f: hash_file(f) for f in sorted(files)}
    opened = replace(opened, warnings=(*opened.warnings, *_told_twice(opened, hashes)))
    plan = Plan(opened, swaths, cells, tiles, hashes, tuple(_left_out(survey)), training, model)
    return replace(plan, overlapping=_overlapping(plan))


def _told_twice(opened: OpenSurvey, hashes: dict[Path, str]) -> list[str]:
    """Warn of tiles with identical content: they count as often as they are listed."""
    first: dict[str, tuple[str, Path]] = {}
    found = []
    for one in opened.passes:
        for tile in one.tiles:
            name, path = first.setdefault(hashes[tile.path], (one.name, tile.path))
            if (name, path) != (one.name, tile.path):
                found.append(
                    f"{tile.path}: pass {one.name}: the same data as {path} of pass {name}: "
                    "counted twice, so that intervals are too narrow; list it once"
                )
    return found


def _met(
    opened: OpenSurvey, swaths: tuple[Swath, ...]
) -> tuple[dict[str, dict[Cell, tuple[Tile, ...]]], dict[Cell, tuple[int, ...]]]:
    """Find the tiles that may show each cell, by pass, and the swaths that meet it."""
    tiles = {p.name: tiles_of_cells(p, opened.grid) for p in opened.passes}
    cells = {
        cell: tuple(k for k, one in enumerate(swaths) if cell in tiles[one.sonar_pass.name])
        for cell in sorted({cell for met in tiles.values() for cell in met})
        if _called_for(opened, cell)
    }
    return tiles, cells


def _overlapping(plan: Plan) -> Plan | None:
    """Plan the same survey in overlapping cells, if it asks for them."""
    survey = plan.settings
    if survey.ripples is None or survey.ripples.overlap == 0:
        return None
    pixels = max(round((1 - survey.ripples.overlap) * survey.window), 1)
    grid = plan.opened.grid.overlapping(plan.opened.grid.size * pixels / survey.window)
    check_count(grid, str(survey.path))
    opened = replace(plan.opened, grid=grid)
    tiles, cells = _met(opened, plan.swaths)
    return replace(plan, opened=opened, tiles=tiles, cells=cells)


def _called_for(opened: OpenSurvey, cell: Cell) -> bool:
    """Whether a cell touches the survey's area and is not fully excluded."""
    square = shapely.box(*opened.grid.bounds(cell))
    if opened.area is not None and not opened.area.intersects(square):
        return False
    return opened.excluded is None or not opened.excluded.covers(square)


def _left_out(survey: Survey) -> Iterator[str]:
    if survey.ripples is None:
        yield "ripples: the survey file has no ripples block"
    if survey.sediments is None:
        yield "sediments: the survey file has no sediments block"


def _law_told(plan: Plan) -> str:
    """Describe which cells can be expected to separate the scattering law from A_H."""
    grid = plan.opened.grid
    cells = list(plan.cells)
    bounds = np.array([grid.bounds(cell) for cell in cells])
    x, y = bounds[:, [0, 2]].mean(axis=1), bounds[:, [1, 3]].mean(axis=1)
    grazing = np.full((len(plan.swaths), len(cells)), np.nan)
    for k, swath in enumerate(plan.swaths):
        seen = swath.sonar_pass.track.locate(x, y)
        shown = np.array([k in plan.cells[cell] for cell in cells])
        angle = np.degrees(np.arctan2(seen.altitude, seen.distance))
        grazing[k] = np.where(shown, angle, np.nan)
    low = np.nanmin(np.where(np.isnan(grazing), np.inf, grazing), axis=0)
    high = np.nanmax(np.where(np.isnan(grazing), -np.inf, grazing), axis=0)
    shadowed = int((low < SHADOW_GRAZING).sum())
    several = int((high - low > APART).sum())
    told = (
        f"{shadowed} of {len(cells)} cells are seen below {SHADOW_GRAZING:.0f} degrees, where "
        f"common ripples cast shadow, {several} at grazing angles {APART:.0f} degrees apart"
    )
    if shadowed or several:
        return f"{told}: these can constrain it for all"
    return f"{told}: the data may not separate it from A_H, whose intervals would then be wide"


def _classes_told(plan: Plan) -> str:
    """Describe where the sediment classes come from."""
    settings = plan.settings.sediments
    assert settings is not None
    if plan.model is not None:
        return f"classes of {settings.model}: {', '.join(plan.model.names)}"
    if plan.training:
        return "classes from training polygons: " + ", ".join(t.name for t in plan.training)
    return (
        "as many classes as the data support"
        if settings.classes == "auto"
        else (f"{settings.classes} classes")
    )


def tags_of(plan: Plan) -> dict[str, str]:
    """Return the tags of a plan's products."""
    return {
        "SOFTWARE": f"sasmap {code_version()}",
        "SURVEY": plan.settings.name,
        "RUN_ID": plan.run_id,
    }


def crs_name(wkt: str) -> str:
    """Return the name of a CRS, with its code where it has one."""
    crs = pyproj.CRS.from_wkt(wkt)
    authority = crs.to_authority()
    return f"{crs.name} ({':'.join(authority)})" if authority else str(crs.name)


def recorded(plan: Plan) -> tuple[datetime, datetime] | None:
    """First and last date of the passes, UTC unless stated; None without dates."""
    given = [datetime.fromisoformat(p.date) for p in plan.settings.passes if p.date is not None]
    dates = sorted(d.replace(tzinfo=UTC) if d.tzinfo is None else d.astimezone(UTC) for d in given)
    return (dates[0], dates[-1]) if dates else None


def dates_of(plan: Plan) -> str:
    """Return the dates of a survey as text; empty where no pass gives one."""
    found = recorded(plan)
    if found is None:
        return ""
    first, last = (d.date().isoformat() for d in found)
    return first if first == last else f"{first} to {last}"


def describe(plan: Plan) -> Iterable[str]:
    """Describe a plan, a line each."""
    plan = plan.ripples
    grid = plan.opened.grid
    looks = [len(k) for k in plan.cells.values()]
    apart = f", every {grid.spacing:g} m" if plan.overlaps else ""
    yield f"survey: {plan.settings.name}"
    yield f"cells: {grid.rows} rows x {grid.columns} columns of {grid.size:g} m{apart}"
    yield f"crs: {crs_name(grid.crs)}"
    for p in plan.opened.passes:
        met = sum(any(plan.swaths[k].sonar_pass is p for k in ks) for ks in plan.cells.values())
        sides = " and ".join(p.sides)
        tiles = f"{len(p.tiles)} tile{'s' * (len(p.tiles) > 1)}"
        yield f"pass {p.name}: {tiles}, {sides}, {p.track.x.size} pings, {met} cells"
    if plan.settings.ripples is not None:
        method = plan.settings.ripples.method
        yield f"ripples: method {method}, {sum(looks)} looks, at most {max(looks)} per cell"
        if method == "default" and plan.settings.ripples.scattering == "estimated":
            yield f"scattering law: {_law_told(plan)}"
    if plan.settings.sediments is not None:
        yield f"sediments: {_classes_told(plan)}"
    shown = Counter(len(k) for k in plan.cells.values())
    yield "looks per cell: " + ", ".join(f"{n} at {shown[n]} cells" for n in sorted(shown))
    for line in plan.left_out:
        yield f"left out: {line}"
