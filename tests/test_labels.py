"""Labels of impacts: rows measured once, the accuracy of those drawn at random, stretches, and work that is stopped."""

from __future__ import annotations

import csv
import json
import re
import shlex
import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgid
from cgid import impact_table, open_recording
from cgid._lib.workers import Workers
from cgid.cli import main
from cgid.cli.answering import prediction_by
from cgid.cli.reading import ReadingOptions
from cgid.errors import BadData, InvalidValue, Stopped
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.model.model import StoredModel
from cgid.identification.training import train_on_groups
from cgid.identification.training.audacity import read_track
from cgid.identification.training.manifest import Annotation, Manifest, read_manifest
from cgid.identification.training.metrics import clustered_interval, evaluate_drawn
from cgid.identification.training.recordings import Reading, labelled, record
from cgid.identification.training.rows import Slicing

RATE = 10_000.0
N_IMPACTS = 40


def test_the_command_after_a_training_reads_recordings_like_its_own(capsys: Any, tmp_path: Path) -> None:
    folder, model = Path(__file__).parents[1] / "datasets" / "labelled", str(tmp_path / "m.npz")
    assert main(["train", str(folder / "labels.csv"), "-o", model, "--set", "dead_time=5"]) == 0
    (then,) = re.findall("; now cgid (.*)", capsys.readouterr().err)
    assert shlex.split(then)[2:-2] == ["--set", "dead_time=5", "--full-scale", "10000 m/s^2"]
    assert main(shlex.split(then.replace("FILE", str(folder / "thursday.wav")))) == 0
    # What differs between the rows is left to the reader, and an option is for rows without a value.
    row = Annotation(path=Path("a.wav"), written="a.wav", label="coal", gain=10.0, unit="V", channels=(2,), invert=True)
    rows = (row, replace(row, path=Path("b.wav"), unit="mV"))
    reading = ReadingOptions(unit="g", sensitivity=("10 mV/g", "a.wav:2=9 mV/g"))
    words = prediction_by(Path("m.npz"), StoredModel.load(model), Manifest(source="x", annotations=rows), reading)
    assert (
        words == "cgid predict FILE --channel 2 --set invert=true --sensitivity '10 mV/g' --set gain=10 --model m.npz"
    )


