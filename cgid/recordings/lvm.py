"""Read LabVIEW measurement files (.lvm): headers of tags, each above rows that the text reader parses.

Segments that follow each other without a gap are one recording. The tags follow National Instruments' "Specification
for the LabVIEW Measurement File (.lvm)", tutorial 4139. Deviations of real files (times with decimal commas, missing
separators) are read, too.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid._lib.validation import STATED_RATE
from cgid.errors import BadData
from cgid.recordings.recording import MAX_CHANNELS, Asked, Blocks, Remark
from cgid.recordings.text import Body, Piece, assembled, encoding_and_end, n_lines, whole_lines
from cgid.recordings.text_layout import NUMBER, ColumnHeader, Header, Layout, stamped_moment

_END_OF_HEAD = "***End_of_Header***"
_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}

#: Rows begin with a number or a separator, the header of the next segment with a letter or a star.
_HEAD = re.compile(r"^[A-Za-z*]", re.MULTILINE)
#: Lines without a field below the last row.
_EMPTY_LINES = re.compile(r"(?<=\n)[\s,;]*\Z")
#: Longest header [lines]; typical ones have about twenty tags.
_MAX_HEAD_LENGTH = 2000

#: Larger values of X0 [s] count from 1904, not from the time stamp.
_SINCE_1904 = 1e8
#: Delta_X gives the rate only if its rounding error is at most this part of it.
_FINE = 1e-3
#: Tolerances of the time between consecutive segments: in steps, and the resolution of the time stamps [s].
_GAP, _STAMP = 1.5, 2e-6


def read_lvm(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of a LabVIEW measurement file."""
    encoding, warnings = encoding_and_end(path, source)
    lvm = _Segments(path, encoding, source, warnings)
    only, variable = None, asked.variable
    if variable is not None:
        only = int(variable) if variable.isascii() and variable.isdigit() and len(variable) < 9 else 0
    first, text = lvm.beginning(variable, only)
    channels = first.channels(source, warnings)
    rate = first.rate(channels[0])
    x = [] if rate is not None else first.x_columns(channels[0])
    if rate is None and not x:
        shown = first.field("Delta_X", channels[0])
        warnings.append(Remark(f"Delta_X {shown[:40]!r} has too few digits for a sampling rate to 0.1 %"))
    columns = [ColumnHeader(name="time", unit="s")] * len(x)
    columns += [ColumnHeader(name=first.label(one), unit=first.field("Y_Unit_Label", one)) for one in channels]
    layout = Layout(
        delimiter=first.separator,
        n_columns=len(columns),
        decimal_comma=first.has_decimal_comma(text),
        picked=(*x, *map(first.column, channels)),
    )
    rates, start_time = () if rate is None else (rate,), first.start_time(channels[0])
    header = Header(columns=tuple(columns), sampling_rates=rates, start_time=start_time)
    arguments: dict[str, Any] = {
        "path": path,
        "encoding": encoding,
        "source": source,
        "start": 0,
        "first_line": first.line,
    }
    body = _Rows(**arguments, layout=layout, segments=lvm, only=only, channel=channels[0])
    rate_from = "column of x" if x else "Delta_X"
    starts = [] if x else [first.start_time(one) for one in channels]
    return replace(assembled(header, body, warnings, asked, list(range(len(x)))), rate_from=rate_from, starts=starts)


