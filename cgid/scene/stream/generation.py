"""From a scene with a stream to recordings on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from cgid import validation
from cgid.errors import CannotCreate, InvalidValue
from cgid.scene.background_noise import background_of
from cgid.scene.generation import attributes_of
from cgid.scene.randomness import require_seed
from cgid.scene.scene import Scene
from cgid.scene.stream.axis import samples_of
from cgid.scene.stream.capacity import MOST_RECORDINGS, require_capacity
from cgid.scene.stream.synthesis import parts_of_recording
from cgid.scene.stream.truth import impact_units, joined
from cgid.store import check_output
from cgid.store.recording import OURS, RecordingPlan, writing
from cgid.store.writing import is_single_file


def generate_recordings(
    scene: Scene,
    output: str | Path,
    n_recordings: int = 1,
    seed: int = 0,
    *,
    dtype: Literal["float32", "float64"] = "float32",
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write recordings of a stream, each with the truth of its impacts, and return the path.

    Parameters
    ----------
    scene : Scene
        With a `stream`.
    output : str or Path
        Ending in .h5 or .hdf5: one file, for one recording. Else a folder of recording-00000.h5 and so on.
    n_recordings : int
        Each of the duration of the stream, with rocks and noise of its own.
    seed : int
    dtype : {"float32", "float64"}
        Of the samples.
    overwrite : bool
        Whether old recordings may be replaced.
    progress : callable, optional
        Called with a number of samples whenever so many more are done.

    Raises
    ------
    InvalidValue
        The scene has no stream, a number breaks its rule, or a recording would be too large.
    CannotCreate
        The output exists, or cannot be made.
    NoInput, BadData
        The recorded background of the scene cannot be used.
    WriteFailed
        The disk is full; finished recordings of a folder stay.
    """
    if scene.stream is None:
        raise InvalidValue(f"scene {scene.name} must have a section stream to make a recording of; it has none")
    if not 1 <= n_recordings <= MOST_RECORDINGS:
        raise InvalidValue(f"n_recordings must lie between 1 and {MOST_RECORDINGS}, got {n_recordings}")
    path = Path(output)
    if n_recordings > 1 and is_single_file(path):
        raise InvalidValue(
            f"{path}: a file must hold one recording, got {n_recordings}; give a name that does not end in .h5, "
            "for a folder"
        )
    validation.choice("dtype", dtype, ("float32", "float64"))
    require_seed(seed)
    require_capacity(scene, dtype)
    background_of(scene)
    path = check_output(path, overwrite, ours=OURS)
    plan = RecordingPlan(
        n_samples=samples_of(scene),
        dtype=dtype,
        sampling_rate=scene.sampling.sampling_rate,
        unit=scene.sensor.unit,
        attributes={**_attributes(scene, seed), "recording": 0},
    )
    plan.require_room(path.parent, n_recordings)
    if is_single_file(path):
        write_recording(path, plan, scene, seed, 0, progress)
        return path
    _make_folder(path, overwrite)
    for number in range(n_recordings):
        write_recording(path / f"recording-{number:05d}.h5", plan, scene, seed, number, progress)
    return path


def write_recording(
    path: Path, plan: RecordingPlan, scene: Scene, seed: int, number: int, progress: Callable[[int], object] | None
) -> None:
    """Write one recording of a stream, by its number; see `generate_recordings`."""
    dtype: Any = plan.dtype
    own = RecordingPlan(**{**vars(plan), "attributes": {**plan.attributes, "recording": number}})
    truth = []
    with writing(path, own) as writer:
        for part in parts_of_recording(scene, seed, number, dtype=dtype):
            writer.add(part.samples)
            truth.append(part.truth)
            if progress is not None:
                progress(part.samples.size)
        writer.add_impacts(joined(scene, truth), impact_units(scene))


def _make_folder(path: Path, overwrite: bool) -> None:
    try:
        path.mkdir(exist_ok=True)
        if overwrite:
            for old in path.iterdir():
                old.unlink()  # nothing but recordings of ours: check_output has seen to that
    except OSError as error:
        raise CannotCreate(f"{path}: cannot be written ({error.strerror}); choose another place") from None


def _attributes(scene: Scene, seed: int) -> dict[str, Any]:
    """Return how a recording is made; the formats are the store's own."""
    found = {key: value for key, value in attributes_of(scene, seed).items() if key not in ("format", "schema_version")}
    if scene.background is not None and scene.background.recorded is not None:
        content = (scene.folder / scene.background.recorded.path).read_bytes()
        # The scene names the file only, and the samples depend on what is in it.
        found["background_sha256"] = hashlib.sha256(content).hexdigest()
    return found
