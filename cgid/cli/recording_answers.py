"""A recording read block by block, answered by the models that its channels need."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cgid.cli.answer_lines import AnswerLines
from cgid.cli.asked import Asked
from cgid.cli.model_choice import warn_of_rate
from cgid.cli.telling import Telling
from cgid.errors import CgidError

if TYPE_CHECKING:
    from cgid.cli.report_pages import Pages


def answer_recording(recording: Any, asked: Asked, lines: AnswerLines, pages: Pages | None = None) -> None:
    """Print the answers for a recording, which is read block by block: once for each model that its channels need.

    Raises
    ------
    CgidError
        It cannot be read, is of another quantity, or nothing in it can be measured.
    """
    groups = _models_of(recording, asked)
    errors: list[CgidError] = []
    try:
        for model, rows in groups:
            try:
                _answer_channels(recording, model, rows, asked, lines, pages)
            except CgidError as error:
                errors.append(error)
    finally:
        for warning in recording.warnings:
            lines.warning(recording.source, warning)
    if len(errors) == len(groups):
        raise errors[0]
    # Channels of another quantity do not hide those that can be answered for.
    for unanswered in errors:
        lines.warning(recording.source, str(unanswered))


def _answer_channels(
    recording: Any, model: Any, rows: list[int], asked: Asked, lines: AnswerLines, pages: Pages | None
) -> None:
    """Print the answers for those channels of a recording that one model answers for."""
    from cgid.identification.answering.stream import identify_blocks, model_blocks

    names, rate, source = [recording.channels[row].name for row in rows], recording.sampling_rate, recording.source
    passing = Passing() if pages is None else pages.drawing(recording, rows)
    blocks = model_blocks(recording, model, rows, mass=asked.mass, invert=asked.invert, seen=passing.see)
    steps = identify_blocks(blocks, rate, model, names, asked.question(), source)
    asked.warn_of_sensor(source, model)
    telling = Telling(source, model, names, rate, asked, lines, keep=pages is not None)
    warn_of_rate(telling.name(telling.channels[0]), rate, model)
    silent: tuple[str, ...] = ()
    for step in steps:
        telling.feed(step.answers, step.until)
        silent += step.silent
        for warning in step.warnings:
            lines.warning(source, warning)
    telling.finish(passing.n_samples / rate, silent, recording.start_time)
    if pages is not None:
        pages.add(recording, passing, model, asked, telling)


def _models_of(recording: Any, asked: Asked) -> list[tuple[Any, list[int]]]:
    """Return the models that answer for the channels of a recording, each with the numbers of its channels."""
    found: dict[int, tuple[Any, list[int]]] = {}
    for row, channel in enumerate(recording.channels):
        model = asked.models.of(channel.quantity)
        found.setdefault(id(model), (model, []))[1].append(row)
    return list(found.values())


class Passing:
    """Counts the samples of blocks that pass by."""

    def __init__(self) -> None:
        self.n_samples = 0

    def see(self, block: Any) -> None:
        """Look at a block, (n_channels, n_samples)."""
        self.n_samples += block.shape[1]
