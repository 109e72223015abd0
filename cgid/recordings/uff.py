"""Read universal files (UFF, UNV) of modal analysis: data sets 58, text or binary, which pyuff reads at once.

Layout: "Universal Dataset Number 58", SDRL of the University of Cincinnati, https://www.ceas3.uc.edu/sdrluff/.
"""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid._lib.validation import rates_agree
from cgid.errors import BadData
from cgid.recordings.recording import Asked, Blocks, Remark, library, library_errors
from cgid.recordings.text_layout import stated_chain
from cgid.recordings.times import lost_before, rate_of, seconds
from cgid.units import hertz_of, known_unit, seconds_of

#: Largest file [bytes], since pyuff reads files at once and needs several times their size.
MAX_FILE_SIZE = 256 << 20

_TIME_RESPONSE, _UNKNOWN_FUNCTION, _TIME_AXIS = 1, 0, 17
_EVEN, _REAL, _SINGLE = 1, (2, 4), 2
_AXES = enumerate(("X", "Y", "Z", "RX", "RY", "RZ"), 1)
_DIRECTIONS = {sign * number: f"{'-' if sign < 0 else '+'}{axis}" for number, axis in _AXES for sign in (1, -1)}
_DATES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%d-%b-%y", "%d-%b-%Y")
#: First line of a binary data set: byte order, type of the numbers, lines of text, bytes.
_BINARY = re.compile(rb"^ {4}58b *\d+ +\d+ +(\d{1,9}) +(\d{1,12})[ \d]*\r?\n", re.MULTILINE)
#: An exponent as Fortran writes it, and most numbers in a line of text.
_FORTRAN = re.compile(rb"(?<=[\d.])[Dd](?=[+-]\d\d)")
_A_LINE = 6
#: pyuff takes the line end and the mark after binary numbers for further numbers [bytes].
_MARK = 16


@dataclass(frozen=True, kw_only=True)
class _DataSet:
    """Header of a data set 58, with the field names of pyuff; `number` among those, `position_in_file` among all."""

    number: int
    position_in_file: int
    header: dict[str, Any]

    @property
    def n_samples(self) -> int:
        """Declared number of samples."""
        return int(self.header["num_pts"])

    @property
    def step(self) -> float:
        """Time between samples [s]."""
        return float(self.header["abscissa_inc"])

    @property
    def name(self) -> str:
        """First identification line, else the label of the ordinate."""
        return _text(self.header["id1"]) or _text(self.header["ordinate_axis_lab"])

    @property
    def position(self) -> str:
        """Node and direction of the response."""
        return f"{self.header['rsp_node']}{_DIRECTIONS.get(self.header['rsp_dir'], '')}"

    @property
    def start_time(self) -> datetime | None:
        """Date in the third identification line, DD-MMM-YY and HH:MM:SS."""
        for form in _DATES:
            with suppress(ValueError):
                return datetime.strptime(self.header["id3"].strip(), form)
        return None

    def messages(self, what: str) -> str | None:
        """Return the sensitivity or the gain in one of the identification lines, None without one."""
        match = [stated_chain(self.header[f"id{number}"]) for number in range(1, 6)]
        return next((one[1][0] for one in match if one is not None and one[0] == what and len(one[1]) == 1), None)

    @property
    def is_recording(self) -> bool:
        """Whether the data set holds samples over time."""
        function, abscissa = self.header["func_type"], self.header["abscissa_spec_data_type"]
        return function in (_TIME_RESPONSE, _UNKNOWN_FUNCTION) and abscissa in (_TIME_AXIS, 0, 1)

    def __str__(self) -> str:
        return f"{self.number} ({self.name or 'no name'}, {self.n_samples} samples)"


