"""Impact against the paper's printed numbers, closed forms, and quadrature of the evaluated force."""

import linecache
import signal
import threading
import time
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cgid.errors import InvalidValue
from cgid.measure.fit import family
from cgid.physics import (
    RIGID,
    Elastic,
    HalfSpace,
    HertzRangeWarning,
    HuntCrossley,
    Impact,
    Sphere,
    ThinPlate,
    Viscoelastic,
)
from cgid.physics.contact import _contact, _kernels, curves
from cgid.physics.contact.closed_forms import damping_number, peak_displacement, peak_force
from cgid.physics.contact.curves import in_threads
from cgid.physics.contact.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material
from tests.references.make_family import reference_pulse


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


def test_loss_of_energy_measured_from_the_hysteresis_loop():
    e = np.array([0.1, 0.5, 0.9])
    impact = paper_impact(dissipation=HuntCrossley(restitution=e))
    fraction = np.sin(np.pi / 2 * np.linspace(0, 1, 40001)) ** 2
    times = impact.contact_duration[:, None] * fraction
    loop = np.trapezoid(impact.force(times), impact.displacement(times), axis=1)
    assert loop == pytest.approx(0.5 * impact.reduced_mass * 4.0 * (1 - e**2), rel=1e-6)


def test_two_spheres_and_a_rigid_wall_after_chung_and_ooi_2011():
    """Benchmark values of Chung & Ooi (2011), Granular Matter 13, 643: peak force [kN] and contact time [us]."""

    def glass(density, modulus, nu, radius):
        return Sphere(material=Material(density=density, youngs_modulus=modulus, poisson_ratio=nu), radius=radius)

    pair = glass(2800, 48e9, 0.20, 0.01)
    two = Impact(sphere=pair, target=pair, velocity=20.0, stiffness="hertz", dissipation=Elastic())
    assert (float(two.peak_force) / 1e3, float(two.contact_duration) * 1e6) == pytest.approx(
        (10.6969, 40.339), rel=2e-5
    )
    pair = glass(2500, 20e9, 0.25, 0.01)  # limestone
    two = Impact(sphere=pair, target=pair, velocity=20.0, stiffness="hertz", dissipation=Elastic())
    assert (float(two.peak_force) / 1e3, float(two.contact_duration) * 1e6) == pytest.approx((7.1082, 54.201), rel=1e-5)
    ball = glass(2699, 70e9, 0.30, 0.1)
    wall = Impact(sphere=ball, target=RIGID, velocity=0.2, stiffness="hertz", dissipation=Elastic())
    assert (float(wall.peak_force) / 1e3, float(wall.contact_duration) * 1e6) == pytest.approx(
        (11.3699, 731.66), rel=2e-5
    )


def test_the_warning_of_hertz_comes_at_a_tenth_of_the_radius_and_points_here():
    """By what the sphere does, not by what it would do without its loss."""
    depth = paper_impact(velocity=1.0, stiffness="hertz").peak_displacement / YANG2018_RADIUS
    limit = float(0.1 / depth) ** (1 / 0.8)  # the displacement goes with v^(4/5)
    paper_impact(velocity=limit * (1 - 1e-9), stiffness="hertz")
    with pytest.warns(HertzRangeWarning) as caught:
        paper_impact(velocity=[1.0, limit * (1 + 1e-9)], stiffness="hertz")
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert "Impact(" in linecache.getline(__file__, caught[0].lineno)
    damped = paper_impact(velocity=1.2 * limit, stiffness="hertz", dissipation=HuntCrossley(restitution=0.2))
    assert damped.peak_displacement < 0.1 * YANG2018_RADIUS
    soft = paper_impact(velocity=0.5 * limit, stiffness="rigid-sphere")
    assert soft.contact_stiffness / paper_impact(stiffness="hertz").contact_stiffness == pytest.approx(8 * 3**0.5 / 9)


# ---- closed forms -----------------------------------------------------------------------------------------------


def exact_peaks(damping):
    """Return largest displacement and force in 50 digits, from the first integral (2/5) x^(5/2) = G(1) - G(x')."""
    mpmath.mp.dps = 50
    d = mpmath.mpf(damping)

    def g(u):
        return u / d - mpmath.log1p(d * u) / d**2

    one = mpmath.mpf(1)
    rate = mpmath.findroot(lambda u: 3 * u / 5 - d * (g(one) - g(u)), (mpmath.mpf(0), one), "anderson", tol=1e-80)
    depth = (mpmath.mpf(5) / 2 * (g(one) - g(rate))) ** mpmath.mpf("0.4")
    return (mpmath.mpf(5) / 2 * g(one)) ** mpmath.mpf("0.4"), depth ** mpmath.mpf("1.5") * (1 + d * rate)


