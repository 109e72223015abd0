"""The container of a model file: a zip archive of NumPy arrays, read so strictly that nothing in it can surprise.

zipfile believes the directory at the end of an archive (overlapping entries, a million of them, sizes that are not
true), and NumPy hands the header of an array to Python's own parser. A model needs neither: its entries stand one
behind the other, stored as they are, and `numpy.savez` writes the head of an array in one way only. So both are read
here, by the rules of PKWARE's APPNOTE 6.3 (sections 4.3.7, 4.3.12, 4.3.16, 4.5.3) and of NumPy's NEP 1, and whatever
differs is refused. No array is copied: each is a view of the file's content.

The header of a model file: JSON that is read as strictly as it is written, and the digest over header and arrays.

What makes a model file sound: nothing of a stranger's file is believed before it is checked.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.identification.families import BY_NAME
from cgid.identification.known import KNOWN
from cgid.identification.reference import equalisations_of
from cgid.identification.windows import require_times
from cgid.measure.bands import MEL_BANDS
from cgid.measure.features import require_known
from cgid.signals import quantity_of

if TYPE_CHECKING:
    from cgid.identification.model import Model

#: More arrays than this no model has.
MOST_ENTRIES = 64
_LOCAL, _CENTRAL, _END = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
#: Behind the signature: version, flags, method, time, date, CRC-32, packed and plain size, lengths of name and extra.
_LOCAL_HEAD = struct.Struct("<4s5H3L2H")
#: Made by, version, flags, method, time, date, CRC-32, sizes, name, extra, comment, disk, attributes (2), offset.
_CENTRAL_HEAD = struct.Struct("<4s6H3L5H2L")
#: Disks (2), entries (2), size and offset of the directory, length of the comment.
_END_RECORD = struct.Struct("<4s4H2LH")
#: Tag 1, 16 bytes: the plain and the packed size, where the short fields say "see there".
_ZIP64 = struct.Struct("<2H2Q")
_SEE_THERE = 0xFFFFFFFF
#: The kind of a file in the upper half of the attributes: none said, or a plain one; never a link.
_PLAIN_FILE = (0, 0o100000)
#: Names as ours are: no folder, no drive, nothing that any system takes for more than a name.
_NAME = re.compile(rb"[a-z0-9_.]{1,64}\.npy")
_MOST_AXES = 3
#: Version 1.0 of the array format, and its head as NumPy writes it.
_MAGIC = b"\x93NUMPY\x01\x00"
_HEAD = re.compile(
    rb"\{'descr': '(<f8|<i4|<i8|\|b1|\|u1)', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,9}, )*\d{1,9},?)?\), \} *\n"
)


@dataclass(frozen=True)
class _Entry:
    """What the local head of an entry says."""

    name: bytes
    crc: int
    size: int
    offset: int


def arrays_of(content: bytes) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and array of each entry of an archive in its order; what comes first can be used before the rest.

    Raises
    ------
    BadData
        The archive or an array is not as `numpy.savez` writes it, or damaged.
    """
    if not content.startswith(_LOCAL):
        raise BadData("it must be an .npz archive of numbers")
    entries: list[_Entry] = []
    place = 0
    while content[place : place + 4] == _LOCAL:
        entry, start = _entry(content, place)
        if len(entries) == MOST_ENTRIES or entry.name in {known.name for known in entries}:
            raise BadData(f"its archive must hold at most {MOST_ENTRIES} arrays, each once")
        entries.append(entry)
        place = start + entry.size
        held = memoryview(content)[start:place]
        if zlib.crc32(held) != entry.crc:
            raise BadData(f"array {entry.name.decode()} must match its checksum, it is damaged")
        yield entry.name.decode().removesuffix(".npy"), _array(held, entry.name.decode())
    _check_directory(content, place, entries)


