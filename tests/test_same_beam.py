"""Channels of one beam: one rock, one row, one decision."""

from __future__ import annotations

import csv
import io
import json
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from cgid import load_model, open_recording, predict, read_recording, shipped
from cgid.cli.hints import NextSteps
from cgid.cli.main import cli
from cgid.errors import InvalidValue
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import Answer, identify_recording
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.same_beam import (
    CROSSING,
    Detected,
    RockAssigner,
    Together,
    agreeing,
    answering_channels,
    fused,
    grouped,
    joined,
    mean_of_log_odds,
    rows_of,
)
from cgid.identification.prediction.settings import PredictionSettings, require_groups
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.telling import of_model
from cgid.measure.features.vibration import BEAM_PULSE
from cgid.scene import load_scene
from cgid.scene.synthesis.several_sensors import recorded_together
from cgid.scene.synthesis.through_beam import beam_of, moved
from tests.streams_of_pulses import RATE as PULSE_RATE
from tests.streams_of_pulses import stream, window_model

RATE = 25_600.0


def covariances(n: int, seed: int) -> np.ndarray:
    """Random covariances of deviations from .001 to 1."""
    rng = np.random.default_rng(seed)
    mixes = rng.normal(size=(n, 3, 5))
    own = mixes @ mixes.swapaxes(1, 2)
    own /= np.sqrt(np.einsum("nii,njj->nij", own, own))
    deviation = 10 ** rng.uniform(-3, 0, (n, 3))
    return own * deviation[:, :, None] * deviation[:, None]


