"""HDF5 files that others wrote, MATLAB's v7.3 among them: what arrays they hold and what is attached to these.

Nothing outside the file is ever read (only hard links are followed; external storage and virtual datasets are passed
over), nothing is believed that the stored bytes do not bear out, and values of variable length, which one flipped bit
can make HDF5 search for ever, are only read in a process of their own (`attribute_reading`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError
from cgid.store.attribute_reading import read_texts
from cgid.store.chunks import cache_size, missing_chunks, storage_fault
from cgid.store.dataset import DAMAGE
from cgid.store.header import attributes_of

#: No recording has more parts.
_MOST_OBJECTS, _DEEPEST, _MOST_ATTRIBUTES = 10_000, 32, 256
#: Longer attributes say nothing of a rate or a unit.
_LONGEST_ATTRIBUTE = 4096
#: Of the table of chunks that are kept while rows of them are read.
_SLOTS = 10_007
#: Where MATLAB keeps what cells and objects refer to.
_MATLAB_INNER = ("#refs#", "#subsystem#")
_CURE = "save it again as plain arrays"


@dataclass(frozen=True, kw_only=True)
class ForeignArray:
    """A numeric array of two values or more.

    Attributes
    ----------
    name : str
        Its path, parts divided by slashes.
    shape : tuple of int
    dtype : dtype
    attributes : dict
        Numbers, texts, and lists of texts.
    chunks : tuple of int or None
        Shape of the chunks; None if there are none.
    fault : str
        Why its samples cannot be read, "" if they can.
    warning : str
        What of it is missing, "" if nothing is.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attributes: dict[str, Any]
    chunks: tuple[int, ...] | None = None
    fault: str = ""
    warning: str = ""


