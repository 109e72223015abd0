"""Other tools for the same work: assembly by scikit-fem, steps by scipy's product with a sparse matrix.

scikit-fem is no dependency of cgid: `pip install scikit-fem` in the benchmark's environment.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from cgid.finite_element.assembly import Body
from cgid.finite_element.mesh import Mesh
from cgid.physics.materials import Material
from cgid.validation import Floats


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
