"""HDF5 files of other programs.

Only hard links are followed; external storage and virtual datasets are skipped, so no other file is read. Declared
sizes are checked against the stored bytes, and chunks are small. HDF5 still trusts files: a crafted or damaged one may
end or hang the process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid.errors import BadData
from cgid.store.description import DAMAGE
from cgid.store.gates import (
    MAX_ATTRIBUTES,
    cache_size,
    clear_damage,
    missing_chunks,
    readable,
    require_closed,
    storage_fault,
)

#: A recording has fewer objects and levels than these.
_MAX_OBJECTS, _DEEPEST = 10_000, 32
#: Longer attributes are neither rates nor units.
_MAX_ATTRIBUTE_LENGTH = 4096
#: Longer lists and texts are neither units nor names.
_MAX_LIST_LENGTH, _MAX_TEXT_LENGTH = 4096, 200
#: Slots of the chunk cache.
_SLOTS = 10_007
#: Where MATLAB stores the targets of cells and objects.
_MATLAB_INNER = ("#refs#", "#subsystem#")
_MATLAB_NAMES = frozenset(("MATLAB_class", "MATLAB_empty"))
_MATLAB_NUMBERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
_MATLAB_PLAIN = frozenset(("double", "single", "logical", "char", "cell", "struct", *_MATLAB_NUMBERS))
_HINT = "save it again as plain arrays"
#: Bytes of a column read at once.
_MAX_PART = 1 << 24


def _cut_off() -> tuple[str, str]:
    """Return what is wrong with a file that HDF5 cannot read, and what to do."""
    cure = f"copy it again, or if it is a dataset, read it with {spelled('index', '0')}"
    return "the HDF5 file is cut off or damaged", cure


@dataclass(frozen=True, kw_only=True)
class ForeignArray:
    """A numeric array at `path` in a file of another program; `fault`: why it cannot be read, `warning`: gaps."""

    name: str
    path: str
    shape: tuple[int, ...]
    attributes: dict[str, Any]
    dtype: np.dtype[Any]
    fault: str
    warning: str


def survey(
    path: Path, source: str, required: Callable[[str], bool]
) -> tuple[list[ForeignArray], dict[str, dict[str, Any]], list[str], list[tuple[str, str]]]:
    """Return the arrays, the `required` values (group -> name -> value), the warnings and the objects of an HDF5 file.

    Objects of MATLAB have a name and a class.
    """
    arrays: list[ForeignArray] = []
    values: dict[str, dict[str, Any]] = {}
    texts, objects = list[tuple[str, str]](), list[tuple[str, str]]()
    size = path.stat().st_size
    with _opened(path, source) as file:
        for name, item in _walk(file, source):
            attributes = _attributes(item, name, required, texts)
            if isinstance(item, h5py.Group):
                values.setdefault(name, {}).update(attributes)
                continue
            if item.shape is None or item.external or item.is_virtual or attributes.get("MATLAB_empty"):
                continue
            group, _, last = name.rpartition("/")
            matlab = attributes.get("MATLAB_class", "")
            if matlab and matlab not in _MATLAB_PLAIN:
                objects.append((name, matlab))
                continue
            if _is_text_of_any_length(item.dtype):
                texts += [(name, "")] if item.size == 1 and required(last) else []
            elif item.dtype.kind == "S" or (item.dtype.kind in "biuf" and (matlab == "char" or item.size == 1)):
                value = _value(item, matlab, size) if required(last) else None
                if value is not None:
                    values.setdefault(group, {})[last] = value
            elif item.dtype.kind in "iuf" and matlab != "logical" and item.size:  # logical arrays are not samples
                fault, warning = storage_fault(item, size), missing_chunks(item)
                arrays.append(
                    ForeignArray(
                        name=name,
                        path=item.name,
                        shape=item.shape,
                        attributes=attributes,
                        dtype=item.dtype,
                        fault=fault,
                        warning=warning,
                    )
                )
        lost = _add_texts(file, texts, {array.name: array.attributes for array in arrays}, values)
    warning = f"texts of variable length ({', '.join(lost[:5])}) could not be read; the file may be damaged"
    return arrays, values, [warning] if lost else [], objects


def _add_texts(
    file: h5py.File,
    texts: Sequence[tuple[str, str]],
    attributes: dict[str, dict[str, Any]],
    values: dict[str, dict[str, Any]],
) -> list[str]:
    """Add texts of variable length, (path, attribute or ""), to attributes and values; return the lost ones."""
    lost = []
    for name_in_file, attribute in texts:
        owner, _, name = (name_in_file, "", attribute) if attribute else name_in_file.rpartition("/")
        try:
            item = file[name_in_file or "/"]
            stored = item.attrs[attribute] if attribute else item[()]
            elements = np.atleast_1d(np.asarray(stored, dtype=object)).ravel().tolist()
        except DAMAGE:
            lost.append(name)
            continue
        words = [value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in elements]
        if 0 < len(words) <= _MAX_LIST_LENGTH and all(isinstance(t, str) and len(t) <= _MAX_TEXT_LENGTH for t in words):
            owned = attributes[owner] if owner in attributes else values.setdefault(owner, {})
            owned[name] = words[0] if len(words) == 1 else words
    return lost


def foreign_columns(path: Path, needed: Sequence[str]) -> tuple[list[str], int]:
    """Return the names and number of rows of the group /columns, read to its end; none without the `needed` ones."""
    source = str(path)
    with _opened(path, source) as file:
        columns = {
            name_in_file.partition("/")[2]: item
            for name_in_file, item in _walk(file, source)
            if name_in_file.startswith("columns/") and isinstance(item, h5py.Dataset)
        }
        is_table = len({item.shape for item in columns.values()}) == 1 and columns.keys() >= set(needed)
        plain = (item.ndim == 1 and item.dtype.kind in "biufS" and not item.external for item in columns.values())
        if not (is_table and all(plain)):
            return [], 0
        for name, item in columns.items():
            if fault := storage_fault(item, path.stat().st_size):
                raise BadData(f"{source}: {name} {fault}; the file is damaged, write it again")
            step = max(_MAX_PART // item.dtype.itemsize, 1)
            for first in range(0, len(item), step):
                with clear_damage(source, f"{name} cannot be read", "the file is damaged, write it again"):
                    item[first : first + step]
        return list(columns), len(next(iter(columns.values())))


def array_blocks(
    path: Path,
    source: str,
    array: ForeignArray,
    axes: tuple[int | None, int],
    length: int,
    channels: Sequence[int],
    start: int = 0,
) -> Iterator[NDArray[Any]]:
    """Yield the samples of these channels from `start` on, as float32 or float64; axes: of channels and of samples."""
    (across, along), name = axes, array.path
    lowest, n_read = (0, 1) if across is None else (min(channels), max(channels) + 1 - min(channels))
    with _opened(path, source) as file:
        cache = cache_size(file[name], across)
    with _opened(path, source, rdcc_nbytes=cache, rdcc_nslots=_SLOTS) as file:
        dataset = file[name]
        if dataset.shape != array.shape:
            raise BadData(f"{source}: {name} has changed while it was read; read it again")
        if fault := storage_fault(dataset, path.stat().st_size):
            raise BadData(f"{source}: {name} {fault}; the file is damaged, copy it again")
        sample_type = np.float32 if dataset.dtype.kind == "f" and dataset.dtype.itemsize == 4 else np.float64
        for first in range(start, array.shape[along], length):
            index: list[Any] = [0] * len(array.shape)
            index[along] = slice(first, first + length)
            if across is not None:
                index[across] = slice(lowest, lowest + n_read)
            what = f"{name} cannot be read from sample {first} on"
            with clear_damage(source, what, "the file is damaged, copy it again"):
                block = np.asarray(dataset[tuple(index)])
            if across is None:
                selected = np.broadcast_to(block, (len(channels), len(block)))
            else:
                selected = (block if across < along else block.T)[[channel - lowest for channel in channels]]
            with np.errstate(all="ignore"):
                samples = selected.astype(sample_type)
            yield samples


@contextmanager
def _opened(path: Path, source: str, **options: int) -> Iterator[h5py.File]:
    with clear_damage(source, *_cut_off()):
        try:
            opened = readable(path, **options)
        except OSError:
            require_closed(path, source)
            raise
        with opened as file:
            yield file


def _walk(file: h5py.File, source: str) -> Iterator[tuple[str, Any]]:
    """Yield the groups and datasets stored in this file, each once."""
    seen, stack = set(), [("", file["/"], 0)]
    while stack:
        name, item, depth = stack.pop()
        name_in_file = h5py.h5o.get_info(item.id).addr
        if name_in_file in seen:
            continue
        seen.add(name_in_file)
        _require_few(len(seen), depth, source)
        yield name, item
        if not isinstance(item, h5py.Group):
            parts = [(f"{name}({index})", part, depth + 1) for index, part in enumerate(_targets(item), 1)]
            _require_few(len(seen) + len(stack) + len(parts), depth, source)
            stack += reversed(parts)
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


def _targets(item: h5py.Dataset) -> Iterator[Any]:
    """Yield what references in a dataset point to, in this file: cells and arrays of structs of MATLAB 7.3."""
    if h5py.check_ref_dtype(item.dtype) is not h5py.Reference or not 0 < (item.size or 0) <= _MAX_OBJECTS:
        return
    with suppress(*DAMAGE):
        if item.external or item.is_virtual or storage_fault(item, Path(item.file.filename).stat().st_size):
            return
        for reference in np.asarray(item[()]).ravel():
            part = item.file[reference] if reference else None
            if isinstance(part, h5py.Group | h5py.Dataset):
                yield part


def _require_few(n_objects: int, depth: int, source: str) -> None:
    if n_objects > _MAX_OBJECTS or depth > _DEEPEST:
        raise BadData(
            f"{source}: a recording must have at most {_MAX_OBJECTS} objects and {_DEEPEST} levels, this file has "
            f"more; {_HINT}"
        )


def _attributes(item: Any, path: str, required: Callable[[str], bool], texts: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the required attributes of fixed size; add those of variable length to `texts`."""
    attributes: dict[str, Any] = {}
    for name in list(item.attrs)[:MAX_ATTRIBUTES]:
        if name not in _MATLAB_NAMES and not required(name):
            continue
        with suppress(*DAMAGE):
            stored = item.attrs.get_id(name)
            size = int(np.prod(stored.shape, dtype=np.int64)) if stored.shape is not None else 0
            if not 0 < size <= _MAX_ATTRIBUTE_LENGTH or stored.dtype.itemsize * size > 16 * _MAX_ATTRIBUTE_LENGTH:
                continue
            if _is_text_of_any_length(stored.dtype):
                texts.append((path, name))
            elif stored.dtype.kind in "biufS":
                value = _plain(np.asarray(item.attrs[name]))
                if value is not None:
                    attributes[name] = value
    return attributes


def _plain(values: NDArray[Any]) -> Any:
    """Return one number, one text or a list of texts; None for a list of numbers."""
    if values.dtype.kind == "S":
        elements = [value.decode("utf-8", "replace").rstrip("\0 ") for value in values.ravel().tolist()]
        return elements[0] if len(elements) == 1 else elements
    return float(values.ravel()[0]) if values.size == 1 else None


def _value(item: h5py.Dataset, matlab: str, file_size: int) -> Any:
    """Return the value of a dataset of one number or of texts, None if it is too long or cannot be read."""
    if not 0 < item.size * item.dtype.itemsize <= _MAX_ATTRIBUTE_LENGTH or storage_fault(item, file_size):
        return None
    with suppress(*DAMAGE):
        read = np.asarray(item[()])
        # MATLAB stores text as UTF-16 code units.
        return read.ravel().astype("<u2").tobytes().decode("utf-16", "replace") if matlab == "char" else _plain(read)
    return None


def _is_text_of_any_length(dtype: np.dtype[Any]) -> bool:
    return dtype.kind == "O" and h5py.check_string_dtype(dtype) is not None
