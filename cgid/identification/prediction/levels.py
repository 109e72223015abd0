"""Levels of impacts against those of the training: a wrong scale of a force, or of a model without explanations.

A level is the logarithm of a peak over that of the training for such a pulse.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

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
#: each, by simulation (benchmarks/plant/wrong_scale.py): (a, b) above and below, for a force and for what a beam gives.
#: Slow rebounds on a beam only lower the level.
_SPREAD = {False: ((7.0, 0.10), (10.0, 0.12)), True: ((3.5, 0.05), (15.0, 0.34))}
#: So many latest levels, n, may be a mixture with the coal of an anchor if their upper end is no further below the
#: coal's than sqrt(a / n + a / n of the coal), and no further above that of the training than hard simulated seams
#: reach: but for one of 100 cycles of such seams. In standard deviations of the training.
OF_ANCHOR, _BELOW_COAL, _HARDEST = 60, 6.3, 1.3


def factor_of(levels: Sequence[float], model: StoredModel, *, endless: bool = False) -> float:
    """Return the likely factor of a signal with these levels; 1 if they are as in recordings like the training's.

    `endless` is one of the many looks at a live stream.
    """
    n, known, deviation = len(levels), model.level_range, model.level_deviation
    if n < MIN_LEVELS:
        return 1.0
    looks = _ENDLESS if endless else 1.0
    if known:  # of a model of labelled recordings
        end = upper_end(np.array(levels), known["deviation"])
        excess = max(end - known["high"], 0.0) + min(end - known["low"], 0.0)
        likely = float(np.exp(end - (known["low"] + known["high"]) / 2))
        return likely if abs(excess) > np.sqrt(known["between"] + looks * known["within"] / n) else 1.0
    # Of labelled vibrations and windows without levels, it is not known by how much recordings differ.
    if not deviation or ("recorded" in model.training and model.kind != "pulse"):
        return 1.0
    excess = upper_end(np.array(levels), deviation) / deviation - _UPPER
    chance, spread = _SPREAD[model.beam is not None][0 if excess > 0 else 1]
    # Includes the uncertainty of the training for few impacts.
    limit = np.sqrt(looks * chance / n + chance / model.training.get("n_train", np.inf) + spread)
    return float(np.exp(excess * deviation)) if abs(excess) > limit else 1.0


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
