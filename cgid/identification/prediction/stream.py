"""Predictions for a recording in blocks: impacts or windows, in batches, in order of time.

Memory use is that of the detector and one batch of impacts, for recordings of any length.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData, CgidError, InvalidValue
from cgid.identification.detection.detector import invert_hint
from cgid.identification.detection.ear import Ear
from cgid.identification.detection.events import Event
from cgid.identification.detection.windows import measure_windows, windows_of
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer, answers_from, measured_events, unmeasured
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.same_beam import SameBeam, Together, answering_channels, pooled, rows_of
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.vote import RunningVote
from cgid.measure.features.extraction import features_of, require_measurable
from cgid.measure.features.table import MIN_BANDWIDTH, ImpactKind
from cgid.recordings.soundness import FAR_BELOW

if TYPE_CHECKING:
    from cgid.identification.prediction.support import SupportReport

#: Minimum sampling rate [Hz]; a lower one is in another unit, or not of an impact recorder.
SLOWEST = 10.0


#: Windows [s], and how many of them make a stretch of 10 s.
_QUIET_WINDOW, _QUIET_STRETCH = 0.02, 500
#: Where the noise is reached between impacts, the power at the second of these quantiles is at most this many times
#: that at the first: 2 in `caving` with 8 and 16 rocks a second, 6 with 40, where four of ten impacts are missed.
_QUIET_SHARES, _QUIET_RATIO = (0.01, 0.2), 4.0
#: A channel is quiet again after so many stretches that are. Of so many stretches, one with noise far below that of
#: another is of a lost sensor and tells nothing.
_N_QUIET, _N_BEFORE = 3, 60


@dataclass(frozen=True, eq=False, repr=False)
class Step:
    """The next predictions."""

    answers: list[Answer]  # in order of time
    until: float  # all predictions before this time have arrived [s]
    found: Sequence[Finding] = ()  # what begins and what ends, in order of time
    heard: Mapping[str, float] = field(default_factory=dict)  # channel -> until when a machine's tones were left in [s]
    reports: Sequence[SupportReport] = ()  # of the supports, up to this time


def identify_blocks(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: StoredModel,
    channels: Sequence[str],
    settings: PredictionSettings,
    source: str = "signal",
) -> Iterator[Step]:
    """Return the predictions for blocks (n_channels, n_samples) in the unit of the model; nan is missing."""
    # Below this rate, features of vibrations and windows are those of models that were trained there.
    trained = 0.0 if model.kind == "pulse" else min(2 * MIN_BANDWIDTH, 0.99 * model.sampling_rates[0])
    needed = max([SLOWEST, trained, *(2 * one.highest_frequency for one in features_of(model.measured))])
    if sampling_rate < needed:
        raise InvalidValue(
            f"{source}: the sampling_rate must be at least {math.ceil(needed)} Hz for this model, got "
            f"{sampling_rate:g} Hz; check it, record faster, or train a model on recordings like this one"
        )
    settings.check(model)
    return STRATEGIES[model.subject].steps(_read(blocks), sampling_rate, model, channels, settings, source)


def _read(blocks: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Yield the blocks; an error in reading them names their file."""
    try:
        yield from blocks
    except CgidError as error:
        error.names_file = True
        raise


@contextmanager
def _named(source: str) -> Iterator[None]:
    """Prefix errors with the recording."""
    try:
        yield
    except (BadData, InvalidValue) as error:
        if error.names_file:
            raise
        raise type(error)(f"{source}: {error}") from None


