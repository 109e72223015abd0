"""One recording of the page: its waveform at any zoom, its impacts, and what is measured of them once."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData, CgidError, NoInput, Stopped
from cgid.identification.detection.ear import Ear
from cgid.identification.detection.events import SAME_IMPACT, Event
from cgid.identification.training.rows import Rows
from cgid.labelling.table import Cells
from cgid.measure.features.table import ImpactKind
from cgid.signals import channel_name

if TYPE_CHECKING:
    from cgid.identification.training.recordings import AnnotatedFile, AnnotatedRows, Cutting

#: Samples of a column of the stored waveform, and most columns of a view.
BIN, MAX_COLUMNS = 256, 2000
#: Most samples of a channel that a view reads from the file.
_READ = 2 * MAX_COLUMNS * BIN
#: The selected impact is shown from so long before its onset to so long after, and heard [s].
BEFORE, AFTER, HEARD = 0.01, 0.09, 0.6
#: Impacts that are measured at once.
_AT_ONCE = 64
#: Digits of a sample in a view.
_STEPS = 32000


@dataclass(eq=False)
class ListedImpact:
    """An impact of one or several channels."""

    cells: Cells
    time: float
    channel: int  # that hears it loudest
    peak: float
    flags: str


@dataclass(eq=False)
class LabelledRecording:
    """A recording, read once from start to end in the background; views may be asked for meanwhile."""

    file: AnnotatedFile
    cells: Cells  # of each of its rows in the table
    kind: ImpactKind
    cuttings: dict[str, Cutting]
    dead_time: float | None = None
    impacts: list[ListedImpact] = field(default_factory=list)
    n_read: int = 0
    ended: bool = False
    fault: str = ""
    measured: set[str] = field(default_factory=set)  # sets of features of which all impacts were measured

    def __post_init__(self) -> None:
        from cgid.identification.training.recordings import ImpactRows

        recording = self.file.recording
        n = -(-(recording.n_samples or 0) // BIN)
        self.lowest = np.zeros((len(recording.channels), n), np.float32)
        self.highest = np.zeros_like(self.lowest)
        self._n_bins, self._last = 0, list[list[Event]]()
        self._pieces: dict[str, list[AnnotatedRows]] = {name: [] for name in self.cuttings}
        self._measuring = {name: ImpactRows(self.file, cutting) for name, cutting in self.cuttings.items()}
        self._stat = self._state()

    @property
    def name(self) -> str:
        """Name of the file, with the channels if these are not all."""
        return channel_name(self.file.annotations[0].path.name, self.cells.get("channel", "1"))

    def has(self, row: Cells) -> bool:
        """Return whether a row of a table is of this recording."""
        own = self.cells.get("channel", "")
        return row["path"] == self.cells["path"] and own in ("", row.get("channel", ""))

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.file.recording.sampling_rate

    @property
    def duration(self) -> float:
        """Duration as far as it is known [s]."""
        return (self.file.recording.n_samples or self.n_read) / self.rate

    def _state(self) -> tuple[int, int]:
        try:
            stat = self.file.annotations[0].path.stat()
        except OSError as error:
            raise NoInput(
                f"{self.file.recording.source}: the recording has gone ({error.strerror}); put it back"
            ) from None
        return stat.st_size, stat.st_mtime_ns

    def require_unchanged(self) -> None:
        """Raise unless the file is as it was opened."""
        if self._state() != self._stat:
            raise BadData(f"{self.file.recording.source}: the recording has changed since it was opened; start again")

    # -- reading once -------------------------------------------------------------------------------------

    def read(self, name: str, stopped: Callable[[], bool]) -> None:
        """Measure the impacts for one set of features, the first time with the waveform; may raise `Stopped`."""
        from cgid.identification.training.recordings import digest_of

        recording, is_first = self.file.recording, not self.ended
        n_channels = len(recording.channels)
        rest = np.empty((n_channels, 0), np.float32)
        # What is listed is heard as in `predict`; what is measured, as in a training with these features.
        measuring = self._measuring[name].ear
        ears = [(measuring, list[Event](), True, is_first)]
        if is_first and measuring.lines is None and self.kind == "vibration":
            listing = Ear(self.rate, n_channels, kind=self.kind, dead_time=self.dead_time)
            ears = [(listing, [], False, True), (measuring, [], True, False)]
        for block in recording.blocks_with_gaps():
            if stopped():
                raise Stopped("the page was closed")
            if is_first:
                rest = self._shown(np.concatenate([rest, block.astype(np.float32)], axis=1))
                self.n_read += block.shape[1]
            for ear, waiting, *takes in ears:
                events, until, _ = ear.feed(block)
                waiting[:] = self._found(waiting + events, until / ear.rate, name, stopped, *takes)
        self.require_unchanged()
        if is_first and rest.shape[1]:
            self._put(rest[:, None, :])
        for ear, waiting, *takes in ears:
            self._found(waiting + ear.feed(None).events, np.inf, name, stopped, *takes)
        if not self.file.digest:  # reading it again takes seconds, so after all that is shown
            self.file = replace(self.file, digest=digest_of(self.file.annotations[0].path))
        self.measured.add(name)
        self.ended = True

    def _shown(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Store the least and largest of each bin, and return the samples behind the last one."""
        n = samples.shape[1] // BIN
        self._put(samples[:, : n * BIN].reshape(len(samples), n, BIN))
        return samples[:, n * BIN :]

    def _put(self, bins: NDArray[np.float32]) -> None:
        at, n = self._n_bins, bins.shape[1]
        self._n_bins += n
        if at + n > self.lowest.shape[1]:
            more = max(at + n, 2 * self.lowest.shape[1]) - self.lowest.shape[1]
            self.lowest, self.highest = (np.pad(one, ((0, 0), (0, more))) for one in (self.lowest, self.highest))
        with np.errstate(all="ignore"):
            self.lowest[:, at : at + n] = np.nan_to_num(np.fmin.reduce(bins, axis=2))
            self.highest[:, at : at + n] = np.nan_to_num(np.fmax.reduce(bins, axis=2))

    def _found(
        self,
        events: list[Event],
        known_until: float,
        name: str,
        stopped: Callable[[], bool],
        measured: bool,
        shown: bool,
    ) -> list[Event]:
        """Take the impacts that are whole, each of any channels at one time, and return the others."""
        from cgid.identification.training.impact_table import interval_rows

        events.sort(key=lambda one: one.onset)
        times = [one.time for one in events]
        n = bisect_left(times, known_until - 2 * SAME_IMPACT)
        while 0 < n < len(times) and times[n] - times[n - 1] <= SAME_IMPACT:
            n -= 1
        taken, left = events[:n], events[n:]
        for k in range(0, n if measured else 0, _AT_ONCE):
            if stopped():
                raise Stopped("the page was closed")
            # The last one of these is of another rock than what is left.
            following = taken[k + _AT_ONCE].onset if k + _AT_ONCE < n else np.inf
            self._pieces[name] += self._measuring[name].feed(taken[k : k + _AT_ONCE], following)
        if not shown:
            return left
        breaks = [k for k in range(1, n) if times[k] - times[k - 1] > SAME_IMPACT]
        rocks = [taken[a:b] for a, b in zip([0, *breaks], [*breaks, n], strict=True)] if n else []
        rows = list(interval_rows([*self._last, *rocks], self.file.unit)) if rocks else []
        if rows and self._last:  # its interval ends where the next begins
            self.impacts[-1].cells["end_s"] = rows.pop(0)["end"]
        self._last = rocks[-1:] or self._last
        for rock, row in zip(rocks, rows, strict=True):
            cells = {"start_s": row["start"], "end_s": row["end"], "label": "", "time_s": row["time_s"]}
            cells |= {"peak": row["peak"], "peak_unit": row["peak_unit"], "flags": row["flags"]}
            loudest = max(rock, key=lambda one: float(np.ptp(one.samples)))
            impact = ListedImpact(
                {**self.cells, **cells}, rock[0].time, loudest.channel, float(row["peak"]), row["flags"]
            )
            self.impacts.append(impact)
        return left

    def pieces(self, name: str) -> list[AnnotatedRows]:
        """Return what was measured so far for one set of features."""
        return list(self._pieces.get(name, ()))

    # -- views --------------------------------------------------------------------------------------------

    def view(self, start: float, end: float, columns: int) -> dict[str, Any]:
        """Return the least and largest sample of each of some columns between two times [s]."""
        columns = min(max(columns, 2), MAX_COLUMNS)
        first, last = max(round(start * self.rate), 0), max(round(end * self.rate), 1)
        step = max((last - first) / columns, 1.0)
        edges = np.unique(np.round(first + step * np.arange(columns + 1)).astype(np.int64))
        low: NDArray[Any]
        high: NDArray[Any]
        if step >= 2 * BIN:
            bins = np.unique(np.minimum(edges // BIN, -(-self.n_read // BIN)))
            low, high = self.lowest[:, : bins[-1]], self.highest[:, : bins[-1]]
            edges = bins * BIN
            at = (bins[:-1]).clip(max=max(low.shape[1] - 1, 0))
        else:
            self.require_unchanged()
            low = high = self._samples(int(edges[0]), min(int(edges[-1]), int(edges[0]) + _READ))
            edges = edges[edges <= edges[0] + low.shape[1]]
            at = (edges - edges[0])[:-1]
        empty = not at.size or not low.shape[1]
        lows = np.zeros((len(low), 0)) if empty else np.minimum.reduceat(low, at, axis=1)
        highs = lows if empty else np.maximum.reduceat(high, at, axis=1)
        names = [channel.name for channel in self.file.recording.channels]
        shown = []
        for name, below, above in zip(names, lows, highs, strict=True):
            scale = max(float(np.abs([below, above]).max(initial=0.0)), 1e-30) / _STEPS
            parts = [np.round(one / scale).astype(int).tolist() for one in (below, above)]
            shown.append({"name": name, "scale": scale, "low": parts[0], "high": parts[1]})
        times = (edges / self.rate).tolist()
        return {"start": times[0], "end": times[-1], "known": self.n_read / self.rate, "channels": shown}

    def _samples(self, first: int, last: int) -> Floats:
        return np.nan_to_num(self.file.recording.samples(first, last).astype(np.float64))

    def detail(self, impact: ListedImpact) -> dict[str, Any]:
        """Return the waveform and the spectrum of an impact in the channel that hears it loudest."""
        self.require_unchanged()
        first = max(round((impact.time - BEFORE) * self.rate), 0)
        samples = self._samples(first, first + round((BEFORE + AFTER) * self.rate))[impact.channel]
        length = 1 << max(int(np.log2(max(len(samples), 2))), 1)
        at = min(max(round(impact.time * self.rate) - first - 2, 0), max(len(samples) - length, 0))
        part = samples[at : at + length]
        power = np.abs(np.fft.rfft((part - part.mean()) * np.hanning(len(part)))) ** 2
        edges = np.unique(np.geomspace(1, max(len(power) - 1, 2), 240).round().astype(int))
        levels = 10 * np.log10(np.maximum(np.add.reduceat(power, edges) / np.diff([*edges, len(power)]), 1e-30))
        scale = max(float(np.abs(samples).max(initial=0.0)), 1e-30) / _STEPS
        return {
            "start": first / self.rate - impact.time,
            "step": 1 / self.rate,
            "unit": self.file.unit,
            "scale": scale,
            "samples": np.round(samples / scale).astype(int).tolist(),
            "frequency": (edges * self.rate / max(len(part), 1)).tolist(),
            "level": np.round(levels - levels.max(), 2).tolist(),
        }

    def sound(self, impact: ListedImpact) -> bytes:
        """Return the sound of an impact as float32 between -1 and 1."""
        self.require_unchanged()
        first = max(round((impact.time - 0.05) * self.rate), 0)
        samples = self._samples(first, first + round(HEARD * self.rate))[impact.channel]
        samples = samples - np.median(samples)
        scale = 0.9 / max(float(np.abs(samples).max(initial=0.0)), 1e-30)
        return bytes((scale * samples).astype("<f4").tobytes())


def read_all(recordings: Sequence[LabelledRecording], name: str, stopped: Callable[[], bool]) -> None:
    """Measure recordings one after the other for one set of features; one that cannot be read has a fault."""
    for one in recordings:
        try:
            if name in one.cuttings and not one.fault:
                one.read(name, stopped)
        except Stopped:
            return
        except Exception as error:  # the other recordings go on
            is_known = isinstance(error, CgidError)
            one.fault = str(error) if is_known else " ".join(f"{type(error).__name__}: {error}".split())
            one.ended = True


def rows_of_all(recordings: Sequence[LabelledRecording], name: str) -> Rows | None:
    """Return what was measured so far for one set of features in recordings; None without a row."""
    from cgid.identification.training.recordings import rows_of

    measured = [(one.file, pieces) for one in recordings if (pieces := one.pieces(name))]
    if not any(np.isfinite(piece.features).all(axis=1).any() for _, pieces in measured for piece in pieces):
        return None
    return rows_of(measured, recordings[0].cuttings[name])
