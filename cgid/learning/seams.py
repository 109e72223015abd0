"""Simulated seams, so that a fraction of gangue can be told in a seam that nobody described.

What one rock gives through a beam, a recorder and a detector is measured once, in some streams of a wide world
(`pool_of`): pulses of a closed formula, and what was measured of them. A rock of any seam then takes the difference
between both from a rock of the pool whose pulse is nearly its own; missed and unknown impacts, too, and whether it
comes back. So the impacts of a seam cost no inversion, and thousands of seams take a minute.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPClassifier
from threadpoolctl import threadpool_limits

from cgid._lib.validation import Floats
from cgid._lib.workers import SERIAL, Workers
from cgid.identification.detection.ear import Ear
from cgid.identification.model.anchor import (
    MIN_ANCHOR,
    N_CLASSES,
    Committee,
    Impacts,
    SeamNetworks,
    class_edges,
    inputs_of,
    summary,
)
from cgid.identification.model.confusion import logit
from cgid.identification.model.families import Network, softmax
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.fraction import estimate_of
from cgid.identification.training.rows import BEAM_FEATURES, BEAM_GUARDS, through
from cgid.learning.prior import seam_numbers
from cgid.learning.streams import DURATION, detected_features, impact_of, labels_of, variations
from cgid.measure.modal.beam import Beam
from cgid.physics.contact.closed_forms import damping_number, peak_force
from cgid.scene.file.schema import Scene, parse_scene
from cgid.scene.synthesis.rocks import arrivals_of, arriving
from cgid.scene.synthesis.stream import record
from cgid.units import STANDARD_GRAVITY

#: Ranges of rocks of the wide world, beyond those of any seam of the prior.
_WIDE = {
    "density": {"distribution": "uniform", "lowest": "1150 kg/m^3", "highest": "2950 kg/m^3"},
    "youngs_modulus": {"distribution": "log-uniform", "lowest": "0.7 GPa", "highest": "60 GPa"},
    "poisson_ratio": {"distribution": "uniform", "lowest": 0.16, "highest": 0.35},
    "radius": {"distribution": "log-uniform", "lowest": "6 mm", "highest": "165 mm"},
    "restitution": {"distribution": "uniform", "lowest": 0.1, "highest": 0.88},
    "drop_height": {"distribution": "uniform", "lowest": "0.15 m", "highest": "4 m"},
}
#: Factors of the noise of the streams of a pool, in turn; and range of those of their rate of rocks: from 8 Hz in
#: `caving`, 3 to 20 Hz.
_LOUDNESS, _RATES = (1.0, 3.0, 10.0, 30.0), (0.4, 2.5)
#: Modulus and Poisson ratio of the beam's steel [Pa].
_STEEL = 210e9 / (1 - 0.3**2)


def pulse_of(density: Floats, radius: Floats, modulus: Floats, restitution: Floats, speed: Floats) -> Floats:
    """Return ln of peak [N], width [s] and restitution of a damped Hertz impact on steel, (n, 3).

    The width is the impulse over the peak; `modulus` is E / (1 - nu^2) [Pa].
    """
    mass = 4 / 3 * np.pi * density * radius**3
    stiffness = 4 / 3 * np.sqrt(radius) / (1 / modulus + 1 / _STEEL)
    length = (mass * speed**2 / stiffness) ** 0.4
    peak = stiffness * length**1.5 * peak_force(damping_number(restitution))
    return np.log(np.stack([peak, mass * speed * (1 + restitution) / peak, restitution], axis=1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Pool:
    """Impacts of the wide world: the pulse of the formula, and what was measured."""

    pulse: Floats  # (n, 3) ln of peak, width and restitution by the formula
    measured: Floats  # (n, n_measured) features and guards; nan if missed or not measurable
    told: NDArray[np.bool_]  # (n,) whether there is a row for it: else it is missed
    bounce: NDArray[np.bool_]  # (n,) whether it is no first impact
    loudness: NDArray[np.intp]  # (n,) number of the noise that it was heard in
    back: Floats  # (n,) speed of the next impact over restitution times speed; nan if the rock does not come back


def wide(scene: Scene) -> Scene:
    """Return the scene with rocks of the wide world under both labels."""
    content = json.loads(scene.text)
    content["populations"] = [{"label": label, **_WIDE} for label in labels_of(scene)]
    return parse_scene(content | {"name": f"{scene.name}, a wide world"})


def pool_of(
    scene: Scene,
    n_streams: int,
    seed: int,
    beam: Beam,
    *,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> Pool:
    """Return the impacts of streams of the wide world, through the beam of a scene.

    Noise hides coal more than gangue: coal is identified 1.2 times a rock in .5 g of noise where it is 2.1 times in
    little, gangue 1.3 times for 1.5. So the streams have its noises in turn.
    """
    scenes = variations(wide(scene), n_streams, seed, rates=_RATES, loudness=_LOUDNESS)
    parts = workers.all(_pooled, (seed, beam), enumerate(scenes), progress)
    return Pool(**{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Pool)})


def _pooled(settings: tuple[int, Beam], numbered: tuple[int, Scene]) -> Pool:
    (seed, beam), (number, scene) = settings, numbered
    signal, truth = record(scene, seed, number)
    assert scene.stream is not None
    restitution = np.concatenate(
        [
            arriving(scene, stretch, 0, seed, number)["restitution"]
            for stretch in arrivals_of(scene.stream).stretches(DURATION, seed, number)
        ]
    )[truth["rock"]]
    pulse = pulses_of(truth, restitution)
    ear = Ear(signal.sampling_rate, kind="vibration", beam=through(beam))
    events = [event for heard in ear.heard([signal.samples[None]]) for event in heard.events]
    with threadpool_limits(1):
        features = detected_features(events, (*BEAM_FEATURES, *BEAM_GUARDS), beam)
    features[[bool(event.problem) for event in events]] = np.nan
    own = impact_of(np.array([event.time for event in events]), truth["time"], truth["peak_force"])
    found = own >= 0
    told = np.zeros(len(pulse), bool)
    told[own[found]] = True
    measured = np.full((len(pulse), features.shape[1]), np.nan)
    measured[own[found]] = features[found]
    order = np.lexsort((truth["bounce"], truth["rock"]))
    again = order[:-1][np.diff(truth["rock"][order]) == 0]
    following = order[1:][np.diff(truth["rock"][order]) == 0]
    back = np.full(len(pulse), np.nan)
    back[again] = truth["velocity"][following] / (restitution * truth["velocity"])[again]
    # The rocks of the last seconds may come back after the end.
    whole = truth["time"] < DURATION - 2.0
    bounce = np.asarray(truth["bounce"] > 0)
    loudness = np.full(np.count_nonzero(whole), number % len(_LOUDNESS))
    return Pool(
        pulse=pulse[whole],
        measured=measured[whole],
        told=told[whole],
        bounce=bounce[whole],
        loudness=loudness,
        back=back[whole],
    )


def pulses_of(truth: Mapping[str, Any], restitution: Floats) -> Floats:
    """Return the pulses of the formula, (n, 3), from the columns of a truth."""
    modulus = truth["youngs_modulus"] / (1 - truth["poisson_ratio"] ** 2)
    return pulse_of(truth["density"], truth["radius"], modulus, restitution, truth["velocity"])


# -- simulated seams --------------------------------------------------------------------------------------

#: Rocks of coal and gangue of a simulated seam.
_COAL, _GANGUE = 340, 220
#: Neighbours in the pool of which one gives its errors.
_NEIGHBOURS = 6
#: Generations of bounces, and the slowest that is followed [m/s].
_MOST_BOUNCES, _LEAST_SPEED = 5, 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Seams:
    """Predictions of a model for the rocks of simulated seams, by rock."""

    pulses: Floats  # (n, 3) ln of peak, width and restitution as measured; nan if not measurable
    logits: Floats  # (n,) nan if unknown
    first: NDArray[np.intp]  # (n_seams * (_COAL + _GANGUE) + 1,) first impact of each rock; coal first in a seam


def simulated(pool: Pool, model: StoredModel, n_seams: int, rng: np.random.Generator) -> Seams:
    """Return the predictions of a model for rocks of seams that are drawn from the prior."""
    drawn = _drawn(n_seams, rng)
    scale = pool.pulse.std(axis=0)
    n_noises = int(pool.loudness.max()) + 1
    kinds = [
        [np.flatnonzero((pool.bounce == again) & (pool.loudness == noise)) for noise in range(n_noises)]
        for again in (False, True)
    ]
    trees = [[cKDTree(pool.pulse[rows] / scale) for rows in of_noise] for of_noise in kinds]
    gain = drawn.pop("gain")
    rock = np.arange(len(drawn["speed"]))
    loudness = np.repeat(rng.integers(n_noises, size=n_seams), _COAL + _GANGUE)
    rocks, numbers, pulses = [], [], []
    for generation in range(_MOST_BOUNCES + 1):
        if not rock.size:
            break
        own = {name: column[rock] for name, column in drawn.items()}
        pulse = pulse_of(own["density"], own["radius"], own["modulus"], own["restitution"], own["speed"])
        number, which = np.empty(len(rock), np.intp), rng.integers(_NEIGHBOURS, size=len(rock))
        for noise, (tree, rows) in enumerate(zip(trees[generation > 0], kinds[generation > 0], strict=True)):
            own_noise = np.flatnonzero(loudness[rock] == noise)
            _, near = tree.query(pulse[own_noise] / scale, k=_NEIGHBOURS, workers=1)
            number[own_noise] = rows[near[np.arange(len(own_noise)), which[own_noise]]]
        rocks.append(rock)
        numbers.append(number)
        pulses.append(pulse)
        speed = pool.back[number] * own["restitution"] * own["speed"]
        again = np.nan_to_num(speed) >= _LEAST_SPEED
        drawn["speed"][rock[again]] = speed[again]
        rock = rock[again]
    rock, number, pulse = np.concatenate(rocks), np.concatenate(numbers), np.concatenate(pulses)
    order = np.argsort(rock, kind="stable")
    order = order[pool.told[number[order]]]
    rock, number, pulse = rock[order], number[order], pulse[order]
    measured = pool.measured[number]
    measured[:, :3] *= np.exp(pulse - pool.pulse[number] + gain[rock // (_COAL + _GANGUE)])
    sound = np.isfinite(measured).all(axis=1)
    logits = np.full(len(rock), np.nan)
    features, guards = measured[sound, : len(model.features)], measured[sound, len(model.features) :]
    known = model.novelty(features, guards) <= 1
    probabilities = model.probabilities(features)[:, model.labels.index("gangue")]
    logits[sound] = np.where(known, logit(probabilities), np.nan)
    first = np.searchsorted(rock, np.arange(n_seams * (_COAL + _GANGUE) + 1))
    return Seams(pulses=np.log(measured[:, :3]), logits=logits, first=first)


def _drawn(n_seams: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return rocks of seams of the prior, (n_seams * (_COAL + _GANGUE),) each, and the errors of gain (n_seams, 3).

    Errors of gain are assumed.
    """
    moduli, spreads, restitutions, densities, largest, ratios, low, high = seam_numbers(n_seams, rng)
    gain = np.where(rng.random((n_seams, 1)) < 0.5, rng.normal(0, (0.10, 0.05, 0.06), (n_seams, 3)), 0.0)
    parts: dict[str, list[Floats]] = {}
    for k, n in enumerate((_COAL, _GANGUE)):
        shape = n_seams, n
        young = moduli[k][:, None] * np.exp(spreads[k][:, None] * rng.standard_normal(shape))
        poisson = rng.uniform((0.26, 0.20)[k], (0.34, 0.32)[k], shape)
        radius = largest[k][:, None] * ratios[k][:, None] ** -rng.random(shape)
        e = restitutions[k][:, None] + (0.08, 0.10)[k] * rng.standard_normal(shape)
        density = densities[k][:, None] * (1 + 0.05 * rng.standard_normal(shape))
        fall = low[:, None] + (high - low)[:, None] * rng.random(shape)
        for name, values in {
            "modulus": young / (1 - poisson**2),
            "radius": radius,
            "restitution": np.clip(e, 0.1, 0.88),
            "density": density,
            "speed": np.sqrt(2 * STANDARD_GRAVITY * fall) * np.cos(np.radians(20)),
        }.items():
            parts.setdefault(name, []).append(values)
    return {name: np.hstack(both).ravel() for name, both in parts.items()} | {"gain": gain}


