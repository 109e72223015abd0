"""The Bayes limit of a scene: the highest accuracy possible given the scene and the signals.

It is the accuracy of Bayes' rule on many synthetic signals. The probability of a signal under a population is the
integral of its likelihood over the population's pulses: by quadrature along the shape, by Laplace's approximation over
peak, duration and (if unknown) onset. For other scenes, a learner on measured signals bounds the limit from below.
Coloured noise, acceleration and bounds from above are in the modules beside it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.features.extraction import extract_array
from cgid.measure.features.pulses import PULSE_FEATURES
from cgid.measure.features.table import Feature
from cgid.measure.filters import SENSOR_TAPER, filter_gain
from cgid.measure.fit.template import relative_times
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.synthesis.draws import BLOCK
from cgid.scene.synthesis.impacts import draws
from cgid.signals import Batch
from studies.impactor.likelihood import Profile, profile
from studies.impactor.prior import Prior
from studies.impactor.pulses import parameters_of

__all__ = ["Ceiling", "Learner", "ceiling", "learner"]

#: Maximum number of signals to evaluate or train on: they take hours, and give the accuracy to 1e-4.
MAX_SIGNALS = 10_000_000
#: Draws for the density of one population.
PRIOR_DRAWS = 1 << 19
#: Seed of these draws, unlikely to be chosen for the signals.
_PRIOR_SEED = 0x5EED_0000_C9D1
#: Number of populations whose draws are cached (8 MiB each); noise and sampling do not change them.
_CACHED = 8
#: Nodes along the shape: half as many change the probability of a signal by up to .1, the accuracy by .0005.
NODES = 33
#: A population whose ln(restitution) varies by less than this has its own nodes.
_NARROW = 0.3
#: Minimum number of samples per contact (5 % quantile) for which the integration is trusted.
MIN_SAMPLES = 5.0
#: Lowest signal over noise [dB]. At 10 dB some initial fits miss the pulse, and the limit of scene peers is .012 too
#: high against brute force over 65,536 draws of each population; at 15 dB .002 to .005.
MIN_SNR = 14.0
#: Minimum number of signals to train the learner on.
MIN_TRAINING = 100
#: Blocks of 256 impacts from which to estimate noise and contacts.
_BLOCKS = 8
#: Lowest edge of an impulse response over the sampling rate: limits the ringing to a million samples.
_MIN_EDGE = 2.0**-14
#: Extent of an impulse response: periods of its edge, and smallest value over its largest.
_RESPONSE_PERIODS, _RESPONSE_FLOOR = 64, 1e-5

#: Function that returns the likelihood of a scene's signals along the shape at some nodes between two bounds.
Along = Callable[[Scene, Batch, float, float, int], Profile]


@dataclass(frozen=True)
class Ceiling:
    """The result of Bayes' rule on the signals of a scene.

    Attributes
    ----------
    labels : tuple of str
    truth : ndarray of str, (n,)
    probabilities : ndarray, (n, n_labels)
        Posterior of each label.
    """

    labels: tuple[str, ...]
    truth: NDArray[np.str_]
    probabilities: Floats

    @property
    def accuracy(self) -> float:
        """Expected accuracy: the mean probability of the most probable label."""
        return float(self.probabilities.max(axis=1).mean())

    @property
    def accuracy_error(self) -> float:
        """Standard error of the accuracy."""
        return float(self.probabilities.max(axis=1).std(ddof=1) / np.sqrt(len(self.truth)))

    @property
    def hits(self) -> NDArray[np.bool_]:
        """Whether the most probable label is correct, (n,); the mean must agree with the accuracy."""
        return np.asarray(np.array(self.labels)[self.probabilities.argmax(axis=1)] == self.truth)

    @property
    def brier_score(self) -> float:
        """Mean of the squared error summed over the labels, 0 to 2."""
        return float(self._squared.mean())

    @property
    def brier_error(self) -> float:
        """Standard error of the Brier score."""
        return float(self._squared.std(ddof=1) / np.sqrt(len(self.truth)))

    @property
    def _squared(self) -> Floats:
        true = self.truth[:, None] == np.array(self.labels)[None]
        return np.asarray(np.sum((self.probabilities - true) ** 2, axis=1))

    def roc_area(self, label: str) -> float:
        """Return the area under the ROC curve of a label.

        Parameters
        ----------
        label : str

        Returns
        -------
        float
        """
        from sklearn.metrics import roc_auc_score

        validation.choice("label", label, self.labels)
        return float(roc_auc_score(self.truth == label, self.probabilities[:, self.labels.index(label)]))


def ceiling(
    scene: Scene | str | Path,
    n_signals: int = 20_000,
    seed: int = 1_000_003,
    *,
    drop_height_known: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Ceiling:
    """Return the Bayes limit of a scene.

    Parameters
    ----------
    scene : Scene, str or Path
        Impacts on a half space or a rigid wall, in white noise of known level.
    n_signals : int
        At most `MAX_SIGNALS`; the standard error falls with the square root.
    seed : int
        Seed of the signals.
    drop_height_known : bool
        Whether the impact speed of each signal is known.
    progress : callable, optional
        Called with the number of signals done.

    Returns
    -------
    Ceiling

    Raises
    ------
    InvalidValue
        The integration does not cover the scene, it has a single label, or `n_signals` is out of range.
    """
    scene = load_scene(scene)
    require_supported(scene)
    if rule := uncovered(scene):
        raise InvalidValue(
            f"scene {scene.name}: the Bayes limit needs {rule}; studies.ceilings.limit.learner bounds it from below"
        )
    return ceilings(scene, n_signals, seed, (drop_height_known,), progress=progress)[0]


def ceilings(
    scene: Scene,
    n_signals: int,
    seed: int,
    drop_height_known: tuple[bool, ...],
    *,
    along: Along | None = None,
    n_nodes: int = NODES,
    n_rows: int = 1024,
    progress: Callable[[int], object] | None = None,
) -> tuple[Ceiling, ...]:
    """Return the limits of the same signals for each value of `drop_height_known`; otherwise as `ceiling`."""
    # The likelihoods take almost all of the time and do not depend on the drop height.
    validation.whole("n_signals", n_signals, 2, MAX_SIGNALS)  # one signal has no standard error
    drop_heights_known = [
        [_Knowledge.of(scene, index, height) for index in range(len(scene.populations))] for height in drop_height_known
    ]
    weights = np.log([population.weight for population in scene.populations])
    truth: list[NDArray[np.str_]] = []
    evidence: list[list[Floats]] = [[] for _ in drop_heights_known]
    for batch in _joined(synthesise(scene, n_signals, seed), n_rows):
        truth.append(batch.labels)
        log_speed = np.log(batch.parameters["velocity"])[:, None]
        profiles = _profiles(scene, batch, along or _in_white_noise, drop_heights_known[0], n_nodes)
        for part, knowledge in zip(evidence, drop_heights_known, strict=True):
            columns = [k.evidence(p, batch, log_speed) for k, p in zip(knowledge, profiles, strict=True)]
            part.append(np.stack(columns, axis=1) + weights)
        if progress is not None:
            progress(len(batch))
    return tuple(_by_label(scene, np.concatenate(truth), np.concatenate(part), weights) for part in evidence)


def require_supported(scene: Scene) -> None:
    """Raise `InvalidValue` if a scene has no ceiling of any kind: no single impacts, or a single label."""
    problems = (
        (scene.stream is not None, "a frame for each impact, this one is a stream; take [stream] out"),
        (scene.taps, "a scene without taps"),
        (len(scene.labels) < 2, f"at least 2 labels, got {', '.join(scene.labels)}"),
    )
    for wrong, rule in problems:
        if wrong:
            raise InvalidValue(f"scene {scene.name}: the Bayes limit needs {rule}")


def uncovered(scene: Scene) -> str:
    """Return the requirements of the integration that a scene does not meet."""
    sensor = scene.sensor
    if sensor.coloured or scene.background is not None or sensor.offset or sensor.drift:
        return "white noise only: take noise_exponent, noise_spectrum, [background], offset and drift out"
    return uncovered_pulses(scene, noisy=bool(_noise_level(scene, np.ones(1)).any()))


def uncovered_pulses(scene: Scene, *, noisy: bool) -> str:
    """Return the requirements for pulses and sensor, for noise of any colour."""
    sensor = scene.sensor
    problems = (
        (
            scene.tail_beam is not None or sensor.quantity != "force",
            "the force itself: behind a beam it is not a member of the family",
        ),
        (bool(sensor.filters), "the force itself: filtered it is not a member of the family"),
        (sensor.relative_range is not None, "a full scale that does not follow each peak: give sensor.range"),
        (scene.impact.gravity is not None, "impacts without gravity, which the family omits"),
        (scene.randomise is not None, "a scene without [randomise]: vary it setting by setting"),
        (not noisy, "noise: without it every pulse is determined exactly"),
        (
            getattr(scene.impact.target, "thickness", None) is not None,
            "a half space or a rigid wall: on a plate the pulses are another family",
        ),
        (scene.mixes_laws, "one law of loss for all populations"),
        ("elastic" in scene.dissipations, "hunt-crossley dissipation: elastic pulses have no shape to estimate"),
        (
            set(scene.dissipations) != {"hunt-crossley"},
            f"hunt-crossley dissipation: {', '.join(sorted(set(scene.dissipations)))} pulses are another family",
        ),
        (
            any(p.second_hit is not None or p.clipped_at is not None for p in scene.populations),
            "single hits that no sensor cuts off",
        ),
    )
    return next((rule for wrong, rule in problems if wrong), "")


def untrusted(scene: Scene) -> str:
    """Return why Laplace's approximation fails for a scene."""
    sampled = [one.parameters for one in draws(scene, 0, _BLOCKS)]
    peak, duration = (np.concatenate([d[name] for d in sampled]) for name in ("peak_force", "contact_duration"))
    rate = scene.sampling.sampling_rate
    level = float(np.median(20 * np.log10(peak / scene.sensor.noise_level(peak, rate))))
    if level < MIN_SNR:
        return f"signal over noise {level:.3g} dB, below {MIN_SNR:g} dB the integration is not trusted"
    samples = float(np.quantile(duration, 0.05) * rate)
    if samples < MIN_SAMPLES:
        return f"{samples:.2g} samples on short contacts, below {MIN_SAMPLES:g} the integration is not trusted"
    return ""


