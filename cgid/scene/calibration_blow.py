"""One blow of a calibration: its recorded motion, and the force or drop that caused it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.physics import Impact
from cgid.physics.driving import Pulses
from cgid.physics.response import LowPass, Resonance
from cgid.scene.schema import Scene
from cgid.signals import Signal
from cgid.units import STANDARD_GRAVITY
from cgid.validation import Floats

#: Samples kept before the start of a blow, and at most after it.
_BEFORE, _BEHIND = 32, 1 << 15
#: Fewest samples before a blow: they show noise and offset.
_QUIET = 8
#: A hammer's force extends from the first to the last sample above this share of its peak and this multiple of its
#: noise, with a margin of samples on both sides; the outermost samples taper to zero.
_FORCE_FLOOR, _NOISE_FLOOR, _MARGIN, _TAPER = 1e-3, 4.0, 8, 3
#: Lowest peak of a blow over the noise.
_STANDS_OUT = 8.0
#: Largest delay between hammer and sensor channels [samples].
_CHANNELS_APART = 4.0
#: Touch may precede the first visible motion of a drop by this many samples plus this share of its contact.
_UNSEEN, _UNSEEN_SHARE = 8.0, 0.5
#: Share of the flight after a drop that is kept, because the sphere falls again.
_FLIGHT = 0.8
#: A filter has settled after this many of its time constants.
_CALM = 3.0
#: Interpolated points of a force for each recorded one.
_FINER = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """One blow on a tail beam: the recorded motion, and the force or the drop that caused it.

    Parameters
    ----------
    motion : Signal
        From the scene's sensor, with a quiet stretch before the blow.
    force : Signal, optional
        Recorded by the hammer with the same clock and length, above 0 where it pushes.
    impact : Impact, optional
        A drop of known mass in place of a force: one impact on `scene.body` at the `free_fall_velocity` of its height.
    impact_point : tuple of float, optional
        Where it fell, x and y [m]; by default that of the scene, if it is a single point.
    force_filtered : bool
        Whether the force passed the same anti-alias filter (or bandwidth) as the motion, as in two channels of one
        recorder. The filter then cancels.

    Raises
    ------
    InvalidValue
        Both or neither of force and impact, wrong unit or length of the force, more than one impact.
    """

    motion: Signal
    force: Signal | None = None
    impact: Impact | None = None
    impact_point: tuple[float, float] | None = None
    force_filtered: bool = True

    def __post_init__(self) -> None:
        validation.instance("motion", self.motion, Signal)
        if (self.force is None) == (self.impact is None):
            raise InvalidValue("a blow must have either force or impact, what made the motion, and not both")
        if self.impact_point is not None and validation.real("impact_point", self.impact_point, "m").shape != (2,):
            raise InvalidValue(f"impact_point must be x and y [m], got {self.impact_point!r}")
        if self.force is not None:
            self._require_force(self.force)
        if self.impact is not None:
            validation.instance("impact", self.impact, Impact)
            if self.impact.contact_duration.size != 1:
                raise InvalidValue(f"impact must be one, got {self.impact.contact_duration.size}; give each its Blow")

    def _require_force(self, force: Signal) -> None:
        validation.instance("force", force, Signal)
        if force.quantity != "force":
            raise InvalidValue(f"{force.name}: force must be in N or another unit of force, got {force.unit!r}")
        if force.sampling_rate != self.motion.sampling_rate or len(force.samples) != len(self.motion.samples):
            raise InvalidValue(
                f"{force.name}: force must have the samples of its motion, {len(self.motion.samples)} at "
                f"{self.motion.sampling_rate:g} Hz, got {len(force.samples)} at {force.sampling_rate:g} Hz"
            )


@dataclass(frozen=True)
class PreparedBlow:
    """A blow prepared for the fit: cut out, without its mean, over its largest sample."""

    samples: Floats
    first: int  # first sample of the cut in the recording
    level: float  # the divisor of the samples, in the SI unit of the sensor
    pulse: Pulses  # one force, for any number of frames
    onset: float  # apparent start of the force in the cut [samples], to be corrected by one of the shifts
    shifts: Floats  # [samples], (n_shifts,)
    decay: int  # from this sample on the beam rings freely
    filters: tuple[Resonance | LowPass, ...]  # between force and recorded motion, in addition to the beam
    limited: bool  # whether the sensor's zero-phase low-pass lies between them as well


def prepared(scene: Scene, blow: Blow) -> PreparedBlow:
    """Return a blow prepared for the fit.

    Raises `InvalidValue` if quantity or rate differ from those of the scene, and `BadData` if the recording is clipped
    or starts too late, or if no blow stands out of it.
    """
    motion, sensor, rate = blow.motion, scene.sensor, scene.sampling.sampling_rate
    if motion.quantity != sensor.quantity:
        raise InvalidValue(
            f"{motion.name}: motion must be {sensor.quantity} in {sensor.unit} or alike, as the sensor of scene "
            f"{scene.name}, got {motion.quantity or 'no unit'}"
        )
    if abs(motion.sampling_rate / rate - 1) > 1e-6:
        raise InvalidValue(
            f"{motion.name}: sampling_rate must be that of scene {scene.name}, {rate:g} Hz, got "
            f"{motion.sampling_rate:g} Hz; change the scene with varied(scene, sampling_rate=...) or resample"
        )
    samples = np.asarray(motion.in_si().samples, np.float64)
    highest = np.abs(samples).max()
    if sensor.range is not None and highest >= 0.999 * sensor.range:
        raise BadData(
            f"{motion.name}: motion must stay within the range of {sensor.range:g} {sensor.unit}; tap lighter"
        )
    filters = sensor.filters
    if blow.force is not None:
        start, stop, pulse = _hammered(blow.force, rate)
        onset, shifts = float(start), np.arange(-_CHANNELS_APART, _CHANNELS_APART + 0.25, 0.5)
        last = len(samples)
        if blow.force_filtered:
            filters = tuple(part for part in filters if isinstance(part, Resonance))
    else:
        assert blow.impact is not None
        onset, lasts = float(_first_motion(samples, motion.name)), blow.impact.contact_duration.item() * rate
        shifts = np.arange(-_UNSEEN - _UNSEEN_SHARE * lasts, _CHANNELS_APART, 0.5)
        pulse, stop = blow.impact, int(np.ceil(onset + lasts))
        flight = 2 * blow.impact.rebound_velocity.item() / STANDARD_GRAVITY
        last = stop + int(_FLIGHT * flight * rate)
    first = max(int(onset) - _BEFORE, 0)
    calm = max((float(-_CALM * rate / part.poles.real.max()) for part in filters), default=0.0)
    cut = samples[first : min(last, int(onset) + _BEHIND)]
    level = float(np.abs(cut).max())
    _require_noise_below(cut[: int(onset) - first], level, motion.name)
    return PreparedBlow(
        samples=(cut - cut.mean()) / level,
        first=first,
        level=level,
        pulse=pulse,
        onset=onset - first,
        shifts=shifts,
        decay=stop + int(np.ceil(calm)) - first,
        filters=filters,
        limited=sensor.bandwidth is not None and not (blow.force is not None and blow.force_filtered),
    )


def _require_noise_below(before: Floats, level: float, name: str) -> None:
    noise = float(before.std()) if before.size >= 2 else 0.0
    if not level > _STANDS_OUT * noise:
        raise BadData(
            f"{name}: motion must stand out of its noise {_STANDS_OUT:g} times, its peak is {level:.3g} over a noise "
            f"of {noise:.3g} before the blow; tap harder, or cut the recording to one blow"
        )


def _first_motion(samples: Floats, name: str) -> int:
    """Return the sample at which noise turns into motion, up to the largest sample.

    It is the likeliest boundary of two stretches of white noise with different variances: Maeda (1985), Zisin 38, 365.
    """
    peak = int(np.argmax(np.abs(samples)))
    if peak < 2 * _QUIET:
        raise BadData(
            f"{name}: motion must begin {2 * _QUIET} samples or more before its peak, got {peak}; leave a quiet "
            "stretch before the blow"
        )
    squares = np.cumsum(np.square(samples[: peak + 1] - np.median(samples[: peak // 2 + 1])))
    k = np.arange(_QUIET, peak)
    floor = 1e-12 * squares[-1]
    before, behind = squares[k - 1] + floor, squares[-1] - squares[k - 1] + floor
    return int(k[np.argmin(k * np.log(before / k) + (peak + 1 - k) * np.log(behind / (peak + 1 - k)))])


def _hammered(force: Signal, rate: float) -> tuple[int, int, Pulses]:
    """Return the first sample of a hammer's force, the sample after its end, and the force itself."""
    samples = np.asarray(force.in_si().samples, np.float64)
    samples = samples - np.median(samples)
    peak, lowest = float(samples.max()), float(-samples.min())
    # Most of a recording holds no force, so its median deviation is that of the noise.
    noise = 1.4826 * float(np.median(np.abs(samples)))
    if not max(peak, lowest) > _STANDS_OUT * noise:
        raise BadData(
            f"{force.name}: force must rise {_STANDS_OUT:g} times above its noise of {noise:.3g} N, its peak is "
            f"{peak:.3g} N; check the hammer's channel"
        )
    if lowest > peak:
        raise BadData(f"{force.name}: force must be above 0 where it pushes, its peak is below; use Signal.inverted()")
    strong = np.flatnonzero(np.abs(samples) > max(_NOISE_FLOOR * noise, _FORCE_FLOOR * peak))
    # Noise passes the floor occasionally, so parts that a quiet stretch separates from the blow are left out.
    at = int(np.searchsorted(strong, np.argmax(samples)))
    gaps = np.diff(strong) > 2 * _MARGIN
    begins = np.flatnonzero(gaps[:at])
    ends = np.flatnonzero(gaps[at:])
    start = int(strong[begins[-1] + 1 if begins.size else 0]) - _MARGIN
    stop = int(strong[at + ends[0] if ends.size else -1]) + _MARGIN + 1
    if start < 0 or stop > len(samples):
        raise BadData(f"{force.name}: force must rise and fall within the recording, {_MARGIN} samples off its ends")
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_TAPER) + 0.5) / _TAPER)
    window = np.concatenate([rise, np.ones(stop - start - 2 * _TAPER), rise[::-1]])
    return start, stop, _RecordedForce(window * samples[start:stop], rate)


class _RecordedForce:
    """The force of a hammer: band-limited interpolation of its samples."""

    def __init__(self, samples: Floats, rate: float) -> None:
        from scipy.interpolate import CubicSpline
        from scipy.signal import resample

        self.contact_duration = self.end_of_contact = np.array([(samples.size - 1) / rate])
        # Zeros avoid a jump where the end of the period meets its start.
        padded = np.concatenate([samples, np.zeros(samples.size)])
        finer = resample(padded, _FINER * padded.size)[: _FINER * (samples.size - 1) + 1]
        self._force = CubicSpline(np.arange(finer.size) / (_FINER * rate), finer)

    def add_to_frames(self, frames: NDArray[Any], sampling_rate: Any, onset: Any, *, tolerance: float) -> None:
        """Add the force to each frame, from its own onset on."""
        times = np.arange(frames.shape[1]) / np.reshape(sampling_rate, (-1, 1)) - np.reshape(onset, (-1, 1))
        inside = (times > 0) & (times < self.contact_duration[0])
        frames[inside] += self._force(times[inside])
