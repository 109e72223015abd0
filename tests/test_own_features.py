"""Features of one's own: in tables, models and pipelines, from functions and other packages, and bad ones."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgid
from cgid.cli.main import run
from cgid.errors import BadData, InvalidValue
from cgid.identification.training import train_on_specimens
from cgid.measure.features import FEATURES, own_feature
from cgid.measure.features import own as own_features


@pytest.fixture(autouse=True)
def forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FEATURES, "_own", {})


@pytest.fixture(scope="module")
def batch() -> cgid.Batch:
    return next(cgid.synthesise("reference", 200, seed=4))


def area(samples: np.ndarray, sampling_rate: float) -> np.ndarray:
    """Area under the samples.

    More text.
    """
    return samples.sum(axis=1) / sampling_rate


def test_a_function_is_a_column_beside_the_others(batch: cgid.Batch) -> None:
    frames, rate = batch.signals + 50.0, batch.sampling_rate  # a baseline, which the function does not see
    table = cgid.extract(frames, rate, ["peak_force", area], pre_trigger=batch.pre_trigger)
    assert list(table) == ["peak_force", "area"]
    level = frames[:, : batch.pre_trigger].mean(axis=1, dtype=float)
    np.testing.assert_allclose(table["area"], (frames - level[:, None]).sum(axis=1, dtype=float) / rate, rtol=1e-6)
    assert FEATURES["area"].definition == "Area under the samples."
    assert cgid.extract(frames, rate, ["area"], pre_trigger=batch.pre_trigger).equals(table[["area"]])


@pytest.mark.parametrize("kind", ["vibration", "window"])
def test_other_kinds_of_signals(kind: Any) -> None:
    time = np.arange(8000) / 25600
    ringing = np.where(time > 0.05, np.exp(-40 * (time - 0.05)) * np.sin(2 * np.pi * 900 * time), 0.0)
    loudest = own_feature(lambda rows, rate: np.abs(rows).max(axis=1), name="loudest", kind=kind, unit="U")
    table = cgid.extract(3.0 * ringing, 25600, [loudest])
    assert table["loudest"][0] == pytest.approx(3.0 * np.abs(ringing).max(), rel=0.01)
    assert table.attrs["units"] == {"loudest": "U"}


def test_a_model_learns_from_it_and_names_it(batch: cgid.Batch, tmp_path: Path) -> None:
    asked: list[Any] = ["peak_force", "contact_duration", own_feature(area, unit="N s")]
    training = train_on_specimens(cgid.synthesise("reference", 600, seed=4), features=asked, family="linear")
    assert training.model.features == ("peak_force", "contact_duration", "area")
    card, path = training.save(tmp_path / "own.npz")
    assert "contact_duration, area (name it in `cgid.measure.features.choose" in card.read_text()
    table = cgid.predict(batch.signals[0], batch.sampling_rate, batch.unit, path)
    assert table["problem"][0] == ""
    FEATURES._own.clear()
    with pytest.raises(BadData, match=r"got 'area'.*\.choose\(\[\.\.\.\]\).* cgid\.features$"):  # in another process
        cgid.load_model(path)


def test_it_goes_into_a_pipeline(batch: cgid.Batch) -> None:
    measuring = cgid.ImpactFeatures(batch.sampling_rate, ["peak_force", area]).fit(batch.signals)
    assert measuring.get_feature_names_out().tolist() == ["peak_force", "area"]
    assert np.isfinite(measuring.transform(batch.signals)).all()


def test_a_package_registers_its_features(
    batch: cgid.Batch, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = EntryPoints(
        [
            EntryPoint("area", "tests.test_own_features:area", own_features.GROUP),
            EntryPoint("gone", "tests.no_such_module:area", own_features.GROUP),
        ]
    )
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries)
    own_features.outside_features.cache_clear()
    with pytest.warns(UserWarning, match="the feature gone .* cannot be loaded: ModuleNotFoundError"):
        table = cgid.extract(batch.signals, batch.sampling_rate, ["area"], pre_trigger=batch.pre_trigger)
    assert run(["features", "--list"]) == 0
    assert "\narea,1," in capsys.readouterr().out
    own_features.outside_features.cache_clear()
    assert np.isfinite(table["area"]).all()


@pytest.mark.parametrize(
    ("feature", "message"),
    [
        (own_feature(lambda rows, rate: rows, name="wide"), r"feature wide: .* each of 200 signals, got shape \(200, "),
        (own_feature(lambda rows, rate: 1.0, name="one"), r"feature one: .* each of 200 signals, got shape \(\)"),
        (own_feature(lambda rows, rate: rows.upper(), name="typo"), "feature typo: .* raised AttributeError"),
        (own_feature(area, name="peak_force"), "must not be that of a feature of cgid, got 'peak_force'"),
        (own_feature(area, name="mel_1000_hz"), "must not be that of a feature of cgid, got 'mel_1000_hz'"),
        (lambda rows, rate: rows.sum(axis=1), "name must be an identifier, got '<lambda>'; give own_feature"),
        (3, "feature must be a name, a function or a Feature, got 3"),
    ],
)
def test_bad_features(feature: Any, message: str, batch: cgid.Batch) -> None:
    with pytest.raises(InvalidValue, match=message) as error:
        cgid.extract(batch.signals, batch.sampling_rate, [feature], pre_trigger=batch.pre_trigger)
    assert "\n" not in str(error.value)


def test_a_row_that_a_feature_cannot_measure_is_named_or_nan(batch: cgid.Batch) -> None:
    def holed(rows: Any, rate: float) -> Any:
        heights = rows.max(axis=1)
        return np.where(heights == np.sort(heights)[-3], np.inf, heights)  # of each batch that it is given, one row

    row = int(np.argsort(batch.signals.max(axis=1))[-3])
    hole = own_feature(holed, name="hole")
    with pytest.raises(BadData, match=f"^signal {row}: feature hole must give a finite number, got inf"):
        cgid.extract(batch, features=["peak_force", hole])
    table = cgid.extract(batch, features=["peak_force", hole], invalid="nan")
    assert table.index[table.isna().all(axis=1)].tolist() == [row] and table.notna().sum().sum() == 2 * (len(batch) - 1)
    assert cgid.train_on_specimens(batch, features=["peak_force", hole]).model.training["n_left_out"] == 1


def test_signals_without_a_feature_are_told_by_a_training(batch: cgid.Batch) -> None:
    def infinite(rows: Any, rate: float) -> Any:
        return np.full(len(rows), np.inf)

    def seldom(rows: Any, rate: float) -> Any:
        return np.where(np.arange(len(rows)) % 4, rows.max(axis=1), np.nan)

    with pytest.raises(BadData, match=r"those of 200 of 200 signals are not: feature infinite must .* got inf$"):
        cgid.train_on_specimens(batch, features=["peak_force", infinite])
    with pytest.warns(UserWarning, match=r"those of 50 of 200 signals are not: feature seldom must .* are left out$"):
        training = cgid.train_on_specimens(batch, features=["peak_force", seldom])
    assert training.model.training["n_left_out"] == 50


def test_bad_kind() -> None:
    with pytest.raises(InvalidValue, match="kind must be"):
        own_feature(area, kind="pulses")  # type: ignore[arg-type]
