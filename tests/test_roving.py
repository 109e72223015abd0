"""Shapes of a beam without a drawing: a roving hammer on a plate whose modes are sines, made without cgid."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cgid.calibration import Flaw, roving_test
from cgid.calibration.matching import matched
from cgid.cli.main import run
from cgid.errors import BadData
from cgid.identification.prediction import PredictionSettings, load_model
from cgid.identification.prediction.telling import of_model
from cgid.physics import STEEL, TailBeam
from cgid.physics.structure.places import placed
from cgid.scene import load_scene, parse_scene, synthesise
from cgid.scene.synthesis.impacts import beam_modes
from cgid.scene.synthesis.through_beam import beam_of, full_beam
from cgid.shipped import scene_path
from tests.tapped import acceleration

RATE, GAP, FINER = 6400.0, 0.7, 8
SIDES, SENSOR = (0.8, 0.6), (0.2, 0.2)
#: Half waves along and across, and natural frequencies [Hz] of a simply supported plate of 40 kg.
WAVES = np.array([(1, 1), (2, 1), (1, 2), (3, 1), (2, 2), (3, 2)])
FREQUENCY = 18.0 * ((WAVES / SIDES) ** 2).sum(axis=1)
DAMPING, MASS = np.full(len(WAVES), 0.01), 40.0
BAND = (50.0, 650.0)


def shapes(x, y):
    """Return shapes of unit modal mass, (n, n_modes)."""
    x, y = np.atleast_1d(x)[:, None], np.atleast_1d(y)[:, None]
    return np.sin(np.pi * WAVES[:, 0] * x / SIDES[0]) * np.sin(np.pi * WAVES[:, 1] * y / SIDES[1]) / np.sqrt(MASS / 4)


def grid():
    x, y = np.meshgrid(0.1 * np.arange(1, 8), 0.1 * np.arange(1, 6), indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def tapped(places, seed=0, noise=1e-3, contact=60):
    """Return acceleration [m/s^2] and force [N] of a tap at each place, and the times [s]."""
    rng, n = np.random.default_rng(seed), round((0.3 + GAP * len(places)) * RATE) * FINER
    total, forces = np.zeros(n), np.zeros(n)
    starts = np.round((0.2 + GAP * np.arange(len(places))) * RATE * FINER).astype(int)
    for first, shape in zip(starts, shapes(*places.T), strict=True):
        own = np.zeros(n - first)
        own[:contact] = rng.uniform(100, 300) * np.sin(np.pi * (np.arange(contact) + 0.5) / contact)
        forces[first:] += own
        heard = acceleration(
            own[: round(2 * RATE) * FINER], 1 / RATE / FINER, FREQUENCY, DAMPING, shape * shapes(*SENSOR)[0]
        )
        total[first : first + heard.size] += heard
    response, force = (one.reshape(-1, FINER).mean(axis=1) for one in (total, forces))
    response = response + rng.normal(0, noise * response.std(), response.size)
    return response, force + rng.normal(0, 0.05, force.size), starts / RATE / FINER


@pytest.fixture(scope="module")
def recording():
    places = grid()
    return (*tapped(places), places)


@pytest.fixture(scope="module")
def found(recording):
    response, force, times, places = recording
    return roving_test(
        response[None], RATE, hammer=force, places=places, sensor=SENSOR, times=times.tolist(), band=BAND
    )


def test_shapes_between_places_are_those_of_the_plate(found):
    np.testing.assert_allclose(found.modes.frequency, FREQUENCY[np.argsort(FREQUENCY)], rtol=1e-4)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0.1, 0.7, 50), rng.uniform(0.1, 0.5, 50)
    truth = (shapes(x, y) * shapes(*SENSOR)[0])[:, np.argsort(FREQUENCY)]
    is_mode = found.response.damping_ratio < 0.2
    off = found.placed.shapes(x, y)[:, is_mode] - truth
    error = np.sqrt(np.mean(np.square(off), axis=0) / np.mean(np.square(truth), axis=0))
    assert error.max() < 0.05
    assert (error < 2 * found.modes.deviation[2]).all()  # which says so
    own = np.abs(shapes(*SENSOR)[0, np.argsort(FREQUENCY)])
    near_node = own < 0.2 * own.max()
    np.testing.assert_allclose(found.modes.at_sensor[~near_node], own[~near_node], rtol=0.02)


def test_modes_of_a_drawing_are_matched_by_their_shapes_too(found):
    """The plate again, drawn .5 % too thin; then with the shapes of two neighbours exchanged."""
    plate = TailBeam(
        material=STEEL,
        length=SIDES[0],
        width=SIDES[1],
        thickness=0.00729,
        edges="simply-supported",
        damping_ratio=0.02,
    )
    drawn = plate.modes(465.0)
    _, partner, mac = matched(found, drawn, 0.01)
    assert partner.tolist() == list(range(len(WAVES))) and mac.min() > 0.99
    swapped = replace(drawn, at_impact=lambda x, y: drawn.shape(x, y)[..., [0, 1, 2, 4, 3, 5]])
    _, partner, mac = matched(found, swapped, 0.01)
    assert partner.tolist() == [0, 1, 2, -1, -1, 5] and (mac[[3, 4]] < 0.1).all()


def test_values_are_kept_at_places_and_noise_is_told():
    rng, points = np.random.default_rng(2), grid()
    values = np.stack([shapes(*points.T)[:, 4], rng.normal(0, 1, len(points))], axis=1)
    found = placed(points, values, np.array([FREQUENCY[4], 500.0]), np.array([0.01, 0.01]))
    assert found.unpredicted[0] < 0.05 and found.unpredicted[1] > 0.8
    np.testing.assert_allclose(found.shapes(*points.T)[:, 0], values[:, 0], atol=0.02 * values[:, 0].std())


def write(folder, response, force, places, times=None, name="taps"):
    np.save(folder / f"{name}.npy", np.stack([response, force]).astype(np.float32))
    columns = [places[:, 0], places[:, 1]] + ([] if times is None else [times])
    titles = "x_m,y_m" + ("" if times is None else ",time_s")
    np.savetxt(folder / f"{name}-places.csv", np.stack(columns, axis=1), "%.6g", ",", header=titles, comments="")
    given = [f"{name}.npy", "--rate", f"{RATE:g}", "--channel", "1", "--hammer", "2", "--unit", "1=m/s^2,2=N"]
    return ["tap", *given, "--taps", f"{name}-places.csv", "--band", *map(str, BAND), "-o", f"{name}-modes.csv"]


BEAM = """[tail_beam]
modes = "taps-modes.csv"
learned = "taps-modes.csv"
shapes = "taps-modes-shapes.csv"

