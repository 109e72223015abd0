"""Frames with one impact each, and the quiet part before it: the common base of pulses and vibrations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import BadData

#: Minimum number of samples of a frame: those of the shortest pulse and one on either side.
MINIMUM_FRAME = 6
#: Largest sample: the squares of larger ones overflow.
LARGEST = 1e150
#: An impact must exceed this many standard deviations of the noise.
DETECTION_LIMIT = 5.0
#: Samples at a limit are equal within this, and are at least this many.
_SAME, _SHARED, _TOLERANCE = 1e-6, 2, 0.01


class ProblemKind(Enum):
    """The rule that a frame or window breaks, so that it cannot be measured."""

    NO_IMPACT = auto()
    CUT_OFF = auto()
    TOO_SHORT = auto()
    NO_SIGNAL = auto()
    NOT_FINITE = auto()


class Problem(NamedTuple):
    """Why a frame or window cannot be measured, and the broken rule, its value and the remedy as text."""

    kind: ProblemKind
    text: str


def frames_of(samples: ArrayLike, pre_trigger: int | None = None) -> NDArray[Any]:
    """Return samples as rows of float32 or float64, (n_signals, n_samples), after checking them."""
    frames = validation.plain("samples", samples)
    if frames.dtype not in (np.float32, np.float64):
        frames = validation.real("samples", frames)
    frames = frames[None] if frames.ndim == 1 else frames
    if frames.ndim != 2 or frames.shape[1] < MINIMUM_FRAME:
        raise BadData(
            f"samples must be rows of at least {MINIMUM_FRAME} samples, got shape {np.shape(samples)}: record longer"
        )
    if frames.size and not -LARGEST <= float(frames.min()) <= float(frames.max()) <= LARGEST:  # also false for nan
        row, column = np.argwhere(~(np.abs(frames, dtype=np.float64) <= LARGEST))[0]
        where = f"signal {row} sample {column}" if len(frames) > 1 else f"sample {column}"
        rule = f"be within +-{LARGEST:g}" if np.isfinite(frames[row, column]) else "be finite"
        raise BadData(f"samples must {rule}, {where} is {frames[row, column]}: cut or repair the recording there")
    if pre_trigger is not None:
        validation.whole("pre_trigger", pre_trigger, 0, frames.shape[1] - 1)
    return frames


def clipped_samples(frames: Floats, shared: int = _SHARED) -> NDArray[np.bool_] | None:
    """Return which samples (n, n_samples) are at the limit of their recorder; None if there are none."""
    # A limit is a value that `shared` samples have in common at the top or the bottom, at least half as large as the
    # other side; the other side then has the same limit, even if only one sample reaches it.
    high, low = frames.max(axis=1), frames.min(axis=1)
    near_top = frames >= (high - _SAME * np.abs(high))[:, None]
    near_bottom = frames <= (low + _SAME * np.abs(low))[:, None]
    beyond, limits = np.zeros(len(frames), bool), np.zeros((2, len(frames)), bool)
    top, bottom = (high, low, near_top, limits[0]), (low, high, near_bottom, limits[1])
    for extreme, other, at, limited in (top, bottom, top):
        limit = (np.count_nonzero(at, axis=1) >= shared) & (np.abs(extreme) >= 0.5 * np.abs(other)) & (high > low)
        limit |= beyond & (np.abs(extreme + other) <= _TOLERANCE * np.abs(extreme))
        beyond |= limit
        limited |= limit
    if not beyond.any():
        return None
    return np.asarray((near_top & limits[0][:, None]) | (near_bottom & limits[1][:, None]))


def no_impact(why: str) -> Problem:
    """Return the problem of a frame without an impact; `why` has the rule, its value and the remedy."""
    return Problem(ProblemKind.NO_IMPACT, f"no impact: {why}")


def constant_signal(value: float) -> Problem:
    """Return the problem of a signal that never changes."""
    return no_impact(f"all samples are {value:g}; check the sensor and its cable")


@dataclass(eq=False, repr=False)
class Frames:
    """Frames with one impact each; baseline and noise are those of the samples before onset."""

    # Without `pre_trigger` (samples before onset), the subclass determines it for each row. An impact must exceed
    # `detection_limit` standard deviations of the noise before onset.

    samples: NDArray[np.floating]  # (n_signals, n_samples)
    sampling_rate: float
    pre_trigger: int | None = None
    remove_baseline: bool = True
    detection_limit: float = DETECTION_LIMIT

    def rows(self, rows: NDArray[np.intp]) -> Self:
        """Return some of the rows with their computed quantities."""
        if np.array_equal(rows, np.arange(len(self.samples))):
            return self
        part = replace(self, samples=self.samples[rows])
        for name, cached in vars(self).items():
            arrays = cached if isinstance(cached, tuple) else (cached,)
            if all(isinstance(array, np.ndarray) and len(array) == len(self.samples) for array in arrays):
                selected = tuple(array[rows] for array in arrays)
                part.__dict__[name] = selected if isinstance(cached, tuple) else selected[0]
        return part

    @cached_property
    def _surely_quiet(self) -> NDArray[np.intp]:
        """Number of samples of each row that are certainly before onset, if there is no `pre_trigger`."""
        raise NotImplementedError

    def _moments(self, count: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return mean and standard deviation of the first samples of each row, 0 if there are fewer than two."""
        before = np.arange(self.samples.shape[1]) < count[:, None]
        mean = np.sum(self.samples, axis=1, where=before, dtype=np.float64) / np.maximum(count, 1)
        square = np.where(before, (self.samples - mean[:, None]) ** 2, 0.0).sum(axis=1, dtype=np.float64)
        enough = count > 1
        return np.where(enough, mean, 0.0), np.where(enough, np.sqrt(square / np.maximum(count - 1, 1)), 0.0)

    @cached_property
    def _quiet(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation before onset."""
        if self.pre_trigger is None:
            return self._moments(self._surely_quiet)
        quiet = self.samples[:, : max(self.pre_trigger, 0)]
        if quiet.shape[1] < 2:
            return np.zeros(len(self.samples)), np.zeros(len(self.samples))
        return quiet.mean(axis=1, dtype=np.float64), quiet.std(axis=1, ddof=1, dtype=np.float64)

    @cached_property
    def offset(self) -> Floats:
        """The amount subtracted from the samples: their mean before onset, of two or more; or 0."""
        return self._quiet[0] if self.remove_baseline else np.zeros(len(self.samples))

    @property
    def noise(self) -> Floats:
        """Standard deviation before onset, 0 if there are fewer than two samples before onset."""
        return self._quiet[1]
