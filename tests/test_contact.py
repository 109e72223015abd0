"""The integrator of contacts: error against tolerance, quadrature, scipy, its limits, and what becomes of an impact."""

import numpy as np
import pytest
from scipy.special import beta

from cgid.physics import STEEL, Elastic, ThinPlate, Thornton, Viscoelastic, WaltonBraun
from cgid.physics.contact import _contact
from cgid.physics.contact.closed_forms import damping_number, peak_displacement, peak_force
from cgid.physics.contact.curves import TOLERANCE, Curves
from tests import naive
from tests.references import make_step
from tests.references.make_family import reference_pulse, time_of_peak

HALF = float(damping_number(0.5))
#: Damping, zeta, lambda, gamma of each mechanism by itself and of those that act together.
MECHANISMS = {
    "elastic": (0, 0, 0, 0),
    "hunt-crossley": (HALF, 0, 0, 0),
    "viscoelastic": (0, 0.5, 0, 0),
    "plate": (0, 0, 0.5, 0),
    "plate hunt-crossley": (HALF, 0, 0.5, 0),
    "gravity hunt-crossley": (HALF, 0, 0, 0.02),
}


#: A pulse is within its tolerance of the truth, rates and times of a run of many a few times that.
EXACT = 1e-12


def curves_of(parameters, tolerance=EXACT):
    """Return the curves of impacts (n, 4) of D or zeta, lambda and gamma."""
    damping, zeta, inelasticity, weight = np.atleast_2d(np.array(parameters, float)).T
    viscous = zeta.any()
    assert not (viscous and damping.any())
    numbers = (zeta if viscous else damping)[:, None].copy()
    return Curves(Viscoelastic if viscous else Elastic, numbers, inelasticity.copy(), weight.copy(), tolerance)


def summary(parameters, tolerance=EXACT):
    """Return the results of one impact by name."""
    return {name: float(values[0]) for name, values in curves_of(parameters, tolerance)._summary.items()}


def curve(times, parameters, quantity="force", tolerance=EXACT):
    times = np.atleast_2d(times)
    ones = np.ones(len(times))
    curves = curves_of(np.broadcast_to(np.array(parameters, float), (len(times), 4)), tolerance)
    out = curves.evaluate(times, ones, ones, quantity, "float64", 1)
    return out[0] if len(out) == 1 else out


def crowded(duration, n=400):
    """Return times that crowd at both ends of contact, where the pulse is not smooth, and do not touch them."""
    return duration * np.sin(np.pi / 2 * np.linspace(0, 1, n + 2)[1:-1]) ** 2


# ---- error against tolerance ------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, TOLERANCE, 1e-10])
@pytest.mark.parametrize("name", MECHANISMS)
def test_a_pulse_is_within_its_tolerance(name, tolerance):
    parameters = MECHANISMS[name]
    slow, found = naive.Contact(*parameters), summary(parameters, tolerance)
    times = crowded(slow.contact_time)
    displacement, force = slow.evaluate(times)
    assert np.abs(curve(times, parameters, tolerance=tolerance) - force).max() < tolerance * force.max()
    deviation = np.abs(curve(times, parameters, "displacement", tolerance) - displacement)
    assert deviation.max() < tolerance * displacement.max()
    for key in ("restitution", "contact_time", "plate_energy"):
        assert found[key] == pytest.approx(getattr(slow, key), abs=tolerance)


@pytest.mark.parametrize("e", [1.0, 0.8, 0.5, 0.2])
def test_the_classical_rule_in_plain_time_converges_at_two_and_a_half(e):
    """x^(3/2) has no second derivative at touch: the first step errs by h^(5/2), whatever the order of the rule."""
    pulse = reference_pulse(e)
    exact = pulse.evaluate(np.array([1.0]))[0][0]
    errors = np.array([abs(naive.impact_rk4(pulse.damping, 1.0, n)[0] - exact) for n in (80, 160, 320, 640)])
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(2.5, abs=0.02)


# ---- against quadrature: Hunt-Crossley alone --------------------------------------------------------------------


