"""Why most answers are unknown: recordings made for each cause get that cause, good ones get no hint."""

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
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile
from scipy.signal import resample_poly
from scipy.stats import binom

from cgid import predict
from cgid.calibration import SiteCalibration
from cgid.calibration.modes import FEWEST, uncertain
from cgid.cli.hints import OWN_SCENE, NextSteps
from cgid.cli.main import run
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import LEVELS
from cgid.identification.model.world import Misfit, MisfitPart
from cgid.identification.prediction import Answer, PredictionSettings, identify_frames
from cgid.identification.prediction import diagnosis as diagnosis_module
from cgid.identification.prediction.diagnosis import (
    Cause,
    CauseKind,
    ChannelAnswers,
    Diagnosis,
    _factor_of,
    misfit_text,
)
from cgid.identification.prediction.findings import Finding, as_option, words
from cgid.identification.prediction.prediction import read_model
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.training import train_on_specimens
from cgid.identification.training.grouped import level_range
from cgid.identification.training.rows import DEFAULT_VIBRATION_FEATURES, Rows, sets_for
from cgid.measure.features.extraction import supported
from cgid.measure.features.pulses import MAX_UNEXPLAINED
from cgid.scene import Scene, load_scene, parse_scene, synthesise, varied
from cgid.scene.output.recordings import parts_of_recording
from tests import few
from tests.ringing import ringing_batch
from tests.streams_of_pulses import RATE, ROOT, stream

LABELS = ["coal", "gangue"] * 8
BEAM_RATE = 25_600.0
PULSES = StoredModel.load(ROOT / "models" / "default.npz")
BEAM = StoredModel.load(ROOT / "models" / "default-acceleration.npz")


@cache
def of_levels() -> StoredModel:
    scene = load_scene(ROOT / "datasets" / "tail_beam.toml")
    return train_on_specimens(
        synthesise(scene, 2000, 5), features=supported(DEFAULT_VIBRATION_FEATURES, BEAM_RATE, 2048), seed=1
    ).model


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


def of_another_beam(n_blows: int = 12) -> np.ndarray:
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
        diagnosis.add(step.answers, step.upside_down)
        silent += [one for one in step.found if one.moves]
    return next((steps_of(diagnosis, rate, options).of(one) for one in silent + diagnosis.findings()), None)


def cause_of(samples: np.ndarray, rate: float, model: StoredModel) -> str | None:
    hint = hint_of(samples, rate, model)
    return None if hint is None else hint.kind


# -- the cause ----------------------------------------------------------------------------------------


def test_what_is_answered_well_gets_no_hint(beam: np.ndarray) -> None:
    random = np.random.default_rng(0)
    assert hint_of(np.clip(random.normal(-beam, 5), -200, 200), BEAM_RATE, BEAM) is None
    assert hint_of(resample_poly(beam, 2, 1), 2 * BEAM_RATE, BEAM) is None
    force = stream(LABELS, 0.05)
    for good in (force, force - force.mean(), force + random.normal(0, 400, force.size)):
        assert hint_of(good, RATE, PULSES) is None


def test_causes_of_vibrations(beam: np.ndarray) -> None:
    random = np.random.default_rng(0)
    assert cause_of(beam + random.normal(0, 150, beam.size), BEAM_RATE, of_levels()) == "noise"
    assert cause_of(0.01 * beam, BEAM_RATE, of_levels()) == "scale"
    other = of_another_beam()
    for samples in (other, other + random.normal(0, 0.02 * other.max(), other.size)):
        assert cause_of(samples, BEAM_RATE, of_levels()) == "features"
        assert cause_of(samples, BEAM_RATE, BEAM) == "other_beam"


def test_causes_of_pulses() -> None:
    force = stream(LABELS, 0.05)
    assert cause_of(np.minimum(force, 2000), RATE, PULSES) == "clipped"
    assert cause_of(force + np.roll(force, 97) + np.roll(force, 194), RATE, PULSES) == "overlapping"
    assert cause_of(1e3 * force, RATE, PULSES) == "scale"
    assert cause_of(1e-3 * force, RATE, PULSES) == "scale"
    assert cause_of(force, RATE / 10, PULSES) == "duration"
    times = np.arange(400) / RATE
    ringing = np.convolve(force, np.exp(-times * 1500) * np.sin(2 * np.pi * 1500 * times))[: force.size]
    assert cause_of(ringing, RATE, PULSES) == "vibration"


