"""Labelled rows, the input of every training: each contains the features of one impact or window.

`measure` makes rows from labelled batches, `cgid.identification.training.recordings.record` from recordings.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from itertools import chain
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers
from cgid.errors import BadData, CgidError, InvalidValue
from cgid.identification.detection.events import SAME_IMPACT
from cgid.identification.detection.windows import CLEAR, WINDOW_TIME, columns_of
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model.model_file import require_times
from cgid.measure.features.extraction import (
    FEATURES,
    Named,
    any_through_beam,
    as_rows,
    choose,
    kind_for,
    kind_of,
    measured,
    require_measurable,
    supported,
)
from cgid.measure.features.table import MIN_BANDWIDTH, Kind
from cgid.measure.features.vibration import BEAM_PULSE, EARLY_BANDS
from cgid.measure.frames import frames_of
from cgid.measure.modal.beam import Beam
from cgid.measure.spectra import THIRD_OCTAVES
from cgid.signals import Batch
from cgid.units import UNITS, quantity_of

__all__ = ["Rows", "measure"]

#: Guards of a model of pulses: how badly a signal fits the shape of a pulse. They indicate novelty, not the material.
DEFAULT_GUARDS = ("unexplained",)
#: Features of a model of pulses: the fitted pulse, and the uncertainty of its shape.
FEW_FEATURES = ("fitted_peak", "fitted_width", "shrunken_restitution", "shrunken_restitution_deviation")
#: These, and features that distinguish laws of loss: the uncertainty of the peak, and the shape of the residual.
DEFAULT_FEATURES = (*FEW_FEATURES, "fitted_peak_deviation", *(f"pulse_shape_{n}" for n in (1, 2, 3, 4)))
#: Features of a model of vibrations, if sampling rate and frame allow: levels by frequency, over the complete frame and
#: while the force acts. They depend on the gain, because the strength of the impact is the most informative.
DEFAULT_VIBRATION_FEATURES = (
    *(f"level_{middle}_hz" for middle in THIRD_OCTAVES),
    *(f"early_level_{low}_{high}_hz" for low, high in EARLY_BANDS),
)
#: Features of a model with a beam, and its guards.
BEAM_FEATURES = BEAM_PULSE
BEAM_GUARDS = ("beam_unexplained", "beam_surely_unexplained")
#: Synthetic rows of a label per recorded one; more would outweigh the measurements.
MAX_SYNTHETIC = 10
#: Share of signals that a training leaves out without a word.
MAX_LEFT_OUT = 0.1


@dataclass(frozen=True, kw_only=True)
class Slicing:
    """Settings of rows from recordings: by window or by impact, with times [s]; None to choose from the recordings."""

    by: Literal["window", "impact"] | None = None
    window_time: float = WINDOW_TIME
    hop_time: float = WINDOW_TIME / 2
    dead_time: float | None = None

    def __post_init__(self) -> None:
        if self.by is not None:
            validation.choice("by", self.by, ("window", "impact"))
        require_times(self.window_time, self.hop_time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """Labelled rows of features.

    Attributes
    ----------
    names : tuple of str
        Features, measured on each of `n_channels` channels.
    features : ndarray, (n_rows, n_channels * n_names)
        Values, channel by channel.
    labels : ndarray of str, (n_rows,)
    group : ndarray of int, (n_rows,)
        Unit that splits keep together: the specimen of a synthetic impact, or a number in `groups`; below 0 for
        synthetic rows among recorded ones, which are never in a test.
    source : ndarray of int, (n_rows,)
        Number in `sources` of the scene, dataset or annotated interval of each row.
    sources, groups : tuple of str
        Names that `source` and `group` count.
    digests : tuple of str
        SHA-256 of scenes, datasets or files.
    unit : str
        Unit of the signals.
    sampling_rates : tuple of two floats [Hz]
        Lowest and highest.
    n_channels : int
        Channels of a row.
    slicing : Slicing or None
        How recordings are cut into windows; None for rows of scenes and datasets.
    time : ndarray, (n_rows,) [s]
        Start of a window, or time of an impact, in its recording.
    file : ndarray of int, (n_rows,)
        Number in `digests` of the recording of each row. Empty for scenes and datasets.
    files : tuple of (str, str)
        Path and chosen channels of each number in `file`.
    channel : ndarray of str, (n_rows,)
        Name of the channel of each impact, "" for a window. Empty for scenes and datasets.
    same_beam : tuple of str
        Channels of a beam whose impacts are one row, such as "1+2".
    chosen : ndarray of str, (n_rows,)
        How each row came to be labelled, "random" if it was drawn at random; empty if no table says so.
    snr : ndarray, (n_rows,) [dB]
        Power of a window over that of the noise added to a copy of it; infinite for a row as recorded. Empty without
        copies.
    background : ndarray, (n_rows, n_ways, n_columns)
        Features of each row with other backgrounds (`cgid.identification.training.control`); nan where there is no
        silence. Empty without a control.
    donor : ndarray of int, (n_rows,)
        Group whose silence gave each row the background of another label; below 0 for none.
    floor : ndarray, (n_names,)
        Value from which each feature counts; empty if all do.
    levels_of_sources : tuple of dict
        Levels of rocks and silence of each label in each recording [dB].
    again : callable or None
        Measures the recordings without tones of machines, and with a floor.
    beam : Beam or None
        The beam of the features.
    left_out : int
        Number of rows that could not be measured.
    failures : tuple of CgidError
        Errors of unreadable recordings.
    warnings : tuple of str
        Damage of the other recordings, and intervals without a row; one line each.
    notes : tuple of str
        What was decided for the user, and why; one line each.
    """

    names: tuple[str, ...]
    features: Floats
    labels: NDArray[np.str_]
    group: NDArray[np.integer]
    source: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    sources: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    digests: tuple[str, ...] = ()
    unit: str = ""
    sampling_rates: tuple[float, float] = (0.0, 0.0)
    n_channels: int = 1
    slicing: Slicing | None = None
    time: Floats = field(default_factory=lambda: np.empty(0))
    file: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    files: tuple[tuple[str, str], ...] = ()
    channel: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, np.str_))
    same_beam: tuple[str, ...] = ()
    chosen: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, np.str_))
    snr: Floats = field(default_factory=lambda: np.empty(0))
    background: Floats = field(default_factory=lambda: np.empty(0))
    donor: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    floor: Floats = field(default_factory=lambda: np.empty(0))
    levels_of_sources: tuple[Mapping[str, Any], ...] = ()
    again: Callable[[], Rows] | None = None
    beam: Beam | None = None
    left_out: int = 0
    failures: tuple[CgidError, ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def kind(self) -> Kind:
        """Kind of signal that the features describe."""
        return kind_of(self.names)

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Return the rows of some parts with the same features, unit and beam, one after the other.

        They have times if all parts have.
        """
        sources = tuple(dict.fromkeys(source for part in parts for source in part.sources))
        order = {source: number for number, source in enumerate(sources)}
        source_numbers = [np.array([order[source] for source in part.sources], np.intp)[part.source] for part in parts]
        rates = [rate for part in parts for rate in part.sampling_rates]
        timed = all(len(part.time) == len(part.labels) for part in parts)
        return replace(
            parts[0],
            features=np.concatenate([part.features for part in parts]),
            labels=np.concatenate([part.labels for part in parts]),
            group=np.concatenate([part.group for part in parts]),
            source=np.concatenate(source_numbers),
            sources=sources,
            digests=sources,
            sampling_rates=(min(rates), max(rates)),
            time=np.concatenate([part.time for part in parts]) if timed else np.empty(0),
            left_out=sum(part.left_out for part in parts),
        )

    def __getitem__(self, selected: NDArray[np.bool_]) -> Rows:
        """Return the rows of a mask."""
        names = [*("features", "labels", "group", "source", "time", "file", "channel", "chosen", "snr")]
        names += ["background", "donor"]
        columns = {name: getattr(self, name) for name in names}
        return replace(self, **{name: column[selected] for name, column in columns.items() if len(column)})

    @property
    def rock(self) -> NDArray[np.intp]:
        """The number of the rock of each row: the rows of a recording at one time, one for each channel."""
        if not len(self.file):
            return np.arange(len(self.labels))
        order = np.lexsort((self.time, self.file))
        begins = (np.diff(self.file[order]) != 0) | (np.diff(self.time[order]) > SAME_IMPACT)
        rocks = np.empty(len(order), np.intp)
        rocks[order] = np.append(0, np.cumsum(begins))
        return rocks

    @property
    def is_recorded(self) -> NDArray[np.bool_]:
        """Mask of the recorded rows, without synthetic ones and noisy copies; only these are in tests."""
        return np.asarray((self.group >= 0) & (self.snr == np.inf) if len(self.snr) else self.group >= 0)

    @property
    def is_clear(self) -> NDArray[np.bool_]:
        """Mask of the rows that train the labels: all but very noisy copies."""
        return np.asarray(self.snr >= CLEAR) if len(self.snr) else np.ones(len(self.labels), bool)

    def only(self, names: Sequence[str], selected: NDArray[np.bool_] | None = None) -> Rows:
        """Return the rows, or those of a mask, with some of the features."""
        if selected is None:
            background = self.background[:, :, self.places(names)] if len(self.background) else self.background
            return replace(self, names=tuple(names), features=self.columns(names), background=background)
        columns = np.array(self.places(names))
        # The other columns are not copied.
        rows = replace(self, features=self.features[:0], background=np.empty(0))[selected]
        return replace(rows, names=tuple(names), features=self.features[np.ix_(np.flatnonzero(selected), columns)])

    def columns(self, names: Sequence[str]) -> Floats:
        """Return the columns of some features, channel by channel."""
        return self.features[:, self.places(names)]

    def places(self, names: Sequence[str]) -> list[int]:
        """Return the numbers of the columns of some features, channel by channel."""
        return columns_of(self.names, names, self.features.shape[1])


