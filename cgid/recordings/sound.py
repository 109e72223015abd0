"""Read WAV without a library; FLAC, OGG, W64, AIFF, CAF and AU with libsndfile (EBU Tech 3285 and 3306, RFC 2361)."""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.recordings.recording import Asked, Blocks, library, library_errors

#: Sizes from here on mean "until the end": 0xFFFFFFFF in the standards; into pipes, some programs write the largest
#: signed 32-bit number, rounded down.
ENDLESS = 0x7FFF0000

#: Bytes of sound that are checked for misplaced bits.
_CHECKED = 1 << 20
#: Bytes to read of each relevant chunk; the others are skipped.
_READ = {b"fmt ": 40, b"ds64": 28, b"bext": 338}
#: Maximum number of chunks before the sound; a hostile file could contain millions of empty ones.
_MAX_CHUNKS = 1000

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_OTHER_CODINGS = {2: "ADPCM", 6: "A-law (ALAW)", 7: "mu-law (MULAW)", 0x11: "IMA ADPCM", 0x55: "MP3"}
_WIDTHS = {"u": (1,), "i": (2, 3, 4, 8), "f": (4, 8)}


@dataclass(frozen=True, kw_only=True)
class Coding:
    """Encoding of a number of `width` bytes: "u" unsigned around the middle, "i" signed integers, "f" floats."""

    kind: Literal["u", "i", "f"]
    width: int
    big_endian: bool = False

    @classmethod
    def of_name(cls, name: str) -> Coding:
        """Return the coding of a name such as "u8", "s16le", "s24be", "f32le"; little-endian by default."""
        match = _NAMED.get(str(name).lower())
        if match is None:
            listed = ", ".join(codings for codings in _NAMED if codings == "u8" or codings.endswith("e"))
            raise InvalidValue(f"sample_format must be one of {listed}, got {name!r}")
        return match

    def decoded(self, raw: bytes) -> NDArray[Any]:
        """Return numbers, (len(raw) // width,): integers as float64 with a full scale of 1.0, floats unchanged."""
        order = ">" if self.big_endian else "<"
        if self.kind == "f":
            numbers = np.frombuffer(raw, f"{order}f{self.width}")
            return numbers.astype(numbers.dtype.newbyteorder("="))
        if self.width == 3:
            return _of_three_bytes(raw, self.big_endian).astype(np.float64) / 2.0**31
        half = 2.0 ** (8 * self.width - 1)
        scaled = np.frombuffer(raw, f"{order}{self.kind}{self.width}").astype(np.float64)
        if self.kind == "u":
            scaled -= half
        scaled /= half
        return scaled


_KINDS: dict[str, Literal["i", "f"]] = {"s": "i", "f": "f"}
_NAMED = {"u8": Coding(kind="u", width=1)} | {
    f"{letter}{8 * width}{ending}": Coding(kind=kind, width=width, big_endian=ending == "be")
    for letter, kind in _KINDS.items()
    for width in _WIDTHS[kind]
    if width < 8 or kind == "f"
    for ending in ("le", "be", "")
}


def _of_three_bytes(raw: bytes, big_endian: bool) -> NDArray[np.int32]:
    """Return 24-bit numbers in the upper bits of 32, so that they keep their sign."""
    three = np.frombuffer(raw, np.uint8).reshape(-1, 3)
    four = np.zeros((len(three), 4), np.uint8)
    little = sys.byteorder == "little"
    four[:, slice(1, 4) if little else slice(0, 3)] = three[:, ::-1] if big_endian == little else three
    return four.view(np.int32)[:, 0]


# ---- the head: everything before the sound ---------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class WaveHead:
    """The metadata of a WAV file before the sound; `start_time` is from a broadcast chunk.

    valid_bits : of each integer, in its upper bits; 0 if the file does not say
    """

    n_channels: int
    sampling_rate: float
    coding: Coding
    data_size: int
    valid_bits: int = 0
    start_time: datetime | None = None
    warnings: list[str] = field(default_factory=list)

    @property
    def frame_size(self) -> int:
        """Bytes of one sample of all channels."""
        return self.n_channels * self.coding.width


