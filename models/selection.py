"""Compare all families of classifiers on a scene, by cross-validation on the same folds; print Markdown.

    python models/selection.py                          # the reference scene, 20000 impacts, 5 folds
    python models/selection.py yang2018 -n 5000

Standardising, fitting and calibrating happen inside the folds, which are the same for all and keep specimens together.
"""

import argparse
import pickle
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.model_selection import StratifiedGroupKFold
from sklearn.svm import SVC
from threadpoolctl import threadpool_limits

from cgid import shipped
from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers, workers
from cgid.errors import InvalidValue
from cgid.identification.model.model import StoredModel
from cgid.identification.training import ImpactClassifier
from cgid.identification.training.card import plain, table
from cgid.identification.training.metrics import evaluate, paired_difference
from cgid.identification.training.rows import Rows, linear_columns, measure
from cgid.scene import load_scene, synthesise

#: A later family must be better by this accuracy.
MARGIN = 0.003
#: Most training impacts of support vector machines in a fold: the cost grows with their square.
SUPPORT_VECTOR_IMPACTS = 10_000
#: Repetitions for the time of one prediction.
_REPEATS = 50


class _Forest(RandomForestClassifier):
    """A random forest with a decision function for the calibration: log probabilities."""

    def decision_function(self, X: Floats) -> Floats:
        logs = np.log(np.maximum(self.predict_proba(X), 0.5 / len(self.estimators_)))
        return np.asarray(logs[:, 1] - logs[:, 0] if len(self.classes_) == 2 else logs)


class Rival(ImpactClassifier):
    """Families for comparison only, which cannot be exported as plain numbers."""

    ESTIMATORS: ClassVar[Mapping[str, Callable[[Any], Any]]] = {
        "gradient boosting": lambda own: HistGradientBoostingClassifier(
            max_iter=200,
            max_leaf_nodes=15,
            learning_rate=0.08,
            l2_regularization=1.0,
            early_stopping=False,
            random_state=own.random_state,
        ),
        "random forest": lambda own: _Forest(200, min_samples_leaf=5, random_state=own.random_state),
        "support vectors": lambda own: SVC(C=3.0, random_state=own.random_state),
    }


@dataclass(frozen=True)
class Family:
    """One family in the comparison: its name, its unfitted classifier, and the most training impacts in a fold."""

    name: str
    classifier: ImpactClassifier
    most: int | None = None

    @property
    def exportable(self) -> bool:
        """Whether a model file can hold it."""
        return not isinstance(self.classifier, Rival)


#: The default, then the other exportable families, then those for comparison only.
FAMILIES = (
    Family("logistic", ImpactClassifier("logistic")),
    Family("network", ImpactClassifier("network")),
    Family("linear discriminant", ImpactClassifier("linear")),
    Family("gradient boosting", Rival("gradient boosting")),
    Family("random forest", Rival("random forest")),
    Family("support vectors (RBF)", Rival("support vectors"), SUPPORT_VECTOR_IMPACTS),
)


def select(
    measured: Rows,
    *,
    families: tuple[Family, ...] = FAMILIES,
    n_folds: int = 5,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
    crew: Workers = SERIAL,
) -> list[dict[str, Any]]:
    """Compare families by cross-validation; return one row for each, as plain numbers for JSON.

    All share the folds, which are stratified by label and never divide a specimen. Fits use one thread and only the
    training part; in parallel folds they take longer. `difference` is to the first family, `standard_error` over
    paired specimens; `n_train` and `fit_s` are per fold; `predict_us` (one impact) and `size_bytes` are those of the
    exported model, else of scikit-learn's and its pickle. Raises `InvalidValue` if a label has fewer specimens than
    folds.
    """
    labels = measured.labels
    fewest = min(len(np.unique(measured.group[labels == label])) for label in np.unique(labels))
    if not 2 <= validation.count("n_folds", n_folds) <= fewest:
        raise InvalidValue(f"n_folds must lie between 2 and {fewest}, the specimens of a label, got {n_folds}")
    splitter = StratifiedGroupKFold(n_folds, shuffle=True, random_state=seed)
    folds = list(splitter.split(measured.features, labels, measured.group))
    rows: list[dict[str, Any]] = []
    hits: list[NDArray[np.bool_]] = []
    for family in families:
        if progress is not None:
            progress(family.name)
        row, own = _judge(family, measured, folds, seed, crew)
        hits.append(own)
        difference, error = paired_difference(own, hits[0], measured.group)
        rows.append({**row, "difference": difference, "standard_error": error})
    best = preferred([row["accuracy"] for row in rows], MARGIN)
    return [{**row, "chosen": k == best} for k, row in enumerate(rows)]


def preferred(accuracies: Sequence[float], margin: float) -> int:
    """Return the best of some candidates; a later one must be better than an earlier one by the margin."""
    best = 0
    for k, accuracy in enumerate(accuracies):
        if accuracy > accuracies[best] + margin:
            best = k
    return best


