"""MATLAB files of version 5 to 7.2; those of 7.3 are HDF5."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.mat.elements import (
    MATRIX,
    NUMBERS,
    PACKED,
    TEXTS,
    Element,
    Order,
    Plain,
    Stored,
    Unpacked,
    byte_order,
    element_at,
    integers,
    top_elements,
)
from cgid.recordings.recording import Contents
from cgid.recordings.statements import Value, is_telling
from cgid.recordings.variables import Variable, contents_of, orientation

# Classes of arrays that are looked into.
_STRUCT, _CHAR, _SINGLE, _NUMERIC = 2, 4, 7, range(6, 16)
_COMPLEX, _LOGICAL = 0x0800, 0x0200
_DEEPEST, _MOST_AXES, _MOST_FIELDS, _LONGEST_TEXT = 16, 8, 4096, 4096


@dataclass
class _Found:
    """What a file holds so far."""

    order: Order
    source: str
    variables: list[Variable] = field(default_factory=list)
    said: dict[str, dict[str, Value]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Array:
    """Class, flags, shape and name of an array, and the first byte behind these."""

    code: int
    flags: int
    shape: tuple[int, ...]
    name: str
    place: int


def read_mat(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of one array of a MATLAB file, or of several arrays of one length.

    Parameters
    ----------
    path : Path
        The file, as ``save -v6`` and ``-v7`` write it. Fields of structs are named ``struct/field``.
    source : str
        Its name in messages.
    variable : str or None
        Name of an array, of a struct, or a pattern; None if there is one array only beside times.

    Returns
    -------
    Contents
        Two axes are channels and samples, the longer one that of the samples. The rate is what single values such as
        ``Fs`` or ``dt`` beside the array say, else an array of times does; ``unit`` likewise.

    Raises
    ------
    BadData
        The file is cut off or damaged, holds no real array or several, or declares more than is stored.
    """
    stored = Plain(path, source)
    order = byte_order(stored.read_at(0, min(stored.size, 128)))
    if order is None:
        raise BadData(f"{source}: must be a MATLAB file of version 5 or later, it is not; save it with -v7")
    found, warnings = _Found(order, source), list[str]()
    for element in top_elements(stored, order, warnings):
        if element.kind == PACKED:
            unpacked = Unpacked(stored, element, order, source)
            _look(unpacked, element_at(unpacked, 0, order), "", found, 0)
        elif element.kind == MATRIX:
            _look(stored, element, "", found, 0)
    if warnings and not found.variables:
        raise BadData(f"{source}: {warnings[0]}, and nothing whole stands before it; copy it again")
    contents = contents_of(found.variables, found.said, source, variable, warnings)
    stored.finish()
    return contents


def _look(stored: Stored, matrix: Element, name: str, found: _Found, depth: int) -> None:
    """Note what a matrix is; `name` is its path if it is a field."""
    if matrix.kind != MATRIX or not matrix.size or depth > _DEEPEST:
        return
    array = _array(stored, matrix, found)
    name = name or array.name
    count = math.prod(array.shape)
    if array.code == _STRUCT:
        _look_into(stored, matrix, array, name, found, depth)
    elif name and count and array.code == _CHAR and is_telling(name.rpartition("/")[2]):
        _note_text(stored, array, name, found)
    elif name and count and array.code in _NUMERIC and not array.flags & (_COMPLEX | _LOGICAL):
        _note_numbers(stored, matrix, array, name, count, found)


def _array(stored: Stored, matrix: Element, found: _Found) -> _Array:
    flags = element_at(stored, matrix.start, found.order)
    shape = element_at(stored, flags.end, found.order)
    name = element_at(stored, shape.end, found.order)
    first = integers(stored, flags, found.order, 1)
    lengths = integers(stored, shape, found.order, _MOST_AXES + 1)
    if not first or len(lengths) > _MOST_AXES or any(length < 0 for length in lengths) or name.size > _LONGEST_TEXT:
        raise BadData(f"{found.source}: the header of a variable is damaged; copy or save the file again")
    text = stored.read_at(name.start, name.size).decode("latin-1").rstrip("\0")
    return _Array(first[0] & 0xFF, first[0] & 0xFF00, tuple(lengths), text, name.end)


