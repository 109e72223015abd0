"""A rock that strikes a beam given by its modes: Hunt and Crossley's contact, stepped with the modes.

Its force is a power of the depth, 3/2 for a sphere; it may break once, and then has a part of its force.

Nothing here comes from `cgid`. Each mode is stepped exactly under a force that is linear over a step; the force at the
end of a step is found together with the motion that it causes, so the force feels the beam's give and its echoes, and
energy is kept. What is attached to the beam, dampers or lumps of rock, acts on the modes, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Floats = NDArray[np.float64]
#: Steps per sample of the recorder for long contacts, fewest steps in a contact, how many contacts the window lasts.
_FINE, _STEPS, _WINDOW = 32, 150, 4.0


def residual(omega: Floats, shapes: Floats) -> Floats:
    """Return the static compliance of all higher modes at each point [m/N].

    In a plate the squared shapes are spread evenly over frequency, so it is their density below the last mode over its
    frequency.
    """
    upper = omega > 0.7 * omega[-1]
    return (shapes[:, upper] ** 2).sum(axis=1) / (0.3 * omega[-1]) / omega[-1]


def stepping(omega: Floats, damping: Floats, step: float) -> Floats:
    """Return q and q' after a step from q, q' and a force that goes linearly from f to g, (n_modes, 2, 4).

    It is the exponential of the matrix of q, q', f and g - f.
    """
    generator = np.zeros((len(omega), 4, 4))
    generator[:, 0, 1] = step
    generator[:, 1, 0], generator[:, 1, 1], generator[:, 1, 2] = -(omega**2) * step, -2 * damping * omega * step, step
    generator[:, 2, 3] = 1.0
    grown = linalg.expm(generator)[:, :2]
    grown[:, :, 2] -= grown[:, :, 3]
    return np.ascontiguousarray(grown)


@numba.njit(cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def _strike(stepped, shape, held, linked, mass, law, loss, speed, step, window, force, state):
    """Step one rock through its contacts; return the number of steps and the rock's last velocity into the beam.

    `law` is stiffness, exponent, the depth where it breaks and the force that is left of it.
    `held` (n_attached, n_modes) are the shapes at what is attached, `linked` (n_attached, 3) its damper, mass and
    spring. The force of a step's end is found by Newton's method; attached forces lag by a step. `state` (2, n_modes)
    ends as the modes' q and q'.
    """
    n_modes, n_held = len(shape), len(linked)
    stiffness, exponent, breaks, left = law
    give = quick = 0.0  # displacement and velocity of the beam per force at the end of the step
    for r in range(n_modes):
        give += stepped[r, 0, 3] * shape[r] ** 2
        quick += stepped[r, 1, 3] * shape[r] ** 2
    give += step**2 / (6 * mass)
    quick += step / (2 * mass)
    depth, velocity, now = 0.0, speed, 0.0
    lump, lump_speed = np.zeros(n_held), np.zeros(n_held)
    pull = np.zeros(n_held)
    for k in range(1, len(force)):
        moved = moving = 0.0
        for r in range(n_modes):
            drive = now * shape[r]
            other = 0.0
            for d in range(n_held):
                other += pull[d] * held[d, r]
            q, u = state[0, r], state[1, r]
            both = drive * stepped[r, 0, 2] + other * (stepped[r, 0, 2] + stepped[r, 0, 3])
            state[0, r] = stepped[r, 0, 0] * q + stepped[r, 0, 1] * u + both
            both = drive * stepped[r, 1, 2] + other * (stepped[r, 1, 2] + stepped[r, 1, 3])
            state[1, r] = stepped[r, 1, 0] * q + stepped[r, 1, 1] * u + both
            moved += shape[r] * state[0, r]
            moving += shape[r] * state[1, r]
        depth += velocity * step - now * step**2 / (3 * mass)
        velocity -= now * step / (2 * mass)
        free, free_speed = depth - moved, velocity - moving
        new = now if now > 0 else 0.0
        for _ in range(30):
            overlap, rate = free - give * new, free_speed - quick * new
            if overlap <= 0:
                # The force that just keeps them in touch is above the root.
                trial = free / give if free > 0 else 0.0
                if new == 0.0 or trial == 0.0:
                    new = 0.0
                    break
                new = 0.5 * trial if new >= trial else new
                continue
            power = overlap**exponent
            lossy = 1 + loss * rate
            value = new - stiffness * power * lossy
            slope = 1 + stiffness * power * (exponent / overlap * give * lossy + loss * quick)
            change = value / slope
            new -= change
            if abs(change) <= 1e-13 * abs(new) + 1e-12:
                break
        new = max(new, 0.0)
        if free - give * new >= breaks:
            stiffness, breaks = left * stiffness, np.inf
        depth -= new * step**2 / (6 * mass)
        velocity -= new * step / (2 * mass)
        for r in range(n_modes):
            state[0, r] += stepped[r, 0, 3] * new * shape[r]
            state[1, r] += stepped[r, 1, 3] * new * shape[r]
        for d in range(n_held):
            w = u = 0.0
            for r in range(n_modes):
                w += held[d, r] * state[0, r]
                u += held[d, r] * state[1, r]
            lump[d] += step * lump_speed[d]
            pull[d] = linked[d, 2] * (lump[d] - w) + linked[d, 0] * (lump_speed[d] - u)
            lump_speed[d] -= step * pull[d] / linked[d, 1]
        force[k] = now = new
        if k * step > window and new == 0.0:
            return k + 1, velocity
    return len(force), velocity


class Contact(NamedTuple):
    """A rock's force [N] at multiples of a step [s], its last velocity into the beam, and the modes' q and q'."""

    force: Floats
    step: float
    velocity: float
    state: Floats


