"""What is wrong with the channels of a recording, the commands that help, and levels."""

from __future__ import annotations

import csv
import json
import shlex
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile
from scipy.signal import resample_poly

from cgid import predict
from cgid.calibration import SiteCalibration
from cgid.calibration.modes import FEWEST, uncertain
from cgid.cli.hints import OWN_SCENE, NextSteps
from cgid.cli.main import run
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import LEVELS
from cgid.identification.prediction import Answer, PredictionSettings, identify_frames
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.levels import factor_of
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.training.grouped import level_range
from cgid.identification.training.rows import Rows, sets_for
from cgid.measure.features.extraction import supported
from cgid.measure.features.pulses import MAX_UNEXPLAINED
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.output.recordings import parts_of_recording
from tests import few
from tests.streams_of_pulses import RATE, ROOT, stream

LABELS = ["coal", "gangue"] * 8
BEAM_RATE = 25_600.0
PULSES = StoredModel.load(ROOT / "models" / "default.npz")
BEAM = StoredModel.load(ROOT / "models" / "default-acceleration.npz")


def of_the_trained_beam(blows_per_second: float) -> np.ndarray:
    """Return 20 s of the tail beam on which the default model was trained, with its noise [m/s^2]."""
    text = (ROOT / "datasets" / "caving.toml").read_text()
    start, stop = text.index("[background]"), text.index("[[populations]]")
    text = text[:start] + text[stop:]
    for old, new in {
        'x = { distribution = "uniform", lowest = "0.2 m", highest = "0.8 m" }': 'x = { distribution = "uniform", '
        'lowest = "0.8 m", highest = "1.5 m" }',
        "100 ug/sqrt(Hz)": "2 mg/sqrt(Hz)",
        "bits = 24": "bits = 16",
        'rebounds = { most = 5, least_speed = "0.1 m/s" }': "",
        'duration = "60 s"': 'duration = "20 s"',
        'times = ["0 s", "20 s", "40 s", "60 s"], gangue = [0.05, 0.10, 0.60, 0.90]': 'times = ["0 s", "20 s"], '
        "gangue = [0.5, 0.5]",
        'rate = "8 Hz"': f'rate = "{blows_per_second} Hz"',
    }.items():
        assert old in text, old
        text = text.replace(old, new)
    parts = parts_of_recording(parse_scene(tomllib.loads(text)), 3, 0, dtype="float64")
    return np.concatenate([samples for samples, _ in parts]).astype(float)


def of_anbeam(n_blows: int = 12) -> np.ndarray:
    """Return clear blows of 0.5 ms on a beam of eight lightly damped modes, one a second [m/s^2]."""
    random, times = np.random.default_rng(1), np.arange(round(BEAM_RATE)) / BEAM_RATE
    frequencies = 2 * np.pi * np.array([137.0, 392.0, 811.0, 1330.0, 2075.0, 3260.0, 4710.0, 6840.0])
    blow = np.sin(np.pi * np.linspace(0, 1, 13)) ** 1.5
    seconds = []
    for _ in range(n_blows):
        sizes = random.uniform(1, 3, 8) * random.choice([-1, 1], 8)
        decays = np.exp(-0.008 * np.outer(frequencies, times)) * np.cos(np.outer(frequencies, times))
        seconds.append(np.roll(np.convolve(sizes @ decays, blow)[: times.size], 1000))
    return np.concatenate(seconds) + random.normal(0, 0.05, n_blows * times.size)


@pytest.fixture(scope="module")
def beam() -> np.ndarray:
    return of_the_trained_beam(1.5)


def steps_of(diagnosis: Diagnosis, rate: float, options: tuple[str, ...] = (), *more: Any) -> NextSteps:
    return NextSteps(diagnosis, rate, "my file.csv", options, *more)


def hint_of(
    samples: np.ndarray, rate: float, model: StoredModel, options: tuple[str, ...] = (), **fields: object
) -> Finding | None:
    """The first finding of a recording, with the commands that help."""
    diagnosis, silent = Diagnosis(model, rate), list[Finding]()
    for step in identify_blocks([samples[None]], rate, model, ("1",), PredictionSettings(**fields)):
        diagnosis.add(step.answers)
        silent += [one for one in step.found if one.moves]
    return next((steps_of(diagnosis, rate, options).of(one) for one in silent + diagnosis.findings()), None)


# -- what is wrong --------------------------------------------------------------------------------------