# -- choice of features -----------------------------------------------------------------------------------

Sets = Mapping[str, tuple[str, ...]]


@cache
def _sets(kind: Kind) -> Sets:
    """Return the feature sets of a kind by name, in order of preference; the gain cancels in "level-free" sets."""
    if kind == "pulse":
        return {"fitted pulse": DEFAULT_FEATURES}
    if kind == "vibration":
        relative = tuple(f"relative_level_{middle}_hz" for middle in THIRD_OCTAVES)
        return {"third octaves": DEFAULT_VIBRATION_FEATURES, "third octaves, level-free": relative}
    window_features = choose(None, "window")

    def starting(*starts: str) -> set[str]:
        return {name for name in window_features if name.startswith(tuple(f"window_{start}_" for start in starts))}

    plain = set(window_features) - starting("mel", "relative", "even", "level")
    shape = plain - {"window_level", "window_peak"}  # free of the gain
    sets = {
        "mel bands, level-free": starting("relative_mel", "mel_deviation"),
        "mel bands and shape, level-free": starting("relative_mel", "mel_deviation") | shape,
        "mel bands and shape": starting("mel") | plain,
        "even bands and shape, level-free": starting("relative_even", "even_deviation") | shape,
        "even bands and shape": starting("even") | plain,
        "third octaves and shape, level-free": starting("relative_level") | shape,
        "third octaves and shape": starting("level") | plain,
    }
    return {name: tuple(feature for feature in window_features if feature in some) for name, some in sets.items()}


