"""The ceiling from below and from above, by learners.

From below: a learner on what the estimator measures of signals. It is judged on the signals of the ceiling, so that
most of the statistical error cancels in the difference.

From above, where the integration does not cover a scene: a learner on the exact pulses of these impacts, trained on as
many as it takes to saturate. Noise, filters, clipping and rounding can only lose what the exact pulse tells. Of a pulse
it receives peak, duration, restitution, impulse, the law of loss and its viscous part, which together determine it.

Behind a beam, in place of that from above, an estimate: a learner on pulses with the least errors that unbiased
estimates can have (`cgid.ceiling.beam`). From below, the learner receives the pulses recovered through the beam.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.ceiling.bayes import MOST_SIGNALS, Ceiling, ceiling, check_asked, uncovered
from cgid.ceiling.beam import BeamErrors
from cgid.errors import InvalidValue
from cgid.identification.contact import ThroughBeam
from cgid.identification.rows import BEAM_FEATURES
from cgid.measure.features import extract_array
from cgid.measure.pulses import PULSE_FEATURES
from cgid.measure.table import Feature
from cgid.measure.vibration import Beam
from cgid.scene import Scene, load_scene, synthesise
from cgid.scene.draws import BLOCK
from cgid.scene.impacts import draws
from cgid.validation import Floats

#: Features whose logarithms are the inputs of the learner.
_POSITIVE = ("fitted_peak", "fitted_width", "shrunken_restitution", "shrunken_restitution_deviation")
#: The other features, for the learner of a scene with pulses of other families.
_OTHERS = tuple(f.name for f in PULSE_FEATURES if isinstance(f, Feature) and f.name not in _POSITIVE)
#: Fewest signals to train a learner on.
FEWEST = 100
#: Share of the training signals held out to decide between the learners, and units of the network's layers.
_HELD_BACK = 0.2
_NEURONS = (32, 32)
#: Most steps of a network through its training signals, once.
_STEPS = 400
#: Seed of the draws from above, unlikely to be chosen for the signals.
_EXACT_SEED = 0x5EED_0001_C9D1
#: Draws on which the learner on exact pulses is trained; it ends when four times as many gain less than the second on
#: draws held back, of this number.
_EXACT_SIZES, _SATURATED, _HELD_DRAWS = (1 << 14, 1 << 16, 1 << 18), 0.001, 1 << 16
#: The same for estimated pulses behind a beam, which take longer.
_ESTIMATED_SIZES, _HELD_ESTIMATES = (1 << 13, 1 << 15), 1 << 14
N_ESTIMATED = _HELD_ESTIMATES + _ESTIMATED_SIZES[-1]
#: Features behind a beam whose logarithms are inputs; the other ones are correlations.
_POSITIVE_BEAM = tuple(name for name in BEAM_FEATURES if not name.endswith("correlation"))
#: Parameters of a pulse, besides its law, that a learner receives as logarithms or, where they may be missing, as is.
_PULSE, _OPTIONAL = (
    ("peak_force", "contact_duration", "restitution"),
    ("second_hit_delay", "second_hit_ratio"),
)


@dataclass(frozen=True)
class Learner:
    """The result of a learner.

    Attributes
    ----------
    n_signals : int
        Training signals.
    kind : str
        "network", "quadratic" or "boosting", the best one on a held-out part of the training; "guess" if none can be
        trained.
    hits : ndarray of bool, (n_test,)
        Whether it was right. For a signal that cannot be measured the answer is the most frequent label.
    difference, difference_error : float
        Accuracy of the ceiling's answers (without a ceiling, of the best learner from above or, behind a beam, of the
        estimate) minus this learner's, on the same signals, and the standard error.
    regret, regret_error : float
        The same with the ceiling's probabilities in place of the truth, which reduces the statistical error; nan
        without a ceiling.
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
    """The ceiling and the learners below it; where the integration does not cover a scene, learners on both sides.

    Behind a beam, an estimate takes the place of those from above.

    Attributes
    ----------
    ceiling : Ceiling, optional
        None if the integration does not cover the scene.
    learners : tuple of Learner
        From below, by the number of training signals.
    unmeasured : int
        Test signals that cannot be measured.
    above : tuple of Learner
        From above, on exact pulses, by the number of draws; the last one is the bound. Empty if there is a ceiling.
    uncovered : str
        What the integration needs that the scene does not have; empty if there is a ceiling.
    estimate : tuple of Learner
        Behind a beam, on pulses with the errors of Cramér and Rao, by the number of draws; the last one is the
        estimate, neither an upper nor a lower bound. Else empty.
    apart : float
        Median distance of the scene's pulses from those of the family that stand for them in the estimate, root mean
        square over that of the pulse; nan without an estimate.
    """

    ceiling: Ceiling | None
    learners: tuple[Learner, ...]
    unmeasured: int
    above: tuple[Learner, ...] = ()
    uncovered: str = ""
    estimate: tuple[Learner, ...] = ()
    apart: float = float("nan")

    @property
    def kind(self) -> str:
        """What is known of the ceiling: its "limit", a "bracket", or an "estimate"."""
        return "limit" if self.ceiling is not None else "estimate" if self.estimate else "bracket"


