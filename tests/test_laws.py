"""The laws of loss: damping factors, viscoelastic spheres, thin plates, gravity, their energy, and their inverses."""

import linecache
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import beta

from cgid.errors import InvalidValue
from cgid.physics import (
    HUNT_CROSSLEY_LAWS,
    RIGID,
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
    ThinPlateWarning,
    Viscoelastic,
)
from studies.paper.sensitivity import dissipative_constant, plate_thickness
from tests import naive
from tests.test_impact import impulse_by_quadrature

PLATE = ThinPlate(material=STEEL, thickness=0.008)
QUANTITIES = ("restitution", "peak_displacement", "peak_force", "contact_duration", "time_of_peak", "compression_time",
              "end_displacement", "rebound_velocity", "impulse", "radiated_energy", "dissipated_energy")  # fmt: skip


def coal_on(target, dissipation=None, velocity=2.0, radius=0.025, number=1, gravity=0.0):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[number], radius=radius),
        target=target,
        velocity=velocity,
        stiffness="hertz",
        dissipation=dissipation or Elastic(),
        gravity=gravity,
        tolerance=1e-12,
    )


ON_STEEL = coal_on(HalfSpace(material=STEEL))


def viscoelastic(zeta, target=None, **changes):
    impact = coal_on(target or HalfSpace(material=STEEL), **changes)
    return replace(impact, dissipation=Viscoelastic(dissipative_constant=zeta * impact.time_scale))


def plate_of(inelasticity, dissipation=None, gravity=0.0):
    """Return the coal sphere at 2 m/s on a steel plate of this lambda, by the definition of lambda and of Z."""
    impedance = ON_STEEL.reduced_mass / (np.asarray(inelasticity) * ON_STEEL.time_scale)
    # Z = 8 sqrt(B rho h), B = E h^3 / (12 (1 - nu^2)), solved for h
    thickness = (impedance**2 / 64 / STEEL.density * 12 * (1 - STEEL.poisson_ratio**2) / STEEL.youngs_modulus) ** 0.25
    return coal_on(ThinPlate(material=STEEL, thickness=thickness), dissipation, gravity=gravity)


def at_contact_nodes(impact, n=240):
    """Return times and weights of Gauss's rule over the contact of a single impact, in theta (see `test_impact`)."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    theta = (nodes + 1) / 2
    duration = float(impact.contact_duration)
    return duration * np.sin(np.pi / 2 * theta) ** 2, weights / 2 * duration * np.pi / 2 * np.sin(np.pi * theta)


def hysteresis_loop(impact, n=240):
    """Return the integral of P d(delta) over a single impact [J]: the displacement by its Chebyshev series in theta."""
    duration = float(impact.contact_duration)

    def times(theta):
        return duration * np.sin(np.pi / 2 * theta) ** 2

    series = np.polynomial.chebyshev.Chebyshev.interpolate(
        lambda theta: impact.displacement(times(theta)), n, domain=[0, 1]
    )
    nodes, weights = np.polynomial.legendre.leggauss(n)
    theta = (nodes + 1) / 2
    return float((impact.force(times(theta)) * series.deriv()(theta) * weights / 2).sum())


# ---- damping factors --------------------------------------------------------------------------------------------

#: What each law delivers for .1, .5 and .9, and half the last printed digit.
DELIVERED = {
    "exact": ((0.1, 0.5, 0.9), 1e-15),
    "hunt-crossley": ((0.516, 0.663, 0.909), 5e-4),
    "herbert-mcwhannell": ((0.491, 0.594, 0.901), 5e-4),
    "lee-wang": ((0.687, 0.799, 0.952), 5e-4),
    "lankarani-nikravesh": ((0.665, 0.725, 0.913), 5e-4),
    "gonthier": ((0.101, 0.488, 0.876), 5e-4),
    "zhiying-qishao": ((0.2175, 0.483, 0.896), 5e-4),
    "flores": ((0.069, 0.470, 0.894), 5e-4),
    "hu-guo": ((0.074, 0.488, 0.900), 5e-4),
}


def test_every_law_is_in_the_table_of_this_test():
    assert set(DELIVERED) == set(HUNT_CROSSLEY_LAWS)


@pytest.mark.parametrize("law", DELIVERED)
def test_what_the_published_laws_deliver(law):
    printed, half_a_digit = DELIVERED[law]
    dissipation = HuntCrossley(restitution=[0.1, 0.5, 0.9], law=law)
    assert dissipation.delivered_restitution == pytest.approx(np.array(printed), rel=0, abs=half_a_digit)
    impact = replace(ON_STEEL, dissipation=dissipation)
    assert (impact.restitution == dissipation.delivered_restitution).all()
    measured = impulse_by_quadrature(impact) / (impact.reduced_mass * impact.velocity) - 1
    assert measured == pytest.approx(impact.restitution, abs=1e-12)


@pytest.mark.parametrize("law", DELIVERED)
@pytest.mark.parametrize("asked", [0.02, 0.3, 0.999])
def test_a_law_s_damping_number_gives_its_delivered_restitution(law, asked):
    """scipy integrates the equation with the law's D; the first integral takes no part."""
    dissipation = HuntCrossley(restitution=asked, law=law)
    slow = naive.Contact(damping=float(dissipation.damping_number))
    assert slow.restitution == pytest.approx(float(dissipation.delivered_restitution), rel=1e-11)
    impact = replace(ON_STEEL, dissipation=dissipation)
    assert float(impact.contact_duration / impact.time_scale) == pytest.approx(slow.contact_time, rel=1e-11)


