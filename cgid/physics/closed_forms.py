"""What a Hunt-Crossley impact needs no integration for: its peaks, from the damping number alone.

Everything is dimensionless: displacement in units of L, force in `K L^(3/2)`. Source: the first integral of
Hunt & Crossley (1975), `(2/5) x^(5/2) = G(1) - G(x')` with `G(u) = u/D - ln(1 + D u)/D^2`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cgid.elementary import exp, expm1, log1p, power
from cgid.physics.restitution import exponential_rest
from cgid.validation import Floats

_NEWTON_STEPS = 12


def energy_below(damping: ArrayLike) -> Floats:
    """Return `G(1) = 1/D - ln(1 + D)/D^2`, the energy stored at the largest displacement over `m v^2`.

    Parameters
    ----------
    damping : array_like
        D = chi v, zero or more.

    Returns
    -------
    ndarray
        1/2 for an elastic impact, `(2/5) x_max^(5/2)` for any.
    """
    damping = np.asarray(damping, dtype=np.float64)
    # D - ln(1 + D) = expm1(a) - a with a = ln(1 + D), which keeps its digits for small D.
    rest = exponential_rest(log1p(damping))
    return _over_square(rest, damping, 0.5)


def peak_displacement(damping: ArrayLike) -> Floats:
    """Return the largest displacement, `(5/2 G(1))^(2/5)`.

    Examples
    --------
    >>> round(float(peak_displacement(0.0)), 12)  # (5/4)^(2/5)
    1.093362073943
    """
    return power(2.5 * energy_below(damping), 0.4)


def peak_logarithm(damping: float | Floats) -> Floats:
    """Return p = `ln(1 + D x')` where the force peaks.

    It is the root of `(8/5) expm1(p) - p = expm1(a) - a` with `a = ln(1 + D)`.
    """
    a = log1p(np.asarray(damping, dtype=np.float64))
    energy = exponential_rest(a)
    p = np.where(a < 1, 5 / 6 * a * a, np.maximum(a - 0.47, 0.1))
    for _ in range(_NEWTON_STEPS):
        p = p - (1.6 * expm1(p) - p - energy) / (1.6 * exp(p) - 1)
    return np.maximum(p, 0.0)


def peak_force(damping: ArrayLike) -> Floats:
    """Return the largest force; it comes before the largest displacement when damped.

    Examples
    --------
    >>> round(float(peak_force(0.0)), 12)  # (5/4)^(3/5)
    1.143262629818
    """
    damping = np.asarray(damping, dtype=np.float64)
    p = peak_logarithm(damping)
    # (2/5) x^(5/2) = 3 x' / (5 D) at the peak, and x' / D = expm1(p) / D^2.
    ratio = _over_square(expm1(p), damping, 5 / 6)
    return np.asarray(power(1.5 * ratio, 0.6) * exp(p))


def _over_square(values: Floats, damping: Floats, limit: float) -> Floats:
    """Return values / D^2, its limit where D is so small that it is reached; neither square over- nor underflows."""
    safe = np.maximum(damping, 1e-150)
    return np.asarray(np.where(damping > 1e-150, values / safe / safe, limit))
