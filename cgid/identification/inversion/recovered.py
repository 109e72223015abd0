"""The force of impacts from the motion of a beam, at one place that a table of modes describes, or anywhere on it.

Anywhere it is the inversion of `predict`, which knows the forces of a population and looks for the place. Where the
place is known, nothing else is: the force is a polygon with corners half a period of the band's end apart, zero outside
of the contact, and least squares in the band of the modes find it. Its errors are those of the modes, which are large
where these resonate, so the deviations come from the residual itself: parts of the band count as independent (Huber
1967).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import Complex, Floats
from cgid.errors import BadData, InvalidValue
from cgid.identification.inversion.through_beam import ThroughBeam
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.fit import family
from cgid.measure.modal.beam import FINE, SPAN_TIME, Beam
from cgid.measure.modal.finite import Stretch, bins_in
from cgid.measure.modal.modes import LINE_DAMPING, Modes, are_lines

#: Motions, by how often the displacement is differentiated.
_MOTIONS = ("displacement", "velocity", "acceleration")
#: The band reaches beyond the modes by this factor.
_BEYOND = 1.1
#: The force may begin this long before a detected onset, and is looked for this long after it [s]: a short time first,
#: each next twice as long, which counts where it leaves less than this part.
_BEFORE, CONTACT = 1e-3, 6e-3
_SHORT, _LONGER_IS_BETTER = 1.5e-3, 0.9
#: Longest vibration that is used [s]; where the place is unknown, of noise before an impact.
_LONGEST, _QUIET_TIME = 1.0, 5e-3
#: Step of numerical slopes of a pulse.
_STEP = 1e-4
#: The contact is where the force is above this fraction of its peak, with a margin of this fraction of its length on
#: either side.
_FOOT, _MARGIN = 0.05, 0.6
#: Parts of the band whose residuals count as independent.
_PARTS = 40
#: A measured force is moved by at most this time [s].
_SHIFT = 2e-3
#: Corners of the force in a period of the band's end; then in that or the contact, whichever is shorter.
_COARSE, _FINE = 3.0, 6.0
#: Bins whose errors are alike, since they belong to one mode.
_ALIKE = 100.0
#: Fraction of the amplitude below which an unexplained rest is no smaller: the corners do not follow the force exactly.
_QUIET = 6e-3
#: Durations that a band shows are no shorter than this part of the period of its end.
_NARROWEST = 0.6
#: Rounds after the first, about the contact that the last has found.
_ROUNDS = 5
#: Standard deviation of a mode's error in one impact, over that of the table, which is a mean of several taps; where
#: the table states none; the least.
_SINGLE, _UNSTATED, _LEAST = 2.0, 0.05, 0.01
#: Errors of modes are at most so many times what they leave unexplained, since a force may take up the rest.
_HIDDEN = 3.0
#: Relative size of what is added to the diagonal of a Gram matrix.
_RIDGE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class RecoveredForce:
    """The force of an impact.

    Attributes
    ----------
    time : ndarray, (n,) [s]
        In the recording, sample by sample.
    force : ndarray, (n,) [N]
    covariance : ndarray, (n, n) [N^2]
    unexplained : float
        Fraction of the amplitude of the vibration, in the band, that the force does not explain.
    place, place_deviation : tuple of float, optional [m]
        x and y of the impact where the place was looked for, and their standard deviations.
    shortest : float [s]
        A duration below this is what the band shows of any shorter contact: then the peak may be higher.
    """

    time: Floats
    force: Floats
    covariance: Floats = field(repr=False)
    unexplained: float
    place: tuple[float, float] | None = None
    place_deviation: tuple[float, float] | None = None
    shortest: float = 0.0

    @property
    def deviation(self) -> Floats:
        """Standard deviations of the force, (n,) [N]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def peak(self) -> tuple[float, float]:
        """Largest force and its standard deviation [N]."""
        at = int(np.argmax(self.force))
        return float(self.force[at]), float(self.deviation[at])

    @property
    def impulse(self) -> tuple[float, float]:
        """Integral of the force and its standard deviation [N s]."""
        step = float(np.diff(self.time).mean())
        return float(self.force.sum() * step), float(np.sqrt(max(self.covariance.sum(), 0.0)) * step)

    @cached_property
    def duration(self) -> float:
        """Time between the first and the last tenth of the peak about it [s]."""
        return time_above(self.time, self.force, 0.1)