# ---- viscoelastic spheres and thin plates -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inelasticity", "plate", "kuwabara_kono", "plate_time", "kuwabara_kono_time"),
    [
        (0.131, 0.800663, 0.803949, 3.299184, 3.102339),
        (0.5, 0.436895, 0.478838, 3.624441, 2.844551),
        (1.0, 0.184123, 0.281131, 4.387612, 2.596916),
    ],
)
def test_thin_plate_and_kuwabara_kono(inelasticity, plate, kuwabara_kono, plate_time, kuwabara_kono_time):
    on_plate, in_sphere = plate_of(inelasticity), viscoelastic(1.5 * inelasticity)
    assert float(on_plate.inelasticity) == pytest.approx(inelasticity, rel=1e-14)
    assert float(in_sphere.inelasticity) == 0
    for impact, e, time in ((on_plate, plate, plate_time), (in_sphere, kuwabara_kono, kuwabara_kono_time)):
        assert float(impact.restitution) == pytest.approx(e, abs=5e-7)
        assert float(impact.contact_duration / impact.time_scale) == pytest.approx(time, abs=5e-7)
        assert float(impact.rebound_velocity) == pytest.approx(2 * e, abs=1e-6)
    assert on_plate.end_displacement == 0
    # The displacement obeys one equation in both, until the viscoelastic sphere has left.
    times = np.linspace(0, float(in_sphere.contact_duration) * 0.999999, 200)
    both = on_plate.displacement(times), in_sphere.displacement(times)
    assert both[0] == pytest.approx(both[1], abs=1e-11 * float(on_plate.peak_displacement))
    just_before = in_sphere.displacement(float(in_sphere.contact_duration) * (1 - 1e-12))
    assert float(in_sphere.end_displacement) == pytest.approx(float(just_before), rel=1e-10)


def test_a_loss_counted_twice_would_give_the_plate_more_than_there_is():
    """The force on a rigid half space, fed into the plate: .45, 1.73, 2.08 of the sphere's energy."""
    elastic = coal_on(HalfSpace(material=STEEL))
    times, weights = at_contact_nodes(elastic)
    work = (elastic.force(times) ** 2 * weights).sum()
    for inelasticity, share in ((0.131, 0.45), (0.5, 1.73), (0.6, 2.08)):
        impact = plate_of(inelasticity)
        energy = 0.5 * impact.reduced_mass * 4
        assert float(work / impact.target.impedance / energy) == pytest.approx(share, abs=5.1e-3)
        assert float(impact.radiated_energy / energy) < 1


