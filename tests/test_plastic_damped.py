"""Crushing with viscous loss: pulses against an integrator, balances by quadrature, limits, scenes, bad input."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from cgid.errors import BadData
from cgid.physics import HuntCrossley, Impact, Material, ModalImpact, Sphere, Thornton, WaltonBraun
from cgid.physics.contact.curves import TOLERANCE
from cgid.scene import parse_scene, plan, record, synthesise, varied
from cgid.scene.synthesis.impacts import draw
from cgid.scene.synthesis.synthesis import columns_of
from cgid.shipped import scene_path
from tests import naive
from tests.plan_scenes import POPULATION, scene_of, uniform
from tests.test_plastic import coal, thornton_contact

pytestmark = pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")

VISCOUS = (0.999, 0.9, 0.6, 0.3, 0.1)
#: From a contact that would yield just before its turn, or does not because of the damping, to one that crushes deeply.
LAWS = {
    f"{name} {viscous}": replace(law, viscous_restitution=viscous)
    for viscous in VISCOUS
    for name, law in {
        **{f"thornton {pressure:g}": Thornton(yield_pressure=pressure) for pressure in (145e6, 120e6, 60e6, 10e6, 1e6)},
        **{f"walton-braun {e:g}": WaltonBraun(restitution=e, loading_stiffness=2e6) for e in (1.0, 0.5, 0.1)},
    }.items()
}
RESULTS = (
    "restitution",
    "peak_force",
    "peak_displacement",
    "contact_duration",
    "time_of_peak",
    "compression_time",
    "end_displacement",
    "impulse",
    "dissipated_energy",
)


def damping_of(restitution, velocity=2.0):
    """Return chi [s/m] of Hunt & Crossley (1975) by their own transcendental equation."""

    def excess(number):
        return (1 + restitution) * number - np.log((1 + number) / (1 - restitution * number))

    return brentq(excess, 1e-6, (1 - 1e-15) / restitution, xtol=1e-18, rtol=1e-15) / velocity


def contact_of(impact):
    """Return the two paths of the contact without damping, as its authors write them."""
    law = impact.dissipation
    if isinstance(law, Thornton):
        return thornton_contact(impact, float(law.yield_pressure))
    return naive.walton_braun_contact(float(law.restitution), float(law.loading_stiffness))


def ends_of(curves):
    """Return the times at which n contacts yield, turn and end; those that do not yield do so at the turn."""
    corner = curves.numbers[:, 0] if curves.law.name == "thornton" else np.zeros(len(curves.numbers))
    end, _, turn = curves.times
    low, high, one = np.zeros(end.size), turn.copy(), np.ones(end.size)
    for _ in range(40 if corner.any() else 0):
        middle = (low + high) / 2
        early = curves.evaluate(middle[:, None], one, one, "displacement", "float64", 1)[:, 0] < corner
        low, high = np.where(early, middle, low), np.where(early, high, middle)
    return low, turn, end


def branches(impact, n=60):
    """Yield times [s] at Gauss's points of a smooth variable s on each branch, dt/ds, weights, and the speed [m/s]."""
    unit = float(impact.time_scale)
    yields, turn, end = (float(times[0]) * unit for times in ends_of(impact.curves))
    nodes, weights = np.polynomial.legendre.leggauss(n)
    nodes, weights = (nodes + 1) / 2, weights / 2
    for start, stop, square in ((0.0, yields, "start"), (yields, turn, ""), (turn, end, "end")):
        length = stop - start
        if length < 1e-12 * end:
            continue
        times, rate = {
            "start": (lambda s, a=start, d=length: a + d * s**2, lambda s, d=length: 2 * d * s),
            "": (lambda s, a=start, d=length: a + d * s, lambda s, d=length: d + 0 * s),
            "end": (lambda s, b=stop, d=length: b - d * (1 - s) ** 2, lambda s, d=length: 2 * d * (1 - s)),
        }[square]
        parts = [(0.0, 0.25), (0.25, 0.5), (0.5, 1.0)]  # damping is quick near touch
        for low, high in parts:
            s = low + (high - low) * nodes
            series = np.polynomial.Chebyshev.interpolate(lambda s, t=times: impact.displacement(t(s)), n, [low, high])
            yield times(s), rate(s), (high - low) * weights, series.deriv()(s) / rate(s)


