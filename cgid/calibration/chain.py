"""The filter of a recorder and the mounting of a sensor, from impacts at unknown locations with unknown forces.

A wrong filter leaves nothing of a vibration unexplained: the recovered force takes up the difference, and has a shape
that no contact has. So forces are recovered in shapes that hold those of all filters, once, in one band, and the pulse
family is fitted to them through one chain after the other. Gauss-Newton steps in the logarithms of edge, mounting and
its damping minimise what the pulses leave, with the pulses projected out; the order of a Butterworth filter, or the
transition of one of linear phase, is tried.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh

from cgid._lib.validation import Floats
from cgid.calibration.learning import ImpactFrames
from cgid.identification.inversion.contact import Contact, ContactFit
from cgid.identification.inversion.inversion import ForceEstimate, Inversion
from cgid.measure.modal.beam import Beam, filtered
from cgid.physics.structure.response import LinearPhase, LowPass, Resonance
from cgid.scene.file.schema import Scene, parse_scene
from cgid.scene.synthesis.through_beam import contact_forces, linear_phase_of

#: Number of impacts, and of shapes of all filtered forces; every so many forces make them, through filters of these
#: edges and mountings (in sampling rates) and orders.
_IMPACTS, _SHAPES, _EVERY = 60, 44, 12
#: Number of impacts whose forces are compared with pulses, and least number of short ones.
_COMPARED, _FEWEST = 128, 10
_SHAPED = (4, 8, 2, 6, 4, 0.1, 8, 2, 6, 4, 8, 0.4)
_CHAINS = tuple(zip(np.geomspace(0.2, 0.49, 12).tolist(), np.geomspace(1.6, 0.35, 12).tolist(), _SHAPED, strict=True))
#: Lowest and highest edge and mounting (in sampling rates) and damping ratio, and deviations of their logarithms. A
#: damped mounting would stand for any filter.
_LIMITS, _PRIOR = np.log([[0.12, 0.22, 0.01], [0.495, 3.2, 0.15]]), np.array([0.3, 0.3, 0.3])
#: A mounting that nobody stated, and one near the band (in sampling rates); damping of the former.
_STIFF, _SOFT, _DAMPING = 1.6, 0.43, 0.05
#: Filters that are tried first: orders, and transitions of a linear phase; all orders, and factors between transitions.
_FIRST, _ALL_ORDERS, _WIDER = (4, 8, 0.2), range(2, 13), 1.5
#: Delay of a linear phase in shapes that hold every filter [samples].
_DELAY = 3.0
#: Steps of a first try and of the best, and tries of each; they end where they gain less log-likelihood. Longest step,
#: and difference quotients in a logarithm.
_TRIED, _STEPS, _CAUTIOUS, _MIN_GAIN, _LONGEST, _STEP = 5, 12, 6, 0.05, 0.25, 1e-3
#: Ranges of ln width, shape and onset of a pulse, their longest step, prior mean and deviation of shape and onset.
_PULSES = np.array([[np.log(25e-6), np.log(0.06), -2.0], [np.log(1.6e-3), 1.2, 9.0]])
_LONGEST_OF_PULSE, _PULSE_PRIOR = 0.3, np.array([[-0.9, 3.5], [1.5, 3.5]])
#: Keys of a sensor, and the narrowest transition that is tried.
_EDGE, _TRANSITIONS = "anti_alias.frequency", (0.05, 1.0)
_LINEAR_KEYS = ("anti_alias.kind", _EDGE, "anti_alias.transition")
#: Parts of a chain that may be exact.
PARTS = ("sensor", "filter", "mounting")
#: A chain is kept where the share of the force outside of the pulse family is below this one, or does not fall to half.
SOUND, _FALLS_TO = 0.01, 0.5


@dataclass(frozen=True)
class SensorChain:
    """A recorder's filter and a sensor's mounting."""

    steep: float | None  # order of a Butterworth filter, or transition (below or at 1) of a linear phase; None without
    logs: Floats  # (3,), of the edge and of the mounting [Hz], and of its damping ratio

    @classmethod
    def of(cls, scene: Scene) -> SensorChain:
        """Return the chain of a scene; a mounting that it does not state is stiff."""
        sensor, rate = scene.sensor, scene.sampling.sampling_rate
        edge, steep = rate, None
        if sensor.anti_alias is not None:
            part = sensor.anti_alias.filter
            edge, steep = part.frequency, part.transition if isinstance(part, LinearPhase) else part.order
        mounting = (_STIFF * rate, _DAMPING)
        if sensor.mounting is not None:
            mounting = (sensor.mounting.frequency, sensor.mounting.damping_ratio)
        return cls(steep, np.log([edge, *mounting]))

    def behind(self, beam: Beam) -> Beam:
        """Return a beam with this chain."""
        edge, mounting, damping = np.exp(self.logs).tolist()
        poles, linear = [Resonance(frequency=mounting, damping_ratio=damping).poles], None
        if self.steep is not None and self.linear:
            linear = linear_phase_of(LinearPhase(frequency=edge, transition=self.steep), _DELAY / beam.sampling_rate)
        elif self.steep is not None:
            poles.append(LowPass(frequency=edge, order=int(self.steep)).poles)
        return replace(beam, filters=np.concatenate(poles), linear_phase=linear)

    @property
    def linear(self) -> bool:
        """Whether the filter has a linear phase."""
        return self.steep is not None and self.steep <= 1

    def moved(self, step: Floats) -> SensorChain:
        """Return the chain with other logarithms."""
        return replace(self, logs=self.logs + step)

    @property
    def others(self) -> list[float]:
        """The filters beside this one: other orders, or other transitions."""
        if self.steep is None:
            return []
        if self.linear:
            return [
                one
                for one in (round(self.steep / _WIDER, 4), round(self.steep * _WIDER, 4))
                if _TRANSITIONS[0] <= one <= 1
            ]
        return [order for order in (self.steep + step for step in (-2, -1, 1, 2)) if order in _ALL_ORDERS]

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of the sensor that state this chain."""
        edge, mounting, damping = np.exp(self.logs).tolist()
        found = {"mounting.frequency": mounting, "mounting.damping_ratio": damping}
        if self.linear:
            return found | dict(zip(_LINEAR_KEYS, ("linear-phase", edge, self.steep), strict=True))
        return found | ({} if self.steep is None else {_EDGE: edge, "anti_alias.order": int(self.steep)})

    def placed(self, scene: Scene) -> Scene:
        """Return a scene with this chain."""
        content = json.loads(scene.text)
        if self.steep is not None:
            content["sensor"].pop("anti_alias", None)
        for name, value in self.keys.items():
            part, key = name.split(".")
            content["sensor"][part] = (content["sensor"].get(part) or {}) | {key: value}
        return parse_scene(content, source=f"another recorder of {scene.name}", folder=scene.folder)


