"""Recordings to answers: by blocks as at once, all channels in order of time, shares, turns, summaries, bad files."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile

from cgid import predict, synthesise
from cgid.cli.main import run
from cgid.errors import BadData
from cgid.identification.detection.windows import measure_windows
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import Answer, PredictionSettings, identify, identify_recording
from cgid.identification.prediction.findings import FindingWarning
from cgid.identification.prediction.fraction import ShutDecision
from cgid.identification.prediction.stream import identify_blocks, independence
from cgid.identification.prediction.support import CavingWatch
from cgid.identification.prediction.vote import RunningVote
from cgid.recordings import open_recording, read_recording
from tests.streams_of_pulses import RATE, ROOT, stream, window_model

LABELS = ["coal"] * 8 + ["gangue"] * 8


@pytest.fixture(scope="module")
def default_model() -> StoredModel:
    return StoredModel.load(ROOT / "models" / "default.npz")


@pytest.fixture(scope="module")
def two_channels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Coal, then gangue; on the second channel the other way round, between the impacts of the first."""
    path = tmp_path_factory.mktemp("streams") / "two.npy"
    first, second = stream(LABELS, 0.02, seed=1), np.roll(stream(LABELS[::-1], 0.02, seed=2), 1500)
    np.save(path, np.stack([first, second]).astype(np.float32))
    return path


def lines_of(capsys: pytest.CaptureFixture[str]) -> list[dict]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def of_kind(rows: list[dict], kind: str) -> list[dict]:
    return [row for row in rows if row["kind"] == kind]


# -- answers of a recording -------------------------------------------------------------------------------


def test_answers_of_a_short_recording_are_those_of_its_signals(two_channels: Path, default_model: StoredModel) -> None:
    found = list(identify_recording(open_recording(two_channels, sampling_rate=RATE, unit="N"), default_model))
    assert [answer.time for answer in found] == sorted(answer.time for answer in found)
    assert len(found) == 32
    for signal in read_recording(two_channels, sampling_rate=RATE, unit="N"):
        alone = identify(signal, default_model)
        own = [answer for answer in found if answer.channel == signal.channel]
        assert [answer.time for answer in own] == [answer.time for answer in alone]
        for answer, other in zip(own, alone, strict=True):
            assert answer.label == other.label
            assert answer.probabilities == pytest.approx(other.probabilities, abs=1e-12)
            assert answer.end > answer.time


@pytest.mark.parametrize("length", [37, 5000, 1 << 20])
@pytest.mark.parametrize("batch", [1, 7, 256])
def test_blocks_and_batches_change_nothing(
    two_channels: Path, default_model: StoredModel, length: int, batch: int
) -> None:
    samples = np.load(two_channels)[:, :48_000].astype(float)
    blocks = [samples[:, first : first + length] for first in range(0, samples.shape[1], length)]
    steps = list(identify_blocks(blocks, RATE, default_model, ("a", "b"), PredictionSettings(batch=batch)))
    whole = identify_blocks([samples], RATE, default_model, ("a", "b"), PredictionSettings())
    expected = [answer for step in whole for answer in step.answers]
    found = [answer for step in steps for answer in step.answers]
    assert [(a.time, a.channel, a.label, a.end) for a in found] == [
        (a.time, a.channel, a.label, a.end) for a in expected
    ]
    for answer, other in zip(found, expected, strict=True):
        assert answer.probabilities == pytest.approx(other.probabilities, abs=1e-9)
    untils = [step.until for step in steps]
    assert untils == sorted(untils)
    told = 0.0
    for step in steps:  # no answer comes for what was said to be told
        assert all(answer.time >= told for answer in step.answers)
        told = step.until
    assert told == pytest.approx(samples.shape[1] / RATE)


def test_units_and_signs_become_the_models(tmp_path: Path, default_model: StoredModel) -> None:
    force = stream(LABELS[:4], 0.02)
    answers = []
    for name, samples, unit, how in (
        ("n", force, "N", {}),
        ("kn", force / 1e3, "kN", {}),
        ("down", -force, "N", {"invert": True}),
        ("impactor", force / 2.5, "m/s^2", {"mass": 2.5}),
    ):
        np.save(tmp_path / f"{name}.npy", samples)
        recording = open_recording(tmp_path / f"{name}.npy", sampling_rate=RATE, unit=unit)
        found = identify_recording(recording, default_model, PredictionSettings(**how))
        answers.append([a.probabilities["coal"] for a in found])
    for other in answers[1:]:
        assert other == pytest.approx(answers[0], rel=1e-6)


