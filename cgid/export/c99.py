"""A model as one C99 file from features to a prediction, for controllers and programs without Python.

The file depends only on the C library, allocates nothing, and has no state. Its caller measures the features.
"""

from __future__ import annotations

import hashlib
import re
import textwrap
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import __version__
from cgid._lib.spelling import spelled
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.model.conformal import COVERAGES
from cgid.identification.model.families import BY_NAME, Contrast, Network, Standardiser
from cgid.identification.model.model import MIN_SHARE, Model, StoredModel, stored
from cgid.identification.model.model_file import FLOOR, STANDARDISER
from cgid.measure.features.extraction import FEATURES, base_of
from cgid.measure.features.vibration import EARLY_BANDS, EARLY_TIME, WINDOW_TIME
from cgid.measure.spectra import THIRD_OCTAVES, third_octave
from cgid.units import column_title

__all__ = ["c_source"]

#: Maximum number of numbers in an exported file: 8 MiB of constants in double precision.
MAX_NUMBERS = 1 << 20
#: Largest and smallest constants of a file that may be compiled with single precision.
_SINGLE = (1e-37, 1e37)
#: Rows of the self-test, in standard deviations from the mean of the training.
_TESTED = (-1.5, -0.75, 0.0, 0.75, 1.5)
_MAX_LINE_LENGTH = 116
#: Tables that stay double in single precision.
_ALWAYS_DOUBLE = ("cgid_coverages", "set_limits", "test_probabilities", "band_edges")


def c_source(model: Model) -> str:
    """Return a C99 file that predicts like the model.

    Parameters
    ----------
    model : Model

    Returns
    -------
    str
        ASCII text. The numbers are exact; `CGID_REAL` is `double`, or `float` if the compiler receives
        `-DCGID_REAL=float`.

    Raises
    ------
    InvalidValue
        The model has too many numbers for a controller.

    Examples
    --------
    >>> from cgid import load_model
    >>> print(c_source(load_model("default")).splitlines()[3])
     * For     pulses of force [N] at sampling rates of 24639 to 1.01428e+06 Hz
    """
    model = stored(model)
    require_small(model)
    arrays = _arrays(model)
    text = [_heading(model), "#ifndef CGID_MODEL_C\n#define CGID_MODEL_C\n", _sizes(model), _part("types")]
    text += [_interface(model), "#endif\n", "#ifndef CGID_HEADER\n"]
    text += [_part("arithmetic", single=_single(arrays)), _inner_sizes(model)]
    text += [_strings("cgid_labels", "CGID_N_LABELS", model.labels)]
    values = (*model.inputs, *model.guards)
    text += [_strings("cgid_values", "CGID_N_VALUES", values)]
    text += [_strings("cgid_columns", "CGID_N_VALUES", (column_title(name, unit) for name, unit, _ in _values(model)))]
    text += [_table(name, array) for name, array in arrays.items()]
    text += [_part("standardise"), *([_part("layer")] if _has_layers(model) else [])]
    text += [_part(f"scores of {model.family}"), _part("probabilities")]
    text += [*_contrast(model), _novelty(model), _answer(model)]
    text += [_part("main"), "#endif\n"]
    return "\n".join(text)


def require_small(model: StoredModel) -> None:
    """Raise `InvalidValue` if a model has too many numbers for an exported file."""
    if model.family not in BY_NAME:
        raise InvalidValue(
            f"family must be {', '.join(BY_NAME)} to be exported, got {model.family}; train one of these"
        )
    names = ("family.", "neighbourhood.", Contrast.PREFIX)
    n_numbers = sum(array.size for name, array in model.arrays.items() if name.startswith(names))
    if n_numbers > MAX_NUMBERS:
        raise InvalidValue(
            f"the model must have at most {MAX_NUMBERS} numbers to be exported, got {n_numbers} for "
            f"{len(model.inputs)} inputs; train one on fewer ({spelled('features')})"
        )


# -- parts of the file ------------------------------------------------------------------------------------


