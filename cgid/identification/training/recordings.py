"""Measure labelled recordings: open the files of a manifest, cut them into windows or impacts, extract features.

Memory holds one block of a recording at a time.
"""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import compress, groupby
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from cgid._lib.files import require_regular
from cgid._lib.spelling import spelled
from cgid._lib.validation import Floats
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption, NoInput
from cgid.identification.detection.ear import Ear
from cgid.identification.detection.events import Event, Framing, frames_alike
from cgid.identification.detection.silence import Silence, silence_of
from cgid.identification.detection.windows import (
    N_COPIES,
    WINDOW_TIME,
    Grid,
    NoisyCopies,
    measure_windows,
    windows_of,
)
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.same_beam import (
    RockAssigner,
    agreeing,
    behind_each_sensor,
    grouped,
    joined,
    pulse_columns,
)
from cgid.identification.prediction.settings import require_groups
from cgid.identification.training.control import N_WAYS, TOTALS, Background, table_of
from cgid.identification.training.manifest import Annotation, Manifest
from cgid.identification.training.rows import Rows, Slicing, default_guards, sets_for, union_of
from cgid.measure.features.extraction import (
    FEATURES,
    choose,
    extract_array,
    kind_for,
    kind_of,
    require_supported,
    supported,
)
from cgid.measure.features.table import LEAST_SAMPLES, LOW_WINDOW_TIME, MIN_BANDWIDTH, ImpactKind, Kind
from cgid.recordings import MAX_STREAM, RecordingFile, open_recording
from cgid.recordings.chain import Statement, require_measured
from cgid.recordings.recording import clear_errors
from cgid.recordings.site import Site
from cgid.signals import channel_name
from cgid.units import UNITS, quantity_of

_NONE = np.empty(0, np.str_)
#: Windows whose noisy copies are measured at once.
_COPIED = 64
#: Impacts that are measured at once in other backgrounds.
_MEASURED = 64


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Settings for reading recordings: metadata that files and manifest lack, and the handling of unreadable files."""

    # If `strict`, the first unreadable recording raises; else `failed` receives its error and the others are read.

    sampling_rate: float | None = None
    unit: str | None = None
    channels: tuple[int | str, ...] | None = None
    same_beam: tuple[str, ...] = ()
    strict: bool = False
    sensitivity: Statement | None = None
    gain: Statement | None = None
    full_scale: Statement | None = None
    site: Site | None = None
    failed: Callable[[CgidError], object] = lambda error: None

    def note(self, error: CgidError, failures: list[CgidError]) -> None:
        """Record the error of a recording, or raise it if strict."""
        if self.strict:
            raise error
        failures.append(error)


# -- files ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class AnnotatedFile:
    """An open recording with the annotations of one selection of its channels."""

    annotations: tuple[Annotation, ...]  # sorted by start, without overlap
    recording: RecordingFile
    unit: str
    digest: str  # SHA-256 of the file
    groups: list[tuple[int, ...]]  # rows of the channels of each beam

    @property
    def is_grouped(self) -> bool:
        """Whether channels share a beam."""
        return len(self.groups) < len(self.recording.channels)

    @property
    def beams(self) -> list[str]:
        """Names of the channels of each beam that has several, such as 1+2."""
        names = [channel.name for channel in self.recording.channels]
        return ["+".join(names[row] for row in rows) for rows in self.groups if len(rows) > 1]

    def annotation_at(self, time: float) -> Annotation | None:
        """Return the annotation that contains a time [s]."""
        k = bisect_right([one.start for one in self.annotations], time) - 1
        return self.annotations[k] if k >= 0 and time < self.annotations[k].end else None

    def annotation_around(self, time: float) -> Annotation | None:
        """Return the annotation that contains a time [s], also the last one if the next has its label and group."""
        k = bisect_right([one.start for one in self.annotations], time) - 1
        around = self.annotations[max(k, 0) : k + 2]
        is_between = len(around) == 2 and len({(one.label, one.group) for one in around}) == 1
        return around[0] if k >= 0 and is_between else self.annotation_at(time)

    def blocks(self) -> Iterator[NDArray[Any]]:
        """Yield the samples, nan in gaps; raise `BadData` at the end if an annotation starts after it."""
        count = 0
        for block in self.recording.blocks_with_gaps():
            count += block.shape[1]
            yield block
        self.require_inside(count)

    def require_inside(self, n_samples: int | None) -> None:
        """Raise `BadData` if the last annotation starts after the end of the recording, if known."""
        last, rate = self.annotations[-1], self.recording.sampling_rate
        if n_samples is not None and last.start * rate >= n_samples:
            raise BadData(
                f"{last.name}: start must be inside the recording, which lasts {n_samples / rate:g} s, got "
                f"{last.start:g} s; correct it, or the path"
            )

    def scale(self, annotation: Annotation, unit: str) -> float:
        """Return the factor from the file's values to a unit, with the recorder's gain divided out."""
        units = UNITS[quantity_of(unit)]
        return units[self.unit] / units[unit] / (annotation.gain or 1.0)


def open_all(manifest: Manifest, reading: Reading, failures: list[CgidError]) -> list[AnnotatedFile]:
    """Open the recordings of a manifest; all of one quantity and number of channels."""
    files: list[AnnotatedFile] = []
    for rows in _by_channels(manifest.annotations):
        try:
            file = opened(rows, reading)
            first = (files or [file])[0]
            require_alike(file.recording, first.recording, counts=not (file.is_grouped or first.is_grouped))
            files.append(file)
        except CgidError as error:
            reading.note(error, failures)
    if not files:
        raise BadData(
            f"{manifest.source}: at least one recording must be readable, there is none"
            + "".join(f"; {error}" for error in failures[:1])
        )
    first_with: dict[str, AnnotatedFile] = {}
    for file in files:
        first = first_with.setdefault(file.digest, file)
        if first.annotations[0].path != file.annotations[0].path:  # one would train, the other test
            raise BadData(
                f"{file.recording.source}: recordings must differ, this one equals {first.recording.source}; remove "
                "one, or name one file in all rows"
            )
    return files


def annotated_blocks(file: AnnotatedFile, unit: str) -> Iterator[tuple[Annotation, Iterator[NDArray[np.floating]]]]:
    """Yield each annotation with its blocks, in a unit, gain divided out; consume them before taking the next one."""
    rate = file.recording.sampling_rate
    bounds = [(round(one.start * rate), one.end * rate) for one in file.annotations]
    for k, parts in groupby(_cut(file.blocks(), bounds), lambda part: part[0]):
        scale = file.scale(file.annotations[k], unit)
        yield file.annotations[k], (samples * scale for _, samples in parts)


def _cut(blocks: Iterator[NDArray[Any]], bounds: Sequence[tuple[int, float]]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield interval number and samples of the parts of blocks within intervals, which rise and do not overlap."""
    start = k = 0
    for block in blocks:
        end = start + block.shape[1]
        while k < len(bounds) and bounds[k][0] < end:
            first, last = max(bounds[k][0] - start, 0), round(min(bounds[k][1], end)) - start
            if first < last:
                yield k, block[:, first:last]
            if bounds[k][1] > end:
                break
            k += 1
        start = end


