"""Read MATLAB files of version 5 to 7.2 at once, with scipy; 7.3 is HDF5."""

from __future__ import annotations

import math
import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cgid.recordings.arrays import blocks_of_arrays, require_readable_size
from cgid.recordings.recording import Asked, Blocks, Remark, library_errors
from cgid.recordings.variables import MATLAB_OBJECT

#: Header of the file, and the type of a variable that is compressed.
_HEADER_LENGTH, _COMPRESSED = 128, 15
#: Maximum depth of nested structs, and of a text [characters].
_DEEPEST, _MAX_TEXT_LENGTH = 16, 4096


def read_mat(path: Path, source: str, asked: Asked) -> Blocks:
    """Return the channels of an array in a MATLAB file (-v6, -v7), or of several; `struct/field` names a field."""
    from scipy.io import loadmat

    with (
        library_errors(source, "the MATLAB file is cut off or damaged", "copy it again, or save it with -v7"),
        path.open("rb") as file,
        warnings.catch_warnings(record=True) as caught,
    ):
        warnings.simplefilter("always")
        require_readable_size(max(_declared(file), os.fstat(file.fileno()).st_size), source, "save it with -v7.3")
        loaded = stored = loadmat(file, mat_dtype=True)
        # MATLAB types (mat_dtype) distinguish logical arrays, but drop the imaginary part of complex numbers.
        if any(issubclass(one.category, np.exceptions.ComplexWarning) for one in caught):
            stored = loadmat(file, mat_dtype=False)
    # Names of MATLAB begin with a letter: scipy's others are its notes and the bytes of functions.
    names = [name for name in loaded if not name.startswith("__")]
    objects: list[str] = []
    arrays = [one for name in names for one in _fields(name, loaded[name], stored[name], 0, objects)]
    return blocks_of_arrays(arrays, source, asked, list(map(Remark, objects)))


def _declared(file: BinaryIO) -> int:
    """Return the bytes that the variables of a file need, by their shapes, at most by their sizes."""
    from scipy.io import whosmat

    try:
        return sum(8 * math.prod(shape) for _, shape, _ in whosmat(file))
    except TypeError:  # an object has no shape
        pass
    file.seek(_HEADER_LENGTH - 2)
    order, total = "<" if file.read(2) == b"IM" else ">", 0
    while len(tag := file.read(8)) == 8:
        kind, length = struct.unpack(f"{order}II", tag)
        start = file.tell()
        if kind == _COMPRESSED:
            _, declared = struct.unpack(f"{order}II", zlib.decompressobj().decompress(file.read(length), 8))
        total += 8 * (declared if kind == _COMPRESSED else length)
        file.seek(start + length)
    file.seek(0)
    return total


def _fields(place: str, value: Any, stored: Any, depth: int, objects: list[str]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays and texts in a MATLAB value; `objects` are named, and complex numbers left out."""
    if isinstance(value, np.ndarray) and "s2" in (value.dtype.names or ()) and type(value) is not np.ndarray:
        name, kind = (value.ravel()[0][field].decode() for field in ("s0", "s2"))
        objects.append(MATLAB_OBJECT.format(place if depth else name, kind))
    if type(value) is not np.ndarray or depth > _DEEPEST or not value.size:
        return
    if value.dtype.names:
        for index, (one, its) in enumerate(zip(value.ravel(), stored.ravel(), strict=True)):
            owner = place if value.size == 1 else f"{place}({index + 1})"
            for field in value.dtype.names:
                yield from _fields(f"{owner}/{field}", one[field], its[field], depth + 1, objects)
        return
    if value.dtype.kind == "O":
        for index, (one, its) in enumerate(zip(value.ravel(), stored.ravel(), strict=True), 1):
            yield from _fields(f"{place}({index})", one, its, depth + 1, objects)
        return
    if value.dtype.kind == "U":
        value = np.char.strip(value) if value.nbytes <= 4 * _MAX_TEXT_LENGTH else value[:0]
    if stored.dtype.kind != "c":
        yield place, value
