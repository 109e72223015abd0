"""Universal files (UFF, UNV) of modal analysis: data sets 58, as text or with binary numbers.

Layout: "Universal Dataset Number 58", SDRL of the University of Cincinnati, https://www.ceas3.uc.edu/sdrluff/. Lines
are of fixed columns, so a block of samples is found by counting bytes; pyuff, which reads files whole, is what the
tests compare with.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import Contents, rates_agree
from cgid.units import known_unit, seconds_of

_DELIMITER = re.compile(rb"[ ]{4}-1[ \t]*\r?\n?")
#: Longer lines are none of text.
_LONGEST_LINE = 512
_TIME_RESPONSE, _UNKNOWN_FUNCTION, _TIME_AXIS = 1, 0, 17
_AXES = enumerate(("X", "Y", "Z", "RX", "RY", "RZ"), 1)
_DIRECTIONS = {sign * number: f"{'-' if sign < 0 else '+'}{axis}" for number, axis in _AXES for sign in (1, -1)}
_DATES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%d-%b-%y", "%d-%b-%Y")


@dataclass(frozen=True, kw_only=True)
class _DataSet:
    """A data set 58 of real numbers over even times."""

    number: int
    name: str
    place: str
    function: int
    abscissa: int
    is_even: bool
    is_real: bool
    step: float
    n_samples: int
    unit: str | None
    start_time: datetime | None
    is_binary: bool
    dtype: np.dtype[Any]
    start: int
    # Characters of a number, numbers of a line and bytes of a line, where it is text.
    width: int
    per_line: int
    line: int

    @property
    def end(self) -> int:
        """The first byte behind the numbers; of text no later than that."""
        if self.is_binary:
            return self.start + self.n_samples * self.dtype.itemsize
        full, rest = divmod(self.n_samples, self.per_line)
        return self.start + full * self.line + rest * self.width

    @property
    def is_recording(self) -> bool:
        """Whether these are samples over time."""
        return self.function in (_TIME_RESPONSE, _UNKNOWN_FUNCTION) and self.abscissa in (_TIME_AXIS, 0, 1)

    def __str__(self) -> str:
        return f"{self.number} ({self.name or 'no name'}, {self.n_samples} samples)"


def read_uff(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of a universal file: its data sets 58 that are responses over time.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        Number of the data set, counting those of type 58 from 1; None takes all over time as channels, which must be
        of one length and rate.

    Returns
    -------
    Contents
        The rate is that of the abscissa's increment, the unit that of the ordinate's label.

    Raises
    ------
    BadData
        The file is cut off or damaged, or has no such data set; its numbers are complex, over uneven times or over
        something else; data sets differ in length or rate.
    """
    warnings: list[str] = []
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(0)
        sets = list(_data_sets(file, size, source, warnings))
    chosen = _chosen(sets, source, variable)
    first = chosen[0]
    for one in chosen:
        if one.n_samples != first.n_samples or not rates_agree(one.step, first.step):
            raise BadData(
                f"{source}: channels must be of one length and rate, data sets {first} every {first.step:g} s and "
                f"{one} every {one.step:g} s differ; pick one by --variable NUMBER"
            )

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with path.open("rb") as file:
            for start in range(0, first.n_samples, length):
                count = min(length, first.n_samples - start)
                yield np.stack([_samples(file, chosen[channel], start, count, source) for channel in channels])

    return Contents(
        n_channels=len(chosen),
        blocks=blocks,
        n_samples=first.n_samples,
        names=_names(chosen),
        units=[one.unit for one in chosen],
        sampling_rate=_rate(first.step),
        rate_from="increment of the abscissa",
        start_time=first.start_time,
        warnings=warnings,
    )


def _names(chosen: Sequence[_DataSet]) -> list[str]:
    """Return the names of the data sets; where they do not tell them apart, node and direction of the response."""
    names = [one.name for one in chosen]
    return names if len(set(names)) == len(names) else [one.place for one in chosen]


