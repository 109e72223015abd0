"""A claim of the paper, and how claims are judged: by code, none by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cgid.reproduction.paper import Ordering
from cgid.reproduction.quantities import SYMBOLS
from cgid.validation import Floats

#: Two values are "equal" if they differ by less than this part.
_EQUAL = 1e-9
#: An exponential's rate changes by less than this part along the curve.
_STEADY = 0.05


@dataclass(frozen=True)
class Claim:
    """One statement of the paper.

    Parameters
    ----------
    name : str
        Short and unique.
    place : str
        Where the paper says it.
    says : str
    found : str
        What was computed.
    holds : bool
        Whether both agree.
    """

    name: str
    place: str
    says: str
    found: str
    holds: bool


def judged_ordering(ordering: Ordering, sizes: Mapping[str, ArrayLike]) -> tuple[bool, str]:
    """Return whether sizes are ordered as said, and a text with the sizes and with every link that fails.

    `>>` is read as `>`: the paper does not say how much larger is "much larger".
    """
    size = {name: abs(float(np.asarray(sizes[name]))) for name in ordering.names}
    failing = []
    for first, relation, second in zip(ordering.names, ordering.relations, ordering.names[1:], strict=False):
        equal = abs(size[first] - size[second]) <= _EQUAL * max(size[first], size[second])
        if not (equal if relation == "=" else size[first] > size[second] and not equal):
            failing.append(f"{symbol(first)} {relation} {symbol(second)}")
    falling = sorted(size, key=lambda name: -size[name])
    text = ", ".join(f"{symbol(name)} {size[name]:.4g}" for name in falling)
    return not failing, text + (f" (not: {', '.join(failing)})" if failing else "")


def written(ordering: Ordering) -> str:
    """Return an ordering as the paper writes it."""
    words = [symbol(ordering.names[0])]
    for relation, name in zip(ordering.relations, ordering.names[1:], strict=True):
        words += [relation, symbol(name)]
    return " ".join(words)


def symbol(name: str) -> str:
    """Return the symbol of a parameter or a theory, or a sphere's number as the paper writes it."""
    return SYMBOLS.get(name, f"{name}#")


def powers(x: Floats, y: Floats) -> Floats:
    """Return the local power `d ln y / d ln x` between neighbouring points: a constant one makes a power law."""
    return np.asarray(np.diff(np.log(y)) / np.diff(np.log(x)))


def judged_exponential(x: Floats, y: Floats) -> tuple[bool, str]:
    """Return whether y is an exponential of x, that is `d ln y / dx` the same along the curve, and what was found."""
    rates, power = np.abs(np.diff(np.log(y)) / np.diff(x)), powers(x, y)
    factor = float(rates.max() / rates.min())
    text = (
        f"d ln y / dx, constant for an exponential, changes by a factor of {factor:.3g} along the curve; the local "
        f"power d ln y / d ln x, constant for a power law, goes from {power[0]:.4f} to {power[-1]:.4f}."
    )
    return factor < 1 + _STEADY, text


def trend(x: Floats, y: Floats) -> tuple[str, str]:
    """Return whether y "rises", "falls" or "neither", and whether its steepness "grows", "shrinks" or "neither"."""
    slopes = np.diff(y) / np.diff(x)
    steepness = np.diff(np.abs(slopes))
    course = "rises" if (slopes > 0).all() else "falls" if (slopes < 0).all() else "neither"
    change = "grows" if (steepness > 0).all() else "shrinks" if (steepness < 0).all() else "neither"
    return course, change
