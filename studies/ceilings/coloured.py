"""The Bayes limit in Gaussian noise of a known covariance: pink, of a measured spectrum, hum of random phase, or a sum.

A pulse is zero outside a window of the frame that begins at touch. The samples outside, before touch and after
separation, hold noise alone, and tell the expected noise within the window and what remains uncertain of it. With y
the samples, m the pulse and P the inverse of the covariance of the whole frame,

    (y - m)' P (y - m) = |S' m - S^-1 (P y)_w|^2 + a constant,    P_ww = S S' (Cholesky),

so a fit to as many whitened points as the window has samples loses nothing. Hum counts as Gaussian of its covariance:
all that a frame tells of its amplitude and phase is used, but not that its amplitude is known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import numpy as np
import scipy  # loads its submodules on first use
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import InvalidValue
from cgid.measure.fit.fit_samples import by_length, mixing_matrix, tied
from cgid.measure.fit.least_squares import solve_scaled
from cgid.measure.fit.template import FREE, MAX_SHAPE, MAX_STEPS, MIN_SHAPE, bounded, relative_times
from cgid.scene import Scene
from cgid.scene.synthesis.draws import COLOURED
from cgid.scene.synthesis.noise import Coloured, ar_noise_of
from cgid.signals import Batch
from studies.ceilings.limit import (
    NODES,
    Ceiling,
    ceilings,
    onset_and_response,
    require_supported,
    true_pulses,
    uncovered_pulses,
)
from studies.impactor.likelihood import Profile, profile
from studies.impactor.pulses import normal_equations, pulse_and_slopes, shape_deviation

#: White noise that is always added, over the peak: the accuracy of the pulse as a curve.
_FLOOR = 1e-5
#: Most points of a window, and of a frame: longer ones are averaged over equal runs, and frames cut around the window.
_LONGEST, _MAX_POINTS = 320, 4096
#: The peaks that set the ratio of two noises are rounded to such steps of their logarithm.
_LEVEL_STEP = 0.05
#: Evaluations of the search for the most likely pulse.
_ITERATIONS = 10
#: Room that a window leaves for the most likely pulses of other shapes to be longer.
_ROOM = 1.15


def uncovered(scene: Scene) -> str:
    """Return what the integration needs that a scene does not have, empty if it covers the scene."""
    if scene.background is not None and scene.background.recorded is not None:
        return (
            "noise of a known spectrum: take [background.recorded] out, or give its spectrum as [background.coloured]"
        )
    noise, sensor = noise_of(scene), scene.sensor
    if sensor.range is not None and (not noise.white or sensor.offset or sensor.drift):
        return "white noise without offset and drift where a range cuts samples off: take sensor.range out"
    return uncovered_pulses(scene, noisy=bool(noise.level(np.ones(1)).any()))


def check_covered(scene: Scene) -> None:
    """Raise `InvalidValue` if the integration does not cover a scene."""
    require_supported(scene)
    if rule := uncovered(scene):
        raise InvalidValue(f"scene {scene.name}: the Bayes limit needs {rule}")


def limits(
    scene: Scene,
    n_signals: int,
    seed: int,
    drop_height_known: tuple[bool, ...] = (False,),
    *,
    n_nodes: int = NODES,
    progress: Callable[[int], object] | None = None,
) -> tuple[Ceiling, ...]:
    """Return the Bayes limits of the same signals for each value of `drop_height_known`."""
    check_covered(scene)
    # Clipped samples tell that the force was higher, which whitening cannot say.
    noise = noise_of(scene)
    along = None if scene.sensor.range is not None else partial(_along, noise)
    # Signals of equal peaks share most of the work.
    n_rows = 4096 if noise.mixed else 1024
    return ceilings(
        scene, n_signals, seed, drop_height_known, along=along, n_nodes=n_nodes, n_rows=n_rows, progress=progress
    )


def _along(noise: Noise, scene: Scene, batch: Batch, lowest: float, highest: float, n_nodes: int) -> Profile:
    onset, onset_between, response = onset_and_response(scene, len(batch))
    sensor, peak = scene.sensor, batch.parameters["peak_force"]
    shift = (sensor.offset or 0.0) + (sensor.drift or 0.0) / batch.sampling_rate * np.arange(batch.signals.shape[1])
    first = float(scene.sampling.pre_trigger)
    frames = Frames(batch.signals - shift, peak, noise, first, onset, response)
    return profile_in(
        frames, true_pulses(batch), lowest=lowest, highest=highest, n_nodes=n_nodes, onset_between=onset_between
    )


@dataclass(frozen=True, eq=False)
class Noise:
    """Stationary Gaussian noise; one part is proportional to the peak of a pulse, the other is not.

    Attributes
    ----------
    relative : ndarray, (n_samples,)
        Autocovariance of the first part at lags 0, 1, ..., over the squared peak.
    absolute : ndarray, (n_samples,)
        That of the second part, in the squared unit of the samples.
    """

    relative: Floats
    absolute: Floats

    @property
    def white(self) -> bool:
        """Whether all samples are independent."""
        return not (self.relative[1:].any() or self.absolute[1:].any())

    @property
    def mixed(self) -> bool:
        """Whether the ratio of its parts, and so the shape of its spectrum, goes with the peak."""
        return bool(self.relative.any() and self.absolute.any())

    def level(self, peak: Floats) -> Floats:
        """Return the standard deviation of a sample for signals with these peaks, (n,)."""
        return np.asarray(np.sqrt(self.relative[0] * peak**2 + self.absolute[0]))

    def scales(self, peak: Floats) -> tuple[Floats, Floats]:
        """Return rounded peaks, and factors by which noise of these peaks is that of the true ones, each (n,)."""
        if not self.mixed:
            return np.ones_like(peak), peak if self.relative.any() else np.ones_like(peak)
        rounded = np.exp(np.rint(np.log(peak) / _LEVEL_STEP) * _LEVEL_STEP)
        return rounded, peak / rounded

    def autocovariance(self, peak: float, run: int, n_points: int) -> Floats:
        """Return the autocovariance of means over runs of samples, (n_points,)."""
        lags = peak**2 * self.relative + self.absolute
        lags[0] += (_FLOOR * peak) ** 2
        if run == 1:
            return np.asarray(lags[:n_points])
        both = np.concatenate([lags[:0:-1], lags])
        triangle = np.convolve(np.ones(run), np.ones(run)) / run**2
        means = np.convolve(both, triangle, mode="same")
        return np.asarray(means[len(lags) - 1 :: run][:n_points])


def noise_of(scene: Scene) -> Noise:
    """Return the noise of a scene: its sensor, the rounding of its converter, hum and coloured background."""
    sensor, sampling, background = scene.sensor, scene.sampling, scene.background
    lags = np.arange(sampling.samples)
    sensed = ar_noise_of(scene)
    unit = np.where(lags == 0, 1.0, 0.0) if sensed is None else _autocovariance(sensed, lags.size)
    relative = sensor.relative_noise**2 * unit
    absolute = sensor.noise_level(np.zeros(()), sampling.sampling_rate) ** 2 * unit
    if sensor.bits is not None and sensor.range is not None:
        absolute[0] += (sensor.range / 2 ** (sensor.bits - 1)) ** 2 / 12
    if background is not None:
        for line in background.hum:
            hum = np.cos(2 * np.pi * line.frequency / sampling.sampling_rate * lags)
            if line.relative_amplitude is not None:
                relative += 0.5 * line.relative_amplitude**2 * hum
            else:
                absolute += 0.5 * line.amplitude_in(sensor.quantity) ** 2 * hum
        if background.coloured is not None:
            made = Coloured(background.coloured, sensor.quantity, sampling.sampling_rate, COLOURED)
            absolute += _autocovariance(made, lags.size)
    return Noise(relative, absolute)


def _autocovariance(noise: Coloured, n_samples: int) -> Floats:
    """Return the covariance of two samples of a frame that are 0, 1, ... samples apart, (n_samples,)."""
    length = 1 << (2 * n_samples - 1).bit_length()  # the period of the noise of a frame
    power = noise.density(length, n_samples) * (noise.sampling_rate / 2)
    power[-1] *= 2.0
    return np.asarray(np.fft.irfft(power, n=length)[:n_samples])


class Maps(NamedTuple):
    """Linear maps that whiten a frame.

    Attributes
    ----------
    data : ndarray, (n_points, n_window)
        From the frame to the whitened window.
    root : ndarray, (n_window, n_window)
        From a pulse in the window to the whitened window. The leading parts of both are those of shorter windows.
    """

    data: Floats
    root: Floats


@lru_cache(maxsize=24)
def maps(noise: Noise, peak: float, run: int, n_points: int, first: int, length: int) -> Maps:
    """Return the maps of a window of a frame of runs of samples, for noise beside a pulse of this peak."""
    window = slice(first, first + length)
    precision = precision_rows(noise.autocovariance(peak, run, n_points), window)
    root = np.linalg.cholesky(0.5 * (precision[:, window] + precision[:, window].T))
    data = scipy.linalg.solve_triangular(root, precision, lower=True).T
    return Maps(np.asarray(data, np.float64), np.asarray(root, np.float64))


def precision_rows(autocovariance: Floats, window: slice) -> Floats:
    """Return some rows of the inverse of a covariance, (n_rows, n), of stationary noise with this autocovariance, (n,).

    With x the first row of the inverse P of a symmetric Toeplitz matrix,
    `P[i, j] = P[i - 1, j - 1] + (x[i] x[j] - x[n - i] x[n - j]) / x[0]` (Gohberg & Semencul 1972).
    """
    x = scipy.linalg.solve_toeplitz(autocovariance, np.eye(1, len(autocovariance))[0])
    turned = np.concatenate([[0.0], x[:0:-1]])
    rows = np.empty((window.stop, len(x)))
    rows[0] = x
    for i in range(1, window.stop):
        rows[i, 0] = x[i]
        rows[i, 1:] = rows[i - 1, :-1] + (x[i] * x[1:] - turned[i] * turned[1:]) / x[0]
    return rows[window]


@dataclass(frozen=True, eq=False)
class Whitened:
    """Points of some pulses whose noise is white and of variance 1, and the curve to fit to them.

    Attributes
    ----------
    values : ndarray, (n, n_points)
    times : ndarray, (n_points,) [samples of the frame]
    root : ndarray, (n_points, n_points) or (n, n_points, n_points)
        From a pulse at these times to its whitened points.
    scale : ndarray, (n,)
        Level of the noise over that of the root.
    onset : ndarray, (n,), optional
        Time of touch if known [samples].
    """

    values: Floats
    times: Floats
    root: Floats
    scale: Floats
    onset: Floats | None
    free: list[int] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", FREE[self.onset is not None])

    def tied(self, parameters: Floats) -> Floats:
        """Return the parameters, with the place that follows from a known onset."""
        return tied(parameters, self.onset)

    def residual(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return whitened samples minus curve (n, n_points), and the slopes of the curve (n, n_free, n_points)."""
        times = np.broadcast_to(self.times, (len(parameters), self.times.size))
        model, slopes = pulse_and_slopes(parameters, times, self.onset is not None)
        curves = np.concatenate([model[:, None], slopes], axis=1)
        if self.root.ndim == 2:
            curves = (curves.reshape(-1, self.times.size) @ self.root).reshape(curves.shape)
        else:
            curves = curves @ self.root
        curves /= self.scale[:, None, None]
        return self.values - curves[:, 0], curves[:, 1:]


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of single pulses in known noise.

    Attributes
    ----------
    samples : ndarray, (n, n_samples)
    peak : ndarray, (n,)
        The peak that sets the level of each frame's noise.
    noise : Noise
    touch : float
        Earliest touch [samples].
    onset : ndarray, (n,), optional
        Time of touch if known [samples].
    response : ndarray, (n_lags,), optional
        Symmetric impulse response of the sensor from lag 0.
    """

    samples: NDArray[np.floating]
    peak: Floats
    noise: Noise
    touch: float
    onset: Floats | None
    response: Floats | None

    @property
    def first(self) -> int:
        """First sample of the windows."""
        return max(int(np.floor(self.touch)) - (0 if self.response is None else len(self.response)), 0)

    @cached_property
    def _scales(self) -> tuple[Floats, Floats]:
        return self.noise.scales(self.peak)

    def rows(self, chosen: NDArray[np.intp]) -> Frames:
        """Return some of the frames."""
        onset = None if self.onset is None else self.onset[chosen]
        return replace(self, samples=self.samples[chosen], peak=self.peak[chosen], onset=onset)

    def whitened(self, block: slice, longest: Floats) -> Iterator[tuple[NDArray[np.intp], Whitened]]:
        """Yield parts of a block of rows with their whitened points, for pulses up to these, (n, 4)."""
        duration, lead, *_ = relative_times(longest[:, 3])
        width = np.exp(longest[:, 1])
        stop = longest[:, 2] + (duration * _ROOM - lead) * width + 2
        wanted = np.maximum(stop - self.first + (0 if self.response is None else len(self.response)), 8.0)
        for rows, length in by_length(wanted):
            yield rows, self._part(block.start + rows, length)

    def _part(self, rows: NDArray[np.intp], length: int) -> Whitened:
        n_samples = self.samples.shape[1]
        run = max(-(-length // _LONGEST), 1) if self.response is None else 1
        before, after = self.first // run, (n_samples - self.first) // run
        points = min(-(-length // run), after)
        # Of a long frame, what lies around the window.
        before = min(before, max(_MAX_POINTS // 4, _MAX_POINTS - after))
        after = min(after, max(_MAX_POINTS - before, points))
        frames = self.samples[rows, self.first - before * run : self.first + after * run].astype(np.float64)
        frames = frames.reshape(rows.size, before + after, run).mean(axis=2)
        levels, scale = (part[rows] for part in self._scales)
        found, of_row = np.unique(levels, return_inverse=True)
        longest = max(points, min(_LONGEST, after))
        values, roots = np.empty((rows.size, points)), []
        for index, level in enumerate(found.tolist()):
            data, root = maps(self.noise, level, run, before + after, before, longest)
            own = of_row == index
            values[own] = frames[own] @ data[:, :points] / scale[own, None]
            roots.append(self._seen(points, run) @ root[:points, :points])
        times = self.first + run * np.arange(points) + 0.5 * (run - 1)
        root = roots[0] if len(roots) == 1 else np.stack(roots)[of_row]
        return Whitened(values, times, root, scale, None if self.onset is None else self.onset[rows])

    def _seen(self, points: int, run: int) -> Floats:
        """Return the map from the pulse at the middles of the runs to what a sensor's points hold of it."""
        if self.response is not None:
            return mixing_matrix(self.response, points)
        share = (1 - run**-2) / 24
        bend = np.eye(points, k=1) + np.eye(points, k=-1) - 2 * np.eye(points)
        return np.asarray(np.eye(points) + share * bend)


