"""The plan: what runs for what is asked; features and tables without signals."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.measure.features.extraction import FEATURES, extract_array, extract_truncated
from cgid.physics import Response
from cgid.physics.contact import _contact, _kernels, curves
from cgid.physics.contact.curves import Curves
from cgid.physics.structure import coupled
from cgid.physics.structure.coupled import ModalCurves
from cgid.scene import Scene, Sensor, synthesise
from cgid.scene.output.generation import tabulate
from cgid.scene.synthesis import impacts, synthesis
from cgid.scene.synthesis.impacts import Recorder, TapPulses, draw
from cgid.scene.synthesis.plan import QUANTITIES, STAGES, plan
from cgid.scene.synthesis.synthesis import columns_of
from cgid.store import read_table
from cgid.store.table import TableRows, is_table
from tests.plan_scenes import (
    CASES,
    FIT,
    IN_TIME,
    PANEL,
    RIGS,
    SECOND,
    TAP,
    Case,
    beam_of,
    named,
    scene_of,
    uniform,
)


def features_of(
    scene: Scene, n_signals: int, seed: int = 0, *, features: object = None, first: int = 0
) -> Iterator[TableRows]:
    return columns_of(plan(scene, "features", features=features), n_signals, seed, first=first)


def closed_forms_of(
    scene: Scene, n_signals: int, seed: int = 0, *, quantities: object = None, first: int = 0
) -> Iterator[TableRows]:
    return columns_of(plan(scene, "closed-form", quantities=quantities), n_signals, seed, first=first)


def parameters_of(scene: Scene, n_signals: int, seed: int = 0, *, first: int = 0) -> Iterator[TableRows]:
    return columns_of(plan(scene, "parameters"), n_signals, seed, first=first)


# -- what runs ------------------------------------------------------------------------------------------


def test_true_pulses_of_a_beam_are_forces() -> None:
    chosen, forces = named("true pulses on a beam").scene, named("a beam whose sensor feels the force").scene
    (pulses,), (felt,) = synthesise(chosen, 100, output="pulses"), synthesise(forces, 100)
    assert pulses.unit == felt.unit == "N"
    # The modes of a table are the same, whatever is felt.
    np.testing.assert_array_equal(pulses.signals, felt.signals)
    filtered = scene_of(sensor={"anti_alias": {"frequency": "20 kHz"}})
    (pulses,), (silent,) = synthesise(filtered, 100, output="pulses"), synthesise(scene_of(sensor={}), 100)
    np.testing.assert_array_equal(pulses.signals, silent.signals)


def _refuse(*_: object, **__: object) -> None:
    raise AssertionError("a stage runs that the plan skips")


#: What does the work of each stage.
WORKERS = {
    "impacts": [
        (curves, "damping_of"),
        (curves, "peak_force"),
        (curves, "peak_displacement"),
        (curves.family, "times"),
        (_contact, "summaries"),
        (coupled, "solve"),
    ],
    "gravity": [(impacts, "weighed")],
    "coupling": [(impacts, "ModalContacts")],
    "pulses": [
        (_kernels, "add_to_frames"),
        (_contact, "add_to_frames"),
        (Curves, "add_to_frames"),
        (ModalCurves, "add_to_frames"),
    ],
    "taps": [(TapPulses, "add_to_frames")],
    "tail beam": [(Recorder, "participation")],
    "bandwidth": [(Sensor, "limit_band")],
    "noise": [(synthesis, "add_sensor_noise")],
    "background": [(synthesis, "background_of")],
    "clipping": [(synthesis, "clip")],
    "offset, range and bits": [(Sensor, "digitise")],
    "features": [(synthesis, "extract_array"), (synthesis, "extract_truncated")],
}


def workers(chosen: Case, *, running: bool) -> list[list[tuple[Any, str]]]:
    """Return what does the work of each stage that runs, or that the plan skips."""
    found = [pairs for name, pairs in WORKERS.items() if chosen.plan.runs(name) == running]
    return found + [[(Response, "add_to_frames")]] * (chosen.plan.responds == running)


@pytest.mark.parametrize("chosen", CASES, ids=lambda chosen: chosen.name)
def test_a_skipped_stage_may_be_broken_and_no_other(chosen: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    skipped = workers(chosen, running=False)
    assert skipped
    for owner, worker in (pair for pairs in skipped for pair in pairs):
        monkeypatch.setattr(owner, worker, _refuse)
    chosen.ask()
    for pairs in workers(chosen, running=True):
        with monkeypatch.context() as broken:
            for owner, worker in pairs:
                broken.setattr(owner, worker, _refuse)
            with pytest.raises(AssertionError, match="that the plan skips"):
                chosen.ask()


# -- features without frames ------------------------------------------------------------------------------


def stored_features(scene, n_signals, names, first=0):
    return np.concatenate(
        [
            extract_array(batch.signals, batch.sampling_rate, names, pre_trigger=batch.pre_trigger, invalid="nan")
            for batch in synthesise(scene, n_signals, first=first)
        ]
    )


def features_without_frames(scene, n_signals, names, first=0):
    parts = list(features_of(scene, n_signals, features=names, first=first))
    return np.concatenate([np.stack([part.columns[name] for name in names], axis=1) for part in parts])


NOISY = {"relative_noise": 0.08}
SCENES = {
    "plain": scene_of(),
    "silent": scene_of(sensor={}),
    "undamped": scene_of({"dissipation": "elastic"}, {"restitution": None}),
    "so noisy that beginnings do not do": scene_of(sensor=NOISY),
    "absolute noise": scene_of(sensor={"absolute_noise": "400 N"}),
    "bandwidth, range, bits": scene_of(
        sensor={"relative_noise": 0.02, "bandwidth": "20 kHz", "range": "20 kN", "bits": 10}
    ),
    "clipped": scene_of(population={"clipped_at": uniform(0.4, 0.9)}),
    "everything drawn": scene_of(
        randomise={"relative_noise": uniform(0.001, 0.2), "bandwidth": uniform("10 kHz", "90 kHz")},
        taps=[{**TAP, "second_hit": {"delay": uniform("0.2 ms", "4 ms"), "ratio": uniform(0.3, 3)}}],
    ),
    "pink noise": scene_of(sensor={**NOISY, "noise_exponent": 1, "relative_range": 2, "bits": 12}),
    "drawn rigs": scene_of(randomise=RIGS),
    "drawn noise": scene_of(randomise={"relative_noise": uniform(0.001, 0.5)}),
    "drawn rate": scene_of(randomise={"sampling_rate": uniform("50 kHz", "400 kHz")}),
}


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_features_without_frames_are_those_of_stored_frames(name: str) -> None:
    scene = SCENES[name]
    fitted = features_without_frames(scene, 300, FIT, first=100)
    np.testing.assert_array_equal(fitted, stored_features(scene, 300, FIT, first=100))
    # Sums over a window may differ in their last bits with what else is in the batch.
    names = (*IN_TIME, "skewness", "spectral_centroid", "band_energy_0_500_hz")
    read = features_without_frames(scene, 300, names, first=100)
    np.testing.assert_allclose(read, stored_features(scene, 300, names, first=100), rtol=1e-9, atol=1e-12)


def test_features_of_vibrations_are_those_of_stored_frames() -> None:
    scene = named("features of measured modes, one silent").scene
    asked = plan(scene, "features")
    names = asked.features
    assert asked.runs("features")
    assert asked.runs("rest of the frames")
    assert "level_10000_hz" in names
    assert "level_31.5_hz" not in names  # frames are too short to tell the band from the next
    assert not any(FEATURES[name].kind == "pulse" for name in names)
    found = features_without_frames(scene, 300, names, first=100)
    # Sums may differ in their last bits with what else is in the batch.
    np.testing.assert_allclose(found, stored_features(scene, 300, names, first=100), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("names", [IN_TIME, FIT], ids=["in time", "fit"])
def test_a_beginning_is_certain_only_where_nothing_behind_it_matters(names: tuple[str, ...]) -> None:
    (batch,) = synthesise(scene_of(population={"second_hit": SECOND}), 128)
    whole = extract_array(batch.signals, 200e3, names, pre_trigger=128, invalid="nan")
    shares = []
    for length in range(140, 460, 20):
        behind = batch.signals[:, length:].max(axis=1)  # the least that is true of it
        cut = np.ascontiguousarray(batch.signals[:, :length])
        found, certain = extract_truncated(cut, 200e3, names, 128, behind)
        np.testing.assert_array_equal(found[certain], whole[certain])
        shares.append(certain.mean())
        assert not extract_truncated(cut, 200e3, names, 128, behind + 1e9)[1].any()
    assert shares[0] == 0
    assert shares[-1] == 1
    assert any(0 < share < 1 for share in shares)


# -- parameters and closed forms --------------------------------------------------------------------------


def test_columns_are_those_of_the_signals() -> None:
    scene = named("taps, second hits, drawn noise").scene
    (batch,) = synthesise(scene, 200, 4, first=20)
    (closed,), (drawn,) = closed_forms_of(scene, 200, 4, first=20), parameters_of(scene, 200, 4, first=20)
    for part in (closed, drawn):
        np.testing.assert_array_equal(part.labels, batch.labels)
        np.testing.assert_array_equal(part.specimen, batch.specimen)
        for name in ("density", "radius", "velocity", "onset", "second_hit_delay", "relative_noise"):
            np.testing.assert_array_equal(part.columns[name], batch.parameters[name])
    for name in ("restitution", "peak_force", "contact_duration"):
        np.testing.assert_array_equal(closed.columns[name], batch.parameters[name])
    assert set(QUANTITIES) <= set(closed.columns)
    tapped = np.isnan(drawn.columns["radius"])
    assert 0 < tapped.sum() < 200
    assert np.isfinite(closed.columns["impulse"][~tapped]).all()
    assert np.isnan(closed.columns["impulse"][tapped]).all()
    np.testing.assert_array_equal(np.isfinite(drawn.columns["peak_force"]), tapped)  # only a tap's is drawn


# -- gravity ----------------------------------------------------------------------------------------------


def test_gravity_changes_a_scene_by_less_than_its_tolerance() -> None:
    scenes = [scene_of({"gravity": 9.81, "gravity_tolerance": limit}) for limit in (0.0, 1e-3, 0.1)]
    exact, usual, none = (draw(scene, 0, 0) for scene in scenes)
    assert not np.any(none.impact.gravity)
    assert np.all(exact.impact.gravity)
    assert 0 < np.count_nonzero(usual.impact.gravity) < 256
    for name in ("peak_force", "contact_duration", "restitution"):
        error = np.abs(usual.parameters[name] / exact.parameters[name] - 1)
        assert 0 < error.max() < 1e-3
    stage = plan(scenes[2]).decisions["gravity"]
    assert not stage.runs
    assert 0 < stage.error_bound < 0.1
    assert plan(scenes[1]).runs("gravity")


# -- tables -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".h5", ".csv", ".parquet"])
def test_a_table_is_read_back_as_it_was_made(tmp_path: Path, suffix: str) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    scene, path, names = SCENES["drawn noise"], tmp_path / f"table{suffix}", ("peak_force", "width_50")
    asked = plan(scene, "features", features=names)
    written = tabulate(asked, path, 1500, seed=3)
    found = read_table(path)
    assert is_table(path)
    (tmp_path / f"cut{suffix}").write_bytes(path.read_bytes()[: 100 if suffix == ".csv" else -9])
    assert is_table(tmp_path / f"cut{suffix}") == (suffix == ".csv")
    parts = list(features_of(scene, 1500, 3, features=names))
    np.testing.assert_array_equal(found.labels, np.concatenate([part.labels for part in parts]))
    np.testing.assert_array_equal(found.specimen, np.concatenate([part.specimen for part in parts]))
    assert list(found.columns) == list(asked.column_units) == list(found.header.units)
    for name, column in found.columns.items():
        np.testing.assert_array_equal(column, np.concatenate([part.columns[name] for part in parts]))
    assert (found.header.kind, found.header.units["peak_force"]) == ("features", "N")
    assert found.header.attributes["scene"] == scene.text
    unmeasured = ~np.isfinite(np.stack([found.columns[name] for name in names])).all(axis=0)
    assert written.n_unmeasured == unmeasured.sum() > 0
    again = tmp_path / f"again{suffix}"
    tabulate(asked, again, 1500, seed=3)
    assert again.read_bytes() == path.read_bytes()
    assert [entry.name for entry in tmp_path.iterdir() if entry.name.startswith(".")] == []


# -- the plan as it is printed ----------------------------------------------------------------------------


def test_explain_prints_the_plan_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for owner, worker in [pair for pairs in WORKERS.values() for pair in pairs if pair[0] is not curves.family]:
        if owner is not curves:
            monkeypatch.setattr(owner, worker, _refuse)
    assert run(["generate", "reference", "--explain", "-n", "100000", "--features-only", "--features", "width_10"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = {line.split("  ")[0]: line for line in out.splitlines()}
    assert "skipped" in lines["taps"]
    assert "width_10; no fit, no spectra" in lines["features"]
    assert " run " in lines["noise"]
    assert "up to the last sample" in lines["noise"]
    assert out.splitlines()[-1].startswith("100000 signals: ")
    assert run(["generate", "reference", "--explain", "--json", "-o", "data.h5"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["output"] == "frames"
    assert content["bytes"] == 10_000 * 2048 * 4
    assert [stage["name"] for stage in content["stages"]] == list(STAGES)
    assert list(tmp_path.iterdir()) == []


#: A value of each key of a sensor, and what it needs beside it.
SENSOR_KEYS: dict[str, tuple[Any, dict[str, Any]]] = {
    "quantity": ("velocity", {}),
    "mounting": ({"frequency": "6 kHz"}, {}),
    "anti_alias": ({"frequency": "5 kHz"}, {}),
    "relative_noise": (0.02, {}),
    "absolute_noise": (10.0, {}),
    "noise_density": (0.1, {}),
    "noise_exponent": (1.0, {"absolute_noise": 10.0}),
    "noise_spectrum": ({"frequencies": [1, 20e3], "density": [1.0, 0.1]}, {"absolute_noise": 10.0}),
    "ac_coupling": ("200 Hz", {}),
    "bandwidth": ("5 kHz", {}),
    "gain": (2.0, {}),
    "offset": (1.0, {}),
    "drift": (1000.0, {}),
    "range": (1.0, {}),
    "relative_range": (0.5, {}),
    "bits": (6, {"range": 1e3}),
}


@pytest.mark.parametrize("key", Sensor.model_fields)
def test_every_key_of_a_sensor_changes_signals_and_plan(key: str) -> None:
    value, others = SENSOR_KEYS[key]
    without = {"quantity": "acceleration"} | others
    scenes = [beam_of(PANEL, sensor) for sensor in (without, without | {key: value})]
    before, after = (next(synthesise(scene, 4)).signals for scene in scenes)
    assert np.abs(after - before).max() > 1e-3 * np.abs(before).max()
    assert key == "quantity" or len({str(plan(scene, "frames").decisions) for scene in scenes}) == 2


def test_a_beam_that_the_recorder_cannot_hear_is_refused() -> None:
    stiff = beam_of(
        {**PANEL, "thickness": "90 mm"}, {"quantity": "acceleration", "anti_alias": {"frequency": "300 Hz"}}
    )
    with pytest.raises(InvalidValue, match="tail_beam: must have a mode within the band"):
        next(synthesise(stiff, 1))


def test_a_table_that_is_cut_off_behind_a_row_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    tabulate(plan(scene_of(), "closed-form"), path, 600)
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"\n", len(content) // 2) + 1])
    with pytest.raises(BadData):
        read_table(path)