def _values(model: StoredModel) -> list[tuple[str, str, str]]:
    """Return name, unit and definition of each value of an impact."""
    values = []
    for name in (*model.inputs, *model.guards):
        feature = FEATURES[base_of(name)]
        values.append((name, feature.unit_for(model.unit), feature.definition))
    return values


def _heading(model: StoredModel) -> str:
    lines = [
        f"A model of cgid as one C99 file: written by cgid {__version__}, without dependencies and allocation.",
        "",
        f"Model   {model.family}, SHA-256 of the file {hashlib.sha256(model.to_bytes()).hexdigest()}",
        f"For     {model.kind}s of {model.quantity} [{model.unit}] at sampling rates of {model.rates_text}",
        f"Labels  {', '.join(f'{k}: {label}' for k, label in enumerate(model.labels))}",
        "",
        "Values of an impact, in this order; name [unit], definition:",
        *(f"  {k:3d}  {name} [{unit}], {definition}" for k, (name, unit, definition) in enumerate(_values(model))),
        "",
        *(line for line in [channels_text(model)] if line),
        *_missing(model),
        "",
        "    cgid_real values[CGID_N_VALUES] = {...};",
        "    cgid_answer answer;",
        "    if (cgid_identify(values, &answer) == CGID_KNOWN) { ... cgid_labels[answer.label] ... }",
        "",
        "cc -std=c99 -O2 -c FILE.c               link with -lm; -DCGID_REAL=float for single precision",
        "cc -std=c99 -O2 -DCGID_MAIN FILE.c -lm  a program that answers to the rows of a CSV",
        "Other files declare what is here by #define CGID_HEADER and #include of this file. Never use -ffast-math.",
    ]
    wrapped = [textwrap.wrap(line, _MAX_LINE_LENGTH - 3, subsequent_indent=" " * 8) or [""] for line in lines]
    return "/* " + "\n".join(f" * {line}".rstrip() for part in wrapped for line in map(_comment, part))[3:] + "\n */\n"


def channels_text(model: StoredModel) -> str:
    """Return how the channels of a model of several are combined; empty for a model of one."""
    if model.n_channels > 1:
        return (
            f"Channels 1 to {model.n_channels} of a recording give the values together, in the order of the training."
        )
    if not model.same_beam:
        return ""
    if model.beam is not None:
        return "Channels of one beam: the values are those of the pulse in which their pulses are fused."
    return (
        f"Channels of one beam ({', '.join(model.same_beam)}): each has values and an answer of its own; the "
        "probabilities of the impact are the mean of their log-odds, and its novelty that of their mean values."
    )


def _together(model: StoredModel) -> int:
    """Return how many channels of one beam the file answers for together, 0 for a model of one."""
    apart = model.n_channels > 1 or model.beam is not None
    return 0 if apart else max((len(beam.split("+")) for beam in model.same_beam), default=0)


def _missing(model: StoredModel) -> Iterable[str]:
    """Yield comments about what the file does not contain."""
    if _bands(model) is not None:
        yield "Not in this file: finding the impacts in a recording. cgid_measure measures a frame of one impact."
        return
    yield "Not in this file: finding the impacts in a recording, and measuring these values. `cgid features` measures"
    if model.beam is not None:
        yield "them, except those named beam_*: they need the beam of the model, and cgid itself."
    else:
        yield "them; what is fitted is fitted to the samples, not read off them."
    if model.kind == "window":
        yield "Nor the vote of successive windows: cgid adds the logarithms of their probabilities."


def _sizes(model: StoredModel) -> str:
    counts = {"LABELS": len(model.labels), "INPUTS": len(model.inputs), "VALUES": len(model.inputs + model.guards)}
    counts |= {"CHANNELS": n} if (n := _together(model)) else {}
    return "".join(f"#define CGID_N_{name} {number}\n" for name, number in counts.items())


def _interface(model: StoredModel) -> str:
    sets = _part("sets", n=len(COVERAGES)) if model.conformal is not None else ""
    sets += _part("together") if _together(model) else ""
    return _part("interface") + sets + (_part("measure") if _bands(model) is not None else "")