# ---- against an integrator ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_force_peak_restitution_and_times_are_those_of_an_integrator(law):
    impact = coal(law)
    chi = damping_of(law.viscous_restitution)
    scales = (float(impact.reduced_mass), 2.0, float(impact.time_scale))
    force, end, rebound = naive.two_path_impact(*scales, *contact_of(impact), damping=chi)
    times = np.linspace(0, 1.02, 3001) * float(impact.contact_duration)
    exact, peak = force(times), float(impact.peak_force)
    assert np.abs(impact.force(times) - exact).max() < TOLERANCE * peak
    assert float(impact.rebound_velocity) == pytest.approx(rebound, rel=TOLERANCE)
    # The integrator leaves where the force falls below 1e-13 of its peak.
    assert float(impact.contact_duration) == pytest.approx(end, rel=1e-6)
    top = float(impact.time_of_peak)
    around = force(top * (1 + np.array([-1e-4, 0.0, 1e-4])))
    assert around[1] == pytest.approx(peak, rel=TOLERANCE) and exact.max() <= peak * (1 + TOLERANCE)
    assert around[1] >= around.max() * (1 - 1e-10)
    assert float(impact.force(top)) == pytest.approx(peak, rel=1e-11)
    turn = float(impact.compression_time)
    assert float(impact.displacement(turn)) == pytest.approx(float(impact.peak_displacement), rel=1e-9)
    assert 0 < top <= turn < float(impact.contact_duration)


# ---- balances -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_impulse_and_both_losses_by_quadrature(law):
    impact, chi = coal(law), damping_of(law.viscous_restitution)
    energy = 0.5 * float(impact.reduced_mass) * 4
    impulse = whole = viscous = 0.0
    for times, rate, weights, speed in branches(impact):
        force = impact.force(times)
        impulse += (force * rate * weights).sum()
        whole += (force * speed * rate * weights).sum()
        viscous += (force * chi * speed**2 / (1 + chi * speed) * rate * weights).sum()
    loading, unloading, corner = contact_of(impact)
    deepest, rest = float(impact.peak_displacement), float(impact.end_displacement)
    crushing = quad(loading, 0, deepest, points=[corner] if corner < deepest else None, epsabs=0, epsrel=1e-12)[0]
    crushing -= quad(unloading(deepest), rest, deepest, epsabs=0, epsrel=1e-12)[0]
    assert impulse == pytest.approx(float(impact.impulse), rel=TOLERANCE)
    assert float(impact.impulse) == pytest.approx(float((1 + impact.restitution) * impact.reduced_mass * 2), rel=1e-14)
    assert whole == pytest.approx(float(impact.dissipated_energy), abs=TOLERANCE * energy)
    assert viscous + crushing == pytest.approx(float(impact.dissipated_energy), abs=TOLERANCE * energy)
    assert viscous > 0 and crushing > -TOLERANCE * energy


# ---- limits -------------------------------------------------------------------------------------------------------


def agree(one, other, times, error):
    for name in RESULTS:
        unit = np.max(np.abs(getattr(other, name)))
        assert np.abs(getattr(one, name) - getattr(other, name)).max() <= error * max(unit, 1e-300), name
    for quantity in ("force", "displacement"):
        exact = getattr(other, quantity)(times)
        assert np.abs(getattr(one, quantity)(times) - exact).max() <= error * exact.max(), quantity


@pytest.mark.parametrize(
    "law",
    [
        Thornton(yield_pressure=np.geomspace(1e4, 200e6, 50)),
        WaltonBraun(restitution=np.linspace(0.05, 1, 50), loading_stiffness=1e6),
        WaltonBraun(restitution=np.linspace(0.05, 1, 50)),
    ],
    ids=["T", "WB", "WB of equal depth"],
)
def test_without_viscous_loss_the_law_is_the_plastic_one(law):
    alone, times = coal(law), np.linspace(0, 1e-3, 700)
    agree(coal(replace(law, viscous_restitution=1.0)), alone, times, 3 * TOLERANCE)
    nearly = coal(replace(law, viscous_restitution=1 - 1e-7))
    assert nearly.restitution == pytest.approx(alone.restitution, rel=1e-6)
    assert (nearly.restitution < alone.restitution).all()


def test_rocks_that_do_not_yield_are_those_of_hunt_and_crossley():
    viscous, times = np.linspace(0.05, 1, 50), np.linspace(0, 1e-3, 700)
    for pressure in (200e6, 1e12):
        hard = coal(Thornton(yield_pressure=pressure, viscous_restitution=viscous))
        agree(hard, coal(HuntCrossley(restitution=viscous)), times, 3 * TOLERANCE)
        assert not hard.end_displacement.any()


