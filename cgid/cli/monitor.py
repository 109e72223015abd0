"""`cgid monitor`: a live stream, its impacts and gangue fraction as they arrive, and when to shut the window."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import click

from cgid.cli.answer_rows import AnswerLines
from cgid.cli.answering import Models, model_option, settings_of, settings_with_coal
from cgid.cli.help import Command
from cgid.cli.options import PATH, json_option
from cgid.cli.output import lines_taken, say, warn
from cgid.cli.reading import CHAIN, ReadingOptions, beam_words, given_options, reading_options_for
from cgid.cli.table import TableOutput
from cgid.cli.watching import coal_option, plant_options
from cgid.errors import InvalidValue, NoInput

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import PredictionSettings
    from cgid.identification.prediction.pasts import Pasts
    from cgid.identification.training.manifest import Manifest
    from cgid.plant import PlantOutputs


class UnbufferedInput:
    """A file descriptor as a binary file without a buffer; a thread that waits in it can be abandoned."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def read(self, size: int) -> bytes:
        """Return this many bytes, fewer only at the end."""
        parts, left = [], size
        while left and (part := os.read(self._descriptor, left)):
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def read1(self, size: int) -> bytes:
        """Return the available bytes, at most this many; none at the end."""
        return os.read(self._descriptor, size)


@click.command(
    cls=Command,
    short_help="Identify impacts in a live stream, and report when to shut the window.",
    example="python -c \"import numpy; numpy.loadtxt('datasets/sample.csv', 'f4', skiprows=2).tofile('sample.f32')\"\n"
    "cgid monitor sample.f32 --rate 200000 --channels 1 --sample-format f32le --unit N",
)
@click.argument("stream", type=PATH, default="-")
@click.option("--rate", "sampling_rate", type=float, help="Rate [Hz] of raw numbers, or the true one of a WAV.")
@click.option("--channels", "n_channels", type=int, help="Number of channels of raw numbers.")
@click.option("--sample-format", help="Format of raw numbers: u8, s16le, s24le, s32le, f32le, ...; be: big-endian.")
@click.option("--unit", help="Unit of the numbers; integers are scaled to -1 to 1.")
@reading_options_for("same_beam", *CHAIN)
@model_option
@coal_option
@click.option("--renew", is_flag=True, help="Let the next impacts replace what each channel is compared with.")
@json_option
@plant_options
def monitor(
    stream: str,
    sampling_rate: float | None,
    n_channels: int | None,
    sample_format: str | None,
    unit: str | None,
    reading: ReadingOptions,
    model_path: str | None,
    coal_until: float | None,
    renew: bool,
    as_json: bool,
    outputs: dict[str, str],
) -> None:
    """Identify the impacts in STREAM as they arrive: raw numbers or WAV; - is stdin.

    Plant outputs (extra `plant`) send the lines to brokers, PLCs, commands and web pages, without delay.

    Stdout is one CSV table, one row per impact. Everything else goes to stderr: each channel is a support with its own
    gangue fraction, printed ten times per window and once in a pause. SHUT is printed when going on is expected to lose
    more than shutting and the interval is above the limit, or has been so for a window; OPEN when staying shut is and
    the interval is below it; costs are keys of a site file. Nothing is dropped: if predictions are slower than the
    stream, a warning reports the delay.
    """
    from cgid.identification.prediction.pasts import Pasts
    from cgid.identification.prediction.support import STEPS
    from cgid.identification.training.manifest import read_manifest
    from cgid.recordings.chain import Chain
    from cgid.recordings.live import live_stream

    site = reading.site
    models, settings = settings_of(reading, model_path, coal_until=coal_until, batch=1, same_beam=reading.same_beam)
    settings = replace(settings, share_step=settings.shares.window / STEPS)
    clock, cycle_by, labelled = bool(site.get("clock")), site.get("cycle_by"), site.get("labelled")
    if site.given.get("clock") and not as_json:
        raise click.UsageError("clock is for lines of JSON; give --json, too")
    stated = Chain.of(**reading.chain)
    _require_cycles(cycle_by, stream, settings, outputs)
    table_of_coal = None if labelled is None else read_manifest(labelled)
    with _plant_outputs(outputs) as listener, _opened(stream) as file, _stdout_beside(listener):
        source = "stdin" if stream == "-" else stream
        live = live_stream(
            file,
            sampling_rate=sampling_rate,
            n_channels=n_channels,
            sample_format=sample_format,
            unit=unit,
            source=source,
            chain=stated,
            site=site,
        )
        settings = replace(settings, same_beam=settings.same_beam or live.beams)
        with TableOutput() as table:
            lines = AnswerLines(as_json, table, live=True, clock=clock)
            pasts = partial(Pasts.of_site, site, sampling_rate=live.sampling_rate, renew=renew)
            _follow(live, models, settings, lines, pasts, listener, cycle_by, table_of_coal)


