"""The trained model: probabilities, novelty and prediction sets from features. Needs numpy only."""

from __future__ import annotations

import io
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.files import check_new, read_regular, write_together
from cgid._lib.notebook import facts_table
from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue
from cgid.identification.model.anchor import SeamNetworks, pulse_names
from cgid.identification.model.conformal import Conformal
from cgid.identification.model.confusion import Confusion
from cgid.identification.model.explanations import Explanations
from cgid.identification.model.families import (
    BY_NAME,
    MIN_DIVISOR,
    Contrast,
    Family,
    Fitted,
    Neighbourhood,
    Standardiser,
    as_numbers,
    softmax,
)
from cgid.identification.model.model_file import (
    FLOOR,
    FORMAT,
    LEVEL_RANGE,
    MENDED,
    NO_FLOOR,
    SCHEMA_VERSION,
    STANDARDISER,
    UNEXPLAINED,
    VOTE_CORRELATION,
    WITHDRAWN,
    NewerSchema,
    arrays_of,
    check_names,
    check_numbers,
    check_training,
    digest,
    fields_of,
    read_header,
    signed,
    stored_fields,
    with_floats,
)
from cgid.measure.features.extraction import (
    FEATURES,
    UnknownFeature,
    base_of,
    extract_array,
    in_units,
    kind_of,
    powers_of,
)
from cgid.measure.features.table import Kind
from cgid.measure.modal.beam import Beam
from cgid.signals import Batch, Signal
from cgid.units import UNITS, quantity_of

if TYPE_CHECKING:
    import pandas

    from cgid.identification.inversion.through_beam import ThroughBeam
    from cgid.identification.training.classifier import ImpactClassifier

#: Largest size of a model file [bytes].
MAX_FILE_SIZE = 64 << 20
#: Longest message about a bad model file.
_MAX_MESSAGE_LENGTH = 400
#: A beam is used at sampling rates from this fraction of the training's on.
MIN_SHARE = 0.5
#: Minimum number of groups of recordings of a label to estimate the spread between groups (assumed).
MIN_GROUPS = 5
#: Maximum number of inputs of a level: more would take seconds.
_MAX_LEVEL_INPUTS = 1500
#: Maximum number of values in memory during prediction.
_MAX_BLOCK = 1 << 20


def inputs_of(features: tuple[str, ...], n_channels: int) -> tuple[str, ...]:
    """Return the names of the inputs, channel by channel.

    >>> inputs_of(("a", "b"), 2)
    ('a of channel 1', 'b of channel 1', 'a of channel 2', 'b of channel 2')
    """
    if n_channels == 1:
        return features
    return tuple(f"{name} of channel {k}" for k in range(1, n_channels + 1) for name in features)


