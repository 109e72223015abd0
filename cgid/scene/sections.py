"""The sections of a scene file, each checked by itself."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from cgid import validation
from cgid.family import HIGHEST_RESTITUTION, LOWEST_RESTITUTION
from cgid.physics import HUNT_CROSSLEY_LAWS, RIGID, HalfSpace, RigidWall, ThinPlate
from cgid.physics.materials import Material
from cgid.scene.distributions import Distribution, measured, measured_within, within
from cgid.scene.taps import SHAPES
from cgid.scene.units import Acceleration, Density, Frequency, Length, Modulus, Number, Ratio, Whole


def _between(lowest: float, highest: float) -> Any:
    return within(lowest, highest, f"must lie between {lowest:g} and {highest:g}")


_Force = Annotated[Distribution, measured("force"), measured_within("force")]
_Time = Annotated[Distribution, measured("time"), measured_within("time")]
_Frequency = Annotated[Distribution, measured("frequency"), measured_within("frequency")]
_Length = Annotated[Distribution, measured("length"), measured_within("length")]


class Section(BaseModel):
    """A part of the file: no unknown keys, no nan."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SecondHit(Section):
    """The same pulse once more, `delay` after touch and `ratio` times as high; the two may overlap."""

    delay: _Time
    ratio: Annotated[Distribution, measured("ratio"), _between(1e-3, 1e3)]


class _Source(Section):
    """What pulses of one label have in common, wherever they come from."""

    _DRAWN: ClassVar[tuple[str, ...]] = ()

    label: Annotated[str, AfterValidator(partial(validation.label, "label"))]
    weight: Number = Field(default=1.0, gt=0, le=1e9)
    second_hit: SecondHit | None = None
    # The share of a pulse's peak at which the sensor's range ends, as if it were too small for this impact.
    clipped_at: Annotated[Distribution, measured("ratio"), _between(1e-3, 1.0)] | None = None

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distributions that are there, by the name of what is drawn."""
        found = {name: getattr(self, name) for name in (*self._DRAWN, "clipped_at")}
        if self.second_hit is not None:
            found |= {"second_hit_delay": self.second_hit.delay, "second_hit_ratio": self.second_hit.ratio}
        return {name: law for name, law in found.items() if law is not None}


class Population(_Source):
    """Particles of one kind and the way they fall; several populations may share a label."""

    _DRAWN = ("density", "youngs_modulus", "poisson_ratio", "radius", "restitution", "drop_height", "velocity")

    density: Annotated[Distribution, measured("density"), measured_within("density")]
    youngs_modulus: Annotated[Distribution, measured("modulus"), measured_within("modulus")]
    poisson_ratio: Annotated[
        Distribution, measured("ratio"), within(-1 + 1e-9, 0.5 - 1e-9, "must lie between -1 and 0.5")
    ]
    radius: _Length
    restitution: (
        Annotated[Distribution, measured("ratio"), _between(LOWEST_RESTITUTION, HIGHEST_RESTITUTION)] | None
    ) = None
    drop_height: _Length | None = None
    velocity: Annotated[Distribution, measured("speed"), measured_within("speed")] | None = None

    @model_validator(mode="after")
    def _one_way_to_fall(self) -> Self:
        if (self.drop_height is None) == (self.velocity is None):
            raise ValueError("must have either drop_height or velocity, and not both")
        return self


if TYPE_CHECKING:
    Law = str
    Shape = str
else:
    Law = Literal[*HUNT_CROSSLEY_LAWS]
    Shape = Literal[*SHAPES]


class Tap(_Source):
    """Pulses of a prescribed shape, which no fall of a sphere has made."""

    _DRAWN = ("peak_force", "contact_duration")

    shape: Shape
    peak_force: _Force
    contact_duration: _Time


class TargetSection(Section):
    """The elastic half space that is hit, a thin plate if it has a thickness; `target = "rigid"` for a rigid wall."""

    density: Density = 7850.0
    youngs_modulus: Modulus
    poisson_ratio: Ratio = Field(gt=-1, lt=0.5)
    thickness: Length | None = None

    @property
    def material(self) -> Material:
        """What the target is of."""
        return Material(**self.model_dump(exclude={"thickness"}))

    @property
    def body(self) -> HalfSpace | ThinPlate:
        """The target itself."""
        return (
            HalfSpace(material=self.material)
            if self.thickness is None
            else ThinPlate(material=self.material, thickness=self.thickness)
        )


class ImpactSection(Section):
    """The laws of the impact."""

    stiffness: Literal["hertz", "rigid-sphere", "series"]
    dissipation: Literal["elastic", "hunt-crossley"]
    law: Law = "exact"
    target: TargetSection | Literal["rigid"]
    # The pull during contact; left out for every impact that it changes by less than the tolerance (`weight`).
    gravity: Acceleration | None = None
    gravity_tolerance: Ratio | None = Field(default=None, ge=0, le=0.1)

    @property
    def body(self) -> HalfSpace | ThinPlate | RigidWall:
        """The target of every impact."""
        return self.target.body if isinstance(self.target, TargetSection) else RIGID


class SamplingSection(Section):
    """How the frame of an impact is cut; of a stream, which has no frames, the sampling rate alone."""

    sampling_rate: Frequency
    # 0 where they are not given, as in a stream: the scene asks for them where there are frames.
    samples: Whole = Field(default=0, ge=16, le=2**20)
    pre_trigger: Whole = Field(default=0, ge=2)
    jitter: Number = Field(default=1.0, ge=0, le=1)

    @model_serializer(mode="wrap")
    def _without_frames(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = handler(self)
        frame = ("samples", "pre_trigger", "jitter")
        return {key: value for key, value in content.items() if self.samples or key not in frame}

    def frame_problems(self, is_stream: bool) -> list[str]:
        """Return what of a frame is missing, or given although there is none."""
        if is_stream:
            return [
                f"sampling.{name}: must be left out of a stream, whose length is stream.duration"
                for name in ("samples", "pre_trigger", "jitter")
                if name in self.model_fields_set
            ]
        return [f"sampling.{name}: is missing" for name in ("samples", "pre_trigger") if not getattr(self, name)]

    @model_validator(mode="after")
    def _room_for_a_pulse(self) -> Self:
        if self.samples and self.pre_trigger > self.samples - 8:
            raise ValueError(
                f"pre_trigger must leave 8 samples of the frame's {self.samples} for the pulse, got {self.pre_trigger}"
            )
        return self


class RandomiseSection(Section):
    """What is drawn anew for each block of 256 signals, in place of the fixed value of `sampling` or `sensor`."""

    sampling_rate: _Frequency | None = None
    relative_noise: Annotated[Distribution, measured("ratio"), _between(0.0, 1e6)] | None = None
    bandwidth: _Frequency | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.laws:
            raise ValueError(f"must name at least one of {', '.join(type(self).model_fields)}; or take it out")
        return self

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distributions that are there, by the name of what is drawn."""
        found = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: law for name, law in found.items() if law is not None}
