"""`cgid calibrate`: the modes of a beam from unlabelled blows, against beams whose modes are known."""

import itertools
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from scipy.special import ndtri

from cgid.calibration import calibrate
from cgid.calibration.dimensions import dimension_errors, learn_dimensions, with_dimensions
from cgid.calibration.learning import ImpactFrames, System, newton, search_valleys
from cgid.calibration.modes import (
    _Sensor,
    check_scene,
    count_crossings,
    frames_of,
    prepare_impacts,
    table_beside,
    uncertain,
    usable_impacts,
)
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.identification.detection import ImpactDetector
from cgid.identification.inversion.inversion import Inversion
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.prediction import load_model
from cgid.identification.training import train_on_specimens
from cgid.identification.training.rows import BEAM_GUARDS, measure
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.modal.beam import corrected
from cgid.measure.modal.modes import LEARNED_COLUMNS, Modes, read_modes
from cgid.scene import generate, load_scene, parse_scene, record, synthesise
from cgid.scene.file.sections import rows_of
from cgid.scene.synthesis.impacts import beam_modes
from cgid.scene.synthesis.through_beam import beam_of, through_modes
from tests.plan_scenes import toml

RATE, BEFORE = 6400.0, 64


def panel(**changes):
    """A small plain panel, of which some ten modes are heard below 2 kHz."""
    content = json.loads(load_scene("tail_beam").text)
    content["tail_beam"] |= {"length": 0.9, "width": 0.7, "thickness": 0.02, "edges": "clamped", "ribs": None}
    content["tail_beam"] |= {
        "sensor_point": {"x": 0.31, "y": 0.22},
        "impact_point": {
            axis: {"distribution": "uniform", "lowest": low, "highest": high}
            for axis, low, high in (("x", 0.3, 0.8), ("y", 0.1, 0.6))
        },
    }
    content["tail_beam"] = {
        name: value for name, value in (content["tail_beam"] | changes).items() if value is not None
    }
    content["sampling"] = {"sampling_rate": RATE, "samples": 512, "pre_trigger": BEFORE}
    content["sensor"] |= {"anti_alias": {"frequency": 2000.0, "order": 8}, "mounting": None, "noise_density": 0.1}
    content["sensor"] = {name: value for name, value in content["sensor"].items() if value is not None}
    for rocks in content["populations"]:
        rocks["radius"] = {"distribution": "log-uniform", "lowest": 0.02, "highest": 0.06}
    return parse_scene(content)


def exact(beam):
    return replace(beam, modes=replace(beam.modes, deviation=None))


def modes_off(scene, frequency, damping, seed, deviation=0.0):
    """Return a scene whose modes are off by independent errors, and these errors."""
    own, rng = beam_modes(scene), np.random.default_rng(seed)
    error = np.stack([rng.normal(0, spread, own.frequency.size) for spread in (frequency, damping)])
    bars = np.full(own.frequency.size, deviation)
    modes = Modes.relative(
        own.frequency * np.exp(error[0]), own.damping_ratio * np.exp(error[1]), np.ones(bars.size), np.stack([bars] * 3)
    )
    content = json.loads(scene.text)
    content["tail_beam"]["learned"] = rows_of(modes)
    return parse_scene(content), error


def frames(scene, n, seed):
    return np.concatenate([batch.signals for batch in synthesise(scene, n, seed)])


@pytest.fixture(scope="module")
def known():
    """The panel, one whose modes are off by 1 %, the errors, and blows on that one."""
    scene = panel()
    site, error = modes_off(scene, 0.01, 0.1, seed=3)
    return scene, site, error, frames(site, 60, seed=8)


@pytest.fixture(scope="module")
def found(known):
    scene, _, _, blows = known
    return calibrate(scene, blows, RATE, BEFORE)


def test_unlabelled_blows_teach_the_modes(known, found):
    scene, site, error, _ = known
    after = np.log(found.learned.frequency / site.tail_beam.learned_modes.frequency)
    heard = beam_modes(scene).frequency < 2000
    assert heard.sum() > 8
    assert np.median(np.abs(after[heard])) < 0.05 * np.median(np.abs(error[0, heard]))
    damping = np.log(found.learned.damping_ratio / site.tail_beam.learned_modes.damping_ratio)
    assert np.median(np.abs(damping[heard])) < 0.2 * np.median(np.abs(error[1, heard]))
    # Its own deviations are right: normal errors rarely pass three.
    assert np.mean(np.abs(after[heard]) < 3 * found.learned.deviation[0][heard]) > 0.85
    assert found.has_converged and found.n_impacts == 60


@pytest.mark.long
def test_five_per_cent_off_is_learned_band_by_band():
    scene = panel()
    site, _ = modes_off(scene, 0.05, 0.3, seed=1)
    found = calibrate(scene, frames(site, 120, seed=4), RATE, BEFORE, start_error=0.05)
    heard = beam_modes(scene).frequency < 2000
    after = np.log(found.learned.frequency / site.tail_beam.learned_modes.frequency)[heard]
    assert np.median(np.abs(after)) < 1e-3


