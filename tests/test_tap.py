"""`cgid tap`: modes from taps on beams whose modes are known, recorded without cgid."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from cgid.calibration import Flaw, tap_test
from cgid.calibration.agreement import shifted
from cgid.calibration.matching import matched
from cgid.calibration.poles import poles_of
from cgid.calibration.splice import Splice, moved, spans_of
from cgid.cli.main import run
from cgid.errors import BadData
from cgid.identification.inversion.recovered import errors_of, recover_force
from cgid.measure.modal.modes import LEARNED_COLUMNS, Modes, read_modes
from cgid.physics.structure.response import Response
from cgid.scene import load_scene
from cgid.scene.synthesis.impacts import beam_modes
from cgid.shipped import scene_path
from tests.tapped import DAMPING, FLAWS, FREQUENCY, PARTICIPATION, flawed, taps

RATE = 25_600.0
BAND = (60.0, 2000.0)


def scores(test):
    """Return the errors of ln frequency and ln damping ratio of each true mode, over their stated deviations."""
    near = np.abs(np.log(test.modes.frequency[:, None] / FREQUENCY)).argmin(axis=0)
    assert np.unique(near).size == FREQUENCY.size
    errors = np.log([test.modes.frequency[near] / FREQUENCY, test.modes.damping_ratio[near] / DAMPING])
    return (
        errors,
        errors
        / np.array(
            [test.modes.columns["frequency_deviation"][near], test.modes.columns["damping_ratio_deviation"][near]]
        ),
        near,
    )


@pytest.fixture(scope="module")
def hammered():
    response, force, _ = taps(4, gap=0.7, seed=1)
    return tap_test(response[None], RATE, hammer=-force, band=BAND)


def test_modes_and_participations_of_an_instrumented_hammer(hammered):
    errors, ratios, near = scores(hammered)
    assert hammered.modes.frequency.size == FREQUENCY.size
    assert np.abs(errors[0]).max() < 1e-4
    assert np.abs(errors[1]).max() < 1e-2
    assert np.abs(ratios).max() < 4
    np.testing.assert_allclose(hammered.modes.participation()[near], PARTICIPATION, rtol=0.01)
    assert hammered.modes.scaled


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_deviations_cover(noise):
    every = []
    for seed in range(3):
        response, _, _ = taps(4, gap=0.7, seed=seed, noise=noise)
        every.append(scores(tap_test(response[None], RATE, band=BAND))[1])
    ratios = np.array(every)
    assert 0.6 < np.sqrt(np.mean(ratios**2)) < 1.4
    assert np.mean(np.abs(ratios) < 1.96) > 0.85


def test_a_single_mode_is_known_as_well_as_cramer_and_rao_allow():
    """For A exp(-s t) cos(w t) in white noise both parts of the pole have the variance 16 s^3 noise^2 step / A^2."""
    rng, times = np.random.default_rng(3), np.arange(round(RATE)) / RATE
    pole, noise = -12.0 + 2j * np.pi * 430, 0.05
    decays = np.stack([np.exp(pole * times).real, 0.5 * np.exp(pole * times + 1j).real])
    decays += rng.normal(0, noise, decays.shape)
    found = poles_of(decays, RATE, (300.0, 600.0), 10)
    bound = np.sqrt(16 * 12.0**3 * noise**2 / RATE / 1.25)
    assert found.pole.size == 1
    assert 0.8 * bound < found.deviation[1, 0] * 12 < 2 * bound
    assert 0.8 * bound < found.deviation[0, 0] * abs(pole) < 2 * bound
    assert abs(found.pole[0] - pole) < 4 * bound
    np.testing.assert_allclose(np.abs(found.amplitude[:, 0]), [1, 0.5], atol=5 * found.amplitude_deviation.max())


def test_without_a_hammer_channel_the_poles_are_the_same(hammered):
    response, _, _ = taps(4, gap=0.7, seed=1)
    test = tap_test(response[None], RATE, band=(BAND[0], 560.0))
    assert not test.modes.scaled
    assert test.modes.participation().max() == pytest.approx(1, abs=0.2)
    assert test.modes.participation().min() > 0
    np.testing.assert_allclose(test.modes.frequency, hammered.modes.frequency[:5], rtol=1e-4)


def test_flawed_taps_are_left_out_and_named():
    response, force, times = taps(5, seed=2, also=((1, 0.05, 0.8), (3, 0.75, 1.0)))
    first = round(times[2] * RATE)
    response[first : first + 2000] *= 4
    response = np.clip(response, -1.2 * np.abs(response[:first]).max(), 1.2 * np.abs(response[:first]).max())
    for hammer in (None, force):
        test = tap_test(response[None], RATE, hammer=hammer, band=(90.0, 150.0))
        flaws = {tap.flaw: tap.reason for tap in test.taps}
        assert flaws.keys() == {None, Flaw.DOUBLE, Flaw.BEFORE_NEXT, Flaw.CLIPPED}
        assert re.fullmatch(r"double tap, another impact follows .*", flaws[Flaw.DOUBLE])
        assert re.fullmatch(r"too close to the next tap, .* s where .* s are needed", flaws[Flaw.BEFORE_NEXT])
        assert (flaws[None], flaws[Flaw.CLIPPED]) == ("", "clipped")
        assert np.abs(np.log(test.modes.frequency[:1] / FREQUENCY[0])).max() < 1e-3


def _all_with(flaw):
    """Return a recording of two taps that both have a flaw, or are not listed, and options to read it."""
    response, hammer, times = taps(2, gap=0.7, seed=2)
    first, second = (round(time * RATE) for time in times)
    match flaw:
        case Flaw.CUT_OFF:
            part = slice(first + 2, second - 500)
            return response[part], {"hammer": hammer[part]}
        case Flaw.DOUBLE:
            response, hammer, times = taps(2, gap=0.7, seed=2, also=((0, 0.05, 0.8), (1, 0.05, 0.8)))
            return response, {"hammer": hammer, "times": times.tolist()}
        case Flaw.CLIPPED:
            limit = 0.3 * min(np.abs(response[at : at + 500]).max() for at in (first, second))
            return np.clip(response, -limit, limit), {"hammer": hammer}
        case Flaw.BEFORE_NEXT:
            response, _, times = taps(2, gap=0.12, seed=2)
            return response, {"times": times[:1].tolist(), "contact": times[1] - times[0] - 0.02}
        case Flaw.BEFORE_END:
            return response[: first + 500], {"hammer": hammer[: first + 500]}
        case Flaw.NOT_LISTED:
            return response, {"hammer": hammer, "times": []}


CURES = [
    (Flaw.CUT_OFF, "record again, some samples before a tap"),
    (Flaw.DOUBLE, "tap again, and lift the hammer at once"),
    (Flaw.CLIPPED, "record with a larger range, or tap more gently"),
    (Flaw.BEFORE_NEXT, "leave a second or more between taps"),
    (Flaw.BEFORE_END, "leave a second or more after the last tap"),
    (Flaw.NOT_LISTED, "add other taps to the table"),
]


@pytest.mark.parametrize(("flaw", "cure"), CURES)
def test_each_flaw_of_all_taps_has_its_cure(flaw, cure):
    response, options = _all_with(flaw)
    with pytest.raises(BadData) as error:
        tap_test(response[None], RATE, band=BAND, **options)
    _, listed, *cures = re.split("; |usable, ", str(error.value))
    assert re.search(rf": (\d .*, )?\d {flaw}", listed)
    assert cure in cures


def test_no_flaw_is_without_a_case():
    """Two taps agree or not: neither is the one that the others do not explain, or that is elsewhere."""
    assert {flaw for flaw, _ in CURES} == set(Flaw) - {Flaw.UNEXPLAINED, Flaw.ELSEWHERE}


@pytest.mark.long
def test_scatter_from_tap_to_tap_is_in_the_participations():
    response, force, _ = taps(8, seed=5, spread=0.05)
    test = tap_test(response[None], RATE, hammer=force, band=BAND)
    near = scores(test)[2]
    assert 0.008 < np.median(test.modes.columns["participation_deviation"]) < 0.04
    off = np.log(test.modes.participation()[near] / PARTICIPATION) / test.modes.columns["participation_deviation"][near]
    assert np.sqrt(np.mean(off**2)) < 2


def test_the_table_is_one_of_a_scene(hammered, tmp_path, capsys):
    path = hammered.save(tmp_path / "modes.csv")
    modes, learned = read_modes(path), read_modes(path, LEARNED_COLUMNS)
    every = hammered.response
    np.testing.assert_allclose(modes.participation(), every.participation())
    np.testing.assert_array_equal(learned.deviation, every.deviation)
    assert (learned.participation() == 1).all()
    lines = path.read_text().splitlines()
    place = lines[1].split(",").index("participation [1/kg]")
    written = [float(line.split(",")[place]) for line in lines[2:]]
    np.testing.assert_allclose(written, every.participation())
    text = scene_path("tail_beam").read_text()
    start, stop = text.index("[tail_beam]"), text.index("[sampling]")
    beam = '[tail_beam]\nmodes = "modes.csv"\nlearned = "modes.csv"\n\n'
    (tmp_path / "support.toml").write_text(text[:start] + beam + text[stop:])
    scene = load_scene(tmp_path / "support.toml")
    np.testing.assert_allclose(beam_modes(scene).frequency, every.frequency)
    np.testing.assert_allclose(beam_modes(scene).participation(), every.participation())
    with pytest.raises(OSError, match="overwrite=True"):
        hammered.save(path)
    assert run(["check", str(tmp_path / "support.toml")]) == 0
    assert "modes of one place: only impacts there" in capsys.readouterr().err
    assert run(["train", str(tmp_path / "support.toml"), "-n", "1", "-o", str(tmp_path / "m.npz")]) != 0
    assert "modes of one place: only impacts there" in capsys.readouterr().err


def test_stretches_of_a_recording_overlap_and_cover_it():
    samples = np.arange(2 * 1000.0).reshape(2, 1000)
    blocks = np.split(samples, [7, 130, 131, 640], axis=1)
    found = list(spans_of(blocks, 300, 50))
    assert [last for _, _, last in found] == [False] * (len(found) - 1) + [True]
    assert [first for first, _, _ in found] == [250 * k for k in range(len(found))]
    for first, part, _ in found:
        np.testing.assert_array_equal(part, samples[:, first : first + 300])
    assert found[-1][0] + found[-1][1].shape[1] == 1000


def test_taps_of_a_long_recording_are_those_of_a_short_one():
    """Three taps twice, with a minute between them; stretches of 12 s end between and within taps."""
    response, force, times = taps(3, gap=0.7, seed=1)
    gap = round(17 * RATE)
    both = np.zeros((2, 2 * response.size + gap))
    both[0] = np.random.default_rng(0).normal(0, 1e-3 * response.std(), both.shape[1])
    for first in (0, response.size + gap):
        both[:, first : first + response.size] = response, force
    spans = list(spans_of([both], round(12 * RATE), round(Splice.OVERLAP * RATE)))
    splice = Splice(((first, part[:1], part[1], last) for first, part, last in spans), RATE, "long", None)
    assert splice.response.shape[1] < 0.9 * both.shape[1]
    test = tap_test(splice.response, RATE, hammer=splice.force, band=(60.0, 560.0))
    second = (response.size + gap) / RATE
    at = [splice.placed(tap).time for tap in test.taps]
    np.testing.assert_allclose(at, [*times, *(times + second)], atol=2e-3)
    np.testing.assert_allclose(test.modes.participation().real, PARTICIPATION[:5], rtol=0.01)
    np.testing.assert_allclose(splice.inside([at[1], 10.0, at[4]]), [test.taps[1].time, test.taps[4].time])


def test_modes_of_a_scene_are_corrected_where_taps_say_more(hammered):
    """The scene is .6 % too stiff, off by .2 % besides, and has modes that no tap found."""
    rng = np.random.default_rng(4)
    alone = np.delete(np.arange(FREQUENCY.size), [1, 2, 7, 8])
    own = np.sort(np.concatenate([FREQUENCY * 1.006 * np.exp(rng.normal(0, 0.002, FREQUENCY.size)), [330, 560, 900]]))
    start = Modes.relative(own, np.full(own.size, 0.02), np.ones(own.size))
    modes, partner, mac = matched(hammered, start, 0.01)
    known = partner >= 0
    np.testing.assert_allclose(hammered.modes.frequency[partner[known]], modes.frequency[known])
    assert np.isnan(mac).all()  # one place has no shapes
    found = np.log(modes.frequency[known][:, None] / FREQUENCY)
    assert np.abs(found).min(axis=1).max() < 1e-4
    for k in alone:
        assert np.abs(found[:, k]).min() < 1e-4
    assert not known[np.isin(own, [330, 560, 900])].any()
    assert (modes.deviation[0][~known] == 0.01).all()
    assert (modes.deviation[0][known] < 1e-4).all()


def test_a_mode_with_two_partners_is_left_as_it_is(hammered):
    computed = np.append(FREQUENCY, 481.0)
    computed.sort()
    start = Modes.relative(computed, np.full(computed.size, 0.01), np.ones(computed.size))
    known = matched(hammered, start, 0.005)[1] >= 0
    assert known.sum() == FREQUENCY.size - 1
    assert not known[(computed > 470) & (computed < 490)].any()


def recording(path: Path, columns, titles="acceleration [m/s^2],force [N]"):
    text = f"# sampling_rate: {RATE:g} Hz\n{titles}\n"
    path.write_text(text + "\n".join(",".join(f"{value:.6g}" for value in row) for row in np.transpose(columns)))
    return str(path)


def test_command(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    response, force, times = taps(3, gap=0.6, seed=1)
    file = recording(tmp_path / "taps.csv", [response, force])
    (tmp_path / "times.csv").write_text(f"time_s,by\n{times[0]:.2f},me\n{times[2]:.2f},me\n")
    given = ["tap", file, "--hammer", "2", "-o", "modes.csv", "--band", "400", "800"]
    assert run([*given, "--plot", "modes.png"]) == 0
    printed = capsys.readouterr()
    assert "3 of 3 taps used" in printed.out
    assert "1/kg" in printed.out
    assert "cgid: hint:" in printed.err
    assert (tmp_path / "modes.png").read_bytes().startswith(b"\x89PNG")
    table = (tmp_path / "modes.csv").read_bytes()
    assert run([*given, "--taps", "times.csv", "--overwrite", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [tap["used"] for tap in content["taps"]] == [True, False, True]
    assert [tap["flaw"] for tap in content["taps"]][1] == "not in the table of taps"
    assert run([*given, "--overwrite"]) == 0
    assert (tmp_path / "modes.csv").read_bytes() == table


def test_the_modelled_response_is_that_of_the_true_modes(hammered):
    found = hammered.frequency_response
    s, own = 2j * np.pi * found.frequency[:, None], 2 * np.pi * FREQUENCY
    true = (PARTICIPATION * s**2 / (s**2 + 2 * DAMPING * own * s + own**2)).sum(axis=1)
    for values, limit in ((found.measured, 0.1), (found.modelled, 0.02)):
        assert np.linalg.norm(values - true) < limit * np.linalg.norm(true)


def test_channels_of_several_units(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    response, force, _ = taps(3, gap=0.6, seed=1)
    np.save("taps.npy", np.stack([response, force]))
    given = ["tap", "taps.npy", "--rate", f"{RATE:g}", "--unit", "1=m/s^2,2=N", "--hammer", "2", "-o", "modes.csv"]
    assert run([*given, "--band", "60", "2000"]) == 0
    capsys.readouterr()
    assert run([*given, "--overwrite", "--unit", "1=m/s^2"]) != 0
    assert "--unit" in capsys.readouterr().err


def test_a_force_beside_a_response_is_a_hammer(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    response, force, _ = taps(3, gap=0.6, seed=1)
    head = f"# sampling_rate: {RATE:g} Hz\nbeam [m/s^2],the hammer [N]"
    np.savetxt("taps.csv", np.stack([response, force], axis=1), "%.7g", ",", header=head, comments="")
    assert run(["tap", "taps.csv", "-o", "modes.csv"]) == 65
    assert "--hammer 'the hammer'" in capsys.readouterr().err


@pytest.mark.parametrize("constant", [None, 0.12])
def test_modes_of_an_exponential_window_are_said_to_be_none(constant, tmp_path, capsys, monkeypatch):
    """Three are there; a recorder's window begins 20 ms before each tap and makes dozens of the noise."""
    monkeypatch.chdir(tmp_path)
    modes = np.array([[130.0, 410.0, 920.0], [0.006, 0.005, 0.004], [8e-4, -6e-4, 5e-4]])
    response, force, times = taps(6, seed=2, modes=modes, noise=1e-2)
    since = np.arange(response.size) / RATE - times[:, None] + 0.02
    since = np.where(since >= 0, since, np.inf).min(axis=0)
    np.save("taps.npy", np.stack([response * (np.exp(-since / constant) if constant else 1.0), force]))
    given = ["tap", "taps.npy", "--rate", f"{RATE:g}", "--unit", "1=m/s^2,2=N", "--hammer", "2", "-o", "modes.csv"]
    assert run([*given, "--band", "60", "1000"]) == 0
    assert ("window" in capsys.readouterr().err) == bool(constant)


