"""Dimensionless curves of a batch of impacts, each by the cheapest exact method; kernels and threads that compute them.

Four numbers describe an impact: the restitution of the material (which determines the Hunt-Crossley damping), and zeta,
lambda and gamma of `cgid.physics._taylor`. Where the last three are 0, the impact is *plain*: its peaks have closed
forms, and its pulse comes from the shipped table (`cgid.family`) unless its restitution is below the table's range. All
other impacts are integrated.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, partial
from types import FunctionType, ModuleType
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid import family
from cgid.counting import count, counting
from cgid.errors import InvalidValue
from cgid.physics.closed_forms import damping_of, peak_displacement, peak_force
from cgid.validation import Floats

Quantity = Literal["force", "displacement"]
#: Smallest restitutions: below, the time scales of braking and of rebound are too far apart for double precision.
LOWEST_RESTITUTION, LOWEST_ON_A_PLATE = 1e-30, 1e-14
#: Time stepping: smallest error over the peak, steps per contact for an error of 1, and the largest D for stability.
FINEST_STEPPED, _STEPS_FOR_ONE, _MOST_STEPPED_DAMPING = 1e-7, 4.0, 100.0
#: Up to this many samples nothing is compiled: kernels are interpreted, and numpy evaluates the table.
FEW_SAMPLES = 4096
#: Up to this many impacts kernels are interpreted, until this much time [s] has gone into interpreting.
_FEW_IMPACTS, _PATIENCE = 4, 2.0
_spent = 0.0
#: Fewest rows worth another thread, and most rows in one call, so that Python can react to an interruption.
_LEAST, _MOST = 200, 1024


@dataclass(frozen=True)
class Curves:
    """The curves of n impacts, in units of L, T0 and `K L^(3/2)`; all fields are (n,).

    material_restitution : by Hunt-Crossley damping alone; 1 for an elastic or viscoelastic material
    zeta : `A v / L` of a viscoelastic sphere
    inelasticity : Zener's lambda of a thin plate
    weight : `g L / v^2`
    """

    #: Fields that all impacts share.
    SHARED: ClassVar[tuple[str, ...]] = ()

    material_restitution: Floats
    zeta: Floats
    inelasticity: Floats
    weight: Floats

    @classmethod
    def damped(cls, restitution: Floats, *more: Any) -> Self:
        """Return the curves of impacts that lose energy in the material alone; `more` fields are those of a law."""
        nothing = np.zeros(restitution.shape)
        return cls(restitution, nothing, nothing, nothing, *more)

    @cached_property
    def plain(self) -> NDArray[np.bool_]:
        """Whether only Hunt-Crossley damping acts."""
        return np.asarray((self.zeta == 0) & (self.inelasticity == 0) & (self.weight == 0))

    @cached_property
    def tabulated(self) -> NDArray[np.bool_]:
        """Whether the shipped table covers the pulse."""
        return self.plain & family.in_table(self.material_restitution)

    @cached_property
    def damping(self) -> Floats:
        """D of the Hunt-Crossley loss."""
        damped = self.material_restitution < 1
        count("damping_solves", np.count_nonzero(damped))
        damping = np.zeros(self.material_restitution.shape)
        if damped.any():
            damping[damped] = damping_of(self.material_restitution[damped])
        return damping

    @cached_property
    def _parameters(self) -> Floats:
        """The columns `_taylor.PARAMETERS`."""
        return np.stack([self.damping, self.zeta, self.inelasticity, self.weight], axis=1)

    @cached_property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed."""
        return self._closed_or_integrated(lambda rows: self.material_restitution[rows], "restitution")

    @cached_property
    def peak_force(self) -> Floats:
        """Largest force."""
        count("closed_form_peaks", np.count_nonzero(self.plain))
        return self._closed_or_integrated(lambda rows: peak_force(self.damping[rows]), "peak_force")

    @cached_property
    def peak_displacement(self) -> Floats:
        """Largest displacement."""
        count("closed_form_peaks", np.count_nonzero(self.plain))
        return self._closed_or_integrated(lambda rows: peak_displacement(self.damping[rows]), "peak_displacement")

    @cached_property
    def end_displacement(self) -> Floats:
        """Displacement at separation: zero except for a viscoelastic sphere."""
        return self._closed_or_integrated(lambda _: np.zeros(()), "end_displacement")

    @cached_property
    def plate_energy(self) -> Floats:
        """Energy radiated into the plate over `m v^2`."""
        return self._closed_or_integrated(lambda _: np.zeros(()), "plate_energy")

    @property
    def impulse(self) -> Floats:
        """Integral of the force over the contact: `1 + e`, plus the weight times the contact time."""
        pull = self.weight * self.times[0] if self.weight.any() else 0.0
        return np.asarray(1 + self.restitution + pull)

    @property
    def rebound(self) -> Floats:
        """Restitution, or 0 where the sphere does not rebound."""
        if self.plain.all():
            return self.restitution
        return np.where(self.plain, self.material_restitution, self._summary["restitution"])

    @cached_property
    def times(self) -> tuple[Floats, Floats, Floats]:
        """Contact time, time of the peak force, and time of the largest displacement."""
        out = np.empty((3, self.plain.size))
        count("tabulated_times", np.count_nonzero(self.tabulated))
        if self.tabulated.any():
            out[:, self.tabulated] = family.times(self.material_restitution[self.tabulated])
        if not self.tabulated.all():
            rest = ~self.tabulated
            for row, name in enumerate(("contact_time", "time_of_peak", "compression_time")):
                out[row, rest] = self._integrated[name][rest]
        return out[0], out[1], out[2]

    def _closed_or_integrated(self, closed: Callable[[NDArray[np.bool_]], Floats], name: str) -> Floats:
        out = np.empty(self.plain.size)
        if self.plain.any():
            out[self.plain] = closed(self.plain)
        if not self.plain.all():
            out[~self.plain] = self._integrated[name][~self.plain]
        return out

    @cached_property
    def _summary(self) -> dict[str, Floats]:
        """Integrated results for the rows outside the table; nan elsewhere."""
        from cgid.physics import _taylor

        found = np.full((self.plain.size, len(_taylor.RESULTS)), np.nan)
        count("integrated_impacts", np.count_nonzero(~self.tabulated))
        summaries = kernel(_taylor, "summaries", self.plain.size)
        in_threads(summaries, (self._parameters, _taylor.ORDER, 0.0, found), np.flatnonzero(~self.tabulated), 1)
        return dict(zip(_taylor.RESULTS, found.T, strict=True))

    @cached_property
    def _integrated(self) -> dict[str, Floats]:
        """The same results, after checking that every sphere rebounds."""
        rows = np.flatnonzero(~self.tabulated)
        self._require_separation(rows, self._summary["status"][rows])
        return self._summary

    def taken(self, rows: NDArray[np.intp]) -> Self:
        """Return the curves of the given rows, in this order."""
        own = (one.name for one in fields(self) if one.name not in self.SHARED)
        return replace(self, **{name: getattr(self, name)[rows] for name in own})

    def require_rebound(self) -> None:
        """Raise `InvalidValue` if a sphere does not rebound, or not within the range of double precision."""
        lowest = np.where(self.inelasticity > 0, LOWEST_ON_A_PLATE, LOWEST_RESTITUTION)
        beyond = self.material_restitution < lowest
        if beyond.any():
            raise InvalidValue(
                f"the restitution of the material must be {lowest[beyond][0]:g} or more for double precision to "
                f"follow the impact, got {self.material_restitution[beyond][0]:g}"
            )
        if not self.plain.all():
            _ = self._integrated

    def _require_separation(self, rows: NDArray[np.intp], status: Floats) -> None:
        from cgid.physics import _taylor

        if (status == _taylor.SEPARATED).all():
            return
        index = np.flatnonzero(status != _taylor.SEPARATED)[0]
        row = rows[index]
        numbers = (
            f"restitution of the material {self.material_restitution[row]:g}, zeta {self.zeta[row]:g}, "
            f"lambda {self.inelasticity[row]:g}, g L / v^2 {self.weight[row]:g}"
        )
        place = f" at index {row}" if self.plain.size > 1 else ""
        if status[index] == _taylor.STAYS:
            raise InvalidValue(
                f"the sphere must rebound, but its weight holds it on the target ({numbers}){place}; "
                "raise the velocity or the restitution, or leave gravity out"
            )
        cure = "lower the loss, or leave gravity out" if self.weight[row] > 0 else "lower the loss"
        raise InvalidValue(
            f"the loss must leave a rebound that double precision can follow, got {numbers}{place}; {cure}"
        )

    def evaluate(
        self, times: Floats, time_scale: Floats, amplitude: Floats, quantity: Quantity, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        """Return force or displacement at times (n, k) [s], shape (n, k); 0 outside contact."""
        out = np.empty(times.shape, dtype)
        rows, rest = np.flatnonzero(self.tabulated), np.flatnonzero(~self.tabulated)
        count("table_pulses", rows.size)
        count("integrated_pulses", rest.size)
        if rows.size * times.shape[1] <= FEW_SAMPLES:
            restitution = self.material_restitution[rows]
            with np.errstate(over="ignore"):  # long past separation
                tau = times[rows] / time_scale[rows, None]
            out[rows] = amplitude[rows, None] * getattr(family, quantity)(tau, restitution)
        else:
            from cgid.physics import _kernels

            columns, place = getattr(family.table(), quantity), family.coordinate(self.material_restitution)
            cubic = quantity == "force"
            in_threads(_kernels.at_times, (times, place, time_scale, amplitude, columns, cubic, out), rows, threads)
        if rest.size:
            from cgid.physics import _taylor

            row = _taylor.FORCE if quantity == "force" else _taylor.DISPLACEMENT
            numbers = (times, self._parameters, time_scale, amplitude, row, _taylor.ORDER, out)
            in_threads(kernel(_taylor, "at_times", *times.shape), numbers, rest, threads)
        return out

    def add_to_frames(
        self, frames: NDArray[Any], onset: Floats, step: Floats, amplitude: Floats, threads: int, tolerance: float = 0.0
    ) -> None:
        """Add a force pulse to each of the frames (n, n_samples) in place.

        `onset` is the touch on the sample grid [samples], `step` the sampling interval [T0], `amplitude` is in [N];
        each (n,). Pulses outside the table are stepped in time if the `tolerance`, an error over the peak, permits.
        """
        rows, rest = np.flatnonzero(self.tabulated), np.flatnonzero(~self.tabulated)
        count("table_pulses", rows.size)
        count("integrated_pulses", rest.size)
        if counting():
            count("pulse_samples", samples_in_contact(onset, onset + self.times[0] / step, frames.shape[1]))
        if rows.size:
            from cgid.physics import _kernels

            place, columns = family.coordinate(self.material_restitution), family.table().force
            run = kernel(_kernels, "add_to_frames", *frames.shape)
            in_threads(run, (frames, onset, step, place, amplitude, columns), rows, threads)
        if rest.size:
            from cgid.physics import _taylor

            if tolerance >= FINEST_STEPPED:
                stepped = self.damping[rest] < _MOST_STEPPED_DAMPING
                n_steps = int(np.ceil(_STEPS_FOR_ONE * np.power(tolerance, -0.4)))
                numbers = (frames, onset, step, self._parameters, amplitude, self.times[0], n_steps)
                in_threads(kernel(_taylor, "add_stepped", *frames.shape), numbers, rest[stepped], threads)
                rest = rest[~stepped]
            run = kernel(_taylor, "add_to_frames", *frames.shape)
            in_threads(run, (frames, onset, step, self._parameters, amplitude, _taylor.ORDER), rest, threads)


def samples_in_contact(touch: Floats, separation: Floats, n_samples: int) -> int:
    """Return the number of frame samples between touch and separation, both in samples."""
    first = np.clip(np.floor(touch) + 1, 0, n_samples)
    return int(np.sum(np.clip(np.ceil(separation), first, n_samples) - first))


def kernel(module: ModuleType, name: str, n_impacts: int, n_samples: int = 0) -> Callable[..., None]:
    """Return a kernel for this much work: compiled, or interpreted for an impact or two.

    Compiling takes seconds, once after installing; interpreting takes milliseconds per pulse. Both run the same
    operations in the same order and return the same bits. Pass the size of the whole batch, not only of the rows that
    need the kernel.
    """
    if n_impacts > _FEW_IMPACTS or n_impacts * n_samples > FEW_SAMPLES or _spent > _PATIENCE:
        compiled: Callable[..., None] = getattr(module, name)
        return compiled
    return partial(_interpret, module, name)


def _interpret(module: ModuleType, name: str, *arguments: Any) -> None:
    global _spent
    start = time.perf_counter()
    with np.errstate(all="ignore"):
        _interpreted(module)[name](*arguments)
    _spent += time.perf_counter() - start


@cache
def _interpreted(module: ModuleType) -> dict[str, Callable[..., None]]:
    """Return the kernels of a module as plain Python functions that call each other."""
    names = dict(vars(module))
    for name, function in vars(module).items():
        if hasattr(function, "py_func"):
            home = sys.modules[function.__module__]
            names[name] = FunctionType(function.py_func.__code__, names) if home is module else _interpreted(home)[name]
    return names


def in_threads(run: Callable[..., None], arguments: tuple[Any, ...], rows: NDArray[np.intp], threads: int) -> None:
    """Call a kernel, which releases the GIL, for parts of the rows, in threads if there are several.

    Each part is short, so that Ctrl-C works.
    """
    threads = max(min(threads, -(-rows.size // _LEAST)), 1)
    parts = np.array_split(rows, max(threads, -(-rows.size // _MOST)))
    in_parts(lambda part: run(*arguments, part), parts, threads)


def in_parts(work: Callable[[NDArray[np.intp]], Any], parts: list[NDArray[np.intp]], threads: int) -> list[Any]:
    """Return the results of `work` for each non-empty part, in threads if there are several."""
    parts = [part for part in parts if part.size]
    each = _pool(threads).map if min(threads, len(parts)) > 1 else map
    return list(each(work, parts))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return a cached pool: starting threads takes as long as a hundred pulses."""
    return ThreadPoolExecutor(threads, thread_name_prefix="cgid")
