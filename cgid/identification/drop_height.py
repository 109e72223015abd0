"""The drop height, a model input besides the signal: from a dataset or from the user."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.signals import Batch
from cgid.units import STANDARD_GRAVITY
from cgid.validation import Floats

#: Possible model inputs besides the signal, and their units.
KNOWN: Mapping[str, str] = {"drop_height": "m"}


def drop_heights(batch: Batch) -> Floats | None:
    """Return the drop height of each rock of a batch [m]; None if the batch does not store it.

    A stored velocity gives the height of a free fall, velocity^2 / (2 g). Raises `BadData` if some impacts have
    neither, or a height that is not above 0.
    """
    missing = np.full(len(batch), np.nan)
    height, velocity = (batch.parameters.get(name, missing) for name in ("drop_height", "velocity"))
    heights = np.where(np.isfinite(height), height, velocity**2 / (2 * STANDARD_GRAVITY))
    if np.isnan(heights).all():
        return None
    good = np.isfinite(heights) & (heights > 0)
    if not good.all():
        row = int(np.argmin(good))
        raise BadData(
            f"every impact must have a drop height above 0 m or a velocity, impact {row} has {height[row]:g} m and "
            f"{velocity[row]:g} m/s; make the dataset again"
        )
    return heights


def known_columns(known: tuple[str, ...], n_impacts: int, drop_height: ArrayLike | None) -> Floats:
    """Return the model inputs besides the features, (n_impacts, n_known).

    The drop height is one number, or one for each impact [m]. Raises `MissingOption` if the model needs it and it is
    not given, `InvalidValue` if the model does not use it, it is not above 0 or has another shape.
    """
    if drop_height is None:
        if "drop_height" in known:
            raise MissingOption(
                "drop_height must be known to this model and is not given; give --drop-height METRES "
                "(how far the rock fell), or take a model that does without"
            )
        return np.empty((n_impacts, 0))
    if "drop_height" not in known:
        raise InvalidValue(
            "drop_height must be left out, this model was trained without it; "
            "or give a model made by cgid train --drop-height"
        )
    heights: NDArray[np.float64] = validation.positive("drop_height", drop_height, KNOWN["drop_height"])
    if heights.shape not in ((), (n_impacts,)):
        raise InvalidValue(
            f"drop_height must be one number or one for each of {n_impacts} impacts, got {heights.shape}"
        )
    return np.broadcast_to(heights, (n_impacts,))[:, None]
