"""The response of beam and sensor chain against matrix exponentials, which know nothing of poles and residues."""

import itertools

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

from cgid.errors import InvalidValue
from cgid.measure.modal import Modes
from cgid.physics import (
    STEEL,
    Elastic,
    HalfSpace,
    HighPass,
    HuntCrossley,
    Impact,
    LinearPhase,
    LowPass,
    Material,
    Resonance,
    Response,
    Sphere,
)
from cgid.physics.structure.driving import steps_for
from cgid.scene.file.sections import SHAPES
from cgid.scene.synthesis.impacts import TapPulses
from tests import few

RATE = 25_600.0
CHAIN = (Resonance(frequency=22e3, damping_ratio=0.04), LowPass(frequency=10_240.0, order=8))


def modes_of(frequency, damping_ratio):
    one = np.ones_like(frequency)
    return Modes(frequency=frequency, damping_ratio=damping_ratio, at_impact=one, at_sensor=one)


def some_modes(n=12, seed=1, highest=12e3):
    rng = np.random.default_rng(seed)
    frequency = np.sort(rng.uniform(60.0, highest, n))
    return modes_of(frequency, rng.uniform(0.005, 0.05, n))


def impacts(n, seed=0, lowest=0.1):
    rng = np.random.default_rng(seed)
    material = Material(
        density=rng.uniform(1300, 2600, n), youngs_modulus=rng.uniform(2e9, 3e10, n), poisson_ratio=np.full(n, 0.3)
    )
    return Impact(
        sphere=Sphere(material=material, radius=rng.uniform(0.01, 0.08, n)),
        target=HalfSpace(material=STEEL),
        velocity=rng.uniform(3, 7, n),
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=rng.uniform(lowest, 0.95, n)),
    )


def frames_of(response, pulses, onset, participation=None, n_samples=512, **how):
    frames = np.zeros((len(onset), n_samples))
    response.add_to_frames(frames, pulses, onset, participation, **how)
    return frames


def of_one(quantity, modes, participation):
    """Matrices of modes in state space: displacement times frequency, and velocity of each; nothing of poles."""
    n = modes.frequency.size
    w = 2 * np.pi * modes.frequency
    a = np.block([[np.zeros((n, n)), np.diag(w)], [-np.diag(w), -np.diag(2 * modes.damping_ratio * w)]])
    b = np.concatenate([np.zeros(n), np.ones(n)])
    c, d = np.zeros(2 * n), 0.0
    if quantity == "displacement":
        c[:n] = participation / w
    elif quantity == "velocity":
        c[n:] = participation
    else:
        c, d = participation @ a[n:], participation.sum()
    return signal.StateSpace(a, b[:, None], c[None], [[d]])


def with_chain(system):
    poles = signal.butter(CHAIN[1].order, 2 * np.pi * CHAIN[1].frequency, analog=True, output="zpk")[1]
    sections = [(abs(pole), -pole.real / abs(pole)) for pole in poles if pole.imag > 0]
    for w, zeta in [(2 * np.pi * CHAIN[0].frequency, CHAIN[0].damping_ratio), *sections]:
        after = signal.StateSpace([[0, w], [-w, -2 * zeta * w]], [[0], [w]], [[1, 0]], [[0]])
        a = np.block([[system.A, np.zeros((len(system.A), 2))], [after.B @ system.C, after.A]])
        b = np.vstack([system.B, after.B @ system.D])
        system = signal.StateSpace(a, b, np.hstack([after.D @ system.C, after.C]), after.D @ system.D)
    return system


def by_quadrature(system, impact, onset, n_samples, at=None):
    """The samples of one impact: Gauss quadrature of exp(A (t - s)) B P(s) over the contact so far."""
    duration = float(impact.contact_duration)
    times = np.arange(n_samples) / RATE - onset
    times = times if at is None else times[at]
    nodes, weights = np.polynomial.legendre.leggauss(96)
    share = (nodes + 1) / 2
    out = np.zeros(times.size)
    # In these variables the force is smooth at touch, and at separation once that is behind.
    whole = np.sin(np.pi * share / 2) ** 2, np.pi / 4 * np.sin(np.pi * share)
    begun = share**2, share
    for k in np.flatnonzero(times > 0):
        until = min(times[k], duration)
        place, slope = whole if times[k] >= duration else begun
        s = until * place
        force = impact.force(s)
        moved = expm(system.A[None] * (times[k] - s)[:, None, None]) @ system.B[:, 0]
        state = (weights * slope * until * force) @ moved
        out[k] = (system.C @ state)[0]
        if times[k] < duration:
            out[k] += system.D[0, 0] * float(impact.force(times[k : k + 1])[0])
    return out


