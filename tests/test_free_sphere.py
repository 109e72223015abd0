"""Lamb's theory as the tests use it: against published roots, and against elasticity itself by mpmath."""

import mpmath
import numpy as np
import pytest

from tests.free_sphere import displacement, roots, spherical_bessel, tractions

EQUAL = 3**-0.5  # c_T / c_L where both constants of Lame are equal, nu = 1/4


def test_roots_of_lamb():
    # Lamb (1882) and Love, Mathematical Theory of Elasticity, art. 194-196, for nu = 1/4: radial modes as x / pi.
    assert np.array(roots(0, EQUAL, 16)[:2]) * EQUAL / np.pi == pytest.approx([0.8160, 1.9285], abs=6e-5)
    assert roots(2, EQUAL, 4)[0] / np.pi == pytest.approx(0.840, abs=6e-4)
    # Sato & Usami (1962), Geophys. Mag. 31, 15, in y: the lowest of n = 1, 3, 4, and the second of n = 2.
    lowest = [roots(n, EQUAL, 6)[k] for n, k in ((1, 0), (3, 0), (4, 0), (2, 1))]
    assert lowest == pytest.approx([3.424, 3.916, 5.009, 4.865], abs=1e-3)


def stress(n, x, y, a, b, place, angle):
    """Return the stresses rr, r theta, theta theta, phi phi over the shear modulus, by derivatives."""

    def radial(s, t):
        return displacement(n, x, y, a, b, s, t)[0]

    def tangential(s, t):
        return displacement(n, x, y, a, b, s, t)[1]

    u, w = displacement(n, x, y, a, b, place, angle)
    along = mpmath.diff(radial, (place, angle), (1, 0))
    around = (mpmath.diff(tangential, (place, angle), (0, 1)) + u) / place
    turned = (u + w * mpmath.cot(angle)) / place
    first = ((y / x) ** 2 - 2) * (along + around + turned)  # lambda / mu is (c_L / c_T)^2 - 2
    shear = mpmath.diff(radial, (place, angle), (0, 1)) / place + mpmath.diff(tangential, (place, angle), (1, 0))
    return first + 2 * along, shear - w / place, first + 2 * around, first + 2 * turned


@pytest.mark.parametrize("n", [0, 1, 3])
def test_tractions_are_those_of_the_displacement(n):
    x, y, a, b, angle = 1.3, 2.9, 0.7, -0.4, 1.1
    expected = np.array(tractions(n, x, y, spherical_bessel), float) @ [a, b]
    with mpmath.workdps(40):
        radial, shear, _, _ = stress(n, x, y, a, b, mpmath.mpf(1), mpmath.mpf(angle))
        legendre = mpmath.legendre(n, mpmath.cos(angle))
        slope = mpmath.diff(lambda t: mpmath.legendre(n, mpmath.cos(t)), angle)
    assert float(radial) == pytest.approx(2 * expected[0] * float(legendre), rel=1e-8)
    assert float(shear) == pytest.approx(2 * expected[1] * float(slope), rel=1e-8, abs=1e-12)


def test_displacement_obeys_the_equation_of_motion():
    n, x, y, a, b, place, angle = 2, 1.3, 2.9, 0.7, -0.4, mpmath.mpf("0.6"), mpmath.mpf("1.1")
    with mpmath.workdps(60):
        rr, rt, tt, pp = stress(n, x, y, a, b, place, angle)
        slope = mpmath.diff(lambda s: stress(n, x, y, a, b, s, angle)[0], place, h=mpmath.mpf("1e-12"))
        turn = mpmath.diff(lambda t: stress(n, x, y, a, b, place, t)[1], angle, h=mpmath.mpf("1e-12"))
        force = slope + (turn + 2 * rr - tt - pp + rt * mpmath.cot(angle)) / place
        u, _ = displacement(n, x, y, a, b, place, angle)
    assert float(force) == pytest.approx(float(-(y**2) * u), rel=1e-6)
