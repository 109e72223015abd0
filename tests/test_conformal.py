"""Prediction sets: whether they hold what they promise, on which impacts, and what is said when they cannot."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cgid.errors import BadData, InvalidValue
from cgid.identification.model.conformal import COVERAGES, Conformal
from cgid.identification.model.families import softmax
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import PredictionSettings, identify_frames
from cgid.identification.training import write_card
from cgid.identification.training.metrics import calibration_error_by_chance, evaluate_sets, reliability
from cgid.identification.training.training import (
    MIN_CALIBRATION_SPECIMENS,
    Training,
    calibration_mask,
    hold_out,
    train_on_specimens,
)
from cgid.scene import Scene, synthesise

Trained = dict[str, Training]


def drawn(n: int, seed: int, share: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return scores (logarithms of odds that are calibrated where both labels are equally frequent) and truths."""
    generator = np.random.default_rng(seed)
    truth = (generator.random(n) < share).astype(int)
    return generator.normal(2.0 * truth - 1.0, 1.2), truth


# -- the threshold ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "coverage", "rank"), [(9, 0.9, 9), (99, 0.9, 90), (99, 0.07, 7), (100, 0.9, 91)])
def test_threshold_is_the_order_statistic_of_n_plus_1(n: int, coverage: float, rank: int) -> None:
    scores = np.random.default_rng(n).random(n)
    found = Conformal(np.sort(scores), np.zeros(n, np.int32), 1).threshold(coverage)
    assert found == sorted(scores)[rank - 1]


@pytest.mark.parametrize("coverage", [0.5, 0.8, 0.9, 0.95])
def test_of_n_plus_1_exchanged_impacts_exactly_the_promised_ones_are_covered(coverage: float) -> None:
    """Each of them is the new one once: that is what exchangeable means, and it leaves nothing to chance."""
    n = 60
    scores = np.random.default_rng(2).random(n + 1)
    covered = 0
    for new in range(n + 1):
        others = np.sort(np.delete(scores, new))
        covered += scores[new] <= Conformal(others, np.zeros(n, np.int32), 1).threshold(coverage)
    assert covered == math.ceil(coverage * (n + 1))


@pytest.mark.parametrize("temperature", [1.0, 0.1, 30.0])
def test_coverage_holds_whatever_the_scores_are_worth(temperature: float) -> None:
    n_calibrations, n_calibration, n_new, coverage = 200, 99, 500, 0.9
    held = []
    for seed in range(n_calibrations):
        scores, truth = drawn(n_calibration + n_new, seed)
        probabilities = softmax(scores / temperature)
        own = Conformal.fit(probabilities[:n_calibration], truth[:n_calibration])
        sets = own.prediction_set(probabilities[n_calibration:], coverage)
        held.append(sets[np.arange(n_new), truth[n_calibration:]].mean())
    # The coverage of one calibration is Beta(90, 10), that of n_new impacts binomial about it.
    of_calibration = coverage * (1 - coverage) / (n_calibration + 2)
    error = math.sqrt((of_calibration + coverage * (1 - coverage) / n_new) / n_calibrations)
    assert abs(np.mean(held) - coverage) < 4 * error


@pytest.mark.parametrize(
    ("scores", "labels"),
    [
        ([], []),
        ([0.1, 0.2], [0]),
        ([0.1], [2]),
        ([0.1], [0.0]),
        ([1.1], [0]),
        ([float("nan")], [0]),
    ],
)
def test_harmful_calibrations_are_refused(scores: list, labels: list) -> None:
    with pytest.raises(BadData, match="calibration"):
        Conformal(np.array(scores), np.array(labels), 2)


# -- who calibrates ---------------------------------------------------------------------------------------


def test_who_calibrates_neither_trains_nor_judges() -> None:
    specimen = np.random.default_rng(0).integers(0, 1000, 5000).astype(np.uint64)
    labels = np.where(specimen < 400, "coal", "gangue")
    test = hold_out(labels, specimen, 0.25, 3)
    calibration = calibration_mask(labels, specimen, test, 0.1, 3)
    parts = [set(specimen[rows].tolist()) for rows in (test, calibration, ~(test | calibration))]
    assert not (parts[0] & parts[1] or parts[0] & parts[2] or parts[1] & parts[2])
    counts = {label: len(np.unique(specimen[calibration & (labels == label)])) for label in ("coal", "gangue")}
    assert counts == {"coal": 40, "gangue": 60}


