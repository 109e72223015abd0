"""Makes the table of the pulse family: `python -m cgid.physics.tabulation` writes `cgid/family.npz`.

Each entry comes from `cgid.physics.quadrature`, so it is right to about 1e-14; what is left is the error
of the interpolation. `tests/test_family.py` checks the shipped file against a fresh evaluation.
"""

from __future__ import annotations

import numpy as np

from cgid.family import INTERVALS, LOWEST_RESTITUTION, ORDERS, POWERS, SEGMENTS, TABLE_PATH, FamilyTable
from cgid.physics.quadrature import reference_pulse, time_of_peak
from cgid.validation import Floats

# Measured with the sizes of `cgid.family`: the force is within 3e-11 of the peak at e = .05, 1e-12 from .1 on,
# 1e-13 from .2 on.
N_TIME_ORDERS = 14  # the time of the peak force has a branch point just above e = 1 and converges slowly
#: The exponent of the cut between the two halves: near the largest displacement where e is large,
#: late enough for the long tail where e is small (0.6 balances the errors of both halves).
_CUT = 0.6


def tabulate() -> FamilyTable:
    """Return the table of the family, made from scratch (half a minute)."""
    pulses = [[_columns(e) for e in nodes] for nodes in _nodes(ORDERS)]
    return FamilyTable(
        force=_series([[force for force, _ in interval] for interval in pulses]),
        displacement=_series([[displacement for _, displacement in interval] for interval in pulses]),
        times=_series([[_times(e) for e in nodes] for nodes in _nodes(N_TIME_ORDERS)]),
    )


def _points(n: int) -> Floats:
    """Return the n Chebyshev points of (-1, 1)."""
    return np.cos(np.pi * (np.arange(n) + 0.5) / n)


def _nodes(n_orders: int) -> list[list[float]]:
    """Return the restitutions at the Chebyshev points of each interval of ln e."""
    places = np.arange(INTERVALS)[:, None] + 0.5 * (1 + _points(n_orders))
    return [[float(e) for e in row] for row in LOWEST_RESTITUTION ** (places / INTERVALS)]


def _powers(values: Floats) -> Floats:
    """Return the coefficients of the powers of the polynomial through values at the Chebyshev points (last axis).

    It goes through the Chebyshev series, whose terms fall off; the inverse of the Vandermonde matrix, or both
    steps in one matrix, would lose five digits.
    """
    n = values.shape[-1]
    to_terms = 2 / n * np.polynomial.chebyshev.chebvander(_points(n), n - 1)
    to_terms[:, 0] /= 2
    to_powers = np.zeros((n, n))
    for order, unit in enumerate(np.eye(n)):
        of_term = np.polynomial.chebyshev.cheb2poly(unit)
        to_powers[order, : of_term.size] = of_term
    return np.asarray((values @ to_terms) @ to_powers)


def _series(values: list[list[Floats]]) -> Floats:
    """Return polynomials (interval, order, column) through values (interval, point, column)."""
    return np.ascontiguousarray(np.swapaxes(_powers(np.swapaxes(np.array(values), 1, 2)), 1, 2))


def _times(e: float) -> Floats:
    pulse = reference_pulse(e)
    return np.array([pulse.contact_time, time_of_peak(e), pulse.compression_time])


def _columns(e: float) -> tuple[Floats, Floats]:
    """Return the columns of force and of displacement at one restitution."""
    pulse = reference_pulse(e)
    contact = pulse.contact_time
    cut = pulse.compression_time ** (1 - _CUT) * (0.5 * contact) ** _CUT
    sigma = (np.arange(SEGMENTS)[:, None] + 0.5 * (1 + _points(POWERS))) / SEGMENTS
    times = np.stack([cut * sigma**2, contact - (contact - cut) * sigma**2])
    displacement, force = pulse.evaluate(times)
    ends = [contact, cut]
    return np.append(_powers(force / sigma**3), ends), np.append(_powers(displacement / sigma**2), ends)


def main() -> None:
    """Write the table beside `cgid/family.py`."""
    made = tabulate()
    np.savez(TABLE_PATH, force=made.force, displacement=made.displacement, times=made.times)
    print(f"{TABLE_PATH.name}: {TABLE_PATH.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
