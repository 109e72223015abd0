"""Repair: make damaged or missing files of a folder again; each follows from the description and its number.

What is whole is adopted before anything is made. A file with a sum in `SHA256SUMS` must come out with that sum, or else
as the file that is there; one without must be made by the versions of the description. Otherwise nothing is replaced.
"""

from __future__ import annotations

import re
import shlex
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData, CannotCreate, CgidError
from cgid.files import whole_file, write_whole
from cgid.scene import generation, recordings
from cgid.scene.generation import attributes_of, next_signals
from cgid.scene.schema import Scene, samples_of, stored_scene
from cgid.scene.synthesis import synthesise
from cgid.store.dataset import shard_content
from cgid.store.description import DIGEST, FORMAT, LARGEST_SHARD, RECORDING_FORMAT
from cgid.store.folder import (
    DESCRIPTION,
    SUMS,
    Description,
    Folder,
    describe,
    read_folder,
    read_sums,
    sha256_of,
    sums_text,
)
from cgid.store.run import locked
from cgid.store.verification import Finding, Verified, examine_file, verify, why_not_whole

#: A leftover that was modified within this time may still be in use [s].
_STILL_WRITTEN = 60.0
#: Bytes that may be made, and additional bytes for each existing byte.
_ROOM, _ROOM_FOR_EACH = 16 << 20, 100
#: Approximate size of the data stored with each signal besides its samples [bytes].
_ROW = 100

Progress = Callable[[int], object]


@dataclass(frozen=True, kw_only=True)
class Repair:
    """The result for one finding.

    Attributes
    ----------
    finding : Finding
        What was damaged or missing.
    done : bool
        Whether the file is whole again.
    told : str
        The action taken, or the reason for its failure.
    """

    finding: Finding
    done: bool
    told: str


def repair(verified: Verified, scene: Scene | None = None, progress: Progress | None = None) -> Iterator[Repair]:
    """Make damaged or missing files of a folder again, each atomically, and remove the leftovers of killed runs.

    Parameters
    ----------
    verified : Verified
        The result of `cgid.store.verification.verify`.
    scene : Scene, optional
        Only a dataset with a recorded background needs it.
    progress : callable, optional
        Is called with the number of signals or samples made since the last call.

    Yields
    ------
    Repair
        For each finding that is not foreign.

    Raises
    ------
    CannotCreate
        A run writes into the folder, or another dataset has replaced it since it was verified.
    """
    path, room, left = verified.path, _Room(verified.path), False
    with ExitStack() as held:
        if path.is_dir() and verified.findings:
            held.enter_context(locked(path))
        _require_unchanged(verified)
        for finding in verified.findings:
            if finding.file.name == DESCRIPTION and finding.harmful:
                yield (described := _described_again(finding))
                verified = verify(path) if described.done else verified
        # The sums come last because they list the other files.
        for finding in sorted(verified.findings, key=lambda finding: finding.file.name == SUMS):
            if finding.problem == "foreign" or finding.file.name == DESCRIPTION:
                continue
            try:
                if left and finding.file.name == SUMS:
                    raise BadData(f"{finding.file}: must list files that are whole; repair the others first")
                told = _repaired(finding, verified.folder, scene, room, progress)
            except (CgidError, OSError) as error:
                left = left or finding.harmful
                yield Repair(finding=finding, done=False, told=str(error))
            else:
                yield Repair(finding=finding, done=True, told=told)


def _require_unchanged(verified: Verified) -> None:
    """Raise `CannotCreate` if the description has changed since it was verified, perhaps hours ago."""
    if verified.folder is None:
        return
    try:
        same = read_folder(verified.path).description == verified.folder.description
    except BadData:
        same = False
    if not same:
        raise CannotCreate(f"{verified.path}: has been replaced by another since it was verified; verify it again")


def _repaired(
    finding: Finding, folder: Folder | None, scene: Scene | None, room: _Room, progress: Progress | None
) -> str:
    """Repair one finding and return what was done."""
    file = finding.file
    if finding.problem == "leftover":
        if time.time() - file.stat().st_mtime < _STILL_WRITTEN:
            raise CannotCreate(f"{file}: was written to within the last minute; remove it when no run writes there")
        file.unlink()
        return "removed"
    if finding.problem == "unfinished":
        raise BadData(f"{file}: is not finished; cgid generate ... --resume goes on with it")
    if folder is None or folder.digest is None:
        raise BadData(_how_to_make(file))
    if file.name == SUMS:
        return _summed_again(folder)
    if finding.number is None:
        raise BadData(f"{file}: does not belong to the folder; move it away")
    return _made_again(file, finding.number, folder, scene, room, progress)


