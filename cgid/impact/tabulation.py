"""Makes the table of the pulse family: `python -m cgid.impact.tabulation` writes `cgid/family.npz`.

Each entry comes from `cgid.impact.quadrature`, so it is right to about 1e-14; what is left is the error
of the interpolation. `tests/test_family.py` checks the shipped file against a fresh evaluation.
"""

from __future__ import annotations

import numpy as np

from cgid.family import HIGHEST_RESTITUTION, LOWEST_RESTITUTION, TABLE_PATH, FamilyTable, cut_time
from cgid.impact.quadrature import reference_pulse, time_of_peak
from cgid.validation import Floats

# Measured with these: the force is within 2e-11 of the peak at e = 0.05 and 1e-12 above e = 0.1.
N_TERMS, N_SEGMENTS, N_POWERS = 30, 12, 10
N_TIME_TERMS = 64  # the time of the peak force has a branch point near e = 1 and converges slowly


def tabulate() -> FamilyTable:
    """Return the table of the family, made from scratch (a few seconds)."""
    pulses = [_polynomials(e) for e in _nodes(N_TERMS)]
    return FamilyTable(
        force=_series(np.stack([force for force, _ in pulses])),
        displacement=_series(np.stack([displacement for _, displacement in pulses])),
        times=_series(np.stack([_times(e) for e in _nodes(N_TIME_TERMS)])),
    )


def _nodes(n_terms: int) -> list[float]:
    """Return the restitutions whose logarithms are the Chebyshev nodes of the table's range."""
    cosines = np.cos(np.pi * (np.arange(n_terms) + 0.5) / n_terms)
    lowest, highest = np.log(LOWEST_RESTITUTION), np.log(HIGHEST_RESTITUTION)
    return [float(e) for e in np.exp(lowest + (highest - lowest) * (1 + cosines) / 2)]


def _series(values: Floats) -> Floats:
    """Return the Chebyshev coefficients of values given at the nodes (first axis)."""
    n_terms = len(values)
    angles = np.pi * (np.arange(n_terms) + 0.5) / n_terms
    to_terms = 2 / n_terms * np.cos(np.outer(np.arange(n_terms), angles))
    to_terms[0] /= 2
    return np.ascontiguousarray(np.tensordot(to_terms, values, axes=1))


def _times(e: float) -> Floats:
    pulse = reference_pulse(e)
    return np.array([pulse.contact_time, time_of_peak(e), pulse.compression_time])


def _polynomials(e: float) -> tuple[Floats, Floats]:
    """Return the local polynomials of force / sigma^3 and displacement / sigma^2 at one restitution."""
    pulse = reference_pulse(e)
    contact = pulse.contact_time
    cut = float(cut_time(contact, pulse.compression_time))
    points = np.cos(np.pi * (np.arange(N_POWERS) + 0.5) / N_POWERS)
    sigma = (np.arange(N_SEGMENTS)[:, None] + 0.5 * (1 + points)) / N_SEGMENTS
    times = np.stack([cut * sigma**2, contact - (contact - cut) * sigma**2])
    displacement, force = pulse.evaluate(times)
    to_powers = np.linalg.inv(np.vander(points, increasing=True))
    return force / sigma**3 @ to_powers.T, displacement / sigma**2 @ to_powers.T


def main() -> None:
    """Write the table beside `cgid/family.py`."""
    made = tabulate()
    np.savez(TABLE_PATH, force=made.force, displacement=made.displacement, times=made.times)
    print(f"{TABLE_PATH.name}: {TABLE_PATH.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