def single(impact, i):
    values = {k: float(np.asarray(getattr(impact.sphere.material, k))[i]) for k in ("density", "youngs_modulus")}
    return Impact(
        sphere=Sphere(material=Material(poisson_ratio=0.3, **values), radius=float(impact.sphere.radius[i])),
        target=impact.target,
        velocity=float(impact.velocity[i]),
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=float(impact.dissipation.restitution[i])),
    )


@pytest.mark.parametrize(
    ("quantity", "chain"), few(itertools.product(["acceleration", "velocity", "displacement"], [True, False]), 2)
)
def test_agrees_with_matrix_exponentials(quantity, chain):
    modes, some = some_modes(6), impacts(3, seed=4)
    participation = np.random.default_rng(2).normal(size=(3, 6)) / 100
    onset = np.array([5.3, 6.0, 7.9]) / RATE
    response = Response(
        sampling_rate=RATE, quantity=quantity, modes=modes, filters=CHAIN if chain else (), tolerance=1e-9
    )
    heard = frames_of(response, some, onset, participation, 48)
    for i in range(3):
        system = of_one(quantity, modes, participation[i])
        expected = by_quadrature(with_chain(system) if chain else system, single(some, i), onset[i], 48)
        np.testing.assert_allclose(heard[i], expected, atol=2e-8 * np.abs(expected).max(), rtol=0)


@pytest.mark.long
def test_force_through_the_chain_agrees_with_matrix_exponentials():
    some, onset = impacts(2, seed=9), np.array([4.2, 5.5]) / RATE
    heard = frames_of(
        Response(sampling_rate=RATE, quantity="force", filters=CHAIN, tolerance=1e-9), some, onset, None, 40
    )
    nothing = signal.StateSpace(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), [[1.0]])
    for i in range(2):
        expected = by_quadrature(with_chain(nothing), single(some, i), onset[i], 40)
        np.testing.assert_allclose(heard[i], expected, atol=2e-8 * np.abs(expected).max(), rtol=0)


@pytest.fixture(scope="module")
def hundred_blows():
    """Frames of the same blows to any tolerance, and those that are exact."""
    some, modes = impacts(100, lowest=0.2), some_modes(40)
    participation = np.random.default_rng(0).normal(size=(100, 40)) / 100
    onset = (20 + np.random.default_rng(5).random(100)) / RATE
    given = {"sampling_rate": RATE, "quantity": "acceleration", "modes": modes, "filters": CHAIN}

    def to(tolerance):
        return frames_of(Response(**given, tolerance=tolerance), some, onset, participation)

    return to, to(1e-10)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 3e-5, 1e-6])
def test_error_over_the_largest_sample_keeps_to_the_tolerance(hundred_blows, tolerance):
    to, exact = hundred_blows
    close = to(tolerance)
    error = np.abs(close - exact).max(axis=1) / np.abs(exact).max(axis=1)
    assert error.max() < 5 * tolerance
    assert np.median(error) < tolerance
    assert steps_for(tolerance) < steps_for(tolerance / 10)


def test_float32_frames_are_those_of_float64_but_for_rounding():
    some, modes = impacts(20), some_modes(30)
    participation = np.random.default_rng(0).normal(size=(20, 30)) / 100
    response = Response(sampling_rate=RATE, quantity="acceleration", modes=modes, filters=CHAIN, tolerance=1e-6)
    onset = np.full(20, 10.4) / RATE
    exact = frames_of(response, some, onset, participation)
    rounded = np.zeros((20, 512), np.float32)
    response.add_to_frames(rounded, some, onset, participation)
    assert (np.abs(rounded - exact).max(axis=1) < 3e-6 * np.abs(exact).max(axis=1)).all()


def test_many_blows_on_one_long_recording_add_up():
    n, modes = 40, some_modes(10)
    some, rng = impacts(n, seed=3), np.random.default_rng(8)
    participation, onset = rng.normal(size=(n, 10)), np.sort(rng.uniform(-0.01, 0.2, n))
    response = Response(sampling_rate=RATE, quantity="velocity", modes=modes, filters=CHAIN, tolerance=1e-7)
    together = np.zeros((1, 4096))
    response.add_to_frames(together, some, onset, participation, rows=np.zeros(n, np.intp))
    apart = frames_of(response, some, onset, participation, 4096)
    np.testing.assert_allclose(together[0], apart.sum(axis=0), atol=2e-6 * np.abs(together).max(), rtol=0)


