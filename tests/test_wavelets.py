"""Wavelet packets: PyWavelets' own tree, Parseval, tones, and what happens where the library is missing."""

import sys

import numpy as np
import pytest

from cgid.errors import MissingExtra
from cgid.measure.features.extraction import extract_array
from cgid.measure.spectra import LEVEL, N_PACKETS, WAVELET, packet_energies
from tests.ringing import PRE_TRIGGER, RATE, ringing_batch

WINDOW = tuple(f"window_packet_{k + 1}_of_{N_PACKETS}" for k in range(N_PACKETS))
VIBRATION = tuple(f"packet_{k + 1}_of_{N_PACKETS}" for k in range(N_PACKETS))


@pytest.fixture
def pywt():
    return pytest.importorskip("pywt", reason="PyWavelets (extra wavelets) is not installed")


def test_packets_are_those_of_the_library(pywt):
    samples = np.random.default_rng(0).normal(size=(5, 1600))
    for row, energies in zip(samples, packet_energies(samples), strict=True):
        tree = pywt.WaveletPacket(row, WAVELET, "periodization", maxlevel=LEVEL)
        expected = [np.sum(node.data**2) for node in tree.get_level(LEVEL, order="freq")]
        assert energies == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("packet", [0, 1, 2, 3, 7, 10, 15])
def test_a_tone_is_in_its_own_packet(pywt, packet):
    rate, middle = 32_000.0, 500.0 + 1000.0 * packet
    tone = np.sin(2 * np.pi * middle * np.arange(3200) / rate)
    found = dict(zip(WINDOW, extract_array(tone, rate, WINDOW)[0], strict=True))
    assert max(found, key=found.__getitem__) == WINDOW[packet]
    assert found[WINDOW[packet]] == pytest.approx(np.log10(0.5), abs=0.25)


@pytest.mark.parametrize(("names", "whole"), [(WINDOW, "window_level"), (VIBRATION, "level_total")])
def test_gain_cancels_and_rows_stand_alone(pywt, names, whole):
    frames = ringing_batch(9, seed=2).signals
    free = tuple(name.replace("packet", "relative_packet") for name in names)
    asked = (*names, *free, whole)
    once, louder = (extract_array(gain * frames, RATE, asked, pre_trigger=PRE_TRIGGER) for gain in (1.0, 2.0))
    assert louder[:, :16] == pytest.approx(once[:, :16] + np.log10(4))
    assert louder[:, 16:32] == pytest.approx(once[:, 16:32], abs=1e-9)
    assert once[:, 16:32] == pytest.approx(once[:, :16] - once[:, 32:], abs=1e-12)
    np.testing.assert_array_equal(extract_array(frames[4], RATE, asked, pre_trigger=PRE_TRIGGER)[0], once[4])


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pywt", None)
    samples = np.random.default_rng(3).normal(size=(2, 2000))
    with pytest.raises(MissingExtra, match=r"PyWavelets, which is not installed: pip install '.*\[wavelets\]'"):
        extract_array(samples, 1e4, WINDOW)
    assert np.isfinite(extract_array(samples, 1e4, ["window_level"])).all()
