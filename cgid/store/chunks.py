"""Whether the chunks of a dataset can be unpacked, by what the file says of them.

HDF5 believes the index of chunks: one of no bytes crashes its checksum (2.0.0, `H5Zfletcher32`), one of too few leaves
another's numbers. So every entry is held against the file before anything is read.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import h5py

from cgid.errors import MissingExtra

#: What h5py raises on damaged files.
DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError)
#: HDF5 unpacks whole chunks; no sound writer makes larger ones [bytes].
LARGEST_CHUNK = 64 << 20
#: deflate packs no better, and what others pack better is no recording.
BEST_RATIO = 1100
#: But silence, which long frames without noise mostly are, by Zstandard and Blosc2: 512 KiB to some 30 bytes.
BEST_RATIO_OF_SILENCE = 1 << 15
#: Chunks that are kept, so that none is unpacked for every block anew: at least and at most so many bytes.
_LEAST_CACHE, _LARGEST_CACHE = 1 << 20, 128 << 20
_DEFLATE, _CHECKSUM = 1, 3
#: What is unpacked: deflate, shuffle, checksum, LZF; and with hdf5plugin Zstandard and Blosc2. Others, such as n-bit
#: and scale-offset, believe parameters that lie in the file.
_UNPACKED, _WITH_PLUGIN = (_DEFLATE, 2, _CHECKSUM, 32000), {32015: "Zstandard", 32026: "Blosc2"}


def storage_fault(item: h5py.Dataset, file_size: int, best_ratio: float = BEST_RATIO) -> str:
    """Return why the samples of a dataset must not or cannot be read, "" if they can.

    Raises
    ------
    MissingExtra
        They are packed by Zstandard or Blosc2, and the library is not installed.
    """
    # HDF5 would go through them all to say what is stored; each that is there takes a byte.
    if (n_chunks := _chunks_declared(item)) > file_size:
        return f"declares {n_chunks} chunks in a file of {file_size} bytes"
    declared, stored = item.size * item.dtype.itemsize, item.id.get_storage_size()
    if declared > best_ratio * stored or stored > file_size:
        return f"declares {declared} bytes and holds {min(stored, file_size)}"
    if item.chunks is None:
        return ""
    if chunk_bytes(item) > LARGEST_CHUNK:
        return f"has chunks of more than {LARGEST_CHUNK >> 20} MiB"
    filters = _filters(item)
    for code, _, _, label in filters:
        if not _is_unpacked(code):
            return f"is packed by filter {code} ({label.decode(errors='replace')}), which is not unpacked here"
    try:
        return _index_fault(item, file_size, [code for code, *_ in filters])
    except DAMAGE:
        return "has a damaged index of chunks"


def packs_silence(item: h5py.Dataset) -> bool:
    """Return whether one of its filters may reach `BEST_RATIO_OF_SILENCE`."""
    return any(code in _WITH_PLUGIN for code, *_ in _filters(item))


def _filters(item: h5py.Dataset) -> list[Any]:
    creation = item.id.get_create_plist()
    return [creation.get_filter(index) for index in range(creation.get_nfilters())]


def missing_chunks(item: h5py.Dataset) -> str:
    """Return how many chunks were never written, "" if all were."""
    if item.chunks is None:
        return ""
    expected = _chunks_declared(item)
    with suppress(*DAMAGE):
        there = item.id.get_num_chunks()
        if there < expected:
            return f"{expected - there} of {expected} chunks were never written; the fill value stands there"
    return ""


def cache_size(shape: tuple[int, ...], chunks: tuple[int, ...] | None, itemsize: int, across: int | None) -> int:
    """Return what the chunks take that hold one moment of all channels [bytes]; `across` is the channels' axis."""
    if chunks is None:
        return _LEAST_CACHE
    side_by_side = 1 if across is None else -(-shape[across] // chunks[across])
    return min(max(_LEAST_CACHE, side_by_side * _chunk_size(chunks, itemsize)), _LARGEST_CACHE)


def chunk_bytes(item: h5py.Dataset) -> int:
    """Return what a chunk takes, unpacked; nothing where there are none."""
    return _chunk_size(item.chunks, item.dtype.itemsize) if item.chunks else 0


def _chunk_size(chunks: tuple[int, ...], itemsize: int) -> int:
    return math.prod(chunks) * itemsize


def _chunks_declared(item: h5py.Dataset) -> int:
    return math.prod(
        -(-length // chunk) for length, chunk in zip(item.shape, item.chunks or item.shape, strict=True) if chunk
    )


def _is_unpacked(code: int) -> bool:
    if code in _WITH_PLUGIN:
        try:
            import hdf5plugin  # noqa: F401
        except ImportError:
            raise MissingExtra(
                f"files packed by {_WITH_PLUGIN[code]} need hdf5plugin, which is not installed: pip install "
                "'cgid[compression]'"
            ) from None
    return (code in _UNPACKED or code in _WITH_PLUGIN) and bool(h5py.h5z.filter_avail(code))


def _index_fault(item: h5py.Dataset, file_size: int, filters: list[int]) -> str:
    size = _chunk_size(item.chunks, item.dtype.itemsize)
    # The checksum of four bytes comes on top; without any filter a chunk is as long as its numbers.
    checksum = 4 if _CHECKSUM in filters else 0
    packed = any(code != _CHECKSUM for code in filters)
    best = size // BEST_RATIO if _DEFLATE in filters else 0
    least, most = (checksum + 1 + best, 2 * size + 4096) if packed else (size + checksum, size + checksum)
    # Of datasets that can grow HDF5 2.0.0 says other offsets than those it reads from.
    can_grow = None in item.maxshape
    places: set[tuple[int, ...]] = set()
    starts: set[int] = set()
    checked = sum(1 << index for index, code in enumerate(filters) if code == _CHECKSUM)

    def is_unsound(info: Any) -> bool | None:
        """Return True, which ends the walk through the index, or None."""
        places.add(info.chunk_offset)
        starts.add(info.byte_offset)
        whole = info.filter_mask == 0 and least <= info.size <= most
        # A filter that found nothing to gain is passed over for this chunk.
        whole = whole or (info.filter_mask != 0 and not info.filter_mask & checked and checksum < info.size <= most)
        aligned = all(
            first % chunk == 0 and (first < length or can_grow)
            for first, chunk, length in zip(info.chunk_offset, item.chunks, item.shape, strict=True)
        )
        inside = 0 < info.byte_offset <= info.byte_offset + info.size <= file_size
        return None if whole and aligned and inside else True

    # Two chunks in one place would be the numbers of one of them twice.
    if item.id.chunk_iter(is_unsound) or not len(places) == len(starts) == item.id.get_num_chunks():
        return "has a damaged index of chunks"
    return ""
