"""The stages on the way from a scene to what is asked of it: each says whether it runs, why, and what it costs.

A stage is one function from the request to a decision, in the order of `STAGES`; the engine asks `Plan.runs(name)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from cgid.family import LOWEST_RESTITUTION
from cgid.measure.features import FEATURES, allow_truncation
from cgid.measure.features import kind_of as kinds_of_signal
from cgid.measure.pulses import FAINT
from cgid.physics import HuntCrossley
from cgid.scene.beam_stages import gives_way, sensor_chain, tail_beam, thin_plate
from cgid.scene.costs import UNIT_COSTS, Workload
from cgid.scene.quantities import DAMPED
from cgid.scene.request import NO_IMPACTS, NO_SENSOR, NO_SIGNALS, ONLY_DRAWN, Decision, Request
from cgid.scene.scene import Scene
from cgid.scene.stream.stages import arrivals, flights
from cgid.scene.stream.truth import impact_units
from cgid.scene.weight import largest_error, tolerance_of

#: More names than these are counted.
_MOST_LISTED = 13
#: Columns of the truth beside its numbers: label and specimen.
_NAMES = 2


def _parameters(request: Request) -> Decision:
    return Decision(
        runs=True, why="all else follows from them", cost=lambda work: UNIT_COSTS["parameters"] * work.sources
    )


def _damping(request: Request) -> Decision:
    scene = request.scene
    if not scene.populations:
        return NO_IMPACTS
    if scene.impact.dissipation == "elastic":
        return Decision(runs=False, why="the impacts are undamped: D = 0")
    if not request.impacts:
        return ONLY_DRAWN
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
        return NO_IMPACTS
    if not request.quantities:
        return ONLY_DRAWN
    if gives_way(request.scene):
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
        return NO_IMPACTS
    if not request.impacts:
        return ONLY_DRAWN
    if not _integrates(scene):
        return Decision(runs=False, why="closed forms and the table of pulses are exact here")

    def cost(work: Workload) -> float:
        pulses = UNIT_COSTS["integrated pulse"] * work.pulses if request.signals else 0.0
        coupled = UNIT_COSTS["coupled mode"] * work.coupled * work.n_modes if scene.tail_beam is not None else 0.0
        return UNIT_COSTS["integrated impact"] * work.impacts + coupled + pulses

    if gives_way(scene):
        return Decision(runs=True, why="a plate or beam that gives way has no closed form", cost=cost)
    if largest_error(scene.impact, scene.body, scene.populations) > tolerance_of(scene.impact):
        return Decision(runs=True, why="for the impacts that feel gravity", cost=cost)
    return Decision(runs=True, why=f"law {scene.impact.law} damps beyond the table of pulses", cost=cost)


def _gravity(request: Request) -> Decision:
    section = request.scene.impact
    if section.gravity is None:
        return Decision(runs=False, why="off")
    if not request.scene.populations:
        return NO_IMPACTS
    if not request.impacts:
        return ONLY_DRAWN
    bound, limit = largest_error(section, request.scene.body, request.scene.populations), tolerance_of(section)
    if bound <= limit:
        why = f"2.4 g L / (v^2 e) is at most {bound:.2g}, the tolerance {limit:g}"
        return Decision(runs=False, why=why, error_bound=bound)
    if np.isinf(bound):
        return Decision(runs=True, why="no bound is known on a thin plate")
    return Decision(runs=True, why=f"for each impact with 2.4 g L / (v^2 e) above {limit:g}", error_bound=limit)


def _pulses(request: Request) -> Decision:
    if not request.signals:
        return NO_SIGNALS
    if not request.scene.populations:
        return NO_IMPACTS

    def cost(work: Workload) -> float:
        return UNIT_COSTS["pulse"] * work.pulses + UNIT_COSTS["pulse sample"] * work.contact_samples

    return Decision(runs=True, why="samples in contact only", cost=cost)


def _taps(request: Request) -> Decision:
    if not request.scene.taps:
        return Decision(runs=False, why="the scene has none")
    if not request.signals:
        return NO_SIGNALS
    return Decision(runs=True, why="samples in contact only", cost=lambda work: UNIT_COSTS["tap"] * work.taps)


def _rest_of_frames(request: Request) -> Decision:
    if not request.signals:
        return NO_SIGNALS

    def whole(why: str) -> Decision:
        return Decision(runs=True, why=why, cost=lambda work: UNIT_COSTS["frame sample"] * work.samples)

    if request.kept:
        return whole("whole signals are asked for")
    if kinds_of_signal(request.features) != "pulse":
        return whole("a vibration is measured all through the frame")
    if not allow_truncation(request.features):
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
        return NO_SENSOR
    if request.scene.sensor.bandwidth is None and not request.drawn("bandwidth"):
        return Decision(runs=False, why="off")
    why = "drawn for each block" if request.drawn("bandwidth") else f"{request.scene.sensor.bandwidth:g} Hz"
    return Decision(
        runs=True, why=f"{why}; always whole frames", cost=lambda w: UNIT_COSTS["filtered sample"] * w.n_samples
    )


def _noise(request: Request) -> Decision:
    if not request.sensed:
        return NO_SENSOR
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
        return NO_SENSOR
    section = request.scene.background
    parts = {
        "hum": len(section.hum),
        "coloured": section.coloured is not None,
        "recorded": section.recorded is not None,
    }

    def cost(work: Workload) -> float:
        return sum(UNIT_COSTS[f"{name} sample"] * number for name, number in parts.items()) * work.n_samples

    on = ", ".join(name for name, number in parts.items() if number)
    return Decision(runs=True, why=f"{on}; always whole frames", cost=cost)


def _clipping(request: Request) -> Decision:
    if not any(source.clipped_at is not None for source in request.scene.sources):
        return Decision(runs=False, why="off")
    if not request.sensed:
        return NO_SENSOR
    return Decision(runs=True, why="clipped_at is drawn", cost=lambda work: UNIT_COSTS["clipped sample"] * work.samples)


def _digitising(request: Request) -> Decision:
    sensor = request.scene.sensor
    parts = {"offset": sensor.offset, "drift": sensor.drift, "range": sensor.range, "bits": sensor.bits}
    on = [f"{name} {value:g}" for name, value in parts.items() if value]
    if not on:
        return Decision(runs=False, why="off")
    if not request.sensed:
        return NO_SENSOR
    return Decision(
        runs=True,
        why=", ".join(on),
        cost=lambda work: UNIT_COSTS["digitised sample"] * work.samples,
    )


def _measuring(kind: str) -> Callable[[Request], Decision]:
    """Return the stage of the features of one kind, as `kind_of` names it."""

    def decide(request: Request) -> Decision:
        if "features" not in request.outputs:
            return Decision(runs=False, why="no features are asked for")
        names = [name for name in request.features if kind_of(name) == kind]
        if not names:
            return Decision(runs=False, why="no asked feature needs it")
        return Decision(runs=True, why=_listed(names), cost=lambda work: UNIT_COSTS[kind])

    return decide


def _listed(names: list[str]) -> str:
    if len(names) <= _MOST_LISTED:
        return ", ".join(names)
    return f"{names[0]} to {names[-1]}, {len(names)} of them"


def kind_of(feature: str) -> str:
    """Return what a feature is read from: "vibrations", or of a pulse "fit", "spectrum" or "features in time"."""
    if FEATURES[feature].kind != "pulse":
        return "vibrations"
    if FEATURES[feature].fitted:
        return "fit"
    return "spectrum" if FEATURES[feature].spectral else "features in time"


def _storing_signals(request: Request) -> Decision:
    if not request.kept:
        return Decision(runs=False, why="no signals are kept")
    size = request.signal_bytes
    noun = "signal" if request.scene.stream is None else "recording"
    return Decision(runs=True, why=f"{size} bytes a {noun}", cost=lambda work: UNIT_COSTS["stored byte"] * size)


def _storing_columns(request: Request) -> Decision:
    if request.scene.stream is not None:
        number = len(impact_units(request.scene)) + _NAMES
        return Decision(
            runs=True,
            why=f"the truth of every impact, {8 * number} bytes each",
            cost=lambda work: UNIT_COSTS["column"] * number * work.impacts,
        )
    if request.kept:
        return Decision(runs=False, why="they are stored beside the signals")
    number = len(request.column_units)
    return Decision(runs=True, why=f"{number} of them", cost=lambda work: UNIT_COSTS["column"] * number)


def _integrates(scene: Scene) -> bool:
    """Return whether some impacts may have to be integrated."""
    return (
        gives_way(scene)
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


#: Every stage in the order of the data.
STAGES: Mapping[str, Callable[[Request], Decision]] = {
    "arrivals": arrivals,
    "parameters": _parameters,
    "damping": _damping,
    "closed forms": _closed_forms,
    "gravity": _gravity,
    "thin plate": thin_plate,
    "time stepping": _time_stepping,
    "flights": flights,
    "pulses": _pulses,
    "taps": _taps,
    "tail beam": tail_beam,
    "sensor chain": sensor_chain,
    "rest of the frames": _rest_of_frames,
    "bandwidth": _bandwidth,
    "noise": _noise,
    "background": _background,
    "clipping": _clipping,
    "offset, range and bits": _digitising,
    "features in time": _measuring("features in time"),
    "spectra": _measuring("spectrum"),
    "fits": _measuring("fit"),
    "vibrations": _measuring("vibrations"),
    "storing signals": _storing_signals,
    "storing columns": _storing_columns,
}