@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_impacts_at_many_places_are_no_taps(spread, tmp_path, capsys, monkeypatch):
    """Modes as strong as at one place to 10 %, and as rocks excite them that fall anywhere."""
    monkeypatch.chdir(tmp_path)
    response, _, _ = taps(8, seed=3, spread=spread)
    np.save("taps.npy", response)
    given = ["tap", "taps.npy", "--rate", f"{RATE:g}", "--unit", "m/s^2", "-o", "modes.csv", "--band", "60", "2000"]
    assert run(given) == 0
    assert ("one place" in capsys.readouterr().err) == (spread == 1.0)


def test_a_tap_at_the_begin_of_a_long_recording_is_kept():
    response, force, times = taps(3, gap=0.6, seed=1)
    first = round((times[0] - 0.02) * RATE)
    both = np.pad(np.stack([response, force])[:, first:], ((0, 0), (0, round(5 * RATE))))
    spans = ((at, part[:1], part[1], last) for at, part, last in spans_of([both], round(4 * RATE), round(2.4 * RATE)))
    splice = Splice(spans, RATE, "long", None, 3)
    test = tap_test(splice.response, RATE, hammer=splice.force, band=BAND)
    np.testing.assert_allclose([splice.placed(tap).time for tap in test.taps], times - first / RATE, atol=2e-3)