def test_threads_and_company_change_no_bit():
    modes, some = some_modes(10), impacts(30)
    participation, onset = np.random.default_rng(1).normal(size=(30, 10)), np.full(30, 3.3) / RATE
    response = Response(sampling_rate=RATE, quantity="acceleration", modes=modes, filters=CHAIN)
    alone = frames_of(response, some, onset, participation)
    assert np.array_equal(alone, frames_of(response, some, onset, participation, threads=3))


def test_square_pulse_on_one_mode_is_the_textbook_step_response():
    frequency, zeta, force, lasts = 400.0, 0.02, 1000.0, 1e-3
    tap = TapPulses(np.array([list(SHAPES).index("square")]), np.array([force]), np.array([lasts]))
    mode = modes_of(np.array([frequency]), np.array([zeta]))
    response = Response(sampling_rate=RATE, quantity="displacement", modes=mode, tolerance=1e-8)
    heard = frames_of(response, tap, np.array([0.0]), np.array([[0.25]]), 300)[0]
    w = 2 * np.pi * frequency
    damped = w * np.sqrt(1 - zeta**2)

    def step(t):
        t = np.maximum(t, 0.0)
        swing = np.cos(damped * t) + zeta * w / damped * np.sin(damped * t)
        return 0.25 * force / w**2 * (1 - np.exp(-zeta * w * t) * swing)

    t = np.arange(300) / RATE
    # A jump of the force falls between two steps: the error goes with the step alone.
    np.testing.assert_allclose(heard, step(t) - step(t - lasts), atol=1e-3 * heard.max())


@pytest.mark.parametrize("coupled", [(), (HighPass(frequency=50.0),)])
def test_frequency_response_is_that_of_transfer_functions(coupled):
    modes, participation = some_modes(5), np.random.default_rng(3).normal(size=5)
    frequencies = np.geomspace(10, 20e3, 50)
    response = Response(sampling_rate=RATE, quantity="acceleration", modes=modes, filters=CHAIN + coupled)
    s = 2j * np.pi * frequencies
    w = 2 * np.pi * modes.frequency
    expected = sum(
        p * s**2 / (s**2 + 2 * z * a * s + a**2) for p, z, a in zip(participation, modes.damping_ratio, w, strict=True)
    )
    mounted = 2 * np.pi * CHAIN[0].frequency
    expected *= mounted**2 / (s**2 + 2 * CHAIN[0].damping_ratio * mounted * s + mounted**2)
    expected *= signal.freqs_zpk(
        *signal.butter(CHAIN[1].order, 2 * np.pi * CHAIN[1].frequency, analog=True, output="zpk"), s.imag
    )[1]
    if coupled:
        expected *= s / (s + 2 * np.pi * 50.0)
    np.testing.assert_allclose(response.frequency_response(frequencies, participation), expected, rtol=1e-9)


def test_ac_coupling_takes_the_mean_of_a_force():
    rate, edge = 200e3, 50.0
    response = Response(sampling_rate=rate, quantity="force", filters=(HighPass(frequency=edge),))
    pulses, onset = impacts(8), np.full(8, 10.3 / rate)
    coupled, force = frames_of(response, pulses, onset, n_samples=2000), np.zeros((8, 2000))
    pulses.add_to_frames(force, rate, onset)
    # dy/dt = dx/dt - w y, exactly for straight lines between samples
    decay = np.exp(-2 * np.pi * edge / rate)
    slope = (1 - decay) / (2 * np.pi * edge / rate)
    expected = signal.lfilter([slope, -slope], [1, -decay], force, axis=1)
    assert np.abs(coupled - expected).max() < 2e-5 * force.max()
    assert (coupled.min(axis=1) < -0.005 * force.max(axis=1)).all()


@pytest.mark.parametrize("order", range(1, 13))
def test_low_pass_has_the_poles_of_butterworth(order):
    own = LowPass(frequency=1000.0, order=order).poles
    theirs = signal.butter(order, 2 * np.pi * 1000.0, analog=True, output="zpk")[1]
    theirs = theirs[theirs.imag > -1e-6]
    np.testing.assert_allclose(np.sort_complex(own), np.sort_complex(theirs), rtol=1e-12, atol=1e-6)
    assert ((own.imag == 0).sum()) == order % 2


