"""Sensitivities against derivatives of the impact itself, in floats and in 40 digits."""

import mpmath
import numpy as np
import pytest

from cgid.physics import RIGID, STEEL, YANG2018_SPHERES, Elastic, HalfSpace, HuntCrossley, Impact, Material, Sphere
from studies.paper.sensitivity import (
    PARAMETERS,
    local_sensitivity,
    range_influence,
    response_grid,
)

RESPONSES = ("peak_force", "peak_displacement")
HELD = {
    "radius": 0.04,
    "density": 2400.0,
    "youngs_modulus": 9e9,
    "poisson_ratio": 0.31,
    "target_youngs_modulus": 30e9,
    "target_poisson_ratio": 0.22,
}


def impact_of(values=HELD, target=None, dissipation=None, stiffness="hertz", **more):
    own = {name: values[name] for name in ("density", "youngs_modulus", "poisson_ratio")}
    of_target = {name: values[f"target_{name}"] for name in ("youngs_modulus", "poisson_ratio")}
    return Impact(
        sphere=Sphere(material=Material(**own), radius=values["radius"]),
        target=target or HalfSpace(material=Material(density=7850, **of_target)),
        velocity=3.0,
        stiffness=stiffness,
        dissipation=dissipation or Elastic(),
        **more,
    )


@pytest.mark.parametrize("target", [None, RIGID], ids=["half space", "rigid wall"])
@pytest.mark.parametrize("stiffness", ["hertz", "rigid-sphere", "series"])
@pytest.mark.parametrize("dissipation", [Elastic(), HuntCrossley(restitution=0.3)], ids=["elastic", "damped"])
def test_local_is_the_derivative_of_the_impact(target, stiffness, dissipation):
    options = {"target": target, "stiffness": stiffness, "dissipation": dissipation}
    found = local_sensitivity(impact_of(**options))
    step = 1e-5
    names = [name for name in PARAMETERS if target is None or not name.startswith("target_")]
    for response in RESPONSES:
        assert list(getattr(found, response)) == names
        for name, value in getattr(found, response).items():
            low, high = (
                np.log(getattr(impact_of({**HELD, name: HELD[name] * (1 + sign * step)}, **options), response))
                for sign in (-1, 1)
            )
            derivative = (high - low) / (np.log1p(step) - np.log1p(-step))
            assert value == pytest.approx(derivative, rel=2e-7, abs=1e-10), (name, response)


def test_local_to_full_precision():
    found = local_sensitivity(impact_of())
    with mpmath.workdps(40):

        def log_peaks(**values):
            radius, density, modulus, nu, modulus_2, nu_2 = (values[name] for name in PARAMETERS)
            mass = mpmath.mpf(4) / 3 * mpmath.pi * radius**3 * density
            stiffness = mpmath.mpf(4) / 3 * mpmath.sqrt(radius) / ((1 - nu**2) / modulus + (1 - nu_2**2) / modulus_2)
            displacement = (mpmath.mpf(5) / 4 * mass * 9 / stiffness) ** mpmath.mpf("0.4")
            return mpmath.log(stiffness * displacement ** mpmath.mpf("1.5")), mpmath.log(displacement)

        held = {name: mpmath.mpf(value) for name, value in HELD.items()}
        for number, response in enumerate(RESPONSES):
            for name in PARAMETERS:
                exact = mpmath.diff(
                    lambda x, name=name, number=number: log_peaks(**{**held, name: mpmath.exp(x)})[number],
                    mpmath.log(held[name]),
                )
                assert float(getattr(found, response)[name]) == pytest.approx(float(exact), rel=1e-13)


def test_range_influence_by_hand():
    sphere, velocity = YANG2018_SPHERES[1], 2.0
    impact = Impact(
        sphere=Sphere(material=sphere, radius=0.025),
        target=HalfSpace(material=STEEL),
        velocity=velocity,
        stiffness="series",
        dissipation=HuntCrossley(restitution=0.6),
    )
    found = range_influence(
        impact, {"density": np.linspace(1000, 3400, 41), "target_youngs_modulus": np.linspace(20e9, 1620e9, 41)}
    )
    assert found.peak_force["density"] == pytest.approx(3.4**0.6 - 1, rel=1e-12)
    assert found.peak_displacement["density"] == pytest.approx(3.4**0.4 - 1, rel=1e-12)
    own = (1 - 0.28**2) / 2.26
    by_hand = ((own + 0.91 / 20) / (own + 0.91 / 1620)) ** 0.4 - 1
    assert found.peak_force["target_youngs_modulus"] == pytest.approx(by_hand, rel=1e-12)
    assert found.peak_displacement["target_youngs_modulus"] == pytest.approx(by_hand, rel=1e-12)


def test_response_grid_is_made_of_single_impacts():
    moduli, ratios = [2e9, 5e9, 2e10], [0.1, 0.4]
    grid = response_grid(impact_of(), {"youngs_modulus": moduli, "target_poisson_ratio": ratios})
    assert grid.peak_force.shape == (3, 2)
    for i, modulus in enumerate(moduli):
        for j, ratio in enumerate(ratios):
            one = impact_of({**HELD, "youngs_modulus": modulus, "target_poisson_ratio": ratio})
            assert grid.peak_force[i, j] == one.peak_force
            assert grid.peak_displacement[i, j] == one.peak_displacement