@pytest.mark.parametrize("count", [-2100, -3, 0, 5, 700])
def test_blocks_are_moved_whatever_their_lengths(count):
    samples = np.arange(1.0, 2001.0)[None]
    blocks = np.split(samples, [700, 701, 1500], axis=1)
    found = list(moved(blocks, count))
    assert [one.shape[1] for one in found] == [one.shape[1] for one in blocks]
    np.testing.assert_array_equal(np.concatenate(found, axis=1), shifted(samples[0], count)[None])


@pytest.mark.parametrize("late", [-300, 400])
def test_channels_that_begin_at_times_of_their_own_are_moved(late, tmp_path, capsys, monkeypatch):
    """LabVIEW states when each channel begins."""
    monkeypatch.chdir(tmp_path)
    response, force, times = taps(3, gap=0.6, seed=1)
    rows = [f"\t{one!r}\t{two!r}" for one, two in zip(response.tolist(), np.roll(force, -late).tolist(), strict=True)]
    head = [
        "LabVIEW Measurement\t", "Separator\tTab", "X_Columns\tNo", "***End_of_Header***\t", "Channels\t2\t",
        "Date\t2026/03/04\t2026/03/04\t", "Time\t10:11:12\t10:11:12\t", "Y_Unit_Label\tm/s^2\tN\t",
        f"X0\t1\t{1 + late / RATE:.9f}\t", f"Delta_X\t{1 / RATE:.9E}\t{1 / RATE:.9E}\t", "***End_of_Header***\t\t",
        "X_Value\tbeam\thammer\tComment",
    ]  # fmt: skip
    (tmp_path / "taps.lvm").write_text("\n".join([*head, *rows, ""]))
    given = ["tap", "taps.lvm", "--channel", "beam", "--hammer", "hammer", "--band", "60", "560", "-o", "modes.csv"]
    assert run([*given, "--json"]) == 0
    told = capsys.readouterr()
    content = json.loads(told.out)
    assert abs(content["delay"]) < 0.1 / RATE
    assert "begins" in told.err
    np.testing.assert_allclose([tap["time"] for tap in content["taps"]], times, atol=2e-3)


