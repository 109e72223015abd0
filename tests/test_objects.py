"""What objects show in a notebook, draw, and give by index; and that the package's functions take them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import cgid
from cgid import shipped
from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate, InvalidValue, MissingOption
from cgid.identification.model.model import stored
from cgid.identification.prediction.answers import unmeasured
from cgid.identification.training import Training, train_on_specimens
from cgid.measure.features.extraction import in_units
from cgid.physics import COAL, GANGUE, SANDSTONE, STEEL, YANG2018_SPHERES
from cgid.plots.figure import COLOURS

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> cgid.Dataset:
    from cgid.scene import generate

    folder = tmp_path_factory.mktemp("objects") / "data"
    generate("reference", folder, 60, 5, shard_signals=25)
    return cgid.Dataset(folder)


@pytest.fixture(scope="module")
def training() -> Training:
    return train_on_specimens(cgid.synthesise("reference", 400, seed=2), family="linear")


@pytest.fixture
def impact() -> cgid.Impact:
    return cgid.Impact(
        sphere=cgid.Sphere(material=YANG2018_SPHERES[1], radius=[0.02, 0.025]),
        target=cgid.HalfSpace(material=STEEL),
        velocity=2.0,
        stiffness="hertz",
        dissipation=cgid.HuntCrossley(restitution=0.6),
    )


class Cells(HTMLParser):
    """The texts of a page, and its tags."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_notebooks_show_what_an_object_is(dataset: cgid.Dataset, training: Training, impact: cgid.Impact) -> None:
    batch = next(dataset.batches())
    scene = cgid.load_scene("tail_beam")
    shown = {
        "Signal": (dataset[3], f"{dataset.header.n_samples} at 200000 Hz"),
        "Batch": (batch, f"coal {np.sum(batch.labels == 'coal')}"),
        "Dataset": (dataset, "drop_height [m]"),
        "Scene": (scene, "acceleration [m/s^2] at 25600 Hz"),
        "Model": (training.model, "coal, gangue"),
        "Training": (training, f"{training.metrics['accuracy']:.3f}"),
        "Impact": (impact, "20 to 25 mm"),
    }
    for name, (one, expected) in shown.items():
        cells = Cells(one._repr_html_())
        assert cells.texts[0].startswith(name)
        assert any(expected in text for text in cells.texts), (name, cells.texts)
        assert set(cells.tags) == {"table", "caption", "tr", "th", "td"}


def test_text_of_a_file_is_never_a_tag() -> None:
    signal = cgid.Signal(np.ones(5), 1e3, source="<img src=x>.csv", warnings=("<script>",))
    assert not {"img", "script"} & set(Cells(signal._repr_html_()).tags)


def test_a_signal_is_samples_rate_and_unit() -> None:
    signal = cgid.Signal([1, 2, 3], 1e3, "kN")
    assert (signal.samples.tolist(), signal.sampling_rate, signal.unit) == ([1.0, 2.0, 3.0], 1e3, "kN")
    with pytest.raises(TypeError):
        cgid.Signal([1, 2, 3], 1e3, "kN", "file.csv")  # type: ignore[misc]


def test_dataset_by_index(dataset: cgid.Dataset) -> None:
    signals = np.concatenate([batch.signals for batch in dataset.batches()])
    for index, signal in enumerate(dataset):
        assert np.array_equal(signal.samples, signals[index]) and signal.source == dataset[index].source
    assert len(list(dataset)) == len(dataset) == len(signals)
    for index in (0, 24, 25, 59, -1, -60, np.int64(7)):
        np.testing.assert_array_equal(dataset[index].samples, signals[index])
        np.testing.assert_array_equal(dataset.impact(index).signals[0], signals[index])
        assert dataset.signal(index).source == dataset[index % 60].source
    for index in (60, -61):
        for read in (dataset.__getitem__, dataset.impact, dataset.signal):
            with pytest.raises(InvalidValue, match="index must be"):
                read(index)
    coal = dataset.parameters["label"].to_numpy() == "coal"
    for rows in (
        slice(1, 3),
        slice(None, None, -7),
        [1, 2],
        [58, 3, -1, 3],
        [],
        np.array([24, 25]),
        coal,
        coal.tolist(),
    ):
        np.testing.assert_array_equal(dataset[rows], signals[rows])
    np.testing.assert_array_equal(dataset[[30, 2], 5:9], signals[[30, 2], 5:9])


