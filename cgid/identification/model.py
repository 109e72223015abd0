"""The trained model: what it needs, its file, its answers. Numpy only, and nothing in a file can run.

A model file is an uncompressed .npz archive: `header`, a JSON text, and arrays of numbers.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData, InvalidValue, NoInput
from cgid.features import FEATURES
from cgid.identification.families import BY_NAME, Family
from cgid.identification.transform import Neighbourhood, Standardiser, softmax
from cgid.signals import quantity_of
from cgid.validation import Floats

if TYPE_CHECKING:
    from cgid.identification.classifier import ImpactClassifier

FORMAT = "cgid-model"
SCHEMA_VERSION = 1
#: A larger file is no model of ours.
LARGEST_FILE = 64 << 20
#: The answer for an impact that lies outside of what the model was trained on.
UNKNOWN = "unknown"
_SHARED = {
    "standardiser.logarithmic": ("logarithmic", 1),
    "standardiser.floor": ("floor", 1),
    "standardiser.mean": ("mean", 1),
    "standardiser.scale": ("scale", 1),
}


@dataclass(frozen=True, kw_only=True)
class Model:
    """A trained model.

    Attributes
    ----------
    family : {"boosting", "discriminant", "logistic"}
    labels : tuple of str
        In the order of the probabilities.
    features : tuple of str
        What it needs to know of a pulse, out of `cgid.features.FEATURES`.
    unit : str
        Of the signals it was trained on.
    sampling_rates : tuple of float
        Lowest and highest it was trained for [Hz].
    temperature, neighbourhood_limit : float
    arrays : dict of ndarray
    training : dict
        How it was made and how good it is: the content of the model card.
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

    def __post_init__(self) -> None:
        _check_names(self)
        _check_numbers(self)
        _ = self._classifier  # checks the arrays of the family

    @property
    def quantity(self) -> str:
        """Quantity of the signals it was trained on."""
        return quantity_of(self.unit)

    @cached_property
    def _classifier(self) -> Family:
        own = {name.removeprefix("family."): a for name, a in self.arrays.items() if name.startswith("family.")}
        return BY_NAME[self.family](own, len(self.features), len(self.labels))

    @cached_property
    def _standardiser(self) -> Standardiser:
        return Standardiser(**{key: self.arrays[name] for name, (key, _) in _SHARED.items()})

    @cached_property
    def _neighbourhood(self) -> Neighbourhood:
        names = ("neighbourhood.centres", "neighbourhood.whitening")
        return Neighbourhood(self.arrays[names[0]], self.arrays[names[1]], self.neighbourhood_limit)

    def probabilities(self, features: Floats) -> Floats:
        """Return the probability of each label, (n_impacts, n_labels).

        Parameters
        ----------
        features : ndarray, (n_impacts, n_features)
            In the order of `self.features`.
        """
        return softmax(self._classifier.scores(self._standardised(features)) / self.temperature)

    def novelty(self, features: Floats) -> Floats:
        """Return how far each impact lies from the training, (n_impacts,): above 1 is outside.

        The distance is Mahalanobis' to the nearest class over the standardised features; 1 is the distance
        that 99.9 % of the training impacts keep.
        """
        return self._neighbourhood.novelty(self._standardised(features))

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

    def _standardised(self, features: Floats) -> Floats:
        if features.ndim != 2 or features.shape[1] != len(self.features) or not np.isfinite(features).all():
            raise InvalidValue(
                f"features must be finite rows of {len(self.features)} ({', '.join(self.features)}), "
                f"got shape {features.shape}"
            )
        return self._standardiser.apply(np.asarray(features, np.float64))

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
    ) -> Model:
        """Return the model of a fitted classifier."""
        standardiser, neighbourhood = classifier.standardiser_, classifier.neighbourhood_
        own = BY_NAME[classifier.family].export(classifier.estimator_)
        arrays: dict[str, NDArray[Any]] = {name: getattr(standardiser, key) for name, (key, _) in _SHARED.items()}
        arrays |= {"neighbourhood.centres": neighbourhood.centres, "neighbourhood.whitening": neighbourhood.whitening}
        arrays |= {f"family.{name}": array for name, array in own.items()}
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
            "quantity": self.quantity,
            "unit": self.unit,
            "sampling_rates": list(self.sampling_rates),
            "temperature": self.temperature,
            "neighbourhood_limit": self.neighbourhood_limit,
            "training": dict(self.training),
        }

    def to_bytes(self) -> bytes:
        """Return the content of the model file; the same model gives the same bytes."""
        stream = io.BytesIO()
        text = json.dumps(self.header, sort_keys=True).encode()
        np.savez(stream, header=np.frombuffer(text, np.uint8), **dict(sorted(self.arrays.items())))  # type: ignore[arg-type]
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
        try:
            with Path(path).open("rb") as stream:
                content = stream.read(LARGEST_FILE + 1)
        except OSError as error:
            raise NoInput(
                f"{path}: the model cannot be read ({error.strerror}); give a file made by cgid train"
            ) from None
        try:
            return cls._parse(content)
        except (BadData, InvalidValue) as error:
            raise BadData(f"{path}: no sound model: {error}; train it again") from None

    @classmethod
    def _parse(cls, content: bytes) -> Model:
        arrays = _read_arrays(content)
        try:
            header = json.loads(arrays.pop("header").tobytes())
        except (KeyError, ValueError):
            raise BadData("it must have a header of JSON") from None
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise BadData(f"format must be {FORMAT!r}")
        if header.get("schema_version") != SCHEMA_VERSION:
            raise BadData(f"schema_version must be {SCHEMA_VERSION}, got {header.get('schema_version')}")
        kinds: dict[str, type | tuple[type, ...]] = {
            "family": str,
            "labels": list,
            "features": list,
            "unit": str,
            "sampling_rates": list,
            "temperature": (int, float),
            "neighbourhood_limit": (int, float),
            "training": dict,
        }
        for name, kind in kinds.items():
            if not isinstance(header.get(name), kind):
                raise BadData(f"{name} is missing or of a wrong kind in the header")
        values: dict[str, Any] = {
            name: tuple(header[name]) if kind is list else header[name] for name, kind in kinds.items()
        }
        return cls(arrays=arrays, **values)