def test_command_with_a_scene_and_one_tap(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    response, _, _ = taps(1, seed=1)
    file = recording(tmp_path / "one.csv", [response], "acceleration [m/s^2]")
    (tmp_path / "scenes").mkdir()
    site, text = tmp_path / "scenes" / "site.toml", scene_path("tail_beam").read_text()
    site.write_text(text)
    assert run(["tap", file, "-o", "learned.csv", "--scene", "scenes/site.toml", "--band", "60", "300"]) == 0
    printed = capsys.readouterr()
    assert "of 188 modes of scenes/site.toml corrected" in printed.out
    assert "cgid: warning: one tap" in printed.err
    # The hint names the table as the scene has to.
    assert printed.err.endswith("cgid calibrate RECORDING --scene scenes/site.toml -o site.toml\n")
    (key,) = re.findall("put (.*) below", printed.err)
    site.write_text(text.replace("[tail_beam]\n", f"[tail_beam]\n{key}\n"))
    assert beam_modes(load_scene(site)).frequency.size == 188


def test_a_hammer_without_a_tap_and_a_tap_that_is_cut_off_are_refused():
    response, force, times = taps(3, gap=0.5, seed=1)
    with pytest.raises(BadData):
        tap_test(response[None], RATE, hammer=np.zeros(response.size))
    half = round((times[2] + 0.6e-3) * RATE)
    with pytest.raises(BadData):
        tap_test(response[None, half:], RATE, hammer=force[half:])


@pytest.mark.parametrize("late", [-400, -2, 3, 512])
def test_a_delay_of_the_hammer_is_corrected_and_told(late):
    response, force, _ = taps(3, gap=0.6, seed=1)
    plain = tap_test(response[None], RATE, hammer=force, band=(60.0, 560.0))
    other = tap_test(response[None], RATE, hammer=shifted(force, late), band=(60.0, 560.0))
    assert abs(plain.delay * RATE) < 0.05
    assert other.delay * RATE == pytest.approx(late, abs=0.05)
    np.testing.assert_allclose(other.modes.participation(), plain.modes.participation(), rtol=2e-3)


def test_delays_that_differ_are_refused():
    response, force, times = taps(3, gap=0.6, seed=1)
    moved = np.zeros_like(force)
    for number, time in enumerate(times):
        first = round(time * RATE) - 100
        moved[first + 6 * number : first + 6 * number + 300] = force[first : first + 300]
    with pytest.raises(BadData, match="delay must be constant"):
        tap_test(response[None], RATE, hammer=moved, band=(60.0, 560.0))


@pytest.mark.parametrize("kind", FLAWS)
def test_a_tap_that_the_others_do_not_explain_is_left_out(kind):
    response, force, times = taps(4, gap=1.2, seed=1)
    first, last = round(times[1] * RATE), round(times[2] * RATE) - 30
    response, force = flawed(response, force, first, last, kind)
    test = tap_test(response[None], RATE, hammer=force, band=(60.0, 560.0))
    assert [tap.flaw for tap in test.taps] == [None, Flaw.UNEXPLAINED, None, None]
    assert "% unexplained" in test.taps[1].reason
    np.testing.assert_allclose(test.modes.participation(), PARTICIPATION[:5], rtol=0.02)


def test_a_weak_mode_on_the_flank_of_a_strong_one_is_found():
    modes = (np.array([480.0, 652.5, 655.0]), np.array([4e-3, 4e-3, 1e-3]), np.array([-0.9, -0.12, 0.8]) * 1e-3)
    response, force, _ = taps(3, gap=0.7, seed=3, modes=modes)
    test = tap_test(response[None], RATE, hammer=force, band=(400.0, 900.0))
    np.testing.assert_allclose(test.modes.frequency, modes[0], rtol=1e-4)
    np.testing.assert_allclose(test.modes.participation().real, modes[2], rtol=0.02)


@pytest.fixture(scope="module")
def damped_in_places():
    """Four taps on modes that a joint damps: its points do not move in phase."""
    turned = PARTICIPATION * np.exp(1j * np.linspace(-0.4, 0.4, FREQUENCY.size))
    response, force, times = taps(4, gap=0.7, seed=1, modes=(FREQUENCY, DAMPING, turned))
    return response, force, times, turned


def test_a_beam_damped_in_places_has_complex_participations(damped_in_places, tmp_path):
    response, force, times, turned = damped_in_places
    last = round((times[3] - 0.05) * RATE)
    test = tap_test(response[None, :last], RATE, hammer=force[:last], band=BAND)
    own = test.response.taken(test.response.damping_ratio < 0.2)
    near = np.abs(np.log(own.frequency[:, None] / FREQUENCY)).argmin(axis=0)
    # A part of the phases that grows with frequency is taken for a delay of the hammer.
    found = own.participation()[near] * np.exp(2j * np.pi * FREQUENCY * test.delay)
    assert np.abs(found / turned - 1).max() < 0.02
    assert test.unexplained.max() < 0.01
    modes = read_modes(test.save(tmp_path / "modes.csv"))
    np.testing.assert_allclose(modes.participation(), test.response.participation(), rtol=1e-9, atol=1e-12)
    # Scenes know real participations alone, and respond as much alike as these can.
    own = Response(sampling_rate=RATE, modes=modes)
    true, real = (own.frequency_response(FREQUENCY, one.participation()) for one in (modes, modes.in_phase()))
    assert np.linalg.norm(real - true) < 0.4 * np.linalg.norm(true)
    one = recover_force(response[None, last:], RATE, modes, [times[3] - last / RATE])[0]
    errors = errors_of(one, force[last:], RATE)
    assert errors["force"] < 0.08
    assert abs(errors["impulse"]) < 0.05


def test_a_beam_in_phase_has_no_quadrature(hammered):
    assert np.abs(hammered.response.participation().imag).max() < 1e-2 * np.abs(PARTICIPATION).max()


def test_modes_beyond_the_band_are_in_its_lines(hammered):
    """The band ends below half of the modes: without their share the highest of it would be wrong by some percent."""
    response, force, _ = taps(4, gap=0.7, seed=1)
    test = tap_test(response[None], RATE, hammer=force, band=(60.0, 800.0))
    np.testing.assert_allclose(test.modes.participation(), PARTICIPATION[:6], rtol=0.01)
    assert test.unexplained.max() < 0.01
    frequency = np.array([570.0, 700.0])

    def response_of(modes):
        own = Response(sampling_rate=RATE, modes=modes)
        return own.frequency_response(frequency, modes.participation())

    beside = response_of(hammered.modes)
    assert np.abs(response_of(test.response) / beside - 1).max() < 0.03
    assert np.abs(response_of(test.modes) / beside - 1).min() > 0.1
