"""Streams: when rocks come and what they are, how they bounce, and what a recording holds of it."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import integrate, stats

from cgid.physics import HalfSpace, HuntCrossley, Impact, Material, Sphere
from cgid.scene import parse_scene, plan, record, varied
from cgid.scene.file.schema import samples_of
from cgid.scene.file.stream_section import RateTable
from cgid.scene.synthesis.impacts import impact_of, impacts_by_coupling, recorder_of
from cgid.scene.synthesis.rocks import PoissonTimes, arrivals_of

GRAVITY = 9.80665
RATE = 25_600.0


def population(label, **changes):
    return {
        "label": label,
        "density": 1400,
        "youngs_modulus": "3 GPa",
        "poisson_ratio": 0.3,
        "radius": {"distribution": "uniform", "lowest": "10 mm", "highest": "50 mm"},
        "restitution": 0.5,
        "drop_height": {"distribution": "uniform", "lowest": "0.5 m", "highest": "3 m"},
        **changes,
    }


def content(populations=None, sensor=None, target=None, background=None, tail_beam=None, **stream):
    found = {
        "name": "stream",
        "impact": {
            "stiffness": "hertz",
            "dissipation": "hunt-crossley",
            "target": target or {"youngs_modulus": "210 GPa", "poisson_ratio": 0.3},
        },
        "sampling": {"sampling_rate": RATE},
        "populations": populations or [population("coal"), population("gangue", density=2450)],
        "stream": {"duration": "20 s", "arrivals": {"rate": "8 Hz"}, **stream},
    }
    if sensor:
        found["sensor"] = sensor
    if background:
        found["background"] = background
    if tail_beam:
        found["tail_beam"] = tail_beam
    return found


def scene_of(**changes):
    return parse_scene(content(**changes))


def on_beam(x, length="20 m", **changes):
    """Return the changes that put a stream on a beam as stiff as a half space: thick, and without its edges' echo."""
    return {
        "tail_beam": {
            "length": length,
            "width": "1 m",
            "thickness": "0.9 m",
            "edges": "cantilever",
            "damping_ratio": 0.02,
            "impact_point": {
                "x": x if isinstance(x, dict) else {"distribution": "uniform", "lowest": x, "highest": x + 0.1},
                "y": {"distribution": "uniform", "lowest": 0.4, "highest": 0.5},
            },
            "sensor_point": {"x": 0.5, "y": 0.45},
            "coupling": "impedance",
            **changes,
        }
    }


def arrivals(scene, seed=0, recording=0):
    stream = scene.stream
    times = [stretch.times for stretch in arrivals_of(stream).stretches(stream.duration, seed, recording)]
    joined = np.concatenate(times)
    return joined[joined < stream.duration]


# ---- when rocks arrive -----------------------------------------------------------------------------------------------


def test_poisson_arrivals_have_poisson_counts_and_exponential_gaps():
    scene = scene_of(duration="400 s", arrivals={"rate": "25 Hz"})
    times = arrivals(scene)
    assert abs(times.size - 10_000) < 4 * 100
    assert stats.kstest(np.diff(times), "expon", args=(0, 1 / 25)).pvalue > 1e-3
    # Counts in windows have the variance of their mean, also in windows as long as a stretch (5.12 s).
    for width in (0.2, 5.12, 10.24):
        counts = np.histogram(times, np.arange(0, 400, width))[0]
        dispersion = (counts.size - 1) * counts.var(ddof=1) / counts.mean()
        assert 1e-3 < stats.chi2.cdf(dispersion, counts.size - 1) < 1 - 1e-3


def test_arrivals_follow_a_rate_that_changes():
    table = {"times": ["50 s", "150 s", "250 s"], "values": [2, 40, 0]}
    scene = scene_of(duration="300 s", arrivals={"rate": table})
    times = np.concatenate([arrivals(scene, seed) for seed in range(4)])
    edges = np.arange(0, 301, 10.0)
    wanted = [
        4 * integrate.quad(lambda t: np.interp(t, [50, 150, 250], [2, 40, 0]), low, high, epsabs=1e-10)[0]
        for low, high in pairwise(edges)
    ]
    counts = np.histogram(times, edges)[0]
    assert (counts[-5:] == 0).all()
    held = np.array(wanted) > 0
    squares = (counts[held] - np.array(wanted)[held]) ** 2 / np.array(wanted)[held]
    assert 1e-3 < stats.chi2.cdf(squares.sum(), held.sum()) < 1 - 1e-3


