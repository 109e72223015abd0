"""The gain of a sensor from recorded impacts on its beam: hammer taps, or drops of known mass."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.physics import Impact
from cgid.physics.response import Resonance, Response
from cgid.scene.impacts import beam_modes
from cgid.scene.schema import Scene, load_scene, parse_scene
from cgid.scene.sections import TailBeamSection
from cgid.signals import Signal
from cgid.units import STANDARD_GRAVITY
from cgid.validation import Complex, Floats

#: Samples before the start of an impact, and maximum on either side of the largest.
_BEFORE, _AROUND = 32, 1 << 15
#: Minimum number of samples before a drop, for noise and offset.
_QUIET = 8
#: A hammer's force extends from the first to the last sample above this fraction of its peak and this multiple of its
#: noise, with a margin of samples on both sides; the outermost samples taper to zero.
_FORCE_FLOOR, _NOISE_FLOOR, _MARGIN, _TAPER = 1e-3, 4.0, 8, 3
#: Minimum peak of an impact over the noise.
_STANDS_OUT = 8.0
#: Largest delay between hammer and sensor channels [samples].
_MAX_DELAY = 4
#: Fraction of the flight after a drop that is kept, because the sphere falls again.
_FLIGHT = 0.8
#: Points of the force of a drop per sample.
_FINER = 16
#: Ring-down after twice the length of a recording wraps around, damped by this factor.
_WRAPPED = 1e-9
#: Numbers of a transfer function that are computed at once.
_AT_ONCE = 1 << 20
#: Minimum fraction of the motion explained by its impact.
_MIN_EXPLAINED = 0.02
#: Steps of the fit, and largest change of a delay [samples].
_STEPS, _MAX_CHANGE = 8, 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationImpact:
    """One impact on a tail beam: the recorded motion, and the force or the drop that caused it.

    Parameters
    ----------
    motion : Signal
        From the scene's sensor, with a quiet stretch before the impact.
    force : Signal, optional
        Recorded by the hammer with the same clock and length, above 0 where it pushes.
    impact : Impact, optional
        A drop of known mass instead of a force: one impact on `scene.body` at the `free_fall_velocity` of its height.
    impact_point : tuple of float, optional
        Location, x and y [m]; by default that of the scene, if it is a single point.
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
            raise InvalidValue("a calibration impact must have either force or impact")
        if self.impact_point is not None and validation.real("impact_point", self.impact_point, "m").shape != (2,):
            raise InvalidValue(f"impact_point must be x and y [m], got {self.impact_point!r}")
        if self.force is not None:
            self._require_force(self.force)
        if self.impact is not None:
            validation.instance("impact", self.impact, Impact)
            if self.impact.contact_duration.size != 1:
                raise InvalidValue(
                    f"impact must be one, got {self.impact.contact_duration.size}; give each its CalibrationImpact"
                )

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


