"""Taps, second hits, clipping, randomised rigs, thin plates and variations of a scene, each against another way."""

import itertools
import json

import numpy as np
import pytest
from scipy import stats

from cgid.physics import Elastic, HuntCrossley, Impact, Material, Sphere, ThinPlate
from cgid.scene import load_scene, parse_scene, synthesise, varied
from cgid.scene.file.distributions import Constant, Uniform
from cgid.scene.file.sensor import clip
from cgid.scene.synthesis.draws import BLOCK, PARAMETER_UNITS
from cgid.scene.synthesis.impacts import draw
from cgid.shipped import scene_path

RATE = 200e3
STEEL = {"youngs_modulus": "210 GPa", "poisson_ratio": 0.3}
#: Force over peak against time over duration, written down again.
SHAPES = {
    "half-sine": lambda u: np.sin(np.pi * u),
    "square": lambda u: 1.0 + 0 * u,
    "triangle": lambda u: np.minimum(2 * u, 2 - 2 * u),
    "haversine": lambda u: (1 - np.cos(2 * np.pi * u)) / 2,
}


def uniform(lowest, highest):
    return {"distribution": "uniform", "lowest": lowest, "highest": highest}


ROCK = {
    "density": uniform(1300, 2500),
    "youngs_modulus": uniform("2 GPa", "8 GPa"),
    "poisson_ratio": 0.3,
    "radius": uniform("15 mm", "40 mm"),
    "velocity": uniform(2, 8),
    "restitution": uniform(0.2, 0.9),
}
SECOND = {"delay": uniform("50 us", "2 ms"), "ratio": uniform(0.3, 1.5)}


def tap(shape, **more):
    force, time = uniform("1 kN", "20 kN"), uniform("0.1 ms", "2 ms")
    return {"label": shape, "shape": shape, "peak_force": force, "contact_duration": time, **more}


TAPS = [tap(shape) for shape in SHAPES]


def scene_of(populations=(), taps=(), **sections):
    return parse_scene(
        {
            "name": "strangers",
            "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": "rigid"},
            "sampling": {"sampling_rate": RATE, "samples": 1024, "pre_trigger": 32},
            "populations": [{"label": f"rock {k}", **ROCK, **more} for k, more in enumerate(populations)],
            "taps": list(taps),
            **sections,
        }
    )


def batch_of(scene, n_signals=BLOCK, seed=3, **options):
    (batch,) = synthesise(scene, n_signals, seed, **options)
    return batch


# ---- taps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-7), ("float64", 1e-12)])
@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_taps_are_their_closed_form(dtype, tolerance, jitter):
    sampling = {"sampling_rate": RATE, "samples": 1024, "pre_trigger": 32, "jitter": jitter}
    batch = batch_of(scene_of(taps=TAPS, sampling=sampling), dtype=dtype)
    p = batch.parameters
    assert set(batch.labels) == set(SHAPES)
    share = (np.arange(1024) / RATE - p["onset"][:, None]) / p["contact_duration"][:, None]
    edge = np.minimum(np.abs(share), np.abs(share - 1)) < 1e-9
    for shape, function in SHAPES.items():
        own = batch.labels == shape
        expected = np.where((share > 0) & (share < 1), function(share), 0.0) * p["peak_force"][:, None]
        error = np.abs(batch.signals - expected)[own] / p["peak_force"][own, None]
        assert error[~edge[own]].max() < tolerance
    # A sample on touch itself holds no force, as in an impact.
    assert (batch.signals[:, :33] == 0).all()


def test_taps_and_populations_share_a_scene_by_their_weights():
    scene = scene_of([{"weight": 2}], [{**TAPS[0], "weight": 6}])
    batches = list(synthesise(scene, 16 * BLOCK, 1))
    labels = np.concatenate([batch.labels for batch in batches])
    assert abs(np.mean(labels == "half-sine") - 0.75) < 4 * np.sqrt(0.75 * 0.25 / labels.size)
    assert scene.labels == ("half-sine", "rock 0")
    for batch in batches:
        tapped = batch.labels == "half-sine"
        assert np.isnan(batch.parameters["radius"][tapped]).all()
        assert np.isfinite(batch.parameters["radius"][~tapped]).all()
        assert np.isfinite(batch.parameters["peak_force"]).all()


