"""The modes of a scene's beam, matched with those that taps have found: by frequency, in their order."""

from __future__ import annotations

import numpy as np

from cgid.measure.modes import Modes
from cgid.site.tapping import TapTest
from cgid.validation import Floats

#: A mode of a scene fits one of the taps within this many deviations; one that fits no mode costs their square.
_FITTING = 3.0


def matched(test: TapTest, frequency: Floats, damping_ratio: Floats, start_error: float) -> tuple[Modes, Floats]:
    """Return the modes of a scene, corrected where the hammer taps show them, and which these are, (n_modes,)."""
    # `start_error` is the relative standard deviation of the scene's frequencies; damping ratios have ten times as
    # much. Modes keep their order, and a common factor of all frequencies, such as a stiffer steel, is allowed for.
    found, computed = np.log(test.modes.frequency), np.log(frequency)
    shifts = np.linspace(-_FITTING, _FITTING, 61) * start_error
    pairs = min(((*_aligned(found, computed + shift, start_error), shift) for shift in shifts), key=lambda one: one[0])
    place = {k: i for i, k in pairs[1] if _is_sure(found, computed + pairs[2], i, k, start_error)}
    mine = np.array(sorted(place), np.intp)
    theirs = np.array([place[k] for k in mine.tolist()], np.intp)
    n = computed.size
    values = np.array([frequency, damping_ratio])
    deviations = np.outer([start_error, min(10 * start_error, 0.3), 0.0], np.ones(n))
    assert test.modes.deviation is not None
    values[:, mine] = np.array([test.modes.frequency, test.modes.damping_ratio])[:, theirs]
    deviations[:2, mine] = test.modes.deviation[:2, theirs]
    known = np.zeros(n, bool)
    known[mine] = True
    return Modes.relative(values[0], values[1], np.ones(n), deviations), known


def _aligned(found: Floats, computed: Floats, error: float) -> tuple[float, list[tuple[int, int]]]:
    """Return the cost and the pairs (found, own) of the best alignment that keeps both orders."""
    # A pair costs its squared distance; a measured mode without a partner `_FITTING` squared.
    distance = np.square((found[:, None] - computed) / error)
    cost = np.zeros((found.size + 1, computed.size + 1))
    cost[1:, 0] = _FITTING**2 * np.arange(1, found.size + 1)
    for i in range(found.size):
        best = np.minimum(cost[i, 1:] + _FITTING**2, cost[i, :-1] + distance[i])
        cost[i + 1, 1:] = np.minimum.accumulate(np.append(cost[i + 1, 0], best))[1:]
    pairs, i, k = [], found.size, computed.size
    while i and k:
        if cost[i, k] == cost[i, k - 1]:
            k -= 1
        elif cost[i, k] == cost[i - 1, k] + _FITTING**2:
            i -= 1
        else:
            i, k = i - 1, k - 1
            pairs.append((i, k))
    return float(cost[-1, -1]), pairs


def _is_sure(found: Floats, computed: Floats, i: int, k: int, error: float) -> bool:
    """Return whether a pair fits, and no neighbour of either would fit nearly as well."""
    apart = abs(found[i] - computed[k])
    others = np.abs(np.delete(computed, k) - found[i]).min(initial=np.inf)
    return bool(apart < _FITTING * error and others > 2 * apart + 0.5 * error)
