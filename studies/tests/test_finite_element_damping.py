"""Damped finite elements against Kuwabara and Kono, implicit against explicit steps, and what a user can do wrong."""

import re
import warnings
from dataclasses import FrozenInstanceError, replace
from functools import cache

import numpy as np
import pytest

from cgid.errors import CgidError, InvalidValue
from cgid.physics import (
    STEEL,
    HertzRangeWarning,
    HuntCrossley,
    Material,
    Sphere,
    Viscoelastic,
    damping_number,
    delivered_restitution,
)
from cgid.physics.contact.bodies import sphere_share
from studies.finite_element import ElasticPlate, FiniteElementImpact, PenaltyContact
from studies.tests.finite_element_cases import RADIUS, impact, plate, sphere, velocity_for
from tests import few

#: Retardation times [s], up to the largest that is promised.
DELAYS = (1e-6, 3e-6, 10e-6)


@cache
def damped(number, velocity, delay):
    """Return the history of an impact of a sphere of Kelvin and Voigt's, 300 implicit steps in the contact."""
    there = impact(number, velocity, retardation_time=delay, method="implicit")
    return replace(there, time_step=float(there.hertz.contact_duration) / 300).run()


def kuwabara_kono(number, velocity, delay):
    """Return the theory's impact, A = 3/2 b s."""
    elastic = impact(number, velocity).hertz
    share = float(sphere_share(elastic.sphere, elastic.target))
    return replace(elastic, dissipation=Viscoelastic(dissipative_constant=1.5 * delay * share))


# ---------------------------------------------------------------------------------------------------- Kelvin-Voigt


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize(("number", "velocity"), few([(1, 2.0), (3, 10.0), (3, 2.0), (1, 5.0)], 2))
def test_kelvin_voigt_is_kuwabara_kono(number, velocity, delay):
    theory = float(kuwabara_kono(number, velocity, delay).restitution)
    assert theory < 0.99
    assert damped(number, velocity, delay).restitution == pytest.approx(theory, abs=0.01)


def test_the_slower_the_impact_the_nearer_to_kuwabara_kono():
    # Theirs is the first order in the rate, on a half space: what is left falls with the size of the contact.
    away = [
        abs(damped(1, velocity, 1e-5).restitution - float(kuwabara_kono(1, velocity, 1e-5).restitution))
        for velocity in (0.5, 2.0, 10.0)
    ]
    assert away[0] < 0.5 * away[1] < 0.25 * away[2]


def test_restitution_falls_with_speed_as_kuwabara_kono_says_not_as_hunt_crossley_does():
    speeds = np.array([0.5, 2.0])
    lost = [1 - damped(1, speed, 3e-6).restitution for speed in speeds]
    found = np.diff(np.log(lost))[0] / np.diff(np.log(speeds))[0]
    assert found == pytest.approx(0.2, abs=0.05)
    # Hunt-Crossley's chi, fitted at the lower speed.
    number = float(damping_number(1 - lost[0]))
    other = 1 - float(delivered_restitution(number * speeds[1] / speeds[0]))
    assert np.log(other / lost[0]) / np.log(speeds[1] / speeds[0]) > 0.8


@pytest.mark.parametrize(("number", "velocity"), [(1, 2.0), (3, 2.0)])
def test_the_pulse_is_kuwabara_konos_rather_than_hunt_crossleys(number, velocity):
    # Both laws at the restitution of the finite elements, stretched to their peak and duration: only the shape counts.
    history = damped(number, velocity, 1e-5)
    force = history.contact_force.samples
    away = {}
    theory = kuwabara_kono(number, velocity, 1e-5)
    for name, law in (
        ("kuwabara-kono", theory),
        ("hunt-crossley", replace(theory, dissipation=HuntCrossley(restitution=history.restitution))),
    ):
        expected = law.force(history.times * float(law.contact_duration) / history.contact_duration)
        away[name] = np.sqrt(np.mean((force / force.max() - expected / expected.max()) ** 2))
    assert away["kuwabara-kono"] < 0.6 * away["hunt-crossley"]
    assert away["hunt-crossley"] > 0.02


def test_damping_pushes_first_and_never_pulls():
    history = damped(1, 2.0, 1e-5)
    force = history.contact_force.samples
    assert force.min() == 0
    assert history.times[force.argmax()] < 0.49 * history.contact_duration
    assert history.energy_error is None
    # What it loses: the work of the force over the way of the mass centre.
    speed = np.diff(history.mass_centre_displacement.samples) * history.contact_force.sampling_rate
    assert -speed[-1] / 2.0 == pytest.approx(history.restitution, abs=0.01)