# ---- second hits -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["impact", "tap"])
@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 3e-7), ("float64", 1e-12)])
def test_a_second_hit_is_the_same_pulse_later_and_scaled(kind, dtype, tolerance):
    first = scene_of([{}]) if kind == "impact" else scene_of(taps=[tap("triangle")])
    both = batch_of(varied(first, second_hit=SECOND), dtype=dtype)
    p = both.parameters
    once = batch_of(first, dtype=dtype)
    for name in PARAMETER_UNITS:
        np.testing.assert_array_equal(p[name], once.parameters[name])
    times = np.arange(1024) / RATE - p["onset"][:, None]
    later = times - p["second_hit_delay"][:, None]
    pulse = _impact_of(p).force if kind == "impact" else lambda t: _triangle(t, p)
    expected = pulse(times) + p["second_hit_ratio"][:, None] * pulse(later)
    error = np.abs(both.signals - expected).max(axis=1) / p["peak_force"]
    assert error.max() < tolerance
    overlapping = p["second_hit_delay"] < p["contact_duration"]
    assert 0.05 < overlapping.mean() < 0.95


def _triangle(times, p):
    share = times / p["contact_duration"][:, None]
    return p["peak_force"][:, None] * np.maximum(0, 1 - np.abs(2 * share - 1))


def _impact_of(p, target=None):
    from cgid.physics import RIGID

    material = Material(density=p["density"], youngs_modulus=p["youngs_modulus"], poisson_ratio=p["poisson_ratio"])
    return Impact(
        sphere=Sphere(material=material, radius=p["radius"]),
        target=RIGID if target is None else target,
        velocity=p["velocity"],
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=p["restitution"]),
    )


# ---- clipping --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_clipped_pulse_is_flat_at_its_share_of_the_peak_and_unchanged_below(dtype, noise):
    free_scene = scene_of([{}], [tap("haversine")], sensor={"relative_noise": noise})
    free = batch_of(free_scene, dtype=dtype)
    clipped = batch_of(varied(free_scene, clipped_at=uniform(0.3, 0.8)), dtype=dtype)
    share = clipped.parameters["clipped_at"]
    assert stats.kstest(share, stats.uniform(0.3, 0.5).cdf).pvalue > 1e-3
    level = (share * free.parameters["peak_force"]).astype(dtype)[:, None]
    np.testing.assert_array_equal(clipped.signals, np.minimum(np.maximum(free.signals, -level), level))
    np.testing.assert_array_equal(clipped.signals.max(axis=1), level[:, 0])
    assert ((clipped.signals == level).sum(axis=1) > 3).all()


def test_clipping_takes_both_sides_of_its_own_frame():
    frames = np.array([[-3.0, 3.0], [-3.0, 3.0]])
    clip(frames, np.array([2.0, np.nan]))
    np.testing.assert_array_equal(frames, [[-2, 2], [-3, 3]])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_relative_range_is_that_of_each_peak(dtype):
    scene = scene_of([{}], [tap("haversine")], sensor={"relative_noise": 0.02, "relative_range": 0.6, "bits": 9})
    digital = batch_of(scene, dtype=dtype)
    analogue = batch_of(varied(scene, relative_range=None, bits=None), dtype=dtype)
    full = (0.6 * digital.parameters["peak_force"])[:, None]
    expected = np.clip(np.rint(analogue.signals / full * 2**8), -(2**8), 2**8 - 1) / 2**8
    # A sample between two steps may go to either.
    apart = np.abs(digital.signals / full - expected)
    assert np.sort(apart.ravel())[:-5].max() < 1e-6 and apart.max() < 1.001 / 2**8
    np.testing.assert_allclose(digital.signals.max(axis=1), full[:, 0] * (1 - 1 / 2**8), rtol=1e-6)
    wide = batch_of(varied(scene, relative_range=1.2, bits=24), dtype=dtype)
    np.testing.assert_allclose(wide.signals, analogue.signals, atol=1e-6 * full.max())


# ---- randomised rigs -------------------------------------------------------------------------------------------------

LOG_RATE = {"distribution": "log-uniform", "lowest": "25 kHz", "highest": "1 MHz"}
LOG_NOISE = {"distribution": "log-uniform", "lowest": 0.003, "highest": 0.3}


