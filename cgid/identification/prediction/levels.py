"""Levels of impacts against those of the training: a wrong scale of a force, or of a model without explanations.

A level is the logarithm of a peak over that of the training for such a pulse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel

#: Impacts from which on their levels are compared with those of the training.
MIN_LEVELS = 10
#: A live stream is looked at for days, so chance may have this many times the variance.
_ENDLESS = 3.5
#: Levels count up to so many standard deviations from their median; the upper end of n levels, their mean and standard
#: deviation together, is about this one in the training. In standard deviations of the training.
_CLIPPED, _UPPER = 2.0, 0.85
#: The upper end of n levels lies above and below that by more than sqrt(a / n + b) in less than one of 200 recordings
#: each, by simulation (forces: benchmarks/plant/false_alarms.py, beams: benchmarks/plant/wrong_scale.py): (a, b) above
#: and below, for a force and for what a beam gives. Slow rebounds on a beam only lower the level.
_SPREAD = {False: ((6.5, 0.09), (10.0, 0.02)), True: ((3.5, 0.05), (15.0, 0.34))}
#: Pulses below so many times the noise are not heard. Of 3 to 20 it tells most factors of 2 at the same false alarms.
_HEARD = 4.0
#: So many latest levels, n, may be a mixture with the coal of an anchor if their upper end is no further below the
#: coal's than sqrt(a / n + a / n of the coal), and no further above that of the training than hard simulated seams
#: reach: but for one of 100 cycles of such seams. In standard deviations of the training.
OF_ANCHOR, _BELOW_COAL, _HARDEST = 60, 6.3, 1.3


def factor_of(
    levels: Sequence[float],
    model: StoredModel,
    *,
    known: NDArray[np.bool_] | None = None,
    heights: Floats | None = None,
    endless: bool = False,
) -> float:
    """Return the likely factor of a signal with these levels; 1 if they are as in recordings like the training's.

    Whether it is told is decided by the `known` impacts, without what noise made of pulses; how large it is, by all.
    `heights` are those of the pulses over the noise, which hides small ones that the training had. `endless` is one of
    the many looks at a live stream.
    """
    own, stated, deviation = np.array(levels), model.level_range, model.level_deviation
    looks = _ENDLESS if endless else 1.0
    if stated:  # of a model of labelled recordings
        end = upper_end(own, stated["deviation"])
        excess = max(end - stated["high"], 0.0) + min(end - stated["low"], 0.0)
        likely = float(np.exp(end - (stated["low"] + stated["high"]) / 2))
        return likely if abs(excess) > np.sqrt(stated["between"] + looks * stated["within"] / own.size) else 1.0
    # Of labelled vibrations and windows without levels, it is not known by how much recordings differ.
    if not deviation or ("recorded" in model.training and model.kind != "pulse"):
        return 1.0
    counted = np.ones(own.size, bool) if known is None else known
    if not counted.any():
        return 1.0
    excess = upper_end(own[counted], deviation) / deviation - _UPPER
    if heights is not None and excess > 0:
        least = (own - np.log(np.maximum(heights, 1.0) / _HEARD))[counted] / deviation
        excess = max(excess - _raised_by(float(np.median(least))), 0.0)
    chance, spread = _SPREAD[model.beam is not None][0 if excess > 0 else 1]
    # Includes the uncertainty of the training for few impacts.
    limit = np.sqrt(looks * chance / counted.sum() + chance / model.training.get("n_train", np.inf) + spread)
    if abs(excess) <= limit:
        return 1.0
    of_all = upper_end(own, deviation) / deviation - _UPPER
    return float(np.exp(deviation * (of_all if of_all * excess > 0 else excess)))


def _raised_by(least: float) -> float:
    """Return by how much the mean and the deviation of a standard normal rise, together, where only more is seen."""
    least = min(least, 8.0)  # the tail beyond has no digits
    mean = math.sqrt(2 / math.pi) * math.exp(-(least**2) / 2) / math.erfc(least / math.sqrt(2))
    return mean + math.sqrt(max(1 + mean * (least - mean), 0.0)) - 1.0


def fits_coal(levels: Sequence[float], coal: Sequence[float], model: StoredModel) -> bool:
    """Return whether the latest levels may be of a mixture with this coal; gangue only raises them."""
    deviation = model.level_deviation
    if len(levels) < OF_ANCHOR or len(coal) < MIN_LEVELS or not deviation:
        return True
    end, lowest = (upper_end(np.array(some), deviation) / deviation for some in (levels[-OF_ANCHOR:], coal))
    limit = np.sqrt(_BELOW_COAL / OF_ANCHOR + _BELOW_COAL / len(coal))
    return bool(lowest - limit <= end <= _UPPER + _HARDEST)


def upper_end(levels: Floats, deviation: float) -> float:
    """Return the upper end of levels, mean and standard deviation together, without stray ones."""
    ordered = np.sort(levels)  # np.median takes three times as long
    middle = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    clipped = np.clip(levels, middle - _CLIPPED * deviation, middle + _CLIPPED * deviation)
    return float(clipped.mean() + clipped.std())