def profile_in(
    frames: Frames,
    near: Floats,
    *,
    lowest: float,
    highest: float,
    n_nodes: int,
    onset_between: tuple[float, float] | None,
) -> Profile:
    """Return the likelihood along the shape, as `studies.impactor.likelihood.profile`.

    `near` (n, 4) holds pulses near the most likely ones, such as the true ones: (peak, ln width, place, s).
    """
    if frames.noise.mixed and (np.diff(frames.peak) < 0).any():
        # Rows of similar peaks share their maps.
        order = np.argsort(frames.peak, kind="stable")
        ordered = profile_in(
            frames.rows(order),
            near[order],
            lowest=lowest,
            highest=highest,
            n_nodes=n_nodes,
            onset_between=onset_between,
        )
        back = np.argsort(order)
        return Profile(**{part.name: getattr(ordered, part.name)[back] for part in fields(Profile)})
    found, deviation = _most_likely(frames, near, lowest, highest)
    # White noise with this deviation of the shape.
    noise = deviation * np.exp(0.5 * found[:, 1] - shape_deviation(found[:, 3])[0]) * found[:, 0]
    return profile(
        frames.samples,
        found,
        noise,
        lowest=lowest,
        highest=highest,
        n_nodes=n_nodes,
        onset_between=onset_between,
        whitened=frames.whitened,
    )


