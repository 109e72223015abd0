"""Signals of a scene against `Impact.force` by itself, and what the sensor makes of them."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from cgid.errors import BadData, InvalidValue
from cgid.physics import HUNT_CROSSLEY_LAWS, RIGID, Elastic, HalfSpace, HuntCrossley, Impact, Material, Sphere
from cgid.scene import parse_scene, synthesise
from cgid.scene.synthesis.draws import BLOCK

DATASETS = Path(__file__).parents[1] / "datasets"
STEEL = {"density": 7850, "youngs_modulus": "210 GPa", "poisson_ratio": 0.3}
RATE = 200e3


def uniform(lowest, highest):
    return {"distribution": "uniform", "lowest": lowest, "highest": highest}


def scene_of(samples=256, target="rigid", stiffness="hertz", elastic=False, law="exact", sensor=None, **sampling):
    population = {
        "density": uniform(1300, 1500),
        "youngs_modulus": uniform("2 GPa", "5 GPa"),
        "poisson_ratio": 0.3,
        "radius": uniform("15 mm", "40 mm"),
        "velocity": uniform(2, 8),
    }
    if not elastic:
        population["restitution"] = uniform(0.05, 1.0)
    return parse_scene(
        {
            "name": "small",
            "impact": {
                "stiffness": stiffness,
                "dissipation": "elastic" if elastic else "hunt-crossley",
                "law": law,
                "target": target,
            },
            "sampling": {"sampling_rate": RATE, "samples": samples, "pre_trigger": 16, **sampling},
            "sensor": sensor or {},
            "populations": [
                {"label": "coal", **population},
                {"label": "gangue", **population, "density": uniform(2300, 2600)},
            ],
        }
    )


def batch_of(scene, n_signals=BLOCK, seed=3, **options):
    (batch,) = synthesise(scene, n_signals, seed, **options)
    return batch


def impact_of(batch, scene):
    p = batch.parameters
    steel = Material(density=7850, youngs_modulus=210e9, poisson_ratio=0.3)
    return Impact(
        sphere=Sphere(
            material=Material(
                density=p["density"], youngs_modulus=p["youngs_modulus"], poisson_ratio=p["poisson_ratio"]
            ),
            radius=p["radius"],
        ),
        target=RIGID if scene.impact.target == "rigid" else HalfSpace(material=steel),
        velocity=p["velocity"],
        stiffness=scene.impact.stiffness,
        dissipation=(
            Elastic() if scene.impact.dissipation == "elastic" else HuntCrossley(restitution=p["restitution"])
        ),
    )


def expected_frames(batch, scene):
    times = np.arange(scene.sampling.samples) / RATE - batch.parameters["onset"][:, None]
    return impact_of(batch, scene).force(times)


def test_a_scene_takes_every_law_of_an_impact():
    for law in HUNT_CROSSLEY_LAWS:
        delivered = batch_of(scene_of(samples=32, law=law)).parameters["restitution"]
        asked = batch_of(scene_of(samples=32)).parameters["restitution"]
        assert delivered == pytest.approx(HuntCrossley(restitution=asked, law=law).delivered_restitution, rel=1e-12)
    with pytest.raises(BadData, match="law"):
        scene_of(law="newton")


# ---- clean signals ---------------------------------------------------------------------------------------------------

KINDS = [
    {"target": STEEL},
    {"target": "rigid"},
    {"target": STEEL, "stiffness": "series"},
    {"target": STEEL, "stiffness": "rigid-sphere"},
    {"target": STEEL, "elastic": True},
    # The stored restitution is the delivered one: by the exact law it gives the same pulse again.
    {"target": STEEL, "law": "flores"},
    {"target": STEEL, "law": "lee-wang"},
    {"target": STEEL, "jitter": 0.0},
]


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-6), ("float64", 1e-9)])
def test_clean_signals_are_the_force_of_each_impact(kind, dtype, tolerance):
    scene = scene_of(**kind)
    batch = batch_of(scene, dtype=dtype)
    assert batch.signals.dtype == dtype
    error = np.abs(batch.signals - expected_frames(batch, scene)).max(axis=1)
    assert (error / batch.parameters["peak_force"]).max() < tolerance


def test_nothing_before_touch_and_nothing_after_separation():
    scene = scene_of(samples=512)
    batch = batch_of(scene)
    times = np.arange(512) / RATE - batch.parameters["onset"][:, None]
    after = times > batch.parameters["contact_duration"][:, None]
    assert after.any(axis=1).all()
    assert (batch.signals[after] == 0).all()
    assert (batch.signals[:, :17] == 0).all()


def test_jitter_spreads_touch_over_its_share_of_a_sample():
    onsets = [batch.parameters["onset"] for batch in synthesise(scene_of(samples=32, jitter=0.4), 8 * BLOCK)]
    place = np.concatenate(onsets) * RATE - 16
    assert stats.kstest(place, stats.uniform(0, 0.4).cdf).pvalue > 1e-4


@pytest.mark.parametrize("samples", [24, 25, 40])
def test_pulses_cut_off_by_the_end_of_the_frame(samples):
    scene = scene_of(samples=samples)
    batch = batch_of(scene, dtype="float64")
    end = batch.parameters["onset"] + batch.parameters["contact_duration"]
    assert (end * RATE > samples).any()
    np.testing.assert_allclose(batch.signals, expected_frames(batch, scene), rtol=1e-6, atol=1e-5)


# ---- noise -----------------------------------------------------------------------------------------------------------


def residual(sensor, **options):
    scene = scene_of(samples=512, sensor=sensor)
    batch = batch_of(scene, **options)
    return batch, batch.signals - expected_frames(batch, scene)


@pytest.mark.parametrize(
    ("sensor", "relative", "absolute"),
    [
        ({"relative_noise": 0.02}, 0.02, 0),
        ({"absolute_noise": "30 N"}, 0, 30),
        ({"relative_noise": "2 %", "absolute_noise": 30}, 0.02, 30),
    ],
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_noise_is_white_gaussian_of_the_level_asked_for(sensor, relative, absolute, dtype):
    batch, noise = residual(sensor, dtype=dtype)
    scaled = noise / np.hypot(relative * batch.parameters["peak_force"], absolute)[:, None]
    # 131072 numbers: the deviation is known to 1 / sqrt(2 n) = 0.2 %.
    assert scaled.std() == pytest.approx(1, abs=4 * 0.002)
    assert abs(scaled.mean()) < 4 / np.sqrt(scaled.size)
    assert stats.kstest(scaled.ravel(), "norm").pvalue > 1e-4
    neighbours = np.mean(scaled[:, 1:] * scaled[:, :-1])
    assert abs(neighbours) < 4 / np.sqrt(scaled.size)


def test_float32_is_float64_with_four_roundings():
    """The pulse, the level of the noise, the noise and the sum are rounded, each to half an ulp."""
    scene = scene_of(sensor={"relative_noise": 0.02})
    single, double = (batch_of(scene, dtype=dtype).signals for dtype in ("float32", "float64"))
    pulse = batch_of(scene_of(), dtype="float64").signals
    noise = np.abs(double - pulse)
    assert (np.abs(single - double) <= 2.0**-24 * (pulse + 2 * noise + np.abs(double)) * (1 + 1e-6)).all()


# ---- the rest of the sensor ------------------------------------------------------------------------------------------


def test_bandwidth_is_a_low_pass_with_a_raised_cosine_edge():
    clean = batch_of(scene_of(), dtype="float64").signals
    limited = batch_of(scene_of(sensor={"bandwidth": "10 kHz"}), dtype="float64").signals
    frequency = np.fft.rfftfreq(256, 1 / RATE)
    place = np.clip((frequency - 10e3) / 5e3, -0.5, 0.5)
    expected = np.fft.irfft(np.fft.rfft(clean) * np.cos(np.pi / 2 * (place + 0.5)) ** 2, n=256)
    np.testing.assert_allclose(limited, expected, atol=1e-10 * clean.max())
    assert np.abs(limited - clean).max() > 1e-3 * clean.max()


def test_noise_is_not_limited_by_the_bandwidth():
    both = batch_of(scene_of(sensor={"absolute_noise": 30, "bandwidth": "10 kHz"}), dtype="float64").signals
    pulses = batch_of(scene_of(sensor={"bandwidth": "10 kHz"}), dtype="float64").signals
    noise = batch_of(scene_of(sensor={"absolute_noise": 30}), dtype="float64").signals
    clean = batch_of(scene_of(), dtype="float64").signals
    np.testing.assert_allclose(both - pulses, noise - clean, atol=1e-9)


def test_clipping_cuts_at_full_scale_and_changes_nothing_below():
    free = batch_of(scene_of(sensor={"absolute_noise": 100})).signals
    clipped = batch_of(scene_of(sensor={"absolute_noise": 100, "range": 150})).signals
    assert free.min() < -150 < 150 < free.max()
    np.testing.assert_array_equal(clipped, np.minimum(np.maximum(free, -150), 150))


@pytest.mark.parametrize("bits", [2, 8, 12])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_bits_are_levels_of_a_grid_within_the_range(bits, dtype):
    sensor = {"absolute_noise": 50, "range": "1024 N"}
    fine = batch_of(scene_of(sensor=sensor), dtype=dtype).signals
    coarse = batch_of(scene_of(sensor={**sensor, "bits": bits}), dtype=dtype).signals
    step = 2 * 1024 / 2**bits
    levels = coarse / step
    np.testing.assert_array_equal(levels, np.round(levels))
    assert coarse.min() >= -1024
    assert coarse.max() == 1024 - step
    inside = np.abs(fine) < 1024 - step
    assert np.abs(coarse - fine)[inside].max() <= step / 2
    assert np.unique(coarse).size <= 2**bits


# ---- what a signal depends on ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    scene = scene_of(samples=32, sensor={"relative_noise": 0.02})
    batches = list(synthesise(scene, 4 * BLOCK, 3))
    return scene, batches


def joined(batches, name):
    return np.concatenate(
        [batch.parameters[name] if name in batch.parameters else getattr(batch, name) for batch in batches]
    )


def test_batches_have_at_most_a_block_and_as_many_signals_as_asked(small):
    lengths = [len(batch) for batch in synthesise(small[0], 600, 3, first=100)]
    assert lengths == [156, 256, 188]


def test_blocks_differ(small):
    radius = joined(small[1], "radius")
    assert np.unique(radius).size == radius.size
    noise = joined(small[1], "signals")[:, :16] / joined(small[1], "peak_force")[:, None]
    blocks = noise.reshape(4, -1)
    assert np.abs(np.corrcoef(blocks)[np.triu_indices(4, 1)]).max() < 5 / np.sqrt(blocks.shape[1])


@pytest.mark.parametrize(("count", "first"), [(0, 0), (-1, 0), (1, -1), (10**30, 0), (1, 10**30), (1.5, 0)])
def test_impossible_ranges(small, count, first):
    with pytest.raises(InvalidValue, match="first" if first else "n_signals"):
        next(synthesise(small[0], count, first=first))
