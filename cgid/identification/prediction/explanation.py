"""What of a channel is not as in the training, explained once: by one score for every fault that is known.

`explain` compares the latest impacts with `cgid.identification.model.explanations`, and `ChannelWatch` does so again
and again in a live stream.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.identification.model.explanations import (
    LEAST_CHANGED,
    LEAST_OF_PAST,
    MAX_NUMBER,
    MOST_IMPACTS,
    MOST_OF_PAST,
    Explanations,
    Fault,
    Impacts,
    bin_of,
    candidates_of,
    reference,
)

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
#: A named fault is told rather than "nothing that is known" if its odds are at most this far below (by eye: a rate in
#: streams of other code, benchmarks/beam/anchor.py, has a name in three of five without it).
_BY_NAME = 10.0
#: A live stream is looked at after so many impacts, then after every so many more (by a trial on 36 simulated seams).
_LOOKS = (10, 20)
_EVERY = 40
#: A fault is over where so many looks in a row have log odds so far below the limit (by eye).
_N_QUIET = 2
_CLEARLY = 1.0


class Evidence:
    """The latest impacts of one channel."""

    def __init__(self, most: int = MOST_IMPACTS, answers: Iterable[Answer] = ()) -> None:
        self.answers: deque[Answer] = deque(answers, maxlen=most)

    def add(self, answer: Answer) -> None:
        """Count one more impact, in order of time."""
        self.answers.append(answer)

    def forget(self, time: float) -> None:
        """Forget the impacts of a live stream that are older than `OLDEST` at a time [s]."""
        while self.answers and self.answers[0].time < time - OLDEST:
            self.answers.popleft()

    def latest(self, n: int) -> Evidence:
        """Return the latest n impacts."""
        return Evidence(n, self.answers)

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
    """What the first impacts of a channel were like, with which later ones are compared.

    Attributes
    ----------
    numbers : ndarray
        `cgid.identification.model.explanations.reference` of them.
    by_word : bool
        Whether a person has said that the channel is sound as it is: then it is not compared with the training.
    """

    numbers: Floats
    by_word: bool = False

    @classmethod
    def of(cls, evidence: Evidence, model: StoredModel, *, by_word: bool = False) -> Self | None:
        """Return the reference from the latest impacts; None if they are too few or, without a word, not sound."""
        impacts = Impacts.of(list(evidence.answers)[-MOST_OF_PAST:], model)
        if model.changes is None or len(impacts.novelty) < LEAST_OF_PAST:
            return None
        if not by_word and explain(evidence, model).faults:
            return None
        return cls(numbers=reference(impacts, model), by_word=by_word)

    @classmethod
    def from_json(cls, content: object, model: StoredModel) -> Self:
        """Return the reference from what `to_json` gave. Raise `BadData` if it does not fit the model."""
        if model.changes is None:
            raise BadData("the model must have explanations of changes to compare a channel with its past")
        n, content = model.changes.n_reference, content if isinstance(content, Mapping) else {}
        numbers = content.get("numbers")
        if not isinstance(numbers, list) or len(numbers) != n:
            raise BadData(f"numbers must be a list of {n} for this model; take the past of the channel anew")
        if not all(one is None or (type(one) in (int, float) and abs(one) < MAX_NUMBER) for one in numbers):
            raise BadData("numbers must be finite, or null")
        found = np.array([np.nan if one is None else one for one in numbers], np.float64)
        return cls(numbers=found, by_word=content.get("by_word") is True)

    def to_json(self) -> dict[str, Any]:
        """Return some 50 to 250 numbers that `json.dumps` takes."""
        numbers = [float(f"{one:.6g}") if np.isfinite(one) else None for one in self.numbers]
        return {"numbers": numbers, "by_word": self.by_word}


def explain(evidence: Evidence, model: StoredModel, past: Past | None = None) -> Explained:
    """Return what explains the latest impacts: as a change since a `past`, else by the training."""
    if past is not None and model.changes is not None:
        latest = Impacts.of(list(evidence.answers)[-MOST_OF_PAST:], model)
        if len(latest.novelty) >= LEAST_CHANGED:
            found = _judged(model.changes, latest, evidence, model, past)
            if found.faults or past.by_word:
                return found
    if past is not None and past.by_word:
        return Explained(n_impacts=evidence.n_impacts, n_unknown=evidence.n_unknown)
    return _judged(model.explanations, Impacts.of(evidence.answers, model), evidence, model)


def _judged(
    known: Explanations | None, impacts: Impacts, evidence: Evidence, model: StoredModel, past: Past | None = None
) -> Explained:
    nothing = Explained(n_impacts=evidence.n_impacts, n_unknown=evidence.n_unknown)
    if known is None or len(impacts.novelty) < LEAST_IMPACTS:
        return nothing
    odds, factors = known.odds(impacts, model, None if past is None else past.numbers)
    excess = odds - known.limits[:, bin_of(len(impacts.novelty))]
    names = [one.faults for one in candidates_of(model.beam is not None)]
    weight = excess - _BY_NAME * np.array([one == (Fault.UNKNOWN,) for one in names])
    order = [k for k in np.argsort(-weight).tolist() if excess[k] > 0]
    if not order:
        return replace(nothing, odds=float(excess.max()))
    best = order[0]
    others = dict.fromkeys(one for k in order[1:] if excess[k] > excess[best] - _ALIKE for one in names[k])
    return replace(
        nothing,
        faults=names[best],
        factor=float(factors[best]),
        odds=float(excess[best]),
        others=tuple(one for one in others if one not in names[best]),
        of_past=past is not None,
    )


class ChannelWatch:
    """What is wrong with one channel of a live stream, without flapping.

    It looks after 10, 20 and 40 impacts, then after every 40, at these and at the latest 80. A fault begins where its
    odds exceed the limit, changes its name only where another one is better at two looks in a row, and ends where two
    looks in a row have odds clearly below the limit.

    Parameters
    ----------
    model : StoredModel
    past : Past, optional
        The channel's own reference, kept from before; without one, the first impacts that the training explains
        become it.

    Attributes
    ----------
    explained : Explained
        What stands; of the last look if nothing does.
    is_sure : bool
        Whether impacts that came after the look that found a fault say, too, that something is wrong: only then may it
        change a ground. It stays until the fault ends.
    since : float
        Time of the first impact of the look that found the fault [s]; nan without one.
    past : Past or None
        The reference, to be kept over restarts; only a person renews it, with `renew`.
    """

    def __init__(self, model: StoredModel, past: Past | None = None) -> None:
        self._model, self.past = model, past
        self._evidence, self._renewing, self._n = Evidence(MOST_OF_PAST), False, 0
        self._found_at, self._quiet, self._other = 0, 0, Explained()
        self.explained, self.is_sure, self.since = Explained(), False, float("nan")

    def add(self, answer: Answer) -> bool:
        """Count one more impact; return whether a fault begins, changes its name, becomes sure or ends."""
        self._evidence.add(answer)
        self._n += 1
        if self._renewing and self._evidence.n_impacts >= MOST_OF_PAST:
            self.past, self._renewing = Past.of(self._evidence, self._model, by_word=True), False
        if self._model.explanations is None or (self._n not in _LOOKS and self._n % _EVERY):
            return False
        if self.past is None and not self._renewing and self._evidence.n_impacts >= LEAST_OF_PAST:
            self.past = Past.of(self._evidence, self._model)
        return self._look()

    def _look(self) -> bool:
        some = {_EVERY, MOST_OF_PAST} if self._evidence.n_impacts > _EVERY else {MOST_OF_PAST}
        looks = [explain(self._evidence.latest(n), self._model, self.past) for n in sorted(some)]
        now, before = max(looks, key=lambda one: np.nan_to_num(one.odds, nan=-np.inf)), self.explained
        if not before.faults:
            self.explained = now
            if now.faults:
                self._found_at, self._quiet, self.since = self._n, 0, self._evidence.answers[0].time
            return bool(now.faults)
        self._quiet = self._quiet + 1 if not now.faults and not now.odds > -_CLEARLY else 0
        if self._quiet >= _N_QUIET:
            self.explained, self.is_sure, self.since = now, False, float("nan")
            return True
        renamed = bool(now.faults) and now.faults == self._other.faults and now.faults != before.faults
        self._other = now
        if now.faults == before.faults or renamed:
            self.explained = now
        was_sure, n_after = self.is_sure, min(self._n - self._found_at, MOST_OF_PAST)
        if not was_sure and n_after >= _EVERY:
            self.is_sure = bool(explain(self._evidence.latest(n_after), self._model, self.past).faults)
        return renamed or self.is_sure != was_sure

    def forget(self, time: float) -> None:
        """Forget impacts that are too old at a time [s]; what stands, stands until impacts show otherwise."""
        self._evidence.forget(time)

    def renew(self) -> None:
        """Take the impacts from now on as the channel's own past, by a person's word; what stood is over."""
        self.past, self._renewing = None, True
        self._evidence.answers.clear()
        self.explained, self.is_sure, self.since = Explained(), False, float("nan")
