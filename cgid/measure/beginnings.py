"""Features from the beginnings of frames: where the rest of a frame cannot change them, it need not exist.

A pulse is looked for in its whole frame and then looked at through a window. So the features of a frame that breaks
off early are those of the whole frame, to the last bit, if its largest sample is above all that may follow, and if
no window reaches past its end. Both are checked for each signal; where either fails, the whole frame is needed.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cgid.measure.features import FEATURES, measured_pulses
from cgid.measure.pulses import FAINT, PulseBatch
from cgid.validation import Floats

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
