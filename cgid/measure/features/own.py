"""Features of one's own: functions, given by the user or registered by another package; a model only names them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.features.table import Feature, Kind

#: Entry points of features of other packages; each is a function or a `Feature`.
GROUP = "cgid.features"
#: Their `source`; a signal of which one gives a number that is not finite cannot be measured.
OWN = "own"


def own_feature(
    function: Callable[[Floats, float], Any],
    *,
    name: str = "",
    kind: Kind = "pulse",
    unit: str = "1",
    positive: bool = False,
) -> Feature:
    """Return a feature that a function measures; it goes where names of features go.

    Parameters
    ----------
    function : callable
        Called with samples (n_signals, n_samples) without their baseline and the sampling rate [Hz]; returns one number
        for each signal. A signal for which it is not finite cannot be measured.
    name : str
        By default that of the function.
    kind : {"pulse", "vibration", "window"}
        What the signals are.
    unit : str
        Of the numbers; `U` stands for the unit of the signal, as in "U" or "U s". A number without a unit is "1".
    positive : bool
        Whether a number without a unit is always above 0, so that its logarithm is meaningful.

    Returns
    -------
    Feature

    Raises
    ------
    InvalidValue
        It is not a function, or its name is not an identifier or is that of a feature of cgid.

    Examples
    --------
    >>> def crest(samples, sampling_rate):
    ...     return samples.max(axis=1) / samples.std(axis=1)
    >>> own_feature(crest, positive=True).name
    'crest'
    """
    name = name or getattr(function, "__name__", "")
    if not callable(function):
        raise InvalidValue(f"feature must be a name, a function or a Feature, got {validation.shown(function)}")
    if not name.isidentifier():
        raise InvalidValue(
            f"feature: name must be an identifier, got {name!r}; give own_feature(function, name='my_feature') of "
            "cgid.measure.features in place of the function"
        )
    validation.choice("kind", kind, ("pulse", "vibration", "window"))

    def measure(batch: Any) -> Floats:
        rows = batch.swing if kind == "window" else batch.samples.astype(np.float64) - batch.offset[:, np.newaxis]
        try:
            values = np.asarray(function(rows, batch.sampling_rate), np.float64)
        except Exception as error:  # another's code may fail in any way
            raise InvalidValue(
                f"feature {name}: must measure signals, it raised {type(error).__name__}: {error}"
            ) from error
        if values.shape != (len(rows),):
            raise InvalidValue(
                f"feature {name}: must give one number for each of {len(rows)} signals, got shape {values.shape}"
            )
        return values

    definition = " ".join((function.__doc__ or "").split("\n\n")[0].split())
    return Feature(
        name, unit, definition or "of one's own", OWN, measure, kind=kind, positive=positive, whole_frame=True
    )


@cache
def outside_features() -> dict[str, Feature]:
    """Return the features that other packages register, by name."""
    from importlib.metadata import entry_points

    return {feature.name: feature for feature in _loaded(entry_points(group=GROUP))}


def _loaded(entries: Any) -> Iterator[Feature]:
    for entry in sorted(entries, key=lambda one: one.name):
        try:
            found = entry.load()
            yield found if isinstance(found, Feature) else own_feature(found, name=entry.name)
        except Exception as error:  # another package may fail in any way
            said = f"{type(error).__name__}: {error}"
            warnings.warn(f"the feature {entry.name} ({entry.value}) cannot be loaded: {said}", stacklevel=2)
