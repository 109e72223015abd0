"""Decide which stages run for the requested output of a scene, and why: one function per stage."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from cgid._lib import validation
from cgid.errors import InvalidValue
from cgid.measure.features.extraction import (
    FEATURES,
    allow_truncation,
    choose,
    kind_for,
    kind_of,
    require_supported,
    supported,
)
from cgid.measure.features.pulses import FAINT
from cgid.measure.fit.family import MIN_RESTITUTION
from cgid.physics.contact.bodies import ThinPlate
from cgid.physics.contact.laws import HuntCrossley
from cgid.physics.structure.response import LinearPhase
from cgid.scene.file.gravity import largest_error, tolerance_of
from cgid.scene.file.schema import Scene, load_scene, samples_of
from cgid.scene.file.sensor import CHUNK
from cgid.scene.synthesis.draws import parameter_units

__all__ = ["Plan", "plan"]

#: The possible outputs.
OUTPUTS = ("parameters", "closed-form", "pulses", "frames", "recordings", "features")
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
#: Quantities of a tap in the scene file.
OF_TAPS = ("peak_force", "contact_duration")
#: Quantities that are stored with signals and features.
STORED = ("restitution", "peak_force", "contact_duration")
#: Prefix of true values in a table of measured ones.
TRUE = "true_"

#: Error of the response over its largest sample: determines the resolution of a contact and the negligible modes.
RESPONSE_TOLERANCE = 3e-5
#: Below this lambda echoes from the edges of a beam are ignored: they change the restitution by about lambda at most.
NEGLIGIBLE_ECHO = 0.02
#: Modes are computed up to this multiple of the recorder's highest frequency, because their tails extend into its band.
BEYOND_BAND = 1.25
#: Modes above this frequency respond quasi-statically to any contact long enough for echoes from the edges [Hz].
MAX_RESPONSE_FREQUENCY = 20e3
#: A frequency is in the band if the anti-alias filter passes at least this fraction of its amplitude.
_MIN_AUDIBLE = 0.1
#: A Gaussian edge passes that after so many standard deviations.
_TO_A_TENTH = 1.2816
#: Filters of the sensor that may be drawn, and by which key.
_DRAWN_FILTERS = {"anti-alias": "anti_alias_frequency", "AC coupling": "ac_coupling"}
#: Longer lists of features are abbreviated.
_MAX_LISTED = 13


class StageDecision(NamedTuple):
    """Whether a stage runs, and why."""

    runs: bool
    why: str
    error_bound: float = 0.0  # error of what is omitted, relative to the peak; 0 if nothing changes


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """The requested output of a scene; see `plan`.

    Attributes
    ----------
    scene : Scene
    kind : str
        The requested output, out of `OUTPUTS`.
    features : tuple of str
        Names of features; empty unless features are requested.
    quantities : tuple of str
        Out of `QUANTITIES`: those requested, or needed for another output.
    dtype : {"float32", "float64"}
        Of stored samples.
    """

    scene: Scene
    kind: str = "frames"
    features: tuple[str, ...] = ()
    quantities: tuple[str, ...] = STORED
    dtype: Literal["float32", "float64"] = "float32"
    _decided: dict[str, StageDecision] = field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        running = ", ".join(stage for stage, decision in self.decisions.items() if decision.runs)
        return f"Plan({self.kind} of scene {self.scene.name!r}: {running})"

    @cached_property
    def decisions(self) -> dict[str, StageDecision]:
        """The decision for each stage, in processing order: whether it runs, why, and the error of what is omitted."""
        return {stage: self._decision(stage) for stage in STAGES}

    def _decision(self, stage: str) -> StageDecision:
        """Return the decision for a stage, made once."""
        if stage not in self._decided:
            needs, decide = STAGES[stage]
            lacking = next(
                (otherwise for has, otherwise in (_NEEDS[need] for need in needs.split()) if not has(self)), None
            )
            outcome = StageDecision(False, lacking) if lacking else decide(self)
            self._decided[stage] = (
                outcome if isinstance(outcome, StageDecision) else StageDecision(bool(outcome), outcome or "off")
            )
        return self._decided[stage]

    def runs(self, stage: str) -> bool:
        """Return whether a stage runs, one of the keys of `decisions`."""
        return self._decision(stage).runs

    @property
    def responds(self) -> bool:
        """Whether a beam or a sensor with poles acts on the forces."""
        return self.runs("tail beam") or self.runs("sensor chain")

    def for_block(self, scene: Scene) -> Plan:
        """Return the plan of a block, whose scene has no random settings."""
        return self if scene is self.scene else replace(self, scene=scene)

    @property
    def signals(self) -> bool:
        """Whether the output needs signals."""
        return self.sensed or self.kind == "pulses"

    @property
    def sensed(self) -> bool:
        """Whether the output needs signals of the sensor."""
        return self.kind in ("frames", "recordings", "features")

    @property
    def kept(self) -> bool:
        """Whether complete signals are requested."""
        return self.kind in ("pulses", "frames", "recordings")

    @property
    def column_units(self) -> dict[str, str]:
        """The columns of the requested table and their units; empty for signals."""
        if self.kept:
            return {}
        parameters = parameter_units(self.scene)
        rate = {"sampling_rate": "Hz"} if self.scene.draws("sampling_rate") else {}
        if self.kind == "features":
            measured = {name: FEATURES[name].unit_for(self.scene.sensor.unit) for name in self.features}
            return measured | {f"{TRUE}{name}": unit for name, unit in parameters.items()} | rate
        drawn = {name for source in self.scene.sources for name in source.laws} | {"onset"}
        drawn |= {"velocity"} if self.scene.populations else set()  # which also follows from a drop height
        drawn |= {"yield_pressure"} if "strength" in drawn else set()
        drawn |= {"dissipation"} if self.scene.mixes_laws else set()
        drawn |= set() if self.scene.randomise is None else set(self.scene.randomise.laws)
        # A law, a plate or gravity may change the delivered restitution.
        units = {
            "asked_restitution" if name == "restitution" else name: unit
            for name, unit in parameters.items()
            if name in drawn
        }
        return units | rate | {name: QUANTITIES[name] for name in self.quantities}

    @property
    def signal_bytes(self) -> int:
        """Size of one signal or recording on disk: its samples, or its columns."""
        if self.kept:
            return samples_of(self.scene) * np.dtype(self.dtype).itemsize
        return 8 * len(self.column_units)


def plan(
    scene: Scene | str | Path,
    output: str = "frames",
    *,
    features: Iterable[str] | None = None,
    quantities: Iterable[str] | None = None,
    dtype: Literal["float32", "float64"] = "float32",
) -> Plan:
    """Return the plan for an output of a scene.

    "parameters" are the sampled numbers, "closed-form" gives quantities of impacts without their pulses, "pulses" are
    forces without beam and sensor, "frames" are signals of the sensor. "features" are measured on such signals, which
    are not stored. A stream has "recordings" and nothing else.

    Parameters
    ----------
    scene : Scene, str or Path
    output : {"parameters", "closed-form", "pulses", "frames", "recordings", "features"}
    features : iterable of str, optional
        By default all of the sensor's kind that sampling rate and frames allow.
    quantities : iterable of str, optional
        Of the closed forms; by default all.
    dtype : {"float32", "float64"}
        Of stored samples.

    Returns
    -------
    Plan
        Its `decisions` state for every stage whether it runs, and why.

    Raises
    ------
    InvalidValue
        A name is unknown, or the requests contradict each other or the scene.

    Examples
    --------
    >>> from cgid.scene import load_scene
    >>> from cgid.shipped import scene_path
    >>> requested = plan(load_scene(scene_path("reference")), "closed-form", quantities=["contact_duration"])
    >>> [stage for stage, decision in requested.decisions.items() if decision.runs]
    ['impacts']
    """
    scene = load_scene(scene)
    validation.choice("output", output, OUTPUTS)
    for name, given, needed in (("features", features, "features"), ("quantities", quantities, "closed-form")):
        if given is not None and output != needed:
            raise InvalidValue(f"{name} need the output {needed!r}, which is not requested; leave them out")
    _require_recordings(scene, output)
    validation.choice("dtype", dtype, ("float32", "float64"))
    made = Plan(scene=scene, kind=output, dtype=dtype)
    names = _quantities(quantities) if output == "closed-form" else ()
    return replace(
        made,
        features=_features(scene, features) if output == "features" else (),
        quantities=STORED if made.signals else names,
    )


def supported_by(scene: Scene, features: Iterable[str]) -> tuple[str, ...]:
    """Return the features that every frame of a scene supports by sampling rate and length."""
    names = tuple(features)
    for rate in scene.extreme_rates:
        names = supported(names, rate, scene.sampling.samples)
    if not names:
        raise InvalidValue(
            f"scene {scene.name}: frames must be sampled fast and long enough for at least one feature, "
            f"{scene.sampling.samples} samples at {scene.sampling.sampling_rate:g} Hz allow none; record longer"
        )
    return names


def _require_recordings(scene: Scene, output: str) -> None:
    """Raise `InvalidValue` unless a stream makes only recordings, and other scenes make none."""
    if scene.stream is not None and output != "recordings":
        raise InvalidValue(
            f"output of scene {scene.name} must be recordings, since it is a stream, got {output}; "
            "make recordings of it (cgid generate SCENE -o RECORDING.h5)"
        )
    if scene.stream is None and output == "recordings":
        raise InvalidValue(f"output of scene {scene.name} must not be recordings, which need a section stream")


def _features(scene: Scene, features: Iterable[str] | None) -> tuple[str, ...]:
    names = choose(features, kind_for(scene.sensor.quantity))
    if features is None:
        return supported_by(scene, names)
    for rate in scene.extreme_rates:
        require_supported(names, rate, scene.sampling.samples)
    return names


def _quantities(quantities: Iterable[str] | None) -> tuple[str, ...]:
    """Return the requested names, all for None; raise `InvalidValue` for unknown or repeated ones."""
    if quantities is None:
        return tuple(QUANTITIES)
    names = (quantities,) if isinstance(quantities, str) else tuple(quantities)
    for name in names:
        validation.choice("quantity", name, QUANTITIES)
    if not names or len(set(names)) != len(names):
        raise InvalidValue(f"quantities must be named once each, and at least one, got {', '.join(names) or 'none'}")
    return names


def highest_frequency(scene: Scene) -> float:
    """Return the frequency up to which the modes of a scene's beam are computed [Hz]."""
    if scene.sensor.quantity == "force":  # modes are not recorded, but act on contacts that outlast their echo
        return MAX_RESPONSE_FREQUENCY
    anti_alias = scene.sensor.anti_alias
    if anti_alias is None:
        return BEYOND_BAND * scene.sampling.sampling_rate / 2
    if isinstance(linear := anti_alias.filter, LinearPhase):
        return BEYOND_BAND * (linear.frequency + _TO_A_TENTH * linear.width)
    # A Butterworth filter passes 1 / sqrt(1 + (f / edge)^(2 order)).
    return float(
        BEYOND_BAND * anti_alias.frequency * np.power(1 / (_MIN_AUDIBLE * _MIN_AUDIBLE) - 1, 0.5 / anti_alias.order)
    )


