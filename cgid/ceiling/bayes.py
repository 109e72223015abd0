"""The ceiling: how well anybody could tell the materials of a scene apart, who knows the scene and sees the signals.

Bayes' rule is applied to each of many synthetic signals. The probability of a signal under a population is the integral
of its likelihood over that population's pulses: along the shape by quadrature, over peak, duration and (where it is not
known) onset by Laplace's approximation, the population's density from many draws. The share of right answers of that
rule is the ceiling; its standard error is that of the number of signals.

The ceiling from below: what a strong learner reaches on the estimator's own output, the more it sees.

Judged on the very signals of the ceiling, so that most of the chance in both cancels in their difference.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.measure.features import extract_array
from cgid.measure.filters import low_pass_response
from cgid.measure.likelihood import Prior, Profile, profile
from cgid.measure.pulses import PulseBatch
from cgid.physics import HertzRangeWarning
from cgid.scene import Scene, parse_scene, synthesise
from cgid.scene.draws import BLOCK
from cgid.scene.impacts import draw
from cgid.signals import Batch
from cgid.validation import Floats

#: Most signals that are judged on, or learnt from: they take hours, and tell the accuracy to 1e-4.
MOST_SIGNALS = 10_000_000
#: Draws that make the density of one population.
PRIOR_DRAWS = 1 << 19
#: Their seed: not one that a user would choose for the signals.
_PRIOR_SEED = 0x5EED_0000_C9D1
#: Populations whose draws are kept (8 MiB each): noise and sampling change nothing about them.
_KEPT = 8
#: Nodes along the shape: with half as many the probability of a signal changes by up to .1, the accuracy by .0005.
NODES = 33
#: Signals treated at once.
_ROWS = 1024
#: Where ln(restitution) of a population varies by less than this, it has nodes of its own.
_NARROW = 0.3


@dataclass(frozen=True)
class Ceiling:
    """The best that can be done in a scene, by Bayes' rule on each of some signals.

    Attributes
    ----------
    labels : tuple of str
    truth : ndarray of str, (n,)
    probabilities : ndarray, (n, n_labels)
        Of each label given the signal.
    """

    labels: tuple[str, ...]
    truth: NDArray[np.str_]
    probabilities: Floats

    @property
    def accuracy(self) -> float:
        """Expected share of right answers: the mean probability of the most probable label."""
        return float(self.probabilities.max(axis=1).mean())

    @property
    def accuracy_error(self) -> float:
        """Standard error of the accuracy."""
        return float(self.probabilities.max(axis=1).std(ddof=1) / np.sqrt(len(self.truth)))

    @property
    def hits(self) -> NDArray[np.bool_]:
        """Where the most probable label is the true one; their share must agree with the accuracy."""
        return np.asarray(np.array(self.labels)[self.probabilities.argmax(axis=1)] == self.truth)

    @property
    def brier_score(self) -> float:
        """Mean of the squared error summed over the labels, 0 to 2."""
        return float(self._squared.mean())

    @property
    def brier_error(self) -> float:
        """Standard error of the Brier score."""
        return float(self._squared.std(ddof=1) / np.sqrt(len(self.truth)))

    @property
    def _squared(self) -> Floats:
        true = self.truth[:, None] == np.array(self.labels)[None]
        return np.asarray(np.sum((self.probabilities - true) ** 2, axis=1))

    def roc(self, label: str) -> tuple[Floats, Floats]:
        """Return the shares of the others taken for a label and of it found, as the threshold falls."""
        validation.choice("label", label, self.labels)
        order = np.argsort(-self.probabilities[:, self.labels.index(label)], kind="stable")
        own = (self.truth == label)[order]
        return np.cumsum(~own) / max((~own).sum(), 1), np.cumsum(own) / max(own.sum(), 1)

    def roc_area(self, label: str) -> float:
        """Return the area under the ROC curve of a label."""
        wrong, right = self.roc(label)
        return float(np.trapezoid(np.append(0.0, right), np.append(0.0, wrong)))


def ceiling(
    scene: Scene,
    n_signals: int = 20_000,
    seed: int = 1_000_003,
    *,
    drop_height_known: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Ceiling:
    """Return the Bayes limit of a scene.

    Parameters
    ----------
    scene : Scene
        Of impacts on a half space or a rigid wall, with noise; its noise level is taken as known.
    n_signals : int
        The standard error falls with their root; at most `MOST_SIGNALS`.
    seed : int
        Of the signals.
    drop_height_known : bool
        Whether the speed at touch is known for each impact.
    progress : callable, optional
        Called with the number of signals done.

    Raises
    ------
    InvalidValue
        The scene is one that the integration does not cover, or has a single label; or `n_signals` breaks its rule.
    """
    return ceilings(scene, n_signals, seed, (drop_height_known,), progress=progress)[0]


def ceilings(
    scene: Scene,
    n_signals: int,
    seed: int,
    drop_height_known: tuple[bool, ...],
    *,
    n_nodes: int = NODES,
    progress: Callable[[int], object] | None = None,
) -> tuple[Ceiling, ...]:
    """Return a ceiling for each state of knowledge, of the same signals; as `ceiling`.

    The likelihoods cost nearly everything and are the same whatever is known of the drop height.
    """
    check_covered(scene)
    validation.whole("n_signals", n_signals, 2, MOST_SIGNALS)  # of one there is no standard error
    known = [
        [_Knowledge.of(scene, index, height) for index in range(len(scene.populations))] for height in drop_height_known
    ]
    weights = np.log([population.weight for population in scene.populations])
    truth: list[NDArray[np.str_]] = []
    evidence: list[list[Floats]] = [[] for _ in known]
    for batch in _joined(synthesise(scene, n_signals, seed)):
        truth.append(batch.labels)
        log_speed = np.log(batch.parameters["velocity"])[:, None]
        profiles = _profiles(scene, batch, known[0], n_nodes)
        for held, knowledge in zip(evidence, known, strict=True):
            columns = [k.evidence(p, batch, log_speed) for k, p in zip(knowledge, profiles, strict=True)]
            held.append(np.stack(columns, axis=1) + weights)
        if progress is not None:
            progress(len(batch))
    return tuple(_by_label(scene, np.concatenate(truth), np.concatenate(held), weights) for held in evidence)


def check_covered(scene: Scene) -> None:
    """Raise `InvalidValue` if the integration does not cover a scene, or it has a single label."""
    problems = (
        (scene.stream is not None, "a frame for each impact, this one is a stream; take [stream] out"),
        (
            scene.tail_beam is not None or bool(scene.sensor.filters),
            "the force itself: what a beam or a filter makes of it is no member of the family; give it to a learner "
            "(cgid train SCENE -o MODEL)",
        ),
        (
            scene.background is not None or bool(scene.sensor.offset) or bool(scene.sensor.drift),
            "white noise alone, without background, offset and drift",
        ),
        (scene.impact.gravity is not None, "impacts without gravity, which the family leaves out"),
        (scene.taps, "a scene of impacts alone, this one has taps"),
        (scene.randomise is not None, "a scene without [randomise]: vary it setting by setting"),
        (len(scene.labels) < 2, f"at least 2 labels, got {', '.join(scene.labels)}"),
        (not scene.sensor.noisy, "noise: without it every pulse is told exactly"),
        (
            getattr(scene.impact.target, "thickness", None) is not None,
            "a half space or a rigid wall: on a plate the pulses are another family",
        ),
        (scene.impact.dissipation == "elastic", "hunt-crossley dissipation: elastic pulses have no shape to be told"),
        (
            any(p.second_hit is not None or p.clipped_at is not None for p in scene.populations),
            "single hits that no sensor cuts off",
        ),
    )
    for wrong, rule in problems:
        if wrong:
            raise InvalidValue(f"scene {scene.name}: the ceiling needs {rule}")


@dataclass(frozen=True)
class _Knowledge:
    """What is known of one population: the density of its pulses, at unit speed where the speed is known."""

    prior: Prior
    speed: tuple[Floats, Floats] | None

    @classmethod
    def of(cls, scene: Scene, index: int, drop_height_known: bool) -> _Knowledge:
        drawn = _draws(_population_alone(scene, index), PRIOR_DRAWS)
        log_peak, log_duration = np.log(drawn["peak_force"]), np.log(drawn["contact_duration"])
        if not drop_height_known:
            return cls(Prior.from_draws(log_peak, log_duration, drawn["restitution"]), None)
        log_speed = np.log(drawn["velocity"])
        prior = Prior.from_draws(log_peak - 1.2 * log_speed, log_duration + 0.2 * log_speed, drawn["restitution"])
        counts, edges = np.histogram(log_speed, bins=200)
        return cls(prior, (np.asarray(edges, np.float64), counts / counts.sum() / np.diff(edges)))

    def evidence(self, along: Profile, batch: Batch, log_speed: Floats) -> Floats:
        """Return the logarithm of the probability of each signal."""
        peak_offset: Any = 0.0
        time_offset: Any = -np.log(batch.sampling_rate)
        own = np.zeros(len(batch))
        if self.speed is not None:
            # P0 ~ v^(6/5), T0 ~ v^(-1/5)
            peak_offset, time_offset = -1.2 * log_speed, time_offset + 0.2 * log_speed
            edges, density = self.speed
            cell = np.clip(np.searchsorted(edges, log_speed[:, 0], side="right") - 1, 0, len(density) - 1)
            inside = (log_speed[:, 0] >= edges[0]) & (log_speed[:, 0] <= edges[-1])
            own = np.log(np.where(inside, np.maximum(density[cell], 1e-12), 1e-12))
        # A fit that lies beside its pulse leaves nan: `_by_label` then goes by the weights.
        with np.errstate(invalid="ignore"):
            return np.asarray(own + self.prior.evidence(along, peak_offset, time_offset))


def _population_alone(scene: Scene, index: int) -> str:
    """Return the text of a scene that holds one population and nothing of the rig but the target."""
    content = json.loads(scene.text)
    content["populations"] = [content["populations"][index]]
    frame = {"sampling_rate": 1e5, "samples": 64, "pre_trigger": 8}
    return json.dumps({"name": "one", "sampling": frame, **{k: content[k] for k in ("impact", "populations")}})


@lru_cache(maxsize=_KEPT)
def _draws(text: str, n_draws: int) -> dict[str, Floats]:
    scene = parse_scene(json.loads(text))
    names = ("peak_force", "contact_duration", "restitution", "velocity")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HertzRangeWarning)
        blocks = [draw(scene, _PRIOR_SEED, block).parameters for block in range(n_draws // BLOCK)]
    return {name: np.concatenate([block[name] for block in blocks]) for name in names}


def _joined(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Yield the batches a few at a time: what is done to them costs the less the more there are."""
    held: list[Batch] = []
    for batch in batches:
        held.append(batch)
        if sum(map(len, held)) >= _ROWS:
            yield _one(held)
            held = []
    if held:
        yield _one(held)


