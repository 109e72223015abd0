"""FiniteElementImpact: impact of a sphere on a plate, both elastic and meshed, without any theory of contact."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics import Elastic
from cgid.physics.contact.bodies import HalfSpace, Sphere, sphere_share
from cgid.physics.contact.impact import HERTZ_LIMIT, HertzRangeWarning, Impact
from cgid.signals import Signal
from studies.finite_element.assembly import Pair, body, require_elements_fit
from studies.finite_element.mesh import (
    ElasticPlate,
    PenaltyContact,
    hold_numbers,
    plate_mesh,
    require_fine_mesh,
    require_room,
    sphere_mesh,
)
from studies.finite_element.steps import (
    Progress,
    Records,
    collected,
    explicit,
    implicit,
    require_times_fit,
    stable_time_step,
)

#: Largest displacement over radius, far beyond the range of linear elasticity.
_DEEPEST = 0.14
METHODS = ("auto", "explicit", "implicit")
#: Default number of elements over the contact radius.
_ELEMENTS = 14
#: If the sphere has more than this share of the compliance, the plate's mesh may grow faster.
_SPHERE_ALONE = 0.75
#: "auto" chooses implicit steps if the contact needs more explicit ones than this.
_MAX_EXPLICIT = 50_000


@dataclass(frozen=True, kw_only=True, eq=False)
class FiniteElementImpact:
    """One normal impact of an elastic sphere on an elastic plate, by axisymmetric finite elements.

    Linear elasticity and small strains: nodes are paired in the undeformed state. Bilinear elements, lumped mass; no
    penetration, adhesion, friction or gravity. Every parameter is scalar.

    Parameters
    ----------
    sphere : Sphere
    plate : ElasticPlate
    velocity : float, above 0 [m/s]
    retardation_time : float, optional [s]
        b of a Kelvin-Voigt sphere, stress = E (strain + b x strain rate). For a slow impact this is `Viscoelastic` with
        A = 3/2 b times the sphere's share of the compliance.
    elements : int, optional
        Number over the radius of Hertz's contact: 7 give the peak force within about .5 %, 14 (default) within .1 %.
    element_size : float, optional [m]
        Edge of the elements at the contact, instead of `elements`.
    penalty : PenaltyContact, optional
        A soft contact instead of a hard one.
    method : {"auto", "explicit", "implicit"}, optional
        Explicit central differences, or implicit steps. "auto" chooses implicit where damping or a small contact would
        need more than 50,000 explicit steps.
    time_step : float, optional [s]
        By default chosen automatically.

    Raises
    ------
    InvalidValue
        A value is invalid, the mesh is too coarse, the plate is thinner than the contact radius, or the displacement
        exceeds a seventh of the sphere's radius.

    Warns
    -----
    HertzRangeWarning
        The displacement exceeds a tenth of the sphere's radius, the limit of small strains.

    Examples
    --------
    >>> from cgid.physics import Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
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
        validation.number("radius", self.sphere.radius)
        hold_numbers(self, "m/s", velocity=validation.positive)
        hold_numbers(self, "s", retardation_time=validation.not_negative)
        validation.choice("method", self.method, METHODS)
        if self.time_step is not None:
            hold_numbers(self, "s", time_step=validation.positive)
        if self.elements is not None and self.element_size is not None:
            raise InvalidValue("elements and element_size say the same thing; give one of them")
        if self.element_size is not None:
            hold_numbers(self, "m", element_size=validation.positive)
        elif self.elements is not None:
            validation.count("elements", self.elements)
        for material in (self.sphere.material, self.plate.material):
            require_elements_fit(material)
        _require_small_strain(float(self.hertz.peak_displacement) / self._radius)
        require_fine_mesh(self.asked_elements, self.contact_radius)
        require_room(self.plate, self.contact_radius)
        require_times_fit(self._retardation, self.time_step, float(self.hertz.contact_duration))

    @property
    def _radius(self) -> float:
        return float(np.asarray(self.sphere.radius))

    @cached_property
    def hertz(self) -> Impact:
        """The same impact on a half space, elastic, by Hertz's theory."""
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
        """Largest contact radius by Hertz's theory, `sqrt(R delta)` [m], for which the mesh is made."""
        return float(np.sqrt(self._radius * self.hertz.peak_displacement))

    @property
    def asked_elements(self) -> float:
        """Requested elements over the contact radius; at the axis the mesh is up to a tenth coarser."""
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
        """Number of nodes of both meshes."""
        return self.pair.mass.size // 2

    @property
    def stable_time_step(self) -> float:
        """Largest stable step of the explicit method [s]."""
        return stable_time_step(self.pair, self._retardation)

    @property
    def _retardation(self) -> tuple[float, float]:
        return self.retardation_time, self.plate.retardation_time

    @cached_property
    def chosen_method(self) -> str:
        """The method that runs, with "auto" resolved."""
        if self.method != "auto":
            return self.method
        return "implicit" if float(self.hertz.contact_duration) > _MAX_EXPLICIT * self.stable_time_step else "explicit"

    def run(self, progress: Progress | None = None) -> History:
        """Simulate the impact and return its history.

        Parameters
        ----------
        progress : callable, optional
            Called repeatedly with the simulated time over Hertz's contact time.

        Returns
        -------
        History

        Raises
        ------
        InvalidValue
            The time step exceeds the stability limit of the explicit method, or the bodies never separate.
        """
        integrate = {"explicit": explicit, "implicit": implicit}[self.chosen_method]
        duration = float(self.hertz.contact_duration)
        run = integrate(self.pair, self.velocity, duration, self._retardation, self.time_step)
        records = collected(run, self.pair, duration, progress)
        return history(
            records, self.pair, velocity=self.velocity, mass=float(self.sphere.mass), is_damped=any(self._retardation)
        )


