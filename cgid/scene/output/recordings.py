"""Write recordings of a stream to disk; the required space is checked first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from cgid._lib import validation
from cgid._lib.files import require_room
from cgid._lib.terminal import counted
from cgid.errors import InvalidValue
from cgid.scene.file.distributions import MIN_RECORDING
from cgid.scene.file.schema import Scene, load_scene, samples_of
from cgid.scene.output.generation import attributes_of, in_order, require_same_samples
from cgid.scene.synthesis.draws import require_seed
from cgid.scene.synthesis.noise import background_of
from cgid.scene.synthesis.rocks import arrivals_of
from cgid.scene.synthesis.stream import impact_units, joined, parts_of_recording
from cgid.store.description import DIGEST, MAX_RECORDING, RECORDING_FORMAT
from cgid.store.folder import Description, describe, sha256_of
from cgid.store.hdf5 import RecordingPlan, writing
from cgid.store.reading import Recording
from cgid.store.run import begun, check_output, is_single_file

#: Memory for the truth of an impact, including sorting and writing [bytes],
_IMPACT_BYTES = 500
#: and the limit for a complete recording [bytes].
MAX_TRUTH = 1 << 30
#: Maximum number of recordings in a folder.
MAX_RECORDINGS = 100_000
#: Allowed excess of Poisson arrivals over the expected number [standard deviations].
_DEVIATIONS = 6.0


def max_impacts(scene: Scene) -> float:
    """Return a safe upper limit of the impacts in a recording: six standard deviations above the expected rocks."""
    assert scene.stream is not None
    stream = scene.stream
    rocks = float(arrivals_of(stream).expected(stream.duration))
    if stream.arrivals.rate is not None:
        rocks += _DEVIATIONS * np.sqrt(rocks)
    return rocks * (1 if stream.rebounds is None else 1 + stream.rebounds.most)


def require_capacity(scene: Scene, dtype: str) -> None:
    """Raise `InvalidValue` if a recording would not fit into a file, or its truth into memory."""
    assert scene.stream is not None
    duration, impacts = scene.stream.duration, max_impacts(scene)
    samples = samples_of(scene)
    size = samples * np.dtype(dtype).itemsize
    if size > MAX_RECORDING:
        raise InvalidValue(
            f"scene {scene.name}: stream.duration must make at most {MAX_RECORDING / 2**30:g} GiB of samples, "
            f"{duration:g} s at {scene.sampling.sampling_rate:g} Hz make {samples:.4g} of {dtype}, "
            f"{size / 2**30:.3g} GiB; {_hint(duration, size / MAX_RECORDING, 'lower the sampling rate')}"
        )
    needed = impacts * _IMPACT_BYTES
    if needed > MAX_TRUTH:
        raise InvalidValue(
            f"scene {scene.name}: stream.arrivals must make at most {MAX_TRUTH / _IMPACT_BYTES:.3g} impacts, whose "
            f"truth fits into {MAX_TRUTH / 2**30:g} GiB of memory; {duration:g} s can make {impacts:.3g}, which "
            f"need {needed / 2**30:.3g} GiB; {_hint(duration, needed / MAX_TRUTH, 'lower the rate')}"
        )


def _hint(duration: float, excess: float, otherwise: str) -> str:
    # A small margin, so that the proposal passes.
    count = int(np.ceil(excess * 1.02))
    if count > MAX_RECORDINGS or duration / count < MIN_RECORDING:
        return otherwise
    made = counted(count, "recording")
    return f"make {made} (-n {count}) with a duration of {duration / count:.3g} s each, or {otherwise}"


def generate_recordings(
    scene: Scene | str | Path,
    output: str | Path,
    n_recordings: int = 1,
    seed: int = 0,
    *,
    dtype: Literal["float32", "float64"] = "float32",
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write recordings of a stream, each with the truth of its impacts, and return the path.

    Parameters
    ----------
    scene : Scene, str or Path
        With a `stream`.
    output : str or Path
        One file for a name in .h5 or .hdf5 (one recording); else a folder of recording-00000.h5 and so on.
    n_recordings : int
        Each has the duration of the stream, and its own rocks and noise.
    seed : int
    dtype : {"float32", "float64"}
        Of the samples.
    overwrite : bool
        Replace existing recordings.
    resume : bool
        Continue an unfinished run; a finished one is unchanged.
    progress : callable, optional
        Called with the number of newly finished samples.

    Returns
    -------
    Path

    Raises
    ------
    InvalidValue
        The scene has no stream, a number breaks its rule, or a recording would be too large.
    CannotCreate
        The output exists, cannot be created or is in use by another run, or the run to resume had other options.
    NoInput, BadData
        The recorded background is unusable, the output to resume is damaged, or its samples do not follow from the
        scene and its laws any more.
    WriteFailed
        The disk is full; finished recordings of a folder stay, and the run can be resumed.
    """
    scene = load_scene(scene)
    if scene.stream is None:
        raise InvalidValue(f"scene {scene.name} must have a section stream for recordings; it has none")
    n_recordings = validation.whole("n_recordings", n_recordings, 1, MAX_RECORDINGS)
    path = Path(output)
    if n_recordings > 1 and is_single_file(path):
        raise InvalidValue(
            f"{path}: a file must contain one recording, got {n_recordings}; give a name that does not end in .h5, "
            "for a folder"
        )
    validation.choice("dtype", dtype, ("float32", "float64"))
    seed = require_seed(seed)
    require_capacity(scene, dtype)
    background_of(scene)
    path = check_output(path, RECORDING_FORMAT, overwrite or resume)
    plan, description = planned(scene, seed, n_recordings, dtype)
    single = is_single_file(path)
    with begun(path, description, overwrite=overwrite, resume=resume) as run:
        if progress is not None and len(run.missing) < n_recordings:
            progress((n_recordings - len(run.missing)) * plan.n_samples)
        files = [] if single else [path / description.name(number) for number in run.missing]
        size = len(run.missing) * plan.size - sum(file.stat().st_size for file in files if file.exists())
        require_room(path, path.parent, size, "samples", "free some space, or make a shorter recording")
        if run.missing and run.first_whole is not None:
            require_recording(run.first_whole, scene, seed)
        for number in run.missing:
            file = path if single else path / description.name(number)
            write_recording(file, plan, scene, seed, number, progress, overwrite=overwrite or not single)
            if not single:
                run.add(file.name, sha256_of(file))
    return path