@pytest.mark.long
def test_dimensions_are_learned():
    """Of a plain plate blows tell the ratios of all dimensions, but not its size: every force is unknown."""
    scene, names = panel(), ["length", "width", "thickness", "sensor_point.x", "sensor_point.y", "damping_ratio"]
    off = np.array([0.025, -0.03, 0.02, -0.04, 0.03, 0.2])
    truth = with_dimensions(scene, names, off)
    blows, beam = prepare_impacts(frames(truth, 60, seed=5), RATE, BEFORE), exact(beam_of(scene))
    own, found = learn_dimensions(scene, beam, blows, dimension_errors(scene, 0.03))
    told = {one.name: one for one in found}
    assert sorted(told) == sorted(names)
    change = np.log([told[name].after / told[name].before for name in names])
    bars = np.array([told[name].deviation for name in names])
    error = change - off
    assert (np.abs(error) < 3.5 * bars).all()
    # What is known, and what is not: one factor, whose deviation follows from the priors of eight parts.
    assert bars[:2] == pytest.approx(0.03 / np.sqrt(8), rel=0.25) and bars[2] == pytest.approx(2 * bars[0], rel=0.1)
    ratios = error[[0, 0, 0, 1]] - np.array([error[1], error[2] / 2, error[3], error[4]])
    assert np.abs(ratios).max() < 2e-3
    assert abs(error[5]) < 0.01
    assert through_modes(own, beam).poles.imag[:6] == pytest.approx(beam_of(truth).poles.imag[:6], rel=1e-3)


@pytest.mark.long
def test_drawings_are_calibrated(known):
    """Dimensions first, then the modes: as good as if the drawing were exact."""
    scene, names = known[0], ["length", "width", "thickness"]
    site, _ = modes_off(with_dimensions(scene, names, np.array([-0.03, 0.02, 0.03])), 0.003, 0.03, seed=2)
    blows = frames(site, 100, seed=11)
    found = calibrate(scene, blows, RATE, BEFORE, dimension_error=0.03, start_error=0.003)
    assert found.before < found.after - 20
    assert abs(found.after - found.expected) < 0.1
    heard = beam_modes(found.scene).frequency < 1800
    after = np.log(found.learned.frequency[heard] / site.tail_beam.learned_modes.frequency[: heard.size][heard])
    assert np.median(np.abs(after)) < 1e-3
    assert found.scene.tail_beam.length == pytest.approx(scene.tail_beam.length * np.exp(-0.03), rel=0.04)


def test_blows_and_sensor_stay_on_the_beam():
    """They stay where they are, as far as the beam reaches."""
    to_the_edge = {"x": {"distribution": "uniform", "lowest": 0.3, "highest": 0.9}, "y": 0.3}
    scene = panel(impact_point=to_the_edge, sensor_point={"x": 0.8995, "y": 0.2})
    for change, blows, sensor in (
        (-0.1, (0.3 * np.exp(-0.1), 0.9 * np.exp(-0.1)), 0.9 * np.exp(-0.1)),
        (0.1, (0.3, 0.9), 0.8995),
    ):
        beam = with_dimensions(scene, ["length"], np.array([change])).tail_beam
        assert beam.length == pytest.approx(0.9 * np.exp(change))
        assert beam.impact_point.x.extremes == pytest.approx(blows) and beam.impact_point.y.extremes == (0.3, 0.3)
        assert beam.sensor_point.x == pytest.approx(sensor) and beam.sensor_point.y == 0.2


@pytest.mark.long
def test_participations_are_learned_where_asked(known):
    scene, site, _, _ = known
    modes = site.tail_beam.learned_modes
    factor = np.exp(np.random.default_rng(5).normal(0, 0.1, modes.frequency.size))
    content = json.loads(site.text)
    content["tail_beam"]["learned"] = rows_of(replace(modes, at_sensor=factor))
    found = calibrate(scene, frames(parse_scene(content), 100, seed=9), RATE, BEFORE, participation_error=0.1)
    heard = beam_modes(scene).frequency < 1800
    # The common factor belongs to the forces, which nobody knows.
    after = np.log(found.learned.at_sensor / factor)[heard]
    before = np.log(factor[heard])
    assert np.std(after) < 0.4 * np.std(before)


def test_a_calibrated_scene_is_followed_as_it_drifts(known, found):
    _, site, _, _ = known
    moved, _ = modes_off(panel(), 0.0, 0.0, seed=0)
    rng = np.random.default_rng(6)
    modes = site.tail_beam.learned_modes
    content = json.loads(moved.text)
    drifted = replace(modes, frequency=modes.frequency * np.exp(rng.normal(0, 0.003, modes.frequency.size)))
    content["tail_beam"]["learned"] = rows_of(drifted)
    again = calibrate(found.scene, frames(parse_scene(content), 60, seed=7), RATE, BEFORE, drift=0.003)
    heard = beam_modes(panel()).frequency < 2000
    error = np.log(again.learned.frequency / drifted.frequency)[heard]
    assert np.median(np.abs(error)) < 5e-4
    # It never knew less than the drift allows.
    assert (again.start.deviation[0] >= 0.003).all()


