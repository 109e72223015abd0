"""Learners where no formula gives the Bayes limit of a scene.

From above, for scenes of force: a learner on the exact pulses of the impacts, trained on as many as it takes to
saturate. Noise, filters, clipping and rounding can only lose what the exact pulse tells. Of a pulse it receives peak,
duration, restitution, impulse, the law of loss and its viscous part, which together determine it.

Behind a beam, an estimate: a learner on pulses with the least errors that unbiased estimates can have
(`studies.ceilings.beam`), neither an upper nor a lower bound. From below, a learner receives the pulses recovered
through the beam.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.training.rows import BEAM_FEATURES
from cgid.measure.features.extraction import extract_array
from cgid.scene import Scene, synthesise
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.impacts import draws
from studies.ceilings.beam import BeamErrors
from studies.ceilings.limit import Learner

#: Fraction of the training signals held out to decide between the learners, and units of the network's layers.
_HELD_BACK = 0.2
_NEURONS = (32, 32)
#: Most steps of a network through its training signals, once.
_STEPS = 400
#: Seed of the draws to train on, unlikely to be chosen for the signals.
_SEED = 0x5EED_0001_C9D1
#: Draws on which the learner on exact pulses is trained; it ends when four times as many gain less than the second on
#: draws held back, of this number.
_EXACT_SIZES, _SATURATED, _HELD_DRAWS = (1 << 14, 1 << 16, 1 << 18), 0.001, 1 << 16
#: The same for estimated pulses behind a beam, which take longer.
_ESTIMATED_SIZES, _HELD_ESTIMATES = (1 << 13, 1 << 15), 1 << 14
#: Parameters of a pulse, besides its law, that a learner receives as logarithms or, where they may be missing, as is.
_PULSE, _OPTIONAL = ("peak_force", "contact_duration", "restitution"), ("second_hit_delay", "second_hit_ratio")

Progress = Callable[[int], object] | None


@dataclass(frozen=True)
class Rows:
    """The inputs of a learner (n, n_columns), nan where a signal cannot be measured, and the labels (n,)."""

    inputs: Floats
    labels: NDArray[np.str_]

    def part(self, selected: slice) -> Rows:
        """Return some of the rows."""
        return Rows(self.inputs[selected], self.labels[selected])


def above(scene: Scene, n_test: int, seed: int, *, drop_height_known: bool = False) -> tuple[Learner, ...]:
    """Return learners on the exact pulses of the signals of a seed, by size until another gains little."""
    test = exact(scene, n_test, seed, drop_height_known)
    training = exact(scene, _HELD_DRAWS + _EXACT_SIZES[-1], _SEED, drop_height_known)
    return _saturated(test, training, _EXACT_SIZES)


def behind_beam(
    scene: Scene, n_test: int, seed: int, *, drop_height_known: bool = False, progress: Progress = None
) -> tuple[tuple[Learner, ...], float]:
    """Return learners on pulses with the errors of Cramér and Rao, the last one the estimate.

    And the median distance of the scene's pulses from those of the family that stand for them, root mean square over
    that of the pulse.
    """
    errors = BeamErrors(scene)
    test, apart = _estimated(errors, n_test, seed, drop_height_known, progress)
    n_training = _HELD_ESTIMATES + _ESTIMATED_SIZES[-1]
    training, _ = _estimated(errors, n_training, _SEED, drop_height_known, progress)
    return _saturated(test, training, _ESTIMATED_SIZES), apart


def through_beam(
    scene: Scene, n_training: int, n_test: int, seed: int, *, drop_height_known: bool = False, progress: Progress = None
) -> Learner:
    """Return a learner on the pulses recovered through the beam, on the signals of a seed."""
    beam = ThroughBeam(BeamErrors(scene).beam)
    rows = []
    for n_signals, own in ((n_test, seed), (n_training, seed + 1 if seed < 2**63 - 1 else 0)):
        inputs, labels = [], []
        for batch in synthesise(scene, n_signals, own):
            values = extract_array(
                batch.signals,
                batch.sampling_rate,
                BEAM_FEATURES,
                pre_trigger=batch.pre_trigger,
                invalid="nan",
                beam=beam,
            )
            positive = [not name.endswith("correlation") for name in BEAM_FEATURES]
            with np.errstate(invalid="ignore", divide="ignore"):
                values[:, positive] = np.log(values[:, positive])
            inputs.append(np.hstack([values, _height(batch.parameters, drop_height_known)]))
            labels.append(batch.labels)
            if progress is not None:
                progress(len(batch))
        rows.append(Rows(np.concatenate(inputs), np.concatenate(labels)))
    return Learner(n_training, answers(rows[1], rows[0]) == rows[0].labels)


def _height(parameters: Any, known: bool) -> Floats:
    # 2 ln(velocity), which all scenes have, is the logarithm of the height up to a constant.
    return np.asarray(2 * np.log(parameters["velocity"])[:, None][:, : int(known)])


def exact(scene: Scene, n_draws: int, seed: int, drop_height_known: bool) -> Rows:
    """Return what the exact pulses of impacts tell."""
    rows, labels = [], []
    for sampled in draws(scene, seed, -(-n_draws // BLOCK)):
        values = sampled.parameters
        mass = values["density"] * values["radius"] ** 3 * values.get("effective_mass", 1.0)
        impulse = mass * values["velocity"] * (1 + values["restitution"])  # up to a constant
        columns = [np.log(values[name]) for name in _PULSE]
        columns += [np.log(impulse), values.get("dissipation", np.zeros(impulse.size))]
        columns += [np.nan_to_num(values[name]) for name in _OPTIONAL if name in values]
        rows.append(np.column_stack([*columns, _height(values, drop_height_known)]))
        labels.append(sampled.labels)
    return Rows(np.concatenate(rows)[:n_draws], np.concatenate(labels)[:n_draws])


def _estimated(
    errors: BeamErrors, n_draws: int, seed: int, drop_height_known: bool, progress: Progress
) -> tuple[Rows, float]:
    """Return what estimates of pulses behind a beam tell, and the median distance of the pulses from the family."""
    rows, labels, apart = [], [], []
    for features, true in errors.estimated(seed, n_draws):
        rows.append(np.hstack([features, _height(true.blows.parameters, drop_height_known)]))
        labels.append(true.blows.labels)
        apart.append(true.apart)
        if progress is not None:
            progress(min(BLOCK, n_draws - BLOCK * (len(rows) - 1)))
    found = Rows(np.concatenate(rows)[:n_draws], np.concatenate(labels)[:n_draws])
    return found, float(np.median(np.concatenate(apart)[:n_draws]))


def _saturated(test: Rows, training: Rows, sizes: tuple[int, ...]) -> tuple[Learner, ...]:
    """Return learners by size until another gains little on draws held back, evaluated on the test."""
    n_held = len(training.labels) - sizes[-1]
    held = training.part(slice(n_held))
    both = Rows(np.concatenate([held.inputs, test.inputs]), np.concatenate([held.labels, test.labels]))
    found: list[Learner] = []
    shares: list[float] = []
    for size in sizes:
        hits = answers(training.part(slice(n_held, n_held + size)), both) == both.labels
        found.append(Learner(size, hits[n_held:]))
        shares.append(float(hits[:n_held].mean()))
        if len(shares) > 1 and shares[-1] - shares[-2] < _SATURATED:
            break
    return tuple(found)


def answers(rows: Rows, test: Rows) -> NDArray[np.str_]:
    """Return a learner's answers; the most frequent label for a signal that cannot be measured."""
    from threadpoolctl import threadpool_limits

    # Numbers, because in scikit-learn before 1.8 early stopping of a network fails with string labels.
    names, numbers, counts = np.unique(rows.labels, return_inverse=True, return_counts=True)
    sound, measured = (np.isfinite(one.inputs).all(axis=1) for one in (rows, test))
    found = np.full(len(test.labels), names[counts.argmax()], dtype=names.dtype)
    if len(np.unique(numbers[sound])) < 2 or not measured.any():
        return found
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a network need not converge
        found[measured] = names[_best(rows.inputs[sound], numbers[sound]).predict(test.inputs[measured])]
    return found


