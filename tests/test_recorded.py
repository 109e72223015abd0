"""Training on recordings: windows, groups that are left out as a whole, mixed training, the command."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal as filters
from scipy import special
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.svm import SVC

from benchmarks.identification.few_groups import PARTS, judged
from benchmarks.identification.low_rates import FORCES, MODES, simulated
from cgid.cli.main import run
from cgid.errors import BadData, CgidError, InvalidValue
from cgid.identification.detection.silence import Silence, silence_of
from cgid.identification.detection.windows import WINDOW_TIME
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.fraction import unproven
from cgid.identification.prediction.vote import RunningVote
from cgid.identification.training import train_on_groups, write_card
from cgid.identification.training.classifier import ImpactClassifier, ShrunkenDiscriminant
from cgid.identification.training.grouped import (
    Candidate,
    TrainingSet,
    cross_validate,
    in_blocks_of_time,
    leave_groups_out,
    vote_correlation,
)
from cgid.identification.training.impact_table import impact_table
from cgid.identification.training.manifest import read_manifest
from cgid.identification.training.recordings import record
from cgid.identification.training.rows import Rows, Slicing, sets_for
from cgid.measure.features.extraction import FEATURES, extract_array, supported
from cgid.measure.spectra import MEL_BANDS
from cgid.recordings import open_recording
from tests import few

RATE = 8000
#: Few, so that training takes no time.
NAMES = ("window_level", "window_kurtosis", "window_centroid", "window_mel_856_hz", "window_zero_crossing_rate")


def flow(label: str, seed: int, seconds: float = 1.0, n_channels: int = 1) -> np.ndarray:
    """Return a second of rustle; the two labels differ in where they sound."""
    noise = np.random.default_rng(seed).normal(size=(n_channels, round(seconds * RATE)))
    band = {"coal": (300, 900), "gangue": (700, 1500)}[label]
    return 0.1 * filters.sosfilt(filters.butter(2, band, "bandpass", fs=RATE, output="sos"), noise)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six recordings of a second, two labels, and manifests of them."""
    path = tmp_path_factory.mktemp("recordings")
    rows = []
    for number in range(6):
        label = ("coal", "gangue")[number % 2]
        np.save(path / f"{number}.npy", flow(label, number))
        rows.append(f"{number}.npy,{label},{RATE},g\n")
    (path / "good.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows))
    (path / "gone.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows) + f"gone.npy,coal,{RATE},g\n")
    (path / "alone.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows) + f"extra.npy,cole,{RATE},g\n")
    (path / "one_group.csv").write_text("path,label,rate_Hz,unit,group\n" + "".join(f"{r.strip()},x\n" for r in rows))
    (path / "one_label.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows[::2]))
    np.save(path / "extra.npy", flow("coal", 99))
    return path


@pytest.fixture(scope="module")
def recorded(folder: Path) -> Rows:
    return record(read_manifest(folder / "good.csv"), NAMES)


# -- windows ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.0, 0.4])
def test_windows_that_are_unknown_do_not_vote_and_correlated_ones_count_as_fewer(correlation: float) -> None:
    probabilities = np.random.default_rng(3).dirichlet(np.ones(3), 40)
    known = np.random.default_rng(4).random(40) < 0.6
    known[10:16] = False
    whole = RunningVote(5, correlation).feed(probabilities, known)
    for row in range(40):
        own = np.arange(max(row - 4, 0), row + 1)[known[max(row - 4, 0) : row + 1]]
        slow = np.prod(probabilities[own], axis=0) ** (1 / (1 + (len(own) - 1) * correlation))
        slow = slow / slow.sum() if len(own) else probabilities[row]
        np.testing.assert_allclose(whole[row], slow, rtol=1e-12)
    vote = RunningVote(5, correlation)
    parts = zip(np.split(probabilities, [1, 12, 13]), np.split(known, [1, 12, 13]), strict=True)
    assert (np.concatenate([vote.feed(*part) for part in parts]) == whole).all()


@pytest.mark.parametrize("shared", few([0.5, 0.0, 1.0]))
def test_votes_of_windows_with_a_common_error_are_calibrated(shared: float) -> None:
    """Log odds z ~ N(+-m, 2 m) are calibrated; n of them that correlate by c add up to sum(z) / (1 + (n - 1) c)."""
    mean, n_windows, n_recordings = 1.2, 20, 3000

    def drawn(seed: int) -> tuple[Rows, np.ndarray]:
        random, second = np.random.default_rng(seed), np.arange(n_recordings) % 2 == 1
        common, own = random.normal(size=(n_recordings, 1)), random.normal(size=(n_recordings, n_windows))
        errors = np.sqrt(2 * mean) * (np.sqrt(shared) * common + np.sqrt(1 - shared) * own)
        odds = np.where(second, mean, -mean)[:, None] + errors
        owner = np.repeat(np.arange(n_recordings), n_windows)
        rows = Rows(
            names=("window_level",),
            features=np.zeros((owner.size, 1)),
            labels=np.where(second, "b", "a")[owner],
            group=owner,
            source=owner,
            slicing=Slicing(by="window"),
        )
        return rows, special.expit(np.stack([-odds, odds], axis=2))

    rows, probabilities = drawn(1)
    correlation = vote_correlation(rows, probabilities.reshape(-1, 2), 0.0)
    assert correlation == pytest.approx(shared, abs=0.05)
    voted = np.stack([RunningVote(9, correlation).feed(own)[8:] for own in drawn(2)[1]])
    right = voted.argmax(axis=2) == (np.arange(n_recordings) % 2)[:, None]
    assert voted.max(axis=2).mean() == pytest.approx(right.mean(), abs=0.03)


# -- from files to rows -----------------------------------------------------------------------------------


def test_models_of_few_recordings_are_sure_of_what_is_right() -> None:
    excesses = np.array([judged(700 + number)[1][PARTS.index(0.5)][0] for number in range(40)])
    assert abs(excesses.mean()) < 0.03 and np.mean(excesses > 0.05) < 0.2


def test_rows_are_those_of_the_windows_of_each_file(folder: Path, recorded: Rows) -> None:
    assert len(recorded.labels) == 6 * 19
    assert recorded.groups == tuple(str(folder / f"{number}.npy") for number in range(6))
    samples = np.load(folder / "3.npy")[0]
    own = recorded.source == 3
    np.testing.assert_allclose(recorded.time[own], 0.05 * np.arange(19), atol=1e-12)
    alone = extract_array(np.stack([samples[400 * k : 400 * k + 800] for k in range(19)]), RATE, NAMES)
    np.testing.assert_array_equal(recorded.features[own], alone)
    assert set(recorded.labels[own]) == {"gangue"}


def test_windows_lie_in_their_intervals_as_a_whole(folder: Path, tmp_path: Path) -> None:
    text = (
        f"path,label,start_s,end_s,rate_Hz,unit\n{folder}/0.npy,a,0.13,0.4,{RATE},g\n{folder}/0.npy,b,0.55,,{RATE},g\n"
    )
    (tmp_path / "m.csv").write_text(text)
    rows = record(read_manifest(tmp_path / "m.csv"), NAMES)
    samples = np.load(folder / "0.npy")[0]
    starts = [0.13, 0.18, 0.23, 0.28, *np.arange(0.55, 0.901, 0.05)]
    np.testing.assert_allclose(rows.time, starts, atol=1e-9)
    assert rows.labels.tolist() == ["a"] * 4 + ["b"] * 8
    frames = np.stack([samples[round(s * RATE) :][:800] for s in starts])
    np.testing.assert_array_equal(rows.features, extract_array(frames, RATE, NAMES))
    assert rows.groups == (str(folder / "0.npy"),)


def test_channels_that_are_annotated_apart_are_recordings_of_their_own(tmp_path: Path) -> None:
    rows = ["path,label,channel,rate_Hz,unit"]
    for number in range(2):
        both = np.concatenate([flow(label, number) for label in ("coal", "gangue")])
        np.save(tmp_path / f"{number}.npy", both)
        rows += [f"{number}.npy,coal,1,{RATE},g", f"{number}.npy,gangue,2,{RATE},g"]
    (tmp_path / "m.csv").write_text("\n".join(rows))
    found = record(read_manifest(tmp_path / "m.csv"), NAMES)
    assert len(found.sources) == 4
    assert len(found.groups) == 2
    for piece in range(4):
        assert len(set(found.labels[found.source == piece])) == 1
        # A running vote must not go on from one channel to the other.
        assert (np.diff(found.time[found.source == piece]) > 0).all()
    judged = train_on_groups(found).metrics["recordings"]["rows"]
    assert [(row["label"], row["vote"]) for row in judged] == [("coal", "coal"), ("gangue", "gangue")] * 2


def test_a_gap_costs_the_windows_that_lack_samples(folder: Path, tmp_path: Path) -> None:
    text = f"path,label,rate_Hz,unit\n{folder}/0.npy,coal,{RATE},g\nbroken.npy,gangue,{RATE},g\n"
    (tmp_path / "m.csv").write_text(text)

    def recorded(samples: np.ndarray) -> Rows:
        np.save(tmp_path / "broken.npy", samples)
        return record(read_manifest(tmp_path / "m.csv"), NAMES, slicing=Slicing(by="window"))

    samples = np.load(folder / "1.npy")
    whole = recorded(samples)
    assert not whole.warnings
    samples[0, 7000] = np.nan
    rows = recorded(samples)
    assert not rows.failures
    assert "1 gap" in rows.warnings[0]
    hop = whole.time[1] - whole.time[0]
    lacking = (whole.labels == "gangue") & (whole.time <= 7000 / RATE) & (whole.time + WINDOW_TIME > 7000 / RATE)
    assert 1 <= lacking.sum() <= WINDOW_TIME / hop + 1
    assert np.array_equal(rows.features, whole.features[~lacking])
    # Without any reading it adds no row.
    rows = recorded(np.full_like(samples, np.nan))
    assert set(rows.labels) == {"coal"}
    assert "broken.npy" in str(rows.failures[0])


# -- from impacts to labels and back -----------------------------------------------------------------------

FAST = 20e3


def beaten(label_of: list[str], seed: int, gap: float = 0.5) -> np.ndarray:
    """Return two channels (2, n) of blows; gangue rings higher, and the second channel hears it later and softer."""
    generator, times = np.random.default_rng(seed), np.arange(0, 0.12, 1 / FAST)
    samples = generator.normal(0, 1e-3, (2, round((len(label_of) * gap + 0.5) * FAST)))
    for number, label in enumerate(label_of):
        middle = {"coal": 900.0, "gangue": 1300.0}[label] * np.exp(generator.normal(0, 0.05))
        blow = np.exp(generator.normal(0, 0.5) - times / 8e-3) * np.sin(2 * np.pi * middle * times)
        for channel, (late, loud) in enumerate([(0, 1.0), (17, 0.4)]):
            first = round((number + 0.6) * gap * FAST) + late
            samples[channel, first : first + times.size] += loud * blow
    return samples


def rows_in(table: Path) -> list[dict[str, str]]:
    with table.open(newline="", encoding="utf-8-sig") as file:
        return list(csv.DictReader(file))


def labelled(table: Path, label_of: dict[str, list[str]]) -> None:
    """Fill in the labels of a table of impacts, as a user does."""
    rows = rows_in(table)
    left = {name: iter(labels) for name, labels in label_of.items()}
    for row in rows:
        row["label"] = next(left[row["path"]])
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture(scope="module")
def blows(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[str]]]:
    """Three recordings of twelve blows on two channels, and their labels."""
    path, generator = tmp_path_factory.mktemp("blows"), np.random.default_rng(30)
    label_of = {f"{k}.npy": generator.permutation(["coal", "gangue"] * 6).tolist() for k in range(3)}
    for number, (name, labels) in enumerate(label_of.items()):
        np.save(path / name, beaten(labels, number))
    return path, label_of


READ = ["--rate", str(FAST), "--unit", "g"]


def test_impacts_are_found_labelled_and_trained_on(
    blows: tuple[Path, dict[str, list[str]]], tmp_path: Path, capsys: Any
) -> None:
    folder, label_of = blows
    table, model = folder / "found.csv", tmp_path / "mine.npz"
    files = [str(folder / name) for name in label_of]
    # Named twice, a recording has its impacts once.
    assert run(["events", files[0], *files, "-o", str(table), *READ, "--overwrite"]) == 0
    assert f"wrote {table}: 36 impacts" in capsys.readouterr().err
    empty = table.read_text()
    labelled(table, label_of)
    before = table.read_bytes()
    assert run(["events", *files, "-o", str(table), *READ]) == 73
    assert table.read_bytes() == before
    rows = record(read_manifest(table))
    assert rows.slicing is not None and rows.slicing.by == "impact"
    # Each blow is a row on both channels, with one label and one group, and no other one is in its interval.
    assert (np.bincount(rows.source) == 2).all() and rows.source.max() == 35
    assert rows.n_channels == 1
    for source in range(36):
        own = rows.source == source
        assert len(set(rows.labels[own])) == len(set(rows.group[own])) == 1
        assert np.ptp(rows.time[own]) < 2e-3
    assert rows.labels[np.unique(rows.source, return_index=True)[1]].tolist() == [*chain(*label_of.values())]
    capsys.readouterr()
    assert run(["train", str(table), "-o", str(model), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["accuracy"] > 0.9
    assert "cgid: trained on impacts, because 36 of 36 recordings or intervals contain a single impact" in err
    assert "recordings" not in json.loads(out)
    # A folder is the recordings in it, and the table on the standard output is the same but for its paths.
    assert run(["events", str(folder), "-o", "-", *READ]) == 0
    assert [line.split(",")[1:] for line in capsys.readouterr().out.splitlines()] == [
        line.split(",")[1:] for line in empty.splitlines()
    ]


def rung(rate: float, label: str, seed: int, unit: str, seconds: float = 4.0) -> np.ndarray:
    """Return eight blows: half sines of force, or what ten modes of a structure make of them."""
    if unit == "m/s^2":
        return simulated(np.random.default_rng(seed), rate, FORCES[label], np.linspace(0.5, 1, MODES.size))
    rng, times = np.random.default_rng(seed), np.arange(round(seconds * rate)) / rate
    out = 0.3 * rng.standard_normal(times.size)
    for onset in np.arange(0.2, seconds - 0.2, 0.45) + rng.uniform(0, 0.2):
        length, since = FORCES[label] * np.exp(0.35 * rng.standard_normal()), times - onset
        out += rng.uniform(10, 40) * np.where((since > 0) & (since < length), np.sin(np.pi * since / length), 0)
    return out


def written_at(folder: Path, rates: Sequence[float], unit: str) -> list[str]:
    """Write six recordings of each label, the rates in turn, and return their paths."""
    for label in FORCES:
        for number in range(6):
            rate = rates[number % len(rates)]
            samples = rung(rate, label, number + 100 * (label == "gangue"), unit)
            header = f"# sampling_rate: {rate:g} Hz\nx ({unit})"
            np.savetxt(folder / f"{label}{number}.csv", samples, "%.4f", header=header, comments="")
    return sorted(map(str, folder.glob("*.csv")))


@pytest.mark.parametrize(
    ("rates", "unit"),
    few(
        [
            ((250,), "m/s^2"),
            ((500,), "m/s^2"),
            ((1000, 2000), "m/s^2"),
            ((1660,), "m/s^2"),
            ((25_600,), "m/s^2"),
            ((1000, 5000), "N"),
            ((5000,), "N"),
        ]
    ),
)
def test_what_events_writes_trains_at_any_rate(
    rates: tuple[float, ...], unit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, table = written_at(tmp_path, rates, unit), tmp_path / "found.csv"
    assert run(["events", *files, "-o", str(table)]) == 0
    rows = rows_in(table)
    labelled(table, {name: [name.rstrip("0123456789.csv")] * 20 for name in {row["path"] for row in rows}})
    capsys.readouterr()
    assert run(["train", str(table), "-o", str(tmp_path / "mine.npz")]) == 0
    said = capsys.readouterr().err
    assert f"trained on impacts, because {len(rows)} of {len(rows)} recordings or intervals contain a single" in said
    # Each row that a person labelled is in the model.
    trained = record(read_manifest(table))
    assert set(trained.source) == set(range(len(rows)))
    assert run(["predict", *files[::6], "--model", str(tmp_path / "mine.npz")]) == 0


@pytest.mark.parametrize(
    ("rate", "unit", "words"),
    [
        (249, "m/s^2", "must be sampled at 250 Hz at least to have a feature, got 249 Hz"),
        (100, "N", "impacts must be long and clear enough to be measured at 100 Hz"),
    ],
)
def test_impacts_that_no_model_could_be_trained_on_are_refused_before_they_are_labelled(
    rate: float, unit: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = written_at(tmp_path, [rate], unit)
    assert run(["events", *[file for file in files if "gangue" in file], "-o", str(tmp_path / "found.csv")]) == 65
    assert words in capsys.readouterr().err and not (tmp_path / "found.csv").exists()


@pytest.mark.parametrize("by", ["window", "impact"])
def test_no_samples_are_in_two_blocks_of_time(by: Any) -> None:
    time = np.sort(np.random.default_rng(3).uniform(0, 30, 600))
    rows = rows_of(np.where(time % 2 < 1, "a", "b"), np.zeros(600, int), time[:, None])
    slicing = Slicing(by=by, window_time=0.2, hop_time=0.1)
    found = in_blocks_of_time(replace(rows, time=time, slicing=slicing))
    assert len(found.groups) == len(np.unique(found.group)) == 8
    length = 0.2 if by == "window" else 0.15
    for before in range(7):
        ends, begins = found.time[found.group == before].max(), found.time[found.group == before + 1].min()
        assert ends + length < begins
    assert len(found.labels) > 500
    rare = replace(rows, labels=np.where(time > 27, "b", "a"), time=time, slicing=slicing)
    assert len(np.unique(in_blocks_of_time(rare).group[in_blocks_of_time(rare).labels == "b"])) >= 2
    last = replace(rows, labels=np.where(time > time[-2], "b", "a"), time=time, slicing=slicing)
    with pytest.raises(BadData, match="at least 2 groups"):
        train_on_groups(replace(last, digests=("x",), groups=("x",)))


@pytest.mark.parametrize("is_of_one", [True, False])
def test_one_recording_says_nothing_of_others_however_well_it_is_known(is_of_one: bool) -> None:
    time = np.linspace(0, 30, 600)
    rows = rows_of(np.where(time % 2 < 1, "coal", "gangue"), np.zeros(600, int), (time % 2)[:, None])
    names = ("monday",) if is_of_one else tuple(map(str, range(12)))
    group = np.arange(600) * len(names) // 600
    more = {"time": time, "source": group, "group": group, "sources": names, "groups": names}
    rows = replace(rows, unit="m/s^2", sampling_rates=(25_600.0, 25_600.0), digests=names, **more)
    model = train_on_groups(rows, features=rows.names).model
    assert model.training["metrics"]["accuracy"] > 0.9
    assert ("all from one recording" in unproven(model, ("gangue",))) is is_of_one
    assert bool(unproven(model, ("gangue",))) is is_of_one


@pytest.mark.parametrize(
    ("gap", "noise", "by"), [(0.5, 0.0, "impact"), (0.06, 0.0, "window"), (0.5, 0.3, "window"), (0.0, 0.1, "window")]
)
def test_recordings_say_whether_impacts_or_windows(gap: float, noise: float, by: str, tmp_path: Path) -> None:
    """Silence between blows: impacts. Dense blows, loud rustle between them, nothing but rustle: windows."""
    for number, label in enumerate(["coal", "gangue"]):
        samples = beaten([label] * round(4 / gap), number, gap) if gap else np.zeros((2, 80_000))
        rustle = np.random.default_rng(number).normal(0, 1, samples.shape)
        np.save(tmp_path / f"{number}.npy", samples + noise * rustle)
    text = "path,label,rate_Hz,unit\n0.npy,coal,20000,g\n1.npy,gangue,20000,g\n"
    (tmp_path / "m.csv").write_text(text)
    rows = record(read_manifest(tmp_path / "m.csv"))
    assert rows.slicing is not None and rows.slicing.by == by
    assert (
        rows.notes[0].startswith(f"trained on {by}s")
        and f"by={'impact' if by == 'window' else 'window'!r}" in rows.notes[0]
    )
    forced = record(read_manifest(tmp_path / "m.csv"), slicing=Slicing(by="window"))
    assert any("most windows contain no impact" in warning for warning in forced.warnings) == (by == "impact")


def test_real_recordings_are_taken_for_what_they_are(real_data: Path) -> None:
    """Bulk on a ramp never rests; shocks are one impact a recording."""
    for files, unit, single in (("bulk_ramp/*_1.wav", None, False), ("shock/acc_base_*.txt", "g", True)):
        held = Silence()
        for file in sorted(real_data.glob(files)):
            held += silence_of(open_recording(file, unit=unit), "vibration", [(0.0, np.inf)])
        assert held.has_single_impacts == single


# -- groups -----------------------------------------------------------------------------------------------


def rows_of(labels: np.ndarray, group: np.ndarray, features: np.ndarray) -> Rows:
    names = tuple(f"window_mel_{centre:.0f}_hz" for centre in MEL_BANDS.centres[: features.shape[1]])
    return Rows(names=names, features=features, labels=labels, group=group, source=group, slicing=Slicing(by="window"))


def lesson_of(rows: Rows, candidates: list[Candidate]) -> TrainingSet:
    return TrainingSet(rows=rows, candidates=candidates, weights=None, seed=0)


def test_each_group_is_left_out_once_and_as_a_whole() -> None:
    generator = np.random.default_rng(0)
    for n_groups in (7, 33):
        group = generator.integers(0, n_groups, 400)
        labels = np.where(group % 2, "a", "b")
        folds = list(leave_groups_out(labels, group, 0))
        assert len(folds) == min(n_groups, 20)
        assert (np.sum(folds, axis=0) == 1).all()
        for fold in folds:
            assert not np.intersect1d(group[fold], group[~fold]).size


def test_what_judges_has_no_part_in_what_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """No classifier that answers for a group, or that helps to choose for it, has seen a row of it."""
    generator, group = np.random.default_rng(7), np.repeat(np.arange(6), 10)
    labels = np.where(group % 2, "a", "b")
    rows = rows_of(labels, group, np.column_stack([group, generator.normal(size=60) + group % 2]).astype(float))
    seen: list[set[int]] = []
    fit = ImpactClassifier.fit

    def watched(self: ImpactClassifier, X: Any, y: Any) -> ImpactClassifier:
        seen.append(set(X[:, 0].astype(int).tolist()))
        return fit(self, X, y)

    monkeypatch.setattr(ImpactClassifier, "fit", watched)
    cross_validate(lesson_of(rows, [Candidate(name=str(k), features=rows.names, family="linear") for k in range(2)]))
    # For each group: two candidates without each of the five others, then the best without the group alone.
    assert len(seen) == 6 * (2 * 5 + 1)
    for one in range(6):
        assert all(one not in groups for groups in seen[11 * one : 11 * (one + 1)])
        assert seen[11 * one + 10] == set(range(6)) - {one}


# -- the linear family ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_features", "n_labels"), [(5, 2), (40, 3), (90, 5)])
def test_discriminant_is_that_of_scikit_learn(n_features: int, n_labels: int) -> None:
    generator = np.random.default_rng(n_features)
    labels = np.arange(200) % n_labels
    rows = generator.normal(size=(200, n_features)) @ generator.normal(size=(n_features, n_features))
    rows += labels[:, None] * generator.normal(size=n_features)
    theirs = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    expected = theirs.fit(rows, labels).decision_function(rows)
    found = ShrunkenDiscriminant().fit(rows, labels)
    np.testing.assert_allclose(found.decision_function(rows), expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(found.covariance_, theirs.covariance_, atol=1e-9 * np.abs(theirs.covariance_).max())


def test_weights_make_up_for_how_often_a_label_comes() -> None:
    """Weighting a label by three is having three of each of its rows."""
    generator = np.random.default_rng(9)
    labels = np.repeat(["coal", "gangue"], [300, 100])
    features = generator.normal(size=(400, 2)) + (labels == "gangue")[:, None]
    thrice = np.repeat(np.arange(400), np.where(labels == "gangue", 3, 1))
    settings = {"linear": (0, 1), "calibration_folds": 0}
    for family in ("logistic", "linear"):
        weighted = ImpactClassifier(family, class_weight={"gangue": 3.0}, **settings)
        weighted.fit(features, labels)
        # The same columns on both sides: the standardiser sees the rows, not their weights.
        repeated = ImpactClassifier(family, **settings)
        repeated.standardiser_ = weighted.standardiser_
        assert np.mean(weighted.predict(features) == "gangue") > np.mean(
            repeated.fit(features, labels).predict(features) == "gangue"
        )
    balanced = ImpactClassifier("linear", class_weight="balanced", **settings).fit(features, labels)
    equal = ImpactClassifier("linear", class_weight={"gangue": 3.0}, **settings).fit(features, labels)
    np.testing.assert_allclose(balanced.predict_proba(features), equal.predict_proba(features), rtol=1e-9)
    counts = np.unique(balanced.predict(features[thrice]), return_counts=True)[1] / len(thrice)
    assert abs(counts[0] - 0.5) < 0.08


# -- training ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(recorded: Rows) -> StoredModel:
    return train_on_groups(recorded, features=NAMES).model


def test_training_says_how_windows_recordings_and_votes_did(recorded: Rows) -> None:
    training = train_on_groups(recorded, features=NAMES)
    metrics, model = training.metrics, training.model
    assert metrics["accuracy"] > 0.8
    assert metrics["recordings"]["n"] == 6
    assert [row["label"] for row in metrics["recordings"]["rows"]] == ["coal", "gangue"] * 3
    half, whole = metrics["running"]
    assert (half["n"], half["n_too_short"], whole["n"]) == (6 * (19 - 8), 0, 6)
    assert half["accuracy"] >= metrics["accuracy"]
    assert (model.kind, model.window_time, model.hop_time, model.n_channels) == ("window", 0.1, 0.05, 1)
    card = write_card(model, "m.npz")
    assert f"{metrics['accuracy']:.4f} (95 % interval" in card
    assert "running vote over 0.5 s" in card
    assert "| 0.npy | coal |" in card
    metrics["recordings"]["rows"][0]["name"] = "<i>|*x"
    assert r"| \<i\>\|\*x | coal |" in write_card(model, "m.npz")


@pytest.mark.long
def test_shuffled_labels_of_recordings_score_at_chance(tmp_path: Path) -> None:
    rows = []
    for number in range(8):
        label = ("coal", "gangue")[number % 2]
        np.save(tmp_path / f"{number}.npy", flow(label, number, 0.5))
        rows.append(f"{number}.npy,{label},{RATE},g\n")
    (tmp_path / "m.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows))
    recorded, random = record(read_manifest(tmp_path / "m.csv"), NAMES), np.random.default_rng(0)
    labels = np.array([("coal", "gangue")[number % 2] for number in range(8)])
    accuracies = [
        train_on_groups(replace(recorded, labels=random.permutation(labels)[recorded.source]), features=NAMES).metrics[
            "accuracy"
        ]
        for _ in range(3)
    ]
    assert np.mean(accuracies) < 0.65


def test_model_of_windows_survives_its_file(model: StoredModel, recorded: Rows, tmp_path: Path) -> None:
    (tmp_path / "m.npz").write_bytes(model.to_bytes())
    loaded = StoredModel.load(tmp_path / "m.npz")
    assert loaded.header == model.header
    np.testing.assert_array_equal(loaded.probabilities(recorded.features), model.probabilities(recorded.features))
    assert (loaded.novelty(recorded.features) < 1.2).all()
    assert loaded.novelty(recorded.features + 1e3).min() > 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"window_time": 0.0}, "must be above 0"),
        ({"hop_time": 1e9}, "hop_time must be between 0.01 of a window and 10 s"),
        ({"hop_time": 1e-9}, "hop_time must be between 0.01 of a window and 10 s"),
        ({"window_time": 1e9}, "window_time must be at most 10 s"),
        ({"n_channels": 2}, "must have shape"),
    ],
)
def test_windows_that_cannot_be_are_refused(change: dict[str, Any], says: str, model: StoredModel) -> None:
    with pytest.raises((BadData, InvalidValue), match=says):
        replace(model, **change)


@pytest.mark.long
def test_two_channels_are_looked_at_together(tmp_path: Path) -> None:
    """Neither channel alone knows the label, both together do: it is whether they are equally loud."""
    generator, rows = np.random.default_rng(11), []
    for number in range(8):
        loudness = np.exp(generator.normal(size=40)).repeat(RATE // 10)
        second = loudness if number % 2 else loudness[::-1]
        samples = generator.normal(size=(2, loudness.size)) * [loudness, second]
        np.save(tmp_path / f"{number}.npy", samples)
        rows.append(f"{number}.npy,{('unlike', 'alike')[number % 2]},{RATE},g\n")
    (tmp_path / "m.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows))
    both = record(read_manifest(tmp_path / "m.csv"), ["window_level"], slicing=Slicing(hop_time=0.1))
    assert both.n_channels == 2
    training = train_on_groups(both, features=["window_level"], family="logistic")
    assert training.metrics["accuracy"] > 0.8
    assert training.model.inputs == ("window_level of channel 1", "window_level of channel 2")
    one = replace(both, features=both.features[:, :1], n_channels=1)
    assert train_on_groups(one, features=["window_level"], family="logistic").metrics["accuracy"] < 0.7


def test_leave_one_recording_out_on_real_bulk(real_data: Path, tmp_path: Path) -> None:
    """The set that comes first, without choosing: choosing takes a minute (`cgid train` does it)."""
    files = sorted((real_data / "bulk_ramp").glob("*.wav"))
    table = "".join(f"{file},{file.stem[:-2]},1\n" for file in files)
    (tmp_path / "m.csv").write_text("path,label,channel\n" + table)
    features = supported(sets_for("window", 44_100.0)["even bands and shape"], 44_100.0, 4410)
    rows = record(read_manifest(tmp_path / "m.csv"), features, slicing=Slicing(hop_time=0.1))
    assert len(rows.groups) == 15
    hits = []
    for fold in leave_groups_out(rows.labels, rows.group, 0):
        linear = tuple(k for k, name in enumerate(rows.names) if FEATURES[name].linear)
        classifier = ImpactClassifier("linear", linear=linear, calibration_folds=0)
        classifier.fit(rows.features[~fold], rows.labels[~fold])
        hits.append(classifier.predict(rows.features[fold]) == rows.labels[fold])
    assert np.concatenate(hits).mean() >= 0.87


# -- few recordings, and noise ----------------------------------------------------------------------------


@pytest.mark.parametrize("n_channels", few([2, 1]))
def test_windows_drowned_in_noise_are_unknown(n_channels: int, tmp_path: Path, capsys: Any) -> None:
    """Bands of a rustle are clear at 30 dB, and drowned where noise is as strong; the model says why."""
    rows = []
    for number in range(6):
        label = ("coal", "gangue")[number % 2]
        np.save(tmp_path / f"{number}.npy", flow(label, number, n_channels=n_channels))
        rows.append(f"{number}.npy,{label},{RATE},g\n")
    (tmp_path / "m.csv").write_text("path,label,rate_Hz,unit\n" + "".join(rows))
    channels = [option for number in range(n_channels) for option in ("--channel", str(number + 1))]
    bands = ",".join(f"window_relative_mel_{centre:.0f}_hz" for centre in MEL_BANDS.centres[2:20])
    arguments = ["train", str(tmp_path / "m.csv"), "-o", str(tmp_path / "m.npz"), "--by", "window", *channels]
    assert run([*arguments, "--features", bands]) == 0
    said = capsys.readouterr()
    assert "for recordings like these" in said.out
    assert "label coal has 3 groups of recordings (days, supports); with fewer than 5" in said.err
    assert (
        "With fewer than 5 groups of a label, expect lower accuracy on another day" in (tmp_path / "m.md").read_text()
    )
    clear, white = flow("coal", 77, 2.0, n_channels), np.random.default_rng(8).normal(size=(n_channels, 2 * RATE))
    for share, is_drowned in ((1e-3, False), (1.0, True)):
        np.save(tmp_path / "new.npy", clear + white * clear.std() * share**0.5)
        predict = ["predict", str(tmp_path / "new.npy"), "--model", str(tmp_path / "m.npz"), "--rate", str(RATE)]
        assert run([*predict, "--unit", "g", "--set", "vote=0", "--json", *channels]) == 0
        said = capsys.readouterr()
        lines = [json.loads(line) for line in said.out.splitlines()]
        windows = [line for line in lines if line["kind"] == "window"]
        assert {line["label"] == "unknown" for line in windows} == {is_drowned}
        found = [line["finding"] for line in lines if line["kind"] == "finding"]
        assert found == ["few_recordings", *["noise"] * is_drowned]


@pytest.mark.long
def test_few_recordings_are_as_sure_as_they_are_right(real_data: Path, tmp_path: Path) -> None:
    """The first two recordings of each material of the ramp teach, the third judges: as it is, and in white noise."""
    from benchmarks.identification.ramp import fold

    files = sorted((real_data / "bulk_ramp").glob("*_[123].wav"))
    for cells in fold(files, "3", 1, 0, tmp_path):
        assert float(cells[5]) <= 0.08
        assert float(cells[6]) >= float(cells[7]) - 0.01
        assert cells[-1] == "5 of 5"


# -- mixed training ---------------------------------------------------------------------------------------


def test_a_manifest_trains_by_its_path_as_by_the_command(tmp_path: Path) -> None:
    table = Path(__file__).parents[1] / "datasets" / "labelled" / "labels.csv"
    assert run(["train", str(table), "-o", str(tmp_path / "m.npz")]) == 0
    training = train_on_groups(table)
    assert training.model == StoredModel.load(tmp_path / "m.npz")
    own = train_on_groups(str(table), features=["peak_amplitude"], family=SVC())
    assert (own.model.family, own.model.features) == ("SVC", ("peak_amplitude",))
    for label in ("coal", "gangue"):
        (tmp_path / "rocks" / label).mkdir(parents=True)
    with pytest.raises(BadData, match="folder must contain recordings"):
        train_on_groups(tmp_path / "rocks")
    (tmp_path / "gone.csv").write_text(f"path,label\n{table.parent / 'monday.wav'},coal\ngone.wav,gangue\n")
    with pytest.raises(CgidError, match=r"gone\.wav"):
        train_on_groups(tmp_path / "gone.csv")


@pytest.mark.parametrize("rate", [300.0, 500.0])
def test_rows_of_a_low_rate_are_as_long_as_what_is_measured(tmp_path, rate):
    """The energy of a vibration has lost 20 dB after .1 s; 175 samples are measured."""
    time = np.arange(round(4 * rate)) / rate
    samples = 1e-3 * np.random.default_rng(1).normal(size=time.size)
    for onset in (0.5, 1.5, 2.5):
        since = np.maximum(time - onset, 0)
        samples += np.exp(-23 * since) * np.sin(2 * np.pi * 40 * since) * (time > onset)
    np.savez(tmp_path / "a.npz", a=samples, fs=rate)
    table = impact_table(open_recording(tmp_path / "a.npz", unit="m/s^2"))
    np.testing.assert_allclose(table["end_s"] - table["time_s"], 3 * [175 / rate], atol=1e-6)