class _Room:
    """Limits how much a repair may write: a small untrusted folder must not fill the disk by what it declares."""

    def __init__(self, path: Path) -> None:
        files = path.iterdir() if path.is_dir() else (path,)
        # A sparse file can declare any size; targets of links in a folder do not count.
        abouts = map(Path.lstat, files) if path.is_dir() else map(Path.stat, files)
        plain = [about for about in abouts if stat.S_ISREG(about.st_mode)]
        stored = sum(min(about.st_size, 512 * getattr(about, "st_blocks", about.st_size)) for about in plain)
        self._left = _ROOM + _ROOM_FOR_EACH * stored

    def take(self, path: Path, size: int) -> None:
        """Reserve this many bytes for a file; raises `BadData` if they exceed the limit."""
        if size > self._left:
            raise BadData(
                f"{path}: so little of it is left that it is no repair ({size / 1e6:.3g} MB would be made, "
                f"{self._left / 1e6:.3g} MB may); if you trust it, make it anew by cgid generate"
            )
        self._left -= size


# ---- descriptions and sums -------------------------------------------------------------------------------------------


def _described_again(finding: Finding) -> Repair:
    """Write a lost or damaged description again from the files that follow from it, which carry its digest."""
    file = finding.file
    folder, found = file.parent, []
    for path in sorted(folder.iterdir()):
        if re.fullmatch(r"(shard|recording)-[0-9]{5,}\.h5", path.name) and not path.is_symlink():
            examined = examine_file(path)
            if examined.description is not None:
                found.append((examined.description, examined.about))
    for one, about in found:
        description = _of_all(one, [about for _, about in found], len(read_sums(folder, None)) - 1)
        if description.sha256 == about.get(DIGEST):
            write_whole(file, description.text)
            told = f"written again from the {len(found)} files that follow from it"
            return Repair(finding=finding, done=True, told=told)
    told = (
        f"{file}: cannot be made from the {len(found)} files that are there; go on with the command that made them, "
        "cgid generate ... --resume"
    )
    return Repair(finding=finding, done=False, told=told)


def _of_all(one: Description, abouts: list[Mapping[str, Any]], n_listed: int) -> Description:
    """Return the description of files in a folder, given that of one of them and what all say of themselves."""
    content = dict(one.content)
    attributes = content.pop("attributes")
    if one.kind == FORMAT:
        counts = [about["n_signals"] for about in abouts]
        content["shard_signals"] = max(counts)
        content["n_signals"] = max(about["first_signal"] + about["n_signals"] for about in abouts)
    else:
        content["n_recordings"] = max(n_listed, *(about["recording"] + 1 for about in abouts), 1)
    del content["format"], content["schema_version"]
    return describe(one.kind, attributes, **content)


def _summed_again(folder: Folder) -> str:
    """Write `SHA256SUMS` again, from the files that are whole."""
    sums = {DESCRIPTION: folder.description.sha256}
    for number, name in enumerate(folder.description.names):
        why = "" if name in folder.sums else why_not_whole(folder, number)
        if why:
            raise BadData(f"{folder.path / name}: {why}")
        sums[name] = folder.sums.get(name) or sha256_of(folder.path / name)
    write_whole(folder.path / SUMS, sums_text(sums))
    return f"written again from the {len(sums) - 1} files that are whole"


# ---- files -----------------------------------------------------------------------------------------------------------


def _made_again(
    file: Path, number: int, folder: Folder, given: Scene | None, room: _Room, progress: Progress | None
) -> str:
    """Make a file of a folder again, and replace it if it comes out as it must."""
    description, sha256 = folder.description, folder.sums.get(file.name)
    if not file.is_symlink() and file.is_file():
        about = examine_file(file).about
        if about and about.get(DIGEST) != folder.digest:
            raise BadData(f"{file}: belongs to another description, so it is not replaced; move it away")
    attributes = description.content["attributes"]
    scene = _scene_of(file.with_name(DESCRIPTION), attributes, given)
    here = attributes_of(scene, 0, description.content.get("compression", "none"))["versions"]
    if sha256 is None and attributes.get("versions") != here:
        raise BadData(f"{file}: {_why_other(attributes, here)}")
    n_signals = description.part(number).get("n_signals", 1)
    size = n_signals * (samples_of(scene) * np.dtype(description.content["dtype"]).itemsize + _ROW)
    if description.content["n_samples"] != samples_of(scene) or size > LARGEST_SHARD + n_signals * _ROW:
        raise BadData(f"{file.with_name(DESCRIPTION)}: n_samples must be that of the scene; generate the files again")
    room.take(file, size)
    with whole_file(file) as temporary:
        _make(temporary, description, number, scene, progress)
        made = sha256_of(temporary)
        # A file that is made as it is there is sound: its sum is damaged.
        is_there = not file.is_symlink() and file.is_file()
        if sha256 not in (None, made) and not (is_there and sha256_of(file) == made):
            raise BadData(
                f"{file}: must come out here with the SHA-256 {sha256}, it does not; nothing was replaced: "
                f"{_why_other(attributes, here)}"
            )
    if made != sha256:
        _relist(folder, file.name, made)
        return "made again; its sum is written again, too"
    return "made again, byte for byte"


