"""Impact against the paper's printed numbers, closed forms, and quadrature of the evaluated force."""

import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.impact import RIGID, Elastic, HalfSpace, HertzRangeWarning, HuntCrossley, Impact, Sphere, free_fall_velocity
from cgid.impact.quadrature import reference_pulse
from cgid.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material


def paper_impact(number=1, velocity=2.0, stiffness="series", dissipation=None, radius=YANG2018_RADIUS):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[number], radius=radius),
        target=HalfSpace(material=STEEL),
        velocity=velocity,
        stiffness=stiffness,
        dissipation=dissipation or Elastic(),
    )


def impulse_by_quadrature(impact):
    """Integrate the evaluated force on Gauss nodes of theta, tau/tau_c = sin^2(pi theta / 2)."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    theta = (nodes + 1) / 2
    duration = impact.contact_duration[..., None]
    force = impact.force(np.sin(np.pi / 2 * theta) ** 2 * duration)
    return (force * np.pi / 2 * np.sin(np.pi * theta) * weights / 2 * duration).sum(axis=-1)


def test_four_constants_under_eq_18():
    impact = paper_impact()
    found = np.array([
        impact.peak_displacement / 0.025, impact.peak_force / 0.025**2,
        impact.peak_displacement / 1380**0.4, impact.peak_force / 1380**0.6,
    ])  # fmt: skip
    printed = [0.013373106060040, 2.161252014548062e6, 1.854473633711090e-5, 17.646475463447818]
    assert found / printed == pytest.approx(np.ones(4), abs=1e-12)


@pytest.mark.parametrize(
    ("number", "modulus", "stiffness"),
    [
        (1, "2.4265", "5.1155e+08"),
        (2, "4.6305", "9.7619e+08"),
        (3, "21.559", "4.5450e+09"),
        (4, "4.1618", "8.7739e+08"),
    ],
)
def test_table_2_to_the_printed_digits(number, modulus, stiffness):
    impact = paper_impact(number, stiffness="hertz")
    assert f"{float(impact.reduced_modulus) / 1e9:.5g}" == modulus
    assert f"{float(impact.contact_stiffness):.4e}" == stiffness


def test_elastic_contact_time_and_shape_number():
    impact = paper_impact(velocity=np.array([0.5, 2.0, 10.0]), stiffness="hertz")
    assert impact.contact_duration * impact.velocity / impact.peak_displacement == pytest.approx(2.943275184, rel=1e-9)
    momentum = impact.reduced_mass * impact.velocity
    assert impact.peak_force * impact.contact_duration / momentum == pytest.approx(3.679094, rel=1e-6)


@pytest.mark.parametrize(
    ("e", "damping", "x_max", "f_max", "t_peak", "tau_c"),
    [
        (0.9, 0.1664819506853, 1.0488221456992, 1.0851869618102, 1.455779666621, 3.255461006071),
        (0.5, 1.4327505332714, 0.8479929129779, 1.0628707219377, 0.905375210462, 3.603560584046),
        (0.2, 4.9191667157908, 0.6375119689307, 1.3269001301292, 0.577515097935, 4.769811746245),
    ],
)
def test_dimensionless_rows(e, damping, x_max, f_max, t_peak, tau_c):
    law = HuntCrossley(restitution=e)
    impact = paper_impact(dissipation=law)
    assert law.damping_number == pytest.approx(damping, rel=1e-11)
    assert impact.peak_displacement / impact.length_scale == pytest.approx(x_max, rel=1e-11)
    assert impact.peak_force / impact.force_scale == pytest.approx(f_max, rel=1e-11)
    assert impact.time_of_peak / impact.time_scale == pytest.approx(t_peak, rel=1e-11)
    assert impact.contact_duration / impact.time_scale == pytest.approx(tau_c, rel=1e-11)


def test_impulse_and_restitution_measured_from_the_force():
    e = np.concatenate([np.linspace(0.05, 1, 96), [1 - 1e-6, 1 - 1e-9]])
    impact = paper_impact(dissipation=HuntCrossley(restitution=e))
    measured = impulse_by_quadrature(impact)
    assert measured / impact.impulse == pytest.approx(np.ones(e.shape), abs=1e-10)
    assert measured / (impact.reduced_mass * impact.velocity) - 1 == pytest.approx(e, abs=1e-10)


def test_peaks_agree_with_the_evaluated_pulse():
    impact = paper_impact(dissipation=HuntCrossley(restitution=[0.03, 0.05, 0.3, 0.7, 1.0]))
    at_peak = impact.force(impact.time_of_peak[:, None])[:, 0]
    assert at_peak == pytest.approx(impact.peak_force, rel=2e-10)
    beside = impact.force(impact.time_of_peak[:, None] * np.array([0.999, 1.001]))
    assert (beside < at_peak[:, None]).all()
    fine = impact.contact_duration[:, None] * np.linspace(0, 1, 4001)
    assert impact.displacement(fine).max(axis=1) == pytest.approx(impact.peak_displacement, rel=1e-5)


def test_loss_of_energy_measured_from_the_hysteresis_loop():
    e = np.array([0.1, 0.5, 0.9])
    impact = paper_impact(dissipation=HuntCrossley(restitution=e))
    fraction = np.sin(np.pi / 2 * np.linspace(0, 1, 40001)) ** 2
    times = impact.contact_duration[:, None] * fraction
    loop = np.trapezoid(impact.force(times), impact.displacement(times), axis=1)
    assert loop == pytest.approx(0.5 * impact.reduced_mass * 4.0 * (1 - e**2), rel=1e-6)


def test_table_and_reference_path_meet_at_the_edge_of_the_table():
    e = np.array([0.05 - 1e-12, 0.05])
    impact = paper_impact(dissipation=HuntCrossley(restitution=e))
    times = np.linspace(0, 1.1 * float(impact.contact_duration[0]), 500)
    force = impact.force(times)
    assert force[0] == pytest.approx(force[1], abs=1e-9 * impact.peak_force[0])


def test_reference_path_serves_tiny_restitutions():
    impact = paper_impact(dissipation=HuntCrossley(restitution=1e-3))
    pulse = reference_pulse(1e-3)
    assert float(impact.contact_duration / impact.time_scale) == pytest.approx(pulse.contact_time, rel=1e-14)
    assert np.isfinite(impact.force(np.linspace(-1e-4, 1e-2, 50))).all()


def test_everything_broadcasts():
    impact = paper_impact(
        radius=np.array([[0.01], [0.02]]), velocity=np.array([1.0, 2.0, 3.0]), dissipation=HuntCrossley(restitution=0.5)
    )
    assert impact.peak_force.shape == (2, 3)
    times = np.linspace(0, 1e-3, 7)
    force = impact.force(times)
    assert force.shape == (2, 3, 7)
    single = paper_impact(radius=0.02, velocity=3.0, dissipation=HuntCrossley(restitution=0.5))
    assert force[1, 2] == pytest.approx(single.force(times), rel=1e-12)
    assert single.force(times[3]) == pytest.approx(force[1, 2, 3])


def test_two_spheres_and_a_rigid_wall_after_chung_and_ooi_2011():
    """Benchmark values of Chung & Ooi (2011), Granular Matter 13, 643: peak force [kN] and contact time [us]."""

    def glass(density, modulus, nu, radius):
        return Sphere(material=Material(density=density, youngs_modulus=modulus, poisson_ratio=nu), radius=radius)

    pair = glass(2800, 48e9, 0.20, 0.01)
    two = Impact(sphere=pair, target=pair, velocity=20.0, stiffness="hertz", dissipation=Elastic())
    assert (float(two.peak_force) / 1e3, float(two.contact_duration) * 1e6) == pytest.approx(
        (10.6969, 40.339), rel=2e-5
    )
    ball = glass(2699, 70e9, 0.30, 0.1)
    wall = Impact(sphere=ball, target=RIGID, velocity=0.2, stiffness="hertz", dissipation=Elastic())
    assert (float(wall.peak_force) / 1e3, float(wall.contact_duration) * 1e6) == pytest.approx(
        (11.3699, 731.66), rel=2e-5
    )


def test_free_fall():
    assert free_fall_velocity([0.5, 3.0], gravity=9.8) == pytest.approx([np.sqrt(9.8), np.sqrt(58.8)])


def test_a_displacement_beyond_hertz_warns():
    with pytest.warns(HertzRangeWarning, match=r"displacement / radius reaches 0\.\d+"):
        paper_impact(velocity=100.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity": -1.0}, "velocity must be above 0, got -1 m/s"),
        ({"velocity": np.nan}, "velocity must be finite"),
        ({"stiffness": "hard"}, "stiffness must be one of 'hertz', 'rigid-sphere', 'series', got 'hard'"),
        ({"radius": [0.01, 0.0]}, "radius must be above 0, got 0 m at index 1"),
    ],
)
def test_bad_values_are_named(change, message):
    with pytest.raises(InvalidValue, match=message):
        paper_impact(**change)


def test_bad_materials_laws_and_shapes_are_named():
    with pytest.raises(InvalidValue, match="density must be above 0, got -1"):
        Material(density=-1, youngs_modulus=1e9, poisson_ratio=0.3)
    with pytest.raises(InvalidValue, match=r"poisson_ratio must lie between -1 and 0.5 \(exclusive\), got 0.5"):
        Material(density=1, youngs_modulus=1e9, poisson_ratio=0.5)
    with pytest.raises(InvalidValue, match="law must be one of 'exact'"):
        HuntCrossley(restitution=0.5, law="viscous")
    with pytest.raises(InvalidValue, match=r"do not broadcast against each other: radius \(2,\)"):
        paper_impact(radius=[0.01, 0.02], velocity=[1.0, 2.0, 3.0])
    with pytest.raises(TypeError, match="stiffness"):
        Impact(sphere=Sphere(material=STEEL, radius=1), target=RIGID, velocity=1, dissipation=Elastic())
