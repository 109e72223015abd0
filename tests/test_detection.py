"""Impacts in recordings that come in blocks: against the truth of streams, whatever the blocks, noises and rates."""

import math
import os
import tracemalloc
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cgid.cli.monitor import UnbufferedInput
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection import ImpactDetector, find_impacts
from cgid.identification.detection.vibration_onsets import onset_in
from cgid.measure.features.extraction import extract_array
from cgid.recordings import read_recording
from cgid.recordings.live import Inbox, live_stream
from cgid.signals import Signal
from tests.impact_truth import Stream, caving, score
from tests.test_features import REAL_SHOCK

RATE = 25_600.0


def detected(samples, kind="vibration", sampling_rate=RATE, cuts=(), **options):
    samples = np.atleast_2d(samples)
    detector = ImpactDetector(sampling_rate, len(samples), kind=kind, **options)
    events, told = [], 0
    for block in np.split(samples, cuts, axis=1):
        new = detector.feed(block)
        # What was told is told: nothing comes later that begins before.
        assert all(event.onset >= told for event in new)
        told = detector.known_until
        events += new
        assert all(event.onset < told for event in events)
    return events + detector.finish()


def all_of(events):
    return [(*(v for k, v in vars(event).items() if k != "samples"), event.samples.tobytes()) for event in events]


def ringing(frequency=2000.0, damping=0.02, amplitude=100.0, sampling_rate=RATE, seconds=0.3):
    t = np.arange(int(seconds * sampling_rate)) / sampling_rate
    return amplitude * np.exp(-2 * np.pi * damping * frequency * t) * np.sin(2 * np.pi * frequency * t)


def blows(places, n_samples, noise=1.0, seed=0, **options):
    """Vibrations of both signs that begin at some samples, in white noise."""
    samples = noise * np.random.default_rng(seed).normal(size=n_samples)
    for number, place in enumerate(places):
        own = ringing(**options)[: n_samples - place]
        samples[place : place + own.size] += own * (-1) ** number
    return samples


# -- streams with truth ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stream():
    return Stream.of(caving(15.0), seed=4)


@pytest.mark.parametrize(
    ("decibels", "kind", "precision", "recall", "late"),
    [
        (30, "white", 0.97, 0.97, 14),
        (20, "white", 0.95, 0.95, 14),
        (10, "white", 0.95, 0.95, 16),
        (0, "white", 0.95, 0.90, 20),
        (20, "pink", 0.95, 0.95, 14),
        (20, "hum", 0.95, 0.95, 14),
    ],
)
def test_impacts_of_a_caving_window_are_found(stream, decibels, kind, precision, recall, late):
    noise = stream.noise(decibels, kind)
    found = score(stream, noise, [event.onset for event in detected(stream.samples + noise)])
    assert found.n_counting >= 25
    assert found.precision >= precision
    assert found.recall >= recall
    assert 0 <= np.median(found.errors) <= 8
    assert np.quantile(found.errors, 0.95) <= late


def test_white_noise_alone_has_no_impact():
    random = np.random.default_rng(0)
    detector = ImpactDetector(RATE, 4, kind="vibration")
    assert sum(len(detector.feed(random.normal(size=(4, 25_600)))) for _ in range(15)) == 0
    assert detector.finish() == []


def test_a_motor_that_starts_is_no_impact_and_hides_none_that_is_louder():
    # Its noise comes up by 20 dB within three seconds.
    growth = 10 ** np.interp(np.arange(7 * 25_600), [25_600, 4 * 25_600], [0, 1])
    noise = growth * np.random.default_rng(3).normal(size=growth.size)
    assert detected(noise) == []
    truth = [12_800, 5 * 25_600, 6 * 25_600]
    hits = noise + blows(truth[1:], growth.size, noise=0.0, amplitude=1000.0)
    hits[truth[0] :] += blows([0], growth.size - truth[0], noise=0.0, amplitude=10.0)
    assert [event.onset for event in detected(hits)] == pytest.approx(truth, abs=6)


