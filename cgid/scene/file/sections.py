"""The sections of a scene file, each validated separately; `cgid.scene.file.schema` checks the rules between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    GetCoreSchemaHandler,
    SerializerFunctionWrapHandler,
    WrapValidator,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from cgid._lib import validation
from cgid._lib.validation import Floats, Rule, poisson_ratio
from cgid.measure.fit.family import MAX_RESTITUTION, MIN_RESTITUTION
from cgid.measure.modal.modes import COLUMNS, LEARNED_COLUMNS, Modes, rows_of_shapes, rows_of_table
from cgid.physics.contact.bodies import RIGID, HalfSpace, RigidWall, ThinPlate
from cgid.physics.contact.laws import EXPONENTS, HUNT_CROSSLEY_LAWS, LAWS, REMAINING, PowerLaw, known, named
from cgid.physics.contact.materials import Material
from cgid.physics.structure.tail_beam import Ribs, TailBeam
from cgid.scene.file.distributions import (
    LIMITS,
    Acceleration,
    DampingRatio,
    Density,
    Distribution,
    Frequency,
    Length,
    Mass,
    Modulus,
    Number,
    Quantity,
    Section,
    Share,
    WholeNumber,
    quantity_of,
)

#: Force over its peak against time over the duration, strictly between 0 and 1. The order defines their indices.
SHAPES: Mapping[str, Callable[[Floats], Floats]] = {
    "half-sine": lambda u: np.sin(np.pi * u),
    "square": np.ones_like,
    "triangle": lambda u: np.asarray(1 - np.abs(2 * u - 1)),
    "haversine": lambda u: np.sin(np.pi * u) ** 2,
}

#: How a rock may lose energy, by laws of cgid. The order defines their indices; those of your own come after them.
DISSIPATIONS = tuple(LAWS)
#: Laws whose numbers in data are fixed: never changed, so that a later built-in law moves no other.
NUMBERED_LAWS = ("elastic", "hunt-crossley", "thornton", "walton-braun", "kuwabara-kono")
#: Those of a contact that unloads on another path, with or without viscous loss.
PLASTIC = ("thornton", "walton-braun")

#: Limits of the curvature of a rock over its radius, and minimum fraction of its mass in an impact: wider than any
#: rock.
CURVATURES, MIN_MASS = (1e-3, 10.0), 1e-2
#: The keys of power-law dissipation beside the restitution, and their defaults: a sphere that never breaks.
CONTACT_SHAPE = {key: getattr(PowerLaw, key) for key in PowerLaw.keys if key != "restitution"}
#: Maximum number of rows of a table of modes; least and largest number of places of a table of shapes.
_MAX_MODES, _PLACES = 10_000, (6, 2_000)
#: Impacts may be this far outside of the places of a table of shapes [m].
_WITHIN = 1e-6


def _or_custom_law(value: Any, handler: Callable[[Any], Any]) -> Any:
    """Accept the name of a law of your own, too."""
    return value if isinstance(value, str) and value not in DISSIPATIONS and known(value) else handler(value)


def loss_key(dissipation: str) -> str | None:
    """Return the key of a population with the amount of loss, None for none."""
    return next((key for key in named(dissipation).keys if key in ("restitution", "yield_pressure")), None)


if TYPE_CHECKING:
    Law = str
    Shape = str
    Loss = str
else:
    Loss = Annotated[Literal[*DISSIPATIONS], WrapValidator(_or_custom_law)]
    Law = Literal[*HUNT_CROSSLEY_LAWS]
    Shape = Literal[*SHAPES]


_Density = Annotated[Distribution, Quantity.of("density")]
_Force = Annotated[Distribution, Quantity.of("force")]
_Time = Annotated[Distribution, Quantity.of("time")]
_Frequency = Annotated[Distribution, Quantity.of("frequency")]
_Pressure = Annotated[Distribution, Quantity.of("modulus")]
_Length = Annotated[Distribution, Quantity.of("length")]
_Speed = Annotated[Distribution, Quantity.of("speed")]
_Factor = Annotated[Distribution, Quantity("ratio", Rule(1e-3, 1e3))]
_Clipped = Annotated[Distribution, Quantity("ratio", Rule(1e-3, 1))]
_Restitution = Annotated[Distribution, Quantity("ratio", Rule(MIN_RESTITUTION, MAX_RESTITUTION))]
_Poisson = Annotated[Distribution, Quantity("ratio", poisson_ratio)]
_Curvature = Annotated[Distribution, Quantity("ratio", Rule(*CURVATURES, note=" and is 1 for a sphere"))]
_ImpactMass = Annotated[Distribution, Quantity("ratio", Rule(MIN_MASS, 1, note=" and is 1 for a central impact"))]
_Relative = Annotated[Distribution, Quantity("ratio", Rule(0, 1e6))]
_Range = Annotated[Distribution, Quantity("ratio", Rule(1e-3, 1e6))]
_Exponent = Annotated[Distribution, Quantity("ratio", Rule(-1, 2))]
_Shape = Annotated[Distribution, Quantity("ratio", Rule(*EXPONENTS, note=" and is 1.5 for a sphere"))]
_Remaining = Annotated[Distribution, Quantity("ratio", Rule(*REMAINING))]
_Bits = Annotated[Distribution, Quantity("ratio", Rule(2, 32))]


class SecondHit(Section):
    """A repetition of the pulse, `delay` after onset and `ratio` times as high; the two may overlap."""

    delay: _Time
    """Time from the first onset to the second."""
    ratio: _Factor
    """Height of the second pulse over that of the first."""


class _Source(Section):
    """Base of populations and taps."""

    label: Annotated[str, AfterValidator(partial(validation.label, "label"))]
    """Class, such as "coal": 1 to 100 letters, digits, blanks, `_`, `.` or `-`; "unknown" is reserved."""
    weight: Annotated[Number, Quantity(rule=Rule(0, 1e9, without="lowest"))] = 1.0
    """Relative frequency of this source."""
    second_hit: SecondHit | None = None
    """A repetition of the pulse."""
    clipped_at: _Clipped | None = None
    """Fraction of the peak at which the pulse is clipped, as by a sensor of too small a range."""

    @cached_property
    def laws(self) -> dict[str, Distribution]:
        """The distributions of this section, by the name of the drawn quantity."""
        again = {} if self.second_hit is None else self.second_hit.distributions
        return self.distributions | {f"second_hit_{name}": law for name, law in again.items()}


class Population(_Source):
    """Rocks of one type and their fall; several populations may have the same label."""

    dissipation: Loss | None = None
    """How these rocks lose energy, instead of `impact.dissipation`. Populations of one label may differ in it:
    then their weights are the frequencies of the laws.
    """
    density: _Density
    """Density of the rock."""
    youngs_modulus: _Pressure
    """Young's modulus of the rock."""
    poisson_ratio: _Poisson
    """Poisson's ratio of the rock."""
    radius: _Length
    """Radius of the rock, a sphere, or of the sphere of equal mass."""
    curvature: _Curvature | None = None
    """Radius of curvature of the rock at the contact, over its radius: below 1 at a corner, above 1 on a flat side; 1
    by default.
    """
    effective_mass: _ImpactMass | None = None
    """Effective mass of the impact over the mass of the rock: below 1 for an eccentric impact, in which the rock turns
    aside; 1 by default.
    """
    restitution: _Restitution | None = None
    """Rebound speed over impact speed of the rock by itself; for hunt-crossley, walton-braun,
    kuwabara-kono and power-law dissipation.
    """
    yield_pressure: _Pressure | None = None
    """Contact pressure at which the rock crushes; for thornton dissipation."""
    strength: _Pressure | None = None
    """Uniaxial compressive strength of the rock, instead of `yield_pressure`, which is 1.6 times as high."""
    viscous_restitution: _Restitution | None = None
    """Rebound speed over impact speed by a viscous loss alone, for rocks with both losses: in addition to
    `yield_pressure` or `strength` of thornton dissipation, or `restitution` of walton-braun dissipation.
    """
    exponent: _Shape | None = None
    """Exponent of the force over the approach, of power-law dissipation: 1 of a face, 1.5 of a sphere, 2 of a corner.
    """
    contact_radius: _Factor | None = None
    """Where the shape of that exponent crosses the sphere, over its radius of curvature: the radius of a face, or twice
    the cotangent of a corner's half angle, 1.15 at 60 and 0.35 at 80 degrees; 1 by default, without effect on a sphere.
    """
    breaking_force: _Clipped | None = None
    """Force without damping at which the rock breaks, over the peak force without loss, of power-law dissipation; never
    by default, nor if its loss stops the rock before.
    """
    remaining_force: _Remaining | None = None
    """Fraction of the force that is left when it breaks."""
    drop_height: _Length | None = None
    """Drop height of the rock; either this or `velocity`."""
    velocity: _Speed | None = None
    """Impact speed; either this or `drop_height`."""

    @model_validator(mode="after")
    def _one_way_to_fall(self) -> Self:
        if (self.drop_height is None) == (self.velocity is None):
            raise ValueError("must have either drop_height or velocity")
        if (self.breaking_force is None) != (self.remaining_force is None):
            raise ValueError("must have both breaking_force and remaining_force, or neither")
        return self


