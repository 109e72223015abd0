"""Make a long recording of a scene and the truth of its impacts, with one stretch in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics.contact.impact import Impact
from cgid.physics.structure.coupled import ModalImpact
from cgid.scene.file.schema import Scene, load_scene, samples_of
from cgid.scene.file.sections import CONTACT_SHAPE
from cgid.scene.file.sensor import CHUNK
from cgid.scene.synthesis.draws import PARAMETER_UNITS, POINT_UNITS, SPHERE_SHAPE, require_seed
from cgid.scene.synthesis.impacts import Recorder, contacts_of, recorder_of
from cgid.scene.synthesis.noise import Background, add_noise, ar_noise_of, background_of
from cgid.scene.synthesis.plan import RESPONSE_TOLERANCE, STORED, Plan, plan
from cgid.scene.synthesis.rocks import Rocks, arrivals_of, arriving, thrown_back
from cgid.signals import Signal


class TimeAxis:
    """The part of the time axis that may still change."""

    def __init__(self) -> None:
        self.first = 0  # number of the first sample not yet taken
        self.samples: Floats = np.zeros(0)  # from there on; later ones are 0

    def until(self, stop: int) -> Floats:
        """Return the samples from the first one to number `stop`, to be added to in place."""
        missing = stop - self.first - self.samples.size
        if missing > 0:
            self.samples = np.concatenate([self.samples, np.zeros(missing)])
        return self.samples[: stop - self.first]

    def add(self, first: NDArray[np.int64], windows: NDArray[np.floating]) -> None:
        """Add windows (n, width), each at its first sample; parts before the axis are dropped."""
        width = windows.shape[1]
        samples = self.until(int(first.max()) + width)
        for start, window in zip((first - self.first).tolist(), windows, strict=True):
            lost = max(-start, 0)
            samples[start + lost : start + width] += window[lost:]

    def taken(self, stop: int) -> Floats:
        """Remove the samples before number `stop` from the axis and return them."""
        part = self.until(stop).copy()
        self.samples, self.first = self.samples[part.size :], stop
        return part


#: Maximum prime factor of the length of low-passed windows, for fast transforms.
_MAX_FACTOR = 509
#: Columns in stored order, and their units.
_UNITS = {"time": "s", "rock": "1", "bounce": "1"} | {
    name: unit for name, unit in PARAMETER_UNITS.items() if name != "onset"
}
_NEIGHBOUR_UNITS = {"next_impact": "s", "overlapping": "1"}


def impact_units(scene: Scene) -> dict[str, str]:
    """Return the columns of the truth of each impact, and their units.

    - time: of onset, from the first sample on
    - rock: its number in the recording, by arrival; bounce: number of its earlier impacts
    - restitution: as delivered, including losses to the target; velocity: normal to the beam
    - yield_pressure: where a rock's dissipation is thornton; dissipation: where populations differ in it, an index in
      `Scene.law_names`
    - curvature, effective_mass, exponent, contact_radius, breaking_force, remaining_force: where a population has a
      shape; viscous_restitution: where one has it
    - drop_height: nan except for a first fall from a height
    - next_impact: time to the next onset of any rock, nan for the last; overlapping: 1 if contacts overlap
    - impact_x, impact_y: on a beam of known size
    """
    more = {"yield_pressure": "Pa"} if "thornton" in scene.dissipations else {}
    more |= {"dissipation": "1"} if scene.mixes_laws else {}
    drawn = {name for population in scene.populations for name in population.laws}
    more |= {name: "1" for name in (*SPHERE_SHAPE, *CONTACT_SHAPE, "viscous_restitution") if name in drawn}
    place = {} if scene.region is None else POINT_UNITS
    return {**_UNITS, **more, **place, **_NEIGHBOUR_UNITS}


def truth_of(scene: Scene, rocks: Rocks, delivered: Mapping[str, Floats]) -> dict[str, NDArray[Any]]:
    """Return the truth of some impacts, except their neighbours; delivered comes from `add_impacts`."""
    known = {**rocks.columns, **delivered}
    labels = np.array([population.label for population in scene.populations])
    truth = {name: known[name] for name in impact_units(scene) if name not in _NEIGHBOUR_UNITS}
    return truth | {"label": labels[rocks["population"]], "specimen": rocks["specimen"]}


def empty_truth(scene: Scene) -> dict[str, NDArray[Any]]:
    """Return an empty truth."""
    return truth_of(scene, Rocks.joined([]), dict.fromkeys(STORED, np.empty(0)))


def joined(scene: Scene, parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the truth of a complete recording, with neighbours, from its parts in order."""
    truth = {name: np.concatenate([part[name] for part in parts]) for name in empty_truth(scene)}
    touch = truth["time"]
    separation = touch + truth["contact_duration"]
    distance = np.append(np.diff(touch), np.nan)[: touch.size]
    earlier = np.append(-np.inf, np.maximum.accumulate(separation))[: touch.size]
    later = np.append(touch[1:], np.inf)[: touch.size]
    truth["next_impact"] = distance
    truth["overlapping"] = ((touch < earlier) | (later < separation)).astype(np.int64)
    return truth