def hunt_crossley_loss(restitution: Floats) -> Floats:
    """Return D of `F = K x^1.5 (1 + D x' / v)` by `D (1 + e) = ln((1 + D) / (1 - D e))`, by bisection."""
    low, high = np.zeros_like(restitution), (1 - 1e-15) / restitution
    for _ in range(200):
        middle = (low + high) / 2
        above = np.log1p(middle) - np.log1p(-middle * restitution) > middle * (1 + restitution)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.where(restitution < 1, middle, 0.0)


class Stepped:
    """A beam ready to be struck: its modes, their losses and what is attached; steps are kept by their number."""

    def __init__(self, omega: Floats, damping: Floats, held: Floats, linked: Floats, rate: float) -> None:
        self.rate = rate
        self.omega, self.damping, self.held, self.linked = omega, damping, held, linked
        self._kept: dict[float, tuple[Floats, Floats]] = {}

    def strike(
        self,
        shape: Floats,
        give: float,
        mass: float,
        stiffness: float,
        damping_number: float,
        speed: float,
        steps: int = _STEPS,
        exponent: float = 1.5,
        breaks: float = np.inf,
        left: float = 1.0,
    ) -> Contact:
        """Return the contact of one rock at a point with these shapes and static compliance of higher modes.

        At the depth `breaks` [m] its force falls to a part of it.
        """
        deepest = ((exponent + 1) / 2 * mass * speed**2 / stiffness) ** (1 / (exponent + 1))
        contact = 2.9432 * deepest / speed  # Hertz's contact on a rigid wall, others last nearly as long
        finer = max(int(np.ceil(np.log2(steps / (contact * self.rate * _FINE)))), 0)
        step = 1 / (self.rate * _FINE * 2**finer)
        if step not in self._kept:
            # What higher modes give is one mode more, where an even spread of modes has its centre.
            omega = np.append(self.omega, np.sqrt(3) * self.omega[-1])
            self._kept[step] = stepping(omega, np.append(self.damping, self.damping[-1]), step), omega
        stepped, omega = self._kept[step]
        shape = np.append(shape, np.sqrt(give) * omega[-1])
        held = np.hstack([self.held, np.zeros((len(self.held), 1))])
        state, window = np.zeros((2, len(shape))), _WINDOW * contact
        force = np.zeros(int(6 * window / step))
        count, velocity = _strike(
            stepped,
            shape,
            held,
            self.linked,
            mass,
            (stiffness, exponent, breaks, left),
            damping_number / speed,
            speed,
            step,
            window,
            force,
            state,
        )
        last = np.flatnonzero(force[:count] > 0)[-1]
        return Contact(force[: last + 2], step, velocity, state)


def summary(contact: Contact) -> tuple[float, float, float, float]:
    """Return peak force [N], duration of the first contact and end of the last [s], and the last velocity [m/s]."""
    force, step = contact.force, contact.step
    # Force falls to 0 as the depth to the power 3/2: the last two samples tell where.
    ends = np.flatnonzero((force[1:-1] > 0) & (force[2:] == 0)) + 1
    a, b = force[ends - 1] ** (2 / 3), force[ends] ** (2 / 3)
    after = np.where(a > b, np.minimum(b / np.maximum(a - b, 1e-300), 1.0), 1.0)
    last = (ends + after) * step
    return float(force.max()), last[0], last[-1], contact.velocity