@pytest.mark.parametrize(
    "e", [1.0, 1 - 1e-12, 1 - 1e-6, 0.99, 0.8, 0.5, 0.2, 0.1, 0.05, 0.02, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-9, 1e-12]
)
def test_quadrature_agrees(e):
    pulse = reference_pulse(e)
    parameters = (pulse.damping, 0, 0, 0)
    found = summary(parameters)
    assert found["status"] == _contact.SEPARATED
    assert found["restitution"] == pytest.approx(e, rel=1e-10)
    assert found["contact_time"] == pytest.approx(pulse.contact_time, rel=1e-10)
    assert found["time_of_peak"] == pytest.approx(time_of_peak(e), rel=1e-7)
    assert found["compression_time"] == pytest.approx(pulse.compression_time, rel=1e-7, abs=1e-7)
    assert found["peak_force"] == pytest.approx(float(peak_force(pulse.damping)), rel=1e-11)
    assert found["peak_displacement"] == pytest.approx(float(peak_displacement(pulse.damping)), rel=1e-11)
    assert (found["end_displacement"], found["plate_energy"]) == (0, 0)
    times = np.concatenate([crowded(pulse.contact_time), crowded(pulse.compression_time)])
    displacement, force = pulse.evaluate(times)
    assert np.abs(curve(times, parameters) - force).max() < 1e-11 * found["peak_force"]
    deviation = np.abs(curve(times, parameters, "displacement") - displacement)
    assert deviation.max() < 1e-11 * found["peak_displacement"]


# ---- against scipy: everything else -----------------------------------------------------------------------------

SCIPY_CASES = [
    *((0, zeta, 0, 0) for zeta in (1e-3, 0.03, 0.5, 3.0, 10.0, 100.0)),
    *((0, 0, inelasticity, 0) for inelasticity in (0.01, 0.1, 0.5, 1.5, 5.0)),
    *((HALF, 0, inelasticity, 0) for inelasticity in (0.01, 0.5, 5.0)),
    (float(damping_number(0.05)), 0, 0.3, 0),
    (0, 0.05, 0.1, 0), (0, 2.0, 1.0, 0),
    (0, 0, 0, 0.3), (HALF, 0, 0, 1e-3), (HALF, 0, 0, 0.05), (0, 0.1, 0, 0.01), (0, 0, 0.2, 0.01),
    (HALF, 0, 0.1, 1e-3), (0, 0.1, 0.1, 0.005),
]  # fmt: skip


@pytest.mark.parametrize("parameters", SCIPY_CASES)
def test_scipy_agrees(parameters):
    slow, found = naive.Contact(*parameters), summary(parameters)
    assert found["status"] == _contact.SEPARATED
    # Where zeta is large the force falls to zero nearly along the axis, and its end is felt less well by scipy.
    along_the_axis = 1e-7 if parameters[1] > 5 else 1e-11
    assert found["contact_time"] == pytest.approx(slow.contact_time, rel=along_the_axis)
    assert found["restitution"] == pytest.approx(slow.restitution, rel=1e-11, abs=1e-12)
    assert found["plate_energy"] == pytest.approx(slow.plate_energy, abs=1e-12)
    assert found["end_displacement"] == pytest.approx(slow.end_displacement, abs=1e-12)
    times = crowded(slow.contact_time)
    displacement, force = slow.evaluate(times)
    assert np.abs(curve(times, parameters) - force).max() < 1e-11 * found["peak_force"]
    deviation = np.abs(curve(times, parameters, "displacement") - displacement)
    assert deviation.max() < 1e-11 * found["peak_displacement"]


@pytest.mark.parametrize("parameters", SCIPY_CASES)
def test_peaks_are_the_largest_values_of_the_curves(parameters):
    found = summary(parameters)
    times = np.concatenate([
        crowded(found["contact_time"], 4000),
        found["time_of_peak"] * np.linspace(0.99, 1.01, 101),
        np.minimum(found["compression_time"] * np.linspace(0.99, 1.01, 101), found["contact_time"]),
    ])  # fmt: skip
    for row, peak, time in (("force", "peak_force", "time_of_peak"),
                            ("displacement", "peak_displacement", "compression_time")):  # fmt: skip
        values = curve(times, parameters, row)
        assert values.max() <= found[peak] * (1 + 1e-12)
        assert curve(found[time], parameters, row) == pytest.approx(found[peak], rel=1e-12)


def test_impulse_and_energy_of_plate_and_loss_by_quadrature_of_the_curves():
    """Gauss nodes of theta, tau/tau_c = sin^2(pi theta/2), see the invariants of the motion to rounding."""
    nodes, weights = np.polynomial.legendre.leggauss(160)
    theta = (nodes + 1) / 2
    for parameters in SCIPY_CASES:
        _, _, inelasticity, weight = parameters
        found = summary(parameters)
        force = curve(found["contact_time"] * np.sin(np.pi / 2 * theta) ** 2, parameters)
        measure = weights / 2 * found["contact_time"] * np.pi / 2 * np.sin(np.pi * theta)
        momentum = 1 + found["restitution"] + weight * found["contact_time"]
        assert (force * measure).sum() == pytest.approx(momentum, rel=1e-11)
        assert inelasticity * (force**2 * measure).sum() == pytest.approx(found["plate_energy"], abs=1e-11)