# -- one decision per stage: what the scene has, and what an output needs ----------


def _arrivals(plan: Plan) -> str:
    stream = plan.scene.stream
    assert stream is not None  # it needs one
    how = "Poisson" if stream.arrivals.rate is not None else "listed"
    mixture = "" if stream.mixture is None else ", the mixture changes"
    return f"{how}, {stream.duration:g} s{mixture}"


def _impacts(plan: Plan) -> str:
    scene = plan.scene
    if isinstance(scene.body, ThinPlate) or scene.tail_beam is not None:
        return "integrated: no closed form with a yielding plate or beam"
    if plan.runs("gravity"):
        return "closed forms, integrated if gravity matters"
    one_by_one = [name for name in ("kuwabara-kono", "power-law", *scene.own_laws) if name in scene.dissipations]
    integrated = f"{' and '.join(one_by_one)} impacts integrated one by one" * bool(one_by_one)
    if scene.plastic:
        names = ", ".join(dict.fromkeys(scene.dissipations))
        others = "; those of other laws separately" * scene.mixes_laws + f", {integrated}" * bool(integrated)
        both = any(population.viscous_restitution is not None for population in scene.populations)
        both_ways = ", those with viscous loss integrated" * both
        pulses = f"pulses of {' and '.join(scene.plastic)} in three branches"
        return f"{names}: closed forms; {pulses}{both_ways}{others}"
    if integrated:
        return integrated
    if _damps_beyond(scene):
        return f"integrated where law {scene.impact.law} exceeds the damping of the table of pulses"
    return "closed forms and the table of pulses are exact here"