@pytest.mark.parametrize(
    "e",
    [1e-6, 1e-5, 1e-4, 1e-3, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1 - 1e-3, 1 - 1e-5, 1 - 1e-7, 1 - 8e-9, 1 - 5e-9,
     1 - 1e-9, 1 - 1e-10, 1 - 1e-11, 1 - 1e-12],
)  # fmt: skip
def test_closed_forms_against_50_digits(e):
    """Within 4e-15 of themselves (measured: 1e-15)."""
    damping = float(damping_number(e))
    depth, force = exact_peaks(damping)
    assert float(peak_displacement(damping) / depth) == pytest.approx(1, abs=4e-15)
    assert float(peak_force(damping) / force) == pytest.approx(1, abs=4e-15)
    impact = paper_impact(dissipation=HuntCrossley(restitution=e))
    assert float(impact.peak_displacement / impact.length_scale / depth) == pytest.approx(1, abs=4e-15)
    assert float(impact.peak_force / impact.force_scale / force) == pytest.approx(1, abs=4e-15)


# ---- the ways to a pulse ----------------------------------------------------------------------------------------


def population(n=700):
    """Return impacts of all sizes, speeds and losses, a few of them damped beyond the table."""
    generator = np.random.default_rng(11)
    restitution = np.where(np.arange(n) % 50 == 7, 0.03, generator.uniform(0.05, 1, n))
    return paper_impact(
        radius=generator.uniform(0.01, 0.08, n),
        velocity=generator.uniform(1, 7, n),
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=restitution),
    )


def mechanisms(n=5):
    """Return small arrays of impacts by each kind of loss, and by what evaluates them."""
    radius = np.linspace(0.01, 0.05, n)
    coal, steel = Sphere(material=YANG2018_SPHERES[1], radius=radius), HalfSpace(material=STEEL)
    plate = ThinPlate(material=STEEL, thickness=0.02)
    cases = {
        "elastic": (steel, Elastic(), 0.0),
        "table": (steel, HuntCrossley(restitution=np.linspace(0.05, 0.9, n)), 0.0),
        "beyond the table": (steel, HuntCrossley(restitution=0.02), 0.0),
        "viscoelastic": (steel, Viscoelastic(dissipative_constant=2e-5), 0.0),
        "plate": (plate, Elastic(), 0.0),
        "everything": (plate, HuntCrossley(restitution=0.5), 9.81),
    }
    return {
        name: Impact(sphere=coal, target=target, velocity=3.0, stiffness="hertz", dissipation=loss, gravity=gravity)
        for name, (target, loss, gravity) in cases.items()
    }


MECHANISMS = mechanisms()


def test_numpy_and_kernels_agree_on_the_table():
    """Few samples are evaluated by numpy and many by numba: within 5e-15 of the peak (measured: 6e-16)."""
    impact = paper_impact(dissipation=HuntCrossley(restitution=[0.05, 0.051, 0.2, 0.5, 0.83, 0.999, 1.0]))
    fraction = np.concatenate([[-0.5, 0, 1, 1.5], np.sin(np.pi / 2 * np.linspace(0, 1, 6000)) ** 2])
    for name, peak in (("force", impact.peak_force), ("displacement", impact.peak_displacement)):
        for row, single in enumerate(impact.restitution):
            one = paper_impact(dissipation=HuntCrossley(restitution=float(single)))
            times = fraction * float(one.contact_duration)
            many = getattr(one, name)(times)
            few = np.concatenate([getattr(one, name)(part) for part in np.array_split(times, 3)])
            assert np.abs(many - few).max() < 5e-15 * peak[row]
            assert not (many == few).all()  # they were two ways, indeed


@pytest.mark.parametrize("e", [0.05, 0.2, 0.37, 0.8, 1.0])
@pytest.mark.parametrize("quantity", ["force", "displacement"])
def test_the_halves_of_the_table_meet_at_the_cut(e, quantity):
    """At the time of the cut, and at its neighbours, numpy and kernel give what quadrature gives."""
    columns, place = getattr(family.table(), quantity), family.coordinate([e])
    pulse = np.empty(columns.shape[2])
    _kernels._blend(columns, place[0], pulse)
    cut = pulse[family.CUT]
    times = np.array([[np.nextafter(cut, 0), cut, np.nextafter(cut, 9)]])
    found, ones = np.empty((1, 3)), np.ones(1)
    _kernels.at_times(times, place, ones, ones, columns, quantity == "force", found, np.array([0]))
    expected = reference_pulse(e).evaluate(times[0])[quantity == "force"]
    assert found[0] == pytest.approx(expected, abs=5e-11)
    assert getattr(family, quantity)(times, [e])[0] == pytest.approx(found[0], abs=1e-14)


