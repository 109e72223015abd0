"""FiniteElementImpact: a sphere falls on a plate, both elastic and meshed; no theory of contact is put in."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from cgid import validation
from cgid.errors import InvalidValue
from cgid.impact.bodies import HalfSpace, Sphere
from cgid.impact.dissipation import Elastic
from cgid.impact.finite_element.bodies import ElasticPlate, PenaltyContact, one
from cgid.impact.finite_element.elasticity import body
from cgid.impact.finite_element.explicit import explicit, stable_time_step
from cgid.impact.finite_element.history import History, history
from cgid.impact.finite_element.implicit import implicit
from cgid.impact.finite_element.mesh import REACH, plate_mesh, sphere_mesh
from cgid.impact.finite_element.pair import Pair
from cgid.impact.finite_element.records import Progress
from cgid.impact.pulse import HERTZ_LIMIT, HertzRangeWarning, Impact

METHODS = ("auto", "explicit", "implicit")
#: Elements over the contact radius: fewer than the first make no contact, the second give the peak within 1 %.
FEWEST, ONE_PERCENT, MOST = 5, 7, 200
#: Displacement over radius up to which there is room for the contact; linear elasticity is beside the point before.
_DEEPEST = 0.2
#: Above this Poisson's ratio the elements are too stiff (they lock).
_LOCKING = 0.45
#: "auto" takes implicit steps where damping divides the stable step by more than this.
_SHORTENED = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FiniteElementImpact:
    """One normal impact of an elastic sphere on an elastic plate, by axisymmetric finite elements.

    Linear elasticity and small strains: node meets node where both were before the impact. Bilinear elements, lumped
    mass, a contact that cannot be passed through and does not stick, no gravity. Every number is one number.

    Parameters
    ----------
    sphere : Sphere
    plate : ElasticPlate
    velocity : float
        [m/s], above 0.
    retardation_time : float, optional
        b of the sphere's material as Kelvin and Voigt have it [s]: stress = E (strain + b x strain rate). For a slow
        impact that is `Viscoelastic` with A = 3/2 b times the sphere's share of the compliance.
    elements : int, optional
        Over the radius of Hertz's contact: 7 give the peak force within about .5 %, 14 within .1 %.
    element_size : float, optional
        Edge of the elements at the contact [m], in place of `elements`.
    penalty : PenaltyContact, optional
        A contact that gives way in place of a hard one.
    method : {"auto", "explicit", "implicit"}, optional
        Explicit central differences, or implicit steps; "auto" takes the latter where damping makes the stable
        step several times smaller.
    time_step : float, optional
        [s]; chosen if left out.

    Raises
    ------
    InvalidValue
        A number breaks its rule: a mesh too coarse, a plate thinner than the contact radius, a displacement beyond a
        fifth of the radius.

    Warns
    -----
    HertzRangeWarning
        If the displacement passes a tenth of the radius, where small strains end.

    Examples
    --------
    >>> from cgid.impact import Sphere
    >>> from cgid.materials import STEEL, YANG2018_SPHERES
    >>> impact = FiniteElementImpact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     plate=ElasticPlate(material=STEEL, thickness=0.008, radius=0.2, lower_face="fixed"),
    ...     velocity=10.0,
    ...     elements=7,
    ... )
    >>> f"{impact.run().peak_force / 1e3:.1f} kN, Hertz {float(impact.hertz.peak_force) / 1e3:.1f} kN"
    '14.2 kN, Hertz 13.0 kN'
    """

    sphere: Sphere
    plate: ElasticPlate
    velocity: float
    retardation_time: float = 0.0
    elements: int | None = None
    element_size: float | None = None
    penalty: PenaltyContact | None = None
    method: Literal["auto", "explicit", "implicit"] = "auto"
    time_step: float | None = None

    def __post_init__(self) -> None:
        validation.instance("sphere", self.sphere, Sphere)
        validation.instance("plate", self.plate, ElasticPlate)
        if self.penalty is not None:
            validation.instance("penalty", self.penalty, PenaltyContact)
        for name in ("density", "youngs_modulus", "poisson_ratio"):
            one(name, getattr(self.sphere.material, name))
        one("velocity", validation.positive("velocity", self.velocity, "m/s"))
        one("retardation_time", validation.not_negative("retardation_time", self.retardation_time, "s"))
        validation.choice("method", self.method, METHODS)
        if self.time_step is not None:
            one("time_step", validation.positive("time_step", self.time_step, "s"))
        self._check_strain()
        self._check_mesh()
        self._check_plate()

    def _check_strain(self) -> None:
        strain = float(self.hertz.peak_displacement) / self._radius
        if strain > _DEEPEST:
            raise InvalidValue(
                f"displacement over radius must not pass {_DEEPEST:g}, this impact reaches {strain:.3g} by Hertz's "
                "theory: strains are far from small there; use a lower velocity or a stiffer material"
            )
        if strain > HERTZ_LIMIT:
            warnings.warn(
                f"displacement over radius reaches {strain:.3g}; linear elasticity and Hertz's theory hold up to "
                f"{HERTZ_LIMIT:g}",
                HertzRangeWarning,
                stacklevel=4,
            )
        for material in (self.sphere.material, self.plate.material):
            ratio = one("poisson_ratio", material.poisson_ratio)
            if ratio > _LOCKING:
                raise InvalidValue(
                    f"poisson_ratio must be at most {_LOCKING:g} for these elements, got {ratio:g}: beyond it they are "
                    "too stiff"
                )

    def _check_mesh(self) -> None:
        if self.elements is not None and self.element_size is not None:
            raise InvalidValue("elements and element_size say the same thing; give one of them")
        if self.element_size is not None:
            one("element_size", validation.positive("element_size", self.element_size, "m"))
        elif self.elements is not None:
            validation.count("elements", self.elements)
        asked = (
            self.contact_radius / self.element_size if self.element_size is not None else self.n_elements_over_radius
        )
        if not FEWEST <= asked <= MOST:
            rule = f"at least {FEWEST} are needed, {ONE_PERCENT} for the peak force within 1 %"
            if asked > MOST:
                rule = f"more than {MOST} are not meant"
            raise InvalidValue(
                f"the mesh has {asked:.3g} elements over the contact radius of {self.contact_radius * 1e3:.3g} mm; "
                f"{rule}: use elements = {ONE_PERCENT} to 28, or an element_size of "
                f"{self.contact_radius / ONE_PERCENT * 1e3:.3g} mm or less"
            )

    def _check_plate(self) -> None:
        if self.plate.thickness < self.contact_radius:
            raise InvalidValue(
                f"thickness of the plate must be at least the contact radius, {self.contact_radius * 1e3:.3g} mm, got "
                f"{self.plate.thickness * 1e3:.3g} mm; use a thicker plate"
            )
        needed = 2 * REACH * self.contact_radius
        if self.plate.radius < needed:
            raise InvalidValue(
                f"radius of the plate must be at least {needed * 1e3:.3g} mm, twice the reach of its contact, got "
                f"{self.plate.radius * 1e3:.3g} mm; use a wider plate"
            )

    @property
    def _radius(self) -> float:
        return one("radius", self.sphere.radius)

    @cached_property
    def hertz(self) -> Impact:
        """The same impact on a half space by Hertz's theory, elastic."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HertzRangeWarning)
            return Impact(
                sphere=self.sphere,
                target=HalfSpace(material=self.plate.material),
                velocity=self.velocity,
                stiffness="hertz",
                dissipation=Elastic(),
            )

    @property
    def contact_radius(self) -> float:
        """The largest by Hertz's theory, `sqrt(R delta)` [m]: what the mesh is made for."""
        return float(np.sqrt(self._radius * self.hertz.peak_displacement))

    @property
    def n_elements_over_radius(self) -> int:
        """Elements over the contact radius."""
        if self.element_size is not None:
            return int(np.ceil(self.contact_radius / self.element_size))
        return 2 * ONE_PERCENT if self.elements is None else int(self.elements)

    @cached_property
    def pair(self) -> Pair:
        """Both bodies, meshed."""
        radius, elements = self._radius, self.n_elements_over_radius
        ball = sphere_mesh(radius, self.contact_radius, elements)
        slab = plate_mesh(self.plate.thickness, self.plate.radius, ball.nodes[ball.contact, 0])
        held = np.flatnonzero(slab.nodes[:, 1] <= -self.plate.thickness * (1 - 1e-9))
        softness = 0.0
        if self.penalty is not None:
            size = self.contact_radius / elements
            softness = self.penalty.softness(self.sphere.material, self.plate.material, size)
        return Pair(
            sphere=body(ball, self.sphere.material, volume=4 / 3 * np.pi * radius**3),
            plate=body(
                slab,
                self.plate.material,
                volume=np.pi * self.plate.radius**2 * self.plate.thickness,
                held=held if self.plate.lower_face == "fixed" else None,
            ),
            softness=softness,
        )

    @property
    def n_nodes(self) -> int:
        """Nodes of both meshes."""
        return self.pair.mass.size // 2

    @property
    def stable_time_step(self) -> float:
        """The largest step of the explicit method [s]."""
        return stable_time_step(self.pair, self._retardation)

    @property
    def _retardation(self) -> tuple[float, float]:
        return float(self.retardation_time), float(self.plate.retardation_time)

    @cached_property
    def chosen_method(self) -> str:
        """The method that runs: what "auto" comes to."""
        if self.method != "auto":
            return self.method
        if not any(self._retardation):
            return "explicit"
        shortened = stable_time_step(self.pair, (0.0, 0.0)) / self.stable_time_step
        return "implicit" if shortened > _SHORTENED else "explicit"

    def run(self, progress: Progress | None = None) -> History:
        """Return the course of the impact.

        Parameters
        ----------
        progress : callable, optional
            Called now and then with the time run through, over the contact time of Hertz's theory.

        Raises
        ------
        InvalidValue
            The time step is beyond the explicit method's limit of stability, or the bodies never part.
        """
        integrate = {"explicit": explicit, "implicit": implicit}[self.chosen_method]
        records = integrate(
            self.pair,
            float(self.velocity),
            float(self.hertz.contact_duration),
            retardation=self._retardation,
            time_step=self.time_step,
            progress=progress,
        )
        return history(
            records,
            self.pair,
            velocity=float(self.velocity),
            mass=float(self.sphere.mass),
            is_damped=any(self._retardation),
        )
