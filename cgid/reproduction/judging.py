"""The judgement of a claim: its record, and verdicts on orderings, curves and surfaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from cgid.reproduction.drawing import SYMBOLS
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.paper import Ordering
from cgid.reproduction.study import Study
from cgid.validation import Floats

#: The judged responses of an impact, with their names in the texts.
RESPONSES = {"peak_displacement": "DCS", "peak_force": "force"}
#: Largest relative difference of two "equal" values.
_EQUAL = 1e-9
#: Largest relative change of the rate along an "exponential" curve.
_STEADY = 0.05


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and its verdict.

    place : section or figure of the paper
    says : the claim
    found : the computed result
    holds : whether they agree
    """

    name: str
    place: str
    says: str
    found: str
    holds: bool


Verdict = tuple[bool, str]
Judge = Callable[..., Verdict]


class Claims:
    """The claims of the paper in its order, each with the function that judges it.

    A judge receives the finite-element study and returns the verdict and the computed result as text.
    """

    def __init__(self) -> None:
        self._claims: list[tuple[str, str, str, Judge]] = []

    def add(self, place: str, says: str, name: str = "", **arguments: object) -> Callable[[Judge], Judge]:
        """Return a decorator that registers a function as the judge of a claim.

        The judge is called with `arguments`. The default name of the claim is that of the function.
        """

        def register(judge: Judge) -> Judge:
            named = name or judge.__name__.replace("_", " ").strip()
            self._claims.append((named, place, says, partial(judge, **arguments)))
            return judge

        return register

    def judged(self, study: Study) -> list[Claim]:
        """Return every claim with its verdict."""
        verdicts = ((name, place, says, *judge(study)) for name, place, says, judge in self._claims)
        return [Claim(name, place, says, found, bool(holds)) for name, place, says, holds, found in verdicts]


def symbol(name: str) -> str:
    """Return the symbol of a parameter or theory, or the number of a sphere in the paper's notation."""
    return SYMBOLS.get(name, f"{name}#")


def written(ordering: Ordering) -> str:
    """Return an ordering in the paper's notation."""
    links = (
        f" {relation} {symbol(name)}" for relation, name in zip(ordering.relations, ordering.names[1:], strict=True)
    )
    return symbol(ordering.names[0]) + "".join(links)


def judged_ordering(ordering: Ordering, sizes: Mapping[str, ArrayLike]) -> Verdict:
    """Return whether the sizes have this ordering, and a text with the sizes and every relation that fails.

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


def combined(judged: Mapping[str, Verdict]) -> Verdict:
    """Return whether all verdicts hold, and their texts by name."""
    text = "; ".join(f"{name}: {text}" if name else text for name, (_, text) in judged.items())
    return all(holds for holds, _ in judged.values()), text


def powers(x: Floats, y: Floats) -> Floats:
    """Return the local exponents `d ln y / d ln x` between neighbouring points; constant for a power law."""
    return np.asarray(np.diff(np.log(y)) / np.diff(np.log(x)))


def judged_exponential(x: Floats, y: Floats) -> Verdict:
    """Return whether y is an exponential of x, that is, whether `d ln y / dx` is constant, and the result as text."""
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
    return _sign(slopes, "rises", "falls", "neither"), _sign(np.diff(np.abs(slopes)), "grows", "shrinks", "neither")


def _sign(values: Floats, positive: str, negative: str, neither: str) -> str:
    return positive if (values > 0).all() else negative if (values < 0).all() else neither


def columns(figure: str, *names: str, varied: str = "") -> list[Floats]:
    """Return columns of a figure's data; only the rows of the parameters `varied`, if given."""
    data = FIGURES[figure]().data
    rows = data[data["varied"] == varied] if varied else data
    return [rows[name].to_numpy() for name in names]


def response_surface(figure: str, first: str, second: str, response: str) -> Floats:
    """Return a response over the grid of two parameters, (n_first, n_second)."""
    x, _, z = columns(figure, first, second, response, varied=f"{first} and {second}")
    return np.asarray(z.reshape(np.unique(x).size, -1))


def course_of(surface: Floats) -> str:
    """Return how a surface changes along both axes."""
    slopes = np.concatenate([np.diff(surface, axis=axis).ravel() for axis in (0, 1)])
    return _sign(slopes, "rises", "falls", "neither rises nor falls")
