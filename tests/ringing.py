"""A struck structure for tests: damped modes with random participation, driven by pulses of the damped-Hertz family.

The signals are independent of the package's models: scipy filters run at eight times the rate, and scipy decimates.
"""

from __future__ import annotations

import numpy as np
from scipy import signal

from cgid.measure.fit import family
from cgid.signals import Batch

RATE = 25600.0
FINER = 8
N_SAMPLES, PRE_TRIGGER = 2048, 256
#: Modes [Hz] and their damping ratios.
MODES = np.array([110, 190, 290, 430, 620, 900, 1300, 1800, 2500, 3300, 4300, 5500, 7000, 8800.0])
DAMPING = np.array([3, 2, 4, 2, 3, 2, 4, 3, 2, 3, 2, 3, 2, 3]) / 100
#: Contact durations [s] and their spread: the soft coal has longer contacts.
DURATIONS = {"coal": 6e-4, "gangue": 2.5e-4}
SPREAD = 0.2


def damped_sinusoid(frequency, damping, rate=RATE, n_samples=N_SAMPLES, before=PRE_TRIGGER, amplitude=100.0):
    """One mode that starts with sample number `before`."""
    time = np.maximum(np.arange(n_samples) - before, 0) / rate
    decay = np.exp(-damping * 2 * np.pi * frequency * time)
    return amplitude * decay * np.sin(2 * np.pi * frequency * time)


def blows(random, n_signals, labels):
    """Pulses at the fine rate, (n_signals, n_fine), touching at the pre-trigger; the impulse is random, too."""
    columns = np.arange(N_SAMPLES * FINER) - PRE_TRIGGER * FINER
    out = np.zeros((n_signals, columns.size))
    for row, label in zip(out, labels, strict=True):
        duration = DURATIONS[label] * np.exp(random.normal(0, SPREAD))
        restitution = random.uniform(0.3, 0.7)
        contact, top, _ = family.times(restitution)
        tau = columns / (RATE * FINER) * contact / duration
        peak = family.force(np.atleast_1d(top), restitution)
        row += np.exp(random.normal(0, 0.5)) / duration * family.force(tau, restitution) / peak
    return out


def through_the_structure(force, random):
    """Return the acceleration by pulses at the fine rate, at the recorder's rate."""
    fine = RATE * FINER
    acceleration = np.zeros_like(force)
    for frequency, damping in zip(MODES, DAMPING, strict=True):
        omega = 2 * np.pi * frequency
        numerator, denominator = signal.bilinear([1.0, 0.0, 0.0], [1.0, 2 * damping * omega, omega**2], fs=fine)
        participation = random.uniform(0.3, 1.0, len(force)) * random.choice([-1, 1], len(force))
        acceleration += participation[:, None] * signal.lfilter(numerator, denominator, force, axis=1)
    return signal.resample_poly(acceleration, 1, FINER, axis=1)


def ringing_batch(n_signals, seed=0, noise=0.01, unit="m/s^2", source="ringing"):
    """A labelled batch, every signal of a separate specimen; noise is a share of the peak."""
    random = np.random.default_rng(seed)
    labels = np.array(["coal", "gangue"])[random.integers(0, 2, n_signals)]
    frames = 1e-3 * through_the_structure(blows(random, n_signals, labels), random)
    frames += noise * np.abs(frames).max(axis=1, keepdims=True) * random.normal(size=frames.shape)
    return Batch(
        signals=frames.astype(np.float32),
        labels=labels,
        sampling_rate=RATE,
        unit=unit,
        pre_trigger=PRE_TRIGGER,
        specimen=np.arange(n_signals, dtype=np.uint64) + np.uint64(seed) * np.uint64(1_000_000),
        source=source,
    )
