"""scene.yaml: a sea floor with known truth, and the passes that look at it."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import pyproj
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    StringConstraints,
    field_validator,
    model_validator,
)

from sasmap.simulate.laws import Law, PowerLaw
from sasmap.simulate.profiles import PUBLISHED_PROFILES, CrestProfile

Name = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]+$")]
Point = tuple[FiniteFloat, FiniteFloat]
Polygon = Annotated[tuple[Point, ...], Field(min_length=3)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


LawChoice = Law | PowerLaw


class _Block(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Sediment(_Block):
    """A sediment: its level, scattering and speckle laws, and outline."""

    name: Name
    level: Positive = Field(
        1.0, description="relative mean intensity; between laws, at 30 degrees of grazing"
    )
    nu: Annotated[float, Field(gt=0)] = Field(
        float("inf"), description="shape of the texture; infinite: no texture"
    )
    kappa: NotNegative = Field(0.0, description="coherent over random amplitude, delta / a")
    polygon: Polygon | None = Field(
        None, description="m east and north of the origin; none: everywhere"
    )
    law: LawChoice | None = Field(
        None, description="scattering law, coherent physics only; default the scene's"
    )


class RipplePatch(_Block):
    """A field of ripples: geometry, crest profile, wander and forks of its crests."""

    frequency: Positive = Field(description="cycles/m")
    height: Positive = Field(description="A_H, m")
    azimuth: FiniteFloat = Field(description="crest normal, degrees clockwise from grid north")
    phase: FiniteFloat = Field(0.0, description="rad, at the scene's centre")
    profile: CrestProfile = Field("sine", description="crest profile")
    asymmetry: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.35, description="a of the asymmetric profile, sin(p + a sin p)"
    )
    wander: NotNegative = Field(0.0, description="rms wander of the phase, rad")
    wander_length: Positive = Field(10.0, description="correlation length of the wander, m")
    forks: tuple[Point, ...] = Field(
        (), description="where crests fork, m east and north of the origin"
    )
    bends: Polygon | None = Field(
        None, description="where crests wander and fork, in pairs of forks; default everywhere"
    )
    polygon: Polygon | None = Field(
        None, description="m east and north of the origin; none: everywhere"
    )
    added: bool = Field(False, description="adds to the ripples beneath, instead of replacing them")

    @model_validator(mode="after")
    def _paired(self) -> Self:
        if self.bends is not None and len(self.forks) % 2:
            raise ValueError("forks: expected pairs of them where bends has an end")
        return self


class ScenePass(_Block):
    """A straight pass by the scene and the settings of its sonar."""

    name: Name
    heading: FiniteFloat = Field(description="degrees clockwise from grid north")
    side: Literal["port", "starboard"] = Field("starboard", description="of the track that is seen")
    distance: Positive = Field(description="ground range of the scene's centre, m")
    altitude: Positive | tuple[Positive, Positive] = Field(
        5.0, description="m; two values: at the track's start and end"
    )
    pixel_size: Positive | None = Field(None, description="m; default the scene's")
    rotation: FiniteFloat = Field(
        0.0, description="of the tiles' rows against grid east, degrees clockwise"
    )
    tile: Annotated[int, Field(ge=16, le=20_000)] = Field(2000, description="tile side, pixels")
    range: Literal["ground", "slant"] = Field("ground", description="of the tiles' columns")
    gain: Positive | None = Field(None, description="pixel value of the mean flat amplitude")
    correlation: NotNegative = Field(0.0, description="speckle correlation length, pixels")
    blur: Annotated[FiniteFloat, Field(ge=0.3, le=5)] = Field(
        0.5, description="standard deviation of the coherent point spread function, pixels"
    )
    range_flattened: bool = Field(
        False, description="divide by flat floor's level; coherent physics only"
    )
    noise: FiniteFloat | None = Field(
        -25.0, description="receiver noise, dB over the mean intensity"
    )
    dtype: Literal["uint8", "uint16", "float32"] = Field(
        "uint8", description="of the tiles' pixels"
    )
    positions: Literal["projected", "geographic"] = Field(
        "projected", description="of the navigation file"
    )
    area: Polygon | None = Field(None, description="area covered; default the whole scene")


class Scene(_Block):
    """A simulated survey."""

    name: Name = Field(description="of the survey")
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(1, description="of everything random")
    crs: str = Field("EPSG:32617", description="projected, in metres")
    origin: Point = Field(description="lower-left corner, map coordinates, m")
    size: tuple[Positive, Positive] = Field(description="m east and north")
    pixel_size: Positive = Field(description="m")
    window: Annotated[int, Field(ge=3, le=10_000)] = Field(
        500, description="side of the survey's cells, pixels"
    )
    physics: Literal["published", "coherent"] = Field(
        "coherent",
        description="coherent: scattering facets, placed by slant range; published: equation 3 of "
        "Zare and Cobb (2013) times speckle, crests do not lean",
    )
    law: LawChoice = Field("lambert", description="scattering law, coherent physics only")
    shadow: Literal["line-of-sight", "crest"] = Field(
        "line-of-sight", description="rule of shadow; crest: published physics only"
    )
    sediments: Annotated[tuple[Sediment, ...], Field(min_length=1)] = Field(
        description="later ones cover earlier ones; the first lies everywhere"
    )
    ripples: tuple[RipplePatch, ...] = Field((), description="later ones cover earlier ones")
    passes: Annotated[tuple[ScenePass, ...], Field(min_length=1)] = Field(
        description="straight passes by the scene"
    )

    @field_validator("crs")
    @classmethod
    def _projected(cls, value: str) -> str:
        try:
            crs = pyproj.CRS.from_user_input(value)
        except pyproj.exceptions.CRSError:
            raise ValueError(f"expected a CRS such as EPSG:32617, got {value!r}") from None
        metres = all(abs(axis.unit_conversion_factor - 1) < 1e-9 for axis in crs.axis_info[:2])
        if not (crs.is_projected and metres):
            raise ValueError(f"expected a projected CRS in metres, got {value!r}")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [p.name for p in self.passes]
        if len(set(names)) < len(names):
            raise ValueError("passes: expected a different name for each")
        if any(set(name) & set("/*?[]") or name.startswith(".") for name in names):
            raise ValueError("passes: expected names that are valid folder names, without * ? [ ]")
        if set(names) & {"out", "truth"}:
            raise ValueError(
                "passes: expected other names than out and truth, which are folders of the output"
            )
        if self.sediments[0].polygon is not None:
            raise ValueError("sediments: expected the first one without a polygon, everywhere")
        if len(self.sediments) > 250:
            raise ValueError("sediments: expected at most 250")
        _check_physics(self)
        return self

    @property
    def centre(self) -> tuple[float, float]:
        """Map coordinates of the middle, m."""
        return self.origin[0] + self.size[0] / 2, self.origin[1] + self.size[1] / 2


def _check_physics(scene: Scene) -> None:
    """Refuse settings that the scene's physics would ignore."""
    coherent = {
        "law": "law" in scene.model_fields_set,
        "sediments.law": any(s.law is not None for s in scene.sediments),
        "ripples.profile": any(p.profile not in PUBLISHED_PROFILES for p in scene.ripples),
        "ripples.added": any(p.added for p in scene.ripples),
        "passes.range_flattened": any(p.range_flattened for p in scene.passes),
        "passes.blur": any("blur" in p.model_fields_set for p in scene.passes),
    }
    published = {
        "shadow": scene.shadow == "crest",
        "sediments.kappa": any(s.kappa > 0 for s in scene.sediments),
        "passes.correlation": any(p.correlation > 0 for p in scene.passes),
    }
    wrong = coherent if scene.physics == "published" else published
    other = "coherent" if scene.physics == "published" else "published"
    for key, used in wrong.items():
        if used:
            raise ValueError(f"{key}: this value needs physics: {other}")