def _relist(folder: Folder, name: str, sha256: str) -> None:
    """Write `SHA256SUMS` again with another sum of one file."""
    sums = read_sums(folder.path, folder.digest) | {name: sha256}
    listed = {name: sums[name] for name in folder.description.names if name in sums}
    write_whole(folder.path / SUMS, sums_text({DESCRIPTION: folder.description.sha256, **listed}))


def _make(path: Path, description: Description, number: int, scene: Scene, progress: Progress | None) -> None:
    """Write a file of a folder by its number."""
    content = description.content
    attributes, seed = content["attributes"], _seed_of(path, content["attributes"])
    if description.kind == RECORDING_FORMAT:
        plan = recordings.described(recordings.recording_plan(scene, attributes, content["dtype"]), description)
        recordings.write_recording(path, plan, scene, seed, number, progress)
        return
    shards = generation.described(
        generation.shard_plan(scene, attributes, content["dtype"], content["compression"]), description
    )
    first, n_signals = description.part(number).values()
    batches = synthesise(scene, n_signals, seed, first=first, dtype=content["dtype"])
    path.write_bytes(shard_content(shards, first, n_signals, next_signals(batches, n_signals, progress)))


def _seed_of(path: Path, attributes: Mapping[str, Any]) -> int:
    seed = attributes.get("seed")
    if type(seed) is not int or seed < 0:
        raise BadData(f"{path}: seed must be a whole number of 0 or more, got {seed!r:.40}; generate the files again")
    return seed


def _how_to_make(file: Path) -> str:
    """Return how to make a file again that is not made again from a folder."""
    found = examine_file(file)
    if found.kind not in (FORMAT, RECORDING_FORMAT) or found.description is None:
        return f"{file}: make it again by the command that made it; if that was cgid generate, with --overwrite"
    content, attributes = found.description.content, found.description.content["attributes"]
    if "seed" not in attributes or found.about.get("first_signal"):
        return f"{file}: generate its folder again by the command that made it, with --overwrite"
    count = content.get("n_signals", content.get("n_recordings"))
    options = f"-n {count} --seed {attributes['seed']} --dtype {content['dtype']}"
    options += f" --compression {content['compression']}" if content.get("compression", "none") != "none" else ""
    name = shlex.quote(str(attributes.get("scene_name")))
    return f"{file}: make it again by cgid generate {name} {options} -o {shlex.quote(str(file))} --overwrite"


def _why_other(attributes: Mapping[str, Any], here: str) -> str:
    """Explain why the numbers differ here from those of the file, and what helps."""
    versions = attributes.get("versions")
    if versions != here:
        return f"repair it by the versions that made it, {versions}; here {here}; or generate it again"
    return f"the versions are the same, {here}, so its numbers have been changed, or others than its scene's"


def _scene_of(path: Path, attributes: Mapping[str, Any], given: Scene | None) -> Scene:
    """Return the scene of a file: `given`, read from the scene's own file, or the one stored in `attributes`.

    Raises `BadData` if neither is available, if `given` is another scene or has another background, or if the stored
    scene names a recorded background.
    """
    if given is not None:
        if given.sha256 != attributes.get("scene_sha256"):
            raise BadData(
                f"{path}: the scene must be the one it was made of, with SHA-256 {attributes.get('scene_sha256')}, got "
                f"{given.sha256} ({given.name}); give that scene's file"
            )
        background = attributes_of(given, 0).get("background_sha256")
        if background != attributes.get("background_sha256", background):
            raise BadData(
                f"{path}: the recorded background must be the one it was made with, with SHA-256 "
                f"{attributes['background_sha256']}, got {background}; put that file in its place"
            )
        return given
    scene = stored_scene(attributes, str(path))
    if scene is None:
        raise BadData(f"{path}: does not say of what scene it was made; make it again by cgid generate")
    if scene.background is not None and scene.background.recorded is not None:
        # An untrusted file must not make us open other files.
        raise BadData(
            f"{path}: was made with the recorded background {scene.background.recorded.path}; give the scene file that "
            "lies beside it by --scene FILE"
        )
    return scene