def _impacts(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: StoredModel,
    channels: Sequence[str],
    settings: PredictionSettings,
    source: str,
) -> Iterator[Step]:
    """Yield the predictions for impacts: when a batch is full, or when no impact is pending."""
    kind: ImpactKind = "pulse" if model.kind == "pulse" else "vibration"
    joint, through = model.together > 1 and not settings.same_beam, model.beam
    beam = None if through is None else through.of(sampling_rate).stream()
    waiting: list[Event] = []
    silent, warned = set(range(len(channels))), set[int]()

    def of(row: int, kind: str, **more: Any) -> Finding:
        return Finding(kind=kind, channels=(channels[row],), **more)

    with _named(source):
        groups = rows_of(model, channels, settings.same_beam)
        names = answering_channels(groups, channels)
        # A model of labelled recordings has learned with their tones, unless it followed them.
        tones = settings.lines if beam is not None else model.is_mended and settings.lines is not False
        ear = Ear(
            sampling_rate,
            len(channels),
            kind=kind,
            dead_time=settings.dead_time,
            joint=joint,
            lines=tones,
            beam=through,
        )
        require_measurable(model.measured, ear.rate, ear.n_samples, model.beam)
        same_beam = SameBeam(model, channels, settings, ear.rate, sampling_rate) if settings.same_beam else None
        together = Together(ear.rate, ((row,) for row in range(len(channels)))) if len(channels) > 1 else None
        quiet = _Quiet(ear.rate, len(channels)) if kind == "vibration" else None
        lines, n_heard = ear.lines, 0
        if ear.is_brought:
            rates = {"rate": sampling_rate, "heard": ear.rate}
            yield Step([], 0.0, found=[Finding(kind="resampled", fields=rates)])
        for events, until, block in map(ear.feed, chain(blocks, [None])):
            ended, n_heard = until == np.inf, n_heard + block.shape[1]
            silent -= set(range(len(channels))) if joint and events else {event.channel for event in events}
            waiting += (replace(event, channel=0) for event in events) if joint else events
            loud = warned if quiet is None else quiet.loud(block) - silent
            found = [of(row, "loud") for row in sorted(loud - warned)]
            found += [of(row, "loud", end=n_heard / ear.rate) for row in sorted(warned - loud)]
            deaf = dict[int, float]()
            if lines is not None:
                found += [of(row, "unsteady") for row in lines.told()]
                found += [of(row, "tones", fields={"tone": tone}) for row, tone in lines.tones().items()]
                deaf = lines.heard()
            warned = loud
            if not (ended or found or deaf or not waiting or len(waiting) >= settings.batch):
                continue
            if same_beam is None:
                answers, _ = measured_events(waiting, model, settings, names, beam)
                found += () if together is None else together.feed(waiting, channels, ended=ended)
            else:
                answers, begin, said = same_beam.identified(waiting, until)
                found, until = found + said, min(until, begin)
            if ended:
                for row in sorted(silent):
                    text = ear.why_silent(row, model.unit)
                    turned = ear.is_upside_down(row)  # why it is silent
                    fields = {"silent": text.removesuffix(invert_hint())} if turned else {"text": text}
                    found.append(of(row, "upside_down" if turned else "silent", fields=fields))
            yield Step(
                answers,
                min(until, n_heard) / ear.rate,
                found=found,
                heard={
                    name: max(deaf[row] for row in deaf.keys() & set(rows))
                    for name, rows in zip(names, groups, strict=True)
                    if deaf.keys() & set(rows)
                },
            )
            waiting.clear()


class _Quiet:
    """Find channels that are never quiet: even the quieter windows of a stretch are far above the quietest."""

    def __init__(self, sampling_rate: float, n_channels: int) -> None:
        self._length = max(round(_QUIET_WINDOW * sampling_rate), 2)
        self._remaining: Floats = np.empty((n_channels, 0))
        self._powers: Floats = np.empty((n_channels, 0))
        self._n_quiet = np.full(n_channels, _N_QUIET)
        self._floors: deque[Floats] = deque(maxlen=_N_BEFORE)

    def loud(self, block: NDArray[Any]) -> set[int]:
        """Take a block (n_channels, n) and return the channels that were not quiet in one of the last stretches."""
        samples = np.concatenate([self._remaining, block], axis=1) if self._remaining.size else block
        count = samples.shape[1] // self._length
        windows = samples[:, : count * self._length].reshape(len(samples), count, self._length)
        self._remaining = samples[:, count * self._length :].copy()
        self._powers = np.concatenate([self._powers, windows.var(axis=2, dtype=np.float64)], axis=1)
        while self._powers.shape[1] >= _QUIET_STRETCH:
            stretch, self._powers = np.split(self._powers, [_QUIET_STRETCH], axis=1)
            floor, low = np.quantile(stretch, _QUIET_SHARES, axis=1)
            self._floors.append(floor)
            is_lost = floor < FAR_BELOW**2 * np.fmax.reduce(self._floors)
            is_loud = (floor > 0) & (low > _QUIET_RATIO * floor) & ~is_lost
            self._n_quiet = np.where(is_loud, 0, self._n_quiet + ~is_lost)
        return set(np.flatnonzero(self._n_quiet < _N_QUIET).tolist())