def _entry(content: bytes, place: int) -> tuple[_Entry, int]:
    """Return the entry whose local head stands at a place, and where what it holds begins."""
    head = content[place : place + _LOCAL_HEAD.size]
    if len(head) < _LOCAL_HEAD.size:
        raise BadData("its archive must be whole, it is cut off")
    _, _, flags, method, _, _, crc, packed, size, n_name, n_extra = _LOCAL_HEAD.unpack(head)
    place_of_name = place + _LOCAL_HEAD.size
    place_of_extra = place_of_name + n_name
    start = place_of_extra + n_extra
    name = content[place_of_name:place_of_extra]
    if not _NAME.fullmatch(name):
        raise BadData("its arrays must have plain names of at most 64 letters")
    if method or flags:
        raise BadData(f"array {name.decode()} must be stored uncompressed and plain")
    extra = content[place_of_extra:start]
    if size == packed == _SEE_THERE and extra[:4] == b"\x01\x00\x10\x00" and len(extra) == _ZIP64.size:
        _, _, size, packed = _ZIP64.unpack(extra)
        extra = b""
    # Stored, not packed: what is declared cannot be larger than the file.
    if extra or size != packed or size > len(content) - start:
        raise BadData(f"array {name.decode()} must have the size that its archive declares")
    return _Entry(name, crc, size, place), start


def _check_directory(content: bytes, place: int, entries: list[_Entry]) -> None:
    """Raise unless the directory at a place says of the entries what they say themselves, and ends the file."""
    first = place
    for entry in entries:
        head = content[place : place + _CENTRAL_HEAD.size]
        if len(head) < _CENTRAL_HEAD.size:
            raise BadData("its archive must be whole, it is cut off")
        signature, _, _, flags, method, _, _, crc, packed, size, *lengths, disk, _, attributes, offset = (
            _CENTRAL_HEAD.unpack(head)
        )
        name = content[place + _CENTRAL_HEAD.size : place + _CENTRAL_HEAD.size + len(entry.name)]
        said = signature, flags, method, crc, packed, size, lengths, disk, offset, name
        true = _CENTRAL, 0, 0, entry.crc, entry.size, entry.size, [len(name), 0, 0], 0, entry.offset, entry.name
        if said != true or (attributes >> 16) & 0o170000 not in _PLAIN_FILE:
            raise BadData(f"the directory of its archive must agree with array {entry.name.decode()}")
        place += _CENTRAL_HEAD.size + len(name)
    end = _END_RECORD.pack(_END, 0, 0, len(entries), len(entries), place - first, first, 0)
    if content[place:] != end:
        raise BadData("its archive must be whole, and end where its directory does")


def _array(held: memoryview, name: str) -> NDArray[Any]:
    """Return the array of an entry, as a view that cannot be written to."""
    length = int.from_bytes(held[8:10], "little")
    head = _HEAD.fullmatch(held[10 : 10 + length]) if held[:8] == _MAGIC else None
    if head is None:
        raise BadData(f"array {name} must hold numbers as numpy.savez writes them (float64, int32, int64 or bool)")
    descr, fortran, sides = (part.decode() for part in head.groups(b""))
    dtype, shape = np.dtype(descr), tuple(int(side) for side in sides.rstrip(",").split(", ") if side)
    # Exact: a product of Python's integers cannot overflow.
    if math.prod(shape) * dtype.itemsize != len(held) - 10 - length or 0 in shape or len(shape) > _MOST_AXES:
        raise BadData(f"array {name} must declare as many numbers as it holds, and one at least, it declares {shape}")
    array = np.frombuffer(held, dtype, offset=10 + length).reshape(shape, order="F" if fortran == "True" else "C")
    if dtype.kind == "b" and (array.view(np.uint8) > 1).any():
        raise BadData(f"array {name} must hold truths, bytes 0 and 1")
    return array


