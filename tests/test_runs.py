"""Runs that are killed, interrupted, resumed, begun twice: what is whole stays whole, and all ends as it should."""

import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from cgid.errors import BadData, CannotCreate
from cgid.scene import generate, generate_recordings, parse_scene
from cgid.scene.output import generation
from cgid.store import Dataset
from cgid.store.verification import verify
from tests import few
from tests.test_store import scene_of
from tests.test_stream import content as stream_content

ROOT = Path(__file__).parents[1]
SCENE = scene_of(32)
STREAM = parse_scene(stream_content(duration="0.5 s", sensor={"absolute_noise": "10 N"}))
#: The options of a run of four shards.
OPTIONS = {"n_signals": 400, "seed": 3, "shard_signals": 100}


def dataset(path, **options):
    return generate(SCENE, path, **{**OPTIONS, **options})


def recordings(path, **options):
    return generate_recordings(STREAM, path, **{"n_recordings": 3, "seed": 3, **options})


class Stop(Exception):
    pass


def stopped(make, path, after=1, **options):
    """Begin a run and stop it when files have been finished; return what is in the folders."""
    done = 0

    def stop(count):
        nonlocal done
        done += bool(count)
        if len((path / "SHA256SUMS").read_text().splitlines()) > after:
            raise Stop

    with pytest.raises(Stop):
        make(path, progress=stop, **options)
    assert done


