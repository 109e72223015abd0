"""The sections of a scene file, each validated separately; `cgid.scene.schema` checks the rules between them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
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
from cgid.measure.modes import COLUMNS, LEARNED_COLUMNS, Modes, rows_of_table
from cgid.physics import HUNT_CROSSLEY_LAWS, RIGID, HalfSpace, RigidWall, ThinPlate
from cgid.physics.materials import Material
from cgid.physics.tail_beam import Ribs, TailBeam
from cgid.scene.distributions import (
    LIMITS,
    Acceleration,
    Density,
    Distribution,
    Frequency,
    Length,
    Mass,
    Modulus,
    Number,
    Ratio,
    Whole,
    measured,
    measured_within,
    within,
)
from cgid.validation import Floats

#: Force over its peak against time over the duration, strictly between 0 and 1. The order defines their indices.
SHAPES: Mapping[str, Callable[[Floats], Floats]] = {
    "half-sine": lambda u: np.sin(np.pi * u),
    "square": np.ones_like,
    "triangle": lambda u: np.asarray(1 - np.abs(2 * u - 1)),
    "haversine": lambda u: np.sin(np.pi * u) ** 2,
}

#: How a rock may lose energy, and the key of a population that says how much. The order defines their indices.
DISSIPATIONS: Mapping[str, str | None] = {
    "elastic": None,
    "hunt-crossley": "restitution",
    "thornton": "yield_pressure",
    "walton-braun": "restitution",
    "kuwabara-kono": "restitution",
}
#: Those of a contact that unloads on another path, with or without viscous loss. They have no weight, and no target
#: that takes energy.
PLASTIC = ("thornton", "walton-braun")
#: Those that scenes have on a half space or a rigid wall only, and without weight.
ON_SOLID_GROUND = (*PLASTIC, "kuwabara-kono")

#: Sharpest corner and flattest side of a rock over its radius, and the least share of its mass in a blow: wider than
#: any lump.
CURVATURES, LEAST_MASS = (1e-3, 10.0), 1e-2

if TYPE_CHECKING:
    Law = str
    Shape = str
    Loss = str
else:
    Loss = Literal[*DISSIPATIONS]
    Law = Literal[*HUNT_CROSSLEY_LAWS]
    Shape = Literal[*SHAPES]


def _between(lowest: float, highest: float, usual: str = "") -> Any:
    return within(lowest, highest, f"must lie between {lowest:g} and {highest:g}{usual}")


_Force = Annotated[Distribution, measured("force"), measured_within("force")]
_Time = Annotated[Distribution, measured("time"), measured_within("time")]
_Frequency = Annotated[Distribution, measured("frequency"), measured_within("frequency")]
_Pressure = Annotated[Distribution, measured("modulus"), measured_within("modulus")]
_Length = Annotated[Distribution, measured("length"), measured_within("length")]


class Section(BaseModel):
    """A section of the file: no unknown keys, no nan."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SecondHit(Section):
    """A repetition of the pulse, `delay` after touch and `ratio` times as high; the two may overlap.

    Parameters
    ----------
    delay : distribution [s]
        Time from the first touch to the second.
    ratio : distribution
        Height of the second pulse over that of the first.
    """

    delay: _Time
    ratio: Annotated[Distribution, measured("ratio"), _between(1e-3, 1e3)]