def test_a_pulse_that_points_down_and_rebounds_is_turned_over() -> None:
    force = stream(LABELS, 0.05)
    # A coupling condenser: what falls comes back a little higher.
    times = np.arange(round(0.03 * RATE)) / RATE
    samples = -force + np.convolve(force, np.exp(-times / 5e-3) / (5e-3 * RATE))[: force.size]
    hint = hint_of(samples, RATE, PULSES)
    assert hint is not None
    assert hint.kind == "upside_down"
    assert hint.commands == ("cgid predict 'my file.csv' --set invert=true",)
    assert hint_of(-samples, RATE, PULSES) is None


def test_a_wrong_sampling_rate_is_told_by_the_true_one() -> None:
    """The answers change when only the rate does, so the rate is the cause."""
    samples = of_the_trained_beam(3)
    model = of_levels()
    diagnosis = Diagnosis(model, 2 * BEAM_RATE)
    for step in identify_blocks([samples[None]], 2 * BEAM_RATE, model, ("1",), PredictionSettings()):
        # Only those outside of the training: at this rate about half of them are.
        diagnosis.add([answer for answer in step.answers if answer.novelty > 1])
    (found,) = diagnosis.findings()
    assert found.kind == "rate"
    assert found.fields["true_rate"] == BEAM_RATE
    assert "sampling_rate" in found.line("x.csv")
    for options in (("--rate", "51200", "--unit", "g"), ("--unit", "g")):  # as well if the file states the wrong rate
        hint = NextSteps(diagnosis, 2 * BEAM_RATE, "x.csv", options, ("--set", "mass=2")).of(found)
        assert hint.commands == ("cgid predict x.csv --unit g --set mass=2 --rate 25600",)
    # Not of a dataset.
    hint = NextSteps(diagnosis, 2 * BEAM_RATE, "x.csv", ("--unit", "g"), labelled=True).of(found)
    assert hint.commands == () and "correct it in the file" in hint.line("x.csv", 1, as_option)


@pytest.mark.parametrize("model", [PULSES, BEAM])
def test_frames_without_an_impact_are_too_weak(model: StoredModel) -> None:
    """Those that are cut off cannot be measured, either, but for another reason."""
    rate = model.sampling_rates[0]
    quiet = np.random.default_rng(0).normal(0, 0.1, (30, 1060))
    rising = quiet + np.append(np.zeros(1000), 100 * np.sin(np.linspace(0, 1.5, 60)))
    for frames, cause in ((np.full_like(quiet, 0.5), "noise"), (rising, "unmeasured")):
        diagnosis = Diagnosis(model, rate)
        diagnosis.add(identify_frames(frames, rate, model, pre_trigger=1000))
        (found,) = diagnosis.findings()
        assert (found.kind, found.fields["unknown"]) == (cause, "30 of 30 impacts unknown: ")


def test_each_cause_has_words() -> None:
    assert set(CauseKind) <= words().keys()


@pytest.mark.parametrize(
    ("factor", "told"), [(1.04, "1.04"), (0.97, "0.97"), (1.8, "1.8"), (0.1, "0.1"), (162.3, "160")]
)
def test_any_factor_is_told_in_words_that_are_right(factor: float, told: str) -> None:
    model = read_model("default")
    assert f"about {told} times as large" in Diagnosis(model)._scale(("1",), factor).line("x")
    for part, word in ((MisfitPart.SCALE, "large"), (MisfitPart.SIZES, "large"), (MisfitPart.SEAM, "hard")):
        text = misfit_text(Misfit(part, 50, factor), model)
        assert f"about {told} times as {word}" in text and text.endswith("(told of at most 1 % of recordings that are)")


