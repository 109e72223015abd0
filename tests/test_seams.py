"""Simulated seams: the formula of a pulse, errors from a pool, and a model that learns from them."""

from dataclasses import replace

import numpy as np
import pytest

from cgid import load_model, shipped
from cgid.identification.model.model import Model
from cgid.learning import seams, streams
from cgid.learning.seams import Pool, pulse_of, simulated, wide, with_seams
from cgid.physics import HalfSpace, HuntCrossley, Impact, Sphere
from cgid.physics.contact.materials import STEEL, Material
from cgid.scene import load_scene, synthesise
from models.single_forces import pool_of_pulses


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model("default")


@pytest.fixture(scope="module")
def pool(model: Model) -> Pool:
    scene = wide(load_scene(shipped.scene_path("reference")))
    return pool_of_pulses(synthesise(scene, 1500, 3), model.measured)


def test_the_formula_is_that_of_a_damped_hertz_impact() -> None:
    rng, n = np.random.default_rng(1), 40
    density, radius = rng.uniform(1200, 2800, n), rng.uniform(0.01, 0.15, n)
    young, poisson = rng.uniform(1e9, 40e9, n), rng.uniform(0.2, 0.35, n)
    restitution, speed = rng.uniform(0.1, 0.9, n), rng.uniform(0.5, 8, n)
    impact = Impact(
        sphere=Sphere(material=Material(density=density, youngs_modulus=young, poisson_ratio=poisson), radius=radius),
        target=HalfSpace(material=STEEL),
        velocity=speed,
        stiffness="hertz",
        dissipation=HuntCrossley(restitution=restitution),
    )
    peak, width, e = np.exp(pulse_of(density, radius, young / (1 - poisson**2), restitution, speed)).T
    assert peak == pytest.approx(impact.peak_force, rel=1e-3)
    mass = 4 / 3 * np.pi * radius**3 * density
    assert width == pytest.approx(mass * speed * (1 + restitution) / impact.peak_force, rel=1e-3)
    assert e == pytest.approx(restitution)


def test_a_force_without_error_gives_the_pulses_of_the_formula(pool: Pool) -> None:
    errors = np.log(pool.measured[:, :3]) - pool.pulse
    known = np.isfinite(errors).all(axis=1)
    assert known.mean() > 0.95 and pool.told.all() and not pool.bounce.any()
    assert np.abs(np.median(errors[known], axis=0)).max() < 0.01
    assert np.quantile(np.abs(errors[known, :2]), 0.9, axis=0).max() < 0.05


def perfect(n: int, *, comes_back: float) -> Pool:
    """Return a pool that measures the formula, in which each rock comes back once with a share of its speed."""
    rng = np.random.default_rng(2)
    pulse = rng.uniform((5.0, -9.5, -2.3), (12.0, -6.0, -0.1), (n, 3))
    rest = np.tile([0.02, 0.01, 0.0, 0.0, 0.0, 0.0, 1.0], (n, 1))
    bounce = np.arange(n) % 2 == 1
    back = np.where(bounce, np.nan, comes_back)
    return Pool(
        pulse=pulse,
        measured=np.hstack([np.exp(pulse), rest]),
        told=np.ones(n, bool),
        bounce=bounce,
        loudness=np.zeros(n, int),
        back=back,
    )


def test_rocks_take_errors_and_bounces_from_the_pool(model: Model) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(seams, "_COAL", 30)
        patch.setattr(seams, "_GANGUE", 20)
        drawn = seams._drawn
        patch.setattr(seams, "_drawn", lambda *given: drawn(*given) | {"gain": np.zeros((6, 3))})
        pool = perfect(400, comes_back=0.8)
        made = simulated(pool, model, 6, np.random.default_rng(5))
        twice = simulated(pool, model, 6, np.random.default_rng(5))
        biased = replace(pool, measured=pool.measured * np.array([1.1, 1, 1, 1, 1, 1, 1, 1, 1, 1]))
        shifted = simulated(biased, model, 6, np.random.default_rng(5))
        deaf = simulated(replace(pool, told=np.zeros(400, bool)), model, 6, np.random.default_rng(5))
    assert made.pulses.tolist() == twice.pulses.tolist()
    assert np.diff(made.first).tolist() == [2] * 300  # each rock strikes, and once more
    # The second impact has the same restitution, and at 80 % of the speed that it left with it is longer and weaker.
    first, second = made.pulses[::2], made.pulses[1::2]
    assert first[:, 2] == pytest.approx(second[:, 2])
    assert second[:, 0] - first[:, 0] == pytest.approx(1.2 * (np.log(0.8) + first[:, 2]), abs=1e-9)
    assert second[:, 1] - first[:, 1] == pytest.approx(-0.2 * (np.log(0.8) + first[:, 2]), abs=1e-9)
    assert shifted.pulses - made.pulses == pytest.approx(np.tile([np.log(1.1), 0, 0], (600, 1)), abs=1e-9)
    assert deaf.first[-1] == 0


