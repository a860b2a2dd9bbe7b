"""Several passes over a cell: table 4 of Zare and Cobb, four headings, contradictions, altitude.

    python pipelines/ripples/passes.py [--runs 50] [--surveys 4] [--cells 9] [--published]
        [--cache FOLDER]

Table 4: a near pass (12.2 to 24.4 m), then a far one (24.4 to 36.6 m), over f = 0.6, A_H = 0.07 m.
Headings: surveys of one law each (Lambert's, one of the fitted family, and two outside it), every
cell with ripples of its own, Stokes-shaped and with wandering crests, rendered by the coherent
simulator for four passes at four headings; then one pass of a cell over another sea floor (f 20 %,
A_H 30 %, azimuth 15 degrees off), and one pass whose altitude is 3 % wrong and stated as known to
0.3 m. With a cache the looks are estimated once and stored there. Rescue: a near pass without
shadow, which determines A_H poorly, and a far one with shadow, coherent, in both orders.
"""

from __future__ import annotations

import argparse
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from zare_cobb_tables import simulate_clip as table_clip

from sasmap.passes.fusion import FusedCell, fuse, fuse_cells, learn_survey, next_prior
from sasmap.passes.shared import SurveyModel
from sasmap.passes.summary import Summary, summarise
from sasmap.ripples import Clip, Quality, RippleSettings, estimate
from sasmap.simulate import Scene, coherent_cell, simulate_clip
from sasmap.simulate.laws import PowerLaw

TRUTH = (0.6, 0.07)
RANGES = ((12.2, 24.4), (24.4, 36.6))
PRINTED = ((7.8e-5, 0.68), (3.4e-5, 0.024))  # means of five runs
ORIGIN = (500000.0, 3300000.0)
HEADINGS = (0.0, 60.0, 115.0, 300.0)
SIDE, PIXEL = 300, 0.025  # of a cell: pixels, and m
# What is changed of the sea floor that a false pass sees: by what factor, or by how much.
CHANGES = {
    "f 20 %": ("frequency", 1.2, 0.0),
    "A_H 30 %": ("height", 1.3, 0.0),
    "azimuth 15 degrees": ("azimuth", 1.0, 15.0),
}
WRONG_ALTITUDE, STATED = 0.97, 0.3  # of the true altitude; its stated accuracy, m
FALSE_PART = 4  # one cell in so many has a false pass
SURE = 0.06  # sd over A_H of looks of which a difference of 30 % is clear


def table_run(seed: int, method: str) -> np.ndarray:
    """Errors of f and A_H and widths of their 90 % intervals, after each pass (2, 4)."""
    own = {"frequency": (0, 1), "height": (0, 1)} if method == "zare-cobb" else {}
    law = "estimated" if own else "zare-cobb"  # the default method is told what rendered the clips
    settings = RippleSettings(method=method, shadow="crest", scattering=law, **own)
    summaries: list[Summary | None] = []
    for k, (near, far) in enumerate(RANGES):
        clip = table_clip(near, far, *TRUTH, "crest", 2 * seed + k)
        prior = next_prior(summaries, settings)
        summaries.append(summarise(estimate(clip, settings, rng=2 * seed + k, prior=prior)))
    known = fuse(summaries, settings).posteriors
    return np.array(
        [[*np.subtract(k.mean, TRUTH), *np.subtract(k.q95, k.q05)] for k in known], float
    )