@pytest.mark.parametrize("damped_body", ["sphere", "plate"])
def test_damping_counts_by_the_share_of_its_body(damped_body):
    # Steel on thick steel: half of the compliance is in either, and so is half of the loss.
    delay, own = 5e-6, {"retardation_time": 5e-6}
    there = impact(
        sphere=Sphere(material=STEEL, radius=RADIUS),
        velocity=velocity_for(0.04, STEEL),
        method="implicit",
        plate=plate(thickness=0.03, radius=0.1, **own if damped_body == "plate" else {}),
        **own if damped_body == "sphere" else {},
    )
    there = replace(there, time_step=float(there.hertz.contact_duration) / 300)
    theory = replace(there.hertz, dissipation=Viscoelastic(dissipative_constant=0.75 * delay))
    assert float(theory.restitution) < 0.97
    assert there.run().restitution == pytest.approx(float(theory.restitution), abs=0.01)


# ------------------------------------------------------------------------------------------------ two ways through time


@pytest.mark.parametrize("delay", [0.0, 1e-6])
def test_implicit_goes_where_explicit_goes(delay):
    explicit = impact(retardation_time=delay, method="explicit").run()
    implicit = impact(retardation_time=delay, method="implicit").run()
    assert implicit.peak_force == pytest.approx(explicit.peak_force, rel=2e-3)
    assert implicit.peak_displacement == pytest.approx(explicit.peak_displacement, rel=1e-3)
    assert implicit.contact_duration == pytest.approx(explicit.contact_duration, rel=2e-3)
    assert implicit.restitution == pytest.approx(explicit.restitution, abs=1e-3)
    assert implicit.momentum_error < 1e-4
    here = np.interp(implicit.times, explicit.times, explicit.contact_force.samples)
    # With damping the force jumps as a ring of nodes touches, a step earlier or later.
    away = implicit.contact_force.samples - here
    assert np.sqrt(np.mean(away**2)) < 3e-3 * explicit.peak_force


def test_auto_takes_implicit_steps_where_damping_shortens_the_explicit_one():
    undamped, damped_much = impact(), impact(retardation_time=1e-5)
    assert (undamped.chosen_method, damped_much.chosen_method) == ("explicit", "implicit")
    assert damped_much.stable_time_step < undamped.stable_time_step / 20


def test_the_limit_of_stability_is_kept_with_damping():
    # Central differences with velocities half a step late: 2/w (sqrt(1 + z^2) - z), z = b w / 2.
    highest = 2 / impact(plate=plate(retardation_time=1e-6)).stable_time_step
    slow = impact(retardation_time=1e-6, plate=plate(retardation_time=1e-6))
    free = 2 / impact().stable_time_step
    z = 1e-6 * free / 2
    assert slow.stable_time_step == pytest.approx(2 / free * (np.sqrt(1 + z**2) - z), rel=1e-2)
    assert highest > free


def test_a_step_just_below_the_limit_is_stable():
    there = impact(elements=5, method="explicit")
    history = replace(there, time_step=0.999 * there.stable_time_step).run()
    assert history.energy_error < 1e-4
    assert history.peak_force == pytest.approx(impact(elements=5).run().peak_force, rel=5e-3)


# ---------------------------------------------------------------------------------------------------- what can go wrong


def numbers(message):
    """Return the numbers in a message."""
    return [float(one) for one in re.findall(r"(?<![\w.])\d+\.?\d*(?:e[+-]?\d+)?", message)]


def test_a_mesh_too_coarse_says_how_many_elements_it_needs():
    with pytest.raises(InvalidValue, match=r"elements.*contact radius.*got 3") as failed:
        impact(elements=3)
    needed = max(n for n in numbers(str(failed.value)) if n == int(n) and n < 50)
    there = impact(elements=int(needed))
    assert np.sum(there.pair.places < there.contact_radius) >= 7
    assert 5 <= needed <= 14


def test_an_element_size_too_large_says_which_is_small_enough():
    with pytest.raises(InvalidValue, match="element_size") as failed:
        impact(elements=None, element_size=3e-3)
    size = float(re.search(r"element_size of ([\d.]+) mm", str(failed.value))[1]) * 1e-3
    there = impact(elements=None, element_size=size)
    assert np.sum(there.pair.places < there.contact_radius) >= 7
    assert np.diff(there.pair.places).min() == pytest.approx(size, rel=0.15)