def time_above(time: Floats, force: Floats, share: float) -> float:
    """Return how long a force stays above a share of its peak, about it [s]."""
    at, level = int(np.argmax(force)), share * float(force.max())
    ends = []
    for part in (np.arange(at, -1, -1), np.arange(at, force.size)):
        below = np.flatnonzero(force[part] < level)
        if not below.size:
            ends.append(time[part[-1]])
            continue
        inner, outer = part[below[0] - 1], part[below[0]]
        ends.append(np.interp(level, [force[outer], force[inner]], [time[outer], time[inner]]))
    return float(ends[1] - ends[0])


def errors_of(found: RecoveredForce, measured: Floats, sampling_rate: float) -> dict[str, float]:
    """Return relative errors beside a measured force [N] of the whole recording (n_samples,), and its delay [s].

    The clock of the hammer may differ from that of the sensor: the measured force is moved to where it fits best.
    """
    # The force is zero outside of the contact, so that what is measured there is an error, too.
    first, last = (round(time * sampling_rate) for time in (found.time[0], found.time[-1]))
    reach = last - first + 1 + round(_SHIFT * sampling_rate)
    part = np.arange(max(first - reach, 0), min(last + 1 + reach, measured.size))
    true, own = measured[part], np.interp(part / sampling_rate, found.time, found.force, 0.0, 0.0)
    padded = 2 * part.size
    spectra = np.fft.rfft(own, padded), np.fft.rfft(true, padded)
    fine = 16 * padded
    match = np.fft.irfft(spectra[1] * spectra[0].conj(), fine)
    shift = np.fft.fftfreq(fine, 1 / padded)
    near = np.abs(shift) <= _SHIFT * sampling_rate
    late = float(shift[near][np.argmax(match[near])])
    turn = np.exp(2j * np.pi * np.fft.rfftfreq(padded) * late)
    true = np.fft.irfft(spectra[1] * turn, padded)[: part.size]
    return {
        "force": float(np.linalg.norm(own - true) / np.linalg.norm(true)),
        "peak": float(own.max() / true.max() - 1),
        "duration": found.duration / time_above(part / sampling_rate, true, 0.1) - 1,
        "impulse": float(own.sum() / true.sum() - 1),
        "delay": late / sampling_rate,
    }


def recover_force(
    response: Floats,
    sampling_rate: float,
    modes: Modes | Sequence[Modes] | Beam,
    onsets: Sequence[float],
    *,
    quantity: str = "acceleration",
    band: tuple[float, float] | None = None,
    contact: float = CONTACT,
) -> list[RecoveredForce]:
    """Return the force of each impact, at the place of a table of modes or anywhere on a beam.

    Parameters
    ----------
    response : ndarray, (n_sensors, n_samples)
        Motion of the beam in SI units.
    sampling_rate : float [Hz]
    modes : Modes, sequence of Modes, or Beam
        Modes of each sensor, such as a table of `cgid tap` with a hammer channel; or a beam with its sensors, of
        `cgid.scene.synthesis.through_beam.beam_of` or a model: then each place is looked for, in the beam's band.
    onsets : sequence of float [s]
        When the impacts begin, to a millisecond.
    quantity : {"acceleration", "velocity", "displacement"}
        Of the response.
    band : tuple of float, optional [Hz]
        By default that of the taps, else the range of the natural frequencies.
    contact : float [s]
        Longest contact.

    Returns
    -------
    list of RecoveredForce

    Raises
    ------
    InvalidValue
        A number breaks its rule.
    BadData
        The modes are not in the band of the recording, or an impact leaves too little of it.
    """
    options: dict[str, Any] = {"quantity": quantity, "band": band, "contact": contact}
    return [one for one in recover_each(response, sampling_rate, modes, onsets, **options) if one is not None]


def _stop(error: BadData) -> None:
    raise error


