"""What becomes of files when the disk does not obey; the long form is benchmarks/safety/faults.py."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchmarks.safety.faults import COMMANDS, FAULTS, Server, Trial, files_in, inputs, load, sweep
from cgid._lib.files import whole_file, write_together
from cgid.cli.main import run
from cgid.errors import WriteFailed
from cgid.store.disk import DiskFile, hdf5_on_disk
from cgid.store.hdf5 import RecordingPlan, writing
from tests import few

ROOT = Path(__file__).parents[1]
FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="this machine has no /dev/full")
#: Commands that are quick, one for each way to write: a shard in memory, HDF5 on the disk, text, files together.
QUICK = ("generate: file", "generate: table, HDF5", "generate: table, CSV", "train")


# ---- HDF5 straight to the disk ---------------------------------------------------------------------------------------


class Refusing:
    """A raw file whose writes fail from the k-th on."""

    def __init__(self, file, first, error):
        self._file, self._first, self._error, self.writes = file, first, error, 0

    def __getattr__(self, name):
        return getattr(self._file, name)

    def write(self, content):
        self.writes += 1
        if self.writes >= self._first:
            raise self._error
        return self._file.write(content)


def fill(output):
    """Write what HDF5 has to read back on the way: rows that end within chunks, and many small headers."""
    with output.step() as file:
        file.create_dataset("rows", (0,), "f8", maxshape=(None,), chunks=(64,), fletcher32=True)
    for start in range(0, 2000, 300):
        with output.step() as file:
            file["rows"].resize((start + 300,))
            file["rows"][start:] = np.arange(start, start + 300.0)
    with output.step() as file:
        for number in range(40):
            file.create_dataset(f"more/{number}", data=np.arange(3), chunks=(3,), fletcher32=True)


def write_refused(path, first, error):
    """Write until the disk refuses; return how many writes there were."""
    path.write_bytes(b"")
    with hdf5_on_disk(path) as output:
        output._disk._disk = disk = Refusing(output._disk._disk, first, error)
        fill(output)
    return disk.writes


def test_whatever_write_fails_is_raised_once_hdf5_has_let_go(tmp_path):
    path = tmp_path / "file.h5"
    error = OSError(28, "No space left on device")
    n_writes = write_refused(path, 1 << 30, error)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["rows"][:], np.arange(2100.0))
    assert n_writes > 100
    for first in (*range(1, 51), *range(51, n_writes, 25), n_writes):
        with pytest.raises(OSError, match="No space left") as caught:
            write_refused(path, first, error)
        assert caught.value is error


@needs_full
def test_a_full_disk_leaves_no_file_and_no_crash_at_exit(tmp_path):
    program = (
        "import sys, pathlib\nfrom cgid.store.disk import hdf5_on_disk\nfrom tests.test_faults import fill\n"
        "try:\n    with hdf5_on_disk(pathlib.Path('/dev/full')) as output:\n        fill(output)\n"
        "except OSError as error:\n    print(error.strerror)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "No space left on device\n", "")


def test_what_was_refused_is_read_back(tmp_path):
    (tmp_path / "file").touch()
    file = DiskFile(tmp_path / "file")
    file.write(b"abcdef")
    file._disk = Refusing(file._disk, 1, OSError(5, "broken"))
    file.seek(4)
    file.write(b"XYZ")
    file.seek(1)
    found = bytearray(10)
    assert file.readinto(found) == 6 and found[:6] == b"bcdXYZ"
    file.close()
    assert str(file.failure) == "[Errno 5] broken"


def test_ctrl_c_waits_until_hdf5_is_done(tmp_path):
    (tmp_path / "file.h5").touch()
    reached = []
    with pytest.raises(KeyboardInterrupt), hdf5_on_disk(tmp_path / "file.h5") as output:
        with output.step() as file:
            signal.raise_signal(signal.SIGINT)
            file["kept"] = [1, 2]
            reached.append(True)
        reached.append(False)
    assert reached == [True]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_reader_during_a_write_sees_old_or_new(tmp_path):
    path = tmp_path / "data.h5"
    plan = RecordingPlan(n_samples=50_000, dtype="float32", sampling_rate=1e4, unit="N", attributes={})

    def make(value):
        with writing(path, plan) as writer:
            writer.add(np.full(50_000, value, np.float32))
            writer.add_impacts({"time": np.arange(3.0)}, {"time": "s"})

    make(0)
    child = os.fork()
    if not child:
        for value in range(1, 40):
            make(value)
        os._exit(0)
    seen = set()
    while not os.waitpid(child, os.WNOHANG)[0]:
        with h5py.File(path) as file:
            values = np.unique(file["samples"][:])
        assert values.size == 1
        seen.add(float(values[0]))
    assert len(seen) > 1 and sorted(file.name for file in tmp_path.iterdir()) == ["data.h5"]


MAKERS = {
    "export": ("export {0}/../two.h5 -o {0}/data.h5 --overwrite", "data.h5"),
    "signals": ("generate reference -n 9 -o {0}/data.h5 --overwrite", "data.h5"),
    "table": ("generate reference -n 9 --parameters-only -o {0}/data.csv --overwrite", "data.csv"),
    "recording": ("generate {0}/../stream.toml -o {0}/data.h5 --overwrite", "data.h5"),
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sources")
    assert run(["generate", "reference", "-n", "9", "-o", str(folder / "two.h5")]) == 0
    shutil.copy(ROOT / "tests" / "golden" / "stream.toml", folder)
    return folder


@pytest.mark.parametrize("name", MAKERS)
def test_the_next_file_of_a_name_clears_what_a_killed_process_left(sources, name):
    command, file = MAKERS[name]
    folder = sources / name
    folder.mkdir()
    other = folder / f".{file}x.0123456789ab.part"  # of another name
    other.touch()
    died = "import os, signal, sys; from cgid._lib.files import whole_file\n"
    died += "with whole_file(sys.argv[1]) as part: part.write_bytes(b'half'); os.kill(os.getpid(), signal.SIGKILL)"
    subprocess.run([sys.executable, "-c", died, folder / file], cwd=ROOT, check=False)
    (left,) = folder.glob(f".{file}.*.part")
    os.utime(left, (0, 0))
    with whole_file(folder / file) as written_by_another:
        assert run(command.format(folder).split()) == 0
        assert written_by_another.exists() and other.exists() and not left.exists()


# ---- files together --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("old", [{}, {"a": b"1", "b": b"2", "c": b"3"}, {"b": b"2"}], ids=["none", "all", "one"])
@pytest.mark.parametrize("first", [1, 2, 3])
def test_files_are_replaced_together_or_not_at_all(tmp_path, monkeypatch, old, first):
    for name, content in old.items():
        (tmp_path / name).write_bytes(content)
    calls, replace = [], Path.replace

    def refused(self, target):
        calls.append(target)
        if len(calls) == first:
            raise PermissionError(13, "Permission denied")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refused)
    with pytest.raises(WriteFailed):
        write_together({tmp_path / name: name.encode() * 5 for name in "abc"})
    assert files_in(tmp_path) == old
    write_together({tmp_path / name: name.encode() * 5 for name in "abc"})
    assert files_in(tmp_path) == {"a": b"aaaaa", "b": b"bbbbb", "c": b"ccccc"}


def test_what_cannot_be_given_back_is_not_thrown_away(tmp_path, monkeypatch):
    for name in "ab":
        (tmp_path / name).write_bytes(b"old " + name.encode())
    replace, done = Path.replace, []

    def only_once(path, target):
        done.append(path)
        if len(done) > 1:
            raise OSError(errno.EIO, "Input/output error")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", only_once)
    with pytest.raises(WriteFailed):
        write_together({tmp_path / name: b"new" for name in "ab"})
    assert {b"old a", b"old b"} <= {path.read_bytes() for path in tmp_path.iterdir()}


# ---- the k-th call of a command --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    if not (sys.platform == "linux" and shutil.which("gcc")):
        pytest.skip("making calls fail takes Linux and gcc")
    folder = tmp_path_factory.mktemp("faults")
    with Server(folder) as started, inputs(started, folder / "inputs") as read:
        yield started, folder, read


@pytest.mark.parametrize("name", few(QUICK))
def test_a_call_that_fails_leaves_what_was_there(server, name):
    started, folder, read = server
    (command,) = (one for one in COMMANDS if one.name == name)
    load(started, command, folder, read)
    trial = Trial(command, started, read, folder / "here")
    trial.prepare(overwrite=True)
    for fault, share in (("ENOSPC", 0.4), ("EACCES", 0.7), ("Ctrl-C", 0.8), ("kill -9", 1.0)):
        done, wrong = sweep(trial, fault, [round(share * trial.calls)])
        assert (done, wrong) == (1, []), fault
    assert list(FAULTS) == ["ENOSPC", "EACCES", "Ctrl-C", "kill -9"]


def test_a_limit_on_the_size_of_files_leaves_what_was_there(server):
    """The kernel itself refuses the write here, with EFBIG."""
    started, folder, read = server
    trial = Trial(next(one for one in COMMANDS if one.name == "generate: table, CSV"), started, read, folder / "here")
    trial.prepare(overwrite=True)
    ended = trial.run(size=4096)
    assert ended.code == 74 and "File too large" in ended.err and ended.err.count("\n") == 1
    assert files_in(trial.here) == trial.old


def _mounted(folder, options):
    """Return the command that runs another with an empty file system of its own at a folder; skip if there is none."""
    around = ["unshare", "-Urm", "sh", "-c", f'mount -t tmpfs -o {options} none "{folder}" && exec "$@"', "sh"]
    try:
        done = subprocess.run([*around, "true"], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no unshare here")
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    return around


@pytest.mark.long
@pytest.mark.parametrize(("options", "code", "says"), [("size=256k", 74, "No space left"), ("ro", 73, "Read-only")])
def test_a_real_disk_that_is_full_or_read_only(tmp_path, options, code, says):
    around = _mounted(tmp_path, options)
    listed = f"; code=$?; ls -A {tmp_path} >&2; exit $code"
    command = f"{sys.executable} -m cgid generate reference -n 3000 --parameters-only -o {tmp_path}/table.h5{listed}"
    done = subprocess.run([*around, "sh", "-c", command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    assert says in done.stderr and done.stderr.count("\n") == 1, done.stderr


# ---- permissions, streams, places ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        "plot sample.csv -o {}/p.png",
        "predict sample.csv --report {}/r.html",
        "generate reference --parameters-only -o {}/t.csv",
    ],
)
def test_a_folder_one_may_not_look_into(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT / "datasets")
    closed, stat = tmp_path / "closed", Path.stat
    closed.mkdir()

    def refused(self, **options):
        if closed in self.parents:  # as the kernel says it to those who are not root
            raise PermissionError(13, "Permission denied")
        return stat(self, **options)

    monkeypatch.setattr(Path, "stat", refused)
    assert run(command.format(closed).split()) == 73
    said = capsys.readouterr().err
    assert "(Permission denied)" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "code"),
    [("predict nothere 2>/dev/full", 66), ("predict --bad 2>/dev/full", 2), ("info --help >/dev/full 2>&1", 74)],
)
@needs_full
def test_streams_that_are_full_do_not_hide_the_exit_code(command, code):
    done = subprocess.run(["bash", "-c", f"{sys.executable} -m cgid {command}"], cwd=ROOT, capture_output=True)
    assert done.returncode == code


@pytest.mark.long
def test_no_file_becomes_a_standard_stream_that_is_closed(tmp_path):
    command = f"{sys.executable} -m cgid generate reference -n 20 --parameters-only -o {tmp_path}/t.csv <&- >&- 2>&-"
    bare = {name: value for name, value in os.environ.items() if name not in ("HOME", "XDG_CACHE_HOME")}
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, env={**bare, "TMPDIR": "/nowhere"}, check=False)
    assert done.returncode == 0
    assert len((tmp_path / "t.csv").read_text().splitlines()) == 22


def test_a_folder_that_is_gone_is_told(tmp_path, monkeypatch, capsys):
    with ExitStack() as stack:
        (tmp_path / "gone").mkdir()
        monkeypatch.chdir(tmp_path / "gone")
        stack.callback(monkeypatch.undo)
        (tmp_path / "gone").rmdir()
        assert run(["plot", str(ROOT / "datasets" / "sample.csv"), "-o", "p.png"]) in (66, 73)
    said = capsys.readouterr().err
    assert said.startswith("cgid: error: ") and said.count("\n") == 1
