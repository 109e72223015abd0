"""What is wrong with the channels of a recording: what explains their latest impacts, or that they are unknown.

`cgid.identification.prediction.explanation` explains those of models that know sound and spoilt recordings. Of others,
levels outside of what labelled recordings had are a wrong scale, windows are drowned in noise, and the rest is unknown.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cgid._lib.terminal import counted
from cgid._lib.validation import UNKNOWN
from cgid.identification.detection.events import EVENT_TIME
from cgid.identification.model.explanations import MOST_IMPACTS, Fault
from cgid.identification.prediction.explanation import ChannelWatch, Explained, Past, explain
from cgid.identification.prediction.findings import Finding
from cgid.units import UNITS

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer
    from cgid.identification.prediction.pasts import Pasts

#: Of so many latest predictions of a channel in a live stream, most are unknown from this fraction of at least so many
#: on, until it falls below the second fraction.
_RECENT = 60
_MIN_ANSWERS, _MOSTLY, _NO_LONGER = 20, 0.8, 0.5
#: Problems that are counted apart.
_MAX_EXAMPLES = 50
#: Up to this factor a seam and a wrong scale look alike: where any seam may fall, it is told and withdraws nothing.
_AS_A_SEAM = 5.0
#: Between these factors g and m/s^2 may have been confused.
_LIKE_G = (5.0, 20.0)


class _Channel:
    """The latest predictions of a channel, and what is known of them."""

    def __init__(self, model: StoredModel, past: Past | None, *, watched: bool) -> None:
        self.watch = ChannelWatch(model, past) if watched else None
        self.answers: deque[Answer] = deque(maxlen=MOST_IMPACTS)
        if self.watch is not None:
            self.answers = self.watch.answers
        self.n_answers = self.n_unknown = self.n_usable = 0
        self.problems: Counter[str] = Counter()
        self.latest = -np.inf

    def add(self, answer: Answer) -> None:
        """Count one more prediction."""
        is_unknown, is_soon = answer.label == UNKNOWN, 0 < answer.time - self.latest < EVENT_TIME
        self.latest = answer.time
        self.n_answers += 1
        self.n_unknown += is_unknown
        # Training excludes impacts that begin within the previous event.
        self.n_usable += bool(answer.probabilities) and not (
            is_soon or answer.overlapping or answer.clipped or answer.cut
        )
        if answer.problem in self.problems or len(self.problems) < _MAX_EXAMPLES:
            self.problems[answer.problem] += is_unknown
        (self.answers.append if self.watch is None else self.watch.add)(answer)

    def is_mostly_unknown(self, *, before: bool) -> bool:
        """Return whether most of the latest predictions are unknown; if they were `before`, until half are not."""
        recent = list(self.answers)[-_RECENT:]
        n_unknown = sum(answer.label == UNKNOWN for answer in recent)
        enough = len(recent) >= (1 if before else _MIN_ANSWERS)
        return enough and n_unknown >= (_NO_LONGER if before else _MOSTLY) * len(recent)


class Diagnosis:
    """Follow the predictions of a recording by channel, and say what is wrong with it.

    `findings` says what is wrong with the whole of a recording, by its latest impacts; where it is `watched`, `changes`
    says what begins and what ends, and `pasts` keep the references of channels.
    """

    def __init__(
        self,
        model: StoredModel,
        sampling_rate: float = float("nan"),
        *,
        labelled: bool = False,
        watched: bool = True,
        pasts: Pasts | None = None,
    ) -> None:
        self.model, self._rate, self._labelled, self._watched = model, sampling_rate, labelled, watched
        self._pasts = pasts
        self.channels: dict[str, _Channel] = {}
        self._standing: dict[str, dict[str, Finding]] = {}
        self._unknown: set[str] = set()  # channels whose latest predictions are mostly unknown

    def add(self, answers: Iterable[Answer]) -> None:
        """Count more predictions."""
        for answer in answers:
            if answer.channel not in self.channels:
                past = None if self._pasts is None else self._pasts.of(answer.channel)
                self.channels[answer.channel] = new = _Channel(self.model, past, watched=self._watched)
                if self._pasts is not None and self._pasts.renews and new.watch is not None:
                    new.watch.renew()
            self.channels[answer.channel].add(answer)

    def is_mostly_unknown(self, channel: str) -> bool:
        """Return whether most latest predictions of a channel are unknown, as of the last `changes`."""
        return channel in self._unknown

    def standing(self, channel: str) -> tuple[Finding, ...]:
        """Return what surely stands of a channel and can move its answers, as of the last `changes`."""
        if channel not in self.channels or self.is_doubtful(channel):
            return ()
        return tuple(one for one in self._standing.get(channel, {}).values() if one.moves)

    def is_doubtful(self, channel: str) -> bool:
        """Return whether something is wrong by impacts that no later ones have confirmed yet."""
        watch = self.channels[channel].watch if channel in self.channels else None
        return watch is not None and bool(watch.explained.faults or watch.suspected) and not watch.is_sure

    def stands(self, channel: str) -> bool:
        """Return whether anything stands of a channel, surely or not, as of the last `changes`."""
        return bool(self._standing.get(channel))

    def changes(self, time: float) -> list[Finding]:
        """Return what has begun or ended up to a time [s]."""
        found = []
        for name, channel in sorted(self.channels.items()):
            assert channel.watch is not None
            channel.watch.forget(time)
            if self._pasts is not None:
                self._pasts.keep(name, channel.watch.past)
            before = self._standing.get(name, {})
            is_unknown = channel.is_mostly_unknown(before=name in self._unknown)
            (self._unknown.add if is_unknown else self._unknown.discard)(name)
            explained = channel.watch.explained
            now = {one.kind: one for one in self._of(name, explained)} if explained.faults else {}
            if not now and is_unknown:
                now = {one.kind: one for one in self._of_unknown(name, channel)}
            began = {kind: replace(one, begin=time) for kind, one in now.items() if kind not in before}
            renamed = {"renamed": True} if now else {}
            found += [
                replace(one, end=time, fields={**one.fields, **renamed})
                for kind, one in before.items()
                if kind not in now
            ]
            found += began.values()
            # Its factor is better known later.
            self._standing[name] = {
                kind: began[kind] if kind in began else replace(one, begin=before[kind].begin)
                for kind, one in now.items()
            }
        return found

    def findings(self) -> list[Finding]:
        """Return what is wrong with the whole of a recording."""
        found = []
        for name, channel in sorted(self.channels.items()):
            explained = explain(channel.answers, self.model)
            own = self._of(name, explained) if explained.faults else []
            if not own and 2 * channel.n_unknown > channel.n_answers:
                own = self._of_unknown(name, channel)
            found += own
        return found

    def is_as_a_seam(self, channel: str) -> bool:
        """Return whether the factor of the levels of a channel may be that of a seam; no seam changes by itself."""
        factors = [one.factor for one in self.standing(channel) if one.kind == Fault.SCALE]
        watch = self.channels[channel].watch if channel in self.channels else None
        is_change = watch is not None and watch.explained.of_past
        return not is_change and all(max(factor, 1 / factor) < _AS_A_SEAM for factor in factors)

    def _of(self, name: str, explained: Explained) -> list[Finding]:
        """Return what explains the impacts of a channel: one finding a fault."""
        factor, odds, others = explained.factor, explained.odds, tuple(map(str, explained.others))
        # At a rate that the training does not cover, forces are too small, whatever the scale.
        is_covered = not self._rate < np.inf or self.model.covers(self._rate)
        faults = [one for one in explained.faults if is_covered or one != Fault.SCALE]
        return [self._finding(str(one), name, factor, odds, others) for one in faults]

    def _of_unknown(self, name: str, channel: _Channel) -> list[Finding]:
        """Return that most predictions of a channel are unknown, with what is known of why."""
        unknown = [one for one in channel.answers if one.label == UNKNOWN]
        measured = np.array([one.values for one in unknown if one.values is not None])
        if len(measured) and self.model.kind == "window":
            drowned = self.model.noise_novelty(measured[:, : len(self.model.inputs)]) > 1
            if drowned.mean() > 0.5:
                return [self._finding(str(Fault.NOISE), name)]
        problem = next((f" ({text})" for text, _ in (+channel.problems).most_common(1)), "")
        return [self._finding(str(Fault.UNKNOWN), name, problem=problem)]

    def _finding(
        self,
        kind: str,
        name: str,
        factor: float = float("nan"),
        odds: float = float("nan"),
        others: tuple[str, ...] = (),
        **fields: Any,
    ) -> Finding:
        """Return a finding with the fields that words share."""
        model, channel = self.model, self.channels[name]
        subject = "signal" if self._labelled else model.subject
        is_like_g = model.quantity == "acceleration" and _LIKE_G[0] < max(factor, 1 / factor) < _LIKE_G[1]
        unknown = f"{channel.n_unknown} of {counted(channel.n_answers, subject)} unknown: "
        common = {
            "unknown": unknown if 2 * channel.n_unknown > channel.n_answers else "",
            "times": times(factor) if np.isfinite(factor) else "",
            "true_rate": self._rate / factor,
            "rate": self._rate,
            "as_g": " (g taken for m/s^2 or the other way round is a factor of 9.81)" if is_like_g else "",
            "forces": "forces" if model.kind == "pulse" or model.beam is not None else "signals",
            "units": ", ".join(spellings(model.quantity)),
            "correct_rate": "correct sampling_rate",
            "what": "parts of recordings" if model.subject == "window" else "impacts",
            "or_rocks": ", or the rocks are of other sizes, drop heights or mixture" if model.beam is None else "",
        }
        return Finding(kind=kind, channels=(name,), factor=factor, odds=odds, others=others, fields=common | fields)


def times(factor: float) -> str:
    """Return a factor above or below 1 in words.

    >>> times(1.04), times(0.31), times(162.3)
    ('1.04 times', '0.31 times', '160 times')
    """
    return f"{float(f'{factor:.{2 + (0.95 < factor < 1.95)}g}'):g} times"


def spellings(quantity: str) -> list[str]:
    """Return the units of a quantity, one spelling of each."""
    first: dict[float, str] = {}
    for unit, factor in UNITS[quantity].items():
        first.setdefault(factor, unit)
    return list(first.values())
