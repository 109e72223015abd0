"""Finding impacts: recordings with impacts at known times, and recordings without."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cgid.errors import BadData, CgidError
from cgid.identification.detection.detector import DEAD_TIME, ImpactDetector, find_impacts
from cgid.identification.detection.pulse_onsets import THRESHOLD_OVER_PEAK
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import identify, unmeasured
from cgid.measure.fit import family
from cgid.scene import load_scene, synthesise
from cgid.signals import Signal
from tests import few, naive

ROOT = Path(__file__).parents[1]
RATE = 1e5
DEAD_SAMPLES = int(DEAD_TIME * RATE)


def recording(samples, **fields):
    return Signal(samples=np.asarray(samples), **{"sampling_rate": RATE, "unit": "N", **fields})


def sharp(height, length=30):
    """A blow that is at its height with its first sample, so that its time has no doubt."""
    return height * (1 - np.arange(length) / length) ** 2


def hertzian(height, length=30, restitution=0.6):
    """A pulse of the family; returned from touch on."""
    contact, top, _ = family.times(restitution)
    force = family.force(np.arange(1, length) / length * contact, restitution)
    return height * force / family.force(np.atleast_1d(top), restitution)


def placed(n_samples, blows, noise=0.0, baseline=0.0, seed=0):
    """Blows, {first sample: samples}, on a baseline with noise."""
    samples = np.zeros(n_samples)
    for first, blow in blows.items():
        samples[first : first + len(blow)] += blow[: n_samples - first]
    return samples + baseline + noise * np.random.default_rng(seed).normal(size=n_samples)


def found_samples(samples, **options):
    return [round(event.time * RATE) for event in find_impacts(recording(samples), **options)]


# -- times ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.1, 5.0])
@pytest.mark.parametrize("baseline", [0.0, -1000.0, 37.0, 1e5])
def test_sharp_blows_are_found_at_their_first_sample(noise, baseline):
    truth = [700, 1500, 4000, 9000]
    samples = placed(10_000, {first: sharp(1000) for first in truth}, noise, baseline)
    assert found_samples(samples) == truth


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_pulses_are_found_within_two_samples_of_touch(noise, restitution):
    truth = [700, 1500, 4000, 9000]
    samples = placed(10_000, {first: hertzian(1000, 25, restitution) for first in truth}, noise)
    assert np.abs(np.subtract(found_samples(samples), truth)).max() <= 2


def test_time_is_where_the_threshold_is_passed():
    samples = placed(5000, {1000: hertzian(1000, 400), 3000: hertzian(300, 400)})
    expected = []
    for own in (np.where(np.arange(5000) < 2000, samples, 0), np.where(np.arange(5000) < 2000, 0, samples)):
        expected += naive.stretches(own.tolist(), THRESHOLD_OVER_PEAK * own.max(), DEAD_SAMPLES)
    assert found_samples(samples) == expected


@pytest.mark.parametrize("share", [0.06, 0.1, 0.5])
@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_small_blow_beside_a_large_one_is_found(share, noise):
    samples = placed(10_000, {2000: sharp(1000), 6000: sharp(1000 * share)}, noise)
    assert found_samples(samples) == [2000, 6000]


@pytest.mark.parametrize("share", [1e-4, 1e-3, 0.01, 0.04])
def test_height_of_other_blows_hides_none(share):
    samples = placed(20_000, {2000: sharp(1000 * share), 8000: sharp(1000), 16_000: sharp(1000 * share)}, noise=1e-3)
    assert found_samples(samples) == [2000, 8000, 16_000]


def test_blow_under_the_noise_is_left_out():
    assert found_samples(placed(10_000, {2000: sharp(1000), 6000: sharp(60)}, noise=20.0)) == [2000]


@pytest.mark.parametrize("neighbour", [0.01, 0.5, 30.0])
def test_frame_of_a_blow_does_not_depend_on_its_neighbours(neighbour):
    own, other = {9000: hertzian(1000, 60)}, hertzian(1000 * neighbour, 60)
    alone, together = (
        find_impacts(recording(placed(20_000, blows, noise=0.1))) for blows in (own, own | {5000: other, 13_000: other})
    )
    (event,), same = alone, together[1]
    assert (event.onset, event.end) == (same.onset, same.end)
    assert np.array_equal(event.samples, same.samples)


# -- dead time ------------------------------------------------------------------------------------------------


def test_decaying_ringing_within_the_dead_time_is_the_same_blow():
    t = np.arange(180)
    ringing = 1000 * np.exp(-t / 60) * np.cos(2 * np.pi * t / 25)
    assert found_samples(placed(5000, {1000: ringing, 3000: ringing}, noise=1.0)) == [1000, 3000]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 500), st.floats(0.06, 1.0)), min_size=1, max_size=8),
    st.sampled_from([0.0, 0.5]),
    st.sampled_from([0.0, -300.0, 20.0]),
)
def test_every_blow_further_apart_than_the_dead_time_is_found(blows, noise, baseline):
    gaps, shares = zip(*blows, strict=True)
    firsts = (300 + np.cumsum(np.array(gaps) + DEAD_SAMPLES + 30)).tolist()
    heights = 1000 * np.array(shares) / max(shares)
    # Quiet is what the recording mostly is: the median must fall on it.
    n_samples = firsts[-1] + 1000
    samples = placed(n_samples, {first: sharp(height) for first, height in zip(firsts, heights, strict=True)}, noise)
    assert found_samples(samples + baseline) == firsts


# -- frames ---------------------------------------------------------------------------------------------------


def test_frames_are_cut_from_the_recording_and_share_no_blow():
    samples = placed(5000, {1000: sharp(1000), 1400: sharp(800)}, noise=1.0)
    first, second = (event.signal.samples for event in find_impacts(recording(samples)))
    assert (first.max(), second.max()) == pytest.approx((1000, 800), abs=5)
    # 5 ms before and 15 ms from the onset on; 0.5 ms before the next it ends, and the next has what is behind it.
    assert np.array_equal(first[: 500 + 350], samples[500 : 1000 + 350])
    assert np.ptp(first[500 + 350 :]) == 0
    assert np.array_equal(second[500 - 370 :], samples[1400 - 370 : 1400 + 1500])
    assert first.size == second.size == 2000


def test_a_frame_of_a_dataset_is_one_impact():
    signal = recording(placed(2000, {500: sharp(1000), 1500: sharp(900)}), pre_trigger=500)
    (event,) = find_impacts(signal)
    assert event.signal.samples is signal.samples
    assert (event.time, event.pre_trigger) == (500 / RATE, 500)


# -- the ends of a recording ----------------------------------------------------------------------------------


def test_blow_at_the_very_start_is_found_and_known_to_be_cut():
    (event,) = find_impacts(recording(placed(3000, {0: sharp(1000)})))
    assert event.time == 0
    assert event.cut
    assert "cut off by its start" in event.problem


def test_blow_at_the_very_end_is_found_and_known_to_be_cut():
    (event,) = find_impacts(recording(placed(3000, {2990: sharp(1000)})))
    assert round(event.time * RATE) == 2990
    assert event.cut
    assert "cut off by its end" in event.problem


# -- any length, anything at all ------------------------------------------------------------------------------


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(
        arrays(np.float64, st.integers(1, 60), elements=st.floats(allow_nan=False, allow_infinity=False)),
        arrays(np.float32, st.integers(1, 60), elements=st.floats(allow_nan=False, allow_infinity=False, width=32)),
        arrays(np.float64, st.integers(1, 60), elements=st.integers(-3, 9).map(float)),
    ),
    st.sampled_from([0.0, 2e-5, DEAD_TIME, 1e300]),
)
@example(np.array([3e38, -3e38, 0, 3e38], np.float32), DEAD_TIME)
@example(np.array([0, -2e38, -2e38, -2e38], np.float32), 0.0)
def test_any_finite_recording_is_cut_or_refused(samples, dead_time):
    try:
        events = find_impacts(recording(samples), dead_time=dead_time)
    except CgidError:
        return
    assert events
    assert all(event.signal.samples.size for event in events)
    assert np.all(np.diff([event.time for event in events]) > 0)


# -- a recording that begins with the blow --------------------------------------------------------------------


def answers_from_sample(frames, rate, model, before_touch, first):
    """Return the answer for each frame (n, n_samples) from sample `first` after touch on, with noise behind it."""
    random, found = np.random.default_rng(3), []
    for frame in frames.astype(float):
        quiet = frame[: before_touch - 10]
        behind = random.normal(quiet.mean(), quiet.std(), round(0.05 * rate))
        signal = Signal(samples=np.append(frame[before_touch + first :], behind), sampling_rate=rate, unit=model.unit)
        try:
            found.append(identify(signal, model)[0])
        except BadData as error:
            found.append(unmeasured(str(error)))
    return found


@pytest.mark.parametrize(
    ("scene", "model", "begun", "agreement", "answered"),
    # Without samples before touch, what rings and what is noise is not known: the beam explains fewer.
    few([("reference", "default", 8, 0.95, 0.95), ("tail_beam", "default-acceleration", 12, 0.85, 0.85)]),
)
def test_a_blow_at_sample_0_is_measured(scene, model, begun, agreement, answered):
    """The answer is that of the whole signal; once its flank is cut, most say so and are not answered."""
    scene, model = load_scene(ROOT / "datasets" / f"{scene}.toml"), StoredModel.load(ROOT / "models" / f"{model}.npz")
    (batch,) = synthesise(scene, 60, seed=4)
    given = batch.sampling_rate, model, batch.pre_trigger
    whole = answers_from_sample(batch.signals, *given, -batch.pre_trigger)
    for first in (-10, -2, 0):
        cut = answers_from_sample(batch.signals, *given, first)
        assert not any(answer.cut for answer in cut)
        assert np.mean([answer.label != "unknown" for answer in cut]) > answered
        same = [answer.label == other.label for answer, other in zip(cut, whole, strict=True)]
        assert np.mean(same) >= agreement, first
    begun = answers_from_sample(batch.signals, *given, begun)
    assert np.mean([answer.cut and "cut off by its start" in answer.problem for answer in begun]) > 0.6


@pytest.mark.parametrize("kind", ["pulse", "vibration"])
def test_a_blow_at_sample_0_is_the_same_in_any_blocks(kind):
    blow, times = hertzian(1000, 120), np.arange(8000) / RATE
    if kind == "vibration":
        modes = [np.exp(-2 * np.pi * 0.02 * f * times) * np.cos(2 * np.pi * f * times) for f in (400, 1100, 2500, 4000)]
        blow = 0.05 * np.convolve(blow, sum(modes))
    samples = placed(60_000, {0: blow, 30_000: 0.6 * blow}, noise=1.0)
    whole = find_impacts(Signal(samples=samples, sampling_rate=RATE), kind=kind)
    assert len(whole) >= 2
    assert not whole[0].problem
    for size in (1000, 4567, 41_000):
        detector = ImpactDetector(RATE, kind=kind)
        found = [event for at in range(0, samples.size, size) for event in detector.feed(samples[at : at + size])]
        found += detector.finish()
        assert [(one.onset, one.end, one.samples.tobytes()) for one in found] == [
            (one.onset, one.end, one.samples.tobytes()) for one in whole
        ]
