"""The modes of a scene's beam, matched with those of a tap test by frequency, in their order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.calibration.roving import RovingTest
from cgid.calibration.taps import TapTest
from cgid.measure.modal.modes import Modes

#: A mode of a scene matches one of the taps within this many standard deviations; an unmatched one costs their square.
_FITTING = 3.0
#: Shapes of a matched mode have at least this assurance criterion.
LEAST_MAC = 0.5


def matched(test: TapTest, known: Modes, start_error: float) -> tuple[Modes, NDArray[np.intp], Floats]:
    """Return the modes of a scene, corrected if matched with a mode of the tap test.

    Beside them are the matched modes of the test, (n_modes,), -1 for none, and the modal assurance criterion of each
    pair, squared cosine of the angle between their shapes at the places of a roving hammer (Allemang & Brown 1982); nan
    without. Pairs of other shapes are not matched.
    """
    # `start_error` is the relative standard deviation of the scene's frequencies; damping ratios have ten times as
    # much. Modes keep their order; a common factor of all frequencies, as for stiffer steel, is possible.
    frequency, damping_ratio = known.frequency, known.damping_ratio
    measured, computed = np.log(test.modes.frequency), np.log(frequency)
    shifts = np.linspace(-_FITTING, _FITTING, 61) * start_error
    pairs = min(
        ((*_aligned(measured, computed + shift, start_error), shift) for shift in shifts), key=lambda one: one[0]
    )
    partner = {k: i for i, k in pairs[1] if _is_unique(measured, computed + pairs[2], i, k, start_error)}
    n = computed.size
    found, alike = np.full(n, -1), np.full(n, np.nan)
    for k, i in partner.items():
        found[k] = i
    if isinstance(test, RovingTest) and callable(known.at_impact):
        own, theirs = test.mode_shapes[:, found], known.shape(*test.places.T)
        products = [np.sum(one * two, axis=0) for one, two in ((own, theirs), (own, own), (theirs, theirs))]
        alike = np.where(found >= 0, products[0] ** 2 / np.maximum(products[1] * products[2], 1e-300), np.nan)
        found[alike < LEAST_MAC] = -1
    matched = np.flatnonzero(found >= 0)
    measured_index = found[matched]
    values = np.array([frequency, damping_ratio])
    deviations = np.outer([start_error, min(10 * start_error, 0.3), 0.0], np.ones(n))
    assert test.modes.deviation is not None
    values[:, matched] = np.array([test.modes.frequency, test.modes.damping_ratio])[:, measured_index]
    deviations[:2, matched] = test.modes.deviation[:2, measured_index]
    return Modes.relative(values[0], values[1], np.ones(n), deviations), found, alike


def _aligned(measured: Floats, computed: Floats, error: float) -> tuple[float, list[tuple[int, int]]]:
    """Return the cost and the pairs (measured, computed) of the best alignment that keeps both orders."""
    # A pair costs its squared distance; a measured mode without a partner `_FITTING` squared.
    distance = np.square((measured[:, None] - computed) / error)
    cost = np.zeros((measured.size + 1, computed.size + 1))
    cost[1:, 0] = _FITTING**2 * np.arange(1, measured.size + 1)
    for i in range(measured.size):
        best = np.minimum(cost[i, 1:] + _FITTING**2, cost[i, :-1] + distance[i])
        cost[i + 1, 1:] = np.minimum.accumulate(np.append(cost[i + 1, 0], best))[1:]
    pairs, i, k = [], measured.size, computed.size
    while i and k:
        if cost[i, k] == cost[i, k - 1]:
            k -= 1
        elif cost[i, k] == cost[i - 1, k] + _FITTING**2:
            i -= 1
        else:
            i, k = i - 1, k - 1
            pairs.append((i, k))
    return float(cost[-1, -1]), pairs


def _is_unique(measured: Floats, computed: Floats, i: int, k: int, error: float) -> bool:
    """Return whether a pair matches and no neighbour matches nearly as well."""
    nearest = abs(measured[i] - computed[k])
    others = np.abs(np.delete(computed, k) - measured[i]).min(initial=np.inf)
    return bool(nearest < _FITTING * error and others > 2 * nearest + 0.5 * error)
