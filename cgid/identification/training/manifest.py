"""The manifest of labelled recordings: labels of files or intervals, and the groups they belong to.

A CSV file has one row per interval, with any of `COLUMNS` and the user's own. A folder whose subfolders are labels is a
manifest, too. Paths are relative to the manifest.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from cgid._lib import validation
from cgid._lib.files import read_regular
from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted, spreadsheet_cell, text_of_cell
from cgid._lib.validation import shown
from cgid.errors import BadData, CannotCreate, CgidError, InvalidValue, NoInput
from cgid.identification.prediction.settings import LabelledSpan, require_groups
from cgid.identification.training.stretches import Row, resolved
from cgid.recordings.chain import Chain, Gain
from cgid.recordings.formats import ENDINGS
from cgid.recordings.recording import LABELS
from cgid.units import quantity_of

#: The columns of a row.
COLUMNS = (
    *("path", "label", "start", "end", "group", "channel", "gain", "rate", "unit"),
    *("variable", "format", "sensitivity", "full_scale", "invert", "same_beam", "site", "chosen"),
)
#: Name of a column -> its title in a CSV file, where they differ.
_TITLES = {"start": "start_s", "end": "end_s", "rate": "rate_Hz"}
#: Columns of a CSV file for the person who labels the rows.
INFORMATIVE = ("time_s", "peak", "peak_unit", "flags", "content", "note", "by")
#: Columns of numbers, which a spreadsheet may write with a decimal comma.
_NUMBERS = ("start", "end", "gain", "rate", "sensitivity", "full_scale")
#: Names of manifests in a folder.
_NAMES = ("manifest.csv", "events.csv")
#: Maximum number of characters of a label or group.
_MAX_WORD_LENGTH = 100
#: Largest size of a manifest [bytes].
MAX_FILE_SIZE = 16 << 20
#: Length of the beginning of a CSV file that shows whether it is a recording [bytes].
_HEAD = 1 << 14
#: A row of numbers and times, in any way that recordings are read.
_NUMBERS_ONLY = re.compile(r"(?=.*\d)(?:[\d\s.,;:+/\"'-]|[ed][+-]?\d|[ap]m|[tz]|nan|inf)+", re.IGNORECASE)
#: Columns for a complete recording, and the attributes of annotations for them.
_OF_RECORDINGS = {
    **{
        name: name
        for name in ("sensitivity", "full_scale", "unit", "variable", "format", "invert", "same_beam", "site")
    },
    "gain": "recording_gain",
    "rate": "sampling_rate",
}
#: Columns that a table of samples has not.
_OF_MANIFESTS = {"path", "group", "start", "end", "start_s", "end_s", "time_s"}
#: Maximum number of mistakes reported at once.
_MAX_MISTAKES = 20


# -- rows -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Annotation:
    """One row of a manifest: a recording, or an interval of it."""

    path: Path
    written: str  # path as in the manifest
    label: str = ""
    group: str = ""  # unit that splits keep together, such as a day or a support; default: the recording
    start: float = 0.0  # `start`, `end`: [s]; `end` is infinite for the end of the recording
    end: float = math.inf
    channels: tuple[str, ...] | None = None  # numbers from 1, or names, of the channels of a row; None for all
    gain: float | None = None  # divisor of the samples of the interval, None if not stated
    # gain that differs between the channels, or is that of a charge amplifier; for the complete recording
    recording_gain: tuple[str, ...] | None = None
    invert: bool = False  # whether the samples are inverted, because impacts must point upwards
    # `sampling_rate`, `unit`, `variable`, `format`, `sensitivity`, `full_scale`: for files without them, see
    # `cgid.recordings.open_recording`
    sampling_rate: float | None = None
    unit: str | None = None
    variable: str | None = None
    format: str | None = None
    sensitivity: tuple[str, ...] | None = None
    full_scale: tuple[str, ...] | None = None
    site: str = ""  # site file by which the recording is read
    same_beam: tuple[str, ...] = ()  # groups of channels of one beam, such as 1+2, whose impacts are one row
    chosen: str = ""  # how the row came to be labelled, "random" if it was drawn at random
    stretch: tuple[float, float] | None = None  # the whole of which this row remains, around rows in it [s]

    @property
    def name(self) -> str:
        """A unique name: the file, the chosen channels, and the interval."""
        channels = "" if self.channels is None else f" channel {'+'.join(map(str, self.channels))}"
        start, end = self.stretch or (self.start, self.end)
        if start == 0 and end == math.inf:
            return self.written + channels
        until = "its end" if end == math.inf else f"{end:g} s"
        return f"{self.written}{channels} from {start:g} to {until}"


def annotation_of(row: Mapping[str, Any], folder: Path) -> Annotation:
    """Return a checked row; paths are relative to `folder`."""
    path = row.get("path")
    if not path or "\0" in path:
        raise InvalidValue(f"path must be the name of a file, got {shown(path)}")
    label = _word("label", row.get("label", ""))
    if not label:
        raise InvalidValue("every recording or interval must have a label; add it, or remove the row")
    validation.label("label", label)
    start, end = _number("start", row.get("start", 0.0), " in s"), _number("end", row.get("end", math.inf), " in s")
    if not 0 <= start < end:
        raise InvalidValue(f"start and end must rise from 0 s, got {start:g} and {end:g} s")
    rate, unit, variable, format_name = (row.get(name) for name in ("rate", "unit", "variable", "format"))
    if unit is not None:
        quantity_of(unit)
    gain, sensitivity, full_scale = (_of_channels(row.get(name)) for name in ("gain", "sensitivity", "full_scale"))
    Chain.of(sensitivity, gain, full_scale)
    one_gain = Gain.of(gain[0]) if gain is not None and len(gain) == 1 and "=" not in gain[0] else None
    is_factor = one_gain is not None and not one_gain.is_of_charge
    return Annotation(
        path=folder / path,
        written=path,
        label=label,
        group=_word("group", row.get("group", "")) or str(folder / path),
        start=start,
        end=end,
        channels=_channels(row.get("channel")),
        gain=one_gain.value if one_gain is not None and is_factor else None,
        recording_gain=None if is_factor else gain,
        invert=_truth("invert", row.get("invert", "no")),
        sampling_rate=None if rate is None else _positive("rate", rate, "Hz"),
        unit=unit,
        variable=None if variable is None else _word("variable", variable),
        format=None if format_name is None else _word("format", format_name),
        sensitivity=sensitivity,
        full_scale=full_scale,
        site="" if row.get("site") is None else str(folder / _word("site", row["site"])),
        same_beam=tuple("+".join(group) for group in require_groups(_of_channels(row.get("same_beam")) or ())),
        chosen=_word("chosen", row.get("chosen", "")),
        stretch=row.get("stretch"),
    )


def _word(name: str, value: str) -> str:
    text = value.strip()
    if len(text) > _MAX_WORD_LENGTH or not text.isprintable():
        raise InvalidValue(f"{name} must be a word of at most {_MAX_WORD_LENGTH} characters, got {shown(value)}")
    return text


def _number(name: str, value: str | float, what: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise InvalidValue(f"{name} must be a number{what}, got {shown(value)}")
    return number


def _positive(name: str, value: str, unit: str) -> float:
    number = _number(name, value, f" in {unit}")
    if not 0 < number < math.inf:
        raise InvalidValue(f"{name} must be above 0 and finite, got {number:g} {unit}")
    return number


def _of_channels(value: str | None) -> tuple[str, ...] | None:
    """Return the values of a cell: one for all channels, or several NAME=VALUE with ; between them."""
    return None if value is None else tuple(one.strip() for one in value.split(";"))


def _truth(name: str, value: str) -> bool:
    words = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}
    truth = words.get(value.lower())
    if truth is None:
        raise InvalidValue(f"{name} must be yes or no, got {shown(value)}")
    return truth


def _channels(value: str | None) -> tuple[str, ...] | None:
    """Return the channels of a cell such as 1+2."""
    if value is None:
        return None
    channels = tuple(one.strip() for one in value.split("+"))
    if not all(channels) or len(set(channels)) != len(channels):
        raise InvalidValue(f"channel must be a name or a number from 1, or different ones (1+2), got {shown(value)}")
    return channels


def contradictions(annotations: Sequence[Annotation]) -> list[str]:
    """Return the contradictions between annotations, one line each."""
    mistakes = []
    by_file: dict[Path, list[Annotation]] = {}
    for one in annotations:
        by_file.setdefault(one.path, []).append(one)
    for path, of_file in by_file.items():
        groups = sorted({one.group for one in of_file})
        if len(groups) > 1:
            got = " and ".join(groups[:2])
            mistakes.append(
                f"{path}: all of a recording must be in one group, got {got}; give its rows one group, or save what "
                "belongs to another as a recording of its own"
            )
        of_file.sort(key=lambda one: (str(one.channels), one.start))
        for before, after in pairwise(of_file):
            for column, name in _OF_RECORDINGS.items():
                first, second = getattr(before, name), getattr(after, name)
                if before.channels == after.channels and first != second:
                    mistakes.append(
                        f"{path}: a recording must have one {column}, got {_value_text(first)} and "
                        f"{_value_text(second)}; write "
                        "the same in all its rows"
                    )
            if before.channels == after.channels and after.start < before.end:
                what = f"{before.label} and {after.label}"
                mistakes.append(f"{path}: intervals must not overlap, {what} do at {after.start:g} s")
    return mistakes


def _value_text(value: Any) -> str:
    """Return a value as in a manifest."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return " and ".join(value) or "none" if isinstance(value, tuple) else "none" if value is None else f"{value}"


