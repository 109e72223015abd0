"""What says how far a run has come: manifests, journals and locks, with every kind of damage."""

import contextlib
import errno
import fcntl
import json
import os
import random
import stat
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest

from cgid.errors import BadData, CannotCreate, WriteFailed
from cgid.files import locked, whole_file, write_whole
from cgid.store.description import (
    DATASET_FILES,
    JOURNAL,
    MANIFEST,
    Manifest,
    ShardEntry,
    parse_manifest,
    read_journal,
    read_manifest,
)
from cgid.store.run import Goal, Run, taking_part

MANIFEST_OF_TWO = Manifest(
    n_signals=7,
    shard_signals=4,
    n_samples=64,
    dtype="float32",
    compression="none",
    attributes={"format": "cgid-dataset", "seed": 3, "scene": '{"name": "Kohle ä"}'},
    shards=(
        ShardEntry("shard-00000.h5", 0, 4, 1000, "0" * 64, {"coal": 1, "gangue": 3}),
        ShardEntry("shard-00001.h5", 4, 3, 900, "f" * 64, {"coal": 3, "gangue": 0}),
    ),
)
PLAN = {"n_signals": 7, "attributes": {"seed": 3}}
ENTRIES = [{"file": f"shard-0000{k}.h5", "sha256": f"{k}" * 64} for k in range(3)]


# ---- the manifest ----------------------------------------------------------------------------------------------------


