"""Read FLAC and OGG files by blocks with libsndfile, and check what it ignores.

libsndfile does not compare the FLAC checksum of all samples (RFC 9639, 8.2) and does not report missing pages of an Ogg
file (RFC 3533).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, MissingExtra
from cgid.recordings.recording import Contents

#: Samples of each channel to decode at once; before damage, only whole groups of this size are read.
_DECODED = 1024

#: Most samples of a channel in one byte of a file: a FLAC frame of 65535 equal samples takes about 12 bytes.
_BEST_PACKING = 1 << 13

#: Bytes of an Ogg page before its segment table.
_PAGE_HEAD = 27
_LAST_PAGE = 4


def read_audio(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of a FLAC or OGG file, which holds one recording: `variable` is not used.

    Full scale is 1.0, in "FS" unless the user gives a unit. A damaged or cut file gives the samples before the damage
    and a warning. Raises `BadData` if the header is damaged, `MissingExtra` without soundfile.
    """
    try:
        import soundfile
    except (ImportError, OSError):
        raise MissingExtra(
            f"{source}: FLAC and OGG need the library soundfile; install it with pip install 'cgid[formats]'"
        ) from None
    sound = _Sound(path=path, source=source, library=soundfile)
    with sound.opened() as file:
        n_channels, rate, n_samples = int(file.channels), float(file.samplerate), int(file.frames)
    return Contents(
        n_channels=n_channels,
        blocks=sound.blocks,
        # A header may declare more than a file of this size can hold.
        n_samples=n_samples if 0 <= n_samples <= _BEST_PACKING * path.stat().st_size else None,
        sampling_rate=rate,
        rate_from="header of the audio file",
        fallback_unit="FS",
        warnings=sound.warnings,
    )


@dataclass(frozen=True, kw_only=True)
class _Sound:
    path: Path
    source: str
    library: Any
    warnings: list[str] = field(default_factory=list)

    def opened(self) -> Any:
        # Open with Python first: its error tells that a file is missing.
        self.path.open("rb").close()
        try:
            return self.library.SoundFile(str(self.path))
        except (self.library.LibsndfileError, ValueError) as error:
            raise BadData(
                f"{self.source}: the audio file cannot be decoded ({_reason(error)}); copy or export it again"
            ) from None

    def blocks(self, length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        """Yield the samples of channels; at the end warn of missing ones."""
        picked, count = list(channels), 0
        checksum = _Checksum.of(self.path)
        end = _ogg_end(self.path)
        with self.opened() as file:
            most = min(length, _DECODED)
            declared = file.frames
            while True:
                try:
                    frames = file.read(most, dtype="int32" if checksum else "float64", always_2d=True)
                except self.library.LibsndfileError as error:
                    self._stopped(count, declared, _reason(error))
                    return
                if not len(frames):
                    break
                if checksum:
                    checksum.feed(frames)
                    frames = frames / 2.0**31
                count += len(frames)
                yield np.ascontiguousarray(frames.T[picked])
        if count < declared:
            self._stopped(count, declared, "it ends there")
        elif checksum and not checksum.holds:
            self.warnings.append("the samples are not those of the checksum in the header; some are damaged or missing")
        if end is not None:
            self._compare(*end, count)

    def _stopped(self, count: int, declared: int, reason: str) -> None:
        if not count:
            raise BadData(f"{self.source}: no sample can be decoded ({reason}); copy or export the file again")
        self.warnings.append(
            f"the header declares {declared} samples and {count} can be decoded ({reason}); the file looks cut off or "
            "damaged, what comes before was read"
        )

    def _compare(self, is_whole: bool, n_samples: int | None, count: int) -> None:
        if not is_whole:
            self.warnings.append(f"the file has no end; it looks cut off, the {count} samples before were read")
        elif n_samples not in (None, count):
            raise BadData(
                f"{self.source}: the file must hold {n_samples} samples and {count} can be decoded; some of its "
                "pages are damaged, copy or export it again"
            )


class _Checksum:
    """MD5 of the samples of a FLAC file, compared with the MD5 in its header."""

    def __init__(self, bits: int, expected: bytes) -> None:
        self._bits, self._expected, self._found = bits, expected, hashlib.md5(usedforsecurity=False)

    @classmethod
    def of(cls, path: Path) -> _Checksum | None:
        """Return the checksum before any samples; None if the header has none."""
        with path.open("rb") as file:
            head = file.read(42)
        if not head.startswith(b"fLaC") or len(head) < 42 or not any(head[26:42]):
            return None
        return cls(bits=((head[20] & 1) << 4 | head[21] >> 4) + 1, expected=head[26:42])

    def feed(self, frames: NDArray[np.int32]) -> None:
        """Add samples (n, n_channels) in the upper bits of 32."""
        numbers = np.ascontiguousarray(frames >> (32 - self._bits), "<i4")
        self._found.update(numbers.view(np.uint8).reshape(-1, 4)[:, : -(-self._bits // 8)].tobytes())

    @property
    def holds(self) -> bool:
        """Whether the checksum matches the header."""
        return self._found.digest() == self._expected


def _reason(error: Exception) -> str:
    # Remove the file name: the message already begins with it.
    return " ".join(str(error).rpartition("':")[2].split()).rstrip(".")[:120]


def _ogg_end(path: Path) -> tuple[bool, int | None] | None:
    """Return whether all pages of an Ogg file exist, and its samples per channel if the last page counts them.

    Returns None if it is not an Ogg file.
    """
    position, flags, number, at = 0, 0, -1, 0
    is_vorbis = False
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        while len(head := file.read(_PAGE_HEAD)) == _PAGE_HEAD and head.startswith(b"OggS"):
            table = file.read(head[26])
            end = at + _PAGE_HEAD + head[26] + sum(table)
            if end > size or int.from_bytes(head[18:22], "little") != number + 1:
                break
            if not at:
                is_vorbis = file.read(7) == b"\x01vorbis"
            number, flags, at = number + 1, head[5], end
            position = int.from_bytes(head[6:14], "little", signed=True)
            file.seek(at)
        if not at and not head.startswith(b"OggS"):
            return None
    return at == size and bool(flags & _LAST_PAGE), position if is_vorbis else None
