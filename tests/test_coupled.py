"""A sphere on a structure given by its modes: scipy, closed forms, half space, thin plate, energy, and bad input."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from cgid.errors import InvalidValue
from cgid.physics import (
    STEEL,
    YANG2018_SPHERES,
    Elastic,
    HalfSpace,
    HuntCrossley,
    Impact,
    ModalImpact,
    Sphere,
    ThinPlate,
    Thornton,
    WaltonBraun,
)
from tests import few, naive

COAL = YANG2018_SPHERES[1]
#: T0 of the reference impact; an undamped contact lasts 3.2 of it.
ON_STEEL = {"sphere": Sphere(material=COAL, radius=0.025), "velocity": 2.0, "stiffness": "hertz"}
HALF = HuntCrossley(restitution=0.5)


def rigid(dissipation=HALF, **changed):
    return Impact(**{**ON_STEEL, "target": HalfSpace(material=STEEL), "dissipation": dissipation, **changed})


def modal(frequency, damping_ratio, compliance, dissipation=HALF, **changed):
    return ModalImpact(
        **{**ON_STEEL, "target": HalfSpace(material=STEEL), "dissipation": dissipation, **changed},
        frequency=frequency,
        damping_ratio=damping_ratio,
        compliance=compliance,
    )


def dimensionless(omega, damping_ratio, participation, dissipation=HALF, **changed):
    """Return an impact whose modes have these frequencies times T0, and these participations times the mass."""
    plain = rigid(dissipation, **changed)
    frequency = np.asarray(omega) / (2 * np.pi * plain.time_scale)
    return modal(frequency, damping_ratio, np.asarray(participation) / plain.reduced_mass, dissipation, **changed)


def slow(impact):
    """Return the same impact by scipy, in units of T0, v, L and m."""
    shares = np.asarray(impact.compliance) * float(impact.reduced_mass)
    omega = 2 * np.pi * np.asarray(impact.frequency) * float(impact.time_scale)
    weight = float(np.asarray(impact.gravity) * impact.length_scale / impact.velocity**2)
    ratios = np.broadcast_to(impact.damping_ratio, omega.shape)
    return Modes(omega, ratios, shares, float(impact.dissipation.damping_number), weight)


#: omega T0, damping ratio, participation times mass, dissipation; some swing back, or let go of the sphere.
CASES = {
    "elastic": ([2, 7, 11], [0.01, 0.02, 0.03], [0.3, 0.5, 0.4], Elastic()),
    "damped": ([2, 7, 11], [0.01, 0.02, 0.03], [0.3, 0.5, 0.4], HALF),
    "strongly damped modes": ([0.3, 4, 9], [0.9, 0.5, 0.3], [1, 2, 3], Elastic()),
    "hit again, damped": ([0.5, 6], [0.01, 0.02], [4, 4], HuntCrossley(restitution=0.8)),
    "heavy": ([0.6, 2.4, 5.4, 9.6], [0.005] * 4, [4, 4, 4, 4], HuntCrossley(restitution=0.9)),
    "released": ([1, 6, 15], [0.01, 0.02, 0.01], [0.3, 0.5, 0.4], HuntCrossley(restitution=0.1)),
    "light": ([3, 20], [0.01, 0.02], [30, 10], HALF),
    "hit again": ([0.5, 6], [0.01, 0.02], [4, 4], Elastic()),
}


@pytest.fixture(scope="module", params=few(CASES, 3))
def pair(request):
    *modes, dissipation = CASES[request.param]
    impact = dimensionless(*modes, dissipation)
    return impact, slow(impact)


class Modes:
    """Sphere and modes by scipy's DOP853 in plain time, contact by contact, each mode a pair of equations."""

    def __init__(self, omega, ratios, shares, damping, weight, window=12.0):
        n = len(omega)
        self._parts = lambda state: (
            state[0] - shares @ state[2 : 2 + n],
            state[1] - shares @ state[2 + n : 2 + 2 * n],
        )
        self._force = lambda x, rate: np.maximum(x, 0) ** 1.5 * np.maximum(1 + damping * rate, 0)
        contact = True

        def rates(_time, state):
            (x, rate), q, p = self._parts(state), state[2 : 2 + n], state[2 + n : 2 + 2 * n]
            force = self._force(x, rate) if contact else 0.0
            lost = (force - max(x, 0) ** 1.5) * rate if contact else 0.0
            modes = force - 2 * ratios * omega * p - omega**2 * q
            taken = (2 * shares * ratios * omega) @ p**2
            return np.concatenate([[state[1], weight - force], p, modes, [force * (shares @ p), lost, taken, force]])

        def crossing(_time, state):
            return self._parts(state)[0]

        def released(_time, state):
            return 1 + damping * self._parts(state)[1]

        crossing.terminal, released.direction = True, -1
        state, time, ends = np.zeros(2 * n + 6), 0.0, []
        state[1] = 1.0
        self._solved = []
        while True:
            crossing.direction = -1 if contact else 1
            limit = 1e3 if contact else window
            # A first short way leaves the crossing behind that the interval begins with.
            near = solve_ivp(rates, (time, time + 1e-6), state, method="DOP853", rtol=1e-13, atol=1e-15,
                             dense_output=True)  # fmt: skip
            far = solve_ivp(rates, (near.t[-1], limit), near.y[:, -1], method="DOP853", rtol=1e-13, atol=1e-15,
                            dense_output=True, events=[crossing, released])  # fmt: skip
            time, state = far.t[-1], far.y[:, -1]
            if contact:
                self._solved += [(near.t[0], near.t[-1], near.sol), (far.t[0], far.t[-1], far.sol)]
                # Force ends where it was let go last, if it was.
                let_go = far.t_events[1].size > 0 and self._parts(far.y_events[1][-1])[0] > 0
                ends.append((far.t_events[1][-1], far.y_events[1][-1]) if let_go else (time, state))
            if far.status != 1 or time >= window:
                break
            contact = not contact
        self.contacts, self.contact_time = len(ends), ends[0][0]
        self.end, state = ends[-1]
        q, p = state[2 : 2 + n], state[2 + n : 2 + 2 * n]
        self.restitution = -state[1]
        self.modal_energy = 0.5 * shares @ (p**2 + omega**2 * q**2)
        self.beam_energy, lost, self.modal_dissipation, self.impulse = state[-4:]
        # What was still compressed when it was let go relaxed without a force.
        self.material_loss = lost + 0.4 * max(self._parts(state)[0], 0) ** 2.5

    def evaluate(self, times):
        """Return force and displacement, zero outside contact."""
        force, displacement = np.zeros((2, len(times)))
        for begin, end, solution in self._solved:
            for k in np.flatnonzero((times > begin) & (times <= end)):
                displacement[k], rate = self._parts(solution(times[k]))
                force[k] = self._force(displacement[k], rate)
        return force, displacement


