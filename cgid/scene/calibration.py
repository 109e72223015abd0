"""The gain of a sensor from recorded blows on its beam: hammer taps, or drops of known mass."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.physics import Impact
from cgid.physics.driving import Pulses
from cgid.physics.response import LowPass, Resonance, Response
from cgid.scene.impacts import beam_modes
from cgid.scene.schema import Scene, load_scene, parse_scene
from cgid.scene.sections import TailBeamSection
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
#: Interpolated points of a force for each recorded one.
_FINER = 8
#: A blow that explains less of the motion did not cause it.
_MIN_EXPLAINED = 0.02
#: Samples of a blow that its delay is searched in, and relative error of the responses.
_ALIGNED, _TOLERANCE = 2048, 1e-6
#: Steps of the fit, step of its derivative and largest change of a delay [samples].
_STEPS, _STEP, _MAX_CHANGE = 8, 1e-3, 0.5


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """A calibrated scene and the quality of the fit.

    Attributes
    ----------
    scene : Scene
        With `sensor.gain`.
    gain : float
        Recorded over synthesised.
    explained : ndarray, (n_blows,)
        Fraction of each recording's energy about its mean that the scene explains.
    delays : ndarray, (n_blows,)
        For a hammer, delay of the motion's channel to the force's; for a drop, onset in the recording [s].
    """

    scene: Scene
    gain: float
    explained: Floats
    delays: Floats


def calibrated(scene: Scene | str | Path, blows: Sequence[Blow]) -> Calibration:
    """Fit the gain of a scene's sensor to recorded blows: hammer taps, or drops of known mass.

    The gain is the factor between the recordings and the synthesised motion of the same blows, by least squares over
    all samples. Each recording is scaled by its largest sample, so all have the same weight. Offsets and delays are
    fitted as well. Noise in a hammer's channel biases the gain: by some 0.7 % per blow where it is 1 % of the peak of a
    contact of 5 to 10 samples. The modes of a beam come from `cgid tap` or `cgid calibrate`.

    Parameters
    ----------
    scene : Scene, str or Path
        With a beam and a sensor of motion: that of the recordings except for the gain.
    blows : sequence of Blow

    Returns
    -------
    Calibration

    Raises
    ------
    InvalidValue
        No blows, or a quantity, rate or location that does not fit the scene.
    BadData
        A recording is too noisy, clipped or starts too late, or the blows do not explain it.

    Examples
    --------
    Taps of an instrumented hammer, simulated with a sensor that is 30 % too loud:

    >>> from cgid.scene import Blow, calibrated, parse_scene, synthesise, varied
    >>> from cgid.signals import Signal
    >>> mode = {"damping_ratio": 0.02, "modal_mass": "300 kg", "shape_impact": 0.8, "shape_sensor": 0.6}
    >>> beam = parse_scene(
    ...     {
    ...         "name": "beam",
    ...         "impact": {"stiffness": "hertz", "dissipation": "elastic", "target": {"youngs_modulus": "210 GPa"}
    ...             | {"poisson_ratio": 0.3}},
    ...         "tail_beam": {"modes": [mode | {"frequency": "150 Hz"}, mode | {"frequency": "410 Hz"}]},
    ...         "sampling": {"sampling_rate": "10 kHz", "samples": 1500, "pre_trigger": 100},
    ...         "sensor": {"quantity": "acceleration", "anti_alias": {"frequency": "4 kHz"}, "relative_noise": "1 %"},
    ...         "taps": [{"label": "hammer", "shape": "haversine", "peak_force": "2 kN", "contact_duration": "1 ms"}],
    ...     }
    ... )
    >>> taps = {}
    >>> for unit, rig in {"m/s^2": varied(beam, gain=1.3), "N": varied(beam, quantity="force")}.items():
    ...     batch = next(synthesise(rig, 3, seed=1))
    ...     taps[unit] = [Signal(samples=row, sampling_rate=10e3, unit=unit) for row in batch.signals]
    >>> found = calibrated(beam, [Blow(motion=motion, force=force) for motion, force in zip(taps["m/s^2"], taps["N"])])
    >>> print(f"{found.gain:.2f}")
    1.30
    >>> bool((found.explained > 0.98).all())
    True
    """
    scene = load_scene(scene)
    blows = _checked(scene, blows)
    beam = scene.tail_beam
    assert beam is not None
    prepared = [_prepared(scene, blow) for blow in blows]
    modes = beam_modes(scene)
    points = np.array([_point(beam, blow) for blow in blows])
    rows = modes.participation(points[:, 0], points[:, 1])
    models = [_Model(scene, blow, modes, row) for blow, row in zip(prepared, rows, strict=True)]
    with threadpool_limits(1, "blas"):
        gain, delays = _aligned(models)
        gain, delays, explained = _refined(models, gain, delays)
    worst = int(np.argmin(explained))
    if explained[worst] < _MIN_EXPLAINED:
        raise BadData(
            f"{blows[worst].motion.name}: motion must come from the blow, which explains "
            f"{100 * explained[worst]:.1f} % of it; check that force and motion are of one blow, and where it fell"
        )
    content = json.loads(scene.text)
    content["sensor"] |= {"gain": gain}
    onsets = [
        0.0 if blow.force is not None else cut.first + cut.onset for blow, cut in zip(blows, prepared, strict=True)
    ]
    return Calibration(
        scene=parse_scene(content, source=f"calibration of {scene.name}"),
        gain=gain,
        explained=explained,
        delays=(delays + onsets) / scene.sampling.sampling_rate,
    )


def _checked(scene: Scene, blows: Sequence[Blow]) -> list[Blow]:
    blows = list(blows)
    if not blows:
        raise InvalidValue("blows must be at least 1, got none")
    for blow in blows:
        if not isinstance(blow, Blow):
            raise InvalidValue(f"blows must be of Blow, got {type(blow).__name__}")
    if scene.sensor.quantity == "force":
        raise InvalidValue(
            f"scene {scene.name} must have a sensor of motion on a tail beam to be calibrated, its sensor feels force"
        )
    return blows


def _point(beam: TailBeamSection, blow: Blow) -> tuple[float, float]:
    """Return the location of a blow; measured modes have only one."""
    if blow.impact_point is not None:
        place = blow.impact_point
        for axis, at, size in (("x", place[0], beam.length), ("y", place[1], beam.width)):
            if size is not None and not 0 <= at <= size:
                raise InvalidValue(f"impact_point must lie on the beam, {axis} between 0 and {size:g} m, got {at:g} m")
        return place
    if beam.impact_point is None:
        return (0.0, 0.0)
    extremes = [getattr(beam.impact_point, axis).extremes for axis in ("x", "y")]
    if any(low != high for low, high in extremes):
        raise InvalidValue(
            f"{blow.motion.name}: impact_point must be given, the scene's rocks fall on more than one place"
        )
    return extremes[0][0], extremes[1][0]


# ---- the fit ---------------------------------------------------------------------------------------------------------


class _Model:
    """The motion of one blow that the scene predicts, over the largest sample of the recording."""

    def __init__(self, scene: Scene, blow: _Prepared, modes: Any, participation: Floats) -> None:
        sensor, rate = scene.sensor, scene.sampling.sampling_rate
        assert sensor.quantity != "force"
        self.blow, self._sensor, self._rate, self._participation = blow, sensor, rate, participation
        self._response = Response(
            sampling_rate=rate, quantity=sensor.quantity, modes=modes, filters=blow.filters, tolerance=_TOLERANCE
        )

    def motion(self, delays: Floats, n_samples: int | None = None) -> Floats:
        """Return the motion without its mean for some delays [samples], (n_delays, n_samples)."""
        blow, n = self.blow, len(delays)
        frames: NDArray[Any] = np.zeros((n, n_samples or blow.samples.size))
        onset = (blow.onset + delays) / self._rate
        self._response.add_to_frames(frames, _Repeated(blow.pulse, n), onset, np.tile(self._participation, (n, 1)))
        if blow.limited:
            frames = self._sensor.limit_band(frames, self._rate)
        return np.asarray((frames - frames.mean(axis=1, keepdims=True)) / blow.level, np.float64)


class _Repeated:
    """The force of a blow, repeated for each frame."""

    def __init__(self, pulse: Pulses, n: int) -> None:
        self.contact_duration = np.broadcast_to(np.ravel(pulse.contact_duration), (n,))
        self.end_of_contact = np.broadcast_to(np.ravel(pulse.end_of_contact), (n,))
        self.add_to_frames = pulse.add_to_frames


def _aligned(models: Sequence[_Model]) -> tuple[float, Floats]:
    """Return the gain and the best delay of each blow [samples], (n_blows,), on the grid of its shifts.

    A shift by half a period with the opposite sign fits almost as well, so the clearest blow sets the sign.
    """
    squares, products, energies = [], [], []
    for model in models:
        samples = model.blow.samples[:_ALIGNED]
        samples = samples - samples.mean()
        motion = model.motion(model.blow.shifts, samples.size)
        squares.append(np.maximum(np.sum(motion**2, axis=1), 1e-300))
        products.append(motion @ samples)
        energies.append(float(samples @ samples))
    explained = [h**2 / g / energy for g, h, energy in zip(squares, products, energies, strict=True)]
    clearest = int(np.argmax([part.max() for part in explained]))
    best = int(np.argmax(explained[clearest]))
    gain = products[clearest][best] / squares[clearest][best]
    for _ in range(3):
        at = [int(np.argmin(gain**2 * g - 2 * gain * h)) for g, h in zip(squares, products, strict=True)]
        chosen = np.array([(h[k], g[k]) for g, h, k in zip(squares, products, at, strict=True)])
        gain = chosen[:, 0].sum() / chosen[:, 1].sum()
    return float(gain), np.array([model.blow.shifts[k] for model, k in zip(models, at, strict=True)])


def _refined(models: Sequence[_Model], gain: float, delays: Floats) -> tuple[float, Floats, Floats]:
    """Return gain, delays and explained fractions of the energy by Gauss-Newton steps over whole recordings."""
    for _ in range(_STEPS):
        information = pull = 0.0
        slopes, rests = [], []
        for model, delay in zip(models, delays, strict=True):
            motion, late = model.motion(np.array([delay, delay + _STEP]))
            slopes.append((motion, gain * (late - motion) / _STEP))
            rests.append(model.blow.samples - gain * motion)
            # What a delay of its own explains tells nothing of the gain.
            free = _without(*slopes[-1])
            information, pull = information + float(free @ free), pull + float(free @ rests[-1])
        change = pull / information
        steps = [
            float(slope @ (rest - change * motion)) / max(float(slope @ slope), 1e-300)
            for (motion, slope), rest in zip(slopes, rests, strict=True)
        ]
        gain, delays = gain + change, delays + np.clip(steps, -_MAX_CHANGE, _MAX_CHANGE)
    explained = []
    for model, delay in zip(models, delays, strict=True):
        samples = model.blow.samples
        rest = samples - gain * model.motion(np.array([delay]))[0]
        explained.append(1 - rest @ rest / (samples @ samples))
    return gain, delays, np.array(explained)


def _without(values: Floats, direction: Floats) -> Floats:
    """Return values without their part along a direction."""
    return np.asarray(values - direction * (float(direction @ values) / max(float(direction @ direction), 1e-300)))


# ---- blows -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Prepared:
    """A blow prepared for the fit: cut out, without its mean, over its largest sample."""

    samples: Floats
    first: int  # first sample of the cut in the recording
    level: float  # the divisor of the samples, in the SI unit of the sensor
    pulse: Pulses  # one force, for any number of frames
    onset: float  # apparent start of the force in the cut [samples], to be corrected by one of the shifts
    shifts: Floats  # [samples], (n_shifts,)
    filters: tuple[Resonance | LowPass, ...]  # between force and recorded motion, in addition to the beam
    limited: bool  # whether the sensor's zero-phase low-pass lies between them as well


def _prepared(scene: Scene, blow: Blow) -> _Prepared:
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
        start, pulse = _hammered(blow.force, rate)
        onset, shifts = float(start), np.arange(-_CHANNELS_APART, _CHANNELS_APART + 0.25, 0.5)
        last = len(samples)
        if blow.force_filtered:
            filters = tuple(part for part in filters if isinstance(part, Resonance))
    else:
        assert blow.impact is not None
        onset, lasts = float(_first_motion(samples, motion.name)), blow.impact.contact_duration.item() * rate
        shifts = np.arange(-_UNSEEN - _UNSEEN_SHARE * lasts, _CHANNELS_APART, 0.5)
        pulse = blow.impact
        flight = 2 * blow.impact.rebound_velocity.item() / STANDARD_GRAVITY
        last = int(np.ceil(onset + lasts)) + int(_FLIGHT * flight * rate)
    first = max(int(onset) - _BEFORE, 0)
    cut = samples[first : min(last, int(onset) + _BEHIND)]
    level = float(np.abs(cut).max())
    _require_noise_below(cut[: int(onset) - first], level, motion.name)
    return _Prepared(
        samples=(cut - cut.mean()) / level,
        first=first,
        level=level,
        pulse=pulse,
        onset=onset - first,
        shifts=shifts,
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


def _hammered(force: Signal, rate: float) -> tuple[int, Pulses]:
    """Return the first sample of a hammer's force, and the force itself."""
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
    return start, _RecordedForce(window * samples[start:stop], rate)


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