def _bands(model: StoredModel) -> dict[str, NDArray[Any]] | None:
    """Return the tables of the bands [Hz], if all values are levels of a vibration that C measures."""
    octaves = {name: third_octave(number) for number, name in enumerate(THIRD_OCTAVES)}
    levels = {"level_total": (0.0, 0.0)} | {f"level_{name}_hz": edges for name, edges in octaves.items()}
    relative = {f"relative_level_{name}_hz": edges for name, edges in octaves.items()}
    early = {f"early_level_{low}_{high}_hz": (low, high) for low, high in EARLY_BANDS}
    edges, names = levels | relative | early, model.measured
    if model.n_channels > 1 or not edges.keys() >= set(names):
        return None
    return {
        "band_edges": np.array([edges[name] for name in names], np.float64),
        "band_early": np.array([name in early for name in names]),
        "band_relative": np.array([name in relative for name in names]),
    }


def _inner_sizes(model: StoredModel) -> str:
    """Return the sizes that only the functions need."""
    arrays = model.arrays
    sizes: dict[str, float] = {
        "N_SCORES": 1 if len(model.labels) == 2 else len(model.labels),
        "N_WHITENINGS": len(arrays["neighbourhood.whitening"]),
        "N_TESTS": len(_TESTED),
    }
    if _bands(model) is not None:
        sizes |= {"WINDOW_TIME": WINDOW_TIME, "EARLY_TIME": EARLY_TIME, "PI": np.pi}
    if model.guards:
        sizes["N_GUARDS"] = len(model.guards)
    if model.family == "network":
        sizes |= {f"N_UNITS_{k}": len(arrays[f"family.biases_{k}"]) for k in (1, 2)}
    if model.contrast is not None:
        if isinstance(model.contrast.scorer, Network):
            sizes |= {f"N_CONTRAST_{k}": len(arrays[f"contrast.biases_{k}"]) for k in (1, 2)}
        sizes |= {"N_FEATURES": len(model.features), "N_CONTRASTED": len(model.measured)}
    return "\n".join(f"#define {name} {number}" for name, number in sizes.items()) + "\n"


def _arrays(model: StoredModel) -> dict[str, NDArray[Any]]:
    """Return all tables of the file by their names in C."""
    stored = model.arrays
    names = [STANDARDISER + name for name in Standardiser.NAMES]
    names += ["neighbourhood.centres", "neighbourhood.whitening"]
    names += [name for name in stored if name.startswith(("family.", "contrast.")) or name == FLOOR]
    arrays = {name.replace(".", "_"): stored[name] for name in names}
    for owner in ("standardiser", "contrast"):
        if f"{owner}_floor" in arrays:  # logarithms of smaller numbers would be those of 0 in single precision
            arrays[f"{owner}_floor"] = np.maximum(arrays[f"{owner}_floor"], 1e-300)
    scalars = {"temperature": model.temperature, "neighbourhood_limit": model.neighbourhood_limit}
    if model.contrast is not None:
        arrays.pop("contrast_limit")
        scalars |= {"contrast_limit": model.contrast.limit, "contrast_spread": model.contrast.SCALE}
    arrays |= {name: np.array(value) for name, value in scalars.items()}
    if model.guards:
        arrays["guard_limits"] = np.array(model.guard_limits)
    arrays |= _bands(model) or {}
    if _together(model):
        arrays["together_linear"] = np.array([FEATURES[name].linear for name in model.measured])
    if model.conformal is not None:
        arrays |= {"cgid_coverages": np.array(COVERAGES), "set_limits": _set_limits(model)}
    return arrays | _tests(model)


def _set_limits(model: StoredModel) -> Floats:
    """Return the largest score in a set for each coverage, (n_coverages,); 1, all labels, without a limit."""
    limits = []
    assert model.conformal is not None
    for coverage in COVERAGES:
        try:
            limits.append(model.conformal.threshold(coverage))
        except InvalidValue:
            limits.append(1.0)
    return np.array(limits)