def _rate(step: float) -> float:
    """Return the sampling rate [Hz] of a step printed with six digits; a whole number where one is printed the same."""
    whole = round(1 / step) if 1 / step < 1e12 else 0
    return float(whole) if whole and f"{1 / whole:.5E}" == f"{step:.5E}" else 1 / step


def _chosen(sets: Sequence[_DataSet], source: str, variable: str | None) -> list[_DataSet]:
    listed = ", ".join(map(str, sets[:12])) + (", ..." if len(sets) > 12 else "")
    if not sets:
        raise BadData(f"{source}: a universal file must hold a data set 58, there is none; export the time response")
    if variable is None:
        chosen = [one for one in sets if one.is_recording]
        if not chosen:
            raise BadData(
                f"{source}: no data set is a response over time, there are {listed}; export the time response"
            )
    else:
        chosen = [one for one in sets if variable in (str(one.number), one.name)]
        if len(chosen) != 1:
            raise BadData(
                f"{source}: variable {variable!r} must be one of the data sets, there are {listed}; give its number by "
                "--variable NUMBER"
            )
    for one in chosen:
        if not one.is_recording:
            raise BadData(f"{source}: data set {one} is no response over time; export the time response")
        if not one.is_real or not one.is_even:
            kind = "complex" if not one.is_real else "at uneven times"
            raise BadData(
                f"{source}: the samples of data set {one} must be real and even in time, they are {kind}; "
                "resample and export them again"
            )
        if not (np.isfinite(one.step) and one.step > 0):
            raise BadData(
                f"{source}: the abscissa of data set {one} must increase, its step is {one.step:g} s; correct it"
            )
    return chosen


def _data_sets(file: BinaryIO, size: int, source: str, warnings: list[str]) -> Iterator[_DataSet]:
    """Yield the data sets 58 of a file; what else is in it is passed over."""
    number = 0
    while _found(file):
        kind = file.readline(_LONGEST_LINE)
        # Some writers leave the end of a set that is not there.
        while _DELIMITER.fullmatch(kind):
            kind = file.readline(_LONGEST_LINE)
        words = kind[:7].split()
        if words and words[0].lower() in (b"58", b"58b"):
            number += 1
            one = _header(file, kind, number, source)
            yield one
            if one.is_real and one.is_even:
                _require_whole(file, one, size, source)
        # Whatever it was, it ends with the next delimiter, which may follow numbers on their line.
        if not _found(file):
            warnings.append("the last data set has no end; the file may be cut off")


def _found(file: BinaryIO) -> bool:
    """Go behind the next delimiter; return whether there was one."""
    while line := file.readline(_LONGEST_LINE):
        if _DELIMITER.fullmatch(line):
            return True
    return False


def _header(file: BinaryIO, kind: bytes, number: int, source: str) -> _DataSet:
    lines = [file.readline(_LONGEST_LINE).decode("latin-1").rstrip("\r\n") for _ in range(11)]
    try:
        function = int(lines[5][0:5])
        code, n_samples, spacing = (int(lines[6][k : k + 10]) for k in (0, 10, 20))
        step = float(lines[6][43:56])
        abscissa = int(lines[7][0:10])
        is_binary = kind.split()[0].lower() == b"58b"
        order, floats = (int(word) for word in kind.split()[1:3]) if is_binary else (1, 2)
    except (ValueError, IndexError):
        raise BadData(f"{source}: the header of data set {number} is damaged; copy or export the file again") from None
    if n_samples < 1 or code not in (2, 4, 5, 6) or order not in (1, 2) or floats != 2:
        raise BadData(
            f"{source}: data set {number} must hold IEEE numbers of type 2, 4, 5 or 6, it declares {n_samples} of type "
            f"{code}; export it again"
        )
    clock = _text(lines[7][47:67])
    if abscissa == _TIME_AXIS and seconds_of(clock) not in (None, 1.0):
        raise BadData(
            f"{source}: the abscissa of data set {number} must be in s, as the format has it, its label says {clock}; "
            "correct label or increment"
        )
    is_double = code in (4, 6)
    start = file.tell()
    line = len(file.readline(_LONGEST_LINE))
    file.seek(start)
    return _DataSet(
        number=number,
        name=_text(lines[0]) or _text(lines[8][26:46]),
        place=_place(lines[5]),
        function=function,
        abscissa=abscissa,
        is_even=spacing == 1,
        is_real=code in (2, 4),
        step=step,
        n_samples=n_samples,
        unit=known_unit(lines[8][47:67]),
        start_time=_date(lines[2]),
        is_binary=is_binary,
        dtype=np.dtype(f"{'<' if order == 1 else '>'}f{8 if is_double else 4}"),
        start=start,
        width=20 if is_double else 13,
        per_line=4 if is_double else 6,
        line=line,
    )


