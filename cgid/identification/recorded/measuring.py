"""From annotated recordings to a table of features of windows or impacts; memory holds one block of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData, CgidError, InvalidValue
from cgid.identification.detection import ImpactDetector
from cgid.identification.events import Event, frames_alike
from cgid.identification.recorded.annotated import AnnotatedFile, Failures, Reading, annotated_blocks, open_all
from cgid.identification.recorded.annotation import Annotation
from cgid.identification.recorded.feature_sets import sets_for, union_of
from cgid.identification.recorded.manifest import Manifest
from cgid.identification.recorded.referenced import reference_spectra
from cgid.identification.reference import Equalisations, equalisations_of
from cgid.identification.windows import WINDOW_TIME, Grid, columns_of, measure_windows, require_times, windows_of
from cgid.measure.features import FEATURES, choose, extract_array, kind_for, kind_of, require_supported, supported
from cgid.measure.features.feature import Kind
from cgid.signals import quantity_of
from cgid.validation import Floats


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
        Of impacts [s]: see `cgid.identification.detection.ImpactDetector`.
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
        Names of features; if not given, all that `cgid.identification.recorded.feature_sets` has for the
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
        for numbers, frames in frames_alike(own):
            some = [own[number] for number in numbers]
            features = extract_array(
                frames * file.scale(annotation, unit),
                file.recording.sampling_rate,
                names,
                pre_trigger=some[0].pre_trigger,
                invalid="nan",
                detection_limit=some[0].detection_limit,
                equalisation=equalisations[annotation.sensor][0] if annotation.sensor else None,
            )
            features[[bool(event.problem) for event in some]] = np.nan
            yield annotation, np.array([event.time for event in some]), features
