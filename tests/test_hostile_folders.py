"""Folders from strangers: descriptions, sums, links and pipes in them; nothing hangs, grows, or lies outside.

Each is given to `cgid info` and `cgid verify`: one line, and no code but those of bad data.
"""

import hashlib
import json
import os
import shutil
import sys
import tracemalloc
from pathlib import Path

import pytest

from benchmarks.safety.bit_flips import small_scene
from cgid.cli.main import run
from cgid.scene import generate
from cgid.store.folder import sums_text

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes and links as on Unix")
GOLDEN = Path(__file__).parent / "golden"
FIRST, SECOND = {"run": "a", "process": "b"}, {"plan": {}, "n_files": 3, "noun": "shards"}


def _pipe(folder, name):
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)


def _linked(folder, name, target):
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(target)


def _changed(change, *, lost=True):
    """Change what a description says, with sums that begin with its digest, and lose a shard."""

    def attack(folder):
        file = folder / "description.json"
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))
        sums = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("*[!S]"))}
        (folder / "SHA256SUMS").write_bytes(sums_text({"description.json": sums.pop("description.json"), **sums}))
        if lost:
            (folder / "shard-00001.h5").unlink()

    return attack


def _attribute(name, value):
    return _changed(lambda content: content["attributes"].update({name: value}))


def _field(name, value):
    return _changed(lambda content: content.update({name: value}))


def _shard_of(n_signals):
    return _changed(lambda content: content.update(shard_signals=n_signals, n_signals=2 * n_signals))


def _far_recording(folder):
    shutil.rmtree(folder)
    folder.mkdir()
    shutil.copy(GOLDEN / "recording.h5", folder / f"recording-{'9' * 200}.h5")


def _content(content):
    return lambda folder: (folder / "description.json").write_bytes(content())


HOSTILE = {
    "a pipe for the description": lambda folder: _pipe(folder, "description.json"),
    "a pipe for the sums": lambda folder: _pipe(folder, "SHA256SUMS"),
    "a pipe for a shard": lambda folder: _pipe(folder, "shard-00001.h5"),
    "a pipe for the lock": lambda folder: _pipe(folder, ".lock"),
    "a folder for the description": lambda folder: (
        (folder / "description.json").unlink(),
        (folder / "description.json").mkdir(),
    ),
    "a description linked to a device": lambda folder: _linked(folder, "description.json", "/dev/zero"),
    "sums linked to a device": lambda folder: _linked(folder, "SHA256SUMS", "/dev/zero"),
    "a description of a hundred megabytes": _content(lambda: b'{"a":[' + b"[]," * 33_000_000 + b"[]]}"),
    "a description of two million lists": _content(lambda: b"[" + b"[]," * 2_000_000 + b"[]]"),
    "a description nested a million deep": _content(lambda: b"[" * 1_000_000),
    "sums of ten million lines": lambda folder: (folder / "SHA256SUMS").write_bytes(b"\n" * 10_000_000),
    "sums of 20 GB of nothing": lambda folder: os.truncate(folder / "SHA256SUMS", 20 << 30),
    "a journal linked to a device": lambda folder: (
        (folder / "description.json").unlink(),
        _linked(folder, "unfinished.jsonl", "/dev/zero"),
    ),
    "a recording with the number 10^200": _far_recording,
    "a seed of 400 digits": _attribute("seed", 10**400),
    "versions that are an object": _attribute("versions", {"a": "b"}),
    "an attribute that is a list": _attribute("more", [1, [2]]),
    "an attribute that is nothing": _attribute("more", None),
    "an attribute that is no Unicode": _attribute("more", "\ud800"),
    "a name that is no Unicode": _attribute("\udcff", 1),
    "a scene nested without end": _attribute("scene", "[" * 100_000),
    "a type of objects": _field("dtype", "O"),
    "a type of gigabytes": _field("dtype", "(1000000000,)f8"),
    "a type that is code": _field("dtype", "import os"),
    "a packing nobody knows": _field("compression", "../x"),
    "a kind with escapes": _field("format", "\x1b[2J\n"),
    "a shard of 10^400 signals": _shard_of(10**400),
    "a shard of 2^61 signals": _shard_of(1 << 61),
    "2^60 shards": _changed(lambda content: content.update(shard_signals=1, n_signals=1 << 60)),
    "300,000 shards": _changed(lambda content: content.update(shard_signals=1, n_signals=300_000)),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return generate(small_scene(), tmp_path_factory.mktemp("made") / "folder", 12, seed=7, shard_signals=6)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_folder_does_no_harm(made, name, tmp_path, capsys):
    folder = tmp_path / "folder"
    shutil.copytree(made, folder)
    HOSTILE[name](folder)
    for command in ("info", "verify"):
        tracemalloc.start()
        try:
            assert run([command, str(folder)]) in (0, 65), command
            assert tracemalloc.get_traced_memory()[1] < 100 << 20
        finally:
            tracemalloc.stop()
        told = capsys.readouterr()
        assert len(told.err.splitlines()) <= 1
        assert "\x1b" not in told.out + told.err


def test_a_link_to_a_file_outside_is_not_followed_and_its_target_stays(tmp_path, capsys):
    """Not even to the very shard: who unpacks a stranger's folder has none of his own files read."""
    folder, outside = tmp_path / "folder", tmp_path / "outside.h5"
    generate(small_scene(), folder, 64, seed=1, shard_signals=32)
    shard = folder / "shard-00001.h5"
    content = shard.read_bytes()
    shard.rename(outside)
    shard.symlink_to(outside)
    for command in ("info", "verify", "predict"):
        assert run([command, str(folder)]) == 65
    capsys.readouterr()
    generate(small_scene(), folder, 64, seed=1, shard_signals=32, resume=True)
    assert not shard.is_symlink()
    assert outside.read_bytes() == content