#: A low-passed pulse is cut off this many periods of the edge frequency to either side, where less than 1e-5 of the
#: peak is left (`tests/test_stream.py`).
_FILTER_PERIODS = 64


def add_impacts(plan: Plan, axis: TimeAxis, rocks: Rocks, recorder: Recorder | None) -> dict[str, Floats]:
    """Add impacts of some rocks to the time axis, and return the delivered quantities `STORED`, each (n,)."""
    delivered = {name: np.empty(len(rocks)) for name in STORED}
    if not len(rocks):
        return delivered
    everyone = np.arange(len(rocks))
    for rows, pulses in contacts_of(plan, rocks.columns, everyone):
        indices = rocks.taken(rows)
        if recorder is None:
            _add_forces(plan, axis, pulses, indices["time"])
        else:
            _add_response(plan.scene, axis, recorder, pulses, indices.columns)
        for name in STORED:
            delivered[name][rows] = getattr(pulses, name)
    return delivered


def _is_quick(length: int) -> bool:
    """Return whether a transform of this length is fast: it has no prime factor above `_MAX_FACTOR`."""
    remaining = length
    for factor in (2, *range(3, _MAX_FACTOR + 1, 2)):
        while remaining % factor == 0:
            remaining //= factor
    return remaining == 1


def _add_forces(plan: Plan, axis: TimeAxis, pulses: Impact | ModalImpact, times: Floats) -> None:
    scene, rate, guard = plan.scene, plan.scene.sampling.sampling_rate, lead(plan)
    filtered = plan.runs("bandwidth")
    first = np.floor(times * rate).astype(np.int64) - guard
    width = int(np.ceil(pulses.end_of_contact.max() * rate)) + 2 + 2 * guard
    while filtered and not _is_quick(width):
        width += 1
    windows: NDArray[np.floating] = np.zeros((times.size, width))
    pulses.add_to_frames(windows, rate, (times * rate - first) / rate)
    if filtered:
        windows = scene.sensor.limit_band(windows, rate)
    inside = first < samples_of(scene)
    if inside.any():
        axis.add(first[inside], windows[inside])


def _add_response(
    scene: Scene,
    axis: TimeAxis,
    recorder: Recorder,
    pulses: Impact | ModalImpact,
    columns: Mapping[str, Floats],
) -> None:
    """Run the poles of beam and sensor from the first onset to the end of the last ring-down, or of the recording."""
    rate = scene.sampling.sampling_rate
    first, last = int(np.floor(columns["time"].min() * rate)), samples_of(scene)
    if first >= last:
        return
    # The slowest pole decays to its fraction of the response's tolerance in this time.
    poles = recorder.response.poles
    ringing = float(np.log(poles.size / RESPONSE_TOLERANCE) / -poles.real.max())
    end = columns["time"].max() + pulses.end_of_contact.max() + recorder.response.lengthened + ringing
    stop = int(min(np.ceil(end * rate), last))
    frames = axis.until(stop)[None, first - axis.first :]
    onset = (columns["time"] * rate - first) / rate
    rows = np.zeros(onset.size, np.intp)
    recorder.response.add_to_frames(frames, pulses, onset, recorder.participation(columns), rows=rows)


def lead(plan: Plan) -> int:
    """Return by how many samples an impact may precede its onset, because the low-pass has zero phase."""
    if not plan.runs("bandwidth"):
        return 0
    scene = plan.scene
    assert scene.sensor.bandwidth is not None
    return int(np.ceil(_FILTER_PERIODS * scene.sampling.sampling_rate / scene.sensor.bandwidth))


def hearing_limit(scene: Scene, background: Background | None) -> float:
    """Return the peak force below which noise and background hide an impact and its rock is dropped [N]."""
    # It is 0 for a sensor of motion, whose signal depends not only on the force.
    if scene.sensor.quantity != "force":
        return 0.0
    noise = float(scene.sensor.noise_level(np.zeros(()), scene.sampling.sampling_rate))
    return float(np.sqrt(noise * noise + (0.0 if background is None else background.rms * background.rms)))


