"""The loss that gives a wanted restitution, where restitution is a result: A of a viscoelastic sphere, h of a plate.

(For Hunt-Crossley damping the answer is a closed form, `cgid.physics.restitution.damping_number`.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import InvalidValue
from cgid.physics.bodies import HalfSpace, ThinPlate, impedance_of_unit_thickness
from cgid.physics.curves import Curves
from cgid.physics.dissipation import Elastic
from cgid.physics.pulse import Impact
from cgid.validation import Floats

#: Values of zeta and of lambda between which the answer is sought: from no visible loss to restitutions of 1e-5, 1e-6.
_ZETA, _LAMBDA = (1e-17, 1e3), (1e-17, 15.0)


def dissipative_constant(restitution: ArrayLike, impact: Impact) -> Floats:
    """Return A of a viscoelastic sphere [s] with which an impact has the wanted restitution.

    Parameters
    ----------
    restitution : array_like
        Below 1, below what a thin plate leaves if the target is one, and above about 1e-5.
    impact : Impact
        Bodies, velocity and stiffness; its own dissipation is replaced.

    Returns
    -------
    ndarray
        For `Viscoelastic(dissipative_constant=...)`, of the shape of restitution and impact together.

    Raises
    ------
    InvalidValue
        The restitution cannot be reached.

    Examples
    --------
    >>> from cgid.physics import Elastic, HalfSpace, Sphere, Viscoelastic
    >>> from cgid.physics.materials import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     target=HalfSpace(material=STEEL), velocity=2.0, stiffness="hertz", dissipation=Elastic(),
    ... )  # fmt: skip
    >>> constant = dissipative_constant(0.8, impact)
    >>> round(float(replace(impact, dissipation=Viscoelastic(dissipative_constant=constant)).restitution), 12)
    0.8
    """
    validation.instance("impact", impact, Impact)
    elastic = replace(impact, dissipation=Elastic())

    def curves(zeta: Floats, rows: NDArray[np.intp]) -> Curves:
        return replace(elastic.curves.taken(rows), zeta=zeta)

    zeta = _sought(restitution, elastic, curves, _ZETA)
    return zeta * elastic.time_scale


def plate_thickness(restitution: ArrayLike, impact: Impact) -> Floats:
    """Return the thickness of a thin plate [m] with which an impact has the wanted restitution.

    Parameters
    ----------
    restitution : array_like
        Below what the material's own loss leaves (1 if it is elastic) and above about 1e-6.
    impact : Impact
        Its target is a thin plate, whose own thickness is replaced.

    Returns
    -------
    ndarray
        Of the shape of restitution and impact together.

    Raises
    ------
    InvalidValue
        The target is no thin plate, or the restitution cannot be reached.
    """
    validation.instance("impact", impact, Impact)
    validation.instance("impact.target", impact.target, ThinPlate)
    assert isinstance(impact.target, ThinPlate)
    on_half_space = replace(impact, target=HalfSpace(material=impact.target.material))

    def curves(inelasticity: Floats, rows: NDArray[np.intp]) -> Curves:
        return replace(on_half_space.curves.taken(rows), inelasticity=inelasticity)

    # lambda = m / (Z T0), and Z goes with the square of the thickness.
    inelasticity = _sought(restitution, on_half_space, curves, _LAMBDA)
    impedance = on_half_space.reduced_mass / (inelasticity * on_half_space.time_scale)
    return np.sqrt(impedance / impedance_of_unit_thickness(impact.target.material))


def _sought(
    restitution: ArrayLike,
    impact: Impact,
    curves: Callable[[Floats, NDArray[np.intp]], Curves],
    between: tuple[float, float],
) -> Floats:
    """Return the number, in the shape of restitution and impact, whose curves have the wanted restitution."""
    # Loaded here: everything else in this room does without scipy's optimisers.
    from scipy.optimize import elementwise

    wanted, lossless = validation.broadcast(
        restitution=validation.restitution("restitution", restitution), impact=impact.restitution
    )
    rows = np.broadcast_to(np.arange(impact.restitution.size).reshape(impact.restitution.shape), wanted.shape)

    def excess(logarithm: Floats, wanted: Floats, rows: NDArray[np.intp]) -> Floats:
        return curves(np.exp(logarithm).ravel(), rows.ravel()).rebound.reshape(wanted.shape) - wanted

    low, high = (np.full(wanted.shape, np.log(bound)) for bound in between)
    least = wanted + excess(high, wanted, rows)
    unreachable = (wanted >= lossless) | (wanted <= least)
    if unreachable.any():
        raise InvalidValue(
            f"restitution must lie between {least[unreachable][0]:.3g} and {lossless[unreachable][0]:.6g}, which the "
            f"impact has without this loss, got {wanted[unreachable][0]:g}"
        )
    found = np.asarray(elementwise.find_root(excess, (low, high), args=(wanted, rows)).x)
    # With gravity the restitution falls from some value straight to nothing: the sphere stays.
    missed = np.abs(excess(found, wanted, rows)) > 1e-9 * wanted
    if missed.any():
        last = wanted + excess(found - 1e-9, wanted, rows)
        raise InvalidValue(
            f"restitution must be {last[missed][0]:.3g} or more, for with more loss gravity holds the sphere on the "
            f"target, got {wanted[missed][0]:g}"
        )
    return np.asarray(np.exp(found))
