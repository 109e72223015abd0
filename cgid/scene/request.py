"""What is asked of a scene, and what is decided for a stage on the way to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cgid.scene.costs import Workload
from cgid.scene.quantities import QUANTITIES, drawn_units, measured_units
from cgid.scene.scene import Scene
from cgid.scene.stream.axis import samples_of

#: What can be asked of a scene.
OUTPUTS = ("parameters", "closed-form", "pulses", "frames", "recordings", "features")


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is asked of a scene.

    Attributes
    ----------
    scene : Scene
    outputs : frozenset of str
        Out of `OUTPUTS`.
    features : tuple of str
        Of `cgid.measure.features`; none unless features are asked.
    quantities : tuple of str
        Of `cgid.scene.quantities`: those asked, or needed by what is asked.
    sample_bytes : int
        Of one sample of signals that are kept.
    """

    scene: Scene
    outputs: frozenset[str]
    features: tuple[str, ...]
    quantities: tuple[str, ...]
    sample_bytes: int

    @property
    def signals(self) -> bool:
        """Whether there must be signals at all."""
        return not self.outputs.isdisjoint(("pulses", "frames", "recordings", "features"))

    @property
    def sensed(self) -> bool:
        """Whether there must be signals as the sensor gives them."""
        return not self.outputs.isdisjoint(("frames", "recordings", "features"))

    @property
    def kept(self) -> bool:
        """Whether the signals themselves are asked, whole."""
        return not self.outputs.isdisjoint(("pulses", "frames", "recordings"))

    @property
    def column_units(self) -> dict[str, str]:
        """The columns of a table of what is asked, and their units; signals that are kept come without one."""
        if self.kept:
            return {}
        if "features" in self.outputs:
            return measured_units(self.scene, self.features)
        return drawn_units(self.scene) | {name: QUANTITIES[name] for name in self.quantities}

    @property
    def signal_bytes(self) -> int:
        """Of one signal or recording on disk: its samples, or its columns."""
        if self.kept:
            return samples_of(self.scene) * self.sample_bytes
        return 8 * len(self.column_units)

    @property
    def impacts(self) -> bool:
        """Whether anything is asked that an impact delivers: more than what is drawn."""
        return bool(self.quantities) or self.signals

    def drawn(self, name: str) -> bool:
        """Return whether a setting is drawn for each block."""
        return self.scene.randomise is not None and name in self.scene.randomise.laws


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Whether a stage runs.

    Attributes
    ----------
    runs : bool
    why : str
    cost : callable
        From the workload to microseconds a signal or recording, if it runs.
    error_bound : float
        Of what is left out, relative to the peak; 0 where nothing changes.
    """

    runs: bool
    why: str
    cost: Callable[[Workload], float] = lambda work: 0.0
    error_bound: float = 0.0


NO_IMPACTS = Decision(runs=False, why="no populations: taps have no law of impact")
NO_SIGNALS = Decision(runs=False, why="no signals are asked for")
NO_SENSOR = Decision(runs=False, why="no sensed signals are asked for")
ONLY_DRAWN = Decision(runs=False, why="only what is drawn is asked for")