def _damps_beyond(scene: Scene) -> bool:
    """Return whether the law can give a lower restitution than the table of pulses covers."""
    lowest = [source.restitution.extremes[0] for source in scene.populations if source.restitution is not None]
    if not lowest or scene.impact.law == "exact":
        return False
    delivered = HuntCrossley(restitution=min(lowest), law=scene.impact.law).delivered_restitution
    return bool(delivered < MIN_RESTITUTION)


def _gravity(plan: Plan) -> str | StageDecision:
    section = plan.scene.impact
    if section.gravity is None:
        return ""
    bound, limit = largest_error(section, plan.scene.body, plan.scene.populations), tolerance_of(section)
    if bound <= limit:
        return StageDecision(False, f"2.4 g L / (v^2 e) is at most {bound:.2g}, the tolerance {limit:g}", bound)
    if np.isinf(bound):
        return "no bound is known on a thin plate"
    return StageDecision(True, f"for each impact with 2.4 g L / (v^2 e) above {limit:g}", limit)


def _coupling(plan: Plan) -> str | StageDecision:
    beam = plan.scene.tail_beam
    if beam is None:
        return StageDecision(False, "the scene has no tail beam")
    if beam.coupling == "impedance":
        return StageDecision(False, "coupling impedance: the beam as an infinite plate")
    if beam.modes is not None:
        return "every impact through the modes: a table of modes has no impedance"
    if beam.coupling == "modes":
        return "coupling modes: every impact through them"
    why = "coupling auto: through the modes if waves return from an edge during contact and lambda is above "
    return StageDecision(True, f"{why}{NEGLIGIBLE_ECHO:g}, else as an endless plate", NEGLIGIBLE_ECHO)


