"""Several accelerometers of one beam, against dense covariances, one accelerometer, and what truly happened."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from cgid.errors import BadData, InvalidValue
from cgid.identification.inversion.inversion import ForceEstimate, Inversion, Observations
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import Answer, PredictionSettings, identify, identify_frames
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.training import train_on_specimens
from cgid.identification.training.rows import BEAM_FEATURES
from cgid.measure.features.extraction import extract_array
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.frames import clipped_samples
from cgid.measure.modal.beam import Beam
from cgid.scene import load_scene, parse_scene, synthesise, varied
from cgid.scene.synthesis.impacts import beam_modes
from cgid.scene.synthesis.several_sensors import recorded_together
from cgid.scene.synthesis.through_beam import beam_of, moved
from cgid.signals import Batch, Signal
from tests.hostile_models import beam_arrays
from tests.test_inversion import basis, dense, eight_modes

SEED, N = 2024, 60
#: Off the middle line of the beam (y = .7 m), and on it.
OFF, ON = ((0.5, 0.45), (1.1, 1.0)), ((0.5, 0.7), (1.1, 0.7))


def sensors_for(beam: Beam, at_sensor: np.ndarray) -> Beam:
    return replace(beam, modes=replace(beam.modes, at_sensor=at_sensor))


def of_sensors(*shares: float) -> Inversion:
    """The small beam of eight modes with sensors that hear some modes more than others."""
    order = np.arange(1, 9)
    sensors = np.stack([np.cos(share * order) for share in shares])
    return Inversion(sensors_for(eight_modes().beam, sensors))


@pytest.mark.parametrize("louder", [1.0, 3.0])
def test_the_samples_of_two_sensors_are_one_gaussian(louder: float) -> None:
    """Evidence and what is told of the force, against dense covariances in time; the second sensor may be louder."""
    inversion, random, n = of_sensors(0.3, 1.7), np.random.default_rng(3), 30.0
    own = basis(inversion)
    noise = np.array([1.0, louder])
    blow = dense(inversion, 0.927, 0.302) @ random.normal(size=4)
    frames = n * blow / np.std(blow) + noise[:, None] * (random.normal(size=(2, len(own))) @ own)
    found = inversion.invert(Observations(frames[None], noise[None]), np.array([[3, 3]]))
    assert found.start[0] == 0
    assert found.x[0] == pytest.approx(0.927, abs=3e-3)
    assert found.y[0] == pytest.approx(0.302, abs=1e-3)
    x, y, force, step = found.x[0], found.y[0], found.coefficients[0], 1e-5
    both = (dense(inversion, x, y) / noise[:, None, None]).reshape(-1, 4)
    sides = [
        (dense(inversion, x + a, y + b) - dense(inversion, x - a, y - b)) @ force / (2 * step) / noise[:, None]
        for a, b in ((step, 0.0), (0.0, step))
    ]
    slopes = np.stack([side.ravel() for side in sides], axis=1)
    sample = (frames / noise[:, None]).ravel()
    free = np.eye(sample.size) + 0.1**2 * slopes @ slopes.T
    information, vector = both.T @ np.linalg.solve(free, both), both.T @ np.linalg.solve(free, sample)
    # It is told before the last step to the place.
    np.testing.assert_allclose(found.information[0], information, rtol=1e-2, atol=1e-3 * np.abs(information).max())
    np.testing.assert_allclose(found.vector[0], vector, rtol=1e-2, atol=5e-3 * np.abs(vector).max())
    levels = inversion.grid.noise_tables(0.0)[1].levels
    gains = []
    for level in levels:
        covariance = np.eye(sample.size) + level**2 * both @ both.T
        quadratic = sample @ sample - sample @ np.linalg.solve(covariance, sample)
        gains.append(0.5 * quadratic - 0.5 * np.linalg.slogdet(covariance)[1])
    assert found.evidence[0] * sample.size == pytest.approx(max(gains), rel=1e-3)


def test_a_beam_is_that_of_a_scene_by_name() -> None:
    assert beam_of("tail_beam", n_shapes=2).shapes.shape == beam_of(load_scene("tail_beam"), n_shapes=2).shapes.shape
    with pytest.raises(InvalidValue, match=r"scene reference: must have a \[tail_beam\]"):
        beam_of("reference")


def test_a_sensor_twice_is_one_with_less_noise() -> None:
    """Two records of the same samples, of noise .5 and 1 / sqrt(12), tell what one of noise .25 tells."""
    one, random = eight_modes(), np.random.default_rng(5)
    two = Inversion(sensors_for(one.beam, np.ones((2, 8))))
    places = zip(random.uniform(0.82, 0.98, 20), random.uniform(0.22, 0.38, 20), strict=True)
    blows = np.stack([dense(one, x, y)[0] @ random.normal(size=4) for x, y in places])
    own = basis(one)
    frames = 20 * blows / np.std(blows, axis=1, keepdims=True) + random.normal(size=(20, len(own))) @ own
    start = np.full((20, 2), 3)
    single = one.invert(Observations(frames, np.full(20, 0.25)), start)
    for parts in ((8.0, 8.0), (4.0, 12.0), (1e-12, 16.0)):
        noise = np.tile(np.array(parts) ** -0.5, (20, 1))
        both = two.invert(Observations(np.stack([frames, frames], axis=1), noise), start)
        np.testing.assert_allclose(both.x, single.x, atol=1e-4)
        np.testing.assert_allclose(both.y, single.y, atol=1e-4)
        np.testing.assert_allclose(both.place_deviation, single.place_deviation, rtol=2e-2)
        scale = both.noise[:, None] * both.coefficients
        expected = single.noise[:, None] * single.coefficients
        np.testing.assert_allclose(scale, expected, atol=1e-2 * np.abs(expected).max())


@functools.cache
def beam_at(*points: tuple[float, float]) -> ThroughBeam:
    return ThroughBeam(beam_of("tail_beam", sensors=points))


def alone(number: int) -> ThroughBeam:
    beam = beam_at(*OFF).beam
    one = beam.with_shapes(beam.participation * beam.shares[number][:, None, None])
    return ThroughBeam(sensors_for(one, np.ones((1, len(beam.poles)))))


def features_of(signals: np.ndarray, batch: Batch, beam: ThroughBeam) -> np.ndarray:
    return extract_array(
        signals, batch.sampling_rate, BEAM_FEATURES, pre_trigger=batch.pre_trigger, beam=beam, invalid="nan"
    )


@functools.cache
def looked(points: tuple[tuple[float, float], ...]) -> tuple[Batch, ForceEstimate, np.ndarray]:
    """Impacts of the shipped scene at several sensors, each with its own noise; what is found, and the features."""
    scene, random = load_scene("tail_beam"), np.random.default_rng(1)
    noise = float(scene.sensor.noise_level(np.zeros(1), scene.sampling.sampling_rate)[0])
    quiet = varied(scene, noise_density=None, bits=None)
    batches = [next(iter(synthesise(moved(quiet, point), N, SEED))) for point in points]
    signals = np.stack([batch.signals for batch in batches], axis=1)
    batch = replace(batches[0], signals=signals + random.normal(0, noise, signals.shape))
    rows = VibrationBatch(batch.signals.reshape(-1, signals.shape[2]), batch.sampling_rate, batch.pre_trigger)
    return batch, beam_at(*points).look(rows)[0], features_of(batch.signals, batch, beam_at(*points))


@functools.cache
def pair() -> StoredModel:
    return train_on_specimens([looked(OFF)[0]], beam=beam_at(*OFF).beam).model


def far(points: tuple[tuple[float, float], ...]) -> np.ndarray:
    batch, inverted, _ = looked(points)
    return np.hypot(inverted.x - batch.parameters["impact_x"], inverted.y - batch.parameters["impact_y"])


def test_two_sensors_find_the_location_and_the_force() -> None:
    batch, _, values = looked(OFF)
    assert np.median(far(OFF)) < 1e-3
    assert np.mean(far(OFF) < 0.02) > 0.97
    assert np.median(np.abs(np.log(values[:, 0] / batch.parameters["peak_force"]))) < 0.01


def test_a_noisy_sensor_does_not_mislead() -> None:
    """Noise that goes with the loudness of each sensor: far louder at one than at the other, and of another colour."""
    batch, _, _ = looked(OFF)
    random, peak = np.random.default_rng(3), np.abs(batch.signals).max(axis=2, keepdims=True)
    noise = random.normal(size=batch.signals.shape)
    noise[:, 0] = signal.lfilter([1.0], [1.0, -0.95], noise[:, 0])
    noise /= np.std(noise, axis=2, keepdims=True)
    signals = batch.signals + np.array([[0.01], [0.1]]) * peak * noise
    rows = VibrationBatch(signals.reshape(-1, signals.shape[2]), batch.sampling_rate, batch.pre_trigger)
    found = beam_at(*OFF).look(rows)[0]
    apart = np.hypot(found.x - batch.parameters["impact_x"], found.y - batch.parameters["impact_y"])
    assert np.median(apart) < 2e-3
    assert np.mean(apart < 0.02) > 0.97


def test_a_dead_sensor_is_left_out() -> None:
    """A cable that fell off gives zeros: the answers are those of the other sensor."""
    batch, _, _ = looked(OFF)
    signals, pair = batch.signals.copy(), beam_at(*OFF)
    signals[:, 1] = 0.0
    assert clipped_samples(signals[:, 1]) is None
    both, one = features_of(signals, batch, pair), features_of(signals[:, 0], batch, alone(0))
    assert np.median(np.abs(np.log(both[:, 0] / one[:, 0]))) < 1e-3
    assert np.median(np.abs(np.log(both[:, 3] / one[:, 3]))) < 0.02
    signals[:5] = 0.0
    found = features_of(signals, batch, pair)
    assert np.isnan(found[:5]).all()
    assert np.isfinite(found[5:]).all()
    with pytest.raises(BadData, match=r"signal 0: no impact: all samples are 0.*\(5 of 60 signals "):
        extract_array(signals, batch.sampling_rate, BEAM_FEATURES, pre_trigger=batch.pre_trigger, beam=pair)


@pytest.mark.parametrize("clipped", [(0,), (0, 1)])
def test_clipped_samples_tell_nothing(clipped: tuple[int, ...]) -> None:
    """The peak is found beside them, within its deviations: they would pull it towards the limit."""
    batch, _, _ = looked(OFF)
    signals = batch.signals[:48].copy()
    limit = 0.4 * np.abs(signals).max(axis=2, keepdims=True)
    for sensor in clipped:
        signals[:, sensor] = np.clip(signals[:, sensor], -limit[:, sensor], limit[:, sensor])
    values = features_of(signals, batch, beam_at(*OFF))
    error = np.log(values[:, 0] / batch.parameters["peak_force"][:48])
    assert np.nanmedian(np.abs(error)) < 0.02
    assert np.mean(np.abs(error) < 1.96 * values[:, 3]) > 0.7


def test_participations_that_blows_taught_are_those_of_one_sensor() -> None:
    """Frequencies and dampings are those of the whole beam, so a scene that has learned these alone may move."""
    scene = load_scene("tail_beam")
    content, modes = json.loads(scene.text), beam_modes(scene)
    rows = [
        {"frequency": f, "damping_ratio": zeta, "frequency_deviation": 0.01}
        for f, zeta in zip(modes.frequency.tolist(), modes.damping_ratio.tolist(), strict=True)
    ]
    content["tail_beam"]["learned"] = rows
    assert next(recorded_together(parse_scene(content), OFF, 1)).signals.shape[:2] == (1, 2)
    for wrong in ({"participation": 1.1}, {"participation_deviation": 0.1}):
        content["tail_beam"]["learned"] = [*rows[:-1], rows[-1] | wrong]
        learned = parse_scene(content)
        for used in (beam_of, lambda scene, sensors: next(recorded_together(scene, sensors, 1))):
            with pytest.raises(InvalidValue, match="participations of 1 without deviation"):
                used(learned, sensors=OFF)


def test_a_model_of_two_sensors(tmp_path: Path) -> None:
    batch, model = looked(OFF)[0], pair()
    path = tmp_path / "pair.npz"
    path.write_bytes(model.to_bytes())
    loaded = StoredModel.load(path)
    assert loaded.to_bytes() == path.read_bytes()
    assert loaded.beam is not None and loaded.beam.n_sensors == 2
    answers = identify_frames(batch.signals[:20], batch.sampling_rate, loaded, pre_trigger=batch.pre_trigger)
    labels = [max(answer.probabilities, key=lambda label: answer.probabilities[label]) for answer in answers]
    assert np.mean(np.array(labels) == batch.labels[:20]) > 0.7
    with pytest.raises(BadData, match=r"must be \(n_signals, 2, n_samples\), one row for each of the 2 sensors"):
        identify_frames(batch.signals[:, 0], batch.sampling_rate, loaded, pre_trigger=batch.pre_trigger)


def test_signals_of_sensors_together() -> None:
    """The impacts are those of the scene, each sensor has noise of its own, and the first has that of the scene."""
    scene, points = load_scene("tail_beam"), [(0.5, 0.45), (1.1, 1.0), (0.5, 0.45)]
    together, alone = next(recorded_together(scene, points, 64, 7)), next(synthesise(scene, 64, 7))
    np.testing.assert_array_equal(together.signals[:, 0], alone.signals)
    np.testing.assert_array_equal(together.labels, alone.labels)
    quiet = together.signals[..., : alone.pre_trigger - 2].transpose(1, 0, 2).reshape(3, -1)
    assert np.abs(np.corrcoef(quiet) - np.eye(3)).max() < 0.05
    rest = together.signals[:, 2] - alone.signals
    assert np.std(rest) == pytest.approx(np.sqrt(2) * np.std(quiet[0]), rel=0.05)


def test_a_recording_of_sensors_together() -> None:
    """One answer a blow, as for its frames, however the recording is cut in blocks; swapped channels are unknown."""
    model, batch = pair(), next(recorded_together(load_scene("tail_beam"), OFF, 6, 4))
    recording, names = np.concatenate(list(batch.signals), axis=1).astype(np.float64), ["left", "right"]

    def answers(samples: np.ndarray, length: int) -> list[Answer]:
        blocks = (samples[:, first : first + length] for first in range(0, samples.shape[1], length))
        return [one for s in identify_blocks(blocks, 25600.0, model, names, PredictionSettings()) for one in s.answers]

    found = answers(recording, 1 << 20)
    assert [answer.channel for answer in found] == ["left+right"] * 6
    assert [answer.probabilities for answer in answers(recording, 777)] == [one.probabilities for one in found]
    own = identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger)
    apart = [a.probabilities["coal"] - b.probabilities["coal"] for a, b in zip(found, own, strict=True)]
    assert np.median(np.abs(apart)) < 0.05
    assert np.mean([answer.label == "unknown" for answer in answers(recording[::-1], 1 << 20)]) > 0.8
    with pytest.raises(BadData, match="channels must be 2, which this model uses together, got 1"):
        list(identify_blocks(iter([recording[:1]]), 25600.0, model, ["left"], PredictionSettings()))
    one = Signal(samples=recording[0], sampling_rate=25600.0, unit="m/s^2")
    with pytest.raises(BadData, match="channels must be 2, one for each sensor"):
        identify(one, model)


def test_sensors_of_a_file_that_do_not_fit_its_beam_are_refused() -> None:
    arrays = beam_arrays(sensors=np.ones((2, 3)))
    found = Beam.from_arrays(arrays)
    assert found is not None and found.n_sensors == 2
    for wrong in (np.ones((2, 4)), np.ones(3), np.zeros((2, 3)), np.full((2, 3), 1e9), np.ones((17, 3))):
        with pytest.raises(BadData):
            Beam.from_arrays(arrays | {"beam.sensors": wrong})
