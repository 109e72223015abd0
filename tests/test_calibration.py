"""On-site calibration against a beam in state space, run step by step at a fine rate, which knows nothing of poles."""

import numpy as np
import pytest
from scipy import signal

from cgid.calibration import calibrated
from cgid.errors import BadData, CgidError, InvalidValue
from cgid.physics import STEEL, YANG2018_SPHERES, HalfSpace, HuntCrossley, Impact, Sphere, free_fall_velocity
from cgid.scene import parse_scene, synthesise, varied
from cgid.signals import Signal
from cgid.units import STANDARD_GRAVITY

RATE, FINER, N_SAMPLES = 25_600.0, 16, 2560
FREQUENCY = np.array([118.0, 187.0, 402.0, 911.0, 1930.0, 2075.0, 4320.0])
DAMPING_RATIO = np.array([0.03, 0.02, 0.025, 0.012, 0.015, 0.01, 0.008])
MASS = np.array([210.0, 180.0, 260.0, 150.0, 320.0, 240.0, 200.0])
AT_IMPACT = np.array([0.9, 0.6, 0.8, -0.9, 0.8, 0.5, 0.9])
AT_SENSOR = np.array([0.7, -0.7, 0.5, 0.6, 0.9, 0.7, -0.4])
PARTICIPATION = AT_IMPACT * AT_SENSOR / MASS
MOUNTING = (22e3, 0.04)
EDGE, ORDER = 10e3, 8
#: [m/s^2] of the recorder.
OFFSET = 3.0


def scene_of(modes=slice(None), **sensor):
    rows = np.stack([FREQUENCY, DAMPING_RATIO, MASS, AT_IMPACT, AT_SENSOR], axis=1)[modes]
    names = ("frequency", "damping_ratio", "modal_mass", "shape_impact", "shape_sensor")
    return parse_scene(
        {
            "name": "beam",
            "impact": {
                "stiffness": "hertz",
                "dissipation": "hunt-crossley",
                "target": {"youngs_modulus": "210 GPa", "poisson_ratio": 0.3},
            },
            "tail_beam": {"modes": [dict(zip(names, row, strict=True)) for row in rows.tolist()]},
            "sampling": {"sampling_rate": RATE, "samples": N_SAMPLES, "pre_trigger": 128},
            "sensor": {
                "quantity": "acceleration",
                "mounting": {"frequency": MOUNTING[0], "damping_ratio": MOUNTING[1]},
                "anti_alias": {"frequency": EDGE, "order": ORDER},
            }
            | sensor,
            "taps": [
                {"label": "hammer", "shape": "half-sine", "peak_force": "4 kN", "contact_duration": "0.15 ms"},
                {"label": "hammer", "shape": "haversine", "peak_force": "2 kN", "contact_duration": "0.3 ms"},
            ],
        }
    )


BEFORE = scene_of()


def chained(system, sections):
    for w, zeta in sections:
        after = signal.StateSpace([[0, w], [-w, -2 * zeta * w]], [[0], [w]], [[1, 0]], [[0]])
        a = np.block([[system.A, np.zeros((len(system.A), 2))], [after.B @ system.C, after.A]])
        system = signal.StateSpace(
            a, np.vstack([system.B, after.B @ system.D]), np.hstack([after.D @ system.C, after.C]), [[0.0]]
        )
    return system


def the_beam():
    """Both channels of a recorder, acceleration and force, from the force."""
    n, w = FREQUENCY.size, 2 * np.pi * FREQUENCY
    a = np.block([[np.zeros((n, n)), np.diag(w)], [-np.diag(w), -np.diag(2 * DAMPING_RATIO * w)]])
    b = np.concatenate([np.zeros(n), np.ones(n)])[:, None]
    beam = signal.StateSpace(a, b, (PARTICIPATION @ a[n:])[None], [[PARTICIPATION.sum()]])
    poles = signal.butter(ORDER, 2 * np.pi * EDGE, analog=True, output="zpk")[1]
    recorder = [(abs(pole), -pole.real / abs(pole)) for pole in poles if pole.imag > 0]
    motion = chained(beam, [(2 * np.pi * MOUNTING[0], MOUNTING[1]), *recorder])
    hammer = chained(signal.StateSpace([[-1.0]], [[0.0]], [[0.0]], [[1.0]]), recorder)
    a = np.block(
        [[motion.A, np.zeros((len(motion.A), len(hammer.A)))], [np.zeros((len(hammer.A), len(motion.A))), hammer.A]]
    )
    c = np.zeros((2, len(a)))
    c[0, : len(motion.A)], c[1, len(motion.A) :] = motion.C[0], hammer.C[0]
    return signal.StateSpace(a, np.vstack([motion.B, hammer.B]), c, np.zeros((2, 1)))


