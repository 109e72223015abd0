"""SEP005, the form in which the tools of sdypy exchange time series: a dictionary for each channel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

import numpy as np

from cgid.errors import BadData
from cgid.recordings.times import lost_before, rate_of
from cgid.signals import Signal
from cgid.units import known_unit


def from_sep005(channels: Iterable[Mapping[str, Any]], source: str = "SEP005") -> list[Signal]:
    """Return the channels of another reader as signals.

    Parameters
    ----------
    channels : iterable of mapping
        Channels in the form SEP005, with data (n_samples,), name, unit_str, and fs [Hz] or time [s].
    source : str
        Name of the recording.

    Returns
    -------
    list of Signal

    Raises
    ------
    BadData
        A channel lacks one of these, or its times have a gap.
    """
    signals = []
    for channel in channels:
        name = f"{source} {channel.get('name', '')}".strip()
        lacking = [key for key in ("data", "name", "unit_str") if key not in channel]
        if lacking or channel.get("fs", channel.get("time")) is None:
            raise BadData(f"{name}: a channel must have data, name, unit_str, fs or time, {lacking or 'fs'} is missing")
        rate, start = channel.get("fs"), channel.get("start_timestamp")
        if rate is None:
            times = np.asarray(channel["time"], np.float64)
            rate = rate_of(times, name)
            if lost_before(times, name).any():
                raise BadData(f"{name}: the times must have no gap; cut the recording there")
        signals.append(
            Signal(
                samples=np.asarray(channel["data"], np.float64),
                sampling_rate=float(rate),
                unit=known_unit(str(channel["unit_str"])),
                source=source,
                channel=str(channel["name"]),
                start_time=datetime.fromisoformat(start) if isinstance(start, str) else start,
            )
        )
    return signals


def to_sep005(signals: Iterable[Signal]) -> list[dict[str, Any]]:
    """Return signals as channels in the form SEP005.

    Parameters
    ----------
    signals : iterable of Signal

    Returns
    -------
    list of dict
        A unit that is not known is "-".
    """
    forms = []
    for one in signals:
        form = {"name": one.channel, "unit_str": one.unit or "-", "data": one.samples, "fs": one.sampling_rate}
        forms.append(form if one.start_time is None else {**form, "start_timestamp": one.start_time.isoformat()})
    return forms
