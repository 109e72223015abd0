"""ModalImpact: an impact on a structure given by its modes; contact and modes are solved together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.physics.contact.bodies import HalfSpace
from cgid.physics.contact.curves import FEW_SAMPLES, TOLERANCE, Curves, is_builtin
from cgid.physics.contact.impact import Impact, Unchecked
from cgid.physics.contact.laws import Elastic, HuntCrossley

#: Phase of the fastest mode [rad] in a cell of time for a tolerance of 1, and the widest cell [T0].
_PHASE, _WIDEST = 2.66, 0.0625
#: Up to this many modes an impact is not worth compiling; fewer than the second number cost no less.
_FEW_MODES, _FEWEST_MODES = 256, 32
#: Steps per impact allocated at first, and the most steps in one block of memory.
_USUAL_STEPS, _PIECE = 32, 8192
#: Default window for new contacts after the first onset [T0]: about four undamped contacts.
USUAL_WINDOW = 12.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ModalImpact(Impact):
    """A normal impact of a sphere on a structure given by its modes; parameters may be arrays and broadcast.

    The structure yields at the point of impact, rings, and may swing back and hit the sphere again. Each loss counts
    once: rebound, material loss and the structure's energy add up to the impact energy and the work of gravity. Use it
    instead of an `Impact` on a thin plate where waves return from the edges in time, or where the structure is not a
    plate. On a large plate with enough modes the two agree.

    Parameters
    ----------
    sphere, velocity, stiffness
        As for `Impact`.
    target : HalfSpace
        Material of the structure, for the contact stiffness.
    dissipation : Law
        Loss in the material alone.
    gravity : array_like, 0 or more [m/s^2]
        Pull towards the structure during and between contacts.
    frequency : array_like, (n_modes,) [Hz]
        Undamped natural frequencies, ascending; may be empty.
    damping_ratio : array_like, (n_modes,) or scalar, in (0, 1)
    compliance : array_like, (..., n_modes), 0 or more [1/kg]
        Squared shape at the point of impact over modal mass; the leading axes are those of the impacts.
    residual_compliance : array_like, 0 or more [m/N]
        Static compliance of the omitted higher modes at the point of impact: the sum of
        `compliance / (2 pi frequency)^2` over them, or `2 / (pi Z w)` for a thin plate of impedance Z, cut at w
        [rad/s].
    window : array_like, optional [s]
        Time after the first onset in which a new contact may begin; it is followed to its end. Default: 12 T0, about
        four undamped contacts on a half space.
    tolerance : float, 1e-9 to 1e-4
        Permitted error of the force over its peak.

    Raises
    ------
    InvalidValue
        A value is invalid, shapes do not broadcast, the sphere does not rebound, or double precision cannot represent
        the impact.

    Warns
    -----
    HertzRangeWarning
        The displacement exceeds a tenth of the radius of curvature.

    Notes
    -----
    Modes far above the contact contribute compliance: omitting them makes the structure too stiff, with an error
    proportional to the inverse of the highest frequency. Their residual compliance becomes one more mode with the last
    mode's damping, at sqrt(3) times its frequency. For a plate, whose compliances are spread evenly in frequency, this
    is correct to second order. On a wide plate, modes up to twice the inverse contact duration then give the
    restitution of the thin-plate theory within .001 (lambda of .13 and .5).

    Examples
    --------
    A mode of 20 kg at 50 Hz hardly moves in a third of a millisecond, so sphere and mode are two free masses:

    >>> from cgid.physics import Elastic, HalfSpace, ModalImpact, Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = ModalImpact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     target=HalfSpace(material=STEEL),
    ...     velocity=2.0,
    ...     stiffness="hertz",
    ...     dissipation=Elastic(),
    ...     frequency=[50.0],
    ...     damping_ratio=0.01,
    ...     compliance=[1 / 20],
    ... )
    >>> mass = float(impact.reduced_mass)
    >>> round(float(impact.restitution), 3), round((20 - mass) / (20 + mass), 3)
    (0.991, 0.991)
    """

    frequency: ArrayLike
    damping_ratio: ArrayLike
    compliance: ArrayLike
    residual_compliance: ArrayLike = 0.0
    window: ArrayLike | None = None
    tolerance: float = TOLERANCE
    _tolerances = (1e-9, 1e-4)

    def __post_init__(self) -> None:
        validation.instance("target", self.target, HalfSpace)
        frequency = validation.positive("frequency", self.frequency, "Hz")
        if frequency.ndim != 1:
            raise InvalidValue(f"frequency must be a list of modes, got an array of shape {frequency.shape}")
        validation.ascending("frequency", frequency, "Hz")
        damping = validation.damping_ratio("damping_ratio", self.damping_ratio)
        compliance = validation.not_negative("compliance", self.compliance, "1/kg")
        n_modes = frequency.size
        if damping.shape not in ((), (n_modes,)) or compliance.shape[-1:] != (n_modes,):
            raise InvalidValue(
                f"damping_ratio and the last axis of compliance must have one number for each of the {n_modes} "
                f"frequencies, got shapes {damping.shape} and {compliance.shape}"
            )
        residual = validation.not_negative("residual_compliance", self.residual_compliance, "m/N")
        if residual.any() and not n_modes:
            raise InvalidValue("residual_compliance needs a mode above which it lies, got no frequencies")
        if self.window is not None:
            validation.not_negative("window", self.window, "s")
            validation.hold(self, "window")
        validation.hold(self, "frequency", "damping_ratio", "compliance", "residual_compliance")
        super().__post_init__()

    @cached_property
    def _given(self) -> dict[str, Floats]:
        """Numbers of the impact, broadcast to one shape."""
        given = super()._given
        leading = np.empty(np.shape(self.compliance)[:-1])
        window = np.empty(()) if self.window is None else np.asarray(self.window)
        residual = np.asarray(self.residual_compliance)
        others = {"compliance": leading, "residual_compliance": residual, "window": window}
        shape = validation.broadcast(impacts=given["mass"], **others)[0].shape
        return {name: np.broadcast_to(numbers, shape) for name, numbers in given.items()}

    def _modes(self, shape: tuple[int, ...]) -> tuple[Floats, Floats, Floats]:
        """Return frequencies, damping ratios and compliances (*shape, n_modes); the residual mode comes last."""
        frequency = np.asarray(self.frequency, np.float64)
        damping = np.broadcast_to(np.asarray(self.damping_ratio, np.float64), frequency.shape)
        compliance = np.broadcast_to(np.asarray(self.compliance, np.float64), (*shape, frequency.size))
        residual = np.broadcast_to(np.asarray(self.residual_compliance, np.float64), shape)
        if not residual.any():
            return frequency, damping, compliance
        highest = np.sqrt(3) * frequency[-1]
        share = residual[..., None] * ((2 * np.pi * highest) * (2 * np.pi * highest))
        return (
            np.append(frequency, highest),
            np.append(damping, damping[-1]),
            np.concatenate([compliance, share], axis=-1),
        )

    @cached_property
    def curves(self) -> ModalCurves:
        """The dimensionless curves, one row per impact in C order."""
        size, shape, time_scale = self.reduced_mass.size, self.reduced_mass.shape, self.time_scale.ravel()
        of_family = isinstance(self.dissipation, Elastic | HuntCrossley)
        rigid = super().curves if of_family else self._integrated_curves()
        if not is_builtin(self.dissipation):
            # A structure that runs from the sphere ends a contact: whether the law attracts shows where nothing yields.
            still = np.zeros(size)
            replace(rigid, weight=still, inelasticity=still).require_rebound()
        frequency, ratio, compliance = self._modes(shape)
        window = USUAL_WINDOW if self.window is None else np.asarray(self.window) / self.time_scale
        angular, root = 2 * np.pi * frequency, np.sqrt((1 - ratio) * (1 + ratio))
        # A copy: a read-only array would make the kernel compile again.
        participation = np.array(compliance.reshape(size, frequency.size), order="C")
        modes = (ratio * angular, angular * root, ratio / root, participation)
        window = np.broadcast_to(window, shape).ravel()
        width = _widths(angular, time_scale, float(self.tolerance))
        columns = (rigid.weight, window, self.reduced_mass.ravel(), time_scale, width)
        return solve(rigid, modes, np.stack(columns, axis=1), float(self.tolerance))

    def _result(self, name: str) -> Floats:
        return self._shaped(self.curves.result(name))

    @property
    def restitution(self) -> Floats:
        """Speed away from the structure's rest position after the last contact, over impact speed.

        Negative where the sphere moves on in the direction of impact.
        """
        return self._result("restitution").copy()

    @property
    def contacts(self) -> NDArray[np.intp]:
        """Number of contacts that began within the window."""
        return self._result("contacts").astype(np.intp)

    @property
    def contact_duration(self) -> Floats:
        """Duration of the first contact [s]."""
        return self.time_scale * self._result("contact_time")

    @property
    def end_of_contact(self) -> Floats:
        """Time from first onset to the end of the last contact [s]."""
        return self.time_scale * self._result("end")

    @property
    def radiated_energy(self) -> Floats:
        """Work of the force on the structure over all contacts [J]."""
        return self._energy_scale * self._result("plate_energy")

    @property
    def modal_energy(self) -> Floats:
        """Part of the radiated energy still in the modes at the end of the last contact [J]."""
        return self._energy_scale * self._result("modal_energy")

    @property
    def modal_dissipation(self) -> Floats:
        """Part of the radiated energy lost to modal damping by then [J]."""
        return self.radiated_energy - self.modal_energy

    @property
    def dissipated_energy(self) -> Floats:
        """Energy lost in the material, the work of the damping force [J]: integrated, not a remainder."""
        return self._energy_scale * self._result("material_loss")

    @property
    def energy_error(self) -> Floats:
        """Error of the energy balance over the impact energy: rebound, losses and structure less impact and fall."""
        found = 0.5 * self.restitution**2 + self._result("plate_energy") + self._result("material_loss")
        return np.asarray(2 * (found - 0.5 - self._shaped(self.curves.weight) * self._result("end_level")))


class ModalContacts(Unchecked, ModalImpact):
    """Impacts of the engine: `ModalImpact` without its checks."""


@dataclass(frozen=True)
class ModalCurves(Curves):
    """The curves of n impacts, all integrated, in units of L, T0 and `K L^(3/2)`.

    results : columns `_coupled.RESULTS`, (n, n_results)
    steps : columns of `_contact`, (n_steps, n_columns)
    begin, end : first step of each impact, and one past its last
    """

    SHARED: ClassVar[tuple[str, ...]] = (*Curves.SHARED, "steps")
    BODY: ClassVar[str] = "structure"
    REMEDY: ClassVar[str] = "lower the loss, shorten the window, or leave out the fastest modes"

    results: Floats
    steps: Floats
    begin: NDArray[np.intp]
    end: NDArray[np.intp]

    @property
    def _solved(self) -> tuple[Any, ...]:
        return self.steps, self.begin, self.end

    @cached_property
    def _summary(self) -> dict[str, Floats]:
        from cgid.physics.structure import _coupled

        return dict(zip(_coupled.RESULTS, self.results.T, strict=True))

    def _material_loss(self, found: dict[str, Floats]) -> Floats:
        return found["material_loss"]

    def result(self, name: str) -> Floats:
        """Return one column of the results."""
        return self._integrated[name]

    @property
    def impulse(self) -> Floats:
        """Integral of the force over all contacts."""
        return self.result("impulse")


def solve(
    rigid: Curves, modes: tuple[Floats, Floats, Floats, Floats], parameters: Floats, tolerance: float
) -> ModalCurves:
    """Return the curves of impacts solved with the modes; arguments as in `_coupled.follow`."""
    from cgid.physics.structure import _coupled

    n, numbers = len(parameters), rigid._parameters
    results = np.empty((n, len(_coupled.RESULTS)))
    # Sorted by width: the kernel tabulates the free motion of the modes once per width.
    left = np.argsort(parameters[:, -1], kind="stable")
    begin, end, total = np.zeros(n, np.intp), np.zeros(n, np.intp), 0
    pieces = [np.empty((0, _coupled.COLUMNS))]
    # Interpreted, an impact takes a tenth of a second, or a second with some hundred modes.
    follow = rigid._kernel("follow", n, FEW_SAMPLES // _FEW_MODES * max(modes[0].size, _FEWEST_MODES), _coupled)
    while left.size:
        steps = np.empty((_coupled.MAX_STEPS + min(_USUAL_STEPS * left.size, _PIECE), _coupled.COLUMNS))
        here = np.full(left.size + 1, -1)
        follow(numbers, *modes, parameters, tolerance, left, steps, here, results)
        done = np.count_nonzero(here >= 0) - 1
        begin[left[:done]], end[left[:done]] = total + here[:done], total + here[1 : done + 1]
        pieces.append(steps[: here[done]].copy())
        total, left = total + here[done], left[done:]
    own = rigid.law, numbers, rigid.inelasticity, rigid.weight, tolerance
    return ModalCurves(*own, results, np.concatenate(pieces), begin, end)


def _widths(angular: Floats, time_scale: Floats, tolerance: float) -> Floats:
    """Return the width of the cells of each impact [s], the same for as many impacts as possible."""
    allowed = _WIDEST * time_scale
    if not angular.size:
        return np.asarray(allowed)
    resolved = _PHASE * tolerance**0.125 / angular.max()
    # Divide by the smallest power of two >= max(resolved / allowed, 1).
    fraction, exponent = np.frexp(np.maximum(resolved / allowed, 1.0))
    return np.asarray(np.ldexp(resolved, -(exponent - (fraction == 0.5))))