class Crushed:
    """Sphere and modes by scipy's DOP853, with a contact that loads and unloads on two paths."""

    def __init__(self, omega, ratios, shares, paths, damping=0.0, weight=0.0, window=12.0):
        loading, unloading, corner = paths
        n = len(omega)
        path, largest, rest, contact = loading, 0.0, 0.0, True

        def parts(state):
            return state[0] - shares @ state[2 : 2 + n], state[1] - shares @ state[2 + n :]

        def force_of(path, state):
            x, rate = parts(state)
            return path(x) * max(1 + damping * rate, 0.0)

        def rates(_time, state):
            f = force_of(path, state) if contact else 0.0
            q, p = state[2 : 2 + n], state[2 + n :]
            return np.concatenate([[state[1], weight - f], p, f - 2 * ratios * omega * p - omega**2 * q])

        state, time, self._solved, self.contacts, self.end = np.zeros(2 + 2 * n), 0.0, [], 1, 0.0
        state[1] = 1.0
        while True:
            edges = [(lambda state, at=rest: parts(state)[0] - at, -1 if contact else 1)]
            if contact and path is loading:
                edges.append((lambda state: parts(state)[1], -1))
                if largest < corner < np.inf:
                    edges.append((lambda state: parts(state)[0] - corner, 1))
            elif contact:
                edges.append((lambda state, at=largest: parts(state)[0] - at, 1))
            events = []
            for edge, direction in edges:
                event = lambda _time, state, edge=edge: edge(state)  # noqa: E731
                event.terminal, event.direction = True, direction
                events.append(event)
            limit = 1e3 if contact else window
            near = solve_ivp(rates, (time, time + 1e-6), state, method="DOP853", rtol=1e-12, atol=1e-14,
                             dense_output=True)  # fmt: skip
            far = solve_ivp(rates, (near.t[-1], limit), near.y[:, -1], method="DOP853", rtol=1e-12, atol=1e-14,
                            dense_output=True, events=events, max_step=0.02)  # fmt: skip
            time, state = far.t[-1], far.y[:, -1]
            if contact:
                self._solved += [(one.t[0], one.t[-1], one.sol, path, force_of) for one in (near, far)]
            if far.status != 1:
                break
            first = next(k for k, at in enumerate(far.t_events) if at.size)
            if first == 0:
                contact = not contact
                self.contacts += int(contact)
                self.end, self.restitution = (time, -state[1]) if not contact else (self.end, self.restitution)
                if time >= window:
                    break
            elif path is loading and first == 1:
                largest = parts(state)[0]
                path = unloading(largest)
                if path(0.0) == 0.0:
                    none = 1e-13 * path(largest)
                    rest = brentq(lambda x, path=path, at=none: path(x) - at, 0.0, largest, xtol=1e-20)
            elif path is loading:
                largest = corner
            else:
                path = loading

    def force(self, times):
        out = np.zeros(times.shape)
        for begin, end, solution, path, force_of in self._solved:
            for k in np.flatnonzero((times > begin) & (times <= end)):
                out[k] = force_of(path, solution(times[k]))
        return out


