"""Functions of the reading process for HDF5 files of other programs; see `cgid.store.foreign`.

Only hard links are followed; external storage and virtual datasets are skipped, so no other file is read. Declared
sizes are checked against the stored bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError
from cgid.store import sandbox
from cgid.store._checks import DAMAGE, cache_size, chunk_bytes, missing_chunks, storage_fault

#: A recording has fewer objects, levels and attributes.
_MOST_OBJECTS, _DEEPEST, _MOST_ATTRIBUTES = 10_000, 32, 256
#: Objects visited within the time limit of one reply.
_OBJECTS_IN_TIME = 500
#: Longer attributes are neither rates nor units.
_LONGEST_ATTRIBUTE = 4096
#: Longer lists and texts are neither units nor names.
_LONGEST_LIST, _LONGEST_TEXT = 4096, 200
#: Slots of the chunk cache.
_SLOTS = 10_007
#: Where MATLAB stores the targets of cells and objects.
_MATLAB_INNER = ("#refs#", "#subsystem#")
_MATLAB_NAMES = frozenset(("MATLAB_class", "MATLAB_empty"))
_CURE = "save it again as plain arrays"


@dataclass
class _Found:
    """The JSON of a survey, see `cgid.store.foreign.ForeignFile`; `texts` only locates texts of variable length."""

    arrays: list[dict[str, Any]] = field(default_factory=list)
    said: dict[str, dict[str, Any]] = field(default_factory=dict)
    texts: list[tuple[str, str]] = field(default_factory=list)


def foreign_names(path: str, source: str) -> list[str]:
    """Return the names of all attributes and values, each once.

    Raises `BadData` if the file is not HDF5, truncated, damaged, or has more objects than a recording.
    """
    names: dict[str, None] = {}
    with _opened(path, source) as file:
        for place, item in _walk(file, source):
            names |= dict.fromkeys(list(item.attrs)[:_MOST_ATTRIBUTES])
            if isinstance(item, h5py.Dataset):
                names[place.rpartition("/")[2]] = None
    return list(names)


def foreign_survey(path: str, source: str, wanted: Sequence[str]) -> dict[str, Any]:
    """Return the content of a foreign HDF5 file: `arrays`, `said`, and the locations of `texts` of variable length.

    Only values with `wanted` names are read. Raises as `foreign_names`.
    """
    found, names = _Found(), frozenset(wanted)
    with _opened(path, source) as file:
        for name, item in _walk(file, source):
            values = _attributes(item, name, names, found.texts)
            if isinstance(item, h5py.Group):
                found.said.setdefault(name, {}).update(values)
            else:
                _add(found, name, item, values, names, Path(path).stat().st_size)
    return vars(found)


def foreign_texts(path: str, source: str, asked: Sequence[tuple[str, str]]) -> list[Any]:
    """Return texts of variable length, each as text or list of texts; None for one that is too long for a unit or name.

    `asked` holds the path of a group or dataset ("" is the root) and the name of the attribute, "" for the dataset's
    value.
    """
    found: list[Any] = []
    with _opened(path, source) as file:
        for place, name in asked:
            item = file[place or "/"]
            values = np.atleast_1d(np.asarray(item.attrs[name] if name else item[()], dtype=object)).ravel().tolist()
            texts = [value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in values]
            sound = len(texts) <= _LONGEST_LIST and all(isinstance(t, str) and len(t) <= _LONGEST_TEXT for t in texts)
            found.append((texts[0] if len(texts) == 1 else texts) if sound and texts else None)
    return found


def foreign_blocks(
    path: str,
    source: str,
    name: str,
    shape: Sequence[int],
    axes: tuple[int | None, int],
    length: int,
    channels: Sequence[int],
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the samples of channels in order; parameters and errors as those of `cgid.store.foreign.array_blocks`."""
    across, along = axes
    with _opened(path, source) as file:
        stored = file[name]
        cache = cache_size(stored.shape, stored.chunks, stored.dtype.itemsize, across)
    with _opened(path, source, rdcc_nbytes=cache, rdcc_nslots=_SLOTS) as file:
        dataset = file[name]
        if dataset.shape != tuple(shape):
            raise BadData(f"{source}: {name} has changed while it was read; read it again")
        if fault := storage_fault(dataset, Path(path).stat().st_size):
            raise BadData(f"{source}: {name} {fault}; the file is damaged, copy it again")
        for first in range(0, shape[along], length):
            index: list[Any] = [0] * len(shape)
            index[along] = slice(first, first + length)
            n_read = 1
            if across is not None:
                index[across] = slice(min(channels), max(channels) + 1)
                n_read = max(channels) + 1 - min(channels)
            # Copies: as stored, transposed, as eight-byte numbers, and the next block, read while the last one exists.
            size = 8 * min(length, shape[along]) * max(n_read, len(channels))
            sandbox.allow(4 * size + 3 * chunk_bytes(dataset) + 2 * cache)
            yield {"": _block(dataset, tuple(index), across, along, channels, source)}