def pulses(means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    deviation = np.sqrt(np.einsum("nii->ni", covariance))
    correlation = covariance / (deviation[:, :, None] * deviation[:, None])
    return np.hstack([np.exp(means), deviation, correlation[:, [0, 0, 1], [1, 2, 2]]])


# -- closed forms -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 3, 5])
def test_fused_pulses_are_the_product_of_gaussians(n: int) -> None:
    """Of one shape and several sizes: the generalised least squares of all measurements, by numpy's own solver."""
    rng = np.random.default_rng(n)
    means, covariance = rng.normal(size=(n, 3)), covariances(1, n) * 10 ** rng.uniform(-2, 2, (n, 1, 1))
    found = fused(pulses(means, covariance))
    whole = np.zeros((3 * n, 3 * n))
    for k in range(n):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = covariance[k]
    design = np.tile(np.eye(3), (n, 1))
    root = np.linalg.cholesky(whole)
    mean, *_ = np.linalg.lstsq(np.linalg.solve(root, design), np.linalg.solve(root, means.ravel()), rcond=None)
    expected = np.linalg.inv(design.T @ np.linalg.solve(whole, design))
    np.testing.assert_allclose(np.log(found[:3]), mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found, pulses(mean[None], expected[None])[0], rtol=1e-7, atol=1e-8)


def test_the_deviation_is_that_of_the_weighted_mean() -> None:
    """Of any covariances, in many draws."""
    covariance, rng = covariances(3, 7), np.random.default_rng(8)
    at = [rng.multivariate_normal(np.zeros(3), one, 20_000) for one in covariance]
    table = pulses(np.zeros((3, 3)), covariance)
    drawn = [table.copy() for _ in range(20_000)]
    for k, part in enumerate(at):
        for row, value in zip(drawn, part, strict=True):
            row[k, :3] = np.exp(value)
    found = np.log([fused(row)[:3] for row in drawn])
    np.testing.assert_allclose(found.std(axis=0), fused(table)[3:6], rtol=0.02)
    np.testing.assert_allclose(np.corrcoef(found.T)[[0, 0, 1], [1, 2, 2]], fused(table)[6:], atol=0.02)


def test_the_restitution_that_a_channel_measures_is_no_weight() -> None:
    """A high restitution has a small deviation of its logarithm; it must not pull the mean."""
    rng, low, high = np.random.default_rng(0), [], []
    for _ in range(4000):
        restitution = 0.4 + 0.12 * rng.normal(size=2)
        table = np.tile([1.0, 1.0, 0.0, 0.02, 0.02, 0.0, 0.0, 0.0, 0.0], (2, 1))
        table[:, 2] = np.maximum(restitution, 0.05)
        table[:, 5] = 0.12 / table[:, 2]
        low.append(np.log(fused(table)[2]))
        high.append(np.log(table[:, 2]).mean())
    assert np.mean(low) == pytest.approx(np.mean(high), abs=1e-9)


def test_one_pulse_is_itself_and_the_order_does_not_matter() -> None:
    table = pulses(np.random.default_rng(1).normal(size=(4, 3)), covariances(4, 1))
    np.testing.assert_allclose(fused(table[:1]), table[0], rtol=1e-9)
    np.testing.assert_allclose(fused(table[::-1]), fused(table), rtol=1e-9)
    np.testing.assert_allclose(fused(np.repeat(table[:1], 4, axis=0))[3:6], table[0, 3:6] / 2, rtol=1e-9)


def test_other_features_are_averaged_as_the_model_takes_them() -> None:
    """Levels are logarithms already; of a duration the logarithm is averaged, unless it is not above 0."""
    names = ("level_1000_hz", "decay_time")
    np.testing.assert_allclose(joined(np.array([[1.0, 2.0], [3.0, 8.0]]), names), [2.0, 4.0])
    np.testing.assert_allclose(joined(np.array([[1.0, 0.0], [3.0, 8.0]]), names), [2.0, 4.0])


def test_a_pulse_that_disagrees_is_dropped() -> None:
    table = np.tile(np.array([[100.0, 1e-3, 0.4, 0.02, 0.02, 0.1, 0.0, 0.0, 0.0]]), (3, 1))
    table[:, 0] *= [1.0, 1.02, 2.0]
    assert agreeing(table, [0.0, 0.0, 0.0]) == [0, 1]
    assert agreeing(table[[0, 2]], [0.0, 1.0]) == [0]
    assert agreeing(table[[0, 2]], [1.0, 0.0]) == [1]
    table[2, 3] = 1.0  # it says that it does not know
    assert agreeing(table, [0.0, 0.0, 0.0]) == [0, 1, 2]
    assert agreeing(table[:0], []) == []


def test_log_odds_are_averaged_and_never_sharper() -> None:
    first, second = 0.9, 0.6
    odds = np.sqrt(first / (1 - first) * second / (1 - second))
    found = mean_of_log_odds(np.array([[1 - first, first], [1 - second, second]]))
    np.testing.assert_allclose(found, [1 / (1 + odds), odds / (1 + odds)])
    # The geometric mean of these would be certain.
    np.testing.assert_allclose(mean_of_log_odds(np.array([[0.5, 0.5, 0.0], [0.5, 0.0, 0.5]]))[0], 0.5)
    rng = np.random.default_rng(0)
    for table in rng.dirichlet(np.full(4, 0.3), (500, 3)):
        found = mean_of_log_odds(table)
        assert found.sum() == pytest.approx(1)
        assert found.max() <= table.max() + 1e-12


def test_a_sensor_of_several_is_that_of_the_scene_there() -> None:
    scene, points = load_scene("tail_beam"), ((0.5, 0.45), (1.1, 1.0))
    both = beam_of(scene, sensors=points)
    for number, point in enumerate(points):
        alone, expected = both.of_sensor(number), beam_of(moved(scene, point))
        scale = np.abs(expected.participation).max()
        np.testing.assert_allclose(alone.participation, expected.participation, rtol=1e-9, atol=1e-12 * scale)
        np.testing.assert_array_equal(alone.shares, expected.shares)


# -- rocks ------------------------------------------------------------------------------------------------


def onsets(seed: int, n: int = 400) -> list[Detected]:
    """Impacts of rocks that two of four channels measure at other times, and others alone."""
    rng = np.random.default_rng(seed)
    out = []
    for time in np.cumsum(rng.exponential(0.05, n)):
        for channel in rng.permutation(4)[: rng.integers(1, 4)].tolist():
            out.append(Detected(channel, round((time + rng.uniform(0, 3e-3)) * RATE)))
    return sorted(out, key=lambda one: one.onset)


def matched(impacts: Sequence[Detected], groups: Iterable[Sequence[int]]) -> list[list[Detected]]:
    """A slow twin: each impact joins the first rock in time that lacks its channel."""
    rocks: list[list[Detected]] = []
    for impact in impacts:
        group = next(rows for rows in groups if impact.channel in rows)
        for rock in rocks:
            channels = {one.channel for one in rock}
            if channels <= set(group) - {impact.channel} and impact.onset - rock[0].onset <= CROSSING * RATE:
                rock.append(impact)
                break
        else:
            rocks.append([impact])
    return rocks


@pytest.mark.parametrize("groups", [((0, 1), (2, 3)), ((0, 1, 2, 3),), ((0,), (1, 3), (2,))])
def test_rocks_do_not_depend_on_the_blocks(groups: tuple[tuple[int, ...], ...]) -> None:
    impacts = onsets(3)
    expected = matched(impacts, groups)
    rocks, found, rng = RockAssigner[Detected](groups, RATE), [], np.random.default_rng(4)
    first = 0
    while first < len(impacts):
        last = first + int(rng.integers(1, 9))
        known = impacts[last].onset if last < len(impacts) else np.inf
        found += rocks.feed(impacts[first:last], known)
        assert len(rocks._open) <= 40  # those of the last moments
        first = last
    assert found == expected
    assert RockAssigner[Detected](groups, RATE).feed(impacts, np.inf) == expected


def test_channels_of_one_beam_that_are_not_declared_are_told_once() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.exponential(0.1, 5000))
    here, elsewhere = times[::2], times[1::2]
    both = [(0, here), (1, here + rng.uniform(-1e-3, 1e-3, here.size)), (2, elsewhere)]
    impacts = sorted(
        (Detected(row, round(t * RATE)) for row, some in both for t in some.tolist()), key=lambda o: o.onset
    )
    names = ("left", "right", "other")
    single, declared = ((0,), (1,), (2,)), ((0, 1), (2,))
    (found,) = Together(RATE, single).feed(impacts, names, ended=True)
    assert (found.kind, found.channels, found.fields["beam"]) == ("same_beam", ("left", "right"), "left+right")
    counter = Together(RATE, declared)
    assert [line for impact in impacts for line in counter.feed([impact], names, ended=False)] == []
    assert len(counter._recent) < 10
    told = list(Together(RATE, ((0, 2), (1,))).feed(impacts, names, ended=True))
    assert [one.channels for one in told if one.kind == "other_rocks"] == [("left", "other")]