FORMAT = "cgid-model"
#: 2: what must be known, guards, the calibration of prediction sets, networks.
#: 3: windows, several channels, reference spectra of sensors, linear discriminants.
#: 4: a digest over header and arrays.
SCHEMA_VERSION = 4
#: What an older header does not say, by its version.
_UNSAID: dict[int, dict[str, Any]] = {
    2: {"window_time": 0.0, "hop_time": 0.0, "n_channels": 1, "sensors": []},
    3: {},
    4: {},
}
#: A longer header is none: it would say a hundred bytes of each of twenty thousand recordings.
LARGEST_HEADER = 2 << 20
#: Lists and objects within each other; ours have seven.
_DEEPEST = 32
#: Numbers beyond this in either direction measure nothing, and squares of them are still numbers.
_LARGEST_NUMBER = 1e100
#: What the header must say beside the format, and as what.
_KINDS: dict[str, type] = {
    "family": str,
    "labels": list,
    "features": list,
    "known": list,
    "guards": list,
    "guard_limits": list,
    "unit": str,
    "sampling_rates": list,
    "temperature": float,
    "neighbourhood_limit": float,
    "training": dict,
    "window_time": float,
    "hop_time": float,
    "n_channels": int,
    "sensors": list,
}
_LISTS_OF_NUMBERS = ("guard_limits", "sampling_rates")
#: What it says beside these: the quantity follows from the unit, the rest has been looked at when they are read.
_BESIDE = {"format", "schema_version", "quantity", "sha256"}


class NewerSchema(BadData):
    """A file of a version that this cgid does not know yet; training again would not help."""


def read_header(stored: NDArray[Any]) -> dict[str, Any]:
    """Return what the header of a model file says, as it stands, once its version is one that is known.

    Raises
    ------
    NewerSchema
        It was written by a later cgid.
    BadData
        It is no JSON, says a thing twice, or is of another format or an older version.
    """
    if stored.size > LARGEST_HEADER:
        raise BadData(f"its header must be at most {LARGEST_HEADER >> 20} MiB, it is {stored.size / 2**20:.1f} MiB")
    try:
        header = json.loads(stored.tobytes(), object_pairs_hook=_each_once)
    except BadData:
        raise
    except (ValueError, RecursionError):
        raise BadData("it must have a header of JSON") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise BadData(f"format must be {FORMAT!r}")
    _check_depth(header)
    version = header.get("schema_version")
    oldest = min(_UNSAID)
    if type(version) is not int or version < oldest:
        raise BadData(f"schema_version must be {oldest} to {SCHEMA_VERSION}, got {repr(version)[:20]}")
    if version > SCHEMA_VERSION:
        reads = f"{oldest} to {SCHEMA_VERSION}"
        raise NewerSchema(f"schema_version {str(version)[:20]} is newer than this cgid (reads {reads}): upgrade cgid")
    return header


