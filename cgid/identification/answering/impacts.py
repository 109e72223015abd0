"""Answers for the impacts of a recording that comes in blocks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.identification.answering.question import BATCH, Question, Step
from cgid.identification.answers import Answer, identify_events
from cgid.identification.detection.detector import ImpactDetector
from cgid.identification.events import Event, Extent, find_impacts
from cgid.identification.model import Model
from cgid.measure.table import ImpactKind
from cgid.signals import Signal

#: No recorder of impacts is slower [Hz]: a short file would last for years, and shares of it come every few seconds.
SLOWEST = 1.0


def impacts_answered(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
    source: str,
) -> Iterator[Step]:
    """Yield the answers for impacts: of a short recording all at once, of a longer one as they come.

    As `cgid.identification.answering.stream.identify_blocks`.
    """
    if sampling_rate < SLOWEST:
        raise InvalidValue(
            f"{source}: sampling_rate must be at least {SLOWEST:g} Hz where impacts are answered for, got "
            f"{sampling_rate:g} Hz; check it"
        )
    coming = iter(blocks)
    held: list[NDArray[Any]] = []
    size = 0
    while size <= question.whole and (block := next(coming, None)) is not None:
        held.append(block)
        size += block.size
    if held and size <= question.whole:
        samples = held[0] if len(held) == 1 else np.concatenate(held, axis=1)
        yield _whole_answered(samples, sampling_rate, model, channels, question, source)
        return
    kind = kind_found(model)
    detector = ImpactDetector(sampling_rate, len(channels), kind=kind, dead_time=question.dead_time)
    extent = Extent(len(channels))
    waiting: list[Event] = []
    heard: set[int] = set()

    def step(silent: tuple[str, ...] = ()) -> Step:
        heard.update(event.channel for event in waiting)
        answers = _events_answered(waiting, model, channels, question)
        waiting.clear()
        return Step(answers, detector.told / sampling_rate, silent)

    for block in chain(_emptied(held), coming):
        extent.see(block)
        waiting += detector.feed(block)
        if not waiting or len(waiting) >= question.batch:
            yield step()
    waiting += detector.finish()
    quiet = [channel for number, channel in enumerate(channels) if number not in heard | {e.channel for e in waiting}]
    yield step(
        tuple(
            f"{_name(source, channel, channels)}: no impact in {detector.told / sampling_rate:g} s: nothing rises "
            f"above the noise; look at it with cgid plot, or {extent.cure(list(channels).index(channel), kind)}"
            for channel in quiet
        )
    )


def _whole_answered(
    samples: NDArray[Any], sampling_rate: float, model: Model, channels: Sequence[str], question: Question, source: str
) -> Step:
    """Return the answers for a recording (n_channels, n_samples) that is in memory."""
    events: list[Event] = []
    silent = []
    for number, channel in enumerate(channels):
        signal = Signal(
            samples=samples[number],
            sampling_rate=sampling_rate,
            unit=model.unit,
            source=_name(source, channel, channels),
        )
        try:
            found = find_impacts(signal, kind=kind_found(model), dead_time=question.dead_time)
        except BadData as error:
            silent.append(str(error))
            continue
        events += [replace(event, channel=number) for event in found]
    events.sort(key=lambda event: (event.onset, event.channel))
    answers = []
    for first in range(0, len(events), BATCH):
        answers += _events_answered(events[first : first + BATCH], model, channels, question)
    return Step(answers, samples.shape[1] / sampling_rate, tuple(silent))


def kind_found(model: Model) -> ImpactKind:
    """Return what the impacts look like that a model answers for."""
    return "pulse" if model.kind == "pulse" else "vibration"


def _name(source: str, channel: str, channels: Sequence[str]) -> str:
    return source if list(channels) == ["1"] else f"{source} channel {channel}"


def _emptied(held: list[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Yield what is held, and hold it no longer."""
    while held:
        yield held.pop(0)


def _events_answered(
    events: Sequence[Event], model: Model, channels: Sequence[str], question: Question
) -> list[Answer]:
    return identify_events(
        events,
        model,
        question.decision,
        drop_height=question.drop_height,
        channels=channels,
        sensors=question.heard_by(model, channels),
    )
