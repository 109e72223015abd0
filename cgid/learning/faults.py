"""Simulated recordings, sound and spoilt, from which a model learns to explain what is not as in its training.

Samples are spoilt, and then heard and measured as those of a user. The beam's sound recordings are of any seam, as its
fraction of gangue; those of forces are of the scenes and rigs of the training.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, sosfilt
from sklearn.covariance import ledoit_wolf
from threadpoolctl import threadpool_limits

from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers
from cgid.errors import InvalidValue
from cgid.identification.model.explanations import (
    BINS,
    FLOOR,
    LEAST_CHANGED,
    MOST_OF_PAST,
    Explanations,
    Fault,
    Impacts,
    candidates_of,
    detrended,
    difference,
    kinds_of,
    reference,
    summary,
)
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks
from cgid.learning.prior import seam_numbers
from cgid.learning.streams import impact_of, labels_of
from cgid.scene.file.schema import Scene, parse_scene
from cgid.scene.synthesis.stream import record
from cgid.scene.synthesis.through_beam import spread_over
from cgid.units import number_and_unit

#: Recordings from which a model learns at most and at least, and impacts of its training for each.
N_RECORDINGS, LEAST_RECORDINGS, IMPACTS_EACH = 64, 24, 800
#: Rocks of a stream, and the range of their rate [Hz] (assumed: from a trickle to a full window).
_N_ROCKS = 220
_SLOWEST = 3.0
_BUSIEST = 16.0
#: So many streams have the noise of the scene, the others up to this many times it (assumed).
_QUIET_SHARE = 0.4
_LOUDEST = 10.0
#: Last part of a stream that is spoilt in each way: enough for the most impacts that count, and no rock of the first.
_SPOILT_PART = 0.55
#: Thickness of other beams over the model's, at least this far from it, and what counts as the same.
_THICKNESS = (0.6, 1.6)
_SAME_BEAM = 0.05
#: Ranges of the strengths of faults, log-uniform, assumed: fraction of the impacts that clip; noise over the largest
#: sample of a force and of a vibration; resonance [Hz] and its damping; corner of a filter [Hz] on a force and on a
#: vibration; stated over true rate.
_CLIPPED = (0.05, 0.9)
_NOISE_OF_FORCE = (0.015, 0.2)
_NOISE_OF_BEAM = (0.003, 0.05)
_RING = (3e3, 15e3)
_RING_DAMPING = (0.01, 0.08)
_CORNER_OF_FORCE = (0.8e3, 3.5e3)
_CORNER_OF_BEAM = (1e3, 9e3)
_RATES = (1 / 3, 5.0)
#: Half of the rates are within this factor of the true one.
_NEAR = 1.5
#: Highest frequency of a resonance or corner over the sampling rate.
_HIGHEST = 0.42
#: Orders of filters: from a loose mount to a recorder's.
_ORDERS = (2, 4, 6)
#: Blocks whose largest samples stand for peaks [s], and the least of them over the largest.
_BLOCK_TIME = 20e-3
_LEAST_PEAK = 0.02
#: What samples are spoilt by.
SPOILT = (Fault.UPSIDE_DOWN, Fault.CLIPPED, Fault.NOISE, Fault.RINGING, Fault.LOW_PASS)


class Recording(NamedTuple):
    """The impacts of one simulated recording, whether each is of gangue, and what is wrong with it, if anything.

    `at_home` is of forces on the rig of their scene.
    """

    impacts: Impacts
    gangue: NDArray[np.bool_]
    fault: Fault | None
    factor: float
    at_home: bool = False


def any_seam(scene: Scene, seed: int, number: int) -> Scene:
    """Return a stream of a scene in a seam that is drawn as those of the fraction, half of its rocks of gangue."""
    rng = np.random.default_rng([seed, number, 74])
    own = seam_numbers(1, rng)
    content = json.loads(scene.text)
    stream, rate = content["stream"], _log_uniform(rng, _SLOWEST, _BUSIEST)
    stream |= {"duration": _N_ROCKS / rate, "arrivals": {"rate": rate}}
    stream["mixture"] = {"times": [0.0], labels_of(scene)[1]: [0.5]}
    noise, background = (1.0 if rng.random() < _QUIET_SHARE else _log_uniform(rng, 1, _LOUDEST) for _ in range(2))
    content["sensor"]["noise_density"] = noise * (content["sensor"].get("noise_density") or 0.0)
    for tone in content.get("background", {}).get("hum", ()):
        tone["amplitude"] = _times(tone["amplitude"], background)
    if coloured := content.get("background", {}).get("coloured"):
        coloured["density"] = [_times(density, background) for density in coloured["density"]]
    if number % 2 == 1:
        spread_over(content["tail_beam"])
    content["populations"] = [
        {
            "label": label,
            "density": {"distribution": "normal", "mean": float(own.densities[k][0]), "deviation": 70.0},
            "youngs_modulus": {
                "distribution": "lognormal",
                "median": float(own.moduli[k][0]),
                "sigma": float(own.spreads[k][0]),
            },
            "poisson_ratio": {"distribution": "uniform", "lowest": 0.2, "highest": 0.34},
            "radius": {
                "distribution": "log-uniform",
                "lowest": float(own.largest[k][0] / own.ratios[k][0]),
                "highest": float(own.largest[k][0]),
            },
            "restitution": {
                "distribution": "truncated-normal",
                "mean": float(own.restitutions[k][0]),
                "deviation": 0.09,
                "lowest": 0.1,
                "highest": 0.88,
            },
            "drop_height": {
                "distribution": "uniform",
                "lowest": float(own.lowest_fall[0]),
                "highest": float(own.highest_fall[0]),
            },
        }
        for k, label in enumerate(labels_of(scene))
    ]
    return parse_scene(content | {"name": f"{scene.name}, any seam {number}"})


def _times(value: float | str, factor: float) -> float | str:
    """Return a number, or one with its unit, times a factor."""
    number = number_and_unit(value) if isinstance(value, str) else None
    return f"{number[0] * factor!r} {number[1]}" if number else float(value) * factor


def number_of_recordings(n_impacts: int) -> int:
    """Return from how many recordings a training on so many impacts learns; none if they do not tell what is rare."""
    n = min(n_impacts // IMPACTS_EACH, N_RECORDINGS)
    return 0 if n < LEAST_RECORDINGS else n


def explained(
    model: StoredModel,
    scene: Scene,
    n_recordings: int,
    seed: int,
    *,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> StoredModel:
    """Return a model of the streams of a scene that explains recordings; the model itself if it learns from none.

    Without gangue among its labels it stays as it is: the seams have coal and gangue.
    """
    if not n_recordings or "gangue" not in model.labels or model.beam is None:
        return model
    return with_faults(model, of_seams(scene, model, n_recordings, seed, progress, workers), seed)


def of_seams(
    scene: Scene,
    model: StoredModel,
    n_recordings: int,
    seed: int,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> list[list[Recording]]:
    """Return sound streams of any seam, and the same spoilt in each way."""
    return workers.all(of_seam, (seed, model, scene), range(n_recordings), progress)


def of_seam(settings: tuple[int, StoredModel, Scene], number: int) -> list[Recording]:
    """Return a sound stream of a seam, and the same spoilt in each way."""
    (seed, model, scene), rng = settings, np.random.default_rng([settings[0], number, 75])
    own = any_seam(scene, seed, number)
    made = [_of_stream(own, model, seed, number, rng, None)]
    made += [_of_stream(own, model, seed, number, rng, fault) for fault in (*SPOILT, Fault.RATE)]
    content, thickness = json.loads(own.text), 1.0
    while abs(thickness - 1) < _SAME_BEAM:
        thickness = _log_uniform(rng, *_THICKNESS)
    beam = content["tail_beam"]
    beam.pop("learned", None)  # of this beam alone
    if modes := beam.get("modes"):
        beam["modes"] = [mode | {"frequency": thickness * mode["frequency"]} for mode in modes]
    else:
        beam["thickness"] *= thickness
    content["stream"]["duration"] *= _SPOILT_PART
    other = parse_scene(content | {"name": f"{own.name}, another beam"})
    return [*made, _of_stream(other, model, seed, number, rng, Fault.BEAM)]


def _of_stream(
    scene: Scene, model: StoredModel, seed: int, number: int, rng: np.random.Generator, fault: Fault | None
) -> Recording:
    signal, truth = record(scene, seed, number)
    samples, rate, factor = signal.samples.ravel(), signal.sampling_rate, 1.0
    if fault not in (None, Fault.BEAM):
        length = round(_SPOILT_PART * samples.size)
        begin = samples.size - length
        samples, rate, factor = spoilt(samples[begin:], rate, fault, rng, is_force=False)
        truth = {name: column[truth["time"] >= begin / signal.sampling_rate] for name, column in truth.items()}
        truth["time"] = (truth["time"] - begin / signal.sampling_rate) / factor
    answers = answers_of(samples, rate, model)
    own = impact_of(np.array([answer.time for answer in answers]), truth["time"], truth["peak_force"])
    gangue = np.where(own >= 0, truth["label"][own] == labels_of(scene)[1], rng.random(len(own)) < 0.5)
    return Recording(Impacts.of(answers, model), gangue[counted(answers)], fault, factor)


def answers_of(samples: Floats, sampling_rate: float, model: StoredModel) -> list[Answer]:
    """Return the answers for a recording of one channel, found as those of a user; none where it is refused."""
    block, settings = samples[None].astype(np.float32), PredictionSettings()
    try:
        with threadpool_limits(1):
            steps = list(identify_blocks([block], sampling_rate, model, ["1"], settings))
    except InvalidValue:  # such a rate is none for this model
        return []
    return [answer for step in steps for answer in step.answers]


def counted(answers: list[Answer]) -> NDArray[np.bool_]:
    """Return which answers `Impacts.of` takes."""
    return np.array([answer.sampled is not None and not answer.cut for answer in answers], bool)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def spoilt(
    samples: Floats, rate: float, fault: Fault | None, rng: np.random.Generator, *, is_force: bool
) -> tuple[Floats, float, float]:
    """Return samples with a fault of random strength, the rate that is stated, and its factor."""
    x = samples.astype(np.float64)
    largest = float(np.abs(x).max())
    match fault:
        case Fault.UPSIDE_DOWN:
            x = -x
        case Fault.CLIPPED:
            block = max(round(_BLOCK_TIME * rate), 1)
            peaks = np.abs(x[: x.size // block * block]).reshape(-1, block).max(axis=1)
            limit = np.quantile(peaks[peaks > _LEAST_PEAK * largest], 1 - _log_uniform(rng, *_CLIPPED))
            x = np.clip(x, -limit, limit)
        case Fault.NOISE:
            x = x + rng.standard_normal(x.size) * largest * _log_uniform(
                rng, *(_NOISE_OF_FORCE if is_force else _NOISE_OF_BEAM)
            )
        case Fault.RINGING:
            w = 2 * np.pi * _log_uniform(rng, _RING[0], min(_RING[1], _HIGHEST * rate)) / rate
            r = np.exp(-_log_uniform(rng, *_RING_DAMPING) * w)
            x = lfilter([1 - 2 * r * np.cos(w) + r * r], [1, -2 * r * np.cos(w), r * r], x)
        case Fault.LOW_PASS:
            low, high = _CORNER_OF_FORCE if is_force else _CORNER_OF_BEAM
            corner = _log_uniform(rng, low, min(high, _HIGHEST * rate))
            x = sosfilt(butter(int(rng.choice(_ORDERS)), corner, fs=rate, output="sos"), x)
        case Fault.RATE:
            near = rng.random() < 0.5
            factor = _log_uniform(rng, *((1 / _NEAR, _NEAR) if near else _RATES))
            return x, rate * factor, factor
        case _:
            pass
    return x, rate, 1.0


# -- densities ---------------------------------------------------------------------------------------------

#: Windows of each recording in each bin of impacts, of sound and of spoilt ones.
_SOUND_WINDOWS = 3
_WINDOWS = 2
#: So many windows have the fraction of gangue of the begin of a cycle; the others any (assumed).
_COAL_SHARE = 0.25
_COAL_FRACTION = 0.05
#: Standard deviation of the logarithm of a channel's noise by itself: the background may change by half (a choice;
#: with 0.1 a gain of 2 is told as often as a background that doubles, by a trial on 36 simulated seams).
_STEADY = 0.4
#: Fewest impacts of a window.
_FEWEST = 3
#: Fewest windows of a density; those of the next bin stand for fewer.
_LEAST_WINDOWS = 12
#: Smallest standard deviation of a number of a summary.
_LEAST_SPREAD = 0.02
#: The density of all faults together is so many times as wide (by eye).
_WIDER = 1.5
#: Parts of the recordings that are judged by the others in turn.
_FOLDS = 5
#: Windows of sound recordings that each explanation may be told in, and the least log odds (by eye: 20 to 1).
_FALSE_RATE = 0.002
_LEAST_ODDS = 3.0
#: Rise over the standard deviation of the noise: some 4 is the largest of the samples of a frame of noise alone.
_LEAST_RISE = 8.0
#: Sound recordings of which any window may be told something: beyond the limits of windows, since those of one rig are
#: alike and a recording is looked at often.
_FALSE_RECORDINGS = 0.01


class Window(NamedTuple):
    """Some impacts of a recording, and their summary, or their difference from a past of the same channel."""

    recording: int
    fault: Fault | None
    at_home: bool
    in_bin: int
    impacts: Impacts
    past: Floats | None
    summary: Floats


def with_faults(model: StoredModel, recordings: Iterable[Sequence[Recording]], seed: int) -> StoredModel:
    """Return a model that explains recordings, from simulated ones, sound and spoilt; nothing else changes."""
    # A beam's streams have the noises that its fraction knows.
    is_beam = model.beam is not None
    made, spectrum = [parts for parts in recordings if is_beam or stands_out(parts[0])], np.zeros(1)
    arrays: dict[str, NDArray[Any]] = {}
    if is_beam:
        sound = [detrended(one.impacts.spectra) for parts in made for one in parts if one.fault is None]
        spectrum = np.nan_to_num(np.mean(sound, axis=0))
    fold = np.random.default_rng([seed, 78]).permutation(len(made)) % _FOLDS
    for prefix in Explanations.PREFIXES:
        of_past = prefix != Explanations.PREFIXES[0]
        windows = list(windows_of(model, made, spectrum, np.random.default_rng([seed, 77]), of_past=of_past))
        odds: list[list[Floats]] = [[] for _ in BINS]
        judged: list[tuple[int, int, Floats]] = []
        with threadpool_limits(1):
            for k in range(_FOLDS):
                rest = fitted(model, [one for one in windows if fold[one.recording] != k], spectrum)
                for one in windows:
                    if fold[one.recording] == k and one.fault is None:
                        judged.append((one.recording, one.in_bin, rest.odds(one.impacts, model, one.past)[0]))
                        odds[one.in_bin].append(judged[-1][2])
            known = fitted(model, windows, spectrum)
        filled = next(found for found in odds if found)  # changes are told from more impacts on
        limits = np.array([np.quantile(found or filled, 1 - _FALSE_RATE, axis=0) for found in odds]).T
        limits = np.maximum(limits, _LEAST_ODDS)
        excess = np.full((len(made), len(limits)), -np.inf)
        for recording, in_bin, own in judged:
            excess[recording] = np.maximum(excess[recording], own - limits[:, in_bin])
        limits += _lifts(excess)[:, None]
        arrays |= replace(known, limits=limits).arrays(prefix)
    told = {"n_recordings": len(made), "false_rate": _FALSE_RATE, "false_recordings": _FALSE_RECORDINGS}
    return replace(model, arrays={**model.arrays, **arrays}, training={**model.training, "faults": told})


def stands_out(sound: Recording) -> bool:
    """Return whether half of the impacts of a sound recording stand out of its noise; else noise was found in it."""
    high, _, baseline, noise = sound.impacts.sampled[:, :4].T
    return bool(np.median((high - baseline) / np.maximum(noise, np.finfo(np.float32).tiny)) >= _LEAST_RISE)


def _lifts(excess: Floats) -> Floats:
    """Return by how much each limit rises, (n_candidates,), so that few sound recordings exceed any.

    `excess` (n_recordings, n_candidates) is the largest of each. The least odd of those that are told something goes
    first, and lifts the limits that it exceeds alone: one odd recording must not silence every fault.
    """
    lifts = np.zeros(excess.shape[1])
    while len(told := np.flatnonzero((excess > lifts).any(axis=1))) > _FALSE_RECORDINGS * len(excess):
        least = told[np.argmin((excess[told] - lifts).max(axis=1))]
        lifts = np.maximum(lifts, excess[least])
    return lifts


def windows_of(
    model: StoredModel,
    recordings: Sequence[Sequence[Recording]],
    spectrum: Floats,
    rng: np.random.Generator,
    *,
    of_past: bool = False,
) -> Iterator[Window]:
    """Yield windows of recordings, of all lengths and fractions; or their difference from earlier sound impacts."""
    for number, parts in enumerate(recordings):
        for one in parts:
            for in_bin, most in enumerate(BINS):
                least = max(BINS[in_bin - 1] + 1 if in_bin else 0, LEAST_CHANGED if of_past else _FEWEST)
                if most < least:
                    continue
                for _ in range(_WINDOWS if one.fault else _SOUND_WINDOWS):
                    begin = int((1 - _SPOILT_PART) * one.gangue.size) if of_past and one.fault is None else 0
                    chosen = begin + _chosen(one.gangue[begin:], int(rng.integers(least, most + 1)), rng)
                    if len(chosen) < least:
                        continue
                    impacts, past = one.impacts.at(chosen), None
                    if of_past:
                        first = parts[0].gangue[: int((1 - _SPOILT_PART) * parts[0].gangue.size)]
                        past = reference(parts[0].impacts.at(_chosen(first, MOST_OF_PAST, rng)), model)
                        past[FLOOR - impacts.spectra.shape[1]] += _STEADY * rng.standard_normal()
                        found = difference(impacts, model, past, np.zeros((1, 3)))[0]
                    else:
                        found = summary(impacts, model, spectrum, np.zeros((1, 3)))[0]
                    yield Window(number, one.fault, one.at_home, in_bin, impacts, past, found)


def _chosen(gangue: NDArray[np.bool_], n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return up to n impacts in order, a random fraction of them of gangue."""
    fraction = _COAL_FRACTION if rng.random() < _COAL_SHARE else rng.random()
    n_gangue = rng.binomial(min(n, gangue.size), fraction)
    parts = [rng.permutation(np.flatnonzero(gangue == one)) for one in (True, False)]
    return np.sort(np.concatenate([parts[0][:n_gangue], parts[1][: max(n - n_gangue, 0)]]))


