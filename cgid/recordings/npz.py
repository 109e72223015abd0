"""NPZ archives: their arrays by blocks without unpacking them, their small values as what is said about them."""

from __future__ import annotations

import io
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.arrays import HEADER_SIZE, ArrayHead, array_head
from cgid.recordings.contents import MAX_CHANNELS, Contents
from cgid.recordings.statements import Value, Values
from cgid.recordings.variables import Variable, contents_of

#: Values of more bytes than this are arrays, not statements.
_SMALL = 1 << 16

#: Archives hold no more arrays than this by intention.
_MOST_MEMBERS = 10_000

#: Deflate packs 1032 to 1 at best (zlib's technical details); what declares more is not true.
_BEST_PACKING = 1032

#: Channels that stand one behind the other are unpacked side by side.
_MOST_SIDE_BY_SIDE = 64

#: Bytes, and numbers, that are unpacked at once.
_PIECE = 1 << 18


def read_npz(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of an array in an NPZ archive.

    Values such as ``fs`` or ``unit`` in the archive say what they are named; an array of times of the same length
    gives the sampling rate.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        The name of an array, or a pattern for several of one length; needed where several can be meant.

    Raises
    ------
    BadData
        The archive is damaged (it has checksums, which are compared when all has been read), or none or several of
        its arrays can be meant.
    """
    variables: list[Variable] = []
    said: dict[str, Values] = {}
    with _sound(source), zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        if len(members) > _MOST_MEMBERS:
            raise BadData(f"{source}: an archive must hold at most {_MOST_MEMBERS} arrays, it holds {len(members)}")
        for member in members:
            group, _, name = member.filename.removesuffix(".npy").rpartition("/")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise BadData(f"{source}: {name} must be stored or deflated as NumPy does; save it again")
            if member.file_size <= _SMALL and (value := _value(archive.read(member))) is not None:
                said[group] = {**said.get(group, {}), name: value}
            elif (found := _variable(archive, path, member, source)) is not None:
                variables.append(found)
    return contents_of(variables, said, source, variable, [])


def _variable(archive: zipfile.ZipFile, path: Path, member: zipfile.ZipInfo, source: str) -> Variable | None:
    """Return an array of the archive as something that may be the recording; None if it is not of real numbers."""
    group, _, name = member.filename.removesuffix(".npy").rpartition("/")
    with archive.open(member) as file:
        start = file.read(HEADER_SIZE)
    try:
        head = array_head(start, f"{source}: {name}")
    except BadData:
        # Texts, objects and arrays of three axes may lie beside the recording.
        return None
    held = member.file_size - head.offset
    fault = ""
    if head.size != held or held > _BEST_PACKING * member.compress_size + _SMALL:
        fault = f"declares {head.size} bytes {head.shape} and holds {held} in {member.compress_size} packed ones"
    elif not head.by_sample and head.n_channels > _MOST_SIDE_BY_SIDE:
        fault = f"of {head.n_channels} channels must be saved as (n_samples, n_channels)"

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[np.float64]]:
        with _sound(source), zipfile.ZipFile(path) as again:
            yield from _blocks(again, member.filename, head, length, channels)

    if not head.n_samples or not head.n_channels:
        return None
    return Variable(
        name=name,
        group=group,
        n_channels=head.n_channels,
        n_samples=head.n_samples,
        blocks=blocks,
        fault=fault,
    )


def _blocks(
    archive: zipfile.ZipFile, name: str, head: ArrayHead, length: int, channels: Sequence[int]
) -> Iterator[NDArray[np.float64]]:
    width, together = head.dtype.itemsize, head.n_channels if head.by_sample else 1
    with ExitStack() as stack:
        files = [stack.enter_context(archive.open(name)) for _ in (channels if not head.by_sample else [0])]
        for file, channel in zip(files, channels, strict=False):
            # By reading: an archive that is sought in does not compare its checksums.
            _pass_over(file, head.offset + (0 if head.by_sample else channel * head.n_samples * width))
        most = min(length, max(1, _PIECE // together))
        for first in range(0, head.n_samples, most):
            size = min(most, head.n_samples - first) * together * width
            rows = np.concatenate([head.decoded(_exactly(file, size), together) for file in files])
            yield np.ascontiguousarray(rows[list(channels)]) if head.by_sample else rows
        # The checksum is compared where the array ends, which is behind the last channel.
        last = files[0 if head.by_sample else int(np.argmax(channels))]
        while last.read(_PIECE):
            pass


def _pass_over(file: IO[bytes], size: int) -> None:
    while size > 0:
        size -= len(_exactly(file, min(size, _PIECE)))


def _exactly(file: IO[bytes], size: int) -> bytes:
    raw = file.read(size)
    if len(raw) < size:
        raise EOFError
    return raw


def _value(raw: bytes) -> Value | None:
    """Return a single number, a text or a list of texts; None if the array is something else."""
    try:
        with warnings.catch_warnings():
            # A damaged header may warn about its syntax before it fails.
            warnings.simplefilter("ignore")
            array = npy_format.read_array(io.BytesIO(raw), allow_pickle=False)
    # The header goes through Python's own parser, whose ways to fail on damaged text are not countable.
    except Exception:
        return None
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    if array.dtype.kind == "U" and array.size:
        texts = [str(text) for text in array.ravel()[:MAX_CHANNELS]]
        return texts[0] if array.size == 1 else texts
    return float(array.ravel()[0]) if array.dtype.kind in "fiu" and array.size == 1 else None


@contextmanager
def _sound(source: str) -> Iterator[None]:
    """Say what is wrong with an archive in one line."""
    try:
        yield
    except (FileNotFoundError, PermissionError):
        raise
    # Besides its own errors, zipfile raises RuntimeError on encrypted members and those of the parsers below it.
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, OSError, ValueError) as error:
        if isinstance(error, BadData):
            raise
        reason = " ".join(str(error).split())[:120] or "it ends too early"
        raise BadData(f"{source}: the archive is damaged or cut off ({reason}); copy or save it again") from None