def test_coal_and_gangue_of_the_prior_overlap_but_differ() -> None:
    drawn = seams._drawn(400, np.random.default_rng(1))
    by_seam = np.log(drawn["modulus"]).reshape(400, -1)
    coal, gangue = by_seam[:, : seams._COAL], by_seam[:, seams._COAL :]
    ratio = np.exp(gangue.mean(axis=1) - coal.mean(axis=1))
    assert 1.2 < ratio.min() < 1.8 and 10 < ratio.max() < 25
    assert np.exp(coal.mean(axis=1)).min() < 2e9 < 5e9 < np.exp(coal.mean(axis=1)).max()


def test_a_model_learns_fractions_of_seams_and_answers_impacts_as_before(model: Model, pool: Pool) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(seams, "_JUDGES", 60)
        patch.setattr(seams, "_EPOCHS", ((12, 3e-3),))
        made, again = (with_seams(model, [pool], 4, 240) for _ in range(2))
    assert made.to_bytes() == again.to_bytes()
    told = made.training["seams"]
    assert told["anchored"]["rms"] < 0.2 < 0.29  # a constant of .5 errs by .29
    assert told["anchored"]["rms"] < told["alone"]["rms"]
    assert told["anchored"]["width"] < told["alone"]["width"]
    assert told["anchored"]["holds"] > 0.85 and told["foreign_told"] > 0.2
    assert told["sharpened"]["rms"] < 0.2 and told["sharpened"]["holds"] > 0.85 and 0 < made.seams.lumps_limit < 0.5
    rows = pool.measured[np.isfinite(pool.measured).all(axis=1)][:50]
    inputs, guards = rows[:, : len(model.features)], rows[:, len(model.features) :]
    assert made.probabilities(inputs).tolist() == model.probabilities(inputs).tolist()
    assert made.novelty(inputs, guards).tolist() == model.novelty(inputs, guards).tolist()


def test_a_model_of_streams_is_taught_behind_its_own_beam() -> None:
    model, scene = load_model("default-acceleration"), load_scene(shipped.scene_path("caving"))
    plain = replace(
        model, arrays={name: array for name, array in model.arrays.items() if not name.startswith("seams.")}
    )
    with pytest.MonkeyPatch.context() as patch:
        for module in (streams, seams):
            patch.setattr(module, "DURATION", 12.0)
        patch.setattr(seams, "N_STREAMS", 4)
        patch.setattr(seams, "_JUDGES", 40)
        patch.setattr(seams, "_EPOCHS", ((12, 3e-3),))
        pool = seams.pool_of(scene, 4, 6, plain.beam.beam)
        made = seams.taught(plain, scene, 160, 6)
    # Errors of the inversion, on a beam that gives way; bounces are slower than first impacts.
    assert 0.75 < pool.told.mean() < 0.97 and 0.15 < pool.bounce.mean() < 0.5
    errors = (np.log(pool.measured[:, :3]) - pool.pulse)[pool.told]
    assert np.abs(np.nanmedian(errors[:, :2], axis=0)).max() < 0.1
    assert 0.9 < np.nanmedian(pool.back) < 1.02  # the beam takes a little, and may strike a dull rock back
    assert np.isfinite(pool.back).sum() == pytest.approx(pool.bounce.sum(), rel=0.2)
    assert plain.seams is None and made.seams is not None
    assert made.training["seams"]["n_seams"] == 4 * 160
    assert made.training["seams"]["anchored"]["rms"] < 0.25
    assert all(made.arrays[name] is plain.arrays[name] for name in plain.arrays)
    other = replace(plain, labels=("coal", "stone"))
    assert seams.taught(other, scene, 160, 6) is other
