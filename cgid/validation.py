"""Checks of numbers, one message style: name, rule, value, unit."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid.errors import InvalidValue

Floats = NDArray[np.float64]

#: What models answer strangers with: nothing that can be taught is called so.
UNKNOWN = "unknown"
#: No label has more characters,
LONGEST_LABEL = 100
#: and these beside letters and digits of any script: labels stand in file headers, options, tables and pages.
_LABEL_SIGNS = " _.-"


def real(name: str, value: ArrayLike, unit: str = "") -> Floats:
    """Return `value` as finite float64 numbers, or raise.

    Parameters
    ----------
    name : str
        What the number is called in the message.
    value : array_like
        A real scalar or array of any shape.
    unit : str, optional
        Shown behind the offending value.

    Returns
    -------
    ndarray
        float64, of the shape of `value`.

    Raises
    ------
    InvalidValue
        If a value is no real number, nan or infinite.
    """
    try:
        given: NDArray[Any] = np.asarray(value)
        numbers = given.astype(np.float64) if given.dtype.kind in "fiu" else None
    except (TypeError, ValueError):
        numbers = None
    if numbers is None:
        raise InvalidValue(f"{name} must be a real number or an array of them, got {value!r}")
    _require(np.isfinite(numbers), name, "must be finite", numbers, unit)
    return numbers


def positive(name: str, value: ArrayLike, unit: str = "") -> Floats:
    """Return `value` as finite float64 numbers above zero, or raise `InvalidValue`."""
    numbers = real(name, value, unit)
    _require(numbers > 0, name, "must be above 0", numbers, unit)
    return numbers


def not_negative(name: str, value: ArrayLike, unit: str = "") -> Floats:
    """Return `value` as finite float64 numbers of zero or more, or raise `InvalidValue`."""
    numbers = real(name, value, unit)
    _require(numbers >= 0, name, "must be 0 or more", numbers, unit)
    return numbers


def poisson_ratio(name: str, value: ArrayLike) -> Floats:
    """Return Poisson's ratio as float64 within (-1, 0.5), the range of a stable isotropic solid."""
    numbers = real(name, value)
    _require((numbers > -1) & (numbers < 0.5), name, "must lie between -1 and 0.5 (exclusive)", numbers)
    return numbers


def restitution(name: str, value: ArrayLike) -> Floats:
    """Return a coefficient of restitution as float64 within (0, 1]; at 0 the damping would be infinite."""
    numbers = real(name, value)
    _require((numbers > 0) & (numbers <= 1), name, "must lie above 0 and up to 1", numbers)
    return numbers


def broadcast(**values: Floats) -> tuple[Floats, ...]:
    """Return the named arrays broadcast against each other; the message of a failure names their shapes."""
    try:
        return tuple(np.broadcast_arrays(*values.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {np.shape(value)}" for name, value in values.items())
        raise InvalidValue(f"these shapes do not broadcast against each other: {shapes}") from None


def choice(name: str, value: str, allowed: tuple[str, ...] | dict[str, Any]) -> str:
    """Return `value` if it is one of `allowed`; else raise with the list of names."""
    if not isinstance(value, str) or value not in allowed:
        raise InvalidValue(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")
    return value


def label(name: str, value: Any) -> str:
    """Return `value` as the name of a kind of bodies, or raise `InvalidValue`; the one rule for labels.

    Examples
    --------
    >>> label("label", "coal, wet")
    Traceback (most recent call last):
        ...
    cgid.errors.InvalidValue: label must be 1 to 100 letters, digits, blanks, _, . or -, got 'coal, wet'; rename it
    """
    letters = "".join(sign for sign in value if sign not in _LABEL_SIGNS) if isinstance(value, str) else ""
    # Behind a letter, what may stand in an identifier is a letter, a mark upon one, or a digit.
    if not letters or len(value) > LONGEST_LABEL or value != value.strip() or not f"a{letters}".isidentifier():
        raise InvalidValue(
            f"{name} must be 1 to {LONGEST_LABEL} letters, digits, blanks, _, . or -, got {value!r}; rename it"
        )
    if value == UNKNOWN:
        raise InvalidValue(f"{name} must not be {UNKNOWN!r}, which is what models answer strangers with; rename it")
    return str(value)


def count(name: str, value: Any) -> int:
    """Return `value` as a whole number of 1 or more, or raise `InvalidValue`."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1:
        raise InvalidValue(f"{name} must be a whole number of 1 or more, got {value!r}")
    return number


def hold(owner: Any, *names: str) -> None:
    """Give a frozen dataclass copies of its arrays that nobody can write to: what follows from them is kept."""
    for name in names:
        value = getattr(owner, name)
        if np.ndim(value):
            held = np.array(value)
            held.setflags(write=False)
            object.__setattr__(owner, name, held)


def instance(name: str, value: Any, *types: type) -> None:
    """Raise `InvalidValue` unless `value` is an object of one of the types."""
    if not isinstance(value, types):
        names = " or ".join(allowed.__name__ for allowed in types)
        article = "an" if names[0] in "AEIOU" else "a"
        raise InvalidValue(f"{name} must be {article} {names}, got {value!r}")


def _require(holds: NDArray[np.bool_] | bool, name: str, rule: str, values: Floats, unit: str = "") -> None:
    if np.all(holds):
        return
    where = np.flatnonzero(~np.atleast_1d(holds))
    value = np.atleast_1d(values).ravel()[where[0]]
    place = f" at index {where[0]}" if values.size > 1 else ""
    raise InvalidValue(f"{name} {rule}, got {value:g}{' ' + unit if unit else ''}{place}")