def planned(scene: Scene, seed: int, n_recordings: int, dtype: str) -> tuple[RecordingPlan, Description]:
    """Return the plan of recordings and the description of their folder."""
    plan = RecordingPlan(
        n_samples=samples_of(scene),
        dtype=dtype,
        sampling_rate=scene.sampling.sampling_rate,
        unit=scene.sensor.unit,
        attributes=in_order(attributes_of(scene, seed)),
    )
    description = describe(RECORDING_FORMAT, n_recordings=n_recordings, **vars(plan))
    return replace(plan, attributes={**plan.attributes, DIGEST: description.sha256}), description


def require_recording(file: Path, scene: Scene, seed: int) -> None:
    """Raise `BadData` unless a whole recording follows from the scene, as far as its first impacts."""
    recording = Recording(file)
    number, dtype = int(recording.attributes.get("recording", 0)), cast(Any, recording.dtype)
    samples, n_impacts = [np.empty(0, dtype)], 0
    for made, impacts in parts_of_recording(scene, seed, number, dtype=dtype):
        samples.append(made)
        if n_impacts and made.size:
            break
        n_impacts += len(impacts["time"])
    again = np.concatenate(samples)
    require_same_samples(file, recording.samples(0, again.size)[None], again[None], scene)


def write_recording(
    path: Path,
    plan: RecordingPlan,
    scene: Scene,
    seed: int,
    number: int,
    progress: Callable[[int], object] | None,
    *,
    overwrite: bool,
) -> None:
    """Write one recording of a stream, by its number; see `generate_recordings`."""
    dtype: Any = plan.dtype
    of_recording = replace(plan, attributes={**plan.attributes, "recording": number})
    truth = []
    with writing(path, of_recording, overwrite=overwrite) as writer:
        for samples, impacts in parts_of_recording(scene, seed, number, dtype=dtype):
            writer.add(samples)
            truth.append(impacts)
            if progress is not None:
                progress(samples.size)
        writer.add_impacts(joined(scene, truth), impact_units(scene))
