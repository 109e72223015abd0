"""The comparison of families: the same folds for all, nothing leaks into them, and the rule that decides."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from cgid.identification.model.model import StoredModel
from cgid.identification.training import ImpactClassifier, Rows, measure, train_on_specimens, write_card
from cgid.identification.training.classifier import FAMILIES as EXPORTABLE
from cgid.identification.training.metrics import paired_difference
from cgid.scene import Scene, synthesise
from models.selection import FAMILIES, MARGIN, Family, preferred, select, selection_section, selection_table
from tests import few

FEATURES = ("fitted_peak", "fitted_width", "fitted_restitution")


def made(features: np.ndarray, labels: np.ndarray, specimen: np.ndarray) -> Rows:
    return Rows(
        names=FEATURES,
        features=features,
        labels=labels,
        group=specimen.astype(np.uint64),
        unit="N",
        sampling_rates=(2e5, 2e5),
        sources=("made",),
        source=np.zeros(len(features), np.intp),
        left_out=0,
    )


@pytest.fixture(scope="module")
def measured(reference_scene: Scene) -> Rows:
    return measure(synthesise(reference_scene, 500, seed=3), FEATURES)


@pytest.mark.parametrize("families", few([list(FAMILIES[:1] + FAMILIES[-1:]), list(FAMILIES)]))
def test_every_family_is_compared_and_a_card_can_print_it(
    measured: Rows, reference_scene: Scene, families: list[Family]
) -> None:
    rows = select(measured, n_folds=2, families=tuple(families))
    assert [row["name"] for row in rows] == [family.name for family in families]
    rivals = {family.name for family in FAMILIES[len(EXPORTABLE) :]}
    assert len(rivals) == 3
    assert [row["exportable"] for row in rows] == [family.name not in rivals for family in families]
    assert all(0.75 < row["accuracy"] < 0.97 for row in rows)
    assert all(row[name] > 0 for row in rows for name in ("fit_s", "predict_us", "size_bytes"))
    assert sum(row["chosen"] for row in rows) == 1
    lines = selection_table(rows)
    assert len(lines) == 2 + len(rows)
    model = train_on_specimens(synthesise(reference_scene, 400), features=FEATURES).model
    model = StoredModel.from_bytes(replace(model, training=model.training | {"selection": rows}).to_bytes())
    assert model.training["selection"] == rows
    card = write_card(model, "m.npz", further=[("Selection", selection_section(rows, model.family))])
    assert "## Selection" in card
    assert all(line in card for line in lines)


class Watched(ImpactClassifier):
    """A classifier that says whose impacts it was fitted to; which one it is stands in the number of iterations."""

    SEEN: ClassVar[dict[int, list[set[int]]]] = {}

    def fit(self, X: Any, y: Any, groups: Any = None) -> ImpactClassifier:
        self.SEEN.setdefault(self.n_iterations, []).append(set(np.asarray(groups).tolist()))
        return super().fit(X, y, groups)


def test_all_see_the_same_folds_and_specimens_stay_together(measured: Rows) -> None:
    names = ("features", "labels", "group")
    twice = replace(measured, **{name: np.repeat(getattr(measured, name), 2, axis=0) for name in names})
    families = tuple(Family(str(k), Watched("linear", n_iterations=k)) for k in (1, 2))
    select(twice, families=families, n_folds=4)
    first, second = Watched.SEEN.values()
    assert first == second
    assert len(first) == 4
    everything = set(measured.group.tolist())
    # Each specimen is missing from one fold; were its two impacts on both sides, it would be missing from none.
    assert sum(len(everything - fold) for fold in first) == len(everything)


def test_paired_difference_is_that_of_specimens() -> None:
    generator = np.random.default_rng(1)
    first, second = generator.random((2, 400)) < [[0.9], [0.8]]
    specimen = np.arange(400, dtype=np.uint64)
    mean, error = paired_difference(first, second, specimen)
    own = first.astype(int) - second
    assert mean == pytest.approx(own.mean())
    assert error == pytest.approx(own.std(ddof=1) / math.sqrt(400))
    # Every impact five times over says no more than once.
    five = paired_difference(*(np.repeat(a, 5) for a in (first, second, specimen)))
    assert five == pytest.approx((mean, error))
    assert paired_difference(first, first, specimen) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("accuracies", "best"),
    [
        ([0.88, 0.882, 0.8829], 0),
        ([0.88, 0.884], 1),
        ([0.88, 0.884, 0.886], 1),
        ([0.88, 0.86, 0.89, 0.8940], 3),
        ([0.88], 0),
    ],
)
def test_a_later_one_wins_only_by_the_margin(accuracies: list[float], best: int) -> None:
    assert MARGIN == 0.003
    assert preferred(accuracies, MARGIN) == best