# ---- against scipy ----------------------------------------------------------------------------------------------


def test_scipy_agrees(pair):
    impact, expected = pair
    energy = impact.reduced_mass * impact.velocity**2
    assert impact.contacts == expected.contacts
    assert impact.restitution == pytest.approx(expected.restitution, abs=1e-8)
    assert impact.contact_duration / impact.time_scale == pytest.approx(expected.contact_time, rel=1e-8)
    assert impact.end_of_contact / impact.time_scale == pytest.approx(expected.end, rel=1e-8)
    assert impact.impulse == pytest.approx(expected.impulse * impact.reduced_mass * impact.velocity, rel=1e-8)
    assert impact.radiated_energy == pytest.approx(expected.beam_energy * energy, abs=1e-8 * energy)
    assert impact.modal_energy == pytest.approx(expected.modal_energy * energy, abs=1e-8 * energy)
    assert impact.modal_dissipation == pytest.approx(expected.modal_dissipation * energy, abs=1e-8 * energy)
    assert impact.dissipated_energy == pytest.approx(expected.material_loss * energy, abs=1e-8 * energy)


def test_force_and_displacement_over_time_are_those_of_scipy(pair):
    impact, expected = pair
    tau = np.linspace(-0.1, 1.02 * expected.end, 500)
    force, displacement = expected.evaluate(tau)
    found = impact.force(tau * impact.time_scale) / impact.force_scale
    assert np.abs(found - force).max() < 1e-8 * force.max()
    found = impact.displacement(tau * impact.time_scale) / impact.length_scale
    in_contact = force > 0
    assert np.abs(found - displacement)[in_contact].max() < 1e-8 * displacement.max()


def crushing(impact):
    """Return the paths of a plastic impact on modes, and its damping number."""
    *own, damping = [float(one) for one in impact._numbers.values()]
    paths = naive.thornton_paths if isinstance(impact.dissipation, Thornton) else naive.walton_braun_paths
    return paths(*own), damping


