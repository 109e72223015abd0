"""The estimate of a Bayes limit behind a beam: slopes, Fisher's information, and the command."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import scipy.optimize

from cgid import shipped
from cgid.errors import InvalidValue
from cgid.measure.fit.template import curve, relative_times
from cgid.physics.contact.sampled import SampledPulses, shares_of_contact
from cgid.scene import Plan, Scene, load_scene
from cgid.scene.synthesis.impacts import recorder_of
from studies.ceilings import learners
from studies.ceilings.__main__ import main
from studies.ceilings.beam import UNKNOWNS, BeamErrors, check_estimated

TEXT = Path(shipped.scene_path("tail_beam")).read_text()
#: A recorder of a lower band hears fewer modes, which takes less time.
SLOW = TEXT.replace('"10 kHz", order = 8', '"4 kHz", order = 8').replace("samples = 2048", "samples = 768")
QUIET = SLOW.replace("2 mg/sqrt(Hz)", "0.05 mg/sqrt(Hz)")
#: A strong blow of 1.1 ms: ln peak, ln width, shape, touch, x, y.
BLOW = np.array([np.log(3000.0), np.log(4e-4), -0.7, 3.4, 1.13, 0.62])
STEPS = np.array([1e-3, 1e-3, 2e-3, 1e-3, 5e-4, 5e-4])


def scene_of(folder: Path, text: str) -> Scene:
    (folder / "scene.toml").write_text(text)
    return load_scene(folder / "scene.toml")


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> BeamErrors:
    return BeamErrors(scene_of(tmp_path_factory.mktemp("beam"), QUIET))


def with_sensor(errors: BeamErrors, folder: Path, text: str) -> BeamErrors:
    """Return the errors behind the same beam of a scene with another noise and range."""
    other = copy.copy(errors)
    other.scene = scene_of(folder, text)
    return other


def heard(errors: BeamErrors, unknowns: np.ndarray, n_samples: int) -> np.ndarray:
    """Return the recorder's response to pulses of the family, as the signals of scenes are made."""
    log_peak, log_width, shape, touch, x, y = unknowns.T
    shares = shares_of_contact(257)
    force = curve(np.broadcast_to(shares, (len(unknowns), shares.size)), shape)
    lasts = relative_times(shape)[0] * np.exp(log_width)
    pulses = SampledPulses(
        shares=shares, forces=np.maximum(force, 0) * np.exp(log_peak)[:, None], contact_duration=lasts
    )
    recorder = recorder_of(Plan(scene=errors.scene))
    assert recorder is not None
    participation = recorder.participation({"impact_x": x, "impact_y": y})
    frames = np.zeros((len(unknowns), n_samples))
    recorder.response.add_to_frames(frames, pulses, touch / errors.beam.sampling_rate, participation)
    return frames


def test_the_slopes_are_those_of_signals_by_central_differences(errors: BeamErrors) -> None:
    slopes = errors.signals(errors.slopes(BLOW[None]))[0]
    ends = np.concatenate([BLOW + np.diag(STEPS), BLOW - np.diag(STEPS)])
    own = errors.signals(errors.slopes(ends)[:, 0])
    signals = heard(errors, ends, slopes.shape[1])
    # The contact force is a sum of 18 principal shapes, which follow a change of width and shape within 7 %.
    for number, name in enumerate(UNKNOWNS):
        for one, error in ((own, 0.002), (signals, 0.07)):
            difference = (one[number] - one[number + 6]) / (2 * STEPS[number])
            apart = np.linalg.norm(slopes[number] - difference) / np.linalg.norm(difference)
            assert apart < error, (name, apart)


@pytest.mark.long
def test_the_information_is_that_of_a_fit_to_noisy_copies(errors: BeamErrors) -> None:
    """Against the covariance of 100 least-squares fits to noisy samples, with slopes by differences."""
    information = errors.information(BLOW[None])[0]
    covariance = np.linalg.inv(information)
    clean = errors.signals(errors.slopes(BLOW[None]))[0, 0]
    sensor = errors.scene.sensor
    step = sensor.range / 2 ** (sensor.bits - 1)
    noise = np.hypot(sensor.noise_density * np.sqrt(errors.beam.sampling_rate / 2), step / np.sqrt(12))
    scale = np.sqrt(np.diag(covariance))
    assert np.abs(clean).max() / noise > 100
    random = np.random.default_rng(5)
    found = []
    for _ in range(100):
        samples = clean + noise * random.standard_normal(clean.size)

        def left(at: np.ndarray, samples: np.ndarray = samples) -> np.ndarray:
            # What the scene says of touch and place is known from elsewhere; here it is less than a thousandth. Steps
            # are shares of the unknowns, so these lie about 10 deviations.
            return (errors.signals(errors.slopes((BLOW + scale * (at - 10))[None])[0, 0]) - samples) / noise

        start = np.full(6, 10.0)
        found.append(scipy.optimize.least_squares(left, start, jac="3-point", diff_step=0.03).x - 10)
    empirical = np.cov(np.array(found).T)
    expected = covariance / np.outer(scale, scale)
    # In the axes of the expected covariance the empirical one is 1, with chi-squared of 99 degrees of freedom.
    root = np.linalg.inv(np.linalg.cholesky(expected))
    whitened = root @ empirical @ root.T
    assert np.abs(np.diag(whitened) - 1).max() < 0.49  # 3.5 standard errors
    assert np.abs(whitened - np.diag(np.diag(whitened))).max() < 0.4  # 4 of 1 / sqrt(100)
    assert np.abs(np.mean(found, axis=0)).max() < 0.4


