"""Elementary functions: against mpmath over their whole range, and the same bits however they are evaluated."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable

import mpmath
import numpy as np
import pytest

from cgid import _elementary, elementary

SEED = 7
CASES: dict[str, Callable[[np.random.Generator, int], tuple[np.ndarray, ...]]] = {
    "exp": lambda rng, n: (np.concatenate([rng.uniform(-745.2, 709.7, n), _both_signs(rng, n, -20, 0)]),),
    "expm1": lambda rng, n: (
        np.concatenate([rng.uniform(-2, 2, n), rng.uniform(-50, 709.7, n), _both_signs(rng, n, -307, 0)]),
    ),
    "log": lambda rng, n: (np.concatenate([10 ** rng.uniform(-323, 308, n), 1 + _both_signs(rng, n, -16, -0.4)]),),
    "log1p": lambda rng, n: (
        np.concatenate([10 ** rng.uniform(-307, 308, n), -(10 ** rng.uniform(-307, -1e-12, n)), rng.uniform(-1, 3, n)]),
    ),
    "power": lambda rng, n: (
        np.concatenate([10 ** rng.uniform(-100, 100, n), rng.uniform(0, 3, n), 1 + _both_signs(rng, n, -12, -1)]),
        np.concatenate([rng.uniform(-3, 3, n), rng.uniform(-500, 500, n), rng.uniform(-1e3, 1e3, n)]),
    ),
    "sin": lambda rng, n: (np.concatenate([rng.uniform(-7, 7, n), _both_signs(rng, n, -20, 12), _multiples(rng, n)]),),
    "cos": lambda rng, n: (np.concatenate([rng.uniform(-7, 7, n), _both_signs(rng, n, -20, 12), _multiples(rng, n)]),),
}
EXACT = dict.fromkeys(("exp", "expm1", "log", "log1p", "power", "sin", "cos")) | {
    "exp": mpmath.exp,
    "expm1": mpmath.expm1,
    "log": mpmath.log,
    "log1p": mpmath.log1p,
    "power": mpmath.power,
    "sin": mpmath.sin,
    "cos": mpmath.cos,
}


def _both_signs(rng: np.random.Generator, n: int, low: float, high: float) -> np.ndarray:
    return 10 ** rng.uniform(low, high, n) * rng.choice([-1, 1], n)


def _multiples(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return doubles next to multiples of pi/2, where nearly all digits cancel."""
    return np.rint(10 ** rng.uniform(0, 12, n)) * (np.pi / 2)


def units_off(value: np.ndarray, name: str, arguments: tuple[np.ndarray, ...]) -> float:
    """Return the largest error in units in the last place of the exact value."""
    worst = 0.0
    with mpmath.workprec(1200 if name in ("sin", "cos", "expm1", "log1p", "power") else 200):
        for got, *given in zip(value.tolist(), *(a.tolist() for a in arguments), strict=True):
            exact = EXACT[name](*given)
            if abs(exact) < 2.3e-308 or abs(exact) > 1.7e308:
                continue
            worst = max(worst, float(abs(mpmath.mpf(got) - exact) / math.ulp(float(exact))))
    return worst


@pytest.mark.parametrize("name", CASES)
def test_errors_stay_below_one_unit_in_the_last_place(name: str) -> None:
    arguments = CASES[name](np.random.default_rng(SEED), 700)
    assert units_off(getattr(elementary, name)(*arguments), name, arguments) < 0.9


