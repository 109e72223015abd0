"""Impact: one impact or an array of them, each scaled from its dimensionless curve."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from cgid._lib import validation
from cgid._lib.notebook import facts_table
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue, MissingOption
from cgid.physics.contact import bodies
from cgid.physics.contact.bodies import Sphere, Target, ThinPlate
from cgid.physics.contact.curves import (
    TOLERANCE,
    TOLERANCES,
    Curves,
    Law,
    Quantity,
    is_builtin,
    own_code,
    require_equal,
    require_numbers,
)
from cgid.physics.contact.laws import STIFFNESS_THEORIES, Plastic, stiffness_of

#: Largest displacement over radius for Hertz's small-strain theory.
HERTZ_LIMIT = 0.1
#: Largest lambda for which Zener's thin plate agrees with finer models.
INELASTICITY_LIMIT = 1.5
#: Effect of a larger lambda, and the remedy.
BEYOND_THIN_PLATE = (
    "the plate takes nearly all of the speed, and the contact lasts until waves return from the edges, so force and "
    "rebound are unreliable; use a thicker plate, or an impact coupled to the modes of the beam"
)


class HertzRangeWarning(UserWarning):
    """The displacement is too large relative to the radius for Hertz's theory."""


class ThinPlateWarning(UserWarning):
    """The impact is too heavy for Zener's thin plate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Impact:
    """A normal impact of a sphere on a target; all numbers may be arrays and broadcast.

    Parameters
    ----------
    sphere : Sphere
        The falling body.
    target : HalfSpace, ThinPlate, Sphere or RIGID
        The body at rest.
    velocity : array_like, above 0 [m/s]
        Normal impact speed; for two spheres the relative speed.
    stiffness : {"hertz", "rigid-sphere", "series"}
        Theory of the contact stiffness (see `contact_stiffness`); no default.
    dissipation : Law
        Loss in the material: Elastic, HuntCrossley, Viscoelastic, Thornton, WaltonBraun, PowerLaw or a custom `Law`.
        The loss to a thin plate is added.
    gravity : array_like, 0 or more [m/s^2]
        Pull towards the target during contact. Neglected where it would change the speed by at most 3e-12 of the impact
        speed.
    tolerance : float, 1e-12 to 1e-4
        Permitted error of an integrated pulse over its peak; closed forms and the table of pulses are exact.

    Raises
    ------
    InvalidValue
        A value is invalid, a theory is unknown, shapes do not broadcast, the sphere does not rebound, or double
        precision cannot represent the impact.

    Warns
    -----
    HertzRangeWarning
        The displacement exceeds a tenth of the radius of curvature.
    ThinPlateWarning
        Zener's lambda of a thin plate exceeds 1.5.

    Examples
    --------
    The constants under Eq. 18 of Yang, Zeng & Wan (2018) belong to 2 m/s:

    >>> from cgid.physics import Elastic, HalfSpace, Impact, Sphere
    >>> from cgid.physics import STEEL, YANG2018_SPHERES
    >>> impact = Impact(
    ...     sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    ...     target=HalfSpace(material=STEEL),
    ...     velocity=2.0,
    ...     stiffness="series",
    ...     dissipation=Elastic(),
    ... )
    >>> round(float(impact.peak_displacement) / 0.025, 12)
    0.01337310606
    """

    sphere: Sphere
    target: Target
    velocity: ArrayLike
    stiffness: str
    dissipation: Law
    gravity: ArrayLike = 0.0
    tolerance: float = TOLERANCE
    _tolerances = TOLERANCES

    if not TYPE_CHECKING:

        def __new__(cls, **given: Any) -> Impact:  # noqa: D102 - only for a message that helps
            if given and "dissipation" not in given:
                raise MissingOption("dissipation must be given, such as Elastic(), HuntCrossley(...) or another Law")
            return object.__new__(cls)

    def __post_init__(self) -> None:
        validation.instance("sphere", self.sphere, Sphere)
        validation.instance("target", self.target, *get_args(Target))
        validation.instance("dissipation", self.dissipation, Law)
        if not is_builtin(self.dissipation):
            from cgid.physics.contact.own_laws import require_sound

            require_sound(type(self.dissipation))
        validation.choice("stiffness", self.stiffness, STIFFNESS_THEORIES)
        validation.positive("velocity", self.velocity, "m/s")
        validation.not_negative("gravity", self.gravity, "m/s^2")
        tolerance, (smallest, largest) = validation.real("tolerance", self.tolerance), self._tolerances
        if tolerance.ndim or not smallest <= tolerance <= largest:
            raise InvalidValue(f"tolerance must be one number from {smallest:g} to {largest:g}, got {self.tolerance!r}")
        validation.hold(self, "velocity", "gravity")
        self._require_reach()
        self.curves.require_rebound()
        self._warn_of_range()

    def __repr__(self) -> str:
        ends = [(np.min(one), np.max(one)) if np.size(one) else () for one in (self.sphere.radius, self.velocity)]
        radius, velocity = (" to ".join(dict.fromkeys(f"{end:.4g}" for end in pair)) or "no" for pair in ends)
        shape = np.broadcast_shapes(np.shape(self.reduced_mass), np.shape(self.velocity))
        return (
            f"Impact({f'{shape} of ' if shape else ''}radius {radius} m at {velocity} m/s on "
            f"{type(self.target).__name__}, {self.stiffness}, {type(self.dissipation).__name__})"
        )

    def _repr_html_(self) -> str:
        def ends(values: ArrayLike, factor: float = 1.0) -> str:
            numbers = [f"{end * factor:.4g}" for end in (np.min(values), np.max(values))]
            return " to ".join(dict.fromkeys(numbers))

        facts = {"target": type(self.target).__name__, "law": f"{self.stiffness}, {type(self.dissipation).__name__}"}
        if self.peak_force.size:
            facts |= {
                "radius": f"{ends(self.sphere.radius, 1e3)} mm",
                "velocity": f"{ends(self.velocity)} m/s",
                "peak force": f"{ends(self.peak_force, 1e-3)} kN",
                "contact duration": f"{ends(self.contact_duration, 1e6)} us",
                "restitution": ends(self.restitution),
            }
        several = f" of {self.peak_force.size} rocks" * (self.peak_force.size != 1)
        return facts_table(f"{type(self).__name__}{several}", facts)

    def spectrum(self, frequency: ArrayLike) -> Floats:
        """Return the magnitude of the Fourier transform of the force; at 0 Hz it is the impulse.

        Parameters
        ----------
        frequency : array_like, (n_frequencies,) [Hz]

        Returns
        -------
        ndarray [N s]
            Shape of the impacts, then n_frequencies; by quadrature of the force, to 1e-6 of the impulse.
        """
        frequencies = np.atleast_1d(validation.not_negative("frequency", frequency, "Hz"))
        length = np.asarray(self.end_of_contact)
        panels = 64 + int(np.max(length, initial=0.0) * np.max(frequencies, initial=0.0))
        nodes, weights = np.polynomial.legendre.leggauss(16)
        places = ((np.arange(panels)[:, np.newaxis] + 0.5 * (1 + nodes)) / panels).ravel()
        times = length[..., np.newaxis] * places
        parts = self.force(times) * np.tile(weights / (2 * panels), panels) * length[..., np.newaxis]
        found = [
            np.exp(-2j * np.pi * np.outer(frequencies, time)) @ part
            for time, part in zip(times.reshape(-1, places.size), parts.reshape(-1, places.size), strict=True)
        ]
        return np.abs(np.reshape(found, (*length.shape, frequencies.size)))

    def plot(self, axes: Any = None) -> Any:
        """Draw the contact force over time; of an array, that of each impact.

        Parameters
        ----------
        axes : matplotlib.axes.Axes, optional
            New ones by default.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        MissingExtra
            matplotlib is not installed.
        """
        from cgid.plots.objects import plot_impact

        return plot_impact(self, axes)

    def _require_reach(self) -> None:
        with np.errstate(all="ignore"):
            scales = {
                "mass": (self.reduced_mass, "kg"),
                "contact stiffness": (self.contact_stiffness, "N/m^(3/2)"),
                "displacement": (self.length_scale, "m"),
                "duration": (self.time_scale, "s"),
                "force": (self.force_scale, "N"),
                "energy": (self._energy_scale, "J"),
                "square of the velocity": (self._velocity**2, "m^2/s^2"),
                "weight": (1 + self.weight, "times the force"),  # it may be 0
                **{name: (1 + np.abs(one), "of that of the impact") for name, one in self._numbers.items()},
            }
            if isinstance(self.target, ThinPlate):
                scales["plate impedance"] = (self.target.impedance, "kg/s")
        for name, (scale, unit) in scales.items():
            is_normal = (scale > 1e-290) & (scale < 1e290)
            if not is_normal.all():
                raise InvalidValue(
                    f"the {name} of the impact must be between 1e-290 and 1e290 {unit} for double precision, got "
                    f"{scale[~is_normal].ravel()[0]:g} {unit}; check radius, material, velocity and loss"
                )

    def _warn_of_range(self) -> None:
        # Without weight and crushing an elastic impact is the deepest, and cheap: its depth needs no damping number.
        deeper = np.any(self.curves.weight) or isinstance(self.dissipation, Plastic)
        if deeper or (1.1 * self.length_scale > HERTZ_LIMIT * self.reduced_radius).any():
            strain = (self.peak_displacement / self.reduced_radius).max(initial=0.0)
            if strain > HERTZ_LIMIT:
                message = f"displacement / radius reaches {strain:.3g}; Hertz's theory is valid up to {HERTZ_LIMIT:g}"
                warnings.warn(message, HertzRangeWarning, stacklevel=4)
        largest = self.inelasticity.max(initial=0.0)
        if largest > INELASTICITY_LIMIT:
            message = (
                f"lambda of the thin plate reaches {largest:.3g}; Zener's theory is valid up to "
                f"{INELASTICITY_LIMIT:g}: {BEYOND_THIN_PLATE}"
            )
            warnings.warn(message, ThinPlateWarning, stacklevel=4)

    @cached_property
    def _given(self) -> dict[str, Floats]:
        """Numbers of the impact, broadcast to one shape."""
        with own_code(self.dissipation):
            of_loss = self.dissipation.values()
        named = {
            "radius": bodies.reduced_radius(self.sphere, self.target),
            "mass": bodies.reduced_mass(self.sphere, self.target),
            "modulus": bodies.reduced_modulus(self.sphere, self.target),
            "velocity": np.asarray(self.velocity, dtype=np.float64),
            "gravity": np.asarray(self.gravity, dtype=np.float64),
            "thickness": np.asarray(self.target.thickness if isinstance(self.target, ThinPlate) else 0.0),
            **{f"{name} of the loss": one for name, one in of_loss.items()},
        }
        return dict(zip(named, self._broadcast(named), strict=True))

    def _broadcast(self, named: dict[str, Floats]) -> tuple[Floats, ...]:
        return validation.broadcast(**named)

    @property
    def _velocity(self) -> Floats:
        return self._given["velocity"]

    @property
    def _energy_scale(self) -> Floats:
        """`m v^2` [J], the unit of energy."""
        return self.reduced_mass * self._velocity**2

    @cached_property
    def weight(self) -> Floats:
        """Weight over the force scale, `g L / v^2`."""
        return self._given["gravity"] * self.length_scale / self._velocity**2

    @property
    def reduced_radius(self) -> Floats:
        """Reduced radius R of the contact [m]."""
        return self._given["radius"]

    @property
    def reduced_modulus(self) -> Floats:
        """Reduced modulus E of the contact [Pa]."""
        return self._given["modulus"]

    @property
    def reduced_mass(self) -> Floats:
        """Reduced mass m of the relative motion [kg]."""
        return self._given["mass"]

    @cached_property
    def contact_stiffness(self) -> Floats:
        """K of `P = K delta^(3/2)` [N/m^(3/2)]."""
        return _fixed(stiffness_of(self.reduced_radius, self.reduced_modulus, STIFFNESS_THEORIES[self.stiffness]))

    @cached_property
    def length_scale(self) -> Floats:
        """`L = (m v^2 / K)^(2/5)` [m], the unit of displacement."""
        return _fixed(np.power(self.reduced_mass * self._velocity**2 / self.contact_stiffness, 0.4))

    @cached_property
    def time_scale(self) -> Floats:
        """`T0 = L / v` [s], the unit of time."""
        return _fixed(self.length_scale / self._velocity)

    @cached_property
    def force_scale(self) -> Floats:
        """`K L^(3/2)` [N], the unit of force."""
        return _fixed(self.contact_stiffness * self.length_scale * np.sqrt(self.length_scale))

    @cached_property
    def inelasticity(self) -> Floats:
        """Zener's `lambda = m / (Z T0)` of a thin plate; 0 for other targets."""
        if not isinstance(self.target, ThinPlate):
            return _fixed(np.zeros(self.reduced_mass.shape))
        return _fixed(self.reduced_mass / (self.target.impedance * self.time_scale))

    @cached_property
    def _numbers(self) -> dict[str, Floats]:
        """Numbers of the contact law, by name, broadcast to the shape of the impact."""
        shape = self.reduced_mass.shape
        with own_code(self.dissipation):
            return {
                name: np.broadcast_to(np.asarray(one, np.float64), shape)
                for name, one in self.dissipation.numbers(self).items()
            }

    @cached_property
    def curves(self) -> Curves:
        """The dimensionless curves, one row per impact in C order."""
        with own_code(self.dissipation):
            closed = self.dissipation.closed(self)
        if closed is None or is_builtin(self.dissipation):
            return self._integrated_curves() if closed is None else closed
        require_equal(self.dissipation, closed, self._integrated_curves())
        return closed

    def _integrated_curves(self) -> Curves:
        columns = [one.ravel() for one in self._numbers.values()]
        numbers = np.stack(columns, axis=1) if columns else np.empty((self.reduced_mass.size, 0))
        if len(numbers) and not is_builtin(self.dissipation):
            with own_code(self.dissipation):
                require_numbers(self.dissipation, numbers[0])
        return Curves(self.dissipation, numbers, np.ravel(self.inelasticity), self.weight.ravel(), self.tolerance)

    def plain_curves(self, make: Callable[..., Curves], *names: str) -> Curves | None:
        """Return the curves that `make` returns for parameters of the law, None if a plate or a weight acts."""
        if self.inelasticity.any() or self.weight.any():
            return None
        return make(*(self._numbers[name].ravel() for name in names))

    def _shaped(self, values: Floats) -> Floats:
        return np.asarray(values.reshape(self.reduced_mass.shape))

    @property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed, from the losses in both material and plate."""
        return self._shaped(self.curves.restitution).copy()

    @property
    def peak_displacement(self) -> Floats:
        """Largest displacement, the approach of sphere and target [m].

        Except on a thin plate, which yields, it is the displacement of the sphere's centre. With only Hunt-Crossley
        damping it has the closed form `L (5/2 G(1))^(2/5)`.
        """
        return self.length_scale * self._shaped(self.curves.peak_displacement)

    @property
    def peak_force(self) -> Floats:
        """Largest contact force [N]; with damping it precedes the largest displacement."""
        return self.force_scale * self._shaped(self.curves.peak_force)

    @property
    def contact_duration(self) -> Floats:
        """Time from onset to separation [s]."""
        return self.time_scale * self._shaped(self.curves.times[0])

    @property
    def end_of_contact(self) -> Floats:
        """Time from first onset to last separation [s]: the contact duration, unless a `ModalImpact` touches again."""
        return self.contact_duration

    @property
    def time_of_peak(self) -> Floats:
        """Time from onset to the largest force [s]."""
        return self.time_scale * self._shaped(self.curves.times[1])

    @property
    def compression_time(self) -> Floats:
        """Time from onset to the largest displacement [s]."""
        return self.time_scale * self._shaped(self.curves.times[2])

    @property
    def end_displacement(self) -> Floats:
        """Approach at separation [m]: 0, except for a viscoelastic or crushed sphere, which is flattened."""
        return self.length_scale * self._shaped(self.curves.end_displacement)

    @property
    def rebound_velocity(self) -> Floats:
        """Speed at separation, `e v` [m/s]."""
        return self.restitution * self._velocity

    @property
    def impulse(self) -> Floats:
        """Integral of the force over the contact, `(1 + e) m v` plus weight times contact time [N s]."""
        return self._shaped(self.curves.impulse) * self.reduced_mass * self._velocity

    @property
    def radiated_energy(self) -> Floats:
        """Energy that a thin plate carries away, the integral of `P^2 / Z` [J]; 0 for other targets."""
        return self._energy_scale * self._shaped(self.curves.plate_energy)

    @property
    def dissipated_energy(self) -> Floats:
        """Energy lost in the material; without plate and gravity `1/2 m v^2 (1 - e^2)` [J].

        It is the impact energy minus rebound and plate. With gravity it includes the sphere's fall during contact, by
        its own displacement and that of a plate.
        """
        e = self.restitution
        lost = 0.5 * self._energy_scale * (1 - e) * (1 + e) - self.radiated_energy
        if np.any(self.curves.weight):
            way = self.curves.end_displacement + self.curves.inelasticity * self.curves.impulse
            lost = lost + self._energy_scale * self._shaped(self.curves.weight * way)
        return np.asarray(lost)

    def force(self, times: ArrayLike, *, dtype: DTypeLike = "float64", threads: int = 1) -> NDArray[Any]:
        """Return the contact force over time.

        Parameters
        ----------
        times : array_like, (..., n_times) [s]
            Time since onset, along the last axis.
        dtype : {"float64", "float32"}
        threads : int
            Number of threads that share the impacts.

        Returns
        -------
        ndarray [N]
            Never negative, 0 outside contact. Shape of `times` for a single impact, otherwise the impacts' shape
            broadcast against the leading axes of `times`, then n_times.
        """
        return self._over_time(times, "force", self.force_scale, dtype, threads)

    def displacement(self, times: ArrayLike, *, dtype: DTypeLike = "float64", threads: int = 1) -> NDArray[Any]:
        """Return the displacement, the approach of sphere and target [m], over time; see `force`."""
        return self._over_time(times, "displacement", self.length_scale, dtype, threads)

    def _over_time(
        self, times: ArrayLike, quantity: Quantity, amplitude: Floats, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        dtype = _output(dtype, amplitude)
        threads = validation.count("threads", threads)
        given = validation.real("times", times, "s")
        row = np.atleast_1d(given)
        leading, index = self._broadcast_with(times=np.empty(row.shape[:-1]))
        shape = (*leading, row.shape[-1])
        rows = np.ascontiguousarray(np.broadcast_to(row, shape)).reshape(index.size, row.shape[-1])
        unit, height = self.time_scale.ravel()[index], amplitude.ravel()[index]
        curves = self._curves_of(leading, index)
        out = curves.evaluate(rows, unit, height, quantity, dtype, threads).reshape(shape)
        return out[..., 0] if given.ndim == 0 else out

    def force_frames(
        self,
        sampling_rate: float,
        n_samples: int,
        onset: ArrayLike = 0.0,
        *,
        dtype: DTypeLike = "float64",
        threads: int = 1,
    ) -> NDArray[Any]:
        """Return the contact force on the sample grid of a recorder, one frame per impact.

        It computes only the samples in contact. The values equal those of `force` up to rounding.

        Parameters
        ----------
        sampling_rate : float [Hz]
        n_samples : int
            Length of a frame.
        onset : array_like [s]
            Time of onset relative to the start of the frame; it may be outside the frame.
        dtype : {"float64", "float32"}
        threads : int
            Number of threads that share the impacts.

        Returns
        -------
        ndarray, (..., n_samples) [N]
            The leading axes are those of the impacts and onsets.
        """
        dtype = _output(dtype, self.force_scale)
        n_samples = validation.count("n_samples", n_samples)
        onsets = validation.real("onset", onset, "s")
        frames = np.zeros((*self._broadcast_with(onset=onsets)[0], n_samples), dtype)
        if np.ndim(sampling_rate):
            raise InvalidValue(f"sampling_rate must be one number, got an array of shape {np.shape(sampling_rate)}")
        self.add_to_frames(frames, sampling_rate, onsets, threads=threads)
        return frames

    def add_to_frames(
        self,
        frames: NDArray[Any],
        sampling_rate: ArrayLike,
        onset: ArrayLike,
        *,
        threads: int = 1,
        tolerance: float = 0.0,
    ) -> None:
        """Add the contact force to frames in place; their shape is that of `force_frames`.

        Each frame may have its own sampling rate. `tolerance` is the permitted error over the peak force of integrated
        pulses, where it is above that of the impact.

        Parameters
        ----------
        frames : ndarray, (..., n_samples) [N]
            Float32 or float64; the leading axes are those of the impacts and onsets.
        sampling_rate : float [Hz]
        onset : array_like [s]
            Time of onset relative to the start of the frame.
        tolerance : float
            Permitted error over the peak.
        threads : int
            Number of threads that share the impacts.

        Raises
        ------
        InvalidValue
            The frames have the wrong shape or type, or are not contiguous.
        """
        rate = validation.positive("sampling_rate", sampling_rate, "Hz")
        threads = validation.count("threads", threads)
        onsets = validation.real("onset", onset, "s")
        leading, index = self._broadcast_with(onset=onsets, sampling_rate=rate)
        _require_frames(frames, leading)
        _output(frames.dtype, self.force_scale)
        with np.errstate(over="ignore", divide="ignore"):  # onset or separation may be far outside the frame
            place = np.broadcast_to(onsets * rate, leading).ravel()
            step = 1 / (np.broadcast_to(rate, leading).ravel() * self.time_scale.ravel()[index])
        rows, height = frames.reshape(index.size, frames.shape[-1]), self.force_scale.ravel()[index]
        self._curves_of(leading, index).add_to_frames(rows, place, step, height, threads, tolerance)

    def _broadcast_with(self, **other: Floats) -> tuple[tuple[int, ...], NDArray[np.intp]]:
        """Return the common shape of the impacts and other arrays, and the index of the impact at each position."""
        leading = validation.broadcast(impacts=self.reduced_mass, **other)[0].shape
        numbers = np.arange(self.reduced_mass.size).reshape(self.reduced_mass.shape)
        return leading, np.broadcast_to(numbers, leading).ravel()

    def _curves_of(self, leading: tuple[int, ...], index: NDArray[np.intp]) -> Curves:
        return self.curves if leading == self.reduced_mass.shape else self.curves.taken(index)


class Unchecked:
    """Mixin of `Impact`: a row of impacts with numbers from the engine, which are valid."""

    def __post_init__(self) -> None:
        """Check nothing."""

    def _broadcast(self, named: dict[str, Floats]) -> tuple[Floats, ...]:
        return tuple(np.broadcast_arrays(*named.values()))

    def add_to_frames(
        self: Any,
        frames: NDArray[Any],
        sampling_rate: ArrayLike,
        onset: ArrayLike,
        *,
        threads: int = 1,
        tolerance: float = 0.0,
    ) -> None:
        """Add the forces to frames (n, n_samples) in place, for onsets [s] (n,) and one rate [Hz] or (n,)."""
        rate, step = np.asarray(sampling_rate), 1 / (np.asarray(sampling_rate) * self.time_scale)
        self.curves.add_to_frames(frames, np.asarray(onset) * rate, step, self.force_scale, threads, tolerance)


class Contacts(Unchecked, Impact):
    """Impacts of the engine: `Impact` without its checks."""


def _fixed(values: Floats) -> Floats:
    """Return a cached result as a read-only array."""
    fixed = np.asarray(values)
    fixed.setflags(write=False)
    return fixed


def _require_frames(frames: NDArray[Any], leading: tuple[int, ...]) -> None:
    validation.instance("frames", frames, np.ndarray)
    usable = frames.dtype in (np.float32, np.float64) and frames.flags.c_contiguous and frames.flags.writeable
    if frames.shape[:-1] != leading or not frames.ndim or not usable:
        shape = ", ".join(map(str, (*leading, "n_samples")))
        raise InvalidValue(
            f"frames must be writeable C-contiguous float32 or float64 samples of shape ({shape}), "
            f"got {frames.dtype} of shape {frames.shape}"
        )


def _output(dtype: DTypeLike, amplitude: Floats) -> np.dtype[Any]:
    """Return the requested sample type, or raise if it cannot represent samples of this amplitude."""
    try:
        requested = np.dtype(dtype)
    except TypeError:
        requested = np.dtype(object)
    if requested not in (np.float32, np.float64):
        raise InvalidValue(f"dtype must be float32 or float64, got {dtype!r}")
    # With these laws no dimensionless peak exceeds 1000.
    if requested == np.float32 and (amplitude > 1e-3 * np.finfo(np.float32).max).any():
        raise InvalidValue(f"float32 must represent the samples, got some near {amplitude.max():.3g}; use float64")
    return requested
