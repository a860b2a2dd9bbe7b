"""Scattering laws of simulated sediments: intensity over grazing angle, up to a factor."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field

from sasmap.arrays import FloatArray

Law = Literal["lambert", "gaussian", "rough", "volume"]

# Rms slope of the roughness of the Kirchhoff peak, and ratio of the peak to the rest at normal
# incidence (5 dB): chosen so that the law differs from all others on the slopes of ripples.
ROUGH_SLOPE = float(np.tan(np.radians(15.0)))
ROUGH_PEAK = 3.0
# Medium sand: density and sound speed relative to water, loss parameter (APL-UW TR 9407, table 2).
DENSITY, SPEED, LOSS = 1.85, 1.15, 0.0166
# Ratio of interface to volume scattering at normal incidence: small, so that volume scattering
# dominates, but positive beyond the critical angle (a choice).
SURFACE_SHARE = 0.03


class PowerLaw(BaseModel):
    """Intensity sin^n(grazing) exp(-c (grazing - pi/2)^2)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    exponent: Annotated[float, Field(ge=0, le=10)] = Field(description="n")
    concentration: Annotated[float, Field(ge=0, le=10)] = Field(0.0, description="c, 1/rad^2")


def backscatter(law: Law | PowerLaw, grazing: ArrayLike) -> FloatArray:
    """Intensity backscattered by a facet, per area.

    Parameters
    ----------
    law : str or PowerLaw
        "lambert": sin^2. "gaussian": exp(-(3/pi)(grazing - pi/2)^2), the square of the amplitude
        cross section of Zare & Cobb (section 3.2.3). "rough": sin^1.5 and the Kirchhoff peak of
        geometric optics, exp(-cot^2 / 2 s^2) / sin^4 (Jackson & Richardson 2007, chapter 13).
        "volume": :func:`_volume`.
    grazing : array_like
        Local grazing angle, above 0 to pi/2, rad.

    Returns
    -------
    ndarray
    """
    grazing = np.asarray(grazing, float)
    if isinstance(law, PowerLaw):
        peak = np.exp(-law.concentration * (grazing - np.pi / 2) ** 2)
        return np.asarray(np.sin(grazing) ** law.exponent * peak)
    if law == "gaussian":
        return np.asarray(np.exp(-(3 / np.pi) * (grazing - np.pi / 2) ** 2))
    sine = np.maximum(np.sin(grazing), 1e-6)
    if law == "lambert":
        return np.asarray(sine**2)
    if law == "rough":
        squared = sine**2
        peak = np.exp(-(1 / squared - 1) / (2 * ROUGH_SLOPE**2)) / squared**2
        return np.asarray(squared**0.75 + ROUGH_PEAK * peak)
    normal = _volume(np.ones(1))[0]
    return np.asarray(_volume(sine) / normal + SURFACE_SHARE * sine**2)


def _volume(sine: FloatArray) -> FloatArray:
    """Intensity from within a lossy fluid sediment (APL-UW TR 9407, section IV).

    |1 - R^2|^2 sin^2 / (|P|^2 Im P) with P = sqrt(k^2 - cos^2), k = (1 + i loss) / speed ratio and
    R the reflection coefficient: it falls steeply below the critical angle, here 30 degrees.

    Parameters
    ----------
    sine : ndarray
        Of the grazing angle.

    Returns
    -------
    ndarray
    """
    index = (1 + 1j * LOSS) / SPEED
    inner = np.sqrt(index**2 - 1 + sine**2)
    ratio = DENSITY * sine / inner
    reflection = (ratio - 1) / (ratio + 1)
    passed = np.abs(1 - reflection**2) ** 2
    return np.asarray(passed * sine**2 / (np.abs(inner) ** 2 * inner.imag))
