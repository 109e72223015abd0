"""The cost of a finite-element impact: seconds and memory, other methods, other tools; a part of `finite_element.py`.

scikit-fem is no dependency of cgid: `pip install scikit-fem` in the benchmark's environment.
"""

from __future__ import annotations

import argparse
import inspect
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numba
import numpy as np
from finite_element_cases import CORNERS, impact, peaks, percent, row, solved, table
from scipy import sparse

from cgid.physics.materials import Material
from cgid.validation import Floats
from studies.finite_element import _stepping, assembly, steps
from studies.finite_element.assembly import Body, body
from studies.finite_element.mesh import Mesh
from studies.finite_element.steps import stable_time_step

#: Explicit runs with more steps than this are skipped in the comparison with implicit runs.
MOST_STEPS = 100_000
#: Retardation times [s] besides 0, for explicit against implicit steps.
DELAYS = (0.0, 0.2e-6, 2e-6)


def against_elements(options: argparse.Namespace) -> None:
    """Print peaks, seconds and memory of an impact against elements over the contact radius."""
    columns = ("peak force [N]", "DCS [um]", "duration [us]", "peak pressure [MPa]")
    costs = ("nodes", "steps", "s", "us a step", "memory [MB]", "energy", "momentum")
    table("sphere", "m/s", "elements", *(f"{column}, off by" for column in columns), *costs)
    for sphere, speed in (CORNERS[0], CORNERS[3]):
        runs = [alone(sphere=sphere, velocity=speed, elements=elements) for elements in options.elements]
        finest = runs[-1]
        for run in runs:
            values = [
                f"{run[name]:.5g}, {percent(run[name] / finest[name] - 1)}" for name in run if name in finest["told"]
            ]
            cost = (f"{run['seconds']:.2f}", f"{1e6 * run['seconds'] / run['steps']:.0f}", run["memory"])
            errors = (f"{run['energy']:.0e}", f"{run['momentum']:.0e}")
            row(sphere, f"{speed:g}", run["elements"], *values, run["nodes"], run["steps"], *cost, *errors)
    print("\nMemory: what the process of an impact came to hold more than before it, all loaded and compiled.")


