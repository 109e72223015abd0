"""Synthetic impacts beside recorded ones: their level and spectrum moved to where those of the recordings are.

A scene knows the bodies and what tells them apart; it does not know the gain and the response of somebody's sensor on
somebody's support. So the mean of each level, over the labels that both have, is moved onto that of the recordings: one
number for each band, found on what trains and never on what judges.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, InvalidValue
from cgid.measure.features import FEATURES
from cgid.signals import Batch
from cgid.units import UNITS, quantity_of
from cgid.validation import Floats

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
