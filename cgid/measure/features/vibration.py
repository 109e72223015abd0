"""Measurements on a batch of vibrations, one impact each, and their features (`VIBRATION_FEATURES`, at the end).

Quantities are relative to a baseline and a noise from before onset, and use the event: the samples from the onset on,
most of them times `exp(-t / WINDOW_TIME)`, the exponential window of impact testing. So neither the length of the frame
nor the sampling rate matters much, except for skewness, kurtosis and flatness of the spectrum (`EnergySpectrum`). Rates
below 2 kHz show low frequencies alone, of which a window holds too few periods: it is longer there, as frames are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.features.table import LEAST_BANDWIDTH, LEAST_SAMPLES, MIN_BANDWIDTH, Bank, Feature, bank, described
from cgid.measure.frames import Frames, Problem, ProblemKind, constant_signal, no_impact
from cgid.measure.spectra import (
    MEL_BANDS,
    MIN_SHARE,
    N_PACKETS,
    THIRD_OCTAVES,
    EnergySpectrum,
    frame_spectra,
    packet_energies,
    passage,
    third_octave,
)

#: Time constant of the exponential window [s]. It widens a line by 1 / (pi WINDOW_TIME) = 21 Hz. At low rates it is a
#: part of `LEAST_SAMPLES`.
WINDOW_TIME, _WINDOW_PART = 15e-3, 0.17
#: Minimum distance between maxima of the spectrum [Hz]: several widths of a line, less where the window is longer.
MIN_SEPARATION = 100.0
#: Length of the frames for the delay of a band [s].
DELAY_FRAME = 10e-3
#: Longest event [s]: the window has then fallen to 2e-6. At low rates it is all of `LEAST_SAMPLES`.
MAX_EVENT = 0.2
#: Shortest event [s].
MIN_EVENT = 5e-3
#: The onset is where the distance from the baseline first exceeds this fraction of its maximum,
ONSET_OVER_PEAK = 0.05
#: or this many standard deviations of the noise if that is more, but at most the second fraction of its maximum.
ONSET_OVER_NOISE, LATEST_ONSET = 5.0, 0.8
#: Without `pre_trigger`, the quiet part ends this long before the signal first leaves its level [s].
QUIET_MARGIN = 1e-3
#: Length of the early window [s], in which the force still acts.
EARLY_TIME = 2e-3
#: Smallest peak: the fourth power of anything less underflows.
MIN_PEAK = 1e-75
#: Share of an event's energy in its strong part.
STRONG_SHARE = 0.9
#: Bands of the early window [Hz].
EARLY_BANDS = ((0, 500), (500, 1000), (1000, 2000), (2000, 4000), (4000, 8000))


class BeamInversion(Protocol):
    """A beam whose modes are known: `cgid.identification.inversion.through_beam.ThroughBeam`."""

    @property
    def n_sensors(self) -> int:
        """Number of sensors, and of vibrations of one impact."""
        ...

    def measured(self, vibrations: VibrationBatch) -> Mapping[str, Floats]:
        """Return features of the contact forces; the vibrations of one impact are adjacent rows."""


class VibrationBatch(Frames):
    """Vibrations in frames, one impact each; each quantity is computed on first use."""

    # Without `pre_trigger`, each row is quiet up to well before it first leaves its initial level.

    #: The beam that vibrates, for the features that need it.
    beam: BeamInversion | None = None
    #: Channel of the recording of each impact, in order of time within each channel; None without a recording.
    channel: NDArray[np.intp] | None = None

    @cached_property
    def through_beam(self) -> Mapping[str, Floats]:
        """The features of the contact forces."""
        assert self.beam is not None
        return self.beam.measured(self)

    # -- before onset ---------------------------------------------------------------------------------

    @property
    def n_quiet(self) -> NDArray[np.intp]:
        """Number of samples before onset that define baseline and noise."""
        if self.pre_trigger is not None:
            return np.full(len(self.samples), self.pre_trigger, np.intp)
        return self._surely_quiet

    @cached_property
    def _surely_quiet(self) -> NDArray[np.intp]:
        """Number of samples up to well before the first that leaves the level before the largest deviation."""
        centre = self.samples.mean(axis=1, dtype=np.float64)
        index = np.argmax(np.abs(self.samples - centre[:, None]), axis=1)
        # The first half of the samples before the largest deviation defines the quiet level.
        mean, noise = self._moments(index // 2)
        deviation = np.abs(self.samples - mean[:, None])
        threshold = _onset_threshold(deviation[np.arange(len(index)), index], noise)
        first = np.argmax(deviation > threshold[:, None], axis=1)
        return np.asarray(np.maximum(first - int(np.ceil(QUIET_MARGIN * self.sampling_rate)), 0))

    # -- the onset ------------------------------------------------------------------------------------

    @cached_property
    def _deviation(self) -> Floats:
        """Distance from the baseline, 0 before onset."""
        deviation = np.abs(self.samples - self.offset[:, None])
        if self.pre_trigger is None:
            deviation[np.arange(deviation.shape[1]) < self.n_quiet[:, None]] = 0.0
        else:
            deviation[:, : self.pre_trigger] = 0.0
        return deviation

    @cached_property
    def peak(self) -> Floats:
        """Largest distance from the baseline."""
        return np.asarray(self._deviation.max(axis=1))

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """First sample of the event."""
        return np.asarray(np.argmax(self._deviation > self._threshold[:, None], axis=1))

    @cached_property
    def _threshold(self) -> Floats:
        return _onset_threshold(self.peak, self.noise)

    @cached_property
    def _lead(self) -> Floats:
        """Time from crossing the threshold to the first sample of the event [samples], linear in between."""
        rows = np.arange(len(self.first))
        high = self._deviation[rows, self.first]
        low = np.where(self.first > 0, self._deviation[rows, np.maximum(self.first - 1, 0)], 0.0)
        return (high - self._threshold) / np.where(high > low, high - low, 1.0)

    # -- the event ------------------------------------------------------------------------------------

    @cached_property
    def event(self) -> Floats:
        """Samples from the onset on, less the baseline; zeros after the end of the frame."""
        n_samples = self.samples.shape[1]
        longest = max(int(np.ceil(MAX_EVENT * self.sampling_rate)), LEAST_SAMPLES)
        out = np.zeros((len(self.samples), min(n_samples, longest)))
        # Row by row: copying a slice is several times faster than gathering the same samples.
        for row, first in enumerate(self.first.tolist()):
            part = self.samples[row, first : first + out.shape[1]]
            np.subtract(part, self.offset[row], out=out[row, : part.size])
        return out

    @cached_property
    def n_event(self) -> NDArray[np.intp]:
        """Number of samples of each event inside the frame."""
        return np.asarray(np.minimum(self.samples.shape[1] - self.first, self.event.shape[1]))

    @property
    def _n_window(self) -> float:
        """Time constant of the exponential window [samples]."""
        return max(WINDOW_TIME * self.sampling_rate, _WINDOW_PART * LEAST_SAMPLES)

    @cached_property
    def _window(self) -> Floats:
        return np.exp(-np.arange(self.event.shape[1]) / self._n_window)

    @cached_property
    def _noise_share(self) -> Floats:
        """Energy of the noise in the windowed event [unit^2 s]."""
        sums = np.append(0.0, np.cumsum(self._window**2))
        return np.asarray(self.noise**2 * sums[self.n_event] / self.sampling_rate)

    def _running_energy(self, weight: Floats) -> Floats:
        """Return the weighted energy of the event up to each sample, less that of the noise [unit^2 s]."""
        # At most half of the energy is subtracted: the noise before onset may be the decay of the previous impact.
        square = self.event**2 * weight
        share = np.append(0.0, np.cumsum(weight))[self.n_event]
        noise = np.minimum(self.noise**2, 0.5 * square.sum(axis=1) / share)
        inside = np.arange(square.shape[1]) < self.n_event[:, None]
        square -= np.where(inside, noise[:, None] * weight, 0.0)
        return np.asarray(np.cumsum(square, axis=1, out=square)) / self.sampling_rate

    @cached_property
    def _growth(self) -> Floats:
        """Energy of the windowed event up to each sample, (n_signals, n_samples)."""
        return self._running_energy(self._window**2)

    def rise(self, share: float) -> Floats:
        """Return the time from the onset until a share of the windowed energy has arrived [s]."""
        # The energy of a sample arrives in the interval around it.
        count = passage(self._growth, share) - 0.5 + self._lead
        return np.maximum(count, 0.5) / self.sampling_rate

    # -- the strong part ------------------------------------------------------------------------------

    @cached_property
    def _n_strong(self) -> NDArray[np.intp]:
        """Number of samples with `STRONG_SHARE` of the windowed energy."""
        return np.maximum(np.ceil(passage(self._growth, STRONG_SHARE)), 1).astype(np.intp)

    @cached_property
    def _strong(self) -> Floats:
        """The event, zero after its strong part."""
        longest = int(self._n_strong.max())
        return np.where(np.arange(longest) < self._n_strong[:, None], self.event[:, :longest], 0.0)

    @cached_property
    def strong_moments(self) -> tuple[Floats, Floats]:
        """Mean of the square and of the fourth power over the strong part."""
        # A running sum: the splitting of a plain sum depends on the longest row of the batch.
        square = self._strong**2
        second, fourth = (np.cumsum(power, axis=1)[:, -1] for power in (square, square**2))
        return np.asarray(second / self._n_strong), np.asarray(fourth / self._n_strong)

    @property
    def strong_rms(self) -> Floats:
        """Root mean square over the strong part."""
        return np.sqrt(self.strong_moments[0])

    @cached_property
    def zero_crossing_rate(self) -> Floats:
        """Changes of sign over the length of the strong part [Hz]."""
        sign = np.signbit(self._strong)
        changes = sign[:, 1:] != sign[:, :-1]
        inside = np.arange(1, self._strong.shape[1]) < self._n_strong[:, None]
        return np.asarray(np.sum(changes & inside, axis=1) * self.sampling_rate / self._n_strong)

    # -- times ----------------------------------------------------------------------------------------

    @cached_property
    def time_to_peak(self) -> Floats:
        """Time from the onset to the largest distance from the baseline [s]."""
        return np.asarray((np.argmax(self._deviation, axis=1) - self.first + self._lead) / self.sampling_rate)

    @cached_property
    def time_to_first_maximum(self) -> Floats:
        """Time from the onset to the first maximum of the distance from the baseline [s], by a parabola there."""
        size = np.abs(self.event)
        falls = size[:, 1:] < size[:, :-1]
        falls[:, -1] = True
        index = np.argmax(falls, axis=1)
        rows = np.arange(len(index))
        outside = self._deviation[rows, np.maximum(self.first - 1, 0)]
        before = np.where(index > 0, size[rows, index - 1], outside)
        top, after = size[rows, index], size[rows, index + 1]
        bend = before - 2 * top + after
        shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
        # A parabola must not yield a time before the onset.
        return np.asarray(np.maximum(index + np.clip(shift, -0.5, 0.5) + self._lead, 0.05) / self.sampling_rate)

    @cached_property
    def decay_time(self) -> Floats:
        """Time in which the energy falls by 60 dB, extrapolated from Schroeder's integral between -5 and -15 dB [s]."""
        # It ends with the frame, so it is too short for a vibration that outlasts the frame.
        running = self._running_energy(np.ones(self.event.shape[1]))
        five, fifteen = (passage(running, 1 - 10**-fall) for fall in (0.5, 1.5))
        return np.asarray(6 * np.maximum(fifteen - five, 1.0) / self.sampling_rate)

    # -- the spectrum ---------------------------------------------------------------------------------

    @cached_property
    def spectrum(self) -> EnergySpectrum:
        """Spectrum of the windowed event."""
        return EnergySpectrum.of(self.event * self._window, self.sampling_rate)

    def level(self, low: float, high: float) -> Floats:
        """Return log10 of the energy between two frequencies [Hz] in the windowed event, less that of white noise."""
        return self._level(self.spectrum, self._noise_share, low, high)

    @cached_property
    def total_level(self) -> Floats:
        """Level of all frequencies together."""
        return self.level(0.0, 0.5 * self.sampling_rate)

    def early_level(self, low: float, high: float) -> Floats:
        """Return the level between two frequencies [Hz] in the first `EARLY_TIME` of the event."""
        spectrum, noise = self._early
        return self._level(spectrum, noise, low, high)

    @cached_property
    def _early(self) -> tuple[EnergySpectrum, Floats]:
        """Spectrum of the early window, and the energy of the noise in it [unit^2 s]."""
        count = min(max(round(EARLY_TIME * self.sampling_rate), 2), self.event.shape[1])
        # Half a cosine bell: an event has its own onset, only its end needs a taper.
        window = np.cos(np.arange(count) * (0.5 * np.pi / count)) ** 2
        noise = self.noise**2 * (np.sum(window**2) / self.sampling_rate)
        return EnergySpectrum.of(self.event[:, :count] * window, self.sampling_rate, finer=4), noise

    def _level(self, spectrum: EnergySpectrum, noise: Floats, low: float, high: float) -> Floats:
        energy, width = spectrum.between(low, high)[:, None], np.array([high - low])
        return self._levels(energy, spectrum.total, noise, width)[:, 0]

    @cached_property
    def clean_spectrum(self) -> EnergySpectrum:
        """Spectrum of the windowed event, less the share of the noise in each bin, at least 0."""
        energy = self.spectrum.energy
        clean = np.maximum(energy - (self._noise_share / (energy.shape[1] - 1))[:, None], 0.0)
        # If there is only noise, all of it counts.
        return EnergySpectrum(self.spectrum.spacing, np.where((clean > 0).any(axis=1)[:, None], clean, energy))

    @cached_property
    def dominant_frequencies(self) -> Floats:
        """Frequencies of the three strongest maxima of the clean spectrum [Hz], (n_signals, 3)."""
        return self.clean_spectrum.dominant(3, MIN_SEPARATION * WINDOW_TIME * self.sampling_rate / self._n_window)

    # -- bands that overlap ---------------------------------------------------------------------------

    @cached_property
    def mel(self) -> Floats:
        """Level of each of `MEL_BANDS` in the windowed event, (n_signals, n_bands)."""
        bands = MEL_BANDS.within(0.5 * self.sampling_rate)
        width = 0.5 * (bands.corners[2:] - bands.corners[:-2])
        energy = bands.sums(self.spectrum.energy, self.spectrum.spacing)
        return self._levels(energy, self.spectrum.total, self._noise_share, width)

    @cached_property
    def mel_delay(self) -> Floats:
        """Mean time after the onset of the energy in each of `MEL_BANDS` [s], (n_signals, n_bands)."""
        length = 2 * max(round(0.5 * DELAY_FRAME * self.sampling_rate), 1)
        padded = np.pad(self.event * self._window, ((0, 0), (length // 2, length // 2)))
        spacing, energy = frame_spectra(padded, length, self.sampling_rate)
        energy = MEL_BANDS.within(0.5 * self.sampling_rate).sums(energy, spacing)
        time = np.arange(energy.shape[1]) * (length // 2 / self.sampling_rate)
        total = np.maximum(energy.sum(axis=1), np.finfo(np.float64).tiny)
        return np.asarray((energy * time[:, None]).sum(axis=1) / total)

    @cached_property
    def packets(self) -> Floats:
        """Level of each wavelet packet of the windowed event, (n_signals, n_packets)."""
        energy = packet_energies(self.event * self._window) / self.sampling_rate
        width = np.full(energy.shape[1], 0.5 * self.sampling_rate / energy.shape[1])
        return self._levels(energy, energy.sum(axis=1), self._noise_share, width)

    def _levels(self, energy: Floats, total: Floats, noise: Floats, width: Floats) -> Floats:
        """Return levels of energies in bands (n_signals, n_bands) of widths [Hz], less the share of the noise."""
        share = noise[:, None] * (width / (0.5 * self.sampling_rate))
        least = np.maximum(share, np.maximum(MIN_SHARE * total, np.finfo(np.float64).tiny)[:, None])
        return np.asarray(np.log10(np.maximum(energy - share, least)))

    # -- rows that cannot be measured -----------------------------------------------------------------

    def problems(self) -> dict[int, Problem]:
        """Map each row that cannot be measured to its problem."""
        problems: dict[int, Problem] = {}
        for row in np.flatnonzero(np.ptp(self.samples, axis=1) == 0):
            problems[int(row)] = constant_signal(self.samples[row, 0])
        for row in np.flatnonzero(~(self.peak > self.detection_limit * self.noise) | ~(self.peak > MIN_PEAK)):
            problems.setdefault(
                int(row),
                no_impact(
                    f"the peak must exceed {self.detection_limit:g} times the noise, it is {self.peak[row]:.3g} over "
                    f"a noise of {self.noise[row]:.3g}; record closer to the impact or with less noise"
                ),
            )
        if self.pre_trigger is None:
            for row in np.flatnonzero(self.first == 0):
                problems.setdefault(
                    int(row),
                    Problem(
                        ProblemKind.CUT_OFF,
                        "the vibration must begin inside the frame, it is cut off by its start (sample 0): record "
                        "some samples before onset",
                    ),
                )
        for row in np.flatnonzero(self.samples.shape[1] - self.first < MIN_EVENT * self.sampling_rate):
            there = (self.samples.shape[1] - self.first[row]) / self.sampling_rate
            problems.setdefault(
                int(row),
                Problem(
                    ProblemKind.CUT_OFF,
                    f"the vibration must last {MIN_EVENT * 1e3:g} ms inside the frame, it is cut off by its end after "
                    f"{there * 1e3:.3g} ms: record a longer frame",
                ),
            )
        return problems


def _onset_threshold(peak: Floats, noise: Floats) -> Floats:
    """Return the deviation above which a signal has left its baseline."""
    return np.maximum(ONSET_OVER_PEAK * peak, np.minimum(ONSET_OVER_NOISE * noise, LATEST_ONSET * peak))


# -- features -----------------------------------------------------------------------------------------

_described = partial(described, kind="vibration", highest_frequency=LEAST_BANDWIDTH)
_bank = partial(bank, kind="vibration")

_BASIC = _described(
    {
        "peak_amplitude": lambda v: v.peak,
        "strong_rms": lambda v: v.strong_rms,
        "crest_factor": lambda v: v.peak / v.strong_rms,
        "strong_kurtosis": lambda v: v.strong_moments[1] / v.strong_moments[0] ** 2,
        "zero_crossing_rate": lambda v: v.zero_crossing_rate,
        "decay_time": lambda v: v.decay_time,
        "vibration_centroid": lambda v: v.clean_spectrum.moments[0],
        "vibration_spread": lambda v: v.clean_spectrum.moments[1],
        "vibration_rolloff": lambda v: v.clean_spectrum.rolloff(0.85),
        "time_to_first_maximum": lambda v: v.time_to_first_maximum,
        "time_to_peak": lambda v: v.time_to_peak,
        "energy_rise_50": lambda v: v.rise(0.5),
        "energy_rise_90": lambda v: v.rise(0.9),
        "level_total": lambda v: v.total_level,
    }
)
_TOTAL = _BASIC[-1]
_OCTAVES = [third_octave(number) for number in range(len(THIRD_OCTAVES))]
_LEVELS = _bank(
    "level_*_hz",
    lambda v, n: v.level(*third_octave(n)),
    THIRD_OCTAVES,
    highest_frequency=[max(high, LEAST_BANDWIDTH) for _, high in _OCTAVES],
    # A frame resolves frequencies one over its length apart.
    shortest_frame=[1 / (high - low) for low, high in _OCTAVES],
)
_EARLY_LEVELS = _bank(
    "early_level_*_hz",
    lambda v, n: v.early_level(*EARLY_BANDS[n]),
    [f"{low}_{high}" for low, high in EARLY_BANDS],
    highest_frequency=[max(high, MIN_BANDWIDTH) for _, high in EARLY_BANDS],
)
_mel = partial(
    _bank,
    labels=MEL_BANDS.labels,
    highest_frequency=np.maximum(MEL_BANDS.corners[2:], MIN_BANDWIDTH).tolist(),
    shortest_frame=(2 / (MEL_BANDS.corners[2:] - MEL_BANDS.corners[:-2])).tolist(),
)
_MEL = _mel("mel_*_hz", lambda v, n: v.mel[:, n])
_PACKETS = _bank(
    f"packet_*_of_{N_PACKETS}",
    lambda v, n: v.packets[:, n],
    [str(number + 1) for number in range(N_PACKETS)],
    highest_frequency=MIN_BANDWIDTH,
    extra="wavelets",
)

#: Features of the pulse of the contact force, recovered through the beam: three quantities, the deviations of their
#: logarithms, and the correlations of first and second, first and third, second and third.
BEAM_PULSE = (
    *("beam_peak_force", "beam_pulse_width", "beam_restitution"),
    *("beam_peak_force_deviation", "beam_pulse_width_deviation", "beam_restitution_deviation"),
    *("beam_peak_width_correlation", "beam_peak_restitution_correlation", "beam_width_restitution_correlation"),
)
#: These, and features of the location and of what remains unexplained.
_BEAM = (
    *BEAM_PULSE,
    *("beam_impact_x", "beam_impact_y", "beam_place_deviation"),
    *("beam_misfit", "beam_unexplained", "beam_surely_unexplained", "beam_misshapen", "beam_overlap"),
)


def _through_beam(name: str) -> Callable[[VibrationBatch], Floats]:
    return lambda vibrations: vibrations.through_beam[name]


VIBRATION_FEATURES: tuple[Feature | Bank, ...] = (
    *_BASIC,
    _LEVELS,
    _LEVELS.less("relative_level_*_hz", _TOTAL),
    _EARLY_LEVELS,
    _EARLY_LEVELS.less("relative_early_level_*_hz", _TOTAL),
    *_described(
        {
            "vibration_skewness": lambda v: v.clean_spectrum.standardised_moments[0],
            "vibration_kurtosis": lambda v: v.clean_spectrum.standardised_moments[1],
            "vibration_flatness": lambda v: v.spectrum.flatness,
            "dominant_frequency": lambda v: v.dominant_frequencies[:, 0],
            "second_frequency": lambda v: v.dominant_frequencies[:, 1],
            "third_frequency": lambda v: v.dominant_frequencies[:, 2],
        }
    ),
    _MEL,
    _MEL.less("relative_mel_*_hz", _TOTAL),
    _mel("mel_delay_*_hz", lambda v, n: v.mel_delay[:, n]),
    _PACKETS,
    _PACKETS.less(f"relative_packet_*_of_{N_PACKETS}", _TOTAL),
    *_described({name: _through_beam(name) for name in _BEAM}),
)
