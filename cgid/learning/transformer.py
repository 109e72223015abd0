"""Tools for your own learners: a scikit-learn transformer, and scenes as endless training data."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import _check_feature_names_in, check_is_fitted, validate_data

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid._lib.workers import MAX_JOBS
from cgid._lib.workers import workers as executor
from cgid.errors import InvalidValue
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.training.rows import BEAM_FEATURES
from cgid.measure.features.extraction import Named, choose, extract_array
from cgid.measure.frames import DETECTION_LIMIT, MINIMUM_FRAME
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.synthesis.draws import require_seed
from cgid.scene.synthesis.synthesis import require_count, require_frames, synthesise
from cgid.scene.synthesis.through_beam import shared_beam
from cgid.signals import Batch, Signal, require_stated
from cgid.store.reading import Dataset
from cgid.units import quantity_of

__all__ = ["TrainingStream"]

#: A batch of a training stream: signals (n_signals, n_samples), numbers of the labels (n_signals,), and parameters,
#: each (n_signals,).
TrainingBatch = tuple[NDArray[Any], NDArray[np.int64], dict[str, Floats]]
#: Signals that one worker makes at a time. Random numbers are addressed by blocks of 256.
_AT_ONCE = 1024


class ImpactFeatures(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Transform rows of samples, one impact each, into a table of features.

    Each row is measured by itself; of the training rows only the number of samples is stored.

    Parameters
    ----------
    sampling_rate : float, optional
        [Hz]; by default that of `scene`. A `Batch` states its own, which must be this one, and is measured in the SI
        unit of its quantity; arrays must be in that unit, too.
    features : str or iterable of str, function or Feature, optional
        Names of features or banks, such as `"mel_*_hz"`, or features of one's own as in `cgid.extract`; by default all
        features of pulses, or with `scene` those that `cgid train` uses for vibrations of its beam.
    pre_trigger : int, optional
        Samples before onset, as in `cgid.extract`.
    remove_baseline : bool
        Whether to subtract the baseline before measuring.
    detection_limit : float
        Minimum height of a pulse over the standard deviation of the noise.
    invalid : {"nan", "raise"}
        Treatment of a row that cannot be measured: it has no impact, is cut off or too short. A row of nan keeps the
        rows of a table together; imputers and scikit-learn's histogram boosting accept it, `ImpactClassifier` does not.
        Samples that are not finite are always an error.
    scene : Scene, Dataset, str or Path, optional
        A scene with the tail beam whose vibrations the rows are: a scene, its name or file, or a dataset made from it.
        Features such as `beam_peak_force` then estimate the contact force through its modes.

    Attributes
    ----------
    features_ : tuple of str
        Names of the columns.
    n_features_in_ : int
        Number of samples of a row.

    Examples
    --------
    >>> t = np.arange(300) / 1e5
    >>> pulse = 800 * np.sin(np.pi * np.clip((t - 1e-3) / 1e-3, 0, 1)) ** 1.5
    >>> measuring = ImpactFeatures(1e5, ["peak_force", "contact_duration"]).fit([pulse])
    >>> measuring.transform([pulse, 0 * pulse]).round(5).tolist()
    [[800.0, 0.001], [nan, nan]]
    >>> measuring.get_feature_names_out().tolist()
    ['peak_force', 'contact_duration']
    """

    def __init__(
        self,
        sampling_rate: float | None = None,
        features: str | Iterable[Named] | None = None,
        *,
        pre_trigger: int | None = None,
        remove_baseline: bool = True,
        detection_limit: float = DETECTION_LIMIT,
        invalid: Literal["nan", "raise"] = "nan",
        scene: Scene | Dataset | str | Path | None = None,
    ) -> None:
        self.sampling_rate = sampling_rate
        self.features = features
        self.pre_trigger = pre_trigger
        self.remove_baseline = remove_baseline
        self.detection_limit = detection_limit
        self.invalid = invalid
        self.scene = scene

    def fit(self, X: ArrayLike, y: object = None) -> ImpactFeatures:
        """Check the settings against rows of samples.

        Parameters
        ----------
        X : array_like, (n_signals, n_samples), or Batch
        y : object
            Ignored.

        Returns
        -------
        ImpactFeatures
            Itself.

        Raises
        ------
        InvalidValue
            A setting breaks its rule, a feature needs longer rows or another sampling rate, the scene has no beam for
            the contact force, or a batch is of another rate, or of another quantity than the scene.
        """
        self._beam, self._quantity, rate = None, None, self.sampling_rate
        if self.scene is not None:
            source = self.scene if isinstance(self.scene, Scene | Dataset) else load_scene(self.scene)
            beam, why = shared_beam([source])
            if beam is None:
                raise InvalidValue(f"scene must have a beam, got {why}; leave it out")
            self._beam, rate = ThroughBeam(beam), beam.sampling_rate if rate is None else rate
            self._quantity = source.quantity if isinstance(source, Dataset) else quantity_of(source.sensor.unit)
        if rate is None:
            raise InvalidValue("sampling_rate must be given [Hz], such as ImpactFeatures(sampling_rate=200e3)")
        self._rate = rate
        validation.choice("invalid", self.invalid, ("nan", "raise"))
        if isinstance(self.features, Iterator):
            raise InvalidValue("features must be a list of names, got an iterator")
        names = BEAM_FEATURES if self._beam is not None and self.features is None else choose(self.features)
        frames = self._frames(X, reset=True)
        self._measured(frames[:0], names)
        self.features_ = names
        return self

    def transform(self, X: ArrayLike) -> Floats:
        """Return the features of each row.

        Parameters
        ----------
        X : array_like, (n_signals, n_samples), or Batch

        Returns
        -------
        ndarray, (n_signals, n_features)
            Or a DataFrame, after `set_output(transform="pandas")`.

        Raises
        ------
        BadData
            A row cannot be measured, if `invalid` is "raise".
        InvalidValue
            A batch is of another rate or quantity than it was fitted to.
        """
        check_is_fitted(self)
        return self._measured(self._frames(X, reset=False), self.features_)

    def get_feature_names_out(self, input_features: ArrayLike | None = None) -> NDArray[np.object_]:
        """Return the names of the columns.

        Parameters
        ----------
        input_features : array_like of str, optional
            Only checked: one name for each sample.

        Returns
        -------
        ndarray of str, (n_features,)
        """
        check_is_fitted(self)
        _check_feature_names_in(self, input_features)
        return np.array(self.features_, dtype=object)

    def _frames(self, X: ArrayLike, *, reset: bool) -> NDArray[Any]:
        if isinstance(X, str | Path | Signal | Dataset):
            raise InvalidValue(f"X must be rows of samples, one impact each, got {validation.shown(X)}")
        if isinstance(X, Batch):
            require_stated(X, self._rate)
            quantity = quantity_of(X.unit)
            if self._quantity not in (None, quantity):
                raise InvalidValue(f"X must be of {self._quantity}, got {quantity} [{X.unit}]; fit others to it")
            self._quantity = quantity if reset else self._quantity
            X = X.in_si().signals
        validation.plain("X", X)
        return np.asarray(validate_data(self, X, dtype=(np.float64, np.float32), reset=reset))

    def _measured(self, frames: NDArray[Any], names: tuple[str, ...]) -> Floats:
        limit = validation.number("detection_limit", self.detection_limit, rule=validation.positive)
        if frames.shape[1] < MINIMUM_FRAME and self.invalid == "nan":
            return np.full((len(frames), len(names)), np.nan)
        return extract_array(
            frames,
            self._rate,
            names,
            pre_trigger=self.pre_trigger,
            remove_baseline=self.remove_baseline,
            invalid=self.invalid,
            detection_limit=limit,
            beam=self._beam,
        )


