"""The current state of each support, for outputs that are polled (Modbus, Prometheus, the page)."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid.plant.output import since

if TYPE_CHECKING:
    from cgid.plant.output import Output

#: States of a support; unknown before its first gangue fraction.
NOTHING, OPEN, SHUT = 0, 1, 2
STATES = ("unknown", "open", "shut")
#: Numbers of gangue fractions and predictions on the page.
_SHARES, _ANSWERS = 300, 200
#: Length of waveforms [s], width of their bins [s], and maximum number of channels with waveforms.
SHOWN_TIME, BIN_TIME, MAX_WAVEFORMS = 5.0, 0.005, 16
#: The largest sample of a waveform is this integer.
_PIXELS = 10_000


@dataclass
class Support:
    """The last gangue fraction and decision of one support; `impacts` and `unknown` are those of its window."""

    state: int = NOTHING
    share: float = math.nan
    low: float = math.nan
    high: float = math.nan
    impacts: int = 0
    unknown: int = 0
    shared_at: float | None = None
    turned_at: float | None = None
    labels: Counter[str] = field(default_factory=Counter)
    turns: Counter[str] = field(default_factory=Counter)
    shares: deque[list[float | None]] = field(default_factory=lambda: deque(maxlen=_SHARES))
    marks: deque[list[Any]] = field(default_factory=lambda: deque(maxlen=_SHARES))
    answers: deque[list[Any]] = field(default_factory=lambda: deque(maxlen=_ANSWERS))

    def take(self, kind: str, record: dict[str, Any]) -> None:
        """Update from a prediction, a gangue fraction or a switch."""
        if kind in ("impact", "window"):
            self.labels[record["label"]] += 1
            self.answers.append([record["time_s"], record["label"]])
            return
        self.share, self.low, self.high = (_number(record[name]) for name in ("gangue_share", "low", "high"))
        if kind == "share":
            self.impacts, self.unknown, self.shared_at = record["impacts"], record["unknown"], time.monotonic()
            self.state = self.state or (OPEN if self.impacts else NOTHING)
            self.shares.append([record["to_s"], record["gangue_share"], record["low"], record["high"]])
        else:
            self.state, self.turned_at = (SHUT if kind == "shut" else OPEN), time.monotonic()
            self.turns[kind] += 1
            self.marks.append([record["time_s"], kind])

    def content(self) -> dict[str, Any]:
        """Return the state in words, the gangue fraction and the counts, for JSON."""
        share = {"gangue_share": self.share, "low": self.low, "high": self.high}
        fields = {name: None if math.isnan(value) else value for name, value in share.items()}
        return {"state": STATES[self.state], **fields, "impacts": self.impacts, "unknown": self.unknown}


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
        self._beaten_at: float | None = None
        self._behind: Callable[[], float] = lambda: 0.0
        self._lock = Lock()

    def begin(
        self,
        source: str,
        channels: Sequence[str],
        rows: Sequence[str],
        unit: str,
        threshold: float | None,
        behind: Callable[[], float],
    ) -> None:
        """Set the monitored channels."""
        with self._lock:
            self.source, self.unit, self.rows, self.threshold = source, unit, tuple(rows), threshold
            self._behind = behind
            self.supports = {name: Support() for name in channels}

    def beat(self, duration: float) -> None:
        """Record a block of this duration [s]."""
        with self._lock:
            self.beats += 1
            self.time += duration
            self._beaten_at = time.monotonic()

    def take(self, record: dict[str, Any]) -> None:
        """Update from one line of JSON."""
        kind = record["kind"]
        if kind in ("impact", "window", "share", "shut", "open"):
            with self._lock:
                self.supports.setdefault(record["channel"], Support()).take(kind, record)

    @property
    def behind(self) -> float:
        """Delay of the predictions after the stream [s]."""
        return self._behind()

    @property
    def age(self) -> float:
        """Time since the last block [s]; infinite before the first."""
        return since(self._beaten_at)

    def read(self, use: Callable[[dict[str, Support]], Any]) -> Any:
        """Return the result of a function of the supports, under the lock."""
        with self._lock:
            return use(self.supports)

    def page(self) -> dict[str, Any]:
        """Return the content of the page, for JSON."""
        supports = self.read(
            lambda all_: [
                {
                    "name": name,
                    **one.content(),
                    "labels": dict(one.labels),
                    "turns": list(one.marks),
                    "shares": list(one.shares),
                    "answers": list(one.answers),
                }
                for name, one in all_.items()
            ]
        )
        return {
            "source": self.source,
            "unit": self.unit,
            "threshold": self.threshold,
            "beats": self.beats,
            "time": self.time,
            "age": self.age if self.beats else None,
            "behind": self.behind,
            "ended": self.ended,
            "supports": supports,
            "outlets": [output.status() for output in self.outputs],
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


def _number(value: float | None) -> float:
    return math.nan if value is None else value