def test_pull_is_that_of_the_projected_misfit(known, monkeypatch):
    """Against difference quotients of the misfit with place and force fitted anew, by Gauss-Newton in float64."""
    scene, _, _, blows = known
    monkeypatch.setattr(System, "level", lambda self, row: 1e12)
    beam = beam_of(scene)
    system = System(beam, prepare_impacts(blows[:1], RATE, BEFORE), np.full(1, 100.0))
    pulls, _ = system.equations(system.by_modes(np.array([0, 1])))
    assert system.nuisance(0)[3] == 1.0  # no error of the model above this noise
    start = np.array([system.inverted.x[0], system.inverted.y[0]])

    def cost(correction):
        own = corrected(beam, correction)
        table = system.of(own).astype(float)
        place = start.copy()
        for _ in range(12):
            at = [side[0].astype(float) for side in own.weights(place[:1], place[1:])]
            ways = np.tensordot(np.stack(at), table, 1)
            force = np.linalg.lstsq(ways[0].T, system.samples[0].astype(float), rcond=1e-9)[0]
            every = np.concatenate([ways[0], np.tensordot(ways[1:], force, (1, 0))])
            left = system.samples[0] - force @ ways[0]
            prior = np.diag(np.concatenate([np.full(force.size, 1e-12), np.full(2, 1e2)]))
            away = np.concatenate([np.zeros(force.size), 1e2 * (place - start)])
            place = place + np.linalg.solve(every @ every.T + prior, every @ left - away)[-2:]
        return 0.5 * left @ left + 50 * np.sum((place - start) ** 2)

    n = len(beam.poles)
    for number in np.argsort(-np.abs(pulls[0]))[:4]:
        step = np.zeros((3, n))
        step[number // n, number % n] = h = 1e-3
        quotient = -(cost(step) - cost(-step)) / (2 * h)
        # Kaufman (1975) leaves out the second derivatives.
        assert pulls[0, number] == pytest.approx(quotient, rel=0.25)


def test_a_mode_in_a_wrong_valley_is_found(known):
    _, site, _, blows = known
    beam = beam_of(site)
    wrong = np.zeros((3, len(beam.poles)))
    mode = int(np.argmax((beam.participation**2).mean(axis=(1, 2)) * (np.abs(beam.poles) < 2 * np.pi * 1500)))
    wrong[0, mode] = 0.09
    own = prepare_impacts(blows[:40], RATE, BEFORE)
    deviation = np.stack([np.full(len(beam.poles), spread) for spread in (0.05, 0.3, 0.0)])
    system = System(corrected(beam, wrong), own, np.ones(40))
    moved = search_valleys([(beam, system)], wrong, deviation)
    assert moved is not None and abs(moved[0, mode]) < 0.02


# -- the site file ----------------------------------------------------------------------------------------


def test_a_step_goes_to_the_optimum_of_misfit_and_prior():
    curvature, optimum, prior = np.array([[9.0, 2.0], [2.0, 4.0]]), np.array([0.3, -0.2]), np.array([0.5, 2.0])
    now, pulls = np.array([0.1, 0.1]), np.zeros((5, 2))
    pulls[:] = curvature @ (optimum - now) / 5
    found, step, deviation = newton(curvature, pulls, prior, now)
    both = curvature + np.diag(1 / prior**2)
    np.testing.assert_allclose(found, np.linalg.solve(both, curvature @ optimum), rtol=1e-12)
    np.testing.assert_allclose(found - now, step, rtol=1e-12)
    np.testing.assert_allclose(deviation, np.sqrt(np.diag(np.linalg.inv(both))), rtol=1e-12)


def test_site_file_holds_the_scene(found, tmp_path):
    path, table = found.save(tmp_path / "site.toml")
    assert (
        table == table_beside(path)
        and read_modes(table, LEARNED_COLUMNS).frequency.size == found.learned.frequency.size
    )
    again = load_scene(path)
    assert again.text == found.scene.text and again.sha256 == found.scene.sha256
    assert np.array_equal(beam_modes(again).frequency, found.learned.frequency)


def test_drawn_modes_have_their_deviations(known):
    modes = known[1].tail_beam.learned_modes
    own = replace(modes, deviation=np.outer([0.02, 0, 0], np.ones(modes.frequency.size)))
    uniform = np.random.default_rng(0).random((400, 3, modes.frequency.size))
    drawn = np.log([own.sampled(ndtri(numbers)).frequency for numbers in uniform]) - np.log(modes.frequency)
    assert np.std(drawn) == pytest.approx(0.02, rel=0.03) and abs(np.mean(drawn)) < 1e-3
    assert np.array_equal(own.sampled(ndtri(uniform[0])).damping_ratio, modes.damping_ratio)


def test_the_command_writes_a_scene_that_trains(known, tmp_path, capsys, monkeypatch):
    _, site, _, _ = known
    generate(site, tmp_path / "blows.h5", 30, seed=12)
    scene_file = tmp_path / "panel.toml"
    scene_file.write_text(toml(json.loads(known[0].text)))
    output = tmp_path / "site.toml"
    monkeypatch.setattr("cgid.cli.output.time", SimpleNamespace(monotonic=itertools.count(0, 5).__next__))
    assert run(["calibrate", str(tmp_path / "blows.h5"), "--scene", str(scene_file), "-o", str(output), "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    # Where stderr is no terminal, a line is printed every ten seconds: for each other round here.
    assert re.findall(r"cgid: fitting beam: (\d+) of \d+ rounds at most", err)[:3] == ["2", "4", "6"]
    assert told["n_impacts"] == 30 and told["evidence"]["after"] > told["evidence"]["before"]
    assert run(["check", str(output), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tail_beam"]["modes"] == told["n_modes"]
    assert run(["generate", str(output), "-n", "16", "-o", str(tmp_path / "more.h5")]) == 0


def test_a_sensor_off_the_beam_is_named_before_the_recording_is_read(tmp_path, capsys):
    (tmp_path / "empty.wav").write_bytes(b"")
    command = ["calibrate", str(tmp_path / "empty.wav"), "--scene", "tail_beam", "-o", str(tmp_path / "site.toml")]
    assert run([*command, "--sensor", "450,350"]) != 0
    assert "sensor_point.x" in capsys.readouterr().err


def test_a_model_of_modes_that_nobody_has_learned(known, tmp_path, capsys):
    """It trains on drawn modes, its file says how far they may be off, and it answers blows on a beam that is off."""
    scene = uncertain(known[0], 0.02)
    assert (beam_modes(scene).deviation == [[0.02], [0.2], [0.0]]).all() and beam_modes(known[0]).deviation is None
    again = beam_modes(uncertain(scene, 0.02)).deviation
    assert again[0] == pytest.approx(0.02 * np.sqrt(2)) and again[1] == pytest.approx(0.2 * np.sqrt(2))
    # Measured modes are sorted by frequency, and their errors with them.
    content = json.loads(tapped(1.0).text)
    rows = [{"frequency": f, "damping_ratio": 0.02, "frequency_deviation": f / 1e5} for f in (350, 300, 560, 905)]
    content["tail_beam"]["learned"] = rows
    assert (beam_modes(parse_scene(content)).deviation[0] == np.array([300, 350, 560, 905]) / 1e5).all()
    scene_file, model = tmp_path / "panel.toml", tmp_path / "model.npz"
    scene_file.write_text(toml(json.loads(known[0].text)))
    told = ["train", str(scene_file), "-n", "128", "--set", "start_error=2 %", "-o", str(model), "--json"]
    assert run(told) == 0
    capsys.readouterr()
    beam = load_model(model).beam.beam
    assert (beam.errors == [[0.02], [0.2], [0.0]]).all()
    generate(known[1], tmp_path / "blows.h5", 8, seed=12)
    assert run(["predict", str(tmp_path / "blows.h5"), "--model", str(model), "--json"]) == 0
    generate(known[1], tmp_path / "data", 64, seed=12)
    assert run(["train", str(tmp_path / "data"), "--set", "start_error=2 %", "-o", str(tmp_path / "other.npz")]) != 0
    assert "start_error must be left out" in capsys.readouterr().err


@pytest.mark.long
def test_a_beam_one_per_cent_off_that_nobody_has_learned():
    """Trained on simulations through drawn modes: .77 on five beams; without their errors as noise .715."""
    scene = load_scene("tail_beam")
    stated, truth = uncertain(scene, 0.01), modes_off(scene, 0.01, 0.1, seed=21)[0]
    model = train_on_specimens(synthesise(stated, 4000, 31), beam=beam_of(stated)).model
    rows = measure(synthesise(truth, 1024, 32), model.measured, beam=model.beam.beam)
    likely = model.probabilities(rows.features[:, : len(model.features)])
    right = np.mean(model.decide(likely) == rows.labels)
    assert right > 0.74
    assert abs(right - likely.max(axis=1).mean()) < 0.04
    assert np.median(rows.columns(BEAM_GUARDS)) < 0.5


def test_usable_impacts_stand_alone(known):
    rng = np.random.default_rng(0)
    blows = known[3][:6, BEFORE:]
    silence = [rng.normal(0, 0.5, 4000) for _ in range(7)]
    detector = ImpactDetector(RATE, kind="vibration")
    stream = np.concatenate([part for pair in zip(silence, [*blows, np.zeros(0)], strict=True) for part in pair])
    events = detector.feed(stream[None]) + detector.finish()
    kept, lost = usable_impacts(events)
    assert len(kept) >= 4 and len(kept) + sum(lost.values()) == len(events)
    # Ended or not, one is not alone if the next is in the stretch that is compared.
    first = replace(kept[0], overlapping=False)
    for gap, n in ((0.02, 1), (0.03, 2)):
        kept, lost = usable_impacts([first, replace(first, onset=first.onset + round(gap * RATE))])
        assert len(kept) == n and lost["overlapping"] == 2 - n and kept[-1].onset > first.onset
    detector = ImpactDetector(RATE, kind="vibration")
    events = detector.feed(np.clip(stream, *np.quantile(stream, [0.01, 0.99]))[None]) + detector.finish()
    kept, lost = usable_impacts(events)
    assert len(kept) + lost["clipped"] == len(events) and lost["clipped"] >= 4


# -- what cannot be calibrated ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "rate", "error", "says"),
    [
        (lambda: load_scene("reference"), 2e5, InvalidValue, "tail_beam"),
        (panel, 12_800.0, BadData, "sampled at 6400 Hz"),
        (lambda: panel(edges="cantilever", sensor_point={"x": 1e-4, "y": 0.2}), RATE, InvalidValue, "node"),
        (lambda: tapped(20.0), RATE, InvalidValue, "lowest mode at 4200 Hz; record faster"),
    ],
)
def test_scenes_that_cannot_be_calibrated(scene, rate, error, says):
    with pytest.raises(error, match=says):
        check_scene(scene(), rate)


def test_clipped_blows_teach_nothing(known):
    scene, _, _, blows = known
    limit = 0.1 * np.abs(blows).max(axis=1, keepdims=True)
    clipped = np.clip(blows, -limit, limit)
    with pytest.raises(BadData, match=r"at least 20 to learn from, got 0 and 60 clipped ones; .*below the sensor"):
        calibrate(scene, clipped, RATE, BEFORE)
    with pytest.raises(BadData, match="got 19 and 40 clipped ones"):
        calibrate(scene, np.concatenate([blows[:19], clipped[20:]]), RATE, BEFORE)


@pytest.mark.long
def test_blows_in_coloured_noise_teach(known):
    """The colour before touch, where it is known, does not bias the modes, and the evidence stays what it should be."""
    content = json.loads(known[0].text)
    content["sampling"] |= {"samples": 640, "pre_trigger": 192}
    content["sensor"].pop("noise_density")
    content["sensor"] |= {"relative_noise": 0.05, "noise_exponent": 1.0}
    scene = parse_scene(content)
    site, error = modes_off(scene, 0.01, 0.1, seed=3)
    found = calibrate(scene, frames(site, 100, seed=8), RATE, 192)
    after = np.log(found.learned.frequency / site.tail_beam.learned_modes.frequency)
    heard = beam_modes(scene).frequency < 2000
    assert np.median(np.abs(after[heard])) < 0.1 * np.median(np.abs(error[0, heard]))
    assert np.mean(np.abs(after[heard]) < 3 * found.learned.deviation[0][heard]) > 0.85
    assert found.has_converged and abs(found.after - found.expected) < 0.05


@pytest.mark.long
def test_onsets_that_low_frequencies_tell_too_early_are_found():
    """A beam explains strong impacts only from the sample at which they begin, wherever a detector puts it."""
    content = json.loads(load_scene("tail_beam").text)
    content["sensor"] |= {"noise_density": 5e-3, "bits": 24}
    rocks = {"duration": 24.0, "arrivals": {"rate": 3.0}, "mixture": {"times": [0.0], "gangue": [0.5]}}
    content |= {"sampling": {"sampling_rate": 25600.0}, "stream": rocks}
    scene = parse_scene(content)
    detector = ImpactDetector(25600.0, kind="vibration")
    kept, _ = usable_impacts(detector.feed(record(scene, seed=4)[0].samples[None]) + detector.finish())
    beam, impacts = exact(beam_of(scene)), prepare_impacts(frames_of(kept)[0], 25600.0, kept[0].pre_trigger)
    inversion, heard = Inversion(beam), impacts.observations()
    first, found = inversion.invert(heard, impacts.start), inversion.settle(heard, impacts.start)
    assert len(kept) > 30 and (found.evidence >= first.evidence).all()
    assert np.mean(first.misfit < 1.3) < 0.65 < 0.85 < np.mean(found.misfit < 1.3)


def test_weights_whiten_the_noise():
    """Noise of a known autoregression has the same power at every frequency once it is weighed."""
    from scipy.signal import lfilter

    from cgid.measure.fit.ar_noise import ORDER, ARNoise

    rng, own = np.random.default_rng(2), np.zeros(ORDER)
    own[:2] = 1.2, -0.5
    noise = lfilter([1.0], [1, *-own], rng.normal(0, 3.0, (400, 2000)), axis=1)
    beam = beam_of(panel())
    inversion = Inversion(beam)
    level = np.full(400, noise.std())
    colour = ARNoise(np.tile(own, (400, 1)), np.full(400, 3.0))
    part = noise[:, 1000 : 1000 + inversion.n_samples]
    blows = ImpactFrames(part, np.zeros((400, 2), np.intp), level, colour, part.shape[1])
    power = np.square(inversion.transformed(part / level[:, None])).mean(axis=0)
    weighed = power * blows.weight(inversion)[0]
    half = weighed.size // 2
    assert power[:half].max() > 10 * power[:half].min()
    low, high = weighed[: half // 2], weighed[half // 2 : half]
    # The end of the window leaks a tenth of the loud half into the quiet one.
    assert low.mean() == pytest.approx(1, abs=0.05) and high.mean() == pytest.approx(1, abs=0.15)


# -- a table of measured modes instead of a panel ----------------------------------------------------------


def tapped(factor):
    """A scene of four modes of a tap test, their frequencies times a factor."""
    content = json.loads(panel().text)
    rows = zip((210.0, 340.0, 560.0, 905.0), (0.02, 0.015, 0.03, 0.02), (210, 180, 240, 160), strict=True)
    content["tail_beam"] = {
        "modes": [
            {
                "frequency": f * factor,
                "damping_ratio": zeta,
                "modal_mass": mass,
                "shape_impact": 0.8,
                "shape_sensor": 0.6,
            }
            for f, zeta, mass in rows
        ]
    }
    return parse_scene(content)


def test_modes_of_a_tap_test_are_followed():
    found = calibrate(tapped(1.0), frames(tapped(1.008), 40, seed=3), RATE, BEFORE)
    error = np.abs(np.log(found.learned.frequency / (1.008 * beam_modes(tapped(1.0)).frequency)))
    assert (error < 2e-3).all() and (error < 4 * found.learned.deviation[0]).all()
    assert np.array_equal(beam_modes(found.scene).frequency, np.sort(found.learned.frequency))


def test_measured_modes_must_not_cross():
    scene = tapped(1.0)
    own = beam_modes(scene)
    modes = Modes.relative(own.frequency, own.damping_ratio, np.ones(4))
    crossed = replace(modes, frequency=modes.frequency[[1, 0, 2, 3]])
    with pytest.raises(BadData, match="modes 1 and 2 must not cross"):
        count_crossings(scene, crossed)
    assert count_crossings(scene, replace(crossed, deviation=np.full((3, 4), 0.3))) == 0  # not known to have


@pytest.mark.long
def test_a_recording_calibrates_the_scene_of_a_stream(known, tmp_path):
    """Its rocks bounce all over the beam and ring into each other; the frames of a detector are compared with such."""
    content, (site, error) = json.loads(known[0].text), modes_off(known[0], 0.01, 0.1, seed=3)
    rocks = {"duration": 16.0, "arrivals": {"rate": 4.0}, "mixture": {"times": [0.0], "gangue": [0.5]}}
    more = {"stream": rocks | {"rebounds": {"most": 2, "least_speed": 0.2}}, "sampling": {"sampling_rate": RATE}}
    signal, _ = record(parse_scene(json.loads(site.text) | more), seed=4)
    np.save(tmp_path / "stream.npy", signal.samples)
    (tmp_path / "stream.toml").write_text(toml(content | more))
    (tmp_path / "face.toml").write_text(f'[recorder]\nrate = {RATE:g}\nunit = "{signal.unit}"\n')
    command = ["calibrate", str(tmp_path / "stream.npy"), "--site", str(tmp_path / "face.toml")]
    output = tmp_path / "site.toml"
    assert run([*command, "--scene", str(tmp_path / "stream.toml"), "-o", str(output)]) == 0
    found = load_scene(output)
    assert json.loads(found.text)["stream"] == json.loads(load_scene(tmp_path / "stream.toml").text)["stream"]
    assert json.loads(found.text)["tail_beam"]["impact_point"] == content["tail_beam"]["impact_point"]
    heard = beam_modes(site).frequency < 2000
    left = np.log(found.tail_beam.learned_modes.frequency / beam_modes(site).frequency)
    assert np.median(np.abs(left[heard])) < 0.3 * np.median(np.abs(error[0][heard]))


# -- the sensor and its recorder ----------------------------------------------------------------------------


def recorded_otherwise(scene, **sensor):
    content = json.loads(scene.text)
    for part, changes in sensor.items():
        content["sensor"][part] = (content["sensor"].get(part) or {}) | changes
    return parse_scene(content)


def test_a_wrong_filter_is_corrected(known):
    """A filter at 1500 Hz in place of 2000 leaves nothing unexplained, but forces that no contact has."""
    scene = known[0]
    truth, _ = modes_off(recorded_otherwise(scene, anti_alias={"frequency": 1500.0, "order": 6}), 0.01, 0.1, seed=3)
    blows = frames(truth, 60, seed=12)
    found = calibrate(scene, blows, RATE, BEFORE)
    assert found.scene.sensor.anti_alias.frequency == pytest.approx(1500, rel=0.03)
    assert found.scene.sensor.anti_alias.order in (5, 6, 7)
    assert found.chain["anti_alias.frequency"][0] == pytest.approx(2000)
    assert found.outside < 0.02
    # As stated it is refused, or explains less.
    with pytest.raises(BadData, match=r"shape of contacts|must explain"):
        calibrate(scene, blows[:30], RATE, BEFORE, exact=("filter", "mounting"))


@pytest.mark.long
def test_a_filter_of_linear_phase_is_looked_through(known):
    """It leaves as little unexplained as any, and forces have the shape of contacts, whatever its delay."""
    content = json.loads(known[0].text)
    content["sensor"]["anti_alias"] = {"frequency": 2500.0, "kind": "linear-phase", "transition": 0.3}
    scene = parse_scene(content)
    batch = next(iter(synthesise(scene, 60, 12)))
    estimate, contact = ThroughBeam(beam_of(scene)).look(VibrationBatch(batch.signals, RATE, BEFORE))
    assert np.median(np.abs(estimate.x - batch.parameters["impact_x"])) < 2e-3
    assert np.median(estimate.unexplained) < 1e-3 and np.nanmedian(contact.outside) < 0.02
    off = np.log(contact.peak / batch.parameters["peak_force"])
    assert np.median(np.abs(off)) < 0.08  # .06 through a Butterworth filter of order 4
    # Its delay is kept in a model file as far as the table of forces has room.
    beam = beam_of(scene)
    again = type(beam).from_arrays(beam.arrays)
    assert np.array_equal(again.linear_phase, beam.linear_phase) and again.delay < scene.sensor.filters[0].delay


def test_noise_behind_a_filter_of_linear_phase_is_that_of_its_band(known):
    """Noise has passed the filter, which rings before each impact: the samples there are no noise."""
    content = json.loads(known[0].text)
    content["sensor"]["anti_alias"] = {"frequency": 1600.0, "kind": "linear-phase", "transition": 0.3}
    taps = signal.firwin(65, 0.5, window=("kaiser", 9.0))
    rows = signal.fftconvolve(np.random.default_rng(1).normal(size=(200, 512)), taps[None], mode="same", axes=1)
    rows[:, BEFORE - 16 :] += 30 * np.sin(np.arange(512 - BEFORE + 16))
    own = prepare_impacts(rows, RATE, BEFORE)
    assert np.median(own.noise) > 5
    behind = own.behind(beam_of(parse_scene(content)))
    assert np.sqrt(np.mean(behind.noise**2)) == pytest.approx(
        1.0, rel=0.05
    )  # half of its power is left, in half the band
    assert not behind.colour.rows.size and (behind.start[:, 0] < own.start[:, 0]).all()
    assert own.behind(beam_of(known[0])) is own


@pytest.mark.long
@pytest.mark.parametrize(("seed", "rings"), [(8, False), (7, True)])
def test_a_filter_of_linear_phase_at_a_low_rate_is_learned_or_the_line_says_why_not(seed, rings):
    """At 6.4 kHz it rings for longer than a table of forces has room; loud impacts show it."""
    scene, content = panel(), json.loads(panel().text)
    content["sensor"].pop("anti_alias")
    content["sampling"] = {"sampling_rate": 2 * RATE, "samples": 1024, "pre_trigger": 2 * BEFORE}
    taps = signal.firwin(129, 0.3, fs=2.0, window=("kaiser", 9.0))
    blows = signal.fftconvolve(frames(parse_scene(content), 40, seed), taps[None], mode="same", axes=1)[:, ::2]
    options = {"exact": ("sensor", "mounting"), "start_error": 1e-3}
    if rings:
        with pytest.raises(BadData, match=r"rings for .* ms before an impact.*record faster"):
            calibrate(scene, blows, RATE, BEFORE, **options)
        return
    found = calibrate(scene, blows, RATE, BEFORE, **options).scene.sensor.anti_alias
    assert found.kind == "linear-phase" and found.frequency == pytest.approx(0.3 * RATE, rel=0.02)


@pytest.mark.long
def test_a_filter_of_linear_phase_is_learned():
    """The taps are those of scipy, its delay is cut off; the scene has a Butterworth filter."""
    scene = load_scene("tail_beam")
    content = json.loads(scene.text)
    content["sensor"].pop("anti_alias")
    content["sampling"] |= {"sampling_rate": 51_200.0, "samples": 4096, "pre_trigger": 256}
    motion = np.concatenate([batch.signals for batch in synthesise(parse_scene(content), 40, 5)])
    taps = signal.firwin(129, 0.2, fs=1.0, window=("kaiser", 9.0))
    blows = signal.fftconvolve(motion, taps[None], mode="same", axes=1)[:, ::2]
    found = calibrate(scene, blows, 25_600.0, 128, exact=("sensor", "mounting"), start_error=1e-3)
    assert found.scene.sensor.anti_alias.kind == "linear-phase" and found.outside < 0.02
    assert found.scene.sensor.anti_alias.frequency == pytest.approx(10_240, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "n"), [({"thickness": 0.0196}, 30), ({"sensor_point": {"x": 0.34, "y": 0.22}}, 45)]
)
def test_impacts_of_two_beams_are_refused(changes, n):
    """Half of them are of a beam 2 % thinner, or the last quarter of a sensor that was moved by 30 mm."""
    one, other = panel(), panel(**changes)
    both = np.concatenate([frames(one, n, seed=1), frames(other, 60 - n, seed=2)])
    with pytest.raises(BadData, match=r"must explain the impacts .* each part by itself"):
        calibrate(one, both, RATE, BEFORE)


def test_a_sensor_elsewhere_is_found_beside_the_modes(known):
    truth, _ = modes_off(panel(sensor_point={"x": 0.29, "y": 0.235}), 0.01, 0.1, seed=4)
    found = calibrate(known[0], frames(truth, 60, seed=8), RATE, BEFORE)
    point = found.scene.tail_beam.sensor_point
    assert np.hypot(point.x - 0.29, point.y - 0.235) < 1e-3
    assert {one.name for one in found.dimensions} == {"sensor_point.x", "sensor_point.y"}


@pytest.mark.long
def test_sensors_of_one_beam_share_its_modes(known, tmp_path):
    """The first is 20 mm from where it should be, the recorder of the second has another filter."""
    scene, site, _, _ = known
    points, truth = [(0.31, 0.22), (0.6, 0.5)], beam_modes(site).frequency
    first = json.loads(site.text)
    first["tail_beam"]["sensor_point"] = {"x": 0.29, "y": 0.22}
    second = json.loads(site.text)
    second["tail_beam"]["sensor_point"] = {"x": 0.6, "y": 0.5}
    second["sensor"]["anti_alias"] = {"frequency": 1500.0, "order": 6}
    second["tail_beam"]["learned"] = second["tail_beam"]["learned"][:18]
    both = np.stack([frames(parse_scene(one), 48, seed=12) for one in (first, second)], axis=1)
    found = calibrate(scene, both, RATE, BEFORE, sensors=points, exact=("mounting",))
    (other,) = found.others
    for one in (found, other):
        error = np.log(beam_modes(one.scene).frequency[:14] / truth[:14])
        assert np.median(np.abs(error)) < 5e-4
    point = found.scene.tail_beam.sensor_point
    assert np.hypot(point.x - 0.29, point.y - 0.22) < 1e-3
    assert not found.chain and not other.dimensions
    assert other.scene.sensor.anti_alias.frequency == pytest.approx(1500, rel=0.03)
    # Each has a scene of its own.
    found.save(tmp_path / "site.toml")
    assert [load_scene(tmp_path / name).text for name in ("site.toml", "site-2.toml")] == [
        found.scene.text,
        other.scene.text,
    ]
    with pytest.raises(BadData, match="same impacts"):  # other impacts, as of another beam
        others = np.stack([both[:, 0], np.roll(both[:, 0], 1, axis=0)], axis=1)
        calibrate(scene, others, RATE, BEFORE, sensors=points, exact=("sensor", "filter", "mounting"))


def test_frames_of_several_sensors_need_their_points(known):
    scene, blows, points = known[0], np.stack([known[3]] * 2, axis=1), [(0.31, 0.22), (0.6, 0.5)]
    with pytest.raises(InvalidValue, match="give sensors"):
        calibrate(scene, blows, RATE, BEFORE)
    with pytest.raises(InvalidValue, match="frames must be of shape"):
        calibrate(scene, known[3], RATE, BEFORE, sensors=points)
    with pytest.raises(InvalidValue, match="participation_error"):
        calibrate(scene, blows, RATE, BEFORE, sensors=points, participation_error=0.1)


def test_what_is_as_stated_stays(known, found):
    """No sound scene gets another sensor or recorder."""
    assert found.scene.sensor == known[0].sensor and not found.chain and not found.dimensions
    assert found.scene.tail_beam.sensor_point == known[0].tail_beam.sensor_point
    assert found.outside < 0.02


def test_parts_that_are_exact_are_named(known):
    with pytest.raises(InvalidValue, match="exact"):
        calibrate(known[0], known[3], RATE, BEFORE, exact=("filters",))


@pytest.mark.parametrize(
    ("later", "places", "told"),
    [
        (-2.0, "from 40 % on", True),
        (-2.0, "up to 30 %", True),
        (-2.0, "here and there", False),  # a poor beam, no change
        (-0.8, "from 40 % on", False),  # a little worse, as in other noise
        (-0.6, "from 40 % on", False),
    ],
)
def test_impacts_of_two_beams_are_told_by_their_order(later: float, places: str, *, told: bool) -> None:
    """Some impacts have the log-likelihood `later`; simulated ones have -.6, and those of a foreign beam -1 or less."""
    rng, number = np.random.default_rng(5), np.arange(120)
    where = {"from 40 % on": number >= 48, "up to 30 %": number < 36, "here and there": rng.random(120) < 0.4}
    evidence = np.where(where[places], later, -0.6) + rng.normal(0, 0.03, 120)
    one = SimpleNamespace(impacts=number, evidence=evidence, worst=0.2)
    assert _Sensor._changes_within(one, -0.7, -1.0) is told  # type: ignore[arg-type]
