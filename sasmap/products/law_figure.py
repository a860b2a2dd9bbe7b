"""Figure of the estimated scattering law with Lambert's and the published law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from sasmap.arrays import FloatArray
from sasmap.passes.shared import SurveyModel, quantiles_of
from sasmap.products.figures import Picture, encoded

# Laws drawn beside the estimated one: exponent n, concentration c, and the line style.
OTHERS = {"Lambert": (2.0, 0.0, "--"), "Zare and Cobb": (0.0, 3 / np.pi, ":")}
# Colours of the estimated laws: blue, vermilion, green, purple.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
# Ratio of the widths of posterior and prior intervals of n below which the data constrain the law
# (a choice), and the 90 % interval of a Gaussian prior in standard deviations.
FIXED = 0.5
PRIOR_WIDTH = 2 * 1.645
# Shift of n above which the law is reported to have another form: laws close to this form give 0.2
# to 0.6 (docs/results.md).
BENT = 0.7


def law_figure(
    survey: SurveyModel | None, grazing: tuple[float, float], sediments: Sequence[str] = ()
) -> Picture | None:
    """Draw intensity over grazing angle.

    Parameters
    ----------
    survey : SurveyModel or None
    grazing : tuple of float
        Smallest and largest grazing angle of the survey's cells, degrees: the law is drawn from a
        third of the smallest to 75 degrees, relative to their geometric mean.
    sediments : sequence of str
        Names of the mapped classes.

    Returns
    -------
    Picture or None
        None where no law was learned.
    """
    if survey is None or not survey.learned:
        return None
    degrees = np.geomspace(max(grazing[0] / 3, 1.0), 75.0, 120)
    middle = float(np.sqrt(grazing[0] * grazing[1]))
    figure = Figure(figsize=(5.2, 2.8), layout="constrained")
    axes = figure.add_subplot()
    names = law_names(survey, sediments)
    for name, draws, colour in zip(names, survey.found, COLOURS, strict=False):
        levels = np.array(
            [level(float(p.shared.law[0]), float(p.shared.law[1]), degrees, middle) for p in draws]
        )
        low, centre, high = np.quantile(levels, (0.05, 0.5, 0.95), axis=0)
        axes.fill_between(degrees, low, high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(degrees, centre, color=colour, label=f"{name} (90 % interval)")
    for name, (n, c, line) in OTHERS.items():
        axes.plot(degrees, level(n, c, degrees, middle), line, color="#333333", label=name)
    axes.axvspan(*grazing, color="#000000", alpha=0.06, linewidth=0)
    axes.set_xscale("log")
    axes.set_xticks([2, 5, 10, 20, 40, 70], ["2", "5", "10", "20", "40", "70"])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("local grazing angle (degrees)", fontsize=8)
    axes.set_ylabel(f"intensity (dB over that at {middle:.0f}°)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    caption = f"{law_caption(survey, sediments)} Grey: grazing angles of the cells."
    return Picture(encoded(figure), caption)


def law_names(survey: SurveyModel, sediments: Sequence[str] = ()) -> list[str]:
    """Name each law that the survey separates, by its sediment or its share of the cells."""
    if not survey.apart:
        return ["estimated"]
    if survey.sediments:
        return [
            sediments[number - 1] if number <= len(sediments) else f"class {number}"
            for number in survey.sediments
        ]
    shares = [100 * np.mean([p.weight for p in draws]) for draws in survey.found]
    return [f"law {i}, {share:.0f} % of the cells" for i, share in enumerate(shares, 1)]


def level(n: float, c: float, degrees: FloatArray, middle: float) -> FloatArray:
    """Intensity of a law, dB relative to that at `middle` degrees."""
    angle, base = np.radians(degrees), np.radians(middle)

    def log(at: FloatArray) -> FloatArray:
        return np.asarray(n * np.log(np.sin(at)) - c * (at - 0.5 * np.pi) ** 2)

    return np.asarray(10 / np.log(10) * (log(angle) - log(np.array(base))))


def law_caption(survey: SurveyModel, sediments: Sequence[str] = ()) -> str:
    """Describe the estimated law, or say that the data do not constrain it."""
    if survey.apart:
        laws = [
            f"{name}: {_numbers(quantiles_of([p.shared for p in draws]))}"
            for name, draws in zip(law_names(survey, sediments), survey.found, strict=True)
        ]
        if survey.sediments:
            return (
                "Scattering law sin(θ)^n exp(-c (θ - 90°)²) of each mapped sediment with enough "
                "rippled cells; " + "; ".join(laws) + ". A sediment in which neither shadow nor a "
                "range of grazing angles separates its law from the height has wide intervals."
            )
        return (
            "Two scattering laws sin(θ)^n exp(-c (θ - 90°)²) are told apart; "
            + "; ".join(laws)
            + ". Where the image of a cell does not tell which law is its own, the interval of its "
            "height covers what follows from both."
        )
    quantiles = survey.quantiles()
    n_low, n_high = quantiles["law"][0][0], quantiles["law"][2][0]
    text = f"Scattering law sin(θ)^n exp(-c (θ - 90°)²) of the survey: {_numbers(quantiles)}."
    low, shift, high = (float(q[0]) for q in quantiles["shift"])
    if low * high > 0 and abs(shift) > BENT:
        text += (
            f" The echo shape of ripples without shadow biases n by {shift:+.1f}, which is "
            "corrected: the true law has another form than this."
        )
    if n_high - n_low > FIXED * PRIOR_WIDTH * 0.9:
        text += (
            " Neither shadow nor a range of grazing angles separates the law from the height, so "
            "the intervals of the heights are wide."
        )
    return text


def _numbers(quantiles: dict[str, FloatArray]) -> str:
    """Write n and c with their 90 % intervals and spreads."""
    (n_low, c_low), (n, c), (n_high, c_high) = quantiles["law"]
    spread = quantiles["spread"][1]
    return (
        f"n {n:.2f} ({n_low:.2f} to {n_high:.2f}), c {c:.2f} ({c_low:.2f} to {c_high:.2f}); from "
        f"look to look n differs by {spread[0]:.2f}, c by {spread[1]:.2f} (standard deviations)"
    )
