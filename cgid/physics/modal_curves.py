"""The dimensionless courses of a batch of impacts on structures given by their modes, solved and kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid.errors import InvalidValue
from cgid.physics.collocation import collocation
from cgid.physics.curves import Curves, Quantity
from cgid.physics.dispatch import FEW_SAMPLES, kernel
from cgid.physics.threads import in_threads
from cgid.validation import Floats

#: Gauss nodes and Chebyshev times of a step.
N_NODES, N_TIMES = 16, 32
#: Phase [rad] of the fastest mode in a step: `J_32(8)` is 1e-16. Duration of a step over T0.
_LARGEST_PHASE, _LONGEST_STEP = 16.0, 1.2
#: Modes up to which an impact or two are not worth compiling.
_FEW_MODES = 256
#: Steps of an impact for which there is room at first, and steps that are kept in one piece.
_USUAL_STEPS, _PIECE = 64, 16384


@dataclass(frozen=True)
class ModalCurves(Curves):
    """The courses of n impacts, in units of L, T0 and `K L^(3/2)`; all numbers are solved for, none is a closed form.

    Attributes
    ----------
    results : ndarray, (n, n_results)
        Columns `_coupled.RESULTS`.
    course : ndarray, (n_steps, n_columns)
        Force and displacement step by step, see `_coupled`.
    begin, end : ndarray, (n,)
        Which of the steps are an impact's.
    """

    results: Floats
    course: Floats
    begin: NDArray[np.intp]
    end: NDArray[np.intp]

    @cached_property
    def plain(self) -> NDArray[np.bool_]:
        """Nowhere."""
        return np.zeros(len(self.results), bool)

    @cached_property
    def _summary(self) -> dict[str, Floats]:
        from cgid.physics import _coupled

        return dict(zip(_coupled.RESULTS, self.results.T, strict=True))

    def result(self, name: str) -> Floats:
        """Return a column of the results."""
        return self._integrated[name]

    @property
    def impulse(self) -> Floats:
        """Integral of the force over all contacts."""
        return self.result("impulse")

    def taken(self, rows: NDArray[np.intp]) -> ModalCurves:
        """Return the curves of these rows, in this order."""
        plain = super().taken(rows)
        numbers = (plain.material_restitution, plain.zeta, plain.inelasticity, plain.weight)
        return ModalCurves(*numbers, self.results[rows], self.course, self.begin[rows], self.end[rows])

    def require_rebound(self) -> None:
        """Raise `InvalidValue` where the sphere does not leave again, or not within the reach of double precision."""
        _ = self._integrated

    def _require_separation(self, rows: NDArray[np.intp], status: Floats) -> None:
        from cgid.physics import _coupled

        if (status == _coupled.SEPARATED).all():
            return
        index = np.flatnonzero(status != _coupled.SEPARATED)[0]
        row = rows[index]
        numbers = f"restitution of the material {self.material_restitution[row]:g}, g L / v^2 {self.weight[row]:g}"
        place = f" at index {row}" if self.weight.size > 1 else ""
        if status[index] == _coupled.STAYS:
            raise InvalidValue(
                f"the sphere must rebound, but its weight holds it on the structure ({numbers}){place}; "
                "raise the velocity or the restitution, or leave gravity out"
            )
        raise InvalidValue(
            f"an impact must end within {_coupled.MOST_STEPS} steps and {_coupled.MOST_CONTACTS} contacts, "
            f"got more ({numbers}){place}; raise the restitution, shorten the window, or leave out the fastest modes"
        )

    def evaluate(
        self, times: Floats, time_scale: Floats, amplitude: Floats, quantity: Quantity, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        """Return force or displacement at times (n, k) [s], shape (n, k), zero outside contact."""
        from cgid.physics import _coupled

        out = np.empty(times.shape, dtype)
        numbers = (self.course, self.begin, self.end, time_scale, amplitude, quantity == "displacement", out)
        run = kernel(_coupled, "at_times", *times.shape)
        in_threads(run, (times, *numbers), np.arange(len(times)), threads)
        return out

    def add_to_frames(
        self,
        frames: NDArray[Any],
        onset: Floats,
        step: Floats,
        amplitude: Floats,
        threads: int,
        tolerance: float = 0.0,
    ) -> None:
        """Add the force of all contacts to each of the frames, in place; see `Curves.add_to_frames`."""
        from cgid.physics import _coupled

        numbers = (frames, onset, step, self.course, self.begin, self.end, amplitude)
        in_threads(kernel(_coupled, "add_to_frames", *frames.shape), numbers, np.arange(len(frames)), threads)


def solve(
    frequency: Floats,
    damping_ratio: Floats,
    participation: Floats,
    material_restitution: Floats,
    damping: Floats,
    weight: Floats,
    window: Floats,
    mass: Floats,
    time_scale: Floats,
    tolerance: float,
) -> ModalCurves:
    """Solve contact and modes together, impact by impact.

    Parameters
    ----------
    frequency, damping_ratio : ndarray, (n_modes,)
        [Hz], undamped; below 1.
    participation : ndarray, (n, n_modes)
        Square of the shape at the point of impact over the modal mass [1/kg].
    material_restitution, damping : ndarray, (n,)
        Of the Hunt-Crossley loss.
    weight : ndarray, (n,)
        `g L / v^2`.
    window : ndarray, (n,)
        Time from touch within which a new contact may begin, over T0.
    mass, time_scale : ndarray, (n,)
        Of the sphere [kg], and T0 [s].
    tolerance : float
        What the series of the force may leave out in a step, over the largest force.
    """
    from cgid.physics import _coupled

    angular = 2 * np.pi * frequency
    root = np.sqrt((1 - damping_ratio) * (1 + damping_ratio))
    longest = _longest_steps(angular, time_scale)
    parameters = np.stack([damping, weight, window, mass, time_scale, longest], axis=1)
    results = np.empty((len(mass), len(_coupled.RESULTS)))
    # One after the other with steps of one length, for which what the modes do freely is tabulated once.
    left = np.argsort(longest, kind="stable")
    bounds = np.zeros((2, len(mass)), np.intp)
    pieces, total = [], 0
    # Interpreted, an impact takes a tenth of a second, and a second with some hundred modes.
    follow = kernel(_coupled, "follow", len(mass), FEW_SAMPLES // _FEW_MODES * angular.size)
    columns = _coupled.COEFFICIENTS + 2 * N_NODES
    while left.size:
        course = np.empty((_coupled.MOST_STEPS + min(_USUAL_STEPS * left.size, _PIECE), columns))
        first = np.zeros(left.size + 1, np.intp)
        follow(
            collocation(N_NODES, N_TIMES), damping_ratio * angular, angular * root, damping_ratio / root,
            participation, parameters, tolerance, left, course, first, results,
        )  # fmt: skip
        done = np.flatnonzero(first).size
        bounds[:, left[:done]] = total + first[:done], total + first[1 : done + 1]
        pieces.append(course[: first[done]].copy())
        total, left = total + first[done], left[done:]
    nothing = np.zeros(len(mass))
    return ModalCurves(
        material_restitution, nothing, nothing, weight, results,
        np.concatenate(pieces) if pieces else np.empty((0, columns)), *bounds,
    )  # fmt: skip


def _longest_steps(angular: Floats, time_scale: Floats) -> Floats:
    """Return what a step may last at most [s], the same for as many impacts as can be."""
    allowed = _LONGEST_STEP * time_scale
    if not angular.size:
        return np.asarray(allowed)
    resolved = _LARGEST_PHASE / angular[-1]
    # The least power of two that is not below resolved / allowed, 1 or more.
    fraction, exponent = np.frexp(np.maximum(resolved / allowed, 1.0))
    return np.asarray(np.ldexp(resolved, -(exponent - (fraction == 0.5))))
