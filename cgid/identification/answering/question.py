"""What is asked of a recording, and the answers as they come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from cgid.errors import InvalidValue
from cgid.identification.answers import Answer, Decision
from cgid.identification.model import Model
from cgid.identification.windows import VOTE_TIME

#: So many impacts are identified at once: a batch costs little more than a single one.
BATCH = 256
#: Samples that are held at once without a second thought.
WHOLE = 1 << 22


@dataclass(frozen=True, kw_only=True)
class Question:
    """What is asked of every impact or window of a recording.

    Attributes
    ----------
    decision : Decision
    drop_height : float or None
        How far the rocks fell [m], for a model that needs to know.
    dead_time : float or None
        See `find_impacts` [s].
    vote_time : float
        Windows are decided on the mean of the logarithms of their probabilities over so long [s]; 0: each by itself.
    sensors : tuple of str
        By which of the sensors that the model knows it was recorded: one for all channels, or one for each.
    batch : int
        Impacts wait until they are so many; with 1 none waits.
    whole : int
        A recording of up to so many samples, of all channels, is looked at as a whole by `find_impacts`, which knows
        its highest pulse; a longer one by `ImpactDetector` as it comes. With 0 every one is.
    """

    decision: Decision = field(default_factory=Decision)
    drop_height: float | None = None
    dead_time: float | None = None
    vote_time: float = VOTE_TIME
    sensors: tuple[str, ...] = ()
    batch: int = BATCH
    whole: int = WHOLE

    def heard_by(self, model: Model, channels: Sequence[str]) -> list[str | None]:
        """Return the sensor of each channel, or of each group of channels that the model looks at together.

        Raises
        ------
        InvalidValue
            There is another number of sensors, or the model knows none of this name.
        """
        if not self.sensors:
            return [None] * len(channels)
        if len(self.sensors) not in (1, len(channels)):
            raise InvalidValue(
                f"sensor must be one for all {len(channels)} channels or one for each, got {len(self.sensors)}"
            )
        for sensor in self.sensors:
            model.equalisation(sensor)
        return [*self.sensors] * (len(channels) // len(self.sensors))


@dataclass(frozen=True)
class Step:
    """Answers that have come.

    Attributes
    ----------
    answers : list of Answer
        In order of time.
    until : float
        No answer is still to come for what happened before this [s].
    silent : tuple of str
        Of which channels there was nothing to answer, and why; at the end.
    warnings : tuple of str
        What else is to be said; at the end.
    """

    answers: list[Answer]
    until: float
    silent: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