#: omega T0, damping ratio, participation times mass, the law of this yield pressure [MPa] or restitution and of this
#: viscous restitution, g L / v^2; some are hit again, pressed beyond their dent, or let go.
CRUSHED = {
    "crushed": ([2, 7, 11], [0.01, 0.02, 0.03], [0.3, 0.5, 0.4], Thornton(yield_pressure=40e6), 0.0),
    "crushed and damped": (
        [2, 7, 11],
        0.02,
        [0.3, 0.5, 0.4],
        Thornton(yield_pressure=40e6, viscous_restitution=0.7),
        0,
    ),
    "crushed again": ([0.5, 6], [0.01, 0.02], [4, 4], Thornton(yield_pressure=60e6), 0.02),
    "two springs": ([0.5, 6], [0.01, 0.02], [4, 4], WaltonBraun(restitution=0.8), 0.0),
    "two springs, damped": (
        [3, 20],
        [0.01, 0.02],
        [3, 10],
        WaltonBraun(restitution=0.6, viscous_restitution=0.8),
        0.02,
    ),
}


@pytest.mark.parametrize("name", few(CRUSHED, 3))
def test_plastic_contacts_on_modes_are_those_of_scipy(name):
    *modes, law, weight = CRUSHED[name]
    gravity = weight * float(rigid(law).velocity ** 2 / rigid(law).length_scale)
    impact = dimensionless(*modes, law, gravity=gravity)
    paths, damping = crushing(impact)
    omega, ratios, shares = np.broadcast_arrays(*map(np.asarray, modes))
    expected = Crushed(omega, ratios, shares, paths, damping, weight)
    assert impact.contacts == expected.contacts
    assert impact.restitution == pytest.approx(expected.restitution, abs=1e-8)
    tau = np.linspace(0, 1.02 * expected.end, 500)
    force = expected.force(tau)
    found = impact.force(tau * impact.time_scale) / impact.force_scale
    assert np.abs(found - force).max() < 1e-8 * force.max()
    assert abs(impact.energy_error) < 1e-8


@pytest.mark.long
def test_random_plastic_impacts_on_modes_are_those_of_scipy():
    """Soft and hard, light and heavy structures; those that their weight holds, or that never rest, are refused."""
    draw, solved = np.random.default_rng(9), 0
    for _ in range(40):
        n = draw.integers(1, 6)
        omega, ratios = np.sort(10 ** draw.uniform(-0.5, 1.5, n)), 10 ** draw.uniform(-3, -0.3, n)
        shares, weight = 10 ** draw.uniform(-2, 1, n), draw.choice([0.0, 0.0, 0.02, 0.1])
        viscous = None if draw.random() < 0.5 else draw.uniform(0.3, 0.99)
        law = [
            Thornton(yield_pressure=10 ** draw.uniform(6.5, 8.3), viscous_restitution=viscous),
            WaltonBraun(restitution=draw.uniform(0.2, 0.999), viscous_restitution=viscous),
        ][draw.integers(0, 2)]
        gravity = weight * float(rigid(law).velocity ** 2 / rigid(law).length_scale)
        try:
            impact = dimensionless(omega, ratios, shares, law, gravity=gravity)
        except InvalidValue:
            assert weight > 0
            continue
        paths, damping = crushing(impact)
        expected = Crushed(omega, ratios, shares, paths, damping, weight)
        tau = np.linspace(0, 1.01 * expected.end, 300)
        found, force = impact.force(tau * impact.time_scale) / impact.force_scale, expected.force(tau)
        assert impact.contacts == expected.contacts
        assert np.abs(found - force).max() < 1e-8 * force.max()
        assert impact.restitution == pytest.approx(expected.restitution, abs=1e-8)
        solved += 1
    assert solved > 33