def _by_channels(annotations: Sequence[Annotation]) -> list[tuple[Annotation, ...]]:
    """Group the annotations by file and channels, each group sorted by start."""
    together: dict[tuple[str, str], list[Annotation]] = {}
    for one in annotations:
        together.setdefault((str(one.path), str(one.channels)), []).append(one)
    return [tuple(sorted(rows, key=lambda one: one.start)) for rows in together.values()]


def opened(annotations: tuple[Annotation, ...], reading: Reading, *, hashed: bool = True) -> AnnotatedFile:
    """Return an open recording with the annotations of one selection of its channels, without a digest if told."""
    first = annotations[0]
    with clear_errors(str(first.path)):  # a manifest may name anything, even a pipe, which would be copied
        require_regular(first.path, "a recording of a manifest", MAX_STREAM)
    given, turned = reading.site or Site(), {"invert": True} if first.invert else {}
    site = Site(given.path or first.site, {**turned, **given.given})  # that of the line wins
    recording = open_recording(
        first.path,
        sampling_rate=first.sampling_rate or reading.sampling_rate,
        unit=first.unit or reading.unit,
        channel=first.channels or reading.channels,
        variable=first.variable,
        sensitivity=first.sensitivity or reading.sensitivity,
        # The gain of an annotation applies only to its interval.
        gain=first.recording_gain or (None if any(one.gain is not None for one in annotations) else reading.gain),
        full_scale=first.full_scale or reading.full_scale,
        format=first.format,
        site=site,
    )
    unit = unit_of(recording)
    digest = digest_of(first.path) if hashed else ""
    named = recording.named(require_groups(first.same_beam or reading.same_beam), "same_beam", all_read=False)
    groups = grouped([channel.name for channel in recording.channels], named or recording.beams)
    file = AnnotatedFile(annotations=annotations, recording=recording, unit=unit, digest=digest, groups=groups)
    file.require_inside(recording.n_samples)
    return file


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    try:
        with path.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except OSError as error:
        raise NoInput(f"{path}: the file cannot be read ({error.strerror}); check it") from None