# -- networks ---------------------------------------------------------------------------------------------

#: Pools, and streams of each, with each of the noises in turn.
N_POOLS, N_STREAMS = 2, 24
#: Seams that train a network, and that settle temperature and limit; windows of each; seams simulated at once.
N_SEAMS, _JUDGES, _DRAWS, _AT_ONCE = 12_000, 800, 4, 1000
#: Rocks of an anchor and of a window at least and at most; half of all are of this typical size.
_ANCHOR, _WINDOW = (8, 200), (5, 130)
_TYPICAL = (100, 200), (40, 130)
#: Rocks of the anchors and windows that users have: 25 s of pure coal, and 10 s, with some 8 rocks a second.
_USUAL = (150, 230), (55, 105)
#: The networks of a committee: which pool, whether of usual sizes only, and its seed. Five averaged over two pools, two
#: of them for usual sizes, err by .108 where one errs by .110 to .120, by luck .133 (31 streams of other code).
_MEMBERS = ((0, False, 0), (1, False, 0), (0, False, 1), (0, True, 0), (1, True, 0))
#: Half of the anchors contain gangue up to this fraction; a polluted one contains this much.
_IMPURE, _POLLUTED = 0.1, (0.2, 0.45)
#: Windows without any gangue.
_PURE = 0.06
#: Labelled lumps of gangue at least and at most.
_LUMPS = (6, 40)
#: Layers, weight decay, epochs with rates of learning, and cells of the summary.
_LAYERS, _DECAY, _EPOCHS, _N_CELLS = (64, 32), 0.3, ((24, 1e-3), (8, 2e-4)), 24
#: Fraction of sound windows that pass the test of the anchor.
_SOUND = 0.99
#: Temperature of the density without an anchor over the one that suits simulated seams best, since a mine may lie at
#: the edge of the prior (assumed), and nothing but the window tells.
_MARGIN = 1.25
#: Candidates of the temperature.
_TEMPERATURES = np.linspace(0.5, 1.6, 23)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Draws:
    """Summaries of windows and anchors of simulated seams."""

    window: Floats
    anchor: Floats
    other: Floats  # an anchor of another seam, or a polluted one
    lumps: Floats  # gangue of this seam
    fraction: Floats


