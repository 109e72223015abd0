"""The tail beam of a scene: what it is, where it is hit, and where it is listened to."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from cgid.physics.materials import Material
from cgid.physics.modes import COLUMNS, MeasuredModes, read_measured_modes
from cgid.physics.tail_beam import Ribs, TailBeam
from cgid.scene.distributions import Distribution, measured, within
from cgid.scene.sections import Section
from cgid.scene.units import LIMITS, Frequency, Length, Mass, Number, Ratio, Whole

_PLACE = within(0.0, LIMITS["length"][1], f"must lie between 0 and {LIMITS['length'][1]:g} m", "m")
_Place = Annotated[Distribution, measured("length"), _PLACE]

# Shapes come in any scale, of which the modal mass is part.
_SHAPE = Field(ge=-1e6, le=1e6)


class ImpactPoint(Section):
    """Where the rocks hit, from the held edge along the length and along the width."""

    x: _Place
    y: _Place


class SensorPoint(Section):
    """Where the sensor sits."""

    x: Annotated[Length, Field(ge=0)]
    y: Annotated[Length, Field(ge=0)]


class RibsSection(Section):
    """Longitudinal ribs under the skin."""

    number: Whole = Field(ge=1, le=100)
    depth: Length
    thickness: Length


class ModeRow(Section):
    """A mode as a tap test gives it."""

    frequency: Frequency
    damping_ratio: Ratio = Field(gt=0, lt=1)
    modal_mass: Mass
    shape_impact: Annotated[Number, _SHAPE]
    shape_sensor: Annotated[Number, _SHAPE]


class TailBeamSection(Section):
    """A rectangular panel, stiffened or not, or what a tap test has measured of one.

    Parameters
    ----------
    length, width, thickness : float, optional
        Of the panel [m], length from the held edge.
    edges : {"simply-supported", "clamped", "cantilever"}
    damping_ratio : float
        Of every mode.
    ribs : RibsSection, optional
    impact_point, sensor_point : optional
        Of the panel.
    modes : tuple of ModeRow, optional
        In place of the panel: frequencies ascending. In a file `modes = "modes.csv"` reads them from a table.
    coupling : {"auto", "impedance", "modes"}
        How the beam gives way under a rock: as an endless thin plate, through its modes, or by what holds.
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
        """Return the panel made of a material; None where the modes are measured."""
        if self.modes is not None:
            return None
        ribs = None if self.ribs is None else Ribs(**self.ribs.model_dump())
        names = ("length", "width", "thickness", "edges", "damping_ratio")
        return TailBeam(material=material, ribs=ribs, **{name: getattr(self, name) for name in names})

    @cached_property
    def measured(self) -> MeasuredModes | None:
        """The modes of the table."""
        if self.modes is None:
            return None
        return MeasuredModes(
            **{name: np.array([getattr(row, name) for row in self.modes]) for name in ModeRow.model_fields}
        )


def with_table(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a scene file with the rows of the table that `tail_beam.modes` names, if it names one."""
    beam = content.get("tail_beam")
    if not isinstance(beam, dict) or not isinstance(beam.get("modes"), str):
        return content
    modes = read_measured_modes(folder / beam["modes"])
    columns = [np.asarray(getattr(modes, name)).tolist() for name in COLUMNS]
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in zip(*columns, strict=True)]
    return content | {"tail_beam": beam | {"modes": rows}}
