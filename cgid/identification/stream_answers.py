"""Answers for a recording that comes in blocks: impacts or windows, many at once, in the order of time.

Memory holds what the detector holds and one batch of impacts, however long the recording is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.identification.answers import Answer, Decision, answers_from, identify_frames, suited, unmeasured
from cgid.identification.detection import Event, ImpactDetector
from cgid.identification.model import Model
from cgid.identification.windows import VOTE_TIME, RunningVote, measure_windows, windows_of
from cgid.recordings import Channel, RecordingFile
from cgid.signals import Signal

#: So many impacts are identified at once: a batch costs little more than a single one.
BATCH = 256


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
    batch : int
        Impacts wait until they are so many; with 1 none waits.
    """

    decision: Decision = Decision()
    drop_height: float | None = None
    dead_time: float | None = None
    vote_time: float = VOTE_TIME
    batch: int = BATCH


def identify_recording(
    recording: RecordingFile,
    model: Model,
    question: Question | None = None,
    *,
    mass: float | None = None,
    invert: bool = False,
) -> Iterator[Answer]:
    """Return an iterator over the answers for a recording, in order of time; it is read block by block.

    Parameters
    ----------
    recording : RecordingFile
        As `cgid.recordings.open_recording` gives it; all of its channels in the model's quantity.
    model : Model
    question : Question, optional
    mass : float, optional
        Of the accelerated striker [kg]; turns an acceleration into a force.
    invert : bool
        Whether pulses point downwards.

    Raises
    ------
    BadData
        The recording is damaged, or of another quantity than the model.
    MissingOption
        The unit of a channel or the drop height is needed and nobody said it.
    """
    factors = [factor_for(recording, channel, model, mass) * (-1.0 if invert else 1.0) for channel in recording.channels]
    blocks = scaled(recording.blocks(), factors)
    names = [channel.name for channel in recording.channels]
    for answers, _ in identify_blocks(blocks, recording.sampling_rate, model, names, question or Question()):
        yield from answers


def factor_for(recording: RecordingFile, channel: Channel, model: Model, mass: float | None = None) -> float:
    """Return what the samples of a channel are multiplied by to be in the model's quantity and unit.

    Raises
    ------
    MissingOption, BadData, InvalidValue
        See `suited`.
    """
    one = Signal(
        samples=np.ones(1),
        sampling_rate=recording.sampling_rate,
        unit=channel.unit,
        source=recording.source,
        channel=channel.name,
    )
    return float(suited(one, model, mass).samples[0])


def scaled(blocks: Iterable[NDArray[Any]], factors: Sequence[float]) -> Iterator[NDArray[Any]]:
    """Return an iterator over blocks (n_channels, n_samples) whose channels are multiplied by factors."""
    if all(factor == 1.0 for factor in factors):
        yield from blocks
        return
    column = np.array(factors)[:, np.newaxis]
    for block in blocks:
        yield block * column.astype(block.dtype)


def identify_blocks(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
) -> Iterator[tuple[list[Answer], float]]:
    """Return an iterator over answers as they come: some of them, and the time until which all have come [s].

    Parameters
    ----------
    blocks : iterable of ndarray, (n_channels, n_samples)
        In the unit of the model.
    sampling_rate : float
        [Hz].
    model : Model
    channels : sequence of str
        Names of the channels.
    question : Question

    Raises
    ------
    BadData
        A model of windows looks at several channels together, and there are others.
    """
    if model.kind == "window":
        return _windows_answered(blocks, sampling_rate, model, channels, question)
    return _impacts_answered(blocks, sampling_rate, model, channels, question)
