"""The table of features, and their extraction: only what is asked is computed.

Every feature is one entry of `FEATURES`: name, unit, definition, source, and the measurement it needs. Those of
pulses, vibrations and windows are in the modules beside this one; the measurements are in `pulses`, `vibration` and
`windows` of `cgid.measure`, each made at most once. Columns, units and documentation all come from this
table.

Features from the beginnings of frames: where the rest of a frame cannot change them, it need not exist.

A pulse is looked for in its whole frame and then looked at through a window. So the features of a frame that breaks
off early are those of the whole frame, to the last bit, if its largest sample is above all that may follow, and if
no window reaches past its end. Both are checked for each signal; where either fails, the whole frame is needed.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.counting import count
from cgid.errors import BadData, InvalidValue
from cgid.measure.filters import Equalisation
from cgid.measure.frames import DETECTION_LIMIT, frames_of
from cgid.measure.pulses import FAINT, PULSE_FEATURES, PulseBatch
from cgid.measure.table import Feature, ImpactKind, Kind
from cgid.measure.vibration import VIBRATION_FEATURES, VibrationBatch
from cgid.measure.windows import WINDOW_FEATURES, WindowBatch
from cgid.validation import Floats, require_rate

if TYPE_CHECKING:
    import pandas

#: Samples measured at once: enough to share the overhead of the fit, few enough for the memory to stay flat; and rows.
_SAMPLES, _ROWS = 1 << 21, 1024
#: Windows are long, and their frames overlap: so many samples of them at once stay in the processor's cache.
_WINDOWED_SAMPLES = 1 << 17
#: What is measured, by its kind.
Batches = Mapping[Kind, PulseBatch | VibrationBatch | WindowBatch]


#: Every feature by name, in the order of the columns.
FEATURES: dict[str, Feature] = {
    feature.name: feature for feature in PULSE_FEATURES + VIBRATION_FEATURES + WINDOW_FEATURES
}
#: What swings about zero when a structure is struck (a level is that of a sound file); all else is taken for a pulse.
SWINGING = ("acceleration", "velocity", "displacement", "pressure", "level")


def kind_for(quantity: str | None) -> ImpactKind:
    """Return what an impact looks like in a signal of this quantity, where nobody says more of it."""
    return "vibration" if quantity in SWINGING else "pulse"


def kind_of(features: Iterable[str]) -> Kind:
    """Return what a signal is like that these features are asked of."""
    kinds = {FEATURES[name].kind for name in features}
    kind: Kind
    for kind in ("window", "vibration"):
        if kind in kinds:
            return kind
    return "pulse"


def choose(features: Iterable[str] | None, kind: Kind = "pulse") -> tuple[str, ...]:
    """Return the names of the asked features in their order; for None all of the kind that need no extra.

    Raises
    ------
    InvalidValue
        A name is unknown, given twice, or there is none.
    """
    if features is None:
        return tuple(name for name, feature in FEATURES.items() if feature.kind == kind and not feature.extra)
    names = (features,) if isinstance(features, str) else tuple(features)
    for name in names:
        require_known(name)
    if not names or len(set(names)) != len(names):
        raise InvalidValue(f"features must be named once each, and at least one, got {', '.join(names) or 'none'}")
    return names


def require_known(name: str) -> None:
    """Raise `InvalidValue` unless there is such a feature; the message has the names that are most like it."""
    if not isinstance(name, str) or name not in FEATURES:
        like = difflib.get_close_matches(str(name)[:80], FEATURES, n=5, cutoff=0.3)
        raise InvalidValue(
            f"feature must be one of the {len(FEATURES)} that `cgid features --list` prints, got {name!r}; most "
            f"like it are {', '.join(like) or 'none'}"
        )


def extract_array(
    samples: ArrayLike,
    sampling_rate: float,
    features: Iterable[str] | None = None,
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    invalid: Literal["raise", "nan"] = "raise",
    detection_limit: float = DETECTION_LIMIT,
    equalisation: Equalisation | None = None,
) -> Floats:
    """Return features as plain numbers, without pandas; as `extract`.

    Parameters
    ----------
    samples, sampling_rate, features, pre_trigger, remove_baseline, invalid
        As in `extract`.
    detection_limit : float
        A peak must pass this many standard deviations of the noise before touch; an impact that was found in a
        recording by other means may ask for less.
    equalisation : Equalisation, optional
        What makes up for the sensor's response, applied before anything is measured.

    Returns
    -------
    ndarray, (n_signals, n_features)
        In the order of `features`.
    """
    names = choose(features)
    frames, rate = frames_of(samples, pre_trigger), require_rate(sampling_rate)
    validation.choice("invalid", invalid, ("raise", "nan"))
    require_supported(names, rate, frames.shape[1])
    if equalisation is not None and kind_of(names) == "pulse":
        raise InvalidValue("equalisation must be of vibrations or windows, got features of pulses: leave it out")
    out = np.full((len(frames), len(names)), np.nan)
    most = _WINDOWED_SAMPLES if kind_of(names) == "window" else _SAMPLES
    n_rows = max(min(most // frames.shape[1], _ROWS), 1)
    for first in range(0, len(frames), n_rows):
        part = frames[first : first + n_rows]
        if equalisation is not None:
            part = equalisation.apply(part, rate)
        batches = _batches(part, rate, names, pre_trigger, remove_baseline, detection_limit)
        found = _problems(batches, names)
        if found and invalid == "raise":
            _raise_first(found, first, len(part), len(frames))
        sound = np.setdiff1d(np.arange(len(part)), list(found))
        if found:
            batches = _batches(part[sound], rate, names, pre_trigger, remove_baseline, detection_limit)
        out[first + sound] = _measured(batches, names, sound.size)
    return out


def measured_pulses(pulses: PulseBatch, names: tuple[str, ...]) -> tuple[NDArray[np.intp], PulseBatch, Floats]:
    """Return the rows that can be measured, their pulses and their features, (n_rows, n_features)."""
    found = _problems({"pulse": pulses}, names)
    sound = np.setdiff1d(np.arange(len(pulses.samples)), list(found))
    if found:
        how = (pulses.sampling_rate, pulses.pre_trigger, pulses.remove_baseline, pulses.detection_limit)
        pulses = PulseBatch(pulses.samples[sound], *how)
    return sound, pulses, _measured({"pulse": pulses}, names, sound.size)


def _measured(batches: Batches, names: tuple[str, ...], n_signals: int) -> Floats:
    """Return the features of signals that can be measured, (n_signals, n_features)."""
    count("features", n_signals * len(names))
    if not n_signals:
        return np.empty((0, len(names)))
    return np.stack([FEATURES[name].measure(batches[FEATURES[name].kind]) for name in names], axis=1)


def problems_of(
    frames: NDArray[np.floating],
    sampling_rate: float,
    names: Iterable[str],
    *,
    pre_trigger: int | None = None,
    detection_limit: float = DETECTION_LIMIT,
) -> dict[int, str]:
    """Return why rows of frames (n_signals, n_samples) cannot be measured: the rule broken, the value and the cure."""
    names = tuple(names)
    return _problems(_batches(frames, sampling_rate, names, pre_trigger, True, detection_limit), names)


def supported(features: Iterable[str], sampling_rate: float, n_samples: int) -> tuple[str, ...]:
    """Return those of the features that can be measured at a sampling rate [Hz] on frames of so many samples."""
    return tuple(name for name in features if not _lack(FEATURES[name], sampling_rate, n_samples))


def require_supported(names: Iterable[str], sampling_rate: float, n_samples: int) -> None:
    """Raise `InvalidValue` for a feature that needs another sampling rate [Hz] or longer frames."""
    for name in names:
        lack = _lack(FEATURES[name], sampling_rate, n_samples)
        if lack:
            raise InvalidValue(f"feature {name} {lack}, or leave it out")


def _lack(feature: Feature, sampling_rate: float, n_samples: int) -> str:
    """Return what a feature needs and the signal has not; empty when it has all."""
    if sampling_rate < 2 * feature.highest_frequency:
        # Rounded up: a cure must cure.
        needed = np.ceil(2 * feature.highest_frequency)
        return f"needs a sampling_rate of {needed:.0f} Hz or more, got {sampling_rate:g} Hz: sample faster"
    if n_samples < feature.shortest_frame * sampling_rate:
        needed = np.ceil(feature.shortest_frame * sampling_rate)
        return (
            f"needs frames of {needed:.0f} samples or more at {sampling_rate:g} Hz to tell its band from the "
            f"next, got {n_samples}: record longer"
        )
    return ""


def _batches(
    frames: NDArray[np.floating],
    sampling_rate: float,
    names: Iterable[str],
    pre_trigger: int | None,
    remove_baseline: bool,
    detection_limit: float,
) -> Batches:
    kinds = {FEATURES[name].kind for name in names}
    makers: dict[Kind, type[PulseBatch] | type[VibrationBatch]] = {"pulse": PulseBatch, "vibration": VibrationBatch}
    # A window has no touch that baseline and noise could be before.
    return {
        kind: WindowBatch(frames, sampling_rate, remove_baseline)
        if kind == "window"
        else makers[kind](frames, sampling_rate, pre_trigger, remove_baseline, detection_limit)
        for kind in kinds
    }


def _problems(batches: Batches, names: Iterable[str]) -> dict[int, str]:
    """Return why rows cannot be measured: a fit needs less of a pulse than what is read off the samples."""
    found: dict[int, str] = {}
    fitted = {FEATURES[name].fitted for name in names if FEATURES[name].kind == "pulse"}
    for batch in batches.values():
        if isinstance(batch, PulseBatch) and True in fitted:
            found |= batch.fit_problems()
        if not isinstance(batch, PulseBatch) or False in fitted:
            found |= batch.problems()
    return found


def _raise_first(found: dict[int, str], first_row: int, n_rows: int, n_signals: int) -> None:
    """Raise `BadData` for the first row that cannot be measured; rows are counted from `first_row`."""
    row, last_row = min(found), first_row + n_rows - 1
    where = f"signal {first_row + row}: " if n_signals > 1 else ""
    more = f" ({len(found)} of signals {first_row} to {last_row} cannot be measured)" if len(found) > 1 else ""
    raise BadData(f"{where}{found[row]}{more}")


def extract(
    samples: ArrayLike,
    sampling_rate: float,
    features: Iterable[str] | None = None,
    *,
    pre_trigger: int | None = None,
    remove_baseline: bool = True,
    invalid: Literal["raise", "nan"] = "raise",
) -> pandas.DataFrame:
    """Return the features of single impacts, one row a signal.

    Parameters
    ----------
    samples : array_like, (n_samples,) or (n_signals, n_samples)
        One positive pulse a row, or one vibration for the features of vibrations.
    sampling_rate : float
        [Hz].
    features : iterable of str, optional
        Names out of `FEATURES`; all of a pulse by default. Only these, and what they need, are computed.
    pre_trigger : int, optional
        Samples before touch; baseline and noise are their mean and standard deviation. By default every
        sample up to the foot of the pulse (1 % of the way from the first samples to the largest).
    remove_baseline : bool
        Whether the baseline is subtracted before anything is measured.
    invalid : {"raise", "nan"}
        What happens to a signal that cannot be measured; a sample that is not finite is always an error.

    Returns
    -------
    pandas.DataFrame, (n_signals, n_features)
        The units are in `FEATURES`.

    Raises
    ------
    BadData
        A signal has no impact, is cut off, has too few samples on the pulse, or is not finite.
    InvalidValue
        A feature is unknown or needs another sampling rate or longer frames, or a number breaks its rule.

    Examples
    --------
    >>> t = np.arange(300) / 1e5
    >>> pulse = 800 * np.sin(np.pi * np.clip((t - 1e-3) / 1e-3, 0, 1)) ** 1.5
    >>> extract(pulse, 1e5, ["peak_force", "contact_duration"]).round(5).values.tolist()
    [[800.0, 0.001]]
    """
    import pandas

    names = choose(features)
    values = extract_array(
        samples, sampling_rate, names, pre_trigger=pre_trigger, remove_baseline=remove_baseline, invalid=invalid
    )
    return pandas.DataFrame(values, columns=list(names))


#: How far windows reach behind touch, in contact durations and in samples: that of what is read off the samples
#: (the whole run above 10 % once more), and that of the fit (its coarse window is at least 48 samples long).
_READ, _FITTED = (2.0, 6), (2.25, 54)


def look_at_the_beginning(names: Iterable[str]) -> bool:
    """Return whether none of these features looks at samples far from the pulse."""
    return not any(FEATURES[name].whole_frame for name in names)


def samples_needed(names: Iterable[str], touch: Floats, duration: Floats) -> NDArray[np.intp]:
    """Return the length of a beginning that will hold all windows of usual pulses, (n,).

    Parameters
    ----------
    names : iterable of str
        The features.
    touch, duration : ndarray, (n,)
        Of the contact [samples].
    """
    contacts, more = _FITTED if any(FEATURES[name].fitted for name in names) else _READ
    return np.ceil(touch + contacts * duration + more).astype(np.intp)


def measure_beginnings(
    samples: NDArray[np.floating],
    sampling_rate: float,
    names: tuple[str, ...],
    pre_trigger: int,
    highest_behind: Floats,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the features of frames of which only the beginnings are there, and where they are certain.

    Parameters
    ----------
    samples : ndarray, (n_signals, n_beginning)
    sampling_rate : float
        [Hz].
    names : tuple of str
    pre_trigger : int
        Samples before touch.
    highest_behind : ndarray, (n_signals,)
        What no sample of the rest of the frame passes.

    Returns
    -------
    ndarray, (n_signals, n_features)
        nan where nothing can be measured.
    ndarray of bool, (n_signals,)
        Where the whole frame would give the same numbers; False where nothing can be measured.
    """
    pulses = PulseBatch(samples, sampling_rate, pre_trigger)
    table, certain = np.full((len(samples), len(names)), np.nan), np.zeros(len(samples), bool)
    sound, pulses, found = measured_pulses(pulses, names)
    if sound.size:
        table[sound] = found
        certain[sound] = _certain(pulses, names, highest_behind[sound])
    return table, certain


def _certain(pulses: PulseBatch, names: tuple[str, ...], highest_behind: Floats) -> NDArray[np.bool_]:
    n_samples = pulses.samples.shape[1]
    found = (pulses.peak + pulses.offset > highest_behind) & (pulses.window_reach < n_samples)
    if any(FEATURES[name].fitted for name in names):
        # A faint pulse is looked for in all the frame.
        found &= (pulses.peak >= FAINT * pulses.noise) & (pulses.fit.reach < n_samples)
    return np.asarray(found & look_at_the_beginning(names))
