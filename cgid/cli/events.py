"""`cgid events`: find the impacts in recordings and write a manifest with a row for each; `cgid train --template`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid.cli.help import Command
from cgid.cli.options import (
    OUTPUT,
    PATH,
    Reading,
    overwrite_option,
    reading_options,
    require_no_input_written,
    strict_option,
)
from cgid.cli.output import FileErrors, say, say_error, warn
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption
from cgid.terminal import counted

if TYPE_CHECKING:
    from cgid.identification.events import Event
    from cgid.measure.table import ImpactKind
    from cgid.recordings import RecordingFile

#: An interval begins this long before its impact, because channels may measure it at different times [s].
_BEFORE = 2e-3
#: Impacts are found without the channels that lack more than this fraction of their samples.
_MOST_MISSING = 0.01


@click.command(
    cls=Command,
    short_help="Find the impacts in recordings: a table to label for cgid train.",
    example="cgid events datasets/sample.csv -o events.csv",
)
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="FILE...")
@click.option(
    "-o", "--output", type=OUTPUT, required=True, help="Write this table, ending in .csv, or to stdout for -."
)
@overwrite_option
@strict_option
@reading_options
def events(files: tuple[str, ...], output: str, overwrite: bool, strict: bool, reading: Reading) -> int:
    """Find the impacts in FILEs, or in the recordings of a folder, and write one row for each.

    Fill in the column label (and group, such as a day or a support, if several recordings share one), then train on the
    table: cgid train events.csv -o mine.npz. Delete the rows that you cannot label. An impact measured by several
    channels is one row.
    """
    from cgid.files import check_new, write_whole
    from cgid.identification.manifest import manifest_text, recordings_of, require_labels_kept

    path = None if output == "-" else check_new(Path(output), "a table of impacts", (".csv",), overwrite=overwrite)
    folder = Path() if path is None else path.parent
    rows: list[dict[str, str]] = []
    every = recordings_of(files)
    require_no_input_written(every)
    if path is not None:
        require_labels_kept(path)
    reading.require_files(every)
    _require_trainable(every, reading)
    errors = FileErrors(strict=strict)
    for file in errors.each(every):
        with errors:
            rows += _rows(file, folder, reading)
    if not rows:
        return errors.code
    text = manifest_text(rows)
    if path is None:
        for line in text.removesuffix("\n").split("\n"):
            say(line)
        return errors.code
    # A byte order mark lets spreadsheets read non-ASCII letters.
    write_whole(path, text.encode("utf-8" if text.isascii() else "utf-8-sig"), overwrite=overwrite)
    train = shlex.join(["cgid", "train", str(path), "-o", "mine.npz"])
    say(f"wrote {path}: {counted(len(rows), 'impact')}; fill in the column label, then {train}", err=True)
    return errors.code


def _require_trainable(files: Sequence[str], reading: Reading) -> None:
    """Raise an error if no model could be trained on these recordings, before their impacts are labelled."""
    from cgid.identification.labelled_recordings import require_alike, unit_of

    first: RecordingFile | None = None
    for file in files:
        try:
            recording = reading.recording(file)
        except MissingOption:
            raise
        except CgidError:
            continue
        if unit_of(recording) == "FS" and reading.unit is None:
            raise MissingOption(
                f"{recording.source}: the file does not state full scale [FS]; give --full-scale '50 g', "
                "or --full-scale '10 V' and the --sensitivity of the sensor, or the unit of the numbers with --unit"
            )
        first = first or recording
        require_alike(recording, first)
        if reading.channel and len(recording.channels) > 1:
            raise InvalidValue(
                f"{recording.source}: --channel must name one channel, got {'+'.join(reading.channel)}; single impacts "
                "use one channel: name one, or leave it out to train on a row of each"
            )


def _rows(file: str, folder: Path, reading: Reading) -> Iterator[dict[str, str]]:
    """Yield a row for each impact of a recording; the columns are those of a manifest and informative ones."""
    from cgid.identification.labelled_recordings import unit_of
    from cgid.identification.manifest import path_from
    from cgid.measure.features import kind_for
    from cgid.units import quantity_of

    if file == "-":
        raise InvalidValue("stdin: a table of impacts must name files, a stream has no name; save it first")
    recording = reading.recording(file)
    unit = unit_of(recording)
    events = found_impacts(recording, kind_for(quantity_of(unit)), reading, joint=True)
    chain = {name: ";".join(values) for name, values in reading.chain_of(file).items() if values}
    given = {
        **chain,
        "path": path_from(folder, file),
        "channel": "+".join(reading.channel),
        "invert": "yes" if reading.invert else "",
        "rate": "" if reading.sampling_rate is None else f"{reading.sampling_rate:.12g}",
        "unit": reading.unit or "",
        "variable": reading.variable or "",
        "format": reading.format or "",
    }
    rate, before = recording.sampling_rate, 0.0
    for event, following in zip(events, [*events[1:], None], strict=True):
        start = max(event.time - _BEFORE, (before + event.time) / 2 if before else 0.0)
        end = event.end / rate
        if following is not None:
            end = min(end, max(following.time - _BEFORE, (event.time + following.time) / 2))
        before = event.time
        yield {
            **given,
            "start": f"{start:.7f}",
            "end": f"{end:.7f}",
            "label": "",
            "time_s": f"{event.time:.6f}",
            "peak": f"{_peak(event):.5g}",
            "peak_unit": unit,
            "flags": " ".join(name for name in ("overlapping", "clipped", "cut") if getattr(event, name)),
        }


def found_impacts(
    recording: RecordingFile, kind: ImpactKind, reading: Reading, factor: float = 1.0, *, joint: bool = False
) -> list[Event]:
    """Return the impacts of a recording, whose samples are multiplied first; raises `BadData` if there is none."""
    from cgid.identification.detection import ImpactDetector

    rows, factor = list(range(len(recording.channels))), -factor if reading.invert else factor
    while True:
        detector = ImpactDetector(
            recording.sampling_rate, len(rows), kind=kind, dead_time=reading.dead_time, joint=joint, gaps=True
        )
        gaps, events = recording.gaps(rows, joint=joint), []
        for block in gaps.marked(block[rows] for block in recording.blocks(gaps=True)):
            events += detector.feed(block * factor)
        lacking = gaps.n_samples > _MOST_MISSING * gaps.n_seen
        if not joint or not lacking.any() or lacking.all():
            break
        # A lost channel would end or cut the impacts of all others.
        names = ", ".join(recording.channels[row].name for row in compress(rows, lacking))
        warn(f"{recording.source}: channel {names} is left out, it lacks too many samples")
        rows = list(compress(rows, ~lacking))
    gaps.require(recording.source)
    events += detector.finish()
    for warning in recording.warnings:
        warn(warning)
    if not events:
        raise BadData(f"{recording.source}: {detector.why_silent(unit=recording.channels[0].unit)}")
    return events


def _peak(event: Event) -> Any:
    """Return the largest distance from the baseline, of the channel that measures the impact best."""
    import numpy as np

    frame = np.atleast_2d(event.samples)
    return max(np.abs(row - np.median(row)).max() for row in frame.astype(float))


# -- one row per recording --------------------------------------------------------------------------------


def write_template(data: tuple[str, ...], path: Path, reading: Reading, *, overwrite: bool) -> int:
    """Write a manifest with a row for each recording, with a label if its folder is one."""
    from cgid.files import check_new, write_whole
    from cgid.identification.manifest import manifest_text, path_from, recordings_in, require_labels_kept, row_of

    every = [(Path(item), recordings_in(Path(item)) if Path(item).is_dir() else [Path(item)]) for item in data]
    require_no_input_written(file for _, files in every for file in files)
    check_new(path, "a manifest", (".csv",), overwrite=overwrite)
    rows, code = [], 0
    for item, files in every:
        folder = item if item.is_dir() else item.parent
        for file in files:
            content, failed = _content(file, reading)
            code = code or failed
            given = {"rate": reading.sampling_rate, "unit": reading.unit, "content": content}
            rows.append({**row_of(file, folder), "path": path_from(path.parent, file), **given})
    require_labels_kept(path, rows)
    text = manifest_text(rows, ("group", "rate", "unit") if code else ("group",))
    write_whole(path, text.encode("utf-8" if text.isascii() else "utf-8-sig"), overwrite=overwrite)
    empty = sum(not row["label"] for row in rows)
    fill = f"fill in the label of {empty}, then " if empty else "now "
    train = shlex.join(["cgid", "train", str(path), "-o", "mine.npz"])
    say(f"wrote {path}: {counted(len(rows), 'recording')}; {fill}{train}", err=True)
    return code


def _content(file: Path, reading: Reading) -> tuple[str, int]:
    """Return a description of a recording, or why it is unreadable, and an exit code."""
    from cgid.recordings import open_recording

    try:
        recording = open_recording(file, **reading.common)
    except CgidError as error:
        say_error(error)
        return "cannot be read", error.exit_code
    n_channels, unit = len(recording.channels), recording.channels[0].unit or "unit unknown"
    length = "" if recording.duration is None else f", {recording.duration:.6g} s"
    return f"{recording.sampling_rate:g} Hz, {unit}, {counted(n_channels, 'channel')}{length}", 0
