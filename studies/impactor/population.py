"""The population of a scene: random draws of its impacts with their pulses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.identification.inversion.inversion import ForceEstimate
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.measure.fit.template import relative_times
from cgid.measure.modal.beam import FINE, TOUCH, filtered, respond
from cgid.physics.contact.impact import Impact
from cgid.physics.structure.coupled import ModalImpact
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.synthesis.impacts import contacts_of, draws
from cgid.scene.synthesis.plan import Plan
from cgid.scene.synthesis.rocks import Rocks, arrivals_of, arriving, thrown_back
from cgid.scene.synthesis.through_beam import beam_of, full_beam
from studies.impactor.estimation import estimate
from studies.impactor.posterior import ImpactorPopulation

#: Number of draws if pulses follow from a formula, if pulses are fitted, and for a scene with a beam.
_MANY, _FEW, _FEWEST = 1 << 17, 1 << 15, 1 << 14
#: Samples of fitted pulses during contact, before it and in total; noise over the peak; arbitrary sampling rate [Hz].
_SAMPLES, _BEFORE, _FRAME, _NOISE, _RATE = 64, 32, 192, 1e-3, 1e5
#: Seed of these draws, unlikely to be chosen for the signals.
_SEED = 0x5EED_0003_C9D1
#: Number of cached populations (some 10 MB each) and beams (24 MB).
_CACHE_SIZE = 4
#: Locations on a beam at which draws are measured, fractions that fill its sides evenly (Roberts 2018), and their
#: energy over that of the noise.
_LOCATIONS, _EVENLY, _ENERGY = 64, (0.7548776662, 0.5698402910), 1e8


def population_of(scene: Scene | str | Path, n_draws: int | None = None) -> ImpactorPopulation:
    """Return the population of a scene, the prior of an impactor.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, a file, or a shipped one by name. In a stream all impacts count, including rebounds.
    n_draws : int, optional
        By default 131,072 if a formula gives the pulses, else 32,768, with a beam 16,384.

    Returns
    -------
    ImpactorPopulation

    Raises
    ------
    InvalidValue
        The scene has no impacts of spheres, or draws its rig.
    """
    # A file may change, a scene does not.
    return _drawn(load_scene(scene), n_draws)


@lru_cache(maxsize=_CACHE_SIZE)
def _drawn(scene: Scene, n_draws: int | None) -> ImpactorPopulation:
    if scene.randomise is not None:
        raise InvalidValue(f"scene {scene.name}: must have fixed settings to estimate impactors; take [randomise] out")
    if not scene.populations:
        raise InvalidValue(f"scene {scene.name}: must have populations to estimate impactors, it has only taps")
    of_family = set(scene.dissipations) <= {"hunt-crossley", "elastic"}
    # Only the sphere has a length or time scale.
    similar = scene.tail_beam is None and scene.impact.gravity is None
    similar &= getattr(scene.impact.target, "thickness", None) is None
    # Each pulse is then a member of the family, with the stored peak, duration and restitution.
    plain = of_family and similar and scene.stream is None
    beam = impact_beam(scene) if uses_beam(scene) else None
    n_required = n_draws or (_MANY if plain else _FEW if scene.tail_beam is None else _FEWEST)
    parts: list[dict[str, Floats]] = []
    blocks = _stream(scene) if scene.stream is not None else _frames(scene)
    while sum(part["radius"].size for part in parts) < n_required:
        values, pulses = next(blocks)
        parts.append(_described(values, None if plain else pulses, beam))
    columns = {name: np.concatenate([part[name] for part in parts])[:n_required] for name in parts[0]}
    return ImpactorPopulation(
        log_peak=columns["log_peak"],
        log_width=columns["log_width"],
        shape=columns["shape"],
        log_radius=np.log(columns["radius"]),
        log_speed=np.log(columns["velocity"]),
        log_mass=np.log(4 / 3 * np.pi * columns["density"]) + 3 * np.log(columns["radius"]),
        group=columns["group"].astype(np.intp),
        similar=similar,
        of_family=of_family,
        name=f"scene {scene.name}",
    )


#: Rows of a block, and their pulses.
_Pulses = list[tuple[NDArray[np.intp], Impact | ModalImpact]]


def _frames(scene: Scene) -> Iterator[tuple[Mapping[str, Any], _Pulses]]:
    """Yield the impacts of frames, block by block, and their pulses."""
    labels = {label: k for k, label in enumerate(scene.labels)}
    for impacts in draws(scene, _SEED):
        group = np.array([labels[str(one)] for one in impacts.labels])
        values = {**impacts.parameters, "group": group}
        is_impact = np.isfinite(values["radius"])
        pulses: _Pulses = [
            (one.rows, one.pulses)
            for one in impacts.strikes
            if one.ratio is None and isinstance(one.pulses, Impact | ModalImpact)
        ]
        values["struck"] = is_impact
        yield values, pulses


def _stream(scene: Scene) -> Iterator[tuple[Mapping[str, Any], _Pulses]]:
    """Yield the impacts of streams, rebound by rebound, and their pulses."""
    pulse_plan = Plan(scene=scene, kind="pulses")
    assert scene.stream is not None
    number = 0
    while True:
        for stretch in arrivals_of(scene.stream).stretches(scene.stream.duration, _SEED, number):
            rocks = arriving(scene, stretch, 0, _SEED, number)
            while len(rocks):
                values = {**rocks.columns, "group": rocks["population"], "struck": np.ones(len(rocks), bool)}
                pulses = _of_rocks(pulse_plan, rocks)
                delivered = {name: np.empty(len(rocks)) for name in ("restitution", "contact_duration", "peak_force")}
                for rows, one in pulses:
                    for name, column in delivered.items():
                        column[rows] = getattr(one, name)
                yield {**values, **delivered}, pulses
                if scene.stream.rebounds is None:
                    break
                loud = np.ones(len(rocks), bool)
                rocks = thrown_back(scene, rocks, delivered["restitution"], delivered["contact_duration"], loud)
        number += 1


def _of_rocks(pulse_plan: Plan, rocks: Rocks) -> _Pulses:
    return list(contacts_of(pulse_plan, rocks.columns, np.arange(len(rocks))))


def _described(values: Mapping[str, Any], pulses: _Pulses | None, beam: ThroughBeam | None) -> dict[str, Floats]:
    """Return impactors and pulses of a block; without pulses, these follow from peak, duration and restitution."""
    names = ("radius", "velocity", "density", "group")
    if pulses is None:
        rows = np.flatnonzero(values["struck"])
        shape = np.log(np.maximum(values["restitution"][rows], 1e-3))
        width = values["contact_duration"][rows] / relative_times(shape)[0]
        columns = {"log_peak": np.log(values["peak_force"][rows]), "log_width": np.log(width), "shape": shape}
        return columns | {name: values[name][rows] for name in names}
    parts: list[dict[str, Floats]] = []
    for rows, one in pulses:
        lasts, peak = values["contact_duration"][rows], values["peak_force"][rows]
        log_peak, log_width, shape = _fitted(one, lasts, peak) if beam is None else fit_through_beam(one, peak, beam)
        columns = {"log_peak": np.log(peak) + log_peak, "log_width": log_width, "shape": shape}
        parts.append(columns | {name: values[name][rows] for name in names})
    return {name: np.concatenate([part[name] for part in parts]) for name in (*names, "log_peak", "log_width", "shape")}


def _fitted(pulses: Impact | ModalImpact, lasts: Floats, peak: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the result of the fit to forces of pulses: ln peak over the true one, ln width, and shape."""
    force = np.zeros((peak.size, _FRAME))
    pulses.add_to_frames(force, _SAMPLES / lasts, _BEFORE * lasts / _SAMPLES)
    estimates = estimate(force / peak[:, None], _RATE, pre_trigger=_BEFORE, noise=_NOISE)
    shape = np.log(estimates.restitution)
    width = estimates.contact_duration * _RATE / _SAMPLES * lasts / relative_times(shape)[0]
    return np.log(estimates.peak), np.log(width), shape


