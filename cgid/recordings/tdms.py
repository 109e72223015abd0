"""Read LabVIEW TDMS files by blocks, with nptdms."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import MAX_ARRAYS, Asked, Blocks, Remark, library, library_errors
from cgid.recordings.times import is_time_name
from cgid.recordings.variables import Value, Variable, contents_of, full_scale_of, is_statement, stated_start

_LEAD_IN, _TAG = 28, b"TDSm"
#: Declared length of a segment that is still being written.
_UNKNOWN = 2**64 - 1
#: Names of the types of scales, and those that nptdms applies.
_SCALE_TYPE = re.compile(r"NI_Scale\[\d+\]_Scale_Type")
_SCALES = re.compile("Polynomial|Linear|RTD|Strain|Table|Thermistor|Thermocouple|Add|Subtract|AdvancedAPI")
#: nptdms reads a chunk of a channel at once; so is a channel of longer chunks [samples].
MAX_CHUNK_SIZE = 1 << 22
#: The epoch of timestamps, which stands for an unknown time.
_EPOCH = datetime(1904, 1, 1, tzinfo=UTC)
#: Samples to read at once, if chunks are shorter.
_READ = 1 << 18


class _Tdms:
    """An open file with its nptdms object."""

    def __init__(self, path: Path, source: str) -> None:
        nptdms = library("nptdms", "TDMS files", source)
        self.source = source
        self._file = path.open("rb")
        self.is_cut = _is_cut(self._file)
        self._file.seek(0)
        with self.library_errors():
            # Given a file handle, nptdms does not look for an index file.
            self.tdms = nptdms.TdmsFile.open(self._file, raw_timestamps=True)
            groups = self.tdms.groups()
            every = [self.tdms, *groups, *(channel for group in groups for channel in group.channels())]
        #: What offsets of channels count from where no channel states a start.
        self.origin = None if any(stated_start(_values(one.properties)) for one in every) else _EPOCH

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()

    @contextmanager
    def library_errors(self) -> Iterator[None]:
        """Turn errors of nptdms into one line, and suppress its log."""
        from nptdms.log import log_manager

        level = log_manager.log_level
        log_manager.set_level(logging.CRITICAL)
        try:
            with library_errors(self.source, "the TDMS file is damaged", "copy it again, or export it anew"):
                yield
        finally:
            log_manager.set_level(level)

    def shortfalls(self) -> Iterator[str]:
        """Yield a warning for each channel of which the last segment declares more samples than it contains."""
        with self.library_errors():
            statuses = self.tdms.file_status.channel_statuses or {}
        for path, status in statuses.items():
            if status.read_length < status.expected_length:
                yield (
                    f"the header of channel {path} declares {status.expected_length} samples in its last part and "
                    f"{status.read_length} follow; these were read, the file may be damaged"
                )

    def blocks(self, channel: Any, length: int, start: int = 0) -> Iterator[NDArray[Any]]:
        """Yield the samples of a channel from `start` on, (1, at most `length`)."""
        with self.library_errors():
            chunk = len(next(iter(channel.data_chunks()), ()))
        # Part of a chunk costs as much as all of it: read complete ones, or the channel if its chunks are long.
        together = chunk * max(_READ // max(chunk, 1), 1)
        step = length * -(-max(together, length) // length) if chunk <= MAX_CHUNK_SIZE else len(channel)
        if step == len(channel) and 8 * step > MAX_ARRAYS:
            raise BadData(
                f"{self.source}: channel {channel.name} of {step} samples is written in one part and so must be of at "
                f"most {MAX_ARRAYS >> 30} GiB; export it again in smaller parts, or as WAV"
            )
        for first in range(start, len(channel), step):
            count = min(step, len(channel) - first)
            with self.library_errors():
                samples = channel.read_data(first, count)
                # Cut to microseconds, stamps would be uneven.
                samples = samples.as_datetime64("ns") if channel.dtype.kind == "M" else np.asarray(samples)
            if len(samples) != count:
                raise BadData(
                    f"{self.source}: channel {channel.name} must have {len(channel)} samples, got "
                    f"{first + len(samples)}; the file is damaged, copy it again"
                )
            if samples.dtype.kind == "M":
                origin = samples[0] if not first else channel.read_data(0, 1).as_datetime64("ns")[0]
                samples = np.rint((samples - origin) / np.timedelta64(1, "us")) / 1e6
            channels_with_numbers = np.float32 if samples.dtype == np.float32 else np.float64
            for begin in range(0, len(samples), length):
                yield samples[np.newaxis, begin : begin + length].astype(channels_with_numbers)


def read_tdms(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of one group of a TDMS file; an index file next to it is not used."""
    # Rate, unit and start come from waveform properties of the channels, else of group or file, or from a channel of
    # times.
    file = _Tdms(path, source)
    warnings: list[str] = []
    if file.is_cut:
        warnings.append("the TDMS file is cut off or was never closed; the complete samples of its last part were read")
    else:
        warnings += file.shortfalls()
    variables: list[Variable] = []
    with file.library_errors():
        statements: dict[str, dict[str, Value]] = {"": _values(file.tdms.properties)}
        for group in file.tdms.groups():
            statements[group.name] = _values(group.properties)
            for channel in group.channels():
                if len(channel) and channel.dtype.kind in "fiuM":
                    variables.append(_variable(file, group.name, channel))
                elif not len(channel):
                    warnings.append(Remark(f"channel {group.name}/{channel.name} contains no samples and is skipped"))
                else:
                    warnings.append(Remark(f"channel {group.name}/{channel.name} contains no numbers and is skipped"))
    if file.is_cut and not variables:
        raise BadData(f"{source}: the TDMS file is cut off before its first sample; copy it again")
    blocks = contents_of(variables, statements, source, asked, warnings, group_is_one=True, is_cut=file.is_cut)
    return blocks if file.origin is None else replace(blocks, start_time=None)