def test_peaks_are_the_largest_values_of_the_curves(pair):
    impact, _ = pair
    times = np.linspace(0, impact.end_of_contact, 20_001)
    for curve, peak, time in (
        (impact.force, impact.peak_force, impact.time_of_peak),
        (impact.displacement, impact.peak_displacement, impact.compression_time),
    ):
        assert curve(times).max() <= peak * (1 + 1e-8)
        assert curve(times).max() == pytest.approx(peak, rel=1e-5)
        assert curve(time) == pytest.approx(peak, rel=1e-8)


def test_gravity_pulls_in_contact_and_between():
    dissipation = HuntCrossley(restitution=0.8)
    light = dimensionless(*CASES["hit again"][:3], dissipation)
    gravity = 0.02 * float(light.velocity**2 / light.length_scale)
    impact = dimensionless(*CASES["hit again"][:3], dissipation, gravity=gravity)
    expected = slow(impact)
    assert impact.contacts == expected.contacts > 1
    assert impact.restitution == pytest.approx(expected.restitution, abs=1e-8)
    assert impact.end_of_contact / impact.time_scale == pytest.approx(expected.end, rel=1e-8)
    assert abs(impact.energy_error) < 1e-8
    assert abs(impact.restitution - light.restitution) > 1e-3


# ---- limits with closed forms -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dissipation", [Elastic(), HALF, HuntCrossley(restitution=0.1)])
@pytest.mark.parametrize("modes", [([], 0.01, []), ([300.0, 2000.0], 0.01, [0.0, 0.0])])
def test_without_modes_or_at_their_nodes_it_is_the_half_space(dissipation, modes):
    plain, impact = rigid(dissipation), modal(*modes, dissipation)
    for name in ("restitution", "peak_force", "contact_duration", "time_of_peak", "peak_displacement",
                 "compression_time", "impulse", "dissipated_energy"):  # fmt: skip
        assert getattr(impact, name) == pytest.approx(getattr(plain, name), rel=1e-8, abs=1e-8)
    assert abs(impact.radiated_energy) < 1e-15 * impact.reduced_mass * impact.velocity**2
    times = np.linspace(0, 1.1 * plain.contact_duration, 300)
    assert np.abs(impact.force(times) - plain.force(times)).max() < 1e-8 * plain.peak_force


def test_a_very_stiff_mode_is_the_half_space():
    """It gives way by mu f / omega^2."""
    plain = rigid()
    errors = [abs(dimensionless([omega], 0.5, [1.0]).peak_force / plain.peak_force - 1) for omega in (50.0, 500.0)]
    assert errors[0] < 2 / 50**2
    assert errors[1] < 2 / 500**2


@pytest.mark.parametrize("share", [0.01, 1.0, 40.0])
def test_a_heavy_or_light_free_mode_is_a_second_body(share):
    """A mode that hardly begins to swing is a body of mass m / share at rest: e, T and P_max of the reduced mass."""
    impact, plain = dimensionless([1e-12], 0.01, [share], Elastic()), rigid(Elastic())
    reduced = 1 / (1 + share)
    assert impact.contact_duration == pytest.approx(plain.contact_duration * reduced**0.4, rel=1e-8)
    assert impact.peak_force == pytest.approx(plain.peak_force * reduced**0.6, rel=1e-8)
    assert impact.restitution == pytest.approx((1 - share) / (1 + share), abs=1e-8)
    damped = dimensionless([1e-12], 0.01, [share])
    assert damped.restitution == pytest.approx((0.5 - share) / (1 + share), abs=1e-8)
    assert damped.contacts == 1


# ---- thin plate -------------------------------------------------------------------------------------------------