def test_causes_add_up_to_the_distance() -> None:
    """The foremost input is the one without which the squared distance falls most, by finite differences."""
    frames = ringing_batch(40, noise=1e-3).signals
    answers = identify_frames(frames, BEAM_RATE, BEAM, pre_trigger=200)
    assert all(answer.cause is None for answer in answers if answer.novelty <= 1)
    outside = [answer for answer in answers if answer.novelty > 1]
    assert outside
    assert all(answer.cause is not None for answer in outside)
    random = np.random.default_rng(0)
    near = BEAM.neighbourhood
    rows = random.normal(0, 3, (20, len(BEAM.inputs)))
    for row, foremost in zip(rows, near.most_distant(rows), strict=True):
        squares = [
            np.sum((near.whitening[k % len(near.whitening)] @ (row - c)) ** 2) for k, c in enumerate(near.centres)
        ]
        nearest = int(np.argmin(squares))
        whitening, offset = near.whitening[nearest % len(near.whitening)], row - near.centres[nearest]
        # For a quadratic form, offset times half the gradient is each part of the sum.
        steps = 1e-6 * np.eye(offset.size)
        gradient = [
            (np.sum((whitening @ (offset + step)) ** 2) - np.sum((whitening @ (offset - step)) ** 2)) / 2e-6
            for step in steps
        ]
        assert np.sum(offset * gradient) / 2 == pytest.approx(squares[nearest], rel=1e-5)
        assert int(np.argmax(offset * gradient)) == foremost


# -- a beam that changes --------------------------------------------------------------------------------


def with_modes_off(share: float, seed: int = 1) -> StoredModel:
    """The model of acceleration; each of its modes is off by this share in frequency, and ten times in damping."""
    assert BEAM.beam is not None
    own, random = BEAM.beam.beam, np.random.default_rng(seed)
    frequency, ratio = (
        one * np.exp(by * random.normal(size=one.size))
        for one, by in ((own.modes.frequency, share), (own.modes.damping_ratio, 10 * share))
    )
    off = replace(own, modes=replace(own.modes, frequency=frequency, damping_ratio=ratio))
    return replace(BEAM, arrays={**BEAM.arrays, **off.arrays})


@cache
def answers_of(share: float, noise: float | None) -> list[Answer]:
    """Answers for 96 impacts through modes that are off, with the noise of the scene or a share of the peak."""
    scene = load_scene("tail_beam")
    if noise is not None:
        scene = varied(scene, noise_density=None, range=None, bits=None, relative_noise=noise)
    batch = next(iter(synthesise(scene, 96, 11)))
    model = with_modes_off(share)
    return identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger)


def change_of(answers: list[Answer], model: StoredModel = BEAM) -> Finding | None:
    """The first finding of answers that come every second, if it is of the beam; not before there are enough."""
    diagnosis = Diagnosis(model, BEAM_RATE, live=True)
    for number, answer in enumerate(answers):
        diagnosis.add([replace(answer, time=float(number))])
        for found in diagnosis.changes(float(number)):
            if found.kind == "beam":
                assert number >= 29
                assert found in diagnosis.standing("1")
                return steps_of(diagnosis, BEAM_RATE, ("--unit", "g")).of(found)
    return None


@pytest.mark.parametrize("noise", few([None, 0.3, 0.003]))
def test_a_beam_that_has_not_changed_gets_no_hint(noise: float | None) -> None:
    assert change_of(answers_of(0.0, noise)) is None


@pytest.mark.parametrize("noise", few([None, 0.03]))
def test_modes_that_are_off_by_a_hundredth_are_noticed(noise: float | None) -> None:
    answers = answers_of(0.01, noise)
    # Most single impacts tell it, too, where noise does not hide it.
    assert np.mean([answer.label == "unknown" for answer in answers]) > (0.2 if noise == 0.03 else 0.5)
    hint = change_of(answers)
    assert hint is not None
    assert "the modes of the model's leave" in hint.line("x")
    assert hint.commands[0] == "cgid events 'my file.csv' --unit g -o events.csv"
    # The beam of a user is not that of the shipped scene.
    assert hint.instead == (
        "write YOUR_BEAM.toml, a scene with the size and sensor of your beam",
        "cgid calibrate 'my file.csv' --unit g --scene YOUR_BEAM.toml -o site.toml",
        "cgid train site.toml -o site.npz",
        "cgid predict 'my file.csv' --unit g --model site.npz",
    )
    # Disturbed impacts show nothing, and few are not enough.
    assert change_of([replace(answer, overlapping=True) for answer in answers]) is None
    assert change_of(answers[:29]) is None
    # A model that was trained on such errors finds nothing new in them.
    middle = float(np.median([answer.unexplained for answer in answers]))
    used = replace(BEAM, training={**BEAM.training, "median_beam_unexplained": middle})
    assert change_of(answers, used) is None
    assert StoredModel.from_bytes(used.to_bytes()).unexplained == middle