class PrescribedPulses(_Source):
    """Pulses of a prescribed shape, such as those of a hammer."""

    shape: Shape
    """Force over its peak against time over the duration."""
    peak_force: _Force
    """Largest force."""
    contact_duration: _Time
    """Time from onset to separation."""


class TargetSection(Section):
    """The target: an elastic half space, or a thin plate if it has a thickness; `target = "rigid"` for a rigid wall."""

    density: Density = 7850.0
    """Density of the target."""
    youngs_modulus: Modulus
    """Young's modulus of the target."""
    poisson_ratio: Annotated[float, Quantity("ratio", poisson_ratio)]
    """Poisson's ratio of the target."""
    thickness: Length | None = None
    """Makes the target a thin plate without returning waves; must be left out with a tail beam."""

    @cached_property
    def material(self) -> Material:
        """The material of the target."""
        return Material(**self.model_dump(exclude={"thickness"}))

    @cached_property
    def body(self) -> HalfSpace | ThinPlate:
        """The target as a body."""
        if self.thickness is None:
            return HalfSpace(material=self.material)
        return ThinPlate(material=self.material, thickness=self.thickness)


class ImpactSection(Section):
    """The laws of the impact."""

    stiffness: Literal["hertz", "rigid-sphere", "series"]
    """Theory of the contact stiffness; there is no default."""
    dissipation: Loss
    """How the rock loses energy: not at all, by hysteretic damping, by crushing at the contact (thornton), as
    a bilinear spring (walton-braun), as a viscoelastic sphere (kuwabara-kono), or as a face, an edge or a corner that
    may break (power-law). Rocks that crush, or are
    bilinear, may also have a `viscous_restitution`.
    """
    law: Law = "exact"
    """For hunt-crossley, relation of the damping to the restitution: "exact" gives the requested restitution; the
    published factors give another one.
    """
    target: TargetSection | Literal["rigid"]
    """The target: an elastic body, or a rigid wall."""
    gravity: Acceleration | None = None
    """Gravity during contact; none by default."""
    gravity_tolerance: Annotated[float, Quantity("ratio", Rule(0, 0.1))] | None = None
    """Gravity is ignored for every elastic or hunt-crossley impact that it changes by less than this fraction."""

    @model_validator(mode="after")
    def _law_applies(self) -> Self:
        if self.dissipation not in ("elastic", "hunt-crossley") and self.law != "exact":
            raise ValueError(f"law must be left out when dissipation is {self.dissipation}, got {self.law!r}")
        return self

    @property
    def body(self) -> HalfSpace | ThinPlate | RigidWall:
        """The target of every impact."""
        return self.target.body if isinstance(self.target, TargetSection) else RIGID


