"""The dimensionless damped-Hertz pulse, a one-parameter family: tables and their evaluation in numpy.

`x'' = -x^(3/2) (1 + D x')`, `x(0) = 0`, `x'(0) = 1`: every damped impact is this curve, stretched. The
parameter here is the restitution e (D and e are two names of one number, `cgid.impact.restitution`).

How a pulse is stored. The contact is cut at `tau_s`, between its largest displacement and its middle.
With `sigma = sqrt(tau / tau_s)` counted from touch, and `sigma = sqrt((tau_c - tau) / (tau_c - tau_s))`
counted back from separation, force / sigma^3 and displacement / sigma^2 are smooth and positive: each
is a polynomial on every one of the segments of sigma, and each coefficient of these, like the times, is
a Chebyshev series in ln e. `cgid.impact.tabulation` makes the table by quadrature to machine precision.
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
LOWEST_RESTITUTION, HIGHEST_RESTITUTION = 0.05, 1.0
#: The exponent of the cut between the two halves: near the largest displacement where e is large,
#: late enough for the long tail where e is small (0.6 balances the errors of both halves).
_CUT = 0.6


@dataclass(frozen=True)
class FamilyTable:
    """Chebyshev coefficients over ln e, lowest order first.

    Attributes
    ----------
    force, displacement : ndarray, (n_terms, 2, n_segments, n_powers)
        Local polynomials of both halves (from touch, from separation).
    times : ndarray, (n_time_terms, 3)
        Contact time, time of the peak force, time of the largest displacement.
    """

    force: Floats
    displacement: Floats
    times: Floats


@cache
def table() -> FamilyTable:
    """Return the table shipped with the package (read once, about a millisecond)."""
    with np.load(TABLE_PATH, allow_pickle=False) as stored:
        return FamilyTable(stored["force"], stored["displacement"], stored["times"])


def in_table(restitution: ArrayLike) -> NDArray[np.bool_]:
    """Return where the table serves this restitution."""
    e = np.asarray(restitution, dtype=np.float64)
    return np.asarray((e >= LOWEST_RESTITUTION) & (e <= HIGHEST_RESTITUTION))


def chebyshev_basis(restitution: ArrayLike, n_terms: int) -> Floats:
    """Return the Chebyshev polynomials of ln e, shape `(*restitution.shape, n_terms)`."""
    e = np.asarray(restitution, dtype=np.float64)
    lowest = np.log(LOWEST_RESTITUTION)
    angle = np.arccos(np.clip(1 - 2 * np.log(e) / lowest, -1, 1))
    return np.asarray(np.cos(angle[..., None] * np.arange(n_terms)))


def cut_time(contact_time: ArrayLike, compression_time: ArrayLike) -> Floats:
    """Return tau_s, where the first half of the table ends and the second begins."""
    return np.asarray(np.asarray(compression_time) ** (1 - _CUT) * (0.5 * np.asarray(contact_time)) ** _CUT)


def times(restitution: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return contact time, time of peak force and time of largest displacement.

    Parameters
    ----------
    restitution : array_like
        Within `LOWEST_RESTITUTION` and 1.

    Returns
    -------
    tuple of ndarray
        Dimensionless, in units of T0 = L / v, each of the shape of `restitution`.

    Examples
    --------
    >>> contact, peak, maximum = times(0.5)
    >>> round(float(contact), 9), round(float(peak), 9), round(float(maximum), 9)
    (3.603560584, 0.90537521, 1.383143902)
    """
    terms = table().times
    values = chebyshev_basis(restitution, len(terms)) @ terms
    return values[..., 0], values[..., 1], values[..., 2]


def force(tau: ArrayLike, restitution: ArrayLike) -> Floats:
    """Return the dimensionless force f(tau; e), zero outside contact.

    Parameters
    ----------
    tau : array_like, (..., n_times)
        Time since touch in units of T0.
    restitution : array_like, (...)
        One number for each row of `tau`.

    Returns
    -------
    ndarray, (..., n_times)
        In units of `K L^(3/2)`.
    """
    return _evaluate(table().force, 3, tau, restitution)


def displacement(tau: ArrayLike, restitution: ArrayLike) -> Floats:
    """Return the dimensionless displacement x(tau; e), zero outside contact; as `force`, in units of L."""
    return _evaluate(table().displacement, 2, tau, restitution)


def _evaluate(terms: Floats, power: int, tau: ArrayLike, restitution: ArrayLike) -> Floats:
    tau, e = np.asarray(tau, np.float64), np.asarray(restitution, np.float64)
    local = np.tensordot(chebyshev_basis(e, len(terms)), terms, axes=1)
    contact, _, compression = (value[..., None] for value in times(e))
    cut = cut_time(contact, compression)
    late = tau > cut
    inside = (tau > 0) & (tau < contact)
    fraction = np.where(late, (contact - tau) / (contact - cut), tau / cut)
    sigma = np.sqrt(np.where(inside, fraction, 0.0))
    n_segments = terms.shape[2]
    segment = np.minimum((sigma * n_segments).astype(np.intp), n_segments - 1)
    offset = 2 * (sigma * n_segments - segment) - 1
    rows = np.broadcast_to(local, (*np.broadcast_shapes(tau.shape[:-1], e.shape), *local.shape[-3:]))
    half = np.broadcast_to(late.astype(np.intp), segment.shape)
    leading = np.ogrid[tuple(slice(n) for n in segment.shape)][:-1]
    coefficients = rows[(*leading, half, segment)]
    value = coefficients[..., -1]
    for order in range(terms.shape[3] - 2, -1, -1):
        value = value * offset + coefficients[..., order]
    return np.asarray(np.where(inside, value * sigma**power, 0.0))
