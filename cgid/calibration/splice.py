"""Recordings of any length, by stretches of a minute, and the taps in them one after the other.

A tap test uses a minute of vibration: a longer recording is read until it has been found, and what lies between the
taps is left out. So an hour needs no more memory than a minute.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from cgid._lib.validation import Floats
from cgid.calibration.taps import NEAR, Tap, events_in, hammer_force
from cgid.errors import BadData

#: Length of a stretch, and of the vibration that is used altogether [s].
MINUTE = 60.0
#: A tap has at most this much vibration, one of a roving hammer this much, from this long before its onset [s].
_PIECE, _ROVING, _LEAD = 8.0, 2.0, 0.1
#: A stretch of a recording: its first sample, response (n_channels, n), force (n,) or None, whether it is the last.
Span = tuple[int, Floats, Floats | None, bool]


def spans_of(blocks: Iterable[Floats], length: int, overlap: int) -> Iterator[tuple[int, Floats, bool]]:
    """Yield stretches (n_channels, at most `length`) of a recording that overlap, with their first sample, and at last.

    `blocks` are those of the recording, (n_channels, n) each.
    """
    first = size = 0
    held: list[Floats] = []
    for block in blocks:
        rest = block
        while size + rest.shape[1] > length:
            whole = np.concatenate([*held, rest[:, : length - size]], axis=1)
            yield first, whole, False
            rest, first = rest[:, length - size :], first + length - overlap
            held, size = [whole[:, length - overlap :].copy()], overlap
        held.append(rest)
        size += rest.shape[1]
    yield first, np.concatenate(held, axis=1), True


def moved(blocks: Iterable[Floats], count: int) -> Iterator[Floats]:
    """Yield blocks (n_channels, n) of the same lengths whose samples come `count` later, or earlier if negative.

    Zeros enter.
    """
    lengths: list[int] = []
    held: Floats | None = None
    for block in blocks:
        held = np.zeros((len(block), max(count, 0))) if held is None else held
        lengths.append(block.shape[1])
        held = np.concatenate([held, block], axis=1)
        while lengths and held.shape[1] >= lengths[0] + max(-count, 0):
            skipped, count = (-count, 0) if count < 0 else (0, count)
            length = lengths.pop(0)
            yield held[:, skipped : skipped + length]
            held = held[:, skipped + length :]
    for length in lengths:
        assert held is not None
        part, held = held[:, max(-count, 0) :][:, :length], held[:, max(-count, 0) + length :]
        count = 0
        yield np.pad(part, ((0, 0), (0, length - part.shape[1])))


class Splice:
    """The taps of a recording, the only stretch of a short one as it is.

    Attributes
    ----------
    response : ndarray, (n_channels, n)
    force : ndarray, (n,), or None
    """

    #: How much stretches must overlap [s].
    OVERLAP = _PIECE + 4 * _LEAD

    def __init__(
        self,
        spans: Iterable[Span],
        sampling_rate: float,
        source: str,
        times: Sequence[float] | None,
        n_places: int = 0,
    ) -> None:
        # `n_places` taps of a roving hammer are used all.
        self.sampling_rate = sampling_rate
        self._piece, most = (_ROVING, np.inf) if n_places else (_PIECE, MINUTE)
        self._listed = None if times is None else np.array(times)
        pieces: list[tuple[int, Floats, Floats | None]] = []
        total, known, refused = 0, -1, None
        for first, response, force, last in spans:
            if last and not first:
                pieces = [(0, response, force)]
                break
            try:
                for onset, piece in list(self._taps_in(first, response, force, last, known, source)):
                    known = onset + round(_LEAD * sampling_rate) // 2  # the next stretch may find it a little later
                    pieces.append(piece)
            except BadData as error:  # a stretch without a tap
                refused = error
            total = sum(piece.shape[1] for _, piece, _ in pieces)
            if total > most * sampling_rate or len(pieces) > n_places > 0:
                break
        if not pieces:
            raise refused or BadData(f"{source}: the table of taps must list one of the recording; correct it")
        self._starts = np.array([start for start, _, _ in pieces])
        self._begins = np.cumsum([0, *(piece.shape[1] for _, piece, _ in pieces)])
        self.response = np.concatenate([piece for _, piece, _ in pieces], axis=1)
        forces = [own for _, _, own in pieces if own is not None]
        self.force = np.concatenate(forces) if forces else None

    def _taps_in(
        self, first: int, response: Floats, force: Floats | None, last: bool, known: int, source: str
    ) -> Iterator[tuple[int, tuple[int, Floats, Floats | None]]]:
        """Yield onset, and begin, response and force, of the taps of a stretch after a sample of the recording."""
        lead, longest = round(_LEAD * self.sampling_rate), round(self._piece * self.sampling_rate)
        if force is None:
            events = events_in(response, self.sampling_rate, source, apart=self._listed is None)
        else:
            events = hammer_force(force, self.sampling_rate, source)[1]
        onsets = [round(event.onset) for event in events]
        for onset, following in zip(onsets, [*onsets[1:], response.shape[1] + lead], strict=True):
            if not last and onset + longest > response.shape[1]:
                return  # the next stretch contains it, too
            time = (first + onset) / self.sampling_rate
            listed = self._listed is None or np.any(np.abs(self._listed - time) <= NEAR)
            if first + onset <= known or not listed:
                continue
            part = slice(max(onset - lead, 0), min(onset + longest, following - lead))
            if part.stop > onset:
                piece = response[:, part].copy(), None if force is None else force[part].copy()
                yield first + onset, (first + part.start, *piece)

    def inside(self, times: Sequence[float] | None) -> list[float] | None:
        """Return those times of the recording that are in the splice, as times of it [s]."""
        if times is None or self._starts.size == 1:
            return None if times is None else list(times)
        at = np.array(times)[:, None] * self.sampling_rate - self._starts
        row, piece = np.nonzero((at >= 0) & (at < np.diff(self._begins)))
        return ((self._begins[piece] + at[row, piece]) / self.sampling_rate).tolist()  # type: ignore[no-any-return]

    def placed(self, tap: Tap) -> Tap:
        """Return a tap of the splice with its time in the recording."""
        k = int(np.searchsorted(self._begins, round(tap.time * self.sampling_rate), side="right")) - 1
        return replace(tap, time=tap.time + float(self._starts[k] - self._begins[k]) / self.sampling_rate)