def test_pulses_of_the_family_stand_for_themselves(errors: BeamErrors) -> None:
    true = errors.drawn(3, 0)
    values = true.blows.parameters
    close = true.apart < 0.002
    assert close.mean() > 0.4
    shape = true.unknowns[close, 2]
    assert np.quantile(np.abs(shape - np.log(values["restitution"][close])), 0.9) < 0.01
    lasts = relative_times(shape)[0] * np.exp(true.unknowns[close, 1])
    assert np.quantile(np.abs(lasts / values["contact_duration"][close] - 1), 0.9) < 0.01
    assert np.array_equal(true.unknowns[:, 0], np.log(values["peak_force"]))


def test_samples_at_full_scale_tell_nothing(errors: BeamErrors, tmp_path: Path) -> None:
    plain = SLOW.replace("bits = 16\n", "")
    clipped = with_sensor(errors, tmp_path, plain.replace('range = "500 g"', 'range = "1 g"'))
    free = with_sensor(errors, tmp_path, plain.replace('range = "500 g"\n', ""))
    signal = free.signals(free.slopes(BLOW[None])[:, 0])[0]
    kept = np.abs(signal) <= 9.80665
    assert 0 < np.sum(~kept) < 200
    slopes = free.signals(free.slopes(BLOW[None]))[0][:, kept]
    expected = slopes @ slopes.T / free.scene.sensor.noise_level(np.zeros(()), 25600.0) ** 2
    for one in (free, clipped):
        found = one.information(BLOW[None])[0] - np.diag(one._prior)
        share = np.diag(found) / np.diag(expected)
        assert np.allclose(share, 1, rtol=1e-6) if one is clipped else (share > 1.001).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[sampling]", "[randomise]\nbandwidth = 3e3\n[sampling]"), "randomise"),
        (("bits = 16", 'bits = 16\nnoise_exponent = 1\nabsolute_noise = "1 g"'), "white noise"),
        (('noise_density = "2 mg/sqrt(Hz)"', ""), "noise: give sensor.noise_density"),
        (("[sampling]", '[background]\nhum = [{ frequency = 50, amplitude = "1 g" }]\n[sampling]'), "background"),
        (('anti_alias = { frequency = "4 kHz", order = 8 }', 'bandwidth = "4 kHz"'), "sensor.anti_alias"),
        (("[[populations]]\n", '[[populations]]\nsecond_hit = { delay = "1 ms", ratio = 0.5 }\n'), "second_hit"),
    ],
)
def test_what_the_estimate_does_not_cover(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    old, new = change
    assert old in SLOW
    text = SLOW.replace(old, new, 1)
    if "noise_exponent" in new:
        text = text.replace('noise_density = "2 mg/sqrt(Hz)"', "")
    with pytest.raises(InvalidValue, match=message):
        check_estimated(scene_of(tmp_path, text))


def test_scenes_without_a_beam_have_no_estimate() -> None:
    with pytest.raises(InvalidValue, match="tail_beam"):
        BeamErrors(load_scene(shipped.scene_path("peers")))


@pytest.mark.long
def test_the_estimate_is_above_the_learner_from_below(
    errors: BeamErrors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("studies.ceilings.beam.beam_of", lambda scene: errors.beam)  # noise does not change it
    monkeypatch.setattr(learners, "_ESTIMATED_SIZES", (1 << 10, 1 << 12))
    monkeypatch.setattr(learners, "_HELD_ESTIMATES", 1 << 10)
    scene = scene_of(tmp_path, SLOW)
    (*_, best), apart = learners.behind_beam(scene, 512, 8)
    below = learners.through_beam(scene, 1000, 512, 8)
    lost = best.hits.astype(float) - below.hits
    assert lost.mean() > -2 * lost.std() / np.sqrt(512)
    assert 0.7 < best.accuracy < 0.9 and below.accuracy > 0.65
    assert 0 < apart < 0.02
    # A known drop height tells more.
    (*_, known), _ = learners.behind_beam(scene, 512, 8, drop_height_known=True)
    assert known.accuracy > best.accuracy
    assert main([str(tmp_path / "scene.toml"), "-n", "512", "--seed", "8"]) == 0
    assert f"about {best.accuracy:.4f} +- {best.accuracy_error:.4f}" in capsys.readouterr().out