def record(
    scene: Scene | str | Path, seed: int = 0, number: int = 0, *, dtype: Literal["float32", "float64"] = "float32"
) -> tuple[Signal, dict[str, NDArray[Any]]]:
    """Return a recording of a stream in memory, and the truth of its impacts.

    Parameters
    ----------
    scene : Scene, str or Path
        With a `stream`.
    seed, number : int
        The same seed and number give the same recording.
    dtype : {"float32", "float64"}
        Of the samples.

    Returns
    -------
    Signal
    dict of ndarray, each (n_impacts,)
        The impacts in order of time: the columns of `cgid.scene.synthesis.stream.impact_units`, label and specimen.

    Raises
    ------
    InvalidValue
        The scene has no stream, or a number breaks its rule.
    """
    scene = load_scene(scene)
    samples, truth = zip(*parts_of_recording(scene, seed, number, dtype=dtype), strict=True)
    signal = Signal(
        samples=np.concatenate(samples),
        sampling_rate=scene.sampling.sampling_rate,
        unit=scene.sensor.unit,
        source=f"{scene.name} {number}",
    )
    return signal, joined(scene, list(truth))


def parts_of_recording(
    scene: Scene, seed: int, number: int, *, dtype: Literal["float32", "float64"]
) -> Iterator[tuple[NDArray[Any], dict[str, NDArray[Any]]]]:
    """Yield the next samples of a recording and the truth of some impacts, perhaps before or after these samples."""
    if scene.stream is None:
        raise InvalidValue(f"scene {scene.name} must have a section stream for recordings; it has none")
    seed, number = require_seed(seed), validation.whole("number of the recording", number, 0, 2**32 - 1)
    recording_plan = plan(scene, "recordings", dtype=dtype)
    background = background_of(scene) if recording_plan.runs("background") else None
    audible, recorder = hearing_limit(scene, background), recorder_of(recording_plan)
    axis, carried, n_rocks, done = TimeAxis(), Rocks.joined([]), 0, 0
    n_samples = samples_of(scene)

    def recorded(chunks: range) -> NDArray[Any]:
        made = [_recorded(recording_plan, background, axis.taken((k + 1) * CHUNK), seed, number, k) for k in chunks]
        return np.concatenate([np.empty(0, dtype), *made])

    arrivals = arrivals_of(scene.stream).stretches(scene.stream.duration, seed, number)
    for stretch in arrivals if recording_plan.runs("arrivals") else ():
        arrived = arriving(scene, stretch, n_rocks, seed, number)
        n_rocks += len(arrived)
        truth = [empty_truth(scene)]
        coming = Rocks.joined([carried, arrived])
        waiting = []
        while len(coming):
            late = coming["time"] >= stretch.stop
            waiting.append(coming.taken(late))
            now = coming.taken(~late)
            delivered = add_impacts(recording_plan, axis, now, recorder)
            truth.append(truth_of(scene, now, delivered))
            if not recording_plan.runs("rebounds"):
                break
            loud = delivered["peak_force"] > audible
            coming = thrown_back(scene, now, delivered["restitution"], delivered["contact_duration"], loud)
        carried = Rocks.joined(waiting)
        # Later impacts, including the low-pass before onset, start after this sample.
        final = min(max(int(stretch.stop * scene.sampling.sampling_rate) - lead(recording_plan), 0), n_samples)
        yield recorded(range(done, final // CHUNK)), _joined_truth(scene, truth)
        done = max(done, final // CHUNK)
    yield recorded(range(done, -(-n_samples // CHUNK)))[: n_samples - done * CHUNK], empty_truth(scene)


def _joined_truth(scene: Scene, parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the impacts of a stretch in order of time, without those after the end of the recording."""
    assert scene.stream is not None
    truth = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((truth["rock"], truth["time"]))
    order = order[truth["time"][order] < scene.stream.duration]
    return {name: column[order] for name, column in truth.items()}


def _recorded(
    plan: Plan, background: Background | None, samples: Floats, seed: int, number: int, chunk: int
) -> NDArray[Any]:
    """Return a chunk as recorded, with the stages after the pulses: noise, background, range and bits."""
    sensor, rate = plan.scene.sensor, plan.scene.sampling.sampling_rate
    if plan.runs("noise"):
        level = sensor.noise_level(np.zeros(1), rate)
        colour = ar_noise_of(plan.scene)
        if colour is None:
            add_noise(samples[None], level, seed, number, first_sample=chunk * CHUNK)
        else:
            samples += level * colour.in_recording(seed, number, chunk)
    if background is not None:
        samples += background.in_recording(seed, number, chunk)
    if plan.runs("offset, range and bits"):
        sensor.digitise(samples[None], rate, np.zeros(1), first=chunk * CHUNK)
    return samples.astype(plan.dtype)
