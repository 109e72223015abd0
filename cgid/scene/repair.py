"""What is damaged is made again: everything follows from the scene and the seed that every file says."""

from __future__ import annotations

import hashlib
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cgid.errors import BadData, CannotCreate, CgidError
from cgid.files import whole_file, write_whole
from cgid.lock import locked
from cgid.scene._fourier import LARGEST_FACTOR, transformable
from cgid.scene.provenance import attributes_of, in_order, plan_of, scene_of, shard_plan, whole_number
from cgid.scene.recordings import write_recording
from cgid.scene.relisting import relist
from cgid.scene.repair_size import Room, require_length, size_made, size_of
from cgid.scene.schema import Scene, samples_of
from cgid.scene.synthesis import synthesise
from cgid.store.examination import compression_of, examine_file
from cgid.store.export import write_dataset
from cgid.store.header import FORMAT, LARGEST_SHARD, RECORDING_FORMAT
from cgid.store.manifest import MANIFEST, Manifest, ShardEntry, read_manifest
from cgid.store.recording import RECORDING_NAME, RecordingPlan
from cgid.store.shard import ShardBuilder, ShardPlan
from cgid.store.verification import Finding, Verified

#: Versions of cgid whose numbers differed from processor to processor.
_DEPENDENT = "cgid 0.1."
#: Datasets that tell whether another version makes the same signals.
_MAIN = ("signals", "samples")
#: What was left behind by a run that was stopped does not change for so long [s].
_STILL_WRITTEN = 60.0

Progress = Callable[[int], object]
Chunks = Mapping[str, list[tuple[int, int, str]]]


@dataclass(frozen=True, kw_only=True)
class Repair:
    """What became of a finding.

    Attributes
    ----------
    finding : Finding
    done : bool
    told : str
        What was done, or why it was not.
    """

    finding: Finding
    done: bool
    told: str


