"""The files behind a manifest, opened: what can be read, what cannot, and what must not stand on both sides."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError, MissingOption, NoInput
from cgid.files import require_regular
from cgid.identification.recorded.annotation import Annotation
from cgid.identification.recorded.manifest import Manifest
from cgid.recordings import LARGEST_STREAM, RecordingFile, open_recording
from cgid.recordings.recording import told
from cgid.units import UNITS, quantity_of


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