# -- the file ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The annotations of a manifest, in the order of the file; `source` is its name."""

    source: str
    annotations: tuple[Annotation, ...] = ()
    n_unlabelled: int = 0  # rows without a label, which are left out

    @property
    def labels(self) -> tuple[str, ...]:
        """The distinct labels, sorted."""
        return tuple(sorted({one.label for one in self.annotations}))

    @property
    def n_intervals(self) -> int | None:
        """Number of labelled intervals, such as one for each impact; None if a row is a complete recording."""
        return len(self.annotations) if all(one.end < math.inf for one in self.annotations) else None


def is_manifest(path: str | Path) -> bool:
    """Return whether a file is a manifest: a .csv that is not a recording."""
    path = Path(path)
    return path.suffix.lower() == ".csv" and not (path.is_file() and _is_table_of_numbers(path))


def _is_table_of_numbers(path: Path) -> bool:
    """Return whether the first lines of a CSV file contain numbers or times only, besides labels of its samples."""
    try:
        with path.open("rb") as file:
            lines = file.read(_HEAD).decode("utf-8-sig", "replace").splitlines()
    except OSError:
        return False
    rows = [[cell.strip().strip('"').lower() for cell in re.split("[,;\t]", line)] for line in lines]
    at = next((cells.index(one) for cells in rows for one in LABELS if one in cells), None)
    if any(_OF_MANIFESTS & set(cells) for cells in rows):
        return False
    if at is None:
        return any(map(_NUMBERS_ONLY.fullmatch, lines))
    # Two numbers at least, such as a time and a sample.
    return any(len(row) > 2 and _NUMBERS_ONLY.fullmatch(",".join(row[:at] + row[at + 1 :])) for row in rows)


