"""Which channels of a LabVIEW segment are read together: those of one length and one rate."""

from __future__ import annotations

from collections.abc import Sequence

from cgid.errors import BadData
from cgid.recordings.contents import MAX_CHANNELS
from cgid.recordings.lvm.segment import Segment


def channels_alike(segment: Segment, named: str | None, source: str, warnings: list[str]) -> list[int]:
    """Return the channels that are read, counted from 0.

    Parameters
    ----------
    segment : Segment
    named : str or None
        The channel whose length and rate the others must have; None if all of them agree.
    source : str
        Name of the file in messages.
    warnings : list of str
        Channels without samples are left out and told here.

    Raises
    ------
    BadData
        There are too many channels or none with samples, or they differ in length or rate and none is named.
    """
    if segment.n_channels > MAX_CHANNELS:
        raise BadData(f"{source}: at most {MAX_CHANNELS} channels, got {segment.n_channels}; export fewer")
    kinds = {
        channel: (segment.n_samples(channel), segment.number_of("Delta_X", channel))
        for channel in range(segment.n_channels)
    }
    empty = [channel for channel, kind in kinds.items() if kind[0] == 0]
    if empty:
        warnings.append(f"{len(empty)} channels without samples were left out: {_listed(segment, empty)}")
    held = [channel for channel in kinds if channel not in empty]
    if not held:
        raise BadData(f"{source}: a recording must hold at least one sample, no channel does; record it again")
    if named is not None:
        chosen = [channel for channel in held if segment.name(channel) == named]
        if not chosen:
            raise BadData(
                f"{source}: variable {named!r} is neither the number of a segment nor a channel with samples; choose "
                f"one of {_listed(segment, held)} by --variable"
            )
        return [channel for channel in held if kinds[channel] == kinds[chosen[0]]]
    odd = next((channel for channel in held if kinds[channel] != kinds[held[0]]), None)
    if odd is not None:
        raise BadData(
            f"{source}: channels must be of one length and rate, {segment.name(held[0])!r} has "
            f"{_shown(kinds[held[0]])} and {segment.name(odd)!r} {_shown(kinds[odd])}; "
            "pick those like one channel by --variable NAME"
        )
    return held


def _listed(segment: Segment, channels: Sequence[int]) -> str:
    names = [segment.name(channel) or str(channel + 1) for channel in channels[:20]]
    return ", ".join(names) + (", ..." if len(channels) > 20 else "")


def _shown(kind: tuple[int | None, float | None]) -> str:
    return f"{kind[0]} samples of {kind[1]} s"