# ---- times in any order, and frames -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", MECHANISMS)
def test_nothing_before_touch_at_touch_and_from_separation_on(name):
    parameters = MECHANISMS[name]
    found = summary(parameters)
    end = found["contact_time"]
    outside = np.array([-1e300, -1.0, -5e-324, 0.0, end, np.nextafter(end, 9), 2 * end, 1e300])
    for row in ("force", "displacement"):
        assert (curve(outside, parameters, row) == 0).all()
        # The first and the last number within contact: force goes like the time to the power 3/2, or less.
        first, last = curve(np.array([5e-324, np.nextafter(end, 0)]), parameters, row)
        left = found["end_displacement"] if row == "displacement" else 0.0
        assert 0 <= first < 1e-150
        assert last == pytest.approx(left, abs=1e-11)
        assert last >= 0


@pytest.mark.parametrize("onset", [0.0, 3.25, 17.0, -5.5, -40.0, 58.0, 59.0, 60.0, 400.0, -400.0, 1e30, -1e30])
def test_frames_hold_what_the_curve_holds_on_their_grid(onset):
    names = list(MECHANISMS)
    parameters = np.array([MECHANISMS[name] for name in names], float)
    step, amplitude = np.linspace(0.05, 0.09, len(names)), np.linspace(1.0, 3.0, len(names))
    ground = np.random.default_rng(1).normal(size=(len(names), 60))
    frames = ground.copy()
    rows = np.arange(len(names))
    times = (np.arange(60) - onset) * step[:, None]
    pulses = np.empty(frames.shape)
    for row in rows:  # a law each
        alone = curves_of(parameters[row])
        part = slice(row, row + 1)
        alone.add_to_frames(frames[part], np.array([onset]), step[part], amplitude[part], 1)
        pulses[row] = alone.evaluate(times[part], np.ones(1), amplitude[part], "force", "float64", 1)[0]
    assert np.abs(frames - (ground + pulses)).max() < 1e-14
    outside = pulses == 0
    assert (frames[outside] == ground[outside]).all()


# ---- what becomes of an impact ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters", [(HALF, 0, 0, 1.0), (HALF, 0, 0, 0.6), (0, 0.5, 0, 2.0), (0, 0, 0.5, 0.3), (6.9, 0, 0, 0.071)]
)
def test_a_weight_that_holds_the_sphere_on_the_target(parameters):
    assert summary(parameters)["status"] == _contact.STAYS
    assert not naive.Contact(*parameters, longest=300).separates
    assert (curve(np.linspace(0, 50, 200), parameters) == 0).all()


def test_the_weight_that_just_lets_the_sphere_leave():
    leaving = summary((HALF, 0, 0, 0.1))["status"]
    low, high = 0.05, 0.3
    assert leaving == _contact.SEPARATED
    for _ in range(30):
        middle = 0.5 * (low + high)
        if summary((HALF, 0, 0, middle))["status"] == _contact.SEPARATED:
            low = middle
        else:
            assert summary((HALF, 0, 0, middle))["status"] == _contact.STAYS
            high = middle
    assert naive.Contact(HALF, weight=low * (1 - 1e-6), longest=100).separates
    assert not naive.Contact(HALF, weight=high * (1 + 1e-6), longest=100).separates


@pytest.mark.parametrize(
    ("damping", "zeta", "inelasticity"), [(HALF, 0, 0), (10.0, 0, 0), (0, 0.5, 0), (0, 20.0, 0), (3.0, 0, 1.0)]
)
def test_a_sphere_that_leaves_would_leave_if_it_were_lighter(damping, zeta, inelasticity):
    """No step that happens to end near the turn, or where force and weight are equal, is taken for rest."""
    low, high = 1e-9, 1.0
    for _ in range(60):
        middle = (low * high) ** 0.5
        leaves = summary((damping, zeta, inelasticity, middle))["status"] == _contact.SEPARATED
        low, high = (middle, high) if leaves else (low, middle)
    weights = np.geomspace(1e-6 * low, low, 3000)
    parameters = np.column_stack([np.tile([damping, zeta, inelasticity], (weights.size, 1)), weights])
    found = curves_of(parameters)._summary
    assert (found["status"] == _contact.SEPARATED).all()
    assert (np.diff(found["restitution"]) < 1e-10).all()  # and the heavier, the slower
    assert low < 0.5