def table_four(runs: int, pool: ProcessPoolExecutor, methods: list[str]) -> None:
    """Print table 4."""
    print("table 4: mean squared errors (printed), share of runs whose 90 % interval narrowed")
    for method in methods:
        found = np.array(list(pool.map(partial(table_run, method=method), range(runs))))
        for k in range(2):
            known = np.isfinite(found[:, k, 0])
            f, height = (found[known, k, :2] ** 2).mean(axis=0)
            both = known & np.isfinite(found[:, 0, 0])
            narrower = (found[both, k, 2:] < found[both, 0, 2:]).mean(axis=0)
            share = "" if k == 0 else f"   narrower {narrower[0]:.2f} {narrower[1]:.2f}"
            print(
                f"  {method:9s} after pass {k + 1}: f {f:.1e} ({PRINTED[k][0]:.0e})  "
                f"A_H {height:.1e} ({PRINTED[k][1]:.0e}){share}   ({known.sum()} of {runs} runs)",
                flush=True,
            )


Look = tuple[tuple[float, float, float], Summary]


class Cell(NamedTuple):
    """A cell's true values, the summary of each pass, and what one pass saw of another sea floor.

    `others` has the second pass over a floor that is changed in one way (:data:`CHANGES`), and the
    third with an altitude that is 3 % too low in the navigation.
    """

    truth: tuple[float, float, float]
    summaries: list[Summary]
    others: dict[str, Summary]


def scene_of(survey: int, number: int, change: str = "") -> Scene:
    """Draw a sea floor and four passes; the passes' altitudes and the law are the survey's."""
    shared, rng = np.random.default_rng([survey, 4]), np.random.default_rng([survey, number, 4])
    family = PowerLaw(exponent=shared.uniform(0.8, 2.5), concentration=shared.uniform(0, 0.7))
    altitudes = shared.uniform(4, 9, len(HEADINGS))
    frequency = rng.uniform(0.75, 1.3)
    patch = {
        "frequency": frequency,
        "height": rng.uniform(0.06, 0.15) / (2 * frequency),
        "azimuth": rng.uniform(0, 180),
        "phase": rng.uniform(0, 6.28),
        "profile": "stokes",
        "wander": rng.choice([0.0, 0.5]),
        "wander_length": 5.0,
    }
    name, factor, turn = CHANGES.get(change, ("", 1.0, 0.0))
    if name:
        patch[name] = factor * patch[name] + turn
    passes = [
        {
            "name": f"p{i}",
            "heading": heading,
            "distance": rng.uniform(10, 35),
            "altitude": altitude,
            "noise": -25.0,
            "dtype": "float32",
        }
        for i, (heading, altitude) in enumerate(zip(HEADINGS, altitudes, strict=True))
    ]
    side = SIDE * PIXEL
    return Scene(
        name="headings",
        seed=1000 * survey + number,
        origin=ORIGIN,
        size=(side, side),
        pixel_size=PIXEL,
        physics="coherent",
        law=["lambert", family, "rough", "volume"][survey % 4],
        sediments=[{"name": "sand"}],
        ripples=[patch],
        passes=passes,
    )


def look(job: tuple[int, int], which: int, change: str, cache: Path | None) -> Look:
    """Simulate and estimate one pass, or read it from the cache: the truth and a summary."""
    kept = cache / f"passes-{job[0]}-{job[1]}-{which}{change[:3]}.pkl" if cache else None
    if kept is not None and kept.exists():
        known: Look = pickle.loads(kept.read_bytes())
        return known
    seed = [*job, which, len(change)]
    made = simulate_clip(scene_of(*job, change), np.random.default_rng(seed), which)
    wrong = WRONG_ALTITUDE if change == "altitude" else 1.0
    clip = replace(made.clip, altitude=wrong * made.clip.altitude)
    if wrong != 1.0:
        clip = replace(clip, altitude_sd=STATED)
    summary = summarise(estimate(clip, RippleSettings(), rng=seed))
    found = (made.frequency, made.height, made.azimuth), summary
    if kept is not None:
        kept.write_bytes(pickle.dumps(found))
    return found


def cell(job: tuple[int, int], cache: Path | None) -> Cell:
    """Simulate and estimate a cell's passes."""
    looks = [look(job, i, "", cache) for i in range(len(HEADINGS))]
    others = {name: look(job, 1, name, cache)[1] for name in CHANGES}
    others["altitude"] = look(job, 2, "altitude", cache)[1]
    return Cell(looks[0][0], [s for _, s in looks], others)


