"""`cgid plot`: a picture of a recording and its impacts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid._lib import validation
from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, json_option, overwrite_option
from cgid.cli.output import print_json, say, warn
from cgid.cli.reading import ReadingOptions, reading_options, warn_of_volts
from cgid.errors import InvalidValue

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cgid.identification.detection import Event
    from cgid.plots.recording import Mark
    from cgid.recordings import RecordingFile


@click.command(
    cls=Command,
    short_help="Plot a recording: waveform, spectrogram, spectrum and impacts.",
    example="cgid plot datasets/sample.csv -o sample.png",
)
@click.argument("file", type=PATH)
@click.option(
    "-o",
    "--output",
    type=OUTPUT,
    required=True,
    metavar="PICTURE",
    help="Write this picture, ending in .png, .svg or .pdf.",
)
@click.option("--events/--no-events", default=True, show_default=True, help="Mark the detected impacts.")
@click.option("--from", "begin", type=float, default=0.0, metavar="SECONDS", help="Plot only after this time.")
@click.option("--to", "end", type=float, metavar="SECONDS", help="Plot only before this time.")
@overwrite_option
@json_option
@reading_options()
def plot(
    file: str,
    output: str,
    events: bool,
    begin: float,
    end: float | None,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> None:
    """Plot the recording FILE: waveform, spectrogram and spectrum of each channel, and detected impacts.

    The recording may be of any length, since it is read block by block. Impacts are detected separately in each
    channel, as in cgid predict, and counted once for the channels of one beam of a site.
    """
    from cgid._lib.files import write_whole
    from cgid.identification.detection.detector import invert_hint
    from cgid.identification.detection.ear import Ear
    from cgid.measure.features.extraction import kind_for
    from cgid.measure.overview import OverviewStream
    from cgid.plots import picture
    from cgid.plots.figure import FORMATS, new_picture
    from cgid.plots.recording import MAX_CHANNELS, overview_figure

    path = new_picture(output, endings=FORMATS, overwrite=overwrite)
    _require_order(begin, end)
    recording = _opened(file, reading)
    beams = reading.beams(recording)
    warn_of_volts(recording)
    channels = recording.channels[:MAX_CHANNELS]
    if len(channels) < len(recording.channels):
        warn(
            f"{recording.source}: the first {len(channels)} of {len(recording.channels)} channels are "
            "drawn; choose with --channel"
        )
    rate, heard = recording.sampling_rate, channels if events else ()
    marks: list[Mark] = []
    stream = OverviewStream(rate, len(channels), recording.source)
    ears = [(one.name, Ear(rate, kind=kind_for(one.quantity), dead_time=reading.dead_time)) for one in heard]
    for block in _between(recording, begin, end):
        stream.feed(block[: len(channels)])
        for row, (name, ear) in enumerate(ears):
            marks += _marks(name, ear.feed(block[[row]]).events, rate, begin)
    for name, ear in ears:
        marks += _marks(name, ear.feed(None).events, rate, begin)
        if ear.is_upside_down() and all(mark.channel != name for mark in marks):
            warn(f"{recording.source} channel {name}: no impact: {invert_hint()}")
    marks.sort(key=lambda mark: mark.time)
    for warning in recording.warnings:
        warn(warning)
    overview = stream.overview()
    names = [channel.name for channel in recording.channels]
    count = _n_impacts(marks, names, beams, rate) if events else None
    facts = _facts(recording, overview.duration, count)
    figure = overview_figure(
        overview, channels, title=Path(recording.source).name, facts=facts, marks=marks, begin=begin
    )
    write_whole(path, picture(figure, path.suffix.lower()), overwrite=overwrite)
    if as_json:
        print_json(
            {
                "source": recording.source,
                "picture": str(path),
                "channels": [channel.name for channel in channels],
                "from_s": begin,
                "duration_s": overview.duration,
                "impacts": count,
                "warnings": list(recording.warnings),
            }
        )
    say(f"wrote {path}", err=True)


def _marks(channel: str, events: Iterable[Event], rate: float, begin: float) -> Iterator[Mark]:
    """Yield a mark for each impact of a channel, heard from a time on [s]."""
    from cgid.plots.recording import Mark

    for event in events:
        label = "overlapping impact" if event.overlapping else "impact"
        yield Mark(time=begin + event.onset / rate, end=begin + event.end / rate, label=label, channel=channel)


def _opened(file: str, reading: ReadingOptions) -> RecordingFile:
    """Return the recording of a file, or the chosen signal of a dataset."""
    from cgid.recordings import is_dataset

    if reading.index is None or not is_dataset(file):
        return reading.recording(file)
    reading.wants_complete_dataset(file)  # refuses what is for recordings
    from cgid.recordings import RecordingFile
    from cgid.recordings.recording import Blocks
    from cgid.store import Dataset

    signal = Dataset(file).signal(reading.index)
    contents = Blocks.of_array(signal.samples[None], units=[signal.unit], sampling_rate=signal.sampling_rate)
    return RecordingFile(contents, source=signal.source, format="dataset", sampling_rate=None, unit=None, channel=None)


def _require_order(begin: float, end: float | None) -> None:
    validation.not_negative("--from", begin, "s")
    if end is not None and not validation.real("--to", end, "s") > begin:
        raise InvalidValue(f"--to must be after --from ({begin:g} s), got {end:g} s")


def _between(recording: RecordingFile, begin: float, end: float | None) -> Iterator[NDArray[Any]]:
    """Yield the blocks of the recording between two times [s]."""
    first = round(begin * recording.sampling_rate)
    last = None if end is None else round(end * recording.sampling_rate)
    if last is not None and last <= first:
        raise InvalidValue(
            f"{recording.source}: at least one sample must be between --from and --to, got {begin:g} to {end:g} s at "
            f"{recording.sampling_rate:g} Hz; set them further apart"
        )
    passed = 0
    for block in recording.blocks_with_gaps():
        part = block[:, max(first - passed, 0) : None if last is None else max(last - passed, 0)]
        passed += block.shape[1]
        if part.shape[1]:
            yield part
        if last is not None and passed >= last:
            return
    if passed <= first:
        raise InvalidValue(
            f"{recording.source}: --from must be within the recording of {passed / recording.sampling_rate:g} s, got "
            f"{begin:g} s"
        )


def _n_impacts(
    marks: Sequence[Mark], names: list[str], same_beam: tuple[tuple[str, ...], ...], sampling_rate: float
) -> int:
    """Return the number of impacts, each counted once for the channels of one beam."""
    from cgid.identification.prediction.same_beam import Detected, RockAssigner, grouped

    rows = {name: row for row, name in enumerate(names)}
    found = [Detected(rows[str(mark.channel)], round(mark.time * sampling_rate)) for mark in marks]
    return len(RockAssigner[Detected](grouped(names, same_beam), sampling_rate).feed(found, float("inf")))


def _facts(recording: RecordingFile, duration: float, count: int | None) -> str:
    """Return the line below the title."""
    from cgid.plots.recording import hertz

    facts = [recording.format, hertz(recording.sampling_rate), f"{duration:.4g} s"]
    if recording.start_time is not None:
        facts.append(f"started {recording.start_time:%Y-%m-%d %H:%M:%S}")
    if count is not None:
        facts.append(f"{counted(count, 'impact')} found" if count else "no impacts found")
    return ", ".join(facts)