def alone(**case: Any) -> dict[str, Any]:
    """Return the results of an impact in a separate process."""
    script = Path(__file__).with_name("finite_element.py")
    done = subprocess.run([sys.executable, script, "--alone", json.dumps(case)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return dict(json.loads(done.stdout))


def print_alone(case: str) -> None:
    """Compute one impact and print its results as JSON."""
    options = json.loads(case)
    solved(1, 10.0, elements=7)  # compiles, imports
    before = _memory(forget=True)
    start = time.process_time()
    asked = impact(**options)
    history = asked.run()
    seconds, after = time.process_time() - start, _memory()
    force, way, duration = peaks(history)
    told = {"force": force, "way": 1e6 * way, "duration": 1e6 * duration, "pressure": history.peak_pressure / 1e6}
    rest = {
        "told": list(told),
        "elements": options["elements"],
        "nodes": asked.n_nodes,
        "steps": history.n_steps,
        "seconds": seconds,
        "memory": round((after - before) / 1e6, 1),
        "energy": history.energy_error,
        "momentum": history.momentum_error,
    }
    print(json.dumps(told | rest))


def _memory(forget: bool = False) -> float:
    """Return the peak memory of this process, or the peak since its last reset [bytes]; Linux only."""
    process = Path("/proc/self")
    if forget:
        (process / "clear_refs").write_text("5")
    return float((process / "status").read_text().partition("VmHWM:")[2].split()[0]) * 1024


class Spy:
    """Wraps the kernel of the steps; records its run time and its states."""

    def __init__(self) -> None:
        self.seconds, self.steps = 0.0, 0
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, matrix: Any, contact: Any, inertia: Any, state: Any, rows: Any, stride: int) -> bool:
        """Take steps as the kernel does."""
        start = time.process_time()
        found: bool = _stepping.advance(matrix, contact, inertia, state, rows, stride)
        self.seconds += time.process_time() - start
        self.steps += stride * len(rows[1])
        self.calls.append((matrix, tuple(part.copy() for part in state)))
        return found


def product_time(spy: Spy) -> float:
    """Return the time of a step's product with the stiffness [s], the mean over states of a run."""
    costs = []
    for matrix, state in spy.calls[:: max(1, len(spy.calls) // 8)]:
        times = max(20, 1_000_000 // len(matrix[2]))
        costs.append(timed(_products, *matrix, state[0].copy(), np.empty(state[0].size), times)[0] / times)
    return float(np.mean(costs))


@numba.njit(nogil=True)
def _products(starts, columns, blocks, x, out, times):  # type: ignore[no-untyped-def]
    for _ in range(times):
        _stepping._multiply(starts, columns, blocks, x, out)
        x[0] = 1e-300 * out[1]


def timed(work: Callable[..., Any], *arguments: Any, rounds: int = 3) -> tuple[float, Any]:
    """Return the least time of some rounds [s] and the result; with more than one round, the first compiles."""
    times, result = [], None
    for _ in range(rounds + (rounds > 1)):
        start = time.process_time()
        result = work(*arguments)
        times.append(time.process_time() - start)
    return min(times), result


def methods(options: argparse.Namespace) -> None:
    """Print time and error of explicit and implicit steps on one mesh."""
    columns = ("steps of Hertz's duration", "s", "peak off by", "DCS", "duration", "restitution off by", "energy")
    table("b [us]", "explicit step shorter by", "method", *columns)
    elements = 7 if options.quick else options.mesh
    for delay in DELAYS[:2] if options.quick else DELAYS:
        asked = impact(1, 2.0, elements=elements, retardation_time=delay)
        duration, stable = float(asked.hertz.contact_duration), asked.stable_time_step
        shorter = stable_time_step(asked.pair, (0.0, 0.0)) / stable
        runs: list[tuple[str, float | None]] = []
        if duration / stable <= MOST_STEPS:
            runs += [("explicit", 0.5 * stable), ("explicit", None)]
        else:
            runs += [("implicit", duration / 4000)]
        runs += [("implicit", duration / steps) for steps in (125, 250, 500, 1000, 2000)]
        exact = None
        for method, step in runs:
            history, seconds = solved(1, 2.0, elements=elements, retardation_time=delay, method=method, time_step=step)
            exact = history if exact is None else exact
            off = [percent(e, 3) for e in peaks(history) / peaks(exact) - 1]
            bounced = f"{history.restitution - exact.restitution:+.5f}"
            energy = "-" if history.energy_error is None else f"{history.energy_error:.0e}"
            steps = f"{duration / history.time_step:.0f}"
            row(f"{1e6 * delay:g}", f"{shorter:.3g}", method, steps, f"{seconds:.2f}", *off, bounced, energy)
    print(
        f"\nThe first of each b is the truth of the others. Explicit runs of more than {MOST_STEPS} steps are left out."
    )


def peers(options: argparse.Namespace) -> None:
    """Print assembly against scikit-fem, and steps against scipy's product with another contact."""
    _assembly(options)
    table("elements", "stepped by", "us a step", "in the product", "over ours", "peak force [N]", "restitution")
    for elements in options.elements:
        asked, spy = impact(1, 2.0, elements=elements, method="explicit"), Spy()
        with mock.patch.object(steps, "advance", spy):
            history = asked.run()
        ours = spy.seconds / spy.steps
        product = product_time(spy)
        told = (f"{history.peak_force:.5g}", f"{history.restitution:.4f}")
        row(elements, "cgid", f"{1e6 * ours:.1f}", f"{1e6 * product:.1f}", "1", *told)
        pair = asked.pair
        duration = history.contact_duration * (0.05 if elements > 20 else 1.1)
        other = by_scipy(pair.sphere, pair.plate, float(asked.velocity), history.time_step, duration)
        each = other.seconds / other.force.size
        cells = (f"{1e6 * each:.1f}", f"{1e6 * other.product / other.force.size:.1f}", f"{each / ours:.1f}")
        told = ("-", "-") if elements > 20 else (f"{other.force.max():.5g}", f"{other.restitution:.4f}")
        row(elements, "a loop with scipy's product", *cells, *told)


def _assembly(options: argparse.Namespace) -> None:
    ours = (assembly.body, assembly.element_matrices, assembly._elasticity)
    lines = sum(statements(function) for function in ours)
    print(f"\nStiffness and mass of a sphere: {lines} lines here, {statements(by_scikit_fem)} with scikit-fem.")
    table("elements", "of them", "cgid [ms]", "scikit-fem [ms]", "stiffness apart, of the largest", "mass apart")
    for elements in options.elements:
        asked = impact(1, 2.0, elements=elements)
        mesh, material = asked.pair.sphere.mesh, asked.sphere.material
        volume = 4 / 3 * np.pi * float(asked.sphere.radius) ** 3
        own, found = timed(partial(body, volume=volume), mesh, material)
        try:
            other, (stiffness, mass) = timed(by_scikit_fem, mesh, material)
        except ImportError:
            row(elements, len(mesh.elements), f"{1e3 * own:.1f}", "not installed", "-", "-")
            continue
        # cgid scales the masses to those of a ball without corners.
        mass *= found.mass.sum() / mass.sum()
        apart = (
            abs(stiffness - found.stiffness).max() / abs(stiffness).max(),
            _largest(mass - found.mass) / mass.max(),
        )
        row(
            elements, len(mesh.elements), f"{1e3 * own:.1f}", f"{1e3 * other:.1f}", *(f"{error:.0e}" for error in apart)
        )


def _largest(values: Floats) -> float:
    return float(np.abs(values).max())


def statements(function: Callable[..., Any]) -> int:
    """Return the number of lines of a function without docstring, comments and blank lines."""
    text = inspect.getsource(function)
    if function.__doc__:
        text = text.replace(function.__doc__, "")
    kept = (line.strip() for line in text.splitlines())
    return sum(1 for line in kept if line and not line.startswith("#") and line != '""""""')


# --- other tools: assembly by scikit-fem, steps by scipy's product with a sparse matrix ---


def by_scikit_fem(mesh: Mesh, material: Material) -> tuple[Any, Floats]:
    """Return stiffness (CSR) [N/m] and lumped mass [kg] of an axisymmetric body, by scikit-fem."""
    from skfem import Basis, BilinearForm, ElementQuad1, ElementVector, MeshQuad
    from skfem.helpers import ddot, dot, sym_grad, trace

    @BilinearForm
    def stiffness(u: Any, v: Any, w: Any) -> Any:
        r = w.x[0]
        hoop_u, hoop_v = u[0] / r, v[0] / r
        dilation = (trace(sym_grad(u)) + hoop_u) * (trace(sym_grad(v)) + hoop_v)
        return 2 * np.pi * r * (first * dilation + 2 * second * (ddot(sym_grad(u), sym_grad(v)) + hoop_u * hoop_v))

    @BilinearForm
    def mass(u: Any, v: Any, w: Any) -> Any:
        return 2 * np.pi * w.x[0] * density * dot(u, v)

    modulus, nu, density = (
        float(np.asarray(value)) for value in (material.youngs_modulus, material.poisson_ratio, material.density)
    )
    first, second = modulus * nu / ((1 + nu) * (1 - 2 * nu)), modulus / (2 * (1 + nu))
    quadrilaterals = MeshQuad(np.ascontiguousarray(mesh.nodes.T), np.ascontiguousarray(mesh.elements.T))
    basis = Basis(quadrilaterals, ElementVector(ElementQuad1()), intorder=3)
    return stiffness.assemble(basis), np.asarray(mass.assemble(basis).sum(axis=1)).ravel()


@dataclass(frozen=True)
class Stepped:
    """An impact stepped in a Python loop.

    force : (n_steps,) [N]
    seconds, product : time of the whole loop, and of the product in it
    restitution : speed of the mass centre at the end / before
    """

    force: Floats
    seconds: float
    product: float
    restitution: float


def by_scipy(sphere: Body, plate: Body, velocity: float, time_step: float, duration: float) -> Stepped:
    """Compute an impact by central differences with scipy's product and the simplest hard contact.

    Nodes that would penetrate share the impulse that leaves them together at the end of the step (Carpenter, Taylor &
    Katona 1991, Int. J. Numer. Methods Eng. 32, 103); all nodes keep their mass. This other contact on the same
    matrices also checks that of cgid.
    """
    stiffness = sparse.csr_array(sparse.block_diag((sphere.stiffness, plate.stiffness), format="csr"))
    mass, n_sphere = np.concatenate((sphere.mass, plate.mass)), sphere.mass.size
    kick = np.where(np.concatenate((sphere.fixed, plate.fixed)), 0.0, time_step / mass)
    above, below = sphere.contact, plate.contact + n_sphere
    distance = sphere.mesh.nodes[sphere.mesh.contact, 1]
    push = 1 / (time_step * (kick[above] + kick[below]))
    u, v = np.zeros(mass.size), np.zeros(mass.size)
    v[1:n_sphere:2] = -velocity
    total, product = np.zeros(int(duration / time_step)), 0.0
    start = time.process_time()
    for step in range(total.size):
        before = time.process_time()
        pull = stiffness @ u
        product += time.process_time() - before
        v -= kick * pull
        ahead = u + time_step * v
        force = push * np.maximum(ahead[below] - ahead[above] - distance, 0.0)
        v[above] += kick[above] * force
        v[below] -= kick[below] * force
        u += time_step * v
        total[step] = force.sum()
    seconds = time.process_time() - start
    weight = mass[1:n_sphere:2]
    return Stepped(total, seconds, product, float(weight @ v[1:n_sphere:2] / weight.sum() / velocity))
