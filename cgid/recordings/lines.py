"""Lines taken out: the tones of motors, pumps and gears are subtracted from a recording, and impacts are not.

A recording is cut into frames of half a second that overlap by a half, with windows that sum to one. In each frame the
samples are clipped at a few standard deviations, so that impacts count little. A line is where the mean of the last
frames, or this one alone, stands far above its neighbours on both sides; most modes of a beam are broader. Whether a
machine runs, two seconds tell: its tone is steady, and its phase goes on from frame to frame. The ring-down of a narrow
mode decays between impacts, and each impact begins another phase. From then on the bands around the lines are taken
back to samples and subtracted, and what is left is clipped again, closer now. So a sample is known as soon as its
second frame is: after half a second. Frames count from the first sample, so the result does not depend on the blocks.
Without a machine, samples stay as they are, unless one is known to run from the start.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats

#: Length of a frame [s].
FRAME_TIME = 0.5
#: Weight of the latest frame in the mean amplitude.
_LATEST = 0.25
#: A line stands this many times above the median power around it (`_AROUND`, [Hz]), and so many times above what is
#: beside it ([Hz]), but for one of these in rank: in the latest frame, or in the mean of at least so many frames.
_CONTRAST_AROUND, _AROUND, _BESIDE, _RANK = 8.0, 64.0, (6.0, 10.0), 1
_CONTRAST_NOW, _CONTRAST, _N_MEAN = 300.0, 32.0, 3
#: It is not below this frequency, and what is as near as this goes with it [Hz].
_LOWEST, _WIDTH = 20.0, 4.0
#: A line is a tone where in so many successive frames (2.25 s) its power is steady, as all but one have this share of
#: the mean at least, and so is the change of its advance of phase from frame to frame, by the length of its mean
#: direction; with tones it is .99. Without tones, `caving` has one in 0 of 48 minutes with dampings of 2 to .1 %;
#: forty modes, all as loud, on which rocks fall for 40 s, in 0 of 24 with .5 % or more, 8 of 12 with .2 %, 12 of 12
#: with .1 % (benchmarks/beam/lines.py --heard). With .99 it is 2 of 16, but a hum of .1 g is heard 5 s later; if it
#: must be seen again after 1 and 2 s, 0 of 16 and 4 s later.
_N_STEADY, _STEADY, _COHERENT = 8, 0.7, 0.96
#: A tone that wanders keeps no phase, but the power around it (`_WIDTH`): this share of its mean in all but one of so
#: many frames (3.25 s), or of `_N_STEADY` where so many lines, this far apart [Hz], do. One tone of 1 g or more does;
#: no mode of those streams without tones does, nor three of them.
_LASTING, _N_LASTING = 0.85, 12
_N_DISTINCT, _APART = 3, 24.0
#: After a minute of frames without any tone, no machine runs.
_N_SILENT = 240
#: Where a machine runs, whether it still does is looked at after so many frames (a second).
_AGAIN = 4
#: In a recording with a machine from the start, lines go from the frame that begins so late on [s].
HEARD_AFTER = (_N_STEADY - 1) * FRAME_TIME / 2
#: Lines with less than this share of the power are not worth it.
_SHARE = 0.05
#: Samples are clipped at so many standard deviations, in so many rounds, of which the later ones are only for lines
#: with more than this share of the power; there, what is found counts more, because clipped samples lack it.
_CLIP, _ROUNDS, _LOUD, _MORE = 3.0, 2, 0.3, 1.5
#: Median of the absolute value over the standard deviation, of normal noise.
_MEDIAN = 0.6745
#: A frame with a larger share of missing samples, or of those at a limit of the recorder, is left as it is, and what
#: follows begins anew; so does a channel whose level changes by this factor from one frame to the next.
_MISSING, _LIMITED, _JUMP = 0.25, 0.1, 4.0
#: At the ends, where only one window is there, an estimate is divided by the window, at least by this.
_LEAST_WINDOW = 0.1
#: What is left is nothing below this share of the lines, the error of their numbers: impacts would be found in it.
_NOTHING = 1e-6
#: Largest sample that can be squared in comfort; a power of nothing.
_LARGEST, _TINY = 1e15, 1e-300
#: Lines are unsteady where two frames differ about them by more than this many standard deviations of the rest, or
#: where the strongest moves by more than this [Hz] in so many frames (4 s), in steps of at most as much. A
#: channel is told when that holds in so many of so many latest frames (a minute).
_DISAGREE, _MOVES, _N_MOVING, _UNSTEADY, _N_RECENT = 4.0, 8.0, 16, 3, 240


@dataclass
class _Channel:
    """What is known of a channel: mean amplitude by frequency, latest spectra, level, the last lines, how steady."""

    mean: Floats | None = None
    n_frames: int = 0
    spectra: deque[NDArray[np.complex64]] = field(default_factory=lambda: deque(maxlen=_N_LASTING))
    silent: float = np.inf  # frames since the last tone
    tone: float = 0.0  # the strongest when lines were first taken out [Hz]; nan once told
    is_out: bool = False  # whether lines were taken out since the last silence
    heard: float = np.nan  # begin of the first frame without them [s]; nan once told
    level: float = 0.0
    tail: Floats | None = None
    strongest: deque[float] = field(default_factory=lambda: deque(maxlen=_N_MOVING))
    unsteady: deque[bool] = field(default_factory=lambda: deque(maxlen=_N_RECENT))
    is_told: bool = False

    def forget(self) -> None:
        """Begin anew with the next frame."""
        self.mean, self.n_frames = None, 0
        self.spectra.clear()

    def hears(self, spectrum: NDArray[np.complex128], lines: NDArray[np.intp], width: int, apart: int) -> bool:
        """Take the spectrum of the next frame and its lines; return whether a machine runs.

        A line is followed back from frame to frame by up to `width` frequencies; distinct ones are `apart`.
        """
        self.spectra.append(spectrum.astype(np.complex64))
        self.silent += 1
        if lines.size and len(self.spectra) >= _N_STEADY and self.silent >= _AGAIN:
            near, at = np.arange(-width, width + 1), np.unique(lines)
            tone = np.empty((len(self.spectra), at.size), np.complex64)
            power = np.empty(tone.shape)
            distinct = at
            for number in reversed(range(len(tone))):
                found = self.spectra[number].take(at[:, None] + near, mode="clip")
                best = np.abs(found).argmax(axis=1)
                at = at + near[best]
                # The phase in the middle of the frame does not depend on the frequency.
                tone[number] = found[np.arange(at.size), best] * (1 - 2 * (at % 2))
                around = self.spectra[number].take(at[:, None] + near, mode="clip")
                power[number] = np.square(np.abs(around)).sum(axis=1)
            tone, lasting = tone[-_N_STEADY:], distinct[_least(power[-_N_STEADY:]) >= _LASTING]
            n_distinct = np.count_nonzero(np.diff(lasting, prepend=-apart) >= apart)
            size, advance = np.square(np.abs(tone)), tone[1:] * tone[:-1].conj()
            change = np.exp(1j * np.angle(advance[1:] * advance[:-1].conj()))
            alike = 2 * np.abs(np.sum(change * np.sqrt(size[2:] * size[:-2]), axis=0))
            is_tone = (_least(size) >= _STEADY) & (alike >= _COHERENT * (size[2:] + size[:-2]).sum(axis=0))
            if len(power) == _N_LASTING:
                is_tone |= _least(power) >= _LASTING
            if is_tone.any() or n_distinct >= _N_DISTINCT:
                self.silent = 0
        self.is_out = self.is_out and self.silent <= _N_SILENT
        return self.silent <= _N_SILENT

    def moves(self, frequency: float) -> bool:
        """Take the frequency of the strongest line [Hz] of the next frame; return whether it moves."""
        if self.strongest and abs(frequency - self.strongest[-1]) > _MOVES:
            self.strongest.clear()
        self.strongest.append(frequency)
        return max(self.strongest) - min(self.strongest) > _MOVES


class _Found(NamedTuple):
    """The lines of a frame under its window, (length,), the deviation of the rest, and the strongest line [Hz]."""

    lines: Floats
    deviation: float
    strongest: float


class Lines:
    """Take lines out of the blocks of a recording; they come out up to `FRAME_TIME` later, in other blocks."""

    def __init__(self, n_channels: int, sampling_rate: float, *, from_begin: bool = False) -> None:
        self._from_begin = from_begin  # a machine is known to run
        self._sampling_rate, self._begin = sampling_rate, 0  # of the next frame
        # A length with small factors.
        step = 2 ** max(int(np.log2(FRAME_TIME * sampling_rate)) - 4, 2)
        self.length = max(int(FRAME_TIME * sampling_rate) // step * step, 16)
        self._hop = self.length // 2
        self._bin_width = bin_width = sampling_rate / self.length
        self._middle = slice(self._hop // 2, -(self._hop // 2))
        self._window = np.square(np.sin(np.pi * np.arange(self.length) / self.length))
        self._first = max(int(np.ceil(_LOWEST / bin_width)), 1)
        self._around = max(round(_AROUND / bin_width), 8)
        near, far = (max(round(value / bin_width), number) for value, number in zip(_BESIDE, (2, 3), strict=True))
        self._beside = np.concatenate([np.arange(-far, 1 - near), np.arange(near, far + 1)])
        self._width, self._apart = max(round(_WIDTH / bin_width), 1), round(_APART / bin_width)
        self._channels = [_Channel() for _ in range(n_channels)]
        self._rest: NDArray[Any] = np.empty((n_channels, 0), np.float32)

    def feed(self, block: NDArray[Any]) -> NDArray[Any]:
        """Take the next samples (n_channels, n), nan where missing; return those that are known without their lines."""
        rest = np.concatenate([self._rest, block], axis=1)
        done = [rest[:, :0]]
        while rest.shape[1] >= self.length:
            done.append(self._next(rest[:, : self.length]))
            rest = rest[:, self._hop :]
        self._rest = rest.copy() if len(done) > 1 else rest  # a view would keep a long block in memory
        return np.concatenate(done, axis=1)

    def finish(self) -> NDArray[Any]:
        """Return the samples that are left at the end of the recording."""
        return self._last(self._rest)

    def told(self) -> list[int]:
        """Return the channels whose lines are unsteady, once each."""
        rows = [row for row, one in enumerate(self._channels) if not one.is_told and sum(one.unsteady) >= _UNSTEADY]
        for row in rows:
            self._channels[row].is_told = True
        return rows

    def tones(self) -> dict[int, float]:
        """Return the strongest tone [Hz] of channels in which a machine was heard, once each."""
        found = {row: one.tone for row, one in enumerate(self._channels) if one.tone > 0}
        for row in found:
            self._channels[row].tone = np.nan
        return found

    def heard(self) -> dict[int, float]:
        """Return until when [s] channels had tones because no machine was heard yet, once for each that is heard."""
        found = {row: one.heard for row, one in enumerate(self._channels) if one.heard > 0}
        for row in found:
            self._channels[row].heard = np.nan
        return found

    def _next(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return the first half of frames (n_channels, length) without lines."""
        out = frames[:, : self._hop].copy()
        rising, falling = self._window[: self._hop], self._window[self._hop :]
        both = np.square(rising * falling).sum()
        for samples, one, left in zip(frames, self._channels, out, strict=True):
            before, is_new = one.tail, one.mean is None
            found = self._lines_of(samples, one)
            if found is None:
                one.tail = None
                one.unsteady.append(False)
                if before is not None:
                    left -= before / np.maximum(falling, _LEAST_WINDOW) if one.mean is None else before
                continue
            now, one.tail = found.lines[: self._hop], found.lines[self._hop :]
            if before is not None:
                left -= before + now
            else:
                left -= now / np.maximum(rising, _LEAST_WINDOW) if is_new else now
            apart = now * falling - (0.0 if before is None else before) * rising
            nothing = _NOTHING * float(np.abs(found.lines).max())
            differs = np.vdot(apart, apart) > np.square(_DISAGREE * max(found.deviation, nothing)) * both
            _level(left, nothing)
            one.unsteady.append(not is_new and bool(one.moves(found.strongest) or differs))
            if not (one.is_out or self._from_begin):
                one.is_out, one.heard = True, self._begin / self._sampling_rate
        self._begin += self._hop
        return out

    def _last(self, rest: NDArray[Any]) -> NDArray[Any]:
        """Return the rest of the recording, for which there is one window at most."""
        out = rest.copy()
        for one, left in zip(self._channels, out, strict=True):
            if one.tail is not None:
                n = min(self._hop, left.size)
                left[:n] -= (one.tail / np.maximum(self._window[self._hop :], _LEAST_WINDOW))[:n]
        return out

    def _lines_of(self, samples: NDArray[Any], one: _Channel) -> _Found | None:
        """Return the lines of a frame (length,); None without any."""
        there, missing = samples, None
        if not -_LARGEST <= samples.min() <= samples.max() <= _LARGEST:
            missing = ~(np.abs(samples) <= _LARGEST)
            there = samples[~missing]
            if missing.mean() > _MISSING:
                one.forget()
                return None
        centre = np.partition(there, there.size // 2)[there.size // 2]
        if missing is not None:
            samples = np.where(missing, centre, samples)
        limits = (samples == samples.max()) | (samples == samples.min())
        n_limited = np.count_nonzero(limits)
        if n_limited > _LIMITED * self.length:
            one.forget()
            return None
        left = (samples.astype(np.float64) - centre) * self._window
        lines: Floats | None = None
        spectrum: NDArray[np.complex128] = np.zeros(self._hop + 1, np.complex128)
        for number in range(_ROUNDS):
            rest = left if lines is None else left - lines
            if missing is not None:
                rest[missing] = 0.0
            sizes = np.abs(rest[self._middle])
            sizes /= self._window[self._middle]
            sizes.partition(sizes.size // 2)
            deviation = float(sizes[sizes.size // 2]) / _MEDIAN
            if number == 0:
                level = deviation
                if not one.level / _JUMP <= level <= one.level * _JUMP:
                    one.forget()
                one.level = level
            limit = _CLIP * deviation * self._window
            spectrum += np.fft.rfft(np.maximum(np.minimum(rest, limit), -limit)) * (_MORE if number else 1.0)
            now = np.square(spectrum.real) + np.square(spectrum.imag)
            size = np.sqrt(now)
            mean = size if one.mean is None else one.mean + max(_LATEST, 1 / (one.n_frames + 1)) * (size - one.mean)
            found = self._lines(now, np.square(mean) if one.n_frames >= _N_MEAN else None)
            if number == 0 and not (one.hears(spectrum, found, self._width, self._apart) or self._from_begin):
                break
            bands = self._bands(found)
            share = now[bands].sum() / max(now[self._first :].sum(), _TINY)
            if share < _SHARE:
                break
            spectrum[~bands] = 0.0
            lines = np.fft.irfft(spectrum, self.length)
            strongest = float(np.argmax(now * bands)) * self._bin_width
            one.tone = one.tone or strongest
            if share < _LOUD:
                break
        one.mean, one.n_frames = mean, one.n_frames + 1
        if lines is None:
            return None
        if n_limited > 2:  # at a limit of the recorder, samples must stay equal
            lines[limits & (np.abs(left) > _CLIP * level * self._window)] = 0.0
        return _Found(lines, deviation, strongest)

    def _bands(self, lines: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which frequencies belong to lines."""
        width = self._width
        bands = np.zeros(self._hop + 1 + 2 * width, bool)
        bands[lines[:, None] + np.arange(2 * width + 1)] = True
        bands[: width + self._first] = False
        return bands[width:-width]

    def _lines(self, now: Floats, mean: Floats | None) -> NDArray[np.intp]:
        """Return the frequencies of lines, by the power of a frame and that of the mean amplitude."""
        found = self._above(now, _CONTRAST_NOW)
        return found if mean is None else np.concatenate([found, self._above(mean, _CONTRAST)])

    def _above(self, power: Floats, contrast: float) -> NDArray[np.intp]:
        """Return the frequencies whose power stands so far above that of others around and beside them."""
        n = self._around
        parts = power[: power.size // n * n].reshape(-1, n)
        typical = np.partition(parts, n // 2, axis=1)[:, n // 2]
        high = np.flatnonzero(parts > _CONTRAST_AROUND * typical[:, None])
        high = high[high >= self._first]
        beside = power.take(high[:, None] + self._beside, mode="clip")
        return high[power[high] > contrast * np.partition(beside, _RANK, axis=1)[:, _RANK]]


def _least(power: Floats) -> Floats:
    """Return the share of its mean power that each line keeps in all but one of the frames, (n_frames, n_lines)."""
    return np.asarray(np.partition(power, 1, axis=0)[1] / power.mean(axis=0))


def _level(samples: NDArray[Any], nothing: float) -> None:
    """Replace, in place, what differs by at most `nothing` from the median by it, in steps of a power of two."""
    step = 2.0 ** np.ceil(np.log2(max(nothing, _TINY)))
    middle = np.round(np.partition(samples, samples.size // 2)[samples.size // 2] / step) * step
    samples[np.abs(samples - middle) <= step] = middle