def recorded(force, noise=0.01, seed=0):
    """Motion and force as a recorder has them, from the force (n_samples * FINER) at the fine rate."""
    time = np.arange(N_SAMPLES * FINER) / (RATE * FINER)
    both = signal.lsim(the_beam(), force(time), time)[1][::FINER].T
    rng = np.random.default_rng(seed)
    both += noise * np.abs(both).max(axis=1, keepdims=True) * rng.normal(size=both.shape)
    in_g = (both[0] + OFFSET) / STANDARD_GRAVITY
    motion = Signal(samples=in_g, sampling_rate=RATE, unit="g", source=f"motion {seed}")
    return motion, Signal(samples=both[1] / 1e3, sampling_rate=RATE, unit="kN", source=f"force {seed}")


def hammer(onset, peak, lasts):
    def force(time):
        share = (time - onset) / lasts
        return np.where((share > 0) & (share < 1), peak * np.sin(np.pi * np.clip(share, 0, 1)) ** 1.5, 0.0)

    return force


def tap(number, **how):
    """A hammer's blow, between two samples."""
    onset, peak = (150.3 + 7.7 * number) / RATE, 1500.0 + 900 * number
    motion, force = recorded(hammer(onset, peak, (0.20 + 0.04 * number) * 1e-3), seed=number, **how)
    return motion, force


def sphere_from(height, radius=0.03):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[3], radius=radius),
        target=HalfSpace(material=STEEL),
        velocity=float(free_fall_velocity(height)),
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=0.6),
    )


def drop(number, **how):
    onset, impact = (190.6 - 11.3 * number) / RATE, sphere_from(0.5 + 0.4 * number)
    motion, _ = recorded(lambda time: impact.force(time - onset), seed=100 + number, **how)
    return motion, impact


@pytest.fixture(scope="module")
def taps():
    return [tap(number) for number in range(3)]


@pytest.fixture(scope="module")
def drops():
    return [drop(number) for number in range(3)]


# ---- gain ------------------------------------------------------------------------------------------------------------


def off_by(gain):
    """A scene that is too quiet by a factor, or upside down."""
    content = scene_of().model_dump(mode="json", exclude_none=True)
    for row in content["tail_beam"]["modes"]:
        row["modal_mass"] *= abs(gain)
        row["shape_sensor"] *= np.sign(gain)
    return parse_scene(content)


def fitted(scene, *blows, **how):
    motions, causes = zip(*blows, strict=True)
    return calibrated(scene, motions, causes, **how)


@pytest.mark.parametrize("gain", [1.3, -0.04])
def test_gain_of_taps_and_drops(taps, drops, gain):
    for blows in (taps, drops, [taps[0], drops[1]]):
        found = fitted(off_by(gain), *blows)
        assert found.gain == pytest.approx(gain, rel=0.01)
        assert found.scene.sensor.gain == found.gain
        assert (found.explained > 0.95).all()
        # Calibrated once more it stays as it is: what is found is the whole gain.
        assert fitted(found.scene, *blows).gain == pytest.approx(gain, rel=0.01)


def test_an_impact_in_a_long_recording(taps, drops):
    for motion, cause in (taps[0], drops[0]):
        rest = np.random.default_rng(1).normal(0, 0.01, (2, 40_000))
        before = rest[0] * np.ptp(motion.samples) / 2 + OFFSET / STANDARD_GRAVITY
        long = of(motion, samples=np.concatenate([before, motion.samples]))
        if isinstance(cause, Signal):
            cause = of(cause, samples=np.concatenate([rest[1] * cause.samples.max(), cause.samples]))
        assert fitted(scene_of(), (long, cause)).gain == pytest.approx(1.0, rel=0.02)


def test_force_that_went_through_no_filter():
    force = hammer(150.4 / RATE, 2e3, 0.6e-3)
    motion, _ = recorded(force)
    raw = Signal(samples=force(np.arange(N_SAMPLES) / RATE), sampling_rate=RATE, unit="N")
    assert fitted(scene_of(), (motion, raw), filtered=False).gain == pytest.approx(1.0, rel=0.005)


PANEL = {
    "length": "1.2 m",
    "width": "0.8 m",
    "thickness": "30 mm",
    "edges": "simply-supported",
    "damping_ratio": "2 %",
    "sensor_point": {"x": "0.3 m", "y": "0.25 m"},
}


def panel_scene(width):
    content = scene_of(relative_noise="1 %").model_dump(mode="json", exclude_none=True)
    content["impact"]["target"]["density"] = 7850
    at = {"x": 0.5, "y": 0.3}
    if width:
        at["x"] = {"distribution": "uniform", "lowest": 0.5 - width, "highest": 0.5 + width}
    return parse_scene(content | {"tail_beam": PANEL | {"impact_point": at}})