def test_what_is_answered_well_gets_no_hint(beam: np.ndarray) -> None:
    assert hint_of(beam, BEAM_RATE, BEAM) is None
    assert hint_of(resample_poly(beam, 2, 1), 2 * BEAM_RATE, BEAM) is None
    force = stream(LABELS, 0.05)
    assert hint_of(force + np.random.default_rng(0).normal(0, 400, force.size), RATE, PULSES) is None


def test_a_beam_upside_down_is_turned_over(beam: np.ndarray) -> None:
    hint = hint_of(-beam, BEAM_RATE, BEAM)
    assert hint is not None
    assert (hint.kind, hint.commands) == ("upside_down", ("cgid predict 'my file.csv' --set invert=true",))


# -- the line -----------------------------------------------------------------------------------------


def test_the_unit_that_explains_the_size_is_named() -> None:
    force = stream(LABELS, 0.05)
    for options, wanted in (
        (("--unit", "kN"), ("cgid predict 'my file.csv' --unit N",)),
        ((), ()),
    ):
        hint = hint_of(1e3 * force, RATE, PULSES, options)
        assert hint is not None and (hint.kind, hint.commands) == ("scale", wanted)


# -- every command that is printed --------------------------------------------------------------------


def recordings_with_hints(folder: Path) -> dict[str, tuple[str, list[str]]]:
    """Write recordings of one and of two channels that get hints; return cause and options of each file."""
    force, motion = stream(["coal", "gangue"] * 12, 0.05), of_anbeam(24)
    noise = np.random.default_rng(5).normal(0, 0.05, motion.size)
    late = np.arange(round(0.03 * RATE)) / RATE
    rebounding = -force + np.convolve(force, np.exp(-late / 5e-3) / (5e-3 * RATE))[: force.size]

    def text(name: str, rate: float, head: str, *columns: np.ndarray) -> str:
        header = f"# sampling_rate: {rate:g} Hz\n{head}"
        np.savetxt(folder / name, np.stack(columns, 1), fmt="%.6g", header=header, comments="", delimiter=",")
        return name

    def array(name: str, *channels: np.ndarray) -> str:
        np.save(folder / name, np.stack(channels).astype(np.float32))
        return name

    two, unstated = (motion, 0.7 * np.roll(motion, 9) + noise), ["--rate", f"{BEAM_RATE:g}"]
    counts = np.round(motion / np.abs(motion).max() * 2**14).astype(np.int16)
    wavfile.write(folder / "two channels.wav", round(BEAM_RATE), np.stack([counts, -counts], 1))
    pulses = ["--rate", f"{RATE:g}"]
    return {
        text("two.csv", BEAM_RATE, "left (m/s^2),right (m/s^2)", *two): ("beam", []),
        text("units.csv", BEAM_RATE, "left (g),right (m/s^2),tap (N)", motion / 9.8, *two): ("beam", []),
        array("volts.npy", *(one / 100 for one in two)): (
            "beam",
            [*unstated, "--unit", "V", "--sensitivity", "1=10 mV/(m/s^2)", "--sensitivity", "2=9 mV/(m/s^2)"],
        ),
        array("picked.npy", *two, motion): (
            "beam",
            [*unstated, "--unit", "g", "--channel", "3", "--channel", "1", "--set", "coverage=.9"],
        ),
        "two channels.wav": ("beam", ["--full-scale", "5 g", "--set", "dead_time=6"]),
        array("faster.npy", resample_poly(motion, 2, 1)): ("beam", ["--rate", "51200", "--unit", "m/s^2"]),
        array("down.npy", force, rebounding): ("upside_down", [*pulses, "--unit", "N"]),
        array("kilo.npy", force, force): ("scale", [*pulses, "--unit", "kN"]),
    }


OTHER_RECORDINGS = ("two channels.wav", "faster.npy", "kilo.npy")


def follow(way: list[str], run_one: Callable[[list[str]], int]) -> list[str]:
    """Run the steps of a hint as they are printed; fill in what they ask for. Return the commands."""
    done = []
    for step in way:
        if step.startswith("cgid "):
            done.append(shlex.split(step)[1])
            assert run_one(shlex.split(step)[1:]) == 0, step
            continue
        if OWN_SCENE in step:
            Path(OWN_SCENE).write_text((ROOT / "datasets" / "tail_beam.toml").read_text())
            continue
        (name,) = (word for word in step.split() if word.endswith(".csv"))
        rows = list(csv.DictReader(Path(name).read_text(encoding="utf-8-sig").splitlines()))
        for number, row in enumerate(rows):
            row["label"] = LABELS[number % 2]
        with Path(name).open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    return done


