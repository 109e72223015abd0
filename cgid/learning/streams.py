"""Simulated streams of a scene: rows of detected impacts, and the predictions of a model for their rocks.

In a
stream an impact overlaps with others or their ring-down, and most rocks bounce. So a model of acceleration also trains
on streams (`rows_of_streams`), and others (`finished`) determine its novelty limit and its confusion of rocks.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from threadpoolctl import threadpool_limits

from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers
from cgid.errors import InvalidValue
from cgid.identification.detection.detector import find_impacts
from cgid.identification.detection.events import Event, frames_alike
from cgid.identification.model.confusion import Confusion, StreamAnswers, logit
from cgid.identification.model.model import StoredModel, stored
from cgid.identification.training.rows import BEAM_FEATURES, BEAM_GUARDS, Rows, through
from cgid.identification.training.training import MIN_LIMITS, Training, train_on_specimens
from cgid.measure.features.extraction import extract_array
from cgid.measure.modal.beam import Beam
from cgid.scene.file.schema import Scene, parse_scene
from cgid.scene.file.sections import rows_of
from cgid.scene.synthesis.stream import record
from cgid.scene.synthesis.through_beam import full_beam, has_beam, spread_over

#: Length of a simulated stream [s].
DURATION = 60.0
#: Range of log-uniform factors of the scene's rate of rocks and density of noise; the latter only in every other stream
#: (assumed).
_RATES, _NOISES = (0.5, 1.5), (0.3, 10.0)
#: A detected impact belongs to the strongest impact with an onset from this long before to this long after it [s].
_BEFORE, _AFTER = 4e-3, 1.5e-3
#: Approximate number of detected impacts per rock; minimum number of streams for training and for finishing.
_IMPACTS_A_ROCK, _MIN_STREAMS = 1.6, 8
#: Fraction of the impacts in its own streams that the last guard of a model rejects.
UNKNOWN_SHARE = 0.035


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamRows:
    """The measured impacts of a simulated stream."""

    rows: Rows  # only measurable ones that belong to an impact
    n_detected: int  # number of detected impacts
    n_rocks: tuple[int, int]  # rocks of each of the two labels, in alphabetical order
    fraction: float  # of the second label among the rocks that may come


def labels_of(scene: Scene) -> tuple[str, ...]:
    """Return the labels of the rocks of a scene in alphabetical order."""
    return tuple(sorted({population.label for population in scene.populations}))


def is_streamable(scene: Scene) -> bool:
    """Return whether a model can be finished on streams of a scene, which needs a stream, a beam and two labels."""
    return scene.stream is not None and has_beam(scene) and len(labels_of(scene)) == 2


def variations(
    scene: Scene,
    n_streams: int,
    seed: int,
    *,
    rates: tuple[float, float] = _RATES,
    loudness: Sequence[float] = (),
) -> list[Scene]:
    """Return variations of the stream of a scene, each with a constant mixture, other rates, locations and noise.

    `loudness` are factors of all noise but hum, taken in turn in place of those of every other stream.
    """
    # Fractions of the second label fill 0 to 1 evenly. Uncertain modes are sampled for each stream.
    if scene.stream is None or len(labels_of(scene)) != 2:
        raise InvalidValue(
            f"scene {scene.name}: must have a [stream] and rocks of two labels to train on streams, got "
            f"{', '.join(labels_of(scene))}"
        )
    rng = np.random.default_rng([seed, n_streams])
    fractions = rng.permutation((np.arange(n_streams) + rng.random(n_streams)) / n_streams)
    louder = [loudness[number % len(loudness)] if loudness else None for number in range(n_streams)]
    return [
        _variation(scene, number, float(fraction), rng, rates, louder[number])
        for number, fraction in enumerate(fractions)
    ]


def _variation(
    scene: Scene,
    number: int,
    fraction: float,
    rng: np.random.Generator,
    rates: tuple[float, float],
    louder: float | None,
) -> Scene:
    content = json.loads(scene.text)
    stream, sensor = content["stream"], content["sensor"]
    stream["duration"] = DURATION
    stream["arrivals"] = {"rate": _rate_of(scene) * _factor(rng, rates)}
    stream["mixture"] = {"times": [0.0], labels_of(scene)[1]: [fraction]}
    factor = _factor(rng, _NOISES)
    if louder is not None:
        sensor["noise_density"] = louder * (sensor.get("noise_density") or 0.0)
        coloured = None if scene.background is None else scene.background.coloured
        if coloured is not None:
            density = np.sqrt(coloured.densities(scene.sensor.quantity))
            content["background"]["coloured"]["density"] = (louder * density).tolist()
    elif number % 4 >= 2 and sensor.get("noise_density"):
        sensor["noise_density"] *= factor
    if number % 2 == 1:
        spread_over(content["tail_beam"])
    learned = None if scene.tail_beam is None else scene.tail_beam.learned_modes
    if learned is not None and learned.deviation is not None:
        modes = learned.sampled(ndtri(rng.uniform(2.0**-54, 1, learned.deviation.shape)))
        content["tail_beam"]["learned"] = rows_of(modes)
    return parse_scene(content | {"name": f"{scene.name}, stream {number}"})


def _rate_of(scene: Scene) -> float:
    """Return the mean number of rocks per second [Hz]."""
    assert scene.stream is not None
    arrivals = scene.stream.arrivals
    if arrivals.rate is None:
        return len(arrivals.times or ()) / scene.stream.duration
    return float(np.mean(arrivals.rate.values))


def _factor(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))


def rows_of_streams(
    scenes: Sequence[Scene],
    seed: int,
    names: tuple[str, ...],
    beam: Beam,
    *,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> list[StreamRows]:
    """Simulate streams, such as `variations`, and measure features and guards of the detected impacts."""
    return workers.all(_measured, (seed, names, beam), enumerate(scenes), progress)


def _measured(settings: tuple[int, tuple[str, ...], Beam], numbered: tuple[int, Scene]) -> StreamRows:
    """Return the measured impacts of one stream."""
    (seed, names, beam), (number, scene) = settings, numbered
    signal, truth = record(scene, seed, number)
    events = find_impacts(signal, kind="vibration")
    with threadpool_limits(1):
        features = detected_features(events, names, beam)
    time = np.array([event.time for event in events])
    impact = impact_of(time, truth["time"], truth["peak_force"])
    is_known = np.isfinite(features).all(axis=1) & (impact >= 0) & np.array([not event.problem for event in events])
    first = truth["bounce"] == 0
    labels = labels_of(scene)
    counts = [int(np.sum(truth["label"][first] == label)) for label in labels]
    rows = Rows(
        names=names,
        features=features[is_known],
        labels=truth["label"][impact[is_known]].astype(str),
        group=truth["specimen"][impact[is_known]],
        source=np.zeros(int(is_known.sum()), np.intp),
        sources=(scene.sha256,),
        digests=(scene.sha256,),
        unit=str(signal.unit),
        sampling_rates=(signal.sampling_rate, signal.sampling_rate),
        time=time[is_known],
        beam=beam,
        left_out=int((~is_known).sum()),
    )
    fraction = _share_of(scene, labels[1])
    return StreamRows(rows=rows, n_detected=len(events), n_rocks=(counts[0], counts[1]), fraction=fraction)


def _share_of(scene: Scene, label: str) -> float:
    """Return the mean fraction of a label in the mixture of a stream."""
    assert scene.stream is not None and scene.stream.mixture is not None
    return float(np.mean(scene.stream.mixture.shares[label]))


def detected_features(events: Sequence[Event], names: tuple[str, ...], beam: Beam) -> Floats:
    """Return the features of detected impacts, (n, n_names); nan if one cannot be measured."""
    features = np.full((len(events), len(names)), np.nan)
    for numbers, frames in frames_alike(events):
        event = events[numbers[0]]
        features[numbers] = extract_array(
            frames,
            event.sampling_rate,
            names,
            pre_trigger=event.pre_trigger,
            invalid="nan",
            detection_limit=event.detection_limit,
            beam=through(beam),
        )
    return features


def impact_of(detected: Floats, onset: Floats, peak: Floats) -> NDArray[np.intp]:
    """Return the number of the true impact of each detected one, -1 for none, (n,)."""
    first, last = np.searchsorted(onset, detected - _BEFORE), np.searchsorted(onset, detected + _AFTER)
    numbers = [a + int(np.argmax(peak[a:b])) if b > a else -1 for a, b in zip(first, last, strict=True)]
    return np.array(numbers, np.intp)


def numbers_of_streams(scene: Scene, n_impacts: int) -> tuple[int, int]:
    """Return how many streams of a scene contain about `n_impacts` for training, and how many finish the model."""
    each = _IMPACTS_A_ROCK * _rate_of(scene) * DURATION
    n_streams = max(math.ceil(n_impacts / each), _MIN_STREAMS)
    return n_streams, max(n_streams // 3, _MIN_STREAMS)


def train_on_streams(
    scene: Scene,
    n_impacts: int,
    seed: int = 0,
    *,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
    **settings: Any,
) -> Training:
    """Train a model on about `n_impacts` from simulated streams of a scene, test it, and finish it on other streams."""
    n_streams, n_further = numbers_of_streams(scene, n_impacts)
    beam, names = full_beam(scene), (*BEAM_FEATURES, *BEAM_GUARDS)
    scenes = variations(scene, n_streams, seed)
    streams = rows_of_streams(scenes, seed, names, beam, progress=progress, workers=workers)
    rows = Rows.joined([stream.rows for stream in streams])
    training = train_on_specimens(
        rows, features=BEAM_FEATURES, guards=BEAM_GUARDS, seed=seed, workers=workers, **settings
    )
    further = variations(scene, n_further, seed + 1)
    others = rows_of_streams(further, seed + 1, names, beam, progress=progress, workers=workers)
    model = finished(stored(training.model), others)
    return replace(training, model=model)


def finished(model: StoredModel, streams: Sequence[StreamRows]) -> StoredModel:
    """Return a model with the confusion of rocks estimated in streams that did not train it."""
    rows = Rows.joined([stream.rows for stream in streams])
    n_detected = sum(stream.n_detected for stream in streams)
    left = max(1 - UNKNOWN_SHARE * n_detected / len(rows.labels), 0.0)
    # Tighter than in the training, whose streams vary widely: impacts on another beam must be unknown, too.
    last = model.guards[-1]
    limit = max(float(np.quantile(rows.columns((last,)), left)), MIN_LIMITS.get(last, 0.0))
    model = replace(model, guard_limits=(*model.guard_limits[:-1], limit))
    answered = [_answered(model, stream) for stream in streams]
    confusion = Confusion.of_streams(answered)
    if confusion is None:
        return model
    unknown = 1 - sum(int(np.isfinite(one.logits).sum()) for one in answered) / n_detected
    summary = {
        "n_streams": len(streams),
        "n_found": n_detected,
        "unknown_share": unknown,
        "answers_a_rock": dict(zip(model.labels, confusion.rates.sum(axis=1).tolist(), strict=True)),
        "overdispersion": confusion.overdispersion,
        "scatter": confusion.scatter,
    }
    return replace(model, arrays={**model.arrays, **confusion.arrays}, training={**model.training, "streams": summary})


def _answered(model: StoredModel, stream: StreamRows) -> StreamAnswers:
    """Return the predictions of a model for a stream."""
    rows = stream.rows
    inputs = rows.columns(model.features)
    logits = logit(model.probabilities(inputs)[:, 1])
    logits[model.novelty(inputs, rows.columns(model.guards)) > 1] = np.nan
    return StreamAnswers(
        logits=logits,
        second=np.asarray(rows.labels == model.labels[1]),
        time=rows.time,
        n_rocks=stream.n_rocks,
        share=stream.fraction,
    )