def test_a_step_over_the_limit_says_the_limit():
    there = impact(elements=5, method="explicit")
    with pytest.raises(InvalidValue, match=r"time_step.*stability.*implicit") as failed:
        replace(there, time_step=1.01 * there.stable_time_step).run()
    assert any(n == pytest.approx(there.stable_time_step, rel=1e-3) for n in numbers(str(failed.value)))


def test_large_strain_warns_and_then_fails():
    # Displacement over radius goes with v^(4/5).
    thick = plate(thickness=0.03)
    for velocity, strain in ((42.0, "0.109"), (50.0, "0.126")):
        with pytest.warns(HertzRangeWarning, match=f"reaches {strain}.*0.1"):
            impact(velocity=velocity, plate=thick)
    with pytest.raises(InvalidValue, match=r"radius must not pass 0\.1.*velocity"):
        impact(velocity=100.0, plate=thick)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        impact(velocity=30.0, plate=thick)


def test_a_plate_thinner_than_the_contact_radius_says_the_radius():
    radius = float(np.sqrt(RADIUS * impact().hertz.peak_displacement))
    with pytest.raises(InvalidValue, match=r"thickness.*contact radius.*thicker") as failed:
        impact(plate=plate(thickness=0.9 * radius))
    assert any(n == pytest.approx(radius * 1e3, rel=0.01) for n in numbers(str(failed.value)))
    assert impact(plate=plate(thickness=1.01 * radius)).n_nodes > 100


def coal(**changes):
    return Material(**{"density": 1380.0, "youngs_modulus": 2.26e9, "poisson_ratio": 0.28} | changes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"velocity": 0.0}, "velocity must be above 0"),
        ({"velocity": -1.0}, "velocity must be above 0"),
        ({"velocity": np.nan}, "velocity must be finite"),
        ({"velocity": "fast"}, "velocity"),
        ({"velocity": np.array([1.0, 2.0])}, "velocity must be one number"),
        ({"retardation_time": -1e-6}, "retardation_time"),
        ({"retardation_time": np.inf}, "retardation_time"),
        ({"retardation_time": 1e300, "method": "explicit"}, "retardation_time"),
        ({"elements": 0}, "elements"),
        ({"elements": 7.5}, "elements"),
        ({"elements": "7"}, "elements"),
        ({"elements": 10**6}, "elements"),
        ({"element_size": 1e-3}, "one of them"),
        ({"elements": None, "element_size": -1e-3}, "element_size"),
        ({"method": "best"}, "method must be one of"),
        ({"time_step": 0.0}, "time_step"),
        ({"time_step": np.nan}, "time_step"),
        ({"time_step": 1.0, "method": "implicit"}, "time_step"),
        ({"time_step": 1e-15, "method": "implicit"}, "time_step"),
        ({"time_step": 1e-15, "method": "explicit"}, "time_step"),
        ({"sphere": "a sphere"}, "sphere must be a Sphere"),
        ({"plate": STEEL}, "plate must be an? ElasticPlate"),
        ({"penalty": 0.1}, "penalty must be a PenaltyContact"),
        ({"sphere": Sphere(material=coal(), radius=np.array([0.02, 0.03]))}, "radius must be one number"),
        ({"sphere": Sphere(material=coal(density=np.array([1e3, 2e3])), radius=0.02)}, "density must be one number"),
        ({"sphere": Sphere(material=coal(poisson_ratio=0.49), radius=0.02)}, "poisson_ratio"),
        ({"plate": plate(radius=0.01)}, "radius of the plate"),
        ({"plate": plate(radius=1e6)}, "radius"),
        ({"elements": 200}, "elements"),
        ({"retardation_time": 5e-5, "penalty": PenaltyContact(factor=1e-7)}, "contact must stay within 2.3 times"),
    ],
    ids=lambda value: None if isinstance(value, str) else "-".join(map(str, value)),
)
def test_bad_input_is_named(changes, says):
    with pytest.raises(InvalidValue, match=says):
        impact(**changes).run()