def sets_for(kind: Kind, sampling_rate: float) -> Sets:
    """Return the feature sets that a training on recordings chooses from."""
    sets = _sets(kind)
    if kind == "window":
        # At low rates [Hz], mel and even bands are too wide.
        is_low = sampling_rate <= 2 * MIN_BANDWIDTH
        sets = {name: names for name, names in sets.items() if name.startswith("third octaves") == is_low}
    return sets


def union_of(sets: Sets) -> tuple[str, ...]:
    """Return every feature of some sets once."""
    return tuple(dict.fromkeys(name for names in sets.values() for name in names))


def features_for(
    batches: Iterable[Batch], features: Iterable[Named] | None, beam: Beam | None = None
) -> tuple[Iterator[Batch], tuple[str, ...]]:
    """Return the batches unchanged, and the features to measure on them, by default those for their quantity."""
    names = None if features is None else choose(features)
    batches = iter(batches)
    first = next(batches, None)
    if not isinstance(first, Batch | None):
        raise InvalidValue(
            f"data must be batches of signals, as of cgid.synthesise, got {type(first).__name__} among them"
        )
    batches = chain(iter([] if first is None else [first]), batches)  # an exhausted iterator keeps no batch
    if names is not None or beam is not None:
        return batches, names or BEAM_FEATURES
    if first is None or kind_for(quantity_of(first.unit)) == "pulse":
        return batches, DEFAULT_FEATURES
    names = supported(DEFAULT_VIBRATION_FEATURES, first.sampling_rate, first.signals.shape[1])
    if not names:
        raise BadData(
            f"vibrations must be sampled fast and long enough for a third-octave band, frames of "
            f"{first.signals.shape[1]} samples at {first.sampling_rate:g} Hz contain none; record longer"
        )
    return batches, names