def test_lambda_of_the_paper_s_plate():
    def inelasticity(radius, velocity, number):
        return coal_on(PLATE, radius=radius, velocity=velocity, number=number).inelasticity

    assert f"{float(inelasticity(0.025, 2.0, 1)):.3f}" == "0.131"
    assert f"{float(inelasticity(0.05, 2.0, 1)):.3f}" == "0.526"
    with pytest.warns(
        ThinPlateWarning, match=r"lambda of the thin plate reaches 2\.\d+; Zener's theory is valid up to 1\.5"
    ):
        heavy = inelasticity(0.05, 5.0, 3)
    assert f"{float(heavy):.1f}" == "2.1"


def test_the_impedance_of_a_plate_by_its_definition():
    for material, h in ((STEEL, 0.008), (YANG2018_SPHERES[3], 0.03)):
        stiffness = material.youngs_modulus * h**3 / (12 * (1 - material.poisson_ratio**2))
        found = ThinPlate(material=material, thickness=h).impedance
        assert float(found) == pytest.approx(8 * np.sqrt(stiffness * material.density * h), rel=1e-14)


def test_kelvin_and_voigt_s_time_constant():
    """A = 3/2 b s, with the sphere's share s in the compliance of both bodies."""
    coal, b = YANG2018_SPHERES[1], 2e-6
    sphere = Sphere(material=coal, radius=0.025)
    own, steel = (1 - 0.28**2) / 2.26e9, (1 - 0.3**2) / 210e9
    for target, share in ((RIGID, 1.0), (HalfSpace(material=STEEL), own / (own + steel)), (sphere, 0.5),
                          (PLATE, own / (own + steel))):  # fmt: skip
        found, expected = (
            Impact(sphere=sphere, target=target, velocity=2.0, stiffness="hertz", dissipation=dissipation)
            for dissipation in (
                Viscoelastic(time_constant=b),
                Viscoelastic(dissipative_constant=1.5 * b * share),
            )
        )
        assert float(found.curves.numbers[0, 0]) == pytest.approx(1.5 * b * share / float(found.time_scale), rel=1e-14)
        assert float(found.restitution) == pytest.approx(float(expected.restitution), rel=1e-11)
        assert float(found.restitution) < 1


def test_viscoelastic_restitution_falls_with_speed_to_the_power_one_fifth():
    """1 - e = C zeta, and zeta = A v / L goes with v^(1/5) (Kuwabara & Kono 1987); Hunt-Crossley has no such trend."""
    velocity = np.array([0.01, 0.1, 1.0, 3.0])
    impact = coal_on(HalfSpace(material=STEEL), velocity=velocity, dissipation=Viscoelastic(dissipative_constant=1e-10))
    loss = 1 - impact.restitution
    assert np.diff(np.log(loss)) / np.diff(np.log(velocity)) == pytest.approx(0.2, abs=1e-5)
    constant = 0.8 * 1.25**0.6 * beta(0.6, 1.5)
    assert loss == pytest.approx(constant * 1e-10 / impact.time_scale, rel=1e-5)
    assert np.diff(viscoelastic(0.3, velocity=velocity).restitution) == pytest.approx(0, abs=1e-14)


def test_force_ends_at_zero_with_the_viscoelastic_sphere_still_flattened():
    for zeta in (1e-3, 0.3, 3.0):
        impact = viscoelastic(zeta)
        end = float(impact.contact_duration)
        before, at, after = impact.force(end * np.array([1 - 1e-9, 1.0, 1 + 1e-9])) / impact.peak_force
        assert 0 < before < 1e-8
        assert (at, after) == (pytest.approx(0, abs=1e-14), 0)
        # f = 0 where x = -zeta x' = zeta e
        flattened = zeta * impact.restitution * impact.length_scale
        assert float(impact.end_displacement) == pytest.approx(float(flattened), rel=1e-12)


