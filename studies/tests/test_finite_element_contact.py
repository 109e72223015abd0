"""Contact of the finite elements: Hertz's limit, contact that gives way, plates that are thin and wide."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cgid.physics import STEEL, YANG2018_SPHERES, Sphere, ThinPlate
from studies.finite_element import ElasticPlate, PenaltyContact
from studies.finite_element.mesh import bulk_modulus
from studies.tests.finite_element_cases import RADIUS, VOLUME, impact, plate, velocity_for
from tests import few

# ---------------------------------------------------------------------------------------------------- Hertz's limit


@pytest.fixture(scope="module")
def narrow():
    """A steel sphere on thick steel, the contact radius a hundredth of R: Hertz's limit, and both bodies alike."""
    velocity = velocity_for(0.01, STEEL)
    slow = impact(
        sphere=Sphere(material=STEEL, radius=RADIUS),
        plate=plate(thickness=0.025, radius=0.1),
        velocity=velocity,
        elements=10,
        method="implicit",
    )
    slow = replace(slow, time_step=float(slow.hertz.contact_duration) / 300)
    return slow, slow.run()


def test_hertz_limit(narrow):
    slow, history = narrow
    theory = slow.hertz
    radius = np.sqrt(RADIUS * float(theory.peak_displacement))
    assert radius == pytest.approx(0.01 * RADIUS, rel=1e-6)
    assert history.peak_force == pytest.approx(float(theory.peak_force), rel=0.015)
    assert history.peak_displacement == pytest.approx(float(theory.peak_displacement), rel=0.015)
    assert history.contact_duration == pytest.approx(float(theory.contact_duration), rel=0.015)
    assert history.contact_radius.samples.max() == pytest.approx(radius, rel=0.015)
    assert history.restitution == pytest.approx(1, abs=1e-3)


def test_pressure_of_the_hertz_limit(narrow):
    slow, history = narrow
    radius = np.sqrt(RADIUS * float(slow.hertz.peak_displacement))
    largest = 1.5 * float(slow.hertz.peak_force) / (np.pi * radius**2)
    assert history.peak_pressure == pytest.approx(largest, rel=0.015)
    expected = largest * np.sqrt(np.maximum(1 - (history.radii / radius) ** 2, 0))
    within = history.radii < radius
    assert np.sqrt(np.mean((history.pressures - expected)[within] ** 2)) < 0.015 * largest
    assert (history.pressures >= 0).all()
    # Pressures and radii are those of rings: together they carry the force.
    carried = np.trapezoid(2 * np.pi * history.radii * history.pressures, history.radii)
    assert carried == pytest.approx(history.peak_force, rel=0.01)


def test_course_of_the_hertz_limit(narrow):
    slow, history = narrow
    expected = slow.hertz.force(history.times * float(slow.hertz.contact_duration) / history.contact_duration)
    assert history.contact_force.samples == pytest.approx(expected, abs=0.015 * expected.max())
    # The square of the contact radius is R times the approach: between nodes, too, which lie a tenth of it apart.
    approach = slow.hertz.displacement(history.times * float(slow.hertz.contact_duration) / history.contact_duration)
    radius = np.sqrt(RADIUS * approach)
    away = history.contact_radius.samples - radius
    assert np.sqrt(np.mean(away[radius > 0] ** 2)) < 0.015 * radius.max()


def test_energy_of_the_hertz_limit_lies_in_both_bodies_by_their_compliance(narrow):
    slow, history = narrow
    whole = 0.5 * VOLUME * 7850 * slow.velocity**2
    stored = history.sphere_energy.samples + history.plate_energy.samples
    assert stored.max() == pytest.approx(whole, rel=1e-3)
    assert history.peak_sphere_energy / whole == pytest.approx(0.5, abs=0.01)
    assert history.peak_plate_energy / whole == pytest.approx(0.5, abs=0.01)


# ---------------------------------------------------------------------------------------------------- soft contact


@pytest.fixture(scope="module")
def hard():
    return impact().run()