def learn_chain(scene: Scene, beam: Beam, impacts: ImpactFrames, exact: Collection[str]) -> SensorChain | None:
    """Return the chain that makes the forces of impacts those of contacts; None if that of the scene does."""
    stated, rate = SensorChain.of(scene), scene.sampling.sampling_rate
    free = np.array(["filter" not in exact and stated.steep is not None, *2 * ["mounting" not in exact]])
    if not free.any():
        return None
    impacts = impacts.taken(slice(_IMPACTS))
    stated_beam = Inversion(beam)
    if outside(stated_beam, stated_beam.settle(impacts.observations(), impacts.start)) < SOUND:
        return None
    inversion = Inversion(_with_every_filter(scene, beam))
    estimate = inversion.settle(impacts.observations(), impacts.start)
    before = _median(ContactFit(inversion, _brief(beam)).fit(estimate))
    soft = stated.logs.copy()
    soft[1] = np.log(_SOFT * rate)
    starts = [stated.logs, soft] if free[1] else [stated.logs]
    low, high = _LIMITS + np.log([rate, rate, 1.0])
    limits = np.array([np.minimum(low, stated.logs), np.maximum(high, stated.logs)])
    search = _Search(inversion, estimate, stated.logs, free, limits)
    filters = sorted({stated.steep, *_FIRST}) if free[0] and stated.steep is not None else [stated.steep]
    tried = search.tried(SensorChain(steep, logs) for logs in starts for steep in filters)
    best = min(tried, key=lambda one: one.cost)
    known = {one.chain.steep for one in tried}
    while True:
        best = search.descended(best.chain, best.pulses, _STEPS)
        others = [one for one in best.chain.others if free[0] and one not in known]
        known |= set(others)
        tried = search.tried(replace(best.chain, steep=one) for one in others)
        better = min(tried, key=lambda one: one.cost, default=best)
        if better.cost >= best.cost:
            break
        best = better
    after = _median(ContactFit(inversion, best.chain.behind(beam)).fit(estimate))
    return best.chain if after <= _FALLS_TO * before else None


