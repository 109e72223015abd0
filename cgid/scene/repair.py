"""Repair: make damaged or missing files again; every file follows from its description and its number.

A file with a SHA-256 in the manifest or `SHA256SUMS` must come out with that sum. A single file has no such sum: it
must be made by the same versions, and its undamaged chunks must come out unchanged. Otherwise nothing is replaced.
"""

from __future__ import annotations

import re
import stat
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData, CannotCreate, CgidError
from cgid.files import locked, whole_file, write_whole
from cgid.scene.generation import attributes_of, in_order, next_signals, shard_plan
from cgid.scene.recordings import recording_plan, write_recording
from cgid.scene.schema import Scene, samples_of, stored_scene
from cgid.scene.synthesis import synthesise
from cgid.store import Dataset
from cgid.store.dataset import shard_content, write_dataset
from cgid.store.description import (
    FORMAT,
    LARGEST_SHARD,
    LINKED,
    MANIFEST,
    RECORDING_FORMAT,
    RECORDING_NAME,
    SHARD_NAME,
    SUMS,
    Manifest,
    ShardEntry,
    file_facts,
    has_sum,
    read_manifest,
    read_sums,
    read_text,
    sums_of,
    sums_text,
)
from cgid.store.verification import Finding, Verified, compression_of, damage_in_words, examine_file

#: Versions of cgid whose numbers depended on the processor.
_DEPENDENT = "cgid 0.1."
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
    """Make damaged or missing files again, each atomically, and remove the leftovers of killed runs.

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
        For each finding that is neither foreign nor pending.

    Raises
    ------
    CannotCreate
        A run writes into the folder, or another dataset has replaced it since it was verified.
    """
    room = _Room(verified.path)
    # Manifest and sums come last because they are made from the other files.
    findings = sorted(verified.findings, key=lambda finding: (finding.file.name == MANIFEST, finding.file.name == SUMS))
    left = False
    with _alone(verified):
        for finding in findings:
            if finding.problem in ("foreign", "pending"):
                continue
            try:
                if left and finding.file.name == SUMS:
                    raise BadData(f"{finding.file}: must list files that are whole; repair the others first")
                told = _mended(finding, verified, scene, room, progress)
            except (CgidError, OSError) as error:
                left = left or finding.harmful
                yield Repair(finding=finding, done=False, told=str(error))
            else:
                yield Repair(finding=finding, done=True, told=told)


@contextmanager
def _alone(verified: Verified) -> Iterator[None]:
    """Lock the folder against runs that write into it.

    Raises `CannotCreate` if one does, or if the manifest has changed since it was verified, perhaps hours ago.
    """
    path = verified.path
    with ExitStack() as held:
        try:
            if path.is_dir():
                held.enter_context(locked(path))
        except BlockingIOError:
            raise CannotCreate(f"{path}: a run is writing there; wait for it") from None
        except OSError as error:
            raise CannotCreate(f"{path}: cannot be written ({error.strerror})") from None
        if verified.manifest is not None:
            try:
                manifest = read_manifest(path)
            except BadData:
                manifest = None
            if manifest != verified.manifest:
                raise CannotCreate(f"{path}: has been replaced by another since it was verified; verify it again")
        yield


def _mended(finding: Finding, verified: Verified, scene: Scene | None, room: _Room, progress: Progress | None) -> str:
    """Repair one finding and return what was done."""
    file, manifest = finding.file, verified.manifest
    if finding.problem == "leftover":
        if time.time() - file.stat().st_mtime < _STILL_WRITTEN:
            raise CannotCreate(f"{file}: was written to within the last minute; remove it when no run writes there")
        file.unlink()
        return "removed"
    if finding.problem == "unfinished" or (finding.entry is not None and manifest is None):
        raise BadData(f"{file}: belongs to an unfinished run; cgid generate ... --resume mends it")
    if file.name == MANIFEST:
        return _relist(file)
    if file.name == SUMS:
        return _sum_again(file, manifest)
    if finding.entry is not None and manifest is not None:
        recipe = _recipe_of_shard(finding, finding.entry, manifest, scene)
    else:
        recipe = _recipe_of_file(finding, scene)
    room.take(file, recipe.size)
    with whole_file(file) as temporary:
        _make(recipe, temporary, progress)
        _require_same(recipe, temporary, finding)
    return "made again, byte for byte" if finding.sha256 else "made again; all that was undamaged is as before"


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


# ---- what a file is made of ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Recipe:
    """Everything that determines the bytes of a file.

    attributes : its root attributes
    number : of the first signal, or of the recording
    n_signals : None for a recording
    """

    attributes: Mapping[str, Any]
    scene: Scene
    seed: int
    number: int
    n_signals: int | None
    dtype: str
    compression: str

    @property
    def size(self) -> int:
        """Approximate size of the file [bytes]."""
        return (self.n_signals or 1) * (samples_of(self.scene) * np.dtype(self.dtype).itemsize + _ROW)


