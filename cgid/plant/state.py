"""The record of each support at this moment, for every output: MQTT, Modbus, Prometheus, commands and the page."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cgid.identification.prediction.fraction import Share
from cgid.identification.prediction.support import Decision, Ground, SupportState
from cgid.pages.server import since

if TYPE_CHECKING:
    from cgid.plant.output import Output

#: Lines that contain the record of a support.
RECORDS = ("share", "state", "shut", "open")
#: Numbers of gangue fractions and predictions on the page.
_SHARES, _ANSWERS = 300, 200
#: Length of waveforms [s], width of their bins [s], and maximum number of channels with waveforms.
SHOWN_TIME, BIN_TIME, MAX_WAVEFORMS = 5.0, 0.005, 16
#: The largest sample of a waveform is this integer.
_PIXELS = 10_000

Result = TypeVar("Result")
#: The record of a support for JSON: `SupportState.content()` and `time_s`.
Record = dict[str, Any]


@dataclass
class Support:
    """The last record of one support, and its history."""

    record: Record
    labels: Counter[str] = field(default_factory=Counter)
    turns: Counter[str] = field(default_factory=Counter)
    shares: deque[list[float | None]] = field(default_factory=lambda: deque(maxlen=_SHARES))
    marks: deque[list[Any]] = field(default_factory=lambda: deque(maxlen=_SHARES))
    answers: deque[list[Any]] = field(default_factory=lambda: deque(maxlen=_ANSWERS))
    #: What stands, its lines by kind, in order of time.
    findings: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, channel: str) -> Support:
        """Return a support of which nothing is known."""
        nothing = Share(time=0.0, start=0.0, share=math.nan, low=0.0, high=1.0, n_impacts=0, channel=channel)
        content = SupportState(time=0.0, share=nothing).content()
        unknown = {name: None for name, value in content.items() if isinstance(value, float) and math.isnan(value)}
        return cls({"time_s": 0.0, **content, **unknown})

    def take(self, record: dict[str, Any]) -> None:
        """Update from a prediction or a line with the record."""
        kind = record["kind"]
        if kind not in RECORDS:
            self.labels[record["label"]] += 1
            self.answers.append([record["time_s"], record["label"]])
            return
        self.record = {name: record[name] for name in self.record}
        if kind == "share":
            self.shares.append([record["to_s"], record["gangue_share"], record["low"], record["high"]])
        elif kind != "state":
            self.turns[kind] += 1
            self.marks.append([record["time_s"], kind])

    def find(self, record: dict[str, Any]) -> None:
        """Take a line of a finding of this support: it begins, or it is over."""
        if record["end_s"] is None:
            self.findings[record["finding"]] = record
        else:
            self.findings.pop(record["finding"], None)

    @property
    def turned(self) -> float | None:
        """Time of the last SHUT or OPEN in the stream [s]; None before the first."""
        return self.marks[-1][0] if self.marks else None


def age(record: Record, moment: float | None) -> float:
    """Return the time from a moment of the stream to that of the record [s]; nan if the moment is not known."""
    return math.nan if moment is None else max(record["time_s"] - moment, 0.0)


def stamped(record: Record) -> Record:
    """Return a record with the time of day of its writing."""
    return record | {"wall_time": datetime.now(UTC).isoformat(timespec="milliseconds")}


class PlantState:
    """All supports of a stream by channel, and whether the stream is alive; several threads may read it."""

    def __init__(self) -> None:
        self.supports: dict[str, Support] = {}
        self.source, self.unit, self.rows = "", "", ()  # type: tuple[str, str, tuple[str, ...]]
        self.threshold: float | None = None
        self.beats, self.time = 0, 0.0
        self.ended = False
        self.outputs: list[Output] = []
        self.waveform: Waveform | None = None
        self._beaten_at = time.monotonic()
        self._behind: Callable[[], float] = lambda: 0.0
        self._waited: Callable[[], float] = lambda: since(self._beaten_at)
        self._blind_after, self._delay = math.inf, 0.0
        self._lock = Lock()

    def begin(
        self,
        *,
        source: str,
        channels: Sequence[str],
        rows: Sequence[str],
        unit: str,
        threshold: float | None,
        behind: Callable[[], float] | None = None,
        blind_after: float = 5.0,
        waited: Callable[[], float] | None = None,
    ) -> None:
        """Set the supports (`channels`), the rows of the blocks, and a function for the delay [s], if it is known.

        A stream has stopped that has been waited for longer than `blind_after` [s], by default since its last block.
        """
        with self._lock:
            self.source, self.unit, self.rows, self.threshold = source, unit, tuple(rows), threshold
            self._behind, self._blind_after = behind or self._behind, blind_after
            self._waited = waited or self._waited
            self._beaten_at = time.monotonic()
            self.supports = {name: Support.of(name) for name in channels}

    def beat(self, duration: float) -> None:
        """Record a block of this duration [s]."""
        with self._lock:
            self.beats += 1
            self.time += duration
            self._beaten_at, self._delay = time.monotonic(), self._behind()

    def take(self, record: dict[str, Any]) -> None:
        """Update from one line of JSON."""
        if record["kind"] == "finding" and not record["note"]:
            with self._lock:
                for name, support in self.supports.items():
                    if not record["channels"] or not {name, *name.split("+")}.isdisjoint(record["channels"]):
                        support.find(record)
        if record["kind"] in ("impact", "window", *RECORDS):
            channel = record["channel"]
            with self._lock:
                if channel not in self.supports:
                    self.supports[channel] = Support.of(channel)
                self.supports[channel].take(record)

    @property
    def behind(self) -> float:
        """Delay of the predictions after the stream [s]."""
        return self._behind()

    @property
    def age(self) -> float:
        """Time since the last block [s]; infinite before the first."""
        return since(self._beaten_at) if self.beats else math.inf

    @property
    def stopped(self) -> str:
        """Why the stream has stopped, in words; empty while blocks arrive."""
        if self.ended:
            return "the stream has ended"
        if (waited := self._waited()) > self._blind_after:
            return f"no samples have arrived for {waited:.0f} s"
        # What is known is as old as that.
        late = self.behind
        return f"the predictions are {late:.0f} s behind" if late > self._blind_after else ""

    def read(self, use: Callable[[list[tuple[Support, Record]]], Result]) -> Result:
        """Return the result of a function of each support and its record at this moment, under the lock."""
        with self._lock:
            return use([(support, self._now(support.record)) for support in self.supports.values()])

    def records(self) -> list[Record]:
        """Return the record of each support at this moment."""
        with self._lock:
            return [self._with_findings(support) for support in self.supports.values()]

    def record(self, channel: str) -> Record:
        """Return the record of a support at this moment."""
        with self._lock:
            return self._with_findings(self.supports[channel])

    def _with_findings(self, support: Support) -> Record:
        return self._now(support.record) | {"findings": list(support.findings)}

    def _now(self, record: Record) -> Record:
        """Return a record at this moment of the stream, by the clock: a decision never outlives its ground."""
        # Without a new line, a channel that is not blind was so for less than `blind_after`.
        sound, floor = record["last_sound_s"], self.time - self._blind_after
        if floor > 0 and record["ground"] not in (Ground.BLIND, Ground.STOPPED):
            sound = floor if sound is None else max(sound, floor)
        now = max(self.time + self._delay + since(self._beaten_at), record["time_s"])
        record = record | {"time_s": now, "last_sound_s": sound}
        if stopped := self.stopped:
            record |= {"ground": str(Ground.STOPPED), "ground_since_s": self.time, "reason": stopped}
        if record["ground"] != Ground.SEEN:
            record["decision"] = str(Decision.NONE)
        return record

    def page(self) -> dict[str, Any]:
        """Return the content of the page, for JSON; `written` is the time of day [s since 1970]."""
        supports = self.read(
            lambda all_: [
                {
                    **record,
                    "labels": dict(one.labels),
                    "turns": list(one.marks),
                    "shares": list(one.shares),
                    "answers": list(one.answers),
                    "findings": [told["message"] for told in one.findings.values()],
                }
                for one, record in all_
            ]
        )
        return {
            "written": time.time(),
            "source": self.source,
            "unit": self.unit,
            "threshold": self.threshold,
            "beats": self.beats,
            "time": self.time,
            "age": self.age if self.beats else None,
            "behind": self.behind,
            "ended": self.ended,
            "supports": supports,
            "outlets": [status for output in self.outputs for status in output.statuses()],
            "waveform": None if self.waveform is None else self.waveform.content(self.rows),
        }


class Waveform:
    """Smallest and largest sample of the last seconds in short bins, for the first channels."""

    def __init__(self) -> None:
        self._bins: deque[tuple[int, NDArray[Any], NDArray[Any]]] = deque(maxlen=round(SHOWN_TIME / BIN_TIME))
        self._seen = 0
        self._lock = Lock()

    def add(self, block: NDArray[Any], sampling_rate: float) -> None:
        """Add the next samples (n_channels, n_samples)."""
        length = max(round(BIN_TIME * sampling_rate), 1)
        shown, size = block[:MAX_WAVEFORMS], block.shape[1]
        starts = np.arange(-(self._seen % length), size, length)
        first = self._seen // length
        self._seen += size
        borders = np.maximum(starts, 0)
        low, high = (ufunc.reduceat(shown, borders, axis=1).T for ufunc in (np.fmin, np.fmax))
        with self._lock:
            for number, (lowest, highest) in enumerate(zip(low, high, strict=True), start=first):
                if self._bins and self._bins[-1][0] == number:
                    _, before_low, before_high = self._bins.pop()
                    lowest, highest = np.fmin(lowest, before_low), np.fmax(highest, before_high)
                self._bins.append((number, lowest, highest))

    def content(self, rows: Sequence[str]) -> dict[str, Any]:
        """Return begin and width of the bins [s], and smallest and largest samples of each channel, as integers."""
        with self._lock:
            bins = list(self._bins)
        if not bins:
            return {"start": 0.0, "step": BIN_TIME, "channels": []}
        # A bin without a sample is drawn at 0.
        low, high = (np.nan_to_num(np.stack([one[k] for one in bins], axis=1)) for k in (1, 2))
        scales = np.maximum(np.maximum(high.max(axis=1), -low.min(axis=1)) / _PIXELS, np.finfo(np.float32).tiny)
        low, high = (np.rint(values / scales[:, None]).astype(int) for values in (low, high))
        channels = [
            {"name": name, "scale": float(scales[row]), "low": low[row].tolist(), "high": high[row].tolist()}
            for row, name in enumerate(rows[: len(low)])
        ]
        return {"start": bins[0][0] * BIN_TIME, "step": BIN_TIME, "channels": channels}