def _best(inputs: Floats, labels: NDArray[np.intp]) -> Any:
    """Return the learner that is best on a held-out part, retrained on all signals."""
    held = max(int(_HELD_BACK * len(inputs)), 1)
    scores = {}
    for kind in ("quadratic", "network", "boosting"):
        if len(np.unique(labels[held:])) > 1:
            model = _learner(kind, len(inputs) - held).fit(inputs[held:], labels[held:])
            scores[kind] = model.score(inputs[:held], labels[:held])
    kind = max(scores, key=lambda name: scores[name]) if scores else "quadratic"
    return _learner(kind, len(inputs)).fit(inputs, labels)


def _learner(kind: str, n_signals: int) -> Any:
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.linear_model import LogisticRegression
    from sklearn.neural_network import MLPClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    if kind == "boosting":
        return HistGradientBoostingClassifier(
            learning_rate=0.05, max_iter=400, l2_regularization=1.0, early_stopping=n_signals >= 1000, random_state=0
        )
    if kind == "quadratic":
        return make_pipeline(StandardScaler(), PolynomialFeatures(2), LogisticRegression(C=10.0, max_iter=1000))
    network = MLPClassifier(
        _NEURONS,
        alpha=1e-3,
        batch_size=min(max(256, n_signals // _STEPS), n_signals),
        early_stopping=n_signals >= 1000,
        n_iter_no_change=8,
        max_iter=80,
        random_state=0,
    )
    return make_pipeline(StandardScaler(), network)
