"""Files that do not follow from their scene any more, since what a custom law reads or imports is in no checksum."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cgid._lib.spelling import spelled
from cgid.errors import BadData
from cgid.scene.file.schema import Scene, stored_scene
from cgid.scene.output import generation, recordings
from cgid.store.description import RECORDING_FORMAT
from cgid.store.folder import read_folder
from cgid.store.verification import Finding, Verified, examine_file

__all__ = ["changed"]

Progress = Callable[[int], object]


def changed(verified: Verified, scene: Scene | None = None, progress: Progress | None = None) -> tuple[Finding, ...]:
    """Return the whole files of a dataset or recording whose first signals its custom laws do not make any more.

    Parameters
    ----------
    verified : Verified
        The result of `cgid.store.verification.verify`.
    scene : Scene, optional
        Only data with a recorded background need it.
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
            findings.append(Finding(file=file, problem="changed", what=str(error)))
        if progress is not None:
            progress(1)
    return tuple(findings)


def _seed_of(file: Path, attributes: Any) -> int:
    seed = attributes.get("seed")
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise BadData(f"{file}: seed must be a whole number of 0 or more; generate the files again")
    return int(seed)


def _scene_of(path: Path, attributes: Any, given: Scene | None) -> Scene:
    """Return the scene of a folder: `given`, read from its own file, or the one stored in `attributes`."""
    scene = given or stored_scene(attributes, str(path))
    if scene is None:
        raise BadData(f"{path}: does not state its scene; make it again by cgid generate")
    if given is None and scene.background is not None and scene.background.recorded is not None:
        # An untrusted file must not open other files.
        raise BadData(
            f"{path}: was made with the recorded background {scene.background.recorded.path}; give the scene file next "
            f"to it by {spelled('scene', 'FILE')}"
        )
    return scene
