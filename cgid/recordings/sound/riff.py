"""The head of a WAV file or stream: its chunks up to the sound."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from typing import BinaryIO

from cgid.errors import BadData
from cgid.recordings.sound.pcm import Coding

#: How WAV files begin: little-endian, big-endian, and two with sizes of 64 bits.
WAV_MAGICS = (b"RIFF", b"RIFX", b"RF64", b"BW64")

#: From here on a size means "until the end": 0xFFFFFFFF by the standards; other programs write to pipes what their
#: signed 32 bits hold, rounded down.
ENDLESS = 0x7FFF0000

#: Bytes to be read of the chunks that matter; the rest of them is passed over (EBU Tech 3285, 3306; RFC 2361).
_READ = {b"fmt ": 40, b"ds64": 28, b"fact": 4, b"bext": 338}

#: More chunks than any program writes before the sound; files from strangers could hold millions of empty ones.
_MOST_CHUNKS = 1000

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_OTHER_CODINGS = {2: "ADPCM", 6: "A-law (ALAW)", 7: "mu-law (MULAW)", 0x11: "IMA ADPCM", 0x55: "MP3"}


@dataclass(frozen=True, kw_only=True)
class WaveHead:
    """What stands before the sound.

    Attributes
    ----------
    n_channels : int
    sampling_rate : float
        [Hz].
    coding : Coding
    outer_size, data_size : int
        [bytes] as declared, of all that follows the first 8 bytes and of the sound.
    n_frames : int or None
        Samples of a channel according to the chunk "fact".
    start_time : datetime or None
        Where a broadcast chunk says it.
    warnings : list of str
        What in the head contradicts itself.
    """

    n_channels: int
    sampling_rate: float
    coding: Coding
    outer_size: int
    data_size: int
    n_frames: int | None = None
    start_time: datetime | None = None
    warnings: list[str] = field(default_factory=list)

    @property
    def frame_size(self) -> int:
        """Bytes of one sample of all channels."""
        return self.n_channels * self.coding.width


def read_wave_head(file: BinaryIO, skip: Callable[[int], object], source: str, start: bytes = b"") -> WaveHead:
    """Read up to the first byte of sound.

    Parameters
    ----------
    file : binary file
        At the first byte behind `start`.
    skip : callable
        Passes over so many bytes of `file`: by seeking where that is possible, else by reading.
    source : str
        Its name in messages.
    start : bytes
        At most 12 that have been read already.

    Raises
    ------
    BadData
        It is no WAV, is cut off before the sound, or its sound is neither PCM nor float of a known width.
    """
    start += file.read(12 - len(start))
    order = ">" if start.startswith(b"RIFX") else "<"
    if len(start) < 12 or start[8:] != b"WAVE":
        kind = f", it says {start[8:]!r}" if len(start) == 12 else "; the file looks cut off"
        raise BadData(f"{source}: a WAV file must begin with RIFF and WAVE{kind}; export it again")
    chunks: dict[bytes, bytes] = {}
    for _ in range(_MOST_CHUNKS):
        head = file.read(8)
        if len(head) < 8:
            break
        name, size = head[:4], int(struct.unpack(order + "I", head[4:])[0])
        if name == b"data":
            return _head(chunks, order, int(struct.unpack(order + "I", start[4:8])[0]), size, source)
        wanted = min(_READ.get(name, 0), size)
        # Some programs write notes twice; the first one counts.
        chunks.setdefault(name, file.read(wanted) if wanted else b"")
        skip(size - wanted + size % 2)
    raise BadData(
        f"{source}: a WAV file must hold a chunk of sound (data), none was found; the file looks cut off or damaged, "
        "copy it again"
    )


def _head(chunks: dict[bytes, bytes], order: str, outer_size: int, data_size: int, source: str) -> WaveHead:
    form = chunks.get(b"fmt ", b"")
    if len(form) < 16:
        raise BadData(f"{source}: a WAV file must say its format before the sound; export it again")
    tag, n_channels, rate, byte_rate, align, bits = struct.unpack(order + "HHIIHH", form[:16])
    if tag == _EXTENSIBLE and len(form) >= 26:
        # The format proper is in the first two bytes of a GUID.
        tag = int(struct.unpack(order + "H", form[24:26])[0])
    width = align // n_channels if n_channels and align % n_channels == 0 else 0
    coding = Coding(kind="f" if tag == _FLOAT else "u" if width == 1 else "i", width=width, big_endian=order == ">")
    if tag not in (_PCM, _FLOAT) or not coding.is_known or not 0 < bits <= 8 * width:
        raise BadData(
            f"{source}: WAV must be PCM of 8 to 64 bits or float of 32 or 64, it is "
            f"{_OTHER_CODINGS.get(tag, f'of type {tag}')}, {n_channels} channels, {align} bytes a frame, {bits} bits; "
            "export it again"
        )
    warnings = []
    if byte_rate != rate * align:
        warnings.append(
            f"the header contradicts itself: {rate} Hz of {align} bytes each are not {byte_rate} bytes/s; check the "
            "sampling rate"
        )
    if -(-bits // 8) != width:
        warnings.append(
            f"the header contradicts itself: {bits} bits do not take {width} bytes each; check the number of channels"
        )
    if b"ds64" in chunks and len(chunks[b"ds64"]) >= 24:
        # The sizes proper of RF64, which do not fit into 32 bits.
        outer_size, data_size = struct.unpack("<QQ", chunks[b"ds64"][:16])
    return WaveHead(
        n_channels=n_channels,
        sampling_rate=float(rate),
        coding=coding,
        outer_size=outer_size,
        data_size=data_size,
        n_frames=struct.unpack(order + "I", chunks[b"fact"])[0] if len(chunks.get(b"fact", b"")) == 4 else None,
        start_time=_start_time(chunks.get(b"bext", b"")),
        warnings=warnings,
    )


def _start_time(broadcast: bytes) -> datetime | None:
    """Return date and time of origin of a broadcast chunk: 10 characters at byte 320, 8 at byte 330."""
    with suppress(ValueError):
        # Any of several characters may stand between the digits.
        digits = [character if character.isdigit() else " " for character in broadcast[320:338].decode("ascii")]
        return datetime.strptime("".join(digits), "%Y %m %d%H %M %S")
    return None