class SamplingSection(Section):
    """How frames are sampled; for a stream, which has no frames, only the sampling rate."""

    sampling_rate: Frequency
    """Samples per second."""
    samples: Annotated[WholeNumber, Quantity(rule=Rule(16, 2**20))] = 0
    """Length of a frame; required, except in a stream, where it is left out."""
    pre_trigger: Annotated[WholeNumber, Quantity(rule=Rule(2))] = 0
    """Samples before onset; required, except in a stream, where it is left out."""
    jitter: Annotated[Number, Quantity(rule=Rule(0, 1))] = 1.0
    """Range of the random onset within a sample, as a fraction."""

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
    def _frame_fits_pulse(self) -> Self:
        if self.samples and self.pre_trigger > self.samples - 8:
            raise ValueError(
                f"pre_trigger must leave 8 samples of the frame's {self.samples} for the pulse, got {self.pre_trigger}"
            )
        return self


class RandomiseSection(Section):
    """Settings drawn for each block of 256 signals, instead of the fixed values of `sampling` or `sensor`."""

    # The order of the keys is that of their random numbers: append new ones.

    sampling_rate: _Frequency | None = None
    """Drawn instead of `sampling.sampling_rate`."""
    relative_noise: _Relative | None = None
    """Drawn instead of `sensor.relative_noise`."""
    bandwidth: _Frequency | None = None
    """Drawn instead of `sensor.bandwidth`; off above 0.45 of the sampling rate."""
    noise_exponent: _Exponent | None = None
    """Drawn instead of `sensor.noise_exponent`; 0 is white noise."""
    hum: _Relative | None = None
    """Amplitude over the largest sample of each signal, for a force over the true peak, of a sine that is added
    to the background; 0 is none.
    """
    hum_frequency: _Frequency | None = None
    """Its frequency, 50 Hz when left out."""
    relative_range: _Range | None = None
    """Drawn instead of `sensor.relative_range`: below 1 the pulses are clipped."""
    bits: _Bits | None = None
    """Drawn instead of `sensor.bits`, and rounded to a whole number."""
    anti_alias_frequency: _Frequency | None = None
    """Drawn instead of `sensor.anti_alias.frequency`, of order 8 when left out; off above 0.45 of the sampling
    rate.
    """

    ac_coupling: _Frequency | None = None
    """Drawn instead of `sensor.ac_coupling`; off below 0.01 Hz."""

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.laws:
            raise ValueError(f"must name at least one of {', '.join(type(self).model_fields)}; or remove it")
        if self.hum_frequency is not None and self.hum is None:
            raise ValueError("hum_frequency needs hum, its amplitude; give that, too, or leave it out")
        return self

    @cached_property
    def laws(self) -> dict[str, Distribution]:
        """The distributions of this section, by the name of the drawn setting."""
        return self.distributions


