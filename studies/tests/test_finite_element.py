"""The finite elements against the theory of elasticity, against slow twins, and their balances."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import linalg

from cgid.physics import STEEL, YANG2018_SPHERES, Sphere
from studies.finite_element import FiniteElementImpact, History
from studies.finite_element.assembly import element_matrices
from studies.tests.element_twin import ElementTwin, lame, solid_of_revolution
from studies.tests.finite_element_cases import RADIUS, VOLUME, impact, plate, sphere, velocity_for
from studies.tests.impact_twin import BodyTwin, Course, ImpactTwin
from tests.free_sphere import frequencies, wave_speeds

#: Contact radius over R of the meshes here: about that of sphere 1 at 2 m/s.
NARROW = 0.1


def meshed(elements=7, share=NARROW, number=1):
    """Return sphere and plate of an impact whose contact radius is a share of R, by Hertz's theory."""
    velocity = velocity_for(share, YANG2018_SPHERES[number])
    return impact(number, velocity, elements, plate=plate(radius=0.05)).pair


def body_of(which):
    """Return one of the two bodies, and its material."""
    pair = meshed()
    return ((pair.sphere, YANG2018_SPHERES[1]), (pair.plate, STEEL))[which]


def natural_frequencies(stiffness, mass, fixed, count):
    """Return the lowest natural frequencies [Hz]; masses of 0 are allowed."""
    free = np.flatnonzero(~fixed)
    k, m = stiffness.tocsr()[free][:, free], sparse.diags_array(mass[free])
    squares = linalg.eigsh(k.tocsc(), count, m.tocsc(), sigma=-((2e3 * 2 * np.pi) ** 2), v0=np.ones(free.size))[0]
    return np.sqrt(np.maximum(np.sort(squares), 0)) / (2 * np.pi)


# ---------------------------------------------------------------------------------------------------- free sphere


@pytest.mark.parametrize("number", [1, 3])
def test_free_sphere_vibrates_as_lamb_says(number):
    # All modes up to y = 6: those of n = 0 to 4, one after the other, and nothing else but the sphere's own flight.
    scale = wave_speeds(sphere(number))[1] / (2 * np.pi * RADIUS)
    theory = [one for one, _ in frequencies(sphere(number), 9, below=6.0)]
    assert sorted({n for _, n in frequencies(sphere(number), 9, below=6.0)}) == [0, 1, 2, 3, 4]
    free = meshed(14, number=number).sphere
    found = natural_frequencies(free.stiffness, free.mass, free.fixed, len(theory) + 2)
    assert found[0] < 1e-3 * scale
    assert found[1:-1] == pytest.approx(theory, rel=0.01)
    assert found[-1] > 5.95 * scale


def test_moving_the_masses_of_the_contact_hardly_changes_the_modes():
    pair = meshed(14)
    theory = [one for one, _ in frequencies(sphere(1), 9, below=6.0)]
    found = natural_frequencies(pair.sphere.stiffness, pair.mass[: pair.n_sphere], pair.sphere.fixed, len(theory) + 1)
    assert found[1:] == pytest.approx(theory, rel=0.01)


def test_frequencies_converge_with_the_square_of_the_element_size():
    theory = np.array([one for one, _ in frequencies(sphere(1), 9, below=6.0)])
    errors = []
    for elements in (6, 12):
        free = meshed(elements).sphere
        errors.append(natural_frequencies(free.stiffness, free.mass, free.fixed, len(theory) + 1)[1:] / theory - 1)
    order = np.log2(np.linalg.norm(errors[0]) / np.linalg.norm(errors[1]))
    assert 1.7 < order < 2.4


# ---------------------------------------------------------------------------------------------------- elements


@pytest.mark.parametrize("which", [0, 1])
def test_elements_are_those_of_the_slow_twin(which):
    (own, material), mesh = body_of(which), body_of(which)[0].mesh
    stiffness, mass = element_matrices(mesh, material)
    assert own.mass[::2] == pytest.approx(np.bincount(mesh.elements.ravel(), mass.ravel()), rel=0.02)
    some = np.arange(0, len(mesh.elements), 7)
    twin = ElementTwin(mesh.nodes[mesh.elements[some]], material, points=2)
    expected = twin.stiffness()
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert stiffness[some] / scale == pytest.approx(expected / scale, abs=1e-9)
    # The mass is a polynomial that two points integrate exactly.
    fine = ElementTwin(mesh.nodes[mesh.elements[some]], material, points=6).mass()
    assert mass[some] == pytest.approx(fine, rel=1e-9)