def repair(verified: Verified, scene: Scene | None = None, progress: Progress | None = None) -> Iterator[Repair]:
    """Make again what is damaged or missing, each file whole or not at all, and remove what killed runs have left.

    A shard that a manifest speaks of must come out with the very SHA-256. Where other versions of libraries give other
    bytes, and in files without a manifest, what is undamaged must be equal to what is made; else nothing is replaced.

    Parameters
    ----------
    verified : Verified
    scene : Scene, optional
        From the file that it was made of; needed where the scene names a recording that is to be read.
    progress : callable, optional
        Called with a number of signals or samples whenever so many more are made.

    Yields
    ------
    Repair
        One for each finding that is neither foreign nor pending.

    Raises
    ------
    CannotCreate
        A run is writing into the folder, or has made another dataset of it since it was verified.
    """
    manifest, room = verified.manifest, Room(verified.path)
    # The manifest comes last: it is made from the shards.
    findings = sorted(verified.findings, key=lambda finding: finding.file.name == MANIFEST)
    with _alone(verified.path):
        _require_unchanged(verified)
        for finding in findings:
            if finding.problem in ("foreign", "pending"):
                continue
            try:
                if finding.problem == "leftover":
                    told = _remove(finding.file)
                elif finding.problem == "unfinished" or (finding.entry is not None and manifest is None):
                    raise BadData(f"{finding.file}: belongs to an unfinished run; cgid generate ... --resume mends it")
                elif finding.file.name == MANIFEST:
                    told = relist(finding.file)
                elif finding.entry is not None and manifest is not None:
                    told, manifest = _mend_shard(finding, finding.entry, verified, manifest, scene, room, progress)
                else:
                    told = _mend_file(finding, scene, room, progress)
            except (CgidError, OSError) as error:
                yield Repair(finding=finding, done=False, told=str(error))
            else:
                yield Repair(finding=finding, done=True, told=told)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep runs from writing into a folder meanwhile; raises `CannotCreate` if one does."""
    with ExitStack() as held:
        try:
            if path.is_dir():
                held.enter_context(locked(path))
        except BlockingIOError:
            raise CannotCreate(f"{path}: a run is writing there; wait for it") from None
        except OSError as error:
            raise CannotCreate(f"{path}: cannot be written ({error.strerror})") from None
        yield


def _require_unchanged(verified: Verified) -> None:
    """Raise `CannotCreate` if the manifest is not the one that was verified, which may be hours ago."""
    if verified.manifest is None:
        return
    try:
        manifest = read_manifest(verified.path)
    except BadData:
        manifest = None
    if manifest != verified.manifest:
        raise CannotCreate(f"{verified.path}: has been replaced by another since it was verified; verify it again")


def _remove(file: Path) -> str:
    """Remove what was left behind, unless somebody may be writing it."""
    if time.time() - file.stat().st_mtime < _STILL_WRITTEN:
        raise CannotCreate(f"{file}: was written to within the last minute; remove it when no run writes there")
    file.unlink()
    return "removed"


# ---- a file by itself ------------------------------------------------------------------------------------------------


def _mend_file(finding: Finding, given: Scene | None, room: Room, progress: Progress | None) -> str:
    path, examined = finding.file, finding.examined
    if re.fullmatch(RECORDING_NAME, path.name) and (not examined or examined["fault"]):
        return _mend_lost_recording(path, given, room, progress)
    kind = examined.get("attributes", {}).get("format")
    if not examined or examined["fault"]:
        raise BadData(
            f"{path}: does not say any more how it was made; if it was made by cgid, make it again by cgid generate "
            "with --overwrite"
        )
    if kind not in (FORMAT, RECORDING_FORMAT):
        raise BadData(f"{path}: is no file that is made again in part; make it again by the command that made it")
    attributes = examined["attributes"]
    scene, seed = scene_of(path, attributes, given), whole_number(path, attributes, "seed")
    room.take(path, size_made(path, examined, scene))
    with whole_file(path) as temporary:
        if kind == RECORDING_FORMAT:
            _write_recording(temporary, examined, scene, seed, progress)
        else:
            _write_dataset(temporary, plan_of(scene, examined), examined, scene, seed, progress)
        _require_agreement(path, examined, temporary, attributes, scene)
    return "made again; all that was undamaged is as before"


def _mend_lost_recording(path: Path, given: Scene | None, room: Room, progress: Progress | None) -> str:
    """Make a recording of which nothing can be read by what another in its folder says."""
    others = sorted(other for other in path.parent.glob("recording-*.h5") if other != path and not other.is_symlink())
    said = next((found for found in map(examine_file, others) if not found["fault"]), None)
    if said is None:
        raise BadData(f"{path}: no recording beside it says how they were made; generate them again")
    attributes = {**said["attributes"], "recording": int(path.stem.removeprefix("recording-"))}
    scene, seed = scene_of(path, attributes, given), whole_number(path, attributes, "seed")
    here = attributes_of(scene, seed)["versions"]
    if attributes.get("versions") != here:
        raise BadData(
            f"{path}: must be made by the versions that made the others, {attributes.get('versions')}; here {here}"
        )
    room.take(path, size_made(path, said, scene))
    _write_recording(path, {**said, "attributes": attributes}, scene, seed, progress)
    return "made again"


def _write_recording(
    path: Path, examined: Mapping[str, Any], scene: Scene, seed: int, progress: Progress | None
) -> None:
    attributes = examined["attributes"]
    own = ("format", "schema_version", "n_impacts")
    plan = RecordingPlan(
        n_samples=samples_of(scene),
        dtype=examined["dtype"],
        sampling_rate=scene.sampling.sampling_rate,
        unit=scene.sensor.unit,
        attributes={name: value for name, value in in_order(attributes).items() if name not in own},
    )
    write_recording(path, plan, scene, seed, whole_number(path, attributes, "recording"), progress)


def _write_dataset(
    path: Path, plan: ShardPlan, examined: Mapping[str, Any], scene: Scene, seed: int, progress: Progress | None
) -> None:
    first = whole_number(path, examined["attributes"], "first_signal")
    n_signals = examined["chunks"]["signals"][-1][1]
    if plan.size(n_signals) <= LARGEST_SHARD:
        path.write_bytes(_shard(plan, first, n_signals, scene, seed, progress))
        return
    dtype: Any = plan.dtype
    write_dataset(path, plan, first, n_signals, synthesise(scene, n_signals, seed, first=first, dtype=dtype), progress)


def _shard(
    plan: ShardPlan, first: int, n_signals: int, scene: Scene, seed: int, progress: Progress | None
) -> memoryview:
    """Return the content of a shard; raises `BadData` for one that no honest manifest lists."""
    size = plan.size(n_signals)
    if size > LARGEST_SHARD:
        raise BadData(f"a shard must be at most {LARGEST_SHARD >> 30} GiB, got {size / 2**30:.3g} GiB of signals")
    builder, dtype = ShardBuilder(plan, first, n_signals), plan.dtype
    kind: Any = dtype
    for batch in synthesise(scene, n_signals, seed, first=first, dtype=kind):
        builder.add(batch)
        if progress is not None:
            progress(len(batch))
    return builder.image()


# ---- a shard of a folder ---------------------------------------------------------------------------------------------


def _mend_shard(
    finding: Finding,
    entry: ShardEntry,
    verified: Verified,
    manifest: Manifest,
    given: Scene | None,
    room: Room,
    progress: Progress | None,
) -> tuple[str, Manifest]:
    """Make a shard again and return what was done, and the manifest as it is then.

    A shard that can be read and names another seed or scene is not damaged: it is never replaced.
    """
    path, attributes = finding.file, manifest.attributes
    manifest.require_own(path, finding.examined.get("attributes", {}))
    if manifest.n_samples is not None and manifest.dtype is not None:
        room.take(path, size_of(entry.n_signals, manifest.n_samples, manifest.dtype))
    scene, seed = scene_of(verified.path / MANIFEST, attributes, given), whole_number(path, attributes, "seed")
    plan = _plan_of_folder(verified, manifest, scene)
    if manifest.n_samples is None:
        room.take(path, size_of(entry.n_signals, plan.n_samples, plan.dtype))
    else:
        require_length(verified.path / MANIFEST, manifest.n_samples, scene)
    content = _shard(plan, entry.first_signal, entry.n_signals, scene, seed, progress)
    digest = hashlib.sha256(content).hexdigest()
    if digest == entry.sha256:
        write_whole(path, content)
        return "made again, byte for byte", manifest
    with whole_file(path) as temporary:
        temporary.write_bytes(content)
        if not _agrees_with_another(verified, manifest, plan, scene, seed):
            _require_agreement(path, finding.examined, temporary, attributes, scene)
    changed = replace(entry, bytes=len(content), sha256=digest)
    manifest = replace(
        manifest,
        shards=tuple(changed if other == entry else other for other in manifest.shards),
        # Manifests of version 1 do not say them, and the new one must.
        shard_signals=manifest.shards[0].n_signals,
        n_samples=plan.n_samples,
        dtype=plan.dtype,
        compression=plan.compression,
    )
    write_whole(verified.path / MANIFEST, manifest.to_bytes())
    return f"made again by other versions than {attributes.get('versions')}: equal numbers in other bytes", manifest


def _agrees_with_another(verified: Verified, manifest: Manifest, plan: ShardPlan, scene: Scene, seed: int) -> bool:
    """Return whether there is an undamaged shard; raises `BadData` if other numbers than its own come out here."""
    damaged = {finding.file.name for finding in verified.findings}
    for entry in sorted(manifest.shards, key=lambda entry: entry.n_signals):
        if entry.file not in damaged:
            path = verified.path / entry.file
            with tempfile.TemporaryDirectory() as folder:
                made = Path(folder) / entry.file
                made.write_bytes(_shard(plan, entry.first_signal, entry.n_signals, scene, seed, None))
                _require_agreement(path, examine_file(path), made, manifest.attributes, scene)
            return True
    return False


def _plan_of_folder(verified: Verified, manifest: Manifest, scene: Scene) -> ShardPlan:
    """Return what the shards of a folder have in common; what an old manifest does not say, a shard does."""
    if manifest.dtype is not None and manifest.compression is not None:
        return shard_plan(scene, manifest.attributes, manifest.dtype, manifest.compression)
    for entry in manifest.shards:
        examined = examine_file(verified.path / entry.file)
        if not examined["fault"]:
            return shard_plan(scene, manifest.attributes, examined["dtype"], compression_of(examined))
    raise BadData(f"{verified.path}: no shard says any more how its signals are stored; generate the dataset again")


def _require_agreement(
    path: Path, examined: Mapping[str, Any], made: Path, attributes: Mapping[str, Any], scene: Scene
) -> None:
    """Raise `BadData` unless what is undamaged in a file is equal to what was made, and there is enough of it."""
    old: Chunks = examined.get("chunks", {})
    steps = {name: max(chunks[0][1], 1) for name, chunks in old.items() if chunks}
    new: Chunks = examine_file(made, steps)["chunks"]
    sound = [(name, tuple(chunk)) for name, chunks in old.items() for chunk in chunks if chunk[2]]
    there = {(name, tuple(chunk)) for name, chunks in new.items() for chunk in chunks}
    differing = sum(chunk not in there for chunk in sound)
    versions, here = attributes.get("versions"), attributes_of(scene, 0, compression_of(examined))["versions"]
    if differing:
        raise BadData(
            f"{path}: what is undamaged must come out here as it is, {differing} of {len(sound)} chunks do not; "
            f"nothing was replaced: {_why_others(versions, here, scene)}"
        )
    # The same numbers come out on every processor; another version may make others.
    if versions != here and not any(name in _MAIN for name, _ in sound):
        raise BadData(
            f"{path}: nothing undamaged is left that tells whether {here} gives the same signals as {versions}; "
            "nothing was replaced: repair it by those versions, or generate it again"
        )


def _why_others(versions: Any, here: str, scene: Scene) -> str:
    """Return why other numbers come out here than those of a file, and what helps."""
    if str(versions).startswith(_DEPENDENT):
        return (
            f"{versions} made it, and cgid 0.1 took the last digits of its numbers from the processor; repair it by "
            "that version on the kind of machine that made it, or generate it again"
        )
    if versions != here:
        return f"repair it by the versions that made it, {versions}; here {here}"
    samples = scene.sampling.samples
    if scene.stream is None and scene.sensor.bandwidth is not None and not transformable(samples):
        return (
            f"the bandwidth of frames of {samples} samples, which have a prime factor above {LARGEST_FACTOR}, is left "
            "to numpy's transform, whose last digits may be the processor's; repair it on the machine that made it"
        )
    return f"the versions are the same, {here}, so its numbers have been changed, or others than its scene's"
