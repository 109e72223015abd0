"""The transformer against `extract` and scikit-learn's own checks; training streams against `synthesise`."""

from __future__ import annotations

import itertools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.inspection import permutation_importance
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.utils.estimator_checks import check_estimator

import cgid
from cgid import ImpactClassifier, ImpactFeatures, extract, synthesise
from cgid.errors import BadData
from cgid.learning.transformer import TrainingBatch
from cgid.scene import Scene
from tests.test_docs import blocks_of

NAMES = ["peak_force", "width_50"]
PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "learners.md"


# -- the transformer --------------------------------------------------------------------------------------


class OfPulses(ImpactFeatures):
    """Features of pulses whose heights and lengths follow from the rows: without it, checks would only see nan."""

    def _frames(self, X: Any, *, reset: bool) -> np.ndarray:
        rows = super()._frames(X, reset=reset)
        times = np.arange(120) / 120
        with np.errstate(over="ignore"):
            heights, lengths = (2 + np.tanh(rows[:, column, None]) for column in (0, -1))
        pulses = heights * np.sin(np.pi * np.clip((times - 0.2) / (0.2 * lengths), 0, 1)) ** 1.5
        return np.asarray(pulses + 1e-4 * np.sin(1e3 * times))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("estimator", [ImpactFeatures(2e5), OfPulses(2e5, NAMES)], ids=["features", "of pulses"])
def test_the_transformer_passes_scikit_learns_own_checks(estimator: ImpactFeatures) -> None:
    results = check_estimator(estimator, on_fail=None, on_skip=None)
    assert [result["check_name"] for result in results if result["status"] not in ("passed", "skipped")] == []
    assert [result["check_name"] for result in results if result["status"] == "skipped"] == ["check_array_api_input"]
    assert len(results) > 40


@pytest.fixture(scope="module")
def impacts(reference_scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    batches = list(synthesise(reference_scene, 600, seed=3))
    return np.concatenate([b.signals for b in batches]), np.concatenate([b.labels for b in batches])


def test_features_are_those_of_extract(impacts: tuple[np.ndarray, np.ndarray]) -> None:
    signals, _ = impacts
    measuring = ImpactFeatures(2e5, NAMES, pre_trigger=200).set_output(transform="pandas")
    found = measuring.fit_transform(signals)
    pd.testing.assert_frame_equal(found, extract(signals, 2e5, NAMES, pre_trigger=200))
    assert measuring.get_feature_names_out().tolist() == NAMES


def test_rows_that_cannot_be_measured_are_nan_or_an_error(impacts: tuple[np.ndarray, np.ndarray]) -> None:
    signals = impacts[0][:3].copy()
    signals[1] = 0
    found = ImpactFeatures(2e5, NAMES).fit_transform(signals)
    assert np.isnan(found).all(axis=1).tolist() == [False, True, False]
    with pytest.raises(BadData, match="signal 1: no impact"):
        ImpactFeatures(2e5, NAMES, invalid="raise").fit_transform(signals)
    with pytest.raises(BadData, match="at least 6 samples"):
        ImpactFeatures(2e5, NAMES, invalid="raise").fit(signals[:, :5])
    signals[1, 3] = np.nan
    with pytest.raises(ValueError, match="contains NaN"):
        ImpactFeatures(2e5, NAMES).fit(signals)


def test_it_serves_pipelines_searches_and_importances(impacts: tuple[np.ndarray, np.ndarray]) -> None:
    signals, labels = impacts
    pipeline = make_pipeline(ImpactFeatures(2e5, invalid="raise"), ImpactClassifier("linear"))
    grid = {
        "impactfeatures__features": [NAMES, ["peak_force"]],
        "impactclassifier__family": ["linear", "logistic"],
    }
    search = GridSearchCV(pipeline, grid, cv=3, error_score="raise").fit(signals, labels)
    assert search.best_params_["impactfeatures__features"] == NAMES
    assert search.best_score_ > 0.7
    table = ImpactFeatures(2e5, NAMES).fit_transform(signals)
    classifier = ImpactClassifier("linear").fit(table, labels)
    importances = permutation_importance(classifier, table, labels, n_repeats=3, random_state=0).importances_mean
    assert (importances > 0.05).all()
    again = pickle.loads(pickle.dumps(pipeline))
    np.testing.assert_array_equal(cross_val_score(again, signals, labels), cross_val_score(pipeline, signals, labels))


# -- training streams -------------------------------------------------------------------------------------


def joined(batches: list[TrainingBatch]) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    signals, labels, parameters = zip(*batches, strict=True)
    columns = {name: np.concatenate([part[name] for part in parameters]) for name in parameters[0]}
    return np.concatenate(signals), np.concatenate(labels), columns


def same(found: list[TrainingBatch], expected: list[TrainingBatch]) -> bool:
    return len(found) == len(expected) and all(
        np.array_equal(a, c) and np.array_equal(b, d) and all(np.array_equal(p[n], q[n], equal_nan=True) for n in q)
        for (a, b, p), (c, d, q) in zip(found, expected, strict=True)
    )


@pytest.mark.parametrize("size", [1, 100, 256, 700, 2000])
def test_batches_are_the_signals_of_synthesise(reference_scene: Scene, size: int) -> None:
    n = 1500 if size > 1 else 40
    batches = list(cgid.stream(reference_scene, batch_size=size, seed=7, n_signals=n, first=130))
    assert [len(signals) for signals, _, _ in batches] == [min(size, n - start) for start in range(0, n, size)]
    signals, labels, parameters = joined(batches)
    made = list(synthesise(reference_scene, n, 7, first=130))
    np.testing.assert_array_equal(signals, np.concatenate([batch.signals for batch in made]))
    names = np.array(reference_scene.labels)
    np.testing.assert_array_equal(names[labels], np.concatenate([batch.labels for batch in made]))
    for name in made[0].parameters:
        np.testing.assert_array_equal(parameters[name], np.concatenate([batch.parameters[name] for batch in made]))
    assert (parameters["sampling_rate"] == 2e5).all()
    assert (signals.dtype, labels.dtype) == (np.float32, np.int64)


@pytest.mark.long
def test_two_workers_give_the_same_batches(reference_scene: Scene) -> None:
    alone, together = (
        list(cgid.stream(reference_scene, batch_size=100, seed=7, n_signals=3333, workers=n)) for n in (1, 2)
    )
    assert same(together, alone)


def test_a_stream_without_end_begins_again_with_each_loop_and_is_left_at_any_time(reference_scene: Scene) -> None:
    batches = cgid.stream("reference", batch_size=32, seed=1)
    assert batches.labels == ("coal", "gangue")
    first, again = (list(itertools.islice(batches, 40)) for _ in range(2))
    assert same(again, first)
    assert same(list(itertools.islice(cgid.stream(reference_scene, batch_size=32, seed=1, first=320), 5)), first[10:15])
    assert not same(list(itertools.islice(cgid.stream(reference_scene, batch_size=32, seed=2), 40)), first)


def test_a_loader_of_pytorch_takes_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="PyTorch is not installed, or not whole", exc_type=ImportError)
    (block,) = (block for block in blocks_of(PAGE.read_text(encoding="utf-8")) if "import torch" in block.text)
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(block.text, names)
    # Both workers together bring what one stream brings, in some order.
    seen = sorted((signals[0].tolist(), numbers.tolist()) for signals, numbers in names["loader"])
    whole = cgid.stream("reference", batch_size=256, n_signals=5120)
    assert seen == sorted((signals[0].tolist(), numbers.tolist()) for signals, numbers, _ in whole)
    assert 0 < names["loss"].item() < 1
