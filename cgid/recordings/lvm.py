"""The heads of LabVIEW measurement files: what the file, and what each of its segments says.

Tags and their meaning are those of National Instruments' "Specification for the LabVIEW Measurement File (.lvm)",
tutorial 4139; where real files differ (times with decimal commas, missing separators), both are read.

Which channels of a LabVIEW segment are read together: those of one length and one rate.

LabVIEW measurement files (.lvm) by blocks: segments that follow each other without a gap are one recording.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import MAX_CHANNELS, RATE_TOLERANCE, Contents, rates_agree
from cgid.recordings.text import PIECE, whole_lines
from cgid.recordings.text_layout import NUMBER, SNIFFED, encoding_of
from cgid.recordings.times import EvenTimes, Floats, is_resolved, rate_of
from cgid.units import known_unit

END_OF_HEAD = "***End_of_Header***"

_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}
#: Larger values of x are seconds since 1904, not since the time stamp.
_SINCE_1904 = 1e8

#: Printed digits tell a rate only if they are that fine.
_FINE = 1e-3


@dataclass(frozen=True, kw_only=True)
class LvmHead:
    """What the head of the file says of all segments.

    Attributes
    ----------
    separator : str
        One character between fields.
    decimal_comma : bool or None
        None where the head does not say.
    x_columns : str
        "no", "one" or "multi": which columns hold values of x.
    tags : dict
        Tag -> its fields.
    """

    separator: str
    decimal_comma: bool | None
    x_columns: str
    tags: dict[str, list[str]]

    def with_points(self, text: str) -> str:
        """Return numbers with decimal points."""
        is_comma = "." not in text if self.decimal_comma is None else self.decimal_comma
        return text.replace(",", ".") if is_comma and self.separator != "," else text


@dataclass(frozen=True, kw_only=True)
class Segment:
    """One packet of rows and what its head says; columns count from 0, the first is that of x.

    Attributes
    ----------
    number, line : int
        Of the segment and of its first row, both from 1.
    head : LvmHead
    tags : dict
        Tag -> fields, each in the column it belongs to.
    labels : list of str
        Above the columns.
    n_channels : int
    """

    number: int
    line: int
    head: LvmHead
    tags: dict[str, list[str]]
    labels: list[str]
    n_channels: int

    def column(self, channel: int) -> int:
        """Return the column of the samples of a channel."""
        return 2 * channel + 1 if self.head.x_columns == "multi" else channel + 1

    def x_column(self, channel: int) -> int | None:
        """Return the column of x of a channel, None if x is not written."""
        return {"no": None, "one": 0, "multi": 2 * channel}[self.head.x_columns]

    def field(self, tag: str, channel: int) -> str:
        """Return what a tag says of a channel, "" where it says nothing."""
        fields = self.tags.get(tag, [])
        column = self.column(channel)
        return fields[column].strip() if column < len(fields) else ""

    def name(self, channel: int) -> str:
        """Return the label above a channel."""
        column = self.column(channel)
        return self.labels[column].strip() if column < len(self.labels) else ""

    def unit(self, channel: int) -> str | None:
        """Return the unit if it is one of `cgid.units.UNITS`."""
        return known_unit(self.field("Y_Unit_Label", channel))

    def n_samples(self, channel: int) -> int | None:
        """Return the samples that are declared, None where they are not."""
        text = self.field("Samples", channel)
        return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else None

    def number_of(self, tag: str, channel: int) -> float | None:
        """Return the number that a tag says of a channel."""
        text = self.field(tag, channel).replace(",", ".")
        return float(text) if NUMBER.fullmatch(text) else None

    def step(self, channel: int) -> tuple[float | None, bool]:
        """Return Delta_X [s], and whether its printed digits are fine enough to give a rate."""
        step = self.number_of("Delta_X", channel)
        if step is None or not (math.isfinite(step) and step > 0):
            return None, False
        digits, _, exponent = self.field("Delta_X", channel).replace(",", ".").lower().partition("e")
        places = len(digits.partition(".")[2])
        return step, 0.5 * 10.0 ** (int(exponent or 0) - places) <= _FINE * step

    def start_time(self, channel: int) -> datetime | None:
        """Return when the first sample was taken."""
        x0 = self.number_of("X0", channel) or 0.0
        if x0 > _SINCE_1904:
            return _later(datetime(1904, 1, 1), x0)
        stamp = _moment(self.field("Date", channel), self.field("Time", channel))
        if stamp is None:
            stamp = _moment(*(self.head.tags.get(tag, ["", ""])[1].strip() for tag in ("Date", "Time")))
        return None if stamp is None else _later(stamp, x0)


def read_head(lines: Sequence[str], source: str) -> LvmHead:
    """Return what the lines above the first `END_OF_HEAD` say.

    Raises
    ------
    BadData
        The separator is none, or X_Columns is none of No, One and Multi.
    """
    separator = "\t"
    for line in lines:
        if line.startswith("Separator"):
            named = line.removeprefix("Separator").strip().lower()
            # Written as itself the separator stands behind itself; of blanks nothing is left.
            separator = _SEPARATORS.get(named) or named[:1] or "\t"
    tags = _tags(lines, separator)
    said = {tag: (fields[1].strip() if len(fields) > 1 else "") for tag, fields in tags.items()}
    x_columns = said.get("X_Columns", "One").lower()
    if x_columns not in ("no", "one", "multi") or separator.isalnum():
        raise BadData(
            f"{source}: the head of a LabVIEW file must say X_Columns No, One or Multi, got {x_columns[:20]!r}, and a "
            f"separator that is no letter, got {separator!r}; export it again"
        )
    return LvmHead(
        separator=separator,
        decimal_comma=said["Decimal_Separator"] == "," if "Decimal_Separator" in said else None,
        x_columns=x_columns,
        tags={tag: fields if len(fields) > 1 else [tag, ""] for tag, fields in tags.items()},
    )


def read_segment(lines: Sequence[str], head: LvmHead, number: int, line: int, source: str) -> Segment:
    """Return what the lines of a segment's head say, the last of them with the labels of the columns.

    Raises
    ------
    BadData
        The number of channels is missing, or x is not time.
    """
    tags = _tags(lines[:-1], head.separator)
    channels = [*tags.get("Channels", []), "", ""][1].strip()
    if not (channels.isascii() and channels.isdigit() and 0 < int(channels[:9]) < 10**6):
        raise BadData(
            f"{source}: segment {number} (line {line}) must say its number of Channels, got {channels[:20]!r}; export "
            "the file again"
        )
    other = {field.strip() for field in tags.get("X_Dimension", [])[1:]} - {"", "Time"}
    if other:
        raise BadData(f"{source}: the x axis must be time, segment {number} says {min(other)[:40]}; export the signals")
    labels = lines[-1].split(head.separator)
    return Segment(number=number, line=line, head=head, tags=tags, labels=labels, n_channels=int(channels))


def _tags(lines: Sequence[str], separator: str) -> dict[str, list[str]]:
    rows = [line.split(separator) for line in lines]
    return {row[0].strip(): row for row in rows if row[0].strip()}


def _moment(date: str, time: str) -> datetime | None:
    """Return a moment from such as 2013/02/19 and 09:51:39,197051012."""
    day = re.fullmatch(r"(\d{4})[/.-](\d\d?)[/.-](\d\d?)", date)
    clock = re.fullmatch(r"(\d\d?):(\d\d):(\d\d)(?:[.,](\d{1,6})\d*)?", time)
    if not day or not clock:
        return None
    micros = int((clock[4] or "0").ljust(6, "0"))
    year, month, date_of_month, hour, minute, second = map(int, (*day.groups(), *clock.groups()[:3]))
    try:
        return datetime(year, month, date_of_month, hour, minute, second, micros)
    except ValueError:
        return None


def _later(stamp: datetime, seconds: float) -> datetime | None:
    try:
        return stamp + timedelta(seconds=seconds)
    except (OverflowError, ValueError):
        return None


def channels_alike(segment: Segment, named: str | None, source: str, warnings: list[str]) -> list[int]:
    """Return the channels that are read, counted from 0.

    Parameters
    ----------
    segment : Segment
    named : str or None
        The channel whose length and rate the others must have; None if all of them agree.
    source : str
        Name of the file in messages.
    warnings : list of str
        Channels without samples are left out and told here.

    Raises
    ------
    BadData
        There are too many channels or none with samples, or they differ in length or rate and none is named.
    """
    if segment.n_channels > MAX_CHANNELS:
        raise BadData(f"{source}: at most {MAX_CHANNELS} channels, got {segment.n_channels}; export fewer")
    kinds = {
        channel: (segment.n_samples(channel), segment.number_of("Delta_X", channel))
        for channel in range(segment.n_channels)
    }
    empty = [channel for channel, kind in kinds.items() if kind[0] == 0]
    if empty:
        warnings.append(f"{len(empty)} channels without samples were left out: {_listed(segment, empty)}")
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
        raise BadData(
            f"{source}: channels must be of one length and rate, {segment.name(held[0])!r} has "
            f"{_shown(kinds[held[0]])} and {segment.name(odd)!r} {_shown(kinds[odd])}; "
            "pick those like one channel by --variable NAME"
        )
    return held


def _listed(segment: Segment, channels: Sequence[int]) -> str:
    names = [segment.name(channel) or str(channel + 1) for channel in channels[:20]]
    return ", ".join(names) + (", ..." if len(channels) > 20 else "")


def _shown(kind: tuple[int | None, float | None]) -> str:
    return f"{kind[0]} samples of {kind[1]} s"


#: Rows begin with a number or a separator; what begins with a letter or a star is the head of the next segment.
_HEAD = re.compile(r"^[A-Za-z*]", re.MULTILINE)

#: Lines of a head at most; there are some twenty tags.
_LONGEST_HEAD = 2000

#: Two segments follow each other if the time between them is that of the samples to this part of a step, and the
#: time stamps cannot be told apart closer than so [s].
_GAP, _STAMP = 1.5, 2e-6


def read_lvm(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of a LabVIEW measurement file.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        The number of a segment from 1; or the name of a channel, which stands for all of its length and rate.

    Returns
    -------
    Contents
        Of a file that is cut off the rows that are whole, and a warning.

    Raises
    ------
    BadData
        A head or a row is damaged; channels differ in length or rate, or segments do not follow each other, and
        `variable` does not pick any.
    """
    is_number = variable is not None and variable.isascii() and variable.isdigit() and len(variable) < 9
    lvm = _Lvm(path=path, source=source, only=int(variable) if variable is not None and is_number else None)
    first, rows = lvm.beginning()
    channels = channels_alike(first, None if is_number else variable, source, lvm.warnings)
    rate, rate_from, is_timed = lvm.rate(first, channels[0], rows)

    def blocks(length: int, picked: Sequence[int]) -> Iterator[NDArray[Any]]:
        for samples in lvm.samples(first, [channels[index] for index in picked], rate if is_timed else None):
            for start in range(0, samples.shape[1], length):
                yield samples[:, start : start + length]

    about: dict[str, Any] = {
        "names": [first.name(channel) for channel in channels],
        "units": [first.unit(channel) for channel in channels],
        "sampling_rate": rate,
        "rate_from": rate_from,
        "start_time": first.start_time(channels[0]),
        "warnings": lvm.warnings,
    }
    if path.stat().st_size > PIECE:
        return Contents(n_channels=len(channels), blocks=blocks, **about)
    # A short file is read once, so that its length is known.
    whole = list(blocks(PIECE, range(len(channels))))
    return Contents.of_array(np.concatenate([np.empty((len(channels), 0)), *whole], axis=1), **about)