def _brief(beam: Beam) -> Beam:
    """Return a beam whose filter of linear phase comes as soon as those that are tried."""
    if beam.linear_phase is None:
        return beam
    return replace(beam, linear_phase=np.minimum(beam.linear_phase, [np.inf, np.inf, _DELAY / beam.sampling_rate]))


def outside(inversion: Inversion, estimate: ForceEstimate) -> float:
    """Return the median share of some recovered forces outside of the pulse family; 0 of long pulses."""
    return _median(ContactFit(inversion).fit(estimate.rows(slice(_COMPARED))))


def _median(contact: Contact) -> float:
    shares = contact.outside[np.isfinite(contact.outside)]
    return float(np.median(shares)) if shares.size >= _FEWEST else 0.0


def _with_every_filter(scene: Scene, beam: Beam) -> Beam:
    """Return a beam without filters, whose shapes hold those of contact forces behind any filter."""
    forces, rate = contact_forces(scene)[::_EVERY], beam.sampling_rate
    chains = (SensorChain(steep, np.log([edge * rate, mounting * rate, _DAMPING])) for edge, mounting, steep in _CHAINS)
    behind = np.concatenate([filtered(chain.behind(beam), forces) for chain in chains])
    n_points = behind.shape[1]
    power, shapes = eigh(behind.T @ behind, subset_by_index=(n_points - _SHAPES, n_points - 1))
    deviations = np.sqrt(power[::-1] / len(behind))
    return replace(
        beam, filters=np.empty(0, complex), linear_phase=None, shapes=shapes.T[::-1].copy(), deviations=deviations
    )


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Pulses fitted through a chain: `ways` are those of peak 1 and their slopes, `left` (n,) the chi-square."""

    chain: SensorChain
    pulses: Floats  # (n, 3), ln width, shape and onset [samples]
    peak: Floats
    ways: Floats  # (n, 4, n_shapes), times the peak
    left: Floats
    cost: float


class _Search:
    """Chains and pulses by Gauss-Newton steps; `free` (3,) tells which logarithms move, between `limits` (2, 3)."""

    def __init__(
        self, inversion: Inversion, estimate: ForceEstimate, stated: Floats, free: Floats, limits: Floats
    ) -> None:
        self._inversion, self._estimate, self._stated, self._limits = inversion, estimate, stated, limits
        self._free, self._n_free = np.flatnonzero(free), max(estimate.vector.shape[1] - 4, 1)

    def descended(self, chain: SensorChain, pulses: Floats, n_steps: int) -> _Fitted:
        """Return the best chain near one, of the same order."""
        now, caution = self._fitted(chain, pulses, 3), 1e-3
        for _ in range(n_steps):
            curvature, pull = self._equations(now)
            for _ in range(_CAUTIOUS):
                step = np.zeros(3)
                damped = curvature + caution * np.diag(np.diag(curvature))
                step[self._free] = np.linalg.solve(damped, pull).clip(-_LONGEST, _LONGEST)
                logs = np.clip(now.chain.logs + step, *self._limits)
                other = self._fitted(replace(now.chain, logs=logs), now.pulses, 2)
                if other.cost < now.cost:
                    break
                caution *= 10
            else:
                return now
            gain, now, caution = now.cost - other.cost, other, max(caution / 10, 1e-5)
            if gain < _MIN_GAIN:
                break
        return now

    def tried(self, chains: Iterable[SensorChain]) -> list[_Fitted]:
        """Return the best chains near some."""
        return [self.descended(chain, self._anew(chain), _TRIED) for chain in chains]

    def _anew(self, chain: SensorChain) -> Floats:
        """Return the pulses through a chain, from the start: those through another one may be in another valley."""
        contact = ContactFit(self._inversion, chain.behind(self._inversion.beam)).fit(self._estimate)
        pulses = np.column_stack([np.log(contact.width), contact.shape, contact.touch])
        return np.asarray(np.clip(pulses, *_PULSES))

    def _fitted(self, chain: SensorChain, pulses: Floats, n_steps: int) -> _Fitted:
        """Return the pulses that fit best through a chain, near some."""
        fit = ContactFit(self._inversion, chain.behind(self._inversion.beam))
        peak, ways, left = self._through(fit, pulses)
        for _ in range(n_steps):
            curvature, pull = self._of_pulses(ways, peak, pulses)
            step = np.linalg.solve(curvature, pull[:, :, None])[:, 1:, 0]
            other = np.clip(pulses + step.clip(-_LONGEST_OF_PULSE, _LONGEST_OF_PULSE), *_PULSES)
            found = self._through(fit, other)
            better = found[2] < left
            pulses = np.where(better[:, None], other, pulses)
            peak, left = np.where(better, found[0], peak), np.where(better, found[2], left)
            ways = np.where(better[:, None, None], found[1], ways)
        # As if deviations of single impacts differed: strong ones, or two at once, do not decide alone.
        likely = 0.5 * self._n_free * np.log1p(left / self._n_free).sum()
        away = (chain.logs - self._stated) / _PRIOR
        return _Fitted(chain, pulses, peak, ways, left, float(likely + 0.5 * away @ away))

    def _through(self, fit: ContactFit, pulses: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the best peaks of pulses, their coefficients with the slopes, and their chi-square."""
        estimate = self._estimate
        own, slopes = fit.exact_coefficients(pulses)
        power = np.einsum("nk,nkl,nl->n", own, estimate.information, own)
        peak = np.maximum(np.einsum("nk,nk->n", own, estimate.vector), 1e-12) / np.maximum(power, 1e-30)
        ways = np.concatenate([own[:, None], slopes], axis=1) * peak[:, None, None]
        spacing = estimate.coefficients - ways[:, 0]
        return peak, ways, np.einsum("nk,nkl,nl->n", spacing, estimate.information, spacing)

    def _of_pulses(self, ways: Floats, peak: Floats, pulses: Floats) -> tuple[Floats, Floats]:
        """Return the curvature of each impact in its pulse, with the prior, and the gradient."""
        estimate, (mean, deviation) = self._estimate, _PULSE_PRIOR
        left = estimate.vector - np.einsum("nkl,nl->nk", estimate.information, ways[:, 0])
        curvature = ways @ estimate.information @ ways.transpose(0, 2, 1)
        pull = np.einsum("nik,nk->ni", ways, left)
        curvature[:, [2, 3], [2, 3]] += deviation**-2
        curvature[:, range(4), range(4)] *= 1 + 1e-6
        pull[:, 2:] -= (pulses[:, 1:] - mean) / deviation**2
        return curvature, pull

    def _equations(self, now: _Fitted) -> tuple[Floats, Floats]:
        """Return curvature and gradient in the free logarithms, with the pulses projected out."""
        estimate = self._estimate
        slopes = np.stack(list(self._slopes(now)), axis=1)
        curvature, pull = self._of_pulses(now.ways, now.peak, now.pulses)
        left = estimate.vector - np.einsum("nkl,nl->nk", estimate.information, now.ways[:, 0])
        informed = slopes @ estimate.information
        cross = now.ways @ informed.transpose(0, 2, 1)
        through = np.linalg.solve(curvature, np.concatenate([cross, pull[:, :, None]], axis=2))
        back = cross.transpose(0, 2, 1) @ through
        weight = 1 / (1 + now.left / self._n_free)
        whole = np.einsum("n,nij->ij", weight, informed @ slopes.transpose(0, 2, 1) - back[:, :, :-1])
        gradient = weight @ (np.einsum("nik,nk->ni", slopes, left) - back[:, :, -1])
        prior = _PRIOR[self._free] ** -2
        return whole + np.diag(prior), gradient - (now.chain.logs - self._stated)[self._free] * prior

    def _slopes(self, now: _Fitted) -> Iterator[Floats]:
        """Yield the slopes of the coefficients in each free logarithm, (n, n_shapes)."""
        for number in self._free:
            step = np.zeros(3)
            step[number] = _STEP
            above, below = (
                ContactFit(
                    self._inversion, now.chain.moved(sign * step).behind(self._inversion.beam)
                ).exact_coefficients(now.pulses)[0]
                for sign in (1, -1)
            )
            yield (above - below) / (2 * _STEP) * now.peak[:, None]