def _in_blocks(answer: Callable[[Floats], Floats], rows: Floats, width: int) -> Floats:
    """Apply `answer` to blocks of rows, to limit memory; `width` is the number of values it needs per row."""
    block = max(1, _MAX_BLOCK // width)
    # The caller checks the answer for overflow.
    with np.errstate(all="ignore"):
        if len(rows) <= block:
            return answer(rows)
        return np.concatenate([answer(rows[first : first + block]) for first in range(0, len(rows), block)])


def level_weights(
    inputs: Sequence[str], standardiser: Standardiser, neighbourhood: Neighbourhood
) -> tuple[Floats, float] | None:
    """Return weights (n_inputs,) of standardised inputs for the level, and its standard deviation in the training."""
    # The best linear estimate of ln of a factor on the signal: the residual of what has its unit, given what has not.
    # Uncertainties are excluded, since they depend on the noise.
    power, is_decadic = powers_of(inputs, "U")
    # A factor shifts only logarithms.
    shift = power * np.where(is_decadic, 1 / np.log(10), standardiser.logarithmic) / standardiser.scale
    is_certain = np.array([not base_of(name).endswith(("deviation", "correlation")) for name in inputs])
    used = (shift != 0) | (is_certain & (power == 0))
    if not shift.any() or len(shift) > _MAX_LEVEL_INPUTS:
        return None
    shift = shift[used]
    try:
        with np.errstate(all="ignore"):
            solved = np.linalg.solve(neighbourhood.covariance[np.ix_(used, used)], shift)
            weights, deviation = np.zeros(len(used)), float(1 / np.sqrt(shift @ solved))
            weights[used] = solved / (shift @ solved)
    except np.linalg.LinAlgError:
        deviation = np.nan
    if not (MIN_DIVISOR < deviation < 1 / MIN_DIVISOR and np.isfinite(weights).all()):
        raise BadData("arrays of the neighbourhood must give the levels of signals a finite deviation")
    return weights, deviation


@dataclass(frozen=True, kw_only=True, eq=False)
class Model(ABC):
    """A trained model, as `cgid.load_model` and training return it; two of the same content are equal.

    Attributes
    ----------
    family : str
        "linear", "logistic", "network", or the name of another class of scikit-learn.
    labels : tuple of str
        In the order of the probabilities.
    features : tuple of str
        Features of a signal that the model learns from, from `cgid.measure.features.FEATURES`.
    unit : str
        Unit of the training signals.
    sampling_rates : tuple of float
        Lowest and highest sampling rate of the training [Hz].
    training : dict
        Origin and quality of the model: the content of the model card.
    """

    family: str
    labels: tuple[str, ...]
    features: tuple[str, ...]
    unit: str
    sampling_rates: tuple[float, float]
    training: Mapping[str, Any]

    def __dir__(self) -> list[str]:
        return sorted({*dir(Model), *Model.__dataclass_fields__})

    @property
    @abstractmethod
    def inputs(self) -> tuple[str, ...]:
        """Inputs of the classifier: the features, channel by channel."""

    @abstractmethod
    def predict_proba(self, features: pandas.DataFrame | ArrayLike | Batch) -> Floats:
        """Return the probability of each label for rows of features, or for signals of one impact each.

        Parameters
        ----------
        features : DataFrame, Batch or array_like, (n_impacts, n_inputs)
            The features of a Batch are measured, through the beam of the model if it has one. Of a DataFrame the
            columns named in `inputs` are used; an array is in their order. If the `attrs["units"]` of a DataFrame, as
            `cgid.extract` returns it, states another scale than the model's `unit`, such as kN, the columns are
            converted. pandas drops `attrs` easily; numbers without it must be in the model's unit.

        Returns
        -------
        ndarray, (n_impacts, n_labels)
            In the order of `labels`.

        Raises
        ------
        InvalidValue
            A column is missing or states another quantity, or values are not finite or of another number.
        """

    @abstractmethod
    def predict(self, features: pandas.DataFrame | ArrayLike | Batch) -> NDArray[np.str_]:
        """Return the most probable label for rows of features or signals of a Batch, without a look at their novelty.

        `cgid.predict` also finds the impacts of a recording, and answers "unknown" outside of the training.

        Parameters
        ----------
        features : DataFrame, Batch or array_like, (n_impacts, n_inputs)
            As in `predict_proba`.

        Returns
        -------
        ndarray of str, (n_impacts,)

        Raises
        ------
        InvalidValue
            As `predict_proba`.
        """

    @abstractmethod
    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the model file, whole or not at all; `Training.save` also writes its card.

        Of a feature of one's own it has the name alone: where the file is read, `choose` must have named the function.

        Parameters
        ----------
        path : str or Path
            A name that ends in .npz.
        overwrite : bool
            Whether to replace a file of this name.

        Returns
        -------
        Path

        Raises
        ------
        CannotCreate
            The file exists, the name ends otherwise, or there is no such folder.
        WriteFailed
            The disk is full, for example; nothing is left behind.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredModel(Model):
    """The content of a model file, and what predictions compute from it: every `Model` is one.

    Attributes
    ----------
    temperature, neighbourhood_limit : float
        Divisor of the scores; distance at which the novelty is 1.
    arrays : dict of ndarray
    guards : tuple of str
        Features that only measure novelty; larger is more novel.
    guard_limits : tuple of float
        99.9 % quantiles of the guards in the training.
    window_time, hop_time : float
        Length and hop of the windows [s]; 0 unless it is a model of windows.
    n_channels : int
        Channels per answer; the features are measured on each of them.
    estimator : object, optional
        The fitted classifier of scikit-learn if no family has its scores; such a model has no file.
    """

    temperature: float
    neighbourhood_limit: float
    arrays: Mapping[str, NDArray[Any]]
    guards: tuple[str, ...] = ()
    guard_limits: tuple[float, ...] = ()
    window_time: float = 0.0
    hop_time: float = 0.0
    n_channels: int = 1
    estimator: Any = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "arrays", with_floats(self.arrays))
        check_names(self)
        check_numbers(self)
        check_training(self)
        self.neighbourhood.check()
        # They check their arrays.
        _ = self._classifier, self.conformal, self.contrast, self.beam, self.confusion, self.seams
        _ = self.explanations, self.changes
        _ = self._level_weights

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StoredModel):
            return NotImplemented
        return self.estimator is other.estimator and self.identity == other.identity

    def __hash__(self) -> int:
        return hash(self.identity)

    @cached_property
    def identity(self) -> str:
        """Checksum of its header and arrays."""
        return digest(self.header, self.arrays)

    def _repr_html_(self) -> str:
        metrics = self.training.get("metrics", {})
        facts = {
            "labels": ", ".join(self.labels),
            "inputs": f"{len(self.inputs)}, such as {self.inputs[0]}",
            "signals": f"{self.quantity} [{self.unit}] at {self.rates_text}",
            "trained on": f"{self.training.get('n_train', 'some')} {self.kind}s",
        }
        if isinstance(metrics.get("accuracy"), float):
            facts["accuracy"] = f"{metrics['accuracy']:.3f}"
        return facts_table(f"Model ({self.family})", facts)

    def __repr__(self) -> str:
        n_more = len(self.inputs) - 4
        inputs = ", ".join(self.inputs[:4]) + (f" and {n_more} more" if n_more > 0 else "")
        accuracy = self.training.get("metrics", {}).get("accuracy")
        accuracy_text = f", accuracy {accuracy:.3f}" if isinstance(accuracy, float) else ""
        return (
            f"Model({self.family}: {', '.join(self.labels)} from {inputs};\n"
            f"      trained on {self.training.get('n_train', 'some')} {self.kind}s of {self.quantity} [{self.unit}] at "
            f"{self.rates_text}{accuracy_text})"
        )

    @cached_property
    def quantity(self) -> str:
        """Quantity of the training signals."""
        return quantity_of(self.unit)

    @property
    def rates_text(self) -> str:
        """Range of the sampling rates of the training, such as "50000 to 200000 Hz"."""
        return " to ".join(f"{rate:g}" for rate in dict.fromkeys(self.sampling_rates)) + " Hz"

    @cached_property
    def is_of_few(self) -> bool:
        """Whether a label has too few groups for intervals that cover another day."""
        recorded = self.training.get("recorded", {})
        return bool(recorded.get("fewest_groups", MIN_GROUPS) < MIN_GROUPS)

    @cached_property
    def is_mended(self) -> bool:
        """Whether it was trained without tones of machines, which are taken out from the first sample on."""
        return bool(self.training.get(MENDED, False))

    @property
    def same_beam(self) -> tuple[str, ...]:
        """Channels of a beam of the training whose impacts are one row, such as "1+2"; none if each is by itself."""
        return tuple(self.training.get("same_beam", ()))

    @cached_property
    def measured(self) -> tuple[str, ...]:
        """Features to measure: those of the classifier, then the guards."""
        return self.features + self.guards

    @cached_property
    def extras(self) -> tuple[str, ...]:
        """Features to measure besides: what a beam shows of an impact, told with its answer and no part of it."""
        return ("beam_misshapen", "beam_overlap") if "beam_unexplained" in self.guards else ()

    @property
    def is_of_blows(self) -> bool:
        """Whether it looks through a beam and learned from simulated single blows alone, so it knows no bounces."""
        return self.beam is not None and "n_test_specimens" in self.training and "streams" not in self.training

    @cached_property
    def kind(self) -> Kind:
        """Kind of the signals: pulse, vibration or window."""
        return kind_of(self.measured)

    @cached_property
    def subject(self) -> Literal["impact", "window"]:
        """What one prediction is of: an impact, or a window of a recording."""
        return "window" if self.kind == "window" else "impact"

    @cached_property
    def inputs(self) -> tuple[str, ...]:  # noqa: D102 -- in `Model`
        return inputs_of(self.features, self.n_channels)

    @cached_property
    def together(self) -> int:
        """Number of channels per prediction: those of a window, or the sensors of the beam."""
        return self.n_channels if self.beam is None else self.beam.n_sensors

    @property
    def unexplained(self) -> float:
        """Median unexplained energy of the training [%]; 0 if the file does not state it."""
        return float(self.training.get(UNEXPLAINED, 0.0))

    @property
    def vote_correlation(self) -> float:
        """Correlation of successive windows in a vote: 0 none, 1 complete or unknown."""
        return float(self.training.get(VOTE_CORRELATION, 1.0))

    @cached_property
    def conformal(self) -> Conformal | None:
        """Calibration of the prediction sets; None if there were too few specimens."""
        if not self.arrays.keys() & {"conformal.scores", "conformal.labels"}:
            return None
        return Conformal(self.arrays["conformal.scores"], self.arrays["conformal.labels"], len(self.labels))

    @cached_property
    def _classifier(self) -> Family:
        if self.estimator is not None:
            return Fitted(self.estimator, len(self.inputs), len(self.labels))
        stored = {name.removeprefix("family."): a for name, a in self.arrays.items() if name.startswith("family.")}
        return BY_NAME[self.family](stored, len(self.inputs), len(self.labels))

    @cached_property
    def _standardiser(self) -> Standardiser:
        return Standardiser.from_arrays(self.arrays, STANDARDISER)

    @cached_property
    def neighbourhood(self) -> Neighbourhood:
        """Distance to the training data."""
        names = ("neighbourhood.centres", "neighbourhood.whitening")
        return Neighbourhood(self.arrays[names[0]], self.arrays[names[1]], self.neighbourhood_limit)

    def probabilities(self, inputs: Floats) -> Floats:
        """Return the probability of each label.

        Parameters
        ----------
        inputs : ndarray, (n_impacts, n_inputs)
            In the order of `self.inputs`.

        Returns
        -------
        ndarray, (n_impacts, n_labels)
        """
        probabilities = _in_blocks(
            lambda rows: softmax(self._classifier.scores(rows) / self.temperature),
            self._standardised(inputs),
            self._classifier.width,
        )
        if not np.isfinite(probabilities).all():
            raise BadData(f"the {self.family} model gives no finite probabilities for this input; train it again")
        return probabilities

    def predict_proba(self, features: pandas.DataFrame | ArrayLike | Batch) -> Floats:  # noqa: D102 -- in `Model`
        return self.probabilities(self._rows_of(features))

    def predict(self, features: pandas.DataFrame | ArrayLike | Batch) -> NDArray[np.str_]:  # noqa: D102
        return self.decide(self.predict_proba(features))

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:  # noqa: D102
        checked = check_new(Path(path), "a model", (".npz",), overwrite=overwrite)
        write_together({checked: self.to_bytes()}, overwrite=overwrite)
        return checked

    def _rows_of(self, features: Any) -> Floats:
        """Return rows of features, of a DataFrame by the names of its columns."""
        if isinstance(features, Batch) and self.kind != "window":
            if quantity_of(features.unit) != self.quantity:
                raise InvalidValue(
                    f"signals must be of the model's quantity, {self.quantity} [{self.unit}], got "
                    f"{quantity_of(features.unit)} [{features.unit}]; train a model on such signals"
                )
            signals = features.signals * (UNITS[self.quantity][features.unit] / UNITS[self.quantity][self.unit])
            rate, before = features.sampling_rate, features.pre_trigger
            return extract_array(signals, rate, self.features, pre_trigger=before, beam=self.beam)
        columns = getattr(features, "columns", None)
        if columns is None:
            if isinstance(features, str | Path | Signal | Batch):
                raise InvalidValue(
                    f"features must be a table of them, got {validation.shown(features)}; cgid.predict(..., "
                    "model=model) identifies recordings and signals"
                )
            return validation.real("features", features)
        missing = [name for name in self.inputs if name not in columns]
        if missing:
            raise InvalidValue(
                f"features must have the columns {', '.join(self.inputs)}, {', '.join(missing)} missing; measure them "
                "by cgid.extract(samples, sampling_rate, model.features)"
            )
        units = {one: FEATURES[base_of(one)].unit_for(self.unit) for one in self.inputs}
        return validation.real("features", in_units(features, units)[list(self.inputs)])

    def novelty(self, inputs: Floats, guards: Floats | None = None) -> Floats:
        """Return the novelty of each impact, (n_impacts,); above 1 it is outside the training range.

        This is the largest of the Mahalanobis distance to the nearest class and the guards, each divided by the 99.9 %
        quantile of the training impacts; and of the novelty against out-of-distribution impacts, if the training had
        some.

        Parameters
        ----------
        inputs : ndarray, (n_impacts, n_inputs)
            In the order of `self.inputs`.
        guards : ndarray, (n_impacts, n_guards), optional
            In the order of `self.guards`; required if the model has any.

        Returns
        -------
        ndarray, (n_impacts,)
        """
        neighbourhood = self.neighbourhood
        distance = _in_blocks(neighbourhood.novelty, self._standardised(inputs), neighbourhood.centres.size)
        if guards is None and not self.guards:
            guards = np.empty((len(inputs), 0))
        guards = None if guards is None else validation.plain("guards", guards)
        rows = len(inputs), len(self.guards)
        if guards is None or guards.shape != rows or not np.isfinite(guards).all():
            raise InvalidValue(
                f"guards must be finite rows of {len(self.guards)} ({', '.join(self.guards)}), "
                f"got {'none' if guards is None else f'shape {guards.shape}'}"
            )
        novelty = np.asarray(np.maximum(distance, np.max(guards / np.array(self.guard_limits), axis=1, initial=0.0)))
        if self.contrast is None:
            return novelty
        both = np.hstack([np.maximum(inputs, self._floor), guards])
        return np.asarray(np.maximum(novelty, _in_blocks(self.contrast.novelty, both, self.contrast.scorer.width)))

    def noise_novelty(self, inputs: Floats) -> Floats:
        """Return the part of the novelty of windows due to noise, (n_windows,); 0 if the model has none."""
        if self.contrast is None or self.kind != "window":
            return np.zeros(len(inputs))
        return _in_blocks(self.contrast.novelty, np.maximum(inputs, self._floor), self.contrast.scorer.width)

    @cached_property
    def contrast(self) -> Contrast | None:
        """The classifier of out-of-distribution impacts; None if the training had none."""
        return Contrast.from_arrays(self.arrays, len(self.inputs) + len(self.guards))

    @cached_property
    def beam(self) -> ThroughBeam | None:
        """The beam of the features; None without one."""
        beam = Beam.from_arrays(self.arrays)
        if beam is None:
            return None
        from cgid.identification.inversion.through_beam import ThroughBeam

        return ThroughBeam(beam, lasting=True)

    @cached_property
    def confusion(self) -> Confusion | None:
        """The confusion of rocks in streams; None if the model was not finished on streams."""
        return Confusion.from_arrays(self.arrays)

    @cached_property
    def seams(self) -> SeamNetworks | None:
        """The networks for fractions of gangue in any seam; None if the model was not trained on simulated seams."""
        return SeamNetworks.from_arrays(self.arrays)

    @cached_property
    def explanations(self) -> Explanations | None:
        """What explains recordings that are not as in the training; None without simulated faults."""
        return Explanations.from_arrays(self.arrays, Explanations.PREFIXES[0])

    @cached_property
    def changes(self) -> Explanations | None:
        """What explains that a channel is not as before; None without simulated faults."""
        return Explanations.from_arrays(self.arrays, Explanations.PREFIXES[1])

    @cached_property
    def _level_weights(self) -> tuple[Floats, float] | None:
        return level_weights(self.inputs, self._standardiser, self.neighbourhood)

    @cached_property
    def pulse_columns(self) -> list[int]:
        """Places of peak, width and restitution of a pulse among the features; empty without all three."""
        return [self.features.index(name) for name in pulse_names(self.features)]

    @property
    def level_range(self) -> Mapping[str, float]:
        """Upper end of the levels of a recording, as `training.grouped.level_range`; empty if not known."""
        return dict(self.training.get(LEVEL_RANGE, {}))

    @property
    def level_deviation(self) -> float:
        """Standard deviation of `levels` in the training; 0 if the model has no levels."""
        return 0.0 if self._level_weights is None else self._level_weights[1]

    def levels(self, inputs: Floats) -> Floats:
        """Return the logarithm of the level of each signal over that expected of such a signal, (n_impacts,).

        A factor on the signal adds its logarithm. Nan if no input of the model depends on the scale of the signal.
        """
        if self._level_weights is None:
            return np.full(len(inputs), np.nan)
        return np.asarray(self._standardised(inputs) @ self._level_weights[0])

    def most_distant(self, inputs: Floats) -> NDArray[np.intp]:
        """Return the index of the input that contributes most to the distance of each impact, (n_impacts,)."""
        return self.neighbourhood.most_distant(self._standardised(inputs))

    def usual(self, deviations: float) -> tuple[Floats, Floats]:
        """Return the range of each input within this many standard deviations of the training, two (n_inputs,)."""
        return self._standardiser.at(-deviations), self._standardiser.at(deviations)

    def prediction_set(self, probabilities: Floats, coverage: float) -> NDArray[np.bool_]:
        """Return the labels that cannot be ruled out for each impact, bool (n_impacts, n_labels).

        For impacts like those of the training, a fraction `coverage` of the sets contains the true label, for any
        quality of the probabilities. A set may contain several labels or none.

        Parameters
        ----------
        probabilities : ndarray, (n_impacts, n_labels)
        coverage : float
            In (0, 1).

        Returns
        -------
        ndarray of bool, (n_impacts, n_labels)

        Raises
        ------
        InvalidValue
            The model is not calibrated, or calibrated on too few impacts for this coverage.
        """
        if self.conformal is None:
            raise InvalidValue(
                "coverage must be left out, this model has no calibration impacts; train on more specimens of each "
                "label"
            )
        return self.conformal.prediction_set(probabilities, coverage)

    def covers(self, sampling_rate: float) -> bool:
        """Return whether a sampling rate [Hz] is in the range of the training, within 1 %.

        Parameters
        ----------
        sampling_rate : float [Hz]

        Returns
        -------
        bool
        """
        low, high = self.sampling_rates
        if self.beam is not None:  # the beam is the same at any rate, features include their errors
            low, high = MIN_SHARE * low, np.inf
        return bool(0.99 * low <= sampling_rate <= 1.01 * high)

    def decide(self, probabilities: Floats, costs: Mapping[str, float] | None = None) -> NDArray[np.str_]:
        """Return the label of the smallest expected cost, (n_impacts,).

        Parameters
        ----------
        probabilities : ndarray, (n_impacts, n_labels)
        costs : dict, optional
            Cost of mistaking an impact of this label for another; default 1. With coal 1 and gangue 3, coal is
            predicted only if it is three times as probable.

        Returns
        -------
        ndarray of str, (n_impacts,)

        Raises
        ------
        InvalidValue
            A label is unknown, or a cost is not above 0.
        """
        weights = np.ones(len(self.labels))
        for label, cost in (costs or {}).items():
            validation.choice("cost", label, self.labels)
            weights[self.labels.index(label)] = validation.positive(f"cost of {label}", cost)
        return np.asarray(np.array(self.labels)[np.argmax(probabilities * weights, axis=1)])

    def _standardised(self, inputs: Floats) -> Floats:
        inputs = validation.plain("features", inputs)
        if inputs.ndim != 2 or inputs.shape[1] != len(self.inputs) or not np.isfinite(inputs).all():
            raise InvalidValue(
                f"features must be finite rows of {len(self.inputs)} ({', '.join(self.inputs)}), "
                f"got shape {inputs.shape}"
            )
        return self._standardiser.apply(np.maximum(np.asarray(inputs, np.float64), self._floor))

    @cached_property
    def _floor(self) -> Floats:
        return self.arrays.get(FLOOR, np.full(len(self.inputs), -np.inf))

    # -- file -----------------------------------------------------------------------------------------

    @classmethod
    def from_classifier(
        cls,
        classifier: ImpactClassifier,
        *,
        guards: Mapping[str, float] | None = None,
        conformal: Conformal | None = None,
        contrast: Contrast | None = None,
        beam: Beam | None = None,
        floor: Floats | None = None,
        **fields: Any,
    ) -> StoredModel:
        """Return the model of a fitted classifier.

        Parameters
        ----------
        classifier : ImpactClassifier
            Fitted to the inputs: features, channel by channel.
        guards : dict of float, optional
            Limits of the guards.
        conformal : Conformal, optional
        contrast : Contrast, optional
        beam : Beam, optional
        floor : ndarray, (n_features,), optional
            Values below which nothing counts.
        **fields
            Other attributes of the model: at least features, unit, sampling_rates and training.
        """
        guards = guards or {}
        standardiser, neighbourhood = classifier.standardiser_, classifier.neighbourhood_
        name, estimator = classifier.family, classifier.estimator_
        if isinstance(name, str):
            found: tuple[str, dict[str, NDArray[Any]]] | None = name, BY_NAME[name].export(estimator)
        else:
            found = as_numbers(Fitted(estimator, classifier.n_features_in_, len(classifier.classes_)))
        name, family = found or (type(estimator).__name__, {})
        arrays: dict[str, NDArray[Any]] = standardiser.arrays(STANDARDISER)
        arrays |= {"neighbourhood.centres": neighbourhood.centres, "neighbourhood.whitening": neighbourhood.whitening}
        arrays |= {f"family.{name}": array for name, array in family.items()}
        if conformal is not None:
            arrays |= {"conformal.scores": conformal.scores, "conformal.labels": conformal.labels}
        if contrast is not None:
            arrays |= contrast.arrays
        if beam is not None:
            arrays |= beam.arrays
        if floor is not None and np.isfinite(floor).any():
            n_channels = len(neighbourhood.centres[0]) // len(floor)
            arrays[FLOOR] = np.tile(np.maximum(floor, NO_FLOOR), n_channels)
        # C order, as in the file: the last digit of a product may depend on the order.
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        return cls(
            family=name,
            labels=tuple(str(label) for label in classifier.classes_),
            temperature=classifier.temperature_,
            neighbourhood_limit=neighbourhood.limit,
            arrays=arrays,
            guards=tuple(guards),
            guard_limits=tuple(guards.values()),
            estimator=None if found else estimator,
            **fields,
        )

    @property
    def header(self) -> dict[str, Any]:
        """All fields except the arrays."""
        fields = {name: getattr(self, name) for name in stored_fields(type(self))}
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "quantity": self.quantity,
            **{name: [] for name in WITHDRAWN},
            **{name: list(value) if isinstance(value, tuple) else value for name, value in fields.items()},
            "training": dict(self.training),
        }

    def to_bytes(self) -> bytes:
        """Return the content of the model file; equal models give equal bytes.

        Returns
        -------
        bytes

        Raises
        ------
        InvalidValue
            The classifier is an object of scikit-learn that no family has the scores of.
        """
        if self.estimator is not None:
            raise InvalidValue(
                f"family must be {', '.join(BY_NAME)} in a file, got {self.family}, which only a pickle stores, and a "
                "pickle runs code when it is opened; train another family, or keep this model by joblib.dump and load"
            )
        stream = io.BytesIO()
        header = np.frombuffer(signed(self.header, self.arrays), np.uint8)
        np.savez(stream, header=header, **dict(sorted(self.arrays.items())))  # type: ignore[arg-type]
        return stream.getvalue()

    @classmethod
    def load(cls, path: str | Path) -> StoredModel:
        """Read a model file and check it completely.

        Raises
        ------
        NoInput
            The file cannot be read.
        BadData
            The file is not a valid model file, is damaged, or has an unsupported version.
        """
        content = read_regular(path, "the model", MAX_FILE_SIZE, "give a file made by cgid train")
        try:
            return cls.from_bytes(content)
        except NewerSchema as error:
            raise NewerSchema(f"{path}: {error}") from None
        except (BadData, InvalidValue) as error:
            # The message may quote long texts of the file.
            reason = textwrap.shorten(str(error), _MAX_MESSAGE_LENGTH, placeholder=" ...")
            if isinstance(error, UnknownFeature):
                raise BadData(f"{path}: {reason}") from None
            raise BadData(f"{path}: not a valid model: {reason}; train it again with cgid train") from None

    @classmethod
    def from_bytes(cls, content: bytes) -> StoredModel:
        """Return the model of a file's content, checked completely; raises `BadData` or `InvalidValue`."""
        stored = arrays_of(content)
        name, text = next(stored, ("", None))
        if name != "header" or text is None or text.dtype != np.uint8 or text.ndim != 1:
            raise BadData("it must be an .npz archive that begins with a header of JSON")
        # Read before the arrays, because a later version may allow further types.
        header = read_header(text)
        arrays = dict(stored)
        return cls(**fields_of(header, arrays, stored_fields(cls)), arrays=arrays)


def stored(model: Model) -> StoredModel:
    """Return a user's model with all that predictions use; raises `InvalidValue` for anything else."""
    if not isinstance(model, StoredModel):
        raise InvalidValue(
            f"model must be from cgid.load_model or the `model` of a training, got {type(model).__name__}"
        )
    return model
