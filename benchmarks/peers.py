"""The same pulses by other packages' solvers of differential equations.

Imported by the work-precision benchmark. Every peer takes a `Population` and a setting and returns the same frames:
2048 samples of float64 at 200 kHz, the force in N, touch exactly at sample 100, zero outside contact.

    for name, peer in PEERS.items():
        few = population.part(0, peer.pulses)
        for setting in peer.settings:
            frames = peer.run(few, **setting)

All peers solve `x'' = -x^(3/2) (1 + D x')`, x(0) = 0, x'(0) = 1, in units of L and T0, in which tolerances are
meaningful: rtol is the tolerance, atol a hundredth of it, for x starts at 0 (for 1 to 1/10000 of it, error and work
follow much the same curve). Right-hand sides are compiled by numba; everything runs on one thread. solve_ivp and the
fixed steps find the separation themselves. odeint stops at given times only, so it receives the contact duration, and
its grid ends there. Compiled peers compile in their first call: call each once before timing.

At touch the force grows as the power 3/2 of the displacement, so equal steps converge at order 2.5, not 4. Graded steps
are equal in sqrt(time) at first, which restores order 4 for about a third more time.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint, solve_ivp

from cgid import shipped
from cgid.scene import load_scene
from cgid.scene.impacts import draw

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.references.make_family import reference_pulse

Floats = NDArray[np.float64]

_jit = numba.njit(error_model="numpy", fastmath=True)

SAMPLING_RATE = 200e3
SAMPLES = 2048
ONSET = 100


@dataclass(frozen=True)
class Population:
    """Impacts `m x'' = -K x^(3/2) (1 + chi x')`, x(0) = 0, x'(0) = v; arrays of shape (n,), SI units.

    mass, stiffness, damping, velocity : m [kg], K [N/m^(3/2)], chi [s/m], v [m/s]
    restitution, contact_duration : results: rebound speed / v, and time in contact [s]
    """

    mass: Floats
    stiffness: Floats
    damping: Floats
    velocity: Floats
    restitution: Floats
    contact_duration: Floats

    def __len__(self) -> int:
        """Return the number of impacts."""
        return self.mass.size

    def part(self, start: int, stop: int) -> Population:
        """Return the impacts from start to stop."""
        return Population(*(getattr(self, field.name)[start:stop] for field in fields(self)))

    @property
    def time_scale(self) -> Floats:
        """T0 = L / v [s]."""
        return (self.mass * self.velocity**2 / self.stiffness) ** 0.4 / self.velocity

    @property
    def force_scale(self) -> Floats:
        """K L^(3/2) [N]."""
        return self.stiffness * (self.mass * self.velocity**2 / self.stiffness) ** 0.6

    @property
    def damping_number(self) -> Floats:
        """D = chi v."""
        return self.damping * self.velocity

    @property
    def spacing(self) -> Floats:
        """One sample in units of T0."""
        return 1 / (SAMPLING_RATE * self.time_scale)

    @property
    def samples_in_contact(self) -> NDArray[np.int64]:
        """Number of samples in contact, including that of touch."""
        return np.ceil(self.contact_duration * SAMPLING_RATE).astype(np.int64)


def population(n: int, seed: int = 0) -> Population:
    scene = load_scene(shipped.scene_path("peers"))
    impacts = [draw(scene, seed, block).impact for block in range(math.ceil(n / 256))]
    columns = (
        [impact.reduced_mass for impact in impacts],
        [impact.contact_stiffness for impact in impacts],
        [impact.dissipation.damping_number / impact.velocity for impact in impacts],
        [impact.velocity for impact in impacts],
        [impact.restitution for impact in impacts],
        [impact.contact_duration for impact in impacts],
    )
    return Population(*(np.concatenate(column)[:n] for column in columns))


def reference_frames(population: Population) -> Floats:
    """Return the exact frames, by quadrature (1e-13 of the peak)."""
    frames = np.zeros((len(population), SAMPLES))
    times = np.arange(SAMPLES - ONSET)
    for i, restitution in enumerate(population.restitution):
        _, force = reference_pulse(float(restitution)).evaluate(times * population.spacing[i])
        frames[i, ONSET:] = force * population.force_scale[i]
    return frames


def frame_errors(frames: Floats, reference: Floats) -> Floats:
    return np.abs(frames - reference).max(axis=1) / reference.max(axis=1)


@_jit
def _force(x: float, u: float, damping: float) -> float:
    return max(x * math.sqrt(x) * (1 + damping * u), 0.0) if x > 0 else 0.0


@_jit
def _rk4(frames, spacing, damping, scale, steps, graded):
    for i in range(frames.shape[0]):
        h, d = spacing[i], damping[i]
        x, u, force = 0.0, 1.0, 0.0
        for k in range(frames.shape[1] - ONSET - 1):
            n, root, width = steps, math.sqrt(k * h), 0.0
            if graded:
                # Equal steps in sqrt(time), in which the pulse is smooth at touch, until they exceed the others.
                stretch = math.sqrt((k + 1) * h) - root
                n = max(n, math.ceil(stretch * 2 * steps / h))
                width = stretch / n
            step = h / n
            for j in range(n):
                if graded:
                    step = width * (2 * root + (2 * j + 1) * width)
                u2 = u - 0.5 * step * force
                a2 = _force(x + 0.5 * step * u, u2, d)
                u3 = u - 0.5 * step * a2
                a3 = _force(x + 0.5 * step * u2, u3, d)
                u4 = u - step * a3
                a4 = _force(x + step * u3, u4, d)
                x += step / 6 * (u + 2 * u2 + 2 * u3 + u4)
                u -= step / 6 * (force + 2 * a2 + 2 * a3 + a4)
                force = _force(x, u, d)
                if x <= 0:
                    break
            if x <= 0:
                break
            frames[i, ONSET + k + 1] = scale[i] * force


def numba_rk4(population: Population, steps: int, graded: bool = False) -> Floats:
    """Runge-Kutta of order 4 in numba, with equal steps per sample; graded: early steps equal in sqrt(time)."""
    frames = np.zeros((len(population), SAMPLES))
    _rk4(frames, population.spacing, population.damping_number, population.force_scale, steps, graded)
    return frames


@_jit
def _right_side(t, y, damping):
    return y[1], -_force(y[0], y[1], damping)


@_jit
def _jacobian(t, y, damping):
    root = math.sqrt(max(y[0], 0.0))
    return np.array([[0.0, 1.0], [-1.5 * root * (1 + damping * y[1]), -max(y[0], 0.0) * root * damping]])


def _separation(t: float, y: Floats, damping: float) -> float:
    return y[0]


_separation.terminal, _separation.direction = True, -1


def _pulse(states: Floats, damping: float) -> Floats:
    x = np.maximum(states[0], 0)
    return np.maximum(x * np.sqrt(x) * (1 + damping * states[1]), 0)


def scipy_solve_ivp(population: Population, method: str, tolerance: float) -> Floats:
    """SciPy's solve_ivp, stopped by an event at separation; it does not receive the duration."""
    frames = np.zeros((len(population), SAMPLES))
    times = np.arange(SAMPLES - ONSET)
    spacings, scales = population.spacing, population.force_scale
    options = {"rtol": tolerance, "atol": tolerance / 100, **({"jac": _jacobian} if method == "Radau" else {})}
    for i, damping in enumerate(population.damping_number.tolist()):
        grid = times * spacings[i]
        span, start = (0.0, grid[-1]), (0.0, 1.0)
        solution = solve_ivp(_right_side, span, start, method, grid, events=_separation, args=(damping,), **options)
        frames[i, ONSET : ONSET + solution.t.size] = scales[i] * _pulse(solution.y, damping)
    return frames