def read_manifest(path: str | Path, text: str | None = None) -> Manifest:
    """Return a checked manifest, without opening its recordings; `BadData` has one line per mistake.

    With `text`, that is what the CSV file is taken to contain.
    """
    path = Path(path)
    rows = _csv_rows(path, text)
    annotations, mistakes = [], []
    kept, empty = resolved(str(path), rows)
    if rows and not kept:
        mistakes.append(
            f"{path}: some row must have a label, none of {len(rows)} has; fill in the column label of those that you "
            "know, the others are left out"
        )
    for where, row in kept:
        try:
            annotations.append(annotation_of(row, path.parent))
        except InvalidValue as error:
            mistakes.append(f"{path}: {where}: {error}")
    mistakes += [f"{path}: {text}" for text in contradictions(annotations)]
    if not rows:
        mistakes.append(f"{path}: a manifest must name recordings, there is none; give a path and a label for each")
    if mistakes:
        more = len(mistakes) - _MAX_MISTAKES
        raise BadData(*mistakes[:_MAX_MISTAKES], *[f"{path}: and {more} more mistakes"] * (more > 0))
    return Manifest(source=str(path), annotations=_in_one_spelling(str(path), annotations), n_unlabelled=len(empty))


def _in_one_spelling(source: str, annotations: Sequence[Annotation]) -> tuple[Annotation, ...]:
    used = validation.one_spelling(source, [one.label for one in annotations])
    return tuple(replace(one, label=used[one.label]) if one.label in used else one for one in annotations)


