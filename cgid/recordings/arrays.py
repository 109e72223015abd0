"""Read NPY files and NPZ archives by blocks, without pickle and without allocating memory for declared sizes."""

from __future__ import annotations

import io
import os
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.recording import MAX_CHANNELS, MOST_NUMBERS, Contents, understood
from cgid.recordings.statements import Value, Values
from cgid.recordings.variables import Variable, contents_of

#: Longest header [bytes]; a longer one is damaged.
HEADER_SIZE = 1 << 16


@dataclass(frozen=True, kw_only=True)
class ArrayHead:
    """An NPY header, with rows and columns as channels and samples.

    shape, dtype : as written
    offset : bytes before the first number
    by_sample : whether the numbers of one sample are stored together, not those of one channel
    """

    shape: tuple[int, ...]
    n_channels: int
    n_samples: int
    dtype: np.dtype[Any]
    offset: int
    by_sample: bool

    @property
    def size(self) -> int:
        """Size of all numbers [bytes]."""
        # Python integers: no declared shape overflows.
        return self.n_channels * self.n_samples * self.dtype.itemsize

    def decoded(self, raw: bytes, n_channels: int) -> NDArray[Any]:
        """Return raw numbers, sample by sample or all of one channel, as (n_channels, n_samples)."""
        numbers = np.frombuffer(raw, self.dtype).reshape(-1, n_channels).T
        as_is = self.dtype.kind == "f" and self.dtype.itemsize in (4, 8)
        # Long doubles beyond float64 become infinite; such samples are rejected later.
        with np.errstate(all="ignore"):
            return np.array(numbers, dtype=self.dtype.newbyteorder("=") if as_is else np.float64, order="C")