def simply_supported(sides, thickness, place, highest):
    """Return frequency and compliance of the modes of a Kirchhoff plate of steel up to the highest frequency."""
    density, modulus = float(STEEL.density), float(STEEL.youngs_modulus)
    stiffness = modulus * thickness**3 / (12 * (1 - float(STEEL.poisson_ratio) ** 2))
    unit = np.pi / 2 * np.sqrt(stiffness / (density * thickness))
    counts = np.arange(1, int(np.sqrt(highest / unit) * max(sides)) + 2)
    m, n = (axis.ravel() for axis in np.meshgrid(counts, counts))
    frequency = unit * ((m / sides[0]) ** 2 + (n / sides[1]) ** 2)
    shape = np.sin(np.pi * m * place[0]) * np.sin(np.pi * n * place[1])
    compliance = shape**2 / (density * thickness * sides[0] * sides[1] / 4)
    order = np.argsort(frequency)[: np.count_nonzero(frequency <= highest)]
    return frequency[order], compliance[order]


@pytest.mark.parametrize(("radius", "dissipation", "first", "of_peak"), [
    (0.025, Elastic(), 0.0065, 0.035), (0.0487, Elastic(), 0.048, 0.095), (0.0487, HALF, 0.055, 0.045),
])  # fmt: skip
def test_a_large_plate_by_its_modes_becomes_zeners_thin_plate(radius, dissipation, first, of_peak):
    """Lambda .131 and .5: what is left falls as the highest frequency rises, and goes like its inverse."""
    given = {"sphere": Sphere(material=COAL, radius=radius)}
    zener = rigid(dissipation, **given, target=ThinPlate(material=STEEL, thickness=0.008))
    errors = []
    for turns in (8, 16, 32):  # periods of the fastest mode within the contact
        modes = simply_supported((0.9, 0.78), 0.008, (0.47, 0.46), turns / float(zener.contact_duration))
        impact = modal(modes[0], 1e-6, modes[1], dissipation, **given)
        assert abs(impact.restitution - zener.restitution) < first / turns
        assert abs(impact.peak_force / zener.peak_force - 1) < of_peak / turns
        assert abs(impact.radiated_energy / zener.radiated_energy - 1) < of_peak / turns
        assert impact.contacts == 1
        errors.append(abs(float(impact.restitution - zener.restitution)))
    assert np.array(errors[:-1]) / errors[1:] == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize(("radius", "dissipation"), [(0.025, Elastic()), (0.0487, Elastic()), (0.0487, HALF)])
def test_what_is_left_out_stands_in_one_more_mode(radius, dissipation):
    """Cut at 8 over the duration, the thin plate is met 40 times closer than without its residual compliance."""
    given = {"sphere": Sphere(material=COAL, radius=radius)}
    plate = ThinPlate(material=STEEL, thickness=0.008)
    zener = rigid(dissipation, **given, target=plate)
    highest = 8 / float(zener.contact_duration)
    frequency, compliance = simply_supported((1.5, 1.3), 0.008, (0.47, 0.46), highest)
    left_out = 2 / (np.pi * float(plate.impedance) * 2 * np.pi * highest)
    bare = modal(frequency, 1e-6, compliance, dissipation, **given)
    impact = modal(frequency, 1e-6, compliance, dissipation, **given, residual_compliance=left_out)
    assert abs(impact.restitution - zener.restitution) < abs(bare.restitution - zener.restitution) / 40
    assert abs(impact.restitution - zener.restitution) < 1e-4
    assert impact.peak_force == pytest.approx(zener.peak_force, rel=2e-3)
    assert impact.contact_duration == pytest.approx(zener.contact_duration, rel=5e-4)
    assert abs(impact.energy_error) < 1e-8


# ---- energy, and the method itself ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    """300 impacts on 7 modes over four decades, some damped, some with gravity, many of which are hit again."""
    draw = np.random.default_rng(11)
    n = 300
    plain = rigid()
    shape = draw.uniform(-1, 1, (n, 7))
    return modal(
        np.sort(np.exp(draw.uniform(np.log(0.2), np.log(60), 7))) / (2 * np.pi * float(plain.time_scale)),
        np.exp(draw.uniform(np.log(5e-4), np.log(0.7), 7)),
        shape**2 * np.exp(draw.uniform(np.log(0.1), np.log(30), 7)) / float(plain.reduced_mass),
        HuntCrossley(restitution=draw.choice([0.2, 0.5, 0.8, 1.0], n)),
        velocity=draw.uniform(1, 8, n),
        gravity=draw.choice([0.0, 9.81], n),
        window=0.01,
    )


