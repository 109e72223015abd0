"""A model corrected by labelled impacts: what is folded into it, its evidence, and what it states of its accuracy."""

from __future__ import annotations

import csv
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cgid.cli.main import run
from cgid.errors import BadData
from cgid.identification.model.confusion import wilson_interval
from cgid.identification.model.families import softmax
from cgid.identification.model.model import StoredModel
from cgid.identification.training import Rows, train_on_specimens
from cgid.identification.training.card import correction_section, write_card
from cgid.identification.training.correction import Shift, correct, fit_bias_and_slope, shifted
from cgid.identification.training.grouped import warnings_of_few
from cgid.identification.training.metrics import clustered_interval
from cgid.scene import load_scene, synthesise

NAMES = ("peak_force", "width_50", "skewness")


def impacts(
    n: int, seed: int, labels: tuple[str, ...] = ("coal", "gangue"), shift: float = 0.0, gain: float = 1.0
) -> Rows:
    """Return impacts whose labels overlap in width; `shift` moves all widths, in standard deviations."""
    random = np.random.default_rng(seed)
    truth = random.integers(len(labels), size=n)
    width = np.exp(0.3 * (random.normal(size=n) - 2.0 * truth + shift)) * 1e-3
    peak = gain * np.exp(random.normal(size=n)) * 1e3 * (1e-3 / width)
    features = np.stack([peak, width, random.normal(size=n)], axis=1)
    return Rows(
        names=NAMES,
        features=features,
        labels=np.array(labels)[truth],
        group=np.arange(n),
        source=np.zeros(n, np.intp),
        sources=("made",),
        digests=("made",),
        unit="N",
        sampling_rates=(1e5, 1e5),
    )


@pytest.fixture(scope="module")
def model() -> StoredModel:
    return train_on_specimens(impacts(3000, 1), features=NAMES, family="logistic").model


@pytest.mark.parametrize("family", ["logistic", "linear", "network"])
@pytest.mark.parametrize("labels", [("coal", "gangue"), ("coal", "gangue", "steel")])
def test_a_shift_is_folded_into_every_family(family: str, labels: tuple[str, ...]) -> None:
    former = train_on_specimens(impacts(400, 2, labels), features=NAMES, family=family).model
    new = impacts(50, 3, labels).features
    shift = Shift(labels, np.linspace(-0.4, 0.6, len(labels)), 0.7, 1.25)
    moved = StoredModel.from_bytes(shifted(former, shift).to_bytes())
    wanted = softmax(shift.slope * np.log(former.probabilities(new)) + shift.bias)
    louder = new * [shift.gain, 1.0, 1.0]
    np.testing.assert_allclose(moved.probabilities(louder), wanted, atol=1e-12)
    np.testing.assert_allclose(moved.novelty(louder), former.novelty(new), rtol=1e-9)
    assert moved.conformal is None