def fit_through_beam(pulses: Impact | ModalImpact, peak: Floats, beam: ThroughBeam) -> tuple[Floats, Floats, Floats]:
    """Return the result of the fit through a beam, as `_fitted`."""
    # Waves of the beam that return during contact change the pulses of heavy rocks; the closest pulse of the family
    # then depends on the frequencies that the beam transmits.
    rate, shapes = beam.beam.sampling_rate, beam.inversion.forces
    order = np.arange(peak.size)
    force = np.zeros((peak.size, shapes.shape[1]))
    pulses.add_to_frames(force, FINE * rate, (order + 0.5) / peak.size * TOUCH / rate)
    filtered_force = filtered(beam.beam, force / peak[:, None])
    coefficients = np.asarray(np.linalg.solve(shapes @ shapes.T, shapes @ filtered_force.T).T, np.float64)
    information = _information(beam)[order % _LOCATIONS]
    vector = np.einsum("nij,nj->ni", information, coefficients)
    louder = _ENERGY / np.einsum("ni,ni->n", vector, coefficients)
    information, vector = information * louder[:, None, None], vector * louder[:, None]
    one, pair = np.ones(peak.size), np.ones((peak.size, 2))
    fitted = beam.fit.fit(
        ForceEstimate(one, one, pair, order, coefficients, information, vector, one, one, one, one, one)
    )
    return np.log(fitted.peak), np.log(fitted.width), fitted.shape


@lru_cache(maxsize=_CACHE_SIZE)
def _information(beam: ThroughBeam) -> Floats:
    """Return the information of samples about forces at locations all over a beam, (_PLACES, n_shapes, n_shapes)."""
    inversion, region = beam.inversion, beam.beam.region.reshape(2, 2)
    table = inversion.transformed(respond(beam.beam, inversion.forces, inversion.n_samples))
    even = np.outer(_EVENLY, np.arange(1, _LOCATIONS + 1)) % 1
    at = beam.beam.weights(*(region[:, :1] + np.diff(region) * even))[0]
    responses = np.tensordot(at, table, (1, 0))
    return np.asarray(responses @ responses.transpose(0, 2, 1), np.float64)


def uses_beam(scene: Scene) -> bool:
    """Return whether a scene measures its impacts through a beam."""
    return scene.tail_beam is not None and scene.sensor.quantity != "force"


@lru_cache(maxsize=_CACHE_SIZE)
def impact_beam(scene: Scene) -> ThroughBeam:
    """Return the beam of a scene, with the region where rocks bounce; raises `InvalidValue` as `beam_of`."""
    return ThroughBeam(beam_of(scene) if scene.stream is None else full_beam(scene))