@dataclass(frozen=True, kw_only=True)
class _Segment:
    """The header of a packet of rows; its `tags` are in the columns of their channels, 0 is that of x."""

    number: int
    line: int
    separator: str
    x: str
    tags: dict[str, list[str]]
    of_file: dict[str, list[str]]
    labels: list[str]
    n_channels: int

    @classmethod
    def of(cls, head: Sequence[str], lines: Sequence[str], number: int, line: int, source: str) -> _Segment:
        """Parse the header of the file and that of a segment, whose last line contains the labels of the columns."""
        separator = "\t"
        for one in head:
            if one.startswith("Separator"):
                named = one.removeprefix("Separator").strip().lower()
                # The separator may be written literally, after a separator; a tab is stripped.
                separator = _SEPARATORS.get(named) or named[:1] or "\t"
        of_file, tags = _tags(head, separator), _tags(lines[:-1], separator)
        x = _at(of_file.get("X_Columns", ["", "One"]), 1).lower()
        if x not in ("no", "one", "multi") or separator.isalnum():
            raise BadData(
                f"{source}: the head of a LabVIEW file must state X_Columns No, One or Multi, got {x[:20]!r}, "
                f"and a separator that is no letter, got {separator!r}; export it again"
            )
        channels = _at(tags.get("Channels", []), 1)
        if not (channels.isascii() and channels.isdigit() and 0 < int(channels[:9]) <= MAX_CHANNELS):
            raise BadData(
                f"{source}: segment {number} (line {line}) must state its number of Channels, 1 to {MAX_CHANNELS}, got "
                f"{channels[:20]!r}; export the file again"
            )
        other = {field.strip() for field in tags.get("X_Dimension", [])[1:]} - {"", "Time"}
        if other:
            raise BadData(
                f"{source}: the x axis must be time, segment {number} states {min(other)[:40]}; export the signals"
            )
        labels, n_channels = lines[-1].split(separator), int(channels)
        arguments: dict[str, Any] = {"number": number, "line": line, "separator": separator, "x": x}
        return cls(**arguments, tags=tags, of_file=of_file, labels=labels, n_channels=n_channels)

    def column(self, channel: int) -> int:
        """Return the column of the samples of a channel."""
        return 2 * channel + 1 if self.x == "multi" else channel + 1

    def x_columns(self, channel: int) -> list[int]:
        """Return the column with the x of a channel, none if there is none."""
        return {"no": [], "one": [0], "multi": [2 * channel]}[self.x]

    def field(self, tag: str, channel: int) -> str:
        """Return the text of a tag for a channel, "" without one."""
        return _at(self.tags.get(tag, []), self.column(channel))

    def label(self, channel: int) -> str:
        """Return the label above a channel."""
        return _at(self.labels, self.column(channel))

    def number_of(self, tag: str, channel: int) -> float | None:
        """Return the number of a tag for a channel, None without one."""
        text = self.field(tag, channel).replace(",", ".")
        return float(text) if NUMBER.fullmatch(text) else None

    @property
    def n_samples(self) -> int:
        """Declared number of samples of the longest channel, 0 without one."""
        texts = [self.field("Samples", channel) for channel in range(self.n_channels)]
        return max(int(text) if text.isascii() and text.isdigit() and len(text) < 19 else 0 for text in texts)

    def channels(self, source: str, warnings: list[str]) -> list[int]:
        """Return the channels with samples, from 0, which must have one rate; warn of others."""
        empty = [channel for channel in range(self.n_channels) if self.number_of("Samples", channel) == 0]
        if empty:
            names = ", ".join(self.label(channel) or str(channel + 1) for channel in empty[:20])
            warnings.append(Remark(f"{counted(len(empty), 'channel')} without samples left out: {names}"))
        channels = [channel for channel in range(self.n_channels) if channel not in empty]
        if not channels:
            raise BadData(f"{source}: a recording must contain at least one sample, no channel does; record it again")
        steps = {channel: self.number_of("Delta_X", channel) for channel in channels}
        if len(set(steps.values())) > 1 and None in steps.values():
            raise BadData(f"{source}: channels must have one sampling rate, some state none; export those of one rate")
        fastest = min(steps.values(), key=lambda step: step or 0.0)
        if slow := [channel for channel in channels if steps[channel] != fastest]:
            names = ", ".join(self.label(channel) or str(channel + 1) for channel in slow[:20])
            warnings.append(Remark(f"{counted(len(slow), 'channel')} of another rate left out: {names}"))
        return [channel for channel in channels if channel not in slow]

    def rate(self, channel: int) -> float | None:
        """Return the rate [Hz] of Delta_X, None if its printed digits are too few for one."""
        step = self.number_of("Delta_X", channel)
        if step is None or not (math.isfinite(step) and step > 0):
            return None
        digits, _, exponent = self.field("Delta_X", channel).replace(",", ".").lower().partition("e")
        decimals = len(digits.partition(".")[2])
        return 1 / step if 0.5 * 10.0 ** (int(exponent or 0) - decimals) <= _FINE * step else None

    def has_decimal_comma(self, text: str) -> bool:
        """Return whether the rows have decimal commas; `text` holds the first ones."""
        stated = _at(self.of_file.get("Decimal_Separator", []), 1)
        return self.separator != "," and (stated == "," if stated else "," in text and "." not in text)

    def start_time(self, channel: int) -> datetime | None:
        """Return the time of the first sample."""
        x0 = self.number_of("X0", channel) or 0.0
        stamp: datetime | None = datetime(1904, 1, 1)
        if x0 <= _SINCE_1904:
            date_and_time = [self.field(tag, channel) for tag in ("Date", "Time")]
            of_file = [_at(self.of_file.get(tag, []), 1) for tag in ("Date", "Time")]
            stamp = stamped_moment(" ".join(date_and_time), is_only_field=True) or stamped_moment(
                " ".join(of_file), is_only_field=True
            )
        with suppress(OverflowError, ValueError):
            return None if stamp is None else stamp + timedelta(seconds=x0)
        return None


def _tags(lines: Sequence[str], separator: str) -> dict[str, list[str]]:
    rows = [line.split(separator) for line in lines]
    return {row[0].strip(): row for row in rows if row[0].strip()}


def _at(fields: Sequence[str], column: int) -> str:
    return fields[column].strip() if column < len(fields) else ""


