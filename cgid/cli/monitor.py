"""`cgid monitor`: a live stream, its impacts and gangue share as they come, and when to shut the window."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click

from cgid.cli.answer_lines import AnswerLines
from cgid.cli.asked import Asked, answering_options, asked_of
from cgid.cli.inbox import Inbox, UnbufferedInput
from cgid.cli.model_choice import warn_of_rate
from cgid.cli.options import PATH, dead_time_in_seconds
from cgid.cli.telling import Telling

#: Shares are told so many times within their window.
_STEPS = 10
#: Whoever is less far behind than this keeps up [s].
_BEHIND = 1.0


@click.command(short_help="Identify impacts in a live stream, and say when to shut the window.")
@click.argument("stream", type=PATH, default="-")
@click.option("--rate", "sampling_rate", type=float, help="Sampling rate [Hz] of raw numbers.")
@click.option("--channels", "n_channels", type=int, help="Number of channels of raw numbers.")
@click.option("--sample-format", help="How raw numbers are written: u8, s16le, s24le, s32le, f32le, ..., or be.")
@click.option("--unit", help="What the numbers are in: floats as they are, integers between -1 and 1.")
@click.option(
    "--full-scale", type=float, help="What 1 stands for, in --unit: 490 where integers reach up to 490 m/s^2."
)
@click.option("--invert", is_flag=True, help="Turn the signal over: impacts must point upwards.")
@answering_options
@click.option("--dead-time", type=float, help="Ringing after a blow [ms]; 2 for pulses, 5 for vibrations.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
def monitor(
    stream: str,
    sampling_rate: float | None,
    n_channels: int | None,
    sample_format: str | None,
    unit: str | None,
    full_scale: float | None,
    as_json: bool,
    dead_time: float | None,
    **options: Any,
) -> None:
    """Identify the impacts in STREAM as they come: raw numbers or WAV; - is stdin.

    Each channel is a support with a gangue share of its own, told ten times within its window, and once in a pause. A
    line SHUT says that going on begins to cost more than it brings: drawn gangue (--gangue-cost) against lost coal (1);
    OPEN, that it pays again. Nothing is dropped: whoever is slower than the stream says how far behind.
    """
    from cgid import validation
    from cgid.recordings.live import live_stream

    asked, _ = asked_of(options, dead_time_in_seconds(dead_time), steps=_STEPS)
    scale = 1.0 if full_scale is None else float(validation.positive("--full-scale", full_scale, unit or ""))
    with _opened(stream) as file:
        source = "stdin" if stream == "-" else stream
        live = live_stream(
            file,
            sampling_rate=sampling_rate,
            n_channels=n_channels,
            sample_format=sample_format,
            unit=unit,
            source=source,
        )
        _follow(live, scale, asked, AnswerLines(as_json))


def _follow(live: Any, scale: float, asked: Asked, lines: AnswerLines) -> None:
    """Print what a stream holds until it ends or is interrupted."""
    from cgid.identification.answering.stream import factor_of, identify_blocks, scaled
    from cgid.units import quantity_of

    model = asked.models.of(None if live.unit is None else quantity_of(live.unit))
    factor = factor_of(model, live.unit, live.source, mass=asked.mass) * (-scale if asked.invert else scale)
    names = [str(number) for number in range(1, live.n_channels + 1)]
    inbox, delay = Inbox(live, live.sampling_rate), _Delay(live.source, lines)
    blocks, question = scaled(inbox, [factor] * live.n_channels), asked.question(batch=1, whole=0)
    steps = identify_blocks(blocks, live.sampling_rate, model, names, question, live.source)
    asked.warn_of_sensor(live.source, model)
    telling = Telling(live.source, model, names, live.sampling_rate, asked, lines, always=True)
    warn_of_rate(live.source, live.sampling_rate, model)
    silent: tuple[str, ...] = ()
    try:
        for step in steps:
            silent += step.silent
            telling.feed(step.answers, step.until)
            delay.see(inbox)
            for warning in step.warnings:
                lines.warning(live.source, warning)
    finally:
        for warning in live.warnings:
            lines.warning(live.source, f"{live.source}: {warning}")
        if inbox.n_taken:
            telling.finish(inbox.n_taken / live.sampling_rate, silent)


class _Delay:
    """Says how far the answers are behind the stream when it gets worse, and when it is over."""

    def __init__(self, source: str, lines: AnswerLines) -> None:
        self._source, self._lines = source, lines
        self._said = 0.0
        self._held_up = False

    def see(self, inbox: Inbox) -> None:
        """Look at what waits, and say so if that is news."""
        behind = inbox.behind
        if behind >= max(_BEHIND, 2 * self._said):
            self._said = behind
            self._lines.delay(self._source, behind, "answers come later than the stream; nothing is dropped")
        elif self._said and behind < _BEHIND / 2:
            self._said = 0.0
            self._lines.delay(self._source, behind, "the answers have caught up with the stream")
        if inbox.held_up and behind and not self._held_up:
            self._held_up = True
            self._lines.delay(self._source, behind, "no more fits into memory: whatever writes the stream has to wait")


@contextmanager
def _opened(stream: str) -> Iterator[Any]:
    """Open a stream so that what has come is there at once."""
    from cgid.errors import NoInput

    if stream == "-" and sys.stdin is None:
        raise NoInput("stdin: the standard input must be open, it is closed; pipe a stream in, or name one")
    with ExitStack() as stack:
        try:
            # A standard input that is closed has no descriptor.
            file = sys.stdin if stream == "-" else stack.enter_context(Path(stream).open("rb", buffering=0))
            opened = UnbufferedInput(file.fileno())
        except (OSError, ValueError, AttributeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise NoInput(f"{stream}: the stream cannot be opened ({reason}); check the name") from None
        yield opened
