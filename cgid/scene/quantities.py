"""What can be had of an impact without its pulse, and the columns of a table of what was asked of a scene."""

from __future__ import annotations

from collections.abc import Iterable

from cgid import validation
from cgid.errors import InvalidValue
from cgid.measure.features import FEATURES
from cgid.scene.population import parameter_units
from cgid.scene.scene import Scene

#: Properties of `Impact` and their units.
QUANTITIES = {
    "restitution": "1",
    "peak_force": "N",
    "peak_displacement": "m",
    "contact_duration": "s",
    "time_of_peak": "s",
    "impulse": "N s",
    "rebound_velocity": "m/s",
    "dissipated_energy": "J",
    "radiated_energy": "J",
}
#: Those that a tap was given.
OF_TAPS = ("peak_force", "contact_duration")
#: Those whose closed form needs the damping number.
DAMPED = ("peak_force", "peak_displacement")
#: Those that are stored beside signals and features.
STORED = ("restitution", "peak_force", "contact_duration")
#: Before the names of what a signal was really made from, in a table of what was measured on it.
TRUE = "true_"


def choose_quantities(quantities: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of the asked quantities, all for None.

    Raises
    ------
    InvalidValue
        A name is unknown, given twice, or there is none.
    """
    if quantities is None:
        return tuple(QUANTITIES)
    names = (quantities,) if isinstance(quantities, str) else tuple(quantities)
    for name in names:
        validation.choice("quantity", name, QUANTITIES)
    if not names or len(set(names)) != len(names):
        raise InvalidValue(f"quantities must be named once each, and at least one, got {', '.join(names) or 'none'}")
    return names


def drawn_units(scene: Scene) -> dict[str, str]:
    """Return what is drawn for each signal, before any law of impact, and its units."""
    drawn = {name for source in scene.sources for name in source.laws} | {"onset"}
    if scene.populations:
        drawn.add("velocity")  # what a drop height comes to
    if scene.randomise is not None:
        drawn |= set(scene.randomise.laws)
    units = {name: unit for name, unit in parameter_units(scene).items() if name in drawn}
    if "restitution" in units:  # a law, a plate or gravity may deliver another
        units = {name.replace("restitution", "asked_restitution"): unit for name, unit in units.items()}
    return units | _sampling_rate(scene)


def measured_units(scene: Scene, features: Iterable[str]) -> dict[str, str]:
    """Return features and the true numbers beside them, and their units."""
    measured = {name: FEATURES[name].unit_for(scene.sensor.unit) for name in features}
    true = {f"{TRUE}{name}": unit for name, unit in parameter_units(scene).items()}
    return measured | true | _sampling_rate(scene)


def _sampling_rate(scene: Scene) -> dict[str, str]:
    randomised = scene.randomise is not None and scene.randomise.sampling_rate is not None
    return {"sampling_rate": "Hz"} if randomised else {}