def _text(path: Path) -> str:
    try:
        return read_regular(path, "a manifest", MAX_FILE_SIZE).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadData(f"{path}: a manifest must be UTF-8 text, byte {error.start} is not; save it as UTF-8") from None


def _csv_table(path: Path, text: str | None = None) -> tuple[list[list[str]], str]:
    """Return the cells of a CSV manifest, line by line, empty for comments; and their separator."""
    # Not `splitlines`, which also splits at other characters that a path may contain.
    split = re.split("\r\n?|\n", _text(path) if text is None else text)
    lines = [line if line.strip() and not line.lstrip().startswith("#") else "" for line in split]
    header = next((line for line in lines if line), "")
    separator = max(",;\t", key=header.count)
    try:
        table = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=separator))
    except csv.Error as error:
        raise BadData(f"{path}: a manifest must be a CSV table ({error}); save it again") from None
    return table, separator


def _csv_rows(path: Path, text: str | None = None) -> list[Row]:
    """Return the rows of a CSV manifest with their line numbers."""
    table, separator = _csv_table(path, text)
    by_title = {_TITLES.get(name, name).lower(): name for name in (*COLUMNS, *INFORMATIVE)}
    names: list[str] = []
    rows: list[Row] = []
    for number, cells in enumerate(table, 1):
        cells = [text_of_cell(cell.strip()) for cell in cells]
        if not any(cells):
            continue
        if not names:
            if "reference" in (cell.lower() for cell in cells):
                raise BadData(f"{path}: column reference must be left out with its rows, reference runs are withdrawn")
            names = [by_title.get(cell.lower(), "") for cell in cells]
            allowed = tuple(_TITLES.get(name, name) for name in COLUMNS)
            titles = [
                _TITLES.get(name, name or cell.lower())
                for name, cell in zip(names, cells, strict=True)
                if name in COLUMNS or not (name or _is_own(cell, cells, allowed))
            ]
            _check_names(titles, allowed, f"{path}: columns", required="path")
            continue
        if len(cells) > len(names):
            raise BadData(f"{path}: row {number}: must have {len(names)} cells like the header, got {len(cells)}")
        row = {name: cell for name, cell in zip(names, cells, strict=False) if cell and name in COLUMNS}
        if separator != ",":
            row |= {name: _with_points(row[name]) for name in _NUMBERS if name in row}
        rows.append((f"row {number}", row))
    return rows


def _is_own(title: str, titles: Sequence[str], allowed: Sequence[str]) -> bool:
    """Return whether a column is the user's own, not a misspelling of one that the table lacks.

    >>> _is_own("weather", ["path", "weather"], COLUMNS), _is_own("lable", ["path", "lable"], COLUMNS)
    (True, False)
    """
    used = {one.lower() for one in titles}
    return not validation.similar(title, [name for name in allowed if name.lower() not in used])


def _with_points(cell: str) -> str:
    """Return a cell with decimal points for its commas, except in channel names (NAME=VALUE).

    >>> _with_points("a,b=10,2 mV/g;2=3,1 mV/N")
    'a,b=10.2 mV/g;2=3.1 mV/N'
    """
    parts = (part.rpartition("=") for part in cell.split(";"))
    return ";".join(f"{name}{equals}{value.replace(',', '.')}" for name, equals, value in parts)


def _check_names(names: Sequence[str], allowed: tuple[str, ...], what: str, required: str | None = None) -> None:
    for name in names:
        if name not in allowed or names.count(name) > 1:
            fault = f"{name!r} is there twice"
            if name not in allowed:
                fault = f"got {name!r}{validation.suggestion(name, allowed)}"
            raise BadData(f"{what} must be out of {', '.join(allowed)}, {fault}")
    if required is not None and required not in names:
        raise BadData(f"{what} must include {required}, got {', '.join(names) or 'none'}")


