"""Correct bias, slope and sensor gain of a model with a few labelled impacts on another beam.

Ten to fifty impacts determine only a few parameters, each with a prior: the bias of each label (standard deviation
0.7), ln of the slope of the scores (0.3), and ln of the gain of the sensor (0.2), which divides features with the unit
of the signal. With prior probability 3/4 no correction is needed; the result is the mean over the alternatives,
weighted by their evidence. `benchmarks/identification/site_correction.py` checks these assumed numbers.

The corrected probabilities are softmax(a s + b) of the scores s at the corrected features, folded into temperature,
last intercepts and standardiser, so a corrected model is an ordinary model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.explanations import Explanations
from cgid.identification.model.families import Contrast, Standardiser, softmax
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import CONTROL, FLOOR, NO_FLOOR, STANDARDISER
from cgid.identification.training.control import in_backgrounds
from cgid.identification.training.control import judged as controlled
from cgid.identification.training.grouped import warnings_of_few
from cgid.identification.training.metrics import clustered_interval, evaluate, evaluate_drawn
from cgid.identification.training.rows import Rows
from cgid.measure.features.extraction import FEATURES
from cgid.units import quantity_of

#: Minimum number of labelled impacts inside the training of the model; with fewer the interval of the accuracy is
#: meaningless.
MIN_LABELLED = 10
#: Prior standard deviations of a bias, of ln slope, and of ln gain.
_BIAS, _SLOPE, _GAIN = 0.7, 0.3, 0.2
#: Prior probability that no correction is needed.
_NOTHING = 0.75
#: Logarithms of the gains tried, over the prior standard deviation.
_GAINS = np.linspace(-2.0, 2.0, 9)
#: The array with the intercept of each score, by family.
_INTERCEPTS = {
    "linear": "intercepts",
    "logistic": "intercepts",
    "network": "biases_3",
}
#: Metrics of the correction stored in a model.
_REPORTED = ("accuracy", "accuracy_interval_95", "recall", "confusion", "log_loss", "expected_calibration_error")
#: Maximum number of folds of held-out impacts: up to this number of impacts each is one.
_MAX_FOLDS = 50


@dataclass(frozen=True)
class Shift:
    """A correction: the bias of each label, (n_labels,), the slope of the scores, and the gain."""

    labels: tuple[str, ...]
    bias: Floats
    slope: float = 1.0
    gain: float = 1.0

    def __str__(self) -> str:
        """Describe the correction."""
        biases = ", ".join(f"{label} {bias:+.2f}" for label, bias in zip(self.labels, self.bias, strict=True))
        slope = f"; slope {self.slope:.2f}" * (self.slope != 1)
        return f"bias {biases}{slope}" + f"; gain {self.gain:.2f}" * (self.gain != 1)

    def probabilities(self, logs: Floats) -> Floats:
        """Return the probabilities from log-probabilities (n, n_labels) at the corrected features."""
        return softmax(self.slope * logs + self.bias)


@dataclass(frozen=True, eq=False)
class Correction:
    """A corrected model, and its accuracy and that of the original model."""

    model: StoredModel
    shift: Shift
    # `before`, `after`: results of `cgid.identification.training.metrics.evaluate` for the original model, and for the
    # corrected one by cross-validation
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    labels: NDArray[np.str_]  # (n_lumps,)
    probabilities: Floats  # (n_lumps, n_labels), cross-validated
    rows: Rows  # the labelled impacts, in this order
    n_unknown: int  # labelled impacts outside the training, which are not used
    warnings: tuple[str, ...] = ()  # of impacts left out, and of few groups; one line each


def correct(model: StoredModel, rows: Rows) -> Correction:
    """Return a model corrected by labelled impacts that did not train it."""
    require_correctable(model)
    rows = replace(
        rows, labels=np.array([validation.as_spelled(label, model.labels) for label in rows.labels.tolist()])
    )
    rows, left_out = _without_trained(model, rows)
    _require_impacts(model, rows)
    known = model.novelty(rows.columns(model.features), rows.columns(model.guards)) <= 1
    if int(known.sum()) < MIN_LABELLED:
        raise _too_few_known(int(known.sum()), len(known))
    rows = rows[known]
    labels, features = rows.labels, rows.columns(model.features)
    _require_labels(labels, model, " within its training")
    trials, rocks = _trials(rows), rows.rock
    truth = np.array([model.labels.index(label) for label in labels])
    impacts = _LabelledImpacts.of(model, features, truth, trials if _each_teaches_all(truth, trials) else rocks)
    shift, probabilities = impacts.learned()
    before = _evaluated(labels, softmax(impacts.logs[impacts.middle]), model, trials)
    after = _evaluated(labels, probabilities, model, trials)
    n, n_unknown = len(labels), int((~known).sum())
    model_after = shifted(model, shift)
    again = in_backgrounds(
        lambda table: np.array(model.labels)[np.argmax(model_after.probabilities(table), axis=1)],
        rows.background[:, :, rows.places(model.features)] if len(rows.background) else np.empty((n, 0, 1)),
    )
    answers = np.array(model.labels)[np.argmax(probabilities, axis=1)]
    correction = {
        CONTROL: controlled(rows, answers, again),
        "n": n,
        "n_rocks": len(np.unique(rocks)),
        "n_groups": len(np.unique(rows.group)),
        "n_trained_on": int(left_out.sum()),
        "n_unknown": n_unknown,
        "labels": {label: int(np.sum(labels == label)) for label in model.labels},
        "bias": shift.bias.tolist(),
        "slope": shift.slope,
        "gain": shift.gain,
        **{name: after[name] for name in _REPORTED},
        **({"drawn": drawn} if (drawn := evaluate_drawn(rows, probabilities, model.labels)) else {}),
        "before": {name: before[name] for name in _REPORTED},
        "sources": sorted({rows.digests[k] for k in rows.file.tolist()}) if len(rows.file) else list(rows.digests),
    }
    # The metrics remain those of the training, of thousands; prediction sets have no guarantee for another beam.
    metrics = {**model.training.get("metrics", {}), "prediction_sets": []}
    training = {**model.training, "metrics": metrics, "correction": correction}
    training |= {"same_beam": [*rows.same_beam]} if rows.same_beam else {}
    return Correction(
        replace(model_after, training=training),
        shift,
        before,
        after,
        labels,
        probabilities,
        rows,
        n_unknown,
        (*_word_of_trained(left_out), *warnings_of_few(rows)),
    )


def _without_trained(model: StoredModel, rows: Rows) -> tuple[Rows, NDArray[np.bool_]]:
    """Return the rows of recordings that did not train the model, and a mask of the others; raise if too few remain."""
    stated = (model.training.get("sources"), model.training.get("correction", {}).get("sources"))
    trained = [one for sources in stated if isinstance(sources, list | tuple) for one in sources]
    # A renamed copy has the same SHA-256. Other files of the same samples cannot be known.
    left_out = (
        np.isin(np.array(rows.digests)[rows.file], trained) if len(rows.file) else np.zeros(len(rows.labels), bool)
    )
    n, n_left = len(left_out), int((~left_out).sum())
    if left_out.any() and n_left < MIN_LABELLED:
        raise BadData(
            f"labelled impacts must be {MIN_LABELLED} at least that did not train the model, got {n_left} of {n}; the "
            f"other recordings trained it (by their SHA-256): label impacts of others, or name its base by "
            f"{spelled('base')}"
        )
    return rows[~left_out], left_out


def _word_of_trained(left_out: NDArray[np.bool_]) -> tuple[str, ...]:
    n = int(left_out.sum())
    what = (
        f"{n} of {len(left_out)} labelled impacts are left out, their recordings trained the model (by their SHA-256)"
    )
    return (what,) * (n > 0)


def _trials(rows: Rows) -> NDArray[np.intp]:
    """Return the number of the independent trial of each row: its group, or with a single group its rock."""
    groups = np.unique(rows.group, return_inverse=True)[1]
    return groups if groups.max() > 0 else rows.rock


def _each_teaches_all(truth: NDArray[np.intp], trials: NDArray[np.intp]) -> bool:
    """Return whether every label remains whichever trial is left out."""
    return all(len(np.unique(trials[truth == label])) > 1 for label in np.unique(truth))


def _evaluated(
    labels: NDArray[np.str_], probabilities: Floats, model: StoredModel, trials: NDArray[np.intp]
) -> dict[str, Any]:
    is_correct = np.array(model.labels)[np.argmax(probabilities, axis=1)] == labels
    interval = list(clustered_interval(is_correct, trials))
    return evaluate(labels, probabilities, model.labels) | {"accuracy_interval_95": interval}


def require_correctable(model: StoredModel) -> None:
    """Raise `InvalidValue` unless impacts can correct the model."""
    if model.kind == "window":
        raise InvalidValue(
            f"{spelled('base')} must name a model of impacts, this one is for windows; train it again with more"
        )


def _too_few_known(n_known: int, n: int) -> BadData:
    return BadData(
        f"labelled impacts must be within the training of the model, {MIN_LABELLED} at least, got {n_known} of {n}"
        f"; train without {spelled('base')}, or calibrate the beam first (cgid calibrate RECORDING "
        "--channel CHANNEL --scene YOUR_BEAM.toml -o site.toml)"
    )


def _require_impacts(model: StoredModel, rows: Rows) -> None:
    for label in np.unique(rows.labels).tolist():
        validation.choice("label", label, model.labels)
    _require_labels(rows.labels, model)
    if len(rows.labels) < MIN_LABELLED:
        raise BadData(
            f"labelled impacts must be {MIN_LABELLED} at least to correct a model, got {len(rows.labels)}; label more"
        )
    if quantity_of(rows.unit) != model.quantity:
        raise BadData(
            f"labelled impacts must be of the model's quantity, {model.quantity} [{model.unit}], got "
            f"{quantity_of(rows.unit)} [{rows.unit}]; give another {spelled('base')}"
        )


def _require_labels(labels: NDArray[np.str_], model: StoredModel, where: str = "") -> None:
    lacking = sorted(set(model.labels) - set(labels.tolist()))
    if lacking:
        raise BadData(
            f"labelled impacts{where} must have every label of the model ({', '.join(model.labels)}), none is "
            f"{lacking[0]}; label some"
        )


# -- learning ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _LabelledImpacts:
    """Labelled impacts: log-probabilities at each gain that is tried (n_gains, n, n_labels), and true labels (n,)."""

    labels: tuple[str, ...]
    logs: Floats
    truth: NDArray[np.intp]
    gains: Floats
    trials: NDArray[np.intp]  # (n,), those of one number are left out together

    @classmethod
    def of(
        cls, model: StoredModel, features: Floats, truth: NDArray[np.intp], trials: NDArray[np.intp]
    ) -> _LabelledImpacts:
        factors, addends = _gained(model, np.e)
        gains = np.exp(_GAIN * _GAINS) if (factors != 1).any() or addends.any() else np.ones(1)
        gained = [_gained(model, gain) for gain in gains]
        tables = [model.probabilities((features - addend) / factor) for factor, addend in gained]
        return cls(model.labels, np.log(np.maximum(np.stack(tables), 1e-12)), truth, gains, trials)

    @property
    def middle(self) -> int:
        """The number of the gain 1."""
        return len(self.gains) // 2

    def learned(self) -> tuple[Shift, Floats]:
        """Return the shift, and the cross-validated probabilities of each impact."""
        fold = self.trials % _MAX_FOLDS
        probabilities = np.empty(self.logs.shape[1:])
        for k in np.unique(fold):
            shift = self._fitted(fold != k)
            probabilities[fold == k] = shift.probabilities(self.logs[self._place(shift.gain), fold == k])
        return self._fitted(np.ones(len(fold), bool)), probabilities

    def _place(self, gain: float) -> int:
        return int(np.argmin(np.abs(np.log(self.gains / gain))))

    def _fitted(self, selected: NDArray[np.bool_]) -> Shift:
        """Return the mean of the possible shifts, weighted by their evidence (Hoeting et al. 1999)."""
        truth, logs = self.truth[selected], self.logs[:, selected]
        none = logs[self.middle, np.arange(len(truth)), truth].sum() + np.log(_NOTHING / (1 - _NOTHING))
        fits = [fit_bias_and_slope(log_probabilities, truth) for log_probabilities in logs]
        prior = -0.5 * (np.log(self.gains) / _GAIN) ** 2
        prior -= np.log(np.exp(prior).sum())
        evidence = np.array([log_evidence for _, log_evidence in fits]) + prior
        weights = np.exp(evidence - np.logaddexp(none, np.logaddexp.reduce(evidence)))
        mean = weights @ np.array([log_evidence for log_evidence, _ in fits])
        gain = float(self.gains[self._place(float(np.exp(weights @ np.log(self.gains))))])
        return Shift(self.labels, mean[:-1], float(np.exp(mean[-1])), gain)


def fit_bias_and_slope(logs: Floats, truth: NDArray[np.intp]) -> tuple[Floats, float]:
    """Return the most probable biases and ln slope, (n_labels + 1,), and ln of their evidence by Laplace's method."""
    n, n_labels = logs.shape
    rows = np.arange(n)
    precision = np.append(np.full(n_labels, _BIAS**-2), _SLOPE**-2)

    def loss(parameters: Floats) -> tuple[float, Floats]:
        slope = np.exp(parameters[-1])
        probabilities = softmax(slope * logs + parameters[:-1])
        value = -np.log(np.maximum(probabilities[rows, truth], 1e-300)).sum() + 0.5 * precision @ parameters**2
        error = probabilities.copy()
        error[rows, truth] -= 1
        slopes = np.append(error.sum(axis=0), slope * np.sum(error * logs))
        return float(value), slopes + precision * parameters

    optimum = minimize(loss, np.zeros(n_labels + 1), jac=True, method="L-BFGS-B", bounds=[(-6, 6)] * (n_labels + 1))
    slope = np.exp(optimum.x[-1])
    probabilities = softmax(slope * logs + optimum.x[:-1])
    effects = np.concatenate([np.broadcast_to(np.eye(n_labels), (n, n_labels, n_labels)), slope * logs[:, :, None]], 2)
    centred = effects - np.einsum("ik,ikp->ip", probabilities, effects)[:, None]
    curvature = np.einsum("ik,ikp,ikq->pq", probabilities, centred, centred)
    curvature[-1, -1] -= precision[-1] * optimum.x[-1]  # curvature of the exponential at the maximum
    size = np.linalg.slogdet(np.eye(n_labels + 1) + curvature / precision[:, None])[1]
    return np.append(optimum.x[:-1] - optimum.x[:-1].mean(), optimum.x[-1]), -float(optimum.fun) - 0.5 * float(size)


