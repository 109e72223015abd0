"""What of a channel is not as in the training, explained once: by one score for every fault that is known.

`explain` compares the latest impacts with `cgid.identification.model.explanations`, and `ChannelWatch` does so again
and again in a live stream. Where nothing is explained, levels may tell a wrong scale (`levels`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cgid._lib.validation import UNKNOWN, Floats
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
    heights_of,
    reference,
)
from cgid.identification.prediction.levels import MIN_LEVELS, factor_of

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer

__all__ = ["ChannelWatch", "Explained", "Past", "explain"]

#: Age of the impacts that count in a live stream [s].
OLDEST = 300.0
#: Impacts from which on something is told.
LEAST_IMPACTS = 3
#: Impacts from which on two faults at once are told: the few that rise above noise are the strongest, and so no scale.
LEAST_OF_TWO = 10
#: Explanations whose odds are within this of the best are told beside it.
_ALIKE = 3.0
#: A fault is told rather than "nothing that is known", or other rocks, if its odds are at most this far below (by eye:
#: a rate in streams of other code, benchmarks/beam/anchor.py, has a name in three of five without the first; a scale of
#: 5 and of .05 was up to 4 below other rocks, and steel balls, which are other rocks, 9 above a rate). A beam whose
#: modes lie higher looks like a rate, which would be corrected in vain.
_RATHER: Mapping[tuple[Fault, ...], float] = {(Fault.UNKNOWN,): 10.0, (Fault.ROCKS,): 5.0, (Fault.RATE,): 3.0}
#: A live stream is looked at after so many impacts, then after every so many more (by a trial on 36 simulated seams).
_LOOKS = (10, 20)
_EVERY = 40
#: A fault is told by one look from odds so far beyond the limit on, else by two of which the second finds it possible
#: by its new impacts alone (by eye: of ten fresh sound seams five were told something at one look in hundreds of
#: impacts, up to 4 beyond it; two that end alike by chance are among the latest 80 at two looks).
_AT_ONCE = 10.0
#: A fault is over where so many looks in a row tell nothing, and have log odds of it so far below its limit (20 to 1).
_N_QUIET = 2
_CLEARLY = 3.0


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
        told; nan of a scale that levels tell, and without explanations or impacts.
    others : tuple of Fault
        What would explain it nearly as well, best first; never one of `faults`.
    of_past : bool
        Whether the faults are a change against the channel's own past, not against the training.
    possible : frozenset of (tuple of Fault, bool)
        What is told, or nearly so, and whether it is a change.
    """

    faults: tuple[Fault, ...] = ()
    factor: float = float("nan")
    odds: float = float("nan")
    others: tuple[Fault, ...] = ()
    of_past: bool = False
    possible: frozenset[tuple[tuple[Fault, ...], bool]] = frozenset()


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
    def of(cls, answers: Iterable[Answer], model: StoredModel, *, by_word: bool = False) -> Self | None:
        """Return the reference from the latest impacts; None if they are too few or, without a word, not sound."""
        if model.changes is None:
            return None
        latest = list(answers)[-MOST_OF_PAST:]
        impacts = Impacts.of(latest, model)
        if len(impacts.novelty) < LEAST_OF_PAST or (not by_word and explain(latest, model).faults):
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


def explain(
    answers: Iterable[Answer], model: StoredModel, past: Past | None = None, *, endless: bool = False
) -> Explained:
    """Return what explains impacts: as a change since a `past`, else by the training, else by their levels.

    `endless` is one of the many looks at a live stream.
    """
    latest, changed, found = list(answers)[-MOST_IMPACTS:], Explained(), Explained()
    if len(latest) < LEAST_IMPACTS:
        return found
    if past is not None:
        impacts = Impacts.of(latest[-MOST_OF_PAST:], model)
        if len(impacts.novelty) >= LEAST_CHANGED:
            changed = _judged(model.changes, impacts, model, past)
        if changed.faults or past.by_word:
            return changed
    if model.explanations is not None:
        found = _judged(model.explanations, Impacts.of(latest, model), model)
        found = replace(found, possible=found.possible | changed.possible)
        if found.faults or model.beam is not None:  # on a beam, levels are those of a seam
            return found
    if 2 * sum(one.label == UNKNOWN for one in latest) > len(latest):
        return found  # levels of impacts that the model does not know mean nothing
    heard = [one for one in latest if np.isfinite(one.level)]
    if len(heard) < MIN_LEVELS:
        return found
    levels, known, heights = [one.level for one in heard], None, None
    if model.beam is None and not model.level_range and all(one.sampled is not None for one in heard):
        known = np.array([one.label != UNKNOWN and not one.cut for one in heard])
        heights = heights_of(np.array([one.sampled for one in heard]))
    factor = factor_of(levels, model, known=known, heights=heights, endless=endless)
    return found if factor == 1 else replace(found, faults=(Fault.SCALE,), factor=factor, odds=np.nan)