@pytest.mark.parametrize("which", [0, 1])
def test_even_strain_is_exact(which):
    # u_r = a r, u_z = b z: the same stress everywhere, so forces are at the surface only, and the energy is known.
    matrices, material = body_of(which)
    mesh = matrices.mesh
    a, b = 2e-3, -1e-3
    first, second = lame(material)
    density = first / 2 * (2 * a + b) ** 2 + second * (2 * a**2 + b**2)
    moved = (mesh.nodes * [a, b]).ravel()
    force = matrices.stiffness @ moved
    expected = density * solid_of_revolution(mesh.nodes, mesh.elements)
    assert force @ moved / 2 == pytest.approx(expected, rel=1e-12)
    within = np.setdiff1d(np.arange(len(mesh.nodes)), boundary_nodes(mesh))
    assert np.abs(force.reshape(-1, 2)[within]).max() < 1e-12 * np.abs(force).max()
    # Nothing holds a body along z, and every force has its counterforce.
    lifted = matrices.stiffness @ np.tile([0.0, 1.0], len(mesh.nodes))
    assert np.abs(lifted).max() < 1e-12 * abs(matrices.stiffness.diagonal()).max()
    assert abs(matrices.stiffness - matrices.stiffness.T).max() < 1e-12 * abs(matrices.stiffness).max()


