"""The settings for identifying a recording, shared by the command line, the API and live streams."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

import numpy as np

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import UNKNOWN, Floats, Rule, shown
from cgid.errors import InvalidValue
from cgid.identification.prediction.vote import VOTE_TIME

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel

__all__ = ["PredictionSettings"]

#: Channels of one beam, as `require_groups` takes them.
BeamGroups = str | Sequence[str] | Sequence[Sequence[str]]

#: Begin and end [s] of each span, and perhaps its channel, as `require_spans` takes them.
Spans = Sequence[tuple[float, float] | tuple[float, float, str]]

#: Number of impacts in one batch, which takes little longer than a single one.
BATCH = 256
#: Default window of a gangue fraction [s].
SHARE_TIME = 10.0
#: Minimum window of a gangue fraction [s]: a shorter one contains too few impacts, and an hour would have millions.
MIN_SHARE_TIME = 0.05
#: Cost of each second and unit of fraction below the limit while shut, over that above it while drawing: the lowest of
#: those tried with which, with and without stated coal, less than one simulated caving cycle in a hundred is shut more
#: than a window too early (benchmarks/identification/caving_cycle.py --settle).
COST_EARLY = 6.0
#: A support is blind after this time without valid samples [s].
BLIND_TIME = 5.0
#: A longer hold keeps a decision for ever, and a longer `blind_after` switches the watch of a sensor off [s].
LONGEST = 3600.0
#: The rules of settings that are numbers, unless None.
RULES = {
    "coverage": Rule(),
    "vote_time": Rule(0, unit="s"),
    "share_time": Rule(MIN_SHARE_TIME, unit="s"),
    "share_step": Rule(0, without="lowest", unit="s"),
    "dilution_cost": Rule(0, without="lowest"),
    "cost_early": Rule(0),
    "hold": Rule(0, LONGEST, unit="s"),
    "coal_until": Rule(0, without="lowest", unit="s"),
    "cycle_pause": Rule(0, without="lowest", unit="s"),
    "blind_after": Rule(0.5, LONGEST, unit="s"),
    "give_up": Rule(0, without="lowest", unit="s"),
}


class LabelledSpan(NamedTuple):
    """A time [s] in which only rocks of a label fall: on a channel, or on all without a name."""

    start: float
    end: float
    channel: str = ""


class ShareSettings(NamedTuple):
    """Settings of the gangue fraction, as in `PredictionSettings`; times in seconds."""

    window: float
    step: float
    gangue: tuple[str, ...]
    dilution_cost: float
    cost_early: float
    hold: float
    coal_until: float | None
    cycle_pause: float | None
    coal: tuple[LabelledSpan, ...]
    lumps: tuple[LabelledSpan, ...]
    trained_seam: bool

    @property
    def costs(self) -> dict[str, float]:
        """The costs of a decision."""
        return {name: getattr(self, name) for name in ("dilution_cost", "cost_early")}


@dataclass(frozen=True, kw_only=True)
class ReadingSettings:
    """How the impacts of a recording are heard.

    Attributes
    ----------
    mass : float, optional [kg]
        Mass of the accelerated impactor; turns an acceleration into a force.
    invert : bool
        Whether pulses point downwards.
    lines : bool, optional
        Whether tones of machines are taken out of accelerations that a model sees through a beam: from the start,
        never, or, without a statement, once two seconds have told that a machine runs.
    dead_time : float, optional [s]
        Time after an impact in which no other begins, see `find_impacts`.
    blind_after : float, optional [s]
        Time without valid samples after which a support is blind; None: `BLIND_TIME`.
    give_up : float, optional [s]
        The recording ends where no channel has a sample that a sensor can give for this long; None: it goes on.
    same_beam : tuple of tuple of str
        Channels of one beam, by name or number from 1, such as (("1", "2"), ("3", "4")): an impact that several of them
        measure is one prediction. "1+2" and ["1+2", "3+4"] are taken, too.
    """

    mass: float | None = None
    invert: bool = False
    lines: bool | None = None
    dead_time: float | None = None
    blind_after: float | None = None
    give_up: float | None = None
    same_beam: tuple[tuple[str, ...], ...] = ()

    @property
    def blinded_after(self) -> float:
        """Time without valid samples after which a support is blind [s]."""
        return BLIND_TIME if self.blind_after is None else self.blind_after


@dataclass(frozen=True, kw_only=True)
class AnsweringSettings:
    """What the answer for an impact or window is.

    Attributes
    ----------
    costs : mapping of str to float
        Cost of missing each label, default 1: with coal 1 and gangue 3, coal must be three times as probable.
    coverage : float, optional
        Fraction of prediction sets that contain the truth; rejects sets without exactly one label; None: no rejection.
    vote_time : float, optional [s]
        Windows that are known are decided on together over this time; 0: no voting; None: `VOTE_TIME`.
    batch : int
        Number of impacts to collect before identification; 1: no waiting.
    """

    costs: Mapping[str, float] = field(default_factory=dict)
    coverage: float | None = None
    vote_time: float | None = None
    batch: int = BATCH

    def labels(self, model: StoredModel, probabilities: Floats) -> tuple[list[str], list[tuple[str, ...] | None]]:
        """Return the label and the prediction set of each row of probabilities."""
        if self.coverage is None:
            return model.decide(probabilities, self.costs).tolist(), [None] * len(probabilities)
        prediction_sets = model.prediction_set(probabilities, self.coverage)
        sets = [tuple(compress(model.labels, row)) for row in prediction_sets.tolist()]
        return [one[0] if len(one) == 1 else UNKNOWN for one in sets], [*sets]

    def doubt(self, labels: tuple[str, ...]) -> str:
        """Return why a prediction set gives no label; empty for a single label."""
        if len(labels) == 1:
            return ""
        if not labels:
            return f"no label is probable enough: the prediction set at coverage {self.coverage:g} is empty"
        listed = "both" if len(labels) == 2 else f"these {len(labels)}"
        return f"{' or '.join(labels)}: the prediction set at coverage {self.coverage:g} contains {listed}"

    def vote_over(self, model: StoredModel) -> float:
        """Return the time over which windows vote [s]."""
        return max(VOTE_TIME if self.vote_time is None else self.vote_time, model.window_time)


@dataclass(frozen=True, kw_only=True)
class WatchingSettings:
    """What is told of the gangue fraction, and when the window is shut.

    Attributes
    ----------
    share_time : float, optional [s]
        Window of a gangue fraction; None: `SHARE_TIME`.
    share_step : float, optional [s]
        Time between the ends of successive windows of shares; None: half a window.
    gangue : tuple of str
        Labels of rocks that must not be drawn; by default "gangue".
    dilution_cost : float, optional
        Cost of one drawn gangue rock, in lost coal rocks; None: 1.
    cost_early : float, optional
        Loss for each second shut below the limit and unit of fraction below it, over that of drawing above it; None:
        `COST_EARLY`. SHUT is at the least expected loss; OPEN also needs an interval below the limit.
    hold : float, optional [s]
        Least time between SHUT and OPEN; None: a window.
    coal_until : float, optional [s]
        Only coal falls for so long from the start: an anchor for the gangue fraction of this seam; None: the seam is
        not known.
    cycle_pause : float, optional [s]
        The first impact after such a pause begins another caving cycle, with as long a time of coal; None: one cycle.
    coal : tuple of (float, float) or (float, float, str), optional [s]
        Begin and end of spans of coal alone, such as of labelled impacts, and the channel if it is of one; in place of
        `coal_until`.
    lumps : tuple of (float, float) or (float, float, str), optional [s]
        Likewise of gangue alone, such as of ten labelled lumps: beside stated coal they sharpen the gangue fraction.
    trained_seam : bool
        The seam is that of the training, so that the gangue fraction takes its rates of errors.
    """

    share_time: float | None = None
    share_step: float | None = None
    gangue: tuple[str, ...] = ()
    dilution_cost: float | None = None
    cost_early: float | None = None
    hold: float | None = None
    coal_until: float | None = None
    cycle_pause: float | None = None
    coal: tuple[LabelledSpan, ...] = ()
    lumps: tuple[LabelledSpan, ...] = ()
    trained_seam: bool = False

    @property
    def shares(self) -> ShareSettings:
        """Settings of the gangue fraction, with the defaults."""
        window = SHARE_TIME if self.share_time is None else self.share_time
        return ShareSettings(
            window=window,
            step=window / 2 if self.share_step is None else self.share_step,
            gangue=self.gangue or ("gangue",),
            dilution_cost=1.0 if self.dilution_cost is None else self.dilution_cost,
            cost_early=COST_EARLY if self.cost_early is None else self.cost_early,
            hold=window if self.hold is None else self.hold,
            coal_until=self.coal_until,
            cycle_pause=self.cycle_pause,
            coal=self.coal,
            lumps=self.lumps,
            trained_seam=self.trained_seam,
        )

    @property
    def needs_shares(self) -> bool:
        """Whether an option requests gangue fractions, so that even a single impact has them."""
        decides = (self.share_time, self.dilution_cost, self.cost_early, self.hold, self.coal_until)
        return bool(self.gangue or self.coal) or self.trained_seam or any(one is not None for one in decides)


@dataclass(frozen=True, kw_only=True)
class PredictionSettings(ReadingSettings, AnsweringSettings, WatchingSettings):
    """Settings for every impact or window of a recording: those of reading, answering and watching.

    Costs and a coverage exclude each other, since a single-label prediction set is a decision. Raises
    `InvalidValue` for this, and for numbers outside of their range.
    """

    def __post_init__(self) -> None:
        for name, rule in RULES.items():
            if (value := getattr(self, name)) is not None:
                validation.number(name, value, rule=rule)
        validation.instance("invert", self.invert, bool, np.bool_)
        if self.lines is not None:
            validation.instance("lines", self.lines, bool, np.bool_)
        if self.same_beam:
            object.__setattr__(self, "same_beam", require_groups(self.same_beam))
        validation.instance("costs", self.costs, Mapping)
        if self.costs and self.coverage is not None:
            raise InvalidValue("costs and coverage must not be given together; leave one out")
        validation.instance("trained_seam", self.trained_seam, bool, np.bool_)
        for name, label in (("coal", "coal"), ("lumps", "gangue")):
            if getattr(self, name):
                object.__setattr__(self, name, require_spans(getattr(self, name), label))
        if self.cycle_pause is not None and self.coal_until is None:
            raise InvalidValue(
                f"cycle_pause must come with coal_until, the coal of each cycle; give {spelled('coal_until')}, too"
            )
        coal = {
            "coal_until": self.coal_until is not None,
            "labelled coal": self.coal,
            "trained_seam": self.trained_seam,
        }
        if len(stated := [name for name, given in coal.items() if given]) > 1:
            raise InvalidValue(f"{' and '.join(stated)} must not be given together; leave one out")
        if self.lumps and not (self.coal or self.coal_until is not None):
            raise InvalidValue(
                f"labelled gangue must come with stated coal, which tells the seam; label coal, or give "
                f"{spelled('coal_until')}"
            )
        if (first := min((one.start for one in self.lumps), default=np.inf)) < (self.coal_until or 0.0):
            raise InvalidValue(
                f"labelled gangue must begin after the {self.coal_until:g} s of coal alone, got {first:g} s; shorten "
                f"{spelled('coal_until')}, or leave the row out"
            )

    def check(self, model: StoredModel) -> None:
        """Raise `InvalidValue` if the model lacks a label or the coverage, or decides on what a setting is not of."""
        self.labels(model, np.empty((0, len(model.labels))))
        of_others = {"impact": ("vote_time", self.vote_time), "window": ("dead_time", self.dead_time)}
        flag, given = of_others[model.subject]
        if given is not None:
            raise InvalidValue(f"{flag} must be left out, this model decides on {model.subject}s")


class GivenSettings(TypedDict, total=False):
    """Fields of `PredictionSettings` as arguments, of which editors and checkers know names and types."""

    mass: float | None
    invert: bool
    lines: bool | None
    dead_time: float | None
    blind_after: float | None
    give_up: float | None
    same_beam: BeamGroups
    costs: Mapping[str, float]
    coverage: float | None
    vote_time: float | None
    batch: int
    share_time: float | None
    share_step: float | None
    gangue: tuple[str, ...]
    dilution_cost: float | None
    cost_early: float | None
    hold: float | None
    coal_until: float | None
    cycle_pause: float | None
    coal: Spans
    lumps: Spans
    trained_seam: bool


def require_spans(spans: Any, label: str) -> tuple[LabelledSpan, ...]:
    """Return spans of coal or gangue; raises `InvalidValue` unless each rises from 0 s.

    >>> require_spans([(0, 30)], "coal")
    (LabelledSpan(start=0.0, end=30.0, channel=''),)
    """
    found = []
    for one in spans if isinstance(spans, list | tuple) else [spans]:
        start, end, *channel = one if isinstance(one, list | tuple) and len(one) in (2, 3) else (None, None)
        if not all(isinstance(value, int | float | np.number) for value in (start, end)):
            raise InvalidValue(f"spans of {label} must be begin and end each [s], as in [(0, 30)], got {shown(spans)}")
        if not 0 <= start < end:
            raise InvalidValue(f"a span of {label} must rise from 0 s, got {start:g} s to {end:g} s; correct it")
        found.append(LabelledSpan(float(start), float(end), *map(str, channel)))
    return tuple(found)


def require_groups(groups: Any) -> tuple[tuple[str, ...], ...]:
    """Return the groups of channels of one beam; raises `InvalidValue` unless each names two or more, no channel twice.

    >>> require_groups(["1+2", (3, 4)]), require_groups("1+2, 3+4")
    ((('1', '2'), ('3', '4')), (('1', '2'), ('3', '4')))
    """
    groups = groups.split(",") if isinstance(groups, str) else groups
    listed = groups if isinstance(groups, list | tuple) else None
    parts = [one.split("+") if isinstance(one, str) else one for one in listed or ()]
    if listed is None or not all(isinstance(one, list | tuple) for one in parts):
        raise InvalidValue(f"same_beam must be groups of channels, as in '1+2' or ['1+2', '3+4'], got {shown(groups)}")
    named = tuple(tuple(str(channel).strip() for channel in one) for one in parts)
    for one in named:
        if len(one) < 2 or not all(one):
            raise InvalidValue(
                f"same_beam must name two or more channels of a beam, as in 1+2, got {'+'.join(one) or 'none'}; a beam "
                "of one channel needs no group"
            )
    channels = [channel for one in named for channel in one]
    for channel in channels:
        if channels.count(channel) > 1:
            raise InvalidValue(
                f"same_beam must name each channel once, got {channel} twice in {', '.join(map('+'.join, named))}; "
                "write channels of one beam as one group, such as 1+2+3"
            )
    return named