def test_many_channels_of_one_signal_are_one_finding() -> None:
    impacts = [Detected(row, 2000 * k + row) for k in range(1, 40) for row in range(84)]
    for size in (1, 7, len(impacts)):
        together = Together(RATE, [(row,) for row in range(84)])
        parts = [impacts[first : first + size] for first in range(0, len(impacts), size)]
        names = [str(row) for row in range(84)]
        found = [one for part in parts for one in together.feed(part, names, ended=part is parts[-1])]
        assert [len(one.channels) for one in found] == [84]


def test_many_rocks_are_no_reason_to_suspect_one_beam() -> None:
    """At 40 rocks a second, 27 % of the impacts of independent channels coincide."""
    rng = np.random.default_rng(1)
    impacts = [
        Detected(row, round(t * RATE)) for row in range(2) for t in np.cumsum(rng.exponential(1 / 40, 20_000)).tolist()
    ]
    assert list(Together(RATE, ((0,), (1,))).feed(sorted(impacts, key=lambda one: one.onset), "ab", ended=True)) == []


# -- streams ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model() -> StoredModel:
    return load_model("default-acceleration")


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    """Sixty impacts on a beam [m/s^2]."""
    (signal,) = read_recording(shipped.path_of("datasets", shipped.ACCELERATION_SAMPLE))
    tiled = np.tile(signal.samples, 10)
    return tiled + np.random.default_rng(0).normal(0, 0.3, tiled.size)