def boundary_nodes(mesh):
    """Return the nodes of edges that belong to one element only."""
    edges = np.sort(np.stack((mesh.elements, np.roll(mesh.elements, -1, axis=1)), axis=-1).reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    return np.unique(edges[count == 1])


@pytest.mark.parametrize("elements", [5, 8, 14])
@pytest.mark.parametrize("share", [0.01, 0.1, 0.3])
def test_meshes_have_no_cracks_and_no_folds(elements, share):
    pair = meshed(elements, share)
    ball, slab = pair.sphere.mesh, pair.plate.mesh
    for mesh in (ball, slab):
        corners = mesh.nodes[mesh.elements]
        along = np.roll(corners, -1, axis=1) - corners
        turned = np.roll(along, -1, axis=1)
        assert (along[..., 0] * turned[..., 1] - along[..., 1] * turned[..., 0] > 0).all()
        assert np.array_equal(np.unique(mesh.elements), np.arange(len(mesh.nodes)))
    # Edges of one element only lie on the axis or on the surface.
    r, z = ball.nodes[boundary_nodes(ball)].T
    assert (np.minimum(r, np.abs(np.hypot(r, z - RADIUS) - RADIUS)) < 1e-8 * RADIUS).all()
    r, z = slab.nodes[boundary_nodes(slab)].T
    edges = np.minimum.reduce([r, -z, np.abs(r - 0.05), np.abs(z + 0.008)])
    assert (edges < 1e-9).all()
    assert solid_of_revolution(slab.nodes, slab.elements) == pytest.approx(np.pi * 0.05**2 * 0.008, rel=1e-12)
    assert solid_of_revolution(ball.nodes, ball.elements) == pytest.approx(VOLUME, rel=0.02)
    # Node upon node, about as many over the contact radius as asked for.
    assert slab.nodes[slab.contact, 0] == pytest.approx(ball.nodes[ball.contact, 0], abs=1e-15)
    inside = np.sum(ball.nodes[ball.contact, 0] <= share * RADIUS * (1 + 1e-9))
    assert inside == pytest.approx(elements + 1, rel=0.15, abs=1)


# ---------------------------------------------------------------------------------------------------- a slow impact


@dataclass(frozen=True)
class Twins:
    """One impact by cgid and by its slow twin, on a plate so small that its own swinging counts."""

    impact: FiniteElementImpact
    divided: int = 4

    @cached_property
    def sphere(self) -> BodyTwin:
        return BodyTwin(self.impact.pair.sphere.mesh, self.impact.sphere.material, [], VOLUME)

    @cached_property
    def plate(self) -> BodyTwin:
        own = self.impact.plate
        return BodyTwin(self.impact.pair.plate.mesh, own.material, [], np.pi * own.radius**2 * own.thickness)

    @cached_property
    def histories(self) -> list[History]:
        """With a step near the limit, and with one divided."""
        step = 0.9 * self.impact.stable_time_step
        return [small_impact(time_step=step / part).run() for part in (1, self.divided)]

    @cached_property
    def places(self):
        return np.arange(0, len(self.histories[1].contact_force.samples), 12)

    @cached_property
    def course(self) -> Course:
        ball = self.impact.pair.sphere.mesh
        twin = ImpactTwin(self.sphere, self.plate, ball.nodes[ball.contact, 1], self.impact.velocity)
        centre = int(np.argmin(np.hypot(ball.nodes[:, 0], ball.nodes[:, 1] - RADIUS)))
        return twin.run(self.histories[1].times[self.places], centre)


def small_impact(**changes):
    return impact(elements=5, plate=plate(radius=0.03, lower_face="free"), method="explicit", **changes)


@pytest.fixture(scope="module")
def twins():
    return Twins(small_impact())


@pytest.mark.long
def test_slow_twin_keeps_its_energy(twins):
    course = twins.course
    energy = course.sphere_energy + course.plate_energy + course.kinetic_energy
    assert energy == pytest.approx(energy[0] * np.ones(energy.size), rel=1e-6)
    assert energy[0] == pytest.approx(0.5 * VOLUME * 1380 * 10.0**2, rel=1e-9)


@pytest.mark.long
def test_explicit_steps_go_where_the_slow_twin_goes(twins):
    history, course, mass = twins.histories[1], twins.course, VOLUME * 1380
    pairs = {
        "force": (history.contact_force, course.force, 1e-3),
        "centre": (history.centre_displacement, -course.centre, 1e-4),
        "sphere": (history.sphere_energy, course.sphere_energy, 1e-3),
        "plate": (history.plate_energy, course.plate_energy, 1e-3),
    }
    for name, (signal, expected, bound) in pairs.items():
        assert signal.samples[twins.places] == pytest.approx(expected, abs=bound * np.abs(expected).max()), name
    # The centre rings at the frequencies that the mesh just carries: there steps of time tell most.
    found = history.centre_node_force.samples[twins.places]
    expected = mass * course.acceleration
    assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(expected)


@pytest.mark.long
def test_restitution_converges_to_that_of_the_slow_twin(twins):
    expected = -twins.course.momentum[-1] / twins.course.momentum[0]
    errors = [abs(history.restitution - expected) for history in twins.histories]
    assert errors[0] < 1e-4
    assert errors[1] < errors[0] / (twins.divided**2 / 2) + 1e-7


@pytest.mark.long
def test_stable_step_is_that_of_the_highest_frequency(twins):
    highest = np.sqrt(max(twins.sphere.squares[-1], twins.plate.squares[-1]))
    assert 0.95 * 2 / highest < twins.impact.stable_time_step <= 2 / highest * (1 + 1e-6)


@pytest.mark.long
def test_energy_error_is_the_steps(twins):
    errors = [history.energy_error for history in twins.histories]
    assert 0 < errors[1] < errors[0] / (twins.divided**2 / 2)


# ---------------------------------------------------------------------------------------------------- balances


@pytest.fixture(scope="module")
def quick():
    """Sphere 1 at 10 m/s, elements that are just enough."""
    return impact().run()


def test_energy_and_momentum_are_kept(quick):
    assert quick.energy_error < 1e-6
    assert quick.momentum_error < 1e-6
    # The signals say so, too: the impulse of the force is the change of momentum, and moves the mass centre.
    force, rate = quick.contact_force.samples, quick.contact_force.sampling_rate
    mass = VOLUME * 1380
    assert np.trapezoid(force) / rate == pytest.approx((1 + quick.restitution) * mass * 10.0, rel=1e-5)
    speed = 10.0 - np.concatenate(([0], np.cumsum((force[1:] + force[:-1]) / 2))) / rate / mass
    way = np.concatenate(([0], np.cumsum((speed[1:] + speed[:-1]) / 2))) / rate
    assert quick.mass_centre_displacement.samples == pytest.approx(way, abs=1e-5 * way.max())


def test_no_more_energy_is_stored_than_the_flight_has_lost(quick):
    mass = VOLUME * 1380
    speed = np.gradient(-quick.mass_centre_displacement.samples) * quick.contact_force.sampling_rate
    lost = 0.5 * mass * (10.0**2 - speed**2)[1:-1]
    stored = (quick.sphere_energy.samples + quick.plate_energy.samples)[1:-1]
    whole = 0.5 * mass * 10.0**2
    assert (stored <= lost + 2e-3 * whole).all()
    # At the largest force hardly anything moves.
    assert stored.max() == pytest.approx(whole, rel=0.03)


def test_elastic_impacts_have_no_scale(quick):
    # Twice as large in everything at the same speed: forces x 4, times and ways x 2, the same rebound.
    twice = Sphere(material=YANG2018_SPHERES[1], radius=2 * RADIUS)
    large = impact(sphere=twice, plate=plate(thickness=0.016, radius=0.4)).run()
    assert large.peak_force == pytest.approx(4 * quick.peak_force, rel=1e-9)
    assert large.contact_duration == pytest.approx(2 * quick.contact_duration, rel=1e-9)
    assert large.peak_displacement == pytest.approx(2 * quick.peak_displacement, rel=1e-9)
    assert large.peak_pressure == pytest.approx(quick.peak_pressure, rel=1e-9)
    assert large.restitution == pytest.approx(quick.restitution, rel=1e-9)


def test_signals_belong_together(quick):
    named = [value for value in vars(quick).values() if hasattr(value, "sampling_rate")]
    assert len(named) == 8
    assert len({(len(one.samples), one.sampling_rate) for one in named}) == 1
    force = quick.contact_force.samples
    assert force.min() == 0 and force[-1] == 0
    assert len(force) / quick.contact_force.sampling_rate > quick.contact_duration
    quantities = [quick.contact_force, quick.contact_pressure, quick.contact_radius, quick.sphere_energy]
    assert [one.quantity for one in quantities] == ["force", "pressure", "displacement", "energy"]