def test_linear_phase_is_the_finite_impulse_response_of_scipy():
    """Taps of `firwin` with a Gaussian window, run over the same motion at 32 times the rate."""
    over, part = 32, LinearPhase(frequency=9000.0, transition=0.3)
    modes, pulses, onset = some_modes(), impacts(6), np.linspace(0.2, 1.9, 6) / RATE
    participation = np.random.default_rng(4).normal(size=(6, 12))
    fine = Response(sampling_rate=over * RATE, modes=modes, filters=CHAIN[:1])
    motion = frames_of(fine, pulses, onset, participation, n_samples=400 * over)
    n = 2 * round(part.delay * over * RATE) + 1
    window = ("gaussian", over * RATE / (2 * np.pi * part.width))
    taps = signal.firwin(n, part.frequency, window=window, fs=over * RATE)
    expected = signal.lfilter(taps, 1, motion, axis=1)[:, ::over]
    # The delay of the taps is a whole number of their steps.
    onset = onset + (n // 2) / (over * RATE) - part.delay
    through = Response(sampling_rate=RATE, modes=modes, filters=(*CHAIN[:1], part))
    found = frames_of(through, pulses, onset, participation, n_samples=400)
    np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())
    frequency = np.array([200.0, 4e3, 8e3, 9e3, 10e3])
    gains = through.frequency_response(frequency, participation[0]) / Response(
        sampling_rate=RATE, modes=modes, filters=CHAIN[:1]
    ).frequency_response(frequency, participation[0])
    _, own = signal.freqz(taps, 1, frequency, fs=over * RATE)
    np.testing.assert_allclose(np.abs(gains), np.abs(own), atol=1e-5)
    np.testing.assert_allclose(np.angle(gains * np.exp(2j * np.pi * frequency * part.delay)), 0, atol=1e-6)
    # From 99 % to 1 % over the stated transition.
    edges = part.frequency * (1 + np.array([-0.5, 0.5]) * part.transition)
    assert np.abs(signal.freqz(taps, 1, edges, fs=over * RATE)[1]) == pytest.approx([0.99, 0.01], abs=2e-4)


def test_resonance_on_a_mode_is_told_apart():
    mode = modes_of(np.array([500.0, 3000.0]), np.array([0.04, 0.04]))
    given = {"sampling_rate": RATE, "quantity": "acceleration", "modes": mode, "tolerance": 1e-6}
    on_it = Response(**given, filters=(Resonance(frequency=3000.0, damping_ratio=0.04),))
    frequencies = np.linspace(50, 10e3, 200)
    s, w = 2j * np.pi * frequencies, 2 * np.pi * mode.frequency[:, None]
    exact = (s**2 / (s**2 + 0.08 * w * s + w**2)).sum(axis=0) * w[1] ** 2 / (s**2 + 0.08 * w[1] * s + w[1] ** 2)
    found = on_it.frequency_response(frequencies, np.ones(2))
    assert np.abs(found - exact).max() < 0.03 * np.abs(exact).max()  # .001 over twice the damping ratio
    onset, participation, some = np.full(5, 5.5) / RATE, np.ones((5, 2)), impacts(5)
    rounded, heard = np.zeros((5, 512), np.float32), frames_of(on_it, some, onset, participation)
    on_it.add_to_frames(rounded, some, onset, participation)
    assert np.abs(rounded - heard).max() < 1e-4 * np.abs(heard).max()


BAD = {
    "damping_ratio must .*got 0": lambda: Resonance(frequency=1e4, damping_ratio=0.0),
    "damping_ratio must .*got -0.1": lambda: Resonance(frequency=1e4, damping_ratio=-0.1),
    "damping_ratio must .*got 1": lambda: Resonance(frequency=1e4, damping_ratio=1.0),
    "frequency of the low-pass must be above 0": lambda: LowPass(frequency=-1.0),
    "order of the low-pass must be at most 12": lambda: LowPass(frequency=1e3, order=13),
    "modes must be left out for a force": lambda: Response(
        sampling_rate=RATE, quantity="force", modes=some_modes(), filters=CHAIN
    ),
    "got velocity without modes": lambda: Response(sampling_rate=RATE, quantity="velocity", filters=CHAIN),
    "filters must be at least 1": lambda: Response(sampling_rate=RATE, quantity="force"),
    "tolerance must be": lambda: Response(sampling_rate=RATE, quantity="force", filters=CHAIN, tolerance=0.0),
    "a 65536th of a sample": lambda: frames_of(
        Response(sampling_rate=0.01, quantity="force", filters=(LowPass(frequency=0.001),)),
        Impact(
            sphere=Sphere(material=STEEL, radius=0.01),
            target=HalfSpace(material=STEEL),
            velocity=np.array([5.0]),
            stiffness="hertz",
            dissipation=Elastic(),
        ),
        np.array([1.0]),
    ),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named(message):
    with pytest.raises(InvalidValue, match=message):
        BAD[message]()
