"""The files behind a manifest, opened: what can be read, what cannot, and what must not stand on both sides.

The reference runs of a manifest: the spectra of its sensors.

From annotated recordings to a table of features of windows or impacts; memory holds one block of a recording.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption, NoInput
from cgid.files import require_regular
from cgid.identification.events import Event, ImpactDetector
from cgid.identification.manifest import Annotation, Manifest
from cgid.identification.reference import Equalisations, MeanSpectrum, equalisations_of
from cgid.identification.rows import sets_for, union_of
from cgid.identification.windows import WINDOW_TIME, Grid, columns_of, measure_windows, require_times, windows_of
from cgid.measure.features import FEATURES, choose, extract_array, kind_for, kind_of, require_supported, supported
from cgid.measure.features.feature import Kind
from cgid.recordings import LARGEST_STREAM, RecordingFile, open_recording
from cgid.recordings.recording_file import told
from cgid.signals import UNITS, quantity_of
from cgid.validation import Floats


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What neither files nor manifest say of recordings, and what to do about a bad one.

    Attributes
    ----------
    sampling_rate, unit, channels
        See `cgid.recordings.open_recording`.
    strict : bool
        Whether the first recording that cannot be read is an error; else it is said, and the others are read.
    """

    sampling_rate: float | None = None
    unit: str | None = None
    channels: tuple[int | str, ...] | None = None
    strict: bool = False


class Failures(list[CgidError]):
    """The recordings that could not be read, each as an error of one line."""

    def __init__(self, strict: bool) -> None:
        super().__init__()
        self._strict = strict

    def note(self, error: CgidError) -> None:
        """Keep an error, or raise it when strict."""
        if self._strict:
            raise error
        self.append(error)


@dataclass(frozen=True, kw_only=True)
class AnnotatedFile:
    """A recording that could be opened, with what is said of one choice of its channels.

    Attributes
    ----------
    annotations : tuple of Annotation
        By their start; they do not overlap.
    recording : RecordingFile
    unit : str
        Of all of its channels.
    digest : str
        SHA-256 of the file.
    """

    annotations: tuple[Annotation, ...]
    recording: RecordingFile
    unit: str
    digest: str

    def scale(self, annotation: Annotation, unit: str) -> float:
        """Return the factor from the numbers of the file to a unit before the recorder's gain."""
        units = UNITS[quantity_of(unit)]
        return units[self.unit] / units[unit] / annotation.gain


def open_all(
    manifest: Manifest, reading: Reading, failures: Failures, *, references: bool = False
) -> list[AnnotatedFile]:
    """Return the recordings of a manifest that can be opened, all of one quantity and number of channels.

    Parameters
    ----------
    manifest : Manifest
    reading : Reading
    failures : Failures
        Where those go that cannot.
    references : bool
        Whether the reference runs are meant instead of the labelled recordings.

    Raises
    ------
    BadData
        None can be opened, or two files of different groups hold the same.
    """
    files: list[AnnotatedFile] = []
    for own in _by_channels([one for one in manifest.annotations if one.reference == references]):
        try:
            file = _opened(own, reading)
            _require_alike(file, (files or [file])[0])
            files.append(file)
        except CgidError as error:
            failures.note(error)
    if not files and not references:
        raise BadData(
            f"{manifest.source}: there must be a recording that can be read, there is none"
            + "".join(f"; {error}" for error in failures[:1])
        )
    _refuse_copies(files)
    return files


def annotated_blocks(file: AnnotatedFile, unit: str) -> Iterator[tuple[Annotation, Iterator[NDArray[np.floating]]]]:
    """Yield each annotation with the blocks of what it speaks of, in a unit and before the recorder's gain.

    The blocks of one must be taken before the next is asked for: the file is read once, block by block.
    """
    rate = file.recording.sampling_rate
    bounds = [(round(one.start * rate), one.end * rate) for one in file.annotations]
    for k, own in groupby(_cut(file.recording.blocks(), bounds), lambda part: part[0]):
        scale = file.scale(file.annotations[k], unit)
        yield file.annotations[k], (samples * scale for _, samples in own)


