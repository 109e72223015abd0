"""The heads of LabVIEW measurement files: what the file, and what each of its segments says.

Tags and their meaning are those of National Instruments' "Specification for the LabVIEW Measurement File (.lvm)",
tutorial 4139; where real files differ (times with decimal commas, missing separators), both are read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from cgid.errors import BadData
from cgid.recordings.text.layout import NUMBER
from cgid.signals import KNOWN_UNITS

END_OF_HEAD = "***End_of_Header***"

_SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}
_SPELT_OUT = {
    "volts": "V", "volt": "V", "newtons": "N", "newton": "N", "pascals": "Pa", "pascal": "Pa", "meters": "m",
    "metres": "m", "millivolts": "mV", "strain": "m/m", "gs": "g",
}  # fmt: skip

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
        """Return the unit if it is one of `cgid.signals.UNITS`."""
        label = self.field("Y_Unit_Label", channel).replace("\u03bc", "µ")
        unit = label if label in KNOWN_UNITS else _SPELT_OUT.get(label.lower(), label)
        return unit if unit in KNOWN_UNITS else None

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