def _judged(known: Explanations | None, impacts: Impacts, model: StoredModel, past: Past | None = None) -> Explained:
    if known is None or len(impacts.novelty) < LEAST_IMPACTS:
        return Explained()
    odds, factors = known.odds(impacts, model, None if past is None else past.numbers)
    excess = odds - known.limits[:, bin_of(len(impacts.novelty))]
    names, is_change = [one.faults for one in candidates_of(model.beam is not None)], past is not None
    possible = frozenset((names[k], is_change) for k in np.flatnonzero(excess > -_CLEARLY).tolist())
    # Limits say what is told, odds alone which: a limit is of sound recordings, and knows nothing of other faults.
    weight = odds - np.array([_RATHER.get(one, 0.0) for one in names])
    most = 2 if len(impacts.novelty) >= LEAST_OF_TWO else 1
    order = [k for k in np.argsort(-weight).tolist() if excess[k] > 0 and len(names[k]) <= most]
    if not order:
        return Explained(odds=float(excess.max()), possible=possible)
    best = order[0]
    others = dict.fromkeys(one for k in order[1:] if odds[k] > odds[best] - _ALIKE for one in names[k])
    return Explained(
        faults=names[best],
        factor=float(factors[best]),
        odds=float(excess[best]),
        others=tuple(one for one in others if one not in names[best]),
        of_past=is_change,
        possible=possible,
    )


class ChannelWatch:
    """What is wrong with one channel of a live stream, without flapping.

    It looks after 10, 20 and 40 impacts, then after every 40, at these and at the latest 80. A fault begins where its
    odds exceed the limit by far, or at two looks in a row, and ends where two looks in a row tell nothing and have odds
    of it clearly below. It changes its name only where another one is better at two looks in a row, and to none that it
    had before.

    Parameters
    ----------
    model : StoredModel
    past : Past, optional
        The channel's own reference, kept from before; without one, the first impacts that the training explains
        become it.

    Attributes
    ----------
    answers : deque of Answer
        The latest impacts.
    explained : Explained
        What stands; of the last look if nothing does.
    suspected : tuple of Fault
        What one look has found, and no other has confirmed yet.
    is_sure : bool
        Whether impacts that came after the look that found a fault say, too, that something is wrong: only then may it
        change a ground. It stays until the fault ends.
    past : Past or None
        The reference, to be kept over restarts; only a person renews it, with `renew`.
    """

    def __init__(self, model: StoredModel, past: Past | None = None) -> None:
        self._model, self.past = model, past
        self.answers: deque[Answer] = deque(maxlen=MOST_IMPACTS)
        self._is_renewing, self._n = False, 0
        self._found_at, self._quiet, self._other = 0, 0, Explained()
        self._names: set[tuple[Fault, ...]] = set()
        self.explained, self.suspected, self.is_sure = Explained(), tuple[Fault, ...](), False

    def add(self, answer: Answer) -> None:
        """Count one more impact."""
        self.answers.append(answer)
        self._n += 1
        if self._is_renewing:
            if len(self.answers) >= MOST_OF_PAST:
                self.past, self._is_renewing = Past.of(self.answers, self._model, by_word=True), False
        elif self._n in _LOOKS or not self._n % _EVERY:
            if self.past is None:
                self.past = Past.of(self.answers, self._model)
            self._look()

    def _look(self) -> None:
        before, endless = self.explained, self._n > _EVERY and not self.explained.faults
        latest = [list(self.answers)[-n:] for n in (_EVERY, MOST_OF_PAST)[len(self.answers) <= _EVERY :]]
        looks = [explain(some, self._model, self.past, endless=endless) for some in latest]
        now = max(looks, key=lambda one: (bool(one.faults), np.nan_to_num(one.odds, nan=-np.inf)))
        if not before.faults:
            if now.faults and now.faults != self.suspected:
                self._found_at = self._n
            is_told = not now.odds <= _AT_ONCE  # levels have no odds
            if not is_told and now.faults and now.faults == self.suspected:
                later = explain(list(self.answers)[self._found_at - self._n :], self._model, self.past)
                is_told = (now.faults, now.of_past) in later.possible
                self._found_at = self._found_at if is_told else self._n
            self.suspected = () if is_told else now.faults
            self.explained = now if is_told else Explained(odds=now.odds)
            self._quiet, self._names = 0, {now.faults}
        else:
            is_quiet = not now.faults and not any((before.faults, before.of_past) in one.possible for one in looks)
            self._quiet = self._quiet + 1 if is_quiet else 0
            if self._quiet >= _N_QUIET:
                self.explained, self.is_sure = now, False
                return
            is_new = bool(now.faults) and now.faults == self._other.faults and now.faults not in self._names
            self._other = now
            if now.faults == before.faults or is_new:
                self.explained = now
                self._names.add(now.faults)
        n_after = min(self._n - self._found_at, MOST_OF_PAST)
        if self.explained.faults and not self.is_sure and n_after >= _EVERY:
            self.is_sure = bool(explain(list(self.answers)[-n_after:], self._model, self.past).faults)

    def forget(self, time: float) -> None:
        """Forget impacts older than `OLDEST` at a time [s]; what stands, stands until impacts show otherwise."""
        while self.answers and self.answers[0].time < time - OLDEST:
            self.answers.popleft()

    def renew(self) -> None:
        """Take the impacts from now on as the channel's own past, by a person's word; what stood is over."""
        self.past, self._is_renewing = None, True
        self.answers.clear()
        self.explained, self.suspected, self.is_sure = Explained(), (), False