# ---- energy and momentum ----------------------------------------------------------------------------------------

BALANCES = {
    "elastic": ON_STEEL,
    "hunt-crossley": replace(ON_STEEL, dissipation=HuntCrossley(restitution=0.5)),
    "hunt-crossley beyond the table": replace(ON_STEEL, dissipation=HuntCrossley(restitution=0.02)),
    "viscoelastic": viscoelastic(0.4),
    "plate": plate_of(0.5),
    "plate hunt-crossley": plate_of(0.5, HuntCrossley(restitution=0.5)),
    "plate viscoelastic": viscoelastic(0.2, PLATE),
    "gravity hunt-crossley": coal_on(HalfSpace(material=STEEL), HuntCrossley(restitution=0.5), gravity=400.0),
    "gravity viscoelastic": viscoelastic(0.2, gravity=400.0),
}


@pytest.mark.parametrize("name", BALANCES)
def test_the_material_s_loss_is_the_area_of_the_loop(name):
    impact = BALANCES[name]
    energy = float(0.5 * impact.reduced_mass * 4)
    assert hysteresis_loop(impact) / energy == pytest.approx(float(impact.dissipated_energy) / energy, abs=1e-11)
    fall = float(impact.reduced_mass * impact.gravity * impact.end_displacement)
    parts = energy * float(impact.restitution) ** 2 + impact.dissipated_energy + impact.radiated_energy
    assert float(parts) == pytest.approx(energy + fall, rel=1e-14)


# ---- gravity ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["elastic", "hunt-crossley", "viscoelastic", "plate"])
def test_gravity_that_weighs_nothing_changes_no_bit(name):
    """Where it would cost the table it is left out, to the last bit; where it is paid for it agrees."""
    times = np.linspace(0, 5e-4, 300)
    without = BALANCES[name]
    unit = float(4 / without.length_scale)  # g L / v^2 = 1
    weightless, weighs = replace(without, gravity=1e-13 * unit), replace(without, gravity=2e-12 * unit)
    energy = float(0.5 * without.reduced_mass * 4)
    for quantity in QUANTITIES:
        expected = getattr(without, quantity)
        if name in ("elastic", "hunt-crossley"):
            assert getattr(weightless, quantity) == expected, quantity
        scale = energy if quantity.endswith("energy") else float(expected)
        error = 1e-7 if quantity == "time_of_peak" else 1e-11  # a maximum is flat
        assert getattr(weighs, quantity) == pytest.approx(expected, rel=0, abs=error * scale), quantity
    if name in ("elastic", "hunt-crossley"):
        assert (weightless.force(times) == without.force(times)).all()
        assert (weightless.displacement(times) == without.displacement(times)).all()
        assert (weightless.force_frames(1e6, 400) == without.force_frames(1e6, 400)).all()
    assert np.abs(weighs.force(times) - without.force(times)).max() < 1e-10 * without.peak_force
    pull = float(weighs.impulse / without.impulse) - 1
    assert pull == pytest.approx(2e-12 * float(without.curves.times[0][0]) / (1 + float(without.restitution)), rel=0.5)


