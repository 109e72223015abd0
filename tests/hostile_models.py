"""Malicious model files, made by hand and by changes to sound ones, for `tests/test_hostile_models.py`."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import cgid.identification.inversion.through_beam  # noqa: F401 - loaded here, so that no watched process imports it
from cgid.identification.model.model import MAX_FILE_SIZE, StoredModel
from cgid.identification.model.model_file import LEVELS, signed
from cgid.measure.features import choose
from cgid.measure.modal.beam import points_of

GOLDEN = Path(__file__).parent / "golden"
#: The action of a pickle when it is loaded: it makes this folder, which the tests look for.
CANARY = "cgid-canary"


class _Bomb:
    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (CANARY,)


def golden_files() -> list[Path]:
    return sorted(GOLDEN.glob("models-4-*.npz"))


def golden(family: str) -> StoredModel:
    return StoredModel.load(GOLDEN / f"models-4-{family}.npz")


def written(header: Mapping[str, Any], arrays: Mapping[str, Any], *, sign: bool = True) -> bytes:
    """Return a model file of any header and arrays, with a valid digest, as an attacker would write it, or as given."""
    text = signed(header, arrays) if sign else json.dumps(header).encode()
    return packed({"header": np.frombuffer(text, np.uint8), **arrays})


def packed(arrays: Mapping[str, Any]) -> bytes:
    """Return an archive of any arrays, including pickles."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def wide_model() -> StoredModel:
    """Return a sound model of windows of 60 channels: too many numbers for a file of C."""
    features = choose(["window_level_*_hz"])[:20]
    n = 60 * len(features)
    return StoredModel(
        family="linear",
        labels=("coal", "gangue"),
        features=tuple(features),
        unit="m/s^2",
        sampling_rates=(48000.0, 48000.0),
        temperature=1.0,
        neighbourhood_limit=1.0,
        arrays={
            "standardiser.logarithmic": np.zeros(n, bool),
            "standardiser.floor": np.ones(n),
            "standardiser.mean": np.zeros(n),
            "standardiser.scale": np.ones(n),
            "neighbourhood.centres": np.zeros((2, n)),
            "neighbourhood.whitening": np.eye(n)[None],
            "family.coefficients": np.zeros((1, n)),
            "family.intercepts": np.zeros(1),
        },
        training={},
        window_time=0.5,
        hop_time=0.25,
        n_channels=60,
    )


def changed(family: str = "linear", header: Mapping[str, Any] | None = None, /, **arrays: Any) -> bytes:
    """Return a golden model with some of its header and its own arrays replaced, signed anew."""
    model = golden(family)
    own = {f"family.{name}": np.asarray(array) for name, array in arrays.items()}
    return written(model.header | dict(header or {}), {**model.arrays, **own})