class _Source(Section):
    """Base of populations and taps."""

    _DRAWN: ClassVar[tuple[str, ...]] = ()

    label: Annotated[str, AfterValidator(partial(validation.label, "label"))]
    weight: Number = Field(default=1.0, gt=0, le=1e9)
    second_hit: SecondHit | None = None
    clipped_at: Annotated[Distribution, measured("ratio"), _between(1e-3, 1.0)] | None = None

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distributions of this section, by the name of the drawn quantity."""
        found = {name: getattr(self, name) for name in (*self._DRAWN, "clipped_at")}
        if self.second_hit is not None:
            found |= {"second_hit_delay": self.second_hit.delay, "second_hit_ratio": self.second_hit.ratio}
        return {name: law for name, law in found.items() if law is not None}


class Population(_Source):
    """Particles of one kind and how they fall; several populations may share a label.

    Parameters
    ----------
    label : str
        Class of the rocks, such as "coal": 1 to 100 letters, digits, blanks, `_`, `.` or `-`; "unknown" is reserved.
    weight : float
        How often this population is drawn, relative to the others.
    second_hit : SecondHit, optional
        The pulse comes a second time.
    clipped_at : distribution, optional
        Share of the peak at which the pulse is clipped, as by a sensor whose range is too small.
    dissipation : str, optional
        How these rocks lose energy, instead of `impact.dissipation`. Populations of one label may differ in it: then
        their weights say how often each law applies.
    density : distribution [kg/m^3]
        Density of the rock.
    youngs_modulus : distribution [Pa]
        Young's modulus of the rock.
    poisson_ratio : distribution
        Poisson's ratio of the rock.
    radius : distribution [m]
        Radius of the rock, a sphere, or of the sphere of equal mass.
    curvature : distribution, optional
        Radius of curvature where the rock touches, over its radius: below 1 at a corner, above 1 on a flat side; left
        out for a sphere.
    effective_mass : distribution, optional
        Mass that takes part in the blow, over the mass of the rock: below 1 where it touches beside its centre and
        turns aside; left out for a central blow.
    restitution : distribution, optional
        Rebound speed over impact speed that the rock alone would have; for hunt-crossley, walton-braun and
        kuwabara-kono dissipation.
    yield_pressure : distribution, optional [Pa]
        Contact pressure at which the rock crushes; for thornton dissipation.
    strength : distribution, optional [Pa]
        Uniaxial compressive strength of the rock, instead of `yield_pressure`, which is 1.6 times as high.
    viscous_restitution : distribution, optional
        Rebound speed over impact speed that a viscous loss alone would leave, for rocks that lose energy in both ways:
        beside `yield_pressure` or `strength` of thornton dissipation, or `restitution` of walton-braun dissipation.
    drop_height : distribution, optional [m]
        How far the rock falls; either this or `velocity`.
    velocity : distribution, optional [m/s]
        Impact speed; either this or `drop_height`.
    """

    _DRAWN = (
        "density",
        "youngs_modulus",
        "poisson_ratio",
        "radius",
        "curvature",
        "effective_mass",
        "restitution",
        "yield_pressure",
        "strength",
        "viscous_restitution",
        "drop_height",
        "velocity",
    )

    dissipation: Loss | None = None
    density: Annotated[Distribution, measured("density"), measured_within("density")]
    youngs_modulus: _Pressure
    poisson_ratio: Annotated[
        Distribution, measured("ratio"), within(-1 + 1e-9, 0.5 - 1e-9, "must lie between -1 and 0.5")
    ]
    radius: _Length
    curvature: Annotated[Distribution, measured("ratio"), _between(*CURVATURES, " and is 1 for a sphere")] | None = None
    effective_mass: (
        Annotated[Distribution, measured("ratio"), _between(LEAST_MASS, 1.0, " and is 1 for a central blow")] | None
    ) = None
    restitution: (
        Annotated[Distribution, measured("ratio"), _between(LOWEST_RESTITUTION, HIGHEST_RESTITUTION)] | None
    ) = None
    yield_pressure: _Pressure | None = None
    strength: _Pressure | None = None
    viscous_restitution: (
        Annotated[Distribution, measured("ratio"), _between(LOWEST_RESTITUTION, HIGHEST_RESTITUTION)] | None
    ) = None
    drop_height: _Length | None = None
    velocity: Annotated[Distribution, measured("speed"), measured_within("speed")] | None = None

    @model_validator(mode="after")
    def _one_way_to_fall(self) -> Self:
        if (self.drop_height is None) == (self.velocity is None):
            raise ValueError("must have either drop_height or velocity, and not both")
        return self


class Tap(_Source):
    """Pulses of a prescribed shape, such as those of a hammer.

    Parameters
    ----------
    label : str
        Class of the taps; the same rule as for populations.
    weight : float
        How often this tap is drawn, relative to the other sources.
    second_hit : SecondHit, optional
        The pulse comes a second time.
    clipped_at : distribution, optional
        Share of the peak at which the pulse is clipped.
    shape : str
        Force over its peak against time over the duration.
    peak_force : distribution [N]
        Largest force.
    contact_duration : distribution [s]
        Time from touch to separation.
    """

    _DRAWN = ("peak_force", "contact_duration")

    shape: Shape
    peak_force: _Force
    contact_duration: _Time


class TargetSection(Section):
    """The target: an elastic half space, or a thin plate if it has a thickness; `target = "rigid"` for a rigid wall.

    Parameters
    ----------
    density : float [kg/m^3]
        Density of the target.
    youngs_modulus : float [Pa]
        Young's modulus of the target.
    poisson_ratio : float
        Poisson's ratio of the target.
    thickness : float, optional [m]
        Makes the target a thin plate that no wave returns in; left out where there is a tail beam.
    """

    density: Density = 7850.0
    youngs_modulus: Modulus
    poisson_ratio: Ratio = Field(gt=-1, lt=0.5)
    thickness: Length | None = None

    @property
    def material(self) -> Material:
        """The material of the target."""
        return Material(**self.model_dump(exclude={"thickness"}))

    @property
    def body(self) -> HalfSpace | ThinPlate:
        """The target as a body."""
        return (
            HalfSpace(material=self.material)
            if self.thickness is None
            else ThinPlate(material=self.material, thickness=self.thickness)
        )


class ImpactSection(Section):
    """The laws of the impact.

    Parameters
    ----------
    stiffness : str
        Theory of the contact stiffness; there is no default.
    dissipation : str
        How the rock loses energy: not at all, by hysteretic damping, by crushing where it touches (thornton), as a
        bilinear spring (walton-braun), or as a viscoelastic sphere (kuwabara-kono). The last three need a half space or
        a rigid wall, and no gravity. Rocks that crush, or are bilinear, may also have a `viscous_restitution`.
    law : str
        For hunt-crossley, relation of the damping to the restitution: "exact" delivers the restitution that is asked
        for; the published factors deliver another one.
    target : TargetSection or "rigid"
        What is hit: an elastic body, or a wall that does not yield.
    gravity : float, optional [m/s^2]
        Weight of the rock during contact; left out for none.
    gravity_tolerance : float, optional
        Weight is ignored for every impact that it changes by less than this share.
    """

    stiffness: Literal["hertz", "rigid-sphere", "series"]
    dissipation: Loss
    law: Law = "exact"
    target: TargetSection | Literal["rigid"]
    gravity: Acceleration | None = None
    gravity_tolerance: Ratio | None = Field(default=None, ge=0, le=0.1)

    @model_validator(mode="after")
    def _law_applies(self) -> Self:
        if self.dissipation in ON_SOLID_GROUND and self.law != "exact":
            raise ValueError(f"law must be left out when dissipation is {self.dissipation}, got {self.law!r}")
        return self

    @property
    def body(self) -> HalfSpace | ThinPlate | RigidWall:
        """The target of every impact."""
        return self.target.body if isinstance(self.target, TargetSection) else RIGID


class SamplingSection(Section):
    """How frames are sampled; for a stream, which has no frames, only the sampling rate.

    Parameters
    ----------
    sampling_rate : float [Hz]
        Samples per second.
    samples : int
        Length of a frame; required, except in a stream, where it is left out.
    pre_trigger : int
        Samples before touch; required, except in a stream, where it is left out.
    jitter : float
        Touch falls anywhere within this part of a sample.
    """

    sampling_rate: Frequency
    # 0 for a stream; required for frames.
    samples: Whole = Field(default=0, ge=16, le=2**20)
    pre_trigger: Whole = Field(default=0, ge=2)
    jitter: Number = Field(default=1.0, ge=0, le=1)

    @model_serializer(mode="wrap")
    def _without_frames(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = handler(self)
        frame = ("samples", "pre_trigger", "jitter")
        return {key: value for key, value in content.items() if self.samples or key not in frame}

    def frame_problems(self, is_stream: bool) -> list[str]:
        """Return error messages for frame settings that are missing, or given although there is no frame."""
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
    """Settings drawn for each block of 256 signals, in place of the fixed values of `sampling` or `sensor`.

    Parameters
    ----------
    sampling_rate : distribution, optional [Hz]
        Drawn in place of `sampling.sampling_rate`.
    relative_noise : distribution, optional
        Drawn in place of `sensor.relative_noise`.
    bandwidth : distribution, optional [Hz]
        Drawn in place of `sensor.bandwidth`; off above 0.45 of the sampling rate.
    noise_exponent : distribution, optional
        Drawn in place of `sensor.noise_exponent`; 0 is white noise.
    hum : distribution, optional
        Amplitude over the largest sample of each signal, for a force over the true peak, of a sine that is added to
        the background; 0 is none.
    hum_frequency : distribution, optional [Hz]
        Its frequency, 50 Hz when left out.
    relative_range : distribution, optional
        Drawn in place of `sensor.relative_range`: below 1 the pulses are clipped.
    bits : distribution, optional
        Drawn in place of `sensor.bits`, and rounded to a whole number.
    anti_alias_frequency : distribution, optional [Hz]
        Drawn in place of `sensor.anti_alias.frequency`, of order 8 when left out; off above 0.45 of the sampling rate.
    """

    sampling_rate: _Frequency | None = None
    relative_noise: Annotated[Distribution, measured("ratio"), _between(0.0, 1e6)] | None = None
    bandwidth: _Frequency | None = None
    noise_exponent: Annotated[Distribution, measured("ratio"), _between(-1.0, 2.0)] | None = None
    hum: Annotated[Distribution, measured("ratio"), _between(0.0, 1e6)] | None = None
    hum_frequency: _Frequency | None = None
    relative_range: Annotated[Distribution, measured("ratio"), _between(1e-3, 1e6)] | None = None
    bits: Annotated[Distribution, measured("ratio"), _between(2, 32)] | None = None
    anti_alias_frequency: _Frequency | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.laws:
            raise ValueError(f"must name at least one of {', '.join(type(self).model_fields)}; or take it out")
        if self.hum_frequency is not None and self.hum is None:
            raise ValueError("hum_frequency must come with hum, its amplitude; give that, too, or leave it out")
        return self

    @property
    def laws(self) -> dict[str, Distribution]:
        """The distributions of this section, by the name of the drawn setting."""
        found = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: law for name, law in found.items() if law is not None}


_PLACE = within(0.0, LIMITS["length"][1], f"must lie between 0 and {LIMITS['length'][1]:g} m", "m")
_Place = Annotated[Distribution, measured("length"), _PLACE]

# Shapes may have any scale; the modal mass includes it.
_SHAPE = Field(ge=-1e6, le=1e6)


class ImpactPoint(Section):
    """The point of impact: x along the length from the held edge, y along the width.

    Parameters
    ----------
    x : distribution [m]
        Along the length, from the held edge.
    y : distribution [m]
        Over the width.
    """

    x: _Place
    y: _Place


class SensorPoint(Section):
    """The position of the sensor.

    Parameters
    ----------
    x : float [m]
        Along the length, from the held edge.
    y : float [m]
        Over the width.
    """

    x: Annotated[Length, Field(ge=0)]
    y: Annotated[Length, Field(ge=0)]


class RibsSection(Section):
    """Longitudinal ribs under the skin.

    Parameters
    ----------
    number : int
        Number of ribs, evenly spaced over the width.
    depth : float [m]
        Depth of a rib, perpendicular to the skin.
    thickness : float [m]
        Thickness of a rib.
    """

    number: Whole = Field(ge=1, le=100)
    depth: Length
    thickness: Length


class ModeRow(Section):
    """A mode measured in a tap test.

    Parameters
    ----------
    frequency : float [Hz]
        Natural frequency.
    damping_ratio : float
        Share of critical damping.
    modal_mass : float [kg]
        Modal mass, consistent with the scale of the shapes.
    shape_impact : float
        Shape of the mode where the rocks hit.
    shape_sensor : float
        Shape of the mode where the sensor sits.
    """

    frequency: Frequency
    damping_ratio: Ratio = Field(gt=0, lt=1)
    modal_mass: Mass
    shape_impact: Annotated[Number, _SHAPE]
    shape_sensor: Annotated[Number, _SHAPE]


_DEVIATION = Field(default=0.0, ge=0, le=1)


class LearnedRow(Section):
    """A mode of the beam as blows have taught it: `cgid calibrate`.

    Parameters
    ----------
    frequency : float [Hz]
        Natural frequency.
    damping_ratio : float
        Share of critical damping.
    participation : float
        Factor of the participation of the beam's own mode.
    frequency_deviation, damping_ratio_deviation, participation_deviation : float
        Standard deviations of their logarithms: each block of 256 signals draws its modes with them.
    """

    frequency: Frequency
    damping_ratio: Ratio = Field(gt=0, lt=1)
    participation: Number = Field(default=1.0, gt=0, le=1e6)
    frequency_deviation: Annotated[Ratio, _DEVIATION]
    damping_ratio_deviation: Annotated[Ratio, _DEVIATION]
    participation_deviation: Annotated[Ratio, _DEVIATION]


class TailBeamSection(Section):
    """A rectangular panel, stiffened or not, or modes measured in a tap test.

    Parameters
    ----------
    length : float [m]
        Length of the panel, from the held edge.
    width, thickness : float [m]
        Width and thickness of the panel.
    edges : str
        How the edges are held: all four simply supported or clamped, or one edge clamped.
    damping_ratio : float
        Share of critical damping of every mode.
    ribs : RibsSection, optional
        Ribs under the panel, along its length.
    impact_point : ImpactPoint
        Where rocks hit the panel.
    sensor_point : SensorPoint
        Where the sensor sits.
    modes : tuple of ModeRow
        Instead of a panel, modes measured in a tap test, with ascending frequencies; in a file `modes = "modes.csv"`
        reads them from a table.
    learned : tuple of LearnedRow, optional
        What blows have taught of the modes of the panel, or of those measured, one row for each in their order; in a
        file `learned = "site-modes.csv"` reads them from a table, as `cgid calibrate` writes it.
    coupling : str
        How the beam yields under a rock: as an infinite thin plate, through its modes, or whichever applies.
    """

    length: Length | None = None
    width: Length | None = None
    thickness: Length | None = None
    edges: Literal["simply-supported", "clamped", "cantilever"] | None = None
    damping_ratio: Annotated[Ratio, Field(gt=0, lt=1)] | None = None
    ribs: RibsSection | None = None
    impact_point: ImpactPoint | None = None
    sensor_point: SensorPoint | None = None
    modes: tuple[ModeRow, ...] | None = Field(default=None, min_length=1, max_length=10_000)
    learned: tuple[LearnedRow, ...] | None = Field(default=None, min_length=1, max_length=10_000)
    coupling: Literal["auto", "impedance", "modes"] = "auto"

    @model_validator(mode="after")
    def _panel_or_table(self) -> Self:
        panel = ("length", "width", "thickness", "edges", "damping_ratio", "impact_point", "sensor_point")
        missing = [name for name in panel if getattr(self, name) is None]
        given = [name for name in (*panel, "ribs") if getattr(self, name) is not None]
        if self.modes is None and missing:
            raise ValueError(f"must have {', '.join(missing)}, or modes in place of a panel")
        if self.modes is not None and given:
            raise ValueError(f"must have either modes or a panel, and not both; take out {', '.join(given)}")
        if self.modes is not None and self.coupling == "impedance":
            raise ValueError("coupling must be auto or modes where the modes are measured: a table has no impedance")
        self._require_ascending()
        self._require_audible()
        self._require_on_panel()
        return self

    def _require_ascending(self) -> None:
        rows = self.modes or ()
        for number in range(1, len(rows)):
            if rows[number].frequency < rows[number - 1].frequency:
                raise ValueError(
                    f"modes must be sorted by frequency, row {number + 1} has {rows[number].frequency:g} Hz after "
                    f"{rows[number - 1].frequency:g} Hz; sort them"
                )

    def _require_audible(self) -> None:
        if self.modes is not None and not any(row.shape_impact * row.shape_sensor for row in self.modes):
            raise ValueError(
                "modes must hold one whose shape is not 0 both where the rocks hit and where the sensor sits; "
                "there is none, and nothing would be heard"
            )

    def _require_on_panel(self) -> None:
        if self.impact_point is None or self.sensor_point is None:
            return
        for axis, size in (("x", self.length), ("y", self.width)):
            assert size is not None
            for name, place in (
                ("impact_point", getattr(self.impact_point, axis).extremes[1]),
                ("sensor_point", getattr(self.sensor_point, axis)),
            ):
                if place > size:
                    raise ValueError(
                        f"{name}.{axis} must lie on the beam, between 0 and {size:g} m, it can be {place:.4g} m"
                    )

    def panel(self, material: Material) -> TailBeam | None:
        """Return the panel, made of a material; None for measured modes."""
        if self.modes is not None:
            return None
        ribs = None if self.ribs is None else Ribs(**self.ribs.model_dump())
        names = ("length", "width", "thickness", "edges", "damping_ratio")
        return TailBeam(material=material, ribs=ribs, **{name: getattr(self, name) for name in names})

    @property
    def couples_always(self) -> bool:
        """Whether every impact goes through the modes: by choice, or because measured modes have no impedance."""
        return self.modes is not None or self.coupling == "modes"

    @cached_property
    def measured(self) -> Modes | None:
        """The measured modes."""
        return _modes_of(self.modes, COLUMNS)

    @cached_property
    def learned_modes(self) -> Modes | None:
        """The learned modes, relative to the beam's own."""
        return _modes_of(self.learned, LEARNED_COLUMNS)

    def with_learned(self, modes: Modes) -> TailBeamSection:
        """Return the beam with other learned modes."""
        rows = [LearnedRow.model_construct(None, **row) for row in rows_of(modes)]
        made = self.model_copy(update={"learned": tuple(rows)})
        made.__dict__.pop("learned_modes", None)  # a copy keeps what is cached
        return made


def _modes_of(rows: tuple[Any, ...] | None, columns: Iterable[str]) -> Modes | None:
    return None if rows is None else Modes.of({name: [getattr(row, name) for row in rows] for name in columns})


def rows_of(modes: Modes) -> list[dict[str, float]]:
    """Return a row of `tail_beam.learned` for each mode."""
    columns = modes.columns
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def with_table(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a scene file with the tables named in `tail_beam` replaced by their rows."""
    beam = content.get("tail_beam")
    if not isinstance(beam, dict):
        return content
    rows = {}
    if isinstance(beam.get("modes"), str):
        rows["modes"] = rows_of_table(folder / beam["modes"], COLUMNS)
    if isinstance(beam.get("learned"), str):
        rows["learned"] = rows_of_table(folder / beam["learned"], LEARNED_COLUMNS)
    return content | {"tail_beam": beam | rows} if rows else content