def _read_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    if len(content) > LARGEST_FILE:
        raise BadData(f"it must be at most {LARGEST_FILE >> 20} MiB, it is larger")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
        # Stored, not deflated: what is declared cannot be larger than the file.
        if (
            any(e.compress_type != zipfile.ZIP_STORED or e.file_size > len(content) for e in entries)
            or len(entries) > 64
        ):
            raise BadData("its arrays must be stored uncompressed")
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except BadData:
        raise
    except Exception as error:  # zipfile and numpy raise many kinds on damaged archives; all mean the same here
        raise BadData(f"it must be an .npz archive of numbers ({type(error).__name__})") from None


def _check_names(model: Model) -> None:
    validation.choice("family", model.family, tuple(BY_NAME))
    for name, values, least in (("labels", model.labels, 2), ("features", model.features, 1)):
        if len(values) < least or not all(isinstance(v, str) and v for v in values) or len(set(values)) != len(values):
            raise BadData(f"{name} must be at least {least} different words")
    for feature in model.features:
        validation.choice("feature", feature, FEATURES)
    quantity_of(model.unit)


def _check_numbers(model: Model) -> None:
    lowest_highest = validation.positive("sampling_rates", model.sampling_rates, "Hz")
    if lowest_highest.shape != (2,) or lowest_highest[0] > lowest_highest[1]:
        raise BadData("sampling_rates must be the lowest and the highest")
    validation.positive("temperature", model.temperature)
    validation.positive("neighbourhood_limit", model.neighbourhood_limit)
    n_features, n_classes = len(model.features), len(model.labels)
    shapes = {name: (n_features,) * axes for name, (_, axes) in _SHARED.items()}
    shapes |= {
        "neighbourhood.centres": (n_classes, n_features),
        "neighbourhood.whitening": (n_classes, n_features, n_features),
    }
    for name, shape in shapes.items():
        if name not in model.arrays or model.arrays[name].shape != shape:
            raise BadData(f"array {name} must have shape {shape}")
    for name, array in model.arrays.items():
        kinds = "b" if name == "standardiser.logarithmic" else "fi"
        if array.dtype.kind not in kinds or not np.isfinite(array).all():
            raise BadData(f"array {name} must hold finite numbers, got {array.dtype}")
    if not (model.arrays["standardiser.scale"] > 0).all() or not (model.arrays["standardiser.floor"] > 0).all():
        raise BadData("arrays standardiser.scale and standardiser.floor must be above 0")