def _one(held: list[Batch]) -> Batch:
    first = held[0]
    return Batch(
        signals=np.concatenate([b.signals for b in held]),
        labels=np.concatenate([b.labels for b in held]),
        sampling_rate=first.sampling_rate,
        unit=first.unit,
        pre_trigger=first.pre_trigger,
        specimen=np.concatenate([b.specimen for b in held]),
        parameters={name: np.concatenate([b.parameters[name] for b in held]) for name in first.parameters},
        source=first.source,
    )


def _profiles(scene: Scene, batch: Batch, knowledge: list[_Knowledge], n_nodes: int) -> list[Profile]:
    """Return the likelihood along the shape for each population.

    They share one unless the restitution of a population hardly varies: its own nodes must lie where it has any.
    """
    sensor, sampling = scene.sensor, scene.sampling
    noise = sensor.noise_level(batch.parameters["peak_force"], batch.sampling_rate)
    if sensor.bits is not None and sensor.range is not None:
        noise = np.hypot(noise, sensor.range / 2 ** (sensor.bits - 1) / np.sqrt(12))
    limit = None if sensor.range is None else np.full(len(batch), 0.999 * sensor.range)
    response = None if sensor.bandwidth is None else low_pass_response(sampling.sampling_rate, sensor.bandwidth)
    fit = PulseBatch(batch.signals, batch.sampling_rate, batch.pre_trigger, remove_baseline=False).fit
    touch = float(sampling.pre_trigger)
    bounds = [k.prior.shape_bounds for k in knowledge]
    if min(high - low for low, high in bounds) > _NARROW:
        bounds = [(min(low for low, _ in bounds), max(high for _, high in bounds))] * len(bounds)
    found = {
        (low, high): profile(
            batch.signals,
            fit,
            noise,
            lowest=low,
            highest=high,
            n_nodes=n_nodes,
            onset=np.full(len(batch), touch) if sampling.jitter == 0 else None,
            onset_between=None if sampling.jitter == 0 else (touch, touch + sampling.jitter),
            clip_level=limit,
            response=response,
        )
        for low, high in set(bounds)
    }
    return [found[bound] for bound in bounds]


