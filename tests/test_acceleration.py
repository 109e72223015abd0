"""Models of acceleration: what they look at, how impacts are found in a vibration, and which default model answers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from cgid import shipped
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection import find_impacts
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import identify, identify_frames, prediction
from cgid.identification.training import Training, train_on_specimens
from cgid.identification.training.rows import (
    DEFAULT_FEATURES,
    DEFAULT_GUARDS,
    DEFAULT_VIBRATION_FEATURES,
    default_guards,
    measure,
)
from cgid.signals import Batch, Signal
from cgid.units import STANDARD_GRAVITY
from tests.ringing import N_SAMPLES, PRE_TRIGGER, RATE, damped_sinusoid, ringing_batch


@pytest.fixture(scope="module")
def fresh() -> Batch:
    return ringing_batch(120, seed=2)


@pytest.fixture(scope="module")
def training() -> Training:
    return train_on_specimens([ringing_batch(300, seed=1)])


@pytest.fixture(scope="module")
def model_file(training: Training, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "vibration.npz"
    path.write_bytes(training.model.to_bytes())
    return path


@pytest.fixture
def default_model(model_file: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    ship = shipped.path_of
    monkeypatch.setattr(
        shipped, "path_of", lambda kind, name: model_file if name == shipped.ACCELERATION_MODEL else ship(kind, name)
    )
    prediction._shipped.cache_clear()  # a shipped model is read once in a process
    yield model_file
    prediction._shipped.cache_clear()


def accuracy(answers, labels) -> float:
    best = [max(a.probabilities, key=a.probabilities.__getitem__) for a in answers]
    return float(np.mean(np.array(best) == labels))


# -- what a model looks at ------------------------------------------------------------------------------------


def test_features_and_guards_follow_from_the_quantity(training: Training) -> None:
    model = training.model
    assert (model.quantity, model.unit, model.kind, model.guards) == ("acceleration", "m/s^2", "vibration", ())
    # Frames of 80 ms do not tell the lowest bands apart.
    too_low = tuple(f"level_{band}_hz" for band in ("8", "10", "12.5", "16", "20", "25", "31.5", "40", "50"))
    assert set(too_low) < set(DEFAULT_VIBRATION_FEATURES)
    assert model.features == tuple(name for name in DEFAULT_VIBRATION_FEATURES if name not in too_low)
    with pytest.warns(UserWarning, match=r"1 of 5 signals are not: sampling_rate 25600 Hz gives this"):
        force = measure([replace(ringing_batch(5), unit="N")])
    assert force.names == DEFAULT_FEATURES
    assert default_guards(DEFAULT_FEATURES) == DEFAULT_GUARDS
    assert default_guards(["level_500_hz"]) == ()


def test_a_model_asks_for_no_band_that_its_rate_has_not() -> None:
    batch = ringing_batch(40)
    slow = replace(batch, signals=batch.signals[:, ::2], sampling_rate=RATE / 2, pre_trigger=PRE_TRIGGER // 2)
    names = measure([slow]).names
    assert "level_5000_hz" in names
    assert not {"level_6300_hz", "level_8000_hz", "level_10000_hz", "early_level_4000_8000_hz"} & set(names)
    with pytest.raises(BadData, match="fast and long enough"):
        short = batch.signals[:, PRE_TRIGGER - 5 : PRE_TRIGGER + 5]
        measure([replace(batch, signals=short, sampling_rate=1000.0, pre_trigger=5)])
    # What is asked by name is not left out in silence.
    with pytest.raises(InvalidValue, match="level_10000_hz needs a sampling_rate"):
        measure([slow], ["level_10000_hz"])


def test_logistic_learns_from_the_levels(training: Training, fresh: Batch) -> None:
    assert training.metrics["accuracy"] > 0.85
    answers = identify_frames(fresh.signals, RATE, training.model, pre_trigger=PRE_TRIGGER)
    assert accuracy(answers, fresh.labels) > 0.85
    assert [answer.time for answer in answers] == [PRE_TRIGGER / RATE] * len(fresh)


# -- impacts in a recording -----------------------------------------------------------------------------------


def recording(firsts, blows, seconds=1.0, noise=0.2, seed=0) -> Signal:
    samples = np.random.default_rng(seed).normal(0, noise, int(seconds * RATE))
    for first, blow in zip(firsts, blows, strict=True):
        stop = min(first + len(blow), samples.size)
        samples[first:stop] += blow[: stop - first]
    return Signal(samples=samples, sampling_rate=RATE, unit="m/s^2")


def found(signal: Signal, **options) -> list[int]:
    return [round(event.time * RATE) for event in find_impacts(signal, kind="vibration", **options)]


def ringing(frequency=400.0, damping=0.02, amplitude=100.0, n_samples=25_600) -> np.ndarray:
    # Long enough to die away: where a vibration breaks off, energy comes as with a blow.
    return damped_sinusoid(frequency, damping, n_samples=n_samples, before=0, amplitude=amplitude)


def test_ringing_is_one_event_and_a_blow_into_it_is_another() -> None:
    slow = ringing(60.0, 0.005)  # rings for half a second
    assert len(found(recording([2000], [slow]))) == 1
    truth = [2000, 6000]
    # A louder blow, one that is lower than the ringing it comes into, and one that is lost in it.
    for amplitude, expected in ((400.0, truth), (30.0, truth), (0.3, truth[:1])):
        times = found(recording(truth, [slow, ringing(500.0, 0.02, amplitude)]))
        assert len(times) == len(expected)
        assert np.abs(np.subtract(times, expected)).max() <= 4


def test_frames_end_where_the_next_blow_begins_and_are_long_enough_for_every_band() -> None:
    signal = recording([2000, 3000], [ringing(2000.0, 0.03), ringing(2000.0, 0.03, 80.0)])
    first, second = find_impacts(signal, kind="vibration")
    for event, length in ((first, 1000), (second, 3500)):
        place, frame = round(event.time * RATE), event.signal.samples
        assert frame.size >= RATE / (31.5 * (10**0.05 - 10**-0.05))
        # Ten milliseconds before, of which one may belong to the impact.
        assert event.signal.pre_trigger == 256 - 26
        assert np.array_equal(frame[: 256 + length - 15], signal.samples[place - 256 : place + length - 15])
    # The first holds its baseline, the mean before its touch, from shortly before the second begins.
    (baseline,) = set(first.signal.samples[256 + 1005 :])
    assert baseline == pytest.approx(first.signal.samples[: 256 - 26].mean())


def test_a_found_event_is_answered_as_its_frame(training: Training, fresh: Batch) -> None:
    # Each blow comes with its own noise, and on an offset; the recording around it is as noisy.
    answers = []
    for frame in fresh.signals[:12]:
        noise = np.random.default_rng(1).normal(0, frame[:PRE_TRIGGER].std(), 8000)
        noise[3000 - PRE_TRIGGER : 3000 - PRE_TRIGGER + N_SAMPLES] = frame
        answers.append(identify(Signal(samples=noise + 40, sampling_rate=RATE, unit="m/s^2"), training.model))
    expected = identify_frames(fresh.signals[:12], RATE, training.model, pre_trigger=PRE_TRIGGER)
    for (answer,), framed in zip(answers, expected, strict=True):
        assert answer.time == pytest.approx(3000 / RATE, abs=0.3e-3)
        assert answer.probabilities["coal"] == pytest.approx(framed.probabilities["coal"], abs=0.1)


def test_a_recording_that_begins_in_a_vibration_says_so(training: Training) -> None:
    signal = recording([0], [ringing()[30:]])
    (answer,) = identify(signal, training.model)
    assert "cut off by its start" in answer.problem


# -- the command line -----------------------------------------------------------------------------------------


def written(folder: Path, name: str, samples: np.ndarray, unit: str = "m/s^2") -> str:
    quantity = "force" if unit == "N" else "acceleration"
    path = folder / name
    path.write_text(f"# sampling_rate: {RATE:g} Hz\n{quantity} ({unit})\n" + "\n".join(map(repr, samples.tolist())))
    return str(path)


@pytest.fixture
def files(tmp_path: Path, fresh: Batch) -> dict[str, str]:
    frame = np.concatenate([np.tile(fresh.signals[0, :PRE_TRIGGER], 8), fresh.signals[0, PRE_TRIGGER:]]).astype(float)
    time = np.arange(4000) / RATE
    pulse = 9e3 * np.sin(np.pi * np.clip((time - 0.05) / 1e-3, 0, 1)) ** 1.5
    return {
        "acceleration": written(tmp_path, "a.csv", frame),
        "g": written(tmp_path, "g.csv", frame / STANDARD_GRAVITY, "g"),
        "force": written(tmp_path, "f.csv", pulse, "N"),
        "impactor": written(tmp_path, "s.csv", pulse / 2.0),
    }


def impacts(capsys: pytest.CaptureFixture[str]) -> list[dict]:
    """Return the answers on stdout, without the hint where most are unknown."""
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    return [row for row in rows if row["kind"] == "impact"]


def test_each_quantity_gets_its_default_model(
    files: dict[str, str], default_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["predict", files["acceleration"], files["g"], files["force"], "--json"]) == 0
    rows = impacts(capsys)
    assert [row["source"] for row in rows] == [files["acceleration"], files["g"], files["force"]]
    assert rows[0]["probabilities"] == pytest.approx(rows[1]["probabilities"], rel=1e-6)
    assert run(["predict", files["acceleration"], "--model", str(default_model), "--json"]) == 0
    (row,) = impacts(capsys)
    assert row == rows[0]
    force_model = str(shipped.path_of("models", shipped.DEFAULT_MODEL))
    assert run(["predict", files["force"], "--model", force_model, "--json"]) == 0
    (row,) = impacts(capsys)
    assert row == rows[2]


def test_dataset_of_acceleration(
    tmp_path: Path, default_model: Path, fresh: Batch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A dataset of force whose signals are exchanged, as another programme would write it."""
    path, n = str(tmp_path / "data.h5"), len(fresh)
    scene = (Path(__file__).parents[1] / "datasets" / "reference.toml").read_text()
    scene = scene.replace('"200 kHz"', f'"{RATE:g} Hz"').replace("pre_trigger = 200", f"pre_trigger = {PRE_TRIGGER}")
    (tmp_path / "scene.toml").write_text(scene)
    assert run(["generate", str(tmp_path / "scene.toml"), "-o", path, "-n", str(n)]) == 0
    with h5py.File(path, "r+") as file:
        assert file["signals"].shape == (n, N_SAMPLES)
        file["signals"][:] = fresh.signals
        file["labels"][:] = np.char.encode(fresh.labels)
        for name, value in {"unit": "m/s^2", "quantity": "acceleration"}.items():
            file["signals"].attrs[name] = np.bytes_(value)
    capsys.readouterr()
    assert run(["predict", path, "--json"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(line) for line in out.splitlines()]
    expected = identify_frames(fresh.signals, RATE, StoredModel.load(default_model), pre_trigger=PRE_TRIGGER)
    assert [row["label"] for row in rows] == [answer.label for answer in expected]
    assert "accuracy of the most probable label 0." in err
    assert run(["predict", path, "--model", str(shipped.path_of("models", shipped.DEFAULT_MODEL))]) == 65
    assert "quantity must be force" in capsys.readouterr().err
    assert run(["features", path, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == n
    assert rows[3]["features"]["peak_amplitude"] == pytest.approx(np.abs(fresh.signals[3]).max(), rel=0.05)
    with h5py.File(path, "r+") as file:
        file["signals"][:] = fresh.signals / STANDARD_GRAVITY
        file["signals"].attrs["unit"] = np.bytes_("g")
    assert run(["predict", path, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert rows[0]["probabilities"] == pytest.approx(expected[0].probabilities, rel=1e-4)
