"""The manifest of labelled recordings: which file, or which intervals of it, is what, and what must stay together.

A CSV file has one row an interval and any of the columns in `COLUMNS`; a TOML file has one `[[recording]]` a file, by
the same names, and values at its top level that hold for all. Paths are relative to the manifest.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cgid.errors import BadData, CgidError, InvalidValue
from cgid.files import parse_toml, read_regular
from cgid.identification.recorded.annotation import COLUMNS, Annotation, annotation_of, contradictions

#: A larger file is no manifest [bytes], nor one of more keys.
LARGEST_FILE, _MOST_KEYS = 16 << 20, 1_000_000
#: What may be said once for all recordings of a TOML manifest.
_SHARED = ("group", "channel", "gain", "sensor", "rate", "unit", "variable")
#: So many mistakes are said at once.
_MOST_MISTAKES = 20


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Annotated recordings.

    Attributes
    ----------
    source : str
        The manifest's file.
    annotations : tuple of Annotation
        In the order of the file, reference runs among them.
    """

    source: str
    annotations: tuple[Annotation, ...] = field(default_factory=tuple)

    @property
    def labels(self) -> tuple[str, ...]:
        """Every label once, sorted."""
        return tuple(sorted({one.label for one in self.annotations if not one.reference}))


def is_manifest(path: str | Path) -> bool:
    """Return whether a file is a manifest by its name and, for TOML, by what it holds: a scene is TOML, too."""
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return True
    if path.suffix.lower() != ".toml" or not path.is_file():
        return False
    try:
        return "recording" in _toml(path)
    except CgidError:
        return False


def read_manifest(path: str | Path) -> Manifest:
    """Return a manifest, checked; whether its recordings can be read shows when they are.

    Raises
    ------
    NoInput
        The file cannot be read.
    BadData
        It is no manifest, or contradicts itself; one line a mistake.
    """
    path = Path(path)
    rows, labels = _csv_rows(path) if path.suffix.lower() == ".csv" else _toml_rows(path)
    annotations, mistakes = [], []
    for where, row in rows:
        try:
            annotations.append(annotation_of(row, path.parent, labels))
        except InvalidValue as error:
            mistakes.append(f"{path}: {where}: {error}")
    mistakes += [f"{path}: {text}" for text in contradictions(annotations)]
    if not rows:
        mistakes.append(f"{path}: a manifest must name recordings, there is none; give a path and a label each")
    if mistakes:
        more = len(mistakes) - _MOST_MISTAKES
        raise BadData(*mistakes[:_MOST_MISTAKES], *[f"{path}: and {more} more mistakes"] * (more > 0))
    return Manifest(source=str(path), annotations=tuple(annotations))


# -- the two formats --------------------------------------------------------------------------------------

Row = tuple[str, Mapping[str, Any]]


def _text(path: Path) -> str:
    try:
        return read_regular(path, "a manifest", LARGEST_FILE).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadData(f"{path}: a manifest must be UTF-8 text, byte {error.start} is not; save it as UTF-8") from None


def _csv_rows(path: Path) -> tuple[list[Row], tuple[str, ...] | None]:
    """Return the rows of a CSV manifest with where they stand; it lists no labels."""
    lines = [line if line.strip() and not line.lstrip().startswith("#") else "" for line in _text(path).splitlines()]
    header = next((line for line in lines if line), "")
    separator = max(",;\t", key=header.count)
    try:
        table = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=separator))
    except csv.Error as error:
        raise BadData(f"{path}: a manifest must be a CSV table ({error}); save it again") from None
    names: list[str] = []
    rows: list[Row] = []
    for number, cells in enumerate(table, 1):
        cells = [cell.strip() for cell in cells]
        if not any(cells):
            continue
        if not names:
            names = [cell.lower() for cell in cells]
            _check_names(names, COLUMNS, f"{path}: columns", required="path")
            continue
        if len(cells) > len(names):
            raise BadData(f"{path}: row {number}: must have {len(names)} cells as the header, got {len(cells)}")
        rows.append((f"row {number}", {name: cell for name, cell in zip(names, cells, strict=False) if cell}))
    return rows, None


def _toml(path: Path) -> dict[str, Any]:
    try:
        return parse_toml(_text(path), _MOST_KEYS)
    except CgidError:
        raise
    except ValueError as error:
        raise BadData(f"{path}: a manifest must be TOML: {error}; correct it there") from None


def _toml_rows(path: Path) -> tuple[list[Row], tuple[str, ...] | None]:
    """Return the rows of a TOML manifest with where they stand, and the labels that it allows."""
    content = _toml(path)
    recordings = content.get("recording")
    if not isinstance(recordings, list) or not all(isinstance(one, dict) for one in recordings):
        raise BadData(f"{path}: a manifest must list its recordings as [[recording]]; see cgid train --help")
    _check_names(list(content), (*_SHARED, "labels", "recording"), f"{path}: keys")
    labels = content.get("labels")
    if labels is not None and not (isinstance(labels, list) and all(isinstance(one, str) for one in labels)):
        raise BadData(f'{path}: labels must be a list of words, such as ["coal", "gangue"], got {labels!r}')
    shared = {name: content[name] for name in _SHARED if name in content}
    rows: list[Row] = []
    for number, recording in enumerate(recordings, 1):
        where = f"recording {number}"
        _check_names(list(recording), (*COLUMNS, "intervals"), f"{path}: {where}: keys", required="path")
        intervals = recording.pop("intervals", [{}])
        if not isinstance(intervals, list) or not all(isinstance(one, dict) for one in intervals):
            raise BadData(f"{path}: {where}: intervals must be a list of {{ start, end, label }}, got {intervals!r}")
        for interval in intervals:
            _check_names(list(interval), ("start", "end", "label"), f"{path}: {where}: keys of an interval")
            rows.append((where, {**shared, **recording, **interval}))
    return rows, None if labels is None else tuple(labels)


def _check_names(names: Sequence[str], allowed: tuple[str, ...], what: str, required: str | None = None) -> None:
    for name in names:
        if name not in allowed or names.count(name) > 1:
            fault = f"got {name!r}" if name not in allowed else f"{name!r} is there twice"
            raise BadData(f"{what} must be out of {', '.join(allowed)}, {fault}")
    if required is not None and required not in names:
        raise BadData(f"{what} must say the {required}, got {', '.join(names) or 'none'}")