MIXED = {
    "noise_exponent": {"distribution": "mixed", "parts": [0, uniform(0, 1.2)]},
    "hum": {"distribution": "mixed", "parts": [0, uniform(0.01, 0.05)]},
    "hum_frequency": {"distribution": "choice", "values": [50, 60]},
    "relative_range": {"distribution": "mixed", "parts": [uniform(1, 1.2), uniform(0.5, 1)], "weights": [9, 1]},
    "bits": uniform(10, 24),
    "anti_alias_frequency": uniform("5 kHz", "400 kHz"),
}


def test_a_block_is_the_scene_fixed_at_all_that_it_drew():
    scene = scene_of([{}], [TAPS[0]], randomise={"sampling_rate": LOG_RATE, "relative_noise": LOG_NOISE, **MIXED})
    off = dict.fromkeys(("noise_exponent", "hum", "anti_alias_frequency"), 0)
    for block, batch in enumerate(synthesise(scene, 8 * BLOCK, 3)):
        one = {name: float(np.unique(batch.parameters[name]).item()) for name in ("relative_noise", *MIXED)}
        edge = None if np.isnan(one["anti_alias_frequency"]) else {"frequency": one["anti_alias_frequency"]}
        hum = [{"frequency": one["hum_frequency"], "relative_amplitude": one["hum"]}] if one["hum"] else []
        off["noise_exponent"] += one["noise_exponent"] == 0
        off["hum"] += not hum
        off["anti_alias_frequency"] += edge is None
        assert one["bits"] == round(one["bits"])
        sensor = {name: one[name] for name in ("relative_noise", "noise_exponent", "relative_range")}
        sensor |= {"bits": round(one["bits"])} | ({"anti_alias": edge} if edge else {})
        content = json.loads(scene.text)
        del content["randomise"]
        content |= {"sensor": sensor} | ({"background": {"hum": hum}} if hum else {})
        content["sampling"]["sampling_rate"] = batch.sampling_rate
        (alone,) = synthesise(parse_scene(content), BLOCK, 3, first=block * BLOCK)
        np.testing.assert_array_equal(alone.signals, batch.signals)
    assert all(0 < times < 8 for times in off.values())


def test_drawn_hum_is_added_to_the_background_that_is_given():
    given_hum = {"hum": [{"frequency": 500, "amplitude": 3.0}]}
    drawn = batch_of(scene_of([], [TAPS[0]], background=given_hum, randomise={"hum": 0.1}), dtype="float64")
    without = batch_of(scene_of([], [TAPS[0]]), dtype="float64")
    places = 2 * np.pi * np.array([[50], [500]]) * np.arange(1024) / RATE
    waves = np.concatenate([np.sin(places), np.cos(places)])
    parts = np.linalg.lstsq(waves.T, (drawn.signals - without.signals).T)[0]
    np.testing.assert_allclose(np.hypot(parts[0], parts[2]), 0.1 * drawn.parameters["peak_force"], rtol=1e-9)
    np.testing.assert_allclose(np.hypot(parts[1], parts[3]), 3.0, rtol=1e-6)


def test_settings_of_a_block_are_drawn_independently():
    scene = scene_of(
        taps=TAPS[:1],
        sampling={"sampling_rate": RATE, "samples": 64, "pre_trigger": 16},
        randomise={"sampling_rate": LOG_RATE, "relative_noise": LOG_NOISE, **MIXED},
    )
    draws = [draw(scene, 8, block) for block in range(400)]
    found = {name: np.array([d.parameters[name][0] for d in draws]) for name in ("relative_noise", *MIXED)}
    assert np.mean(found["noise_exponent"] == 0) == pytest.approx(0.5, abs=0.1)
    assert np.mean(found["relative_range"] < 1) == pytest.approx(0.1, abs=0.06)
    assert set(found["hum_frequency"]) == {50, 60} and set(found["bits"]) == set(range(10, 25))
    assert stats.kstest(found["noise_exponent"][found["noise_exponent"] > 0], stats.uniform(0, 1.2).cdf).pvalue > 1e-3
    found["rate"] = np.array([d.scene.sampling.sampling_rate for d in draws])
    del found["anti_alias_frequency"]  # off above a share of the rate
    for one, other in itertools.combinations(found.values(), 2):
        assert abs(stats.spearmanr(one, other).statistic) < 4.5 / np.sqrt(400)


