"""Whether taps agree with each other, and the hammer's clock with that of the sensor.

A tap that the participations fitted to the others do not explain has a flaw of its own: a spike, a gap, a step, another
place or scale. A hammer recorded by another device is late or early. Its delay shows where the response begins, to a
millisecond, and then in the phases of the modes: from the right time on, all of their amplitudes over the force are
real.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Complex, Floats
from cgid.calibration.joint import Blow, Gram, spectra_of
from cgid.measure.modal.finite import bins_in

#: A response begins this long before or after its force, at most [s].
LATEST = 25e-3
#: Energy before and after a moment is compared within this time, in steps of a quarter of it [s].
_JUMP_TIME = 1e-3
#: A response begins elsewhere if its energy grows this many times as much there as near the force.
_RISES = 10.0
#: Of a tap: the fraction of the amplitude that is left, the same of others, and the factor that predicts it best.
Disagreement = tuple[float, float, float]
#: A tap is not explained if it leaves this fraction of its amplitude (the second, before modes are known), and this
#: many times what the others leave.
_UNEXPLAINED, _GROSS, _TIMES = 0.15, 0.5, 3.0
#: The remaining delay is sought in this range [s]; steps per period of the highest mode.
_FINE, _STEPS = 2e-3, 24
#: Delays below this many half periods of the highest mode count as none at first.
_NONE = 1.0


def starts_late(responses: Floats, before: int, sampling_rate: float) -> float:
    """Return by how many seconds a response (n_channels, n) begins after sample `before`, where its force does."""
    power = np.square(np.diff(responses, axis=1)).sum(axis=0)
    n = max(round(_JUMP_TIME * sampling_rate), 4)
    total = np.concatenate([[0.0], np.cumsum(power)])
    places = np.unique(np.append(np.arange(n // 4, power.size - n, max(n // 4, 1)), before))
    lead = np.maximum(np.minimum(places, n), 1)
    earlier = (total[places] - total[places - lead]) / lead
    later = (total[np.minimum(places + n, power.size)] - total[places]) / n
    # Not a ratio to silence: a floor that is below any response.
    jump = later / (earlier + 1e-6 * later.max() + 1e-300)
    none = float(jump[np.abs(places - before) <= 2 * n].max())  # also where a soft blow begins slowly
    jump[later < 0.05 * later.max()] = 0.0
    if jump.max() < _RISES * max(none, 1.0):
        return 0.0
    return float(places[np.argmax(jump)] - before) / sampling_rate


def disagreeing(gram: Gram) -> dict[int, Disagreement]:
    """Return taps that the others do not explain."""
    # Each tap counts alike: a spike would be the loudest.
    power = gram.power[:, None]
    gram = Gram(gram.matrix / power[:, None], gram.vector / power, np.ones_like(gram.power), gram.n_bins)
    return _worst(len(gram.power), lambda tap, others: _left(gram, tap, others), _UNEXPLAINED)


def disagreeing_at_first(
    blows: Sequence[Blow], sampling_rate: float, band: tuple[float, float]
) -> dict[int, Disagreement]:
    """Return taps, equally long, that the response measured at others does not explain, before any mode is known."""
    # Vibration of earlier taps is not in the forces, so that only gross errors count.
    spectrum, force = spectra_of(blows, bins_in(blows[0].response.size, sampling_rate, band))
    spectrum = spectrum / np.maximum(np.linalg.norm(spectrum, axis=1, keepdims=True), 1e-300)
    force = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-300)

    def left(tap: int, others: NDArray[np.intp]) -> tuple[float, float]:
        power = np.square(np.abs(force[others])).sum(axis=0)
        predicted = (spectrum[others] * force[others].conj()).sum(axis=0) / np.maximum(power, 1e-300) * force[tap]
        factor = np.sum(spectrum[tap] * predicted.conj()).real / max(np.sum(np.square(np.abs(predicted))), 1e-300)
        return float(np.linalg.norm(spectrum[tap] - predicted)), float(factor)

    return _worst(len(spectrum), left, _GROSS)


def _worst(
    n_taps: int, left: Callable[[int, NDArray[np.intp]], tuple[float, float]], least: float
) -> dict[int, Disagreement]:
    """Return taps of which others leave at least some fraction of the amplitude, the worst first."""
    out: dict[int, Disagreement] = {}
    rest = np.arange(n_taps)
    while rest.size > 2:
        each = [left(tap, rest[rest != tap]) for tap in rest.tolist()]
        worst = int(np.argmax([one[0] for one in each]))
        others = np.delete(rest, worst)
        among = float(np.median([left(tap, others[others != tap])[0] for tap in others.tolist()]))
        own, factor = each[worst]
        if own < max(least, _TIMES * among):
            break
        out[int(rest[worst])] = own, among, factor
        rest = others
    return out


def _left(gram: Gram, tap: int, others: NDArray[np.intp]) -> tuple[float, float]:
    """Return the fraction of a tap's amplitude that the others do not predict, and the factor that predicts it best."""
    participation = gram.of(others).solved(np.arange(gram.vector.shape[1]))[0]
    factor = gram.vector[tap] @ participation / max(participation @ gram.matrix[tap] @ participation, 1e-300)
    return float(np.sqrt(gram.of(np.array([tap])).unexplained(participation)[0])), float(factor)


