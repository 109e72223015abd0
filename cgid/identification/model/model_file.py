"""The model file: an uncompressed .npz archive of a JSON header and numeric arrays, read as untrusted.

Model files may come from anyone. numpy reads them without pickle, compressed entries are refused, so that no size can
exceed the file, and a digest covers header and arrays. Then the content is checked.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.anchor import SeamNetworks, pulse_names
from cgid.identification.model.confusion import Confusion
from cgid.identification.model.explanations import Explanations, needed
from cgid.identification.model.families import (
    BY_NAME,
    MIN_DIVISOR,
    Contrast,
    Fitted,
    Linear,
    Network,
    Standardiser,
    require_family,
)
from cgid.measure.features.extraction import any_through_beam, require_known
from cgid.measure.modal.beam import Beam
from cgid.units import quantity_of

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel

#: Of the training record: median of the guard of models with a beam [%].
UNEXPLAINED = "median_beam_unexplained"
#: Of the training record of models of windows: correlation of windows in a vote.
VOTE_CORRELATION = "vote_correlation"
#: Prefix of arrays of models that earlier versions trained on streams.
_NO_LONGER_USED = "world."
#: Of the training record of models of labelled recordings: the levels of recordings, and the names of its numbers.
LEVEL_RANGE, LEVELS = "level_range", ("deviation", "low", "high", "between", "within")

#: Of the training record of models of recordings: the control by what sounds between the rocks, and whether the model
#: was trained without tones of machines.
CONTROL = "control"
MENDED = "mended"
#: The array of least values of the inputs: below these, nothing counts.
FLOOR = "floor.levels"
#: The least value of an input that has none, finite in single precision.
NO_FLOOR = -1e30

#: Longest window [s], because it is in memory.
MAX_WINDOW = 10.0
#: Shortest hop, as a share of the window; the longest is `MAX_WINDOW`.
FINEST_HOP = 0.01

# -- the archive ------------------------------------------------------------------------------------------

#: Maximum number of arrays of a model, and longest directory of its archive [bytes].
MAX_ENTRIES, _MAX_DIRECTORY_SIZE = 96, 96 * 128
_MAX_AXES = 3
_TYPES = ("<f8", "<f4", "<i4", "<i8", "|b1", "|u1")
#: Errors of zipfile and numpy on damaged archives.
_DAMAGE = (
    zipfile.BadZipFile, struct.error, ValueError, LookupError, OSError, EOFError, RuntimeError, ArithmeticError,
    MemoryError, SyntaxError, TypeError,
)  # fmt: skip


def arrays_of(content: bytes) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and array of each entry of an archive in order, read-only; `BadData` for anything else."""
    # zipfile would read a directory of a million entries.
    directory = struct.unpack_from("<L", content, len(content) - 10)[0] if len(content) > 22 else 0
    if not content.startswith(b"PK") or content[-22:-18] != b"PK\x05\x06" or not 0 < directory <= _MAX_DIRECTORY_SIZE:
        raise BadData("it must be a complete .npz archive of numbers; it is damaged, cut off or another file")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            if len(entries) > MAX_ENTRIES or len({entry.filename for entry in entries}) != len(entries):
                raise BadData(f"its archive must contain at most {MAX_ENTRIES} arrays, each once")
            for entry in entries:
                # Then no array exceeds the file.
                if entry.compress_type or entry.flag_bits & 1 or entry.file_size > len(content):
                    raise BadData(f"array {entry.filename!r} must be stored uncompressed and not encrypted")
                yield entry.filename.removesuffix(".npy"), _array(archive.read(entry), entry.filename)
    except BadData:
        raise
    except _DAMAGE as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:100]
        raise BadData(f"its archive must be complete, it is damaged ({reason})") from None