def with_arrays(family: str, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return a golden model with some of its arrays replaced, signed anew."""
    model = golden(family)
    return written(model.header, {**model.arrays, **arrays})


def with_header(text: bytes) -> bytes:
    return packed({"header": np.frombuffer(text, np.uint8), **golden("linear").arrays})


def with_array(npy: bytes) -> bytes:
    """Return a golden model with any bytes as its intercepts, in a sound archive."""
    entries = entries_of(golden("linear").to_bytes())
    return archive({**entries, "family.intercepts.npy": npy})


def entries_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as stored:
        return {name: stored.read(name) for name in stored.namelist()}


def archive(entries: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as stored:
        for name, content in entries.items():
            stored.writestr(zipfile.ZipInfo(name), content, method)
    return stream.getvalue()


def npy(descr: str, shape: str, content: bytes = b"") -> bytes:
    head = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + content


# -- code -----------------------------------------------------------------------------------------------


def _pickles() -> dict[str, Callable[[], bytes]]:
    objects = np.array([_Bomb()], dtype=object)
    stream = io.BytesIO()
    np.save(stream, objects, allow_pickle=True)
    alone, expression = stream.getvalue(), b"__import__('os').mkdir('cgid-canary')\n"
    code = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(expression)) + expression
    return {
        "pickle with the ending of a model": lambda: pickle.dumps(_Bomb()),
        "header of objects": lambda: packed({"header": objects}),
        "weights of objects": lambda: packed({**arrays_with_header(), "family.intercepts": objects}),
        "pickle beside the arrays": lambda: archive({**entries_of(golden("linear").to_bytes()), "data.pkl": alone}),
        "pickle instead of numbers": lambda: with_array(npy("'|O'", "(1,)", pickle.dumps([_Bomb()]))),
        "Python instead of a shape": lambda: with_array(npy("'<f8'", "(__import__('os').mkdir('cgid-canary'),)")),
        "Python instead of the head of an array": lambda: with_array(code),
        "brackets that break a parser": lambda: with_array(npy("'<f8'", "(" * 9000 + ")" * 9000)),
    }


def arrays_with_header() -> dict[str, Any]:
    """Return the arrays of a golden model, with its header as one of them."""
    model = golden("linear")
    return {"header": np.frombuffer(signed(model.header, model.arrays), np.uint8), **model.arrays}


# -- archives -------------------------------------------------------------------------------------------


def _archives() -> dict[str, Callable[[], bytes]]:
    plain = golden("linear").to_bytes()
    entries = entries_of(plain)
    directory = plain.index(b"PK\x01\x02")
    crc = struct.unpack_from("<L", plain, 14)[0]

    def patched(place: int, form: str, *values: int) -> bytes:
        content = bytearray(plain)
        struct.pack_into(form, content, place, *values)
        return bytes(content)

    return {
        "deflated": lambda: archive(entries, zipfile.ZIP_DEFLATED),
        "bomb of a gigabyte": _bomb,
        "entries that overlap": _overlapping,
        "header twice": lambda: _twice(entries),
        "path out of the folder": lambda: archive({**entries, "../../../../tmp/evil.npy": b""}),
        "escape sequence in a name": lambda: archive({**entries, "\x1b[2J.npy": b""}),
        "directory that says another size": lambda: patched(directory + 20, "<2L", 1, 1),
        "checksum that does not fit": lambda: patched(14, "<L", crc ^ 1),
        "bytes behind the archive": lambda: plain + b"#!/bin/sh\n",
        "cut in the directory": lambda: plain[: directory + 30],
        "empty archive": lambda: archive({}),
        "larger than any model": lambda: bytes(MAX_FILE_SIZE + 1),
    }


def _bomb() -> bytes:
    packing = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packing.compress(bytes(1 << 20)) + packing.flush(zlib.Z_FULL_FLUSH)
    content = first * 1024 + zlib.compressobj(9, zlib.DEFLATED, -15).flush()
    name = b"header.npy"
    head = struct.pack("<5H3L", 20, 0, 8, 0, 33, 0, len(content), 1 << 30)
    local = b"PK\x03\x04" + head + struct.pack("<2H", len(name), 0) + name + content
    central = b"PK\x01\x02" + struct.pack("<H", 20) + head
    central += struct.pack("<5H2L", len(name), 0, 0, 0, 0, 0, 0) + name
    return local + central + b"PK\x05\x06" + struct.pack("<4H2LH", 0, 0, 1, 1, len(central), len(local), 0)


def _overlapping() -> bytes:
    local = archive({"header.npy": bytes(1 << 20)})
    start = local.index(b"PK\x01\x02")
    central = local[start : start + 56] * 60
    return local[:start] + central + b"PK\x05\x06" + struct.pack("<4H2LH", 0, 0, 60, 60, len(central), start, 0)


def _twice(entries: Mapping[str, bytes]) -> bytes:
    again = archive({**entries, "headex.npy": entries["header.npy"]})
    return again.replace(b"headex.npy", b"header.npy")


# -- arrays ---------------------------------------------------------------------------------------------


def _arrays() -> dict[str, Callable[[], bytes]]:
    one = np.float64(1.0).tobytes()
    heads = {
        "10^12 numbers in no bytes": npy("'<f8'", "(1000000000000,)"),
        "shape that overflows": npy("'<f8'", "(4294967296, 4294967296, 16)"),
        "shape of nothing": npy("'<f8'", "(0,)"),
        "more numbers than declared": npy("'<f8'", "(1,)", one * 2),
        "big-endian": npy("'>f8'", "(1,)", one),
        "head of four gigabytes": b"\x93NUMPY\x02\x00\xff\xff\xff\xff{",
        "no array": b"hello",
        "nothing": b"",
    }
    crafted = {name: (lambda content=content: with_array(content)) for name, content in heads.items()}
    truths = npy("'|b1'", "(2,)", b"\x07\x01")
    linear = golden("linear")
    entries = entries_of(linear.to_bytes())
    network = golden("network")
    turned = np.asfortranarray(network.arrays["family.weights_1"].T.copy())
    return crafted | {
        "truths that are sevens": lambda: archive({**entries, "standardiser.logarithmic.npy": truths}),
        "array of another family": lambda: changed("linear", None, biases_1=np.zeros(1)),
        "weights turned": lambda: changed("network", None, weights_1=turned),
        "weight that is nan": lambda: changed("linear", None, intercepts=[np.nan]),
        "weight of 1e300": lambda: changed("linear", None, coefficients=np.full((1, 2), 1e300)),
        "scale of zero": lambda: with_arrays("linear", {"standardiser.scale": np.zeros(2)}),
        "scale of 5e-324": lambda: with_arrays("linear", {"standardiser.scale": np.full(2, 5e-324)}),
        "floor of 5e-324": lambda: with_arrays("linear", {"standardiser.floor": np.full(2, 5e-324)}),
        "whitening of zeros": lambda: with_arrays("linear", {"neighbourhood.whitening": np.zeros((1, 2, 2))}),
        "whitening of equal rows": lambda: with_arrays("logistic", {"neighbourhood.whitening": np.ones((2, 2, 2))}),
        "whitening of 5e-324": lambda: with_arrays("linear", {"neighbourhood.whitening": 5e-324 * np.eye(2)[None]}),
        "whitening of 1e-90": lambda: with_arrays("linear", {"neighbourhood.whitening": 1e-90 * np.eye(2)[None]}),
        "centres of 1e100": lambda: with_arrays("linear", {"neighbourhood.centres": np.full((2, 2), 1e100)}),
        "calibration of labels that do not exist": lambda: written(
            linear.header, {**linear.arrays, "conformal.labels": linear.arrays["conformal.labels"] + 7}
        ),
    }


# -- beams ----------------------------------------------------------------------------------------------


def beam_arrays(**changes: Any) -> dict[str, Any]:
    """Return the arrays of a beam of three modes and four shapes at 8 kHz, some replaced, or left out if None."""
    poles = np.array([[-20.0, -60.0, -200.0], [600.0, 2500.0, 9000.0]])
    n_points = points_of(8e3)
    shapes = np.sin(np.outer(np.arange(1, 5), np.linspace(0, np.pi, n_points))) / np.sqrt(n_points / 2)
    arrays = {
        "scalars": np.array([8e3, 2.0]),
        "poles": poles,
        "participation": 1e-3 * np.cos(np.arange(3 * 4 * 5.0)).reshape(3, 4, 5),
        "region": np.array([0.8, 1.2, 0.2, 0.5]),
        "filters": np.array([[-9e3, -2e4], [1.8e4, 0.0]]),
        "shapes": shapes,
        "deviations": np.array([4.0, 2.0, 1.0, 0.5]),
    }
    return {f"beam.{name}": array for name, array in (arrays | changes).items() if array is not None}


def with_beam(header: Mapping[str, Any] | None = None, /, **changes: Any) -> bytes:
    """Return a model that looks through `beam_arrays`, changed and signed anew."""
    model = golden("logistic")
    features = {"features": ["beam_peak_force", "beam_pulse_width"], "unit": "m/s^2", "sampling_rates": [8e3, 8e3]}
    return written(model.header | features | dict(header or {}), {**model.arrays, **beam_arrays(**changes)})


def _beams() -> dict[str, Callable[[], bytes]]:
    poles = beam_arrays()["beam.poles"]

    def of_modes(n: int) -> dict[str, Any]:
        return {"poles": np.tile([[-20.0], [600.0]], n), "participation": np.ones((n, 1, 1))}

    def one(name: str, place: Any, value: float) -> dict[str, Any]:
        array = beam_arrays()[f"beam.{name}"].copy()
        array[place] = value
        return {name: array}

    changes: dict[str, dict[str, Any]] = {
        "beam whose pole grows": one("poles", (0, 1), 20.0),
        "beam whose pole is below the axis": {"poles": poles * [[1.0], [-1.0]]},
        "beam whose pole is nan": one("poles", (1, 0), np.nan),
        "beam whose pole is 10^99": one("poles", (1, 0), 1e99),
        "beam whose filter grows": one("filters", (0, 0), 9e3),
        "beam of 100 filters": {"filters": np.tile([[-9e3], [0.0]], 100)},
        "beam of 1,025 modes": of_modes(1025),
        "beam of 65 shapes": {"shapes": np.ones((65, points_of(8e3))), "deviations": np.ones(65)},
        "beam of too many responses": {
            **of_modes(1024),
            "scalars": np.array([4e5, 2.0]),
            "shapes": np.ones((8, points_of(4e5))),
            "deviations": np.ones(8),
        },
        "beam of two axes": {"participation": np.ones((3, 4))},
        "beam that nothing moves": {"participation": np.zeros((3, 4, 5))},
        "beam upside down": {"region": np.array([0.8, 1.2, 0.5, 0.2])},
        "beam of a million metres": {"region": np.array([0.0, 1e6, 0.0, 1e6])},
        "rate of a beam of 10^99": one("scalars", 0, 1e99),
        "rate of a beam below 0": one("scalars", 0, -8e3),
        "rate of a beam of another table": one("scalars", 0, 9e3),
        "seven derivatives": one("scalars", 1, 7.0),
        "deviation of 0": one("deviations", 0, 0.0),
        "shape that is nan": one("shapes", (0, 0), np.nan),
        "shape of nothing but 0": one("shapes", 0, 0.0),
        "poles of three parts": {"poles": np.concatenate([poles, poles[:1]])},
        "beam of errors below 0": {"errors": np.full((3, 3), -0.01)},
        "beam of errors of other modes": {"errors": np.full((3, 4), 0.01)},
        "beam without poles": {"poles": None},
    }
    crafted = {name: (lambda own=own: with_beam(None, **own)) for name, own in changes.items()}
    force = {"features": ["peak_force", "width_50"], "unit": "N"}
    plain = golden("logistic")
    through = plain.header | {"features": ["beam_peak_force", "beam_pulse_width"], "unit": "m/s^2"}
    return crafted | {
        "beam that nobody looks through": lambda: with_beam(force),
        "look through no beam": lambda: written(through, plain.arrays),
    }


# -- headers --------------------------------------------------------------------------------------------


def _headers() -> dict[str, Callable[[], bytes]]:
    model = golden("linear")
    text = json.dumps(model.header | {"sha256": "0" * 64}).encode()
    said = {
        "label that clears the screen": {"labels": ["coal\x1b[2J\x1b[H", "gangue"]},
        "label that turns the line over": {"labels": ["coal\u202eeugnag", "gangue"]},
        "label of two lines": {"labels": ["coal\ncgid: all is well", "gangue"]},
        "label of a megabyte": {"labels": ["c" * (1 << 20), "gangue"]},
        "labels that are lists": {"labels": [["coal"], ["gangue"]]},
        "100,000 labels": {"labels": [f"l{k}" for k in range(100_000)]},
        "feature of a megabyte": {"features": ["f" * (1 << 20), "width_50"]},
        "a feature twice": {"features": ["width_50", "width_50"]},
        "feature that does not exist": {"features": ["peak_forse", "width_50"]},
        "channels without end": {"n_channels": 10**9},
        "temperature of 5e-324": {"temperature": 5e-324},
        "neighbourhood of 5e-324": {"neighbourhood_limit": 5e-324},
        "sampling rate of 5e-324": {"sampling_rates": [5e-324, 5e-324]},
        "levels of no spread": {"training": {"level_range": dict.fromkeys(LEVELS, 0.0)}},
        "levels of 5e-324": {"training": {"level_range": dict.fromkeys(LEVELS, 5e-324)}},
        "levels that fall": {"training": {"level_range": dict.fromkeys(LEVELS, 1.0) | {"low": 2.0}}},
        "levels that are a list": {"training": {"level_range": [1.0, 2.0]}},
        "temperature that is nan": {"temperature": float("nan")},
        "temperature of 4000 digits": {"temperature": 10**4000},
        "a thousand rates and a long text": {"sampling_rates": [*([1.0] * 1000), "9" * 1_000_000]},
        "measurement that is a number": {"training": {"metrics": 7}},
        "accuracy that is a text": {"training": {"metrics": {"accuracy": "\x1b[31mperfect"}}},
        "confusion of other labels": {"training": {"metrics": {"confusion": [[1]]}}},
        "class weights that are lists": {"training": {"class_weights": [1, 2]}},
        "class weight of 10^-300": {"training": {"class_weights": {"coal": 1e-300, "gangue": 1e-300}}},
        "sensors that clear the screen": {"sensors": "\x1b[2J"},
        "something unheard of": {"\x1b]0;evil\x07": 1},
        "family of another world": {"family": "pickle"},
        "family without harm, arrays of another": {"family": "network"},
        "family of trees": {"family": "boosting"},
        "schema 1": {"schema_version": 1},
        "schema that is a text": {"schema_version": "\x1b[2J"},
        "nested 900 deep": {"training": _nested(900)},
    }
    crafted = {name: (lambda header=header: changed("linear", header)) for name, header in said.items()}
    order = model.header | {"features": model.header["features"][::-1]}
    true = json.loads(entries_of(model.to_bytes())["header.npy"][128:])
    flipped = {**model.arrays, "family.intercepts": model.arrays["family.intercepts"] + 1e-12}
    return crafted | {
        "header of 6 megabytes": lambda: with_header(text[:-1] + b" " * 6_000_000 + b"}"),
        "a hundred megabytes of JSON": lambda: with_header(b"[" + b"0," * 50_000_000 + b"0]"),
        "nested a million deep": lambda: with_header(b"[" * 1_000_000 + b"]" * 1_000_000),
        "key said twice": lambda: with_header(text[:-1] + b', "unit": "N"}'),
        "number of 100,000 digits": lambda: with_header(text[:-1] + b', "n": 1' + b"0" * 100_000 + b"}"),
        "no JSON": lambda: with_header(b"hello"),
        "no digest": lambda: written(model.header, model.arrays, sign=False),
        "digest that is a number": lambda: written(model.header | {"sha256": 7}, model.arrays, sign=False),
        "features in another order under the old digest": lambda: written(
            order | {"sha256": true["sha256"]}, model.arrays, sign=False
        ),
        "weight changed under the old digest": lambda: written(true, flipped, sign=False),
        "header of floats": lambda: packed({"header": np.ones(3), **model.arrays}),
        "header behind the arrays": lambda: archive(dict(reversed(entries_of(model.to_bytes()).items()))),
    }


def _nested(depth: int) -> Any:
    value: Any = {}
    for _ in range(depth):
        value = {"a": value}
    return value


# -- sound files, but extreme ----------------------------------------------------------------------------


def _widest_network() -> bytes:
    wide = 1_000_000
    return changed(
        "network",
        None,
        weights_1=np.zeros((2, 1)),
        biases_1=np.zeros(1),
        weights_2=np.zeros((1, wide)),
        biases_2=np.zeros(wide),
        weights_3=np.zeros((wide, 1)),
    )


def _huge_numbers() -> bytes:
    scale = np.full(2, 1e-29)
    return with_arrays("logistic", {"standardiser.logarithmic": np.zeros(2, bool), "standardiser.scale": scale})


def _extreme_beam() -> bytes:
    own = beam_arrays()
    return with_beam(
        poles=8e3 * np.array([[-1.1e-5, -999.0, -1e-9], [1.2e-11, 1e-2, 900.0]]),
        participation=1e9 * np.sign(own["beam.participation"]),
        filters=8e3 * np.array([[-1.1e-3, -999.0], [0.0, 1.0]]),
        shapes=9e8 * np.sign(own["beam.shapes"] + 1e-12),
        deviations=np.array([1e9, 1e9, 1e-9, 1e-9]),
    )


#: Files to refuse, in one line.
HOSTILE: dict[str, Callable[[], bytes]] = _pickles() | _archives() | _arrays() | _beams() | _headers()
#: Files that may answer within the limits of time and memory: with probabilities, or with a one-line reason.
EXTREME: dict[str, Callable[[], bytes]] = {
    "checksum that does not fit": HOSTILE.pop("checksum that does not fit"),  # zipfile reads that of the directory
    "widest network": _widest_network,
    "numbers that grow too large": _huge_numbers,
    "beam of one node": lambda: with_beam(participation=np.ones((3, 1, 1))),
    "beam without filters": lambda: with_beam(filters=None),
    "beam of no size": lambda: with_beam(region=np.array([0.8, 0.8, 0.2, 0.2])),
    "beam of extreme numbers": _extreme_beam,
    "beam of modes and places as many as allowed": lambda: with_beam(
        poles=np.tile([[-20.0], [600.0]], 1024),
        participation=np.ones((1024, 4, 5)),
        region=np.array([0.0, 400.0, 0.0, 0.0]),
    ),
}


# -- changes to sound files ------------------------------------------------------------------------------

#: Values that an attacker may put into the header, and into an array.
_SAYINGS: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2, 64, 10**6, 2**63, -(2**31), 1e-320, 1e99, 1e308, float("nan"), float("inf"),
    "", "N", "m/s^2", "coal", "\x1b[2J", "network", "boosting", "logistic", "linear", "window_centroid",
    [], [0], [1e-9, 1e9], ["coal"], ["coal", "gangue", "stone"], ["peak_force"],
    ["window_centroid", "window_rms"], {}, {"metrics": []}, {"metrics": {"confusion": [[1, 2], [3, 4]]}},
)  # fmt: skip
_NUMBERS = (
    *(0.0, -1.0, 1.0, 2.0, 5e-324, 1e-300, 1e-29, -1e99, 1e99, 1e300, 1e308, np.nan, np.inf),
    *(2.0**31 - 1, -(2.0**31), 1e6),
)
_TYPES = ("f4", "f8", "i4", "i8", "u4", "?", ">f8", "S3", "c16")


def mended(content: bytes, random: np.random.Generator) -> bytes:
    """Change a bit of an array or of the header, and adjust the archive's checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as stored:
        entry = stored.infolist()[int(random.integers(len(stored.infolist())))]
    start = entry.header_offset + 30 + len(entry.filename) + 20
    changed = bytearray(content)
    changed[start + int(random.integers(128, entry.file_size))] ^= 1 << int(random.integers(8))
    checksum = struct.pack("<L", zlib.crc32(changed[start : start + entry.file_size]))
    changed[entry.header_offset + 14 : entry.header_offset + 18] = checksum
    named = changed.rindex(b"PK\x01\x02", 0, changed.rindex(entry.filename.encode()))
    changed[named + 16 : named + 20] = checksum
    return bytes(changed)


def signed_anew(model: StoredModel, random: np.random.Generator) -> bytes:
    """Make one or two changes to header and arrays as an attacker would, with all checksums recomputed."""
    header, arrays = dict(model.header), dict(model.arrays)
    for _ in range(int(random.integers(1, 3))):
        if random.random() < 0.4:
            header[str(random.choice(sorted(header)))] = _SAYINGS[int(random.integers(len(_SAYINGS)))]
        else:
            name = str(random.choice(sorted(arrays)))
            arrays[name] = _changed_array(arrays[name], random)
    return written(header, arrays)


def _changed_array(array: np.ndarray, random: np.random.Generator) -> np.ndarray:
    if not array.size:  # the change before has left nothing
        return np.zeros(1, array.dtype)
    numbers = array.copy()
    where = slice(None) if random.random() < 0.2 else int(random.integers(array.size))
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        numbers.reshape(-1)[where] = np.array(random.choice(_NUMBERS)).astype(array.dtype)
        changes = (
            *(numbers, numbers, array[:-1], array.ravel(), np.concatenate([array, array]), array[::-1].copy()),
            *(np.broadcast_to(array[..., :1], array.shape).copy(), np.zeros_like(array)),
            *(random.permutation(array), array.astype(str(random.choice(_TYPES))), np.asfortranarray(array)),
        )
        return changes[int(random.integers(len(changes)))]
