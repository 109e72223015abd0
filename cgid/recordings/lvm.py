"""Read LabVIEW measurement files (.lvm) by blocks: headers of tags, each above tab-separated rows.

Segments that follow each other without a gap are one recording. The tags follow National Instruments' "Specification
for the LabVIEW Measurement File (.lvm)", tutorial 4139. Deviations of real files (times with decimal commas, missing
separators) are read, too.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import MAX_CHANNELS, RATE_TOLERANCE, Blocks, Remark, require_one_rate
from cgid.recordings.text import PIECE, no_number, whole_lines
from cgid.recordings.text_layout import NUMBER, SNIFFED, encoding_of, stamped_moment
from cgid.recordings.times import EvenTimes, Floats, is_resolved, rate_of
from cgid.terminal import counted
from cgid.units import known_unit

_END_OF_HEAD = "***End_of_Header***"
_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}

#: Rows begin with a number or a separator, the header of the next segment with a letter or a star.
_HEAD = re.compile(r"^[A-Za-z*]", re.MULTILINE)
#: Longest header [lines]; usual ones have about twenty tags.
_LONGEST_HEAD = 2000

#: Larger values of X0 [s] count from 1904, not from the time stamp.
_SINCE_1904 = 1e8
#: Delta_X gives the rate only if its rounding error is at most this part of it.
_FINE = 1e-3
#: Tolerances of the time between consecutive segments: in steps, and the resolution of the time stamps [s].
_GAP, _STAMP = 1.5, 2e-6


def read_lvm(path: Path, source: str, variable: str | None) -> Blocks:
    """Return the channels of a LabVIEW measurement file.

    `variable` is the number of a segment from 1, or a channel, which selects all channels of its length and rate. A cut
    file gives its whole rows and a warning. Raises `BadData` if a header or a row is damaged; without `variable` also
    if channels differ in length or rate, or segments do not follow each other.
    """
    is_number = variable is not None and variable.isascii() and variable.isdigit() and len(variable) < 9
    lvm = _Lvm(path=path, source=source, only=int(variable) if variable is not None and is_number else None)
    first, rows = lvm.beginning()
    channels = _channels_alike(first, None if is_number else variable, source, lvm.warnings)
    rate, rate_from, is_timed = lvm.rate(first, channels[0], rows)

    def blocks(length: int, picked: Sequence[int]) -> Iterator[NDArray[Any]]:
        for samples in lvm.samples(first, [channels[index] for index in picked], rate if is_timed else None):
            for start in range(0, samples.shape[1], length):
                yield samples[:, start : start + length]

    about: dict[str, Any] = {
        "names": [first.name(channel) for channel in channels],
        "units": [known_unit(first.field("Y_Unit_Label", channel)) for channel in channels],
        "sampling_rate": rate,
        "rate_from": rate_from,
        "start_time": first.start_time(channels[0]),
        "warnings": lvm.warnings,
    }
    if path.stat().st_size > PIECE:
        return Blocks(n_channels=len(channels), read=blocks, **about)
    # Read a short file at once, so that its length is known.
    whole = list(blocks(PIECE, range(len(channels))))
    return Blocks.of_array(np.concatenate([np.empty((len(channels), 0)), *whole], axis=1), **about)


# ---- heads -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Head:
    """File header, valid for all segments.

    decimal_comma : None if the header does not state it
    x_columns : "no", "one" or "multi": columns with values of x
    """

    separator: str
    decimal_comma: bool | None
    x_columns: str
    tags: dict[str, list[str]]

    @classmethod
    def of(cls, lines: Sequence[str], source: str) -> _Head:
        """Parse the lines above the first end of a header."""
        separator = "\t"
        for line in lines:
            if line.startswith("Separator"):
                named = line.removeprefix("Separator").strip().lower()
                # The separator may be written literally, after a separator; of a tab nothing is left.
                separator = _SEPARATORS.get(named) or named[:1] or "\t"
        tags = _tags(lines, separator)
        stated = {tag: (fields[1].strip() if len(fields) > 1 else "") for tag, fields in tags.items()}
        x_columns = stated.get("X_Columns", "One").lower()
        if x_columns not in ("no", "one", "multi") or separator.isalnum():
            raise BadData(
                f"{source}: the head of a LabVIEW file must say X_Columns No, One or Multi, got {x_columns[:20]!r}, "
                f"and a separator that is no letter, got {separator!r}; export it again"
            )
        decimal_comma = stated["Decimal_Separator"] == "," if "Decimal_Separator" in stated else None
        return cls(separator=separator, decimal_comma=decimal_comma, x_columns=x_columns, tags=tags)

    def with_points(self, text: str) -> str:
        """Return numbers with decimal points."""
        is_comma = "." not in text if self.decimal_comma is None else self.decimal_comma
        return text.replace(",", ".") if is_comma and self.separator != "," else text


@dataclass(frozen=True, kw_only=True)
class _Segment:
    """A packet of rows and its header.

    number : from 1
    line : of the first row in the file, from 1
    tags : fields of each tag, in the columns to which they belong; column 0 is that of x
    labels : texts above the columns
    """

    number: int
    line: int
    head: _Head
    tags: dict[str, list[str]]
    labels: list[str]
    n_channels: int

    @classmethod
    def of(cls, lines: Sequence[str], head: _Head, number: int, line: int, source: str) -> _Segment:
        """Parse the header of a segment; its last line holds the labels of the columns."""
        tags = _tags(lines[:-1], head.separator)
        channels = [*tags.get("Channels", []), "", ""][1].strip()
        if not (channels.isascii() and channels.isdigit() and 0 < int(channels[:9]) < 10**6):
            raise BadData(
                f"{source}: segment {number} (line {line}) must say its number of Channels, got {channels[:20]!r}; "
                "export the file again"
            )
        other = {field.strip() for field in tags.get("X_Dimension", [])[1:]} - {"", "Time"}
        if other:
            raise BadData(
                f"{source}: the x axis must be time, segment {number} says {min(other)[:40]}; export the signals"
            )
        labels = lines[-1].split(head.separator)
        return cls(number=number, line=line, head=head, tags=tags, labels=labels, n_channels=int(channels))

    def column(self, channel: int) -> int:
        """Return the column of the samples of a channel."""
        return 2 * channel + 1 if self.head.x_columns == "multi" else channel + 1

    def x_column(self, channel: int) -> int | None:
        """Return the x column of a channel, None without one."""
        return {"no": None, "one": 0, "multi": 2 * channel}[self.head.x_columns]

    def field(self, tag: str, channel: int) -> str:
        """Return the text of a tag for a channel, "" without one."""
        return _at(self.tags.get(tag, []), self.column(channel))

    def name(self, channel: int) -> str:
        """Return the label above a channel."""
        return _at(self.labels, self.column(channel))

    def n_samples(self, channel: int) -> int | None:
        """Return the declared number of samples, None without one."""
        text = self.field("Samples", channel)
        return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else None

    def number_of(self, tag: str, channel: int) -> float | None:
        """Return the number of a tag for a channel, None without one."""
        text = self.field(tag, channel).replace(",", ".")
        return float(text) if NUMBER.fullmatch(text) else None

    def step(self, channel: int) -> tuple[float | None, bool]:
        """Return Delta_X [s], and whether its printed digits are fine enough for a rate."""
        step = self.number_of("Delta_X", channel)
        if step is None or not (math.isfinite(step) and step > 0):
            return None, False
        digits, _, exponent = self.field("Delta_X", channel).replace(",", ".").lower().partition("e")
        places = len(digits.partition(".")[2])
        return step, 0.5 * 10.0 ** (int(exponent or 0) - places) <= _FINE * step

    def start_time(self, channel: int) -> datetime | None:
        """Return the time of the first sample."""
        x0 = self.number_of("X0", channel) or 0.0
        stamp: datetime | None = datetime(1904, 1, 1)
        if x0 <= _SINCE_1904:
            own = [self.field(tag, channel) for tag in ("Date", "Time")]
            of_file = [_at(self.head.tags.get(tag, []), 1) for tag in ("Date", "Time")]
            stamp = stamped_moment(" ".join(own), alone=True) or stamped_moment(" ".join(of_file), alone=True)
        with suppress(OverflowError, ValueError):
            return None if stamp is None else stamp + timedelta(seconds=x0)
        return None


def _tags(lines: Sequence[str], separator: str) -> dict[str, list[str]]:
    rows = [line.split(separator) for line in lines]
    return {row[0].strip(): row for row in rows if row[0].strip()}


def _at(fields: Sequence[str], column: int) -> str:
    return fields[column].strip() if column < len(fields) else ""


def _channels_alike(segment: _Segment, named: str | None, source: str, warnings: list[str]) -> list[int]:
    """Return the channels, from 0, like the channel `named` in length and rate; without a name all must be alike.

    Channels without samples are left out with a warning.
    """
    if segment.n_channels > MAX_CHANNELS:
        raise BadData(f"{source}: at most {MAX_CHANNELS} channels, got {segment.n_channels}; export fewer")
    kinds = {
        channel: (segment.n_samples(channel), segment.number_of("Delta_X", channel))
        for channel in range(segment.n_channels)
    }
    empty = [channel for channel, kind in kinds.items() if kind[0] == 0]
    if empty:
        warnings.append(Remark(f"{counted(len(empty), 'channel')} without samples left out: {_listed(segment, empty)}"))
    held = [channel for channel in kinds if channel not in empty]
    if not held:
        raise BadData(f"{source}: a recording must hold at least one sample, no channel does; record it again")
    if named is not None:
        chosen = [channel for channel in held if segment.name(channel) == named]
        if not chosen:
            raise BadData(
                f"{source}: variable {named!r} is neither the number of a segment nor a channel with samples; choose "
                f"one of {_listed(segment, held)} by --variable"
            )
        return [channel for channel in held if kinds[channel] == kinds[chosen[0]]]
    odd = next((channel for channel in held if kinds[channel] != kinds[held[0]]), None)
    if odd is not None:
        shown = [f"{kinds[one][0]} samples of {kinds[one][1]} s" for one in (held[0], odd)]
        raise BadData(
            f"{source}: channels must be of one length and rate, {segment.name(held[0])!r} has {shown[0]} and "
            f"{segment.name(odd)!r} {shown[1]}; pick those like one channel by --variable NAME"
        )
    return held


def _listed(segment: _Segment, channels: Sequence[int]) -> str:
    names = [segment.name(channel) or str(channel + 1) for channel in channels[:20]]
    return ", ".join(names) + (", ..." if len(channels) > 20 else "")


# ---- segments and their rows -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Lvm:
    """A file of segments; `only` is the number of the selected one, None for all."""

    path: Path
    source: str
    only: int | None
    warnings: list[str] = field(default_factory=list)

    def beginning(self) -> tuple[_Segment, str]:
        """Return the first selected segment and its first rows."""
        found, last = None, 0
        for segment, rows, _ in self._parts():
            if found is not None:
                # A header without rows is followed by the header of the next segment.
                return found, rows if segment is found else ""
            last = segment.number
            if self.only in (None, segment.number):
                found = segment
                if rows.strip():
                    return found, rows
        if found is None:
            raise BadData(
                f"{self.source}: there is no segment {self.only}, the last one is {last}; name it by --variable"
            )
        return found, ""

    def rate(self, segment: _Segment, channel: int, text: str) -> tuple[float | None, str, bool]:
        """Return the sampling rate [Hz], its origin, and whether the x column is fine enough for checks.

        Delta_X gives the rate if its printed digits are fine enough, else the x of the first rows.
        """
        step, is_fine = segment.step(channel)
        stated = 1 / step if step is not None and is_fine else None
        if segment.x_column(channel) is not None:
            times = self._rows(text, segment, [channel], 0, segment.line)[:, 0]
            if len(times) > 1 and (stated is None or is_resolved(times, 1 / stated)):
                measured = rate_of(times, self.source)
                # A few rounded times are less exact than a step of many digits.
                if stated is not None and abs(measured - stated) * len(times) > measured:
                    require_one_rate((stated, "Delta_X"), (measured, "the column of x"), self.source)
                return stated or measured, "Delta_X" if stated else "column of x", True
        if stated is None:
            shown = segment.field("Delta_X", channel)
            self.warnings.append(Remark(f"Delta_X {shown[:40]!r} has too few digits for a sampling rate to 0.1 %"))
        return stated, "Delta_X", False

    def samples(self, first: _Segment, channels: Sequence[int], timed: float | None) -> Iterator[Floats]:
        """Yield samples, (len(channels), n), segment by segment; `timed` is the rate [Hz] of checked x."""
        at, count = first, 0
        clock = None if timed is None else EvenTimes(timed, self.source)
        for segment, text, line in self._parts():
            if segment.number < first.number or self.only not in (None, segment.number):
                continue
            if segment.number > at.number:
                self._require_end(at, channels[0], count)
                self._require_next(at, segment, channels[0], count)
                # Times may restart from 0 in each segment.
                at, count, clock = segment, 0, None if timed is None else EvenTimes(timed, self.source)
            rows = self._rows(text, segment, channels, count, line)
            if clock is not None:
                clock.feed(rows[:, 0])
            count += len(rows)
            yield np.ascontiguousarray(rows.T[-len(channels) :])
        self._require_end(at, channels[0], count)

    def _parts(self) -> Iterator[tuple[_Segment, str, int]]:
        """Yield segments with pieces of their rows, at least one each, and the first line of the piece."""
        with self.path.open("rb") as file:
            encoding = encoding_of(file.read(SNIFFED), self.source)
        above: list[str] | None = []
        special, line, segment = False, 1, None
        for text, _ in whole_lines(self.path, encoding, self.source):
            at = 0
            while at < len(text):
                if above is None and segment is not None:
                    found = _HEAD.search(text, at)
                    end = found.start() if found else len(text)
                    yield segment, text[at:end], line
                    line += text.count("\n", at, end)
                    at, above = end, [] if found else None
                    continue
                end = text.find("\n", at) + 1 or len(text)
                written, at, line = text[at:end].rstrip("\r\n"), end, line + 1
                # Special blocks in a header hold other data, such as binary data or notes.
                if special or written.startswith("***Start_Special***"):
                    special = not written.startswith("***End_Special***")
                    continue
                assert above is not None
                above.append(written)
                if (head := self._head_of(above, segment)) is not None:
                    number = 1 if segment is None else segment.number + 1
                    below = above if segment is not None else above[_ends(above)[0] + 1 :]
                    segment, above = _Segment.of(below, head, number, line, self.source), None
                    yield segment, "", line
                elif len(above) > _LONGEST_HEAD:
                    raise BadData(
                        f"{self.source}: a head of {len(above)} lines is none (line {line}); copy the file again"
                    )
        if segment is None:
            raise BadData(
                f"{self.source}: a LabVIEW file must hold a segment with its head, there is none; it looks cut off, "
                "copy it again"
            )
        if above and any(map(str.strip, above)):
            self.warnings.append(f"the head of segment {segment.number + 1} is cut off; what comes before it was read")

    def _head_of(self, above: list[str], segment: _Segment | None) -> _Head | None:
        """Return the file header if `above` is a complete segment header: its end and a line of labels."""
        if len(above) < 2 or not above[-2].startswith(_END_OF_HEAD):
            return None
        if segment is not None:
            return segment.head
        ends = _ends(above)
        return _Head.of(above[: ends[0]], self.source) if len(ends) > 1 else None

    def _rows(self, text: str, segment: _Segment, channels: Sequence[int], sample: int, line: int) -> Floats:
        """Return rows as numbers, (n, n_columns): x, if present, and the channels."""
        x = segment.x_column(channels[0])
        columns = ([] if x is None else [x]) + [segment.column(channel) for channel in channels]
        # If channels differ in length, the shorter ones have empty fields after their end.
        declared = segment.n_samples(channels[0])
        longest = max(segment.n_samples(channel) or 0 for channel in range(segment.n_channels))
        if declared is not None and declared < longest:
            text = "".join(text.splitlines(keepends=True)[: max(0, declared - sample)])
        if not text.strip():
            return np.empty((0, len(columns)))
        written = io.StringIO(segment.head.with_points(text).rstrip())
        try:
            rows = np.loadtxt(written, delimiter=segment.head.separator, usecols=columns, comments=None, ndmin=2)
            if np.isfinite(rows).all():
                return rows
        except ValueError:
            pass
        checked = list(self._checked(text, segment, columns, x is not None, sample, line))
        return np.array(checked).reshape(-1, len(columns))

    def _checked(
        self, text: str, segment: _Segment, columns: list[int], times: bool, sample: int, line: int
    ) -> Iterator[list[float]]:
        unended = line + text.count("\n")
        for number, written in enumerate(text.split("\n"), line):
            fields = written.split(segment.head.separator)
            if not written.strip() or not any(map(str.strip, fields)):
                continue
            values = [segment.head.with_points(_at(fields, column)) for column in columns]
            numbers = [float(value) if NUMBER.fullmatch(value) else None for value in values]
            wrong = next((column for column, x in zip(columns, numbers, strict=True) if x is None), None)
            if wrong is None and times and not math.isfinite(numbers[0] or 0.0):
                wrong = columns[0]
            if wrong is None:
                yield [math.nan if number is None else number for number in numbers]
                sample += 1
            elif number == unended:
                # Only the last line of the file has no line feed.
                self.warnings.append(f"the last row (line {number}) is cut off and was left out")
                return
            else:
                raise no_number(sample, number, wrong, _at(fields, wrong), self.source)

    def _require_end(self, segment: _Segment, channel: int, count: int) -> None:
        declared = segment.n_samples(channel)
        # More packets of the declared length may follow without headers.
        if declared and (not count or count % declared):
            self.warnings.append(
                f"segment {segment.number} declares {declared} samples and holds {count}; the file looks cut off or "
                "damaged, the rows that are whole were read"
            )

    def _require_next(self, segment: _Segment, following: _Segment, channel: int, count: int) -> None:
        """Raise `BadData` unless a segment continues the one before with the same channels and rate."""
        step, _ = segment.step(channel)
        cure = f"pick one segment by --variable {segment.number}, {following.number}, ..."
        if following.n_channels != segment.n_channels or following.step(channel)[0] != step:
            raise BadData(
                f"{self.source}: segment {following.number} (line {following.line}) must have the channels and the "
                f"rate of the one before, it has others; {cure}"
            )
        if step is None:
            return
        span, allowed = count * step, max(_GAP * step, RATE_TOLERANCE * count * step) + _STAMP
        starts = [one.number_of("X0", channel) or 0.0 for one in (segment, following)]
        moments = [one.start_time(channel) for one in (segment, following)]
        passed = [starts[1] - starts[0]]
        if moments[0] is not None and moments[1] is not None:
            passed.append((moments[1] - moments[0]).total_seconds())
        if all(abs(seconds - span) > allowed for seconds in passed):
            raise BadData(
                f"{self.source}: segment {following.number} (line {following.line}) must begin where the one before "
                f"ends, after {span:.6g} s, its head says after {passed[-1]:.6g} s; {cure}"
            )


def _ends(lines: Sequence[str]) -> list[int]:
    return [index for index, line in enumerate(lines) if line.startswith(_END_OF_HEAD)]
