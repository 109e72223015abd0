"""Frames of impacts at the borders of what has been heard: what comes late must not depend on the blocks."""

from __future__ import annotations

import numpy as np
import pytest

from cgid.identification.detection import ImpactDetector

RATE = 20_000.0


def heard(samples: np.ndarray, size: int, **options) -> list[tuple[object, ...]]:
    """Return all of each event of a recording of one channel that is fed in blocks of one size."""
    detector, events = ImpactDetector(RATE, **options), []
    for start in range(0, samples.size, size):
        events += detector.feed(samples[start : start + size])
    found = events + detector.finish()
    return [(*(v for k, v in vars(one).items() if k != "samples"), one.samples.tobytes()) for one in found]


@pytest.mark.parametrize("gap", [-1, 0, 1, 5, 9, 10, 11])
def test_what_follows_right_behind_a_frame_is_known_whatever_the_blocks(gap: int) -> None:
    detector = ImpactDetector(RATE, kind="pulse")
    length, chunk = detector.n_samples - detector.n_quiet, 4000
    # The frame of the second pulse ends where the third chunk does, and the third pulse begins about there.
    samples = 1e-2 * np.random.default_rng(0).normal(size=12 * chunk)
    for place in (chunk // 2, 3 * chunk - length, 3 * chunk + gap, 6 * chunk):
        samples[place : place + 6] += (3, 8, 10, 9, 6, 2)
    as_a_whole = heard(samples, samples.size, kind="pulse")
    assert len(as_a_whole) == 4
    assert heard(samples, chunk, kind="pulse") == as_a_whole
    assert heard(samples, 1777, kind="pulse") == as_a_whole


@pytest.mark.parametrize(("apart", "is_one"), [(2000, True), (8000, False)])
def test_what_is_heard_in_the_dead_time_marks_a_blow_within_its_frame_only(apart: int, is_one: bool) -> None:
    time = np.arange(1000) / RATE
    blow = sum(np.exp(-200 * time) * np.sin(2 * np.pi * f * time) for f in (1500, 2300, 3300, 5200, 7000))
    samples = 1e-3 * np.random.default_rng(0).normal(size=60_000)
    for place in (20_000, 20_000 + apart):
        samples[place : place + blow.size] += blow
    (event,) = heard(samples, samples.size, kind="vibration", dead_time=0.6)
    assert heard(samples, 1000, kind="vibration", dead_time=0.6) == [event]
    assert (True in event) is is_one  # overlapping: neither clipped nor cut is
