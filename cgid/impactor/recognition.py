"""The impactor from samples of forces or vibrations of a beam.

If the material is given, Hertz' two scales yield radius and speed without a population.
"""

from __future__ import annotations

from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib.validation import Floats, given_rate, require_rate
from cgid.errors import InvalidValue, MissingOption
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.identification.prediction.answers import factor_to
from cgid.impactor.estimation import estimate
from cgid.impactor.measured import MeasuredPulses
from cgid.impactor.population import impact_beam, population_of, uses_beam
from cgid.impactor.posterior import LEVELS, SPEED_POWER, TIME_POWER, ImpactorEstimates, ImpactorPopulation
from cgid.measure.features.extraction import BEAM_LEAD
from cgid.measure.features.pulses import PulseBatch
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.fit.template import dimensionless_logarithms
from cgid.measure.frames import DETECTION_LIMIT, frames_of
from cgid.physics.contact.bodies import RIGID, HalfSpace, RigidWall
from cgid.physics.contact.materials import STEEL, Material
from cgid.scene.file.schema import Scene, load_scene
from cgid.scene.file.sensor import Sensor
from cgid.signals import Batch, Signal, require_stated

#: Vibrations processed at once.
_ROWS = 256
#: Step of the shape for finite differences.
_STEP = 1e-3


def estimate_impactors(
    samples: ArrayLike | Signal | Batch,
    sampling_rate: float | None = None,
    among: str | Path | Scene | ImpactorPopulation | Material | None = None,
    *,
    target: HalfSpace | RigidWall = HalfSpace(material=STEEL),  # noqa: B008
    pre_trigger: int | None = None,
    **options: Any,
) -> ImpactorEstimates:
    """Estimate mass, radius and speed of the impactor, with intervals.

    A pulse does not determine radius, speed and modulus in one direction; the possible impactors determine it.

    Parameters
    ----------
    samples : array_like, (n_samples,) or (n_signals, n_samples), Signal or Batch
        One impact per row: forces [N], or for a scene with a beam and a sensor of motion its samples in the SI unit. A
        signal or batch states its unit, its rate and its samples before onset.
    sampling_rate : float, optional
        [Hz]; required for an array.
    among : str, Path, Scene, ImpactorPopulation or Material
        Possible impactors: a scene (a shipped one or a file), draws, or spheres of one material.
    target : HalfSpace or RIGID
        Target of a sphere of one material; a scene specifies it.
    pre_trigger : int, optional
        Samples before onset, as in `cgid.impactor.estimation.estimate`.
    **options
        Other arguments of `estimate`, for forces: noise, clip_level, bandwidth and others; ``invalid="raise"`` refuses
        a signal without impact.

    Returns
    -------
    ImpactorEstimates
        Nan, with the reason, without an estimate: a signal has no impact, the pulse is saturated, or the population
        contains no such impactor.

    Raises
    ------
    BadData
        Samples are not finite rows of numbers, or of another quantity.
    InvalidValue
        A number breaks its rule, or the scene has no population.
    MissingOption
        An array has no sampling rate, a signal no unit, or nothing says what the impactors may be.

    Examples
    --------
    An impact of 3 kN that lasts half a millisecond, by a ball of steel on steel:

    >>> time = np.arange(2000) / 200e3
    >>> blow = 3e3 * np.sin(np.pi * np.clip((time - 4e-3) / 0.5e-3, 0, 1)) ** 1.5
    >>> blow += np.random.default_rng(0).normal(0, 30, 2000)
    >>> found = estimate_impactors(blow, 200e3, Material(density=7850, youngs_modulus=210e9, poisson_ratio=0.3))
    >>> [round(float(x[0]), 2) for x in (found.median("mass"), *found.interval("mass", 0.95))]
    [3.6, 3.57, 3.62]
    """
    if isinstance(among, str | Path):
        among = load_scene(among)
    if isinstance(samples, Signal | Batch):
        require_stated(samples, sampling_rate)
        own, samples = samples, _in_si(samples, among.sensor if isinstance(among, Scene) else Sensor())
        sampling_rate = own.sampling_rate
        pre_trigger = own.pre_trigger if pre_trigger is None else pre_trigger
    sampling_rate = given_rate(samples, sampling_rate)
    if among is None:
        raise MissingOption("among: the possible impactors must be known; give a scene, as in among='reference'")
    if isinstance(among, Material):
        return of_material(_of_forces(samples, sampling_rate, pre_trigger, options), among, target)
    if isinstance(among, Scene):
        if uses_beam(among):
            if options:
                raise InvalidValue(f"{min(options)} is for forces, scene {among.name} has a beam; leave it out")
            frames = frames_of(samples, pre_trigger).astype(np.float64, copy=False)
            return population_of(among).posterior(through_beam(frames, sampling_rate, pre_trigger, impact_beam(among)))
        among = population_of(among)
    if not isinstance(among, ImpactorPopulation):
        raise InvalidValue(f"among must be a scene, draws or a material, got a {type(among).__name__}")
    return among.posterior(_of_forces(samples, sampling_rate, pre_trigger, options))


def _in_si(own: Signal | Batch, sensor: Sensor) -> NDArray[Any]:
    """Return the samples of a signal or batch in the unit of a sensor; raises for another quantity."""
    name, samples = (own.name, own.samples) if isinstance(own, Signal) else ("batch", own.signals)
    factor = factor_to(sensor, own.unit, name)
    return samples if factor == 1 else np.asarray(samples * factor)