def _cut(blocks: Iterator[NDArray[Any]], bounds: Sequence[tuple[int, float]]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield what of each block lies in which interval of samples; the intervals rise and do not overlap."""
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
    """Return the annotations of the same channels of the same file together, by their start."""
    together: dict[tuple[str, str], list[Annotation]] = {}
    for one in annotations:
        together.setdefault((str(one.path), str(one.channels)), []).append(one)
    return [tuple(sorted(own, key=lambda one: one.start)) for own in together.values()]


def _opened(annotations: tuple[Annotation, ...], reading: Reading) -> AnnotatedFile:
    first = annotations[0]
    with told(str(first.path)):  # a manifest may name anything, and a pipe would be copied
        require_regular(first.path, "a recording of a manifest", LARGEST_STREAM)
    recording = open_recording(
        first.path,
        sampling_rate=first.sampling_rate or reading.sampling_rate,
        unit=first.unit or reading.unit,
        channel=first.channels or reading.channels,
        variable=first.variable,
    )
    units = {channel.unit for channel in recording.channels}
    unit = recording.channels[0].unit
    if unit is None:
        raise MissingOption(
            f"{recording.source}: the file does not say the unit; give it with --unit U, such as --unit g"
        )
    if len(units) > 1:
        got = " and ".join(sorted(str(unit) for unit in units))
        raise BadData(f"{recording.source}: channels must be in one unit, got {got}; choose with --channel")
    try:
        with first.path.open("rb") as content:
            digest = hashlib.file_digest(content, "sha256").hexdigest()
    except OSError as error:
        raise NoInput(f"{first.path}: the file cannot be read ({error.strerror}); check it") from None
    return AnnotatedFile(annotations=annotations, recording=recording, unit=unit, digest=digest)


def _require_alike(file: AnnotatedFile, first: AnnotatedFile) -> None:
    source = file.recording.source
    if quantity_of(file.unit) != quantity_of(first.unit):
        raise BadData(
            f"{source}: recordings must be of one quantity, got {quantity_of(file.unit)} [{file.unit}] after "
            f"{quantity_of(first.unit)} [{first.unit}]; train apart"
        )
    count, wanted = len(file.recording.channels), len(first.recording.channels)
    if count != wanted:
        raise BadData(
            f"{source}: recordings must have as many channels each, got {count} after {wanted}; choose with --channel, "
            "or channel in the manifest"
        )


def _refuse_copies(files: list[AnnotatedFile]) -> None:
    """Raise where two files of different groups hold the same: what is trained on would judge."""
    seen: dict[str, AnnotatedFile] = {}
    for file in files:
        first = seen.setdefault(file.digest, file)
        if first.annotations[0].group != file.annotations[0].group:
            raise BadData(
                f"{file.recording.source}: recordings of different groups must differ, it holds the same as "
                f"{first.recording.source}; take one out, or give both one group"
            )


def reference_spectra(files: Sequence[AnnotatedFile], labelled: AnnotatedFile, window_time: float) -> dict[str, Floats]:
    """Return the reference spectrum of each sensor, (n_channels, n_bands), from the runs of all of its files.

    Parameters
    ----------
    files : sequence of AnnotatedFile
        The reference runs.
    labelled : AnnotatedFile
        One of the recordings that they are for: what quantity, and how many channels.
    window_time : float
        Of the windows that are averaged [s].

    Raises
    ------
    BadData
        A run is of another quantity or number of channels, or holds nothing.
    """
    spectra: dict[str, list[MeanSpectrum]] = {}
    for file in files:
        source, n_channels = file.recording.source, len(labelled.recording.channels)
        if quantity_of(file.unit) != quantity_of(labelled.unit) or len(file.recording.channels) != n_channels:
            raise BadData(
                f"{source}: a reference run must be as the recordings, {quantity_of(labelled.unit)} in {n_channels} "
                f"channels, got {quantity_of(file.unit)} in {len(file.recording.channels)}; record it in the same way"
            )
        rate = file.recording.sampling_rate
        for annotation, blocks in annotated_blocks(file, labelled.unit):
            own = spectra.setdefault(annotation.sensor, [MeanSpectrum(rate) for _ in range(n_channels)])
            if own[0].sampling_rate != rate:
                raise BadData(f"{source}: the reference runs of a sensor must be sampled alike; take one out")
            for _, windows in windows_of(blocks, rate, window_time, window_time):
                for channel, spectrum in enumerate(own):
                    spectrum.feed(windows[:, channel])
    return {sensor: np.stack([spectrum.levels for spectrum in own]) for sensor, own in spectra.items()}


@dataclass(frozen=True, kw_only=True)
class Slicing:
    """How recordings become rows.

    Attributes
    ----------
    by : {"window", "impact"}
        What is decided on.
    window_time, hop_time : float
        Length of a window, and from the start of one to that of the next [s].
    dead_time : float or None
        Of impacts [s]: see `cgid.identification.events.ImpactDetector`.
    """

    by: Literal["window", "impact"] = "window"
    window_time: float = WINDOW_TIME
    hop_time: float = WINDOW_TIME / 2
    dead_time: float | None = None

    def __post_init__(self) -> None:
        validation.choice("by", self.by, ("window", "impact"))
        require_times(self.window_time, self.hop_time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """The features of all labelled windows or impacts of recordings.

    Attributes
    ----------
    slicing : Slicing
    names : tuple of str
        Features, measured on each of `n_channels` channels.
    features : ndarray, (n_rows, n_channels * n_names)
        Channel after channel.
    labels : ndarray of str, (n_rows,)
    time : ndarray, (n_rows,)
        When a window starts or an impact comes, in its recording [s].
    piece, group : ndarray of int, (n_rows,)
        Which of `pieces` (annotated intervals) and which of `groups` each belongs to.
    unit : str
    sampling_rates : tuple of float
        Lowest and highest [Hz].
    sources : tuple of str
        SHA-256 of the files.
    references : dict of ndarray, each (n_channels, n_bands)
        Reference spectra of the sensors.
    left_out : int
        Rows that could not be measured.
    failures : tuple of CgidError
        The recordings that could not be read.
    warnings : tuple of str
        What is damaged in others and was left out, and intervals in which there is nothing; one line each.
    """

    slicing: Slicing
    names: tuple[str, ...]
    n_channels: int
    features: Floats
    labels: NDArray[np.str_]
    time: Floats
    piece: NDArray[np.intp]
    group: NDArray[np.intp]
    pieces: tuple[str, ...]
    groups: tuple[str, ...]
    unit: str
    sampling_rates: tuple[float, float]
    sources: tuple[str, ...]
    references: Mapping[str, Floats] = field(default_factory=dict)
    left_out: int = 0
    failures: tuple[CgidError, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def kind(self) -> Kind:
        """What the features are measured on."""
        return kind_of(self.names)

    def only(self, names: tuple[str, ...]) -> Recorded:
        """Return the same rows with some of the features."""
        columns = columns_of(self.names, names, self.features.shape[1])
        return replace(self, names=names, features=self.features[:, columns])


def record(
    manifest: Manifest,
    features: Sequence[str] | None = None,
    *,
    slicing: Slicing | None = None,
    reading: Reading | None = None,
    level_free: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Recorded:
    """Return the features of the windows or impacts of annotated recordings.

    Parameters
    ----------
    manifest : Manifest
    features : sequence of str, optional
        Names of features; if not given, all that `cgid.identification.rows` has for the
        kind and that can be measured on all of them.
    slicing : Slicing, optional
    reading : Reading, optional
    level_free : bool
        Whether only features are measured in which the gain of the sensor cancels, if none are named.
    progress : callable, optional
        Called with the number of rows measured.

    Raises
    ------
    CgidError
        That of the first recording that cannot be read, when strict.
    BadData
        No recording can be read, none has a window or an impact, or two files in different groups hold the same.
    InvalidValue
        A choice breaks its rule.
    """
    slicing, reading = slicing or Slicing(), reading or Reading()
    failures = Failures(reading.strict)
    files = open_all(manifest, reading, failures)
    names = _names(features, files, slicing, level_free)
    references = reference_spectra(
        open_all(manifest, reading, Failures(strict=True), references=True), files[0], slicing.window_time
    )
    equalisations = equalisations_of(references)
    measured: list[_Rows] = []
    for file in files:
        try:
            measured.append(_measured(file, names, slicing, files[0].unit, equalisations, progress))
        except CgidError as error:
            failures.note(error)
    annotations = [one for rows in measured for one in rows.annotations]
    if not annotations:
        told = "".join(f"; {error}" for error in failures[:1])
        raise BadData(
            f"{manifest.source}: recordings must hold a {slicing.by} with a label, there is none{told}; "
            "correct start and end, or what is decided on"
        )
    pieces, piece = _numbered([one.name for one in annotations])
    groups, group = _numbered([one.group for one in annotations])
    rates = [rows.file.recording.sampling_rate for rows in measured]
    return Recorded(
        slicing=slicing,
        names=names,
        n_channels=len(files[0].recording.channels),
        features=np.concatenate([part for rows in measured for part in rows.features]),
        labels=np.array([one.label for one in annotations]),
        time=np.concatenate([part for rows in measured for part in rows.times]),
        piece=piece,
        group=group,
        pieces=pieces,
        groups=groups,
        unit=files[0].unit,
        sampling_rates=(min(rates), max(rates)),
        sources=tuple(rows.file.digest for rows in measured),
        references=references,
        left_out=sum(rows.left_out for rows in measured),
        failures=tuple(failures),
        warnings=tuple(warning for rows in measured for warning in rows.warnings(slicing.by)),
    )


def _numbered(words: list[str]) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """Return the different words in their order, and the number of each."""
    different = tuple(dict.fromkeys(words))
    numbers = {word: number for number, word in enumerate(different)}
    return different, np.array([numbers[word] for word in words], np.intp)


def _names(
    features: Sequence[str] | None, files: list[AnnotatedFile], slicing: Slicing, level_free: bool
) -> tuple[str, ...]:
    """Return what to measure: what is asked, or all of the sets that can be measured everywhere."""
    rate = min(file.recording.sampling_rate for file in files)
    n_channels = len(files[0].recording.channels)
    if slicing.by == "impact" and n_channels > 1:
        raise InvalidValue(
            f"impacts must be those of one channel, got {n_channels}; choose with --channel, or decide on windows"
        )
    kind: Kind = "window" if slicing.by == "window" else kind_for(quantity_of(files[0].unit))
    if features is not None:
        asked = choose(features)
        if (kind_of(asked) == "window") != (slicing.by == "window"):
            raise InvalidValue(
                f"features must be those of the {slicing.by} that is decided on, got those of a {kind_of(asked)}; "
                "choose others, or another --by"
            )
        require_supported(asked, rate, _length(kind_of(asked), rate, slicing))
        return asked
    wanted = union_of(sets_for(kind, level_free=level_free))
    if not wanted:
        raise InvalidValue(f"features of a {kind} must be named, there is no set of level-free ones; or allow all")
    names = supported(wanted, rate, _length(kind, rate, slicing))
    if not names:
        _refuse(wanted, rate, slicing)
    return names


def _refuse(wanted: Sequence[str], rate: float, slicing: Slicing) -> NoReturn:
    """Say whether the rate [Hz] or the window is too small for all features."""
    slowest = min(2 * FEATURES[name].highest_frequency for name in wanted)
    if rate < slowest:
        raise BadData(
            f"recordings must be sampled at {math.ceil(slowest)} Hz at least to have a feature, got {rate:g} Hz; "
            "sample faster"
        )
    shortest = min(FEATURES[name].shortest_frame for name in wanted if 2 * FEATURES[name].highest_frequency <= rate)
    raise InvalidValue(
        f"window must last {math.ceil(shortest * rate) / rate:.6g} s at least to have a feature at {rate:g} Hz, got "
        f"{slicing.window_time:g} s; give a longer --window"
    )


def _length(kind: Kind, rate: float, slicing: Slicing) -> int:
    """Return how many samples are measured together."""
    if kind == "window":
        return Grid.at(rate, slicing.window_time, slicing.hop_time).length
    return ImpactDetector(rate, kind="pulse" if kind == "pulse" else "vibration").n_samples


# -- one file ---------------------------------------------------------------------------------------------


@dataclass
class _Rows:
    """What was measured on one file."""

    file: AnnotatedFile
    features: list[Floats] = field(default_factory=list)
    times: list[Floats] = field(default_factory=list)
    annotations: list[Annotation] = field(default_factory=list)
    left_out: int = 0

    def warnings(self, by: str) -> tuple[str, ...]:
        """Return what is damaged in the file, and which of its annotations speak of nothing."""
        held = {one.name for one in self.annotations}
        empty = [one.name for one in self.file.annotations if one.name not in held]
        said = (f"{name}: there must be {by}s to be measured, there is none; check start and end" for name in empty)
        return (*self.file.recording.warnings, *said)


def _measured(
    file: AnnotatedFile,
    names: tuple[str, ...],
    slicing: Slicing,
    unit: str,
    equalisations: Equalisations,
    progress: Callable[[int], object] | None,
) -> _Rows:
    rows = _Rows(file)
    measure = _windows if slicing.by == "window" else _impacts
    for annotation, times, features in measure(file, names, slicing, unit, equalisations):
        sound = np.isfinite(features).all(axis=1)
        rows.left_out += int((~sound).sum())
        rows.features.append(features[sound])
        rows.times.append(times[sound])
        rows.annotations += [annotation] * int(sound.sum())
        if progress is not None:
            progress(len(times))
    return rows


Measured = Iterator[tuple[Annotation, Floats, Floats]]


def _windows(
    file: AnnotatedFile, names: tuple[str, ...], slicing: Slicing, unit: str, equalisations: Equalisations
) -> Measured:
    """Yield annotation, times and features of the windows that lie in annotated intervals as a whole."""
    rate = file.recording.sampling_rate
    for annotation, blocks in annotated_blocks(file, unit):
        equalisation = equalisations.get(annotation.sensor)
        for first, windows in windows_of(blocks, rate, slicing.window_time, slicing.hop_time):
            times = annotation.start + first / rate
            yield annotation, times, measure_windows(windows, rate, names, equalisation)


def _impacts(
    file: AnnotatedFile, names: tuple[str, ...], slicing: Slicing, unit: str, equalisations: Equalisations
) -> Measured:
    """Yield annotation, times and features of the impacts in annotated intervals; all of the recording is heard."""
    recording = file.recording
    detector = ImpactDetector(
        recording.sampling_rate,
        kind="vibration" if kind_of(names) == "vibration" else "pulse",
        dead_time=slicing.dead_time,
    )
    for block in recording.blocks():
        yield from _measured_events(detector.feed(block), file, names, unit, equalisations)
    yield from _measured_events(detector.finish(), file, names, unit, equalisations)


def _measured_events(
    events: list[Event], file: AnnotatedFile, names: tuple[str, ...], unit: str, equalisations: Equalisations
) -> Measured:
    for annotation in file.annotations:
        own = [event for event in events if annotation.start <= event.time < annotation.end]
        alike: dict[tuple[int | None, float], list[Event]] = {}
        for event in own:
            alike.setdefault((event.pre_trigger, event.detection_limit), []).append(event)
        for (pre_trigger, detection_limit), some in alike.items():
            features = extract_array(
                np.stack([event.samples for event in some]) * file.scale(annotation, unit),
                file.recording.sampling_rate,
                names,
                pre_trigger=pre_trigger,
                invalid="nan",
                detection_limit=detection_limit,
                equalisation=equalisations[annotation.sensor][0] if annotation.sensor else None,
            )
            features[[bool(event.problem) for event in some]] = np.nan
            yield annotation, np.array([event.time for event in some]), features