def _recipe_of_shard(finding: Finding, entry: ShardEntry, manifest: Manifest, given: Scene | None) -> _Recipe:
    """Return the recipe of a shard; raises `BadData` if it is readable and belongs to another dataset."""
    path = finding.file
    manifest.require_own(path, finding.examined.get("attributes", {}))
    about: Mapping[str, Any] = vars(manifest)
    if manifest.dtype is None:  # manifests of version 1 do not say it, but the other shards do
        about = _readable(path, [path.with_name(other.file) for other in manifest.shards])
    attributes = {**manifest.attributes, "first_signal": entry.first_signal}
    recipe = _recipe(path.with_name(MANIFEST), attributes, about, entry.n_signals, given)
    size = entry.n_signals * about["n_samples"] * np.dtype(about["dtype"]).itemsize
    if size > LARGEST_SHARD:
        raise BadData(f"a shard must be at most {LARGEST_SHARD >> 30} GiB, got {size / 2**30:.3g} GiB of signals")
    return recipe


def _recipe_of_file(finding: Finding, given: Scene | None) -> _Recipe:
    """Return the recipe of a single file or recording, from its own attributes or those of a sibling."""
    path, about = finding.file, dict(finding.examined)
    attributes = about.get("attributes", {})
    if not about or about["fault"]:
        if not re.fullmatch(RECORDING_NAME, path.name):
            raise BadData(
                f"{path}: does not say any more how it was made; if it was made by cgid, make it again by cgid "
                "generate with --overwrite"
            )
        about = _readable(path, sorted(path.parent.glob("recording-*.h5")))
        attributes = {**about["attributes"], "recording": int(path.stem.removeprefix("recording-"))}
    kind = attributes.get("format")
    if kind not in (FORMAT, RECORDING_FORMAT):
        raise BadData(f"{path}: is no file that is made again in part; make it again by the command that made it")
    about["compression"] = compression_of(about)
    recipe = _recipe(path, attributes, about, about["chunks"]["signals"][-1][1] if kind == FORMAT else None, given)
    if finding.sha256 is None and attributes.get("versions") != _versions(recipe):
        raise BadData(
            f"{path}: must be made again by the versions that made it; nothing was replaced: {_why_other(recipe)}"
        )
    return recipe


def _readable(path: Path, others: Iterable[Path]) -> dict[str, Any]:
    """Return the result of `examine_file`, with the compression, for the first of the other files that can be read."""
    for other in others:
        if other != path and not other.is_symlink():
            examined = examine_file(other)
            if not examined["fault"]:
                return {**examined, "compression": compression_of(examined)}
    raise BadData(f"{path}: no file beside it says how it was made; generate it again")


def _recipe(
    path: Path, attributes: Mapping[str, Any], about: Mapping[str, Any], n_signals: int | None, given: Scene | None
) -> _Recipe:
    """Return the recipe of a file; `path` is the file that describes it.

    `about` holds n_samples, dtype and compression. Raises `BadData` unless the scene makes this number of samples.
    """
    scene = _scene_of(path, attributes, given)
    if about["n_samples"] != samples_of(scene):
        raise BadData(
            f"{path}: must hold as many samples as its scene makes, {samples_of(scene)}, it holds "
            f"{about['n_samples']}; make it again by cgid generate"
        )
    return _Recipe(
        attributes=attributes,
        scene=scene,
        seed=_whole_number(path, attributes, "seed"),
        number=_whole_number(path, attributes, "recording" if n_signals is None else "first_signal"),
        n_signals=n_signals,
        dtype=about["dtype"],
        compression=about["compression"],
    )


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


def _whole_number(path: Path, attributes: Mapping[str, Any], name: str) -> int:
    number = attributes.get(name)
    if type(number) is not int or number < 0:
        raise BadData(
            f"{path}: {name} must be a whole number of 0 or more, got {number!r:.40}; generate the file again"
        )
    return number


# ---- making it, and comparing ----------------------------------------------------------------------------------------


def _make(recipe: _Recipe, path: Path, progress: Progress | None) -> None:
    """Write the new content into an empty file."""
    scene, seed, number, n_signals = recipe.scene, recipe.seed, recipe.number, recipe.n_signals
    own = ("first_signal",) if n_signals is not None else ("format", "schema_version", "n_impacts")
    attributes = {name: value for name, value in recipe.attributes.items() if name not in own}
    if n_signals is None:
        write_recording(path, recording_plan(scene, attributes, recipe.dtype), scene, seed, number, progress)
        return
    plan = shard_plan(scene, attributes, recipe.dtype, recipe.compression)
    dtype: Any = recipe.dtype
    batches = synthesise(scene, n_signals, seed, first=number, dtype=dtype)
    if plan.size(n_signals) > LARGEST_SHARD:  # only an exported dataset is that large
        write_dataset(path, plan, number, n_signals, batches, progress)
    else:
        path.write_bytes(shard_content(plan, number, n_signals, next_signals(batches, n_signals, progress))[0])


