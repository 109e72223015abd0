"""Rocks that are no spheres: lumps with corners, blows beside the centre; in impacts, frames, tables and streams."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import gamma

from cgid.errors import BadData
from cgid.physics import (
    RIGID,
    STEEL,
    YANG2018_SPHERES,
    Elastic,
    HalfSpace,
    HuntCrossley,
    Impact,
    Material,
    Sphere,
    ThinPlate,
    Thornton,
    Viscoelastic,
    WaltonBraun,
)
from cgid.physics.contact.laws import MIN_VISCOELASTIC, viscoelastic_number
from cgid.scene import parse_scene, plan, record, synthesise
from cgid.scene.synthesis.draws import SPHERE_SHAPE
from cgid.scene.synthesis.synthesis import columns_of
from tests.plan_scenes import STEEL as STEEL_TARGET
from tests.plan_scenes import scene_of, uniform

pytestmark = pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")

ROCK = YANG2018_SPHERES[1]
LAWS = {
    "elastic": Elastic(),
    "hunt-crossley": HuntCrossley(restitution=0.4),
    "viscoelastic": Viscoelastic(dissipative_constant=2e-5),
    "thornton": Thornton(yield_pressure=41e6),
    "walton-braun": WaltonBraun(restitution=0.4),
}


def lump(curvature=0.3, effective_mass=0.6, **more):
    return Sphere(material=ROCK, radius=0.025, curvature=curvature, effective_mass=effective_mass, **more)


def impact_of(sphere, dissipation, target=None, **more):
    target = target or HalfSpace(material=STEEL)
    settings = {"velocity": 2.0, "stiffness": "hertz"} | more
    return Impact(sphere=sphere, target=target, dissipation=dissipation, **settings)


# ---- impacts ------------------------------------------------------------------------------------------------------


def same_sphere(sphere):
    """Return the sphere with the contact radius and the effective mass of a lump, made of another rock."""
    density = ROCK.density * sphere.effective_mass / sphere.curvature**3
    return Sphere(material=replace(ROCK, density=density), radius=sphere.radius * sphere.curvature)


@pytest.mark.parametrize(
    ("target", "gravity"),
    [(None, 0.0), (None, 9.81), (RIGID, 0.0), (lump(0.5, 0.9), 0.0), (ThinPlate(material=STEEL, thickness=0.02), 0.0)],
    ids=["half space", "weight", "rigid", "lump", "plate"],
)
@pytest.mark.parametrize("name", LAWS)
def test_a_lump_hits_like_the_sphere_of_its_contact_and_mass(name, target, gravity):
    one = impact_of(lump(), LAWS[name], target, gravity=gravity)
    mirrored = same_sphere(target) if isinstance(target, Sphere) else target
    other = impact_of(same_sphere(lump()), LAWS[name], mirrored, gravity=gravity)
    times = np.linspace(0, 1.05, 500) * float(one.contact_duration)
    assert np.abs(one.force(times) - other.force(times)).max() < 3e-8 * other.peak_force
    for quantity in ("restitution", "contact_duration", "impulse", "dissipated_energy", "end_displacement"):
        assert getattr(one, quantity) == pytest.approx(getattr(other, quantity), rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("offset", [0.2, 0.8, 1.5])
def test_an_eccentric_blow_is_that_of_a_rigid_body_that_turns(offset):
    """Centre and rotation by DOP853; the contact lies `offset` radii of gyration beside the centre."""
    share = 1 / (1 + offset**2)
    impact = impact_of(lump(0.3, share), HuntCrossley(restitution=0.5))
    mass, gyration, chi = float(impact.sphere.mass), 0.016, float(impact.dissipation.damping_number) / 2.0
    modulus = 1 / (ROCK.plane_strain_compliance + STEEL.plane_strain_compliance)
    stiffness, arm = 4 / 3 * np.sqrt(0.3 * 0.025) * modulus, offset * gyration

    def push(state):
        depth, rate = state[0] + arm * state[1], state[2] + arm * state[3]
        return max(stiffness * max(depth, 0.0) ** 1.5 * (1 + chi * rate), 0.0)

    def motion(_, state):
        force = push(state)
        return state[2], state[3], -force / mass, -force * arm / (mass * gyration**2)

    def parted(time, state):
        return state[0] + arm * state[1] if time > 1e-6 else 1.0

    parted.terminal, parted.direction = True, -1
    tolerance = {"rtol": 1e-12, "atol": [1e-17, 1e-17, 1e-12, 1e-12]}
    found = solve_ivp(
        motion, (0, 2e-3), (0, 0, 2.0, 0), "DOP853", events=parted, dense_output=True, max_step=3e-6, **tolerance
    )
    times = np.linspace(0, 0.999, 300) * found.t[-1]
    forces = np.array([push(found.sol(time)) for time in times])
    assert np.abs(impact.force(times) - forces).max() < 1e-8 * forces.max()
    assert float(impact.contact_duration) == pytest.approx(found.t[-1], rel=1e-6)
    centre, spin = found.y[2, -1], found.y[3, -1]
    assert -(centre + arm * spin) == pytest.approx(float(impact.rebound_velocity), rel=1e-7)
    # As a rock of a stream leaves.
    assert -centre == pytest.approx((1.5 * share - 1) * 2.0, rel=1e-7)
    assert impact.sphere.impact_mass == pytest.approx(share * mass)


# ---- viscoelastic rocks --------------------------------------------------------------------------------------------


def viscoelastic_restitution(zeta):
    """Return the restitution of `x'' = -x^(3/2) - zeta x^(1/2) x'`, in w with x = w^2, by DOP853."""

    def motion(_, state):
        w, y, _ = state
        return y / 2, -w * (w**3 + zeta * w * y), w

    def released(sigma, state):
        return state[0] ** 2 + zeta * state[1] if sigma > 0 else 1.0

    released.terminal, released.direction = True, -1
    found = solve_ivp(motion, (0, 1e3), (0, 1, 0), "DOP853", events=released, rtol=1e-13, atol=1e-15, max_step=0.05)
    return -found.y_events[0][0][1]


@pytest.mark.parametrize("restitution", [0.999, 0.95, 0.8, 0.5, 0.3, 0.15, 0.05, 0.01, 0.003])
def test_the_number_of_a_viscoelastic_impact_gives_its_restitution(restitution):
    zeta = float(viscoelastic_number(restitution))
    assert viscoelastic_restitution(zeta) == pytest.approx(restitution, rel=1e-10)


def test_the_number_of_a_viscoelastic_impact_has_its_published_limit():
    """1 - e = 1.15344 zeta for little loss: Ramirez et al. (1999), Phys. Rev. E 60, 4465."""
    first = np.sqrt(np.pi) * gamma(0.6) / (5**0.4 * 2**0.2 * gamma(2.1))
    assert viscoelastic_number(1 - 1e-12) * first * 1e12 == pytest.approx(1, rel=2e-4)
    assert viscoelastic_number(1.0) == 0
    dense = np.linspace(MIN_VISCOELASTIC, 1, 100_001)
    assert (np.diff(viscoelastic_number(dense)) < 0).all()


def test_a_restitution_is_delivered_at_every_speed_and_on_every_body():
    wanted = np.array([0.003, 0.2, 0.6, 1.0])
    law = Viscoelastic(restitution=wanted)
    for velocity in (0.3, 6.0):
        impact = impact_of(lump(), law, velocity=velocity)
        assert impact.restitution == pytest.approx(wanted, abs=1e-9)
        constant = viscoelastic_number(wanted) * impact.time_scale
        same = impact_of(lump(), Viscoelastic(dissipative_constant=constant[:3]), velocity=velocity)
        times = np.linspace(0, 1, 200) * float(impact.contact_duration.max())
        assert np.abs(impact.force(times)[:3] - same.force(times)).max() < 1e-10 * same.peak_force.max()
    on_plate = impact_of(lump(), law, ThinPlate(material=STEEL, thickness=0.03))
    assert (on_plate.restitution < wanted).all()


# ---- scenes -------------------------------------------------------------------------------------------------------

SHAPE = {
    "curvature": {"distribution": "log-uniform", "lowest": 0.1, "highest": 1.0},
    "effective_mass": uniform(0.4, 1.0),
}


def rebuilt(scene, parameters, rows=slice(None)):
    own = {name: parameters[name][rows] for name in parameters if name != "label"}
    material = Material(**{name: own[name] for name in ("density", "youngs_modulus", "poisson_ratio")})
    return Impact(
        sphere=Sphere(material=material, radius=own["radius"], **{name: own[name] for name in SPHERE_SHAPE}),
        target=scene.body, velocity=own["velocity"], stiffness="hertz",
        dissipation=HuntCrossley(restitution=own["restitution"]),
    )  # fmt: skip


def test_a_scene_of_lumps_holds_the_impacts_of_its_parameters():
    scene, plain = scene_of(None, SHAPE, {}), scene_of(None, None, {})
    (batch,), (spheres,) = (list(synthesise(one, 200, dtype="float64")) for one in (scene, plain))
    frames = rebuilt(scene, batch.parameters).force_frames(200e3, 2048, batch.parameters["onset"])
    assert np.abs(batch.signals - frames).max() < 1e-12 * frames.max()
    assert {*batch.parameters} - {*spheres.parameters} == {*SPHERE_SHAPE}
    for name in set(spheres.parameters) - {"peak_force", "contact_duration"}:
        assert np.array_equal(batch.parameters[name], spheres.parameters[name], equal_nan=True)
    assert np.median(batch.parameters["curvature"]) == pytest.approx(np.sqrt(0.1), rel=0.15)
    assert batch.parameters["effective_mass"].min() < 0.45
    assert np.abs(np.corrcoef(*(batch.parameters[name] for name in SPHERE_SHAPE))[0, 1]) < 0.2
    assert parse_scene(json.loads(scene.text)) == scene


def test_a_table_and_a_beam_of_lumps():
    (rows,) = columns_of(plan(scene_of(None, SHAPE, {}), "closed-form"), 100)
    assert rows.columns["peak_force"] == pytest.approx(
        rebuilt(scene_of(), {**rows.columns}).peak_force, rel=1e-12
    )  # fmt: skip
    large = {"radius": "0.1 m"}
    thin, thinner = ({"target": {**STEEL_TARGET, "thickness": size}} for size in ("3 mm", "2.5 mm"))
    assert scene_of(thin, large) and scene_of(thinner, {**large, "effective_mass": 0.1})
    for impact, shape in ((thin, {"curvature": 10.0}), (thinner, {})):
        with pytest.raises(BadData, match="lambda of the thin plate must be at most 30"):
            scene_of(impact, {**large, **shape})


def test_a_lump_keeps_its_shape_in_a_stream_and_leaves_as_its_centre_does():
    shape = {"curvature": uniform(0.1, 1.0), "effective_mass": uniform(0.6, 1.0), "restitution": uniform(0.5, 0.9)}
    scene = scene_of(
        None, shape, {}, sampling={"sampling_rate": 100e3},
        stream={"duration": "5 s", "arrivals": {"rate": "10 Hz"}, "rebounds": {"most": 3, "least_speed": "0.02 m/s"}},
    )  # fmt: skip
    _, truth = record(scene, 3)
    assert (truth["bounce"] == 2).any()
    toppled = 0
    for rock in np.unique(truth["rock"]):
        rows = np.flatnonzero(truth["rock"] == rock)
        assert np.ptp(truth["curvature"][rows]) == np.ptp(truth["effective_mass"][rows]) == 0
        first = {name: column[rows] for name, column in truth.items()}
        left = ((1 + first["restitution"]) * first["effective_mass"] - 1) * first["velocity"]
        assert first["velocity"][1:] == pytest.approx(left[:-1], rel=1e-12)
        toppled += rows.size == 1 and bool(left[0] <= 0)
    assert toppled
    assert rebuilt(scene, truth).peak_force == pytest.approx(truth["peak_force"], rel=1e-12)


def test_viscoelastic_rocks_rebound_as_asked_and_lose_more_before_they_turn():
    (damped,), (batch,) = (
        list(synthesise(scene_of({"dissipation": name}, SHAPE, {}), 200, dtype="float64"))
        for name in ("hunt-crossley", "kuwabara-kono")
    )
    for name in ("restitution", "velocity", "radius", *SPHERE_SHAPE):
        assert batch.parameters[name] == pytest.approx(damped.parameters[name], rel=1e-10)
    impact = replace(
        rebuilt(scene_of(), damped.parameters), dissipation=Viscoelastic(restitution=damped.parameters["restitution"])
    )
    frames = impact.force_frames(200e3, 2048, damped.parameters["onset"])
    assert np.abs(batch.signals - frames).max() < 1e-9 * frames.max()
    assert plan(scene_of({"dissipation": "kuwabara-kono"})).decisions["impacts"].why == (
        "kuwabara-kono impacts integrated one by one"
    )


def test_a_strength_is_a_yield_pressure_1_6_times_as_high():
    strength, pressure = (
        {"restitution": None, name: {"distribution": "lognormal", "median": median, "sigma": 0.4}}
        for name, median in (("strength", "20 MPa"), ("yield_pressure", "32 MPa"))
    )
    crushing = {"dissipation": "thornton"}
    (one,), (other,) = (list(synthesise(scene_of(crushing, part, {}), 100)) for part in (strength, pressure))
    assert np.array_equal(one.parameters["yield_pressure"], 1.6 * one.parameters["strength"])
    assert one.parameters["yield_pressure"] == pytest.approx(other.parameters["yield_pressure"], rel=1e-14)
    assert np.median(one.parameters["strength"]) == pytest.approx(20e6, rel=0.15)
    assert np.abs(one.signals - other.signals).max() < 1e-5 * other.signals.max()
    (rows,) = columns_of(plan(scene_of(crushing, strength), "closed-form"), 50)
    assert np.array_equal(rows.columns["yield_pressure"], 1.6 * rows.columns["strength"])
    stream = {"duration": "2 s", "arrivals": {"rate": "10 Hz"}}
    _, truth = record(scene_of(crushing, strength, {}, sampling={"sampling_rate": 100e3}, stream=stream))
    assert np.isfinite(truth["yield_pressure"]).all() and (truth["restitution"] < 1).all()


CRUSHED = {"restitution": None, "strength": "20 MPa"}