def _require_small_strain(strain: float) -> None:
    """Raise `InvalidValue` or warn if the displacement is too large relative to the radius."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class History:
    """The history of one impact.

    Signals begin at first touch, share one sampling rate, and extend beyond the end of contact. `cgid.extract` takes
    their `samples` and `sampling_rate`. `cgid.fft_filter` is circular, and the sphere keeps ringing: before filtering,
    prepend as many zeros as the signal has samples.

    Parameters
    ----------
    contact_force : Signal [N]
    centre_displacement, mass_centre_displacement : Signal [m]
        Towards the plate, of the node at the sphere's centre (DCS in Yang et al. 2018) and of the mass centre.
    contact_radius : Signal [m]
        Radius of vanishing pressure, extrapolated from the outermost loaded nodes: by Hertz's law the squared pressure
        is linear in the squared radius.
    contact_pressure : Signal [Pa]
        Largest pressure.
    sphere_energy, plate_energy : Signal [J]
        Internal (elastic) energies.
    centre_node_force : Signal [N]
        Mass of the sphere times acceleration of its centre node: the "dense vibration waves" of Yang et al. (2018).
    radii, pressures : ndarray, (n_contact,) [m], [Pa]
        Distance from the axis, and contact pressure there at the peak force.
    contact_duration : float [s]
        From first to last touch; a free plate may be hit repeatedly.
    restitution : float
        Velocity of the mass centre away from the plate's initial position over impact velocity; negative if the sphere
        moves on downwards, slower than a free plate.
    energy_error : float or None
        Largest change of the total energy over the impact energy; None with damping.
    momentum_error : float
        Largest difference between the sphere's change of momentum and the contact impulse, over the initial momentum.
    time_step : float [s]
    n_steps : int
    """

    contact_force: Signal
    centre_displacement: Signal
    mass_centre_displacement: Signal
    contact_radius: Signal
    contact_pressure: Signal
    sphere_energy: Signal
    plate_energy: Signal
    centre_node_force: Signal
    radii: Floats
    pressures: Floats
    contact_duration: float
    restitution: float
    energy_error: float | None
    momentum_error: float
    time_step: float
    n_steps: int

    @property
    def times(self) -> Floats:
        """Time of each sample since first touch [s]."""
        return np.arange(len(self.contact_force.samples)) / self.contact_force.sampling_rate

    @property
    def peak_force(self) -> float:
        """Largest contact force [N]."""
        return float(self.contact_force.samples.max())

    @property
    def peak_displacement(self) -> float:
        """Largest displacement of the sphere's centre [m]."""
        return float(self.centre_displacement.samples.max())

    @property
    def peak_pressure(self) -> float:
        """Largest contact pressure [Pa]."""
        return float(self.contact_pressure.samples.max())

    @property
    def peak_sphere_energy(self) -> float:
        """Largest internal energy of the sphere [J]."""
        return float(self.sphere_energy.samples.max())

    @property
    def peak_plate_energy(self) -> float:
        """Largest internal energy of the plate [J]."""
        return float(self.plate_energy.samples.max())


def history(records: Records, pair: Pair, *, velocity: float, mass: float, is_damped: bool) -> History:
    """Return the history of a run from its records."""
    centre, mass_centre, acceleration, in_sphere, in_plate, kinetic, momentum, _, impulse = records.values.T
    force = records.forces.sum(axis=1)
    pressures = records.forces / pair.areas
    rate = 1 / records.interval
    last = int(np.flatnonzero(force)[-1])

    def signal(samples: Floats, unit: str, name: str) -> Signal:
        return Signal(samples=samples, sampling_rate=rate, unit=unit, source=name, pre_trigger=0)

    energy = kinetic + in_sphere + in_plate + records.forces**2 @ pair.soft_part / 2
    return History(
        contact_force=signal(force, "N", "contact force"),
        centre_displacement=signal(-centre, "m", "displacement of the sphere's centre"),
        mass_centre_displacement=signal(-mass_centre, "m", "displacement of the sphere's mass centre"),
        contact_radius=signal(_radius(pressures, pair.places), "m", "contact radius"),
        contact_pressure=signal(pressures.max(axis=1), "Pa", "contact pressure"),
        sphere_energy=signal(in_sphere, "J", "internal energy of the sphere"),
        plate_energy=signal(in_plate, "J", "internal energy of the plate"),
        centre_node_force=signal(mass * acceleration, "N", "mass times acceleration of the centre"),
        radii=pair.places,
        pressures=pressures[np.argmax(force)],
        contact_duration=(last + 1) * records.interval,
        restitution=float(momentum[-1] / (mass * velocity)),
        energy_error=None if is_damped else float(np.abs(energy / energy[0] - 1).max()),
        momentum_error=float(np.abs(momentum - momentum[0] - impulse).max() / (mass * velocity)),
        time_step=records.step,
        n_steps=round(len(force) * records.interval / records.step),
    )


def _radius(pressures: Floats, places: Floats) -> Floats:
    """Return the radius at which the squared pressure, extrapolated over the squared radius, is 0 [m]."""
    touching = pressures > 0
    outermost = places.size - 1 - np.argmax(touching[:, ::-1], axis=1)
    inner = np.maximum(outermost - 1, 0)
    row = np.arange(len(pressures))
    squares, last, before = places**2, pressures[row, outermost] ** 2, pressures[row, inner] ** 2
    falling = before > last
    beyond = np.divide(
        last * (squares[outermost] - squares[inner]), before - last, out=np.zeros(len(row)), where=falling
    )
    bounds = squares[np.minimum(outermost + 1, places.size - 1)]
    radius = np.sqrt(np.minimum(squares[outermost] + beyond, bounds))
    return np.where(touching.any(axis=1), radius, 0.0)