@pytest.mark.parametrize("values", [(2.0, 40.0, 0.0), (5.0, 5.0, 5.0), (0.0, 0.0, 3.0)])
def test_expected_arrivals_and_their_inverse(values):
    process = PoissonTimes(RateTable(times=(1.0, 4.0, 6.0), values=values))
    moments = np.linspace(0, 9, 91)
    wanted = [
        integrate.quad(lambda t: np.interp(t, [1, 4, 6], values), 0, t, points=[1, 4, 6], limit=200)[0] for t in moments
    ]
    np.testing.assert_allclose(process.expected(moments), wanted, atol=1e-9)
    numbers = np.linspace(0, float(process.expected(9.0)) * (1 - 1e-12), 50)
    np.testing.assert_allclose(process.expected(process.time_of(numbers)), numbers, atol=1e-9)


@pytest.mark.parametrize("many", [3, 700])
def test_given_times_are_those_of_the_impacts(many):
    wanted = np.sort(np.random.default_rng(1).uniform(0, 100, many))
    scene = scene_of(duration="100 s", arrivals={"times": wanted.tolist()})
    found = record(scene)[1]
    np.testing.assert_array_equal(found["time"], wanted)
    np.testing.assert_array_equal(found["rock"], np.arange(many))
    assert np.unique(found["specimen"]).size == many


# ---- what they are ---------------------------------------------------------------------------------------------------


def test_labels_follow_the_mixture_over_time():
    mixture = {"times": ["0 s", "200 s", "300 s"], "gangue": [0.05, 0.2, 0.9]}
    scene = scene_of(duration="400 s", arrivals={"rate": "30 Hz"}, mixture=mixture)
    found = record(scene, seed=3)[1]
    edges = np.arange(0, 401, 20.0)
    total = np.histogram(found["time"], edges)[0]
    gangue = np.histogram(found["time"][found["label"] == "gangue"], edges)[0]
    share = np.interp((edges[:-1] + edges[1:]) / 2, [0, 200, 300], [0.05, 0.2, 0.9])  # linear within every window
    squares = (gangue - total * share) ** 2 / (total * share * (1 - share))
    assert 1e-3 < stats.chi2.cdf(squares.sum(), total.size) < 1 - 1e-3


# ---- rebounds --------------------------------------------------------------------------------------------------------


def one_rock(**stream):
    kind = population("coal", radius="30 mm", drop_height=None, velocity=4.0, restitution=0.6)
    del kind["drop_height"]
    return scene_of(populations=[kind], **{"arrivals": {"times": [0.25]}, **stream})


def flown(normal, slip, slope):
    """Return time, way down the slope, normal speed and slip at the next touch: the fall integrated in the plane."""

    def fall(_, state):
        return [state[2], state[3], GRAVITY * np.sin(slope), -GRAVITY * np.cos(slope)]

    def touch(t, state):
        return state[1] if t > 0 else 1.0

    touch.terminal, touch.direction = True, -1
    found = integrate.solve_ivp(
        fall, (0, 10), [0, 0, slip, normal], events=touch, rtol=1e-11, atol=1e-13, max_step=0.01
    )
    x, _, u, w = found.y_events[0][0]
    return found.t_events[0][0], x, -w, u


@pytest.mark.parametrize("slope", [0.0, 0.35, 1.2])
def test_bounces_against_the_fall_integrated_in_time(slope):
    found = record(one_rock(inclination=slope, rebounds={"most": 4}, **on_beam(0.2)))[1]
    assert (found["bounce"] == np.arange(5)).all()
    assert 0.2 <= found["impact_x"][0] <= 0.3 and (found["impact_y"] == found["impact_y"][0]).all()
    assert 0.4 <= found["impact_y"][0] <= 0.5
    normal, slip = 4 * np.cos(slope), 4 * np.sin(slope)
    time, x = 0.25, found["impact_x"][0]
    for row in range(5):
        assert found["velocity"][row] == pytest.approx(normal, rel=1e-9)
        assert found["time"][row] == pytest.approx(time, abs=1e-9)
        assert found["impact_x"][row] == pytest.approx(x, abs=1e-8)
        contact = found["contact_duration"][row]
        in_contact = slip * contact + GRAVITY * np.sin(slope) * contact**2 / 2
        slip += GRAVITY * np.sin(slope) * contact
        flight, way, normal, slip = flown(found["restitution"][row] * normal, slip, slope)
        time, x = time + contact + flight, x + in_contact + way