def _judge(
    family: Family, measured: Rows, folds: list[tuple[NDArray[np.intp], NDArray[np.intp]]], seed: int, crew: Workers
) -> tuple[dict[str, Any], NDArray[np.bool_]]:
    """Return the row of a family, and which impacts it answers right."""
    labels, inputs = measured.labels, np.ascontiguousarray(measured.columns(measured.names))
    classes = tuple(np.unique(labels).tolist())
    probabilities = np.empty((len(labels), len(classes)))
    parts = []
    for training, test in folds:
        if family.most is not None and len(training) > family.most:
            training = np.random.default_rng(seed).permutation(training)[: family.most]
        parts.append((training, test, test is folds[-1][1]))
    unfitted = clone(family.classifier).set_params(linear=linear_columns(measured.names), random_state=seed)
    judged = list(crew.each(_judge_fold, (unfitted, measured, inputs), parts))
    for (_, test, _), (answers, _, _) in zip(parts, judged, strict=True):
        probabilities[test] = answers
    metrics = evaluate(labels, probabilities, classes)
    with threadpool_limits(1):
        predict, size = _in_use(judged[-1][2], measured)
        row = {
            "name": family.name,
            "exportable": family.exportable,
            **{name: metrics[name] for name in ("accuracy", "brier_score", "expected_calibration_error")},
            "n_train": len(parts[-1][0]),
            "fit_s": float(np.mean([seconds for _, seconds, _ in judged])),
            "predict_us": _microseconds(predict, inputs[:1]),
            "size_bytes": size,
        }
    return row, np.array(classes)[np.argmax(probabilities, axis=1)] == labels


def _judge_fold(
    trial: tuple[ImpactClassifier, Rows, Floats], part: tuple[NDArray[np.intp], NDArray[np.intp], bool]
) -> tuple[Floats, float, Any]:
    """Return probabilities for the test rows, the time of the fit [s], and the classifier if it is kept."""
    (unfitted, measured, inputs), (training, test, kept) = trial, part
    classifier = clone(unfitted)
    with threadpool_limits(1):
        start = time.perf_counter()
        classifier.fit(inputs[training], measured.labels[training], measured.group[training])
        seconds = time.perf_counter() - start
        # Sending all classifiers between processes would be slow: a forest is large.
        return classifier.predict_proba(inputs[test]), seconds, classifier if kept else None


def _in_use(classifier: ImpactClassifier, measured: Rows) -> tuple[Callable[[Floats], Floats], int]:
    """Return the function that a user calls for probabilities, and the size of the file [bytes]."""
    if isinstance(classifier, Rival):
        return classifier.predict_proba, len(pickle.dumps(classifier))
    model = StoredModel.from_classifier(
        classifier,
        features=measured.names,
        unit=measured.unit,
        sampling_rates=measured.sampling_rates,
        beam=measured.beam,
        training={},
    )
    return model.probabilities, len(model.to_bytes())


def _microseconds(predict: Callable[[Floats], Floats], one: Floats) -> float:
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        predict(one)
        times.append(time.perf_counter() - start)
    return 1e6 * float(np.median(times))


def selection_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of the comparison."""
    titles = ("family", "exportable", "accuracy", "difference", "Brier", "calibration error", "trained on")
    cells = [
        (
            f"**{plain(row['name'])}**" if row["chosen"] else plain(row["name"]),
            "yes" if row["exportable"] else "no",
            f"{row['accuracy']:.4f}",
            f"{row['difference']:+.4f} ± {row['standard_error']:.4f}",
            f"{row['brier_score']:.4f}",
            f"{row['expected_calibration_error']:.4f}",
            row["n_train"],
            f"{row['fit_s']:.1f}",
            f"{row['predict_us']:.0f}",
            f"{row['size_bytes'] / 1e3:.1f}",
        )
        for row in rows
    ]
    return table((*titles, "fit [s]", "one impact [us]", "size [kB]"), cells)


def selection_section(rows: list[dict[str, Any]], family: str) -> list[str]:
    """Return the section of the card of a model of some family."""
    lines = selection_table(rows)
    if family not in [row["name"] for row in rows if row["chosen"]]:
        lines += ["", f"Bold is the choice of this comparison; the family of this model, {family}, was asked for."]
    return lines


def main() -> None:
    """Synthesise, measure, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="reference", help="a .toml file, or the name of a shipped scene")
    parser.add_argument("-n", "--signals", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--features", help="only these, with commas between them")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes; fits then take longer each")
    arguments = parser.parse_args()
    scene = load_scene(shipped.scene_path(arguments.scene))
    features = None if arguments.features is None else arguments.features.split(",")
    measured = measure(synthesise(scene, arguments.signals, arguments.seed), features)
    with workers(arguments.jobs) as crew:
        rows = select(
            measured,
            n_folds=arguments.folds,
            seed=arguments.seed,
            progress=lambda name: print(name, "...", file=sys.stderr, flush=True),
            crew=crew,
        )
    print(f"Scene `{scene.name}`, {len(measured.labels)} impacts, {arguments.folds} folds by specimen.\n")
    print("\n".join(selection_table(rows)))
    print(
        f"\nDifferences are from the first line on the same impacts, ± one standard error. Bold is the choice: the "
        f"first, or a later\none that is better by more than {MARGIN:g}. Support vectors learn from at most "
        f"{SUPPORT_VECTOR_IMPACTS} impacts of a fold. Fit: one fold,\none thread, calibration included. One impact: "
        "by the exported model in numpy where there is one, else by scikit-learn."
    )


if __name__ == "__main__":
    main()
