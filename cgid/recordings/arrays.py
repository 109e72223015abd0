"""Read NPY, NPZ and HDF5 files by blocks, without pickle and without allocating memory for declared sizes.

HDF5 files, including MATLAB v7.3, are read by `cgid.store`.
"""

from __future__ import annotations

import io
import os
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.recordings.recording import DATASET_CURE, MAX_CHANNELS, Contents, understood
from cgid.recordings.variables import (
    Value,
    Values,
    Variable,
    contents_of,
    full_scale_of,
    is_statement,
    orientation,
)

if TYPE_CHECKING:
    from cgid.store.foreign import ForeignArray

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

    def starts(self, channels: Sequence[int]) -> list[int]:
        """Return where the numbers of each channel begin [bytes]; all begin at 0 if stored sample by sample."""
        size = self.n_samples * self.dtype.itemsize
        return [0] if self.by_sample else [channel * size for channel in channels]

    def decoded(self, raw: bytes, n_channels: int) -> NDArray[Any]:
        """Return raw numbers, sample by sample or all of one channel, as (n_channels, n_samples)."""
        whole = len(raw) - len(raw) % (n_channels * self.dtype.itemsize)
        numbers = np.frombuffer(raw[:whole], self.dtype).reshape(-1, n_channels).T
        as_is = self.dtype.kind == "f" and self.dtype.itemsize in (4, 8)
        # Long doubles beyond float64 become infinite; such samples are rejected later.
        with np.errstate(all="ignore"):
            return np.array(numbers, dtype=self.dtype.newbyteorder("=") if as_is else np.float64, order="C")


def read_npy(path: Path, source: str) -> Contents:
    """Return the channels of an NPY file, which holds one array.

    (n_samples,) is one channel. Two axes are (n_channels, n_samples), or (n_samples, n_channels) if the second is
    shorter. Raises `BadData` if the header is damaged, the type is not real numbers, or the shape is empty, has more
    than two axes or does not match the file size.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(Path(folder) / "two.npy", np.zeros((1000, 2)))
    ...     contents = read_npy(Path(folder) / "two.npy", "two.npy")
    >>> contents.n_channels, contents.n_samples
    (2, 1000)
    """
    with path.open("rb") as file:
        head = array_head(file.read(HEADER_SIZE), source)
        held = os.fstat(file.fileno()).st_size - head.offset
    if not head.size:
        raise BadData(f"{source}: a recording must hold at least one sample, got shape {head.shape}; record it again")
    if head.size != held:
        cure = "the file looks cut off, copy it again" if head.size > held else "save one array only"
        raise BadData(
            f"{source}: the header must match the file, it declares {head.size} bytes {head.shape} and {held} follow; "
            f"{cure}"
        )

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with path.open("rb") as file:

            def read(index: int, start: int, size: int) -> bytes:
                file.seek(head.offset + start)
                return file.read(size)

            yield from _blocks(read, head, length, channels)

    return Contents(
        n_channels=head.n_channels,
        blocks=blocks,
        n_samples=head.n_samples,
        full_scales=[full_scale_of(head.dtype)] * head.n_channels,
        integers=[head.dtype.kind in "iu"] * head.n_channels,
    )


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