def _require_cycles(by: str | None, stream: str, settings: PredictionSettings, outputs: dict[str, str]) -> None:
    """Raise `UsageError` unless what begins cycles is there, and they begin with coal."""
    if by is not None and settings.coal_until is None:
        raise click.UsageError("cycle_by needs the coal of each cycle; give --coal-until, too")
    if by == "stdin" and stream == "-":
        raise click.UsageError("cycle_by stdin needs stdin, which is the stream; name a file or pipe as STREAM")
    if by == "mqtt" and "mqtt" not in outputs:
        raise click.UsageError("cycle_by mqtt needs a broker; give --mqtt, too")
    if by not in (None, "stdin", "mqtt"):
        raise InvalidValue(f"cycle_by must be stdin or mqtt, got {by}")


@contextmanager
def _stdout_beside(outputs: PlantOutputs | None) -> Iterator[None]:
    """Let stdout hold up no other output, if there are any."""
    descriptor = None
    with suppress(OSError, ValueError):  # of a program that runs this command in itself
        descriptor = sys.stdout.fileno()
    if outputs is None or descriptor is None:
        yield
        return
    from cgid.plant.output import Stdout

    sys.stdout.flush()
    stdout = Stdout(descriptor, warn)
    outputs.plant.outputs.append(stdout)
    stdout.start()
    try:
        with lines_taken(stdout.put):
            yield
    finally:
        stdout.request_end()
        stdout.wait(0.0)


def _plant_outputs(given: dict[str, str]) -> AbstractContextManager[PlantOutputs | None]:
    """Return the outputs that were requested; without any, nothing of them is imported."""
    if not given:
        return nullcontext()
    from cgid.plant import PlantOutputs

    return PlantOutputs(**given, warn=warn)


def _follow(
    live: Any,
    models: Models,
    settings: PredictionSettings,
    lines: AnswerLines,
    pasts: Callable[[StoredModel], Pasts],
    outputs: PlantOutputs | None = None,
    cycle_by: str | None = None,
    labelled: Manifest | None = None,
) -> None:
    """Print the predictions for a stream until it ends or is interrupted."""
    from cgid.cli.hints import NextSteps
    from cgid.identification.prediction.findings import Finding
    from cgid.identification.prediction.pipeline import Pipeline
    from cgid.identification.prediction.records import RecordingRows
    from cgid.recordings.live import Inbox

    def warned(text: str) -> None:
        lines.finding(live.source, Finding(kind="reading", fields={"text": text}))

    model = models.of(live.channels[0].quantity)
    names = [channel.name for channel in live.channels]
    if labelled is not None:
        settings = settings_with_coal(settings, labelled, live.source, live.channels, model)
    inbox = Inbox(live.sampling_rate)
    # A stream is over when the next command runs: that is for a recording of it.
    file = live.source if live.is_wav and Path(live.source).is_file() else "RECORDING"
    beams = beam_words(map("+".join, settings.same_beam))
    rate = live.sampling_rate
    pipeline = Pipeline(model, live.channels, rate, settings, live.source, live=True, pasts=pasts(model))
    steps = NextSteps(pipeline.diagnosis, rate, file, given_options()[0], beams, channels=names)
    rows = RecordingRows(pipeline, lines, steps.of)
    inbox.on_pause = settings.blinded_after, rows.stopped
    if outputs is not None:
        rows.attach(outputs, inbox)

    def begun(name: str) -> None:
        assert pipeline.watch is not None
        name, time = name.strip(), pipeline.duration
        try:
            pipeline.watch.begin_cycle(time, name)
        except InvalidValue as error:
            warned(str(error))
        else:
            say(f"{live.source}: a caving cycle of {name or 'all supports'} begins at {time:.6g} s", err=True)

    if cycle_by == "mqtt" and outputs is not None:
        outputs.listen(begun)
    elif cycle_by == "stdin" and sys.stdin is not None:
        Thread(target=_each_line, args=(sys.stdin.fileno(), begun), daemon=True).start()
    inbox.read(live)
    try:
        for _ in rows.steps(inbox):
            pass
    finally:
        for warning in live.warnings:
            warned(warning)
        if inbox.n_taken:
            rows.finish()
    pipeline.require()


def _each_line(descriptor: int, take: Callable[[str], object]) -> None:
    """Call a function with each line, whole or at the end, as it arrives."""
    rest = b""
    while part := os.read(descriptor, 1 << 12):
        *whole, rest = (rest + part).split(b"\n")
        for line in whole:
            take(line.decode(errors="replace"))
    if rest:
        take(rest.decode(errors="replace"))


@contextmanager
def _opened(stream: str) -> Iterator[Any]:
    """Open a stream whose data is available at once."""
    if stream == "-" and sys.stdin is None:
        raise NoInput("stdin: the standard input must be open, it is closed; pipe a stream in, or name one")
    with ExitStack() as stack:
        try:
            # A closed standard input has no descriptor.
            file = sys.stdin if stream == "-" else stack.enter_context(Path(stream).open("rb", buffering=0))
            opened = UnbufferedInput(file.fileno())
        except (OSError, ValueError, AttributeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise NoInput(f"{stream}: the stream cannot be opened ({reason}); check the name") from None
        yield opened
