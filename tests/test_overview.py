"""The overview of a recording against slow twins and scipy."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy import signal as scipy_signal

from cgid.measure.overview import SPECTROGRAM_COLUMNS, WAVEFORM_COLUMNS, Overview, OverviewStream, segment_length

RATE = 25600.0


def noise(n_channels: int, n_samples: int, seed: int = 0) -> np.ndarray:
    """Return coloured noise with an offset, a tone and a blow in every channel."""
    rng = np.random.default_rng(seed)
    samples = scipy_signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=(n_channels, n_samples)))
    times = np.arange(n_samples) / RATE
    samples += 3.0 + np.sin(2 * np.pi * 1234.5 * times) * np.arange(1, n_channels + 1)[:, None]
    samples[:, n_samples // 3] += 50.0
    return samples


def overview_of(samples: np.ndarray, length: int | None = None, rate: float = RATE) -> Overview:
    stream = OverviewStream(rate, len(samples))
    for start in range(0, samples.shape[1], length or samples.shape[1]):
        stream.feed(samples[:, start : start + (length or samples.shape[1])])
    return stream.overview()


@pytest.mark.parametrize("n_samples", [16, 63, 64, 1000, 8191, 100_000, 700_001])
def test_the_spectrum_is_that_of_scipy(n_samples: int) -> None:
    samples = noise(2, n_samples)
    overview = overview_of(samples)
    segment = segment_length(RATE, n_samples)
    frequency, density = scipy_signal.welch(samples, RATE, window="hann", nperseg=segment)
    np.testing.assert_allclose(overview.frequency, frequency, rtol=1e-15)
    np.testing.assert_allclose(overview.spectrum, density, rtol=1e-10, atol=1e-13 * density.max())


@pytest.mark.parametrize("n_samples", [64, 5000, 700_001, 2_500_000])
def test_the_spectrogram_is_that_of_scipy_in_bands_and_columns(n_samples: int) -> None:
    samples = noise(1, n_samples)
    overview = overview_of(samples)
    segment = segment_length(RATE, n_samples)
    frequency, times, density = scipy_signal.spectrogram(
        samples[0], RATE, window="hann", nperseg=segment, noverlap=segment // 2, detrend="constant"
    )
    assert overview.spectrogram.shape[2] <= SPECTROGRAM_COLUMNS
    # Which bins and segments belong together is told by the edges alone.
    band = np.searchsorted(overview.band_edges, frequency, side="right") - 1
    band[-1] = len(overview.band_edges) - 2
    column = np.searchsorted(overview.time_edges, times, side="right") - 1
    assert band[0] == -1 and set(band[1:]) == set(range(len(overview.band_edges) - 1))
    assert set(column) == set(range(overview.spectrogram.shape[2]))
    bands = np.array([density[band == k].mean(axis=0) for k in range(max(band) + 1)])
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    expected = np.add.reduceat(bands, starts, axis=1) / np.diff(np.append(starts, column.size))
    np.testing.assert_allclose(overview.spectrogram[0], expected, rtol=1e-9, atol=1e-13 * density.max())
    np.testing.assert_allclose(overview.band_edges[[0, -1]], [RATE / segment / 2, RATE / 2])


@pytest.mark.parametrize("n_samples", [1, 2, 4095, 4096, 4097, 8192, 50_003])
def test_lowest_and_highest_are_exact(n_samples: int) -> None:
    samples = noise(3, n_samples)
    overview = overview_of(samples, 777)
    step, edges = overview.waveform_step, np.arange(0, n_samples, overview.waveform_step)
    assert len(edges) <= WAVEFORM_COLUMNS and (step == 1 or len(edges) >= WAVEFORM_COLUMNS // 2)
    columns = [samples[:, edge : edge + step] for edge in edges]
    np.testing.assert_array_equal(overview.lowest, np.transpose([part.min(axis=1) for part in columns]))
    np.testing.assert_array_equal(overview.highest, np.transpose([part.max(axis=1) for part in columns]))
    np.testing.assert_allclose(overview.waveform_edges, np.append(edges, n_samples) / RATE)
    np.testing.assert_allclose(overview.mean, samples.mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(overview.deviation, samples.std(axis=1), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("n_samples", [300, 9000, 200_000])
def test_blocks_change_nothing(n_samples: int) -> None:
    samples = noise(2, n_samples)
    whole = overview_of(samples)
    for length in (1, 17, 4096, 65537) if n_samples < 1000 else (997, 4096, 65537):
        parts = overview_of(samples, length)
        for name in ("lowest", "highest", "time_edges", "band_edges", "waveform_step", "n_samples"):
            np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
        for name in ("mean", "deviation", "spectrum", "spectrogram"):
            np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-9, atol=1e-15)


def test_an_overview_on_the_way_disturbs_nothing() -> None:
    samples = noise(1, 30_000)
    stream = OverviewStream(RATE)
    stream.feed(samples[:, :1000])
    np.testing.assert_array_equal(stream.overview().spectrum, overview_of(samples[:, :1000]).spectrum)
    stream.feed(samples[:, 1000:])
    np.testing.assert_allclose(stream.overview().spectrum, overview_of(samples).spectrum, rtol=1e-10)


def test_memory_does_not_grow_with_the_recording() -> None:
    def peak(n_blocks: int) -> int:
        block = noise(1, 65536).astype(np.float32)
        stream = OverviewStream(RATE)
        tracemalloc.start()
        try:
            for _ in range(n_blocks):
                stream.feed(block)
            stream.overview()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    short, long = peak(10), peak(150)
    assert long < 1.05 * short < 30e6


def test_a_missing_sample_counts_as_the_mean() -> None:
    samples = np.random.default_rng(0).normal(5.0, 1.0, (1, 3000))
    lacking, filled = samples.copy(), samples.copy()
    lacking[0, 2000:2050], filled[0, 2000:2050] = np.nan, samples[0, :2000].mean()
    seen = []
    for one in (lacking, filled):
        stream = OverviewStream(1000.0, 1)
        stream.feed(one[:, :2000])
        stream.feed(one[:, 2000:])
        seen.append(stream.overview())
    for name in ("lowest", "highest", "mean", "deviation", "spectrum", "spectrogram"):
        np.testing.assert_allclose(getattr(seen[0], name), getattr(seen[1], name), rtol=1e-12)
