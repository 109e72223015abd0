"""Repair of a folder: damaged or lost files are regenerated from the description, as when a run is resumed."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData
from cgid.files import require_room
from cgid.scene import generation, recordings
from cgid.scene.schema import Scene, stored_scene
from cgid.store.description import DIGEST, FORMAT, RECORDING_FORMAT
from cgid.store.folder import DESCRIPTION, Description, read_folder, require_same
from cgid.store.run import begun
from cgid.store.verification import Finding, Verified, examine_file

__all__ = ["changed", "repair"]

Progress = Callable[[int], object]


def repair(verified: Verified, scene: Scene | None = None, progress: Progress | None = None) -> None:
    """Regenerate damaged and lost files of a folder, list the sums of complete files, and remove leftovers.

    An unfinished run is not completed, and files of another description are not replaced.

    Parameters
    ----------
    verified : Verified
        The result of `cgid.store.verification.verify`.
    scene : Scene, optional
        Only a dataset with a recorded background needs it.
    progress : callable, optional
        Called with the number of signals or samples made since the last call.

    Raises
    ------
    BadData
        It is not a folder of this version with a valid description, or its whole files do not follow from that here.
    CannotCreate
        Its files do not follow from the description here, a run writes into the folder, or the disk is full.
    WriteFailed
        The disk is full.
    """
    path = verified.path
    if not path.is_dir():
        raise BadData(_how_to_make(path))
    folder = read_folder(path)
    digest, names = folder.description.sha256, folder.description.names
    lost = {finding.file.name for finding in verified.damage} & {*names}
    for name in sorted(lost):
        is_there = (path / name).is_file() and not (path / name).is_symlink()
        if is_there and examine_file(path / name).about.get(DIGEST, digest) != digest:
            raise BadData(f"{path / name}: belongs to another description, so it is not replaced; move it away")
    make = _maker(path, folder.description, scene, len(lost)) if lost else None
    with begun(path, folder.description, resume=True) as run:
        if make is not None:
            make(run, missing=[number for number in run.missing if names[number] in lost], progress=progress)


def changed(verified: Verified, scene: Scene | None = None, progress: Progress | None = None) -> tuple[Finding, ...]:
    """Return the whole files of a dataset or recording whose first signals its custom laws do not make any more.

    Parameters
    ----------
    verified : Verified
        The result of `cgid.store.verification.verify`.
    scene : Scene, optional
        As for `repair`.
    progress : callable, optional
        Called with the number of files made again since the last call.

    Returns
    -------
    tuple of Finding
        None where the scene has no custom laws.

    Raises
    ------
    BadData
        A law of the scene is unknown, or the scene or seed is missing.
    """
    path, lost = verified.path, {finding.file for finding in verified.findings}
    if path.is_dir():
        description = read_folder(path).description
        kind, about = description.kind, description.content["attributes"]
        files = [path / name for name in description.names if (path / name).exists()]
    else:
        kind, _, about = examine_file(path)
        files = [path]
    if "laws" not in about:
        return ()
    of_scene, seed = _scene_of(path, about, scene), _seed_of(path, about)
    require = recordings.require_recording if kind == RECORDING_FORMAT else generation.require_shard
    findings = []
    for file in files:
        try:
            if file not in lost:
                require(file, of_scene, seed)
        except BadData as error:
            findings.append(Finding(file=file, problem="changed", what=str(error).removeprefix(f"{file}: ")))
        if progress is not None:
            progress(1)
    return tuple(findings)


def _seed_of(file: Path, attributes: Any) -> int:
    seed = attributes.get("seed")
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise BadData(f"{file}: seed must be a whole number of 0 or more; generate the files again")
    return int(seed)


def _maker(path: Path, description: Description, given: Scene | None, n_files: int) -> Callable[..., None]:
    """Return the function that makes the files of a folder; raises `BadData` if this cgid would make different ones."""
    file, content, attributes = path / DESCRIPTION, description.content, description.content["attributes"]
    seed, dtype = _seed_of(file, attributes), content["dtype"]
    scene = _scene_of(file, attributes, given)
    plan: Any
    make: Callable[..., None]
    if description.kind == RECORDING_FORMAT:
        plan, current = recordings.planned(scene, seed, content["n_recordings"], dtype)
        make, size = recordings.make_recordings, plan.size
    else:
        counts = content["n_signals"], content["shard_signals"]
        plan, current = generation.planned(path, scene, seed, *counts, dtype, content["compression"])
        make, size = generation.make_shards, plan.size(content["shard_signals"])
    require_same(path, content, current.content, "use the versions and the scene that made it, or generate it again")
    require_room(path, path, n_files * size, "files that are made again", "make room")
    return partial(make, scene=scene, seed=seed, plan=plan)


def _how_to_make(file: Path) -> str:
    """Return how to regenerate a single file."""
    kind, _, about = examine_file(file)
    if kind not in (FORMAT, RECORDING_FORMAT) or "seed" not in about or about.get("first_signal"):
        return f"{file}: repeat the command that made it; if that was cgid generate, with --overwrite"
    options = f"-n {about.get('n_signals', 1)} --seed {about['seed']}"
    options += "".join(f" --{name} {about[name]}" for name in ("dtype", "compression") if name in about)
    name, output = shlex.quote(str(about.get("scene_name"))), shlex.quote(str(file))
    return f"{file}: make it again by cgid generate {name} {options} -o {output} --overwrite"


def _scene_of(path: Path, attributes: Any, given: Scene | None) -> Scene:
    """Return the scene of a folder: `given`, read from its own file, or the one stored in `attributes`."""
    scene = given or stored_scene(attributes, str(path))
    if scene is None:
        raise BadData(f"{path}: does not state its scene; make it again by cgid generate")
    if given is None and scene.background is not None and scene.background.recorded is not None:
        # An untrusted file must not open other files.
        raise BadData(
            f"{path}: was made with the recorded background {scene.background.recorded.path}; give the scene file next "
            "to it by --scene FILE"
        )
    return scene
