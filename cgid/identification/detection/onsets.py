"""What the two ways to find the beginnings of impacts give: `ringing` and `pulses`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cgid.validation import Floats

#: Returns the samples (n_channels, n) of a recording between two numbers, as far as they are there.
Read = Callable[[int, int], Floats]


@dataclass(eq=False)
class Onset:
    """The beginning of an impact, before its frame is cut.

    Attributes
    ----------
    row : int
        What dead time and neighbours are counted in: its channel, or 0 where all are one.
    channel : int
        Where it was found; where all are one, that which heard it most.
    sample : int
        From the first of the recording.
    noise : ndarray, (n,)
        Of a vibration: the energy of the noise in each band. Of a pulse: the baseline of each channel.
    last : int or None
        Of a pulse: the last sample above the threshold so far.
    closed : bool
        Whether no later sample can belong to it.
    again : int or None
        Sample at which another one is seen that followed so closely that they are one.
    """

    row: int
    channel: int
    sample: int
    noise: Floats
    last: int | None = None
    closed: bool = True
    again: int | None = None