def test_a_bilinear_contact_of_restitution_1_is_a_damped_linear_spring():
    """Its depth and restitution in SI units, by the first integral of `m x'' = -k x (1 + chi x')`."""
    impact = coal(WaltonBraun(restitution=1.0, loading_stiffness=2e6, viscous_restitution=0.5))
    number = 2 * damping_of(0.5)
    stored = (number - np.log1p(number)) / number**2  # of m v^2
    deepest = np.sqrt(2 * stored * float(impact.reduced_mass) * 4 / 2e6)
    assert float(impact.peak_displacement) == pytest.approx(deepest, rel=TOLERANCE)
    assert float(impact.restitution) == pytest.approx(0.5, rel=TOLERANCE)  # it stores as much as a Hertzian one


# ---- scenes -------------------------------------------------------------------------------------------------------

CRUSHED = {"restitution": None, "yield_pressure": uniform("10 MPa", "200 MPa")}
BOTH = {"viscous_restitution": uniform(0.4, 0.95)}
SCENES = {
    "thornton": scene_of({"dissipation": "thornton"}, {**CRUSHED, **BOTH}, {}),
    "walton-braun": scene_of({"dissipation": "walton-braun"}, BOTH, {}),
    "thornton alone": scene_of({"dissipation": "thornton"}, CRUSHED, {}),
    "walton-braun alone": scene_of({"dissipation": "walton-braun"}, None, {}),
    "strength": scene_of({"dissipation": "thornton"}, {"restitution": None, "strength": "30 MPa", **BOTH}, {}),
}


def impacts_from(scene, columns, restitution=None):
    material = Material(**{name: columns[name] for name in ("density", "youngs_modulus", "poisson_ratio")})
    viscous = {key: np.nan_to_num(columns[key], nan=1.0) for key in ("viscous_restitution",) if key in columns}
    law = (
        WaltonBraun(restitution=columns["asked_restitution"], **viscous)
        if (scene.impact.dissipation == "walton-braun")
        else Thornton(yield_pressure=columns["yield_pressure"], **viscous)
    )
    return Impact(
        sphere=Sphere(material=material, radius=columns["radius"]),
        target=scene.body, velocity=columns["velocity"], stiffness="hertz", dissipation=law,
    )  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_holds_the_impacts_of_its_parameters(name):
    scene = SCENES[name]
    (rows,) = columns_of(plan(scene, "closed-form"), 200)
    impact = impacts_from(scene, rows.columns)
    for quantity in ("restitution", "peak_force", "contact_duration", "time_of_peak", "dissipated_energy"):
        assert rows.columns[quantity] == pytest.approx(getattr(impact, quantity), rel=1e-13)
    (batch,) = synthesise(scene, 200, dtype="float64")
    frames = impact.force_frames(200e3, 2048, batch.parameters["onset"])
    assert np.abs(batch.signals - frames).max() < 1e-10 * frames.max()
    viscous = rows.columns.get("viscous_restitution", np.ones(200))
    assert np.array_equal(batch.parameters.get("viscous_restitution", viscous), viscous)
    assert (batch.parameters["restitution"] <= viscous + TOLERANCE).all()
    assert parse_scene(json.loads(scene.text)).text == scene.text
    integrated = "those with viscous loss integrated" in plan(scene).decisions["impacts"].why
    assert integrated == ("viscous_restitution" in rows.columns) == ("alone" not in name)


def test_viscous_loss_is_drawn_apart_from_crushing():
    batches = list(synthesise(SCENES["thornton"], 2048))
    pressure, viscous = (
        np.concatenate([one.parameters[name] for one in batches]) for name in ("yield_pressure", "viscous_restitution")
    )
    assert abs(np.corrcoef(pressure, viscous)[0, 1]) < 0.07
    assert viscous.min() >= 0.4 and viscous.max() <= 0.95 and viscous.mean() == pytest.approx(0.675, abs=0.02)


