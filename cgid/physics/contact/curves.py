"""Dimensionless curves of a batch of impacts, each by the cheapest method; kernels and threads that compute them.

Numbers of its law, lambda of a plate and gamma of a weight describe an impact, see `cgid.physics.contact._contact`,
which integrates it. A *plain* impact has only Hunt-Crossley damping: its peaks have closed forms, and its pulse comes
from the shipped table (`cgid.measure.fit.family`) unless its restitution is below the table's range.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, cached_property, partial
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from cgid._lib.validation import Floats
from cgid.errors import CgidError, InvalidValue
from cgid.measure.fit import family
from cgid.physics.contact.closed_forms import damping_of, peak_displacement, peak_force

if TYPE_CHECKING:
    from cgid.physics.contact.impact import Impact

Quantity = Literal["force", "displacement"]
#: Error of an integrated pulse over its peak, and the bounds that may be requested.
TOLERANCE, TOLERANCES = 1e-8, (1e-12, 1e-4)
#: Roots of displacements at which the force of a custom law is looked at before its integration; by eye.
_FIRST_TOUCH = np.geomspace(1e-5, 0.1, 41)
#: An attraction above this part of the scale of the force is none by rounding.
_ATTRACTED = 1e-12
#: Smallest restitution of the material: below, the time scales of braking and of rebound are too far apart.
MIN_RESTITUTION = 1e-14
#: A weight g L / v^2 below this times e^0.6 is neglected: over the contact it changes the speed by a fraction of 3e-12.
NEGLIGIBLE_WEIGHT = 1e-12
#: Largest weight g L / v^2: beyond, rounding decides on the rebound. There the restitution is right within 3e-8.
MAX_WEIGHT = 1e4
#: Energy that a law creates, over that of the impact and of its fall, is an error of less than so many times the
#: tolerance (.3 times were found); a closed form agrees with integrated curves within this over the peak.
_CREATED, _CLOSED = 10.0, 1e-6
#: Up to this number of samples nothing is compiled: kernels are interpreted, and numpy evaluates the table.
FEW_SAMPLES = 4096
#: Up to this number of impacts kernels are interpreted unless compiled before, until so many samples were, of which an
#: impact costs so many.
#: No time is measured: which code runs does not depend on how busy a machine is.
_FEW_IMPACTS, _MAX_INTERPRETED, _SAMPLES_OF_IMPACT = 4, 8 * FEW_SAMPLES, 128
_interpreted_samples = 0
_NO_STEPS, _NO_ROWS = np.empty((0, 0)), np.empty(0, np.intp)
#: Minimum number of rows per thread, and maximum number of rows per call, so that Python can react to an interruption.
_MIN_ROWS, _MAX_ROWS = 200, 1024


class Law:
    """A contact law: the force `f = g + c x'` as a function of the approach, and its parameters.

    Subclass it as a frozen dataclass whose fields are the parameters of the law. All functions work in units of the
    impact: length L, time `T0 = L / v` and force `K L^(3/2)` (`Impact.length_scale`, `time_scale`, `force_scale`).

    Attributes
    ----------
    name : str
        Name in scenes and data; empty for a law without one.
    keys : tuple of str
        Keys of a population that a scene passes as fields: one of restitution and yield_pressure; and
        viscous_restitution, exponent, contact_radius, breaking_force, remaining_force.
    pulls : bool
        Whether the force may become attractive on the way back, which ends the contact. Otherwise it ends at w = 0,
        and a force below 0 is an error.
    force : compiled function
        `force(p, history, w)` returns g and c, the force at rest and the damping, where the approach is
        `history[0] + w * w`. p holds the `numbers` of an impact, history four numbers that begin at 0. It must be
        smooth in w, also a little below 0, and create no energy.
    corner : compiled function, optional
        `corner(p, history)` returns the approach at which the path changes on the way in; infinite for none.
    turn : compiled function, optional
        `turn(p, history, x)` changes the history at a corner, and where the sphere turns at the approach x; it returns
        `x - history[0]`.
    """

    name: ClassVar[str] = ""
    keys: ClassVar[tuple[str, ...]] = ()
    pulls: ClassVar[bool] = False
    force: ClassVar[Any] = None
    corner: ClassVar[Any] = None
    turn: ClassVar[Any] = None

    def numbers(self, impact: Impact) -> dict[str, ArrayLike]:
        """Return the numbers p of `force`, by name in its order; arrays broadcast with the impact."""
        return {}

    def closed(self, impact: Impact) -> Curves | None:
        """Return the curves of impacts by a faster method than integration, None without one.

        Those of a custom law are compared with integrated ones, at the first impact.
        """
        return None

    def values(self) -> dict[str, Floats]:
        """Return the parameters that are numbers, by name."""
        own: tuple[Any, ...] = fields(self) if is_dataclass(self) else ()
        values: dict[str, Any] = {one.name: getattr(self, one.name) for one in own}
        return {k: np.asarray(v, np.float64) for k, v in values.items() if v is not None and not isinstance(v, str)}


@dataclass(frozen=True)
class Curves:
    """The curves of n impacts, in units of L, T0 and `K L^(3/2)`: here all are integrated.

    law : the contact law of all of them
    numbers : its numbers, (n, k)
    inelasticity : Zener's lambda of a thin plate, (n,)
    weight : `g L / v^2`, (n,)
    tolerance : permitted error of a pulse over its peak
    """

    #: Fields that all impacts share.
    SHARED: ClassVar[tuple[str, ...]] = ("law", "tolerance")
    #: What the sphere hits, and what helps against too many steps, in messages.
    BODY: ClassVar[str] = "target"
    REMEDY: ClassVar[str] = "lower the loss"

    law: Law | type[Law]
    numbers: Floats
    inelasticity: Floats
    weight: Floats
    tolerance: float

    @property
    def _parameters(self) -> Floats:
        """The numbers p of the law, (n, k)."""
        return self.numbers

    @property
    def _solved(self) -> tuple[Any, ...]:
        """The steps of the impacts, and where those of each begin and end; none where they are integrated again."""
        return _NO_STEPS, _NO_ROWS, _NO_ROWS

    @cached_property
    def plain(self) -> NDArray[np.bool_]:
        """Whether an impact has closed forms."""
        return np.zeros(self.inelasticity.shape, bool)

    @property
    def tabulated(self) -> NDArray[np.bool_]:
        """Whether a pulse comes from the shipped table."""
        return np.zeros(self.inelasticity.shape, bool)

    @property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed."""
        return self._result("restitution")

    @property
    def peak_force(self) -> Floats:
        """Largest force."""
        return self._result("peak_force")

    @property
    def peak_displacement(self) -> Floats:
        """Largest displacement."""
        return self._result("peak_displacement")

    @property
    def end_displacement(self) -> Floats:
        """Displacement at separation: zero except for a viscoelastic or crushed sphere."""
        return self._result("end_displacement")

    @property
    def plate_energy(self) -> Floats:
        """Energy radiated into the plate over `m v^2`."""
        return self._result("plate_energy")

    @property
    def impulse(self) -> Floats:
        """Integral of the force over the contact: `1 + e`, plus the weight times the contact time."""
        pull = self.weight * self.times[0] if self.weight.any() else 0.0
        return np.asarray(1 + self.restitution + pull)

    @property
    def rebound(self) -> Floats:
        """Restitution, or 0 where the sphere does not rebound."""
        return self._summary["restitution"]

    @property
    def times(self) -> tuple[Floats, Floats, Floats]:
        """Contact time, time of the peak force, and time of the largest displacement."""
        return self._result("contact_time"), self._result("time_of_peak"), self._result("compression_time")

    def _result(self, name: str) -> Floats:
        return self._integrated[name]

    @cached_property
    def _summary(self) -> dict[str, Floats]:
        """Integrated results for the rows outside the table; nan elsewhere."""
        from cgid.physics.contact import _contact

        rows = np.flatnonzero(~self.tabulated)
        results = np.full((self.inelasticity.size, len(_contact.RESULTS)), np.nan)
        run = self._kernel("summaries", rows.size)
        in_threads(run, (*self._problem(rows, self.tolerance), results), rows, 1)
        return dict(zip(_contact.RESULTS, results.T, strict=True))

    def _kernel(
        self, name: str, n_impacts: int, n_samples: int = 0, module: ModuleType | None = None
    ) -> Callable[..., None]:
        """Return a kernel of `_contact`, or of another module, with this law."""
        from cgid.physics.contact import _contact

        module = module or _contact
        run, flags = kernel(module, name, n_impacts, n_samples), _contact.flags_of(self.law)
        if not hasattr(run, "py_func"):
            parts = tuple(_interpreted(sys.modules[part.__module__])[part.__name__] for part in module.PARTS)
            run = partial(run, *verbs_of(self.law, compiled=False), (flags, *parts))
        else:
            from cgid._lib.compiled import with_law

            run = partial(with_law, run, *verbs_of(self.law, compiled=True), (flags, *module.PARTS))
        return run if is_builtin(self.law) else partial(_run_own_law, self.law, run)

    def _problem(self, rows: NDArray[np.intp], tolerance: float) -> tuple[Any, ...]:
        """Return the arguments of kernels for these rows."""
        return self._parameters, self.inelasticity, self.weight, max(self.tolerance, tolerance)

    @cached_property
    def _integrated(self) -> dict[str, Floats]:
        """The same results after a check that every sphere rebounds."""
        rows = np.flatnonzero(~self.tabulated)
        self._require_reach()
        self._require_sound_law()
        self._require_separation(rows, self._summary["status"][rows])
        return self._summary

    def _require_reach(self) -> None:
        heavy = self.weight > MAX_WEIGHT
        if heavy.any():
            raise InvalidValue(
                f"g L / v^2, the weight over the force of the impact, must be at most {MAX_WEIGHT:g} for double "
                f"precision to leave a rebound, got {self.weight[heavy][0]:g}; raise the velocity, or leave gravity out"
            )

    def _require_sound_law(self) -> None:
        """Raise `InvalidValue`, with its name, if a custom law has done in an impact what no contact does."""
        if is_builtin(self.law):
            return
        from cgid.physics.contact import _contact

        found = self._summary
        status, separated = found["status"], found["status"] == _contact.SEPARATED
        finite = np.isfinite(np.stack(list(found.values()))).all(axis=0) | self.tabulated
        with np.errstate(all="ignore"):
            scale = 0.5 + self.weight * found["peak_displacement"]
            creates = separated & (self._material_loss(found) < -_CREATED * self.tolerance * scale)
        damping = "a dashpot needs pulls = True, with which the contact ends where the force falls to 0"
        if self.law.pulls:
            damping = "only on the way back may it fall to 0"
        faults = (
            ((status == _contact.NOT_FINITE) | ~finite, "force must be finite, got nan or infinity", "check the law"),
            (status == _contact.ATTRACTS, "force must not be below 0, got an attractive one", damping),
            (status == _contact.TORN, "turn must keep the approach", "return x - history[0], with the new history"),
            (
                creates,
                "the contact must create no energy",
                "let c be 0 or more, and on the way back the force no higher than on the way in",
            ),
        )
        for rows, rule, cure in faults:
            if rows.any():
                row = int(np.flatnonzero(rows)[0])
                got = f", and a restitution of {found['restitution'][row]:g}" * bool(creates[row])
                raise InvalidValue(
                    f"contact law {name_of(self.law)}: {rule} ({self._numbers_of(row)}{got}){self._place(row)}; {cure}"
                )

    def _material_loss(self, found: dict[str, Floats]) -> Floats:
        """Return what the material has taken over `m v^2`, by integrated results."""
        e = found["restitution"]
        fall = found["end_displacement"] + self.inelasticity * (1 + e + self.weight * found["contact_time"])
        return np.asarray(0.5 * (1 - e) * (1 + e) - found["plate_energy"] + self.weight * fall)

    def taken(self, rows: NDArray[np.intp]) -> Self:
        """Return the curves of the given rows, in this order."""
        own = (one.name for one in fields(self) if one.name not in self.SHARED)
        return replace(self, **{name: getattr(self, name)[rows] for name in own})

    def require_rebound(self) -> None:
        """Raise `InvalidValue` if a sphere does not rebound, or not within the range of double precision."""
        if not self.plain.all():
            _ = self._integrated

    def _described(self, row: int) -> str:
        """Return the numbers of an impact for a message."""
        numbers = ", ".join(f"{number:g}" for number in self.numbers[row])
        return f"{name_of(self.law)} {numbers}".strip()

    def _numbers_of(self, row: int) -> str:
        return f"{self._described(row)}, lambda {self.inelasticity[row]:g}, g L / v^2 {self.weight[row]:g}"

    def _place(self, row: int) -> str:
        return f" at index {row}" if self.inelasticity.size > 1 else ""

    def _require_separation(self, rows: NDArray[np.intp], status: Floats) -> None:
        from cgid.physics.contact import _contact

        if (status == _contact.SEPARATED).all():
            return
        index = np.flatnonzero(status != _contact.SEPARATED)[0]
        row = int(rows[index])
        heavy, numbers, where = self.weight[row] > 0, self._numbers_of(row), self._place(row)
        if status[index] == _contact.STAYS:
            raise no_rebound_error(self.BODY, numbers, where)
        hint = f"{self.REMEDY}, or leave gravity out" if heavy else self.REMEDY
        raise InvalidValue(
            f"the impact must end within {_contact.MAX_STEPS} steps of the integration and leave a rebound that double "
            f"precision can follow, got {numbers}{where}; {hint}"
        )

    def evaluate(
        self, times: Floats, time_scale: Floats, amplitude: Floats, quantity: Quantity, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        """Return force or displacement at times (n, k) [s], shape (n, k); 0 outside contact."""
        out = np.empty(times.shape)
        self._evaluate(np.arange(len(times)), times, time_scale, amplitude, quantity, out, threads)
        return out.astype(dtype, copy=False)

    def _evaluate(
        self,
        rows: NDArray[np.intp],
        times: Floats,
        time_scale: Floats,
        amplitude: Floats,
        quantity: Quantity,
        out: Floats,
        threads: int,
    ) -> None:
        from cgid.physics.contact import _contact

        row = _contact.FORCE if quantity == "force" else _contact.DISPLACEMENT
        numbers = (*self._problem(rows, 0.0), *self._solved, times, time_scale, amplitude, row, out)
        in_threads(self._kernel("at_times", *times.shape), numbers, rows, threads)

    def add_to_frames(
        self, frames: NDArray[Any], onset: Floats, step: Floats, amplitude: Floats, threads: int, tolerance: float = 0.0
    ) -> None:
        """Add a force pulse to each of the frames (n, n_samples) in place.

        `onset` is the onset on the sample grid [samples], `step` the sampling interval [T0], `amplitude` is in [N];
        each (n,). A `tolerance` above that of the curves, an error over the peak, saves time.
        """
        self._add(np.arange(len(frames)), frames, onset, step, amplitude, threads, tolerance)

    def _add(
        self,
        rows: NDArray[np.intp],
        frames: NDArray[Any],
        onset: Floats,
        step: Floats,
        amplitude: Floats,
        threads: int,
        tolerance: float,
    ) -> None:
        numbers = (*self._problem(rows, tolerance), *self._solved, frames, onset, step, amplitude)
        in_threads(self._kernel("add_to_frames", *frames.shape), numbers, rows, threads)


def hunt_crossley_curves(impact: Impact, restitution: Floats) -> HuntCrossleyCurves:
    """Return the curves of elastic impacts, or those with Hunt and Crossley's damping of these restitutions."""
    # The contact grows with the damping, about as e^-0.6 T0. A weight is neglected only where the pulse then comes
    # from the table.
    plain = impact.inelasticity == 0
    light = plain & (impact.weight < NEGLIGIBLE_WEIGHT * np.power(restitution, 0.6))
    weight = np.where(light, 0.0, impact.weight)
    given = np.broadcast_to(restitution, weight.shape)
    columns = given.reshape(-1, 1), np.ravel(impact.inelasticity), weight.ravel()
    return HuntCrossleyCurves(impact.dissipation, *columns, impact.tolerance)


@dataclass(frozen=True)
class HuntCrossleyCurves(Curves):
    """The curves of elastic impacts, and of those with Hunt and Crossley's damping; numbers are the restitutions."""

    @property
    def material_restitution(self) -> Floats:
        """Restitution by damping alone, 1 for an elastic material."""
        return self.numbers[:, 0]

    @cached_property
    def plain(self) -> NDArray[np.bool_]:
        """Whether only the damping acts."""
        return np.asarray((self.inelasticity == 0) & (self.weight == 0))

    @cached_property
    def tabulated(self) -> NDArray[np.bool_]:
        """Whether the shipped table covers the pulse."""
        return self.plain & family.in_table(self.material_restitution)

    @cached_property
    def damping(self) -> Floats:
        """D of the Hunt-Crossley loss."""
        damped = self.material_restitution < 1
        damping = np.zeros(damped.shape)
        if damped.any():
            damping[damped] = damping_of(self.material_restitution[damped])
        return damping

    @property
    def _parameters(self) -> Floats:
        return self.damping[:, None]

    @cached_property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed."""
        return self._closed_or_integrated(lambda rows: self.material_restitution[rows], "restitution")

    @cached_property
    def peak_force(self) -> Floats:
        """Largest force."""
        return self._closed_or_integrated(lambda rows: peak_force(self.damping[rows]), "peak_force")

    @cached_property
    def peak_displacement(self) -> Floats:
        """Largest displacement."""
        return self._closed_or_integrated(lambda rows: peak_displacement(self.damping[rows]), "peak_displacement")

    @cached_property
    def end_displacement(self) -> Floats:
        """Displacement at separation: zero."""
        return np.zeros(self.plain.shape)

    @cached_property
    def plate_energy(self) -> Floats:
        """Energy radiated into the plate over `m v^2`."""
        return self._closed_or_integrated(lambda _: np.zeros(()), "plate_energy")

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
        if self.tabulated.any():
            out[:, self.tabulated] = family.times(self.material_restitution[self.tabulated])
        if not self.tabulated.all():
            others = ~self.tabulated
            for row, name in enumerate(("contact_time", "time_of_peak", "compression_time")):
                out[row, others] = self._integrated[name][others]
        return out[0], out[1], out[2]

    def _closed_or_integrated(self, closed: Callable[[NDArray[np.bool_]], Floats], name: str) -> Floats:
        out = np.empty(self.plain.size)
        if self.plain.any():
            out[self.plain] = closed(self.plain)
        if not self.plain.all():
            out[~self.plain] = self._integrated[name][~self.plain]
        return out

    def require_rebound(self) -> None:
        """Raise `InvalidValue` if a sphere does not rebound, or not within the range of double precision."""
        beyond = self.material_restitution < MIN_RESTITUTION
        if beyond.any():
            raise InvalidValue(
                f"the restitution of the material must be {MIN_RESTITUTION:g} or more for double precision to "
                f"follow the impact, got {self.material_restitution[beyond][0]:g}"
            )
        super().require_rebound()

    def _described(self, row: int) -> str:
        return f"restitution of the material {self.material_restitution[row]:g}"

    def evaluate(
        self, times: Floats, time_scale: Floats, amplitude: Floats, quantity: Quantity, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        """See `Curves.evaluate`."""
        out = np.empty(times.shape, dtype)
        rows, others = np.flatnonzero(self.tabulated), np.flatnonzero(~self.tabulated)
        if rows.size * times.shape[1] <= FEW_SAMPLES:
            restitution = self.material_restitution[rows]
            with np.errstate(over="ignore"):  # long past separation
                tau = times[rows] / time_scale[rows, None]
            out[rows] = amplitude[rows, None] * getattr(family, quantity)(tau, restitution)
        else:
            from cgid.physics.contact import _kernels

            columns, where = getattr(family.table(), quantity), family.coordinate(self.material_restitution)
            cubic = quantity == "force"
            in_threads(_kernels.at_times, (times, where, time_scale, amplitude, columns, cubic, out), rows, threads)
        if others.size:
            self._evaluate(others, times, time_scale, amplitude, quantity, out, threads)
        return out

    def _add(
        self,
        rows: NDArray[np.intp],
        frames: NDArray[Any],
        onset: Floats,
        step: Floats,
        amplitude: Floats,
        threads: int,
        tolerance: float,
    ) -> None:
        tabulated, others = np.flatnonzero(self.tabulated), np.flatnonzero(~self.tabulated)
        if tabulated.size:
            from cgid.physics.contact import _kernels

            where, columns = family.coordinate(self.material_restitution), family.table().force
            run = kernel(_kernels, "add_to_frames", *frames.shape)
            in_threads(run, (frames, onset, step, where, amplitude, columns), tabulated, threads)
        if others.size:
            super()._add(others, frames, onset, step, amplitude, threads, tolerance)


@cache
def _compiled_builtin(function: Callable[..., Any]) -> Any:
    """Return a function of a built-in law, compiled or from the cache."""
    from cgid._lib.compiled import jit

    return jit(function)


def is_builtin(law: Law | type[Law]) -> bool:
    """Return whether a law is built in."""
    return (law if isinstance(law, type) else type(law)).__module__ == "cgid.physics.contact.laws"


def name_of(law: Law | type[Law]) -> str:
    """Return the name of a law, or that of its class."""
    return law.name or (law if isinstance(law, type) else type(law)).__name__


@contextmanager
def own_code(law: Law | type[Law]) -> Iterator[None]:
    """Turn whatever the code of a custom law raises into `InvalidValue` with its name."""
    try:
        yield
    except (CgidError, KeyboardInterrupt):
        raise
    except BaseException as error:
        if is_builtin(law):
            raise
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}".removesuffix(": ")
        raise InvalidValue(
            f"contact law {name_of(law)}: must work for every impact, but raised {said}; check the law"
        ) from None


def _run_own_law(law: Law | type[Law], run: Callable[..., None], *arguments: Any) -> None:
    """Call a kernel with a custom law."""
    with own_code(law):
        run(*arguments)


def require_numbers(law: Law, numbers: Floats) -> None:
    """Raise `InvalidValue` if a custom law reads more numbers than it has, or begins with attraction.

    Compiled, it would read other memory; and steps of a loose tolerance pass over the first touch.
    """
    for verb, more in zip(verbs_of(law, compiled=False), ((0.5,), (), (0.5,)), strict=True):
        try:
            verb(numbers.copy(), np.zeros(4), *more)
        except IndexError as error:
            raise InvalidValue(
                f"contact law {name_of(law)}: its functions must read the {numbers.size} numbers of the law and the "
                f"four of the history, but {error}; return more from numbers"
            ) from None
        except Exception:
            # It may need a history that it does not have here; the integration reports other errors.
            continue
    force = verbs_of(law, compiled=False)[0]
    try:
        at = [(force(numbers.copy(), np.zeros(4), w)[0], w) for w in _FIRST_TOUCH.tolist()]
    except Exception:
        return
    lowest, w = min(at)
    if lowest < -_ATTRACTED:
        raise InvalidValue(
            f"contact law {name_of(law)}: force must not be below 0, got an attractive one at first touch, "
            f"{lowest:.2g} at w = {w:.2g}; a contact that attracts is no impact"
        )


def require_equal(law: Law, closed: Any, exact: Curves) -> None:
    """Raise `InvalidValue` unless the curves of a custom law are, at the first impact, those integrated."""
    with own_code(law):
        if not isinstance(closed, Curves) or closed.inelasticity.shape != exact.inelasticity.shape:
            raise InvalidValue(
                f"contact law {name_of(law)}: closed must return the Curves of {exact.inelasticity.size} impacts or "
                f"None, got {type(closed).__name__}; return None"
            )
        first = np.zeros(min(exact.inelasticity.size, 1), np.intp)
        exact, closed = replace(exact.taken(first), tolerance=min(exact.tolerance, TOLERANCE)), closed.taken(first)
        times, unit = np.linspace(0, 1.2, 60) * exact.times[0][:, None], np.ones(first.size)
        found, wanted = (
            np.concatenate(
                (
                    *(one.restitution, one.peak_force, one.peak_displacement, one.times[0]),
                    one.evaluate(times, unit, unit, "force", "float64", 1).ravel(),
                )
            )
            for one in (closed, exact)
        )
        error = float(np.abs(found - wanted).max(initial=0) / np.abs(wanted).max(initial=1))
    if not error <= _CLOSED:
        raise InvalidValue(
            f"contact law {name_of(law)}: closed must return the curves that force gives, they differ by {error:.2g} "
            f"of the peak ({exact._numbers_of(0)}); correct closed, or leave it out"
        )


def verbs_of(law: Law | type[Law], *, compiled: bool) -> tuple[Any, ...]:
    """Return force, corner and turn of a law: compiled, or as plain Python functions."""
    from cgid.physics.contact import _contact

    verbs = law.force, law.corner or _contact.no_corner, law.turn or _contact.no_turn
    if not compiled:
        return tuple(getattr(verb, "py_func", verb) for verb in verbs)
    return tuple(verb if hasattr(verb, "py_func") else _compiled_builtin(verb) for verb in verbs)


def kernel(module: ModuleType, name: str, n_impacts: int, n_samples: int = 0) -> Callable[..., None]:
    """Return a kernel for this amount of work: compiled, or interpreted for the first few impacts of a process.

    Compiling takes seconds, once after installing; interpreting takes milliseconds per pulse. Both run the same
    operations in the same order and return the same bits. Pass the size of the complete batch, not only of the rows
    that need the kernel.
    """
    global _interpreted_samples
    compiled: Callable[..., None] = getattr(module, name)
    total = _interpreted_samples + n_impacts * max(n_samples, _SAMPLES_OF_IMPACT)
    few = n_impacts <= _FEW_IMPACTS and n_impacts * n_samples <= FEW_SAMPLES and total <= _MAX_INTERPRETED
    if not few or _is_ready(compiled):
        return compiled
    _interpreted_samples = total
    return partial(_interpret, module, name)


def _is_ready(kernel: Any) -> bool:
    """Return whether the process has compiled a kernel, or read it from the cache."""
    return bool(getattr(kernel, "overloads", True))


def _interpret(module: ModuleType, name: str, *arguments: Any) -> None:
    with np.errstate(all="ignore"):
        _interpreted(module)[name](*arguments)


def no_rebound_error(target: str, numbers: str, where: str) -> InvalidValue:
    """Return the error for a sphere that does not rebound."""
    return InvalidValue(
        f"the sphere must rebound, but its weight holds it on the {target} ({numbers}){where}; "
        "raise the velocity or the restitution, or leave gravity out"
    )


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
    threads = max(min(threads, -(-rows.size // _MIN_ROWS)), 1)
    parts = np.array_split(rows, max(threads, -(-rows.size // _MAX_ROWS)))
    in_parts(lambda part: run(*arguments, part), parts, threads)


def in_parts(work: Callable[[NDArray[np.intp]], None], parts: list[NDArray[np.intp]], threads: int) -> None:
    """Do `work` for each non-empty part, in threads if there are several."""
    parts = [part for part in parts if part.size]
    each = _pool(threads).map if min(threads, len(parts)) > 1 else map
    for _ in each(work, parts):
        pass


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return a cached pool: starting threads takes as long as a hundred pulses."""
    return ThreadPoolExecutor(threads, thread_name_prefix="cgid")