def independence(model: StoredModel, settings: PredictionSettings) -> float:
    """Return the weight of the prediction for a window, in (0, 1]: overlapping ones and votes are not independent."""
    return min(model.hop_time / settings.vote_over(model), 1.0)


def _windows(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: StoredModel,
    channels: Sequence[str],
    settings: PredictionSettings,
    source: str,
) -> Iterator[Step]:
    """Yield the predictions for windows as they complete."""
    with _named(source):
        groups = rows_of(model, channels, settings.same_beam)
        names = answering_channels(groups, channels)
        # Each has its own votes.
        looks = channels if model.n_channels == 1 else names
        times = settings.vote_over(model), model.window_time, model.hop_time
        votes = [RunningVote.over(*times, model.vote_correlation) for _ in looks]
        seen = False
        for first, windows in windows_of(blocks, sampling_rate, model.window_time, model.hop_time):
            parts = [windows] if model.n_channels > 1 else [windows[:, [row]] for row in range(len(looks))]
            predicted = [
                _predicted(part, sampling_rate, model, settings, vote) for part, vote in zip(parts, votes, strict=True)
            ]
            length, seen = windows.shape[2], True
            if settings.same_beam:
                predicted = [
                    [pooled(parts, model, settings) for parts in zip(*(predicted[row] for row in rows), strict=True)]
                    for rows in groups
                ]
            answers = [
                replace(answered[row], time=start / sampling_rate, end=(start + length) / sampling_rate, channel=name)
                for row, start in enumerate(first.tolist())
                for name, answered in zip(names, predicted, strict=True)
            ]
            yield Step(answers, answers[-1].time)
        if not seen:
            yield Step(
                [],
                0.0,
                [
                    Finding(
                        kind="silent",
                        fields={"text": f"a recording must contain a window of {model.window_time:g} s, it is shorter"},
                    )
                ],
            )


class Strategy(NamedTuple):
    """How the predictions of a recording are made."""

    steps: Callable[..., Iterator[Step]]  # as `identify_blocks`
    weight: Callable[[StoredModel, PredictionSettings], float]  # of one prediction among dependent ones, in (0, 1]


#: What one prediction is of (`StoredModel.subject`) -> how it is made.
STRATEGIES: Mapping[str, Strategy] = {
    "impact": Strategy(_impacts, lambda model, settings: 1.0),
    "window": Strategy(_windows, independence),
}


def _predicted(
    windows: NDArray[np.floating],
    sampling_rate: float,
    model: StoredModel,
    settings: PredictionSettings,
    vote: RunningVote,
) -> list[Answer]:
    """Return one prediction for each window (n_windows, n_channels, n_samples); unmeasurable windows have no vote."""
    n_windows, n_channels, _ = windows.shape
    table = measure_windows(windows, sampling_rate, model.measured).reshape(n_windows, n_channels, -1)
    inputs = table[:, :, : len(model.features)].reshape(n_windows, -1)
    guards = table[:, :, len(model.features) :].max(axis=1)
    sound = np.asarray(np.isfinite(table).all(axis=(1, 2)))
    answers = answers_from(inputs[sound], guards[sound], model, settings, sampling_rate, vote.feed)
    silent = unmeasured("the window cannot be measured: it is silent, constant or lacks samples")
    return [next(answers) if known else silent for known in sound.tolist()]