def _place(line: str) -> str:
    """Return node and direction of the response, "" where the line does not say them."""
    with suppress(ValueError):
        return f"{int(line[41:51])}{_DIRECTIONS.get(int(line[51:55]), '')}"
    return ""


def _text(line: str) -> str:
    text = line.strip()
    return "" if text.upper() == "NONE" else text


def _date(line: str) -> datetime | None:
    """Return the date of the third identification line, DD-MMM-YY and HH:MM:SS."""
    for form in _DATES:
        with suppress(ValueError):
            return datetime.strptime(line.strip(), form)
    return None


def _require_whole(file: BinaryIO, one: _DataSet, size: int, source: str) -> None:
    """Go to the end of the numbers, where the mark of the end must be, or the end of a file that lacks it."""
    if one.end > size or (not one.is_binary and one.line < one.width):
        raise BadData(
            f"{source}: data set {one} must be whole, its numbers end at byte {one.end} and the file at {size}; "
            "it looks cut off, copy it again"
        )
    file.seek(one.end)
    # Behind the last number the line may go on with blanks.
    rest = file.read(_LONGEST_LINE).lstrip(b" \r\n")
    if rest and not rest.startswith(b"-1"):
        raise BadData(
            f"{source}: data set {one} must end where {one.n_samples} numbers of its type do, at byte {one.end}, other "
            "things stand there; the file is damaged, export it again"
        )
    file.seek(one.end)


def _samples(file: BinaryIO, one: _DataSet, first: int, count: int, source: str) -> NDArray[Any]:
    """Return `count` samples from `first` on, float32 or float64."""
    if one.is_binary:
        file.seek(one.start + first * one.dtype.itemsize)
        return np.frombuffer(file.read(count * one.dtype.itemsize), one.dtype).astype(one.dtype.newbyteorder("="))
    skipped, lines = first // one.per_line, -(-(first + count) // one.per_line)
    file.seek(one.start + skipped * one.line)
    raw = file.read((lines - skipped) * one.line)
    numbers = one.width * one.per_line
    # The last line may be shorter.
    rest = len(raw) % one.line
    table = np.frombuffer(raw[: len(raw) - rest], np.uint8).reshape(-1, max(one.line, 1))
    texts = [np.ascontiguousarray(table[:, :numbers]).tobytes(), raw[len(raw) - rest :].rstrip()]
    joined = b"".join(texts).replace(b"D", b"E")[: one.width * (first - skipped * one.per_line + count)]
    fields = np.frombuffer(joined[: len(joined) // one.width * one.width], f"S{one.width}")
    ends_in_time = (table[:-1, -1] == ord("\n")).all() and (table[:-1, numbers:] <= ord(" ")).all()
    try:
        values = fields.astype(np.float64)[first - skipped * one.per_line :]
    except ValueError:
        values = np.empty(0)
    if not ends_in_time or len(values) < count:
        raise BadData(
            f"{source}: data set {one} must hold {one.per_line} numbers of {one.width} characters a line, it does not "
            f"from sample {first} on; the file is damaged, export it again"
        )
    return values