def test_rebound_loss_and_beam_are_the_energy_of_impact(many):
    assert np.abs(many.energy_error).max() < 1e-8
    assert (many.contacts > 1).sum() > 30
    assert (many.radiated_energy > 0).all()
    assert (many.modal_dissipation > 0).all()


def test_momentum_is_kept(many):
    """Impulse of all contacts is (1 + e) m v and the pull until the last of them ends."""
    pull = many.gravity * many.end_of_contact
    expected = many.reduced_mass * ((1 + many.restitution) * many.velocity + pull)
    assert many.impulse == pytest.approx(expected, rel=1e-8)


def test_a_smaller_tolerance_gives_the_same(many):
    given = {name: getattr(many, name) for name in many.__dataclass_fields__}
    finer = ModalImpact(**{**given, "tolerance": 1e-9})
    assert (finer.contacts == many.contacts).all()
    for name in ("restitution", "peak_force", "contact_duration", "end_of_contact", "modal_energy"):
        assert getattr(finer, name) == pytest.approx(getattr(many, name), rel=1e-8, abs=1e-8)


# ---- batches, frames --------------------------------------------------------------------------------------------


def test_a_batch_is_its_impacts_one_by_one(many):
    for index in (0, 57, 299):
        alone = modal(
            many.frequency, many.damping_ratio, many.compliance[index],
            HuntCrossley(restitution=many.dissipation.restitution[index]),
            velocity=many.velocity[index], gravity=many.gravity[index], window=0.01,
        )  # fmt: skip
        assert alone.restitution == many.restitution[index]
        assert alone.peak_force == many.peak_force[index]
        assert alone.end_of_contact == many.end_of_contact[index]


def test_frames_hold_the_force_of_all_contacts(many):
    rate, n_samples, onset = 200e3, 1500, 2.37e-4
    ground = np.random.default_rng(2).normal(size=(300, n_samples))
    frames = ground.copy()
    many.add_to_frames(frames, rate, onset, threads=2)
    expected = many.force(np.arange(n_samples) / rate - onset)
    assert np.abs(frames - ground - expected).max() < 1e-9 * many.peak_force.max()
    again = many.contacts > 1
    after = np.arange(n_samples) / rate - onset > many.contact_duration[again, None]
    assert (expected[again] * after).any(axis=1).mean() > 0.5
    outside = np.arange(n_samples) / rate - onset > many.end_of_contact[:, None]
    assert (frames[outside] == ground[outside]).all()
    assert (expected >= 0).all()


# ---- bad input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"damping_ratio": [0.01, -0.1]}, "damping_ratio must .*got -0.1 at index 1"),
        ({"frequency": [900.0, 100.0]}, "frequency must ascend, got 100 Hz after 900 Hz at index 1"),
        ({"frequency": 100.0}, "frequency must be a list"),
        ({"damping_ratio": [0.1, 0.2, 0.3]}, "one number for each of the 2 frequencies"),
        ({"compliance": np.ones((3, 2)), "velocity": np.ones(2)}, "do not broadcast"),
        ({"residual_compliance": 1e-9, "frequency": [], "compliance": []}, "needs a mode above which it lies"),
        ({"target": ThinPlate(material=STEEL, thickness=0.01)}, "target must be a HalfSpace"),
        ({"gravity": 1e6}, "its weight holds it"),
    ],
)
def test_what_cannot_be_is_refused(changed, message):
    given = {"frequency": [100.0, 900.0], "damping_ratio": 0.01, "compliance": [0.1, 0.2], **changed}
    with pytest.raises(InvalidValue, match=message):
        modal(**given)