[tail_beam.impact_point]
x = { distribution = "uniform", lowest = 0.1, highest = 0.7 }
y = { distribution = "uniform", lowest = 0.1, highest = 0.5 }

"""


@pytest.fixture(scope="module")
def folder(recording, tmp_path_factory):
    response, force, _, places = recording
    folder = tmp_path_factory.mktemp("roving")
    command = write(folder, response, force, places)  # without times: one row a tap, in order
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert run([*command, "--sensor", "0.2,0.2"]) == 0
    text = scene_path("tail_beam").read_text()
    start, stop = text.index("[tail_beam]"), text.index("[sampling]")
    text = text[:start] + BEAM + text[stop:]
    text = text.replace('"25.6 kHz"', '"6.4 kHz"').replace('"10 kHz", order', '"2.5 kHz", order')
    text = "\n".join(line for line in text.splitlines() if not line.startswith("mounting"))
    (folder / "support.toml").write_text(text)
    return folder


def test_tables_are_a_scene_whose_impacts_fall_anywhere(folder):
    scene = load_scene(folder / "support.toml")
    modes = beam_modes(scene)
    at = modes.participation(np.array([0.33, 0.61]), np.array([0.27, 0.4]))[:, modes.damping_ratio < 0.2]
    truth = (shapes(np.array([0.33, 0.61]), np.array([0.27, 0.4])) * shapes(*SENSOR)[0])[:, np.argsort(FREQUENCY)]
    np.testing.assert_allclose(at, truth, atol=0.05 * np.abs(truth).max())
    assert parse_scene(json.loads(scene.text)).sha256 == scene.sha256
    beam = beam_of(scene)
    np.testing.assert_allclose(beam.region, [0.1, 0.7, 0.1, 0.5])
    x, y, weights = beam.grid(0.1)
    np.testing.assert_allclose(weights, modes.participation(x, y), rtol=1e-4, atol=1e-5 * np.abs(weights).max())
    drawn = next(iter(synthesise(scene, 16, 1))).parameters
    assert ((drawn["impact_x"] >= 0.1) & (drawn["impact_x"] <= 0.7)).all() and np.ptp(drawn["impact_y"]) > 0.1
    np.testing.assert_allclose(full_beam(scene).region, [0.1, 0.7, 0.1, 0.5])


def test_forces_of_impacts_at_unknown_places(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    places = np.array([[0.17, 0.42], [0.63, 0.31], [0.36, 0.14]])
    response, force, _ = tapped(places, seed=8, contact=40)
    write(folder, response, force, places, name="rocks")
    given = ["rocks.npy", "--rate", f"{RATE:g}", "--channel", "1", "--hammer", "2", "--unit", "1=m/s^2,2=N"]
    command = ["invert", *given, "--scene", "support.toml", "-o", "forces.csv"]
    assert run([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["impacts"]
    np.testing.assert_allclose([[one["x"], one["y"]] for one in found], places, atol=0.02)
    for one in found:
        assert np.hypot(one["x_deviation"], one["y_deviation"]) < 0.02
        assert abs(one["errors"]["impulse"]) < 0.03 and abs(one["errors"]["peak"]) < 0.1
        assert one["unexplained"] < 0.1
    rows = (folder / "forces.csv").read_text().splitlines()
    assert rows[0] == "impact,time [s],force [N],deviation [N],measured [N],x [m],y [m]"
    assert run([*command, "--overwrite"]) == 0
    assert "x [mm]" in capsys.readouterr().out
    # Participations of the table are means over its places, so that forces through it alone would be wrong.
    assert run(["invert", *given, "--modes", "taps-modes.csv"]) == 65
    assert "--scene" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ('shapes = "taps-modes-shapes.csv"\n', "must have either modes or a panel"),
        ('modes = "taps-modes.csv"\n', "modes"),
        ("lowest = 0.1, highest = 0.7", "impact_point.x must be among the places"),
    ],
)
def test_scenes_whose_tables_do_not_fit_are_refused(folder, change, says):
    text = (folder / "support.toml").read_text()
    changed = text.replace(change, "lowest = 0.1, highest = 0.8" if "lowest" in change else "")
    (folder / "wrong.toml").write_text(changed)
    with pytest.raises(BadData, match=says):
        load_scene(folder / "wrong.toml")


def test_a_tap_elsewhere_is_left_out_by_name(recording):
    response, force, times, places = recording
    wrong = places.copy()
    wrong[[3, 20]] = wrong[[20, 3]]
    found = roving_test(
        response[None], RATE, hammer=force, places=wrong, sensor=SENSOR, times=times.tolist(), band=BAND
    )
    assert [k for k, tap in enumerate(found.taps) if tap.flaw == Flaw.ELSEWHERE] == [3, 20]


def test_taps_at_one_place_are_averaged(recording):
    response, force, _, places = recording
    again = np.concatenate([places, places[:2]])
    more, hammer, _ = tapped(places[:2], seed=5)
    found = roving_test(
        np.concatenate([response, more])[None],
        RATE,
        hammer=np.concatenate([force, hammer]),
        places=again,
        sensor=SENSOR,
        band=BAND,
    )
    assert len(found.used) == len(again) and len(found.places) == len(places)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"places": grid()[:-1]}, "a row for each tap"),
        ({"sensor": (0.7, 2.0)}, "next to the sensor"),
        ({"places": np.repeat(grid()[:1], len(grid()), axis=0)}, "6 places"),
        ({"times": [0.2, 0.2, *(0.2 + GAP * np.arange(2, len(grid()))).tolist()]}, "a tap of its own"),
    ],
)
def test_tables_of_places_that_do_not_match_are_refused(recording, options, says):
    response, force, _, places = recording
    with pytest.raises(BadData, match=says):
        roving_test(response[None], RATE, hammer=force, band=BAND, **{"places": places, "sensor": SENSOR} | options)


def test_a_model_of_one_place_says_so():
    model = load_model("default-acceleration")
    arrays = dict(model.arrays) | {"beam.region": np.zeros(4)}
    arrays["beam.participation"] = arrays["beam.participation"][:, :1, :1]
    for one, kinds in ((model, []), (replace(model, arrays=arrays), ["one_place"])):
        assert [found.kind for found in of_model(one, one.sampling_rates[0], PredictionSettings())] == kinds
