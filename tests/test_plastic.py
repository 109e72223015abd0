"""Elastic-plastic and bilinear contacts: closed forms, pulses against an integrator, balances, limits, bad input."""

import json

import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.physics import (
    STEEL,
    YANG2018_SPHERES,
    Elastic,
    HalfSpace,
    HertzRangeWarning,
    HuntCrossley,
    Impact,
    Material,
    Sphere,
    ThinPlate,
    Thornton,
    WaltonBraun,
)
from cgid.scene import parse_scene, plan, record, synthesise
from cgid.scene.file.distributions import LIMITS
from cgid.scene.synthesis.synthesis import columns_of
from studies.paper.sensitivity import yield_pressure
from tests import naive
from tests.plan_scenes import POPULATION, scene_of, uniform

#: Deep in plasticity a contact passes Hertz's range; the closed forms and the integrator do so alike.
pytestmark = pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")

#: From a contact that hardly yields to one that hardly does anything else [Pa], at 2 m/s.
PRESSURES = (151e6, 145e6, 120e6, 80e6, 41e6, 10e6, 1e6)


def coal(dissipation, *, target=None, velocity=2.0, stiffness="hertz", **more):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
        target=target or HalfSpace(material=STEEL),
        velocity=velocity,
        stiffness=stiffness,
        dissipation=dissipation,
        **more,
    )


ELASTIC = coal(Elastic())
#: Largest pressure of the elastic contact, `2 E a / (pi R)` with `a^2 = R delta`.
ELASTIC_PRESSURE = float(2 * ELASTIC.reduced_modulus / np.pi * np.sqrt(ELASTIC.peak_displacement / 0.025))


def yield_velocity(impact, pressure):
    """Return v_y of Thornton (1997), Eq. 39: the elastic energy at p_y, all in his own numbers."""
    radius, modulus, mass = impact.reduced_radius, impact.reduced_modulus, impact.reduced_mass
    return np.sqrt((np.pi / (2 * modulus)) ** 4 * 8 * np.pi * radius**3 * pressure**5 / (15 * mass))


def published_restitution(ratio):
    """Return e of v_y / v (Thornton 1997, Eq. 44)."""
    root = np.sqrt(6 / 5 - ratio**2 / 5)
    return np.sqrt(6 * np.sqrt(3) / 5) * np.sqrt(1 - ratio**2 / 6) * (ratio / (ratio + 2 * root)) ** 0.25


def thornton_contact(impact, pressure):
    return naive.thornton_contact(float(impact.reduced_radius), float(impact.reduced_modulus), pressure)


def integrated(impact, contact):
    return naive.two_path_impact(float(impact.reduced_mass), float(impact.velocity), float(impact.time_scale), *contact)


def over_branches(impact, n=120):
    """Yield Gauss's times and weights on each branch of a pulse, in a variable in which it is smooth, and d t."""
    unit, curves = float(impact.time_scale), impact.curves
    ends = unit * np.array([0.0, curves.end_of_elastic[0], curves.time_of_peak[0], curves.times[0][0]])
    nodes, weights = np.polynomial.legendre.leggauss(n)
    theta, weights = (nodes + 1) / 2, weights / 2
    lengths = np.diff(ends)
    yield lambda s: ends[0] + lengths[0] * s**2, theta, weights, 2 * lengths[0] * theta
    yield lambda s: ends[1] + lengths[1] * s, theta, weights, lengths[1] * np.ones(n)
    yield lambda s: ends[3] - lengths[2] * s**2, theta[::-1], weights, 2 * lengths[2] * theta[::-1]


def impulse_of(impact):
    return sum((impact.force(times(s)) * w * rate).sum() for times, s, w, rate in over_branches(impact))


def loop_of(impact, n=60):
    """Return the integral of P d(delta) [J], the displacement of each branch by its Chebyshev series."""
    total = 0.0
    for index, (times, s, w, _) in enumerate(over_branches(impact)):
        series = np.polynomial.Chebyshev.interpolate(lambda s, times=times: impact.displacement(times(s)), n, [0, 1])
        total += (-1 if index == 2 else 1) * (impact.force(times(s)) * series.deriv()(s) * w).sum()
    return total


