"""Settings of a ripple estimate: the ``ripples`` block of a survey file."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator, model_validator

Bounds = tuple[FiniteFloat, FiniteFloat]
# Largest bound of A_H, m: half the height of a wave of 20 m, the longest, at a slope of 1.
MOST_HEIGHT = 3.2
NotNegative = Annotated[FiniteFloat, Field(ge=0)]


class Exponent(BaseModel):
    """A scattering law: intensity follows the sine of the local grazing angle to a power."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    exponent: Annotated[FiniteFloat, Field(ge=0, le=4)]


class RippleSettings(BaseModel):
    """Settings of a ripple estimate, with defaults that suit most surveys."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Literal["default", "zare-cobb"] = Field(
        "default", description="default, or zare-cobb (the published sampler)"
    )
    frequency: Bounds = Field(
        (0.05, 5.0), description="truncation bounds of the prior of f, cycles/m"
    )
    height: Bounds = Field(
        (0.0, 0.5),
        description="truncation bounds of the prior of A_H, m; no slope is steeper than 1",
    )
    shadow: Literal["line-of-sight", "crest"] = Field(
        "line-of-sight",
        description="shadow rule; crest is the published one, always used by zare-cobb",
    )
    scattering: Literal["estimated", "zare-cobb", "lambert"] | Exponent = Field(
        "estimated",
        description="scattering law; estimated: learned from the image with A_H; zare-cobb: the "
        "published model; lambert, or {exponent: n}: intensity follows the sine of the local "
        "grazing angle to the power 2, or n",
    )
    overlap: Annotated[FiniteFloat, Field(ge=0, le=0.9)] = Field(
        0.0,
        description="of neighbouring cells, a fraction of the window: 0.5 estimates them every "
        "half window, from a whole window each",
    )
    scatter: tuple[NotNegative, NotNegative, NotNegative] | None = Field(
        None,
        description="change and misregistration between passes, standard deviations: of f and A_H "
        "as fractions, of the azimuth in degrees; by default what the survey shows",
    )
    keep_model: bool = Field(False, description="write modelled_amplitude.tif")
    chains: Annotated[int, Field(ge=2, le=64)] = Field(
        4, description="Markov chains per clip; zare-cobb runs one, as published"
    )
    draws: Annotated[int, Field(ge=100, le=1_000_000)] = Field(
        4000,
        description="largest number of kept draws per chain; sampling stops early on convergence",
    )

    @field_validator("frequency", "height")
    @classmethod
    def _ordered(cls, value: Bounds) -> Bounds:
        low, high = value
        if low < 0 or high <= low:
            raise ValueError(f"expected 0 <= lower < upper bound, got [{low:g}, {high:g}]")
        return value

    @field_validator("height")
    @classmethod
    def _in_metres(cls, value: Bounds) -> Bounds:
        if value[1] > MOST_HEIGHT:
            raise ValueError(f"expected bounds of A_H in metres, at most {MOST_HEIGHT:g}")
        return value

    @model_validator(mode="after")
    def _above_zero(self) -> Self:
        if self.frequency[0] == 0 and self.method == "default":
            raise ValueError("frequency: expected a lower bound above 0 cycles/m")
        return self


def scattering_law(setting: str | Exponent) -> tuple[float, float] | None:
    """Exponent and concentration of the law if the settings fix it, None if it is estimated.

    Parameters
    ----------
    setting : str or Exponent
        ``RippleSettings.scattering``.

    Returns
    -------
    tuple of float or None
        n and c of the intensity sin^n(theta) exp(-c (theta - pi/2)^2).
    """
    if isinstance(setting, Exponent):
        return setting.exponent, 0.0
    # the Gaussian amplitude of Zare and Cobb has variance pi/3
    return {"lambert": (2.0, 0.0), "zare-cobb": (0.0, 3.0 / math.pi)}.get(setting)
