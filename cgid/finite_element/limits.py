"""What a finite-element impact must keep to, each rule with its numbers."""

from __future__ import annotations

import warnings

from cgid.errors import InvalidValue
from cgid.finite_element.bodies import ElasticPlate, single_number
from cgid.finite_element.mesh import REACH
from cgid.physics.materials import Material
from cgid.physics.pulse import HERTZ_LIMIT, HertzRangeWarning

#: Elements over the contact radius: with fewer than the first, pressure and radius rest on two or three nodes; the
#: second give the peak force within 1 %.
_FEWEST, _ONE_PERCENT, _MOST = 5, 7, 60
#: Displacement over radius that still leaves room for the contact; linear elasticity ends before.
_DEEPEST = 0.14
#: Steps in the duration of a Hertz impact: with fewer an impact is not followed, more take hours.
_FEWEST_STEPS, _MOST_STEPS = 50, 1_000_000
#: Retardation times beyond so many durations make the sphere a rigid body.
_SLOWEST = 100.0
#: Plates larger than so many contact radii are half spaces, and more.
_LARGEST = 1e5
#: Stiffest material [Pa].
_STIFFEST = 1e15
#: Above this Poisson's ratio bilinear elements are too stiff (they lock).
_LOCKING = 0.45


def require_elements_fit(material: Material) -> None:
    """Raise `InvalidValue` for a material that is an array, or nearly incompressible."""
    single_number("density", material.density)
    modulus = single_number("youngs_modulus", material.youngs_modulus)
    if modulus > _STIFFEST:
        raise InvalidValue(
            f"youngs_modulus must be at most {_STIFFEST:g} Pa, a thousand times diamond's, got {modulus:.3g} Pa; a "
            "lower one is as good as rigid"
        )
    ratio = single_number("poisson_ratio", material.poisson_ratio)
    if ratio > _LOCKING:
        raise InvalidValue(
            f"poisson_ratio must be at most {_LOCKING:g}, got {ratio:g}: beyond it these elements are too stiff; use a "
            "lower one"
        )


def require_small_strain(strain: float) -> None:
    """Raise `InvalidValue` or warn of a displacement that is too large a part of the radius."""
    if strain > _DEEPEST:
        raise InvalidValue(
            f"displacement over radius must not pass {_DEEPEST:g}, by Hertz's theory this impact reaches {strain:.3g}: "
            "strains are far from small there; use a lower velocity or a stiffer material"
        )
    if strain > HERTZ_LIMIT:
        warnings.warn(
            f"displacement over radius reaches {strain:.3g}; linear elasticity and Hertz's theory hold up to "
            f"{HERTZ_LIMIT:g}",
            HertzRangeWarning,
            stacklevel=4,
        )


def require_fine_mesh(elements: float, contact_radius: float) -> None:
    """Raise `InvalidValue` for a mesh too coarse for the contact, or finer than is meant."""
    if elements < _FEWEST:
        raise InvalidValue(
            f"the mesh must have at least {_FEWEST} elements over the contact radius of {contact_radius * 1e3:.3g} mm "
            f"({_ONE_PERCENT} for the peak force within 1 %), got {elements:.3g}; use elements = {_ONE_PERCENT} or "
            f"more, or an element_size of {contact_radius / _ONE_PERCENT * 1e3:.3g} mm or less"
        )
    if elements > _MOST:
        raise InvalidValue(
            f"the mesh must have at most {_MOST} elements over the contact radius of {contact_radius * 1e3:.3g} mm, "
            f"got {min(elements, 1e9):.4g}; 14 give the peak force within about .1 %"
        )


def require_room(plate: ElasticPlate, contact_radius: float) -> None:
    """Raise `InvalidValue` for a plate thinner than the contact radius, hardly wider than the contact, or boundless."""
    if plate.thickness < contact_radius:
        raise InvalidValue(
            f"thickness of the plate must be at least the contact radius, {contact_radius * 1e3:.3g} mm, got "
            f"{plate.thickness * 1e3:.3g} mm; use a thicker plate"
        )
    for name, size in (("thickness", plate.thickness), ("radius", plate.radius)):
        if size > _LARGEST * contact_radius:
            raise InvalidValue(
                f"{name} of the plate must be at most {_LARGEST * contact_radius:.3g} m, {_LARGEST:g} contact radii, "
                f"got {size:.3g} m; use a smaller one, the impact will not notice"
            )
    needed = 2 * REACH * contact_radius
    if plate.radius < needed:
        raise InvalidValue(
            f"radius of the plate must be at least {needed * 1e3:.3g} mm, {2 * REACH:g} times the contact radius, got "
            f"{plate.radius * 1e3:.3g} mm; use a wider plate"
        )


def require_times_fit(retardation: tuple[float, float], time_step: float | None, duration: float) -> None:
    """Raise `InvalidValue` for a step, or retardation times, out of proportion to the duration of the contact [s]."""
    if max(retardation) > _SLOWEST * duration:
        raise InvalidValue(
            f"retardation_time must be at most {_SLOWEST * duration:.3g} s, {_SLOWEST:g} times the contact of Hertz's "
            f"theory, got {max(retardation):.3g} s; nothing deforms with more"
        )
    if time_step is None:
        return
    longest, shortest = duration / _FEWEST_STEPS, duration / _MOST_STEPS
    if not shortest <= time_step <= longest:
        raise InvalidValue(
            f"time_step must lie between {shortest:.3g} and {longest:.3g} s, {_MOST_STEPS} and {_FEWEST_STEPS} steps "
            f"of the contact of Hertz's theory, got {time_step:.3g} s; leave it out and it is chosen"
        )


def require_enough_time(step: float, duration: float) -> None:
    """Raise `InvalidValue` where a stable step is so small that the contact would take too many."""
    if step * _MOST_STEPS < duration:
        raise InvalidValue(
            f"the explicit method needs steps of {step:.3g} s here, and may take at most {_MOST_STEPS} in the contact "
            f"of {duration:.3g} s; use method implicit"
        )


def require_followed(contact_duration: float, step: float) -> None:
    """Raise `InvalidValue` for a contact of a few steps: a light plate ends it long before Hertz's theory would."""
    if contact_duration < _FEWEST_STEPS * step:
        raise InvalidValue(
            f"time_step must be at most a {_FEWEST_STEPS}th of the contact, which lasted {contact_duration:.3g} s, got "
            f"{step:.3g} s; use {contact_duration / (4 * _FEWEST_STEPS):.2g} s"
        )
