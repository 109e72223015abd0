"""WAV files by blocks: what is whole is read, and what is not is said."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cgid.recordings.contents import Contents
from cgid.recordings.sound.pcm import MOST_NUMBERS
from cgid.recordings.sound.riff import ENDLESS, WaveHead, read_wave_head


def read_wav(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of a WAV file.

    Parameters
    ----------
    path : Path
        RIFF, RIFX or RF64 with integers of 8, 16, 24, 32 or 64 bits or floats of 32 or 64.
    source : str
        Its name in messages.
    variable : str or None
        Not used: such a file holds one recording.

    Returns
    -------
    Contents
        Integers scaled to a full scale of 1.0, floats as they are; both in "FS" if nobody says otherwise. Of a file
        that is cut off, or was never closed, the samples that are whole, and a warning.

    Raises
    ------
    BadData
        The file is cut off before the sound, is no WAV, or its encoding is none of the above.
    """
    with path.open("rb") as file:
        held = os.fstat(file.fileno()).st_size
        head = read_wave_head(file, lambda size: file.seek(size, os.SEEK_CUR), source)
        start = file.tell()
        warnings = list(head.warnings)
        size = _size_of_sound(file, head, start, held, warnings)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        most = min(length, max(1, MOST_NUMBERS // head.n_channels)) * head.frame_size
        picked = list(channels)
        with path.open("rb") as file:
            file.seek(start)
            for first in range(0, size, most):
                raw = file.read(min(most, size - first))
                whole = len(raw) - len(raw) % head.frame_size
                yield np.ascontiguousarray(head.coding.decoded(raw[:whole]).reshape(-1, head.n_channels).T[picked])
                if len(raw) < min(most, size - first):
                    warnings.append("the file became shorter while it was read; what is whole was read")
                    return

    return Contents(
        n_channels=head.n_channels,
        blocks=blocks,
        n_samples=size // head.frame_size,
        sampling_rate=head.sampling_rate,
        rate_from="header of the WAV file",
        fallback_unit="FS",
        start_time=head.start_time,
        warnings=warnings,
    )


def _size_of_sound(file: BinaryIO, head: WaveHead, start: int, held: int, warnings: list[str]) -> int:
    """Return the bytes of whole frames that are there; say where the sizes in the file are not true."""
    declared, follows = head.data_size, held - start
    # A recorder that was switched off, or a program that wrote to a pipe, never came back to fill in the size.
    never_closed = declared == 0 and follows > 0 and not _is_chunk(file, head, start, held)
    if never_closed or (declared >= ENDLESS and declared > follows):
        warnings.append(f"the file was not closed and does not say its length; all {follows} bytes of sound were read")
    elif declared > follows:
        warnings.append(
            f"the header declares {declared} bytes of sound and {follows} follow; the file looks cut off, what is "
            "whole was read"
        )
    else:
        follows = declared
        _check_end(file, head, start, held, warnings)
    return follows - follows % head.frame_size


def _check_end(file: BinaryIO, head: WaveHead, start: int, held: int, warnings: list[str]) -> None:
    """Say what contradicts the size of the sound, where the file holds all of it."""
    n_frames, left = divmod(head.data_size, head.frame_size)
    if left:
        warnings.append(
            f"{head.data_size} bytes of sound are not whole frames of {head.frame_size}; the last {left} were left out"
        )
    # Some programs count the numbers of all channels there.
    counted = head.n_frames or n_frames
    if counted not in (n_frames, n_frames * head.n_channels) and counted < ENDLESS:
        warnings.append(f"the header says {counted} samples a channel and there are {n_frames}; check the file")
    end = start + head.data_size
    # Sound of an odd size is followed by a zero, which some programs forget.
    if end + end % 2 < held and not any(_is_chunk(file, head, at, held) for at in (end, end + 1)):
        warnings.append(
            f"{held - end} bytes behind the declared sound are no part of a WAV file and were left out; check the file"
        )
    elif 0 < head.outer_size < ENDLESS and not 0 <= held - 8 - head.outer_size <= 1:
        warnings.append(
            f"the file must be of {head.outer_size + 8} bytes by its header and is of {held}; check whether it is whole"
        )


def _is_chunk(file: BinaryIO, head: WaveHead, at: int, held: int) -> bool:
    """Return whether a chunk that ends within the file begins at a byte."""
    file.seek(at)
    name, size = file.read(4), int.from_bytes(file.read(4), "big" if head.coding.big_endian else "little")
    return len(name) == 4 and all(32 <= byte < 127 for byte in name) and at + 8 + size <= held + 1
