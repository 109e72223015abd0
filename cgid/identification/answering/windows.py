"""Answers for the windows of a recording that comes in blocks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.identification.answering.drifts import Drifts
from cgid.identification.answering.question import Question, Step
from cgid.identification.answers import Answer, Decision, answers_from, unmeasured
from cgid.identification.model import Model
from cgid.identification.windows import VOTE_TIME, RunningVote, measure_windows, windows_of
from cgid.measure.filters import Equalisation


def answering_channels(model: Model, channels: Sequence[str]) -> tuple[str, ...]:
    """Return the names under which a model answers: that of each channel, or one for all that it looks at together.

    Raises
    ------
    BadData
        The model looks at another number of channels.
    """
    if model.n_channels == 1:
        return tuple(channels)
    if model.n_channels != len(channels):
        raise BadData(
            f"channels must be {model.n_channels}, which this model looks at together, got {len(channels)}; pick them "
            "with --channel"
        )
    return ("+".join(channels),)


def independence(model: Model, vote_time: float = VOTE_TIME) -> float:
    """Return what one answer counts beside others, in (0, 1]: windows that overlap, and votes, tell things again."""
    if model.kind != "window":
        return 1.0
    return min(model.hop_time / max(model.window_time, vote_time), 1.0)


def windows_answered(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
    source: str,
) -> Iterator[Step]:
    """Yield the answers for windows as they are complete; as `cgid.identification.answering.stream.identify_blocks`."""
    names = answering_channels(model, channels)
    votes = [_vote(model, question) for _ in names]
    sensors = question.heard_by(model, names)
    equalisations = [None if sensor is None else model.equalisation(sensor) for sensor in sensors]
    drifts, seen = Drifts(model, sensors, sampling_rate), False
    for first, windows in windows_of(blocks, sampling_rate, model.window_time, model.hop_time):
        parts = [windows] if model.n_channels > 1 else [windows[:, [row]] for row in range(len(names))]
        told = [
            _judged(part, sampling_rate, model, question.decision, vote, equalisation)
            for part, vote, equalisation in zip(parts, votes, equalisations, strict=True)
        ]
        for number, part in enumerate(parts):
            drifts.see(number, part)
        length, seen = windows.shape[2], True
        answers = [
            replace(answered[row], time=start / sampling_rate, end=(start + length) / sampling_rate, channel=name)
            for row, start in enumerate(first.tolist())
            for name, answered in zip(names, told, strict=True)
        ]
        yield Step(answers, answers[-1].time)
    if not seen:
        yield Step([], 0.0, (f"{source}: a recording must last a window of {model.window_time:g} s, it is shorter",))
    yield Step([], 0.0, warnings=tuple(f"{source}: {warning}" for warning in drifts.warnings()))


def _vote(model: Model, question: Question) -> RunningVote:
    return RunningVote.over(max(question.vote_time, model.window_time), model.window_time, model.hop_time)


def _judged(
    windows: NDArray[np.floating],
    sampling_rate: float,
    model: Model,
    decision: Decision,
    vote: RunningVote,
    equalisation: Sequence[Equalisation] | None,
) -> list[Answer]:
    """Return one answer for each window (n_windows, n_channels, n_samples); what cannot be measured has no vote."""
    n_windows, n_channels, _ = windows.shape
    table = measure_windows(windows, sampling_rate, model.measured, equalisation).reshape(n_windows, n_channels, -1)
    inputs = table[:, :, : len(model.features)].reshape(n_windows, -1)
    guards = table[:, :, len(model.features) :].max(axis=1)
    sound = np.asarray(np.isfinite(table).all(axis=(1, 2)))
    answers: Iterator[Answer] = iter(())
    if sound.any():
        probabilities = vote.feed(model.probabilities(inputs[sound]))
        novelties = model.novelty(inputs[sound], guards[sound])
        answers = answers_from(probabilities, novelties, model, decision, sampling_rate)
    silent = unmeasured("the window cannot be measured: it is silent, constant or not a number")
    return [next(answers) if known else silent for known in sound.tolist()]
