"""Checks of values; every message gives name, rule, value and unit."""

from __future__ import annotations

import math
import operator
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid.errors import InvalidValue, MissingOption

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
_T = TypeVar("_T")
#: Limits of sampling rates [Hz]: no recorder exceeds them, and beyond them squares of times leave the range of floats.
RATES = (1e-6, 1e12)
#: Largest relative difference of two sampling rates that are one: clocks of recorders differ by less, and a vibration
#: stated as this much faster gives the same answers (tests/test_inversion.py).
SAME_RATE = 1e-4
#: The same of two that a file states, often in few digits.
STATED_RATE = 1e-3

#: Prediction of models for out-of-distribution signals; not allowed as a label.
UNKNOWN = "unknown"
#: Longest label [characters].
MAX_LABEL_LENGTH = 100
#: Allowed in labels besides letters and digits of any script. Labels appear in file headers, options, tables and pages.
_LABEL_SIGNS = " _.-"


@dataclass(frozen=True)
class Rule:
    """A rule of single numbers, as data: finite and in an interval; called with a name, a value and its unit.

    >>> Rule(0, 1, without="ends")("damping_ratio", [0.1, 1.2])
    Traceback (most recent call last):
        ...
    cgid.errors.InvalidValue: damping_ratio must be between 0 and 1 (exclusive), got 1.2 at index 1
    """

    lowest: float = -math.inf
    highest: float = math.inf
    without: Literal["", "lowest", "highest", "ends"] = ""
    unit: str = ""
    note: str = ""

    def __call__(self, name: str, value: ArrayLike, unit: str = "") -> Floats:
        """Return the numbers, or raise `InvalidValue`."""
        unit = unit or self.unit
        try:
            given = plain(name, value)
            numbers = given.astype(np.float64) if given.dtype.kind in "fiu" else None
        except (TypeError, ValueError) as error:
            if isinstance(error, InvalidValue):
                raise
            numbers = None
        if numbers is None:
            raise InvalidValue(f"{name} must be a real number or an array of them, got {shown(value)}")
        finite = np.isfinite(numbers)
        if not finite.all():
            raise InvalidValue(f"{name} must be finite, got {_first(~finite, numbers, unit)}")
        inside = self.holds(numbers)
        if not inside.all():
            raise InvalidValue(f"{name} must {self.sentence(unit)}, got {_first(~inside, numbers, unit)}")
        return numbers

    @property
    def limited(self) -> bool:
        """Whether it requires more than finite numbers."""
        return self.lowest > -math.inf or self.highest < math.inf

    def holds(self, numbers: Floats) -> NDArray[np.bool_]:
        """Return which finite numbers meet the rule."""
        above = numbers > self.lowest if self.without in ("lowest", "ends") else numbers >= self.lowest
        below = numbers < self.highest if self.without in ("highest", "ends") else numbers <= self.highest
        return np.asarray(above & below)

    def sentence(self, unit: str = "") -> str:
        """Return the rule in words, to follow "must"."""
        unit = f" {unit}" if unit else ""
        low, high = (str(end) if isinstance(end, int) else f"{end:g}" for end in (self.lowest, self.highest))
        if self.highest == math.inf:
            text = f"be above {low}" if self.without == "lowest" else f"be {low} or more"
        elif self.without == "lowest":
            text = f"lie above {low} and up to {high}{unit}"
        elif self.without == "highest":
            text = f"lie from {low} and below {high}{unit}"
        else:
            text = f"be between {low} and {high}{unit}" + " (exclusive)" * (self.without == "ends")
        return text + self.note


real = Rule()
positive, not_negative = Rule(0, without="lowest"), Rule(0)
#: Sampling rates [Hz].
rates = Rule(*RATES, unit="Hz")
#: The range of stable isotropic solids.
poisson_ratio = Rule(-1, 0.5, without="ends")
#: Oscillations that decay.
damping_ratio = Rule(0, 1, without="ends", note=", so that a mode oscillates")
#: Fractions, and coefficients of restitution; at a restitution of 0 the damping would be infinite.
share = restitution = Rule(0, 1, without="lowest")


def between(name: str, value: ArrayLike, lowest: float, highest: float, unit: str = "") -> Floats:
    """Return `value` as float64 within [lowest, highest], or raise `InvalidValue`."""
    return Rule(lowest, highest)(name, value, unit)


def plain(name: str, value: Any) -> NDArray[Any]:
    """Return `value` as an array of any type; raise `InvalidValue` if numbers are masked."""
    if type(value) is np.ndarray:
        return value
    masked = 0 if type(value) in (float, int) else _masked(value)
    if masked:
        raise InvalidValue(
            f"{name} must have no masked numbers, got {masked} of {np.size(value)}; cut them out, or fill them (filled)"
        )
    try:
        return np.asarray(value)
    except (TypeError, ValueError):  # rows of different lengths
        raise InvalidValue(f"{name} must be a real number or an array of them, got {shown(value)}") from None