def test_the_median_lies_above_what_is_said() -> None:
    """But for a chance of 2e-5, by the binomial distribution of ranks."""
    for n in (30, 47, 100, 300):
        channel = ChannelAnswers()
        # The later ones leave less, so that most are looked at.
        channel.unexplained.extend(np.arange(n, 0.0, -1).tolist())
        left, latest = channel.median_unexplained()
        assert len(latest) == n
        rank = sorted(latest).index(left) + 1
        assert binom.cdf(rank - 1, n, 0.5) < 2e-5 < binom.cdf(rank + 1, n, 0.5)
    assert np.isnan(ChannelAnswers().median_unexplained()[0])


def test_forces_that_no_contact_has_are_told_with_the_way_to_find_out() -> None:
    """From a hundred impacts on, while the beam explains them; long pulses tell nothing."""
    answers = [replace(answer, label="coal", unexplained=0.0) for answer in answers_of(0.0, None)[:50]] * 4
    for share, told in ((2.5, False), (6.0, True)):
        diagnosis = Diagnosis(BEAM, BEAM_RATE, live=True)
        found: list[tuple[int, Finding]] = []
        for number, answer in enumerate(answers):
            diagnosis.add([replace(answer, time=float(number), misshapen=share if number % 2 else float("nan"))])
            found += [(number, one) for one in diagnosis.changes(float(number))]
        assert [(number, one.kind, one.is_over) for number, one in found] == [(199, "chain", False)] * told
        assert [one.kind for one in diagnosis.findings()] == ["chain"] * told
        if told:
            assert found[0][1].fields["value"] == 6.0
            (hint,) = (steps_of(diagnosis, BEAM_RATE, ("--unit", "g")).of(one) for one in diagnosis.findings())
            assert hint.commands[0].startswith("cgid calibrate 'my file.csv' --unit g --scene tail_beam -o site.toml")
    # Where most begin while an earlier one rings, the scene of a stream explains them; behind the beam of a user,
    # neither of them does.
    times = 0.03 * np.arange(200) + 0.3 * (np.arange(200) // 3)
    for model, scene in ((BEAM, "caving"), (with_modes_off(0.05), "YOUR_BEAM.toml")):
        diagnosis = Diagnosis(model, BEAM_RATE)
        diagnosis.add([replace(one, time=float(time), misshapen=6.0) for one, time in zip(answers, times, strict=True)])
        (hint,) = (steps_of(diagnosis, BEAM_RATE, ("--unit", "g")).of(one) for one in diagnosis.findings())
        assert any(f"calibrate 'my file.csv' --unit g --scene {scene} " in step for step in hint.commands)


@pytest.mark.long
def test_a_changed_beam_in_a_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, wav, model = tmp_path / "stream.raw", tmp_path / "stream.wav", tmp_path / "off.npz"
    of_the_trained_beam(4.0).astype("<f4").tofile(path)
    wavfile.write(wav, round(BEAM_RATE), of_the_trained_beam(4.0).astype("<f4"))
    model.write_bytes(with_modes_off(0.01).to_bytes())
    how = ["--rate", f"{BEAM_RATE:g}", "--channels", "1", "--sample-format", "f32le", "--unit", "m/s^2", "--json"]
    # Commands for files read a WAV, and no raw numbers.
    for arguments, n_hints, file in (
        ([str(path), *how, "--model", str(model)], 1, "RECORDING"),
        ([str(wav), *how[-3:], "--model", str(model)], 1, str(wav)),
        ([str(path), *how], 0, ""),
    ):
        assert run(["monitor", *arguments]) == 0
        told = capsys.readouterr()
        found = [line for line in map(json.loads, told.out.splitlines()) if line.get("finding") == "beam"]
        assert len(found) == n_hints
        assert told.err.count("the beam has changed") == n_hints
        for line in found:
            assert line["commands"][0].startswith(f"cgid events {file} ")
            assert line["instead"][1].startswith(f"cgid calibrate {file} ")


# -- the line -----------------------------------------------------------------------------------------


def test_the_unit_that_explains_the_size_is_named() -> None:
    force = stream(LABELS, 0.05)
    for options, wanted in (
        (("--unit", "kN"), ("cgid predict 'my file.csv' --unit N",)),
        ((), ()),
    ):
        hint = hint_of(1e3 * force, RATE, PULSES, options)
        assert hint is not None and (hint.kind, hint.commands) == ("scale", wanted)


def test_the_coal_of_another_seam_ends_within_a_recording_of_fifty_impacts() -> None:
    """At eight rocks a second these take ten seconds."""
    for part in (MisfitPart.SEAM, MisfitPart.SIZES):
        diagnosis = Diagnosis(BEAM, BEAM_RATE)
        diagnosis.misfits["1"] = Misfit(part, 50, 2.0)
        (found,) = diagnosis.findings()
        hint = NextSteps(diagnosis, BEAM_RATE, "a.wav", ("--unit", "g")).of(found)
        assert hint.commands == ("cgid predict a.wav --unit g --coal-until 10s",)


# -- every command that is printed --------------------------------------------------------------------


def recordings_with_hints(folder: Path) -> dict[str, tuple[str, list[str]]]:
    """Write recordings of one and of two channels that get hints; return cause and options of each file."""
    force, motion = stream(["coal", "gangue"] * 12, 0.05), of_another_beam(24)
    noise = np.random.default_rng(5).normal(0, 0.05, motion.size)
    times = np.arange(400) / RATE
    ringing = np.convolve(force, np.exp(-times * 1500) * np.sin(2 * np.pi * 1500 * times))[: force.size]
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
        text("two.csv", BEAM_RATE, "left (m/s^2),right (m/s^2)", *two): ("other_beam", []),
        text("units.csv", BEAM_RATE, "left (g),right (m/s^2),tap (N)", motion / 9.8, *two): ("other_beam", []),
        array("volts.npy", *(one / 100 for one in two)): (
            "other_beam",
            [*unstated, "--unit", "V", "--sensitivity", "1=10 mV/(m/s^2)", "--sensitivity", "2=9 mV/(m/s^2)"],
        ),
        array("picked.npy", *two, motion): (
            "other_beam",
            [*unstated, "--unit", "g", "--channel", "3", "--channel", "1", "--set", "coverage=.9"],
        ),
        "two channels.wav": ("other_beam", ["--full-scale", "5 g", "--set", "dead_time=6"]),
        array("faster.npy", resample_poly(motion, 2, 1)): ("other_beam", ["--rate", "51200", "--unit", "m/s^2"]),
        array("down.npy", force, rebounding): ("upside_down", [*pulses, "--unit", "N"]),
        array("kilo.npy", force, force): ("scale", [*pulses, "--unit", "kN"]),
        array("ringing.npy", ringing, ringing): ("vibration", [*pulses, "--unit", "N"]),
    }