@dataclass(frozen=True, kw_only=True)
class _Lvm:
    """A file whose segments are gone through; `only` is the number of the one that is meant."""

    path: Path
    source: str
    only: int | None
    warnings: list[str] = field(default_factory=list)

    def beginning(self) -> tuple[Segment, str]:
        """Return the first segment that is meant and its first rows."""
        found, last = None, 0
        for segment, rows, _ in self._parts():
            if found is not None:
                # A head without rows is followed by the next one.
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

    def rate(self, segment: Segment, channel: int, text: str) -> tuple[float | None, str, bool]:
        """Return the sampling rate [Hz], where it is said, and whether the column of x is fine enough to be checked.

        Delta_X counts if its printed digits are fine enough, else the x of the first rows.
        """
        step, is_fine = segment.step(channel)
        said = 1 / step if step is not None and is_fine else None
        if segment.x_column(channel) is not None:
            times = self._rows(text, segment, [channel], 0, segment.line)[:, 0]
            if len(times) > 1 and (said is None or is_resolved(times, 1 / said)):
                measured = rate_of(times, self.source)
                # Few rounded times say less than a step of many digits.
                if (
                    said is not None
                    and abs(measured - said) * len(times) > measured
                    and not rates_agree(measured, said)
                ):
                    raise BadData(
                        f"{self.source}: the sampling rate must be one to 0.1 %, Delta_X says {said:.10g} Hz and the "
                        f"column of x {measured:.10g} Hz; correct one"
                    )
                return said or measured, "Delta_X" if said else "column of x", True
        if said is None:
            shown = segment.field("Delta_X", channel)
            self.warnings.append(f"Delta_X {shown[:40]!r} has too few digits for a sampling rate to 0.1 %")
        return said, "Delta_X", False

    def samples(self, first: Segment, channels: Sequence[int], timed: float | None) -> Iterator[Floats]:
        """Yield the samples of channels, (len(channels), n), segment after segment; `timed` is the rate [Hz] of x."""
        at, count = first, 0
        clock = None if timed is None else EvenTimes(timed, self.source)
        for segment, text, line in self._parts():
            if segment.number < first.number or self.only not in (None, segment.number):
                continue
            if segment.number > at.number:
                self._require_end(at, channels[0], count)
                self._require_next(at, segment, channels[0], count)
                # Each segment may count its time anew.
                at, count, clock = segment, 0, None if timed is None else EvenTimes(timed, self.source)
            rows = self._rows(text, segment, channels, count, line)
            if clock is not None:
                clock.feed(rows[:, 0])
            count += len(rows)
            yield np.ascontiguousarray(rows.T[-len(channels) :])
        self._require_end(at, channels[0], count)

    def _parts(self) -> Iterator[tuple[Segment, str, int]]:
        """Yield segments with pieces of their rows, each segment at least once, and the line the piece begins with."""
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
                # Blocks of other data may stand in a head: binary ones, notes of the sender.
                if special or written.startswith("***Start_Special***"):
                    special = not written.startswith("***End_Special***")
                    continue
                assert above is not None
                above.append(written)
                if (head := self._head_of(above, segment)) is not None:
                    number = 1 if segment is None else segment.number + 1
                    below = above if segment is not None else above[_ends(above)[0] + 1 :]
                    segment, above = read_segment(below, head, number, line, self.source), None
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

    def _head_of(self, above: list[str], segment: Segment | None) -> LvmHead | None:
        """Return the head of the file once the head of a segment is complete: labels stand behind its end."""
        if len(above) < 2 or not above[-2].startswith(END_OF_HEAD):
            return None
        if segment is not None:
            return segment.head
        ends = _ends(above)
        return read_head(above[: ends[0]], self.source) if len(ends) > 1 else None

    def _rows(self, text: str, segment: Segment, channels: Sequence[int], sample: int, line: int) -> Floats:
        """Return rows as numbers, (n, n_columns): x, where it is written, and the channels."""
        x = segment.x_column(channels[0])
        columns = ([] if x is None else [x]) + [segment.column(channel) for channel in channels]
        # Where channels are of different length, the fields of the shorter ones are empty from there on.
        declared = segment.n_samples(channels[0])
        longest = max(segment.n_samples(channel) or 0 for channel in range(segment.n_channels))
        if declared is not None and declared < longest:
            text = "".join(text.splitlines(keepends=True)[: max(0, declared - sample)])
        if not text.strip():
            return np.empty((0, len(columns)))
        written = segment.head.with_points(text)
        try:
            rows = np.loadtxt(
                io.StringIO(written.rstrip()),
                delimiter=segment.head.separator,
                usecols=columns,
                comments=None,
                ndmin=2,
            )
        except ValueError:
            rows = np.full((1, 1), np.nan)
        if np.isfinite(rows).all():
            return rows
        checked = list(self._checked(text, segment, columns, sample, line))
        return np.array(checked).reshape(-1, len(columns))

    def _checked(
        self, text: str, segment: Segment, columns: list[int], sample: int, line: int
    ) -> Iterator[list[float]]:
        unended = line + text.count("\n")
        for number, written in enumerate(text.split("\n"), line):
            fields = [part.strip() for part in written.split(segment.head.separator)]
            if not any(fields):
                continue
            values = []
            for column in columns:
                shown = fields[column] if column < len(fields) else ""
                value = segment.head.with_points(shown)
                if NUMBER.fullmatch(value) and math.isfinite(float(value)):
                    values.append(float(value))
                elif number == unended:
                    # Only the very last line of the file has none.
                    self.warnings.append(f"the last row (line {number}) is cut off and was left out")
                    return
                else:
                    raise BadData(
                        f"{self.source}: every field must be a finite number, sample {sample} (line {number}) column "
                        f"{column + 1} is {repr(shown[:40]) if shown else 'empty'}; repair or cut the recording there"
                    )
            yield values
            sample += 1

    def _require_end(self, segment: Segment, channel: int, count: int) -> None:
        declared = segment.n_samples(channel)
        # Further packets may follow without a head of their own, each of so many samples.
        if declared and (not count or count % declared):
            self.warnings.append(
                f"segment {segment.number} declares {declared} samples and holds {count}; the file looks cut off or "
                "damaged, the rows that are whole were read"
            )

    def _require_next(self, segment: Segment, following: Segment, channel: int, count: int) -> None:
        """Raise unless a segment goes on where the one before ended, with the same channels."""
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
    return [index for index, line in enumerate(lines) if line.startswith(END_OF_HEAD)]
