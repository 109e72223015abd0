"""The stages on the way from a scene to what is asked of it: each says whether it runs, why, and what it costs.

A stage is one function from the request to a decision, in the order of `STAGES`; the engine asks `Plan.runs(name)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from cgid.beginnings import look_at_the_beginning
from cgid.family import LOWEST_RESTITUTION
from cgid.features import FEATURES
from cgid.impact import HuntCrossley, ThinPlate
from cgid.pulses import FAINT
from cgid.scene.costs import UNIT_COSTS, Workload
from cgid.scene.quantities import DAMPED
from cgid.scene.request import Decision, Request
from cgid.scene.scene import Scene
from cgid.scene.weight import largest_error, tolerance_of

_NO_IMPACTS = Decision(runs=False, why="no populations: taps have no law of impact")
_NO_SIGNALS = Decision(runs=False, why="no signals are asked for")
_NO_SENSOR = Decision(runs=False, why="no sensed signals are asked for")


def _parameters(request: Request) -> Decision:
    return Decision(runs=True, why="all else follows from them", cost=lambda work: UNIT_COSTS["parameters"])


def _damping(request: Request) -> Decision:
    scene = request.scene
    if not scene.populations:
        return _NO_IMPACTS
    if scene.impact.dissipation == "elastic":
        return Decision(runs=False, why="the impacts are undamped: D = 0")
    if not request.quantities and not request.signals:
        return Decision(runs=False, why="only what is drawn is asked for")
    if _integrates(scene):
        why = "the integration starts from D"
    elif scene.impact.law != "exact":
        why = f"law {scene.impact.law} delivers another restitution than is asked, which follows from D"
    elif not set(request.quantities).isdisjoint(DAMPED):
        why = "the closed form of the peak needs D"
    else:
        return Decision(runs=False, why="nothing asked needs D: restitution and times come without it")
    return Decision(runs=True, why=why, cost=lambda work: UNIT_COSTS["damping solve"] * work.impacts)


def _closed_forms(request: Request) -> Decision:
    if not request.scene.populations:
        return _NO_IMPACTS
    if not request.quantities:
        return Decision(runs=False, why="only what is drawn is asked for")
    if _on_plate(request.scene):
        return Decision(runs=False, why="a plate or beam that gives way leaves none: the impacts are integrated")
    number = len(request.quantities)
    return Decision(
        runs=True,
        why=", ".join(request.quantities),
        cost=lambda work: (UNIT_COSTS["impact"] + UNIT_COSTS["closed form"] * number) * work.impacts,
    )


def _time_stepping(request: Request) -> Decision:
    scene = request.scene
    if not scene.populations:
        return _NO_IMPACTS
    if not request.quantities and not request.signals:
        return Decision(runs=False, why="only what is drawn is asked for")
    if not _integrates(scene):
        return Decision(runs=False, why="closed forms and the table of pulses are exact here")

    def cost(work: Workload) -> float:
        pulses = UNIT_COSTS["integrated pulse"] * work.pulses if request.signals else 0.0
        return UNIT_COSTS["integrated impact"] * work.impacts + pulses

    if _on_plate(scene):
        return Decision(runs=True, why="a plate or beam that gives way has no closed form", cost=cost)
    if largest_error(scene.impact, scene.body, scene.populations) > tolerance_of(scene.impact):
        return Decision(runs=True, why="for the impacts that feel gravity", cost=cost)
    return Decision(runs=True, why=f"law {scene.impact.law} damps beyond the table of pulses", cost=cost)


def _gravity(request: Request) -> Decision:
    section = request.scene.impact
    if section.gravity is None:
        return Decision(runs=False, why="off")
    if not request.scene.populations:
        return _NO_IMPACTS
    if not request.quantities and not request.signals:
        return Decision(runs=False, why="only what is drawn is asked for")
    bound, limit = largest_error(section, request.scene.body, request.scene.populations), tolerance_of(section)
    if bound <= limit:
        why = f"2.4 g L / (v^2 e) is at most {bound:.2g}, the tolerance {limit:g}"
        return Decision(runs=False, why=why, error_bound=bound)
    if np.isinf(bound):
        return Decision(runs=True, why="no bound is known on a thin plate")
    return Decision(runs=True, why=f"for each impact with 2.4 g L / (v^2 e) above {limit:g}", error_bound=limit)


def _thin_plate(request: Request) -> Decision:
    if not _on_plate(request.scene):
        return Decision(runs=False, why="the target does not give way")
    if not request.scene.populations:
        return _NO_IMPACTS
    if not request.quantities and not request.signals:
        return Decision(runs=False, why="only what is drawn is asked for")
    return Decision(runs=True, why="no bound on leaving it out is proven (lambda)")


def _pulses(request: Request) -> Decision:
    if not request.signals:
        return _NO_SIGNALS
    if not request.scene.populations:
        return _NO_IMPACTS

    def cost(work: Workload) -> float:
        return UNIT_COSTS["pulse"] * work.pulses + UNIT_COSTS["pulse sample"] * work.contact_samples

    return Decision(runs=True, why="samples in contact only", cost=cost)


def _taps(request: Request) -> Decision:
    if not request.scene.taps:
        return Decision(runs=False, why="the scene has none")
    if not request.signals:
        return _NO_SIGNALS
    return Decision(runs=True, why="samples in contact only", cost=lambda work: UNIT_COSTS["tap"] * work.taps)


def _rest_of_frames(request: Request) -> Decision:
    if not request.signals:
        return _NO_SIGNALS

    def whole(why: str) -> Decision:
        return Decision(runs=True, why=why, cost=lambda work: UNIT_COSTS["frame sample"] * work.samples)

    if request.kept:
        return whole("whole signals are asked for")
    if not look_at_the_beginning(request.features):
        everywhere = [name for name in request.features if FEATURES[name].whole_frame]
        return whole(f"{', '.join(everywhere)} looks at samples far from the pulse")
    if request.scene.sensor.quantity != "force" or request.scene.sensor.filters:
        return whole("what is heard of a blow through a beam or a filter rings on")
    if request.scene.background is not None:
        return whole("a background may stand out anywhere")
    if request.scene.sensor.relative_noise * FAINT > 1 and not request.drawn("relative_noise"):
        return whole(f"a pulse below {FAINT:g} times the noise is looked for in all the frame")
    return Decision(runs=False, why="no asked feature looks there; made for the signals where that is not certain")


def _bandwidth(request: Request) -> Decision:
    if not request.sensed:
        return _NO_SENSOR
    if request.scene.sensor.bandwidth is None and not request.drawn("bandwidth"):
        return Decision(runs=False, why="off")
    why = "drawn for each block" if request.drawn("bandwidth") else f"{request.scene.sensor.bandwidth:g} Hz"
    return Decision(
        runs=True, why=f"{why}; always whole frames", cost=lambda w: UNIT_COSTS["filtered sample"] * w.n_samples
    )


def _noise(request: Request) -> Decision:
    if not request.sensed:
        return _NO_SENSOR
    if not request.scene.sensor.noisy and not request.drawn("relative_noise"):
        return Decision(runs=False, why="off")
    whole = _rest_of_frames(request).runs
    return Decision(
        runs=True,
        why="whole frames" if whole else "up to the last sample that a feature looks at",
        cost=lambda work: UNIT_COSTS["noise sample"] * work.samples,
    )


def _background(request: Request) -> Decision:
    if request.scene.background is None:
        return Decision(runs=False, why="off")
    if not request.sensed:
        return _NO_SENSOR
    return Decision(runs=True, why="whole frames")


def _clipping(request: Request) -> Decision:
    if not any(source.clipped_at is not None for source in request.scene.sources):
        return Decision(runs=False, why="off")
    if not request.sensed:
        return _NO_SENSOR
    return Decision(runs=True, why="clipped_at is drawn", cost=lambda work: UNIT_COSTS["clipped sample"] * work.samples)


def _digitising(request: Request) -> Decision:
    sensor = request.scene.sensor
    parts = {"offset": sensor.offset, "drift": sensor.drift, "range": sensor.range, "bits": sensor.bits}
    on = [f"{name} {value:g}" for name, value in parts.items() if value]
    if not on:
        return Decision(runs=False, why="off")
    if not request.sensed:
        return _NO_SENSOR
    return Decision(
        runs=True,
        why=", ".join(on),
        cost=lambda work: UNIT_COSTS["digitised sample"] * work.samples,
    )


def _measuring(kind: str) -> Callable[[Request], Decision]:
    """Return the stage of the features of one kind: of the samples in time, of the spectrum, of the fit."""

    def decide(request: Request) -> Decision:
        if "features" not in request.outputs:
            return Decision(runs=False, why="no features are asked for")
        names = [name for name in request.features if kind_of(name) == kind]
        if not names:
            return Decision(runs=False, why="no asked feature needs it")
        return Decision(runs=True, why=", ".join(names), cost=lambda work: UNIT_COSTS[kind])

    return decide


def kind_of(feature: str) -> str:
    """Return what a feature is read from: "fit", "spectrum" or "features in time"."""
    if FEATURES[feature].fitted:
        return "fit"
    return "spectrum" if FEATURES[feature].spectral else "features in time"


def _storing_signals(request: Request) -> Decision:
    if not request.kept:
        return Decision(runs=False, why="no signals are kept")
    size = request.signal_bytes
    return Decision(runs=True, why=f"{size} bytes a signal", cost=lambda work: UNIT_COSTS["stored byte"] * size)


def _storing_columns(request: Request) -> Decision:
    if request.kept:
        return Decision(runs=False, why="they are stored beside the signals")
    number = len(request.column_units)
    return Decision(runs=True, why=f"{number} of them", cost=lambda work: UNIT_COSTS["column"] * number)


def _on_plate(scene: Scene) -> bool:
    return isinstance(scene.body, ThinPlate) or scene.tail_beam is not None


def _integrates(scene: Scene) -> bool:
    """Return whether some impacts may have to be integrated."""
    return (
        _on_plate(scene)
        or largest_error(scene.impact, scene.body, scene.populations) > tolerance_of(scene.impact)
        or _damps_beyond(scene)
    )


def _damps_beyond(scene: Scene) -> bool:
    """Return whether the law can deliver less restitution than the table of pulses holds."""
    lowest = [source.restitution.extremes[0] for source in scene.populations if source.restitution is not None]
    if not lowest or scene.impact.law == "exact":
        return False
    delivered = HuntCrossley(restitution=min(lowest), law=scene.impact.law).delivered_restitution
    return bool(delivered < LOWEST_RESTITUTION)


#: Every stage in the order of the data. What comes between the pulses and the sensor, such as the modes of a beam or
#: a background, is one more function and one more line.
STAGES: Mapping[str, Callable[[Request], Decision]] = {
    "parameters": _parameters,
    "damping": _damping,
    "closed forms": _closed_forms,
    "gravity": _gravity,
    "thin plate": _thin_plate,
    "time stepping": _time_stepping,
    "pulses": _pulses,
    "taps": _taps,
    "rest of the frames": _rest_of_frames,
    "bandwidth": _bandwidth,
    "noise": _noise,
    "background": _background,
    "clipping": _clipping,
    "offset, range and bits": _digitising,
    "features in time": _measuring("features in time"),
    "spectra": _measuring("spectrum"),
    "fits": _measuring("fit"),
    "storing signals": _storing_signals,
    "storing columns": _storing_columns,
}