def _array(stored: bytes, name: str) -> NDArray[Any]:
    stream = io.BytesIO(stored)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise BadData(f"array {name} must be in version 1.0 of the array format")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    # With Python's integers the product cannot overflow.
    size = math.prod(map(int, shape)) * dtype.itemsize
    if dtype.str not in _TYPES or size != len(stored) - stream.tell() or 0 in shape or len(shape) > _MAX_AXES:
        raise BadData(f"array {name} must contain plain numbers (float64, float32, int32, int64, bool) as declared")
    array: NDArray[Any] = np.frombuffer(stored, dtype, offset=stream.tell())  # read-only
    if dtype.kind == "b" and (array.view(np.uint8) > 1).any():
        raise BadData(f"array {name} must contain truth values, bytes 0 and 1")
    return array.reshape(shape, order="F" if is_fortran else "C")


# -- the header -------------------------------------------------------------------------------------------

FORMAT = "cgid-model"
SCHEMA_VERSION = 4
#: Longest header [bytes]: 100 bytes for each of 20,000 recordings.
MAX_HEADER_SIZE = 2 << 20
#: Deepest nesting of lists and objects; real headers have seven levels.
_DEEPEST = 32
#: Largest absolute value of any number: products of three are still finite.
_MAX_NUMBER = 1e100
_LISTS_OF_NUMBERS = ("guard_limits", "sampling_rates")
#: Fields that must be empty: what a model of an earlier development version needed -> why it is withdrawn.
WITHDRAWN = {
    "known": "a model that needs a drop height is withdrawn",
    "sensors": "reference runs of sensors are withdrawn",
}
#: Other fields: the quantity follows from the unit, the others are checked on reading.
_FURTHER_FIELDS = {"format", "schema_version", "quantity", "sha256", *WITHDRAWN}


class NewerSchema(BadData):
    """The file has a later schema than this cgid reads; retraining the model would not help."""


def read_header(stored: NDArray[Any]) -> dict[str, Any]:
    """Return the header of a model file after checking its schema version."""
    if stored.size > MAX_HEADER_SIZE:
        raise BadData(f"its header must be at most {MAX_HEADER_SIZE >> 20} MiB, it is {stored.size / 2**20:.1f} MiB")
    try:
        header = json.loads(stored.tobytes(), object_pairs_hook=_unique)
    except BadData:
        raise
    except (ValueError, RecursionError):
        raise BadData("it must have a header of JSON") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise BadData(f"format must be {FORMAT!r}")
    if _is_deeper(header, _DEEPEST):
        raise BadData(f"its header must not nest deeper than {_DEEPEST}")
    version = header.get("schema_version")
    if type(version) is int and version > SCHEMA_VERSION:
        raise NewerSchema(
            f"schema_version {str(version)[:20]} is newer than this cgid (reads {SCHEMA_VERSION}): upgrade cgid"
        )
    if type(version) is not int or version != SCHEMA_VERSION:
        raise BadData(
            f"schema_version must be {SCHEMA_VERSION}, got {repr(version)[:20]}, of an earlier development version"
        )
    return header


def stored_fields(model: type[StoredModel]) -> dict[str, type]:
    """Return the fields of a model that its header has, all required, and their types in JSON."""
    kinds = {"str": str, "float": float, "int": int, "Mapping[str, Any]": dict}
    declared = {field.name: str(field.type) for field in fields(model) if field.name not in ("arrays", "estimator")}
    return {name: list if kind.startswith("tuple") else kinds[kind] for name, kind in declared.items()}


def fields_of(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], stored: Mapping[str, type]
) -> dict[str, Any]:
    """Return the stored fields of a model from a header whose digest matches, lists as tuples."""
    if header.get("sha256") != digest(header, arrays):
        raise BadData("header and arrays must match the SHA-256 in the header, they were changed")
    if unknown := header.keys() - stored.keys() - _FURTHER_FIELDS:
        raise BadData(f"the header must have the fields of a model only, got {min(unknown)[:40]!r}")
    for name, reason in WITHDRAWN.items():
        if header.get(name) != []:
            raise BadData(f"{name} must be an empty list, {reason}, got {header.get(name)!r:.40}")
    for name, kind in stored.items():
        good = _is(header.get(name), kind)
        if not good or (name in _LISTS_OF_NUMBERS and not all(_is(number, float) for number in header[name])):
            raise BadData(f"{name} is missing or of a wrong kind in the header")
    return {name: tuple(header[name]) if kind is list else header[name] for name, kind in stored.items()}


