"""FiniteElementImpact: a sphere falls on a plate, both elastic and meshed; no theory of contact is put in."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from cgid import validation
from cgid.errors import InvalidValue
from cgid.finite_element import limits
from cgid.finite_element.bodies import ElasticPlate, PenaltyContact, hold_number, single_number
from cgid.finite_element.elasticity import body
from cgid.finite_element.explicit import explicit, stable_time_step
from cgid.finite_element.history import History, history
from cgid.finite_element.implicit import implicit
from cgid.finite_element.mesh import plate_mesh, sphere_mesh
from cgid.finite_element.pair import Pair
from cgid.finite_element.records import Progress
from cgid.physics.bodies import HalfSpace, Sphere, sphere_share
from cgid.physics.dissipation import Elastic
from cgid.physics.pulse import HertzRangeWarning, Impact

METHODS = ("auto", "explicit", "implicit")
#: Over the contact radius, unless told otherwise.
_ELEMENTS = 14
#: Where the sphere has more of the compliance than this, the plate's mesh may grow faster.
_SPHERE_ALONE = 0.75
#: "auto" takes implicit steps where the contact would last more explicit ones than this.
_MOST_STEPS = 50_000


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
        Explicit central differences, or implicit steps; "auto" takes the latter where damping, or a small contact,
        would make more than 50,000 explicit steps of it.
    time_step : float, optional
        [s]; chosen if left out.

    Raises
    ------
    InvalidValue
        A number breaks its rule: a mesh too coarse, a plate thinner than the contact radius, a displacement beyond a
        seventh of the radius.

    Warns
    -----
    HertzRangeWarning
        If the displacement passes a tenth of the radius, where small strains end.

    Examples
    --------
    >>> from cgid.physics import Sphere
    >>> from cgid.physics.materials import STEEL, YANG2018_SPHERES
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
        single_number("radius", self.sphere.radius)
        hold_number(self, "velocity", validation.positive("velocity", self.velocity, "m/s"))
        hold_number(self, "retardation_time", validation.not_negative("retardation_time", self.retardation_time, "s"))
        validation.choice("method", self.method, METHODS)
        if self.time_step is not None:
            hold_number(self, "time_step", validation.positive("time_step", self.time_step, "s"))
        if self.elements is not None and self.element_size is not None:
            raise InvalidValue("elements and element_size say the same thing; give one of them")
        if self.element_size is not None:
            hold_number(self, "element_size", validation.positive("element_size", self.element_size, "m"))
        elif self.elements is not None:
            validation.count("elements", self.elements)
        for material in (self.sphere.material, self.plate.material):
            limits.require_elements_fit(material)
        limits.require_small_strain(float(self.hertz.peak_displacement) / self._radius)
        limits.require_fine_mesh(self.asked_elements, self.contact_radius)
        limits.require_room(self.plate, self.contact_radius)
        limits.require_times_fit(self._retardation, self.time_step, float(self.hertz.contact_duration))

    @property
    def _radius(self) -> float:
        return single_number("radius", self.sphere.radius)

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
    def asked_elements(self) -> float:
        """Elements over the contact radius, as asked; next to the axis the mesh is up to a tenth coarser."""
        if self.element_size is not None:
            return self.contact_radius / self.element_size
        return _ELEMENTS if self.elements is None else self.elements

    @cached_property
    def pair(self) -> Pair:
        """Both bodies, meshed."""
        radius, elements = self._radius, int(np.ceil(self.asked_elements))
        ball = sphere_mesh(radius, self.contact_radius, elements)
        growth = 2.0 if float(sphere_share(self.sphere, self.hertz.target)) > _SPHERE_ALONE else 1.0
        slab = plate_mesh(self.plate.thickness, self.plate.radius, ball.nodes[ball.contact, 0], growth)
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
    def n_elements(self) -> int:
        """Elements of both meshes."""
        return len(self.pair.sphere.mesh.elements) + len(self.pair.plate.mesh.elements)

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
        return "implicit" if float(self.hertz.contact_duration) > _MOST_STEPS * self.stable_time_step else "explicit"

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