def default_guards(features: Iterable[str]) -> tuple[str, ...]:
    """Return the guards of a model with these features; models of vibrations have them only through a beam."""
    features = tuple(features)
    if any_through_beam(features):
        return BEAM_GUARDS
    return DEFAULT_GUARDS if kind_of(features) == "pulse" else ()


def linear_columns(features: Sequence[str]) -> tuple[int, ...]:
    """Return the columns that never get a logarithm: they already are logarithms, or may have either sign."""
    return tuple(column for column, name in enumerate(features) if FEATURES[name].linear)


# -- rows of scenes and datasets --------------------------------------------------------------------------


def measure(
    batches: Iterable[Batch],
    features: Iterable[Named] | None = None,
    progress: Callable[[int], object] | None = None,
    *,
    beam: Beam | None = None,
    workers: Workers = SERIAL,
) -> Rows:
    """Return the rows of labelled batches; memory holds one batch of signals, or a few for each worker.

    Parameters
    ----------
    batches : iterable of Batch
        Such as `synthesise(...)` or `Dataset(...).batches()`.
    features : iterable of str, optional
        Names of features; by default those of the default model.
    progress : callable, optional
        Called with the number of signals of each batch.
    beam : Beam, optional
        The beam that vibrates, for features that need it.
    workers : Workers
        Processes that measure.

    Returns
    -------
    Rows

    Raises
    ------
    BadData
        There is no signal, none has all features, or batches differ in their unit.
    InvalidValue
        A feature does not exist.
    """
    batches, names = features_for(batches, features, beam)
    parts: list[Rows] = []
    problem = ""
    with closing(workers.each(_measured, (names, beam), batches)) as parts_measured:
        for part, first_problem in parts_measured:
            if parts and part.unit != parts[0].unit:
                raise BadData(
                    f"all signals must be in one unit, got {parts[0].unit} and {part.unit}; convert them (in_si) or "
                    "train separately"
                )
            parts.append(part)
            problem = problem or first_problem
            if progress is not None:
                progress(len(part.labels) + part.left_out)
    if not parts:
        raise BadData("there must be signals for training, there are none")
    rows = Rows.joined(parts)
    n = len(rows.labels) + rows.left_out
    if rows.left_out > MAX_LEFT_OUT * n:
        text = f"all features of a signal must be finite for training, those of {rows.left_out} of {n} signals are not"
        text += f": {problem}" if problem else ""
        if rows.left_out == n:
            raise BadData(text)
        warnings.warn(f"{text}; such signals are left out", stacklevel=2)
    return rows


def _measured(settings: tuple[tuple[str, ...], Beam | None], batch: Batch) -> tuple[Rows, str]:
    """Return the complete rows of a batch, and what the first other signal lacks."""
    names, beam = settings
    if not batch.labelled:
        raise BadData("all signals must have labels for training, got a batch without; give Batch(labels=...)")
    with threadpool_limits(1):
        inversion = None if beam is None else through(beam)
        before, rate = batch.pre_trigger or None, batch.sampling_rate
        frames = frames_of(as_rows(batch.signals, 1 if inversion is None else inversion.n_sensors, names), before)
        require_measurable(names, rate, frames.shape[1], inversion)
        features, problems = measured(frames, rate, names, pre_trigger=before, beam=inversion)
    complete = np.asarray(np.isfinite(features).all(axis=1))
    rows = Rows(
        names=names,
        features=features,
        labels=batch.labels,
        group=batch.specimen,
        source=np.zeros(len(batch), np.intp),
        sources=(batch.source,),
        unit=batch.unit,
        sampling_rates=(batch.sampling_rate, batch.sampling_rate),
        beam=beam if any_through_beam(names) else None,
        left_out=int((~complete).sum()),
    )
    return rows[complete], problems[min(problems)].text if problems else ""


@lru_cache(maxsize=4)
def through(beam: Beam) -> ThroughBeam:
    """Return the tables of a beam, made once in each process."""
    return ThroughBeam(beam)


