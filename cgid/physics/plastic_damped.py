"""Curves of impacts that lose energy in two ways: a plastic contact with Hunt and Crossley's damping on every branch.

The force is `g(x) (1 + D x')`. g is that of `cgid.physics.plastic`: one path while the contact loads, a steeper one
while it unloads. D is the damping number that alone would leave the viscous restitution. In the momentum

    m = ln(1 + D x') / D,  m' = -g,  V(m) = (exp(D m) - 1 - D m) / D^2,

the sum of V and the work of g is constant along each path. (Without damping m is the speed and V its energy.) So the
energy that reaches the turn is `E = V(m(0)) = G(1)`, as in `cgid.physics.closed_forms`. The plastic contact gives W of
it back, as it would to a sphere of this energy without damping, and `V(m) = W` with m below 0 is the rebound. Peaks and
restitution are closed forms or roots of such equations. Damping takes `1/2 - E + W - e^2 / 2`, crushing `E - W`.

Time is the integral of `dm / g`, by Gauss's quadrature in a variable in which it is smooth. A Hertzian branch is a part
of a tabulated pulse (`cgid.family`): loading is that of the viscous restitution, unloading that of a faster sphere that
would turn there. A linear branch is expanded in Taylor series about times that the quadrature has found: with phi the
force of the spring over its largest, and psi = -phi', going back from the turn in units of the spring's rate,

    psi' = phi (1 + B psi),  B = D (2 E)^(1/2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cgid import family
from cgid.counting import count, counting
from cgid.physics.closed_forms import energy_below, peak_displacement, peak_force, peak_logarithm
from cgid.physics.curves import Curves, Quantity, in_threads, kernel, samples_in_contact
from cgid.validation import Floats

_NEWTON_STEPS = 7  # the start values are within 40 %, and each step squares the error
_PANELS, _ORDER = 8, 14  # of a linear branch: errors below 1e-11 of the peak from a viscous restitution of .1 on
_ELASTIC_PANELS = 6
_REST = tuple(1 / math.factorial(n) for n in range(18, 1, -1))  # series of `_rest`, highest power first
_MOST_AT_ONCE = 1 << 18  # samples
# Gauss's five points on (0, 1) and their weights.
_INNER, _OUTER = (np.sqrt(5 - sign * 2 * np.sqrt(10 / 7)) / 6 for sign in (1, -1))
_GAUSS = np.array([0.5 - _OUTER, 0.5 - _INNER, 0.5, 0.5 + _INNER, 0.5 + _OUTER])
_LESS, _MORE = ((322 - sign * 13 * np.sqrt(70)) / 1800 for sign in (1, -1))
_WEIGHTS = (_LESS, _MORE, 64 / 225, _MORE, _LESS)


@dataclass(frozen=True)
class DampedPlasticCurves(Curves):
    """The curves of n plastic impacts with damping; all fields are (n,), and `material_restitution` is the viscous one.

    corner : displacement at which the Hertzian contact yields, 0 for a linear spring
    stiffness : slope of the linear branch
    plastic : restitution of a linear spring without damping; 1 for a Hertzian contact, whose own follows
    linear : whether the contact unloads as a linear spring; else as a Hertzian contact
    """

    SHARED: ClassVar[tuple[str, ...]] = ("linear",)

    corner: Floats
    stiffness: Floats
    plastic: Floats
    linear: bool

    @cached_property
    def _turn(self) -> _Turn:
        return _Turn(self)

    @property
    def restitution(self) -> Floats:
        """Rebound speed over impact speed."""
        return self._turn.restitution

    @cached_property
    def peak_force(self) -> Floats:
        """Largest force; it precedes the largest displacement."""
        turn = self._turn
        return np.where(turn.peaks_early, peak_force(self.damping), turn.largest_force)

    @property
    def peak_displacement(self) -> Floats:
        """Largest displacement."""
        return self._turn.displacement

    @property
    def end_displacement(self) -> Floats:
        """Displacement at separation."""
        return self._turn.left

    @cached_property
    def _loading(self) -> _Quarter:
        return _Quarter(self._turn.coefficient, self._turn.spent, self._turn.share)

    @cached_property
    def _spring_unloading(self) -> _Quarter:
        """The unloading of a linear spring: loading backwards, with damping that drives."""
        whole = np.full(self.plastic.shape, 0.5)
        return _Quarter(-self.plastic * self._turn.coefficient, 0.0 * whole, whole)

    @cached_property
    def _slower(self) -> Curves:
        """The Hertzian impacts whose beginnings are the loading."""
        return Curves.damped(self.material_restitution)

    @cached_property
    def _faster(self) -> Curves:
        """The Hertzian impacts whose second halves are the unloading."""
        return Curves.damped(self._turn.second)

    @cached_property
    def _ends(self) -> tuple[Floats, Floats, Floats]:
        """Times at which the linear branch begins, of the turn, and of separation."""
        turn, loading = self._turn, self._loading
        first = np.zeros(self.plastic.shape) if self.linear else self._elastic_time()
        at_turn = first + loading.times[:, -1] / turn.rate
        if self.linear:
            return first, at_turn, at_turn + self.plastic * self._spring_unloading.times[:, -1] / turn.rate
        contact, _, compression = self._faster.times
        return first, at_turn, at_turn + turn.unit * (contact - compression)

    @cached_property
    def times(self) -> tuple[Floats, Floats, Floats]:
        """Contact time, time of the peak force, and time of the largest displacement."""
        turn, (_, at_turn, contact) = self._turn, self._ends
        early = self._slower.times[1]
        late = at_turn - self._loading.time_to(turn.peak_momentum) / turn.rate
        return contact, np.where(turn.peaks_early, early, late), at_turn

    def _elastic_time(self) -> Floats:
        """Return how long the Hertzian loading lasts.

        From touch on m falls by r^5, and time is smooth in r. Where the contact yields late, the time from there to the
        turn of a contact that does not yield is smooth in m.
        """
        turn, damping = self._turn, self.damping[:, None]
        early = (turn.fallen < 0.45 * turn.momentum)[:, None]
        top = (turn.fallen + turn.momentum)[:, None]
        scale = np.where(early, 5 * np.power(turn.fallen, 0.4)[:, None], turn.momentum[:, None])
        total = np.zeros(self.plastic.shape)
        for panel in range(_ELASTIC_PANELS):
            share = (panel + _GAUSS) / _ELASTIC_PANELS
            fifth = share * share * share * share * share
            fall = np.where(early, turn.fallen[:, None] * fifth, top - turn.momentum[:, None] * share)
            rates = 2.5 * _over_fall(fall, np.ones(fall.shape), damping) * np.where(early, 1.0, fall)
            rates = scale * np.where(early, share, 1.0) / np.power(rates, 0.6)
            for k, weight in enumerate(_WEIGHTS):
                total = total + weight / _ELASTIC_PANELS * rates[:, k]
        return np.where(early[:, 0], total, self._slower.times[2] - total)

    def evaluate(
        self, times: Floats, time_scale: Floats, amplitude: Floats, quantity: Quantity, dtype: DTypeLike, threads: int
    ) -> NDArray[Any]:
        """Return force or displacement at times (n, k) [s], shape (n, k); 0 outside contact."""
        count("branched_pulses", len(times))
        with np.errstate(over="ignore"):  # long past separation
            tau = times / time_scale[:, None]
        shape = self._at(np.arange(len(times)), tau, quantity, threads)
        return (amplitude[:, None] * shape).astype(dtype)

    def _at(self, rows: NDArray[np.intp], tau: Floats, quantity: Quantity, threads: int) -> Floats:
        """Return force or displacement of these rows at dimensionless times (n, k)."""
        turn, force = self._turn, quantity == "force"
        first, at_turn, contact = (times[rows, None] for times in self._ends)
        inside, late = (tau > 0) & (tau < contact), tau > at_turn
        late &= inside
        between = inside & ~late & (tau > first)
        out = np.zeros(tau.shape)
        row = rows[np.nonzero(between)[0]]
        out[between] = self._loading.at(row, (at_turn - tau)[between] * turn.rate[row], turn.force, turn.swing, force)
        if not force:
            out[between] += (turn.displacement - turn.swing)[row]
        if self.linear:
            row = rows[np.nonzero(late)[0]]
            back = (tau - at_turn)[late] * (turn.rate / self.plastic)[row]
            way = turn.displacement - turn.left
            out[late] = self._spring_unloading.at(row, back, turn.force, way, force)
        else:
            one, unit, length = np.ones(rows.size), turn.unit[rows], turn.length[rows]
            early = np.where(inside & (tau <= first), tau, -1.0)
            out += _tabulated(early, self.material_restitution[rows], one, one, quantity, threads)
            since = np.where(late, tau - at_turn + (turn.unit * self._faster.times[2])[rows, None], -1.0)
            scale = length / (unit * unit) if force else length
            out += _tabulated(since, turn.second[rows], unit, scale, quantity, threads)
        if not force:
            out += np.where(late, turn.left[rows, None], 0.0)
        return np.maximum(out, 0.0)

    def add_to_frames(
        self, frames: NDArray[Any], onset: Floats, step: Floats, amplitude: Floats, threads: int, tolerance: float = 0.0
    ) -> None:
        """Add a force pulse to each of the frames in place; see `Curves.add_to_frames`. Every pulse is exact."""
        count("branched_pulses", len(frames))
        behind = onset + self.times[0] / step
        if counting():
            count("pulse_samples", samples_in_contact(onset, behind, frames.shape[1]))
        first = np.clip(np.floor(onset) + 1, 0, frames.shape[1]).astype(np.intp)
        last = np.clip(np.ceil(behind), first, frames.shape[1]).astype(np.intp)
        for rows in _alike(last - first):
            width = int((last - first)[rows].max())
            tau = (first[rows, None] + np.arange(width) - onset[rows, None]) * step[rows, None]
            force = (amplitude[rows, None] * self._at(rows, tau, "force", threads)).astype(frames.dtype)
            for row, values in zip(rows.tolist(), force, strict=True):
                frames[row, first[row] : last[row]] += values[: last[row] - first[row]]


def _tabulated(
    times: Floats, restitution: Floats, unit: Floats, amplitude: Floats, quantity: Quantity, threads: int
) -> Floats:
    """Return tabulated pulses at times (n, k), 0 outside contact."""
    from cgid.physics import _kernels

    out, columns = np.empty(times.shape), getattr(family.table(), quantity)
    numbers = (times, family.coordinate(restitution), unit, amplitude, columns, quantity == "force", out)
    in_threads(kernel(_kernels, "at_times", *times.shape), numbers, np.arange(len(times)), threads)
    return out


def damped_thornton_curves(yield_displacement: Floats, viscous: Floats) -> DampedPlasticCurves:
    """Return the curves of spheres that yield at these displacements [L] and have these viscous restitutions, (n,)."""
    one = np.ones(viscous.shape)
    made = DampedPlasticCurves.damped(viscous, yield_displacement, one, one, False)
    corner = np.minimum(yield_displacement, peak_displacement(made.damping))
    return replace(made, corner=corner, stiffness=1.5 * np.sqrt(corner))


def damped_walton_braun_curves(restitution: Floats, stiffness: Floats, viscous: Floats) -> DampedPlasticCurves:
    """Return the curves of bilinear contacts of these restitutions, slopes [K L^(1/2)] and viscous ones, each (n,)."""
    return DampedPlasticCurves.damped(viscous, np.zeros(viscous.shape), stiffness, restitution, True)


class _Turn:
    """What follows in closed form, or as a root; each (n,).

    force, displacement : at the turn; swing : way from the spring's zero to the turn; rate : of the spring
    coefficient : B, with E the energy of the spring
    spent, share : work of the spring and V where its branch begins, over 2 E; fallen : what m has lost until then
    momentum : m there
    peaks_early : whether the peak force precedes this branch; else it is largest_force, where m is peak_momentum
    left : displacement at separation
    second, length, unit : restitution and scales of the Hertzian impact that unloads likewise
    """

    def __init__(self, of: DampedPlasticCurves) -> None:
        damping, viscous = of.damping, of.material_restitution
        energy = energy_below(damping)
        taken = 0.4 * np.power(of.corner, 2.5)
        yields = np.full(viscous.shape, True) if of.linear else of.corner < peak_displacement(damping)
        rest = np.where(yields, np.maximum(energy - taken, 0.0), 0.0)
        offset = 2 / 3 * of.corner
        swing = np.sqrt(offset * offset + 2 * rest / of.stiffness)
        self.swing, self.rate, self.force = swing, np.sqrt(of.stiffness), of.stiffness * swing
        across = self.rate * swing  # (2 E)^(1/2) of the spring
        self.coefficient, self.share = damping * across, rest / (across * across)
        self.spent = 0.5 * (offset / swing) * (offset / swing)
        self.fallen, self.momentum = _until(taken, rest, damping, _momentum(energy, damping))
        self.displacement = of.corner / 3 + swing
        way = of.plastic * of.plastic * swing if of.linear else self.force / np.sqrt(self.displacement)
        self.left = np.where(yields, self.displacement - way, 0.0)
        work = np.where(yields, (0.5 if of.linear else 0.4) * self.force * way, energy)
        self.restitution = np.where(yields, _speed(_momentum(work, -damping), -damping), viscous)
        speed = np.where(yields, _speed(_momentum(work, damping), damping), 1.0)
        second = np.where(yields, self.restitution / speed, viscous)
        self.second = np.clip(second, family.LOWEST_RESTITUTION, 1.0)
        hertzian = yields & (not of.linear)
        compliance = np.where(hertzian, way * np.sqrt(way), 0.0) / self.force
        self.length = np.where(hertzian, np.power(speed * speed * compliance, 0.4), 1.0)
        self.unit = self.length / speed
        early = np.divide(peak_logarithm(damping), damping, out=np.zeros(damping.shape), where=damping > 0)
        self.peaks_early = np.zeros(viscous.shape, bool) if of.linear else early >= self.momentum
        self.peak_momentum, height = _spring_peak(self.coefficient)
        self.largest_force = self.force * height


def _rest(x: Floats) -> Floats:
    """Return `(exp(x) - 1 - x) / x^2`."""
    near = np.abs(x) < 0.5
    small, series = np.where(near, x, 0.0), np.zeros(x.shape)
    for coefficient in _REST:
        series = series * small + coefficient
    if near.all():
        return series
    large = np.where(near, 1.0, x)
    return np.where(near, series, (np.expm1(large) - large) / (large * large))


def _speed(momentum: Floats, damping: Floats) -> Floats:
    """Return `(exp(D m) - 1) / D`."""
    x = damping * momentum
    far = np.abs(x) > 1e-30
    safe = np.where(far, x, 1.0)
    return momentum * np.where(far, np.expm1(safe) / safe, 1.0)


def _momentum(energy: Floats, damping: Floats) -> Floats:
    """Return m above 0 with V(m) = energy; with the sign of damping turned, -m below 0."""
    root = np.sqrt(2 * energy)
    x = damping * root
    x = np.where(np.abs(x) > 1e-60, x, 1e-60)
    level = 0.5 * x * x
    y = np.where(x > 0, np.log1p(np.abs(x) + level), x - level / 3)
    for _ in range(_NEWTON_STEPS):
        y = y - (y * y * _rest(y) - level) / np.expm1(y)
    return root * (y / x)


def _over_fall(fall: Floats, speed: Floats, damping: Floats) -> Floats:
    """Return the work of g over the fall of m from where the speed is this one."""
    return speed - (1 + damping * speed) * fall * _rest(-damping * fall)


def _until(work: Floats, rest: Floats, damping: Floats, top: Floats) -> tuple[Floats, Floats]:
    """Return how far m falls from the top while g does this work, and m then, where V is the rest."""
    momentum, speed = _momentum(rest, damping), _speed(top, damping)
    early = work < rest  # where the difference of the two momenta would lose its digits
    fall = np.where(early, work / speed, 0.0)
    for _ in range(_NEWTON_STEPS):
        now = speed - (1 + damping * speed) * _speed(fall, -damping)
        fall = np.where(early, fall - (fall * _over_fall(fall, speed, damping) - work) / now, 0.0)
    return np.where(early, fall, top - momentum), np.where(early, top - fall, momentum)


def _spring_peak(coefficient: Floats) -> tuple[Floats, Floats]:
    """Return m over (2 E)^(1/2) at the peak force of a damped linear spring, and this force over that of the turn.

    There psi = B phi^2. With `p = ln(1 + B psi)` that is `3 (exp(p) - 1) - 2 p = B^2`.
    """
    b = np.maximum(coefficient, 1e-20)
    p = np.log1p(b * b)
    for _ in range(_NEWTON_STEPS):
        p = p - (3 * np.expm1(p) - 2 * p - b * b) / (3 * np.exp(p) - 2)
    return p / b, np.sqrt(np.expm1(p)) / b * np.exp(p)


class _Quarter:
    """The motion of n damped springs from their turn back to a given momentum, in units of their rate and swing.

    There V and the work of the spring have the shares `share` and `spent` of 2 E, in all 1/2.

    coefficient : B, (n,)
    times : of the expansions, from the turn, (n, `_PANELS` + 1)
    series : of phi in the time from there, (`_ORDER` + 1, n, `_PANELS` + 1)
    edges : where the motion is expanded, as the root of the fall of m from where phi = 0, (n, `_PANELS` + 1)
    speed : psi where phi = 0, (n,)
    """

    def __init__(self, coefficient: Floats, spent: Floats, share: Floats) -> None:
        self.coefficient = coefficient
        top = _momentum(np.full(share.shape, 0.5), coefficient)
        self.speed = _speed(top, coefficient)
        fall, momentum = _until(spent, share, coefficient, top)
        highest, lowest = np.sqrt(top), np.sqrt(fall)
        # Where damping drives, the motion is quick at first.
        even = np.arange(_PANELS + 1) / _PANELS
        drive = np.maximum(-coefficient, 0.0)[:, None]
        graded = even * (1 + drive * even) / (1 + drive)
        self.edges = highest[:, None] - (momentum / (highest + lowest))[:, None] * graded
        self.times = np.zeros(self.edges.shape)
        np.cumsum(self._between(self.edges[:, :-1], self.edges[:, 1:]), axis=1, out=self.times[:, 1:])
        self.series = self._expanded(top)

    def _between(self, early: Floats, late: Floats) -> Floats:
        """Return the time between two edges (n, k), by quadrature."""
        coefficient, speed = self.coefficient[:, None], self.speed[:, None]
        total = np.zeros(early.shape)
        for place, weight in zip(_GAUSS, _WEIGHTS, strict=True):
            root = early + (late - early) * place
            total = total + weight * 2 / np.sqrt(2 * _over_fall(root * root, speed, coefficient))
        return np.asarray(total * (early - late))

    def _expanded(self, top: Floats) -> Floats:
        coefficient = self.coefficient[:, None]
        fall = self.edges * self.edges
        phi = [self.edges * np.sqrt(2 * _over_fall(fall, self.speed[:, None], coefficient))]
        psi = [_speed(np.maximum(top[:, None] - fall, 0.0), coefficient)]
        for n in range(_ORDER):
            product = phi[0] * psi[n]
            for i in range(1, n + 1):
                product = product + phi[i] * psi[n - i]
            psi.append((phi[n] + coefficient * product) / (n + 1))
            phi.append(-psi[n] / (n + 1))
        return np.stack(phi)

    def time_to(self, momentum: Floats) -> Floats:
        """Return the time from the turn at which m is this, within the motion."""
        root = np.sqrt(np.maximum(self.edges[:, 0] * self.edges[:, 0] - momentum, 0.0))
        panel = np.sum(self.edges[:, 1:-1] > root[:, None], axis=1)
        row = np.arange(root.size)
        rest = self._between(self.edges[row, panel][:, None], root[:, None])[:, 0]
        return np.asarray(self.times[row, panel] + rest)

    def at(self, row: NDArray[np.intp], back: Floats, high: Floats, deep: Floats, force: bool) -> Floats:
        """Return force or displacement of the spring at times before the turn, where they are `high` and `deep`.

        row says whose the times are.
        """
        middles = 0.5 * (self.times[:, 1:] + self.times[:, :-1]).T
        nearest = np.zeros(row.shape, np.intp)
        for middle in np.ascontiguousarray(middles):
            nearest += back > middle.take(row)
        place = row * (_PANELS + 1) + nearest
        since = back - self.times.ravel()[place]
        phi, rate = self.series[_ORDER].take(place), np.zeros(row.shape)
        for order in range(_ORDER - 1, -1, -1):
            if force:
                rate = rate * since + phi
            phi = phi * since + self.series[order].take(place)
        shape = high[row] * phi * (1 - self.coefficient[row] * rate) if force else deep[row] * phi
        return np.asarray(shape)


def _alike(widths: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the rows whose pulses have samples, in groups within a factor of two in their number."""
    groups, exponents = [], np.frexp(widths)[1]
    for exponent in np.unique(exponents[widths > 0]).tolist():
        rows = np.flatnonzero(exponents == exponent)
        groups += np.array_split(rows, min(-(-rows.size * 2**exponent // _MOST_AT_ONCE), rows.size))
    return groups
