"""Folders from strangers: manifests, journals, links and pipes in them; nothing hangs, grows, or lies outside.

Each is given to `cgid info`, `verify` and `verify --repair`: one line, and no code but those of bad data.
"""

import hashlib
import json
import os
import shutil
import sys
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchmarks.bit_flips import small_scene
from cgid.cli.main import run
from cgid.scene import generate
from cgid.store.description import sealed

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes and links as on Unix")
GOLDEN = Path(__file__).parent / "golden"
FIRST, SECOND = {"run": "a", "process": "b"}, {"plan": {}, "n_files": 3, "noun": "shards"}


def _pipe(folder, name):
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)


def _linked(folder, name, target):
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(target)


def _of_manifest(change, *, lost=True):
    """Change what a manifest says, with a digest that fits, and lose a shard."""

    def attack(folder):
        manifest = folder / "manifest.json"
        said = json.loads(manifest.read_text())
        del said["digest"]
        change(said)
        manifest.write_text(json.dumps(sealed(said)))
        if lost:
            (folder / "shard-00001.h5").unlink()

    return attack


def _attribute(name, value):
    return _of_manifest(lambda said: said["attributes"].update({name: value}))


def _said(name, value):
    return _of_manifest(lambda said: said.update({name: value}))


def _shard_of(n_signals):
    def change(said):
        said["shards"][1]["n_signals"] = n_signals
        said["n_signals"] = said["shards"][0]["n_signals"] + n_signals

    return _of_manifest(change)


def _many_shards(said):
    first, second = said["shards"]
    rest = range(1, 500)
    said["shards"] = [first] + [
        {**second, "file": f"shard-{k:05d}.h5", "n_signals": 10**5, "first_signal": 8 + 10**5 * (k - 1)} for k in rest
    ]
    said["n_signals"] = 8 + 10**5 * len(rest)


def _journal(*lines, tail=b""):
    def attack(folder):
        (folder / "manifest.json").unlink()
        text = "".join(json.dumps(sealed(line)) + "\n" for line in lines)
        (folder / "unfinished.jsonl").write_bytes(text.encode() + tail)

    return attack


def _far_recording(folder):
    shutil.rmtree(folder)
    folder.mkdir()
    shutil.copy(GOLDEN / "recording.h5", folder / f"recording-{'9' * 200}.h5")


def _content(content):
    return lambda folder: (folder / "manifest.json").write_bytes(content())


HOSTILE = {
    "a pipe for the manifest": lambda folder: _pipe(folder, "manifest.json"),
    "a pipe for the journal": lambda folder: _pipe(folder, "unfinished.jsonl"),
    "a pipe for a shard": lambda folder: _pipe(folder, "shard-00001.h5"),
    "a folder for the manifest": lambda folder: (
        (folder / "manifest.json").unlink(),
        (folder / "manifest.json").mkdir(),
    ),
    "a manifest linked to a device": lambda folder: _linked(folder, "manifest.json", "/dev/zero"),
    "a journal linked to a device": lambda folder: _linked(folder, "unfinished.jsonl", "/dev/zero"),
    "a manifest of a hundred megabytes": _content(lambda: b'{"a":[' + b"[]," * 33_000_000 + b"[]]}"),
    "a manifest of two million lists": _content(lambda: b"[" + b"[]," * 2_000_000 + b"[]]"),
    "a manifest nested a million deep": _content(lambda: b"[" * 1_000_000),
    "a journal of ten million lines": _journal(FIRST, SECOND, tail=b"\n" * 10_000_000),
    "a journal of 20 GB of nothing": lambda folder: os.truncate(_made(folder / "unfinished.jsonl"), 20 << 30),
    "a journal of a file that is a list": _journal(FIRST, SECOND, {"entry": {"file": []}}),
    "a journal of a noun of two lines": _journal(FIRST, {**SECOND, "noun": "\x1b[2J\n" * 200}),
    "a recording with the number 10^200": _far_recording,
    "a seed of 400 digits": _attribute("seed", 10**400),
    "versions that are an object": _attribute("versions", {"a": "b"}),
    "an attribute that is a list": _attribute("more", [1, [2]]),
    "an attribute that is nothing": _attribute("more", None),
    "an attribute that is no Unicode": _attribute("more", "\ud800"),
    "a name that is no Unicode": _attribute("\udcff", 1),
    "a scene nested without end": _attribute("scene", "[" * 100_000),
    "a type of objects": _said("dtype", "O"),
    "a type of gigabytes": _said("dtype", "(1000000000,)f8"),
    "a type that is code": _said("dtype", "import os"),
    "a packing nobody knows": _said("compression", "../x"),
    "a shard of 10^400 signals": _shard_of(10**400),
    "a shard of 2^62 signals": _shard_of(1 << 62),
    "a shard of a gigabyte that is not there": _shard_of(1 << 20),
    "five hundred shards of 100 MB that are not there": _of_manifest(_many_shards),
}


def _made(path):
    path.touch()
    return path


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_folder_does_no_harm(name, tmp_path, capsys):
    folder = tmp_path / "folder"
    shutil.copytree(GOLDEN / "manifest-2", folder)
    HOSTILE[name](folder)
    stored = sum(file.lstat().st_blocks for file in folder.iterdir())
    for command in (["info"], ["verify"], ["verify", "--repair"]):
        if "--repair" not in command:
            tracemalloc.start()
        try:
            assert run([*command, str(folder)]) in (0, 65), command
            assert not tracemalloc.is_tracing() or tracemalloc.get_traced_memory()[1] < 100 << 20
        finally:
            tracemalloc.stop()
        told = capsys.readouterr()
        assert len(told.err.splitlines()) <= 1
        assert "\x1b" not in told.out + told.err
    # What is repaired takes little more than there was.
    assert sum(file.lstat().st_blocks for file in folder.iterdir()) <= stored + 1024


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
    assert "it is a link" in capsys.readouterr().out
    assert run(["verify", "--repair", str(folder)]) == 0
    assert not shard.is_symlink()
    assert outside.read_bytes() == content


def test_a_scene_that_makes_much_more_than_the_file_holds_is_not_made(tmp_path, capsys):
    path = tmp_path / "recording.h5"
    shutil.copy(GOLDEN / "recording.h5", path)
    with h5py.File(path, "r+") as file:
        scene = json.loads(file.attrs["scene"])
        scene["stream"]["duration"] = 2000 * scene["stream"]["duration"]
        text = json.dumps(scene)
        file.attrs["scene"] = np.bytes_(text)
        file.attrs["scene_sha256"] = np.bytes_(hashlib.sha256(text.encode()).hexdigest())
        place = file["samples"].id.get_chunk_info(0).byte_offset
    damaged = bytearray(path.read_bytes())
    damaged[place] ^= 1
    path.write_bytes(damaged)
    assert run(["verify", "--repair", str(path)]) == 65
    assert "as many samples as its scene makes" in capsys.readouterr().out
    assert path.read_bytes() == damaged
