"""Recordings on disk: whole or not at all, the same bytes twice, read back as they were; damage is told."""

import json
import subprocess
import sys
import tracemalloc

import h5py
import numpy as np
import pytest

from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate
from cgid.measure.features.extraction import extract_array
from cgid.recordings import is_dataset, read_recording
from cgid.scene import generate_recordings, parse_scene
from cgid.scene.synthesis.stream import impact_units, record
from cgid.store import Dataset
from cgid.store.hdf5 import RecordingPlan, writing
from cgid.store.reading import Recording, is_recording
from tests.test_stream import RATE, content

SCENE = parse_scene(content(duration="5 s", rebounds={"most": 2}, sensor={"absolute_noise": "10 N"}))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    generate_recordings(SCENE, folder / "one.h5", seed=3)
    generate_recordings(SCENE, folder / "three", 3, seed=3)
    return folder


def plan_of(n_samples=100_000, **attributes):
    return RecordingPlan(n_samples=n_samples, dtype="float32", sampling_rate=RATE, unit="N", attributes=attributes)


def impacts_of(count=3):
    return {
        "time": np.arange(count) * 1.0,
        "label": np.array(["coal"] * count),
        "specimen": np.arange(count).astype("u8"),
    }


# ---- what comes back -------------------------------------------------------------------------------------------------


def test_what_is_read_is_what_was_made(made):
    signal, truth = record(SCENE, 3)
    stored = Recording(made / "one.h5")
    np.testing.assert_array_equal(stored.samples(), signal.samples)
    np.testing.assert_array_equal(stored.samples(70_000, 70_100), signal.samples[70_000:70_100])
    assert stored.sampling_rate == RATE and stored.unit == "N" and stored.start == 0
    found = stored.impacts()
    assert found.keys() == truth.keys() and stored.n_impacts == truth["time"].size > 60
    for name, column in truth.items():
        np.testing.assert_array_equal(found[name], column)
    assert stored.impact_units == {**impact_units(SCENE), "label": "", "specimen": ""}


def test_recordings_of_a_folder_are_those_of_their_numbers(made):
    files = sorted(path.name for path in (made / "three").glob("*.h5"))
    assert files == [f"recording-{number:05d}.h5" for number in range(3)]
    first, alone = Recording(made / "three" / files[0]), Recording(made / "one.h5")
    np.testing.assert_array_equal(first.samples(), alone.samples())
    assert first.impacts().keys() == alone.impacts().keys()
    samples = [Recording(made / "three" / file).samples() for file in files]
    np.testing.assert_array_equal(samples[2], record(SCENE, 3, 2)[0].samples)
    assert (samples[0] != samples[1]).mean() > 0.99


@pytest.mark.long
def test_twice_the_same_bytes_in_another_process(made, tmp_path):
    (tmp_path / "scene.json").write_text(SCENE.text)
    program = (
        "import json, sys; from cgid.scene import parse_scene\n"
        "from cgid.scene import generate_recordings\n"
        "generate_recordings(parse_scene(json.load(open(sys.argv[1]))), sys.argv[2], seed=3)"
    )
    subprocess.run([sys.executable, "-c", program, tmp_path / "scene.json", tmp_path / "again.h5"], check=True)
    assert (tmp_path / "again.h5").read_bytes() == (made / "one.h5").read_bytes()


# ---- as a recording like any other -----------------------------------------------------------------------------------


def test_it_is_read_as_a_recording(made):
    path = made / "one.h5"
    assert is_recording(path) and not is_dataset(path) and is_dataset(made)
    (signal,) = read_recording(path)
    np.testing.assert_array_equal(signal.samples, Recording(path).samples())
    assert (signal.unit, signal.sampling_rate, signal.channel) == ("N", RATE, "1")
    with pytest.raises(BadData, match="header states N"):
        read_recording(path, unit="g")
    with pytest.raises(BadData, match="must be a cgid dataset"):
        Dataset(path)