@pytest.mark.parametrize("sampling_rate", [10_000.0, 44_100.0, 100_000.0])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_onsets_at_other_rates(sampling_rate, noise):
    truth = [int(time * sampling_rate) for time in (0.3, 0.5, 0.9)]
    samples = blows(truth, int(1.3 * sampling_rate), noise, sampling_rate=sampling_rate)
    onsets = [event.onset for event in detected(samples, sampling_rate=sampling_rate)]
    assert onsets == pytest.approx(truth, abs=max(2, 1e-4 * sampling_rate))


def test_onset_is_where_the_likelihood_of_two_noises_is_highest():
    random = np.random.default_rng(7)
    for _ in range(20):
        samples = np.cumsum(random.normal(size=80) * np.where(np.arange(80) < random.integers(20, 60), 1.0, 8.0))
        differences = np.diff(samples)
        likelihood = {}
        for k in range(2, differences.size - 2):
            parts = differences[:k], differences[k:]
            likelihood[k] = sum(-0.5 * part.size * np.log(np.mean(part**2)) for part in parts)
        assert onset_in(samples, 1) == max(likelihood, key=likelihood.get) + 1


# -- the same answer whatever the blocks ----------------------------------------------------------------------


def test_memory_holds_some_tenths_of_a_second():
    random = np.random.default_rng(2)
    tracemalloc.start()
    detector = ImpactDetector(RATE, kind="pulse", dead_time=1e300)
    vibrations = ImpactDetector(RATE, kind="vibration")
    for _ in range(20):
        # An offset that stays, where a pulse never ends.
        block = random.normal(size=25_600) + 1000.0
        block[:2000] -= 1000.0
        detector.feed(block)
        vibrations.feed(block)
    del block
    n_bytes, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert n_bytes < 2 * 8 * RATE  # less than a second each, of twenty


@pytest.mark.parametrize("kind", ["vibration", "pulse"])
def test_whole_blocks_and_live_are_the_same_to_the_bit(kind):
    samples = np.random.default_rng(0).normal(size=60_000)
    for number, place in enumerate((3000, 9000, 9400, 9460, 22_000, 30_000, 30_500, 45_000, 59_990)):
        height, length = 10.0 ** (1 + number % 3), 12 + 7 * number
        samples[place : place + length] += height * np.sin(np.pi * np.arange(length) / length)[: 60_000 - place]
        if kind == "vibration":
            own = ringing(amplitude=10 * height)[: 60_000 - place]
            samples[place : place + own.size] += own
    expected = all_of(detected(samples, kind))
    assert len(expected) >= 6
    for size in (1, 7, 100, 4096, 65_536):
        assert all_of(detected(samples, kind, cuts=range(size, 60_000, size))) == expected
    whole = find_impacts(Signal(samples=samples, sampling_rate=RATE, unit="N"), kind=kind)
    assert all_of(replace(event, unit=None, source="signal") for event in whole) == expected
    # Live: read as it comes through a pipe, in pieces of any length.
    reader, writer = os.pipe()
    with os.fdopen(writer, "wb") as pipe, os.fdopen(reader, "rb", buffering=0) as file:
        Thread(target=lambda: (pipe.write(samples.astype("<f8").tobytes()), pipe.close()), daemon=True).start()
        source = UnbufferedInput(file.fileno())
        live = live_stream(source, sampling_rate=RATE, n_channels=1, sample_format="f64le", unit="N")
        detector, events, inbox = ImpactDetector(RATE, kind=kind), [], Inbox(RATE)
        inbox.read(live)
        for block in inbox:
            events += detector.feed(block)
        assert all_of(events + detector.finish()) == expected


# -- gaps and loud samples -------------------------------------------------------------------------------------


