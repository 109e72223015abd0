"""The source of the step of DOP853, unrolled into scalars.

`python tests/references/make_step.py` writes `cgid/physics/contact/_step.py`; `tests/test_contact.py` compares the two.
"""

from __future__ import annotations

from pathlib import Path

from cgid.physics.contact._dop853 import DENSE, END, ERROR_3, ERROR_5, HISTORY, LAST, STAGES, TAU, W, Y

PATH = Path(__file__).parents[2] / "cgid" / "physics" / "contact" / "_step.py"


def weighted(weights: dict[int, float], name: str) -> str:
    """Return the source of a weighted sum of the stages of a variable."""
    return " + ".join(f"{weight!r} * {name}{stage}" for stage, weight in weights.items())


def stages(template: str, first: int, last: int) -> str:
    """Return the source of some stages: `{i}` in the template, and the sums `{w}`, `{y}` and `{t}` of those before."""
    rates = {"w": "dw", "y": "dy", "t": "w"}
    sums = [{name: weighted(STAGES[i], rate) for name, rate in rates.items()} for i in range(last)]
    return "".join(template.format(i=i, **sums[i]) for i in range(first, last))


def dense(variable: str, rate: str, change: str, column: int) -> str:
    """Return the source that stores the dense output of a variable in `row` from a column on."""
    terms = [variable, change, f"h * {rate}0 - ({change})", f"2.0 * ({change}) - h * ({rate}0 + {rate}{END})"]
    terms += [f"h * ({weighted(weights, rate)})" for weights in DENSE]
    return "".join(f"        row[{column + k}] = {term}\n" for k, term in enumerate(terms))


STAGE_SOURCE = """
    w{i} = w + h * ({w})
    y{i} = y + h * ({y})
    g, c = force(p, history, w{i})
    f = (g + c * y{i}) / (1.0 + inelasticity * c)
    u = y{i} - inelasticity * f
    dw{i} = 0.5 * u
    dy{i} = w{i} * (weight - f)
"""
INDENTED = STAGE_SOURCE.replace("\n    ", "\n        ")
SOURCE = f'''"""The step of DOP853 for a contact, unrolled into scalars: eight times as quick as arrays.

Written by `python tests/references/make_step.py`, which is to be edited instead.
"""
# fmt: off
# ruff: noqa: E501

from __future__ import annotations

import math
from typing import Any

from numba import float64, types
from numpy.typing import NDArray

from cgid._lib.compiled import FLOATS, LAW, ROWS, by_address

Array = NDArray[Any]


#: The type of a step.
STEP = types.FunctionType(
    types.UniTuple(float64, 8)(LAW[0], FLOATS, FLOATS, float64, float64, ROWS, *9 * [float64], FLOATS)
)


@by_address(STEP)
def step(
    force: Any, p: Array, history: Array, inelasticity: float, weight: float, cells: Array, h: float, w: float,
    y: float, tau: float, u: float, f: float, top: float, peak: float, tolerance: float, row: Array
) -> tuple[float, ...]:
    """Return the error over the permitted one, w, y, tau, x', g, c and f at the end; a good step fills its row.

    Steps on modes take space in `cells`.
    """
    w0, dw0, dy0 = w, 0.5 * u, w * (weight - f)
{stages(STAGE_SOURCE, 1, END + 1)}
    later = tau + h * ({weighted(STAGES[END], "w")})
    scale = max(top, abs(w{END}))
    size = 1.0 / (1.0 + c / max(peak, f)) if f > 0.0 or peak > 0.0 else 1.0
    ew5, ey5, et5 = {", ".join(f"({weighted(ERROR_5, name)})" for name in ("dw", "dy", "w"))}
    ew3, ey3, et3 = {", ".join(f"({weighted(ERROR_3, name)})" for name in ("dw", "dy", "w"))}
    ew5, ey5, et5, ew3, ey3, et3 = ew5 / scale, ey5 / size, et5 / later, ew3 / scale, ey3 / size, et3 / later
    e5, e3 = ew5 * ew5 + ey5 * ey5 + et5 * et5, ew3 * ew3 + ey3 * ey3 + et3 * et3
    error = h * e5 / math.sqrt(3.0 * (e5 + 0.01 * e3)) / tolerance if e5 > 0.0 else e5
    if error <= 1.0:
        at_end = u, g, c, f
{stages(INDENTED, END + 1, LAST)}
        row[0] = h
        for k in range(4):
            row[{HISTORY} + k] = history[k]
{dense("w", "dw", f"w{END} - w", W)}{dense("y", "dy", f"y{END} - y", Y)}{dense("tau", "w", "later - tau", TAU)}
        u, g, c, f = at_end
    return error, w{END}, y{END}, later, u, g, c, f
'''

if __name__ == "__main__":
    PATH.write_text(SOURCE, encoding="utf-8")