def _masked(value: Any) -> int:
    """Return the number of masked values in an array, or in lists of arrays."""
    ma = sys.modules.get("numpy.ma")  # NumPy loads it on first use: if not loaded, nothing is masked
    if ma is not None and isinstance(value, ma.MaskedArray):
        return int(np.count_nonzero(ma.getmaskarray(value)))
    if ma is not None and isinstance(value, list | tuple):
        return sum(_masked(part) for part in value if not isinstance(part, float | int))
    return 0


def _first(wrong: NDArray[np.bool_], numbers: Floats, unit: str) -> str:
    """Return the first wrong number with its unit, and its index in an array."""
    index = int(np.flatnonzero(wrong)[0])
    where = f" at index {index}" if numbers.size > 1 else ""
    return f"{numbers.ravel()[index]:g}{' ' + unit if unit else ''}{where}"


def number(name: str, value: ArrayLike, unit: str = "", rule: Callable[[str, ArrayLike, str], Floats] = real) -> float:
    """Return `value` as one float that meets a rule, such as `positive`; raise `InvalidValue` also for an array."""
    checked = rule(name, value, unit)
    if checked.ndim:
        raise InvalidValue(f"{name} must be one number, got an array of shape {checked.shape}; select one")
    return float(checked)


def require_rate(sampling_rate: float) -> float:
    """Return one sampling rate [Hz] within `RATES`, or raise `InvalidValue`."""
    return number("sampling_rate", sampling_rate, "Hz", rates)


def rates_agree(first: float, second: float, tolerance: float = SAME_RATE) -> bool:
    """Return whether two sampling rates [Hz] are one."""
    return abs(first - second) <= tolerance * min(first, second)


def given_rate(samples: Any, sampling_rate: float | None) -> float:
    """Return the sampling rate of an array; raises `MissingOption` without one, `InvalidValue` for another object.

    The times in the index of a Series or DataFrame, dates or seconds, must agree with it.
    """
    if isinstance(samples, str | Path) or hasattr(samples, "batches"):
        raise InvalidValue(
            f"samples must be an array, a Signal or a Batch, got {shown(samples)}; give one of cgid.read_recording, or "
            "of batches() of a dataset"
        )
    if sampling_rate is None:
        raise MissingOption("samples: an array has no sampling rate; give sampling_rate in Hz")
    index = getattr(samples, "index", None) if hasattr(samples, "iloc") else None  # of pandas
    if index is not None and (times := np.asarray(index)).dtype.kind in "fmM" and len(times) > 1:
        second = 1 if times.dtype.kind == "f" else np.timedelta64(1, "s")
        step = float((times[-1] - times[0]) / second) / (len(times) - 1)
        if not step > 0 or not rates_agree(1 / step, require_rate(sampling_rate), STATED_RATE):
            raise InvalidValue(
                f"sampling_rate must be that of the times in the index of samples, one each {step:.10g} s, got "
                f"{sampling_rate:.10g} Hz; correct one, or give samples.to_numpy()"
            )
    return sampling_rate


def ascending(name: str, values: Floats, unit: str = "") -> Floats:
    """Return numbers that do not decrease, or raise `InvalidValue`."""
    falling = np.flatnonzero(np.diff(values) < 0)
    if falling.size:
        at, unit = int(falling[0]), f" {unit}" if unit else ""
        raise InvalidValue(
            f"{name} must ascend, got {values[at + 1]:g}{unit} after {values[at]:g}{unit} at index {at + 1}; sort them"
        )
    return values