def test_commands_understand_it(made, capfd):
    path = str(made / "one.h5")
    assert run(["info", path, "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    truth = Recording(path).impacts()
    assert said["kind"] == "recording" and said["channel 1"]["samples"] == 128_000
    assert (
        said["truth"]["impacts"] == truth["time"].size and sum(said["truth"]["labels"].values()) == truth["time"].size
    )
    assert run(["features", path, "--features", "peak_force", "--json"]) == 0
    rows = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert len(rows) > 20
    # Impacts that are found stand where the truth has one.
    distance = [np.abs(truth["time"] - row["time_s"]).min() for row in rows]
    assert np.median(distance) < 2 / RATE and max(distance) < 5e-3


def test_what_is_measured_is_what_the_truth_says(made):
    stored = Recording(made / "one.h5")
    truth, samples = stored.impacts(), stored.samples()
    clear = (np.append(np.inf, truth["next_impact"][:-1]) > 5e-3) & (truth["next_impact"] > 5e-3)
    clear &= (truth["peak_force"] > 2000) & (truth["contact_duration"] * RATE > 12) & (truth["time"] > 0.01)
    rows = np.flatnonzero(clear)
    assert rows.size > 5
    for row in rows:
        first = round(truth["time"][row] * RATE) - 64
        (peak, duration) = extract_array(
            samples[None, first : first + 160], RATE, ["peak_force", "contact_duration"], pre_trigger=63
        )[0]
        assert peak == pytest.approx(truth["peak_force"][row], rel=0.05)
        assert duration == pytest.approx(truth["contact_duration"][row], rel=0.3)


# ---- whole or not at all ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [99_999, 100_001])
def test_a_recording_must_have_all_its_samples_and_no_more(tmp_path, count):
    with (
        pytest.raises(BadData, match=f"100000 samples received {count}"),
        writing(tmp_path / "x.h5", plan_of()) as writer,
    ):
        writer.add(np.zeros(count, np.float32))
        writer.add_impacts(impacts_of(), {})
    assert not list(tmp_path.iterdir())


def test_overwriting_takes_the_old_recordings_away(made, tmp_path):
    folder = tmp_path / "some"
    generate_recordings(SCENE, folder, 2, seed=1)
    (folder / ".recording-00007.h5.0123456789ab.part").write_bytes(b"left by a killed run")
    with pytest.raises(CannotCreate, match="exists already"):
        generate_recordings(SCENE, folder, 1, seed=3)
    generate_recordings(SCENE, folder, 1, seed=3, overwrite=True)
    (only,) = folder.glob("*.h5")
    assert only.read_bytes() == (made / "one.h5").read_bytes()


def test_memory_does_not_grow_with_the_length(tmp_path):
    peaks = []
    for seconds in (240, 480):
        scene = parse_scene(content(duration=seconds, arrivals={"rate": "0.2 Hz"}))
        tracemalloc.start()
        generate_recordings(scene, tmp_path / f"{seconds}.h5")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0] < 0.5 * 240 * RATE * 8


# ---- damage ----------------------------------------------------------------------------------------------------------


def test_every_flipped_byte_of_the_samples_is_found(made, tmp_path):
    content = bytearray((made / "one.h5").read_bytes())
    wanted = Recording(made / "one.h5")
    samples, truth = wanted.samples(), wanted.impacts()
    rng = np.random.default_rng(0)
    found = 0
    for place in rng.integers(0, len(content), 60):
        damaged = content.copy()
        damaged[place] ^= 1 << rng.integers(8)
        (tmp_path / "damaged.h5").write_bytes(damaged)
        try:
            stored = Recording(tmp_path / "damaged.h5")
            # What is still read must be right: a flipped bit may lie in unused space.
            np.testing.assert_array_equal(stored.samples(), samples)
            for name, column in stored.impacts().items():
                np.testing.assert_array_equal(column, truth[name])
        except BadData:
            found += 1
    assert found > 30


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda file: file.attrs.__setitem__("schema_version", 9), "schema_version 9 is newer.*upgrade"),
        (lambda file: file["samples"].attrs.__setitem__("sampling_rate", -1.0), "sampling_rate"),
        (lambda file: file.__delitem__("impacts"), "impacts must be a group"),
        (lambda file: file["impacts"].__delitem__("time"), "column time"),
        (lambda file: file.attrs.__setitem__("n_impacts", 3), "one value an impact"),
        (lambda file: (file.__delitem__("samples"), file.create_dataset("samples", data=np.zeros((3, 3)))), "row of"),
    ],
)
def test_headers_that_are_not_believed(made, tmp_path, change, says):
    path = tmp_path / "changed.h5"
    path.write_bytes((made / "one.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(BadData, match=says):
        Recording(path)
