"""Recordings of coal and gangue made from the sample, and a model of windows, for tests of the answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cgid.identification.detection.windows import measure_windows
from cgid.identification.model.model import StoredModel
from cgid.identification.training import ImpactClassifier
from cgid.recordings import read_recording

ROOT = Path(__file__).parents[1]
#: Sampling rate of the sample [Hz].
RATE = 200_000.0
#: First impact and spacing in the sample; start before an impact and length of a frame [samples].
_FIRST, _SPACING, _BEFORE, _LENGTH = 1000, 4000, 200, 1200


def pulses() -> tuple[NDArray[np.float64], list[str]]:
    """Return the impacts of the sample minus their baseline, (6, n), and their labels by the default model."""
    (signal,) = read_recording(ROOT / "datasets" / "sample.csv")
    starts = _FIRST + _SPACING * np.arange(6) - _BEFORE
    frames = np.stack([signal.samples[start : start + _LENGTH] for start in starts])
    frames = frames - frames[:, : _BEFORE - 20].mean(axis=1, keepdims=True)
    return frames, ["coal", "gangue", "coal", "gangue", "coal", "gangue"]


def stream(labels: list[str], gap: float, seed: int = 0, noise: float = 25.0) -> NDArray[np.float64]:
    """Return a force [N] with an impact of each label, one every `gap` seconds, the first after half of it."""
    frames, kinds = pulses()
    rng, sizes = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    step = round(gap * RATE)
    samples = rng.normal(0.0, noise, step * len(labels))
    for number, label in enumerate(labels):
        # The second and third of each label have the more certain answers.
        which = [k for k, kind in enumerate(kinds) if kind == label][rng.integers(3)]
        first = step * number + step // 2 - _BEFORE
        # No two rocks are alike: peaks that are equal stand at the limit of a recorder.
        samples[first : first + _LENGTH] = frames[which] * sizes.uniform(0.9, 1.1)
    return samples


def window_model(n_channels: int = 1, hop_time: float = 0.05) -> StoredModel:
    """Return a model that separates windows of 0.1 s at 8 kHz: dull noise ("coal") from white noise ("gangue")."""
    names = ("window_zero_crossing_rate", "window_centroid")
    rng = np.random.default_rng(1)
    white = rng.normal(size=(200, n_channels, 800))
    dull = np.cumsum(white, axis=2)
    table = measure_windows(np.concatenate([dull, white]), 8000.0, names)
    labels = np.repeat(["coal", "gangue"], 200)
    classifier = ImpactClassifier("linear").fit(table, labels)
    return StoredModel.from_classifier(
        classifier,
        features=names,
        unit="FS",
        sampling_rates=(8000.0, 8000.0),
        training={},
        window_time=0.1,
        hop_time=hop_time,
        n_channels=n_channels,
    )
