"""What a finite-element impact tells: signals over time, and their peaks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cgid.finite_element.pair import Pair
from cgid.finite_element.records import Records
from cgid.signals import Signal
from cgid.validation import Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class History:
    """The course of one impact. Signals begin at first touch, have one rate, and go on past the end of contact.

    `cgid.extract` takes their `samples` and `sampling_rate`. `cgid.fft_filter` is circular, and the sphere
    rings on: put as many zeros before a signal as it is long.

    Parameters
    ----------
    contact_force : Signal
        [N].
    centre_displacement, mass_centre_displacement : Signal
        Of the node at the sphere's centre (the paper's DCS) and of its mass centre, towards the plate [m].
    contact_radius : Signal
        Where the pressure has fallen to nothing [m]: between the outermost nodes that press, by Hertz's law that
        its square falls with the square of the radius.
    contact_pressure : Signal
        The largest [Pa].
    sphere_energy, plate_energy : Signal
        Internal (elastic) energies [J].
    centre_node_force : Signal
        Mass of the sphere times acceleration of the node at its centre [N]: the paper's "dense vibration waves".
    radii, pressures : ndarray, (n_contact,)
        Contact pressure over the distance from the axis [m], [Pa] at the moment of the largest force.
    contact_duration : float
        From first to last touch [s]; a free plate may be struck more than once.
    restitution : float
        Velocity of the mass centre away from where the plate was, over the impact velocity: below 0 where it goes on
        downwards, slower than a free plate.
    energy_error : float or None
        Largest change of the sum of all energies over the impact energy; None with damping, which takes some.
    momentum_error : float
        Largest difference of the sphere's change of momentum and the contact's impulse, over its first momentum.
    time_step : float
        [s].
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
    """Return what records of a run tell."""
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
    """Return where the square of the pressure, drawn on over the square of the radius, falls to 0 [m]."""
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