def calibrated(scene: Scene | str | Path, impacts: Sequence[CalibrationImpact]) -> Calibration:
    """Fit the gain of a scene's sensor to recorded impacts: hammer taps, or drops of known mass.

    The gain is the factor between the recordings and the synthesised motion of the same impacts, by least squares over
    all samples. Each recording is scaled by its largest sample, so all have the same weight. Offsets and delays are
    fitted as well. Noise in a hammer's channel biases the gain: by some 0.7 % per impact if it is 1 % of the peak of a
    contact of 5 to 10 samples. The modes of a beam come from `cgid tap` or `cgid calibrate`.

    Parameters
    ----------
    scene : Scene, str or Path
        With a beam and a sensor of motion: that of the recordings except for the gain.
    impacts : sequence of CalibrationImpact

    Returns
    -------
    Calibration

    Raises
    ------
    InvalidValue
        No impacts, or a quantity, rate or location that does not fit the scene.
    BadData
        A recording is too noisy, clipped or starts too late, or the impacts do not explain it.

    Examples
    --------
    Taps of an instrumented hammer, simulated with a sensor that is 30 % too loud:

    >>> from cgid.scene import CalibrationImpact, calibrated, parse_scene, synthesise, varied
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
    >>> pairs = zip(taps["m/s^2"], taps["N"])
    >>> found = calibrated(beam, [CalibrationImpact(motion=motion, force=force) for motion, force in pairs])
    >>> print(f"{found.gain:.2f}")
    1.30
    >>> bool((found.explained > 0.98).all())
    True
    """
    scene = load_scene(scene)
    impacts = _checked(scene, impacts)
    beam, modes = scene.tail_beam, beam_modes(scene)
    assert beam is not None
    points = np.array([_point(beam, blow) for blow in impacts])
    rows = modes.participation(points[:, 0], points[:, 1])
    with threadpool_limits(1, "blas"):
        models = [_Model(scene, blow, row) for blow, row in zip(impacts, rows, strict=True)]
        clearest = max(models, key=lambda model: model.correlation()[1])
        # A shift by half a period with the opposite sign fits almost as well: the clearest impact determines the sign.
        sign = np.sign(clearest.correlation()[2])
        for model in models:
            model.begin(model.correlation(sign)[0])
        gain, explained = _fitted(models)
    worst = int(np.argmin(explained))
    if explained[worst] < _MIN_EXPLAINED:
        raise BadData(
            f"{impacts[worst].motion.name}: motion must be due to the impact, which explains "
            f"{100 * explained[worst]:.1f} % of it; check that force and motion belong together, and the impact point"
        )
    content = json.loads(scene.text)
    content["sensor"] |= {"gain": gain}
    return Calibration(
        scene=parse_scene(content, source=f"calibration of {scene.name}"),
        gain=gain,
        explained=explained,
        delays=np.array([model.delay + (model.blow.force is None) * model.first for model in models])
        / scene.sampling.sampling_rate,
    )


def _checked(scene: Scene, impacts: Sequence[CalibrationImpact]) -> list[CalibrationImpact]:
    impacts = list(impacts)
    if not impacts:
        raise InvalidValue("impacts must be at least 1, got none")
    for blow in impacts:
        if not isinstance(blow, CalibrationImpact):
            raise InvalidValue(f"impacts must be of CalibrationImpact, got {type(blow).__name__}")
    if scene.sensor.quantity == "force":
        raise InvalidValue(
            f"scene {scene.name} must have a sensor of motion on a tail beam to be calibrated, its sensor measures "
            "force"
        )
    return impacts


def _point(beam: TailBeamSection, blow: CalibrationImpact) -> tuple[float, float]:
    """Return the location of an impact; measured modes have only one."""
    if blow.impact_point is not None:
        place = blow.impact_point
        for axis, at, size in (("x", place[0], beam.length), ("y", place[1], beam.width)):
            if size is not None and not 0 <= at <= size:
                raise InvalidValue(f"impact_point must be on the beam, {axis} between 0 and {size:g} m, got {at:g} m")
        return place
    if beam.impact_point is None:
        return (0.0, 0.0)
    extremes = [getattr(beam.impact_point, axis).extremes for axis in ("x", "y")]
    if any(low != high for low, high in extremes):
        raise InvalidValue(
            f"{blow.motion.name}: impact_point must be given, the scene's rocks fall on more than one point"
        )
    return extremes[0][0], extremes[1][0]


# ---- the fit ---------------------------------------------------------------------------------------------------------