# -- into the model ---------------------------------------------------------------------------------------


def _gained(model: StoredModel, gain: float) -> tuple[Floats, Floats]:
    """Return the factor and the addend (n_features,) of a sensor gain in each feature."""
    factors, addends = np.ones(len(model.features)), np.zeros(len(model.features))
    for k, name in enumerate(model.features):
        unit = FEATURES[name].unit
        is_force = FEATURES[name].beam and unit == "N"  # the force on the beam scales with the signal
        power = 2.0 if "U^2" in unit else float("U" in unit or is_force)
        if unit.startswith("log10"):
            addends[k] = power * np.log10(gain)
        else:
            factors[k] = gain**power
    return factors, addends


def shifted(model: StoredModel, shift: Shift) -> StoredModel:
    """Return the model with a shift folded into its arrays, without prediction sets and explanations.

    Neither is that of the site.
    """
    lost = ("conformal.", *Explanations.PREFIXES)
    arrays = {name: array for name, array in model.arrays.items() if not name.startswith(lost)}
    gained = _gained(model, shift.gain)
    arrays |= _after(Standardiser.from_arrays(arrays, STANDARDISER), *gained).arrays(STANDARDISER)
    if FLOOR in arrays:
        arrays[FLOOR] = np.where(arrays[FLOOR] > NO_FLOOR, arrays[FLOOR] * gained[0] + gained[1], NO_FLOOR)
    if model.contrast is not None:  # its inputs include the guards, which no gain changes
        n_guards = len(model.guards)
        factors, addends = np.append(gained[0], np.ones(n_guards)), np.append(gained[1], np.zeros(n_guards))
        arrays |= _after(model.contrast.standardiser, factors, addends).arrays(Contrast.PREFIX)
    temperature = model.temperature / shift.slope
    name, moved = f"family.{_INTERCEPTS[model.family]}", shift.bias * temperature
    arrays[name] = arrays[name] + (np.diff(moved) if len(model.labels) == 2 else moved)
    return replace(model, arrays=arrays, temperature=temperature)


def _after(standardiser: Standardiser, factors: Floats, addends: Floats) -> Standardiser:
    """Return the standardiser for features f x + a, given that for x, both (n_features,)."""
    logarithmic, mean, scale = standardiser.logarithmic, standardiser.mean, standardiser.scale
    return Standardiser(
        logarithmic,
        np.where(logarithmic, standardiser.floor * factors, standardiser.floor),
        np.where(logarithmic, mean + np.log(factors), mean * factors + addends),
        np.where(logarithmic, scale, scale * factors),
    )