@dataclass(frozen=True)
class _Knowledge:
    """The density of the pulses of one population, scaled to unit speed if the speed is known."""

    prior: Prior
    speed: tuple[Floats, Floats] | None

    @classmethod
    def of(cls, scene: Scene, index: int, drop_height_known: bool) -> _Knowledge:
        sampled = _draws(_population_alone(scene, index), PRIOR_DRAWS)
        log_peak, log_duration = np.log(sampled["peak_force"]), np.log(sampled["contact_duration"])
        if not drop_height_known:
            return cls(Prior.from_draws(log_peak, log_duration, sampled["restitution"]), None)
        log_speed = np.log(sampled["velocity"])
        prior = Prior.from_draws(log_peak - 1.2 * log_speed, log_duration + 0.2 * log_speed, sampled["restitution"])
        counts, edges = np.histogram(log_speed, bins=200)
        return cls(prior, (np.asarray(edges, np.float64), counts / counts.sum() / np.diff(edges)))

    def evidence(self, along: Profile, batch: Batch, log_speed: Floats) -> Floats:
        """Return the log probability of each signal."""
        peak_offset: Any = 0.0
        time_offset: Any = -np.log(batch.sampling_rate)
        log_evidence = np.zeros(len(batch))
        if self.speed is not None:
            # P0 ~ v^(6/5), T0 ~ v^(-1/5)
            peak_offset, time_offset = -1.2 * log_speed, time_offset + 0.2 * log_speed
            edges, density = self.speed
            cell = np.clip(np.searchsorted(edges, log_speed[:, 0], side="right") - 1, 0, len(density) - 1)
            inside = (log_speed[:, 0] >= edges[0]) & (log_speed[:, 0] <= edges[-1])
            log_evidence = np.log(np.where(inside, np.maximum(density[cell], 1e-12), 1e-12))
        # A fit that misses its pulse gives nan, which `_by_label` replaces by the weights.
        with np.errstate(invalid="ignore"):
            return np.asarray(log_evidence + self.prior.evidence(along, peak_offset, time_offset))


