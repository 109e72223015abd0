"""Restitution <-> damping against mpmath at 60 digits."""

import mpmath
import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.physics import damping_number, delivered_restitution

RESTITUTIONS = [
    1e-6, 1e-4, 1e-3, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.75, 0.82, 0.83, 0.9, 0.97, 0.99, 1 - 1e-6, 1 - 1e-12,
]  # fmt: skip


def exact_damping(e):
    """Solve (1 + e) D = ln[(1 + D) / (1 - e D)] in the logarithm of D's distance from its limit 1/e."""
    mpmath.mp.dps = 60
    e = mpmath.mpf(e)
    # D = 1/e - d: bracket d in its logarithm, the root D = 0 stays outside.
    low, high = mpmath.log(1 / e) - 2 / e - 50, mpmath.log(1 / e - mpmath.mpf("1.2") * (1 - e))

    def residual(log_distance):
        damping = 1 / e - mpmath.exp(log_distance)
        return (1 + e) * damping - mpmath.log1p(damping) + mpmath.log(e) + log_distance

    for _ in range(260):
        middle = (low + high) / 2
        if residual(middle) * residual(low) > 0:
            low = middle
        else:
            high = middle
    return 1 / e - mpmath.exp(low)


@pytest.mark.parametrize("e", RESTITUTIONS)
def test_damping_number_is_exact_to_the_last_digits(e):
    if e > 1 - 1e-9:
        # The bracket's own digits run out there: D = 3/2 (1-e) + 3/4 (1-e)^2 * ... from the series of the relation.
        expected = 3 * (1 - mpmath.mpf(e)) / 2
        assert float(damping_number(e) / expected) == pytest.approx(1, abs=1e-11)
        return
    assert float(damping_number(e) / exact_damping(e)) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("e", RESTITUTIONS)
def test_delivered_is_the_inverse(e):
    assert float(delivered_restitution(damping_number(e))) == pytest.approx(e, rel=6e-16)


@pytest.mark.parametrize("e", [0.0, -0.1, 1.2, np.nan])
def test_outside_is_refused_by_name_and_value(e):
    with pytest.raises(InvalidValue, match="restitution must"):
        damping_number(e)
