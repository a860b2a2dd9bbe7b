"""The scattering law that a survey learned, drawn beside Lambert's and the published one."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from sasmap.products.figures import Picture, encoded
from sasmap.ripples.survey import SurveyModel

FloatArray = NDArray[np.float64]

# Laws that are drawn beside the learned one: exponent n, concentration c, and the line.
OTHERS = {"Lambert": (2.0, 0.0, "--"), "Zare and Cobb": (0.0, 3 / np.pi, ":")}
# Width of the interval of the learned law over that of its prior below which something fixed it.
FIXED = 0.5
PRIOR_WIDTH = 2 * 1.645
# Shift of n from which the law is called one of another form: 0.2 to 0.6 under laws of about this
# form (docs/results.md).
BENT = 0.7


def law_figure(survey: SurveyModel | None, grazing: tuple[float, float]) -> Picture | None:
    """Draw intensity over grazing angle.

    Parameters
    ----------
    survey : SurveyModel or None
    grazing : tuple of float
        Least and largest grazing angle of the survey's cells, degrees: the law is drawn from a
        third of the least to 75 degrees, relative to their middle.

    Returns
    -------
    Picture or None
        None where no law was learned.
    """
    if survey is None or not survey.learned:
        return None
    degrees = np.geomspace(max(grazing[0] / 3, 1.0), 75.0, 120)
    middle = float(np.sqrt(grazing[0] * grazing[1]))
    levels = np.array(
        [level(float(v.law[0]), float(v.law[1]), degrees, middle) for v in survey.values]
    )
    low, centre, high = np.quantile(levels, (0.05, 0.5, 0.95), axis=0)
    figure = Figure(figsize=(5.2, 2.8), layout="constrained")
    axes = figure.add_subplot()
    axes.fill_between(degrees, low, high, color="#0072b2", alpha=0.25, linewidth=0)
    axes.plot(degrees, centre, color="#0072b2", label="learned, with its 90 % interval")
    for name, (n, c, line) in OTHERS.items():
        axes.plot(degrees, level(n, c, degrees, middle), line, color="#333333", label=name)
    axes.axvspan(*grazing, color="#000000", alpha=0.06, linewidth=0)
    axes.set_xscale("log")
    axes.set_xticks([2, 5, 10, 20, 40, 70], ["2", "5", "10", "20", "40", "70"])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("local grazing angle (degrees)", fontsize=8)
    axes.set_ylabel("intensity (dB)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return Picture(encoded(figure), f"{told(survey)} Grey: grazing angles of the cells.")


def level(n: float, c: float, degrees: FloatArray, middle: float) -> FloatArray:
    """Intensity of a law, dB over that at `middle` degrees."""
    angle, base = np.radians(degrees), np.radians(middle)

    def log(at: FloatArray) -> FloatArray:
        return np.asarray(n * np.log(np.sin(at)) - c * (at - 0.5 * np.pi) ** 2)

    return np.asarray(10 / np.log(10) * (log(angle) - log(np.array(base))))


def told(survey: SurveyModel) -> str:
    """Say what was learned of the law, or that nothing fixed it."""
    quantiles = survey.quantiles()
    (n_low, c_low), (n, c), (n_high, c_high) = quantiles["law"]
    spread = quantiles["spread"][1]
    text = (
        f"Scattering law sin(θ)^n exp(-c (θ - 90°)²) of the survey: n {n:.2f} ({n_low:.2f} to "
        f"{n_high:.2f}), c {c:.2f} ({c_low:.2f} to {c_high:.2f}); from look to look n differs by "
        f"{spread[0]:.2f}, c by {spread[1]:.2f} (standard deviations)."
    )
    low, shift, high = (float(q[0]) for q in quantiles["shift"])
    if low * high > 0 and abs(shift) > BENT:
        text += (
            f" The shape of waves without shadow tells n wrong by {shift:+.1f}, which is taken "
            "off: the law bends otherwise than this form."
        )
    if n_high - n_low > FIXED * PRIOR_WIDTH * 0.9:
        text += (
            " No shadow and no difference of grazing angles told the law from the height: heights "
            "therefore are wide."
        )
    return text