LAWS = {
    **{f"thornton {pressure:g}": Thornton(yield_pressure=pressure) for pressure in PRESSURES},
    **{f"walton-braun {e:g}": WaltonBraun(restitution=e) for e in (1.0, 0.7, 0.3, 0.05)},
}


# ---- Thornton -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pressure", PRESSURES)
@pytest.mark.parametrize("velocity", [2.0, 8.0])
def test_restitution_is_the_published_closed_form(pressure, velocity):
    impact = coal(Thornton(yield_pressure=pressure), velocity=velocity)
    ratio = yield_velocity(impact, pressure) / velocity
    assert ratio < 1
    assert float(impact.restitution) == pytest.approx(float(published_restitution(ratio)), rel=1e-12, abs=0)


@pytest.mark.parametrize("pressure", PRESSURES)
def test_force_is_that_of_an_integrator(pressure):
    impact = coal(Thornton(yield_pressure=pressure))
    force, end, rebound = integrated(impact, thornton_contact(impact, pressure))
    times = np.linspace(0, 1.02, 4001) * float(impact.contact_duration)
    peak = float(impact.peak_force)
    assert np.abs(impact.force(times) - force(times)).max() < 1e-9 * peak
    assert force(times).max() <= peak * (1 + 1e-12)
    assert impact.force(impact.time_of_peak) == pytest.approx(peak, rel=1e-12)
    assert impact.displacement(impact.compression_time) == pytest.approx(impact.peak_displacement, rel=1e-12)
    assert float(impact.rebound_velocity) == pytest.approx(rebound, rel=1e-9)
    # The integrator leaves where the force falls below 1e-13 of its peak.
    assert float(impact.contact_duration) == pytest.approx(end, rel=1e-7)


def test_an_impact_below_yield_is_the_elastic_one():
    impact = coal(Thornton(yield_pressure=1.0001 * ELASTIC_PRESSURE))
    times = np.linspace(-0.1, 1.1, 1001) * float(ELASTIC.contact_duration)
    assert impact.restitution == 1 and impact.end_displacement == 0 and impact.dissipated_energy == 0
    for name in ("peak_force", "peak_displacement", "contact_duration", "time_of_peak", "impulse"):
        assert getattr(impact, name) == pytest.approx(getattr(ELASTIC, name), rel=1e-14)
    assert np.abs(impact.force(times) - ELASTIC.force(times)).max() < 1e-13 * ELASTIC.peak_force
    assert np.abs(impact.displacement(times) - ELASTIC.displacement(times)).max() < 3e-13 * ELASTIC.peak_displacement


def test_deep_in_plasticity_restitution_falls_as_the_fourth_root_of_speed():
    slow, quick = (coal(Thornton(yield_pressure=1e3), velocity=v).restitution for v in (0.1, 1.6))
    assert float(slow / quick) == pytest.approx(2, rel=1e-4)
    # Thornton's own limit, 1.185 (v_y / v)^(1/4).
    limit = 1.185 * (yield_velocity(ELASTIC, 1e3) / 1.6) ** 0.25
    assert float(quick) == pytest.approx(float(limit), rel=1e-3)


def test_yield_pressure_gives_the_wanted_restitution():
    wanted = np.array([[0.999], [0.7], [0.3], [0.01]])
    pressure = yield_pressure(wanted, coal(Elastic(), velocity=[2.0, 5.0]))
    assert pressure.shape == (4, 2)
    assert coal(Thornton(yield_pressure=pressure), velocity=[2.0, 5.0]).restitution == pytest.approx(
        np.broadcast_to(wanted, (4, 2)), rel=1e-11
    )
    with pytest.raises(InvalidValue, match="restitution must be between"):
        yield_pressure(1.0, ELASTIC)
    with pytest.raises(InvalidValue, match="target must have no losses"):
        yield_pressure(0.5, coal(Elastic(), target=ThinPlate(material=STEEL, thickness=0.01)))


