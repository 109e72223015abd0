"""Closed forms of a Hunt-Crossley impact: restitution from damping, damping from restitution, and the peaks.

The contact `m x'' = -K x^(3/2) (1 + chi x')` at impact speed v depends on one damping number, D = chi v. Its first
integral (Hunt & Crossley 1975, J. Appl. Mech. 42, 440) relates D to the restitution e:
`(1 + e) D = ln[(1 + D) / (1 - e D)]`. With `kappa = (1 - e) / (1 + e)` and `D = 2 t / (1 + e)` this becomes

    coth(t) - 1/t = kappa,

so t is the inverse Langevin function of kappa. This form does not cancel as e -> 1 or underflow as e -> 0. The same
integral, `(2/5) x^(5/2) = G(1) - G(x')` with `G(u) = u/D - ln(1 + D u)/D^2`, gives the peaks, here in units of L and
`K L^(3/2)`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cgid._lib.validation import Floats, not_negative
from cgid._lib.validation import restitution as valid_restitution

_SMALL = 0.8  # above it, coth(t) - 1/t does not cancel
_N_TERMS = 14


def _langevin_series() -> Floats:
    """Return c_k of `coth(t) - 1/t = sum of c_k t^(2k - 1)`, from the equation `L' = 1 - L^2 - 2 L/t`."""
    terms = [1 / 3]
    for k in range(2, _N_TERMS + 1):
        terms.append(-sum(terms[i] * terms[-1 - i] for i in range(k - 1)) / (2 * k + 1))
    return np.array(terms)


_SERIES = _langevin_series()
_NEWTON_STEPS = 6  # the start value is within 5 %, and each step squares the error
_PEAK_NEWTON_STEPS = 12


def langevin(t: ArrayLike) -> tuple[Floats, Floats]:
    """Return the Langevin function `L(t) = coth(t) - 1/t` and `1 - L(t)` for t >= 0, both to full precision."""
    t = np.asarray(t, dtype=np.float64)
    small = t < _SMALL
    below = np.where(small, t, 0.0)
    series = below * np.polynomial.polynomial.polyval(below * below, _SERIES)
    large = np.where(small, 1.0, t)
    # Beyond 2t = 700 the exponential overflows; its term is negligible.
    complement = 1 / large - 2 / np.expm1(np.minimum(2 * large, 700.0))
    return np.where(small, series, 1 - complement), np.where(small, 1 - series, complement)


def inverse_langevin(kappa: ArrayLike, complement: ArrayLike) -> Floats:
    """Return t with `coth(t) - 1/t = kappa`; both kappa and `1 - kappa` must have full precision."""
    kappa, complement = np.broadcast_arrays(np.asarray(kappa, float), np.asarray(complement, float))
    # Jedynak (2015), Rheol. Acta 54, 29: within 1.5 % everywhere.
    t = kappa * (3 - 2.6 * kappa + 0.7 * kappa * kappa) / (complement * (1 + 0.1 * kappa))
    for _ in range(_NEWTON_STEPS):
        value, rest = langevin(t)
        # Near 0 the values keep full precision, near 1 the complements.
        error = np.where(kappa < 0.5, value - kappa, complement - rest)
        # Newton in ln t keeps t positive.
        step = np.divide(error, _logarithmic_slope(t), out=np.zeros_like(t), where=t > 0)
        t = t * np.exp(-np.clip(step, -1, 1))
    return np.asarray(t)


def _logarithmic_slope(t: Floats) -> Floats:
    """Return `t L'(t)`, without overflow for any t."""
    safe = np.where(t < 0.02, 1.0, np.minimum(t, 350.0))
    grown = np.expm1(safe)
    sinh = (grown + grown / (grown + 1)) / 2
    slope = 1 / safe - safe / (sinh * sinh)
    slope = np.where(t > 350.0, 1 / np.maximum(t, 1.0), slope)
    small = np.minimum(t, 0.02)
    return np.where(t < 0.02, small * (1 / 3 - small * small / 15), slope)


def damping_number(restitution: ArrayLike) -> Floats:
    """Return the damping number D = chi v for a restitution (rebound speed over impact speed).

    Parameters
    ----------
    restitution : array_like, in (0, 1]

    Returns
    -------
    ndarray, 0 for an elastic impact

    Raises
    ------
    InvalidValue
        The restitution is outside (0, 1].

    Examples
    --------
    >>> round(float(damping_number(0.5)), 10)
    1.4327505333
    """
    return damping_of(valid_restitution("restitution", restitution))


def damping_of(e: Floats) -> Floats:
    """Return the damping number for restitutions in (0, 1], without checks."""
    return 2 * inverse_langevin((1 - e) / (1 + e), 2 * e / (1 + e)) / (1 + e)


def delivered_restitution(damping: ArrayLike) -> Floats:
    """Return the restitution that a damping number D = chi v delivers, the inverse of `damping_number`.

    Parameters
    ----------
    damping : array_like, 0 or more

    Returns
    -------
    ndarray, in (0, 1]

    Raises
    ------
    InvalidValue
        A damping number is negative or not finite.
    """
    damping = np.minimum(not_negative("damping", damping), 1e300)
    # Newton on the monotone D = (1 + L(t)) t; the start value has both limits, t -> D at 0 and t -> (1 + D)/2.
    t = damping * ((1 + damping / 2) / (1 + damping))
    for _ in range(_NEWTON_STEPS):
        value, _complement = langevin(t)
        t = t - ((1 + value) * t - damping) / (1 + value + _logarithmic_slope(t))
        t = np.maximum(t, 0.0)
    value, complement = langevin(t)
    return complement / (1 + value)


def logarithms(damping: ArrayLike, restitution: ArrayLike) -> tuple[Floats, Floats]:
    """Return `ln(1 + D)` and `-ln(1 - e D)`, from their sum `(1 + e) D`, which avoids the underflow of `1 - e D`."""
    damping = np.asarray(damping, dtype=np.float64)
    start = np.log1p(damping)
    return start, (1 + np.asarray(restitution)) * damping - start


def exponential_rest(p: ArrayLike) -> Floats:
    """Return `expm1(p) - p` without cancellation near zero."""
    p = np.asarray(p, dtype=np.float64)
    small = np.abs(p) < 0.5
    x = np.where(small, p, 0.0)
    # x^2/2 (1 + x/3 (1 + x/4 (1 + ...)))
    series = np.ones_like(x)
    for order in range(18, 2, -1):
        series = 1 + x / order * series
    return np.asarray(np.where(small, x * x / 2 * series, np.expm1(p) - p), dtype=np.float64)


def energy_below(damping: ArrayLike) -> Floats:
    """Return the energy at the largest displacement over `m v^2`: `1/D - ln(1 + D)/D^2 = (2/5) x_max^(5/2)`."""
    damping = np.asarray(damping, dtype=np.float64)
    # D - ln(1 + D) = expm1(a) - a with a = ln(1 + D), accurate for small D.
    rest = exponential_rest(np.log1p(damping))
    return _over_square(rest, damping, 0.5)


def peak_displacement(damping: ArrayLike) -> Floats:
    """Return the largest displacement, `(5/2 G(1))^(2/5)`."""
    return np.power(2.5 * energy_below(damping), 0.4)


def peak_logarithm(damping: float | Floats) -> Floats:
    """Return p = `ln(1 + D x')` at the peak force: the root of `(8/5) expm1(p) - p = expm1(a) - a`, `a = ln(1 + D)`."""
    a = np.log1p(np.asarray(damping, dtype=np.float64))
    energy = exponential_rest(a)
    p = np.where(a < 1, 5 / 6 * a * a, np.maximum(a - 0.47, 0.1))
    for _ in range(_PEAK_NEWTON_STEPS):
        p = p - (1.6 * np.expm1(p) - p - energy) / (1.6 * np.exp(p) - 1)
    return np.maximum(p, 0.0)


def peak_force(damping: ArrayLike) -> Floats:
    """Return the largest force; with damping it precedes the largest displacement."""
    damping = np.asarray(damping, dtype=np.float64)
    p = peak_logarithm(damping)
    # (2/5) x^(5/2) = 3 x' / (5 D) at the peak, and x' / D = expm1(p) / D^2.
    ratio = _over_square(np.expm1(p), damping, 5 / 6)
    return np.asarray(np.power(1.5 * ratio, 0.6) * np.exp(p))


def _over_square(values: Floats, damping: Floats, limit: float) -> Floats:
    """Return values / D^2 without overflow or underflow of the square, and the limit for the smallest D."""
    safe = np.maximum(damping, 1e-150)
    return np.asarray(np.where(damping > 1e-150, values / safe / safe, limit))
