"""The contact's linear complementarity problem against non-negative least squares, which is another way to pose it."""

import numpy as np
import pytest
from scipy.optimize import nnls

from studies.finite_element._stepping import press


def pressed(compliance, gap, touching):
    force = np.full(gap.size, np.nan)
    assert press(compliance, gap, force, touching)
    return force


@pytest.mark.parametrize("seed", range(5))
def test_forces_are_those_of_non_negative_least_squares(seed):
    rng = np.random.default_rng(seed)
    for _ in range(100):
        n = rng.integers(1, 15)
        root = rng.normal(size=(n, n))
        compliance = root @ root.T / n + 10 ** rng.uniform(-5, 0) * np.eye(n)
        gap = rng.normal(size=n)
        force = pressed(compliance, gap, rng.random(n) < 0.5)
        # 1/2 f W f + g f is the square of L' f + L^-1 g, but for a constant.
        factor = np.linalg.cholesky(compliance)
        wanted, _ = nnls(factor.T, -np.linalg.solve(factor, gap), maxiter=1000)
        np.testing.assert_allclose(force, wanted, atol=1e-9 * (1 + wanted.max()))


def test_who_touches_may_be_guessed_wrong_altogether():
    rng = np.random.default_rng(5)
    for n in (40, 64):
        root = rng.normal(size=(n, n))
        compliance, gap = root @ root.T / n + 1e-3 * np.eye(n), rng.normal(size=n)
        found = [pressed(compliance, gap, np.full(n, guess)) for guess in (True, False)]
        np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-9 * found[0].max())
        left = gap + compliance @ found[0]
        scale = np.abs(compliance).max() * found[0].max()
        assert (found[0] >= 0).all() and (left > -1e-9 * scale).all()
        assert (np.minimum(found[0] / found[0].max(), np.maximum(left, 0) / scale) < 1e-9).all()


def test_surfaces_apart_do_not_press():
    touching = np.ones(3, bool)
    assert not pressed(np.eye(3), np.array([1.0, 0.5, 2.0]), touching).any()
    assert not touching.any()


@pytest.mark.parametrize(
    ("compliance", "gap"),
    [
        (np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([-1.0, -1.0])),
        (np.eye(2), np.array([-1.0, np.nan])),
        (np.eye(2), np.array([np.nan, 1.0])),
        (np.diag([1.0, np.nan]), np.array([-1.0, -1.0])),
    ],
)
def test_no_numbers_no_forces(compliance, gap):
    assert not press(compliance, gap, np.zeros(2), np.zeros(2, bool))