def with_seams(
    model: StoredModel,
    pools: Sequence[Pool],
    seed: int,
    n_seams: int = N_SEAMS,
    *,
    progress: Callable[[int], object] | None = None,
) -> StoredModel:
    """Return a model with networks for the fraction of gangue in any seam, trained on simulated seams of pools."""
    rng = np.random.default_rng([seed, n_seams])
    few = simulated(pools[0], model, min(n_seams, _AT_ONCE), rng)
    known = np.flatnonzero(np.isfinite(few.logits))
    pulses = few.pulses[rng.choice(known, min(20_000, known.size), replace=False)]
    cell_scale = pulses.std(axis=0)
    with threadpool_limits(1):
        cells = KMeans(_N_CELLS, n_init=3, random_state=seed).fit(pulses / cell_scale).cluster_centers_

    def drawn(pool: Pool, n: int, *, usual: bool) -> _Draws:
        parts = []
        for left in range(n, 0, -_AT_ONCE):
            seams = simulated(pool, model, min(left, _AT_ONCE), rng)
            parts.append(_draws(seams, cells, cell_scale, rng, usual=usual))
            if progress is not None:
                progress(min(left, _AT_ONCE))
        return _Draws(
            **{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(_Draws)}
        )

    own = {
        (which, usual): drawn(pools[which % len(pools)], n_seams, usual=usual)
        for which, usual in dict.fromkeys(member[:2] for member in _MEMBERS)
    }
    judges = drawn(pools[-1], _JUDGES, usual=False)
    first = own[0, False]
    plain = np.concatenate([first.window, first.anchor, first.window - first.anchor], axis=1)
    mean, scale = plain.mean(axis=0), np.maximum(plain.std(axis=0), 1e-6)

    def trained(inputs: Callable[[_Draws], Floats], margin: float = 1.0) -> tuple[Committee, list[float]]:
        """Return a committee at the temperature that suits the judges, and the error of each of its networks."""
        networks = [
            _fitted(inputs(own[which, usual]), _class_of(own[which, usual].fraction), seed + more)
            for which, usual, more in _MEMBERS
        ]
        given, classes = inputs(judges), _class_of(judges.fraction)
        alone = [_figures(softmax(one.scores(given))[typical], judges.fraction[typical])["rms"] for one in networks]
        return _cooled(networks, given, classes, margin), alone

    def beside(drawn: _Draws) -> Floats:
        return inputs_of(drawn.window, drawn.anchor, mean, scale)

    typical = judges.window[:, -1] >= np.log(_TYPICAL[1][0])
    with threadpool_limits(1):
        anchored, errors = trained(beside)
        alone, _ = trained(lambda drawn: beside(drawn)[:, : drawn.window.shape[1]], _MARGIN)
        sharpened, _ = trained(lambda drawn: inputs_of(drawn.window, drawn.anchor, mean, scale, drawn.lumps))
        sound, others = beside(first), inputs_of(first.window, first.other, mean, scale)
        foreign = _fitted(np.concatenate([sound, others]), np.repeat([0, 1], len(sound)), seed)
    networks = SeamNetworks(
        cells=cells,
        cell_scale=cell_scale,
        mean=mean,
        scale=scale,
        limit=float(np.quantile(foreign.scores(beside(judges)), _SOUND)),
        anchored=anchored,
        alone=alone,
        foreign=foreign,
        sharpened=sharpened,
        lumps_limit=0.0,
    )
    limit = float(np.quantile(networks.gangue_of(judges.lumps, judges.anchor), 1 - _SOUND))
    networks = replace(networks, lumps_limit=limit)
    told = {
        "n_seams": n_seams * len(own),
        "n_judges": _JUDGES,
        "n_impacts": sum(int(pool.told.sum()) for pool in pools),
        "sound": _SOUND,
        "foreign_told": float(np.mean(networks.foreignness(judges.window, judges.other)[typical] > 0)),
        "each": errors,
        "anchored": _figures(networks.density(judges.window, judges.anchor)[typical], judges.fraction[typical]),
        "alone": _figures(networks.density(judges.window)[typical], judges.fraction[typical]),
        "sharpened": _figures(
            networks.density(judges.window, judges.anchor, judges.lumps)[typical], judges.fraction[typical]
        ),
    }
    arrays = {name: array for name, array in model.arrays.items() if not name.startswith(SeamNetworks.PREFIX)}
    return replace(model, arrays={**arrays, **networks.arrays}, training={**model.training, "seams": told})


