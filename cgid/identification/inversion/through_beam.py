"""The contact force from the acceleration of a beam, impact by impact or as a stream, and its features."""

from __future__ import annotations

from collections import deque
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats, rates_agree
from cgid.identification.inversion.beam_responses import Observations
from cgid.identification.inversion.contact import Contact, ContactFit
from cgid.identification.inversion.inversion import MORE_THAN_ONE, ForceEstimate, Inversion
from cgid.identification.inversion.one_rate import OneRate
from cgid.identification.inversion.ring_down import RingDown
from cgid.measure.features.vibration import VibrationBatch
from cgid.measure.fit.ar_noise import ARNoise, ar_noise_of
from cgid.measure.frames import clipped_samples
from cgid.measure.modal.beam import SPAN_TIME, TOUCH, Beam

#: Maximum time of the onset before the first sample above the noise [s]: the travel time of waves.
REACH = 1.2e-3
#: Where a faster recorder had the filters of the beam's, its samples are used up to this share of the beam's rate:
#: beyond it, what folds back differs too much.
_TOP = 0.43
#: What is faster by more than this is brought to the beam's rate: it costs answers at 30 kHz, and saves some at 32 kHz.
_FASTER = 1.2
#: An onset this close to the ends of the table of forces is searched this much further [samples].
_EDGE, _BESIDE = 0.35, 4
#: With more than this fraction of the energy unexplained, and a misfit above this, the onset is searched this much
#: later [samples].
_MUCH, _LATER = (0.01, 1.3), (4, 8, 12, -6, 20)
#: In a stream a second impact explains this many times what all but this fraction of the impacts seem to have of one:
#: on a beam that is a little off, many do. On a foreign beam another still rings where the vibration before is this
#: much louder than usual and has more than this fraction of the energy.
_MORE_THAN_USUAL, _TWO, _STILL_LOUD, _STILL = 5.0, 0.3, 3.0, 0.01
#: In a stream: median unexplained fraction of energy on a foreign beam, and number of impacts for it; number of impacts
#: that settle the filter; number that test it again, and ratio of noise that triggers this.
_FOREIGN, _RECENT, _SETTLED, _TESTS, _LOUDER = 0.05, 200, 60, 8, 4.0
#: Numbers of impacts before decisions, and the later interval between decisions.
_DECISIONS, _EVERY = (8, 16, 32), 64
#: Maximum number of channels, before and after gaps, with such a state.
_REMEMBERED = 4096
#: Maximum misfit of noise: five standard deviations of chi-square of the coefficients of a frame.
_BY_NOISE = 1.28
#: Minimum and maximum number of samples before onset to estimate ring-down.
_MIN_QUIET, _MAX_QUIET = 64, 256
#: Minimum noise over the signal: of white noise, and of what an autoregression leaves, for single precision.
_FLOOR, _LEAST = 1e-3, 1e-6