def fitted(model: StoredModel, windows: Sequence[Window], spectrum: Floats) -> Explanations:
    """Return the densities of windows, without limits."""
    sound = np.array([one.summary for one in windows if one.fault is None])
    centre, scale = np.nanmean(sound, axis=0), np.maximum(np.nanstd(sound, axis=0), _LEAST_SPREAD)
    assert np.isfinite(centre).all()
    kinds, n_bins, n = kinds_of(model.beam is not None), len(BINS), len(centre)
    known = Explanations(
        centre=centre,
        scale=scale,
        mean=np.zeros((len(kinds), n_bins, n)),
        whitening=np.zeros((len(kinds), n_bins, n * (n + 1) // 2)),
        limits=np.zeros((len(candidates_of(model.beam is not None)), n_bins)),
        spectrum=spectrum,
    )
    z = known.standardised(np.array([one.summary for one in windows]))
    bins = np.array([one.in_bin for one in windows])
    faults = np.array([kinds.index(one.fault) for one in windows])
    at_home = np.array([one.at_home for one in windows])
    for k, kind in enumerate(kinds):
        of_kind = faults > 0 if kind is Fault.UNKNOWN else faults == kinds.index(kind)
        if kind is None and kinds.count(None) > 1:
            of_kind &= at_home == (k > 0)
        for in_bin in range(n_bins):
            near = next(
                bin_
                for bin_ in sorted(range(n_bins), key=lambda other: abs(other - in_bin))
                if (of_kind & (bins == bin_)).sum() >= _LEAST_WINDOWS
            )
            own = z[of_kind & (bins == near)]
            covariance = ledoit_wolf(own)[0] * (_WIDER**2 if kind is Fault.UNKNOWN else 1.0)
            known.mean[k, in_bin] = own.mean(axis=0)
            known.whitening[k, in_bin] = np.linalg.inv(np.linalg.cholesky(covariance))[np.tril_indices(n)]
    return known
