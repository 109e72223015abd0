"""Streams a model trains on and is finished with: their truth, what the detector finds, and a share that covers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from cgid import shipped
from cgid.calibration.modes import uncertain
from cgid.identification.model.confusion import MIN_SCATTER
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.support import CavingWatch
from cgid.identification.training.rows import BEAM_FEATURES, BEAM_GUARDS, Rows
from cgid.learning import streams
from cgid.learning.streams import StreamRows, finished, rows_of_streams, train_on_streams, variations
from cgid.scene import Scene, load_scene, parse_scene, record
from cgid.scene.synthesis.impacts import beam_modes

NAMES = (*BEAM_FEATURES, *BEAM_GUARDS)


@pytest.fixture(scope="module")
def caving() -> Scene:
    return load_scene(shipped.scene_path("caving"))


@pytest.fixture(scope="module")
def shipped_model() -> StoredModel:
    return StoredModel.load(shipped.path_of("models", shipped.ACCELERATION_MODEL))


@pytest.fixture(scope="module")
def short(caving: Scene, shipped_model: StoredModel) -> tuple[list[Scene], list[StreamRows]]:
    """Return four streams of five seconds, and their measured impacts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streams, "DURATION", 5.0)
        scenes = variations(caving, 4, 7)
    assert shipped_model.beam is not None
    return scenes, rows_of_streams(scenes, 7, NAMES, shipped_model.beam.beam)


def test_variations_fill_the_shares_and_keep_the_rocks(caving: Scene) -> None:
    scenes = variations(caving, 20, 3)
    shares = sorted(
        scene.stream.mixture.shares["gangue"][0] for scene in scenes if scene.stream and scene.stream.mixture
    )
    assert np.floor(np.array(shares) * 20).tolist() == list(range(20))
    rates = [scene.stream.arrivals.rate.values[0] for scene in scenes if scene.stream and scene.stream.arrivals.rate]
    assert min(rates) >= 4 and max(rates) <= 12 and np.ptp(rates) > 3
    assert {scene.populations for scene in scenes} == {caving.populations}
    points = [scene.tail_beam.impact_point for scene in scenes if scene.tail_beam]
    assert caving.tail_beam is not None
    assert [point == caving.tail_beam.impact_point for point in points] == [True, False] * 10
    assert [one.text for one in variations(caving, 20, 3)] == [one.text for one in scenes]
    assert variations(caving, 20, 4)[0].text != scenes[0].text


def test_each_stream_has_modes_of_its_own_where_nobody_knows_them(caving: Scene) -> None:
    stated = uncertain(caving, 0.01)
    nominal, modes = beam_modes(caving), [beam_modes(one) for one in variations(stated, 4, 3)]
    errors = np.log([one.frequency / nominal.frequency for one in modes])
    assert np.std(errors, axis=1) == pytest.approx(0.01, rel=0.3) and np.abs(np.corrcoef(errors)).min() < 0.2
    assert all(one.deviation is None for one in modes)


def test_rows_are_what_the_detector_finds_with_the_truth_of_the_rock(short) -> None:
    for number, (scene, stream) in enumerate(zip(*short, strict=True)):
        _, truth = record(scene, 7, number)
        first = truth["bounce"] == 0
        assert stream.n_rocks == (
            np.sum(first & (truth["label"] == "coal")),
            np.sum(first & (truth["label"] == "gangue")),
        )
        rows = stream.rows
        assert rows.names == NAMES
        assert len(rows.labels) + rows.left_out == stream.n_detected
        assert 0.7 * truth["time"].size < stream.n_detected < 1.1 * truth["time"].size
        assert np.isfinite(rows.features).all()
        # The rock of each row is one that touched within the time of detection, and its force is that which was seen.
        peaks = []
        for label, specimen, time in zip(rows.labels, rows.group, rows.time, strict=True):
            own = (truth["specimen"] == specimen) & (np.abs(truth["time"] - time) < 5e-3)
            assert own.any()
            assert set(truth["label"][own]) == {label}
            peaks.append(truth["peak_force"][own].max())
        seen = rows.columns(("beam_peak_force",))[:, 0]
        assert np.median(np.abs(np.log(seen / np.array(peaks)))) < 0.05


def test_a_model_is_finished(short, shipped_model: StoredModel) -> None:
    _, measured = short
    plain = replace(
        shipped_model,
        arrays={name: array for name, array in shipped_model.arrays.items() if not name.startswith("share.")},
        guard_limits=(50.0, 1.0),
    )
    assert plain.confusion is None
    repeated = [replace(one, rows=Rows.joined([one.rows] * 3), n_detected=3 * one.n_detected) for one in measured]
    model = finished(plain, repeated)
    told = model.training["streams"]
    assert model.guard_limits[0] == 50.0 and model.guard_limits[1] >= 1.0
    assert told["unknown_share"] < 0.15
    assert told["n_found"] == 3 * sum(one.n_detected for one in measured)
    again = StoredModel.from_bytes(model.to_bytes())
    assert again.confusion is not None and model.confusion is not None
    assert again.confusion.rates.tolist() == model.confusion.rates.tolist()
    assert sum(told["answers_a_rock"].values()) == pytest.approx(model.confusion.rates.sum())
    assert told["overdispersion"] >= 1 and told["scatter"] >= MIN_SCATTER


@pytest.mark.long
def test_training_on_streams_gives_a_share_that_covers(caving: Scene) -> None:
    training = train_on_streams(caving, 4000, seed=5)
    assert training.metrics["accuracy"] > 0.75
    held, errors, unknown = [], [], []
    for number, share in enumerate((0.05, 0.3, 0.5)):
        content = json.loads(caving.text)
        content["stream"]["mixture"] = {"times": [0.0], "gangue": [share]}
        signal, truth = record(parse_scene(content), 77, number)
        first = truth["bounce"] == 0
        question = PredictionSettings(share_step=10.0)
        steps = identify_blocks([signal.samples[None]], signal.sampling_rate, training.model, ("1",), question)
        answers = [answer for step in steps for answer in step.answers]
        unknown += [answer.label == "unknown" for answer in answers]
        for report in CavingWatch(training.model, ("1",), question).feed(answers, 60.0):
            if report.kind == "share":
                one = report.state.share
                own = first & (truth["time"] > one.start) & (truth["time"] <= one.time)
                truly = np.mean(truth["label"][own] == "gangue")
                held.append(one.low <= truly <= one.high)
                errors.append(one.share - truly)
    assert np.mean(held) > 0.8
    assert np.sqrt(np.mean(np.square(errors))) < 0.12
    assert np.mean(unknown) < 0.07
