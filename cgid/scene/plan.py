"""The plan: from a scene and what is asked of it, what runs, what is skipped, why, and what it costs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from cgid import validation
from cgid.errors import InvalidValue
from cgid.measure.features import choose, kind_for, require_supported, supported
from cgid.scene.costs import Workload
from cgid.scene.quantities import STORED, choose_quantities
from cgid.scene.request import OUTPUTS, Decision, Request
from cgid.scene.scene import Scene
from cgid.scene.stages import STAGES


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A line of the plan.

    Attributes
    ----------
    name : str
    runs : bool
    why : str
    microseconds : float
        What it is estimated to cost a signal, or a recording of a stream, on one thread; 0 where it is skipped.
    error_bound : float
        Of what is left out, relative to the peak; 0 where nothing changes.
    """

    name: str
    runs: bool
    why: str
    microseconds: float
    error_bound: float


@dataclass(frozen=True)
class Plan:
    """What runs for what is asked; the engine goes by it. See `plan`.

    Attributes
    ----------
    request : Request
    decisions : dict of Decision
        One for each stage, in the order of the data.
    """

    request: Request
    decisions: dict[str, Decision]

    def runs(self, stage: str) -> bool:
        """Return whether a stage runs."""
        return self.decisions[stage].runs

    @property
    def responds(self) -> bool:
        """Whether a beam or the chain of sensors stands between the forces and the signals."""
        return self.runs("tail beam") or self.runs("sensor chain")

    def for_block(self, scene: Scene) -> Plan:
        """Return the plan of a block, in which nothing is left to be drawn anew."""
        if scene is self.request.scene:
            return self
        return _decided(replace(self.request, scene=scene))

    @cached_property
    def stages(self) -> tuple[Stage, ...]:
        """All stages with their estimated costs."""
        work = Workload(self.request.scene, self.request.features, self.runs("rest of the frames"))
        return tuple(
            Stage(
                name=name,
                runs=decision.runs,
                why=decision.why,
                microseconds=decision.cost(work) if decision.runs else 0.0,
                error_bound=decision.error_bound,
            )
            for name, decision in self.decisions.items()
        )

    @property
    def kind(self) -> str:
        """What comes out, in a word: the last of what is asked on the way of the data."""
        return max(self.request.outputs, key=OUTPUTS.index)

    @property
    def microseconds(self) -> float:
        """Estimated cost of a signal or recording."""
        return sum(stage.microseconds for stage in self.stages)


def plan(
    scene: Scene,
    outputs: Iterable[str] = ("frames",),
    *,
    features: Iterable[str] | None = None,
    quantities: Iterable[str] | None = None,
    dtype: Literal["float32", "float64"] = "float32",
) -> Plan:
    """Return what runs for these outputs of a scene.

    Parameters
    ----------
    scene : Scene
    outputs : iterable of str
        "parameters": what is drawn. "closed-form": quantities of the impacts without their pulses. "pulses": forces
        without beam and sensor. "frames": signals as the sensor gives them. "features": measured on such signals,
        which are not kept unless frames are asked, too. "recordings": all that a stream has, and a stream has nothing
        else.
    features : iterable of str, optional
        Names out of `cgid.measure.features.FEATURES`, only with the output "features". By default all of the kind
        that the sensor's quantity has, as far as sampling rate and frames allow.
    quantities : iterable of str, optional
        Names out of `cgid.scene.quantities.QUANTITIES`, all by default; only with the output "closed-form".
    dtype : {"float32", "float64"}
        Of stored samples.

    Raises
    ------
    InvalidValue
        There is no such output, feature or quantity, or they contradict each other or the scene.

    Examples
    --------
    >>> from cgid.scene import load_scene
    >>> from cgid.shipped import scene_path
    >>> asked = plan(load_scene(scene_path("reference")), ["closed-form"], quantities=["contact_duration"])
    >>> [stage.name for stage in asked.stages if stage.runs]
    ['parameters', 'closed forms', 'storing columns']
    """
    asked = frozenset((outputs,) if isinstance(outputs, str) else outputs)
    if not asked:
        raise InvalidValue(f"outputs must be at least one of {', '.join(OUTPUTS)}, got none")
    for output in sorted(asked):
        validation.choice("output", output, OUTPUTS)
    for name, given, output in (("features", features, "features"), ("quantities", quantities, "closed-form")):
        if given is not None and output not in asked:
            raise InvalidValue(f"{name} must come with the output {output!r}, which is not asked; leave them out")
    _require_recordings(scene, asked)
    request = Request(
        scene=scene,
        outputs=asked,
        features=_features(scene, features) if "features" in asked else (),
        quantities=_needed(asked, quantities),
        sample_bytes=np.dtype(validation.choice("dtype", dtype, ("float32", "float64"))).itemsize,
    )
    return _decided(request)


def _decided(request: Request) -> Plan:
    return Plan(request, {name: decide(request) for name, decide in STAGES.items()})


def _require_recordings(scene: Scene, outputs: frozenset[str]) -> None:
    """Raise `InvalidValue` if anything but recordings is asked of a stream, or recordings of another scene."""
    if scene.stream is not None and outputs != {"recordings"}:
        raise InvalidValue(
            f"outputs of scene {scene.name} must be recordings, for it is a stream, got {', '.join(sorted(outputs))}; "
            "make recordings of it (cgid generate SCENE -o RECORDING.h5)"
        )
    if scene.stream is None and "recordings" in outputs:
        raise InvalidValue(f"outputs of scene {scene.name} must not be recordings, for which it needs a section stream")


def _features(scene: Scene, features: Iterable[str] | None) -> tuple[str, ...]:
    names = choose(features, kind_for(scene.sensor.quantity))
    if features is None:
        return supported_by(scene, names)
    for rate in _extreme_rates(scene):
        require_supported(names, rate, scene.sampling.samples)
    return names


def supported_by(scene: Scene, features: Iterable[str]) -> tuple[str, ...]:
    """Return those of the features that every frame of a scene is sampled fast and long enough for.

    Raises
    ------
    InvalidValue
        None of them is.
    """
    names = tuple(features)
    for rate in _extreme_rates(scene):
        names = supported(names, rate, scene.sampling.samples)
    if not names:
        raise InvalidValue(
            f"scene {scene.name}: frames must be sampled fast and long enough for one feature at least, "
            f"{scene.sampling.samples} samples at {scene.sampling.sampling_rate:g} Hz hold none; record longer"
        )
    return names


def _extreme_rates(scene: Scene) -> tuple[float, ...]:
    """Return the sampling rate of a scene, or the lowest and the highest that it draws [Hz]."""
    drawn = None if scene.randomise is None else scene.randomise.sampling_rate
    return (scene.sampling.sampling_rate,) if drawn is None else drawn.extremes


def _needed(outputs: frozenset[str], quantities: Iterable[str] | None) -> tuple[str, ...]:
    """Return the quantities that are asked, or stored beside the signals."""
    asked = choose_quantities(quantities) if "closed-form" in outputs else ()
    if outputs.isdisjoint(("pulses", "frames", "recordings", "features")):
        return asked
    return tuple(dict.fromkeys((*STORED, *asked)))
