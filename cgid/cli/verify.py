"""`cgid verify`: find damage in datasets, recordings, tables and models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import PATH, json_option
from cgid.cli.output import FileErrors, print_json, progress_bar, say
from cgid.cli.reading import ReadingOptions, reading_options_for
from cgid.errors import BadData, CgidError, MissingOption
from cgid.shipped import SCENES

if TYPE_CHECKING:
    from cgid.recordings import RecordingFile

_NO_SUM = "no checksum, "


@click.command(
    cls=Command,
    short_help="Find damage in data or models.",
    example="cgid verify models/default.npz datasets/sample.csv",
)
@click.argument("data", type=PATH, nargs=-1, required=True, metavar="DATA...")
@reading_options_for()
@json_option
def verify(data: tuple[str, ...], as_json: bool, reading: ReadingOptions) -> int:
    """Find damage in DATA: datasets (folders or files), recordings, tables, models; the exit code is 65 then.

    The files of a folder are compared with its SHA256SUMS, single files with their own checksums. A recording of
    another program (TDMS, WAV, CSV, ...) has none: it is read to its end, as are all in a folder. For a damaged dataset
    the command is named that makes exactly its damaged and missing files again, to the same bytes. Files that do not
    belong to a dataset are reported, but are not damage.
    """
    from cgid.cli.info import is_model

    errors = FileErrors()
    for path in errors.each(file for one in data for file in _recordings_of(one) or [one]):
        with errors:
            if not _is_file(path):
                _verify_data(path, as_json)
            elif is_model(path):
                _verify_model(path, as_json)
            elif not _is_foreign(path):
                _verify_data(path, as_json)
            elif not _verify_rows(path, as_json):
                _verify_foreign(path, reading, as_json)
    return errors.code


def _recordings_of(path: str) -> list[str]:
    """Return the recordings of other programs in a folder, sorted; none for anything else."""
    from cgid.identification.training.manifest import recordings_in
    from cgid.store.folder import is_dataset_folder

    folder = Path(path)
    try:
        if folder.is_dir() and not is_dataset_folder(folder) and not any(folder.glob("recording-*.h5")):
            return [str(file) for file in recordings_in(folder)]
    except (CgidError, OSError):  # the error is reported on reading
        pass
    return []


def _verify_rows(path: str, as_json: bool) -> bool:
    """Report an intact table of predictions or features, or raise its damage; return whether it is one."""
    from cgid.cli.table import written_table

    try:
        table = written_table(path)
    except BadData as error:
        _tell(path, "table", 1, [_line(Path(path), "damaged", str(error))], False, as_json)
        raise
    if table is None:
        return False
    content = f"{counted(table.n_rows, 'row')} of {counted(len(table.columns), 'column')}"
    has_sums = Path(path).suffix.lower() not in (".csv", ".jsonl")
    state = "whole" if has_sums else f"{_NO_SUM}readable"
    _tell(path, table.kind, 1, [], True, as_json, f"{state}: {content}")
    return True


def _verify_model(path: str, as_json: bool) -> None:
    """Report an intact model, or raise its damage."""
    from cgid.identification.model.model import StoredModel

    try:
        StoredModel.load(path)
    except BadData as error:
        _tell(path, "model", 1, [_line(Path(path), "damaged", str(error))], False, as_json)
        raise
    _tell(path, "model", 1, [], True, as_json)


def _is_file(path: str) -> bool:
    try:
        return Path(path).is_file()
    except OSError:  # such as a name too long
        return False


def _is_foreign(path: str) -> bool:
    """Return whether this is a recording of another program."""
    from cgid.recordings import is_dataset
    from cgid.store.description import is_hdf5
    from cgid.store.reading import is_recording
    from cgid.store.run import is_single_file
    from cgid.store.table import is_table

    file = Path(path)
    if is_table(path) or is_dataset(path) or is_recording(path):
        return False
    return not is_single_file(file) or is_hdf5(file)


def _verify_foreign(path: str, reading: ReadingOptions, as_json: bool) -> None:
    """Report a recording without checksums that is readable to its end, or raise its damage."""
    source = Path(path)
    try:
        recording, n_samples = _read(path, reading)
    except BadData as error:
        _tell(path, "recording", 1, [_line(source, "unreadable", str(error))], False, as_json, f"{_NO_SUM}unreadable")
        raise
    damage = recording.damage
    lines = [
        _line(source, "damaged" if text in damage else "remark", f"{source}: {text}") for text in recording.messages
    ]
    channels = counted(len(recording.channels), "channel")
    content = f"{recording.format} of {channels}, {counted(n_samples, 'sample')} each"
    state = "damaged" if damage else "readable"
    _tell(path, "recording", 1, lines, not damage, as_json, f"{_NO_SUM}{state}: {content}")
    if damage:
        raise BadData(f"{path}: must be complete, {damage[0]}; copy or export it again, this is not a file of cgid")


def _read(path: str, reading: ReadingOptions) -> tuple[RecordingFile, int]:
    """Read a recording to its end, whether or not its rate is known; return it and its samples per channel."""
    from cgid.recordings import open_recording

    try:
        recording = open_recording(path, **reading.common)
    except MissingOption:
        recording = open_recording(path, **reading.common | {"sampling_rate": 1.0})
    n_samples = 0
    with progress_bar(recording.n_samples, "samples", "reading") as progress:
        for block in recording.blocks():
            n_samples += block.shape[1]
            progress(block.shape[1])
    return recording, n_samples


def _verify_data(path: str, as_json: bool) -> None:
    from cgid.store.verification import remedy
    from cgid.store.verification import verify as find

    report = find(path)
    left = report.damage
    lines = [_line(finding.file, finding.problem, finding.what) for finding in report.findings]
    _tell(path, report.kind, report.n_files, lines, not left, as_json)
    if left:
        files = f"{len(left)} of its files are" if len(left) > 1 else f"{left[0].file.name} is"
        raise BadData(
            f"{path}: must be complete, {files} damaged, missing or unfinished; make it again: {remedy(path, SCENES)}"
        )


def _line(file: Path, problem: str, what: str) -> dict[str, Any]:
    return {"file": str(file), "problem": problem, "what": what}


def _tell(
    path: str, kind: str, n_files: int, lines: list[dict[str, Any]], whole: bool, as_json: bool, state: str = ""
) -> None:
    """Print the state of one input, and the findings in it."""
    if as_json:
        print_json({"source": path, "kind": kind, "files": n_files, "whole": whole, "findings": lines})
        return
    say(f"{path}: {kind} of {counted(n_files, 'file')}, {state or ('whole' if whole else 'damaged')}")
    for line in lines:
        say(f"  {line['problem']}: {line['what']}")