def _by_label(scene: Scene, truth: NDArray[np.str_], evidence: Floats, weights: Floats) -> Ceiling:
    # What was not told goes by the shares of the populations.
    evidence = np.where(np.isfinite(evidence).all(axis=1, keepdims=True), evidence, weights)
    top = evidence.max(axis=1, keepdims=True)
    share = np.exp(evidence - top)
    of_population = np.array([population.label for population in scene.populations])
    columns = [share[:, of_population == label].sum(axis=1) for label in scene.labels]
    probabilities = np.stack(columns, axis=1)
    return Ceiling(scene.labels, truth, probabilities / probabilities.sum(axis=1, keepdims=True))


#: What the learner is given the logarithms of.
_POSITIVE = ("fitted_peak", "fitted_width", "fitted_restitution", "fitted_restitution_deviation")
#: Fewest signals that a learner can be trained on.
FEWEST = 100
#: Share of the training that decides between the learners, and the neurons of the network.
_HELD_BACK = 0.2
_NEURONS = (32, 32)


@dataclass(frozen=True)
class Learner:
    """What a learner reached.

    Attributes
    ----------
    n_signals : int
        It was trained on.
    kind : str
        "network" or "quadratic", whichever did better on signals held back from the training.
    hits : ndarray of bool, (n_test,)
        Where it was right; a signal that cannot be measured is taken for the commonest label.
    difference, difference_error : float
        Accuracy of the ceiling's answers less its own, on the same signals, and the standard error.
    regret, regret_error : float
        The same by the ceiling's probabilities in place of the truth: far less chance, as certain as these are.
    """

    n_signals: int
    kind: str
    hits: NDArray[np.bool_]
    difference: float
    difference_error: float
    regret: float
    regret_error: float

    @property
    def accuracy(self) -> float:
        """Share of right answers."""
        return float(self.hits.mean())

    @property
    def accuracy_error(self) -> float:
        """Standard error of the accuracy."""
        return float(self.hits.std(ddof=1) / np.sqrt(len(self.hits)))


