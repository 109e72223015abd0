"""Hertz contact: the paper's three stiffness theories and the closed forms of an elastic impact.

Every theory has the form `P = K delta^(3/2)`. Hertz's reduced modulus already holds the compliance of both
bodies, so the paper's own series theory counts it twice, and an independent finite-element run agrees with
`"hertz"`; all three are kept, and none is chosen silently.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.units import STANDARD_GRAVITY
from cgid.validation import Floats

#: K over Hertz's `K1 = 4/3 sqrt(R) E`; Yang, Zeng & Wan (2018), Eq. 5-6, 7-8 and 9-13.
STIFFNESS_THEORIES = {
    "hertz": 1.0,
    "rigid-sphere": 8 * np.sqrt(3) / 9,
    "series": 1 / (1.75 * math.sqrt(1.75)),
}


def contact_stiffness(reduced_radius: ArrayLike, reduced_modulus: ArrayLike, theory: str) -> Floats:
    """Return K of `P = K delta^(3/2)`.

    Parameters
    ----------
    reduced_radius : array_like
        [m].
    reduced_modulus : array_like
        [Pa].
    theory : {"hertz", "rigid-sphere", "series"}
        `K1 = 4/3 sqrt(R) E`; `K2 = 8 sqrt(3)/9 K1`; both springs in series, `K1 / 1.75^(3/2)`.

    Returns
    -------
    ndarray
        [N/m^(3/2)].

    Examples
    --------
    >>> f"{contact_stiffness(0.025, 2.4265e9, 'hertz'):.4e}"  # Yang 2018, Table 1
    '5.1155e+08'
    """
    factor = STIFFNESS_THEORIES[validation.choice("stiffness", theory, STIFFNESS_THEORIES)]
    radius = validation.positive("reduced_radius", reduced_radius, "m")
    modulus = validation.positive("reduced_modulus", reduced_modulus, "Pa")
    return np.asarray(factor * 4 / 3 * np.sqrt(radius) * modulus)


def free_fall_velocity(height: ArrayLike, gravity: float = STANDARD_GRAVITY) -> Floats:
    """Return the speed after a free fall, `sqrt(2 g H)` [m/s] (Yang 2018, Eq. 15).

    Examples
    --------
    >>> round(float(free_fall_velocity(1.0)), 4)
    4.4287
    """
    pull = validation.not_negative("gravity", gravity, "m/s^2")
    return np.asarray(np.sqrt(2 * pull * validation.not_negative("height", height, "m")))