@pytest.mark.parametrize(
    ("kind", "changes", "says"),
    [
        (plate, {"thickness": 0.0}, "thickness"),
        (plate, {"thickness": np.array([0.01, 0.02])}, "thickness must be one number"),
        (plate, {"radius": -1.0}, "radius"),
        (plate, {"radius": np.inf}, "radius"),
        (plate, {"lower_face": "glued"}, "lower_face must be one of"),
        (plate, {"lower_face": None}, "lower_face must be one of"),
        (plate, {"material": "steel"}, "material must be a Material"),
        (plate, {"retardation_time": -1.0}, "retardation_time"),
        (PenaltyContact, {"factor": 0.0}, "factor"),
        (PenaltyContact, {"factor": np.nan}, "factor"),
        (PenaltyContact, {"factor": np.array([0.1, 1.0])}, "factor must be one number"),
    ],
)
def test_bad_parts_are_named(kind, changes, says):
    with pytest.raises(InvalidValue, match=says):
        kind(**changes)


def test_what_was_checked_cannot_change():
    for thing, name in ((impact(), "velocity"), (plate(), "thickness"), (PenaltyContact(), "factor")):
        with pytest.raises(FrozenInstanceError):
            setattr(thing, name, -1.0)
    assert isinstance(impact(), FiniteElementImpact) and isinstance(plate(), ElasticPlate)


def test_progress_goes_from_touch_past_the_end_of_contact():
    seen = []
    there = impact(elements=5)
    history = there.run(progress=seen.append)
    assert len(seen) > 5
    assert seen == sorted(seen) and seen[0] > 0
    assert seen[-1] >= history.contact_duration / float(there.hertz.contact_duration)


def test_runs_repeat_to_the_last_bit():
    first, second = (impact(3, 2.0, 5).run() for _ in range(2))
    assert np.array_equal(first.contact_force.samples, second.contact_force.samples)
    assert sphere(3) == impact(3, 2.0, 5).sphere


@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_a_sphere_that_never_leaves_is_told(monkeypatch, method):
    # Two tenths of a contact are not enough for any sphere.
    monkeypatch.setattr("studies.finite_element.steps.LONGEST", 0.2)
    with pytest.raises(InvalidValue, match=r"must part from the plate, it still touches or nears it after .* s"):
        impact(method=method).run()


@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_a_contact_without_forces_is_no_result(monkeypatch, method):
    there = impact(method=method)
    monkeypatch.setitem(there.pair.__dict__, "soft_part", np.full(there.pair.gap.size, np.nan))
    with pytest.raises(CgidError, match="the contact found no set of nodes"):
        there.run()


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.longdouble])
@pytest.mark.parametrize(("method", "step"), [("explicit", 5e-8), ("implicit", 1e-6)])
def test_small_types_of_numpy_are_numbers_as_others(kind, method, step):
    # In their own arithmetic they would round on every step, or wrap.
    step = kind(step)
    there = impact(method=method, elements=5, time_step=step, plate=plate(thickness=np.float16(0.008)))
    same = impact(method=method, elements=5, time_step=float(step), plate=plate(thickness=float(np.float16(0.008))))
    np.testing.assert_array_equal(there.run().contact_force.samples, same.run().contact_force.samples)


def test_whole_numbers_of_eight_bits_do_not_wrap():
    wide = plate(thickness=np.uint8(1), radius=np.array(17, np.uint8))
    assert (wide.thickness, wide.radius, type(wide.radius)) == (1.0, 17.0, float)
    assert impact(elements=5, plate=wide).pair.plate.mass[1::2].sum() == pytest.approx(np.pi * 17**2 * 7850)


@pytest.fixture(scope="module")
def light_disc():
    """An impact whose contact is too short for its steps, and the step that is proposed for it [s]."""
    # A light disc gives way: the contact is over long before Hertz's theory would have it.
    light = Material(density=434.0, youngs_modulus=22.3e9, poisson_ratio=0.149)
    there = impact(
        sphere=Sphere(material=Material(density=1759.0, youngs_modulus=589e9, poisson_ratio=-0.058), radius=7.33),
        plate=ElasticPlate(material=light, thickness=0.15, radius=0.771, lower_face="free"),
        velocity=2e-4,
        elements=5,
        method="implicit",
    )
    with pytest.raises(InvalidValue, match="a 50th of the contact") as refused:
        there.run()
    return there, float(re.search(r"use (\S+) s", str(refused.value))[1])


def test_a_contact_of_a_few_steps_is_refused(light_disc):
    there, proposed = light_disc
    assert 0 < proposed < 0.1 * float(there.hertz.contact_duration)


@pytest.mark.long
def test_the_step_that_is_proposed_does(light_disc):
    there, proposed = light_disc
    coarse, fine = (replace(there, time_step=proposed / n).run() for n in (1, 2))
    assert coarse.peak_force == pytest.approx(fine.peak_force, rel=5e-3)
