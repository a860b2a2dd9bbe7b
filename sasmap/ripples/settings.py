"""What a ripple estimate can be told: the ``ripples`` block of a survey file."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator, model_validator

Bounds = tuple[FiniteFloat, FiniteFloat]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]


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
    profile: Literal["auto", "sine", "stokes", "peaked"] = Field(
        "auto", description="crest profile; auto: sine unless the image says otherwise"
    )
    presence: Literal["tested", "assumed"] = Field(
        "tested",
        description="assumed: the strongest wave of every cell is estimated, ripple or not",
    )
    speckle: Literal["measured", "independent"] = Field(
        "measured",
        description="measured: correlated and textured speckle counts as fewer pixels",
    )
    scatter: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (0.00003, 0.0003, 0.005),
        description="change and misregistration between passes, standard deviations: "
        "of f and A_H as fractions, of the azimuth in degrees",
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

    @model_validator(mode="after")
    def _above_zero(self) -> Self:
        if self.frequency[0] == 0 and self.method == "default":
            raise ValueError("frequency: expected a lower bound above 0 cycles/m")
        return self