_Position = Annotated[Distribution, Quantity("length", Rule(0, LIMITS["length"][1]))]
# Shapes may have any scale; the modal mass includes it.
_ShapeValue = Annotated[Number, Quantity(rule=Rule(-1e6, 1e6))]


class ImpactPoint(Section):
    """The point of impact: x along the length from the clamped edge, y along the width."""

    x: _Position
    """Along the length, from the clamped edge."""
    y: _Position
    """Over the width."""


class SensorPoint(Section):
    """The position of the sensor."""

    x: Length
    """Along the length, from the clamped edge."""
    y: Length
    """Over the width."""


class RibsSection(Section):
    """Longitudinal ribs under the skin."""

    number: Annotated[WholeNumber, Quantity(rule=Rule(1, 100))]
    """Number of ribs, evenly spaced over the width."""
    depth: Length
    """Depth of a rib, perpendicular to the skin."""
    thickness: Length
    """Thickness of a rib."""


class _Mode(Section):
    frequency: Frequency
    """Natural frequency."""
    damping_ratio: DampingRatio
    """Fraction of critical damping."""


class ModeRow(_Mode):
    """A mode measured in a tap test."""

    modal_mass: Mass
    """Modal mass, consistent with the scale of the shapes."""
    shape_impact: _ShapeValue
    """Shape of the mode at the impact."""
    shape_sensor: _ShapeValue
    """Shape of the mode at the sensor."""