@dataclass(frozen=True)
class Bracket:
    """The ceiling and what a learner reached below it.

    Attributes
    ----------
    ceiling : Ceiling
    learners : tuple of Learner
        By the number of signals they were trained on.
    unmeasured : int
        Test signals that cannot be measured.
    """

    ceiling: Ceiling
    learners: tuple[Learner, ...]
    unmeasured: int


def sizes_up_to(highest: int) -> tuple[int, ...]:
    """Return 1,000, 3,000, 10,000, ... and last `highest`.

    Examples
    --------
    >>> sizes_up_to(20_000)
    (1000, 3000, 10000, 20000)
    """
    if validation.count("learner", highest) < FEWEST:
        raise InvalidValue(f"learner must have at least {FEWEST} signals to train on, got {highest}; give more")
    if highest > MOST_SIGNALS:
        raise InvalidValue(f"learner must have at most {MOST_SIGNALS} signals to train on, got {highest}; give fewer")
    steps = [base * 10**power for power in range(3, 10) for base in (1, 3)]
    return (*(step for step in steps if step < highest), highest)


def bracket(
    scene: Scene,
    sizes: tuple[int, ...] = (1_000, 3_000, 10_000),
    n_test: int = 20_000,
    seed: int = 1_000_003,
    *,
    drop_height_known: bool = False,
    permute_labels: bool = False,
    limit: Ceiling | None = None,
    progress: Callable[[int], object] | None = None,
) -> Bracket:
    """Return the ceiling of a scene and what a learner reaches below it.

    Parameters
    ----------
    scene : Scene
    sizes : tuple of int
        Numbers of signals to train on, each set holding the one before. They are of another seed than the test.
    n_test, seed, drop_height_known
        Of the ceiling, as in `ceiling`.
    permute_labels : bool
        Whether the learner is trained on labels in random order: a check, accuracy must be that of guessing.
    limit : Ceiling, optional
        That of these very signals, where it is there already.
    progress : callable, optional
        Called with the number of signals done.

    Raises
    ------
    InvalidValue
        As `ceiling`, and if a size is too small to train on.
    """
    for size in sizes or (0,):
        sizes_up_to(size)
    if limit is None:
        limit = ceiling(scene, n_test, seed, drop_height_known=drop_height_known, progress=progress)
    test, truth = _measured(scene, n_test, seed, drop_height_known, progress)
    if not np.array_equal(truth, limit.truth):
        raise InvalidValue(f"limit must be the ceiling of the {n_test} signals of seed {seed}, it is of others")
    inputs, labels = _measured(scene, max(sizes), _training_seed(seed), drop_height_known, progress)
    if permute_labels:
        labels = np.random.default_rng(seed).permutation(labels)
    learners = [_learn(inputs[:size], labels[:size], test, limit) for size in sorted(sizes)]
    return Bracket(limit, tuple(learners), int((~np.isfinite(test).all(axis=1)).sum()))