@cache
def softened(factor, elements=7):
    return impact(elements=elements, penalty=PenaltyContact(factor=factor)).run()


def test_soft_contact_gives_way_as_a_layer_does(hard):
    # A layer of softness s [m/Pa] takes `s/2` times the integral of p^2. As long as it is little, Hertz's pressure
    # gives 9 s P^2 / (16 pi a^2), and at the same energy the sphere goes deeper by that over P.
    factor = 30.0
    soft = softened(factor)
    radius = hard.contact_radius.samples.max()
    size = impact().contact_radius / 7
    softness = size / (factor * min(bulk_modulus(YANG2018_SPHERES[1]), bulk_modulus(STEEL)))
    assert bulk_modulus(STEEL) == pytest.approx(175e9)
    expected = softness * 9 * hard.peak_force / (16 * np.pi * radius**2)
    assert soft.peak_displacement - hard.peak_displacement == pytest.approx(expected, rel=0.2)


def test_soft_contact_goes_with_factor_over_element_size(hard):
    assert softened(0.05, 14).peak_force == pytest.approx(softened(0.1, 7).peak_force, rel=5e-3)
    assert softened(0.1, 7).peak_force < 0.9 * hard.peak_force


def test_soft_contact_moves_the_elements_away_from_hertz_towards_the_series_theory(hard):
    series = replace(impact().hertz, stiffness="series")
    for name in ("peak_force", "peak_displacement", "contact_duration"):
        right, wrong, soft = (float(getattr(one, name)) for one in (hard, series, softened(0.1)))
        assert 0.25 < (soft - right) / (wrong - right) < 1.2, name
    assert softened(0.1).energy_error < 1e-6


# ---------------------------------------------------------------------------------------------------- thin plates


@pytest.mark.parametrize(("number", "velocity", "thickness"), few([(3, 2.0, 0.012), (3, 0.5, 0.008), (1, 2.0, 0.008)]))
def test_wide_free_plate_takes_what_zener_says(number, velocity, thickness):
    wide = impact(number, velocity, 5, plate=plate(thickness=thickness, radius=0.3, lower_face="free"))
    wider = replace(wide, plate=replace(wide.plate, radius=0.5))
    theory = replace(wide.hertz, target=ThinPlate(material=STEEL, thickness=thickness))
    assert 0.1 < float(theory.inelasticity) < 0.5
    history = wide.run()
    assert history.restitution == pytest.approx(float(theory.restitution), abs=0.01)
    assert history.contact_duration == pytest.approx(float(theory.contact_duration), rel=0.05)
    assert wider.run().restitution == pytest.approx(history.restitution, abs=1e-3)
    assert history.energy_error < 1e-6


def test_narrow_free_plate_throws_back():
    narrow = impact(1, 2.0, 5, plate=plate(radius=0.04, lower_face="free")).run()
    theory = replace(impact(1, 2.0).hertz, target=ThinPlate(material=STEEL, thickness=0.008))
    assert abs(narrow.restitution - float(theory.restitution)) > 0.05


@pytest.mark.long
@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_a_sphere_that_a_light_plate_runs_away_from_strikes_it_again(method):
    # The plate is as heavy as one and a half spheres: the first blow does not turn the sphere round.
    there = impact(
        sphere=Sphere(material=STEEL, radius=RADIUS),
        plate=ElasticPlate(material=STEEL, thickness=0.005, radius=0.1, lower_face="free"),
        velocity=5.0,
        elements=5,
        method=method,
    )
    history = there.run()
    touches = np.diff((history.contact_force.samples > 0).astype(int)) == 1
    assert touches.sum() == 2
    assert history.contact_duration > 3 * float(there.hertz.contact_duration)
    # Both blows together: the impulse is what the sphere's momentum changed by, and it rises in the end.
    force = history.contact_force
    impulse = force.samples.sum() / force.sampling_rate
    assert impulse == pytest.approx((1 + history.restitution) * float(there.sphere.mass) * 5.0, rel=1e-3)
    assert history.restitution == pytest.approx(0.368, abs=0.002)