@pytest.mark.parametrize("name", ["hunt-crossley", "viscoelastic", "plate"])
def test_moderate_gravity_against_scipy_in_si_units(name):
    """m delta'' = m g - P, in seconds and metres, with chi, A and Z as they stand in the definitions."""
    gravity = 300.0
    impact = {
        "hunt-crossley": coal_on(HalfSpace(material=STEEL), HuntCrossley(restitution=0.4), gravity=gravity),
        "viscoelastic": coal_on(HalfSpace(material=STEEL), Viscoelastic(dissipative_constant=2e-5), gravity=gravity),
        "plate": coal_on(PLATE, gravity=gravity),
    }[name]
    own, steel = (1 - 0.28**2) / 2.26e9, (1 - 0.3**2) / 210e9
    mass, stiffness = 4 / 3 * np.pi * 0.025**3 * 1380, 4 / 3 * np.sqrt(0.025) / (own + steel)
    chi = float(impact.dissipation.damping_number) / 2.0 if name == "hunt-crossley" else 0.0
    constant = 2e-5 if name == "viscoelastic" else 0.0
    give = 1 / float(PLATE.impedance) if name == "plate" else 0.0

    def force(x, y):
        x = np.maximum(x, 0)
        return np.maximum(stiffness * (x**1.5 * (1 + chi * y) + constant * x**0.5 * y), 0)

    def rates(_time, state):
        p = force(*state)
        return [state[1] - give * p, gravity - p / mass]

    def held(time, state):
        return 1.0 if time == 0 else state[0] + constant * state[1]

    held.terminal, held.direction = True, -1
    solved = solve_ivp(rates, (0, 0.01), [0.0, 2.0], method="DOP853", rtol=1e-13, atol=1e-19, first_step=1e-12,
                       events=held, dense_output=True)  # fmt: skip
    end = solved.t_events[0][0]
    assert float(impact.contact_duration) == pytest.approx(end, rel=1e-11)
    assert float(impact.rebound_velocity) == pytest.approx(-solved.y_events[0][0][1], rel=1e-10)
    times = end * np.sin(np.pi / 2 * np.linspace(0, 1, 302)[1:-1]) ** 2
    state = solved.sol(times)
    assert np.abs(impact.displacement(times) - state[0]).max() < 1e-11 * float(impact.peak_displacement)
    assert np.abs(impact.force(times) - force(*state)).max() < 1e-11 * float(impact.peak_force)


def test_a_sphere_that_stays_on_the_target_is_said_with_the_cure():
    message = r"the sphere must rebound, but its weight holds it on the target \(restitution of the material 0\.5,.*"
    with pytest.raises(InvalidValue, match=message + "raise the velocity or the restitution, or leave gravity out"):
        coal_on(HalfSpace(material=STEEL), HuntCrossley(restitution=0.5), velocity=0.01, gravity=9.81)
    with pytest.raises(InvalidValue, match=r"its weight holds it on the target .* at index 1"):
        coal_on(HalfSpace(material=STEEL), HuntCrossley(restitution=0.5), velocity=[2.0, 0.01], gravity=9.81)


# ---- the loss for a wanted restitution --------------------------------------------------------------------------

WANTED = np.array([1e-4, 1e-3, 0.02, 0.3, 0.7, 0.99, 1 - 1e-4, 1 - 1e-6, 1 - 1e-9])


def test_dissipative_constant_gives_the_wanted_restitution():
    constant = dissipative_constant(WANTED, ON_STEEL)
    found = replace(ON_STEEL, dissipation=Viscoelastic(dissipative_constant=constant)).restitution
    assert found == pytest.approx(WANTED, abs=1e-11)
    # Where rounding of e hides A, the digits of 1 - e are those that A has.
    assert 1 - found[-2:] == pytest.approx(1 - WANTED[-2:], rel=1e-6)
    loss = 0.8 * 1.25**0.6 * beta(0.6, 1.5) * constant[-2:] / ON_STEEL.time_scale
    assert loss == pytest.approx([1e-6, 1e-9], rel=1e-5)