def read_wave_head(file: BinaryIO, skip: Callable[[int], object], source: str, start: bytes = b"") -> WaveHead:
    """Read up to the first byte of sound; `start` holds bytes read before, `skip` skips bytes of `file`."""
    start += file.read(12 - len(start))
    order = ">" if start.startswith(b"RIFX") else "<"
    if len(start) < 12 or start[8:] != b"WAVE":
        kind = f", it states {start[8:]!r}" if len(start) == 12 else "; the file looks cut off"
        raise BadData(f"{source}: a WAV file must begin with RIFF and WAVE{kind}; export it again")
    chunks: dict[bytes, bytes] = {}
    for _ in range(_MAX_CHUNKS):
        head = file.read(8)
        if len(head) < 8:
            break
        name, size = head[:4], int(struct.unpack(order + "I", head[4:])[0])
        if name == b"data":
            return _head(chunks, order, size, source)
        required = min(_READ.get(name, 0), size)
        # Some programs write chunks twice; the first one is used.
        chunks.setdefault(name, file.read(required) if required else b"")
        skip(size - required + size % 2)
    raise BadData(
        f"{source}: a WAV file must contain a chunk of sound (data), none was found; the file looks cut off or "
        "damaged, copy it again"
    )


def _head(chunks: dict[bytes, bytes], order: str, data_size: int, source: str) -> WaveHead:
    form = chunks.get(b"fmt ", b"")
    if len(form) < 16:
        raise BadData(f"{source}: a WAV file must state its format before the sound; export it again")
    tag, n_channels, rate, byte_rate, align, bits = struct.unpack(order + "HHIIHH", form[:16])
    valid_bits = 0
    if tag == _EXTENSIBLE and len(form) >= 26:
        valid_bits = int(struct.unpack(order + "H", form[18:20])[0])
        # The actual format is in the first two bytes of a GUID.
        tag = int(struct.unpack(order + "H", form[24:26])[0])
    width = align // n_channels if n_channels and align % n_channels == 0 else 0
    coding = Coding(kind="f" if tag == _FLOAT else "u" if width == 1 else "i", width=width, big_endian=order == ">")
    if tag not in (_PCM, _FLOAT) or width not in _WIDTHS[coding.kind] or not 0 < bits <= 8 * width:
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
    if len(chunks.get(b"ds64", b"")) >= 24:
        # RF64 stores its 64-bit sizes here.
        (data_size,) = struct.unpack("<Q", chunks[b"ds64"][8:16])
    return WaveHead(
        n_channels=n_channels,
        sampling_rate=float(rate),
        coding=coding,
        data_size=data_size,
        valid_bits=valid_bits,
        start_time=_start_time(chunks.get(b"bext", b"")),
        warnings=warnings,
    )


def _start_time(broadcast: bytes) -> datetime | None:
    """Return the origination time from a broadcast chunk: date, 10 characters at byte 320, and time, 8 at byte 330."""
    with suppress(ValueError):
        # Several separators are allowed between the digits.
        digits = [character if character.isdigit() else " " for character in broadcast[320:338].decode("ascii")]
        return datetime.strptime("".join(digits), "%Y %m %d%H %M %S")
    return None


# ---- WAV files -------------------------------------------------------------------------------------------------------


def read_wav(path: Path, source: str, _asked: Asked) -> Blocks:
    """Return the channels of a WAV file (RIFF, RIFX or RF64), integers scaled to a full scale of 1.0."""
    # A truncated or never closed file gives its complete samples and a warning.
    with path.open("rb") as file:
        n_available = os.fstat(file.fileno()).st_size
        head = read_wave_head(file, lambda size: file.seek(size, os.SEEK_CUR), source)
        start = file.tell()
        warnings = list(head.warnings)
        size = _size_of_sound(file, head, start, n_available, warnings)
        file.seek(start)
        if head.coding.kind == "i" and 0 < head.valid_bits <= 8 * (head.coding.width - 1) and head.coding.width == 4:
            _check_bits(file.read(min(size, _CHECKED)), head, warnings)

    def blocks(length: int, channels: Sequence[int], begin: int = 0) -> Iterator[NDArray[Any]]:
        block_size = length * head.frame_size
        picked = list(channels)
        with path.open("rb") as file:
            file.seek(start + begin * head.frame_size)
            for first in range(begin * head.frame_size, size, block_size):
                raw = file.read(min(block_size, size - first))
                complete = len(raw) - len(raw) % head.frame_size
                yield np.ascontiguousarray(head.coding.decoded(raw[:complete]).reshape(-1, head.n_channels).T[picked])
                if len(raw) < min(block_size, size - first):
                    warnings.append("the file became shorter while it was read; the complete part was read")
                    return

    return Blocks(
        n_channels=head.n_channels,
        read=blocks,
        seekable=True,
        n_samples=size // head.frame_size,
        sampling_rate=head.sampling_rate,
        rate_from="header of the WAV file",
        fallback_unit="FS",
        full_scales=[1.0] * head.n_channels,
        integers=[head.coding.kind != "f"] * head.n_channels,
        start_time=head.start_time,
        warnings=warnings,
    )