def test_when_a_rock_is_followed_no_further():
    assert record(one_rock())[1]["bounce"].tolist() == [0]
    by_count = record(one_rock(rebounds={"most": 3}))[1]
    assert by_count["bounce"].tolist() == [0, 1, 2, 3]
    by_speed = record(one_rock(rebounds={"most": 1000, "least_speed": "0.1 m/s"}))[1]
    speeds = 4 * 0.6 ** np.arange(100)
    np.testing.assert_allclose(by_speed["velocity"], speeds[speeds >= 0.1], rtol=1e-12)
    noise = by_speed["peak_force"][2] * 1.01
    noisy = varied(one_rock(rebounds={"most": 1000}), absolute_noise=noise)
    assert record(noisy)[1]["bounce"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("target", [None, {"youngs_modulus": "210 GPa", "poisson_ratio": 0.3, "thickness": "15 mm"}])
def test_energy_never_grows_and_each_bounce_has_what_the_impact_left(target):
    found = record(scene_of(target=target, rebounds={"most": 5}))[1]
    material = Material(
        density=found["density"], youngs_modulus=found["youngs_modulus"], poisson_ratio=found["poisson_ratio"]
    )
    scene = scene_of(target=target)
    alone = Impact(
        sphere=Sphere(material=material, radius=found["radius"]),
        target=scene.impact.body,
        velocity=found["velocity"],
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=0.5),
    )
    np.testing.assert_allclose(found["restitution"], alone.restitution, rtol=1e-12)
    np.testing.assert_allclose(found["peak_force"], alone.peak_force, rtol=1e-12)
    assert (found["restitution"].max() < 0.5) == (target is not None)
    for rock in np.unique(found["rock"]):
        own = found["rock"] == rock
        speed, left = found["velocity"][own], (found["restitution"] * found["velocity"])[own]
        assert (np.diff(found["time"][own]) > found["contact_duration"][own][:-1]).all()
        assert (np.diff(speed) < 0).all()
        np.testing.assert_allclose(speed[1:], left[:-1], rtol=1e-14)


# ---- what is recorded ------------------------------------------------------------------------------------------------


def forces_alone(found, scene, n_samples):
    """Return the sum of the forces of all impacts, each computed on the whole axis: the slow twin."""
    out, times = np.zeros(n_samples), np.arange(n_samples) / RATE
    for row in range(found["time"].size):
        material = Material(
            density=found["density"][row], youngs_modulus=found["youngs_modulus"][row], poisson_ratio=0.3
        )
        impact = Impact(
            sphere=Sphere(material=material, radius=found["radius"][row]),
            target=scene.impact.body,
            velocity=found["velocity"][row],
            stiffness="hertz",
            dissipation=HuntCrossley(restitution=0.5),
        )
        out += impact.force(times - found["time"][row])
    return out


def test_the_recording_is_the_sum_of_its_impacts():
    # So many that most overlap.
    scene = scene_of(duration="0.2 s", arrivals={"rate": "2 kHz"}, rebounds={"most": 2})
    signal, found = record(scene, dtype="float64")
    assert isinstance(scene.impact.body, HalfSpace) and found["overlapping"].mean() > 0.3
    wanted = forces_alone(found, scene, signal.samples.size)
    np.testing.assert_allclose(signal.samples, wanted, atol=1e-9 * wanted.max())


def test_overlaps_and_distances_against_every_pair():
    found = record(scene_of(duration="1 s", arrivals={"rate": "400 Hz"}, rebounds={}))[1]
    start, end = found["time"], found["time"] + found["contact_duration"]
    pairs = (start[:, None] < end) & (start < end[:, None])
    np.fill_diagonal(pairs, False)
    np.testing.assert_array_equal(found["overlapping"], pairs.any(axis=1))
    assert 0.1 < found["overlapping"].mean() < 0.9
    np.testing.assert_allclose(found["next_impact"][:-1], np.diff(start), rtol=1e-12)
    assert np.isnan(found["next_impact"][-1])


ACCELERATION = {"quantity": "acceleration", "anti_alias": {"frequency": "8 kHz", "order": 6}}


def beam(**changes):
    """Return a thin beam that rings, and the coarse way to reckon with it."""
    x = {"distribution": "uniform", "lowest": 0.2, "highest": 1.1}
    return on_beam(x, "1.2 m", thickness="40 mm", **changes)