def _variable(file: _Tdms, group: str, channel: Any) -> Variable:
    def blocks(length: int, _channels: Sequence[int], start: int = 0) -> Iterator[NDArray[Any]]:
        return file.blocks(channel, length, start)

    about = _values(channel.properties)
    owners = (channel.properties, file.tdms[group].properties, file.tdms.properties)
    types = {str(value) for one in owners for name, value in one.items() if _SCALE_TYPE.fullmatch(name)}
    scales = {one for one in types if not _SCALES.fullmatch(one)}
    if scales:
        # nptdms leaves the numbers as they are, and so without the unit.
        about = {"unit": "unscaled", **about}
    start = next(filter(None, (stated_start(_values(one)) for one in owners)), file.origin)
    offset = channel.properties.get("wf_start_offset", 0.0)
    if start is not None and isinstance(offset, int | float) and abs(offset) < 1e9:
        about.pop("wf_start_time", None)
        about = {"wf_start_time": start + timedelta(seconds=float(offset)), **about}
    is_stamp = channel.dtype.kind == "M"
    about = {**about, "unit": "s"} if is_stamp else about
    return Variable(
        name="time" if is_stamp and not is_time_name(channel.name) else channel.name,
        group=group,
        n_channels=1,
        n_samples=len(channel),
        read=blocks,
        seekable=True,
        about=about,
        warning=f"its scale {', '.join(sorted(scales))} is not known, so its numbers are not in its unit"
        if scales
        else "",
        # That of the numbers after the scales of NI, which nptdms applies.
        full_scale=full_scale_of(channel.dtype),
        is_integer=channel.dtype.kind in "iu",
    )


def _values(properties: Any) -> dict[str, Value]:
    units: dict[str, Value] = {}
    for name, value in properties.items():
        if not is_statement(name):
            continue
        if hasattr(value, "as_datetime64"):
            # TDMS timestamps are in UTC; datetime covers only the years 1 to 9999.
            stamp = value.as_datetime64("us").item()
            if isinstance(stamp, datetime) and stamp.replace(tzinfo=UTC) != _EPOCH:
                units[name] = stamp.replace(tzinfo=UTC)
        elif isinstance(value, str | int | float):
            units[name] = value
    return units


def _is_cut(file: BinaryIO) -> bool:
    """Return whether the last segment ends too early, by the declared lengths of all segments."""
    size, position = file.seek(0, 2), 0
    while position + _LEAD_IN <= size:
        file.seek(position)
        lead_in = file.read(_LEAD_IN)
        if not lead_in.startswith(_TAG):
            return False  # damaged, not cut: nptdms reports it
        # Bit 6 of the table of contents: the following numbers are big-endian.
        follows = int.from_bytes(lead_in[12:20], "big" if lead_in[4] & 0x40 else "little")
        if follows == _UNKNOWN:
            return True
        position += _LEAD_IN + follows
    return position != size