OTHER_RECORDINGS = ("two channels.wav", "faster.npy", "kilo.npy", "ringing.npy")


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


@pytest.mark.parametrize("model", SHIPPED)
def test_a_factor_adds_its_logarithm_to_the_levels(model: str) -> None:
    own, scaled = ([one.level for one in own_answers(model, factor)] for factor in (1.0, 9.81))
    assert np.isfinite(own).all()
    # A fit may end elsewhere.
    assert np.median(np.abs(np.subtract(scaled, own) - np.log(9.81))) < 1e-6


def conditions_of(parts: list[tuple[str, tuple[Answer, ...]]], model: str) -> list[tuple[int, str, str, bool]]:
    """Return when what begins and ends in a live stream: number of the impact, channel, kind, whether it begins.

    These are blows one by one, without rebounds, so the stream as a whole is not of the world of the training.
    """
    shipped = StoredModel.load(ROOT / "models" / f"{model}.npz")
    diagnosis, number, found = Diagnosis(shipped, live=True), 0, []
    for channel, answers in parts:
        for answer in answers:
            number += 1
            diagnosis.add([replace(answer, channel=channel, time=number / 8)])
            changes = [one for one in diagnosis.changes(number / 8) if one.kind not in ("foreign", "other_seam")]
            found += [(number, *one.channels, one.kind, not one.is_over) for one in changes]
    return found