# -- folders, and files to fill in ------------------------------------------------------------------------


def folder_manifest(folder: str | Path) -> Manifest:
    """Return the manifest of a folder: the file in it, else one whose labels are the names of subfolders."""
    # Files of a deeper folder are one group, such as a day.
    folder = Path(folder)
    manifests = [folder / name for name in _NAMES if (folder / name).is_file()]
    if len(manifests) > 1:
        raise BadData(
            f"{folder}: several manifests in this folder, {' and '.join(one.name for one in manifests)}; name one"
        )
    if manifests:
        return read_manifest(manifests[0])
    rows = [row_of(file, folder) for file in recordings_in(folder)]
    loose = [row["path"] for row in rows if not row["label"]]
    if loose:
        raise BadData(f"{folder}: {unlabelled(loose[0], str(folder))}")
    annotations = []
    for row in rows:
        try:
            annotations.append(annotation_of(row, folder))
        except InvalidValue as error:
            raise BadData(f"{folder}: {row['path']}: {error}") from None
    return Manifest(source=str(folder), annotations=_in_one_spelling(str(folder), annotations))


def row_of(file: Path, folder: Path) -> dict[str, str]:
    """Return path, label and group of a recording in a folder; outside subfolders it has no label."""
    parts = file.relative_to(folder).parts
    return {"path": "/".join(parts), "label": "".join(parts[:-1][:1]), "group": "/".join(parts[1:-1])}


def recordings_in(folder: Path) -> list[Path]:
    """Return the files in a folder and its subfolders with suffixes of recordings, sorted."""
    try:
        all_files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in ENDINGS and file.is_file())
    except OSError as error:
        raise NoInput(f"{folder}: the folder cannot be read ({error.strerror}); check its rights") from None
    hidden = {file for file in all_files if any(part.startswith(".") for part in file.relative_to(folder).parts)}
    files = [file for file in all_files if file not in hidden and not is_manifest(file)]
    if not files:
        what = "its files have other suffixes" if any(folder.iterdir()) else "it is empty"
        raise BadData(f"{folder}: a folder must contain recordings ({', '.join(ENDINGS)}), {what}; choose another one")
    return files


def labelled_in(
    manifest: Manifest,
    recording: str,
    channels: Sequence[str],
    labels: Sequence[str],
    gangue: Sequence[str],
    *,
    needs_coal: bool,
) -> tuple[tuple[LabelledSpan, ...], tuple[LabelledSpan, ...]]:
    """Return the spans of a recording that a manifest gives a label of a model other than gangue, and gangue.

    Raises `BadData` if there is none, or none but gangue where it needs coal.
    """
    path, of_gangue = Path(recording).resolve(), {one.casefold() for one in gangue}
    known = {one.casefold() for one in labels} - of_gangue
    rows = [
        one
        for one in manifest.annotations
        if (one.path.resolve() == path or (recording == "stdin" and one.written == "-"))
        and one.label.casefold() in known | of_gangue
    ]
    if not any(one.label.casefold() in known or not needs_coal for one in rows):
        raise BadData(
            f"{manifest.source}: some row of {recording} must be labelled {' or '.join(sorted(known))}, none is; label "
            f"what was coal alone, state it by {spelled('coal_until')}, or leave out {spelled('labelled')}"
        )
    by_name = {str(number): name for number, name in enumerate(channels, 1)} | {name: name for name in channels}
    asked = {str(channel) for one in rows for channel in one.channels or ()}
    if unknown := sorted(asked - by_name.keys()):
        raise BadData(
            f"{manifest.source}: channel must be one of {recording} ({', '.join(channels)}), got {unknown[0]}"
        )
    coal, lumps = (
        tuple(
            LabelledSpan(one.start, one.end, "" if channel == "" else by_name[str(channel)])
            for one in rows
            if (one.label.casefold() in of_gangue) == is_gangue
            for channel in one.channels or ("",)
        )
        for is_gangue in (False, True)
    )
    return coal, lumps