def taught(
    model: StoredModel,
    scene: Scene,
    n_impacts: int,
    seed: int,
    *,
    progress: Callable[[int], object] | None = None,
    workers: Workers = SERIAL,
) -> StoredModel:
    """Return a model of the streams of a scene with networks for any seam, from no more seams than impacts.

    Without gangue among its labels it stays as it is: the seams have coal and gangue.
    """
    if "gangue" not in model.labels or model.beam is None:
        return model
    pools = [
        pool_of(scene, N_STREAMS, seed + k, model.beam.beam, progress=progress, workers=workers) for k in range(N_POOLS)
    ]
    return with_seams(model, pools, seed, min(n_impacts, N_SEAMS))


def _draws(seams: Seams, cells: Floats, scale: Floats, rng: np.random.Generator, *, usual: bool) -> _Draws:
    """Return windows of each seam beside anchors of it and of others; those of `usual` sizes are of pure coal."""
    n_rocks = _COAL + _GANGUE
    n_seams = (len(seams.first) - 1) // n_rocks
    (of_lumps,) = rng.spawn(1)
    rows = []
    for seam in np.repeat(np.arange(n_seams), _DRAWS).tolist():
        coal, gangue = rng.permutation(_COAL), _COAL + rng.permutation(_GANGUE)
        n_anchor, n_window = (
            int(rng.integers(*typical)) if usual or rng.random() < 0.5 else int(np.exp(rng.uniform(*np.log(limits))))
            for typical, limits in zip(_USUAL if usual else _TYPICAL, (_ANCHOR, _WINDOW), strict=True)
        )
        fraction = 0.0 if rng.random() < _PURE else rng.random()
        n_gangue = rng.binomial(n_window, fraction)
        impure = rng.binomial(n_anchor, rng.uniform(0, _IMPURE) if not usual and rng.random() < 0.5 else 0.0)
        polluted = rng.binomial(n_anchor, rng.uniform(*_POLLUTED))
        first, rest = seam * n_rocks, coal[n_window:]
        another = (seam + 1 + int(rng.integers(n_seams - 1))) % n_seams * n_rocks
        is_another = rng.random() < 0.5
        chosen = (
            first + np.append(coal[: n_window - n_gangue], gangue[:n_gangue]),
            first + np.append(rest[: n_anchor - impure], gangue[_GANGUE - impure :]),
            another + rest[:n_anchor]
            if is_another
            else first + np.append(rest[: n_anchor - polluted], gangue[_GANGUE - polluted :]),
            first + gangue[n_gangue:][: int(np.exp(of_lumps.uniform(*np.log(_LUMPS))))],
        )
        impacts = [_of_rocks(seams, rocks) for rocks in chosen]
        least = 1, MIN_ANCHOR, MIN_ANCHOR, 1
        if all(len(one.logits) >= n for one, n in zip(impacts, least, strict=True)):
            rows.append((*(summary(one, cells, scale) for one in impacts), fraction))
    columns = map(np.array, zip(*rows, strict=True))
    return _Draws(**dict(zip((one.name for one in fields(_Draws)), columns, strict=True)))