def read_uff(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of a universal file: its data sets 58 over time."""
    pyuff = library("pyuff", "universal files", source)
    content = _whole(path, source)
    fault, hint = "the universal file is damaged", "copy or export it again"
    with (
        library_errors(source, fault, hint),
        warnings.catch_warnings(action="ignore"),
        tempfile.TemporaryDirectory() as folder,
    ):
        if _FORTRAN.search(content) and not _BINARY.search(content):
            # pyuff does not know the D of double precision.
            path = Path(folder) / "exponents.uff"
            path.write_bytes(_FORTRAN.sub(b"E", content))
        file = pyuff.UFF(str(path))
        positions = [place for place, kind in enumerate(file.get_set_types()) if kind == 58]
        headers = [file.read_sets(place, header_only=True) for place in positions]
        sets = [
            _DataSet(number=number, position_in_file=place, header=header)
            for number, (place, header) in enumerate(zip(positions, headers, strict=True), 1)
        ]
        selected = _select(sets, source, asked.variable)
        left_out = [] if asked.variable else [one for one in sets if not one.is_recording]
        _require_recordings(selected, source)
        data_sets = [file.read_sets(one.position_in_file) for one in selected]
    samples = np.stack([_samples(one, its, source) for one, its in zip(data_sets, selected, strict=True)])
    first = selected[0]
    rates = [_rate_of(one, its, source, asked.sampling_rate) for one, its in zip(data_sets, selected, strict=True)]
    if not all(rates_agree(rate, rates[0]) for rate in rates):
        raise BadData(
            f"{source}: data sets must be of one rate, got {rates} Hz; pick one by {spelled('variable', 'NUMBER')}"
        )
    names = [one.name for one in selected]
    return Blocks.of_array(
        samples,
        # If the names are not unique, node and direction are.
        names=names if len(set(names)) == len(names) else [one.position for one in selected],
        units=[known_unit(one.header["ordinate_axis_units_lab"]) for one in selected],
        sensitivities=[one.messages("sensitivities") for one in selected],
        gains=[one.messages("gains") for one in selected],
        sampling_rate=rates[0],
        rate_from="abscissa",
        start_time=first.start_time,
        starts=[one.start_time for one in selected],
        warnings=[Remark(f"data set {one} is no response over time and is left out") for one in left_out],
    )


def _whole(path: Path, source: str) -> bytes:
    """Return the file; raise `BadData` unless it is small enough and ends with the end mark of a data set."""
    size = path.stat().st_size
    if size > MAX_FILE_SIZE:
        raise BadData(
            f"{source}: a universal file must be at most {MAX_FILE_SIZE >> 20} MiB, it has {size} bytes; export fewer "
            "data sets at once, or export WAV or TDMS"
        )
    content = path.read_bytes()
    # Where bytes are added or missing, pyuff reads the numbers at wrong positions.
    ends = [content[-200:].rstrip()[-2:], *(_after(content, match) for match in _BINARY.finditer(content))]
    if any(end != b"-1" for end in ends):
        raise BadData(
            f"{source}: each data set of a universal file must end with the mark -1, one does not; it looks cut off or "
            "damaged, copy it again"
        )
    return content


def _after(content: bytes, header: re.Match[bytes]) -> bytes:
    """Return the mark after the lines and bytes that the first line of a binary data set declares."""
    position = header.end()
    for _ in range(min(int(header[1]), 100)):
        position = content.find(b"\n", position) + 1
    return content[position + int(header[2]) :][:10].strip()[:2]


def _select(sets: Sequence[_DataSet], source: str, variable: str | None) -> list[_DataSet]:
    listed = ", ".join(map(str, sets[:12])) + (", ..." if len(sets) > 12 else "")
    if not sets:
        raise BadData(f"{source}: a universal file must contain a data set 58, there is none; export the time response")
    if variable is None:
        selected = [one for one in sets if one.is_recording]
        if not selected:
            raise BadData(
                f"{source}: no data set is a response over time, there are {listed}; export the time response"
            )
        return selected
    selected = [one for one in sets if variable in (str(one.number), one.name)]
    if len(selected) != 1:
        raise BadData(
            f"{source}: variable {variable!r} must be one of the data sets, there are {listed}; give its number by "
            f"{spelled('variable', 'NUMBER')}"
        )
    return selected


def _require_recordings(selected: Sequence[_DataSet], source: str) -> None:
    """Raise `BadData` unless all data sets are real samples at even times [s], of one length and rate."""
    first = selected[0]
    for one in selected:
        header = one.header
        if not one.is_recording:
            raise BadData(f"{source}: data set {one} is no response over time; export the time response")
        if header["ord_data_type"] not in _REAL:
            raise BadData(f"{source}: the samples of data set {one} must be real, they are complex; export them again")
        if header["abscissa_spacing"] == _EVEN and not (np.isfinite(one.step) and one.step > 0):
            raise BadData(
                f"{source}: the abscissa of data set {one} must increase, its step is {one.step:g} s; correct it"
            )
        label = _text(header["abscissa_axis_units_lab"])
        if hertz_of(label) is not None and label:
            seconds(label, source)
        if header["abscissa_spec_data_type"] == _TIME_AXIS and seconds_of(label) not in (None, 1.0):
            raise BadData(
                f"{source}: the abscissa of data set {one.number} must be in s, as the format has it, its label states "
                f"{label}; correct label or increment"
            )
        both_even = header["abscissa_spacing"] == first.header["abscissa_spacing"] == _EVEN
        if one.n_samples != first.n_samples or (both_even and not rates_agree(one.step, first.step)):
            raise BadData(
                f"{source}: channels must be of one length and rate, data sets {first} every {first.step:g} s and "
                f"{one} every {one.step:g} s differ; pick one by {spelled('variable', 'NUMBER')}"
            )


def _samples(data_set: dict[str, Any], one: _DataSet, source: str) -> NDArray[Any]:
    """Return the numbers of a data set, float32 if stored so; raise `BadData` if they are not as many as declared."""
    binary, single = bool(data_set["binary"]), data_set["ord_data_type"] == _SINGLE
    numbers, more = data_set["data"], _MARK // (4 if single else 8) if binary else 0
    if not binary and not np.any(numbers[one.n_samples :]):
        # Some programs fill the last line with zeros.
        more = _A_LINE - 1
    if not 0 < one.n_samples <= len(numbers) <= one.n_samples + more:
        raise BadData(
            f"{source}: data set {one} must have {one.n_samples} numbers of its type, got {len(numbers)}; the file is "
            "damaged, copy or export it again"
        )
    samples: NDArray[Any] = numbers[: one.n_samples]
    return samples.astype(np.float32) if binary and single else samples


def _rate_of(data_set: dict[str, Any], one: _DataSet, source: str, given: float | None) -> float:
    """Return the sampling rate [Hz] of a data set by its step, or by its times where a flag calls them uneven."""
    if one.header["abscissa_spacing"] == _EVEN:
        return _rate(one.step)
    times = np.asarray(data_set["x"], np.float64)[: one.n_samples]
    if len(times) < 2 or not np.isfinite(times).all() or lost_before(times, source, given=given).any():
        raise BadData(
            f"{source}: the samples of data set {one} must be at even times without a gap, they are not; export "
            "them again"
        )
    return rate_of(times, source, given)


def _rate(step: float) -> float:
    """Return the sampling rate [Hz] of a step printed with six digits: a whole number if its step prints the same."""
    rounded = round(1 / step) if 1 / step < 1e12 else 0
    return float(rounded) if rounded and f"{1 / rounded:.5E}" == f"{step:.5E}" else 1 / step


def _text(line: str) -> str:
    text = line.strip()
    return "" if text.upper() == "NONE" else text
