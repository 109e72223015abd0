"""Slow, obvious twins of the fast routines: plain loops, one signal at a time, nothing shared with the package."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np


def peak(samples: Sequence[float]) -> tuple[int, float]:
    """Return place and value of the first largest sample."""
    place = 0
    for k in range(len(samples)):
        if samples[k] > samples[place]:
            place = k
    return place, samples[place]


def crossings(samples: Sequence[float], level: float) -> tuple[float, float]:
    """Walk outwards from the peak to the first sample below a fraction of it; straight lines [samples]."""
    place, highest = peak(samples)
    height = level * highest
    left = place
    while samples[left] >= height:
        left -= 1
    right = place
    while samples[right] >= height:
        right += 1
    rising = left + (height - samples[left]) / (samples[left + 1] - samples[left])
    falling = right - (height - samples[right]) / (samples[right - 1] - samples[right])
    return rising, falling


def width(samples: Sequence[float], rate: float, level: float) -> float:
    rising, falling = crossings(samples, level)
    return (falling - rising) / rate


def rise_time(samples: Sequence[float], rate: float) -> float:
    return (crossings(samples, 0.9)[0] - crossings(samples, 0.1)[0]) / rate


def fall_time(samples: Sequence[float], rate: float) -> float:
    return (crossings(samples, 0.1)[1] - crossings(samples, 0.9)[1]) / rate


def impulse(samples: Sequence[float], rate: float) -> float:
    total = 0.0
    for value in samples:
        total += value / rate
    return total


def energy(samples: Sequence[float], rate: float) -> float:
    total = 0.0
    for value in samples:
        total += value * value / rate
    return total


def skewness(samples: Sequence[float]) -> float:
    """Third standardised moment of the samples, seen as a distribution over time."""
    total = sum(samples)
    mean = sum(k * value for k, value in enumerate(samples)) / total
    second = sum((k - mean) ** 2 * value for k, value in enumerate(samples)) / total
    third = sum((k - mean) ** 3 * value for k, value in enumerate(samples)) / total
    return float(third / second**1.5)


def power_spectrum(samples: Sequence[float], rate: float, duration: float) -> tuple[list[float], list[float]]:
    """Direct Fourier sum up to 4/T, on the grid of a transform padded to a power of two of at least 8 T."""
    length = 64
    while length < 8 * math.ceil(duration * rate + 1):
        length *= 2
    frequencies, power = [], []
    k = 0
    while k * rate / length <= min(4 / duration, rate / 2):
        total = 0j
        for n, value in enumerate(samples):
            total += value * cmath.exp(-2j * math.pi * k * n / length)
        frequencies.append(k * rate / length)
        power.append(abs(total) ** 2)
        k += 1
    return frequencies, power


def spectral_mean(values: Sequence[float], power: Sequence[float]) -> float:
    """Mean over the spectrum; the bin at 0 Hz is half a bin wide."""
    weights = [0.5 * power[0], *power[1:]]
    return sum(v * w for v, w in zip(values, weights, strict=True)) / sum(weights)


def centroid(frequencies: Sequence[float], power: Sequence[float]) -> float:
    return spectral_mean(frequencies, power)


def bandwidth(frequencies: Sequence[float], power: Sequence[float]) -> float:
    middle = centroid(frequencies, power)
    return math.sqrt(spectral_mean([(f - middle) ** 2 for f in frequencies], power))


def energy_below(frequencies: Sequence[float], power: Sequence[float], limit: float) -> float:
    """Share of the spectrum below a limit: trapezoids, the last one cut in proportion."""
    below = total = 0.0
    for k in range(len(power) - 1):
        step = 0.5 * (power[k] + power[k + 1])
        share = (limit - frequencies[k]) / (frequencies[k + 1] - frequencies[k])
        total += step
        below += step * min(max(share, 0.0), 1.0)
    return below / total


def rolloff(frequencies: Sequence[float], power: Sequence[float], share: float = 0.85) -> float:
    """Bisect for the limit with that share of the energy below it."""
    low, high = 0.0, frequencies[-1]
    for _ in range(60):
        middle = 0.5 * (low + high)
        if energy_below(frequencies, power, middle) < share:
            low = middle
        else:
            high = middle
    return low


def cutoff_10db(frequencies: Sequence[float], power: Sequence[float]) -> float:
    decibel = [10 * math.log10(p / power[0]) for p in power]
    k = 0
    while decibel[k] > -10:
        k += 1
    share = (-10 - decibel[k - 1]) / (decibel[k] - decibel[k - 1])
    return frequencies[k - 1] + share * (frequencies[k] - frequencies[k - 1])


def low_pass_gain(frequency: float, edge: float, taper: float) -> float:
    """One below the edge, zero above it, half a cosine wave of width `taper * edge` between."""
    start, stop = edge * (1 - taper / 2), edge * (1 + taper / 2)
    if frequency <= start:
        return 1.0
    if frequency >= stop:
        return 0.0
    return 0.5 * (1 + math.cos(math.pi * (frequency - start) / (stop - start)))


def fft_filter(
    samples: Sequence[float], rate: float, low: float | None = None, high: float | None = None, taper: float = 0.0
) -> np.ndarray:
    """Filter by a direct Fourier sum forth and back."""
    n = len(samples)
    result = np.zeros(n, complex)
    for k in range(n):
        frequency = min(k, n - k) * rate / n
        gain = 1.0 if high is None else low_pass_gain(frequency, high, taper)
        gain *= 1.0 if low is None else 1 - low_pass_gain(frequency, low, taper)
        coefficient = sum(samples[m] * cmath.exp(-2j * math.pi * k * m / n) for m in range(n))
        for m in range(n):
            result[m] += gain * coefficient * cmath.exp(2j * math.pi * k * m / n) / n
    return result.real


def band_power(frequencies: Sequence[float], power: Sequence[float], low: float, high: float) -> float:
    return energy_below(frequencies, power, high) - energy_below(frequencies, power, low)


def stretches(samples: Sequence[float], threshold: float, gap: int) -> list[int]:
    """First samples of the stretches above a threshold that are more than `gap` samples apart."""
    firsts: list[int] = []
    last = None
    for k, value in enumerate(samples):
        if value > threshold:
            if last is None or k - last > gap:
                firsts.append(k)
            last = k
    return firsts
