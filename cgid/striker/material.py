"""What struck where the material is known: Hertz' two scales give radius and speed, without a population."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from cgid.errors import InvalidValue
from cgid.measure.template import dimensionless_logarithms
from cgid.physics import RIGID, HalfSpace, RigidWall
from cgid.physics.materials import STEEL, Material
from cgid.striker.measured import MeasuredPulses
from cgid.striker.posterior import LEVELS, SPEED_POWER, TIME_POWER, Strikers
from cgid.validation import Floats

#: Step of the shape for slopes.
_STEP = 1e-3


def of_material(
    pulses: MeasuredPulses,
    material: Material,
    target: HalfSpace | RigidWall = HalfSpace(material=STEEL),  # noqa: B008
) -> Strikers:
    """Return radius, speed and mass of spheres of a known material.

    From `P0 = K L^(3/2)` and `T0 = L / v` with `K = 4/3 E* R^(1/2)` and `L = (m v^2 / K)^(2/5)`, which are linear in
    the logarithms; intervals by plain propagation of the covariance of the pulse.

    Parameters
    ----------
    pulses : MeasuredPulses
    material : Material
        Of the striker; single numbers.
    target : HalfSpace or RIGID
        What it struck; by default steel.

    Returns
    -------
    Strikers

    Raises
    ------
    InvalidValue
        The material has several values, or the target is neither a half space nor rigid.
    """
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
    found = {
        "radius": (log_radius, radius),
        "speed": (log_speed, speed),
        "mass": (density + 3 * log_radius, 3 * radius),
    }
    scores = np.array([NormalDist().inv_cdf(level) for level in LEVELS.tolist()])
    quantiles = {}
    for name, (middle, slope) in found.items():
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", slope, pulses.covariance, slope))
        spread = np.exp(middle[:, None] + deviation[:, None] * scores)
        quantiles[name] = np.where(pulses.usable[:, None], spread, np.nan)
    return Strikers(quantiles, pulses.problem)


def _scales(material: Material, target: HalfSpace | RigidWall) -> tuple[float, float]:
    """Return ln of 4/3 E* and of 4/3 pi rho."""
    if not isinstance(target, HalfSpace | RigidWall):
        raise InvalidValue(
            f"target must be a HalfSpace or RIGID to tell radius and speed by, got a {type(target).__name__}; "
            "take a population with this target"
        )
    compliance = np.asarray(material.plane_strain_compliance, np.float64)
    density = np.asarray(material.density, np.float64)
    if compliance.size != 1 or density.size != 1:
        raise InvalidValue(f"material must be one material, got {max(compliance.size, density.size)}; take one by one")
    if target is not RIGID and isinstance(target, HalfSpace):
        compliance = compliance + np.asarray(target.material.plane_strain_compliance, np.float64)
    return float(np.log(4 / 3 / compliance).ravel()[0]), float(np.log(4 / 3 * np.pi * density).ravel()[0])


def _observed(pulses: MeasuredPulses, shape: Floats) -> tuple[Floats, Floats]:
    """Return ln(P0 / T0^2) and ln T0 of pulses, if this were their shape."""
    log_peak, log_width = dimensionless_logarithms(shape, "peak", "width")
    time = pulses.log_width - log_width
    return pulses.log_peak - log_peak - 2 * time, time