def _require_same(recipe: _Recipe, made: Path, finding: Finding) -> None:
    """Raise `BadData` unless the new file has the known SHA-256, or the undamaged chunks of the old one."""
    path = finding.file
    if finding.sha256 is not None:
        if not has_sum(made, finding.sha256):
            raise BadData(
                f"{path}: must come out here with the SHA-256 {finding.sha256}, it does not; nothing was replaced: "
                f"{_why_other(recipe)}"
            )
        return
    old = finding.examined.get("chunks", {})
    steps = {name: max(chunks[0][1], 1) for name, chunks in old.items() if chunks}
    new = examine_file(made, steps)["chunks"]
    sound = [(name, tuple(chunk)) for name, chunks in old.items() for chunk in chunks if chunk[2]]
    there = {(name, tuple(chunk)) for name, chunks in new.items() for chunk in chunks}
    differing = sum(chunk not in there for chunk in sound)
    if differing:
        raise BadData(
            f"{path}: what is undamaged must come out here as it is, {differing} of {len(sound)} chunks do not; "
            f"nothing was replaced: {_why_other(recipe)}"
        )


def _versions(recipe: _Recipe) -> str:
    return str(attributes_of(recipe.scene, 0, recipe.compression)["versions"])


def _why_other(recipe: _Recipe) -> str:
    """Explain why the numbers differ here from those of the file, and what helps."""
    versions, here = recipe.attributes.get("versions"), _versions(recipe)
    if str(versions).startswith(_DEPENDENT):
        return (
            f"{versions} made it, and cgid 0.1 took the last digits of its numbers from the processor; repair it by "
            "that version on the kind of machine that made it, or generate it again"
        )
    if versions != here:
        return f"repair it by the versions that made it, {versions}; here {here}; or generate it again"
    return f"the versions are the same, {here}, so its numbers have been changed, or others than its scene's"


# ---- manifest and sums -----------------------------------------------------------------------------------------------


def _sum_again(file: Path, manifest: Manifest | None) -> str:
    """Rewrite `SHA256SUMS` from the manifest, or from recordings, which have their own checksums."""
    if manifest is not None:
        write_whole(file, sums_text(sums_of(manifest.shards, file.with_name(MANIFEST).read_bytes())))
        return "written again from the manifest"
    sums = {path.name: file_facts(path)["sha256"] for path, _ in _whole_files(file, RECORDING_NAME)}
    write_whole(file, sums_text(sums))
    return f"written again from the {len(sums)} recordings that are there"


def _relist(file: Path) -> str:
    """Rewrite a lost manifest from the shards in its folder, which must be whole and of one dataset."""
    sums: dict[str, str] = {}
    with suppress(BadData):  # damaged sums are rewritten from the manifest later
        sums = read_sums(file.parent) or {}
    entries: list[ShardEntry] = []
    attributes: dict[str, Any] = {}
    examined: dict[str, Any] = {}
    for shard, examined in _whole_files(file, SHARD_NAME, sums.keys() - {MANIFEST}):
        said = dict(examined["attributes"])
        labels: Counter[str] = Counter()
        for batch in Dataset(shard).batches():
            labels.update(batch.labels.tolist())
        first, counts = said.pop("first_signal", 0), dict(sorted(labels.items()))
        entries.append(ShardEntry(first_signal=first, n_signals=labels.total(), labels=counts, **file_facts(shard)))
        attributes = attributes or said
        if said != attributes:
            raise BadData(
                f"{shard}: is not of the dataset that {entries[0].file} is of; take it away, or generate anew"
            )
    *starts, n_signals = accumulate((entry.n_signals for entry in entries), initial=0)
    if not entries or [entry.first_signal for entry in entries] != starts:
        raise BadData(f"{file.parent}: its shards must follow each other from signal 0 on; generate the dataset again")
    manifest = Manifest(
        n_signals=n_signals,
        attributes=in_order(attributes),
        shards=tuple(entries),
        shard_signals=entries[0].n_signals,
        n_samples=examined["n_samples"],
        dtype=examined["dtype"],
        compression=compression_of(examined),
    ).to_bytes()
    if sums and sums != sums_of(entries, manifest):
        raise BadData(f"{file}: must come out with the sums of {SUMS}, it does not; generate the dataset again")
    write_whole(file, manifest)
    return f"made again from the {len(entries)} shards that are there, of {n_signals} signals"


def _whole_files(file: Path, name: str, listed: Collection[str] = ()) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the files from which a manifest or `SHA256SUMS` is rewritten, each with the result of `examine_file`.

    Raises `BadData` unless they are whole, and as many as `file`, which may be damaged, and `listed` name: a new one
    would omit missing files.
    """
    found = sorted(path for path in file.parent.iterdir() if re.fullmatch(name, path.name))
    named = {*re.findall(name, (read_text(file) or b"").decode("latin-1")), *listed}
    if len(named) > len(found):
        raise BadData(
            f"{file}: names {len(named)} files, {len(found)} are there, and without it those that are missing cannot "
            "be made again; generate them again"
        )
    for path in found:
        if path.is_symlink():
            raise BadData(f"{path}: {LINKED}")
        examined = examine_file(path)
        if damage_in_words(examined):
            raise BadData(
                f"{path}: must be whole to make a new {file.name} from, it is not, and without that it cannot be made "
                "again; generate the dataset again"
            )
        yield path, examined
