"""Folders and whole files: descriptions, sums, locks, and what comes meanwhile."""

import contextlib
import errno
import os
import random
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cgid._lib.files import clear_half_written, whole_file, write_whole
from cgid.errors import BadData, CannotCreate, WriteFailed
from cgid.store.description import FORMAT
from cgid.store.folder import DESCRIPTION, SUMS, describe, parse_description, read_sums, sums_text
from cgid.store.run import begun, locked

DATASET = describe(
    FORMAT,
    {"seed": 3, "scene": '{"name": "Kohle ä"}', "rate": 0.1},
    n_signals=7,
    shard_signals=3,
    n_samples=64,
    dtype="float32",
    compression="none",
)
DIGESTS = dict(zip(DATASET.names, ("1" * 64, "2" * 64, "3" * 64), strict=True))


def test_a_description_there_and_back():
    assert parse_description(DATASET.text, Path("x")) == DATASET
    assert [DATASET.part(number) for number in range(3)] == [
        {"first_signal": 0, "n_signals": 3},
        {"first_signal": 3, "n_signals": 3},
        {"first_signal": 6, "n_signals": 1},
    ]
    # The order of the attributes, which HDF5 does not keep, is no part of it.
    fields = {
        name: DATASET.content[name] for name in ("n_signals", "shard_signals", "n_samples", "dtype", "compression")
    }
    assert describe(FORMAT, dict(reversed(DATASET.content["attributes"].items())), **fields) == DATASET


def test_no_flipped_bit_of_a_description_keeps_its_digest():
    places = random.Random(1)
    for bit in places.sample(range(8 * len(DATASET.text)), 300):
        flipped = bytearray(DATASET.text)
        flipped[bit // 8] ^= 1 << bit % 8
        with contextlib.suppress(BadData):
            assert parse_description(bytes(flipped), Path("x")).sha256 != DATASET.sha256


# ---- sums ------------------------------------------------------------------------------------------------------------


def test_sums_cut_anywhere_or_flipped_invent_nothing(tmp_path):
    content, places = sums_text({DESCRIPTION: DATASET.sha256, **DIGESTS}), random.Random(1)
    damaged = [content[:length] for length in range(len(content))]
    for _ in range(300):
        flipped = bytearray(content)
        flipped[places.randrange(len(content))] ^= 1 << places.randrange(8)
        damaged.append(bytes(flipped))
    for text in damaged:
        (tmp_path / SUMS).write_bytes(text)
        sums = read_sums(tmp_path, DATASET.sha256)
        # A digit may be another one: then the file does not fit.
        wrong = {name for name, digest in sums.items() if DIGESTS.get(name) != digest}
        assert len(wrong) <= (len(text) == len(content))
    (tmp_path / SUMS).write_bytes(content)
    assert read_sums(tmp_path, DATASET.sha256) == DIGESTS
    assert read_sums(tmp_path, "0" * 64) == {}


def test_a_line_is_there_when_its_file_is_whole(tmp_path):
    folder = tmp_path / "data"
    with begun(folder, DATASET) as run:
        assert run.missing == [0, 1, 2]
        for number in (2, 0, 1):
            name = DATASET.names[number]
            (folder / name).touch()
            run.add(name, DIGESTS[name])
            assert read_sums(folder, DATASET.sha256)[name] == DIGESTS[name]
    assert (folder / SUMS).read_bytes() == sums_text({DESCRIPTION: DATASET.sha256, **DIGESTS})


def test_a_full_disk_under_the_sums(tmp_path):
    folder, name = tmp_path / "data", DATASET.names[0]
    with pytest.raises(WriteFailed, match="resume=True"), begun(folder, DATASET) as run:
        (folder / name).touch()
        os.dup2(os.open("/dev/full", os.O_WRONLY), run._listing)
        run.add(name, DIGESTS[name])
    assert (folder / name).exists()


# ---- locks -----------------------------------------------------------------------------------------------------------


def test_a_lock_keeps_other_processes_out_and_goes_with_its_own(tmp_path):
    code = (
        "import sys; from pathlib import Path; from cgid.store.run import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    root = Path(__file__).parents[1]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code, tmp_path], cwd=root, **pipes) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(CannotCreate), locked(tmp_path):
            pytest.fail("another process holds it")
        other.kill()
        other.wait()
        with locked(tmp_path), pytest.raises(CannotCreate), locked(tmp_path):
            pytest.fail("this process holds it")


# ---- whole files -----------------------------------------------------------------------------------------------------


def test_a_file_that_came_meanwhile_is_kept(tmp_path):
    path = tmp_path / "file"
    with pytest.raises(CannotCreate, match="file"), whole_file(path, overwrite=False) as temporary:
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
    with pytest.raises(CannotCreate, match="file"):
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


def test_what_a_killed_process_has_left_goes_after_an_hour(tmp_path):
    old, new = (tmp_path / f".data.h5.{digit * 12}.part" for digit in "ab")
    other = tmp_path / f".other.h5.{'c' * 12}.part"
    for left in (old, new, other):
        left.write_bytes(b"half")
    hours_ago = time.time() - 2 * 3600
    for left in (old, other):
        os.utime(left, (hours_ago, hours_ago))
    clear_half_written(tmp_path / "data.h5")
    assert sorted(tmp_path.iterdir()) == sorted([new, other])


def test_a_check_that_fails_just_before_the_name_keeps_the_old_file(tmp_path):
    def check():
        raise CannotCreate("another has taken it")

    write_whole(tmp_path / "file", b"old")
    with pytest.raises(CannotCreate):
        write_whole(tmp_path / "file", b"new", check=check)
    assert (tmp_path / "file").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_a_device_a_pipe_or_a_descriptor_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "out").symlink_to("/proc/self/fd/1")
    for name in ("pipe", "out"):
        before = (tmp_path / name).lstat().st_ino
        with pytest.raises(CannotCreate, match=name):
            write_whole(tmp_path / name, b"content")
        assert (tmp_path / name).lstat().st_ino == before
