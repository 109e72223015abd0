"""Read the arrays of NPY, NPZ and HDF5 files (also MATLAB v7.3), without pickle, within limits for declared sizes."""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.recordings.recording import MAX_ARRAYS, MAX_CHANNELS, Asked, Blocks, Remark, dataset_hint, library_errors
from cgid.recordings.text_layout import column_of
from cgid.recordings.variables import (
    MATLAB_OBJECT,
    Value,
    Variable,
    contents_of,
    full_scale_of,
    is_statement,
    orientation,
)

if TYPE_CHECKING:
    from cgid.store.foreign import ForeignArray

#: Longest NPY header [bytes]; a longer one is damaged.
_HEADER_SIZE = 1 << 16


def read_npy(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of an NPY file; the longer of two axes is that of the samples."""
    with path.open("rb") as file:
        shape, fortran_order, dtype, offset = _header(file.read(_HEADER_SIZE), source)
        stored = os.fstat(file.fileno()).st_size - offset
    if dtype.names and len(shape) == 1 and math.prod(shape) * dtype.itemsize == stored:
        return _records(path, source, asked, shape[0], dtype, offset)
    if dtype.kind not in "fiu":
        raise BadData(f"{source}: samples must be real numbers, got type {dtype}; save them as float64")
    if len(shape) not in (1, 2) or min(shape) < 0:
        raise BadData(f"{source}: samples must have one or two axes, got shape {shape}; save them as such")
    declared = math.prod(shape) * dtype.itemsize
    if not declared:
        raise BadData(f"{source}: a recording must contain at least one sample, got shape {shape}; record it again")
    if declared != stored:
        hint = "the file looks cut off, copy it again" if declared > stored else "save one array only"
        raise BadData(
            f"{source}: the header must match the file, it declares {declared} bytes {shape} and {stored} follow; "
            f"{hint}"
        )
    rows, columns = (1, *shape)[-2:]
    is_upright = len(shape) == 2 and columns < rows
    n_samples, n_channels = (rows, columns) if is_upright else (columns, rows)
    by_sample = is_upright != fortran_order or n_channels == 1

    def read(length: int, channels: Sequence[int], begin: int = 0) -> Iterator[NDArray[Any]]:
        # Either the numbers of one sample are contiguous, or those of one channel.
        together, picked = (n_channels, list(channels)) if by_sample else (1, [0])
        starts = [0] if by_sample else [channel * n_samples for channel in channels]
        with path.open("rb") as file:
            for first in range(begin, n_samples, length):
                n = min(length, n_samples - first)
                parts = []
                for start in starts:
                    file.seek(offset + (start + first * together) * dtype.itemsize)
                    numbers = np.fromfile(file, dtype, n * together)
                    if numbers.size < n * together:
                        raise BadData(f"{source}: the file became shorter while it was read; read it again")
                    parts.append(numbers.reshape(-1, together).T[picked])
                yield _floats(np.concatenate(parts))

    return Blocks(
        n_channels=n_channels,
        read=read,
        seekable=True,
        n_samples=n_samples,
        full_scales=[full_scale_of(dtype)] * n_channels,
        integers=[dtype.kind in "iu"] * n_channels,
    )


def _records(path: Path, source: str, asked: Asked, n_samples: int, dtype: np.dtype[Any], offset: int) -> Blocks:
    """Return the fields of the records of an NPY file as channels, with the times among them."""

    def variable(name: str, stored: np.dtype[Any]) -> Variable:
        def read(length: int, _channels: Sequence[int], begin: int = 0) -> Iterator[NDArray[Any]]:
            with path.open("rb") as file:
                file.seek(offset + begin * dtype.itemsize)
                for first in range(begin, n_samples, length):
                    n = min(length, n_samples - first)
                    records = np.fromfile(file, dtype, n)
                    if records.size < n:
                        raise BadData(f"{source}: the file became shorter while it was read; read it again")
                    yield _floats(records[name][None])

        column = column_of(name)
        return Variable(
            name=column.name or name,
            n_channels=1,
            n_samples=n_samples,
            read=read,
            seekable=True,
            about={"unit": column.unit} if column.unit else {},
            full_scale=full_scale_of(stored),
            is_integer=stored.kind in "iu",
        )

    fields = [(name, dtype[name]) for name in dtype.names or ()]
    variables = [variable(name, stored) for name, stored in fields if stored.kind in "fiu" and not stored.shape]
    left_out = [name for name, stored in fields if stored.kind not in "fiu" or stored.shape]
    warnings: list[str] = [Remark(f"field {name} contains no numbers and is left out") for name in left_out]
    return contents_of(variables, {}, source, asked, warnings, group_is_one=True)


def _header(start: bytes, source: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return shape, order, type and size of the header at the start of an NPY file."""
    file = io.BytesIO(start)
    with warnings.catch_warnings():
        # The header is a Python literal: damaged ones may cause syntax warnings before they fail.
        warnings.simplefilter("ignore")
        try:
            # Version 3 differs from 2 only in the encoding of field names, which real numbers do not have.
            is_first = npy_format.read_magic(file) == (1, 0)
            read = npy_format.read_array_header_1_0 if is_first else npy_format.read_array_header_2_0
            shape, fortran_order, dtype = read(file)
        # Python's parser reads the literal and raises many kinds of errors on damaged text.
        except Exception:
            raise BadData(f"{source}: the header of the NPY file is damaged; copy or save it again") from None
    return shape, fortran_order, dtype, file.tell()


def _floats(samples: NDArray[Any]) -> NDArray[Any]:
    """Return samples as contiguous float32 or float64 of this machine."""
    real = samples.dtype.newbyteorder("=") if samples.dtype.kind == "f" and samples.itemsize in (4, 8) else np.float64
    # Long doubles beyond float64 become infinite; such samples are rejected later.
    with np.errstate(all="ignore"):
        return np.ascontiguousarray(samples, real)


def require_readable_size(size: int, source: str, hint: str) -> None:
    """Raise `BadData` if arrays [bytes] are too large to be read completely."""
    if size > MAX_ARRAYS:
        raise BadData(
            f"{source}: the arrays of this format must be at most {MAX_ARRAYS >> 30} GiB, it "
            f"declares {size} bytes; {hint}"
        )


def blocks_of_arrays(
    arrays: Iterable[tuple[str, NDArray[Any]]], source: str, asked: Asked, warnings: list[str]
) -> Blocks:
    """Return the recording among arrays in memory, each with its path; single numbers and texts are metadata."""
    variables, statements = [], dict[str, dict[str, Value]]()
    for array_path, array in arrays:
        group, _, name = array_path.rpartition("/")
        axes = orientation(array.shape)
        if (value := _value(array)) is not None:
            statements.setdefault(group, {})[name] = value
        elif array.dtype.kind in "fiu" and axes is not None and array.size:
            variables.append(_variable(group, name, array, axes))
    return contents_of(variables, statements, source, asked, warnings)


def _value(array: NDArray[Any]) -> Value | None:
    """Return a single number, a text or a list of texts; None for any other array."""
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    if array.dtype.kind == "U" and array.size:
        texts = [str(text) for text in array.ravel()[:MAX_CHANNELS]]
        return texts[0] if array.size == 1 else texts
    return float(array.ravel()[0]) if array.dtype.kind in "fiu" and array.size == 1 else None


def _variable(group: str, name: str, array: NDArray[Any], axes: tuple[int | None, int]) -> Variable:
    across, along = axes
    rows = array.reshape(1, -1) if across is None else np.moveaxis(array, (across, along), (0, 1)).squeeze()

    def read(length: int, channels: Sequence[int], begin: int = 0) -> Iterator[NDArray[Any]]:
        for first in range(begin, rows.shape[1], length):
            yield _floats(rows[list(channels), first : first + length])

    return Variable(
        name=name,
        group=group,
        n_channels=rows.shape[0],
        n_samples=rows.shape[1],
        read=read,
        seekable=True,
        full_scale=full_scale_of(array.dtype),
        is_integer=array.dtype.kind in "iu",
    )


def read_npz(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of an array in an NPZ archive, or of several of one length."""
    arrays = []
    damage = library_errors(source, "the archive is damaged or cut off", "copy or save it again")
    with damage, zipfile.ZipFile(path) as archive, warnings.catch_warnings(action="ignore"):
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        require_readable_size(sum(member.file_size for member in members), source, "save one array as NPY")
        for member in members:
            with archive.open(member) as file:
                try:
                    shape, _, dtype, offset = _header(file.read(_HEADER_SIZE), source)
                except BadData:  # it is not the recording
                    continue
            if dtype.hasobject:  # pickled, so its declared size is meaningless
                continue
            declared, stored = math.prod(shape) * dtype.itemsize, member.file_size - offset
            if declared != stored:
                raise BadData(
                    f"{source}: {member.filename} declares {declared} bytes {shape} and contains {stored}; save it "
                    "again"
                )
            with archive.open(member) as file:
                array = npy_format.read_array(file, allow_pickle=False)
                file.read()  # zipfile compares the checksum at the end
            arrays.append((member.filename.removesuffix(".npy"), array))
    return blocks_of_arrays(arrays, source, asked, [])


# ---- HDF5 ------------------------------------------------------------------------------------------------------------


def read_generated(path: Path) -> Blocks:
    """Return the single channel of a recording made by `cgid generate`."""
    from cgid.store.reading import Recording

    recording = Recording(path)

    def read(length: int, channels: Sequence[int], begin: int = 0) -> Iterator[NDArray[Any]]:
        with closing(recording.blocks(length, begin)) as rows:
            for row in rows:
                yield row[None][list(channels)]

    return Blocks(
        n_channels=1,
        read=read,
        seekable=True,
        n_samples=recording.n_samples,
        units=[recording.unit],
        sampling_rate=recording.sampling_rate,
    )


def read_hdf5(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of one array of an HDF5 file, or of several arrays of one length."""
    # Values of the array, its groups and the root state rate, unit, start and names: the nearest first.
    from cgid.store.description import RECORDING_FORMAT, hdf5_format
    from cgid.store.foreign import array_blocks, survey

    stated_format = hdf5_format(path)
    if stated_format == RECORDING_FORMAT:
        if asked.variable not in (None, "samples"):
            raise InvalidValue(f"{source}: the variable of a recording of cgid is 'samples', got {asked.variable!r}")
        return read_generated(path)
    arrays, values, warnings, objects = survey(path, source, is_statement)
    warnings += [Remark(MATLAB_OBJECT.format(*one)) for one in objects]
    if stated_format is None or stated_format.startswith("cgid"):
        raise BadData(f"{source}: an HDF5 file is a dataset, not one recording; {dataset_hint()}")

    def variable_of(array: ForeignArray, axes: tuple[int | None, int]) -> Variable:
        def read(length: int, channels: Sequence[int], begin: int = 0) -> Iterator[NDArray[Any]]:
            return array_blocks(path, source, array, axes, length, channels, begin)

        across, along = axes
        return Variable(
            name=array.name.rpartition("/")[2],
            group=array.name.rpartition("/")[0],
            n_channels=1 if across is None else array.shape[across],
            n_samples=array.shape[along],
            read=read,
            seekable=True,
            about=array.attributes,
            full_scale=full_scale_of(array.dtype),
            is_integer=array.dtype.kind in "iu",
            fault=array.fault,
            warning=array.warning,
        )

    variables = [variable_of(array, axes) for array in arrays if (axes := orientation(array.shape)) is not None]
    return contents_of(variables, values, source, asked, warnings)
