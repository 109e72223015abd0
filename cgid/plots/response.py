"""Frequency responses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cgid.plots.figure import png, require_matplotlib
from cgid.validation import Floats


def frequency_response_picture(frequency: Floats, responses: Mapping[str, NDArray[np.complex128]], unit: str) -> bytes:
    """Return a PNG picture of frequency responses: level over phase.

    Parameters
    ----------
    frequency : ndarray, (n_frequencies,)
        [Hz], above 0.
    responses : dict of ndarray of complex, (n_frequencies,)
        By the name that the picture gives them.
    unit : str
        Of the responses, as "m/s^2/N"; 0 dB is one of it.
    """
    figure = require_matplotlib()(figsize=(7.2, 5.0), layout="constrained")
    level, phase = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for name, response in responses.items():
        # A node is no response at all; the picture leaves it out.
        height = np.where(response == 0, np.nan, np.abs(response))
        level.plot(frequency, 20 * np.log10(height), lw=1, label=name)
        degrees = np.degrees(np.angle(response))
        # Broken where it jumps from one end of the circle to the other.
        degrees[1:][np.abs(np.diff(degrees)) > 180] = np.nan
        phase.plot(frequency, degrees, lw=1)
    level.set(ylabel=f"dB re 1 {unit}", xscale="log", xlim=(frequency[0], frequency[-1]))
    phase.set(xlabel="frequency [Hz]", ylabel="phase [degrees]", ylim=(-185, 185), yticks=range(-180, 181, 90))
    for axes in (level, phase):
        axes.grid(alpha=0.3, which="both")
    if len(responses) > 1:
        level.legend(fontsize="small")
    return png(figure)