def again(samples: np.ndarray, seed: int = 1) -> np.ndarray:
    """The same impacts as another sensor of the same place has them, with more noise of its own."""
    return samples + np.random.default_rng(seed).normal(0, 2.0, samples.size)


def told(
    blocks: np.ndarray, model: StoredModel, *same_beam: str, length: int = 1 << 14, rate: float = RATE, **fields: object
) -> tuple[list[Answer], list[str]]:
    """Answers for channels, and the warnings."""
    settings = PredictionSettings(same_beam=require_groups(same_beam), **fields)  # type: ignore[arg-type]
    channels = [str(number) for number in range(1, len(blocks) + 1)]
    answers, lines, until = [], [], 0.0
    parts = (blocks[:, first : first + length] for first in range(0, blocks.shape[1], length))
    for step in identify_blocks(parts, rate, model, channels, settings):
        # All answers before `until` have arrived, in order.
        assert all(until <= answer.time for answer in step.answers)
        until = step.until
        answers += step.answers
        lines += [one.line("signal", len(channels)) for one in step.found if not one.is_silent]
    assert [one.time for one in answers] == sorted(one.time for one in answers)
    return answers, lines


def rows(answers: Iterable[Answer]) -> list[tuple[object, ...]]:
    return [(one.time, one.end, one.label, tuple(one.probabilities.values()), one.novelty) for one in answers]


def alike(some: Sequence[Answer], others: Sequence[Answer]) -> None:
    """Equal within the search of an impact, in another batch or on another processor; and another channel's onset."""
    # A search ends within 1e-3 of the evidence of an optimum. Of two optima of nearly the same evidence, the rounding
    # decides: of 1,068 impacts in batches or one by one, with three kinds of OPENBLAS_CORETYPE, .7 % differ by more
    # than 1e-3, 3.4 % of one recording, some by .1.
    assert len(some) == len(others)
    np.testing.assert_allclose([one.time for one in some], [one.time for one in others], atol=1e-3)
    probabilities = [np.array([list(one.probabilities.values()) for one in answers]) for answers in (some, others)]
    differ = np.abs(np.subtract(*probabilities)).max(axis=1) > 1e-3
    assert np.mean(differ) < 0.1
    labels = [np.array([one.label for one in answers])[~differ] for answers in (some, others)]
    assert np.mean(labels[0] != labels[1]) < 0.1  # an impact may be at the limit


def test_a_missing_channel_changes_no_bit(model: StoredModel, samples: np.ndarray) -> None:
    alone, _ = told(samples[None], model)
    for missing in (np.full_like(samples, np.nan), np.zeros_like(samples)):
        both, lines = told(np.stack([samples, missing]), model, "1+2")
        assert rows(both) == rows(alone)
        assert {one.channel for one in both} == {"1+2"}
        (line,) = lines
        assert f"channel 2: since {alone[19].time:.6g} s: it is left out of 1+2: " in line


def test_two_sensors_are_one_row_and_surer(model: StoredModel, samples: np.ndarray) -> None:
    two = np.stack([samples, again(samples), samples[::-1]])
    single, lines = told(two[:2], model)
    assert len(single) == 120
    assert len(lines) == 1
    assert lines[0].endswith("give same_beam=[('1', '2')]")
    grouped_answers, lines = told(two, model, "1+2")
    both = [one for one in grouped_answers if one.channel == "1+2"]
    assert len(both) == 60
    assert lines == []
    alike([one for one in grouped_answers if one.channel == "3"], told(two[2:], model)[0])
    in_small_blocks, _ = told(two, model, "1+2", length=500, batch=1)
    assert [one.channel for one in in_small_blocks] == [one.channel for one in grouped_answers]
    alike(in_small_blocks, grouped_answers)
    turned, _ = told(two[:2], model, "2+1")
    assert {one.channel for one in turned} == {"2+1"}
    alike(turned, both)