def signed(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the header as JSON, including the digest of header and arrays."""
    return json.dumps({**header, "sha256": digest(header, arrays)}, sort_keys=True).encode()


def digest(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the header without its digest, and of the arrays; it detects accidental changes only."""
    fields = {name: value for name, value in header.items() if name != "sha256"}
    hashed = hashlib.sha256(json.dumps(fields, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        hashed.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        hashed.update(np.ascontiguousarray(array).data)
    return hashed.hexdigest()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    unique = dict(pairs)
    if len(unique) != len(pairs):
        raise BadData("its header must have each key once")
    return unique


def _is_deeper(value: Any, levels: int) -> bool:
    """Return whether lists and objects nest deeper than `levels`."""
    inner = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_is_deeper(one, levels - 1) for one in inner if isinstance(one, dict | list))


def _is(value: Any, kind: type) -> bool:
    """Return whether a JSON value has a type; an integer may stand for a float, a bool for neither."""
    if kind in (int, float):
        number = type(value) is int or (kind is float and type(value) is float)
        return number and abs(value) <= _MAX_NUMBER  # False for nan
    return isinstance(value, kind)


# -- the model --------------------------------------------------------------------------------------------

MAX_CHANNELS = 64
#: Prefix of the arrays of the standardiser.
STANDARDISER = "standardiser."
MAX_LABELS = 1000
#: Maximum number of characters of a label.
_MAX_WORD_LENGTH = 100


def with_floats(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a model with float64 for integer weights, as exports need; those of a beam unchanged."""
    return {
        name: array
        if array.dtype.kind != "i" or name == "conformal.labels" or name.startswith("beam.")
        else array.astype(np.float64)
        for name, array in arrays.items()
    }


def check_names(model: StoredModel) -> None:
    """Raise unless family, labels, features and guards are valid and distinct."""
    if model.estimator is None:
        require_family(model.family, BY_NAME)
    for name, values, min_count in (
        ("labels", model.labels, 2),
        ("features", model.features, 1),
        ("features and guards", model.measured, 1),
    ):
        if len(values) < min_count or not all(map(_is_word, values)) or len(set(values)) != len(values):
            raise BadData(
                f"{name} must be {min_count} or more different printable words of 1 to {_MAX_WORD_LENGTH} characters"
            )
    for label in model.labels:
        validation.label("labels", label)
    if len(model.labels) > MAX_LABELS:
        raise BadData(f"labels must be at most {MAX_LABELS}, got {len(model.labels)}")
    for feature in model.measured:
        require_known(feature)
    quantity_of(model.unit)


def check_numbers(model: StoredModel) -> None:
    """Raise unless the numbers and the arrays common to all families are finite and consistent."""
    rates = validation.positive("sampling_rates", model.sampling_rates, "Hz")
    low, high = validation.RATES
    if rates.shape != (2,) or not low <= rates[0] <= rates[1] <= high:
        raise BadData(f"sampling_rates must be the lowest and the highest, {low:g} to {high:g} Hz")
    for name in ("temperature", "neighbourhood_limit", "guard_limits"):
        numbers = validation.positive(name, getattr(model, name))
        if (numbers < MIN_DIVISOR).any():
            raise BadData(f"{name} must be at least {MIN_DIVISOR:g}, got {numbers.min():.3g}")
    if np.shape(model.guard_limits) != (len(model.guards),):
        raise BadData("guard_limits must be one number for each guard")
    _check_windows(model)
    _check_arrays(model)


def check_training(model: StoredModel) -> None:
    """Raise unless the entries of the training record that answers and reports use have the right type."""
    training, n_labels = model.training, len(model.labels)
    metrics, recorded, correction = (training.get(name, {}) for name in ("metrics", "recorded", "correction"))
    if not all(isinstance(one, Mapping) for one in (metrics, recorded, correction)):
        raise BadData("metrics, recorded and correction must be objects if the header has them")
    shapes: dict[str, tuple[int, ...]] = {
        "accuracy": (),
        "accuracy_interval_95": (2,),
        "confusion": (n_labels, n_labels),
    }
    for found in (metrics, correction):
        for name in shapes.keys() & found.keys():
            numbers = validation.not_negative(name, found[name])
            if numbers.shape != shapes[name] or numbers.max() > _MAX_NUMBER:
                raise BadData(f"{name} must be numbers of shape {shapes[name]} up to {_MAX_NUMBER:g}")
        if "confusion" in found and np.sum(found["confusion"]) < 1:
            raise BadData("confusion must count at least one impact")
    for control in (training.get(CONTROL, {}), correction.get(CONTROL, {})):
        _check_control(control)
    for name in (UNEXPLAINED, VOTE_CORRELATION):
        if name in training and np.ndim(validation.not_negative(name, training[name])):
            raise BadData(f"{name} must be one number")
    if LEVEL_RANGE in training:
        _check_level_range(training[LEVEL_RANGE])
    if training.get(VOTE_CORRELATION, 0.0) > 1:
        raise BadData(f"{VOTE_CORRELATION} must be at most 1, got {training[VOTE_CORRELATION]:g}")
    beams = training.get("same_beam", [])
    if not (isinstance(beams, list) and all(isinstance(one, str) for one in beams)):
        raise BadData("same_beam must be a list of names of channels, such as 1+2")
    if "fewest_groups" in recorded:
        validation.count("fewest_groups", recorded["fewest_groups"])
    for weights in (training.get("class_weights"), recorded.get("class_weights")):
        if isinstance(weights, Mapping):
            numbers = validation.positive("class_weights", list(weights.values()))
            low, high = 1 / _MAX_NUMBER, _MAX_NUMBER  # products with counts neither vanish nor overflow
            if numbers.ndim != 1 or (numbers > high).any() or (numbers < low).any():
                raise BadData(f"class_weights must be one number for each label, {low:g} to {high:g}")
        elif weights not in (None, "balanced"):
            raise BadData("class_weights must be 'balanced' or a number for each label")


def _check_control(control: object) -> None:
    """Raise unless a control is empty, or states by what it tells, with the numbers of its line."""
    if not isinstance(control, Mapping):
        raise BadData(f"{CONTROL} must be an object")
    validation.choice(f"told of {CONTROL}", control.get("told", ""), ("", "background", "path"))
    numbers = [control.get("same"), control.get("other"), *np.ravel(control.get("path", ())).tolist()]
    if control.get("told") and (len(numbers) != 4 or not all(_is(one, float) for one in numbers)):
        raise BadData(f"{CONTROL} must have the numbers same, other and two of path if it tells")


def _check_level_range(levels: object) -> None:
    """Raise unless the range of levels is empty, or its numbers are finite and make one."""
    if levels == {}:
        return
    if (
        not isinstance(levels, Mapping)
        or set(levels) != set(LEVELS)
        or not all(_is(levels[one], float) for one in LEVELS)
    ):
        raise BadData(f"{LEVEL_RANGE} must be numbers named {', '.join(LEVELS)}")
    spreads = [levels[name] for name in ("deviation", "between", "within")]
    if min(spreads) < np.finfo(np.float32).tiny or levels["low"] > levels["high"]:
        raise BadData(f"{LEVEL_RANGE} must rise from low to high and have spreads above 0")


def _is_word(value: object) -> bool:
    """Return whether a value is a word without control characters, safe to print on a terminal."""
    return isinstance(value, str) and 0 < len(value) <= _MAX_WORD_LENGTH and value.isprintable()


def _check_arrays(model: StoredModel) -> None:
    """Raise unless the arrays are those of the model's family and all values are finite."""
    arrays, n, n_classes = model.arrays, len(model.inputs), len(model.labels)
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        **dict.fromkeys((STANDARDISER + name for name in Standardiser.NAMES), ((n,),)),
        "neighbourhood.centres": ((n_classes, n),),
        "neighbourhood.whitening": ((n_classes, n, n), (1, n, n)),  # one per class, or one for all
    }
    for name, possible in shapes.items():
        if name not in arrays or arrays[name].shape not in possible:
            raise BadData(f"array {name} must have shape {possible[0]}")
    if ("conformal.scores" in arrays) != ("conformal.labels" in arrays):
        raise BadData("arrays conformal.scores and conformal.labels must both be present or absent")
    if FLOOR in arrays and arrays[FLOOR].shape != (n,):
        raise BadData(f"array {FLOOR} must have shape {(n,)}")
    known = shapes.keys() | {"conformal.scores", "conformal.labels", FLOOR}
    family = Fitted if model.estimator is not None else BY_NAME[model.family]
    known |= {f"family.{name}" for name in family.AXES} | {f"beam.{name}" for name in Beam.ARRAYS}
    known |= {Contrast.PREFIX + name for name in (*Standardiser.NAMES, *Network.AXES, *Linear.AXES, "limit")}
    known |= {part.PREFIX + name for part in (Confusion, SeamNetworks) for name in part.ARRAYS}
    known |= {prefix + name for prefix in Explanations.PREFIXES for name in Explanations.ARRAYS}
    for name, array in arrays.items():
        if name not in known and not name.startswith(_NO_LONGER_USED):
            raise BadData(f"array {name!r} must be left out, a model of family {model.family} has no such array")
        kinds = "b" if name.endswith(".logarithmic") else "fi"
        plain = array.dtype.kind in kinds and array.size > 0
        # Without np.abs, which would copy a large array. False for nan.
        if not plain or not (float(array.min()) >= -_MAX_NUMBER and float(array.max()) <= _MAX_NUMBER):
            raise BadData(f"array {name} must contain finite numbers, got {array.dtype}")
    if n_classes != 2 and any(name.startswith(Confusion.PREFIX) for name in arrays):
        raise BadData(f"arrays of a share must be left out, they are for two labels, got {n_classes}")
    if any(name.startswith(SeamNetworks.PREFIX) for name in arrays) and (
        n_classes != 2 or "gangue" not in model.labels or not pulse_names(model.features)
    ):
        raise BadData("arrays of seams must be left out, they are for pulses of gangue and one other label")
    if any(name.startswith(Explanations.PREFIXES) for name in arrays) and not needed(model):
        raise BadData("arrays of explanations must be left out, they are for pulses, shapes and what these leave")
    Standardiser.from_arrays(arrays, STANDARDISER)  # checks its scale and floor
    if any_through_beam(model.measured) != any(name.startswith("beam.") for name in arrays):
        raise BadData("a model must have the arrays of a beam if and only if features need it")


def require_times(window_time: float, hop_time: float) -> None:
    """Raise `InvalidValue` unless the length of windows [s] and the hop between their starts [s] are valid."""
    validation.positive("window_time", window_time, "s")
    validation.positive("hop_time", hop_time, "s")
    if window_time > MAX_WINDOW:
        raise InvalidValue(f"window_time must be at most {MAX_WINDOW:g} s, got {window_time:g} s")
    if not FINEST_HOP * window_time <= hop_time <= MAX_WINDOW:
        raise InvalidValue(
            f"hop_time must be between {FINEST_HOP:g} of a window and {MAX_WINDOW:g} s, got {hop_time:g} s for "
            f"windows of {window_time:g} s"
        )


def _check_windows(model: StoredModel) -> None:
    """Raise unless windows and channels are consistent."""
    if isinstance(model.n_channels, bool) or not 1 <= model.n_channels <= MAX_CHANNELS:
        raise BadData(f"n_channels must be between 1 and {MAX_CHANNELS}, got {model.n_channels}")
    if model.n_channels > 1 and model.guards:
        raise BadData("guards must be left out in a model of several channels")
    if model.kind == "window":
        require_times(model.window_time, model.hop_time)
    elif model.window_time or model.hop_time:
        raise BadData(f"window_time and hop_time must be 0 for features of a {model.kind}")
