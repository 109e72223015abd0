"""Checks of HDF5 files before reading: plain arrays in the same file, of declared sizes that its bytes allow.

HDF5 trusts files: in the index of chunks, an empty chunk crashes its checksum (2.0.0, `H5Zfletcher32`), and a short
chunk leaves the numbers of another. So declared sizes and every index entry are checked against the file first. These
checks cannot rule out that a crafted or damaged file ends or hangs the process.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py

from cgid.errors import BadData, CgidError, NoInput, optional
from cgid.store.description import DAMAGE

#: HDF5 unpacks complete chunks; no reasonable writer makes larger ones [bytes].
_MAX_CHUNK_SIZE = 64 << 20
#: The best ratio of deflate; no recording compresses better with other filters.
BEST_RATIO = 1100
#: Exception: silence, most of a long frame without noise. Zstandard and Blosc2 pack 512 KiB of it to some 30 bytes.
_BEST_RATIO_OF_SILENCE = 1 << 15
#: Limits of the chunk cache [bytes], which avoids unpacking a chunk again for every block.
_MIN_CACHE, _MAX_CACHE = 1 << 20, 128 << 20
#: Longest name of a format [bytes].
_MAX_NAME_LENGTH = 4096
_DEFLATE, _CHECKSUM = 1, 3
#: Allowed filters: deflate, shuffle, checksum, LZF, and those of hdf5plugin below. Others, such as n-bit and
#: scale-offset, trust parameters in the file.
_UNPACKED = (_DEFLATE, 2, _CHECKSUM, 32000)
_WITH_PLUGIN = {32001: "Blosc", 32004: "LZ4", 32015: "Zstandard", 32026: "Blosc2"}


def storage_fault(item: h5py.Dataset, file_size: int, best_ratio: float = BEST_RATIO) -> str:
    """Return why the samples of a dataset cannot or must not be read, "" if they can."""
    # First, because HDF5 visits all chunks to report the stored size; each chunk takes at least a byte.
    if (n_chunks := _chunks_declared(item)) > file_size:
        return f"declares {n_chunks} chunks in a file of {file_size} bytes"
    declared, stored = item.size * item.dtype.itemsize, item.id.get_storage_size()
    if declared > best_ratio * stored or stored > file_size:
        return f"declares {declared} bytes and contains {min(stored, file_size)}"
    if item.chunks is None:
        return ""
    if chunk_bytes(item) > _MAX_CHUNK_SIZE:
        return f"has chunks of more than {_MAX_CHUNK_SIZE >> 20} MiB"
    filters = codes_of(item)
    for code in filters:
        if not _is_unpacked(code):
            return f"is packed by filter {code}, which is not unpacked here"
    try:
        return _index_fault(item, file_size, filters)
    except DAMAGE:
        return "has a damaged index of chunks"


def codes_of(item: h5py.Dataset) -> list[int]:
    """Return HDF5's numbers of the filters of a dataset."""
    creation = item.id.get_create_plist()
    return [creation.get_filter(index)[0] for index in range(creation.get_nfilters())]


def missing_chunks(item: h5py.Dataset) -> str:
    """Describe how many chunks were never written, "" if all were."""
    if item.chunks is None:
        return ""
    expected = _chunks_declared(item)
    with suppress(*DAMAGE):
        n_stored = item.id.get_num_chunks()
        if n_stored < expected:
            return f"{expected - n_stored} of {expected} chunks were never written; they contain the fill value"
    return ""


