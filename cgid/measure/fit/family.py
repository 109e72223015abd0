"""The dimensionless damped-Hertz pulse, a one-parameter family: tables and their evaluation in numpy.

`x'' = -x^(3/2) (1 + D x')`, `x(0) = 0`, `x'(0) = 1`: every damped impact is this curve, scaled. The parameter here is
the restitution e, which determines D (`cgid.physics.contact.closed_forms`).

The contact is cut at `tau_s`, between its largest displacement and its middle. With `sigma = sqrt(tau / tau_s)` from
onset, and `sigma = sqrt((tau_c - tau) / (tau_c - tau_s))` back from separation, force / sigma^3 and displacement /
sigma^2 are smooth and positive: piecewise polynomials of sigma, whose coefficients, like the times, are piecewise
polynomials of ln e. `tests/references/make_family.py` makes the table by quadrature to machine precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

TABLE_PATH = Path(__file__).with_name("family.npz")
#: The restitutions that the table covers.
MIN_RESTITUTION, MAX_RESTITUTION = 0.05, 1.0
#: Intervals of ln e, and coefficients of the polynomial on each.
INTERVALS, ORDERS = 16, 9
#: Segments of sigma in either half of a pulse, and coefficients of the polynomial on each (an even number).
SEGMENTS, POWERS = 4, 18
#: Columns after the coefficients of both halves: contact time and the time of the cut.
CONTACT, CUT = 2 * SEGMENTS * POWERS, 2 * SEGMENTS * POWERS + 1


@dataclass(frozen=True)
class FamilyTable:
    """Coefficients of polynomials in the position within an interval of ln e (-1 to 1), lowest order first."""

    # `force` and `displacement` (INTERVALS, ORDERS, CUT + 1): local polynomials from onset and from separation, segment
    # by segment, then contact time and time of the cut. `times` (INTERVALS, n_time_orders, 3): contact time, time of
    # the peak force, time of the largest displacement.

    force: Floats
    displacement: Floats
    times: Floats


@cache
def table() -> FamilyTable:
    """Return the table shipped with the package (read once, about a millisecond)."""
    with np.load(TABLE_PATH, allow_pickle=False) as stored:
        return FamilyTable(stored["force"], stored["displacement"], stored["times"])


def in_table(restitution: ArrayLike) -> NDArray[np.bool_]:
    """Return whether the table covers this restitution."""
    e = np.asarray(restitution, dtype=np.float64)
    return np.asarray((e >= MIN_RESTITUTION) & (e <= MAX_RESTITUTION))


def coordinate(restitution: ArrayLike) -> Floats:
    """Return the position of a restitution in the table: 0 at 1, `INTERVALS` at the lowest, evenly in ln e."""
    e = np.asarray(restitution, dtype=np.float64)
    return np.asarray(np.clip(np.log(e) * (INTERVALS / np.log(MIN_RESTITUTION)), 0, INTERVALS))


def times(restitution: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return contact time, time of peak force and time of largest displacement, in units of T0 = L / v."""
    values = _at(table().times, restitution)
    return values[..., 0], values[..., 1], values[..., 2]


def force(tau: ArrayLike, restitution: ArrayLike) -> Floats:
    """Return the dimensionless force f(tau; e) in units of `K L^(3/2)`, (..., n_times), zero outside contact."""
    return _evaluate(table().force, 3, tau, restitution)


def displacement(tau: ArrayLike, restitution: ArrayLike) -> Floats:
    """Return the dimensionless displacement x(tau; e), zero outside contact; as `force`, in units of L."""
    return _evaluate(table().displacement, 2, tau, restitution)


def _at(columns: Floats, restitution: ArrayLike) -> Floats:
    """Return the columns of a table at these restitutions, shape `(*restitution.shape, n_columns)`."""
    position = coordinate(restitution)
    interval = np.minimum(position.astype(np.intp), INTERVALS - 1)
    u = (2 * (position - interval) - 1)[..., None]
    value = columns[interval, -1]
    for order in range(columns.shape[1] - 2, -1, -1):
        value = value * u + columns[interval, order]
    return np.asarray(value)


def _evaluate(columns: Floats, power: int, tau: ArrayLike, restitution: ArrayLike) -> Floats:
    tau, rows = np.asarray(tau, np.float64), _at(columns, restitution)
    contact, cut = rows[..., CONTACT, None], rows[..., CUT, None]
    late = tau > cut
    inside = (tau > 0) & (tau < contact)
    fraction = np.where(late, (contact - tau) / (contact - cut), tau / cut)
    sigma = np.sqrt(np.where(inside, fraction, 0.0))
    segment = np.minimum((sigma * SEGMENTS).astype(np.intp), SEGMENTS - 1)
    u = 2 * (sigma * SEGMENTS - segment) - 1
    first = np.broadcast_to((late * SEGMENTS + segment) * POWERS, u.shape)
    rows = np.broadcast_to(rows, (*u.shape[:-1], rows.shape[-1]))
    value = np.take_along_axis(rows, first + POWERS - 1, axis=-1)
    for order in range(POWERS - 2, -1, -1):
        value = value * u + np.take_along_axis(rows, first + order, axis=-1)
    return np.asarray(np.where(inside, value * (sigma * sigma if power == 2 else sigma * sigma * sigma), 0.0))