def test_a_wrong_gain_is_left_out_and_told_when_it_ends(model: StoredModel, samples: np.ndarray) -> None:
    alone, _ = told(samples[None], model)
    wrong = again(samples)
    wrong[: samples.size // 2] *= 9.81
    both, lines = told(np.stack([samples, wrong]), model, "1+2")
    alike(both[:25], alone[:25])
    left_out, back = lines
    assert "channel 2: since " in left_out and "it is left out of 1+2" in left_out
    assert "channel 2: it counts again at " in back


def test_forces_have_the_mean_of_log_odds(default_force: StoredModel) -> None:
    force = stream(["coal", "gangue"] * 6, 0.05)
    other = 0.8 * stream(["coal", "gangue"] * 6, 0.05, noise=60.0)
    single = [told(one[None], default_force, rate=PULSE_RATE)[0] for one in (force, other)]
    both, _ = told(np.stack([force, other]), default_force, "1+2", rate=PULSE_RATE)
    assert len(both) == 12
    for one, first, second in zip(both, *single, strict=True):
        odds = [np.log(p.probabilities["gangue"] / p.probabilities["coal"]) for p in (first, second)]
        found = one.probabilities["gangue"] / one.probabilities["coal"]
        assert first.novelty <= 1
        assert second.novelty <= 1
        assert np.log(found) == pytest.approx(np.mean(odds), abs=1e-6)
        assert one.probability <= max(first.probability, second.probability)


@pytest.fixture(scope="module")
def default_force() -> StoredModel:
    return load_model("default")


def test_windows_of_one_beam_are_one_answer() -> None:
    model, rng = window_model(), np.random.default_rng(2)
    blocks = np.stack([rng.normal(size=8000), np.cumsum(rng.normal(size=8000))])
    single, _ = told(blocks, model, rate=8000.0, vote_time=0.0)
    both, _ = told(blocks, model, "1+2", rate=8000.0, vote_time=0.0)
    assert len(single) == 2 * len(both)
    for one, *own in zip(both, single[::2], single[1::2], strict=True):
        logs = np.mean([np.log(list(part.probabilities.values())) for part in own], axis=0)
        expected = np.exp(logs) / np.exp(logs).sum()
        np.testing.assert_allclose(list(one.probabilities.values()), expected, rtol=1e-9)
        assert one.channel == "1+2"


def test_python_and_recordings_take_groups(model: StoredModel, samples: np.ndarray, tmp_path: Path) -> None:
    two = np.stack([samples, again(samples)], axis=1)[: samples.size // 5]
    table = predict(two, RATE, "m/s^2", same_beam="1+2")
    assert set(table["channel"]) == {"1+2"}
    with pytest.warns(UserWarning, match="give same_beam="):
        predict(np.tile(two, (3, 1)), RATE, "m/s^2")
    np.save(tmp_path / "two.npy", two)
    recording = open_recording(tmp_path / "two.npy", sampling_rate=RATE, unit="m/s^2")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = list(identify_recording(recording, model, PredictionSettings(same_beam=(("1", "2"),))))
    np.testing.assert_allclose([one.time for one in found], table["time_s"])


# -- groups -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("groups", "says"),
    [
        (("1+1",), "each channel once, got 1 twice"),
        (("1+2", "2+3"), "each channel once, got 2 twice"),
        (("1",), "two or more channels"),
        (("1+",), "two or more channels"),
        ("1", "two or more channels"),
        (3, "groups of channels"),
    ],
)
def test_groups_are_checked(groups: object, says: str) -> None:
    with pytest.raises(InvalidValue, match=says):
        PredictionSettings(same_beam=groups)  # type: ignore[arg-type]


def test_groups_name_channels_of_the_recording(model: StoredModel) -> None:
    names = ("left", "right", "3")
    assert grouped(names, (("3", "left"),)) == [(2, 0), (1,)]
    groups = rows_of(model, names, (("1", "right"),))
    assert groups == [(0, 1), (2,)] and answering_channels(groups, names) == ("left+right", "3")
    for group, says in ((("left", "9"), "got 9"), (("left", "1"), "left twice, by name and number")):
        with pytest.raises(InvalidValue, match=says):
            rows_of(model, names, (group,))
    with pytest.raises(InvalidValue, match="uses 2 channels together"):
        rows_of(window_model(2), ("1", "2"), (("1", "2"),))


# -- commands ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pairs(samples: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of two sensors on a beam, and one that hears something else."""
    folder = tmp_path_factory.mktemp("pairs")
    for name, seed in (("monday", 1), ("tuesday", 2)):
        three = np.stack([samples, again(samples, seed), samples[::-1]], axis=1)[: samples.size // 2]
        np.save(folder / f"{name}.npy", three.astype(np.float32))
    return folder


def ran(*arguments: object) -> tuple[str, str]:
    result = CliRunner().invoke(cli, [str(one) for one in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout, result.stderr


READ = ("--rate", RATE, "--unit", "m/s^2")


def test_predict_counts_a_rock_once(pairs: Path) -> None:
    out, err = ran(
        "predict", pairs / "monday.npy", *READ, "--set", "channels.1.beam=A", "--set", "channels.2.beam=A", "--json"
    )
    lines = [json.loads(line) for line in out.splitlines()]
    impacts = [line for line in lines if line["kind"] == "impact"]
    assert {line["channel"] for line in impacts} == {"1+2", "3"}
    assert sum(line["channel"] == "1+2" for line in impacts) == 30
    assert {line["channel"] for line in lines if line["kind"] == "share"} == {"1+2", "3"}
    assert "hear" not in err
    _, err = ran("predict", pairs / "monday.npy", *READ)
    assert "channels 1, 2: they hear the same rocks" in err and "give --same-beam 1+2" in err
    result = CliRunner().invoke(cli, ["predict", str(pairs / "monday.npy"), *map(str, READ), "--channel", "1+2"])
    assert "give --same-beam 1+2 if they are on one beam" in result.stderr


def test_info_counts_a_rock_once(pairs: Path) -> None:
    out, _ = ran(
        "info", pairs / "monday.npy", *READ, "--set", "channels.1.beam=A", "--set", "channels.2.beam=A", "--json"
    )
    described = json.loads(out)
    assert described["channel 1"]["impacts"] == described["channel 2"]["impacts"] == 30
    assert described["channels 1+2"] == {"impacts": 30}


def test_a_table_of_rocks_trains_a_model(pairs: Path) -> None:
    """Half of the rows of separate channels, since a label counts once; joined name and option say the same."""
    table = pairs / "events.csv"
    ran("events", pairs / "monday.npy", pairs / "tuesday.npy", *READ, "--same-beam", "1+2", "-o", table)
    found = list(csv.DictReader(io.StringIO(table.read_text())))
    assert {(row["channel"], row["same_beam"]) for row in found} == {("1+2", "1+2"), ("3", "")}
    both = [row for row in found if row["channel"] == "1+2"]
    assert len(both) == 60
    for number, row in enumerate(both):
        row["label"] = ("coal", "gangue")[number % 2]
    columns = [name for name in found[0] if name != "same_beam"]
    counts = {}
    for name, dropped, options in (
        ("column", (), ()),
        ("option", ("same_beam",), ("--same-beam", "1+2")),
        ("apart", ("same_beam", "channel"), ()),
    ):
        path = pairs / f"{name}.csv"
        with path.open("w", newline="") as file:
            kept = [one for one in (*columns, "same_beam") if one not in dropped]
            writer = csv.DictWriter(file, kept, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(both)
        _, err = ran("train", path, "--by", "impact", *options, "-o", path.with_suffix(".npz"))
        own = StoredModel.load(path.with_suffix(".npz"))
        counts[name] = own.training["n_train"]
        assert own.same_beam == (() if name == "apart" else ("1+2",))
        assert err.rstrip().endswith(".npz" if name == "apart" else ".npz --same-beam 1+2")
    assert "| channels of one beam | 1+2;" in (pairs / "column.md").read_text()
    assert counts["column"] == counts["option"] == 60
    assert counts["apart"] == 120
    out, _ = ran("predict", pairs / "monday.npy", *READ, "--same-beam", "1+2", "--model", pairs / "column.npz")
    answers = list(csv.DictReader(io.StringIO(out)))
    assert sum(row["channel"] == "1+2" for row in answers) == 30
    assert sum(row["label"] != "unknown" for row in answers if row["channel"] == "1+2") >= 27
    for name, more, is_told in (("column", (), True), ("apart", (), False), ("column", ("--same-beam", "1+2"), False)):
        _, err = ran("predict", pairs / "monday.npy", *READ, *more, "--model", pairs / f"{name}.npz")
        assert ("trained with channels of one beam together; give --same-beam 1+2" in err) is is_told


def test_commands_name_the_channels_of_one_beam(default_force: StoredModel) -> None:
    """As given; or as in the training, where nobody has said so."""
    beams = replace(default_force, training={**default_force.training, "same_beam": ["1+2"]})
    unlike = Answer(time=0.0, channel="1", label="unknown", novelty=9.0, probabilities={"coal": 1.0})
    for own, given, channels, first in (
        (default_force, [], ["1", "2"], "cgid events x.wav --unit N --channel {} -o events.csv"),
        (default_force, ["--same-beam", "1+2"], ["1+2"], "cgid events x.wav --unit N --same-beam 1+2 -o events.csv"),
        (beams, ["--same-beam", "1+2"], ["1+2"], "cgid events x.wav --unit N --same-beam 1+2 -o events.csv"),
    ):
        diagnosis = Diagnosis(own, 200e3)
        diagnosis.add([replace(unlike, time=float(k), channel=name) for k in range(30) for name in channels])
        steps = NextSteps(diagnosis, 200e3, "x.wav", ["--unit", "N"], given, channels=["1", "2"])
        for hint in map(steps.of, diagnosis.findings()):
            assert (hint.kind, hint.commands[0]) == ("unknown", first.format(*hint.channels))
            assert ("--same-beam 1+2" in hint.commands[-1]) is bool(given)
            assert ("--channel" in hint.commands[-1]) is False
    (found,) = (one for one in of_model(beams, 200e3, PredictionSettings(), ["1", "2"]) if one.kind == "together")
    hint = NextSteps(Diagnosis(beams, 200e3), 200e3, "x.wav", ["--unit", "N"], channels=["1", "2"]).of(found)
    assert hint.commands == ("cgid predict x.wav --unit N --same-beam 1+2",)


def test_pulse_names_are_those_of_the_model(model: StoredModel) -> None:
    assert set(BEAM_PULSE) <= set(model.measured)


def test_a_model_knows_the_place_of_each_sensor(tmp_path: Path) -> None:
    """Each channel is inverted behind its own sensor; in the other order neither fits."""
    points, path = ((0.5, 0.45), (1.1, 1.0)), tmp_path / "two.npz"
    sensors = [word for point in points for word in ("--sensor", "{},{}".format(*point))]
    ran("train", "tail_beam", *sensors, "--same-beam", "1+2", "-n", 600, "-o", path)
    model = StoredModel.load(path)
    assert model.together == 2
    (batch,) = recorded_together(load_scene("tail_beam"), points, 40, 77)
    noise = np.random.default_rng(0).normal(0, 2.0, (2, 40, 4096))
    noise[:, :, 1024 : 1024 + batch.signals.shape[2]] += np.moveaxis(batch.signals, 1, 0)
    stream = noise.reshape(2, -1)
    answers, lines = told(stream, model, "1+2")
    assert lines == []
    known = [one for one in answers if one.label != "unknown"]
    assert len(known) >= 0.8 * len(answers) >= 30
    swapped, lines = told(stream[::-1], model, "1+2")
    assert sum(one.label == "unknown" for one in swapped) >= 0.5 * len(swapped)
    assert len(lines) == 1
    assert "are they swapped?" in lines[0]
    with pytest.raises(InvalidValue, match="groups of 2 channels"):
        rows_of(model, ("1", "2", "3"), (("1", "2", "3"),))