@pytest.mark.parametrize("onset", [0.0, 7.3e-6, -60e-6, 250e-6, 299e-6, 300e-6, 5.0, -5.0, 1e30, -1e30])
@pytest.mark.parametrize("name", MECHANISMS)
def test_frames_hold_the_force_on_their_grid(name, onset):
    impact = MECHANISMS[name]
    frames = impact.force_frames(1e6, 300, onset)
    force = impact.force(np.arange(300) / 1e6 - onset)
    assert frames.shape == (5, 300)
    # The place on the grid is rounded: by 1e-16 of the place, times the slope of the force.
    assert np.abs(frames - force).max(axis=1) == pytest.approx(0, abs=2e-14 * impact.peak_force.max())
    away = onset >= 299e-6 or onset <= -1
    assert (frames == 0).all() == away


@pytest.mark.parametrize("name", MECHANISMS)
def test_a_grid_that_fits_the_contact_leaves_no_trace_of_rounding(name):
    """Touch and separation on the grid, in up to 300 parts: never nan, never negative, nothing behind separation."""
    impact = replace(MECHANISMS[name], sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.0317))
    if name == "table":
        impact = replace(impact, dissipation=HuntCrossley(restitution=0.37))
    duration, peak = float(impact.contact_duration), float(impact.peak_force)
    for parts in range(1, 300):
        frame = impact.force_frames(parts / duration, parts + 5, 2 * duration / parts) / peak
        assert (frame >= 0).all()
        assert frame[:3] == pytest.approx(0, abs=1e-20 if name != "viscoelastic" else 1e-7)
        # The series of the reference path have their digits beside the force at the start of a step.
        left = {"elastic": 1e-20, "table": 1e-20, "viscoelastic": 1e-14}.get(name, 1e-16)
        assert frame[parts + 2 :] == pytest.approx(0, abs=left)


@pytest.mark.parametrize("n_threads", [1, 3])
def test_kernels_stop_when_interrupted(n_threads):
    done, first = [], threading.Lock()

    def run(rows):
        done.append(rows)
        # Once only: a second one would hit whatever runs by then.
        if len(done) >= n_threads and first.acquire(blocking=False):
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        in_threads(run, (), np.arange(100_000), n_threads)
    assert len(done) < 20  # of a hundred
    assert max(rows.size for rows in done) <= 1024


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_no_bit(threads):
    impacts = population()
    times = np.linspace(0, 5e-4, 40)
    onset = np.linspace(-1e-5, 1e-5, 700)
    assert (impacts.force(times, threads=threads) == impacts.force(times)).all()
    assert (impacts.displacement(times, threads=threads) == impacts.displacement(times)).all()
    for dtype in ("float64", "float32"):
        one, many = (impacts.force_frames(1e5, 60, onset, dtype=dtype, threads=n) for n in (1, threads))
        assert (one == many).all()
    viscous = replace(impacts, dissipation=Viscoelastic(dissipative_constant=1e-5))
    assert (viscous.force(times, threads=threads) == viscous.force(times)).all()
    assert (viscous.force_frames(1e5, 60, onset, threads=threads) == viscous.force_frames(1e5, 60, onset)).all()


def test_a_row_of_many_impacts_is_that_impact_alone():
    impacts = population(60)
    frames = impacts.force_frames(2e5, 100, 1e-5)
    for k in (0, 7, 31, 57):
        alone = paper_impact(
            radius=impacts.sphere.radius[k],
            velocity=impacts.velocity[k],
            stiffness="hertz",
            dissipation=HuntCrossley(restitution=impacts.dissipation.restitution[k]),
        )
        assert (frames[k] == alone.force_frames(2e5, 100, 1e-5)).all()
        assert impacts.peak_force[k] == alone.peak_force
        assert impacts.contact_duration[k] == alone.contact_duration