def unit_of(recording: RecordingFile) -> str:
    """Return the unit of all channels; raises `MissingOption` if it is not known, `BadData` if there are several."""
    unit, *others = units = [channel.unit for channel in recording.channels]
    names = [channel_name(recording.source, channel.name) for channel in recording.channels]
    if None in units:
        raise MissingOption(
            f"{names[units.index(None)]}: the file does not state the unit; give it with {spelled('unit', 'g')}"
        )
    for channel, name in zip(recording.channels, names, strict=True):
        require_measured(channel.unit, name)
    if other := next((one for one in others if one != unit), None):
        raise BadData(
            f"{names[units.index(other)]}: channels must be in one unit, got {other} after {unit}; choose with "
            f"{spelled('channel')}"
        )
    assert unit is not None
    return unit


def require_alike(recording: RecordingFile, first: RecordingFile, *, counts: bool = True) -> None:
    """Raise `BadData` unless two recordings can train one model, one quantity and, if `counts`, number of channels."""
    units = [unit_of(one) for one in (recording, first)]
    got, required = (f"{quantity_of(unit)} [{unit}]" for unit in units)
    if quantity_of(units[0]) != quantity_of(units[1]):
        raise BadData(
            f"{recording.source}: recordings must be of one quantity, got {got} after {required} of {first.source}; "
            "train apart"
        )
    n_channels, n_first = len(recording.channels), len(first.channels)
    if counts and n_channels != n_first:
        raise BadData(
            f"{recording.source}: recordings must have equally many channels, got {n_channels} after {n_first} of "
            f"{first.source}; choose with {spelled('channel')}, or channel in the manifest"
        )


def _require_single(files: Sequence[AnnotatedFile], reading: Reading) -> None:
    """Raise `InvalidValue` if several channels are named for single impacts, which use one channel."""
    for file in files:
        named = file.annotations[0].channels or reading.channels
        if named and len(file.groups) > 1:
            raise InvalidValue(
                f"{file.recording.source}: channel must be one for single impacts, got {'+'.join(map(str, named))}; "
                f"name one, leave channel out for a row per channel, give {spelled('same_beam')} if they are on one "
                f"beam, or {spelled('by', 'window')} to combine several"
            )


# -- rows -------------------------------------------------------------------------------------------------


def record(
    manifest: Manifest,
    features: Sequence[str] | None = None,
    *,
    slicing: Slicing | None = None,
    reading: Reading | None = None,
    augment: bool = False,
    model: StoredModel | None = None,
    progress: Callable[[int], object] | None = None,
    control: bool = True,
    mended: bool = False,
) -> Rows:
    """Return the rows of annotated recordings: the features of their windows or impacts."""
    # If `augment`, windows have noisy copies (`Rows.snr`), from which a model learns the effect of noise. With a
    # `model` of impacts, rows are what it measures: its features and guards, in its unit, through its beam. If
    # `control`, rows are measured again with other backgrounds; if `mended`, without tones of machines, and levels
    # count from a floor above the loudest silence.
    slicing, reading = slicing or Slicing(), reading or Reading()
    failures: list[CgidError] = []
    files = open_all(manifest, reading, failures)
    for failure in failures:
        reading.failed(failure)
    n_reported = len(failures)
    if model is not None:
        features, slicing = model.measured, replace(slicing, by="impact")
        _require_quantity(files[0], model)
    unit = files[0].unit if model is None else model.unit
    background = Background(unit) if control else None
    slicing, notes, warnings = _decided(files, slicing, features)
    if slicing.by == "window" and background and not _silence(files, slicing, background).has_single_impacts:
        background = Background(unit)  # what is dense has no silence
    if slicing.by == "impact":
        _require_single(files, reading)
    elif grouped_file := next((file for file in files if file.is_grouped), None):
        raise InvalidValue(
            f"{grouped_file.recording.source}: same_beam must be left out for windows, which use their channels "
            f"together; or give {spelled('by', 'impact')}"
        )
    names = _names(features, files, slicing)
    if model is None:
        names += tuple(name for name in default_guards(names) if name not in names)
    if mended:
        names = tuple(dict.fromkeys((*names, *filter(None, [TOTALS.get(kind_of(names))]))))
    cutting = Cutting(names, slicing, unit, augment, model, mended or (model is not None and model.is_mended))
    measured: list[tuple[AnnotatedFile, list[AnnotatedRows]]] = []
    numbers = list[int]()
    for number, file in enumerate(files):
        try:
            measured.append((file, list(_pieces(file, cutting, progress, (background, number)))))
            numbers.append(number)
        except CgidError as error:
            reading.note(error, failures)
    if not any(np.isfinite(piece.features).all(axis=1).any() for _, parts in measured for piece in parts):
        first_failure = "".join(f"; {error}" for error in failures[:1])
        raise BadData(
            f"{manifest.source}: recordings must contain a {slicing.by} with a label, there is none{first_failure}; "
            f"correct start and end, or give {spelled('by', 'impact' if slicing.by == 'window' else 'window')}"
        )
    for failure in failures[n_reported:]:
        reading.failed(failure)
    rows = rows_of(measured, cutting)
    if background is not None:
        rows = _controlled(rows, measured, cutting, background, numbers)
        if model is None and not mended:
            once = replace(reading, failed=Reading().failed)  # who is told of unreadable files already
            again = partial(record, manifest, features, slicing=slicing, reading=once, augment=augment, mended=True)
            rows = replace(rows, again=again)
    return replace(rows, failures=tuple(failures), notes=notes, warnings=(*warnings, *rows.warnings))