def test_impacts_of_one_specimen_calibrate_once(reference_scene: Scene) -> None:
    batches = list(synthesise(reference_scene, 600))
    training = train_on_specimens([*batches, *batches, *batches], features=["peak_force", "width_50", "tilt"])
    assert training.model.conformal is not None
    assert len(training.model.conformal.scores) == training.model.training["n_calibration_specimens"] == 60


def test_too_few_specimens_all_train_and_nothing_can_be_rejected(reference_scene: Scene) -> None:
    training = train_on_specimens(synthesise(reference_scene, 300), features=["peak_force", "width_50"])
    assert MIN_CALIBRATION_SPECIMENS > 0.1 * 300 / 2
    assert training.model.conformal is None
    assert training.metrics["prediction_sets"] == []
    assert "nothing can be rejected" in write_card(training.model, "m.npz")
    with pytest.raises(InvalidValue, match="coverage must be left out"):
        training.model.prediction_set(np.array([[0.5, 0.5]]), 0.9)


# -- what is reported -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("family", ["logistic", "linear", "network"])
def test_held_out_impacts_are_covered_as_promised(family: str, trained: Trained) -> None:
    training = trained[family]
    n_test, n_calibration = len(training.test_labels), training.model.training["n_calibration_specimens"]
    assert [row["coverage"] for row in training.metrics["prediction_sets"]] == [*COVERAGES]
    for row in training.metrics["prediction_sets"]:
        error = math.sqrt(row["coverage"] * (1 - row["coverage"]) * (1 / n_test + 2 / n_calibration))
        assert abs(row["achieved"] - row["coverage"]) < 4 * error
        assert row["single"] + row["several"] + row["empty"] == pytest.approx(1)


def test_reported_sets_are_those_counted_by_hand() -> None:
    probabilities = np.array([[0.95, 0.05], [0.45, 0.55], [0.7, 0.3], [0.15, 0.85]])
    labels = np.array(["a", "a", "b", "b"])
    (row,) = evaluate_sets(
        labels, probabilities, ("a", "b"), Conformal(np.array([0.1, 0.2]), np.array([0, 0]), 2), (0.6,)
    )
    # The threshold is .2: the sets are {a}, {}, {}, {b}.
    assert (row["achieved"], row["single"], row["several"], row["empty"]) == (0.5, 0.5, 0.0, 0.5)
    assert row["accuracy_of_single"] == 1.0
    assert row["achieved_of"] == {"a": 0.5, "b": 0.5}


def test_calibration_error_by_chance_is_what_calibrated_answers_show() -> None:
    generator = np.random.default_rng(8)
    confidence = generator.uniform(0.5, 1.0, 3000)
    errors = []
    for _ in range(300):
        bins = reliability(confidence, generator.random(3000) < confidence)
        errors.append(sum(n * abs(c - a) for c, a, n in bins) / 3000)
    assert calibration_error_by_chance(confidence) == pytest.approx(np.mean(errors), rel=0.05)


# -- answers ----------------------------------------------------------------------------------------------


def test_an_impact_is_rejected_unless_its_set_is_a_single_label(trained: Trained, reference_scene: Scene) -> None:
    model = trained["logistic"].model
    (batch,) = synthesise(reference_scene, 200, seed=77)
    arguments = (batch.signals, batch.sampling_rate, model)
    plain = identify_frames(*arguments, pre_trigger=batch.pre_trigger)
    assert {answer.prediction_set for answer in plain} == {None}
    seen = set()
    for coverage in (0.7, 0.97):
        for before, after in zip(
            plain,
            identify_frames(*arguments, PredictionSettings(coverage=coverage), pre_trigger=batch.pre_trigger),
            strict=True,
        ):
            assert after.probabilities == before.probabilities
            assert after.prediction_set is not None
            seen.add(len(after.prediction_set))
            if before.novelty > 1:
                assert "outside of the training" in after.problem
            elif len(after.prediction_set) == 1:
                assert (after.label,) == after.prediction_set == (before.label,)
                assert after.problem == ""
            else:
                both = f"coal or gangue: the prediction set at coverage {coverage:g} contains both"
                none = f"the prediction set at coverage {coverage:g} is empty"
                assert (both if after.prediction_set else none) in after.problem
                assert after.label == "unknown"
                assert after.in_training_range
    assert seen == {0, 1, 2}


def test_coverage_survives_the_file(trained: Trained, tmp_path: Path) -> None:
    training = trained["linear"]
    (tmp_path / "m.npz").write_bytes(training.model.to_bytes())
    loaded = StoredModel.load(tmp_path / "m.npz")
    np.testing.assert_array_equal(
        loaded.prediction_set(training.test_probabilities, 0.93),
        training.model.prediction_set(training.test_probabilities, 0.93),
    )