# ---- what a user can do wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": "rigid"}, "target must be .*Sphere or RigidWall, got 'rigid'"),
        (
            {"dissipation": None},
            "dissipation must be a Law, got None",
        ),
        ({"sphere": STEEL}, "sphere must be a Sphere, got Material"),
        ({"gravity": -9.81}, r"gravity must be 0 or more, got -9\.81 m/s\^2"),
        ({"stiffness": "hard"}, "stiffness must be one of 'hertz', 'rigid-sphere', 'series', got 'hard'"),
    ],
)
def test_wrong_things_are_named(changes, message):
    with pytest.raises(InvalidValue, match=message):
        replace(paper_impact(), **changes)


def one_of(velocity=2.0, radius=0.025, density=1380.0, youngs_modulus=2.26e9, thickness=None, **changes):
    material = Material(density=density, youngs_modulus=youngs_modulus, poisson_ratio=0.28)
    return Impact(
        sphere=Sphere(material=material, radius=radius),
        target=RIGID if thickness is None else ThinPlate(material=STEEL, thickness=thickness),
        velocity=velocity,
        stiffness="hertz",
        **{"dissipation": Elastic(), **changes},
    )


def everything(impact):
    """Return every number of an impact, and some of its curve."""
    names = ("restitution", "peak_displacement", "peak_force", "contact_duration", "time_of_peak", "compression_time",
             "end_displacement", "rebound_velocity", "impulse", "radiated_energy", "dissipated_energy")  # fmt: skip
    times = float(impact.contact_duration) * np.linspace(-0.1, 1.1, 40)
    curves = [impact.force(times), impact.displacement(times), impact.force_frames(30 / times[-1], 40)]
    return np.concatenate([[float(getattr(impact, name)) for name in names], *curves])


@pytest.mark.parametrize("law", ["exact", "gonthier", "lee-wang", "flores"])
@pytest.mark.parametrize("e", [1e-300, 1e-200, 1e-155, 1e-60, 1e-40, 1e-20])
def test_a_restitution_near_nothing_is_refused_or_served_but_never_nan(e, law):
    try:
        numbers = everything(paper_impact(dissipation=HuntCrossley(restitution=e, law=law)))
    except InvalidValue as error:
        assert "double precision" in str(error)
    else:
        assert np.isfinite(numbers).all()


@given(exponents=st.tuples(*(st.floats(-limit, limit) for limit in (170, 110, 200, 300))))
@settings(max_examples=100, deadline=None, derandomize=True)
@pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning", "ignore:radius is")
def test_any_magnitude_is_served_or_refused_without_a_warning(exponents):
    velocity, radius, density, youngs_modulus = (10.0**exponent for exponent in exponents)
    try:
        impact = one_of(velocity=velocity, radius=radius, density=density, youngs_modulus=youngs_modulus)
    except InvalidValue as error:
        assert "double precision" in str(error)
        return
    numbers = everything(impact)
    assert np.isfinite(numbers).all()
    assert float(impact.peak_force * impact.contact_duration / impact.reduced_mass / velocity) == pytest.approx(
        3.679094, rel=1e-6
    )


# ---- similarity -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MECHANISMS)
@pytest.mark.parametrize(("radius", "density", "modulus", "velocity"), [(3.0, 1.7, 0.3, 1.9), (0.2, 0.6, 5.0, 0.4)])
@pytest.mark.filterwarnings("ignore::cgid.physics.HertzRangeWarning")
def test_scaling_all_lengths_densities_moduli_and_speeds_leaves_the_curves(name, radius, density, modulus, velocity):
    """With D, zeta, lambda and gamma held the dimensionless curve is the same, for both bodies scaled alike."""
    before = MECHANISMS[name]
    exact = before.curves.tabulated.all()

    def scaled(material):
        return Material(
            density=density * material.density,
            youngs_modulus=modulus * material.youngs_modulus,
            poisson_ratio=material.poisson_ratio,
        )

    sphere = Sphere(material=scaled(before.sphere.material), radius=radius * before.sphere.radius)
    after = Impact(
        sphere=sphere,
        target=HalfSpace(material=scaled(STEEL)),
        velocity=velocity * 3.0,
        stiffness="hertz",
        dissipation=before.dissipation if not isinstance(before.dissipation, Viscoelastic) else Elastic(),
    )
    longer = after.time_scale / before.time_scale
    if isinstance(before.dissipation, Viscoelastic):
        after = replace(after, dissipation=Viscoelastic(dissipative_constant=2e-5 * longer))
    if isinstance(before.target, ThinPlate):
        # lambda = m / (Z T0), Z as the square of the thickness and the root of density and modulus
        grown = np.sqrt(radius**3 * density / longer / np.sqrt(density * modulus))
        after = replace(after, target=ThinPlate(material=scaled(STEEL), thickness=0.02 * grown))
    if np.any(before.gravity):
        after = replace(after, gravity=before.gravity * velocity / longer)
    assert after.restitution == pytest.approx(before.restitution, rel=1e-12 if exact else 1e-8)
    fraction = np.linspace(-0.1, 1.1, 300)
    for curve, unit in (("force", "force_scale"), ("displacement", "length_scale")):
        first, second = (
            getattr(impact, curve)(impact.contact_duration[:, None] * fraction) / getattr(impact, unit)[:, None]
            for impact in (before, after)
        )
        assert np.abs(first - second).max() < (1e-12 if exact else 3e-8)
    for quantity, unit in (("contact_duration", "time_scale"), ("time_of_peak", "time_scale"),
                           ("compression_time", "time_scale"), ("peak_force", "force_scale"),
                           ("peak_displacement", "length_scale"), ("end_displacement", "length_scale")):  # fmt: skip
        first, second = (getattr(impact, quantity) / getattr(impact, unit) for impact in (before, after))
        assert second == pytest.approx(first, rel=1e-12 if exact else 1e-7)