# ---- Walton and Braun ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("restitution", [1.0, 0.7, 0.3, 0.05])
def test_bilinear_contact_is_that_of_an_integrator(restitution):
    impact = coal(WaltonBraun(restitution=restitution, loading_stiffness=2e6))
    force, end, rebound = integrated(impact, naive.walton_braun_contact(restitution, 2e6))
    times = np.linspace(0, 1.02, 4001) * float(impact.contact_duration)
    assert np.abs(impact.force(times) - force(times)).max() < 1e-9 * impact.peak_force
    assert (impact.restitution == restitution).all()
    assert restitution * float(impact.velocity) == pytest.approx(rebound, rel=1e-9)
    quarter = np.pi / 2 * np.sqrt(impact.reduced_mass / 2e6)
    assert float(impact.contact_duration) == pytest.approx(float((1 + restitution) * quarter), rel=1e-14)
    assert float(impact.contact_duration) == pytest.approx(end, rel=1e-9)
    assert float(impact.peak_force) == pytest.approx(float(2 * np.sqrt(2e6 * impact.reduced_mass)), rel=1e-14)


def test_the_spring_of_equal_depth_is_as_deep_as_the_elastic_contact():
    impact = coal(WaltonBraun(restitution=0.4))
    assert float(impact.peak_displacement) == pytest.approx(float(ELASTIC.peak_displacement), rel=1e-14)
    modulus, mass, root = ELASTIC.reduced_modulus, ELASTIC.reduced_mass, np.sqrt(0.025)
    stiffness = 16 / 15 * root * modulus * (15 * mass * 4 / (16 * root * modulus)) ** 0.2
    given = coal(WaltonBraun(restitution=0.4, loading_stiffness=stiffness))
    assert float(given.peak_force) == pytest.approx(float(impact.peak_force), rel=1e-14)


# ---- both ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_impulse_and_energy_balance_by_quadrature(law):
    impact = coal(law)
    energy = 0.5 * float(impact.reduced_mass) * 4
    assert impulse_of(impact) == pytest.approx(float(impact.impulse), rel=1e-12)
    assert float(impact.impulse) == pytest.approx(float((1 + impact.restitution) * impact.reduced_mass * 2), rel=1e-14)
    assert loop_of(impact) == pytest.approx(float(impact.dissipated_energy), rel=0, abs=1e-11 * energy)


# ---- scenes -------------------------------------------------------------------------------------------------------

CRUSHED = {"restitution": None, "yield_pressure": uniform("10 MPa", "200 MPa")}


def test_a_rock_that_rebounds_in_a_stream_crushes_less_each_time():
    scene = scene_of(
        {"dissipation": "thornton"}, CRUSHED, {}, sampling={"sampling_rate": 100e3},
        stream={"duration": "5 s", "arrivals": {"rate": "4 Hz"}, "rebounds": {"most": 3, "least_speed": "0.05 m/s"}},
    )  # fmt: skip
    _, truth = record(scene, 3)
    assert (truth["bounce"] == 2).any()
    for rock in np.unique(truth["rock"]):
        rows = np.flatnonzero(truth["rock"] == rock)
        assert np.ptp(truth["yield_pressure"][rows]) == 0
        assert (np.diff(truth["restitution"][rows]) > 0).all()
        assert truth["velocity"][rows[1:]] == pytest.approx((truth["restitution"] * truth["velocity"])[rows[:-1]])


@pytest.mark.parametrize("velocity", LIMITS["speed"])
@pytest.mark.parametrize("radius", LIMITS["length"])
@pytest.mark.parametrize("modulus", LIMITS["modulus"])
@pytest.mark.parametrize("pressure", LIMITS["modulus"])
def test_the_widest_scenes_allowed_give_finite_signals(pressure, modulus, radius, velocity):
    rocks = {"youngs_modulus": modulus, "radius": radius, "velocity": velocity, "density": 1e-3}
    frame = {"sampling_rate": 1e5, "samples": 64, "pre_trigger": 8}
    scene = scene_of({"dissipation": "thornton"}, {**CRUSHED, **rocks, "yield_pressure": pressure}, {}, sampling=frame)
    with np.errstate(all="raise", under="ignore"):
        (batch,) = synthesise(scene, 2, dtype="float64")
    assert np.isfinite(batch.signals).all() and (batch.signals >= 0).all()
    restitution = batch.parameters["restitution"]
    assert ((restitution > 0) & (restitution <= 1)).all()


