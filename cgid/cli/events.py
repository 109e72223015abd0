"""`cgid events`: find the impacts in recordings and write a manifest with a row for each."""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, overwrite_option, require_no_input_written
from cgid.cli.output import FileErrors, say, warn
from cgid.cli.reading import CHAIN, ReadingOptions, reading_options
from cgid.errors import CgidError, InvalidValue, MissingOption
from cgid.units import quantity_of

if TYPE_CHECKING:
    from cgid.recordings import RecordingFile


@click.command(
    cls=Command,
    short_help="Find the impacts in recordings: a table to label for cgid train.",
    example="cgid events datasets/sample.csv -o events.csv",
)
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="FILE...")
@click.option(
    "-o", "--output", type=OUTPUT, required=True, help="Write this table, ending in .csv, or to stdout for -."
)
@click.option(
    "--audacity",
    type=OUTPUT,
    metavar="TRACK.txt",
    help="Fill in the labels of this label track of Audacity; if it does not exist, write one to label there.",
)
@overwrite_option
@reading_options(*CHAIN, "same_beam")
def events(
    files: tuple[str, ...],
    output: str,
    audacity: str | None,
    overwrite: bool,
    reading: ReadingOptions,
) -> int:
    """Find the impacts in FILEs, or in the recordings of a folder, and write one row for each.

    Fill in the column label (and group, such as a day or a support, if several recordings share one), then train on the
    table: cgid train events.csv -o mine.npz. Rows that you leave empty do not train; a row with start_s, end_s and
    label alone labels all that lies in its time. An impact measured by several channels is one row. With --same-beam,
    each beam and each other channel has rows of its own.
    """
    from cgid._lib.files import check_new, write_whole
    from cgid.identification.training.audacity import fill_in, read_track
    from cgid.identification.training.manifest import manifest_text, recordings_of, require_labels_kept

    beams = reading.has_beams
    path = None if output == "-" else check_new(Path(output), "a table of impacts", (".csv",), overwrite=overwrite)
    folder = Path() if path is None else path.parent
    rows: list[dict[str, str]] = []
    # A recording named twice, such as by its folder, has its impacts once.
    every = list({os.path.realpath(file): file for file in reversed(recordings_of(files))}.values())[::-1]
    require_no_input_written(every)
    if path is not None:
        require_labels_kept(path)
    reading.require_files(every)
    if audacity is not None and (len(every) > 1 or beams):
        raise InvalidValue(
            f"--audacity {audacity}: a label track must be of one recording without --same-beam, got "
            f"{counted(len(every), 'recording')}; give each its own"
        )
    marks = None if audacity is None or not Path(audacity).exists() else read_track(Path(audacity))
    rates = require_trainable(every, reading, beams)
    errors, n_read = FileErrors(), 0
    for file in errors.each(every):
        with errors:
            if file == "-":
                raise InvalidValue("stdin: a table of impacts must name files, a stream has no name; save it first")
            recording = reading.recording(file)
            found = list(_rows(recording, cells_of(file, folder, reading), reading, beams, rates))
            fill_in(found, recording.labels(), "column")
            rows += found
            n_read += 1
    if not rows:
        return errors.code
    if audacity is not None:
        _exchange(rows, Path(audacity), marks)
    text = manifest_text(rows)
    if path is None:
        for line in text.removesuffix("\n").split("\n"):
            say(line)
        return errors.code
    # A byte order mark lets spreadsheets read non-ASCII letters.
    write_whole(path, text.encode("utf-8" if text.isascii() else "utf-8-sig"), overwrite=overwrite)
    train = shlex.join(["cgid", "train", str(path), "-o", "mine.npz"])
    of = "" if n_read == len(every) else f" of {n_read} of {len(every)} recordings, without those that failed"
    say(f"wrote {path}: {counted(len(rows), 'impact')}{of}; fill in the column label, then {train}", err=True)
    return errors.code


def _exchange(rows: list[dict[str, str]], track: Path, marks: list[tuple[float, float, str]] | None) -> None:
    """Fill in the labels of a track of Audacity, or write one."""
    from cgid._lib.files import write_whole
    from cgid.identification.training.audacity import fill_in, track_text

    if marks is None:
        write_whole(track, track_text(rows).encode(), overwrite=False)
        say(f"wrote {track}: label its {counted(len(rows), 'mark')} in Audacity, then run this again", err=True)
        return
    n, lost = fill_in(rows, marks)
    say(f"cgid: {track} labels {n} of {counted(len(rows), 'impact')}", err=True)
    if lost:
        warn(f"{track}: {counted(lost, 'mark')} with a label at no impact")


def require_trainable(files: Sequence[str], reading: ReadingOptions, beams: bool) -> set[float]:
    """Return the sampling rates [Hz] of the recordings; raise an error if no model could be trained on them."""
    from cgid.identification.training.recordings import measurable, require_alike, unit_of
    from cgid.measure.features.extraction import kind_for

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
                f"{recording.source}: the file does not state full scale [FS]; give --set full_scale='50 g', "
                "or --set full_scale='10 V' and the sensitivity of the sensor, or the unit of the numbers with --unit"
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


def cells_of(file: str, folder: Path, reading: ReadingOptions) -> dict[str, str]:
    """Return the cells that every row of a recording has in a table in a folder."""
    from cgid.identification.training.manifest import path_from

    given = reading.site.given
    chain = {name: ";".join(values) for name, values in reading.chain_of(file).items() if values}
    return {
        **chain,
        "path": path_from(folder, file),
        "channel": "+".join(reading.channel),
        "invert": "yes" if given.get("invert") else "",
        "site": path_from(folder, reading.site.path) if reading.site.path else "",
        "rate": "" if reading.sampling_rate is None else f"{reading.sampling_rate:.12g}",
        "unit": reading.unit or "",
        **{name: str(given.get(name, "")) for name in ("gain", "variable", "format")},
    }


def _rows(
    recording: RecordingFile, given: dict[str, str], reading: ReadingOptions, beams: bool, rates: Collection[float]
) -> Iterator[dict[str, str]]:
    """Yield a row for each impact of a recording; the columns are those of a manifest and informative ones."""
    from cgid.identification.detection import Event
    from cgid.identification.prediction.same_beam import RockAssigner, grouped
    from cgid.identification.training.impact_table import interval_rows, measured_impacts
    from cgid.identification.training.recordings import unit_of
    from cgid.measure.features.extraction import kind_for

    unit = unit_of(recording)
    named = reading.beams(recording)
    kind = kind_for(quantity_of(unit))
    events = measured_impacts(recording, kind, sorted(rates), dead_time=reading.dead_time, joint=not beams, told=warn)
    names = [channel.name for channel in recording.channels]
    if not beams:
        yield from ({**given, **row} for row in interval_rows([[event] for event in events], unit))
        return
    groups = grouped(names, named)
    rocks = RockAssigner[Event](groups, recording.sampling_rate).feed(events, np.inf)
    cells = []
    for rows in groups:
        channel = "+".join(names[row] for row in rows)
        given |= {"channel": channel, "same_beam": channel if len(rows) > 1 else ""}
        cells += [given | row for row in interval_rows([rock for rock in rocks if rock[0].channel in rows], unit)]
    yield from sorted(cells, key=lambda row: float(row["time_s"]))