def sizes_up_to(highest: int) -> tuple[int, ...]:
    """Return 1,000, 3,000, 10,000, ... and finally `highest`.

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
    scene: Scene | str | Path,
    sizes: tuple[int, ...] = (1_000, 3_000, 10_000),
    n_test: int = 20_000,
    seed: int = 1_000_003,
    *,
    drop_height_known: bool = False,
    limit: Ceiling | None = None,
    progress: Callable[[int], object] | None = None,
) -> Bracket:
    """Return the ceiling of a scene and the accuracy of learners below it, or of learners on both sides of it.

    Behind a beam, return an estimate of the ceiling and learners below it.

    Parameters
    ----------
    scene : Scene, str or Path
    sizes : tuple of int
        Numbers of training signals; each set contains the smaller ones. Their seed differs from that of the test. May
        be empty for an estimate.
    n_test, seed, drop_height_known
        As in `ceiling`.
    limit : Ceiling, optional
        The ceiling of the same signals, if already known.
    progress : callable, optional
        Called with the number of signals done.

    Returns
    -------
    Bracket

    Raises
    ------
    InvalidValue
        The scene has no single impacts or a single label, the errors behind its beam are not known, or a size is out
        of range.
    """
    scene = load_scene(scene)
    behind_beam = scene.tail_beam is not None
    for size in sizes if sizes or behind_beam else (0,):
        sizes_up_to(size)
    check_asked(scene)
    validation.whole("n_signals", n_test, 2, MOST_SIGNALS)
    another = seed + 1 if seed < 2**63 - 1 else 0
    rule = uncovered(scene)
    if behind_beam:
        return _behind_beam(scene, sizes, n_test, (seed, another), drop_height_known, progress)
    if limit is None and not rule:
        limit = ceiling(scene, n_test, seed, drop_height_known=drop_height_known, progress=progress)
    look = _Look((*_POSITIVE, *_OTHERS) if rule else _POSITIVE, _POSITIVE, drop_height_known)
    test = _measured(scene, look, n_test, seed, progress)
    if limit is not None and not np.array_equal(test.labels, limit.truth):
        raise InvalidValue(f"limit must be the ceiling of the {n_test} signals of seed {seed}, it is of others")
    above = () if limit is not None else _above(scene, n_test, seed, drop_height_known)
    signals = _measured(scene, look, max(sizes), another, progress)
    learners = _below(signals, sizes, test, limit, above)
    return Bracket(limit, learners, int((~test.sound).sum()), above, rule)


def _behind_beam(
    scene: Scene,
    sizes: tuple[int, ...],
    n_test: int,
    seeds: tuple[int, int],
    drop_height_known: bool,
    progress: Callable[[int], object] | None,
) -> Bracket:
    """Return the estimate of a scene with a beam, and learners of some sizes below it."""
    errors = BeamErrors(scene)
    test, apart = _estimated(errors, n_test, seeds[0], drop_height_known, progress)
    draws, _ = _estimated(errors, N_ESTIMATED, _EXACT_SEED, drop_height_known, progress)
    estimate = _saturated(test, draws, _ESTIMATED_SIZES)
    rule = uncovered(scene)
    if not sizes:
        return Bracket(None, (), 0, (), rule, estimate, apart)
    look = _Look(BEAM_FEATURES, _POSITIVE_BEAM, drop_height_known, ThroughBeam(errors.beam))
    measured = _measured(scene, look, n_test, seeds[0], progress)
    signals = _measured(scene, look, max(sizes), seeds[1], progress)
    learners = _below(signals, sizes, measured, None, estimate)
    return Bracket(None, learners, int((~measured.sound).sum()), (), rule, estimate, apart)


def _below(
    signals: _Rows, sizes: tuple[int, ...], test: _Rows, limit: Ceiling | None, above: tuple[Learner, ...]
) -> tuple[Learner, ...]:
    return tuple(
        _judged(size, *_answers(signals.part(slice(size)), test), test.labels, limit, above) for size in sorted(sizes)
    )


@dataclass(frozen=True)
class _Rows:
    """The inputs of a learner (n, n_columns), nan where a signal cannot be measured, and the labels (n,).

    Boosting receives all columns, the other learners the first n_core.
    """

    inputs: Floats
    labels: NDArray[np.str_]
    n_core: int

    @property
    def sound(self) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(self.inputs[:, : self.n_core]).all(axis=1))

    def part(self, chosen: slice) -> _Rows:
        return _Rows(self.inputs[chosen], self.labels[chosen], self.n_core)

    def joined(self, others: _Rows) -> _Rows:
        inputs, labels = np.concatenate([self.inputs, others.inputs]), np.concatenate([self.labels, others.labels])
        return _Rows(inputs, labels, self.n_core)


@dataclass(frozen=True)
class _Look:
    """What a learner from below receives: features, the first of which as logarithms."""

    features: tuple[str, ...]
    logarithms: tuple[str, ...]
    drop_height_known: bool
    beam: Beam | None = None


def _measured(scene: Scene, look: _Look, n_signals: int, seed: int, progress: Callable[[int], object] | None) -> _Rows:
    rows, labels, n_logarithms = [], [], len(look.logarithms)
    for batch in synthesise(scene, n_signals, seed):
        values = extract_array(
            batch.signals,
            batch.sampling_rate,
            look.features,
            pre_trigger=batch.pre_trigger,
            invalid="nan",
            beam=look.beam,
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            columns = [np.log(values[:, :n_logarithms])]
        if look.drop_height_known:
            # 2 ln(velocity), which all scenes have, is the logarithm of the height up to a constant.
            columns.append(2 * np.log(batch.parameters["velocity"])[:, None])
        rows.append(np.hstack([*columns, values[:, n_logarithms:]]))
        labels.append(batch.labels)
        if progress is not None:
            progress(len(batch))
    return _Rows(np.concatenate(rows), np.concatenate(labels), n_logarithms + look.drop_height_known)


def _exact(scene: Scene, n_draws: int, seed: int, drop_height_known: bool) -> _Rows:
    """Return what the exact pulses of impacts tell."""
    rows, labels = [], []
    for drawn in draws(scene, seed, -(-n_draws // BLOCK)):
        values = drawn.parameters
        mass = values["density"] * values["radius"] ** 3 * values.get("effective_mass", 1.0)
        impulse = mass * values["velocity"] * (1 + values["restitution"])  # up to a constant
        columns = [np.log(values[name]) for name in _PULSE]
        columns += [np.log(impulse), values.get("dissipation", np.zeros(impulse.size))]
        columns += [np.nan_to_num(values[name]) for name in _OPTIONAL if name in values]
        if drop_height_known:
            columns.append(np.log(values["velocity"]))
        rows.append(np.stack(columns, axis=1))
        labels.append(drawn.labels)
    inputs = np.concatenate(rows)[:n_draws]
    return _Rows(inputs, np.concatenate(labels)[:n_draws], inputs.shape[1])


def _above(scene: Scene, n_test: int, seed: int, drop_height_known: bool) -> tuple[Learner, ...]:
    """Return learners on the exact pulses of the signals of a seed, by size until another gains little."""
    test = _exact(scene, n_test, seed, drop_height_known)
    draws = _exact(scene, _HELD_DRAWS + _EXACT_SIZES[-1], _EXACT_SEED, drop_height_known)
    return _saturated(test, draws, _EXACT_SIZES)


def _estimated(
    errors: BeamErrors, n_draws: int, seed: int, drop_height_known: bool, progress: Callable[[int], object] | None
) -> tuple[_Rows, float]:
    """Return what estimates of pulses behind a beam tell, and the median distance of the pulses from the family."""
    rows, labels, apart = [], [], []
    for features, true in errors.estimated(seed, n_draws):
        blows = true.blows
        height = [2 * np.log(blows.parameters["velocity"])[:, None]] if drop_height_known else []
        rows.append(np.hstack([features, *height]))
        labels.append(blows.labels)
        apart.append(true.apart)
        if progress is not None:
            progress(min(BLOCK, n_draws - BLOCK * (len(rows) - 1)))
    inputs = np.concatenate(rows)[:n_draws]
    found = _Rows(inputs, np.concatenate(labels)[:n_draws], inputs.shape[1])
    return found, float(np.median(np.concatenate(apart)[:n_draws]))


def _saturated(test: _Rows, draws: _Rows, sizes: tuple[int, ...]) -> tuple[Learner, ...]:
    """Return learners by size until another gains little on draws held back, judged on the test."""
    n_held = len(draws.labels) - sizes[-1]
    judged = draws.part(slice(n_held)).joined(test)
    found: list[tuple[int, str, NDArray[np.str_]]] = []
    shares: list[float] = []
    for size in sizes:
        kind, answers = _answers(draws.part(slice(n_held, n_held + size)), judged)
        found.append((size, kind, answers[n_held:]))
        shares.append(float(np.mean((answers == judged.labels)[:n_held])))
        if len(shares) > 1 and shares[-1] - shares[-2] < _SATURATED:
            break
    last = (_judged(*found[-1], test.labels, None, ()),)
    return (*(_judged(*one, test.labels, None, last) for one in found[:-1]), *last)


def _answers(rows: _Rows, test: _Rows) -> tuple[str, NDArray[np.str_]]:
    """Return the kind of learner and its answers; the most frequent label for a signal that cannot be measured."""
    from threadpoolctl import threadpool_limits

    # Numbers, because in scikit-learn before 1.8 early stopping of a network fails with string labels.
    names, numbers, counts = np.unique(rows.labels, return_inverse=True, return_counts=True)
    sound, measured = rows.sound, test.sound
    answers = np.full(len(test.labels), names[counts.argmax()], dtype=names.dtype)
    if len(np.unique(numbers[sound])) < 2 or not measured.any():
        return "guess", answers
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a network need not converge
        kind, model = _best(rows.inputs[sound], numbers[sound], rows.n_core)
        answers[measured] = names[model.predict(test.inputs[measured])]
    return kind, answers


def _best(inputs: Floats, labels: NDArray[np.intp], n_core: int) -> tuple[str, Any]:
    """Return the learner that is best on a held-out part, retrained on all signals."""
    held = max(int(_HELD_BACK * len(inputs)), 1)
    scores = {}
    for kind in ("quadratic", "network", "boosting"):
        if len(np.unique(labels[held:])) > 1:
            model = _learner(kind, len(inputs) - held, n_core).fit(inputs[held:], labels[held:])
            scores[kind] = model.score(inputs[:held], labels[:held])
    kind = max(scores, key=lambda name: scores[name]) if scores else "quadratic"
    return kind, _learner(kind, len(inputs), n_core).fit(inputs, labels)


def _learner(kind: str, n_signals: int, n_core: int) -> Any:
    from sklearn.compose import make_column_transformer
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.linear_model import LogisticRegression
    from sklearn.neural_network import MLPClassifier
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    if kind == "boosting":
        return HistGradientBoostingClassifier(
            learning_rate=0.05, max_iter=400, l2_regularization=1.0, early_stopping=n_signals >= 1000, random_state=0
        )
    scaled = make_column_transformer((StandardScaler(), slice(0, n_core)))
    if kind == "quadratic":
        return make_pipeline(scaled, PolynomialFeatures(2), LogisticRegression(C=10.0, max_iter=1000))
    network = MLPClassifier(
        _NEURONS,
        alpha=1e-3,
        batch_size=min(max(256, n_signals // _STEPS), n_signals),
        early_stopping=n_signals >= 1000,
        n_iter_no_change=8,
        max_iter=80,
        random_state=0,
    )
    return make_pipeline(scaled, network)


def _judged(
    n_signals: int,
    kind: str,
    answers: NDArray[np.str_],
    truth: NDArray[np.str_],
    limit: Ceiling | None,
    above: tuple[Learner, ...],
) -> Learner:
    hits = answers == truth
    best = limit.hits if limit is not None else above[-1].hits if above else hits
    lost = best.astype(float) - hits
    regret = np.full(len(answers), np.nan)
    if limit is not None:
        given = np.searchsorted(np.array(limit.labels), answers)
        regret = limit.probabilities.max(axis=1) - limit.probabilities[np.arange(len(answers)), given]
    root = np.sqrt(len(answers))
    return Learner(
        n_signals=n_signals,
        kind=kind,
        hits=hits,
        difference=float(lost.mean()),
        difference_error=float(lost.std(ddof=1) / root),
        regret=float(regret.mean()),
        regret_error=float(regret.std(ddof=1) / root),
    )