def read_npy(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of an NPY file, which holds one array: `variable` is not used.

    (n_samples,) is one channel. Two axes are (n_channels, n_samples), or (n_samples, n_channels) if the second is
    shorter. Raises `BadData` if the header is damaged, the type is not real numbers, or the shape is empty, has more
    than two axes or does not match the file size.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(Path(folder) / "two.npy", np.zeros((1000, 2)))
    ...     contents = read_npy(Path(folder) / "two.npy", "two.npy", None)
    >>> contents.n_channels, contents.n_samples
    (2, 1000)
    """
    with path.open("rb") as file:
        head = array_head(file.read(HEADER_SIZE), source)
        held = os.fstat(file.fileno()).st_size - head.offset
    require_size(head, held, source)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with path.open("rb") as file:
            yield from (
                _by_sample(file, head, length, channels)
                if head.by_sample
                else _by_channel(file, head, length, channels)
            )

    return Contents(n_channels=head.n_channels, blocks=blocks, n_samples=head.n_samples)


def array_head(start: bytes, source: str) -> ArrayHead:
    """Parse the first `HEADER_SIZE` bytes of an NPY file; raises as `read_npy`."""
    shape, fortran_order, dtype, offset = _header(start, source)
    if dtype.kind not in "fiu":
        raise BadData(f"{source}: samples must be real numbers, got type {dtype}; save them as float64")
    if len(shape) not in (1, 2) or min(shape) < 0:
        raise BadData(f"{source}: samples must have one or two axes, got shape {shape}; save them as such")
    rows, columns = (1, *shape)[-2:]
    upright = len(shape) == 2 and columns < rows
    return ArrayHead(
        shape=shape,
        n_channels=columns if upright else rows,
        n_samples=rows if upright else columns,
        dtype=dtype,
        offset=offset,
        by_sample=upright != fortran_order or min(rows, columns) == 1,
    )


def require_size(head: ArrayHead, held: int, source: str) -> None:
    """Raise `BadData` unless at least one number is declared and all numbers fill the `held` bytes after the header."""
    if not head.size:
        raise BadData(f"{source}: a recording must hold at least one sample, got shape {head.shape}; record it again")
    if head.size != held:
        cure = "the file looks cut off, copy it again" if head.size > held else "save one array only"
        raise BadData(
            f"{source}: the header must match the file, it declares {head.size} bytes {head.shape} and {held} follow; "
            f"{cure}"
        )


def _header(start: bytes, source: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    file = io.BytesIO(start)
    with warnings.catch_warnings():
        # The header is a Python literal: damaged ones may cause syntax warnings before they fail.
        warnings.simplefilter("ignore")
        try:
            version = npy_format.read_magic(file)
            # Version 3 differs from 2 only in the encoding of field names, which real numbers do not have.
            read = {
                (1, 0): npy_format.read_array_header_1_0,
                (2, 0): npy_format.read_array_header_2_0,
                (3, 0): npy_format.read_array_header_2_0,
            }[version]
            shape, fortran_order, dtype = read(file)
        # Python's parser reads the literal and raises many kinds of errors on damaged text.
        except Exception:
            raise BadData(f"{source}: the header of the NPY file is damaged; copy or save it again") from None
    return shape, fortran_order, dtype, file.tell()


def _by_sample(file: BinaryIO, head: ArrayHead, length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
    picked, frame_size = list(channels), head.n_channels * head.dtype.itemsize
    file.seek(head.offset)
    for count in _counts(head, length, head.n_channels):
        raw = file.read(count * frame_size)
        yield np.ascontiguousarray(head.decoded(raw[: len(raw) - len(raw) % frame_size], head.n_channels)[picked])


def _by_channel(file: BinaryIO, head: ArrayHead, length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
    first = 0
    for count in _counts(head, length, len(channels)):
        block = []
        for channel in channels:
            file.seek(head.offset + (channel * head.n_samples + first) * head.dtype.itemsize)
            block.append(file.read(count * head.dtype.itemsize))
        # Keep all channels equally long if the file is cut while it is read.
        whole = min(map(len, block)) // head.dtype.itemsize * head.dtype.itemsize
        yield np.concatenate([head.decoded(raw[:whole], 1) for raw in block])
        first += count


def _counts(head: ArrayHead, length: int, n_channels: int) -> Iterator[int]:
    """Yield the number of samples of each read."""
    most = min(length, max(1, MOST_NUMBERS // n_channels))
    for first in range(0, head.n_samples, most):
        yield min(most, head.n_samples - first)


#: Largest value [bytes] that may state something; larger ones are samples.
_SMALL = 1 << 16

#: Most arrays in an archive; one with more is hostile.
_MOST_MEMBERS = 10_000

#: Best compression ratio of deflate (zlib technical details); an array that declares more is damaged.
_BEST_PACKING = 1032

#: Most channels, stored one after the other, to unpack at the same time.
_MOST_SIDE_BY_SIDE = 64

#: Bytes, or numbers, to unpack at once.
_PIECE = 1 << 18


_DAMAGED = ("the archive is damaged or cut off", "copy or save it again")


def read_npz(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of an array in an NPZ archive, or of several of one length.

    Values such as ``fs`` or ``unit`` give rate and unit; an array of times of the same length also gives the rate.
    Raises `BadData` if the archive is damaged (checksums are compared at the end of reading), or holds no array, or
    holds several and `variable` (a name or pattern) selects none.
    """
    variables: list[Variable] = []
    statements: dict[str, Values] = {}
    with understood(source, *_DAMAGED), zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        if len(members) > _MOST_MEMBERS:
            raise BadData(f"{source}: an archive must hold at most {_MOST_MEMBERS} arrays, it holds {len(members)}")
        for member in members:
            group, _, name = member.filename.removesuffix(".npy").rpartition("/")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise BadData(f"{source}: {name} must be stored or deflated as NumPy does; save it again")
            if member.file_size <= _SMALL and (value := _value(archive.read(member))) is not None:
                statements[group] = {**statements.get(group, {}), name: value}
            elif (found := _variable(archive, path, member, source)) is not None:
                variables.append(found)
    return contents_of(variables, statements, source, variable, [])


def _variable(archive: zipfile.ZipFile, path: Path, member: zipfile.ZipInfo, source: str) -> Variable | None:
    """Return an array of the archive that may be the recording; None if it does not hold real numbers."""
    group, _, name = member.filename.removesuffix(".npy").rpartition("/")
    with archive.open(member) as file:
        start = file.read(HEADER_SIZE)
    try:
        head = array_head(start, f"{source}: {name}")
    except BadData:
        # Texts, objects and arrays of three axes may accompany the recording.
        return None
    held = member.file_size - head.offset
    fault = ""
    if head.size != held or held > _BEST_PACKING * member.compress_size + _SMALL:
        fault = f"declares {head.size} bytes {head.shape} and holds {held} in {member.compress_size} packed ones"
    elif not head.by_sample and head.n_channels > _MOST_SIDE_BY_SIDE:
        fault = f"of {head.n_channels} channels must be saved as (n_samples, n_channels)"

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[np.float64]]:
        with understood(source, *_DAMAGED), zipfile.ZipFile(path) as again:
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
            # Read instead of seek: after seeking, zipfile does not compare checksums.
            _pass_over(file, head.offset + (0 if head.by_sample else channel * head.n_samples * width))
        most = min(length, max(1, _PIECE // together))
        for first in range(0, head.n_samples, most):
            size = min(most, head.n_samples - first) * together * width
            rows = np.concatenate([head.decoded(_exactly(file, size), together) for file in files])
            yield np.ascontiguousarray(rows[list(channels)]) if head.by_sample else rows
        # zipfile compares the checksum at the end of the array, after the last channel.
        last = files[0 if head.by_sample else int(np.argmax(channels))]
        while last.read(_PIECE):
            pass


def _pass_over(file: IO[bytes], size: int) -> None:
    while size > 0:
        size -= len(_exactly(file, min(size, _PIECE)))


def _exactly(file: IO[bytes], size: int) -> bytes:
    raw = file.read(size)
    if len(raw) < size:
        raise EOFError("it ends too early")
    return raw


def _value(raw: bytes) -> Value | None:
    """Return a single number, a text or a list of texts; None for any other array."""
    try:
        with warnings.catch_warnings():
            # Damaged headers may cause syntax warnings before they fail.
            warnings.simplefilter("ignore")
            array = npy_format.read_array(io.BytesIO(raw), allow_pickle=False)
    # Python's parser reads the header and raises many kinds of errors on damaged text.
    except Exception:
        return None
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    if array.dtype.kind == "U" and array.size:
        texts = [str(text) for text in array.ravel()[:MAX_CHANNELS]]
        return texts[0] if array.size == 1 else texts
    return float(array.ravel()[0]) if array.dtype.kind in "fiu" and array.size == 1 else None
