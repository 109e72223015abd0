"""From labelled batches to a table of features, one batch of signals in memory at a time.

The sets of features that are chosen among when a model is trained on recordings, by kind.

Synthetic impacts beside recorded ones: their level and spectrum moved to where those of the recordings are.

A scene knows the bodies and what tells them apart; it does not know the gain and the response of somebody's sensor on
somebody's support. So the mean of each level, over the labels that both have, is moved onto that of the recordings: one
number for each band, found on what trains and never on what judges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.identification.known import KNOWN, drop_heights
from cgid.measure.features import FEATURES, choose, extract_array, kind_for, kind_of, supported
from cgid.measure.features.feature import Kind
from cgid.measure.features.vibration import EARLY_BANDS, THIRD_OCTAVES
from cgid.signals import UNITS, Batch, quantity_of
from cgid.validation import Floats
from cgid.workers import ALONE, Workers

#: How ill a pulse fits what a pulse should be: of use to know strangers by, and never to tell labels apart.
#: These guard a model of pulses by default.
DEFAULT_GUARDS = ("misfit", "overload")
#: What a model of pulses looks at by default: the fitted pulse, with how well its shape is told.
DEFAULT_FEATURES = ("fitted_peak", "fitted_width", "shrunken_restitution", "shrunken_restitution_deviation")
#: What a model of vibrations looks at by default, as far as rate and frames allow: how strong it is at which
#: frequencies, all in all and while the force still acts. Gains cannot cancel: how hard a blow was says most.
DEFAULT_VIBRATION_FEATURES = (
    *(f"level_{middle}_hz" for middle in THIRD_OCTAVES),
    *(f"early_level_{low}_{high}_hz" for low, high in EARLY_BANDS),
)


@dataclass(frozen=True)
class Measured:
    """The features of all labelled impacts.

    Attributes
    ----------
    names, known_names : tuple of str
        Of the columns of the features and of what is known.
    features : ndarray, (n_impacts, n_features)
    known : ndarray, (n_impacts, n_known)
        What was asked of it beside the signals.
    labels : ndarray of str, (n_impacts,)
    specimen : ndarray of uint64, (n_impacts,)
    unit : str
    sampling_rates : tuple of float
    sources : tuple of str
    source : ndarray of int, (n_impacts,)
        Which of the sources each is from.
    left_out : int
        Impacts that could not be measured.
    """

    names: tuple[str, ...]
    known_names: tuple[str, ...]
    features: Floats
    known: Floats
    labels: NDArray[np.str_]
    specimen: NDArray[np.uint64]
    unit: str
    sampling_rates: tuple[float, float]
    sources: tuple[str, ...]
    source: NDArray[np.intp]
    left_out: int


def chosen_for(batches: Iterable[Batch], features: Iterable[str] | None) -> tuple[Iterator[Batch], tuple[str, ...]]:
    """Return the batches as they are, and what to measure on them.

    Where nothing is asked, their quantity says it, and what the first of them allows: a band above half of its
    sampling rate is left out, and one that its frames are too short for.
    """
    batches = iter(batches)
    if features is not None:
        return batches, choose(features)
    first = next(batches, None)
    if first is None or kind_for(quantity_of(first.unit)) == "pulse":
        return chain([first] if first is not None else [], batches), DEFAULT_FEATURES
    names = supported(DEFAULT_VIBRATION_FEATURES, first.sampling_rate, first.signals.shape[1])
    if not names:
        raise BadData(
            f"vibrations must be sampled fast and long enough for a third-octave band, frames of "
            f"{first.signals.shape[1]} samples at {first.sampling_rate:g} Hz hold none; record longer"
        )
    return chain([first], batches), names


def linear_columns(features: Sequence[str]) -> tuple[int, ...]:
    """Return the columns that never get a logarithm: they are logarithms already, or may be of either sign."""
    return tuple(column for column, name in enumerate(features) if FEATURES[name].linear)


def default_guards(features: Iterable[str]) -> tuple[str, ...]:
    """Return the guards of a model that looks at these features: what says how ill a pulse fits knows no vibration."""
    return DEFAULT_GUARDS if kind_of(features) == "pulse" else ()


def measure(
    batches: Iterable[Batch],
    features: Iterable[str] | None = None,
    progress: Callable[[int], object] | None = None,
    *,
    known: tuple[str, ...] = (),
    crew: Workers = ALONE,
) -> Measured:
    """Return the features of labelled batches; memory holds a batch of signals at a time, or a few for each of a crew.

    Raises
    ------
    BadData
        There is no signal, batches are of different quantities, or they do not say what has to be known.
    InvalidValue
        A feature or something known is unknown.
    """
    batches, names = chosen_for(batches, features)
    for name in known:
        validation.choice("known", name, dict(KNOWN))
    rows, beside, labels, specimen, rates, sources, source = [], [], [], [], set(), [], []
    unit = ""
    with closing(crew.each(_measured, (names, known), batches)) as measured:
        for part in measured:
            if unit and part.about.unit != unit:
                raise BadData(
                    f"all signals must be in one unit, got {unit} and {part.about.unit}; convert or train apart"
                )
            unit = part.about.unit
            rows.append(part.features)
            beside.append(part.known)
            labels.append(part.about.labels)
            sources += [part.about.source] if part.about.source not in sources else []
            source.append(np.full(len(part.about), sources.index(part.about.source)))
            specimen.append(part.about.specimen)
            rates.add(part.about.sampling_rate)
            if progress is not None:
                progress(len(part.about))
    if not rows:
        raise BadData("there must be signals to train on; there are none")
    table = np.concatenate(rows)
    sound = np.isfinite(table).all(axis=1)
    return Measured(
        names=names,
        known_names=known,
        features=table[sound],
        known=np.concatenate(beside)[sound],
        labels=np.concatenate(labels)[sound],
        specimen=np.concatenate(specimen)[sound],
        unit=unit,
        sampling_rates=(min(rates), max(rates)),
        sources=tuple(sources),
        source=np.concatenate(source)[sound],
        left_out=int((~sound).sum()),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """What is measured on one batch."""

    about: Batch
    features: Floats
    known: Floats


def _measured(asked: tuple[tuple[str, ...], tuple[str, ...]], batch: Batch) -> _Part:
    names, known = asked
    with threadpool_limits(1):
        features = extract_array(
            batch.signals, batch.sampling_rate, names, pre_trigger=batch.pre_trigger or None, invalid="nan"
        )
    return _Part(
        about=replace(batch, signals=np.empty((len(batch), 0)), parameters={}),
        features=features,
        known=_known_of(batch) if known else np.empty((len(batch), 0)),
    )


def _known_of(batch: Batch) -> Floats:
    heights = drop_heights(batch)
    if heights is None:
        raise BadData(
            "the data must hold drop_height or velocity among its parameters, it has "
            f"{', '.join(batch.parameters) or 'none'}; train without --drop-height"
        )
    return heights[:, None]


Sets = Mapping[str, tuple[str, ...]]
#: Features of windows that change with the gain of the sensor, beside the bands.
_WITH_GAIN = ("window_level", "window_peak")


def _windows(*wanted: Callable[[str], bool]) -> tuple[str, ...]:
    own = (name for name, feature in FEATURES.items() if feature.kind == "window" and not feature.extra)
    return tuple(name for name in own if any(want(name) for want in wanted))


def _starting(*starts: str) -> Callable[[str], bool]:
    return lambda name: name.startswith(tuple(f"window_{start}_" for start in starts))


def _shape(name: str) -> bool:
    """Return whether a feature of windows is no band of a bank and does not change with the gain."""
    return not _starting("mel", "relative", "even", "level")(name) and name not in _WITH_GAIN


def _plain(name: str) -> bool:
    return _shape(name) or name in _WITH_GAIN


#: Kind -> name of a set -> its features, the first first where none is clearly better. A name that ends in
#: "level-free" promises that the gain of the sensor cancels.
FEATURE_SETS: Mapping[Kind, Sets] = {
    "window": {
        # First, for no gain was ever the same for long.
        "even bands and shape, level-free": _windows(_starting("relative_even", "even_deviation"), _shape),
        "even bands and shape": _windows(_starting("even"), _plain),
        "mel bands and shape": _windows(_starting("mel"), _plain),
        "mel bands": _windows(_starting("mel")),
        "mel bands and shape, level-free": _windows(_starting("relative_mel", "mel_deviation"), _shape),
    },
    "vibration": {
        "third octaves": DEFAULT_VIBRATION_FEATURES,
        "third octaves, level-free": tuple(name for name in FEATURES if name.startswith("relative_level_")),
    },
    "pulse": {"fitted pulse": DEFAULT_FEATURES},
}


def union_of(sets: Sets) -> tuple[str, ...]:
    """Return every feature of some sets once."""
    return tuple(dict.fromkeys(name for names in sets.values() for name in names))


def sets_for(kind: Kind, *, level_free: bool = False) -> Sets:
    """Return the sets of a kind; only those in which the gain cancels, if asked."""
    own = FEATURE_SETS[kind]
    return {name: names for name, names in own.items() if name.endswith("level-free")} if level_free else own


#: More synthetic impacts of a label, over those recorded, would drown what was measured.
MOST_SYNTHETIC = 10


def is_level(feature: str) -> bool:
    """Return whether a feature is a level, on which a gain or a response adds a number.

    Examples
    --------
    >>> is_level("level_1000_hz"), is_level("relative_level_1000_hz"), is_level("decay_time")
    (True, True, False)
    """
    return FEATURES[feature].unit.startswith("log10") or "relative_" in feature


def in_unit(batches: Iterable[Batch], unit: str, features: Iterable[str]) -> Iterator[Batch]:
    """Yield synthetic batches in the unit of the recordings.

    Another quantity is taken as it is where nothing but levels is measured: how large the numbers are is then adapted.

    Raises
    ------
    InvalidValue
        The quantity is another, and a feature keeps the unit of the signal.
    """
    for batch in batches:
        factor = 1.0
        if quantity_of(batch.unit) == quantity_of(unit):
            units = UNITS[quantity_of(unit)]
            factor = units[batch.unit] / units[unit]
        else:
            fixed = [name for name in features if "U" in FEATURES[name].unit and not is_level(name)]
            if fixed:
                raise InvalidValue(
                    f"feature {', '.join(fixed)} must be left out, it cannot be moved from {quantity_of(batch.unit)} "
                    f"[{batch.unit}] of the scene to {quantity_of(unit)} [{unit}] of the recordings; name others by "
                    "--features, or say the recordings' unit by --unit"
                )
        yield replace(batch, signals=batch.signals * factor, unit=unit)


def shift(names: tuple[str, ...], features: Floats, labels: NDArray[np.str_], synthetic: NDArray[np.bool_]) -> Floats:
    """Return what has to be added to the synthetic rows, (n_features,): 0 for what is no level.

    Parameters
    ----------
    names : tuple of str
    features : ndarray, (n_rows, n_features)
    labels : ndarray of str, (n_rows,)
    synthetic : ndarray of bool, (n_rows,)
        The other rows were recorded.

    Raises
    ------
    BadData
        They have no label in common.
    """
    both = np.intersect1d(labels[synthetic], labels[~synthetic])
    if not both.size:
        raise BadData(
            f"scenes and recordings must have a label in common, got {', '.join(np.unique(labels[synthetic]))} and "
            f"{', '.join(np.unique(labels[~synthetic]))}; name them alike in the manifest"
        )
    # Label by label: another mix of materials is no other response.
    differences = [
        features[~synthetic & (labels == label)].mean(axis=0) - features[synthetic & (labels == label)].mean(axis=0)
        for label in both
    ]
    return np.where([is_level(name) for name in names], np.mean(differences, axis=0), 0.0)


def thinned(labels: NDArray[np.str_], recorded: NDArray[np.str_], seed: int) -> NDArray[np.bool_]:
    """Return which synthetic rows are kept: of each label at most `MOST_SYNTHETIC` times as many as were recorded."""
    order = np.random.default_rng(seed).permutation(len(labels))
    kept = np.zeros(len(labels), bool)
    for label in np.unique(recorded):
        own = order[labels[order] == label]
        kept[own[: MOST_SYNTHETIC * int(np.sum(recorded == label))]] = True
    return kept