def _block(
    dataset: h5py.Dataset,
    index: tuple[Any, ...],
    across: int | None,
    along: int,
    channels: Sequence[int],
    source: str,
) -> NDArray[Any]:
    kept = np.float32 if dataset.dtype.kind == "f" and dataset.dtype.itemsize == 4 else np.float64
    try:
        block = np.asarray(dataset[index])
    except DAMAGE as error:
        reason = " ".join(str(error).split())
        raise BadData(
            f"{source}: {dataset.name[1:]} cannot be read from sample {index[along].start} on ({reason}); the file is "
            "damaged, copy it again"
        ) from None
    if across is None:
        rows = np.broadcast_to(block, (len(channels), len(block)))
    else:
        rows = (block if across < along else block.T)[[channel - min(channels) for channel in channels]]
    with np.errstate(all="ignore"):
        return rows.astype(kept)


@contextmanager
def _opened(path: str, source: str, **options: int) -> Iterator[h5py.File]:
    try:
        # A lock would keep writers out, and fails on some network file systems.
        with h5py.File(path, "r", locking=False, **options) as file:
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
    """Yield the groups and datasets stored in this file, each once."""
    seen, stack = set(), [("", file["/"], 0)]
    while stack:
        name, item, depth = stack.pop()
        place = h5py.h5o.get_info(item.id).addr
        if place in seen:
            continue
        seen.add(place)
        _require_few(len(seen), depth, source)
        # Progress shows that HDF5 is not caught in a loop, so restart the time limits.
        if len(seen) % _OBJECTS_IN_TIME == 0:
            sandbox.begin(file.filename)
        yield name, item
        if not isinstance(item, h5py.Group):
            continue
        _require_few(len(seen) + len(stack) + len(item), depth, source)
        for key in reversed(list(item)):
            if key in _MATLAB_INNER or not isinstance(item.get(key, getlink=True), h5py.HardLink):
                continue
            # Skip objects that cannot be opened, such as those with an unavailable filter.
            with suppress(*DAMAGE):
                part = item[key]
                if isinstance(part, h5py.Group | h5py.Dataset):
                    stack.append((f"{name}/{key}" if name else key, part, depth + 1))


def _require_few(n_objects: int, depth: int, source: str) -> None:
    if n_objects > _MOST_OBJECTS or depth > _DEEPEST:
        raise BadData(
            f"{source}: a recording has at most {_MOST_OBJECTS} parts and {_DEEPEST} levels, here are more; {_CURE}"
        )


def _attributes(item: Any, path: str, wanted: frozenset[str], texts: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the wanted attributes of fixed size; add those of variable length to `texts`."""
    found: dict[str, Any] = {}
    for name in list(item.attrs)[:_MOST_ATTRIBUTES]:
        if name not in _MATLAB_NAMES and name not in wanted:
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
    found: _Found,
    name: str,
    item: h5py.Dataset,
    values: dict[str, Any],
    wanted: frozenset[str],
    size: int,
) -> None:
    kind, shape = item.dtype.kind, item.shape
    group, _, last = name.rpartition("/")
    if shape is None or item.external or item.is_virtual or values.get("MATLAB_empty"):
        return
    if h5py.check_string_dtype(item.dtype) is not None and kind == "O" and item.size == 1 and last in wanted:
        found.texts.append((name, ""))
    if kind not in "biufS":
        return
    matlab = values.get("MATLAB_class", "")
    if matlab == "char" or kind == "S" or item.size == 1:
        if (
            last in wanted
            and 0 < item.size * item.dtype.itemsize <= _LONGEST_ATTRIBUTE
            and not storage_fault(item, size)
        ):
            with suppress(*DAMAGE):
                read = np.asarray(item[()])
                # MATLAB stores text as UTF-16 code units.
                text = read.ravel().astype("<u2").tobytes().decode("utf-16", "replace") if matlab == "char" else None
                value = _plain(read) if text is None else text
                if value is not None:
                    found.said.setdefault(group, {})[last] = value
        return
    # Logical arrays are not samples.
    if kind == "b" or matlab == "logical" or not item.size:
        return
    found.arrays.append(
        {
            "name": name,
            "shape": shape,
            "attributes": values,
            "fault": storage_fault(item, size),
            "warning": missing_chunks(item),
        }
    )
