"""Recordings read block by block: the `Blocks` of a file, and a `RecordingFile`, with the settings of the user."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid._lib.validation import STATED_RATE, rates_agree, require_rate, whole
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption, NoInput, optional
from cgid.recordings.chain import Chain, scaled
from cgid.recordings.gaps import COUNTED, Gaps, counts, is_name_of_counter, without_fillers
from cgid.signals import Signal, channel_name
from cgid.units import meaning_of, quantity_of

if TYPE_CHECKING:
    from cgid.recordings.site import Site

#: Default length of a block [samples].
BLOCK_LENGTH = 1 << 16

#: Most numbers in a block, of all channels together.
MAX_NUMBERS = 1 << 22

#: Maximum number of channels; a file with more has its samples along the wrong axis.
MAX_CHANNELS = 4096

#: Names of a column of labels.
LABELS = ("label", "labels", "class", "material", "标签")

#: Channels that begin within this part of a sample are simultaneous.
SIMULTANEOUS = 0.05

#: Largest arrays that a format read completely may unpack to [bytes].
MAX_ARRAYS = 2 << 30

#: (block length, channels) -> blocks (len(channels), at most length), from the first sample on; of a file that can be
#: read from any place also (block length, channels, first sample).
ReadBlocks = Callable[..., Iterator[NDArray[Any]]]


def dataset_hint() -> str:
    """Return what to do with a dataset where a recording is wanted."""
    return f"read it with cgid.Dataset, or pick one of its signals with {spelled('index', '0')}"


class Remark(str):
    """A warning that does not concern damage."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What the user says of a file that its reader must know: which array, its rate [Hz], to skip broken lines."""

    variable: str | None = None
    sampling_rate: float | None = None
    skip_broken: bool = False


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Samples of a file and their metadata, as the reader of a format returns them.

    Attributes
    ----------
    n_channels : int
    read : callable
        ``read(length, channels)`` yields these channels, a sequence counted from 0, as arrays (len(channels), at most
        `length`) of float32 or float64. Each call begins with the first sample, because a recording may be read several
        times. A block may also be a pair (index of its first sample, array): missing samples before it are a gap, and
        later times stay correct.
    seekable : bool
        Whether ``read(length, channels, first)`` begins with the sample `first` without reading those before it.
    n_samples : int or None
        Per channel; None if unknown before reading.
    names : sequence of str
        One per channel, "" without one.
    is_named : bool
        Whether an only channel is called by its name, and not by its number.
    units : sequence of str or None
        One per channel, None if unknown.
    sampling_rate : float or None
        [Hz]; None if the file does not state it.
    rate_from : str
        Part of the file that states the sampling rate, for messages.
    fallback_unit : str or None
        Unit if neither the file nor the user states one, such as "FS".
    full_scales : sequence of float or None
        Number at full scale of each channel: 1 in a sound file, 2^15 for integers of 16 bit.
    integers : sequence of bool
        Whether the samples of each channel were integers, whose scale the unit alone does not give.
    sensitivities, gains : sequence of str or None
        One per channel, such as "10.2 mV/g"; for samples in volts or coulombs.
    start_time : datetime or None
        Time of the first sample.
    starts : sequence of datetime
        That of each channel where they may differ; channels that do not begin together are not read together.
    gaps : sequence of (int, int)
        Index among the stored samples of each that follows a gap, and the number of samples missing before it, which
        `n_samples` includes.
    labels : callable or None
        Yields the first sample, the one after the last and the text of each stretch with a label.
    warnings : list of str
        One line for each damaged part that was skipped; may grow during reading.

    Examples
    --------
    >>> blocks = Blocks.of_array(np.zeros((2, 1000)), sampling_rate=51_200.0, units=["N", "m/s^2"])
    >>> [block.shape for block in blocks.read(600, [1])]
    [(1, 600), (1, 400)]
    """

    n_channels: int
    read: Callable[..., Iterator[NDArray[Any] | tuple[int, NDArray[Any]]]]
    n_samples: int | None = None
    seekable: bool = False
    names: Sequence[str] = ()
    is_named: bool = False
    units: Sequence[str | None] = ()
    sampling_rate: float | None = None
    rate_from: str = "header"
    fallback_unit: str | None = None
    full_scales: Sequence[float | None] = ()
    integers: Sequence[bool] = ()
    sensitivities: Sequence[str | None] = ()
    gains: Sequence[str | None] = ()
    start_time: datetime | None = None
    starts: Sequence[datetime | None] = ()
    gaps: Sequence[tuple[int, int]] = ()
    labels: Callable[[], Iterator[tuple[int, int, str]]] | None = None
    warnings: list[str] = field(default_factory=list)

    @classmethod
    def of_array(cls, samples: NDArray[Any], **about: Any) -> Blocks:
        """Return the blocks of an array in memory.

        Parameters
        ----------
        samples : array (n_channels, n_samples)
        **about
            Other attributes.

        Returns
        -------
        Blocks
        """

        def read(length: int, channels: Sequence[int], start: int = 0) -> Iterator[NDArray[Any]]:
            for first in range(start, samples.shape[1], length):
                yield samples[list(channels), first : first + length]

        about = {"n_samples": samples.shape[1], "seekable": True, **about}
        return cls(n_channels=samples.shape[0], read=read, **about)

    def joined(self, length: int, channels: Sequence[int], start: int = 0) -> Iterator[NDArray[Any]]:
        """Yield the blocks of `read` in order, from the sample `start` on, with nan where samples are missing."""
        if start and not (self.seekable and not self.gaps):
            for whole_block in self.joined(length, channels):
                if start < whole_block.shape[1]:
                    yield whole_block[:, start:]
                start = max(start - whole_block.shape[1], 0)
            return
        count = start
        blocks = self.read(length, channels, start) if start else self.read(length, channels)
        for block in _shifted(blocks, self.gaps) if self.gaps else blocks:
            first, samples = block if isinstance(block, tuple) else (count, block)
            if first < count or samples.shape[0] != len(channels):
                raise BadData(
                    f"a block must be of {len(channels)} channels and begin at sample {count} or later, got shape "
                    f"{samples.shape} at {first}; correct the reader of the format"
                )
            while count < first:
                n = min(length, first - count)
                yield np.full((len(channels), n), np.nan, samples.dtype)
                count += n
            count += samples.shape[1]
            yield samples

    def require_channels(self, source: str) -> None:
        """Raise `BadData` if there are no samples, or if rows and columns look swapped."""
        if not self.n_channels or self.n_samples == 0:
            raise BadData(f"{source}: a recording must contain at least one sample, there is none; record it again")
        if self.n_channels > MAX_CHANNELS:
            raise BadData(
                f"{source}: at most {MAX_CHANNELS} channels, got {self.n_channels} of {self.n_samples or 'some'} "
                "samples; transpose it if each row is a channel"
            )

    def name(self, index: int) -> str:
        """Return the name of a channel, "" without one."""
        return self.names[index] if index < len(self.names) else ""

    def label(self, index: int) -> str:
        """Return the name of a channel, its number from 1 if it has none, or both if the name is not unique."""
        if (self.n_channels == 1 and not self.is_named) or not self.name(index):
            return str(index + 1)
        name = self.name(index)
        return name if self.names.count(name) == 1 else _numbered(index, name)

    def selected(self, channel: int | str, source: str, option: str = "") -> list[int]:
        """Return the indices of the selected channels: a number from 1, a name, or several as in 1+2."""
        if not (isinstance(channel, str) and "+" in channel):
            return [self._index(channel, source, option)]
        try:  # a name may contain a plus sign
            return [self._index(channel, source, option)]
        except InvalidValue:
            return [self._index(part.strip(), source, option) for part in channel.split("+")]

    def _index(self, channel: int | str, source: str, option: str) -> int:
        """Return the index of a channel from its number, its name, or both as in `label`."""
        names = [self.name(index) for index in range(self.n_channels)]
        if isinstance(channel, str) and channel and names.count(channel) == 1:
            return names.index(channel)
        labels = [_numbered(index, name) for index, name in enumerate(names)]
        if channel in labels:
            return labels.index(str(channel))
        text = str(channel)
        # Compare as text: True would otherwise be channel 1.
        if text.isascii() and text.isdigit() and len(text) < 9:
            number = int(text)
            if 1 <= number <= len(names):
                return number - 1
        listed, more = ", ".join(labels[:20]), ", ..." if len(names) > 20 else ""
        fault = "is the name of several" if text and names.count(text) > 1 else "is none of them"
        raise InvalidValue(
            f"{source}: channel {channel!r} {fault}; choose one of {listed}{more} by {option or spelled('channel')}"
        )

    def rate(self, given: float | None, source: str) -> float:
        """Return the sampling rate [Hz] of the user, else of the file; one that the user overrules is told."""
        stated = self.sampling_rate
        if given is None:
            if stated is None:
                cure = f"give it with {spelled('sampling_rate', 'HZ')}"
                raise MissingOption(f"{source}: the file does not state the sampling rate; {cure}")
            if not (np.isfinite(stated) and stated > 0):
                raise BadData(
                    f"{source}: sampling rate must be above 0 and finite, the {self.rate_from} states {stated:g} Hz; "
                    f"give it with {spelled('sampling_rate', 'HZ')}"
                )
            return stated
        if stated is not None and not rates_agree(given, stated):
            # Some recorders write the nearest rate of a sound card into a WAV, where nobody can correct it.
            says = f"the {self.rate_from} states {stated:.10g} Hz"
            self.warnings.append(Remark(f"{says}; {given:.10g} Hz is used, as given"))
        return given

    def unit(self, index: int, given: str | None, source: str) -> str | None:
        """Return the unit of a channel stated by file or user, which must agree."""
        stated = self.units[index] if index < len(self.units) else None
        if given is None or stated is None:
            return given or stated or self.fallback_unit
        if meaning_of(given) == meaning_of(stated):
            return stated
        raise BadData(
            f"{source}: channel {self.label(index)} must be in one unit, its header states {stated} "
            f"({quantity_of(stated)}) and {spelled('unit')} states {given} ({quantity_of(given)}); leave it out or "
            f"correct the header, or pick another channel with {spelled('channel')}"
        )


def _shifted(
    blocks: Iterable[NDArray[Any] | tuple[int, NDArray[Any]]], gaps: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, NDArray[Any]]]:
    count = 0
    for block in blocks:
        assert not isinstance(block, tuple)
        yield from with_gaps(places_of(count + np.arange(block.shape[1]), gaps), block)
        count += block.shape[1]


def places_of(stored: NDArray[np.int64], gaps: Sequence[tuple[int, int]]) -> NDArray[np.int64]:
    """Return the places in the recording of stored samples."""
    lost = np.cumsum([0, *(number for _, number in gaps)])
    return np.asarray(stored + lost[np.searchsorted([start for start, _ in gaps], stored, side="right")])


def stretches(words: Iterable[tuple[int, str]]) -> Iterator[tuple[int, int, str]]:
    """Yield begin, end and text of the runs of one word of samples, each given with its place; "" is none."""
    begin, end, label = 0, 0, ""
    for place, word in words:
        if word != label:
            yield from [(begin, end, label)] if label else []
            begin, label = place, word
        end = place + 1
    yield from [(begin, end, label)] if label else []


def with_gaps(places: NDArray[np.int64], samples: NDArray[Any]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield samples, (n_channels, n), of these places in the recording by pieces without a gap, each with its first."""
    ends = np.flatnonzero(np.diff(places) > 1) + 1
    for first, end in pairwise([0, *ends.tolist(), len(places)]):
        if end > first:
            yield int(places[first]), samples[:, first:end]