def test_float32_refuses_what_it_cannot_hold():
    with pytest.warns(UserWarning, match="larger than any rock"):
        ball = Sphere(material=YANG2018_SPHERES[3], radius=1e8)
    with pytest.warns(HertzRangeWarning):
        impact = Impact(sphere=ball, target=RIGID, velocity=1e30, stiffness="hertz", dissipation=Elastic())
    times = impact.contact_duration * np.linspace(0, 1, 5)
    assert np.isfinite(impact.force(times)).all()
    with pytest.raises(InvalidValue, match="float32 must represent the samples"):
        impact.force(times, dtype="float32")


@pytest.mark.parametrize("name", sorted(MECHANISMS))
def test_interpreted_and_compiled_agree(name, monkeypatch):
    one = replace(MECHANISMS[name])
    times = one.contact_duration[:, None] * np.linspace(0, 1, 40)
    compiled = one.force(times), one.restitution, one.time_of_peak
    monkeypatch.setattr(curves, "_FEW_IMPACTS", 5)
    monkeypatch.setattr(curves, "_is_ready", lambda kernel: False)
    monkeypatch.setattr(curves, "_interpreted_samples", 0)
    two = replace(MECHANISMS[name])
    for one_by_one, together in zip((two.force(times), two.restitution, two.time_of_peak), compiled, strict=True):
        assert (one_by_one == together).all()
    for dtype in ("float32", "float64"):
        frames = two.force_frames(1e5, 60, 1.7e-5, dtype=dtype)
        monkeypatch.setattr(curves, "_interpreted_samples", 10**9)
        assert (frames == one.force_frames(1e5, 60, 1.7e-5, dtype=dtype)).all()
        monkeypatch.setattr(curves, "_interpreted_samples", 0)


def test_what_was_compiled_is_not_interpreted(monkeypatch):
    monkeypatch.setattr(curves, "_interpreted_samples", 0)
    ball = Sphere(material=YANG2018_SPHERES[3], radius=0.01)
    loss = Viscoelastic(time_constant=5e-6)
    five = Impact(sphere=ball, target=RIGID, velocity=np.ones(5), stiffness="hertz", dissipation=loss)
    assert (five.restitution < 1).all()
    assert curves.kernel(_contact, "summaries", 1) is _contact.summaries
    monkeypatch.setattr(_contact.summaries, "overloads", {})
    assert curves.kernel(_contact, "summaries", 1) is not _contact.summaries


def test_how_much_is_interpreted_follows_from_the_work_alone(monkeypatch):
    monkeypatch.setattr(curves, "_is_ready", lambda kernel: False)
    monkeypatch.setattr(curves, "_interpreted_samples", 0)
    chosen = [curves.kernel(_contact, "summaries", 1) is _contact.summaries for _ in range(300)]
    assert chosen == [False] * 256 + [True] * 44
    monkeypatch.setattr(curves, "_interpreted_samples", 0)
    assert curves.kernel(_contact, "at_times", 1, 4097) is _contact.at_times
    assert curves.kernel(_contact, "summaries", 5) is _contact.summaries
    chosen = [curves.kernel(_contact, "at_times", 4, 1024) is _contact.at_times for _ in range(9)]
    assert chosen == [False] * 8 + [True]
