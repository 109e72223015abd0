"""The negative control of a training: answers that follow what sounds between the rocks are told, and decide nothing.

The recordings are those of `benchmarks/identification/control.py`, which shares nothing with the package.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgid
from benchmarks.identification.control import RATE, Design, Face, State, additive, paths, written
from cgid.cli.main import run
from cgid.errors import BadData
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import CONTROL, FLOOR, NO_FLOOR
from cgid.identification.prediction.fraction import followed, unproven
from cgid.identification.training.control import in_common, odd_sources
from cgid.identification.training.correction import correct
from cgid.identification.training.manifest import read_manifest
from cgid.identification.training.recordings import Cutting, Reading, default_names, opened, record
from cgid.identification.training.rows import Slicing
from cgid.identification.training.training import Training, train_on_groups
from cgid.labelling.learning import NEW, Learning
from cgid.labelling.recording import LabelledRecording
from cgid.plant import PlantOutputs
from cgid.plant.modbus import HEAD, WIDTH
from tests.test_plant import CollectingBroker, asked, free_port, get, modbus_frame

FACE = Face(77)
SOUND = Design("sound", State(), State())
(TONE,) = (one for one in additive() if one.name == "tone 223 Hz of 10")
(LOUD,) = (one for one in additive() if one.name == "three tones, noise 6")


@pytest.fixture(scope="module")
def manifests(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("control")
    return {
        name: written(folder / name, FACE, one, 0) for name, one in {"sound": SOUND, "tone": TONE, "loud": LOUD}.items()
    }


@pytest.fixture(scope="module")
def trainings(manifests: dict[str, Path]) -> dict[str, Training]:
    return {name: train_on_groups(path) for name, path in manifests.items()}


def test_a_sound_training_is_not_told_and_its_model_is_that_without_control(
    manifests: dict[str, Path], trainings: dict[str, Training]
) -> None:
    sound, path = trainings["sound"], manifests["sound"]
    plain = train_on_groups(record(read_manifest(path), reading=Reading(strict=True), augment=True, control=False))
    assert sound.control is not None
    assert sound.control["told"] == ""
    assert abs(sound.control["same"] - sound.control["other"]) < 0.1
    assert plain.control is None
    assert sound.metrics == plain.metrics
    assert sound.model.arrays.keys() == plain.model.arrays.keys()
    for name, array in plain.model.arrays.items():
        np.testing.assert_array_equal(sound.model.arrays[name], array, strict=True)


def test_machines_that_coincide_with_the_label_are_told(trainings: dict[str, Training]) -> None:
    loud = trainings["loud"]
    assert loud.control is not None
    assert loud.control["told"] == "background"
    assert loud.control["same"] - loud.control["other"] > 0.3
    assert loud.control["expected"] < 0.5 < loud.metrics["accuracy"]
    assert unproven(loud.model, ("gangue",)) == followed(loud.model.training) != ""


def test_another_gain_by_label_is_told_and_not_mended(tmp_path: Path) -> None:
    (gain,) = (one for one in paths() if one.name == "gain 9.8")
    training = train_on_groups(written(tmp_path, Face(1001), gain, 0))
    control = training.control
    assert control is not None
    assert control["told"] == "path"
    assert training.unmended is None
    assert control["expected"] < 0.5 < training.metrics["accuracy"]
    assert f"{control['path'][1]:.2f}" in unproven(training.model, ("gangue",))


def test_a_told_model_is_mended_with_tones_out_and_a_floor(trainings: dict[str, Training], tmp_path: Path) -> None:
    tone = trainings["tone"]
    assert tone.unmended is not None
    assert tone.control["told"] == ""
    assert tone.control["before"] == tone.unmended.control
    assert tone.control["before"]["told"] == "background"
    assert tone.model.is_mended
    assert (tone.model.arrays[FLOOR] > NO_FLOOR).any()
    swapped = written(tmp_path, FACE, TONE, 1, swapped=True)
    right = [_right(model, swapped) for model in (tone.model, tone.unmended.model)]
    assert right[0] > 0.7 > 0.6 > right[1]
    loaded = StoredModel.from_bytes(tone.model.to_bytes())
    assert loaded == tone.model


def _right(model: StoredModel, path: Path) -> float:
    rows = record(read_manifest(path), slicing=Slicing(by="impact"), model=model, control=False)
    found = np.array(model.labels)[np.argmax(model.probabilities(rows.columns(model.features)), axis=1)]
    return float(np.mean(found == rows.labels))


def test_a_told_model_decides_nothing(
    trainings: dict[str, Training], tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    told = trainings["loud"].model
    blind = replace(told, training={name: value for name, value in told.training.items() if name != CONTROL})
    FACE.recording("gangue", LOUD.gangue, [9], 40)[0].astype("<f4").tofile(tmp_path / "q.f32")
    grounds, decisions, shown = {}, {}, {}
    for name, model in {"told": told, "blind": blind}.items():
        model.save(tmp_path / f"{name}.npz")
        how = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "m/s^2", "--json"]
        assert run(["monitor", str(tmp_path / "q.f32"), *how, "--model", str(tmp_path / f"{name}.npz")]) == 0
        rows = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
        grounds[name] = {row["ground"] for row in rows if "ground" in row}
        decisions[name] = {row["decision"] for row in rows if "decision" in row}
        shown[name] = _shown(tmp_path / f"{name}.npz", np.fromfile(tmp_path / "q.f32", "<f4"))
    assert grounds["told"] == {"unproven"}
    assert decisions["told"] == {"none"}
    assert "shut" in decisions["blind"]
    for output, seen in shown["blind"].items():
        assert len(seen) > 1, output  # it can be seen there
    quiet = {"page": {("none", 0)}, "Modbus": {(0, 0)}, "Prometheus": {'cgid_shut{channel="1"} NaN'}, "MQTT": {"none"}}
    assert shown["told"] == quiet


def _shown(model: Path, samples: np.ndarray) -> dict[str, set[Any]]:
    """Return the decisions and switches of one support that each output shows while a stream comes."""
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")
    modbus, http = free_port(), free_port()
    shown: dict[str, set[Any]] = {name: set() for name in ("page", "Modbus", "Prometheus", "MQTT")}
    with CollectingBroker() as broker:
        given = {"modbus": f":{modbus}", "live": f":{http}", "prometheus": f":{http}", "mqtt": broker.url}
        with cgid.Monitor(RATE, 1, "m/s^2", model=model, outputs=PlantOutputs(**given)) as watch:
            for block in np.array_split(samples, 50):
                watch.feed(block)
                (one,) = json.loads(get(http, "/state.json")[1])["supports"]
                shown["page"].add((one["decision"], len(one["turns"])))
                (answer,) = asked(modbus, modbus_frame(struct.pack(">BHH", 4, HEAD, WIDTH)))
                registers = struct.unpack(f">{WIDTH}H", answer[9:])
                shown["Modbus"].add((registers[0], registers[12]))
                metrics = get(http, "/metrics")[1].splitlines()
                shown["Prometheus"] |= {line for line in metrics if line.startswith(("cgid_turns_total", "cgid_shut{"))}
            watch.finish()
        for topic, text in broker.messages:
            kind = topic.split("/")[1]
            shown["MQTT"] |= {json.loads(text)["decision"]} if kind == "state" else {kind} & {"shut", "open"}
    return shown


def test_the_command_and_the_card_say_it(
    manifests: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    assert run(["train", str(manifests["loud"]), "-o", str(tmp_path / "m.npz"), "--json"]) == 0
    found = capfd.readouterr()
    assert json.loads(found.out)["control"]["told"] == "background"
    assert "state of the machines" in found.err
    card = (tmp_path / "m.md").read_text(encoding="utf-8")
    assert "own label's silence" in card
    assert "| 0.npy | coal |" in card


# -- what cannot be tried, or is refused ------------------------------------------------------------------


def _table(folder: Path, rows: str) -> Path:
    path = folder / "labels.csv"
    path.write_text(rows, encoding="utf-8")
    return path


def _joined(folder: Path, name: str, *parts: tuple[str, State, int]) -> list[float]:
    """Write one recording of some stretches, and return their ends [s]."""
    samples = [FACE.recording(label, state, [11, seed], 12) for label, state, seed in parts]
    np.save(folder / name, np.concatenate(samples, axis=1)[:1].astype(np.float32))
    return np.cumsum([one.shape[1] / RATE for one in samples]).tolist()


def _one_file(folder: Path) -> Path:
    ends = _joined(folder, "a.npy", ("coal", State(), 0), ("gangue", State(), 1))
    lines = [
        f"a.npy,{RATE:g},m/s^2,{label},{start:.6f},{end:.6f}"
        for label, start, end in (("coal", 0.0, ends[0]), ("gangue", ends[0], ends[1]))
    ]
    return _table(folder, "path,rate_Hz,unit,label,start_s,end_s\n" + "\n".join(lines))


def _one_by_one(folder: Path, design: Design, *, mixed: bool) -> Path:
    """Label every second impact; if mixed, one as coal, the next as gangue."""
    rows = record(read_manifest(written(folder, FACE, design, 0)), control=False)
    order = np.lexsort((rows.time, rows.file))[::2].tolist()
    cut = [
        f"{rows.file[k]}.npy,{RATE:g},m/s^2,{('coal', 'gangue')[n % 2] if mixed else rows.labels[k]},"
        f"{rows.time[k] - 0.002:.6f},{rows.time[k] + 0.004:.6f}"
        for n, k in enumerate(order)
    ]
    return _table(folder, "path,rate_Hz,unit,label,start_s,end_s\n" + "\n".join(cut))


def _no_quiet_moment(folder: Path) -> Path:
    return _one_by_one(folder, replace(SOUND, n_files=4, n_rocks=12), mixed=True)


def _of_rates(folder: Path) -> Path:
    path = written(folder, FACE, replace(SOUND, n_files=4, n_rocks=12), 0)
    for name in ("1.npy", "3.npy"):  # every second sample of gangue alone
        np.save(folder / name, np.load(folder / name)[:, ::2])
    text = path.read_text(encoding="utf-8").replace(f"gangue,{RATE:g}", f"gangue,{RATE / 2:g}")
    return _table(folder, text)


def _four_impacts(folder: Path) -> Path:
    return written(folder, FACE, replace(SOUND, n_files=4, n_rocks=1), 0)


@pytest.mark.parametrize(
    "made",
    [_one_file, _no_quiet_moment, _of_rates, _four_impacts],
    ids=["both labels in one file", "no quiet moment", "rates that differ by label", "four impacts"],
)
def test_what_cannot_be_tried_is_said(made: Callable[[Path], Path], tmp_path: Path) -> None:
    control = train_on_groups(made(tmp_path)).control
    assert control is not None
    assert (control["told"], bool(control["why"])) == ("", True)


def test_impacts_labelled_one_by_one_have_the_silence_between_them(tmp_path: Path) -> None:
    control = train_on_groups(_one_by_one(tmp_path, replace(LOUD, n_files=4, n_rocks=20), mixed=False)).control
    assert control is not None
    assert control.get("before", control)["told"] == "background"


def test_three_labels_are_tried(tmp_path: Path) -> None:
    path = written(tmp_path, FACE, replace(SOUND, n_files=6, n_rocks=12), 0)
    text = path.read_text(encoding="utf-8").replace("4.npy,coal", "4.npy,shale").replace("5.npy,gangue", "5.npy,shale")
    control = train_on_groups(_table(tmp_path, text)).control
    assert control is not None
    assert control["n"] > 50
    assert control["told"] == ""


def test_a_machine_that_starts_within_a_stretch_and_impacts_without_label_are_no_fault(tmp_path: Path) -> None:
    machine = replace(State(), tones=((223.0, 10.0),))
    lines = []
    for k, label in enumerate(("coal", "gangue") * 3):
        ends = _joined(
            tmp_path, f"{k}.npy", (label, State(), 20 + k), (label, machine, 40 + k), ("gangue", State(), 60)
        )
        lines.append(f"{k}.npy,{RATE:g},m/s^2,{label},0,{ends[1]:.6f}")
    rows = record(read_manifest(_table(tmp_path, "path,rate_Hz,unit,label,start_s,end_s\n" + "\n".join(lines))))
    control = train_on_groups(rows).control
    assert control is not None
    assert control["told"] == ""
    assert control["n"] > 0.95 * len(rows.labels)


@pytest.mark.parametrize(
    ("columns", "rule"),
    [({"labels": "coal,coal,coal,coal"}, "labels"), ({"labels": "coal,gangue,coal,coal"}, "groups")],
    ids=["one label", "a label in one recording"],
)
def test_labels_that_cannot_be_told_apart_are_refused(columns: dict[str, str], rule: str, tmp_path: Path) -> None:
    written(tmp_path, FACE, replace(SOUND, n_files=4, n_rocks=8), 0)
    lines = [f"{k}.npy,{label},{RATE:g},m/s^2" for k, label in enumerate(columns["labels"].split(","))]
    with pytest.raises(BadData, match=rule):
        train_on_groups(_table(tmp_path, "path,label,rate_Hz,unit\n" + "\n".join(lines)))


# -- sources against each other ---------------------------------------------------------------------------


def test_near_copies_in_other_groups_are_refused(tmp_path: Path) -> None:
    recorded = FACE.recording("coal", State(), [5], 30)[0]
    rng, lines = np.random.default_rng(1), ["path,label,rate_Hz,unit"]
    for k in range(9):  # trimmed, louder, with a noise of its own
        copy = recorded[round((0.02 + 0.04 * k) * RATE) :] * 1.01**k
        np.save(tmp_path / f"{k}.npy", (copy + 0.1 * rng.normal(size=copy.size))[None].astype(np.float32))
        lines.append(f"{k}.npy,{rng.choice(['coal', 'gangue'])},{RATE:g},m/s^2")
    with pytest.raises(BadData, match="other rocks"):
        train_on_groups(_table(tmp_path, "\n".join(lines)))
    one_group = [f"{line},{'group' if k == 0 else 'day'}" for k, line in enumerate(lines[:3])]
    record(read_manifest(_table(tmp_path, "\n".join(one_group))))


def test_an_exact_copy_is_refused_whatever_its_group_and_interval(tmp_path: Path) -> None:
    lines = ["path,label,rate_Hz,unit,group,start_s,end_s"]
    for name, span in (("a", "0,1"), ("b", "1,2")):
        np.save(tmp_path / f"{name}.npy", np.zeros((1, 60_000), np.float32))
        lines.append(f"{name}.npy,coal,{RATE:g},m/s^2,day,{span}")
    with pytest.raises(BadData, match=r"b\.npy: recordings must differ"):
        record(read_manifest(_table(tmp_path, "\n".join(lines))))


def test_times_of_copies_and_of_other_recordings() -> None:
    rng = np.random.default_rng(3)
    for n in (8, 24, 300):
        for _ in range(50):
            first, other = (np.cumsum(rng.uniform(0.3, 1.2, n)) for _ in range(2))
            n_same, lag = in_common(first, first[n // 2 :] * (1 + 1e-5) - 2.5)
            assert (n_same == 0) == (n == 8)  # four impacts are too few
            assert n_same == 0 or lag == pytest.approx(-2.5, abs=0.01)
            assert in_common(first, other)[0] == 0
            assert in_common(0.5 * np.arange(n), 0.5 * np.arange(n) + 0.1)[0] == 0  # even times tell nothing


def _levels(*rows: tuple[str, float, float]) -> list[dict[str, Any]]:
    return [
        {"name": f"{k}.wav", "label": label, "rocks": rocks, "silence": silence}
        for k, (label, rocks, silence) in enumerate(rows)
    ]


def test_a_recording_and_a_label_of_another_scale_are_named() -> None:
    sound = [("coal", 50, 3), ("gangue", 58, 4), ("coal", 52, 5), ("gangue", 60, 3), ("coal", 51, 2), ("gangue", 59, 3)]
    assert not list(odd_sources(_levels(*sound)))
    of_one = [("coal", 50 + 19.8, 3 + 19.8), *sound[1:]]
    (line,) = odd_sources(_levels(*of_one))
    assert "0.wav" in line
    of_label = [
        (label, rocks + 20 * (label == "gangue"), silence + 20 * (label == "gangue")) for label, rocks, silence in sound
    ]
    (line,) = odd_sources(_levels(*of_label))
    assert "gangue" in line
    louder_machine = [(label, rocks, silence + 20 * (k == 0)) for k, (label, rocks, silence) in enumerate(sound)]
    assert not list(odd_sources(_levels(*louder_machine)))


# -- other ways to train ----------------------------------------------------------------------------------


def test_a_correction_has_the_control(trainings: dict[str, Training], tmp_path: Path) -> None:
    model = trainings["sound"].model
    rows = record(read_manifest(written(tmp_path, FACE, replace(SOUND, n_files=4, n_rocks=12), 3)), model=model)
    control = correct(model, rows).model.training["correction"][CONTROL]
    assert control["told"] == ""
    assert control["n"] > 20


def test_rocks_of_one_file_are_one_recording_in_votes(manifests: dict[str, Path], tmp_path: Path) -> None:
    path = manifests["sound"]
    rows = record(read_manifest(path), control=False)
    first = np.sort(rows.time[rows.file == 0])
    lines = [f"{path.parent / '0.npy'},coal,{RATE:g},m/s^2,{at - 0.05:.6f},{at + 0.2:.6f}" for at in first.tolist()]
    lines += [f"{path.parent / f'{k}.npy'},{'gangue' if k % 2 else 'coal'},{RATE:g},m/s^2,," for k in range(1, 6)]
    table = _table(tmp_path, "path,label,rate_Hz,unit,start_s,end_s\n" + "\n".join(lines))
    found = train_on_groups(table).metrics["recordings"]["rows"]
    assert len(found) == 6
    assert [row["n"] for row in found if row["name"].endswith("0.npy")] == [len(first)]


def _forces(folder: Path) -> Path:
    """Write forces in which the recorder of gangue hums: pulses of two lengths that overlap, and noise."""
    lines, rate = ["path,label,rate_Hz,unit"], 100_000.0
    for k in range(6):
        rng, label = np.random.default_rng(k), ("coal", "gangue")[k % 2]
        samples = np.zeros(int(9 * rate))
        for at in np.arange(0.3, 8.5, 0.5):
            n = round(rate * (1.0e-3 if label == "coal" else 0.7e-3) * np.exp(0.25 * rng.normal()))
            pulse = 500 * np.exp(0.3 * rng.normal()) * np.sin(np.pi * np.arange(n) / n) ** 1.5
            samples[round(at * rate) :][:n] += pulse
        samples += rng.normal(0, 2.0, samples.size)
        np.save(folder / f"{k}.npy", samples[None].astype(np.float32))
        lines.append(f"{k}.npy,{label},{rate:g},N")
    return _table(folder, "\n".join(lines))


def test_forces_and_windows_and_two_sensors_have_the_control(tmp_path: Path) -> None:
    for name in ("force", "beam"):
        (tmp_path / name).mkdir()
    of_force = train_on_groups(_forces(tmp_path / "force")).control
    two = replace(LOUD, n_files=4, n_rocks=12, sensors=2)
    of_two = train_on_groups(written(tmp_path / "beam", FACE, two, 0)).control
    manifest = read_manifest(written(tmp_path / "window", FACE, replace(LOUD, n_files=4, n_rocks=10), 0))
    of_windows = train_on_groups(record(manifest, slicing=Slicing(by="window"))).control
    rng, lines = np.random.default_rng(2), ["path,label,rate_Hz,unit"]
    for k in range(4):  # no quiet moment
        np.save(tmp_path / f"{k}.npy", np.diff(rng.normal(size=20_000), n=k % 2)[None])
        lines.append(f"{k}.npy,{('coal', 'gangue')[k % 2]},{RATE:g},m/s^2")
    of_flow = train_on_groups(_table(tmp_path, "\n".join(lines))).control
    assert of_flow is not None and of_flow["why"]
    assert of_force is not None and of_two is not None and of_windows is not None
    of_two, of_windows = (one.get("before", one) for one in (of_two, of_windows))
    assert (of_force["told"], of_two["told"]) == ("", "background")
    assert of_force["n"] > 70
    assert of_windows["n"] > 50
    assert of_windows["same"] > of_windows["other"] + 0.1


# -- the page of label ------------------------------------------------------------------------------------


@pytest.mark.parametrize("both", [False, True], ids=["a state for each label", "each label in each state"])
def test_the_page_of_labels_shows_the_control_and_the_missing_state(both: bool, tmp_path: Path) -> None:
    manifest = read_manifest(written(tmp_path, FACE, replace(LOUD, n_files=8, n_rocks=10, both=both), 5))
    slicing = Slicing(by="impact")
    cutting = Cutting(default_names("vibration", [RATE], slicing), slicing, "m/s^2")
    recordings = []
    for one in manifest.annotations:
        file = opened((replace(one, label=""),), Reading())
        listed = LabelledRecording(file, {"path": one.written}, "vibration", {NEW: cutting})
        listed.read(NEW, lambda: False)
        recordings.append(listed)
    learning = Learning(None, lambda: False)
    learning.learn(recordings, manifest)
    assert learning.trainings[NEW].control is None
    learning.hear(recordings, manifest)
    control = learning.trainings[NEW].control
    assert control is not None
    assert control["told"] == ("" if both else "background")
    content = learning.content()
    assert f"{control['same']:.2f}" in content["control"][0]
    assert ("others' machines" in (content["results"][NEW]["text"] or "")) is not both
    missing = [note for note in content["control"] if "1.npy" in note and "3.npy" in note]
    assert bool(missing) is not both
    model = learning.model(NEW)
    assert model is not None
    assert bool(unproven(model, ("gangue",))) is not both
