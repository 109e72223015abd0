"""What of a channel is not as in the training, explained once: by one score for every fault that is known.

`explain` compares the latest impacts with `cgid.identification.model.explanations`, and `ChannelWatch` does so again
and again in a live stream.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from cgid.identification.model.explanations import MOST_IMPACTS, Fault, Impacts, bin_of, candidates_of

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer

__all__ = ["ChannelWatch", "Evidence", "Explained", "Fault", "Past", "explain"]

#: Age of the impacts that count in a live stream [s].
OLDEST = 300.0
#: Impacts from which on something is told.
LEAST_IMPACTS = 3
#: Explanations whose odds are within this of the best are told beside it.
_ALIKE = 3.0


class Evidence:
    """The latest impacts of one channel, at most `MOST_IMPACTS`."""

    def __init__(self) -> None:
        self.answers: deque[Answer] = deque(maxlen=MOST_IMPACTS)

    def add(self, answer: Answer) -> None:
        """Count one more impact, in order of time."""
        self.answers.append(answer)

    def forget(self, time: float) -> None:
        """Forget the impacts of a live stream that are older than `OLDEST` at a time [s]."""
        while self.answers and self.answers[0].time < time - OLDEST:
            self.answers.popleft()

    @property
    def n_impacts(self) -> int:
        """Number of impacts that count."""
        return len(self.answers)

    @property
    def n_unknown(self) -> int:
        """Number of impacts outside of the training, or not measured."""
        return sum(not answer.novelty <= 1 for answer in self.answers)


@dataclass(frozen=True, kw_only=True)
class Explained:
    """What explains the latest impacts of a channel.

    Attributes
    ----------
    faults : tuple of Fault
        What is wrong, the best explanation first; two where both are there at once (a scale and noise, or clipped).
        Empty if the channel is as in the training (or as its own past), or if it is not known.
    factor : float
        Of samples over what they should be (scale), or of the stated sampling rate over the true one (rate); nan
        without either among the faults.
    odds : float
        Natural logarithm of the odds of the faults against "as the training", less the limit from which on they are
        told, which is 0 here. Above 0 if and only if something is told; nan without explanations or impacts.
    others : tuple of Fault
        What would explain it nearly as well, best first; never one of `faults`.
    n_impacts, n_unknown : int
        Impacts that count, and those of them outside of the training or not measured.
    of_past : bool
        Whether the faults are a change against the channel's own past, not against the training.
    """

    faults: tuple[Fault, ...] = ()
    factor: float = float("nan")
    odds: float = float("nan")
    others: tuple[Fault, ...] = ()
    n_impacts: int = 0
    n_unknown: int = 0
    of_past: bool = False


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Past:
    """What the first impacts of a channel were like, which any seam explains: the reference for later changes."""

    content: Mapping[str, list[float]]

    @classmethod
    def of(cls, evidence: Evidence, model: StoredModel) -> Self | None:
        """Return the reference from the latest impacts; None if they are too few or not sound."""
        return None

    @classmethod
    def from_json(cls, content: object, model: StoredModel) -> Self:
        """Return the reference from what `to_json` gave. Raise `BadData` if it does not fit the model."""
        raise NotImplementedError

    def to_json(self) -> dict[str, list[float]]:
        """Return numbers that `json.dumps` takes, some 10 kB."""
        return dict(self.content)


def explain(evidence: Evidence, model: StoredModel, past: Past | None = None) -> Explained:
    """Return what explains the impacts best, in the training and, with a `past`, of a change since then."""
    impacts, n_unknown = Impacts.of(evidence.answers, model), evidence.n_unknown
    nothing = Explained(n_impacts=evidence.n_impacts, n_unknown=n_unknown)
    known = model.explanations
    if known is None or len(impacts.novelty) < LEAST_IMPACTS:
        return nothing
    odds, factors = known.odds(impacts, model)
    excess = odds - known.limits[:, bin_of(len(impacts.novelty))]
    told = [k for k in np.argsort(-odds).tolist() if excess[k] > 0]
    if not told:
        return replace(nothing, odds=float(excess.max()))
    names = [one.faults for one in candidates_of(model.beam is not None)]
    best = told[0]
    others = {one: None for k in told[1:] if odds[k] > odds[best] - _ALIKE for one in names[k]}
    return replace(
        nothing,
        faults=names[best],
        factor=float(factors[best]),
        odds=float(excess[best]),
        others=tuple(one for one in others if one not in names[best]),
    )


class ChannelWatch:
    """What is wrong with one channel of a live stream, without flapping.

    It looks after 10, 20 and 40 impacts, then after every 40 more. A fault begins where its odds exceed the limit,
    changes its name only where the new one is clearly better, and ends where the odds fall clearly below the limit.

    Parameters
    ----------
    model : StoredModel
    past : Past, optional
        The channel's own reference, kept from before; without one, the first impacts that the training explains
        become it.

    Attributes
    ----------
    explained : Explained
        What stands.
    is_sure : bool
        Whether two looks without an impact in common agree that something is wrong: only then may it change a ground.
        It stays until the fault ends.
    since : float
        Time of the first impact of the look that found the fault [s]; nan without one.
    past : Past or None
        The reference, to be kept over restarts; a person renews it with `renew`.
    """

    def __init__(self, model: StoredModel, past: Past | None = None) -> None:
        self._model, self.past = model, past
        self._evidence = Evidence()
        self.explained, self.is_sure, self.since = Explained(), False, float("nan")

    def add(self, answer: Answer) -> bool:
        """Count one more impact; return whether a fault or its factor begins, changes, becomes sure or ends."""
        self._evidence.add(answer)
        return False

    def forget(self, time: float) -> None:
        """Forget impacts that are too old at a time [s]; what stands, stands until impacts show otherwise."""
        self._evidence.forget(time)

    def renew(self) -> None:
        """Take the impacts from now on as the channel's own past, by a person's word."""
        self.past = None
