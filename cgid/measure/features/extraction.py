"""Features of impacts and windows: names, requirements and values.

`FEATURES` is the table of all features by name; `cgid.measure.features.table` explains how to add one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats, require_rate
from cgid.errors import BadData, InvalidValue
from cgid.measure.features.own import OWN, outside_features, own_feature
from cgid.measure.features.pulses import FAINT, PULSE_FEATURES, PulseBatch
from cgid.measure.features.table import Feature, FeatureTable, ImpactKind, Kind
from cgid.measure.features.vibration import VIBRATION_FEATURES, BeamInversion, VibrationBatch
from cgid.measure.features.windows import WINDOW_FEATURES, WindowBatch
from cgid.measure.frames import DETECTION_LIMIT, Problem, ProblemKind, frames_of
from cgid.signals import Batch, Signal, require_stated
from cgid.units import KNOWN_UNITS, meaning_of

if TYPE_CHECKING:
    import pandas

    from cgid.store.reading import Dataset

__all__ = ["FEATURES", "choose", "extract"]

#: Maximum number of samples and rows measured at once: enough to share the overhead of the fit, few enough to bound the
#: memory.
BLOCK_SAMPLES, _ROWS = 1 << 21, 1024
#: Maximum number of samples of windows measured at once: their overlapping frames fit in the processor's cache.
_WINDOWED_SAMPLES = 1 << 17
#: Extent of windows after onset, in contact durations and in samples: for quantities read off the samples (the
#: level after contact, behind the run above 10 %), and for the fit (its bins and windows).
_READ, _FITTED = (3.25, 9), (3.25, 54)
#: The detection limit of features inverted through a beam is lower by this many standard deviations of the noise before
#: the vibration: the modes detect an impact that the samples alone do not show, such as one during the ring-down of
#: another.
BEAM_LEAD = 2.0
#: An entry of a list of features: a name, or a feature of one's own.
Named = str | Feature | Callable[[Floats, float], Any]
#: Signals by kind.
Batches = Mapping[Kind, PulseBatch | VibrationBatch | WindowBatch]

#: All features by name, in column order.
FEATURES = FeatureTable((*PULSE_FEATURES, *VIBRATION_FEATURES, *WINDOW_FEATURES), outside_features)
#: Quantities that swing about zero when a structure is struck (`level`: of a sound file); all others are pulses.
SWINGING = ("acceleration", "velocity", "displacement", "pressure", "level")


# -- names --------------------------------------------------------------------------------------------


def kind_for(quantity: str | None) -> ImpactKind:
    """Return the default kind of impact in a signal of this quantity."""
    return "vibration" if quantity in SWINGING else "pulse"


def kind_of(features: Iterable[str]) -> Kind:
    """Return the kind of signal that these features are measured on."""
    kinds = {FEATURES[name].kind for name in features}
    kind: Kind
    for kind in ("window", "vibration"):
        if kind in kinds:
            return kind
    return "pulse"


def any_through_beam(features: Iterable[str]) -> bool:
    """Return whether any of the features needs a beam."""
    return any(FEATURES[name].beam for name in features)


def choose(features: Iterable[Named] | None, kind: Kind = "pulse") -> tuple[str, ...]:
    """Return the names of features in order, with the columns of banks.

    Parameters
    ----------
    features : iterable of str, function or Feature, or None
        Names of features or banks: `mel_*_hz` stands for all of its columns. A function, or what `own_feature` returns,
        is a feature of one's own, which is known by its name from then on. None: all of the kind that need neither an
        extra nor a beam.
    kind : {"pulse", "vibration", "window"}

    Returns
    -------
    tuple of str

    Raises
    ------
    InvalidValue
        A name is unknown or repeated, or there is none.

    Examples
    --------
    >>> choose(["level_total", "early_level_*_hz"])[:3]
    ('level_total', 'early_level_0_500_hz', 'early_level_500_1000_hz')
    """
    if features is None:
        return FEATURES.names(kind)
    if not isinstance(features, str):
        validation.instance("features", features, Iterable)  # names, not the samples
    given = (features,) if isinstance(features, str) else tuple(features)
    names = tuple(name for entry in given for name in FEATURES.expand(name_of(entry)))
    for name in names:
        require_known(name)
    if not names or len(set(names)) != len(names):
        raise InvalidValue(f"features must be named once each, and at least one, got {', '.join(names) or 'none'}")
    return names


def name_of(entry: Named) -> str:
    """Return the name of an entry of a list of features; a feature of one's own is known from then on."""
    if isinstance(entry, str):
        return entry
    for cached in (features_of, _lacking):  # an earlier one of its name is replaced
        cached.cache_clear()
    return FEATURES.add(entry if isinstance(entry, Feature) else own_feature(entry))