def _blocks(
    read: Callable[[int, int, int], bytes], head: ArrayHead, length: int, channels: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Yield channels; ``read(index, start, size)`` returns bytes of the array; `index` counts `ArrayHead.starts`."""
    together = head.n_channels if head.by_sample else 1
    frame_size = together * head.dtype.itemsize
    for first in range(0, head.n_samples, length):
        size = min(length, head.n_samples - first) * frame_size
        parts = [
            head.decoded(read(index, start + first * frame_size, size), together)
            for index, start in enumerate(head.starts(channels))
        ]
        # Keep all channels equally long if the file is cut while it is read.
        whole = min(part.shape[1] for part in parts)
        rows = np.concatenate([part[:, :whole] for part in parts])
        yield rows[list(channels)] if head.by_sample else rows


# ---- NPZ -------------------------------------------------------------------------------------------------------------

#: Largest value [bytes] that may state something; larger ones are samples.
_SMALL = 1 << 16

#: Most arrays in an archive; one with more is hostile.
_MOST_MEMBERS = 10_000

#: Best compression ratio of deflate (zlib technical details); an array that declares more is damaged.
_BEST_PACKING = 1032

#: Most channels, stored one after the other, to unpack at the same time.
_MOST_SIDE_BY_SIDE = 64

#: Bytes to unpack at once while passing over others.
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

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with understood(source, *_DAMAGED), zipfile.ZipFile(path) as again:
            yield from _unpacked(again, member.filename, head, length, channels)

    if not head.n_samples or not head.n_channels:
        return None
    return Variable(
        name=name,
        group=group,
        n_channels=head.n_channels,
        n_samples=head.n_samples,
        blocks=blocks,
        full_scale=full_scale_of(head.dtype),
        is_integer=head.dtype.kind in "iu",
        fault=fault,
    )


def _unpacked(
    archive: zipfile.ZipFile, name: str, head: ArrayHead, length: int, channels: Sequence[int]
) -> Iterator[NDArray[Any]]:
    with ExitStack() as stack:
        starts = head.starts(channels)
        files = [stack.enter_context(archive.open(name)) for _ in starts]
        for file, start in zip(files, starts, strict=True):
            # Read instead of seek: after seeking, zipfile does not compare checksums.
            _pass_over(file, head.offset + start)
        yield from _blocks(lambda index, start, size: _exactly(files[index], size), head, length, channels)
        # zipfile compares the checksum at the end of the array, after the last channel.
        last = files[int(np.argmax(starts))]
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


# ---- HDF5 ------------------------------------------------------------------------------------------------------------


def read_own(path: Path) -> Contents:
    """Return the single channel of a recording made by `cgid generate`."""
    from cgid.store.reading import Recording

    recording = Recording(path)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        with closing(recording.blocks(length)) as rows:
            for row in rows:
                yield row[None][list(channels)]

    return Contents(
        n_channels=1,
        blocks=blocks,
        n_samples=recording.n_samples,
        units=[recording.unit],
        sampling_rate=recording.sampling_rate,
    )


#: Attributes of packed numbers and their defaults: CF conventions 1.11, section 8.1.
_PACKING = {"scale_factor": 1.0, "add_offset": 0.0}


def read_hdf5(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of one array of an HDF5 file, or of several arrays of one length.

    Rate, unit, start and channel names come from attributes and single values of the array, its groups and the root,
    the nearest first; the rate else from an array of times next to it. Packed numbers are unpacked by ``scale_factor``
    and ``add_offset`` (CF conventions). Raises `BadData` if the file is damaged, is a dataset of cgid, or holds no
    array or several; or if the array is in another file, declares more than is stored, or needs an unavailable filter.
    """
    from cgid.store.description import RECORDING_FORMAT, hdf5_format
    from cgid.store.foreign import array_blocks, survey

    said = hdf5_format(path)
    if said == RECORDING_FORMAT:
        if variable not in (None, "samples"):
            raise InvalidValue(f"{source}: the variable of a recording of cgid is 'samples', got {variable!r}")
        return read_own(path)
    arrays, values, warnings = survey(path, source, lambda name: name in _PACKING or is_statement(name))
    if said is None or said.startswith("cgid"):
        raise BadData(f"{source}: an HDF5 file is a dataset, not one recording; {DATASET_CURE}")

    def variable_of(array: ForeignArray, axes: tuple[int | None, int]) -> Variable:
        about = dict(array.attributes)
        factor, offset = (_number(about.pop(name, default)) for name, default in _PACKING.items())

        def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
            stored = array_blocks(path, source, array, axes, length, channels)
            return stored if (factor, offset) == (1.0, 0.0) else (offset + factor * block for block in stored)

        across, along = axes
        return Variable(
            name=array.name.rpartition("/")[2],
            group=array.name.rpartition("/")[0],
            n_channels=1 if across is None else array.shape[across],
            n_samples=array.shape[along],
            blocks=blocks,
            about=about,
            is_integer=array.is_integer and (factor, offset) == (1.0, 0.0),
            fault=array.fault,
            warning=array.warning,
        )

    variables = [variable_of(array, axes) for array in arrays if (axes := orientation(array.shape)) is not None]
    return contents_of(variables, values, source, variable, warnings)


def _number(value: Any) -> float:
    """Return a number unchanged, nan for anything else, so that the samples are rejected."""
    return float(value) if isinstance(value, int | float) else float("nan")