def test_parameters_of_a_dataset_are_a_table_with_units(dataset: cgid.Dataset) -> None:
    table, batches = dataset.parameters, list(dataset.batches())
    assert table["label"].tolist() == np.concatenate([batch.labels for batch in batches]).tolist()
    for name in ("drop_height", "radius"):
        np.testing.assert_array_equal(table[name], np.concatenate([batch.parameters[name] for batch in batches]))
        assert table.attrs["units"][name] == "m"
    assert len(table) == len(dataset) == 60


def test_pictures_draw_the_values(dataset: cgid.Dataset, impact: cgid.Impact) -> None:
    axes = dataset[2].plot()
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), dataset[2].samples)
    assert axes.get_xlabel() == "time [ms]"
    assert dataset[3].plot(axes) is axes
    axes = impact.plot()
    peaks = [line.get_ydata().max() for line in axes.lines]
    np.testing.assert_allclose(peaks, impact.peak_force / 1e3, rtol=1e-3)
    assert [line.get_color() for line in axes.lines] == list(COLOURS[:2])
    low, high = dataset.plot().get_xlim()
    assert -0.5 < low < 0 and 0.1 < high < 1.2  # ms: pulses of some 0.2 ms in frames of 10 ms
    for one in (dataset, next(dataset.batches()), cgid.load_scene("reference")):
        drawn = one.plot(n=5)
        assert len(drawn.lines) == 10
        assert [text.get_text() for text in drawn.get_legend().get_texts()] == ["coal", "gangue"]
    with pytest.raises(InvalidValue, match=r"n must be .* 200, got 201"):
        dataset.plot(n=201)
    matplotlib.pyplot.close("all")


def test_long_signal_keeps_its_extremes() -> None:
    samples = np.random.default_rng(0).normal(size=1_000_003)
    line = cgid.Signal(samples, 1e4, "g").plot().lines[0]
    assert len(line.get_ydata()) <= 20_000
    assert (line.get_ydata().min(), line.get_ydata().max()) == (samples.min(), samples.max())
    where = np.argmax(line.get_ydata())
    assert line.get_xdata()[where] == np.argmax(samples) / 1e4
    matplotlib.pyplot.close("all")


def batch_of(signals: np.ndarray) -> cgid.Batch:
    return cgid.Batch(signals=signals, sampling_rate=1e5, unit="N", pre_trigger=0)


def test_odd_objects_are_drawn_or_refused() -> None:
    """No warning, and nothing drawn that is not there: without labels, of two sensors, of one sample, of none."""
    rng = np.random.default_rng(1)
    plain, several = batch_of(rng.normal(size=(3, 40))), batch_of(rng.normal(size=(3, 2, 40)))
    assert plain.plot().get_legend() is None
    drawn = [line.get_ydata() for line in several.plot().lines]
    np.testing.assert_array_equal(drawn, several.signals.reshape(6, 40))
    labelled = replace(several, labels=np.array(["coal", "coal", "gangue"]))
    assert [text.get_text() for text in labelled.plot().get_legend().get_texts()] == ["coal", "gangue"]
    assert cgid.Signal([1.0], 1e5, "N").plot().lines[0].get_marker() == "."
    with pytest.raises(InvalidValue, match="must have a signal to be drawn, it has none"):
        batch_of(np.empty((0, 40))).plot()
    matplotlib.pyplot.close("all")


def test_texts_of_odd_objects_are_right(dataset: cgid.Dataset) -> None:
    assert repr(dataset.impact(0)).startswith("Batch(1 signal of ")
    assert "force [N] at a random rate" in cgid.load_scene("randomised")._repr_html_()
    assert "[m/s^2] at 25600 Hz<" in stored(cgid.load_model("default-acceleration"))._repr_html_()
    assert repr(unmeasured("it is cut off", 0.12)) == "Answer(unknown at 0.12 s: not measured; it is cut off)"


def test_many_impacts_are_not_drawn() -> None:
    impact = cgid.Impact(
        sphere=cgid.Sphere(material=YANG2018_SPHERES[1], radius=np.full(201, 0.02)),
        target=cgid.HalfSpace(material=STEEL),
        velocity=2.0,
        stiffness="hertz",
        dissipation=cgid.Elastic(),
    )
    with pytest.raises(InvalidValue, match="1 to 200"):
        impact.plot()