def test_a_small_manifest_takes_little_memory(tmp_path):
    (tmp_path / MANIFEST).write_bytes(MANIFEST_OF_TWO.to_bytes())
    tracemalloc.start()
    try:
        read_manifest(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_manifest_there_and_back(tmp_path):
    (tmp_path / MANIFEST).write_bytes(MANIFEST_OF_TWO.to_bytes())
    assert read_manifest(tmp_path) == MANIFEST_OF_TWO


def test_flipped_bits_of_a_manifest_are_found_or_harmless():
    content, places = MANIFEST_OF_TWO.to_bytes(), random.Random(1)
    for bit in places.sample(range(8 * len(content)), 1500):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        with contextlib.suppress(BadData):
            assert parse_manifest(bytes(flipped), Path(MANIFEST)) == MANIFEST_OF_TWO, bit


def test_a_manifest_cut_anywhere_is_none():
    content = MANIFEST_OF_TWO.to_bytes()
    for length in range(len(content) - 1):  # the last byte ends the line
        with pytest.raises(BadData):
            parse_manifest(content[:length], Path(MANIFEST))


def test_a_manifest_of_version_1_is_read(tmp_path):
    content = json.loads(MANIFEST_OF_TWO.to_bytes())
    for name in ("digest", "shard_signals", "n_samples", "dtype", "compression"):
        del content[name]
    (tmp_path / MANIFEST).write_text(json.dumps({**content, "schema_version": 1}))
    found = read_manifest(tmp_path)
    assert found.shards == MANIFEST_OF_TWO.shards
    assert (found.n_signals, found.dtype, found.shard_signals) == (7, None, None)


# ---- the journal -----------------------------------------------------------------------------------------------------


def run_of(folder, entries=()):
    """Return a context of a run that has finished some of three files."""
    goal = Goal(
        output=folder,
        description=PLAN,
        names=tuple(entry["file"] for entry in ENTRIES),
        noun="shards",
        ours=DATASET_FILES,
        description_of=lambda _: None,
    )
    return contextlib.closing(Run(goal, folder, {entry["file"]: entry for entry in entries}, journalled=True))


@pytest.fixture
def journal(tmp_path):
    """The content of a journal of three files, in a folder."""
    with run_of(tmp_path, ENTRIES[:1]) as written:
        for entry in ENTRIES[1:]:
            written.add(entry)
    return tmp_path / JOURNAL


def test_journal_there_and_back(journal):
    found = read_journal(journal.parent)
    assert (found.description, list(found.entries)) == (PLAN, ENTRIES)
    assert str(os.getpid()) in found.process
    assert found.progress.startswith("3 of 3 shards are there")
    journal.unlink()
    assert read_journal(journal.parent) is None


def test_a_torn_line_does_not_count(journal):
    """Cut at every length, a journal says only what was written, and of files a beginning."""
    content = journal.read_bytes()
    begins = len(b"\n".join(content.split(b"\n")[:2]))
    for length in range(len(content)):
        journal.write_bytes(content[:length])
        if length < begins:
            with pytest.raises(BadData, match="--overwrite"):
                read_journal(journal.parent)
            continue
        found = read_journal(journal.parent)
        assert found.description == PLAN
        assert list(found.entries) == ENTRIES[: len(found.entries)]


def test_flipped_bits_of_a_journal_lose_files_and_never_invent_any(journal):
    content, places = journal.read_bytes(), random.Random(1)
    for _ in range(400):
        flipped = bytearray(content)
        flipped[places.randrange(len(content))] ^= 1 << places.randrange(8)
        journal.write_bytes(flipped)
        try:
            found = read_journal(journal.parent)
        except BadData:
            continue
        assert found.description == PLAN
        assert all(entry in ENTRIES for entry in found.entries)


def test_a_full_disk_under_a_journal(journal):
    with run_of(journal.parent) as written:
        os.dup2(os.open("/dev/full", os.O_WRONLY), written._journal.fileno())
        with pytest.raises(WriteFailed, match="No space left"):
            written.add(ENTRIES[0])


def test_what_can_just_be_read_may_be_too_deep_to_be_checked():
    for depth in range(900, 1000):
        with pytest.raises(BadData, match="manifest"):
            parse_manifest(
                b'{"format":"cgid-dataset","schema_version":2,"x":' + b"[" * depth + b"]" * depth + b"}",
                Path("manifest.json"),
            )


def test_a_worker_of_an_earlier_run_is_refused(tmp_path):
    with run_of(tmp_path) as first:
        with taking_part(tmp_path, first.token):
            pass
        with run_of(tmp_path), pytest.raises(CannotCreate, match="taken this folder over"):  # noqa: SIM117
            with taking_part(tmp_path, first.token):
                pytest.fail("the folder belongs to the second run")
        (tmp_path / JOURNAL).unlink()
    with pytest.raises(CannotCreate, match="taken this folder over"), taking_part(tmp_path, first.token):
        pytest.fail("there is no run")


# ---- locks -----------------------------------------------------------------------------------------------------------


def test_a_lock_keeps_other_processes_out_and_goes_with_its_own(tmp_path):
    code = (
        "import sys; from pathlib import Path; from cgid.files import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    root = Path(__file__).parents[1]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code, tmp_path], cwd=root, **pipes) as other:
        assert other.stdout.readline() == b"held\n"
        for shared in (False, True):
            with pytest.raises(BlockingIOError), locked(tmp_path, shared=shared):
                pytest.fail("another process holds it")
        other.kill()
        with locked(tmp_path, patience=60.0):
            pass


def test_shared_locks_and_one_alone(tmp_path):
    with locked(tmp_path, shared=True), locked(tmp_path, shared=True), pytest.raises(BlockingIOError):
        locked(tmp_path).__enter__()
    with locked(tmp_path):
        pass


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def unknown(*_):
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(fcntl, "flock", unknown)
    with locked(tmp_path), locked(tmp_path):
        pass


def test_where_there_is_no_fcntl_folders_are_locked_by_a_file(tmp_path, monkeypatch):
    """As on Windows."""
    pytest.importorskip("filelock")  # loaded with what it needs here itself
    monkeypatch.setitem(sys.modules, "fcntl", None)
    folder = tmp_path / "data"
    folder.mkdir()
    with locked(folder) as held:
        assert held
        with pytest.raises(BlockingIOError), locked(folder):
            pytest.fail("it is held")
        with locked(folder, shared=True) as shared, locked(folder / "file") as file:
            assert not shared and not file
    with locked(folder, patience=5.0) as held:
        assert held
    assert list(tmp_path.iterdir()) == [folder]


# ---- whole files -----------------------------------------------------------------------------------------------------


def test_a_file_that_came_meanwhile_is_kept(tmp_path):
    path = tmp_path / "file"
    with pytest.raises(CannotCreate, match="come into being meanwhile"), whole_file(path, overwrite=False) as temporary:
        temporary.write_bytes(b"ours")
        path.write_bytes(b"theirs")
    assert path.read_bytes() == b"theirs" and list(tmp_path.iterdir()) == [path]
    write_whole(path, b"ours")
    assert path.read_bytes() == b"ours"


@pytest.mark.parametrize("error", [None, errno.EPERM, errno.EOPNOTSUPP])
def test_a_new_file_with_and_without_hard_links(tmp_path, monkeypatch, error):
    def refused(*_):
        raise OSError(error, os.strerror(error))

    if error is not None:
        monkeypatch.setattr(os, "link", refused)
    path = tmp_path / "file"
    write_whole(path, b"first", overwrite=False)
    with pytest.raises(CannotCreate, match="come into being meanwhile"):
        write_whole(path, b"second", overwrite=False)
    assert path.read_bytes() == b"first" and path.stat().st_nlink == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_flushed_is_no_failure(tmp_path, monkeypatch):
    flushed = []

    def files_only(number):
        if stat.S_ISDIR(os.fstat(number).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        flushed.append(number)

    monkeypatch.setattr(os, "fsync", files_only)
    write_whole(tmp_path / "file", b"content")
    assert flushed and (tmp_path / "file").read_bytes() == b"content"