def files(folder):
    """Return every file below a folder, hidden ones, too, with its content."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return {make: files(make(folder / make.__name__)) for make in (dataset, recordings)}


@pytest.fixture
def path(tmp_path):
    (tmp_path / "here").mkdir()
    return tmp_path / "here" / "data"


# ---- killed ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("kills", few([2, 12]))
def test_killed_runs_go_on_to_the_same_bytes(kills):
    """The short form of the benchmark, in a process of its own: it forks."""
    command = [sys.executable, "benchmarks/safety/kills.py", "--kills", str(kills), "--with-workers", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("| nothing |") == 4


@pytest.mark.parametrize("make", [dataset, recordings])
@pytest.mark.parametrize("older", [False, True])
def test_a_stopped_run_goes_on_to_the_same_bytes(whole, path, make, older):
    if older:
        make(path, seed=1)
    stopped(make, path, overwrite=older)
    if older:  # what is there is of two descriptions, and no dataset
        with pytest.raises(BadData):
            len(list(Dataset(path)))
        assert verify(path).damage
    with pytest.raises(CannotCreate, match="resume=True"):
        make(path)
    first = next(path.glob("*-00000.h5"))
    time = first.stat().st_mtime_ns
    make(path, resume=True)
    assert files(path) == whole[make]
    assert first.stat().st_mtime_ns == time
    assert [left.name for left in path.parent.iterdir()] == ["data"]


def test_a_shard_is_written_beside_the_making_of_the_next(whole, path, monkeypatch):
    made, write = threading.Event(), generation.write_whole

    def waiting(file, *content, **options):
        assert made.wait(60) or file.name != "shard-00000.h5"
        write(file, *content, **options)

    monkeypatch.setattr(generation, "write_whole", waiting)
    n_made = 0

    def count(number):
        nonlocal n_made
        n_made += number
        if n_made > OPTIONS["shard_signals"]:
            made.set()

    dataset(path, progress=count)
    assert files(path) == whole[dataset]


@pytest.mark.long
def test_ctrl_c_with_two_workers_and_on(whole, path):
    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dataset(path, jobs=2, progress=interrupt)
    assert not list(path.glob("*.part")) and (path / "description.json").exists()
    dataset(path, resume=True)
    assert files(path) == whole[dataset]


@pytest.mark.long
def test_a_spawned_process_makes_the_same_bytes(whole, path):
    """As on Windows, where no process is forked: all that is handed over must be pickled."""
    process = multiprocessing.get_context("spawn").Process(target=dataset, args=(path,))
    process.start()
    process.join()
    assert process.exitcode == 0
    assert files(path) == whole[dataset]


# ---- what is resumed -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [dataset, recordings])
def test_what_is_whole_is_left_as_it_is(whole, path, make):
    make(path)
    times = {file: file.stat().st_mtime_ns for file in path.glob("*.h5")}
    make(path, resume=True)
    assert files(path) == whole[make]
    assert {file: file.stat().st_mtime_ns for file in path.glob("*.h5")} == times
    with pytest.raises(CannotCreate, match="seed"):
        make(path, resume=True, seed=4)
    make(path, resume=True, seed=4, overwrite=True)
    assert files(path) != whole[make]


@pytest.mark.parametrize(
    ("name", "value", "first"),
    [
        ("seed", 4, 3),
        ("n_signals", 500, 400),
        ("shard_signals", 50, 100),
        ("dtype", "float64", "float32"),
    ],
)
def test_other_options_are_refused(path, name, value, first):
    stopped(dataset, path)
    before = files(path)
    with pytest.raises(CannotCreate, match=rf"{name} .*{first}.*{value}"):
        dataset(path, resume=True, **{name: value})
    assert files(path) == before


@pytest.mark.parametrize("damage", ["flip", "cut", "missing"])
def test_finished_shards_that_are_damaged_are_made_again(whole, path, damage):
    stopped(dataset, path, after=2)
    shard = path / "shard-00000.h5"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    if damage == "missing":
        shard.unlink()
    else:
        shard.write_bytes(content if damage == "flip" else content[:-1])
    dataset(path, resume=True)
    assert files(path) == whole[dataset]


@pytest.mark.parametrize("damage", ["gone", "cut", "flipped"])
def test_a_description_that_is_lost_is_written_again(whole, path, damage):
    stopped(dataset, path, after=2)
    file, time = path / "description.json", (path / "shard-00000.h5").stat().st_mtime_ns
    content = file.read_bytes()
    file.unlink() if damage == "gone" else file.write_bytes(
        content[:50] if damage == "cut" else content.replace(b'"seed": 3', b'"seed": 2')
    )
    dataset(path, resume=True)
    assert files(path) == whole[dataset]
    assert (path / "shard-00000.h5").stat().st_mtime_ns == time


def test_a_shard_without_a_sum_that_is_not_whole_is_made_again(whole, path):
    """Killed between a shard and its sum; and shards of another run, number or content."""
    dataset(path)
    other = dataset(path.with_name("other"), seed=4)
    (path / "SHA256SUMS").unlink()
    shards = [path / f"shard-0000{number}.h5" for number in range(4)]
    content = bytearray(shards[0].read_bytes())
    content[len(content) // 2] ^= 1
    shards[0].write_bytes(content)
    shards[1].write_bytes((other / "shard-00001.h5").read_bytes())
    shards[2].write_bytes(shards[3].read_bytes())
    dataset(path, resume=True)
    assert files(path) == whole[dataset]


@pytest.mark.parametrize("options", [{"resume": True}, {"overwrite": True}])
@pytest.mark.parametrize("name", ["manifest.json", "unfinished.jsonl"])
def test_datasets_of_a_development_version_are_left_alone(path, name, options):
    path.mkdir()
    (path / name).write_text('{"format": "cgid-dataset"}')
    with pytest.raises(CannotCreate, match=name):
        dataset(path, **options)
    assert [left.name for left in path.iterdir()] == [name]


def test_recordings_of_a_development_version_are_not_resumed(whole, path):
    """They have sums without a description, so that nothing says of what scene they are."""
    path.mkdir()
    (path / "SHA256SUMS").write_text(f"{64 * '0'}  recording-00000.h5\n")
    with pytest.raises(BadData, match="another folder"):
        recordings(path, resume=True)
    assert not (path / "description.json").exists()
    recordings(path, overwrite=True)
    assert files(path) == whole[recordings]


def test_one_file(tmp_path):
    path = tmp_path / "data.h5"
    with pytest.raises(Stop):
        dataset(path, progress=lambda _: (_ for _ in ()).throw(Stop))
    assert not list(tmp_path.iterdir())
    dataset(path, resume=True)
    before = files(tmp_path)
    dataset(path, resume=True)
    assert files(tmp_path) == before
    for options, says in (
        ({"seed": 4}, "seed"),
        ({"n_signals": 10}, "n_signals"),
        ({"dtype": "float64"}, "dtype"),
    ):
        with pytest.raises(CannotCreate, match=says):
            dataset(path, resume=True, **options)
    dataset(path, resume=True, overwrite=True, seed=4)
    assert files(tmp_path) != before


# ---- two at once -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [dataset, recordings])
@pytest.mark.parametrize("options", [{}, {"overwrite": True}, {"resume": True}, {"resume": True, "overwrite": True}])
@pytest.mark.parametrize("older", [False, True])
def test_a_second_run_is_refused(whole, path, make, options, older):
    if older:
        make(path, seed=1)
    refusals = []

    def second(_):
        if not refusals:
            with pytest.raises(CannotCreate) as refused:
                make(path, **options)
            refusals.append(str(refused.value))

    make(path, progress=second, overwrite=older)
    assert files(path) == whole[make]
    assert [left.name for left in path.parent.iterdir()] == ["data"]


@pytest.mark.parametrize("make", [dataset, recordings])
def test_a_file_that_another_run_has_made_meanwhile_is_kept(tmp_path, make):
    path = tmp_path / "data.h5"
    one = {"n_signals": 100} if make is dataset else {"n_recordings": 1}

    def other(_):
        path.write_bytes(b"theirs")

    with pytest.raises(CannotCreate, match=r"data\.h5"):
        make(path, progress=other, **one)
    assert files(tmp_path) == {"data.h5": b"theirs"}


# ---- overwriting -----------------------------------------------------------------------------------------------------


def test_what_others_put_into_a_folder_meanwhile_is_kept(path):
    dataset(path, seed=1)
    dataset(path, overwrite=True, progress=lambda _: (path / "thesis.txt").write_text("mine"))
    assert (path / "thesis.txt").read_text() == "mine"
    assert Dataset(path).header.attributes["seed"] == 3


def test_a_worker_of_an_earlier_run_replaces_nothing(whole, path, monkeypatch):
    """A lock dies with its process, a worker does not: it compares the description just before it gives the name."""
    dataset(path)
    before = files(path)
    monkeypatch.setattr("cgid.store.run.clear", lambda *_, **__: None)

    def another_run(folder):
        (folder / "description.json").write_bytes(before["description.json"].replace(b'"seed": 3', b'"seed": 5'))

    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (fsync(number), another_run(path)))
    with pytest.raises(CannotCreate, match=r"description\.json"):
        dataset(path, seed=4, overwrite=True)
    assert {name: content for name, content in files(path).items() if name.startswith("shard")} == {
        name: content for name, content in before.items() if name.startswith("shard")
    }


@pytest.mark.long
def test_a_reader_never_sees_a_mixture(path):
    dataset(path, seed=1)
    before = files(path)
    reader, late = Dataset(path), Dataset(path)
    signals = iter(reader)
    next(signals)
    dataset(path, overwrite=True)
    assert files(path) != before
    for read in (lambda: list(signals), lambda: late.signal(0), lambda: list(late)):
        with pytest.raises(BadData):
            read()
    assert len(list(Dataset(path).batches())) == 4