def fine_delay(ratio: Complex, weight: Floats, pole: Complex) -> tuple[float, Floats, Floats]:
    """Return by how much forces are late [s], and the same of each tap with its standard deviation, (n_taps,).

    `ratio` (n_taps, n_modes) are amplitudes over transforms of the forces, `weight` how loud each of them is.
    """
    sizes = np.square(np.abs(ratio))
    step = 2 * np.pi / (_STEPS * pole.imag.max())
    grid = np.arange(-_FINE, _FINE + step, step)
    # Twice the phase, since a participation may have either sign: the mean of exp(2 j phase) is 1 if all are real.
    turns = np.exp(-2j * np.outer(grid, pole.imag))
    double = weight * np.square(ratio) / np.maximum(sizes, 1e-300)
    each = (double @ turns.T).real / weight.sum(axis=1, keepdims=True)
    height = np.median(each, axis=0)  # a tap with a flaw has any phase
    best, none = _top(grid, height), np.abs(grid) < _NONE * np.pi / pole.imag.max()
    if 1 - height.max() > 0.5 * (1 - height[none].max()):  # phases of few modes repeat: none is as likely
        best = _top(grid[none], height[none])
    near = np.abs(grid - best) < np.pi / pole.imag[np.argmax(weight.sum(axis=0))]
    own = np.array([_top(grid[near], row[near]) for row in each])
    rest = np.maximum(1 - each[:, near].max(axis=1), 1e-12)
    spread = (weight * np.square(2 * pole.imag)).sum(axis=1) / weight.sum(axis=1)
    count = np.square(weight.sum(axis=1)) / np.square(weight).sum(axis=1)
    return best, own, np.sqrt(2 * rest / spread / np.maximum(count - 1, 1.0))


def _top(grid: Floats, height: Floats) -> float:
    """Return where a curve is highest, by a parabola through three points."""
    at = int(np.argmax(height))
    if not 0 < at < grid.size - 1:
        return float(grid[at])
    before, top, after = height[at - 1 : at + 2]
    bend = before - 2 * top + after
    return float(grid[at] + (0.5 * (before - after) / bend if bend < 0 else 0.0) * (grid[1] - grid[0]))


def shifted(samples: Floats, count: int) -> Floats:
    """Return samples `count` later, or earlier if negative; zeros enter."""
    out = np.zeros_like(samples)
    if count >= 0:
        out[count:] = samples[: samples.size - count]
    else:
        out[:count] = samples[-count:]
    return out


def are_alike(delays: Floats, deviations: Floats, sampling_rate: float) -> NDArray[np.bool_]:
    """Return which delays differ from the median by less than half a sample, or than their errors allow."""
    off = np.abs(delays - np.median(delays))
    return np.asarray(off < np.maximum(0.5 / sampling_rate, 5 * deviations))
