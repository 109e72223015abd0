"""What of an HDF5 file may be opened: plain arrays that lie in this very file and that its bytes bear out.

Only the reading process opens files; see `apart`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from cgid.errors import BadData, CgidError, NoInput
from cgid.store.chunks import BEST_RATIO, BEST_RATIO_OF_SILENCE, DAMAGE, missing_chunks, packs_silence, storage_fault

#: What we write has a few dozen [objects of a group], [attributes of an object], [bytes of these].
MOST_MEMBERS, _MOST_ATTRIBUTES, _LARGEST_ATTRIBUTES = 4096, 256, 8 << 20
#: Datasets whose index of chunks has been gone through, as long as their file stays as it was.
_found_sound: set[tuple[Any, ...]] = set()


@contextmanager
def opened(path: str, source: str, **options: Any) -> Iterator[h5py.File]:
    """Yield an HDF5 file open for reading; what h5py raises on a damaged one becomes `BadData`."""
    if not Path(path).exists():
        raise BadData(f"{source}: this shard of the dataset is missing; generate the dataset again")
    if not Path(path).is_file():
        raise BadData(f"{source}: must be a regular file; copy it to one first")
    try:
        # A lock would keep writers out, and fails on some network file systems; files are replaced, never changed.
        file = h5py.File(path, "r", locking=False, **options)
    except PermissionError:
        raise NoInput(f"{source}: cannot be read (Permission denied); see to its permissions") from None
    except DAMAGE:
        raise BadData(
            f"{source}: must be a readable HDF5 file, it is empty, truncated or no HDF5 file; copy it again, or "
            "generate it anew"
        ) from None
    try:
        yield file
    except CgidError:
        raise
    except DAMAGE as error:
        reason = " ".join(str(error).split())
        raise BadData(f"{source}: is damaged ({reason}); copy it again, or generate it anew") from None
    finally:
        file.close()


def plain_dataset(file: h5py.File, name: str, source: str, best_ratio: float = BEST_RATIO) -> h5py.Dataset:
    """Return a dataset that lies in this very file, as large as it says; links elsewhere could read other files.

    Parameters
    ----------
    file : h5py.File
    name : str
    source : str
        The file's name in messages.
    best_ratio : float
        Declared bytes over stored ones, at most.
    """
    for part in (name.split("/")[0], name):
        if not is_inside(file, part):
            raise BadData(f"{source}: {part} must be part of the file itself; it is missing or a link")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual or dataset.dtype.hasobject:
        raise BadData(f"{source}: {name} must be a plain dataset inside the file")
    _require_borne_out(file, dataset, source, best_ratio)
    return dataset


def _require_borne_out(file: h5py.File, dataset: h5py.Dataset, source: str, best_ratio: float) -> None:
    """Raise `BadData` unless the stored bytes are enough for what is declared, and all there."""
    if dataset.shape is None:
        return
    about = Path(file.filename).stat()
    key = (file.filename, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns, dataset.name, best_ratio)
    if key in _found_sound:
        return
    # Own files are read by batches, whatever they declare.
    best_ratio = max(best_ratio, BEST_RATIO_OF_SILENCE) if packs_silence(dataset) else best_ratio
    fault = storage_fault(dataset, about.st_size, best_ratio) or missing_chunks(dataset)
    if fault:
        raise BadData(f"{source}: {dataset.name[1:]} {fault}; the file is damaged or hostile, generate it again")
    if len(_found_sound) >= MOST_MEMBERS:
        _found_sound.clear()
    _found_sound.add(key)


def is_inside(file: h5py.File, name: str) -> bool:
    """Return whether this name is there and no soft or external link, without following it."""
    links = file.id.links
    return bool(links.exists(name.encode()) and links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD)


def members(file: h5py.File, name: str, source: str) -> list[str]:
    """Return the names in a group of the file itself."""
    if not is_inside(file, name) or not isinstance(file[name], h5py.Group):
        raise BadData(f"{source}: {name} must be a group of the file itself; it is missing, a link or a dataset")
    group = file[name]
    if len(group) > MOST_MEMBERS:
        raise BadData(f"{source}: {name} must hold at most {MOST_MEMBERS} columns, it has {len(group)}")
    return list(group)


def attributes_of(item: h5py.HLObject, source: str) -> dict[str, Any]:
    """Return the attributes that are one number or one string of fixed length; no others are written, or even read."""
    found: dict[str, Any] = {}
    room = _LARGEST_ATTRIBUTES
    if len(item.attrs) > _MOST_ATTRIBUTES:
        raise BadData(f"{source}: {item.name} must have at most {_MOST_ATTRIBUTES} attributes, got {len(item.attrs)}")
    for name in item.attrs:
        stored = item.attrs.get_id(name)
        room -= stored.dtype.itemsize + len(name)
        if room < 0:
            raise BadData(f"{source}: attributes of {item.name} must take at most {_LARGEST_ATTRIBUTES >> 20} MiB")
        # Python has no number for those of more than eight bytes.
        if stored.shape == () and (
            stored.dtype.kind == "S" or (stored.dtype.kind in "biuf" and stored.dtype.itemsize <= 8)
        ):
            value = item.attrs[name]
            found[name] = value.decode(errors="replace") if isinstance(value, bytes) else value.item()
    return found


def bytes_of(dataset: h5py.Dataset) -> int:
    """Return what a row takes."""
    return int(math.prod(dataset.shape[1:])) * int(dataset.dtype.itemsize)
