"""How a file says it was made: the scene, the seed, and the plan of its shards."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cgid import __version__
from cgid.errors import BadData
from cgid.scene.draws import parameter_units
from cgid.scene.schema import Scene, parse_scene
from cgid.store.compression import library
from cgid.store.examination import compression_of
from cgid.store.shard import ShardPlan

#: In which root attributes are written: bytes depend on it, and HDF5 does not keep it.
_ORDER = ("format", "schema_version", "seed", "scene_name", "scene", "scene_sha256", "versions", "background_sha256")


def attributes_of(scene: Scene, seed: int, compression: str = "none") -> dict[str, Any]:
    """Return the root attributes of a dataset: how it was made, and by what its bytes were."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "h5py"))
    if compression != "none":
        packages += f", {library(compression)}"
    found = {
        "seed": seed,
        "scene_name": scene.name,
        "scene": scene.text,
        "scene_sha256": scene.sha256,
        "versions": f"cgid {__version__}, Python {platform.python_version()}, {packages}",
    }
    if scene.background is not None and scene.background.recorded is not None:
        # The scene names the file only, and the samples depend on what is in it.
        with scene.background.recorded.file(scene.folder).open("rb") as stream:
            found["background_sha256"] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found


def scene_of(path: Path, attributes: Mapping[str, Any], given: Scene | None) -> Scene:
    """Return the scene that a file was made of.

    Parameters
    ----------
    path : Path
        For messages.
    attributes : dict
        What the file says.
    given : Scene or None
        From the scene's own file.

    Raises
    ------
    BadData
        The file does not say it, another scene is given, or none where the scene names a recording to be read.
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
    try:
        content = json.loads(attributes["scene"])
    except (KeyError, TypeError, ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise BadData(f"{path}: does not say of what scene it was made; make it again by cgid generate")
    scene = parse_scene(content, source=str(path))
    if scene.background is not None and scene.background.recorded is not None:
        # What a file names, which may come from a stranger, is not opened for him.
        raise BadData(
            f"{path}: was made with the recorded background {scene.background.recorded.path}; give the scene file that "
            "lies beside it by --scene FILE"
        )
    return scene


def whole_number(path: Path, attributes: Mapping[str, Any], name: str) -> int:
    """Return an attribute that must be a whole number of 0 or more; raises `BadData`."""
    number = attributes.get(name)
    if type(number) is not int or number < 0:
        raise BadData(
            f"{path}: {name} must be a whole number of 0 or more, got {number!r:.40}; generate the file again"
        )
    return number


def plan_of(scene: Scene, examined: Mapping[str, Any]) -> ShardPlan:
    """Return the plan of a shard that `cgid.store.examination.examine_file` has looked at."""
    stored = {name: value for name, value in examined["attributes"].items() if name != "first_signal"}
    return shard_plan(scene, stored, examined["dtype"], compression_of(examined))


def shard_plan(scene: Scene, attributes: Mapping[str, Any], dtype: str, compression: str) -> ShardPlan:
    """Return the plan of the shards of a dataset with these root attributes."""
    return ShardPlan(
        n_samples=scene.sampling.samples,
        dtype=dtype,
        label_width=max(len(label.encode()) for label in scene.labels),
        parameter_units=parameter_units(scene),
        attributes=in_order(attributes),
        compression=compression,
    )


def in_order(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes in the order in which they are written, which HDF5 does not keep, and bytes depend on."""
    return {name: attributes[name] for name in _ORDER if name in attributes} | dict(attributes)