class ThroughBeam:
    """Features of the contact force from vibrations of a beam."""

    # Rows of one impact follow in the order of the sensors. A recorder with another sampling rate is assumed to have
    # the same anti-alias filter, at the same fraction of its rate or, if it is faster, at the same frequency: whichever
    # force is more like a pulse. Of a slower one the beam has that rate, and what a faster one gave is at the beam's.

    def __init__(self, beam: Beam, *, lasting: bool = False) -> None:
        self.beam = beam
        self.inversion = Inversion(beam, lasting=lasting)
        self.fit = ContactFit(self.inversion)
        self.recorded = beam.sampling_rate  # sampling rate of the recorder [Hz]
        self._ring_down: dict[tuple[int, int], RingDown] = {}
        self._others: dict[float, ThroughBeam] = {}

    @property
    def n_sensors(self) -> int:
        """Number of sensors, and of vibrations of one impact."""
        return self.beam.n_sensors

    def of(self, recorded: float) -> ThroughBeam:
        """Return the same for a recorder of this sampling rate [Hz]."""
        if rates_agree(recorded, self.beam.sampling_rate):
            return self
        if recorded not in self._others:
            # Tables are kept by rate: clocks that agree to five digits share them.
            if recorded > _FASTER * self.beam.sampling_rate:
                other = copy(self)
            else:
                other = ThroughBeam(self.beam.at(float(f"{recorded:.5g}")), lasting=self.inversion.lasting)
            other.recorded = recorded
            self._others[recorded] = other
        return self._others[recorded]

    def brings(self, recorded: float, n_channels: int = 1) -> OneRate | None:
        """Return what brings a faster recorder's samples to the rate of the beam; None for others."""
        is_faster = recorded > _FASTER * self.beam.sampling_rate
        return OneRate(self.beam, recorded, n_channels) if is_faster else None

    def own(self, vibrations: VibrationBatch) -> tuple[ThroughBeam, VibrationBatch]:
        """Return what looks at vibrations of any sampling rate, and these at its rate."""
        rate, before = vibrations.sampling_rate, vibrations.pre_trigger
        through, brought = self.of(rate), self.brings(rate)
        if brought is None:
            return through, vibrations
        if before is not None:
            before = int(before * brought.rate / rate)
        samples = brought.frames(vibrations.samples)
        return through, replace(vibrations, samples=samples, sampling_rate=brought.rate, pre_trigger=before)

    def stream(self) -> BeamStream:
        """Return the same for impacts that follow each other in a stream."""
        return BeamStream(self)

    def measured(self, vibrations: VibrationBatch) -> dict[str, Floats]:
        """Return the features of the contact forces of vibrations by name, nan where there is no impact."""
        through, vibrations = self.own(vibrations)
        return through.features(vibrations, *through.look(vibrations))

    def features(self, vibrations: VibrationBatch, estimate: ForceEstimate, contact: Contact) -> dict[str, Floats]:
        """Return the features of vibrations by name, from their estimates."""
        deviation = np.sqrt(contact.covariance[:, range(3), range(3)])
        correlation = np.clip(contact.covariance / (deviation[:, :, None] * deviation[:, None]), -1.0, 1.0)
        # Subtract what noise and earlier vibration can explain.
        surely = np.maximum(estimate.misfit - _BY_NOISE, 0.0) / np.maximum(estimate.misfit - 1, 1e-9)
        surely = np.maximum(estimate.unexplained * surely - self.earlier(vibrations), 0.0)
        return {
            "beam_peak_force": contact.peak,
            "beam_pulse_width": contact.width,
            "beam_restitution": np.exp(contact.shape),
            "beam_peak_force_deviation": deviation[:, 0],
            "beam_pulse_width_deviation": deviation[:, 1],
            "beam_restitution_deviation": deviation[:, 2],
            "beam_peak_width_correlation": correlation[:, 0, 1],
            "beam_peak_restitution_correlation": correlation[:, 0, 2],
            "beam_width_restitution_correlation": correlation[:, 1, 2],
            "beam_impact_x": estimate.x,
            "beam_impact_y": estimate.y,
            "beam_place_deviation": np.hypot(*estimate.place_deviation.T),
            "beam_misfit": estimate.misfit,
            "beam_unexplained": 100 * estimate.unexplained,
            "beam_surely_unexplained": 100 * surely,
            "beam_misshapen": 100 * contact.outside,
            "beam_overlap": 100 * estimate.overlap,
        }

    def earlier(self, vibrations: VibrationBatch) -> Floats:
        """Return the energy of what came before each impact over that of the impact."""
        event = vibrations.event[:, : round(SPAN_TIME * vibrations.sampling_rate)]
        energy = np.maximum(self.loudest(np.einsum("nt,nt->n", event, event)), 1e-300)
        return np.asarray(np.square(self.loudest(vibrations.noise)) * event.shape[1] / energy)

    def loudest(self, values: Floats) -> Floats:
        """Return the largest value of the sensors of each impact."""
        return np.asarray(values.reshape(-1, self.n_sensors).max(axis=1))

    def look(self, vibrations: VibrationBatch) -> tuple[ForceEstimate, Contact]:
        """Return the forces estimated from vibrations at any sampling rate, and the pulses fitted to them."""
        through, vibrations = self.own(vibrations)
        n = len(vibrations.samples) // self.n_sensors
        return through.at_other_filter(vibrations, np.ones((n, 2), bool), np.ones(n, bool))[:2]

    def at_other_filter(
        self, vibrations: VibrationBatch, filters: NDArray[np.bool_], again: NDArray[np.bool_]
    ) -> tuple[ForceEstimate, Contact, Floats]:
        """Return force, pulse, and misfit of each filter (n, 2), infinite if not tried; `again` tries other onsets."""
        if rates_agree(self.recorded, self.beam.sampling_rate):
            filters = np.broadcast_to([True, False], filters.shape)
        rows = [np.flatnonzero(column) for column in filters.T]
        parts = [
            self._estimated(vibrations, undone, part, again[part])
            for undone, part in zip((False, True), rows, strict=True)
            if part.size or not filters.size
        ]
        estimates, contacts = zip(*parts, strict=True)
        estimate, contact = ForceEstimate.joined(list(estimates)), Contact.joined(list(contacts))
        # A wrong filter distorts the force rather than adding a residual: the pulse fits worse.
        misfit = np.full(filters.shape, np.inf)
        misfit.T[filters.T] = contact.misfit
        place = np.cumsum(filters.T).reshape(filters.T.shape).T - 1
        best = place[np.arange(len(filters)), misfit.argmin(axis=1)]
        return estimate.rows(best), contact.rows(best), misfit

    def _estimated(
        self, vibrations: VibrationBatch, undone: bool, rows: NDArray[np.intp], again: NDArray[np.bool_]
    ) -> tuple[ForceEstimate, Contact]:
        """Return the same for some rows, perhaps with the change of the recorder undone."""
        if rows.size < len(vibrations.samples) // self.n_sensors:
            vibrations = vibrations.rows(np.add.outer(rows * self.n_sensors, np.arange(self.n_sensors)).ravel())
        observations, onset = self._prepared(vibrations, undone)
        estimate = self.inversion.invert(observations, onset)
        contact = self.fit.fit(estimate)
        # If the onset is at the edge of the table of forces, search there, at the same location. If it is too early,
        # much stays unexplained: compare others.
        edge = np.where(contact.touch < _EDGE, -_BESIDE, np.where(contact.touch > TOUCH - _EDGE, _BESIDE, 0))
        start = estimate.later(edge)
        lost = np.flatnonzero(again & (estimate.unexplained > _MUCH[0]) & (estimate.misfit > _MUCH[1]))
        if lost.size:
            others = np.add.outer(start.first[lost] + TOUCH // 2, (0, *_LATER))
            start = start.replaced(lost, self.inversion.compare(observations.rows(lost), others))
        rows = np.flatnonzero(again & (start.first != estimate.start))
        if rows.size:
            other = self.inversion.refine(observations.rows(rows), start.rows(rows))
            before = self._before(observations.rows(rows), estimate.start[rows], other.start)
            better = np.flatnonzero(other.misfit + before < estimate.misfit[rows])
            if better.size:
                estimate = estimate.replaced(rows[better], other.rows(better))
                contact = contact.replaced(rows[better], self.fit.fit(other.rows(better)))
        # At the end of the region the impact itself may lie beyond, which leaves as much as a second one.
        x_low, x_high, y_low, y_high = self.beam.region
        inside = (estimate.x > x_low) & (estimate.x < x_high) & (estimate.y > y_low) & (estimate.y < y_high)
        rows = np.flatnonzero(again & inside & (estimate.unexplained > MORE_THAN_ONE))
        if rows.size:
            estimate.overlap[rows] = self.inversion.overlap(observations.rows(rows), estimate.rows(rows))
        return estimate, contact

    def _before(self, observations: Observations, first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
        """Return the energy outside a window that begins at the last sample, in units of the total misfit, (n,)."""
        columns = np.arange(min(observations.frames.shape[2], int(last.max(initial=0))))
        out = (columns >= first[:, None]) & (columns < last[:, None])
        power = np.square(observations.frames[:, :, : columns.size] / observations.noise[:, :, None])
        return np.asarray(np.sum(power, axis=(1, 2), where=out[:, None]) / (self.n_sensors * self.beam.n_samples))

    def _prepared(self, vibrations: VibrationBatch, undone: bool) -> tuple[Observations, NDArray[np.intp]]:
        """Return the input of the inversion, and the range of the onset."""
        frames = vibrations.samples - vibrations.offset[:, None]
        own, noise = self.beam.sampling_rate, vibrations.noise
        quiet, first = vibrations.n_quiet.astype(np.float64), vibrations.first.astype(np.float64)
        if undone:
            frames = self._undone(frames)
            before = np.arange(frames.shape[1]) < quiet[:, None]
            noise = np.sqrt(np.sum(np.square(frames), axis=1, where=before) / np.maximum(quiet, 1))
        clear = self._clearest(vibrations)
        start = np.stack(
            [
                np.maximum(np.floor(first - REACH * own), np.floor(quiet))[clear] - np.ceil(self.beam.delay * own),
                np.ceil(first)[clear] + 1,
            ],
            axis=1,
        )
        start[:, 0] = np.clip(start[:, 0], 0, start[:, 1])
        size = np.sqrt(np.einsum("nt,nt->n", frames, frames) / frames.shape[1])
        # Without noise: the accuracy of a table of the beam.
        noise = np.maximum(noise, _FLOOR * size + 1e-300)
        colour = ar_noise_of(frames, quiet, _LEAST * size, 1)
        clipped = clipped_samples(frames)
        frames, noise, error = self._settled(frames, quiet.astype(np.intp), noise, colour)
        limit = _TOP * own if undone else None
        found = Observations(frames, noise, colour.coefficients, colour.innovation, error, clipped, limit)
        return self._together(found, vibrations), start.astype(np.intp)

    def _clearest(self, vibrations: VibrationBatch) -> NDArray[np.intp]:
        """Return the row of each impact whose sensor measures it best, (n,)."""
        if self.n_sensors == 1:
            return np.arange(len(vibrations.samples))
        clear = vibrations.peak / np.maximum(vibrations.noise, 1e-300)
        best = np.argmax(clear.reshape(-1, self.n_sensors), axis=1)
        return np.asarray(np.arange(best.size) * self.n_sensors + best)

    def _together(self, found: Observations, vibrations: VibrationBatch) -> Observations:
        """Return rows of vibrations as impacts; a sensor without an impact is uninformative."""
        if self.n_sensors == 1:
            return found.by_sensor()
        silent = np.zeros(len(found.noise), bool)
        silent[list(vibrations.problems())] = True
        silent &= ~np.repeat(silent.reshape(-1, self.n_sensors).all(axis=1), self.n_sensors)
        found.noise[silent] = np.inf
        if found.coefficients is not None:
            found.coefficients[silent] = 0.0
        return found.changed(lambda array: array.reshape(-1, self.n_sensors, *array.shape[1:]))

    def _settled(
        self, frames: Floats, quiet: NDArray[np.intp], noise: Floats, colour: ARNoise
    ) -> tuple[Floats, Floats, Floats | None]:
        """Return frames without ring-down of earlier impacts, the noise, and the error power of the ring-down."""
        rows = colour.rows[quiet[colour.rows] >= _MIN_QUIET]
        if not rows.size:
            return frames, noise, None
        frames, noise, error = frames.copy(), noise.copy(), None
        lengths, sensors = np.minimum(quiet[rows], _MAX_QUIET) // 32 * 32, rows % self.n_sensors
        for n_quiet, sensor in sorted(set(zip(lengths.tolist(), sensors.tolist(), strict=True))):
            if (n_quiet, sensor) not in self._ring_down:
                self._ring_down[n_quiet, sensor] = RingDown(self.inversion, n_quiet, sensor)
            ring_down, own = self._ring_down[n_quiet, sensor], rows[(lengths == n_quiet) & (sensors == sensor)]
            before = np.stack([frames[row, quiet[row] - n_quiet : quiet[row]] for row in own])
            found, level, ring_error, rings = ring_down.after(before, colour.innovation[own])
            error = np.zeros((len(frames), ring_error.shape[1])) if error is None else error
            for number in np.flatnonzero(rings).tolist():
                part = frames[own[number], quiet[own[number]] : quiet[own[number]] + ring_down.n_samples]
                part -= found[number, : part.size]
            colour.coefficients[own[rings]] = 0.0
            noise[own[rings]], error[own[rings]] = level[rings], ring_error[rings]
        return frames, noise, error

    def _undone(self, frames: Floats) -> Floats:
        """Return frames as of a faster recorder that had the filters of the beam's."""
        frequency = np.fft.rfftfreq(2 * frames.shape[1], 1 / self.beam.sampling_rate)
        change = self.beam.at(self.recorded).gain(frequency) / self.beam.gain(frequency)
        return np.asarray(np.fft.irfft(np.fft.rfft(frames, 2 * frames.shape[1]) * change)[:, : frames.shape[1]])


class _ChannelState:
    """State of a channel from its impacts, which determines the fit of the next ones."""

    # Decisions are made after fixed numbers of impacts, so they do not depend on the batches.

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset the state."""
        self.n, self.n_tests, self.lost = 0, 0, 0
        self.level, self.usual, self.single = 0.0, 0.0, 0.0
        self.unexplained: deque[float] = deque(maxlen=_RECENT)
        self.overlap: deque[float] = deque(maxlen=_RECENT)
        self.ratios: list[float] = []
        self.levels: list[float] = []
        self.filters, self.again = (True, True), True

    @property
    def n_next(self) -> int:
        """Number of impacts up to the next decision."""
        return next((n for n in _DECISIONS if n > self.n), (self.n // _EVERY + 1) * _EVERY) - self.n

    def plan(self, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the filters to try (n, 2) for the next impacts, and whether to try other samples of onset, (n,)."""
        # A decision seldom changes what has settled on a known beam; else only impacts up to the next one are planned.
        settled = self.n >= _SETTLED and self.again and self.lost < _TESTS
        tests = np.arange(n if settled else min(n, self.n_next)) < self.n_tests
        return tests[:, None] | np.array(self.filters), tests | self.again

    def learn(self, unexplained: Floats, overlap: Floats, misfit: Floats, level: Floats) -> Floats:
        """Add impacts as they were planned up to a decision that changes the plan; return what is usual, (n, 3)."""
        # Unexplained energy and that of a second impact, misfits for both filters (n, 2), and noise; usual are the
        # unexplained energy, what many seem to have of a second impact, and the noise.
        usual, before = list[tuple[float, float, float]](), (self.filters, self.again)
        while len(usual) < len(level) and (self.filters, self.again) == before and not (usual and self.n_tests):
            own = slice(len(usual), len(usual) + self.n_next)
            usual += [(self.usual, self.single, self.level)] * len(level[own])
            self.overlap.extend(overlap[own].tolist())
            self._learn(unexplained[own], misfit[own], level[own])
        return np.array(usual)

    def _learn(self, unexplained: Floats, misfit: Floats, level: Floats) -> None:
        """Add impacts up to the next decision at most."""
        decides = self.n_next == len(level)
        self.n += len(level)
        self.n_tests = max(self.n_tests - len(level), 0)
        self.unexplained.extend(unexplained.tolist())
        self.levels.extend(level.tolist())
        for one in (unexplained > _FOREIGN).tolist():
            self.lost = max(self.lost + (1 if one else -1), 0)
        both = misfit[np.isfinite(misfit).all(axis=1)]
        self.ratios.extend(np.log(np.maximum(both, 1e-300)) @ (1.0, -1.0))
        if not decides:
            return
        before, self.level, self.levels = self.level, float(np.median(self.levels)), []
        if before and not 1 / _LOUDER < self.level / before < _LOUDER:
            self.reset()
            return
        self.usual = float(np.median(self.unexplained))
        self.single = _MORE_THAN_USUAL * sorted(self.overlap)[int((1 - _TWO) * len(self.overlap))]
        self.again = self.usual <= _FOREIGN
        if self.n >= _SETTLED and self.ratios:
            beams = bool(np.median(self.ratios) > 0)
            self.filters = not beams, beams
        if self.lost >= _SETTLED:
            self.lost, self.n_tests, self.ratios = 0, _TESTS, []


class BeamStream:
    """State of each channel of a stream, so that not every impact tries all filters and onsets."""

    # On a foreign beam another onset is no better, and a recorder has one filter. Both are tried again after a gap, a
    # change of level, or as many unexplained impacts as settled them.

    def __init__(self, through: ThroughBeam) -> None:
        self.through = through
        self._channels: dict[int, _ChannelState] = {}

    @property
    def n_sensors(self) -> int:
        """Number of sensors, and of vibrations of one impact."""
        return self.through.n_sensors

    def measured(self, vibrations: VibrationBatch) -> dict[str, Floats]:
        """Return the features of the next vibrations of a stream, as `ThroughBeam.measured`."""
        n_sensors = self.n_sensors
        rest = np.arange(len(vibrations.samples) // n_sensors)
        channel = np.zeros(rest.size, np.intp) if vibrations.channel is None else vibrations.channel
        parts, found = [], []
        for old in list(self._channels)[:-_REMEMBERED]:  # before gaps
            del self._channels[old]
        while rest.size:
            numbers = np.unique(channel[rest]).tolist()
            states = [self._channels.pop(number, _ChannelState()) for number in numbers]
            self._channels |= zip(numbers, states, strict=True)
            plans = [state.plan(int((channel[rest] == k).sum())) for k, state in zip(numbers, states, strict=True)]
            rows = [rest[channel[rest] == k][: len(plan[1])] for k, plan in zip(numbers, plans, strict=True)]
            of_all = np.concatenate(rows)
            order = np.argsort(of_all)
            of_all = of_all[order]
            part = vibrations.rows(np.add.outer(of_all * n_sensors, np.arange(n_sensors)).ravel())
            filters, again = (np.concatenate(one)[order] for one in zip(*plans, strict=True))
            estimate, contact, misfit = self.through.at_other_filter(part, filters, again)
            features = self.through.features(part, estimate, contact)
            earlier, before = self.through.earlier(part), self.through.loudest(part.noise)
            done = np.zeros(of_all.size, bool)
            for state, own in zip(states, rows, strict=True):
                own = np.searchsorted(of_all, own)
                known = estimate.unexplained[own], estimate.overlap[own], misfit[own], estimate.noise[own]
                left, single, level = state.learn(*known).T
                own = own[: level.size]
                done[own] = True
                second = estimate.overlap[own] * (estimate.overlap[own] > single)
                rings = (earlier[own] > _STILL) & (before[own] > _STILL_LOUD * level)
                features["beam_overlap"][own] = 100 * np.where(left > _FOREIGN, rings, second)
            parts.append(of_all[done])
            found.append({name: values[done] for name, values in features.items()})
            rest = np.setdiff1d(rest, parts[-1])
        order = np.argsort(np.concatenate(parts))
        return {name: np.concatenate([one[name] for one in found])[order] for name in found[0]}