@lru_cache
def features_of(names: tuple[str, ...]) -> tuple[Feature, ...]:
    """Return the features of these names."""
    return tuple(FEATURES[name] for name in names)


class UnknownFeature(InvalidValue):
    """No feature of cgid, nor one that this process has named."""


def require_known(name: str) -> None:
    """Raise `UnknownFeature` for an unknown feature; the message lists similar names."""
    if not isinstance(name, str) or name not in FEATURES:
        names = [*FEATURES, *(entry.name for entry in FEATURES.entries if "*" in entry.name)]
        likely = validation.similar(str(name), names, n=5, cutoff=0.3)
        raise UnknownFeature(
            f"feature must be one of the {len(FEATURES)} that `cgid features --list` describes, got {name!r}; most "
            f"like it are {', '.join(likely) or 'none'}; a feature of your own? In Python, name its function "
            "first, in cgid.measure.features.choose([...]); for commands, it is an entry point cgid.features"
        )


def base_of(name: str) -> str:
    """Return the name of the feature that an input of a model is, without the channel that it is of."""
    return name.partition(" of channel ")[0]


def powers_of(inputs: Sequence[str], symbol: str) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the power of a unit such as "U" in each input of a model, and which of these are logarithms."""
    names = [base_of(name) for name in inputs]
    units = [FEATURES[name].unit if name in FEATURES else "" for name in names]
    is_decadic = np.array([unit.startswith("log10") for unit in units])
    units = ["U" if unit == "N" else unit for unit in units]  # a force estimated through a beam
    return np.array([2.0 if f"{symbol}^2" in unit else float(symbol in unit) for unit in units]), is_decadic


def supported(features: Iterable[str], sampling_rate: float, n_samples: int) -> tuple[str, ...]:
    """Return the features that a sampling rate [Hz] and frames of `n_samples` samples allow."""
    return tuple(name for name in features if not _lack(FEATURES[name], sampling_rate, n_samples))


def require_supported(names: Iterable[str], sampling_rate: float, n_samples: int) -> None:
    """Raise `InvalidValue` for a feature that needs another sampling rate [Hz] or longer frames."""
    if lack := _lacking(tuple(names), sampling_rate, n_samples):
        raise InvalidValue(lack)


@lru_cache
def _lacking(names: tuple[str, ...], sampling_rate: float, n_samples: int) -> str:
    """Return the first requirement that a signal does not meet; empty if it meets all."""
    lacks = ((name, _lack(FEATURES[name], sampling_rate, n_samples)) for name in names)
    return next((f"feature {name} {lack}, or leave it out" for name, lack in lacks if lack), "")


def _lack(feature: Feature, sampling_rate: float, n_samples: int) -> str:
    """Return the requirement of a feature that the signal does not meet; empty if it meets all."""
    if sampling_rate < 2 * feature.highest_frequency:
        # Rounded up, so that the suggested rate is accepted.
        needed = np.ceil(2 * feature.highest_frequency)
        return f"needs a sampling_rate of {needed:.0f} Hz or more, got {sampling_rate:g} Hz: sample faster"
    if n_samples < feature.shortest_frame * sampling_rate:
        needed = np.ceil(feature.shortest_frame * sampling_rate)
        return (
            f"needs frames of {needed:.0f} samples or more at {sampling_rate:g} Hz to resolve its band, got "
            f"{n_samples}: record longer"
        )
    return ""


# -- values -------------------------------------------------------------------------------------------


def extract(
    samples: ArrayLike | Signal | Batch | Dataset,
    sampling_rate: float | None = None,
    features: Iterable[Named] | None = None,
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    invalid: Literal["raise", "nan"] = "raise",
) -> pandas.DataFrame:
    """Return the features of single impacts, one row per signal.

    Parameters
    ----------
    samples : array_like, (n_samples,) or (n_signals, n_samples), Signal, Batch or Dataset
        One positive pulse per row, or one vibration for the features of vibrations. A signal, batch or dataset states
        its rate, its unit and its samples before onset.
    sampling_rate : float, optional
        [Hz]; required for an array; another one than a signal, batch or dataset states is refused.
    features : iterable of str, function or Feature, optional
        Names of features or banks; by default all features of pulses. A feature of one's own is a function of samples
        (n_signals, n_samples) without their baseline and the sampling rate, or the result of
        `cgid.measure.features.own_feature`.
    pre_trigger : int, optional
        Samples before onset, whose mean and standard deviation are baseline and noise. By default all samples up to
        the foot of the pulse (1 % of the way from the first samples to the largest).
    remove_baseline : bool
        Whether to subtract the baseline before measuring.
    invalid : {"raise", "nan"}
        Treatment of a signal that cannot be measured; a sample that is not finite is always an error.

    Returns
    -------
    pandas.DataFrame, (n_signals, n_features)
        Its `attrs["units"]` has the unit of each column; U is the unknown one of an array.

    Raises
    ------
    BadData
        A signal has no impact, is cut off, has too few samples on the pulse, or is not finite.
    InvalidValue
        A feature is unknown or needs another sampling rate or longer frames, or an argument is out of range.
    MissingOption
        An array has no sampling rate.

    Examples
    --------
    >>> t = np.arange(300) / 1e5
    >>> pulse = 800 * np.sin(np.pi * np.clip((t - 1e-3) / 1e-3, 0, 1)) ** 1.5
    >>> extract(pulse, 1e5, ["peak_force", "contact_duration"]).round(5).values.tolist()
    [[800.0, 0.001]]
    """
    import pandas

    names, unit = choose(features), "U"
    if isinstance(samples, Signal | Batch) or hasattr(samples, "batches"):
        require_stated(samples, sampling_rate)
    if hasattr(samples, "batches"):
        how: dict[str, Any] = {"pre_trigger": pre_trigger, "remove_baseline": remove_baseline, "invalid": invalid}
        parts = [extract(batch, None, names, **how) for batch in samples.batches()]
        return pandas.concat(parts, ignore_index=True)
    if isinstance(samples, Signal | Batch):
        own, samples = samples, samples.signals if isinstance(samples, Batch) else samples.samples
        sampling_rate, unit = own.sampling_rate, own.unit or unit
        pre_trigger = own.pre_trigger if pre_trigger is None else pre_trigger
    sampling_rate = validation.given_rate(samples, sampling_rate)
    values = extract_array(
        samples, sampling_rate, names, pre_trigger=pre_trigger, remove_baseline=remove_baseline, invalid=invalid
    )
    table = pandas.DataFrame(values, columns=list(names))
    table.attrs["units"] = {name: FEATURES[name].unit_for(unit) for name in names}
    return table


def units_of(table: Any) -> dict[str, str]:
    """Return the units of columns that `attrs["units"]` of a DataFrame states; none of anything else."""
    stated = getattr(table, "attrs", {}).get("units")
    columns = stated.items() if isinstance(stated, Mapping) else ()
    return {name: unit for name, unit in columns if isinstance(name, str) and name in table}


def in_units(table: Any, units: Mapping[str, str]) -> Any:
    """Return a table with its columns in these units of the training, as far as it states its own.

    Raises `InvalidValue` unless the unit of the signals differs in its scale alone.
    """
    for name, given in units_of(table).items():
        base, unit = base_of(name), units.get(name, given)
        feature = FEATURES.get(base) or Feature(base, "U", "", "", np.asarray)
        # The unit of an array is unknown, "U".
        if given == unit or ("U" in feature.unit and feature.unit in (given, unit)):
            continue
        meanings = {feature.unit_for(one): meaning_of(one) for one in KNOWN_UNITS}
        # The power of U; other forms, of features of one's own, are not converted.
        form = re.fullmatch(r"(log10\()?U(?:\^([2-9]))?(?:[ /)][^U]*)?", feature.unit)
        if form is None or not {given, unit} <= set(meanings) or meanings[given][0] != meanings[unit][0]:
            raise InvalidValue(
                f"column {name} must be in {unit}, as in the training, attrs['units'] of the table states {given}; "
                "measure it on signals of that unit, or correct attrs"
            )
        ratio = (meanings[given][1] / meanings[unit][1]) ** int(form[2] or 1)
        table = table.assign(**{name: table[name] + np.log10(ratio) if form[1] else table[name] * ratio})
    return table


def extract_array(
    samples: ArrayLike,
    sampling_rate: float,
    features: Iterable[str] | None = None,
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    invalid: Literal["raise", "nan"] = "raise",
    detection_limit: float = DETECTION_LIMIT,
    beam: BeamInversion | None = None,
) -> Floats:
    """Return features as a plain array (n_signals, n_features), without pandas; otherwise as `extract`."""
    # `equalisation` corrects the sensor's response first; it does not apply to pulses. With several sensors on `beam`,
    # samples are (n_signals, n_sensors, n_samples), and only features through the beam exist.
    names = choose(features)
    each = 1 if beam is None else beam.n_sensors
    frames, rate = frames_of(as_rows(samples, each, names), pre_trigger), require_rate(sampling_rate)
    validation.choice("invalid", invalid, ("raise", "nan"))
    detection_limit = validation.number("detection_limit", detection_limit, rule=validation.not_negative)
    require_measurable(names, rate, frames.shape[1], beam)
    values, problems = measured(
        frames,
        rate,
        names,
        pre_trigger=pre_trigger,
        remove_baseline=remove_baseline,
        detection_limit=detection_limit,
        beam=beam,
    )
    if problems and invalid == "raise":
        row, n = min(problems), len(values)
        where = f"signal {row}: " if n > 1 else ""
        more = f" ({len(problems)} of {n} signals cannot be measured)" if len(problems) > 1 else ""
        cure = "; invalid='nan' gives such signals a row of nan" if n > 1 else ""
        raise BadData(f"{where}{problems[row].text}{more}{cure}")
    return values


def require_measurable(
    names: Iterable[str],
    sampling_rate: float,
    n_samples: int,
    beam: BeamInversion | None,
) -> None:
    """Raise `InvalidValue` unless features can be measured at a rate [Hz] on frames and through a beam."""
    names = tuple(names)
    require_supported(names, sampling_rate, n_samples)
    through = next((feature.name for feature in features_of(names) if feature.beam), None)
    if through is not None and beam is None:
        raise InvalidValue(
            f"feature {through} must have a beam to look through, got none: train on a scene with a [tail_beam] (cgid "
            "train tail_beam -o MODEL) and use that model, or leave the feature out"
        )


def measured(
    frames: NDArray[np.floating],
    sampling_rate: float,
    names: tuple[str, ...],
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    detection_limit: float = DETECTION_LIMIT,
    beam: BeamInversion | None = None,
    channel: NDArray[np.intp] | None = None,
) -> tuple[Floats, dict[int, Problem]]:
    """Return the features of checked frames, nan where a signal cannot be measured, and a dict of signal -> problem."""
    # The frames of the sensors of a signal are adjacent; the signal has a problem if none of them can be measured. A
    # `beam` that learns from the channels of a recording gets the `channel` of each signal.
    each = 1 if beam is None else beam.n_sensors
    features = features_of(names)
    values = np.full((len(frames) // each, len(names)), np.nan)
    problems: dict[int, Problem] = {}
    max_samples = _WINDOWED_SAMPLES if any(feature.kind == "window" for feature in features) else BLOCK_SAMPLES
    n_rows = max(min(max_samples // frames.shape[1], _ROWS), 1)
    how = (sampling_rate, features, pre_trigger, remove_baseline, detection_limit, beam)
    for first in range(0, len(values), n_rows):
        part = frames[first * each : (first + n_rows) * each]
        batches = _batches(part, *how)
        faulty = _problems(batches, features)
        if each > 1:
            faulty = _of_all(faulty, each)
        sound = np.delete(np.arange(len(part) // each), np.fromiter(faulty, np.intp))
        if faulty:
            problems |= {first + row: problem for row, problem in faulty.items()}
            batches = _batches(part[(sound[:, None] * each + np.arange(each)).ravel()], *how)
        vibrations = batches.get("vibration")
        if channel is not None and isinstance(vibrations, VibrationBatch):
            vibrations.channel = channel[first + sound]
        values[first + sound] = found = _values(batches, features, sound.size)
        for column, feature in enumerate(features):
            if feature.source == OWN and not np.isfinite(found[:, column]).all():  # one's own code may fail on a row
                for row in np.flatnonzero(~np.isfinite(found[:, column])).tolist():
                    text = f"feature {feature.name} must give a finite number, got {found[row, column]}"
                    problems.setdefault(first + int(sound[row]), Problem(ProblemKind.NOT_FINITE, text))
                    values[first + sound[row]] = np.nan
    return values, problems


def as_rows(samples: ArrayLike, each: int, names: tuple[str, ...]) -> ArrayLike:
    """Return samples as rows, those of the `each` sensors of a signal after each other."""
    if each == 1:
        return samples
    if not all(FEATURES[name].beam for name in names):
        raise InvalidValue(
            f"features must all be inverted through the beam if it has {each} sensors, got "
            f"{next(name for name in names if not FEATURES[name].beam)}; leave it out"
        )
    frames = validation.plain("samples", samples)
    if frames.ndim != 3 or frames.shape[1] != each:
        raise BadData(
            f"samples must be (n_signals, {each}, n_samples), one row for each of the {each} sensors of the beam, got "
            f"shape {frames.shape}; give the channels of one recording, or take a model of one sensor"
        )
    return frames.reshape(-1, frames.shape[2])


def _of_all(problems: dict[int, Problem], each: int) -> dict[int, Problem]:
    """Return the problems of signals all of whose sensors, in `each` successive rows, have one."""
    return {
        row // each: problems[row]
        for row in problems
        if row % each == 0 and problems.keys() >= {*range(row, row + each)}
    }


def _values(batches: Batches, features: Sequence[Feature], n_signals: int) -> Floats:
    """Return the features of measurable signals, (n_signals, n_features)."""
    if not n_signals:
        return np.empty((0, len(features)))
    return np.stack([feature.measure(batches[feature.kind]) for feature in features], axis=1)


def _batches(
    frames: NDArray[np.floating],
    sampling_rate: float,
    features: Sequence[Feature],
    pre_trigger: int | None,
    remove_baseline: bool,
    detection_limit: float,
    beam: BeamInversion | None,
) -> Batches:
    if all(feature.beam for feature in features):
        detection_limit = max(detection_limit - BEAM_LEAD, 0.0)
    how = (frames, sampling_rate, pre_trigger, remove_baseline, detection_limit)
    batches: dict[Kind, PulseBatch | VibrationBatch | WindowBatch] = {}
    for kind in {feature.kind for feature in features}:
        if kind == "window":  # has no onset
            batches[kind] = WindowBatch(frames, sampling_rate, remove_baseline)
        else:
            batches[kind] = PulseBatch(*how).uncoupled() if kind == "pulse" else VibrationBatch(*how)
            if isinstance(batch := batches[kind], VibrationBatch):
                batch.beam = beam
    return batches


def _problems(batches: Batches, features: Sequence[Feature]) -> dict[int, Problem]:
    """Return the problems by row; a fit requires less of a pulse than quantities read off the samples."""
    problems: dict[int, Problem] = {}
    fitted = {feature.fitted for feature in features if feature.kind == "pulse"}
    for batch in batches.values():
        if isinstance(batch, PulseBatch) and True in fitted:
            problems |= batch.fit_problems()
        if not isinstance(batch, PulseBatch) or False in fitted:
            problems |= batch.problems()
    return problems


# -- truncated frames ---------------------------------------------------------------------------------


def allow_truncation(names: Iterable[str]) -> bool:
    """Return whether all of these features are independent of samples far from the pulse."""
    return not any(FEATURES[name].whole_frame for name in names)


def samples_needed(names: Iterable[str], onset: Floats, duration: Floats) -> NDArray[np.intp]:
    """Return the lengths of truncated frames that contain all windows of typical pulses, (n,); arguments in samples."""
    contacts, more = _FITTED if any(FEATURES[name].fitted for name in names) else _READ
    return np.ceil(onset + contacts * duration + more).astype(np.intp)


def extract_truncated(
    samples: NDArray[np.floating],
    sampling_rate: float,
    names: tuple[str, ...],
    pre_trigger: int,
    highest_after: Floats,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the features of pulses in truncated frames, nan where not measurable, and a mask of the certain ones."""
    # Certain: no missing sample (at most `highest_after`, (n_signals,)) can exceed the peak, and no window extends past
    # the end. These equal those of the complete frame to the last bit.
    table, certain = np.full((len(samples), len(names)), np.nan), np.zeros(len(samples), bool)
    pulses = PulseBatch(samples, sampling_rate, pre_trigger).uncoupled()
    features = [FEATURES[name] for name in names]
    sound = np.setdiff1d(np.arange(len(samples)), list(_problems({"pulse": pulses}, features)))
    if sound.size < len(samples):
        pulses = PulseBatch(samples[sound], sampling_rate, pre_trigger).uncoupled()
    table[sound] = _values({"pulse": pulses}, features, sound.size)
    if sound.size:
        certain[sound] = _certain(pulses, names, highest_after[sound])
    return table, certain


def _certain(pulses: PulseBatch, names: tuple[str, ...], highest_after: Floats) -> NDArray[np.bool_]:
    n_samples = pulses.samples.shape[1]
    certain = (pulses.peak + pulses.offset > highest_after) & (
        np.maximum(pulses.window_reach, pulses.after[1]) < n_samples
    )
    if any(FEATURES[name].fitted for name in names):
        # The search for a faint pulse covers the complete frame.
        certain &= (pulses.peak >= FAINT * pulses.noise) & (pulses.fit.reach < n_samples)
    return np.asarray(certain & allow_truncation(names))
