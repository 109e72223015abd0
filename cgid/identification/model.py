"""The trained model: what it needs, its file, its answers. Numpy only, and nothing in a file can run.

A model file is an uncompressed .npz archive: `header`, a JSON text, and arrays of numbers.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.files import read_regular
from cgid.identification.conformal import Conformal
from cgid.identification.families import BY_NAME, Family, Neighbourhood, Standardiser, softmax
from cgid.identification.model_file import (
    FORMAT,
    SCHEMA_VERSION,
    STANDARDISER,
    NewerSchema,
    arrays_of,
    check_names,
    check_numbers,
    check_training,
    fields_of,
    read_header,
    signed,
)
from cgid.identification.reference import equalisations_of
from cgid.measure.features import kind_of
from cgid.measure.filters import Equalisation
from cgid.measure.table import Kind
from cgid.units import quantity_of
from cgid.validation import Floats

if TYPE_CHECKING:
    from cgid.identification.classifier import ImpactClassifier

#: A larger file is no model of ours.
LARGEST_FILE = 64 << 20
#: What is wrong with one is said in so many letters.
_LONGEST_MESSAGE = 400
#: Numbers that are held at once while rows are answered for.
_MOST_HELD = 1 << 20


def inputs_of(features: tuple[str, ...], n_channels: int) -> tuple[str, ...]:
    """Return what each input is called, channel after channel.

    Examples
    --------
    >>> inputs_of(("a", "b"), 2)
    ('a of channel 1', 'b of channel 1', 'a of channel 2', 'b of channel 2')
    """
    if n_channels == 1:
        return features
    return tuple(f"{name} of channel {k}" for k in range(1, n_channels + 1) for name in features)


def _in_blocks(answer: Callable[[Floats], Floats], rows: Floats, width: int) -> Floats:
    """Return the answers for rows, so many of them at once that the memory holds what a row needs."""
    most = max(1, _MOST_HELD // width)
    # Numbers that grow too large are seen in the answer, and said once.
    with np.errstate(all="ignore"):
        if len(rows) <= most:
            return answer(rows)
        return np.concatenate([answer(rows[first : first + most]) for first in range(0, len(rows), most)])


@dataclass(frozen=True, kw_only=True)
class Model:
    """A trained model.

    Attributes
    ----------
    family : {"boosting", "linear", "logistic", "network"}
    labels : tuple of str
        In the order of the probabilities.
    features : tuple of str
        What tells the labels apart, out of `cgid.measure.features.FEATURES`.
    unit : str
        Of the signals it was trained on.
    sampling_rates : tuple of float
        Lowest and highest it was trained for [Hz].
    temperature, neighbourhood_limit : float
    arrays : dict of ndarray
    training : dict
        How it was made and how good it is: the content of the model card.
    known : tuple of str
        What must be known beside the signal, out of `cgid.identification.drop_height.KNOWN`.
    guards : tuple of str
        Features that say only whether an impact is like those of the training: the larger, the stranger. The
        labels are not told apart by them.
    guard_limits : tuple of float
        What 99.9 % of the training impacts stay below.
    window_time, hop_time : float
        Length of a window and from the start of one to that of the next [s], for a model of windows; else 0.
    n_channels : int
        Channels that are looked at together; the features are measured on each of them.
    sensors : tuple of str
        Whose reference spectra the model holds.
    """

    family: str
    labels: tuple[str, ...]
    features: tuple[str, ...]
    unit: str
    sampling_rates: tuple[float, float]
    temperature: float
    neighbourhood_limit: float
    arrays: Mapping[str, NDArray[Any]]
    training: Mapping[str, Any]
    known: tuple[str, ...] = ()
    guards: tuple[str, ...] = ()
    guard_limits: tuple[float, ...] = ()
    window_time: float = 0.0
    hop_time: float = 0.0
    n_channels: int = 1
    sensors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_names(self)
        check_numbers(self)
        check_training(self)
        _ = self._classifier, self.conformal  # check their arrays

    @property
    def quantity(self) -> str:
        """Quantity of the signals it was trained on."""
        return quantity_of(self.unit)

    @property
    def measured(self) -> tuple[str, ...]:
        """What to measure on an impact: the features, then the guards."""
        return self.features + self.guards

    @property
    def kind(self) -> Kind:
        """What its signals are like: pulses, vibrations, or windows of a recording."""
        return kind_of(self.measured)

    @property
    def inputs(self) -> tuple[str, ...]:
        """What the probabilities follow from: the features, channel after channel, then what is known."""
        return inputs_of(self.features, self.n_channels) + self.known

    @property
    def references(self) -> dict[str, Floats]:
        """Reference spectra of each sensor, (n_channels, n_bands); none where the model knows no sensor."""
        return dict(zip(self.sensors, self.arrays["reference.spectra"], strict=True)) if self.sensors else {}

    @cached_property
    def conformal(self) -> Conformal | None:
        """The calibration of prediction sets; None when there were too few specimens for one."""
        if not self.arrays.keys() & {"conformal.scores", "conformal.labels"}:
            return None
        return Conformal(self.arrays["conformal.scores"], self.arrays["conformal.labels"], len(self.labels))

    @cached_property
    def _classifier(self) -> Family:
        own = {name.removeprefix("family."): a for name, a in self.arrays.items() if name.startswith("family.")}
        return BY_NAME[self.family](own, len(self.inputs), len(self.labels))

    @cached_property
    def _standardiser(self) -> Standardiser:
        return Standardiser(**{name: self.arrays[f"standardiser.{name}"] for name in STANDARDISER})

    @cached_property
    def _neighbourhood(self) -> Neighbourhood:
        names = ("neighbourhood.centres", "neighbourhood.whitening")
        return Neighbourhood(self.arrays[names[0]], self.arrays[names[1]], self.neighbourhood_limit)

    def probabilities(self, inputs: Floats) -> Floats:
        """Return the probability of each label, (n_impacts, n_labels).

        Parameters
        ----------
        inputs : ndarray, (n_impacts, n_inputs)
            In the order of `self.inputs`.
        """
        found = _in_blocks(
            lambda rows: softmax(self._classifier.scores(rows) / self.temperature),
            self._standardised(inputs),
            self._classifier.width,
        )
        if not np.isfinite(found).all():
            raise BadData(
                f"the {self.family} model gives no probabilities for this, its numbers grow too large; train it again"
            )
        return found

    def novelty(self, inputs: Floats, guards: Floats | None = None) -> Floats:
        """Return how far each impact lies from the training, (n_impacts,): above 1 is outside.

        It is the largest of the distance (Mahalanobis' to the nearest class over the standardised inputs) and the
        guards, each over what 99.9 % of the training impacts keep.

        Parameters
        ----------
        inputs : ndarray, (n_impacts, n_inputs)
            In the order of `self.inputs`.
        guards : ndarray, (n_impacts, n_guards), optional
            In the order of `self.guards`; needed where the model has any.
        """
        near = self._neighbourhood
        distance = _in_blocks(near.novelty, self._standardised(inputs), near.centres.size)
        if guards is None and not self.guards:
            return distance
        guards = None if guards is None else validation.plain("guards", guards)
        rows = len(inputs), len(self.guards)
        if guards is None or guards.shape != rows or not np.isfinite(guards).all():
            raise InvalidValue(
                f"guards must be finite rows of {len(self.guards)} ({', '.join(self.guards)}), "
                f"got {'none' if guards is None else f'shape {guards.shape}'}"
            )
        return np.asarray(np.maximum(distance, np.max(guards / np.array(self.guard_limits), axis=1, initial=0.0)))

    def prediction_set(
        self, probabilities: Floats, coverage: float, *, class_conditional: bool = False
    ) -> NDArray[np.bool_]:
        """Return which labels cannot be ruled out for each impact, (n_impacts, n_labels).

        Sets hold the truth as often as `coverage` says, for impacts like those of the training, however good the
        probabilities are. A set may hold several labels or none.

        Parameters
        ----------
        probabilities, coverage, class_conditional
            See `Conformal.prediction_set`.

        Raises
        ------
        InvalidValue
            The model was not calibrated for it, or not on enough impacts.
        """
        if self.conformal is None:
            raise InvalidValue(
                "coverage must be left out, this model has no calibration impacts to promise one; "
                "train on more specimens of each label"
            )
        return self.conformal.prediction_set(probabilities, coverage, class_conditional=class_conditional)

    def equalisation(self, sensor: str) -> tuple[Equalisation, ...]:
        """Return what makes a sensor sound as those of the training together, for each channel.

        Raises
        ------
        InvalidValue
            The model knows no such sensor.
        """
        if not self.sensors:
            raise InvalidValue("sensor must be left out, this model was trained without reference runs")
        validation.choice("sensor", sensor, self.sensors)
        return tuple(equalisations_of(self.references)[sensor])

    def covers(self, sampling_rate: float) -> bool:
        """Return whether the model was trained at this sampling rate [Hz], within 1 %."""
        return bool(0.99 * self.sampling_rates[0] <= sampling_rate <= 1.01 * self.sampling_rates[1])

    def decide(self, probabilities: Floats, costs: Mapping[str, float] | None = None) -> NDArray[np.str_]:
        """Return the label of the smallest expected cost, (n_impacts,).

        Parameters
        ----------
        probabilities : ndarray, (n_impacts, n_labels)
        costs : dict, optional
            What it costs to take an impact of this label for another; 1 where not said. With coal 1 and gangue 3,
            gangue is only drawn as coal when coal is three times as probable.

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
        return self._standardiser.apply(np.asarray(inputs, np.float64))

    # -- the file -------------------------------------------------------------------------------------

    @classmethod
    def from_classifier(
        cls,
        classifier: ImpactClassifier,
        *,
        features: tuple[str, ...],
        unit: str,
        sampling_rates: tuple[float, float],
        training: Mapping[str, Any],
        known: tuple[str, ...] = (),
        guards: Mapping[str, float] | None = None,
        conformal: Conformal | None = None,
        window_time: float = 0.0,
        hop_time: float = 0.0,
        n_channels: int = 1,
        references: Mapping[str, Floats] | None = None,
    ) -> Model:
        """Return the model of a classifier fitted to `features` and `known`; `guards` have their limits.

        `references` are the reference spectra of sensors, (n_channels, n_bands) each.
        """
        guards = guards or {}
        standardiser, neighbourhood = classifier.standardiser_, classifier.neighbourhood_
        own = BY_NAME[classifier.family].export(classifier.estimator_)
        arrays: dict[str, NDArray[Any]] = {f"standardiser.{name}": getattr(standardiser, name) for name in STANDARDISER}
        arrays |= {"neighbourhood.centres": neighbourhood.centres, "neighbourhood.whitening": neighbourhood.whitening}
        arrays |= {f"family.{name}": array for name, array in own.items()}
        if conformal is not None:
            arrays |= {"conformal.scores": conformal.scores, "conformal.labels": conformal.labels}
        if references:
            arrays["reference.spectra"] = np.stack(list(references.values()))
        # As they will be read: the last digit of a product may depend on the order in memory.
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        return cls(
            family=classifier.family,
            labels=tuple(str(label) for label in classifier.classes_),
            features=features,
            unit=unit,
            sampling_rates=sampling_rates,
            temperature=classifier.temperature_,
            neighbourhood_limit=neighbourhood.limit,
            arrays=arrays,
            training=training,
            known=known,
            guards=tuple(guards),
            guard_limits=tuple(guards.values()),
            window_time=window_time,
            hop_time=hop_time,
            n_channels=n_channels,
            sensors=tuple(references or ()),
        )

    @property
    def header(self) -> dict[str, Any]:
        """Everything but the arrays."""
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "family": self.family,
            "labels": list(self.labels),
            "features": list(self.features),
            "known": list(self.known),
            "guards": list(self.guards),
            "guard_limits": list(self.guard_limits),
            "quantity": self.quantity,
            "unit": self.unit,
            "sampling_rates": list(self.sampling_rates),
            "temperature": self.temperature,
            "neighbourhood_limit": self.neighbourhood_limit,
            "window_time": self.window_time,
            "hop_time": self.hop_time,
            "n_channels": self.n_channels,
            "sensors": list(self.sensors),
            "training": dict(self.training),
        }

    def to_bytes(self) -> bytes:
        """Return the content of the model file; the same model gives the same bytes."""
        stream = io.BytesIO()
        header = np.frombuffer(signed(self.header, self.arrays), np.uint8)
        np.savez(stream, header=header, **dict(sorted(self.arrays.items())))  # type: ignore[arg-type]
        return stream.getvalue()

    @classmethod
    def load(cls, path: str | Path) -> Model:
        """Return the model of a file, checked in full.

        Raises
        ------
        NoInput
            The file cannot be read.
        BadData
            It is no model, damaged, of another version, or would misbehave.
        """
        content = read_regular(path, "the model", LARGEST_FILE, "give a file made by cgid train")
        try:
            return cls.from_bytes(content)
        except NewerSchema as error:
            raise NewerSchema(f"{path}: {error}") from None
        except (BadData, InvalidValue) as error:
            # A stranger's text in it may be long.
            told = textwrap.shorten(str(error), _LONGEST_MESSAGE, placeholder=" ...")
            raise BadData(f"{path}: no sound model: {told}; train it again with cgid train") from None

    @classmethod
    def from_bytes(cls, content: bytes) -> Model:
        """Return the model of the content of a file, checked in full; raises `BadData` or `InvalidValue`."""
        stored = arrays_of(content)
        name, text = next(stored, ("", None))
        if name != "header" or text is None or text.dtype != np.uint8 or text.ndim != 1:
            raise BadData("it must be an .npz archive that begins with a header of JSON")
        # Before the rest: arrays of a later version may be of kinds unheard of.
        header = read_header(text)
        arrays = dict(stored)
        return cls(**fields_of(header, arrays), arrays=arrays)
