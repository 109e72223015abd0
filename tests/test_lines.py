"""Lines taken out of accelerations: the tones of machines."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray

from cgid import load_model, predict
from cgid.errors import BadData, InvalidValue
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.recordings.lines import FRAME_TIME, HEARD_AFTER, Lines

RATE = 25_600.0
#: Standard deviation of the noise of the streams [m/s^2].
NOISE = 1.0
#: A machine that runs from the begin on is heard by then [s].
HEARD = 3.0
Floats = NDArray[np.float64]


def noise(seconds: float, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).normal(0, NOISE, round(seconds * RATE))


def tone(n: int, frequency: float | Floats, level: float = 30.0) -> Floats:
    """Return a sine of a frequency [Hz], fixed or of each sample."""
    return level * np.sin(2 * np.pi * np.cumsum(np.broadcast_to(frequency, n)) / RATE + 0.4)


def rings(n: int, rate: float, seed: int = 0, damping: float = 0.02) -> tuple[Floats, Floats]:
    """Return what a beam of a few damped modes answers to impacts at random, and their times [s]."""
    rng, at, out = np.random.default_rng([seed, 1]), np.arange(round(0.002 / damping * RATE)) / RATE, np.zeros(n)
    times = np.sort(rng.uniform(1, n / RATE - 1, round(rate * (n / RATE - 2))))
    for time in times:
        first = round(time * RATE)
        for f, strength in zip((640.0, 1300.0, 1900.0, 5200.0), rng.lognormal(3.0, 0.8, 4), strict=True):
            decay = np.exp(-2 * np.pi * damping * f * at)
            out[first : first + len(at)] += strength * decay * np.sin(2 * np.pi * f * at)
    return out, times


def without(samples: NDArray[np.floating], *, size: int | None = None, rate: float = RATE) -> NDArray[np.floating]:
    """Return channels without their lines, fed in blocks of a size."""
    size = size or max(samples.shape[1], 1)
    blocks = (samples[:, first : first + size] for first in range(0, samples.shape[1], size))
    lines = Lines(len(samples), rate)
    return np.concatenate([samples[:, :0], *map(lines.feed, blocks), lines.finish()], axis=1)


def loud() -> tuple[Floats, Floats]:
    """Return two channels of impacts, noise and tones, and the same without tones."""
    n = round(10 * RATE)
    quiet = np.stack([noise(10, 1), noise(10, 2)]) + rings(n, 4.0)[0]
    return quiet + np.stack([tone(n, 297.3) + tone(n, 1203.0, 9.0), tone(n, 49.8, 3.0)]), quiet


def test_a_tone_goes_and_the_noise_stays() -> None:
    # The bands of two lines have some thousandths of the power of white noise; Hann's side lobes beyond them have a
    # thousandth of the amplitude of a tone, which is 30 standard deviations.
    samples, quiet = noise(10) + tone(round(10 * RATE), 297.3) + tone(round(10 * RATE), 1203.0), noise(10)
    left = without(samples[None])[0] - quiet
    inside = slice(round(HEARD * RATE), round(9 * RATE))
    assert np.std(left[inside]) < 0.1 * NOISE
    assert np.std((left + quiet)[inside]) == pytest.approx(NOISE, rel=0.01)


def test_impacts_keep_their_shape() -> None:
    # What is taken out is at most what passes the last clip, three standard deviations, in the bands of the lines.
    samples, quiet = loud()
    changed = np.abs(without(samples) - quiet)
    for time in rings(samples.shape[1], 4.0)[1]:
        if time < HEARD:
            continue
        around = slice(round((time - 0.005) * RATE), round((time + 0.08) * RATE))
        assert changed[:, around].max() < 3 * NOISE
    assert np.median(changed[:, round(HEARD * RATE) :]) < 0.1 * NOISE


@pytest.mark.parametrize("size", [1000, 7777, 100_000])
def test_blocks_do_not_matter(size: int) -> None:
    samples = loud()[0]
    samples[0, 70_000:70_010] = np.nan
    samples[1, 120_000:140_000] = np.nan
    whole = without(samples)
    assert whole.shape == samples.shape
    np.testing.assert_array_equal(without(samples, size=size), whole)
    np.testing.assert_array_equal(np.isnan(whole), np.isnan(samples))
    np.testing.assert_array_equal(without(samples[1:])[0], whole[1])


@pytest.mark.parametrize("rate", [4000.0, 8000.0, 25_600.0, 44_100.0, 51_200.0, 97_656.25, 1e6])
def test_no_sample_waits_for_more_than_half_a_second(rate: float) -> None:
    fed = given = 0
    lines = Lines(1, rate)

    def blocks() -> Iterable[Floats]:
        nonlocal fed
        for _ in range(70):
            yield np.random.default_rng(fed).normal(size=(1, round(0.03 * rate)))
            # The consumer has had all that came out.
            assert fed == 0 or fed - given <= FRAME_TIME * rate
            fed += round(0.03 * rate)

    for block in map(lines.feed, blocks()):
        given += block.shape[1]
    given += lines.finish().shape[1]
    assert given == fed


def test_future_samples_do_not_matter() -> None:
    samples = loud()[0]
    until = round(5 * RATE)
    known = until - round(FRAME_TIME * RATE)
    early = Lines(2, RATE).feed(samples[:, :until])
    assert early.shape[1] >= known
    np.testing.assert_array_equal(early, without(samples)[:, : early.shape[1]])


def test_without_tones_nothing_changes() -> None:
    white = noise(20).astype(np.float32)[None]
    left = without(white, size=5000)
    assert left.dtype == np.float32
    np.testing.assert_array_equal(left, white)
    # The ring-down of a mode that one rock excites can look like a line for a moment.
    rung = np.stack([noise(60, seed) + rings(round(60 * RATE), rate, seed)[0] for seed, rate in ((1, 4.0), (2, 15.0))])
    np.testing.assert_array_equal(without(rung), rung)


@pytest.mark.parametrize("damping", [0.02, 0.005, 0.002])
def test_the_ring_down_of_narrow_modes_is_no_tone(damping: float) -> None:
    rung = np.stack([noise(60, seed) + rings(round(60 * RATE), 8.0, seed, damping)[0] for seed in (3, 4)])
    np.testing.assert_array_equal(without(rung), rung)


def test_a_machine_that_has_stopped_is_forgotten() -> None:
    stop = round(4 * RATE)
    samples = noise(70)
    samples[:stop] += tone(stop, 297.0)
    # What one frame alone shows counts only while a machine runs; it is short.
    for at in (6.0, 66.0):
        first, length = round(at * RATE), round(RATE)
        samples[first : first + length] += tone(length, 1203.0)
    left = without(samples[None])[0]
    early, late = (slice(round((at + 0.4) * RATE), round((at + 0.6) * RATE)) for at in (6.0, 66.0))
    assert np.std(left[early]) < 2 * NOISE
    np.testing.assert_array_equal(left[late], samples[late])


def test_a_gap_begins_anew() -> None:
    samples, quiet = (part[:1] for part in loud())
    other = quiet + tone(samples.shape[1], 431.0)
    end = 24 * Lines(1, RATE).length // 2
    other[:, end:] = samples[:, end:]
    for one in (samples, other):
        one[:, end - 20_000 : end] = np.nan
    np.testing.assert_array_equal(without(samples)[:, end:], without(other)[:, end:])


def test_a_lost_sample_does_not() -> None:
    samples, quiet = loud()
    samples[:, 1000::2000] = np.nan
    left = (without(samples) - quiet)[:, round(HEARD * RATE) : round(9 * RATE)]
    assert np.nanmedian(np.abs(left)) < 0.1 * NOISE
    assert np.isnan(left).sum() == np.isnan(samples[:, round(HEARD * RATE) : round(9 * RATE)]).sum()


def test_a_change_of_level_begins_anew() -> None:
    samples, quiet = loud()
    half = samples.shape[1] // 2
    samples[:, half:] *= 0.05
    samples[:, half:] += 300.0
    left = without(samples)[:, half + round(RATE) : round(9 * RATE)]
    wanted = 0.05 * quiet[:, half + round(RATE) : round(9 * RATE)] + 300.0
    assert np.median(np.abs(left - wanted)) < 0.1 * 0.05 * NOISE


def test_clipped_samples_stay_equal() -> None:
    samples = np.clip(loud()[0][:1], -110.0, 110.0)
    limits = np.abs(samples) == 110.0
    assert limits.sum() > 30
    left = without(samples)
    np.testing.assert_array_equal(left[limits], samples[limits])
    heard = ~limits & (np.arange(samples.size) > HEARD * RATE)
    assert np.mean(left[heard] != samples[heard]) > 0.99


def told(samples: Floats) -> list[int]:
    lines = Lines(1, RATE)
    found = []
    for first in range(0, samples.size, 6400):
        lines.feed(samples[None, first : first + 6400])
        found += lines.told()
    return found


def test_lines_that_move_or_come_and_go_are_told() -> None:
    n = round(40 * RATE)
    at, impacts = np.arange(n) / RATE, noise(40) + rings(n, 4.0)[0]
    assert told(impacts) == []
    assert told(impacts + tone(n, 297.0)) == []
    # By 2 Hz in all, within eight seconds.
    assert told(impacts + tone(n, 297.0 + np.sin(2 * np.pi * at / 8))) == []
    # By 10 Hz in 4 s, and back.
    assert told(impacts + tone(n, 297.0 + 10 * np.abs(at % 8 - 4))) == [0]
    assert told(impacts + (at % 6 < 3) * tone(n, 297.0)) == [0]


def test_a_motor_that_runs_up_is_not_made_worse() -> None:
    n = round(20 * RATE)
    at, quiet = np.arange(n) / RATE, noise(20)
    speed = np.interp(at % 10, (0, 3, 7, 10), (10, 60, 60, 10))
    samples = quiet + sum(tone(n, order * speed, 10.0) for order in (1, 3, 6, 20))
    left = without(samples[None])[0] - quiet
    before = np.square(samples - quiet).reshape(-1, 512).mean(axis=1)
    after = np.square(left).reshape(-1, 512).mean(axis=1)
    assert after.sum() < 0.5 * before.sum()
    assert np.mean(after > 1.2 * before + NOISE**2) < 0.01


def answers(samples: NDArray[np.floating], **fields: bool) -> tuple[Floats, list[str]]:
    """Return time and unexplained energy [%] of each impact, and the warnings."""
    model, found, lines = load_model("default-acceleration"), [], []
    for step in identify_blocks([samples], RATE, model, ["1"], PredictionSettings(**fields)):
        found += [(answer.time, answer.unexplained) for answer in step.answers]
        lines += [one.line("signal") for one in step.found if not one.is_note]
    return np.array(found), lines


@pytest.mark.filterwarnings("ignore:samples")
def test_recordings_are_answered_without_their_lines() -> None:
    samples, quiet = (part[:1].astype(np.float32) for part in loud())
    samples += 9 * (samples - quiet)
    alone, out, kept = answers(quiet)[0], answers(samples)[0], answers(samples, lines=False)[0]
    np.testing.assert_array_equal(answers(quiet, lines=False)[0], alone)

    def missed(found: Floats) -> int:
        heard = alone[alone[:, 0] > HEARD, :1]
        return int(np.sum(np.abs(found[:, 0] - heard).min(axis=1) > 1e-3))

    assert missed(out) == 0 < missed(kept)
    for found, fields in ((out, {}), (kept, {"lines": False})):
        table = predict(samples[0], RATE, "m/s^2", **fields)
        np.testing.assert_array_equal(table["time_s"], found[:, 0])


def test_the_warning_names_the_channel_and_a_cure() -> None:
    n = round(40 * RATE)
    samples = noise(40) + rings(n, 4.0)[0] + (np.arange(n) / RATE % 6 < 3) * tone(n, 297.0)
    (line,) = answers(samples[None])[1]
    assert line.startswith("signal: tones of a machine begin, end or move")
    assert "--set", "lines=false" in line
    (line,) = answers((noise(40) + rings(n, 4.0, damping=0.005)[0] + tone(n, 297.0))[None])[1]
    assert "or the beam rings long beside them" in line  # the machine is steady
    assert not answers(samples[None], lines=False)[1]


def test_a_machine_that_is_known_to_run_is_taken_out_from_the_begin() -> None:
    n = round(4 * RATE)
    samples = noise(4) + tone(n, 297.0)
    first = slice(0, round(RATE))
    heard, known = (
        np.concatenate([lines.feed(samples[None]), lines.finish()], axis=1)[0]
        for lines in (Lines(1, RATE), Lines(1, RATE, from_begin=True))
    )
    np.testing.assert_array_equal(heard[first], samples[first])
    assert known[first].std() < 0.3 * samples[first].std()


@pytest.mark.parametrize("size", [6400, 128_000])
def test_tones_are_noted_however_long_the_blocks_are(size: int) -> None:
    samples, model = loud()[0][:1, :128_000], load_model("default-acceleration")
    for lines in (None, True):
        blocks = (samples[:, first : first + size] for first in range(0, samples.shape[1], size))
        steps = list(identify_blocks(blocks, RATE, model, ["1"], PredictionSettings(lines=lines), "belt"))
        (note,) = (one for step in steps for one in step.found if one.is_note)
        assert note.kind == "tones" and note.fields["tone"] > 0


def test_a_machine_is_heard_each_time_it_begins() -> None:
    n, start = round(12 * RATE), 4.0
    samples = np.stack([noise(12), noise(12, 1), noise(12, 2)])
    samples[1] += tone(n, 297.0)
    samples[2] += (np.arange(n) / RATE > start) * tone(n, 297.0)
    lines, heard = Lines(3, RATE), list[tuple[int, float]]()
    for first in range(0, n, 6400):
        assert lines.feed(samples[:, first : first + 6400]).shape[0] == 3
        heard += lines.heard().items()
    (first, at), (second, later) = heard
    assert (first, second) == (1, 2)
    assert at == HEARD_AFTER
    assert start < later < start + HEARD_AFTER + FRAME_TIME
    known = Lines(3, RATE, from_begin=True)
    known.feed(samples)
    assert not known.heard()


def test_bad_input() -> None:
    with pytest.raises(InvalidValue, match="lines must be"):
        PredictionSettings(lines="no")  # type: ignore[arg-type]
    model = load_model("default-acceleration")
    for block in (np.zeros((2, 30_000)), np.zeros((1, 30_000), complex)):
        with pytest.raises(InvalidValue, match="a block must be real numbers"):
            list(identify_blocks([np.zeros((1, 100)), block], RATE, model, ["1"], PredictionSettings()))
    samples = loud()[0][:1]
    samples[0, 100_000] = np.inf
    with warnings.catch_warnings(), pytest.raises(BadData, match="samples must be finite"):
        warnings.simplefilter("error")
        list(identify_blocks([samples], RATE, model, ["1"], PredictionSettings()))


@pytest.mark.parametrize("n", [0, 1, 100, 12_799, 12_800, 20_000])
@pytest.mark.parametrize("value", [0.0, 3.0, np.nan])
def test_silent_and_short_recordings_stay(n: int, value: float) -> None:
    samples = np.full((1, n), value)
    np.testing.assert_array_equal(without(samples), samples)


def test_a_recording_that_is_one_tone_becomes_silent() -> None:
    n = round(10 * RATE)
    left = without(tone(n, 120.0)[None])[0]
    assert (left[round(HEARD * RATE) : -round(RATE)] == 0).all()
    assert told(tone(n, 120.0)) == []
    steady = 5.0 + without(tone(n, 120.0).astype(np.float32)[None])[0]
    assert np.ptp(steady[round(HEARD * RATE) : -round(RATE)]) == 0


def test_predicting_imports_no_scipy() -> None:
    code = "import sys, cgid.recordings.lines; assert not {'scipy', 'sklearn'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_machine_whose_tones_wander_is_heard(seed: int) -> None:
    n = round(6 * RATE)
    wander = 2.0 * np.sin(2 * np.pi * 0.7 * np.arange(n) / RATE)
    impacts = noise(6, seed) + rings(n, 8.0, seed=seed)[0]

    def heard(*tones: float) -> dict[int, float]:
        lines = Lines(1, RATE)
        lines.feed((impacts + sum(tone(n, f + wander, 5.0) for f in tones))[None])
        return lines.heard()

    assert heard() == {}
    assert heard(147.0, 412.0, 1030.0)[0] <= HEARD_AFTER + FRAME_TIME
    # One alone is one that stays for longer.
    assert heard(412.0)[0] <= HEARD_AFTER + 3 * FRAME_TIME