def test_gain_of_a_panel_hit_at_its_point():
    truth = panel_scene(0.0)
    heard, felt = (next(synthesise(rig, 4, seed=3)) for rig in (truth, varied(truth, quantity="force", mounting=None)))
    motions = [Signal(samples=0.7 * row, sampling_rate=RATE, unit="m/s^2") for row in heard.signals]
    forces = [Signal(samples=row, sampling_rate=RATE, unit="N") for row in felt.signals]
    assert calibrated(truth, motions, forces).gain == pytest.approx(0.7, rel=0.01)
    with pytest.raises(InvalidValue, match="impact_point must be that of the impacts, it is a region"):
        calibrated(panel_scene(0.2), motions, forces)


def test_gain_is_a_factor_on_the_motion_alone():
    plain = scene_of(absolute_noise=0.0)
    louder = varied(plain, gain=-2.5)
    one, other = (next(synthesise(scene, 5, seed=1, dtype="float64")) for scene in (plain, louder))
    np.testing.assert_allclose(other.signals, -2.5 * one.signals, rtol=0, atol=1e-9 * np.abs(one.signals).max())
    assert np.array_equal(one.parameters["peak_force"], other.parameters["peak_force"])
    # The noise comes after it.
    noisy = [
        next(synthesise(varied(scene, absolute_noise=1.0), 5, seed=1, dtype="float64")) for scene in (plain, louder)
    ]
    np.testing.assert_allclose(noisy[1].signals - other.signals, noisy[0].signals - one.signals, atol=1e-6)


# ---- bad input -------------------------------------------------------------------------------------------------------


def of(signal_, change=None, **changes):
    given = {"samples": signal_.samples, "sampling_rate": signal_.sampling_rate, "unit": signal_.unit}
    return Signal(**given | changes | ({"samples": change(signal_.samples)} if change else {}))


def noise(samples):
    return np.random.default_rng(7).normal(size=samples.size)


def late(samples):
    return samples[156:]


BAD = {
    "motions must be 1 or more, and as many causes, got 0 and 0": lambda motion, force: calibrated(BEFORE, [], []),
    "as many causes, got 1 and 2": lambda motion, force: calibrated(BEFORE, [motion], [force, force]),
    "motion must be a Signal": lambda motion, force: calibrated(BEFORE, [motion.samples], [force]),
    "cause must be a Signal or Impact": lambda motion, force: calibrated(BEFORE, [motion], [force.samples]),
    "cause must be one impact, got 2": lambda motion, force: calibrated(
        BEFORE, [motion], [sphere_from(1.0, np.array([0.02, 0.03]))]
    ),
    "force must be in N, of 2560 samples at 25600 Hz as its motion": lambda motion, force: calibrated(
        BEFORE, [motion], [motion]
    ),
    "force must be in N, of 2560 samples": lambda motion, force: calibrated(
        BEFORE, [motion], [of(force, lambda samples: samples[:-1])]
    ),
    "motion must be acceleration at 25600 Hz.*got velocity": lambda motion, force: calibrated(
        BEFORE, [of(motion, unit="mm/s")], [force]
    ),
    "got no unit": lambda motion, force: calibrated(BEFORE, [of(motion, unit=None)], [force]),
    "got acceleration at 51200 Hz": lambda motion, force: calibrated(
        BEFORE, [of(motion, sampling_rate=2 * RATE)], [of(force, sampling_rate=2 * RATE)]
    ),
    "must have a sensor of motion": lambda motion, force: calibrated(
        varied(BEFORE, quantity="force"), [motion], [force]
    ),
    "force must rise 8 times above its noise of [1-9]": lambda motion, force: calibrated(
        BEFORE, [motion], [of(force, noise)]
    ),
    "force must rise 8 times above its noise of 0 N.*its peak is 0 N": lambda motion, force: calibrated(
        BEFORE, [motion], [of(force, np.zeros_like)]
    ),
    "be positive for compression": lambda motion, force: calibrated(BEFORE, [motion], [of(force, np.negative)]),
    "force must rise and fall within the recording": lambda motion, force: calibrated(
        BEFORE, [of(motion, late)], [of(force, late)]
    ),
    "motion must move, within the sensor's range": lambda motion, force: calibrated(
        varied(BEFORE, range="1 g"), [motion], [force]
    ),
    "motion must be due to its impact, which explains [01]": lambda motion, force: calibrated(
        BEFORE, [of(motion, noise)], [force]
    ),
    "motion must move, .*check the channel": lambda motion, force: calibrated(
        BEFORE, [of(motion, np.zeros_like)], [force]
    ),
    "motion must be due to its impact": lambda motion, force: calibrated(
        scene_of(slice(0, 1)), [of(motion, lambda samples: np.roll(samples, 900))], [force]
    ),
    "gain must be left out for a force": lambda motion, force: varied(BEFORE, quantity="force", gain=2.0),
    "gain must not be 0": lambda motion, force: varied(BEFORE, gain=0.0),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named(message, taps):
    with pytest.raises(CgidError, match=message) as caught:
        BAD[message](*taps[1])
    assert isinstance(caught.value, (BadData, InvalidValue)) and "\n" not in str(caught.value)