def _size_of_sound(file: BinaryIO, head: WaveHead, start: int, n_available: int, warnings: list[str]) -> int:
    """Return the bytes of complete frames in the file; warn of wrong declared sizes."""
    declared, follows = head.data_size, n_available - start
    # Recorders that lose power, and programs that write to pipes, never fill in the size.
    never_closed = declared == 0 and follows > 0 and not _is_chunk(file, head, start, n_available)
    if never_closed or (declared >= ENDLESS and declared > follows):
        warnings.append(
            f"the file was not closed and does not state its length; all {follows} bytes of sound were read"
        )
    elif declared > follows:
        warnings.append(
            f"the header declares {declared} bytes of sound and {follows} follow; the file looks cut off, what is "
            "whole was read"
        )
    else:
        follows = declared
        end = start + declared
        # A zero byte follows sound of odd size, but some programs omit it.
        if end + end % 2 < n_available and not any(_is_chunk(file, head, at, n_available) for at in (end, end + 1)):
            warnings.append(
                f"{n_available - end} bytes after the declared sound are not part of a WAV file and were left out; "
                "check the file"
            )
        elif second := _second_sound(file, head, end + end % 2, n_available):
            warnings.append(f"a second chunk of {second} bytes of sound was left out; check how the file was made")
        if left := declared % head.frame_size:
            warnings.append(
                f"{declared} bytes of sound are not complete frames of {head.frame_size}; the last {left} were left out"
            )
    return follows - follows % head.frame_size


def _second_sound(file: BinaryIO, head: WaveHead, at: int, n_available: int) -> int:
    """Return the bytes of a further chunk of sound from byte `at` on, 0 without one."""
    for _ in range(_MAX_CHUNKS):
        if not _is_chunk(file, head, at, n_available):
            return 0
        file.seek(at)
        name, size = file.read(4), int.from_bytes(file.read(4), "big" if head.coding.big_endian else "little")
        if name == b"data":
            return size
        at += 8 + size + size % 2
    return 0