def _of_rocks(seams: Seams, rocks: NDArray[np.intp]) -> Impacts:
    """Return the impacts of some rocks."""
    first, counts = seams.first[rocks], seams.first[rocks + 1] - seams.first[rocks]
    rows = np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    known = np.isfinite(seams.logits[rows])
    own = rows[known]
    return Impacts(seams.pulses[own], seams.logits[own], int(rows.size - own.size))


def _class_of(fractions: Floats) -> NDArray[np.intp]:
    return np.clip(np.searchsorted(class_edges(), fractions, side="right") - 1, 0, N_CLASSES - 1)


def _fitted(inputs: Floats, classes: NDArray[np.intp], seed: int) -> Network:
    estimator = MLPClassifier(
        _LAYERS, activation="tanh", alpha=_DECAY, batch_size=200, warm_start=True, random_state=seed
    )
    rows = inputs.astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the number of epochs is given
        for epochs, rate in _EPOCHS:
            estimator.set_params(max_iter=epochs, learning_rate_init=rate).fit(rows, classes)
    arrays = {name: np.asarray(a, np.float64) for name, a in Network.export(estimator).items()}
    return Network(arrays, inputs.shape[1], len(estimator.classes_))


def _cooled(networks: Sequence[Network], inputs: Floats, classes: NDArray[np.intp], margin: float = 1.0) -> Committee:
    """Return a committee whose densities have the temperature that suits other seams best, times a margin."""
    scores, rows = [one.scores(inputs) for one in networks], np.arange(len(inputs))
    losses = [
        -np.mean(np.log(np.mean([softmax(own / t)[rows, classes] for own in scores], axis=0) + 1e-300))
        for t in _TEMPERATURES
    ]
    best = margin * _TEMPERATURES[int(np.argmin(losses))]
    last = ("weights_3", "biases_3")
    return Committee.of(
        [
            Network({**one.arrays, **{name: one.arrays[name] / best for name in last}}, one.n_features, one.n_classes)
            for one in networks
        ]
    )


def _figures(densities: Floats, fractions: Floats) -> dict[str, float]:
    """Return RMS error, hold and width of intervals for densities of known fractions."""
    found = [estimate_of(density, 0.5) for density in densities]
    share, low, high = (np.array([one[name] for one in found]) for name in ("share", "low", "high"))
    return {
        "rms": float(np.sqrt(np.mean((share - fractions) ** 2))),
        "holds": float(np.mean((low <= fractions) & (fractions <= high))),
        "width": float(np.mean(high - low)),
    }