def _most_likely(frames: Frames, near: Floats, lowest: float, highest: float) -> tuple[Floats, Floats]:
    """Return the most likely parameters, (n, 4), and the standard deviation of the shape, (n,)."""
    found, deviation = near.copy(), np.empty(len(near))
    longest = near.copy()
    longest[:, 3] = np.maximum(longest[:, 3] - MAX_STEPS[2], MIN_SHAPE)
    for first in range(0, len(near), 256):
        block = slice(first, first + 256)
        for part, points in frames.whitened(block, longest[block]):
            rows = first + part
            found[rows], deviation[rows] = _search(points, near[rows], lowest, highest)
    return found, deviation


def _search(points: Whitened, near: Floats, lowest: float, highest: float) -> tuple[Floats, Floats]:
    parameters = points.tied(near.copy())
    low, high = max(lowest - 0.5, MIN_SHAPE), min(highest + 0.5, MAX_SHAPE)
    cost = np.full(len(near), np.inf)
    best, damping = parameters.copy(), np.full(len(near), 1e-3)
    information = np.empty(0)
    for _ in range(_ITERATIONS):
        residual, slopes = points.residual(parameters)
        squared, new, gradient = normal_equations(residual, slopes)
        if not information.size:
            information, pull = new, gradient
        better = squared < cost
        best[better], cost[better] = parameters[better], squared[better]
        information[better], pull[better] = new[better], gradient[better]
        damping = np.where(better, 0.1 * damping, np.maximum(10 * damping, 0.1))
        step = solve_scaled(information, pull, (damping + 1e-10)[:, None, None])
        parameters = best.copy()
        parameters[:, 0] = np.maximum(parameters[:, 0] + step[:, 0], 0.2 * parameters[:, 0])
        parameters[:, points.free[1:]] += bounded(step, points.free, np.exp(best[:, 1]))[:, 1:]
        parameters[:, 3] = np.clip(parameters[:, 3], low, high)
        parameters = points.tied(parameters)
    unit = np.zeros(pull.shape)
    unit[:, points.free.index(3)] = 1.0
    spread = solve_scaled(information, unit, 1e-12)[:, points.free.index(3)]
    return best, np.sqrt(np.maximum(spread, 1e-300))