def mixed(**more):
    """Return a scene of one label whose rocks lose energy in one of four ways."""
    rock = {key: value for key, value in {**POPULATION, "restitution": None}.items() if value is not None}
    pressure = {"yield_pressure": uniform("10 MPa", "200 MPa")}
    populations = [
        {**rock, **pressure, "weight": 2.0},
        {**rock, "dissipation": "hunt-crossley", "restitution": uniform(0.2, 0.9)},
        {**rock, "dissipation": "walton-braun", "restitution": uniform(0.2, 0.9)},
        {**rock, "dissipation": "elastic"},
    ]
    return scene_of({"dissipation": "thornton"}, None, {}, populations=populations, **more)


def test_populations_of_one_label_may_lose_energy_in_different_ways():
    batches = list(synthesise(mixed(), 700, dtype="float64"))
    values = {name: np.concatenate([one.parameters[name] for one in batches]) for name in batches[0].parameters}
    signals, laws = np.concatenate([one.signals for one in batches]), values["dissipation"]
    assert np.mean(laws == 2) == pytest.approx(0.4, abs=0.06)
    material = [values[name] for name in ("density", "youngs_modulus", "poisson_ratio")]
    for index, law in enumerate(
        (
            lambda rows: Elastic(),
            lambda rows: HuntCrossley(restitution=values["restitution"][rows]),
            lambda rows: Thornton(yield_pressure=values["yield_pressure"][rows]),
            lambda rows: WaltonBraun(restitution=values["restitution"][rows]),
        )
    ):
        rows = np.flatnonzero(laws == index)
        assert rows.size > 70
        assert np.isfinite(values["yield_pressure"][rows]).all() == (index == 2)
        density, modulus, ratio = (column[rows] for column in material)
        rock = Material(density=density, youngs_modulus=modulus, poisson_ratio=ratio)
        impact = Impact(
            sphere=Sphere(material=rock, radius=values["radius"][rows]), target=mixed().body,
            velocity=values["velocity"][rows], stiffness="hertz", dissipation=law(rows),
        )  # fmt: skip
        frames = impact.force_frames(200e3, 2048, values["onset"][rows])
        assert np.abs(signals[rows] - frames).max() < 1e-10 * frames.max()
        assert values["restitution"][rows] == pytest.approx(impact.restitution, rel=1e-13)
    assert parse_scene(json.loads(mixed().text)) == mixed()


def test_a_table_and_a_stream_of_mixed_laws():
    (rows,) = columns_of(plan(mixed(), "closed-form"), 200)
    asked = np.isfinite(rows.columns["asked_restitution"])
    assert np.array_equal(asked, np.isin(rows.columns["dissipation"], (1, 3)))
    assert rows.columns["restitution"][asked] == pytest.approx(rows.columns["asked_restitution"][asked], rel=1e-12)
    scene = mixed(
        sampling={"sampling_rate": 100e3},
        stream={"duration": "3 s", "arrivals": {"rate": "20 Hz"}, "rebounds": {"most": 2, "least_speed": "0.05 m/s"}},
    )
    _, truth = record(scene, 1)
    assert set(truth["dissipation"]) == {0, 1, 2, 3}
    for rock in np.unique(truth["rock"]):
        assert np.ptp(truth["dissipation"][truth["rock"] == rock]) == 0
    bounces = [
        truth["restitution"][truth["rock"] == rock] for rock in np.unique(truth["rock"][truth["dissipation"] == 1])
    ]
    assert all(np.ptp(one) < 1e-12 for one in bounces)


# ---- bad input ----------------------------------------------------------------------------------------------------


def test_extreme_but_representable_yield_pressures_give_finite_pulses():
    for pressure in (1e-30, 1e30):
        with np.errstate(all="raise"), pytest.warns(HertzRangeWarning) if pressure < 1 else np.errstate():
            impact = coal(Thornton(yield_pressure=pressure))
        assert np.isfinite(impact.force(np.linspace(0, float(impact.contact_duration), 50))).all()
        assert 0 < impact.restitution <= 1
