"""The forces of all impacts in a recording of any length, by stretches of a minute."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cgid._lib.validation import Floats
from cgid.calibration.splice import Span
from cgid.calibration.taps import JUMP, events_in, hammer_force, is_clipped
from cgid.errors import BadData
from cgid.identification.detection.events import Event
from cgid.identification.inversion.recovered import CONTACT, RecoveredForce, errors_of, recover_each
from cgid.measure.modal.beam import Beam
from cgid.measure.modal.modes import Modes

#: How much stretches must overlap: an impact is heard for half of it [s].
OVERLAP = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ImpactForce:
    """The force of an impact in a recording.

    Attributes
    ----------
    found : RecoveredForce
        With its times in the recording.
    clipped : bool
        Whether its vibration is clipped, so that the force is wrong.
    measured : ndarray, (n,), optional [N]
        What a hammer channel says at the same times.
    errors : dict, optional
        Of the found force beside it (`errors_of`).
    """

    found: RecoveredForce
    clipped: bool
    measured: Floats | None = None
    errors: dict[str, float] | None = None


def forces_in(
    spans: Iterable[Span],
    sampling_rate: float,
    modes: Modes | Sequence[Modes] | Beam,
    *,
    quantity: str = "acceleration",
    band: tuple[float, float] | None = None,
    contact: float = CONTACT,
    source: str = "signal",
    told: Callable[[str], None] | None = None,
) -> Iterator[ImpactForce]:
    """Yield the force of each impact of a recording, in order of time.

    Parameters
    ----------
    spans : iterable
        Stretches of the recording: first sample, response (n_channels, n) in SI units, force of a hammer (n,) [N] or
        None, and whether it is the last. They overlap by `OVERLAP` (`cgid.calibration.splice.spans_of`); a recording as
        a whole is one stretch, `[(0, response, None, True)]`.
    sampling_rate : float [Hz]
    modes, quantity, band, contact
        As of `cgid.identification.inversion.recover_force`.
    source : str
        Name of the recording in errors.
    told : callable, optional
        Receives one line about each impact that is left out: its force cannot be found, by default the first one
        raises; or it is perhaps a beat of modes.

    Yields
    ------
    ImpactForce

    Raises
    ------
    InvalidValue, BadData
        There is no impact whose force can be found; or as of `recover_force`.
    """
    done, n_found = 0, 0
    why_none = BadData(f"{source}: must contain an impact, got none; record longer")
    for first, response, force, last in spans:
        beats: list[Event] = []
        try:
            if force is None:
                measured, events = None, events_in(response, sampling_rate, source, apart=False, beats=beats)
            else:
                measured, events = hammer_force(force, sampling_rate, source)
        except BadData as error:
            why_none = error
            continue
        # The vibration of the last impacts goes on in the next stretch, which also begins with them.
        rings = round(OVERLAP / 2 * sampling_rate)
        end = response.shape[1] - (0 if last else rings)
        onsets = [event.onset for event in events if done - first <= event.onset < end]
        limits = response.max(axis=1), response.min(axis=1)
        failed: list[BadData] = []
        found = recover_each(
            response,
            sampling_rate,
            modes,
            [onset / sampling_rate for onset in onsets],
            quantity=quantity,
            band=band,
            contact=contact,
            begin=first / sampling_rate,
            told=failed.append,
        )
        for why_none in failed:
            if told is None:
                raise why_none
            told(f"{source}: {why_none}")
        for event in beats:
            if told is not None and done - first <= event.onset < end:
                time = (first + event.onset) / sampling_rate
                told(
                    f"{source}: impact at {time:.4g} s: must stand out {JUMP:g}-fold from the vibration before it, "
                    "else it may be a beat of modes; leave more time between impacts"
                )
        for onset, one in zip(onsets, found, strict=True):
            if one is None:
                continue
            part = response[:, round(onset) : round(one.time[-1] * sampling_rate) + rings]
            out = ImpactForce(found=one, clipped=is_clipped(part, *limits))
            if measured is not None:
                beside = np.interp(one.time, np.arange(measured.size) / sampling_rate, measured)
                out = replace(out, measured=beside, errors=errors_of(one, measured, sampling_rate))
            n_found += 1
            yield replace(out, found=replace(one, time=one.time + first / sampling_rate))
        done = first + end
    if not n_found:
        raise why_none