# -- windows ----------------------------------------------------------------------------------------------


def noises(n_windows: int = 12) -> np.ndarray:
    """Dull noise, then white noise, 0.1 s each a window at 8 kHz."""
    rng = np.random.default_rng(4)
    dull = np.cumsum(rng.normal(size=(2, 800 * n_windows // 2)), axis=1)
    return np.concatenate([dull / np.abs(dull).max(), rng.normal(size=dull.shape) / 5], axis=1) / 2


@pytest.mark.parametrize("n_channels", [1, 2])
def test_windows_are_answered_by_their_vote(n_channels: int) -> None:
    model, samples = window_model(n_channels), noises()
    starts = np.arange(0, samples.shape[1] - 800 + 1, 400)
    question = PredictionSettings(vote_time=0.3)
    blocks = [samples[:, first : first + 1000] for first in range(0, samples.shape[1], 1000)]
    found = [a for s in identify_blocks(blocks, 8000.0, model, ("l", "r"), question) for a in s.answers]
    groups = [("l+r", slice(0, 2))] if n_channels == 2 else [("l", slice(0, 1)), ("r", slice(1, 2))]
    assert len(found) == len(groups) * len(starts)
    for name, rows in groups:
        own = [answer for answer in found if answer.channel == name]
        windows = np.stack([samples[rows, start : start + 800] for start in starts])
        features = measure_windows(windows, 8000.0, model.features)
        known = model.novelty(features) <= 1
        logs = np.where(known[:, None], np.log(np.maximum(model.probabilities(features), 1e-6)), np.nan)
        means = np.exp([np.nanmean(logs[max(k - 4, 0) : k + 1], axis=0) for k in range(len(starts))])
        assert 0 < np.sum(~known) < 3
        expected = means / means.sum(axis=1, keepdims=True)  # five windows, half overlapping, last 0.3 s
        assert [a.time for a in own] == pytest.approx(starts / 8000)
        assert [a.end - a.time for a in own] == pytest.approx([0.1] * len(starts))
        assert [a.probabilities["gangue"] for a in own] == pytest.approx(expected[:, 1], abs=1e-9)
    assert RunningVote.over(0.3, 0.1, 0.05).n_windows == 5


def test_windows_of_silence_are_unknown_and_have_no_vote() -> None:
    model, samples = window_model(hop_time=0.1), noises()[:1]
    samples[:, 1600:3200] = 0.0
    (step,) = identify_blocks([samples], 8000.0, model, ("1",), PredictionSettings(vote_time=0.2))
    (other,) = identify_blocks(
        [np.delete(samples, np.s_[1600:3200], 1)], 8000.0, model, ("1",), PredictionSettings(vote_time=0.2)
    )
    assert [a.label for a in step.answers[2:4]] == ["unknown"] * 2
    assert "silent" in step.answers[2].problem
    told = [a.probabilities for a in step.answers[:2] + step.answers[4:]]
    for one, two in zip(told, (a.probabilities for a in other.answers), strict=True):
        assert one == pytest.approx(two, abs=1e-12)


def test_a_model_of_two_channels_asks_for_two() -> None:
    with pytest.raises(BadData, match="channels must be 2, which this model uses together, got 3"):
        list(identify_blocks([noises()], 8000.0, window_model(2), ("1", "2", "3"), PredictionSettings()))


def test_votes_that_overlap_count_less() -> None:
    assert independence(window_model(), PredictionSettings(vote_time=0.0)) == pytest.approx(0.5)
    assert independence(window_model(), PredictionSettings(vote_time=0.5)) == pytest.approx(0.1)


# -- shares and turns -------------------------------------------------------------------------------------


def answers_at(times: np.ndarray, probabilities: np.ndarray, channel: str = "1") -> list[Answer]:
    return [
        Answer(time=t, label="x", probabilities={"coal": 1 - p, "gangue": p}, novelty=0.5, channel=channel)
        for t, p in zip(times.tolist(), probabilities.tolist(), strict=True)
    ]


def test_watch_tells_the_same_however_answers_come(default_model: StoredModel) -> None:
    rng = np.random.default_rng(2)
    times = np.sort(rng.uniform(0, 30, 400))
    answers = answers_at(times, np.clip(rng.normal(times / 30, 0.2), 0, 1))
    settings = PredictionSettings(share_time=6.0, share_step=2.0, dilution_cost=1.5)

    def told(portion: int) -> list:
        watch = CavingWatch(default_model, ("1",), settings)
        said = []
        for first in range(0, len(answers), portion):
            part = answers[first : first + portion]
            said += watch.feed(part, part[-1].time)
        return said + watch.finish(30.0)

    whole = told(400)
    assert told(1) == whole
    shares = [one.state.share for one in whole if one.kind == "share"]
    turns = [one.switch for one in whole if one.switch is not None]
    assert [share.time for share in shares] == pytest.approx(np.arange(2.0, 31.0, 2.0))
    assert [turn.shut for turn in turns] == [True]
    losing = [ShutDecision(1.5).cost(share) > 0 for share in shares]  # at steps of a third of the window
    assert turns[0].share == next(share for k, share in enumerate(shares) if k and losing[k - 1] and losing[k])


# -- the command ------------------------------------------------------------------------------------------


def test_predict_tells_impacts_shares_and_a_summary(two_channels: Path, capsys: pytest.CaptureFixture[str]) -> None:
    how = ["--rate", str(RATE), "--unit", "N", "--set", "window=0.16", "--set", "dilution_cost=2"]
    assert run(["predict", str(two_channels), "--json", *how]) == 0
    rows = lines_of(capsys)
    assert {row["version"] for row in rows} == {7}
    impacts = of_kind(rows, "impact")
    assert [row["time_s"] for row in impacts] == sorted(row["time_s"] for row in impacts)
    assert [row["impact"] for row in impacts if row["channel"] == "2"] == list(range(1, 17))
    for channel, labels in (("1", LABELS), ("2", LABELS[::-1])):
        own = [row["label"] for row in impacts if row["channel"] == channel]
        assert np.mean([a == b for a, b in zip(own, labels, strict=True)]) > 0.9
    shares = [row for row in of_kind(rows, "share") if row["channel"] == "1"]
    assert [row["to_s"] for row in shares] == pytest.approx([0.08, 0.16, 0.24, 0.32])
    assert shares[1]["gangue_share"] < 0.35 < 0.6 < shares[3]["gangue_share"]
    assert all(row["low"] <= row["gangue_share"] <= row["high"] for row in shares)
    (summary,) = of_kind(rows, "summary")
    assert (summary["impacts"], summary["duration_s"]) == (32, pytest.approx(0.32))
    assert sum(summary["labels"].values()) == 32

    assert run(["predict", str(two_channels), *how, "--fractions"]) == 0
    out, err = capsys.readouterr()
    table = list(csv.DictReader(io.StringIO(out)))
    assert [row["label"] for row in table] == [row["label"] for row in impacts]
    assert [float(row["p_coal"]) for row in table] == pytest.approx(
        [row["probabilities"]["coal"] for row in impacts], abs=5.1e-5
    )
    assert sum(row["channel"] == "1" for row in table) == 16
    text = err.splitlines()
    assert sum(line.startswith(f"{two_channels} channel 1: gangue fraction ") for line in text) == 1
    assert text[-1].startswith(f"{two_channels}: 32 impacts: ")


def coal_then_gangue() -> np.ndarray:
    """Return 80 rocks, mostly coal, then 100, mostly gangue, one every 20 ms [N]."""
    batch, rng = next(iter(synthesise("reference", 240, seed=5))), np.random.default_rng(0)
    signals = np.asarray(batch.signals, float)
    coal, gangue = (np.flatnonzero(batch.labels == label).tolist() for label in ("coal", "gangue"))
    parts = [rng.permutation(coal[:75] + gangue[:5]), rng.permutation(gangue[5:95] + coal[75:85])]
    quiet = rng.normal(0, signals[:, :50].std(), (180, round(0.01 * RATE)))
    return np.concatenate([quiet, signals[np.concatenate(parts)]], axis=1).ravel()


def test_predict_says_when_to_shut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "s.npy", coal_then_gangue().astype(np.float32))
    arguments = ["predict", str(tmp_path / "s.npy"), "--rate", str(RATE), "--unit", "N", "--set", "window=1.4"]
    arguments += ["--set", "trained_seam=true"]
    assert run([*arguments, "--json"]) == 0
    rows = lines_of(capsys)
    (shut,) = of_kind(rows, "shut")
    assert 1.6 < shut["time_s"] <= 3.5
    assert 0 < shut["cost"] <= 2 * shut["gangue_share"] - 1 + 1e-6  # the expected share lies nearer to the middle
    assert 0.95 <= shut["evidence"] <= 1
    assert not of_kind(rows, "open")
    before = [row for row in of_kind(rows, "share") if row["to_s"] < shut["time_s"]]
    assert all(row["low"] < 0.5 for row in before)
    assert run([*arguments, "--fractions"]) == 0
    assert sum(line.startswith("SHUT ") for line in capsys.readouterr().err.splitlines()) == 1
    assert run(arguments) == 0  # one paragraph, with the time
    (last,) = (line for line in capsys.readouterr().err.splitlines() if " impacts: " in line)
    assert last.count("gangue fraction") == 1 and last.endswith(f"SHUT at {shut['time_s']:.6g} s")


def test_summary_alone_and_fractions_from_ten_answers_on(
    two_channels: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command = ["predict", str(two_channels), "--rate", str(RATE), "--unit", "N", "--set", "window=0.24"]
    assert run([*command, "--json"]) == 0
    rows = lines_of(capsys)
    assert run([*command, "--fractions"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "gangue fraction" in line and " answers" in line]
    shares = of_kind(rows, "share")
    last = [[row for row in shares if row["channel"] == channel][-1] for channel in ("1", "2")]
    enough = [row for row in shares if row["impacts"] >= 10 and row not in last]
    assert len(told) == len(enough) + 2 < len(shares)
    assert run([*command, "--summary"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.partition("; SHUT")[0] for line in out if "gangue fraction" in line] == told[-2:]
    assert f": {len(of_kind(rows, 'impact'))} impacts: " in out[-3]
    assert "p_coal" not in "".join(out)
    assert run([*command, "--summary", "--json"]) == 0
    alone = lines_of(capsys)
    assert not of_kind(alone, "impact")
    assert of_kind(alone, "share") == last
    assert of_kind(alone, "summary") == of_kind(rows, "summary")
    assert run([*command, "--summary", "-o", str(tmp_path / "rows.csv")]) == 0
    assert capsys.readouterr().out.splitlines() == out
    assert run([*command, "-o", str(tmp_path / "all.csv")]) == 0
    assert (tmp_path / "rows.csv").read_bytes() == (tmp_path / "all.csv").read_bytes()


def test_silent_channel_is_a_warning_and_silence_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    force = stream(LABELS[:3], 0.02)
    quiet = np.random.default_rng(0).normal(0, 25, force.size)
    how = ["--rate", str(RATE), "--unit", "N", "--json"]
    np.save(tmp_path / "a.npy", np.stack([force, quiet]))
    assert run(["predict", str(tmp_path / "a.npy"), *how]) == 0
    out, err = capsys.readouterr()
    (warning,) = of_kind([json.loads(line) for line in out.splitlines()], "finding")
    assert (warning["channels"], warning["finding"]) == (["2"], "silent")
    assert "channel 2: no impact" in err
    np.save(tmp_path / "many.npy", np.stack([force, *[quiet] * 9]))
    assert run(["predict", str(tmp_path / "many.npy"), *how]) == 0
    (told,) = (line for line in capsys.readouterr().err.splitlines() if "no impact" in line)
    assert "channels 2, 3, 4 and 6 more: " in told
    assert run(["features", str(tmp_path / "many.npy"), *how]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 3 and err.count("no impact") == 3 and "and 6 more channels cannot" in err
    np.save(tmp_path / "b.npy", np.stack([quiet, quiet]))
    assert run(["predict", str(tmp_path / "b.npy"), *how]) == 65
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1


def test_recordings_of_two_quantities_have_two_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    force = stream(LABELS[:2], 0.02)
    force = np.concatenate([force, force[: round(0.01 * RATE)]])  # a vibration needs 5 ms after its onset
    times = np.arange(force.size) / RATE
    rows = [f"{t!r},{f!r},{f / 40!r}" for t, f in zip(times.tolist(), force.tolist(), strict=True)]
    (tmp_path / "m.csv").write_text("time (s),hammer (N),beam (m/s^2)\n" + "\n".join(rows) + "\n")
    assert run(["predict", str(tmp_path / "m.csv"), "--json"]) == 0
    out = capsys.readouterr().out
    impacts = of_kind([json.loads(line) for line in out.splitlines()], "impact")
    assert [row["in_training_range"] for row in impacts if row["channel"] == "hammer"] == [True, True]
    assert {row["channel"] for row in impacts} == {"hammer", "beam"}
    # The model of vibrations, at the rate of its recorder, has not seen a pulse that does not ring.
    assert {row["label"] for row in impacts if row["channel"] == "beam"} == {"unknown"}
    assert min(row["novelty"] for row in impacts if row["channel"] == "beam") > 1
    text = (tmp_path / "m.csv").read_text().replace("beam (m/s^2)", "heat (V)")
    (tmp_path / "m.csv").write_text(text)
    assert run(["predict", str(tmp_path / "m.csv"), "--json"]) == 0
    rows = lines_of(capsys)
    assert {row["channel"] for row in of_kind(rows, "impact")} == {"hammer"}
    assert "channel heat: the samples are a voltage [V]" in of_kind(rows, "finding")[0]["message"]


def test_model_of_windows_answers_windows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "m.npz").write_bytes(window_model(hop_time=0.1).to_bytes())
    wavfile.write(tmp_path / "n.wav", 8000, noises(24).T.astype(np.float32))
    arguments = ["predict", str(tmp_path / "n.wav"), "--model", str(tmp_path / "m.npz"), "--json", "--set", "vote=0"]
    assert run([*arguments, "--set", "window=1.2"]) == 0
    rows = lines_of(capsys)
    windows = [row for row in of_kind(rows, "window") if row["channel"] == "1"]
    assert [row["window"] for row in windows] == list(range(1, 25))
    assert [row["label"] for row in windows] == ["coal"] * 12 + ["gangue"] * 12
    assert {row["channel"] for row in of_kind(rows, "share")} == {"1", "2"}
    (summary,) = of_kind(rows, "summary")
    assert summary["windows"] == 48
    assert run([*arguments, "--set", "gangue=granite"]) == 65
    assert "gangue label must be one of" in capsys.readouterr().err
    wavfile.write(tmp_path / "short.wav", 8000, noises(12).T[:500].astype(np.float32))
    arguments[1] = str(tmp_path / "short.wav")
    assert run(arguments) == 65
    assert "must contain a window of 0.1 s" in capsys.readouterr().err


def test_python_hears_what_the_command_hears_beside_a_gap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Samples that are not finite are no reading, of a file and of an array alike."""
    (whole,) = read_recording(ROOT / "datasets" / "sample.csv")
    samples = whole.samples.astype("<f4")
    samples[:50], samples[-7] = np.nan, np.inf
    np.save(tmp_path / "gaps.npy", samples)
    how = {"sampling_rate": whole.sampling_rate, "unit": "N"}
    assert (
        run(["predict", str(tmp_path / "gaps.npy"), "--rate", repr(whole.sampling_rate), "--unit", "N", "--json"]) == 0
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    rows = [line for line in lines if line["kind"] == "impact"]
    (gap,) = (line for line in lines if line.get("finding") == "missing")
    for given in (tmp_path / "gaps.npy", samples, samples.astype(float)):
        with pytest.warns(FindingWarning, match="51 samples in 2 gaps"):
            table = predict(given, **how)
        assert list(table["label"]) == [row["label"] for row in rows] and len(rows) >= 5
        np.testing.assert_allclose(table["time_s"], [row["time_s"] for row in rows], atol=1e-6)
        assert table.attrs["findings"][0]["message"] == gap["message"]
    with pytest.warns(FindingWarning, match="no reading|no impact"), pytest.raises(BadData, match="must be finite"):
        predict(np.full(5000, np.nan), 25600.0, "N")
    with pytest.raises(BadData, match="real numbers"):
        predict(np.ones(5000, complex), 25600.0, "N")
