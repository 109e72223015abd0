"""Forces recovered through a table of modes, beside the forces of recordings that cgid has not made."""

import csv
import json
import re

import numpy as np
import pytest

from cgid.calibration import forces_in, tap_test
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.identification.inversion.recovered import RecoveredForce, errors_of, recover_force
from cgid.measure.modal.modes import Modes, read_modes
from cgid.scene import generate
from cgid.store import Dataset
from tests.tapped import DAMPING, FREQUENCY, PARTICIPATION, taps

RATE = 25_600.0


def modes_of(participation=PARTICIPATION):
    return Modes(
        frequency=FREQUENCY,
        damping_ratio=DAMPING,
        at_impact=np.ones_like(participation),
        at_sensor=participation,
        deviation=np.full((3, FREQUENCY.size), 0.01),
    )


@pytest.fixture(scope="module")
def recorded():
    return taps(3, gap=0.6, seed=1)


def test_force_and_its_deviations(recorded):
    """Half sines of .6 ms, through ten modes up to 1.7 kHz."""
    response, force, times = recorded
    found = recover_force(response[None], RATE, modes_of(), times)
    assert len(found) == 3
    for one in found:
        errors = errors_of(one, force, RATE)
        assert errors["force"] < 0.08
        assert abs(errors["peak"]) < 0.05
        assert abs(errors["impulse"]) < 0.03
        assert abs(errors["duration"]) < 0.1
        assert one.unexplained < 0.02
        assert abs(errors["peak"]) < 3 * one.peak[1] / one.peak[0]
        assert one.peak[1] < 0.2 * one.peak[0]
        assert abs(errors["impulse"]) < 3 * one.impulse[1] / one.impulse[0]


@pytest.mark.parametrize("width", [0.15e-3, 0.25e-3, 0.35e-3, 0.5e-3, 0.8e-3, 2.5e-3, 4.5e-3])
def test_deviations_know_what_lies_above_the_band(width):
    """It ends at 1.87 kHz: of contacts below .3 ms it shows the impulse, and they look as short as it can."""
    response, force, times = taps(4, gap=0.6, seed=3, width=width)
    for one in recover_force(response[None], RATE, modes_of(), times):
        errors = errors_of(one, force, RATE)
        assert abs(errors["peak"]) < 2 * one.peak[1] / one.peak[0] or one.duration < one.shortest
        assert abs(errors["impulse"]) < 3 * one.impulse[1] / one.impulse[0]
        assert one.duration > one.shortest or width < 0.4e-3


def test_the_band_of_the_taps_is_that_of_their_table(tmp_path):
    """Three modes of ten lie above it; in the range of the others a table has no more of them than its lines."""
    response, force, _ = taps(4, seed=5, width=1.5e-3)
    test = tap_test(response[None], RATE, hammer=force, band=(60.0, 1100.0))
    modes = read_modes(test.save(tmp_path / "modes.csv"))
    assert modes.band == test.response.band == (60.0, 1100.0)
    again, _, times = taps(3, seed=6, width=1.5e-3)
    for one in recover_force(again[None], RATE, modes, times):
        assert abs(errors_of(one, taps(3, seed=6, width=1.5e-3)[1], RATE)["peak"]) < 0.1
        assert one.unexplained < 0.05
    text = (tmp_path / "modes.csv").read_text()
    (tmp_path / "wrong.csv").write_text(text.replace("1100.0", "50.0"))
    with pytest.raises(BadData, match="band_low"):
        read_modes(tmp_path / "wrong.csv")


def test_its_text_has_no_matrix() -> None:
    force = RecoveredForce(time=np.arange(3.0), force=np.ones(3), covariance=np.eye(3), unexplained=0.1)
    assert "covariance" not in repr(force) and "unexplained=0.1" in repr(force)


def test_an_onset_a_millisecond_late_gives_the_same_force(recorded):
    response, _, times = recorded
    found = recover_force(response[None], RATE, modes_of(), times)
    for first, other in zip(found, recover_force(response[None], RATE, modes_of(), times + 0.8e-3), strict=True):
        assert other.peak[0] == pytest.approx(first.peak[0], rel=0.03)
        assert abs(round((other.time[np.argmax(other.force)] - first.time[np.argmax(first.force)]) * RATE)) <= 1


def test_two_sensors_are_inverted_together():
    other = PARTICIPATION * np.cos(np.arange(FREQUENCY.size))
    first, force, times = taps(1, seed=2)
    second = taps(1, seed=2, modes=(FREQUENCY, DAMPING, other))[0]
    found = recover_force(np.stack([first, second]), RATE, [modes_of(), modes_of(other)], times)[0]
    assert errors_of(found, force, RATE)["force"] < 0.08
    with pytest.raises(InvalidValue, match="one table for each channel"):
        recover_force(np.stack([first, second]), RATE, modes_of(), times)