# ---- addresses -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def everything():
    scene = scene_of(
        [{"second_hit": SECOND}, {"clipped_at": uniform(0.3, 0.8)}],
        [TAPS[0], tap("square", second_hit=SECOND)],
        sampling={"sampling_rate": RATE, "samples": 128, "pre_trigger": 16},
        sensor={"absolute_noise": "20 N"},
        randomise={"sampling_rate": LOG_RATE, "relative_noise": LOG_NOISE},
    )
    return scene, list(synthesise(scene, 4 * BLOCK, 3))


# ---- thin plates -----------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("dissipation", ["elastic", "hunt-crossley"])
def test_a_target_with_a_thickness_is_a_thin_plate(dissipation):
    elastic = dissipation == "elastic"
    rock = {"restitution": None} if elastic else {}
    section = {"stiffness": "hertz", "dissipation": dissipation, "target": {**STEEL, "thickness": "20 mm"}}
    scene = scene_of([rock], impact=section)
    batch = batch_of(scene, 24, dtype="float64")
    asked = batch_of(varied(scene, target="rigid"), 24).parameters["restitution"]
    p = batch.parameters
    steel = Material(density=7850.0, youngs_modulus=210e9, poisson_ratio=0.3)
    for row in range(24):
        one = {name: float(p[name][row]) for name in ("density", "youngs_modulus", "poisson_ratio")}
        impact = Impact(
            sphere=Sphere(material=Material(**one), radius=p["radius"][row]),
            target=ThinPlate(material=steel, thickness=0.02),
            velocity=p["velocity"][row],
            stiffness="hertz",
            dissipation=Elastic() if elastic else HuntCrossley(restitution=asked[row]),
        )
        assert p["restitution"][row] == pytest.approx(float(impact.restitution), rel=1e-10)
        assert p["restitution"][row] < asked[row]
        assert p["peak_force"][row] == pytest.approx(float(impact.peak_force), rel=1e-10)
        times = np.arange(1024) / RATE - p["onset"][row]
        np.testing.assert_allclose(batch.signals[row], impact.force(times), atol=1e-9 * p["peak_force"][row])


# ---- variations ------------------------------------------------------------------------------------------------------


def test_a_variation_is_the_scene_written_with_these_settings():
    scene = load_scene(scene_path("reference"))
    changed = varied(
        scene,
        stiffness="series",
        target="rigid",
        sampling_rate="100 kHz",
        samples=1024,
        pre_trigger=100,
        relative_noise="3 %",
        bandwidth="20 kHz",
        range="50 kN",
        bits=12,
        radius=Uniform(distribution="uniform", lowest=0.02, highest=0.03),
        density=Constant(value=1500),
        velocity="5 m/s",
    )
    assert (changed.impact.stiffness, changed.impact.target) == ("series", "rigid")
    assert (changed.sampling.sampling_rate, changed.sampling.samples, changed.sampling.pre_trigger) == (1e5, 1024, 100)
    assert changed.sensor.model_dump(exclude_none=True) == {
        "quantity": "force",
        "relative_noise": 0.03,
        "absolute_noise": 0.0,
        "bandwidth": 2e4,
        "range": 5e4,
        "bits": 12,
    }
    for population, old in zip(changed.populations, scene.populations, strict=True):
        assert population.radius.extremes == pytest.approx((0.02, 0.03))
        assert population.density.extremes == (1500, 1500)
        assert population.velocity.extremes == (5, 5)
        assert population.drop_height is None
        assert (population.youngs_modulus, population.label) == (old.youngs_modulus, old.label)
    assert changed.sha256 != scene.sha256
    assert parse_scene(json.loads(changed.text)) == changed
    assert varied(scene) == scene
    assert varied(scene).sha256 == scene.sha256
    assert varied(changed, range=None, bits=None).sensor.range is None
    assert varied(scene, restitution=None, dissipation="elastic").impact.dissipation == "elastic"


@pytest.mark.parametrize(
    ("rate", "samples", "pre_trigger"), [("400 kHz", 4096, 400), (100e3, 1024, 100), ("20 kHz", 249, 64)]
)
def test_a_frame_keeps_its_seconds(rate, samples, pre_trigger):
    scene = load_scene(scene_path("reference"))
    changed = varied(scene, keep_frame=True, sampling_rate=rate).sampling
    assert (changed.samples, changed.pre_trigger) == (samples, pre_trigger)
    after = (changed.samples - changed.pre_trigger) / changed.sampling_rate
    assert after == pytest.approx((2048 - 200) / 200e3, abs=0.5 / changed.sampling_rate)