def _numbered(index: int, name: str) -> str:
    return f"{index + 1} ({name})" if name else str(index + 1)


def require_one_rate(
    first: tuple[float, str], second: tuple[float, str], source: str, tolerance: float = STATED_RATE
) -> None:
    """Raise `BadData` unless two sampling rates [Hz] of a recording agree; each comes with its origin."""
    if not rates_agree(first[0], second[0], tolerance):
        other = "" if first[1] == second[1] else f"{second[1]} states "
        raise BadData(
            f"{source}: the sampling rate must be one to {100 * tolerance:g} %, {first[1]} states {first[0]:.10g} Hz "
            f"and {other}{second[0]:.10g} Hz; correct one"
        )


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One channel of a recording.

    Attributes
    ----------
    name : str
        Name in the file, else number from 1; 1 for an only channel.
    unit : str or None
        None if neither the file nor the user states it.
    origin : str
        Origin of the samples, such as "from V, sensitivity 10.2 mV/g"; "" if they are the numbers of the file.
    stated : str
        Name in the file, "" without one.
    """

    name: str
    unit: str | None = None
    origin: str = field(default="", repr=False, compare=False)
    stated: str = field(default="", repr=False, compare=False)

    @property
    def quantity(self) -> str | None:
        """Physical quantity of the unit; None if the unit is unknown."""
        return None if self.unit is None else quantity_of(self.unit)


class RecordingFile:
    """A recording that is read by blocks and may be larger than memory; made by `open_recording`.

    Attributes
    ----------
    source : str
        File name.
    format : str
        Such as "WAV".
    sampling_rate : float
        [Hz].
    channels : tuple of Channel
        The selected channels.
    n_samples : int or None
        Per channel, as the file states; None if unknown before reading.
    start_time : datetime or None
        Time of the first sample, if the file states it.
    starts : tuple of datetime or None
        That of each channel, empty where all have one.
    beams : tuple of tuple of str
        Channels of each beam with several, as the site states them.
    """

    def __init__(
        self,
        contents: Blocks,
        *,
        source: str,
        format: str,
        sampling_rate: float | None,
        unit: str | None,
        channel: int | str | Sequence[int | str] | None,
        chain: Chain | None = None,
        site: Site | None = None,
    ) -> None:
        contents.require_channels(source)
        self.beams: tuple[tuple[str, ...], ...] = ()
        if site is not None:
            contents, chain = site.applied(contents, chain or Chain(), source)
            self.beams = site.beams(contents, source)
            sampling_rate = site.get("rate") if sampling_rate is None else sampling_rate
            channel = site.get("channel") if channel is None else channel
        self._contents = contents
        self._selected = _selected(contents, channel, source)
        if channel is None and contents.n_channels > 1 and (counters := _counters(contents)):
            self._selected = tuple(index for index in self._selected if index not in counters)
            names = ", ".join(contents.label(index) for index in counters)
            contents.warnings.append(Remark(f"channel {names} only counts and is left out"))
            if not self._selected:
                raise BadData(f"{source}: a recording must have a channel that does not only count; record it again")
        self.source, self.format = source, format
        self.sampling_rate = require_rate(contents.rate(sampling_rate, source))
        if contents.starts:
            _require_one_start(contents, self._selected, self.sampling_rate, source)
        links = (chain or Chain()).links(contents, self._selected, unit, source)
        self._factors = [link.factor for link in links]
        self.channels = tuple(
            Channel(name=contents.label(index), unit=link.unit, origin=link.origin, stated=contents.name(index))
            for index, link in zip(self._selected, links, strict=True)
        )
        self.n_samples, self.start_time = contents.n_samples, contents.start_time
        self.starts = tuple(contents.starts[index] for index in self._selected) if contents.starts else ()

    def __repr__(self) -> str:
        channels = ", ".join(f"{channel.name} [{channel.unit or 'unit unknown'}]" for channel in self.channels[:4])
        more = f" and {len(self.channels) - 4} more" if len(self.channels) > 4 else ""
        length = "samples" if self.n_samples is None else f"{self.n_samples} samples"
        return (
            f"RecordingFile({self.source!r}, {self.format}: {length} at {self.sampling_rate:g} Hz of "
            f"channel{'s' * (len(self.channels) > 1)} {channels}{more})"
        )

    @property
    def duration(self) -> float | None:
        """Duration [s]; None if unknown before reading."""
        return None if self.n_samples is None else self.n_samples / self.sampling_rate

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damaged parts that were skipped, one line each; complete once all blocks have been read."""
        return tuple(f"{self.source}: {warning}" for warning in self.messages)

    @property
    def messages(self) -> tuple[str, ...]:
        """The warnings without the name of the source."""
        return tuple(dict.fromkeys(self._contents.warnings))

    @property
    def damage(self) -> tuple[str, ...]:
        """The warnings, without remarks."""
        return tuple(one for one in self.messages if not isinstance(one, Remark))

    def named(
        self, groups: Sequence[Sequence[str]], option: str, *, all_read: bool = True
    ) -> tuple[tuple[str, ...], ...]:
        """Return the names of groups of channels, each given by its name or its number in the file, from 1.

        Raises `InvalidValue` for channels that are not selected; unless `all_read`, a group of such channels is left
        out.
        """
        found = []
        for group in groups:
            rows = [row for one in group for row in self._contents.selected(one, self.source, option)]
            if lacking := [row for row in rows if row not in self._selected]:
                if len(lacking) == len(rows) and not all_read:
                    continue
                raise InvalidValue(
                    f"{self.source}: {option} must name channels that are read, {self._contents.label(lacking[0])} is "
                    f"not; add it to {spelled('channel')}, or leave it out"
                )
            found.append(tuple(self._contents.label(row) for row in rows))
        return tuple(found)

    def gaps(self, rows: Sequence[int], *, joint: bool = False) -> Gaps:
        """Return a marker of gaps in some channels for one reading, adding to `warnings`; arguments as in `Gaps`."""
        channels = [self.channels[row] for row in rows]
        return Gaps(channels, self.sampling_rate, self.note, joint=joint)

    def note(self, text: str) -> None:
        """Add a line to `warnings`."""
        self._contents.warnings.append(text)

    def blocks(self, length: int = BLOCK_LENGTH, *, gaps: bool = False) -> Iterator[NDArray[Any]]:
        """Return an iterator over the samples in order, (n_channels, at most `length`), float32 or float64.

        Parameters
        ----------
        length : int
            Samples of a block; the last one may be shorter.
        gaps : bool
            Whether to yield numbers that are not finite unchanged; otherwise the first one is an error.

        Raises
        ------
        BadData
            A number is not finite (the message names channel and sample), or damage cannot be skipped.
        NoInput
            The file has disappeared or is no longer readable.
        """
        blocks = self._blocks(length)
        return blocks if gaps else self._finite(blocks)

    def _finite(self, blocks: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        first = 0
        for block in blocks:
            finite = np.isfinite(block)
            if not finite.all():
                row, column = np.argwhere(~finite)[0]
                raise BadData(
                    f"{channel_name(self.source, self.channels[row].name)}: samples must be finite, sample "
                    f"{first + column} is {block[row, column]}; cut or repair the recording there"
                )
            first += block.shape[1]
            yield block

    def labels(self) -> list[tuple[float, float, str]]:
        """Return begin, end [s] and text of the stretches that a column of labels marks; none without one."""
        marks = [] if self._contents.labels is None else self._contents.labels()
        return [(first / self.sampling_rate, end / self.sampling_rate, text) for first, end, text in marks]

    def samples(self, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the samples from index `start` to before `stop`, fewer at the end of the recording.

        WAV, NPY, NPZ, HDF5, TDMS, FLAC and other lossless sound are read there only; other formats in one pass up to
        `stop`. Numbers that are not finite are unchanged, and missing samples are nan.

        Parameters
        ----------
        start, stop : int
            From 0; `start` at most `stop`. None: to the end.

        Returns
        -------
        ndarray, (n_channels, n_samples)
            float32 or float64.

        Raises
        ------
        InvalidValue
            `start` or `stop` is no such number.
        BadData, NoInput
            As `blocks`.
        """
        start = whole("start", start, 0)
        if start == 0 and stop is None:
            return self._all_samples()
        stop = sys.maxsize if stop is None else whole("stop", stop, start)
        if self.n_samples is not None:
            stop = min(stop, self.n_samples)
        parts, left = [np.empty((len(self._selected), 0), np.float32)], stop - start
        for block in self._blocks(min(left, BLOCK_LENGTH), start) if left > 0 else ():
            parts.append(block[:, :left])
            left -= block.shape[1]
            if left <= 0:
                break
        return np.concatenate(parts, axis=1)

    def blocks_with_gaps(self, *, joint: bool = False) -> Iterator[NDArray[Any]]:
        """Yield the samples as `blocks` does, with nan for impossible numbers; `warnings` report where.

        Raises `BadData` at the end if no sample of all channels (of a `joint` one) is readable.
        """
        gaps = self.gaps(range(len(self.channels)), joint=joint)
        yield from gaps.marked(self.blocks(gaps=True))
        gaps.require(self.source)

    def signals(self) -> list[Signal]:
        """Return one `Signal` per channel, all in memory.

        Returns
        -------
        list of Signal

        Raises
        ------
        BadData
            As `blocks`, or the recording does not fit in memory.
        """
        signals, faults = self.signals_and_faults()
        if faults:
            raise BadData(f"{faults[0]}, or take its samples with nan by cgid.open_recording(...).samples()")
        return signals

    def signals_and_faults(self) -> tuple[list[Signal], list[BadData]]:
        """Return one `Signal` for each channel whose samples are all finite, and an error for each other channel."""
        signals, faults = [], []
        for row, channel in zip(self.samples(), self.channels, strict=True):
            try:
                signal = Signal(
                    samples=row,
                    sampling_rate=self.sampling_rate,
                    unit=channel.unit,
                    source=self.source,
                    channel=channel.name,
                    start_time=self.start_time,
                    warnings=self.warnings,
                )
            except BadData as error:
                faults.append(error)
            else:
                signals.append(signal)
        return signals, faults

    def _blocks(self, length: int, start: int = 0) -> Iterator[NDArray[Any]]:
        count = start
        # Memory must not grow with the number of channels.
        length = min(length, max(MAX_NUMBERS // self._contents.n_channels, 1))
        with clear_errors(self.source):
            numbers = without_fillers(self._contents.joined(length, self._selected, start))
            for block in scaled(numbers, self._factors):
                count += block.shape[1]
                yield block
        if not count:
            raise BadData(
                f"{self.source}: a recording must contain at least one sample, there is none; record it again"
            )

    def _all_samples(self) -> NDArray[Any]:
        try:
            if self.n_samples is None:
                return np.concatenate(list(self._blocks(BLOCK_LENGTH)), axis=1)
            out, filled = np.empty((len(self._selected), 0)), 0
            for block in self._blocks(BLOCK_LENGTH):
                if not filled:
                    out = np.empty((len(block), self.n_samples), block.dtype)
                out[:, filled : filled + block.shape[1]] = block
                filled += block.shape[1]
        except MemoryError:
            raise BadData(f"{self.source}: the recording must fit in memory and does not; cut it into parts") from None
        return out[:, :filled]


def _require_one_start(contents: Blocks, selected: Sequence[int], rate: float, source: str) -> None:
    known = [(index, start) for index in selected if (start := contents.starts[index])]
    for index, start in known:
        later = (start - known[0][1]).total_seconds()
        if abs(later) * rate > SIMULTANEOUS:
            raise BadData(
                f"{source}: channels must begin together, {contents.label(index)} begins {later:.9g} s after "
                f"{contents.label(known[0][0])}; pick one by {spelled('channel')}"
            )


def _counters(contents: Blocks) -> list[int]:
    """Return the channels without a unit that only count, if their names say so or they have none."""
    units = contents.units or [None] * contents.n_channels
    rows = [index for index in range(contents.n_channels) if not units[index]]
    rows = [index for index in rows if is_name_of_counter(contents.name(index))]
    if not rows or contents.fallback_unit is not None:
        return []
    first = next(iter(contents.joined(COUNTED, rows)), np.empty((0, 0)))
    return [index for index, row in zip(rows, first, strict=False) if counts(contents.name(index), row)]


def _selected(contents: Blocks, channel: int | str | Sequence[int | str] | None, source: str) -> tuple[int, ...]:
    if channel is None:
        return tuple(range(contents.n_channels))
    requested = [channel] if isinstance(channel, int | str) else list(channel)
    return tuple(dict.fromkeys(index for one in requested for index in contents.selected(one, source)))


@contextmanager
def clear_errors(source: str) -> Iterator[None]:
    """Turn system errors on opening or reading a file into a one-line `NoInput`."""
    try:
        yield
    except CgidError:
        raise
    except FileNotFoundError:
        raise NoInput(f"{source}: the file must exist and does not; check the name") from None
    except PermissionError:
        raise NoInput(f"{source}: the file must be readable, permission is denied; check its rights") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise NoInput(f"{source!r}: the file cannot be opened ({reason}); check the name") from None


def library(name: str, of: str, source: str, extra: str = "formats") -> Any:
    """Import the library that reads a format; raise `MissingExtra` without it."""
    return optional(name, f"{source}: {of} need the library", extra)


@contextmanager
def library_errors(source: str, fault: str, hint: str = "copy it again") -> Iterator[None]:
    """Turn errors of a library on a damaged file into a one-line `BadData`: source, fault, reason and cure."""
    try:
        yield
    except (CgidError, FileNotFoundError, PermissionError):
        raise
    # On damaged files, libraries raise any exception, often chained to a more specific one.
    except Exception as raised:
        error: BaseException = raised
        while error.__context__ is not None:
            error = error.__context__
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise BadData(f"{source}: {fault} ({reason}); {hint}") from None
