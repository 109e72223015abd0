"""A recording that is not of the world of a training is told, at a stated rate of false alarms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cgid import load_model
from cgid.errors import BadData
from cgid.identification.model.model import StoredModel
from cgid.identification.model.world import CHECKS, Misfit, MisfitPart, World, WorldTest, trait_names
from cgid.learning.world import with_world

Floats = NDArray[np.float64]
#: Logarithms of impulse, hardness and restitution of coal and of gangue, and their deviations.
KINDS = (np.array([1.0, 30.0, -1.1]), np.array([1.5, 31.5, -0.7])), np.array([1.2, 0.7, 0.2])


def recording(seed: int, n: int = 400) -> tuple[Floats, float]:
    """Return the traits of a recording, whose levels, noise and rest differ from others, and its fraction of gangue."""
    rng = np.random.default_rng(seed)
    fraction = rng.random()
    is_gangue = rng.random(n) < fraction
    means, deviations = KINDS
    own = 0.05 * rng.standard_normal(3)
    impulse, hardness, restitution = (
        np.where(is_gangue[:, None], means[1], means[0]) + own + deviations * rng.standard_normal((n, 3))
    ).T
    width = (impulse - hardness) / 3
    noise = 2.0 + 0.3 * rng.standard_normal() + 0.4 * rng.standard_normal(n)
    peak = impulse - width
    rest = np.exp(-4 + 0.3 * rng.standard_normal() + 1.5 * rng.standard_normal(n))
    return np.column_stack([np.exp(np.stack([peak, width, restitution, noise - peak], axis=1)), rest]), fraction


@pytest.fixture(scope="module")
def model() -> StoredModel:
    return with_world(load_model("default"), (recording(k) for k in range(199)), 1)


def told(model: StoredModel, traits: Floats) -> Misfit | None:
    assert model.world is not None
    test = WorldTest(model.world)
    for n in CHECKS:
        if n <= len(traits):
            test.look(traits[:n].tolist())
    return test.misfit


def test_a_recording_of_this_world_is_told_at_the_stated_rate(model: StoredModel) -> None:
    assert model.world is not None and model.world.rate == 0.01 and model.training["world"]["rate"] == 0.01
    alarms = [told(model, recording(10_000 + k, 800)[0]) is not None for k in range(400)]
    assert sum(alarms) <= 11  # 4 at the stated rate, more than 11 with a probability of .001


def scaled(column: int | tuple[int, ...], factor: float) -> Callable[[Floats], Floats]:
    def change(traits: Floats) -> Floats:
        changed = traits.copy()
        changed[:, column] *= factor
        return changed

    return change


def of_seam(traits: Floats) -> Floats:
    """Rocks eight times as hard: by Hertz, peaks rise by the power .4, and widths fall by it, at equal impulse."""
    return traits * np.array([8**0.4, 8**-0.4, 1.0, 8**-0.4, 1.0])


CHANGES = {
    "five times the gain": (lambda one: one * np.array([5.0, 1, 1, 1, 1]), MisfitPart.SCALE, 5.0),
    "g for m/s^2": (lambda one: one / np.array([9.81, 1, 1, 1, 1]), MisfitPart.SCALE, 1 / 9.81),
    "a harder seam": (of_seam, MisfitPart.SEAM, 8.0),
    # Peaks grow as the square of a radius, and widths as the radius.
    "rocks twice as large": (lambda one: one * np.array([4.0, 2.0, 1, 1 / 4, 1]), MisfitPart.SIZES, 8.0),
    "another beam": (scaled(4, 30.0), MisfitPart.BEAM, np.nan),
    "louder noise": (scaled(3, 8.0), MisfitPart.NOISE, np.nan),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_does_not_fit_is_told_and_by_how_much(model: StoredModel, what: str) -> None:
    change, part, factor = CHANGES[what]
    for seed in range(20_000, 20_010):
        misfit = told(model, change(recording(seed, 800)[0]))
        assert misfit is not None and misfit.part == part and misfit.n_impacts in CHECKS
        assert misfit.factor == pytest.approx(factor, rel=0.5, nan_ok=True)


def test_what_may_be_it_as_well_is_told_too(model: StoredModel) -> None:
    # Large rocks leave more unexplained.
    large = CHANGES["rocks twice as large"][0]
    misfit = told(model, scaled(4, 30.0)(large(recording(20_000, 800)[0])))
    assert misfit is not None
    assert {MisfitPart.SIZES, MisfitPart.BEAM} <= {one.part for one in (misfit, *misfit.others)}
    alone = told(model, CHANGES["louder noise"][0](recording(20_000, 800)[0]))
    assert alone is not None and not alone.others


def test_few_recordings_state_a_higher_rate_and_hardly_any_make_no_test() -> None:
    plain = replace(load_model("default"), training={})
    few = with_world(plain, [recording(k) for k in range(30)], 1)
    assert few.world is not None and few.world.rate == pytest.approx(1 / 31)
    plain = replace(few, arrays={name: a for name, a in few.arrays.items() if not name.startswith("world.")})
    assert with_world(plain, [recording(k) for k in range(7)], 1).world is None
    assert with_world(plain, [recording(k, 49) for k in range(30)], 1).world is None


def test_model_files_keep_the_world_and_damaged_ones_are_refused(model: StoredModel) -> None:
    again = StoredModel.from_bytes(model.to_bytes())
    assert model.world is not None and again.world is not None
    assert all(np.array_equal(a, again.world.arrays[name]) for name, a in model.world.arrays.items())
    for name, wrong in {
        "world.mean": np.zeros((2, 3, 25)),
        "world.maxima": np.array([2.0, 1.0]),
        "world.scale": np.zeros((len(CHECKS), 3)),
    }.items():
        with pytest.raises(BadData, match=name):
            replace(model, arrays={**model.arrays, name: wrong})
    with pytest.raises(BadData, match=r"world.maxima is missing"):
        replace(model, arrays={name: a for name, a in model.arrays.items() if name != "world.maxima"})


def test_only_models_that_measure_pulses_and_what_is_left_are_compared() -> None:
    assert trait_names(load_model("default").measured)[0] == "fitted_peak"
    assert trait_names(load_model("default-acceleration").measured)[0] == "beam_peak_force"
    assert trait_names(("fitted_peak", "fitted_width")) == ()


def test_impacts_that_are_no_numbers_are_no_alarm(model: StoredModel) -> None:
    assert told(model, np.full((100, 5), np.nan)) is None
    assert World.from_arrays({}) is None