def _of_forces(
    samples: ArrayLike, sampling_rate: float, pre_trigger: int | None, options: dict[str, Any]
) -> MeasuredPulses:
    options = {"pre_trigger": pre_trigger, "invalid": "nan"} | options
    return MeasuredPulses.of_estimates(estimate(samples, sampling_rate, **options))


def through_beam(
    frames: NDArray[np.floating],
    sampling_rate: float,
    pre_trigger: int | None,
    beam: ThroughBeam,
    detection_limit: float = DETECTION_LIMIT,
) -> MeasuredPulses:
    """Return the pulses of the contact forces that cause vibrations; a frame without an impact is not usable."""
    rate, parts = require_rate(sampling_rate), []
    detection_limit = max(detection_limit - BEAM_LEAD, 0.0)
    for first in range(0, max(len(frames), 1), _ROWS):
        part = np.asarray(frames[first : first + _ROWS], np.float64)
        batch = VibrationBatch(part, rate, pre_trigger, detection_limit=detection_limit)
        failed = {row: problem.text for row, problem in batch.problems().items()}
        # An empty frame would fail in the inversion: any other stands in for it.
        sound = np.delete(np.arange(len(part)), np.fromiter(failed, np.intp))
        if sound.size and failed:
            filled = part.copy()
            filled[list(failed)] = part[sound[0]]
            batch = VibrationBatch(filled, rate, pre_trigger, detection_limit=detection_limit)
        if sound.size:
            inverted, contact = beam.look(batch)
            parts.append(MeasuredPulses.of_contact(contact, inverted).without(failed))
        else:
            parts.append(MeasuredPulses.failed([failed[row] for row in range(len(part))]))
    return MeasuredPulses.joined(parts)


def forces(
    frames: NDArray[np.floating],
    sampling_rate: float,
    pre_trigger: int | None,
    detection_limit: float = DETECTION_LIMIT,
) -> MeasuredPulses:
    """Return the pulses of frames of force [N], as `through_beam`; a frame without an impact is not usable."""
    part = np.asarray(frames, np.float64)
    batch = PulseBatch(part, require_rate(sampling_rate), pre_trigger, detection_limit=detection_limit)
    return MeasuredPulses.of_frames(batch.uncoupled())


# -- spheres of a known material --------------------------------------------------------------------------


def of_material(
    pulses: MeasuredPulses,
    material: Material,
    target: HalfSpace | RigidWall = HalfSpace(material=STEEL),  # noqa: B008
) -> ImpactorEstimates:
    """Return radius, speed and mass of spheres of a known material on a half space or rigid wall."""
    # From `P0 = K L^(3/2)` and `T0 = L / v` with `K = 4/3 E* R^(1/2)` and `L = (m v^2 / K)^(2/5)`, linear in the
    # logarithms; intervals by propagation of the covariance of the pulse.
    pulses = pulses.widened()
    modulus, density = _scales(material, target)
    size_free, time = _observed(pulses, pulses.shape)
    log_speed = (size_free - 1.2 * modulus + 0.2 * density) / SPEED_POWER
    log_radius = time - 0.4 * (density - modulus) - TIME_POWER * log_speed
    later, sooner = (_observed(pulses, pulses.shape + side * _STEP) for side in (1, -1))
    in_shape = [(a - b) / (2 * _STEP) for a, b in zip(later, sooner, strict=True)]
    one = np.ones(len(pulses))
    speed = np.stack([one, -2 * one, in_shape[0]], axis=1) / SPEED_POWER
    radius = np.stack([0 * one, one, in_shape[1]], axis=1) - TIME_POWER * speed
    logarithms = {
        "radius": (log_radius, radius),
        "speed": (log_speed, speed),
        "mass": (density + 3 * log_radius, 3 * radius),
    }
    scores = np.array([NormalDist().inv_cdf(level) for level in LEVELS.tolist()])
    quantiles = {}
    for name, (middle, slope) in logarithms.items():
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", slope, pulses.covariance, slope))
        spread = np.exp(middle[:, None] + deviation[:, None] * scores)
        quantiles[name] = np.where(pulses.usable[:, None], spread, np.nan)
    return ImpactorEstimates(quantiles, pulses.problem)


def _scales(material: Material, target: HalfSpace | RigidWall) -> tuple[float, float]:
    """Return ln of 4/3 E* and of 4/3 pi rho."""
    if not isinstance(target, HalfSpace | RigidWall):
        raise InvalidValue(
            f"target must be a HalfSpace or RIGID to estimate radius and speed, got a {type(target).__name__}; "
            "use a population with this target"
        )
    compliance = np.asarray(material.plane_strain_compliance, np.float64)
    density = np.asarray(material.density, np.float64)
    if compliance.size != 1 or density.size != 1:
        raise InvalidValue(
            f"material must be one material, got {max(compliance.size, density.size)}; estimate one by one"
        )
    if target is not RIGID and isinstance(target, HalfSpace):
        compliance = compliance + np.asarray(target.material.plane_strain_compliance, np.float64)
    return float(np.log(4 / 3 / compliance).ravel()[0]), float(np.log(4 / 3 * np.pi * density).ravel()[0])


def _observed(pulses: MeasuredPulses, shape: Floats) -> tuple[Floats, Floats]:
    """Return ln(P0 / T0^2) and ln T0 of pulses for a given shape."""
    log_peak, log_width = dimensionless_logarithms(shape, "peak", "width")
    time = pulses.log_width - log_width
    return pulses.log_peak - log_peak - 2 * time, time
