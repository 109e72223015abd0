"""The stages between a contact force and what a sensor shows of it: how the beam gives way, its modes, the sensor."""

from __future__ import annotations

from cgid.physics import ThinPlate
from cgid.scene.costs import UNIT_COSTS, Workload
from cgid.scene.impacts import NEGLIGIBLE_ECHO
from cgid.scene.request import NO_IMPACTS, NO_SENSOR, ONLY_DRAWN, Decision, Request
from cgid.scene.response import TOLERANCE, expected_modes, highest_frequency
from cgid.scene.scene import Scene


def gives_way(scene: Scene) -> bool:
    """Return whether the target of a scene is a thin plate or a beam."""
    return isinstance(scene.body, ThinPlate) or scene.tail_beam is not None


def thin_plate(request: Request) -> Decision:
    """Return how a plate or a beam gives way under its impacts."""
    scene = request.scene
    if not gives_way(scene):
        return Decision(runs=False, why="the target does not give way")
    if not scene.populations:
        return NO_IMPACTS
    if not request.impacts:
        return ONLY_DRAWN
    if scene.tail_beam is None:
        return Decision(runs=True, why="no bound on leaving it out is proven (lambda)")
    if scene.tail_beam.coupling == "impedance":
        return Decision(runs=True, why="coupling impedance: the beam as an endless plate")
    if scene.panel is None:
        return Decision(runs=True, why="every impact through the modes: those of a table have no impedance")
    if scene.tail_beam.coupling == "modes":
        return Decision(runs=True, why="coupling modes: every impact through them")
    return Decision(
        runs=True,
        why="coupling auto: through the modes where waves come back from an edge during contact and lambda is above "
        f"{NEGLIGIBLE_ECHO:g}, else as an endless plate",
        error_bound=NEGLIGIBLE_ECHO,
    )


def tail_beam(request: Request) -> Decision:
    """Return whether the modes of a beam are run for what a sensor feels."""
    scene = request.scene
    if scene.tail_beam is None:
        return Decision(runs=False, why="the scene has none")
    if not request.sensed:
        return NO_SENSOR
    if scene.sensor.quantity == "force":
        return Decision(runs=False, why="the sensor feels the force: no mode is heard")
    number = len(expected_modes(scene)[0])
    if scene.panel is None:
        modes = f"the {number} modes of the table"
    else:
        modes = f"about {number} modes up to {highest_frequency(scene):.3g} Hz, none further beyond the band"
    return Decision(
        runs=True,
        why=f"{scene.sensor.quantity}: {modes}; those too quiet at the sensor are left out",
        cost=lambda work: _cost(number, work.mode_samples, work),
        error_bound=TOLERANCE,
    )


def sensor_chain(request: Request) -> Decision:
    """Return whether there are poles of a mounting and an anti-alias filter to be run."""
    sensor = request.scene.sensor
    if not sensor.filters:
        return Decision(runs=False, why="off")
    if not request.sensed:
        return NO_SENSOR
    parts = {"mounting": sensor.mounting, "anti-alias": sensor.anti_alias}
    why = ", ".join(f"{name} {part.frequency:g} Hz" for name, part in parts.items() if part is not None)
    number = sum(part.poles.size for part in sensor.filters)
    return Decision(
        runs=True,
        why=f"{why}: {number} poles",
        cost=lambda work: _cost(number, work.filter_samples, work),
        error_bound=TOLERANCE,
    )


def _cost(n_poles: int, pole_samples: float, work: Workload) -> float:
    struck = UNIT_COSTS["struck mode"] * n_poles * (work.pulses + work.taps)
    return struck + UNIT_COSTS["mode sample"] * pole_samples
