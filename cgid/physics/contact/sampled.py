"""Contact forces given at discrete times: computed by another program, or measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import Floats
from cgid.errors import InvalidValue

__all__ = ["SampledPulses"]

#: Minimum number of points of a pulse, as a cubic spline needs.
MIN_POINTS = 4
#: Points per interval around the largest sample in the peak search.
_FINER = 32


def shares_of_contact(n_points: int) -> Floats:
    """Return fractions of a contact from 0 to 1, dense at both ends: `(1 - cos) / 2`."""
    if validation.count("n_points", n_points) < MIN_POINTS:
        raise InvalidValue(f"n_points must be {MIN_POINTS} or more, got {n_points}")
    return np.asarray((1 - np.cos(np.linspace(0, np.pi, n_points))) / 2)


def angle_of(fraction: Floats) -> Floats:
    """Return `arccos(1 - 2 share)`, by Newton's method for half of it, whose sine is the root of the share."""
    late = fraction > 0.5
    sine = np.sqrt(np.where(late, 1 - fraction, fraction))
    square = sine * sine
    half = sine * (1 + square * (1 / 6 + square * (3 / 40 + square * 15 / 336)))
    for _ in range(3):
        sine_now, slope = np.sin(half), np.cos(half)
        half = half - (sine_now - sine) / slope
    return np.where(late, np.pi - 2 * half, 2 * half)


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPulses:
    """Pulses given by their forces at the same fractions of each contact.

    They are interpolated by a cubic spline in the angle `arccos(1 - 2 share)`. In this angle a force is smooth, whether
    it starts as the square root of time (a viscoelastic sphere) or as its power 3/2. Negative values of the spline
    become 0.

    Parameters
    ----------
    shares : ndarray, (n_points,)
        Fractions of the contact, rising from 0 to 1, such as `shares_of_contact`.
    forces : ndarray, (n, n_points) [N]
        Contact forces at these fractions, not negative.
    contact_duration : ndarray, (n,) [s]

    Examples
    --------
    >>> shares = shares_of_contact(33)
    >>> pulses = SampledPulses(shares=shares, forces=800 * np.sin(np.pi * shares)[None] ** 1.5, contact_duration=[5e-4])
    >>> pulses.force([[1.25e-4]]).round(1).tolist()
    [[475.7]]
    """

    shares: Floats
    forces: Floats
    contact_duration: Floats

    def __post_init__(self) -> None:
        shares, forces = validation.real("shares", self.shares), validation.not_negative("forces", self.forces, "N")
        duration = validation.positive("contact_duration", self.contact_duration, "s")
        rising = shares.ndim == 1 and shares.size >= MIN_POINTS and bool((np.diff(shares) > 0).all())
        if not rising or shares[0] != 0 or shares[-1] != 1:
            raise InvalidValue(
                f"shares must be {MIN_POINTS} or more numbers that rise from 0 to 1, got {shares.size} numbers from "
                f"{shares.min(initial=np.inf):g} to {shares.max(initial=-np.inf):g}"
            )
        if forces.shape != (*duration.shape, shares.size) or duration.ndim != 1:
            raise InvalidValue(
                f"forces must have a row for each contact_duration and a column for each of {shares.size} shares, got "
                f"shape {forces.shape} for durations of shape {duration.shape}"
            )
        silent = np.flatnonzero(forces.max(axis=1, initial=0.0) == 0)
        if silent.size:
            raise InvalidValue(f"forces must be above 0 somewhere in each pulse, got none in row {silent[0]}")
        for name, values in (("shares", shares), ("forces", forces), ("contact_duration", duration)):
            object.__setattr__(self, name, values)
        validation.hold(self, "shares", "forces", "contact_duration")

    def __len__(self) -> int:
        return len(self.contact_duration)

    @property
    def end_of_contact(self) -> Floats:
        """Time from onset to separation [s], (n,)."""
        return self.contact_duration

    @cached_property
    def peak_force(self) -> Floats:
        """Largest force of the interpolated curve [N], (n,)."""
        knots, largest = self._angles, np.argmax(self.forces, axis=1)
        low, high = knots[np.maximum(largest - 1, 0)], knots[np.minimum(largest + 1, knots.size - 1)]
        around = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, 2 * _FINER + 1)
        peaks = [self._curve(row, angles).max() for row, angles in enumerate(around)]
        return np.asarray(np.maximum(np.array(peaks, np.float64), self.forces.max(axis=1)))

    @property
    def impulse(self) -> Floats:
        """Integral of the force over the contact [N s], (n,)."""
        nodes, weights = np.polynomial.legendre.leggauss(4)
        knots = self._angles
        middle, half = (knots[1:] + knots[:-1]) / 2, np.diff(knots) / 2
        angles = (middle[:, None] + half[:, None] * nodes).ravel()
        # With the share (1 - cos) / 2 of the contact, dt is half the sine of the angle.
        weight = (half[:, None] * weights).ravel() * np.sin(angles) / 2
        each = [float(self._curve(row, angles) @ weight) for row in range(len(self))]
        return np.array(each, np.float64) * self.contact_duration

    def taken(self, rows: NDArray[np.intp] | slice) -> SampledPulses:
        """Return the given rows."""
        return replace(self, forces=self.forces[rows], contact_duration=self.contact_duration[rows])

    def stretched(self, force: ArrayLike, time: ArrayLike) -> SampledPulses:
        """Return the pulses with forces and times multiplied by factors, scalar or (n,)."""
        factor = np.broadcast_to(validation.positive("force", force), (len(self),))
        stretch = np.broadcast_to(validation.positive("time", time), (len(self),))
        return replace(
            self,
            forces=self.forces * factor[:, None],
            contact_duration=self.contact_duration * stretch,
        )

    def force(self, times: ArrayLike) -> Floats:
        """Return the forces [N] at times since onset [s], (n, n_times); 0 outside contact.

        Times are a scalar or (n_times,) for all pulses, or (n, n_times).
        """
        since = np.atleast_1d(validation.real("times", times, "s"))
        since = np.broadcast_to(since, (len(self), since.shape[-1]))
        share = since / self.contact_duration[:, None]
        inside = (share > 0) & (share < 1)
        angles = angle_of(np.clip(share, 0, 1))
        forces = np.zeros(angles.shape)
        for row, angle in enumerate(angles):
            forces[row] = self._curve(row, angle)
        return np.asarray(np.where(inside, forces, 0.0))

    def add_to_frames(
        self, frames: NDArray[Any], sampling_rate: ArrayLike, onset: ArrayLike, *, tolerance: float = 0.0
    ) -> None:
        """Add the pulses to frames (n, n_samples) in place, each from its onset [s].

        Each frame may have its own sampling rate. The tolerance is unused.
        """
        rate = np.broadcast_to(validation.positive("sampling_rate", sampling_rate, "Hz"), (len(self),))
        start = np.broadcast_to(validation.real("onset", onset, "s"), (len(self),)) * rate
        length = self.contact_duration * rate
        first = np.clip(np.floor(start) + 1, 0, frames.shape[1]).astype(np.intp)
        behind = np.clip(np.ceil(start + length), first, frames.shape[1]).astype(np.intp)
        for row, frame in enumerate(frames):
            share = (np.arange(first[row], behind[row]) - start[row]) / length[row]
            frame[first[row] : behind[row]] += self._curve(row, angle_of(np.clip(share, 0, 1)))

    @cached_property
    def _angles(self) -> Floats:
        return angle_of(self.shares)

    @cached_property
    def _coefficients(self) -> Floats:
        """Coefficients of the cubic of each interval, highest power first, (n, 4, n_points - 1)."""
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(self._angles, self.forces, axis=1)
        return np.ascontiguousarray(np.moveaxis(spline.c, 2, 0))

    def _curve(self, row: int, angles: Floats) -> Floats:
        """Return the force of one pulse at angles between 0 and pi."""
        knots = self._angles
        interval = np.clip(np.searchsorted(knots, angles, side="right") - 1, 0, knots.size - 2)
        x = angles - knots[interval]
        cubic, square, slope, start = self._coefficients[row][:, interval]
        return np.asarray(np.maximum(((cubic * x + square) * x + slope) * x + start, 0.0))