def fields_of(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return what a header says of a model, lists as tuples, once it is whole and of the right kinds.

    Raises
    ------
    BadData
        Something is missing, unheard of or of a wrong kind; or header and arrays do not match the digest.
    """
    version = header["schema_version"]
    if version >= 4 and header.get("sha256") != digest(header, arrays):
        raise BadData("header and arrays must match the SHA-256 in the header, they were changed")
    said = _UNSAID[version] | dict(header)
    if unheard := said.keys() - _KINDS.keys() - _BESIDE:
        raise BadData(f"the header must say nothing but what a model needs, got {min(unheard)[:40]!r}")
    for name, kind in _KINDS.items():
        if not _is(said.get(name), kind) or (
            name in _LISTS_OF_NUMBERS and not all(_is(number, float) for number in said[name])
        ):
            raise BadData(f"{name} is missing or of a wrong kind in the header")
    return {name: tuple(said[name]) if kind is list else said[name] for name, kind in _KINDS.items()}


def signed(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the header as text, with the digest over it and the arrays."""
    return json.dumps({**header, "sha256": digest(header, arrays)}, sort_keys=True).encode()


def digest(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 over all that a header says but for its digest, and over names, types, shapes and numbers.

    It finds every accidental change: a flipped bit, features in another order. Who changes a file on purpose can
    compute it anew.
    """
    said = {name: value for name, value in header.items() if name != "sha256"}
    found = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        found.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise BadData("its header must say each thing once")
    return found


def _is(value: Any, kind: type) -> bool:
    """Return whether a value out of JSON is of a kind; a whole number may stand for a float, a truth for nothing."""
    if kind in (int, float):
        number = type(value) is int or (kind is float and type(value) is float)
        return number and abs(value) <= _LARGEST_NUMBER  # false for nan
    return isinstance(value, kind)


def _check_depth(value: Any) -> None:
    """Raise unless lists and objects stand within each other no deeper than those of a model."""
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            inner
            for outer in level
            if isinstance(outer, (dict, list))
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise BadData(f"its header must not nest deeper than {_DEEPEST}")


#: More channels than this no model looks at.
MOST_CHANNELS = 64
#: Arrays of every family -> the attribute of the standardiser, and the number of axes.
SHARED = {
    "standardiser.logarithmic": ("logarithmic", 1),
    "standardiser.floor": ("floor", 1),
    "standardiser.mean": ("mean", 1),
    "standardiser.scale": ("scale", 1),
}
#: More labels, or more references of sensors, than this no model tells apart.
MOST_LABELS, _MOST_SENSORS = 1000, 1000
#: No label and no name of a sensor has more letters.
_LONGEST_WORD = 100


def check_names(model: Model) -> None:
    """Raise unless family, labels, features, guards and what is known are words we know, each once."""
    validation.choice("family", model.family, tuple(BY_NAME))
    for name, values, least in (
        ("labels", model.labels, 2),
        ("features", model.features, 1),
        ("features and guards", model.measured, 1),
        ("known", model.known, 0),
        ("sensors", model.sensors, 0),
    ):
        if len(values) < least or not all(map(_is_word, values)) or len(set(values)) != len(values):
            raise BadData(
                f"{name} must be at least {least} different words of 1 to {_LONGEST_WORD} letters that can be printed"
            )
    for label in model.labels:
        validation.label("labels", label)
    for name, values, most in (("labels", model.labels, MOST_LABELS), ("sensors", model.sensors, _MOST_SENSORS)):
        if len(values) > most:
            raise BadData(f"{name} must be at most {most}, got {len(values)}")
    for feature in model.measured:
        require_known(feature)
    for name in model.known:
        validation.choice("known", name, dict(KNOWN))
    quantity_of(model.unit)


def check_numbers(model: Model) -> None:
    """Raise unless the numbers and arrays that all families share can be used without harm."""
    lowest_highest = validation.positive("sampling_rates", model.sampling_rates, "Hz")
    if lowest_highest.shape != (2,) or lowest_highest[0] > lowest_highest[1]:
        raise BadData("sampling_rates must be the lowest and the highest")
    validation.positive("temperature", model.temperature)
    validation.positive("neighbourhood_limit", model.neighbourhood_limit)
    if validation.positive("guard_limits", model.guard_limits).shape != (len(model.guards),):
        raise BadData("guard_limits must be one number for each guard")
    _check_windows(model)
    n_features, n_classes = len(model.inputs), len(model.labels)
    shapes = {name: (n_features,) * axes for name, (_, axes) in SHARED.items()}
    shapes |= {
        "neighbourhood.centres": (n_classes, n_features),
        "neighbourhood.whitening": (n_classes, n_features, n_features),
    }
    common = (1, n_features, n_features)  # one covariance for all classes
    for name, shape in shapes.items():
        found = model.arrays[name].shape if name in model.arrays else None
        if found != shape and not (name == "neighbourhood.whitening" and found == common):
            raise BadData(f"array {name} must have shape {shape}")
    if ("conformal.scores" in model.arrays) != ("conformal.labels" in model.arrays):
        raise BadData("arrays conformal.scores and conformal.labels must both be there, or none")
    _check_arrays(model)
    if model.sensors:
        equalisations_of(model.references)  # checks their gains


def check_training(model: Model) -> None:
    """Raise unless what answers and reports take from the record of the training is of its kind."""
    training, n_labels = model.training, len(model.labels)
    metrics, recorded = training.get("metrics", {}), training.get("recorded", {})
    if not isinstance(metrics, Mapping) or not isinstance(recorded, Mapping):
        raise BadData("metrics and recorded must be objects in the header, where they are told")
    shapes: dict[str, tuple[int, ...]] = {
        "accuracy": (),
        "accuracy_interval_95": (2,),
        "confusion": (n_labels, n_labels),
    }
    for name, shape in shapes.items():
        if name in metrics:
            numbers = validation.not_negative(name, metrics[name])
            if numbers.shape != shape or numbers.max() > _LARGEST_NUMBER:
                raise BadData(f"{name} must be numbers of shape {shape} up to {_LARGEST_NUMBER:g}")
    if "confusion" in metrics and np.sum(metrics["confusion"]) < 1:
        raise BadData("confusion must count at least one impact")
    for weights in (training.get("class_weights"), recorded.get("class_weights")):
        if isinstance(weights, Mapping):
            numbers = validation.positive("class_weights", list(weights.values()))
            # Products with counts of impacts neither vanish nor overflow.
            if numbers.ndim != 1 or ((numbers > _LARGEST_NUMBER) | (numbers < 1 / _LARGEST_NUMBER)).any():
                raise BadData(
                    f"class_weights must be one number a label, {1 / _LARGEST_NUMBER:g} to {_LARGEST_NUMBER:g}"
                )
        elif weights not in (None, "balanced"):
            raise BadData("class_weights must be 'balanced' or a number for each label")


def _is_word(value: object) -> bool:
    """Return whether a value is a word that a terminal can be shown; escapes and signs that turn a line are none."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST_WORD and value.isprintable()


def _check_arrays(model: Model) -> None:
    """Raise unless all arrays are those of a model of this family, and hold numbers that can be reckoned with."""
    own = {f"family.{name}" for name in BY_NAME[model.family].AXES}
    beside = {"conformal.scores", "conformal.labels", "reference.spectra", "neighbourhood.centres"}
    known = own | beside | SHARED.keys() | {"neighbourhood.whitening"}
    for name, array in model.arrays.items():
        if name not in known:
            raise BadData(f"array {name!r} must be left out, a model of family {model.family} has none such")
        kinds = "b" if name == "standardiser.logarithmic" else "fi"
        plain = array.dtype.kind in kinds and array.size > 0
        # Without the absolute values: they would be another copy of it. False for nan.
        if not plain or not (array.min() >= -_LARGEST_NUMBER and array.max() <= _LARGEST_NUMBER):
            raise BadData(f"array {name} must hold finite numbers, got {array.dtype}")
    if not (model.arrays["standardiser.scale"] > 0).all() or not (model.arrays["standardiser.floor"] > 0).all():
        raise BadData("arrays standardiser.scale and standardiser.floor must be above 0")


def _check_windows(model: Model) -> None:
    """Raise unless windows, channels and references of sensors go together."""
    if isinstance(model.n_channels, bool) or not 1 <= model.n_channels <= MOST_CHANNELS:
        raise BadData(f"n_channels must lie between 1 and {MOST_CHANNELS}, got {model.n_channels}")
    if model.n_channels > 1 and (model.guards or model.known):
        raise BadData("guards and what is known must be left out where a model looks at several channels")
    if model.kind != "window":
        if model.window_time or model.hop_time:
            raise BadData(f"window_time and hop_time must be 0 for features of a {model.kind}")
    else:
        require_times(model.window_time, model.hop_time)
    spectra = model.arrays.get("reference.spectra")
    if (spectra is not None) != bool(model.sensors):
        raise BadData("array reference.spectra must be there where sensors are named, and only there")
    shape = len(model.sensors), model.n_channels, len(MEL_BANDS)
    if spectra is not None and spectra.shape != shape:
        raise BadData(f"array reference.spectra must have shape {shape}, got {spectra.shape}")
