"""What a scene's recorder hears of a contact force: the way through its tail beam and its sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cgid.elementary import power
from cgid.errors import InvalidValue
from cgid.physics.modes import MeasuredModes, Modes
from cgid.physics.response import Response
from cgid.physics.tail_beam import TailBeam
from cgid.scene.beam import TailBeamSection
from cgid.scene.scene import Scene
from cgid.validation import Floats

#: Error of the response over its largest sample: how fine a contact is cut, and which modes are too quiet to be run.
TOLERANCE = 3e-5
#: Modes are found up to so many times the highest frequency that the recorder passes: they have a tail in its band.
BEYOND_BAND = 1.25
#: Modes above it follow at once what a contact does that lasts long enough to feel the edges of a beam [Hz].
HIGHEST_FELT = 20e3
#: As long as an anti-alias filter passes this much of it, a frequency is in the band.
_STILL_HEARD = 0.1


@dataclass(frozen=True)
class BeamModes:
    """The modes of a scene's tail beam, with their shapes at the sensor.

    Attributes
    ----------
    modes : Modes or MeasuredModes
    at_sensor : ndarray, (n_modes,)
    """

    modes: Modes | MeasuredModes
    at_sensor: Floats

    @property
    def frequency(self) -> Floats:
        """[Hz], (n_modes,)."""
        return np.asarray(self.modes.frequency)

    @property
    def damping_ratio(self) -> Floats:
        """(n_modes,)."""
        return np.asarray(self.modes.damping_ratio)

    @property
    def modal_mass(self) -> Floats:
        """[kg], (n_modes,)."""
        return np.asarray(self.modes.modal_mass)

    def shape_at(self, parameters: Mapping[str, Floats]) -> Floats:
        """Return the shapes where each blow falls, (n, n_modes)."""
        if isinstance(self.modes, MeasuredModes):
            n = len(next(iter(parameters.values())))
            return np.broadcast_to(np.asarray(self.modes.shape_impact), (n, self.at_sensor.size))
        return self.modes.shape(parameters["impact_x"], parameters["impact_y"])

    def participation(self, parameters: Mapping[str, Floats]) -> Floats:
        """Return how strongly each blow drives each mode as the sensor sees it, (n, n_modes) [1/kg]."""
        return self.shape_at(parameters) * (self.at_sensor / self.modal_mass)


@dataclass(frozen=True)
class Hearing:
    """The response of a scene's recorder; `modes` is None for a force, which has no gain either."""

    response: Response
    modes: BeamModes | None
    gain: float | None = None

    def participation(self, parameters: Mapping[str, Floats]) -> Floats | None:
        """Return how strongly each blow drives each mode as the recorder shows it, (n, n_modes) [1/kg]."""
        if self.modes is None:
            return None
        participation = self.modes.participation(parameters)
        return participation if self.gain is None else self.gain * participation


@lru_cache(maxsize=16)
def hearing(scene: Scene) -> Hearing | None:
    """Return the response of a scene's recorder, None where it has the force itself; asked again, the same one."""
    sensor = scene.sensor
    if sensor.quantity == "force" and not sensor.filters:
        return None
    modes = None if sensor.quantity == "force" else beam_modes(scene)
    response = Response(
        sampling_rate=scene.sampling.sampling_rate,
        quantity=sensor.quantity,
        modes=modes,
        filters=sensor.filters,
        tolerance=TOLERANCE,
    )
    return Hearing(response, modes, sensor.gain)


def beam_modes(scene: Scene) -> BeamModes:
    """Return the modes of a scene's tail beam as far as its recorder can hear them; asked again, the same ones.

    Raises
    ------
    InvalidValue
        The beam has none there.
    """
    assert scene.tail_beam is not None  # a scene has checked that a motion has a beam
    return _beam_modes(scene.tail_beam, scene.panel, highest_frequency(scene))


def expected_modes(scene: Scene) -> tuple[Floats, Floats]:
    """Return about which modes `beam_modes` will find, without looking for them: frequencies [Hz], damping ratios.

    Those of a panel are spread evenly, so many per hertz as it has far up.
    """
    assert scene.tail_beam is not None
    if scene.tail_beam.measured is not None:
        table = scene.tail_beam.measured
        return np.asarray(table.frequency, np.float64), np.asarray(table.damping_ratio, np.float64)
    assert scene.panel is not None and scene.tail_beam.damping_ratio is not None
    density = scene.panel.modal_density
    numbers = np.arange(max(round(density * highest_frequency(scene)), 1), dtype=np.float64)
    return (numbers + 0.5) / density, np.full_like(numbers, scene.tail_beam.damping_ratio)


def highest_frequency(scene: Scene) -> float:
    """Return up to which frequency modes are found [Hz]."""
    if scene.sensor.quantity == "force":  # they are not heard, but felt by the rocks that last till their echo
        return HIGHEST_FELT
    anti_alias = scene.sensor.anti_alias
    if anti_alias is None:
        return BEYOND_BAND * scene.sampling.sampling_rate / 2
    # A Butterworth filter passes 1 / sqrt(1 + (f / edge)^(2 order)).
    return float(
        BEYOND_BAND * anti_alias.frequency * power(1 / (_STILL_HEARD * _STILL_HEARD) - 1, 0.5 / anti_alias.order)
    )


@lru_cache(maxsize=16)
def _beam_modes(section: TailBeamSection, panel: TailBeam | None, highest: float) -> BeamModes:
    if panel is None:
        assert section.measured is not None
        return BeamModes(section.measured, np.asarray(section.measured.shape_sensor))
    assert section.sensor_point is not None
    try:
        modes = panel.modes(highest)
    except InvalidValue as error:
        raise InvalidValue(
            f"tail_beam: {error}; that frequency follows from sensor.anti_alias.frequency, or else from "
            "sampling.sampling_rate: lower it, or take a smaller or thicker beam"
        ) from None
    if not modes.frequency.size:
        raise InvalidValue(
            f"tail_beam: must have a mode within the band of its recorder, it has none below {highest:.4g} Hz; "
            "raise sampling.sampling_rate or sensor.anti_alias.frequency, or take a larger or thinner beam"
        )
    return BeamModes(modes, modes.shape(section.sensor_point.x, section.sensor_point.y))
