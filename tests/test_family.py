"""The shipped table of pulses against a fresh quadrature and against mpmath's integration of the equation."""

import mpmath
import numpy as np
import pytest

from cgid.measure.fit import family
from cgid.physics import damping_number
from tests import few
from tests.references.make_family import reference_pulse, time_of_peak


@pytest.mark.parametrize(
    ("e", "error"),
    [(1.0, 2e-13), (0.999, 2e-13), (0.8, 2e-13), (0.5, 2e-13), (0.3, 2e-13), (0.2, 2e-13), (0.1, 2e-12), (0.07, 1e-11),
     (0.0552, 4e-11), (0.05, 4e-11)],
)  # fmt: skip
def test_table_agrees_with_quadrature(e, error):
    pulse = reference_pulse(e)
    tau = np.random.default_rng(7).uniform(0, pulse.contact_time, 400)
    displacement, force = pulse.evaluate(tau)
    assert np.abs(family.force(tau, e) - force).max() < error * force.max()
    assert np.abs(family.displacement(tau, e) - displacement).max() < error * displacement.max()
    assert np.array(family.times(e)) == pytest.approx(
        [pulse.contact_time, time_of_peak(e), pulse.compression_time], rel=2e-14
    )


def test_zero_outside_contact_and_never_attractive():
    e = np.linspace(0.05, 1, 200)
    contact = family.times(e)[0]
    tau = contact[:, None] * np.linspace(-0.5, 1.5, 801)
    force = family.force(tau, e)
    assert (force[:, :201] == 0).all()
    assert (force[:, 601:] == 0).all()
    assert (force[:, 201:600] > 0).all()


@pytest.mark.parametrize("e", few([0.5, 1.0, 0.1]))
def test_quadrature_agrees_with_a_taylor_integration_in_mpmath(e):
    """Independent of the first integral: mpmath's own ODE solver on the equation itself, started by its series."""
    mpmath.mp.dps = 25
    damping = mpmath.mpf(float(damping_number(e)))
    # x(s), s = sqrt(tau), and u = x'; the first step from x = tau - (1 + D) 4/35 tau^(7/2).
    start = mpmath.mpf("1e-3")
    state = [start - (1 + damping) * 4 / mpmath.mpf(35) * start ** mpmath.mpf("3.5"),
             1 - (1 + damping) * mpmath.mpf(2) / 5 * start ** mpmath.mpf("2.5")]  # fmt: skip
    solve = mpmath.odefun(
        lambda _t, y: [y[1], -(y[0] ** mpmath.mpf("1.5")) * (1 + damping * y[1])], start, state, tol=mpmath.mpf("1e-16")
    )
    times = [0.05, 0.3, 1.0]
    expected = np.array([float(solve(t)[0]) for t in times])
    found, _ = reference_pulse(e).evaluate(np.array(times))
    # The two-term start leaves an error of order tau^6 = 1e-18 times (1 + D)^2.
    assert found == pytest.approx(expected, rel=1e-12)
