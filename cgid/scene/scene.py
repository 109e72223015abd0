"""The scene file: what falls on what, and what senses it.

A scene is TOML, validated as a whole: every mistake is reported at once with its path. Numbers are in SI
units, or strings with a unit.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cgid.errors import BadData, NoInput
from cgid.family import HIGHEST_RESTITUTION, LOWEST_RESTITUTION
from cgid.impact import RIGID, HalfSpace, RigidWall
from cgid.materials import Material
from cgid.scene.distributions import DISTRIBUTION_NAMES, Distribution, measured, within
from cgid.scene.sensor import Sensor
from cgid.scene.units import Density, Frequency, Modulus, Ratio

_TINY, _HUGE = 5e-324, 1e300


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Population(_Section):
    """Particles of one kind and the way they fall; several populations may share a label."""

    label: str = Field(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_. -]+$")
    weight: float = Field(default=1.0, gt=0)
    density: Annotated[Distribution, measured("density"), within(_TINY, _HUGE, "must be above 0", "kg/m^3")]
    youngs_modulus: Annotated[Distribution, measured("modulus"), within(_TINY, _HUGE, "must be above 0", "Pa")]
    poisson_ratio: Annotated[
        Distribution, measured("ratio"), within(-1 + 1e-9, 0.5 - 1e-9, "must lie between -1 and 0.5")
    ]
    radius: Annotated[Distribution, measured("length"), within(_TINY, _HUGE, "must be above 0", "m")]
    restitution: (
        Annotated[
            Distribution,
            measured("ratio"),
            within(
                LOWEST_RESTITUTION,
                HIGHEST_RESTITUTION,
                f"must lie between {LOWEST_RESTITUTION:g} and {HIGHEST_RESTITUTION:g}",
            ),
        ]
        | None
    ) = None
    drop_height: Annotated[Distribution, measured("length"), within(_TINY, _HUGE, "must be above 0", "m")] | None = None
    velocity: Annotated[Distribution, measured("speed"), within(_TINY, _HUGE, "must be above 0", "m/s")] | None = None

    @model_validator(mode="after")
    def _one_way_to_fall(self) -> Self:
        if (self.drop_height is None) == (self.velocity is None):
            raise ValueError("must have either drop_height or velocity, and not both")
        return self


class TargetSection(_Section):
    """The elastic half space that is hit; `target = "rigid"` for a rigid wall."""

    density: Density = Field(default=7850.0, gt=0)
    youngs_modulus: Modulus = Field(gt=0)
    poisson_ratio: Ratio = Field(gt=-1, lt=0.5)


class ImpactSection(_Section):
    """The laws of the impact."""

    stiffness: Literal["hertz", "rigid-sphere", "series"]
    dissipation: Literal["elastic", "hunt-crossley"]
    law: Literal["exact"] = "exact"
    target: TargetSection | Literal["rigid"]

    @property
    def body(self) -> HalfSpace | RigidWall:
        """The target of every impact."""
        if self.target == "rigid":
            return RIGID
        return HalfSpace(material=Material(**self.target.model_dump()))


class SamplingSection(_Section):
    """How the frame of an impact is cut."""

    sampling_rate: Frequency = Field(gt=0)
    samples: int = Field(ge=16, le=2**24)
    pre_trigger: int = Field(ge=2)
    jitter: float = Field(default=1.0, ge=0, le=1)

    @model_validator(mode="after")
    def _room_for_a_pulse(self) -> Self:
        if self.pre_trigger > self.samples - 8:
            raise ValueError(
                f"pre_trigger must leave 8 samples of the frame's {self.samples} for the pulse, got {self.pre_trigger}"
            )
        return self


class Scene(_Section):
    """A whole scene; see `load_scene`."""

    name: str = Field(min_length=1, max_length=64)
    description: str = ""
    impact: ImpactSection
    sampling: SamplingSection
    sensor: Sensor = Sensor()
    populations: tuple[Population, ...] = Field(min_length=1, max_length=64)

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        elastic = self.impact.dissipation == "elastic"
        for index, population in enumerate(self.populations):
            if elastic and population.restitution is not None:
                raise ValueError(f"populations.{index}.restitution must be left out when dissipation is elastic")
            if not elastic and population.restitution is None:
                raise ValueError(f"populations.{index}.restitution is missing: hunt-crossley dissipation needs it")
        nyquist = self.sampling.sampling_rate / 2
        if self.sensor.bandwidth is not None and self.sensor.bandwidth >= nyquist:
            raise ValueError(
                f"sensor.bandwidth must be below half the sampling rate, {nyquist:g} Hz, got "
                f"{self.sensor.bandwidth:g} Hz: leave it out for an unlimited sensor"
            )
        return self

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels in alphabetical order."""
        return tuple(sorted({population.label for population in self.populations}))

    @property
    def text(self) -> str:
        """The whole scene as JSON with sorted keys: what is stored in a dataset, and hashed."""
        return json.dumps(self.model_dump(mode="json", exclude_none=True), sort_keys=True)

    @property
    def sha256(self) -> str:
        """Identity of the scene: the hash of `text`, whatever the layout of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def load_scene(path: str | Path) -> Scene:
    """Return the scene of a TOML file.

    Parameters
    ----------
    path : str or Path
        The file.

    Raises
    ------
    NoInput
        The file cannot be read.
    BadData
        It is no TOML, or breaks rules; one line for each, with its path in the file.
    """
    try:
        text = Path(path).read_bytes().decode()
    except OSError as error:
        raise NoInput(
            f"{path}: the scene file cannot be read ({error.strerror}); give the path of a .toml file"
        ) from None
    except UnicodeDecodeError:
        raise BadData(f"{path}: a scene file must be UTF-8 text; this one is not") from None
    try:
        return parse_scene(tomllib.loads(text), source=str(path))
    except tomllib.TOMLDecodeError as error:
        raise BadData(f"{path}: a scene file must be valid TOML: {error}") from None


def parse_scene(content: dict[str, Any], source: str = "scene") -> Scene:
    """Return the scene of a mapping with the structure of the file; raises `BadData` as `load_scene`."""
    try:
        return Scene.model_validate(content)
    except ValidationError as error:
        lines = [f"{source}: {_path(entry['loc'])}: {_message(entry)}" for entry in error.errors(include_url=False)]
        raise BadData("\n".join(lines)) from None


def _path(location: tuple[int | str, ...]) -> str:
    """Write a path without the names of the alternatives that pydantic puts in."""
    left_out = {*DISTRIBUTION_NAMES, "TargetSection", "literal['rigid']"}
    return ".".join(str(part) for part in location if part not in left_out) or "scene"


def _message(entry: Any) -> str:
    if entry["type"] == "extra_forbidden":
        return "unknown key; look for a misspelling, or take it out"
    if entry["type"] == "missing":
        return "is missing"
    if entry["type"] == "union_tag_not_found":
        return f"must name its distribution: one of {', '.join(DISTRIBUTION_NAMES)}"
    text = str(entry["msg"]).removeprefix("Value error, ").replace("Input should", "must")
    shown = entry["input"]
    if entry["type"] != "value_error" and isinstance(shown, str | int | float):
        text += f", got {shown!r}"
    return text