def recover_each(
    response: Floats,
    sampling_rate: float,
    modes: Modes | Sequence[Modes] | Beam,
    onsets: Sequence[float],
    *,
    quantity: str = "acceleration",
    band: tuple[float, float] | None = None,
    contact: float = CONTACT,
    begin: float = 0.0,
    told: Callable[[BadData], None] = _stop,
) -> list[RecoveredForce | None]:
    """Return what `recover_force` returns, and None for an impact whose error is told instead of raised.

    Errors name times from `begin` [s] on, when the response begins.
    """
    derivatives = _MOTIONS.index(validation.choice("quantity", quantity, _MOTIONS))
    contact = validation.number("contact", contact, "s", validation.positive)
    response = np.atleast_2d(np.asarray(response, np.float64))
    onset = np.sort(np.asarray(onsets, np.float64))
    if isinstance(modes, Beam):
        return _anywhere(response, sampling_rate, modes, onset, derivatives, begin, told)
    every = [modes] if isinstance(modes, Modes) else list(modes)
    if len(every) != len(response):
        raise InvalidValue(
            f"modes must be one table for each channel, got {len(every)} for {len(response)}; choose "
            f"channels ({spelled('channel')}), or name a table for each"
        )
    band = _band_of(every, band, sampling_rate)
    before = round(_BEFORE * sampling_rate)
    starts = (np.round(onset * sampling_rate).astype(int) - before).tolist()
    out: list[RecoveredForce | None] = []
    for at, first, end in zip(onset.tolist(), starts, [*starts[1:], response.shape[1] - before], strict=True):
        first, last = max(first, 0), min(end, first + round(_LONGEST * sampling_rate))
        n_bins = bins_in(max(last - first, 1), sampling_rate, band).size
        if n_bins < 4 * _PARTS:
            error = BadData(
                f"impact at {begin + at:.4g} s: must be followed by "
                f"{4 * _PARTS / (band[1] - band[0]):.2g} s of vibration, got "
                f"{max(last - first, 0) / sampling_rate:.2g} s; leave more time between impacts"
            )
            told(error)
            out.append(None)
            continue
        found = [one for one in out if one is not None]
        vibrations = [
            _Vibration(row[first:last], own, sampling_rate, derivatives, band, first, found)
            for row, own in zip(response, every, strict=True)
        ]
        tried, best = min(_SHORT, contact), None
        while True:
            one = _recovered(vibrations, first, round((tried + _BEFORE) * sampling_rate))
            if best is None or one.unexplained < _LONGER_IS_BETTER * best.unexplained:
                best = one
            if tried >= contact:
                break
            tried = min(2 * tried, contact)
        out.append(best)
    return out


def _anywhere(
    response: Floats,
    sampling_rate: float,
    beam: Beam,
    onset: Floats,
    derivatives: int,
    begin: float,
    told: Callable[[BadData], None],
) -> list[RecoveredForce | None]:
    """Return the force of each impact on a beam, with its place."""
    if len(response) != beam.n_sensors or derivatives != beam.derivatives:
        raise InvalidValue(
            f"response must be {beam.n_sensors} channels of {_MOTIONS[beam.derivatives]} for this beam, got "
            f"{len(response)} of {_MOTIONS[derivatives]}; choose channels ({spelled('channel')})"
        )
    before, n = (round(time * sampling_rate) for time in (_QUIET_TIME, _QUIET_TIME + 1.6 * SPAN_TIME))
    first = np.round(onset * sampling_rate).astype(int) - before
    inside = (first >= 0) & (first + n <= response.shape[1])
    for at in onset[~inside].tolist():
        error = BadData(
            f"impact at {begin + at:.4g} s: must have {1e3 * _QUIET_TIME:g} ms before and "
            f"{1e3 * (n - before) / sampling_rate:g} ms after it; record longer"
        )
        told(error)
    out: list[RecoveredForce | None] = [None] * len(first)
    if not inside.any():
        return out
    first = first[inside]
    frames = np.stack([row[start : start + n] for start in first.tolist() for row in response])
    through = ThroughBeam(beam).of(sampling_rate)
    found, contact = through.look(VibrationBatch(frames, sampling_rate, before))
    for row, (at, start) in enumerate(zip(np.flatnonzero(inside).tolist(), first.tolist(), strict=True)):
        touch = start / sampling_rate + (found.start[row] + contact.touch[row]) / through.beam.sampling_rate
        logs = np.array([np.log(contact.peak[row]), np.log(contact.width[row]), contact.shape[row]])
        time, force = _pulse(logs, None, sampling_rate)
        slopes = np.stack([_pulse(logs + step, time, sampling_rate)[1] - force for step in _STEP * np.eye(3)]) / _STEP
        out[at] = RecoveredForce(
            time=touch + time,
            force=force,
            covariance=slopes.T @ contact.covariance[row] @ slopes,
            unexplained=float(np.sqrt(found.unexplained[row])),
            place=(float(found.x[row]), float(found.y[row])),
            place_deviation=(float(found.place_deviation[row, 0]), float(found.place_deviation[row, 1])),
        )
    return out


