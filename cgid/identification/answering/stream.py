"""Answers for a recording that comes in blocks: impacts or windows, many at once, in the order of time.

Memory holds what the detector holds and one batch of impacts, however long the recording is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.identification.answering.impacts import impacts_answered
from cgid.identification.answering.question import Question, Step
from cgid.identification.answering.windows import windows_answered
from cgid.identification.answers import Answer, suited
from cgid.identification.model import Model
from cgid.measure.features import FEATURES
from cgid.signals import Signal

if TYPE_CHECKING:
    from cgid.recordings import RecordingFile

#: No recorder of impacts is slower: a rate below is one in another unit, or that of something else [Hz].
SLOWEST = 10.0


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
    blocks = model_blocks(recording, model, range(len(recording.channels)), mass=mass, invert=invert)
    names = [channel.name for channel in recording.channels]
    question = question or Question()
    for step in identify_blocks(blocks, recording.sampling_rate, model, names, question, recording.source):
        yield from step.answers


def model_blocks(
    recording: RecordingFile,
    model: Model,
    rows: Sequence[int],
    *,
    mass: float | None = None,
    invert: bool = False,
    seen: Callable[[NDArray[Any]], object] | None = None,
) -> Iterator[NDArray[Any]]:
    """Return an iterator over the blocks of some channels, in the model's quantity and unit; as `identify_recording`.

    What is wrong with quantity or unit is said at once, not when the first block is asked for. `seen` is called with
    each block of these channels in their own units.
    """
    chosen, sign = list(rows), -1.0 if invert else 1.0
    channels = [recording.channels[row] for row in chosen]
    factors = [sign * factor_of(model, c.unit, recording.source, c.name, mass=mass) for c in channels]
    return scaled(_chosen_blocks(recording, chosen, seen), factors)


def _chosen_blocks(
    recording: RecordingFile, rows: list[int], seen: Callable[[NDArray[Any]], object] | None
) -> Iterator[NDArray[Any]]:
    all_of_them = rows == list(range(len(recording.channels)))
    for block in recording.blocks():
        chosen = block if all_of_them else block[rows]
        if seen is not None:
            seen(chosen)
        yield chosen


def factor_of(model: Model, unit: str | None, source: str, channel: str = "1", *, mass: float | None = None) -> float:
    """Return what samples in a unit are multiplied by to be in the model's quantity and unit; raises as `suited`."""
    one = Signal(samples=np.ones(1), sampling_rate=1.0, unit=unit, source=source, channel=channel)
    return float(suited(one, model, mass).samples[0])


def scaled(blocks: Iterable[NDArray[Any]], factors: Sequence[float]) -> Iterator[NDArray[Any]]:
    """Return an iterator over blocks (n_channels, n_samples) whose channels are multiplied by factors."""
    if all(factor == 1.0 for factor in factors):
        yield from blocks
        return
    column = np.array(factors)[:, np.newaxis]
    for block in blocks:
        with np.errstate(over="ignore"):  # what is no number then is told where impacts are looked for
            scaled_block = block * column.astype(block.dtype)
        yield scaled_block


def identify_blocks(
    blocks: Iterable[NDArray[Any]],
    sampling_rate: float,
    model: Model,
    channels: Sequence[str],
    question: Question,
    source: str = "signal",
) -> Iterator[Step]:
    """Return an iterator over answers as they come.

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
    source : str
        Name of the recording.

    Raises
    ------
    BadData
        A model of windows looks at several channels together, and there are others; or the samples are absurd.
    InvalidValue
        The recording is sampled too slowly for what the model measures, or absurdly fast.
    """
    needed = max([SLOWEST, *(2 * FEATURES[name].highest_frequency for name in model.measured)])
    if sampling_rate < needed:
        raise InvalidValue(
            f"{source}: the sampling_rate must be at least {math.ceil(needed)} Hz for this model, got "
            f"{sampling_rate:g} Hz; check it, record faster, or train a model on recordings like this one"
        )
    how = windows_answered if model.kind == "window" else impacts_answered
    return _named(how(blocks, sampling_rate, model, channels, question, source), source)


def _named(steps: Iterator[Step], source: str) -> Iterator[Step]:
    """Yield steps; say which recording it is that cannot be answered for."""
    try:
        yield from steps
    except (BadData, InvalidValue) as error:
        text = str(error)
        if text.startswith(source):
            raise
        raise type(error)(f"{source}: {text}") from None