# ---- segments and their rows -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Segments:
    path: Path
    encoding: str
    source: str
    warnings: list[str]

    def beginning(self, variable: str | None, only: int | None) -> tuple[_Segment, str]:
        """Return the first selected segment that has rows, and its first ones."""
        number = 0
        for segment, piece in self.parts():
            number = segment.number
            if piece.text and only in (None, number):
                return segment, piece.text
        if only is not None and not 0 < only <= number:
            raise BadData(f"{self.source}: there is no segment {variable}, the last is {number}; correct variable")
        raise BadData(f"{self.source}: a recording must contain at least one sample, there is none; record it again")

    def parts(self) -> Iterator[tuple[_Segment, Piece]]:
        """Yield segments with pieces of their rows, at least one each, which may be empty."""
        above: list[str] | None = []
        head: list[str] = []
        special, line, segment = False, 1, None
        for text, is_last in whole_lines(self.path, self.encoding, self.source):
            at = 0
            while at < len(text):
                if above is None and segment is not None:
                    match = _HEAD.search(text, at)
                    end = match.start() if match else len(text)
                    rows = _EMPTY_LINES.sub("", text[at:end]) if match or is_last else text[at:end]
                    yield segment, Piece(rows, line, is_last and not match)
                    line += text.count("\n", at, end)
                    at, above = end, [] if match else None
                    continue
                end = text.find("\n", at) + 1 or len(text)
                written, at, line = text[at:end].rstrip("\r\n"), end, line + 1
                # Special blocks in a header hold other data, such as binary data or notes.
                if special or written.startswith("***Start_Special***"):
                    special = not written.startswith("***End_Special***")
                    continue
                assert above is not None
                above.append(written)
                if len(above) > 1 and above[-2].startswith(_END_OF_HEAD):
                    if segment is None and not head:
                        # The first end is that of the header of the file.
                        head, above = above[:-2], above[-1:]
                        continue
                    number = 1 if segment is None else segment.number + 1
                    segment, above = _Segment.of(head, above, number, line, self.source), None
                    yield segment, Piece("", line)
                elif len(above) > _MAX_HEAD_LENGTH:
                    raise BadData(
                        f"{self.source}: a head of {len(above)} lines is none (line {line}); copy the file again"
                    )
        if segment is None:
            raise BadData(
                f"{self.source}: a LabVIEW file must contain a segment with its head, there is none; it looks cut off, "
                "copy it again"
            )
        if above and any(map(str.strip, above)):
            self.warnings.append(f"the head of segment {segment.number + 1} is cut off; what comes before it was read")


@dataclass(frozen=True, kw_only=True)
class _Rows(Body):
    """The rows of a segment (`only`), or of all, which must follow each other."""

    segments: _Segments
    only: int | None
    channel: int

    def texts(self) -> Iterator[Piece]:
        """Yield the rows as they are written, without the headers between them."""
        before: _Segment | None = None
        count = 0
        for segment, piece in self.segments.parts():
            if not (piece.text or piece.is_last) or self.only not in (None, segment.number):
                continue
            is_new = segment is not before
            if before is not None and is_new:
                self._require_end(before, count)
                self._require_next(before, segment, count)
            before, count = segment, (0 if is_new else count) + n_lines(piece.text)
            if piece.is_last:
                self._require_end(segment, count)
                before = None
            yield piece._replace(is_restart=is_new)
        if before is not None:
            self._require_end(before, count)

    def last_row(self) -> None:
        """Return None, as the times of a later segment may restart."""

    def _require_end(self, segment: _Segment, count: int) -> None:
        declared = segment.n_samples
        # More packets of the declared length may follow without headers.
        if declared and (not count or count % declared):
            self.segments.warnings.append(
                f"segment {segment.number} declares {declared} samples and contains {count}; the file looks cut off or "
                "damaged, the rows that are there were read"
            )

    def _require_next(self, segment: _Segment, following: _Segment, count: int) -> None:
        """Raise `BadData` unless a segment continues the one before with the same channels and rate."""
        step, channel = segment.number_of("Delta_X", self.channel), self.channel
        name = f"{self.source}: segment {following.number} (line {following.line})"
        hint = f"pick one segment, such as {segment.number}, by {spelled('variable', 'NUMBER')}"
        if following.n_channels != segment.n_channels or following.number_of("Delta_X", channel) != step:
            raise BadData(f"{name} must have the channels and the rate of the one before, it has others; {hint}")
        if step is None:
            return
        span, allowed = count * step, max(_GAP * step, STATED_RATE * count * step) + _STAMP
        starts = [one.number_of("X0", channel) or 0.0 for one in (segment, following)]
        moments = [one.start_time(channel) for one in (segment, following)]
        passed = [starts[1] - starts[0]]
        if moments[0] is not None and moments[1] is not None:
            passed.append((moments[1] - moments[0]).total_seconds())
        if all(abs(seconds - span) > allowed for seconds in passed):
            raise BadData(
                f"{name} must begin where the one before ends, after {span:.6g} s, its head states after "
                f"{passed[-1]:.6g} s; {hint}"
            )