def _training_seed(seed: int) -> int:
    return seed + 1 if seed < 2**63 - 1 else 0


def _measured(
    scene: Scene, n_signals: int, seed: int, drop_height_known: bool, progress: Callable[[int], object] | None
) -> tuple[Floats, NDArray[np.str_]]:
    """Return what the learner is given, nan where a signal cannot be measured, and the labels."""
    rows, labels = [], []
    for batch in _several(synthesise(scene, n_signals, seed)):
        values = [
            extract_array(b.signals, b.sampling_rate, _POSITIVE, pre_trigger=b.pre_trigger, invalid="nan")
            for b in batch
        ]
        with np.errstate(invalid="ignore", divide="ignore"):
            columns = [np.log(np.concatenate(values))]
        if drop_height_known:
            # By the speed at touch, which scenes that give a velocity know, too: their logarithms differ by a constant.
            columns.append(2 * np.log(np.concatenate([b.parameters["velocity"] for b in batch]))[:, None])
        rows.append(np.hstack(columns))
        labels += [b.labels for b in batch]
        if progress is not None:
            progress(sum(map(len, batch)))
    return np.concatenate(rows), np.concatenate(labels)


def _several(batches: Iterator[Any]) -> Iterator[list[Any]]:
    held = []
    for batch in batches:
        held.append(batch)
        if len(held) == 4:
            yield held
            held = []
    if held:
        yield held


def _learn(inputs: Floats, labels: NDArray[np.str_], test: Floats, limit: Ceiling) -> Learner:
    from threadpoolctl import threadpool_limits

    # By their numbers: scikit-learn before 1.8 cannot stop a network early that learns texts.
    names, numbers, counts = np.unique(labels, return_inverse=True, return_counts=True)
    sound = np.isfinite(inputs).all(axis=1)
    measured = np.isfinite(test).all(axis=1)
    answers = np.full(len(test), names[counts.argmax()], dtype=names.dtype)
    kind = "guess"
    if len(np.unique(numbers[sound])) > 1 and measured.any():
        with threadpool_limits(1), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a network that has not converged is judged by what it does
            kind, model = _best(inputs[sound], numbers[sound])
            answers[measured] = names[model.predict(test[measured])]
    return _judged(len(inputs), kind, answers, limit)


def _best(inputs: Floats, labels: NDArray[np.intp]) -> tuple[str, Any]:
    """Return the learner that is right more often on signals held back, trained on all."""
    held = max(int(_HELD_BACK * len(inputs)), 1)
    scores = {}
    for kind in ("quadratic", "network"):
        if len(np.unique(labels[held:])) > 1:
            scores[kind] = (
                _learner(kind, len(inputs) - held).fit(inputs[held:], labels[held:]).score(inputs[:held], labels[:held])
            )
    kind = max(scores, key=lambda name: scores[name]) if scores else "quadratic"
    return kind, _learner(kind, len(inputs)).fit(inputs, labels)


def _learner(kind: str, n_signals: int) -> Any:
    from sklearn.linear_model import LogisticRegression
    from sklearn.neural_network import MLPClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    if kind == "quadratic":
        return make_pipeline(StandardScaler(), PolynomialFeatures(2), LogisticRegression(C=10.0, max_iter=1000))
    network = MLPClassifier(
        _NEURONS,
        alpha=1e-3,
        batch_size=min(256, n_signals),
        early_stopping=n_signals >= 1000,
        n_iter_no_change=8,
        max_iter=80,
        random_state=0,
    )
    return make_pipeline(StandardScaler(), network)


def _judged(n_signals: int, kind: str, answers: NDArray[np.str_], limit: Ceiling) -> Learner:
    hits = answers == limit.truth
    lost = limit.hits.astype(float) - hits
    given = np.searchsorted(np.array(limit.labels), answers)
    regret = limit.probabilities.max(axis=1) - limit.probabilities[np.arange(len(answers)), given]
    root = np.sqrt(len(answers))
    return Learner(
        n_signals,
        kind,
        hits,
        float(lost.mean()),
        float(lost.std(ddof=1) / root),
        float(regret.mean()),
        float(regret.std(ddof=1) / root),
    )