def test_a_radius_in_millimetres_asks_back() -> None:
    with pytest.warns(UserWarning, match=r"radius is 25 m, .*; if it is in mm, give 0\.025") as told:
        cgid.Sphere(material=STEEL, radius=25)
    assert told[0].filename == __file__


def test_ranges_of_materials_give_materials() -> None:
    for one in (COAL, GANGUE, SANDSTONE):
        drawn = one.draw(np.random.default_rng(1), 2000)
        for name in ("density", "youngs_modulus", "poisson_ratio"):
            low, high = getattr(one, name)
            values = np.asarray(getattr(drawn, name))
            assert low <= getattr(one.middle, name) <= high and low <= values.min() and values.max() <= high
            assert values.min() < low + 0.01 * (high - low) and values.max() > high - 0.02 * (high - low)
        sphere = cgid.Sphere(material=drawn, radius=0.025)
        assert np.shape(sphere.mass) == (2000,)
        with pytest.raises(InvalidValue, match=r"material .*\.middle or \.draw"):
            cgid.Sphere(material=one, radius=0.025)  # type: ignore[arg-type]


def test_an_impact_without_a_loss_names_it() -> None:
    with pytest.raises(cgid.errors.MissingOption, match="dissipation must be given"):
        cgid.Impact(sphere=None, target=cgid.RIGID, velocity=1.0, stiffness="hertz")  # type: ignore[call-arg, arg-type]


def test_the_spectrum_of_an_impact_is_that_of_its_equation_of_motion(impact: cgid.Impact) -> None:
    """An own integration of Hertz's contact with the damping of Hunt and Crossley, by steps of Runge and Kutta."""
    elastic = replace(impact, dissipation=cgid.Elastic())
    frequency = np.array([0.0, 500.0, 3e3, 12e3])
    for number in range(2):
        stiffness, mass = elastic.contact_stiffness[number], elastic.reduced_mass[number]

        def rate(state: np.ndarray, k: float = stiffness, m: float = mass) -> np.ndarray:
            return np.array([state[1], -k / m * max(state[0], 0.0) ** 1.5])

        step, state, forces = 2e-8, np.array([0.0, 2.0]), [0.0]
        while len(forces) < 3 or state[0] > 0:
            a = rate(state)
            b = rate(state + step / 2 * a)
            c = rate(state + step / 2 * b)
            state = state + step / 6 * (a + 2 * b + 2 * c + rate(state + step * c))
            forces.append(stiffness * max(state[0], 0.0) ** 1.5)
        times = step * np.arange(len(forces))
        expected = [abs(np.sum(forces * np.exp(-2j * np.pi * f * times)) * step) for f in frequency]
        np.testing.assert_allclose(elastic.spectrum(frequency)[number], expected, rtol=0, atol=1e-5 * expected[0])
    np.testing.assert_allclose(impact.spectrum(0.0)[:, 0], impact.impulse, rtol=1e-6)
    times = np.arange(4000) / 4e6
    sampled = cgid.Signal(samples=impact.force(times)[1], sampling_rate=4e6, unit="N")
    frequencies, magnitude = sampled.spectrum()
    np.testing.assert_allclose(impact.spectrum(frequencies[:20])[1], magnitude[:20], rtol=0, atol=1e-4 * magnitude[0])


def test_times_of_a_series_must_be_of_the_rate() -> None:
    pd = pytest.importorskip("pandas")
    samples = np.random.default_rng(0).normal(0, 1, 4000)
    for index in (np.arange(4000) / 5e4, pd.date_range("2026-01-01", periods=4000, freq="20us")):
        series = pd.Series(samples, index=index)
        for call in (cgid.predict, cgid.extract):
            with pytest.raises(InvalidValue, match=r"sampling_rate must be that of the times .* 2e-05 s, got 25600 Hz"):
                call(series, 25600.0, "N") if call is cgid.predict else call(series, 25600.0)
        with pytest.warns(UserWarning, match="no impact"):
            assert len(cgid.predict(pd.DataFrame({"a": series}), 50_000.0, "N")) == 0
    with pytest.warns(UserWarning, match="no impact"):
        assert len(cgid.predict(pd.Series(samples), 25600.0, "N")) == 0