def controlled(files: Sequence[AnnotatedFile], cutting: Cutting, progress: Callable[[int], object]) -> Rows:
    """Return the rows of open files, in other backgrounds, too."""
    background = Background(cutting.unit)
    measured = [
        (file, list(_pieces(file, cutting, progress, (background, number)))) for number, file in enumerate(files)
    ]
    return _controlled(rows_of(measured, cutting), measured, cutting, background, range(len(files)))


def _controlled(
    rows: Rows,
    measured: Sequence[tuple[AnnotatedFile, list[AnnotatedRows]]],
    cutting: Cutting,
    background: Background,
    numbers: Sequence[int],
) -> Rows:
    """Return the rows with what they are with other backgrounds; the files are read once more."""
    background.settle()
    background.require_others()
    table = table_of(background.sources)
    complete = np.isfinite(np.concatenate([piece.features for _, parts in measured for piece in parts])).all(axis=1)
    parts = [
        _again(file, its, cutting, background, number) for number, (file, its) in zip(numbers, measured, strict=True)
    ]
    again = np.concatenate([features for features, _ in parts])[complete]
    known = {name: number for number, name in enumerate(rows.groups)}
    donor = np.array([known.get(name, -1) for _, names in parts for name in names], np.intp)[complete]
    kind = kind_of(cutting.names)

    def framed(rate: float) -> tuple[int, int | None]:
        pre_trigger = Framing.of("vibration", rate).pre_trigger if kind == "vibration" else None
        return _length(kind, rate, cutting.slicing), pre_trigger

    floor = background.floor(cutting.names, framed) if cutting.mended and cutting.model is None else np.empty(0)
    return replace(rows, background=again, donor=donor, levels_of_sources=tuple(table), floor=floor)


def _again(
    file: AnnotatedFile, parts: Sequence[AnnotatedRows], cutting: Cutting, background: Background, number: int
) -> tuple[Floats, list[str]]:
    """Return the rows of a file in other backgrounds (n_rows, N_WAYS, n_columns), and the groups these are from."""
    if cutting.slicing.by == "window":
        return _windows_again(file, cutting, background, number)
    ways = [ImpactRows(file, cutting) for _ in range(N_WAYS)]
    found: list[list[AnnotatedRows]] = [[] for _ in ways]
    waiting: list[list[Event]] = [[] for _ in ways]
    groups = dict[int, str]()  # of onsets
    for events, until, _ in cutting.ear(file).heard(file.blocks()):
        for event in events:
            others = background.again(number, event)
            changed, group = ([replace(event, problem="no silence")] * N_WAYS, "") if others is None else others
            groups[event.onset] = group
            for way, one in zip(waiting, changed, strict=True):
                way.append(one)
        if len(waiting[0]) >= _MEASURED or until == np.inf:
            for way, measuring, rows in zip(waiting, ways, found, strict=True):
                rows += measuring.feed(way, until)
                way.clear()
    # Measured in larger batches, so in another order.
    times, order = _ordered(parts)
    features = np.empty((len(order), N_WAYS, len(cutting.names)))
    for k, rows in enumerate(found):
        if rows:
            features[order, k] = np.concatenate([piece.features for piece in rows])[_ordered(rows)[1]]
    return features, [groups.get(round(time * ways[0].ear.rate), "") for time in times.tolist()]


def _ordered(parts: Sequence[AnnotatedRows]) -> tuple[Floats, NDArray[np.intp]]:
    """Return the times of rows, and their order by channel and time."""
    times = np.concatenate([np.empty(0), *(piece.times for piece in parts)])
    return times, np.lexsort((times, np.repeat([piece.channel for piece in parts], [piece.n_rows for piece in parts])))