def _pulse(logs: Floats, time: Floats | None, sampling_rate: float) -> tuple[Floats, Floats]:
    """Return times from the touch on [s] and the pulse of ln peak, ln width and shape there, as `Contact` has them."""
    peak, width, shape = np.exp(logs[0]), np.exp(logs[1]), logs[2]
    restitution = np.array([min(np.exp(-abs(shape)), family.MAX_RESTITUTION)])
    lasts, top, _ = (part[0] for part in family.times(restitution))
    height = family.force(np.array([[top]]), restitution)[0, 0]
    scale = width * height / (1 + restitution[0])  # of the dimensionless time, whose impulse is 1 + e
    if time is None:
        step = 1 / (FINE * sampling_rate)
        time = np.asarray(step * np.arange(int(lasts * scale / step) + 2))
    own = np.asarray(time / scale)
    inside = (own > 0) & (own < lasts)
    own = np.where(shape > 0, lasts - own, own)
    force = family.force(np.clip(own, 0, lasts)[None], restitution)[0]
    return np.asarray(time), np.where(inside, peak / height * force, 0.0)


def _band_of(modes: Sequence[Modes], band: tuple[float, float] | None, sampling_rate: float) -> tuple[float, float]:
    """Return the band [Hz], that of the tables or of the modes if not given, within that of the recording."""
    frequency = np.concatenate([own.frequency[~are_lines(own.damping_ratio)] for own in modes])
    if not frequency.size:
        raise BadData(
            f"modes must contain one with a damping ratio below {LINE_DAMPING / 2:g}; name a table of cgid tap"
        )
    if band is None:
        ends = [own.band or (frequency.min() / _BEYOND, frequency.max() * _BEYOND) for own in modes]
        band = max(low for low, _ in ends), min(min(high for _, high in ends), 0.45 * sampling_rate)
    low, high = band
    if not 0 < low < high:
        raise InvalidValue(f"band must be two ascending frequencies above 0, got {low:.4g} and {high:.4g} Hz")
    if high > 0.49 * sampling_rate:
        raise BadData(
            f"band must end below 0.49 of the sampling rate ({0.49 * sampling_rate:.5g} Hz), got {high:.5g} Hz; limit "
            f"it by {spelled('band')}, or record faster"
        )
    if not ((frequency >= low) & (frequency <= high)).any():
        raise BadData(
            f"band must contain a mode, they are from {frequency.min():.4g} to {frequency.max():.5g} Hz, got "
            f"{low:.4g} to {high:.5g} Hz; change {spelled('band')}"
        )
    return float(low), float(high)


class _Vibration:
    """The transform of what one sensor records of an impact, and of its response to forces."""

    def __init__(
        self,
        samples: Floats,
        modes: Modes,
        sampling_rate: float,
        derivatives: int,
        band: tuple[float, float],
        first: int,
        earlier: Sequence[RecoveredForce],
    ) -> None:
        inside = bins_in(samples.size, sampling_rate, band)
        self.high, self.participation = band[1], modes.participation()
        deviation = np.full(modes.frequency.size, _UNSTATED) if modes.deviation is None else modes.deviation[2]
        self.error = np.clip(_SINGLE * deviation, _LEAST, 1.0)
        self.stretch = Stretch(
            pole=modes.poles,
            bins=inside,
            n_samples=samples.size,
            sampling_rate=sampling_rate,
            derivatives=derivatives,
        )
        self.bins = np.fft.rfft(samples)[inside] / sampling_rate
        before = np.zeros(modes.frequency.size, complex)
        for one in earlier:
            before += self.stretch.states(one.force, first - round(one.time[0] * sampling_rate))
        if before.any():
            self.bins = self.bins - self.stretch.free(self.participation, before)

    def by_mode(self, force: Floats) -> Complex:
        """Return what each mode adds for a force at the first samples, (n_bins, n_modes)."""
        one, turned = self.stretch.by_mode(force, np.zeros(self.participation.size, complex))
        return one * self.participation.real + turned * self.participation.imag


def _recovered(vibrations: Sequence[_Vibration], first: int, n_samples: int) -> RecoveredForce:
    """Return the force that starts within some samples of the first: sought at all of them, then about its peak."""
    start, n_samples = 0, min(n_samples, vibrations[0].stretch.n_samples)
    force, covariance, unexplained = _solved(vibrations, start, n_samples, None)
    for _ in range(_ROUNDS):
        begin, end = _contact_in(force)
        guess = np.concatenate([np.zeros(start + begin), np.maximum(force[begin:end], 0.0)])
        start, n_samples = start + begin, end - begin
        force, covariance, unexplained = _solved(vibrations, start, n_samples, guess, unexplained)
    time = (first + start + np.arange(force.size)) / vibrations[0].stretch.sampling_rate
    shortest = _NARROWEST / vibrations[0].high
    return RecoveredForce(time=time, force=force, covariance=covariance, unexplained=unexplained, shortest=shortest)