@pytest.mark.parametrize("gain", [9.81, 0.102])
@pytest.mark.parametrize("model", SHIPPED)
def test_a_gain_that_changes_is_told_within_thirty_impacts_and_when_it_is_back(model: str, gain: float) -> None:
    own, wrong = own_answers(model, 1.0), own_answers(model, gain)
    n, before = 60, 8 * (len(own) // 60) * 60
    found = conditions_of([("1", own[: len(own) // 60 * 60] * 8), ("1", wrong[:n]), ("1", own)], model)
    assert not [one for one in found if one[0] <= before]
    begun = [number - before for number, _, condition, begins in found if begins]
    assert 1 <= begun[0] <= 30
    told = dict.fromkeys((condition for _, _, condition, begins in found if begins))
    assert "scale" in told
    ended = [number - before - n for number, _, condition, begins in found if not begins]
    assert ended and max(ended) <= 120


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
        ("1", "coverage"),
        ("2", "scale"),
    }
    # In a recording as a whole, too.
    diagnosis = Diagnosis(StoredModel.load(ROOT / "models" / "default.npz"), RATE)
    for channel, answers in parts:
        diagnosis.add([replace(one, channel=channel) for one in answers])
    told = {one.kind: one.channels for one in diagnosis.findings()}
    assert told["coverage"] == ("1",) and told["scale"] == ("2",)


def test_only_the_latest_answers_of_a_live_stream_count() -> None:
    """Counts that forget equal those of the last sixty answers alone, causes and examples included."""
    rng = np.random.default_rng(3)
    causes = [
        None,
        Cause(CauseKind.NOISE, 1.0),
        Cause(CauseKind.AMPLITUDE, 9.0),
        Cause(CauseKind.SHAPE, 2.0, "peak_misfit"),
    ]
    answers = []
    for number in range(500):
        cause = causes[rng.integers(4)]
        answers.append(
            Answer(
                time=number * 2.0,
                label="coal" if cause is None else "unknown",
                probabilities={"coal": 0.9} if rng.random() < 0.8 else {},
                novelty=0.5 if cause is None else 2.0,
                cause=cause,
                clipped=bool(rng.random() < 0.2),
                problem="" if cause is None else cause.kind,
            )
        )
    live = ChannelAnswers(live=True)
    for answer in answers:
        live.add(answer, is_vibration=False)
    last = ChannelAnswers()
    for answer in answers[-60:]:
        last.add(answer, is_vibration=False)
    for name in ("n_answers", "n_unmarked", "n_unknown", "n_usable"):
        assert getattr(live, name) == getattr(last, name)
    for name in ("marks", "unmarked", "problems"):
        assert +getattr(live, name) == +getattr(last, name)
    assert {name: list(one) for name, one in live.examples.items() if one} == {
        name: list(one) for name, one in last.examples.items()
    }
    live.forget(answers[-1].time + 301)
    assert (live.n_answers, live.n_unknown, live.marks.total() + live.unmarked.total()) == (0, 0, 0)


@pytest.mark.parametrize("model", SHIPPED)
def test_a_wrong_scale_is_told_from_ten_impacts_on(model: str) -> None:
    own, wrong = own_answers(model, 1.0), own_answers(model, 9.81)
    assert sum(one.label == "unknown" for one in wrong) < len(wrong) / 2
    for size, most in ((10, 1), (30, 0), (100, 0)):
        parts = [slice(first, first + size) for first in range(0, len(own), size)]
        assert sum(level_of(model, own[part]) is not None for part in parts) <= most
    # Of those of 9.81, some have a hint instead: most of their impacts are unknown.
    told = [level_of(model, wrong[first : first + 10]) for first in range(0, len(wrong), 10)]
    assert sum(one is not None for one in told) >= 0.75 * len(told)
    assert level_of(model, wrong[:9]) is None
    text = level_of(model, wrong)
    assert text is not None
    assert ("9.81" in text) == (model == "default-acceleration")
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
            warned += [_factor_of(one.tolist(), model) != 1 for one in drawn(30, n_levels)]
            told += [_factor_of((one + np.log(9.81)).tolist(), model) != 1 for one in drawn(4, n_levels)]
    assert np.mean(warned) < 0.01
    assert np.mean(told) > 0.95


def test_one_quiet_test_is_not_the_end_of_a_wrong_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    found = iter([2.0, 1.0, 2.0, 1.0, 1.0, 1.0])
    scale, channel = diagnosis_module._Scale(read_model("default")), SimpleNamespace(n_levels=10, levels=[1.0] * 10)
    monkeypatch.setattr(scale, "_of_latest", lambda *_: next(found))
    factors = []
    for n in (10, 30, 50, 70, 90, 110):
        channel.n_levels = n
        scale.test(channel)
        factors.append(scale.factor)
    assert factors == [2.0, 2.0, 2.0, 2.0, 2.0, 1.0]
    assert not channel.levels  # those before were of another scale
