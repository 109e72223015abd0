"""Entries that the table begins with: a guess, simple statistics by scikit-learn, cgid as it is shipped, cgid trained.

But for `limit`, each sees the folder `signals` alone, as every entrant does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.open.judge import FRAME_COLUMNS, STREAM_COLUMNS, TIMES, WINDOW, Frames, Predictions, Streams, Truth
from benchmarks.open.sets import COAL, GANGUE, LARGEST, PUBLIC_SEED, TRAIN_SEED, all_sets, write_rows
from cgid import shipped
from cgid._lib.files import read_cells
from cgid.errors import InvalidValue
from cgid.identification.model.model import StoredModel, stored
from cgid.identification.prediction import PredictionSettings, identify_frames
from cgid.identification.prediction.stream import identify_blocks
from cgid.identification.prediction.support import CavingWatch
from cgid.identification.training import train_on_specimens
from cgid.identification.training.rows import BEAM_FEATURES, BEAM_GUARDS, Rows, measure
from cgid.learning.streams import finished, rows_of_streams
from cgid.scene import synthesise
from cgid.scene.synthesis.through_beam import full_beam
from cgid.signals import Batch
from studies.ceilings.limit import ceiling

_AT_ONCE = 512


class Part(NamedTuple):
    """A row of `sets.csv`, and the signals (n_signals, n_samples)."""

    name: str
    part: str
    is_stream: bool
    rate: float
    unit: str
    trigger: int
    learn: str
    signals: NDArray[np.float32]


def parts_of(folder: Path, part: str) -> dict[str, Part]:
    (_, header), *lines = read_cells(folder / "sets.csv", "the list of sets", LARGEST)
    rows = [row for _, cells in lines if (row := dict(zip(header, cells, strict=True)))["part"] == part]
    return {
        row["set"]: Part(
            *(row["set"], part, row["kind"] == "stream", float(row["sampling_rate"]), row["unit"]),
            *(int(row["pre_trigger"]), row["learn"], np.load(folder / row["file"], mmap_mode="r")),
        )
        for row in rows
    }


def constant(folder: Path) -> Predictions:
    found: Predictions = {}
    for name, part in parts_of(folder, "test").items():
        n, windows = len(part.signals), (len(part.signals), len(TIMES))
        never = Streams(np.full(windows, 0.5), np.zeros(windows, bool))
        found[name] = never if part.is_stream else Frames(np.full(n, 0.5), np.zeros(n, bool))
    return found


def limit(folder: Path) -> Predictions:
    """Return what whoever knows the populations, laws and noise of a public set of forces can say at best.

    Raises `InvalidValue` for sets of a private seed. Sets of several laws, or behind a filter, have no such formula.
    """
    found: Predictions = {}
    for name, part in parts_of(folder, "test").items():
        one = all_sets()[name]
        seed, scene = PUBLIC_SEED + one.number, one.scene
        if part.is_stream or part.unit != "N" or {rock.label for rock in scene.populations} != {COAL, GANGUE}:
            continue
        if (next(synthesise(scene, 1, seed)).signals[0] != part.signals[0]).any():
            raise InvalidValue(f"{folder}: limit must have the public sets, {name} has another seed; make them anew")
        with suppress(InvalidValue):  # several laws, or a filter: there is no formula
            known = ceiling(scene, len(part.signals), seed)
            probability = known.probabilities[:, known.labels.index(GANGUE)]
            found[name] = Frames(probability, np.zeros(len(probability), bool))
    return found


# -- scikit-learn alone ----------------------------------------------------------------------------------------------


def statistics(folder: Path) -> Predictions:
    """Return a logistic regression of products of simple statistics; of streams, a ridge regression of band levels."""
    from sklearn.linear_model import LogisticRegression, RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    learned: dict[str, Any] = {}
    truth = Truth.read(folder)
    for name, part in parts_of(folder, "train").items():
        if part.is_stream:
            share = np.concatenate([one.shares() for one in truth.streams[name]])
            levels = np.concatenate([_window_levels(signal, part.rate) for signal in part.signals])
            learned[name] = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-2, 4, 13))).fit(levels, share)
        else:
            steps = StandardScaler(), PolynomialFeatures(2), StandardScaler(), LogisticRegression(max_iter=3000)
            learned[name] = make_pipeline(*steps).fit(_simple(part), truth.frames[name] == GANGUE)
    found: Predictions = {}
    for name, part in parts_of(folder, "test").items():
        model = learned[part.learn]
        if part.is_stream:
            share = np.array([model.predict(_window_levels(signal, part.rate)) for signal in part.signals]).clip(0, 1)
            found[name] = Streams(share, share > 0.5)
        else:
            probability = model.predict_proba(_simple(part))[:, 1]
            found[name] = Frames(probability, np.zeros(len(probability), bool))
    return found


def _simple(part: Part) -> NDArray[np.float64]:
    samples = part.signals - part.signals[:, : part.trigger // 2].mean(axis=1, keepdims=True)
    peak, scale = np.abs(samples).max(axis=1), samples.std(axis=1)
    width = (np.abs(samples) > peak[:, None] / 2).sum(axis=1) / part.rate
    skewness = ((samples / scale[:, None]) ** 3).mean(axis=1)
    columns = [*np.log([peak, scale, width]), skewness, *_octaves(samples, part.rate).T]
    return np.asarray(np.nan_to_num(np.stack(columns, axis=1), posinf=0.0, neginf=0.0))


def _octaves(samples: NDArray[Any], rate: float) -> NDArray[np.float64]:
    power = np.abs(np.fft.rfft(samples, axis=1)) ** 2
    edges = np.searchsorted(np.fft.rfftfreq(samples.shape[1], 1 / rate), 200.0 * 2.0 ** np.arange(7))
    octaves = [power[:, first : last + 1].sum(axis=1) for first, last in pairwise(edges)]
    return np.asarray(np.log(np.stack(octaves, axis=1)))


def _window_levels(signal: NDArray[Any], rate: float) -> NDArray[np.float64]:
    length = round(0.02 * rate)
    levels = _octaves(np.reshape(signal[: signal.size // length * length], (-1, length)), rate)
    windows = [levels[round(50 * (time - WINDOW)) : round(50 * time)] for time in TIMES]
    return np.array([np.append(window.mean(axis=0), window.std(axis=0)) for window in windows])


# -- cgid ------------------------------------------------------------------------------------------------------------


def defaults(folder: Path) -> Predictions:
    names = {"N": shipped.DEFAULT_MODEL, "m/s^2": shipped.ACCELERATION_MODEL}
    models = {unit: StoredModel.load(shipped.path_of("models", name)) for unit, name in names.items()}
    return {name: _answered(models[part.unit], part) for name, part in parts_of(folder, "test").items()}


def trained(folder: Path) -> Predictions:
    """Return the answers of models trained on the training parts alone.

    Behind the beam it is one model for frames and streams. It knows the beam of `tail_beam`, as `sets.toml` does.
    """
    parts, labels = parts_of(folder, "train"), Truth.read(folder).frames
    streams = all_sets()["caving-constant"]
    models = {
        name: stored(train_on_specimens(_batches(parts[name], labels[name])).model) for name in ("reference", "peers")
    }
    beam, names = full_beam(streams.scene), (*BEAM_FEATURES, *BEAM_GUARDS)
    seed, n = TRAIN_SEED + streams.number, len(parts[streams.name].signals)
    # The very streams of the training part: the same scenes, seed and numbers.
    heard = rows_of_streams([streams.stream(seed, number)[0] for number in range(n)], seed, names, beam)
    frames = measure(_batches(parts["tail_beam"], labels["tail_beam"]), names, beam=beam)
    rows = Rows.joined([frames, *(one.rows for one in heard[: n // 2])])
    model = stored(train_on_specimens(rows, features=BEAM_FEATURES, guards=BEAM_GUARDS).model)
    models["tail_beam"] = models[streams.name] = finished(model, heard[n // 2 :])
    return {name: _answered(models[part.learn], part) for name, part in parts_of(folder, "test").items()}


def _batches(part: Part, labels: NDArray[np.str_]) -> Iterator[Batch]:
    for first in range(0, len(labels), _AT_ONCE):
        own = slice(first, first + _AT_ONCE)
        signals = np.array(part.signals[own])
        numbers = np.arange(first, first + len(signals), dtype=np.uint64)
        known: dict[str, Any] = {"sampling_rate": part.rate, "pre_trigger": part.trigger, "source": part.name}
        yield Batch(signals=signals, labels=labels[own], specimen=numbers, unit=part.unit, **known)


def _answered(model: StoredModel, part: Part) -> Frames | Streams:
    if part.is_stream:
        return Streams(*map(np.array, zip(*(_watched(model, one, part.rate) for one in part.signals), strict=True)))
    probabilities, unknown = [], []
    for first in range(0, len(part.signals), _AT_ONCE):
        frames = np.array(part.signals[first : first + _AT_ONCE])
        for answer in identify_frames(frames, part.rate, model, pre_trigger=part.trigger):
            probabilities.append(answer.probabilities.get(GANGUE, 0.5))
            unknown.append(answer.label == "unknown")
    return Frames(np.array(probabilities), np.array(unknown))


def _watched(model: StoredModel, signal: NDArray[Any], rate: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    question = PredictionSettings(share_time=float(WINDOW), share_step=1.0)
    steps = identify_blocks([np.array(signal)[None]], rate, model, ("1",), question)
    watch = CavingWatch(model, ("1",), question)
    said = watch.feed([answer for step in steps for answer in step.answers], float(TIMES[-1]))
    share, shut = np.full(TIMES[-1] + 1, 0.5), np.zeros(TIMES[-1] + 1, bool)
    for one in said:
        if one.switch is not None:
            shut[round(one.switch.time) :] = one.switch.shut
        elif one.kind == "share" and one.state.share.n_impacts:
            share[round(one.state.time)] = one.state.share.share
    return share[TIMES], shut[TIMES]


#: What `answer` makes: name in the table, and what predicts.
ENTRIES: dict[str, tuple[str, Callable[[Path], Predictions]]] = {
    "constant": ("one half", constant),
    "statistics": ("scikit-learn, simple statistics", statistics),
    "defaults": ("cgid, models as shipped", defaults),
    "trained": ("cgid, trained on each set", trained),
    "limit": ("limit, who knows the scene", limit),
}


def write_predictions(predictions: Predictions, folder: Path, name: str) -> list[Path]:
    """Write the predictions of frames and of streams, and return the paths of the files."""
    frames: list[tuple[Any, ...]] = []
    streams: list[tuple[Any, ...]] = []
    for of, one in predictions.items():
        if isinstance(one, Frames):
            for k, (gangue, unknown) in enumerate(zip(one.gangue.round(5).tolist(), one.unknown.tolist(), strict=True)):
                frames.append((of, k, f"{1 - gangue:.5f}", f"{gangue:.5f}", int(unknown)))
        else:
            for (k, at), share in np.ndenumerate(one.share):
                streams.append((of, k, int(TIMES[at]), f"{share:.4f}", int(one.shut[k, at])))
    paths = []
    for kind, columns, rows in (("frames", FRAME_COLUMNS, frames), ("streams", STREAM_COLUMNS, streams)):
        if rows:
            paths.append(folder / f"{name}-{kind}.csv")
            write_rows(paths[-1], columns, rows)
    return paths
