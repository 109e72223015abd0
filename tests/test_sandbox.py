"""HDF5 is read in a process of its own: what it answers, how it ends, and what hostile files do to it."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from cgid.errors import BadData
from cgid.store import Dataset, sandbox
from tests import few
from tests.hostile_hdf5 import KINDS

#: More than a pipe holds.
NUMBERS = np.arange(400_000.0).reshape(2000, 200)
ROOT = Path(__file__).parents[1]


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "numbers.h5"
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file.create_dataset("x", data=NUMBERS, chunks=(100, 200), fletcher32=True)
        file.create_dataset("nothing", shape=(0,), dtype="S3", chunks=(5,), maxshape=(None,))
        file.attrs["format"] = np.bytes_(b"numbers")
    return path


def parts(path, length=300, stop=2000):
    return sandbox.stream("rows", path, ["x"], 0, stop, length)


def readers():
    return [child.process for child in sandbox._alive]


def test_rows_are_those_of_h5py(path):
    found = [part["x"] for part in parts(path)]
    assert [len(part) for part in found] == [300] * 6 + [200]
    np.testing.assert_array_equal(np.concatenate(found), NUMBERS)
    (empty,) = sandbox.stream("rows", path, ["nothing"], 0, 0, 10)
    assert empty["nothing"].shape == (0,) and empty["nothing"].dtype == "S3"


@pytest.mark.parametrize("kind", KINDS)
def test_who_reads_does_without_h5py(tmp_path, kind):
    KINDS[kind].write(tmp_path / "sound.h5")
    code = {
        "dataset": "from cgid.store import Dataset; print(sum(map(len, Dataset(sys.argv[1]))))",
        "recording": "from cgid.store.reading import Recording; print(Recording(sys.argv[1]).samples().size)",
        "table": "from cgid.store import read_table; print(len(read_table(sys.argv[1])))",
        "foreign": "from cgid.recordings import open_recording as read; "
        "print(read(sys.argv[1], variable='run/samples').n_samples)",
    }[kind]
    command = [sys.executable, "-c", f"import sys; {code}; sys.exit('h5py' in sys.modules)", tmp_path / "sound.h5"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    wanted = {"dataset": "24", "recording": "384", "table": "24", "foreign": "500"}
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, wanted[kind], "")


def test_files_are_read_side_by_side_and_a_reader_is_kept(path):
    sandbox._end_all()
    pairs = list(zip(parts(path), parts(path, 299), strict=True))
    assert len(pairs) == 7 and len(readers()) == 2
    before = {process.pid for process in readers()}
    half = parts(path)
    next(half)
    half.close()  # ends its reader, and with it whatever the file still does
    assert sandbox.format_said(path) == "numbers"
    assert len(readers()) == 1 and {process.pid for process in readers()} < before


def no_thread(*_):
    raise RuntimeError("can't start new thread")


@pytest.mark.parametrize("start", [no_thread, lambda *_: 0], ids=["refused", "dead before its first step"])
def test_no_room_for_a_thread_is_no_room_for_a_reader_alone(path, monkeypatch, start):
    """What a reader has begun it ends without another thread; the next file is read."""
    sandbox._end_all()
    asked = parts(path)
    found, before = [next(asked)["x"]], readers()
    with monkeypatch.context() as short:
        short.setattr(sandbox._thread, "start_new_thread", start)
        short.setattr(sandbox, "_BEGINS", 0.0)
        with pytest.raises(MemoryError, match="no room for one more thread"):
            next(parts(path))
        found += [part["x"] for part in asked]
        assert readers() == before
        assert sandbox.format_said(path) == "numbers"  # by the reader that is free again
    np.testing.assert_array_equal(np.concatenate(found), NUMBERS)
    np.testing.assert_array_equal(np.concatenate([part["x"] for part in parts(path)]), NUMBERS)


def test_a_reader_that_is_late_is_ended_and_the_next_is_not(path, monkeypatch):
    sandbox._end_all()
    assert sandbox.format_said(path) == "numbers"
    (process,) = readers()
    os.kill(process.pid, signal.SIGSTOP)
    with monkeypatch.context() as short:
        short.setattr(sandbox, "patience_for", lambda _: 0.0)
        with pytest.raises(BadData, match=r"numbers\.h5: the HDF5 library did not come to an end on this file"):
            sandbox.call("format_said", path)
    assert process.returncode == -signal.SIGKILL
    assert sandbox.format_said(path) == "numbers"


def test_threads_do_not_hear_each_other(path):
    wrong = []

    def read(length):
        for _ in range(5):
            found = np.concatenate([part["x"] for part in parts(path, length)])
            if not np.array_equal(found, NUMBERS):
                wrong.append(length)

    threads = [threading.Thread(target=read, args=(length,)) for length in (150, 300, 700)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_a_reader_that_was_ended_is_replaced(path):
    assert sandbox.format_said(path) == "numbers"
    for process in readers():
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert sandbox.format_said(path) == "numbers"


def test_a_reader_that_ends_over_a_file_is_an_error_of_that_file_alone(path):
    other, half = parts(path), parts(path)
    first = next(other)["x"]
    before = set(readers())
    next(half)
    (process,) = set(readers()) - before or before
    os.kill(process.pid, signal.SIGSEGV)
    with pytest.raises(BadData, match=r"numbers\.h5: the HDF5 library crashed on this file; it is damaged or hostile"):
        list(half)
    rest = [part["x"] for part in other]
    np.testing.assert_array_equal(np.concatenate([first, *rest]), NUMBERS)


def test_a_forked_process_has_readers_of_its_own(path):
    stream = parts(path)
    next(stream)
    child = os.fork()
    if not child:
        os._exit(7 if sandbox.format_said(path) == "numbers" else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert len(list(stream)) == 6


def test_a_forked_process_is_told_that_it_cannot_read_on(path):
    """The file is not to blame, and the process that began reads on."""
    stream = parts(path)
    next(stream)
    child = os.fork()
    if not child:
        try:
            next(stream)
        except Exception as error:
            os._exit(7 if "was forked from it meanwhile; begin anew here" in str(error) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert len(list(stream)) == 6


def test_a_reader_ends_with_whom_it_reads_for_and_hears_no_interruption(path):
    code = (
        "import os, signal, sys; from pathlib import Path; from cgid.store import sandbox; path = Path(sys.argv[1]);"
        "sandbox.format_said(path); (child,) = sandbox._alive; os.kill(child.process.pid, signal.SIGINT);"
        "print(child.process.pid, sandbox.format_said(path), flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, path], cwd=ROOT, capture_output=True, text=True)
    pid, said = done.stdout.split()
    assert said == "numbers"
    for _ in range(6000):
        # It may lie there dead until whoever has inherited it looks.
        status = Path(f"/proc/{pid}/stat")
        if not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z":
            break
        time.sleep(0.01)
    else:
        pytest.fail("the reader has outlived whom it read for")


def test_paths_are_those_of_the_one_who_asks(path, monkeypatch):
    sandbox.format_said(path)
    monkeypatch.chdir(path.parent)
    assert sandbox.format_said(Path("numbers.h5")) == "numbers"
    with pytest.raises(BadData, match=r"^numbers\.h5: this HDF5 file must be a cgid dataset"):
        Dataset("numbers.h5")


def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(BadData, match="must be a regular file"):
        Dataset(tmp_path / "pipe.h5")


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"{",
        b"[]\n",
        b"[" * 100_000 + b"\n",
        b'{"value": 1}\n',
        b'{"arrays": [["x", "|O", [3]]]}\n',
        b'{"arrays": [["x", "|V8", [3]]]}\n',
        b'{"arrays": [["x", "<f3", [3]]]}\n',
        b'{"arrays": [["x", "<f8", [-1]]]}\n',
        b'{"arrays": [["x", "<f8", [1e3]]]}\n',
        b'{"arrays": [["x", "<f8", [1000000000000]]]}\n',
        b'{"arrays": [["x", "<f8", [4]]]}\n' + bytes(31),
        b'{"arrays": 3}\n',
        b"x" * (sandbox.LONGEST_LINE + 2),
    ],
)
def test_answers_that_make_no_sense_are_refused_before_room_is_made(line):
    with pytest.raises(sandbox.BrokenWire):
        sandbox.receive(io.BytesIO(line), 1 << 20)


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "u1", "S7", "?", "c16"])
def test_what_is_sent_arrives(dtype):
    array = np.ones((3, 4), dtype)[::2].T
    stream = io.BytesIO()
    sandbox.send(stream, {"value": {"a": [1.5, "ü", None]}}, {"x": array, "none": array[:0]})
    stream.seek(0)
    message, arrays = sandbox.receive(stream, 1 << 20)
    assert message == {"value": {"a": [1.5, "ü", None]}}
    for name, wanted in (("x", array), ("none", array[:0])):
        np.testing.assert_array_equal(arrays[name], wanted, strict=True)
    assert not stream.read()


@pytest.mark.long
@pytest.mark.parametrize("kinds", few([["table"], list(KINDS)]))
def test_hostile_files_and_mutants_do_no_harm(kinds):
    """All hand-made files of these kinds and some mutants; the longest form is `benchmarks/hostile.py` with 5,000."""
    # A processor that two share counts its time double.
    code = (
        "from benchmarks import hostile; hostile.TIME_LIMIT = 20.0; "
        f"[hostile.KINDS.pop(kind) for kind in {sorted(KINDS.keys() - set(kinds))}]; hostile.main()"
    )
    command = [sys.executable, "-c", code, "--mutants", str(10 * len(kinds))]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 failed" in done.stdout and "files outside opened: 0; code run: 0" in done.stdout


def test_the_watch_sees_what_it_watches_for(tmp_path):
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        from hostile import Watch
    finally:
        sys.path.pop(0)
    (tmp_path / "secret").write_text("x")
    watch = Watch(tmp_path)
    assert watch.opened() == []
    (tmp_path / "secret").read_text()
    assert "secret" in watch.opened()


@pytest.mark.parametrize(("rests", "code"), [(False, -signal.SIGALRM), (True, 0)])
def test_a_reader_that_is_held_up_ends_by_itself(tmp_path, rests, code):
    """By a pipe that nobody writes into, which takes no time of the processor."""
    (tmp_path / "file").write_bytes(b"")
    script = (
        "import os, select, sys; from cgid.store import sandbox; sandbox._CLOCK, sandbox._LATER = 0.05, 0.05\n"
        "sandbox.begin(sys.argv[1]); sys.argv[2] == 'True' and sandbox.rest()\n"
        "select.select([os.pipe()[0]], [], [], 0.5 if sys.argv[2] == 'True' else 60)"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "file"), str(rests)], capture_output=True)
    assert done.returncode == code, done.stderr


def test_without_limits_of_the_system_files_are_read_all_the_same(path):
    """As on Windows, which has neither fcntl, nor resource, nor timers of processor time."""
    script = (
        "import signal, sys; sys.modules['fcntl'] = sys.modules['resource'] = None; del signal.setitimer\n"
        "from pathlib import Path; from cgid.store import _reader, sandbox\n"
        "sandbox.settle(); sandbox.begin(sys.argv[1]); sandbox.allow(1 << 40); sandbox.rest()\n"
        "parts = sandbox.stream('rows', Path(sys.argv[1]), ['x'], 0, 2000, 300)\n"
        "print(sum(len(part['x']) for part in parts), _reader.format_said(sys.argv[1], ''))"
    )
    done = subprocess.run([sys.executable, "-c", script, path], cwd=ROOT, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("2000 numbers\n", "")
