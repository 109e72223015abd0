"""One rate: what a faster recorder gave, as the recorder that a beam was measured with would have given it.

A recorder has the same filters at the same share of its rate. So samples pass the chain of the wanted recorder over
that of their own, an impulse response of some milliseconds, and what lies above half of the wanted rate folds back as
in that recorder. Frames overlap and count from the first sample: the result does not depend on blocks.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import SAME_RATE, Floats
from cgid.measure.frames import clipped_samples
from cgid.measure.modal.beam import Beam

#: The wanted rate is met to this, closer than rates have to agree, by a ratio of small whole numbers.
_CLOSE = SAME_RATE / 2
#: Gain below which a recorder's filters are not undone.
_PASSED = 1e-3
#: The impulse response begins so long before its input and ends so long after it [samples of the wanted rate]; its gain
#: falls to 0 from half of the wanted rate to half of the recorded one.
_BEFORE, _AFTER = 64, 96
#: Length of a frame in samples of the recording, about.
_LENGTH = 1 << 14
#: A missing sample reaches as far as the response is above this share of its peak.
_OF_MISSING = 0.02
#: The same of a sample at a limit of the recorder; what is left of it beyond costs less than further samples without
#: use: of recordings of 51.2 kHz clipped at 60 g .81 are right, with a share of .02 .78 (benchmarks/beam/rates.py).
_OF_LIMIT = 0.6
#: A limit is this many median absolute values away from the median.
_LOUD = 8.0


class OneRate:
    """Samples (n_channels, n) at the rate [Hz] of a recorder become those at `rate`, which agrees with the beam's."""

    def __init__(self, beam: Beam, recorded: float, n_channels: int = 1) -> None:
        own = beam.sampling_rate
        ratios = (Fraction(own / recorded).limit_denominator(1 << k) for k in range(64))
        ratio = next(one for one in ratios if abs(one * recorded / own - 1) < _CLOSE)
        self._up, self._down = ratio.numerator, ratio.denominator
        self.rate = recorded * self._up / self._down
        self._fold = -(-self._down // self._up)
        before, after = (round(n * recorded / own) for n in (_BEFORE, _AFTER))
        n = 8 * (before + after)
        frequency = np.fft.rfftfreq(n, 1 / recorded)
        passed = beam.at(recorded).gain(frequency)
        known = np.abs(passed) > _PASSED
        falls = np.cos(np.pi / 2 * np.clip((2 * frequency - own) / (recorded - own), 0, 1)) ** 2
        response = np.fft.irfft(np.where(known, falls * beam.gain(frequency) / np.where(known, passed, 1), 0), n)
        self._lags = np.arange(-before, after + 1)
        taper = np.minimum(1.0, np.minimum(self._lags + before, after - self._lags) / (before / 2))
        self._response = response[self._lags] * (0.5 - 0.5 * np.cos(np.pi * taper))
        # Of each frame this much at its begin and end is of others.
        self._before, self._after = (-(-n // self._down) * self._down for n in (before, after))
        # A length with small factors.
        self._length = self._down << max(round(np.log2(_LENGTH / self._down)), 3)
        self._hop = self._length - self._before - self._after
        self._rest: NDArray[Any] = np.empty((n_channels, 0), np.float32)
        self._n_fed = self._n_given = 0
        self._gains: dict[int, NDArray[np.complex128]] = {}

    def feed(self, block: NDArray[Any]) -> NDArray[Any]:
        """Take the next samples, nan where missing, and return those that are known at the other rate."""
        if not self._n_fed:
            self._rest = np.repeat(block[:, :1], self._after, axis=1)
        self._n_fed += block.shape[1]
        rest = np.concatenate([self._rest, block], axis=1)
        done = [rest[:, :0]]
        while rest.shape[1] >= self._length:
            done.append(self._brought(rest[:, : self._length]))
            rest = rest[:, self._hop :]
        self._rest = rest.copy() if len(done) > 1 else rest
        self._n_given += (len(done) - 1) * self._hop * self._up // self._down
        return np.concatenate(done, axis=1)

    def finish(self) -> NDArray[Any]:
        """Return the samples that are left at the end of the recording."""
        if not self._n_fed:
            return self._rest
        left = -(-self._n_fed * self._up // self._down) - self._n_given
        rest = np.pad(self._rest, ((0, 0), (0, self._hop + self._before)), mode="edge")
        length = -(-left // self._up) * self._down + self._before + self._after
        return self._brought(rest[:, :length])[:, :left]

    def frames(self, frames: NDArray[Any]) -> Floats:
        """Return frames (n, n_samples) at the other rate."""
        n = frames.shape[1]
        left = n * self._up // self._down
        more = -(-n // self._down) * self._down - n + self._before
        return self._brought(np.pad(frames, ((0, 0), (self._after, more)), mode="edge"))[:, :left]

    def _brought(self, samples: NDArray[Any]) -> NDArray[Any]:
        """Return what lies `_after` behind the begin and `_before` before the end of samples (n_channels, n)."""
        n = samples.shape[1]
        first, last = self._after * self._up // self._down, (n - self._before) * self._up // self._down
        at = np.arange(first, last) * self._down // self._up
        missing = ~np.isfinite(samples)
        lacking = np.flatnonzero(missing.any(axis=1)).tolist()
        unreadable = np.where(np.isinf(samples).any(axis=1), np.inf, np.nan)  # which is no gap
        samples = samples.copy() if lacking else samples
        for row in lacking:
            none, there = np.flatnonzero(missing[row]), np.flatnonzero(~missing[row])
            samples[row, none] = np.interp(none, there, samples[row, there]) if there.size else 0.0
        n_out = n // self._down * self._up * self._fold
        spectrum = np.fft.rfft(samples, axis=1) * self._gain(n)
        out = (np.fft.irfft(spectrum, n_out, axis=1)[:, :: self._fold] * (n_out / n))[:, first:last]
        out = out.astype(samples.dtype)
        clipped = clipped_samples(samples)
        if clipped is None:
            clipped = np.zeros_like(samples, bool)
        for row in np.flatnonzero(clipped.any(axis=1)).tolist():
            apart = samples[row] - np.median(samples[row])
            # Of noise, the largest may be alike.
            loud = clipped[row] & (np.abs(apart) > _LOUD * np.median(np.abs(apart)))
            for value in np.unique(samples[row, loud]).tolist():
                is_limit = loud & (samples[row] == value)
                (np.minimum if apart[is_limit][0] > 0 else np.maximum)(out[row], value, out=out[row])
                out[row, self._near(is_limit, _OF_LIMIT)[at]] = value
        for row in lacking:
            out[row, self._near(missing[row], _OF_MISSING)[at]] = unreadable[row]
        return np.asarray(out)

    def _near(self, which: NDArray[np.bool_], share: float) -> NDArray[np.bool_]:
        """Return the samples that the response brings so much of these to, and themselves."""
        strong = self._lags[np.abs(self._response) > share * np.abs(self._response).max()]
        first, last = min(int(strong[0]), 0), max(int(strong[-1]), 0)
        count = np.cumsum(np.pad(which, (last + 1, -first)))
        return np.asarray(count[last - first + 1 :] > count[: -(last - first + 1)])

    def _gain(self, n: int) -> NDArray[np.complex128]:
        """Return the gain of `n` samples."""
        if n not in self._gains:
            response = np.zeros(n)
            response[self._lags] = self._response
            self._gains[n] = np.fft.rfft(response)
        return self._gains[n]
