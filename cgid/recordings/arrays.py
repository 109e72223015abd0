"""NPY files, read without pickle and without believing what their header declares."""

from __future__ import annotations

import io
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.contents import Contents


def read_npy(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of an NPY file.

    Parameters
    ----------
    path : Path
        The file.
    source : str
        Its name in messages.
    variable : str or None
        Not used: such a file holds one recording.

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
    ...     file = Path(folder) / "two.npy"
    ...     np.save(file, np.zeros((1000, 2)))
    ...     contents = read_npy(file, "two.npy", None)
    >>> contents.n_channels, contents.n_samples
    (2, 1000)
    """
    raw = path.read_bytes()
    shape, fortran_order, dtype, offset = _header(raw, source)
    if dtype.kind not in "fiu":
        raise BadData(f"{source}: samples must be real numbers, got type {dtype}; save them as float64")
    if len(shape) not in (1, 2) or min(shape) < 0:
        raise BadData(f"{source}: samples must have one or two axes, got shape {shape}; save them as such")
    # The product is exact in Python's integers, so no declared shape can overflow or allocate anything.
    count = math.prod(shape)
    declared, held = count * dtype.itemsize, len(raw) - offset
    if not count:
        raise BadData(f"{source}: a recording must hold at least one sample, got shape {shape}; record it again")
    if declared != held:
        cure = "the file looks cut off, copy it again" if declared > held else "save one array only"
        raise BadData(
            f"{source}: the header must match the file, it declares {declared} bytes {shape} and {held} follow; {cure}"
        )
    flat = np.frombuffer(raw, dtype, count, offset)
    return Contents.of_array(_channels(flat.reshape(shape, order="F" if fortran_order else "C")))


def _header(raw: bytes, source: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    file = io.BytesIO(raw)
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


def _channels(array: NDArray[Any]) -> NDArray[Any]:
    if array.ndim == 1:
        array = array[np.newaxis]
    elif array.shape[1] < array.shape[0]:
        array = array.T
    kept = array.dtype.newbyteorder("=") if array.dtype.kind == "f" and array.dtype.itemsize in (4, 8) else np.float64
    # A long double beyond float64 becomes infinite, which the signal refuses by sample.
    with np.errstate(all="ignore"):
        return np.array(array, dtype=kept, order="C")
