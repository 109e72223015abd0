"""What explains a channel that is not as in the training: faults by name, no false alarms, no flapping."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from cgid import shipped
from cgid.errors import BadData
from cgid.identification.model.explanations import BANDS, Explanations, Fault, Impacts, detrended, sampled
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import explanation
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.explanation import ChannelWatch, Explained, Past, explain
from cgid.identification.prediction.pasts import Pasts
from cgid.learning import faults
from cgid.learning.faults import answers_of
from cgid.scene import load_scene, parse_scene, synthesise
from cgid.scene.synthesis.stream import record
from cgid.scene.synthesis.through_beam import full_beam

#: Seeds that trained nothing.
SEED = 7407
RATE = 25600.0


@cache
def model_of(kind: str) -> StoredModel:
    name = shipped.DEFAULT_MODEL if kind == "force" else shipped.ACCELERATION_MODEL
    return StoredModel.load(shipped.path_of("models", name))


@cache
def samples_of(kind: str, seed: int = SEED) -> tuple[np.ndarray, float]:
    if kind == "beam":
        signal, _ = record(load_scene(shipped.scene_path("caving")), seed, 0)
        return signal.samples.ravel()[: round(25 * signal.sampling_rate)].astype(float), signal.sampling_rate
    batch = next(iter(synthesise("reference", 60, seed=seed)))
    frames, rng = np.asarray(batch.signals, float), np.random.default_rng(seed)
    noise = frames[:, : frames.shape[1] // 20].std()
    gaps = noise * rng.standard_normal((len(frames), round(0.01 * batch.sampling_rate)))
    return np.hstack([gaps, frames]).ravel(), batch.sampling_rate


@cache
def answers(kind: str, fault: str) -> tuple[Answer, ...]:
    samples, rate = samples_of(kind)
    noise = np.random.default_rng(1).standard_normal(samples.size)
    w, z = 2 * np.pi * 6000.0 / rate, 0.03
    r = np.exp(-z * w)
    spoilt = {
        "none": samples,
        "x40": 40 * samples,
        "/20": samples / 20,
        "upside_down": -samples,
        "clipped": np.clip(samples, -np.quantile(np.abs(samples), 0.993), np.quantile(np.abs(samples), 0.993)),
        "noise": samples + noise * (20.0 if kind == "beam" else 0.04 * np.abs(samples).max()),
        "ringing": lfilter([1 - 2 * r * np.cos(w) + r * r], [1, -2 * r * np.cos(w), r * r], samples),
        "low_pass": sosfilt(butter(4, 3000 if kind == "beam" else 1500, fs=rate, output="sos"), samples),
    }
    stated = {"rate x1.25": 1.25, "rate x5": 5.0, "rate /3": 1 / 3}.get(fault, 1.0)
    return tuple(answers_of(spoilt.get(fault, samples), rate * stated, model_of(kind)))


def explained(kind: str, fault: str) -> object:
    return explain(answers(kind, fault), model_of(kind))


@pytest.mark.parametrize(
    ("kind", "spoilt", "fault", "factor"),
    [
        ("force", "x40", Fault.SCALE, 40.0),
        ("force", "/20", Fault.SCALE, 0.05),
        ("force", "rate x5", Fault.RATE, 5.0),
        ("force", "rate /3", Fault.RATE, 1 / 3),
        *(("force", one, Fault(one), None) for one in ("upside_down", "clipped", "noise", "ringing", "low_pass")),
        ("beam", "rate x1.25", Fault.RATE, 1.25),
        *(("beam", one, Fault(one), None) for one in ("upside_down", "clipped", "noise", "ringing", "low_pass")),
    ],
)
def test_a_fault_is_told_by_its_name(kind: str, spoilt: str, fault: Fault, factor: float | None) -> None:
    found = explained(kind, spoilt)
    assert found.faults[:1] == (fault,)
    assert found.odds > 0
    assert not found.of_past
    if factor is not None:
        assert found.factor == pytest.approx(factor, rel=0.02 if kind == "beam" else 0.5)


@pytest.mark.parametrize("kind", ["force", "beam"])
def test_a_sound_recording_has_no_fault(kind: str) -> None:
    found = explained(kind, "none")
    assert found.faults == ()
    assert found.odds < 0


def test_the_few_impacts_that_rise_above_noise_have_no_scale() -> None:
    samples, rate = samples_of("force", 41)
    noise = np.random.default_rng(1).standard_normal(samples.size) * 0.12 * np.abs(samples).max()
    assert explain(answers_of(samples + noise, rate, model_of("force")), model_of("force")).faults == (Fault.NOISE,)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_impacts_are_no_fault(n: int) -> None:
    found = explain(answers("force", "none")[:n], model_of("force"))
    assert found.faults == ()


def test_a_model_without_explanations_tells_levels_alone() -> None:
    model = model_of("force")
    plain = {name: a for name, a in model.arrays.items() if not name.startswith(Explanations.PREFIXES)}
    model = replace(model, arrays=plain)
    assert explain(answers("force", "upside_down"), model).faults == ()
    found = explain([replace(one, label="coal") for one in answers("force", "x40")], model)
    assert found.faults == (Fault.SCALE,)
    assert np.isnan(found.odds)
    assert Past.of(answers("force", "none"), model) is None


@pytest.mark.parametrize("prefix", Explanations.PREFIXES)
@pytest.mark.parametrize(
    ("name", "spoil", "rule"),
    [
        ("mean", None, "missing"),
        ("limits", lambda a: a[:-1], "shape"),
        ("whitening", lambda a: 0 * a, "at least"),
        ("scale", lambda a: -a, "at least"),
        ("centre", lambda a: a[:-1], "shape"),
        ("mean", lambda a: a + 1e10, "at most"),
    ],
)
def test_arrays_are_checked(prefix: str, name: str, spoil: object, rule: str) -> None:
    model = model_of("force")
    arrays = dict(model.arrays)
    array = arrays.pop(prefix + name)
    if spoil is not None:
        arrays[prefix + name] = spoil(array)
    with pytest.raises(BadData, match=rf"{prefix}.*{rule}"):
        replace(model, arrays=arrays)


def test_samples_show_ends_noise_and_spectrum() -> None:
    rate, n = 25600.0, 4096
    t = np.arange(n) / rate
    frame = np.where(t > 0.01, np.sin(2 * np.pi * 1000 * t), 0.0)
    frame[300:310] = 2.0
    shown = sampled(frame[None] + 5.0, rate, 200, spectrum=True)[0]
    assert shown[:3] == pytest.approx([7.0, frame.min() + 5, 5.0])
    assert shown[3] == pytest.approx(0, abs=1e-6)
    assert shown[4] == 10
    assert BANDS[np.nanargmax(shown[7:])] == pytest.approx(1000, rel=0.02)


def test_a_shifted_spectrum_gives_the_rate() -> None:
    """The factor of a rate follows from the modes alone, to the 2 % between bands."""
    found = Impacts.of(answers("beam", "none"), model_of("beam"))
    fast = Impacts.of(answers("beam", "rate x1.25"), model_of("beam"))
    own, other = detrended(found.spectra), detrended(fast.spectra)
    shift = round(np.log(1.25) / np.log(1.02))
    alike = [np.corrcoef(own[20:120], other[20 + k : 120 + k])[0, 1] for k in (0, shift)]
    assert alike[1] > 0.8 > alike[0]


def stream(*parts: tuple[str, int, int]) -> list[Answer]:
    """Return successive impacts of recordings of a beam, by fault, as one stream."""
    found: list[Answer] = []
    for fault, first, last in parts:
        chosen = answers("beam", fault)[first:last]
        begin = found[-1].time + 0.1 if found else 0.0
        found += [replace(one, time=begin + one.time - chosen[0].time) for one in chosen]
    return found


def test_a_fault_of_a_stream_begins_and_ends_once() -> None:
    watch, told = ChannelWatch(model_of("beam")), []
    for answer in stream(("none", 0, 160), ("upside_down", 0, 160), ("none", 160, 330)):
        before = watch.explained.faults
        watch.add(answer)
        if watch.explained.faults != before:
            told.append(watch.explained.faults)
    assert [bool(faults) for faults in told] == [True, False]
    assert told[0] == (Fault.UPSIDE_DOWN,)
    assert not watch.is_sure


def told_by(monkeypatch: pytest.MonkeyPatch, looks: list[Explained]) -> list[tuple[Fault, ...]]:
    """Return what stands after each look, every 40 impacts, at what would be explained then."""
    watch, found = ChannelWatch(model_of("beam")), []
    for one in looks:
        monkeypatch.setattr(explanation, "explain", lambda *_, now=one, **__: now)
        for answer in answers("beam", "none")[:40]:
            watch.add(answer)
        found.append(watch.explained.faults)
    return found


def test_a_fault_near_its_limit_does_not_flap(monkeypatch: pytest.MonkeyPatch) -> None:
    told, over = Explained(faults=(Fault.SCALE,), odds=99.0), Explained(odds=-9.0)
    nearly = Explained(odds=-2.0, possible=frozenset({((Fault.SCALE,), False)}))
    found = told_by(monkeypatch, [told, over, told, *[nearly] * 4, over, over, told])
    assert found == [told.faults] * 8 + [(), told.faults]


def test_a_fault_barely_beyond_its_limit_needs_two_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    barely, other = (
        Explained(faults=(fault,), odds=3.0, possible=frozenset({((fault,), False)}))
        for fault in (Fault.CLIPPED, Fault.NOISE)
    )
    sound = Explained(odds=-1.0)  # the first forty impacts have three looks
    found = told_by(monkeypatch, [sound, barely, sound, barely, other, barely, barely])
    assert found == [()] * 6 + [barely.faults]
    # Not what only impacts of the first look say.
    assert told_by(monkeypatch, [sound, *[replace(barely, possible=frozenset())] * 4]) == [()] * 5


def test_a_fault_does_not_alternate_between_two_names(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = (Explained(faults=(fault,), odds=99.0) for fault in (Fault.LOW_PASS, Fault.RINGING))
    found = told_by(monkeypatch, [one, two, one, *[two] * 3, *[one] * 3, *[two] * 2])
    assert found == [one.faults] * 4 + [two.faults] * 7


def test_a_fault_is_sure_by_impacts_of_its_own() -> None:
    watch = ChannelWatch(model_of("beam"))
    sure = []
    for answer in stream(("none", 0, 120), ("upside_down", 0, 200)):
        watch.add(answer)
        sure.append(bool(watch.is_sure))
    assert watch.explained.of_past
    assert watch.is_sure
    first = sure.index(True)
    assert 120 + 20 < first <= 120 + 120
    assert all(sure[first:])


def test_the_past_outlives_a_restart() -> None:
    model = model_of("beam")
    past = Past.of(answers("beam", "none")[:100], model)
    assert past is not None
    again = Past.from_json(json.loads(json.dumps(past.to_json())), model)
    found = [explain(answers("beam", "low_pass"), model, one) for one in (past, again)]
    assert found[0].faults == found[1].faults != ()
    assert found[0].of_past


def test_a_person_may_say_that_a_rig_is_so() -> None:
    model, as_it_is = model_of("beam"), answers("beam", "low_pass")
    assert Past.of(as_it_is[:100], model) is None
    watch = ChannelWatch(model)
    watch.renew()
    for answer in as_it_is:
        watch.add(answer)
    assert watch.past is not None
    assert watch.past.by_word
    assert watch.explained.faults == ()


@pytest.mark.parametrize(
    "content",
    [None, [], {}, {"numbers": []}, {"numbers": ["a"] * 300}, {"numbers": None, "by_word": True}, 5, "null"],
)
def test_a_past_that_does_not_fit_is_refused(content: object) -> None:
    with pytest.raises(BadData, match="numbers"):
        Past.from_json(content, model_of("beam"))


def test_a_past_with_other_numbers_is_refused() -> None:
    model = model_of("beam")
    past = Past.of(answers("beam", "none")[:100], model)
    assert past is not None
    content = past.to_json()
    for wrong in (float("nan"), float("inf"), 1e30, "1", True):
        with pytest.raises(BadData, match="finite"):
            Past.from_json({**content, "numbers": [wrong, *content["numbers"][1:]]}, model)


def told_beside(path: Path, *parts: tuple[str, int, int], rate: float = RATE, **given: Any) -> tuple[Pasts, list[str]]:
    """Return the pasts after a run of `cgid monitor` that ends without a word, and the kinds that begin in it."""
    model, found = model_of("beam"), list[str]()
    pasts = Pasts(path, model, rate, **given)
    diagnosis = Diagnosis(model, rate, pasts=pasts)
    for answer in stream(*parts):
        diagnosis.add([answer])
        found += [one.kind for one in diagnosis.changes(answer.time) if not one.is_over]
    return pasts, found


def test_a_restart_keeps_the_own_past_and_a_person_renews_it(tmp_path: Path) -> None:
    path, turned = tmp_path / "face.past.json", ("upside_down", 0, 120)
    pasts, found = told_beside(path, ("none", 0, 120))
    assert found == []
    first, kept = path.read_bytes(), pasts.of("1")
    pasts, found = told_beside(path, turned)
    assert found == ["upside_down"]
    assert path.read_bytes() == first
    assert np.allclose(pasts.of("1").numbers, kept.numbers, rtol=1e-5, equal_nan=True)
    pasts, found = told_beside(path, turned, renew=True)
    assert found == [] and path.read_bytes() != first
    assert any("1 is replaced" in one.what() for one in pasts.take_told())
    assert told_beside(path, turned)[1] == []


def test_a_past_is_of_its_channel_model_and_rate(tmp_path: Path) -> None:
    path = tmp_path / "face.past.json"
    told_beside(path, ("none", 0, 120))
    beam = model_of("beam")
    other = replace(beam, training={**beam.training, "note": "another"})
    assert Pasts(path, beam, RATE).of("1") is not None
    assert Pasts(path, beam, RATE).of("2") is None
    for stranger in (Pasts(path, beam, 51200.0), Pasts(path, other, RATE), Pasts(path, model_of("force"), 2e5)):
        assert stranger.of("1") is None
    told_beside(path, ("none", 0, 120), rate=51200.0)  # which keeps its own beside it
    assert all(Pasts(path, beam, rate).of("1") is not None for rate in (RATE, 51200.0))


@pytest.mark.parametrize(
    "damage", [lambda raw: raw[:-40], lambda raw: b"[]", lambda raw: raw.replace(b"[", b"[1e40,", 2)]
)
def test_a_damaged_past_is_told_and_not_used(damage: Any, tmp_path: Path) -> None:
    path = tmp_path / "face.past.json"
    told_beside(path, ("none", 0, 120))
    path.write_bytes(damage(path.read_bytes()))
    spoilt = path.read_bytes()
    pasts, _ = told_beside(path, ("none", 0, 120))
    assert ["face.past.json" in one.what() for one in pasts.take_told()] == [True]
    assert path.read_bytes() == spoilt
    told_beside(path, ("none", 0, 120), renew=True)
    assert Pasts(path, model_of("beam"), RATE).of("1") is not None


def test_a_training_of_few_impacts_explains_nothing() -> None:
    """A dozen simulated recordings do not tell what is rare among sound ones."""
    model, scene = model_of("beam"), load_scene(shipped.scene_path("caving"))
    n_least = faults.LEAST_RECORDINGS * faults.IMPACTS_EACH
    assert faults.number_of_recordings(n_least) == faults.LEAST_RECORDINGS
    assert faults.explained(model, scene, faults.number_of_recordings(n_least - 1), 0) is model
    plain = {name: one for name, one in model.arrays.items() if not name.startswith(("seams.", *Explanations.PREFIXES))}
    other = replace(model, labels=("coal", "stone"), arrays=plain)
    assert faults.explained(other, scene, faults.number_of_recordings(2 * n_least), 0) is other


@pytest.mark.long
def test_a_model_of_a_user_explains_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `cgid train SCENE` learns of spoilt recordings; a table of modes has no thickness to change."""
    content = json.loads(load_scene(shipped.scene_path("caving")).text)
    content["tail_beam"] = {"modes": [mode(number) for number in range(12)]}
    scene, model = parse_scene(content), model_of("beam")
    others = ("beam.", *Explanations.PREFIXES)
    plain = {name: one for name, one in model.arrays.items() if not name.startswith(others)}
    model = replace(model, arrays=plain | full_beam(scene).arrays)
    monkeypatch.setattr(faults, "_N_ROCKS", 100)
    counted: list[int] = []
    made = faults.explained(model, scene, 10, 3, progress=counted.append)
    assert counted == [1] * 10 and made.training["faults"]["n_recordings"] == 10
    assert made.explanations is not None and made.changes is not None
    again = StoredModel.from_bytes(made.to_bytes())
    sound, *spoilt = faults.of_seam((3, again, scene), 70)
    parts = {one.fault: explain_impacts(again, one.impacts) for one in (sound, *spoilt)}
    assert parts[None] == ()
    assert parts[Fault.UPSIDE_DOWN] == (Fault.UPSIDE_DOWN,)
    assert sum(bool(found) for found in parts.values()) >= 4


def mode(number: int) -> dict[str, float]:
    """Return a row of a table of modes."""
    shapes = {"shape_impact": 1.0, "shape_sensor": 0.8 * (-1) ** number}
    return {"frequency": 150 * 1.4**number, "damping_ratio": 0.02, "modal_mass": 80.0, **shapes}


def explain_impacts(model: StoredModel, impacts: Impacts) -> tuple[Fault, ...]:
    last = impacts.at(slice(-explanation.MOST_IMPACTS, None))
    return explanation._judged(model.explanations, last, model).faults
