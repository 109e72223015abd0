"""The FFT filter against a direct Fourier sum, and what it does to a clean pulse."""

import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.measure.filters import fft_filter, filter_gain
from cgid.measure.fit import family
from tests import naive

RATE = 1e6


#: Long, so that an edge falls on a fine grid and nothing rings around the ends.
FRAME = 2**16
TOUCH = FRAME // 2


def clean_pulse(restitution, duration):
    contact, top, _ = family.times(restitution)
    tau = np.arange(int(duration * RATE) + 2) / RATE * contact / duration
    samples = np.zeros(FRAME)
    samples[TOUCH : TOUCH + tau.size] = family.force(tau, restitution)
    return samples / family.force(np.atleast_1d(top), restitution)


def noise(*shape):
    return np.random.default_rng(1).normal(size=shape)


# -- the filter itself ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_samples", [32, 33])
@pytest.mark.parametrize("taper", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("low", "high"), [(None, 210.0), (120.0, None), (120.0, 340.0), (None, None)])
def test_agrees_with_the_direct_sum(n_samples, taper, low, high):
    samples = noise(n_samples)
    expected = naive.fft_filter(samples.tolist(), 1000.0, low, high, taper)
    assert fft_filter(samples, 1000.0, low, high, taper) == pytest.approx(expected, abs=1e-12)


def test_filters_along_the_last_axis_whatever_the_shape():
    samples = noise(2, 50, 64)
    together = fft_filter(samples, 1000.0, high=200, taper=0.5)
    alone = [[fft_filter(row, 1000.0, high=200, taper=0.5) for row in block] for block in samples]
    assert together.shape == samples.shape
    assert together == pytest.approx(np.array(alone), abs=1e-15)


@pytest.mark.parametrize("taper", [0.1, 0.5, 1.0])
def test_taper_passes_half_at_the_edge(taper):
    edge = 100.0
    ends = np.array([edge * (1 - taper / 2), edge, edge * (1 + taper / 2)])
    assert filter_gain(ends, 1000.0, None, edge, taper) == pytest.approx([1, 0.5, 0], abs=1e-15)
    assert filter_gain(ends, 1000.0, edge, None, taper) == pytest.approx([0, 0.5, 1], abs=1e-15)


# -- what is refused ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"high": 501.0}, {"low": 600.0}])
def test_edge_above_half_the_sampling_rate(options):
    cure = 2 * next(iter(options.values()))
    with pytest.raises(InvalidValue, match=f"at most half the sampling rate, 500 Hz.*sample at {cure:g} Hz or more"):
        fft_filter(noise(64), 1000.0, **options)


@pytest.mark.parametrize(("low", "high"), [(200.0, 100.0), (100.0, 100.0)])
def test_edges_are_in_order(low, high):
    with pytest.raises(InvalidValue, match=f"low must be below high, got low {low:g} Hz and high {high:g} Hz"):
        fft_filter(noise(64), 1000.0, low, high)


# -- what it does to a clean pulse: the numbers in the docstring of cgid.measure.filters -------------------------------


@pytest.mark.parametrize(
    ("restitution", "over_duration", "taper", "change"),
    [
        (1.0, 4, 0.0, 0.0022),
        (0.5, 4, 0.0, 0.0085),
        (1.0, 2, 0.0, 0.0132),
        (0.5, 2, 0.0, -0.0677),
        (1.0, 4, 0.5, 0.0009),
        (0.5, 4, 0.5, 0.0071),
        (1.0, 2, 0.5, 0.0109),
        (0.5, 2, 0.5, -0.0730),
    ],
)
@pytest.mark.parametrize("duration", [2e-4, 5e-4])
def test_low_pass_moves_the_peak_as_stated(restitution, over_duration, taper, change, duration):
    filtered = fft_filter(clean_pulse(restitution, duration), RATE, high=over_duration / duration, taper=taper)
    assert filtered.max() - 1 == pytest.approx(change, abs=0.0005)


@pytest.mark.parametrize(
    ("restitution", "over_duration", "ringing"),
    [(1.0, 4, 0.0035), (0.5, 4, 0.0126), (1.0, 2, 0.0203), (0.5, 2, 0.0793)],
)
def test_brick_wall_rings_before_touch_as_stated(restitution, over_duration, ringing):
    filtered = fft_filter(clean_pulse(restitution, 5e-4), RATE, high=over_duration / 5e-4)
    # A tenth of the duration before touch and more, so that it is no smearing of the rise.
    assert np.abs(filtered[: TOUCH - 50]).max() == pytest.approx(ringing, rel=0.02)


@pytest.mark.parametrize("restitution", [1.0, 0.5])
@pytest.mark.parametrize("over_duration", [2, 4])
def test_taper_rings_as_high_beside_the_pulse_and_dies_out_sooner(restitution, over_duration):
    pulse = clean_pulse(restitution, 5e-4)
    brick, taper = (fft_filter(pulse, RATE, high=over_duration / 5e-4, taper=taper) for taper in (0.0, 0.5))
    beside = np.abs(taper[: TOUCH - 50]).max() / np.abs(brick[: TOUCH - 50]).max()
    one_duration_before = np.abs(taper[: TOUCH - 500]).max() / np.abs(brick[: TOUCH - 500]).max()
    assert 0.85 < beside < 1
    assert one_duration_before < 1 / 3
