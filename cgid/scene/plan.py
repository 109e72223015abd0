"""The plan: from a scene and what is asked of it, what runs, what is skipped, why, and what it costs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from cgid import validation
from cgid.errors import InvalidValue
from cgid.features import choose, kind_for
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
        What it is estimated to cost a signal, on one thread; 0 where it is skipped.
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
        """Estimated cost of a signal."""
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
        without a sensor. "frames": signals as the sensor gives them. "features": measured on such signals, which are
        not kept unless frames are asked, too.
    features : iterable of str, optional
        Names out of `cgid.features.FEATURES`, all by default; only with the output "features".
    quantities : iterable of str, optional
        Names out of `cgid.scene.quantities.QUANTITIES`, all by default; only with the output "closed-form".
    dtype : {"float32", "float64"}
        Of stored samples.

    Raises
    ------
    InvalidValue
        There is no such output, feature or quantity, or they contradict each other.

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
    request = Request(
        scene=scene,
        outputs=asked,
        features=choose(features, kind_for(scene.sensor.quantity)) if "features" in asked else (),
        quantities=_needed(asked, quantities),
        sample_bytes=np.dtype(validation.choice("dtype", dtype, ("float32", "float64"))).itemsize,
    )
    return _decided(request)


def _decided(request: Request) -> Plan:
    return Plan(request, {name: decide(request) for name, decide in STAGES.items()})


def _needed(outputs: frozenset[str], quantities: Iterable[str] | None) -> tuple[str, ...]:
    """Return the quantities that are asked, or stored beside the signals."""
    asked = choose_quantities(quantities) if "closed-form" in outputs else ()
    if outputs.isdisjoint(("pulses", "frames", "features")):
        return asked
    return tuple(dict.fromkeys((*STORED, *asked)))