def test_model_predicts_from_a_table_of_features(training: Training) -> None:
    model = training.model
    (batch,) = cgid.synthesise("reference", 100, seed=9)
    table = cgid.extract(batch.signals, batch.sampling_rate, model.features, pre_trigger=batch.pre_trigger)
    assert list(table.attrs["units"]) == list(model.features)
    probabilities = model.predict_proba(table)
    np.testing.assert_array_equal(probabilities, model.predict_proba(table.to_numpy()))
    shuffled = table[table.columns[::-1]].assign(other=1.0)
    np.testing.assert_array_equal(probabilities, model.predict_proba(shuffled))
    assert training.classifier is not None
    np.testing.assert_allclose(probabilities, training.classifier.predict_proba(table.to_numpy()), atol=1e-12)
    assert model.predict(table).tolist() == np.array(model.labels)[probabilities.argmax(axis=1)].tolist()
    assert np.mean(model.predict(table) == batch.labels) > 0.7
    assert model.predict(batch).tolist() == model.predict(table).tolist()
    in_kn = replace(batch, signals=batch.signals / 1e3, unit="kN")
    np.testing.assert_allclose(model.predict_proba(in_kn), probabilities, atol=1e-5)  # of single samples
    with pytest.raises(InvalidValue, match="m/s"):
        model.predict(replace(batch, unit="m/s^2"))
    with pytest.raises(InvalidValue, match=f"{model.features[0]} missing"):
        model.predict(table.drop(columns=model.features[0]))
    with pytest.raises(InvalidValue, match="features must be"):
        model.predict(table.assign(**{model.features[0]: np.nan}))


def test_model_of_a_beam_predicts_signals_through_it() -> None:
    model = cgid.load_model("default-acceleration")
    (batch,) = cgid.synthesise("tail_beam", 4, seed=3)
    table = cgid.predict(batch, model=model)
    np.testing.assert_allclose(model.predict_proba(batch)[:, 0], table["p_coal"], atol=1e-12)
    in_g = replace(batch, signals=batch.signals / 9.80665, unit="g")
    assert model.predict(in_g).tolist() == table["label"].tolist()


def test_tables_in_another_unit_are_converted_or_refused(training: Training) -> None:
    (batch,) = cgid.synthesise("reference", 100, seed=9)
    in_kn = replace(batch, signals=batch.signals / 1e3, unit="kN")
    model = training.model
    table, other = (cgid.extract(one, features=model.features) for one in (batch, in_kn))
    np.testing.assert_allclose(model.predict_proba(other), model.predict_proba(table), atol=1e-5)
    classifier = cgid.ImpactClassifier().fit(table, batch.labels)
    np.testing.assert_allclose(classifier.predict_proba(other), classifier.predict_proba(table), atol=1e-5)
    for name in ("impulse", "energy", "size_free_index", "level_total", "spectral_centroid"):
        of_n, of_kn = (cgid.extract(one, features=[name]) for one in (batch, in_kn))
        np.testing.assert_allclose(in_units(of_kn, of_n.attrs["units"]), of_n, rtol=1e-5)
        assert of_kn.equals(in_units(of_kn, of_kn.attrs["units"]))
    other.attrs = {}
    assert not np.allclose(model.predict_proba(other), model.predict_proba(table), atol=0.1)
    shocks = cgid.extract(replace(batch, unit="g"), features=model.features)
    with pytest.raises(
        InvalidValue, match=r"fitted_peak must be in N, .* states g; measure it on signals of that unit"
    ):
        model.predict(shocks)