def broadcast(**values: Floats) -> tuple[Floats, ...]:
    """Return the named arrays broadcast against each other; error messages name their shapes."""
    try:
        return tuple(np.broadcast_arrays(*values.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {np.shape(value)}" for name, value in values.items())
        raise InvalidValue(f"these shapes do not broadcast against each other: {shapes}") from None


def choice(name: str, value: str, allowed: tuple[str, ...] | dict[str, Any]) -> str:
    """Return `value` if it is one of `allowed`, else raise `InvalidValue` with the allowed names."""
    if not isinstance(value, str) or value not in allowed:
        known = ", ".join(map(repr, allowed))
        raise InvalidValue(f"{name} must be one of {known}, got {shown(value)}{suggestion(value, allowed)}")
    return value


def suggestion(given: Any, names: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the known name most similar to an unknown one, or nothing.

    >>> suggestion("Gange", ["coal", "gangue"]), suggestion("steel", ["coal", "gangue"])
    ("; did you mean 'gangue'?", '')
    """
    matches = similar(given, names) if isinstance(given, str) else []
    return f"; did you mean {matches[0]!r}?" if matches else ""


def similar(given: str, names: Iterable[str], n: int = 1, cutoff: float = 0.7) -> list[str]:
    """Return up to `n` known names most similar to a given one, in upper or lower case; see `difflib`."""
    import difflib

    by_case = {name.lower(): name for name in names}
    return [by_case[name] for name in difflib.get_close_matches(given[:80].lower(), by_case, n, cutoff)]


def label(name: str, value: Any) -> str:
    """Return `value` if it is a valid label of a class, or raise `InvalidValue`."""
    letters = "".join(sign for sign in value if sign not in _LABEL_SIGNS) if isinstance(value, str) else ""
    # After its first letter, an identifier may contain letters, combining marks and digits.
    if not letters or len(value) > MAX_LABEL_LENGTH or value != value.strip() or not f"a{letters}".isidentifier():
        raise InvalidValue(
            f"{name} must be 1 to {MAX_LABEL_LENGTH} letters, digits, blanks, _, . or -, got {value!r}; rename it"
        )
    if value == UNKNOWN:
        raise InvalidValue(
            f"{name} must not be {UNKNOWN!r}, the prediction of models for out-of-distribution impacts; rename it"
        )
    return str(value)


def as_spelled(value: str, labels: Iterable[str]) -> str:
    """Return the label that is `value` but for case and blanks, else `value`.

    >>> as_spelled("Gangue ", ["coal", "gangue"]), as_spelled("steel", ["coal", "gangue"])
    ('gangue', 'steel')
    """
    labels = tuple(labels)
    alike = (label for label in labels if _without_case(label) == _without_case(value))
    return value if value in labels else next(alike, value)


def one_spelling(source: str, labels: Iterable[str]) -> dict[str, str]:
    """Return the spelling to use of each label that has several, with a `UserWarning` of them.

    Labels that differ only in case and blanks are one label, in its most frequent spelling, of equally frequent ones
    the first.

    >>> one_spelling("a.csv", ["coal", "gangue", "coal"])
    {}
    """
    alike: dict[str, Counter[str]] = {}
    for one, n in Counter(labels).items():
        alike.setdefault(_without_case(one), Counter())[one] = n
    used: dict[str, str] = {}
    for spellings in alike.values():
        if len(spellings) > 1:
            spelling = " ".join(spellings.most_common(1)[0][0].split())
            listed = ", ".join(f"{one!r} ({n})" for one, n in spellings.items())
            warnings.warn(
                f"{source}: labels {listed} differ only in case or blanks and are one label, {spelling!r}", stacklevel=3
            )
            used |= dict.fromkeys(spellings, spelling)
    return used


def _without_case(label: str) -> str:
    return " ".join(label.split()).casefold()


def count(name: str, value: Any) -> int:
    """Return `value` as an integer of 1 or more, or raise `InvalidValue`."""
    return whole(name, value, 1)


def whole(name: str, value: Any, lowest: int, highest: int | None = None) -> int:
    """Return `value` as an integer within [lowest, highest], or raise `InvalidValue`."""
    try:
        number = operator.index(value)
    except TypeError:
        number = lowest - 1
    masked = type(value) is not int and _masked(value)
    if masked or number < lowest or (highest is not None and number > highest):
        limits = f"of {lowest} or more" if highest is None else f"between {lowest} and {highest}"
        raise InvalidValue(f"{name} must be a whole number {limits}, got {shown(value)}")
    return number


def hold(owner: Any, *names: str) -> None:
    """Replace arrays of a frozen dataclass by read-only copies, so that values derived from them stay valid."""
    for name in names:
        value = getattr(owner, name)
        if np.ndim(value):
            array = np.array(value)
            array.setflags(write=False)
            object.__setattr__(owner, name, array)


def unchecked(kind: type[_T], **fields: Any) -> _T:
    """Return a frozen dataclass of valid numbers without its checks and copies."""
    made = object.__new__(kind)
    vars(made).update(fields)
    return made


def instance(name: str, value: Any, *types: type) -> None:
    """Raise `InvalidValue` unless `value` is an instance of one of the types."""
    if not isinstance(value, types):
        names = " or ".join(allowed.__name__ for allowed in types)
        article = "an" if names[0] in "AEIOU" else "a"
        raise InvalidValue(f"{name} must be {article} {names}, got {shown(value)}")


def shown(value: Any) -> str:
    """Return a value as text for a message: on one line, cut if long."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"
    return cut(" ".join(repr(value).split()))


def cut(text: str) -> str:
    """Return a text for a message, cut after 80 characters."""
    return text if len(text) <= 80 else text[:80] + "..."


def finite(value: Any) -> Any:
    """Return a value for JSON, with null for every number in it that is not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