def recordings_of(files: Sequence[str]) -> list[str]:
    """Return files, for a folder that is no dataset the recordings in it."""
    every: list[str] = []
    for file in files:
        if Path(file).is_dir():
            from cgid.store.folder import is_dataset_folder

            every += [file] if is_dataset_folder(Path(file)) else map(str, recordings_in(Path(file)))
        else:
            every.append(file)
    return every


def joined(manifests: Sequence[Manifest]) -> Manifest:
    """Return one manifest of the rows of several, such as one table of `events` for each day."""
    if len(manifests) == 1:
        return manifests[0]
    source = " + ".join(one.source for one in manifests)
    annotations = [row for one in manifests for row in one.annotations]
    if mistakes := contradictions(annotations):
        raise BadData(*(f"{source}: {text}" for text in mistakes[:_MAX_MISTAKES]))
    n_unlabelled = sum(one.n_unlabelled for one in manifests)
    return Manifest(source=source, annotations=tuple(annotations), n_unlabelled=n_unlabelled)


def unlabelled(name: str, given: str) -> str:
    """Return the error for a recording without a label, with the commands to label `given`."""
    return (
        f"{name} must have labels for training and has none; run cgid events {shlex.quote(given)} -o events.csv for a "
        "row per impact, fill in the column label, then cgid train events.csv -o mine.npz"
    )


def manifest_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Return the content of a CSV manifest, without empty columns other than path, label and `columns`."""
    order = dict.fromkeys(("path", "channel", "start", "end", "label", *INFORMATIVE, *COLUMNS))
    required = ("path", "label", *columns)
    columns = [name for name in order if name in required or any(row.get(name) for row in rows)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([_TITLES.get(name, name) for name in columns])
    writer.writerows([spreadsheet_cell(str(row.get(name) or "")) for name in columns] for row in rows)
    return stream.getvalue()


def path_from(folder: Path, file: str | Path) -> str:
    """Return the path of a file as in a manifest in a folder."""
    try:
        path = Path(os.path.relpath(file, folder)).as_posix()
    except ValueError:  # another drive
        path = Path(file).absolute().as_posix()
    # A comment begins with #, and blanks around a cell do not count.
    return f"./{path}" if path.startswith("#") or path != path.lstrip() else path


def named_recordings(item: Path) -> list[Path]:
    """Return the recordings that a manifest, or a folder of recordings, names, as far as it can be read."""
    manifests = [item / name for name in _NAMES if (item / name).is_file()] if item.is_dir() else [item]
    if not manifests:
        return recordings_in(item)
    found: list[Path] = []
    for path in manifests:
        found += [path.parent / file for (file,) in _columns_in(path, "path") or ()]
    return found


def labels_in(path: Path) -> list[tuple[str, str]] | None:
    """Return file and label of each row of a manifest; None for any other table; raises `BadData`."""
    return _columns_in(path, "path", "label")


def _columns_in(path: Path, *names: str) -> list[Any] | None:
    """Return the cells of some columns of a CSV table, row by row; None if it lacks one; raises `BadData`."""
    table = [cells for cells in _csv_table(path)[0] if any(cells)]
    titles = [cell.strip().lower() for cell in table[0]] if table else []
    if not set(names) <= set(titles):
        return None
    places = [titles.index(name) for name in names]
    rows = (cells for cells in table[1:] if len(cells) > max(places))
    return [tuple(text_of_cell(cells[at].strip()) for at in places) for cells in rows]


def require_labels_kept(path: Path, rows: Sequence[Mapping[str, Any]] = ()) -> None:
    """Raise `CannotCreate` if `rows`, written over an existing table, would lose labels that a person filled in."""
    try:
        filled = labels_in(path)
    except CgidError:
        return  # there is none, or it is no table
    kept = {(row["path"], row["label"]) for row in rows}
    lost = [label for file, label in filled or () if label and (file, label) not in kept]
    if lost:
        raise CannotCreate(
            f"{path}: must not contain labels to be replaced, got {counted(len(lost), 'label')}, the first is "
            f"{shown(lost[0])}; choose another name, or remove the table first"
        )
