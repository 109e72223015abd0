"""What the answers of a recording say of the caving window: the gangue share every so often, and when to shut."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from cgid import validation
from cgid.errors import InvalidValue
from cgid.identification.answering.share import Share, ShareWindow, trained_share
from cgid.identification.answering.shutting import Shutting, Turn
from cgid.identification.answers import Answer
from cgid.identification.model import Model

#: The label of what must not be drawn.
GANGUE = "gangue"
#: A share looks back over this, where nobody says it [s].
SHARE_TIME = 10.0
#: Over less there is nothing to share, and of an hour there would be millions of shares [s].
SHORTEST_SHARE_TIME = 0.05


@dataclass(frozen=True, kw_only=True)
class ShareSettings:
    """How shares are told.

    Attributes
    ----------
    length : float
        How far a share looks back [s], above 0.
    step : float
        From the end of one window to that of the next [s], above 0.
    gangue : tuple of str
        The labels of what must not be drawn.
    gangue_cost : float
        Of one drawn gangue impact, in lost coal impacts; above 0.
    """

    length: float = SHARE_TIME
    step: float = SHARE_TIME / 2
    gangue: tuple[str, ...] = (GANGUE,)
    gangue_cost: float = 1.0

    def __post_init__(self) -> None:
        if not validation.positive("window", self.length, "s") >= SHORTEST_SHARE_TIME:
            raise InvalidValue(f"window must be at least {SHORTEST_SHARE_TIME:g} s, got {self.length:g} s")
        validation.positive("step", self.step, "s")
        validation.positive("gangue_cost", self.gangue_cost)

    def serve(self, model: Model) -> bool:
        """Return whether a model tells gangue from something else."""
        return 0 < len(set(self.gangue) & set(model.labels)) < len(model.labels)

    def require(self, model: Model) -> None:
        """Raise `InvalidValue` if a label is none of the model's, or is all of them."""
        for label in self.gangue:
            validation.choice("gangue label", label, model.labels)
        if not self.serve(model):
            raise InvalidValue(
                f"gangue labels must leave another one, got all of the model's: {', '.join(self.gangue)}; leave one out"
            )


class CavingWatch:
    """Follows the answers of a recording, each channel for itself: a channel is a support with a window of its own.

    Parameters
    ----------
    model : Model
    channels : sequence of str
        Their names.
    settings : ShareSettings
    weight : float
        See `ShareWindow`.

    Examples
    --------
    See `cgid.cli.predict`, which prints what `feed` and `finish` return.
    """

    def __init__(self, model: Model, channels: Sequence[str], settings: ShareSettings, weight: float = 1.0) -> None:
        settings.require(model)
        share = trained_share(model, settings.gangue)
        self._settings = settings
        self._windows = {
            name: ShareWindow(settings.length, trained_share=share, weight=weight, channel=name) for name in channels
        }
        self._rules = {name: Shutting(settings.gangue_cost) for name in channels}
        self._waiting: deque[Answer] = deque()
        self._steps = 0
        # Channels whose last window held nothing, and has been told.
        self._silent: set[str] = set()

    @property
    def threshold(self) -> float:
        """The share above which going on costs more than it brings."""
        return Shutting(self._settings.gangue_cost).threshold

    def feed(self, answers: Iterable[Answer], until: float) -> list[Share | Turn]:
        """Return the shares of the windows that end by now, and the turns that they bring.

        Of windows without impacts only the first is told, so that a pause costs nothing, however long it is.

        Parameters
        ----------
        answers : iterable of Answer
            The next ones, in order of time.
        until : float
            No answer is still to come for what happened before this [s].
        """
        self._waiting.extend(answers)
        told: list[Share | Turn] = []
        self._pass_silence(until)
        while (end := (self._steps + 1) * self._settings.step) <= until:
            self._steps += 1
            told += self._at(end)
            self._pass_silence(until)
        return told

    def finish(self, duration: float) -> list[Share | Turn]:
        """Return what is left to tell at the end of a recording of so long [s]."""
        told = self.feed((), duration)
        return told + list(self._at(duration)) if self._waiting or not self._steps else told

    def _pass_silence(self, until: float) -> None:
        """Go on to the window of the next impact where all channels are silent, at most to the last one by now."""
        if len(self._silent) == len(self._windows):
            due = min(until, self._waiting[0].time) if self._waiting else until
            self._steps = max(self._steps, int(due / self._settings.step) - 1)

    def _at(self, end: float) -> Iterator[Share | Turn]:
        while self._waiting and self._waiting[0].time <= end:
            answer = self._waiting.popleft()
            self._windows[answer.channel].add(answer.time, self._probability(answer))
        for name, window in self._windows.items():
            share = window.at(end)
            if share.n_impacts + share.n_unknown:
                self._silent.discard(name)
            elif name in self._silent:
                continue
            else:
                self._silent.add(name)
            yield share
            turn = self._rules[name].watch(share)
            if turn is not None:
                yield turn

    def _probability(self, answer: Answer) -> float:
        """Return how probably an impact is gangue; nan where the model cannot speak of it."""
        if not answer.novelty <= 1:
            return float("nan")
        return sum(answer.probabilities[label] for label in self._settings.gangue)