@dataclass(frozen=True)
class TrainingStream:
    """Batches of the signals of a scene; made by `cgid.stream`. Each iteration begins again.

    Attributes
    ----------
    scene : Scene
    batch_size, seed, workers, first : int
    n_signals : int or None
        Of all batches, the last of which may be smaller; None: unlimited.
    shard : tuple of int
        Number of this part, and number of all parts.
    """

    scene: Scene
    batch_size: int
    seed: int
    workers: int
    first: int
    n_signals: int | None
    shard: tuple[int, int]

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the labels, in the order of their numbers."""
        return self.scene.labels

    def __iter__(self) -> Iterator[TrainingBatch]:
        part, n_parts = self.shard
        signals = self.batch_size * max(_AT_ONCE // self.batch_size, 1)
        starts: Iterator[int] = (start * signals for start in count(part, n_parts))
        if self.n_signals is not None:
            n = self.n_signals
            starts = takewhile(lambda start: start < n, starts)
        # More processes than processors would only cost memory.
        with (
            executor(min(self.workers, os.cpu_count() or 1)) as pool,
            closing(pool.each_in_step(_batches, self, starts)) as made,
        ):
            for batches in made:
                yield from batches


def stream(
    scene: Scene | str | Path,
    *,
    batch_size: int = 64,
    seed: int = 0,
    workers: int = 1,
    n_signals: int | None = None,
    first: int = 0,
    shard: tuple[int, int] = (0, 1),
) -> TrainingStream:
    """Return batches of new signals for a training loop, without a file.

    Signal k of a seed is always the same, and equals signal k of `cgid.synthesise` and of `cgid generate`: neither the
    size of the batches nor the number of workers or shards changes it.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a scene file, or a shipped scene.
    batch_size : int
        Number of signals of a batch.
    seed : int
        From 0 to 2^63 - 1.
    workers : int
        Number of processes, at most that of processors; 1 is this process.
    n_signals : int, optional
        Number of signals of all shards together; by default unlimited.
    first : int
        Number of the first signal, to continue an earlier stream.
    shard : tuple of int
        Number of this part and number of all parts, such as those of a data loader's worker: each batch of 1024 or
        fewer signals belongs to exactly one shard.

    Returns
    -------
    TrainingStream
        Iterable over tuples: signals, float32 (n_signals, n_samples); numbers of their labels in `labels`, int64
        (n_signals,); a dict of parameters, each (n_signals,), with the sampling rate [Hz].

    Raises
    ------
    InvalidValue
        A number breaks its rule, or the scene is of continuous recordings.

    Examples
    --------
    >>> batches = stream("reference", batch_size=8, n_signals=20)
    >>> [signals.shape for signals, labels, parameters in batches]
    [(8, 2048), (8, 2048), (4, 2048)]
    >>> batches.labels
    ('coal', 'gangue')
    """
    scene = load_scene(scene)
    require_frames(scene)
    if not isinstance(shard, tuple) or len(shard) != 2:
        raise InvalidValue(f"shard must be the number of this part and of all parts, as in (0, 2), got {shard!r}")
    n_parts = validation.count("number of shards", shard[1])
    return TrainingStream(
        scene=scene,
        batch_size=validation.count("batch_size", batch_size),
        seed=require_seed(seed),
        workers=validation.whole("workers", workers, 1, MAX_JOBS),
        first=require_count(1, first)[1],
        n_signals=None if n_signals is None else require_count(n_signals, first)[0],
        shard=(validation.whole("shard", shard[0], 0, n_parts - 1), n_parts),
    )


def _batches(settings: TrainingStream, first: int) -> list[TrainingBatch]:
    """Return the batches that one worker makes at a time, from this signal of the stream on."""
    size = settings.batch_size
    n = size * max(_AT_ONCE // size, 1)
    if settings.n_signals is not None:
        n = min(n, settings.n_signals - first)
    made = list(synthesise(settings.scene, n, settings.seed, first=settings.first + first))
    names = np.array(settings.labels)
    signals = np.concatenate([batch.signals for batch in made])
    labels = np.searchsorted(names, np.concatenate([batch.labels for batch in made])).astype(np.int64)
    rates = [np.full(len(batch), batch.sampling_rate) for batch in made]
    columns = {name: np.concatenate([batch.parameters[name] for batch in made]) for name in made[0].parameters}
    columns["sampling_rate"] = np.concatenate(rates)
    parts = [slice(start, start + size) for start in range(0, n, size)]
    return [(signals[part], labels[part], {name: column[part] for name, column in columns.items()}) for part in parts]