def _population_alone(scene: Scene, index: int) -> str:
    """Return the text of a scene with one population and the target, without the rest of the rig."""
    content = json.loads(scene.text)
    content["populations"] = [content["populations"][index]]
    frame = {"sampling_rate": 1e5, "samples": 64, "pre_trigger": 8}
    return json.dumps({"name": "one", "sampling": frame, **{k: content[k] for k in ("impact", "populations")}})


@lru_cache(maxsize=_CACHED)
def _draws(text: str, n_draws: int) -> dict[str, Floats]:
    scene = parse_scene(json.loads(text))
    names = ("peak_force", "contact_duration", "restitution", "velocity")
    blocks = [one.parameters for one in draws(scene, _PRIOR_SEED, n_draws // BLOCK)]
    return {name: np.concatenate([block[name] for block in blocks]) for name in names}


def _joined(batches: Iterator[Batch], n_rows: int) -> Iterator[Batch]:
    """Yield the batches joined to at least this many signals, because larger batches are faster."""
    pending: list[Batch] = []
    for batch in batches:
        pending.append(batch)
        if sum(map(len, pending)) >= n_rows:
            yield _one(pending)
            pending = []
    if pending:
        yield _one(pending)


def _one(pending: list[Batch]) -> Batch:
    return replace(
        pending[0],
        signals=np.concatenate([batch.signals for batch in pending]),
        labels=np.concatenate([batch.labels for batch in pending]),
        specimen=np.concatenate([batch.specimen for batch in pending]),
        parameters={
            name: np.concatenate([batch.parameters[name] for batch in pending]) for name in pending[0].parameters
        },
    )


def _profiles(scene: Scene, batch: Batch, along: Along, knowledge: list[_Knowledge], n_nodes: int) -> list[Profile]:
    """Return the likelihood along the shape for each population."""
    # The populations share it, unless the restitution of one hardly varies: then each has its own nodes.
    bounds = [k.prior.shape_bounds for k in knowledge]
    if min(high - low for low, high in bounds) > _NARROW:
        bounds = [(min(low for low, _ in bounds), max(high for _, high in bounds))] * len(bounds)
    profiles = {(low, high): along(scene, batch, low, high, n_nodes) for low, high in set(bounds)}
    return [profiles[bound] for bound in bounds]


def _in_white_noise(scene: Scene, batch: Batch, lowest: float, highest: float, n_nodes: int) -> Profile:
    onset, onset_between, response = onset_and_response(scene, len(batch))
    full_scale = scene.sensor.range
    return profile(
        batch.signals,
        true_pulses(batch),
        _noise_level(scene, batch.parameters["peak_force"]),
        lowest=lowest,
        highest=highest,
        n_nodes=n_nodes,
        onset=onset,
        onset_between=onset_between,
        clip_level=None if full_scale is None else np.full(len(batch), 0.999 * full_scale),
        response=response,
    )


def _noise_level(scene: Scene, peak: Floats) -> Floats:
    """Return the standard deviation of white noise and rounding, for signals with these peaks."""
    sensor = scene.sensor
    level = sensor.noise_level(peak, scene.sampling.sampling_rate)
    if sensor.bits is None or sensor.range is None:
        return level
    return np.asarray(np.hypot(level, sensor.range / 2 ** (sensor.bits - 1) / np.sqrt(12)))


def true_pulses(batch: Batch) -> Floats:
    """Return the true pulses, (n, 4), near which the most likely ones are: (peak, ln width, location, s)."""
    values, rate = batch.parameters, batch.sampling_rate
    shape = np.log(values["restitution"])
    width = values["contact_duration"] * rate / relative_times(shape)[0]
    return parameters_of(values["peak_force"], width, values["onset"] * rate, shape)


def low_pass_response(sampling_rate: float, edge: float) -> Floats:
    """Return the impulse response of `fft_filter`'s low-pass from lag 0 on, (n_lags,); it is symmetric."""
    edge = validation.number("bandwidth", edge, "Hz")
    validation.between("bandwidth", edge, _MIN_EDGE * sampling_rate, sampling_rate / 2, "Hz")
    n = int(2 ** np.ceil(np.log2(_RESPONSE_PERIODS * sampling_rate / edge)))
    frequency = np.asarray(np.fft.rfftfreq(n, 1 / sampling_rate), np.float64)
    gain = filter_gain(frequency, sampling_rate, None, edge, SENSOR_TAPER)
    response = np.fft.irfft(gain, n=n)[: n // 2]
    # Ringing below 1e-5 of the largest value is cut off.
    significant = np.flatnonzero(np.abs(response) > _RESPONSE_FLOOR * response[0])
    return np.asarray(response[: significant[-1] + 1])


def onset_and_response(scene: Scene, n: int) -> tuple[Floats | None, tuple[float, float] | None, Floats | None]:
    """Return the onsets if known, their bounds if not [samples], and the response of the sensor."""
    sampling, bandwidth = scene.sampling, scene.sensor.bandwidth
    first = float(sampling.pre_trigger)
    response = None if bandwidth is None else low_pass_response(sampling.sampling_rate, bandwidth)
    if sampling.jitter == 0:
        return np.full(n, first), None, response
    return None, (first, first + sampling.jitter), response


def _by_label(scene: Scene, truth: NDArray[np.str_], evidence: Floats, weights: Floats) -> Ceiling:
    # Without evidence, use the fractions of the populations.
    evidence = np.where(np.isfinite(evidence).all(axis=1, keepdims=True), evidence, weights)
    top = evidence.max(axis=1, keepdims=True)
    posterior = np.exp(evidence - top)
    of_population = np.array([population.label for population in scene.populations])
    columns = [posterior[:, of_population == label].sum(axis=1) for label in scene.labels]
    probabilities = np.stack(columns, axis=1)
    return Ceiling(scene.labels, truth, probabilities / probabilities.sum(axis=1, keepdims=True))


# ---- from below ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Learner:
    """The result of a learner, a lower bound of the limit of a scene.

    Attributes
    ----------
    n_training : int
        Training signals.
    hits : ndarray of bool, (n,)
        Whether the prediction was correct.
    """

    n_training: int
    hits: NDArray[np.bool_]

    @property
    def accuracy(self) -> float:
        """Fraction of correct predictions."""
        return float(self.hits.mean())

    @property
    def accuracy_error(self) -> float:
        """Standard error of the accuracy."""
        return float(self.hits.std(ddof=1) / np.sqrt(len(self.hits)))


def learner(
    scene: Scene | str | Path,
    n_training: int = 10_000,
    n_signals: int = 20_000,
    seed: int = 1_000_003,
    *,
    drop_height_known: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Learner:
    """Return the accuracy of boosted trees on all features of a pulse for a scene of force.

    Parameters
    ----------
    scene : Scene, str or Path
    n_training : int
        Training signals, of the next seed.
    n_signals, seed, drop_height_known, progress
        As in `ceiling`, with the same signals.

    Returns
    -------
    Learner

    Raises
    ------
    InvalidValue
        The scene is not one of force, has no single impacts or a single label, or a number is out of range.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier
    from threadpoolctl import threadpool_limits

    scene = load_scene(scene)
    require_supported(scene)
    if scene.sensor.quantity != "force":
        raise InvalidValue(f"scene {scene.name}: the learner needs a sensor of force, it has {scene.sensor.quantity}")
    validation.whole("n_signals", n_signals, 2, MAX_SIGNALS)
    check_training(n_training)
    another = seed + 1 if seed < 2**63 - 1 else 0
    test, truth = _measured(scene, n_signals, seed, drop_height_known, progress)
    inputs, labels = _measured(scene, n_training, another, drop_height_known, progress)
    inputs[:, np.isnan(inputs).all(axis=0)] = 0.0  # scikit-learn cannot bin a column without numbers
    # Numbers, because in scikit-learn before 1.8 early stopping fails with string labels.
    names, numbers, counts = np.unique(labels, return_inverse=True, return_counts=True)
    trees = HistGradientBoostingClassifier(
        learning_rate=0.05,
        max_iter=400,
        l2_regularization=1.0,
        early_stopping=bool(counts.min() >= 100),
        random_state=0,
    )
    with threadpool_limits(1):
        answers = names[trees.fit(inputs, numbers).predict(test)]
    return Learner(n_training, answers == truth)


def check_training(n_training: int) -> None:
    """Raise `InvalidValue` if a learner cannot be trained on so many signals."""
    validation.whole("learner", n_training, MIN_TRAINING, MAX_SIGNALS)


def _measured(
    scene: Scene, n_signals: int, seed: int, drop_height_known: bool, progress: Callable[[int], object] | None
) -> tuple[Floats, NDArray[np.str_]]:
    """Return the features of a scene's signals, nan where they cannot be measured, and the labels."""
    names = [f.name for f in PULSE_FEATURES if isinstance(f, Feature)]
    rows, labels = [], []
    for batch in synthesise(scene, n_signals, seed):
        values = extract_array(batch.signals, batch.sampling_rate, names, pre_trigger=batch.pre_trigger, invalid="nan")
        rows.append(np.column_stack([values, batch.parameters["velocity"]] if drop_height_known else [values]))
        labels.append(batch.labels)
        if progress is not None:
            progress(len(batch))
    return np.concatenate(rows), np.concatenate(labels)