@pytest.mark.filterwarnings("ignore::cgid.physics.ThinPlateWarning")
def test_plate_thickness_gives_the_wanted_restitution():
    on_plate = coal_on(PLATE)
    thickness = plate_thickness(WANTED, on_plate)
    assert (np.diff(thickness) > 0).all()
    found = replace(on_plate, target=ThinPlate(material=STEEL, thickness=thickness)).restitution
    assert found == pytest.approx(WANTED, abs=1e-11)
    assert float(plate_thickness(on_plate.restitution, on_plate)) == pytest.approx(0.008, rel=1e-10)


def test_inverses_serve_a_plate_and_a_material_that_both_take_energy():
    lossy = coal_on(PLATE, HuntCrossley(restitution=0.6))
    thickness = plate_thickness([0.2, 0.59], lossy)
    found = replace(lossy, target=ThinPlate(material=STEEL, thickness=thickness)).restitution
    assert found == pytest.approx([0.2, 0.59], rel=1e-10)
    viscous = viscoelastic(0.1, PLATE)
    thickness = plate_thickness([0.2, 0.5], viscous)
    found = replace(viscous, target=ThinPlate(material=STEEL, thickness=thickness)).restitution
    assert found == pytest.approx([0.2, 0.5], rel=1e-10)
    constant = dissipative_constant([0.1, 0.5, 0.8], coal_on(PLATE, HuntCrossley(restitution=0.5)))
    found = replace(coal_on(PLATE), dissipation=Viscoelastic(dissipative_constant=constant)).restitution
    assert found == pytest.approx([0.1, 0.5, 0.8], rel=1e-10)


@pytest.mark.parametrize("wanted", [0.03, 0.01, 0.003])
def test_a_restitution_that_a_heavy_sphere_jumps_over_is_refused(wanted):
    """A viscoelastic sphere with g L / v^2 = .005 leaves with .038 at least; with a little more loss it stays."""
    heavy = coal_on(HalfSpace(material=STEEL), gravity=98.1)
    with pytest.raises(InvalidValue, match=r"restitution must be 0\.03[678]\d* or more"):
        dissipative_constant(wanted, heavy)


def test_restitutions_that_no_plate_gives_are_named():
    on_plate = coal_on(PLATE, HuntCrossley(restitution=0.6))
    with pytest.raises(InvalidValue, match=r"restitution must be between \S+e-0\d and 0\.6, .* got 0\.7"):
        plate_thickness(0.7, on_plate)
    with pytest.raises(InvalidValue, match=r"and 0\.6, .* got 1e-09"):
        plate_thickness(1e-9, on_plate)
    with pytest.raises(InvalidValue, match=r"impact\.target must be a ThinPlate, got HalfSpace"):
        plate_thickness(0.5, ON_STEEL)
    with pytest.raises(InvalidValue, match=r"do not broadcast against each other: restitution \(2,\), impact \(3,\)"):
        dissipative_constant([0.5, 0.6], coal_on(RIGID, velocity=[1.0, 2.0, 3.0]))
    # A plate of its own takes some of what the constant could leave.
    with pytest.raises(InvalidValue, match=r"and 0\.800\d+, which the impact has without this loss, got 0\.9"):
        dissipative_constant(0.9, coal_on(PLATE))


# ---- limits of the theories -------------------------------------------------------------------------------------


def test_the_plate_warns_from_lambda_one_and_a_half_on_where_the_impact_was_made():
    plate_of(1.4999999)
    with pytest.warns(ThinPlateWarning) as caught:
        plate_of(np.array([0.1, 1.5000001]))
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert "Impact(" in linecache.getline(__file__, caught[0].lineno)


def test_a_heavy_sphere_that_sinks_beyond_hertz_warns():
    gel = Material(density=1000, youngs_modulus=2e3, poisson_ratio=0.3)
    with pytest.warns(HertzRangeWarning):
        heavy = Impact(
            sphere=Sphere(material=gel, radius=0.1), target=RIGID, velocity=0.02, stiffness="hertz",
            dissipation=Elastic(), gravity=0.981,
        )  # fmt: skip
    assert heavy.peak_displacement > 0.4 * 0.1