def headings(surveys: list[list[Cell]]) -> None:
    """Print the errors after each of four passes, coverage and the effect of order."""
    settings = RippleSettings()
    cells = [c for survey in surveys for c in survey]
    models = [learn_survey([c.summaries for c in survey], settings) for survey in surveys]
    chains = [
        chain
        for survey, model in zip(surveys, models, strict=True)
        for chain in fuse_cells([c.summaries for c in survey], settings, model)
    ]
    print(f"four headings, {len(cells)} cells: rms error of f (%), A_H (%), azimuth (degrees)")
    for k in range(len(HEADINGS)):
        pairs = [
            (c.truth, chain.posteriors[k])
            for c, chain in zip(cells, chains, strict=True)
            if np.isfinite(chain.posteriors[k].mean[0])
        ]
        errors = np.array([_errors(truth, known) for truth, known in pairs])
        inside = np.array(
            [[known.q05[i] <= truth[i] <= known.q95[i] for i in range(2)] for truth, known in pairs]
        )
        rms = np.sqrt(np.mean(errors**2, axis=0))
        middle = np.median(np.abs(errors), axis=0)
        cover = 100 * inside.mean(axis=0)
        print(
            f"  after {k + 1}: rms {rms[0]:.3f} {rms[1]:.2f} {rms[2]:.3f}   "
            f"median {middle[0]:.3f} {middle[1]:.2f} {middle[2]:.3f}   "
            f"90 % intervals cover {cover[0]:.0f} {cover[1]:.0f}   ({len(pairs)} cells)"
        )
    honest = [c.quality == Quality.CONTRADICTION for c in chains if c.group]
    print(f"  consistent cells flagged as contradiction: {sum(honest)} of {len(honest)}")
    shifts = [_shift(survey, model) for survey, model in zip(surveys, models, strict=True)]
    print(f"  order: means move by {max(shifts):.1e} posterior sd at most")


def false_passes(surveys: list[list[Cell]]) -> None:
    """Print how many passes over another sea floor are found, one cell in four at a time."""
    for name in CHANGES:
        flagged, told, sure = [], [], []
        for survey in surveys:
            for part in range(FALSE_PART):
                mixed = [list(c.summaries) for c in survey]
                for c, looks in list(zip(survey, mixed, strict=True))[part::FALSE_PART]:
                    looks[1] = c.others[name]
                known = fuse_cells(mixed, RippleSettings(), learn_survey(mixed, RippleSettings()))
                for c, chain in list(zip(survey, known, strict=True))[part::FALSE_PART]:
                    both = [s.quality is Quality.GOOD for s in (c.others[name], c.summaries[1])]
                    if all(both) and sum(s.quality is Quality.GOOD for s in c.summaries) > 2:
                        flagged.append(chain.qualities[1] is Quality.CONTRADICTION)
                        told.append(chain.quality is Quality.CONTRADICTION)
                        known_by = [s.sd[1] / s.mean[1] for s in (c.summaries[0], *c.summaries[2:])]
                        false = c.others[name]
                        sure.append(max(false.sd[1] / false.mean[1], np.nanmin(known_by)) < SURE)
        print(
            f"  passes of another floor, {name}: {sum(flagged)} of {len(flagged)} named, "
            f"{sum(told)} of {len(told)} cells flagged; of {sum(sure)} where this look and another "
            f"tell A_H to {100 * SURE:.0f} %, {sum(np.logical_and(told, sure))}",
            flush=True,
        )