def struck(kind, seconds=4.0, seed=0):
    """Samples with an impact every 110 ms or so, of more than a decade in height."""
    random, n_samples = np.random.default_rng(seed), int(seconds * RATE)
    samples = random.normal(size=n_samples)
    for number, place in enumerate(range(1500, n_samples - 4000, 2816)):
        height = 30.0 * 20.0 ** random.random()
        own = ringing(amplitude=3 * height)[: n_samples - place] if kind == "vibration" else height * np.hanning(30)
        samples[place + 7 * number : place + 7 * number + own.size] += own[: n_samples - place - 7 * number]
    return samples


def after(events, sample):
    """What is known of the impacts after a sample, but for the last gap before them."""
    return all_of(replace(event, since=0) for event in events if event.onset > sample)


@pytest.mark.parametrize("kind", ["vibration", "pulse"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("place", [0, 3001, 25_600])
@pytest.mark.parametrize("height", [1e3, -1e5, 1e6])
def test_a_loud_sample_hides_nothing_a_second_later(kind, dtype, place, height):
    samples = struck(kind).astype(dtype)
    expected = after(detected(samples, kind), place + RATE)
    assert len(expected) >= 15
    samples[place] += height
    events = detected(samples, kind)
    assert [own[:3] for own in after(events, place + RATE)] == [own[:3] for own in expected]
    if place:  # The first sample stands in the level from which vibrations are counted: only rounding tells them apart.
        assert after(events, place + RATE) == expected


@pytest.mark.parametrize("kind", ["vibration", "pulse"])
@pytest.mark.parametrize("length", [1, 40, 2000, 30_000])
def test_a_gap_is_in_no_frame_and_hides_nothing_a_second_later(kind, length):
    place, samples = 30_001, struck(kind, 5.0)
    whole = detected(samples, kind)
    samples[place : place + length] = np.nan
    events = detected(samples, kind, gaps=True)
    # Before it nothing changes but frames that reach into it.
    assert [e.onset for e in events if e.onset < place - 200] == [e.onset for e in whole if e.onset < place - 200]
    assert all(np.isfinite(event.samples).all() for event in events)
    assert not [event for event in events if place <= event.onset < place + length]
    assert all(event.since == (place + length if event.onset > place else 0) for event in events)
    late = place + length + RATE
    assert len(after(whole, late)) >= 10
    if kind == "vibration" or length == 1:  # The noise of pulses looks back for two seconds.
        assert after(events, late) == after(whole, late)
    assert [e.onset for e in events if e.onset > late] == [e.onset for e in whole if e.onset > late]
    # Beside it at most what it covers is lost, and nothing is made up.
    assert {e.onset for e in events} <= {e.onset for e in whole}
    assert len(whole) - len(events) <= 2 + length // 2816
    for size in (1000, 4096):
        assert all_of(detected(samples, kind, cuts=range(size, samples.size, size), gaps=True)) == all_of(events)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(["vibration", "pulse"]),
    st.lists(st.tuples(st.integers(0, 30_000), st.integers(1, 9000)), max_size=6),
    st.lists(st.integers(0, 30_000), max_size=5),
    st.booleans(),
)
def test_any_gaps_in_any_blocks_give_the_same(kind, gaps, cuts, joint):
    samples = np.stack([blows([3000, 9000, 9400, 16_000, 25_000], 30_000, seed=seed) for seed in (0, 1)])
    alone = all_of(detected(samples[1], kind))
    for number, (start, length) in enumerate(gaps):
        samples[0 if not joint else number % 2, start : start + length] = np.nan
    events = detected(samples, kind, joint=joint, gaps=True)
    assert all(np.isfinite(event.samples).all() for event in events)
    assert all_of(detected(samples, kind, cuts=sorted(cuts), joint=joint, gaps=True)) == all_of(events)
    if not joint:  # The other channel has no gap.
        assert all_of(replace(event, channel=0) for event in events if event.channel == 1) == alone


@pytest.mark.parametrize("scale", [1e-120, 1e-9, 1.0, 1e9, 1e120])
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_units_and_offsets_change_nothing(scale, offset):
    samples = blows([9000, 20_000], 30_000)
    expected = [(event.onset, event.end) for event in detected(samples)]
    assert len(expected) == 2
    assert [(event.onset, event.end) for event in detected(scale * (samples + offset))] == expected


def test_missing_samples_are_an_error_unless_they_are_expected():
    samples = np.zeros((1, 30_000))
    samples[0, 17_000] = np.nan
    with pytest.raises(BadData):
        ImpactDetector(RATE, kind="pulse").feed(samples)
    samples[0, 16_000] = np.inf
    with pytest.raises(BadData):
        ImpactDetector(RATE, kind="pulse", gaps=True).feed(samples)
    for kind in ("pulse", "vibration"):
        detector = ImpactDetector(RATE, kind=kind, gaps=True)
        assert detector.feed(np.full((1, 30_000), np.nan)) + detector.finish() == []
        assert "read" in detector.why_silent()


# -- every impact that stands clear ---------------------------------------------------------------------------


def outcome(events, truth, sampling_rate, tolerance=1e-3):
    """Return how many of the impacts at some times [s] were found, and how many others."""
    times = np.array([event.onset for event in events]) / sampling_rate
    nearest = [int(np.argmin(np.abs(truth - time))) for time in times]
    hits = {k for k, time in zip(nearest, times, strict=True) if abs(truth[k] - time) < tolerance}
    return len(hits), len(times) - len(hits)


@pytest.mark.parametrize(("spacing", "noise", "found"), [(0.02, 0.001, 600), (0.02, 0.05, 600), (0.06, 0.05, 600)])
def test_600_half_sines_over_two_decades(spacing, noise, found):
    # From 10 ms apart: one is lower than a fiftieth of the blow right before it.
    random, rate, n = np.random.default_rng(1), 200e3, 600
    samples = noise * random.normal(size=round((n + 1) * spacing * rate))
    truth = (np.arange(n) + 0.5 + random.uniform(-0.25, 0.25, n)) * spacing
    for time, height, duration in zip(
        truth, 10 ** random.uniform(0, 2, n), random.uniform(0.2e-3, 1e-3, n), strict=True
    ):
        k = np.arange(math.ceil(time * rate), int((time + duration) * rate))
        samples[k] += height * np.sin(np.pi * (k / rate - time) / duration)
    assert outcome(detected(samples, "pulse", rate), truth, rate) == (found, 0)


@pytest.mark.parametrize(("frequency", "decay"), [(250.0, 0.1), (400.0, 0.05), (1500.0, 0.02), (8000.0, 0.01)])
@pytest.mark.parametrize("sign", [1, -1])
def test_ringing_of_a_force_sensor_is_no_blow_and_hides_none_that_stands_clear(frequency, decay, sign):
    rate = 100e3
    t = np.arange(60_000) / rate
    samples = 0.1 * np.random.default_rng(2).normal(size=100_000)
    samples[30_000:30_060] += 1000 * np.sin(np.pi * np.arange(60) / 60)
    samples[30_060:90_060] += sign * 25 * np.exp(-t / decay) * np.sin(2 * np.pi * frequency * t)
    assert [event.onset for event in detected(samples, "pulse", rate)] == pytest.approx([30_000], abs=3)
    second = 30_000 + round(30e-3 * rate)
    height = 4 * 25 * math.exp(-30e-3 / max(decay, 20e-3))
    samples[second : second + 60] += height * np.sin(np.pi * np.arange(60) / 60)
    found = [event.onset for event in detected(samples, "pulse", rate)]
    assert found == pytest.approx([30_000, second], abs=25)


@pytest.mark.parametrize("rate", [10_000.0, 100_000.0])
@pytest.mark.parametrize(("begin", "seconds"), [(0.05, 0.0), (0.3, 0.0), (1.5, 0.0), (1.0, 3.0)])
def test_noise_that_rises_is_at_most_a_few_pulses(rate, begin, seconds):
    # By 20 dB, at once or within three seconds; the rise at once is an event, and it may be cut in some.
    t = np.arange(int(6 * rate)) / rate
    noise = np.where(t < begin, 0.1, 1.0) if seconds == 0 else 10 ** np.interp(t, [begin, begin + seconds], [-1, 0])
    noise *= np.random.default_rng(6).normal(size=t.size)
    assert len(detected(noise, "pulse", rate)) <= (5 if seconds == 0 else 1)
    noise[int(5.5 * rate) :][:20] += 30.0
    assert detected(noise, "pulse", rate)[-1].onset == int(5.5 * rate)


# -- channels -------------------------------------------------------------------------------------------------


def test_every_channel_has_its_own_impacts_or_all_have_the_same():
    samples = np.stack([blows([4000, 12_000], 26_000), blows([12_100, 20_000], 26_000, seed=1)])
    own = detected(samples)
    assert [(event.channel, event.samples.ndim) for event in own] == [(0, 1), (0, 1), (1, 1), (1, 1)]
    for channel in range(2):
        alone = [(event.onset, event.end, event.samples.tobytes()) for event in detected(samples[channel])]
        assert [(e.onset, e.end, e.samples.tobytes()) for e in own if e.channel == channel] == alone
    joint = detected(samples, joint=True)
    assert [event.channel for event in joint] == [0, 0, 1]
    assert [event.onset for event in joint] == pytest.approx([4000, 12_000, 20_000], abs=4)
    # The other channel hears a hit of its own within the dead time.
    assert [event.overlapping for event in joint] == [False, True, False]
    event = joint[0]
    start = event.onset - 256
    assert np.array_equal(event.samples[:, :4000], samples[:, start : start + 4000])


# -- frames and what is known of them -------------------------------------------------------------------------


def test_frames_are_of_one_length_and_measure_as_the_whole():
    truth = [3000, 9000, 15_000, 22_000]
    events = detected(blows(truth, 30_000, noise=0.1))
    frames = np.stack([event.samples for event in events])
    detector = ImpactDetector(RATE, kind="vibration")
    assert frames.shape == (4, detector.n_samples)
    assert {event.pre_trigger for event in events} == {detector.pre_trigger} == {256 - 26}
    decay, peak = extract_array(
        frames, RATE, ["decay_time", "peak_amplitude"], pre_trigger=detector.pre_trigger, detection_limit=2.0
    ).T
    assert decay == pytest.approx(3 * np.log(10) / (2 * np.pi * 0.02 * 2000.0), rel=0.1)
    assert peak == pytest.approx(97, rel=0.05)


def test_the_end_is_where_one_percent_of_the_energy_is_left():
    # The energy of 2 ms, exp(-2 pi 0.02 2000 t) twice over, reaches it after 9.2 ms; the noise is not reached.
    (event,) = detected(blows([9000], 20_000, noise=0.01))
    assert (event.end - event.onset) / RATE == pytest.approx(np.log(100) / (4 * np.pi * 0.02 * 2000.0), abs=2e-3)
    # In louder noise it is lost in it earlier.
    (event,) = detected(blows([9000], 20_000, noise=60.0))
    assert 1e-3 < (event.end - event.onset) / RATE < 7e-3


def test_two_pulses_within_the_dead_time_are_one_and_marked():
    samples = np.random.default_rng(0).normal(size=20_000)
    samples[5000:5010] += 500.0
    samples[5020:5030] += 400.0
    samples[9000:9010] += 500.0
    assert [event.overlapping for event in detected(samples, "pulse")] == [True, False]


@pytest.mark.parametrize("kind", ["vibration", "pulse"])
def test_clipping_is_marked(kind):
    samples = blows([9000, 15_000], 26_000, frequency=300.0, damping=0.1)
    if kind == "pulse":
        samples = blows([], 26_000)
        samples[9000:9040] += 200 * np.sin(np.arange(40) * np.pi / 40)
        samples[15_000:15_040] += 100 * np.sin(np.arange(40) * np.pi / 40)
    assert [event.clipped for event in detected(samples, kind)] == [False, False]
    assert [event.clipped for event in detected(np.clip(samples, -60.0, 60.0), kind)] == [True, True]


def test_what_the_recording_cuts_is_marked():
    samples = blows([0, 9000, 19_950], 20_000, damping=0.005)
    first, whole, last = detected(samples[20:])
    assert (first.cut, whole.cut, last.cut) == (True, False, True)
    assert "cut off by its start" in first.problem
    assert whole.problem == ""
    assert "last 5 ms" in detected(blows([9000], 9060))[0].problem
    assert {event.samples.size for event in (first, whole, last)} == {whole.samples.size}


# -- anything at all ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["vibration", "pulse"])
def test_silence_and_offsets_have_no_impact(kind):
    for value in (0.0, -7.0, 1e100, 0.1):
        assert detected(np.full((2, 60_000), value), kind) == []
        assert detected(np.full((2, 60_000), np.float32(min(value, 1e30))), kind) == []
    assert detected(np.empty((1, 0)), kind) == []


@pytest.mark.parametrize("start", [0, -1000])
def test_a_drifting_baseline_hides_no_pulse(start):
    samples = np.random.default_rng(0).normal(size=100_000) + np.linspace(start, start + 300, 100_000)
    truth = [5000, 30_000, 70_000, 95_000]
    for place in truth:
        samples[place : place + 20] += 200.0
    assert [event.onset for event in detected(samples, "pulse", 1e5)] == truth


def test_what_is_no_block_is_refused():
    detector = ImpactDetector(RATE, 2, kind="vibration")
    for block in (np.zeros(5), np.zeros((3, 5)), np.zeros((2, 5), complex), [["a"], ["b"]]):
        with pytest.raises(InvalidValue, match=r"shape \(2, n\)"):
            detector.feed(block)
    for value in (np.nan, np.inf, 1e200):
        with pytest.raises(BadData, match="must be finite and within"):
            detector.feed(np.array([[0.0, 1.0], [2.0, value]]))
    detector.finish()
    with pytest.raises(InvalidValue, match="the recording has ended"):
        detector.feed(np.zeros((2, 5)))
    assert detector.finish() == []


@pytest.mark.parametrize("number", range(4))
def test_real_shocks(number):
    if not REAL_SHOCK.is_dir():
        pytest.skip("the real shocks are not beside this checkout (../shared/realdata/shock)")
    (table,) = read_recording(REAL_SHOCK / f"acc_base_a{number}.txt")
    (event,) = detected(table.samples, "pulse", table.sampling_rate)
    assert event.onset < np.argmax(table.samples) < event.end
    # The board rings with the shock; the recording begins 9 ms before.
    (board,) = read_recording(REAL_SHOCK / f"acc_pcb_a{number}.txt")
    event = detected(board.samples, sampling_rate=board.sampling_rate)[0]
    assert event.time == pytest.approx(0.009, abs=1e-3)
    assert not event.cut


@pytest.mark.parametrize(("after", "problem"), [(4.5e-3, True), (5.5e-3, False)])
def test_a_vibration_needs_5_ms_of_recording_even_if_it_is_over(after, problem):
    rate, rng = 50_000, np.random.default_rng(2)
    samples = rng.normal(0, 1e-3, round((0.05 + after) * rate))
    ring = np.arange(samples.size - 2500) / rate
    samples[2500:] += np.exp(-ring / 3e-4) * np.sin(2 * np.pi * 5000 * ring)
    (event,) = find_impacts(Signal(samples=samples, sampling_rate=rate, unit="m/s^2"), kind="vibration")
    assert event.problem.startswith("the vibration must last 5 ms inside the recording") == problem