def _windows_again(
    file: AnnotatedFile, cutting: Cutting, background: Background, number: int
) -> tuple[Floats, list[str]]:
    rate, slicing = file.recording.sampling_rate, cutting.slicing
    width = len(cutting.names) * len(file.recording.channels)
    features, groups = [np.empty((0, N_WAYS, width))], list[str]()
    for annotation, blocks in annotated_blocks(file, cutting.unit):
        for first, windows in windows_of(blocks, rate, slicing.window_time, slicing.hop_time):
            changed, names = background.windows(number, annotation, first, windows)
            n_copies = N_COPIES * len(windows) if cutting.augment else 0
            features += [np.stack([measure_windows(one, rate, cutting.names) for one in changed], axis=1)]
            features += [np.full((n_copies, N_WAYS, width), np.nan)]
            groups += names + [""] * n_copies
    return np.concatenate(features), groups


def _require_quantity(file: AnnotatedFile, model: StoredModel) -> None:
    quantity = quantity_of(file.unit)
    if quantity != model.quantity:
        raise BadData(
            f"{file.recording.source}: the quantity must be the model's, {model.quantity} [{model.unit}], got "
            f"{quantity} [{file.unit}]; give another {spelled('base')}, or correct {spelled('unit')}"
        )


def _decided(
    files: Sequence[AnnotatedFile], slicing: Slicing, features: Sequence[str] | None
) -> tuple[Slicing, tuple[str, ...], tuple[str, ...]]:
    """Return the slicing by impact or by window, a note with the reason if it was chosen here, and warnings."""
    rate = min(file.recording.sampling_rate for file in files)
    if slicing.window_time == WINDOW_TIME and rate <= 2 * MIN_BANDWIDTH:
        time = max(LOW_WINDOW_TIME, LEAST_SAMPLES / rate)
        slicing = replace(slicing, window_time=time, hop_time=slicing.hop_time * time / WINDOW_TIME)
    if slicing.by == "impact":
        return slicing, (), ()
    if slicing.by is None and features is not None:
        return replace(slicing, by="window" if kind_of(choose(features)) == "window" else "impact"), (), ()
    silence = _silence(files, slicing)
    if slicing.by is None and silence.has_single_impacts:
        note = f"trained on impacts, because {silence}; {spelled('by', 'window')} for windows"
        return replace(slicing, by="impact"), (note,), ()
    if slicing.by is None:
        other = f"{spelled('by', 'impact')} for impacts"
        note = f"trained on windows of {slicing.window_time:g} s, because only {silence}; {other}"
        return replace(slicing, by="window"), (note,), ()
    if not silence.has_single_impacts or silence.is_cut:
        return slicing, (), ()
    cure = f"leave out {spelled('by')}, or give {spelled('by', 'impact')}"
    return slicing, (), (f"most windows contain no impact, {silence}; {cure}",)


def _silence(files: Sequence[AnnotatedFile], slicing: Slicing, background: Background | None = None) -> Silence:
    """Return the impacts and silence of all files; unreadable files are reported later."""
    silence = Silence()
    for number, file in enumerate(files):
        with suppress(CgidError):
            intervals = [(one.start, one.end) for one in file.annotations]
            kind = kind_for(quantity_of(file.unit))
            hear = None if background is None else partial(background.hear, number, file)
            silence += silence_of(file.recording, kind, intervals, slicing.dead_time, hear)
    return silence