@pytest.mark.parametrize("name", CASES)
def test_scalars_arrays_and_numpy_give_the_same_bits(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = CASES[name](np.random.default_rng(SEED + 1), 2000)
    compiled = getattr(elementary, name)(*arguments)
    monkeypatch.setattr(elementary, "_loop", lambda _: None)
    np.testing.assert_array_equal(compiled, getattr(elementary, name)(*arguments))
    if hasattr(_elementary, name):
        scalar = getattr(_elementary, name)
        assert [float(scalar(*(float(a[k]) for a in arguments))) for k in range(50)] == compiled[:50].tolist()


@pytest.mark.parametrize(
    ("name", "arguments", "value"),
    [
        ("exp", (np.inf,), np.inf),
        ("exp", (-np.inf,), 0.0),
        ("exp", (710.0,), np.inf),
        ("exp", (-745.13,), 5e-324),
        ("exp", (-746.0,), 0.0),
        ("expm1", (-1e9,), -1.0),
        ("expm1", (1e-320,), 1e-320),
        ("expm1", (1e9,), np.inf),
        ("log", (0.0,), -np.inf),
        ("log", (np.inf,), np.inf),
        ("log", (5e-324,), -744.4400719213812),
        ("log1p", (-1.0,), -np.inf),
        ("log1p", (1e-300,), 1e-300),
        ("power", (0.0, 0.4), 0.0),
        ("power", (0.0, -0.4), np.inf),
        ("power", (0.0, 0.0), 1.0),
        ("power", (np.inf, 0.4), np.inf),
        ("power", (np.inf, -0.4), 0.0),
        ("power", (1.0, 1e300), 1.0),
        ("power", (2.0, 1e300), np.inf),
        ("power", (2.0, -1074.0), 5e-324),
        ("sin", (0.0,), 0.0),
        ("cos", (0.0,), 1.0),
    ],
)  # fmt: skip
def test_ends_of_the_range(name: str, arguments: tuple[float, ...], value: float) -> None:
    assert float(getattr(elementary, name)(*arguments)) == value


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("exp", (np.nan,)),
        ("expm1", (np.nan,)),
        ("log", (-1.0,)),
        ("log", (np.nan,)),
        ("log1p", (-1.1,)),
        ("power", (-1.0, 2.0)),
        ("power", (np.nan, 2.0)),
        ("power", (2.0, np.nan)),
        ("sin", (2e12,)),
        ("cos", (np.inf,)),
    ],
)
def test_what_has_no_value_is_not_a_number(name: str, arguments: tuple[float, ...]) -> None:
    assert np.isnan(getattr(elementary, name)(*arguments))


def test_numpy_evaluates_them_without_numba() -> None:
    code = "import sys, cgid.elementary as e; e.exp([1.0]); e.power(2.0, 0.3); assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_complex_numbers() -> None:
    rng = np.random.default_rng(SEED)
    a, b = (rng.normal(size=50) + 1j * rng.normal(size=50) for _ in range(2))
    np.testing.assert_allclose(elementary.complex_exp(a), np.exp(a), rtol=1e-15)
    np.testing.assert_allclose(elementary.complex_product(a, b), a * b, rtol=1e-14)
    np.testing.assert_allclose(elementary.modulus(a), np.abs(a), rtol=1e-15)


def test_the_normal_distribution() -> None:
    rng = np.random.default_rng(SEED)
    shares = np.concatenate([rng.uniform(0, 1, 300), 10 ** rng.uniform(-16.2, 0, 200), [2.0**-54, 1 - 2.0**-53]])
    with mpmath.workdps(50):
        for share, value in zip(shares.tolist(), elementary.normal_quantile(shares).tolist(), strict=True):
            exact = mpmath.sqrt(2) * mpmath.erfinv(2 * mpmath.mpf(share) - 1)
            assert abs(value - exact) < 3e-15 * max(abs(exact), 1)
        for value in np.concatenate([np.linspace(-37, 9, 200), [-2.0, 2.0, 1.9999999]]).tolist():
            exact = mpmath.ncdf(value)
            assert abs(elementary.normal_share(value) - exact) < 3e-15 * exact * max(1, value**2)
    assert elementary.normal_quantile([0.0, 1.0]).tolist() == [-np.inf, np.inf]
    assert np.isnan(elementary.normal_quantile([-0.1, 1.1, np.nan])).all()
    assert (elementary.normal_share(-np.inf), elementary.normal_share(np.inf)) == (0.0, 1.0)


def test_the_normal_quantile_is_the_same_compiled_and_by_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(SEED)
    ends = [0.0, 1.0, -0.1, 1.1, np.nan, 0.075, 0.925, np.exp(-25.0)]
    shares = np.concatenate([rng.uniform(0, 1, 2000), 10 ** rng.uniform(-16.2, 0, 2000), ends])
    compiled = elementary.normal_quantile(shares)
    monkeypatch.setattr(elementary, "_loop", lambda _: None)
    np.testing.assert_array_equal(compiled, elementary.normal_quantile(shares))