def cache_size(item: h5py.Dataset, across: int | None) -> int:
    """Return the size of the chunks for one moment of all channels [bytes]; `across` is the axis of the channels."""
    side_by_side = 1 if across is None or not item.chunks else -(-item.shape[across] // item.chunks[across])
    return min(max(_MIN_CACHE, side_by_side * chunk_bytes(item)), _MAX_CACHE)


def chunk_bytes(item: h5py.Dataset) -> int:
    """Return the unpacked size of a chunk [bytes], 0 for contiguous storage."""
    return math.prod(item.chunks) * item.dtype.itemsize if item.chunks else 0


def _chunks_declared(item: h5py.Dataset) -> int:
    return math.prod(
        -(-length // chunk) for length, chunk in zip(item.shape, item.chunks or item.shape, strict=True) if chunk
    )


def _is_unpacked(code: int) -> bool:
    if code in _WITH_PLUGIN:
        optional("hdf5plugin", f"files packed by {_WITH_PLUGIN[code]} need", "compression")
    return (code in _UNPACKED or code in _WITH_PLUGIN) and bool(h5py.h5z.filter_avail(code))


def _index_fault(item: h5py.Dataset, file_size: int, filters: list[int]) -> str:
    size = chunk_bytes(item)
    # The checksum adds four bytes; without any other filter a chunk is as long as its numbers.
    checksum = 4 if _CHECKSUM in filters else 0
    packed = any(code != _CHECKSUM for code in filters)
    best = size // BEST_RATIO if _DEFLATE in filters else 0
    min_size, max_size = (checksum + 1 + best, 2 * size + 4096) if packed else (size + checksum, size + checksum)
    # For datasets that can grow, HDF5 2.0.0 reports other offsets than it reads from.
    can_grow = None in item.maxshape
    offsets: set[tuple[int, ...]] = set()
    starts: set[int] = set()
    checked = sum(1 << index for index, code in enumerate(filters) if code == _CHECKSUM)

    def is_unsound(info: Any) -> bool | None:
        """Return True, which ends the iteration over the index, or None."""
        offsets.add(info.chunk_offset)
        starts.add(info.byte_offset)
        fits = info.filter_mask == 0 and min_size <= info.size <= max_size
        # HDF5 skips a filter for a chunk that it cannot shrink.
        fits = fits or (info.filter_mask != 0 and not info.filter_mask & checked and checksum < info.size <= max_size)
        aligned = all(
            first % chunk == 0 and (first < length or can_grow)
            for first, chunk, length in zip(info.chunk_offset, item.chunks, item.shape, strict=True)
        )
        inside = 0 < info.byte_offset <= info.byte_offset + info.size <= file_size
        return None if fits and aligned and inside else True

    # Two chunks at one offset would give the same numbers twice.
    if item.id.chunk_iter(is_unsound) or not len(offsets) == len(starts) == item.id.get_num_chunks():
        return "has a damaged index of chunks"
    return ""


#: Limits of the members of a group, the attributes of an object and their size [bytes]; our files have a few dozen.
_MAX_MEMBERS, MAX_ATTRIBUTES, _MAX_ATTRIBUTES = 4096, 256, 8 << 20
#: Datasets with a checked chunk index; the key contains the state of the file.
_sound_cache: set[tuple[Any, ...]] = set()


#: State of a file: device, inode, size, and time of the last change [ns].
Identity = tuple[int, int, int, int]


def identity_of(about: os.stat_result) -> Identity:
    """Return the identity of a file."""
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns


def readable(path: Path, **options: int) -> h5py.File:
    """Return an HDF5 file open for reading, also one that other code of this process has open; raises as h5py."""
    try:
        # A lock would keep writers out, and fails on some network file systems; files are replaced, never changed.
        return h5py.File(path, "r", locking=False, **options)
    except OSError:
        # HDF5 opens a file a second time in a process only with the same kind of lock; a damaged one opens with none.
        for locking in (None, True, "best-effort"):
            with suppress(OSError):
                return h5py.File(path, "r", locking=locking, **options)
        raise


@contextmanager
def opened(path: Path, source: str, identity: Identity | None = None) -> Iterator[h5py.File]:
    """Yield an HDF5 file open for reading; raises `BadData` if it is damaged, or not in the state `identity`."""
    try:
        if not path.is_file():
            raise BadData(f"{source}: must be a regular file; copy it to one first")
        file = readable(path)
    except PermissionError as error:
        raise NoInput(f"{source}: cannot be read ({error.strerror}); see to its permissions") from None
    except CgidError:  # a pipe would wait for its writer
        raise
    except DAMAGE:
        require_closed(path, source)
        raise BadData(
            f"{source}: must be a readable HDF5 file, it is empty, truncated or no HDF5 file; copy it again, or "
            "generate it again"
        ) from None
    with file, clear_damage(source):
        if identity not in (None, identity_of(os.fstat(file.id.get_vfd_handle()))):
            raise BadData(f"{source}: has been replaced by another while it was read; read it again")
        yield file


def require_closed(path: Path, source: str) -> None:
    """Raise `BadData` if the superblock of an HDF5 file (version 3) says that a program has it open for writing."""
    with path.open("rb") as file:
        superblock = file.read(12)
    if len(superblock) == 12 and superblock[8] == 3 and superblock[11]:
        raise BadData(
            f"{source}: the HDF5 file must be closed, a program has it open for writing or was killed; close it, or "
            "run h5clear -s on a copy"
        )


@contextmanager
def clear_damage(
    source: str, what: str = "is damaged", hint: str = "copy it again, or generate it again"
) -> Iterator[None]:
    """Turn h5py's errors on a damaged file into `BadData`."""
    try:
        yield
    except CgidError:
        raise
    except DAMAGE as error:
        reason = " ".join(str(error).split())
        raise BadData(f"{source}: {what} ({reason}); {hint}") from None


def plain_dataset(file: h5py.File, name: str, source: str, best_ratio: float = BEST_RATIO) -> h5py.Dataset:
    """Return a dataset stored in this file and large enough for its declared size; links could read other files."""
    for part in (name.split("/")[0], name):
        if not is_inside(file, part):
            raise BadData(f"{source}: {part} must be in the file itself; it is missing or a link")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual or dataset.dtype.hasobject:
        raise BadData(f"{source}: {name} must be a plain dataset inside the file")
    if dataset.shape is not None:
        _require_borne_out(file, dataset, source, best_ratio)
    return dataset


def _require_borne_out(file: h5py.File, dataset: h5py.Dataset, source: str, best_ratio: float) -> None:
    """Raise `BadData` unless the stored bytes are complete and suffice for the declared size."""
    about = Path(file.filename).stat()
    key = (file.filename, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns, dataset.name, best_ratio)
    if key in _sound_cache:
        return
    # Our own files are read in batches, whatever size they declare.
    if not _WITH_PLUGIN.keys().isdisjoint(codes_of(dataset)):
        best_ratio = max(best_ratio, _BEST_RATIO_OF_SILENCE)
    fault = storage_fault(dataset, about.st_size, best_ratio) or missing_chunks(dataset)
    if fault:
        raise BadData(f"{source}: {dataset.name[1:]} {fault}; the file is damaged or hostile, generate it again")
    if len(_sound_cache) >= _MAX_MEMBERS:
        _sound_cache.clear()
    _sound_cache.add(key)


def is_inside(file: h5py.File, name: str) -> bool:
    """Return whether this name exists and is no soft or external link, without following it."""
    links = file.id.links
    return bool(links.exists(name.encode()) and links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD)


def members(file: h5py.File, name: str, source: str) -> list[str]:
    """Return the names in a group of the file itself."""
    if not is_inside(file, name) or not isinstance(file[name], h5py.Group):
        raise BadData(f"{source}: {name} must be a group of the file itself; it is missing, a link or a dataset")
    group = file[name]
    if len(group) > _MAX_MEMBERS:
        raise BadData(f"{source}: {name} must have at most {_MAX_MEMBERS} columns, got {len(group)}")
    return list(group)


def attributes_of(item: h5py.HLObject, source: str) -> dict[str, Any]:
    """Return the attributes that are one number or one fixed-length string; cgid writes and reads no others."""
    attributes: dict[str, Any] = {}
    left = _MAX_ATTRIBUTES
    if len(item.attrs) > MAX_ATTRIBUTES:
        raise BadData(f"{source}: {item.name} must have at most {MAX_ATTRIBUTES} attributes, got {len(item.attrs)}")
    for name in item.attrs:
        stored = item.attrs.get_id(name)
        left -= stored.dtype.itemsize + len(name)
        if left < 0:
            raise BadData(f"{source}: attributes of {item.name} must take at most {_MAX_ATTRIBUTES >> 20} MiB")
        # Python has no numbers of more than eight bytes.
        if stored.shape == () and (
            stored.dtype.kind == "S" or (stored.dtype.kind in "biuf" and stored.dtype.itemsize <= 8)
        ):
            value = item.attrs[name]
            attributes[name] = value.decode(errors="replace") if isinstance(value, bytes) else value.item()
    return attributes


def format_of(path: Path) -> str:
    """Return the attribute `format` of the root, "" if there is none; raises `BadData` if the file cannot be opened."""
    with opened(path, str(path)) as file:
        stored = file.attrs.get_id("format") if "format" in file.attrs else None
        if stored is None or stored.shape != () or stored.dtype.kind != "S" or stored.dtype.itemsize > _MAX_NAME_LENGTH:
            return ""
        return bytes(file.attrs["format"]).decode(errors="replace")