def scipy_odeint(population: Population, tolerance: float) -> Floats:
    """SciPy's odeint (LSODA), the grid cut at separation."""
    frames = np.zeros((len(population), SAMPLES))
    spacings, scales, counts = population.spacing, population.force_scale, population.samples_in_contact
    options = {"rtol": tolerance, "atol": tolerance / 100, "mxstep": 10_000}
    for i, damping in enumerate(population.damping_number.tolist()):
        grid = np.arange(counts[i]) * spacings[i]
        states = odeint(_right_side, (0.0, 1.0), grid, args=(damping,), tfirst=True, **options)
        frames[i, ONSET : ONSET + counts[i]] = scales[i] * _pulse(states.T, damping)
    return frames


class Peer(NamedTuple):
    """A function from population and setting to frames, its settings, and the number of pulses to time."""

    run: Callable[..., Floats]
    settings: list[dict[str, Any]]
    pulses: int


def _tolerances(*exponents: int, **fixed: Any) -> list[dict[str, Any]]:
    return [{**fixed, "tolerance": 10.0**exponent} for exponent in exponents]


_EXPONENTS = (-3, -5, -7, -9, -11)
_STEPS = (1, 4, 16, 64)

#: By name, cheap ones first.
PEERS: dict[str, Peer] = {
    "numba RK4": Peer(numba_rk4, [{"steps": n} for n in _STEPS], 2000),
    "numba RK4, graded": Peer(numba_rk4, [{"steps": n, "graded": True} for n in _STEPS], 2000),
    "odeint": Peer(scipy_odeint, _tolerances(*_EXPONENTS), 200),
    "solve_ivp RK45": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS, method="RK45"), 20),
    "solve_ivp DOP853": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS, method="DOP853"), 20),
    "solve_ivp LSODA": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS, method="LSODA"), 20),
    "solve_ivp Radau": Peer(scipy_solve_ivp, _tolerances(*_EXPONENTS[:-1], method="Radau"), 20),
}