def _contact_in(force: Floats) -> tuple[int, int]:
    """Return the samples about the peak of a force, with a margin."""
    at = int(np.argmax(force))
    over = force > _FOOT * force[at]
    left = 0 if over[: at + 1].all() else at - int(np.argmin(over[at::-1]))
    right = force.size - 1 if over[at:].all() else at + int(np.argmin(over[at:]))
    margin = max(round(_MARGIN * (right - left)), 2)
    return max(left - margin, 0), min(right + margin + 1, force.size)


def _solved(
    vibrations: Sequence[_Vibration], start: int, n_samples: int, guess: Floats | None, before: float = 0.0
) -> tuple[Floats, Floats, float]:
    """Return the force at samples from `start` on, its covariance, and the fraction of the amplitude unexplained."""
    # With a guess of the force, each mode may be wrong by a complex factor.
    rate = vibrations[0].stretch.sampling_rate
    length = 0 if guess is None else np.count_nonzero(guess > _FOOT * guess.max()) + 1
    finest = rate / (_COARSE * vibrations[0].high) if guess is None else min(rate / vibrations[0].high, length) / _FINE
    spacing = max(finest, 1.0)
    # Zero just outside: corners from one spacing inside.
    corners = np.arange(spacing, n_samples, spacing)
    hats = np.maximum(1 - np.abs(np.arange(n_samples)[:, None] - corners) / spacing, 0.0)
    longer = np.concatenate([np.zeros((start, corners.size)), hats])
    levels = [1 / np.sqrt(np.mean(np.square(np.abs(one.bins)))) for one in vibrations]
    parts = [
        one.stretch.by_force(one.participation, longer) * level for one, level in zip(vibrations, levels, strict=True)
    ]
    matrix = np.concatenate(parts)
    target = np.concatenate([one.bins * level for one, level in zip(vibrations, levels, strict=True)])
    gram, vector = (matrix.conj().T @ matrix).real, (matrix.conj().T @ target).real
    gram += _RIDGE * np.diag(gram).max() * np.eye(len(gram))
    noise = 0.0
    if guess is not None:
        # A half sine of this peak and length bends so much from corner to corner; noise is what was left before. What
        # this says in place of the band is as uncertain as it allows.
        bends = guess.max() * (np.pi * spacing / length) ** 2
        second = np.diff(np.eye(corners.size + 2), 2, axis=0)[:, 1:-1]
        noise = _ALIKE * np.square(max(before, _QUIET)) / 2
        gram += noise / bends**2 * second.T @ second
    force = _pushing(gram, vector)
    left = target - matrix @ force
    inverse = np.linalg.inv(gram)
    unexplained = float(np.linalg.norm(left) / max(float(np.linalg.norm(target)), 1e-300))
    # Residuals of parts of the band, and the errors of the modes, of which a force may explain the larger part.
    blocks = zip(np.array_split(matrix, _PARTS), np.array_split(left, _PARTS), strict=True)
    pulls = [np.stack([(own.conj().T @ rest).real for own, rest in blocks])]
    if guess is not None:
        errors = [one.by_mode(guess) * one.error * level for one, level in zip(vibrations, levels, strict=True)]
        # Rows that cancel have large errors, which leave no more than is seen.
        size = np.sqrt(sum(float(np.square(np.abs(rest)).sum()) for rest in errors))
        share = min(1.0, _HIDDEN * max(unexplained, _QUIET) * float(np.linalg.norm(target)) / max(size, 1e-300))
        for own, rest in zip(parts, errors, strict=True):
            moved = share * own.conj().T @ rest
            pulls += [moved.real.T, moved.imag.T]
    pull = np.concatenate(pulls) @ inverse
    return hats @ force, hats @ (pull.T @ pull + noise * inverse) @ hats.T, unexplained


def _pushing(gram: Floats, vector: Floats) -> Floats:
    """Return the least-squares solution that is nowhere negative (Lawson & Hanson 1974)."""
    out, free = np.zeros(vector.size), np.zeros(vector.size, bool)
    for _ in range(3 * vector.size):
        slope = np.where(free, -np.inf, vector - gram @ out)
        if not (slope > 1e-10 * np.abs(vector).max()).any():
            break
        free[np.argmax(slope)] = True
        while True:
            trial = np.zeros(vector.size)
            trial[free] = np.linalg.solve(gram[np.ix_(free, free)], vector[free])
            below = free & (trial <= 0)
            if not below.any():
                break
            share = np.min(out[below] / (out[below] - trial[below]))
            out = out + share * (trial - out)
            free &= out > 1e-12 * max(out.max(), 1e-300)
            out[~free] = 0.0
        out = trial
    return out
