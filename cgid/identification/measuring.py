"""From labelled batches to a table of features, one batch of signals in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.errors import BadData
from cgid.identification.known import KNOWN, drop_heights
from cgid.measure.features import choose, extract_array, kind_for, kind_of, supported
from cgid.measure.features.vibration import EARLY_BANDS, THIRD_OCTAVES
from cgid.signals import Batch
from cgid.units import quantity_of
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