def _tests(model: StoredModel) -> dict[str, Floats]:
    """Return rows and their probabilities for the self-test."""
    rows = np.array([Standardiser.from_arrays(model.arrays, STANDARDISER).at(row) for row in _TESTED])
    guards = np.broadcast_to(np.array(model.guard_limits) / 2, (len(rows), len(model.guards)))
    return {"test_values": np.hstack([rows, guards]), "test_probabilities": model.probabilities(rows)}


def _single(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the error of single precision for a model whose numbers exceed it."""
    small, large = _SINGLE
    numbers = [np.abs(array[array != 0]) for array in arrays.values() if array.dtype.kind == "f"]
    if all(((some > small) & (some < large)).all() for some in numbers):
        return ""
    return '#error "this model has numbers beyond single precision: leave CGID_REAL double"\n'


def _has_layers(model: StoredModel) -> bool:
    return model.family == "network" or model.contrast is not None


def _contrast(model: StoredModel) -> list[str]:
    if model.contrast is None:
        return []
    network = isinstance(model.contrast.scorer, Network)
    return [_part("contrast", score=_part("contrast by a network" if network else "contrast by a line"))]


def _novelty(model: StoredModel) -> str:
    more = (_part("guards") if model.guards else "") + (_part("strangers") if model.contrast is not None else "")
    return _part("novelty", more=more, unused="" if more else "    (void)values;\n")


def _answer(model: StoredModel) -> str:
    low, high = model.sampling_rates
    if model.beam is not None:
        low, high = MIN_SHARE * low, 1e300
    ones = ", ".join("1" for _ in model.labels)
    floored = FLOOR in model.arrays
    filled = {
        "above": "    cgid_real above[CGID_N_VALUES];  /* values from their floors on */\n" * floored,
        "floored": _part("floored") * floored,
    }
    text = _part("answer", **filled, ones=ones, lowest=repr(0.99 * low), highest=repr(1.01 * high))
    measuring = _part("body of measure") if _bands(model) is not None else ""
    text += _part("body of together") if _together(model) else ""
    return text + (_part("body of sets") if model.conformal is not None else "") + measuring


# -- C as text --------------------------------------------------------------------------------------------


def _part(name: str, **filled: object) -> str:
    """Return a part of `c99.c`, filled in."""
    return _parts()[name] % filled if filled else _parts()[name]


@cache
def _parts() -> dict[str, str]:
    text = (resources.files("cgid.export") / "c99.c").read_text(encoding="ascii")
    _, *parts = re.split(r"^//: (.+)\n", text, flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def _comment(text: str) -> str:
    """Return a line for a comment: ASCII, without anything that ends it or causes a warning of compilers."""
    plain = text.encode("ascii", "backslashreplace").decode()
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def _strings(name: str, size: str, texts: Iterable[str]) -> str:
    return f"const char *const {name}[{size}] = {{\n" + "".join(f"    {_quoted(text)},\n" for text in texts) + "};\n"


def _quoted(text: str) -> str:
    """Return a string of C: UTF-8, with octal escapes for all but plain signs."""
    plain = (chr(byte) if re.match(rb"[\w .-]", bytes([byte])) else f"\\{byte:03o}" for byte in text.encode())
    return f'"{"".join(plain)}"'


def _table(name: str, array: NDArray[Any]) -> str:
    """Return the definition of a table, or of one number."""
    kind = _type_of(name, array)
    public = name.startswith("cgid_")
    if not array.ndim:
        return f"static const {kind} {name} = {_number(array.item())};\n"
    text = ", ".join(map(_number, array.ravel().tolist()))
    lines = textwrap.fill(text, _MAX_LINE_LENGTH, initial_indent="    ", subsequent_indent="    ")
    return f"{'' if public else 'static '}const {kind} {name}[{array.size}] = {{\n{lines}\n}};\n"


def _type_of(name: str, array: NDArray[Any]) -> str:
    """Return the C type of a table; sets and tests stay double."""
    if array.dtype.kind == "b":
        return "unsigned char"
    return "double" if name in _ALWAYS_DOUBLE else "cgid_real"


def _number(value: float) -> str:
    return str(int(value)) if isinstance(value, bool | int) else repr(value)
