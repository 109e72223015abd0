"""Numba kernels: contact forces between surfaces that cannot penetrate each other, and explicit steps in time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.compiled import inner_jit, jit

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int32]


@jit
def press(compliance: Floats, gap: Floats, force: Floats, touching: Flags) -> bool:
    """Fill in contact forces that leave no penetration and no attraction; return False if none were found.

    Forces leave the gaps `gap + compliance @ force`. Forces and gaps must be at least 0, and one of each pair must be
    0: a linear complementarity problem. The touching nodes are guessed (those of the step before), and corrected.
    """
    n = gap.size
    factor = np.empty((n, n))
    place = np.empty(n, np.int64)
    for attempt in range(100 * n):
        k = 0
        for i in range(n):
            force[i] = 0.0
            if touching[i]:
                place[k] = i
                k += 1
        if not _solve(compliance, gap, place[:k], factor, force):
            return False
        changed = False
        for i in range(n):
            left = force[i]
            if not touching[i]:
                left = gap[i]
                for j in range(k):
                    left += compliance[i, place[j]] * force[place[j]]
            if left < 0.0:
                touching[i] = not touching[i]
                changed = True
                if attempt > 2 * n:
                    break  # changing one at a time cannot cycle (Murty 1974, Linear Algebra Appl. 9, 65)
        if not changed:
            return True
    return False


@inner_jit
def _solve(compliance: Floats, gap: Floats, place: NDArray[np.int64], factor: Floats, force: Floats) -> bool:
    """Fill in the forces that close the gaps at some places, by Cholesky's factor of the compliance there.

    False if there is no factor, or a number is not finite.
    """
    k = place.size
    for i in range(k):
        for j in range(i + 1):
            s = compliance[place[i], place[j]]
            for m in range(j):
                s -= factor[i, m] * factor[j, m]
            if i == j and not s > 0.0:
                return False
            factor[i, j] = np.sqrt(s) if i == j else s / factor[j, j]
    for i in range(k):
        s = -gap[place[i]]
        for j in range(i):
            s -= factor[i, j] * force[place[j]]
        force[place[i]] = s / factor[i, i]
    for i in range(k - 1, -1, -1):
        s = force[place[i]]
        for j in range(i + 1, k):
            s -= factor[j, i] * force[place[j]]
        force[place[i]] = s / factor[i, i]
    return bool(np.isfinite(force).all() and np.isfinite(gap).all())


@inner_jit
def _multiply(starts: Indices, columns: Indices, blocks: Floats, x: Floats, out: Floats) -> None:
    """Fill in a matrix of 2 x 2 blocks times a vector."""
    for row in range(starts.size - 1):
        a = 0.0
        b = 0.0
        for k in range(starts[row], starts[row + 1]):
            c = 2 * columns[k]
            p = x[c]
            q = x[c + 1]
            a += blocks[k, 0] * p + blocks[k, 1] * q
            b += blocks[k, 2] * p + blocks[k, 3] * q
        out[2 * row] = a
        out[2 * row + 1] = b


@inner_jit
def _axial(starts: Indices, columns: Indices, blocks: Floats, x: Floats, row: int) -> float:
    """Return the second of the two rows of a matrix that belong to a node, times a vector."""
    b = 0.0
    for k in range(starts[row], starts[row + 1]):
        c = 2 * columns[k]
        b += blocks[k, 2] * x[c] + blocks[k, 3] * x[c + 1]
    return b


@inner_jit
def _meet(
    matrix: Any,
    contact: Any,
    lag: Floats,
    w: Floats,
    before: Floats,
    now: Floats,
    force: Floats,
    touching: Flags,
    scratch: Any,
) -> bool:
    """Put the massless nodes of both bodies in equilibrium with the contact forces; return False if that fails.

    `w` holds displacements (with what damping adds) of all others, and is filled in; `before` and `now`,
    (2, n_contact), are the displacements of the massless nodes a step ago and now; `lag` is retardation time over step.
    """
    starts, columns, blocks = matrix
    touch, inverse, compliance, distance = contact
    gap, pull = scratch
    n = distance.size
    for i in range(n):
        w[touch[0, i]] = 0.0
        w[touch[1, i]] = 0.0
    for body in range(2):
        for i in range(n):
            pull[i] = -_axial(starts, columns, blocks, w, touch[body, i] // 2)
        for i in range(n):
            s = lag[body] * before[body, i]
            for j in range(n):
                s += inverse[body, i, j] * pull[j]
            now[body, i] = s / (1 + lag[body])
    for i in range(n):
        gap[i] = distance[i] + now[0, i] - now[1, i]
    found = press(compliance, gap, force, touching)
    for body in range(2):
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += inverse[body, i, j] * force[j]
            now[body, i] += (s if body == 0 else -s) / (1 + lag[body])
            w[touch[body, i]] = now[body, i] + lag[body] * (now[body, i] - before[body, i])
    return found


@jit
def advance(matrix: Any, contact: Any, inertia: Any, state: Any, rows: Any, stride: int) -> bool:
    """Take explicit steps, a record every `stride` of them; return whether a contact was found in every step.

    Parameters
    ----------
    matrix : tuple
        Starts of rows, columns and blocks (n, 4) of the stiffness, both bodies.
    contact : tuple
        Unknowns that may touch (2, n), inverse of their stiffness for each body (2, n, n), compliance of both (n, n),
        gap (n,).
    inertia : tuple
        Mass, 1 / mass (0 for what is held or massless), step, retardation time of each body (2,), number of the
        sphere's unknowns, unknown of the sphere's centre.
    state : tuple
        Displacements, velocities half a step ago, displacements of the touching nodes a step ago (2, n), forces (n,),
        whether they touch (n,) and the impulse so far (1,): all are updated.
    rows : tuple
        Filled in for each record: forces (n_records, n); displacements of centre and mass centre, acceleration of the
        centre, internal energies of both bodies, kinetic energy, momentum of either, impulse (n_records, 9).
    """
    starts, columns, blocks = matrix
    touch = contact[0]
    mass, inverse_mass, step, retardation, n_sphere, centre = inertia
    u, v, before, force, touching, impulse = state
    forces, values = rows
    size, n = u.size, touch.shape[1]
    w, pull, strained = np.empty(size), np.empty(size), np.empty(size)
    now = np.empty((2, n))
    scratch = (np.empty(n), np.empty(n))
    lag = retardation / step
    damped = retardation[0] > 0.0 or retardation[1] > 0.0
    for record in range(len(values)):
        for inner in range(stride):
            for i in range(n_sphere):
                w[i] = u[i] + retardation[0] * v[i]
            for i in range(n_sphere, size):
                w[i] = u[i] + retardation[1] * v[i]
            if not _meet(matrix, contact, lag, w, before, now, force, touching, scratch):
                return False
            for body in range(2):
                for i in range(n):
                    u[touch[body, i]] = now[body, i]
                    before[body, i] = now[body, i]
            _multiply(starts, columns, blocks, w, pull)
            if inner == 0:
                if damped:
                    _multiply(starts, columns, blocks, u, strained)
                else:
                    strained[:] = pull
                forces[record] = force
                half_kick = step / 2 * force.sum()
                _record(u, v, strained, pull, mass, half_kick, step, n_sphere, values[record])
                values[record, 0] = u[centre]
                values[record, 2] = -pull[centre] * inverse_mass[centre]
                values[record, 8] = impulse[0] + half_kick
            impulse[0] += step * force.sum()
            for i in range(size):
                v[i] -= step * inverse_mass[i] * pull[i]
                u[i] += step * v[i]
    return True


@inner_jit
def _record(
    u: Floats,
    v: Floats,
    strained: Floats,
    pull: Floats,
    mass: Floats,
    half_kick: float,
    step: float,
    n_sphere: int,
    out: Floats,
) -> None:
    """Fill in displacement of the mass centre, energies of sphere and plate, kinetic energy, momentum of either."""
    total, moved, momentum, of_plate = 0.0, 0.0, half_kick, -half_kick
    for i in range(1, n_sphere, 2):
        total += mass[i]
        moved += mass[i] * u[i]
        momentum += mass[i] * v[i]
    for i in range(n_sphere + 1, u.size, 2):
        of_plate += mass[i] * v[i]
    kinetic = 0.0
    for i in range(u.size):
        # The product of the velocities before and after keeps the energy to the last digit, their mean does not.
        kinetic += v[i] * (mass[i] * v[i] - step * pull[i])
    in_sphere, in_plate = 0.0, 0.0
    for i in range(n_sphere):
        in_sphere += u[i] * strained[i]
    for i in range(n_sphere, u.size):
        in_plate += u[i] * strained[i]
    out[1] = moved / total
    out[3] = in_sphere / 2
    out[4] = in_plate / 2
    out[5] = kinetic / 2
    out[6] = momentum
    out[7] = of_plate