def _rebounds(plan: Plan) -> str | StageDecision:
    stream = plan.scene.stream
    assert stream is not None
    if stream.rebounds is None:
        return StageDecision(False, "off: no rock bounces")
    return f"by formula, {stream.rebounds.most} rebounds at most, none slower than {stream.rebounds.least_speed:g} m/s"


def _tail_beam(plan: Plan) -> StageDecision:
    scene = plan.scene
    if scene.tail_beam is None:
        return StageDecision(False, "the scene has none")
    if scene.sensor.quantity == "force":
        return StageDecision(False, "the sensor measures the force: no modes")
    if scene.tail_beam.modes is not None:
        modes = f"the {len(scene.tail_beam.modes)} modes of the table"
    else:
        assert scene.panel is not None
        # The asymptotic modal density, since a plan solves nothing.
        highest = highest_frequency(scene)
        number = max(round(scene.panel.modal_density * highest), 1)
        modes = f"about {number} modes up to {highest:.3g} Hz, none further beyond the band"
    gain = "" if scene.sensor.gain is None else f" times {scene.sensor.gain:g}"
    why = f"{scene.sensor.quantity}{gain}: {modes}; those negligible at the sensor are omitted"
    return StageDecision(True, why, RESPONSE_TOLERANCE)


def _sensor_chain(plan: Plan) -> str | StageDecision:
    sensor = plan.scene.sensor
    drawn = [name for name, key in _DRAWN_FILTERS.items() if plan.scene.draws(key)]
    parts = {"mounting": sensor.mounting, "anti-alias": sensor.anti_alias}
    edges = {name: part.frequency for name, part in parts.items() if part is not None}
    edges |= {} if sensor.ac_coupling is None else {"AC coupling": sensor.ac_coupling}
    on = ", ".join(f"{name} {edge:g} Hz" for name, edge in edges.items() if name not in drawn)
    if drawn:
        why = f"{on}{', ' * bool(on)}{' and '.join(drawn)} drawn for each block"
        return StageDecision(True, why, RESPONSE_TOLERANCE)
    if not on:
        return ""
    linear = next((part for part in sensor.filters if isinstance(part, LinearPhase)), None)
    late = "" if linear is None else f" of linear phase, {1e3 * linear.delay:.3g} ms late"
    n_poles = sum(part.poles.size for part in sensor.filters)
    return StageDecision(True, f"{on}{late}: {n_poles} poles", RESPONSE_TOLERANCE)


def _frame_remainder(plan: Plan) -> str | StageDecision:
    scene, sensor = plan.scene, plan.scene.sensor
    if plan.kept:
        return "complete signals are requested"
    if kind_of(plan.features) != "pulse":
        return "a vibration is measured all through the frame"
    if not allow_truncation(plan.features):
        everywhere = [name for name in plan.features if FEATURES[name].whole_frame]
        return f"{', '.join(everywhere)} looks at samples far from the pulse"
    if sensor.quantity != "force" or sensor.filters:
        return "ring-down of a beam or a filter"
    if scene.background is not None:
        return "a background may have peaks anywhere"
    if sensor.coloured:
        return "coloured noise is made for complete frames"
    drawn = [name for name in ("noise_exponent", "hum", *_DRAWN_FILTERS.values()) if scene.draws(name)]
    if drawn:
        return f"for each block whose {' or '.join(drawn)} needs it"
    if sensor.relative_noise * FAINT > 1 and not scene.draws("relative_noise"):
        return f"a pulse below {FAINT:g} times the noise is searched in the complete frame"
    return StageDecision(False, "no requested feature needs it; made for signals for which this is not certain")


