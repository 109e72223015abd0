"""NPY files by blocks, without pickle and without believing what their header declares."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.contents import Contents
from cgid.recordings.sound.pcm import MOST_NUMBERS

#: Longer headers are those of damaged files.
HEADER_SIZE = 1 << 16


@dataclass(frozen=True, kw_only=True)
class ArrayHead:
    """What an NPY header says, with rows and columns understood as channels and samples.

    Attributes
    ----------
    shape : tuple of int
        As written.
    n_channels, n_samples : int
    dtype : dtype
        Of the numbers as written.
    offset : int
        Bytes before the first number.
    by_sample : bool
        The numbers of one sample stand together, not those of one channel.
    """

    shape: tuple[int, ...]
    n_channels: int
    n_samples: int
    dtype: np.dtype[Any]
    offset: int
    by_sample: bool

    @property
    def size(self) -> int:
        """Bytes of all numbers."""
        # The product is exact in Python's integers, so no declared shape can overflow or allocate anything.
        return self.n_channels * self.n_samples * self.dtype.itemsize

    def decoded(self, raw: bytes, n_channels: int) -> NDArray[Any]:
        """Return numbers written sample by sample, or all of one channel, as (n_channels, n_samples)."""
        numbers = np.frombuffer(raw, self.dtype).reshape(-1, n_channels).T
        as_is = self.dtype.kind == "f" and self.dtype.itemsize in (4, 8)
        # A long double beyond float64 becomes infinite, which is refused by its sample.
        with np.errstate(all="ignore"):
            return np.array(numbers, dtype=self.dtype.newbyteorder("=") if as_is else np.float64, order="C")


def read_npy(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of an NPY file.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        Not used: such a file holds one array.

    Returns
    -------
    Contents
        (n_samples,) is one channel. Two axes are (n_channels, n_samples), unless the second is the shorter
        one; they are then (n_samples, n_channels).

    Raises
    ------
    BadData
        The header is damaged; the type is not real numbers; the shape is empty, of more than two axes, or
        does not match the size of the file.

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
    """Return what the first `HEADER_SIZE` bytes of an NPY file declare; raises as `read_npy` does."""
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
    """Raise `BadData` unless the numbers declared are those that follow the header, and at least one."""
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
        # The header is a Python literal; a damaged one may warn about its syntax before it fails.
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
        # The literal goes through Python's own parser, whose ways to fail on damaged text are not countable.
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
        # The channels of a file that is cut while it is read stay of one length.
        whole = min(map(len, block)) // head.dtype.itemsize * head.dtype.itemsize
        yield np.concatenate([head.decoded(raw[:whole], 1) for raw in block])
        first += count


def _counts(head: ArrayHead, length: int, n_channels: int) -> Iterator[int]:
    """Yield how many samples are read each time."""
    most = min(length, max(1, MOST_NUMBERS // n_channels))
    for first in range(0, head.n_samples, most):
        yield min(most, head.n_samples - first)