@pytest.mark.long
@pytest.mark.parametrize("sensor", [ACCELERATION, {"quantity": "velocity"}, {"mounting": {"frequency": "3 kHz"}}])
def test_the_ringing_of_every_impact_goes_on_through_the_recording(sensor):
    # Over several stretches, of which each ringing passes the end.
    scene = scene_of(duration="6 s", arrivals={"rate": "60 Hz"}, sensor=sensor, rebounds={"most": 1}, **beam())
    signal, found = record(scene, dtype="float64")
    assert signal.unit == scene.sensor.unit and len(set(found["time"] // (128 / 60))) == 3
    planned = plan(scene, "recordings")
    heard = recorder_of(planned)
    # All at once, in one frame as long as the recording. What was asked is more than what the beam has left.
    asked = {**found, "restitution": np.full(found["time"].size, 0.5)}
    impact = impact_of(planned, asked, np.arange(found["time"].size))
    wanted, rows = np.zeros((1, signal.samples.size)), np.zeros(found["time"].size, int)
    heard.response.add_to_frames(wanted, impact, found["time"], heard.participation(found), rows=rows)
    np.testing.assert_allclose(signal.samples, wanted[0], atol=1e-4 * np.abs(wanted).max())


def test_rocks_that_feel_the_modes_of_the_beam_bounce_by_what_these_leave():
    changes = {"sensor": ACCELERATION, "rebounds": {"most": 1}, **beam(coupling="modes")}
    scene = scene_of(duration="2 s", arrivals={"rate": "20 Hz"}, **changes)
    signal, found = record(scene)
    assert np.abs(signal.samples).max() > 0 and found["bounce"].max() == 1
    planned = plan(scene, "recordings")
    asked = {**found, "restitution": np.full(found["time"].size, 0.5)}
    for row in (0, found["time"].size - 1):
        alone = {name: column[row : row + 1] for name, column in asked.items()}
        ((_, impact, _),) = impacts_by_coupling(planned, impact_of(planned, alone, np.arange(1)), alone, np.arange(1))
        assert found["restitution"][row] == pytest.approx(float(impact.restitution[0]), rel=1e-9)
        assert found["restitution"][row] != pytest.approx(0.5, rel=1e-3)


def test_drift_and_noise_density_run_through_the_chunks():
    scene = scene_of(
        arrivals={"times": [19.9]}, sensor={"drift": "3 N/s", "offset": "-5 N", "noise_density": "0.1 N/sqrt(Hz)"}
    )
    samples = record(scene, dtype="float64")[0].samples[: int(19 * RATE)]
    slope, offset = np.polyfit(np.arange(samples.size) / RATE, samples, 1)
    assert slope == pytest.approx(3, rel=0.01) and offset == pytest.approx(-5, abs=0.2)
    rest = samples - np.polyval([3, -5], np.arange(samples.size) / RATE)
    assert rest.std() == pytest.approx(0.1 * np.sqrt(RATE / 2), rel=0.01)


def test_noise_range_and_bits_close_the_chain():
    sensor = {"absolute_noise": "50 N", "range": "5 kN", "bits": 12}
    scene = scene_of(sensor=sensor, arrivals={"rate": "2 Hz"})
    samples = record(scene, dtype="float64")[0].samples
    step = 5000 / 2**11
    assert samples.max() == 5000 - step
    np.testing.assert_array_equal(samples / step, np.rint(samples / step))
    assert np.std(samples[np.abs(samples) < 300]) == pytest.approx(50, rel=0.02)


# ---- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping_ratio", [1e-3, 1e-9])
def test_a_beam_that_rings_beyond_the_end_needs_no_more_memory_than_the_recording(damping_ratio):
    """A mode of 50 Hz and a damping ratio of 1e-9 rings for two years."""
    table = [{"frequency": 50, "damping_ratio": damping_ratio, "modal_mass": 100, "shape_impact": 1, "shape_sensor": 1}]
    made = scene_of(
        tail_beam={"modes": table},
        sensor={"quantity": "acceleration"},
        duration=0.1,
        arrivals={"times": [0.02, 0.09]},
    )
    signal, truth = record(made)
    assert signal.samples.size == samples_of(made)
    assert len(truth["time"]) == 2 and np.isfinite(signal.samples).all()
    assert np.abs(signal.samples[-1]) > 0


@pytest.mark.parametrize(
    ("frequency", "mass", "restitution"), [(300.0, 0.05, 0.3), (300.0, 0.2, 0.3), (800.0, 0.2, 0.9)]
)
def test_a_beam_that_swings_back_hits_again_in_the_recording(frequency, mass, restitution):
    """The force of all contacts together gives the rock its rebound: m v (1 + e)."""
    row = {"frequency": frequency, "damping_ratio": 0.01, "modal_mass": mass, "shape_impact": 1.0, "shape_sensor": 1.0}
    scene = parse_scene(
        {
            "name": "light",
            "impact": {
                "stiffness": "hertz",
                "dissipation": "hunt-crossley",
                "target": {"youngs_modulus": 210e9, "poisson_ratio": 0.3},
            },
            "tail_beam": {"modes": [row]},
            "sampling": {"sampling_rate": 2e6},
            "stream": {
                "duration": 0.05,
                "arrivals": {"times": [0.01]},
                "rebounds": {"most": 1, "least_speed": 100.0},
            },
            "populations": [
                {
                    "label": "coal",
                    "density": 1400.0,
                    "youngs_modulus": 3e9,
                    "poisson_ratio": 0.3,
                    "radius": 0.03,
                    "restitution": restitution,
                    "velocity": 5.0,
                }
            ],
        }
    )
    signal, truth = record(scene, 0)
    momentum = 4 / 3 * np.pi * 0.03**3 * 1400.0 * 5.0
    impulse = signal.samples.sum(dtype=np.float64) / 2e6
    assert impulse == pytest.approx(momentum * (1 + truth["restitution"][0]), rel=1e-5)