def _bandwidth(plan: Plan) -> str:
    edge = plan.scene.sensor.bandwidth
    if plan.scene.draws("bandwidth"):
        return "random for each block; always complete frames"
    return "" if edge is None else f"{edge:g} Hz; always complete frames"


def _noise(plan: Plan) -> str:
    if not plan.scene.sensor.noisy and not plan.scene.draws("relative_noise"):
        return ""
    extent = plan.runs("rest of the frames")
    return _colour(plan) + ("complete frames" if extent else "up to the last sample that a feature uses")


def _colour(plan: Plan) -> str:
    """Return the description of coloured noise, with the frequency below which it is flat."""
    sensor, rate = plan.scene.sensor, plan.scene.extreme_rates[0]
    if plan.scene.draws("noise_exponent"):
        return "colour drawn for each block; "
    if not sensor.coloured:
        return ""
    shape = f"1/f^{sensor.noise_exponent:g}" if sensor.noise_spectrum is None else "of the spectrum given"
    least = "at least " if plan.scene.draws("sampling_rate") else ""
    return f"{shape}, flat below {least}{rate / (plan.scene.sampling.samples or CHUNK):.4g} Hz; "


def _background(plan: Plan) -> str:
    section = plan.scene.background
    on = [name for name in ("hum", "coloured", "recorded") if section is not None and getattr(section, name)]
    on += ["hum drawn for each block"] * plan.scene.draws("hum")
    return ", ".join(on) + "; always complete frames" * bool(on)


def _digitising(plan: Plan) -> str:
    names = ("offset", "drift", "range", "relative_range", "bits")
    drawn = [name for name in names if plan.scene.draws(name)]
    parts = {name: getattr(plan.scene.sensor, name) for name in names if name not in drawn}
    on = [f"{name} {value:g}" for name, value in parts.items() if value]
    return ", ".join(on + [f"{' and '.join(drawn)} drawn for each block"] * bool(drawn))


def _measuring(plan: Plan) -> str | StageDecision:
    names = plan.features
    if not names:
        return StageDecision(False, "no features are requested")
    listed = ", ".join(names) if len(names) <= _MAX_LISTED else f"{names[0]} to {names[-1]}, {len(names)} of them"
    fitted = "a fit" if any(FEATURES[name].fitted for name in names) else "no fit"
    spectral = any(FEATURES[name].spectral for name in names if FEATURES[name].kind == "pulse")
    return f"{listed}; {fitted}, {'spectra' if spectral else 'no spectra'}"


#: Requirements of a stage, and the reason if one is missing.
_NEEDS: Mapping[str, tuple[Callable[[Plan], bool], str]] = {
    "rocks": (lambda plan: bool(plan.scene.populations), "no populations: taps have no contact law"),
    "results": (lambda plan: bool(plan.quantities), "only sampled numbers are requested"),
    "signals": (lambda plan: plan.signals, "no signals are requested"),
    "sensor": (lambda plan: plan.sensed, "no sensor signals are requested"),
    "stream": (lambda plan: plan.scene.stream is not None, "the scene is not a stream"),
    "recordings": (lambda plan: plan.kind == "recordings", "no recordings are requested"),
}
#: Every stage in processing order: its requirements, and whether a scene has it, and why (only a text: yes; none: off).
STAGES: Mapping[str, tuple[str, Callable[[Plan], str | StageDecision]]] = {
    "arrivals": ("stream recordings", _arrivals),
    "impacts": ("rocks results", _impacts),
    "gravity": ("rocks results", _gravity),
    "coupling": ("rocks results", _coupling),
    "rebounds": ("stream recordings", _rebounds),
    "pulses": ("signals rocks", lambda _: "samples in contact only"),
    "taps": (
        "signals",
        lambda plan: "samples in contact only" if plan.scene.taps else StageDecision(False, "the scene has none"),
    ),
    "second hits": (
        "signals",
        lambda plan: (
            "the same pulse again, with random delay and ratio"
            * any(source.second_hit is not None for source in plan.scene.sources)
        ),
    ),
    "tail beam": ("sensor", _tail_beam),
    "sensor chain": ("sensor", _sensor_chain),
    "rest of the frames": ("signals", _frame_remainder),
    "bandwidth": ("sensor", _bandwidth),
    "noise": ("sensor", _noise),
    "background": ("sensor", _background),
    "clipping": (
        "sensor",
        lambda plan: "random clipped_at" * any(source.clipped_at is not None for source in plan.scene.sources),
    ),
    "offset, range and bits": ("sensor", _digitising),
    "features": ("", _measuring),
}