class _Model:
    """The motion of one impact that the scene predicts, for any delay of the force."""

    # Force and response are transformed along `s = decay + i omega`, so that long ring-down does not wrap around.

    def __init__(self, scene: Scene, blow: CalibrationImpact, participation: Floats) -> None:
        self.blow, self._sensor, self._rate = blow, scene.sensor, scene.sampling.sampling_rate
        samples, filters = _motion(scene, blow), scene.sensor.filters
        self.first = max(int(np.argmax(np.abs(samples))) - _AROUND, 0)
        part = slice(self.first, self.first + 2 * _AROUND)
        self.samples = samples[part] - samples[part].mean()
        n = self.samples.size
        self.onset, self._limited = 0, True
        if blow.force is not None:
            start, force = _hammered(blow.force)
            self.onset, force = start - self.first, force[part]
            if blow.force_filtered:  # the filter is in both channels
                filters, self._limited = tuple(part for part in filters if isinstance(part, Resonance)), False
            lags = np.arange(-_MAX_DELAY, _MAX_DELAY + 1)
        else:
            assert blow.impact is not None
            force = np.ravel(blow.impact.force(np.arange(_FINER * n) / (_FINER * self._rate)))
            lags = np.arange(n)
        self._lags, finer = lags, force.size // n
        decay = -np.log(_WRAPPED) / (2 * n)
        self._shrink = np.exp(-decay * np.arange(n))
        self._s = decay + 1j * np.pi * np.arange(n + 1) / n
        spectrum = np.fft.rfft(force * np.exp(-decay / finer * np.arange(force.size)), 2 * force.size)[: n + 1] / finer
        response = Response(
            sampling_rate=self._rate, quantity=scene.sensor.quantity, modes=beam_modes(scene), filters=filters
        )
        frequency = self._s * self._rate / (2j * np.pi)
        parts = np.array_split(frequency, 1 + frequency.size * participation.size // _AT_ONCE)
        self._spectrum = spectrum * np.concatenate([response.frequency_response(part, participation) for part in parts])

    def _shifted(self, spectrum: Complex, delay: float) -> Floats:
        motion = np.fft.irfft(spectrum * np.exp(-self._s * delay), 2 * self._shrink.size)[: self._shrink.size]
        motion = motion / self._shrink
        return np.asarray(self._sensor.limit_band(motion[None], self._rate)[0] if self._limited else motion)

    def correlation(self, sign: float = 0.0) -> tuple[float, float, float]:
        """Return the delay of best correlation (of `sign` if not 0) with the recording, its square and the product."""
        motion = self._shifted(self._spectrum, 0.0)
        both = [np.fft.rfft(part, 2 * motion.size) for part in (self.samples, motion)]
        product = np.fft.irfft(both[0] * both[1].conj())[self._lags]
        best = int(np.argmax(np.abs(product) if not sign else sign * product))
        size = float(np.sum(motion**2) * np.sum(self.samples**2))
        return float(self._lags[best]), float(product[best] ** 2 / max(size, 1e-300)), float(product[best])

    def begin(self, delay: float) -> None:
        """Cut the recording to the impact, which must exceed the noise."""
        self.delay, stop, blow = delay, self.samples.size, self.blow
        if blow.impact is not None:
            self.onset = int(delay)
            if self.onset < _QUIET:
                raise BadData(
                    f"{blow.motion.name}: motion must begin {_QUIET} samples or more after the recording, got "
                    f"{self.onset}; leave a quiet stretch before the impact"
                )
            flight = 2 * blow.impact.rebound_velocity.item() / STANDARD_GRAVITY
            lasts = blow.impact.contact_duration.item() + _FLIGHT * flight
            stop = min(self.onset + int(np.ceil(lasts * self._rate)), stop)
        self._part = slice(max(self.onset - _BEFORE, 0), stop)
        ratio, before = self.samples[self._part], self.samples[self._part.start : self.onset]
        noise = float(before.std()) if before.size >= 2 else 0.0
        self.level = float(np.abs(ratio).max())
        if not self.level > _STANDS_OUT * noise:
            raise BadData(
                f"{blow.motion.name}: motion must exceed its noise {_STANDS_OUT:g} times, its peak is "
                f"{self.level:.3g} over a noise of {noise:.3g} before the impact; tap harder, or cut the recording to "
                "one impact"
            )

    def motion(self, *, slope: bool = False) -> Floats:
        """Return the motion of a gain of 1, or its slope in the delay, as `recorded`."""
        return self._scaled(self._shifted(-self._s * self._spectrum if slope else self._spectrum, self.delay))

    @property
    def recorded(self) -> Floats:
        """The recording over its largest sample, without its mean."""
        return self._scaled(self.samples)

    def _scaled(self, samples: Floats) -> Floats:
        ratio = samples[self._part]
        return np.asarray((ratio - ratio.mean()) / self.level)


def _fitted(models: Sequence[_Model]) -> tuple[float, Floats]:
    """Return the gain and explained fractions of the energy, by Gauss-Newton steps in the gain and all delays."""
    gain = 0.0
    for _ in range(_STEPS):
        information = pull = 0.0
        parts = []
        for model in models:
            motion, slope, recorded = model.motion(), model.motion(slope=True), model.recorded
            # The part explained by its delay is uninformative about the gain.
            free = motion - slope * (float(slope @ motion) / max(float(slope @ slope), 1e-300))
            information, pull = information + float(free @ free), pull + float(free @ recorded)
            parts.append((motion, slope, recorded))
        gain = pull / information
        for model, (motion, slope, recorded) in zip(models, parts, strict=True):
            step = float(slope @ (recorded - gain * motion)) / max(gain * float(slope @ slope), 1e-300, key=abs)
            model.delay += float(np.clip(step, -_MAX_CHANGE, _MAX_CHANGE))
    left = [model.recorded - gain * model.motion() for model in models]
    return gain, np.array(
        [1 - (ratio @ ratio) / (m.recorded @ m.recorded) for ratio, m in zip(left, models, strict=True)]
    )


# ---- recordings ------------------------------------------------------------------------------------------------------


def _motion(scene: Scene, blow: CalibrationImpact) -> Floats:
    """Return the samples of a motion in SI, checked against the scene."""
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
    if sensor.range is not None and np.abs(samples).max() >= 0.999 * sensor.range:
        raise BadData(
            f"{motion.name}: motion must stay within the range of {sensor.range:g} {sensor.unit}; tap more gently"
        )
    return samples


def _hammered(force: Signal) -> tuple[int, Floats]:
    """Return the first sample of a hammer's force, and the force, 0 before and after its contact."""
    samples = np.asarray(force.in_si().samples, np.float64)
    samples = samples - np.median(samples)
    peak, lowest = float(samples.max()), float(-samples.min())
    # Most of a recording contains no force, so its median deviation is that of the noise.
    noise = 1.4826 * float(np.median(np.abs(samples)))
    if not max(peak, lowest) > _STANDS_OUT * noise:
        raise BadData(
            f"{force.name}: force must rise {_STANDS_OUT:g} times above its noise of {noise:.3g} N, its peak is "
            f"{peak:.3g} N; check the hammer's channel"
        )
    if lowest > peak:
        raise BadData(
            f"{force.name}: force must be positive for compression, its peak is negative; use Signal.inverted()"
        )
    strong = np.flatnonzero(np.abs(samples) > max(_NOISE_FLOOR * noise, _FORCE_FLOOR * peak))
    # Noise exceeds the floor occasionally, so parts separated from the impact by a quiet stretch are excluded.
    at = int(np.searchsorted(strong, np.argmax(samples)))
    gaps = np.diff(strong) > 2 * _MARGIN
    begins = np.flatnonzero(gaps[:at])
    ends = np.flatnonzero(gaps[at:])
    start = int(strong[begins[-1] + 1 if begins.size else 0]) - _MARGIN
    stop = int(strong[at + ends[0] if ends.size else -1]) + _MARGIN + 1
    if start < 0 or stop > len(samples):
        raise BadData(f"{force.name}: force must rise and fall within the recording, {_MARGIN} samples off its ends")
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_TAPER) + 0.5) / _TAPER)
    window = np.zeros(samples.size)
    window[start:stop] = np.concatenate([rise, np.ones(stop - start - 2 * _TAPER), rise[::-1]])
    return start, window * samples