@dataclass(frozen=True, kw_only=True)
class ForeignFile:
    """What a foreign file holds.

    Attributes
    ----------
    arrays : list of ForeignArray
    said : dict
        Path of a group, "" for the root -> its attributes and the single values that lie in it.
    warnings : list of str
    """

    arrays: list[ForeignArray] = field(default_factory=list)
    said: dict[str, dict[str, Any]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def is_foreign(path: str | Path) -> bool:
    """Return whether this is an HDF5 file that cgid did not make; False for what cannot be opened."""
    try:
        with h5py.File(path, "r") as file:
            return not str(attributes_of(file).get("format", "")).startswith("cgid")
    except DAMAGE:
        return False


def survey(path: Path, source: str, wanted: Any) -> ForeignFile:
    """Return what a foreign HDF5 file holds.

    Parameters
    ----------
    path : Path
    source : str
        Its name in messages.
    wanted : callable
        From the name of a value to whether it is of interest; others are not read.

    Raises
    ------
    BadData
        The file is no HDF5, cut off, damaged, or of more parts than a recording has.
    """
    found = ForeignFile()
    texts: list[tuple[str, str]] = []
    with _opened(path, source) as file:
        for name, item in _walk(file, source):
            values = _attributes(item, name, wanted, texts)
            if isinstance(item, h5py.Group):
                found.said.setdefault(name, {}).update(values)
            else:
                _add(found, name, item, values, wanted, texts, path.stat().st_size)
    if texts:
        _add_texts(found, texts, read_texts(path, texts))
    return found


def array_blocks(
    path: Path, source: str, array: ForeignArray, axes: tuple[int | None, int], length: int, channels: Sequence[int]
) -> Iterator[NDArray[Any]]:
    """Yield the samples of these channels in order, (len(channels), at most length), float32 or float64.

    Parameters
    ----------
    path : Path
    source : str
        Its name in messages.
    array : ForeignArray
    axes : tuple of int
        The axis of the channels, None if there is only one, and that of the samples.
    length : int
    channels : sequence of int

    Raises
    ------
    BadData
        A checksum or a packed chunk does not fit: the file is damaged.
    """
    across, along = axes
    kept = np.float32 if array.dtype.kind == "f" and array.dtype.itemsize == 4 else np.float64
    cache = cache_size(array.shape, array.chunks, array.dtype.itemsize, across)
    with _opened(path, source, rdcc_nbytes=cache, rdcc_nslots=_SLOTS) as file:
        dataset = file[array.name]
        if dataset.shape != array.shape:
            raise BadData(f"{source}: {array.name} has changed while it was read; read it again")
        for first in range(0, array.shape[along], length):
            index: list[Any] = [0] * len(array.shape)
            index[along] = slice(first, first + length)
            if across is not None:
                index[across] = slice(min(channels), max(channels) + 1)
            try:
                block = np.asarray(dataset[tuple(index)])
            except DAMAGE as error:
                reason = " ".join(str(error).split())
                raise BadData(
                    f"{source}: {array.name} cannot be read from sample {first} on ({reason}); the file is damaged, "
                    "copy it again"
                ) from None
            if across is None:
                rows = np.broadcast_to(block, (len(channels), len(block)))
            else:
                rows = (block if across < along else block.T)[[channel - min(channels) for channel in channels]]
            with np.errstate(all="ignore"):
                yield rows.astype(kept)


@contextmanager
def _opened(path: Path, source: str, **options: int) -> Iterator[h5py.File]:
    try:
        with h5py.File(path, "r", **options) as file:
            yield file
    except CgidError:
        raise
    except DAMAGE as error:
        reason = " ".join(str(error).split())
        raise BadData(
            f"{source}: the HDF5 file is cut off or damaged ({reason}); copy it again, or if it is a dataset, see what "
            "cgid.store or --index say of it"
        ) from None


def _walk(file: h5py.File, source: str) -> Iterator[tuple[str, Any]]:
    """Yield the groups and datasets that lie in this very file, each once."""
    seen, stack = set(), [("", file["/"], 0)]
    while stack:
        name, item, depth = stack.pop()
        place = h5py.h5o.get_info(item.id).addr
        if place in seen:
            continue
        seen.add(place)
        if len(seen) > _MOST_OBJECTS or depth > _DEEPEST:
            raise BadData(
                f"{source}: a recording has at most {_MOST_OBJECTS} parts and {_DEEPEST} levels, here are more; {_CURE}"
            )
        yield name, item
        if not isinstance(item, h5py.Group):
            continue
        for key in reversed(list(item)):
            if key in _MATLAB_INNER or not isinstance(item.get(key, getlink=True), h5py.HardLink):
                continue
            # An object that cannot be opened, such as one of a filter that is not here, is none of the arrays.
            with suppress(*DAMAGE):
                part = item[key]
                if isinstance(part, h5py.Group | h5py.Dataset):
                    stack.append((f"{name}/{key}" if name else key, part, depth + 1))


def _attributes(item: Any, path: str, wanted: Any, texts: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the attributes of interest of fixed size; those of variable length are put on the list `texts`."""
    found: dict[str, Any] = {}
    for name in list(item.attrs)[:_MOST_ATTRIBUTES]:
        if name != "MATLAB_class" and name != "MATLAB_empty" and not wanted(name):
            continue
        with suppress(*DAMAGE):
            stored = item.attrs.get_id(name)
            size = int(np.prod(stored.shape, dtype=np.int64)) if stored.shape is not None else 0
            if not 0 < size <= _LONGEST_ATTRIBUTE or stored.dtype.itemsize * size > 16 * _LONGEST_ATTRIBUTE:
                continue
            if h5py.check_string_dtype(stored.dtype) is not None and stored.dtype.kind == "O":
                texts.append((path, name))
            elif stored.dtype.kind in "biufS":
                value = _plain(np.asarray(item.attrs[name]))
                if value is not None:
                    found[name] = value
    return found


def _plain(values: NDArray[Any]) -> Any:
    """Return one number, one text or a list of texts; None for a list of numbers."""
    if values.dtype.kind == "S":
        found = [value.decode("utf-8", "replace").rstrip("\0 ") for value in values.ravel().tolist()]
        return found[0] if len(found) == 1 else found
    return float(values.ravel()[0]) if values.size == 1 else None


def _add(
    found: ForeignFile,
    name: str,
    item: h5py.Dataset,
    values: dict[str, Any],
    wanted: Any,
    texts: list[tuple[str, str]],
    size: int,
) -> None:
    kind, shape = item.dtype.kind, item.shape
    group, _, last = name.rpartition("/")
    if shape is None or item.external or item.is_virtual or values.get("MATLAB_empty"):
        return
    if h5py.check_string_dtype(item.dtype) is not None and kind == "O" and item.size == 1 and wanted(last):
        texts.append((name, ""))
    if kind not in "biufS":
        return
    matlab = values.get("MATLAB_class", "")
    if matlab == "char" or kind == "S" or item.size == 1:
        if wanted(last) and 0 < item.size * item.dtype.itemsize <= _LONGEST_ATTRIBUTE and not storage_fault(item, size):
            with suppress(*DAMAGE):
                read = np.asarray(item[()])
                # MATLAB keeps text as numbers of UTF-16, one a letter.
                text = read.ravel().astype("<u2").tobytes().decode("utf-16", "replace") if matlab == "char" else None
                value = _plain(read) if text is None else text
                if value is not None:
                    found.said.setdefault(group, {})[last] = value
        return
    # Logical arrays are no samples.
    if kind == "b" or matlab == "logical" or not item.size:
        return
    found.arrays.append(
        ForeignArray(
            name=name,
            shape=shape,
            dtype=item.dtype,
            attributes=values,
            chunks=item.chunks,
            fault=storage_fault(item, size),
            warning=missing_chunks(item),
        )
    )


def _add_texts(
    found: ForeignFile, asked: Sequence[tuple[str, str]], texts: Mapping[tuple[str, str], Any] | None
) -> None:
    if texts is None:
        names = ", ".join(sorted({name or path for path, name in asked})[:5])
        found.warnings.append(f"texts of variable length ({names}) could not be read; the file may be damaged")
        return
    arrays = {array.name: array.attributes for array in found.arrays}
    for place, value in texts.items():
        # Without the name of an attribute it is a value that lies in a group.
        path, _, name = place[0].rpartition("/") if not place[1] else (place[0], "", place[1])
        owner = arrays.get(path)
        if owner is None:
            owner = found.said.setdefault(path, {})
        owner[name] = value