def rows_of(measured: Sequence[tuple[AnnotatedFile, list[AnnotatedRows]]], cutting: Cutting) -> Rows:
    """Return the complete rows of all files, and warnings of the damage of files and of annotations without a row."""
    recordings = [file.recording for file, _ in measured]
    pieces = [piece for _, parts in measured for piece in parts]
    features = np.concatenate([piece.features for piece in pieces])
    snr = np.concatenate([piece.snr for piece in pieces])
    complete = np.isfinite(features).all(axis=1)
    annotations = list(compress((piece.annotation for piece in pieces for _ in piece.times), complete))
    sources, source = _numbered([one.name for one in annotations])
    groups, group = _numbered([one.group for one in annotations])
    rates = [recording.sampling_rate for recording in recordings]
    warnings, measured_sources = [], set(sources)
    for file, _ in measured:
        names = dict.fromkeys(one.name for one in file.annotations)  # parts of a stretch have one name
        empty = [name for name in names if name not in measured_sources]
        message = (f"{name}: there must be {cutting.slicing.by}s that can be measured, there is none" for name in empty)
        warnings += [*file.recording.warnings, *(f"{text}; check start and end" for text in message)]
    return Rows(
        names=cutting.names,
        features=features[complete],
        labels=np.array([one.label for one in annotations]),
        group=group,
        source=source,
        sources=sources,
        groups=groups,
        digests=tuple(file.digest for file, _ in measured),
        unit=cutting.unit,
        sampling_rates=(min(rates), max(rates)),
        n_channels=len(recordings[0].channels) if cutting.slicing.by == "window" else 1,
        slicing=cutting.slicing,
        time=np.concatenate([piece.times for piece in pieces])[complete],
        file=np.repeat(np.arange(len(measured)), [sum(piece.n_rows for piece in parts) for _, parts in measured])[
            complete
        ],
        files=tuple((str(one.path), str(one.channels)) for file, _ in measured for one in file.annotations[:1]),
        channel=np.repeat([piece.channel for piece in pieces], [piece.n_rows for piece in pieces])[complete],
        same_beam=tuple(dict.fromkeys(name for file, _ in measured for name in file.beams)),
        chosen=np.array([one.chosen for one in annotations]) if any(one.chosen for one in annotations) else _NONE,
        snr=snr[complete] if cutting.augment and cutting.slicing.by == "window" else np.empty(0),
        left_out=int((~complete & (snr == np.inf)).sum()),
        warnings=tuple(warnings),
    )


def labelled(rows: Rows, manifest: Manifest) -> Rows:
    """Return the impacts that a manifest labels, of impacts that were measured once, such as without any label.

    The result is that of `record` for the same features, but for impacts that two rows of a table share.
    """
    if rows.slicing is None or rows.slicing.by != "impact":
        raise InvalidValue("rows must be impacts of recordings, got others; measure them with record(..., by impact)")
    place = {key: number for number, key in enumerate(rows.files)}
    annotations = manifest.annotations
    owner = np.full(len(rows.labels), -1)
    by_file: dict[int, list[int]] = {}
    for number, one in enumerate(annotations):
        if (file := place.get((str(one.path), str(one.channels)))) is not None:
            by_file.setdefault(file, []).append(number)
    for file, numbers in by_file.items():
        numbers.sort(key=lambda number: annotations[number].start)
        inside = np.flatnonzero(rows.file == file)
        last = np.searchsorted([annotations[number].start for number in numbers], rows.time[inside], side="right") - 1
        ends = np.array([annotations[number].end for number in numbers])
        is_in = (last >= 0) & (rows.time[inside] < ends[last])
        owner[inside[is_in]] = np.array(numbers)[last[is_in]]
    rows, owners = rows[owner >= 0], [annotations[number] for number in owner[owner >= 0].tolist()]
    sources, source = _numbered([one.name for one in owners])
    groups, group = _numbered([one.group for one in owners])
    return replace(
        rows,
        labels=np.array([one.label for one in owners], np.str_),
        chosen=np.array([one.chosen for one in owners], np.str_),
        sources=sources,
        source=source,
        groups=groups,
        group=group,
    )


def _numbered(words: list[str]) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """Return the distinct words in order of appearance, and the number of each word."""
    numbers = {word: number for number, word in enumerate(dict.fromkeys(words))}
    return tuple(numbers), np.array([numbers[word] for word in words], np.intp)


def _names(features: Sequence[str] | None, files: list[AnnotatedFile], slicing: Slicing) -> tuple[str, ...]:
    """Return the features to measure: the given ones, or those of all sets that every recording supports."""
    rates = sorted({file.recording.sampling_rate for file in files})
    kind: Kind = "window" if slicing.by == "window" else kind_for(quantity_of(files[0].unit))
    if features is not None:
        rate = rates[0]
        selected = choose(features)
        if (kind_of(selected) == "window") != (slicing.by == "window"):
            raise InvalidValue(
                f"features must be those of a {slicing.by}, got those of a {kind_of(selected)}; choose others, or "
                f"another {spelled('by')}"
            )
        require_supported(selected, rate, _length(kind_of(selected), rate, slicing))
        return selected
    return default_names(kind, rates, slicing)


def default_names(kind: Kind, rates: Sequence[float], slicing: Slicing) -> tuple[str, ...]:
    """Return the features of all sets that recordings of these rates [Hz], the lowest first, support."""
    names_of_sets = names = union_of(sets_for(kind, rates[0]))
    for rate in rates:
        names = supported(names, rate, _length(kind, rate, slicing))
    if not names:
        _refuse(names_of_sets, rates[0], slicing)
    return names