def wrong_altitude(surveys: list[list[Cell]]) -> None:
    """Print the estimate of an altitude that is 3 % too low in one of three passes."""
    for number, survey in enumerate(surveys):
        looks = [[c.summaries[0], c.summaries[1], c.others["altitude"]] for c in survey]
        model = learn_survey(looks, RippleSettings())
        offsets = np.array([v.offset for v in model.values])
        chains = fuse_cells(looks, RippleSettings(), model)
        inside = [
            chain.final.q05[1] <= c.truth[1] <= chain.final.q95[1]
            for c, chain in zip(survey, chains, strict=True)
            if chain.group
        ]
        altitude = scene_of(number, 0).passes[2].altitude
        print(
            f"  altitude {100 * (1 - WRONG_ALTITUDE):.0f} % too low in the third pass: "
            f"{(1 - WRONG_ALTITUDE) * altitude:.2f} m, found "
            f"{offsets[:, 2].mean():.2f} +- {offsets[:, 2].std():.2f} m; "
            f"A_H in {sum(inside)} of {len(inside)} intervals"
        )


def _errors(truth: tuple[float, float, float], known: object) -> tuple[float, float, float]:
    turn = (known.azimuth[0] - truth[2] + 90) % 180 - 90
    return 100 * (known.mean[0] / truth[0] - 1), 100 * (known.mean[1] / truth[1] - 1), turn


def _shift(survey: list[Cell], model: SurveyModel) -> float:
    """Largest move of a mean, in posterior sd, where passes come in the opposite order."""
    settings = RippleSettings()
    turned = [c.summaries[::-1] for c in survey]
    again = fuse_cells(turned, settings, learn_survey(turned, settings))
    before = fuse_cells([c.summaries for c in survey], settings, model)
    moves = [
        np.abs(np.subtract(a.final.mean, b.final.mean) / b.final.sd)
        for a, b in zip(again, before, strict=True)
    ]
    return float(np.nan_to_num(moves).max())


def rescue_run(seed: int) -> list[FusedCell]:
    """Combine a near pass without shadow and a far one with some, in both orders."""
    settings = RippleSettings()
    clips: list[Clip] = [
        coherent_cell(
            np.random.default_rng([seed, i, 5]), frequency=TRUTH[0], height=TRUTH[1], near=near
        ).clip
        for i, near in enumerate((4.0, 24.4))
    ]
    near, far = (summarise(estimate(c, settings, rng=seed)) for c in clips)
    return [fuse(looks, settings) for looks in ([near, far], [far, near])]


def rescue(runs: int, pool: ProcessPoolExecutor) -> None:
    """Print A_H after each pass."""
    found = list(pool.map(rescue_run, range(runs)))
    print("rescue: A_H, rms error and sd (m) after each pass")
    for i, name in enumerate(("near, then far", "far, then near")):
        for k in range(2):
            error = np.array([c[i].posteriors[k].mean[1] - TRUTH[1] for c in found])
            sd = np.nanmedian([c[i].posteriors[k].sd[1] for c in found])
            rms, known = np.sqrt(np.nanmean(error**2)), np.isfinite(error).sum()
            print(
                f"  {name:15s} after {k + 1}: {rms:.1e}  {sd:.1e}   ({known} of {len(found)} runs)"
            )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--surveys", type=int, default=4)
    parser.add_argument("--cells", type=int, default=9)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--published", action="store_true", help="the published sampler as well")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    if options.cache:
        options.cache.mkdir(parents=True, exist_ok=True)
    methods = ["default", "zare-cobb"] if options.published else ["default"]
    with ProcessPoolExecutor(options.workers) as pool:
        if options.runs:
            table_four(options.runs, pool, methods)
            rescue(max(options.runs // 5, 2), pool)
        jobs = [(i, k) for i in range(options.surveys) for k in range(options.cells)]
        found = list(pool.map(partial(cell, cache=options.cache), jobs))
    surveys = [found[i : i + options.cells] for i in range(0, len(found), options.cells)]
    headings(surveys)
    false_passes(surveys)
    wrong_altitude(surveys)


if __name__ == "__main__":
    main()
