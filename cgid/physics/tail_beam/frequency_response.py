"""Frequency response of a beam: motion at the sensor over force where it is hit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.physics.response import DERIVATIVES
from cgid.physics.tail_beam.measured import MeasuredModes
from cgid.physics.tail_beam.modes import Modes
from cgid.validation import Floats


def frequency_response(
    frequency: ArrayLike, modes: Modes | MeasuredModes, participation: Floats, *, quantity: str
) -> NDArray[np.complex128]:
    """Return motion over force at given frequencies, `exp(+j omega t)`.

    `sum participation (j omega)^n / (omega_r^2 - omega^2 + 2 j zeta_r omega_r omega)`, n = 0, 1, 2 for receptance,
    mobility and accelerance: Ewins (2000), Modal Testing, section 2. Modes that were left out above the
    highest are missing, which shows as a stiffness below them.

    Parameters
    ----------
    frequency : array_like, (n_frequencies,)
        [Hz], 0 or more.
    modes : Modes or MeasuredModes
    participation : ndarray, (*points, n_modes)
        `modes.participation(...)` [1/kg].
    quantity : {"acceleration", "velocity", "displacement"}

    Returns
    -------
    ndarray of complex, (*points, n_frequencies)
        [m/s^2/N], [m/s/N] or [m/N].

    Raises
    ------
    InvalidValue
        A frequency is negative, the quantity unknown, or the participation is that of other modes.

    Examples
    --------
    At its resonance one mode moves as the damping allows, a quarter period behind the force:

    >>> modes = MeasuredModes(
    ...     frequency=[100.0], damping_ratio=[0.01], modal_mass=[50.0], shape_impact=[1.0], shape_sensor=[1.0]
    ... )
    >>> response = frequency_response([100.0], modes, modes.participation(), quantity="acceleration")
    >>> complex(response[0].round(9))
    1j
    """
    validation.choice("quantity", quantity, DERIVATIVES)
    asked = np.atleast_1d(validation.not_negative("frequency", frequency, "Hz"))
    natural, damping = (np.asarray(part, dtype=np.float64) for part in (modes.frequency, modes.damping_ratio))
    if participation.shape[-1:] != natural.shape:
        raise InvalidValue(
            f"participation must have one number for each of the {natural.size} modes in its last axis, got shape "
            f"{participation.shape}"
        )
    omega, natural = 2 * np.pi * asked[:, None], 2 * np.pi * natural
    each = (1j * omega) ** DERIVATIVES[quantity] / (natural**2 - omega**2 + 2j * damping * natural * omega)
    # Not a product of matrices, whose last bits hang on the library and its threads.
    return np.asarray(np.einsum("...m,fm->...f", participation, each))