def _look_into(stored: Stored, matrix: Element, array: _Array, name: str, found: _Found, depth: int) -> None:
    """Note the fields of a struct, or of the structs of an array of them."""
    longest = element_at(stored, array.place, found.order)
    names = element_at(stored, longest.end, found.order)
    length = (integers(stored, longest, found.order, 1) or [0])[0]
    if not 0 < length <= 1024 or names.size // length > _MOST_FIELDS:
        return
    raw = stored.read_at(names.start, names.size)
    fields = [raw[k : k + length].split(b"\0")[0].decode("latin-1") for k in range(0, len(raw) - length + 1, length)]
    place, end = names.end, matrix.start + matrix.size
    # Without fields there is nothing, however many structs are declared.
    for index in range(math.prod(array.shape) if fields else 0):
        for part in fields:
            if place + 8 > end:
                return
            element = element_at(stored, place, found.order)
            owner = name if math.prod(array.shape) == 1 else f"{name}({index + 1})"
            _look(stored, element, f"{owner}/{part}", found, depth + 1)
            place = element.end


def _note_text(stored: Stored, array: _Array, name: str, found: _Found) -> None:
    element = element_at(stored, array.place, found.order)
    if element.kind not in TEXTS or element.size > _LONGEST_TEXT:
        return
    encoding = TEXTS[element.kind]
    if encoding in ("utf-16", "utf-32"):
        encoding += "-le" if found.order == "little" else "-be"
    text = stored.read_at(element.start, element.size).decode(encoding, "replace").strip()
    stored.finish()
    group, _, last = name.rpartition("/")
    found.said.setdefault(group, {})[last] = text


def _note_numbers(stored: Stored, matrix: Element, array: _Array, name: str, count: int, found: _Found) -> None:
    data = element_at(stored, array.place, found.order)
    code = NUMBERS.get(data.kind)
    dtype = np.dtype(code or "u1").newbyteorder("<" if found.order == "little" else ">")
    if code is None or data.size != count * dtype.itemsize or data.start + data.size > matrix.start + matrix.size + 4:
        raise BadData(
            f"{found.source}: {name} must hold {count} numbers, {data.size} bytes follow; the file is damaged, copy it "
            "again"
        )
    group, _, last = name.rpartition("/")
    if count == 1:
        value = np.frombuffer(stored.read_at(data.start, data.size), dtype)
        stored.finish()
        found.said.setdefault(group, {})[last] = float(value[0])
        return
    axes = orientation(array.shape)
    if axes is None:
        return
    across, along = axes
    kept = np.dtype(np.float32 if array.code == _SINGLE else np.float64)

    def blocks(length: int, channels: Sequence[int]) -> Iterator[NDArray[Any]]:
        # In MATLAB the first axis runs fastest: channels lie one after the other, or sample by sample.
        n_samples, n_channels = array.shape[along], count // array.shape[along]
        one_by_one = n_channels == 1 or (across is not None and along < across)
        for first in range(0, n_samples, length):
            n = min(length, n_samples - first)
            if one_by_one:
                starts = [channel * n_samples + first for channel in channels]
                rows = np.stack([_numbers(stored, data, dtype, start, n) for start in starts])
            else:
                rows = _numbers(stored, data, dtype, first * n_channels, n * n_channels)
                rows = rows.reshape(n, n_channels).T[list(channels)]
            yield rows.astype(kept)
        stored.finish()

    found.variables.append(
        Variable(
            name=last,
            group=group,
            n_channels=count // array.shape[along],
            n_samples=array.shape[along],
            blocks=blocks,
        )
    )


def _numbers(stored: Stored, data: Element, dtype: np.dtype[Any], first: int, count: int) -> NDArray[Any]:
    return np.frombuffer(stored.read_at(data.start + first * dtype.itemsize, count * dtype.itemsize), dtype)
