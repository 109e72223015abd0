"""Functions of the reading process for HDF5 files of other programs; see `cgid.store.reading`.

Only hard links are followed; external storage and virtual datasets are skipped, so no other file is read. Declared
sizes are checked against the stored bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.store import sandbox
from cgid.store._checks import MOST_ATTRIBUTES, cache_size, chunk_bytes, damage_told, missing_chunks, storage_fault
from cgid.store.sandbox import DAMAGE

#: A recording has fewer objects and levels.
_MOST_OBJECTS, _DEEPEST = 10_000, 32
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
#: Bytes of a column read at once.
_LONGEST_PART = 1 << 24
_CUT_OFF = (
    "the HDF5 file is cut off or damaged",
    "copy it again, or if it is a dataset, see what cgid.store or --index say of it",
)


def foreign_names(path: str, source: str) -> list[str]:
    """Return the names of all attributes and values, each once.

    Raises `BadData` if the file is not HDF5, truncated, damaged, or has more objects than a recording.
    """
    names: dict[str, None] = {}
    with _opened(path, source) as file:
        for place, item in _walk(file, source):
            names |= dict.fromkeys(list(item.attrs)[:MOST_ATTRIBUTES])
            if isinstance(item, h5py.Dataset):
                names[place.rpartition("/")[2]] = None
    return list(names)


def foreign_survey(path: str, source: str, wanted: Sequence[str]) -> dict[str, Any]:
    """Return the content of a foreign HDF5 file: `arrays`, `said`, and the locations of `texts` of variable length.

    For `arrays` and `said` see `cgid.store.reading.survey`. Only values with `wanted` names are read. Raises as
    `foreign_names`.
    """
    arrays: list[dict[str, Any]] = []
    said: dict[str, dict[str, Any]] = {}
    texts: list[tuple[str, str]] = []
    names, size = frozenset(wanted), Path(path).stat().st_size
    with _opened(path, source) as file:
        for name, item in _walk(file, source):
            values = _attributes(item, name, names, texts)
            if isinstance(item, h5py.Group):
                said.setdefault(name, {}).update(values)
                continue
            if item.shape is None or item.external or item.is_virtual or values.get("MATLAB_empty"):
                continue
            group, _, last = name.rpartition("/")
            matlab = values.get("MATLAB_class", "")
            if _is_text_of_any_length(item.dtype):
                texts += [(name, "")] if item.size == 1 and last in names else []
            elif item.dtype.kind == "S" or (item.dtype.kind in "biuf" and (matlab == "char" or item.size == 1)):
                value = _value(item, matlab, size) if last in names else None
                if value is not None:
                    said.setdefault(group, {})[last] = value
            elif item.dtype.kind in "iuf" and matlab != "logical" and item.size:  # logical arrays are not samples
                fault, warning = storage_fault(item, size), missing_chunks(item)
                about = {"name": name, "shape": item.shape, "attributes": values, "is_integer": item.dtype.kind != "f"}
                arrays.append({**about, "fault": fault, "warning": warning})
    return {"arrays": arrays, "said": said, "texts": texts}


def foreign_columns(path: str, source: str, needed: Sequence[str]) -> dict[str, Any]:
    """Return the `names` of the columns in the group /columns, read to their end, and their `n_rows`.

    There are none if the `needed` ones are not all there, or some have several axes or another length. Raises as
    `foreign_names`.
    """
    with _opened(path, source) as file:
        found = {
            place.partition("/")[2]: item
            for place, item in _walk(file, source)
            if place.startswith("columns/") and isinstance(item, h5py.Dataset)
        }
        is_table = len({item.shape for item in found.values()}) == 1 and found.keys() >= set(needed)
        plain = (item.ndim == 1 and item.dtype.kind in "biufS" and not item.external for item in found.values())
        if not (is_table and all(plain)):
            return {"names": [], "n_rows": 0}
        for name, item in found.items():
            if fault := storage_fault(item, Path(path).stat().st_size):
                raise BadData(f"{source}: {name} {fault}; the file is damaged, write it again")
            step = max(_LONGEST_PART // item.dtype.itemsize, 1)
            sandbox.allow(2 * step * item.dtype.itemsize + 3 * chunk_bytes(item))
            for first in range(0, len(item), step):
                with damage_told(source, f"{name} cannot be read", "the file is damaged, write it again"):
                    item[first : first + step]
        return {"names": list(found), "n_rows": len(next(iter(found.values())))}


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
    """Yield the samples of channels in order; parameters and errors as those of `cgid.store.reading.array_blocks`."""
    across, along = axes
    lowest, n_read = (0, 1) if across is None else (min(channels), max(channels) + 1 - min(channels))
    with _opened(path, source) as file:
        cache = cache_size(file[name], across)
    with _opened(path, source, rdcc_nbytes=cache, rdcc_nslots=_SLOTS) as file:
        dataset = file[name]
        if dataset.shape != tuple(shape):
            raise BadData(f"{source}: {name} has changed while it was read; read it again")
        if fault := storage_fault(dataset, Path(path).stat().st_size):
            raise BadData(f"{source}: {name} {fault}; the file is damaged, copy it again")
        kept = np.float32 if dataset.dtype.kind == "f" and dataset.dtype.itemsize == 4 else np.float64
        for first in range(0, shape[along], length):
            index: list[Any] = [0] * len(shape)
            index[along] = slice(first, first + length)
            if across is not None:
                index[across] = slice(lowest, lowest + n_read)
            # Copies: as stored, transposed, as eight-byte numbers, and the next block, read while the last one exists.
            size = 8 * min(length, shape[along]) * max(n_read, len(channels))
            sandbox.allow(4 * size + 3 * chunk_bytes(dataset) + 2 * cache)
            what = f"{name} cannot be read from sample {first} on"
            with damage_told(source, what, "the file is damaged, copy it again"):
                block = np.asarray(dataset[tuple(index)])
            if across is None:
                rows = np.broadcast_to(block, (len(channels), len(block)))
            else:
                rows = (block if across < along else block.T)[[channel - lowest for channel in channels]]
            with np.errstate(all="ignore"):
                samples = rows.astype(kept)
            yield {"": samples}


@contextmanager
def _opened(path: str, source: str, **options: int) -> Iterator[h5py.File]:
    # A lock would keep writers out, and fails on some network file systems.
    with damage_told(source, *_CUT_OFF), h5py.File(path, "r", locking=False, **options) as file:
        yield file


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
    for name in list(item.attrs)[:MOST_ATTRIBUTES]:
        if name not in _MATLAB_NAMES and name not in wanted:
            continue
        with suppress(*DAMAGE):
            stored = item.attrs.get_id(name)
            size = int(np.prod(stored.shape, dtype=np.int64)) if stored.shape is not None else 0
            if not 0 < size <= _LONGEST_ATTRIBUTE or stored.dtype.itemsize * size > 16 * _LONGEST_ATTRIBUTE:
                continue
            if _is_text_of_any_length(stored.dtype):
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


def _value(item: h5py.Dataset, matlab: str, file_size: int) -> Any:
    """Return the value of a dataset of one number or of texts, None if it is too long or cannot be read."""
    if not 0 < item.size * item.dtype.itemsize <= _LONGEST_ATTRIBUTE or storage_fault(item, file_size):
        return None
    with suppress(*DAMAGE):
        read = np.asarray(item[()])
        # MATLAB stores text as UTF-16 code units.
        return read.ravel().astype("<u2").tobytes().decode("utf-16", "replace") if matlab == "char" else _plain(read)
    return None


def _is_text_of_any_length(dtype: np.dtype[Any]) -> bool:
    return dtype.kind == "O" and h5py.check_string_dtype(dtype) is not None