@pytest.mark.parametrize("weight", [1e-3, 0.1, 1.0, 10.0, 100.0])
def test_an_elastic_sphere_leaves_as_fast_as_it_came_however_heavy(weight):
    """The first integral 1/2 + gamma x = 2/5 x^(5/2) + 1/2 x'^2 gives the turn and all of the time."""
    found = summary((0, 0, 0, weight))
    assert found["status"] == _contact.SEPARATED
    # The fall beneath touch is worth gamma x_max beside the energy of impact, and takes as many digits.
    assert found["restitution"] == pytest.approx(1, abs=1e-11 * (1 + weight * found["peak_displacement"]))
    turn = np.polynomial.Polynomial([-0.5, 0, -weight, 0, 0, 0.4]).roots()  # in x^(1/2)
    largest = turn[(abs(turn.imag) < 1e-9) & (turn.real > 0)].real.max() ** 2
    assert found["peak_displacement"] == pytest.approx(largest, rel=1e-11)
    assert found["peak_force"] == pytest.approx(largest**1.5, rel=1e-11)
    assert found["contact_time"] == pytest.approx(2 * found["compression_time"], rel=1e-7)


@pytest.mark.parametrize("parameters", [(0, 1e8, 0, 0), (0, 0, 100.0, 0), (0, 0, 1e200, 0), (0, 1e300, 0, 0),
                                        (0, 0, 0, 1e200)])  # fmt: skip
def test_what_double_precision_cannot_follow_is_said(parameters):
    assert summary(parameters)["status"] == _contact.OUT_OF_REACH
    assert (curve(np.linspace(0, 50, 200), parameters) == 0).all()


# ---- continuity -------------------------------------------------------------------------------------------------

SMALL = 10.0 ** np.arange(-10, -5)
#: Twice the integral of x^(1/2) x' over the compression of an elastic impact: 1 - e = C zeta.
LOSS = 0.8 * 1.25**0.6 * beta(0.6, 1.5)


@pytest.mark.parametrize("number", SMALL)
def test_a_little_loss_is_what_perturbation_says(number):
    elastic = summary((0, 0, 0, 0))
    viscous, plate = summary((0, number, 0, 0)), summary((0, 0, number, 0))
    assert 1 - viscous["restitution"] == pytest.approx(LOSS * number, rel=4 * number, abs=1e-13)
    assert viscous["end_displacement"] == pytest.approx(number, rel=2 * number, abs=3e-11)
    # The equation of x is that of zeta = 3/2 lambda, and what x loses the plate has taken.
    assert 1 - plate["restitution"] == pytest.approx(1.5 * LOSS * number, rel=4 * number, abs=1e-13)
    assert plate["plate_energy"] == pytest.approx(1.5 * LOSS * number, rel=4 * number, abs=1e-13)
    for found in (viscous, plate):
        for name in ("contact_time", "peak_force", "time_of_peak", "peak_displacement", "compression_time"):
            assert found[name] == pytest.approx(elastic[name], rel=2 * number + (1e-7 if "time" in name else 1e-11))


# ---- plastic laws, with a plate and weight ---------------------------------------------------------------------------

PLASTIC = {
    "thornton": (Thornton, naive.thornton_paths, (0.08,)),
    "thornton, late": (Thornton, naive.thornton_paths, (0.97,)),
    "walton-braun": (WaltonBraun, naive.walton_braun_paths, (0.8, 0.5)),
}


@pytest.mark.parametrize(("damping", "inelasticity", "weight"), [(0, 0.4, 0), (0.7, 0, 0.01), (0.7, 1.0, 1e-4)])
@pytest.mark.parametrize("name", PLASTIC)
def test_plastic_laws_agree_with_scipy_on_a_plate_and_with_weight(name, damping, inelasticity, weight):
    law, paths, numbers = PLASTIC[name]
    force, end, rebound, energy = naive.plastic_contact(*paths(*numbers), damping, inelasticity, weight)
    curves = Curves(
        law, np.array([[*numbers, damping]]), np.array([inelasticity]), np.array([weight], float), TOLERANCE
    )
    times = crowded(end)
    found = curves.evaluate(times[None], np.ones(1), np.ones(1), "force", "float64", 1)[0]
    assert np.abs(found - force(times)).max() < 3 * TOLERANCE * float(curves.peak_force[0])
    assert curves.restitution[0] == pytest.approx(rebound, abs=TOLERANCE)
    assert curves.times[0][0] == pytest.approx(end, rel=1e-6)  # scipy's end is one of the force
    assert curves.plate_energy[0] == pytest.approx(energy, abs=TOLERANCE)


def test_the_unrolled_step_is_what_its_coefficients_give():
    assert make_step.PATH.read_text(encoding="utf-8") == make_step.SOURCE


def test_a_plate_needs_its_thickness():
    with pytest.raises(TypeError, match="thickness"):
        ThinPlate(material=STEEL)