def test_the_evidence_is_that_of_the_integral() -> None:
    """Laplace's Gaussian beside a sum over a grid of both biases and the slope, of prior deviations .7 and .3."""
    random = np.random.default_rng(4)
    logs = np.log(softmax(random.normal(size=(30, 2)) * 2))
    truth = (random.random(30) < 0.6).astype(np.intp)
    grids = [np.linspace(-5, 5, 81) * deviation for deviation in (0.7, 0.7, 0.3)]
    first, second, slope = np.meshgrid(*grids, indexing="ij")
    total = np.zeros(first.shape)
    for row, label in zip(logs, truth, strict=True):
        scores = [np.exp(slope) * row[0] + first, np.exp(slope) * row[1] + second]
        total += scores[label] - np.logaddexp(*scores)
    for axis, deviation in ((first, 0.7), (second, 0.7), (slope, 0.3)):
        total += -0.5 * (axis / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
    cell = np.prod([grid[1] - grid[0] for grid in grids])
    (_, evidence) = fit_bias_and_slope(logs, truth)
    assert evidence == pytest.approx(np.log(np.exp(total).sum() * cell), abs=0.05)


def test_impacts_like_those_of_the_training_move_little(model: StoredModel) -> None:
    lost, held, judge = [], [], impacts(2000, 99)
    before = np.mean(answers(model, judge) == judge.labels)
    for seed in range(8):
        found = correct(model, impacts(20, 100 + seed))
        after = np.mean(answers(found.model, judge) == judge.labels)
        low, high = found.after["accuracy_interval_95"]
        lost.append(before - after)
        held.append(low <= after <= high)
    assert np.mean(lost) < 0.01 and max(lost) < 0.04
    assert sum(held) >= 6


def test_another_seam_is_corrected(model: StoredModel) -> None:
    judge = impacts(2000, 98, shift=1.0)
    before = np.mean(answers(model, judge) == judge.labels)
    found = correct(model, impacts(50, 7, shift=1.0))
    after = np.mean(answers(found.model, judge) == judge.labels)
    assert before < 0.75 and after > before + 0.07
    assert found.before["accuracy"] == pytest.approx(np.mean(found.labels == answers(model, impacts(50, 7, shift=1.0))))
    low, high = found.after["accuracy_interval_95"]
    assert low <= after <= high
    again = correct(model, impacts(50, 7, shift=1.0)).model
    assert again.to_bytes() == found.model.to_bytes()
    told = found.model.training["correction"]
    assert sum(told["labels"].values()) == told["n"] == 50
    assert "Corrected for a site" in write_card(found.model, "m.npz", further=[correction_section(told)])


def answers(model: StoredModel, rows: Rows) -> np.ndarray:
    return np.array(model.labels)[np.argmax(model.probabilities(rows.features), axis=1)]


def test_impacts_that_the_model_does_not_know_teach_nothing(model: StoredModel) -> None:
    rows = impacts(30, 8)
    strange = rows.features.copy()
    strange[:25, 1] *= 1e3
    with pytest.raises(BadData, match="within the training of the model, 10 at least, got 5 of 30; train without"):
        correct(model, replace(rows, features=strange))
    strange = np.where(np.arange(30)[:, None] < 12, strange, rows.features)
    assert correct(model, replace(rows, features=strange)).n_unknown == 12


def test_labelled_impacts_correct_a_shipped_model(tmp_path: Path, capsys: Any) -> None:
    """Blows on the beam of `tail_beam`, one after the other in a recording."""
    (batch,) = synthesise(load_scene("tail_beam"), 14, seed=5)
    silence = np.random.default_rng(0).normal(0, batch.signals[:, :60].std(), (14, 1200))
    blows = np.hstack([silence[:, :600], batch.signals, silence[:, 600:]])
    np.save(tmp_path / "blows.npy", blows.ravel())
    length = blows.shape[1] / 25_600
    with (tmp_path / "lumps.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["path", "label", "start_s", "end_s", "rate_Hz", "unit"])
        for k, label in enumerate(batch.labels):
            rows.writerow(["blows.npy", label, k * length, (k + 0.8) * length, 25_600, "m/s^2"])
    arguments = ["train", str(tmp_path / "lumps.csv"), "--from", "default-acceleration", "-o", str(tmp_path / "s.npz")]
    assert run(arguments) == 0
    said = capsys.readouterr()
    assert "on this beam, cross-validated over 1" in said.out and "moved bias coal" in said.out
    assert "what sounds between the rocks" in said.err
    assert "Corrected for a site" in (tmp_path / "s.md").read_text()
    assert run([*arguments, "--json", "--overwrite"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["n"] + told["n_unknown"] >= 12 and told["accuracy"] > 0.6
    (then,) = re.findall("; now cgid (.*)", said.err)
    assert shlex.split(then)[2:-2] == UNIT
    assert run(shlex.split(then.replace("FILE", str(tmp_path / "blows.npy")))) == 0


UNIT = ["--rate", "25600", "--unit", "m/s^2"]


# -- what is counted ---------------------------------------------------------------------------------------


def recorded(rows: Rows, digest: str = "other", *, n_channels: int = 1, n_groups: int = 1) -> Rows:
    """Return impacts as of recordings, each heard by some channels within a millisecond."""
    n = len(rows.labels)
    twice = np.repeat(np.arange(n), n_channels)
    return replace(
        rows,
        features=rows.features[twice],
        labels=rows.labels[twice],
        group=(np.arange(n) * n_groups // n)[twice],
        source=rows.source[:1].repeat(n * n_channels),
        groups=tuple(map(str, range(n_groups))),
        file=(np.arange(n) * n_groups // n)[twice],
        digests=tuple(f"{digest}{k}" for k in range(n_groups)),
        time=(np.arange(n) % (n // n_groups))[twice] + 1e-3 * np.tile(np.arange(n_channels), n),
        channel=np.tile(np.arange(n_channels), n).astype(str),
    )


def test_a_rock_that_two_channels_heard_counts_once(model: StoredModel) -> None:
    one, two = (correct(model, recorded(impacts(40, 7), n_channels=n)) for n in (1, 2))
    assert [one.model.training["correction"][name] for name in ("n", "n_rocks")] == [40, 40]
    assert [two.model.training["correction"][name] for name in ("n", "n_rocks")] == [80, 40]
    # A few impacts say less of the levels than the training.
    assert two.model.level_range == model.level_range and two.model.level_deviation > 0
    # The other channel says the same: no further evidence.
    share = two.after["accuracy"]
    assert two.after["accuracy_interval_95"] == pytest.approx(wilson_interval(share, 40), abs=0.02)
    assert two.after["accuracy_interval_95"] != pytest.approx(wilson_interval(share, 80), abs=0.02)
    # Channels of one beam are one in what the corrected model is asked, too.
    joint = correct(model, replace(recorded(impacts(40, 7)), same_beam=("1+2",)))
    assert joint.model.same_beam == ("1+2",) and one.model.same_beam == ()


def test_recordings_of_several_days_are_the_trials(model: StoredModel) -> None:
    """As `train` does: with few groups the interval is that of groups, and a line says that they are few."""
    days = correct(model, recorded(impacts(60, 7), n_groups=3))
    low, high = days.after["accuracy_interval_95"]
    rows = recorded(impacts(60, 7), n_groups=3)
    hits = np.array(model.labels)[np.argmax(days.probabilities, axis=1)] == days.labels
    assert (low, high) == clustered_interval(hits, rows.group)
    assert any("3 groups of recordings" in line for line in days.warnings)
    (of_one_file,) = warnings_of_few(replace(rows, file=np.zeros_like(rows.file)))
    assert "3 groups within one recording" in of_one_file


def test_impacts_that_trained_the_model_are_left_out(model: StoredModel) -> None:
    taught = replace(model, training={**model.training, "sources": ["mine0", "mine1"]})
    with pytest.raises(BadData, match="10 at least that did not train the model, got 0 of 40"):
        correct(taught, recorded(impacts(40, 7), "mine", n_groups=2))
    own, others = recorded(impacts(40, 7), "mine", n_groups=2), recorded(impacts(30, 8))
    both = replace(
        Rows.joined([own, others]),
        file=np.append(own.file, 2 + others.file),
        channel=np.append(own.channel, others.channel),
        digests=(*own.digests, *others.digests),
    )
    found = correct(taught, both)
    assert found.model.training["correction"]["n"] == 30
    assert found.model.training["correction"]["sources"] == ["other0"]
    np.testing.assert_array_equal(found.probabilities, correct(model, others).probabilities)
    assert found.warnings[0].startswith("40 of 70 labelled impacts are left out")
    # Nor do those that corrected it before.
    with pytest.raises(BadData, match="did not train the model, got 0 of 30"):
        correct(found.model, others)
    # What the file does not state, nobody claims.
    assert correct(replace(model, training={"sources": "mine0"}), own).model.training["correction"]["n"] == 40


def test_labels_are_those_of_the_model_in_any_case(model: StoredModel) -> None:
    rows = impacts(40, 7)
    shouted = replace(rows, labels=np.char.upper(rows.labels))
    assert correct(model, shouted).model.to_bytes() == correct(model, rows).model.to_bytes()


def test_a_training_takes_two_spellings_as_one_label() -> None:
    rows = impacts(400, 2)
    spelled = np.where(np.arange(400) % 9 == 0, np.char.capitalize(rows.labels), rows.labels)
    with pytest.warns(UserWarning, match="are one label"):
        mixed = train_on_specimens(replace(rows, labels=spelled), features=NAMES)
    assert mixed.model.to_bytes() == train_on_specimens(rows, features=NAMES).model.to_bytes()