class LearnedRow(_Mode):
    """A mode of the beam learned from impacts by `cgid calibrate`. Each block of 256 signals samples its modes."""

    participation: Annotated[Number, Quantity(rule=Rule(0, 1e6, without="lowest"))] = 1.0
    """Factor of the participation of the beam's mode."""
    frequency_deviation: Share = 0.0
    """Standard deviation of the logarithm of the frequency."""
    damping_ratio_deviation: Share = 0.0
    """Standard deviation of the logarithm of the damping ratio."""
    participation_deviation: Share = 0.0
    """Standard deviation of the logarithm of the participation."""


class ShapeRow(Section):
    """A place where the shapes of all modes were measured."""

    x: Annotated[float, Quantity("length", Rule(0, LIMITS["length"][1]))]
    """First coordinate of the place, of the same origin as `impact_point`."""
    y: Annotated[float, Quantity("length", Rule(0, LIMITS["length"][1]))]
    """Second coordinate."""
    shape: Annotated[tuple[float, ...], Field(min_length=1, max_length=_MAX_MODES), Quantity(rule=Rule(-1e6, 1e6))]
    """Shape of each mode there, in their order and in the scale of `shape_sensor`."""


class SceneTable:
    """The rows of a table as columns, (n_rows,) or more each; equal to another and hashable by its numbers."""

    def __init__(self, columns: Mapping[str, Floats]) -> None:
        self.columns = columns

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SceneTable) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @cached_property
    def _identity(self) -> tuple[tuple[str, bytes], ...]:
        return tuple((name, column.tobytes()) for name, column in self.columns.items())

    def rows(self) -> list[dict[str, float]]:
        """Return a mapping for each row, as a scene file has it."""
        values = zip(*(column.tolist() for column in self.columns.values()), strict=True)
        return [dict(zip(self.columns, row, strict=True)) for row in values]