def _check_bits(raw: bytes, head: WaveHead, warnings: list[str]) -> None:
    """Warn if the bits of integers of 32 bits that must be empty are not."""
    numbers = np.frombuffer(raw[: len(raw) // 4 * 4], ">i4" if head.coding.big_endian else "<i4")
    if not (numbers & (1 << 32 - head.valid_bits) - 1).any():
        return
    is_right = numbers.size and int(np.abs(numbers.astype(np.int64)).max()) <= 1 << head.valid_bits - 1
    place = (
        f"in the lower bits, so that samples are {1 << 32 - head.valid_bits} times too small" if is_right else "in all"
    )
    warnings.append(
        f"the header states {head.valid_bits} valid bits in the upper ones of 32, the numbers are {place}; check the "
        "recorder, and give its full scale"
    )


def _is_chunk(file: BinaryIO, head: WaveHead, at: int, n_available: int) -> bool:
    """Return whether a chunk begins at byte `at` and ends within the file."""
    file.seek(at)
    name, size = file.read(4), int.from_bytes(file.read(4), "big" if head.coding.big_endian else "little")
    return len(name) == 4 and all(32 <= byte < 127 for byte in name) and at + 8 + size <= n_available + 1


# ---- files of libsndfile -------------------------------------------------------------------------------------------

#: Codings that keep the samples, and a size of AU that means unknown.
_CODINGS = ("PCM_", "FLOAT", "DOUBLE", "VORBIS", "OPUS", "ALAC_")
#: In these, a sample depends on those before it.
_LOSSY = ("VORBIS", "OPUS")
_UNKNOWN_SIZE, _ALIGNED = (1 << 32) - 1, 8
#: Samples of each channel to decode at once.
_DECODED = 1 << 14
#: Maximum number of samples of a channel in one byte of a file: a FLAC frame of 65535 equal samples takes about 12
#: bytes.
_BEST_PACKING = 1 << 13
#: An Ogg page (RFC 3533): bytes before its segment table, longest page, and the flag of the last one.
_PAGE_HEAD, _MAX_PAGE_SIZE, _LAST_PAGE = 27, 65_307, 4


def read_audio(path: Path, source: str, _asked: Asked) -> Blocks:
    """Return the channels of a FLAC, OGG, W64, AIFF, CAF or AU file, with a full scale of 1.0."""
    soundfile = library("soundfile", "FLAC, OGG, W64, AIFF, CAF and AU files", source)
    fault, hint = "the audio file is damaged or cut off", "copy or export it again"

    @contextmanager
    def opened() -> Iterator[Any]:
        # An open file, because libsndfile takes no name that is not UTF-8.
        with library_errors(source, fault, hint), path.open("rb") as file, soundfile.SoundFile(file) as sound:
            yield sound

    with opened() as sound:
        n_channels, rate, declared = int(sound.channels), float(sound.samplerate), int(sound.frames)
        coding = str(sound.subtype)
    if not coding.startswith(_CODINGS):
        raise BadData(f"{source}: sound must be stored as PCM, float, FLAC or Vorbis, it is {coding}; export it again")
    declared_end, size = _declared_end(path), path.stat().st_size
    if declared_end is not None and declared_end > size:
        raise BadData(f"{source}: {fault}, it declares {declared_end - size} bytes more than it contains; {hint}")
    warnings = []
    if declared_end is not None and _content_after(path, declared_end):
        warnings.append(f"{size - declared_end} bytes after the declared end were left out; check the file")
    # A header may declare more than a file of this size can contain, or nothing.
    n_samples = declared if 0 < declared <= _BEST_PACKING * path.stat().st_size else None
    is_ended, position = _ogg_end(path)
    if not is_ended:
        raise BadData(f"{source}: an OGG file must end with a last page, there is none; it looks cut off, {hint}")

    def read(length: int, channels: Sequence[int], start: int = 0) -> Iterator[NDArray[Any]]:
        picked, count = list(channels), start
        with opened() as sound:
            if start:
                sound.seek(start)
            # `SoundFile.blocks` repeats samples where a file is damaged.
            while len(frames := sound.read(min(length, _DECODED), dtype="float64", always_2d=True)):
                count += len(frames)
                yield np.ascontiguousarray(frames.T[picked])
        for stated in (n_samples, position):
            if stated not in (None, count):
                raise BadData(f"{source}: {fault}, it declares {stated} samples and {count} can be decoded; {hint}")

    return Blocks(
        n_channels=n_channels,
        read=read,
        seekable=n_samples is not None and coding not in _LOSSY,
        n_samples=n_samples,
        sampling_rate=rate,
        rate_from="header of the audio file",
        fallback_unit="FS",
        full_scales=[1.0] * n_channels,
        integers=[coding not in ("FLOAT", "DOUBLE")] * n_channels,
        warnings=warnings,
    )


def _content_after(path: Path, end: int) -> bool:
    """Return whether more than the zeros that align a file follow its declared end."""
    with path.open("rb") as file:
        file.seek(end)
        after = file.read(_ALIGNED)
    return len(after) == _ALIGNED or any(after)


def _declared_end(path: Path) -> int | None:
    """Return the size [bytes] that a W64, AIFF, CAF or AU file declares, which libsndfile does not compare."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(24)
        ends: list[int] = []
        if head.startswith(b"riff"):
            ends.append(int.from_bytes(head[16:24], "little"))
        elif head.startswith(b"FORM"):
            ends.append(8 + int.from_bytes(head[4:8], "big"))
        elif head[:4] in (b".snd", b"dns."):
            start, length = (int.from_bytes(head[at : at + 4], "big" if head[0] == 46 else "little") for at in (4, 8))
            ends += [start + length] if length < _UNKNOWN_SIZE else []
        elif head.startswith(b"caff"):
            at = 8
            while at + 12 <= size and len(ends) < _MAX_CHUNKS:
                file.seek(at)
                chunk = file.read(12)
                length = int.from_bytes(chunk[4:], "big", signed=True)
                if not chunk[:4].isalnum() or (length < 0 and chunk[:4] != b"data"):
                    break
                # The last chunk of sound may be of unknown length.
                at = at + 12 + length if length >= 0 else size
                ends.append(at)
    return max(ends, default=None)


def _ogg_end(path: Path) -> tuple[bool, int | None]:
    """Return whether an Ogg file ends with its last page, and its number of samples if they are Vorbis."""
    # libsndfile reports neither, and leaves out damaged pages.
    with path.open("rb") as file:
        head = file.read(_MAX_PAGE_SIZE)
        file.seek(max(0, os.fstat(file.fileno()).st_size - _MAX_PAGE_SIZE))
        page = file.read()
    if not head.startswith(b"OggS"):
        return True, None
    page = page[page.rfind(b"OggS") :]
    n_segments = page[26] if len(page) >= _PAGE_HEAD else 0
    size = _PAGE_HEAD + n_segments + sum(page[_PAGE_HEAD : _PAGE_HEAD + n_segments])
    is_vorbis = b"\x01vorbis" in head[: _PAGE_HEAD + 256]
    position = int.from_bytes(page[6:14], "little", signed=True) if is_vorbis else None
    return len(page) == size and bool(page[5] & _LAST_PAGE), position
