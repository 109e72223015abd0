"""The ceiling of a scene: the highest accuracy possible given the scene and the signals.

It is the accuracy of Bayes' rule on many synthetic signals. The probability of a signal under a population is the
integral of its likelihood over the population's pulses: by quadrature along the shape, by Laplace's approximation over
peak, duration and (if unknown) onset. The density of the pulses comes from many draws.
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

from cgid import validation
from cgid.ceiling.coloured import Frames, Noise, noise_of, profile_in, true_parameters
from cgid.errors import InvalidValue
from cgid.identification.prior import Prior
from cgid.measure.filters import low_pass_response
from cgid.measure.likelihood import Profile, profile
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.draws import BLOCK
from cgid.scene.impacts import draws
from cgid.signals import Batch
from cgid.validation import Floats

#: Most signals to judge or train on: they take hours, and give the accuracy to 1e-4.
MOST_SIGNALS = 10_000_000
#: Draws for the density of one population.
PRIOR_DRAWS = 1 << 19
#: Seed of these draws, unlikely to be chosen for the signals.
_PRIOR_SEED = 0x5EED_0000_C9D1
#: Number of populations whose draws are cached (8 MiB each); noise and sampling do not change them.
_KEPT = 8
#: Nodes along the shape: half as many change the probability of a signal by up to .1, the accuracy by .0005.
NODES = 33
#: Signals integrated at once, and where those of equal peaks share most of the work.
_ROWS, _MANY_ROWS = 1024, 4096
#: A population whose ln(restitution) varies by less than this has its own nodes.
_NARROW = 0.3


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
        """Expected share of right answers: the mean probability of the most probable label."""
        return float(self.probabilities.max(axis=1).mean())

    @property
    def accuracy_error(self) -> float:
        """Standard error of the accuracy."""
        return float(self.probabilities.max(axis=1).std(ddof=1) / np.sqrt(len(self.truth)))

    @property
    def hits(self) -> NDArray[np.bool_]:
        """Whether the most probable label is the true one, (n,); their share must agree with the accuracy."""
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

    def roc(self, label: str) -> tuple[Floats, Floats]:
        """Return false and true positive rate of a label for falling thresholds.

        Parameters
        ----------
        label : str

        Returns
        -------
        tuple of two ndarray
            False and true positive rates.
        """
        validation.choice("label", label, self.labels)
        order = np.argsort(-self.probabilities[:, self.labels.index(label)], kind="stable")
        own = (self.truth == label)[order]
        return np.cumsum(~own) / max((~own).sum(), 1), np.cumsum(own) / max(own.sum(), 1)

    def roc_area(self, label: str) -> float:
        """Return the area under the ROC curve of a label.

        Parameters
        ----------
        label : str

        Returns
        -------
        float
        """
        wrong, right = self.roc(label)
        return float(np.trapezoid(np.append(0.0, right), np.append(0.0, wrong)))


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
        Impacts on a half space or a rigid wall, with noise of known level.
    n_signals : int
        At most `MOST_SIGNALS`; the standard error falls with the square root.
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
    return ceilings(scene, n_signals, seed, (drop_height_known,), progress=progress)[0]


def ceilings(
    scene: Scene | str | Path,
    n_signals: int,
    seed: int,
    drop_height_known: tuple[bool, ...],
    *,
    n_nodes: int = NODES,
    progress: Callable[[int], object] | None = None,
) -> tuple[Ceiling, ...]:
    """Return ceilings of the same signals for each value of `drop_height_known`; otherwise as `ceiling`.

    The likelihoods take almost all of the time and do not depend on this. `n_nodes` are those along the shape.

    Parameters
    ----------
    scene, n_signals, seed
        As in `ceiling`.
    drop_height_known : tuple of bool
        One ceiling for each.
    n_nodes : int
        Nodes of the quadrature along the shape.
    progress : callable, optional
        Is called with the number of signals done.

    Returns
    -------
    tuple of Ceiling
    """
    scene = load_scene(scene)
    check_covered(scene)
    validation.whole("n_signals", n_signals, 2, MOST_SIGNALS)  # one signal has no standard error
    known = [
        [_Knowledge.of(scene, index, height) for index in range(len(scene.populations))] for height in drop_height_known
    ]
    weights = np.log([population.weight for population in scene.populations])
    noise = noise_of(scene)
    truth: list[NDArray[np.str_]] = []
    evidence: list[list[Floats]] = [[] for _ in known]
    for batch in _joined(synthesise(scene, n_signals, seed), _MANY_ROWS if noise.mixed else _ROWS):
        truth.append(batch.labels)
        log_speed = np.log(batch.parameters["velocity"])[:, None]
        profiles = _profiles(scene, batch, noise, known[0], n_nodes)
        for held, knowledge in zip(evidence, known, strict=True):
            columns = [k.evidence(p, batch, log_speed) for k, p in zip(knowledge, profiles, strict=True)]
            held.append(np.stack(columns, axis=1) + weights)
        if progress is not None:
            progress(len(batch))
    return tuple(_by_label(scene, np.concatenate(truth), np.concatenate(held), weights) for held in evidence)


def check_asked(scene: Scene) -> None:
    """Raise `InvalidValue` if a scene has no ceiling of any kind: no single impacts, or a single label."""
    problems = (
        (scene.stream is not None, "a frame for each impact, this one is a stream; take [stream] out"),
        (scene.taps, "a scene of impacts alone, this one has taps"),
        (len(scene.labels) < 2, f"at least 2 labels, got {', '.join(scene.labels)}"),
    )
    for wrong, rule in problems:
        if wrong:
            raise InvalidValue(f"scene {scene.name}: the ceiling needs {rule}")


def uncovered(scene: Scene) -> str:
    """Return what the integration needs that a scene does not have, empty if it covers the scene."""
    sensor, background = scene.sensor, scene.background
    noise = noise_of(scene) if scene.sampling.samples else None
    problems = (
        (scene.tail_beam is not None, "the force itself: what a beam makes of it is no member of the family"),
        (bool(sensor.filters), "the force itself: what a filter makes of it is no member of the family"),
        (
            background is not None and background.recorded is not None,
            "noise of a known spectrum: take [background.recorded] out, or give its spectrum as [background.coloured]",
        ),
        (sensor.relative_range is not None, "a full scale that does not follow each peak: give sensor.range"),
        (scene.impact.gravity is not None, "impacts without gravity, which the family leaves out"),
        (scene.randomise is not None, "a scene without [randomise]: vary it setting by setting"),
        (noise is not None and not noise.level(np.ones(1)).any(), "noise: without it every pulse is told exactly"),
        (
            getattr(scene.impact.target, "thickness", None) is not None,
            "a half space or a rigid wall: on a plate the pulses are another family",
        ),
        (scene.mixes_laws, "one law of loss for all populations"),
        ("elastic" in scene.dissipations, "hunt-crossley dissipation: elastic pulses have no shape to be told"),
        (
            set(scene.dissipations) != {"hunt-crossley"},
            f"hunt-crossley dissipation: {', '.join(sorted(set(scene.dissipations)))} pulses are another family",
        ),
        (
            any(p.second_hit is not None or p.clipped_at is not None for p in scene.populations),
            "single hits that no sensor cuts off",
        ),
        (
            sensor.range is not None and ((noise is not None and not noise.white) or sensor.offset or sensor.drift),
            "white noise without offset and drift where a range cuts samples off: take sensor.range out",
        ),
    )
    return next((rule for wrong, rule in problems if wrong), "")


def check_covered(scene: Scene) -> None:
    """Raise `InvalidValue` if the integration does not cover a scene, or it has a single label."""
    check_asked(scene)
    if rule := uncovered(scene):
        raise InvalidValue(
            f"scene {scene.name}: the ceiling needs {rule}; cgid ceiling without --plot, or cgid.ceiling.bracket, "
            f"{'estimates' if scene.tail_beam is not None else 'encloses'} it by learners"
        )


@dataclass(frozen=True)
class _Knowledge:
    """The density of the pulses of one population, scaled to unit speed if the speed is known."""

    prior: Prior
    speed: tuple[Floats, Floats] | None

    @classmethod
    def of(cls, scene: Scene, index: int, drop_height_known: bool) -> _Knowledge:
        drawn = _draws(_population_alone(scene, index), PRIOR_DRAWS)
        log_peak, log_duration = np.log(drawn["peak_force"]), np.log(drawn["contact_duration"])
        if not drop_height_known:
            return cls(Prior.from_draws(log_peak, log_duration, drawn["restitution"]), None)
        log_speed = np.log(drawn["velocity"])
        prior = Prior.from_draws(log_peak - 1.2 * log_speed, log_duration + 0.2 * log_speed, drawn["restitution"])
        counts, edges = np.histogram(log_speed, bins=200)
        return cls(prior, (np.asarray(edges, np.float64), counts / counts.sum() / np.diff(edges)))

    def evidence(self, along: Profile, batch: Batch, log_speed: Floats) -> Floats:
        """Return the log probability of each signal."""
        peak_offset: Any = 0.0
        time_offset: Any = -np.log(batch.sampling_rate)
        own = np.zeros(len(batch))
        if self.speed is not None:
            # P0 ~ v^(6/5), T0 ~ v^(-1/5)
            peak_offset, time_offset = -1.2 * log_speed, time_offset + 0.2 * log_speed
            edges, density = self.speed
            cell = np.clip(np.searchsorted(edges, log_speed[:, 0], side="right") - 1, 0, len(density) - 1)
            inside = (log_speed[:, 0] >= edges[0]) & (log_speed[:, 0] <= edges[-1])
            own = np.log(np.where(inside, np.maximum(density[cell], 1e-12), 1e-12))
        # A fit that misses its pulse gives nan, which `_by_label` replaces by the weights.
        with np.errstate(invalid="ignore"):
            return np.asarray(own + self.prior.evidence(along, peak_offset, time_offset))


def _population_alone(scene: Scene, index: int) -> str:
    """Return the text of a scene with one population and the target, without the rest of the rig."""
    content = json.loads(scene.text)
    content["populations"] = [content["populations"][index]]
    frame = {"sampling_rate": 1e5, "samples": 64, "pre_trigger": 8}
    return json.dumps({"name": "one", "sampling": frame, **{k: content[k] for k in ("impact", "populations")}})


@lru_cache(maxsize=_KEPT)
def _draws(text: str, n_draws: int) -> dict[str, Floats]:
    scene = parse_scene(json.loads(text))
    names = ("peak_force", "contact_duration", "restitution", "velocity")
    blocks = [one.parameters for one in draws(scene, _PRIOR_SEED, n_draws // BLOCK)]
    return {name: np.concatenate([block[name] for block in blocks]) for name in names}


def _joined(batches: Iterator[Batch], n_rows: int) -> Iterator[Batch]:
    """Yield the batches joined to at least this many signals, because larger batches are faster."""
    held: list[Batch] = []
    for batch in batches:
        held.append(batch)
        if sum(map(len, held)) >= n_rows:
            yield _one(held)
            held = []
    if held:
        yield _one(held)


def _one(held: list[Batch]) -> Batch:
    return replace(
        held[0],
        signals=np.concatenate([batch.signals for batch in held]),
        labels=np.concatenate([batch.labels for batch in held]),
        specimen=np.concatenate([batch.specimen for batch in held]),
        parameters={name: np.concatenate([batch.parameters[name] for batch in held]) for name in held[0].parameters},
    )


def _profiles(scene: Scene, batch: Batch, noise: Noise, knowledge: list[_Knowledge], n_nodes: int) -> list[Profile]:
    """Return the likelihood along the shape for each population.

    The populations share it, unless the restitution of one hardly varies: then each has its own nodes.
    """
    bounds = [k.prior.shape_bounds for k in knowledge]
    if min(high - low for low, high in bounds) > _NARROW:
        bounds = [(min(low for low, _ in bounds), max(high for _, high in bounds))] * len(bounds)
    # Clipped samples tell that the force was higher, which whitening cannot say.
    along = _along if scene.sensor.range is None else _along_clipped
    found = {(low, high): along(scene, batch, noise, low, high, n_nodes) for low, high in set(bounds)}
    return [found[bound] for bound in bounds]


def _along(scene: Scene, batch: Batch, noise: Noise, lowest: float, highest: float, n_nodes: int) -> Profile:
    onset, onset_between, response = _touch(scene, len(batch))
    sensor, peak = scene.sensor, batch.parameters["peak_force"]
    shift = (sensor.offset or 0.0) + (sensor.drift or 0.0) / batch.sampling_rate * np.arange(batch.signals.shape[1])
    frames = Frames(batch.signals - shift, peak, noise, float(scene.sampling.pre_trigger), onset, response)
    return profile_in(
        frames, _true(batch), lowest=lowest, highest=highest, n_nodes=n_nodes, onset_between=onset_between
    )


def _along_clipped(scene: Scene, batch: Batch, noise: Noise, lowest: float, highest: float, n_nodes: int) -> Profile:
    onset, onset_between, response = _touch(scene, len(batch))
    assert scene.sensor.range is not None
    return profile(
        batch.signals,
        _true(batch),
        noise.level(batch.parameters["peak_force"]),
        lowest=lowest,
        highest=highest,
        n_nodes=n_nodes,
        onset=onset,
        onset_between=onset_between,
        clip_level=np.full(len(batch), 0.999 * scene.sensor.range),
        response=response,
    )


def _true(batch: Batch) -> Floats:
    """Return the true pulses, (n, 5), near which the most likely ones are."""
    values, rate = batch.parameters, batch.sampling_rate
    duration, onset = values["contact_duration"] * rate, values["onset"] * rate
    return true_parameters(values["peak_force"], duration, onset, values["restitution"])


def _touch(scene: Scene, n: int) -> tuple[Floats | None, tuple[float, float] | None, Floats | None]:
    """Return the onsets if known, their bounds if not [samples], and the response of the sensor."""
    sampling, bandwidth = scene.sampling, scene.sensor.bandwidth
    touch = float(sampling.pre_trigger)
    response = None if bandwidth is None else low_pass_response(sampling.sampling_rate, bandwidth)
    if sampling.jitter == 0:
        return np.full(n, touch), None, response
    return None, (touch, touch + sampling.jitter), response


def _by_label(scene: Scene, truth: NDArray[np.str_], evidence: Floats, weights: Floats) -> Ceiling:
    # Without evidence, use the shares of the populations.
    evidence = np.where(np.isfinite(evidence).all(axis=1, keepdims=True), evidence, weights)
    top = evidence.max(axis=1, keepdims=True)
    share = np.exp(evidence - top)
    of_population = np.array([population.label for population in scene.populations])
    columns = [share[:, of_population == label].sum(axis=1) for label in scene.labels]
    probabilities = np.stack(columns, axis=1)
    return Ceiling(scene.labels, truth, probabilities / probabilities.sum(axis=1, keepdims=True))