def test_a_hammer_on_another_clock_is_compared_where_it_fits(recorded):
    response, force, times = recorded
    found = recover_force(response[None], RATE, modes_of(), times)[0]
    here, later = errors_of(found, force, RATE), errors_of(found, np.roll(force, 10), RATE)
    assert later["delay"] - here["delay"] == pytest.approx(10 / RATE, abs=0.1 / RATE)
    assert later["force"] == pytest.approx(here["force"], abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"band": (900.0, 100.0)}, "band must be two ascending"),
        ({"band": (100.0, 20_000.0)}, "0.49 of the sampling rate"),
        ({"band": (2_000.0, 5_000.0)}, "band must contain a mode"),
        ({"contact": -1.0}, "contact"),
        ({"onsets": [0.4, 0.42]}, "leave more time between impacts"),
    ],
)
def test_what_cannot_be_inverted_is_refused(recorded, options, message):
    response, _, times = recorded
    onsets = options.pop("onsets", times)
    with pytest.raises((BadData, InvalidValue), match=message):
        recover_force(response[None], RATE, modes_of(), onsets, **options)


def test_an_impact_without_vibration_costs_its_own_row_alone(recorded):
    """The recording ends just behind the last tap; its stretch begins 10 s into it."""
    response, _, times = recorded
    span = (round(10 * RATE), response[None, : round((times[-1] + 0.03) * RATE)], None, True)
    told: list[str] = []
    found = list(forces_in([span], RATE, modes_of(), told=told.append))
    np.testing.assert_allclose([one.found.time[0] for one in found], 10 + times[:2], atol=1e-3)
    assert len(told) == 1
    assert f"impact at {10 + times[2]:.4g} s" in told[0]
    with pytest.raises(BadData, match=f"impact at {10 + times[2]:.4g} s"):
        list(forces_in([span], RATE, modes_of()))


def test_command(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    response, force, _ = recorded
    rows = np.stack([response, force], axis=1)
    head = f"# sampling_rate: {RATE:g} Hz\nacceleration [m/s^2],force [N]"
    np.savetxt("taps.csv", rows, "%.7g", ",", header=head, comments="")
    assert run(["tap", "taps.csv", "--hammer", "2", "-o", "modes.csv", "--band", "60", "2000"]) == 0
    given = ["invert", "taps.csv", "--modes", "modes.csv", "-o", "forces.csv"]
    capsys.readouterr()
    assert run([*given, "--hammer", "2"]) == 0
    assert capsys.readouterr().out.count("beside the measured force") == 3
    table = list(csv.DictReader((tmp_path / "forces.csv").read_text().splitlines()))
    measured, found = (np.array([float(row[name]) for row in table]) for name in ("measured [N]", "force [N]"))
    assert np.linalg.norm(found - measured) < 0.1 * np.linalg.norm(measured)
    assert {row["impact"] for row in table} == {"1", "2", "3"}
    assert run([*given, "--channel", "1", "--json", "--overwrite"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert len(content["impacts"]) == 3
    assert not any(one["clipped"] for one in content["impacts"])
    for one in content["impacts"]:
        assert one["peak"] == pytest.approx(force[round(one["time"] * RATE) :][:200].max(), rel=0.05)
    limit = 0.4 * np.abs(response).max()
    rows = np.stack([np.clip(response, -limit, limit), force], axis=1)
    np.savetxt("clipped.csv", rows, "%.7g", ",", header=head, comments="")
    assert run(["invert", "clipped.csv", "--modes", "modes.csv", "--channel", "1"]) == 0
    assert "the response is clipped" in capsys.readouterr().err


@pytest.fixture
def beam_frames(tmp_path, monkeypatch):
    """Twelve impacts on the beam of a scene, as a dataset and one after the other."""
    monkeypatch.chdir(tmp_path)
    generate("tail_beam", "frames.h5", 12)
    dataset = Dataset("frames.h5")
    np.savez("recording.npz", x=np.concatenate([dataset.signal(number).samples for number in range(12)]))
    return dataset


def test_impacts_that_are_left_out_are_told(beam_frames, capsys):
    """The fifth is weak beside what still rings, and could be a beat."""
    given = ["recording.npz", "--rate", f"{beam_frames.sampling_rate:g}", "--unit", "m/s^2"]
    assert run(["invert", *given, "--scene", "tail_beam", "--json"]) == 0
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert len(content["impacts"]) == 11
    (why,) = content["left_out"]
    assert re.search(r"impact at 0\.325\d* s: must stand out 3-fold", why)
    assert why in err and "1 of 12 impacts left out" in err


def test_a_signal_of_a_dataset_is_inverted(beam_frames, capsys):
    """It is a recording of one impact, whose place and peak the dataset knows."""
    given = ["invert", "frames.h5", "--scene", "tail_beam"]
    assert run([*given, "--set", "index=3", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["impacts"]
    truth = beam_frames.impact(3).parameters
    for name, true in ("x", "impact_x"), ("y", "impact_y"), ("peak", "peak_force"):
        assert found[name] == pytest.approx(truth[true][0], abs=4 * found[f"{name}_deviation"])
    for wrong, says in ([], "index must"), (["--set", "index=3", "--hammer", "1"], "--hammer must be left out"):
        assert run([*given, *wrong]) == 65
        assert says in capsys.readouterr().err
