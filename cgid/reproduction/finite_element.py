"""Figures of an independent axisymmetric finite-element run, quoted: the run is not part of this package yet."""

from __future__ import annotations

from dataclasses import dataclass

#: How they were made.
METHOD = (
    "axisymmetric linear elasticity, explicit central differences, lumped mass, hard (Lagrange) contact of two meshed "
    "bodies, the 8 mm plate fixed at its lower face as in the paper, no damping, mesh-converged (the peak moves "
    "less than 0.04 % from 14 to 28 elements over the contact radius)"
)


@dataclass(frozen=True)
class FiniteElementImpact:
    """One impact of a sphere of Table 2 on the plate.

    Parameters
    ----------
    sphere : int
        Number in Table 2.
    velocity : float
        [m/s].
    peak_force, peak_displacement, contact_duration : float
        [N], [m], [s].
    """

    sphere: int
    velocity: float
    peak_force: float
    peak_displacement: float
    contact_duration: float


IMPACTS = (
    FiniteElementImpact(1, 2.0, 1.98e3, 0.231e-3, 338e-6),
    FiniteElementImpact(1, 10.0, 14.20e3, 0.811e-3, 239e-6),
    FiniteElementImpact(3, 2.0, 6.57e3, 0.121e-3, 177e-6),
    FiniteElementImpact(3, 10.0, 46.66e3, 0.428e-3, 125e-6),
)
#: Error of each theory over all twenty impacts (four spheres, five speeds): peak force, DCS, contact duration.
ERRORS_OVER_TWENTY = {
    "hertz": (-0.06, 0.05, 0.05),
    "rigid-sphere": (0.12, -0.12, -0.11),
    "series": (-0.33, 0.47, 0.48),
}
#: What else was found in that run.
FACTS = (
    "Over all twenty impacts the squared correlation exceeds 0.999 for every theory and so tells nothing; "
    "1 - SSres/SStot does tell: 0.97 to 0.98 for K1, 0.52 and below zero for the series theory.",
    "What is left of K1's error is finite size: it falls with the contact radius over R. About half of it is "
    "small-strain error of the finite elements themselves.",
    "A soft penalty contact (0.1 x bulk modulus / element size per area) moves the finite elements onto the series "
    "theory (R^2 0.97): a likely, unproven reason for the agreement that the paper finds with its own simulation.",
    "The converged contact force is smooth. The paper's dense vibration waves appear in mass x acceleration of the "
    "centre node, and an FFT low-pass at 4/T brings that peak back within 1 %.",
)