def test_only_some_populations_may_damp_as_they_crush():
    rock = {key: value for key, value in {**POPULATION, **CRUSHED}.items() if value is not None}
    scene = scene_of({"dissipation": "thornton"}, None, {}, populations=[{**rock, **BOTH}, {**rock, "label": "gangue"}])
    (batch,) = synthesise(scene, 256, dtype="float64")
    has = np.isfinite(batch.parameters["viscous_restitution"])
    assert np.array_equal(has, batch.labels == "coal")
    impact = impacts_from(scene, batch.parameters)
    assert batch.parameters["restitution"] == pytest.approx(impact.restitution, rel=1e-13)
    frames = impact.force_frames(200e3, 2048, batch.parameters["onset"])
    assert np.abs(batch.signals - frames).max() < 1e-10 * frames.max()


def test_rocks_keep_their_viscous_loss_in_a_stream():
    scene = scene_of(
        {"dissipation": "thornton"}, {**CRUSHED, **BOTH}, {}, sampling={"sampling_rate": 100e3},
        stream={"duration": "5 s", "arrivals": {"rate": "4 Hz"}, "rebounds": {"most": 3, "least_speed": "0.05 m/s"}},
    )  # fmt: skip
    _, truth = record(scene, 3)
    assert (truth["bounce"] == 1).any()
    for rock in np.unique(truth["rock"]):
        rows = np.flatnonzero(truth["rock"] == rock)
        assert np.ptp(truth["viscous_restitution"][rows]) == 0
        assert truth["velocity"][rows[1:]] == pytest.approx((truth["restitution"] * truth["velocity"])[rows[:-1]])


def test_a_scene_of_crushing_rocks_becomes_one_that_also_damps():
    scene = varied(SCENES["thornton"], viscous_restitution=0.7)
    assert next(iter(synthesise(scene, 9))).parameters["viscous_restitution"] == pytest.approx(0.7)
    assert varied(scene, viscous_restitution=None) == scene_of({"dissipation": "thornton"}, CRUSHED, {})


def crushing_on(name, **impact):
    """Return a shipped scene whose rocks crush, with other settings of its impact."""
    content = tomllib.loads(scene_path(name).read_text())
    content["impact"] |= {"dissipation": "thornton"} | impact
    for population in content["populations"]:
        del population["restitution"]
        population |= {"yield_pressure": uniform("20 MPa", "90 MPa"), "viscous_restitution": uniform(0.5, 0.9)}
    return parse_scene(content)


def test_rocks_crush_on_a_plate_with_their_weight():
    steel = {"density": 7850.0, "youngs_modulus": "210 GPa", "poisson_ratio": 0.3, "thickness": "30 mm"}
    scene = crushing_on("reference", gravity=9.81, target=steel)
    values = draw(scene, 3, 0).parameters
    rock = Material(**{name: values[name] for name in ("density", "youngs_modulus", "poisson_ratio")})
    impact = Impact(
        sphere=Sphere(material=rock, radius=values["radius"]), target=scene.body, velocity=values["velocity"],
        stiffness="hertz", gravity=9.81, dissipation=Thornton(
            yield_pressure=values["yield_pressure"], viscous_restitution=values["viscous_restitution"],
        ),
    )  # fmt: skip
    assert (impact.radiated_energy > 0).all()
    for name in ("restitution", "peak_force", "contact_duration"):
        assert values[name] == pytest.approx(getattr(impact, name), rel=1e-12)


def test_rocks_crush_on_a_tail_beam():
    drawn = draw(crushing_on("tail_beam"), 3, 0)
    assert {type(strike.pulses).__name__ for strike in drawn.strikes} == {"Contacts", "ModalContacts"}
    for strike in drawn.strikes:
        pulses, given = (
            strike.pulses,
            {name: getattr(strike.pulses, name) for name in strike.pulses.__dataclass_fields__},
        )
        public = (ModalImpact if isinstance(pulses, ModalImpact) else Impact)(**given)
        assert isinstance(public.dissipation, Thornton)
        assert drawn.parameters["peak_force"][strike.rows] == pytest.approx(public.peak_force, rel=1e-12)
        assert (public.radiated_energy > 0).all()


def test_a_plate_that_bilinear_rocks_do_not_leave_is_refused():
    """Spring, mass and impedance of the plate are overdamped: the rock comes to rest and never leaves."""
    content = tomllib.loads(scene_path("reference").read_text())
    steel = {"density": 7850.0, "youngs_modulus": "210 GPa", "poisson_ratio": 0.3, "thickness": "20 mm"}
    content["impact"] |= {"dissipation": "walton-braun", "target": steel}
    with pytest.raises(BadData, match=r"populations\.0: .* must rebound"):
        parse_scene(content)