def test_batches_and_datasets_are_predicted(
    dataset: cgid.Dataset, training: Training, capsys: pytest.CaptureFixture[str]
) -> None:
    table = cgid.predict(dataset)
    assert list(table)[:4] == ["index", "time_s", "label", "p_coal"]
    assert table["index"].tolist() == list(range(60))
    assert table["truth"].tolist() == dataset.parameters["label"].tolist()
    assert cgid.predict(str(dataset.path)).equals(table)
    batch = next(dataset.batches())
    assert cgid.predict(batch).equals(table[: len(batch)])
    assert run(["predict", str(dataset.path), "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    printed = [line["probabilities"]["coal"] for line in lines if "probabilities" in line]
    np.testing.assert_allclose(table["p_coal"], printed, atol=1e-9)
    own = cgid.predict(batch, model=training)
    assert own.equals(cgid.predict(batch, model=training.model))
    assert not own["p_coal"].equals(table["p_coal"][: len(batch)])
    with pytest.raises(BadData, match="quantity must be acceleration"):
        cgid.predict(dataset, model="default-acceleration")


def test_labels_that_a_model_lacks_are_not_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cgid.scene.generate("lookalikes", tmp_path / "alike", 50, 3)
    labels = cgid.Dataset(tmp_path / "alike").parameters["label"].value_counts()
    assert run(["predict", str(tmp_path / "alike"), "-o", str(tmp_path / "answers.csv")]) == 0
    error = capsys.readouterr().err
    foreign = labels.drop(["coal", "gangue"], errors="ignore")
    assert f"{foreign.sum()} impacts of labels that the model lacks (" in error
    assert "0.0000" not in error


def test_tables_have_units(dataset: cgid.Dataset) -> None:
    sample = cgid.shipped.path_of("datasets", "sample.csv")
    tables = (
        cgid.predict(sample),
        cgid.predict(dataset),
        cgid.impact_table(sample),
        cgid.impact_table(sample, "default"),
    )
    for table in tables:
        units = table.attrs["units"]
        assert list(units) == list(table) and units["time_s"] == "s"
        assert {unit for name, unit in units.items() if not name.endswith("_s")} <= {"", "N"}
    assert tables[2].attrs["units"]["peak"] == "N"


def test_objects_of_the_package_go_into_its_functions(dataset: cgid.Dataset) -> None:
    batch, sample = next(dataset.batches()), cgid.shipped.path_of("datasets", "sample.csv")
    known = {"pre_trigger": batch.pre_trigger}
    expected = cgid.extract(batch.signals, batch.sampling_rate, ["peak_force", "width_10"], **known)
    assert cgid.extract(batch, features=["peak_force", "width_10"]).equals(expected)
    assert cgid.extract(dataset[0], features=["peak_force", "width_10"]).equals(expected[:1])
    with pytest.raises(MissingOption, match="sampling_rate"):
        cgid.extract(batch.signals)
    (signal,) = cgid.read_recording(sample)
    assert [one.onset for one in cgid.find_impacts(sample)] == [one.onset for one in cgid.find_impacts(signal)]


def test_extract_takes_samples_and_no_path(dataset: cgid.Dataset) -> None:
    for wrong in ("sample.csv", dataset.path):
        with pytest.raises(InvalidValue, match="must be an array, a Signal or a Batch"):
            cgid.extract(wrong)
    with pytest.raises(MissingOption, match="sampling rate"):
        cgid.extract(dataset[0].samples)


def test_a_rate_or_unit_that_contradicts_the_object_is_refused(dataset: cgid.Dataset) -> None:
    batch, names = next(dataset.batches(20)), ["peak_force"]
    for given in (dataset[0], batch, dataset):
        calls: list[Callable[..., Any]] = [cgid.predict, lambda given, rate: cgid.extract(given, rate, names)]
        for call in calls:
            with pytest.raises(InvalidValue, match=f"that of the {type(given).__name__}, 200000 Hz"):
                call(given, 1e5)
            call(given, 200e3)
    for given in (batch, dataset):
        assert len(cgid.predict(given, unit="N")) == len(given)
        for wrong in ({"unit": "mN"}, {"sensitivity": "1 mV/N"}):
            with pytest.raises(InvalidValue, match=next(iter(wrong))):
                cgid.predict(given, **wrong)


def test_features_of_a_batch_are_of_its_own_rate_and_unit(dataset: cgid.Dataset) -> None:
    batch = next(dataset.batches(20))
    in_kn = replace(batch, signals=batch.signals / 1e3, unit="kN")
    measured = cgid.extract(in_kn, features=["peak_force", "impulse"]).attrs["units"]
    assert measured == {"peak_force": "kN", "impulse": "kN s"}
    features = cgid.ImpactFeatures(200e3, ["peak_force", "contact_duration"]).fit(batch)
    assert features.transform(in_kn) == pytest.approx(features.transform(batch), rel=1e-5)
    with pytest.raises(InvalidValue, match="sampling_rate"):
        cgid.ImpactFeatures(100e3, ["contact_duration"]).fit(batch)
    with pytest.raises(InvalidValue, match="sampling_rate"):
        features.transform(replace(batch, sampling_rate=50e3))
    for fitted in (features, cgid.ImpactFeatures(scene="tail_beam", sampling_rate=200e3)):
        other = replace(batch, unit="g") if fitted is features else batch
        with pytest.raises(InvalidValue, match=r"X must be of (force|acceleration), got (acceleration|force)"):
            (fitted.transform if fitted is features else fitted.fit)(other)


def test_features_of_a_dataset_are_those_of_its_batches(dataset: cgid.Dataset) -> None:
    names = ["peak_force", "width_10"]
    table = cgid.extract(dataset, features=names)
    expected = [cgid.extract(batch, features=names) for batch in dataset.batches(25)]
    pd.testing.assert_frame_equal(table, pd.concat(expected, ignore_index=True))
    assert table.attrs["units"] == expected[0].attrs["units"]


@pytest.mark.parametrize("index", [1.5, "a", None, [1, 60], [[1]], [1.5], np.array([True]), 60, -61])
def test_a_wrong_index_is_no_damage(dataset: cgid.Dataset, index: Any) -> None:
    with pytest.raises(InvalidValue, match="index"):
        dataset[index]


def test_part_of_a_batch() -> None:
    (batch,) = cgid.synthesise("reference", 40, seed=2)
    coal = batch.labels == "coal"
    for rows in (slice(5), slice(None, None, -2), coal, coal.tolist(), np.array([7, 3, -1, 3]), [2], []):
        part = batch[rows]
        for name in ("signals", "labels", "specimen"):
            np.testing.assert_array_equal(getattr(part, name), getattr(batch, name)[np.arange(40)[rows]])
        assert list(part.parameters) == list(batch.parameters)
        np.testing.assert_array_equal(part.parameters["radius"], batch.parameters["radius"][np.arange(40)[rows]])
        assert (part.unit, part.sampling_rate, part.source) == (batch.unit, batch.sampling_rate, batch.source)
    for wrong in (3, "coal", 1.5, None, [40], [True, False], (1, 2), coal[:, None]):
        with pytest.raises(InvalidValue, match=r"index must be a slice, a mask or indices of 40 signals, .* got"):
            batch[wrong]


@pytest.mark.parametrize("n_rows", [0, -3, 2.5, "7"])
def test_a_wrong_size_of_batches_is_no_damage(dataset: cgid.Dataset, n_rows: Any) -> None:
    with pytest.raises(InvalidValue, match="n_rows must be a whole number of 1 or more, got"):
        dataset.batches(n_rows)
    assert [len(batch) for batch in dataset.batches(20)] == [20, 5, 20, 5, 10]


def test_paths_and_batches_go_where_their_samples_do(dataset: cgid.Dataset) -> None:
    assert cgid.train_on_specimens(dataset.path, family="linear").model.labels == ("coal", "gangue")
    sample, model = shipped.path_of("datasets", "sample.csv"), cgid.load_model("default")
    by_path = [answer.label for answer in cgid.identify_recording(sample, model)]
    assert by_path == [answer.label for answer in cgid.identify_recording(cgid.open_recording(sample), model)]
    batch = next(dataset.batches(4))
    features = cgid.ImpactFeatures(batch.sampling_rate)
    assert np.array_equal(features.fit_transform(batch), features.fit_transform(batch.signals))


@pytest.mark.parametrize("wrong", [None, 3, 2.5, [], {}, b"x", np.zeros(9), pd.DataFrame({"a": [1.0]}), print, {1}])
def test_wrong_types_are_errors_of_the_package(wrong: Any, training: Training) -> None:
    calls = [
        *(cgid.open_recording, cgid.read_recording, cgid.Dataset, cgid.impact_table, cgid.load_scene),
        *(cgid.train_on_specimens, cgid.train_on_groups, cgid.find_impacts, cgid.load_model),
        lambda given: list(cgid.identify_recording(given, training.model)),
        lambda given: cgid.predict(np.zeros(100), 1e5, given),
        lambda given: cgid.predict(np.zeros(100), given, "N"),
        lambda given: cgid.extract(np.zeros(100), 1e5, given),
    ]
    for call in calls:
        if wrong is None and call is calls[-1]:
            continue  # these are all features
        with pytest.raises(cgid.errors.CgidError):
            call(wrong)


def test_what_is_no_object_of_the_package_is_refused_with_the_way_out(tmp_path: Path) -> None:
    table = pd.DataFrame({"a": [1.0, 2.0]})
    for train in (cgid.train_on_specimens, cgid.train_on_groups):
        with pytest.raises(InvalidValue, match="got DataFrame; a table of features"):
            train(table)
    for features in (None, ["peak_force"]):
        with pytest.raises(InvalidValue, match=r"as of cgid\.synthesise, got tuple among them"):
            cgid.train_on_specimens(cgid.stream("reference", n_signals=64), features=features)
    with pytest.raises(InvalidValue, match="model must be a Model, a Training or"):
        cgid.predict(np.zeros(100), 1e5, "N", model=5)
    with pytest.raises(BadData, match="give a cgid"):
        cgid.predict(np.zeros((5, 100)), 1e5, "N")
    with pytest.raises(InvalidValue, match="signal must be a Signal"):
        cgid.find_impacts(np.zeros(100))
    (tmp_path / "two.csv").write_text("time [s],a [N],b [N]\n" + "".join(f"{k / 1e4},{k % 7},1\n" for k in range(99)))
    with pytest.raises(InvalidValue, match="one channel"):
        cgid.find_impacts(tmp_path / "two.csv")


METHODS = ("predict", "predict_proba", "save")


def test_a_model_shows_what_users_need(training: Training) -> None:
    names = sorted({"inputs", *METHODS, "family", "features", "labels", "sampling_rates", "training", "unit"})
    for model in (cgid.load_model(), training.model):
        assert isinstance(model, cgid.Model)
        assert [name for name in dir(model) if not name.startswith("_")] == names
    assert [name for name in dir(cgid.Model) if not name.startswith("_")] == ["inputs", *METHODS]
    with pytest.raises(InvalidValue, match="load_model"):
        cgid.identification.prediction.identify_frames(np.zeros((1, 64)), 1e5, "default", pre_trigger=8)


def test_models_of_the_same_content_are_equal(training: Training, tmp_path: Path) -> None:
    path = training.model.save(tmp_path / "model.npz")
    one, two = cgid.load_model(path), cgid.load_model(path)
    assert one == two == training.model and hash(one) == hash(two) and len({one, two}) == 1
    arrays = stored(one).arrays
    moved = arrays | {"family.intercepts": arrays["family.intercepts"] + 1.0}
    for other in (replace(stored(one), arrays=moved), replace(one, training={}), training, None):
        assert one != other
    assert training != replace(training, test_probabilities=training.test_probabilities.copy())  # no ValueError


def test_model_and_training_are_saved(training: Training, tmp_path: Path) -> None:
    model = training.model
    assert model.save(tmp_path / "mine.npz").read_bytes() == model.to_bytes()
    with pytest.raises(CannotCreate, match=r"mine\.npz"):
        model.save(tmp_path / "mine.npz")
    assert cgid.load_model(model.save(str(tmp_path / "mine.npz"), overwrite=True)).labels == model.labels
    with pytest.raises(CannotCreate, match=r"\.npz"):
        model.save(tmp_path / "mine.pkl")
    files = training.save(tmp_path / "own.npz", plots=True)
    assert {file.name for file in files} >= {"own.npz", "own.md", "own-roc.png"}
    with pytest.raises(CannotCreate):
        training.save(tmp_path / "own.npz")


def test_an_error_of_one_of_many_signals_names_the_way_out(dataset: cgid.Dataset) -> None:
    signals = next(dataset.batches()).signals.copy()
    signals[4] = 0
    with pytest.raises(BadData, match=r"^signal 4: .*; invalid='nan' gives such signals a row of nan$"):
        cgid.extract(signals, dataset.sampling_rate, ["peak_force"])
    assert cgid.extract(signals, dataset.sampling_rate, ["peak_force"], invalid="nan")["peak_force"].isna().sum() == 1
