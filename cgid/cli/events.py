"""`cgid events`: find the impacts in recordings and write a manifest with a row for each; `cgid train --template`."""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Iterator, Sequence
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import (
    OUTPUT,
    PATH,
    ReadingOptions,
    overwrite_option,
    reading_options,
    require_no_input_written,
    same_beam_option,
    strict_option,
)
from cgid.cli.output import FileErrors, say, say_error, warn
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption

if TYPE_CHECKING:
    from cgid.identification.detection import Event
    from cgid.measure.features.table import ImpactKind
    from cgid.recordings import RecordingFile

#: Channels of each beam, by name or number.
Groups = tuple[tuple[str, ...], ...]
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
@same_beam_option
@reading_options
def events(
    files: tuple[str, ...],
    output: str,
    overwrite: bool,
    strict: bool,
    same_beam: tuple[str, ...],
    reading: ReadingOptions,
) -> int:
    """Find the impacts in FILEs, or in the recordings of a folder, and write one row for each.

    Fill in the column label (and group, such as a day or a support, if several recordings share one), then train on the
    table: cgid train events.csv -o mine.npz. Rows that you leave empty do not train; a row with start_s, end_s and
    label alone labels all that lies in its time. An impact measured by several channels is one row. With --same-beam,
    each beam and each other channel has rows of its own.
    """
    from cgid._lib.files import check_new, write_whole
    from cgid.identification.prediction.settings import require_groups
    from cgid.identification.training.manifest import manifest_text, recordings_of, require_labels_kept

    beams = require_groups(same_beam)
    path = None if output == "-" else check_new(Path(output), "a table of impacts", (".csv",), overwrite=overwrite)
    folder = Path() if path is None else path.parent
    rows: list[dict[str, str]] = []
    # A recording named twice, such as by its folder, has its impacts once.
    every = list({os.path.realpath(file): file for file in reversed(recordings_of(files))}.values())[::-1]
    require_no_input_written(every)
    if path is not None:
        require_labels_kept(path)
    reading.require_files(every)
    rates = _require_trainable(every, reading, beams)
    errors = FileErrors(strict=strict)
    for file in errors.each(every):
        with errors:
            rows += _rows(file, folder, reading, beams, rates)
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


def _require_trainable(files: Sequence[str], reading: ReadingOptions, beams: Groups) -> set[float]:
    """Return the sampling rates [Hz] of the recordings; raise an error if no model could be trained on them."""
    from cgid.identification.training.recordings import measurable, require_alike, unit_of
    from cgid.measure.features.extraction import kind_for
    from cgid.units import quantity_of

    first: RecordingFile | None = None
    rates: set[float] = set()
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
        rates.add(recording.sampling_rate)
        require_alike(recording, first, counts=not beams)
        if reading.channel and len(recording.channels) > 1 and not beams:
            raise InvalidValue(
                f"{recording.source}: --channel must name one channel, got {'+'.join(reading.channel)}; single impacts "
                "use one channel: name one, give --same-beam if they are on one beam, or leave it out to train on a "
                "row of each"
            )
    if first is not None:
        measurable([], kind_for(quantity_of(unit_of(first))), sorted(rates))
    return rates


def _rows(
    file: str, folder: Path, reading: ReadingOptions, beams: Groups, rates: Collection[float]
) -> Iterator[dict[str, str]]:
    """Yield a row for each impact of a recording; the columns are those of a manifest and informative ones."""
    import numpy as np

    from cgid.identification.detection import Event
    from cgid.identification.prediction.same_beam import RockAssigner, grouped
    from cgid.identification.training.manifest import path_from
    from cgid.identification.training.recordings import measurable, unit_of
    from cgid.measure.features.extraction import kind_for
    from cgid.units import quantity_of

    if file == "-":
        raise InvalidValue("stdin: a table of impacts must name files, a stream has no name; save it first")
    recording = reading.recording(file)
    unit = unit_of(recording)
    named = recording.named(beams, "--same-beam")
    kind = kind_for(quantity_of(unit))
    found = found_impacts(recording, kind, reading, joint=not beams)
    events = list(compress(found, measurable(found, kind, sorted(rates))))
    if not events and len(recording.channels) > 1:  # one bad channel is enough, and train can leave it out
        warn(
            f"{recording.source}: no impact can be measured on all channels together; name a sound one by --channel, "
            "or in the column channel"
        )
        events = found
    if not events:
        raise BadData(
            f"{recording.source}: impacts must be long and clear enough to be measured at {recording.sampling_rate:g} "
            f"Hz, none of {len(found)} is; record faster, or closer to the impact"
        )
    if lost := len(found) - len(events):
        warn(f"{recording.source}: {lost} of {counted(len(found), 'impact')} cannot be measured and are left out")
    names = [channel.name for channel in recording.channels]
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
    if not beams:
        yield from ({**given, **row} for row in _intervals([[event] for event in events], unit))
        return
    groups = grouped(names, named)
    rocks = RockAssigner[Event](groups, recording.sampling_rate).feed(events, np.inf)
    cells = []
    for rows in groups:
        channel = "+".join(names[row] for row in rows)
        given |= {"channel": channel, "same_beam": channel if len(rows) > 1 else ""}
        cells += [given | row for row in _intervals([rock for rock in rocks if rock[0].channel in rows], unit)]
    yield from sorted(cells, key=lambda row: float(row["time_s"]))


def _intervals(rocks: Sequence[Sequence[Event]], unit: str) -> Iterator[dict[str, str]]:
    """Yield the cells of each rock, of which every channel has an event."""
    before = 0.0
    for events, following in zip(rocks, [*rocks[1:], None], strict=True):
        time, end = events[0].time, max(event.end / event.sampling_rate for event in events)
        start = max(time - _BEFORE, (before + time) / 2 if before else 0.0)
        if following is not None:
            end = min(end, max(following[0].time - _BEFORE, (time + following[0].time) / 2))
        before = time
        yield {
            "start": f"{start:.7f}",
            "end": f"{end:.7f}",
            "label": "",
            "time_s": f"{time:.6f}",
            "peak": f"{max(map(_peak, events)):.5g}",
            "peak_unit": unit,
            "flags": " ".join(
                name for name in ("overlapping", "clipped", "cut") if any(getattr(event, name) for event in events)
            ),
        }


def found_impacts(
    recording: RecordingFile, kind: ImpactKind, reading: ReadingOptions, factor: float = 1.0, *, joint: bool = False
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


def write_template(data: tuple[str, ...], path: Path, reading: ReadingOptions, *, overwrite: bool) -> int:
    """Write a manifest with a row for each recording, with a label if its folder is one."""
    from cgid._lib.files import check_new, write_whole
    from cgid.identification.training.manifest import (
        manifest_text,
        path_from,
        recordings_in,
        require_labels_kept,
        row_of,
    )

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


def _content(file: Path, reading: ReadingOptions) -> tuple[str, int]:
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