# -- synthetic rows among recorded ones -------------------------------------------------------------------
#
# A scene models the bodies, but not the gain and response of the recording sensor on its support. So the mean of each
# level, over the labels in common, is shifted to that of the recordings. Only training rows determine the shifts.


def is_level(feature: str) -> bool:
    """Return whether a feature is a level, to which a gain or a response adds a constant.

    >>> is_level("level_1000_hz"), is_level("relative_level_1000_hz"), is_level("decay_time")
    (True, True, False)
    """
    return FEATURES[feature].unit.startswith("log10") or "relative_" in feature


def in_unit(batches: Iterable[Batch], unit: str, features: Iterable[str]) -> Iterator[Batch]:
    """Yield synthetic batches in the unit of the recordings; the quantity may differ if only levels are measured."""
    for batch in batches:
        factor = 1.0
        if quantity_of(batch.unit) == quantity_of(unit):
            units = UNITS[quantity_of(unit)]
            factor = units[batch.unit] / units[unit]
        else:
            fixed = [name for name in features if "U" in FEATURES[name].unit and not is_level(name)]
            if fixed:
                raise InvalidValue(
                    f"feature {', '.join(fixed)} must be left out, it cannot be converted from "
                    f"{quantity_of(batch.unit)} [{batch.unit}] of the scene to {quantity_of(unit)} [{unit}] of the "
                    f"recordings; name others by {spelled('features')}, or state the recordings' unit "
                    f"by {spelled('unit')}"
                )
        yield replace(batch, signals=batch.signals * factor, unit=unit)


def mixed(recorded: Rows, synthetic: Rows, seed: int) -> Rows:
    """Join recorded and synthetic rows, these in group -1; raises `BadData` if a synthetic label was not recorded."""
    labels = np.unique(recorded.labels)
    unknown = np.setdiff1d(synthetic.labels, labels)
    if unknown.size:
        raise BadData(
            f"label {unknown[0]} of the scene must be one of the recordings' ({', '.join(labels)}), it is not; name "
            "them alike in the manifest, or record it"
        )
    selected = thinned(synthetic.labels, recorded.labels, seed)
    n, shape = int(selected.sum()), recorded.background.shape[1:]
    return Rows(
        names=recorded.names,
        features=np.concatenate([recorded.features, synthetic.features[selected]]),
        labels=np.concatenate([recorded.labels, synthetic.labels[selected]]),
        group=np.concatenate([recorded.group, np.full(n, -1)]),
        background=np.concatenate([recorded.background, np.full((n * bool(shape), *shape), np.nan)]),
        levels_of_sources=recorded.levels_of_sources,
        n_channels=recorded.n_channels,
    )


def adapted(rows: Rows) -> Rows:
    """Return the rows with the levels of synthetic rows shifted to those of the recorded ones."""
    synthetic = rows.group < 0
    if not synthetic.any():
        return rows
    features = rows.features.copy()
    features[synthetic] += shift(rows.names, features, rows.labels, synthetic)
    return replace(rows, features=features)


def shift(names: tuple[str, ...], features: Floats, labels: NDArray[np.str_], synthetic: NDArray[np.bool_]) -> Floats:
    """Return the shift that `adapted` adds to synthetic rows, (n_features,); 0 for features that are not levels."""
    both = np.intersect1d(labels[synthetic], labels[~synthetic])
    if not both.size:
        raise BadData(
            f"scenes and recordings must have a label in common, got {', '.join(np.unique(labels[synthetic]))} and "
            f"{', '.join(np.unique(labels[~synthetic]))}; name them alike in the manifest"
        )
    # By label, so that another mixture of materials does not look like another response.
    differences = [
        features[~synthetic & (labels == label)].mean(axis=0) - features[synthetic & (labels == label)].mean(axis=0)
        for label in both
    ]
    return np.where([is_level(name) for name in names], np.mean(differences, axis=0), 0.0)


def thinned(labels: NDArray[np.str_], recorded: NDArray[np.str_], seed: int) -> NDArray[np.bool_]:
    """Return a mask of the synthetic rows to keep: at most `MAX_SYNTHETIC` per recorded row of the same label."""
    order = np.random.default_rng(seed).permutation(len(labels))
    selected = np.zeros(len(labels), bool)
    for label in np.unique(recorded):
        of_label = order[labels[order] == label]
        selected[of_label[: MAX_SYNTHETIC * int(np.sum(recorded == label))]] = True
    return selected