def measurable(events: Sequence[Event], kind: ImpactKind, rates: Sequence[float]) -> list[bool]:
    """Return whether a model of recordings of these rates [Hz] can be trained on each impact, found in one of them.

    Raises `BadData` if the rates leave no feature.
    """
    names, found = default_names(kind, sorted(rates), Slicing(by="impact")), [False] * len(events)
    for numbers, frames in frames_alike(events):
        first = events[numbers[0]]
        rows = extract_array(
            frames.reshape(-1, frames.shape[-1]),  # of joint channels, one must measure the impact
            first.sampling_rate,
            names,
            pre_trigger=first.pre_trigger,
            invalid="nan",
            detection_limit=first.detection_limit,
        )
        is_measured = np.isfinite(rows).all(axis=1).reshape(len(numbers), -1).any(axis=1)
        for number, one in zip(numbers, np.atleast_1d(is_measured).tolist(), strict=True):
            found[number] = one and not events[number].problem
    return found


def _refuse(names: Sequence[str], rate: float, slicing: Slicing) -> NoReturn:
    """Raise the error that the rate [Hz] or the window is too small for all features."""
    slowest = min(2 * FEATURES[name].highest_frequency for name in names)
    if rate < slowest:
        raise BadData(
            f"recordings must be sampled at {math.ceil(slowest)} Hz at least to have a feature, got {rate:g} Hz; "
            "sample faster"
        )
    shortest = min(FEATURES[name].shortest_frame for name in names if 2 * FEATURES[name].highest_frequency <= rate)
    raise InvalidValue(
        f"window must last {math.ceil(shortest * rate) / rate:.6g} s at least to have a feature at {rate:g} Hz, got "
        f"{slicing.window_time:g} s; give a longer {spelled('window_time')}"
    )


def _length(kind: Kind, rate: float, slicing: Slicing) -> int:
    """Return the number of samples of a row."""
    if kind == "window":
        return Grid.at(rate, slicing.window_time, slicing.hop_time).length
    framing = Framing.of(kind, rate)
    return framing.quiet + framing.length


@dataclass(frozen=True)
class Cutting:
    """Settings to cut rows from a file and measure them."""

    names: tuple[str, ...]
    slicing: Slicing
    unit: str
    augment: bool = False
    model: StoredModel | None = None
    mended: bool = False

    def ear(self, file: AnnotatedFile) -> Ear:
        """Return what hears the impacts of a file; with tones unless they are looked at through a beam."""
        return Ear(
            file.recording.sampling_rate,
            len(file.recording.channels),
            kind="vibration" if kind_of(self.names) == "vibration" else "pulse",
            dead_time=self.slicing.dead_time,
            lines=self.mended if self.model is None or self.model.beam is None else None,
            beam=None if self.model is None else self.model.beam,
        )

    @cached_property
    def beams(self) -> list[ThroughBeam]:
        """The beam behind each sensor of the model."""
        assert self.model is not None
        return [look.beam for look in behind_each_sensor(self.model) if look.beam is not None]

    def beam(self, file: AnnotatedFile, channel: int) -> ThroughBeam | None:
        """Return the beam behind a channel."""
        if self.model is None or self.model.beam is None:
            return None
        row = 0
        if file.is_grouped:
            row = next(rows for rows in file.groups if channel in rows).index(channel)
        return self.beams[row % len(self.beams)].of(file.recording.sampling_rate)


class AnnotatedRows(NamedTuple):
    """Some rows of an annotation: times, features, power over that of added noise [dB], and the channel of impacts."""

    annotation: Annotation
    times: Floats
    features: Floats
    snr: Floats
    channel: str = ""

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.times)


def _pieces(
    file: AnnotatedFile,
    cutting: Cutting,
    progress: Callable[[int], object] | None,
    background: tuple[Background | None, int],
) -> Iterator[AnnotatedRows]:
    for piece in _windows(file, cutting) if cutting.slicing.by == "window" else _impacts(file, cutting, *background):
        yield piece
        if progress is not None:
            progress(int(np.sum(piece.snr == np.inf)))