@dataclass(frozen=True)
class TableOf:
    """Metadata of a list of rows, which it reads column by column; row by row only to name what is wrong in them."""

    row: type[Section]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of a `SceneTable`."""
        serial = core_schema.plain_serializer_function_ser_schema(SceneTable.rows)
        return core_schema.no_info_wrap_validator_function(self._read, handler(source), serialization=serial)

    def _read(self, content: Any, row_by_row: Callable[[Any], tuple[Section, ...]]) -> SceneTable:
        columns = content.columns if isinstance(content, SceneTable) else self._columns(content)
        if columns is None:
            rows = row_by_row(content)
            lengths = {len(row.shape) for row in rows if isinstance(row, ShapeRow)}
            if len(lengths) > 1:
                raise ValueError(f"must have as many shapes at each place, got {min(lengths)} to {max(lengths)}")
            columns = {name: np.array([getattr(row, name) for row in rows]) for name in self.row.model_fields}
        return SceneTable(columns)

    def _columns(self, content: Any) -> dict[str, Floats] | None:
        """Return the columns of numbers in SI units that meet their rules; None for any other content."""
        fields = self.row.model_fields
        if not isinstance(content, list) or not 1 <= len(content) <= _MAX_MODES:
            return None
        if not all(isinstance(row, dict) and row.keys() <= fields.keys() for row in content):
            return None
        columns = {}
        for name, field in fields.items():
            values, quantity = [row.get(name, field.default) for row in content], quantity_of(field)
            if quantity is None or not all(type(value) in (int, float) and abs(value) < 1e300 for value in values):
                return None
            columns[name] = np.array(values, np.float64)
            if not quantity.rule.holds(columns[name]).all():
                return None
        return columns


if TYPE_CHECKING:
    ModeTable = SceneTable
    LearnedTable = SceneTable
    ShapeTable = SceneTable
else:
    _SIZE = Field(min_length=1, max_length=_MAX_MODES)
    ModeTable = Annotated[tuple[ModeRow, ...], _SIZE, TableOf(ModeRow)]
    LearnedTable = Annotated[tuple[LearnedRow, ...], _SIZE, TableOf(LearnedRow)]
    _PLACED = Field(min_length=_PLACES[0], max_length=_PLACES[1])
    ShapeTable = Annotated[tuple[ShapeRow, ...], _PLACED, TableOf(ShapeRow)]


class TailBeamSection(Section):
    """A rectangular panel, stiffened or not, or modes measured in a tap test."""

    length: Length | None = None
    """Length of the panel, from the clamped edge."""
    width: Length | None = None
    """Width of the panel."""
    thickness: Length | None = None
    """Thickness of the panel."""
    edges: Literal["simply-supported", "clamped", "cantilever"] | None = None
    """Support of the edges: all four simply supported or clamped, or one edge clamped."""
    damping_ratio: DampingRatio | None = None
    """Fraction of critical damping of every mode."""
    ribs: RibsSection | None = None
    """Ribs under the panel, along its length."""
    impact_point: ImpactPoint | None = None
    """Locations of the impacts."""
    sensor_point: SensorPoint | None = None
    """Position of the sensor."""
    modes: ModeTable | None = None
    """Instead of a panel, modes measured in a tap test, with ascending frequencies; in a file `modes =
    "modes.csv"` reads them from a table.
    """
    learned: LearnedTable | None = None
    """Corrections, learned from impacts, of the modes of the panel, or of measured ones, one row for each in their
    order; in a file `learned = "site-modes.csv"` reads them from a table, as `cgid calibrate` writes it.
    """
    shapes: ShapeTable | None = None
    """Shapes of the measured modes at the places of a roving hammer, between which they are interpolated: then impacts
    fall at `impact_point`. In a file `shapes = "modes-shapes.csv"` reads them from a table, as `cgid tap` writes it.
    """
    coupling: Literal["auto", "impedance", "modes"] = "auto"
    """Coupling of the beam to a rock: as an infinite thin plate, through its modes, or whichever applies."""

    @model_validator(mode="after")
    def _panel_or_table(self) -> Self:
        panel = ("length", "width", "thickness", "edges", "damping_ratio", "impact_point", "sensor_point")
        missing = [name for name in panel if getattr(self, name) is None]
        given = [name for name in (*panel, "ribs") if getattr(self, name) is not None]
        if self.modes is None and missing:
            raise ValueError(f"must have {', '.join(missing)}, or modes in place of a panel")
        if self.shapes is not None:
            given = [name for name in given if name != "impact_point"]
        if self.modes is not None and given:
            raise ValueError(f"must have either modes or a panel; remove {', '.join(given)}")
        if self.modes is not None and self.coupling == "impedance":
            raise ValueError("coupling must be auto or modes for measured modes: a table has no impedance")
        if self.length and self.width and self.thickness and self.thickness > min(self.length, self.width):
            raise ValueError(
                f"thickness must be at most length and width, as of a plate, got {self.thickness:g} m; if it is in mm, "
                f"give {self.thickness / 1e3:g}"
            )
        self._require_modes()
        self._require_shapes()
        self._require_on_panel()
        return self

    def _require_shapes(self) -> None:
        if self.shapes is None:
            return
        if self.modes is None or self.impact_point is None:
            raise ValueError("shapes must have modes and impact_point beside them; add them, or remove shapes")
        if (n := self.shapes["shape"].shape[1]) != len(self.modes):
            raise ValueError(f"shapes must have one for each of the {len(self.modes)} modes, got {n}; name both tables")
        places = np.stack([self.shapes["x"], self.shapes["y"]], axis=1)
        if len(np.unique(places, axis=0)) < len(places):
            raise ValueError("shapes must be at different places, one is there twice; leave one of them out")
        assert self.region is not None
        for axis, low, high in zip("xy", self.region[::2], self.region[1::2], strict=True):
            extremes = getattr(self.impact_point, axis).extremes
            if extremes[0] < low - _WITHIN or extremes[1] > high + _WITHIN:
                raise ValueError(
                    f"impact_point.{axis} must be among the places of shapes, {low:g} to {high:g} m, it is "
                    f"{extremes[0]:.4g} to {extremes[1]:.4g} m; change it, or tap there, too"
                )

    @cached_property
    def region(self) -> tuple[float, ...] | None:
        """Lowest and highest x, lowest and highest y of a beam that impacts may hit [m]; None for one place."""
        if self.shapes is not None:
            return tuple(float(end(self.shapes[axis])) for axis in "xy" for end in (np.min, np.max))
        return None if self.length is None or self.width is None else (0.0, self.length, 0.0, self.width)

    def _require_modes(self) -> None:
        if self.modes is None:
            return
        frequency = self.modes["frequency"]
        for row in np.flatnonzero(np.diff(frequency) < 0)[:1] + 1:
            raise ValueError(
                f"modes must be sorted by frequency, row {row + 1} has {frequency[row]:g} Hz after "
                f"{frequency[row - 1]:g} Hz; sort them"
            )
        if not (self.modes["shape_impact"] * self.modes["shape_sensor"]).any():
            raise ValueError("modes must contain one with shapes other than 0 at both impact and sensor; there is none")

    def _require_on_panel(self) -> None:
        if self.impact_point is None or self.sensor_point is None or self.modes is not None:
            return
        for axis, size in (("x", self.length), ("y", self.width)):
            assert size is not None
            for name, place in (
                ("impact_point", getattr(self.impact_point, axis).extremes[1]),
                ("sensor_point", getattr(self.sensor_point, axis)),
            ):
                if place > size:
                    raise ValueError(
                        f"{name}.{axis} must be on the beam, between 0 and {size:g} m, it can be {place:.4g} m"
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
        return None if self.modes is None else Modes.of(self.modes.columns)

    @cached_property
    def learned_modes(self) -> Modes | None:
        """The learned modes, relative to those of the beam."""
        return None if self.learned is None else Modes.of(self.learned.columns)

    def with_learned(self, modes: Modes) -> TailBeamSection:
        """Return the beam with other learned modes."""
        made = self.model_copy(update={"learned": SceneTable(modes.columns)})
        made.__dict__["learned_modes"] = modes  # a copy keeps cached values
        return made


def rows_of(modes: Modes) -> list[dict[str, float]]:
    """Return a row of `tail_beam.learned` for each mode."""
    return SceneTable(modes.columns).rows()


def with_table(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a scene file with the tables named in `tail_beam` replaced by their rows."""
    beam = content.get("tail_beam")
    if not isinstance(beam, dict):
        return content
    rows: dict[str, Any] = {}
    if isinstance(beam.get("modes"), str):
        rows["modes"] = rows_of_table(folder / beam["modes"], COLUMNS)
    if isinstance(beam.get("learned"), str):
        rows["learned"] = rows_of_table(folder / beam["learned"], LEARNED_COLUMNS)
    if isinstance(beam.get("shapes"), str):
        rows["shapes"] = rows_of_shapes(folder / beam["shapes"])
    return content | {"tail_beam": beam | rows} if rows else content