def rung(seed: int, n: int = N_IMPACTS) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Return two channels [g] of a ringing plate, the labels of its impacts and their times [s]."""
    generator = np.random.default_rng(seed)
    labels = generator.permutation(["coal", "gangue"] * (n // 2)).tolist()
    onsets = 0.3 + 0.4 * np.arange(n) + generator.uniform(0, 0.05, n)
    time = np.arange(round((onsets[-1] + 0.6) * RATE)) / RATE
    out = 0.02 * generator.standard_normal((2, len(time)))
    for onset, label in zip(onsets, labels, strict=True):
        since = np.clip(time - onset, 0, None)
        for tone in (700.0, 1900.0):
            height = 10 ** generator.normal(0.3, 0.1) * (1 if (tone > 1000) == (label == "gangue") else 0.4)
            decay = (time >= onset) * np.exp(-since / 0.02) * np.sin(2 * np.pi * tone * since)
            out += height * np.array([[1.0], [0.6]]) * decay
    return out, labels, onsets


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, str]], list[str]]:
    """A recording, the rows of its table without labels, and the labels."""
    folder = tmp_path_factory.mktemp("site")
    samples, labels, _ = rung(62)
    np.save(folder / "a.npy", samples)
    table = folder / "events.csv"
    assert main(["events", str(folder / "a.npy"), "-o", str(table), "--rate", "10000", "--unit", "g"]) == 0
    with table.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == N_IMPACTS
    return folder, rows, labels


def written(path: Path, rows: list[dict[str, Any]]) -> Path:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path


def whole(folder: Path) -> Manifest:
    """Return the recording without any label."""
    return Manifest(source="a.npy", annotations=(Annotation(path=folder / "a.npy", written="a.npy", group="a"),))


READING = Reading(sampling_rate=RATE, unit="g")


# -- measured once, trained often -------------------------------------------------------------------------


def test_rows_measured_once_and_labelled_are_those_of_the_table(site: Any) -> None:
    folder, rows, labels = site
    measured = record(whole(folder), slicing=Slicing(by="impact"), reading=READING)
    assert set(measured.labels) == {""} and len(measured.labels) == 2 * N_IMPACTS
    marked = [
        {**row, "label": label if k % 3 else "", "chosen": "random"}
        for k, (row, label) in enumerate(zip(rows, labels, strict=True))
    ]
    manifest = read_manifest(written(folder / "some.csv", marked))
    assert manifest.n_unlabelled == len(range(0, N_IMPACTS, 3))
    once, again = labelled(measured, manifest), record(manifest, slicing=Slicing(by="impact"), reading=READING)

    def by_time(one: Any) -> list[Any]:
        keys = zip(one.time.tolist(), one.channel.tolist(), one.labels.tolist(), one.chosen.tolist(), strict=True)
        return sorted(zip(keys, one.features.tolist(), strict=True))

    assert by_time(once) == by_time(again)
    assert {once.sources[k] for k in once.source} == {again.sources[k] for k in again.source}
    with pytest.raises(InvalidValue, match="rows must be impacts of recordings"):
        labelled(record(whole(folder), slicing=Slicing(by="window"), reading=READING), manifest)


def test_a_stretch_trains_what_its_rows_would(site: Any) -> None:
    """ "Half was coal, half was gangue" without a label in any row, beside the same labels row by row."""
    folder, rows, _ = site
    middle = (float(rows[19]["end_s"]) + float(rows[20]["start_s"])) / 2
    names = ["coal"] * 20 + ["gangue"] * 20
    each = [{**row, "label": name} for row, name in zip(rows, names, strict=True)]
    stretches = [
        {"path": "a.npy", "start_s": 0.0, "end_s": middle, "label": "coal"},
        {"path": "a.npy", "start_s": middle, "end_s": "", "label": "gangue"},
    ]
    found = []
    for name, table in (("each.csv", each), ("stretches.csv", [*rows, *stretches])):
        one = record(read_manifest(written(folder / name, table)), slicing=Slicing(by="impact"))
        order = np.lexsort((one.channel, one.time))
        found.append((one.time[order], one.labels[order], one.features[order]))
    for first, second in zip(*found, strict=True):
        assert np.array_equal(first, second)


def test_stretches_of_one_recording_are_its_groups(site: Any) -> None:
    """Eight stretches of five impacts; with two of a label, or as single impacts, blocks of time are the groups."""
    folder, rows, _ = site
    spans = list(pairwise([0.0, *[float(row["start_s"]) - 0.01 for row in rows[5::5]], 17.0]))
    table = [
        {"path": "a.npy", "start_s": a, "end_s": b, "label": ["coal", "gangue"][k % 2], "chosen": "stretch"}
        for k, (a, b) in enumerate(spans)
    ]
    measured = record(whole(folder), slicing=Slicing(by="impact"), reading=READING)
    for n, found in ((8, "8 stretches"), (5, "blocks of its time")):
        manifest = read_manifest(written(folder / "spans.csv", table[:n]))
        training = train_on_groups(labelled(measured, manifest))
        recorded = training.model.training["recorded"]
        assert any(found in line for line in recorded["warnings"])
        assert recorded["class_weights"] == ("balanced" if n == 8 else None)
    assert training.rows is not None and set(training.rows.chosen) == {"stretch"}


def test_a_training_says_its_rows(site: Any) -> None:
    folder, rows, labels = site
    table = written(folder / "all.csv", [{**row, "label": label} for row, label in zip(rows, labels, strict=True)])
    training = train_on_groups(record(read_manifest(table), slicing=Slicing(by="impact")))
    tested = training.rows
    assert tested is not None and tested.labels.tolist() == training.test_labels.tolist()
    truth = {round(float(row["time_s"]), 1): label for row, label in zip(rows, labels, strict=True)}
    assert [truth[round(time, 1)] for time in tested.time.tolist()] == training.test_labels.tolist()
    answers = np.array(training.model.labels)[np.argmax(training.test_probabilities, axis=1)]
    assert np.mean(answers == tested.labels) == training.metrics["accuracy"]


# -- drawn at random --------------------------------------------------------------------------------------


def test_the_accuracy_of_impacts_drawn_at_random_comes_first(site: Any, capsys: Any) -> None:
    """Of 40 impacts 25 were drawn; they are counted once though two channels have them."""
    folder, rows, labels = site
    drawn = [
        {**row, "label": label, "chosen": "random" if k < 25 else "looked"}
        for k, (row, label) in enumerate(zip(rows, labels, strict=True))
    ]
    table = written(folder / "drawn.csv", drawn)
    assert main(["train", str(table), "-o", str(folder / "a.npz"), "--overwrite"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("right on ") and "impacts drawn at random: " in out[0] and out[1].startswith("accuracy ")
    assert "of impacts drawn at random" in (folder / "a.md").read_text()
    assert main(["train", str(table), "-o", str(folder / "a.npz"), "--overwrite", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["drawn"]
    assert found["n_recordings"] == 1 and found["of_others"] is None and 22 <= found["n"] <= 25
    assert found["accuracy_interval_95"] == list(wilson_interval(found["n_right"] / found["n"], found["n"]))
    assert f"right on {found['n_right']} of {found['n']} impacts" in out[0]


def test_drawn_impacts_are_counted_by_rock_and_over_recordings(site: Any) -> None:
    folder, rows, labels = site
    table = written(
        folder / "b.csv", [{**row, "label": label, "chosen": "random"} for row, label in zip(rows, labels, strict=True)]
    )
    one = record(read_manifest(table), slicing=Slicing(by="impact"))
    sure = np.where((one.labels == "coal")[:, None], [0.9, 0.1], [0.1, 0.9])
    assert evaluate_drawn(one, sure, ("coal", "gangue"))["n_right"] == N_IMPACTS
    first = np.flatnonzero(one.rock == one.rock[0])
    doubtful = sure.copy()
    doubtful[first[0]] = [0.45, 0.55] if one.labels[0] == "coal" else [0.55, 0.45]  # the other channel knows better
    assert evaluate_drawn(one, doubtful, ("coal", "gangue"))["n_right"] == N_IMPACTS
    doubtful[first] = doubtful[first[0]]
    counted = evaluate_drawn(one, doubtful, ("coal", "gangue"))
    assert (counted["n"], counted["n_right"]) == (N_IMPACTS, N_IMPACTS - 1)
    several = replace(one, file=one.rock // 10, digests=tuple("abcd"))
    rock = np.unique(several.rock, return_index=True)[1]
    counted = evaluate_drawn(several, doubtful, ("coal", "gangue"))
    hits = np.array(["coal", "gangue"])[doubtful[rock].argmax(axis=1)] == several.labels[rock]
    assert counted["n_recordings"] == 4 and counted["of_others"] == list(clustered_interval(hits, several.file[rock]))
    assert evaluate_drawn(replace(one, chosen=np.empty(0, np.str_)), sure, ("coal", "gangue")) == {}
    assert evaluate_drawn(replace(one, chosen=np.full(len(one.labels), "looked")), sure, ("coal", "gangue")) == {}


# -- stopped ----------------------------------------------------------------------------------------------


def test_work_that_is_stopped_ends_before_its_next_part(site: Any) -> None:
    folder, rows, labels = site
    table = written(folder / "c.csv", [{**row, "label": label} for row, label in zip(rows, labels, strict=True)])
    measured = record(read_manifest(table), slicing=Slicing(by="impact"))
    ended, seen = threading.Event(), list[int]()

    def progress(n: int) -> None:
        seen.append(n)
        ended.set()

    with pytest.raises(Stopped):
        train_on_groups(measured, progress=progress, workers=Workers(stopped=ended.is_set))
    assert seen == [1]


@pytest.mark.parametrize("jobs", [1, 2])
def test_stopped_workers_do_no_more(jobs: int) -> None:
    ended = threading.Event()
    results = Workers(jobs, stopped=ended.is_set).each(pow, 2, range(50))
    assert next(results) == 1
    ended.set()
    with pytest.raises(Stopped):
        list(results)


# -- tables of impacts ------------------------------------------------------------------------------------


def test_the_table_of_impacts_is_that_of_events_and_can_be_trained_on(site: Any) -> None:
    folder, rows, labels = site
    recording = open_recording(folder / "a.npy", sampling_rate=RATE, unit="g")
    table = impact_table(recording)
    assert table["time_s"].tolist() == [float(row["time_s"]) for row in rows]
    assert (table[["label", "by", "chosen"]] == "").all(axis=None)
    assert table["end_s"].tolist() == [float(row["end_s"]) for row in rows]
    named = table.assign(path="a.npy", label=labels, rate_Hz=RATE, unit="g")
    named.to_csv(folder / "python.csv", index=False)
    assert main(["train", str(folder / "python.csv"), "-o", str(folder / "python.npz"), "--overwrite"]) == 0
    predicted = impact_table(recording, folder / "python.npz")
    assert np.mean(predicted["predicted"].to_numpy() == np.array(labels)) > 0.8
    assert np.allclose(predicted["p_coal"] + predicted["p_gangue"], 1) and (predicted["novelty"] > 0).all()
    # The mean over both channels of what predict says of each.
    with pytest.warns(UserWarning, match="hear the same rocks"):
        each = cgid.predict(np.load(folder / "a.npy").T, RATE, "g", folder / "python.npz")
    near = [each[np.abs(each["time_s"] - time) < 5e-3] for time in predicted["time_s"]]
    assert predicted["p_coal"].tolist() == pytest.approx([one["p_coal"].mean() for one in near], abs=1e-12)
    assert {len(one) for one in near} == {2}


def test_labels_go_to_audacity_and_back(site: Any, tmp_path: Path, capsys: Any) -> None:
    folder, rows, labels = site
    track = tmp_path / "a.txt"
    events = ["events", str(folder / "a.npy"), "--rate", "10000", "--unit", "g", "--audacity", str(track)]
    assert main([*events, "-o", str(tmp_path / "new.csv")]) == 0
    assert "40 marks in Audacity" in capsys.readouterr().err
    lines = [line.split("\t") for line in track.read_text().splitlines()]
    assert [line[0] for line in lines] == [f"{float(row['time_s']):.6f}" for row in rows]
    # A person names most of them, one by a mark at an instant, some by a region, and marks one that is none.
    named = [f"{begin}\t{end}\t{label}" for (begin, end, _), label in zip(lines, labels, strict=True)]
    named[3] = f"{float(lines[3][0]) + 0.02}\t{float(lines[3][0]) + 0.02}\tslate\n\\\t100.0\t2000.0"
    region = f"{float(lines[20][0]) - 0.1:.6f}\t{float(lines[29][0]) + 0.1:.6f}\tcoal"
    track.write_text(
        "\n".join(
            [*named[:20], region, lines[20][0] + "\t" + lines[20][1] + "\tgangue", *named[30:35], "0.01\t0.02\tcoal"]
        )
    )
    assert main([*events, "-o", str(tmp_path / "labelled.csv")]) == 0
    err = capsys.readouterr().err
    assert "labels 35 of 40 impacts" in err and "1 mark with a label at no impact" in err
    with (tmp_path / "labelled.csv").open(newline="") as file:
        found = [row["label"] for row in csv.DictReader(file)]
    assert found == [*labels[:3], "slate", *labels[4:20], "gangue", *["coal"] * 9, *labels[30:35], *[""] * 5]


@pytest.mark.parametrize("line", ["coal", "1\t0.5\tcoal", "1\t2e999\tcoal", "nan\t1\tx", "1 2 coal"])
def test_a_damaged_track_is_one_line(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(f"0.1\t0.2\tcoal\n{line}\n")
    with pytest.raises(BadData, match="line 2: a label track must have begin and end in s"):
        read_track(tmp_path / "a.txt")