def _windows(file: AnnotatedFile, cutting: Cutting) -> Iterator[AnnotatedRows]:
    """Yield annotation, times and features of the windows completely inside annotated intervals."""
    rate, slicing = file.recording.sampling_rate, cutting.slicing
    for annotation, blocks in annotated_blocks(file, cutting.unit):
        copies = NoisyCopies((int(file.digest[:8], 16), round(annotation.start * rate)))
        for first, windows in windows_of(blocks, rate, slicing.window_time, slicing.hop_time):
            times = annotation.start + first / rate
            features = measure_windows(windows, rate, cutting.names)
            yield AnnotatedRows(annotation, times, features, np.full(len(times), np.inf))
            for some in range(0, len(times) if cutting.augment else 0, _COPIED):
                # Measured together: a call takes some milliseconds however few its windows are.
                snr, noisy = map(np.concatenate, zip(*copies.of(windows[some : some + _COPIED]), strict=True))
                features = measure_windows(noisy, rate, cutting.names)
                n_copies = len(snr) // len(times[some : some + _COPIED])
                yield AnnotatedRows(annotation, np.repeat(times[some : some + _COPIED], n_copies), features, snr)


def _impacts(
    file: AnnotatedFile, cutting: Cutting, background: Background | None, number: int
) -> Iterator[AnnotatedRows]:
    """Yield annotation, times and features of the impacts in annotated intervals; the detector gets all samples."""
    measuring = ImpactRows(file, cutting)
    for heard in measuring.ear.heard(file.blocks()):
        if background is not None:
            background.hear(number, file, heard, measuring.ear.rate, measuring.ear.n_samples)
        yield from measuring.feed(heard.events, heard.until)


class ImpactRows:
    """Rows of the impacts of a file as they are found: one for each channel that measures it, or for those of a beam.

    As in prediction, other channels are separate sensors.
    """

    def __init__(self, file: AnnotatedFile, cutting: Cutting) -> None:
        self._file, self._cutting, self.ear = file, cutting, cutting.ear(file)
        self._names = [channel.name for channel in file.recording.channels]
        self._rocks: RockAssigner[_Part] = RockAssigner(file.groups, self.ear.rate)

    def feed(self, events: list[Event], known_until: float) -> Iterator[AnnotatedRows]:
        """Yield the rows of further impacts, all of which before a sample are known."""
        pieces = _measured_events(events, self._file, self._cutting)
        if not self._file.is_grouped:
            for annotation, channel, times, features in pieces:
                yield AnnotatedRows(annotation, times, features, np.full(len(times), np.inf), self._names[channel])
            return
        parts = [
            _Part(channel, round(time * self.ear.rate), annotation, time, row)
            for annotation, channel, times, features in pieces
            for time, row in zip(times.tolist(), features, strict=True)
        ]
        for rock in self._rocks.feed(sorted(parts, key=lambda part: part.onset), known_until):
            rows = next(rows for rows in self._file.groups if rock[0].channel in rows)
            features, name = _of_rock(rock, self._cutting.names)[None], "+".join(self._names[row] for row in rows)
            yield AnnotatedRows(rock[0].annotation, np.array([rock[0].time]), features, np.array([np.inf]), name)


class _Part(NamedTuple):
    """What one channel measures of a rock."""

    channel: int
    onset: int
    annotation: Annotation
    time: float
    values: Floats


def _of_rock(rock: Sequence[_Part], names: tuple[str, ...]) -> Floats:
    """Return the features of a rock from those of its channels, nan if none could be measured."""
    measured = [part.values for part in rock if np.isfinite(part.values).all()]
    if len(measured) < 2:
        return (measured or [rock[0].values])[0]
    values = np.stack(measured)
    if columns := pulse_columns(names):
        # What a channel leaves unexplained tells which of two is wrong.
        misfit = values[:, names.index("beam_unexplained")] if "beam_unexplained" in names else np.zeros(len(values))
        values = values[agreeing(values[:, columns], misfit.tolist())]
    return joined(values, names)


def _measured_events(
    events: list[Event], file: AnnotatedFile, cutting: Cutting
) -> Iterator[tuple[Annotation, int, Floats, Floats]]:
    """Yield annotation, channel, times and features of the impacts in annotated intervals."""
    starts = [one.start for one in file.annotations]
    inside: dict[tuple[int, int], list[Event]] = {}
    for event in events:
        k = bisect_right(starts, event.time) - 1
        if k >= 0 and event.time < file.annotations[k].end:
            inside.setdefault((k, event.channel), []).append(event)
    for (k, channel), its_events in sorted(inside.items()):
        annotation = file.annotations[k]
        for numbers, frames in frames_alike(its_events):
            some = [its_events[number] for number in numbers]
            features = extract_array(
                frames * file.scale(annotation, cutting.unit),
                some[0].sampling_rate,
                cutting.names,
                pre_trigger=some[0].pre_trigger,
                invalid="nan",
                detection_limit=some[0].detection_limit,
                beam=cutting.beam(file, channel),
            )
            features[[bool(event.problem) for event in some]] = np.nan
            yield annotation, channel, np.array([event.time for event in some]), features
