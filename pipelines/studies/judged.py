"""One estimate beside the truth, and tables of several: common parts of the studies."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sasmap.ripples import Clip, Quality, RippleSettings, estimate

Row = dict[str, Any]
NAN = float("nan")


def estimated(clip: Clip, frequency: float, height: float, seed: int) -> Row:
    """Estimate a clip with default settings; numbers beside the truth.

    Parameters
    ----------
    clip : Clip
    frequency, height : float
        True f (cycles/m) and A_H (m).
    seed : int
        Of the estimate.

    Returns
    -------
    dict
        Quality, probability, seconds; the truth; mean, standard deviation, 5 and 95 % quantile of
        f and A_H, and the share of draws below the truth (``_rank``); NaN where there are no draws.
    """
    start = time.perf_counter()
    posterior = estimate(clip, RippleSettings(), rng=seed)
    row: Row = {
        "quality": posterior.quality.label,
        "probability": NAN if posterior.probability is None else posterior.probability,
        "seconds": round(time.perf_counter() - start, 2),
    }
    for name, truth in (("frequency", frequency), ("height", height)):
        draws = posterior.draws[name].values.ravel() if posterior.sampled else np.full(2, NAN)
        low, high = np.quantile(draws, (0.05, 0.95))
        row |= {
            f"true_{name}": truth,
            f"{name}_mean": draws.mean(),
            f"{name}_sd": draws.std(),
            f"{name}_low": low,
            f"{name}_high": high,
            f"{name}_rank": np.mean(draws < truth) if posterior.sampled else NAN,
        }
    return row


def write_rows(path: Path, rows: list[Row]) -> None:
    """Write rows as CSV, numbers to six digits; makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as stream:
        written = csv.DictWriter(stream, list(rows[0]))
        written.writeheader()
        for row in rows:
            written.writerow(
                {k: v if isinstance(v, str | int) else f"{v:.6g}" for k, v in row.items()}
            )


def is_good(row: Row) -> bool:
    """Whether a row's estimate is good."""
    return bool(row["quality"] == Quality.GOOD.label)


def values(rows: list[Row], name: str) -> np.ndarray:
    """Values of a column."""
    return np.array([row[name] for row in rows], float)


def has_draws(row: Row) -> bool:
    """Whether a row has an estimate, good or not."""
    return bool(np.isfinite(row["height_mean"]))


def summary(title: str, rows: list[Row], judged: Callable[[Row], bool] = is_good) -> str:
    """One line of the table, as Markdown: how many, found, good; coverage and errors.

    Parameters
    ----------
    title : str
    rows : list of dict
        From :func:`estimated`.
    judged : callable
        Which rows coverage and errors are of.

    Returns
    -------
    str
    """
    counts = len(rows), sum(map(has_draws, rows)), sum(map(is_good, rows))
    cells = [title, *map(str, counts)]
    good = [row for row in rows if judged(row)]
    for name in ("frequency", "height"):
        if not good:
            cells += ["", "", ""]
            continue
        rank = values(good, f"{name}_rank")
        error = np.abs(values(good, f"{name}_mean") / values(good, f"true_{name}") - 1)
        cells += [f"{100 * np.mean(np.abs(rank - 0.5) < p / 2):.0f}" for p in (0.5, 0.9)]
        cells.append(f"{100 * np.median(error):.2g} %")
    if good:
        off = values(good, "height_mean") - values(good, "true_height")
        cells.append(f"{100 * np.mean(off / values(good, 'true_height')):+.0f} %")
        wide = (values(good, "height_high") - values(good, "height_low")) / values(
            good, "true_height"
        )
        cells.append(f"{np.median(wide):.2f}")
        far = np.abs(off) > 4 * values(good, "height_sd") + 0.2 * values(good, "true_height")
        cells.append(str(int(far.sum())))
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| | scenes | found | good | f in its 50, | 90 % interval | median error | A_H in its 50, | "
    "90 % interval | median error | mean error | width | far |\n" + "|---" * 13 + "|"
)


def print_table(rows: list[Row], columns: tuple[str, ...]) -> None:
    """Print the table: all rows, then by the values of some columns.

    Parameters
    ----------
    rows : list of dict
        From :func:`estimated`, with further columns.
    columns : tuple of str

    Notes
    -----
    Width is that of the 90 % interval of A_H over the true one, at the median; far are estimates
    that miss by more than four standard deviations and 20 %.
    """
    print(HEAD)
    print(summary("all", rows))
    print(summary("all, and what is found but not good", rows, has_draws))
    for column in columns:
        for value in dict.fromkeys(row[column] for row in rows):
            print(summary(f"{column} {value}", [row for row in rows if row[column] == value]))
