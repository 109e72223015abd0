"""Spheroidal vibrations of a free elastic sphere, from Lamb's theory: the reference for assembled matrices.

Lamb (1882), Proc. London Math. Soc. 13, 189; in modern notation Eringen & Suhubi, Elastodynamics, vol. 2 (1975),
sections 8.13 and 8.14. The displacement is `grad f + curl curl (r g)`, where r is the vector from the centre, with
`f = A j_n(x s) P_n(cos theta)` and `g = B j_n(y s) P_n(cos theta)`; s is the distance from the centre over R,
`x = omega R / c_L`, `y = omega R / c_T`. The surface is free of traction where the determinant of the two conditions
is zero. An axisymmetric mesh has each of these modes once, and no torsion.
"""

from __future__ import annotations

import mpmath
import numpy as np
from scipy.optimize import brentq
from scipy.special import spherical_jn

from cgid.physics import Sphere

#: Step of y in the search for roots, far smaller than their distance.
_STEP = 0.01


def wave_speeds(sphere: Sphere) -> tuple[float, float]:
    """Return the speeds of longitudinal and transverse waves [m/s]."""
    material = sphere.material
    modulus, nu, density = (float(x) for x in (material.youngs_modulus, material.poisson_ratio, material.density))
    shear = modulus / (2 * (1 + nu))
    return float(np.sqrt(2 * shear * (1 - nu) / (1 - 2 * nu) / density)), float(np.sqrt(shear / density))


def tractions(n, x, y, j):
    """Return the conditions of a free surface, [[rr of A, rr of B], [r theta of A, r theta of B]]; j is j(n, x)."""
    return [
        [(n * n - n - y * y / 2) * j(n, x) + 2 * x * j(n + 1, x), n * (n + 1) * ((n - 1) * j(n, y) - y * j(n + 1, y))],
        [(n - 1) * j(n, x) - x * j(n + 1, x), (n * n - 1 - y * y / 2) * j(n, y) + y * j(n + 1, y)],
    ]


def frequency_equation(n, y, ratio):
    """Return the value that is zero at a mode of order n; `ratio` is c_T / c_L."""
    (a, b), (c, d) = tractions(n, ratio * y, y, spherical_jn)
    return a if n == 0 else a * d - b * c


def roots(n: int, ratio: float, below: float) -> list[float]:
    """Return y of the modes of order n up to a limit, without the rigid motion y = 0."""
    places = np.arange(0.5, below + _STEP, _STEP)
    values = frequency_equation(n, places, ratio)
    found = [
        brentq(lambda y: float(frequency_equation(n, y, ratio)), places[k], places[k + 1], xtol=1e-12)
        for k in np.flatnonzero(values[:-1] * values[1:] < 0)
    ]
    return [root for root in found if root <= below]


def frequencies(sphere: Sphere, orders: int, below: float) -> list[tuple[float, int]]:
    """Return frequency [Hz] and order of all modes of orders 0 to `orders` up to y = `below`, ascending."""
    fast, slow = wave_speeds(sphere)
    scale = slow / (2 * np.pi * float(np.asarray(sphere.radius)))
    return sorted((y * scale, n) for n in range(orders + 1) for y in roots(n, slow / fast, below))


def spherical_bessel(n, x):
    """Return j_n(x) in mpmath's precision."""
    return mpmath.sqrt(mpmath.pi / (2 * x)) * mpmath.besselj(n + mpmath.mpf(1) / 2, x)


def displacement(n, x, y, a, b, place, angle):
    """Return (u_r, u_theta) of `grad f + curl curl (r g)` at a distance and an angle, R = 1, by mpmath."""
    legendre = mpmath.legendre(n, mpmath.cos(angle))
    slope = mpmath.diff(lambda t: mpmath.legendre(n, mpmath.cos(t)), angle)
    inner, shear = spherical_bessel(n, x * place), spherical_bessel(n, y * place)
    inner_slope = mpmath.diff(lambda s: spherical_bessel(n, x * s), place)
    shear_slope = mpmath.diff(lambda s: s * spherical_bessel(n, y * s), place)
    radial = (a * inner_slope + b * n * (n + 1) * shear / place) * legendre
    return radial, (a * inner + b * shear_slope) / place * slope
