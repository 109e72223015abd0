"""The gain of a sensor from recorded impacts on its beam: hammer taps, or drops of known mass."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from cgid._lib import validation
from cgid._lib.validation import Floats, rates_agree
from cgid.errors import BadData, InvalidValue
from cgid.physics.contact.impact import Impact
from cgid.physics.structure.response import Resonance, Response
from cgid.scene.file.schema import Scene, load_scene, varied
from cgid.scene.synthesis.impacts import beam_modes
from cgid.signals import Signal
from cgid.units import STANDARD_GRAVITY

#: Samples used before an impact and on either side of the largest; of a drop's force per sample; largest hammer delay.
_BEFORE, _AROUND, _FINER, _MAX_DELAY = 32, 1 << 13, 16, 4
#: A hammer's force exceeds this fraction of its peak and multiple of its noise, with a margin; its peak exceeds this.
_FLOOR, _NOISE_FLOOR, _MARGIN, _STANDS_OUT = 1e-3, 4.0, 8, 8.0
#: Used fraction of the flight after a drop; least explained fraction of a motion; damping of what wraps around.
_FLIGHT, _MIN_EXPLAINED, _WRAPPED = 0.8, 0.02, 1e-9


class Calibration(NamedTuple):
    """The gain of a sensor.

    Attributes
    ----------
    scene : Scene
        With `sensor.gain`.
    gain : float
    explained : ndarray, (n_recordings,)
        Fraction of each recording's energy that the scene explains.
    """

    scene: Scene
    gain: float
    explained: Floats


def calibrated(
    scene: Scene | str | Path, motions: Sequence[Signal], causes: Sequence[Signal | Impact], *, filtered: bool = True
) -> Calibration:
    """Fit the gain of a scene's sensor to recorded impacts: the factor between recorded and synthesised motion.

    It is fitted by least squares, with the delay of each impact; each recording has the same weight. Noise of 1 % of
    the peak of a hammer's force biases it by some 0.7 %. The beam's modes come from `cgid tap` or `cgid calibrate`.

    Parameters
    ----------
    scene : Scene, str or Path
        With a beam, the point of the impacts, and the sensor of the recordings, except for its gain.
    motions : sequence of Signal
        One impact each, after a quiet stretch.
    causes : sequence of Signal or Impact
        The force, recorded by a hammer with the same clock and length, above 0 where it pushes; or the drop of a known
        mass, as an impact on `scene.body` at the `free_fall_velocity` of its height.
    filtered : bool
        Whether forces passed the same anti-alias filter (or bandwidth) as motions, which then cancels.

    Returns
    -------
    Calibration

    Raises
    ------
    InvalidValue, BadData
        A quantity, rate or length does not fit; a recording is clipped, noise, or not due to its impact.
    """
    scene = load_scene(scene)
    if not 0 < len(motions) == len(causes):
        raise InvalidValue(f"motions must be 1 or more, and as many causes, got {len(motions)} and {len(causes)}")
    if scene.sensor.quantity == "force" or scene.tail_beam is None:
        raise InvalidValue(f"scene {scene.name} must have a sensor of motion on a tail beam to be calibrated")
    point = scene.tail_beam.impact_point
    (x, x_end), (y, y_end) = (point.x.extremes, point.y.extremes) if point else ((0, 0), (0, 0))  # measured modes: one
    if (x, y) != (x_end, y_end):
        raise InvalidValue(f"scene {scene.name}: impact_point must be that of the impacts, it is a region; set it")
    with threadpool_limits(1, "blas"):
        at = beam_modes(scene).participation([x], [y])[0]
        # Shifted by half a period the opposite sign fits almost as well: all impacts together determine the sign.
        both = [[_aligned(scene, at, *one, filtered, s) for one in zip(motions, causes, strict=True)] for s in (1, -1)]
    pairs = max(both, key=lambda pairs: sum((seen @ made) ** 2 / (made @ made) / (seen @ seen) for seen, made in pairs))
    gain = sum(float(made @ seen) for seen, made in pairs) / sum(float(made @ made) for _, made in pairs)
    explained = np.array([1 - np.sum((seen - gain * made) ** 2) / (seen @ seen) for seen, made in pairs])
    if explained[k := int(np.argmin(explained))] < _MIN_EXPLAINED:
        why = f"due to its impact, which explains {100 * explained[k]:.1f} % of it; check that they belong together"
        raise BadData(f"{motions[k].name}: motion must be {why}, the noise, and the impact point")
    return Calibration(varied(scene, gain=gain), gain, explained)


def _aligned(scene: Scene, at: Floats, motion: Signal, cause: Any, filtered: bool, sign: int) -> tuple[Floats, Floats]:
    """Return recorded and predicted motion at the best delay for a sign of the gain, over the recorded peak."""
    validation.instance("motion", motion, Signal)
    validation.instance("cause", cause, Signal, Impact)
    sensor, rate, filters, band = scene.sensor, scene.sampling.sampling_rate, scene.sensor.filters, True
    if motion.quantity != sensor.quantity or not rates_agree(motion.sampling_rate, rate):
        raise InvalidValue(
            f"{motion.name}: motion must be {sensor.quantity} at {rate:g} Hz, as in scene {scene.name}, got "
            f"{motion.quantity or 'no unit'} at {motion.sampling_rate:g} Hz; change the scene, or resample"
        )
    samples = np.asarray(motion.in_si().samples, np.float64)
    force = _hammered(cause, motion) if isinstance(cause, Signal) else samples
    window = slice(first := max(int(np.argmax(np.abs(force))) - _AROUND, 0), first + 2 * _AROUND)
    samples, force = samples[window], force[window]
    n = samples.size
    if np.ptp(samples) == 0 or np.abs(samples).max() > 0.999 * (sensor.range or np.inf):
        raise BadData(f"{motion.name}: motion must move, within the sensor's range; check the channel, or tap gently")
    if isinstance(cause, Signal):
        finer, lags = 1, np.arange(-_MAX_DELAY, _MAX_DELAY + 1)
        filters, band = tuple(f for f in filters if isinstance(f, Resonance) or not filtered), not filtered
    else:
        if cause.contact_duration.size != 1:
            raise InvalidValue(f"cause must be one impact, got {cause.contact_duration.size}; give each its motion")
        force, finer, lags = np.ravel(cause.force(np.arange(_FINER * n) / (_FINER * rate))), _FINER, np.arange(n)
    # Transformed along `s = decay + i omega`, so that ring-down after twice the length does not wrap around.
    decay = -np.log(_WRAPPED) / (2 * n)
    shrink, s = np.exp(-decay * np.arange(n)), decay + 1j * np.pi * np.arange(n + 1) / n
    spectrum = np.fft.rfft(force * np.exp(-decay / finer * np.arange(force.size)), 2 * force.size)[: n + 1] / finer
    response = Response(sampling_rate=rate, quantity=sensor.quantity, modes=beam_modes(scene), filters=filters)
    spectrum *= response.frequency_response(s * rate / (2j * np.pi), at)

    def predicted(delay: float) -> Floats:
        moved = np.fft.irfft(spectrum * np.exp(-s * delay), 2 * n)[:n] / shrink
        return np.asarray(sensor.limit_band(moved[None], rate)[0] if band else moved)

    both = [np.fft.rfft(part, 2 * n) for part in (samples - samples.mean(), predicted(0.0))]
    delay = float(lags[np.argmax(sign * np.fft.irfft(both[0] * both[1].conj())[lags])])
    part = slice(max(int(np.argmax(force > 0)) - _BEFORE, 0), n)
    if isinstance(cause, Impact):  # the sphere flies, then falls again
        lasts = cause.contact_duration.item() + _FLIGHT * 2 * cause.rebound_velocity.item() / STANDARD_GRAVITY
        part = slice(max(int(delay) - _BEFORE, 0), int(delay) + int(np.ceil(lasts * rate)))
    seen, *tried = (a[part] - a[part].mean() for a in (samples, *map(predicted, delay + np.linspace(-1, 1, 81))))
    made = max(tried, key=lambda made: sign * float(made @ seen) / float(np.linalg.norm(made)))
    return seen / np.abs(seen).max(), made / np.abs(seen).max()


def _hammered(force: Signal, motion: Signal) -> Floats:
    """Return a hammer's force, 0 before and after its contact."""
    rate, n = motion.sampling_rate, motion.samples.size
    if force.quantity != "force" or force.samples.size != n or not rates_agree(force.sampling_rate, rate):
        raise InvalidValue(f"{force.name}: force must be in N, of {n} samples at {rate:g} Hz as its motion; it is not")
    samples = np.asarray(force.in_si().samples, np.float64)
    samples = samples - np.median(samples)
    # Most of a recording contains no force, so its median deviation is that of the noise.
    peak, noise, at = float(samples.max()), 1.4826 * float(np.median(np.abs(samples))), int(np.argmax(samples))
    if not peak > max(_STANDS_OUT * noise, -float(samples.min())):
        raise BadData(
            f"{force.name}: force must rise {_STANDS_OUT:g} times above its noise of {noise:.3g} N and be positive for "
            f"compression, its peak is {peak:.3g} N; check the hammer's channel, or use Signal.inverted()"
        )
    loud = np.convolve(np.abs(samples) > max(_NOISE_FLOOR * noise, _FLOOR * peak), np.ones(2 * _MARGIN + 1), "same")
    quiet, index = np.flatnonzero(loud == 0), np.arange(n)
    end = int(np.searchsorted(quiet, at))
    if not 0 < end < quiet.size:
        raise BadData(f"{force.name}: force must rise and fall within the recording, {_MARGIN} samples off its ends")
    return np.where((index > quiet[end - 1]) & (index < quiet[end]), samples, 0.0)
