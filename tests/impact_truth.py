"""Noiseless caving streams and the truth of their impacts, for tests and `benchmarks/identification/detection.py`.

**Noise** in dB: mean square of the whole noiseless recording over that of the added noise.

**Loud**: in the `LONG` after touch, the noiseless recording has at least twice the power of the noise. **Alone**: no
other impact touches within `APART` before or after, and the power after touch is at least twice that of the `LONG`
before it (otherwise it drowns in the ringing of another). An impact **counts** if it is both.

**Found**: an onset from `EARLY` before touch to `LATE` after it; each onset finds at most one impact, the nearest.
Precision is the share of onsets that find an impact, loud or not; recall is the share of counting impacts that are
found.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cgid.scene import Scene, parse_scene, record
from cgid.shipped import scene_path

APART, LONG, EARLY, LATE = 20e-3, 5e-3, 1e-3, 2e-3


def caving(seconds: float, *, noise: bool = False, **changes: dict[str, Any]) -> Scene:
    """Return the scene `caving` with another length, with or without its noise; changes are of its sections."""
    content = tomllib.loads(scene_path("caving").read_text())
    content["stream"] |= {
        "duration": f"{seconds} s",
        "mixture": {"times": ["0 s", f"{seconds} s"], "gangue": [0.1, 0.9]},
    }
    if not noise:
        del content["background"]
        for name in ("noise_density", "range", "bits"):
            del content["sensor"][name]
    for section, own in changes.items():
        content[section] |= own
    return parse_scene(content)


@dataclass
class Stream:
    """A noiseless recording, and the touch times of its impacts."""

    samples: np.ndarray
    sampling_rate: float
    touch: np.ndarray

    @classmethod
    def of(cls, scene: Scene, seed: int = 0) -> Stream:
        signal, truth = record(scene, seed, dtype="float64")
        return cls(signal.samples, signal.sampling_rate, truth["time"])

    def noise(self, decibels: float, kind: str = "white", seed: int = 0) -> np.ndarray:
        """Return noise of a power: white, pink (power / frequency), or mains hum with some white noise."""
        random, n_samples = np.random.default_rng(seed), self.samples.size
        if kind == "hum":
            turns = 2 * np.pi * 50 * np.arange(n_samples) / self.sampling_rate
            noise = sum(np.sin(order * turns + order) / order for order in (1, 2, 3, 5, 7, 13))
            noise += 0.1 * random.normal(size=n_samples)
        else:
            noise = random.normal(size=n_samples)
        if kind == "pink":
            spectrum = np.fft.rfft(noise)
            spectrum /= np.sqrt(np.maximum(np.arange(spectrum.size), 1))
            noise = np.fft.irfft(spectrum, n_samples)
        return self.scaled(noise, decibels)

    def scaled(self, noise: np.ndarray, decibels: float) -> np.ndarray:
        return noise * np.sqrt(np.mean(self.samples**2) / np.mean(noise**2) / 10 ** (decibels / 10))

    @cached_property
    def _powers(self) -> tuple[np.ndarray, np.ndarray]:
        energy = np.append(0.0, np.cumsum(self.samples**2))
        place = (self.touch * self.sampling_rate).astype(int)
        long = int(LONG * self.sampling_rate)
        early, late = np.maximum(place - long, 0), np.minimum(place + long, self.samples.size)
        return (energy[place] - energy[early]) / long, (energy[late] - energy[place]) / long

    @cached_property
    def alone(self) -> np.ndarray:
        gap, (before, after) = np.diff(self.touch), self._powers
        return (np.append(np.inf, gap) > APART) & (np.append(gap, np.inf) > APART) & (after >= 2 * before)

    def loud(self, noise: np.ndarray) -> np.ndarray:
        return self._powers[1] >= 2 * np.mean(noise**2)

    def finding(self, onsets: np.ndarray) -> np.ndarray:
        """Return the number of the impact that each onset [samples] finds, -1 for none."""
        times, found = np.asarray(onsets) / self.sampling_rate, np.full(len(onsets), -1)
        first, behind = np.searchsorted(self.touch, times - LATE), np.searchsorted(self.touch, times + EARLY)
        pairs = [(abs(times[k] - self.touch[j]), k, j) for k in range(len(times)) for j in range(first[k], behind[k])]
        taken: set[int] = set()
        for _, k, j in sorted(pairs):
            if found[k] < 0 and j not in taken:
                found[k] = j
                taken.add(j)
        return found


@dataclass
class Score:
    """The quality of detection in a stream with noise.

    recall_of_all : recall of all loud impacts, alone or not
    errors : onset - touch of the counting impacts that were found [samples]
    """

    precision: float
    recall: float
    recall_of_all: float
    n_events: int
    n_counting: int
    errors: np.ndarray


def score(stream: Stream, noise: np.ndarray, onsets: np.ndarray) -> Score:
    """Return how well the onsets [samples] match the truth."""
    found = stream.finding(onsets)
    hit = np.zeros(stream.touch.size, bool)
    hit[found[found >= 0]] = True
    loud = stream.loud(noise)
    counts = loud & stream.alone
    right = found[found >= 0]
    errors = np.asarray(onsets)[found >= 0] - stream.touch[right] * stream.sampling_rate
    return Score(
        precision=float(np.mean(found >= 0)) if len(onsets) else 1.0,
        recall=float(hit[counts].mean()),
        recall_of_all=float(hit[loud].mean()),
        n_events=len(onsets),
        n_counting=int(counts.sum()),
        errors=errors[counts[right]],
    )