@pytest.mark.parametrize(
    "name",
    few(("down.npy", "two.csv", "volts.npy", "units.csv", "picked.npy", *OTHER_RECORDINGS)),
)
def test_every_command_of_a_hint_works(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As printed, on the file, from another folder. Modes are not learned, and few signals train: all else is done."""

    def unlearned(scene: Scene, blows: np.ndarray, *_: object, **__: object) -> SiteCalibration:
        assert len(blows) >= FEWEST
        site = uncertain(scene, 0.01)
        assert site.tail_beam is not None and site.tail_beam.learned_modes is not None
        modes = site.tail_beam.learned_modes
        return SiteCalibration(
            scene=site,
            start=modes,
            learned=modes,
            n_impacts=20,
            before=0,
            after=0,
            expected=0,
            crossings=0,
            has_converged=True,
        )

    def run_one(arguments: list[str]) -> int:
        return run([*arguments, *["-n", "600"] * (arguments[:2] == ["train", "site.toml"])])

    monkeypatch.setattr("cgid.calibration.calibrate", unlearned)
    recordings, foreign = tmp_path / "recordings", tmp_path / "foreign"
    recordings.mkdir()
    foreign.mkdir()
    monkeypatch.chdir(foreign)
    cause, options = recordings_with_hints(recordings)[name]
    assert run(["predict", f"../recordings/{name}", *options, "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    hints = [line for line in lines if line["kind"] == "finding" and line["commands"]]
    assert [hint["finding"] for hint in hints][:1] == [cause]
    commands = [follow(way, run_one) for hint in hints for way in (hint["commands"], hint["instead"])]
    capsys.readouterr()
    assert any(commands)


@pytest.mark.parametrize("name", few(("kilo.npy", "down.npy", "two.csv", "volts.npy", "units.csv", *OTHER_RECORDINGS)))
def test_the_same_is_told_with_and_without_a_report(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a hint has told of a channel is not told again."""
    monkeypatch.chdir(tmp_path)
    _, options = recordings_with_hints(tmp_path)[name]
    told = []
    for more in ((), ("--report", "page.html")):
        assert run(["predict", name, *options, "--json", *more]) == 0
        lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        told.append([line for line in lines if line["kind"] == "finding"])
    assert told[0] == told[1]
    assert any(line["commands"] for line in told[0])


# -- the level ----------------------------------------------------------------------------------------


@cache
def own_answers(model: str, factor: float) -> tuple[Answer, ...]:
    """Return the answers for 400 impacts of the scene of a model, 120 of a beam, their samples times a factor."""
    scene = load_scene(ROOT / "datasets" / ("tail_beam.toml" if "acceleration" in model else "reference.toml"))
    shipped, found = StoredModel.load(ROOT / "models" / f"{model}.npz"), []
    for batch in synthesise(scene, 120 if shipped.beam else 400, 77):
        found += identify_frames(factor * batch.signals, batch.sampling_rate, shipped, pre_trigger=batch.pre_trigger)
    return tuple(found)


def level_of(model: str, answers: tuple[Answer, ...]) -> str | None:
    shipped = StoredModel.load(ROOT / "models" / f"{model}.npz")
    diagnosis = Diagnosis(shipped, shipped.sampling_rates[0])
    diagnosis.add(answers)
    return next((one.line("x") for one in diagnosis.findings() if one.kind == "scale"), None)


SHIPPED = ["default", "default-acceleration"]
#: Of a beam, levels are those of a seam.
OF_FORCES = ["default"]


@pytest.mark.parametrize("model", SHIPPED)
def test_a_factor_adds_its_logarithm_to_the_levels(model: str) -> None:
    own, scaled = ([one.level for one in own_answers(model, factor)] for factor in (1.0, 9.81))
    assert np.isfinite(own).all()
    # A fit may end elsewhere.
    assert np.median(np.abs(np.subtract(scaled, own) - np.log(9.81))) < 1e-6


def conditions_of(parts: list[tuple[str, tuple[Answer, ...]]], model: str) -> list[tuple[int, str, str, bool]]:
    """Return when what begins and ends in a live stream: number of the impact, channel, kind, whether it begins.

    These are answers without their samples, so levels alone tell.
    """
    shipped = StoredModel.load(ROOT / "models" / f"{model}.npz")
    diagnosis, number, found = Diagnosis(shipped), 0, []
    for channel, answers in parts:
        for answer in answers:
            number += 1
            diagnosis.add([replace(answer, channel=channel, time=number / 8)])
            found += [(number, *one.channels, one.kind, not one.is_over) for one in diagnosis.changes(number / 8)]
    return found


@pytest.mark.parametrize("gain", [9.81, 0.102])
@pytest.mark.parametrize("model", OF_FORCES)
def test_a_gain_that_changes_is_told_at_the_next_look_and_when_it_is_back(model: str, gain: float) -> None:
    own, wrong = own_answers(model, 1.0), own_answers(model, gain)
    n, before = 60, 8 * (len(own) // 60) * 60
    found = conditions_of([("1", own[: len(own) // 60 * 60] * 8), ("1", wrong[:n]), ("1", own)], model)
    assert not [one for one in found if one[0] <= before]
    begun = [number - before for number, _, condition, begins in found if begins]
    assert begun[0] == 40
    told = dict.fromkeys((condition for _, _, condition, begins in found if begins))
    assert "scale" in told
    ended = [number - before - n for number, _, condition, begins in found if not begins]
    assert ended and max(ended) <= 160  # a look, its 80 impacts, and one more look


def test_each_channel_is_told_whatever_is_wrong_with_another() -> None:
    own, wrong = own_answers("default", 1.0)[:200], own_answers("default", 9.81)[:200]
    unknown = tuple(replace(one, label="unknown", novelty=3.0) for one in own)
    parts = [
        part
        for k in range(0, 200, 2)
        for part in (("1", unknown[k : k + 2]), ("2", wrong[k : k + 2]), ("3", own[k : k + 2]))
    ]
    found = conditions_of(parts, "default")
    assert {(channel, condition) for _, channel, condition, _ in found} == {
        ("1", "unknown"),
        ("2", "scale"),
    }
    # In a recording as a whole, too.
    diagnosis = Diagnosis(StoredModel.load(ROOT / "models" / "default.npz"), RATE)
    for channel, answers in parts:
        diagnosis.add([replace(one, channel=channel) for one in answers])
    findings = diagnosis.findings()
    told = {one.kind: one.channels for one in findings}
    assert told["unknown"] == ("1",) and told["scale"] == ("2",)
    # The commands read the channel that is wrong.
    steps = NextSteps(diagnosis, RATE, "x.wav", channels=["1", "2", "3"])
    for one in findings:
        commands = [*steps.of(one).commands, *steps.of(one).instead]
        assert all("--channel" not in step or f"--channel {one.channels[0]}" in step for step in commands)
    assert any("--channel 1" in step for one in findings for step in steps.of(one).commands)
    # No text stands in empty brackets where impacts are unknown as a whole.
    assert "()" not in Finding(kind="unknown", fields={"unknown": "", "what": "impacts"}).line("x")


@pytest.mark.parametrize("model", OF_FORCES)
def test_a_wrong_scale_is_told_from_ten_impacts_on(model: str) -> None:
    own, wrong = own_answers(model, 1.0), own_answers(model, 9.81)
    assert sum(one.label == "unknown" for one in wrong) < len(wrong) / 2
    for size, most in ((10, 1), (30, 0), (100, 0)):
        parts = [slice(first, first + size) for first in range(0, len(own), size)]
        assert sum(level_of(model, own[part]) is not None for part in parts) <= most
    # Of those of 9.81, some have a hint instead: most of their impacts are unknown.
    told = [level_of(model, wrong[first : first + 10]) for first in range(0, len(wrong), 10)]
    assert sum(one is not None for one in told) >= 0.65 * len(told)
    assert level_of(model, wrong[:9]) is None
    text = level_of(model, wrong)
    assert text is not None
    assert 6 < float(text.partition("about ")[2].split()[0]) < 16
    small = level_of(model, own_answers(model, 0.102))
    assert small is not None and 0.06 < float(small.partition("about ")[2].split()[0]) < 0.16


# -- the level of models of labelled recordings ----------------------------------------------------------

N_EACH = 24


def labelled_recording(kind: str, number: int) -> tuple[np.ndarray, float, str, list[str]]:
    """Return samples of a day, rate, unit and labels: forces, a beam of five modes, or a flow; numpy alone."""
    random = np.random.default_rng([number, len(kind)])
    strength, second = np.exp(random.normal(0, 0.1)), np.arange(N_EACH) % 2 == number % 2
    labels = np.where(second, "gangue", "coal").tolist()
    if kind == "window":
        rate, label = 8000.0, ("coal", "gangue")[number % 2]
        noise = np.convolve(random.normal(size=12_000), {"coal": [1, 1, 1, 1], "gangue": [1, -1]}[label], "same")
        beats = np.exp(random.normal(0, 0.3, 30)).repeat(400)
        return 5 * strength * noise * beats, rate, "m/s^2", [label]
    rate, unit, gap = (1e5, "N", 2000) if kind == "pulse" else (25_600.0, "m/s^2", 15_000)
    samples = random.normal(0, 5 if kind == "pulse" else 0.05, (N_EACH + 1) * gap)
    size = strength * np.exp(random.normal(0, 0.4, N_EACH))
    times = np.arange(gap) / rate
    for k, is_second in enumerate(second):
        duration = (3e-4 if is_second else 7e-4) * np.exp(random.normal(0, 0.15))
        if kind == "pulse":
            phase = times / (duration * (0.9 + 0.2 * (times > duration / 2)))
            event = 3e3 * size[k] * np.sin(np.pi * np.clip(phase, 0, 1)) ** 1.5
        else:
            modes = 2 * np.pi * np.array([140.0, 410.0, 980.0, 1900.0, 3300.0])
            excited = random.uniform(0.3, 1, 5) * np.exp(-((modes * duration / 4) ** 2))
            event = 60 * size[k] * excited @ (np.exp(-0.03 * modes[:, None] * times) * np.sin(modes[:, None] * times))
        samples[gap // 2 + k * gap :][:gap] += event
    return samples, rate, unit, labels


@pytest.fixture(scope="module")
def of_labels(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that trains a model of a kind by the command, on eight labelled recordings."""

    @cache
    def trained(kind: str) -> Path:
        folder = tmp_path_factory.mktemp(kind)
        rows = ["path,label,start_s,end_s,rate_Hz,unit"]
        for number in range(8):
            samples, rate, unit, labels = labelled_recording(kind, number)
            np.save(folder / f"{number}.npy", samples)
            gap = len(samples) // (N_EACH + 1) / rate
            for k, label in enumerate(labels):
                span = "," if len(labels) == 1 else f"{(k + 0.4) * gap:.5f},{(k + 1.4) * gap:.5f}"
                rows.append(f"{number}.npy,{label},{span},{rate:g},{unit}")
        (folder / "labels.csv").write_text("\n".join(rows) + "\n")
        features = ["--features", "window_level,window_peak,window_centroid"] if kind == "window" else []
        assert run(["train", str(folder / "labels.csv"), *features, "-o", str(folder / "m.npz")]) == 0
        return folder / "m.npz"

    return trained


def told_of_scale(command: str, kind: str, number: int, factor: float, model: Path, capsys: Any) -> bool:
    samples, rate, unit, _ = labelled_recording(kind, number)
    if command == "python":
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            predict(factor * samples, rate, unit, model=model)
        return bool(caught)
    path = model.parent / "new.f32"
    (factor * samples).astype("<f4").tofile(path)
    if command == "predict":
        np.save(path := path.with_suffix(".npy"), factor * samples)
    given = ["--rate", str(rate), "--unit", unit, "--model", str(model), "--json"]
    raw = ["--channels", "1", "--sample-format", "f32le"] if command == "monitor" else []
    capsys.readouterr()
    assert run([command, str(path), *given, *raw]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    return any(line["kind"] == "finding" and not line["note"] for line in lines)


@pytest.mark.parametrize("kind", ["pulse", "vibration", "window"])
def test_a_wrong_scale_of_labelled_recordings_is_told(kind: str, of_labels: Callable[[str], Path], capsys: Any) -> None:
    model = of_labels(kind)
    assert set(StoredModel.load(model).level_range) == set(LEVELS)
    for command in ("predict", "monitor", "python"):
        for factor in (0.1, 1 / 9.81, 9.81, 10.0):
            assert told_of_scale(command, kind, 100, factor, model, capsys), (command, factor)
    sound = [told_of_scale("python", kind, number, 1.0, model, capsys) for number in range(101, 121)]
    assert sum(sound) <= 1
    for command in ("predict", "monitor"):
        assert not told_of_scale(command, kind, 101, 1.0, model, capsys)


def test_a_model_free_of_levels_answers_alike_at_any_scale(of_labels: Callable[[str], Path]) -> None:
    folder = of_labels("window").parent
    samples, rate, unit, _ = labelled_recording("window", 100)
    names = supported(sets_for("window", rate)["mel bands, level-free"], rate, round(0.1 * rate))
    train = ["train", str(folder / "labels.csv"), "--features", ",".join(names), "-o", str(folder / "free.npz")]
    assert run(train) == 0
    own, scaled = (predict(factor * samples, rate, unit, model=folder / "free.npz") for factor in (1.0, 9.81))
    assert StoredModel.load(folder / "free.npz").level_range == {}
    np.testing.assert_allclose(own["p_coal"], scaled["p_coal"], atol=1e-9)


def test_pulses_of_labelled_recordings_have_the_guard_against_residuals(of_labels: Callable[[str], Path]) -> None:
    """A square is no pulse of a contact, however long and strong."""
    model = StoredModel.load(of_labels("pulse"))
    assert model.guards == PULSES.guards and model.guard_limits[0] >= MAX_UNEXPLAINED
    frame = np.random.default_rng(0).normal(0, 5, 1000)
    frame[300:350] += 3e3
    assert identify_frames(frame[None], 1e5, model, pre_trigger=None)[0].label == "unknown"


def level_rows(levels: np.ndarray) -> Rows:
    """Return rows whose levels (n_groups, n_each) are given, two labels in each group."""
    n_groups, n_each = levels.shape
    return Rows(
        names=("peak_force",),
        features=levels.reshape(-1, 1),
        labels=np.tile(np.arange(n_each) % 2, n_groups).astype(str),
        group=np.repeat(np.arange(n_groups), n_each),
        digests=tuple(map(str, range(n_groups))),
    )


@pytest.mark.parametrize(("n_groups", "between", "correlation"), [(20, 0.3, 0.0), (20, 0.8, 0.0), (3, 0.3, 0.6)])
def test_sound_recordings_are_warned_once_in_hundreds(n_groups: int, between: float, correlation: float) -> None:
    """Levels of recordings differ by a standard deviation of their own, and successive ones may be correlated."""
    random, n_each = np.random.default_rng(5), 40

    def drawn(n: int, n_levels: int) -> np.ndarray:
        noise = random.normal(size=(n, n_levels))
        for k in range(1, n_levels):
            noise[:, k] = correlation * noise[:, k - 1] + np.sqrt(1 - correlation**2) * noise[:, k]
        return 0.5 * (noise + random.normal(0, between, (n, 1)))

    warned, told = [], []
    for _ in range(60):
        levels = drawn(n_groups, n_each)
        found = level_range(level_rows(levels), levels.ravel())
        model = replace(PULSES, training={"level_range": found})
        for n_levels in (10, 40, 160):
            warned += [factor_of(one.tolist(), model) != 1 for one in drawn(30, n_levels)]
            told += [factor_of((one + np.log(9.81)).tolist(), model) != 1 for one in drawn(4, n_levels)]
    assert np.mean(warned) < 0.01
    assert np.mean(told) > 0.95


def test_noise_that_hides_small_pulses_makes_no_scale() -> None:
    """The levels that are heard rise, though no scale is wrong; pulses far above the noise tell a factor as before."""
    model, rng = StoredModel.load(ROOT / "models" / "default.npz"), np.random.default_rng(83)
    all_levels = model.level_deviation * rng.standard_normal((200, 120))

    def told(factor: float, noise: float, *, by_noise: bool) -> float:
        heard = [one[one > noise] for one in all_levels]
        heights = [4.0 * np.exp(one - noise) if by_noise else None for one in heard]
        levels = [(one + np.log(factor)).tolist() for one in heard]
        return np.mean([factor_of(*of, model, heights=one) != 1 for *of, one in zip(levels, heights, strict=True)])

    for by_noise in (False, True):  # `noise`: ln of what is just heard, over the middle of the training
        assert told(1.0, -6.0, by_noise=by_noise) <= 0.01 and told(9.81, -6.0, by_noise=by_noise) == 1
    assert told(1.0, 0.5, by_noise=False) > 0.9
    assert told(1.0, 0.5, by_noise=True) < 0.02 and told(9.81, 0.5, by_noise=True) > 0.9
    nothing = np.zeros(120, bool)
    assert factor_of((all_levels[0] + 3).tolist(), model, known=nothing) == 1
