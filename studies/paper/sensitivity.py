"""Sensitivity of peak force and displacement to the parameters of an impact, and the loss for a given restitution.

There are two measures of sensitivity. The local one, `d ln P / d ln X`, is the percentage change of the response for a
1 % change of the parameter: a property of the impact alone. The influence over a range, as in Yang, Zeng & Wan (2018),
section 4, varies one parameter over a range and fixes the others: it depends as much on the range as on the impact.

Where restitution is a result (viscoelastic sphere, thin plate), `dissipative_constant` and `plate_thickness` invert it.
For Hunt-Crossley damping the inverse has a closed form, `cgid.physics.damping_number`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics import Elastic, HuntCrossley, Impact, Material, Thornton, Viscoelastic
from cgid.physics.contact.bodies import HalfSpace, RigidWall, ThinPlate, impedance_of_unit_thickness
from cgid.physics.contact.curves import Curves
from cgid.physics.contact.plastic import thornton_curves

#: Parameters of the sphere and of the half space, with their units.
PARAMETERS = {
    "radius": "m",
    "density": "kg/m^3",
    "youngs_modulus": "Pa",
    "poisson_ratio": "",
    "target_youngs_modulus": "Pa",
    "target_poisson_ratio": "",
}
_OF_TARGET = "target_"
#: Search bounds of zeta, lambda and L over yield displacement: from negligible loss to restitutions of 1e-5 or 1e-6.
_ZETA, _LAMBDA, _OVER_DEPTH = (1e-17, 1e3), (1e-17, 15.0), (0.9, 1e16)
#: Tolerance of the curves during the search.
_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Sensitivity:
    """Dimensionless effect of each parameter on both responses of an impact.

    Parameters
    ----------
    peak_force, peak_displacement : dict of str to ndarray
        By parameter name; a rigid wall has no target parameters.
    """

    peak_force: dict[str, Floats]
    peak_displacement: dict[str, Floats]


def local_sensitivity(impact: Impact) -> Sensitivity:
    """Return `d ln P_max / d ln X` and `d ln delta_max / d ln X` for every parameter X, in closed form.

    With the fraction `s_i = c_i / (c_1 + c_2)` of each body in the compliance, `c_i = (1 - nu_i^2) / E_i`, they follow
    from `P ~ R^2 rho^(3/5) c^(-2/5)` and `delta ~ R rho^(2/5) c^(2/5)` (Yang, Zeng & Wan 2018, Eq. 17-18): R: 2 and 1;
    rho: 3/5 and 2/5; E_i: 2/5 s_i and -2/5 s_i; nu_i: 4/5 s_i nu_i^2 / (1 - nu_i^2) and its negative. Stiffness theory,
    velocity and restitution cancel if held constant.

    Parameters
    ----------
    impact : Impact
        Elastic or Hunt-Crossley, without gravity, of a sphere on a half space or a rigid wall; of any shape.

    Returns
    -------
    Sensitivity
        Each value has the broadcast shape of sphere and target.

    Raises
    ------
    InvalidValue
        Other dissipations and targets, and gravity: these have other exponents.

    Examples
    --------
    >>> from cgid.physics import Elastic, HalfSpace, Impact, Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=HalfSpace(material=STEEL),
    ...     velocity=2.0, stiffness="hertz", dissipation=Elastic(),
    ... )
    >>> for name, value in local_sensitivity(impact).peak_force.items():
    ...     print(f"{name} {value:.4f}")
    radius 2.0000
    density 0.6000
    youngs_modulus 0.3958
    poisson_ratio 0.0673
    target_youngs_modulus 0.0042
    target_poisson_ratio 0.0008
    """
    validation.instance("impact", impact, Impact)
    if not isinstance(impact.dissipation, Elastic | HuntCrossley):
        raise InvalidValue(
            "dissipation must be Elastic or HuntCrossley for local sensitivities, got "
            f"{type(impact.dissipation).__name__}; range_influence works for any"
        )
    if np.any(impact.gravity):
        raise InvalidValue("gravity must be 0 for local sensitivities; range_influence works for any")
    materials = _materials(impact)
    shape = np.broadcast_shapes(*(np.shape(value) for value in parameters_of(impact).values()))
    total = sum(material.plane_strain_compliance for material in materials.values())
    force: dict[str, ArrayLike] = {"radius": 2.0, "density": 0.6}
    displacement: dict[str, ArrayLike] = {"radius": 1.0, "density": 0.4}
    for body, material in materials.items():
        fraction = material.plane_strain_compliance / total
        square = np.square(np.asarray(material.poisson_ratio, np.float64))
        force[f"{body}youngs_modulus"] = 0.4 * fraction
        force[f"{body}poisson_ratio"] = 0.8 * fraction * square / (1 - square)
        for name in (f"{body}youngs_modulus", f"{body}poisson_ratio"):
            displacement[name] = -np.asarray(force[name])
    return Sensitivity(_filled(force, shape), _filled(displacement, shape))


def range_influence(impact: Impact, ranges: Mapping[str, ArrayLike]) -> Sensitivity:
    """Return the effect of each range on the responses, `largest / smallest - 1`, with the other parameters fixed.

    Parameters
    ----------
    impact : Impact
        The single reference impact; any dissipation.
    ranges : mapping of str to array_like, (n_values,)
        Values of each varied parameter of `PARAMETERS`, in its unit.

    Returns
    -------
    Sensitivity of scalars, 0 or more

    Raises
    ------
    InvalidValue
        As for `response_grid`.

    Examples
    --------
    >>> from cgid.physics import Elastic, HalfSpace, Impact, Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=HalfSpace(material=STEEL),
    ...     velocity=2.0, stiffness="hertz", dissipation=Elastic(),
    ... )
    >>> found = range_influence(impact, {"radius": [0.02, 0.04], "density": [1000, 3400]})
    >>> print(f"{found.peak_force['radius']:.4f} {found.peak_force['density']:.4f}")
    3.0000 1.0840
    """
    validation.instance("impact", impact, Impact)
    validation.instance("ranges", ranges, Mapping)
    grids = {name: response_grid(impact, {name: values}) for name, values in ranges.items()}
    return Sensitivity(
        {name: _spread(grid.peak_force) for name, grid in grids.items()},
        {name: _spread(grid.peak_displacement) for name, grid in grids.items()},
    )


def response_grid(impact: Impact, parameters: Mapping[str, ArrayLike]) -> Impact:
    """Return the impacts over a grid of parameters: one parameter gives a curve, two a response surface.

    Parameters
    ----------
    impact : Impact
        The single reference impact; any dissipation.
    parameters : mapping of str to array_like, (n,)
        Values of parameters of `PARAMETERS`, in their units; each is an axis of the grid, in this order.

    Returns
    -------
    Impact of shape (n_first, n_second, ...)

    Raises
    ------
    InvalidValue
        The impact is not a single one, its target is neither a half space nor a rigid wall, a parameter is unknown or
        missing in this impact, or a value is invalid.

    Warns
    -----
    HertzRangeWarning
        The displacement exceeds a tenth of the radius somewhere on the grid.

    Examples
    --------
    >>> from cgid.physics import RIGID, Elastic, Impact, Sphere
    >>> from cgid.physics import YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025), target=RIGID,
    ...     velocity=2.0, stiffness="hertz", dissipation=Elastic(),
    ... )
    >>> response_grid(impact, {"radius": [0.02, 0.04], "density": [1200, 1800, 2400]}).peak_force.shape
    (2, 3)
    """
    validation.instance("impact", impact, Impact)
    validation.instance("parameters", parameters, Mapping)
    parameters_held = parameters_of(impact)
    if not parameters:
        raise InvalidValue("parameters must name at least one of " + ", ".join(parameters_held))
    if impact.peak_force.ndim:
        raise InvalidValue(f"impact must be a single one, its numbers have shape {impact.peak_force.shape}")
    axes: dict[str, Floats] = {}
    for name, values in parameters.items():
        validation.choice("parameter", name, tuple(parameters_held))
        axes[name] = validation.real(name, values, PARAMETERS[name])
        if axes[name].ndim != 1 or axes[name].size == 0:
            raise InvalidValue(f"{name} must be a row of values, got shape {axes[name].shape}")
    grids = np.meshgrid(*axes.values(), indexing="ij")
    return _changed(impact, {**parameters_held, **dict(zip(axes, grids, strict=True))})


def _materials(impact: Impact) -> dict[str, Material]:
    """Return the deformable materials, by the prefix of their parameters."""
    if isinstance(impact.target, RigidWall):
        return {"": impact.sphere.material}
    if isinstance(impact.target, HalfSpace):
        return {"": impact.sphere.material, _OF_TARGET: impact.target.material}
    raise InvalidValue(
        f"target must be a half space or a rigid wall for sensitivities, got {type(impact.target).__name__}"
    )


def parameters_of(impact: Impact) -> dict[str, Floats]:
    """Return the parameters of an impact on a half space or a rigid wall, by name, in the units of `PARAMETERS`."""
    values = {"radius": impact.sphere.radius, "density": impact.sphere.material.density}
    for body, material in _materials(impact).items():
        values[f"{body}youngs_modulus"] = material.youngs_modulus
        values[f"{body}poisson_ratio"] = material.poisson_ratio
    return {name: np.asarray(value, np.float64) for name, value in values.items()}


def _changed(impact: Impact, values: Mapping[str, ArrayLike]) -> Impact:
    material = Material(
        density=values["density"], youngs_modulus=values["youngs_modulus"], poisson_ratio=values["poisson_ratio"]
    )
    target = impact.target
    if isinstance(target, HalfSpace):
        changes = {name: values[_OF_TARGET + name] for name in ("youngs_modulus", "poisson_ratio")}
        target = HalfSpace(material=replace(target.material, **changes))
    return replace(impact, sphere=replace(impact.sphere, material=material, radius=values["radius"]), target=target)


def _filled(values: Mapping[str, ArrayLike], shape: tuple[int, ...]) -> dict[str, Floats]:
    return {name: np.array(np.broadcast_to(np.asarray(value, float), shape)) for name, value in values.items()}


def _spread(response: Floats) -> Floats:
    return np.asarray(response.max() / response.min() - 1)


def dissipative_constant(restitution: ArrayLike, impact: Impact) -> Floats:
    """Return the constant A of a viscoelastic sphere [s] that gives an impact the requested restitution.

    Parameters
    ----------
    restitution : array_like
        Below 1, below the restitution of a thin plate if it is the target, and above about 1e-5.
    impact : Impact
        Bodies, velocity and stiffness; its dissipation is replaced.

    Returns
    -------
    ndarray
        For `Viscoelastic(dissipative_constant=...)`, in the broadcast shape of restitution and impact.

    Raises
    ------
    InvalidValue
        The restitution cannot be reached.

    Examples
    --------
    >>> from cgid.physics import Elastic, HalfSpace, Sphere, Viscoelastic
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     target=HalfSpace(material=STEEL), velocity=2.0, stiffness="hertz", dissipation=Elastic(),
    ... )  # fmt: skip
    >>> constant = dissipative_constant(0.8, impact)
    >>> round(float(replace(impact, dissipation=Viscoelastic(dissipative_constant=constant)).restitution), 8)
    0.8
    """
    validation.instance("impact", impact, Impact)
    elastic = replace(impact, dissipation=Elastic())

    def curves(zeta: Floats, rows: NDArray[np.intp]) -> Curves:
        of = elastic.curves.taken(rows)
        return Curves(Viscoelastic, zeta[:, None], of.inelasticity, of.weight, _TOLERANCE)

    zeta = _solve(restitution, elastic, curves, _ZETA)
    return zeta * elastic.time_scale


def plate_thickness(restitution: ArrayLike, impact: Impact) -> Floats:
    """Return the thickness of a thin plate [m] that gives an impact the requested restitution.

    Parameters
    ----------
    restitution : array_like
        Below the restitution of the material alone (1 if elastic) and above about 1e-6.
    impact : Impact
        On a thin plate, whose thickness is replaced.

    Returns
    -------
    ndarray in the broadcast shape of restitution and impact

    Raises
    ------
    InvalidValue
        The target is not a thin plate, or the restitution cannot be reached.
    """
    validation.instance("impact", impact, Impact)
    validation.instance("impact.target", impact.target, ThinPlate)
    assert isinstance(impact.target, ThinPlate)
    on_half_space = replace(impact, target=HalfSpace(material=impact.target.material))

    def curves(inelasticity: Floats, rows: NDArray[np.intp]) -> Curves:
        return replace(on_half_space.curves.taken(rows), inelasticity=inelasticity, tolerance=_TOLERANCE)

    # lambda = m / (Z T0), and Z is proportional to the square of the thickness.
    inelasticity = _solve(restitution, on_half_space, curves, _LAMBDA)
    impedance = on_half_space.reduced_mass / (inelasticity * on_half_space.time_scale)
    return np.sqrt(impedance / impedance_of_unit_thickness(impact.target.material))


def yield_pressure(restitution: ArrayLike, impact: Impact) -> Floats:
    """Return the yield pressure [Pa] that gives an elastic-plastic impact the requested restitution.

    Parameters
    ----------
    restitution : array_like
        Below 1 and above about 1e-5.
    impact : Impact
        Bodies, velocity and stiffness; its dissipation is replaced. No thin plate, no gravity.

    Returns
    -------
    ndarray
        For `Thornton(yield_pressure=...)`, in the broadcast shape of restitution and impact.

    Raises
    ------
    InvalidValue
        The restitution cannot be reached, or the impact has a thin plate or gravity.

    Examples
    --------
    >>> from cgid.physics import Elastic, HalfSpace, Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     target=HalfSpace(material=STEEL), velocity=2.0, stiffness="hertz", dissipation=Elastic(),
    ... )  # fmt: skip
    >>> round(float(yield_pressure(0.5, impact)) / 1e6, 1)
    38.2
    """
    validation.instance("impact", impact, Impact)
    if np.any(impact.inelasticity) or np.any(impact.weight):
        raise InvalidValue(
            "target must have no losses, and gravity must be 0, for the yield pressure of a restitution, got "
            f"{type(impact.target).__name__}; take a HalfSpace, and leave gravity out"
        )
    # At a yield pressure of the modulus nothing yields.
    elastic = replace(impact, dissipation=Thornton(yield_pressure=impact.reduced_modulus))

    def curves(over_depth: Floats, rows: NDArray[np.intp]) -> Curves:  # noqa: ARG001
        return thornton_curves(1 / over_depth)

    depth = elastic.length_scale / _solve(restitution, elastic, curves, _OVER_DEPTH)
    return np.asarray(1.5 * elastic.contact_stiffness * np.sqrt(depth) / (np.pi * elastic.reduced_radius))


def _solve(
    restitution: ArrayLike,
    impact: Impact,
    curves: Callable[[Floats, NDArray[np.intp]], Curves],
    between: tuple[float, float],
) -> Floats:
    """Return the loss parameter that gives the restitution, in the broadcast shape of restitution and impact."""
    from scipy.optimize import elementwise

    requested, lossless = validation.broadcast(
        restitution=validation.restitution("restitution", restitution), impact=impact.restitution
    )
    rows = np.broadcast_to(np.arange(impact.restitution.size).reshape(impact.restitution.shape), requested.shape)

    def excess(logarithm: Floats, requested: Floats, rows: NDArray[np.intp]) -> Floats:
        return curves(np.exp(logarithm).ravel(), rows.ravel()).rebound.reshape(requested.shape) - requested

    low, high = (np.full(requested.shape, np.log(bound)) for bound in between)
    lowest = requested + excess(high, requested, rows)
    unreachable = (requested >= lossless) | (requested <= lowest)
    if unreachable.any():
        raise InvalidValue(
            f"restitution must be between {lowest[unreachable][0]:.3g} and {lossless[unreachable][0]:.6g}, which the "
            f"impact has without this loss, got {requested[unreachable][0]:g}"
        )
    logarithm_found = np.asarray(elementwise.find_root(excess, (low, high), args=(requested, rows)).x)
    # With gravity the restitution drops to 0 abruptly when the sphere stays on the target.
    missed = np.abs(excess(logarithm_found, requested, rows)) > 1e-9 * requested
    if missed.any():
        # The verdict that a sphere stays has rounding of its own, some 1e-9.
        last = requested + excess(logarithm_found - 1e-7, requested, rows)
        raise InvalidValue(
            f"restitution must be {last[missed][0]:.3g} or more, since with more loss the sphere stays on the target, "
            f"got {requested[missed][0]:g}"
        )
    return np.asarray(np.exp(logarithm_found))
